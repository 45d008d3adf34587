"""The command line: `gvtorch info`, `gvtorch render` and `gvtorch convert`.

torch is imported inside the commands, so that `--help` answers at once. A mistake of the user ends
in one line on standard error and status 2.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..pool import N3Tree
    from ..rendering import Camera, TransferFunction
    from ..volume import Volume


@dataclass(frozen=True, kw_only=True)
class Source:
    """How to read the volume where the file does not tell."""

    shape: Annotated[str | None, arg(metavar="X,Y,Z")] = None
    """RAW: voxels; else taken from the name *_XxYxZ_dtype.raw"""
    dtype: Annotated[str | None, arg(metavar="TYPE")] = None
    """RAW: a NumPy dtype, as in int16 or >i2"""
    spacing: Annotated[str | None, arg(metavar="X,Y,Z")] = None
    """voxel size in world units"""
    key: Annotated[str | None, arg(metavar="NAME")] = None
    """NPZ: which array"""
    nan: Annotated[float | None, arg(metavar="VALUE")] = None
    """value for voxels that are NaN or infinite"""

    def read(self, path: Path) -> Volume:
        """Reads the volume at `path`."""
        from ..io import read_volume

        return read_volume(path, **self.options())

    def options(self) -> dict[str, Any]:
        """The options as arguments of `read_volume` and `convert`."""
        return {
            "shape": _numbers("--shape", self.shape, 3, int) if self.shape else None,
            "dtype": self.dtype,
            "spacing": _numbers("--spacing", self.spacing, 3, float) if self.spacing else None,
            "key": self.key,
            "nan": self.nan,
        }


@dataclass(frozen=True, kw_only=True)
class Info:
    """Tell about this installation, a volume file, or a store."""

    path: Positional[Annotated[str | None, arg(metavar="PATH")]] = None
    """a volume or a store; without it backends, devices and versions"""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """print JSON"""
    source: tyro.conf.OmitArgPrefixes[Source] = Source()

    def run(self) -> None:
        """Prints the answer."""
        if self.path is None:
            content = installation()
        elif _is_store(self.path):
            from ..io import Store

            content = Store.open(self.path).describe()
        else:
            from ..io.formats import describe

            with Bar() as bar:
                bar("reading", 0, 0)
                content = describe(self.source.read(Path(self.path)))
        if self.json:
            print(json.dumps(content))
        else:
            _print_table(content)


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render a volume file to a picture."""

    path: Positional[Annotated[Path, arg(metavar="PATH")]]
    """the volume: RAW, NPY, NPZ, NIfTI, NRRD, TIFF or FITS"""
    output: Annotated[Path, arg(aliases=["-o"], metavar="OUT.png")]
    """the picture"""
    npz: Annotated[Path | None, arg(metavar="OUT.npz")] = None
    """float32 color, alpha and depth"""
    stats: Annotated[Path | None, arg(metavar="FILE.json")] = None
    """milliseconds, rays, samples, nodes, bricks, bytes"""
    camera: Annotated[str, arg(metavar="CAMERA")] = "orbit:30,20,2.4"
    """orbit:AZIMUTH,ELEVATION,DISTANCE (degrees, and largest sides of the box) or
    look:ex,ey,ez,tx,ty,tz (world units)"""
    up: Annotated[str, arg(metavar="X,Y,Z")] = "0,1,0"
    """what a look camera takes for up"""
    fov: Annotated[float, arg(metavar="DEG")] = 30.0
    """vertical field of view"""
    size: Annotated[str, arg(metavar="WxH")] = "512x512"
    """pixels"""
    tf: Annotated[str, arg(metavar="FILE|PRESET")] = "gray"
    """transfer function: a JSON file, or a preset over the data's range: gray, hot, vessels, bone,
    tissue"""
    step: Annotated[float, arg(metavar="VOXELS")] = 0.5
    """distance between samples"""
    lod: Literal["auto", "finest"] = "auto"
    """auto: voxels as wide as a pixel's cone; finest: the data as it is"""
    background: Annotated[str, arg(metavar="R,G,B")] = "0,0,0"
    """linear, 0 to 1"""
    stop_alpha: Annotated[float, arg(metavar="ALPHA")] = 0.99
    """a ray ends at this alpha; 1 integrates to the end"""
    brick_size: Annotated[int, arg(metavar="VOXELS")] = 8
    """side of a brick"""
    border: Annotated[int, arg(metavar="VOXELS")] = 1
    """voxels around a brick"""
    threshold: Annotated[float | None, arg(metavar="VALUE")] = None
    """regions with no value above it are never drawn"""
    backend: Literal["auto", "reference", "cpp", "cuda"] = "auto"
    """what traces the rays"""
    source: tyro.conf.OmitArgPrefixes[Source] = Source()

    def run(self) -> None:
        """Reads, builds the tree, renders, writes."""
        width, height = _size(self.size)
        background = _numbers("--background", self.background, 3, float)
        if self.output.suffix != ".png":
            raise ValueError(f"--output must end in .png, got {str(self.output)!r}")
        if self.npz is not None and self.npz.suffix != ".npz":
            raise ValueError(f"--npz must end in .npz, got {str(self.npz)!r}")
        for file in (self.output, self.npz, self.stats):
            if file is not None and not file.parent.is_dir():
                raise FileNotFoundError(f"folder not found: {file.parent}")
        camera = parse_camera(self.camera, self.up, self.fov, width, height)
        with Bar() as bar:
            bar("reading", 0, 0)
            volume = self.source.read(self.path)
            shader = self._shader(volume)
            tree = self._tree(volume, bar)
            from ..rendering import render

            picture = render(
                *(tree, camera, shader),
                progress=bar,
                step=self.step,
                lod=self.lod,
                background=tuple(background),
                stop_alpha=self.stop_alpha,
                backend=self.backend,
            )
        picture.save(self.output)
        if self.npz is not None:
            picture.save(self.npz)
        if self.stats is not None:
            content = {**picture.stats.as_dict(), "extent": volume.extent}
            self.stats.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        stats = picture.stats
        print(
            f"{self.output}: {width}x{height}, {stats.samples / 1e6:.1f} M samples in "
            f"{stats.milliseconds:.0f} ms ({stats.backend})"
        )

    def _tree(self, volume: Volume, bar: Bar) -> N3Tree:
        import torch

        from ..ops import available
        from ..ops.trace import choose_backend
        from ..pool import N3Tree

        wants_cuda = self.backend == "cuda" or (self.backend == "auto" and not available()["cuda"])
        device = torch.device("cuda" if wants_cuda else "cpu")
        choose_backend(self.backend, device)
        return N3Tree.from_volume(
            *(volume, self.brick_size, self.border),
            threshold=self.threshold,
            device=device,
            progress=bar,
        )

    def _shader(self, volume: Volume) -> TransferFunction:
        from ..rendering import TransferFunction

        if self.tf.endswith(".json") or Path(self.tf).is_file():
            return TransferFunction.from_json(self.tf)
        return TransferFunction.preset(self.tf, *volume.value_range)


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Convert a volume of any size to a store: OME-Zarr with bordered blocks."""

    path: Positional[Annotated[str, arg(metavar="PATH")]]
    """the volume: RAW, NPY, NPZ, NIfTI, NRRD, TIFF, FITS or OME-Zarr (folder or URL)"""
    store: Positional[Annotated[Path, arg(metavar="STORE.zarr")]]
    """the folder to make"""
    block: Literal[32, 64] = 32
    """voxels along a side of a block"""
    threshold: Annotated[float | None, arg(metavar="VALUE")] = None
    """regions with no value above it are not kept as blocks"""
    workers: Annotated[int | None, arg(metavar="N")] = None
    """processes; one a core if left out"""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """of a dask cluster that shares this folder, as in tcp://host:8786"""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """go on with a half-written store"""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """tell disk, memory and time, and write nothing"""
    source: tyro.conf.OmitArgPrefixes[Source] = Source()

    def run(self) -> None:
        """Converts, or tells what it would take."""
        from ..io.convert import convert, estimate
        from ..io.machine import amount

        if self.scheduler is not None and self.workers is not None:
            raise ValueError("--scheduler brings its own workers: leave --workers out")
        common: dict[str, Any] = {
            **self.source.options(),
            "block": self.block,
            "threshold": self.threshold,
            "workers": self.workers,
        }
        if self.dry_run:
            del common["spacing"]
            _print_table(_readable(estimate(self.path, self.store, **common).as_dict()))
            return
        start = time.perf_counter()
        with Bar(speed=True) as bar, self._cluster() as executor:
            store = convert(
                *(self.path, self.store),
                **common,
                executor=executor,
                resume=self.resume,
                progress=bar,
            )
        seconds = time.perf_counter() - start
        size = amount(store.describe()["disk bytes"])
        extent = "x".join(str(n) for n in store.extent)
        print(f"{self.store}: {extent}, {store.levels} levels, {size} in {seconds:.1f} s")

    @contextlib.contextmanager
    def _cluster(self) -> Iterator[Executor | None]:
        if self.scheduler is None:
            yield None
            return
        try:
            from distributed import Client
        except ImportError:
            raise ImportError("--scheduler needs dask: pip install distributed") from None
        with Client(self.scheduler, timeout="20s") as client:
            yield client.get_executor()


class Bar:
    """A progress bar on standard error that shows itself once the work has taken a second."""

    def __init__(self, *, speed: bool = False) -> None:
        """Shows nothing yet. With `speed` what is done counts bytes."""
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
        self._progress = Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self._tasks: dict[str, Any] = {}
        self._timer = threading.Timer(1.0, self._progress.start)
        self._timer.daemon = True

    def __enter__(self) -> Bar:
        """Starts the clock."""
        self._timer.start()
        return self

    def __exit__(self, *_error: object) -> None:
        """Takes the bar away."""
        self._timer.cancel()
        self._timer.join()
        if self._progress.live.is_started:
            self._progress.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        """Shows that `done` of `total` (0: unknown) parts of `what` are done."""
        if what not in self._tasks:
            for task in self._tasks.values():
                self._progress.update(task, visible=False)
            self._tasks[what] = self._progress.add_task(what, total=total or None)
        self._progress.update(self._tasks[what], completed=done, total=total or None)


def parse_camera(text: str, up: str, fov: float, width: int, height: int) -> Camera:
    """Makes a camera from `orbit:AZ,EL,DIST` or `look:ex,ey,ez,tx,ty,tz`.

    Raises:
        ValueError: The text is neither, or a number is out of its range.
    """
    from ..rendering import Camera

    kind, _, rest = text.partition(":")
    if kind == "orbit":
        azimuth, elevation, distance = _numbers("--camera orbit", rest, 3, float)
        return Camera.orbit(azimuth, elevation, distance, fov, width, height)
    if kind == "look":
        values = _numbers("--camera look", rest, 6, float)
        upward = _numbers("--up", up, 3, float)
        return Camera.look_at(values[:3], values[3:], upward, fov, width, height)
    raise ValueError(f"--camera must be orbit:AZ,EL,DIST or look:ex,ey,ez,tx,ty,tz, got {text!r}")


def installation() -> dict[str, Any]:
    """Returns versions, what each backend can do here, and the devices."""
    import platform

    import torch

    from .. import __version__
    from ..ops import available

    cards = range(torch.cuda.device_count()) if torch.cuda.is_available() else ()
    return {
        "gvtorch": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backends": {name: reason or "ready" for name, reason in available().items()},
        "devices": [
            f"cpu ({torch.get_num_threads()} threads)",
            *(f"cuda:{i} ({torch.cuda.get_device_name(i)})" for i in cards),
        ],
    }


def _is_store(path: str) -> bool:
    return (
        "://" in path or path.rstrip("/").endswith(".zarr") or (Path(path) / "zarr.json").exists()
    )


def _readable(content: dict[str, Any]) -> dict[str, Any]:
    """Underscores to blanks, and bytes for people."""
    from ..io.machine import amount

    out = {}
    for name, value in content.items():
        is_bytes = name.endswith(("_bytes", "_free"))
        text = amount(value) if is_bytes else value
        out[name.removesuffix("_bytes").replace("_", " ")] = text
    return out


def _print_table(content: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None)
    for name, value in content.items():
        if name == "histogram":
            text = _sparkline(value)
        elif isinstance(value, dict):
            text = "\n".join(f"{key}: {item}" for key, item in value.items())
        elif isinstance(value, (list, tuple)):
            text = ", ".join(
                f"{item:g}" if isinstance(item, float) else str(item) for item in value
            )
        else:
            text = f"{value:g}" if isinstance(value, float) else str(value)
        table.add_row(f"[bold]{name}[/bold]", text.replace("[", "\\["))
    Console().print(table)


def _sparkline(counts: list[int]) -> str:
    """Bars of the counts' logarithms: most volumes are mostly air."""
    import math

    most = math.log1p(max(counts))
    if not (sys.stdout.encoding or "ascii").lower().startswith("utf"):
        return ", ".join(str(count) for count in counts)
    return "".join(" ▁▂▃▄▅▆▇█"[math.ceil(8 * math.log1p(count) / most)] for count in counts)


def _numbers(name: str, text: str, count: int, kind: type) -> list[Any]:
    try:
        values = [kind(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        wanted = "whole numbers" if kind is int else "numbers"
        raise ValueError(f"{name} must be {count} {wanted} with commas between them, got {text!r}")
    return values


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise ValueError(f"--size must be WIDTHxHEIGHT in pixels, got {text!r}")
    return int(width), int(height)


def main(args: list[str] | None = None) -> None:
    """Runs the command line and ends the process."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            command = tyro.extras.subcommand_cli_from_dict(
                {"info": Info, "render": Render, "convert": Convert},
                args=args,
                prog="gvtorch",
                description="GigaVoxels on PyTorch tensors.",
                config=(tyro.conf.CascadeSubcommandArgs,),
            )
    except SystemExit as end:
        if end.code:
            words = " ".join(re.sub(r"[^\x20-\x7e]+|[-+|]{3,}", " ", said.getvalue()).split())
            print(f"gvtorch: error: {words}", file=sys.stderr)
        raise
    warnings.showwarning = lambda message, *_rest, **_more: print(
        f"gvtorch: {message}", file=sys.stderr
    )
    try:
        command.run()
    except (ValueError, OSError, ImportError, MemoryError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        print(f"gvtorch: error: {text}", file=sys.stderr)
        sys.exit(2)
    except RuntimeError as error:
        if "alloc" not in str(error) and "memory" not in str(error):
            raise
        text = " ".join(str(error).split())
        print(f"gvtorch: error: not enough memory: {text}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
