"""`gvtorch surface`: writes the surface of a volume or a store at a value as triangles."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from ..base.messages import printable
from .common import Bar, ReadOptions, check_outputs, open_data, option, volume_formats


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Make triangles of the surface around values, or around a label; a store is read block by
    block."""

    path: Positional[Annotated[str, option(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    # mesh to write, in world units: PLY, or binary glTF
    output: Annotated[Path, option(aliases=["-o"], metavar="OUT.ply|OUT.glb")]
    # surface around values of at least this (at most, for signed distances); for labels: the label
    # to enclose
    value: Annotated[float, option(aliases=["--iso"], metavar="VALUE")]
    # level of detail of a store; 0 is the finest, each next one has a quarter of the triangles
    level: Annotated[int, option(metavar="N")] = 0
    # close the surface where it leaves the box; otherwise it is open there
    caps: bool = True
    # index of the number to use, for voxels with several
    component: Annotated[int, option(metavar="N")] = 0
    # image of a store to read, by name or number, if there are several
    image: Annotated[str | None, option(metavar="NAME")] = None

    # How to read a volume file that does not say so itself; a store takes only --time.
    source: tyro.conf.OmitArgPrefixes[ReadOptions] = ReadOptions()

    def run(self) -> None:
        from ..io.resources import amount
        from ..io.surface import export_surface
        from ..io.surface_file import check_surface_path

        check_surface_path("--output", self.output)
        check_outputs({"PATH": self.path}, {"--output": self.output})
        start = time.perf_counter()
        with Bar() as bar:
            bar("reading", 0, 0)
            data = open_data(self.path, self.source, image=self.image, level=self.level)
            mesh_size = export_surface(
                *(data, self.value, self.output),
                level=self.level,
                component=self.component,
                caps=self.caps,
                progress=bar,
            )
        seconds, file_size = time.perf_counter() - start, amount(self.output.stat().st_size)
        counts = f"{mesh_size.triangles} triangles, {mesh_size.vertices} vertices"
        print(f"{printable(self.output)}: {counts}, {file_size} in {seconds:.1f} s")
