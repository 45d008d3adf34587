"""A lantern made of distance fields: shapes united, cut, hollowed, twisted and blended.

400^3 voxels, of which only those near the surface are computed: the rest is proven empty or full.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

import gvtorch as gv

sdf = gv.sdf
IVORY, BRASS, TEAL, CLAY = (0.7, 0.62, 0.48), (0.55, 0.3, 0.06), (0.02, 0.2, 0.22), (0.7, 0.1, 0.03)
SUN = gv.DirectionalLight((-0.9, 1.0, -1.1), (1.25, 1.1, 0.85), angle=6)
SKY = gv.Gradient((0.05, 0.07, 0.1), (0.32, 0.3, 0.28))


def lantern() -> sdf.Distance:
    """Returns the shapes, z up."""
    lace = sdf.Shell(sdf.Gyroid(0.46, color=IVORY), 0.035)
    ball = (lace & sdf.Shell(sdf.Sphere(0.92, color=IVORY), 0.09)) | sdf.Sphere(0.55, color=CLAY)
    rings = sdf.Torus(0.95, 0.06, color=BRASS) | sdf.rotated(
        sdf.Torus(0.95, 0.06, color=BRASS), (1, 0, 0), 90
    )
    column = sdf.Twist(sdf.Box((0.42, 0.42, 0.9), round=0.06, color=TEAL), 3.5)
    foot = sdf.Revolution(sdf.Box((0.16, 0.16, 1), round=0.06, color=BRASS), 0.45)
    plate = sdf.Extrusion(sdf.Sphere(0.62, color=TEAL), 0.12)
    base = sdf.SmoothUnion(sdf.moved(column, z=-1.35), sdf.moved(plate, z=-1.8), 0.25)
    base = base | sdf.moved(foot, z=-1.7)
    holes = sdf.Repeat(sdf.Sphere(0.12, color=IVORY), (0.4, 0.4, 0), (11, 11, 1))
    floor = sdf.Box((4.4, 4.4, 0.2), round=0.05, color=(0.3, 0.27, 0.25))
    floor = sdf.SmoothDifference(floor, sdf.moved(holes, z=0.12), 0.03)
    return ball | rings | base | sdf.moved(floor, z=-1.96)


@dataclass
class Settings:
    """Renders the lantern."""

    output: Path = Path("distance_fields.png")
    size: int = 720
    extent: int = 400
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Streams what a small picture needs, which is nearly all, then renders the large one."""
    producer = gv.FieldProducer(gv.Solid(lantern(), differences=True), settings.extent)
    shader = gv.StoredColor(
        "rgba", premultiplied=True, normals="normal", light=SUN, ambient=0.4, diffuse=0.9
    )
    light = gv.Lighting(ambient=(0.65, 0.75, 0.9), occlusion=0.9, reach=0.1, frame="box", cones=3)
    with gv.Engine(producer, brick_pool="256 MB", device=settings.device) as engine:
        for divisor in (3, 1):
            size = {"width": settings.size * 16 // 9 // divisor, "height": settings.size // divisor}
            camera = gv.Camera.look_at((2.5, -4.2, 1.7), (0, 0, -0.52), (0, 0, 1), 36, **size)
            options = {"cone_scale": 1.4 / divisor, "lighting": light, "background": SKY}
            picture = engine.render(camera, shader, **options)
            print(f"{producer}: {picture.stats}")
    picture.save(settings.output)
    print(f"{settings.output}: {picture.stats.bricks_used} bricks in use")


if __name__ == "__main__":
    main(tyro.cli(Settings))
