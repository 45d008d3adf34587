"""Holes of meshes: `rims` finds them, and `filled` closes them along the surface on which the
generalised winding number is one half; all other code then treats the mesh as a solid.

Source: Jacobson, Kavan, Sorkine-Hornung, "Robust inside-outside segmentation using generalized
    winding numbers", SIGGRAPH 2013, section 3 (that surface closes open parts).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from .mesh import Mesh, edges_of, facing_away, part_of_faces, solids, welded
from .winding import WindingNumber

#: Which parts are solids: closed ones, those that are closed after filling holes, or none.
SolidParts = Literal["auto", "always", "never"]

_RINGS = 4  # rings of triangles between a hole's rim and its middle
_BISECTIONS = 12  # steps of the bisection
_NEARLY_CLOSED = 0.02  # a part with at most this many hole edges per triangle is nearly closed
_MIN_VOLUME_RATIO = 1e-3  # a part whose volume / area^(3/2) is at most this encloses nothing


@dataclass(frozen=True)
class Rim:
    """A hole's rim: triangle corners in order around it, with the hole to their left seen from
    outside.
    """

    part: int  # the part that it belongs to, named by one of its triangles
    face: np.ndarray  # (n,) the triangle along each edge
    corner: np.ndarray  # (n,) the corner of that triangle at which the rim's edge begins


def rims(mesh: Mesh) -> tuple[list[Rim], np.ndarray]:
    """Returns the rims of all holes; and (f,) each triangle's part, -1 for triangles that `solids`
    leaves out.
    """
    kept, _ = solids(mesh)
    faces = welded(mesh)[kept]
    edge, begin, end, balance = edges_of(faces)
    face = np.repeat(np.arange(len(faces)), 3)
    part = np.full(len(mesh.faces), -1)
    part_label = part_of_faces(face, edge, len(faces), int(edge.max()) + 1)
    part[kept] = kept[part_label]
    # Where `excess` more triangles run along an edge one way than the other, the rim runs the other
    # way, `excess` times; of the triangles that run the first way, the first ones are used.
    excess = np.abs(balance)[edge]
    ahead = np.sign(balance)[edge] == np.where(begin < end, 1, -1)
    order = np.lexsort((np.arange(len(edge)), edge))
    rim_edges = order[(excess > 0)[order] & ahead[order]]
    rank = np.arange(len(rim_edges)) - np.searchsorted(edge[rim_edges], edge[rim_edges])
    rim_edges = rim_edges[rank < excess[rim_edges]]
    hole_rims = []
    for loop in _loops(end[rim_edges], begin[rim_edges]):
        rim_faces = kept[face[rim_edges[loop]]]
        hole_rims.append(Rim(int(part[rim_faces[0]]), rim_faces, (rim_edges[loop] + 1) % 3))
    return hole_rims, part


def _loops(begin: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """Splits edges into loops that pass no vertex twice: (n,) edges each, in order. As many edges
    must end in each vertex as begin there.
    """
    leaving: dict[int, list[int]] = {}
    for edge, vertex in enumerate(begin.tolist()):
        leaving.setdefault(vertex, []).append(edge)
    ends, begins = end.tolist(), begin.tolist()
    loops = []
    for vertex in list(leaving):
        while leaving[vertex]:
            path: list[int] = []
            seen = {vertex: 0}
            current = vertex
            while True:
                edge = leaving[current].pop()
                path.append(edge)
                current = ends[edge]
                if current in seen:
                    loop = path[seen[current] :]
                    loops.append(np.array(loop))
                    del path[seen[current] :]
                    for passed in loop[1:]:
                        seen.pop(begins[passed], None)
                    if not path:
                        break
                else:
                    seen[current] = len(path)
    return loops


def warning_of_holes(mesh: Mesh) -> str:
    """Returns a warning if parts are nearly closed, or few triangles turned; else an empty text."""
    kept, solid = solids(mesh)
    if solid.all():
        return ""
    flipped = facing_away(mesh)
    hole_rims, part = rims(mesh.turned(flipped))
    count = np.bincount(part[kept], minlength=len(mesh.faces))
    edges = np.zeros(len(mesh.faces))
    for rim in hole_rims:
        edges[rim.part] += len(rim.face)
    nearly = np.flatnonzero((edges > 0) & (edges <= _NEARLY_CLOSED * count))
    holes = sum(rim.part in nearly for rim in hole_rims)
    reasons = []
    if holes:
        reasons.append(
            f"{holes} holes of {int(edges[nearly].sum())} edges leave {len(nearly)} parts open"
        )
    if len(flipped) and len(flipped) <= _NEARLY_CLOSED * len(kept):
        reasons.append(f"{len(flipped)} triangles face the other way than those around them")
    if not reasons:
        return ""
    return (
        f"{mesh.name}: {', '.join(reasons)}: they become sheets; "
        'solid="always" (--solid always) mends them'
    )


def warn_of_holes(mesh: Mesh, solid: str, stacklevel: int) -> None:
    """Issues `warning_of_holes` where it matters: if closed parts alone are to be solids ("auto").
    `stacklevel` is as in `warnings.warn`: 2 is the line that called this function's caller.
    """
    if solid == "auto" and (message := warning_of_holes(mesh)):
        warnings.warn(message, stacklevel=stacklevel + 1)


def filled(mesh: Mesh) -> Mesh:
    """Returns the mesh with its holes closed, and triangles that face the wrong way turned. Parts
    that enclose nothing even then, such as a leaf, are not closed.
    """
    flipped = facing_away(mesh)
    mesh = mesh.turned(flipped) if len(flipped) else mesh
    hole_rims, part = rims(mesh)
    if not hole_rims:
        return mesh
    in_open_part = np.isin(part, [rim.part for rim in hole_rims])
    winding = WindingNumber(torch.from_numpy(mesh.corners[in_open_part]))
    caps = [(rim.part, _cap(mesh, rim, winding)) for rim in hole_rims]
    a, b, c = mesh.corners.transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    areas = 0.5 * np.linalg.norm(cross[in_open_part], axis=1)
    area = np.bincount(part[in_open_part], areas, len(part))
    volume = np.zeros(len(part))
    for owner in {rim.part for rim in hole_rims}:
        corners = np.concatenate(
            [mesh.corners[part == owner], *(cap.corners for other, cap in caps if other == owner)]
        )
        corners = corners - corners.mean((0, 1))
        volume[owner] = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    round_enough = np.abs(volume) > _MIN_VOLUME_RATIO * area**1.5
    return _joined(mesh, [cap for owner, cap in caps if round_enough[owner]])


def _cap(mesh: Mesh, rim: Rim, winding: WindingNumber) -> Mesh:
    """Returns triangles that close a hole: rings from its rim to its middle, moved along the rim's
    normal to where the winding number is one half.
    """
    assert mesh.material is not None
    around, n = np.arange(len(rim.face)), len(rim.face)
    rim_points = mesh.vertices[mesh.faces[rim.face, rim.corner]]
    middle = rim_points.mean(0)
    spoke = rim_points - middle
    normal = np.cross(spoke, np.roll(spoke, -1, 0)).sum(0)
    size, radius = np.linalg.norm(normal), np.linalg.norm(spoke, axis=1).mean()
    fraction = np.arange(1, _RINGS + 1)[:, None, None] / _RINGS  # 0 at the rim
    inner = middle + spoke * (1 - fraction[:-1])
    points = np.concatenate((inner.reshape(-1, 3), middle[None]))
    if size > 0:
        points = _on_half_winding(points, normal / size, radius, winding)
    points = np.concatenate((rim_points, points))
    ring = np.arange(_RINGS * n).reshape(_RINGS, n)
    ring = np.concatenate((ring, np.full((1, n), _RINGS * n)))
    a, b = ring[:-1], np.roll(ring[:-1], -1, 1)
    c, d = np.roll(ring[1:], -1, 1), ring[1:]
    faces = np.concatenate((np.stack((a, b, c), -1)[:-1], np.stack((a, c, d), -1)[:-1]))
    last = np.stack((a[-1], b[-1], d[-1]), -1)
    faces = np.concatenate((faces.reshape(-1, 3), last))

    def spread(values: np.ndarray | None) -> np.ndarray | None:
        """Returns values for each corner, blended from the rim's to their mean in the middle."""
        if values is None:
            return None
        rim_values = values[rim.face, rim.corner]
        mean = rim_values.mean(0)
        rings = mean + (rim_values - mean) * (1 - np.arange(_RINGS)[:, None, None] / _RINGS)
        return np.concatenate((rings.reshape(-1, rim_values.shape[1]), mean[None]))[faces]

    owner = np.concatenate((np.tile(around, 2 * (_RINGS - 1)), around))
    return Mesh(
        vertices=points,
        faces=faces,
        color=spread(mesh.color),
        uv=spread(mesh.uv),
        material=mesh.material[rim.face][owner],
        materials=mesh.materials,
        name=mesh.name,
    )


def _on_half_winding(
    points: np.ndarray, normal: np.ndarray, max_offset: float, winding: WindingNumber
) -> np.ndarray:
    """Moves points (p, 3) along a normal to where the winding number is +-1/2, at most by
    `max_offset`; points without such a position in reach stay.
    """
    start, direction = torch.from_numpy(points), torch.from_numpy(normal)

    def is_inside(t: torch.Tensor) -> torch.Tensor:
        return winding(start + t[:, None] * direction).abs() > 0.5

    low = torch.full_like(start[:, 0], -max_offset)
    high, inside = -low, is_inside(low)
    crosses = inside != is_inside(high)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same = is_inside(middle) == inside
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    moved = torch.where(crosses, 0.5 * (low + high), 0)
    return (start + moved[:, None] * direction).numpy()


def _joined(mesh: Mesh, caps: list[Mesh]) -> Mesh:
    meshes = [mesh, *caps]
    first = np.cumsum([0, *(len(part.vertices) for part in meshes)])
    faces = [part.faces + start for part, start in zip(meshes, first, strict=False)]
    fields: dict[str, Any] = {"faces": np.concatenate(faces)}
    for name in ("vertices", "color", "uv", "material"):
        if getattr(mesh, name) is not None:
            fields[name] = np.concatenate([getattr(part, name) for part in meshes])
    return replace(mesh, **fields)
