"""Several trees in one picture: beside a dense marcher in NumPy, which knows no trees."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import gvtorch as gv
from helpers import DEVICES

WARM = gv.TransferFunction([(0, 0), (0.1, 0), (1, 0.5)], [(0, 0.2, 0, 0), (1, 1, 0.8, 0.3)])
COLD = gv.TransferFunction([(0, 0), (0.2, 0), (1, 0.4)], [(0, 0, 0.1, 0.4), (1, 0.4, 0.9, 1)])


def blob(extent: tuple[int, int, int], spacing, origin, at, width: float) -> gv.Volume:
    """A smooth ball: (z, y, x) values of a Gaussian at a place of the world."""
    axes = [o + s * np.arange(n) for n, s, o in zip(extent, spacing, origin, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    square = (x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2
    return gv.Volume(np.exp(-square / width**2).astype(np.float32), spacing, origin)


@pytest.fixture(scope="module")
def volumes() -> dict[str, gv.Volume]:
    """Two volumes of another spacing and place each, which overlap in part."""
    return {
        "ct": blob((24, 20, 28), (1.0, 1.2, 0.9), (0.0, 0.0, 0.0), (12, 11, 12), 7.0),
        "pet": blob((9, 8, 10), (2.3, 2.1, 2.0), (7.0, 5.0, -3.0), (16, 12, 8), 6.0),
    }


def view(size: int = 24) -> gv.Camera:
    return gv.Camera.look_at((40, -34, 30), (12, 11, 11), (0, 0, 1), 38, size, size)


def value_at(volume: gv.Volume, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trilinear values (k,) at world places (k, 3), the outermost voxels repeated to the box's
    faces, and whether these lie in the box.
    """
    data = volume.data[..., 0].double().numpy()
    grid = (place - volume.origin) / volume.spacing
    inside = ((grid >= -0.5) & (grid <= np.array(volume.extent) - 0.5)).all(1)
    grid = grid.clip(0, np.array(volume.extent) - 1)
    low = np.minimum(grid.astype(int), np.array(volume.extent) - 2)
    part = grid - low
    value = np.zeros(len(place))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, part, 1 - part).prod(1)
        x, y, z = (low + corner).T
        value += weight * data[z, y, x]
    return value, inside


def dense(
    volumes: list[gv.Volume], shaders: list[gv.TransferFunction], rays: gv.Rays, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Marches straight through all volumes at once in float64: extinctions add."""
    origin, direction = rays.origin.numpy(), rays.direction.numpy()
    clear, color = np.ones(len(origin)), np.zeros((len(origin), 3))
    for t in np.arange(0, 110, step) + step / 2:
        place = origin + t * direction
        total, glow = np.zeros(len(origin)), np.zeros((len(origin), 3))
        for volume, shader in zip(volumes, shaders, strict=True):
            value, inside = value_at(volume, place)
            rgba = shader(value)
            thick = -np.log1p(-rgba[:, 3]) / min(volume.spacing) * inside
            total, glow = total + thick, glow + thick[:, None] * rgba[:, :3]
        alpha = -np.expm1(-total * step)
        share = (clear * alpha / np.maximum(total, 1e-300))[:, None]
        color, clear = color + share * glow, clear * (1 - alpha)
    return color, 1 - clear


@pytest.mark.parametrize(
    "backend", [pytest.param(b, marks=pytest.mark.backend(b)) for b in DEVICES]
)
def test_trees_that_overlap_are_composited_by_sample_as_by_a_dense_marcher(volumes, backend):
    size, step = (10, 0.5) if backend == "reference" else (24, 0.05)
    trees = {
        name: gv.N3Tree.from_volume(volume, 8, device=DEVICES[backend])
        for name, volume in volumes.items()
    }
    shaders = {"ct": WARM, "pet": COLD}
    found = gv.render(
        *(trees, view(size), shaders),
        step=step,
        lod="finest",
        stop_alpha=1,
        dtype=torch.float64,
        backend=backend,
    )
    color, alpha = dense([*volumes.values()], [WARM, COLD], view(size).rays(), 0.02)
    worst = 1e-4 if step < 0.1 else 4e-3
    assert np.abs(found.color.cpu().numpy().reshape(-1, 3) - color).max() < worst
    assert np.abs(found.alpha.cpu().numpy().ravel() - alpha).max() < worst
    apart = [gv.render(trees[n], view(size), shaders[n], lod="finest") for n in trees]
    both = (apart[0].alpha > 0.1) & (apart[1].alpha > 0.1)
    assert both.float().mean() > 0.05, "they are seen through each other"
