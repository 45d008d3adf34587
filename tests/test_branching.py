"""Producers of every kind in trees of any N: the finest voxels do not depend on N, coarse ones are
their means, and what `classify` states of regions is true.
"""

from __future__ import annotations

import functools

import pytest
import torch
from helpers import meshes
from helpers.pictures import GRAY, camera

import gvtorch as gv
from gvtorch.producers.producer import Layout, Producer, wait_for

BOX = ((-1, -1, -1), (1, 1, 1))
EXTENT = 36  # bricks of 4: trees 4, 2 and 2 levels deep


def waves(points):
    return 0.5 + 0.4 * (3 * points[..., 0]).sin() * (2 * points[..., 1]).cos() + 0 * points[..., 2]


class Waves(torch.nn.Module):
    def forward(self, points):
        return waves(points)


class Ball(gv.Producer):
    """A user-defined producer."""

    def __init__(self, branching):
        super().__init__(EXTENT, box=BOX, branching=branching)

    def fill(self, nodes):
        return {"value": waves(nodes.positions)}


def field(branching, formula=None):
    return gv.FieldProducer(formula or Waves(), EXTENT, box=BOX, samples=2, branching=branching)


def scan():
    values = torch.rand((EXTENT,) * 3, generator=torch.Generator().manual_seed(1))
    values[:, :20, :9] = 0
    return gv.Volume(values, spacing=(2 / EXTENT,) * 3, origin=(-1 + 1 / EXTENT,) * 3)


def points(branching):
    random = torch.Generator().manual_seed(2)
    positions = 1.8 * torch.rand(100, 3, generator=random) - 0.9
    options = {"radius": 0.1, "box": BOX, "branching": branching}
    return gv.PointProducer(positions, torch.full((100,), 20.0), EXTENT, **options)


def octaves(branching):
    total = gv.noise.OctaveSum(frequency=2, octaves=5, settled=32)
    return gv.OctaveProducer(total, EXTENT, box=BOX, branching=branching)


def rough(branching):
    options = {"thickness": 0.4, "amplitude": 0.5, "softness": 0.3, "dtype": torch.float32}
    return gv.Hypertexture(gv.sdf.Sphere(0.6), EXTENT, box=BOX, **options, branching=branching)


def solid(branching):
    return gv.FieldProducer(
        gv.Solid(gv.sdf.Sphere(0.7), colors=False), EXTENT, box=BOX, branching=branching
    )


def mesh(branching):
    channels = ("coverage", "distance")
    return gv.MeshProducer(
        meshes.torus(0.7, 0.25), resolution=EXTENT, channels=channels, branching=branching
    )


#: Kind: how it is made, and how far voxels above the finest level may be from their means.
KINDS = {
    "own": (Ball, None),
    "field": (field, 0.02),
    "solid": (solid, 0.1),
    "volume": (lambda n: gv.VolumeProducer(scan(), threshold=0.0, branching=n), 1e-6),
    "bricks": (lambda n: gv.VolumeProducer(scan(), hold="bricks", branching=n), 1e-6),
    "mapped": (lambda n: gv.VolumeProducer(scan(), hold="mapped", branching=n), 1e-6),
    "points": (points, 1e-4),
    "octaves": (octaves, None),
    "hypertexture": (rough, 0.15),
    "mesh": (mesh, 0.05),
    "joined": (lambda n: gv.JoinedProducer({"a": field(n), "b": field(n)}), 0.02),
    "from children": (lambda n: gv.FromChildren(Ball(n)), 1e-6),
}


def layout_of(producer: Producer) -> Layout:
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    producer.prepare(layout)
    return layout


def places(layout: Layout, depth: int) -> torch.Tensor:
    """Returns the locs (k, 4) of all nodes of a level within the extent, in the order z, y, x."""
    step = layout.brick_size * layout.branching ** (layout.depth - depth)
    z, y, x = (torch.arange(-(-n // step)) for n in layout.extent[::-1])
    zyx = torch.cartesian_prod(z, y, x)
    return torch.cat((zyx.flip(1), torch.full_like(zyx[:, :1], depth)), 1)


def level(producer: Producer, layout: Layout, depth: int) -> dict[str, torch.Tensor]:
    """Returns by channel (z, y, x, c) all voxels of a level within the extent."""
    loc = places(layout, depth)
    z, y, x = (loc[:, :3].amax(0) + 1).flip(0).tolist()
    scale = layout.branching ** (layout.depth - depth)
    kept = [slice(0, -(-n // scale)) for n in layout.extent[::-1]]
    channels = {}
    for name, bricks in producer.bricks_at(loc, layout).items():
        inner = bricks[:, 1:-1, 1:-1, 1:-1].double()
        whole = inner.view(z, y, x, 4, 4, 4, -1).permute(0, 3, 1, 4, 2, 5, 6)
        channels[name] = whole.reshape(4 * z, 4 * y, 4 * x, -1)[kept[0], kept[1], kept[2]]
    return channels


def means(values: torch.Tensor, n: int) -> torch.Tensor:
    """Returns the means of cubes of n^3 voxels, of complete cubes only."""
    z, y, x = (size // n for size in values.shape[:3])
    cubes = values[: z * n, : y * n, : x * n].reshape(z, n, y, n, x, n, -1)
    return cubes.mean((1, 3, 5))


@functools.cache
def finest(kind: str, branching: int) -> tuple[Producer, Layout, dict[str, torch.Tensor]]:
    """Returns a producer, its layout, and all voxels of its finest level."""
    producer = KINDS[kind][0](branching)
    layout = layout_of(producer)
    return producer, layout, level(producer, layout, layout.depth)


@pytest.mark.parametrize("branching", [2, 3, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_voxels_are_right_in_trees_of_any_n(kind, branching):
    tolerance = KINDS[kind][1]
    producer, layout, fine = finest(kind, branching)
    assert producer.branching == branching and layout.depth == (4 if branching == 2 else 2)
    scale = {"coverage": 255.0, "distance": 2.0}
    for name, values in fine.items():
        if name != "inherited":
            torch.testing.assert_close(values, finest(kind, 2)[2][name], atol=1e-4, rtol=0)
            assert values.std() > 0.05 * scale.get(name, 1)
    for up in range(1, layout.depth if tolerance else 0):
        for name, values in level(producer, layout, layout.depth - up).items():
            mean = means(fine[name], branching**up)
            z, y, x = (slice(0, size) for size in mean.shape[:3])
            error = (values[z, y, x] - mean).abs().max() / scale.get(name, 1)
            assert error <= (tolerance if up == 1 or tolerance < 1e-3 else 0.2), (name, up)


@pytest.mark.parametrize("branching", [2, 3, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_regions_hold_in_trees_of_any_n(kind, branching):
    """What `classify` states of a node is true of all finest voxels in it."""
    producer, layout, fine = finest(kind, branching)
    for depth in range(layout.depth + 1):
        loc = places(layout, depth)
        regions = wait_for(producer.classify(gv.Nodes(loc, layout)))
        regions = regions if isinstance(regions, gv.Regions) else gv.Regions(kind=regions)
        side = layout.brick_size * branching ** (layout.depth - depth)
        for row in (regions.kind <= gv.Region.CONSTANT).nonzero()[:, 0].tolist():
            x, y, z = (slice(n * side, (n + 1) * side) for n in loc[row, :3].tolist())
            for name, values in fine.items():
                inside = values[z, y, x].flatten(0, 2)
                assert (inside == inside[0]).all(), (name, depth)
        for name, ends in regions.ranges.items():
            for row, (low, high) in enumerate(ends.double()):
                x, y, z = (slice(n * side, (n + 1) * side) for n in loc[row, :3].tolist())
                inside = fine[name][z, y, x].flatten(0, 2)
                assert (inside >= low).all() and (inside <= high).all(), (name, depth)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("kind", ["volume", "mesh", "hypertexture", "octaves"])
def test_the_picture_is_that_of_any_other_n(kind):
    seen, transfer = [], gv.TransferFunction.preset("gray", 0, 255) if kind == "mesh" else GRAY
    for branching in (2, 3, 4):
        with gv.Engine(KINDS[kind][0](branching), brick_size=4) as engine:
            picture = engine.render(camera(24), transfer, lod="finest")
            engine.validate()
        assert picture.stats.converged and picture.alpha.max() > 0.3
        seen.append(picture.color)
    for other in seen[1:]:
        torch.testing.assert_close(other, seen[0], atol=2e-4, rtol=0)


def test_sums_of_splines_halve_their_voxels():
    message = "OctaveProducer: branching must be 2 for a SplineSum, got 3"
    with pytest.raises(ValueError, match=f"^{message}$"):
        gv.OctaveProducer(gv.noise.SplineSum(), 64, branching=3)
