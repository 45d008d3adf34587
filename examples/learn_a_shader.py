"""Learns a transfer function from pictures: a module shader starts as a gray haze, and gradients
through the renderer find the colours and opacities that made the pictures."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro
from torch.nn.functional import mse_loss

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
ROWS, RATE, PICTURE_STEPS = 24, 0.2, (5, 9, 15, 30, 120)
SKY = gv.Gradient((0.002, 0.003, 0.006), (0.012, 0.016, 0.028))


class Learned(torch.nn.Module):
    """Colour and log extinction at evenly spaced values, linear in between."""

    def __init__(self) -> None:
        super().__init__()
        start = torch.tensor([0.0, 0.0, 0.0, -4.0])  # gray, and a thin haze
        self.rows = torch.nn.Parameter(start.repeat(ROWS, 1))

    def forward(self, values, positions, directions, lengths):
        location = (values / 255 * (ROWS - 1)).clamp(0, ROWS - 1)
        row = location.long().clamp(max=ROWS - 2)[:, 0]
        entry = self.rows[row] + (location - row[:, None]) * (self.rows[row + 1] - self.rows[row])
        return entry[:, :3].sigmoid(), 1 - torch.exp(-entry[:, 3:].exp() * lengths)

    def transfer(self) -> gv.TransferFunction:
        """Returns the learned function for the compiled kernel."""
        values = torch.linspace(0, 255, 256)[:, None]
        color, opacity = (x.detach().cpu() for x in self(values.to(self.rows), None, None, 1.0))
        points = [torch.cat((values, column), 1).tolist() for column in (opacity, color)]
        return gv.TransferFunction.from_points(*points)


@dataclass
class Settings:
    """Learns from views of the bundled aneurism; renders another one at times, and the target."""

    output: Path = Path("learn_a_shader.png")
    size: int = 720
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Learns, and renders a view that training does not use."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    target, module = gv.TransferFunction.preset("vessels", 0, 255), Learned().to(tree.device)
    side = max(8, settings.size // 22)
    views = gv.Camera.orbit([0, 75, 150, 225], [10, -20, 30, -5], 1.6, 30, side, side)
    targets = gv.render(tree, views, target, step=1.0).color
    optimizer = torch.optim.Adam(module.parameters(), lr=RATE)
    new_view = gv.Camera.orbit(40, 15, 1.2, 30, -(-settings.size * 16 // 27), settings.size // 2)
    pictures, render = [], partial(gv.render, tree, background=SKY)
    for step in range(PICTURE_STEPS[-1] + 1):
        if step in PICTURE_STEPS:
            mean = gv.Progressive(partial(render, shader=module.transfer()))
            pictures.append(mean.refine(new_view, 4))
        i, shader = step % len(views), gv.ModuleShader(module)
        color = gv.render(tree, views[i], shader, step=1.0).color
        loss = mse_loss((color + 1e-4).sqrt(), (targets[i] + 1e-4).sqrt())  # as displays show it
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    truth = gv.Progressive(partial(render, shader=target)).refine(new_view, 4)
    error = float((pictures[-1].color - truth.color).square().mean())
    print(f"{settings.output}: a new view, PSNR {-10 * math.log10(error):.1f} dB")
    tiles = [picture.color for picture in (*pictures, truth)]
    rows = [torch.cat(tiles[first : first + 3], 1) for first in (0, 3)]
    replace(truth, color=torch.cat(rows)).save(settings.output)


if __name__ == "__main__":
    main(tyro.cli(Settings))
