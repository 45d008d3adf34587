"""Backgrounds of pictures, in linear light."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..cameras.camera import Camera
from .read_files import read_image

Color = tuple[float, float, float]
_PIXELS_A_BLOCK = 1 << 20  # pixels whose rays are in memory at once


class Background(ABC):
    """Colours behind a camera's pixels."""

    @abstractmethod
    def behind(self, camera: Camera, numbers: Tensor, dtype: torch.dtype) -> Tensor:
        """Returns linear RGB (r, 3), or (1, 3) for all pixels; does not wait for the device.

        Args:
            camera: Placed in the world.
            numbers: What `camera.numbers` returned, on the device of the picture.
            dtype: Dtype of the colours.
        """

    def check(self, context: str, camera: Camera) -> None:
        """Raises ValueError if this background does not fit a camera's pictures."""
        del context, camera


class Gradient(Background):
    """A blend from the top row of the picture to the bottom row, linear in linear light."""

    def __init__(self, top: Color, bottom: Color) -> None:
        """Takes two colours, linear RGB, finite and >= 0."""
        self.ends = [_color("Gradient", "top", top), _color("Gradient", "bottom", bottom)]

    def __repr__(self) -> str:
        top, bottom = self.ends
        return f"Gradient(top={top}, bottom={bottom})"

    def behind(self, camera: Camera, numbers: Tensor, dtype: torch.dtype) -> Tensor:
        options: Any = {"dtype": dtype, "device": numbers.device}
        top_row, rows = camera.window
        fraction = (torch.arange(top_row, top_row + camera.height, **options) + 0.5) / rows
        ends = zip(*self.ends, strict=True)
        column = torch.stack([top + (bottom - top) * fraction for top, bottom in ends], -1)
        return _by_pixel(column[:, None], camera)


class Backdrop(Background):
    """An image of the size of the picture."""

    def __init__(self, image: Tensor) -> None:
        """Takes linear RGB, (h, w, 3) or, for a batch of cameras, (n, h, w, 3). An image on another
        device is uploaded once; one on the picture's device may be edited between frames.
        """
        check.images("Backdrop", "image", image, 3)
        if not (image.is_cuda or bool(torch.isfinite(image).all())):
            raise ValueError("Backdrop: image must be finite, got NaN or infinity")
        self.image = image
        self._uploaded: dict[torch.device, Tensor] = {}

    def __repr__(self) -> str:
        return f"Backdrop({check.describe(self.image)})"

    def check(self, context: str, camera: Camera) -> None:
        shape, size = tuple(self.image.shape), (camera.window[1], camera.width, 3)
        if shape[-3:] != size or (len(shape) == 4 and shape[0] not in (1, len(camera))):
            wanted = (len(camera), *size) if camera.batched else size
            raise ValueError(f"{context}: background image must be {wanted}, got {shape}")

    def behind(self, camera: Camera, numbers: Tensor, dtype: torch.dtype) -> Tensor:
        device = numbers.device
        if self.image.device != device and device not in self._uploaded:
            self._uploaded[device] = self.image.to(device)
        top = camera.window[0]
        rows = self._uploaded.get(device, self.image)[..., top : top + camera.height, :, :]
        return _by_pixel(rows.to(dtype), camera)


class Environment(Background):
    """An equirectangular map of all directions, 360 by 180 degrees, interpolated bilinearly.

    Its middle is the direction -z, its upper edge +y, its right half faces +x: what a panorama
    camera that looks along -z would see.
    """

    def __init__(self, image: Tensor, *, rotation: Tensor | None = None) -> None:
        """Takes the map.

        Args:
            image: (h, w, 3) linear RGB, finite; values above 1 are kept.
            rotation: (3, 3) from world directions to those of the map.

        Raises:
            ValueError: A shape is wrong, a value is not finite, or the matrix is not orthonormal.
        """
        check.images("Environment", "image", image, 3, batch=False)
        if not bool(torch.isfinite(image).all()):
            raise ValueError("Environment: image must be finite, got NaN or infinity")
        self.image = image
        identity = torch.eye(3, dtype=torch.float64, device="cpu")
        self.rotation = (
            identity if rotation is None else torch.as_tensor(rotation, device="cpu").to(identity)
        )
        if self.rotation.shape != (3, 3) or not torch.allclose(
            self.rotation @ self.rotation.mT, identity, atol=1e-3
        ):
            raise ValueError("Environment: rotation must be (3, 3) and orthonormal")
        self._uploaded: dict[tuple[torch.device, torch.dtype], tuple[Tensor, Tensor]] = {}

    @classmethod
    def read(cls, path: str | Path) -> Environment:
        """Reads the map from a file; see `read_image`."""
        return cls(read_image(path)[..., :3])

    def __repr__(self) -> str:
        return f"Environment({check.describe(self.image)})"

    def _map_on(self, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Returns the map (1, 3, h, w + 2), wrapped by a column on both sides, and the rotation."""
        if (device, dtype) not in self._uploaded:
            image = self.image.to(device, dtype).movedim(-1, 0)[None]
            wrapped = torch.cat((image[..., -1:], image, image[..., :1]), -1)
            self._uploaded[device, dtype] = (wrapped, self.rotation.to(device))
        return self._uploaded[device, dtype]

    def look_up(self, direction: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Returns the colours (r, 3) in world directions (r, 3) of unit length."""
        wrapped, rotation = self._map_on(direction.device, dtype)
        x, y, z = (direction.to(torch.float64) @ rotation.mT).unbind(-1)
        width = wrapped.shape[-1] - 2
        u = torch.atan2(x, -z) / torch.pi  # -1 to 1 over the map
        v = -2 * torch.asin(y.clamp(-1, 1)) / torch.pi
        grid = torch.stack((u * (width / (width + 2)), v), -1).to(dtype)
        colors = torch.nn.functional.grid_sample(
            wrapped, grid[None, None], padding_mode="border", align_corners=False
        )
        return colors[0, :, 0].mT

    def behind(self, camera: Camera, numbers: Tensor, dtype: torch.dtype) -> Tensor:
        blocks = camera.blocks(_PIXELS_A_BLOCK)
        rays = (camera.pixel_rays(numbers, rows) for rows in blocks)
        return torch.cat([self.look_up(block_rays.direction, dtype) for block_rays in rays])


def checked_background(context: str, value: Any) -> Background | Color | None:
    """Returns a user's background: an object of this file, a colour, or None (transparent)."""
    if value is None or isinstance(value, Background):
        return value
    if isinstance(value, Tensor) and value.dim() > 1:
        return Backdrop(value)
    return _color(context, "background", value, high=1)


def _color(context: str, name: str, value: Sequence[float], high: float = math.inf) -> Color:
    color = check.triple(context, name, value)
    for number in color:
        check.number(context, name, number, low=0, high=high)
    return color


def _by_pixel(image: Tensor, camera: Camera) -> Tensor:
    """Expands an image, broadcastable to (n, h, w, 3), to a colour (r, 3) for each pixel."""
    return image.expand(len(camera), camera.height, camera.width, 3).reshape(-1, 3)
