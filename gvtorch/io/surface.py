"""`extract_surface`, `export_surface`: the surface on which a volume, a store or a tree crosses a
value, as triangles; made block by block, so that memory holds a block and the vertices on the faces
of earlier ones.

Every cell is in one block. Vertices on the face between two blocks are identified by the number of
their edge, so both blocks use the same vertex. Values are interpolated between voxel centres, and
constant from the outermost centres to the faces of the box, as in pictures.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..base import check
from ..base.boxes import clamped_box, repeat_edges
from ..base.image_info import SIGNED_DISTANCE
from ..base.stage import Progress, no_progress
from ..base.volume import Volume, to_numpy
from ..meshes.contour import contour, edge_of
from ..meshes.mesh import Mesh
from ..pool import N3Tree
from ..pool.refresh import Span
from .stores.store import CELL, Store
from .surface_file import SurfaceFile, check_surface_path

_BLOCK_CELLS = 64  # along a side
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
    world units; see `export_surface` for one larger than memory. The surface of a volume or a store
    of signed distances (`ImageInfo.quantity`) is around values of at most `value`.

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
        Triangles, counter-clockwise seen from outside; every edge belongs to two triangles,
        except where an open surface ends. Where a voxel is `value` exactly, some have no area.

    Raises:
        ValueError: The data has no surface at `value`, an argument is out of its range, or not all
            of the tree is in memory.
        OSError: The store can't be read.

    Source: see meshes/contour.py.
    """
    grid = _Grid(what, value, level, component, channel, caps)
    parts = list(_surface_parts(grid, progress))
    vertices, faces = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    if not len(faces):
        raise ValueError(grid.no_surface_message())
    return Mesh(vertices=vertices, faces=faces, name="surface")


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
    origin, step = grid.to_world(np.zeros((1, 3)))[0], float(grid.step.min())
    with SurfaceFile(path, origin, step).opened() as file:
        for vertices, faces in _surface_parts(grid, progress):
            file.add(vertices, faces)
        if not file.triangles:
            raise ValueError(grid.no_surface_message())
    return SurfaceSize(file.vertices, file.triangles)


class _Grid:
    """Samples of one component and level, z y x. With caps, two more layers surround the voxels:
    one on the faces of the box, which repeats the outermost values, and one outside.
    """

    def __init__(
        self,
        source: Volume | Store | N3Tree,
        value: float,
        level: int,
        component: int,
        channel: str | None,
        caps: bool,
    ) -> None:
        caller = "extract_surface"
        if not isinstance(source, (Volume, Store, N3Tree)):
            kind = type(source).__name__
            raise ValueError(f"{caller}: what must be a Volume, Store or N3Tree, got {kind}")
        self.source, self.margin = source, 2 if caps else 0
        self.label: int | None = None
        is_distance = isinstance(source, (Volume, Store)) and (
            source.info.quantity == SIGNED_DISTANCE
        )
        self._sign = -1 if is_distance else 1  # signed distances grow outwards
        self.value = self._sign * check.number(caller, "value", value)
        branching, levels = 2, source.levels if isinstance(source, Store) else 1
        if isinstance(source, N3Tree):
            branching, levels = source.branching, source.depth + 1
            self._bricks, self._channel = source.levels(), source.fine_channel(caller, channel)
            width, labels = source.bricks.channels[self._channel].width, source.labels
            label_values, is_labelled = labels.get(self._channel), self._channel in labels
        else:
            if channel is not None:
                raise ValueError(f"{caller}: channel is for trees, got {channel!r}")
            width, label_values, is_labelled = source.width, source.label_values, source.info.labels
        self.level = check.integer(caller, "level", level, low=0, high=levels - 1)
        self.component = check.integer(caller, "component", component, low=0, high=width - 1)
        if is_labelled:
            self.label, self.value = _stored_label(self.value, label_values), 0.5
        scale = branching**level
        self.voxels = tuple(-(-n // scale) for n in source.extent[::-1])
        self.samples = tuple(n + 2 * self.margin for n in self.voxels)
        spacing, origin = np.array(source.spacing[::-1]), np.array(source.origin[::-1])
        self.step = spacing * scale
        self._first_center = origin + spacing * (scale - 1) / 2  # of the first voxel's centre
        far_faces = np.array(source.extent[::-1]) / scale - 0.5  # far faces of the box, in voxels
        self._far_faces = np.clip(far_faces, np.array(self.voxels) - 1, None)

    def to_world(self, positions: np.ndarray) -> np.ndarray:
        """Returns world positions (k, 3) x y z of positions z y x in samples."""
        voxels = positions - self.margin
        if self.margin:
            voxels = np.where(voxels < 0, -0.5 * np.clip(-voxels, 0, 1), voxels)
            last = np.array(self.voxels) - 1
            beyond = np.clip(voxels - last, 0, 1)
            voxels = np.where(beyond > 0, last + beyond * (self._far_faces - last), voxels)
        return (self._first_center + voxels * self.step)[:, ::-1]

    def read(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Returns samples low to high, float64, which grow inwards; outside they are -inf."""
        begin, end = ([n - self.margin for n in corner] for corner in (low, high))
        start, stop = clamped_box(begin, end, self.voxels)
        values = self._voxels(start, stop)[..., self.component, None]
        values = repeat_edges(values, start, begin, end)[..., 0]
        scalars = values == self.label if self.label is not None else values
        samples = self._sign * scalars.astype(np.float64)
        samples[np.isnan(samples)] = -np.inf
        for axis in range(3 if self.margin else 0):
            layer = np.arange(low[axis], high[axis])
            outside = (layer == 0) | (layer == self.samples[axis] - 1)
            samples[(slice(None),) * axis + (outside,)] = -np.inf
        return samples

    def _voxels(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Returns voxels low to high, which must lie inside, (z, y, x, c)."""
        if isinstance(self.source, Store):
            return self.source.read_region(self.level, low, high)
        if isinstance(self.source, N3Tree):
            voxels = self._bricks.read(self._channel, self.level, Span(tuple(low), tuple(high)))
        else:
            voxels = self.source.data[tuple(map(slice, low, high))]
        return to_numpy(voxels)

    def may_cross(self, low: Sequence[int], high: Sequence[int]) -> bool:
        """Returns whether samples low to high may lie on both sides of the value: judged by the
        cells of a store, without reading voxels; true if there are no cells.
        """
        store, ends = self.source, zip(low, high, self.samples, strict=True)
        if not isinstance(store, Store) or not store.has_blocks:
            return True
        outside = self.margin and any(a == 0 or b == n for a, b, n in ends)
        begin, end = ([n - self.margin for n in corner] for corner in (low, high))
        start, stop = clamped_box(begin, end, self.voxels)
        first, last = [n // CELL for n in start], [-(-n // CELL) for n in stop]
        cells = store.read_cells(self.level, first, last)[..., self.component]
        ends_of_range = float(cells[..., 0].min()), float(cells[..., 1].max())
        lowest, highest = sorted(self._sign * end for end in ends_of_range)
        if self.label is not None:
            return bool(lowest <= self.label <= highest and (lowest < highest or outside))
        return bool(highest >= self.value and (lowest < self.value or outside))

    def no_surface_message(self) -> str:
        """Returns the message for data without a surface."""
        target = f"value {self._sign * self.value:g}" if self.label is None else "that label"
        return f"extract_surface: the data has no surface at {target}"


def _stored_label(label: float, label_values: torch.Tensor | None) -> int:
    """Returns the number by which a label is stored: its index in `label_values`, or itself."""
    whole = int(label) if label % 1 == 0 else label
    value = check.integer("extract_surface", "value of labels", whole, low=0)
    if label_values is None:
        return value
    matches = (label_values == value).nonzero()
    if not len(matches):
        raise ValueError(f"extract_surface: there is no label {value}")
    return int(matches[0, 0])


def _surface_parts(grid: _Grid, progress: Progress) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields new vertices, (v, 3) world x y z, and triangles that index all vertices so far. Blocks
    are visited along x, then y, then z; vertices on far faces are kept for the blocks behind them.
    """
    last_cells = [n - 1 for n in grid.samples]
    counts = [-(-n // _BLOCK_CELLS) for n in last_cells]
    total, vertices = int(np.prod(counts)), 0
    # By block, until the one behind it along z is done.
    far_vertices: dict[tuple[int, ...], Numbered] = {}
    for blocks_done, block_index in enumerate(np.ndindex(*counts)):
        low = tuple(_BLOCK_CELLS * n for n in block_index)
        high = tuple(min(a + _BLOCK_CELLS, n) for a, n in zip(low, last_cells, strict=True))
        z, y, x = block_index
        near, behind = ((z, y, x - 1), (z, y - 1, x)), (z - 1, y, x)
        neighbours = [*(far_vertices.get(n) for n in near), far_vertices.pop(behind, None)]
        end = [b + 1 for b in high]
        if grid.may_cross(low, end):
            piece = contour(grid.read(low, end), grid.value, low, grid.samples)
            vertex_numbers = _vertex_numbers(piece.keys, filter(None, neighbours), vertices)
            is_new = vertex_numbers >= vertices
            vertices += int(is_new.sum())
            start, edge_axis = edge_of(piece.keys, grid.samples)
            on_far_face = ((start == high) & (edge_axis[:, None] != (2, 1, 0))).any(1)
            far_vertices[block_index] = piece.keys[on_far_face], vertex_numbers[on_far_face]
            if len(piece.faces):
                yield grid.to_world(piece.places[is_new]), vertex_numbers[piece.faces]
        progress("surface", blocks_done + 1, total)
    yield np.zeros((0, 3)), np.zeros((0, 3), np.int64)


def _vertex_numbers(keys: np.ndarray, earlier: Iterable[Numbered], first_new: int) -> np.ndarray:
    """Returns the number of each key's vertex: the known one, if it is on the far face of an
    earlier block, else a new one, from `first_new` on.
    """
    vertex_numbers = np.full(len(keys), -1)
    for earlier_keys, earlier_numbers in earlier:
        if len(earlier_keys):
            positions = np.minimum(np.searchsorted(earlier_keys, keys), len(earlier_keys) - 1)
            is_known = earlier_keys[positions] == keys
            vertex_numbers[is_known] = earlier_numbers[positions[is_known]]
    is_new = vertex_numbers < 0
    vertex_numbers[is_new] = first_new + np.arange(int(is_new.sum()))
    return vertex_numbers
