"""`FromChildren`: coarse levels for producers that can make their finest level only."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.downsample import from_grid
from ..base.rows import distinct_rows
from ..base.volume import movable, to_numpy
from ..pool import Channel
from ..pool.pyramid import coarser
from ..pool.staging import on_device
from .answer import checked_bricks, checked_regions, raise_first
from .nodes import Layout, Nodes, along_axes, grid_of
from .producer import (
    Bricks,
    OfProducers,
    Producer,
    Region,
    Regions,
    by_depth,
    changed_nodes,
    wait_for,
)

_BATCH_BLOCKS = 64  # blocks of a level that are made together, from N^3 times as many below

Blocks = dict[str, np.ndarray]  # for each channel (k, z, y, x, c) without borders


class FromChildren(OfProducers):
    """A producer's finest level, and coarse levels that are the means of those below.

    A coarse voxel is the mean of the N^3 voxels below it as they are stored, so that pictures equal
    those of a resident tree (`N3Tree.from_volume`) in every bit. This has a price: making the root
    needs all finest bricks, and all coarser levels are kept in host memory, without borders, at
    most 1 / (N^3 - 1) of the finest level. So it suits trees of a few levels. Where the producer's
    `classify` returns EMPTY or CONSTANT, nothing below is made. For formulas, `FieldProducer` with
    more samples is better.

    Attributes:
        producer: Makes the finest level. Its `classify` must serve nodes of all levels.
        levels: The most levels that a tree may have above the finest.
    """

    def __init__(self, producer: Producer, levels: int = 5) -> None:
        """Sets the producer, and the most levels that may be made of its finest one.

        Raises:
            ValueError: It makes labels, whose means are meaningless, or coarse channels, or it
                needs its parents' bricks. Answers with aliases raise when they come.
        """
        context = type(self).__name__
        check.instance(context, "producer", producer, Producer)
        if producer.labels or producer.needs_parent:
            reason = "makes labels" if producer.labels else "needs its parents' bricks"
            raise ValueError(f"{context}: {type(producer).__name__} {reason}")
        if any(channel.coarse for channel in producer.channels.values()):
            raise ValueError(f"{context}: {type(producer).__name__} makes coarse channels itself")
        ranges = producer.value_range
        super().__init__(**grid_of(producer), channels=producer.channels, value_range=ranges)
        self.producer = producer
        self.levels = check.integer(context, "levels", levels, low=1, high=10)
        self._cache: dict[tuple[int, ...], Blocks] = {}  # blocks above the finest level, by loc
        self._cached_version = producer.version  # the version that these blocks were made from

    def parts(self) -> dict[str, Producer]:
        return {"producer": self.producer}

    def prepare(self, layout: Layout) -> None:
        """Prepares the producer; raises ValueError if the tree is too deep."""
        if layout.depth > self.levels:
            count = layout.branching ** (3 * layout.depth)
            raise ValueError(
                f"{type(self).__name__}: the root of a tree {layout.depth} levels deep is made of "
                f"{count} finest bricks; the most is levels={self.levels}"
            )
        self._cache.clear()
        super().prepare(layout)

    def close(self) -> None:
        """Drops the cached blocks, and closes the producer."""
        self._cache.clear()
        super().close()

    def classify(self, nodes: Nodes) -> Regions | Tensor | Future:
        """Returns the producer's answer."""
        return self.producer.classify(nodes)

    def fill(self, nodes: Nodes) -> Bricks | Mapping[str, Tensor] | Tensor | Future:
        """Returns the producer's bricks at the finest level; above it, means of the level below."""
        finest = nodes.depth == nodes.layout.depth
        if bool(finest.all()):
            return self.producer.fill(nodes)
        if self._cached_version != self.producer.version:
            self._drop_stale(nodes.layout)
        if bool(finest.any()):
            return self._fill_mixed(nodes, finest)
        return Bricks(data=self._coarse_bricks(nodes))

    def _drop_stale(self, layout: Layout) -> None:
        """Drops the blocks that have changed since they were made."""
        version = self.producer.version  # another thread may change it further meanwhile
        changes, locs = self.producer.changes(self._cached_version), [*self._cache]
        self._cached_version = version
        if changes is None or not locs:
            self._cache.clear()
            return
        stale = changed_nodes(changes, Nodes(torch.tensor(locs, device=layout.device), layout))
        for row in stale.nonzero()[:, 0].tolist():
            del self._cache[locs[row]]

    def _fill_mixed(self, nodes: Nodes, finest: Tensor) -> Bricks:
        """Returns the bricks of nodes of which some are at the finest level and some above it."""
        fine, coarse = ((mask.nonzero()[:, 0]) for mask in (finest, ~finest))
        finest_bricks = self._producer_bricks(nodes[fine])
        kind = torch.full((len(nodes),), int(Region.DATA), device="cpu")
        if finest_bricks.kind is not None:
            kind[fine.cpu()] = finest_bricks.kind.cpu()
        data, constants = {}, {}
        for name, rows in self._coarse_bricks(nodes[coarse]).items():
            data[name] = rows.new_empty((len(nodes), *rows.shape[1:]))
            movable(data[name])[coarse.cpu()] = movable(rows)
            fine_rows = on_device(finest_bricks.data[name], rows.device)
            movable(data[name])[fine.cpu()] = movable(fine_rows)
            if name in finest_bricks.constants:
                values = finest_bricks.constants[name].cpu()
                constants[name] = values.new_zeros((len(nodes), *values.shape[1:]))
                movable(constants[name])[fine.cpu()] = movable(values)
        errors = {int(fine[index]): message for index, message in finest_bricks.errors.items()}
        return Bricks(data=data, kind=kind, constants=constants, errors=errors)

    def _producer_bricks(self, nodes: Nodes) -> Bricks:
        """Returns the producer's answer, checked."""
        bricks = checked_bricks(wait_for(self.producer.fill(nodes)), nodes, self.producer)
        if bricks.kind is not None:
            self._refuse_alias(bricks.kind)
        return bricks

    def _refuse_alias(self, kind: Tensor) -> None:
        if bool((kind == Region.ALIAS).any()):
            name = type(self.producer).__name__
            raise ValueError(f"{type(self).__name__}: {name} must answer without alias")

    def _coarse_bricks(self, nodes: Nodes) -> dict[str, Tensor]:
        """Returns the bricks (k, z, y, x, c) of coarse nodes, borders included."""
        layout, loc = nodes.layout, nodes.loc.cpu()
        arrays = _zeros(self.channels, len(loc), layout.side)
        for depth, level_rows in by_depth(loc):
            for rows in level_rows.split(_BATCH_BLOCKS):
                low = loc[rows, :3] * layout.brick_size - layout.border
                for name, values in self._level_voxels(layout, depth, low, layout.side).items():
                    arrays[name][rows.numpy()] = values
        return {n: from_grid(arrays[n], c.dtype) for n, c in self.channels.items()}

    def _level_voxels(self, layout: Layout, depth: int, low: Tensor, size: int) -> Blocks:
        """Returns size^3 voxels of a level from each `low` (k, 3) x y z; outermost ones repeat."""
        step, brick = layout.branching ** (layout.depth - depth), layout.brick_size
        last = torch.tensor([-(-n // step) - 1 for n in layout.extent], device="cpu")[:, None]
        voxel = (low[:, :, None] + torch.arange(size, device="cpu")).clamp(min=0).minimum(last)
        grid = torch.stack(torch.broadcast_tensors(*along_axes(voxel // brick)), -1)
        block, block_row = distinct_rows(grid.reshape(-1, 3))
        blocks = self._blocks(layout, torch.cat((block, torch.full_like(block[:, :1], depth)), 1))
        x, y, z = along_axes(voxel % brick)
        index = tuple(n.numpy() for n in (block_row.view(grid.shape[:4]), z, y, x))
        return {name: values[index] for name, values in blocks.items()}

    def _blocks(self, layout: Layout, loc: Tensor) -> Blocks:
        """Returns the voxels of nodes (k, 4) of one level; caches them if it is a coarse one."""
        if int(loc[0, 3]) == layout.depth:
            return self._make_blocks(layout, loc)
        keys = [tuple(node_loc) for node_loc in loc.tolist()]
        missing = [row for row, key in enumerate(keys) if key not in self._cache]
        new_blocks: dict[tuple[int, ...], Blocks] = {}
        for begin in range(0, len(missing), _BATCH_BLOCKS):
            rows = missing[begin : begin + _BATCH_BLOCKS]
            blocks = self._make_blocks(layout, loc[rows])
            for index, row in enumerate(rows):
                new_blocks[keys[row]] = {name: values[index] for name, values in blocks.items()}
        self._cache |= new_blocks
        return {name: np.stack([self._cache[key][name] for key in keys]) for name in self.channels}

    def _make_blocks(self, layout: Layout, loc: Tensor) -> Blocks:
        """Makes the voxels of nodes of one level; where they are uniform, without making bricks."""
        nodes = Nodes(loc.to(layout.device), layout)
        regions = checked_regions(wait_for(self.producer.classify(nodes)), nodes, self.producer)
        raise_first(regions.errors)
        kind = regions.kind.cpu()
        self._refuse_alias(kind)
        blocks = _zeros(self.channels, len(loc), layout.brick_size)
        for name, values in regions.constants.items():
            blocks[name][:] = to_numpy(values.cpu())[:, None, None, None]
        detailed = ((kind != Region.EMPTY) & (kind != Region.CONSTANT)).nonzero()[:, 0]
        if len(detailed):
            if int(loc[0, 3]) == layout.depth:
                voxels = self._finest_voxels(nodes[detailed])
            else:
                voxels = self._means(layout, loc[detailed])
            for name, rows in voxels.items():
                blocks[name][detailed.numpy()] = rows
        return blocks

    def _means(self, layout: Layout, loc: Tensor) -> Blocks:
        """Returns the means of the voxels of the level below."""
        n, size, depth = layout.branching, layout.brick_size, int(loc[0, 3])
        means = {}
        low = loc[:, :3] * (size * n)
        for name, values in self._level_voxels(layout, depth + 1, low, size * n).items():
            # Blocks are stacked along z, and their sides are multiples of N: no mean spans two.
            stacked = values.reshape(-1, *values.shape[2:])
            pooling = "mean", n, self.channels[name].dtype, layout.spacing, layout.depth - depth
            means[name] = coarser(stacked, *pooling).reshape(len(loc), size, size, size, -1)
        return means

    def _finest_voxels(self, nodes: Nodes) -> Blocks:
        """Returns the producer's voxels of finest nodes, without borders."""
        bricks, border = self._producer_bricks(nodes), nodes.layout.border
        raise_first(bricks.errors)
        inner, cpu = slice(border, border + nodes.layout.brick_size), torch.device("cpu")
        return {
            name: to_numpy(on_device(bricks.voxels(name), cpu))[:, inner, inner, inner]
            for name in bricks.data
        }


def _zeros(channels: Mapping[str, Channel], count: int, side: int) -> Blocks:
    zeros = {}
    for name, channel in channels.items():
        shape = (count, *(side,) * 3, channel.width)
        zeros[name] = to_numpy(torch.zeros(shape, dtype=channel.dtype, device="cpu"))
    return zeros
