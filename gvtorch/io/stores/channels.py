"""Stores of several channels: images on one grid, each with its own dtype, side by side in one
folder, in OME-Zarr's layout for several images (`bioformats2raw.layout`).

    STORE.zarr/zarr.json      lists the channels; written last
    STORE.zarr/OME/zarr.json  lists them for other readers
    STORE.zarr/NAME/ ...      a store for each channel, see store_layout.py
    STORE.zarr/.gvtorch-work  only during the conversion: fingerprints of the sources
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ...base.stage import Progress, no_progress
from ..source import VolumeSource
from . import unfinished
from .conversion import convert
from .ngff import CHANNELS_ATTRIBUTE, read_json, read_json_file
from .store import Store
from .store_layout import WORK, is_name
from .tensorstores import Deadline, kvstore

_TIMEOUT = 20.0  # seconds
_MANIFEST = "channels.json"


def channel_names(location: str | Path) -> tuple[str, ...]:
    """Returns the channel names of a store of several channels; () for any other location.

    Raises:
        ValueError: The metadata is damaged.
        OSError: It can't be read.
    """
    context = str(location)
    group = read_json(context, kvstore(location), "zarr.json", Deadline(_TIMEOUT)) or {}
    attributes = group.get("attributes")
    names = attributes.get(CHANNELS_ATTRIBUTE) if isinstance(attributes, dict) else None
    if names is None:
        return ()
    if not isinstance(names, list) or not names or not all(is_name(name) for name in names):
        raise ValueError(f"{context}: damaged: {CHANNELS_ATTRIBUTE} is {names!r}")
    return tuple(names)


def convert_channels(
    sources: Mapping[str, VolumeSource],
    store: str | Path,
    *,
    resume: bool = False,
    progress: Progress = no_progress,
    **options: Any,
) -> Store:
    """Writes a store of several channels, one after the other.

    Args:
        sources: By name (letters, digits, "-" and "_"); all of one extent, spacing and origin.
        store: The folder to create.
        resume: Continue a half-written store.
        progress: Called with ("converting", bytes done, bytes in all), for all channels together.
        **options: block, executor and workers, as for `convert`.

    Returns:
        The store of the first channel, open; `Store.open(store, image=NAME)` opens another.

    Raises:
        ValueError: The sources have different grids, a name is invalid, or `resume` finds a store
            of other channels.
        FileExistsError, OSError, KeyboardInterrupt: As for `convert`.
    """
    target = Path(store)
    grids = {(source.extent, source.spacing, source.origin) for source in sources.values()}
    if len(grids) != 1:
        raise ValueError(f"a store's channels must be of one grid, got {len(grids)}")
    if invalid := [name for name in sources if not is_name(name)]:
        raise ValueError(f"a channel's name has letters, digits, - and _ only, got {invalid[0]!r}")
    unfinished.is_begun(target, resume=resume, manifest=_MANIFEST)
    with unfinished.claimed_folder(target):
        _write_channels(sources, target, resume, progress, options)
    return Store.open(target)


def _write_channels(
    sources: Mapping[str, VolumeSource],
    target: Path,
    resume: bool,
    progress: Progress,
    options: dict[str, Any],
) -> None:
    """Writes the channels into a folder that no other process writes to."""
    begun = unfinished.is_begun(target, resume=resume, manifest=_MANIFEST)
    manifest = target / WORK / _MANIFEST
    fingerprints = {name: source.fingerprint() for name, source in sources.items()}
    content = unfinished.as_json({"sources": fingerprints})
    if begun and read_json_file(manifest) != content:
        raise ValueError(
            f"{target}: was begun with another source, other channels or other settings; remove "
            "the store to begin again"
        )
    unfinished.write_json(manifest, content)
    total, done = sum(source.nbytes for source in sources.values()), 0
    for name, source in sources.items():
        folder = target / name
        if not unfinished.is_finished(folder):
            half_written = unfinished.is_half_written(folder)
            if not half_written:
                shutil.rmtree(folder, ignore_errors=True)
            report = partial(_report_share, progress, done, source.nbytes, total)
            convert(source, folder, resume=half_written, progress=report, **options)
        done += source.nbytes
        progress("converting", done, total)
    (target / "OME").mkdir(exist_ok=True)
    series = {"ome": {"version": "0.5", "series": [*sources]}}
    unfinished.write_json(target / "OME" / "zarr.json", unfinished.group_metadata(series))
    root = {"ome": {"version": "0.5", "bioformats2raw.layout": 3}, CHANNELS_ATTRIBUTE: [*sources]}
    unfinished.write_json(target / "zarr.json", unfinished.group_metadata(root))
    shutil.rmtree(target / WORK, ignore_errors=True)


def _report_share(
    progress: Progress, before: int, size: int, total: int, stage: str, done: int, parts: int
) -> None:
    """Reports the progress of one channel as that of all."""
    progress(stage, before + size * done // max(parts, 1), total)
