"""A cloud in the evening sun with multiple scattering, made of `gv.noise` or read from a file."""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SUN = gv.DirectionalLight((-0.78, -0.48, 0.4), (1.9, 1.12, 0.58), angle=15.0)
SKY = gv.Gradient((0.012, 0.04, 0.16), (0.5, 0.24, 0.17))
PUFFS = ((-0.85, -0.2, 0.0, 0.45), (-0.3, 0.1, 0.1, 0.6), (0.35, 0.2, -0.1, 0.62),
         (0.9, -0.1, 0.05, 0.42), (0.1, -0.2, 0.35, 0.5))  # fmt: skip
OPTICAL_DEPTH = 40.0  # optical depth of half the longest side at full density


@dataclass
class Settings:
    """Renders a cloud."""

    file: Path | None = None
    """a grid of density: .vdb, .nvdb or any volume"""
    output: Path = Path("cloud.png")
    size: int = 720
    voxels: int = 288
    """along the longest side of the cloud of noise"""
    device: str = "cpu"


def cloud(voxels: int) -> gv.Volume:
    """Returns the density of puffs roughened by noise, flat below."""
    step = 3.2 / voxels
    axes = [torch.arange(-half_side, half_side, step) for half_side in (0.8, 1.0, 1.6)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    shape = torch.full_like(x, -1.0)
    for px, py, pz, radius in PUFFS:
        distance = ((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2).sqrt()
        shape = torch.maximum(shape, 1 - distance / radius)
    shape = torch.minimum(shape, 4 * (y + 0.55))
    near_surface = shape > -0.7
    noise = torch.zeros_like(x)
    positions = torch.stack((x[near_surface], y[near_surface], z[near_surface]), -1)
    noise[near_surface] = gv.noise.fbm(3.2 * positions, octaves=6, gain=0.55, seed=5)
    density = (2.2 * (shape + 0.85 * noise - 0.02)).clamp(0, 1)
    return gv.Volume((255 * density).to(torch.uint8), (step,) * 3)


def main(settings: Settings) -> None:
    """Reads or makes the cloud, and renders it."""
    volume = gv.read_volume(settings.file) if settings.file else cloud(settings.voxels)
    tree = gv.N3Tree.from_volume(volume, device=settings.device)
    peak, half_side = float(volume.data.max()), float((tree.box[1] - tree.box[0]).max()) / 2
    albedo, reference = (0.995, 0.99, 0.98), min(volume.spacing)
    values = [n / 64 for n in range(65)]
    points = [(peak * v, 1 - math.exp(-OPTICAL_DEPTH * v * reference / half_side)) for v in values]
    white = gv.TransferFunction(points, [(0.0, *albedo)], reference)
    shader = gv.Lit(white, light=SUN, octaves=5, anisotropy=0.4, ambient=0.1, diffuse=1.0)
    size = {"width": settings.size * 16 // 9, "height": settings.size}
    camera = gv.Camera.orbit(18, -6, 1.15, fov=38, **size)
    picture = gv.render(tree, camera, shader, background=SKY, step=2)
    picture.tone_map("aces", exposure=0.62).save(settings.output)
    print(f"{settings.output}: {picture.stats.milliseconds / 1000:.1f} s")


if __name__ == "__main__":
    main(tyro.cli(Settings))
