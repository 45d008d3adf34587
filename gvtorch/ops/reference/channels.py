"""Part of the torch twin: several numbers of a voxel, each with its own transfer function, as in
csrc/shaders/channels.h, which gives the formula and the layout of the table.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .exact import absorbed_by, larger
from .lit import Lit
from .march import Interval, Probe, Transfer
from .tree import ChannelBricks


class AllNumbers(ChannelBricks):
    """All numbers of a channel; smallest and largest values are (r, c)."""

    def value_range(self, node: Tensor | slice, real: torch.dtype) -> tuple[Tensor, Tensor]:
        low, high = self.range_n2c[node].to(real).unbind(1)
        return low, high


class ChannelRows(Transfer):
    """One number's rows of the shared table, as a transfer function."""

    def __init__(self, transfer: Transfer, head: Sequence[float], first: int) -> None:
        component, self.low, self.scale, rows = head
        self.component, self.end = int(component), first + int(rows)
        self.table_lm4 = transfer.table_lm4[:, first : self.end]
        self.opaque_m = transfer.opaque_m[first : self.end]


class ChannelTable:
    """The transfer functions of all numbers."""

    def __init__(self, transfer: Transfer) -> None:
        heads = transfer.table_lm4[0]
        count, self.additive = int(heads[0, 0]), bool(heads[0, 1] > 0)
        self.channels, first = [], 1 + count
        for head in heads[1:first].tolist():
            self.channels.append(ChannelRows(transfer, head, first))
            first = self.channels[-1].end

    def transparent(self, low: Tensor, high: Tensor) -> Tensor:
        """Returns (r,) bool: no number shows anything between low and high (r, c)."""
        hidden = torch.ones_like(low[:, 0], dtype=torch.bool)
        for rows in self.channels:
            hidden = hidden & rows.transparent(low[:, rows.component], high[:, rows.component])
        return hidden

    def interval(self, interval: Interval, probe: Probe) -> Tensor:
        """Returns (r, 4) premultiplied colours and alphas of intervals."""
        total = torch.zeros_like(interval.middle)
        color = total[:, None].expand(-1, 3)
        level = torch.where(interval.odd, 0, interval.level)
        numbers = probe.numbers(probe.channel, interval.middle)
        for rows in self.channels:
            row = rows.look_up(numbers[:, rows.component], level)
            halvings = row[:, 3]
            color = color + halvings[:, None] * row[:, :3]
            total = larger(total, halvings) if self.additive else total + halvings
        alpha = absorbed_by(torch.where(interval.odd, total * interval.lengths, total))
        scale = alpha / torch.where(total > 0, total, 1.0)
        return torch.cat((color * scale[:, None], alpha[:, None]), 1)


class ChannelMix(Lit):
    """Several numbers of a voxel, each with its transfer function."""

    bricks = AllNumbers

    def __post_init__(self) -> None:
        super().__post_init__()
        self.table = ChannelTable(self.transfer)

    def transparent(self, low: Tensor, high: Tensor) -> Tensor:
        return self.table.transparent(low, high)

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        rgba = self.table.interval(interval, probe)
        self.sum.add_light(self.sum.clear[:, None] * rgba[:, :3], mask)
        self.sum.absorb(rgba[:, 3], interval, mask)
