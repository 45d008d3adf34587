"""A spiral galaxy of points: a bulge, an old disc, young arms, nebulae, and dust that hides them.

The brightness of its voxels spans a factor of about 10^6, and is tone-mapped.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import gvtorch as gv

ARMS, WINDING, LENGTH, EXTENT = 2, 3.1, 0.27, 512  # the disc fades to 1/e over LENGTH


@dataclass
class Settings:
    """Renders the galaxy."""

    output: Path = Path("galaxy.png")
    stars: int = 200_000
    size: int = 720
    device: str = "cpu"


def disc(count: int, thickness: float, lag: float, arm_power: float, clump: float) -> torch.Tensor:
    """Returns about `count` positions (n, 3), denser near arms that lag behind by the angle `lag`,
    and where noise that is wound like the arms is high.
    """
    radius = 0.02 - LENGTH * (1 - 0.99 * torch.rand(3 * count)).log()
    angle, twist = 6.2832 * torch.rand(len(radius)), WINDING * (radius / 0.1).log()
    jitter = 0.5 * gv.noise.fbm(torch.stack((3 * twist, radius * 5, angle.cos()), 1), octaves=2)
    nearness = 0.5 + 0.5 * (ARMS * (angle - twist + lag + jitter)).cos()
    flat = torch.stack((radius * angle.cos(), radius * angle.sin(), 0.7 * (angle - twist).cos()), 1)
    knots = 0.5 + 0.8 * gv.noise.fbm(flat * torch.tensor([11.0, 11.0, 3.0]), octaves=3, seed=3)
    weight = nearness**arm_power * knots.clamp(0, 1) ** clump
    kept = torch.rand(len(weight)) < weight * count / weight.sum()
    height = thickness * torch.randn(len(weight)) * (1.3 - radius).clamp(min=0.3)
    return torch.stack((radius * angle.cos(), height, radius * angle.sin()), 1)[kept]


def ball(count: int, size: float) -> torch.Tensor:
    """Returns (n, 3) positions, denser towards the middle."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=1)
    return directions * size * torch.randn(count, 1).abs() ** 2 * torch.tensor([1.0, 0.75, 1.0])


def main(settings: Settings) -> None:
    """Makes the points and their picture."""
    torch.manual_seed(11)
    count, centres = settings.stars, disc(600, 0.006, 0.0, 6.0, 2.5)
    nebulae = centres.repeat_interleave(24, 0) + 0.007 * torch.randn(24 * len(centres), 3)
    parts = (  # positions, linear colour, and of each point: light, opacity, radius
        (ball(count // 16, 0.065), (1.0, 0.70, 0.40), 0.28, 1e-3, 0.025),
        (disc(count // 10, 0.018, 0.0, 0.4, 0.2), (1.0, 0.76, 0.52), 0.18, 1e-3, 0.05),
        (disc(count // 3, 0.008, 0.0, 3.0, 1.6), (0.34, 0.55, 1.0), 0.09, 1e-3, 0.014),
        (nebulae, (1.0, 0.14, 0.30), 0.20, 1e-3, 0.010),
        (disc(count // 3, 0.003, 0.45, 5.0, 2.0), (0.22, 0.10, 0.05), 0.005, 2.2, 0.011),
        (disc(count, 0.012, 0.0, 1.5, 1.2), (0.72, 0.84, 1.0), 0.005, 1e-4, 0.0),
        (ball(count // 4, 0.12), (1.0, 0.82, 0.6), 0.005, 1e-4, 0.0),
    )
    rows = []
    for positions, color, light, opacity, radius in parts:  # most stars are faint, few are bright
        brightness = light * torch.rand(len(positions), 1) ** (0 if radius else -0.9)
        rest = torch.tensor([opacity, radius]).expand(len(positions), 2)
        rows.append(torch.cat((positions, brightness * torch.tensor(color), rest), 1))
    positions, values, radii = torch.cat(rows).split((3, 4, 1), 1)
    producer = gv.PointProducer(positions, values, EXTENT, radius=radii[:, 0], drawn=True)
    size = {"width": settings.size * 16 // 9, "height": settings.size}
    camera = gv.Camera.look_at((0.35, 1.25, 1.75), (0, -0.02, 0.03), (0.3, 1, 0), 36, **size)
    with gv.Engine(producer, brick_pool="512 MB", device=settings.device) as engine:
        look, stars = gv.StoredColor("value", premultiplied=True), gv.point_layer(producer, camera)
        picture = engine.render(camera, look, layer=stars, step=0.6)
    picture.tone_map("aces", exposure=0.5).save(settings.output)
    print(f"{settings.output}: {len(positions):,} points, {picture.stats.bricks_used} bricks")


if __name__ == "__main__":
    main(tyro.cli(Settings))
