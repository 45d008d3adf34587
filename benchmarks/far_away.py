"""How accurate a scan is from afar: mean values and `gv.Filtered`, against 256 rays a pixel.

    python benchmarks/far_away.py ../shared/data/volumes --picture docs/images/far_away.png
    ... --lit --only stent,tooth --picture docs/images/far_away_lit.png

Orthographic pictures, obliquely through each scan, at several voxels a pixel. Light is our mean
relative to the ground truth's; PSNR (peak 1, linear light) and SSIM (window 7) are over pixels
where either shows something. Prints Markdown.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from kornia.metrics import ssim
from torch import Tensor
from tyro.conf import Positional

import gvtorch as gv
from gvtorch.pictures.files import write_image

#: File; least and greatest value and opacity per voxel of a translucent function; the values
#: between which an opaque one rises.
SCANS = {
    "aneurism": ("aneurism_256x256x256_uint8.raw.gz", (20, 255, 0.15), (60, 70)),
    "VisMale": ("vismale_128x256x256_uint8.raw.gz", (20, 255, 0.06), (120, 130)),
    "stent": ("stent_256x128x128_int16.npz", (140, 900, 0.1), (380, 430)),
    "tooth": ("tooth_103x94x161_uint8.raw.gz", (85, 255, 0.06), (100, 110)),
    "brain": ("mni_icbm152_t1_197x233x189_uint8.nii.gz", (40, 255, 0.05), (185, 195)),
}
SUN = gv.DirectionalLight((-0.6, 0.7, 1.0))  # shines from above, right of the eye
PARTS = 16  # rays of the ground truth along each side of a pixel
STILL = 4  # and those of a still picture
SCALE = 5  # magnification of the saved picture


@dataclass
class Settings:
    """What to measure."""

    folder: Positional[Path]
    """with the scans of docs/from_afar.md"""
    pixels: tuple[float, ...] = (2.0, 8.0, 32.0)
    """voxels a pixel"""
    only: str = ""
    """scans that have it, or one of several parted by commas, in their name"""
    device: str = "cpu"
    """of the trees"""
    lit: bool = False
    """show the functions as `Lit` does, with a sun"""
    picture: Path | None = None
    """file for the scans side by side, at the second size"""


def functions(scan: str) -> dict[str, gv.TransferFunction]:
    """Returns the two transfer functions of a scan."""
    _, (low, high, max_opacity), (clear, solid) = SCANS[scan]
    ramp = [(low, 0.5, 0.2, 0.1), ((low + high) / 2, 0.9, 0.7, 0.4), (high, 1, 1, 1)]
    skin = [(clear, 0.8, 0.4, 0.25), (2 * solid, 1, 0.9, 0.7)]
    return {
        "translucent": gv.TransferFunction([(low, 0), (high, max_opacity)], ramp),
        "opaque": gv.TransferFunction([(clear, 0), (solid, 0.95)], skin),
    }


def parallel(tree: gv.N3Tree, pixel: float, parts: int) -> gv.Rays:
    """Returns parallel rays through the tree, parts^2 a pixel, each as wide as its part."""
    real = {"dtype": torch.float64}
    view = torch.nn.functional.normalize(torch.tensor([0.37, 0.23, 1.0], **real), dim=0)
    across = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], **real), view)
    across = across / across.norm()
    up = torch.linalg.cross(view, across)
    reach = float((tree.box[1] - tree.box[0]).norm()) / 2
    pixel = pixel * min(tree.spacing)
    side = math.ceil(2 * reach / pixel)
    offsets = ((torch.arange(side * parts, **real) + 0.5) / parts - side / 2 + 0.37) * pixel
    y, x = torch.meshgrid(offsets, offsets, indexing="ij")
    origin = tree.box.mean(0) + x.reshape(-1, 1) * across + y.reshape(-1, 1) * up - 2 * reach * view
    cone_width = torch.tensor([pixel / parts, 0.0], **real)
    columns = (view, cone_width, torch.tensor([0.0, 1e9], **real))
    direction, cone, limits = (column.expand(len(origin), -1).contiguous() for column in columns)
    rays = gv.Rays(origin=origin, direction=direction, cone=cone, range=limits)
    return rays.to(tree.device)


def draw(
    tree: gv.N3Tree, shader: gv.Shader, pixel: float, parts: int = 1, lod: str = "auto"
) -> tuple[Tensor, int]:
    """Returns (h, w, 4) linear premultiplied colour and alpha, and the number of samples."""
    rays = parallel(tree, pixel, parts)
    hits = gv.trace(tree, rays, shader, lod=lod)
    side = math.isqrt(len(rays.origin)) // parts
    image = torch.cat((hits.color, hits.alpha), 1).double()
    image = image.reshape(side, parts, side, parts, 4).mean((1, 3)).cpu()
    return image, int(hits.samples.sum())


def compare(image: Tensor, truth: Tensor) -> str:
    """Returns light, PSNR and SSIM as text."""
    visible = (truth[..., 3] > 1e-3) | (image[..., 3] > 1e-3)
    error = float((image - truth)[..., :3][visible].square().mean())
    images = (picture[..., :3].movedim(-1, 0)[None].float() for picture in (image, truth))
    alike = float(ssim(*images, window_size=7).mean(1)[0][visible].mean())
    light = float(image[..., :3].sum() / truth[..., :3].sum())
    return f"{light:.2f} / {-10 * math.log10(error + 1e-12):.1f} / {alike:.2f}"


def main(settings: Settings) -> None:
    """Measures all and prints the table."""
    rows: list[Tensor] = []
    print("| scan | function | voxels a pixel | one ray | means | filtered | samples | 16 rays |")
    print("|---|---|---|---|---|---|---|---|")
    for scan in SCANS:
        if not any(one_ray in scan for one_ray in settings.only.split(",")):
            continue
        volume = gv.read_volume(settings.folder / SCANS[scan][0])
        tree = gv.N3Tree.from_volume(volume, device=settings.device)
        for name, transfer in functions(scan).items():
            base_shader = gv.Lit(transfer, light=SUN) if settings.lit else transfer
            start = time.perf_counter()
            shader = gv.Filtered.of(tree, volume, base_shader)
            seconds = time.perf_counter() - start
            size = tree.bricks.bricks["filtered"].nbytes / volume.data[..., 0].numel()
            print(f"{scan}, {name}: {seconds:.1f} s, {size:.2f} bytes a voxel", file=sys.stderr)
            for pixel in settings.pixels:
                truth, _ = draw(tree, base_shader, pixel, PARTS, "finest")
                one_ray, _ = draw(tree, base_shader, pixel, 1, "finest")
                means, before = draw(tree, base_shader, pixel)
                filtered, after = draw(tree, shader, pixel)
                still, _ = draw(tree, shader, pixel, STILL)
                scores = " | ".join(compare(image, truth) for image in (one_ray, means, filtered))
                last = f"{after / before:.2f} | {compare(still, truth)}"
                print(f"| {scan} | {name} | {pixel:g} | {scores} | {last} |", flush=True)
                if pixel == settings.pixels[min(1, len(settings.pixels) - 1)]:
                    rows.append(torch.stack((truth, filtered, means, one_ray)))
    if settings.picture is not None:
        save(rows, settings.picture)


def save(rows: list[Tensor], path: Path) -> None:
    """Draws the rows, two side by side, each cut to what it shows."""
    boxes = []
    for row in rows:
        visible = row[0, ..., 3] > 0.02
        y, x = (visible.any(axis).nonzero()[:, 0] for axis in (1, 0))
        boxes.append((int(y[0]), int(y[-1]) + 1, int(x[0]), int(x[-1]) + 1))
    width = max(right - left for _, _, left, right in boxes) + 2
    tiles = []
    for row, (top, bottom, left, right) in zip(rows, boxes, strict=True):
        missing = width - (right - left)
        cut = row[:, top:bottom, left:right, :3]
        cut = torch.nn.functional.pad(cut, (0, 0, missing // 2, missing - missing // 2, 1, 1))
        cut = cut.repeat_interleave(SCALE, 1).repeat_interleave(SCALE, 2)
        tiles.append(torch.cat(list(cut), 1))
    lines = []
    for left_tile, right_tile in zip(tiles[::2], tiles[1::2], strict=True):
        high = max(len(left_tile), len(right_tile))
        both = [
            torch.nn.functional.pad(tile, (0, 0, 0, 0, 0, high - len(tile)))
            for tile in (left_tile, right_tile)
        ]
        lines.append(torch.cat(both, 1))
    color = torch.cat(lines).float()
    layers = {"color": color.numpy(), "alpha": torch.ones_like(color[..., :1]).numpy()}
    write_image(path, layers, transparent=False)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
