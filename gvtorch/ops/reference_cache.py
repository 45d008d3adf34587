"""The torch twins of the cache's ops, right by definition. Arguments as in `ops/cache.py`.

Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..config import ABSENT, REQUEST_KINDS, REQUEST_PENDING_SHIFT, REQUEST_PRIORITY


def compact_requests(request_tn: Tensor, capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    """Twin of `torch.ops.gvtorch.compact_requests`."""
    words = request_tn.view(-1)
    wished = int((words & REQUEST_KINDS).count_nonzero())
    open_kinds = words & REQUEST_KINDS & ~(words >> REQUEST_PENDING_SHIFT)
    node = open_kinds.nonzero()[:, 0]
    kept = node[:capacity]
    node_k = torch.full((capacity,), -1, dtype=torch.int32, device=words.device)
    word_k = torch.zeros(capacity, dtype=torch.int32, device=words.device)
    node_k[: len(kept)] = kept.to(torch.int32)
    word_k[: len(kept)] = open_kinds[kept] | (words[kept] & REQUEST_PRIORITY)
    words &= REQUEST_KINDS << REQUEST_PENDING_SHIFT
    return node_k, word_k, torch.tensor([len(kept), len(node), wished], device=words.device)


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
