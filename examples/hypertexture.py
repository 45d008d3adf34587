"""Hypertexture: a weathered rock, whose distance and normals noise perturbs, coloured by a transfer
function of the distance; and fur, which a transfer function alone makes of noise. Both are made
where rays ask for it, around any shape: --volume takes signed distances, such as a bunny's.
"""

from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import starmap
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SUN = gv.DirectionalLight((-0.7, -0.75, -0.65), (1.5, 1.3, 1.05), angle=3)
SKY = gv.Gradient((0.16, 0.22, 0.31), (0.68, 0.72, 0.72))
STONE = [(-0.13, 0.08, 0.055, 0.04), (-0.07, 0.3, 0.22, 0.15), (0, 0.55, 0.49, 0.41)]
LIMBS = (  # of a hare: where each begins and ends, and its radius
    *(((-0.1, -0.15, 0), (0.35, -0.12, 0), 0.46), ((-0.55, 0.35, 0), (-0.68, 0.32, 0), 0.27)),
    *(((-0.52, 0.6, z), (-0.36, 1.12, 2 * z), 0.1) for z in (-0.15, 0.15)),
    *(((-0.4, -0.5, z), (-0.68, -0.53, z), 0.12) for z in (-0.22, 0.22)),
    *(((0.35, -0.45, z), (-0.02, -0.52, z), 0.16) for z in (-0.3, 0.3)),
    ((0.82, -0.02, 0), (0.86, 0.02, 0), 0.15),
)
HAIR = [
    (0.0, 0.02, 0.008, 0.004),
    (0.4, 0.3, 0.12, 0.04),
    (0.75, 0.85, 0.52, 0.25),
    (1, 1, 0.9, 0.7),
]


@dataclass
class Settings:
    """Renders a rock and its fur."""

    output: Path = Path("hypertexture.png")
    size: int = 720
    extent: int = 384
    volume: Path | None = None  # of signed distances
    device: str = "cpu"


class Fur(gv.Field):
    """Hairs on a shape: 0 between them, else from 0.1 at the roots to 1 at the tips."""

    prefiltered = True

    def __init__(self, shape, length=0.11, frequency=36.0):
        """Takes the shape, how long hairs are, and how many stand on a unit."""
        super().__init__()
        self.shape, self.length, self.frequency = shape, length, frequency
        self.threshold = {"value": 0.0}

    def filtered(self, points, size):
        """A hair is where noise at its root on the shape is above the height."""
        away, _, normal = self.shape.surface_and_gradient(points)
        normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=0.5)
        height = away / self.length
        root = points - away[..., None] * normal
        fall = points.new_tensor((0.25, 1.0, 0.1)) * (0.5 * self.length)
        root = root + (height * height)[..., None] * fall
        seen = (-0.82 * (size[..., 0] * self.frequency) ** 2).exp()
        hairs = gv.noise.perlin(root * self.frequency) * seen
        inside = ((0.45 + 0.7 * hairs - height) * 5).clamp(0, 1)
        return {"value": inside * (0.1 + 0.9 * height.clamp(0, 1))}

    def bounds(self, center, half):
        """Hairs end at 1.2 of their length at most; skin begins 0.5 of it below the surface."""
        low, high = self.shape.bounds(center, half)
        most = torch.where(low > 1.2 * self.length, 0.0, 1.0)
        skin = high < -0.5 * self.length
        return {"value": (0.1 * skin.to(low), torch.where(skin, 0.1, most.to(low)))}

    def box(self):
        """Around the shape and its hairs."""
        box = self.shape.box()
        return torch.stack((box[0] - self.length, box[1] + self.length))


def main(settings: Settings) -> None:
    """Renders both side by side."""
    shape = reduce(partial(gv.sdf.SmoothUnion, width=0.12), starmap(gv.sdf.Capsule, LIMBS))
    if settings.volume is not None:
        shape = gv.SampledDistance(gv.read_volume(settings.volume))
    rock = gv.Hypertexture(
        gv.sdf.Offset(shape, 0.03),  # as much as density 1/2 lies below the surface
        settings.extent,
        thickness=0.075,
        frequency=6,
        octaves=6,
        gain=0.55,
        softness=0.12,
        distances=True,
    )
    stone = gv.TransferFunction.from_points([(-1, 1), (1, 1)], STONE)
    light = {"light": SUN, "ambient": 0.35, "diffuse": 0.85, "specular": 0.05, "shininess": 12}
    looks = {
        rock: gv.Isosurface(0.5, stone, color_channel="distance", **light),
        gv.FieldProducer(Fur(shape), settings.extent): gv.TransferFunction.from_points(
            [(0.02, 0), (0.1, 0.5), (1, 0.6)], HAIR
        ),
    }
    lighting = gv.Lighting(
        ambient=(0.75, 0.88, 1.1), occlusion=0.9, reach=0.08, cones=8, frame="box"
    )
    camera = gv.Camera.orbit(-30, 16, 1.45, 36, settings.size * 8 // 9, settings.size)
    pictures = []
    for producer, look in looks.items():
        engine = gv.Engine(producer, device=settings.device, brick_pool="1 GB")
        lit = {"lighting": lighting} if producer is rock else {}
        pictures.append(engine.render(camera, look, background=SKY, **lit))
    both = torch.cat([picture.color for picture in pictures], dim=1)
    replace(pictures[0], color=both).save(settings.output)
    print(f"{settings.output}: {rock.saved:.0%} of the rock's octaves were not evaluated")


if __name__ == "__main__":
    main(tyro.cli(Settings))
