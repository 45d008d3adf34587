"""`Layer`: the colour and depth of another renderer, composited with voxels along each ray.

Voxels in front of the layer are composited over it. Where it is opaque, rays end at it: nothing
behind is sampled or requested. Where it is translucent, a second trace continues behind it.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..base import check
from ..base.records import Hits, Rays
from ..cameras.camera import Camera
from .composite import TraceRays, over


@dataclass(frozen=True, eq=False)
class Layer:
    """Another renderer's picture of the same pixels, on any device.

    The tensors are kept, not copied, and read in every frame: write into them to change the layer.
    They are checked once, here; on CUDA that waits for the device. A depth that becomes NaN later
    counts as +inf.

    Attributes:
        color: (h, w, 3) or, for a batch of cameras, (n, h, w, 3); linear RGB, premultiplied.
        depth: (h, w, 1) or (n, h, w, 1) distance along the ray in world units, +inf where there is
            nothing; `gv.opengl.ray_distance` makes it from a depth buffer.
        alpha: As depth, 0 (nothing there) to 1; opaque if left out.
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor | None = None

    def __post_init__(self) -> None:
        for name, image in vars(self).items():
            if image is None and name == "alpha":
                continue
            check.images("Layer", name, image, 3 if name == "color" else 1)
            if image.shape[:-1] != self.color.shape[:-1]:
                color, got = check.describe(self.color), check.describe(image)
                raise ValueError(f"Layer: {name} must have the pixels of color, {color}, got {got}")
        if not bool(torch.isfinite(self.color).all()):
            raise ValueError("Layer: color must be finite, got NaN or infinity")
        if not bool((self.depth >= 0).all()):
            problem = "NaN" if bool(self.depth.isnan().any()) else f"{float(self.depth.min()):g}"
            raise ValueError(f"Layer: depth must be >= 0, +inf where nothing is, got {problem}")
        if self.alpha is not None and not bool(((self.alpha >= 0) & (self.alpha <= 1)).all()):
            raise ValueError("Layer: alpha must be finite and >= 0 and <= 1")

    def __repr__(self) -> str:
        kind = "opaque" if self.alpha is None else "translucent"
        return f"Layer({kind}, color={check.describe(self.color)})"

    def _images(self) -> list[tuple[str, Tensor]]:
        """Returns the tensors that are not None, by name."""
        return [(name, image) for name, image in vars(self).items() if image is not None]

    def cut(self, context: str, camera: Camera) -> Layer:
        """Returns the part of the layer that a camera sees: of a strip of rows, views of these.

        Raises:
            ValueError: The layer's size is not that of the camera's whole pictures.
        """
        top, rows = camera.window
        count = (len(camera),) if camera.batched else ()
        wanted, got = (*count, rows, camera.width), tuple(self.color.shape[:-1])
        if got == (*count, camera.height, camera.width):
            return self
        if got != wanted:
            pixels = f"{wanted} pixels (rows, columns)"
            raise ValueError(f"{context}: layer must have the camera's {pixels}, got {got}")
        strip = copy.copy(self)  # checked already
        for name, image in self._images():
            object.__setattr__(strip, name, image[..., top : top + camera.height, :, :])
        return strip

    def check_device(self, device: torch.device) -> None:
        """Raises ValueError unless all tensors are on the device."""
        for _, image in self._images():
            if image.device != device:
                place = f"{device}, where the graph reads it"
                raise ValueError(f"capture: layer must lie on {place}, got {image.device}")

    def distance(self, device: torch.device) -> Tensor:
        """Returns (p, 1) the distance of the layer at every pixel, +inf where it shows nothing."""
        depth = _as_rows(self.depth, device)
        shown = depth < torch.inf
        if self.alpha is not None:
            shown = shown & (_as_rows(self.alpha, device) > 0)
        return torch.where(shown, depth, torch.inf)

    def pixels(self, device: torch.device) -> LayerPixels:
        """Returns all pixels on a device, row by row through the batch."""
        alpha = None if self.alpha is None else _as_rows(self.alpha, device)
        return LayerPixels(_as_rows(self.color, device), self.distance(device), alpha)


def _as_rows(image: Tensor, device: torch.device) -> Tensor:
    """Returns (p, c) of (..., h, w, c), a view if it is on the device already."""
    flat = image.reshape(-1, image.shape[-1])
    return flat.to(device, non_blocking=device.type == "cuda")  # to the CPU it must block


@dataclass(frozen=True)
class LayerPixels:
    """Pixels of a layer, on the device of their rays."""

    color: Tensor  # (r, 3)
    distance: Tensor  # (r, 1), +inf where nothing is shown
    alpha: Tensor | None  # (r, 1)

    def __getitem__(self, index: slice | Tensor) -> LayerPixels:
        """Returns some of the pixels."""
        alpha = None if self.alpha is None else self.alpha[index]
        return LayerPixels(self.color[index], self.distance[index], alpha)

    def trace(self, trace_rays: TraceRays, rays: Rays, stop_alpha: float) -> Hits:
        """Traces the rays of these pixels and composites voxels and layer. Depth, normal and
        features are those of the voxels alone; the normal is the mean in front of the layer and
        behind it, weighted by absorbed light. A ray that has reached `stop_alpha` with the layer
        ends there.
        """
        near, far = rays.range.split(1, dim=1)
        layer_distance = self.distance.to(rays.range.dtype)
        front_range = torch.cat((near, torch.maximum(near, torch.minimum(far, layer_distance))), 1)
        front = trace_rays(replace(rays, range=front_range))
        shown = self.distance < torch.inf
        alpha = shown if self.alpha is None else torch.where(shown, self.alpha, 0)
        layer = Hits(
            color=torch.where(shown, self.color, 0).to(front.color),
            alpha=alpha.to(front.alpha),
            depth=torch.full_like(front.depth, torch.inf),
            samples=torch.zeros_like(front.samples),
            missed=torch.zeros_like(front.missed),
        )
        front_and_layer = over(front, layer)
        if self.alpha is None:
            return front_and_layer
        onward = (layer_distance < torch.inf) & (front_and_layer.alpha < stop_alpha)
        start = torch.where(onward, torch.maximum(near, layer_distance), near)
        end = torch.where(onward, torch.maximum(start, far), start)
        back = trace_rays(replace(rays, range=torch.cat((start, end), 1)))
        total = over(front_and_layer, back)
        if front.normal is None or back.normal is None:
            return total
        # Light absorbed by the voxels behind the layer.
        absorbed = (1 - front_and_layer.alpha) * back.alpha
        normal = normalize(front.normal * front.alpha + back.normal * absorbed, dim=1)
        return replace(total, normal=torch.where(absorbed > 0, normal, front.normal))
