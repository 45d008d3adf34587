"""`N3Tree`: one tree over a node pool and a brick pool, with its place in the world."""

from __future__ import annotations

import copy
import math
import threading
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..base import check
from ..base.constants import CONSTANT, MAX_BRANCHING, TERMINAL
from ..base.image_info import ImageInfo
from ..base.labels import background
from ..base.lasting import lasting
from ..base.stage import Progress, check_progress, no_progress
from ..base.volume import Volume, movable
from ..ops import locate
from .pools import (
    BrickPool,
    Channel,
    NodePool,
    checked_threshold,
    labels_by_channel,
    volumes_by_channel,
)
from .pyramid import TreePlan, choose_build_device, levels_by_depth, tree_depth
from .refresh import BrickLevels, Span
from .turns import Turns

_frame_lock = threading.Lock()


class N3Tree:
    """A tree of nodes, each of which covers a cube of space and has N^3 children or none.

    The root cube holds brick_size * N ** depth voxels of the finest level along each axis, and the
    scene fills it from its low corner. Tree units are [0, 1] over the root cube; spacing may differ
    by axis, so the cube is a box in the world.

    Several threads may render a tree at a time. While they do, or read it, `refresh` in another
    thread raises RuntimeError, and so do they while `refresh` runs. Direct writes into its tensors
    are not guarded: they must not happen meanwhile.

    Attributes:
        nodes: The node pool.
        bricks: The brick pool.
        branching: N.
        root: Node index of the root.
        depth: Depth of the finest level; the root's is 0.
        extent: Voxels of the finest level along x, y, z.
        box: (2, 3) float64 world corners of the scene, x y z.
        spacing: (x, y, z) world size of a finest voxel.
        origin: (x, y, z) world position of the centre of voxel 0.
        value_range: For each channel, the smallest and largest value of the finest level.
        frame: Number of the last frame traced; usage stamps hold it.
        labels: For channels that hold labels, (k,) int64 the label of each stored value, or None:
            the values are the labels.
        made_of: For coarse channels, what they were made from, as plain values.
        filters: For channels whose coarse levels are not means, their `Volume.filter`.
        infos: For channels made from a volume, its `Volume.info`.
        threshold: See `from_volume`.
        turns: Keeps track of the threads that use it.
    """

    def __init__(
        self,
        nodes: NodePool,
        bricks: BrickPool,
        *,
        depth: int,
        extent: tuple[int, int, int],
        spacing: tuple[float, float, float],
        origin: tuple[float, float, float],
        root: int = 0,
        branching: int | None = None,
        value_range: Mapping[str, tuple[float, float]] | None = None,
        labels: Mapping[str, Tensor | None] | None = None,
    ) -> None:
        """Makes a tree over two pools, which trees may share; it writes nothing into them.

        `origin` is the world position of the centre of voxel 0; `branching` is at most the node
        pool's, which is the default. The others are the attributes.
        """
        self.nodes, self.bricks = nodes, bricks
        self.branching = nodes.branching if branching is None else branching
        check.integer("N3Tree", "branching", self.branching, low=2, high=nodes.branching)
        self.root, self.depth, self.extent, self.spacing = root, depth, extent, spacing
        self.origin = origin
        low = [o - 0.5 * s for o, s in zip(origin, spacing, strict=True)]
        high = [a + n * s for a, n, s in zip(low, extent, spacing, strict=True)]
        self.box = torch.tensor([low, high], dtype=torch.float64, device="cpu")
        self.value_range, self.labels = dict(value_range or {}), dict(labels or {})
        self.frame = 0
        self.made_of: dict[str, Any] = {}
        self.filters: dict[str, Any] = {}
        self.infos: dict[str, ImageInfo] = {}
        self.threshold: float | None = None
        self._place: Tensor | None = None
        self.turns = Turns()

    @property
    def device(self) -> torch.device:
        """Device of the pools."""
        return self.nodes.child_tn.device

    @property
    def number(self) -> int:
        """Index of the root's tile; `tree_t` holds it for all tiles of this tree."""
        return self.root // self.nodes.nodes_per_tile

    @property
    def side(self) -> int:
        """Voxels of the finest level along a side of the root cube."""
        return self.bricks.brick_size * self.branching**self.depth

    @property
    def root_voxel(self) -> float:
        """World size of a depth-0 voxel along its smallest side."""
        return min(self.spacing) * self.branching**self.depth

    @property
    def isotropy(self) -> float:
        """Smallest over largest side of a voxel; 1 for cubes. Kernels compare cones with a voxel's
        smallest side; cones narrowed by this factor are as wide as its largest, so no detail is
        lost.
        """
        return min(self.spacing) / max(self.spacing)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels; shaders read the first unless told otherwise."""
        return tuple(self.bricks.channels)

    @property
    def nbytes(self) -> int:
        """Bytes of both pools."""
        return self.nodes.nbytes + self.bricks.nbytes

    @property
    @lasting
    def place(self) -> Tensor:
        """(3, 3) float64 by which kernels transform rays into tree units: the scene's low corner in
        the world, the world size of the root cube, the scene's high corner in tree units.
        """
        if self._place is None or self._place.device != self.device:
            size = torch.tensor(self.spacing, dtype=torch.float64, device="cpu") * self.side
            high = torch.tensor(self.extent, dtype=torch.float64, device="cpu") / self.side
            self._place = torch.stack((self.box[0], size, high)).to(self.device)
        return self._place

    def next_frame(self) -> None:
        """Gives the next picture its number."""
        with _frame_lock:
            self.frame += 1

    def loc(self, node: Tensor) -> Tensor:
        """Returns (k, 4) int64 locs x, y, z, depth of nodes (k,) of this tree."""
        return locate(self.nodes.loc_t4, node, self.branching, self.nodes.nodes_per_tile)

    def find(self, loc: Tensor) -> Tensor:
        """Returns (k,) int64 nodes with locs (k, 4) x, y, z, depth; -1 where there is none yet."""
        node, exact = self.nearest(loc)
        return torch.where(exact, node, -1)

    def nearest(self, loc: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (k,) int64 nodes with locs (k, 4) x, y, z, depth, or their nearest ancestors that
        exist, and (k,) bool, whether it is the node itself. A loc that no node of the tree can have
        gives the root and False.
        """
        check.tensor("N3Tree", "loc", loc, ("k", 4), torch.int64, self.device)
        n, node, depth = self.branching, torch.full_like(loc[:, 0], self.root), loc[:, 3]
        side = n ** depth.clamp(0, self.depth)
        exact = ((loc[:, :3] >= 0) & (loc[:, :3] < side[:, None])).all(1)
        exact &= (depth >= 0) & (depth <= self.depth)
        child = self.nodes.child_tn.view(-1)
        for level in range(1, int((depth * exact).max()) + 1 if len(loc) else 0):
            tile = child[node].to(torch.int64)
            up = (depth - level).clamp(0, self.depth)
            x, y, z = (loc[:, axis] // n**up % n for axis in range(3))
            child_node = tile * self.nodes.nodes_per_tile + (z * n + y) * n + x
            deeper = level <= depth
            exact = exact & (~deeper | (tile >= 0))
            node = torch.where(deeper & exact, child_node, node)
        return node, exact

    def __repr__(self) -> str:
        extent = "x".join(str(n) for n in self.extent)
        return (
            f"N3Tree({extent} (x, y, z), N={self.branching}, depth={self.depth}, "
            f"{self.nodes.capacity} tiles, {self.bricks.capacity} bricks of "
            f"{self.bricks.brick_size}^3+{self.bricks.border}, "
            f"{self.nbytes / 1e6:.1f} MB on {self.device})"
        )

    def validate(self) -> None:
        """Raises ValueError unless every pointer leads to a tile or brick that exists, only shared
        ones have several pointers, and the loc of each tile matches its parent's.
        """
        self._check_words()
        child, brick = self.nodes.child_tn, self.nodes.brick_tn
        tiles, bricks = (child, self.nodes.shared_t), (brick, self.bricks.shared_b)
        for name, (pointers, shared) in (("tile", tiles), ("brick", bricks)):
            used = pointers[pointers >= 0].to(torch.int64)
            used = used[~shared[used]]
            if used.unique().numel() != used.numel():
                raise ValueError(f"N3Tree: a {name} has two owners")
        parent, loc_t4 = self.nodes.parent_t.to(torch.int64), self.nodes.loc_t4.to(torch.int64)
        tile = ((parent >= 0) & (self.nodes.tree_t == self.number)).nonzero()[:, 0]
        expected_loc = self.loc(parent[tile])
        expected_loc[:, 3] += 1
        if not torch.equal(loc_t4[tile], expected_loc):
            raise ValueError("N3Tree: a tile's loc does not match its parent")

    def _check_words(self) -> None:
        nodes, last_slot = self.nodes, self.bricks.capacity - 1
        check.integers_in("N3Tree", "child_tn", nodes.child_tn, TERMINAL, nodes.capacity - 1)
        check.integers_in("N3Tree", "brick_tn", nodes.brick_tn, CONSTANT, last_slot)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a pickled tree. Raises ValueError if its pointers lead out of the pools."""
        vars(self).update(state)
        self._check_words()

    @classmethod
    @lasting
    def from_volume(
        cls,
        volume: Volume | Mapping[str, Volume],
        brick_size: int = 8,
        border: int = 1,
        *,
        branching: int = 2,
        threshold: float | None = None,
        device: torch.device | str = "cpu",
        progress: Progress = no_progress,
    ) -> N3Tree:
        """Builds the tree of a dense volume, all of it resident: levels made by the volume's
        filter, cut into bricks.

        A node is CONSTANT where all finest voxels in reach of its brick are equal, EMPTY where
        they are all at most `threshold`; neither has a brick or children.

        Args:
            volume: A volume, which becomes channel "value", or one volume for each channel, all of
                one extent, spacing and origin.
            brick_size: Voxels along a side of a brick without border, >= 2.
            border: Voxels around a brick; with 1 or more no seam shows.
            branching: N >= 2.
            threshold: Regions with no value above it are EMPTY: they are never drawn, whatever the
                transfer function. None keeps every value. Not allowed if all channels are labels.
            device: Device of the pools. On a CUDA device with enough memory the levels are made
                there, too, with the same bits, except for labels and directional volumes.
            progress: Called with what is made, how many levels of it are done, and of how many.

        Raises:
            ValueError: An argument is out of its range, or channels differ in extent, spacing or
                origin.

        Source: Crassin et al., "GigaVoxels", I3D 2009, section 3; docs/design.md, section 2.
        """
        check_progress("from_volume", progress)
        originals = volumes_by_channel("from_volume", volume)
        device = check.device("from_volume", device)
        build_device = choose_build_device(originals.values(), device)
        volumes = {name: volume.to(build_device) for name, volume in originals.items()}
        first = next(iter(volumes.values()))
        branching = check.integer("from_volume", "branching", branching, low=2, high=MAX_BRANCHING)
        threshold = checked_threshold("from_volume", threshold, volumes)
        channels = {name: Channel.of(volume) for name, volume in volumes.items()}
        checked = BrickPool(0, channels, brick_size=brick_size, border=border)  # before the work
        brick_size, border = checked.brick_size, checked.border
        depth = tree_depth(first.extent, brick_size, branching)
        levels = levels_by_depth(volumes, depth, branching, brick_size, border, progress)
        plan = TreePlan(levels, branching, threshold)
        tree = cls(
            NodePool(plan.tiles, channels, branching=branching, device=device),
            BrickPool(plan.bricks, channels, brick_size=brick_size, border=border, device=device),
            depth=depth,
            extent=first.extent,
            spacing=first.spacing,
            origin=first.origin,
            value_range={name: volume.value_range for name, volume in volumes.items()},
            labels=labels_by_channel(volumes),
        )
        tree.filters = {n: v.filter for n, v in volumes.items() if v.filter != "mean"}
        tree.infos = {name: volume.info for name, volume in volumes.items()}
        tree.threshold = threshold
        plan.write_nodes(tree.nodes, tree.bricks)
        for name in channels:
            for level_depth in range(depth + 1):
                plan.write_bricks(tree.bricks, name, level_depth)
                progress("bricks", level_depth + 1, depth + 1)
        tree.bricks.in_order()
        return tree

    @lasting
    def to(self, device: torch.device | str) -> N3Tree:
        """Returns the tree with its pools on a device; tensors already there are shared."""
        device, other = check.device("N3Tree.to", device), copy.copy(self)
        other.nodes, other.bricks = self.nodes.to(device), self.bricks.to(device)
        if device != self.device:  # its content may be edited separately
            other.value_range, other.made_of = dict(self.value_range), dict(self.made_of)
            other.turns = Turns()
        return other

    def to_volume(self, channel: str | None = None) -> Volume:
        """Returns the finest voxels of a channel, by default the first, as they are in the bricks
        now. For an unedited tree from `from_volume` they are the original volume.

        Each region that a threshold made EMPTY is filled with its mean.

        Raises:
            ValueError: There is no such channel, it is a coarse one, or not all of the tree is in
                memory, as in an engine.
        """
        name = self.fine_channel("N3Tree.to_volume", channel)
        z, y, x = reversed(self.extent)
        with self.turns.using("N3Tree.to_volume"):
            data = self.levels().read(name, 0, Span((0, 0, 0), (z, y, x)))
        table = self.labels.get(name)
        if table is not None:
            data = table[data.to(torch.int64)]
        volume = Volume(data, self.spacing, self.origin, info=self.infos.get(name))
        volume.filter = self.filters.get(name, "mean")
        return volume

    @lasting
    @torch.no_grad()
    def refresh(self, box: Sequence[Sequence[float]] | Tensor | None = None) -> None:
        """Recomputes borders, coarse levels, regions and ranges after the finest bricks were edited
        or trained. If every region had a brick when the tree was built, bricks, ranges and pictures
        then equal, in every bit, those of a tree that `from_volume` makes of `to_volume()`.

        It reads the voxels of the finest bricks without their borders; all else is overwritten,
        also what borders and coarse bricks have learned: train with `lod="finest"`. A region
        without a brick, because it was CONSTANT or EMPTY when the tree was built, stays as it is,
        up to its faces, whatever is edited beside it. One with a brick becomes CONSTANT or EMPTY
        where its voxels are, and uses its brick again when they change; bricks that require
        gradients stay bricks. Coarse channels, such as `Filtered` colours, are not updated and have
        to be made again. It runs on the host.

        Args:
            box: (2, 3) world corners, low and high: only voxels that it touches were edited. None:
                any were.

        Raises:
            ValueError: The box is malformed, or not all of the tree is in memory, as in an engine.
            RuntimeError: Another thread renders the tree.
        """
        low, high = (0, 0, 0), self.extent
        if box is not None:
            corners = check.reals("N3Tree.refresh", "box", box, (2, 3))
            if not bool((corners[0] <= corners[1]).all()):
                raise ValueError(f"N3Tree.refresh: box must be low and high corner, got {box!r}")
            corner_voxels = ((corners - self.box[0]) / corners.new_tensor(self.spacing)).tolist()
            sizes = zip(*corner_voxels, self.extent, strict=True)
            spans = [(max(0, math.floor(a)), min(n, math.floor(b) + 1)) for a, b, n in sizes]
            low, high = (tuple(end) for end in zip(*spans, strict=True))
            if any(a >= b for a, b in spans):
                return  # outside the tree
        fine = [name for name, channel in self.bricks.channels.items() if not channel.coarse]
        filters = {name: self.filters.get(name, "mean") for name in fine}
        tables = self.labels.items()
        empty = {n: background(None if table is None else table.numpy()) for n, table in tables}
        settings = filters, empty, self.spacing, self.threshold
        with self.turns.changing("N3Tree.refresh"):
            self.levels().refresh(Span(low[::-1], high[::-1]), *settings)
            tile, child = divmod(self.root, self.nodes.nodes_per_tile)
            for name in fine:
                ranges = self.nodes.ranges[name]
                low_high = movable(ranges)[tile, child].view(ranges.dtype).float()  # (2, c)
                self.value_range[name] = (float(low_high[0].min()), float(low_high[1].max()))
            for name in self.made_of:
                self.made_of[name] = {}
            self.bricks.in_order()

    def fine_channel(self, context: str, channel: str | None) -> str:
        """Returns the name of a channel of the finest bricks, the first if none is named; raises
        ValueError if there is no such channel.
        """
        name = check.text(context, "channel", channel) or self.channel_names[0]
        check.channel(context, name, self.channel_names)
        if self.bricks.channels[name].coarse:
            raise ValueError(f"{context}: only coarse bricks have channel {name!r}")
        return name

    def levels(self) -> BrickLevels:
        """Returns the levels of a fully resident tree, to read and write its voxels."""
        return BrickLevels(
            nodes=self.nodes,
            bricks=self.bricks,
            root=self.root,
            depth=self.depth,
            branching=self.branching,
            extent=self.extent[::-1],
        )

    def warn_if_edited(self, *, learned: bool = False) -> None:
        """Warns, once for each edit, if bricks were edited and not refreshed since. `learned`: not
        about bricks that require gradients, which the caller reads as they are trained.
        """
        edited = self.bricks.new_edits(learned)
        if edited:
            warnings.warn(
                f"render: bricks of {', '.join(edited)} were edited, and ranges and coarse levels "
                "were made before: call tree.refresh()",
                stacklevel=4,
            )
