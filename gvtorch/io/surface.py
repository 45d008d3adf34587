"""`extract_surface`, `export_surface`: the surface on which a volume, a store or a tree crosses a
value, as triangles; made block by block, so that memory holds a block and the vertices on the faces
of earlier ones.

Every cell is in one block. Vertices on the face between two blocks are identified by the number of
their edge, so both blocks use the same vertex. Values are interpolated between voxel centres, and
constant from the outermost centres to the faces of the box, as in pictures.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..base import check
from ..base.boxes import clamped_box, repeat_edges
from ..base.stage import Progress, no_progress
from ..base.volume import Volume, to_numpy
from ..meshes.contour import contour, edge_of
from ..meshes.mesh import Mesh
from ..pool import N3Tree
from .stores.store import CELL, Store
from .surface_file import SurfaceFile, check_surface_path

_BLOCK = 64  # cells along a side
Numbered = tuple[np.ndarray, np.ndarray]  # keys, increasing, and the numbers of their vertices


class SurfaceSize(NamedTuple):
    """The size of a surface."""

    vertices: int
    triangles: int


def extract_surface(
    what: Volume | Store | N3Tree,
    value: float,
    *,
    level: int = 0,
    component: int = 0,
    channel: str | None = None,
    caps: bool = True,
    progress: Progress = no_progress,
) -> Mesh:
    """Returns the surface around values of at least `value`, or around one label, as triangles in
    world units; see `export_surface` for one larger than memory.

    Args:
        what: A volume; a store, of which a block is read at a time; or a resident tree.
        value: The value on the surface; for labels, the label.
        level: Level of a store or a tree; 0 is the finest. Voxels of coarse levels are means, so
            thin structures vanish.
        component: Index of the component, if voxels hold several numbers.
        channel: Channel of a tree; the first if left out.
        caps: Closes the surface where it leaves the box. Else it ends at the outermost voxel
            centres.
        progress: Called with ("surface", blocks done, blocks in all).

    Returns:
        Triangles, counter-clockwise seen from lower values; every edge belongs to two triangles,
        except where an open surface ends. Where a voxel is `value` exactly, some have no area.

    Raises:
        ValueError: The data has no surface at `value`, an argument is out of its range, or not all
            of the tree is in memory.
        OSError: The store can't be read.

    Source: see meshes/contour.py.
    """
    grid = _Grid(what, value, level, component, channel, caps)
    parts = list(_parts(grid, progress))
    places, faces = (np.concatenate(those) for those in zip(*parts, strict=True))
    if not len(faces):
        raise ValueError(grid.nothing())
    return Mesh(vertices=places, faces=faces, name="surface")


def export_surface(
    what: Volume | Store | N3Tree,
    value: float,
    path: str | Path,
    *,
    level: int = 0,
    component: int = 0,
    channel: str | None = None,
    caps: bool = True,
    progress: Progress = no_progress,
) -> SurfaceSize:
    """Writes the surface of `extract_surface` to a file block by block, so that it may be larger
    than memory; the file appears once it is complete.

    Args:
        path: .ply (binary), or .glb (glTF 2.0; below 4 GB).
        what, value, level, component, channel, caps, progress: As in `extract_surface`.

    Raises:
        ValueError: `path` has another ending, there are more vertices than the file can hold, or as
            in `extract_surface`.
        FileNotFoundError: The folder does not exist.
    """
    path = Path(path)
    check_surface_path("export_surface", path)
    grid = _Grid(what, value, level, component, channel, caps)
    with SurfaceFile(path, grid.place(np.zeros((1, 3)))[0], float(grid.step.min())) as file:
        for places, faces in _parts(grid, progress):
            file.add(places, faces)
        if not file.triangles:
            raise ValueError(grid.nothing())
    return SurfaceSize(file.vertices, file.triangles)


class _Grid:
    """Samples of one component and level, z y x. With caps, two more layers surround the voxels:
    one on the faces of the box, which repeats the outermost values, and one outside.
    """

    def __init__(
        self,
        what: Volume | Store | N3Tree,
        value: float,
        level: int,
        component: int,
        channel: str | None,
        caps: bool,
    ) -> None:
        where = "extract_surface"
        if not isinstance(what, (Volume, Store, N3Tree)):
            kind = type(what).__name__
            raise ValueError(f"{where}: what must be a Volume, Store or N3Tree, got {kind}")
        self.what, self.more = what, 2 if caps else 0
        self.label: int | None = None
        self.value = check.number(where, "value", value)
        branching, levels = 2, what.levels if isinstance(what, Store) else 1
        if isinstance(what, N3Tree):
            branching, levels = what.branching, what.depth + 1
            self._bricks, self._channel = what.levels(), what.fine_channel(where, channel)
            width = what.bricks.channels[self._channel].width
            known, labels = what.labels.get(self._channel), self._channel in what.labels
        else:
            if channel is not None:
                raise ValueError(f"{where}: channel is for trees, got {channel!r}")
            width, known, labels = what.width, what.label_values, what.info.labels
        self.level = check.whole(where, "level", level, low=0, high=levels - 1)
        self.component = check.whole(where, "component", component, low=0, high=width - 1)
        if labels:
            self.label, self.value = _stored_label(self.value, known), 0.5
        scale = branching**level
        self.voxels = tuple(-(-n // scale) for n in what.extent[::-1])
        self.samples = tuple(n + 2 * self.more for n in self.voxels)
        spacing, origin = np.array(what.spacing[::-1]), np.array(what.origin[::-1])
        self.step = spacing * scale
        self._first = origin + spacing * (scale - 1) / 2  # of the first voxel's centre
        ends = np.array(what.extent[::-1]) / scale - 0.5  # far faces of the box, in voxels
        self._ends = np.clip(ends, np.array(self.voxels) - 1, None)

    def place(self, at: np.ndarray) -> np.ndarray:
        """Returns world positions (k, 3) x y z of positions z y x in samples."""
        found = at - self.more
        if self.more:
            found = np.where(found < 0, -0.5 * np.clip(-found, 0, 1), found)
            last = np.array(self.voxels) - 1
            beyond = np.clip(found - last, 0, 1)
            found = np.where(beyond > 0, last + beyond * (self._ends - last), found)
        return (self._first + found * self.step)[:, ::-1]

    def read(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Returns samples low to high, float64; outside they are -inf."""
        begin, end = ([n - self.more for n in corner] for corner in (low, high))
        start, stop = clamped_box(begin, end, self.voxels)
        values = self._voxels(start, stop)[..., self.component, None]
        values = repeat_edges(values, start, begin, end)[..., 0]
        same = values == self.label if self.label is not None else values
        samples = same.astype(np.float64)
        samples[np.isnan(samples)] = -np.inf
        for axis in range(3 if self.more else 0):
            at = np.arange(low[axis], high[axis])
            outside = (at == 0) | (at == self.samples[axis] - 1)
            samples[(slice(None),) * axis + (outside,)] = -np.inf
        return samples

    def _voxels(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Returns voxels low to high, which must lie inside, (z, y, x, c)."""
        if isinstance(self.what, Store):
            return self.what.read_region(self.level, low, high)
        if isinstance(self.what, N3Tree):
            found = self._bricks.read(self._channel, self.level, tuple(low), tuple(high))
        else:
            found = self.what.data[tuple(map(slice, low, high))]
        return to_numpy(found)

    def crossed(self, low: Sequence[int], high: Sequence[int]) -> bool:
        """Returns whether samples low to high may lie on both sides of the value: judged by the
        cells of a store, without reading voxels; true if there are no cells.
        """
        store = self.what
        outside = self.more and any(
            a == 0 or b == n for a, b, n in zip(low, high, self.samples, strict=True)
        )
        if not isinstance(store, Store) or not store.has_blocks:
            return True
        begin, end = ([n - self.more for n in corner] for corner in (low, high))
        start, stop = clamped_box(begin, end, self.voxels)
        cells = store.read_cells(
            self.level, [n // CELL for n in start], [-(-n // CELL) for n in stop]
        )[..., self.component]
        least, most = cells[..., 0].min(), cells[..., 1].max()
        if self.label is not None:
            return bool(least <= self.label <= most and (least < most or outside))
        return bool(most >= self.value and (least < self.value or outside))

    def nothing(self) -> str:
        """Returns the message for data without a surface."""
        what = f"value {self.value:g}" if self.label is None else "that label"
        return f"extract_surface: the data has no surface at {what}"


def _stored_label(label: float, known: torch.Tensor | None) -> int:
    """Returns the number by which a label is stored: its index in `known`, or itself."""
    value = check.whole(
        "extract_surface", "value of labels", int(label) if label % 1 == 0 else label, low=0
    )
    if known is None:
        return value
    found = (known == value).nonzero()
    if not len(found):
        raise ValueError(f"extract_surface: there is no label {value}")
    return int(found[0, 0])


def _parts(grid: _Grid, progress: Progress) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields new vertices, (v, 3) world x y z, and triangles that index all vertices so far. Blocks
    are visited along x, then y, then z; vertices on far faces are kept for the blocks behind them.
    """
    spans = [[(a, min(a + _BLOCK, n - 1)) for a in range(0, n - 1, _BLOCK)] for n in grid.samples]
    counts = [len(those) for those in spans]
    total, vertices = int(np.prod(counts)), 0
    far: dict[tuple[int, ...], Numbered] = {}  # by block, until the one behind it along z is done
    blocks = itertools.product(*(enumerate(those) for those in spans))
    for done, block in enumerate(blocks):
        at, low, high = (
            tuple(part) for part in zip(*((n, *span) for n, span in block), strict=True)
        )
        z, y, x = at
        before = [far.get(place) for place in ((z, y, x - 1), (z, y - 1, x), (z - 1, y, x))]
        far.pop((z - 1, y, x), None)
        end = [b + 1 for b in high]
        if grid.crossed(low, end):
            made = contour(grid.read(low, end), grid.value, low, grid.samples)
            number = _numbers(made.keys, filter(None, before), vertices)
            new = number >= vertices
            vertices += int(new.sum())
            start, along = edge_of(made.keys, grid.samples)
            on = ((start == high) & (along[:, None] != (2, 1, 0))).any(1)
            far[at] = made.keys[on], number[on]
            if len(made.faces):
                yield grid.place(made.places[new]), number[made.faces]
        progress("surface", done + 1, total)
    yield np.zeros((0, 3)), np.zeros((0, 3), np.int64)


def _numbers(keys: np.ndarray, known: Iterable[Numbered], count: int) -> np.ndarray:
    """Returns the number of each key's vertex: the known one, if it is on the far face of an
    earlier block, else a new one, from `count` on.
    """
    number = np.full(len(keys), -1)
    for names, numbers in known:
        if len(names):
            found = np.minimum(np.searchsorted(names, keys), len(names) - 1)
            same = names[found] == keys
            number[same] = numbers[found[same]]
    new = number < 0
    number[new] = count + np.arange(int(new.sum()))
    return number
