"""`BrickLevels`: reads the levels of a resident tree from its bricks; and, after the finest bricks
were edited, recomputes what depends on them: borders, coarse levels, regions and ranges.

The filters are those of pyramid.py, so the bits are those of a newly built tree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..base.constants import ABSENT, CONSTANT, EMPTY, TERMINAL
from ..base.volume import movable, to_numpy
from .downsample import by_node, extend, from_grid, pool_max, pool_min, reduce_windows
from .pools import BrickPool, NodePool
from .pyramid import NodeSummary, coarser, node_reduction

_BATCH_BRICKS = 4096  # bricks read or written at a time
GridPosition = tuple[int, ...]  # voxels or nodes of a level, z y x


@dataclass(frozen=True, eq=False)
class BrickLevels:
    """The levels of a tree whose nodes are all in the pools. A node keeps the brick and the tile
    that it owns even while its words say CONSTANT or EMPTY: so regions may change both ways.
    """

    nodes: NodePool
    bricks: BrickPool
    root: int
    depth: int
    branching: int
    extent: GridPosition  # finest voxels z y x

    @cached_property
    def slot_n(self) -> Tensor:
        """(t * n,) int64 brick slot of each node, -1 for none.

        Raises:
            ValueError: A node is not loaded, or has a brick and no children above the finest level.
        """
        slot = _pointed_or_owned(self.nodes.brick_tn, self.bricks.owner_b)
        pool = self.nodes
        per_tile, count = pool.nodes_per_tile, self.branching**3
        in_tree = pool.tree_t == self.root // per_tile  # see `N3Tree.number`
        tile = ((pool.parent_t >= 0) & in_tree).nonzero()[:, 0]
        node = (tile[:, None] * per_tile + torch.arange(count, device=slot.device)).flatten()
        node = torch.cat((node, node.new_full((1,), self.root)))
        depth = torch.cat((pool.loc_t4[tile, 3].repeat_interleave(count), tile.new_zeros(1)))
        words = pool.brick_tn.view(-1)[node]
        unrefined = (slot[node] >= 0) & (self.tile_n[node] < 0) & (depth < self.depth)
        shared = bool(self.bricks.shared_b.any()) or bool(pool.shared_t.any())
        if bool(((words == ABSENT) & (slot[node] < 0)).any()) or bool(unrefined.any()) or shared:
            raise ValueError(
                "N3Tree: not all of this tree is in memory, each brick once, as in trees of "
                "N3Tree.from_volume; in an engine, edit what the producer makes"
            )
        return slot

    @cached_property
    def tile_n(self) -> Tensor:
        """(t * n,) int64 tile of each node's children, -1 for none."""
        return _pointed_or_owned(self.nodes.child_tn, self.nodes.parent_t)

    def shape(self, level: int) -> GridPosition:
        """Returns the number of voxels z y x of a level; level 0 is the finest."""
        return tuple(-(-size // self.branching**level) for size in self.extent)

    def find(self, position_k3: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """Returns (k,) int64 nodes at grid positions z y x, or their nearest ancestors, and (k,)
        bool, whether it is the node itself.
        """
        n, node = self.branching, torch.full_like(position_k3[:, 0], self.root)
        exact = torch.ones_like(node, dtype=torch.bool)
        for up in range(self.depth - level - 1, -1, -1):
            tile = self.tile_n[node]
            z, y, x = (position_k3 // n**up % n).unbind(1)
            exact = exact & (tile >= 0)
            node = torch.where(exact, tile * self.nodes.nodes_per_tile + (z * n + y) * n + x, node)
        return node, exact

    def read(self, channel: str, level: int, low: GridPosition, high: GridPosition) -> Tensor:
        """Returns voxels low to high (z, y, x, c) of a level, on the CPU. A region without a brick
        is filled with its constant: for EMPTY ones that is their mean.
        """
        size, border = self.bricks.brick_size, self.bricks.border
        first = tuple(start // size for start in low)
        count = tuple(-(-end // size) - start for start, end in zip(first, high, strict=True))
        stored = self.bricks.bricks[channel].detach()
        bricks, constants = movable(stored), movable(self.nodes.constants[channel]).flatten(0, 1)
        node, exact = self.find(_grid_positions(first, count, bricks.device), level)
        slot = torch.where(exact, self.slot_n[node], -1)
        inner = slice(border, border + size)
        out = bricks.new_empty((len(node), size, size, size, bricks.shape[4]))
        for part in torch.arange(len(node), device=bricks.device).split(_BATCH_BRICKS):
            has_brick = slot[part] >= 0
            out[part[~has_brick]] = constants[node[part[~has_brick]]][:, None, None, None]
            out[part[has_brick]] = bricks[slot[part[has_brick]]][:, inner, inner, inner]
        grid = out.view(*count, size, size, size, -1).permute(0, 3, 1, 4, 2, 5, 6)
        crop = (slice(a - size * f, b - size * f) for a, b, f in zip(low, high, first, strict=True))
        box = grid.reshape(*(size * k for k in count), -1)[tuple(crop)]
        return box.contiguous().cpu().view(stored.dtype)

    def refresh(
        self,
        low: GridPosition,
        high: GridPosition,
        filters: Mapping[str, str],
        empty: Mapping[str, float | None],
        spacing: tuple[float, float, float],
        threshold: float | None,
    ) -> None:
        """Recomputes what depends on the finest voxels low to high (z y x).

        Args:
            low: First voxel.
            high: The one after the last.
            filters: For each channel, see `Volume.filter`.
            empty: For channels of labels, the value of the background.
            spacing: (x, y, z) of the finest voxels.
            threshold: See `N3Tree.from_volume`.
        """
        channels = [
            _ChannelLevels(self, name, how, spacing, empty.get(name))
            for name, how in filters.items()
        ]
        if any(how != "mean" for how in filters.values()):  # constants may be no coarse voxels
            low, high = (0, 0, 0), self.extent
        begin, end = low, high
        levels = []
        for level in range(self.depth + 1):
            levels.append((begin, end, *self._nodes_in_reach(level, begin, end)))
            begin = tuple(voxel // self.branching for voxel in begin)
            end = tuple(-(-voxel // self.branching) for voxel in end)
        for channel in channels:
            channel.prepare(
                [(level, first, last) for level, (_, _, first, last) in enumerate(levels)]
            )
        for level, (begin, end, first, last) in enumerate(levels):
            count = tuple(b - a for a, b in zip(first, last, strict=True))
            position_k3 = _grid_positions(first, count, self.nodes.child_tn.device)
            node, exact = self.find(position_k3, level)
            summaries = {
                channel.name: channel.update(level, begin, end, first, last, node, exact)
                for channel in channels
            }
            self._write(summaries, node, exact, threshold)

    def _nodes_in_reach(
        self, level: int, begin: GridPosition, end: GridPosition
    ) -> tuple[GridPosition, GridPosition]:
        """Returns the nodes (first, after the last) whose bricks or borders hold any of these."""
        size, border = self.bricks.brick_size, self.bricks.border
        first = tuple(max(0, (voxel - border) // size) for voxel in begin)
        ends = zip(end, self.shape(level), strict=True)
        return first, tuple(
            -(-min(voxel + border, level_size) // size) for voxel, level_size in ends
        )

    def _write(
        self,
        summaries: Mapping[str, NodeSummary],
        node: Tensor,
        exact: Tensor,
        threshold: float | None,
    ) -> None:
        """Writes ranges, constants and words of nodes (k,), where they exist."""
        device, pool = node.device, self.nodes
        has_brick = exact & (self.slot_n[node] >= 0)
        learned = any(voxels.requires_grad for voxels in self.bricks.bricks.values())
        nodes = summaries.values()
        constant = torch.stack([summary.is_constant for summary in nodes]).all(0).to(device)
        empty = torch.stack([summary.is_empty(threshold) for summary in nodes]).all(0).to(device)
        for name, summary in summaries.items():
            for stored, values, mask in (
                (pool.ranges[name], summary.ranges, exact),
                (pool.constants[name], summary.constants, has_brick),
            ):
                rows = movable(values(stored.dtype)).to(device)
                movable(stored).flatten(0, 1)[node[mask]] = rows[mask]
        slot, tile = self.slot_n[node], self.tile_n[node]
        data = ~(constant | empty) | learned
        word = torch.where(data, slot, torch.where(empty, EMPTY, CONSTANT))
        child_word = torch.where(data & (tile >= 0), tile, TERMINAL)
        pool.brick_tn.view(-1)[node[has_brick]] = word[has_brick].to(torch.int32)
        pool.child_tn.view(-1)[node[has_brick]] = child_word[has_brick].to(torch.int32)


@dataclass(eq=False)
class _ChannelLevels:
    """One channel while its levels are recomputed, one after the other, the finest first."""

    tree: BrickLevels
    name: str
    how: str
    spacing: tuple[float, float, float]
    empty: float | None
    _values: np.ndarray | None = None  # of the previous level
    _begin: GridPosition = (0, 0, 0)  # their first voxel

    def prepare(self, node_spans: Sequence[tuple[int, GridPosition, GridPosition]]) -> None:
        """Prepares for the nodes (first, after the last) of each level whose ranges are needed."""
        tree, size, border = self.tree, self.tree.bricks.brick_size, self.tree.bricks.border
        steps = [tree.branching**level for level, _, _ in node_spans]
        # From this level on, a border spans whole finest bricks: their ranges are enough.
        whole_levels = (level for level, step in enumerate(steps) if border * step % size == 0)
        self._by_brick = next(whole_levels, len(steps))
        fine_spans = [span for span in node_spans if 0 < span[0] < self._by_brick]
        if not fine_spans:
            return
        align = steps[fine_spans[-1][0]]

        firsts = [
            [(node * size - border) * steps[k] for node in first] for k, first, _ in fine_spans
        ]
        lasts = [[(node * size + border) * steps[k] for node in last] for k, _, last in fine_spans]
        low = [max(0, min(voxels) // align * align) for voxels in zip(*firsts, strict=True)]
        high = [max(voxels) for voxels in zip(*lasts, strict=True)]
        self._low = tuple(low)
        self._high = tuple(min(b, edge) for b, edge in zip(high, tree.extent, strict=True))

    def update(
        self,
        level: int,
        begin: GridPosition,
        end: GridPosition,
        first: GridPosition,
        last: GridPosition,
        node: Tensor,
        exact: Tensor,
    ) -> NodeSummary:
        """Writes the bricks of a level's nodes `first` to `last`, where its voxels `begin` to `end`
        have changed; returns the summaries (k, c) of these nodes (k,).
        """
        tree, n = self.tree, self.tree.branching
        size, border, shape = tree.bricks.brick_size, tree.bricks.border, tree.shape(level)
        low = tuple(max(0, index * size - border) for index in first)
        high = tuple(
            min(index * size + border, edge) for index, edge in zip(last, shape, strict=True)
        )
        ends = zip(end, tree.shape(level + 1), strict=True)
        coarse_begin = tuple(index // n for index in begin)
        coarse_end = tuple(min(-(-index // n), edge) for index, edge in ends)
        low = tuple(min(a, b * n) for a, b in zip(low, coarse_begin, strict=True))
        grown = zip(high, coarse_end, shape, strict=True)
        high = tuple(min(max(a, b * n), edge) for a, b, edge in grown)
        values = self._make_level(level, begin, end, low, high)
        self._values, self._begin = values, low
        padded = _with_borders(values, low, first, last, size, border)
        self._write_bricks(padded, node, exact)
        if level == 0:
            smallest = largest = padded
        elif level < self._by_brick:
            smallest, largest = (
                _with_borders(
                    extremes,
                    tuple(index // n**level for index in self._low),
                    first,
                    last,
                    size,
                    border,
                )
                for extremes in self._finest_extremes(level)
            )
        inner = padded[tuple(slice(border, s - border) for s in padded.shape[:3])]
        mean = reduce_windows(inner, node_reduction(self.how), size=size, step=size)
        if level < self._by_brick:
            window = {"size": size + 2 * border, "step": size}
            ranges = [
                reduce_windows(smallest, "min", **window),
                reduce_windows(largest, "max", **window),
            ]
        else:
            node_slices = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
            reach = border * n**level // size
            smallest, largest = self._brick_ranges
            ranges = [
                by_node(smallest, "min", n**level, reach)[node_slices],
                by_node(largest, "max", n**level, reach)[node_slices],
            ]
        flat = [torch.from_numpy(part.astype(np.float32)).flatten(0, 2) for part in (*ranges, mean)]
        return NodeSummary(*flat)

    def _make_level(
        self,
        level: int,
        begin: GridPosition,
        end: GridPosition,
        low: GridPosition,
        high: GridPosition,
    ) -> np.ndarray:
        """Returns voxels low to high of a level, begin to end of them made from the one before."""
        n = self.tree.branching
        if level == 0:
            return to_numpy(self.tree.read(self.name, 0, low, high))
        assert self._values is not None
        finer_shape = self.tree.shape(level - 1)
        ends = zip(end, finer_shape, self._begin, strict=True)
        source = tuple(
            slice(a * n - start, min(b * n, edge) - start)
            for a, (b, edge, start) in zip(begin, ends, strict=True)
        )
        dtype = self.tree.bricks.bricks[self.name].dtype
        arguments = self.how, n, dtype, self.spacing, level
        coarse = coarser(self._values[source], *arguments, empty=self.empty)
        if (low, high) == (begin, end):
            return coarse
        values = to_numpy(self.tree.read(self.name, level, low, high))
        inside = (slice(a - z, b - z) for a, b, z in zip(begin, end, low, strict=True))
        values[tuple(inside)] = coarse
        return values

    def _finest_extremes(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the smallest and largest finest value of a level's voxels, near what changes."""
        if level == 1:
            self._extremes = (to_numpy(self.tree.read(self.name, 0, self._low, self._high)),) * 2
        low, high = self._extremes
        n = self.tree.branching
        self._extremes = (pool_min(low, n), pool_max(high, n))
        return self._extremes

    @cached_property
    def _brick_ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and largest voxel of each finest brick without its border, (z, y, x, c)."""
        tree, size, border = self.tree, self.tree.bricks.brick_size, self.tree.bricks.border
        stored = tree.bricks.bricks[self.name].detach()
        grid = tuple(-(-n // size) for n in tree.extent)
        node, exact = tree.find(_grid_positions((0, 0, 0), grid, stored.device), 0)
        slot = torch.where(exact, tree.slot_n[node], -1)
        constant = movable(tree.nodes.constants[self.name]).flatten(0, 1)[node]
        low = constant.view(stored.dtype).to(torch.float32)
        high, inner = low.clone(), slice(border, border + size)
        for part in (slot >= 0).nonzero()[:, 0].split(_BATCH_BRICKS):
            bricks = movable(stored)[slot[part]].view(stored.dtype)
            voxels = bricks[:, inner, inner, inner].to(torch.float32).flatten(1, 3)
            low[part], high[part] = torch.aminmax(voxels, dim=1)
        smallest, largest = (extremes.view(*grid, -1).cpu().numpy() for extremes in (low, high))
        return smallest, largest

    def _write_bricks(self, padded: np.ndarray, node: Tensor, exact: Tensor) -> None:
        """Writes the bricks (with borders) of nodes (k,), whose voxels lie in `padded` in order."""
        size, border = self.tree.bricks.brick_size, self.tree.bricks.border
        stored = self.tree.bricks.bricks[self.name].detach()
        slot = torch.where(exact, self.tree.slot_n[node], -1)
        side = size + 2 * border
        level = movable(from_grid(padded, stored.dtype))
        windows = level.unfold(0, side, size).unfold(1, side, size).unfold(2, side, size)
        grid = windows.shape[:3]
        for part in (slot >= 0).nonzero()[:, 0].split(_BATCH_BRICKS):
            index = torch.unravel_index(part.cpu(), grid)
            bricks = windows[index].permute(0, 2, 3, 4, 1)  # (k, z, y, x, c)
            movable(stored)[slot[part]] = bricks.to(stored.device)


def _pointed_or_owned(words: Tensor, owner: Tensor) -> Tensor:
    """Returns (t * n,) int64 what each node's word points to, or else the slot that it owns."""
    pointed_n = words.flatten().to(torch.int64).clamp(min=-1)
    slot = (owner >= 0).nonzero()[:, 0]
    owner_node = owner[slot].to(torch.int64)
    lacks = pointed_n[owner_node] < 0
    pointed_n[owner_node[lacks]] = slot[lacks]
    return pointed_n


def _grid_positions(first: GridPosition, count: GridPosition, device: torch.device) -> Tensor:
    """Returns (k, 3) int64 z y x of a grid, in order."""
    axes = [torch.arange(a, a + k, device=device) for a, k in zip(first, count, strict=True)]
    return torch.cartesian_prod(*axes).view(-1, 3)


def _with_borders(
    values: np.ndarray,
    low: GridPosition,
    first: GridPosition,
    last: GridPosition,
    size: int,
    border: int,
) -> np.ndarray:
    """Returns the voxels of nodes `first` to `last` with their borders, from `values`, which begin
    at voxel `low`; the outermost voxels are repeated.
    """
    for axis, start in enumerate(low):
        begin, end = first[axis] * size - border - start, last[axis] * size + border - start
        inside = max(0, begin)
        values = values[(slice(None),) * axis + (slice(inside, end),)]
        values = extend(values, axis, inside - begin, end - inside - values.shape[axis])
    return values
