"""The twin of `voxelize`: what cubes of voxels hold of the triangles near them, in plain torch, one
cube after the other. It defines what the compiled op gives, in every bit of float32.

Sources: Ericson, "Real-Time Collision Detection", 2005, section 5.1.5 (closest point on a
    triangle); Jacobson, Kavan, Sorkine-Hornung, "Robust inside-outside segmentation using
    generalized winding numbers", SIGGRAPH 2013 (the number counted here along axes); Scardovelli,
    Zaleski, "Analytical relations connecting linear interfaces and volume fractions in rectangular
    grids", J. Comput. Phys. 164, 2000, section 2.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .exact import sqrt_exact

FLAT = 1e-3  # least share of the normal's sum along an axis, see `box_share`
TOUCH = 1e-6  # squared distance in voxels below which the triangle's own normal is taken


def voxelize(
    corner_m33: Tensor,
    solid_m: Tensor,
    first_k: Tensor,
    start_k3: Tensor,
    winding_k: Tensor,
    voxel_3: Tensor,
    side: int,
    thickness: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `ops.voxelize`."""
    items, cube = len(first_k) - 1, (side,) * 3
    distance = corner_m33.new_empty((items, *cube))
    nearest = torch.empty((items, *cube), dtype=torch.int32, device=corner_m33.device)
    winding, coverage = torch.empty_like(nearest), torch.empty_like(distance)
    at = torch.arange(side, device=corner_m33.device).to(corner_m33.dtype) + 0.5
    z, y, x = torch.meshgrid(at * voxel_3[2], at * voxel_3[1], at * voxel_3[0], indexing="ij")
    place_p3 = torch.stack((x, y, z), -1).view(-1, 3)
    for item, (begin, end) in enumerate(first_k.unfold(0, 2, 1).tolist()):
        corner, solid = corner_m33[begin:end], solid_m[begin:end]
        gap, row, away = _nearest(place_p3, corner)
        count = winding_k[item] + _crossed(start_k3[item], place_p3, corner, solid)
        share = _coverage(gap, away, count, row, solid, voxel_3, thickness)
        nearest[item] = torch.where(row >= 0, row + begin, -1).to(torch.int32).view(cube)
        distance[item], coverage[item] = gap.view(cube), share.view(cube)
        winding[item] = count.to(torch.int32).view(cube)
    return distance, nearest, winding, coverage


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    turns = ((1, 2), (2, 0), (0, 1))
    return torch.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in turns], -1)


def _nearest(place_p3: Tensor, corner_n33: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns for each place the distance to the nearest of n triangles, which it is (-1: there is
    none), and a vector (p, 3) along which it lies, of any length and sign.
    """
    if not len(corner_n33):
        far = torch.full_like(place_p3[:, 0], torch.inf)
        return far, torch.full_like(far, -1, dtype=torch.int64), torch.zeros_like(place_p3)
    a, b, c = corner_n33.unbind(1)
    normal = _cross(b - a, c - a)
    length2 = _dot(normal, normal)
    inside = (length2 > 0).expand(len(place_p3), -1)
    best = torch.full(inside.shape, torch.inf, dtype=a.dtype, device=a.device)
    toward = torch.zeros_like(normal).expand(*inside.shape, 3)
    for corner, edge in ((a, b - a), (b, c - b), (c, a - c)):
        beside = _cross(edge, normal)  # out of the triangle
        from_corner = place_p3[:, None] - corner
        inside = inside & (_dot(beside, from_corner) <= 0)
        edge2 = _dot(edge, edge)
        inverse = 1 / torch.where(edge2 > 0, edge2, 1)
        along = (_dot(from_corner, edge) * inverse).clamp(0, 1)
        from_edge = from_corner - edge * along[..., None]
        gap2 = _dot(from_edge, from_edge)
        toward = torch.where((gap2 < best)[..., None], from_edge, toward)
        best = torch.minimum(gap2, best)
    height = _dot(normal, place_p3[:, None] - a)
    over = height * height / torch.where(length2 > 0, length2, 1)
    best = torch.where(inside, over, best)
    gap2 = best.amin(1)
    rows = torch.arange(len(a), device=a.device)
    row = torch.where(best == gap2[:, None], rows, len(a)).amin(1)
    each = torch.arange(len(place_p3), device=a.device)
    flat = inside[each, row] | (gap2 < TOUCH)
    away = torch.where(flat[:, None], normal[row], toward[each, row])
    return sqrt_exact(gap2), row, away


def _crossed(start_3: Tensor, place_p3: Tensor, corner_n33: Tensor, solid_n: Tensor) -> Tensor:
    """Returns (p,) int64 by how much the winding number at each place is larger than at the start:
    triangles are counted along z, then y, then x, the way on which they are crossed outwards as 1.
    """
    total = torch.zeros(len(place_p3), dtype=torch.int64, device=place_p3.device)
    here = start_3.expand(len(place_p3), 3).clone()
    for axis in (2, 1, 0):
        before = here[:, axis].clone()
        where, way = pierced(here[:, None], corner_n33, axis)
        here[:, axis] = place_p3[:, axis]
        ahead = (where > here[:, axis, None]).long() - (where > before[:, None]).long()
        total += (way * solid_n * ahead).sum(1)
    return total


def pierced(place: Tensor, corner: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Finds where lines along an axis through places pierce triangles. Two triangles at an edge
    agree on whose side a line passes, and a line through an edge passes as if it were moved aside
    by nearly nothing, the same way for all: so none slips through.

    Args:
        place: (..., 3) places.
        corner: (..., 3, 3) triangles; leading dimensions broadcast.
        axis: 0, 1 or 2.

    Returns:
        (...) coordinate along the axis; (...) int64: 1 where the triangle's normal points along
        the axis, -1 where against it, 0 where the line passes beside.
    """
    first, second = (axis + 1) % 3, (axis + 2) % 3
    p, q = place[..., first], place[..., second]
    sides, positive = [], []
    for one, other in ((1, 2), (2, 0), (0, 1)):
        u, v = corner[..., one, :], corner[..., other, :]
        u0, u1, v0, v1 = u[..., first], u[..., second], v[..., first], v[..., second]
        swap = (u0 > v0) | ((u0 == v0) & (u1 > v1))
        a0, b0 = torch.where(swap, v0, u0), torch.where(swap, u0, v0)
        a1, b1 = torch.where(swap, v1, u1), torch.where(swap, u1, v1)
        area = (b0 - a0) * (q - a1) - (b1 - a1) * (p - a0)
        sides.append(torch.where(swap, -area, area))
        positive.append((area >= 0) != swap)
    total = sides[0] + sides[1] + sides[2]
    same = (positive[0] == positive[1]) & (positive[1] == positive[2]) & (total != 0)
    height = sides[0] * corner[..., 0, axis] + sides[1] * corner[..., 1, axis]
    height = height + sides[2] * corner[..., 2, axis]
    way = torch.where(positive[0], 1, -1) * same
    return height / torch.where(total != 0, total, 1), way


def _coverage(
    gap: Tensor,
    away: Tensor,
    winding: Tensor,
    row: Tensor,
    solid_n: Tensor,
    voxel_3: Tensor,
    thickness: float,
) -> Tensor:
    """Returns (p,) the share of each voxel that is filled, the surface taken as the plane at the
    nearest place: inside of it, or where the nearest triangle bounds no solid, half of a thickness
    to either side.
    """
    inside = winding != 0
    if not len(solid_n):
        return inside.to(gap.dtype)
    below = box_share(away, gap, voxel_3)
    half = 0.5 * thickness
    layer = box_share(away, gap + half, voxel_3) - box_share(away, gap - half, voxel_3)
    one = torch.ones_like(gap)
    outside = torch.where(solid_n[row], one - below, layer)
    return torch.where(inside, torch.where(solid_n[row], below, one), outside)


def box_share(normal_p3: Tensor, offset_p: Tensor, voxel_3: Tensor) -> Tensor:
    """Returns (p,) the share of a box that lies below a plane, in closed form.

    Exact but for planes within `FLAT` of an axis, which are turned by less than that: the formula
    would divide by nothing there. The share is then right to 3e-4.

    Args:
        normal_p3: (p, 3) normals of planes, of any length; that of length 0 gives 1/2.
        offset_p: (p,) how far the plane lies above the box's centre, along the normal.
        voxel_3: (3,) sides of the box.
    """
    length = sqrt_exact(_dot(normal_p3, normal_p3))
    size = torch.stack([normal_p3[..., i].abs() * voxel_3[i] for i in range(3)], -1)
    sum0 = size[..., 0] + size[..., 1] + size[..., 2]
    least = FLAT * sum0
    x, y, z = (torch.maximum(size[..., i], least) for i in range(3))
    low, high = torch.minimum(x, y), torch.maximum(x, y)
    m3 = torch.maximum(high, z)
    rest = torch.minimum(high, z)
    m1, m2 = torch.minimum(low, rest), torch.maximum(low, rest)
    total = m1 + m2 + m3
    total = torch.where(total > 0, total, 1)
    m1, m2, m3 = m1 / total, m2 / total, m3 / total
    full = offset_p * length / total + 0.5
    alpha = torch.minimum(full, 1 - full).clamp(min=0)
    m12 = m1 + m2
    six = 6 * m1 * m2 * m3
    six = torch.where(six > 0, six, 1)
    pair = 2 * m2 * m3
    pair = torch.where(pair > 0, pair, 1)
    corner = alpha * alpha * alpha / six
    wedge = alpha * (alpha - m1) / pair + m1 * m1 / (3 * pair)
    cut = alpha * alpha * (3 * m12 - alpha) + m1 * m1 * (m1 - 3 * alpha)
    cut = (cut + m2 * m2 * (m2 - 3 * alpha)) / six
    six_sided = alpha * alpha * (3 - 2 * alpha) + m1 * m1 * (m1 - 3 * alpha)
    six_sided = six_sided + m2 * m2 * (m2 - 3 * alpha)
    six_sided = (six_sided + m3 * m3 * (m3 - 3 * alpha)) / six
    slab = (2 * alpha - m12) / (2 * torch.where(m3 > 0, m3, 1))
    share = torch.where(alpha < m3, cut, torch.where(m3 < m12, six_sided, slab))
    share = torch.where((alpha >= m12) & (m12 <= m3), slab, share)
    share = torch.where(alpha < m2, wedge, share)
    share = torch.where(alpha < m1, corner, share)
    return torch.where(full > 0.5, 1 - share, share).clamp(0, 1)
