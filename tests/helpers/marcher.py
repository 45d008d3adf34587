"""A dense marcher that shares only the camera's convention with gvtorch: NumPy, float64, no tree,
no skipping.

Samples lie in the middle of intervals of one length, counted from where the ray enters the
volume's box; the last interval is cut at the far side.
"""

from __future__ import annotations

import numpy as np


def orbit_rays(box, azimuth, elevation, distance, fov, width, height):
    """Ray origins and unit directions (h * w, 3) of an orbit camera."""
    centre, side = (box[0] + box[1]) / 2, (box[1] - box[0]).max()
    az, el = np.radians(azimuth), np.radians(elevation)
    outward = np.array([np.sin(az) * np.cos(el), np.sin(el), np.cos(az) * np.cos(el)])
    eye = centre + distance * side * outward
    right = np.cross([0, 1, 0], outward)
    right /= np.linalg.norm(right)
    up = np.cross(outward, right)
    half_extent = np.tan(np.radians(fov) / 2)
    v, u = np.mgrid[0:height, 0:width]
    u = (2 * (u + 0.5) / width - 1) * half_extent * width / height
    v = (1 - 2 * (v + 0.5) / height) * half_extent
    direction = -outward + u[..., None] * right + v[..., None] * up
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    direction = direction.reshape(-1, 3)
    return np.broadcast_to(eye, direction.shape), direction


def box_of(shape_zyx, spacing, origin):
    n = np.array(shape_zyx[::-1], dtype=np.float64)
    low = np.array(origin) - 0.5 * np.array(spacing)
    return np.array([low, low + n * np.array(spacing)])


def trilinear(data, index_xyz):
    """Returns values at fractional voxel indices, clamped to the outermost centres."""
    n = np.array(data.shape[::-1])
    p = np.clip(index_xyz, 0, n - 1)
    i = np.minimum(p.astype(int), np.maximum(n - 2, 0))
    f = p - i
    j = np.minimum(i + 1, n - 1)
    value = 0.0
    for corner in range(8):
        offsets = [(corner >> axis) & 1 for axis in range(3)]
        x, y, z = ((j if b else i)[:, axis] for axis, b in enumerate(offsets))
        w = np.prod([f[:, a] if b else 1 - f[:, a] for a, b in enumerate(offsets)], axis=0)
        value = value + w * data[z, y, x]
    return value


def march(
    data, spacing, origin, rays, transfer, reference, step, stop_alpha=1.0, first=0.0, last=np.inf
):
    """Returns color (r, 3), alpha (r,), depth (r,) of a dense (z, y, x) array, from distance
    first to last, numbers or (r,).
    """
    eye, direction = rays
    spacing, origin = np.array(spacing), np.array(origin)
    box = box_of(data.shape, spacing, origin)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (box[0] - eye) / direction, (box[1] - eye) / direction
    near = np.maximum(np.nanmax(np.minimum(a, b), axis=1), first)
    far = np.minimum(np.nanmin(np.maximum(a, b), axis=1), last)
    color, transmittance = np.zeros_like(direction), np.ones(len(direction))
    depth = np.full(len(direction), np.inf)
    for k in range(int(np.ceil(np.clip(far - near, 0, None).max() / step)) + 1):
        start = near + k * step
        active = np.nonzero((start < far) & (transmittance > 1 - stop_alpha))[0]
        if len(active) == 0:
            break
        end = np.minimum(start[active] + step, far[active])
        middle = (start[active] + end) / 2
        positions = eye[active] + middle[:, None] * direction[active]
        rgba = transfer(trilinear(data, (positions - origin) / spacing))
        alpha = 1 - (1 - rgba[:, 3]) ** ((end - start[active]) / reference)
        color[active] += (transmittance[active] * alpha)[:, None] * rgba[:, :3]
        transmittance[active] *= 1 - alpha
        first = active[(transmittance[active] < 0.9) & np.isinf(depth[active])]
        depth[first] = near[first] + (k + 0.5) * step
    return color, 1 - transmittance, depth
