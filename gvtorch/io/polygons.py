"""Cuts the polygons of OBJ files that are not convex into triangles inside them, before trimesh
reads the file, because trimesh would make a fan around the first corner.
"""

from __future__ import annotations

import re
from collections import defaultdict

import numpy as np

_FACE = re.compile(rb"^[ \t]*f((?:[ \t]+[-\d/]+){4,})[ \t]*(?=\r?$)", re.MULTILINE)
_VERTEX = re.compile(rb"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_MOST = 1000  # corners of a polygon to cut: in the worst case, the time grows as their cube
_ROUND = 1e-9  # of the polygon's area: turns up to this count as straight


def cut_polygons(content: bytes) -> bytes:
    """Returns an OBJ file with triangles in place of the polygons that are not convex.

    Raises:
        ValueError: A position is no number, or such a polygon has more than 1000 corners.
    """
    faces: dict[int, list[re.Match[bytes]]] = defaultdict(list)
    for found in _FACE.finditer(content):
        faces[len(found[1].split())].append(found)
    if not faces:
        return content
    places = np.array([found.groups() for found in _VERTEX.finditer(content)], np.float64)
    cut: dict[int, tuple[re.Match[bytes], list[list[int]]]] = {}  # by the offset of the line
    for count, some in faces.items():
        words = re.sub(rb"/\S*", b"", b" ".join(found[1] for found in some)).split()
        corner = np.array(words, np.int64).reshape(-1, count)
        corner = np.where(corner > 0, corner - 1, corner + len(places))
        there = np.flatnonzero(((corner >= 0) & (corner < len(places))).all(1))
        flat = _flat(places[corner[there]])
        for at in np.flatnonzero((_turns(flat) < -_ROUND).any(1)).tolist():
            found = some[there[at]]
            if count > _MOST:
                raise ValueError(
                    f"a polygon of {count} corners is not convex, at most {_MOST} can be cut"
                )
            cut[found.start()] = found, ears(flat[at])
    parts, end = [], 0
    for start in sorted(cut):
        found, triangles = cut[start]
        words = found[1].split()
        lines = [b"f " + b" ".join(words[one] for one in three) for three in triangles]
        parts += [content[end:start], b"\n".join(lines)]
        end = found.end()
    return b"".join([*parts, content[end:]])


def _flat(places: np.ndarray) -> np.ndarray:
    """Projects corners (p, n, 3) of polygons to their planes, (p, n, 2): counter-clockwise, of
    area 1.

    Source: the normal is Newell's; Sutherland, Sproull, Schumacker, "A characterization of ten
        hidden-surface algorithms", ACM Computing Surveys 6, 1974.
    """
    arm = places - places.mean(1, keepdims=True)
    normal = 0.5 * np.cross(arm, np.roll(arm, -1, 1)).sum(1)
    area = np.linalg.norm(normal, axis=1)[:, None]
    area[area == 0] = 1
    normal = normal / area
    least = np.eye(3)[np.abs(normal).argmin(1)]
    right = np.cross(least, normal)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-300)
    basis = np.stack((right, np.cross(normal, right)), -1)
    return arm @ basis / np.sqrt(area)[:, None]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _turns(flat: np.ndarray) -> np.ndarray:
    """Returns (..., n) by how much a polygon (..., n, 2) turns left at each corner: twice the area
    of the triangle of the corner and its two neighbours.
    """
    before, after = np.roll(flat, 1, -2), np.roll(flat, -1, -2)
    return _cross(flat - before, after - flat)


def ears(flat: np.ndarray) -> list[list[int]]:
    """Cuts a polygon (n, 2), counter-clockwise, into n - 2 triangles of its corners: cuts off, one
    by one, a convex corner whose triangle holds no other corner (an ear). A polygon that crosses
    itself and has no ear left is cut as a fan.

    Source: Meisters, "Polygons have ears", American Mathematical Monthly 82, 1975.
    """
    left = list(range(len(flat)))
    found = []
    while len(left) > 3:
        own = flat[left]
        turn = _turns(own)
        not_convex = own[turn <= _ROUND]
        at = next((n for n in np.argsort(-turn) if _is_ear(own, int(n), turn[n], not_convex)), None)
        if at is None:
            break
        n = int(at)
        found.append([left[n - 1], left[n], left[(n + 1) % len(left)]])
        del left[n]
    return found + [[left[0], left[n], left[n + 1]] for n in range(1, len(left) - 1)]


def _is_ear(polygon: np.ndarray, at: int, turn: float, not_convex: np.ndarray) -> bool:
    if turn <= 0:
        return False
    a, b, c = polygon[at - 1], polygon[at], polygon[(at + 1) % len(polygon)]
    inside = np.ones(len(not_convex), bool)
    for begin, end in ((a, b), (b, c), (c, a)):
        inside &= _cross(end - begin, not_convex - begin) >= 0
        inside &= (not_convex != begin).any(1)
    return not inside.any()
