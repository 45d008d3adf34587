"""`straighten`: resamples a source along the world's axes if its own are not parallel to them.

Values are interpolated (trilinear, float64); labels are those of the nearest voxel. A region of the
result reads only the voxels of the source that it overlaps, and has the same bits as in the whole.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from ..base import boxes
from ..base.downsample import round_array
from ..base.image_info import Rows
from .source import Index, VolumeSource

Oblique = Literal["resample", "keep"]

_SLAB_VOXELS = 1 << 18  # voxels that are interpolated at a time
_ROUNDING_VOXELS = 2.0**-20  # voxels by which rounding may shift a position


@dataclass(frozen=True, kw_only=True)
class StraightSource(VolumeSource):
    """A source resampled on a grid parallel to the world's axes, (t, z, y, x, c)."""

    inner: VolumeSource
    to_inner: tuple[tuple[float, ...], ...]  # (3, 4): from this grid's x, y, z to `inner`'s, voxels
    nearest: bool  # takes the nearest value instead of interpolating
    fill: float  # value of voxels that lie outside `inner`

    @property
    def peak_bytes(self) -> int:
        """Bytes that reading a time point takes: the inner source is held while it is resampled."""
        return self.inner.peak_bytes + self.nbytes

    def check_file(self) -> None:
        self.inner.check_file()

    def read_stored(self, index: Index) -> np.ndarray:
        times, (low, high) = index[0], boxes.box_of(index[1:4])
        size = [b - a for a, b in zip(low, high, strict=True)]
        out = np.empty((times.stop - times.start, *size, self.width), self.stored)
        out[...] = self.fill
        start, stop = self._inner_box(low, high)
        if any(a >= b for a, b in zip(start, stop, strict=True)):
            return out[..., index[4]]
        rows = max(1, _SLAB_VOXELS // math.prod(size[1:]))
        inner_times = self.inner.read_box(start, stop, (times.start, times.stop))
        for values, out_values in zip(inner_times, out, strict=True):
            for z in range(low[0], high[0], rows):
                box = (z, *low[1:]), (min(z + rows, high[0]), *high[1:])
                self._resample(values, start, box, out_values[z - low[0] : box[1][0] - low[0]])
        return out[..., index[4]]

    def _inner_box(self, low: Sequence[int], high: Sequence[int]) -> tuple[list[int], list[int]]:
        """Returns start and stop, z y x, of the inner voxels under a box; none if stop <= start."""
        ends = zip(low, np.subtract(high, 1), strict=True)
        corners = np.array([(x, y, z, 1) for z, y, x in itertools.product(*ends)])
        positions = (corners @ np.array(self.to_inner).T)[:, ::-1]
        shape = np.array(self.inner.extent[::-1])
        first = np.floor(positions.min(0) - _ROUNDING_VOXELS)
        last = np.floor(positions.max(0) + _ROUNDING_VOXELS) + 2
        start, stop = np.maximum(first, 0), np.minimum(last, shape)
        return start.astype(int).tolist(), stop.astype(int).tolist()

    def _resample(
        self,
        values: np.ndarray,
        start: Sequence[int],
        box: tuple[Sequence[int], Sequence[int]],
        out: np.ndarray,
    ) -> None:
        """Writes a box (z, y, x, c) from inner values (z, y, x, c), of voxels from `start` on."""
        z, y, x = np.ogrid[boxes.index(*box)]
        # Inner positions x, y, z: a voxel has the same bits in any box.
        xyz = [a * x + b * y + c * z + d for a, b, c, d in self.to_inner]
        positions = np.broadcast_arrays(*xyz[::-1])
        pairs = list(zip(positions, self.inner.extent[::-1], strict=True))
        inside = np.ones(positions[0].shape, bool)
        for a, n in pairs:
            inside &= (a >= -0.5 - _ROUNDING_VOXELS) & (a <= n - 0.5 + _ROUNDING_VOXELS)
        if not inside.any():
            return
        places = [a[inside].clip(0, n - 1) for a, n in pairs]
        if self.nearest:
            voxels = (np.floor(a + 0.5).astype(np.int64) for a in places)
            out[inside] = values[tuple(v - s for v, s in zip(voxels, start, strict=True))]
            return
        sizes = values.shape[:3]
        axes = [(a, np.floor(a), n, s) for a, n, s in zip(places, sizes, start, strict=True)]
        total = np.zeros((len(places[0]), values.shape[3]))
        for corner in itertools.product((0, 1), repeat=3):
            weight, index = np.ones(len(places[0])), []
            for (a, first, n, s), upper in zip(axes, corner, strict=True):
                weight = weight * (a - first if upper else 1 - (a - first))
                position = (first + upper).astype(np.int64) - s
                index.append(np.minimum(position, n - 1))  # voxels beyond have weight 0
            corner_values = values[tuple(index)].astype(np.float64)
            # Where the weight is 0 the value may be NaN, and 0 * NaN is NaN.
            total += np.where(weight[:, None] > 0, corner_values * weight[:, None], 0)
        out[inside] = round_array(total, out.dtype)


def straighten(
    source: VolumeSource, oblique: Oblique | None = None, first_voxel: Sequence[float] | None = None
) -> VolumeSource:
    """Returns a source whose axes are parallel to the world's, and warns about what it did.

    The new spacing along an axis of the world is that of the voxels in that direction, and the grid
    covers the source's whole box. Voxels outside that box are 0 for labels, else the smallest value
    at the source's `time`.

    Args:
        source: Returned as it is, if its axes are parallel to the world's.
        oblique: "resample" (the default), or "keep": the voxels stay as they are, and their axes
            count as the world's; `info.pose` holds the missing rotation (`RenderOptions.pose`).
        first_voxel: World position of the first voxel, if it is not the file's.

    Raises:
        ValueError: `oblique` is something else.
        OSError: The smallest value can't be read.
    """
    from ..base import check  # imports torch, which workers of a conversion do without

    if oblique is not None:
        check.one_of(source.path, "oblique", oblique, get_args(Oblique))
    if source.oblique is None:
        return source
    affine = np.array(source.oblique)
    lengths = np.linalg.norm(affine[:, :3], axis=0)
    degrees = math.degrees(math.acos(min(1.0, (np.abs(affine[:, :3]).max(0) / lengths).min())))
    message = f"{Path(source.path).name}: voxel axes are turned by {degrees:.3g} degrees"
    if oblique == "keep":
        origin = np.array(source.origin if first_voxel is None else first_voxel)
        pose = _pose(affine[:, :3] / lengths, origin)
        hint = "" if pose is None else "; info.pose turns them (gv.render(..., pose=...))"
        warnings.warn(f"{message}: kept, and treated as the world's axes{hint}", stacklevel=3)
        info = dataclasses.replace(source.info, pose=pose)
        return dataclasses.replace(source, oblique=None, info=info)
    extent, spacing, origin, to_inner = _grid(affine, source.extent)
    fill = 0.0 if source.info.labels else _smallest_value(source)
    x, y, z = extent.tolist()
    warnings.warn(
        f"{message}: resampled along the world's axes, {x}x{y}x{z} voxels of "
        f"{' x '.join(f'{s:.4g}' for s in spacing)}; oblique='keep' (--oblique keep) keeps the "
        "voxels as they are",
        stacklevel=3,
    )
    fields = {name: getattr(source, name) for name in ("path", "info", "dropped", "time", "whole")}
    return StraightSource(
        shape=(source.times, z, y, x, source.width),
        axes="tzyxc",
        stored=source.dtype,
        spacing=tuple(spacing.tolist()),
        origin=tuple(origin.tolist()),
        inner=dataclasses.replace(source, oblique=None),
        to_inner=tuple(map(tuple, to_inner.tolist())),
        nearest=source.info.labels,
        fill=fill,
        **fields,
    )


def _grid(affine: np.ndarray, inner_extent: Sequence[int]) -> tuple[np.ndarray, ...]:
    """Returns extent, spacing and origin (x, y, z) of a grid along the world's axes that covers all
    voxels, and the affine from its voxels to theirs, (3, 4).
    """
    inverse = np.linalg.inv(affine[:, :3])
    spacing = 1 / np.linalg.norm(inverse, axis=0)
    ends = [(-0.5, n - 0.5) for n in inner_extent]
    corners = np.array(list(itertools.product(*ends))) @ affine[:, :3].T + affine[:, 3]
    low, high = corners.min(0), corners.max(0)
    extent = np.ceil((high - low) / spacing - 1e-6).astype(int).clip(1)
    origin = (low + high - (extent - 1) * spacing) / 2
    to_inner = np.column_stack((inverse * spacing, inverse @ (origin - affine[:, 3])))
    return extent, spacing, origin, to_inner


def _pose(rotation: np.ndarray, origin: np.ndarray) -> Rows | None:
    """Returns the (4, 4) rotation of the axes about the first voxel; None if they are sheared."""
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-4:
        return None
    left, _, right = np.linalg.svd(rotation)
    rotation = left @ right
    matrix = np.block([[rotation, (origin - rotation @ origin)[:, None]], [np.eye(4)[3:]]])
    return tuple(map(tuple, matrix.tolist()))


def _smallest_value(source: VolumeSource) -> float:
    """Returns the smallest finite value, reading part by part where that is possible."""
    x, y, z = source.extent
    rows = z if source.whole else max(1, 16 * _SLAB_VOXELS // (y * x * source.width))
    smallest = math.inf
    for low in range(0, z, rows):
        part = source.read_region((low, 0, 0), (min(low + rows, z), y, x))
        finite = part[np.isfinite(part)] if part.dtype.kind == "f" else part
        smallest = min(smallest, float(finite.min()) if finite.size else math.inf)
    return smallest if smallest < math.inf else 0.0
