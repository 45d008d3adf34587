"""`VolumeProducer`: a dense volume in memory as a producer."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .. import check
from ..pool import Channel, cut_bricks
from ..pool.n3tree import check_channels
from ..pool.pyramid import Level, build_levels, round_to
from ..volume import Volume, movable
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions


class VolumeProducer(Producer):
    """Cuts bricks out of the mean pyramid of a volume; the same bits as `N3Tree.from_volume`."""

    def __init__(
        self, volume: Volume | Mapping[str, Volume], *, threshold: float | None = None
    ) -> None:
        """Takes a volume, which becomes channel "value", or one for each channel.

        Args:
            volume: One volume, or one by channel name, all of one extent, spacing and origin.
            threshold: Regions with no value above it are EMPTY; None keeps every value.

        Raises:
            ValueError: Channels differ in extent, spacing or origin.
        """
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
        self._volumes, self._threshold = volumes, threshold
        self._levels: dict[str, list[Level]] = {}  # by channel, the root's first

    def prepare(self, layout: Layout) -> None:
        """Makes all levels."""
        sizes = {"brick_size": layout.brick_size, "border": layout.border}
        for name, volume in self._volumes.items():
            levels = build_levels(
                volume.data, layout.depth + 1, branching=layout.branching, **sizes
            )
            self._levels[name] = [*levels][::-1]

    def classify(self, nodes: Nodes) -> Regions:
        """CONSTANT where all finest voxels in reach are equal, EMPTY where none is above the
        threshold.
        """
        count = len(nodes)
        flat = torch.ones(count, dtype=torch.bool)
        below = torch.full((count,), self._threshold is not None)
        constants, ranges = {}, {}
        for name, channel in self.channels.items():
            low, high, mean = (
                self._at(nodes, [getattr(level, what) for level in self._levels[name]])
                for what in ("low", "high", "mean")
            )
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
        """Cuts the bricks."""
        layout = nodes.layout
        side = layout.brick_size + 2 * layout.border
        loc = nodes.loc.cpu()
        data = {}
        for name, channel in self.channels.items():
            bricks = torch.empty((len(nodes), side, side, side, channel.width), dtype=channel.dtype)
            for depth in loc[:, 3].unique().tolist():
                here = loc[:, 3] == depth
                values = self._levels[name][depth].values
                place = loc[here, :3].flip(1)
                cut = cut_bricks(values, place, layout.brick_size, layout.border)
                movable(bricks)[here] = movable(cut)
            data[name] = bricks
        return Bricks(data=data)

    def _at(self, nodes: Nodes, grids: list[Tensor]) -> Tensor:
        """(k, c) values of the nodes in a grid by depth; beyond the volume the outermost."""
        loc = nodes.loc.cpu()
        values = torch.empty((len(nodes), grids[0].shape[-1]))
        for depth in loc[:, 3].unique().tolist():
            here, grid = loc[:, 3] == depth, grids[depth]
            z, y, x = (loc[here, 2 - axis].clamp(max=grid.shape[axis] - 1) for axis in range(3))
            values[here] = grid[z, y, x]
        return values
