"""`Mesh`: triangles with colours, textures and materials; `solids`: which of them bound solids."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ..base import check

_MIN_SIZE = 1e-30  # world size of a mesh; 1 / _MIN_SIZE is the largest: squares are finite, not 0
_WELD_STEPS = 2.0**40  # steps along a mesh's longest side; vertices that round alike are merged
MOST_FACES = 2**28  # most triangles of a mesh: with their hierarchy, they would take 100 GB


def _check_color(context: str, color: np.ndarray) -> None:
    """Raises ValueError unless all of (..., 4) are light >= 0 and an opacity in [0, 1]."""
    low, high, opaque = (float(end) for end in (color.min(), color.max(), color[..., 3].max()))
    if not (low >= 0 and high < np.inf and opaque <= 1):  # so bytes are refused
        wanted = "finite, light >= 0, opacity 0 to 1"
        got = f"{low:g} to {high:g}, opacity up to {opaque:g}"
        raise ValueError(f"{context}: color must be {wanted}, got {got}")


@dataclass(frozen=True, kw_only=True)
class Material:
    """The look of some triangles of a mesh."""

    name: str = ""
    color: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)  # linear RGB, opacity
    texture: np.ndarray | None = field(default=None, repr=False)  # (h, w, 4) uint8, sRGB; row 0 top

    def __post_init__(self) -> None:
        """Raises ValueError if a field has the wrong shape or dtype, or is no colour."""
        color = check.reals(f"material {self.name!r}", "color", self.color, (4,))
        _check_color(f"material {self.name!r}", color.numpy())
        texture = self.texture
        if texture is not None and not (
            isinstance(texture, np.ndarray)
            and (texture.ndim, texture.shape[2:], texture.dtype) == (3, (4,), np.uint8)
            and texture.size
        ):
            got = check.as_text(texture)
            raise ValueError(f"material {self.name!r}: texture must be (h, w, 4) uint8, got {got}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangles, with colours and texture coordinates for each of their corners.

    Arrays of these dtypes are not copied, so they must not be changed afterwards. Raises ValueError
    if a field has the wrong shape, an index is out of range, a position or uv is not finite, a
    colour is not finite light >= 0 with an opacity in [0, 1], or there is no triangle.
    """

    vertices: np.ndarray  # (v, 3) float64, world units, x y z
    faces: np.ndarray  # (f, 3) int64 vertices, counter-clockwise seen from outside
    color: np.ndarray | None = None  # (f, 3, 4) float32 of each corner, linear RGB and opacity
    uv: np.ndarray | None = None  # (f, 3, 2) float32 of each corner, (0, 0) at the lower left
    material: np.ndarray | None = None  # (f,) int64 index into materials; all 0 if left out
    materials: tuple[Material, ...] = (Material(),)
    name: str = "mesh"  # for messages

    def __post_init__(self) -> None:
        count = None  # of faces, which come first
        for field_name, row_shape, dtype in (
            ("faces", (3,), np.int64),
            ("vertices", (3,), np.float64),
            ("color", (3, 4), np.float32),
            ("uv", (3, 2), np.float32),
            ("material", (), np.int64),
        ):
            value = getattr(self, field_name)
            if value is None and field_name not in ("faces", "vertices"):
                continue
            shape = (None if field_name == "vertices" else count, *row_shape)
            expected_shape = ", ".join("n" if n is None else str(n) for n in shape)
            check.no_gradient(self.name, field_name, value)
            try:
                array = check.real_array(value)
                is_whole = dtype != np.int64 or (array == np.trunc(array)).all()
                with np.errstate(invalid="ignore"):
                    value = np.ascontiguousarray(array, dtype)
            except (TypeError, ValueError):  # rows of different lengths, text
                raise ValueError(
                    f"{self.name}: {field_name} must be ({expected_shape}) numbers"
                ) from None
            if not is_whole:
                raise ValueError(f"{self.name}: {field_name} must be whole numbers")
            fits = value.ndim == len(shape) and all(
                n is None or n == m for n, m in zip(shape, value.shape, strict=True)
            )
            if not fits:
                got = value.shape
                raise ValueError(f"{self.name}: {field_name} must be ({expected_shape}), got {got}")
            vars(self)[field_name] = value
            count = len(self.faces)
        if self.material is None:
            vars(self)["material"] = np.zeros(count, np.int64)
        self._check()

    def _check(self) -> None:
        if not len(self.faces):
            raise ValueError(f"{self.name}: has no triangles")
        if len(self.faces) > MOST_FACES:
            raise ValueError(f"{self.name}: at most {MOST_FACES} triangles, got {len(self.faces)}")
        self._check_indices("vertex", self.faces, len(self.vertices))
        used = self.corners.reshape(-1, 3)
        bad = int((~np.isfinite(used)).any(1).sum())
        if bad:
            raise ValueError(f"{self.name}: {bad} corners of triangles are NaN or infinite")
        if self.color is not None:
            _check_color(self.name, self.color)
        if self.uv is not None and not np.isfinite(self.uv).all():
            raise ValueError(f"{self.name}: uv must be finite, got NaN or infinity")
        assert self.material is not None
        for entry in check.items(self.name, "materials", self.materials):
            check.instance(self.name, "each of materials", entry, Material)
        self._check_indices("material", self.material, len(self.materials))
        low, high = self.bounds
        if not (high > low).any():
            raise ValueError(f"{self.name}: all triangles lie in one point")
        with np.errstate(over="ignore"):
            size = max(float((high - low).max()), float(abs(used).max()))
        if not _MIN_SIZE <= size <= 1 / _MIN_SIZE:
            limits = f"{_MIN_SIZE:g} to {1 / _MIN_SIZE:g}"
            raise ValueError(f"{self.name}: size must be {limits} world units, got {size:.3g}")

    def _check_indices(self, kind: str, indices: np.ndarray, count: int) -> None:
        low, high = int(indices.min()), int(indices.max())
        if low < 0 or high >= count:
            bad = low if low < 0 else high
            raise ValueError(f"{self.name}: a triangle refers to {kind} {bad}, there are {count}")

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64 lowest and highest corner of the triangles."""
        used = np.zeros(len(self.vertices), bool)
        used[self.faces] = True
        return np.stack((self.vertices[used].min(0), self.vertices[used].max(0)))

    @property
    def corners(self) -> np.ndarray:
        """(f, 3, 3) float64 positions of the corners."""
        return self.vertices[self.faces]

    def only(self, kept: np.ndarray) -> Mesh:
        """Returns the mesh with only the triangles `kept`, (m,) int64."""
        arrays = {name: getattr(self, name) for name in ("faces", "color", "uv", "material")}
        return replace(self, **{n: array[kept] for n, array in arrays.items() if array is not None})

    def turned(self, which: np.ndarray) -> Mesh:
        """Returns the mesh with the triangles `which`, (m,) int64, facing the other way."""
        corner = np.tile(np.arange(3), (len(self.faces), 1))
        corner[which] = (0, 2, 1)
        row = np.arange(len(self.faces))[:, None]
        arrays = {name: getattr(self, name) for name in ("faces", "color", "uv")}
        return replace(self, **{n: a[row, corner] for n, a in arrays.items() if a is not None})

    def __repr__(self) -> str:
        low, high = (", ".join(f"{n:.6g}" for n in corner) for corner in self.bounds)
        painted = [n for n in ("color", "uv") if getattr(self, n) is not None]
        return (
            f"Mesh({len(self.faces)} triangles, {len(self.materials)} materials, "
            f"from ({low}) to ({high})" + (f", {', '.join(painted)})" if painted else ")")
        )


def solids(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Finds which triangles bound solids. Of triangles with the same three corners, one is kept;
    those without area are kept, since they close gaps, unless two of their corners are one.

    A part is a set of triangles connected by edges (vertices at the same position count as one). It
    bounds a solid if its triangles run along each edge equally often in both directions: then every
    point has a whole winding number. All other parts are sheets, and so are triangles that lie back
    to back, which are not counted in parts.

    Returns:
        kept (m,) int64 triangles; solid (m,) bool.
    """
    faces = welded(mesh)
    a, b, c = faces.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    if not len(kept):
        raise ValueError(f"{mesh.name}: no triangle has three corners")
    faces = faces[kept]
    sorted_corners = np.sort(faces, axis=1)
    first, distinct_index = _distinct_rows(sorted_corners)
    parities = np.zeros((len(first), 2), bool)
    parities[distinct_index, _parity(faces)] = True
    back_to_back = parities[:, 0] & parities[:, 1]
    faces, kept = faces[first], kept[first]
    order = np.argsort(kept)  # back in the mesh's order
    faces, kept, back_to_back = faces[order], kept[order], back_to_back[order]
    return kept, _closed(faces, ~back_to_back) & ~back_to_back


def _parity(faces: np.ndarray) -> np.ndarray:
    """Returns (f,) 1 where the corners are an even permutation of their sorted order, else 0."""
    a, b, c = faces.T
    return ((a < b).astype(np.int64) + (b < c) + (a < c)) % 2


def welded(mesh: Mesh) -> np.ndarray:
    """Returns faces (f, 3) int64 with vertices at the same position merged, to 10^-12 of the mesh's
    size: a pole or a seam that is computed twice differs by rounding.
    """
    low, high = mesh.bounds
    size = float((high - low).max())
    positions = mesh.vertices if size == 0 else np.round((mesh.vertices - low) / size * _WELD_STEPS)
    return _distinct_rows(positions)[1][mesh.faces]


def _distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns (m,) the index of the first of each distinct row of `rows` (n, 3), in sorted order,
    and (n,) which of these each row equals; takes a fifth of the time of np.unique.
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    new = np.append(True, (ordered[1:] != ordered[:-1]).any(1))[: len(rows)]
    same = np.empty(len(rows), np.int64)
    same[order] = np.cumsum(new) - 1
    return order[new], same


def edges_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns for each corner of each triangle (3 f,) the edge that begins there and the vertices
    where it begins and ends; and for each edge, how many more triangles run along it from its lower
    to its higher vertex than back.
    """
    begin, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    _, edge = np.unique(low * (faces.max() + 1) + high, return_inverse=True)
    edge = edge.reshape(-1)
    balance = np.bincount(edge, np.where(begin < end, 1, -1)).astype(np.int64)
    return edge, begin, end, balance


def facing_away(mesh: Mesh) -> np.ndarray:
    """Finds triangles that face the other way than most of their part. If exactly two triangles
    share an edge, they face the same way if they run along it in opposite directions; in each part
    that is connected by such edges, those that face the way of less area are returned. A part that
    can't be oriented, such as a Moebius strip, is left as it is.

    Returns:
        (m,) int64 triangles.
    """
    kept, _ = solids(mesh)
    faces = welded(mesh)[kept]
    edge, begin, end, _ = edges_of(faces)
    order = np.argsort(edge, kind="stable")
    first = np.searchsorted(edge[order], np.flatnonzero(np.bincount(edge) == 2))
    ahead = (begin < end).astype(np.int64)
    # Each triangle is two nodes, as it is and flipped; a node is connected to the neighbours' nodes
    # that run along the shared edge in the opposite direction.
    state = np.arange(2)[:, None]
    edge_nodes = [
        2 * np.arange(len(first)) + (ahead[order[first + side]] ^ state ^ side) for side in range(2)
    ]
    nodes = [order[first + side] // 3 + state * len(faces) for side in range(2)]
    part = part_of_faces(np.ravel(nodes), np.ravel(edge_nodes), 2 * len(faces), 2 * len(first))
    part = part.reshape(2, len(faces))
    part_label = part.min(0)
    # Whether they face the other way than their part's first triangle.
    unlike_first = part[0] > part_label
    a, b, c = mesh.corners[kept].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    excess = np.bincount(part_label, np.where(unlike_first, area, -area), len(faces))[part_label]
    return kept[(part[0] != part[1]) & (unlike_first == (excess <= 0))]


def _closed(faces: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Returns (f,) bool, whether a triangle's part is closed, by the triangles `counted` alone."""
    closed = np.zeros(len(faces), bool)
    counted_faces = np.flatnonzero(counted)
    if len(counted_faces):
        edge, _, _, balance = edges_of(faces[counted_faces])
        if not balance.any():  # all parts are closed
            closed[counted_faces] = True
            return closed
        face = np.repeat(np.arange(len(counted_faces)), 3)
        part = part_of_faces(face, edge, len(counted_faces), len(balance))
        closed[counted_faces] = ~np.isin(part, np.unique(part[face[balance[edge] != 0]]))
    return closed


def part_of_faces(face: np.ndarray, edge: np.ndarray, faces: int, edges: int) -> np.ndarray:
    """Returns (faces,) the lowest face number in each face's part; `face[i]` has `edge[i]`."""
    label = np.arange(faces)
    while True:
        lowest = np.full(edges, faces)
        np.minimum.at(lowest, edge, label[face])
        new_label = label.copy()
        np.minimum.at(new_label, face, lowest[edge])
        # Pass a face's new label on to its old label's face.
        np.minimum.at(new_label, label, new_label)
        new_label = new_label[new_label]
        if (new_label == label).all():
            return label
        label = new_label
