"""`VolumeProducer`: a dense volume in memory as a producer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from ..base import check
from ..base.volume import Volume
from ..ops import cut_bricks
from ..pool import BrickTable, Channel
from ..pool.pools import checked_threshold, labels_by_channel, volumes_by_channel
from ..pool.pyramid import Level, NodeSummary, levels_by_depth
from ..pool.staging import wide_rows
from .answer import regions_of
from .producer import (
    Bricks,
    CoarseColors,
    Layout,
    Nodes,
    Producer,
    Regions,
    by_depth,
    check_filtered,
)

_BATCH = 4096  # bricks cut from a level at a time


class VolumeProducer(Producer):
    """Cuts bricks out of the levels of a volume; the same bits as `N3Tree.from_volume`.

    Attributes:
        volumes: What it cuts, by channel.
    """

    on_host = True

    def __init__(
        self,
        volume: Volume | Mapping[str, Volume],
        *,
        threshold: float | None = None,
        hold: Literal["voxels", "bricks"] = "voxels",
        filtered: CoarseColors | None = None,
    ) -> None:
        """Takes a volume, which becomes channel "value", or one for each channel.

        Args:
            volume: One volume, or one by channel name, all of one extent, spacing and origin.
            threshold: Regions with no value above it are EMPTY; None keeps every value.
            hold: What is held in memory. "voxels": all levels, 8 / 7 of the volume. "bricks": all
                bricks of all levels, with their borders, as well (2.2 times the volume for 8^3 and
                a border of 1); answers then come many times as fast.
            filtered: A `Filtered` shader: coarse bricks hold colours for it as well, made of the
                first channel; to be rendered with this shader.

        Raises:
            ValueError: Channels differ in extent, spacing or origin, or `hold` is unknown.
        """
        if hold not in ("voxels", "bricks"):
            raise ValueError(f"VolumeProducer: hold must be 'voxels' or 'bricks', got {hold!r}")
        volumes = volumes_by_channel("VolumeProducer", volume)
        first = next(iter(volumes.values()))
        channels = {name: Channel.of(volume) for name, volume in volumes.items()}
        if filtered is not None:
            check_filtered("VolumeProducer", filtered)
            name, last = str(filtered.other), first.width - 1
            what = "component of filtered"
            check.whole("VolumeProducer", what, filtered.component, low=0, high=last)
            if name in channels:
                raise ValueError(f"VolumeProducer: channel {name!r} is a volume's")
            channels[name] = filtered.colors(first.spacing)
        super().__init__(
            first.extent,
            channels=channels,
            spacing=first.spacing,
            origin=first.origin,
            value_range={name: volume.value_range for name, volume in volumes.items()},
            labels=labels_by_channel(volumes),
        )
        threshold = checked_threshold("VolumeProducer", threshold, volumes)
        self.volumes, self._threshold, self._hold = volumes, threshold, hold
        self._filtered = filtered
        self._levels: dict[str, list[Level]] = {}  # by channel, the root's first
        self._values: dict[str, list[Tensor]] = {}  # voxels of these levels, and coarse channels
        self._tables: dict[str, BrickTable] = {}  # by channel, depth after depth, in order z, y, x
        self._grids: Tensor | None = None  # (d, 4) of each depth: bricks along x, y, z; first row

    def prepare(self, layout: Layout) -> None:
        """Makes all levels, and all bricks if they are to be held."""
        cuts = (layout.branching, layout.brick_size, layout.border)
        self._levels = levels_by_depth(self.volumes, layout.depth, *cuts)
        self._values = {name: [one.values for one in own] for name, own in self._levels.items()}
        levels = next(iter(self._levels.values()))
        if self._filtered is not None:
            first = next(iter(self.volumes.values()))
            name = str(self._filtered.other)
            sizes = (layout.branching, layout.depth, layout.device, self.channels[name].width)
            self.made_of[name] = self._filtered.made_of
            self._values[name] = [*self._filtered.levels(first, *sizes)][::-1]
        if self._hold == "bricks":
            for name, values in self._values.items():
                if values:  # a tree of one brick has no coarse ones
                    self._tables[name] = BrickTable(_all_bricks(values, levels, layout))
            grids = torch.tensor([level.grid[::-1] for level in levels])
            count = grids.prod(1, keepdim=True)
            self._grids = torch.cat((grids, count.cumsum(0) - count), 1)

    def classify(self, nodes: Nodes) -> Regions:
        """CONSTANT where all finest voxels in reach are equal, EMPTY where none is above the
        threshold.
        """
        found = {name: self._summary(nodes, levels) for name, levels in self._levels.items()}
        return regions_of(found, self.channels, self._threshold)

    def fill(self, nodes: Nodes) -> Bricks:
        """Cuts the bricks, or names their rows where they are held."""
        layout, data = nodes.layout, {}
        held = {name: c for name, c in self.channels.items() if nodes.coarse or not c.coarse}
        if self._grids is not None:
            x, y, z, level = nodes.loc.cpu().unbind(1)
            wide, high, _, first = self._grids[level].unbind(1)
            row = first + (z * high + y) * wide + x
            return Bricks(data={name: self._tables[name][row] for name in held})
        for name, channel in held.items():
            shape = (len(nodes), *(layout.side,) * 3, channel.width)
            bricks = data[name] = torch.empty(shape, dtype=channel.dtype)
            for depth, here, zyx in _by_depth(nodes):
                values = self._values[name][depth]
                cut = cut_bricks(values, zyx, layout.brick_size, layout.border)
                rows, found = wide_rows(bricks, cut)
                rows[here] = found
        return Bricks(data=data)

    def _summary(self, nodes: Nodes, levels: list[Level]) -> NodeSummary:
        """Returns what nodes hold; nodes beyond the volume hold what the nearest at its face do."""
        result = torch.empty((3, len(nodes), levels[0].values.shape[3]))
        for depth, here, zyx in _by_depth(nodes):
            summary, grid = levels[depth].nodes, torch.tensor(levels[depth].grid)
            at = zyx.minimum(grid - 1).unbind(1)
            for rows, values in zip(result, (summary.low, summary.high, summary.mean), strict=True):
                rows[here] = values[at]
        return NodeSummary(*result)


def _by_depth(nodes: Nodes) -> list[tuple[int, Tensor, Tensor]]:
    """Returns for each depth which of the nodes it has, (m,), and their z, y, x, (m, 3)."""
    loc = nodes.loc.cpu()
    return [(depth, here, loc[here, :3].flip(1)) for depth, here in by_depth(loc)]


def _all_bricks(values: list[Tensor], levels: list[Level], layout: Layout) -> Tensor:
    """Returns (n, s, s, s, c) the bricks of a channel's values (z, y, x, c) of each level, level
    after level, in the order z, y, x.
    """
    places = [torch.cartesian_prod(*map(torch.arange, one.grid)) for one in levels[: len(values)]]
    shape = (sum(map(len, places)), *(layout.side,) * 3, values[0].shape[3])
    bricks, begin = torch.empty(shape, dtype=values[0].dtype), 0
    for level, zyx in zip(values, places, strict=True):
        for part in zyx.split(_BATCH):
            cut = cut_bricks(level, part, layout.brick_size, layout.border)
            bricks[begin : begin + len(part)] = cut
            begin += len(part)
    return bricks
