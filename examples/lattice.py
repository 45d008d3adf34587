"""A ball of gyroid lattice, like a 3D print in porcelain: thin shells within a shell, with ambient
occlusion and one bounce of light, on a slate foot.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

import gvtorch as gv

sdf = gv.sdf
PORCELAIN, BRASS, CORE = (0.8, 0.75, 0.68), (0.75, 0.42, 0.1), (0.9, 0.12, 0.04)
SLATE, WALL = (0.1, 0.12, 0.15), gv.Gradient((0.012, 0.018, 0.028), (0.1, 0.12, 0.15))
BALLS = (1.0, 0.22, 0.5, 0.045, PORCELAIN), (0.62, 0.2, 0.3, 0.03, BRASS)
KEY = gv.DirectionalLight((0.6, 0.75, -1.0), (1.0, 0.82, 0.6), angle=12)
FILL = gv.DirectionalLight((-1.0, 0.3, -0.3), (0.08, 0.16, 0.36), angle=30)
LIGHT = gv.Lighting(
    lights=(KEY, FILL), ambient=(0.15, 0.18, 0.24), occlusion=0.9, indirect=1.0, cones=5, reach=0.35
)
VIEW = (2.1, -4.3, 2.5), (0, 0, -0.12), (0, 0, 1), 28


def lattice() -> sdf.Distance:
    """Returns the shapes, z up: a lattice within a lattice around a core, a part cut away."""
    foot = sdf.Extrusion(sdf.Sphere(1.7, color=SLATE), 0.12)
    shapes = sdf.Sphere(0.27, color=CORE) | sdf.moved(foot, z=-1.06)
    for radius, depth, period, wall, color in BALLS:
        cells = sdf.Shell(sdf.Gyroid(period, color=color), wall)
        ball = cells & sdf.Shell(sdf.Sphere(radius - depth / 2, color=color), depth)
        shapes = shapes | (ball - sdf.moved(sdf.Box((1, 1, 1), color=color), 0.53, -0.53, 0.53))
    return shapes


@dataclass
class Settings:
    """Renders the ball."""

    output: Path = Path("lattice.png")
    size: int = 720
    extent: int = 320
    device: str = "cpu"


def main(settings: Settings) -> None:
    producer = gv.FieldProducer(gv.Solid(lattice(), differences=True), settings.extent)
    shader = gv.StoredColor(
        "rgba",
        premultiplied=True,
        normals="normal",
        specular=0.25,
        shininess=60,
        ambient=1,
        diffuse=1,
    )
    with gv.Engine(producer, device=settings.device, brick_pool="512 MB") as engine:
        for divisor, mode in ((6, "converge"), (1, "interactive")):
            view = gv.Camera.look_at(
                *VIEW, settings.size * 16 // 9 // divisor, settings.size // divisor
            )
            options = {"lighting": LIGHT, "background": WALL, "cone_scale": 1.3 / divisor}
            picture = engine.render(view, shader, mode, **options)
            print(picture.stats)
    picture.tone_map("aces").save(settings.output)
    print(f"{settings.output}: {picture.stats}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
