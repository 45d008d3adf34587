"""Projections: from pixels to rays, on the device, for every camera model.

A lens turns a place of the image plane, x = (u - cx) / fx and y = (v - cy) / fy, into a ray:

- pinhole: the direction is (x, y, 1).
- ortho: the origin moves by (x, y), all directions are (0, 0, 1); fx is in pixels a world unit.
- fisheye: equidistant, the angle to the axis is the distance from the middle; with four
  coefficients it is the angle t whose t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) is that distance.
  Source: Kannala and Brandt, "A generic camera model and calibration method for conventional,
  wide-angle, and fish-eye lenses", PAMI 2006, eq. 6; OpenCV's fisheye model.
- panorama: equirectangular, x is the longitude and y the latitude (down), in radians.

Axes are OpenCV's: x right, y down, z forward.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from ..base.records import Rays

CameraModel = Literal["pinhole", "ortho", "fisheye", "panorama"]
MODELS = ("pinhole", "ortho", "fisheye", "panorama")
_NEWTON = 20  # steps; each halves the bracket where Newton's leaves it


def default_fov(model: CameraModel) -> float:
    """Returns the vertical field of view, degrees, of a camera for which none was told."""
    return 180.0 if model in ("fisheye", "panorama") else 30.0


def pixel_rays(
    numbers: Tensor,
    width: int,
    height: int,
    rows: tuple[int, int],
    model: str = "pinhole",
    distorted: bool = False,
) -> Rays:
    """Returns the rays through the pixel centres of whole rows; nobody waits for the device.

    Args:
        numbers: (n, 25) float64, a row a camera: world-to-camera rotation (9), position (3), focal
            lengths and principal point (2, 2; pixel centres at integers), cone (2), range (2), the
            fisheye's coefficients (4) and largest angle to the axis (1, radians).
        width: Pixels.
        height: Pixels.
        rows: First row and the row after the last, counted through the batch.
        model: One of `MODELS`.
        distorted: Whether a fisheye's coefficients are used.
    """
    first, end = rows
    row = torch.arange(first, end, device=numbers.device)  # (y,)
    if len(numbers) > 1:
        numbers, row = numbers[row // height], row % height  # one for each row
    rotation, position = numbers[:, :9].unflatten(1, (3, 3)), numbers[:, 9:12]  # (k, 3, 3), (k, 3)
    (fx, fy), (cx, cy) = numbers[:, 12:14].unbind(1), numbers[:, 14:16].unbind(1)
    column = torch.arange(width, dtype=torch.float64, device=numbers.device)
    x, y = (column - cx[:, None]) / fx[:, None], (row - cy) / fy  # (k, w), (y,)

    def spread(values: Tensor) -> Tensor:
        """(r, c) of (k, c): one camera's is not copied."""
        if len(values) == 1:
            return values.expand(len(row) * width, -1)
        return values[:, None].expand(-1, width, -1).reshape(len(row) * width, -1)

    origin, cone, limits = (spread(part) for part in (position, *numbers[:, 16:20].split(2, 1)))
    if model == "pinhole":
        length = (x * x + (y * y + 1)[:, None]).sqrt_()  # (y, w)
        across = x[..., None] * rotation[:, None, 0]
        down = y[:, None] * rotation[:, 1] + rotation[:, 2]
        direction = (across + down[:, None]).div_(length[..., None]).reshape(-1, 3)
    elif model == "ortho":
        across, down = x[..., None] * rotation[:, None, 0], y[:, None] * rotation[:, 1] + position
        origin, direction = (across + down[:, None]).reshape(-1, 3), spread(rotation[:, 2])
    else:
        if model == "fisheye":
            local, inside, stretch = _fisheye(x, y, numbers[:, 20:24], numbers[:, 24:], distorted)
            cone = cone * stretch if distorted else cone
        else:
            local, inside = _panorama(x, y)
            # A pixel spans 1 / fy radians down, and along its circle of latitude cos / fx.
            span = torch.maximum(y.cos() / fx, 1 / fy) * torch.minimum(fx, fy)
            cone = cone * span[:, None].expand(-1, width).reshape(-1, 1)
        turned = (local[..., i, None] * rotation[:, None, i] for i in range(3))
        direction = sum(turned, torch.zeros_like(local)).reshape(-1, 3)
        limits = torch.where(inside.reshape(-1, 1), limits, 0.0)  # an empty range closes a ray
    return Rays(origin=origin, direction=direction, cone=cone, range=limits, width=width)


def _panorama(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions (y, w, 3), and (y, w) whether a pixel lies on the sphere."""
    latitude = y[:, None].expand(-1, x.shape[-1])
    longitude = x.expand_as(latitude)
    ring = latitude.cos()
    local = torch.stack((longitude.sin() * ring, latitude.sin(), longitude.cos() * ring), -1)
    rounding = 1 + 1e-12
    inside = (latitude.abs() <= rounding * math.pi / 2) & (longitude.abs() <= rounding * math.pi)
    return local, inside


def _fisheye(
    x: Tensor, y: Tensor, k: Tensor, limit: Tensor, distorted: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Unit directions (y, w, 3), (y, w) whether a pixel lies in the circle, and (r, 1) by how much
    wider its cone is than that of an equidistant lens.
    """
    radius = (x * x + (y * y)[:, None]).sqrt()  # (y, w)
    angle = undistort(radius, k, limit) if distorted else radius
    scale = torch.where(radius > 0, angle.sin() / radius, 1.0)
    plane = scale[..., None] * torch.stack((x.expand_as(radius), y[:, None].expand_as(radius)), -1)
    inside = radius <= (distort(limit, k) if distorted else limit) * (1 + 1e-12)
    # Along the radius a pixel spans 1 / slope, across it sin(angle) / radius.
    stretch = torch.maximum(1 / slope(angle, k), scale) if distorted else torch.ones_like(scale)
    return torch.cat((plane, angle.cos()[..., None]), -1), inside, stretch.reshape(-1, 1)


def distort(angle: Tensor, k: Tensor) -> Tensor:
    """Distance from the middle, in focal lengths, at an angle (..., w), by (..., 4) coefficients
    that broadcast against it.
    """
    a2, (k1, k2, k3, k4) = angle * angle, k.split(1, -1)
    return angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))


def slope(angle: Tensor, k: Tensor) -> Tensor:
    """Derivative of `distort` by the angle."""
    a2, (k1, k2, k3, k4) = angle * angle, k.split(1, -1)
    return 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))


def undistort(radius: Tensor, k: Tensor, limit: Tensor) -> Tensor:
    """The angle in [0, limit] whose `distort` is the radius: Newton's steps, and halves of the
    bracket where they leave it. `distort` must rise up to the limit.
    """
    low, high = torch.zeros_like(radius), limit.expand_as(radius)
    angle = torch.minimum(radius, high)
    for _ in range(_NEWTON):
        excess = distort(angle, k) - radius
        low, high = torch.where(excess < 0, angle, low), torch.where(excess < 0, high, angle)
        step = angle - excess / slope(angle, k)
        near = (step > low - 1e-12) & (step < high + 1e-12)
        angle = torch.where(near, step, (low + high) / 2)
    return angle


def last_rising_angle(k: Tensor) -> float:
    """Largest angle, at most pi, up to which `distort` rises, for (4,) coefficients on the CPU."""
    import numpy as np

    k1, k2, k3, k4 = k.tolist()
    roots = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots.real[(abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return min([math.pi, *np.sqrt(real).tolist()])


def neighbour_cones(origin: Tensor, direction: Tensor) -> Tensor:
    """Returns cones (..., h, w, 2) from the differences between neighbouring rays: width at the
    origin and growth per unit distance, the larger of both axes of the picture.

    Args:
        origin: (..., h, w, 3).
        direction: (..., h, w, 3), unit length.

    Source: Igehy, "Tracing ray differentials", SIGGRAPH 1999.
    """
    widths = []
    for field in (origin, direction):
        steps = [ray_step(field, axis).norm(dim=-1) for axis in (-3, -2)]
        widths.append(torch.maximum(*steps))
    return torch.stack(widths, -1)


def ray_step(field: Tensor, axis: int) -> Tensor:
    """Change of (..., h, w, c) from pixel to pixel: central differences, 0 along a lone row."""
    if field.shape[axis] == 1:
        return torch.zeros_like(field)
    return torch.gradient(field, dim=axis)[0]
