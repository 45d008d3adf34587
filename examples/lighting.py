"""Lighting by secondary cones. Above: a scan in its shader's own light, with soft shadows, and
with ambient occlusion. Below: a room with a lamp: direct light, occluded ambient light, one bounce.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SUN = gv.DirectionalLight((-1.0, -1.2, -0.8), (1.25, 1.1, 0.9), angle=4)
SHINE = {"ambient": 0.5, "diffuse": 0.75, "specular": 0.2, "shininess": 30}
VESSELS = gv.Isosurface(50, (0.85, 0.35, 0.25), light=SUN, **SHINE)
SKY, EVENING = (0.75, 0.9, 1.15), gv.Gradient((0.2, 0.25, 0.34), (0.03, 0.035, 0.05))
SIDE, WALL, SOFT = 96, 5.0, 3.0  # voxels: the room, its walls, and soft edges of surfaces
WHITE, RED, GREEN, BRASS = (0.8, 0.8, 0.8), (0.8, 0.1, 0.06), (0.12, 0.55, 0.1), (0.85, 0.7, 0.45)
LAMP = gv.PointLight((46.0, 82.0, 66.0), (1.0, 0.95, 0.85), radius=7.0)
MATT = {"ambient": 1.0, "diffuse": 1.0, "specular": 0.0}
PAINT = gv.StoredColor("rgba", premultiplied=True, light=LAMP, **MATT)


@dataclass
class Settings:
    """Renders the bundled aneurism and a small room."""

    output: Path = Path("lighting.png")
    size: int = 720
    samples: int = 2
    device: str = "cpu"


def room() -> gv.Volume:
    """Returns premultiplied colour and opacity of walls, a block and a ball."""
    axis = torch.arange(SIDE, dtype=torch.float32)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    u, v = (math.cos(a) * (x - 32) + math.sin(a) * (z - 34) for a in (0.35, 0.35 + math.pi / 2))
    block = torch.maximum(torch.maximum(u.abs() - 13, v.abs() - 13), y - 44)
    ball = ((x - 64) ** 2 + (y - WALL - 15) ** 2 + (z - 50) ** 2).sqrt() - 15
    far = SIDE - 1 - WALL
    bodies = (
        *((y - WALL, WHITE), (far - y, WHITE), (z - WALL, WHITE)),
        *((x - WALL, RED), (far - x, GREEN), (block, WHITE), (ball, BRASS)),
    )
    color, alpha = torch.zeros(SIDE, SIDE, SIDE, 3), torch.zeros_like(x)
    for distance, paint in bodies:  # composited front to back
        share = (0.5 - distance / SOFT).clamp(0, 1) * (1 - alpha)
        color, alpha = color + share[..., None] * torch.tensor(paint), alpha + share
    return gv.Volume(torch.cat((color, alpha[..., None]), -1))


def main(settings: Settings) -> None:
    """Renders six pictures."""
    size = -(-settings.size * 16 // 27), settings.size // 2  # a third and a half of 16:9
    scan = gv.read_volume(Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz")
    vessels = gv.N3Tree.from_volume(scan, device=settings.device)
    box = gv.N3Tree.from_volume({"rgba": room()}, device=settings.device)
    orbit = gv.Camera.orbit(30, 20, 1.15, 30, *size)
    front = gv.Camera.look_at((48, 58, 250), (48, 38, 48), (0, 1, 0), 23, *size)
    soft, lamp = gv.Lighting(ambient=SKY), gv.Lighting(ambient=(0, 0, 0))
    near = gv.Lighting(ambient=SKY, occlusion=0.85, reach=0.1, frame="box", cones=6)
    dim = gv.Lighting(ambient=(0.3, 0.3, 0.3), occlusion=0.9, cones=7)
    bounce = replace(dim, ambient=(0.1, 0.1, 0.1), indirect=1.0, reach=SIDE)
    images = []
    cases = (vessels, orbit, VESSELS, (None, soft, near)), (box, front, PAINT, (lamp, dim, bounce))
    for tree, camera, shader, lights in cases:
        for lighting in lights:
            render = partial(gv.render, tree, shader=shader, lighting=lighting, background=EVENING)
            picture = gv.Progressive(render).refine(camera, settings.samples)
            images.append(picture.color)
    rows = torch.cat([torch.cat(images[i : i + 3], dim=1) for i in (0, 3)])
    replace(picture, color=rows).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
