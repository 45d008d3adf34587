"""A region of interest: a scan, cut open by a box, without and with caps on the cut."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
EYE, TARGET, UP = (-230.0, -190.0, 300.0), (63.5, 63.5, 120.0), (0.0, 0.0, 1.0)
OPACITY = [(0, 0.5), (200, 0.9)]  # of everything, air included: a block
COLOR = [
    *((0, 0.16, 0.1, 0.08), (60, 0.5, 0.3, 0.2), (130, 0.75, 0.3, 0.2)),
    *((220, 0.95, 0.75, 0.45), (400, 1, 0.95, 0.85), (1000, 0.55, 0.75, 1)),
]
CUT = ((-1, -1, 130), (62, 62, 260))  # low and high corner, world units


@dataclass
class Settings:
    """Renders the bundled stent: whole, cut, and cut with caps."""

    output: Path = Path("clip.png")
    size: int = 320
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders three pictures, side by side."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    shader = gv.TransferFunction.from_points(OPACITY, COLOR)
    camera = gv.Camera.look_at(EYE, TARGET, UP, 32, settings.size, settings.size)
    clips = [None, gv.Clip(without=[CUT]), gv.Clip(without=[CUT], caps=True, cap_light=0.4)]
    pictures = [gv.render(tree, camera, shader, clip=clip) for clip in clips]
    for picture in pictures:
        print(f"{picture.stats.samples} samples of {picture.stats.bricks_used} bricks")
    names = ("color", "alpha", "depth", "samples")
    images = {name: torch.stack([getattr(one, name) for one in pictures]) for name in names}
    replace(pictures[0], **images).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
