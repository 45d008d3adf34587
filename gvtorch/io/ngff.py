"""OME-Zarr metadata: `find_image` (NGFF 0.1 to 0.5) and `image_metadata` (0.5).

What a file says is checked here before anything is done with it. Arrays are not opened.
Source: OME-NGFF specification, versions 0.4 and 0.5 (multiscales).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .store_layout import WORK, Deadline, StoreLayout, child, read_key

_MOST_LEVELS = 64
_MOST_JSON = 1 << 24  # bytes
_DEFAULT_AXES = "tczyx"  # of versions 0.1 and 0.2


@dataclass(frozen=True)
class ImageArray:
    """One array of a multiscale image."""

    path: str
    scale: tuple[float, float, float]  # z y x
    translation: tuple[float, float, float]  # z y x


@dataclass(frozen=True)
class MultiscaleImage:
    """A multiscale image."""

    axes: str  # in stored order, a letter each
    scales: tuple[ImageArray, ...]  # finest first
    name: str
    unit: str | None


def is_zarr(path: str | Path) -> bool:
    """Tells a Zarr group, or what is named like one (a URL, `NAME.zarr`), from any other file."""
    text = str(path)
    if "://" in text or text.rstrip("/").endswith(".zarr"):
        return True
    return any((Path(text) / name).is_file() for name in ("zarr.json", ".zattrs", ".zgroup"))


def find_image(
    where: str, root: Any, image: str | None, deadline: Deadline
) -> tuple[Any, MultiscaleImage, StoreLayout | None]:
    """Finds a multiscale image by its name, number or folder; None takes the first.

    Returns:
        Its group's kvstore, what the metadata tells, and the layout if it is a store of ours.

    Raises:
        ValueError: There is none, or the metadata is damaged.
    """
    attributes = _attributes(where, root, deadline)
    if attributes is None:
        raise _no_store(where, root, deadline)
    own = attributes.get("gvtorch")
    layout = None if own is None else StoreLayout.parse(where, own)
    found = _parse_image(where, attributes, image)
    if found is None and layout is None:
        inner = "0" if image is None else image  # where converters of microscopy files put it
        if ".." not in inner and not inner.startswith("/"):
            root = child(root, inner)
            deeper = _attributes(f"{where}/{inner}", root, deadline)
            found = _parse_image(where, deeper, None) if deeper else None
    if found is None:
        asked = "no multiscale image" if image is None else f"no image {image!r}"
        raise ValueError(f"{where}: has {asked} (NGFF multiscales)")
    return root, found, layout


def read_json(where: str, root: Any, name: str, deadline: Deadline) -> dict[str, Any] | None:
    """Reads a JSON object of a folder, as `parse_json`; returns None if there is no such file."""
    content = read_key(where, root, name, deadline)
    return None if content is None else parse_json(f"{where}/{name}", content)


def parse_json(where: str, content: bytes) -> dict[str, Any]:
    """Reads a JSON object; raises ValueError if it is damaged, no object, or far too large."""
    if len(content) > _MOST_JSON:
        raise ValueError(f"{where}: {len(content)} bytes of JSON are too many")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: damaged JSON: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{where}: expected a JSON object, got {type(found).__name__}")
    return found


def _attributes(where: str, root: Any, deadline: Deadline) -> dict[str, Any] | None:
    """A group's attributes: of zarr.json (v3), or .zattrs (v2)."""
    group = read_json(where, root, "zarr.json", deadline)
    if group is None:
        return read_json(where, root, ".zattrs", deadline)
    attributes = group.get("attributes", {})
    if group.get("node_type") != "group" or not isinstance(attributes, dict):
        raise ValueError(f"{where}: zarr.json is that of no group; expected an OME-Zarr image")
    return attributes


def _no_store(where: str, root: Any, deadline: Deadline) -> Exception:
    if isinstance(root, dict) and not Path(where).exists():
        return FileNotFoundError(f"store not found: {where}")
    work = child(root, WORK)
    manifest = read_json(where, work, "manifest.json", deadline)
    if manifest is None:
        return ValueError(f"{where}: not a store: has neither zarr.json nor .zattrs")
    done = (read_key(where, work, "journal.jsonl", deadline) or b"").count(b"\n")
    return ValueError(
        f"{where}: half-written: {done} of {manifest.get('tasks', '?')} shards are done; "
        f"gvtorch convert {manifest.get('source', 'SOURCE')} {where} --resume goes on"
    )


def _parse_image(
    where: str, attributes: dict[str, Any], image: str | None
) -> MultiscaleImage | None:
    """Reads an image out of a group's attributes (of 0.5 those in `ome`), if it is there."""
    ome = attributes.get("ome")
    images = (ome if isinstance(ome, dict) else attributes).get("multiscales")
    if not isinstance(images, list) or not images:
        return None
    if not all(isinstance(item, dict) for item in images):
        raise ValueError(f"{where}: multiscales must be objects")
    for number, item in enumerate(images):
        if image in (None, item.get("name"), str(number)):
            return _image(where, item)
    return None


def _image(where: str, item: dict[str, Any]) -> MultiscaleImage:
    axes, unit = _axes(where, item.get("axes"))
    datasets = item.get("datasets")
    if not isinstance(datasets, list) or not 1 <= len(datasets) <= _MOST_LEVELS:
        raise ValueError(f"{where}: multiscales must have 1 to {_MOST_LEVELS} datasets")
    outer = _transform(where, item.get("coordinateTransformations"), axes)
    scales = []
    for dataset in datasets:
        path = dataset.get("path") if isinstance(dataset, dict) else None
        if not isinstance(path, str) or not path or path.startswith("/") or ".." in path:
            raise ValueError(f"{where}: a dataset needs a path inside the store, got {path!r}")
        scale, move = _transform(where, dataset.get("coordinateTransformations"), axes)
        z, y, x = (a * b for a, b in zip(scale, outer[0], strict=True))
        mz, my, mx = (m * s + o for m, s, o in zip(move, *outer, strict=True))
        scales.append(ImageArray(path.strip("/"), (z, y, x), (mz, my, mx)))
    name = item.get("name")
    return MultiscaleImage(axes, tuple(scales), name if isinstance(name, str) else "image", unit)


def _axes(where: str, axes: Any) -> tuple[str, str | None]:
    if axes is None:
        return _DEFAULT_AXES, None
    names, unit = "", None
    for axis in axes if isinstance(axes, list) else [None]:
        name = axis.get("name") if isinstance(axis, dict) else axis
        if not isinstance(name, str) or name.lower() not in ("t", "c", "z", "y", "x"):
            raise ValueError(f"{where}: axes must be among t, c, z, y, x, got {name!r}")
        names += name.lower()
        if isinstance(axis, dict) and name.lower() == "x" and isinstance(axis.get("unit"), str):
            unit = axis["unit"]
    if len(set(names)) != len(names) or not {"y", "x"} <= set(names):
        raise ValueError(f"{where}: axes must have y and x, each once, got {', '.join(names)}")
    return names, unit


def _transform(where: str, items: Any, axes: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Scale and translation along z, y, x; 1 and 0 where they are not told."""
    told = {"scale": dict.fromkeys("zyx", 1.0), "translation": dict.fromkeys("zyx", 0.0)}
    for item in items if isinstance(items, list) else []:
        kind = item.get("type") if isinstance(item, dict) else None
        if kind not in ("scale", "translation"):
            continue
        values = item.get(kind)
        plain = isinstance(values, list) and all(
            isinstance(v, (int, float)) and math.isfinite(v) for v in values
        )
        if not plain or len(values) != len(axes):
            raise ValueError(f"{where}: {kind} must be {len(axes)} numbers, got {values!r}")
        told[kind].update(zip(axes, map(float, values), strict=True))
    scale, move = (tuple(told[kind][axis] for axis in "zyx") for kind in told)
    if min(scale) <= 0:
        raise ValueError(f"{where}: scale must be positive, got {scale} (z, y, x)")
    return scale, move


def image_metadata(
    name: str,
    levels: int,
    *,
    spacing: Sequence[float],
    origin: Sequence[float],
    width: int,
    unit: str | None,
) -> dict[str, Any]:
    """Returns the `ome` attribute (0.5) of a pyramid of factor 2 in the arrays "0", "1", ...

    `spacing` and `origin` are (x, y, z) of level 0; an axis c comes first where `width` is not 1.
    """
    axes: list[dict[str, str]] = [{"name": "c", "type": "channel"}] if width > 1 else []
    axes += [{"name": axis, "type": "space"} | ({"unit": unit} if unit else {}) for axis in "zyx"]
    datasets = []
    for level in range(levels):
        factor = 2**level
        zyx = list(zip(spacing, origin, strict=True))[::-1]
        scale = [1.0] * (len(axes) - 3) + [s * factor for s, _ in zyx]
        move = [0.0] * (len(axes) - 3) + [o + (factor - 1) / 2 * s for s, o in zyx]
        transforms = [
            {"type": "scale", "scale": scale},
            {"type": "translation", "translation": move},
        ]
        datasets.append({"path": str(level), "coordinateTransformations": transforms})
    return {
        "version": "0.5",
        "multiscales": [{"name": name, "type": "mean", "axes": axes, "datasets": datasets}],
    }
