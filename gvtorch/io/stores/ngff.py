"""OME-Zarr metadata: `find_image` (NGFF 0.1 to 0.5) and `image_metadata` (0.5).

All metadata is validated here before it is used. Arrays are not opened.
Source: OME-NGFF specification, versions 0.4 and 0.5 ("multiscales" and "omero" metadata).
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from ...base.image_info import ChannelInfo, ImageInfo, Rgb, Rows, from_hex, to_hex
from ...base.units import length_unit, metres, time_unit
from ..http import Endless, file_url, is_forbidden, refused
from ..remote import is_file_url
from .store_layout import JOURNAL, MANIFEST, RESUME_ADVICE, WORK, StoreLayout, is_number
from .tensorstores import MAX_JSON_BYTES, Deadline, StoreError, child, read_key

CHANNELS_ATTRIBUTE = "gvtorch_channels"  # names the images of a store of several channels
_MAX_LEVELS = 64
#: Colours written for channels that have none, since viewers want one. A single channel is white.
_COLORS = ("00ff00", "ff00ff", "00ffff", "ffff00", "ff0000", "0000ff")
_DEFAULT_AXES = "tczyx"  # in versions 0.1 and 0.2


@dataclass(frozen=True)
class ImageArray:
    """One array of a multiscale image."""

    path: str
    scale: tuple[float, ...]  # z y x
    translation: tuple[float, ...]  # z y x


@dataclass
class MultiscaleImage:
    """A multiscale image; further metadata is added to it as it is read."""

    axes: str  # in stored order, a letter each: t, c, z, y, x, or - for any other axis
    scales: tuple[ImageArray, ...]  # finest first
    name: str
    info: ImageInfo = field(default_factory=ImageInfo)
    dropped: list[str] = field(default_factory=list)  # phrases: metadata that is not kept
    store_json: dict[str, Any] = field(default_factory=dict)  # gvtorch's attributes, in its stores
    layout: StoreLayout | None = None  # what they say, in its stores


def is_zarr(path: str | Path) -> bool:
    """Returns whether a path is a Zarr group, or is named like one (a URL, `NAME.zarr`)."""
    text = str(path)
    if is_file_url(text):
        return False
    if "://" in text or text.rstrip("/").endswith(".zarr"):
        return True
    return any((Path(text) / name).is_file() for name in ("zarr.json", ".zattrs", ".zgroup"))


def find_image(
    location: str, root: Any, image: str | None, deadline: Deadline
) -> tuple[Any, MultiscaleImage]:
    """Finds a multiscale image by its name, number or folder; None finds the first.

    Returns:
        Its group's kvstore, and its metadata.

    Raises:
        ValueError: There is no such image, or the metadata is damaged.
    """
    attributes = _attributes(location, root, deadline)
    if attributes is None:
        raise _no_store_error(location, root, deadline)
    group = attributes
    pyramid = _parse_image(location, group, image)
    if pyramid is None:
        folders = _image_folders(location, root, group, deadline) if image is None else [image]
        if ".." not in folders[0] and not folders[0].startswith("/"):
            root, inner = child(root, folders[0]), f"{location}/{folders[0]}"
            group = _attributes(inner, root, deadline) or {}
            pyramid = _parse_image(inner, group, None)
            if pyramid is not None:
                _note_other_images(pyramid, folders[1:])
    if pyramid is None:
        problem = "no multiscale image" if image is None else f"no image {image!r}"
        plate = "; it is a plate: name a field of view, as in 'A/1/0'"
        plate_hint = plate if _ngff_attribute(attributes, "plate") is not None else ""
        names = _image_names(attributes) if image is not None else []
        names_hint = f"; it holds {_join_some(names)}" if names else ""
        raise ValueError(f"{location}: has {problem} (NGFF multiscales){names_hint}{plate_hint}")
    pyramid.dropped += _label_notes(location, root, group, deadline)
    return root, pyramid


def read_json(
    location: str, root: Any, name: str, deadline: Deadline, max_bytes: int = MAX_JSON_BYTES
) -> dict[str, Any] | None:
    """Reads a JSON object from a file in a folder, as `parse_json`; None if there is no file, which
    servers also tell by 403, or by sending a page in its place.
    """
    try:
        content = read_key(location, root, name, deadline, max_bytes=max_bytes)
    except StoreError as error:
        if isinstance(root, str) and is_forbidden(error):
            return None
        raise
    if content is None or (isinstance(root, str) and content.lstrip()[:1] == b"<"):
        return None
    return parse_json(f"{location}/{name}", content, max_bytes)


def parse_json(location: str, content: bytes, max_bytes: int = MAX_JSON_BYTES) -> dict[str, Any]:
    """Parses a JSON object; raises ValueError if it is damaged, not an object, or too long."""
    if len(content) > max_bytes:
        raise ValueError(f"{location}: more than {max_bytes} bytes of JSON are too many")
    try:
        value = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{location}: damaged JSON: {error}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{location}: expected a JSON object, got {type(value).__name__}")
    return value


def read_json_file(file: Path) -> dict[str, Any]:
    """Reads a JSON object from a file on disk, as `parse_json`."""
    from .chunk_files import check_file  # it imports NumPy, for which start-up must not wait

    try:
        check_file(str(file), MAX_JSON_BYTES)
    except Endless as error:
        raise ValueError(f"{file}: {error}") from None
    return parse_json(str(file), file.read_bytes())


def _attributes(location: str, root: Any, deadline: Deadline) -> dict[str, Any] | None:
    """Returns a group's attributes, from zarr.json (v3) or .zattrs (v2), which a group may lack."""
    group = read_json(location, root, "zarr.json", deadline)
    if group is None:
        attributes = read_json(location, root, ".zattrs", deadline)
        is_group = attributes is None and read_json(location, root, ".zgroup", deadline) is not None
        return {} if is_group else attributes
    attributes = group.get("attributes", {})
    if group.get("node_type") != "group" or not isinstance(attributes, dict):
        raise ValueError(f"{location}: zarr.json is that of no group; expected an OME-Zarr image")
    return attributes


def _no_store_error(location: str, root: Any, deadline: Deadline) -> Exception:
    if isinstance(root, dict) and not Path(root["path"]).exists():
        return FileNotFoundError(f"store not found: {location}")
    work_folder = child(root, WORK)
    manifest = read_json(location, work_folder, MANIFEST, deadline)
    if manifest is None:
        reason = refused(file_url(root, "zarr.json")) if isinstance(root, str) else ""
        note = f" ({reason})" if reason else ""
        return ValueError(f"{location}: not a store: has neither zarr.json nor .zattrs{note}")
    done = (read_key(location, work_folder, JOURNAL, deadline) or b"").count(b"\n")
    shards = f"{done} of {manifest.get('tasks', '?')} shards are done"
    return ValueError(f"{location}: half-written: {shards}; {RESUME_ADVICE}")


def _parse_image(
    location: str, attributes: dict[str, Any], image: str | None
) -> MultiscaleImage | None:
    """Returns the image of this name or number from a group's attributes; None if not found."""
    store_json = attributes.get("gvtorch")
    layout = None if store_json is None else StoreLayout.parse(location, store_json)
    images = _ngff_attribute(attributes, "multiscales")
    if not isinstance(images, list) or not images:
        return None
    if not all(isinstance(item, dict) for item in images):
        raise ValueError(f"{location}: multiscales must be objects")
    for number, item in enumerate(images):
        if image in (None, item.get("name"), str(number)):
            pyramid = _parse_multiscale(location, item, _ngff_attribute(attributes, "omero"))
            labels = _ngff_attribute(attributes, "image-label")
            if isinstance(labels, dict):
                pyramid.info = replace(pyramid.info, labels=True)
                ignored = (name for name in ("colors", "properties") if labels.get(name))
                pyramid.dropped += [f"{name} of the labels" for name in ignored]
            if layout is not None:
                pyramid.layout, pyramid.store_json = layout, attributes["gvtorch"]
                pyramid.info = _stored_info(pyramid.store_json.get("info"), pyramid.info)
            others = [str(other.get("name", n)) for n, other in enumerate(images) if n != number]
            _note_other_images(pyramid, others if image is None else [])
            return pyramid
    return None


def _image_names(attributes: dict[str, Any]) -> list[str]:
    """Returns the names under which `find_image` finds the images that a group lists."""
    listed = _ngff_attribute(attributes, "multiscales"), attributes.get(CHANNELS_ATTRIBUTE)
    images, folders = (items if isinstance(items, list) else [] for items in listed)
    names = [str(item.get("name", n)) for n, item in enumerate(images) if isinstance(item, dict)]
    return [*names, *(name for name in folders if isinstance(name, str))]


def _join_some(names: list[str]) -> str:
    shown = [name if len(name) < 50 else brief(name) for name in names[:5]]
    return ", ".join(shown) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _ngff_attribute(attributes: dict[str, Any], name: str) -> Any:
    """Returns an attribute of NGFF; version 0.5 keeps them in `ome`."""
    ome = attributes.get("ome")
    return (ome if isinstance(ome, dict) else attributes).get(name)


def _note_other_images(image: MultiscaleImage, others: list[str]) -> None:
    if others:
        hint = f"beside {brief(image.name)} (key= or image= names one)"
        image.dropped.append(f"the images {_join_some(others)} {hint}")


def _image_folders(
    location: str, root: Any, attributes: dict[str, Any], deadline: Deadline
) -> list[str]:
    """Returns the folders of the images in a group: the channels of a store of several, or the
    series that OME lists, else "0", and "1" if there is such an image (bioformats2raw's layout).
    """
    folders = attributes.get(CHANNELS_ATTRIBUTE)
    try:
        if folders is None:
            ome = _attributes(f"{location}/OME", child(root, "OME"), deadline)
            folders = _ngff_attribute(ome or {}, "series")
        if not isinstance(folders, list):
            has_second = _attributes(f"{location}/1", child(root, "1"), deadline) is not None
            folders = ["0", "1"] if has_second else ["0"]
    except (OSError, ValueError):  # damage there must not prevent opening the image
        return ["0"]
    return [folder for folder in folders if isinstance(folder, str)] or ["0"]


def _label_notes(
    location: str, root: Any, attributes: dict[str, Any], deadline: Deadline
) -> list[str]:
    """Returns a phrase on the label images in the image's group `labels`, if it has any. That group
    has the same version of Zarr as the image, so a server is asked for one file.
    """
    name = "zarr.json" if "ome" in attributes else ".zattrs"
    try:
        group = read_json(f"{location}/labels", child(root, "labels"), name, deadline) or {}
    except (OSError, ValueError):
        return []
    group = group.get("attributes", group)
    labels = _ngff_attribute(group, "labels") if isinstance(group, dict) else None
    if not isinstance(labels, list) or not labels:
        return []
    return [f"the labels {_join_some([f'labels/{name}' for name in labels])}"]


def _stored_info(stored: Any, info: ImageInfo) -> ImageInfo:
    """Returns `info` with the metadata that gvtorch stores in addition to NGFF's."""
    stored = stored if isinstance(stored, dict) else {}
    quantity, space = (stored.get(name) for name in ("quantity", "space"))
    return replace(
        info,
        channels=_forget_assumed(info.channels, stored.get("assumed")),
        quantity=quantity if isinstance(quantity, str) else None,
        space=space if isinstance(space, str) else None,
        labels=stored.get("labels") is True,
        pose=_parse_pose(stored.get("pose")),
    )


def _parse_pose(rows: Any) -> Rows | None:
    """Returns a (4, 4) matrix of numbers; None for anything else."""
    is_list = isinstance(rows, list) and len(rows) == 4 and all(isinstance(r, list) for r in rows)
    if not is_list or not all(len(row) == 4 and all(map(is_number, row)) for row in rows):
        return None
    return tuple(tuple(map(float, row)) for row in rows)


def _parse_multiscale(location: str, item: dict[str, Any], omero: Any) -> MultiscaleImage:
    axes, units, dropped = _parse_axes(location, item.get("axes"))
    datasets = item.get("datasets")
    if not isinstance(datasets, list) or not 1 <= len(datasets) <= _MAX_LEVELS:
        raise ValueError(f"{location}: multiscales must have 1 to {_MAX_LEVELS} datasets")
    outer = _parse_transforms(location, item.get("coordinateTransformations"), axes, dropped)
    factors, scales, times = _unit_factors(units, dropped), [], []
    for dataset in datasets:
        path: Any = dataset.get("path") if isinstance(dataset, dict) else None
        is_inside = isinstance(path, str) and path and path.isprintable() and path[0] != "/"
        if not is_inside or ".." in path:
            raise ValueError(
                f"{location}: a dataset needs a path inside the store, got {brief(path)}"
            )
        transforms = dataset.get("coordinateTransformations")
        scale, translation = _parse_transforms(location, transforms, axes, dropped)
        time_scale, *zyx = (a * b for a, b in zip(scale, outer[0], strict=True))
        time_offset, *offsets = (m * s + o for m, s, o in zip(translation, *outer, strict=True))
        spacing, position = (
            tuple(a * f for a, f in zip(lengths, factors, strict=True))
            for lengths in (zyx, offsets)
        )
        scales.append(ImageArray(path.strip("/"), spacing, position))
        times.append((time_scale, time_offset))
    name = item.get("name")
    channels, damaged = _read_channels(omero) if omero is not None else ((), [])
    (step, origin), step_unit = times[0], units.get("t")
    has_time_step = "t" in axes and step > 0 and (step_unit is not None or step != 1)
    info = ImageInfo(
        unit=units.get("x"),
        channels=channels,
        time_step=step if has_time_step else None,
        time_origin=origin if "t" in axes else 0.0,
        time_unit=step_unit,
    )
    name = name if isinstance(name, str) else "image"
    return MultiscaleImage(axes, tuple(scales), name, info, [*dict.fromkeys(dropped + damaged)])


def _unit_factors(units: dict[str, str], dropped: list[str]) -> list[float]:
    """Returns factors along z, y, x that convert lengths to the unit of x."""
    x_unit, factors = units.get("x"), []
    for axis in "zyx":
        unit = units.get(axis)
        metres_per_unit, metres_per_x, factor = metres(unit), metres(x_unit), 1.0
        if metres_per_unit and metres_per_x:
            factor = float(f"{metres_per_unit / metres_per_x:.12g}")
        elif unit is not None and unit != x_unit:
            dropped.append(f"unit {brief(unit)} of {axis}, where that of x is {x_unit!r}")
        factors.append(factor)
    return factors


def _parse_axes(location: str, axes: Any) -> tuple[str, dict[str, str], list[str]]:
    """Returns a letter for each axis, their units by letter, and phrases on what is not kept."""
    if axes is None:
        return _DEFAULT_AXES, {}, []
    axis_order, units, dropped = "", dict[str, str](), list[str]()
    for axis in axes if isinstance(axes, list) else [None]:
        fields = axis if isinstance(axis, dict) else {"name": axis}
        name, kind, unit = (fields.get(key) for key in ("name", "type", "unit"))
        if not isinstance(name, str):
            raise ValueError(f"{location}: axes must have names, got {brief(name)}")
        letter = name.lower() if name.lower() in ("t", "c", "z", "y", "x") else None
        letter = letter or {"time": "t", "channel": "c"}.get(str(kind), "-")
        axis_order += letter
        if isinstance(unit, str):  # writers also spell it in other ways than NGFF
            units[letter] = (time_unit if letter == "t" else length_unit)(unit) or unit
    named_axes = axis_order.replace("-", "")
    if len(set(named_axes)) != len(named_axes) or not {"y", "x"} <= set(named_axes):
        names = ", ".join(brief(a.get("name") if isinstance(a, dict) else a) for a in axes[:8])
        raise ValueError(f"{location}: axes must have y and x, each of them once, got {names}")
    return axis_order, units, dropped


def _parse_transforms(
    location: str, items: Any, axes: str, dropped: list[str]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns scale and translation along t, z, y, x; 1 and 0 where they are not given."""
    transform = {"scale": dict.fromkeys("tzyx", 1.0), "translation": dict.fromkeys("tzyx", 0.0)}
    for item in items if isinstance(items, list) else []:
        kind = item.get("type") if isinstance(item, dict) else None
        if kind not in ("scale", "translation"):
            if kind != "identity":
                dropped.append(f"a transformation of type {brief(kind)}")
            continue
        values = item.get(kind)
        is_numeric = isinstance(values, list) and all(map(is_number, values))
        if not is_numeric or len(values) != len(axes):
            raise ValueError(f"{location}: {kind} must be {len(axes)} numbers, got {brief(values)}")
        transform[kind].update(zip(axes, map(float, values), strict=True))
    scale, translation = (tuple(transform[kind][axis] for axis in "tzyx") for kind in transform)
    if min(scale[1:]) <= 0:
        raise ValueError(f"{location}: scale must be positive, got {scale[1:]} (z, y, x)")
    return scale, translation


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
    time_step = 1.0 if info.time_step is None else info.time_step
    steps = dict(zip("xyztc", (*spacing, time_step, 1.0), strict=True))
    origins = dict(zip("xyztc", (*origin, info.time_origin, 0.0), strict=True))
    axes = [
        {"name": axis, "type": kinds[axis]} | ({"unit": units[axis]} if units[axis] else {})
        for axis in layout.axes
    ]
    datasets = []
    for level in range(layout.levels):
        factors = [2**level if axis in "xyz" else 1 for axis in layout.axes]
        pairs = list(zip(layout.axes, factors, strict=True))
        scale = [steps[axis] * factor for axis, factor in pairs]
        translation = [origins[axis] + (factor - 1) / 2 * steps[axis] for axis, factor in pairs]
        transforms = {"scale": scale, "translation": translation}
        listed = [{"type": kind, kind: numbers} for kind, numbers in transforms.items()]
        datasets.append({"path": str(level), "coordinateTransformations": listed})
    method = "mode" if info.labels else "mean"  # how coarse levels are made
    multiscale = {"name": name, "type": method, "axes": axes, "datasets": datasets}
    ome: dict[str, Any] = {"version": "0.5", "multiscales": [multiscale]}
    extras: dict[str, Any] = {"quantity": info.quantity, "space": info.space, "labels": info.labels}
    extras["pose"] = info.pose
    if info.channels:
        ome["omero"], extras["assumed"] = _write_channels(info.channels, layout.value_range or ())
    return ome, {key: value for key, value in extras.items() if value}


# --- omero: names, colours and windows of channels


def _read_channels(omero: Any) -> tuple[tuple[ChannelInfo, ...], list[str]]:
    """Returns the channels, and phrases on metadata that is damaged or not kept. A viewer's initial
    state (rdefs) and a server's image number (id) are ignored: they are not part of the data.
    """
    entries = omero.get("channels") if isinstance(omero, dict) else None
    if not isinstance(entries, list) or not all(isinstance(channel, dict) for channel in entries):
        return (), ["omero, which holds no list of channels"]
    channels, dropped = [], []
    for number, channel in enumerate(entries):
        color, window = _parse_color(channel.get("color")), _parse_window(channel.get("window"))
        for name, value in (("color", color), ("window", window)):
            if value is None and channel.get(name) is not None:
                dropped.append(f"{name} {brief(channel[name])} of channel {number}")
        if channel.get("inverted") is True:
            dropped.append(f"channel {number} is shown inverted")
        label, active = channel.get("label"), channel.get("active") is not False
        name = "" if label is None else str(label)
        channels.append(ChannelInfo(name=name, color=color, window=window, active=active))
    return tuple(channels), dropped


def _write_channels(
    channels: Sequence[ChannelInfo], value_range: Sequence[Sequence[float]]
) -> tuple[dict[str, Any], dict[str, list[int]]]:
    """Returns the `omero` attribute of channels, and the numbers of those without a colour or a
    window: the specification requires both, so they are made up.
    """
    assumed: dict[str, list[int]] = {"color": [], "window": []}
    entries = []
    for number, (channel, (low, high)) in enumerate(zip(channels, value_range, strict=True)):
        for name, numbers in assumed.items():
            if getattr(channel, name) is None:
                numbers.append(number)
        color = _COLORS[number % len(_COLORS)] if len(channels) > 1 else "ffffff"
        start, end = (low, high) if channel.window is None else channel.window
        entry = {
            "label": channel.name,
            "color": (color if channel.color is None else to_hex(channel.color)).upper(),
            "window": {"min": min(low, start), "max": max(high, end), "start": start, "end": end},
            "active": channel.active,
        }
        entries.append(entry)
    return {"channels": entries}, {name: numbers for name, numbers in assumed.items() if numbers}


def _forget_assumed(channels: Sequence[ChannelInfo], assumed: Any) -> tuple[ChannelInfo, ...]:
    """Returns the channels without the colours and windows that `_write_channels` made up."""
    fields = assumed if isinstance(assumed, dict) else {}
    cleaned = list(channels)
    for name in ("color", "window"):
        for number in fields[name] if isinstance(fields.get(name), list) else ():
            if number in range(len(cleaned)):
                cleared: dict[str, Any] = {name: None}
                cleaned[number] = replace(cleaned[number], **cleared)
    return tuple(cleaned)


def _parse_color(text: Any) -> Rgb | None:
    color = text if isinstance(text, str) else ""
    match = re.fullmatch(r"#?([0-9a-fA-F]{6})([0-9a-fA-F]{2})?", color)
    return None if match is None else from_hex(match[1])


def _parse_window(window: Any) -> tuple[float, float] | None:
    if not isinstance(window, dict):
        return None
    low: Any = window.get("start", window.get("min"))
    high: Any = window.get("end", window.get("max"))
    is_valid = is_number(low) and is_number(high) and low <= high
    return (float(low), float(high)) if is_valid else None
