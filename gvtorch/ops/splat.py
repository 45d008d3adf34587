"""`splat`: what cubes of voxels hold of points."""

from __future__ import annotations

import torch
from torch import Tensor

from ..base import check
from .reference import splat as twin
from .registry import Backend, choose_backend

MOST_VOXELS = (1 << 20) - 1  # along a side of a cube


def splat(
    edge_k3e: Tensor,  # (k, 3, e)
    low_k3: Tensor,  # (k, 3)
    narrow_b: Tensor,  # (k + 1,)
    narrow_s2: Tensor,  # (s, 2)
    voxel_n3: Tensor,  # (n, 3)
    value_nc: Tensor,  # (n, c)
    wide_b: Tensor,  # (k + 1,)
    wide_t2: Tensor,  # (t, 2)
    center_m3: Tensor,  # (m, 3)
    radius_m: Tensor,  # (m,)
    value_mc: Tensor,  # (m, c)
    *,
    backend: Backend = "auto",
) -> Tensor:
    """Adds up what each voxel of k cubes holds of points, in the order of their lists: first those
    that lie wholly in a voxel (narrow), then those that reach over several (wide), whose densities
    are products of cubic splines and are integrated in closed form.

    Points stand in a table of either kind, and a cube's list of them is runs of its rows, as many
    as wanted. On all backends and devices every bit is the same, if values are finite. Nothing
    waits for the host, but in the twin.

    Args:
        edge_k3e: (k, 3, e) float64 rising edges of e - 1 voxels along x, y and z; world units.
        low_k3: (k, 3) int64 x, y, z of the cubes' first voxels.
        narrow_b: (k + 1,) int64 a cube's runs of narrow points are those from its number up to the
            next. What is said to be where no run or row is, is left out.
        narrow_s2: (s, 2) int64 the rows of a run are those from the first number up to the second.
        voxel_n3: (n, 3) int64 x, y, z of the voxel; points in no voxel of the cube are left out.
        value_nc: (n, c) float64 numbers that are added up.
        wide_b: (k + 1,) int64 as `narrow_b`, of wide points.
        wide_t2: (t, 2) int64 as `narrow_s2`.
        center_m3: (m, 3) float64 x, y, z, world units.
        radius_m: (m,) float64 how far a point reaches along each axis. 0: it is wholly in one
            voxel.
        value_mc: (m, c) float64 numbers that are added up.
        backend: auto, reference, cpp or cuda.

    Returns:
        (k, z, y, x, c) float64.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device.

    Source: see `ops/reference/splat.py`.
    """
    where, device, real = "splat", edge_k3e.device, torch.float64
    whole, begins = torch.int64, {"b": len(edge_k3e) + 1}
    fields = (
        ("edge_k3e", edge_k3e, "k3e", real),
        ("low_k3", low_k3, "k3", whole),
        ("narrow_b", narrow_b, "b", whole),
        ("narrow_s2", narrow_s2, "s2", whole),
        ("voxel_n3", voxel_n3, "n3", whole),
        ("value_nc", value_nc, "nc", real),
        ("wide_b", wide_b, "b", whole),
        ("wide_t2", wide_t2, "t2", whole),
        ("center_m3", center_m3, "m3", real),
        ("radius_m", radius_m, "m", real),
        ("value_mc", value_mc, "mc", real),
    )
    sizes = check.tensors(where, device, fields, begins)
    if not 2 <= sizes["e"] <= MOST_VOXELS + 1 or not sizes["c"]:
        got = f"{sizes['e'] - 1} and {sizes['c']}"
        raise ValueError(f"{where}: 1 to {MOST_VOXELS} voxels and a number are needed, got {got}")
    plain = choose_backend(backend, device) == "reference"
    op = twin.splat if plain else torch.ops.gvtorch.splat
    return op(*(value for _, value, _, _ in fields))
