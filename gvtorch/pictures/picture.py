"""`Picture`: the result of a render, and how it is shown and saved."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base.records import RenderStats, to_device
from .files import display_pixels, write_image
from .tone import ToneCurve, tone_map


@dataclass(frozen=True, kw_only=True)
class Picture:
    """Float pictures of one camera (h, w, c) or of a batch (n, h, w, c)."""

    color: Tensor  # (h, w, 3) linear RGB over the background; premultiplied if transparent
    alpha: Tensor  # (h, w, 1)
    depth: Tensor  # (h, w, 1) of the voxels, world units along the ray, +inf where nothing was hit
    nearest: Tensor  # (h, w, 1) as `depth`, to the nearer of voxels and layer
    samples: Tensor  # (h, w, 1) int32
    missed: Tensor | None = None  # (h, w, 1) bool, the ray needed data that was not loaded
    transparent: bool = False  # there is no background
    stats: RenderStats
    # Results of some shaders only, else None:
    normal: Tensor | None = None  # (h, w, 3) world, towards the eye, of unit length or 0
    features: Tensor | None = None  # (h, w, c)
    label: Tensor | None = None  # (h, w, 1) int64, of the voxels at the depth; -1: nothing was hit

    def tone_map(
        self, curve: ToneCurve = "aces", *, exposure: float = 0.0, white: float = 4.0
    ) -> Picture:
        """Returns the picture with its light mapped to what a display shows, still linear.

        Args:
            curve: none: clipped; reinhard: luminance is compressed so that `white` becomes 1, hue
                stays; aces: a filmic curve for each primary.
            exposure: Stops: the colour is multiplied by 2^exposure first.
            white: Smallest luminance, after exposure, that Reinhard's curve shows as 1.

        Raises:
            ValueError: The curve is unknown, or a number is out of its range.
        """
        color = tone_map(self.straight(), curve, exposure=exposure, white=white)
        return replace(self, color=color * self.alpha if self.transparent else color)

    def straight(self) -> Tensor:
        """Returns the colour (h, w, 3), not premultiplied; 0 where there is nothing."""
        if not self.transparent:
            return self.color
        return torch.where(self.alpha > 0, self.color / self.alpha, 0.0)

    def to_srgb8(self) -> Tensor:
        """Returns the colour for a display: sRGB-encoded uint8 on the CPU, of the same shape. A
        transparent picture is shown over black, NaN as black.
        """
        return torch.from_numpy(display_pixels(self.color, None, 8))

    def numpy(self) -> np.ndarray:
        """Returns linear light, (h, w, 4) float32: colour (premultiplied if transparent), alpha."""
        layers = self.layers()
        return np.concatenate((layers["color"], layers["alpha"]), -1)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Returns the picture as displayed, for `np.asarray(picture)`, Pillow and matplotlib: sRGB
        uint8, (h, w, 3), or (h, w, 4) with straight alpha if the picture is transparent.
        """
        if copy is False:
            raise ValueError("Picture: its array is always a copy: copy must not be False")
        pixels = display_pixels(self.color, self.alpha if self.transparent else None, 8)
        return pixels if dtype is None else pixels.astype(dtype)

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Picture:
        """Returns the picture on a device; its floats in another dtype. None leaves each as is."""
        fields = vars(self).items()
        return replace(self, **{name: to_device(value, device, dtype) for name, value in fields})

    def show(self) -> None:
        """Shows the picture: in a notebook below the cell, else as a PNG in the system's viewer.

        Raises:
            RuntimeError: There is no viewer; the message has the path of the PNG.
        """
        if in_notebook():
            sys.modules["IPython"].display.display(self)
            return
        path = Path(tempfile.mkdtemp(prefix="gvtorch-")) / "picture.png"
        self.save(path)
        if not webbrowser.open(path.as_uri()):
            raise RuntimeError(f"Picture.show: no viewer can be opened here; the PNG is {path}")

    def layers(self) -> dict[str, np.ndarray]:
        """Returns the layers as arrays: color, alpha, depth (float32), samples (int32), and where
        they exist normal, features (float32) and label (int64).
        """
        names = ("color", "alpha", "depth", "normal", "features")
        tensors = {name: getattr(self, name) for name in names}
        layers = {name: layer.float() for name, layer in tensors.items() if layer is not None}
        layers["samples"] = self.samples
        if self.label is not None:
            layers["label"] = self.label
        return {name: layer.detach().cpu().numpy() for name, layer in layers.items()}

    def save(self, path: str | Path, *, bits: int | None = None) -> None:
        """Writes a file, whole or not at all. A batch is laid side by side, except in NumPy files.

        - .png: sRGB, 8 or 16 bits; with straight alpha if the picture is transparent.
        - .tif: the same, or 32 bits: linear float, premultiplied (BigTIFF, Deflate).
        - .exr: linear, 32 or 16 bits float: R G B A (premultiplied), Z (depth), samples.
        - .npy: (h, w, 6) float32: color, alpha, depth, samples.
        - .npz: float32 color, alpha and depth, int32 samples; normal, features and label where
          they exist.

        Args:
            path: The file; its ending chooses the format.
            bits: Bits of each number; 8 for .png and .tif, 32 for .exr if left out.

        Raises:
            ValueError: The ending or the number of bits is unknown.
            FileNotFoundError: The folder does not exist.
            ImportError: The library for this kind of file is missing.
        """
        write_image(Path(path), self.layers(), transparent=self.transparent, bits=bits)

    def _repr_png_(self) -> bytes:
        """Shows the picture in a notebook."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "picture.png"
            self.save(path)
            return path.read_bytes()

    def __repr__(self) -> str:
        *_, height, width, _ = self.color.shape
        count = "" if self.color.dim() == 3 else f"{self.color.shape[0]} x "
        return f"Picture({count}{width}x{height}, {self.stats.milliseconds:.0f} ms)"


def in_notebook() -> bool:
    """Returns whether this runs in a notebook, which shows the result of a cell below it."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and hasattr(shell, "kernel")
