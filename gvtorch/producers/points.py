"""`PointProducer`: points with values, such as stars or particles, as voxels that hold their sum.

A point lies wholly in the voxel of each level that it is in, so a level's voxels are the means of
those below, and the sum over a level is that of the points, whatever the level. Source: the nearest
grid point of Hockney, Eastwood, "Computer simulation using particles", 1988, section 5-2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..base import check
from ..pool import Channel
from .producer import Layout, Nodes, Producer, Region, Regions

_BATCH = 256  # bricks looked up at a time
_MOST_CODES = 2**62  # of an int64, which names a voxel of a level


class Level(NamedTuple):
    """The voxels of a level that hold points, and their nodes."""

    voxel: Tensor  # (m,) int64 codes of voxels, rising: that of the node, and the place in it
    value: Tensor  # (m, c) float64 what they hold
    node: Tensor  # (j,) int64 codes of their nodes, rising
    low: Tensor  # (j, c) float64 smallest value of any voxel of the node, here and below; at most 0
    high: Tensor  # (j, c) float64 largest; at least 0


class PointProducer(Producer):
    """Makes bricks of points. Its channel is "value": for each number of a point's the sum over the
    points in a voxel, per finest voxel, so that a voxel of a coarse level holds the mean.
    """

    on_host = True

    def __init__(
        self,
        positions: Tensor,
        values: Tensor | None = None,
        extent: int | Sequence[int] = 1024,
        *,
        box: Sequence[Sequence[float]] | None = None,
        branching: int = 2,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Takes the points.

        Args:
            positions: (n, 3) x, y, z in the world.
            values: (n,) or (n, c) numbers that add up, such as mass, luminosity, or premultiplied
                colour and opacity; 1 each if left out.
            extent: Voxels of the finest level, (x, y, z), or along the longest side of the box.
            box: World corners ((x, y, z), (x, y, z)); points outside are left out. Around all
                points if left out.
            branching: N.
            dtype: Of the voxels: float16, bfloat16 or float32.

        Raises:
            ValueError: A tensor is of the wrong shape, empty or not finite, no point lies in the
                box, or a number is out of its range.
        """
        where = type(self).__name__
        place = check.reals(where, "positions", positions)
        if place.dim() != 2 or place.shape[1] != 3 or not len(place):
            raise ValueError(f"{where}: positions must be (n, 3), n >= 1, got {tuple(place.shape)}")
        value = check.reals(where, "values", torch.ones(len(place)) if values is None else values)
        value = value[:, None] if value.dim() == 1 else value
        if value.dim() != 2 or len(value) != len(place) or not value.shape[1]:
            raise ValueError(
                f"{where}: values must be ({len(place)},) or ({len(place)}, c), "
                f"got {tuple(value.shape)}"
            )
        if not dtype.is_floating_point:
            raise ValueError(f"{where}: dtype must be one of floats, got {dtype}")
        if box is None:
            low, high = place.amin(0), place.amax(0)
            half = 0.5 * (high - low).clamp(min=1e-6 * float((high - low).max()) or 1.0) * 1.001
            box = [(0.5 * (low + high) - half).tolist(), (0.5 * (low + high) + half).tolist()]
        sides = [float(b) - float(a) for a, b in zip(*box, strict=True)]
        if isinstance(extent, int):
            check.whole(where, "extent", extent, low=1, high=2**40)
            check.triple(where, "sides of the box", sides, positive=True)
            extent = [max(1, round(extent * side / max(sides))) for side in sides]
        width = value.shape[1]
        channels = {"value": Channel(dtype, width)}
        super().__init__(extent, channels=channels, box=box, branching=branching)
        corner = torch.tensor(box[0], dtype=torch.float64)
        finest = ((place - corner) / torch.tensor(self.spacing, dtype=torch.float64)).floor()
        inside = ((finest >= 0) & (finest < torch.tensor(self.extent))).all(1)
        if not bool(inside.any()):
            raise ValueError(f"{where}: no point lies in the box")
        self._finest, self._value = finest[inside].to(torch.int64), value[inside]
        self._levels: list[Level] = []  # the root's first

    def prepare(self, layout: Layout) -> None:
        """Sorts the points into the voxels of each level, from the finest to the root."""
        codes = (layout.branching**layout.depth * layout.brick_size) ** 3
        if codes > _MOST_CODES:
            raise ValueError(
                f"{type(self).__name__}: a tree of depth {layout.depth} has more voxels than a "
                "64-bit number tells apart; take a smaller extent"
            )
        place, value, n = self._finest, self._value, layout.branching
        finer: Level | None = None
        self._levels = []
        for depth in range(layout.depth, -1, -1):
            level, place = _level(place, value, depth, layout)
            if finer is not None:
                above = _node_codes(_places(finer.node, depth + 1, n) // n, depth, n)
                index = torch.searchsorted(level.node, above)[:, None].expand_as(finer.low)
                level.low.scatter_reduce_(0, index, finer.low, "amin")
                level.high.scatter_reduce_(0, index, finer.high, "amax")
            self._levels.insert(0, level)
            finer, place, value = level, place // n, level.value / n**3

    def classify(self, nodes: Nodes) -> Regions:
        """EMPTY where no point is in the node or a neighbour, and the ranges of values."""
        layout = nodes.layout
        loc, width = nodes.loc.cpu(), self.channels["value"].width
        low = torch.zeros((len(loc), width), dtype=torch.float64)
        high, found = torch.zeros_like(low), torch.zeros(len(loc), dtype=torch.bool)
        for depth in loc[:, 3].unique().tolist():
            here, level = (loc[:, 3] == depth).nonzero()[:, 0], self._levels[depth]
            for at in _neighbours(loc[here, :3], depth, layout):
                row, there = _find(level.node, _node_codes(at, depth, layout.branching))
                there &= (at >= 0).all(1) & (at < layout.branching**depth).all(1)
                some = here[there]
                found[some] = True
                low[some] = torch.minimum(low[some], level.low[row[there]])
                high[some] = torch.maximum(high[some], level.high[row[there]])
        kind = torch.where(found, int(Region.DATA), int(Region.EMPTY))
        # What is rounded to the channel's dtype may pass the ends by a part of 2^-7 (bfloat16).
        ranges = torch.stack((low, high), 1) * (1 + 2.0**-7)
        least, most = self.channels["value"].limits
        stored = ranges.clamp(least, most).to(self.channels["value"].dtype)
        return Regions(kind=kind, ranges={"value": stored})

    def fill(self, nodes: Nodes) -> dict[str, Tensor]:
        """Looks up the voxels of each brick, border included; beyond the tree there is nothing."""
        layout, channel, loc = nodes.layout, self.channels["value"], nodes.loc.cpu()
        out = torch.empty((len(loc), *(layout.side,) * 3, channel.width), dtype=channel.dtype)
        reach, (least, most) = layout.reach.cpu(), channel.limits
        offset = torch.cartesian_prod(reach, reach, reach).flip(1)  # x fastest
        for depth in loc[:, 3].unique().tolist():
            level, size = self._levels[depth], layout.brick_size * layout.branching**depth
            for rows in (loc[:, 3] == depth).nonzero()[:, 0].split(_BATCH):
                voxel = (loc[rows, None, :3] * layout.brick_size + offset).view(-1, 3)
                inside = ((voxel >= 0) & (voxel < size)).all(1)
                code = _voxel_codes(voxel.clamp(0, size - 1), depth, layout)
                at, there = _find(level.voxel, code)
                value = torch.where((there & inside)[:, None], level.value[at], 0.0)
                made = value.clamp(least, most).to(channel.dtype)
                out[rows] = made.view(len(rows), *out.shape[1:])
        return {"value": out}


def _level(place: Tensor, value: Tensor, depth: int, layout: Layout) -> tuple[Level, Tensor]:
    """The voxels that hold points or voxels of the level below, at places (k, 3) with values (k, c)
    that add up; and the places of these voxels.
    """
    code, row = _voxel_codes(place, depth, layout).unique(return_inverse=True)
    total = torch.zeros((len(code), value.shape[1]), dtype=torch.float64).index_add_(0, row, value)
    first = torch.empty(len(code), dtype=torch.int64).scatter_(0, row, torch.arange(len(row)))
    node, which = (code // layout.brick_size**3).unique(return_inverse=True)
    index = which[:, None].expand_as(total)
    ends = torch.zeros((len(node), value.shape[1]), dtype=torch.float64)
    low = ends.scatter_reduce(0, index, total, "amin")
    high = ends.scatter_reduce(0, index, total, "amax")
    return Level(code, total, node, low, high), place[first]


def _voxel_codes(place: Tensor, depth: int, layout: Layout) -> Tensor:
    """(k,) int64 codes of voxels (k, 3) of a level: that of the node, then the place in it."""
    size = layout.brick_size
    x, y, z = (place % size).unbind(1)
    node = _node_codes(place // size, depth, layout.branching)
    return node * size**3 + (z * size + y) * size + x


def _node_codes(loc: Tensor, depth: int, branching: int) -> Tensor:
    """(k,) int64 numbers of nodes x, y, z (k, 3) of a level."""
    along = branching**depth
    return (loc[:, 2] * along + loc[:, 1]) * along + loc[:, 0]


def _places(node: Tensor, depth: int, branching: int) -> Tensor:
    """(k, 3) x, y, z of node codes."""
    along = branching**depth
    return torch.stack((node % along, node // along % along, node // along**2), 1)


def _find(codes: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Where (k,) codes lie among rising ones, and which are there."""
    at = torch.searchsorted(codes, wanted).clamp(max=len(codes) - 1)
    return at, codes[at] == wanted


def _neighbours(loc: Tensor, depth: int, layout: Layout) -> list[Tensor]:
    """(k, 3) each: nodes and those that their borders reach into."""
    around = -(-layout.border // layout.brick_size)
    offsets = torch.cartesian_prod(*(torch.arange(-around, around + 1),) * 3).view(-1, 3)
    return [loc + offset for offset in offsets]
