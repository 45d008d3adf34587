"""`Nodes`: a batch of nodes by location, the argument of a producer's methods. `Layout`: how a
producer's world is divided into nodes and bricks.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from ..fields.noise import inherit
from ..pool.pyramid import tree_depth

ROUNDING_VOXELS = 1 / 32  # voxels by which boxes are widened, so that they hold rounded positions


def grid_of(producer: Any) -> dict[str, Any]:
    """Returns the arguments of `Producer.__init__` that place another producer in the same grid."""
    names = ("extent", "spacing", "origin", "branching")
    return {name: getattr(producer, name) for name in names}


def _on_device(name: str) -> functools.cached_property[Tensor]:
    """Returns a property of layouts: three of their numbers as (3,) float64 on their device."""

    def vector(layout: Layout) -> Tensor:
        return torch.tensor(getattr(layout, name), dtype=torch.float64, device=layout.device)

    return functools.cached_property(vector)


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How an engine divides a producer's world into nodes and bricks."""

    depth: int  # of the finest level; the root's is 0
    branching: int  # N: a node has N^3 children
    brick_size: int  # voxels along a side of a brick, without the border
    border: int  # voxels around a brick
    extent: tuple[int, int, int]  # finest voxels along x, y, z
    spacing: tuple[float, float, float]  # world size of a finest voxel
    origin: tuple[float, float, float]  # world position of the centre of voxel 0
    device: torch.device  # of the pools
    scene: Mapping[str, Layout] = field(default_factory=dict, repr=False, compare=False)  # by tree

    @classmethod
    def of(cls, producer: Any, brick_size: int, border: int, device: torch.device) -> Layout:
        """Returns the layout of a producer's world in bricks of a size."""
        depth = tree_depth(producer.extent, brick_size, producer.branching)
        grid = grid_of(producer)
        return cls(depth=depth, brick_size=brick_size, border=border, device=device, **grid)

    def wider(self, by: int) -> Layout:
        """Returns the layout with `by` more border voxels on each side of a brick; cached."""
        if by not in self._wider_layouts:
            self._wider_layouts[by] = replace(self, border=self.border + by)
        return self._wider_layouts[by]

    @functools.cached_property
    def _wider_layouts(self) -> dict[int, Layout]:
        return {}

    @property
    def side(self) -> int:
        """s = brick_size + 2 * border, voxels along a side of a brick with its border."""
        return self.brick_size + 2 * self.border

    spacing_3, origin_3, extent_3 = map(_on_device, ("spacing", "origin", "extent"))

    @functools.cached_property
    def reach(self) -> Tensor:
        """(s,) int64 voxels along a side of a brick, -border to brick_size + border - 1."""
        return torch.arange(-self.border, self.brick_size + self.border, device=self.device)

    @functools.cached_property
    def grid(self) -> Tensor:
        """(s * s * s * 3,) int64: for x, y, z of each voxel of a brick (in order z, y, x), the
        index of that coordinate in a flattened (3, s) tensor of coordinates along each axis.
        """
        index = torch.arange(len(self.reach), device=self.device)
        z, y, x = torch.meshgrid(index, index, index, indexing="ij")
        return torch.stack((x, y + len(index), z + 2 * len(index)), -1).flatten()


class Nodes:
    """A batch of k nodes of one tree, by location: the argument of a producer's methods.

    Attributes:
        loc: (k, 4) int64 x, y, z, depth: node x of its level covers voxels x * brick_size to
            (x + 1) * brick_size of that level.
        layout: How the tree's world is divided: brick size, border, spacing and so on.
        coarse: Whether their bricks also hold coarse channels: then all nodes are above the finest
            level. If a producer has such channels and this is False, all are at the finest level.
        parents: The bricks of their parents, (k, z, y, x, c) by channel that is not coarse, with
            borders, as stored; None unless `Producer.needs_parent`. The root has no parent: None,
            or, in a recorded batch, its own brick.
    """

    def __init__(
        self,
        loc: Tensor,
        layout: Layout,
        *,
        coarse: bool = False,
        parents: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.loc, self.layout, self.coarse, self.parents = loc, layout, coarse, parents
        self._cache: dict[str, Tensor] = {}  # a cache of properties that torch.compile can trace

    def __len__(self) -> int:
        return self.loc.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Nodes:
        parents = self.parents
        if parents is not None:
            parents = {name: rows[index] for name, rows in parents.items()}
        return Nodes(self.loc[index], self.layout, coarse=self.coarse, parents=parents)

    def wider(self, by: int) -> Nodes:
        """Returns the same nodes with `by` more border voxels on each side: for producers that
        evaluate a wider grid because voxels depend on their neighbours. They have no `parents`.
        """
        return Nodes(self.loc, self.layout.wider(by), coarse=self.coarse) if by else self

    @property
    def child(self) -> Tensor:
        """(k, 3) int64 index of each node among its parent's children, x y z, 0 to N - 1."""
        return self.loc[:, :3] % self.layout.branching

    def inherited(self, points: int = 2) -> dict[str, Tensor]:
        """Returns the values of `parents` at these nodes' voxels, border included, as
        (k, z, y, x, c) float32 by channel: interpolated from `points` voxels along each axis, see
        `gv.noise.inherit`; 2 interpolates as renderers do.

        Raises:
            ValueError: There are no parents, or bricks have no border.
        """
        if self.parents is None:
            raise ValueError("Nodes.inherited: the producer must have needs_parent, and no root")
        layout, values = self.layout, {}
        options = {"border": layout.border, "branching": layout.branching, "points": points}
        for name, bricks in self.parents.items():
            width = bricks.shape[-1]
            flat = bricks.movedim(-1, 1).flatten(0, 1).to(torch.float32)
            rows = inherit(flat, self.child.repeat_interleave(width, 0), **options)
            values[name] = rows.unflatten(0, (-1, width)).movedim(1, -1)
        return values

    @property
    def depth(self) -> Tensor:
        """(k,) int64, 0 for the root."""
        return self.loc[:, 3]

    @property
    def scale(self) -> Tensor:
        """(k,) float64 side of the nodes' voxels, in finest voxels."""
        if "scale" not in self._cache:
            base = torch.full_like(self.loc[:, 3], self.layout.branching, dtype=torch.float64)
            self._cache["scale"] = base ** (self.layout.depth - self.loc[:, 3])
        return self._cache["scale"]

    @property
    def voxel_size(self) -> Tensor:
        """(k, 3) float64 world size of the nodes' voxels."""
        return self.scale[:, None] * self.layout.spacing_3.to(self.loc.device)

    @property
    def box(self) -> Tensor:
        """(k, 2, 3) float64 world corners, x y z, without the border."""
        low = self.loc[:, :3] * self.layout.brick_size
        faces = torch.stack((low, low + self.layout.brick_size), 1) * self.scale[:, None, None]
        return self._to_world(faces - 0.5)

    @property
    def center(self) -> Tensor:
        """(k, 3) float64 world centre."""
        return self.box.mean(1)

    @property
    def radius(self) -> Tensor:
        """(k,) float64 world distance from the centre to the farthest voxel centre of the brick,
        border included.
        """
        return (self.voxel_size * (0.5 * (self.layout.side - 1))).norm(dim=1)

    def half_extent(self, margin: float = ROUNDING_VOXELS) -> Tensor:
        """Returns (k, 3) float64 half the world sides of the boxes that bricks cover, borders and
        `margin` voxels around them included.
        """
        return self.voxel_size * (0.5 * self.layout.brick_size + self.layout.border + margin)

    def touch(self, boxes: Tensor) -> Tensor:
        """Returns (k,) bool: whether bricks, borders included, reach into any of (m, 2, 3) world
        boxes.
        """
        boxes, half_extent = boxes.to(self.loc.device, torch.float64), self.half_extent()
        low, high = (self.center - half_extent)[:, None], (self.center + half_extent)[:, None]
        return ((low <= boxes[:, 1]) & (high >= boxes[:, 0])).all(2).any(1)

    @property
    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """float32 world coordinates of the voxel centres along x (k, 1, 1, s), y (k, 1, s, 1) and
        z (k, s, 1, 1), border included. A function of them broadcasts to (k, z, y, x) and reads a
        hundredth of the memory that `positions` take. Beyond 2^18 voxels from the world's origin
        float32 is exact to 1/64 of a voxel at best: see `local_axes`.
        """
        return along_axes(self._coordinates)

    @property
    def local_axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """The same relative to the brick's `center`: exact at any depth. `center` is float64, so
        `nodes.center[:, 0, None, None, None] + x` is a world coordinate in float64.
        """
        return along_axes(self._local_coordinates)

    @property
    def positions(self) -> Tensor:
        """(k, z, y, x, 3) float32 world positions of the voxel centres, border included."""
        return self._grid("positions", self._coordinates)

    @property
    def local_positions(self) -> Tensor:
        """(k, z, y, x, 3) float32, the same relative to the brick's `center`: see `local_axes`."""
        return self._grid("local_positions", self._local_coordinates)

    def points(self, dtype: torch.dtype) -> Tensor:
        """Returns `positions`, in float32 or, exact at any depth, in float64."""
        if dtype == torch.float64:
            return self.center[:, None, None, None] + self.local_positions
        return self.positions

    def _grid(self, name: str, coordinates: Tensor) -> Tensor:
        """Expands (k, 3, s) coordinates along each axis to (k, z, y, x, 3); cached by name."""
        if name not in self._cache:
            side, grid = self.layout.side, self.layout.grid.to(coordinates.device)
            flat = coordinates.flatten(1).index_select(1, grid)
            self._cache[name] = flat.view(-1, side, side, side, 3)
        return self._cache[name]

    @property
    def _local_coordinates(self) -> Tensor:
        """(k, 3, s) float32 coordinates of the voxel centres along each axis, from `center`."""
        middle = 0.5 * (self.layout.brick_size - 1)
        offsets = self.layout.reach.to(self.loc.device) - middle
        return (self.voxel_size[:, :, None] * offsets).to(torch.float32)

    @property
    def _coordinates(self) -> Tensor:
        """(k, 3, s) float32 world coordinates of the voxel centres along each axis."""
        if "places" not in self._cache:
            offsets = self.layout.reach.to(self.loc.device)
            voxel = self.loc[:, :3, None] * self.layout.brick_size + offsets
            finest = (voxel + 0.5) * self.scale[:, None, None] - 0.5
            self._cache["places"] = self._to_world(finest.mT).mT.to(torch.float32).contiguous()
        return self._cache["places"]

    def _to_world(self, finest: Tensor) -> Tensor:
        """Converts positions (..., 3) from finest voxels to world units."""
        layout = self.layout
        return finest * layout.spacing_3.to(finest.device) + layout.origin_3.to(finest.device)

    def __repr__(self) -> str:
        layout = self.layout
        return (
            f"Nodes({len(self)} on {self.loc.device}, "
            f"bricks of {layout.brick_size}^3+{layout.border}, tree depth {layout.depth})"
        )


def along_axes(coordinates: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Reshapes (k, 3, s) coordinates along each axis so that they broadcast to (k, z, y, x)."""
    x, y, z = coordinates.unbind(1)
    return x[:, None, None, :], y[:, None, :, None], z[:, :, None, None]
