"""Meshes of known area and volume."""

from __future__ import annotations

import itertools
import math

import numpy as np

import gvtorch as gv


def sphere(steps: int = 5, radius: float = 1.0) -> gv.Mesh:
    """Returns an octahedron subdivided `steps` times and projected on a sphere."""
    points = [*np.eye(3), *-np.eye(3)]
    faces = []
    for x, y, z in itertools.product((0, 3), (1, 4), (2, 5)):
        odd = sum(n > 2 for n in (x, y, z)) % 2
        faces.append((x, z, y) if odd else (x, y, z))
    corners = np.array(points)[np.array(faces)]
    for _ in range(steps):
        a, b, c = corners.transpose(1, 0, 2)
        d, e, f = a + b, b + c, c + a
        parts = ((a, d, f), (d, b, e), (f, e, c), (d, e, f))
        corners = np.concatenate([np.stack(part, 1) for part in parts])
        corners = corners / np.linalg.norm(corners, axis=2, keepdims=True)
    return of_corners(radius * corners)


def torus(ring: float = 1.0, tube: float = 0.4, counts: tuple[int, int] = (96, 48)) -> gv.Mesh:
    """Returns a torus around z; its vertices lie on the exact surface."""
    a, b = (np.arange(n) * 2 * math.pi / n for n in counts)
    a, b = np.meshgrid(a, b, indexing="ij")
    rho = ring + tube * np.cos(b)
    points = np.stack((rho * np.cos(a), rho * np.sin(a), tube * np.sin(b)), -1)
    next_a, next_b = np.roll(points, -1, 0), np.roll(points, -1, 1)
    next_both = np.roll(next_a, -1, 1)
    first = np.stack((points, next_a, next_both), 2).reshape(-1, 3, 3)
    return of_corners(
        np.concatenate((first, np.stack((points, next_both, next_b), 2).reshape(-1, 3, 3)))
    )


def box(low=(0.0, 0.0, 0.0), high=(1.0, 0.7, 0.4)) -> gv.Mesh:
    """A box, twelve triangles."""
    corner = np.array(list(itertools.product(*zip(low, high, strict=True))))
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return gv.Mesh(vertices=corner, faces=np.array(faces))


def sheet(count: int = 1, size: float = 1.0) -> gv.Mesh:
    """Returns a square in a slanted plane, which encloses no volume."""
    u = np.array((1.0, 0.4, -0.2)) / np.linalg.norm((1.0, 0.4, -0.2))
    v = np.cross(u, (0.1, 0.3, 1.0))
    v /= np.linalg.norm(v)
    grid = np.linspace(0, size, count + 1)
    points = grid[:, None, None] * u + grid[None, :, None] * v
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    triangles = (np.stack((a, b, c), 2), np.stack((a, c, d), 2))
    return of_corners(np.concatenate([part.reshape(-1, 3, 3) for part in triangles]))


def of_corners(corners: np.ndarray) -> gv.Mesh:
    """Returns a mesh of triangles that share no vertices."""
    return gv.Mesh(
        vertices=corners.reshape(-1, 3), faces=np.arange(len(corners) * 3).reshape(-1, 3)
    )


def joined(*meshes: gv.Mesh) -> gv.Mesh:
    """Joins several meshes into one."""
    return of_corners(np.concatenate([mesh.corners for mesh in meshes]))


def volume(mesh: gv.Mesh) -> float:
    """Returns the enclosed volume, by the divergence theorem."""
    a, b, c = mesh.corners.transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def area(mesh: gv.Mesh) -> float:
    a, b, c = mesh.corners.transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def components(mesh: gv.Mesh) -> list[gv.Mesh]:
    """Returns the components that are connected by corners at equal positions."""
    _, corner = np.unique(mesh.corners.reshape(-1, 3), axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3)
    label, before = np.arange(corner.max() + 1), None
    while not np.array_equal(label, before):
        before = label.copy()
        np.minimum.at(label, corner, label[corner].min(1, keepdims=True))
    labels = label[corner[:, 0]]
    return [mesh.only(np.flatnonzero(labels == component)) for component in np.unique(labels)]
