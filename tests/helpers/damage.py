"""Damages files in many ways, and reads them in another process, which may crash."""

from __future__ import annotations

import faulthandler
import json
import random
import resource
import shutil
import warnings
from pathlib import Path
from typing import Any

import gvtorch as gv
from gvtorch.io.reading import open_source
from helpers.processes import CONTEXT

COPIES = 50
_SECONDS = 240
_MEMORY = 3 << 30  # bytes of address space beyond what the libraries use


def _read(paths: list[Path], options: dict[str, Any], log: Path) -> None:
    """Reads files; writes for each a line with its outcome, and last what a crash prints."""
    warnings.simplefilter("ignore")
    gv.read_volume(paths[0], **options)  # the libraries are there from now on
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, -1))
    with log.open("w") as file:
        faulthandler.enable(file)
        for path in paths:
            try:
                source = open_source(path, **options)
                x, y, z = source.extent
                source.read_region((0, 0, 0), (min(2, z), min(3, y), min(4, x)))
                gv.read_volume(path, nan=0, **options)
                outcome = ["read", ""]
            except (ValueError, OSError) as error:
                outcome = ["refused", str(error)]
            except BaseException as error:
                outcome = [type(error).__name__, str(error)]
            print(json.dumps(outcome), file=file, flush=True)


def break_file(content: bytes, number: int) -> bytes:
    """Cuts a file (even numbers), or changes some of its bytes, mostly near its beginning."""
    rng = random.Random(number)
    if number % 2 == 0:
        return content[: rng.randrange(len(content))]
    damaged = bytearray(content)
    end = len(content) if number % 4 == 1 else min(len(content), 600)
    for _ in range(rng.choice((1, 4, 32))):
        damaged[rng.randrange(end)] = rng.randrange(256)
    return bytes(damaged)


def outcomes(path: Path, folder: Path, **options: Any) -> list[tuple[str, str]]:
    """Reads a file, or folder, and 50 copies of which a file is damaged; returns for each "read",
    "refused" or an error's name, and the message. The first is of the undamaged file.

    Raises:
        AssertionError: The process crashed or did not end.
    """
    paths = [path]
    for number in range(COPIES):
        copy = folder / f"{number}" / path.name
        copy.parent.mkdir(parents=True)
        if path.is_dir():
            shutil.copytree(path, copy)
            files = sorted(file for file in copy.rglob("*") if file.is_file())
            damaged = files[number % len(files)]
            damaged.write_bytes(break_file(damaged.read_bytes(), number))
        else:
            copy.write_bytes(break_file(path.read_bytes(), number))
        paths.append(copy)
    log = folder / "log"
    process = CONTEXT.Process(target=_read, args=(paths, options, log))
    process.start()
    process.join(_SECONDS)
    process.kill()
    process.join()
    text = log.read_text() if log.exists() else ""
    lines = [tuple(json.loads(line)) for line in text.splitlines() if line.startswith("[")]
    failed_path = paths[len(lines)] if len(lines) < len(paths) else "the end"
    assert process.exitcode == 0, f"ended with {process.exitcode} at {failed_path}: {text[-3000:]}"
    return lines


def assert_robust(path: Path, folder: Path, min_refused: int = 15, **options: Any) -> None:
    """Asserts that the whole file is read, and that every damaged one is read or refused with a
    one-line message that names it; at least `min_refused` are refused.
    """
    (first, message), *rest = outcomes(path, folder, **options)
    assert first == "read", message
    assert len(rest) == COPIES
    for outcome, message in rest:
        assert outcome in ("read", "refused"), f"{outcome}: {message}"
        assert outcome == "read" or ("\n" not in message and str(folder) in message), message
    assert sum(outcome == "refused" for outcome, _ in rest) >= min_refused, rest
