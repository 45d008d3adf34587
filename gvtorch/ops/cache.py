"""The cache's ops, checked and sent to a backend: requests listed, nodes located, slots ordered by
use, pointers cleared and written.

Words and slots are int32, nodes that the host names int64. Lists have a fixed capacity and a
count that stays on the device, so that a frame needs no host synchronisation; places that are not
taken hold -1.

Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base.constants import REQUEST_LOAD, REQUEST_SUBDIVIDE
from .reference import cache as reference_cache
from .trace import Backend, choose_backend


def compact_requests(
    request_tn: Tensor, capacity: int, *, backend: Backend = "auto"
) -> tuple[Tensor, Tensor, Tensor]:
    """Lists requests and clears their words, the pending bits excepted; kinds that are pending are
    not listed.

    Mutates `request_tn`.

    Args:
        request_tn: (t, n) request words.
        capacity: Most requests listed, >= 1.
        backend: auto, reference, cpp or cuda.

    Returns:
        node_k (capacity,) node indices, rising, -1 behind them; word_k (capacity,) kinds and
        priority; count_3 (3,) int64: nodes listed, nodes that could be listed, requested nodes,
        pending or not.

    Raises:
        ValueError: request_tn is no contiguous (t, n) int32, or capacity < 1.
    """
    where = "compact_requests"
    _words(where, "request_tn", request_tn, ("t", "n"), request_tn)
    check.whole(where, "capacity", capacity, low=1, high=2**31 - 1)
    return _home(backend, request_tn).compact_requests(request_tn, capacity)


def lru_partition(
    order_k: Tensor, stamp_s: Tensor, frame_1: Tensor, *, backend: Backend = "auto"
) -> tuple[Tensor, Tensor]:
    """Orders slots by use: a stable partition, those that this frame did not use first.

    Kept from frame to frame, the order is that of least recent use; victims come from the front.

    Args:
        order_k: (k,) slots; those that are never given away are not among them.
        stamp_s: (s,) last frame that used each slot.
        frame_1: (1,) number of this frame.
        backend: auto, reference, cpp or cuda.

    Returns:
        order_k (k,), unused_1 (1,) int64: how many this frame did not use.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device.
    """
    where = "lru_partition"
    _words(where, "order_k", order_k, ("k",), order_k)
    _words(where, "stamp_s", stamp_s, ("s",), order_k)
    _words(where, "frame_1", frame_1, (1,), order_k)
    return _home(backend, order_k).lru_partition(order_k, stamp_s, frame_1)


def unlink(
    pointer: Tensor, slot_k: Tensor, slots: int, divisor: int = 1, *, backend: Backend = "auto"
) -> None:
    """Clears every pointer to slots that change hands, shared ones too: it becomes ABSENT.

    Mutates `pointer`.

    Args:
        pointer: Words of any shape; those >= 0 name a slot.
        slot_k: (k,) slots that change hands; -1 names none.
        slots: Number of slots there are.
        divisor: A word names slot word // divisor: nodes a tile, where words are node indices.
        backend: auto, reference, cpp or cuda.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    where = "unlink"
    _words(where, "pointer", pointer, tuple("abcd"[: pointer.dim()]), pointer)
    _words(where, "slot_k", slot_k, ("k",), pointer)
    check.whole(where, "slots", slots, low=0, high=2**31 - 1)
    check.whole(where, "divisor", divisor, low=1, high=2**31 - 1)
    _home(backend, pointer).unlink(pointer, slot_k, slots, divisor)


def link(
    pointer_tn: Tensor,
    request_tn: Tensor,
    node_k: Tensor,
    word_k: Tensor,
    kind: int,
    *,
    backend: Backend = "auto",
) -> None:
    """Writes pointers of nodes and clears the requests that they answer.

    Mutates `pointer_tn` and `request_tn`.

    Args:
        pointer_tn: (t, n) child or brick words.
        request_tn: (t, n) request words: the kind and its pending bit are cleared.
        node_k: (k,) node indices, each once; -1 names none.
        word_k: (k,) what their words become.
        kind: REQUEST_LOAD for brick words, REQUEST_SUBDIVIDE for child words.
        backend: auto, reference, cpp or cuda.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or an unknown kind.
    """
    where = "link"
    _words(where, "pointer_tn", pointer_tn, ("t", "n"), pointer_tn)
    _words(where, "request_tn", request_tn, tuple(pointer_tn.shape), pointer_tn)
    _words(where, "node_k", node_k, ("k",), pointer_tn)
    _words(where, "word_k", word_k, tuple(node_k.shape), pointer_tn)
    if kind not in (REQUEST_LOAD, REQUEST_SUBDIVIDE):
        raise ValueError(f"{where}: kind must be REQUEST_LOAD or REQUEST_SUBDIVIDE, got {kind!r}")
    _home(backend, pointer_tn).link(pointer_tn, request_tn, node_k, word_k, kind)


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
    *,
    backend: Backend = "auto",
) -> None:
    """Gives nodes the bricks in slots, which are theirs alone from now on, and takes back that they
    asked for them.

    Mutates the first six; see `BrickPool` and `NodePool`.

    Args:
        brick_tn: (t, n) int32 brick words.
        request_tn: (t, n) int32 request words.
        owner_b: (b,) int32 the node that owns each slot.
        stamp_b: (b,) int32 last frame that used it: becomes `frame`.
        born_b: (b,) int32 the first frame that can show it: becomes `frame` + 1.
        shared_b: (b,) bool, other nodes may point to it, too.
        node_k: (k,) int64 node indices, each once; those of no node are left out.
        slot_k: (k,) int32 slots, each once.
        frame: Number of the last picture.
        backend: auto, reference, cpp or cuda.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device.
    """
    where = "link_bricks"
    _words(where, "brick_tn", brick_tn, ("t", "n"), brick_tn)
    _words(where, "request_tn", request_tn, tuple(brick_tn.shape), brick_tn)
    slots = {"owner_b": owner_b, "stamp_b": stamp_b, "born_b": born_b}
    for name, words in slots.items():
        _words(where, name, words, tuple(owner_b.shape[:1]), brick_tn)
    _words(where, "shared_b", shared_b, tuple(owner_b.shape[:1]), brick_tn, torch.bool)
    _words(where, "node_k", node_k, ("k",), brick_tn, torch.int64)
    _words(where, "slot_k", slot_k, tuple(node_k.shape), brick_tn)
    pools = (brick_tn, request_tn, *slots.values(), shared_b)
    _home(backend, brick_tn).link_bricks(*pools, node_k, slot_k, frame)


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
    *,
    backend: Backend = "auto",
) -> None:
    """Writes tiles, hangs them below nodes, and takes back that these asked for them.

    Mutates the first eight; see `NodePool`. Words beyond the `w` of the tree become TERMINAL and
    EMPTY.

    Args:
        child_tn: (t, n) int32 child words.
        brick_tn: (t, n) int32 brick words.
        request_tn: (t, n) int32 request words.
        loc_t4: (t, 4) int32 places.
        parent_t: (t,) int32 parents.
        tree_t: (t,) int32 numbers of trees.
        stamp_t: (t,) int32 last frame that used a tile: becomes `frame`.
        shared_t: (t,) bool, other nodes may point to a tile, too.
        child_jw: (j, w) int32 what the children of j nodes hold, w <= n.
        brick_jw: (j, w) int32 the same of their bricks.
        node_j: (j,) int64 the nodes.
        loc_j4: (j, 4) int64 their places.
        row_k: (k,) int64 which of the j nodes get tiles, each once.
        tile_k: (k,) int32 the tiles, each once, none of them a node's own.
        tree: The tree's number.
        frame: Number of the last picture.
        backend: auto, reference, cpp or cuda.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device.
    """
    where = "link_tiles"
    _words(where, "child_tn", child_tn, ("t", "n"), child_tn)
    _words(where, "brick_tn", brick_tn, tuple(child_tn.shape), child_tn)
    _words(where, "request_tn", request_tn, tuple(child_tn.shape), child_tn)
    tiles, rows = len(child_tn), len(node_j)
    _words(where, "loc_t4", loc_t4, (tiles, 4), child_tn)
    words = {"parent_t": parent_t, "tree_t": tree_t, "stamp_t": stamp_t}
    for name, tensor in words.items():
        _words(where, name, tensor, (tiles,), child_tn)
    _words(where, "shared_t", shared_t, (tiles,), child_tn, torch.bool)
    _words(where, "child_jw", child_jw, (rows, "w"), child_tn)
    _words(where, "brick_jw", brick_jw, tuple(child_jw.shape), child_tn)
    if child_jw.shape[1] > child_tn.shape[1]:
        width = child_tn.shape[1]
        raise ValueError(
            f"{where}: child_jw must hold at most {width} words a row, got {child_jw.shape[1]}"
        )
    _words(where, "node_j", node_j, ("j",), child_tn, torch.int64)
    _words(where, "loc_j4", loc_j4, (rows, 4), child_tn, torch.int64)
    _words(where, "row_k", row_k, ("k",), child_tn, torch.int64)
    _words(where, "tile_k", tile_k, tuple(row_k.shape), child_tn)
    pools = (child_tn, brick_tn, request_tn, loc_t4, *words.values(), shared_t)
    made = (child_jw, brick_jw, node_j, loc_j4, row_k, tile_k)
    _home(backend, child_tn).link_tiles(*pools, *made, tree, frame)


def locate(
    loc_t4: Tensor, node_k: Tensor, branching: int, per_tile: int, *, backend: Backend = "auto"
) -> Tensor:
    """Returns where nodes lie.

    Args:
        loc_t4: (t, 4) int32 x, y, z of each tile's parent, and the depth of the tile's nodes.
        node_k: (k,) int64 node indices.
        branching: N of the tree whose nodes they are.
        per_tile: Nodes of a tile.
        backend: auto, reference, cpp or cuda.

    Returns:
        (k, 4) int64 x, y, z, depth; -1 for an index that is no node's.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    where = "locate"
    _words(where, "loc_t4", loc_t4, ("t", 4), node_k)
    _words(where, "node_k", node_k, ("k",), node_k, torch.int64)
    check.whole(where, "branching", branching, low=2, high=2**15 - 1)
    check.whole(where, "per_tile", per_tile, low=1, high=2**31 - 1)
    return _home(backend, node_k).locate(loc_t4, node_k, branching, per_tile)


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
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Tells which nodes still stand for the places that were asked for, and still have nothing.

    Args:
        pointer_tn: (t, n) int32 child or brick words: what is asked for is ABSENT.
        loc_t4: See `locate`.
        parent_t: (t,) int32 the node whose children a tile holds, below 0: none.
        tree_t: (t,) int32 number of the tree that owns each tile.
        shared_t: (t,) bool, nodes that are the same as its parent may lead to the tile, too.
        node_k: (k,) int64 node indices.
        loc_k4: (k, 4) int64 the places that were asked for.
        tree: The tree's number.
        root: Node index of its root.
        branching: Its N.
        backend: auto, reference, cpp or cuda.

    Returns:
        (k,) bool: the node's tile hangs in the tree, at that place, and its word is ABSENT.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    where = "lacking"
    _words(where, "pointer_tn", pointer_tn, ("t", "n"), node_k)
    tiles = len(pointer_tn)
    _words(where, "loc_t4", loc_t4, (tiles, 4), node_k)
    _words(where, "parent_t", parent_t, (tiles,), node_k)
    _words(where, "tree_t", tree_t, (tiles,), node_k)
    _words(where, "shared_t", shared_t, (tiles,), node_k, torch.bool)
    _words(where, "node_k", node_k, ("k",), node_k, torch.int64)
    _words(where, "loc_k4", loc_k4, (len(node_k), 4), node_k, torch.int64)
    check.whole(where, "branching", branching, low=2, high=2**15 - 1)
    pools = (pointer_tn, loc_t4, parent_t, tree_t, shared_t)
    return _home(backend, node_k).lacking(*pools, node_k, loc_k4, tree, root, branching)


def _words(
    where: str,
    name: str,
    value: Tensor,
    shape: tuple,
    like: Tensor,
    dtype: torch.dtype = torch.int32,
) -> None:
    check.tensor(where, name, value, shape, dtype, like.device)
    if not value.is_contiguous():
        raise ValueError(f"{where}: {name} must be contiguous")


def _home(backend: Backend, tensor: Tensor) -> Any:  # the module of twins, or the compiled ops
    if choose_backend(backend, tensor.device) == "reference":
        return reference_cache
    return torch.ops.gvtorch
