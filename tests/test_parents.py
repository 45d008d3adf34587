"""Producers that need the bricks of their nodes' parents, such as octaves by level."""

from __future__ import annotations

import random
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.recorded import Frames

import gvtorch as gv
from gvtorch.producers.producer import Layout, Nodes

COMPILED = [pytest.param(b, marks=pytest.mark.backend(b)) for b in ("cpp", "cuda")]
LOOK = gv.TransferFunction.preset("gray", -0.5, 1.5)
BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def view(size=20, azimuth=30.0, away=0.8):
    return gv.Camera.orbit(azimuth, 20, away, None, size, size)


class Grown(gv.Producer):
    """Each node adds a number, which depends on its loc, to 0.9 of its parent's values, so that a
    voxel's value identifies its path from the root.
    """

    needs_parent = True
    on_device = True
    bad = None

    def fill(self, nodes):
        if self.bad is not None and (nodes.depth == self.bad).any():
            raise OSError("no such brick")
        side = nodes.layout.side
        value = (0.07 * nodes.depth + 0.01 * (nodes.loc[:, :3] % 3).sum(1)).float()
        value = value[:, None, None, None].expand(-1, side, side, side)
        if nodes.parents is None:
            return {"value": value.contiguous()}
        assert nodes.parents["value"].shape == (len(nodes), side, side, side, 1)
        return {"value": value + 0.9 * nodes.inherited()["value"][..., 0]}


class Later(Grown):
    """The same, answered from threads."""

    on_device = False

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.threads = ThreadPoolExecutor(3)

    def fill(self, nodes) -> Future:
        return self.threads.submit(super().fill, nodes)


def expected(producer: Grown, loc: list[int], layout: Layout) -> torch.Tensor:
    """Returns the brick of one node, from the root down, by trilinear interpolation in NumPy."""
    brick = None
    for depth in range(loc[3] + 1):
        ancestor = [c >> (loc[3] - depth) for c in loc[:3]]
        value = 0.07 * depth + 0.01 * sum(c % 3 for c in ancestor)
        side, size = layout.side, layout.brick_size
        if brick is None:
            brick = np.full((side,) * 3, value)
            continue
        above, brick = brick, np.empty((side,) * 3)
        axis = [((c % 2 * size + np.arange(side) - 1 + 0.5) / 2 - 0.5 + 1) for c in ancestor]
        low = [np.floor(a).astype(int) for a in axis]
        part = [a - b for a, b in zip(axis, low, strict=True)]
        brick[:] = 0
        for corner in np.ndindex(2, 2, 2):
            z, y, x = (low[2 - i] + corner[i] for i in range(3))
            weights = [part[2 - i] if corner[i] else 1 - part[2 - i] for i in range(3)]
            weight = weights[0][:, None, None] * weights[1][:, None] * weights[2]
            brick += weight * above[np.ix_(z, y, x)]
        brick = value + 0.9 * brick
    return torch.from_numpy(brick)


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("kind", [Grown, Later])
def test_children_are_handed_what_their_parents_hold(backend, kind):
    with gv.Engine(kind(64, box=BOX), brick_size=4, device=DEVICES[backend]) as engine:
        picture = engine.render(view(), LOOK)
        engine.validate()
        assert picture.stats.converged and not engine.failures
        source, bricks = engine.trees["scene"], engine.cache.bricks
        slot = (bricks.owner_b >= 0).nonzero()[:, 0]
        loc = source.tree.loc(bricks.owner_b[slot].to(torch.int64))
        assert len(slot) > 90 and loc[:, 3].max() >= 3
        for i in range(0, len(slot), 9):
            actual = bricks.bricks["value"][slot[i], ..., 0].cpu().double()
            whole = expected(source.producer, loc[i].tolist(), source.layout)
            torch.testing.assert_close(actual, whole, atol=1e-5, rtol=0)


@pytest.mark.parametrize("backend", COMPILED)
def test_small_pools_end_in_the_same_picture(backend):
    """Parents that were evicted are made again, and so are their parents."""
    options = {"brick_size": 4, "device": DEVICES[backend]}
    with gv.Engine(Grown(128, box=BOX), brick_pool="16 MB", **options) as engine:
        views = [view(16, azimuth, away) for azimuth in (0, 120) for away in (0.3, 1.5)]
        whole = [engine.render(camera, LOOK) for camera in views]
    pick, evicted = random.Random(1), 0
    for pool in (60, 200, 900):
        size = {"brick_pool": pool * 6**3 * 4, "node_pool": 60 * 8 * 20}
        with gv.Engine(Grown(128, box=BOX), **size, **options) as engine:
            for _ in range(12):
                number = pick.randrange(4)
                engine.frame(views[number], LOOK)
                engine.validate()
            for camera, picture in zip(views, whole, strict=True):
                actual = engine.render(camera, LOOK, max_frames=400)
                engine.validate()
                evicted += actual.stats.evicted["bricks"]
                assert actual.stats.converged or pool == 60
                if actual.stats.converged:
                    assert torch.equal(actual.color, picture.color)
    assert evicted > 150


@pytest.mark.parametrize("backend", COMPILED)
def test_frames_that_serve_themselves_do_as_others(backend):
    options = {"brick_size": 4, "device": DEVICES[backend], "brick_pool": "4 MB"}
    with gv.Engine(Grown(64, box=BOX), **options) as engine:
        picture = engine.render(view(), LOOK)
    with gv.Engine(Grown(64, box=BOX), **options) as engine:
        frames = Frames(engine, view(), LOOK, 64)
        for _ in range(300):
            hits, stats = frames.frame()
            if stats.converged:
                break
        engine.validate()
        assert stats.converged and torch.equal(hits.color, picture.color.reshape(-1, 3))


@pytest.mark.backend("cuda")
def test_a_graph_hands_over_what_parents_hold():
    options = {"brick_size": 4, "device": "cuda", "brick_pool": "4 MB"}
    with gv.Engine(Grown(64, box=BOX), **options) as engine:
        expected = engine.render(view(), LOOK)
    with gv.Engine(Grown(64, box=BOX), **options) as engine:
        graph = engine.capture(view(), LOOK, batch=64)
        for _ in range(300):
            picture, stats = graph.replay(view())
            if stats.settle().converged:
                break
        engine.validate()
        assert stats.converged and torch.equal(picture.color, expected.color)


@pytest.mark.backend("cpp")
def test_children_of_what_can_t_be_made_are_named():
    producer = Grown(64, box=BOX)
    producer.bad = 2
    with gv.Engine(producer, brick_size=4) as engine:
        picture = engine.render(view(), LOOK, lod="finest")
        engine.validate()
        failures = {(failure.loc[3], failure.message) for failure in engine.failures}
        assert (2, "OSError: no such brick") in failures
        assert (4, "the brick of its parent can't be made") in failures
        assert torch.isfinite(picture.color).all()
        producer.bad = None
        engine.forget_failures()
        assert engine.render(view(), LOOK, lod="finest").stats.converged and not engine.failures


@pytest.mark.backend("cpp")
def test_values_without_an_engine_are_those_of_the_picture():
    points = torch.rand((50, 3), generator=torch.Generator().manual_seed(2)) * 1.6 - 0.8
    producer = Grown(64, box=BOX)
    with gv.Engine(producer, brick_size=4) as engine:
        engine.render(view(), LOOK)
        inside = producer.at(points)["value"]
    assert inside.shape == (50, 1) and inside.std() > 0.005


def test_without_parents_there_is_nothing_to_inherit():
    layout = Layout.of(gv.Producer(64), 4, 1, torch.device("cpu"))
    with pytest.raises(ValueError, match="must have needs_parent"):
        Nodes(torch.zeros((1, 4), dtype=torch.int64), layout).inherited()


# --- Octaves by level


class Alone(gv.OctaveProducer):
    """The direct sum: nothing is inherited."""

    needs_parent = False


def spline(octaves=7, extent=256, **options) -> gv.noise.SplineSum:
    return gv.noise.SplineSum(frequency=extent / 2 / 2 ** (octaves - 1), octaves=octaves, **options)


def dense(total: gv.noise.SplineSum, side: int, hashed) -> np.ndarray:
    """Returns the sum in side^3 voxels and 2 around, by subdividing whole levels in float64."""
    result = None
    for number, octave in enumerate(total.octaves):
        cells = side >> (len(total.octaves) - 1 - number)
        if result is not None:
            for axis in range(3):
                result = np.moveaxis(result, axis, 0)
                finer = np.empty((2 * (len(result) - 4) + 4, *result.shape[1:]))
                finer[0::2] = 0.75 * result[1:-1] + 0.25 * result[:-2]
                finer[1::2] = 0.75 * result[1:-1] + 0.25 * result[2:]
                result = np.moveaxis(finer, 0, axis)
        values = octave.amplitude * hashed(octave, cells)
        result = values if result is None else result + values
    return result


@pytest.mark.parametrize("octaves", [1, 4, 6])
def test_voxels_hold_the_direct_sum(octaves):
    """Against whole levels in float64, with the same random numbers."""
    total, side = spline(octaves, 32), 32
    unit = gv.noise.SplineSum(frequency=1.0, octaves=1)

    def hashed(octave, cells):
        unit.octaves[0] = octave._replace(amplitude=1.0, frequency=1.0)
        reach = torch.arange(-2, cells + 2, dtype=torch.float64)[None] + 0.5
        return unit.bricks([reach] * 3, 1.0)[0][0].double().numpy()

    whole = dense(total, side, hashed)
    reach = (torch.arange(-2, side + 2, dtype=torch.float64)[None] + 0.5) * (2 / side)
    bricks, same = total.bricks([reach] * 3, 2 / side)
    assert bricks.shape == (1, 36, 36, 36) and same is bricks
    inner = (slice(2, -2),) * 3  # whole levels lack coarse neighbours beyond their faces
    np.testing.assert_allclose(bricks[0].numpy()[inner], whole[inner], atol=3e-7, rtol=0)
    assert 0.1 < bricks.std() < 1.0


@pytest.mark.parametrize("backend", COMPILED)
def test_streamed_octaves_are_the_direct_sum_in_every_bit(backend):
    options = {"brick_size": 8, "device": DEVICES[backend]}
    pictures, evaluations = [], []
    for kind, pool in ((Alone, "64 MB"), (gv.OctaveProducer, "64 MB"), (gv.OctaveProducer, "2 MB")):
        producer = kind(spline(gain=0.6), 256, box=BOX)
        with gv.Engine(producer, brick_pool=pool, **options) as engine:
            views = [engine.render(view(32, 40, away), LOOK) for away in (0.3, 1.2)]
            assert all(a.stats.converged for a in views)
            engine.validate()
        pictures.append(views)
        evaluations.append(producer.total.evaluations)
    for views in pictures[1:]:
        for a, c in zip(views, pictures[0], strict=True):
            assert torch.equal(a.color, c.color) and torch.equal(a.depth, c.depth)
    if backend == "cpp":  # CUDA must not wait, so it evaluates each level for all nodes
        assert evaluations[1] < 0.7 * evaluations[0], "numbers that were not made again"
    assert producer.at(torch.tensor([0.1, 0.2, 0.3]))["value"].shape == (1,)


@pytest.mark.parametrize("backend", COMPILED)
def test_recorded_frames_make_octaves(backend):
    """For nodes of all levels at once, without waiting, with the same bits."""
    options = {"brick_size": 8, "brick_pool": "64 MB", "device": DEVICES[backend]}
    with gv.Engine(gv.OctaveProducer(spline(), 256, box=BOX), **options) as engine:
        expected = engine.render(view(32), LOOK)
    producer = gv.OctaveProducer(spline(), 256, box=BOX)
    producer._by_level = producer._at_every_level  # as on CUDA
    with gv.Engine(producer, **options) as engine:
        frames = Frames(engine, view(32), LOOK, 50)
        for _ in range(200):
            hits, stats = frames.frame()
            if stats.converged:
                break
        engine.validate()
    assert stats.converged and expected.stats.converged and expected.alpha.mean() > 0.1
    assert torch.equal(hits.color, expected.color.reshape(-1, 3))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("total", [spline(5, 64), gv.noise.OctaveSum(frequency=2.0, octaves=5)])
def test_octaves_are_made_without_a_look_at_values(total):
    """torch.compile finds no read on the host, for roots and children, with or without parents."""
    producer = gv.OctaveProducer(total, 64, box=BOX)
    layout = Layout.of(producer, 8, 1, torch.device("cpu"))
    loc = torch.tensor([[0, 0, 0, 0], [1, 0, 1, 1], [3, 2, 0, 2], [5, 1, 7, 3], [4, 1, 7, 3]])
    assert len(layout.reach) == 10  # cached from here on; its lock can't be compiled
    random = torch.Generator().manual_seed(3)
    shape = (len(loc), *(layout.side,) * 3, 1)
    parents = {name: torch.rand(shape, generator=random) for name in producer.channels}

    def make(loc):
        return producer.fill(Nodes(loc, layout, parents=parents))

    compiled = torch.compile(make, fullgraph=True, backend="eager")
    actual = compiled(loc)
    with torch._dynamo.config.patch(error_on_recompile=True):
        compiled(loc)
    for rows in ([0], [1, 2, 3, 4]):
        held = {name: table[rows] for name, table in parents.items()} if rows[0] else None
        expected = producer.fill(Nodes(loc[rows], layout, parents=held))
        for name, values in expected.items():
            assert torch.equal(actual[name][rows], values)


def test_bricks_agree_where_they_meet_in_every_bit():
    producer = gv.OctaveProducer(spline(), 256, box=BOX)
    layout = Layout.of(producer, 8, 1, torch.device("cpu"))
    left = torch.tensor([[3, 7, 12, 5], [15, 0, 31, 5], [7, 7, 7, 5]])
    right = left + torch.tensor([1, 0, 0, 0])
    low, high = (producer.bricks_at(loc, layout)["value"][..., 0] for loc in (left, right))
    assert torch.equal(low[..., 8:], high[..., :2])


def test_a_level_makes_one_octave_and_gradient_noise_four():
    """Nothing is evaluated twice; a sum without parents would evaluate more octaves."""
    counts = {}
    for name, total in (
        ("spline", spline(12, 8 << 11)),
        ("perlin", gv.noise.OctaveSum(frequency=2.0, octaves=12)),
    ):
        producer = gv.OctaveProducer(total, 8 << 11, box=BOX)
        layout = Layout.of(producer, 8, 1, torch.device("cpu"))
        path = [torch.tensor([[5 << 8 >> (11 - d)] * 3 + [d]]) for d in range(12)]
        parents, shares = None, []
        for loc in path:
            before = total.evaluations
            bricks = producer.fill(Nodes(loc, layout, parents=parents))
            parents = {n: rows[..., None] for n, rows in bricks.items()}
            shares.append((total.evaluations - before) / 1000)
        counts[name] = shares, total.evaluations / total.plain_evaluations
    assert counts["spline"][0] == [1.0] * 12 and counts["spline"][1] < 0.65
    assert max(counts["perlin"][0]) == 4 and counts["perlin"][1] < 0.6


@pytest.mark.backend("cpp")
def test_gradient_noise_is_the_direct_sum_within_its_error():
    total = gv.noise.OctaveSum(frequency=3.0, octaves=6, gain=0.6, settled=16)
    points = torch.rand((200, 3), generator=torch.Generator().manual_seed(2)) * 1.8 - 0.9
    producer = gv.OctaveProducer(total, 512, box=BOX)
    alone = Alone(total, 512, box=BOX)
    actual, direct = producer.at(points)["value"], alone.at(points)["value"]
    assert 0 < (actual - direct).abs().max() < 9e-4 and direct.std() > 0.2


@pytest.mark.backend("cpp")
def test_what_voxels_hold_may_be_made_of_the_sum():
    def clouds(sums, nodes):
        return (sums - nodes.positions[..., 2]).clamp(0, 1)

    producer = gv.OctaveProducer(spline(), 256, box=BOX, values=clouds, value_range=(0, 1))
    assert [*producer.channels] == ["value", "inherited"]
    with gv.Engine(producer) as engine:
        picture = engine.render(view(24), gv.TransferFunction.preset("gray", 0, 1))
        engine.validate()
    assert picture.stats.converged and picture.alpha.max() > 0.9 and picture.alpha.min() == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.OctaveProducer(3, 64), "total must be a SplineSum or an OctaveSum, got int"),
        (
            lambda: gv.OctaveProducer(spline(), 64, box=((0, 0, 0), (1, 1, 2))),
            "voxels must be cubes, got sides (0.015625, 0.015625, 0.03125)",
        ),
        (lambda: gv.noise.SplineSum(octaves=0), "octaves must be an int >= 1"),
        (
            lambda: gv.Engine(gv.OctaveProducer(gv.noise.SplineSum(frequency=1.3), 64, box=BOX)),
            "voxels must be 2^n times as wide as the first octave's cells, 0.769231, got 0.25",
        ),
    ],
)
def test_bad_input_gives_one_clear_line(call, message):
    with pytest.raises((ValueError, gv.ProductionError)) as error:
        call()
    assert message in str(error.value) and "\n" not in str(error.value)
