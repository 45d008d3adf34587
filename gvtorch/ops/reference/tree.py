"""Part of the torch twin: descents, marks, samples of bricks, as in csrc/walk/tree.h, brick.h."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from ...base.constants import ABSENT, REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from ..arguments import TraceArguments
from .exact import clamp, smaller
from .rays import INF, Beam, Rows


class Levels:
    """Sizes and numbers of the nodes and voxels of each depth."""

    def __init__(self, args: TraceArguments, real: torch.dtype) -> None:
        counts = [float(args.branching**depth) for depth in range(args.max_depth + 1)]
        self.branching, self.border = args.branching, args.border
        self.count_d = torch.tensor(counts, dtype=torch.float64, device=args.place_33.device)
        # (d,) nodes along a side of the root cube, and the side of a node in tree units
        self.size_d = 1 / self.count_d
        self.finest_d = self.count_d.flip(0).to(torch.int64)  # nodes of the largest depth a side
        brick_size = args.bricks_bzyxc.shape[1] - 2 * args.border
        self.scale_d = (brick_size * self.count_d).to(real)  # (d,) voxels a tree unit
        # (d,) side of a voxel, world units
        self.voxel_d = (args.root_voxel / self.count_d).to(real)

    def wanted(self, cone: Tensor) -> Tensor:
        """Returns (r,) the first depths whose voxels are not wider than the cone (the lod)."""
        return (self.voxel_d[:-1] > cone[:, None]).sum(1)

    def voxels(self, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (r,) voxel sizes at each depth, and at the one above (+inf above the root)."""
        voxel_above = torch.where(depth > 0, self.voxel_d[(depth - 1).clamp(min=0)], INF)
        return self.voxel_d[depth], voxel_above

    def finest_cells(self, position_r3: Tensor) -> Tensor:
        """Returns (r, 3) int64 x, y, z of the nodes of the largest depth around float64 positions:
        the argument `finest` of the methods below.
        """
        return torch.floor(position_r3 * self.count_d[-1]).to(torch.int64)

    def cells(self, finest: Tensor, depth: Tensor) -> Tensor:
        """Returns (r, 3) int64 x, y, z of the nodes at a depth (r,) that contain the finest."""
        return finest // self.finest_d[depth, None]

    def corners(self, finest: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (r, 3) float64 low and high corners of the same nodes."""
        cell, size = self.cells(finest, depth), self.size_d[depth, None]
        return cell * size, (cell + 1) * size

    def holder(
        self, node: Tensor, brick: Tensor, depth: Tensor, finest: Tensor, beam: Beam
    ) -> Holder:
        """Returns nodes (r,), with brick words, at a depth, and where the rays lie in them."""
        corner = self.cells(finest, depth) * self.size_d[depth, None]
        scale = self.scale_d[depth]
        start = (beam.exact_origin - corner).to(scale) * scale[:, None] + (self.border - 0.5)
        return Holder(node, brick, depth, scale, start, beam.direction * scale[:, None])


@dataclass
class Holder(Rows):
    """A node that holds data, its brick, and where a ray lies in it."""

    node: Tensor  # (r,) int64; -1: none holds data
    brick: Tensor  # (r,) int64 slot, or the node's brick word below 0
    depth: Tensor  # (r,) int64
    scale: Tensor  # (r,) voxels a tree unit
    start: Tensor  # (r, 3) x, y, z where the ray begins, in voxels from the brick's first centre
    direction: Tensor  # (r, 3) voxels per world unit

    def at(self, t: Tensor) -> Tensor:
        """Returns (r, 3) x, y, z at distances t (r,), in voxels from the brick's first centre."""
        return self.start + t[:, None] * self.direction


@dataclass
class Descent:
    """Where a descent ended, and the two nodes whose data is used (-1: none)."""

    node: Tensor  # (r,) last node reached
    depth: Tensor  # (r,) its depth
    parent: Tensor  # (r,)
    hidden: Tensor  # (r,) bool: nothing in the node or below it is seen
    fine: Tensor  # (r,) the deepest node on the path whose brick word is not ABSENT
    fine_depth: Tensor  # (r,)
    coarse: Tensor  # (r,) the deepest such node above the wanted depth
    coarse_depth: Tensor  # (r,)


class Tree:
    """The tree of an op's arguments, with the node pool as flat words."""

    def __init__(self, args: TraceArguments) -> None:
        self.arguments, self.levels = args, Levels(args, args.table_lm4.dtype)
        # A word that names a tile or slot beyond the pool counts as absent.
        child, brick = args.child_tn, args.brick_tn
        self.child_n, self.brick_n = (
            torch.where(word < count, word, ABSENT).view(-1).to(torch.int64)
            for word, count in ((child, len(child)), (brick, len(args.bricks_bzyxc)))
        )
        self.request_n, self.per_tile = args.request_tn.view(-1), args.child_tn.shape[1]

    def descend(self, finest: Tensor, wanted: Tensor, hides: Callable[[Tensor], Tensor]) -> Descent:
        """Descends to the wanted depth, or as far as tiles exist and are seen; stamps the tiles."""
        args, n = self.arguments, self.levels.branching
        node, zero = torch.full_like(wanted, args.root), torch.zeros_like(wanted)
        absent = torch.full_like(node, -1)
        descent = Descent(node, zero, absent, hides(node), absent, zero, absent, zero)
        active = torch.ones_like(node, dtype=torch.bool)
        for depth in itertools.count():  # all nodes that are still active have this depth
            goes_deeper = wanted > depth
            args.stamp_t[descent.node[active] // self.per_tile] = args.frame_1[0]
            has_data = active & (self.brick_n[descent.node] != ABSENT)
            descent.fine = torch.where(has_data, descent.node, descent.fine)
            descent.fine_depth = torch.where(has_data, depth, descent.fine_depth)
            above_wanted = has_data & goes_deeper
            descent.coarse = torch.where(above_wanted, descent.node, descent.coarse)
            descent.coarse_depth = torch.where(above_wanted, depth, descent.coarse_depth)

            tile = self.child_n[descent.node]
            active = active & goes_deeper & (tile >= 0) & ~descent.hidden
            if not active.any():
                break
            x, y, z = (finest // n ** (args.max_depth - depth - 1) % n).unbind(1)
            child = tile * self.per_tile + (z * n + y) * n + x
            descent.parent = torch.where(active, descent.node, descent.parent)
            descent.node = torch.where(active, child, descent.node)
            descent.depth = torch.where(active, depth + 1, descent.depth)
            descent.hidden = torch.where(active, hides(descent.node), descent.hidden)
        return descent

    def holder(self, node: Tensor, depth: Tensor, finest: Tensor, beam: Beam) -> Holder:
        """Returns nodes (r,), or -1, at a depth, and where the rays lie in them."""
        brick = torch.where(node >= 0, self.brick_n[node.clamp(min=0)], ABSENT)
        return self.levels.holder(node, brick, depth, finest, beam)

    def mark_missing(
        self, descent: Descent, wanted: Tensor, blends: Tensor, cone: Tensor, visible: Tensor
    ) -> Tensor:
        """Requests absent tiles and bricks where something is seen, straight to the wanted level or
        level by level; returns (r,) bool: the ray made a request.
        """
        by_level, absent = self.arguments.by_level, self.brick_n[descent.node] == ABSENT
        node, depth = descent.node, descent.depth
        deeper = (depth < wanted) & (self.child_n[node] == ABSENT)
        needs_tile = visible & deeper & ~(by_level & absent)
        needs_brick = visible & absent & (by_level | ~deeper | (descent.fine < 0))
        parent = descent.parent.clamp(min=0)
        needs_parent = visible & blends & (depth == wanted) & (self.brick_n[parent] == ABSENT)
        self.request(needs_tile, node, depth, cone, REQUEST_SUBDIVIDE)
        self.request(needs_brick, node, depth, cone, REQUEST_LOAD)
        self.request(needs_parent, parent, depth - 1, cone, REQUEST_LOAD)
        return needs_tile | needs_brick | needs_parent

    def stamp(self, brick: Tensor) -> None:
        """Stamps brick slots as used in this frame; words below 0 are no slots."""
        args = self.arguments
        args.stamp_b[brick[brick >= 0]] = args.frame_1[0]

    def request(self, mask: Tensor, node: Tensor, depth: Tensor, cone: Tensor, kind: int) -> None:
        """Joins requests, where `mask` (r,) is true, into words: kinds by OR, priorities by
        maximum. A priority is a voxel's width on the screen in 1/16 pixel, up to 128 pixels.
        """
        if not mask.any():
            return
        node, cone, voxel = node[mask], cone[mask], self.levels.voxel_d[depth[mask]]
        priority = torch.where(cone > 0, voxel / cone * 16, REQUEST_PRIORITY)
        priority = torch.where(priority < REQUEST_PRIORITY, priority, REQUEST_PRIORITY)
        requested, inverse = torch.unique(node, return_inverse=True)
        highest = torch.zeros_like(requested, dtype=torch.int16)
        highest.scatter_reduce_(0, inverse, priority.to(torch.int16), "amax")
        word = self.request_n[requested]
        kinds = (word & ~REQUEST_PRIORITY) | kind
        self.request_n[requested] = kinds | torch.maximum(word & REQUEST_PRIORITY, highest)


@dataclass
class ChannelBricks:
    """A channel, and which of a voxel's numbers is read: its component."""

    bricks_bzyxc: Tensor
    constant_nc: Tensor
    range_n2c: Tensor
    border: int
    component: int

    @classmethod
    def of(cls, args: TraceArguments) -> Self:
        constant_nc, range_n2c = args.constant_tnc.flatten(0, 1), args.range_tn2c.flatten(0, 1)
        return cls(args.bricks_bzyxc, constant_nc, range_n2c, args.border, args.component)

    def other(self, bricks: Tensor | None, constants: Tensor | None, component: int) -> Self | None:
        """Returns another channel of the same nodes; None where there is none."""
        if bricks is None:
            return None
        if constants is None:  # a coarse channel, whose constants are never used
            constants = bricks.new_zeros((1, len(self.constant_nc), bricks.shape[4]))
        constant_nc = constants.flatten(0, 1)
        return replace(self, bricks_bzyxc=bricks, constant_nc=constant_nc, component=component)

    def value_range(self, node: Tensor | slice, real: torch.dtype) -> tuple[Tensor, Tensor]:
        """Returns (r,) smallest and largest values in reach of bricks of the nodes and below."""
        low, high = self.range_n2c[node, :, self.component].to(real).unbind(1)
        return low, high

    def same(self, a: Tensor, b: Tensor) -> Tensor:
        """Returns (r,) bool: two nodes have the same constant."""
        constant = self.constant_nc[:, self.component]
        return constant[a] == constant[b]

    def constants(self, holder: Holder, real: torch.dtype) -> Tensor:
        """Returns (r, c) constants of nodes, 0 where there is no node."""
        constant_rc = self.constant_nc[holder.node.clamp(min=0)].to(real)
        return torch.where(holder.node[:, None] >= 0, constant_rc, 0.0)

    def sample(self, holder: Holder, t: Tensor, shift: Tensor | float = 0.0) -> Tensor:
        """Returns (r,) values of the component, or (..., r); see `samples`."""
        c = slice(self.component, self.component + 1)
        bricks, constants = self.bricks_bzyxc[..., c], self.constant_nc[:, c]
        single = replace(self, bricks_bzyxc=bricks, constant_nc=constants)
        return single.samples(holder, t, shift)[..., 0]

    def samples(self, holder: Holder, t: Tensor, shift: Tensor | float = 0.0) -> Tensor:
        """Returns (r, c) trilinear values at distances t (r,); the node's constants where it has no
        brick, 0 where there is no node. `shift` (..., 1, 3) voxels, if given, is added to
        positions; the result is then (..., r, c).
        """
        real, side = t.dtype, self.bricks_bzyxc.shape[1]
        constant, position = self.constants(holder, real), holder.at(t) + shift
        if self.bricks_bzyxc.shape[0] == 0:
            return constant.expand(*position.shape[:-1], -1)
        position = clamp(position, 0, side - 1)
        cell = smaller(torch.floor(position), torch.full_like(position, side - 2))
        wx, wy, wz = (position - cell)[..., None].unbind(-2)
        pair = torch.arange(2, device=t.device)[:, None]
        x, y, z = (cell.to(torch.int64)[..., None, :] + pair).unbind(-1)
        corners = (z[..., :, None, None], y[..., None, :, None], x[..., None, None, :])
        brick = holder.brick.clamp(min=0)[:, None, None, None]
        value_rzyxc = self.bricks_bzyxc[(brick, *corners)].to(real)
        left, right = value_rzyxc.unbind(-2)
        low, high = (left + wx[..., None, None] * (right - left)).unbind(-2)
        near, far = (low + wy[..., None] * (high - low)).unbind(-2)
        return torch.where(holder.brick[:, None] >= 0, near + wz * (far - near), constant)
