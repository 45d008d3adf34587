"""The cache's ops, checked and sent to a backend: requests listed, nodes located, slots ordered by
use, pointers cleared and written.

Words and slots are int32, nodes that the host names int64. Lists of wishes have a fixed capacity
and a count that stays on the device, so that a frame needs no host synchronisation; places that are
not taken hold -1.

Source: Crassin et al., "GigaVoxels", I3D 2009, section 5.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .. import check
from ..config import REQUEST_LOAD, REQUEST_SUBDIVIDE
from . import reference_cache
from .trace import Backend, choose_backend


def compact_requests(
    request_tn: Tensor, capacity: int, *, backend: Backend = "auto"
) -> tuple[Tensor, Tensor, Tensor]:
    """Lists what rays asked for and clears the wishes; pending kinds are left alone.

    Mutates `request_tn`.

    Args:
        request_tn: (t, n) request words.
        capacity: Most requests listed, >= 1.
        backend: auto, reference, cpp or cuda.

    Returns:
        node_k (capacity,) node indices, rising, -1 behind them; word_k (capacity,) kinds and
        priority; count_3 (3,) int64: nodes listed, nodes that could be listed, nodes with a wish,
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
    """Writes pointers of nodes and takes back what they asked for.

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
