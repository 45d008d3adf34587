"""A cloud of noise in the sun: lit without shadows, and with a shadow cone from each sample to the
sun.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

PUFFS = ((-0.35, -0.5, 0.0, 0.48), (0.38, -0.55, 0.15, 0.42), (0.05, -0.1, -0.05, 0.55),
         (-0.15, 0.4, 0.05, 0.42), (0.15, 0.7, 0.0, 0.3))  # fmt: skip
SUN = gv.DirectionalLight((0.8, -0.6, -0.35), (0.9, 0.75, 0.55), angle=10.0)
SKY = gv.Gradient((0.03, 0.1, 0.32), (0.36, 0.46, 0.6))


@dataclass
class Settings:
    """Renders the cloud twice."""

    output: Path = Path("clouds.png")
    size: int = 720
    voxels: int = 192
    device: str = "cpu"


def cloud(voxels: int) -> gv.Volume:
    """Returns the density of round puffs roughened by noise, flat below."""
    step = 2.4 / voxels
    axes = [torch.arange(-half_side, half_side, step) for half_side in (0.8, 1.2, 1.0)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    distances = [
        ((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2).sqrt() / radius
        for px, py, pz, radius in PUFFS
    ]
    shape = torch.minimum(1 - torch.stack(distances).amin(0), 4 * (y + 0.85))
    noise = gv.noise.fbm(3.5 * torch.stack((x, y, z), -1), octaves=5, gain=0.55, seed=5)
    return gv.Volume((2 * (shape + 0.62 * noise)).clamp(0, 1), (step,) * 3)


def main(settings: Settings) -> None:
    """Renders both pictures."""
    density = cloud(settings.voxels)
    # Normals of length 0, because droplets scatter light in all directions.
    no_normals = torch.zeros((*density.data.shape[:3], 3), dtype=torch.int8)
    channels = {"density": density, "none": gv.Volume(no_normals, density.spacing)}
    tree = gv.N3Tree.from_volume(channels, device=settings.device)
    opacity = [(0.02, 0), (1, 0.3)]
    white = gv.TransferFunction.from_points(opacity, [(0, 1, 1, 1)], reference=0.02)
    width = -(-settings.size * 8 // 9)  # a half of 16:9
    camera = gv.Camera.orbit(10, -4, 1.4, fov=40, width=width, height=settings.size)
    shading = {"normals": "none", "light": SUN, "ambient": 0.3, "diffuse": 1.0, "specular": 0.0}
    pictures = [
        gv.render(tree, camera, gv.Lit(white, shadows=shadows, **shading), background=SKY, step=2)
        for shadows in (False, True)
    ]
    color = torch.cat([picture.color for picture in pictures], dim=1)
    replace(pictures[-1], color=color).save(settings.output)
    times = " and ".join(f"{picture.stats.milliseconds:.0f}" for picture in pictures)
    print(f"{settings.output}: {times} ms without and with shadows")


if __name__ == "__main__":
    main(tyro.cli(Settings))
