"""A spiral galaxy of two million points: a bulge, young arms, nebulae, and dust that hides them.

What shines adds up in voxels of 32-bit floats, over six orders of magnitude, and is tone-mapped.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import gvtorch as gv

ARMS, WINDING, FLAT = 2, 2.4, 0.010


@dataclass
class Settings:
    """Renders the galaxy."""

    output: Path = Path("galaxy.png")
    stars: int = 600_000
    size: int = 720
    extent: int = 768
    device: str = "cpu"


def disc(count: int, wide: float, thick: float, pick: torch.Generator) -> torch.Tensor:
    """(n, 3) places along the arms, the more beside them the larger `wide` is."""
    radius = 0.04 - 0.22 * (1 - 0.985 * torch.rand(count, generator=pick)).log()
    arm = torch.randint(0, ARMS, (count,), generator=pick) * (2 * math.pi / ARMS)
    away = wide * torch.randn(count, generator=pick) / (0.4 + radius)
    angle = arm + WINDING * (radius / 0.12).log() + away
    height = thick * torch.randn(count, generator=pick) * (1.2 - radius).clamp(min=0.3)
    return torch.stack((radius * angle.cos(), height, radius * angle.sin()), 1)


def ball(count: int, size: float, pick: torch.Generator) -> torch.Tensor:
    """(n, 3) places around the middle, the denser the nearer."""
    away = size * torch.randn((count, 1), generator=pick).abs() ** 1.6
    way = torch.nn.functional.normalize(torch.randn((count, 3), generator=pick), dim=1)
    return away * way * torch.tensor([1.0, 0.7, 1.0])


def clumps(places: torch.Tensor, each: int, size: float, pick: torch.Generator) -> torch.Tensor:
    """(n * each, 3) places around each of n."""
    spread = size * (0.5 + torch.rand((len(places), 1, 1), generator=pick))
    away = torch.randn((len(places), each, 3), generator=pick)
    return (places[:, None] + spread * away).flatten(0, 1)


def main(settings: Settings) -> None:
    """Makes the points and their picture."""
    pick, many = torch.Generator().manual_seed(11), settings.stars
    parts = (  # places, linear colour, light and opacity of a point
        (ball(many // 3, 0.075, pick), (1.0, 0.72, 0.42), 0.010, 1e-4),
        (disc(many, 0.50, 2 * FLAT, pick), (1.0, 0.83, 0.62), 0.007, 1e-4),
        (disc(many, 0.17, FLAT, pick), (0.42, 0.62, 1.0), 0.008, 1e-4),
        (disc(many // 300, 0.13, FLAT, pick), (0.7, 0.84, 1.0), 0.7, 1e-3),
        (clumps(disc(420, 0.10, FLAT, pick), 90, 0.008, pick), (1.0, 0.16, 0.32), 0.03, 1e-3),
        (0.94 * clumps(disc(14000, 0.09, 0.3 * FLAT, pick), 40, 0.011, pick), (1, 1, 1), 0.0, 0.25),
    )
    rows = []
    for place, color, light, opacity in parts:
        bright = light * torch.empty(len(place), 1).exponential_(generator=pick) ** 1.5
        rows.append(torch.cat((place, bright * torch.tensor(color), bright * 0 + opacity), 1))
    points = torch.cat(rows)
    producer = gv.PointProducer(points[:, :3], points[:, 3:], settings.extent)
    look = gv.StoredColor("value", premultiplied=True)
    size = {"width": settings.size * 16 // 9, "height": settings.size}
    camera = gv.Camera.look_at((0.35, 0.95, 1.75), (0, -0.03, 0.05), (0.12, 1, 0), 36, **size)
    with gv.Engine(producer, brick_pool="2 GB", device=settings.device) as engine:
        picture = engine.render(camera, look, stop_alpha=1.0)
    picture.tone_map("aces", exposure=0.8).save(settings.output)
    print(f"{settings.output}: {len(points):,} points, {picture.stats.bricks_used} bricks")


if __name__ == "__main__":
    main(tyro.cli(Settings))
