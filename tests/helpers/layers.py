"""Planes drawn by a formula, as colour and depth of another renderer, and balls that they cut."""

from __future__ import annotations

import math

import torch

import gvtorch as gv

BLUE = (0.1, 0.2, 0.8)


def plane_distances(view: gv.Camera, point: torch.Tensor, normal: tuple[float, float, float]):
    """Returns (h, w, 1) distances at which the rays of a camera meet the plane through `point`;
    +inf where they do not.
    """
    rays, normal = view.rays(), torch.tensor(normal, dtype=torch.float64)
    distance = ((point - rays.origin) @ normal) / (rays.direction @ normal)
    return torch.where(distance > 0, distance, math.inf).reshape(view.height, view.width, 1)


def layer_of(depth: torch.Tensor, alpha: torch.Tensor | None = None, color=BLUE) -> gv.Layer:
    """Returns a layer of one straight colour at a depth."""
    plain = depth.new_tensor(color).expand(*depth.shape[:-1], 3)
    return gv.Layer(plain if alpha is None else plain * alpha, depth, alpha)


def ball(radius: float, size: int) -> gv.Volume:
    """Returns the signed distance to a sphere at the origin, positive inside; voxels are 1 wide."""
    axis = torch.arange(size) - (size - 1) / 2
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    origin = (-(size - 1) / 2,) * 3
    return gv.Volume(radius - (x * x + y * y + z * z).sqrt(), origin=origin)


SOLID = gv.TransferFunction.from_points([(-1e-3, 0), (1e-3, 1)], [(0, 1, 0, 0)], reference=0.01)


def seam_error(picture: gv.Picture, view: gv.Camera, height: float, radius: float) -> float:
    """Returns by how many pixels the seam of a ball and the plane z = height is off: the largest
    distance from the seam's circle of a pixel that shows the wrong one. A pixel must show the ball
    where its ray meets the plane inside of it.
    """
    rays = view.rays()
    distance = (height - rays.origin[:, 2]) / rays.direction[:, 2]
    hit = rays.origin + distance[:, None] * rays.direction
    ring = math.sqrt(radius**2 - height**2)
    from_axis = hit[:, :2].norm(dim=1)
    red, blue = picture.color.cpu().double().reshape(-1, 3)[:, (0, 2)].unbind(1)
    wrong = (red > blue) != (from_axis < ring)
    # The nearest point of the circle, in pixels.
    edge = hit.clone()
    edge[:, :2] *= (ring / from_axis)[:, None]
    matrix = view.Ks[0] @ view.viewmats[0, :3]
    pixels = []
    for point in (hit, edge):
        homogeneous = torch.cat((point, torch.ones_like(point[:, :1])), 1) @ matrix.T
        pixels.append(homogeneous[:, :2] / homogeneous[:, 2:])
    inside = int((from_axis < ring).sum())
    assert inside > 500 and inside < 0.8 * len(hit), "the test must see something"
    errors = (pixels[0] - pixels[1]).norm(dim=1)[wrong]
    return float(errors.max()) if len(errors) else 0.0
