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

from collections.abc import Iterator, Sequence
from typing import Self

import torch
from torch import Tensor

from ..base import check
from ..base.stage import Progress, no_progress
from ..base.volume import Volume
from ..ops import ShadeArguments, cut_bricks
from ..ops.shading import FilteredNumbers
from ..pool import Channel, N3Tree
from .coarse_colors import Field, VolumeField, mean_of_directions, write_colors
from .shader import Sampling, Shader
from .transfer_function import TransferFunction

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
        return Channel(torch.float16, 24 if directions else 4, coarse=True)

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
        field = VolumeField(volume, self.component or 0)
        sides = [branching ** (level + 1) for level in range(depth)]
        shapes = [[-(-n // side) for n in field.shape] for side in sides]
        out = [torch.empty((*n, 24), dtype=torch.float16, device=device) for n in shapes]
        self.write(field, volume.spacing, branching, out, device, progress)
        for colors in out:
            yield self.kept(colors, volume.spacing).cpu()

    def write(
        self,
        field: Field,
        spacing: tuple[float, float, float],
        branching: int,
        out: Sequence[Tensor],
        device: torch.device,
        progress: Progress = no_progress,
    ) -> None:
        """Writes the colours of coarse levels, worked out on a device, into tensors, which may be
        mapped from files; see `write_colors`.
        """
        self._made_of = _content(self.transfer)
        smallest = min(spacing)
        tables = [self.transfer.table(_sampling(smallest, side / 2, device)) for side in spacing]
        write_colors(field, tables, [smallest / side for side in spacing], branching, out, progress)

    def kept(self, colors: Tensor, spacing: tuple[float, float, float]) -> Tensor:
        """Returns what the channel keeps of colours (..., 24): themselves, or their mean."""
        return colors if self.colors(spacing).width == 24 else mean_of_directions(colors)

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
