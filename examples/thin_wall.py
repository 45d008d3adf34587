"""A wall two voxels thick, red in front and green behind, seen by cones 1, 8, 16 and 32 times as
wide as a pixel's. Above, coarse voxels are means; below, they hold six directions.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SIDE = 128  # voxels
RED, GREEN = (0.8, 0.06, 0.04, 1.0), (0.05, 0.5, 0.1, 1.0)
WIDER = (1, 8, 16, 32)  # times the pixel's cone


@dataclass
class Settings:
    """Renders the wall with cones of four widths, with and without directions."""

    output: Path = Path("thin_wall.png")
    size: int = 180
    device: str = "cpu"


def wall() -> gv.Volume:
    """Premultiplied colour and opacity of two sheets, one behind the other, with a window."""
    rgba = torch.zeros((SIDE, SIDE, SIDE, 4))  # z, y, x
    middle, low, high = SIDE // 2 + 2, SIDE // 8, SIDE - SIDE // 8
    for depth, color in ((middle, RED), (middle - 1, GREEN)):
        rgba[depth, low:high, low:high] = torch.tensor(color)
    window = slice(SIDE // 2, SIDE // 2 + SIDE // 5)
    rgba[middle - 1 : middle + 1, window, window] = 0
    return gv.Volume(rgba)


def main(settings: Settings) -> None:
    """Renders the grid."""
    volume = wall()
    shader = gv.StoredColor("value", premultiplied=True)
    rows = []
    for levels in (volume, volume.directional(premultiplied=True)):
        tree = gv.N3Tree.from_volume(levels, device=settings.device)
        camera = gv.Camera.orbit(35, 15, 2.0, width=settings.size, height=settings.size)
        pictures = [
            gv.render(tree, camera, shader, cone_scale=wider, background=(0.9, 0.95, 1.0))
            for wider in WIDER
        ]
        rows.append(torch.cat([picture.color for picture in pictures], dim=1))
    replace(pictures[-1], color=torch.cat(rows)).save(settings.output)
    print(f"{settings.output}: cones of {WIDER} times the pixel's")


if __name__ == "__main__":
    main(tyro.cli(Settings))
