"""`Aliases`: nodes that share the content of other nodes, their targets, at all levels below. An
alias has no brick or children of its own: its words are copies of its target's, renewed after every
write, so that rays know nothing of it. What rays miss there is requested at the target.

A row of the list holds the locs of both nodes and is valid while the nodes have them, so that it
needs no update when tiles change hands. Where a target is not in the tree, its alias requests the
children of the target's nearest ancestor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ..base.constants import (
    ABSENT,
    REQUEST_KINDS,
    REQUEST_LOAD,
    REQUEST_PENDING_SHIFT,
    REQUEST_SUBDIVIDE,
    TERMINAL,
)
from ..base.volume import movable
from ..ops import unlink
from ..pool import BrickPool, N3Tree, NodePool

_LONGEST = 64  # longest chain of aliases of aliases


class AliasRows(NamedTuple):
    """The current aliases, sorted by node."""

    node: Tensor  # (a,) int64
    place: Tensor  # (a, 5) int64 number of its tree, and its loc
    goal: Tensor  # (a, 5) the same of the target
    target: Tensor  # (a,) int64 the target, or the node whose children are asked for
    target_place: Tensor  # (a, 5) the same of `target`; below another alias not `goal`
    exact: Tensor  # (a,) bool, whether `target` lies at `goal`

    def some(self, index: Tensor) -> AliasRows:
        """Returns some of the rows."""
        return AliasRows(*(field[index] for field in self))


class Aliases:
    """The aliases in a pair of pools.

    Attributes:
        trees: Trees by number.
        rows: The aliases.
    """

    rows: AliasRows

    def __init__(self, nodes: NodePool, bricks: BrickPool) -> None:
        """Starts without any."""
        self.nodes, self.bricks = nodes, bricks
        self.trees: dict[int, N3Tree] = {}
        self.clear()

    def clear(self, tree: int | None = None) -> None:
        """Forgets the aliases in a tree, and unlinks aliases of its nodes; None: forgets all."""
        if tree is not None and len(self):
            self.rows = rows = self.rows.some(self.rows.place[:, 0] != tree)
            stale = rows.node[(rows.goal[:, 0] == tree) | (rows.target_place[:, 0] == tree)]
            for words in (self.nodes.child_tn, self.nodes.brick_tn):
                words.view(-1)[stale] = ABSENT
            return
        device = self.nodes.child_tn.device
        none = torch.zeros((0, 5), dtype=torch.int64, device=device)
        one = none[:, 0]
        self.rows = AliasRows(one, none, none, one, none, one.bool())
        self._kept = one, one

    def __len__(self) -> int:
        """Number of aliases."""
        return len(self.rows.node)

    def add(self, node: Tensor, tree: int, place: Tensor, goal: Tensor, goal_tree: int) -> None:
        """Makes (k,) nodes of a tree, with locs `place` (k, 4), aliases of the nodes with locs
        `goal` (k, 4) in another tree or the same; `update` gives them their words.
        """
        known = ~torch.isin(self.rows.node, node)
        own, other = (
            torch.cat((torch.full_like(loc[:, :1], number), loc), 1)
            for number, loc in ((tree, place), (goal_tree, goal))
        )
        new = AliasRows(node, own, other, node, own, torch.zeros_like(node, dtype=torch.bool))
        both = [torch.cat(pair) for pair in zip(self.rows.some(known), new, strict=True)]
        order = both[0].argsort()
        self.rows = AliasRows(*(field[order] for field in both))

    def update(self) -> None:
        """Looks up targets that have gone, and copies the words of all targets to their aliases."""
        if not len(self):
            return
        rows = self.rows.some(self._stand(self.rows.node, self.rows.place))
        exact = rows.exact & self._stand(rows.target, rows.target_place)
        target = rows.target.clone()
        for number, tree in self.trees.items():
            lost = (~exact & (rows.goal[:, 0] == number)).nonzero()[:, 0]
            if len(lost):
                target[lost], exact[lost] = tree.nearest(rows.goal[lost, 1:])
        rows = rows._replace(target=target, exact=exact)
        bare = ~exact & (self.nodes.child_tn.view(-1)[target] == TERMINAL)
        whole = bare & (self.nodes.brick_tn.view(-1)[target] < ABSENT)  # EMPTY and CONSTANT regions
        stay = ~bare | whole  # others are requested in their own place
        rows = rows._replace(exact=exact | whole).some(stay)
        rows = self._followed(rows)
        self.rows = rows._replace(target_place=self._places(rows.target))
        self._copy(self.rows.some(self.rows.exact))
        self._copy_pending()
        self._kept = self._paths()

    def by_target(
        self, asked: Mapping[int, tuple[Tensor, Tensor]]
    ) -> dict[int, tuple[Tensor, Tensor]]:
        """Returns requests, by kind nodes (k,) and priorities (k,), with aliases replaced by their
        targets, each node once; pending ones are left out.
        """
        nodes, priorities, kinds = [], [], []
        for kind, (node, priority) in asked.items():
            row, known = self._row(node)
            nodes.append(torch.where(known, self.rows.target[row], node))
            priorities.append(priority)
            above = known & ~self.rows.exact[row]
            kinds.append(torch.where(above, REQUEST_SUBDIVIDE, kind))
        node, priority, kind_k = torch.cat(nodes), torch.cat(priorities), torch.cat(kinds)
        found = {}
        for kind in (REQUEST_LOAD, REQUEST_SUBDIVIDE):
            pending = self.nodes.request_tn.view(-1)[node] & kind << REQUEST_PENDING_SHIFT
            mine = (kind_k == kind) & (pending == 0)
            once, inverse = node[mine].unique(return_inverse=True)
            most = torch.zeros(len(once), dtype=priority.dtype, device=node.device)
            found[kind] = once, most.scatter_reduce(0, inverse, priority[mine], "amax")
        return found

    def keep(self, frame_1: Tensor) -> None:
        """Stamps the tiles on the path from the root to targets of aliases that may have been used
        in a frame, so that they stay; the host does not wait.
        """
        seen, tile = self._kept
        recording = tile.is_cuda and torch.cuda.is_current_stream_capturing()
        if not len(tile) or recording:  # tensors that a graph reads must stay, and these change
            return
        stamp = self.nodes.stamp_t
        used = torch.where(stamp[seen] == frame_1, frame_1, ABSENT)
        stamp.scatter_reduce_(0, tile, used, "amax")

    def __repr__(self) -> str:
        return f"Aliases({len(self)}, {int(self.rows.exact.sum())} with their targets)"

    def _row(self, node: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (k,) rows of nodes, and (k,) bool, which nodes have one."""
        held = self.rows.node
        row = torch.searchsorted(held, node).clamp(max=len(held) - 1)
        return row, held[row] == node

    def _places(self, node: Tensor) -> Tensor:
        """Returns (k, 5) tree numbers and locs of nodes."""
        number = self.nodes.tree_t[node // self.nodes.nodes_per_tile].to(torch.int64)
        place = torch.zeros((len(node), 4), dtype=torch.int64, device=node.device)
        for known, tree in self.trees.items():
            mine = (number == known).nonzero()[:, 0]
            place[mine] = tree.loc(node[mine])
        return torch.cat((number[:, None], place), 1)

    def _stand(self, node: Tensor, place: Tensor) -> Tensor:
        """Returns (k,) bool, which nodes are in a tree and still have their locs."""
        tile = node // self.nodes.nodes_per_tile
        roots = tile < len(self.trees)
        linked = (self.nodes.parent_t[tile] >= 0) | self.nodes.shared_t[tile] | roots
        return linked & (self._places(node) == place).all(1)

    def _followed(self, rows: AliasRows) -> AliasRows:
        """Returns the rows with targets that are not aliases; those that lead back to themselves
        are left out, and requested in their own place.
        """
        self.rows, target, exact = rows, rows.target, rows.exact
        if not len(self):
            return rows
        for _ in range(_LONGEST):
            row, known = self._row(target)
            if not bool(known.any()):
                return rows._replace(target=target, exact=exact)
            exact = torch.where(known, exact & rows.exact[row], exact)
            target = torch.where(known, rows.target[row], target)
        return self._followed(rows.some(~known))

    def _copy(self, rows: AliasRows) -> None:
        """Copies the words, constants and ranges of targets to their aliases."""
        nodes, bricks, node, target = self.nodes, self.bricks, rows.node, rows.target
        for pointer, owner, shared in (
            (nodes.child_tn, nodes.parent_t, nodes.shared_t),
            (nodes.brick_tn, bricks.owner_b, bricks.shared_b),
        ):
            words = pointer.view(-1)
            slot = words[node].clamp(min=0).to(torch.int64)
            held = words[node] >= 0
            own = held & (owner[slot] == node)  # from before it was an alias
            unlink(pointer, owner, shared, torch.where(own, slot, -1).to(torch.int32))
            # A target that was gone and is back takes over what its aliases kept.
            left = held & ~own & (owner[slot] < 0) & (words[target] == ABSENT)
            words[target[left]] = slot[left].to(torch.int32)
            owner[slot[left]] = target[left].to(torch.int32)
            words[node] = words[target]
            slot = words[node]
            shared[slot[slot >= 0].to(torch.int64)] = True
        for held in (*nodes.constants.values(), *nodes.ranges.values()):
            flat = movable(held).flatten(0, 1)
            flat[node] = flat[target]

    def _copy_pending(self) -> None:
        """Copies the pending bits of targets to their aliases, so that rays need not ask again."""
        words, rows = self.nodes.request_tn.view(-1), self.rows
        pending = words[rows.target] & REQUEST_KINDS << REQUEST_PENDING_SHIFT
        above = torch.where(pending & REQUEST_SUBDIVIDE << REQUEST_PENDING_SHIFT != 0, -1, 0)
        pending = torch.where(rows.exact, pending, above & REQUEST_KINDS << REQUEST_PENDING_SHIFT)
        words[rows.node] &= ~(REQUEST_KINDS << REQUEST_PENDING_SHIFT)
        words[rows.node] |= pending.to(words.dtype)

    def _paths(self) -> tuple[Tensor, Tensor]:
        """Returns (p,) tiles of aliases, and (p,) the tiles on the path to their targets."""
        per_tile, parent = self.nodes.nodes_per_tile, self.nodes.parent_t
        rows = self.rows
        pairs = torch.stack((rows.node, rows.target), 1) // per_tile
        found = []
        while len(pairs):
            pairs = pairs.unique(dim=0)
            found.append(pairs)
            above = parent[pairs[:, 1]].to(torch.int64)
            pairs = torch.stack((pairs[:, 0], above // per_tile), 1)[above >= 0]
        seen, tile = torch.cat([*found, pairs]).unique(dim=0).unbind(1)
        return seen, tile
