"""The cache's ops: they list and choose requests, locate nodes, order slots by use, and clear and
write pointers. The body of each is its twin in plain torch, right by definition; see `op`. Also
`cut_bricks`, for a level that is in memory.

Lists have a fixed capacity and a count that stays on the device, so that a frame needs no host
synchronisation; unused entries hold -1. Fields of pools: see `NodePool`, `BrickPool`.

Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

from typing import Annotated, Any

import torch
from torch import Tensor

from ..base import check
from ..base.constants import (
    ABSENT,
    EMPTY,
    REQUEST_KINDS,
    REQUEST_LOAD,
    REQUEST_PENDING_SHIFT,
    REQUEST_PRIORITY,
    REQUEST_SUBDIVIDE,
    TERMINAL,
)
from ..base.volume import movable
from .registry import Backend, Bytes, Flags, Longs, Requests, Words, choose_backend, fake_of, op

Positive = Annotated[int, range(1, 2**31)]
Branching = Annotated[int, range(2, 2**15)]  # N of a tree


@op(
    fake=lambda *, request_tn, capacity: (
        request_tn.new_empty((capacity,), dtype=torch.int32),
        request_tn.new_empty((capacity,), dtype=torch.int32),
        request_tn.new_empty((5,), dtype=torch.int64),
    )
)
def compact_requests(
    request_tn: Requests, capacity: Positive, *, backend: Backend = "auto"
) -> tuple[Tensor, Tensor, Tensor]:
    """Lists at most `capacity` nodes with requests, without the kinds that are pending, and clears
    all request words but their pending bits. Mutates `request_tn`.

    Returns:
        node_k (capacity,) node indices, rising, -1 behind them; word_k (capacity,) kinds and
        priority; count_5 (5,) int64: nodes listed; nodes with a request that is not pending; nodes
        with any request; listed loads; listed subdivisions.
    """
    request_words = request_tn.view(-1)
    requested = int((request_words & REQUEST_KINDS).count_nonzero())
    open_kinds = request_words & REQUEST_KINDS & ~(request_words >> REQUEST_PENDING_SHIFT)
    node = open_kinds.nonzero()[:, 0]
    listed = node[:capacity]
    node_k = torch.full((capacity,), -1, dtype=torch.int32, device=request_words.device)
    word_k = torch.zeros(capacity, dtype=torch.int32, device=request_words.device)
    node_k[: len(listed)] = listed.to(torch.int32)
    word_k[: len(listed)] = open_kinds[listed] | (request_words[listed] & REQUEST_PRIORITY)
    request_words &= REQUEST_KINDS << REQUEST_PENDING_SHIFT
    kinds = [int((word_k & kind).count_nonzero()) for kind in (REQUEST_LOAD, REQUEST_SUBDIVIDE)]
    counts = [len(listed), len(node), requested, *kinds]
    return node_k, word_k, torch.tensor(counts, device=request_words.device)


@op(
    fake=lambda *, asked_l2k, batch, **_: (
        asked_l2k.new_empty((2, batch), dtype=torch.int64),
        asked_l2k.new_empty((2, batch)),
    )
)
def choose_requests(
    asked_l2k: Words,  # lists of nodes, -1 for none, and their words; earlier lists first
    loc_t4: Words,  # only the depth of each tile's nodes is read
    room_2: Longs,  # most subdivisions (tiles) and loads (bricks) to choose
    per_tile: Positive,  # nodes of a tile
    batch: Positive,
    coarse_first: bool,  # else fine levels first
    *,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor]:
    """Chooses the requests to serve, ordered by list, then level, then size on the screen (largest
    first), then their order in the list.

    Returns:
        node_2b (2, batch) int64 nodes to load, and nodes to subdivide, the most wanted first, -1
        behind the last; priority_2b (2, batch) int32 of each.
    """
    lists, _, listed = asked_l2k.shape
    node, word = asked_l2k.transpose(0, 1).flatten(1)
    valid = (node >= 0) & (node < len(loc_t4) * per_tile)
    tile = torch.where(valid, node, 0).to(torch.int64) // per_tile
    level = loc_t4[tile, 3].to(torch.int64) * (1 if coarse_first else -1)
    size = word & REQUEST_PRIORITY
    list_index = torch.arange(lists, device=node.device).repeat_interleave(listed)
    rank = (list_index << 20) + level * (REQUEST_PRIORITY + 1) + REQUEST_PRIORITY - size
    order = rank.argsort(stable=True)
    node_2b = torch.full((2, batch), -1, dtype=torch.int64, device=node.device)
    priority_2b = torch.zeros((2, batch), dtype=torch.int32, device=node.device)
    for row, kind in enumerate((REQUEST_LOAD, REQUEST_SUBDIVIDE)):
        wanted = order[valid[order] & ((word[order] & kind) != 0)]
        chosen = wanted[: min(batch, max(0, int(room_2[1 - row])))]
        node_2b[row, : len(chosen)] = node[chosen].to(torch.int64)
        priority_2b[row, : len(chosen)] = size[chosen]
    return node_2b, priority_2b


@op(
    fake=lambda *, order_k, **_: (
        torch.empty_like(order_k),
        order_k.new_empty((1,), dtype=torch.int64),
    )
)
def lru_partition(
    order_k: Words,  # slots, without those that never change hands
    stamp_s: Words,  # last frame that used each slot
    frame_1: Words,  # number of this frame
    *,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor]:
    """Orders slots by use: a stable partition, those that this frame did not use first.

    Repeated frame by frame, this sorts slots by least recent use; victims come from the front.

    Returns:
        order_k (k,), unused_1 (1,) int64: number of slots that this frame did not use.
    """
    order = order_k.to(torch.int64)
    valid = (order >= 0) & (order < len(stamp_s))  # others count as unused
    used = valid & (stamp_s[torch.where(valid, order, 0)] == frame_1)
    return torch.cat((order_k[~used], order_k[used])), (~used).sum().view(1)


def _marked(slot_k: Tensor, slots: int) -> Tensor:
    """Returns (slots + 1,) bool: true for listed slots; the last entry, for no slot, is false."""
    marked = torch.zeros(slots + 1, dtype=torch.bool, device=slot_k.device)
    marked[slot_k[(slot_k >= 0) & (slot_k < slots)].to(torch.int64)] = True
    return marked


@op()
def unlink(
    pointer_tn: Words,  # child or brick words; those >= 0 are slots
    owner_s: Words,  # the node that each slot belongs to, or ABSENT
    shared_s: Flags,  # whether nodes besides the owner may point to the slot
    slot_k: Words,  # slots that change hands; -1 names none
    *,
    backend: Backend = "auto",
) -> None:
    """Takes slots from their nodes: every pointer to them becomes ABSENT, and so does their owner.

    A slot that is not shared has no pointer but its owner's, so the compiled op scans all words
    only where a shared slot changes hands. Mutates `pointer_tn` and `owner_s`.
    """
    slots = len(owner_s)
    leaving = _marked(slot_k, slots)
    slot_tn = torch.where(pointer_tn >= 0, pointer_tn, slots).clamp(max=slots)
    pointer_tn[leaving[slot_tn.to(torch.int64)]] = ABSENT
    owner_s[leaving[:slots]] = ABSENT


@op()
def orphan(
    pointer_tn: Words,  # child or brick words
    owner_s: Words,  # the node that each slot belongs to (it points to the slot), or ABSENT
    tile_k: Words,  # tiles that change hands; -1 names none
    *,
    backend: Backend = "auto",
) -> None:
    """Clears the owner of slots that belong to nodes of the given tiles. Mutates `owner_s`."""
    tiles, per_tile = pointer_tn.shape
    leaving = _marked(tile_k, tiles)
    tile = torch.where(owner_s >= 0, owner_s // per_tile, tiles).clamp(max=tiles)
    owner_s[leaving[tile.to(torch.int64)]] = ABSENT


def _check_kind(*, kind: int, **_: Any) -> None:
    if kind not in (REQUEST_LOAD, REQUEST_SUBDIVIDE):
        raise ValueError(f"link: kind must be REQUEST_LOAD or REQUEST_SUBDIVIDE, got {kind!r}")


@op(_check_kind)
def link(
    pointer_tn: Words,  # child or brick words
    request_tn: Requests,
    node_k: Words,  # node indices, each once; -1 names none
    word_k: Words,  # their new words
    kind: int,  # REQUEST_LOAD for brick words, REQUEST_SUBDIVIDE for child words
    *,
    backend: Backend = "auto",
) -> None:
    """Writes pointers of nodes and clears the requests of this kind, and their pending bits.
    Mutates `pointer_tn` and `request_tn`.
    """
    valid = (node_k >= 0) & (node_k < pointer_tn.numel())
    node = node_k[valid].to(torch.int64)
    pointer_tn.view(-1)[node] = word_k[valid]
    request_tn.view(-1)[node] &= ~(kind | kind << REQUEST_PENDING_SHIFT)


@op()
def link_bricks(
    brick_tn: Words,
    request_tn: Requests,
    owner_b: Words,
    stamp_b: Words,
    born_b: Words,
    shared_b: Flags,
    node_k: Longs,  # node indices, each once; invalid ones are left out
    slot_k: Words,  # their slots, each once; -1 names none
    frame_1: Words,  # number of the last picture
    *,
    backend: Backend = "auto",
) -> None:
    """Links nodes to brick slots, whose only owners they become, and clears their LOAD requests.
    The slots count as used in the last picture, and are first drawn in the next one. Mutates the
    first six arguments.
    """
    valid = (node_k >= 0) & (node_k < brick_tn.numel())
    valid &= (slot_k >= 0) & (slot_k < len(owner_b))
    node, slot_k = node_k[valid].to(torch.int32), slot_k[valid]
    slot = slot_k.to(torch.int64)
    owner_b[slot] = node
    stamp_b[slot], born_b[slot], shared_b[slot] = frame_1, frame_1 + 1, False
    link(brick_tn, request_tn, node, slot_k, REQUEST_LOAD, backend=backend)


def _check_width(*, child_tn: Tensor, child_jw: Tensor, **_: Any) -> None:
    per_tile, width = child_tn.shape[1], child_jw.shape[1]
    if width > per_tile:
        raise ValueError(f"link_tiles: child_jw must hold <= {per_tile} words a row, got {width}")


@op(_check_width)
def link_tiles(
    child_tn: Words,
    brick_tn: Words,
    request_tn: Requests,
    loc_t4: Words,
    parent_t: Words,
    tree_t: Words,
    stamp_t: Words,
    shared_t: Flags,
    child_jw: Words,  # child words of the w <= n children of j nodes
    brick_jw: Words,  # their brick words
    node_j: Longs,  # the j nodes
    loc_j4: Longs,  # their locs
    row_k: Longs,  # rows of the nodes that get tiles, each once
    tile_k: Words,  # the tiles, each once, none that contains one of the j nodes; -1 names none
    tree: int,  # number of the tree
    frame_1: Words,  # number of the last picture: the tiles count as used in it
    *,
    backend: Backend = "auto",
) -> None:
    """Writes tiles, links their parent nodes to them, and clears these nodes' SUBDIVIDE requests.
    Words beyond the tree's `w` become TERMINAL and EMPTY. Mutates the first eight arguments.
    """
    valid = (row_k >= 0) & (row_k < len(node_j)) & (tile_k >= 0) & (tile_k < len(parent_t))
    row_k, tile_k = row_k[valid], tile_k[valid]
    valid = (node_j[row_k] >= 0) & (node_j[row_k] < child_tn.numel())
    row, tile_k = row_k[valid], tile_k[valid]
    tile, width, node = tile_k.to(torch.int64), child_jw.shape[1], node_j[row].to(torch.int32)
    child_tn[tile], brick_tn[tile] = TERMINAL, EMPTY
    child_tn[tile, :width], brick_tn[tile, :width] = child_jw[row], brick_jw[row]
    request_tn[tile], stamp_t[tile], shared_t[tile] = 0, frame_1, False
    loc_t4[tile] = loc_j4[row].to(torch.int32)
    loc_t4[tile, 3] += 1
    parent_t[tile], tree_t[tile] = node, tree
    link(child_tn, request_tn, node, tile_k, REQUEST_SUBDIVIDE, backend=backend)


@op()
def put_rows(
    target_sb: Bytes,  # slots
    slot_k: Longs,  # slot of each row, each once; -1 names none
    rows_kb: Bytes,
    *,
    backend: Backend = "auto",
) -> None:
    """Writes rows of raw bytes into slots. Mutates `target_sb`."""
    valid = (slot_k >= 0) & (slot_k < len(target_sb))
    target_sb[slot_k[valid]] = rows_kb[valid]


@op(fake=lambda *, node_k, **_: node_k.new_empty((node_k.shape[0], 4)))
def locate(
    loc_t4: Words,  # x, y, z of each tile's parent, and the depth of the tile's nodes
    node_k: Longs,  # node indices
    branching: Branching,
    per_tile: Positive,  # nodes of a tile
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Returns the locs of nodes, (k, 4) int64 x, y, z, depth; -1 for an index that is no node's."""
    valid = (node_k >= 0) & (node_k < len(loc_t4) * per_tile)
    node = torch.where(valid, node_k, 0)
    parent_loc = loc_t4.to(torch.int64)[node // per_tile]
    child = node % per_tile
    digits = [child // branching**axis % branching for axis in range(3)]
    loc = torch.stack([parent_loc[:, i] * branching + d for i, d in enumerate(digits)], 1)
    return torch.where(valid[:, None], torch.cat((loc, parent_loc[:, 3:]), 1), -1)


@op(fake=lambda *, node_k, **_: torch.empty_like(node_k, dtype=torch.bool))
def lacking(
    pointer_tn: Words,  # child or brick words, by what was requested
    loc_t4: Words,
    parent_t: Words,
    tree_t: Words,
    shared_t: Flags,
    node_k: Longs,  # node indices
    loc_k4: Longs,  # the locs that were requested
    tree: int,  # number of the tree
    root: int,  # node index of its root
    branching: Branching,
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Returns which nodes still have the loc that was requested, and still lack what was requested.

    Returns:
        (k,) bool: the node's tile is linked into the tree, at this loc, and its word is ABSENT.
    """
    per_tile = pointer_tn.shape[1]
    valid = (node_k >= 0) & (node_k < pointer_tn.numel())
    node = torch.where(valid, node_k, 0)
    tile = node // per_tile
    linked = (parent_t[tile] >= 0) | shared_t[tile] | (node == root)
    at_loc = (locate(loc_t4, node, branching, per_tile, backend=backend) == loc_k4).all(1)
    absent = pointer_tn.view(-1)[node] == ABSENT
    return valid & linked & (tree_t[tile] == tree) & at_loc & absent


def cut_bricks(
    values_zyxc: Tensor,
    place_k3: Tensor,
    brick_size: int,
    border: int,
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Cuts bricks out of a level, with borders from the neighbours, clamped at the level's faces.

    Args:
        values_zyxc: (z, y, x, c) a whole level, of any dtype.
        place_k3: (k, 3) int64 brick indices, z y x.
        brick_size: Voxels along a side, without the border.
        border: Width of the border in voxels.

    Returns:
        (k, s, s, s, c), s = brick_size + 2 * border.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, a number out of its range, or a
            level without voxels.
    """
    context = "cut_bricks"
    shape = ("z", "y", "x", "c")
    check.instance(context, "values_zyxc", values_zyxc, Tensor)
    check.instance(context, "place_k3", place_k3, Tensor)
    check.no_gradient(context, "values_zyxc", values_zyxc)
    check.tensor(context, "values_zyxc", values_zyxc, shape, values_zyxc.dtype, place_k3.device)
    check.tensor(context, "place_k3", place_k3, ("k", 3), torch.int64, place_k3.device)
    brick_size = check.integer(context, "brick_size", brick_size, low=1, high=2**10)
    border = check.integer(context, "border", border, low=0, high=2**10)
    if not values_zyxc.numel():
        raise ValueError(f"{context}: values_zyxc has no voxels, got {check.describe(values_zyxc)}")
    if choose_backend(backend, place_k3.device) != "reference":
        tensors = (values_zyxc.contiguous(), place_k3.contiguous())
        return torch.ops.gvtorch.cut_bricks(*tensors, brick_size, border)
    offsets = torch.arange(-border, brick_size + border, device=place_k3.device)
    brick_index = place_k3.clamp(-(2**50), 2**50)  # beyond any level
    voxel = brick_index[:, :, None] * brick_size + offsets  # (k, 3, s)
    z, y, x = (voxel[:, axis].clamp(0, values_zyxc.shape[axis] - 1) for axis in range(3))
    index = (z[:, :, None, None], y[:, None, :, None], x[:, None, None, :])
    return movable(values_zyxc)[index].view(values_zyxc.dtype)


@fake_of("cut_bricks")
def _fake_bricks(*, values_zyxc: Tensor, place_k3: Tensor, brick_size: int, border: int) -> Tensor:
    side = brick_size + 2 * border
    return values_zyxc.new_empty((place_k3.shape[0], side, side, side, values_zyxc.shape[3]))
