"""`voxelize`: samples a mesh into cubes of voxels."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..base import check
from .reference import voxelize as twin
from .registry import Backend, choose_backend, fake_of

MAX_CUBE_SIDE = 32  # along a side of a cube
ARITY = 8  # boxes in a box


class Voxelized(NamedTuple):
    """A mesh in k cubes of side^3 voxels; floats are float32, or float64 where `wide`."""

    distance: Tensor  # (k, z, y, x) to the nearest point of the mesh, voxels; inf beyond the reach
    nearest: Tensor  # (k, z, y, x) int32 its triangle, the first of equally near; -1 beyond
    winding: Tensor  # (k, z, y, x) int32 winding number of the voxel's centre, not 0 inside solids
    coverage: Tensor  # (k, z, y, x) filled share, 0 to 1; k is 0 unless `shares`
    weight: Tensor  # (k, z, y, x, 3) of the triangle's corners there; k is 0 unless `weights`


def voxelize(
    corner_f33: Tensor,  # (f, 3, 3)
    solid_f: Tensor,  # (f,)
    box_n6: Tensor,  # (n, 6)
    low_k3: Tensor,  # (k, 3)
    size_k3: Tensor,  # (k, 3)
    side: int,
    thickness: float,
    *,
    detail: float = 0.0,
    shares: bool = True,
    weights: bool = False,
    wide: bool = False,
    backend: Backend = "auto",
) -> Voxelized:
    """Finds for each voxel of k cubes the nearest triangle of a mesh, how often the mesh winds
    around it, and what share of the voxel is filled. It does not block, and no shape depends on
    values.

    The share of a solid is the volume that its triangles enclose in the voxel: exact, to rounding,
    at edges and corners too and for any number of triangles; where solids overlap, their shares add
    up to 1 at most. A sheet is approximated by one plane in each voxel, and exact where it is flat.
    On the CPU, C++ and the twin agree in every bit of float32. In float32 a triangle that comes
    near a cube should reach no farther than some thousand voxels away from it.

    Args:
        corner_f33: (f, 3, 3) float64 corners of at least one triangle, x y z, world units.
        solid_f: (f,) bool, whether the triangle bounds a solid; else it is part of a sheet. The
            triangles of solids should form closed surfaces, so that winding numbers are exact.
        box_n6: (n, 6) float64 low and high corners of boxes: one around each triangle, then one
            around each 8 of those (the last may hold fewer), and so on until at most 8 are left.
        low_k3: (k, 3) float64 low corners of the first voxels of the cubes, world units.
        size_k3: (k, 3) float64 world sizes: the side of a voxel, the distance from one voxel to the
            next along each axis, and the reach, within which triangles are looked for (below 0:
            none are). A cube whose voxel side is not above 0 stays empty.
        side: Voxels along a side of a cube, at most 32.
        thickness: Thickness of sheets, world units.
        detail: Typical world size of a triangle: a hint for the search that changes no result.
        shares: Whether to compute `coverage`.
        weights: Whether to compute `weight`.
        wide: Whether to compute in float64.
        backend: auto, reference, cpp or cuda.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    context, dtype = "voxelize", torch.float64
    device = check.instance(context, "corner_f33", corner_f33, Tensor).device
    check.no_gradient(context, "corner_f33", corner_f33)
    if not corner_f33.numel():
        raise ValueError(f"{context}: corner_f33 must hold at least one triangle")
    fields = (
        ("corner_f33", corner_f33, "f33", dtype),
        ("solid_f", solid_f, "f", torch.bool),
        ("low_k3", low_k3, "k3", dtype),
        ("size_k3", size_k3, "k3", dtype),
        ("box_n6", box_n6, "n6", dtype),
    )
    check.tensors(context, device, fields, {"n": boxes_of(len(corner_f33))})
    side = check.integer(context, "side", side, low=1, high=MAX_CUBE_SIDE)
    thickness = check.number(context, "thickness", thickness, low=0)
    detail = check.number(context, "detail", detail, low=0)
    use_twin = choose_backend(backend, device) == "reference"
    op = twin.voxelize if use_twin else torch.ops.gvtorch.voxelize
    mesh, cubes = (corner_f33, solid_f, box_n6), (low_k3, size_k3, side)
    return Voxelized(*op(*mesh, *cubes, thickness, detail, shares, weights, wide))


def boxes_of(triangles: int) -> int:
    """Returns the number of boxes in the hierarchy over `triangles` triangles."""
    floor_boxes = total = triangles
    while floor_boxes > ARITY:
        floor_boxes = -(-floor_boxes // ARITY)
        total += floor_boxes
    return total


@fake_of("voxelize")
def _fake_cubes(
    *, low_k3: Tensor, side: int, shares: bool, weights: bool, wide: bool, **_: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    cubes, shape = low_k3.shape[0], (side, side, side)
    float_volume = low_k3.new_empty((cubes, *shape), dtype=torch.float64 if wide else torch.float32)
    int_volume = torch.empty_like(float_volume, dtype=torch.int32)
    share = float_volume.new_empty((cubes if shares else 0, *shape))
    weight = float_volume.new_empty((cubes if weights else 0, *shape, 3))
    return float_volume, int_volume, torch.empty_like(int_volume), share, weight
