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
from .pyramid import NodeSummary, coarser, middle_of

_BATCH = 4096  # bricks read or written at a time
Place = tuple[int, ...]  # voxels or nodes of a level, z y x


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
    extent: Place  # finest voxels z y x

    @cached_property
    def slot_n(self) -> Tensor:
        """(t * n,) int64 brick slot of each node, -1 for none.

        Raises:
            ValueError: A node is not loaded, or has a brick and no children above the finest level.
        """
        slot = _owned(self.nodes.brick_tn, self.bricks.owner_b)
        pool = self.nodes
        per_tile, count = pool.nodes_per_tile, self.branching**3
        mine = pool.tree_t == self.root // per_tile  # see `N3Tree.number`
        tile = ((pool.parent_t >= 0) & mine).nonzero()[:, 0]
        node = (tile[:, None] * per_tile + torch.arange(count, device=slot.device)).flatten()
        node = torch.cat((node, node.new_full((1,), self.root)))
        depth = torch.cat((pool.loc_t4[tile, 3].repeat_interleave(count), tile.new_zeros(1)))
        words = pool.brick_tn.view(-1)[node]
        short = (slot[node] >= 0) & (self.tile_n[node] < 0) & (depth < self.depth)
        shared = bool(self.bricks.shared_b.any()) or bool(pool.shared_t.any())
        if bool(((words == ABSENT) & (slot[node] < 0)).any()) or bool(short.any()) or shared:
            raise ValueError(
                "N3Tree: not all of this tree is in memory, each brick once, as in trees of "
                "N3Tree.from_volume; in an engine, edit what the producer makes"
            )
        return slot

    @cached_property
    def tile_n(self) -> Tensor:
        """(t * n,) int64 tile of each node's children, -1 for none."""
        return _owned(self.nodes.child_tn, self.nodes.parent_t)

    def shape(self, level: int) -> Place:
        """Returns the number of voxels z y x of a level; level 0 is the finest."""
        return tuple(-(-size // self.branching**level) for size in self.extent)

    def find(self, place_k3: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """Returns (k,) int64 nodes at grid positions z y x, or their nearest ancestors, and (k,)
        bool, whether it is the node itself.
        """
        n, node = self.branching, torch.full_like(place_k3[:, 0], self.root)
        exact = torch.ones_like(node, dtype=torch.bool)
        for up in range(self.depth - level - 1, -1, -1):
            tile = self.tile_n[node]
            z, y, x = (place_k3 // n**up % n).unbind(1)
            exact = exact & (tile >= 0)
            node = torch.where(exact, tile * self.nodes.nodes_per_tile + (z * n + y) * n + x, node)
        return node, exact

    def read(self, channel: str, level: int, low: Place, high: Place) -> Tensor:
        """Returns voxels low to high (z, y, x, c) of a level, on the CPU. A region without a brick
        is filled with its constant: for EMPTY ones that is their mean.
        """
        size, border = self.bricks.brick_size, self.bricks.border
        first = tuple(at // size for at in low)
        count = tuple(-(-end // size) - at for at, end in zip(first, high, strict=True))
        held = self.bricks.bricks[channel].detach()
        pool, constants = movable(held), movable(self.nodes.constants[channel]).flatten(0, 1)
        node, exact = self.find(_places(first, count, pool.device), level)
        slot = torch.where(exact, self.slot_n[node], -1)
        inner = slice(border, border + size)
        out = pool.new_empty((len(node), size, size, size, pool.shape[4]))
        for part in torch.arange(len(node), device=pool.device).split(_BATCH):
            own = slot[part] >= 0
            out[part[~own]] = constants[node[part[~own]]][:, None, None, None]
            out[part[own]] = pool[slot[part[own]]][:, inner, inner, inner]
        grid = out.view(*count, size, size, size, -1).permute(0, 3, 1, 4, 2, 5, 6)
        cropped = (
            slice(a - size * f, b - size * f) for a, b, f in zip(low, high, first, strict=True)
        )
        whole = grid.reshape(*(size * k for k in count), -1)[tuple(cropped)]
        return whole.contiguous().cpu().view(held.dtype)

    def refresh(
        self,
        low: Place,
        high: Place,
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
            begin = tuple(at // self.branching for at in begin)
            end = tuple(-(-at // self.branching) for at in end)
        for one in channels:
            one.limit([(level, first, last) for level, (_, _, first, last) in enumerate(levels)])
        for level, (begin, end, first, last) in enumerate(levels):
            count = tuple(b - a for a, b in zip(first, last, strict=True))
            place = _places(first, count, self.nodes.child_tn.device)
            node, exact = self.find(place, level)
            summaries = {
                one.name: one.update(level, begin, end, first, last, node, exact)
                for one in channels
            }
            self._write(summaries, node, exact, threshold)

    def _nodes_in_reach(self, level: int, begin: Place, end: Place) -> tuple[Place, Place]:
        """Returns the nodes (first, after the last) whose bricks or borders hold any of these."""
        size, border = self.bricks.brick_size, self.bricks.border
        first = tuple(max(0, (at - border) // size) for at in begin)
        ends = zip(end, self.shape(level), strict=True)
        return first, tuple(-(-min(at + border, most) // size) for at, most in ends)

    def _write(
        self,
        summaries: Mapping[str, NodeSummary],
        node: Tensor,
        exact: Tensor,
        threshold: float | None,
    ) -> None:
        """Writes ranges, constants and words of nodes (k,), where they exist."""
        device, pool = node.device, self.nodes
        own = exact & (self.slot_n[node] >= 0)
        learned = any(one.requires_grad for one in self.bricks.bricks.values())
        nodes = summaries.values()
        constant = torch.stack([one.is_constant for one in nodes]).all(0).to(device)
        empty = torch.stack([one.is_empty(threshold) for one in nodes]).all(0).to(device)
        for name, one in summaries.items():
            for held, values, some in (
                (pool.ranges[name], one.ranges, exact),
                (pool.constants[name], one.constants, own),
            ):
                rows = movable(values(held.dtype)).to(device)
                movable(held).flatten(0, 1)[node[some]] = rows[some]
        slot, tile = self.slot_n[node], self.tile_n[node]
        data = ~(constant | empty) | learned
        word = torch.where(data, slot, torch.where(empty, EMPTY, CONSTANT))
        below = torch.where(data & (tile >= 0), tile, TERMINAL)
        pool.brick_tn.view(-1)[node[own]] = word[own].to(torch.int32)
        pool.child_tn.view(-1)[node[own]] = below[own].to(torch.int32)


@dataclass(eq=False)
class _ChannelLevels:
    """One channel while its levels are recomputed, one after the other, the finest first."""

    tree: BrickLevels
    name: str
    how: str
    spacing: tuple[float, float, float]
    empty: float | None
    _values: np.ndarray | None = None  # of the previous level
    _begin: Place = (0, 0, 0)  # their first voxel

    def limit(self, reach: Sequence[tuple[int, Place, Place]]) -> None:
        """Prepares for the nodes (first, after the last) of each level whose ranges are needed."""
        tree, size, border = self.tree, self.tree.bricks.brick_size, self.tree.bricks.border
        steps = [tree.branching**level for level, _, _ in reach]
        # From this level on, a border spans whole finest bricks: their ranges are enough.
        whole = (level for level, step in enumerate(steps) if border * step % size == 0)
        self._by_brick = next(whole, len(steps))
        near = [one for one in reach if 0 < one[0] < self._by_brick]
        if not near:
            return
        align = steps[near[-1][0]]

        firsts = [[(at * size - border) * steps[k] for at in first] for k, first, _ in near]
        lasts = [[(at * size + border) * steps[k] for at in last] for k, _, last in near]
        low = [max(0, min(at) // align * align) for at in zip(*firsts, strict=True)]
        high = [max(at) for at in zip(*lasts, strict=True)]
        self._low = tuple(low)
        self._high = tuple(min(b, most) for b, most in zip(high, tree.extent, strict=True))

    def update(
        self,
        level: int,
        begin: Place,
        end: Place,
        first: Place,
        last: Place,
        node: Tensor,
        exact: Tensor,
    ) -> NodeSummary:
        """Writes the bricks of a level's nodes `first` to `last`, where its voxels `begin` to `end`
        have changed; returns the summaries (k, c) of these nodes (k,).
        """
        tree, n = self.tree, self.tree.branching
        size, border, shape = tree.bricks.brick_size, tree.bricks.border, tree.shape(level)
        low = tuple(max(0, at * size - border) for at in first)
        high = tuple(min(at * size + border, most) for at, most in zip(last, shape, strict=True))
        ends = zip(end, tree.shape(level + 1), strict=True)
        coarse_begin = tuple(at // n for at in begin)
        coarse_end = tuple(min(-(-at // n), most) for at, most in ends)
        low = tuple(min(a, b * n) for a, b in zip(low, coarse_begin, strict=True))
        grown = zip(high, coarse_end, shape, strict=True)
        high = tuple(min(max(a, b * n), most) for a, b, most in grown)
        values = self._level(level, begin, end, low, high)
        self._values, self._begin = values, low
        padded = _padded(values, low, first, last, size, border)
        self._cut(padded, node, exact)
        if level == 0:
            smallest = largest = padded
        elif level < self._by_brick:
            smallest, largest = (
                _padded(one, tuple(at // n**level for at in self._low), first, last, size, border)
                for one in self._pooled(level)
            )
        inner = padded[tuple(slice(border, s - border) for s in padded.shape[:3])]
        mean = reduce_windows(inner, middle_of(self.how), size=size, step=size)
        if level < self._by_brick:
            both = {"size": size + 2 * border, "step": size}
            ranges = [
                reduce_windows(smallest, "min", **both),
                reduce_windows(largest, "max", **both),
            ]
        else:
            cut = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
            wide = border * n**level // size
            smallest, largest = self._own_ranges
            ranges = [
                by_node(smallest, "min", n**level, wide)[cut],
                by_node(largest, "max", n**level, wide)[cut],
            ]
        flat = [torch.from_numpy(part.astype(np.float32)).flatten(0, 2) for part in (*ranges, mean)]
        return NodeSummary(*flat)

    def _level(self, level: int, begin: Place, end: Place, low: Place, high: Place) -> np.ndarray:
        """Returns voxels low to high of a level, begin to end of them made from the one before."""
        n = self.tree.branching
        if level == 0:
            return to_numpy(self.tree.read(self.name, 0, low, high))
        assert self._values is not None
        before = self.tree.shape(level - 1)
        ends = zip(end, before, self._begin, strict=True)
        cut = tuple(
            slice(a * n - at, min(b * n, most) - at)
            for a, (b, most, at) in zip(begin, ends, strict=True)
        )
        dtype = self.tree.bricks.bricks[self.name].dtype
        told = self.how, n, dtype, self.spacing, level
        made = coarser(self._values[cut], *told, empty=self.empty)
        if (low, high) == (begin, end):
            return made
        values = to_numpy(self.tree.read(self.name, level, low, high))
        at = (slice(a - z, b - z) for a, b, z in zip(begin, end, low, strict=True))
        values[tuple(at)] = made
        return values

    def _pooled(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the smallest and largest finest value of a level's voxels, near what changes."""
        if level == 1:
            self._extremes = (to_numpy(self.tree.read(self.name, 0, self._low, self._high)),) * 2
        low, high = self._extremes
        n = self.tree.branching
        self._extremes = (pool_min(low, n), pool_max(high, n))
        return self._extremes

    @cached_property
    def _own_ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and largest voxel of each finest brick without its border, (z, y, x, c)."""
        tree, size, border = self.tree, self.tree.bricks.brick_size, self.tree.bricks.border
        held = tree.bricks.bricks[self.name].detach()
        grid = tuple(-(-n // size) for n in tree.extent)
        node, exact = tree.find(_places((0, 0, 0), grid, held.device), 0)
        slot = torch.where(exact, tree.slot_n[node], -1)
        constant = movable(tree.nodes.constants[self.name]).flatten(0, 1)[node]
        low = constant.view(held.dtype).to(torch.float32)
        high, inner = low.clone(), slice(border, border + size)
        for part in (slot >= 0).nonzero()[:, 0].split(_BATCH):
            bricks = movable(held)[slot[part]].view(held.dtype)
            voxels = bricks[:, inner, inner, inner].to(torch.float32).flatten(1, 3)
            low[part], high[part] = torch.aminmax(voxels, dim=1)
        smallest, largest = (ends.view(*grid, -1).cpu().numpy() for ends in (low, high))
        return smallest, largest

    def _cut(self, padded: np.ndarray, node: Tensor, exact: Tensor) -> None:
        """Writes the bricks (with borders) of nodes (k,), whose voxels lie in `padded` in order."""
        size, border = self.tree.bricks.brick_size, self.tree.bricks.border
        held = self.tree.bricks.bricks[self.name].detach()
        slot = torch.where(exact, self.tree.slot_n[node], -1)
        side = size + 2 * border
        level = movable(from_grid(padded, held.dtype))
        windows = level.unfold(0, side, size).unfold(1, side, size).unfold(2, side, size)
        grid = windows.shape[:3]
        for part in (slot >= 0).nonzero()[:, 0].split(_BATCH):
            index = torch.unravel_index(part.cpu(), grid)
            bricks = windows[index].permute(0, 2, 3, 4, 1)  # (k, z, y, x, c)
            movable(held)[slot[part]] = bricks.to(held.device)


def _owned(words: Tensor, owner: Tensor) -> Tensor:
    """Returns (t * n,) int64 what each node's word points to, or else the slot that it owns."""
    found = words.flatten().to(torch.int64).clamp(min=-1)
    slot = (owner >= 0).nonzero()[:, 0]
    mine = owner[slot].to(torch.int64)
    lacks = found[mine] < 0
    found[mine[lacks]] = slot[lacks]
    return found


def _places(first: Place, count: Place, device: torch.device) -> Tensor:
    """Returns (k, 3) int64 z y x of a grid, in order."""
    axes = [torch.arange(a, a + k, device=device) for a, k in zip(first, count, strict=True)]
    return torch.cartesian_prod(*axes).view(-1, 3)


def _padded(
    values: np.ndarray, low: Place, first: Place, last: Place, size: int, border: int
) -> np.ndarray:
    """Returns the voxels of nodes `first` to `last` with their borders, from `values`, which begin
    at voxel `low`; the outermost voxels are repeated.
    """
    for axis, at in enumerate(low):
        begin, end = first[axis] * size - border - at, last[axis] * size + border - at
        here = max(0, begin)
        values = values[(slice(None),) * axis + (slice(here, end),)]
        values = extend(values, axis, here - begin, end - here - values.shape[axis])
    return values
