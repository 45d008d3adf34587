"""A ball of cells, cut open: labels of 64 bits, each in a colour of its own, and one picked.

Cells are the neighbourhoods of their nuclei, with a gap between them; a nucleus is a label, too.
The numbers are far beyond what float32 keeps apart.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

FIRST, NUCLEUS = 720_575_940_000_000_000, 1_000_000  # labels: of cells, and so much more of nuclei
CELLS, GAP, RADIUS, CORE = 360, 0.012, 0.47, 0.42  # of a box of side 1; CORE of a cell's own size
SKY = gv.Gradient((0.030, 0.036, 0.052), (0.004, 0.005, 0.008))
SUN = gv.DirectionalLight((0.55, -1.0, -0.75), (1.25, 1.16, 1.0), angle=7)
LIGHT = gv.Lighting(ambient=(0.62, 0.72, 0.95), occlusion=0.9, reach=0.12, cones=12, frame="box")
CUT = gv.Clip(without=[((0.0, 0.0, 0.0), (0.6, 0.6, 0.6))], frame="box", caps=True, cap_light=0.0)


@dataclass
class Settings:
    """Renders a ball of cells."""

    output: Path = Path("labels.png")
    size: int = 360
    samples: int = 4
    side: int = 144
    device: str = "cpu"


def tissue(side: int) -> gv.Volume:
    """Cells in a ball whose places were spread evenly, (side)^3 labels in int64."""
    random = torch.Generator().manual_seed(4)
    places = torch.rand((40 * CELLS, 3), generator=random) - 0.5
    places = places[places.norm(dim=1) < RADIUS]
    centre = places[:CELLS]
    for _ in range(12):  # Lloyd: each centre goes to the middle of its neighbourhood
        nearest = torch.cdist(places, centre).argmin(1)
        middle = torch.zeros_like(centre).index_add(0, nearest, places)
        centre = middle / nearest.bincount(minlength=len(centre)).clamp(min=1)[:, None]
    size = torch.cdist(centre, centre).fill_diagonal_(torch.inf).min(1).values / 2  # of each cell
    axis = (torch.arange(side) + 0.5) / side - 0.5
    label = torch.zeros((side, side, side), dtype=torch.int64)
    for plane, z in zip(label, axis, strict=True):
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        place = torch.stack((x, y, z.expand_as(x)), -1).flatten(0, 1)
        apart = torch.cdist(place, centre)
        near, cell = apart.min(1)
        far, other = apart.scatter_(1, cell[:, None], torch.inf).min(1)
        wall = (far**2 - near**2) / 2 / (centre[cell] - centre[other]).norm(dim=1)  # how far it is
        inside = (wall > GAP / 2) & (place.norm(dim=1) < RADIUS + 0.3 * wall.clamp(max=0.08))
        number = FIRST + cell + torch.where(near < CORE * size[cell], NUCLEUS, 0)
        plane[:] = torch.where(inside, number, 0).view(side, side)
    return gv.Volume(label, labels=True)


def main(settings: Settings) -> None:
    """Renders the cells, and tells which one lies in the middle of the picture."""
    volume = tissue(settings.side)
    tree = gv.N3Tree.from_volume(volume, 10, border=3, device=settings.device)
    nuclei = volume.label_values[volume.label_values >= FIRST + NUCLEUS]
    colors = dict.fromkeys(nuclei.tolist(), (0.86, 0.80, 0.66))
    shader = gv.Labels(colors, light=SUN, ambient=0.55, diffuse=0.75, specular=0.12)
    camera = gv.Camera.orbit(38, 30, 1.95, 30, settings.size * 16 // 9, settings.size)
    options = {"shader": shader, "lighting": LIGHT, "clip": CUT, "background": SKY}
    show = gv.Progressive(partial(gv.render, tree, **options))
    picture = show.refine(camera, settings.samples)
    middle = picture.label[settings.size // 2, settings.size * 8 // 9, 0]
    print(f"{len(volume.label_values) - 1} labels; in the middle: {middle}")
    picture.tone_map("aces", exposure=0.15).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
