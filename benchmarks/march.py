"""Speed of `trace_rays` on resident trees, beside a dense marcher on `grid_sample` in the same run.

Prints, for each scene: median milliseconds, samples a second, and how far the two pictures are
apart. Rays are made before the clock starts; the peer takes the same samples as `lod="finest"`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

import gvtorch as gv
from gvtorch.rendering.renderer import trace

DATA = Path(__file__).parent.parent / "examples" / "data"


@dataclass
class Settings:
    """What to run."""

    device: str = "cpu"
    size: tuple[int, int] = (512, 512)
    step: float = 0.5
    repeats: int = 5
    stop_alpha: float = 0.99


def scenes() -> dict[str, tuple[gv.Volume, gv.TransferFunction]]:
    """A real scan, a fog that fills the box, and a thin shell."""
    aneurism = gv.read_volume(DATA / "aneurism_256x256x256_uint8.raw.gz")
    axis = torch.linspace(-1, 1, 256)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    radius = (x * x + y * y + z * z).sqrt()
    waves = 100 + 50 * torch.sin(9 * x) * torch.sin(8 * y) * torch.sin(7 * z)
    shell = 255 * (1 - (radius - 0.8).abs() / 0.02).clamp(0, 1)
    fog = gv.TransferFunction.from_points(
        [(0, 0), (255, 0.004)], [(0, 1, 0.5, 0), (255, 0, 0.5, 1)]
    )
    solid = gv.TransferFunction.from_points([(20, 0), (120, 1)])
    return {
        "aneurism": (aneurism, gv.TransferFunction.preset("vessels", 0, 255)),
        "fog": (gv.Volume(waves.to(torch.uint8)), fog),
        "shell": (gv.Volume(shell.to(torch.uint8)), solid),
    }


def clock(run: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Median milliseconds of a call, after one to warm up."""
    times = []
    for _ in range(repeats + 1):
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        if device.type == "cuda":
            torch.cuda.synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return sorted(times[1:])[repeats // 2]


class DenseMarcher:
    """The peer: `torch.nn.functional.grid_sample` on the whole volume, all rays in lockstep."""

    def __init__(
        self, volume: gv.Volume, shader: gv.TransferFunction, rays: gv.Rays, step: float
    ) -> None:
        device = rays.origin.device
        self.data = volume.data[..., 0].float().to(device)[None, None]
        n = torch.tensor(volume.extent, dtype=torch.float64, device=device)
        self.origin = ((rays.origin + 0.5) / n * 2 - 1).float()
        self.direction = (rays.direction / n * 2).float()
        a, b = (-1 - self.origin) / self.direction, (1 - self.origin) / self.direction
        self.first = torch.minimum(a, b).amax(1).clamp(min=0)
        self.last = torch.maximum(a, b).amin(1)
        self.table, domain, _ = shader.table(1.0, torch.float32, device)
        self.low, self.high, _ = domain.tolist()
        self.step = step

    def __call__(self, stop_alpha: float) -> tuple[Tensor, int]:
        """Returns colour (r, 3) and the number of samples."""
        color, clear = torch.zeros_like(self.origin), torch.ones_like(self.first)
        start, samples = self.first.clone(), 0
        alive = (start < self.last).nonzero()[:, 0]
        while alive.numel():
            samples += alive.numel()
            t = start[alive]
            end = torch.minimum(t + self.step, self.last[alive])
            place = self.origin[alive] + (0.5 * (t + end))[:, None] * self.direction[alive]
            value = torch.nn.functional.grid_sample(
                self.data, place[None, None, None], padding_mode="border", align_corners=False
            )[0, 0, 0, 0]
            row = ((value - self.low) / (self.high - self.low)).clamp(0, 1) * (len(self.table) - 1)
            cell = row.floor().clamp(max=len(self.table) - 2)
            below = self.table[cell.long()]
            rgba = below + (row - cell)[:, None] * (self.table[cell.long() + 1] - below)
            kept = clear[alive] * (1 - rgba[:, 3]) ** (end - t)
            color[alive] += (clear[alive] - kept)[:, None] * rgba[:, :3]
            clear[alive] = kept
            start[alive] = t + self.step
            alive = alive[(t + self.step < self.last[alive]) & (kept > 1 - stop_alpha)]
        return color, samples


def main(settings: Settings) -> None:
    """Runs all scenes and prints the table."""
    device, (width, height) = torch.device(settings.device), settings.size
    name = (
        torch.cuda.get_device_name()
        if device.type == "cuda"
        else f"{torch.get_num_threads()} threads"
    )
    table = Table(
        title=f"march {width}x{height}, step {settings.step}, torch {torch.__version__}, {name}"
    )
    for column in (
        "scene",
        "lod",
        "ms",
        "M samples",
        "M samples/s",
        "peer ms",
        "ratio",
        "max error",
    ):
        table.add_column(column, justify="right")
    for scene, (volume, shader) in scenes().items():
        tree = gv.N3Tree.from_volume(volume, device=device)
        rays = gv.Camera.orbit(30, 20, 2.0, 30, width, height).placed(tree.box).rays(device)
        marcher = DenseMarcher(volume, shader, rays, settings.step)
        color, _ = marcher(settings.stop_alpha)
        peer = clock(lambda m=marcher: m(settings.stop_alpha), device, 1)
        for lod in ("finest", "auto"):
            options = gv.RenderOptions(lod=lod, step=settings.step, stop_alpha=settings.stop_alpha)  # type: ignore[arg-type]
            hits = trace(tree, rays, shader, options)
            ms = clock(
                lambda t=tree, r=rays, s=shader, o=options: trace(t, r, s, o),
                device,
                settings.repeats,
            )
            samples = int(hits.samples.sum(dtype=torch.int64)) / 1e6
            error = float((hits.color - color).abs().max()) if lod == "finest" else float("nan")
            figures = (samples, samples / ms * 1e3, peer, peer / ms, error)
            table.add_row(scene, lod, f"{ms:.2f}", *(f"{figure:.4g}" for figure in figures))
    Console(width=120).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
