"""Rays that the CPU traces in packets: each bit is the reference's, for all instruction sets."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from helpers.packets import INSTRUCTIONS, LAMP, TRANSFER, result, shaded, start
from helpers.rays import camera_rays
from torch import Tensor

import gvtorch as gv
from gvtorch.tracing.tracer import Tracer


def looks(*components: int) -> list[gv.ChannelLook]:
    """Returns looks of 8-bit channels, signed or unsigned."""
    return [gv.ChannelLook(window=(9.0 * c + 2, 120 - c), component=c) for c in components]


SUN = gv.DirectionalLight((1.0, -1.0, 0.0), (1.0, 0.9, 0.8))
SHADERS = {
    "plain": TRANSFER,
    "lit": gv.Lit(TRANSFER),
    "lit by the sun": gv.Lit(TRANSFER, light=SUN, shininess=7.3),
    "lit by a lamp": gv.Lit(TRANSFER, light=LAMP),
    "lit by stored normals": gv.Lit(TRANSFER, normals="normal", light=SUN),
    "lit by stored normals and a lamp": gv.Lit(TRANSFER, normals="normal", light=LAMP),
    "pre-integrated": gv.PreIntegrated(TRANSFER),
    "stored colour": gv.StoredColor("rgba"),
    "stored colour, lit": gv.StoredColor("rgba", premultiplied=True, lit=True, light=LAMP),
    "stored colour, stored normals": gv.StoredColor("rgba", lit=True, normals="normal"),
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
    (name, 3) for name in ("plain", "lit by a lamp", "stored colour", "isosurface", "maximum")
]


def all_shaded() -> dict[str, list[Tensor]]:
    return {f"{name} {number}": shaded(SHADERS[name], "cpp", number) for name, number in CASES}


@cache
def expected(name: str, branching: int) -> list[Tensor]:
    return shaded(SHADERS[name], "reference", branching)


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
