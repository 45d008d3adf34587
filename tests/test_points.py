"""Points as voxels: against dense sums at every level, proofs, pictures, bad input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.points import share_below

import gvtorch as gv
from gvtorch.points.points import Points
from gvtorch.points.sorted import sort_points
from gvtorch.points.splat import Cubes, values
from gvtorch.producers import Layout

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
CPU = torch.device("cpu")


def some_points(count: int = 4000, width: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns clusters away from the faces; most regions are empty."""
    random = torch.Generator().manual_seed(3)
    middle = torch.rand((12, 3), generator=random) * 1.4 - 0.7
    positions = middle[torch.randint(0, 12, (count,), generator=random)]
    positions = positions + 0.06 * torch.randn((count, 3), generator=random).clamp(-2.5, 2.5)
    return positions.double(), torch.rand((count, width), generator=random).double() + 0.1


def some_radii(count: int = 4000) -> torch.Tensor:
    """Returns radii of 0, below a voxel of 1/32, of some voxels and of many, inside the box."""
    random = torch.Generator().manual_seed(4)
    radius = torch.tensor([0.0, 0.01, 0.04, 0.1])[
        torch.randint(0, 4, (count,), generator=random)
    ].double()
    radius[:6] = torch.tensor([0.3, 0.5, 0.9, 0.7, 0.2, 3.0])
    return radius


def dense(
    positions: torch.Tensor, value: torch.Tensor, side: int, radius: torch.Tensor | None = None
) -> np.ndarray:
    """Returns (z, y, x, c): sums of the points in voxels, by a histogram, or by the density of sums
    of four uniform random numbers (Irwin, Hall) along each axis."""
    if radius is None:
        parts = [
            np.histogramdd(
                positions.flip(1).numpy(), (side,) * 3, [(-1, 1)] * 3, weights=value[:, c].numpy()
            )[0]
            for c in range(value.shape[1])
        ]
        return np.stack(parts, -1)
    edges = np.linspace(-1, 1, side + 1)
    out = np.zeros((side,) * 3 + (value.shape[1],))
    for mid, weight, reach in zip(positions.numpy(), value.numpy(), radius.tolist(), strict=True):
        parts = [np.diff(share_below(edges, mid[axis], reach)) for axis in (2, 1, 0)]
        held = tuple(slice(part.nonzero()[0][0], part.nonzero()[0][-1] + 1) for part in parts)
        z, y, x = (part[some] for part, some in zip(parts, held, strict=True))
        out[held] += z[:, None, None, None] * y[:, None, None] * x[:, None] * weight
    return out


def prepared(
    branching: int = 2, side: int = 64, wide: bool = False, **options
) -> tuple[gv.PointProducer, Layout]:
    positions, value = some_points()
    radius = some_radii() if wide else None
    arguments = {"radius": radius, "box": BOX, "branching": branching, **options}
    producer = gv.PointProducer(positions, value, side, **arguments)
    layout = Layout.of(producer, 4, 1, CPU)
    producer.prepare(layout)
    return producer, layout


def all_nodes(layout: Layout, depth: int) -> gv.Nodes:
    along = torch.arange(layout.branching**depth)
    loc = torch.cartesian_prod(along, along, along).flip(1)
    return gv.Nodes(torch.cat((loc, torch.full((len(loc), 1), depth)), 1), layout)


@pytest.mark.parametrize(
    "branching, side, wide", [(2, 64, False), (3, 36, False), (2, 64, True), (3, 36, True)]
)
def test_every_level_is_the_dense_sum_and_its_mean(branching, side, wide):
    producer, layout = prepared(branching, side, wide)
    positions, value = some_points()
    radius = some_radii() if wide else None
    finest = dense(positions, value, side, radius)
    total = finest.sum((0, 1, 2))
    assert wide or np.allclose(total, value.sum(0).numpy(), rtol=1e-12), "none is outside"
    for depth in range(layout.depth, -1, -1):
        nodes = all_nodes(layout, depth)
        bricks = producer.fill(nodes)["value"]
        along, n = branching**depth, side // branching ** (layout.depth - depth)
        inner = bricks[:, 1:-1, 1:-1, 1:-1].reshape(along, along, along, 4, 4, 4, 2)
        level = inner.permute(0, 3, 1, 4, 2, 5, 6).reshape(n, n, n, 2)
        assert np.allclose(level, finest, rtol=1e-6, atol=1e-7)
        scale = branching ** (3 * (layout.depth - depth))
        assert np.allclose(level.double().sum((0, 1, 2)) * scale, total, rtol=1e-6)
        wide_level = np.pad(finest, ((1, 1), (1, 1), (1, 1), (0, 0)))
        for row in range(0, len(nodes), 37):
            x, y, z = (4 * nodes.loc[row, :3]).tolist()
            brick = wide_level[z : z + 6, y : y + 6, x : x + 6]
            assert np.allclose(bricks[row], brick, rtol=1e-6, atol=1e-7), "with its border"
        if depth:
            finest = finest.reshape(*(n // branching, branching) * 3, 2).mean((1, 3, 5))


@pytest.mark.parametrize("wide", [False, True])
def test_mass_is_the_same_at_every_level_to_rounding_of_float64(wide):
    place, value = some_points()
    radius = some_radii().clamp(max=0.3) if wide else None
    points = sort_points(Points(place, value, radius=radius), 48)
    for level in range(points.grid.levels):
        side = -(-48 // 2**level)
        held = values(points, Cubes(np.zeros((1, 3), np.int64), side, level))
        total = held.sum((0, 1, 2, 3)) * 8**level
        assert np.allclose(total, value.sum(0).numpy(), rtol=1e-13)


@pytest.mark.parametrize(
    "branching, side, wide", [(2, 64, False), (3, 36, False), (2, 64, True), (3, 36, True)]
)
def test_what_is_proven_holds_for_all_below(branching, side, wide):
    producer, layout = prepared(branching, side, wide)
    levels = {d: producer.fill(all_nodes(layout, d))["value"] for d in range(layout.depth + 1)}
    empty = 0
    for depth in range(layout.depth + 1):
        nodes = all_nodes(layout, depth)
        regions = producer.classify(nodes)
        low, high = regions.ranges["value"].unbind(1)
        for below in range(depth, layout.depth + 1):
            inner = all_nodes(layout, below).loc[:, :3] // branching ** (below - depth)
            along = branching**depth
            owner = inner[:, 0] + inner[:, 1] * along + inner[:, 2] * along**2
            voxels = levels[below].flatten(1, 3)
            assert (voxels >= low[owner][:, None]).all() and (voxels <= high[owner][:, None]).all()
            bare = regions.kind[owner] == gv.Region.EMPTY
            assert not voxels[bare].any()
        empty += int((regions.kind == gv.Region.EMPTY).sum())
    assert empty > 100 or wide  # a point of radius 3 reaches everywhere


def test_empty_regions_are_proven_beside_wide_points_too():
    place, value = some_points()
    producer = gv.PointProducer(place, value - 0.6, 64, box=BOX, radius=some_radii().clamp(max=0.1))
    layout = Layout.of(producer, 4, 1, CPU)
    nodes = all_nodes(layout, layout.depth)
    regions, bricks = producer.classify(nodes), producer.fill(nodes)["value"]
    bare = regions.kind == gv.Region.EMPTY
    assert 100 < int(bare.sum()) < len(nodes) - 100
    assert not bricks[bare].any() and bricks[~bare].flatten(1).any(1).float().mean() > 0.9
    low, high = regions.ranges["value"].unbind(1)
    assert (low < 0).any() and (bricks.amin((1, 2, 3)) >= low).all()
    assert (bricks.amax((1, 2, 3)) <= high).all()


def test_points_that_are_drawn_are_missing_at_the_finest_level_alone():
    (all_, layout), (drawn, _) = prepared(wide=True), prepared(wide=True, drawn=True)
    place, value = some_points()
    broad = some_radii() > 2 / 64
    for depth in range(layout.depth + 1):
        nodes = all_nodes(layout, depth)
        bricks = drawn.fill(nodes)["value"]
        if depth < layout.depth:
            assert torch.equal(bricks, all_.fill(nodes)["value"])
            continue
        only = gv.PointProducer(place[broad], value[broad], 64, box=BOX, radius=some_radii()[broad])
        assert torch.allclose(bricks, only.fill(nodes)["value"], rtol=1e-6, atol=1e-9)
        kind = drawn.classify(nodes).kind
        assert not bricks[kind == gv.Region.EMPTY].any()


@pytest.mark.backend("cpp")
def test_streamed_points_are_the_picture_of_the_dense_volume():
    positions, value = some_points(width=1)
    transfer = gv.TransferFunction.from_points([(0, 0), (3, 0.8)], [(0, 1, 0.5, 0.2), (3, 1, 1, 1)])
    camera = gv.Camera.orbit(20, 30, 1.2, None, 40, 32)
    volume = gv.Volume(
        torch.from_numpy(dense(positions, value, 64)).float(),
        spacing=(2 / 64,) * 3,
        origin=(-1 + 1 / 64,) * 3,
    )
    expected = gv.render(gv.N3Tree.from_volume(volume, 4), camera, transfer)
    producer = gv.PointProducer(positions, value[:, 0], 64, box=BOX)
    with gv.Engine(producer, brick_size=4, brick_pool="300 kB") as engine:
        picture = engine.render(camera, transfer)
        engine.validate()
    assert picture.stats.converged and (expected.alpha > 0.2).any()
    assert torch.allclose(picture.color, expected.color, atol=1e-5)


def test_the_box_is_around_all_points_unless_given():
    positions, value = some_points()
    producer = gv.PointProducer(positions, value)
    held = producer.points.points[0].rows["value"]
    assert max(producer.extent) == 1024 and held.sum() == pytest.approx(float(value.sum()))
    part = gv.PointProducer(positions, value, box=((0, 0, 0), (1, 1, 1)))
    assert 0 < len(part.points) < len(positions), "points outside are left out"
    single = gv.PointProducer(torch.zeros(1, 3))
    assert single.extent == (1024, 1024, 1024) and len(single.points) == 1


def test_sums_that_halves_cannot_hold_are_told_once():
    positions, value = torch.rand(50, 3), torch.full((50,), 1e6)
    view, shader = gv.Camera.orbit(width=8, height=8), gv.TransferFunction.preset("gray", 0, 1e5)
    with gv.Engine(gv.PointProducer(positions, value, 32)) as engine:
        engine.render(view, shader, lod="finest")
    half = gv.PointProducer(positions, value, 32, dtype=torch.float16)
    with pytest.warns(UserWarning, match=r"a voxel's sum, .*float16 holds, 65504") as caught:
        with gv.Engine(half) as engine:
            engine.render(view, shader, lod="finest")
    assert len(caught) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.PointProducer(torch.zeros(0, 3)), r"positions must be (n, 3), n >= 1"),
        (lambda: gv.PointProducer(torch.zeros(4, 2)), r"positions must be (n, 3)"),
        (lambda: gv.PointProducer(torch.full((2, 3), torch.nan)), "positions must be finite"),
        (lambda: gv.Points([["1", "2", "3"]]), "positions must be numbers"),
        (lambda: gv.Points(torch.ones((2, 3)) * 1j), "positions must be numbers"),
        (lambda: gv.Points(np.ma.masked_less(np.eye(3), 1)), "positions must be numbers"),
        (lambda: gv.PointProducer(torch.zeros(2, 3), torch.ones(3)), r"values must be (2,) or"),
        (lambda: gv.PointProducer(torch.zeros(2, 3), torch.ones(2) / 0), "values must be finite"),
        (
            lambda: gv.PointProducer(torch.zeros(2, 3), box=((1, 1, 1), (2, 2, 2))),
            "no point lies in the box",
        ),
        (lambda: gv.PointProducer(torch.zeros(2, 3), dtype=torch.uint8), "dtype must be one of"),
        (
            lambda: gv.Engine(gv.PointProducer(torch.rand(9, 3), extent=2**30)),
            "more voxels than a 64-bit number tells apart",
        ),
    ],
)
def test_bad_points_are_named(call, message):
    with pytest.raises((ValueError, gv.ProductionError)) as caught:
        call()
    assert message in str(caught.value)
