"""Part of the reference: descents to a node, marks, and samples of bricks, as csrc/tree.h, walk.h
and brick.h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ...base.constants import ABSENT, REQUEST_LOAD, REQUEST_PRIORITY, REQUEST_SUBDIVIDE
from ..arguments import TraceArguments
from .exact import clamp, divide, smaller
from .rays import INF


@dataclass
class Place:
    """Where a descent ended, and the two nodes whose bricks answer (-1: nobody)."""

    corner: Tensor  # (r, 3) of the box in which the answer stays the same
    size: Tensor  # (r,)
    depth: Tensor  # (r,)
    node: Tensor  # (r,) last node reached
    parent: Tensor  # (r,)
    hidden: Tensor  # (r,) bool: nothing in the node or below it is seen
    fine_node: Tensor  # (r,)
    fine_corner: Tensor  # (r, 3)
    fine_size: Tensor  # (r,)
    coarse_node: Tensor  # (r,)
    coarse_corner: Tensor  # (r, 3)
    coarse_size: Tensor  # (r,)


@dataclass
class Tree:
    """The node pool as flat words, and the numbers of one tree in it."""

    child_n: Tensor
    brick_n: Tensor
    request_n: Tensor
    stamp_t: Tensor
    stamp_b: Tensor
    frame: Tensor  # ()
    root_voxel: Tensor  # () world size of a depth-0 voxel
    branching: int
    nodes_per_tile: int
    root: int
    max_depth: int
    by_level: bool

    @classmethod
    def of(cls, a: TraceArguments, root_voxel: Tensor) -> Tree:
        """The tree of an op's arguments."""
        words = (a.child_tn.view(-1), a.brick_tn.view(-1), a.request_tn.view(-1))
        numbers = (a.branching, a.child_tn.shape[1], a.root, a.max_depth)
        return cls(*words, a.stamp_t, a.stamp_b, a.frame_1[0], root_voxel, *numbers, a.by_level)

    def voxel_at(self, depth: Tensor) -> Tensor:
        """World size of a voxel at each depth."""
        voxel = self.root_voxel.expand(depth.shape)
        for level in range(self.max_depth):
            voxel = torch.where(depth > level, divide(voxel, self.branching, voxel), voxel)
        return voxel

    def mark(
        self, found: Place, wanted: Tensor, blends: Tensor, cone: Tensor, seen: Tensor
    ) -> Tensor:
        """Stamps the bricks that answer where something is seen; requests what is not there, and
        returns (r,) bool whether it did.

        Straight to the wanted level, or level by level: then a brick is there before its node is
        subdivided.
        """
        for node in (found.fine_node, found.coarse_node):
            slot = torch.where(seen & (node >= 0), self.brick_n[node.clamp(min=0)], -1)
            self.stamp_b[torch.unique(slot[slot >= 0]).to(torch.int64)] = self.frame
        absent = self.brick_n[found.node] == ABSENT
        deeper = (found.depth < wanted) & (self.child_n[found.node] == ABSENT)
        short = seen & deeper & ~(self.by_level & absent)
        missing = seen & absent & (self.by_level | ~deeper | (found.fine_node < 0))
        parent = found.parent.clamp(min=0)
        above = seen & blends & (found.depth == wanted) & (self.brick_n[parent] == ABSENT)
        self.request(found.node[short], found.depth[short], cone[short], REQUEST_SUBDIVIDE)
        self.request(found.node[missing], found.depth[missing], cone[missing], REQUEST_LOAD)
        self.request(parent[above], found.depth[above] - 1, cone[above], REQUEST_LOAD)
        return short | missing | above

    def request(self, node: Tensor, depth: Tensor, cone: Tensor, kind: int) -> None:
        """Joins wishes into the request words: kinds by OR, priorities by maximum.

        The priority is the width of one voxel of the node on the screen in sixteenths of a pixel.
        """
        priority = torch.where(cone > 0, self.voxel_at(depth) / cone * 16, REQUEST_PRIORITY)
        priority = torch.where(priority < REQUEST_PRIORITY, priority, REQUEST_PRIORITY)
        wished, inverse = torch.unique(node, return_inverse=True)
        most = torch.zeros_like(wished, dtype=torch.int32)
        most.scatter_reduce_(0, inverse, priority.to(torch.int32), "amax")
        word = self.request_n[wished]
        kinds = (word & ~REQUEST_PRIORITY) | kind
        self.request_n[wished] = kinds | torch.maximum(word & REQUEST_PRIORITY, most)


def descend(
    position_r3: Tensor, wanted_r: Tensor, tree: Tree, hides: Callable[[Tensor], Tensor]
) -> Place:
    """Descends from the root to the wanted depth, or as far as tiles exist and something is seen;
    stamps the tiles.
    """
    n = tree.branching
    local, corner = position_r3, torch.zeros_like(position_r3)
    size = torch.ones_like(position_r3[:, 0])
    node = torch.full_like(wanted_r, tree.root)
    nobody = torch.full_like(node, -1)
    place = Place(
        *(corner, size, torch.zeros_like(node), node, nobody, hides(node)),
        *(nobody, corner, size, nobody, corner, size),
    )
    going = torch.ones_like(node, dtype=torch.bool)
    for _ in range(tree.max_depth + 1):
        tree.stamp_t[torch.unique(place.node[going] // tree.nodes_per_tile)] = tree.frame
        answers = going & (tree.brick_n[place.node] != ABSENT)
        place.fine_node = torch.where(answers, place.node, place.fine_node)
        place.fine_corner = torch.where(answers[:, None], place.corner, place.fine_corner)
        place.fine_size = torch.where(answers, place.size, place.fine_size)
        above = answers & (place.depth < wanted_r)
        place.coarse_node = torch.where(above, place.node, place.coarse_node)
        place.coarse_corner = torch.where(above[:, None], place.corner, place.coarse_corner)
        place.coarse_size = torch.where(above, place.size, place.coarse_size)

        tile = tree.child_n[place.node].to(torch.int64)
        going = going & (place.depth < wanted_r) & (tile >= 0) & ~place.hidden
        if not going.any():
            break
        size = divide(place.size, n, place.size)
        scaled = local * n
        digit = clamp(torch.floor(scaled), 0, n - 1)
        x, y, z = digit.to(torch.int64).unbind(1)
        child = (z * n + y) * n + x
        moved = place.corner + digit * size[:, None]
        local = torch.where(going[:, None], scaled - digit, local)
        place.corner = torch.where(going[:, None], moved, place.corner)
        place.size = torch.where(going, size, place.size)
        place.parent = torch.where(going, place.node, place.parent)
        place.node = torch.where(going, tile * tree.nodes_per_tile + child, place.node)
        place.depth = torch.where(going, place.depth + 1, place.depth)
        place.hidden = torch.where(going, hides(place.node), place.hidden)
    return place


def wanted_depth(cone: Tensor, tree: Tree) -> tuple[Tensor, Tensor, Tensor]:
    """Level of detail: the first depth whose voxel fits the cone, its voxel, and the voxel
    above."""
    voxel = tree.root_voxel.expand(cone.shape)
    above = torch.full_like(cone, INF)
    wanted = torch.zeros_like(cone, dtype=torch.int64)
    for _ in range(tree.max_depth):
        deeper = voxel > cone
        above = torch.where(deeper, voxel, above)
        wanted = torch.where(deeper, wanted + 1, wanted)
        voxel = torch.where(deeper, divide(voxel, tree.branching, voxel), voxel)
    return wanted, voxel, above


@dataclass
class Bricks:
    """One component of one channel."""

    bricks_bzyxc: Tensor
    constant_nc: Tensor
    range_n2c: Tensor
    border: int
    component: int

    @classmethod
    def of(cls, a: TraceArguments) -> Bricks:
        """The channel of an op's arguments."""
        values = a.constant_tnc.flatten(0, 1), a.range_tn2c.flatten(0, 1)
        return cls(a.bricks_bzyxc, *values, a.border, a.component)

    def ends(self, node: Tensor, real: torch.dtype) -> tuple[Tensor, Tensor]:
        """(r,) smallest and largest value in reach of the nodes' bricks, and of the nodes below."""
        low, high = self.range_n2c[node, :, self.component].to(real).unbind(1)
        return low, high

    def sample(
        self,
        brick_n: Tensor,
        node: Tensor,
        corner: Tensor,
        size: Tensor,
        origin_r3: Tensor,
        direction_r3: Tensor,
        t: Tensor,
        shift: tuple[float, float, float] = (0, 0, 0),
    ) -> Tensor:
        """Trilinear value of each ray's node at distance t, `shift` voxels beside the ray; its
        constant where it has no brick.
        """
        real, known = origin_r3.dtype, node.clamp(min=0)
        constant = torch.where(node >= 0, self.constant_nc[known, self.component].to(real), 0.0)
        slot = torch.where(node >= 0, brick_n[known].to(torch.int64), -1)
        if self.bricks_bzyxc.shape[0] == 0:
            return constant
        side = self.bricks_bzyxc.shape[1]
        scale = divide(side - 2 * self.border, size, size)
        offset = (origin_r3 - corner) * scale[:, None] + (self.border - 0.5)
        place = offset + t[:, None] * (direction_r3 * scale[:, None])
        place = torch.stack(
            [p + d if d else p for p, d in zip(place.unbind(1), shift, strict=True)], 1
        )
        place = clamp(place, 0, side - 1)
        cell = smaller(torch.floor(place), torch.full_like(place, side - 2))
        wx, wy, wz = (place - cell).unbind(1)
        x, y, z = cell.to(torch.int64).unbind(1)
        brick = slot.clamp(min=0)

        def voxel(dx: int, dy: int, dz: int) -> Tensor:
            found = self.bricks_bzyxc[brick, z + dz, y + dy, x + dx, self.component]
            return found.to(real)

        def row(dy: int, dz: int) -> Tensor:
            left, right = voxel(0, dy, dz), voxel(1, dy, dz)
            return left + wx * (right - left)

        def plane(dz: int) -> Tensor:
            low, high = row(0, dz), row(1, dz)
            return low + wy * (high - low)

        near, far = plane(0), plane(1)
        return torch.where(slot >= 0, near + wz * (far - near), constant)
