"""Cells as a fluorescence microscope sees them: four channels, each in its colour and window."""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor, rand
from torch.nn.functional import conv3d, interpolate, normalize

import gvtorch as gv

X, Y, Z, FIBRES = 576, 384, 56, 40  # voxels; fibres of each kind in each of 20 cells
LOOKS = [  # as `omero` metadata would specify them
    gv.ChannelLook(name="nuclei", color="#4f80ff", window=(10, 200), opacity=0.22),
    gv.ChannelLook(name="actin", color="#ff2560", window=(15, 220), opacity=0.3),
    gv.ChannelLook(name="microtubules", color="#20ff9a", window=(15, 230), opacity=0.35),
    gv.ChannelLook(name="mitochondria", color="#ffb02a", window=(10, 190), opacity=0.5),
]


@dataclass
class Settings:
    """Makes the cells and renders them."""

    output: Path = Path("channels.png")
    size: int = 720
    device: str = "cpu"


def fibres(start: Tensor, aim: Tensor, steps: int, curl: float, blur: float, top: Tensor) -> Tensor:
    """Returns (z, y, x) winding fibres from `start` (k, 3): x, y, fraction of cell height."""
    spots = torch.zeros(1, 1, Z, Y, X)
    for _ in range(steps):
        aim = normalize(aim + curl * (rand(aim.shape) - 0.5), dim=1)
        start = start + aim * torch.tensor([0.7, 0.7, 0.01])
        x, y = (start[:, i].long().clamp(0, n - 1) for i, n in enumerate((X, Y)))
        z = 3 + start[:, 2].clamp(0.02, 0.95) * top[y, x]
        spots[0, 0, z.long(), y, x] = top[y, x].clamp(0, 1)
    for shape in ((9, 1, 1), (1, 9, 1), (1, 1, 9)):
        kernel = torch.exp(-((torch.arange(-4, 5) / blur) ** 2)).reshape(1, 1, *shape)
        spots = conv3d(spots, kernel, padding=[n // 2 for n in shape])
    return spots[0, 0] / 2


def cells() -> Tensor:
    """Returns (z, y, x, 4) nuclei, actin, microtubules and mitochondria."""
    row, column = torch.arange(20) // 5, torch.arange(20) % 5
    centres = torch.stack((128.0 * column + 60 * (row % 2) - 22, 112.0 * row - 6, 0 * row + 0.5), 1)
    centres, angles = centres + rand(20, 3) * torch.tensor([44, 44, 0]), 3.14 * rand(20, 1, 1)
    z, y, x = torch.meshgrid(*(torch.arange(n).float() for n in (Z, Y, X)), indexing="ij")
    u, v = (p[0] - centres[:, i, None, None] for i, p in enumerate((x, y)))
    u, v = u * angles.cos() + v * angles.sin(), v * angles.cos() - u * angles.sin()
    wobble = 0.5 * interpolate(rand(1, 1, 9, 14), (Y, X), mode="bicubic")[0, 0]
    distance = (((u / 92) ** 2 + (v / 62) ** 2).sqrt() + wobble).amin(0)
    top = (6 + 36 * torch.exp(-((distance / 0.7) ** 2))) * ((1.2 - distance) * 9).clamp(0, 1)
    noise = interpolate(rand(1, 1, 16, 64, 64), (Z, Y, X), mode="trilinear")[0, 0]
    core = ((u / 26) ** 2 + (v / 18) ** 2).amin(0) + ((z - 17) / 12) ** 2  # nuclei: below 1
    starts, aims = centres.repeat(FIBRES, 1), rand(20 * FIBRES, 3) - 0.5
    axes = torch.stack((angles.cos(), angles.sin(), 0 * angles), 1)[:, :, 0, 0].repeat(FIBRES, 1)
    near, wide = (starts + (rand(aims.shape) - 0.5) * torch.tensor([s, s, 0.7]) for s in (24, 104))
    actin = fibres(wide * torch.tensor([1, 1, 0.08]) - 52 * axes, axes, 150, 0.03, 1.1, top)
    tubes = fibres(near, aims, 170, 0.2, 1.1, top) * (core > 1)
    mitochondria = fibres(wide, aims, 18, 0.7, 1.35, top) * (core > 1.1)
    nuclei = ((1 - core) * 6).clamp(0, 1) * (0.3 + 0.9 * noise**2)
    return torch.stack((nuclei, actin, tubes, mitochondria), -1).clamp(0, 1)


def main(settings: Settings) -> None:
    """Renders the cells."""
    torch.manual_seed(12)
    tree = gv.N3Tree.from_volume(gv.Volume((cells() * 255).byte()), 16, device=settings.device)
    camera = gv.Camera.orbit(8, -44, 0.7, 32, settings.size * 16 // 9, settings.size)
    picture = gv.render(tree, camera, gv.Channels(LOOKS), background=(0.001, 0.001, 0.004))
    picture.save(settings.output)
    print(f"{settings.output}: {len(LOOKS)} channels, {picture.stats.milliseconds:.0f} ms")


if __name__ == "__main__":
    main(tyro.cli(Settings))
