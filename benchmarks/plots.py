"""Plots the records that `gvtorch bench NAME -o docs/performance` saved, and writes their tables
between the markers of docs/performance/tables.md. Records of quick sizes are left out.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from gvtorch.bench import WORKLOADS, tables

DOCS = Path(__file__).parent.parent / "docs"
BEGIN = "<!-- figures: written by benchmarks/plots.py -->"
END = "<!-- end of figures -->"


@dataclass
class Settings:
    """What to read and to write."""

    records: Path = DOCS / "performance"
    """a folder of JSON files; pictures are written beside them"""
    page: Path = DOCS / "performance" / "tables.md"
    """a Markdown file with the markers"""


def read(folder: Path) -> list[tuple[str, dict[str, Any]]]:
    """Returns name and content of each record, in the order of the workloads."""
    records = [(file.stem, json.loads(file.read_text())) for file in sorted(folder.glob("*.json"))]
    order = [*WORKLOADS]
    full_size = [(name, record) for name, record in records if not record["quick"]]
    return sorted(full_size, key=lambda item: order.index(item[1]["workload"]))


def section(picture: Path, record: dict[str, Any], drawn: bool) -> str:
    """Returns a record's part of the page, which is linked to its `picture`."""
    text = WORKLOADS[record["workload"]]
    head = f"## {tables.title(record)}\n\n{text[0].upper()}{text[1:]}.\n"
    link = f"\n![{record['workload']}]({picture.as_posix()})\n" if drawn else ""
    return f"{head}{link}\n{tables.markdown(record)}\n"


def write_between_markers(page: Path, text: str) -> None:
    """Replaces the text between the markers.

    Raises:
        ValueError: A marker is missing.
    """
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{page}: expected the lines {BEGIN!r} and {END!r}")
    page.write_text(f"{before}{BEGIN}\n\n{text}\n{END}{after}", encoding="utf-8")


def draw(file: Path, record: dict[str, Any]) -> bool:
    """Plots a record; returns False if matplotlib is not installed."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure = _sweep(pyplot, record) if record["workload"] == "bricks" else _bars(pyplot, record)
    figure.suptitle(tables.title(record), fontsize=10)
    figure.savefig(file, dpi=100, metadata={"Software": None})
    pyplot.close(figure)
    return True


def _bars(pyplot: Any, record: dict[str, Any]) -> Any:
    """Plots the milliseconds of every row, or gigabytes a second if all rows move bytes, with the
    range of the repeats; on a logarithmic axis where rows differ more than 20 times.
    """
    rows = record["rows"][::-1]
    names = list(dict.fromkeys(row["who"] for row in record["rows"]))
    figure, axes = pyplot.subplots(
        figsize=(9, 1.2 + 0.24 * len(rows)), constrained_layout=True, squeeze=True
    )
    moves = all("bytes_per_second" in row for row in rows)
    middles = []
    for y, row in enumerate(rows):
        ends = [row[name] for name in ("ms_low", "ms", "ms_high")]
        if moves:  # not all rows move as many bytes
            ends = [1e-6 * row["moved_bytes"] / ms for ms in reversed(ends)]
        low, middle, high = ends
        color = f"C{names.index(row['who']) % 10}"
        axes.barh(y, middle, color=color, xerr=[[middle - low], [high - middle]], ecolor="0.4")
        middles.append(middle)
    axes.set_yticks(range(len(rows)), [f"{row['case']}: {row['who']}" for row in rows], fontsize=7)
    axes.margins(y=0.01)
    if max(middles) > 20 * min(middles):
        axes.set_xscale("log")
    axes.set_xlabel("GB / s" if moves else "milliseconds")
    axes.grid(axis="x", alpha=0.3)
    return figure


def _sweep(pyplot: Any, record: dict[str, Any]) -> Any:
    """Plots, for each scene, milliseconds and memory over the brick size, a line per border."""
    scenes = list(dict.fromkeys(row["scene"] for row in record["rows"]))
    figure, grid = pyplot.subplots(
        *(2, len(scenes)), figsize=(4 * len(scenes), 6), constrained_layout=True, squeeze=False
    )
    for column, scene in enumerate(scenes):
        for border in (0, 1, 2):
            rows = [r for r in record["rows"] if (r["scene"], r["border"]) == (scene, border)]
            sizes = [row["brick_size"] for row in rows]
            grid[0][column].plot(sizes, [r["ms"] for r in rows], "o-", label=f"border {border}")
            grid[1][column].plot(sizes, [r["tree_bytes"] / 1e6 for r in rows], "o-")
        grid[0][column].set_title(scene, fontsize=9)
        for axes in grid[:, column]:
            axes.set_xscale("log", base=2)
            axes.set_xticks((4, 8, 16, 32), ("4", "8", "16", "32"))
            axes.set_ylim(bottom=0)
            axes.grid(alpha=0.3)
        grid[1][column].set_xlabel("brick size, voxels")
    grid[0][0].set_ylabel("milliseconds")
    grid[1][0].set_ylabel("tree, MB")
    grid[0][0].legend(fontsize=8)
    return figure


def main(settings: Settings) -> None:
    """Draws all plots and writes the page."""
    records = read(settings.records)
    if not records:
        sys.exit(f"plots: no records in {settings.records}; `make bench` makes them")
    parts, plots = [], 0
    folder = Path(os.path.relpath(settings.records, settings.page.parent))
    for name, record in records:
        drawn = draw(settings.records / f"{name}.png", record)
        parts.append(section(folder / f"{name}.png", record, drawn))
        plots += drawn
    write_between_markers(settings.page, "\n".join(parts))
    print(f"{settings.page}: {len(records)} tables, {plots} plots")
    if not plots:
        print("plots: matplotlib is not installed, so the page shows tables alone")


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings))
    except (ValueError, OSError) as error:
        sys.exit(f"plots: error: {error}")
