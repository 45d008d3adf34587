"""A dense marcher on `torch.nn.functional.grid_sample`: all rays in lockstep, finished ones
dropped.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .peer import Peer, Task, bake, spans

_ROWS = 255 * 16 + 1


class Marcher(Peer):
    """The same samples, in float32, of the whole volume."""

    differences = "the same samples; torch on the same threads, no empty space is skipped"

    def __init__(self, task: Task) -> None:
        """Converts the volume to float32, and the rays to grid_sample's coordinates."""
        volume, device = task.scene.volume, task.device
        self.data = volume.data[..., 0].float().to(device)[None, None]
        n = torch.tensor(volume.extent, dtype=torch.float64, device=device)
        self.origin = ((task.rays.origin + 0.5) / n * 2 - 1).float()
        self.direction = (task.rays.direction / n * 2).float()
        self.first, self.last = spans(task).float().unbind(1)
        table = bake(task.scene.shader, 1.0, _ROWS)
        self.table = torch.tensor(table, dtype=torch.float32, device=device)
        self.step, self.stop_alpha = task.scene.step, task.stop_alpha
        self.color = torch.zeros_like(self.origin)
        self.transmittance = torch.ones_like(self.first)

    def render(self) -> None:
        self.color.zero_()
        self.transmittance.fill_(1)
        start = self.first.clone()
        alive = (start < self.last).nonzero()[:, 0]
        while alive.numel():
            t = start[alive]
            end = torch.minimum(t + self.step, self.last[alive])
            position = self.origin[alive] + (0.5 * (t + end))[:, None] * self.direction[alive]
            value = torch.nn.functional.grid_sample(
                self.data, position[None, None, None], padding_mode="border", align_corners=False
            )[0, 0, 0, 0]
            row = value * ((_ROWS - 1) / 255)
            cell = row.floor().clamp(max=_ROWS - 2)
            lower = self.table[cell.long()]
            rgba = lower + (row - cell)[:, None] * (self.table[cell.long() + 1] - lower)
            remaining = self.transmittance[alive] * (1 - rgba[:, 3]) ** (end - t)
            self.color[alive] += (self.transmittance[alive] - remaining)[:, None] * rgba[:, :3]
            self.transmittance[alive] = remaining
            start[alive] = t + self.step
            alive = alive[(t + self.step < self.last[alive]) & (remaining > 1 - self.stop_alpha)]

    def picture(self) -> Tensor:
        return torch.cat((self.color, 1 - self.transmittance[:, None]), 1)
