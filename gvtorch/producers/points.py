"""`PointProducer`: sums the values of points, such as stars or particles, in voxels.

Source: Hockney, Eastwood, "Computer simulation using particles", 1988, section 5 (shape functions;
nearest grid point for points without a radius).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..points.points import Points
from ..points.sorted import SortedPoints, sort_points
from ..points.splat import Cubes, ranges, values
from ..pool import Channel
from .producer import Nodes, Producer, Region, Regions, by_depth

_BATCH_BRICKS = 256  # bricks made at a time


class PointProducer(Producer):
    """Makes bricks of points. Its channel "value" holds, for each number of a point, the sum over
    the points in a voxel, divided by the volume of the voxel in finest voxels. So a coarse voxel
    holds the mean of the finest ones, and the integral over each level is the sum over all points.

    Attributes:
        points: The points, sorted.
        drawn: See `__init__`.
    """

    on_host = True

    def __init__(
        self,
        positions: Any,
        values: Any = None,
        extent: int | Sequence[int] = 1024,
        *,
        radius: Any = None,
        box: Sequence[Sequence[float]] | None = None,
        branching: int = 2,
        dtype: torch.dtype = torch.float32,
        drawn: bool = False,
    ) -> None:
        """Sets the points and the grid of voxels; sorts the points if they are not sorted.

        Args:
            positions: (n, 3) world x, y, z; or `Points`; or `SortedPoints`, or the folder that
                holds them, which define values, radius, extent, box and branching themselves.
            values: (n,) or (n, c) additive numbers, such as mass, luminosity, or premultiplied
                colour and opacity; 1 each if left out.
            extent: Voxels of the finest level, (x, y, z), or along the longest side of the box.
            radius: (n,) or one number: extent of a point to either side along each axis, world
                units. 0, or left out: a point is in one voxel only.
            box: World corners ((x, y, z), (x, y, z)); points outside are ignored. If left out,
                around all points and their radii.
            branching: N.
            dtype: Of the voxels: float16, bfloat16 or float32.
            drawn: True leaves points narrower than its voxels out of the finest level:
                `gv.point_layer` draws them where that level would be used.

        Raises:
            ValueError: A tensor is of the wrong shape, empty or not finite, no point lies in the
                box, or a number is out of its range.
        """
        context = type(self).__name__
        check.float_dtype(context, dtype)
        if isinstance(positions, (str, Path)):
            positions = SortedPoints.open(positions)
        if isinstance(positions, (Points, SortedPoints)) and not (values is radius is None):
            raise ValueError(f"{context}: values and radius go with positions, not with points")
        if isinstance(positions, SortedPoints):
            sorted_points = positions
            if box is not None or extent != 1024 or branching != 2:
                raise ValueError(f"{context}: sorted points have an extent, a box and N already")
        else:
            if not isinstance(positions, Points):
                positions = Points(positions, values, radius=radius)
            sorted_points = sort_points(positions, extent, box=box, branching=branching)
        grid = sorted_points.grid
        super().__init__(
            grid.extent,
            channels={"value": Channel(dtype, sorted_points.width)},
            box=(grid.low, grid.high),
            branching=grid.branching,
        )
        self.points, self.drawn = sorted_points, drawn
        self._warned = False  # whether the warning about sums that the channel can't hold was shown

    def classify(self, nodes: Nodes) -> Regions:
        """Returns EMPTY where no point reaches into the brick, else DATA; and the value ranges."""
        channel = self.channels["value"]
        kind = torch.full((len(nodes),), int(Region.EMPTY), device="cpu")
        value_range = torch.zeros((len(nodes), 2, channel.width), dtype=torch.float64, device="cpu")
        for rows, cubes in _by_level(nodes):
            bounds = ranges(self.points, cubes, narrow=self._includes_narrow(cubes))
            nonempty, low, high = (torch.from_numpy(array) for array in bounds)
            kind[rows[nonempty]] = int(Region.DATA)
            value_range[rows] = torch.stack((low, high), 1)
        # Values rounded to the channel's dtype may exceed the ends, by a relative 2^-7 at most.
        stored = (value_range * (1 + 2.0**-7)).clamp(*channel.limits).to(channel.dtype)
        return Regions(kind=kind, ranges={"value": stored})

    def fill(self, nodes: Nodes) -> dict[str, Tensor]:
        """Sums the points in each voxel, border included; voxels beyond the box are 0."""
        channel = self.channels["value"]
        shape = (len(nodes), *(nodes.layout.side,) * 3, channel.width)
        out = torch.empty(shape, dtype=channel.dtype, device="cpu")
        for rows, cubes in _by_level(nodes):
            sums = torch.from_numpy(values(self.points, cubes, narrow=self._includes_narrow(cubes)))
            self._warn_overflow(sums)
            out[rows] = sums.clamp(*channel.limits).to(channel.dtype)
        return {"value": out}

    def _warn_overflow(self, sums: Tensor) -> None:
        """Warns once if sums are larger than the channel can hold."""
        (low, high), dtype = self.channels["value"].limits, self.channels["value"].dtype
        smallest, largest = map(float, sums.aminmax()) if sums.numel() else (0.0, 0.0)
        if not self._warned and (smallest < low or largest > high):
            self._warned = True
            magnitude, dtype_name = max(-smallest, largest), str(dtype).removeprefix("torch.")
            warnings.warn(
                f"{type(self).__name__}: a voxel's sum, {magnitude:.3g}, is more than "
                f"{dtype_name} holds, {high:.5g}, which is stored: "
                "take float32, or scale the values",
                stacklevel=2,
            )

    def _includes_narrow(self, cubes: Cubes) -> bool:
        return not (self.drawn and cubes.level == 0)


def _by_level(nodes: Nodes) -> Iterator[tuple[Tensor, Cubes]]:
    """Yields indices of a batch of nodes of one level, and their cubes of voxels with borders."""
    layout, loc = nodes.layout, nodes.loc.cpu()
    for depth, level_rows in by_depth(loc):
        for rows in level_rows.split(_BATCH_BRICKS):
            low = loc[rows, :3].numpy() * layout.brick_size - layout.border
            yield rows, Cubes(np.ascontiguousarray(low), layout.side, layout.depth - depth)
