"""One scene through four camera models: pinhole, orthographic, fisheye and panorama.

The first two look at the stent from outside, the other two from between its wires.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
SKY = gv.Gradient((0.06, 0.09, 0.15), (0.008, 0.008, 0.012))
OUTSIDE, AXIS = (-140.0, -190.0, 250.0), (66.0, 60.0, 132.0)
INSIDE, AHEAD, UP = (63.0, 62.0, 96.0), (63.0, 50.0, 150.0), (0.0, 0.0, 1.0)


@dataclass
class Settings:
    """Renders the bundled stent with four camera models."""

    output: Path = Path("cameras.png")
    size: int = 720
    samples: int = 3
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders the pinhole at the left; at the right orthographic and fisheye above a panorama."""
    tree = gv.N3Tree.from_volume(
        gv.read_volume(DATA / "stent_256x128x128_int16.npz"), device=settings.device
    )
    shader = gv.TransferFunction.from_json(DATA / "stent.json")
    height, lower = settings.size, settings.size * 4 // 9  # a panorama is twice as wide as high
    upper = height - lower
    views = [
        gv.Camera.look_at(OUTSIDE, AXIS, UP, 42, 2 * lower, height),
        gv.Camera.look_at(OUTSIDE, AXIS, UP, 48, 2 * lower - upper, upper, "ortho"),
        gv.Camera.look_at(INSIDE, AHEAD, (0, 1, 0), 180, upper, upper, "fisheye"),
        gv.Camera.look_at(INSIDE, AHEAD, (0, 1, 0), 180, 2 * lower, lower, "panorama"),
    ]
    render = partial(gv.render, tree, shader=gv.Lit(shader), background=SKY)
    pictures = [gv.Progressive(render).refine(view, settings.samples) for view in views]
    for view, picture in zip(views, pictures, strict=True):
        print(f"{view.model:9s} {picture.stats.samples:9d} samples")
    pinhole, ortho, fisheye, panorama = (picture.color for picture in pictures)
    right = torch.cat([torch.cat([ortho, fisheye], 1), panorama])
    replace(pictures[0], color=torch.cat([pinhole, right], 1)).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
