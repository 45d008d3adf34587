"""Surfaces of equal star density around a galaxy, whose tides stretch satellites into streams. The
stars are made here, or a file has the log-scaled density, such as hdz2000_128_uint8.npy.bz2."""

import bz2
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import tyro

import gvtorch as gv

SURFACES = {  # density: opacity, colour
    124: (0.0012, 0.06, 0.16, 0.75),
    138: (0.004, 0.12, 0.35, 0.95),
    154: (0.012, 0.30, 0.30, 0.95),
    172: (0.03, 0.80, 0.30, 0.70),
    192: (0.07, 1.00, 0.40, 0.32),
    214: (0.16, 1.00, 0.62, 0.22),
    238: (0.60, 1.00, 0.92, 0.65),
}


@dataclass
class Settings:
    """Renders a halo of stars."""

    output: Path = Path("halo.png")
    volume: Path | None = None
    size: int = 720
    samples: int = 4
    device: str = "cpu"


def streams(stars: int, steps: int = 700, step: float = 0.02) -> torch.Tensor:
    """Returns (n, 3) positions of the stars of 40 satellites after some orbits in the potential
    ln(0.1 + x^2 + y^2 + z^2 / 0.8) / 2 (Binney, Tremaine, "Galactic Dynamics", 2008, 2.71)."""
    normal = partial(torch.randn, generator=torch.Generator().manual_seed(6))
    satellite = (40 * torch.linspace(0, 1, stars) ** 2).long().clamp(max=39)  # they differ in size
    position = (0.4 * normal(40, 3)[satellite] + 0.03 * normal(stars, 3)).T.contiguous()
    velocity = (0.5 * normal(40, 3)[satellite] + 0.04 * normal(stars, 3)).T.contiguous()
    scale = torch.tensor([[1.0], [1.0], [1 / 0.8]])
    for _ in range(steps):  # leapfrog
        position += 0.5 * step * velocity
        velocity -= step * scale * position / (0.1 + (scale * position**2).sum(0))
        position += 0.5 * step * velocity
    return position.T


def star_density(stars: int = 200_000, side: int = 128) -> torch.Tensor:
    """Returns the logarithm of the stars' density, side^3 uint8."""
    points = gv.Points(streams(stars), radius=0.05)
    producer = gv.PointProducer(points, extent=side, box=((-1, -1, -1), (1, 1, 1)))
    axis = (torch.arange(side) + 0.5) / side * 2 - 1
    positions = torch.cartesian_prod(axis, axis, axis).flip(1)  # x runs fastest
    density = producer.at(positions)["value"].view(side, side, side)
    value = 100 + 16 * torch.log2(density / density.mean() + 1e-3)
    return value.clamp(0, 255).to(torch.uint8)


def main(settings: Settings) -> None:
    """Makes the picture."""
    value = star_density() if settings.volume is None else np.load(bz2.open(settings.volume))
    tree = gv.N3Tree.from_volume(gv.Volume(value), device=settings.device)
    opacity = [(0.0, 0.0)]
    for density, (peak, *_) in SURFACES.items():
        opacity += [(density - 5, peak / 8), (density, peak), (density + 5, peak / 8)]
    color = [(density, *rgb) for density, (_, *rgb) in SURFACES.items()]
    transfer = gv.TransferFunction(opacity, color)
    shader = gv.Lit(transfer, light=gv.DirectionalLight((-1, 0.6, -0.5)), diffuse=0.9)
    camera = gv.Camera.orbit(35, 25, 1.95, 30, settings.size * 16 // 9, settings.size, up="+z")
    mean = gv.Progressive(partial(gv.render, tree, shader=shader, step=0.5))
    mean.refine(camera, settings.samples).tone_map("aces", exposure=0.6).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
