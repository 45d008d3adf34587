"""The command line: `gvtorch info`, `view`, `render`, `fly`, `slice`, `surface`, `convert`,
`voxelize`, `splat`, `filter` and `bench`.

torch is imported inside the commands, so that `--help` answers at once. A mistake of the user ends
in one line on standard error and status 2.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal, NoReturn

import tyro
from tyro.conf import Positional

from ..base.declared import did_you_mean
from ..base.messages import one_line, printable
from ..io.stores.ngff import is_zarr
from .bench import Bench
from .common import Bar, ReadOptions, Switch, given_flags, option, refuse_file_flags, volume_formats
from .fly import Fly
from .making import ConversionFlags, Splat, Voxelize, store_summary
from .render import Render
from .slice import Slice
from .surface import Surface
from .view import View


@dataclass(frozen=True, kw_only=True)
class Info:
    """Show information on this installation, a volume file, or a store."""

    # volume or store to describe; if left out: backends, devices, formats and versions
    path: Positional[Annotated[str | None, option(metavar="PATH")]] = None
    # print JSON
    json: Switch = False

    # How to read a volume file that does not say so itself; a store takes only --time and --key.
    source: tyro.conf.OmitArgPrefixes[ReadOptions] = ReadOptions()

    def run(self) -> None:
        if self.path is None:
            flags = given_flags(self.source)
            if flags:
                raise ValueError(f"{flags[0]} is for volume files: name one")
            content = installation()
        elif is_zarr(self.path):
            from ..io.stores.store import Store

            refuse_file_flags(self.source, "--key")
            store = Store.open(self.path, image=self.source.key, time=self.source.time or 0)
            content = store.describe()
        else:
            from ..io.reading import MAX_VOXELS, open_source, volume_of

            path, options = self.path, self.source.options()
            nan = options.pop("nan")

            def description(**more: Any) -> dict[str, Any]:
                source = open_source(path, max_values=MAX_VOXELS, **options | more)
                series = {"times": source.times, "time": source.time} if source.times > 1 else {}
                return volume_of(source, nan).describe() | series

            with Bar() as bar:
                bar("reading", 0, 0)
                try:
                    content = description()
                except ValueError as error:
                    if "--labels" not in str(error):
                        raise
                    warnings.warn(f"{error}; shown as labels", stacklevel=2)
                    content = description(labels=True)
        if self.json:
            print(json.dumps(content))
        else:
            _print_table(content)


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Convert a volume of any size to a store: OME-Zarr with bordered blocks."""

    path: Positional[Annotated[str, option(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    # folder to create
    store: Positional[Annotated[Path, option(metavar="STORE.zarr")]]
    # leave out blocks with no value above this
    threshold: Annotated[float | None, option(metavar="VALUE")] = None
    # most memory of all processes together, as in "2 GB"; if left out: all that is free
    memory: Annotated[str | None, option(metavar="BYTES")] = None
    # print the estimated disk space, memory and time, and write nothing
    dry_run: Switch = False

    conversion: tyro.conf.OmitArgPrefixes[ConversionFlags] = ConversionFlags()
    source: tyro.conf.OmitArgPrefixes[ReadOptions] = ReadOptions()

    def run(self) -> None:
        from ..io.stores.conversion import convert, estimate

        self.conversion.check()
        arguments: dict[str, Any] = {**self.source.options(), "threshold": self.threshold}
        arguments["memory"] = self.memory
        if self.dry_run:
            from ..base import check
            from ..io.stores.unfinished import is_begun

            is_begun(self.store, resume=self.conversion.resume)  # raises as `convert` would
            if self.memory is not None:
                check.nbytes("convert", "--memory", self.memory)
            arguments |= {"block": self.conversion.block, "workers": self.conversion.workers}
            _print_table(_readable(estimate(self.path, self.store, **arguments).as_dict()))
            return
        start, was_finished = time.perf_counter(), (self.store / "zarr.json").exists()
        with self.conversion.arguments(speed=True) as store_options:
            store = convert(self.path, self.store, **arguments, **store_options)
        if was_finished:  # --resume had nothing to do
            print(f"{printable(self.store)}: is finished already")
            return
        print(store_summary(self.store, [store], start))


@dataclass(frozen=True, kw_only=True)
class Filter:
    """Add filtered colours to a store: `--shader filtered` then shows it correctly from afar."""

    # store that gvtorch convert made; its voxels are not changed
    store: Positional[Annotated[Path, option(metavar="STORE.zarr")]]
    # transfer function to make the colours with, as in gvtorch render; if left out: gray
    tf: Annotated[str | None, option(metavar="FILE|PRESET")] = None
    # values that the transfer function is stretched over, as in gvtorch render
    window: Annotated[str | None, option(metavar="LO,HI")] = None
    # index of the number that the transfer function reads, for voxels with several
    component: Annotated[int, option(metavar="N")] = 0
    # store normals as well, for --shader filtered-lit
    lit: Switch = False
    # store colours for each of six directions, or one mean of them, a sixth of the size; auto: six
    # if a voxel may hide over a fifth of what is behind it
    directions: Literal["auto", "six", "one"] = "auto"
    # where colours are computed; if left out: cuda if available, else cpp
    backend: Annotated[Literal["cpp", "cuda"] | None, option(metavar="{cpp,cuda}")] = None

    def run(self) -> None:
        from ..io.resources import amount
        from ..io.stores.store import Store
        from ..ops.registry import device_of
        from ..shaders import Filtered, Lit
        from .parse import parse_transfer

        start, store = time.perf_counter(), Store.open(self.store)
        bytes_before = store.describe()["disk bytes"]
        with Bar() as bar:
            transfer = parse_transfer(self.tf, self.window, store, self.component)
            for time_index in range(store.times):
                Filtered.add_to(
                    store if time_index == 0 else Store.open(self.store, time=time_index),
                    Lit(transfer) if self.lit else transfer,
                    component=self.component,
                    directions={"auto": None, "six": True, "one": False}[self.directions],
                    device=device_of(self.backend or "auto"),
                    progress=bar,
                )
        added = amount(max(0, store.describe()["disk bytes"] - bytes_before))
        print(f"{printable(self.store)}: {added} of colours in {time.perf_counter() - start:.1f} s")


def installation() -> dict[str, Any]:
    """Returns versions, what each backend can do here, the devices, and the file formats."""
    import platform

    import torch

    from .. import __version__
    from ..io.formats import FORMATS
    from ..ops import unavailable

    threads = torch.get_num_threads()
    gpu_indices = range(torch.cuda.device_count()) if torch.cuda.is_available() else ()
    return {
        "gvtorch": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backends": {name: reason or "ready" for name, reason in unavailable().items()},
        "devices": [
            f"cpu ({threads} thread{'s' * (threads > 1)})",
            *(f"cuda:{i} ({torch.cuda.get_device_name(i)})" for i in gpu_indices),
        ],
        "formats": {file_format.name: file_format.status for file_format in FORMATS},
    }


def _readable(content: dict[str, Any]) -> dict[str, Any]:
    """Returns names with blanks for underscores, bytes in readable units, and rounded seconds."""
    from ..io.resources import amount

    out = {}
    for name, value in content.items():
        is_bytes = name.endswith(("_bytes", "_free"))
        text = amount(value) if is_bytes else f"{value:.1f}" if name == "seconds" else value
        out[name.removesuffix("_bytes").replace("_", " ")] = text
    return out


def _print_table(content: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None)
    for name, value in content.items():
        if value is None:
            continue
        if name == "histogram":
            text = _sparkline(value)
        elif isinstance(value, dict):
            text = "\n".join(printable(f"{key}: {item}") for key, item in value.items())
        elif isinstance(value, (list, tuple)):
            text = ", ".join(map(_cell_text, value))
        else:
            text = _cell_text(value)
        table.add_row(Text(name, "bold"), Text(text))
    Console().print(table)


def _cell_text(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_cell_text, value))}]"
    return f"{value:g}" if isinstance(value, float) else printable(value)


def _sparkline(counts: list[int]) -> str:
    """Returns bars of the counts' logarithms, because most volumes are mostly air."""
    import math

    max_log = math.log1p(max(1, *counts))
    if not (sys.stdout.encoding or "ascii").lower().startswith("utf"):
        return ", ".join(str(count) for count in counts)
    bars = (min(8, math.ceil(8 * math.log1p(count) / max_log)) for count in counts)
    return "".join(" ▁▂▃▄▅▆▇█"[bar] for bar in bars)


_COMMANDS: dict[str, Any] = {
    cls.__name__.lower(): cls
    for cls in (Info, View, Render, Fly, Slice, Surface, Convert, Voxelize, Splat, Filter, Bench)
}


def _unbox_error(error_text: str) -> str:
    """Returns the parser's boxed error as one line, with suggestions for an unknown flag."""
    text = re.sub(r"╭.*╮|[^\x20-\x7e]+|[-+|]{3,}", " ", error_text)  # without frame and title
    message = re.sub(r" \(applied to [^)]*\)", "", " ".join(text.split()))
    unknown = re.match(r"Unrecognized options: (--[\w-]+)", message)
    suggestion = ""  # for none that another command has: it is "misplaced"
    if unknown is not None:
        known_flags = set(re.findall(r"--[\w-]+", message)) - {unknown[1], "--help"}
        suggestion = did_you_mean(unknown[1], known_flags)
    ending = r"Arguments are|Perhaps you meant|Available subcommands|(Argument|For full) helptext"
    sentence = re.sub(rf"\.? ({ending}).*", "", message).replace(" or misplaced", "")
    return f"{sentence}{suggestion}; gvtorch COMMAND --help tells all"


def _join_minus_values(args: list[str]) -> list[str]:
    """Joins values that begin with a minus to their flags, as in `--up=-z` and `--position=-4mm`,
    because the parser would take them for flags.
    """
    joined: list[str] = []
    for arg in args:
        value = re.fullmatch(r"-([xyz]|\.?\d.*)", arg)
        if value and joined and re.fullmatch(r"--[a-z][\w-]*", joined[-1]):
            joined[-1] += f"={arg}"
        else:
            joined.append(arg)
    return joined


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Makes Ctrl-C raise KeyboardInterrupt while a command runs, if it ended the process at once
    before (`__main__`), and end it at once again afterwards.
    """
    ends_at_once = signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    if ends_at_once:
        signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
        signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        if ends_at_once:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _interrupt(_signum: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt; during an import it tries again a moment later, because some
    modules catch it and others would stay half initialised.
    """
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            signal.setitimer(signal.ITIMER_REAL, 0.02)
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def main(args: list[str] | None = None) -> None:
    """Runs the command line; ends the process quietly if its output is closed (`| head`)."""
    try:
        try:
            _run(args)
        finally:
            sys.stdout.flush()
    except OSError as error:  # of standard output: `_run` reports all others
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if isinstance(error, BrokenPipeError):
            sys.exit(1)
        _fail(f"standard output: {error.strerror}")


def _fail(message: str) -> NoReturn:
    """Reports a mistake of the user in one line, and ends the process."""
    print(f"gvtorch: error: {message}", file=sys.stderr)
    sys.exit(2)


def _run(args: list[str] | None) -> None:
    if isinstance(sys.stdout, io.TextIOWrapper):  # file names may hold what it can't encode
        sys.stdout.reconfigure(errors="backslashreplace")
    args = _join_minus_values(sys.argv[1:] if args is None else args)
    if args == ["--version"]:
        from .. import __version__

        print(f"gvtorch {__version__}")
        return
    if args and not args[0].startswith("-") and args[0] not in _COMMANDS:
        listing = f"{', '.join(_COMMANDS)}{did_you_mean(args[0], _COMMANDS)}"
        _fail(f"unknown command {args[0]!r}; known: {listing}")
    parser_output = io.StringIO()
    try:
        with contextlib.redirect_stderr(parser_output):
            command = tyro.extras.subcommand_cli_from_dict(
                _COMMANDS,
                args=args,
                prog="gvtorch",
                description="GigaVoxels on PyTorch tensors. --version prints the version.",
                config=(tyro.conf.CascadeSubcommandArgs,),
            )
    except SystemExit as end:
        if end.code:
            _fail(_unbox_error(parser_output.getvalue()))
        raise
    warnings.showwarning = lambda message, *_rest, **_more: print(
        f"gvtorch: {one_line(message)}", file=sys.stderr
    )
    try:
        with _interruptible():
            command.run()
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ImportError, MemoryError) as error:
        _fail(one_line(error))
    except RuntimeError as error:
        if type(error).__name__ == "ProductionError":
            _fail(one_line(error))
        if "alloc" not in str(error) and "memory" not in str(error):
            raise
        _fail(f"not enough memory: {one_line(error)}")
    except KeyboardInterrupt as interrupt:
        if str(interrupt):
            print(f"gvtorch: {printable(interrupt)}", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
