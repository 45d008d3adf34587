"""A region of interest: a scan cut in half. An isosurface is hollow; caps close it, and coloured
by the scan they look like a slice of it.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
EYE, TARGET, UP = (-280.0, -200.0, 190.0), (66.0, 60.0, 132.0), (0.0, 0.0, 1.0)
LEVEL = 160.0  # bone, and blood with contrast agent
CUT = (1.0, 0.0, 0.0, -72.0)  # keeps the side where x >= 72
SUN = gv.DirectionalLight((0.5, 1.0, -0.8), (1.2, 1.1, 0.95))
SKY = gv.Gradient((0.06, 0.08, 0.12), (0.012, 0.014, 0.02))
COLOR = [
    *((160, 0.85, 0.6, 0.42), (200, 0.9, 0.75, 0.6), (320, 0.5, 0.15, 0.08)),
    *((600, 1.0, 0.8, 0.5), (1200, 0.6, 0.75, 1.0)),
]


@dataclass
class Settings:
    """Renders the bundled stent: whole, cut, and with caps."""

    output: Path = Path("clip.png")
    size: int = 720
    samples: int = 8
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders three pictures, side by side."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    colors = gv.TransferFunction.from_points([(0, 1)], COLOR)
    shader = gv.Isosurface(LEVEL, colors, color_channel="value", light=SUN, ambient=0.25)
    size = (-(-settings.size * 16 // 27), settings.size)  # a third of 16:9
    camera = gv.Camera.look_at(EYE, TARGET, UP, 32, *size)
    render = partial(gv.render, tree, shader=shader, background=SKY)
    clips = [None, gv.Clip(planes=[CUT]), gv.Clip(planes=[CUT], caps=True, cap_light=0.3)]
    pictures = []
    for clip in clips:
        pictures.append(gv.Progressive(partial(render, clip=clip)).refine(camera, settings.samples))
        print(f"{pictures[-1].stats.samples} samples of {pictures[-1].stats.bricks_used} bricks")
    color = torch.cat([picture.color for picture in pictures], dim=1)
    replace(pictures[0], color=color).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
