"""A cloud of noise in the sun: lit without shadows, and with a shadow cone from each sample to the
sun.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from torch.nn.functional import interpolate

import gvtorch as gv

EXTENT = (64, 96, 160)  # z, y, x; y is up
PUFFS = ((0.3, 0.35, 0.5, 0.42), (0.55, 0.5, 0.5, 0.55), (0.75, 0.35, 0.45, 0.38))  # x y z radius
SUN = gv.DirectionalLight((0.8, -0.8, -0.45), (1.4, 1.2, 0.9), angle=4.0)
SKY = gv.Gradient((0.08, 0.2, 0.5), (0.45, 0.55, 0.7))


@dataclass
class Settings:
    """Renders the cloud twice."""

    output: Path = Path("clouds.png")
    size: int = 300
    device: str = "cpu"


def cloud() -> torch.Tensor:
    """(z, y, x) density: round puffs, roughened by noise of five octaves."""
    random = torch.Generator().manual_seed(4)
    noise = torch.zeros((1, 1, *EXTENT))
    for octave in range(5):
        grid = [max(2, n * 2**octave // 24) for n in EXTENT]
        points = torch.rand((1, 1, *grid), generator=random) - 0.5
        noise += interpolate(points, EXTENT, mode="trilinear", align_corners=True) / 1.7**octave
    axes = (torch.linspace(0, n / EXTENT[1], n) for n in EXTENT)
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    wide, deep = EXTENT[2] / EXTENT[1], EXTENT[0] / EXTENT[1]
    shape = torch.full(EXTENT, -1.0)
    for cx, cy, cz, radius in PUFFS:
        away = ((x - cx * wide) ** 2 + ((y - cy) * 1.3) ** 2 + (z - cz * deep) ** 2).sqrt()
        shape = torch.maximum(shape, 1 - away / radius)
    return (shape + 0.9 * noise[0, 0]).clamp(0, 1)


def main(settings: Settings) -> None:
    """Renders both pictures."""
    density = cloud()
    # Normals of length 0: droplets scatter light to all sides.
    none = torch.zeros((*density.shape, 3), dtype=torch.int8)
    channels = {"density": gv.Volume(density), "none": gv.Volume(none)}
    tree = gv.N3Tree.from_volume(channels, device=settings.device)
    white = gv.TransferFunction.from_points([(0.02, 0), (0.5, 0.22)], [(0, 1, 1, 1)])
    camera = gv.Camera.orbit(
        10, -4, 1.35, fov=42, width=settings.size * 4 // 3, height=settings.size
    )
    look = {"normals": "none", "light": SUN, "ambient": 0.12, "diffuse": 1.0, "specular": 0.0}
    pictures = [
        gv.render(tree, camera, gv.Lit(white, shadows=shadows, **look), background=SKY)
        for shadows in (False, True)
    ]
    both = torch.cat([picture.color for picture in pictures], dim=1)
    replace(pictures[-1], color=both).save(settings.output)
    times = " and ".join(f"{picture.stats.milliseconds:.0f}" for picture in pictures)
    print(f"{settings.output}: {times} ms without and with shadows")


if __name__ == "__main__":
    main(tyro.cli(Settings))
