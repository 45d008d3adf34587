"""Opening what a store's metadata names: groups, images, arrays. `Store.open` is the way in.

Everything that a file says is checked before memory is taken for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import ngff
from .level_reader import Deadline, StoredArray, StoreError, short
from .store_layout import (
    BLOCKS,
    BORDER,
    CELL,
    DTYPES,
    MOST_VOXELS,
    VERSION,
    WORK,
    child,
    context,
    opened,
)

_MOST_CHUNK = 2**31  # bytes of one chunk of a foreign array


def find_image(
    where: str, root: Any, image: str | None, deadline: Deadline
) -> tuple[Any, ngff.MultiscaleImage, dict[str, Any] | None]:
    """Finds a multiscale image.

    Returns:
        Its group's kvstore, what the metadata tells, and our own attributes if it is a store of
        ours.

    Raises:
        ValueError: There is none, or the metadata is damaged.
    """
    attributes = _attributes(where, root, deadline)
    if attributes is None:
        raise _no_store(where, root, deadline)
    own = attributes.get("gvtorch")
    if own is not None:
        _check_own(where, own)
    found = ngff.parse_image(where, _ome(attributes), image)
    if found is None and own is None:
        inner = image if image is not None else "0"  # where converters of microscopy files put it
        if ".." not in inner and not inner.startswith("/"):
            root = child(root, inner)
            deeper = _attributes(f"{where}/{inner}", root, deadline)
            found = ngff.parse_image(where, _ome(deeper), None) if deeper else None
    if found is None:
        asked = "no multiscale image" if image is None else f"no image {image!r}"
        raise ValueError(f"{where}: has {asked} (NGFF multiscales)")
    return root, found, own


def _read_json(where: str, root: Any, name: str, deadline: Deadline) -> dict[str, Any] | None:
    import tensorstore as ts

    try:
        store = deadline.wait(ts.KvStore.open(root, context=context()), where)
    except StoreError as error:
        raise ValueError(f"{where}: not a store: {error}") from None
    found = deadline.wait(store.read(name), f"{where}/{name}")
    return ngff.parse_json(f"{where}/{name}", found.value) if found.state == "value" else None


def _attributes(where: str, root: Any, deadline: Deadline) -> dict[str, Any] | None:
    """A group's attributes: of zarr.json (v3), or .zattrs (v2)."""
    group = _read_json(where, root, "zarr.json", deadline)
    if group is not None:
        attributes = group.get("attributes", {})
        if group.get("node_type") != "group" or not isinstance(attributes, dict):
            raise ValueError(f"{where}: zarr.json is that of no group; expected an OME-Zarr image")
        return attributes
    return _read_json(where, root, ".zattrs", deadline)


def _ome(attributes: dict[str, Any]) -> dict[str, Any]:
    inner = attributes.get("ome")
    return inner if isinstance(inner, dict) else attributes


def _no_store(where: str, root: Any, deadline: Deadline) -> Exception:
    if isinstance(root, dict) and not Path(where).exists():
        return FileNotFoundError(f"store not found: {where}")
    manifest = _read_json(where, child(root, WORK), "manifest.json", deadline)
    if manifest is None:
        return ValueError(f"{where}: not a store: has neither zarr.json nor .zattrs")
    import tensorstore as ts

    kept = deadline.wait(ts.KvStore.open(child(root, WORK), context=context()), where)
    journal = deadline.wait(kept.read("journal.jsonl"), where)
    done = journal.value.count(b"\n") if journal.state == "value" else 0
    return ValueError(
        f"{where}: half-written: {done} of {manifest.get('tasks', '?')} shards are done; "
        f"gvtorch convert {manifest.get('source', 'SOURCE')} {where} --resume goes on"
    )


def _check_own(where: str, own: Any) -> None:
    """Raises ValueError unless our attributes are what `convert` writes."""

    def whole(value: Any, low: int, high: int) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high

    if not isinstance(own, dict) or own.get("complete") is not True:
        raise ValueError(f"{where}: half-written or damaged: zarr.json does not say complete")
    if own.get("version") != VERSION:
        raise ValueError(f"{where}: store version {own.get('version')!r}, this reads {VERSION}")
    extent, ranges, threshold = own.get("extent"), own.get("value_range"), own.get("threshold")
    fits = {
        "extent": isinstance(extent, list)
        and len(extent) == 3
        and all(whole(n, 1, MOST_VOXELS) for n in extent),
        "dtype": own.get("dtype") in DTYPES,
        "channels": whole(own.get("channels"), 1, 2**16),
        "block": own.get("block") in BLOCKS,
        "border": own.get("border") == BORDER,
        "cell": own.get("cell") == CELL,
        "branching": own.get("branching") == 2,
        "threshold": threshold is None or isinstance(threshold, (int, float)),
        "value_range": isinstance(ranges, list)
        and len(ranges) == own.get("channels")
        and all(
            isinstance(pair, list)
            and len(pair) == 2
            and all(isinstance(value, (int, float)) for value in pair)
            for pair in ranges
        ),
    }
    for key, good in fits.items():
        if not good:
            raise ValueError(f"{where}: damaged: gvtorch.{key} is {own.get(key)!r}")


def open_arrays(
    where: str,
    root: Any,
    image: ngff.MultiscaleImage,
    moment: int,
    channels: Sequence[int] | None,
    deadline: Deadline,
) -> tuple[list[StoredArray], slice | list[int]]:
    """Opens the image's arrays that fit the tree, the finest first."""
    at = child(root, image.scales[0].path)
    is_v3 = _read_json(f"{where}/{image.scales[0].path}", at, "zarr.json", deadline) is not None
    driver = "zarr3" if is_v3 else "zarr"
    futures = [opened(root, {"driver": driver, "path": scale.path}) for scale in image.scales]
    stored: list[StoredArray] = []
    chosen: slice | list[int] = slice(None)
    for scale, future in zip(image.scales, futures, strict=True):
        name = f"{where}/{scale.path}"
        try:
            array = deadline.wait(future, name)
        except StoreError as error:
            raise ValueError(f"{name}: can't be opened: {short(error)}") from None
        _check_array(name, array, image.axes)
        if not stored:
            chosen = _choose(where, array, image.axes, moment, channels)
        axes = image.axes.replace("t", "")
        place: tuple[Any, ...] = tuple(
            moment if axis == "t" else chosen if axis == "c" else slice(None) for axis in image.axes
        )
        # Singleton axes of an index array would move: oindex leaves every axis where it is.
        array = array.oindex[place]
        first = stored[0] if stored else None
        candidate = StoredArray(array, axes, (1, 1, 1), name)
        factors = _factors(first, candidate, image.scales[0], scale)
        if factors is not None:
            stored.append(StoredArray(array, axes, factors, name))
    return stored, chosen


def _check_array(where: str, array: Any, axes: str) -> None:
    if array.rank != len(axes):
        raise ValueError(f"{where}: has {array.rank} axes, the metadata {len(axes)}: {axes}")
    voxels = math.prod(array.shape[axes.index(axis)] for axis in "zyx" if axis in axes)
    if voxels > MOST_VOXELS:
        raise ValueError(f"{where}: {voxels} voxels are more than the {MOST_VOXELS} of a store")
    if min(array.shape) < 1 or math.prod(array.shape) > MOST_VOXELS * 2**10:
        raise ValueError(f"{where}: extent {tuple(array.shape)} is empty or far too large")
    chunk = (
        math.prod(array.chunk_layout.read_chunk.shape or (1,)) * array.dtype.numpy_dtype.itemsize
    )
    if chunk > _MOST_CHUNK:
        raise ValueError(f"{where}: a chunk takes {chunk} bytes, more than {_MOST_CHUNK}")


def _choose(
    where: str, array: Any, axes: str, moment: int, channels: Sequence[int] | None
) -> slice | list[int]:
    size = {axis: int(n) for axis, n in zip(axes, array.shape, strict=True)}
    moments, width = size.get("t", 1), size.get("c", 1)
    if isinstance(moment, bool) or not isinstance(moment, int) or not 0 <= moment < moments:
        raise ValueError(f"{where}: has no time {moment!r}; it has {moments}, from 0")
    if channels is None:
        return slice(None)
    picked = list(channels)
    if not picked or not all(isinstance(c, int) and 0 <= c < width for c in picked):
        raise ValueError(f"{where}: has no channels {picked!r}; it has {width}, from 0")
    return picked if "c" in axes else slice(None)


def _factors(
    first: StoredArray | None, other: StoredArray, fine: ngff.ImageArray, coarse: ngff.ImageArray
) -> tuple[int, int, int] | None:
    """Whole factors (z, y, x) between the finest array and another; None where there are none."""
    if first is None:
        return (1, 1, 1)
    found = []
    for axis, a, b in zip("zyx", fine.scale, coarse.scale, strict=True):
        big, small = first.size(axis), other.size(axis)
        # Where scales don't tell, sizes do; a last voxel that is not full may have been dropped.
        for factor in dict.fromkeys((round(b / a), round(big / small))):
            if factor >= 1 and small in (-(-big // factor), big // factor):
                found.append(factor)
                break
    return (found[0], found[1], found[2]) if len(found) == 3 else None
