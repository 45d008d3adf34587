"""Computes filtered colours for the voxels of coarse levels. The finest voxels below such a voxel
are coloured by the transfer function and composited in columns along each axis, then columns are
averaged. For lit matter the second moments of the normals, which describe the orientation and
roughness of surfaces, are averaged in the same way.
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
from ..ops.shading import FAINT as _FAINT
from .shader import ColorTable

_TILE_VOXELS = {"cpu": 1 << 17, "cuda": 1 << 20}  # finest voxels that are processed at a time
_LEAST = 0.001  # weight of a column that no light reaches
_HIDDEN = 0.5  # a voxel with less than this share of its neighbours' light is hidden
_DIRECTIONS = 6
#: Numbers of a voxel seen along one direction: premultiplied colour and alpha; then, for lit
#: matter, the mean products xx xy xz yy yz zz of the components of its normals, premultiplied.
PLAIN, LIT = 4, 10


class FinestVoxels(Protocol):
    """The finest voxels, which need not fit into memory."""

    shape: tuple[int, int, int]  # z, y, x
    across: int  # voxels; side of the slabs that are read at once, on the two axes across columns

    def read(self, low: Sequence[int], high: Sequence[int]) -> Tensor:
        """Returns a box (z, y, x) on the CPU; beyond the field the outermost voxels repeat."""


class VolumeField:
    """One number of a volume's voxels."""

    across = 256

    def __init__(self, volume: Volume, component: int) -> None:
        self._values = volume.data[..., component].cpu()
        z, y, x = self._values.shape
        self.shape = (z, y, x)

    def read(self, low: Sequence[int], high: Sequence[int]) -> Tensor:
        """See `FinestVoxels`."""
        found = movable(self._values)
        for axis, (first, end, size) in enumerate(zip(low, high, self.shape, strict=True)):
            if first >= 0 and end <= size:
                found = found.narrow(axis, first, end - first)
            else:
                found = found.index_select(axis, torch.arange(first, end).clamp(0, size - 1))
        return found.view(self._values.dtype)


def write_colors(
    field: FinestVoxels,
    tables: Sequence[ColorTable],  # for columns along x, y, z: alpha over half a voxel
    spacing: tuple[float, float, float],
    branching: int,
    out: Sequence[Tensor],
    progress: Progress,  # called with ("filtered", voxels done, voxels in all)
    *,
    all_light: bool,
) -> None:
    """Writes the colours of the coarse levels, the finest of them first, (z, y, x, 6 * (n + 1))
    float16 each: for each of the directions +x -x +y -y +z -z, the n numbers (PLAIN or LIT) of a
    voxel seen in it, over a length of the smallest spacing, and the share of light that reached it.

    Columns are weighted by the light that reaches them in a voxel. With `all_light` everything
    before the voxel dims it, so that a row of voxels transmits what its columns do. This suits
    translucent matter, which looks much the same to an oblique ray. In opaque matter an oblique ray
    may see what no light reaches along an axis, so else only the voxel in front dims the light.
    """
    done, total = 0, 3 * math.prod(field.shape)
    numbers = out[0].shape[-1] // _DIRECTIONS if out else 0
    for axis, table in enumerate(tables):
        along, share = 2 - axis, min(spacing) / spacing[axis]
        sizes = [spacing[2 - a] for a in (along, *(a for a in range(3) if a != along))]
        painter = _Painter(table, sizes if numbers == LIT + 1 else None, along)
        mine = [
            level.unflatten(-1, (_DIRECTIONS, -1))[..., 2 * axis : 2 * axis + 2, :]
            .movedim(along, 0)
            .movedim(3, 0)
            for level in out
        ]  # (2, n, a, b, numbers)
        for level, a, b, sums in _see_along(field, along, painter, branching, len(out), all_light):
            light = sums[:, -1:]
            means = _of_length(sums[:, :-1] / light, share)
            part = light / (2 * branching ** (level + 1)) ** 2
            seen = torch.cat((means, part), 1).movedim(1, 4).to(torch.float16)
            high, wide = seen.shape[2:4]
            mine[level][:, :, a : a + high, b : b + wide] = seen
            if level == 0:
                done += field.shape[along] * high * wide * branching**2
                progress("filtered", min(done, total), total)
        for level in mine:
            _fill_hidden(level, table.table_lm4.device)


def _see_along(
    field: FinestVoxels,
    along: int,
    painter: _Painter,
    branching: int,
    levels: int,
    all_light: bool,
) -> Iterator[tuple[int, int, int, Tensor]]:
    """Yields blocks of coarse voxels, each voxel once, seen along an axis of the field: the level
    (0: finest coarse one), the block's first indices a, b across the axis, and weighted sums
    (2, c + 1, n, a, b), seen forwards and backwards: c numbers (see `LIT`) and the weight.
    """
    device = painter.table.table_lm4.device
    length = field.shape[along]
    sides = [axis for axis in range(3) if axis != along]
    across = [field.shape[axis] for axis in sides]
    tile, most = branching, _TILE_VOXELS[device.type]
    while tile * branching <= max(across) and length * (tile * branching) ** 2 <= most:
        tile *= branching
    whole = [branching ** (level + 1) for level in range(levels)]  # finest voxels along a side
    coarse = {  # for levels whose voxels are wider than a tile: sums of each tile's columns
        level: torch.zeros(
            (2, painter.width + 1, -(-length // side), *(-(-n // tile) for n in across)),
            device=device,
        )
        for level, side in enumerate(whole)
        if side > tile
    }
    for a, b, part in _parts(field, along, tile):
        values = part.to(device).to(torch.float32)
        empty = not _shows(values, painter.table)
        if empty:  # the fewest intervals that make up a voxel of level 0
            high, wide = (2 * n - 4 for n in part.shape[1:])
            columns = _Columns.empty(painter.width - 1, (2 * branching, high, wide), device)
        else:
            columns = painter.colored(values)
        columns = columns.joined(2)
        for level, side in enumerate(whole):
            if not empty or level == 0:
                columns = columns.joined(branching)
                weighted = columns.weighted(all_light)
            block = min(side, tile)
            seen = _pooled(weighted, 2 * block)
            if level in coarse:
                coarse[level][..., a // tile, b // tile] = seen[..., 0, 0]
            else:
                yield level, a // block, b // block, seen
    for level, sums in coarse.items():
        yield level, 0, 0, _pooled(sums, whole[level] // tile)


def _fill_hidden(seen: Tensor, device: torch.device) -> None:
    """Blends the colours of neighbours into voxels that hardly any light reaches. In `seen`,
    (2, n, a, b, c + 1), the last number is the light.

    A hidden voxel is only seen by rays that pass between it and a visible one, and interpolate the
    two. Such a ray along the rim of a solid would blend in half of the inside in each interval, so
    that solids would grow from afar.
    """
    most, (high, wide) = _TILE_VOXELS[device.type], seen.shape[2:4]
    rows = min(high, max(1, most // wide))
    for slab in seen.split(max(1, most // (rows * wide)), 1):
        before = torch.zeros_like(slab[:, :, :1], dtype=torch.float32, device=device)
        for first in range(0, high, rows):
            part = slab[:, :, first : first + rows]
            known = slab[:, :, first : first + rows + 1].to(device, torch.float32)
            sums = known[..., :-1] * known[..., -1:]
            sums = torch.cat((sums, known[..., -1:]), -1)
            count = part.shape[2]
            missing = count + 1 - known.shape[2]  # 1 where no row follows
            near = _beside(torch.cat((before, _padded(sums, 2, 0, missing)), 2), 2)
            near = _beside(_padded(near, 3, 1, 1), 3)
            before, sums = sums[:, :, count - 1 : count], sums[:, :, :count]
            light, around = sums[..., -1:], near[..., -1:]
            lack = (1 - light / (_HIDDEN * around)).clamp(min=0)
            total = sums + lack * lack * near
            part[..., :-1] = (total[..., :-1] / total[..., -1:]).to(part)


def _padded(values: Tensor, axis: int, before: int, behind: int) -> Tensor:
    """Pads an axis with zeros."""
    sides = [0, 0] * (values.dim() - axis - 1) + [before, behind]
    return torch.nn.functional.pad(values, sides)


def _beside(values: Tensor, axis: int) -> Tensor:
    """Returns means of three neighbours along an axis, the middle one weighted twice."""
    count = values.shape[axis] - 2
    first, middle, last = (values.narrow(axis, at, count) for at in range(3))
    return 0.25 * first + 0.5 * middle + 0.25 * last


def _parts(field: FinestVoxels, along: int, tile: int) -> Iterator[tuple[int, int, Tensor]]:
    """Yields the field in columns along an axis, tile by tile: a tile's first indices across the
    axis, and its values (n, a + 2, b + 2) with a neighbour on each side. Reads slabs of many tiles.
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
    """Returns whether any value between a part's smallest and largest has an opacity."""
    last = len(table.opaque_m) - 1
    low, high = table.domain_2.tolist()
    ends = (torch.stack(part.aminmax()) - low) * (last / (high - low))
    first, end = (int(end) for end in ends.clamp(0, last).tolist())
    rows = table.opaque_m[[max(first - 1, 0), min(end + 1, last)]].tolist()
    return rows[1] > (rows[0] if first > 0 else 0)


def _finer(part: Tensor, slope: int | None = None) -> Tensor:
    """Resamples (n, a + 2, b + 2) values, which have neighbours on the sides, twice as finely:
    returns (2n, 2a, 2b) values a quarter of a voxel on either side of the voxel centres. Or, if
    `slope` is an axis, differences along it, over half a voxel on either side of these positions.
    """
    last = len(part) - 1
    index = torch.arange(last + 1, device=part.device)
    before, behind = (part[(index + step).clamp(0, last)] for step in (-1, 1))
    part = _between(part, before, behind, 0, slope)
    part = _between(part[:, 1:-1], part[:, :-2], part[:, 2:], 1, slope)
    return _between(part[:, :, 1:-1], part[:, :, :-2], part[:, :, 2:], 2, slope)


def _between(here: Tensor, before: Tensor, behind: Tensor, axis: int, slope: int | None) -> Tensor:
    if axis == slope:
        rise, fall = behind - here, here - before
        sides = (0.25 * rise + 0.75 * fall, 0.75 * rise + 0.25 * fall)
    else:
        sides = (0.75 * here + 0.25 * before, 0.75 * here + 0.25 * behind)
    return torch.stack(sides, axis + 1).flatten(axis, axis + 1)


@dataclass(frozen=True)
class _Columns:
    """Columns of n intervals each, along the first axis of (n, a, b)."""

    front: Tensor  # (c, n, a, b) premultiplied colour, and moments, seen from the front
    back: Tensor  # (c, n, a, b) the same seen from behind
    clear: Tensor  # (n, a, b) transmittance

    @classmethod
    def empty(cls, numbers: int, shape: tuple[int, ...], device: torch.device) -> _Columns:
        """Returns intervals that hold nothing."""
        color = torch.zeros((numbers, *shape), device=device)
        return cls(color, color, torch.ones(shape, device=device))

    def joined(self, count: int) -> _Columns:
        """Composites every `count` intervals into one; the last is repeated if some are missing."""
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

    def weighted(self, all_light: bool) -> Tensor:
        """Returns (2, c + 2, n, a, b) colour, alpha, moments and 1, seen from both sides, times the
        light that reaches each interval; see `write_colors`.
        """
        whole = torch.ones_like(self.clear[:1])
        before = torch.cat((whole, self.clear[:-1]))
        behind = torch.cat((self.clear[1:], whole))
        if all_light:
            before, behind = before.cumprod(0), behind.flip(0).cumprod(0).flip(0)
        before, behind = before + _LEAST, behind + _LEAST
        alpha = 1 - self.clear
        sides = [
            [color[:3] * light, (alpha * light)[None], light[None]]
            for color, light in ((self.front, before), (self.back, behind))
        ]
        if len(self.front) > 3:
            sides[0].insert(2, _surfaces(self.front, alpha, before, 1))
            sides[1].insert(2, _surfaces(self.back, alpha, behind, -1))
        return torch.stack([torch.cat(side) for side in sides])


def _surfaces(color: Tensor, alpha: Tensor, light: Tensor, step: int) -> Tensor:
    """Returns the moments of intervals (c - 3, n, a, b), weighted by light. Rays also blend in the
    inside of solids, which no light reaches: there an interval takes the moments of the last one
    before it that light reaches, divided by `_FAINT`, so that other directions count more.
    """
    index = torch.arange(len(alpha), device=alpha.device)[:, None, None]
    comes = light > 2 * _LEAST
    if step > 0:
        place = torch.where(comes, index, 0).cummax(0).values
    else:
        place = torch.where(comes, index, len(alpha) - 1).flip(0).cummin(0).values.flip(0)
    thick = alpha.gather(0, place)
    part = light * torch.where(thick > 0, alpha / torch.where(thick > 0, thick, 1.0), 0.0)
    part = torch.where(comes, part, part / _FAINT)
    return color[3:].gather(1, place.expand_as(color[3:])) * part


@dataclass(frozen=True)
class _Painter:
    """Turns values into coloured intervals."""

    table: ColorTable
    sizes: Sequence[float] | None  # of a voxel along each axis of the values; None: no normals
    along: int  # the axis (z, y, x) of the field that is the first axis of the values

    @property
    def width(self) -> int:
        """How many numbers an interval has: PLAIN or LIT."""
        return PLAIN if self.sizes is None else LIT

    def colored(self, part: Tensor) -> _Columns:
        """Returns intervals of half a voxel, coloured from (n, a + 2, b + 2) values, which have
        neighbours on the sides.
        """
        values = _finer(part)
        low, high = self.table.domain_2
        rows = self.table.table_lm4[0]
        place = ((values - low) * ((len(rows) - 1) / (high - low))).clamp(0, len(rows) - 1)
        row = place.to(torch.int64).clamp(max=len(rows) - 2)
        part_of = place - row
        numbers = [torch.lerp(one[row], one[row + 1], part_of) for one in rows.T.contiguous()]
        color = [one * numbers[3] for one in numbers[:3]]
        if self.sizes is not None:
            color += [one * numbers[3] for one in self.moments(part, self.sizes)]
        seen = torch.stack(color)
        return _Columns(seen, seen, 1 - numbers[3])

    def moments(self, part: Tensor, sizes: Sequence[float]) -> list[Tensor]:
        """Returns the products xx xy xz yy yz zz of unit normals; 0 where there is no gradient."""
        slopes = [_finer(part, axis) / sizes[axis] for axis in range(3)]
        most = torch.stack([one.abs() for one in slopes]).amax(0)
        scaled = [one / torch.where(most > 0, most, 1.0) for one in slopes]
        square = scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2]
        share = 1 / torch.where(square > 0, square, 1.0)
        others = [axis for axis in range(3) if axis != self.along]
        z, y, x = (scaled[[self.along, *others].index(axis)] for axis in range(3))
        return [a * b * share for a, b in ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))]


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


def without_light(colors: Tensor) -> Tensor:
    """Drops the shares of light: returns (..., 6 * n) of `write_colors`' (..., 6 * (n + 1))."""
    return colors.unflatten(-1, (_DIRECTIONS, -1))[..., :-1].flatten(-2)


def mean_of_directions(colors: Tensor) -> Tensor:
    """Returns the mean (..., n) of (..., 6 * n), of the same dtype. Moments are divided by _FAINT,
    which the shader multiplies their trace by: light reaches all of such matter, so the product is
    the share of it that has a normal.
    """
    first, *others = colors.split(colors.shape[-1] // _DIRECTIONS, -1)
    total = first.float()
    for one in others:
        total += one
    mean = total / _DIRECTIONS
    mean[..., PLAIN:] /= _FAINT
    return mean.to(colors.dtype)


def _of_length(colors: Tensor, lengths: float) -> Tensor:
    """Rescales numbers (2, c, ...) of homogeneous matter to another length."""
    if lengths == 1:
        return colors
    alpha = colors[:, 3:4]
    changed = 1 - (1 - alpha).clamp(min=1e-30) ** lengths
    scale = changed / torch.where(alpha > 0, alpha, 1.0)
    return torch.cat((colors[:, :3] * scale, changed, colors[:, 4:] * scale), 1)
