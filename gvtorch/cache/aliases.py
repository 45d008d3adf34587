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
from ..base.rows import distinct_rows
from ..base.volume import movable
from ..ops import unlink
from ..pool import BrickPool, N3Tree, NodePool

_MAX_CHAIN = 64  # longest chain of aliases of aliases


class AliasRows(NamedTuple):
    """The current aliases, sorted by node."""

    node: Tensor  # (a,) int64
    tree_loc: Tensor  # (a, 5) int64 number of its tree, and its loc
    goal: Tensor  # (a, 5) the same of the target
    target: Tensor  # (a,) int64 the target, or the node whose children are asked for
    target_tree_loc: Tensor  # (a, 5) the same of `target`; not `goal` if another alias leads there
    exact: Tensor  # (a,) bool, whether `target` lies at `goal`

    def select(self, index: Tensor) -> AliasRows:
        return AliasRows(*(field[index] for field in self))


class Aliases:
    """The aliases in a pair of pools.

    Attributes:
        trees: Trees by number.
        rows: The aliases.
    """

    rows: AliasRows

    def __init__(self, nodes: NodePool, bricks: BrickPool) -> None:
        self.nodes, self.bricks = nodes, bricks
        self.trees: dict[int, N3Tree] = {}
        self.clear()

    def clear(self, tree: int | None = None) -> None:
        """Forgets the aliases in a tree, and unlinks aliases of its nodes; None: forgets all."""
        if tree is not None and len(self):
            self.rows = rows = self.rows.select(self.rows.tree_loc[:, 0] != tree)
            stale = rows.node[(rows.goal[:, 0] == tree) | (rows.target_tree_loc[:, 0] == tree)]
            for words in (self.nodes.child_tn, self.nodes.brick_tn):
                words.view(-1)[stale] = ABSENT
            return
        device = self.nodes.child_tn.device
        no_locs = torch.zeros((0, 5), dtype=torch.int64, device=device)
        no_nodes = no_locs[:, 0]
        self.rows = AliasRows(no_nodes, no_locs, no_locs, no_nodes, no_locs, no_nodes.bool())
        self._alias_paths = no_nodes, no_nodes

    def __len__(self) -> int:
        return len(self.rows.node)

    def add(self, node: Tensor, tree: int, loc_k4: Tensor, goal: Tensor, goal_tree: int) -> None:
        """Makes (k,) nodes of a tree, with locs `loc_k4` (k, 4), aliases of the nodes with locs
        `goal` (k, 4) in another tree or the same; `update` gives them their words.
        """
        kept = ~torch.isin(self.rows.node, node)
        own_loc, goal_loc = (
            torch.cat((torch.full_like(loc[:, :1], number), loc), 1)
            for number, loc in ((tree, loc_k4), (goal_tree, goal))
        )
        not_exact = torch.zeros_like(node, dtype=torch.bool)
        new = AliasRows(node, own_loc, goal_loc, node, own_loc, not_exact)
        joined = [torch.cat(pair) for pair in zip(self.rows.select(kept), new, strict=True)]
        order = joined[0].argsort()
        self.rows = AliasRows(*(field[order] for field in joined))

    def update(self) -> None:
        """Looks up targets that have gone, and copies the words of all targets to their aliases."""
        if not len(self):
            return
        rows = self.rows.select(self._are_current(self.rows.node, self.rows.tree_loc))
        exact = rows.exact & self._are_current(rows.target, rows.target_tree_loc)
        target = rows.target.clone()
        for number, tree in self.trees.items():
            missing = (~exact & (rows.goal[:, 0] == number)).nonzero()[:, 0]
            if len(missing):
                target[missing], exact[missing] = tree.nearest(rows.goal[missing, 1:])
        rows = rows._replace(target=target, exact=exact)
        above_leaf = ~exact & (self.nodes.child_tn.view(-1)[target] == TERMINAL)
        # EMPTY and CONSTANT regions.
        uniform = above_leaf & (self.nodes.brick_tn.view(-1)[target] < ABSENT)
        kept = ~above_leaf | uniform  # others are requested in their own place
        rows = rows._replace(exact=exact | uniform).select(kept)
        rows = self._follow_chains(rows)
        self.rows = rows._replace(target_tree_loc=self._tree_locs(rows.target))
        self._copy_words(self.rows.select(self.rows.exact))
        self._copy_pending()
        self._alias_paths = self._paths()

    def by_target(
        self, requests: Mapping[int, tuple[Tensor, Tensor]]
    ) -> dict[int, tuple[Tensor, Tensor]]:
        """Returns requests, by kind nodes (k,) and priorities (k,), with aliases replaced by their
        targets, each node once; pending ones are left out.
        """
        nodes, priorities, kinds = [], [], []
        for kind, (node, priority) in requests.items():
            row, is_alias = self._find_rows(node)
            nodes.append(torch.where(is_alias, self.rows.target[row], node))
            priorities.append(priority)
            at_ancestor = is_alias & ~self.rows.exact[row]
            kinds.append(torch.where(at_ancestor, REQUEST_SUBDIVIDE, kind))
        node, priority, kind_k = torch.cat(nodes), torch.cat(priorities), torch.cat(kinds)
        result = {}
        for kind in (REQUEST_LOAD, REQUEST_SUBDIVIDE):
            pending = self.nodes.request_tn.view(-1)[node] & kind << REQUEST_PENDING_SHIFT
            of_kind = (kind_k == kind) & (pending == 0)
            distinct, inverse = node[of_kind].unique(return_inverse=True)
            highest = torch.zeros(len(distinct), dtype=priority.dtype, device=node.device)
            result[kind] = distinct, highest.scatter_reduce(0, inverse, priority[of_kind], "amax")
        return result

    def keep(self, frame_1: Tensor) -> None:
        """Stamps the tiles on the path from the root to targets of aliases that may have been used
        in a frame, so that they stay; the host does not wait.
        """
        alias_tile, path_tile = self._alias_paths
        recording = path_tile.is_cuda and torch.cuda.is_current_stream_capturing()
        # Tensors that a graph reads must stay, and these change.
        if not len(path_tile) or recording:
            return
        stamp = self.nodes.stamp_t
        used = torch.where(stamp[alias_tile] == frame_1, frame_1, ABSENT)
        stamp.scatter_reduce_(0, path_tile, used, "amax")

    def __repr__(self) -> str:
        return f"Aliases({len(self)}, {int(self.rows.exact.sum())} with their targets)"

    def _find_rows(self, node: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (k,) rows of nodes, and (k,) bool, which nodes have one."""
        alias_node = self.rows.node
        row = torch.searchsorted(alias_node, node).clamp(max=len(alias_node) - 1)
        return row, alias_node[row] == node

    def _tree_locs(self, node: Tensor) -> Tensor:
        """Returns (k, 5) tree numbers and locs of nodes."""
        number = self.nodes.tree_t[node // self.nodes.nodes_per_tile].to(torch.int64)
        loc = torch.zeros((len(node), 4), dtype=torch.int64, device=node.device)
        for tree_number, tree in self.trees.items():
            in_tree = (number == tree_number).nonzero()[:, 0]
            loc[in_tree] = tree.loc(node[in_tree])
        return torch.cat((number[:, None], loc), 1)

    def _are_current(self, node: Tensor, tree_loc: Tensor) -> Tensor:
        """Returns (k,) bool, which nodes are in a tree and still have their locs."""
        tile = node // self.nodes.nodes_per_tile
        roots = tile < len(self.trees)
        linked = (self.nodes.parent_t[tile] >= 0) | self.nodes.shared_t[tile] | roots
        return linked & (self._tree_locs(node) == tree_loc).all(1)

    def _follow_chains(self, rows: AliasRows) -> AliasRows:
        """Returns the rows with targets that are not aliases; those that lead back to themselves
        are left out, and requested in their own place.
        """
        self.rows, target, exact = rows, rows.target, rows.exact
        if not len(self):
            return rows
        for _ in range(_MAX_CHAIN):
            row, is_alias = self._find_rows(target)
            if not bool(is_alias.any()):
                return rows._replace(target=target, exact=exact)
            exact = torch.where(is_alias, exact & rows.exact[row], exact)
            target = torch.where(is_alias, rows.target[row], target)
        return self._follow_chains(rows.select(~is_alias))

    def _copy_words(self, rows: AliasRows) -> None:
        """Copies the words, constants and ranges of targets to their aliases."""
        nodes, bricks, node, target = self.nodes, self.bricks, rows.node, rows.target
        for pointer, owner, shared in (
            (nodes.child_tn, nodes.parent_t, nodes.shared_t),
            (nodes.brick_tn, bricks.owner_b, bricks.shared_b),
        ):
            words = pointer.view(-1)
            slot = words[node].clamp(min=0).to(torch.int64)
            has_slot = words[node] >= 0
            owned = has_slot & (owner[slot] == node)  # from before it was an alias
            unlink(pointer, owner, shared, torch.where(owned, slot, -1).to(torch.int32))
            # A target that was gone and is back takes over what its aliases kept.
            orphaned = has_slot & ~owned & (owner[slot] < 0) & (words[target] == ABSENT)
            words[target[orphaned]] = slot[orphaned].to(torch.int32)
            owner[slot[orphaned]] = target[orphaned].to(torch.int32)
            words[node] = words[target]
            slot = words[node]
            shared[slot[slot >= 0].to(torch.int64)] = True
        for values in (*nodes.constants.values(), *nodes.ranges.values()):
            flat = movable(values).flatten(0, 1)
            flat[node] = flat[target]

    def _copy_pending(self) -> None:
        """Copies the pending bits of targets to their aliases, so that rays need not ask again."""
        words, rows = self.nodes.request_tn.view(-1), self.rows
        all_bits = REQUEST_KINDS << REQUEST_PENDING_SHIFT
        pending = words[rows.target] & all_bits
        subdividing = (pending & REQUEST_SUBDIVIDE << REQUEST_PENDING_SHIFT) != 0
        pending = torch.where(rows.exact, pending, torch.where(subdividing, all_bits, 0))
        words[rows.node] &= ~all_bits
        words[rows.node] |= pending.to(words.dtype)

    def _paths(self) -> tuple[Tensor, Tensor]:
        """Returns (p,) tiles of aliases, and (p,) the tiles on the path to their targets."""
        per_tile, parent = self.nodes.nodes_per_tile, self.nodes.parent_t
        rows = self.rows
        pairs = torch.stack((rows.node, rows.target), 1) // per_tile
        levels = []
        while len(pairs):
            pairs, _ = distinct_rows(pairs)
            levels.append(pairs)
            parent_node = parent[pairs[:, 1]].to(torch.int64)
            pairs = torch.stack((pairs[:, 0], parent_node // per_tile), 1)[parent_node >= 0]
        alias_tile, path_tile = distinct_rows(torch.cat([*levels, pairs]))[0].unbind(1)
        return alias_tile, path_tile
