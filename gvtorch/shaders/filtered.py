"""`Filtered`: the transfer function, lit or not, that is also right from afar.

The function of a mean is not the mean of the function, and a mean loses the order of depth. So each
voxel of a coarse level stores colours instead of a value: the finest voxels below it are coloured
by the function and composited in columns along the axes, and the columns' colours and alphas are
averaged, weighted by the light that reaches them. Cracks stay open, and walls closed; hidden voxels
take on the colours of neighbours, so that solids hardly grow. Lit matter also stores the mean
second moments of its normals. They have no sign, which suits lighting on both sides of a surface,
and they describe how rough it is. Light and material can still be changed.

Source: Crassin et al., "Interactive indirect illumination using voxel cone tracing", CGF 2011
(voxels by direction); Younesy, Möller, Carr, "Improving the quality of multi-resolution volume
rendering", EuroVis 2006 (motivation); Olano, Baker, "LEAN mapping", I3D 2010, and Heitz, Dupuy,
Crassin, Dachsbacher, "The SGGX microflake distribution", SIGGRAPH 2015 (moments of normals). The
weights, the colours of hidden voxels and the sums over moments are ours; see docs/from_afar.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, class_name, whole_between
from ..base.stage import Progress, no_progress
from ..base.volume import DIRECTIONS, Volume
from ..io.stores.coarse import make_channel
from ..io.stores.store import Store
from ..io.stores.store_layout import CoarseChannel
from ..ops import ShadeArguments, cut_bricks
from ..ops.reference.stored_color import FilteredNumbers
from ..ops.shading import COLOR_WIDTH, LIT_COLOR_WIDTH, ShadeParameters, channel_widths
from ..pool import Channel, N3Tree
from .built_in import Lit
from .coarse_colors import (
    FinestVoxels,
    mean_of_directions,
    without_light,
    write_colors,
)
from .shader import Sampling, Shader, check_width
from .transfer_function import TransferFunction

#: Results of `finer`, fitted. With a larger factor the finest voxels, which are not filtered, are
#: drawn in larger pixels, too; so it is smaller where they hold sharper detail: normals, walls.
_FINER, _FINER_LIT, _FINER_BY_DIRECTION = 2.0, 1.75, 1.6
_OPAQUE_ALPHA = 0.2  # colours are stored by direction if a finest voxel can have a higher alpha
_TIMEOUT = 3600.0  # seconds for one read of local data
_SLAB_SIDE = 64  # voxels of a store's slabs: the side of its chunks
_BATCH_BRICKS = 4096  # bricks cut at a time


def _check_filterable(owner: Any, name: str, value: Any) -> TransferFunction | Lit:
    """Checks that a value is a shader that can be filtered."""
    context = class_name(owner)
    check.instance(context, name, value, TransferFunction, Lit)
    if isinstance(value, Lit) and (value.normals or value.shadows or value.octaves):
        raise ValueError(
            f"{context}: a Lit must take its normals from the gradient, without shadows per sample "
            "and octaves of scattering"
        )
    return value


class Filtered(Shader):
    """Shades the finest bricks with the transfer function, and coarse bricks with a channel of
    colours that were computed from the finest voxels below them. Near by it draws what the transfer
    function does; from afar, about what many rays per pixel would. `Filtered.of` makes both shader
    and channel.

    Given a `Lit`, coarse bricks also store the normals' moments, and highlights widen with
    distance. Light and material may be edited at any time.

    Levels are chosen twice as fine as for other shaders, which rely on wide cones to filter; 1.75
    times as fine for lit matter, 1.6 times where colours differ by direction.
    """

    reads_coarse = True
    transfer: TransferFunction | Lit
    checks: ClassVar[Mapping[str, Check]] = {
        "transfer": _check_filterable,
        "component": whole_between(0),
    }

    def __init__(
        self,
        transfer: TransferFunction | Lit,
        channel: str = "filtered",
        component: int = 0,
        *,
        directions: bool | None = None,
    ) -> None:
        """Sets the transfer function, and the channel of its colours.

        Args:
            transfer: The transfer function, or a `Lit` with one. If it is edited, or the colours
                were made with another one, tracing raises ValueError until they are recomputed.
            channel: Name of the channel that holds the colours.
            component: Index of the number of a voxel that the function reads.
            directions: True: colours for each of six directions; False: their mean, which takes a
                sixth of the memory. None: True if a voxel may hide over a fifth of what is behind.
        """
        self.transfer, self.other = transfer, channel
        self.component, self._directions = component, directions

    @classmethod
    def of(
        cls,
        tree: N3Tree,
        volume: Volume,
        transfer: TransferFunction | Lit,
        *,
        channel: str = "filtered",
        component: int = 0,
        directions: bool | None = None,
        progress: Progress = no_progress,
    ) -> Self:
        """Computes the colours on the device of a resident tree, and adds them to it as a channel:
        (b, z, y, x, n or 6 * n) float16 for its first b bricks, those above the finest level. n is
        4: premultiplied linear colour, and the alpha of a voxel; for lit matter 10: also the
        moments of its normals. Values that the tree's threshold made EMPTY are not left out.
        Needs 16 to 27 bytes a finest voxel on the device, including the channel; lit, twice that.

        Args:
            tree: The tree that `N3Tree.from_volume` made of the volume.
            volume: The volume.
            transfer: The transfer function, or a `Lit`.
            channel: Name of the channel; an existing one of this name is replaced.
            component, directions: See `Filtered`.
            progress: Called with ("filtered", voxels done, voxels in all).

        Raises:
            ValueError: Tree and volume do not belong together, or an argument is out of its range.
        """
        check.instance("Filtered", "tree", tree, N3Tree)
        check.instance("Filtered", "volume", volume, Volume)
        check.integer("Filtered", "component", component, low=0, high=volume.width - 1)
        shader = cls(transfer, channel, component, directions=directions)
        if (volume.extent, volume.spacing) != (tree.extent, tree.spacing):
            raise ValueError(f"Filtered: tree and volume must have one placement: {tree}, {volume}")
        if channel == tree.channel_names[0]:
            raise ValueError(f"Filtered: channel {channel!r} is that of the values")
        owner_b = tree.bricks.owner_b
        locs = tree.loc(owner_b.clamp(min=0).to(torch.int64)).cpu()
        is_coarse = (owner_b.cpu() >= 0) & (locs[:, 3] < tree.depth)
        count = int(is_coarse.sum())
        if not bool(is_coarse[:count].all()):
            raise ValueError("Filtered: the tree's coarse bricks must come first in its pool")
        bricks, color_channel = tree.bricks, shader.colors(tree.spacing)
        side = bricks.brick_size + 2 * bricks.border
        shape = (count, side, side, side, color_channel.width)
        colors = torch.zeros(shape, dtype=color_channel.dtype, device="cpu")
        level_arguments = (tree.branching, tree.depth, tree.device, color_channel.width)
        for level, values in enumerate(shader.levels(volume, *level_arguments, progress), 1):
            level_rows = (locs[:count, 3] == tree.depth - level).nonzero()[:, 0]
            for rows in level_rows.split(_BATCH_BRICKS):
                zyx = locs[rows, :3].flip(1)
                colors[rows] = cut_bricks(values, zyx, bricks.brick_size, bricks.border)
        bricks.channels[channel] = tree.nodes.channels[channel] = color_channel
        bricks.bricks[channel], bricks.coarse = colors.to(tree.device), count
        tree.made_of[channel] = shader.made_of
        return shader

    @classmethod
    def add_to(
        cls,
        store: Store | str | Path,
        transfer: TransferFunction | Lit,
        *,
        channel: str = "filtered",
        component: int = 0,
        directions: bool | None = None,
        device: torch.device | str = "cpu",
        progress: Progress = no_progress,
    ) -> Self:
        """Computes the colours of a store, out of core, and writes them into it as a coarse
        channel, which `StoredProducer(store, filtered=shader)` streams. The store's voxels are not
        changed. While it runs, temporary files take 9 bytes a finest voxel (lit, 19) in the store's
        folder; the colours themselves compress well.

        Args:
            store: A store that `convert` made, in a folder.
            transfer: The transfer function, or a `Lit`.
            channel: Name of the channel of colours; an existing one of this name is replaced.
            component, directions: See `Filtered`.
            device: Device on which colours are computed.
            progress: Called with ("filtered", voxels done, voxels in all), then with "writing".

        Raises:
            ValueError: It is not such a store, or an argument is out of its range.
            OSError: It can't be read or written.
        """
        opened = store if isinstance(store, Store) else Store.open(store)
        check.integer("Filtered", "component", component, low=0, high=opened.width - 1)
        shader = cls(transfer, channel, component, directions=directions)
        torch_device = check.device("Filtered", device)
        color_channel, made_of = shader.colors(opened.spacing), shader.made_of
        voxel_width = len(DIRECTIONS) * (shader.numbers + 1)  # see `write_colors`

        def read(low: Sequence[int], high: Sequence[int]) -> Tensor:
            values = opened.read_region(0, low, high, timeout=_TIMEOUT)[..., component]
            return torch.from_numpy(np.ascontiguousarray(values))

        def fill(levels: Sequence[np.ndarray]) -> None:
            out = [torch.from_numpy(level) for level in levels]
            field = FinestVoxels(opened.extent[::-1], _SLAB_SIDE, read)
            shader.write(field, opened.spacing, 2, out, torch_device, progress)

        def keep(colors: np.ndarray) -> np.ndarray:
            return shader.kept(torch.from_numpy(colors), color_channel.width).numpy()

        coarse_channel = CoarseChannel(width=color_channel.width, made_of=made_of)
        make_channel(opened, channel, coarse_channel, voxel_width, fill, keep, progress)
        return shader

    @classmethod
    def stored(cls, store: Store | str | Path, channel: str = "filtered") -> Self:
        """Returns the shader for the colours in a store, with the function that made them, which is
        in a `Lit` with a headlight if the colours include normals.

        Raises:
            ValueError: The store has no such colours, or they are damaged.
        """
        opened = store if isinstance(store, Store) else Store.open(store)
        if channel not in opened.coarse:
            names_stored = ", ".join(map(repr, opened.coarse)) or "none"
            raise ValueError(
                f"{opened.location}: has no filtered colours {channel!r} (it has {names_stored}); "
                "gvtorch filter (Filtered.add_to) makes them"
            )
        coarse = opened.coarse[channel]
        names = ("opacity", "color", "reference", "component")
        lit = coarse.made_of.get("normals") is True
        expected_keys = sorted((*names, "normals") if lit else names)
        numbers = LIT_COLOR_WIDTH if lit else COLOR_WIDTH
        widths = channel_widths(numbers)
        if sorted(coarse.made_of) != expected_keys or coarse.width not in widths:
            raise ValueError(f"{opened.location}: damaged: {channel!r} holds no filtered colours")
        opacity, color, reference, component = (coarse.made_of[name] for name in names)
        try:
            transfer = TransferFunction(opacity, color, reference)
            check.integer("Filtered", "component", component, low=0, high=opened.width - 1)
        except ValueError as error:
            raise ValueError(f"{opened.location}: damaged: {channel!r}: {error}") from None
        shader = Lit(transfer) if lit else transfer
        return cls(shader, channel, component, directions=coarse.width != numbers)

    @property
    def kind(self) -> str:  # type: ignore[override]
        return "FilteredLit" if isinstance(self.transfer, Lit) else "Filtered"

    @property
    def function(self) -> TransferFunction:
        """The transfer function itself."""
        return self.transfer.transfer if isinstance(self.transfer, Lit) else self.transfer

    @property
    def numbers(self) -> int:
        """How many numbers a voxel has along one direction: COLOR_WIDTH or LIT_COLOR_WIDTH."""
        return LIT_COLOR_WIDTH if isinstance(self.transfer, Lit) else COLOR_WIDTH

    @property
    def made_of(self) -> dict[str, Any]:
        """The function, component and use of normals that made the colours, as JSON values."""
        function = self.function
        description = {
            "opacity": function.opacity.tolist(),
            "color": function.color.tolist(),
            "reference": function.reference,
            "component": self.component,
        }
        return description if self.numbers == COLOR_WIDTH else {**description, "normals": True}

    def colors(self, spacing: tuple[float, float, float]) -> Channel:
        """Returns dtype and width of the channel of colours, for voxels of this size."""
        directions = self._directions
        if directions is None:
            one_voxel = Sampling(smallest_spacing=min(spacing), step=min(spacing))
            table = self.transfer.table(one_voxel)
            directions = float(table.table_lm4[0, :, 3].max()) > _OPAQUE_ALPHA
        one, by_direction = channel_widths(self.numbers)
        return Channel(torch.float16, by_direction if directions else one, coarse=True)

    def levels(
        self,
        volume: Volume,
        branching: int,
        depth: int,
        device: torch.device,
        width: int,
        progress: Progress = no_progress,
    ) -> Iterator[Tensor]:
        """Computes the colours of a volume's coarse levels on a device, see `of`, and yields them,
        finest level first, as (z, y, x, width) float16 on the CPU. The width is that of `colors`.
        """
        field = FinestVoxels.of(volume, self.component or 0)
        sides = [branching ** (level + 1) for level in range(depth)]
        shapes = [[-(-n // side) for n in field.shape] for side in sides]
        voxel_width = len(DIRECTIONS) * (self.numbers + 1)  # see `write_colors`
        out = [torch.empty((*n, voxel_width), dtype=torch.float16, device=device) for n in shapes]
        self.write(field, volume.spacing, branching, out, device, progress)
        for colors in out:
            yield self.kept(colors, width).cpu()

    def kept(self, colors: Tensor, width: int) -> Tensor:
        """Converts what `write` wrote to a channel of `width` numbers a voxel: drops the share of
        light, and averages the six directions if the channel stores one.
        """
        directional = without_light(colors)
        return directional if directional.shape[-1] == width else mean_of_directions(directional)

    def write(
        self,
        field: FinestVoxels,
        spacing: tuple[float, float, float],
        branching: int,
        out: Sequence[Tensor],
        device: torch.device,
        progress: Progress = no_progress,
    ) -> None:
        """Writes colours of coarse levels to (possibly mapped) tensors; see `write_colors`."""
        sampling = Sampling(smallest_spacing=min(spacing), step=min(spacing) / 2, device=device)
        tables = [self.transfer.table(replace(sampling, step=side / 2)) for side in spacing]
        one_mean = self.colors(spacing).width == self.numbers
        write_colors(field, tables, spacing, branching, out, progress, all_light=one_mean)

    def finer(self, tree: N3Tree) -> float:
        channel = tree.bricks.channels.get(str(self.other))
        if channel is not None and channel.width > self.numbers:
            return _FINER_BY_DIRECTION
        return _FINER if self.numbers == COLOR_WIDTH else _FINER_LIT

    def own_numbers(self, tree: N3Tree) -> FilteredNumbers:
        return FilteredNumbers(min(tree.spacing) * tree.side)

    def material(self) -> ShadeParameters:
        return self.transfer.material()

    @property
    def shows_nothing(self) -> bool:
        return self.transfer.shows_nothing

    def own_light(self) -> Any:
        return self.transfer.own_light()

    def unlit(self) -> Shader:
        if not isinstance(self.transfer, Lit):
            return super().unlit()
        return self.changed(transfer=self.transfer.unlit())

    def shading(self, context: str, tree: N3Tree) -> ShadeArguments | None:
        if tree.made_of.get(str(self.other), self.made_of) != self.made_of:
            made = f"the colours {self.other!r} were made of another function or component"
            hint = "make them again (Filtered.of, Filtered.add_to, a new producer)"
            raise ValueError(f"{context}: {made}, or it was edited: {hint}")
        widths = channel_widths(self.numbers)
        check_width(f"{context}: filtered colours need", tree, self.other, *widths)
        return super().shading(context, tree)
