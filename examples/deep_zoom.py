"""Four views into Menger's sponge, down to some billionths of its size: 3^21 cells a side, in a
pool of 24,000 bricks of 9^3. Cells of every size look alike, and so should the pictures."""

from dataclasses import replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv

LEVELS = (1.0, 6.5, 12.25, 17.3)
SUN = gv.DirectionalLight((-0.5, 0.35, -1), color=(1.5, 1.15, 0.75), angle=2)
SHADE = {"shadows": 0.85, "occlusion": 1.0, "ambient": (0.8, 0.9, 1.1), "cones": 8}
STONE = gv.Isosurface(0.5, color=(0.95, 0.72, 0.45), ambient=0.45, diffuse=0.9, specular=0.1)
HAZE = torch.tensor([0.78, 0.85, 0.92])


class Menger(gv.Producer):
    """The sponge in the unit cube: a voxel of any level is solid if it is a cell of the sponge.
    A brick is 9^3 cells, so that the base-3 digits of a voxel's index decide."""

    def classify(self, nodes):
        offsets = torch.cartesian_prod(*(torch.arange(-1, 2, device=nodes.loc.device),) * 3)
        x, y, z = (nodes.loc[:, None, :3] + offsets).unbind(2)  # a border reaches into neighbours
        occupied = solid(x, y, z, nodes.depth[:, None]).any(1)
        return torch.where(occupied, gv.Region.DATA, gv.Region.EMPTY)

    def fill(self, nodes):
        index = nodes.loc[:, :3, None] * 9 + nodes.layout.reach.to(nodes.loc.device)
        x, y, z = index[:, 0, None, None, :], index[:, 1, None, :, None], index[:, 2, :, None, None]
        return {"value": solid(x, y, z, nodes.depth[:, None, None, None] + 2).float()}


def solid(x, y, z, digits):
    """Returns which cells of a grid of 3^digits a side are solid: at no position two digits 1."""
    side = 3**digits
    filled = (torch.minimum(torch.minimum(x, y), z) >= 0) & (x < side) & (y < side) & (z < side)
    for _ in range(int(digits.max())):
        filled = filled & ((x % 3 == 1).int() + (y % 3 == 1).int() + (z % 3 == 1).int() < 2)
        x, y, z = x // 3, y // 3, z // 3
    return filled


def camera(level: float, size: int) -> gv.Camera:
    """Returns a camera in the hole of a cell of the grid 3^level, or on the way to the next."""
    whole = int(level)
    progress, target = 1.5 * (1 - 3 ** (whole - level)), torch.tensor([0.25, 0.75, 0.25]).double()
    eye = ((target * 3**whole).floor() + 0.5) / 3**whole
    step = (3 * progress - torch.tensor([2, 0, 1])).clamp(0, 1)  # corridors lie along the axes
    eye += step / 3 ** (whole + 1) * (target - eye).sign()
    aim = eye + (target - eye) * torch.tensor([0.3, 2.0, 0.6])
    return gv.Camera.look_at(eye, aim, (0, 0, 1), 75, size * 8 // 9, size // 2)


def picture(engine: gv.Engine, level: float, size: int) -> gv.Picture:
    """Renders a stop of the flight in sunlight, and in a haze that is thinner in larger views."""
    scale = 3.0**-level
    light = gv.Lighting(lights=[SUN], reach=0.25 * scale, **SHADE)
    for divisor, cone_scale in ((4, 0.9), (1, 4.5)):  # a small picture loads nearly all
        view = camera(level, size // divisor)
        frame = engine.render(view, STONE, lighting=light, cone_scale=cone_scale)
    clear = torch.exp(-frame.depth / (2.2 * scale)) * frame.alpha
    print(f"a view of 3^-{level:g}: {frame.stats}")
    return replace(frame, color=clear * frame.color + (1 - clear) * HAZE.to(clear))


def main(output: Path = Path("deep_zoom.png"), size: int = 720, device: str = "cpu") -> None:
    """Renders all stops with one pool."""
    sponge = Menger(9 * 3**19, box=((0, 0, 0), (1, 1, 1)), branching=3)
    options = {"brick_size": 9, "brick_pool": "128 MB", "load_budget": 4096}
    with gv.Engine(sponge, device=device, **options) as engine:
        tiles = [picture(engine, level, size) for level in LEVELS]
    rows = [torch.cat([tile.color for tile in tiles[first : first + 2]], 1) for first in (0, 2)]
    replace(tiles[0], color=torch.cat(rows)).save(output)
    print(output)


if __name__ == "__main__":
    tyro.cli(main)
