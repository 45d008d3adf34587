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

    differs = "the same samples; torch on the same threads, nothing is skipped"

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
        self.step, self.stop = task.scene.step, task.stop_alpha
        self.color = torch.zeros_like(self.origin)
        self.clear = torch.ones_like(self.first)

    def render(self) -> None:
        self.color.zero_()
        self.clear.fill_(1)
        start = self.first.clone()
        alive = (start < self.last).nonzero()[:, 0]
        while alive.numel():
            t = start[alive]
            end = torch.minimum(t + self.step, self.last[alive])
            place = self.origin[alive] + (0.5 * (t + end))[:, None] * self.direction[alive]
            value = torch.nn.functional.grid_sample(
                self.data, place[None, None, None], padding_mode="border", align_corners=False
            )[0, 0, 0, 0]
            row = value * ((_ROWS - 1) / 255)
            cell = row.floor().clamp(max=_ROWS - 2)
            below = self.table[cell.long()]
            rgba = below + (row - cell)[:, None] * (self.table[cell.long() + 1] - below)
            kept = self.clear[alive] * (1 - rgba[:, 3]) ** (end - t)
            self.color[alive] += (self.clear[alive] - kept)[:, None] * rgba[:, :3]
            self.clear[alive] = kept
            start[alive] = t + self.step
            alive = alive[(t + self.step < self.last[alive]) & (kept > 1 - self.stop)]

    def picture(self) -> Tensor:
        return torch.cat((self.color, 1 - self.clear[:, None]), 1)
