"""Depth of field: a lens of three apertures, and the mean of 256 pinhole pictures from all over
the widest.

Voxels hold the colour and opacity that the transfer function gives them, so that a wide cone
reads the mean of what is seen, not the colour of a mean density. The pinholes take minutes on a
CPU.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from kornia.metrics import ssim

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
OPACITY = [(20, 0), (60, 0.04), (255, 0.25)]
COLOR = [(20, 0.6, 0.1, 0.05), (120, 0.9, 0.5, 0.3), (255, 1, 1, 0.8)]
FOCUS, APERTURES = 1.3, (0.05, 0.1, 0.2)  # largest sides of the box
PINHOLES = 256


@dataclass
class Settings:
    """Renders the bundled aneurism."""

    output: Path = Path("depth_of_field.png")
    size: int = 192
    device: str = "cpu"


def seen(volume: gv.Volume, function: gv.TransferFunction) -> gv.Volume:
    """Premultiplied colour and opacity of every voxel."""
    rgba = torch.from_numpy(function(volume.data[..., 0].numpy()))
    rgba[..., :3] *= rgba[..., 3:]
    return gv.Volume(rgba.half(), spacing=volume.spacing, origin=volume.origin)


def thin_lens(tree: gv.N3Tree, camera: gv.Camera, shader: gv.StoredColor, aperture: float):
    """(h, w, 3) mean colour of rays from all over the lens through each pixel's point in focus."""
    placed = camera.placed(tree.box)
    rays, side = placed.rays(tree.device), float((tree.box[1] - tree.box[0]).max())
    right, down = placed.viewmats[0, :2, :3].to(tree.device)
    sharp, total = rays.origin + FOCUS * side * rays.direction, torch.zeros_like(rays.origin)
    for number in range(PINHOLES):
        radius = side * aperture / 2 * math.sqrt((number + 0.5) / PINHOLES)
        turn = number * math.pi * (3 - math.sqrt(5))
        origin = rays.origin + radius * (math.cos(turn) * right + math.sin(turn) * down)
        direction = torch.nn.functional.normalize(sharp - origin)
        total += gv.trace(tree, replace(rays, origin=origin, direction=direction), shader).color
    return (total / PINHOLES).reshape(camera.height, camera.width, 3).float()


def main(settings: Settings) -> None:
    """Renders four pictures, side by side, and prints the SSIM of lens and pinholes."""
    volume = seen(gv.read_volume(SCAN), gv.TransferFunction.from_points(OPACITY, COLOR))
    tree = gv.N3Tree.from_volume(volume, device=settings.device)
    shader = gv.StoredColor("value", premultiplied=True)
    camera = gv.Camera.orbit(30, 20, 1.5, 32, settings.size, settings.size)
    colors = []
    for aperture in APERTURES:
        lens = gv.ThinLens(aperture=aperture, focus=FOCUS, frame="box")
        picture = gv.render(tree, camera, shader, lens=lens)
        print(f"aperture {aperture:g}: {picture.stats}")
        colors.append(picture.color)
    expected = thin_lens(tree, camera, shader, APERTURES[-1])
    planes = (one.movedim(-1, 0)[None].clamp(0, 1) for one in (colors[-1], expected))
    alike = float(ssim(*planes, window_size=11).mean())
    print(f"aperture {aperture:g} and {PINHOLES} pinholes: SSIM {alike:.3f}")
    layers = {n: getattr(picture, n).expand(4, -1, -1, -1) for n in ("alpha", "depth", "samples")}
    replace(picture, color=torch.stack([*colors, expected]), **layers).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
