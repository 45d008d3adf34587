"""Rays that the CPU traces in packets: each bit is the reference's, for all instruction sets."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from helpers.packets import (
    INSTRUCTIONS,
    LAMP,
    TRANSFER,
    result,
    shaded_in_few_steps,
    start,
)
from helpers.rays import camera_rays
from helpers.traces import trace
from torch import Tensor

import gvtorch as gv
from gvtorch.base.constants import ABSENT
from gvtorch.tracing.tracer import Tracer


def looks(*components: int) -> list[gv.ChannelLook]:
    """Returns looks of 8-bit channels, signed or unsigned."""
    return [gv.ChannelLook(window=(9.0 * c + 2, 120 - c), component=c) for c in components]


SUN = gv.DirectionalLight((1.0, -1.0, 0.0), (1.0, 0.9, 0.8))
FAINT = gv.TransferFunction.from_points(
    [(20, 0), (250, 0.03)], [(20, 1, 0.3, 0.1), (250, 0.2, 0.6, 1)]
)
WIDE_SUN = gv.DirectionalLight((0.3, -1.0, 0.6), angle=20.0)
SHADERS = {
    "plain": TRANSFER,
    "lit": gv.Lit(TRANSFER),
    "lit by the sun": gv.Lit(TRANSFER, light=SUN, shininess=7.3),
    "lit by a lamp": gv.Lit(TRANSFER, light=LAMP),
    "lit by stored normals": gv.Lit(TRANSFER, normals="normal", light=SUN),
    "lit by stored normals and a lamp": gv.Lit(TRANSFER, normals="normal", light=LAMP),
    "in the sun's shadows": gv.Lit(TRANSFER, light=SUN, shadows=True),
    "in a lamp's shadows": gv.Lit(TRANSFER, normals="normal", light=LAMP, shadows=True),
    "in a wide sun's shadows": gv.Lit(TRANSFER, light=WIDE_SUN, shadows=True),
    "scattering": gv.Lit(TRANSFER, light=SUN, shadows=True, octaves=3, anisotropy=0.4),
    "pre-integrated": gv.PreIntegrated(TRANSFER),
    "stored colour": gv.StoredColor("rgba"),
    "stored colour, lit": gv.StoredColor("rgba", premultiplied=True, lit=True, light=LAMP),
    "stored colour, stored normals": gv.StoredColor("rgba", lit=True, normals="normal"),
    "colour by direction": gv.StoredColor("six"),
    "colour by direction, lit": gv.StoredColor("six", lit=True, normals="normal", light=LAMP),
    "stored colour, shadows": gv.StoredColor("rgba", normals="normal", light=SUN, shadows=True),
    "colour by direction, shadows": gv.StoredColor("six", light=LAMP, shadows=True),
    "isosurface": gv.Isosurface(0.45, light=LAMP),
    "distance field": gv.DistanceField(offset=0.4),
    "maximum": gv.Projection("maximum", TRANSFER),
    "minimum": gv.Projection("minimum", TRANSFER),
    "mean": gv.Projection("mean", TRANSFER),
    "features": gv.Features(TRANSFER, "rgba"),
    "channels": gv.Channels(looks(3, 0, 2, 1), channel="rgba"),
    "channels by opacity": gv.Channels(looks(2, 0), "opacity", channel="normal"),
    "one channel": gv.Channels([TRANSFER]),
}


#: Shader and N; trees with N = 3 are deep.
CASES = [(name, 2) for name in SHADERS]
CASES += [
    (name, 3)
    for name in (
        "plain",
        "lit by a lamp",
        "in a lamp's shadows",
        "stored colour",
        "colour by direction",
        "isosurface",
        "maximum",
    )
]


def all_shaded() -> dict[str, list[Tensor]]:
    return {
        f"{name} {number}": shaded_in_few_steps(SHADERS[name], "cpp", number)
        for name, number in CASES
    }


@cache
def expected(name: str, branching: int) -> list[Tensor]:
    return shaded_in_few_steps(SHADERS[name], "reference", branching)


@pytest.fixture(scope="module")
def of_instructions(tmp_path_factory) -> dict[str, dict[str, list[Tensor]]]:
    """The results by instruction set, then by shader."""
    folder = tmp_path_factory.mktemp("packets")
    return {name: result(start(all_shaded, folder, name)) for name in INSTRUCTIONS}


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(("name", "branching"), CASES)
@pytest.mark.parametrize("instructions", INSTRUCTIONS)
def test_every_bit_is_the_reference_s(of_instructions, instructions, name, branching):
    actual = of_instructions[instructions][f"{name} {branching}"]
    for a, b in zip(actual, expected(name, branching), strict=True):
        assert torch.equal(a.nan_to_num(7), b.nan_to_num(7))
    assert sum(len(a.unique()) for a in actual) > 1000, "the test must see something"


def check_bits(tree, size: int, shader: gv.Shader, lods=("auto", "finest"), **options) -> None:
    """Checks that pictures have the reference's bits."""
    rays = camera_rays(tree, size, distance=1.4)
    for lod in lods:
        (a, marks_a), (b, marks_b) = (
            trace(tree, backend, rays, shader, lod=lod, **options)
            for backend in ("cpp", "reference")
        )
        for key, expected in {**b, **marks_b}.items():
            assert torch.equal({**a, **marks_a}[key].nan_to_num(7), expected.nan_to_num(7)), key
        assert b["color"].unique().numel() >= 20, "the test must see something"


OF_ONE_BRICK = [
    *("plain", "lit", "lit by stored normals"),
    *("stored colour", "isosurface", "features"),
]


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("name", OF_ONE_BRICK)
def test_a_pool_of_one_brick_is_read(name, number):
    """It is copied, with room for loads beyond a voxel, if that is little beside the rays. Any two
    of shader, dtype, size of the brick and lod meet.
    """
    dtype = (torch.uint8, torch.int16, torch.float16, torch.float32)[number]
    odd = OF_ONE_BRICK.index(name) % 2
    brick = (8, 32)[(number + odd) % 2]  # copied, not copied
    lod = ("auto", "finest")[(number // 2 + odd) % 2]
    numbers = torch.rand((4, 6, 7, 5), generator=torch.Generator().manual_seed(3))
    factor = 1 if dtype.is_floating_point else 1.9
    channels = {"value": numbers[0], "rgba": numbers.movedim(0, -1), "normal": numbers[:3]}
    channels["normal"] = channels["normal"].movedim(0, -1)
    volumes = {key: gv.Volume((some * factor).to(dtype)) for key, some in channels.items()}
    tree = gv.N3Tree.from_volume(volumes, brick)
    assert tree.bricks.capacity == 1
    check_bits(tree, 9, SHADERS[name], lods=(lod,))


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    "shader",
    [FAINT, gv.Lit(FAINT), gv.StoredColor("rgba", reference=30.0), gv.Features(FAINT, "rgba")],
    ids=["plain", "lit", "stored colour", "features"],
)
def test_constant_nodes_beside_the_one_brick_of_a_pool(shader):
    """Packets read constant nodes, but not the brick: it is too large to be copied for few rays."""
    numbers = torch.full((32, 32, 64, 4), 90, dtype=torch.uint8)
    generator = torch.Generator().manual_seed(3)
    numbers[:, :, :31] = torch.randint(0, 255, (32, 32, 31, 4), generator=generator)
    volumes = {"value": gv.Volume(numbers[..., 1]), "rgba": gv.Volume(numbers)}
    tree = gv.N3Tree.from_volume(volumes, 32)
    pool, brick_tn = tree.bricks, tree.nodes.brick_tn.view(-1)
    brick_tn[tree.root] = ABSENT
    (node,) = (brick_tn >= 0).nonzero()[:, 0].tolist()
    for channel, bricks in pool.bricks.items():
        pool.bricks[channel] = bricks[brick_tn[node]][None].clone()
    for key, field in pool.fields.items():
        if key in vars(pool):
            setattr(pool, key, field[:1].clone())
    pool.in_order()
    brick_tn[node] = 0
    check_bits(tree, 9, shader, lods=("finest",))


@pytest.mark.backend("cpp")
def test_a_pool_without_bricks_is_none_to_read():
    """All nodes are constant."""
    volumes = {
        "value": gv.Volume(torch.full((9, 9, 9), 0.6)),
        "normal": gv.Volume(torch.full((9, 9, 9, 3), 0.4)),
    }
    tree = gv.N3Tree.from_volume(volumes, 4)
    assert tree.bricks.capacity == 0
    check_bits(tree, 9, SHADERS["plain"])
    check_bits(tree, 9, SHADERS["lit by stored normals and a lamp"])


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", ["plain", "lit"])
def test_bricks_of_more_than_2_to_the_24_numbers_are_read(name):
    """Float32 can't count them: it would round the place of a voxel in the far half of a brick."""
    values = torch.rand((300, 6, 5, 3), generator=torch.Generator().manual_seed(5)) * 255
    tree = gv.N3Tree.from_volume(gv.Volume(values.to(torch.uint8)), 200)
    assert tree.bricks.bricks["value"][0].numel() > 2**24 and tree.bricks.capacity > 1
    check_bits(tree, 33, SHADERS[name], component=1)


@pytest.mark.backend("cpp")
def test_nodes_beyond_2_gib_are_found_as_others_are():
    values = torch.rand((24, 24, 24), generator=torch.Generator().manual_seed(2))
    tree = gv.N3Tree.from_volume(gv.Volume(values), 4)
    rays = camera_rays(tree, 9, distance=1.4)
    tracer = Tracer(tree, TRANSFER, gv.RenderOptions())
    near, arguments = tracer(rays), tracer.arguments
    first = 2**26 + 1  # tile; 8 nodes of 4 bytes each

    def far(tensor: Tensor) -> Tensor:
        # Pages that are never touched take no memory.
        table = np.zeros((first + len(tensor), *tensor.shape[1:]), tensor.numpy().dtype)
        table[first:] = tensor.numpy()
        return torch.from_numpy(table)

    children = arguments.child_tn.clone()
    children[children >= 0] += first
    tables = {
        name: far(getattr(arguments, name))
        for name in ("constant_tnc", "range_tn2c", "brick_tn", "request_tn", "stamp_t")
    }
    tracer.arguments = arguments._replace(
        **tables, child_tn=far(children), root=arguments.root + 8 * first
    )
    hits = tracer(rays)
    assert near.alpha.max() > 0.3 and (tables["stamp_t"][first:] == tree.frame).any()
    for field, there in vars(near).items():
        assert there is None or torch.equal(getattr(hits, field), there), field


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
@pytest.mark.parametrize("name", ["plain", "lit", "maximum", "isosurface"])
def test_bricks_beyond_2_gib_are_read_as_others_are(name, dtype):
    factor = 1 if dtype.is_floating_point else 2
    values = torch.rand((24, 24, 24), generator=torch.Generator().manual_seed(2))
    tree = gv.N3Tree.from_volume(gv.Volume((values * factor).to(dtype)), 4)
    rays = camera_rays(tree, 9, distance=1.4)
    near = gv.trace(tree, rays, SHADERS[name])
    bricks, voxels = tree.bricks, tree.bricks.bricks["value"]
    used = bricks.capacity
    first = 2**31 // voxels[0].nbytes + 1
    # Pages that are never touched take no memory.
    far = np.zeros((first + used, *voxels.shape[1:]), voxels.numpy().dtype)
    far[first:] = voxels.numpy()
    bricks.bricks["value"] = torch.from_numpy(far)
    bricks.stamp_b = torch.full((first + used,), -1, dtype=torch.int32)
    tree.nodes.brick_tn[tree.nodes.brick_tn >= 0] += first
    bricks.in_order()
    hits = gv.trace(tree, rays, SHADERS[name])
    assert near.alpha.max() > 0.3 and (bricks.stamp_b[first:] == tree.frame).any()
    for field, there in vars(near).items():
        assert there is None or torch.equal(getattr(hits, field), there), field


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", ["plain", "lit"])
def test_a_table_beyond_2_gib_is_read_as_others_are(name):
    tree = gv.N3Tree.from_volume(gv.Volume(torch.linspace(0, 1, 12**3).view(12, 12, 12)), 4)
    rays = camera_rays(tree, 9, distance=1.4)
    tracer = Tracer(tree, SHADERS[name], gv.RenderOptions(lod="finest"))
    arguments, used = tracer.arguments, 64  # rows from the value 0 on, all of one colour
    hits = []
    for unused in (0, 2**27):
        # Pages that are never touched take no memory.
        table = np.zeros((1, unused + used, 4), np.float32)
        table[0, unused:] = (0.2, 0.5, 0.9, 0.3)
        opaque = np.zeros(unused + used, np.int32)
        opaque[unused:] = np.arange(1, used + 1)
        tracer.arguments = arguments._replace(
            table_lm4=torch.from_numpy(table),
            domain_2=torch.tensor([-unused, used - 1], dtype=torch.float32),
            opaque_m=torch.from_numpy(opaque),
        )
        hits.append(tracer(rays))
    assert hits[0].alpha.max() > 0.3
    for field, near in vars(hits[0]).items():
        assert near is None or torch.equal(getattr(hits[1], field), near), field
