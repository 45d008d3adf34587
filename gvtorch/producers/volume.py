"""`VolumeProducer`: a dense volume in memory as a producer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from ..base import check
from ..base.volume import Volume, movable
from ..ops import cut_bricks
from ..pool import BrickTable, Channel
from ..pool.n3tree import check_channels
from ..pool.pyramid import Level, round_to, volume_levels
from ..pool.staging import wide_rows
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions


class VolumeProducer(Producer):
    """Cuts bricks out of the levels of a volume; the same bits as `N3Tree.from_volume`."""

    def __init__(
        self,
        volume: Volume | Mapping[str, Volume],
        *,
        threshold: float | None = None,
        hold: Literal["voxels", "bricks"] = "voxels",
    ) -> None:
        """Takes a volume, which becomes channel "value", or one for each channel.

        Args:
            volume: One volume, or one by channel name, all of one extent, spacing and origin.
            threshold: Regions with no value above it are EMPTY; None keeps every value.
            hold: "bricks" cuts all bricks of all levels at the start, which takes 1 / 7 more than
                the volume with all borders (2.2 times the volume for 8^3 and a border of 1), and
                is many times as fast afterwards.

        Raises:
            ValueError: Channels differ in extent, spacing or origin, or `hold` is unknown.
        """
        if hold not in ("voxels", "bricks"):
            raise ValueError(f"VolumeProducer: hold must be 'voxels' or 'bricks', got {hold!r}")
        volumes = dict(volume) if isinstance(volume, Mapping) else {"value": volume}
        first = check_channels("VolumeProducer", volumes)
        super().__init__(
            first.extent,
            channels={n: Channel(v.data.dtype, v.data.shape[3]) for n, v in volumes.items()},
            spacing=first.spacing,
            origin=first.origin,
            value_range={name: volume.value_range for name, volume in volumes.items()},
        )
        if threshold is not None:
            threshold = check.number("VolumeProducer", "threshold", threshold)
        self._volumes, self._threshold, self._hold = volumes, threshold, hold
        self._levels: dict[str, list[Level]] = {}  # by channel, the root's first
        self._tables: dict[str, BrickTable] = {}  # by channel, depth after depth
        self._first: Tensor | None = None  # (d, 4) int64: bricks along x, y, z; row of the first

    def prepare(self, layout: Layout) -> None:
        """Makes all levels."""
        sizes = {"brick_size": layout.brick_size, "border": layout.border}
        for name, volume in self._volumes.items():
            levels = volume_levels(volume, layout.depth + 1, branching=layout.branching, **sizes)
            self._levels[name] = [*levels][::-1]
            if self._hold == "bricks":
                self._tables[name] = BrickTable(_all_bricks(self._levels[name], layout))
                grids = torch.tensor([_grid(level, layout)[::-1] for level in self._levels[name]])
                ends = grids.prod(1).cumsum(0)
                first = torch.cat((grids, (ends - grids.prod(1))[:, None]), 1)
                self._first = first.to(layout.device)

    def classify(self, nodes: Nodes) -> Regions:
        """CONSTANT where all finest voxels in reach are equal, EMPTY where none is above the
        threshold.
        """
        count = len(nodes)
        flat = torch.ones(count, dtype=torch.bool)
        below = torch.full((count,), self._threshold is not None)
        constants, ranges = {}, {}
        for name, channel in self.channels.items():
            low, high, mean = self._summary(nodes, self._levels[name])
            same = (low == high).all(-1)
            flat &= same
            if self._threshold is not None:
                below &= (high <= self._threshold).all(-1)
            value = torch.where(same[:, None], low, mean)
            constants[name] = round_to(value, channel.dtype)
            ranges[name] = round_to(torch.stack((low, high), 1), channel.dtype)
        kind = torch.where(flat, Region.CONSTANT, Region.DATA)
        return Regions(
            kind=torch.where(below, Region.EMPTY, kind), constants=constants, ranges=ranges
        )

    def fill(self, nodes: Nodes) -> Bricks:
        """Cuts the bricks, or names them where they are cut already."""
        layout = nodes.layout
        if self._first is not None:
            (x, y, z), at = nodes.loc[:, :3].unbind(1), self._first[nodes.depth]
            row = (at[:, 3] + (z * at[:, 1] + y) * at[:, 0] + x).cpu()
            return Bricks(data={name: table[row] for name, table in self._tables.items()})
        side = layout.brick_size + 2 * layout.border
        loc = nodes.loc.cpu()
        data = {}
        for name, channel in self.channels.items():
            bricks = torch.empty((len(nodes), side, side, side, channel.width), dtype=channel.dtype)
            for depth in loc[:, 3].unique().tolist():
                here = (loc[:, 3] == depth).nonzero()[:, 0]
                level = self._levels[name][depth].values
                place = loc[here, :3].flip(1)
                cut = cut_bricks(level, place, layout.brick_size, layout.border)
                rows, found = wide_rows(bricks, cut)
                rows[here] = found
            data[name] = bricks
        return Bricks(data=data)

    def _summary(self, nodes: Nodes, levels: list[Level]) -> list[Tensor]:
        """(k, c) smallest, largest and mean value of nodes; beyond the volume those at its face."""
        loc = nodes.loc.cpu()
        found = [torch.empty((len(nodes), levels[0].low.shape[-1])) for _ in range(3)]
        for depth in loc[:, 3].unique().tolist():
            here, level = (loc[:, 3] == depth).nonzero()[:, 0], levels[depth]
            zyx = loc[here, :3].flip(1)
            z, y, x = zyx.minimum(torch.tensor(level.low.shape[:3]) - 1).unbind(1)
            for values, grid in zip(found, (level.low, level.high, level.mean), strict=True):
                values[here] = grid[z, y, x]
        return found


def _grid(level: Level, layout: Layout) -> tuple[int, int, int]:
    """Bricks along z, y, x."""
    z, y, x = (-(-n // layout.brick_size) for n in level.values.shape[:3])
    return (z, y, x)


def _all_bricks(levels: list[Level], layout: Layout) -> Tensor:
    """(n, s, s, s, c) bricks of all levels, in the order z, y, x, made a layer at a time."""
    size, reach = layout.brick_size, layout.reach.cpu()
    first, side = levels[0].values, len(reach)
    count = sum(z * y * x for z, y, x in (_grid(level, layout) for level in levels))
    out = torch.empty((count, side, side, side, first.shape[3]), dtype=first.dtype)
    begin = 0
    for level in levels:
        gz, gy, gx = _grid(level, layout)
        values = movable(level.values)
        y, x = (
            torch.arange(int(reach[0]), grid * size + layout.border).clamp(0, n - 1)
            for grid, n in ((gy, values.shape[1]), (gx, values.shape[2]))
        )
        for layer in range(gz):
            z = (layer * size + reach).clamp(0, values.shape[0] - 1)
            slab = values[z].index_select(1, y).index_select(2, x)
            windows = slab.unfold(1, side, size).unfold(2, side, size)  # (s, gy, gx, c, s, s)
            here = movable(out)[begin : begin + gy * gx].unflatten(0, (gy, gx))
            here.copy_(windows.permute(1, 2, 0, 4, 5, 3))
            begin += gy * gx
    return out
