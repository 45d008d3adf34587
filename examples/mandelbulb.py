"""The Mandelbulb in the evening sun: 512^3 voxels of a formula, of which few are ever made.

Regions whose orbits are proven to escape in time are empty, and never evaluated.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

import gvtorch as gv

SUN = gv.DirectionalLight((0.3, -1.0, -0.9), (1.35, 1.1, 0.8), angle=4)
SKY = gv.Gradient((0.02, 0.03, 0.05), (0.2, 0.22, 0.26))
COLORS = ((1.0, 0.8, 0.45), (0.75, 0.22, 0.12), (0.1, 0.18, 0.35))  # of three orbit traps


@dataclass
class Settings:
    """Renders a fractal: the bulb, a Julia set or the Mandelbox."""

    output: Path = Path("mandelbulb.png")
    fractal: Literal["bulb", "julia", "box"] = "bulb"
    size: int = 720
    extent: int = 512
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Streams what a small picture needs, which is nearly all, then renders the large one."""
    shape = {
        "bulb": gv.Mandelbulb(8, iterations=6, colors=COLORS),
        "julia": gv.Julia((-0.2, 0.5, 0.3), 2, iterations=12, colors=COLORS),
        "box": gv.Mandelbox(2.0, iterations=12, colors=COLORS),
    }[settings.fractal]
    producer = gv.FieldProducer(gv.Solid(shape, normals=False), settings.extent)
    shader = gv.StoredColor(
        "rgba", premultiplied=True, lit=True, light=SUN, ambient=0.4, diffuse=0.85, specular=0.15
    )
    light = gv.Lighting(ambient=(0.6, 0.75, 1.0), occlusion=0.9, reach=0.1, frame="box", cones=4)
    with gv.Engine(producer, brick_pool="512 MB", device=settings.device) as engine:
        for divisor in (3, 1):
            size = {"width": settings.size * 16 // 9 // divisor, "height": settings.size // divisor}
            camera = gv.Camera.orbit(35, 28, distance=2.05, **size)
            options = {"cone_scale": 2.0 / divisor, "lighting": light, "background": SKY}
            picture = engine.render(camera, shader, **options)
            print(f"{producer}: {picture.stats}")
    picture.save(settings.output)
    print(f"{settings.output}: {picture.stats.bricks_used} bricks in use")


if __name__ == "__main__":
    main(tyro.cli(Settings))
