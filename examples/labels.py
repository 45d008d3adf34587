"""A ball of cells, cut open: 64-bit labels, each in its own colour, and one of them picked. A cell
is the region nearest to its nucleus, with gaps between cells; each nucleus has a label, too.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

FIRST_LABEL, NUCLEUS = 720_575_940_000_000_000, 1_000_000  # NUCLEUS: added to its cell's label
CELLS, REACH = 360, 0.2  # REACH: more than the radius of any cell, in sides of the box
GAP, RADIUS, CORE = 0.012, 0.47, 0.42  # in sides of the box; CORE relative to a cell's size
BONE, SKY = (0.86, 0.80, 0.66), gv.Gradient((0.030, 0.036, 0.052), (0.004, 0.005, 0.008))
SUN = gv.DirectionalLight((0.55, -1.0, -0.75), (1.25, 1.16, 1.0), angle=7)
LIGHT = gv.Lighting(ambient=(0.62, 0.72, 0.95), occlusion=0.9, reach=0.12, cones=5, frame="box")
CUT = gv.Clip(without=[((0.0, 0.0, 0.0), (0.6, 0.6, 0.6))], frame="box", caps=True, cap_light=0.0)


@dataclass
class Settings:
    """Renders a ball of cells."""

    output: Path = Path("labels.png")
    size: int = 720
    samples: int = 2
    side: int = 224
    device: str = "cpu"


def tissue(side: int) -> gv.Volume:
    """Returns side^3 int64 labels of cells that are spread evenly in a ball."""
    positions = torch.rand((40 * CELLS, 3), generator=torch.Generator().manual_seed(4)) - 0.5
    positions = positions[positions.norm(dim=1) < RADIUS]
    centres = positions[:CELLS]
    for _ in range(12):  # Lloyd: each centre moves to the mean of its neighbourhood
        nearest = torch.cdist(positions, centres).argmin(1)
        sums = torch.zeros_like(centres).index_add(0, nearest, positions)
        centres = sums / nearest.bincount(minlength=len(centres)).clamp(min=1)[:, None]
    size = torch.cdist(centres, centres).fill_diagonal_(torch.inf).min(1).values / 2  # of each cell
    near, far = torch.full((2, side, side, side), torch.inf)  # squared distances to two centres
    cell, other = torch.zeros((2, side, side, side), dtype=torch.int64)
    axis = (torch.arange(side) + 0.5) / side - 0.5
    for number, centre in enumerate(centres):
        low, high = (((centre.flip(0) + 0.5 + r) * side).int().clamp(0) for r in (-REACH, REACH))
        block = tuple(map(slice, low, high))  # of z, y, x
        z, y, x = ((axis[rows] - c) ** 2 for rows, c in zip(block, centre.flip(0), strict=True))
        d2, a, b = z[:, None, None] + y[:, None] + x, near[block], far[block]
        other[block] = torch.where(d2 < a, cell[block], other[block].where(d2 >= b, number))
        far[block] = torch.where(d2 < a, a, torch.minimum(d2, b))
        cell[block], near[block] = torch.where(d2 < a, number, cell[block]), d2.minimum(a)
    wall = (far - near) / 2 / (centres[cell] - centres[other]).norm(dim=-1)  # distance to it
    depth = RADIUS - sum(a**2 for a in torch.meshgrid(axis, axis, axis, indexing="ij")).sqrt()
    inside = (wall > GAP / 2) & (depth > -0.3 * wall.clamp(max=0.08))
    labels = FIRST_LABEL + cell + NUCLEUS * (near.sqrt() < CORE * size[cell])
    return gv.Volume(torch.where(inside, labels, 0), labels=True)


def main(settings: Settings) -> None:
    """Renders the cells, and prints which label is in the middle of the picture."""
    volume = tissue(settings.side)
    tree = gv.N3Tree.from_volume(volume, 10, border=3, device=settings.device)
    nuclei = [label for label in volume.label_values.tolist() if label >= FIRST_LABEL + NUCLEUS]
    shader = gv.Labels(
        dict.fromkeys(nuclei, BONE), light=SUN, ambient=0.55, diffuse=0.75, specular=0.12
    )
    camera = gv.Camera.orbit(38, 30, 1.95, 30, settings.size * 16 // 9, settings.size)
    options = {"shader": shader, "lighting": LIGHT, "clip": CUT, "background": SKY}
    picture = gv.Progressive(partial(gv.render, tree, **options)).refine(camera, settings.samples)
    middle = picture.label[settings.size // 2, settings.size * 8 // 9, 0]
    print(f"{len(volume.label_values) - 1} labels; in the middle: {middle}")
    picture.tone_map("aces", exposure=0.15).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
