"""OME-Zarr metadata: `parse_image` (NGFF 0.1 to 0.5) and `image_metadata` (0.5).

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
    """A multiscale image: its axes in stored order, one letter each, and its arrays, finest
    first.
    """

    axes: str
    scales: tuple[ImageArray, ...]
    name: str
    unit: str | None


def is_zarr(path: str | Path) -> bool:
    """Tells a Zarr group, or what is named like one (a URL, `NAME.zarr`), from any other file."""
    text = str(path)
    if "://" in text or text.rstrip("/").endswith(".zarr"):
        return True
    return any((Path(text) / name).is_file() for name in ("zarr.json", ".zattrs", ".zgroup"))


def parse_json(where: str, content: bytes) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        ValueError: It is damaged, no object, or far too large.
    """
    if len(content) > _MOST_JSON:
        raise ValueError(f"{where}: {len(content)} bytes of JSON are too many")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: damaged JSON: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{where}: expected a JSON object, got {type(found).__name__}")
    return found


def parse_image(
    where: str, attributes: dict[str, Any], image: str | None
) -> MultiscaleImage | None:
    """Reads the multiscale image out of a group's attributes.

    Args:
        where: The group, for messages.
        attributes: `ome` of version 0.5, or the whole of `.zattrs` before that.
        image: Name or number of the image; None takes the first.

    Returns:
        The image, or None if the group has no image of this name.

    Raises:
        ValueError: The metadata is damaged.
    """
    images = attributes.get("multiscales")
    if not isinstance(images, list) or not images:
        return None
    if not all(isinstance(item, dict) for item in images):
        raise ValueError(f"{where}: multiscales must be objects")
    if image is None:
        return _image(where, images[0])
    for number, item in enumerate(images):
        if image in (item.get("name"), str(number)):
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
    scale: dict[str, float] = {}
    move: dict[str, float] = {}
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
        (scale if kind == "scale" else move).update(zip(axes, map(float, values), strict=True))
    if any(scale.get(axis, 1.0) <= 0 for axis in "zyx"):
        raise ValueError(f"{where}: scale must be positive, got {scale}")
    return (
        tuple(scale.get(axis, 1.0) for axis in "zyx"),
        tuple(move.get(axis, 0.0) for axis in "zyx"),
    )


def image_metadata(
    name: str,
    levels: int,
    *,
    spacing: Sequence[float],
    origin: Sequence[float],
    width: int,
    unit: str | None = None,
) -> dict[str, Any]:
    """Returns the `ome` attribute (0.5) of a pyramid of factor 2 in the arrays "0", "1", ...

    Args:
        name: The image's name.
        levels: Number of arrays.
        spacing: (x, y, z) of level 0.
        origin: (x, y, z) centre of voxel 0 of level 0.
        width: Channels; an axis c comes first where there are several.
        unit: Unit of length, where it is known.
    """
    axes: list[dict[str, str]] = [{"name": "c", "type": "channel"}] if width > 1 else []
    for axis in "zyx":
        axes.append({"name": axis, "type": "space"} | ({"unit": unit} if unit else {}))
    first = [1.0] if width > 1 else []
    datasets = []
    for level in range(levels):
        scale = [s * 2**level for s in reversed(spacing)]
        move = [
            o + (2**level - 1) / 2 * s
            for o, s in zip(reversed(origin), reversed(spacing), strict=True)
        ]
        transforms = [
            {"type": "scale", "scale": first + scale},
            {"type": "translation", "translation": [0.0] * len(first) + move},
        ]
        datasets.append({"path": str(level), "coordinateTransformations": transforms})
    return {
        "version": "0.5",
        "multiscales": [{"name": name, "type": "mean", "axes": axes, "datasets": datasets}],
    }
