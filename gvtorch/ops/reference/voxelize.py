"""The twin of `voxelize` in plain torch: it tests all triangles for each voxel, one cube after the
other. It defines the results of the compiled op, in every bit of float32.

Sources: Ericson, "Real-Time Collision Detection", 2005, section 5.1.5 (closest point on a
    triangle); Jacobson, Kavan, Sorkine-Hornung, "Robust inside-outside segmentation using
    generalized winding numbers", SIGGRAPH 2013 (the number counted here along x); Scardovelli,
    Zaleski, "Analytical relations connecting linear interfaces and volume fractions in rectangular
    grids", J. Comput. Phys. 164, 2000, section 2; Sutherland, Hodgman, "Reentrant polygon
    clipping", CACM 17, 1974 (triangles in a voxel).
"""

from __future__ import annotations

import torch
from torch import Tensor

from .exact import sqrt_exact

FLAT = 1e-3  # least share of the normal's sum along an axis, see `box_share`
TOUCH = 1e-6  # squared distance in voxels below which the triangle's normal is used
HALF_DIAGONAL = 0.8661  # voxels, more than from a voxel's centre to its corner
CORNERS = 16  # a clipped triangle has at most 9, more only where rounding dents it
PARTS_PER_VOXEL = 2.0**30  # volumes are added as integers, in these parts, so in any order
_PAIRS_AT_ONCE = 1 << 20  # pairs of point and triangle that are tested together


def voxelize(
    corner_f33: Tensor,
    solid_f: Tensor,
    box_n6: Tensor,
    low_k3: Tensor,
    size_k3: Tensor,
    side: int,
    thickness: float,
    detail: float,
    shares: bool,
    weights: bool,
    wide: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """See `ops.voxelize`. Boxes and detail only save work, so they are ignored here."""
    real = torch.float64 if wide else torch.float32
    cubes, shape = len(low_k3), (side,) * 3
    distance = torch.full((cubes, *shape), torch.inf, dtype=real, device=low_k3.device)
    nearest = torch.full((cubes, *shape), -1, dtype=torch.int32, device=low_k3.device)
    winding = torch.zeros_like(nearest)
    coverage = distance.new_zeros((cubes if shares else 0, *shape))
    weight = distance.new_zeros((cubes if weights else 0, *shape, 3))
    voxel_index = torch.arange(side, device=low_k3.device).to(real)
    for cube in range(cubes):
        voxel, step, reach = size_k3[cube]
        if not voxel > 0:
            continue
        inverse = 1 / voxel
        corner = ((corner_f33 - low_k3[cube]) * inverse).to(real)
        centers = voxel_index * (step * inverse).to(real) + 0.5
        z, y, x = torch.meshgrid(centers, centers, centers, indexing="ij")
        positions = torch.stack((x, y, z), -1).view(-1, 3)
        half_thickness = (0.5 * thickness * inverse).to(real)
        flat_outputs = [output[cube].view(-1) for output in (distance, nearest, winding)]
        for begin in range(0, len(positions), max(1, _PAIRS_AT_ONCE // len(corner))):
            chunk = slice(begin, begin + max(1, _PAIRS_AT_ONCE // len(corner)))
            gap, row, away = _nearest(positions[chunk], corner, (reach * inverse).to(real))
            count = _winding(positions[chunk], corner, solid_f)
            for output, values in zip(flat_outputs, (gap, row, count), strict=True):
                output[chunk] = values.to(output.dtype)
            if shares:
                share = _coverage(gap, away, count, row, solid_f, half_thickness)
                cut = (row >= 0) & solid_f[row.clamp(min=0)] & (gap <= HALF_DIAGONAL)
                filled = _filled(positions[chunk][cut], corner[solid_f])
                coverage[cube].view(-1)[chunk] = share.masked_scatter(cut, filled)
            if weights:
                corner_weights = _weights(positions[chunk], corner[row.clamp(min=0)])
                weight[cube].view(-1, 3)[chunk] = torch.where(row[:, None] >= 0, corner_weights, 0)
    return distance, nearest, winding, coverage, weight


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    turns = ((1, 2), (2, 0), (0, 1))
    return torch.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in turns], -1)


def _relative_to_edge(
    from_corner: Tensor, edge: Tensor, normal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns, for points relative to the first corner of an edge: their scaled distance outside
    it in the triangle's plane (below 0: inside), the position of the nearest point on the edge, 0
    to 1, and the vectors from there.
    """
    area = _dot(_cross(edge, normal), from_corner)
    edge2 = _dot(edge, edge)
    inverse = 1 / torch.where(edge2 > 0, edge2, 1)
    along = (_dot(from_corner, edge) * inverse).clamp(0, 1)
    return area, along, from_corner - edge * along[..., None]


def _nearest(
    position_p3: Tensor, corner_f33: Tensor, reach: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns for each point the distance to the nearest of f triangles, its index (-1: none is
    within reach), and a vector (p, 3) along the line to it, of any length and sign.
    """
    a, b, c = corner_f33.unbind(1)
    normal = _cross(b - a, c - a)
    length2 = _dot(normal, normal)
    inside = (length2 > 0).expand(len(position_p3), -1)
    best = torch.full(inside.shape, torch.inf, dtype=a.dtype, device=a.device)
    toward = torch.zeros_like(normal).expand(*inside.shape, 3)
    for corner, edge in ((a, b - a), (b, c - b), (c, a - c)):
        area, _, from_edge = _relative_to_edge(position_p3[:, None] - corner, edge, normal)
        inside = inside & (area <= 0)
        gap2 = _dot(from_edge, from_edge)
        toward = torch.where((gap2 < best)[..., None], from_edge, toward)
        best = torch.minimum(gap2, best)
    height = _dot(normal, position_p3[:, None] - a)
    plane_gap2 = height * height / torch.where(length2 > 0, length2, 1)
    best = torch.where(inside, plane_gap2, best)
    best = torch.where(best < torch.inf, best, torch.inf)  # NaN is nowhere
    gap2 = best.amin(1)
    rows = torch.arange(len(a), device=a.device)
    row = torch.where(best == gap2[:, None], rows, len(a)).amin(1)
    point_index = torch.arange(len(position_p3), device=a.device)
    use_normal = inside[point_index, row] | (gap2 < TOUCH)
    away = torch.where(use_normal[:, None], normal[row], toward[point_index, row])
    in_reach = (gap2 <= reach * reach) & (reach >= 0) & (gap2 < torch.inf)
    return sqrt_exact(torch.where(in_reach, gap2, torch.inf)), torch.where(in_reach, row, -1), away


def _weights(position_p3: Tensor, corner_p33: Tensor) -> Tensor:
    """Returns (p, 3) weights of a triangle's corners at its point nearest to a given point."""
    a, b, c = corner_p33.unbind(1)
    normal = _cross(b - a, c - a)
    length2 = _dot(normal, normal)
    inside = length2 > 0
    area_weights, gaps, edge_positions = [], [], []
    for corner, edge in ((a, b - a), (b, c - b), (c, a - c)):
        area, edge_position, from_edge = _relative_to_edge(position_p3 - corner, edge, normal)
        inside = inside & (area <= 0)
        area_weights.append(-area / torch.where(length2 > 0, length2, 1))
        edge_positions.append(edge_position)
        gaps.append(_dot(from_edge, from_edge))
    # a corner's weight: the area at the edge opposite to it
    inside_weights = torch.stack((area_weights[1], area_weights[2], area_weights[0]), 1)
    first = (gaps[0] <= gaps[1]) & (gaps[0] <= gaps[2])
    second = ~first & (gaps[1] <= gaps[2])
    third, zero = ~first & ~second, torch.zeros_like(gaps[0])
    edge_weights = zero[:, None].expand(-1, 3)
    for index, is_nearest in enumerate((first, second, third)):
        corner_weights, t = [zero, zero, zero], edge_positions[index]
        corner_weights[index], corner_weights[(index + 1) % 3] = 1 - t, t
        weights = torch.stack(corner_weights, 1)
        edge_weights = torch.where(is_nearest[:, None], weights, edge_weights)
    return torch.where(inside[:, None], inside_weights, edge_weights)


def _winding(position_p3: Tensor, corner_f33: Tensor, solid_f: Tensor) -> Tensor:
    """Returns (p,) int64 winding numbers: each triangle of a solid that a ray along +x hits adds 1
    if its normal points along x, else -1.
    """
    x, sign = pierced(position_p3[:, None], corner_f33)
    return (sign * solid_f * (x > position_p3[:, :1]).long()).sum(1)


def pierced(position: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Finds where lines along x through points pierce triangles. Two triangles agree on which side
    of a shared edge a line passes, and a line through an edge counts as moved aside by nearly
    nothing, in the same direction for all triangles, so no line slips through.

    Args:
        position: (..., 3) points.
        corner: (..., 3, 3) triangles; leading dimensions broadcast.

    Returns:
        (...) x; (...) int64: 1 where the triangle's normal points along x, -1 where against it, 0
        where the line misses the triangle.
    """
    y, z = position[..., 1], position[..., 2]
    sides, positive = [], []
    for first, second in ((1, 2), (2, 0), (0, 1)):
        u, v = corner[..., first, :], corner[..., second, :]
        u0, u1, v0, v1 = u[..., 1], u[..., 2], v[..., 1], v[..., 2]
        swap = (u0 > v0) | ((u0 == v0) & (u1 > v1))
        a0, b0 = torch.where(swap, v0, u0), torch.where(swap, u0, v0)
        a1, b1 = torch.where(swap, v1, u1), torch.where(swap, u1, v1)
        area = (b0 - a0) * (z - a1) - (b1 - a1) * (y - a0)
        sides.append(torch.where(swap, -area, area))
        positive.append((area >= 0) != swap)
    total = sides[0] + sides[1] + sides[2]
    same = (positive[0] == positive[1]) & (positive[1] == positive[2]) & (total != 0)
    x_sum = sides[0] * corner[..., 0, 0] + sides[1] * corner[..., 1, 0]
    x_sum = x_sum + sides[2] * corner[..., 2, 0]
    sign = torch.where(positive[0], 1, -1) * same
    return x_sum / torch.where(total != 0, total, 1), sign


def _coverage(
    gap: Tensor, away: Tensor, winding: Tensor, row: Tensor, solid_f: Tensor, half_thickness: Tensor
) -> Tensor:
    """Returns (p,) the filled share of voxels that no solid's surface cuts: 1 inside, 0 outside;
    where a sheet's triangle is nearest, the part up to half its thickness from the plane at its
    nearest point.
    """
    inside = (winding != 0).to(gap.dtype)
    sheet = (row >= 0) & ~solid_f[row.clamp(min=0)]
    gap = torch.where(sheet, gap, 0)
    layer = box_share(away, gap + half_thickness) - box_share(away, gap - half_thickness)
    return torch.where(sheet & (winding == 0), layer, inside)


def _filled(position_p3: Tensor, corner_f33: Tensor) -> Tensor:
    """Returns (p,) the winding number's mean over voxels around points, 0 to 1 (the filled share,
    unless solids overlap or are inside out next to others). Each triangle adds the volume before it
    along x, with the sign of its normal's x.
    """
    low_p3 = position_p3 - 0.5
    least, most = corner_f33.amin(1), corner_f33.amax(1)
    overlaps = most[:, 0] > low_p3[:, None, 0]
    for axis in (1, 2):
        low = low_p3[:, None, axis]
        overlaps = overlaps & (most[:, axis] > low) & (least[:, axis] < low + 1)
    point, face = overlaps.nonzero().unbind(1)
    polygon = corner_f33.new_zeros(len(point), CORNERS, 3)
    polygon[:, :3] = corner_f33[face]
    count = torch.full_like(point, 3)
    low = low_p3[point]
    for axis in (1, 2):
        polygon[..., axis] -= low[:, None, axis]
        polygon, count = _clip(polygon, count, axis, 0, upper=True)
        polygon, count = _clip(polygon, count, axis, 1, upper=False)
    polygon[..., 0] -= low[:, None, 0]
    ahead, clipped_count = _clip(polygon, count, 0, 1, upper=True)
    ahead[..., 0] = 1
    volume = _volume_before(ahead, clipped_count)
    within, clipped_count = _clip(*_clip(polygon, count, 0, 0, upper=True), 0, 1, upper=False)
    volume = volume + _volume_before(within, clipped_count)
    parts = (volume.clamp(-1, 1) * PARTS_PER_VOXEL).to(torch.int64)
    total = torch.zeros(len(position_p3), dtype=torch.int64, device=point.device)
    total = total.index_add(0, point, parts).abs().to(position_p3.dtype)
    return (total * (1 / PARTS_PER_VOXEL)).clamp(max=1)


def _clip(
    corners: Tensor, count: Tensor, axis: int, limit: float, *, upper: bool
) -> tuple[Tensor, Tensor]:
    """Clips polygons, (q, CORNERS, 3) corners in order and (q,) their numbers, at the plane where
    `axis` is `limit`, and returns the part above it (`upper`) or below. Points in the plane are
    above, and an edge is cut at the same point in both directions.
    """
    number = torch.arange(CORNERS, device=corners.device)
    next_index = torch.where(number + 1 < count[:, None], number + 1, 0)
    following = corners.gather(1, next_index[..., None].expand_as(corners))
    value, next_value = corners[..., axis], following[..., axis]
    inside, next_inside = value >= limit, next_value >= limit
    if not upper:
        inside, next_inside = value < limit, next_value < limit
    exists = number < count[:, None]
    cut = exists & (inside != next_inside)
    swap = (value > next_value)[..., None]
    first, second = torch.where(swap, following, corners), torch.where(swap, corners, following)
    rise = second[..., axis] - first[..., axis]
    fraction = (limit - first[..., axis]) / torch.where(cut, rise, 1)
    crossing = first + fraction[..., None] * (second - first)
    crossing[..., axis] = limit
    kept = torch.stack((inside & exists, cut), 2).flatten(1)
    slot = kept.cumsum(1) - 1
    slot = torch.where(kept & (slot < CORNERS), slot, CORNERS)  # the extra slot is discarded
    candidates = torch.stack((corners, crossing), 2).flatten(1, 2)
    clipped = corners.new_zeros(len(corners), CORNERS + 1, 3)
    clipped = clipped.scatter(1, slot[..., None].expand_as(candidates), candidates)[:, :CORNERS]
    return clipped, kept.sum(1).clamp(max=CORNERS)


def _volume_before(corners: Tensor, count: Tensor) -> Tensor:
    """Returns (q,) volumes between polygons and x = 0, below 0 where normals point against x."""
    a, total = corners[:, 0], corners.new_zeros(len(corners))
    for i in range(1, CORNERS - 1):
        b, c = corners[:, i], corners[:, i + 1]
        area = (b[:, 1] - a[:, 1]) * (c[:, 2] - a[:, 2]) - (b[:, 2] - a[:, 2]) * (c[:, 1] - a[:, 1])
        term = area * (a[:, 0] + b[:, 0] + c[:, 0])
        total = torch.where(i + 1 < count, total + term, total)
    return total * (1 / 6)


def box_share(normal_p3: Tensor, offset_p: Tensor) -> Tensor:
    """Returns (p,) the share of a voxel, a cube of side 1, that lies below a plane, in closed form.

    Exact except for normals within `FLAT` of being perpendicular to an axis, which are turned by
    less than that, since the formula would divide by 0. The share is then right to 3e-4.

    Args:
        normal_p3: (p, 3) normals of planes, of any length; length 0 gives 1/2.
        offset_p: (p,) distance of the plane above the voxel's centre, along the normal.
    """
    length = sqrt_exact(_dot(normal_p3, normal_p3))
    size = normal_p3.abs()
    sum0 = size[..., 0] + size[..., 1] + size[..., 2]
    minimum = FLAT * sum0
    x, y, z = (torch.maximum(size[..., i], minimum) for i in range(3))
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
