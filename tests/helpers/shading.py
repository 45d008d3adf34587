"""Balls, parallel rays and lights whose shading has a closed form."""

from __future__ import annotations

import numpy as np
import torch

import gvtorch as gv
from helpers import DEVICES
from helpers.rays import rays_along

SPACING = (1.0, 0.8, 1.3)


RADIUS, CENTRE = 11.0, np.array([16.0, 15.0, 17.0])


def grid(extent, spacing=(1.0, 1.0, 1.0)) -> np.ndarray:
    """Returns (z, y, x, 3): world positions of voxel centres."""
    nx, ny, nz = extent
    z, y, x = np.mgrid[0:nz, 0:ny, 0:nx].astype(np.float64)
    return np.stack((x, y, z), -1) * np.array(spacing)


def ball(backend: str, spacing=SPACING, brick_size: int = 4, **extra: gv.Volume) -> gv.N3Tree:
    """Returns a tree of the signed distance to a sphere, float32, in many small bricks."""
    positions = grid((33, 39, 27), spacing)
    distance = np.linalg.norm(positions - CENTRE, axis=-1) - RADIUS
    volume = gv.Volume(distance.astype(np.float32), spacing)
    channels = {"value": volume, **extra}
    return gv.N3Tree.from_volume(channels, brick_size, device=DEVICES[backend])


def parallel(count: int, reach: float, device: str, direction=(0.3, -0.2, 1.0)) -> gv.Rays:
    """Returns parallel rays through a disc around the sphere's centre."""
    axis = torch.tensor(direction, dtype=torch.float64)
    axis = axis / axis.norm()
    right = torch.linalg.cross(axis, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    right = right / right.norm()
    up = torch.linalg.cross(right, axis)
    a, b = torch.meshgrid(
        *(torch.linspace(-reach, reach, count).double() for _ in "ab"), indexing="ij"
    )
    keep = a**2 + b**2 < reach**2
    points = torch.from_numpy(CENTRE) + a[keep][:, None] * right + b[keep][:, None] * up
    return rays_along(points - 60 * axis, axis, device=device)


def sphere(rays: gv.Rays, radius: float = RADIUS) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance to the sphere's near side, and the outward normals there."""
    origin, direction = rays.origin.cpu().numpy(), rays.direction.cpu().numpy()
    b = ((origin - CENTRE) * direction).sum(1)
    c = ((origin - CENTRE) ** 2).sum(1) - radius**2
    t = -b - np.sqrt(b**2 - c)
    return t, (origin + t[:, None] * direction - CENTRE) / radius


def phong(normal, to_light, eye, base, light, ambient, diffuse, specular, shininess):
    """Returns Blinn-Phong shading, by NumPy."""
    half = to_light + eye
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    facing = np.maximum(0, (normal * to_light).sum(1))[:, None]
    highlight = np.maximum(0, (normal * half).sum(1))[:, None] ** shininess * (facing > 0)
    return base * (ambient + diffuse * facing * light) + specular * highlight * light


MATT = {"ambient": 0.0, "diffuse": 1.0, "specular": 0.0}
