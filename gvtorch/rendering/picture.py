"""`Picture`: what a render gives, and how it is shown and saved."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..frame import RenderStats


@dataclass(frozen=True, kw_only=True)
class Picture:
    """Float pictures of one camera (h, w, c) or of a batch (n, h, w, c)."""

    color: Tensor  # (h, w, 3) linear RGB over the background
    alpha: Tensor  # (h, w, 1)
    depth: Tensor  # (h, w, 1) world units along the ray, +inf where nothing was hit
    samples: Tensor  # (h, w, 1) int32
    stats: RenderStats
    # What only some shaders give, else None:
    normal: Tensor | None = None  # (h, w, 3) world, towards the eye, of unit length or 0
    features: Tensor | None = None  # (h, w, c)

    def to_srgb8(self) -> Tensor:
        """Returns the colour as a display wants it: sRGB-encoded uint8 on the CPU, same shape."""
        from kornia.color import linear_rgb_to_rgb

        planes = self.color.detach().to("cpu", torch.float32).movedim(-1, -3).clamp(0, 1)
        return (
            (linear_rgb_to_rgb(planes) * 255).round().to(torch.uint8).movedim(-3, -1).contiguous()
        )

    def save(self, path: str | Path) -> None:
        """Writes a PNG (sRGB; a batch side by side) or an NPZ of float32 color, alpha, depth,
        and normal and features where they are.

        The file appears whole or not at all.

        Raises:
            ValueError: The path ends in neither .png nor .npz.
            FileNotFoundError: The folder does not exist.
        """
        path = Path(path)
        if path.suffix not in (".png", ".npz"):
            raise ValueError(f"save: path must end in .png or .npz, got {str(path)!r}")
        if not path.parent.is_dir():
            raise FileNotFoundError(f"save: folder not found: {path.parent}")
        handle, name = tempfile.mkstemp(suffix=path.suffix, dir=path.parent)
        os.close(handle)
        try:
            if path.suffix == ".png":
                _write_png(Path(name), self.to_srgb8())
            else:
                names = ("color", "alpha", "depth", "normal", "features")
                fields = {n: getattr(self, n) for n in names if getattr(self, n) is not None}
                arrays = {n: field.detach().cpu().float() for n, field in fields.items()}
                np.savez(name, **{n: array.numpy() for n, array in arrays.items()})
            os.chmod(name, 0o666 & ~_umask())
            os.replace(name, path)
        finally:
            Path(name).unlink(missing_ok=True)

    def _repr_png_(self) -> bytes:
        """Shows the picture in a notebook."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "picture.png"
            _write_png(path, self.to_srgb8())
            return path.read_bytes()

    def __repr__(self) -> str:
        """Shows the size."""
        *_, height, width, _ = self.color.shape
        count = "" if self.color.dim() == 3 else f"{self.color.shape[0]} x "
        return f"Picture({count}{width}x{height}, {self.stats.milliseconds:.0f} ms)"


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _write_png(path: Path, image: Tensor) -> None:
    from kornia_rs.io import write_image_png_u8

    if image.dim() == 4:
        image = torch.cat(tuple(image), dim=1)
    write_image_png_u8(str(path), image.numpy(), "rgb")
