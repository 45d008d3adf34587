"""`voxelize`: what cubes of voxels hold of the triangles near them."""

from __future__ import annotations

import torch
from torch import Tensor

from ..base import check
from .reference import voxelize as twin
from .registry import Backend, choose_backend

MOST_VOXELS = 16  # along a side of a cube


def voxelize(
    corner_m33: Tensor,  # (m, 3, 3)
    solid_m: Tensor,  # (m,)
    first_k: Tensor,  # (k + 1,)
    start_k3: Tensor,  # (k, 3)
    winding_k: Tensor,  # (k,)
    voxel_3: Tensor,  # (3,)
    side: int,
    thickness: float,
    *,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Finds for each voxel of k cubes the nearest of the cube's own triangles, and what share of
    the voxel is filled.

    Lengths are in voxels (of any unit near the size of one): triangles far smaller or larger than
    1e9 of them underflow or overflow. The surface is taken as a plane through each voxel, so shares
    are exact where it is one. On the CPU, C++ and the twin agree in every bit of float32.

    Args:
        corner_m33: (m, 3, 3) float32 or float64 corners of triangles, x y z, from the low corner of
            the cube whose they are; those of a cube one after another.
        solid_m: (m,) bool, whether the triangle bounds a solid; else it is a sheet.
        first_k: (k + 1,) int64: cube i has triangles first_k[i] to first_k[i + 1] - 1.
        start_k3: (k, 3) a place in each cube, away from the surface.
        winding_k: (k,) int32 winding number there, of all triangles that bound solids. A cube's own
            triangles must be all that the cube contains parts of.
        voxel_3: (3,) sides of a voxel along x, y, z; voxel x has its centre at (x + 1/2) of them.
        side: Voxels along a side of a cube, at most 16.
        thickness: Of sheets.
        backend: auto, reference, cpp or cuda.

    Returns:
        distance_kzyx (k, side, side, side) to the nearest place, infinite without triangles;
        nearest_kzyx int32 the triangle's row, the first of those that are equally near, -1 for
        none; winding_kzyx int32 winding number of the voxel's centre, not 0 inside of solids;
        coverage_kzyx the filled share, 0 to 1.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    where, device, real = "voxelize", corner_m33.device, corner_m33.dtype
    if real not in (torch.float32, torch.float64):
        raise ValueError(
            f"{where}: corner_m33 must be float32 or float64, got {check.describe(corner_m33)}"
        )
    check.tensors(
        where,
        device,
        (
            ("corner_m33", corner_m33, "m33", real),
            ("solid_m", solid_m, "m", torch.bool),
            ("winding_k", winding_k, "k", torch.int32),
            ("start_k3", start_k3, "k3", real),
            ("voxel_3", voxel_3, "3", real),
            ("first_k", first_k, "f", torch.int64),
        ),
    )
    if len(first_k) != len(winding_k) + 1:
        raise ValueError(
            f"{where}: first_k must be ({len(winding_k) + 1},) int64, got {check.describe(first_k)}"
        )
    check.whole(where, "side", side, low=1, high=MOST_VOXELS)
    thickness = check.number(where, "thickness", thickness, low=0)
    arguments = (corner_m33, solid_m, first_k, start_k3, winding_k, voxel_3, side, thickness)
    if choose_backend(backend, device) == "reference":
        return twin.voxelize(*arguments)
    return torch.ops.gvtorch.voxelize(*arguments)
