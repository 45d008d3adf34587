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

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, instance_of, whole
from ..base.stage import Progress, no_progress
from ..base.volume import Volume
from ..io.stores.coarse import make_channel
from ..io.stores.store import Store
from ..io.stores.store_layout import CoarseChannel
from ..ops import ShadeArguments, cut_bricks
from ..ops.shading import FilteredNumbers
from ..pool import Channel, N3Tree
from .coarse_colors import Field, VolumeField, mean_of_directions, write_colors
from .shader import Sampling, Shader
from .transfer_function import TransferFunction

_OPAQUE = 0.2  # alpha of a finest voxel from which on directions matter
_TIMEOUT = 3600.0  # seconds for one read of local data
_BATCH = 4096  # bricks cut at a time


class Filtered(Shader):
    """The transfer function, and for coarse bricks the colours that it makes of the finest voxels
    below them, a channel of their own. Near by it draws as the transfer function does; from afar
    it shows about what many rays a pixel would. `Filtered.of` makes both.

    Levels are chosen 1.6 times as fine as for other shaders, whose wide cones have to filter.
    """

    kind = "Filtered"
    reads_coarse = True
    finer = 1.6  # a fine voxel is at least five eighths of an interval
    transfer: TransferFunction
    checks: ClassVar[Mapping[str, Check]] = {
        "transfer": instance_of(TransferFunction),
        "component": whole(0),
    }

    def __init__(
        self,
        transfer: TransferFunction,
        channel: str = "filtered",
        component: int = 0,
        *,
        directions: bool | None = None,
    ) -> None:
        """Tells the transfer function, and where its colours lie.

        Args:
            transfer: The transfer function. Where colours were made of another one, or it is
                edited, tracing raises ValueError: they have to be made anew.
            channel: Name of the channel that holds the colours.
            component: Which number of a voxel the function takes.
            directions: Whether colours are made for each of six directions, or their mean, which
                takes a sixth of the memory. None: where a voxel may hide a fifth of what is behind.
        """
        self.transfer, self.other = transfer, channel
        self.component, self._directions = component, directions

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
        counts here as it is. Working takes 14 to 25 bytes a finest voxel on the device, the
        channel included.

        Args:
            tree: What `N3Tree.from_volume` made of the volume.
            volume: The volume.
            transfer: The transfer function.
            channel: Name of the channel, which replaces one of this name.
            component, directions: See `Filtered`.
            progress: Told ("filtered", voxels done, voxels in all).

        Raises:
            ValueError: Tree and volume do not belong together, or an argument is out of its range.
        """
        check.instance("Filtered", "volume", volume, Volume)
        check.whole("Filtered", "component", component, low=0, high=volume.width - 1)
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
        sizes = (tree.branching, tree.depth, tree.device, kind.width)
        levels = shader.levels(volume, *sizes, progress)
        for level, values in enumerate(levels, 1):
            mine = (places[:count, 3] == tree.depth - level).nonzero()[:, 0]
            for some in mine.split(_BATCH):
                place = places[some, :3].flip(1)
                colors[some] = cut_bricks(values, place, bricks.brick_size, bricks.border)
        bricks.channels[channel] = tree.nodes.channels[channel] = kind
        bricks.bricks[channel], bricks.coarse = colors.to(tree.device), count
        tree.made_of[channel] = shader.made_of
        return shader

    @classmethod
    def add_to(
        cls,
        store: Store | str | Path,
        transfer: TransferFunction,
        *,
        channel: str = "filtered",
        component: int = 0,
        directions: bool | None = None,
        device: torch.device | str = "cpu",
        progress: Progress = no_progress,
    ) -> Self:
        """Works the colours out for a store, out of core, and writes them into it as a coarse
        channel, which `StoredProducer(store, filtered=shader)` streams. The store's own voxels are
        read and stay as they are. While they are made, files of 7 bytes a finest voxel lie in the
        store's folder; the colours themselves compress well.

        Args:
            store: A store that `convert` made, in a folder.
            transfer: The transfer function.
            channel: Name of the colours; those of this name are replaced.
            component, directions: See `Filtered`.
            device: Where the work is done.
            progress: Told ("filtered", voxels done, voxels in all), then of "writing".

        Raises:
            ValueError: It is no such store, or an argument is out of its range.
            OSError: It can't be read or written.
        """
        opened = store if isinstance(store, Store) else Store.open(store)
        check.whole("Filtered", "component", component, low=0, high=opened.width - 1)
        shader = cls(transfer, channel, component, directions=directions)
        place = check.device("Filtered", device)
        kind, made_of = shader.colors(opened.spacing), shader.made_of

        def fill(levels: Sequence[np.ndarray]) -> None:
            out = [torch.from_numpy(level) for level in levels]
            field = _StoreField(opened, component)
            shader.write(field, opened.spacing, 2, out, place, progress)

        def keep(colors: np.ndarray) -> np.ndarray:
            return (
                colors if kind.width == 24 else mean_of_directions(torch.from_numpy(colors)).numpy()
            )

        told = CoarseChannel(width=kind.width, made_of=made_of)
        make_channel(opened, channel, told, 24, fill, keep, progress)
        return shader

    @classmethod
    def stored(cls, store: Store | str | Path, channel: str = "filtered") -> Self:
        """Returns the shader whose colours a store holds, with the function they were made with.

        Raises:
            ValueError: The store has no such colours, or they are damaged.
        """
        opened = store if isinstance(store, Store) else Store.open(store)
        if channel not in opened.coarse:
            known = ", ".join(map(repr, opened.coarse)) or "none"
            raise ValueError(
                f"{opened.location}: has no filtered colours {channel!r} (it has {known}); "
                "gvtorch filter (Filtered.add_to) makes them"
            )
        told = opened.coarse[channel]
        names = ("opacity", "color", "reference", "component")
        if sorted(told.made_of) != sorted(names) or told.width not in (4, 24):
            raise ValueError(f"{opened.location}: damaged: {channel!r} holds no filtered colours")
        opacity, color, reference, component = (told.made_of[name] for name in names)
        try:
            transfer = TransferFunction(opacity, color, reference)
            check.whole("Filtered", "component", component, low=0, high=opened.width - 1)
        except ValueError as error:
            raise ValueError(f"{opened.location}: damaged: {channel!r}: {error}") from None
        return cls(transfer, channel, component, directions=told.width == 24)

    @property
    def made_of(self) -> dict[str, Any]:
        """What the colours depend on, as JSON."""
        return {
            "opacity": self.transfer.opacity.tolist(),
            "color": self.transfer.color.tolist(),
            "reference": self.transfer.reference,
            "component": self.component,
        }

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
        width: int,
        progress: Progress = no_progress,
    ) -> Iterator[Tensor]:
        """Yields the colours of a volume's coarse levels, (z, y, x, width) float16 on the CPU, the
        finest of them first, worked out on a device; see `of`. The width is 4 or 24.
        """
        field = VolumeField(volume, self.component or 0)
        sides = [branching ** (level + 1) for level in range(depth)]
        shapes = [[-(-n // side) for n in field.shape] for side in sides]
        out = [torch.empty((*n, 24), dtype=torch.float16, device=device) for n in shapes]
        self.write(field, volume.spacing, branching, out, device, progress)
        for colors in out:
            yield (colors if width == 24 else mean_of_directions(colors)).cpu()

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
        smallest = min(spacing)
        tables = [self.transfer.table(_sampling(smallest, side / 2, device)) for side in spacing]
        write_colors(field, tables, [smallest / side for side in spacing], branching, out, progress)

    def own_numbers(self, tree: N3Tree) -> FilteredNumbers:
        return FilteredNumbers(min(tree.spacing) * tree.side)

    def shading(self, where: str, tree: N3Tree) -> ShadeArguments | None:
        if tree.made_of.get(str(self.other), self.made_of) != self.made_of:
            raise ValueError(
                f"{where}: the colours {self.other!r} were made of another function or component, "
                "or it was edited: make them anew (Filtered.of, Filtered.add_to, or a new producer)"
            )
        known = tree.bricks.channels.get(str(self.other), Channel(width=4))
        if known.width not in (4, 24):
            raise ValueError(
                f"{where}: filtered colours need 4 numbers a voxel, or 24 for six directions, "
                f"{self.other!r} has {known.width}"
            )
        return super().shading(where, tree)


class _StoreField:
    """One number of the finest voxels of a store."""

    across = 64  # as wide as its chunks

    def __init__(self, store: Store, component: int) -> None:
        self._store, self._component = store, component
        x, y, z = store.extent
        self.shape = (z, y, x)

    def read(self, low: Sequence[int], high: Sequence[int]) -> Tensor:
        """See `Field`."""
        values = self._store.read_region(0, low, high, timeout=_TIMEOUT)[..., self._component]
        return torch.from_numpy(np.ascontiguousarray(values))


def _sampling(smallest: float, step: float, device: torch.device) -> Sampling:
    return Sampling(
        smallest_spacing=smallest, step=step, levels=1, dtype=torch.float32, device=device
    )
