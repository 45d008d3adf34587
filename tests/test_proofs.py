"""Guarantees of all producers of formulas, meshes and points: what is proven empty or full is so in
every voxel, values lie in their ranges, and a level is the mean of the one below it.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable

import pytest
import torch
from helpers import meshes
from helpers.shapes import ALL, BOXES, ball, block, nodes_of, points_inside, random_boxes

import gvtorch as gv
from gvtorch.producers import Layout

sdf = gv.sdf
SOAK = bool(os.environ.get("GVTORCH_SOAK"))
#: Producers of which too little is proven in larger nodes.
INTRICATE = {"sampled", "julia", "gyroid", "bulb", "bulb of 3", "mandelbox"}


def whole_depth(name: str) -> int:
    """Returns the depth in bricks of 2^3 of the voxels that are all compared: of 32^3, 64^3 or, at
    the finest, 128^3 of them.
    """
    return 6 if SOAK else 5 if name in INTRICATE else 4


BOX = ((-1.1,) * 3, (1.1,) * 3)
ROUGH = {"thickness": 0.15, "frequency": 3.0, "octaves": 4, "softness": 0.1, "box": BOX}


def sampled():
    """Returns the sampled distance to a ball."""
    axis = torch.linspace(-1, 1, 41)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    away = torch.stack((x, y, z), -1).norm(dim=-1) - 0.7
    return gv.SampledDistance(gv.Volume(away, spacing=(0.05,) * 3, origin=(-1.0,) * 3))


class Stripes(torch.nn.Module):
    """A plain module: colours without bounds."""

    def forward(self, points):
        return 0.5 + 0.5 * (9 * points).sin()


class Sway(torch.nn.Module):
    """A displacement of at most 0.1."""

    def forward(self, points):
        return 0.05 * (7 * points.roll(1, -1)).sin()


def scattered():
    """Returns points of all sizes, from 0 to many voxels, in clumps."""
    random = torch.Generator().manual_seed(3)
    positions = 0.25 * torch.randn((500, 3), generator=random).double().clamp(-3, 3)
    sizes = torch.tensor([0.0, 0.005, 0.02, 0.1], dtype=torch.float64)
    radius = sizes[torch.randint(0, 4, (500,), generator=random)]
    return gv.PointProducer(positions, 0.1 + radius, 128, radius=radius, box=BOX)


def of_field(field, **options):
    return lambda: gv.FieldProducer(field(), 128, **{"box": BOX, **options})


#: Producers of 128^3 voxels around the origin, by name; those of other shapes are `ALL`.
PRODUCERS = {
    "hypertexture": lambda: gv.Hypertexture(ball(), 128, dtype=torch.float32, **ROUGH),
    "hypertexture and distance": lambda: gv.Hypertexture(
        block(), 128, dtype=torch.float32, distances=True, **ROUGH
    ),
    "fur": of_field(lambda: gv.Fur(ball(), length=0.2, frequency=9.0, fall=(0.1, -0.5, 0.2))),
    "sampled": of_field(sampled),
    "density": of_field(lambda: gv.Solid(ball() - block(), colors=False)),
    "differences": of_field(lambda: gv.Solid(ball() | block(), differences=True)),
    "painted": of_field(lambda: gv.Painted(sdf.SmoothUnion(ball(), block(), 0.2), Stripes())),
    "warped": of_field(
        lambda: gv.warp(gv.Solid(ball(), colors=False), Sway(), max_offset=0.1), threshold=0.0
    ),
    "masked": of_field(lambda: gv.mask(Stripes(), gv.Solid(ball(), colors=False)), threshold=0.0),
    "blended": of_field(
        lambda: gv.blend(
            gv.Fur(ball(), length=0.2, frequency=9.0),
            gv.Fur(block(), length=0.1, frequency=20.0),
            gv.Solid(sdf.Plane(), colors=False),
        ),
        threshold=0.0,
    ),
    "stacked": of_field(
        lambda: gv.stack(a=gv.Solid(ball()), b=gv.Solid(block(), colors=False)), threshold=0.0
    ),
    "mesh": lambda: gv.MeshProducer(meshes.torus(1.0, 0.4, (48, 24)), resolution=128),
    "distances to a mesh": lambda: gv.MeshProducer(
        meshes.joined(meshes.torus(1.0, 0.4, (48, 24)), meshes.sheet(3, 1.3)),
        resolution=128,
        channels=("coverage", "distance"),
    ),
    "points": scattered,
    "julia": lambda: gv.FieldProducer(gv.Julia((-0.2, 0.5, 0.3), 2, iterations=9), 128),
    **{
        name: of_field(make, **({"box": ((-7.0,) * 3, (7.0,) * 3)} if name == "mandelbox" else {}))
        for name, (make, _) in ALL.items()
    },
}


@pytest.fixture(params=PRODUCERS)
def name(request):
    return request.param


@functools.cache
def made(name: str) -> gv.Producer:
    """Returns one producer for all tests, each of which prepares it anew."""
    return PRODUCERS[name]()


def voxels(producer, nodes):
    answer = producer.fill(nodes)
    return answer.data if isinstance(answer, gv.Bricks) else answer


def shown_by(producer) -> dict[str, float]:
    """Returns by visible channel the value up to which it shows nothing."""
    if isinstance(producer, gv.FieldProducer):
        return producer.threshold or {}
    return {name: 0.0 for name in ("density", "coverage", "value") if name in producer.channels}


def check_proofs(producer, regions, ends) -> None:
    """Checks the regions of nodes against the least and the largest voxel in their reach, two
    (k, c) by channel.
    """
    kind, visible = regions.kind, shown_by(producer)
    assert visible or not (kind == gv.Region.EMPTY).any()
    for channel, (least, greatest) in ends.items():
        if channel in visible:
            assert (greatest <= visible[channel])[kind == gv.Region.EMPTY].all(), channel
        if channel in regions.constants:
            same = (least == regions.constants[channel]) & (greatest == regions.constants[channel])
            assert same[kind == gv.Region.CONSTANT].all(), channel
        else:
            assert not (kind == gv.Region.CONSTANT).any()
        if channel in regions.ranges:
            low, high = regions.ranges[channel].unbind(1)
            assert (least >= low).all() and (greatest <= high).all(), channel


def halved(cells: torch.Tensor, of: Callable, reach: bool) -> torch.Tensor:
    """Returns the least or the largest of 2^3 cells (z, y, x, c), or of the 4^3 in reach of a brick
    of two cells and a border of 1; cells beyond the level are ignored.
    """
    for axis in range(3):
        first, last = cells.narrow(axis, 0, 1), cells.narrow(axis, -1, 1)
        every = [slice(None)] * axis
        pair = of(cells[(*every, slice(0, None, 2))], cells[(*every, slice(1, None, 2))])
        if reach:
            before, after = torch.cat((first, cells), axis), torch.cat((cells, last), axis)
            pair = of(pair, before[(*every, slice(0, -1, 2))])
            pair = of(pair, after[(*every, slice(2, None, 2))])
        cells = pair
    return cells


def each(ends, reach: bool):
    """Returns the least of the least cells, and the largest of the largest."""
    return halved(ends[0], torch.minimum, reach), halved(ends[1], torch.maximum, reach)


def whole_level(producer, depth: int, brick_size: int) -> dict[str, torch.Tensor]:
    """Returns by channel (z, y, x, c) all voxels of a level, made in bricks of a size."""
    producer.prepare(Layout.of(producer, brick_size, 1, torch.device("cpu")))
    nodes, n = nodes_of(producer, depth, brick_size=brick_size), 2**depth
    level = {}
    for channel, bricks in voxels(producer, nodes).items():
        inner = bricks[:, 1:-1, 1:-1, 1:-1].unflatten(0, (n, n, n))
        level[channel] = inner.permute(0, 3, 1, 4, 2, 5, 6).reshape(*(n * brick_size,) * 3, -1)
    return level


def test_no_voxel_is_dropped(name):
    """Brute force: all nodes of all depths to `whole_depth`, in bricks of 2^3, against all voxels
    of that level in reach. EMPTY and CONSTANT hold for every voxel, every value is in its range.
    """
    producer, finest = made(name), whole_depth(name)
    levels, region_counts = whole_level(producer, finest - 3, 16), dict.fromkeys(gv.Region, 0)
    cells = {channel: (level, level) for channel, level in levels.items()}
    producer.prepare(Layout.of(producer, 2, 1, torch.device("cpu")))
    for depth in range(finest, -1, -1):
        regions = producer.classify(nodes_of(producer, depth, brick_size=2))
        ends = {n: each(t, reach=True) for n, t in cells.items()}
        check_proofs(
            producer, regions, {n: (a.flatten(0, 2), b.flatten(0, 2)) for n, (a, b) in ends.items()}
        )
        cells = {n: each(t, reach=False) for n, t in cells.items()}
        for region in gv.Region:
            region_counts[region] += int((regions.kind == region).sum())
    least = 0.0001 if name == "mandelbox" else 0.08
    proven = region_counts[gv.Region.CONSTANT if name == "distances to a mesh" else gv.Region.EMPTY]
    assert proven > least * sum(region_counts.values())


def test_no_brick_is_dropped(name):
    """As above, against the nodes' own bricks, which are coarser at depth 3: all of this depth and
    1024 of depth 6; all of them with GVTORCH_SOAK=1.
    """
    producer, random = made(name), torch.Generator().manual_seed(6)
    producer.prepare(Layout.of(producer, 2, 1, torch.device("cpu")))
    for depth, max_nodes in ((3, 1 << 9), (6, 1 << (18 if SOAK else 10))):
        nodes = nodes_of(producer, depth, brick_size=2)
        nodes = nodes[torch.randperm(len(nodes), generator=random)[:max_nodes].sort().values]
        for rows in torch.arange(len(nodes)).split(50_000):
            channels = voxels(producer, nodes[rows]).items()
            ends = {channel: bricks.flatten(1, 3).aminmax(dim=1) for channel, bricks in channels}
            check_proofs(producer, producer.classify(nodes[rows]), ends)


@pytest.mark.parametrize("octaves", [1, 4])
def test_noise_passes_no_proof_in_random_boxes(octaves):
    """`BOXES` nodes of all levels, two thirds of them near the limit at which they are proven EMPTY
    or CONSTANT: 32 values of each by the formula.
    """
    rough = {**ROUGH, "frequency": 60.0, "octaves": octaves, "dtype": torch.float32}
    producer, random = gv.Hypertexture(ball(), 2**12, **rough), torch.Generator().manual_seed(9)
    layout = Layout.of(producer, 8, 1, torch.device("cpu"))
    producer.prepare(layout)
    finest = producer.level_of(layout.depth)
    worn = finest.remaining[0] + finest.half_width
    begins = [0.7 + producer.thickness * gap for gap in (worn - 0.5, -worn - 0.5)]
    depth = torch.randint(2, layout.depth + 1, (BOXES, 1), generator=random)
    side = layout.spacing[0] * 8 * 2.0 ** (layout.depth - depth)
    away = 1.2 * torch.rand((BOXES, 1), generator=random).double()
    for third, begin in enumerate(begins):
        away[third::3] = begin + 2 * side[third::3] * (away[third::3] - 0.6)
    unit = torch.nn.functional.normalize(torch.randn((BOXES, 3), generator=random).double(), dim=1)
    position = ((unit * away - layout.origin_3) / side).floor().long().clamp(min=0)
    nodes = gv.Nodes(torch.cat((position.minimum(2**depth - 1), depth), 1), layout)
    kind = producer.classify(nodes).kind
    half = nodes.voxel_size * (0.5 * layout.brick_size + layout.border - 0.5)
    for region, value in ((gv.Region.EMPTY, 0.0), (gv.Region.CONSTANT, 1.0)):
        rows = (kind == region).nonzero()[:, 0]
        points = points_inside(nodes.center[rows], half[rows], 32)
        assert (producer.at(points)["density"] == value).all() and len(rows) > BOXES / 20


NOT_FIELDS = {*ALL, "mesh", "distances to a mesh", "points"}


@pytest.mark.parametrize("name", [name for name in PRODUCERS if name not in NOT_FIELDS])
def test_intervals_of_fields_hold_in_random_boxes(name):
    """Many boxes, 12 values of each; for prefiltered fields, with voxels of any size."""
    producer = made(name)
    center, half = random_boxes(BOXES if SOAK else BOXES // 3)
    random = torch.Generator().manual_seed(8)
    size = (10 ** (-3 * torch.rand(len(center), 1, generator=random).double())).expand(-1, 3)
    if isinstance(producer, gv.Hypertexture):
        low, high = producer.shape.bounds(center, half)
        value = producer.shape(points_inside(center, half, 12))
        assert (value >= low[:, None]).all() and (value <= high[:, None]).all()
        return
    field, bounds = producer.field, producer.field.filtered_bounds(center, half, size)
    for rows in torch.arange(len(center)).split(20_000):
        points = points_inside(center[rows], half[rows], 12)
        sides = size[rows, None].expand_as(points)
        values = field.filtered(points, sides) if field.prefiltered else field(points)
        by_name = values if isinstance(values, dict) else {"value": values}
        ends = bounds if isinstance(bounds, dict) else {"value": bounds}
        for channel, interval in ends.items():
            if channel != "normal":  # `finish` computes them from distances
                low, high = (end[rows].view(len(rows), 1, -1) for end in interval)
                value = by_name[channel].view(len(rows), 12, -1)
                assert (value >= low - 1e-9).all() and (value <= high + 1e-9).all(), channel


def test_a_level_is_the_mean_of_the_one_below(name):
    """As far as filters can predict details below a voxel: to a tenth of a level's variation, at
    the root to a third. The Mandelbox is dust at every scale: a third everywhere. Of the level of
    4^3 nodes every fifth; all, and a finer level, with GVTORCH_SOAK=1.
    """
    error = 0.3 if name == "mandelbox" else 0.03
    producer = made(name)
    producer.prepare(Layout.of(producer, 8, 1, torch.device("cpu")))
    for depth in (3, 2, 1, 0) if SOAK else (2, 1, 0):
        chosen = slice(None, None, 5 if depth == 2 and not SOAK else 1)
        nodes = nodes_of(producer, depth, brick_size=8, border=0)[chosen]
        below = nodes_of(producer, depth + 1, brick_size=8, border=0)
        count = 2**depth
        number = torch.arange(len(below)).view(*(count, 2) * 3).permute(0, 2, 4, 1, 3, 5)
        children = number.reshape(-1, 8)[chosen].flatten()
        fine = voxels(producer, below[children])
        for channel, bricks in voxels(producer, nodes).items():
            if channel.endswith("normal"):  # a unit direction is not a mean
                continue
            # 2^3 bricks of 4^3 cells of 2^3 voxels
            cells = fine[channel].float().view(len(nodes), 2, 2, 2, 4, 2, 4, 2, 4, 2, -1)
            mean = cells.mean((5, 7, 9)).permute(0, 1, 4, 2, 5, 3, 6, 7).reshape(bricks.shape)
            difference = (bricks.float() - mean).abs()
            assert difference.mean() < (error + 0.3 / count) * mean.std(), channel
