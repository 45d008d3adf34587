"""Computes filtered colours for the voxels of coarse levels. The finest voxels below such a voxel
are coloured by the transfer function and composited in columns along each axis, then columns are
averaged. For lit matter the second moments of the normals, which describe the orientation and
roughness of surfaces, are averaged in the same way.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..base import boxes
from ..base.stage import Progress
from ..base.volume import DIRECTIONS, Volume, to_numpy
from ..ops.reference.march import Transfer
from ..ops.shading import COLOR_WIDTH, FAINT, LIT_COLOR_WIDTH
from .shader import ColorTable, row_and_fraction

_TILE_VOXELS = {"cpu": 1 << 17, "cuda": 1 << 20}  # finest voxels that are processed at a time
_MIN_LIGHT = 0.001  # weight of a column that no light reaches
_HIDDEN_BELOW = 0.5  # a voxel with less than this share of its neighbours' light is hidden


@dataclass(frozen=True)
class FinestVoxels:
    """One number of the finest voxels, which need not fit into memory."""

    shape: tuple[int, ...]  # z, y, x
    slab_side: int  # voxels, of the slabs that are read at once, on the two axes across columns
    #: Returns the box (z, y, x) on the CPU from one corner to another; beyond the field the
    #: outermost voxels repeat.
    read: Callable[[Sequence[int], Sequence[int]], Tensor]

    @classmethod
    def of(cls, volume: Volume, component: int) -> FinestVoxels:
        """Returns those of a volume."""
        values = to_numpy(volume.data[..., component])

        def read(low: Sequence[int], high: Sequence[int]) -> Tensor:
            start, stop = boxes.clamped_box(low, high, values.shape)
            part = values[boxes.index(start, stop)]
            return torch.from_numpy(boxes.repeat_edges(part, start, low, high))

        return cls(values.shape, 256, read)


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
    float16 each: for each of `DIRECTIONS`, the n numbers (COLOR_WIDTH or LIT_COLOR_WIDTH) of a
    voxel seen in it, over a length of the smallest spacing, and the share of light that reached it.

    Columns are weighted by the light that reaches them in a voxel. If `all_light` is true,
    everything in front of the voxel dims this light, so that a row of voxels transmits what its
    columns do: this suits translucent matter, which looks much the same to an oblique ray. If it is
    false, only the voxel in front does: this suits opaque matter, of which an oblique ray may see
    what no light reaches along an axis.
    """
    done, total = 0, 3 * math.prod(field.shape)
    numbers = out[0].shape[-1] // len(DIRECTIONS) if out else 0
    for axis, table in enumerate(tables):
        column_axis, length_ratio = 2 - axis, min(spacing) / spacing[axis]
        sizes = [spacing[2 - a] for a in (column_axis, *(a for a in range(3) if a != column_axis))]
        painter = _Painter(table, sizes if numbers == LIT_COLOR_WIDTH + 1 else None, column_axis)
        sides = slice(2 * axis, 2 * axis + 2)
        by_side = [level.unflatten(-1, (len(DIRECTIONS), -1))[..., sides, :] for level in out]
        # (2, n, a, b, numbers)
        axis_levels = [level.movedim((3, column_axis), (0, 1)) for level in by_side]
        blocks = _sums_along(field, column_axis, painter, branching, len(out), all_light)
        for level, a, b, sums in blocks:
            light = sums[:, -1:]
            means = _scaled_to_length(sums[:, :-1] / light, length_ratio)
            light_fraction = light / (2 * branching ** (level + 1)) ** 2
            colors = torch.cat((means, light_fraction), 1).movedim(1, 4).to(torch.float16)
            height, width = colors.shape[2:4]
            axis_levels[level][:, :, a : a + height, b : b + width] = colors
            if level == 0:
                done += field.shape[column_axis] * height * width * branching**2
                progress("filtered", min(done, total), total)
        for level in axis_levels:
            _fill_hidden(level, table.table_lm4.device)


def _sums_along(
    field: FinestVoxels,
    column_axis: int,
    painter: _Painter,
    branching: int,
    levels: int,
    all_light: bool,
) -> Iterator[tuple[int, int, int, Tensor]]:
    """Yields blocks of coarse voxels, each voxel once, seen along an axis of the field: the level
    (0: finest coarse one), the block's first indices a, b across the axis, and weighted sums
    (2, c + 1, n, a, b), seen forwards and backwards: the c numbers of a colour and the weight.
    """
    device = painter.table.table_lm4.device
    float32: Any = {"dtype": torch.float32, "device": device}
    length = field.shape[column_axis]
    cross_axes = [axis for axis in range(3) if axis != column_axis]
    cross_sizes = [field.shape[axis] for axis in cross_axes]
    tile, max_voxels = branching, _TILE_VOXELS[device.type]
    while tile * branching <= max(cross_sizes) and length * (tile * branching) ** 2 <= max_voxels:
        tile *= branching
    # Finest voxels along a side of a voxel of each level.
    level_sides = [branching ** (level + 1) for level in range(levels)]
    coarse = {}  # for levels whose voxels are wider than a tile: sums of each tile's columns
    for level, side in enumerate(level_sides):
        if side > tile:
            counts = (-(-length // side), *(-(-n // tile) for n in cross_sizes))
            coarse[level] = torch.zeros((2, painter.width + 1, *counts), **float32)
    for a, b, tile_values in _tiles(field, column_axis, tile):
        values = tile_values.to(device).to(torch.float32)
        empty = bool(Transfer(painter.table).transparent(*values.aminmax()))
        if empty:  # the fewest intervals that make up a voxel of level 0
            shape = (2 * branching, *(2 * n - 4 for n in tile_values.shape[1:]))
            color = torch.zeros((painter.width - 1, *shape), **float32)
            columns = _Columns(color, color, torch.ones(shape, **float32))
        else:
            columns = painter.colored(values)
        columns = columns.joined(2)
        for level, side in enumerate(level_sides):
            if not empty or level == 0:
                columns = columns.joined(branching)
                weighted = columns.weighted(all_light)
            block = min(side, tile)
            block_sums = _pooled(weighted, 2 * block)
            if level in coarse:
                coarse[level][..., a // tile, b // tile] = block_sums[..., 0, 0]
            else:
                yield level, a // block, b // block, block_sums
    for level, sums in coarse.items():
        yield level, 0, 0, _pooled(sums, level_sides[level] // tile)


def _fill_hidden(colors: Tensor, device: torch.device) -> None:
    """Blends the colours of neighbours into voxels that hardly any light reaches. In `colors`,
    (2, n, a, b, c + 1), the last number is the light.

    A hidden voxel is only seen by rays that pass between it and a visible one, and interpolate the
    two. Such a ray along the rim of a solid would blend in half of the inside in each interval, so
    that solids would grow from afar.
    """
    max_voxels, (height, width) = _TILE_VOXELS[device.type], colors.shape[2:4]
    rows = min(height, max(1, max_voxels // width))
    for slab in colors.split(max(1, max_voxels // (rows * width)), 1):
        previous_sums = torch.zeros_like(slab[:, :, :1], dtype=torch.float32, device=device)
        for first in range(0, height, rows):
            strip = slab[:, :, first : first + rows]
            with_next_row = slab[:, :, first : first + rows + 1].to(device, torch.float32)
            sums = with_next_row[..., :-1] * with_next_row[..., -1:]
            sums = torch.cat((sums, with_next_row[..., -1:]), -1)
            count = strip.shape[2]
            missing = count + 1 - with_next_row.shape[2]  # 1 where no row follows
            blurred = _smoothed(torch.cat((previous_sums, _padded(sums, 2, 0, missing)), 2), 2)
            blurred = _smoothed(_padded(blurred, 3, 1, 1), 3)
            previous_sums, sums = sums[:, :, count - 1 : count], sums[:, :, :count]
            light, light_around = sums[..., -1:], blurred[..., -1:]
            deficit = (1 - light / (_HIDDEN_BELOW * light_around)).clamp(min=0)
            total = sums + deficit * deficit * blurred
            strip[..., :-1] = (total[..., :-1] / total[..., -1:]).to(strip)


def _padded(values: Tensor, axis: int, before: int, behind: int) -> Tensor:
    """Pads an axis with zeros."""
    sides = [0, 0] * (values.dim() - axis - 1) + [before, behind]
    return torch.nn.functional.pad(values, sides)


def _smoothed(values: Tensor, axis: int) -> Tensor:
    """Returns means of three neighbours along an axis, the middle one weighted twice."""
    count = values.shape[axis] - 2
    first, middle, last = (values.narrow(axis, offset, count) for offset in range(3))
    return 0.25 * first + 0.5 * middle + 0.25 * last


def _tiles(field: FinestVoxels, column_axis: int, tile: int) -> Iterator[tuple[int, int, Tensor]]:
    """Yields the field in columns along an axis, tile by tile: a tile's first indices across the
    axis, and its values (n, a + 2, b + 2) with a neighbour on each side. Reads slabs of many tiles.
    """
    slab_side = tile * max(1, field.slab_side // tile)
    shape, cross_axes = field.shape, [axis for axis in range(3) if axis != column_axis]
    starts = [range(0, shape[axis], slab_side) for axis in cross_axes]
    for corner in itertools.product(*starts):
        low, high = [0, 0, 0], list(shape)
        for axis, first in zip(cross_axes, corner, strict=True):
            low[axis], high[axis] = first - 1, min(first + slab_side, shape[axis]) + 1
        values = field.read(low, high).movedim(column_axis, 0)
        _, *sizes = values.shape
        for a, b in itertools.product(*(range(0, size - 2, tile) for size in sizes)):
            yield corner[0] + a, corner[1] + b, values[:, a : a + tile + 2, b : b + tile + 2]


def _upsampled(values: Tensor, slope_axis: int | None = None) -> Tensor:
    """Resamples (n, a + 2, b + 2) values, which have neighbours on the sides, twice as finely:
    returns (2n, 2a, 2b) values a quarter of a voxel on either side of the voxel centres. Or,
    if `slope_axis` is given, differences along it, over half a voxel on either side of these
    positions.
    """
    last = len(values) - 1
    index = torch.arange(last + 1, device=values.device)
    before, behind = (values[(index + step).clamp(0, last)] for step in (-1, 1))
    values = _refine_axis(values, before, behind, 0, slope_axis)
    values = _refine_axis(values[:, 1:-1], values[:, :-2], values[:, 2:], 1, slope_axis)
    return _refine_axis(values[:, :, 1:-1], values[:, :, :-2], values[:, :, 2:], 2, slope_axis)


def _refine_axis(
    center: Tensor, before: Tensor, behind: Tensor, axis: int, slope_axis: int | None
) -> Tensor:
    shape = list(center.shape)
    shape.insert(axis + 1, 2)
    halves = center.new_empty(shape)
    first, second = halves.unbind(axis + 1)
    if axis == slope_axis:
        rise, fall = behind - center, center - before
        torch.add(0.25 * rise, 0.75 * fall, out=first)
        torch.add(0.75 * rise, 0.25 * fall, out=second)
    else:
        middle = 0.75 * center
        torch.add(middle, 0.25 * before, out=first)
        torch.add(middle, 0.25 * behind, out=second)
    return halves.flatten(axis, axis + 1)


@dataclass(frozen=True)
class _Columns:
    """Columns of n intervals each, along the first axis of (n, a, b)."""

    front: Tensor  # (c, n, a, b) premultiplied colour, and moments, seen from the front
    back: Tensor  # (c, n, a, b) the same seen from behind
    clear: Tensor  # (n, a, b) transmittance

    def joined(self, count: int) -> _Columns:
        """Composites every `count` intervals into one; the last is repeated if some are missing."""
        length = len(self.clear)
        if length % count:
            index = torch.arange(-(-length // count) * count, device=self.clear.device)
            index = index.clamp(max=length - 1)
            repeated = (self.front[:, index], self.back[:, index], self.clear[index])
            return _Columns(*repeated).joined(count)
        front, back = (c.unflatten(1, (-1, count)).unbind(2) for c in (self.front, self.back))
        clear = self.clear.unflatten(0, (-1, count)).unbind(1)
        front_color, back_color, transmittance = front[0], back[0], clear[0]
        for k in range(1, count):
            front_color = torch.addcmul(front_color, transmittance, front[k])
            back_color = torch.addcmul(back[k], clear[k], back_color)
            transmittance = transmittance * clear[k]
        return _Columns(front_color, back_color, transmittance)

    def weighted(self, all_light: bool) -> Tensor:
        """Returns (2, c + 2, n, a, b) colour, alpha, moments and 1, seen from both sides, times the
        light that reaches each interval; see `write_colors`.
        """
        full_light = torch.ones_like(self.clear[:1])
        front_light = torch.cat((full_light, self.clear[:-1]))
        back_light = torch.cat((self.clear[1:], full_light))
        if all_light:
            front_light, back_light = front_light.cumprod(0), back_light.flip(0).cumprod(0).flip(0)
        front_light, back_light = front_light + _MIN_LIGHT, back_light + _MIN_LIGHT
        alpha = 1 - self.clear
        weighted = self.front.new_empty((2, len(self.front) + 2, *alpha.shape))
        sides = ((self.front, front_light, 1), (self.back, back_light, -1))
        for out, (color, light, step) in zip(weighted, sides, strict=True):
            torch.mul(color[:3], light, out=out[:3])
            torch.mul(alpha, light, out=out[3])
            if len(color) > 3:
                _weigh_moments(color, alpha, light, step, out[4:-1])
            out[-1] = light
        return weighted


def _weigh_moments(color: Tensor, alpha: Tensor, light: Tensor, step: int, out: Tensor) -> None:
    """Writes the moments of intervals (c - 3, n, a, b), weighted by light. Rays also blend in the
    inside of solids, which no light reaches: there an interval takes the moments of the last one
    before it that light reaches, divided by `FAINT`, so that other directions count more.
    """
    index = torch.arange(len(alpha), device=alpha.device)[:, None, None]
    lit = light > 2 * _MIN_LIGHT
    if step > 0:
        source_index = torch.where(lit, index, 0).cummax(0).values
    else:
        source_index = torch.where(lit, index, len(alpha) - 1).flip(0).cummin(0).values.flip(0)
    source_alpha = alpha.gather(0, source_index)
    ratio = alpha / torch.where(source_alpha > 0, source_alpha, 1.0)
    weight = light * torch.where(source_alpha > 0, ratio, 0.0)
    weight = torch.where(lit, weight, weight / FAINT)
    torch.gather(color[3:], 1, source_index.expand_as(out), out=out)
    out *= weight


@dataclass(frozen=True)
class _Painter:
    """Turns values into coloured intervals."""

    table: ColorTable
    # Of a voxel along each axis of the values; None: no normals.
    voxel_sizes: Sequence[float] | None
    column_axis: int  # the axis (z, y, x) of the field that is the first axis of the values

    @property
    def width(self) -> int:
        """How many numbers an interval has: COLOR_WIDTH or LIT_COLOR_WIDTH."""
        return COLOR_WIDTH if self.voxel_sizes is None else LIT_COLOR_WIDTH

    def colored(self, padded_values: Tensor) -> _Columns:
        """Returns intervals of half a voxel from (n, a + 2, b + 2) values, with neighbours."""
        values = _upsampled(padded_values)
        low, high = self.table.domain_2
        rows = self.table.table_lm4[0]
        row_position = (values - low) * ((len(rows) - 1) / (high - low))
        row, fraction = row_and_fraction(row_position.flatten(), len(rows))
        next_row = row + 1

        def between_rows(column: Tensor) -> Tensor:
            # `index_select` takes a third of the time of `column[row]`
            ends = column.index_select(0, row), column.index_select(0, next_row)
            return torch.lerp(*ends, fraction).view_as(values)

        *columns, opacity = rows.T.contiguous()
        alpha = between_rows(opacity)
        colors = values.new_empty((self.width - 1, *values.shape))
        for out, column in zip(colors, columns, strict=False):
            torch.mul(between_rows(column), alpha, out=out)
        if self.voxel_sizes is not None:
            self.write_moments(padded_values, self.voxel_sizes, colors[3:])
            colors[3:] *= alpha
        return _Columns(colors, colors, 1 - alpha)

    def write_moments(self, padded: Tensor, voxel_sizes: Sequence[float], out: Tensor) -> None:
        """Writes the products xx xy xz yy yz zz of unit normals; 0 where there is no gradient."""
        slopes = [_upsampled(padded, axis) / voxel_sizes[axis] for axis in range(3)]
        largest = torch.maximum(torch.maximum(slopes[0].abs(), slopes[1].abs()), slopes[2].abs())
        divisor = torch.where(largest > 0, largest, 1.0)
        scaled = [slope / divisor for slope in slopes]
        square = scaled[0] * scaled[0] + scaled[1] * scaled[1] + scaled[2] * scaled[2]
        inverse_square = 1 / torch.where(square > 0, square, 1.0)
        cross_axes = [axis for axis in range(3) if axis != self.column_axis]
        z, y, x = (scaled[[self.column_axis, *cross_axes].index(axis)] for axis in range(3))
        pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
        for moment, (a, b) in zip(out, pairs, strict=True):
            torch.mul(a, b, out=moment)
        out *= inverse_square


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
    return colors.unflatten(-1, (len(DIRECTIONS), -1))[..., :-1].flatten(-2)


def mean_of_directions(colors: Tensor) -> Tensor:
    """Returns the mean (..., n) of (..., 6 * n), of the same dtype. Moments are divided by FAINT,
    which the shader multiplies their trace by: light reaches all of such matter, so the product is
    the share of it that has a normal.
    """
    first, *others = colors.split(colors.shape[-1] // len(DIRECTIONS), -1)
    total = first.float()
    for direction in others:
        total += direction
    mean = total / len(DIRECTIONS)
    mean[..., COLOR_WIDTH:] /= FAINT
    return mean.to(colors.dtype)


def _scaled_to_length(colors: Tensor, length_ratio: float) -> Tensor:
    """Rescales numbers (2, c, ...) of homogeneous matter to another length."""
    if length_ratio == 1:
        return colors
    alpha = colors[:, 3:4]
    new_alpha = 1 - (1 - alpha).clamp(min=1e-30) ** length_ratio
    scale = new_alpha / torch.where(alpha > 0, alpha, 1.0)
    return torch.cat((colors[:, :3] * scale, new_alpha, colors[:, 4:] * scale), 1)
