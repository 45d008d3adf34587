"""Rewrites OBJ files before trimesh reads them: `plain_obj` what trimesh would not read, or not
right, `cut_polygons` polygons that are not convex, of which it would make a fan around a corner.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from functools import partial

import numpy as np

_CORNERS = re.compile(rb"^f [^\n]*-[^\n]*", re.MULTILINE)  # of a face with numbers below 0
_FACE = re.compile(rb"^f((?: +[\d/]+){4,}) *$", re.MULTILINE)
_VERTEX = re.compile(rb"^v +(\S+) +(\S+) +(\S+)", re.MULTILINE)
_MAX_CORNERS = 1000  # of a polygon to cut: in the worst case, the time grows as their cube
_STRAIGHT_TURN = 1e-9  # of the polygon's area: turns up to this count as straight


def plain_obj(content: bytes) -> bytes:
    """Returns an OBJ file without tabs, indented lines, comments, lines that go on in the next one,
    and corners that count backwards, from the vertex before their face.

    Raises:
        ValueError: A corner counts back to a vertex before the first.
    """
    content = content.replace(b"\r\n", b"\n").replace(b"\t", b" ")
    if content[:1] == b" " or b"\n " in content:
        content = re.sub(rb"(?m)^ +", b"", content)
    # Before lines are joined: a comment may end in a backslash, as names of folders do.
    content = re.sub(rb"#[^\n]*", partial(_without_comment, content), content)
    content = content.replace(b"\\\n", b" ")
    if not _CORNERS.search(content):
        return content
    starts = [
        np.array([match.start() for match in re.finditer(rb"(?m)^%s " % kind, content)])
        for kind in (b"v", b"vt", b"vn")
    ]

    def count_forwards(match: re.Match[bytes]) -> bytes:
        counts = [int(np.searchsorted(lines, match.start())) for lines in starts]
        corners = []
        for corner in match[0].split()[1:]:
            pairs = [*zip(corner.split(b"/"), counts, strict=False)]
            numbers = [int(n) + count + 1 if n[:1] == b"-" else n for n, count in pairs]
            if any(isinstance(n, int) and n < 1 for n in numbers):
                raise ValueError(f"a corner {corner.decode()} behind {counts[0]} vertices")
            corners.append(b"/".join(b"%d" % n if isinstance(n, int) else n for n in numbers))
        return b"f " + b" ".join(corners)

    return _CORNERS.sub(count_forwards, content)


def _without_comment(content: bytes, comment: re.Match[bytes]) -> bytes:
    """Returns nothing for a comment, but names as they are: they may contain a #."""
    line = content.rfind(b"\n", 0, comment.start()) + 1
    is_named = content[line : line + 2] not in (b"f ", b"v ", b"vt", b"vn")
    return comment[0] if is_named and line < comment.start() else b""


def cut_polygons(content: bytes) -> bytes:
    """Returns an OBJ file of `plain_obj` with triangles for the polygons that are not convex.

    Raises:
        ValueError: A position is no number, or such a polygon has more than 1000 corners.
    """
    faces: dict[int, list[re.Match[bytes]]] = defaultdict(list)
    for match in _FACE.finditer(content):
        faces[len(match[1].split())].append(match)
    if not faces:
        return content
    vertices = np.array([match.groups() for match in _VERTEX.finditer(content)], np.float64)
    # The line of each cut polygon and its triangles, by the offset of the line.
    triangulated: dict[int, tuple[re.Match[bytes], list[list[int]]]] = {}
    for count, matches in faces.items():
        tokens = re.sub(rb"/\S*", b"", b" ".join(match[1] for match in matches)).split()
        corners = np.array(tokens, np.int64).reshape(-1, count) - 1
        valid = np.flatnonzero(((corners >= 0) & (corners < len(vertices))).all(1))
        flat = _project(vertices[corners[valid]])
        for number in np.flatnonzero((_turns(flat) < -_STRAIGHT_TURN).any(1)).tolist():
            match = matches[valid[number]]
            if count > _MAX_CORNERS:
                raise ValueError(
                    f"a polygon of {count} corners is not convex, at most {_MAX_CORNERS} can be cut"
                )
            triangulated[match.start()] = match, ears(flat[number])
    parts, end = [], 0
    for start in sorted(triangulated):
        match, triangles = triangulated[start]
        tokens = match[1].split()
        lines = [b"f " + b" ".join(tokens[corner] for corner in triangle) for triangle in triangles]
        parts += [content[end:start], b"\n".join(lines)]
        end = match.end()
    return b"".join([*parts, content[end:]])


def _project(corners: np.ndarray) -> np.ndarray:
    """Projects corners (p, n, 3) of polygons to their planes, (p, n, 2): counter-clockwise, of
    area 1.

    Source: the normal is Newell's; Sutherland, Sproull, Schumacker, "A characterization of ten
        hidden-surface algorithms", ACM Computing Surveys 6, 1974.
    """
    offsets = corners - corners.mean(1, keepdims=True)
    normal = 0.5 * np.cross(offsets, np.roll(offsets, -1, 1)).sum(1)
    area = np.linalg.norm(normal, axis=1)[:, None]
    area[area == 0] = 1
    normal = normal / area
    least_axis = np.eye(3)[np.abs(normal).argmin(1)]
    right = np.cross(least_axis, normal)
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-300)
    basis = np.stack((right, np.cross(normal, right)), -1)
    return offsets @ basis / np.sqrt(area)[:, None]


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
    remaining = list(range(len(flat)))
    triangles = []
    while len(remaining) > 3:
        polygon = flat[remaining]
        turn = _turns(polygon)
        not_convex = polygon[turn <= _STRAIGHT_TURN]
        order = np.argsort(-turn).tolist()
        n = next((n for n in order if _is_ear(polygon, n, turn[n], not_convex)), None)
        if n is None:
            break
        triangles.append([remaining[n - 1], remaining[n], remaining[(n + 1) % len(remaining)]])
        del remaining[n]
    first, *others = remaining
    return triangles + [[first, a, b] for a, b in itertools.pairwise(others)]


def _is_ear(polygon: np.ndarray, corner: int, turn: float, not_convex: np.ndarray) -> bool:
    if turn <= 0:
        return False
    a, b, c = polygon[corner - 1], polygon[corner], polygon[(corner + 1) % len(polygon)]
    inside = np.ones(len(not_convex), bool)
    for begin, end in ((a, b), (b, c), (c, a)):
        inside &= _cross(end - begin, not_convex - begin) >= 0
        inside &= (not_convex != begin).any(1)
    return not inside.any()
