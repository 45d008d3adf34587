"""`Filtered`: the transfer function, right from afar too.

The function of a mean is not the mean of the function, and a mean forgets what stands behind what.
So each voxel of a coarse level holds what the function makes of the finest voxels below it, seen
along the axes: for each column of them its colour and alpha, and of the columns the mean, weighted
with the light that came through the voxel before. Cracks stay open, and walls closed.

Source: Crassin et al., "Interactive indirect illumination using voxel cone tracing", CGF 2011
(voxels by direction); Younesy, Möller, Carr, "Improving the quality of multi-resolution volume
rendering", EuroVis 2006 (why). The weight is ours; docs/picture.md measures what it gives.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from ..base import check
from ..base.stage import Progress, no_progress
from ..base.volume import Volume
from ..ops import ShadeArguments, cut_bricks
from ..ops.shading import FilteredNumbers
from ..pool import Channel, N3Tree
from .shader import ColorTable, Sampling, Shader
from .transfer_function import TransferFunction

_DIRECTIONS = 6
_TILE_VOXELS = 1 << 17  # columns are worked out so many voxels at a time
_LEAST = 0.001  # weight of a column that no light comes to
_OPAQUE = 0.2  # alpha of a finest voxel from which on directions matter
_BATCH = 4096  # bricks cut at a time


class Filtered(Shader):
    """The transfer function, and for coarse bricks the colours that it makes of the finest voxels
    below them, a channel of their own. Near by it draws as the transfer function does; from afar
    it shows about what many rays a pixel would. `Filtered.of` makes both.

    Levels are chosen 1.6 times as fine as for other shaders, whose wide cones have to filter.
    """

    kind = "Filtered"
    finer = 1.6  # a fine voxel is at least five eighths of an interval
    transfer: TransferFunction

    def __init__(
        self,
        transfer: TransferFunction,
        channel: str = "filtered",
        component: int | None = None,
        *,
        directions: bool | None = None,
    ) -> None:
        """Tells the transfer function, and where its colours lie.

        Args:
            transfer: The transfer function. Once it is edited, tracing raises ValueError where the
                colours were made for this shader: they have to be made anew.
            channel: Name of the channel that holds the colours.
            component: Which number of a voxel the function takes.
            directions: Whether colours are made for each of six directions, or their mean, which
                takes a sixth of the memory. None: where a voxel may hide a fifth of what is behind.
        """
        self.transfer = check.instance("Filtered", "transfer", transfer, TransferFunction)
        self.other, self.component, self._directions = channel, component, directions
        self._made_of: tuple[bytes, ...] | None = None  # the function, where colours were made here

    @classmethod
    def of(
        cls,
        tree: N3Tree,
        volume: Volume,
        transfer: TransferFunction,
        *,
        channel: str = "filtered",
        component: int = 0,
        directions: bool | None = None,
        progress: Progress = no_progress,
    ) -> Self:
        """Works the colours out on the device of a resident tree, and keeps them as a channel of
        it: (b, z, y, x, 4 or 24) float16 for its first b bricks, those above the finest level.
        Premultiplied linear colour, and the alpha of a voxel. What a tree's threshold made EMPTY
        counts here as it is. Working takes some 40 bytes a finest
        voxel on the device, the channel included.

        Args:
            tree: What `N3Tree.from_volume` made of the volume.
            volume: The volume.
            transfer: The transfer function.
            channel: Name of the channel, which replaces one of this name.
            component, directions: See `Filtered`.
            progress: Called with what is made, how many axes of it are done, and of how many.

        Raises:
            ValueError: Tree and volume do not belong together, or an argument is out of its range.
        """
        check.instance("Filtered", "volume", volume, Volume)
        last = volume.data.shape[3] - 1
        check.whole("Filtered", "component", component, low=0, high=last)
        shader = cls(transfer, channel, component, directions=directions)
        if (volume.extent, volume.spacing) != (tree.extent, tree.spacing):
            raise ValueError(f"Filtered: tree and volume must be of one place: {tree}, {volume}")
        if channel == tree.channel_names[0]:
            raise ValueError(f"Filtered: channel {channel!r} is that of the values")
        owner_b = tree.bricks.owner_b
        places = tree.loc(owner_b.clamp(min=0).to(torch.int64)).cpu()
        upper = (owner_b.cpu() >= 0) & (places[:, 3] < tree.depth)
        count = int(upper.sum())
        if not bool(upper[:count].all()):
            raise ValueError("Filtered: the tree's coarse bricks must come first in its pool")
        bricks, kind = tree.bricks, shader.colors(tree.spacing)
        side = bricks.brick_size + 2 * bricks.border
        colors = torch.zeros((count, side, side, side, kind.width), dtype=kind.dtype)
        levels = shader.levels(volume, tree.branching, tree.depth, tree.device, progress)
        for level, values in enumerate(levels, 1):
            mine = (places[:count, 3] == tree.depth - level).nonzero()[:, 0]
            for some in mine.split(_BATCH):
                place = places[some, :3].flip(1)
                colors[some] = cut_bricks(values, place, bricks.brick_size, bricks.border)
        bricks.channels[channel] = tree.nodes.channels[channel] = kind
        bricks.bricks[channel], bricks.coarse = colors.to(tree.device), count
        return shader

    def colors(self, spacing: tuple[float, float, float]) -> Channel:
        """Returns the channel that holds the colours of voxels of this size."""
        directions = self._directions
        if directions is None:
            table = self.transfer.table(_sampling(min(spacing), min(spacing), torch.device("cpu")))
            directions = float(table.table_lm4[0, :, 3].max()) > _OPAQUE
        return Channel(torch.float16, 4 * (_DIRECTIONS if directions else 1), coarse=True)

    def levels(
        self,
        volume: Volume,
        branching: int,
        depth: int,
        device: torch.device,
        progress: Progress = no_progress,
    ) -> Iterator[Tensor]:
        """Yields the colours of a volume's coarse levels, (z, y, x, 4 or 24) float16 on the CPU,
        the finest of them first, worked out on a device; see `of`.
        """
        values, sides = volume.data[..., self.component or 0], []
        smallest, width = min(volume.spacing), self.colors(volume.spacing).width
        self._made_of = _content(self.transfer)
        for axis in range(3):
            spacing = volume.spacing[axis]
            table = self.transfer.table(_sampling(smallest, spacing / 2, device))
            columns = values.movedim(2 - axis, 0)
            found = _seen_along(columns, table, branching, depth, device)
            sides.append(
                [
                    _of_length(one, smallest / spacing).to(torch.float16).movedim(0, 2 - axis)
                    for one in found
                ]
            )
            progress("filtered", axis + 1, 3)
        for _ in range(depth):
            level = torch.cat([side.pop(0) for side in sides], 3)
            yield (level if width > 4 else _mean_of_directions(level)).cpu()

    def own_numbers(self, tree: N3Tree) -> FilteredNumbers:
        return FilteredNumbers(min(tree.spacing) * tree.side)

    def shading(self, where: str, tree: N3Tree) -> ShadeArguments | None:
        if self._made_of not in (None, _content(self.transfer)):
            raise ValueError(
                f"{where}: the function was edited; make its colours anew: Filtered.of"
            )
        known = tree.bricks.channels.get(str(self.other), Channel(width=4))
        if known.width not in (4, 24):
            raise ValueError(
                f"{where}: filtered colours need 4 numbers a voxel, or 24 for six directions, "
                f"{self.other!r} has {known.width}"
            )
        return super().shading(where, tree)


def _content(transfer: TransferFunction) -> tuple[bytes, ...]:
    reference = str(transfer.reference).encode()
    return (transfer.opacity.tobytes(), transfer.color.tobytes(), reference)


def _sampling(smallest: float, step: float, device: torch.device) -> Sampling:
    return Sampling(
        smallest_spacing=smallest, step=step, levels=1, dtype=torch.float32, device=device
    )


def _seen_along(
    values: Tensor, table: ColorTable, branching: int, levels: int, device: torch.device
) -> Iterator[Tensor]:
    """Yields for each coarse level (n, a, b, 8) premultiplied colour and alpha of its voxels, seen
    along the first axis of values (n, a, b), first forwards, then backwards.
    """
    length, *across = values.shape
    tile = branching
    while tile * branching <= max(across) and length * (tile * branching) ** 2 <= _TILE_VOXELS:
        tile *= branching
    blocks = [min(branching ** (level + 1), tile) for level in range(levels)]
    shapes = [
        (2, 5, -(-length // branching ** (level + 1)), *(-(-n // block) for n in across))
        for level, block in enumerate(blocks)
    ]
    sums = [torch.zeros(shape, device=device) for shape in shapes]
    for a in range(0, across[0], tile):
        for b in range(0, across[1], tile):
            part = _finer(values, (a, b), tile, device)
            columns = _colored(part, table)
            empty = bool((columns.clear == 1).all())
            columns = columns.joined(2)
            for level, block in enumerate(blocks):
                if not empty or level == 0:
                    columns = columns.joined(branching)
                    weighted = columns.weighted()
                if empty:  # the same in all intervals
                    weighted = weighted[:, :, :1]
                seen = _pooled(weighted, 2 * block)
                high, wide = seen.shape[3:]
                x, y = a // block, b // block
                sums[level][..., x : x + high, y : y + wide] = seen
    for level, block in enumerate(blocks):
        total = _pooled(sums.pop(0), branching ** (level + 1) // block)
        yield (total[:, :4] / total[:, 4:]).flatten(0, 1).movedim(0, 3)


def _finer(values: Tensor, corner: tuple[int, int], tile: int, device: torch.device) -> Tensor:
    """Returns a tile (2n, 2a, 2b) float32 of values (n, a, b), sampled twice as finely: a quarter
    of a voxel on either side of its centre.
    """
    slices = [slice(max(at - 1, 0), at + tile + 1) for at in corner]
    part = values[:, slices[0], slices[1]].to(device).to(torch.float32)
    for axis, at in ((0, 0), (1, corner[0]), (2, corner[1])):
        first = max(at - 1, 0)
        count = min(values.shape[axis] - at, tile) if axis else values.shape[0]
        index = torch.arange(at - first, at - first + count, device=device)
        last = part.shape[axis] - 1
        here, before, behind = (
            part.index_select(axis, (index + step).clamp(0, last)) for step in (0, -1, 1)
        )
        sides = (0.75 * here + 0.25 * before, 0.75 * here + 0.25 * behind)
        part = torch.stack(sides, axis + 1).flatten(axis, axis + 1)
    return part


@dataclass(frozen=True)
class _Columns:
    """Intervals of columns along the first axis of (n, a, b)."""

    front: Tensor  # (3, n, a, b) premultiplied colour as seen from the front
    back: Tensor  # (3, n, a, b) and from behind
    clear: Tensor  # (n, a, b) transmittance

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


def _mean_of_directions(colors: Tensor) -> Tensor:
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
