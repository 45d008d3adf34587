"""Depth of field: a pinhole, and a lens with three apertures. `--pinholes 256` compares the widest
with the mean of 256 pinhole pictures from all over the lens, which takes minutes on a CPU. Voxels
hold colour and opacity, so that a wide cone reads the mean of what it sees."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro
from kornia.metrics import ssim

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
OPACITY = [(20, 0), (60, 0.04), (255, 0.25)]
COLOR = [(20, 0.6, 0.1, 0.05), (120, 0.9, 0.5, 0.3), (255, 1, 1, 0.8)]
FOCUS, APERTURES = 0.8, (0.03, 0.07, 0.15)  # in largest sides of the box


@dataclass
class Settings:
    """Renders the bundled aneurism."""

    output: Path = Path("depth_of_field.png")
    size: int = 720
    samples: int = 4
    pinholes: int = 0
    device: str = "cpu"


def colored(volume: gv.Volume, transfer: gv.TransferFunction) -> gv.Volume:
    """Returns premultiplied colour and opacity of every voxel."""
    rgba = torch.from_numpy(transfer(volume.data[..., 0].numpy()))
    rgba[..., :3] *= rgba[..., 3:]
    return gv.Volume(rgba.half(), spacing=volume.spacing, origin=volume.origin)


def thin_lens(
    tree: gv.N3Tree, camera: gv.Camera, shader: gv.StoredColor, aperture: float, pinholes: int
):
    """Returns (h, w, 3): mean colour of rays from all over the lens to each pixel's focal point."""
    placed_camera = camera.placed(tree.box)
    rays, side = placed_camera.rays(tree.device), float((tree.box[1] - tree.box[0]).max())
    right, down = placed_camera.viewmats[0, :2, :3].to(tree.device)
    focal_points, total = rays.origin + FOCUS * side * rays.direction, torch.zeros_like(rays.origin)
    for index in range(pinholes):
        radius = side * aperture / 2 * math.sqrt((index + 0.5) / pinholes)
        angle = index * math.pi * (3 - math.sqrt(5))
        origin = rays.origin + radius * (math.cos(angle) * right + math.sin(angle) * down)
        direction = torch.nn.functional.normalize(focal_points - origin)
        total += gv.trace(tree, replace(rays, origin=origin, direction=direction), shader).color
    return (total / pinholes).reshape(camera.height, camera.width, 3).float()


def main(settings: Settings) -> None:
    """Renders four pictures."""
    volume = colored(gv.read_volume(SCAN), gv.TransferFunction.from_points(OPACITY, COLOR))
    tree = gv.N3Tree.from_volume(volume, device=settings.device)
    shader = gv.StoredColor("value", premultiplied=True)
    camera = gv.Camera.orbit(60, 12, 1.1, 32, settings.size * 8 // 9, settings.size // 2)
    render, tiles = partial(gv.render, tree, shader=shader), []
    for aperture in (None, *APERTURES):
        lens = aperture and gv.ThinLens(aperture=aperture, focus=FOCUS, frame="box")
        picture = gv.Progressive(partial(render, lens=lens)).refine(camera, settings.samples)
        print(f"aperture {aperture}: {picture.stats}")
        tiles.append(picture.color)
    if settings.pinholes:
        expected = thin_lens(tree, camera, shader, APERTURES[-1], settings.pinholes)
        images = (image.movedim(-1, 0)[None].clamp(0, 1) for image in (tiles[-1], expected))
        print(f"SSIM {float(ssim(*images, window_size=11).mean()):.3f}")
    rows = [torch.cat(tiles[first : first + 2], 1) for first in (0, 2)]
    replace(picture, color=torch.cat(rows)).save(settings.output)
    print(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
