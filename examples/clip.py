"""A region of interest: a scan cut in half. An isosurface is hollow; caps close it, and coloured
by the scan they look like a slice of it.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
EYE, TARGET, UP = (-230.0, -170.0, 210.0), (64.0, 62.0, 138.0), (0.0, 0.0, 1.0)
LEVEL = 160.0  # bone, and blood with contrast agent
CUT = (1.0, 0.0, 0.0, -72.0)  # keeps where x >= 72
COLOR = [
    *((160, 0.85, 0.6, 0.42), (200, 0.9, 0.75, 0.6), (320, 0.5, 0.15, 0.08)),
    *((600, 1.0, 0.8, 0.5), (1200, 0.6, 0.75, 1.0)),
]


@dataclass
class Settings:
    """Renders the bundled stent: whole, cut, and with caps."""

    output: Path = Path("clip.png")
    size: int = 320
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders three pictures, side by side."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    colors = gv.TransferFunction.from_points([(0, 1)], COLOR)
    shader = gv.Isosurface(LEVEL, colors, color_channel="value")
    camera = gv.Camera.look_at(EYE, TARGET, UP, 27, settings.size, settings.size)
    clips = [None, gv.Clip(planes=[CUT]), gv.Clip(planes=[CUT], caps=True, cap_light=0.3)]
    sky = (0.6, 0.66, 0.75)
    pictures = [gv.render(tree, camera, shader, clip=clip, background=sky) for clip in clips]
    for picture in pictures:
        print(f"{picture.stats.samples} samples of {picture.stats.bricks_used} bricks")
    names = ("color", "alpha", "depth", "samples")
    images = {name: torch.stack([getattr(one, name) for one in pictures]) for name in names}
    replace(pictures[0], **images).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
