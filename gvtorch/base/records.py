"""The records that the steps of a frame pass to each other, and what a picture cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from . import check


def to_device(
    value: Any, device: torch.device | str | None, dtype: torch.dtype | None = None
) -> Any:
    """Returns a tensor on a device, in another dtype if it holds floats; anything else as it is."""
    if not isinstance(value, Tensor):
        return value
    return value.to(device, dtype if value.is_floating_point() else None)


@dataclass(frozen=True, kw_only=True, repr=False)
class Rays:
    """Rays in world units, all float32 or all float64 on one device."""

    origin: Tensor  # (r, 3)
    direction: Tensor  # (r, 3), unit length
    cone: Tensor  # (r, 2) width at the origin, growth of the width per unit distance
    range: Tensor  # (r, 2) first and last distance along the ray; +inf is allowed for the last
    width: int = 0  # pixels per row if the rays are whole rows of a picture: traced in tiles
    transmittance: Tensor | None = None  # (r,) at the first distance; None: 1
    # (r,) int64: index of the pixel in its picture + 2^32 * index of the pixel's sample; None: the
    # index of the ray. `Lighting` derives its directions from it.
    sample: Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("origin", "direction", "cone", "range"):
            check.instance("Rays", name, getattr(self, name), Tensor)

    def __getitem__(self, index: Tensor | slice) -> Rays:
        """Returns some of the rays; they no longer count as rows of a picture (width 0)."""
        return self._convert_columns(lambda column: column[index], 0)

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Rays:
        """Returns the rays on a device, in float32 or float64; None leaves either as it is."""
        return self._convert_columns(lambda column: to_device(column, device, dtype), self.width)

    def light(self) -> Tensor:
        """Returns (r, 1) float64 transmittance at the first distance."""
        if self.transmittance is None:
            return torch.ones_like(self.origin[:, :1], dtype=torch.float64)
        return self.transmittance[:, None].to(torch.float64)

    def _convert_columns(self, convert: Callable[[Tensor], Tensor], width: int) -> Rays:
        columns = {name: value for name, value in vars(self).items() if name != "width"}
        changed = {n: None if value is None else convert(value) for n, value in columns.items()}
        return Rays(**changed, width=width)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        rows = f", rows of {self.width}" if self.width else ""
        return f"Rays({check.describe(self.origin)}{rows})"


@dataclass(frozen=True, kw_only=True, repr=False)
class Hits:
    """The results of tracing rays; floats are of the dtype that the rays were traced in."""

    color: Tensor  # (r, 3) linear RGB, premultiplied by alpha
    alpha: Tensor  # (r, 1) 0 to 1
    depth: Tensor  # (r, 1) distance along the ray in world units, +inf where nothing was hit
    samples: Tensor  # (r,) int32, positions at which the shader was evaluated
    missed: Tensor  # (r,) bool, true where a node or brick that the ray wanted was missing
    # Only some shaders give these, else None:
    normal: Tensor | None = None  # (r, 3) world, towards the eye, of unit length or 0
    features: Tensor | None = None  # (r, c) what the shader sums along the ray, as `Features`
    label: Tensor | None = None  # (r, 1) int64, at the depth; -1 where nothing was hit

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Hits:
        """Returns the hits on a device, floats in another dtype. None leaves either as it is."""
        return replace(self, **{n: to_device(v, device, dtype) for n, v in vars(self).items()})

    def __repr__(self) -> str:
        extra = [n for n in ("normal", "features", "label") if getattr(self, n) is not None]
        return f"Hits({', '.join([check.describe(self.color), *extra])})"


@dataclass(kw_only=True, repr=False)
class RenderStats:
    """What a picture cost."""

    milliseconds: float = 0.0  # wall time of the whole call
    stages: dict[str, float] = field(default_factory=dict)  # milliseconds by stage
    backend: str = ""
    rays: int = 0
    samples: int = 0  # positions at which the shader was evaluated
    nodes: int = 0  # nodes in the pool
    bricks: int = 0  # bricks in the pool
    bytes: int = 0  # memory of the pools
    tiles_used: int = 0  # node tiles that rays passed through
    bricks_used: int = 0  # bricks that rays sampled

    def after(self, before: RenderStats) -> RenderStats:
        """Returns these statistics with the milliseconds, rays and samples of `before`, the earlier
        parts of the same picture, added.
        """
        summed = ("milliseconds", "rays", "samples")
        return replace(self, **{n: getattr(self, n) + getattr(before, n) for n in summed})

    def as_dict(self) -> dict[str, object]:
        """Returns plain values, ready for JSON."""
        return asdict(self)

    def __repr__(self) -> str:
        cost = f"{self.rays} rays, {self.samples} samples, {self.milliseconds:.1f} ms"
        return f"RenderStats({self.backend}: {cost})"


def add(sums: dict[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Adds the numbers of `more` to `sums` by name, in place; returns `sums`."""
    for key, value in more.items():
        sums[key] = sums.get(key, 0) + value
    return sums
