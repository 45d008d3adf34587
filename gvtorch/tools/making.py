"""`Making`: the flags of commands that make a store: who works, and how it is told of."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import arg

from ..base.messages import printable
from .common import Bar

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..io.stores.store import Store


@dataclass(frozen=True, kw_only=True)
class Making:
    """How the store is made."""

    block: Literal[32, 64] = 32
    """voxels along a side of a block"""
    workers: Annotated[int | None, arg(metavar="N")] = None
    """processes; one a core if left out, fewer where memory is short"""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """of a dask cluster that shares this folder, as in tcp://host:8786"""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """go on with a half-written store"""

    def check(self) -> None:
        """Raises ValueError where flags do not go together."""
        if self.scheduler is not None and self.workers is not None:
            raise ValueError("--scheduler brings its own workers: leave --workers out")

    @contextlib.contextmanager
    def working(self, *, speed: bool = False) -> Iterator[dict[str, Any]]:
        """Gives what `convert`, `voxelize` and `splat` are told of it; see `Bar` for `speed`."""
        self.check()
        with Bar(speed=speed) as bar, cluster(self.scheduler) as executor:
            yield {
                "block": self.block,
                "workers": self.workers,
                "executor": executor,
                "resume": self.resume,
                "progress": bar,
            }


def told_store(output: Path, stores: list[Store], start: float) -> str:
    """What was made since `time.perf_counter()` was `start`; the first image tells extent."""
    from ..io.resources import amount

    seconds, first = time.perf_counter() - start, stores[0]
    size = amount(sum(one.describe()["disk bytes"] for one in stores))
    extent = "x".join(str(n) for n in first.extent)
    times = f" at {first.times} times" if first.times > 1 else ""
    return f"{printable(output)}: {extent}{times}, {first.levels} levels, {size} in {seconds:.1f} s"


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[Executor | None]:
    """The executor of a dask cluster, or none."""
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError:
        raise ImportError("--scheduler needs dask: pip install distributed") from None
    with Client(address, timeout="20s") as client:
        yield client.get_executor()
