"""Producers: what they are asked, and what they may answer."""

from __future__ import annotations

from concurrent.futures import Future

import pytest
import torch
from helpers.pictures import GRAY, camera
from helpers.producers import SIZE, Ball, Sponge

import gvtorch as gv
from gvtorch.base.rows import distinct_rows
from gvtorch.producers import Layout


def layout(**changes) -> Layout:
    options = {
        "depth": 3,
        "branching": 2,
        "brick_size": 4,
        "border": 1,
        "extent": (32, 20, 9),
        "spacing": (0.5, 1.0, 2.0),
        "origin": (10.0, 20.0, 30.0),
        "device": torch.device("cpu"),
    }
    return Layout(**{**options, **changes})


@pytest.mark.parametrize(
    ("low", "high", "shape"),
    [
        (-3, 4, (500, 4)),
        (7, 8, (5, 3)),
        (0, 1 << 30, (40, 4)),  # their numbers would overflow
        (0, 9, (0, 4)),
    ],
)
def test_distinct_rows_are_those_of_unique(low, high, shape):
    rows = torch.randint(low, high, shape, generator=torch.Generator().manual_seed(1))
    rows = torch.cat((rows, rows.flip(0)))
    for a, b in zip(distinct_rows(rows), rows.unique(dim=0, return_inverse=True), strict=True):
        assert torch.equal(a, b)


def test_nodes_know_their_place():
    nodes = gv.Nodes(torch.tensor([[0, 0, 0, 0], [3, 1, 0, 2], [7, 4, 2, 3]]), layout())
    assert nodes.scale.tolist() == [8, 2, 1]
    assert nodes.voxel_size.tolist() == [[4, 8, 16], [1, 2, 4], [0.5, 1, 2]]
    low = [(0, 0, 0), (24, 8, 0), (28, 16, 8)]  # finest voxels
    for row, corner in enumerate(low):
        expected = [
            o + s * (c - 0.5) for o, s, c in zip((10, 20, 30), (0.5, 1, 2), corner, strict=True)
        ]
        assert nodes.box[row, 0].tolist() == pytest.approx(expected)
        side = 4 * nodes.voxel_size[row]
        assert torch.allclose(nodes.box[row, 1] - nodes.box[row, 0], side)
    positions = nodes.positions
    assert positions.shape == (3, 6, 6, 6, 3) and positions.dtype == torch.float32
    first = nodes.box[:, 0] + 0.5 * nodes.voxel_size
    assert torch.allclose(positions[:, 1, 1, 1].double(), first, atol=1e-5)
    step = positions[:, 2, 3, 4] - positions[:, 1, 1, 1]
    assert torch.allclose(step.double(), nodes.voxel_size * torch.tensor([3, 2, 1]), atol=1e-5)
    reach = (positions.double() - nodes.center[:, None, None, None]).norm(dim=-1)
    assert torch.allclose(reach.flatten(1).amax(1), nodes.radius, atol=1e-5)
    assert len(nodes[1:]) == 2 and nodes[1:].depth.tolist() == [2, 3]


@pytest.mark.backend("cpp")
def test_a_producer_is_asked_only_for_what_is_seen_and_once():
    ball = Ball(256)
    with gv.Engine(ball, **SIZE) as engine:
        picture = engine.render(camera(24, distance=0.3), GRAY)
        assert picture.stats.converged and picture.alpha.max() > 0.5
    filled = torch.cat(ball.filled)
    assert len(filled.unique(dim=0)) == len(filled)
    assert len(filled) < 0.1 * (256 // 4) ** 3
    assert len(filled) == picture.stats.produced["bricks"] + 1, "and the root"


@pytest.mark.backend("cpp")
def test_a_brick_may_turn_out_constant_or_empty():
    class Told(Ball):
        def fill(self, nodes):
            data = super().fill(nodes)["value"]
            finest = nodes.depth == nodes.layout.depth
            flat = finest & (data == 0).flatten(1).all(1)
            kind = torch.where(flat, gv.Region.CONSTANT, gv.Region.DATA)
            return gv.Bricks(
                data={"value": data}, kind=kind, constants={"value": data[:, 0, 0, 0, None]}
            )

    view = camera(24, distance=1.3)
    with gv.Engine(Ball(), **SIZE) as plain, gv.Engine(Told(), **SIZE) as told:
        a, b = (e.render(view, GRAY, lod="finest") for e in (plain, told))
        told.validate()
    assert b.stats.produced["constant"] > 0
    assert b.stats.produced["bricks"] < a.stats.produced["bricks"]
    assert torch.equal(a.color, b.color) and a.alpha.max() > 0.3


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("loading", ["straight", "levels"])
def test_a_node_may_be_the_same_as_another_even_as_its_own_ancestor(loading):
    """The graph has cycles: one tile and one brick suffice for every level of the sponge."""
    sponge = Sponge()
    options = {"brick_size": 4, "node_pool": "20 kB", "brick_pool": "20 kB", "loading": loading}
    shader = gv.TransferFunction.from_points([(0, 0), (20 / 27, 1)])
    view = gv.Camera.look_at((0.5, 0.5, 4), (0.5, 0.5, 0.5), (0, 1, 0), 17, 81, 81)
    with gv.Engine(sponge, **options) as engine:
        picture = engine.render(view, shader, lod="finest")
        engine.validate()
        assert picture.stats.converged and sponge.classified == 1 + 27 and sponge.filled == 1
        assert int((engine.cache.nodes.parent_t >= 0).sum()) == 1
        assert int((engine.cache.bricks.owner_b >= 0).sum()) == 1
        assert picture.alpha[40, 40] == 0 and picture.alpha[12, 12] == 1


@pytest.mark.backend("cpp")
def test_eviction_clears_every_pointer_to_a_shared_tile():
    """The sponge, next to a ball whose bricks and tiles evict it from the pools."""
    scene = {"sponge": Sponge(3), "ball": Ball(256)}
    view = gv.Camera.look_at((0.5, 0.5, 4), (0.5, 0.5, 0.5), (0, 1, 0), 20, 40, 40)
    away = gv.Camera.look_at((0, 0, 1.4), (-0.9, 0.2, -1), (0, 1, 0), 20, 40, 40)
    options = {"brick_size": 4, "node_pool": "60 kB", "brick_pool": "100 kB"}
    with gv.Engine(scene, **options) as engine:
        first = engine.render(view, GRAY)
        evicted = engine.render(away, GRAY, max_frames=60).stats.evicted
        assert evicted["tiles"] > 100 and evicted["bricks"] > 100
        engine.validate()
        picture = engine.render(view, GRAY)
        engine.validate()
        assert picture.stats.converged
        assert torch.equal(picture.alpha, first.alpha) and first.alpha.max() > 0.5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.Producer(0), "extent must be an int >= 1"),
        (lambda: gv.Producer((4, 4)), "extent must be a number or (x, y, z)"),
        (lambda: gv.Producer(4, spacing=0), "spacing must be positive"),
        (lambda: gv.Producer(4, box=((0, 0, 0), (1, 1, -1))), "sides of the box must be positive"),
        (lambda: gv.Producer(4, box=((0, 0, 0),)), "box must be two corners"),
        (lambda: gv.Producer(4, branching=1), "branching must be an int >= 2"),
        (lambda: gv.Producer(4.5), "extent must be an int >= 1"),
        (lambda: gv.Producer(4, value_range={"a": (0, 1)}), "value_range: unknown channel 'a'; "),
        (lambda: gv.Producer(4, value_range={"value": (1, 0)}), "must be (smallest, largest)"),
        (lambda: gv.Producer(4, labels={"a": None}), "labels: unknown channel 'a'; the producer"),
    ],
)
def test_bad_producers_are_named(call, message):
    with pytest.raises(ValueError) as caught:
        call()
    assert message in str(caught.value)


class Gray(Ball):
    """Returns only a tensor for its only channel, and counts the nodes outside."""

    def fill(self, nodes):
        return super().fill(nodes)["value"]


def test_the_voxels_of_one_channel_need_no_name(blobs):
    view = camera(24)
    with gv.Engine(Ball(64), **SIZE) as engine, gv.Engine(Gray(64), **SIZE) as other:
        expected, actual = engine.render(view, GRAY), other.render(view, GRAY)
    assert torch.equal(actual.color, expected.color) and actual.alpha.max() > 0.5


def test_a_mask_is_no_kind_of_region():
    class Outside(Ball):
        def classify(self, nodes):
            return nodes.center.norm(dim=1) > 3

    with pytest.raises(gv.ProductionError, match=r"kind must be \(1,\) of Region, got \(1,\) bool"):
        gv.Engine(Outside(64), **SIZE)


def test_nodes_that_fail_are_told_with_the_picture():
    class Torn(Ball):
        def fill(self, nodes):
            if int(nodes.depth.max()) > 0:
                raise OSError("torn")
            return super().fill(nodes)

    with gv.Engine(Torn(64), **SIZE) as engine:
        stats = engine.render(camera(24), GRAY).stats
        assert stats.failed > 0 and f"{stats.failed} nodes failed: Engine.failures" in repr(stats)


def test_validate_finds_a_tile_in_the_wrong_place(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    tree.nodes.loc_t4[3, 0] += 1
    with pytest.raises(ValueError, match="a tile's loc does not match its parent"):
        tree.validate()


@pytest.mark.backend("cpp")
def test_constants_do_not_depend_on_what_was_there_before(blobs):
    """A producer without constants for EMPTY nodes shares pools with one that has some: its picture
    is the same before and after."""

    class Bare(Ball):
        def classify(self, nodes):
            outside = nodes.center.norm(dim=1) - nodes.radius > 0.7
            return torch.where(outside, gv.Region.EMPTY, gv.Region.DATA)

    other = gv.VolumeProducer(gv.Volume(blobs.data + 1, blobs.spacing, (900.0, 0.0, 0.0)))
    views = [
        gv.Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40, 16, 16),
        gv.Camera.look_at((920, 10, 140), (920, 10, 20), (0, 1, 0), 40, 16, 16),
    ]
    options = {"brick_size": 4, "brick_pool": "600 kB", "node_pool": 60 * 160}
    with gv.Engine({"bare": Bare(64), "other": other}, **options) as engine:
        before = engine.render(views[0], GRAY)
        for _ in range(3):
            engine.render(views[1], GRAY, max_frames=60)
            after = engine.render(views[0], GRAY)
            assert torch.equal(after.color, before.color) and before.alpha.max() > 0.3


class Twins(Ball):
    """`fill` makes the right half of the finest level an alias of the left one."""

    how = "now"

    def fill(self, nodes):
        data = super().fill(nodes)["value"]
        side = 2**nodes.layout.depth
        right = (nodes.depth == nodes.layout.depth) & (nodes.loc[:, 0] >= side // 2)
        same = torch.full_like(nodes.loc, 2**40)  # rows that are no alias may hold anything
        same[right] = nodes.loc[right] - torch.tensor([side // 2, 0, 0, 0])
        if self.how == "bad" and right.any():
            same[right] = torch.tensor([0, 0, side, nodes.layout.depth])
        if self.how == "nan":
            left = (nodes.depth == nodes.layout.depth) & ~right
            data[left] = float("nan")
        if self.how == "raises" and not right.any() and (nodes.depth > 2).any():
            raise OSError("no such brick")
        kind = torch.where(right, gv.Region.ALIAS, gv.Region.DATA)
        answer = gv.Bricks(data={"value": data}, kind=kind, alias=same)
        if self.how != "later":
            return answer
        future: Future = Future()
        future.set_result(answer)
        return future


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("how", ["now", "later"])
def test_a_brick_may_be_the_same_as_one_that_is_not_here(how):
    """The camera sees only the right half: its bricks are made at the left half's positions."""
    view = gv.Camera.look_at((0.6, 0.1, 2.5), (0.6, 0.1, 0), (0, 1, 0), 14, 24, 24)
    twins = Twins()
    twins.how = how
    with gv.Engine(twins, **SIZE) as engine:
        picture = engine.render(view, GRAY, lod="finest")
        engine.validate()
        assert picture.stats.converged and picture.stats.failed == 0
        assert picture.alpha.max() > 0.2
        whole = gv.Camera.look_at((0, 0, 5), (0, 0, 0), (0, 1, 0), 28, 32, 32)
        engine.render(whole, GRAY, lod="finest")
        engine.validate()


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("how", "message"),
    [("bad", "is no node of this tree"), ("nan", "NaN"), ("raises", "OSError: no such brick")],
)
def test_aliases_fail_as_other_answers_do(how, message):
    twins = Twins()
    twins.how = how
    with gv.Engine(twins, **SIZE) as engine:
        picture = engine.render(camera(24, distance=1.3), GRAY, lod="finest")
        engine.validate()
        assert picture.stats.converged and picture.stats.failed > 0
        assert torch.isfinite(picture.color).all()
        assert any(message in failure.message for failure in engine.failures)


@pytest.mark.backend("cpp")
def test_a_root_may_be_constant_by_fill():
    class Flat(gv.Producer):
        def fill(self, nodes):
            side = nodes.layout.brick_size + 2
            kind = torch.full((len(nodes),), gv.Region.CONSTANT)
            value = {"value": torch.full((len(nodes), 1), 0.7)}
            data = {"value": torch.zeros((len(nodes), side, side, side))}
            return gv.Bricks(data=data, kind=kind, constants=value)

    for extent in (8, 64):
        with gv.Engine(Flat(extent)) as engine:
            assert engine.render(camera(8, distance=1.3), GRAY).alpha.max() > 0.9


def test_a_producer_serves_one_engine_at_a_time(blobs):
    producer = gv.VolumeProducer(blobs)
    with gv.Engine(producer, brick_size=4):
        with pytest.raises(ValueError, match="serves another engine"):
            gv.Engine(producer, brick_size=8)
    with gv.Engine(producer, brick_size=8) as engine:
        assert engine.frame(camera(8, distance=1.3), GRAY)[0].alpha.max() > 0
    with pytest.raises(ValueError, match="Engine: it is closed"):
        engine.render(camera(8, distance=1.3), GRAY)
