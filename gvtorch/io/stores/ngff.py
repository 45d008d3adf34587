"""OME-Zarr metadata: `find_image` (NGFF 0.1 to 0.5) and `image_metadata` (0.5).

All metadata is validated here before it is used. Arrays are not opened.
Source: OME-NGFF specification, versions 0.4 and 0.5 ("multiscales" and "omero" metadata).
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from ...base.image_info import ChannelInfo, ImageInfo, Rgb, from_hex, to_hex
from ...base.units import metres
from ..http import Endless
from ..remote import is_file_url
from .store_layout import MOST_JSON, WORK, Deadline, StoreLayout, child, is_number, read_key

SEVERAL = "gvtorch_channels"  # attribute that names the images of a store of several channels
_MOST_LEVELS = 64
#: Colours written for channels that have none, since viewers want one. A single channel is white.
_COLORS = ("00ff00", "ff00ff", "00ffff", "ffff00", "ff0000", "0000ff")
_DEFAULT_AXES = "tczyx"  # in versions 0.1 and 0.2


@dataclass(frozen=True)
class ImageArray:
    """One array of a multiscale image."""

    path: str
    scale: tuple[float, float, float]  # z y x
    translation: tuple[float, float, float]  # z y x


@dataclass
class MultiscaleImage:
    """A multiscale image; further metadata is added to it as it is read."""

    axes: str  # in stored order, a letter each: t, c, z, y, x, or - for any other axis
    scales: tuple[ImageArray, ...]  # finest first
    name: str
    info: ImageInfo = field(default_factory=ImageInfo)
    lost: list[str] = field(default_factory=list)  # phrases: metadata that is not kept
    own: dict[str, Any] = field(default_factory=dict)  # gvtorch's attributes, in its stores


def is_zarr(path: str | Path) -> bool:
    """Returns whether a path is a Zarr group, or is named like one (a URL, `NAME.zarr`)."""
    text = str(path)
    if is_file_url(text):
        return False
    if "://" in text or text.rstrip("/").endswith(".zarr"):
        return True
    return any((Path(text) / name).is_file() for name in ("zarr.json", ".zattrs", ".zgroup"))


def find_image(
    where: str, root: Any, image: str | None, deadline: Deadline
) -> tuple[Any, MultiscaleImage, StoreLayout | None]:
    """Finds a multiscale image by its name, number or folder; None finds the first.

    Returns:
        Its group's kvstore, its metadata, and its layout, which is None unless gvtorch wrote it.

    Raises:
        ValueError: There is no such image, or the metadata is damaged.
    """
    attributes = _attributes(where, root, deadline)
    if attributes is None:
        raise _no_store(where, root, deadline)
    own = attributes.get("gvtorch")
    layout = None if own is None else StoreLayout.parse(where, own)
    found = _parse_image(where, attributes, image)
    series = _member(attributes, "bioformats2raw.layout")
    if found is None and layout is None:
        first = attributes.get(SEVERAL, ["0"])  # "0": the folder used by bioformats2raw
        named = isinstance(first, list) and first and isinstance(first[0], str)
        inner = image if image is not None else first[0] if named else "0"
        if ".." not in inner and not inner.startswith("/"):
            top, root = root, child(root, inner)
            deeper = _attributes(f"{where}/{inner}", root, deadline)
            found = _parse_image(where, deeper, None) if deeper else None
            own = deeper.get("gvtorch") if deeper else None
            layout = None if own is None else StoreLayout.parse(f"{where}/{inner}", own)
            if found is not None and image is None and series is not None:
                _tell_of_images(found, _series(where, top, deadline, inner))
    if found is None:
        asked = "no multiscale image" if image is None else f"no image {image!r}"
        plate = "; it is a plate: name a field of view, as in 'A/1/0'"
        of = plate if _member(attributes, "plate") is not None else ""
        known = _image_names(attributes) if image is not None else []
        held = f"; it holds {_few(known)}" if known else ""
        raise ValueError(f"{where}: has {asked} (NGFF multiscales){held}{of}")
    if layout is not None and isinstance(own, dict):
        found.info, found.own = _own_info(own.get("info"), found.info), own
    else:
        found.lost += _labels(where, root, deadline)
    return root, found, layout


def read_json(
    where: str, root: Any, name: str, deadline: Deadline, most: int = MOST_JSON
) -> dict[str, Any] | None:
    """Reads a JSON object from a file in a folder, as `parse_json`; None if there is no file."""
    content = read_key(where, root, name, deadline, most=most)
    return None if content is None else parse_json(f"{where}/{name}", content, most)


def parse_json(where: str, content: bytes, most: int = MOST_JSON) -> dict[str, Any]:
    """Parses a JSON object; raises ValueError if it is damaged, not an object, or longer than
    `most` bytes.
    """
    if len(content) > most:
        raise ValueError(f"{where}: more than {most} bytes of JSON are too many")
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{where}: damaged JSON: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{where}: expected a JSON object, got {type(found).__name__}")
    return found


def read_json_file(file: Path) -> dict[str, Any]:
    """Reads a JSON object from a file on disk, as `parse_json`."""
    from .chunk_files import check_file  # it imports NumPy, for which start-up must not wait

    try:
        check_file(str(file), MOST_JSON)
    except Endless as error:
        raise ValueError(f"{file}: {error}") from None
    return parse_json(str(file), file.read_bytes())


def _attributes(where: str, root: Any, deadline: Deadline) -> dict[str, Any] | None:
    """Returns a group's attributes, from zarr.json (v3) or .zattrs (v2)."""
    group = read_json(where, root, "zarr.json", deadline)
    if group is None:
        return read_json(where, root, ".zattrs", deadline)
    attributes = group.get("attributes", {})
    if group.get("node_type") != "group" or not isinstance(attributes, dict):
        raise ValueError(f"{where}: zarr.json is that of no group; expected an OME-Zarr image")
    return attributes


def _no_store(where: str, root: Any, deadline: Deadline) -> Exception:
    if isinstance(root, dict) and not Path(root["path"]).exists():
        return FileNotFoundError(f"store not found: {where}")
    work = child(root, WORK)
    manifest = read_json(where, work, "manifest.json", deadline)
    if manifest is None:
        return ValueError(f"{where}: not a store: has neither zarr.json nor .zattrs")
    done = (read_key(where, work, "journal.jsonl", deadline) or b"").count(b"\n")
    return ValueError(
        f"{where}: half-written: {done} of {manifest.get('tasks', '?')} shards are done; "
        f"gvtorch convert {shlex.join((str(manifest.get('source', 'SOURCE')), where))} --resume "
        "goes on"
    )


def _parse_image(
    where: str, attributes: dict[str, Any], image: str | None
) -> MultiscaleImage | None:
    """Returns the image of this name or number from a group's attributes; None if not found."""
    images = _member(attributes, "multiscales")
    if not isinstance(images, list) or not images:
        return None
    if not all(isinstance(item, dict) for item in images):
        raise ValueError(f"{where}: multiscales must be objects")
    for number, item in enumerate(images):
        if image in (None, item.get("name"), str(number)):
            found = _image(where, item, _member(attributes, "omero"))
            labels = _member(attributes, "image-label")
            if isinstance(labels, dict):
                found.info = replace(found.info, labels=True)
                beside = (name for name in ("colors", "properties") if labels.get(name))
                found.lost += [f"{name} of the labels" for name in beside]
            others = [str(one.get("name", at)) for at, one in enumerate(images) if at != number]
            _tell_of_images(found, others if image is None else [])
            return found
    return None


def _image_names(attributes: dict[str, Any]) -> list[str]:
    """Returns the names under which `find_image` finds the images that a group lists."""
    images, folders = _member(attributes, "multiscales"), attributes.get(SEVERAL)
    scales, inner = (one if isinstance(one, list) else [] for one in (images, folders))
    names = [str(one.get("name", n)) for n, one in enumerate(scales) if isinstance(one, dict)]
    return [*names, *(one for one in inner if isinstance(one, str))]


def _few(names: list[str]) -> str:
    short = [one if len(one) < 50 else brief(one) for one in names[:5]]
    return ", ".join(short) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _member(attributes: dict[str, Any], name: str) -> Any:
    """Returns an attribute of NGFF; version 0.5 keeps them in `ome`."""
    ome = attributes.get("ome")
    return (ome if isinstance(ome, dict) else attributes).get(name)


def _tell_of_images(found: MultiscaleImage, others: list[str]) -> None:
    if others:
        beside = f"beside {brief(found.name)} (key= or image= names one)"
        found.lost.append(f"the images {_few(others)} {beside}")


def _series(where: str, root: Any, deadline: Deadline, first: str) -> list[str]:
    """Returns the names of the other images of a bioformats2raw layout."""
    try:
        listed = _attributes(f"{where}/OME", child(root, "OME"), deadline) or {}
        series = _member(listed, "series")
        if isinstance(series, list):
            return [str(path) for path in series if path != first]
        there = _attributes(f"{where}/1", child(root, "1"), deadline) is not None
    except (OSError, ValueError):  # damage there must not prevent opening the image
        return []
    return ["1"] if there else []


def _labels(where: str, root: Any, deadline: Deadline) -> list[str]:
    """Returns a phrase on the label images in the image's group `labels`, if it has any."""
    try:
        group = _attributes(f"{where}/labels", child(root, "labels"), deadline) or {}
    except (OSError, ValueError):
        return []
    labels = _member(group, "labels")
    if not isinstance(labels, list) or not labels:
        return []
    return [f"the labels {', '.join(f'labels/{name}' for name in labels[:5])}"]


def _own_info(told: Any, info: ImageInfo) -> ImageInfo:
    """Returns `info` with the metadata that gvtorch stores in addition to NGFF's."""
    told = told if isinstance(told, dict) else {}
    quantity, space = (told.get(name) for name in ("quantity", "space"))
    return replace(
        info,
        channels=_forget_assumed(info.channels, told.get("assumed")),
        quantity=quantity if isinstance(quantity, str) else None,
        space=space if isinstance(space, str) else None,
        labels=told.get("labels") is True,
    )


def _image(where: str, item: dict[str, Any], omero: Any) -> MultiscaleImage:
    axes, units, lost = _axes(where, item.get("axes"))
    datasets = item.get("datasets")
    if not isinstance(datasets, list) or not 1 <= len(datasets) <= _MOST_LEVELS:
        raise ValueError(f"{where}: multiscales must have 1 to {_MOST_LEVELS} datasets")
    outer = _transform(where, item.get("coordinateTransformations"), axes, lost)
    scales, times = [], []
    for dataset in datasets:
        path = dataset.get("path") if isinstance(dataset, dict) else None
        plain = isinstance(path, str) and path.isprintable() and ".." not in path
        if not isinstance(path, str) or not plain or not path or path.startswith("/"):
            raise ValueError(f"{where}: a dataset needs a path inside the store, got {brief(path)}")
        scale, move = _transform(where, dataset.get("coordinateTransformations"), axes, lost)
        t, *zyx = (a * b for a, b in zip(scale, outer[0], strict=True))
        mt, *moves = (m * s + o for m, s, o in zip(move, *outer, strict=True))
        factors = _in_one_unit(units, lost)
        sides, places = ([a * f for a, f in zip(one, factors, strict=True)] for one in (zyx, moves))
        scales.append(ImageArray(path.strip("/"), _triple(sides), _triple(places)))
        times.append((t, mt))
    name = item.get("name")
    channels, damaged = _read_channels(omero) if omero is not None else ((), [])
    (step, origin), period = times[0], units.get("t")
    told = "t" in axes and (period is not None or step != 1)
    info = ImageInfo(
        unit=units.get("x"),
        channels=channels,
        time_step=step if told else None,
        time_origin=origin if "t" in axes else 0.0,
        time_unit=period,
    )
    text = name if isinstance(name, str) else "image"
    return MultiscaleImage(axes, tuple(scales), text, info, list(dict.fromkeys(lost + damaged)))


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    z, y, x = values
    return (z, y, x)


def _in_one_unit(units: dict[str, str], lost: list[str]) -> list[float]:
    """Returns factors along z, y, x that convert lengths to the unit of x."""
    one, factors = units.get("x"), []
    for axis in "zyx":
        other = units.get(axis)
        size, wanted = metres(other), metres(one)
        factors.append(float(f"{size / wanted:.12g}") if size and wanted else 1.0)
        if not (size and wanted) and other is not None and other != one:
            lost.append(f"unit {brief(other)} of {axis}, where that of x is {one!r}")
    return factors


def _axes(where: str, axes: Any) -> tuple[str, dict[str, str], list[str]]:
    """Returns a letter for each axis, their units by letter, and phrases on what is not kept."""
    if axes is None:
        return _DEFAULT_AXES, {}, []
    letters, units, lost = "", dict[str, str](), list[str]()
    for axis in axes if isinstance(axes, list) else [None]:
        told = axis if isinstance(axis, dict) else {"name": axis}
        name, kind, unit = (told.get(key) for key in ("name", "type", "unit"))
        if not isinstance(name, str):
            raise ValueError(f"{where}: axes must have names, got {brief(name)}")
        letter = name.lower() if name.lower() in ("t", "c", "z", "y", "x") else None
        letter = letter or {"time": "t", "channel": "c"}.get(str(kind), "-")
        letters += letter
        if isinstance(unit, str):
            units[letter] = unit
    solid = letters.replace("-", "")
    if len(set(solid)) != len(solid) or not {"y", "x"} <= set(solid):
        names = ", ".join(brief(a.get("name") if isinstance(a, dict) else a) for a in axes[:8])
        raise ValueError(f"{where}: axes must have y and x, each of them once, got {names}")
    return letters, units, lost


def _transform(
    where: str, items: Any, axes: str, lost: list[str]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns scale and translation along t, z, y, x; 1 and 0 where they are not given."""
    told = {"scale": dict.fromkeys("tzyx", 1.0), "translation": dict.fromkeys("tzyx", 0.0)}
    for item in items if isinstance(items, list) else []:
        kind = item.get("type") if isinstance(item, dict) else None
        if kind not in ("scale", "translation"):
            if kind != "identity":
                lost.append(f"a transformation of type {brief(kind)}")
            continue
        values = item.get(kind)
        plain = isinstance(values, list) and all(map(is_number, values))
        if not plain or len(values) != len(axes):
            raise ValueError(f"{where}: {kind} must be {len(axes)} numbers, got {brief(values)}")
        told[kind].update(zip(axes, map(float, values), strict=True))
    scale, move = (tuple(told[kind][axis] for axis in "tzyx") for kind in told)
    if min(scale[1:]) <= 0:
        raise ValueError(f"{where}: scale must be positive, got {scale[1:]} (z, y, x)")
    return scale, move


def image_metadata(
    name: str,
    layout: StoreLayout,
    info: ImageInfo,
    *,
    spacing: Sequence[float],
    origin: Sequence[float],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the `ome` attribute (0.5) of a pyramid of factor 2 in the arrays "0", "1", ..., and
    the further metadata that `find_image` reads back.

    `spacing` and `origin` are (x, y, z) of level 0; axes t and c come first if they exist.
    """
    units = {"t": info.time_unit, "c": None, **dict.fromkeys("zyx", info.unit)}
    kinds = {"t": "time", "c": "channel", **dict.fromkeys("zyx", "space")}
    period = 1.0 if info.time_step is None else info.time_step
    step = dict(zip("xyztc", (*spacing, period, 1.0), strict=True))
    first = dict(zip("xyztc", (*origin, info.time_origin, 0.0), strict=True))
    axes = [
        {"name": axis, "type": kinds[axis]} | ({"unit": units[axis]} if units[axis] else {})
        for axis in layout.axes
    ]
    datasets = []
    for level in range(layout.levels):
        factors = [2**level if axis in "xyz" else 1 for axis in layout.axes]
        pairs = list(zip(layout.axes, factors, strict=True))
        scale = [step[axis] * factor for axis, factor in pairs]
        move = [first[axis] + (factor - 1) / 2 * step[axis] for axis, factor in pairs]
        transforms = [
            {"type": "scale", "scale": scale},
            {"type": "translation", "translation": move},
        ]
        datasets.append({"path": str(level), "coordinateTransformations": transforms})
    how = "mode" if info.labels else "mean"  # how coarse levels are made
    ome: dict[str, Any] = {
        "version": "0.5",
        "multiscales": [{"name": name, "type": how, "axes": axes, "datasets": datasets}],
    }
    beside: dict[str, Any] = {
        "quantity": info.quantity,
        "space": info.space,
        "labels": info.labels or None,
    }
    if info.channels:
        ome["omero"], assumed = _write_channels(info.channels, layout.value_range or ())
        beside["assumed"] = assumed or None
    return ome, {key: value for key, value in beside.items() if value}


# --- omero: names, colours and windows of channels


def _read_channels(omero: Any) -> tuple[tuple[ChannelInfo, ...], list[str]]:
    """Returns the channels, and phrases on metadata that is damaged or not kept. A viewer's initial
    state (rdefs) and a server's image number (id) are ignored: they are not part of the data.
    """
    told = omero.get("channels") if isinstance(omero, dict) else None
    if not isinstance(told, list) or not all(isinstance(channel, dict) for channel in told):
        return (), ["omero, which holds no list of channels"]
    found, lost = [], []
    for number, channel in enumerate(told):
        color, window = _shown_color(channel.get("color")), _shown_window(channel.get("window"))
        for name, value in (("color", color), ("window", window)):
            if value is None and channel.get(name) is not None:
                lost.append(f"{name} {brief(channel[name])} of channel {number}")
        if channel.get("inverted") is True:
            lost.append(f"channel {number} is shown inverted")
        label, active = channel.get("label"), channel.get("active")
        name = label if isinstance(label, str) else "" if label is None else str(label)
        shown = active is not False
        found.append(ChannelInfo(name=name, color=color, window=window, active=shown))
    return tuple(found), lost


def _write_channels(
    channels: Sequence[ChannelInfo], value_range: Sequence[Sequence[float]]
) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Returns the `omero` attribute of channels, and the numbers of those without a colour or a
    window: the specification requires both, so they are made up.
    """
    assumed: dict[str, list[int]] = {"color": [], "window": []}
    written = []
    for number, (channel, (low, high)) in enumerate(zip(channels, value_range, strict=True)):
        for name, numbers in assumed.items():
            if getattr(channel, name) is None:
                numbers.append(number)
        color = _COLORS[number % len(_COLORS)] if len(channels) > 1 else "ffffff"
        start, end = (low, high) if channel.window is None else channel.window
        one = {
            "label": channel.name,
            "color": (color if channel.color is None else to_hex(channel.color)).upper(),
            "window": {"min": min(low, start), "max": max(high, end), "start": start, "end": end},
            "active": channel.active,
        }
        written.append(one)
    return {"channels": written}, {name: numbers for name, numbers in assumed.items() if numbers}


def _forget_assumed(channels: Sequence[ChannelInfo], assumed: Any) -> tuple[ChannelInfo, ...]:
    """Returns the channels without the colours and windows that `_write_channels` made up."""
    told = assumed if isinstance(assumed, dict) else {}
    lists = {name: told[name] for name in ("color", "window") if isinstance(told.get(name), list)}
    kept = []
    for number, channel in enumerate(channels):
        empty: dict[str, Any] = {name: None for name, some in lists.items() if number in some}
        kept.append(replace(channel, **empty))
    return tuple(kept)


def _shown_color(text: Any) -> Rgb | None:
    plain = text if isinstance(text, str) else ""
    found = re.fullmatch(r"#?([0-9a-fA-F]{6})([0-9a-fA-F]{2})?", plain)
    return None if found is None else from_hex(found[1])


def _shown_window(told: Any) -> tuple[float, float] | None:
    if not isinstance(told, dict):
        return None
    ends: list[Any] = [told.get("start", told.get("min")), told.get("end", told.get("max"))]
    if not all(map(is_number, ends)) or ends[0] > ends[1]:
        return None
    return (float(ends[0]), float(ends[1]))
