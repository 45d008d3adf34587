"""Compares the speed of two checkouts: each workload of `gvtorch bench` runs in both in turn, and
the fastest of the rounds counts, so that other load on the machine matters less.

    python benchmarks/compare.py ../before . march frame --device cuda

Both folders must hold built libraries. Peers are left out. Prints Markdown, the slowest row first.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

Case = tuple[str, str, str]  # workload, case, who


@dataclass
class Settings:
    """What to compare."""

    before: Positional[Path]
    """a checkout"""
    after: Positional[Path]
    """another one"""
    workloads: Positional[tuple[str, ...]]
    """names of workloads, as `gvtorch bench` lists them"""
    device: str = "cpu"
    """cpu, cuda or cuda:1"""
    rounds: int = 3
    """how often each workload runs in each checkout"""
    repeats: int = 5
    """timings of each figure in a round"""
    only: str = ""
    """cases that have it in their name"""
    quick: bool = False
    """tiny sizes"""
    least: Annotated[float, tyro.conf.arg(metavar="MS")] = 0.0
    """figures below this many milliseconds are left out"""


def figures(checkout: Path, workload: str, settings: Settings) -> dict[Case, float]:
    """Runs a workload once, in its own process; returns the least milliseconds of each case."""
    command = [sys.executable, "-m", "gvtorch", "bench", workload, "--json", "--peers", "none"]
    command += ["--device", settings.device, "--repeats", str(settings.repeats)]
    command += ["--only", settings.only, *(["--quick"] if settings.quick else [])]
    paths = [str(checkout.resolve()), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    run = subprocess.run(
        command, cwd=checkout, env=environment, capture_output=True, text=True, check=False
    )
    if run.returncode:
        sys.exit(f"compare: {workload} failed in {checkout}: {run.stderr.strip()[-500:]}")
    record = json.loads(run.stdout.strip().splitlines()[-1])
    return {(workload, row["case"], row["who"]): row["ms_low"] for row in record["rows"]}


def main(settings: Settings) -> None:
    """Runs all and prints the table."""
    least: dict[Path, dict[Case, float]] = {settings.before: {}, settings.after: {}}
    for workload in settings.workloads:
        for turn in range(settings.rounds):
            for checkout, fastest in least.items():
                print(f"{workload}: round {turn + 1}, {checkout}", file=sys.stderr, flush=True)
                for case, took in figures(checkout, workload, settings).items():
                    fastest[case] = min(took, fastest.get(case, took))
    before, after = least.values()
    both = [case for case in before if case in after and before[case] >= settings.least]
    print("| workload | case | who | ms before | ms after | after / before |")
    print("|---|---|---|---|---|---|")
    for case in sorted(both, key=lambda case: before[case] / after[case]):
        ratio = after[case] / before[case]
        print(f"| {' | '.join(case)} | {before[case]:.4g} | {after[case]:.4g} | {ratio:.3f} |")
    for case in sorted(set(before) ^ set(after)):
        print(f"| {' | '.join(case)} | in one of them only | | |")


if __name__ == "__main__":
    main(tyro.cli(Settings))
