"""Eight balls, each displaced and coloured by one noise of `gv.noise`."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

noise = gv.noise
SUN = gv.DirectionalLight((-0.75, -0.6, -0.6), (1.15, 1.05, 0.9))
SEA = [(0.01, 0.03, 0.12), (0.02, 0.25, 0.45), (0.45, 0.8, 0.8), (1.0, 0.95, 0.85)]
FIRE = [(0.06, 0.01, 0.02), (0.5, 0.05, 0.02), (1.0, 0.45, 0.05), (1.0, 0.95, 0.6)]
MOSS = [(0.03, 0.06, 0.03), (0.15, 0.28, 0.06), (0.55, 0.5, 0.25), (0.95, 0.92, 0.85)]
WALLS = partial(noise.cellular, feature="F2-F1")
#: Name: noise, cells per unit length, the values of the first and the last colour, colours.
BALLS = {
    "perlin": (noise.perlin, 5, (-0.6, 0.6), SEA),
    "simplex": (noise.simplex, 4, (-0.8, 0.8), SEA),
    "cells": (noise.cellular, 5, (0.85, 0.0), FIRE),
    "walls": (WALLS, 4, (0.0, 0.6), FIRE),
    "fbm": (noise.fbm, 2.5, (-0.6, 0.7), SEA),
    "ridged": (noise.ridged, 2, (0.3, 1.8), MOSS),
    "turbulence": (noise.turbulence, 2.5, (0.9, 0.0), FIRE),
    "warped fbm": (lambda p: noise.fbm(noise.warp(p, octaves=2)), 2, (-0.5, 0.6), MOSS),
}


class Ball(gv.Field):
    """Premultiplied colour and opacity of a ball that is displaced by noise."""

    def __init__(self, function, frequency, value_range, colors):
        super().__init__()
        self.noise, self.frequency, self.ends = function, frequency, value_range
        self.register_buffer("colors", torch.tensor(colors))
        self.prefiltered, self.threshold = True, {"rgba": 0.0}

    def filtered(self, points, size):
        """Evaluates noise in the middle of each voxel; the edge is three voxels wide."""
        values, (low, high) = self.noise(points * self.frequency), self.ends
        share = ((values - low) / (high - low)).clamp(0, 1)
        gap = 0.88 + 0.1 * share - points.norm(dim=-1)
        alpha = (0.5 + gap / (3 * size[..., 0])).clamp(0, 1)[..., None]
        row = share * (len(self.colors) - 1)
        first = row.long().clamp(max=len(self.colors) - 2)
        color = torch.lerp(self.colors[first], self.colors[first + 1], (row - first)[..., None])
        return {"rgba": torch.cat((color * alpha, alpha), -1)}

    def bounds(self, center, half):
        """Returns the least and greatest values: both are 0 beyond the radius 1."""
        near = (center.abs() - half).clamp(min=0).norm(dim=1, keepdim=True) < 1
        return {"rgba": (torch.zeros(len(near), 4).to(center), near.to(center).expand(-1, 4))}


@dataclass
class Settings:
    """Renders each ball, in two rows."""

    output: Path = Path("noise.png")
    size: int = 720
    device: str = "cpu"


def main(settings: Settings) -> None:
    camera = gv.Camera.orbit(25, 15, 1.85, 36, settings.size * 4 // 9, settings.size // 2)
    shading = {"light": SUN, "ambient": 0.25, "diffuse": 0.85, "specular": 0.1}
    shader = gv.StoredColor("rgba", premultiplied=True, lit=True, **shading)
    tiles, box = [], ((-1, -1, -1), (1, 1, 1))
    for ball in BALLS.values():
        engine = gv.Engine(gv.FieldProducer(Ball(*ball), 160, box=box), device=settings.device)
        tiles.append(engine.render(camera, shader, background=(0.02, 0.024, 0.032)))
    rows = [torch.cat([tile.color for tile in tiles[n : n + 4]], 1) for n in (0, 4)]
    replace(tiles[0], color=torch.cat(rows)).save(settings.output)
    print(f"{settings.output}: {', '.join(BALLS)}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
