"""What several commands share: how a volume is read, numbers in flags, the progress bar."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, arg

from ..base.digits import whole_number
from ..io.stores.ngff import is_zarr

if TYPE_CHECKING:
    from ..base.volume import Volume
    from ..io.stores.store import Store


def option(**options: Any) -> Any:
    """Returns tyro's `arg` for a flag whose help names its default only if there is one."""

    def default_hint(value: str) -> str:
        return "" if value in ("None", "False", "''") else f"(default: {value})"

    return arg(help_behavior_hint=default_hint, **options)


#: A flag that is given or not: there is no --no-NAME.
Switch = Annotated[FlagCreatePairsOff[bool], option()]


def volume_formats() -> str:
    """Returns what a volume may be, for help texts."""
    from ..io.formats import format_names

    return f"file, folder or URL; formats: {format_names()}"


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """How to read the volume, where the file does not say so itself."""

    # voxels of a RAW file, or one of unknown ending; if left out: from its name *_XxYxZ_dtype.raw
    shape: Annotated[str | None, option(metavar="X,Y,Z")] = None
    # NumPy dtype of such a file, as in int16 or >i2; if left out: from its name
    dtype: Annotated[str | None, option(metavar="TYPE")] = None
    # length of such a file's header, which is skipped; if left out: 0
    offset: Annotated[int | None, option(metavar="BYTES")] = None
    # voxel size in world units; if left out: as the file says, or 1
    spacing: Annotated[str | None, option(metavar="X,Y,Z")] = None
    # array, series, image or scene to read, by name or number, if there are several
    key: Annotated[str | None, option(metavar="NAME")] = None
    # axes of an array whose file does not name them: one letter of t, c, z, y, x for each, slowest
    # first, as in tzyx or czyx
    axes: Annotated[str | None, option(metavar="LETTERS")] = None
    # index of the time point, from 0; if left out: the first, or all for gvtorch convert
    time: Annotated[int | None, option(metavar="N")] = None
    # if voxel axes are not parallel to the world's: resample along the world's axes, or keep the
    # voxels and use their axes instead; if left out: resample
    oblique: Annotated[Literal["resample", "keep"] | None, option(metavar="{resample,keep}")] = None
    # value that replaces NaN and infinite voxels; if left out: they are an error
    nan: Annotated[float | None, option(metavar="VALUE")] = None
    # voxel values are label numbers: kept exactly, never blended, and shown with --shader labels;
    # if left out: only if the file says so
    labels: Switch = False

    def read(self, path: str | Path) -> Volume:
        from ..io.reading import read_volume

        return read_volume(path, **self.options())

    def options(self) -> dict[str, Any]:
        """Returns the options as arguments of `read_volume` and `convert`."""
        options = dict(vars(self))
        for name, number_type in (("shape", int), ("spacing", float)):
            if (text := options[name]) is not None:
                options[name] = parse_numbers(f"--{name}", text, 3, number_type)
        return options


class Bar:
    """A progress bar on standard error that appears once the work has taken a second."""

    def __init__(self, *, speed: bool = False) -> None:
        """Prepares the bar; with `speed` the progress is in bytes, and their rate is shown."""
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            Progress,
            ProgressColumn,
            TextColumn,
            TimeRemainingColumn,
            TransferSpeedColumn,
        )

        rate: tuple[ProgressColumn, ...] = (TransferSpeedColumn(),) if speed else ()
        columns = (TextColumn("{task.description}"), BarColumn(), *rate, TimeRemainingColumn())
        console = Console(stderr=True)
        disable = not console.is_terminal
        self._progress = Progress(*columns, console=console, transient=True, disable=disable)
        self._tasks: dict[str, Any] = {}
        self._timer = threading.Timer(1.0, self._progress.start)
        self._timer.daemon = True

    def __enter__(self) -> Bar:
        self._timer.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._timer.cancel()
        self._timer.join()
        if self._progress.live.is_started:
            self._progress.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Shows that `done` of `total` (0: unknown) parts of a stage are done."""
        if stage not in self._tasks:
            for task_id in self._tasks.values():
                self._progress.update(task_id, visible=False)
            self._tasks[stage] = self._progress.add_task(stage, total=total or None)
        self._progress.update(self._tasks[stage], completed=done, total=total or None)


def given_flags(options: Any) -> list[str]:
    """Returns the flags of a group of options that differ from their defaults."""
    defaults = vars(type(options)())
    return [f"--{n.replace('_', '-')}" for n, v in vars(options).items() if v != defaults[n]]


def refuse_file_flags(options: ReadOptions, *allowed: str) -> None:
    """Raises ValueError if flags for volume files are given with a store; --time and the flags in
    `allowed` are for stores too.
    """
    flags = [flag for flag in given_flags(options) if flag not in ("--time", *allowed)]
    if flags:
        raise ValueError(f"{flags[0]} is for volume files; a store has it in its metadata")


def refuse_store_flags(path: str, flags: Sequence[str]) -> None:
    """Raises ValueError if flags for stores are given with a volume file."""
    if flags:
        raise ValueError(f"{flags[0]} is for stores; make one: gvtorch convert {path} STORE.zarr")


def open_data(path: str, options: ReadOptions, *, image: str | None, level: int) -> Volume | Store:
    """Opens a store, or reads a volume; raises ValueError if a flag is for the other kind."""
    from ..io.stores.store import Store

    if is_zarr(path):
        refuse_file_flags(options)
        return Store.open(path, image=image, time=options.time or 0)
    given = {"--image": image, "--level": level}
    refuse_store_flags(path, [flag for flag, value in given.items() if value])
    return options.read(path)


def check_outputs(inputs: Mapping[str, Any], outputs: Mapping[str, Path | None]) -> None:
    """Raises ValueError if a command would overwrite a file that it reads (in a folder of pictures:
    a numbered PNG), or one in a folder that it reads, or write a file twice, FileNotFoundError if
    the folder of an output is missing. `inputs` and `outputs` map flags to paths; a text in
    `inputs` may also be FILE:NAME or FILE,NAME, or no path at all.
    """
    input_flags: dict[Path, str] = {}
    for flag, text in inputs.items():
        for file in (str(text), *(str(text).rpartition(separator)[0] for separator in ":,")):
            if text is not None and os.path.exists(file):
                input_flags[Path(os.path.realpath(file))] = flag
                break
    output_flags: dict[Path, str] = {}
    for flag, path in outputs.items():
        if path is None:
            continue
        if not path.parent.is_dir():
            raise FileNotFoundError(f"{flag}: folder not found: {path.parent}")
        real_path = Path(os.path.realpath(path))
        for source, input_flag in input_flags.items():
            is_picture = source.parent == real_path and source.match("[0-9]*.png")
            if source in (real_path, real_path.parent) or is_picture:
                raise ValueError(f"{flag} {path} would be written over what {input_flag} reads")
        if real_path in output_flags:
            raise ValueError(f"{flag} and {output_flags[real_path]} are one file: {path}")
        output_flags[real_path] = flag


def parse_numbers(flag: str, text: str, count: int, number_type: type) -> list[Any]:
    """Returns the `count` numbers of a flag's text; raises ValueError if it is anything else."""
    try:
        values = [number_type(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        noun = "whole number" if number_type is int else "number"
        wanted = f"a {noun}" if count == 1 else f"{count} {noun}s with commas between them"
        raise ValueError(f"{flag} must be {wanted}, got {text!r}")
    return values


def parse_size(text: str) -> tuple[int, int]:
    """Returns width and height of WIDTHxHEIGHT; raises ValueError if the text is anything else."""
    width, height = (whole_number(n) for n in text.lower().partition("x")[::2])
    if not width or not height:
        raise ValueError(f"--size must be WIDTHxHEIGHT in pixels, got {text!r}")
    return width, height
