"""`contour`: the surface where a grid of samples crosses a value, cell by cell (marching cubes).

A cell has a sample at each of its 8 corners. A vertex lies on each edge whose ends are on different
sides of the value; on each face, lines join the vertices of its edges; the lines of all six faces
form loops, and these are cut into triangles. A face's lines depend on its own four samples only:
where two inside corners are diagonal, each is cut off separately. So the two cells at a face agree,
and there are no cracks. All other edges of triangles lie inside their cell. So each edge belongs to
exactly two triangles, and the surface is a manifold, except where the grid ends.

The tables are computed here, from that rule.

Source: Lorensen and Cline, "Marching cubes", SIGGRAPH 1987; Duerst, "Additional reference to
marching cubes", 1988 (faces that can be joined in two ways).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

#: Corner n of a cell lies at x = n & 1, y = n >> 1 & 1, z = n >> 2 & 1. Edges: axis, first corner.
_EDGES = [(axis, n) for axis in range(3) for n in range(8) if not n >> axis & 1]
_EDGE_NUMBER = {edge: number for number, edge in enumerate(_EDGES)}
_EDGE_AXIS = np.array([axis for axis, _ in _EDGES])  # 0: x
_EDGE_START = np.array([[n >> 2 & 1, n >> 1 & 1, n & 1] for _, n in _EDGES])  # z y x


class Tables(NamedTuple):
    """Triangles of each of the 256 kinds of cells: corner n is inside where bit n is set."""

    triangles: np.ndarray  # (256,) number of triangles
    first: np.ndarray  # (256,) row in `edges` of the first triangle
    edges: np.ndarray  # (t, 3) the cell's edges on which a triangle's corners lie


class Contour(NamedTuple):
    """A part of a surface."""

    keys: np.ndarray  # (v,) int64, increasing: `key` of the edge on which each vertex lies
    places: np.ndarray  # (v, 3) float64 positions of the vertices, z y x in samples
    faces: np.ndarray  # (f, 3) vertices, counter-clockwise seen from the side of lower values


def contour(
    samples: np.ndarray,  # (z, y, x) float64; -inf: outside, vertices lie at edges' other ends
    value: float,  # samples of at least this are inside
    low: Sequence[int],  # z y x of the first sample in the grid; keys and places refer to the grid
    grid: Sequence[int],  # samples z y x of the grid
) -> Contour:
    """Returns the surface in the cells of a block of samples."""
    inside = samples >= value
    cells = tuple(n - 1 for n in samples.shape)
    kind = np.zeros(cells, np.uint8)
    for n in range(8):
        corner = [n >> bit & 1 for bit in (2, 1, 0)]
        window = tuple(slice(a, a + count) for a, count in zip(corner, cells, strict=True))
        kind |= inside[window].view(np.uint8) << n
    crossed_cell = np.argwhere((kind != 0) & (kind != 255))  # (k, 3)
    tables = _tables()
    cell_kind = kind[tuple(crossed_cell.T)]
    count = tables.triangles[cell_kind]
    cell = np.repeat(np.arange(len(crossed_cell)), count)
    triangle = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    edge = tables.edges[np.repeat(tables.first[cell_kind], count) + triangle]  # (f, 3)
    start = crossed_cell[cell][:, None] + _EDGE_START[edge] + np.asarray(low)  # (f, 3, 3)
    keys, faces = np.unique(key(start, _EDGE_AXIS[edge], grid), return_inverse=True)
    return Contour(keys, _vertex_positions(samples, value, keys, low, grid), faces.reshape(-1, 3))


def key(start: np.ndarray, axis: np.ndarray, grid: Sequence[int]) -> np.ndarray:
    """Returns a unique number for each edge of a grid of samples (z y x), from its first sample
    (..., 3) and its axis, 0 along x.
    """
    z, y, x = np.moveaxis(start, -1, 0)
    return ((z * grid[1] + y) * grid[2] + x) * 3 + axis


def edge_of(keys: np.ndarray, grid: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns first samples (k, 3) z y x and axes of keys (k,)."""
    first_sample, axis = np.divmod(keys, 3)
    return np.stack(np.unravel_index(first_sample, tuple(grid)), -1), axis


def _vertex_positions(
    samples: np.ndarray, value: float, keys: np.ndarray, low: Sequence[int], grid: Sequence[int]
) -> np.ndarray:
    """Returns (v, 3) the position of the value on each edge, by linear interpolation."""
    start, axis = edge_of(keys, grid)
    end = start.copy()
    row, column = np.arange(len(keys)), 2 - axis
    end[row, column] += 1
    a, b = (samples[tuple((sample - np.asarray(low)).T)] for sample in (start, end))
    with np.errstate(invalid="ignore"):
        fraction = (value - a) / (b - a)
    fraction = np.where(np.isneginf(b), 0.0, np.where(np.isneginf(a), 1.0, fraction))
    positions = start.astype(np.float64)
    positions[row, column] += fraction
    return positions


@functools.cache
def _tables() -> Tables:
    triangles = [
        [triangle for loop in _loops(kind) for triangle in _triangulated(tuple(loop))]
        for kind in range(256)
    ]
    count = np.array([len(cell_triangles) for cell_triangles in triangles])
    edges = np.array([triangle for cell_triangles in triangles for triangle in cell_triangles])
    return Tables(count, np.cumsum(count) - count, edges)


def _loops(kind: int) -> list[list[int]]:
    """Returns the loops of cell edges around the inside corners of a cell."""
    next_edge: dict[int, int] = {}
    for corners in _faces():
        pairs = list(itertools.pairwise((*corners, corners[0])))
        crossed = [(_edge(a, b), kind >> b & 1) for a, b in pairs if (kind >> a ^ kind >> b) & 1]
        for n, (edge, enters) in enumerate(crossed):
            if enters:  # join the edge where the face's rim enters to the next, where it leaves
                next_edge[edge] = crossed[(n + 1) % len(crossed)][0]
    loops = []
    while next_edge:
        edge, following = next_edge.popitem()
        loop = [edge]
        while following != edge:
            loop.append(following)
            following = next_edge.pop(following)
        loops.append(loop)
    return loops


def _faces() -> list[tuple[int, ...]]:
    """Returns the corners of each face of a cell, counter-clockwise seen from outside."""
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        around = [0, u, u + v, v]
        faces.append(tuple((side << axis) + n for n in (around if side else around[::-1])))
    return faces


def _edge(a: int, b: int) -> int:
    return _EDGE_NUMBER[(a ^ b).bit_length() - 1, min(a, b)]


def _on_one_face(a: int, b: int) -> bool:
    """Returns whether two edges of a cell lie on the same face."""
    ends = [{n, n | 1 << axis} for axis, n in (_EDGES[a], _EDGES[b])]
    return any(ends[0] | ends[1] <= set(corners) for corners in _faces())


@functools.cache
def _triangulated(loop: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """Cuts a loop into triangles, with cuts inside the cell only and the least total length."""
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    best: list[tuple[int, int, int]] = []
    for n in range(1, len(loop) - 1):
        sides = ((loop[0], loop[n]), (loop[n], loop[-1]))
        inner = [pair for pair, ends in zip(sides, (n > 1, n < len(loop) - 2), strict=True) if ends]
        if any(_on_one_face(*pair) for pair in inner):
            continue
        parts = [_triangulated(part) for part in (loop[: n + 1], loop[n:]) if len(part) > 2]
        triangles = [(loop[0], loop[n], loop[-1]), *itertools.chain(*parts)]
        if all(parts) and (not best or _length(triangles) < _length(best)):
            best = triangles
    return best


def _length(triangles: list[tuple[int, int, int]]) -> float:
    """Returns the length of all triangles' edges, with vertices in the middle of cell edges."""
    middles = _EDGE_START.astype(np.float64)
    middles[np.arange(12), 2 - _EDGE_AXIS] = 0.5
    corners = middles[np.array(triangles)]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).sum())
