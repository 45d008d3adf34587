"""A flight at a place on the Mandelbulb's surface, from the whole bulb to 10^-9 of it, on the way
that has the most room. 2^33 voxels a side; a pool of fixed size holds what a picture needs.
"""

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro
from rich.progress import track

import gvtorch as gv

BOX = 2.4  # world units along a side
PLACES = (1.0, 6.0, 10.0, 15.0, 20.0, 24.0)  # of the six pictures: 2^-n of the box away
WAY = torch.nn.functional.normalize(torch.tensor([0.5, 0.32, 0.81]).double(), dim=0)
COLORS = ((1.0, 0.8, 0.45), (0.75, 0.22, 0.12), (0.1, 0.18, 0.35))  # of three orbit traps
HAZE = torch.tensor([0.30, 0.36, 0.46])


@dataclass
class Settings:
    """Writes six places of the flight, side by side, and a film if it has frames."""

    output: Path = Path("mandelbulb_zoom.png")
    size: int = 320
    cone_scale: float = 2.0  # pixels that a voxel is wide: below 1 it is as sharp as it gets
    film: Path = Path("mandelbulb_zoom.mp4")
    frames: int = 0
    budget: int = 4096  # most bricks a frame
    device: str = "cpu"


def plan(shape: gv.Mandelbulb) -> tuple[torch.Tensor, torch.Tensor]:
    """The place where a line from outside meets the bulb, and by level the eye's direction."""
    outside, inside = 1.3, 0.2
    for _ in range(6):  # to 10^-16
        along = torch.linspace(outside, inside, 2001, dtype=torch.float64)
        first = int((shape(along[:, None] * WAY) < 0).nonzero()[0])
        outside, inside = float(along[first - 1]), float(along[first])
    random = torch.Generator().manual_seed(0)
    ways = torch.nn.functional.normalize(torch.randn((2000, 3), generator=random).double())
    place, chosen = outside * WAY, [WAY]
    for level in range(32):
        far = BOX * 0.5**level
        room = (shape(place + far * ways) / far).clamp(max=0.3)
        chosen.append(ways[(room + 0.35 * ways @ chosen[-1]).argmax()])
    return place, torch.stack(chosen[1:])


def look(place: torch.Tensor, ways: torch.Tensor, level: float, width: int, height: int):
    """The camera 2^-level of the box away from the place, and how its sun shines."""
    way = torch.lerp(ways[int(level)], ways[int(level) + 1], level % 1)
    eye, up = place + BOX * 0.5**level * way / way.norm(), torch.tensor([0.0, 0.0, 1.0]).double()
    sun = -way - 0.9 * torch.nn.functional.normalize(torch.linalg.cross(way, up), dim=0) - 0.5 * up
    return gv.Camera.look_at(eye, place, fov=60, width=width, height=height), sun.float()


def stone(sun: torch.Tensor) -> gv.Shader:
    """The surface, which is where the opacity is a half, in its own colours."""
    light = gv.DirectionalLight(sun, (1.5, 1.25, 0.9), angle=4)
    painted = {"color_channel": "rgba", "premultiplied": True, "light": light, "ambient": 0.35}
    shader = gv.Isosurface(0.5, None, **painted)
    shader.channel, shader.component = "rgba", 3
    return shader


def opened(shape: gv.Mandelbulb, settings: Settings, **options) -> gv.Engine:
    """An engine for it, with a pool of fixed size."""
    solid, box = gv.Solid(shape, normals=False), ((-BOX / 2,) * 3, (BOX / 2,) * 3)
    producer = gv.FieldProducer(solid, 2**33, box=box)
    return gv.Engine(producer, device=settings.device, load_budget=settings.budget, **options)


def fly(engine: gv.Engine, route: tuple[torch.Tensor, torch.Tensor], settings: Settings) -> None:
    """Films 2^-4 to 2^-30 of the box, loaded level by level; on a GPU it is flown live."""
    size, took = (settings.size * 16 // 9 // 2 * 2, settings.size), []
    options, (camera, way) = {"cone_scale": settings.cone_scale}, look(*route, 4.0, *size)
    shader = stone(sun := way.to(engine.device))
    engine.render(camera, shader, **options)  # where it begins
    draw = partial(engine.frame, shader=shader, **options)
    if engine.device.type == "cuda":
        draw = engine.capture(camera, shader, batch=settings.budget, fit=True, **options).replay
    with gv.Video(settings.film, *size, fps=30) as film:
        for level in track(torch.linspace(4, 30, settings.frames).tolist()):
            camera, way = look(*route, level, *size)
            began = time.perf_counter()
            sun.copy_(way)
            picture, stats = draw(camera)
            stats.settle()  # waits for the device
            took.append(1e3 * (time.perf_counter() - began))
            film.add(picture)
    late, middle = sum(one > 1e3 / 30 for one in took), sorted(took)[len(took) // 2]
    print(f"{len(took)} frames: {middle:.1f} ms, at most {max(took):.1f}; {late} over 1/30 s")


def main(settings: Settings) -> None:
    """Flies there, then renders the six places."""
    finest = gv.Mandelbulb(8, iterations=20, colors=COLORS)
    route, scale = plan(finest), settings.cone_scale
    if settings.frames:
        with opened(finest, settings, brick_pool="512 MB", loading="levels") as engine:
            fly(engine, route, settings)
    pictures, size = [], (settings.size * 16 // 27 + 1, settings.size // 2)
    for level in track(PLACES):
        # Each iteration adds details an eighth as large; those finer than pixels would be noise.
        shape = gv.Mandelbulb(8, iterations=4 + int(level / 2), colors=COLORS)
        camera, sun = look(*route, level, *size)
        small, _ = look(*route, level, size[0] // 4, size[1] // 4)
        shader = stone(sun.to(settings.device))
        with opened(shape, settings) as engine:
            engine.render(small, shader, cone_scale=scale / 4)  # loads most of what is seen
            light = gv.Lighting(shadows=0, occlusion=1.0, reach=0.1 * BOX * 0.5**level)
            lit = engine.render(camera, shader, lighting=light, cone_scale=scale).to("cpu")
        clear = lit.alpha * torch.exp(-0.15 * lit.depth / (BOX * 0.5**level))
        pictures.append(replace(lit, color=1.15 * clear * lit.color + (1 - clear) * HAZE))
    both = {}
    for name in ("color", "alpha"):
        six = [getattr(one, name) for one in pictures]
        both[name] = torch.cat([torch.cat(six[row : row + 3], 1) for row in (0, 3)])
    replace(pictures[0], **both).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
