"""`gvtorch bench`: measures workloads on this machine."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from .common import Switch, option


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure a workload on this machine, side by side with other renderers."""

    # workload to run, or all; if left out: list the workloads
    name: Positional[Annotated[str | None, option(metavar="NAME")]] = None
    # print JSON, one line per workload
    json: Switch = False
    # also write the JSON to this folder, a file for each workload and machine
    output: Annotated[Path | None, option(aliases=["-o"], metavar="FOLDER")] = None
    # device to measure: cpu, cuda or cuda:N
    device: Annotated[str, option(metavar="DEVICE")] = "cpu"
    # run with tiny sizes, to check that everything works
    quick: Switch = False
    # timings per figure, after one to warm up
    repeats: Annotated[int, option(metavar="N")] = 7
    # time limit per figure, in seconds; slow figures use fewer timings, at least one
    seconds: Annotated[float, option(metavar="S")] = 10.0
    # run only cases with this in their name
    only: Annotated[str, option(metavar="TEXT")] = ""
    # other renderers to compare with; none: gvtorch alone; if left out: all that are installed
    peers: Annotated[str | None, option(metavar="NAME,NAME")] = None
    # write the compared pictures to this folder
    pictures: Annotated[Path | None, option(metavar="FOLDER")] = None

    def run(self) -> None:
        from ..bench import COMPARED_WITH, SAVES_PICTURES, WORKLOADS, Unavailable

        if self.name is None:
            listing = [f"{name:10} {description}" for name, description in WORKLOADS.items()]
            print(json.dumps(WORKLOADS) if self.json else "\n".join(listing))
            return
        names = [*WORKLOADS] if self.name == "all" else [self.name]
        if names[0] not in WORKLOADS:
            known_names = ", ".join((*WORKLOADS, "all"))
            raise ValueError(f"bench: unknown workload {self.name!r}; known: {known_names}")
        known_peers = [peer for name in names for peer in COMPARED_WITH.get(name, ())]
        for peer in self._peers() or ():
            if peer not in known_peers:
                known_text = ", ".join(dict.fromkeys(known_peers)) or "nothing"
                raise ValueError(
                    f"--peers: {self.name} is compared with {known_text}, not {peer!r}"
                )
        if self.pictures is not None and not {*names} & {*SAVES_PICTURES}:
            raise ValueError(f"--pictures is for {' and '.join(SAVES_PICTURES)}")
        left_out = 0
        for name in names:
            try:
                self._run_workload(name)
            except Unavailable as reason:
                if self.name != "all":
                    raise
                print(f"{name} is left out: {reason}", file=sys.stderr)
                left_out += 1
        if left_out == len(names):
            raise ValueError("bench: all workloads were left out")

    def _peers(self) -> tuple[str, ...] | None:
        """Returns the peers of `--peers`; None: all that are installed."""
        peers = None if self.peers is None else tuple(p for p in self.peers.split(",") if p)
        return () if peers == ("none",) else peers

    def _run_workload(self, name: str) -> None:
        import torch
        from rich.console import Console

        from ..base.whole_file import write_text
        from ..bench import run, tables
        from ..bench.record import Settings

        try:
            device = torch.device(self.device)
        except RuntimeError:
            raise ValueError(f"--device must be cpu, cuda or cuda:N, got {self.device!r}") from None
        error_console = Console(stderr=True)
        with error_console.status(name) as status:
            settings = Settings(
                device=device,
                quick=self.quick,
                repeats=self.repeats,
                seconds=self.seconds,
                peers=self._peers(),
                only=self.only,
                pictures=self.pictures,
                tell=status.update,
            )
            content = run(name, settings).as_dict()
        if self.output is not None:
            self.output.mkdir(parents=True, exist_ok=True)
            text = json.dumps(content, indent=1) + "\n"
            write_text(self.output / tables.file_name(content), text)
        if self.json:
            print(json.dumps(content), flush=True)
            return
        console = Console(width=None if sys.stdout.isatty() else 200)
        console.print(tables.rich_table(content))
        for peer, outcome in content["peers"].items():
            if outcome != "ran":
                console.print(f"{peer}: {outcome}", highlight=False, markup=False)
        for note in content["notes"]:
            console.print(note, highlight=False, markup=False)
