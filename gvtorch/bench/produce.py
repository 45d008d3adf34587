"""Bricks made by a torch producer, eager and compiled: `produce`."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..pool import Channel
from ..producers import Bricks, Layout, Nodes, Producer
from .record import Record, clock, synchronize

_SIDE = 4096  # finest voxels along a side of the scene


class Ripples(Producer):
    """A procedural scene: rings around the centre, uint8."""

    def __init__(self) -> None:
        """Tells where it lies."""
        box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
        super().__init__(_SIDE, channels={"value": Channel(torch.uint8)}, box=box)

    def fill(self, nodes: Nodes) -> Bricks:
        """Evaluates the function at every voxel."""
        return Bricks(data={"value": ripples(*nodes.axes)})


def ripples(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Returns (..., 1) uint8 values at places that broadcast."""
    radius = (x * x + y * y + z * z).sqrt()
    return (127.5 + 127.5 * torch.sin(40 * radius)).to(torch.uint8)[..., None]


def produce(record: Record) -> None:
    """`fill` of bricks of 8^3 and a border of 1, at random places of the finest level."""
    settings = record.settings
    count = {"cpu": 1 << 11, "cuda": 1 << 16}[settings.device.type] >> (4 * settings.quick)
    case = f"{count:,} bricks of 10^3 voxels"
    if not record.wants(case):
        return
    producer = Ripples().to(settings.device)
    layout = Layout.of(producer, 8, 1, settings.device)
    generator = torch.Generator().manual_seed(3)
    loc = torch.randint(0, _SIDE // 8, (count, 4), generator=generator)
    loc[:, 3] = layout.depth
    loc = loc.to(settings.device)

    def eager() -> Tensor:
        bricks = producer.fill(Nodes(loc, layout)).data["value"]
        assert isinstance(bricks, Tensor)
        return bricks

    compiled = torch.compile(eager, fullgraph=True, dynamic=False)
    expected = eager()
    timing = _add(record, case, "eager", eager, expected)
    try:
        settings.tell("produce: compiling")
        compiled()
        synchronize(settings.device)
    except Exception as error:  # whatever the compiler finds missing here
        reason = str(error).strip().splitlines()
        record.note(f"compiled: it does not work here: {reason[0] if reason else type(error)}")
        return
    _add(record, case, "compiled", compiled, expected, timing)
    record.note(
        "max difference: of voxels, in steps of uint8, from the eager ones. Places are made of "
        "nodes in float64, as producers do it."
    )


def _add(
    record: Record,
    case: str,
    who: str,
    run: Callable[[], Tensor],
    expected: Tensor,
    eager: float | None = None,
) -> float:
    timing = clock(run, record.settings)
    apart = (run().int() - expected.int()).abs().max()
    rates = {
        "bricks_per_second": 1e3 * len(expected) / timing.median,
        "voxels_per_second": 1e3 * expected.numel() / timing.median,
        "max_difference": int(apart),
    }
    times = {} if eager is None else {"times": timing.median / eager}
    record.add(case, who, timing, **rates, **times)
    return timing.median
