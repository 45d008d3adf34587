"""One scan, fused shaders. From left to right, above: plain, lit, isosurface, maximum; below: a
thin shell by the plain function at step 1, the same pre-integrated, plain at step 0.02; the mean.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
EYE, TARGET, UP = (-230.0, -330.0, 170.0), (63.5, 63.5, 127.5), (0.0, 0.0, 1.0)
BONE = 290.0  # aorta, bones and the stent
SHELL = gv.TransferFunction.from_points(  # a skin thinner than a step's change of value
    opacity=[(240, 0), (244, 0.98), (252, 0.98), (256, 0)],
    color=[(240, 0.9, 0.3, 0.15), (256, 1.0, 0.8, 0.5)],
)


@dataclass
class Settings:
    """Renders the bundled stent with each shader."""

    output: Path = Path("shaders.png")
    size: int = 240
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Renders the grid."""
    volume = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    tree = gv.N3Tree.from_volume(volume, device=settings.device)
    transfer = gv.TransferFunction.from_json(DATA / "stent.json")
    white = gv.TransferFunction.preset("gray", 100, 1000)
    sun = gv.DirectionalLight((0.6, 1.0, -0.7))
    camera = gv.Camera.look_at(EYE, TARGET, UP, fov=28, width=settings.size, height=settings.size)
    rows = (
        (
            (transfer, 0.5),
            (gv.Lit(transfer, light=sun, ambient=0.3), 0.5),
            (gv.Isosurface(BONE, (0.9, 0.8, 0.65), light=sun), 0.5),
            (gv.Projection("maximum", white), 0.5),
        ),
        (
            (SHELL, 1.0),
            (gv.PreIntegrated(SHELL), 1.0),
            (SHELL, 0.02),
            (gv.Projection("mean", gv.TransferFunction.preset("gray", 40, 300)), 0.5),
        ),
    )
    images = []
    for row in rows:
        pictures = [gv.render(tree, camera, s, step=step, lod="finest") for s, step in row]
        images.append(torch.cat([picture.color for picture in pictures], dim=1))
    replace(pictures[-1], color=torch.cat(images)).save(settings.output)
    print(f"{settings.output}: {sum(map(len, rows))} pictures")


if __name__ == "__main__":
    main(tyro.cli(Settings))
