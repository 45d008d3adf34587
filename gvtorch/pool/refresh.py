"""`BrickLevels`: reads the levels of a resident tree from its bricks; and, after the finest bricks
were edited, recomputes what depends on them: borders, coarse levels, regions and ranges.

The filters are those of pyramid.py, so the bits are those of a newly built tree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..base.constants import ABSENT, CONSTANT, EMPTY, TERMINAL
from ..base.downsample import by_node, extend, from_grid, pool_max, pool_min, reduce_windows
from ..base.volume import movable, to_numpy
from .pools import BrickPool, NodePool
from .pyramid import NodeSummary, coarser, constant_and_empty, node_reduction

_BATCH_BRICKS = 4096  # bricks read or written at a time
GridPosition = tuple[int, ...]  # voxels or nodes of a level, z y x


class Span(NamedTuple):
    """A box of voxels or nodes of a level: from `first` up to, and without, `end`."""

    first: GridPosition
    end: GridPosition

    @property
    def shape(self) -> GridPosition:
        """Its size along each axis."""
        return tuple(b - a for a, b in zip(*self, strict=True))

    def divided(self, n: int) -> Span:
        """Returns the cells of n^3 that hold any of it."""
        return Span(tuple(a // n for a in self.first), tuple(-(-b // n) for b in self.end))

    def scaled(self, n: int) -> Span:
        """Returns what cells of n^3 hold."""
        return Span(tuple(a * n for a in self.first), tuple(b * n for b in self.end))

    def grown(self, margin: int) -> Span:
        """Returns it with a margin on all sides."""
        return Span(tuple(a - margin for a in self.first), tuple(b + margin for b in self.end))

    def within(self, shape: GridPosition) -> Span:
        """Returns the part that lies in a level of this shape."""
        first = tuple(max(0, a) for a in self.first)
        return Span(first, tuple(min(b, size) for b, size in zip(self.end, shape, strict=True)))

    def joined(self, other: Span) -> Span:
        """Returns the smallest box that holds both."""
        return Span(tuple(map(min, self.first, other.first)), tuple(map(max, self.end, other.end)))

    def slices(self, origin: GridPosition = (0, 0, 0)) -> tuple[slice, ...]:
        """Returns where it lies in an array that begins at `origin`."""
        return tuple(slice(a - o, b - o) for a, b, o in zip(*self, origin, strict=True))


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

    def read(self, channel: str, level: int, voxels: Span) -> Tensor:
        """Returns voxels (z, y, x, c) of a level, on the CPU. A region without a brick is filled
        with its constant: for EMPTY ones that is their mean.
        """
        size, border = self.bricks.brick_size, self.bricks.border
        nodes = voxels.divided(size)
        stored = self.bricks.bricks[channel].detach()
        bricks, constants = movable(stored), movable(self.nodes.constants[channel]).flatten(0, 1)
        node, exact = self.find(_grid_positions(nodes, bricks.device), level)
        slot = torch.where(exact, self.slot_n[node], -1)
        inner = slice(border, border + size)
        out = bricks.new_empty((len(node), size, size, size, bricks.shape[4]))
        for part in torch.arange(len(node), device=bricks.device).split(_BATCH_BRICKS):
            has_brick = slot[part] >= 0
            out[part[~has_brick]] = constants[node[part[~has_brick]]][:, None, None, None]
            out[part[has_brick]] = bricks[slot[part[has_brick]]][:, inner, inner, inner]
        grid = out.view(*nodes.shape, size, size, size, -1).permute(0, 3, 1, 4, 2, 5, 6)
        box = grid.reshape(*nodes.scaled(size).shape, -1)
        box = box[voxels.slices(nodes.scaled(size).first)]
        return box.contiguous().cpu().view(stored.dtype)

    def refresh(
        self,
        changed: Span,
        filters: Mapping[str, str],
        empty: Mapping[str, float | None],
        spacing: tuple[float, float, float],
        threshold: float | None,
    ) -> None:
        """Recomputes what depends on the `changed` ones of the finest voxels.

        Args:
            changed: z y x.
            filters: For each channel, see `Volume.filter`.
            empty: For channels of labels, the value of the background.
            spacing: (x, y, z) of the finest voxels.
            threshold: See `N3Tree.from_volume`.
        """
        if any(how != "mean" for how in filters.values()):  # constants may be no coarse voxels
            changed = Span((0, 0, 0), self.extent)
        levels = []  # of each: the voxels that change, and the nodes that hold any of these
        for level in range(self.depth + 1):
            reach = changed.grown(self.bricks.border).within(self.shape(level))
            levels.append((changed, reach.divided(self.bricks.brick_size)))
            changed = changed.divided(self.branching)
        nodes_by_level = [nodes for _, nodes in levels]
        channels = [
            _ChannelLevels(self, name, how, spacing, empty.get(name), nodes_by_level)
            for name, how in filters.items()
        ]
        for level, (changed, nodes) in enumerate(levels):
            position_k3 = _grid_positions(nodes, self.nodes.child_tn.device)
            node, exact = self.find(position_k3, level)
            summaries = {
                channel.name: channel.update(level, changed, nodes, node, exact)
                for channel in channels
            }
            self._write(summaries, node, exact, threshold)

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
        masks = constant_and_empty(summaries.values(), threshold)
        constant, empty = (mask.to(device) for mask in masks)
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
    nodes_by_level: Sequence[Span]  # whose content is needed

    def __post_init__(self) -> None:
        tree, size, border = self.tree, self.tree.bricks.brick_size, self.tree.bricks.border
        self._size, self._border = size, border
        steps = [tree.branching**level for level in range(len(self.nodes_by_level))]
        # From this level on, a border spans whole finest bricks: their ranges are enough.
        whole_levels = (level for level, step in enumerate(steps) if border * step % size == 0)
        self._by_brick = next(whole_levels, len(steps))
        self._values = np.empty(0)  # of the previous level
        self._first: GridPosition = (0, 0, 0)  # their first voxel
        # Finest voxels in reach of the nodes of the levels before, in whole voxels of these levels.
        self._finest: Span | None = None
        for level in range(1, self._by_brick):
            in_reach = self.nodes_by_level[level].scaled(size).grown(border).scaled(steps[level])
            self._finest = in_reach if self._finest is None else self._finest.joined(in_reach)
        if self._finest is not None:
            coarsest = steps[self._by_brick - 1]
            aligned = self._finest.divided(coarsest).scaled(coarsest)
            self._finest = aligned.within(tree.extent)

    def update(
        self, level: int, changed: Span, nodes: Span, node: Tensor, exact: Tensor
    ) -> NodeSummary:
        """Writes the bricks of a level's `nodes`, of which `changed` voxels have changed; returns
        the summaries (k, c) of these nodes (k,).
        """
        self._make_level(level, changed, nodes)
        padded = self._with_borders(self._values, self._first, nodes)
        self._write_bricks(padded, node, exact)
        inner = padded[tuple(slice(self._border, side - self._border) for side in padded.shape[:3])]
        mean = reduce_windows(inner, node_reduction(self.how), size=self._size, step=self._size)
        parts = (*self._ranges(level, nodes, padded), mean)
        flat = [torch.from_numpy(part.astype(np.float32)).flatten(0, 2) for part in parts]
        return NodeSummary(*flat)

    def _make_level(self, level: int, changed: Span, nodes: Span) -> None:
        """Makes the voxels of a level's nodes and borders, and those that the next level is made
        of: the changed ones from the level before, others are read.
        """
        tree, n = self.tree, self.tree.branching
        shape = tree.shape(level)
        needed = nodes.scaled(self._size).grown(self._border).joined(changed.divided(n).scaled(n))
        needed = needed.within(shape)
        if level == 0 or needed != changed:
            values = to_numpy(tree.read(self.name, level, needed))
        if level > 0:
            source = changed.scaled(n).within(tree.shape(level - 1)).slices(self._first)
            dtype = tree.bricks.bricks[self.name].dtype
            arguments = self.how, n, dtype, self.spacing, level
            coarse = coarser(self._values[source], *arguments, empty=self.empty)
            if needed == changed:
                values = coarse
            else:
                values[changed.slices(needed.first)] = coarse
        self._values, self._first = values, needed.first

    def _with_borders(self, values: np.ndarray, first: GridPosition, nodes: Span) -> np.ndarray:
        """Returns the voxels of nodes with their borders, from `values`, which begin at voxel
        `first`; the outermost voxels are repeated.
        """
        for axis, part in enumerate(nodes.scaled(self._size).grown(self._border).slices(first)):
            inside = max(0, part.start)
            values = values[(slice(None),) * axis + (slice(inside, part.stop),)]
            after = part.stop - inside - values.shape[axis]
            values = extend(values, axis, inside - part.start, after)
        return values

    def _ranges(self, level: int, nodes: Span, padded: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the smallest and the largest finest value in reach of a level's nodes, whose
        voxels with their borders are `padded`.
        """
        n = self.tree.branching**level
        if level >= self._by_brick:
            low, high = self._brick_ranges
            reach, in_level = self._border * n // self._size, nodes.slices()
            return by_node(low, "min", n, reach)[in_level], by_node(high, "max", n, reach)[in_level]
        low = high = padded
        if level > 0:
            assert self._finest is not None
            first, extremes = self._finest.divided(n).first, self._finest_extremes(level)
            low, high = (self._with_borders(values, first, nodes) for values in extremes)
        windows = {"size": self._size + 2 * self._border, "step": self._size}
        return reduce_windows(low, "min", **windows), reduce_windows(high, "max", **windows)

    def _finest_extremes(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the smallest and largest finest value of a level's voxels, near what changes."""
        if level == 1:
            assert self._finest is not None
            self._extremes = (to_numpy(self.tree.read(self.name, 0, self._finest)),) * 2
        low, high = self._extremes
        n = self.tree.branching
        self._extremes = (pool_min(low, n), pool_max(high, n))
        return self._extremes

    @cached_property
    def _brick_ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """The smallest and largest voxel of each finest brick without its border, (z, y, x, c)."""
        tree = self.tree
        stored = tree.bricks.bricks[self.name].detach()
        finest = Span((0, 0, 0), tree.extent).divided(self._size)
        node, exact = tree.find(_grid_positions(finest, stored.device), 0)
        slot = torch.where(exact, tree.slot_n[node], -1)
        constant = movable(tree.nodes.constants[self.name]).flatten(0, 1)[node]
        low = constant.view(stored.dtype).to(torch.float32)
        high, inner = low.clone(), slice(self._border, self._border + self._size)
        for part in (slot >= 0).nonzero()[:, 0].split(_BATCH_BRICKS):
            bricks = movable(stored)[slot[part]].view(stored.dtype)
            voxels = bricks[:, inner, inner, inner].to(torch.float32).flatten(1, 3)
            low[part], high[part] = torch.aminmax(voxels, dim=1)
        grid = (*finest.shape, -1)
        return low.view(grid).cpu().numpy(), high.view(grid).cpu().numpy()

    def _write_bricks(self, padded: np.ndarray, node: Tensor, exact: Tensor) -> None:
        """Writes the bricks (with borders) of nodes (k,), whose voxels lie in `padded` in order."""
        stored = self.tree.bricks.bricks[self.name].detach()
        slot = torch.where(exact, self.tree.slot_n[node], -1)
        size, side = self._size, self._size + 2 * self._border
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


def _grid_positions(span: Span, device: torch.device) -> Tensor:
    """Returns (k, 3) int64 z y x of all positions in a box, in order."""
    axes = [torch.arange(a, b, device=device) for a, b in zip(*span, strict=True)]
    return torch.cartesian_prod(*axes).view(-1, 3)
