"""Bricks made by the producers of the library, eager and compiled: `produce`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import Any

import torch
from torch import Tensor

from ..fields import Mandelbulb, Solid, noise, sdf
from ..pool import Channel
from ..producers import (
    Bricks,
    FieldProducer,
    Hypertexture,
    Layout,
    MeshProducer,
    Nodes,
    OctaveProducer,
    PointProducer,
    Producer,
    Region,
    Regions,
)
from .record import Record, clock
from .voxelize import bumpy_sphere

_SIDE = 4096  # finest voxels along a side of the scene
_BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class Ripples(Producer):
    """A procedural scene: rings around the centre, uint8."""

    def __init__(self) -> None:
        super().__init__(_SIDE, channels={"value": Channel(torch.uint8)}, box=_BOX)

    def fill(self, nodes: Nodes) -> Bricks:
        """Evaluates the function at every voxel."""
        return Bricks(data={"value": ripples(*nodes.axes)})


def ripples(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Returns (..., 1) uint8 values at positions whose coordinates broadcast."""
    radius = (x * x + y * y + z * z).sqrt()
    return (127.5 + 127.5 * torch.sin(40 * radius)).to(torch.uint8)[..., None]


def library() -> dict[str, Producer]:
    """Returns one producer of each kind by name, in boxes of about 2 units."""
    bulb = Solid(Mandelbulb(8, iterations=6), normals=False)
    ball, lace = sdf.Sphere(0.9), sdf.Shell(sdf.Gyroid(0.46), 0.035)
    octaves = noise.SplineSum(frequency=4.0, octaves=8)
    generator = torch.Generator().manual_seed(5)
    points = torch.randn((1_000_000, 3), generator=generator, device="cpu").double()
    return {
        "rings": Ripples(),
        "Mandelbulb": FieldProducer(bulb, _SIDE),
        "distance field": FieldProducer(Solid(lace & ball), _SIDE),
        "noise of 6 octaves": FieldProducer(_Clouds(), _SIDE, box=_BOX, samples=1),
        "octaves by level": OctaveProducer(octaves, _SIDE, box=_BOX),
        "hypertexture": Hypertexture(ball, _SIDE, thickness=0.1, frequency=4.0, octaves=6),
        "mesh of 100,000 triangles": MeshProducer(bumpy_sphere(100_000), resolution=1024),
        "1,000,000 points": PointProducer(points, extent=1024),
    }


class _Clouds(torch.nn.Module):
    def forward(self, points: Tensor) -> Tensor:
        return noise.fbm(4 * points, octaves=6)[..., None]


def produce(record: Record) -> None:
    """Measures `fill` of bricks of 8^3 and a border of 1, at random nodes of the finest level that
    are neither empty nor constant.
    """
    settings = record.settings
    for name, producer in library().items():
        if not record.wants(name):
            continue
        settings.tell(f"produce: {name}")
        max_count = {"cpu": 1 << 8, "cuda": 1 << 13}[settings.device.type] >> (4 * settings.quick)
        with closing(producer):
            nodes = random_nodes(producer.to(settings.device), max_count, settings.device)
            compiles = name == "rings" or not settings.quick
            _measure(record, f"{name}: {len(nodes):,} bricks", producer, nodes, compiles)
    record.note(
        "max difference: of compiled values from eager ones, relative to the largest value; voxel "
        "positions are computed from nodes in float64, as producers do it"
    )


def random_nodes(producer: Producer, max_count: int, device: torch.device) -> Nodes:
    """Returns at most `max_count` random nodes of the finest level that have data."""
    layout = Layout.of(producer, 8, 1, device)
    producer.prepare(layout)
    generator = torch.Generator().manual_seed(3)
    side = -(-min(producer.extent) // 8)
    data_locs: list[Tensor] = []
    for _ in range(64):
        loc = torch.randint(0, side, (8 * max_count, 4), generator=generator, device="cpu")
        loc[:, 3] = layout.depth
        loc = loc.to(device)
        regions: Any = producer.classify(Nodes(loc, layout))
        region = regions.kind if isinstance(regions, Regions) else regions
        data_locs.append(loc[region.to(device) == Region.DATA])
        if sum(map(len, data_locs)) >= max_count:
            break
    loc = torch.cat(data_locs)[:max_count]
    parents = None
    if producer.needs_parent:
        parent_locs = torch.cat((loc[:, :3] // layout.branching, loc[:, 3:] - 1), 1)
        parents = producer.bricks_at(parent_locs, layout)
    return Nodes(loc, layout, parents=parents)


def _measure(record: Record, case: str, producer: Producer, nodes: Nodes, compiles: bool) -> None:
    """Measures `fill` eager, then compiled; compiling takes many seconds."""
    settings = record.settings

    def eager() -> Tensor:
        answer: Any = producer.fill(Nodes(nodes.loc, nodes.layout, parents=nodes.parents))
        data: Any = answer.data if isinstance(answer, Bricks) else answer
        return torch.cat([rows.reshape(len(nodes), -1).float() for rows in data.values()], 1)

    expected = eager()
    _add(record, case, "eager", eager, expected)
    if not compiles:
        return
    settings.tell(f"{case}: compiling")
    compiled = record.compiled(case, eager)
    if compiled is not None:
        _add(record, case, "compiled", compiled, expected)


def _add(record: Record, case: str, who: str, run: Callable[[], Tensor], expected: Tensor) -> None:
    timing = clock(run, record.settings)
    deviation = (timing.last - expected).abs().max() / expected.abs().max().clamp(min=1e-30)
    rates = {
        "bricks_per_second": 1e3 * len(expected) / timing.median,
        "voxels_per_second": 1e3 * len(expected) * 1000 / timing.median,
        "max_difference": float(deviation),
    }
    record.add(case, who, timing, **rates, **record.relative_to_first(case, timing))
