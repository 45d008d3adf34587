"""Four stops of a flight into the Mandelbulb, down to 10^-6 of it; mandelbulb_film.py flies on."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from rich.progress import track
from torch.nn.functional import normalize

import gvtorch as gv

BOX = 2.4  # world units along a side of 2^33 voxels
GOAL = torch.tensor([0.39751421168185086, 0.2544090897898981, 0.6439730248200939]).double()
COLORS = ((1.0, 0.7, 0.3), (0.6, 0.13, 0.06), (0.05, 0.13, 0.3))  # of three orbit traps


@dataclass
class Settings:
    """Renders the four stops, side by side."""

    output: Path = Path("mandelbulb_zoom.png")
    size: int = 720
    cone_scale: float = 4.5  # width of a voxel in pixels; below 1 adds no sharpness
    device: str = "cpu"


def eye_directions() -> torch.Tensor:
    """Returns (32, 3): for each level, the direction from PLACE to an eye with much room around."""
    shape, random = gv.Mandelbulb(8, iterations=20), torch.Generator().manual_seed(0)
    candidates, chosen = normalize(torch.randn((2000, 3), generator=random).double()), [GOAL]
    for level in range(32):
        room = (shape(GOAL + BOX * 0.5**level * candidates) / (BOX * 0.5**level)).clamp(max=0.3)
        chosen.append(candidates[(room + 0.35 * candidates @ chosen[-1]).argmax()])
    return torch.stack(chosen[1:])


def view(directions: torch.Tensor, level: float, width: int, height: int, device: str):
    """Returns a camera at 2^-level of the box from PLACE, and a shader that draws a surface a
    quarter of a voxel outside of the bulb, where opacity changes smoothly: inside it is 1.
    """
    outward = torch.lerp(directions[int(level)], directions[int(level) + 1], level % 1)
    eye, up = GOAL + BOX * 0.5**level * normalize(outward, dim=0), torch.tensor([0, 0, 1]).double()
    sun = (-0.6 * outward - normalize(torch.linalg.cross(outward, up), dim=0) - 0.5 * up).float()
    sun = gv.DirectionalLight(sun.to(device), (1.5, 1.25, 0.9))
    options = {"color_channel": "rgba", "premultiplied": True, "ambient": 0.3, "specular": 0.15}
    shader = gv.Isosurface(0.25, None, light=sun, **options)
    shader.channel, shader.component = "rgba", 3
    return gv.Camera.look_at(eye, GOAL, fov=60, width=width, height=height), shader


def bulb_engine(iterations: int, device: str, **options) -> gv.Engine:
    """Returns an engine for the bulb; each iteration adds details that are an eighth as large."""
    solid = gv.Solid(gv.Mandelbulb(8, iterations=iterations, colors=COLORS), normals=False)
    producer = gv.FieldProducer(solid, 2**33, box=((-BOX / 2,) * 3, (BOX / 2,) * 3))
    return gv.Engine(producer, device=device, **options)


def main(settings: Settings) -> None:
    """Renders each stop, small before large: the small picture loads most of what is seen."""
    directions, pictures, scale = eye_directions(), [], settings.cone_scale
    haze = torch.tensor([0.16, 0.22, 0.3])
    for level in track((1.0, 7.0, 13.0, 20.0)):
        distance = BOX * 0.5**level
        light = gv.Lighting(shadows=0, occlusion=1.0, cones=3, reach=0.05 * distance)
        with bulb_engine(4 + int(level / 2), settings.device, load_budget=4096) as engine:
            for divisor, lighting in ((16, None), (2, light)):
                size = settings.size * 16 // 9 // divisor, settings.size // divisor
                camera, shader = view(directions, level, *size, engine.device)
                options = {"lighting": lighting, "cone_scale": 2 * scale / divisor}
                picture = engine.render(camera, shader, **options).to("cpu")
        transmittance = picture.alpha * torch.exp(-0.15 * picture.depth / distance)
        pictures.append(1.15 * transmittance * picture.color + (1 - transmittance) * haze)
    color = torch.cat([torch.cat(pictures[row : row + 2], 1) for row in (0, 2)])
    replace(picture, color=color).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
