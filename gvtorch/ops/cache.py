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
    _check(where, request_tn, words={"request_tn": request_tn})
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
    words = {"order_k": order_k, "stamp_s": stamp_s, "frame_1": frame_1}
    _check("lru_partition", order_k, words=words)
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
    _check(where, pointer, words={"slot_k": slot_k})
    fields = [("pointer", pointer, "abcd"[: pointer.dim()], torch.int32)]
    check.tensors(where, pointer.device, fields)
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
    words = {"pointer_tn": pointer_tn, "request_tn": request_tn, "node_k": node_k, "word_k": word_k}
    _check(where, pointer_tn, words=words)
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
    words = {"brick_tn": brick_tn, "request_tn": request_tn}
    words |= {"owner_b": owner_b, "stamp_b": stamp_b, "born_b": born_b}
    _check(
        *("link_bricks", brick_tn),
        words={**words, "slot_k": slot_k},
        nodes={"node_k": node_k},
        flags={"shared_b": shared_b},
    )
    _home(backend, brick_tn).link_bricks(*words.values(), shared_b, node_k, slot_k, frame)


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
    pools = {"child_tn": child_tn, "brick_tn": brick_tn, "request_tn": request_tn}
    pools |= {"loc_t4": loc_t4, "parent_t": parent_t, "tree_t": tree_t, "stamp_t": stamp_t}
    _check(
        *(where, child_tn),
        words={**pools, "child_jw": child_jw, "brick_jw": brick_jw, "tile_k": tile_k},
        nodes={"node_j": node_j, "loc_j4": loc_j4, "row_k": row_k},
        flags={"shared_t": shared_t},
    )
    if child_jw.shape[1] > child_tn.shape[1]:
        width = child_tn.shape[1]
        raise ValueError(
            f"{where}: child_jw must hold at most {width} words a row, got {child_jw.shape[1]}"
        )
    made = (child_jw, brick_jw, node_j, loc_j4, row_k, tile_k)
    _home(backend, child_tn).link_tiles(*pools.values(), shared_t, *made, tree, frame)


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
    _check(where, node_k, words={"loc_t4": loc_t4}, nodes={"node_k": node_k})
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
    pools = {"pointer_tn": pointer_tn, "loc_t4": loc_t4, "parent_t": parent_t, "tree_t": tree_t}
    nodes = {"node_k": node_k, "loc_k4": loc_k4}
    _check(where, node_k, words=pools, nodes=nodes, flags={"shared_t": shared_t})
    check.whole(where, "branching", branching, low=2, high=2**15 - 1)
    pool = (*pools.values(), shared_t)
    return _home(backend, node_k).lacking(*pool, node_k, loc_k4, tree, root, branching)


def _check(
    where: str,
    like: Tensor,
    *,
    words: dict[str, Tensor],
    nodes: dict[str, Tensor] | None = None,
    flags: dict[str, Tensor] | None = None,
) -> None:
    """Checks words (int32), nodes (int64) and flags (bool) on the device of `like`; names end with
    their shapes.
    """
    groups = ((words, torch.int32), (nodes or {}, torch.int64), (flags or {}, torch.bool))
    fields = [(n, t, check.shape_of(n), dtype) for group, dtype in groups for n, t in group.items()]
    check.tensors(where, like.device, fields)


def _home(backend: Backend, tensor: Tensor) -> Any:  # the module of twins, or the compiled ops
    if choose_backend(backend, tensor.device) == "reference":
        return reference_cache
    return torch.ops.gvtorch
