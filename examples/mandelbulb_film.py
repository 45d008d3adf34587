"""A film of a flight to the Mandelbulb's surface, from a distance of 2^-4 to 2^-30 of the box. On a
GPU each frame is one replay of a captured CUDA graph, in a pool of fixed size.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro
from mandelbulb_zoom import bulb_engine, eye_directions, view
from rich.progress import track

import gvtorch as gv


@dataclass
class Settings:
    """Films the flight, and saves its last picture."""

    output: Path = Path("mandelbulb_film.png")
    film: Path = Path("mandelbulb_film.mp4")
    size: int = 360
    frames: int = 600
    cone_scale: float = 2.0  # width of a voxel in pixels
    budget: int = 4096  # bricks per frame, at most
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Loads the first view level by level, so that every ray finds a brick, then flies."""
    directions, times = eye_directions(), []
    size = settings.size * 16 // 9 // 2 * 2, settings.size
    pools = {"brick_pool": "512 MB", "load_budget": settings.budget, "loading": "levels"}
    with (
        bulb_engine(20, settings.device, **pools) as engine,
        gv.Video(settings.film, *size, fps=30) as film,
    ):
        camera, shader = view(directions, 4.0, *size, engine.device)
        options = {"cone_scale": settings.cone_scale}
        engine.render(camera, shader, **options)  # loads the first view
        draw = partial(engine.frame, shader=shader, **options)
        if engine.device.type == "cuda":
            draw = engine.capture(camera, shader, batch=settings.budget, fit=True, **options).replay
        for level in track(torch.linspace(4, 30, settings.frames).tolist()):
            camera, next_shader = view(directions, level, *size, engine.device)
            start = time.perf_counter()
            shader.light.direction.copy_(next_shader.light.direction)
            picture, stats = draw(camera)
            stats.settle()  # waits for the device
            times.append(1e3 * (time.perf_counter() - start))
            film.add(picture)
        picture.save(settings.output)
    late, median = sum(ms > 1e3 / 30 for ms in times), sorted(times)[len(times) // 2]
    print(f"{len(times)} frames: {median:.1f} ms, at most {max(times):.1f}; {late} over 1/30 s")
    print(f"{settings.film}, {settings.output}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
