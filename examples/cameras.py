"""One scene through four camera models: pinhole, orthographic, fisheye and panorama.

The first two look at the stent from outside, the other two from between its wires.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
SKY = gv.Gradient((0.10, 0.14, 0.22), (0.01, 0.01, 0.015))
OUTSIDE, AXIS = (-260.0, -340.0, 190.0), (63.5, 63.5, 127.5)
INSIDE, AHEAD, UP = (63.0, 62.0, 96.0), (63.0, 50.0, 150.0), (0.0, 0.0, 1.0)


@dataclass
class Settings:
    """Renders the bundled stent with four camera models."""

    output: Path = Path("cameras.png")
    size: int = 250
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders all at the same height, side by side."""
    tree = gv.N3Tree.from_volume(
        gv.read_volume(DATA / "stent_256x128x128_int16.npz"), device=settings.device
    )
    shader = gv.TransferFunction.from_json(DATA / "stent.json")
    size = settings.size
    views = [
        gv.Camera.look_at(OUTSIDE, AXIS, UP, 32, size * 2 // 3, size),
        gv.Camera.look_at(OUTSIDE, AXIS, UP, 32, size * 2 // 3, size, "ortho"),
        gv.Camera.look_at(INSIDE, AHEAD, (0, 1, 0), 180, size, size, "fisheye"),
        gv.Camera.look_at(INSIDE, AHEAD, (0, 1, 0), 180, size * 2, size, "panorama"),
    ]
    pictures = [gv.render(tree, view, shader, background=SKY) for view in views]
    for view, picture in zip(views, pictures, strict=True):
        print(f"{view.model:9s} {picture.stats.samples:9d} samples")
    whole = {
        name: torch.cat([getattr(picture, name) for picture in pictures], 1)
        for name in ("color", "alpha", "depth", "samples")
    }
    replace(pictures[0], **whole).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
