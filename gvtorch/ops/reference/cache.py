"""The torch twins of the cache's ops, right by definition. Arguments as in `ops/cache.py`.

Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...base.constants import (
    ABSENT,
    EMPTY,
    REQUEST_KINDS,
    REQUEST_LOAD,
    REQUEST_PENDING_SHIFT,
    REQUEST_PRIORITY,
    REQUEST_SUBDIVIDE,
    TERMINAL,
)


def compact_requests(request_tn: Tensor, capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.compact_requests`."""
    words = request_tn.view(-1)
    requested = int((words & REQUEST_KINDS).count_nonzero())
    open_kinds = words & REQUEST_KINDS & ~(words >> REQUEST_PENDING_SHIFT)
    node = open_kinds.nonzero()[:, 0]
    kept = node[:capacity]
    node_k = torch.full((capacity,), -1, dtype=torch.int32, device=words.device)
    word_k = torch.zeros(capacity, dtype=torch.int32, device=words.device)
    node_k[: len(kept)] = kept.to(torch.int32)
    word_k[: len(kept)] = open_kinds[kept] | (words[kept] & REQUEST_PRIORITY)
    words &= REQUEST_KINDS << REQUEST_PENDING_SHIFT
    return node_k, word_k, torch.tensor([len(kept), len(node), requested], device=words.device)


def lru_partition(order_k: Tensor, stamp_s: Tensor, frame_1: Tensor) -> tuple[Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.lru_partition`."""
    used = stamp_s[order_k.to(torch.int64)] == frame_1
    return torch.cat((order_k[~used], order_k[used])), (~used).sum().view(1)


def unlink(pointer: Tensor, slot_k: Tensor, slots: int, divisor: int) -> None:
    """Twin of `torch.ops.gvtorch.unlink`."""
    leaving = torch.zeros(slots + 1, dtype=torch.bool, device=pointer.device)
    leaving[slot_k[(slot_k >= 0) & (slot_k < slots)].to(torch.int64)] = True
    named = torch.where(pointer >= 0, pointer // divisor, slots).clamp(max=slots)
    pointer[leaving[named.to(torch.int64)]] = -1


def link(pointer_tn: Tensor, request_tn: Tensor, node_k: Tensor, word_k: Tensor, kind: int) -> None:
    """Twin of `torch.ops.gvtorch.link`."""
    valid = (node_k >= 0) & (node_k < pointer_tn.numel())
    node = node_k[valid].to(torch.int64)
    pointer_tn.view(-1)[node] = word_k[valid]
    request_tn.view(-1)[node] &= ~(kind | kind << REQUEST_PENDING_SHIFT)


def link_bricks(
    brick_tn: Tensor,
    request_tn: Tensor,
    owner_b: Tensor,
    stamp_b: Tensor,
    born_b: Tensor,
    shared_b: Tensor,
    node_k: Tensor,
    slot_k: Tensor,
    frame: int,
) -> None:
    """Twin of `torch.ops.gvtorch.link_bricks`."""
    valid = (node_k >= 0) & (node_k < brick_tn.numel())
    valid &= (slot_k >= 0) & (slot_k < len(owner_b))
    node_k, slot_k = node_k[valid].to(torch.int32), slot_k[valid]
    slot = slot_k.to(torch.int64)
    owner_b[slot] = node_k
    stamp_b[slot], born_b[slot], shared_b[slot] = frame, frame + 1, False
    link(brick_tn, request_tn, node_k, slot_k, REQUEST_LOAD)


def link_tiles(
    child_tn: Tensor,
    brick_tn: Tensor,
    request_tn: Tensor,
    loc_t4: Tensor,
    parent_t: Tensor,
    tree_t: Tensor,
    stamp_t: Tensor,
    shared_t: Tensor,
    child_jw: Tensor,
    brick_jw: Tensor,
    node_j: Tensor,
    loc_j4: Tensor,
    row_k: Tensor,
    tile_k: Tensor,
    tree: int,
    frame: int,
) -> None:
    """Twin of `torch.ops.gvtorch.link_tiles`."""
    valid = (row_k >= 0) & (row_k < len(node_j)) & (tile_k >= 0) & (tile_k < len(parent_t))
    row_k, tile_k = row_k[valid], tile_k[valid]
    valid = (node_j[row_k] >= 0) & (node_j[row_k] < child_tn.numel())
    row, tile_k = row_k[valid], tile_k[valid]
    tile, width = tile_k.to(torch.int64), child_jw.shape[1]
    child_tn[tile], brick_tn[tile] = TERMINAL, EMPTY
    child_tn[tile, :width], brick_tn[tile, :width] = child_jw[row], brick_jw[row]
    request_tn[tile], stamp_t[tile], shared_t[tile] = 0, frame, False
    loc_t4[tile] = loc_j4[row].to(torch.int32)
    loc_t4[tile, 3] += 1
    parent_t[tile] = node_j[row].to(torch.int32)
    tree_t[tile] = tree
    link(child_tn, request_tn, node_j[row].to(torch.int32), tile_k, REQUEST_SUBDIVIDE)


def locate(loc_t4: Tensor, node_k: Tensor, branching: int, per_tile: int) -> Tensor:
    """Twin of `torch.ops.gvtorch.locate`."""
    known = (node_k >= 0) & (node_k < len(loc_t4) * per_tile)
    node = torch.where(known, node_k, 0)
    above = loc_t4.to(torch.int64)[node // per_tile]
    child = node % per_tile
    digits = [child // branching**axis % branching for axis in range(3)]
    loc = torch.stack([above[:, i] * branching + d for i, d in enumerate(digits)], 1)
    return torch.where(known[:, None], torch.cat((loc, above[:, 3:]), 1), -1)


def lacking(
    pointer_tn: Tensor,
    loc_t4: Tensor,
    parent_t: Tensor,
    tree_t: Tensor,
    shared_t: Tensor,
    node_k: Tensor,
    loc_k4: Tensor,
    tree: int,
    root: int,
    branching: int,
) -> Tensor:
    """Twin of `torch.ops.gvtorch.lacking`."""
    per_tile = pointer_tn.shape[1]
    known = (node_k >= 0) & (node_k < pointer_tn.numel())
    node = torch.where(known, node_k, 0)
    tile = node // per_tile
    linked = (parent_t[tile] >= 0) | shared_t[tile] | (node == root)
    there = (locate(loc_t4, node, branching, per_tile) == loc_k4).all(1)
    bare = pointer_tn.view(-1)[node] == ABSENT
    return known & linked & (tree_t[tile] == tree) & there & bare
