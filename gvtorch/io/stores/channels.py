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
from pathlib import Path
from typing import Any

from ...base.stage import Progress, no_progress
from ..source import VolumeSource
from . import unfinished
from .conversion import convert
from .ngff import SEVERAL, read_json, read_json_file
from .store import Store
from .store_layout import WORK, Deadline, is_name, kvstore

_TIMEOUT = 20.0  # seconds
_MANIFEST = "channels.json"


def channel_names(location: str | Path) -> tuple[str, ...]:
    """Returns the channel names of a store of several channels; () for any other location.

    Raises:
        ValueError: The metadata is damaged.
        OSError: It can't be read.
    """
    where = str(location)
    content = read_json(where, kvstore(location), "zarr.json", Deadline(_TIMEOUT)) or {}
    attributes = content.get("attributes")
    named = attributes.get(SEVERAL) if isinstance(attributes, dict) else None
    if named is None:
        return ()
    if not isinstance(named, list) or not named or not all(is_name(name) for name in named):
        raise ValueError(f"{where}: damaged: {SEVERAL} is {named!r}")
    return tuple(named)


def convert_channels(
    sources: Mapping[str, VolumeSource],
    store: str | Path,
    *,
    resume: bool = False,
    progress: Progress = no_progress,
    **told: Any,
) -> Store:
    """Writes a store of several channels, one after the other.

    Args:
        sources: By name (letters, digits, "-" and "_"); all of one extent, spacing and origin.
        store: The folder to create.
        resume: Continue a half-written store.
        progress: Called with ("converting", bytes done, bytes in all), for all channels together.
        **told: block, executor and workers, as for `convert`.

    Returns:
        The store of the first channel, open; `Store.open(store, image=NAME)` opens another.

    Raises:
        ValueError: The sources have different grids, a name is invalid, or `resume` finds a store
            of other channels.
        FileExistsError, OSError, KeyboardInterrupt: As for `convert`.
    """
    target = Path(store)
    grids = {(one.extent, one.spacing, one.origin) for one in sources.values()}
    if len(grids) != 1:
        raise ValueError(f"a store's channels must be of one grid, got {len(grids)}")
    if wrong := [name for name in sources if not is_name(name)]:
        raise ValueError(f"a channel's name is made of letters, digits, - and _, got {wrong[0]!r}")
    begun = unfinished.is_begun(target, resume=resume, manifest=_MANIFEST)
    target.mkdir(exist_ok=True)
    (target / WORK).mkdir(exist_ok=True)
    manifest = target / WORK / _MANIFEST
    marks = unfinished.as_json({name: one.fingerprint() for name, one in sources.items()})
    if begun and read_json_file(manifest) != {"sources": marks}:
        raise ValueError(
            f"{target}: was begun with another source, other channels or other settings; remove "
            "the store to begin again"
        )
    unfinished.write_json(manifest, {"sources": marks})
    total, before = sum(one.nbytes for one in sources.values()), 0
    for name, source in sources.items():
        if not unfinished.is_finished(target / name):
            half = (target / name / WORK / "manifest.json").exists()
            if not half:
                shutil.rmtree(target / name, ignore_errors=True)
            share = _share(progress, before, source.nbytes, total)
            convert(source, target / name, resume=half, progress=share, **told)
        before += source.nbytes
        progress("converting", before, total)
    (target / "OME").mkdir(exist_ok=True)
    series = {"ome": {"version": "0.5", "series": [*sources]}}
    unfinished.write_json(target / "OME" / "zarr.json", unfinished.group(series))
    root = {"ome": {"version": "0.5", "bioformats2raw.layout": 3}, SEVERAL: [*sources]}
    unfinished.write_json(target / "zarr.json", unfinished.group(root))
    shutil.rmtree(target / WORK, ignore_errors=True)
    return Store.open(target)


def _share(progress: Progress, before: int, own: int, total: int) -> Progress:
    """Returns a callback that maps one channel's progress to the progress of all channels."""

    def tell(stage: str, done: int, of: int) -> None:
        progress(stage, before + own * done // max(of, 1), total)

    return tell
