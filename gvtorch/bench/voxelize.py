"""`voxelize`: triangles to voxels in memory and to a store, compared with other libraries in the
same run.

The mesh is synthetic: a sphere with bumps, of a chosen number of triangles.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ..io.mesh_source import voxelize as voxelize_store
from ..meshes.mesh import Mesh
from ..meshes.voxelizer import Voxelizer
from .record import Record, clock
from .storage import clock_store

_REGION_SIDE = 512  # voxels along a side of the regions that are computed at once


def voxelize(record: Record) -> None:
    """Computes the coverage of 100,000 triangles: all finest voxels in memory, then a store."""
    settings = record.settings
    faces, side = (2_000, 64) if settings.quick else (100_000, 1024)
    mesh = bumpy_sphere(faces)
    count = f"{len(mesh.faces):,} triangles"
    device = settings.device
    case = f"{count}, {side}^3 in memory"
    if record.wants(case):
        settings.tell(case)
        timing = clock(lambda: _volume(Voxelizer(mesh, resolution=side, device=device)), settings)
        a, b, c = mesh.corners.transpose(1, 0, 2)
        volume = float((a * np.cross(b, c)).sum() / 6)
        record.add(
            *(case, "gvtorch", timing),
            voxels_per_second=1e3 * side**3 / timing.median,
            max_difference=abs(timing.last - volume) / volume,
        )
    case = f"{count}, {side}^3 to a store"
    if record.wants(case):
        _measure_store(record, case, mesh, side)
    _measure_peers(record, mesh, 64 if settings.quick else 256)
    record.note("max difference: of the voxels' volume from the mesh's, relative to the mesh's")


def _volume(voxelizer: Voxelizer) -> float:
    """Computes all finest voxels, part by part; returns the volume that they cover."""
    total = torch.zeros((), dtype=torch.int64, device=voxelizer.device)
    x, y, z = voxelizer.extent
    for k in range(0, z, _REGION_SIDE):
        for j in range(0, y, _REGION_SIDE):
            for i in range(0, x, _REGION_SIDE):
                high = min(k + _REGION_SIDE, z), min(j + _REGION_SIDE, y), min(i + _REGION_SIDE, x)
                coverage = voxelizer.region((k, j, i), high)["coverage"]
                total += coverage.sum(dtype=torch.int64)
    return float(total) / 255 * voxelizer.spacing**3


def _measure_store(record: Record, case: str, mesh: Mesh, side: int) -> None:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "mesh.zarr"
        make = functools.partial(voxelize_store, mesh, path, resolution=side)
        clock_store(record, case, path, make, voxels=side**3)


def _measure_peers(record: Record, mesh: Mesh, side: int) -> None:
    """Compares coverage of all voxels (gvtorch) with a filled grid of as many voxels (trimesh) and
    signed distances at every 64th voxel's centre (igl).
    """
    settings = record.settings
    case = f"{len(mesh.faces):,} triangles, {side}^3 beside peers"
    if not record.wants(case):
        return
    voxelizer = Voxelizer(mesh, resolution=side, device=settings.device)
    runs: dict[str, Callable[[], object]] = {
        "gvtorch": lambda: _volume(Voxelizer(mesh, resolution=side, device=settings.device))
    }
    if record.has_peer("trimesh"):
        import trimesh

        other_mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        runs["trimesh"] = lambda: other_mesh.voxelized(voxelizer.spacing).fill()
        record.note("trimesh: voxelized().fill(): whole voxels; it cuts triangles until small")
    if record.has_peer("igl"):
        import igl

        axes = [
            np.arange(n) * voxelizer.spacing + o
            for n, o in zip(voxelizer.extent, voxelizer.origin, strict=True)
        ]
        centers = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)[::64]
        runs["igl"] = lambda: igl.signed_distance(centers, mesh.vertices, mesh.faces)
        record.note("igl: signed_distance at every 64th voxel's centre; times: as if at all")
    for who, run in runs.items():
        settings.tell(f"{case}: {who}")
        timing = clock(run, settings)
        stride = 64 if who == "igl" else 1
        times = {name: stride * v for name, v in record.relative_to_first(case, timing).items()}
        rate = 1e3 * side**3 / stride / timing.median
        record.add(case, who, timing, voxels_per_second=rate, **times)


def bumpy_sphere(faces: int) -> Mesh:
    """Returns a closed sphere with bumps of two sizes, of about `faces` triangles."""
    rows = max(4, round((faces / 4) ** 0.5))
    columns = 2 * rows
    a, b = np.meshgrid(
        np.arange(1, rows) * np.pi / rows, np.arange(columns) * 2 * np.pi / columns, indexing="ij"
    )
    radius = 1 + 0.08 * np.sin(9 * a) * np.sin(8 * b) + 0.02 * np.sin(40 * a) * np.cos(36 * b)
    sphere = np.stack((np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)), -1)
    points = np.concatenate(((radius[..., None] * sphere).reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]))
    index = np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    next_index = np.roll(index, -1, 1)
    p, q, r, s = index[:-1], index[1:], next_index[1:], next_index[:-1]
    top, bottom = np.full(columns, len(points) - 2), np.full(columns, len(points) - 1)
    parts = (
        *(np.stack((p, q, r), -1), np.stack((p, r, s), -1)),
        *(np.stack((top, index[0], next_index[0]), -1),),
        *(np.stack((bottom, next_index[-1], index[-1]), -1),),
    )
    return Mesh(vertices=points, faces=np.concatenate([part.reshape(-1, 3) for part in parts]))
