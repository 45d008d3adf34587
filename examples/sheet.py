"""A scan as a radiologist's sheet: a 3D picture and three slices, with a colour bar, scale bars and
notes. Thin lines show in each slice where the two others lie.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

DATA = Path(__file__).parent / "data"
CROSSING = (72, 47, 128)  # the voxel in which the slices meet
SPAN = (0, 900)  # values from black to white in slices
EYE, UP = (-190.0, -240.0, 190.0), (0.0, 0.0, 1.0)
SKY = gv.Gradient((0.012, 0.018, 0.03), (0.002, 0.002, 0.004))
LINE = torch.tensor((0.9, 0.45, 0.05))


def main(output: str = "sheet.png", device: str = "cpu", size: int = 720) -> None:
    """Renders the picture, cuts the slices, and lays them side by side."""
    gap = max(1, size // 120)
    volume = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    nx, ny, nz = volume.extent
    scale = (size - gap) / (nz + ny)  # pixels a voxel
    sheet = torch.full((size, size * 16 // 9, 3), 0.002)
    slice_width, slice_height = round(nx * scale), round(nz * scale)
    split, lower_top = sheet.shape[1] - 2 * slice_width - gap, slice_height + gap
    for axis, left, top, lines in (
        ("y", split, 0, (CROSSING[0] / nx, 1 - CROSSING[2] / nz)),
        ("x", split + slice_width + gap, 0, (CROSSING[1] / ny, 1 - CROSSING[2] / nz)),
        ("z", split, lower_top, (CROSSING[0] / nx, CROSSING[1] / ny)),
    ):
        index = CROSSING["xyz".index(axis)]
        color = gv.slice_picture(volume, axis, index, span=SPAN, scale=scale).color
        for line in (color[:, int(lines[0] * color.shape[1])], color[int(lines[1] * len(color))]):
            line.lerp_(LINE, 0.5)
        area = sheet[top : top + color.shape[0], left : left + color.shape[1]]
        area.copy_(color[: area.shape[0], : area.shape[1]])
    tree = gv.N3Tree.from_volume(volume, brick_size=8, device=device)
    colors = gv.TransferFunction.from_json(DATA / "stent.json")
    camera = gv.Camera.look_at(EYE, CROSSING, UP, 36, split - gap, size)
    render = partial(gv.render, tree, shader=gv.Lit(colors, ambient=0.3), background=SKY)
    picture = gv.Progressive(render).refine(camera, 4)
    sheet[:, : split - gap] = picture.color.cpu()
    flat = replace(picture, color=sheet, alpha=torch.ones_like(sheet[..., :1]))
    distance = (torch.tensor(EYE) - torch.tensor(CROSSING)).norm()
    text = f"CT angiogram, abdominal aorta with a stent\n{nx} x {ny} x {nz} voxels"
    if size >= 240:  # text would be unreadable below that
        bar = gv.ColorBar(colors=colors, low=140, high=1000, title="CT value")
        pixel_options = {"pixel": camera.pixel_width(float(distance)), "unit": "voxels"}
        overlay = gv.Overlay(split - gap, size, bar=bar, text=text, **pixel_options)
        left_part = replace(flat, color=sheet[:, : split - gap], alpha=flat.alpha[:, : split - gap])
        sheet[:, : split - gap] = overlay.over(left_part).color
        right = sheet[:, split:]
        overlay = gv.Overlay(right.shape[1], size, pixel=1 / scale, unit="voxels")
        right.copy_(overlay.over(replace(flat, color=right, alpha=flat.alpha[:, split:])).color)
        notes = "".join(f"across {n}: {CROSSING['xyz'.index(n)]}\n" for n in "yxz")
        blank = replace(flat, color=torch.full_like(sheet, 0.002))
        overlay = gv.Overlay(sheet.shape[1], size, text=f"{notes}window {SPAN[0]} to {SPAN[1]}")
        corner = sheet[lower_top:, split + slice_width + gap :]
        corner.copy_(overlay.over(blank).color[: corner.shape[0], : corner.shape[1]])
    flat.save(output)
    print(output)


if __name__ == "__main__":
    tyro.cli(main)
