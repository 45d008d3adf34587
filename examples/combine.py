"""Fields of fields: a gyroid that blends into noise along a ramp, masked by a ball, and warped."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SUN = gv.DirectionalLight((0.8, 1.0, -0.8), (1.3, 1.15, 0.95), angle=6)
LIGHT = gv.Lighting(lights=(SUN,), ambient=(0.5, 0.56, 0.68), occlusion=0.8, cones=5, reach=0.2)
WALL = gv.Gradient((0.06, 0.08, 0.12), (0.34, 0.36, 0.38))
HUES = [(0.55, 0.14, 0.05), (0.75, 0.5, 0.2), (0.3, 0.62, 0.5), (0.1, 0.36, 0.5)]
COLORS = gv.TransferFunction([(0, 1), (1, 1)], [(n / 3, *hue) for n, hue in enumerate(HUES)])
BOX = ((-1.3,) * 3, (1.3,) * 3)
VIEW = (-0.9, -3.3, 1.1), (0, 0, 0), (0, 0, 1), 35


class Function(torch.nn.Module):
    """A function of points and of submodules, which move to the engine's device with it."""

    def __init__(self, function: Callable[..., torch.Tensor], *parts: torch.nn.Module) -> None:
        super().__init__()
        self.function, self.parts = function, torch.nn.ModuleList(parts)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return self.function(points, *self.parts)


@dataclass
class Settings:
    """Renders the ball."""

    output: Path = Path("combine.png")
    size: int = 720  # height of the picture
    extent: int = 192
    device: str = "cpu"


def world() -> torch.nn.Module:
    """Returns a field of two channels: "shape", whose surface is at 1/2, and "side", its colour."""
    cells = gv.sdf.Shell(gv.sdf.Gyroid(0.55), 0.06)
    gyroid = Function(lambda p, shape: (0.5 - 12 * shape(p)).clamp(0, 1), cells)
    stone = Function(lambda p: (0.6 + 2 * gv.noise.fbm(1.8 * p, octaves=5, seed=3)).clamp(0, 1))
    ramp = Function(lambda p: (0.5 + 0.9 * p[..., 0] + 0.2 * p[..., 2]).clamp(0, 1))
    ball = Function(lambda p: (0.5 + 12 * (1 - p.norm(dim=-1))).clamp(0, 1))
    swirl = Function(lambda p: 0.12 * torch.sin(2.2 * p.roll(1, -1) + 0.7))
    shape = gv.warp(gv.mask(gv.blend(gyroid, stone, ramp), ball), swirl, max_offset=0.25)
    return gv.stack(shape=shape, side=ramp)


def main(settings: Settings) -> None:
    """Renders the picture."""
    producer = gv.FieldProducer(world(), settings.extent, box=BOX, samples=1)
    shader = gv.Isosurface(0.5, COLORS, color_channel="side")
    camera = gv.Camera.look_at(*VIEW, settings.size * 16 // 9, settings.size)
    with gv.Engine(producer, device=settings.device, brick_pool="512 MB") as engine:
        picture = engine.render(camera, shader, lighting=LIGHT, background=WALL)
    picture.save(settings.output)
    print(f"{settings.output}: {picture.stats.bricks_used} bricks")


if __name__ == "__main__":
    main(tyro.cli(Settings))
