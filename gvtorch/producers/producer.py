"""`Producer`: what makes the content of a tree. It answers two questions, both on a batch: what is
in these nodes (`classify`), and what are the voxels of these bricks (`fill`).

It never sees pools, slots or the order of use: nodes are named by place. Source: Crassin et al.,
"GigaVoxels", I3D 2009, section 5; Crassin, PhD thesis 2011, chapter 7 (a producer may decline).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import IntEnum

import torch
from torch import Tensor

from ..base import check
from ..pool import Channel
from ..pool.staging import Voxels


class Region(IntEnum):
    """What a node holds."""

    EMPTY = 0  # nothing is ever drawn here, nor below
    CONSTANT = 1  # one value all over, also below
    DATA = 2  # voxels; its children may hold more detail
    DATA_MAX_DEPTH = 3  # voxels; its children would hold nothing new
    ALIAS = 4  # the same as another node, with all that is below it


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How the engine cuts a producer's world into bricks."""

    depth: int  # of the finest level
    branching: int
    brick_size: int
    border: int
    extent: tuple[int, int, int]  # finest voxels along x, y, z
    spacing: tuple[float, float, float]  # world size of a finest voxel
    origin: tuple[float, float, float]  # world place of the centre of voxel 0
    device: torch.device

    @functools.cached_property
    def spacing_3(self) -> Tensor:
        """(3,) float64 `spacing` on the device."""
        return torch.tensor(self.spacing, dtype=torch.float64, device=self.device)

    @functools.cached_property
    def origin_3(self) -> Tensor:
        """(3,) float64 `origin` on the device."""
        return torch.tensor(self.origin, dtype=torch.float64, device=self.device)

    @functools.cached_property
    def extent_3(self) -> Tensor:
        """(3,) float64 `extent` on the device."""
        return torch.tensor(self.extent, dtype=torch.float64, device=self.device)

    @functools.cached_property
    def reach(self) -> Tensor:
        """(s,) int64 voxels along a side of a brick, -border to brick_size + border - 1."""
        return torch.arange(-self.border, self.brick_size + self.border, device=self.device)

    @functools.cached_property
    def grid(self) -> Tensor:
        """(s * s * s * 3,) int64: where each component of each voxel's place stands among the
        3 * s places along the axes.
        """
        at = torch.arange(len(self.reach), device=self.device)
        z, y, x = torch.meshgrid(at, at, at, indexing="ij")
        return torch.stack((x, y + len(at), z + 2 * len(at)), -1).flatten()


class Nodes:
    """A batch of nodes of one tree, by place.

    Attributes:
        loc: (k, 4) int64 x, y, z, depth: node x of its level covers voxels x * brick_size to
            (x + 1) * brick_size of that level.
        layout: Brick size, border, spacing and the like.
    """

    def __init__(self, loc: Tensor, layout: Layout) -> None:
        """Holds the places."""
        self.loc, self.layout = loc, layout
        self._known: dict[str, Tensor] = {}  # made when first asked for; torch.compile follows it

    def __len__(self) -> int:
        """Number of nodes."""
        return self.loc.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Nodes:
        """Some of the nodes."""
        return Nodes(self.loc[index], self.layout)

    @property
    def depth(self) -> Tensor:
        """(k,) int64, 0 for the root."""
        return self.loc[:, 3]

    @property
    def scale(self) -> Tensor:
        """(k,) float64, finest voxels along a side of one of the node's voxels."""
        if "scale" not in self._known:
            base = torch.full_like(self.loc[:, 3], self.layout.branching, dtype=torch.float64)
            self._known["scale"] = base ** (self.layout.depth - self.loc[:, 3])
        return self._known["scale"]

    @property
    def voxel_size(self) -> Tensor:
        """(k, 3) float64 world size of one of the node's voxels."""
        return self.scale[:, None] * self.layout.spacing_3.to(self.loc.device)

    @property
    def box(self) -> Tensor:
        """(k, 2, 3) float64 world corners, x y z, without the border."""
        low = self.loc[:, :3] * self.layout.brick_size
        faces = torch.stack((low, low + self.layout.brick_size), 1) * self.scale[:, None, None]
        return self._world(faces - 0.5)

    @property
    def center(self) -> Tensor:
        """(k, 3) float64 world centre."""
        return self.box.mean(1)

    @property
    def radius(self) -> Tensor:
        """(k,) float64 world distance from the centre to the farthest voxel centre of the brick,
        border included.
        """
        side = self.layout.brick_size + 2 * self.layout.border - 1
        return (self.voxel_size * (0.5 * side)).norm(dim=1)

    @property
    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """float32 world places of the voxel centres along x (k, 1, 1, s), y (k, 1, s, 1) and
        z (k, s, 1, 1), border included. What is made of them broadcasts to (k, z, y, x), and they
        take a hundredth of the memory traffic of `positions`: a compiled function of them writes
        each brick once and reads next to nothing.
        """
        x, y, z = self._places.unbind(1)
        return x[:, None, None, :], y[:, None, :, None], z[:, :, None, None]

    @property
    def positions(self) -> Tensor:
        """(k, z, y, x, 3) float32 world places of the voxel centres, x y z, border included."""
        if "positions" not in self._known:
            side = len(self.layout.reach)
            places = self._places.flatten(1).index_select(1, self.layout.grid.to(self.loc.device))
            self._known["positions"] = places.view(-1, side, side, side, 3)
        return self._known["positions"]

    @property
    def _places(self) -> Tensor:
        """(k, 3, s) float32 world places of the voxel centres along each axis."""
        if "places" not in self._known:
            reach = self.layout.reach.to(self.loc.device)
            voxel = self.loc[:, :3, None] * self.layout.brick_size + reach
            finest = (voxel + 0.5) * self.scale[:, None, None] - 0.5
            places = self._world(finest.mT).mT.to(torch.float32).contiguous()
            self._known["places"] = places
        return self._known["places"]

    def _world(self, finest: Tensor) -> Tensor:
        spacing, origin = (
            v.to(finest.device) for v in (self.layout.spacing_3, self.layout.origin_3)
        )
        return finest * spacing + origin


@dataclass(frozen=True, kw_only=True)
class Regions:
    """Answer of `classify`: what each of k nodes holds."""

    kind: Tensor  # (k,) of `Region`
    constants: Mapping[str, Tensor] = field(default_factory=dict)  # (k, c): of CONSTANT and EMPTY
    ranges: Mapping[str, Tensor] = field(default_factory=dict)  # (k, 2, c) smallest, largest value
    alias: Tensor | None = None  # (k, 4) loc of the node that an ALIAS is the same as
    errors: Mapping[int, str] = field(default_factory=dict)  # which can't be told, and why


@dataclass(frozen=True, kw_only=True)
class Bricks:
    """Answer of `fill`: the voxels of k bricks, or why a brick has none.

    Bricks may lie on the engine's device or in host memory, whatever the device: those are sent
    through pinned memory while the engine renders. Bricks that lie ready are best named by the rows
    of a `BrickTable`; those that lie in pinned memory themselves are copied from there a little
    later, so a producer must leave them as they are.
    """

    data: Voxels  # (k, z, y, x, c) for each channel, border included
    kind: Tensor | None = None  # (k,) of `Region`; all DATA if left out
    constants: Mapping[str, Tensor] = field(default_factory=dict)  # (k, c)
    alias: Tensor | None = None  # (k, 4) loc
    errors: Mapping[int, str] = field(default_factory=dict)


class Producer(torch.nn.Module):
    """Base of producers: subclass it and write `fill`, and `classify` where that saves work.

    Attributes:
        extent: (x, y, z) voxels of the finest level.
        spacing: (x, y, z) world size of a finest voxel.
        origin: (x, y, z) world place of the centre of voxel 0.
        branching: N of its tree.
        channels: What a voxel holds, by name.
        value_range: For each channel its smallest and largest value, where they are known.
        patience: Seconds until an answer that does not come is given up; None: the engine's.
        layout: How the engine that it serves cuts its world; None while it serves none.
    """

    patience: float | None = None
    layout: Layout | None = None

    def __init__(
        self,
        extent: int | Sequence[int],
        *,
        channels: Mapping[str, Channel] | None = None,
        box: Sequence[Sequence[float]] | None = None,
        spacing: float | Sequence[float] = 1.0,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        branching: int = 2,
        value_range: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        """Tells where the content lies.

        Args:
            extent: Voxels of the finest level, one number or (x, y, z).
            channels: What a voxel holds, by name; one float32 "value" if left out.
            box: World corners ((x, y, z), (x, y, z)) that the extent fills; takes the place of
                spacing and origin.
            spacing: World size of a finest voxel, one number or (x, y, z).
            origin: World place of the centre of voxel 0.
            branching: N >= 2.
            value_range: For each channel its smallest and largest value, where they are known.

        Raises:
            ValueError: A number is out of its range.
        """
        super().__init__()
        where = type(self).__name__
        sizes = (extent,) * 3 if isinstance(extent, int) else tuple(extent)
        if len(sizes) != 3:
            raise ValueError(f"{where}: extent must be a number or (x, y, z), got {extent!r}")
        x, y, z = (check.whole(where, "extent", size, low=1, high=2**40) for size in sizes)
        self.extent = (x, y, z)
        if box is not None:
            if len(box) != 2:
                raise ValueError(f"{where}: box must be two corners, got {box!r}")
            low, high = (check.triple(where, "box", corner) for corner in box)
            spacing = [(b - a) / n for a, b, n in zip(low, high, self.extent, strict=True)]
            origin = [a + 0.5 * s for a, s in zip(low, spacing, strict=True)]
        if isinstance(spacing, (int, float)):
            spacing = (spacing,) * 3
        self.spacing = check.triple(where, "spacing", spacing)
        if min(self.spacing) <= 0:
            raise ValueError(f"{where}: spacing must be positive, got {self.spacing}")
        self.origin = check.triple(where, "origin", origin)
        self.branching = check.whole(where, "branching", branching, low=2, high=16)
        self.channels = dict(channels) if channels is not None else {"value": Channel()}
        for name, channel in self.channels.items():
            if not isinstance(channel, Channel):
                raise ValueError(f"{where}: channels[{name!r}] must be a Channel, got {channel!r}")
        self.value_range = dict(value_range or {})

    def prepare(self, layout: Layout) -> None:
        """Learns how the engine cuts the world; called once, before the first question."""

    def classify(self, nodes: Nodes) -> Regions | Tensor | Future:
        """Tells what nodes hold: `Regions`, or a (k,) tensor of `Region`, now or as a future.

        A wrong DATA costs memory; a wrong EMPTY or CONSTANT costs the picture: what lies in reach
        of the node's brick, border included, and of all nodes below counts. All DATA unless
        overridden.
        """
        return torch.full((len(nodes),), Region.DATA, device=nodes.loc.device)

    def fill(self, nodes: Nodes) -> Bricks | Mapping[str, Tensor] | Future:
        """Makes bricks: `Bricks`, or {channel: (k, z, y, x, c)}, now or as a future.

        Coarse levels must be pre-filtered: a voxel stands for the mean over the space it covers.
        """
        raise NotImplementedError(f"{type(self).__name__}: fill is not written")

    def close(self) -> None:
        """Lets go of files and threads."""
