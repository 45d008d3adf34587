"""A wall two voxels thick, red in front and green behind, seen by cones 1, 8, 16 and 32 times as
wide as a pixel's. Above, coarse voxels are means; below, they hold six directions.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SIDE = 128  # voxels
RED, GREEN = torch.tensor([(0.7, 0.05, 0.03, 1.0), (0.02, 0.4, 0.2, 1.0)])
CONE_SCALES = (1, 8, 16, 32)  # times the pixel's cone
SKY = gv.Gradient((0.3, 0.5, 0.8), (0.95, 0.85, 0.75))


@dataclass
class Settings:
    """Renders the wall with cones of four widths, with and without directions."""

    output: Path = Path("thin_wall.png")
    size: int = 720
    samples: int = 4
    device: str = "cpu"


def wall() -> gv.Volume:
    """Returns premultiplied colour and opacity of two disks with windows, one behind the other."""
    y, x = torch.meshgrid(*(torch.arange(SIDE) - (SIDE - 1) / 2,) * 2, indexing="ij")
    radius, angle = torch.hypot(x, y), torch.atan2(y, x)
    petal = torch.remainder(angle, torch.pi / 4) - torch.pi / 8
    petal = torch.hypot((radius * petal.cos() - 36) / 1.5, radius * petal.sin()) - 9.5
    gap = torch.stack((radius - 56, 12 - radius, -petal)).amax(0)
    share = (0.5 - gap / 1.5).clamp(0, 1)[..., None]  # edges are soft
    rgba = torch.zeros((SIDE, SIDE, SIDE, 4))  # z, y, x
    rgba[SIDE // 2 + 2], rgba[SIDE // 2 + 1] = share * RED, share * GREEN
    return gv.Volume(rgba)


def main(settings: Settings) -> None:
    """Renders the grid."""
    volume, rows = wall(), []
    shader = gv.StoredColor("value", premultiplied=True)
    camera = gv.Camera.orbit(38, 12, 1.72, 34, settings.size * 4 // 9, settings.size // 2)
    for levels in (volume, volume.directional(premultiplied=True)):
        tree = gv.N3Tree.from_volume(levels, device=settings.device)
        render = partial(gv.render, tree, shader=shader, background=SKY)
        means = [gv.Progressive(partial(render, cone_scale=scale)) for scale in CONE_SCALES]
        pictures = [mean.refine(camera, settings.samples) for mean in means]
        rows.append(torch.cat([picture.color for picture in pictures], dim=1))
    replace(pictures[-1], color=torch.cat(rows)).save(settings.output)
    print(f"{settings.output}: cones of {CONE_SCALES} times the pixel's")


if __name__ == "__main__":
    main(tyro.cli(Settings))
