"""Learns a transfer function from pictures: a module shader starts as a gray haze, and gradients
through the renderer find the colours and opacities that made the pictures."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

import gvtorch as gv

SCAN = Path(__file__).parent / "data" / "aneurism_256x256x256_uint8.raw.gz"
ROWS, STEPS, RATE = 24, 60, 0.2


class Learned(torch.nn.Module):
    """Colour and log extinction at evenly spaced values, linear in between."""

    def __init__(self) -> None:
        super().__init__()
        start = torch.tensor([0.0, 0.0, 0.0, -4.0])  # gray, and a thin haze
        self.rows = torch.nn.Parameter(start.repeat(ROWS, 1))

    def forward(self, values, positions, directions, lengths):
        place = (values / 255 * (ROWS - 1)).clamp(0, ROWS - 1)
        row = place.long().clamp(max=ROWS - 2)[:, 0]
        look = self.rows[row] + (place - row[:, None]) * (self.rows[row + 1] - self.rows[row])
        extinction = torch.exp(look[:, 3:])
        return look[:, :3].sigmoid(), 1 - torch.exp(-extinction * lengths)


def shown(color: torch.Tensor) -> torch.Tensor:
    """Roughly display-encoded light, so that differences in the dark count."""
    return (color + 1e-4).sqrt()


@dataclass
class Settings:
    """Learns from views of the bundled aneurism; shows before, after and target of a new one."""

    output: Path = Path("learn_a_shader.png")
    size: int = 160
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Learns, then renders a view that was not learned from."""
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=settings.device)
    target = gv.TransferFunction.preset("vessels", 0, 255)
    module = Learned().to(tree.device)
    shader = gv.ModuleShader(module)
    small = max(8, settings.size // 5)
    views = gv.Camera.orbit([0, 75, 150, 225], [10, -20, 30, -5], 1.6, 30, small, small)
    pictures = [gv.render(tree, views[i], target, step=1.0).color for i in range(len(views))]
    optimizer = torch.optim.Adam(module.parameters(), lr=RATE)
    new = gv.Camera.orbit(40, 15, 1.5, 30, settings.size, settings.size)
    look = torch.no_grad()(partial(gv.render, tree, new, shader))
    before, losses = look(), []
    for step in range(STEPS):
        at = step % len(views)
        color = gv.render(tree, views[at], shader, step=1.0).color
        loss = (shown(color) - shown(pictures[at])).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    first, last = sum(losses[: len(views)]), sum(losses[-len(views) :])
    print(f"loss {first:.5f} -> {last:.5f}: {first / last:.0f} times less")
    after, aim = look(), gv.render(tree, new, target)
    error = float((after.color - aim.color).square().mean())
    print(f"{settings.output}: a new view, PSNR {-10 * math.log10(error):.1f} dB")
    replace(aim, color=torch.cat([one.color.cpu() for one in (before, after, aim)], 1)).save(
        settings.output
    )


if __name__ == "__main__":
    main(tyro.cli(Settings))
