"""Pools, the mean-filtered pyramid and `N3Tree.from_volume`."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base import constants as config
from gvtorch.pool import pyramid
from gvtorch.pool.pyramid import volume_levels

SIZES = {"branching": 2, "brick_size": 4, "border": 1}


def random_volume(extent, dtype=torch.float32, seed=0, channels=1):
    x, y, z = extent
    data = torch.rand((z, y, x, channels), generator=torch.Generator().manual_seed(seed)) * 200
    return gv.Volume(data.to(dtype))


def coarse_by_hand(data: np.ndarray, n: int) -> np.ndarray:
    """Returns one level of the pyramid, voxel by voxel: means of the voxels below, the last one
    repeated."""
    shape = [-(-size // n) for size in data.shape]
    out = np.zeros(shape)
    for index in np.ndindex(*shape):
        picks = [
            np.minimum(np.arange(i * n, (i + 1) * n), size - 1)
            for i, size in zip(index, data.shape, strict=True)
        ]
        out[index] = data[np.ix_(*picks)].mean()
    return out


@pytest.mark.parametrize("reduction", ["mean", "majority"])
def test_each_level_is_made_once(reduction, monkeypatch):
    """From the level below: values by the volume's filter, and the ends of ranges."""
    shapes: dict[str, list[tuple[int, ...]]] = {}
    for name in ("coarser", "pool_min", "pool_max"):
        pool = getattr(pyramid, name)

        def noted(values, *args, name=name, pool=pool, **named):
            shapes.setdefault(name, []).append(values.shape)
            return pool(values, *args, **named)

        monkeypatch.setattr(pyramid, name, noted)
    volume = random_volume((40, 24, 30), torch.uint8)
    volumes = {"a": gv.Volume(volume.data, labels=reduction == "majority"), "b": volume}
    gv.N3Tree.from_volume(volumes, 4)
    levels = [(30, 24, 40, 1), (15, 12, 20, 1), (8, 6, 10, 1), (4, 3, 5, 1)]
    assert shapes == dict.fromkeys(("coarser", "pool_min", "pool_max"), 2 * levels)


@pytest.mark.parametrize("branching", [2, 3])
@pytest.mark.parametrize("extent", [(9, 5, 7), (16, 8, 4), (1, 13, 2)])
def test_levels_are_means_of_the_voxels_below(extent, branching):
    volume = random_volume(extent)
    sizes = {**SIZES, "branching": branching}
    expected = volume.data[..., 0].double().numpy()
    for number, level in enumerate(volume_levels(volume, 3, **sizes)):
        if number:
            expected = coarse_by_hand(expected, branching)
        np.testing.assert_allclose(level.values[..., 0].numpy(), expected, rtol=1e-5)


def test_integer_levels_are_rounded_once():
    volume = random_volume((8, 8, 8), torch.uint8)
    levels = list(volume_levels(volume, 4, **SIZES))
    mean = volume.data.double().mean()
    assert levels[3].values.dtype == torch.uint8 and abs(int(levels[3].values) - mean) <= 0.5


def node_at(tree: gv.N3Tree, depth: int, xyz: tuple[int, int, int]) -> int | None:
    """Returns the index of a node by its loc; None where the tree ends above it."""
    node = tree.root
    n, dim = tree.branching, tree.nodes.nodes_per_tile
    for level in range(1, depth + 1):
        tile = int(tree.nodes.child_tn.view(-1)[node])
        if tile < 0:
            return None
        x, y, z = (p // n ** (depth - level) % n for p in xyz)
        node = tile * dim + (z * n + y) * n + x
    return node


@settings(max_examples=20, deadline=None)
@given(
    extent=st.tuples(*[st.integers(1, 21)] * 3),
    branching=st.integers(2, 3),
    brick_size=st.integers(2, 5),
    border=st.integers(0, 2),
    seed=st.integers(0, 1000),
)
def test_every_brick_holds_its_region_of_its_level(extent, branching, brick_size, border, seed):
    volume = random_volume(extent, seed=seed)
    tree = gv.N3Tree.from_volume(volume, brick_size, border, branching=branching)
    tree.validate()
    sizes = {"branching": branching, "brick_size": brick_size, "border": border}
    levels = [level.values for level in volume_levels(volume, tree.depth + 1, **sizes)][::-1]
    count = 0
    for depth, level in enumerate(levels):
        grid = [-(-size // brick_size) for size in level.shape[2::-1]]
        for xyz in np.ndindex(*grid):
            node = node_at(tree, depth, xyz)
            slot = config.EMPTY if node is None else int(tree.nodes.brick_tn.view(-1)[node])
            if slot < 0:
                continue
            count += 1
            assert int(tree.bricks.owner_b[slot]) == node
            picks = [
                np.clip(np.arange(i * brick_size - border, (i + 1) * brick_size + border), 0, s - 1)
                for i, s in zip(xyz[::-1], level.shape[:3], strict=True)
            ]
            expected = level[np.ix_(*picks)]
            assert torch.equal(tree.bricks.bricks["value"][slot], expected)
    assert count == tree.bricks.capacity


def test_tiles_know_their_place_and_parent():
    tree = gv.N3Tree.from_volume(random_volume((20, 9, 14)), 4)
    for tile in range(1, tree.nodes.capacity):
        x, y, z, depth = tree.nodes.loc_t4[tile].tolist()
        parent = node_at(tree, depth - 1, (x, y, z))
        assert parent == int(tree.nodes.parent_t[tile])
        assert int(tree.nodes.child_tn.view(-1)[parent]) == tile
    assert tree.nodes.loc_t4[0].tolist() == [0, 0, 0, 0] and int(tree.nodes.parent_t[0]) == -1


@pytest.mark.parametrize("branching", [2, 3])
def test_a_node_is_found_by_its_loc_and_by_no_other(branching):
    tree = gv.N3Tree.from_volume(gv.Volume(torch.rand(16, 16, 16)), 4, branching=branching)
    node = torch.tensor([0, *range(branching**3, tree.nodes.child_tn.numel())])
    assert torch.equal(tree.find(tree.loc(node)), node)
    wrong = [(branching, 0, 0, 1), (-1, 0, 0, 1), (0, 0, 0, -1), (0, 0, 0, 99), (1 << 40, 0, 0, 2)]
    assert tree.find(torch.tensor(wrong)).tolist() == [-1] * len(wrong)
    with pytest.raises(ValueError, match="N3Tree: loc must be"):
        tree.find(torch.tensor([0, 0, 0, 0]))


def test_uniform_regions_take_no_brick():
    data = torch.full((32, 32, 32), 5, dtype=torch.uint8)
    data[20:28, 20:28, 20:28] = 9
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4)
    node = node_at(tree, tree.depth, (5, 5, 5))
    assert int(tree.nodes.brick_tn.view(-1)[node]) >= 0
    corner = node_at(tree, 1, (0, 0, 0))
    pointers = tree.nodes.brick_tn.view(-1), tree.nodes.child_tn.view(-1)
    assert [int(pointer[corner]) for pointer in pointers] == [config.CONSTANT, config.TERMINAL]
    assert int(tree.nodes.constants["value"].view(-1)[corner]) == 5


def test_threshold_never_hides_a_thin_bright_detail():
    """EMPTY depends on the largest finest voxel, not on the coarse mean, which a thin line hardly
    changes."""
    data = torch.zeros((32, 32, 32), dtype=torch.uint8)
    data[:, 17, 17] = 200
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4, threshold=100)
    for z in range(8):
        node = node_at(tree, tree.depth, (4, 4, z))
        assert node is not None and int(tree.nodes.brick_tn.view(-1)[node]) >= 0
    far = node_at(tree, 2, (0, 0, 0))
    assert far is None or int(tree.nodes.brick_tn.view(-1)[far]) == config.EMPTY


def test_box_runs_from_face_to_face(blobs):
    tree = gv.N3Tree.from_volume(blobs)
    low, high = tree.box.tolist()
    assert low == pytest.approx([4.5, -3.4, 1.25]) and high == pytest.approx([49.5, 19.8, 56.75])
    corner, size, far = tree.place
    assert torch.equal(corner, tree.box[0]) and torch.allclose(corner + far * size, tree.box[1])


def test_channels_keep_dtype_and_width(blobs):
    four = (blobs.data.repeat(1, 1, 1, 4) * 255).to(torch.uint8)
    color = gv.Volume(four, blobs.spacing, blobs.origin)
    tree = gv.N3Tree.from_volume({"density": blobs, "color": color}, 4)
    assert tree.channel_names == ("density", "color")
    for name, width in (("density", 1), ("color", 4)):
        assert tree.bricks.bricks[name].shape == (tree.bricks.capacity, 6, 6, 6, width)
    assert tree.bricks.bricks["color"].dtype == torch.uint8
    fields = (tree.nodes.fields, tree.bricks.fields)
    assert tree.nbytes == sum(tensor.nbytes for part in fields for tensor in part.values())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda v: gv.N3Tree.from_volume(v, 1), "brick_size must be an int >= 2"),
        (lambda v: gv.N3Tree.from_volume(v, 8.0), "brick_size must be an int"),
        (lambda v: gv.N3Tree.from_volume(v, 8, -1), "border must be an int >= 0"),
        (lambda v: gv.N3Tree.from_volume(v, branching=1), "branching must be an int >= 2"),
        (lambda v: gv.N3Tree.from_volume(v, threshold=float("nan")), "threshold must be finite"),
        (lambda v: gv.N3Tree.from_volume("v"), "expected a volume or an array"),
        (lambda v: gv.N3Tree.from_volume({}), "at least one channel"),
        (lambda v: gv.NodePool(0), "capacity must be an int >= 1"),
        (lambda v: gv.NodePool(2**30), "more than int32 can name"),
        (lambda v: gv.BrickPool(1, {}), "at least one channel"),
        (lambda v: gv.Channel(torch.float64), "dtype must be one of uint8"),
        (
            lambda v: gv.N3Tree.from_volume({"a": v, "b": gv.Volume(v.data[1:])}),
            "channels must share extent",
        ),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        call(random_volume((8, 8, 8)))


def test_validate_finds_wrong_pointers(blobs):
    for change in ("far", "twice"):
        tree = gv.N3Tree.from_volume(blobs, 4)
        pointers = tree.nodes.brick_tn.view(-1)
        owned = (pointers >= 0).nonzero()[:, 0]
        pointers[owned[0]] = tree.bricks.capacity if change == "far" else pointers[owned[1]]
        with pytest.raises(ValueError, match="brick"):
            tree.validate()
