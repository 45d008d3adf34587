"""Trees whose bricks were edited: `to_volume`, `refresh`, and the warning if it is missing."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from helpers import DEVICES
from helpers.pictures import GRAY, assert_same_picture, camera
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base.volume import CHANNEL_DTYPES, movable
from gvtorch.pool.refresh import BrickLevels

SOFT = gv.TransferFunction.from_points(
    [(0, 0), (60, 0.1), (200, 0.9)], [(0, 1, 0, 0), (200, 0, 1, 1)]
)
PLACE = {"spacing": (1.1, 0.9, 1.3), "origin": (0.1, -3.7, 1e6 / 3)}


def patchy(extent, dtype=torch.float32, seed=0, channels=1) -> torch.Tensor:
    """Returns (z, y, x, c) with large and small regions of one value."""
    x, y, z = extent
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randint(
        0, 4, (-(-z // 5), -(-y // 5), -(-x // 5), channels), generator=generator
    )
    up = coarse.repeat_interleave(5, 0).repeat_interleave(5, 1).repeat_interleave(5, 2)[:z, :y, :x]
    noise = torch.rand((z, y, x, channels), generator=generator) * 120 * (up == 3)
    return (30.0 * up * (up > 1) + noise).to(dtype)


def equal(a: torch.Tensor, b: torch.Tensor) -> bool:
    return torch.equal(movable(a), movable(b))


def nodes_of(tree: gv.N3Tree) -> dict[tuple[int, ...], int]:
    """Returns the index of each node that rays can reach, by its loc."""
    nodes, front = {}, [((0, 0, 0, 0), tree.root)]
    n, per_tile = tree.branching, tree.nodes.nodes_per_tile
    child = tree.nodes.child_tn.flatten().tolist()
    while front:
        (x, y, z, depth), node = front.pop()
        size = tree.bricks.brick_size * n ** (tree.depth - depth)
        if any(c * size >= n_voxels for c, n_voxels in zip((x, y, z), tree.extent, strict=True)):
            continue
        nodes[x, y, z, depth] = node
        if child[node] >= 0:
            for i in range(n**3):
                loc = (x * n + i % n, y * n + i // n % n, z * n + i // n**2, depth + 1)
                front.append((loc, child[node] * per_tile + i))
    return nodes


def assert_same_trees(actual: gv.N3Tree, expected: gv.N3Tree) -> None:
    """Asserts the same nodes with the same content; only slots may differ."""
    mine, theirs = nodes_of(actual), nodes_of(expected)
    assert mine.keys() == theirs.keys()
    locs = list(mine)
    a, b = (torch.tensor([nodes[loc] for loc in locs]) for nodes in (mine, theirs))
    pointers = [t.nodes.brick_tn.flatten().cpu()[i] for t, i in ((actual, a), (expected, b))]
    assert torch.equal(pointers[0].clamp(max=0), pointers[1].clamp(max=0))
    has = pointers[0] >= 0
    for name in expected.bricks.channels:
        bricks = [
            movable(t.bricks[name].detach()).cpu()[word[has].long()]
            for t, word in zip((actual, expected), pointers, strict=True)
        ]
        assert torch.equal(*bricks), f"bricks of {name}"
        for field in ("ranges", "constants"):
            rows = [
                movable(getattr(t.nodes, field)[name]).flatten(0, 1).cpu()[index]
                for t, index in ((actual, a), (expected, b))
            ]
            some = slice(None) if field == "ranges" else ~has
            assert torch.equal(rows[0][some], rows[1][some]), f"{field} of {name}"
    assert actual.value_range == expected.value_range


@settings(max_examples=20, deadline=None)
@given(
    extent=st.tuples(*[st.integers(1, 15)] * 3),
    branching=st.integers(2, 3),
    brick_size=st.integers(2, 5),
    border=st.integers(0, 2),
    dtype=st.sampled_from(CHANNEL_DTYPES),
    seed=st.integers(0, 1000),
)
def test_a_tree_gives_its_volume_back_and_is_in_order(
    extent, branching, brick_size, border, dtype, seed
):
    volume = gv.Volume(patchy(extent, dtype, seed), **PLACE)
    tree = gv.N3Tree.from_volume(volume, brick_size, border, branching=branching)
    back = tree.to_volume()
    assert equal(back.data, volume.data)
    assert (back.spacing, back.origin) == (volume.spacing, volume.origin)
    before = {**tree.nodes.fields, **tree.bricks.fields}
    before = {name: field.clone() for name, field in before.items()}
    tree.refresh()
    for name, field in {**tree.nodes.fields, **tree.bricks.fields}.items():
        assert equal(field, before[name]), name


@settings(max_examples=24, deadline=None)
@given(
    extent=st.tuples(*[st.integers(4, 24)] * 3),
    branching=st.integers(2, 3),
    brick_size=st.integers(2, 8),
    border=st.integers(0, 2),
    dtype=st.sampled_from(CHANNEL_DTYPES),
    threshold=st.sampled_from([None, None, 40.0]),
    whole=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_a_refreshed_tree_is_one_built_anew(
    extent, branching, brick_size, border, dtype, threshold, whole, seed
):
    """All voxels in bricks may be edited, also so that regions become constant or cease to be."""
    generator = torch.Generator().manual_seed(seed)
    dense = torch.rand(*extent[::-1], 1, generator=generator) * 100 + 50  # bricks everywhere
    build = {"branching": branching, "threshold": threshold}
    tree = gv.N3Tree.from_volume(gv.Volume(dense.to(dtype), **PLACE), brick_size, border, **build)
    finest = tree.loc(tree.bricks.owner_b.long())[:, 3] == tree.depth
    assume(int(finest.sum()) == math.prod(-(-n // brick_size) for n in extent))  # none is uniform
    expected = dense.to(dtype, copy=True)
    for step in range(3):
        low = [int(torch.randint(0, n, (), generator=generator)) for n in extent]
        ends = zip(low, extent, strict=True)
        high = [int(torch.randint(a, n, (), generator=generator)) + 1 for a, n in ends]
        x, y, z = (slice(a, b) for a, b in zip(low, high, strict=True))
        new = patchy(extent, dtype, seed + step) if step < 2 else dense.to(dtype)
        movable(expected)[z, y, x] = movable(new)[z, y, x]
        write_finest(tree, expected, noise=whole)
        box = tree.box[0] + (torch.tensor([low, high]) - torch.tensor([-0.2, 0.2])[:, None]) * (
            torch.tensor(tree.spacing, dtype=torch.float64)
        )
        tree.refresh(None if whole else box)
        assert equal(tree.to_volume().data, expected)
        anew = gv.N3Tree.from_volume(gv.Volume(expected, **PLACE), brick_size, border, **build)
        assert_same_trees(tree, anew)
        tree.validate()


def write_finest(tree: gv.N3Tree, dense: torch.Tensor, noise: bool = True) -> None:
    """Writes voxels (z, y, x, c) into the bricks of the finest level, and others into borders."""
    size, border = tree.bricks.brick_size, tree.bricks.border
    owner = tree.bricks.owner_b.long()
    loc = tree.loc(owner)
    pool = movable(tree.bricks["value"].detach())
    values = movable(dense)
    for slot in (loc[:, 3] == tree.depth).nonzero()[:, 0].tolist():
        x, y, z = (loc[slot, :3] * size).tolist()
        part = values[z : z + size, y : y + size, x : x + size]
        inner = [slice(border, border + n) for n in part.shape[:3]]
        pool[slot] += noise  # borders, and what lies beyond the extent
        pool[slot][tuple(inner)] = part.to(pool.device)


@pytest.mark.parametrize("extent", [(40, 33, 29)])
def test_pictures_after_a_refresh_are_those_of_a_tree_built_anew(extent, compiled):
    device = DEVICES[compiled]
    dense = torch.rand(*extent[::-1], 1, generator=torch.Generator().manual_seed(1)) * 20
    tree = gv.N3Tree.from_volume(gv.Volume(dense, **PLACE), 8, device=device)
    write_finest(tree, 8 * dense + patchy(extent))
    with pytest.warns(UserWarning, match="render: bricks of value were edited, .* tree.refresh()"):
        stale = gv.render(tree, camera(), SOFT)
    gv.render(tree, camera(), SOFT)  # warns once
    tree.refresh()
    anew = gv.N3Tree.from_volume(tree.to_volume(), 8, device=device)
    for options in ({}, {"lod": "finest"}):
        picture = gv.render(tree, camera(), SOFT, **options)
        assert_same_picture(picture, gv.render(anew, camera(), SOFT, **options))
    assert (stale.alpha - picture.alpha).abs().max() > 0.3, "the ranges were stale"


def test_channels_of_all_kinds_are_refreshed(blobs):
    rgba = torch.rand(*blobs.data.shape[:3], 4, generator=torch.Generator().manual_seed(2))
    volumes = {
        "value": blobs,
        "rgba": gv.Volume(rgba, blobs.spacing, blobs.origin).directional(),
        "code": gv.Volume((rgba * 60000).to(torch.uint16), blobs.spacing, blobs.origin),
    }
    tree = gv.N3Tree.from_volume(volumes, 4)
    tree.bricks["value"][-200:] *= 0.25
    tree.bricks["rgba"][-30:] *= 0.5
    centre = tree.box.mean(0)
    tree.refresh()
    back = {name: tree.to_volume(name) for name in volumes}
    assert back["rgba"].filter == "directional" and not equal(back["value"].data, blobs.data)
    assert equal(back["code"].data, volumes["code"].data)
    assert_same_trees(tree, gv.N3Tree.from_volume(back, 4))
    tree.bricks["rgba"][-10:] *= 0.5
    tree.refresh(torch.stack((centre, tree.box[1])))
    again = {name: tree.to_volume(name) for name in volumes}
    assert_same_trees(tree, gv.N3Tree.from_volume(again, 4))


def test_a_region_without_a_brick_stays_as_it_is():
    data = torch.zeros(32, 32, 32)
    data[20:28, 20:28, 20:28] = 100
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4)
    tree.bricks["value"] += 5
    tree.refresh()
    back = tree.to_volume().data[..., 0]
    assert back[0, 0, 0] == 0 and back[24, 24, 24] == 105 and back[19, 19, 19] == 5
    tree.refresh()
    assert equal(tree.to_volume().data[..., 0], back)


def test_bricks_that_are_learned_stay_bricks_and_stay_silent(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    pointers = tree.nodes.brick_tn.clone()
    tree.bricks["value"] = torch.nn.Parameter(tree.bricks["value"])
    optimizer = torch.optim.SGD([tree.bricks["value"]], lr=1.0)
    shader = gv.ModuleShader(lambda v, *_: (v.expand(-1, 3), v.clamp(0, 1)))
    for _ in range(3):
        optimizer.zero_grad()
        gv.render(tree, camera(8), shader).color.sum().backward()
        optimizer.step()
    with torch.no_grad():
        with pytest.warns(UserWarning, match="tree.refresh"):
            gv.render(tree, camera(8), SOFT)
        tree.bricks["value"].fill_(0.25)
        tree.refresh()
        gv.render(tree, camera(8), SOFT)
    assert torch.equal(tree.nodes.brick_tn, pointers) and tree.bricks["value"].requires_grad
    assert tree.value_range == {"value": (0.25, 0.25)} or (tree.to_volume().data != 0.25).any()


def test_an_edit_is_told_once_and_an_engine_edits_nothing(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera(8).placed(tree.box).rays()
    for make in (
        lambda: gv.render(tree, camera(8), SOFT),
        lambda: gv.trace(tree, rays, SOFT),
        lambda: gv.cost(tree, camera(8), SOFT),
        lambda: gv.TreeTracer(tree, SOFT),
    ):
        tree.bricks["value"].mul_(1.5)
        with pytest.warns(UserWarning, match="edited"):
            make()
        make()
    pools = {"brick_size": 4, "node_pool": "1 MB", "brick_pool": "300 KB"}
    with gv.Engine(gv.VolumeProducer(blobs), **pools) as engine, warnings.catch_warnings():
        warnings.simplefilter("error")
        for turn in range(6):
            engine.frame(gv.Camera.orbit(60 * turn, 20, 1.2, width=16, height=16), SOFT)
        tree = engine.trees["scene"].tree
        tree.bricks["value"].mul_(1.5)
        with pytest.warns(UserWarning, match="edited"):
            engine.frame(camera(16), SOFT)
        with pytest.raises(ValueError, match="not all of this tree is in memory"):
            tree.refresh()


def test_colours_of_a_refreshed_tree_are_made_anew(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    bone = gv.TransferFunction.preset("bone", 0, 1)
    shader = gv.Filtered.of(tree, blobs, bone)
    tree.bricks["value"][-5:] *= 0.5
    tree.refresh()
    with pytest.raises(ValueError, match="make them again"):
        gv.render(tree, camera(8), shader)
    gv.render(tree, camera(8), gv.Filtered.of(tree, tree.to_volume(), bone))


def test_mistakes_are_named(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    for call, message in (
        (
            lambda: tree.to_volume("heat"),
            "unknown channel 'heat'; the tree has v",
        ),
        (lambda: tree.refresh((0, 0, 0)), "box must be (2, 3) numbers"),
        (lambda: tree.refresh([(1, 1, 1), (0, 2, 2)]), "box must be low and high corner"),
        (lambda: tree.bricks["heat"], "unknown channel 'heat'; it has value"),
        (lambda: tree.bricks.__setitem__("value", torch.zeros(3)), "value must be ("),
    ):
        with pytest.raises(ValueError) as caught:
            call()
        assert message in str(caught.value) and "\n" not in str(caught.value)
    tree.refresh([(1e6, 1e6, 1e6), (2e6, 2e6, 2e6)])  # outside of the tree: nothing to do


def test_a_box_far_from_the_corner_is_found_to_the_voxel(monkeypatch):
    """In float32 the spacing would be off by a third of a voxel there."""
    pools = gv.NodePool(1, {"value": gv.Channel()}), gv.BrickPool(1, {"value": gv.Channel()})
    place = {"extent": (20_000_000, 1, 1), "spacing": (0.1,) * 3, "origin": (0.0,) * 3}
    tree, spans = gv.N3Tree(*pools, depth=22, **place), []
    monkeypatch.setattr(BrickLevels, "refresh", lambda _, span, *settings: spans.append(span))
    tree.refresh(((1_899_999.97, 0, 0), (1_900_000.03, 0, 0)))
    assert [(span.first, span.end) for span in spans] == [((0, 0, 19_000_000), (1, 1, 19_000_001))]


def test_a_copy_on_another_device_is_edited_separately(blobs, monkeypatch):
    tree = gv.N3Tree.from_volume(blobs)
    monkeypatch.setattr("gvtorch.base.check.device", lambda *_: torch.device("meta"))
    other = tree.to("meta")
    before = dict(tree.value_range)
    other.value_range["value"] = (0.0, 1e9)
    assert tree.value_range == before
    assert other.turns is not tree.turns


def test_a_tree_moves_and_keeps_what_is_known_of_it(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4)
    moved = tree.to(DEVICES[compiled])
    assert moved.device.type == DEVICES[compiled]
    assert_same_picture(
        gv.render(moved.to("cpu"), camera(16, distance=1.3), GRAY),
        gv.render(tree, camera(16, distance=1.3), GRAY),
    )
    moved.bricks["value"].mul_(0.5)
    with pytest.warns(UserWarning, match="edited"):
        gv.render(moved, camera(8), SOFT)
