"""A flight into Menger's sponge, down to a billionth of its size, and back.

Its finest level has 3^21 cells a side; the pool has room for 24,000 bricks of 9^3. Cells of
every size look alike, and so should the pictures. Writes four of them, side by side.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import gvtorch as gv


class Menger(gv.Producer):
    """The sponge in the unit cube: a voxel of any level is solid if it is a cell of the sponge."""

    def __init__(self, depth: int) -> None:
        """Each brick is 9^3 cells, so that digits in base 3 tell all."""
        super().__init__(9 * 3**depth, box=((0, 0, 0), (1, 1, 1)), branching=3)

    def classify(self, nodes):
        beside = torch.cartesian_prod(*(torch.arange(-1, 2, device=nodes.loc.device),) * 3)
        x, y, z = (nodes.loc[:, None, :3] + beside).unbind(2)  # a border reaches into neighbours
        seen = solid(x, y, z, nodes.depth[:, None]).any(1)
        return torch.where(seen, gv.Region.DATA, gv.Region.EMPTY)

    def fill(self, nodes):
        reach = nodes.layout.reach.to(nodes.loc.device)
        x, y, z = (nodes.loc[:, axis, None] * 9 + reach for axis in range(3))
        cells = x[:, None, None, :], y[:, None, :, None], z[:, :, None, None]
        return {"value": solid(*cells, nodes.depth[:, None, None, None] + 2).float()}


def solid(x, y, z, digits):
    """Whether cells of a grid of 3^digits a side are the sponge's: nowhere are two digits 1."""
    side = 3**digits
    found = (torch.minimum(torch.minimum(x, y), z) >= 0) & (x < side) & (y < side) & (z < side)
    for _ in range(21):
        found = found & ((x % 3 == 1).int() + (y % 3 == 1).int() + (z % 3 == 1).int() < 2)
        x, y, z = x // 3, y // 3, z // 3
    return found


def camera(level: float, size: int) -> gv.Camera:
    """Stands in the hole of a cell of the grid 3^level, or in a corridor to the next smaller one,
    on its way to (1/4, 3/4, 1/4), which lies in the sponge: all its digits are 0 or 2.
    """
    whole = int(level)
    cell, part = 3.0**-whole, 1.5 * (1 - 3 ** (whole - level))
    target = (0.25, 0.75, 0.25)
    eye = [(int(4 * t) * 3**whole // 4 + 0.5) * cell for t in target]
    ahead = [t - e for t, e in zip(target, eye, strict=True)]
    for number, axis in enumerate((1, 2, 0)):  # corridors lie along the axes
        way = min(max(3 * part - number, 0), 1)
        eye[axis] += way * cell / 3 * (1 if ahead[axis] > 0 else -1)
    ahead = [t - e for t, e in zip(target, eye, strict=True)]
    aim = [e + a * f for e, a, f in zip(eye, ahead, (0.3, 2.0, 0.6), strict=True)]
    return gv.Camera.look_at(eye, aim, up=(0, 0, 1), fov=75, width=size, height=size)


def picture(engine: gv.Engine, level: float, size: int) -> gv.Picture:
    """A place of the flight in the sun, and in a haze as thin as the place is large."""
    near = 3.0**-level
    light = gv.Lighting(
        lights=[gv.DirectionalLight((-0.5, 0.35, -1), color=(1.5, 1.15, 0.75), angle=2)],
        shadows=0.85,
        occlusion=1.0,
        ambient=(0.8, 0.9, 1.1),
        reach=0.25 * near,
    )
    stone = gv.Isosurface(0.5, color=(0.95, 0.72, 0.45), ambient=0.45, diffuse=0.9, specular=0.1)
    found = engine.render(camera(level, size), stone, lighting=light, cone_scale=4.0)
    clear = torch.exp(-found.depth / (2.2 * near)) * found.alpha
    haze = torch.tensor([0.78, 0.85, 0.92], device=clear.device)
    print(f"a view of 3^-{level:g}: {found.stats}")
    return replace(found, color=clear * found.color + (1 - clear) * haze)


@dataclass
class Settings:
    """What to fly."""

    output: Path = Path("deep_zoom.png")
    size: int = 256
    frames: int = 24
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Flies there and back, then renders four places."""
    look, size = gv.Isosurface(0.5), settings.size
    with gv.Engine(Menger(19), brick_size=9, brick_pool="128 MB", device=settings.device) as engine:
        began = time.perf_counter()
        for number in range(settings.frames):
            level = 17.9 * (1 - abs(2 * number / settings.frames - 1))
            engine.frame(camera(level, size), look, cone_scale=4.0)
        each = 1e3 * (time.perf_counter() - began) / settings.frames
        print(f"{settings.frames} frames, {each:.0f} ms each")
        pictures = [picture(engine, level, size) for level in (1.0, 6.5, 12.25, 17.3)]
    whole = {
        name: torch.cat([getattr(p, name) for p in pictures], 1) for name in ("color", "alpha")
    }
    replace(pictures[0], **whole).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
