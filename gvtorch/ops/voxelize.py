"""`voxelize`: what cubes of voxels hold of a mesh."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..base import check
from .reference import voxelize as twin
from .registry import Backend, choose_backend

MOST_VOXELS = 32  # along a side of a cube
ARITY = 8  # boxes in a box


class Voxelized(NamedTuple):
    """What k cubes of side^3 voxels hold of a mesh; in float32, or float64 where `wide`."""

    distance: Tensor  # (k, z, y, x) to the nearest place of the mesh, voxels; inf beyond the reach
    nearest: Tensor  # (k, z, y, x) int32 triangle of it, the first of equally near; -1 beyond
    winding: Tensor  # (k, z, y, x) int32 winding number of the voxel's centre, not 0 inside solids
    coverage: Tensor  # (k, z, y, x) filled share, 0 to 1; of no cubes unless wanted
    weight: Tensor  # (k, z, y, x, 3) of the triangle's corners there; of no cubes unless wanted


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
    around it, and what share of the voxel is filled. Nothing waits for the host, and no shape
    depends on values.

    Of a solid, the share is the volume of its triangles in the voxel: exact, to rounding, at edges
    and corners and of any number of triangles; where solids overlap, their shares add up to 1 at
    most. A sheet is taken as a plane through each voxel, whose share is exact where it is one. On
    the CPU, C++ and the twin agree in every bit of float32. In float32 a triangle that comes near a
    cube should reach no farther than some thousand voxels away from it.

    Args:
        corner_f33: (f, 3, 3) float64 corners of at least one triangle, x y z, world units.
        solid_f: (f,) bool, whether the triangle bounds a solid; else it is a sheet. Those of
            solids close each other's edges: then winding numbers are whole.
        box_n6: (n, 6) float64 low and high corners of boxes: one around each triangle, then one
            around each 8 of those (the last may hold fewer), and so on until at most 8 are left.
        low_k3: (k, 3) float64 low corners of the first voxels of the cubes, world units.
        size_k3: (k, 3) float64 world sizes: the side of a voxel, the distance from one to the next
            along each axis, and how far away triangles are looked for (below 0: none are). Where
            the side is not above 0, the cube is left out: nothing is in it.
        side: Voxels along a side of a cube, at most 32.
        thickness: Of sheets, world units.
        detail: World size of a usual triangle: tells how to search, and changes no result.
        shares: Whether shares are wanted.
        weights: Whether weights are wanted.
        wide: Whether it is worked out in float64.
        backend: auto, reference, cpp or cuda.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.
    """
    where, world = "voxelize", torch.float64
    device = check.instance(where, "corner_f33", corner_f33, Tensor).device
    check.no_gradient(where, "corner_f33", corner_f33)
    if not corner_f33.numel():
        raise ValueError(f"{where}: corner_f33 must hold at least one triangle")
    check.tensors(
        where,
        device,
        (
            ("corner_f33", corner_f33, "f33", world),
            ("solid_f", solid_f, "f", torch.bool),
            ("low_k3", low_k3, "k3", world),
            ("size_k3", size_k3, "k3", world),
            ("box_n6", box_n6, "n6", world),
        ),
        {"n": boxes_of(len(corner_f33))},
    )
    check.whole(where, "side", side, low=1, high=MOST_VOXELS)
    thickness = check.number(where, "thickness", thickness, low=0)
    detail = check.number(where, "detail", detail, low=0)
    plain = choose_backend(backend, device) == "reference"
    op = twin.voxelize if plain else torch.ops.gvtorch.voxelize
    mesh, cubes = (corner_f33, solid_f, box_n6), (low_k3, size_k3, side)
    return Voxelized(*op(*mesh, *cubes, thickness, detail, shares, weights, wide))


def boxes_of(triangles: int) -> int:
    """Returns how many boxes there are in the hierarchy of so many triangles."""
    floor = total = triangles
    while floor > ARITY:
        floor = -(-floor // ARITY)
        total += floor
    return total
