"""What a transfer function makes of the finest voxels, for each voxel of the coarse levels: columns
of them along each axis, coloured and composited, and of the columns the mean.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ..base.stage import Progress
from ..base.volume import Volume, movable
from .shader import ColorTable

_TILE_VOXELS = {"cpu": 1 << 17, "cuda": 1 << 20}  # whose columns are worked out at a time
_LEAST = 0.001  # weight of a column that no light comes to
_DIRECTIONS = 6


class Field(Protocol):
    """The finest voxels, which may be more than memory holds."""

    shape: tuple[int, int, int]  # z, y, x
    across: int  # voxels that are read at once on either side of what they are read along

    def read(self, low: Sequence[int], high: Sequence[int]) -> Tensor:
        """Returns a box (z, y, x) on the CPU; beyond the field its outermost voxels repeat."""


class VolumeField:
    """One number of a volume's voxels."""

    across = 256

    def __init__(self, volume: Volume, component: int) -> None:
        self._values = volume.data[..., component]
        z, y, x = self._values.shape
        self.shape = (z, y, x)

    def read(self, low: Sequence[int], high: Sequence[int]) -> Tensor:
        """See `Field`."""
        found = movable(self._values)
        for axis, (first, end, size) in enumerate(zip(low, high, self.shape, strict=True)):
            if first >= 0 and end <= size:
                found = found.narrow(axis, first, end - first)
            else:
                found = found.index_select(axis, torch.arange(first, end).clamp(0, size - 1))
        return found.view(self._values.dtype)


def write_colors(
    field: Field,
    tables: Sequence[ColorTable],
    shares: Sequence[float],
    branching: int,
    out: Sequence[Tensor],
    progress: Progress,
) -> None:
    """Writes the colours of the coarse levels.

    Args:
        field: The finest voxels.
        tables: For each axis x, y, z the colours of intervals of half a voxel, on the device that
            works.
        shares: For each axis, the length that an alpha is stored for, in voxels along this axis.
        branching: N.
        out: For each coarse level, the finest of them first, (z, y, x, 24) float16: premultiplied
            colour and alpha of its voxels as seen along +x -x +y -y +z -z.
        progress: Told ("filtered", voxels done, voxels in all).
    """
    done, total = 0, 3 * math.prod(field.shape)
    for axis, (table, share) in enumerate(zip(tables, shares, strict=True)):
        along = 2 - axis
        for level, a, b, sums in _see_along(field, along, table, branching, len(out)):
            means = (sums[:, :4] / sums[:, 4:]).flatten(0, 1).movedim(0, 3)
            colors = _of_length(means, share).to(torch.float16)
            _, high, wide, _ = colors.shape
            columns = out[level].movedim(along, 0)[..., 8 * axis : 8 * axis + 8]
            columns[:, a : a + high, b : b + wide] = colors
            if level == 0:
                done += field.shape[along] * high * wide * branching**2
                progress("filtered", min(done, total), total)


def _see_along(
    field: Field,
    along: int,
    table: ColorTable,
    branching: int,
    levels: int,
) -> Iterator[tuple[int, int, int, Tensor]]:
    """Yields what is seen along an axis of the field: a coarse level, two places across, and of the
    voxels that begin there the weighted sums (2, 5, n, a, b), forwards and backwards: premultiplied
    colour, alpha and weight. Each voxel comes once.
    """
    device = table.table_lm4.device
    length = field.shape[along]
    sides = [axis for axis in range(3) if axis != along]
    across = [field.shape[axis] for axis in sides]
    tile, most = branching, _TILE_VOXELS[device.type]
    while tile * branching <= max(across) and length * (tile * branching) ** 2 <= most:
        tile *= branching
    whole = [branching ** (level + 1) for level in range(levels)]  # finest voxels along a side
    coarse = {  # sums of columns of a tile, where a voxel is wider than a tile
        level: torch.zeros(
            (2, 5, -(-length // side), *(-(-n // tile) for n in across)), device=device
        )
        for level, side in enumerate(whole)
        if side > tile
    }
    for a, b, part in _parts(field, along, tile):
        values = part.to(device).to(torch.float32)
        empty = not _shows(values, table)
        if empty:  # as few intervals as make a voxel of the first level
            high, wide = (2 * n - 4 for n in part.shape[1:])
            columns = _Columns.empty((2 * branching, high, wide), device)
        else:
            columns = _colored(_finer(values), table)
        columns = columns.joined(2)
        for level, side in enumerate(whole):
            if not empty or level == 0:
                columns = columns.joined(branching)
                weighted = columns.weighted()
            block = min(side, tile)
            seen = _pooled(weighted, 2 * block)
            if level in coarse:
                coarse[level][..., a // tile, b // tile] = seen[..., 0, 0]
            else:
                yield level, a // block, b // block, seen
    for level, sums in coarse.items():
        yield level, 0, 0, _pooled(sums, whole[level] // tile)


def _parts(field: Field, along: int, tile: int) -> Iterator[tuple[int, int, Tensor]]:
    """Yields the field in columns along an axis, tile by tile: where a tile begins across, and its
    values (n, a + 2, b + 2) with a neighbour on each side. They are read in slabs of many tiles.
    """
    slab = tile * max(1, field.across // tile)
    size, sides = field.shape, [axis for axis in range(3) if axis != along]
    across = [range(0, size[axis], slab) for axis in sides]
    for corner in itertools.product(*across):
        low, high = [0, 0, 0], list(size)
        for axis, first in zip(sides, corner, strict=True):
            low[axis], high[axis] = first - 1, min(first + slab, size[axis]) + 1
        values = field.read(low, high).movedim(along, 0)
        _, *ends = values.shape
        for a, b in itertools.product(*(range(0, end - 2, tile) for end in ends)):
            yield corner[0] + a, corner[1] + b, values[:, a : a + tile + 2, b : b + tile + 2]


def _shows(part: Tensor, table: ColorTable) -> bool:
    """Whether any value between the smallest and the largest of a part has an opacity."""
    last = len(table.opaque_m) - 1
    low, high = table.domain_2.tolist()
    ends = (torch.stack(part.aminmax()) - low) * (last / (high - low))
    first, end = (int(end) for end in ends.clamp(0, last).tolist())
    rows = table.opaque_m[[max(first - 1, 0), min(end + 1, last)]].tolist()
    return rows[1] > (rows[0] if first > 0 else 0)


def _finer(part: Tensor) -> Tensor:
    """Samples (n, a + 2, b + 2) values, with neighbours on the sides, twice as finely: returns
    (2n, 2a, 2b), a quarter of a voxel on either side of the centres.
    """
    last = len(part) - 1
    index = torch.arange(last + 1, device=part.device)
    before, behind = (part[(index + step).clamp(0, last)] for step in (-1, 1))
    part = _between(part, before, behind, 0)
    part = _between(part[:, 1:-1], part[:, :-2], part[:, 2:], 1)
    return _between(part[:, :, 1:-1], part[:, :, :-2], part[:, :, 2:], 2)


def _between(here: Tensor, before: Tensor, behind: Tensor, axis: int) -> Tensor:
    sides = (0.75 * here + 0.25 * before, 0.75 * here + 0.25 * behind)
    return torch.stack(sides, axis + 1).flatten(axis, axis + 1)


@dataclass(frozen=True)
class _Columns:
    """Intervals of columns along the first axis of (n, a, b)."""

    front: Tensor  # (3, n, a, b) premultiplied colour as seen from the front
    back: Tensor  # (3, n, a, b) and from behind
    clear: Tensor  # (n, a, b) transmittance

    @classmethod
    def empty(cls, shape: tuple[int, ...], device: torch.device) -> _Columns:
        """Returns intervals of nothing."""
        color = torch.zeros((3, *shape), device=device)
        return cls(color, color, torch.ones(shape, device=device))

    def joined(self, count: int) -> _Columns:
        """Makes one of every `count` intervals; the last is repeated where there are too few."""
        length = len(self.clear)
        if length % count:
            index = torch.arange(-(-length // count) * count, device=self.clear.device)
            index = index.clamp(max=length - 1)
            given = (self.front[:, index], self.back[:, index], self.clear[index])
            return _Columns(*given).joined(count)
        front, back = (c.unflatten(1, (-1, count)).unbind(2) for c in (self.front, self.back))
        clear = self.clear.unflatten(0, (-1, count)).unbind(1)
        ahead, behind, passes = front[0], back[0], clear[0]
        for k in range(1, count):
            ahead = torch.addcmul(ahead, passes, front[k])
            behind = torch.addcmul(back[k], clear[k], behind)
            passes = passes * clear[k]
        return _Columns(ahead, behind, passes)

    def weighted(self) -> Tensor:
        """Returns (2, 5, n, a, b) colour, alpha and 1, from both sides, times the light that the
        interval before lets through.
        """
        whole = torch.ones_like(self.clear[:1])
        before = torch.cat((whole, self.clear[:-1])) + _LEAST
        behind = torch.cat((self.clear[1:], whole)) + _LEAST
        alpha = 1 - self.clear
        sides = [
            torch.cat((color * light, (alpha * light)[None], light[None]))
            for color, light in ((self.front, before), (self.back, behind))
        ]
        return torch.stack(sides)


def _colored(values: Tensor, table: ColorTable) -> _Columns:
    """Returns what one interval of each value shows."""
    low, high = table.domain_2
    rows = table.table_lm4[0]
    place = ((values - low) * ((len(rows) - 1) / (high - low))).clamp(0, len(rows) - 1)
    row = place.to(torch.int64).clamp(max=len(rows) - 2)
    part = place - row
    numbers = [torch.lerp(one[row], one[row + 1], part) for one in rows.T.contiguous()]
    color = torch.stack([one * numbers[3] for one in numbers[:3]])
    return _Columns(color, color, 1 - numbers[3])


def _pooled(values: Tensor, block: int) -> Tensor:
    """Returns sums (..., n, a / block, b / block) over blocks of values (..., n, a, b)."""
    if block == 1:
        return values
    missing = [-size % block for size in values.shape[-2:]]
    if any(missing):
        values = torch.nn.functional.pad(values, (0, missing[1], 0, missing[0]))
    flat = values.flatten(0, -3)[:, None]
    pooled = torch.nn.functional.avg_pool2d(flat, block, divisor_override=1)
    return pooled[:, 0].unflatten(0, values.shape[:-2])


def mean_of_directions(colors: Tensor) -> Tensor:
    """Returns (..., 4) of (..., 24), of the same dtype."""
    first, *others = colors.split(4, -1)
    total = first.float()
    for one in others:
        total += one
    return (total / _DIRECTIONS).to(colors.dtype)


def _of_length(colors: Tensor, lengths: float) -> Tensor:
    """Returns colours (..., 8) of homogeneous matter over other lengths."""
    if lengths == 1:
        return colors
    pairs = colors.unflatten(-1, (2, 4))
    alpha = pairs[..., 3:]
    changed = 1 - (1 - alpha).clamp(min=1e-30) ** lengths
    scale = changed / torch.where(alpha > 0, alpha, 1.0)
    return torch.cat((pairs[..., :3] * scale, changed), -1).flatten(-2)
