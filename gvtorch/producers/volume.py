"""`VolumeProducer`: a dense volume in memory as a producer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor

from ..base import check
from ..base.volume import Volume, movable
from ..ops import cut_bricks
from ..pool import BrickTable, Channel
from ..pool.pools import checked_threshold, labels_by_channel, volumes_by_channel
from ..pool.pyramid import Level, NodeSummary, levels_by_depth
from ..pool.staging import mapped, wide_rows
from ..shaders.filtered import Filtered
from .answer import regions_of
from .nodes import Layout, Nodes
from .producer import Bricks, Producer, Regions, by_depth

_BATCH_BRICKS = 4096  # bricks cut from a level at a time


class VolumeProducer(Producer):
    """Cuts bricks out of the levels of a volume; bit for bit those of `N3Tree.from_volume`.

    Attributes:
        volumes: The volumes, by channel.
    """

    def __init__(
        self,
        volume: Volume | Mapping[str, Volume],
        *,
        threshold: float | None = None,
        hold: Literal["voxels", "bricks", "mapped"] = "voxels",
        filtered: Filtered | None = None,
        branching: int = 2,
    ) -> None:
        """Sets the volume, which becomes channel "value", or one volume for each channel.

        Args:
            volume: One volume, or several by channel name, all of one extent, spacing and origin;
                kept in host memory.
            threshold: Regions with no value above it are EMPTY; None keeps every value.
            hold: What is kept in memory (sizes are for N = 2). "voxels": all levels, 8 / 7 of the
                volume. "bricks": in addition all bricks of all levels, with borders (2.2 times the
                volume for 8^3 and a border of 1), which makes answers many times faster.
                "mapped": a copy of all levels in host memory that the engine's CUDA device reads
                directly: it cuts bricks itself, without the host, and `Engine.capture` records it.
            filtered: A `Filtered` shader: coarse bricks also hold its colours, made of the first
                channel; render with this shader.
            branching: N.

        Raises:
            ValueError: Channels differ in extent, spacing or origin, or `hold` is unknown.
        """
        check.one_of("VolumeProducer", "hold", hold, ("voxels", "bricks", "mapped"))
        by_channel = volumes_by_channel("VolumeProducer", volume)
        volumes = {name: volume.to("cpu") for name, volume in by_channel.items()}
        first = next(iter(volumes.values()))
        channels = {name: Channel.of(volume) for name, volume in volumes.items()}
        if filtered is not None:
            check.instance("VolumeProducer", "filtered", filtered, Filtered)
            name, last = str(filtered.other), first.width - 1
            label = "component of filtered"
            check.integer("VolumeProducer", label, filtered.component, low=0, high=last)
            if name in channels:
                raise ValueError(f"VolumeProducer: channel {name!r} is a volume's")
            channels[name] = filtered.colors(first.spacing)
        super().__init__(
            first.extent,
            channels=channels,
            spacing=first.spacing,
            origin=first.origin,
            branching=branching,
            value_range={name: volume.value_range for name, volume in volumes.items()},
            labels=labels_by_channel(volumes),
        )
        threshold = checked_threshold("VolumeProducer", threshold, volumes)
        self.volumes, self._threshold, self._hold = volumes, threshold, hold
        self._filtered = filtered
        self.on_device, self.on_host = hold == "mapped", hold != "mapped"
        self._values: dict[str, list[Tensor]] = {}  # by channel, one per level, the root's first
        self._tables: dict[str, BrickTable] = {}  # by channel; rows by depth, z, y, x
        self._voxels: dict[str, Tensor] = {}  # by channel (v, c), in the same order
        self._nodes: dict[str, Tensor] = {}  # by channel (n, 3, c) low, high, mean, same order
        # (d, 4) for each depth: the first node or voxel, and nodes or voxels along z, y, x.
        self._grids = self._sizes = torch.empty(0, device="cpu")

    def prepare(self, layout: Layout) -> None:
        """Makes all levels, and all bricks if `hold` is "bricks"."""
        brick_options = (layout.branching, layout.brick_size, layout.border)
        by_channel = levels_by_depth(self.volumes, layout.depth, *brick_options)
        values = {name: [level.values for level in levels] for name, levels in by_channel.items()}
        levels = next(iter(by_channel.values()))
        if self._filtered is not None:
            first = next(iter(self.volumes.values()))
            name = str(self._filtered.other)
            sizes = (layout.branching, layout.depth, layout.device, self.channels[name].width)
            self.made_of[name] = self._filtered.made_of
            if colors := [*self._filtered.levels(first, *sizes)]:  # none in a tree of one brick
                values[name] = colors[::-1]
        summaries = {
            name: torch.cat([*map(_node_rows, channel_levels)])
            for name, channel_levels in by_channel.items()
        }
        self._grids = _grid_offsets([level.grid for level in levels])
        if self._hold == "bricks":
            for name, channel_values in values.items():
                self._tables[name] = BrickTable(_all_bricks(channel_values, levels, layout))
        if self._hold != "mapped":
            self._values, self._nodes = values, summaries
            return
        device = layout.device
        self._grids = self._grids.to(device)
        self._sizes = _grid_offsets([level.values.shape[:3] for level in levels]).to(device)
        self._nodes = {name: mapped(rows, device) for name, rows in summaries.items()}
        while values:  # one by one, and freed, since each is copied
            name, channel_values = values.popitem()
            rows = [movable(level).flatten(0, 2) for level in channel_values]
            self._voxels[name] = mapped(torch.cat(rows), device)

    def classify(self, nodes: Nodes) -> Regions:
        """Returns EMPTY where no finest voxel in reach is above the threshold, else CONSTANT where
        all are equal, else DATA.
        """
        row = self._node_index(nodes)
        summaries = {name: NodeSummary(*rows[row].unbind(1)) for name, rows in self._nodes.items()}
        return regions_of(summaries, self.channels, self._threshold)

    def fill(self, nodes: Nodes) -> Bricks:
        """Cuts the bricks, or returns rows of the table if `hold` is "bricks"."""
        layout = nodes.layout
        channels = {name: c for name, c in self.channels.items() if nodes.coarse or not c.coarse}
        if self._hold == "bricks":
            row = self._node_index(nodes)
            return Bricks(data={name: self._tables[name][row] for name in channels})
        if self._hold == "mapped":
            voxel = self._voxel_index(nodes)
            voxels = {name: self._voxels[name][voxel].view(c.dtype) for name, c in channels.items()}
            return Bricks(data=voxels)
        loc, data = nodes.loc.cpu(), {}
        for name, channel in channels.items():
            shape = (len(nodes), *(layout.side,) * 3, channel.width)
            bricks = data[name] = torch.empty(shape, dtype=channel.dtype, device="cpu")
            for depth, level_rows in by_depth(loc):
                zyx = loc[level_rows, :3].flip(1)
                cut = cut_bricks(self._values[name][depth], zyx, layout.brick_size, layout.border)
                rows, cut_rows = wide_rows(bricks, cut)
                rows[level_rows] = cut_rows
        return Bricks(data=data)

    def _node_index(self, nodes: Nodes) -> Tensor:
        """Returns (k,) int64 indices of nodes among those of all levels; outside, the nearest's."""
        loc = nodes.loc.to(self._grids.device)
        first, *sizes = self._grids[loc[:, 3]].unbind(1)
        nodes_zyx = zip(loc[:, :3].flip(1).unbind(1), sizes, strict=True)
        z, y, x = (node.minimum(size - 1) for node, size in nodes_zyx)
        return first + (z * sizes[1] + y) * sizes[2] + x

    def _voxel_index(self, nodes: Nodes) -> Tensor:
        """Returns (k, s, s, s) int64 indices of voxels among those of all levels, of the bricks
        that `cut_bricks` cuts.
        """
        layout, loc = nodes.layout, nodes.loc.to(self._sizes.device)
        first, *sizes = self._sizes[loc[:, 3], :, None, None, None].unbind(1)
        offsets, indices = layout.reach.to(loc.device), []
        for axis, (node, size) in enumerate(zip(loc[:, :3].flip(1).unbind(1), sizes, strict=True)):
            axis_offsets = offsets.view([-1 if other == axis else 1 for other in range(3)])
            coordinate = node[:, None, None, None] * layout.brick_size + axis_offsets
            indices.append(coordinate.clamp(min=0).minimum(size - 1))
        z, y, x = indices
        return first + (z * sizes[1] + y) * sizes[2] + x


def _node_rows(level: Level) -> Tensor:
    """Returns (n, 3, c): low, high and mean of the nodes of a level."""
    summary = level.nodes
    return torch.stack((summary.low, summary.high, summary.mean), 3).flatten(0, 2)


def _grid_offsets(sizes: Sequence[Sequence[int]]) -> Tensor:
    """Returns (d, 4) int64 for concatenated grids (z, y, x): index of the first entry, sizes."""
    grids = torch.tensor([[*size] for size in sizes], device="cpu")
    count = grids.prod(1, keepdim=True)
    return torch.cat((count.cumsum(0) - count, grids), 1)


def _all_bricks(values: list[Tensor], levels: list[Level], layout: Layout) -> Tensor:
    """Returns (n, s, s, s, c): the bricks of a channel, by level and then z, y, x."""
    node_positions = [
        torch.cartesian_prod(*(torch.arange(n, device="cpu") for n in level.grid))
        for level in levels[: len(values)]
    ]
    shape = (sum(map(len, node_positions)), *(layout.side,) * 3, values[0].shape[3])
    bricks, begin = torch.empty(shape, dtype=values[0].dtype, device="cpu"), 0
    for level, zyx in zip(values, node_positions, strict=True):
        for part in zyx.split(_BATCH_BRICKS):
            cut = cut_bricks(level, part, layout.brick_size, layout.border)
            bricks[begin : begin + len(part)] = cut
            begin += len(part)
    return bricks
