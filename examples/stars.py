"""The stars around the Sun: far stars as voxels that hold their light, near ones as points. They
come from a catalogue (positions in parsecs, luminosities, B-V), or are made up.

    python examples/stars.py --catalog hyg_stars.npz
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import gvtorch as gv

OPACITY, COLOR_EXPONENT = 0.02, 1.5  # opacity of a star in its voxel; exponent of its colour


@dataclass
class Settings:
    """Renders the stars."""

    output: Path = Path("stars.png")
    catalog: Path | None = None
    values: str = "luminosity_sun"
    color_index: str = "color_index_bv"
    exposure: float = -11.5
    size: int = 720
    extent: int = 384
    device: str = "cpu"


def made_up_stars(count: int = 60_000) -> tuple[gv.Points, np.ndarray]:
    """Returns stars out to where each is visible, the brighter the farther, and their B-V."""
    random = np.random.default_rng(4)
    luminosity = 16 * random.random(count) ** -0.9
    distance = np.minimum(40 * np.sqrt(luminosity), 900) * random.random(count) ** 0.5
    directions = random.standard_normal((count, 3)) * (1, 0.7, 0.4)
    positions = directions * (distance / np.linalg.norm(directions, axis=1))[:, None]
    return gv.Points(positions, luminosity), random.normal(0.6, 0.4, count)


def star_color(color_index: np.ndarray) -> np.ndarray:
    """Returns (n, 3) linear colours from B-V: the temperature by Ballesteros (2012), and Planck's
    law at the wavelengths of red, green and blue, relative to the Sun's light.
    """
    clipped = np.clip(color_index, -0.35, 2.0)
    kelvin = np.r_[5800, 4600 * (1 / (0.92 * clipped + 1.7) + 1 / (0.92 * clipped + 0.62))]
    nanometers = np.array([610.0, 550.0, 465.0])
    light = 1 / np.expm1(1.4388e7 / (nanometers * kelvin[:, None]))
    color = light[1:] / light[0]
    return (color / color.max(1, keepdims=True)) ** COLOR_EXPONENT


def main(settings: Settings) -> None:
    """Makes the picture."""
    if settings.catalog is None:
        points, color_index = made_up_stars()
    else:
        points = gv.read_points(settings.catalog, values=settings.values)
        color_index = gv.PointFile(settings.catalog).columns[settings.color_index]
    lit_points = gv.Points(points.positions, points.values, star_color(color_index)).lit(OPACITY)
    producer = gv.PointProducer(lit_points, extent=settings.extent, drawn=True)
    size = {"width": settings.size * 16 // 9, "height": settings.size}
    camera = gv.Camera.look_at((300, -800, 420), (0, 0, 0), (0.5, 0, 1), 50, **size)
    with gv.Engine(producer, brick_pool="1 GB", device=settings.device) as engine:
        layer = gv.point_layer(producer, camera)
        shader = gv.StoredColor("value", premultiplied=True)
        picture = engine.render(camera, shader, layer=layer, step=1.0)
    picture.tone_map("aces", exposure=settings.exposure).save(settings.output)
    pixels = int((layer.alpha > 0).sum())
    print(f"{settings.output}: {len(points):,} stars; points are drawn in {pixels:,} pixels")


if __name__ == "__main__":
    main(tyro.cli(Settings))
