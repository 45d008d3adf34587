"""`gvtorch slice`: planes of voxels as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional

from ..base.messages import printable
from .common import Bar, ReadOptions, Switch, check_outputs, open_data, option, volume_formats
from .parse import parse_transfer, parse_window


@dataclass(frozen=True, kw_only=True)
class Slice:
    """Show planes of voxels of a volume or a store, exact to the voxel."""

    path: Positional[Annotated[str, option(metavar="PATH", help=f"a volume: {volume_formats()}")]]
    # picture to write: .png, .exr, .tif, .npy or .npz
    output: Annotated[Path, option(aliases=["-o"], metavar="OUT.png")]
    # bits of each number, as in gvtorch render
    bits: Annotated[int | None, option(metavar="N")] = None
    # axis that the plane is perpendicular to; all: three planes in one picture
    axis: Literal["x", "y", "z", "all"] = "z"
    # position along the axis: 50%, the index of a voxel, or a world position such as 12.5mm;
    # with --axis all also three, as in 50%,40%,12
    position: Annotated[str, option(metavar="PLACE")] = "50%"
    # axis that points up in the picture of one plane; if left out: as radiologists view
    # patients (see --plain); for other data -y (rows run down) across z, else +z
    up: Annotated[str | None, option(metavar="+z")] = None
    # leave out the letters at the edges (R right, L left, A front, P back, S head, I feet) of scans
    # of patients, which are shown as radiologists view them: the right side on the left
    plain: Switch = False
    # pixels along the shortest side of a voxel
    scale: Annotated[float, option(metavar="PIXELS")] = 1.0
    # level of detail of a store; 0 is the finest
    level: Annotated[int, option(metavar="N")] = 0
    # colours, as in gvtorch render; if left out: visually even grays, or those of labels
    tf: Annotated[str | None, option(metavar="FILE|PRESET")] = None
    # values that the colours span, as in gvtorch render; auto includes the background
    window: Annotated[str | None, option(metavar="LO,HI")] = None
    # index of the number to show, for voxels with several
    component: Annotated[int, option(metavar="N")] = 0
    # image of a store to show, by name or number, if there are several
    image: Annotated[str | None, option(metavar="NAME")] = None

    # How to read a volume file that does not say so itself; a store takes only --time.
    source: tyro.conf.OmitArgPrefixes[ReadOptions] = ReadOptions()

    def run(self) -> None:
        from ..pictures.files import checked_path
        from ..shaders import Labels, TransferFunction
        from ..tracing import slice_picture
        from ..tracing.slices import radiological_views

        checked_path("--output", self.output, self.bits)
        check_outputs({"PATH": self.path, "--tf": self.tf}, {"--output": self.output})
        positions: Any = tuple(self.position.split(","))
        if len(positions) not in ((1, 3) if self.axis == "all" else (1,)):
            raise ValueError(
                f"--position must be one, or three for --axis all, got {self.position!r}"
            )
        with Bar() as bar:
            bar("reading", 0, 0)
            data = open_data(self.path, self.source, image=self.image, level=self.level)
            views = radiological_views(data.info.space) if self.up is None else {}
            span: tuple[float, float] | None = None
            colors: Labels | TransferFunction | None = None
            if data.info.labels and self.tf is None and self.window is None:
                colors = Labels({0: (0.0, 0.0, 0.0)})
            elif self.tf is None:
                text = "auto" if self.window is None else self.window
                span = parse_window(text, data, self.component, background=True)
            else:
                transfer_arguments = self.tf, self.window, data, self.component
                colors = parse_transfer(*transfer_arguments, background=True)
            picture = slice_picture(
                *(data, self.axis, positions if len(positions) == 3 else positions[0]),
                span=span,
                colors=colors,
                component=self.component,
                level=self.level,
                scale=self.scale,
                up=self.up,
                radiological=bool(views),
                letters=bool(views) and not self.plain,
            )
        height, width, _ = picture.color.shape
        picture.save(self.output, bits=self.bits)
        shown = [view for axis, view in views.items() if self.axis in (axis, "all")]
        note = "".join(
            f", {' and '.join(names)}: {side} is on the left"
            for letter, side in (("R", "right"), ("A", "front"))
            if (names := [view.name for view in shown if view.letters.endswith(letter)])
        )
        print(f"{printable(self.output)}: {width}x{height}{note}")
