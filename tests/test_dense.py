"""Voxels of every kind of producer, level by level, against means of 16^3 points in each voxel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from helpers import meshes
from helpers.points import share_below
from helpers.shapes import nodes_of
from torch import Tensor

import gvtorch as gv
from gvtorch.producers import Layout

sdf, noise = gv.sdf, gv.noise
SIDE, BOX = 64, ((-1.1,) * 3, (1.1,) * 3)
FINEST = 2.2 / SIDE
COUNT = 200  # voxels of a level
PLACES = 16  # along each axis, in a voxel
#: Largest difference between the share of 16^3 points behind a plane and the exact volume: half a
#: layer, if the plane is parallel to the layers.
COUNTED = 0.5 / PLACES
#: `Solid` treats the surface as a plane across an axis; this is its error in other directions.
PLANE = 0.09
RADIUS = 0.7


class Voxels(NamedTuple):
    """Some voxels of a level."""

    low: Tensor  # (k, 3) float64 world corners
    side: float
    producer: gv.Producer

    @property
    def positions(self) -> Tensor:
        """(k, 16^3, 3) points spread over them."""
        offsets = (torch.arange(PLACES, dtype=torch.float64) + 0.5) / PLACES
        return self.low[:, None] + self.side * torch.cartesian_prod(offsets, offsets, offsets)

    @property
    def middle(self) -> Tensor:
        return self.low + 0.5 * self.side


class Case(NamedTuple):
    """A producer, an independent reference of its voxels, and bounds by a voxel's side: the largest
    error, and the root mean square error.
    """

    make: Callable[[], gv.Producer]
    dense: Callable[[Voxels], dict[str, Tensor]]
    bounds: Callable[[float], dict[str, tuple[float, float]]]


def both(max_error: float, share: float) -> tuple[float, float]:
    """Returns the largest error, and a share of it as the root mean square error."""
    return max_error, share * max_error


def means(voxels: Voxels) -> dict[str, Tensor]:
    """Returns the means of the producer's unfiltered values at the points."""
    by_channel = voxels.producer.at(voxels.positions)
    return {name: values.double().mean(1) for name, values in by_channel.items()}


class Stripes(torch.nn.Module):
    """Colours (1 + sin 9x) / 2 of each coordinate; second derivatives of at most `BENT`."""

    def forward(self, points):
        return 0.5 + 0.5 * (9 * points).sin()


STEEP, BENT = 0.5 * 9, 0.5 * 9**2


def field(make: Callable[[], torch.nn.Module]) -> Callable[[], gv.Producer]:
    return lambda: gv.FieldProducer(make(), SIDE, box=BOX)


def solid(shape: Callable[[], gv.fields.Distance], bent: float) -> Case:
    """Returns the case of a surface whose curvature is at most `bent`: in a voxel it leaves its
    plane by at most bent / 2 (half the diagonal)^2, on average over a square by bent / 12 side^2.
    """

    def bounds(side):
        curved = bent * side
        return {"density": (PLANE + curved * 3 / 8 + COUNTED, PLANE / 2 + curved / 12)}

    return Case(field(lambda: gv.Solid(shape(), colors=False)), means, bounds)


def painted_means(voxels: Voxels) -> dict[str, Tensor]:
    """As `means`, with the ball's normals in closed form, where visible voxels have any."""
    away = voxels.middle.norm(dim=1, keepdim=True)
    depth = (RADIUS - away) / voxels.side
    normal = torch.where((depth > -0.5) & (depth < 3.9), 127 * voxels.middle / away, math.nan)
    return {**means(voxels), "normal": normal}


def painted_bounds(side: float) -> dict[str, tuple[float, float]]:
    """Bounds for colours that are evaluated only in the middle of a voxel."""
    alpha, rms = solid(sdf.Sphere, 1 / RADIUS).bounds(side)["density"]
    return {
        "rgba": (alpha + STEEP * side / 2, rms + STEEP * side / 12**0.5),
        "normal": (0.51, 0.4),
    }


ROUGH = {"thickness": 0.15, "frequency": 3.0, "octaves": 4, "softness": 0.1}


def rough() -> gv.Producer:
    return gv.Hypertexture(sdf.Sphere(RADIUS), SIDE, dtype=torch.float32, box=BOX, **ROUGH)


def variances(octaves, side: float):
    """Yields for each octave: variance of its noise, share of it in means, and cells a voxel."""
    for octave in octaves:
        share = math.exp(-noise.MEAN_DECAY * (side * octave.frequency) ** 2)
        yield octave.amplitude**2 * noise.VARIANCE, share, side * octave.frequency


def rough_bounds(side: float) -> dict[str, tuple[float, float]]:
    """In s, each octave is its value in the middle times its share, instead of its mean: they
    differ by a variance of at most 2 share^2 (1 - share), or share^2 if the octave is left out. The
    mean distance is larger by side^2 / 12 radii. The slope of the step from 0 to 1, over its half
    width, has a root mean square of 0.55; a step and a ramp of equal variance differ by 0.036.
    """
    spread = soft = 0.0
    for variance, share, cells in variances(rough().octaves, side):
        taken = cells <= 1.5
        spread += variance * share**2 * (2 * (1 - share) if taken else 1)
        soft += variance * (1 - share**2 * taken)
    soft = math.sqrt(
        5 * (soft + ROUGH["softness"] ** 2 / 5 + (side / ROUGH["thickness"]) ** 2 / 12)
    )
    spread += (side**2 / (12 * RADIUS * ROUGH["thickness"])) ** 2
    rms = 0.55 / soft * math.sqrt(spread) + 0.036
    return {"density": (4 * rms, rms)}


SUM = noise.OctaveSum(frequency=1.5, octaves=6, gain=0.6)


def octave_means(voxels: Voxels) -> dict[str, Tensor]:
    """Returns means of all octaves at every level; cells begin at the low corner of the box."""
    points = (voxels.positions - torch.tensor(BOX[0])) * 1.5
    return {"value": noise.fbm(points, octaves=6, gain=0.6).mean(1, keepdim=True)}


def octave_bounds(side: float) -> dict[str, tuple[float, float]]:
    """Octaves of a level have the variance of their values in the middle, means have less: they
    differ by at most the difference; for octaves not in the level, by the variance of the means.
    """
    total = 0.0
    for variance, share, cells in variances(SUM.octaves, side):
        total += variance * (1 - share**2 if cells <= 0.5 else share**2)
    return {"value": (5 * math.sqrt(total), 1.35 * math.sqrt(total))}


TURN = torch.linalg.qr(torch.randn((3, 3), generator=torch.Generator().manual_seed(4)).double()).Q
HALF = torch.tensor([0.9, 0.5, 0.3], dtype=torch.float64)


def turned_box(channel: str) -> Callable[[], gv.Producer]:
    corners = torch.from_numpy(meshes.box(tuple(-HALF), tuple(HALF)).corners) @ TURN
    return lambda: gv.MeshProducer(
        meshes.of_corners(corners.numpy()), resolution=SIDE, channels=(channel,)
    )


def box_means(voxels: Voxels) -> dict[str, Tensor]:
    """Returns coverage by the planes of the box, or distance by its nearest point."""
    producer = voxels.producer
    q = (voxels.positions @ TURN.T).abs() - HALF
    if "coverage" in producer.channels:
        return {"coverage": 255 * (q.amax(-1) < 0).double().mean(1, keepdim=True)}
    distance = q.clamp(min=0).norm(dim=-1) + q.amax(-1).clamp(max=0)
    band = producer.voxelizer.band
    return {"distance": distance.clamp(-band, band).mean(1, keepdim=True)}


def box_distance_bounds(side: float) -> dict[str, tuple[float, float]]:
    """Distances change by at most 1 per unit, so the mean over a cube is within 0.48 sides of the
    value in its middle; above the finest level, 2^3 middles are averaged.
    """
    max_error = 0.48 * side / (2 if side > 1.01 * turned_box("coverage")().spacing[0] else 1)
    return {"distance": both(max_error, 0.25)}


def scattered() -> tuple[Tensor, Tensor, Tensor]:
    """Returns positions, values and radii of points."""
    random = torch.Generator().manual_seed(3)
    positions = 0.3 * torch.randn((300, 3), generator=random).double().clamp(-3, 3)
    sizes = torch.tensor([0.0, 0.01, 0.04, 0.1], dtype=torch.float64)
    radius = sizes[torch.randint(0, 4, (300,), generator=random)]
    return positions, torch.rand((300, 2), generator=random).double() - 0.3, radius


def point_sums(voxels: Voxels) -> dict[str, Tensor]:
    """Returns sums of points, by the share of each point along each axis."""
    low = voxels.low.numpy()
    total = np.zeros((len(low), 2))
    for position, value, reach in zip(*(t.numpy() for t in scattered()), strict=True):
        ends = (share_below(low + side, position, float(reach)) for side in (voxels.side, 0.0))
        total += (next(ends) - next(ends)).prod(1, keepdims=True) * value
    return {"value": torch.from_numpy(total) * (FINEST / voxels.side) ** 3}


def random_volume() -> gv.Volume:
    values = torch.rand((SIDE,) * 3, generator=torch.Generator().manual_seed(2)) ** 4
    grid = field(Stripes)()
    return gv.Volume(values, grid.spacing, grid.origin)


def volume_means(voxels: Voxels) -> dict[str, Tensor]:
    """Returns the means of the finest voxels in each."""
    values, n = random_volume().data.double().view((SIDE,) * 3), round(voxels.side / FINEST)
    first = ((voxels.low - BOX[0][0]) / FINEST).round().long()
    x, y, z = (first[:, axis, None] + torch.arange(n) for axis in range(3))
    held = values[z[:, :, None, None], y[:, None, :, None], x[:, None, None, :]]
    return {"value": held.flatten(1).mean(1, keepdim=True)}


#: Channels of a joined producer, and the case each one comes from.
PARTS = {"ball": "ball", "volume": "volume", "rough": "hypertexture"}


def joined() -> gv.Producer:
    return gv.JoinedProducer({name: CASES[case].make() for name, case in PARTS.items()})


def joined_means(voxels: Voxels) -> dict[str, Tensor]:
    by_channel = {}
    for name, case in PARTS.items():
        own_voxels = voxels._replace(producer=voxels.producer.producers[name])
        (by_channel[name],) = CASES[case].dense(own_voxels).values()
    return by_channel


def joined_bounds(side: float) -> dict[str, tuple[float, float]]:
    return {name: next(iter(CASES[case].bounds(side).values())) for name, case in PARTS.items()}


CASES = {
    "ball": solid(lambda: sdf.Sphere(RADIUS), 1 / RADIUS),
    "torus": solid(lambda: sdf.Torus(0.6, 0.25), 1 / 0.25),
    # Its values are not distances; their slope changes by at most 2^2 / 0.7 of itself per unit.
    "flattened": solid(
        lambda: sdf.Transform(
            sdf.Sphere(RADIUS), ((1, 0, 0), (0, 1, 0), (0, 0, 0.5)), (0.1, 0.0, 0.1)
        ),
        2**2 / RADIUS,
    ),
    "painted": Case(
        field(lambda: gv.Solid(gv.Painted(sdf.Sphere(RADIUS), Stripes()), differences=False)),
        painted_means,
        painted_bounds,
    ),
    # Two points along an axis: the midpoint rule's error on halves, plus that of 16 points.
    "module": Case(
        field(Stripes),
        means,
        lambda side: {"value": both(BENT * side**2 / 24 * (1 / 4 + 1 / 256) + 1e-6, 0.75)},
    ),
    "hypertexture": Case(rough, means, rough_bounds),
    "octaves": Case(lambda: gv.OctaveProducer(SUM, SIDE, box=BOX), octave_means, octave_bounds),
    # Shares are exact, but rounded to multiples of 1 / 255.
    "mesh": Case(
        turned_box("coverage"), box_means, lambda side: {"coverage": (0.5 + 255 * COUNTED, 1.0)}
    ),
    "distances to a mesh": Case(turned_box("distance"), box_means, box_distance_bounds),
    "points": Case(
        lambda: gv.PointProducer(*scattered()[:2], SIDE, radius=scattered()[2], box=BOX),
        point_sums,
        lambda side: {"value": (3e-8, 5e-9)},
    ),
    "volume": Case(
        lambda: gv.VolumeProducer(random_volume()),
        volume_means,
        lambda side: {"value": (1e-6, 1e-7)},
    ),
    "joined": Case(joined, joined_means, joined_bounds),
}


def held(producer: gv.Producer, nodes: gv.Nodes, positions: Tensor) -> dict[str, Tensor]:
    """Returns by channel (k, c): the voxel at `positions` (k, 3), z y x, of each node."""
    answer = producer.classify(nodes)
    regions = answer if isinstance(answer, gv.Regions) else gv.Regions(kind=answer)
    rows, (z, y, x) = torch.arange(len(nodes)), (positions + nodes.layout.border).unbind(1)
    by_channel = {}
    for name, bricks in producer.bricks_at(nodes.loc, nodes.layout).items():
        values = bricks[rows, z, y, x].double()
        constant = regions.constants.get(name, torch.zeros(1, 1)).double()
        is_constant = (regions.kind == gv.Region.CONSTANT)[:, None]
        values = torch.where(is_constant, constant, values)
        by_channel[name] = values * (regions.kind != gv.Region.EMPTY)[:, None]
    return by_channel


@pytest.mark.parametrize("name", CASES)
def test_every_level_is_the_mean_of_the_formula(name):
    """Random voxels, three quarters of them in nodes with more than one value: the largest error,
    and the root mean square, over the number of voxels between the least and the largest value.
    """
    case, random = CASES[name], torch.Generator().manual_seed(1)
    producer = case.make()
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    producer.prepare(layout)
    for depth in range(layout.depth + 1):
        nodes = nodes_of(producer, depth)
        regions = producer.classify(nodes)
        kind = regions.kind if isinstance(regions, gv.Regions) else regions
        some = (kind == gv.Region.DATA).nonzero()[:, 0]
        rows = some[torch.randint(len(some), (COUNT,), generator=random)]
        rows[::4] = torch.randint(len(nodes), (COUNT // 4,), generator=random)
        nodes, positions = nodes[rows], torch.randint(0, 4, (COUNT, 3), generator=random)
        side = float(nodes.voxel_size[0, 0])
        voxels = Voxels(nodes.box[:, 0] + positions.flip(1) * side, side, producer)
        dense, bounds = case.dense(voxels), case.bounds(side)
        actual = held(producer, nodes, positions)
        for channel, (max_error, rms) in bounds.items():
            defined = ~dense[channel].isnan()
            values = dense[channel][defined]
            error = (actual[channel][defined] - values).abs()
            between = (values > values.min()) & (values < values.max())
            root = float((error.square().sum() / between.sum()).sqrt())
            assert error.max() <= max_error and root <= rms, (channel, depth)
