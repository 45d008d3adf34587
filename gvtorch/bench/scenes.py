"""The scenes: synthetic volumes and a bundled scan, all uint8 cubes with voxels of 1 world
unit, each with its transfer function and camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..base.volume import Volume
from ..cameras import Camera
from ..io.reading import read_volume
from ..shaders import TransferFunction

SCAN = Path(__file__).parents[2] / "examples" / "data" / "aneurism_256x256x256_uint8.raw.gz"


@dataclass(frozen=True, kw_only=True)
class BenchScene:
    """A volume, and the options it is rendered with."""

    name: str
    volume: Volume
    shader: TransferFunction
    step: float = 0.5
    surface: float = 128.0  # isovalue of shaders that draw a surface

    @property
    def box(self) -> Tensor:
        """(2, 3) float64 world corners."""
        high = torch.tensor(self.volume.extent, dtype=torch.float64, device="cpu") - 0.5
        return torch.stack((torch.full_like(high, -0.5), high))

    def camera(self, width: int, height: int) -> Camera:
        """Returns a camera two box lengths away, in world units."""
        return Camera.orbit(30, 20, 2.0, 30, width, height).placed(self.box)


def _grid(side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Returns z, y, x in [-1, 1] of a cube of voxels."""
    axis = torch.linspace(-1, 1, side, device="cpu")
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    return z, y, x


def _waves(z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    return 100 + 50 * torch.sin(9 * x) * torch.sin(8 * y) * torch.sin(7 * z)


def _uint8(values: Tensor) -> Volume:
    return Volume(values.clamp(0, 255).to(torch.uint8))


def fog_dense(side: int) -> BenchScene:
    """Thin fog that fills the box: every brick exists and is sampled."""
    volume = _uint8(_waves(*_grid(side)))
    return BenchScene(name="fog dense", volume=volume, shader=_FOG, surface=100.0)


def fog_sparse(side: int) -> BenchScene:
    """Fog in five balls, a twentieth of the box: the rest is empty."""
    z, y, x = _grid(side)
    inside = torch.zeros_like(x, dtype=torch.bool)
    for cx, cy, cz in ((0, 0, 0), (0.5, 0.5, 0.5), (-0.5, 0.4, -0.3), (0.4, -0.6, -0.4)):
        inside |= (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2 < 0.28**2
    inside |= (x + 0.5) ** 2 + (y + 0.5) ** 2 + (z - 0.5) ** 2 < 0.28**2
    return BenchScene(name="fog sparse", volume=_uint8(_waves(z, y, x) * inside), shader=_FOG)


def _shell(side: int) -> Tensor:
    z, y, x = _grid(side)
    radius = (x * x + y * y + z * z).sqrt()
    width = max(0.02, 3 / side)  # two voxels at least
    return 255 * (1 - (radius - 0.8).abs() / width).clamp(0, 1)


def shell_sparse(side: int) -> BenchScene:
    """A thin opaque sphere: most of the box is empty."""
    return BenchScene(name="shell sparse", volume=_uint8(_shell(side)), shader=_SOLID)


def shell_dense(side: int) -> BenchScene:
    """The thin sphere among transparent values that vary, so that every brick exists."""
    z, y, x = np.ogrid[0:side, 0:side, 0:side]
    faint = torch.from_numpy((7 * x + 13 * y + 29 * z) % 16 + 1)
    return BenchScene(
        name="shell dense", volume=_uint8(torch.maximum(_shell(side), faint)), shader=_SOLID
    )


def clouds(side: int) -> BenchScene:
    """Clouds with 68 % transparent voxels, at steps of a whole voxel: settings for which a figure
    of VTK is known.
    """
    z, y, x = _grid(side)
    field = torch.zeros_like(x)
    for octave in range(4):
        k, phase = 5.0 * 2.0**octave, 1.3 * octave
        field += (
            torch.sin(k * x + phase) * torch.sin(k * y - z) * torch.cos(k * z + x) / 1.7**octave
        )
    ordered = field.flatten()[:: max(1, field.numel() // 10**6)].sort().values
    threshold = float(ordered[int(0.68 * len(ordered))])
    values = 128 + 127 * (field - threshold) / float(field.max() - threshold)
    opacity, color = [(128, 0), (255, 0.3)], [(128, 0.2, 0.4, 0.8), (255, 1, 0.9, 0.7)]
    shader = TransferFunction.from_points(opacity, color)
    return BenchScene(name="clouds", volume=_uint8(values.floor()), shader=shader, step=1.0)


def aneurism(side: int) -> BenchScene:
    """The bundled scan, subsampled to about `side` voxels.

    Raises:
        FileNotFoundError: The scan's file is missing; it comes with the source.
    """
    data = read_volume(SCAN).data[..., 0]
    stride = max(1, data.shape[0] // side)
    volume = Volume(data[::stride, ::stride, ::stride].contiguous())
    vessels = TransferFunction.preset("vessels", 0, 255)
    return BenchScene(name="aneurism", volume=volume, shader=vessels, surface=76.0)


def made(
    make: Callable[[int], BenchScene], side: int, note: Callable[[str], object]
) -> BenchScene | None:
    """Returns the scene that `make` makes; None, after a note, if its file is missing."""
    try:
        return make(side)
    except FileNotFoundError:
        note("aneurism: left out, its file is missing (it comes with the source code)")
        return None


def scan_or_fog(side: int, note: Callable[[str], object] = lambda _: None) -> BenchScene:
    """Returns the scan; where its file is missing, fog, after a note."""
    scan = made(aneurism, side, note)
    if scan is None:
        note("fog takes the place of the scan")
        return fog_dense(side)
    return scan


def worn_planes(side: int) -> Iterator[np.ndarray]:
    """Yields a sphere eroded by gyroids of five scales, a solid with holes, as uint8 planes (y, x)
    from low z to high.
    """
    axis = np.linspace(-1, 1, side, dtype=np.float32)
    y, x = axis[:, None], axis[None, :]
    for z in axis:
        erosion = np.zeros((side, side), np.float32)
        for octave in range(5):
            k = 7.0 * 2.1**octave
            gyroid = np.sin(k * x) * np.cos(k * y) + np.sin(k * y) * np.cos(k * z)
            gyroid += np.sin(k * z) * np.cos(k * x)
            erosion += gyroid / 1.9**octave
        distance = 0.9 - np.sqrt(x * x + y * y + z * z) + 0.12 * erosion
        yield np.clip(128 + 20 * side / 8 * distance, 0, 255).astype(np.uint8)


def worn(side: int) -> BenchScene:
    """The worn sphere as a volume in memory."""
    shader = TransferFunction.from_points(
        [(100, 0), (140, 0.9)],
        [(100, 0.3, 0.1, 0.05), (160, 0.9, 0.6, 0.3), (255, 1, 0.95, 0.8)],
        reference=4.0,
    )
    return BenchScene(name="worn", volume=Volume(np.stack([*worn_planes(side)])), shader=shader)


_FOG = TransferFunction.from_points([(0, 0), (255, 0.004)], [(0, 1, 0.5, 0), (255, 0, 0.5, 1)])
_SOLID = TransferFunction.from_points([(20, 0), (120, 1)])

#: Scenes of `march`, by name.
SCENES: dict[str, Callable[[int], BenchScene]] = {
    "fog dense": fog_dense,
    "fog sparse": fog_sparse,
    "shell dense": shell_dense,
    "shell sparse": shell_sparse,
    "clouds": clouds,
    "aneurism": aneurism,
}
