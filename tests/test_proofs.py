"""What all producers of formulas promise: what is proven empty or full is so in every voxel, values
lie in their ranges, and a level is the mean of the one below it.
"""

from __future__ import annotations

import os

import pytest
import torch
from helpers.shapes import ALL, BOXES, ball, block, inside, nodes_of, random_boxes

import gvtorch as gv
from gvtorch.producers import Layout

sdf = gv.sdf
BOX = ((-1.1,) * 3, (1.1,) * 3)
ROUGH = {"thickness": 0.15, "frequency": 3.0, "octaves": 4, "softness": 0.1, "box": BOX}


def sampled():
    """A ball of distances, as a volume."""
    axis = torch.linspace(-1, 1, 41)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    away = torch.stack((x, y, z), -1).norm(dim=-1) - 0.7
    return gv.SampledDistance(gv.Volume(away, spacing=(0.05,) * 3, origin=(-1.0,) * 3))


class Stripes(torch.nn.Module):
    """A plain module: colours of which nothing is known."""

    def forward(self, points):
        return 0.5 + 0.5 * (9 * points).sin()


class Sway(torch.nn.Module):
    """A way of at most 0.1."""

    def forward(self, points):
        return 0.05 * (7 * points.roll(1, -1)).sin()


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
        lambda: gv.warp(gv.Solid(ball(), colors=False), Sway(), most=0.1), threshold=0.0
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
    "julia": lambda: gv.FieldProducer(gv.Julia((-0.2, 0.5, 0.3), 2, iterations=9), 128),
    **{
        name: of_field(make, **({"box": ((-7.0,) * 3, (7.0,) * 3)} if name == "mandelbox" else {}))
        for name, (make, _) in ALL.items()
    },
}


@pytest.fixture(params=PRODUCERS)
def name(request):
    return request.param


def voxels(producer, nodes):
    answer = producer.fill(nodes)
    return answer.data if isinstance(answer, gv.Bricks) else answer


def test_no_voxel_is_dropped(name):
    """All nodes of depth 3 and a twentieth of those of depth 6, in bricks of 2^3; all of them with
    GVTORCH_SOAK=1. What is called EMPTY or CONSTANT is, in every voxel, and every value is in its
    range.
    """
    producer = PRODUCERS[name]()
    producer.prepare(Layout.of(producer, 2, 1, torch.device("cpu")))
    shown = getattr(producer, "threshold", None) or {"density": 0.0}
    told, random = dict.fromkeys(gv.Region, 0), torch.Generator().manual_seed(6)
    share = 1 if os.environ.get("GVTORCH_SOAK") else 20
    for depth, most in ((3, 1 << 9), (6, (1 << 18) // share)):
        nodes = nodes_of(producer, depth, brick_size=2)
        nodes = nodes[torch.randperm(len(nodes), generator=random)[:most].sort().values]
        regions = producer.classify(nodes)
        for at in torch.arange(len(nodes)).split(50_000):
            kind = regions.kind[at]
            data = voxels(producer, nodes[at])
            for channel, bricks in data.items():
                rows = bricks.flatten(1, 3)
                if channel in shown:
                    assert (rows <= shown[channel])[kind == gv.Region.EMPTY].all(), channel
                if channel in regions.constants:
                    constant = regions.constants[channel][at][:, None]
                    assert (rows == constant)[kind == gv.Region.CONSTANT].all(), channel
                else:
                    assert not (kind == gv.Region.CONSTANT).any()
                if channel in regions.ranges:
                    low, high = regions.ranges[channel][at].unbind(1)
                    assert (rows >= low[:, None]).all() and (rows <= high[:, None]).all(), channel
            for region in gv.Region:
                told[region] += int((kind == region).sum())
    least = 0.001 if name == "mandelbox" else 0.1
    assert told[gv.Region.EMPTY] > least * sum(told.values())


@pytest.mark.parametrize("name", [name for name in PRODUCERS if name not in ALL])
def test_intervals_of_fields_hold_in_random_boxes(name):
    """10^5 boxes, 12 values of each; of prefiltered fields for voxels of any size."""
    producer = PRODUCERS[name]()
    center, half = random_boxes(BOXES)
    random = torch.Generator().manual_seed(8)
    size = (10 ** (-3 * torch.rand(len(center), 1, generator=random).double())).expand(-1, 3)
    if isinstance(producer, gv.Hypertexture):
        low, high = producer.shape.bounds(center, half)
        value = producer.shape(inside(center, half, 12))
        assert (value >= low[:, None]).all() and (value <= high[:, None]).all()
        return
    field, known = producer.field, producer.field.filtered_bounds(center, half, size)
    for at in torch.arange(len(center)).split(20_000):
        points = inside(center[at], half[at], 12)
        sides = size[at, None].expand_as(points)
        found = field.filtered(points, sides) if field.prefiltered else field(points)
        by_name = found if isinstance(found, dict) else {"value": found}
        ends = known if isinstance(known, dict) else {"value": known}
        for channel, interval in ends.items():
            if channel != "normal":  # `finish` makes them of distances
                low, high = (end[at].view(len(at), 1, -1) for end in interval)
                value = by_name[channel].view(len(at), 12, -1)
                assert (value >= low - 1e-9).all() and (value <= high + 1e-9).all(), channel


def test_a_level_is_the_mean_of_the_one_below(name):
    """As far as filters tell what voxels hold of what is smaller than they are: of the variation of
    a level a tenth, at the root a third. The Mandelbox is dust at every scale: a third everywhere.
    """
    error = 0.3 if name == "mandelbox" else 0.03
    producer = PRODUCERS[name]()
    producer.prepare(Layout.of(producer, 8, 1, torch.device("cpu")))
    for depth in (3, 2, 1, 0):
        nodes = nodes_of(producer, depth, brick_size=8, border=0)
        below = nodes_of(producer, depth + 1, brick_size=8, border=0)
        count = 2**depth
        number = torch.arange(len(below)).view(*(count, 2) * 3).permute(0, 2, 4, 1, 3, 5)
        children = number.reshape(-1)
        fine = voxels(producer, below[children])
        for channel, bricks in voxels(producer, nodes).items():
            if channel.endswith("normal"):  # a direction: of a mean of colours, no mean itself
                continue
            # 2^3 bricks of 4^3 cells of 2^3 voxels
            cells = fine[channel].float().view(len(nodes), 2, 2, 2, 4, 2, 4, 2, 4, 2, -1)
            mean = cells.mean((5, 7, 9)).permute(0, 1, 4, 2, 5, 3, 6, 7).reshape(bricks.shape)
            apart = (bricks.float() - mean).abs()
            assert apart.mean() < (error + 0.3 / count) * mean.std(), channel
