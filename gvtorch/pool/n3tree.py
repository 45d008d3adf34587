"""`N3Tree`: one tree over a node pool and a brick pool, with its place in the world."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..base import check
from ..base.constants import CONSTANT, EMPTY, TERMINAL
from ..base.stage import Progress, no_progress
from ..base.volume import Volume, movable
from ..ops import cut_bricks, locate
from .brick_pool import BrickPool
from .channel import Channel
from .node_pool import NodePool
from .pyramid import Level, round_to, volume_levels

_BATCH = 4096  # bricks cut from a level at a time


class N3Tree:
    """A tree whose root cube holds brick_size * N ** depth voxels of the finest level along each
    axis.

    Tree units are [0, 1] over the root cube. The scene fills it from its low corner; spacing may
    differ by axis, so the cube is a box in the world.

    Attributes:
        nodes: The node pool.
        bricks: The brick pool.
        branching: N.
        root: Node index of the root.
        depth: Depth of the finest level.
        box: (2, 3) float64 world corners of the scene, x y z.
        spacing: (x, y, z) world size of a finest voxel.
        value_range: For each channel, the smallest and largest value of the finest level.
        frame: Number of the last frame traced; usage stamps hold it.
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
    ) -> None:
        """Joins two pools to a tree that is empty but for its root.

        Args:
            nodes: Pool of three-dimensional tiles.
            bricks: Pool of bricks.
            depth: Depth of the finest level.
            extent: Voxels of the finest level along x, y, z.
            spacing: World size of a finest voxel.
            origin: World place of the centre of voxel 0.
            root: Node index of the root.
            branching: N; the pool's if left out.
            value_range: For each channel, its smallest and largest value.
        """
        if nodes.dimensions != 3:
            raise ValueError(f"N3Tree: nodes must have 3 dimensions, got {nodes.dimensions}")
        self.nodes, self.bricks = nodes, bricks
        self.branching = nodes.branching if branching is None else branching
        check.whole("N3Tree", "branching", self.branching, low=2, high=nodes.branching)
        self.root, self.depth, self.extent, self.spacing = root, depth, extent, spacing
        low = [o - 0.5 * s for o, s in zip(origin, spacing, strict=True)]
        high = [a + n * s for a, n, s in zip(low, extent, spacing, strict=True)]
        self.box = torch.tensor([low, high], dtype=torch.float64)
        self.value_range = dict(value_range or {})
        self.frame = 0
        self._place: Tensor | None = None

    @property
    def device(self) -> torch.device:
        """Where the pools lie."""
        return self.nodes.child_tn.device

    @property
    def number(self) -> int:
        """What `tree_t` holds for its tiles: the tile of its root."""
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
    def flatness(self) -> float:
        """Smallest over largest side of a voxel. Cones are narrowed by it: then the level is chosen
        by the largest side, so that no detail is lost, and intervals fit the smallest one.
        """
        return min(self.spacing) / max(self.spacing)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels, the default one first."""
        return tuple(self.bricks.channels)

    @property
    def nbytes(self) -> int:
        """Memory of both pools."""
        return self.nodes.nbytes + self.bricks.nbytes

    @property
    def place(self) -> Tensor:
        """(3, 3) float64: the scene's low corner in the world, the world size of the root cube, and
        the scene's high corner in tree units (its low corner is 0).
        """
        if self._place is None or self._place.device != self.device:
            size = torch.tensor(self.spacing, dtype=torch.float64) * self.side
            high = torch.tensor(self.extent, dtype=torch.float64) / self.side
            self._place = torch.stack((self.box[0], size, high)).to(self.device)
        return self._place

    def loc(self, node: Tensor) -> Tensor:
        """Returns (k, 4) int64 x, y, z, depth of nodes (k,) of this tree."""
        return locate(self.nodes.loc_t4, node, self.branching, self.nodes.nodes_per_tile)

    def find(self, loc: Tensor) -> Tensor:
        """Returns (k,) int64 node indices of places (k, 4) x, y, z, depth; -1 where there is none
        yet.
        """
        n = self.branching
        node = torch.full_like(loc[:, 0], self.root)
        child = self.nodes.child_tn.view(-1)
        for level in range(1, int(loc[:, 3].max()) + 1 if len(loc) else 0):
            tile = torch.where(node >= 0, child[node.clamp(min=0)].to(torch.int64), -1)
            up = (loc[:, 3] - level).clamp(min=0)
            x, y, z = (loc[:, axis] // n**up % n for axis in range(3))
            below = tile * self.nodes.nodes_per_tile + (z * n + y) * n + x
            deeper = level <= loc[:, 3]
            node = torch.where(deeper, torch.where(tile >= 0, below, -1), node)
        return node

    def __repr__(self) -> str:
        """Shows extent, depth, pools and memory."""
        extent = "x".join(str(n) for n in self.extent)
        return (
            f"N3Tree({extent} (x, y, z), N={self.branching}, depth={self.depth}, "
            f"{self.nodes.capacity} tiles, {self.bricks.capacity} bricks of "
            f"{self.bricks.brick_size}^3+{self.bricks.border}, "
            f"{self.nbytes / 1e6:.1f} MB on {self.device})"
        )

    def validate(self) -> None:
        """Raises ValueError unless every pointer leads to a tile or brick that exists and, where
        it is not shared, is owned once.
        """
        child, brick = self.nodes.child_tn, self.nodes.brick_tn
        if bool(((child < TERMINAL) | (child >= self.nodes.capacity)).any()):
            raise ValueError("N3Tree: a child pointer leads out of the node pool")
        if bool(((brick < CONSTANT) | (brick >= self.bricks.capacity)).any()):
            raise ValueError("N3Tree: a brick pointer leads out of the brick pool")
        for name, pointers, shared in (
            *(("tile", child, self.nodes.shared_t), ("brick", brick, self.bricks.shared_b)),
        ):
            used = pointers[pointers >= 0].to(torch.int64)
            used = used[~shared[used]]
            if used.unique().numel() != used.numel():
                raise ValueError(f"N3Tree: a {name} has two owners")
        parent, places = self.nodes.parent_t.to(torch.int64), self.nodes.loc_t4.to(torch.int64)
        tile = ((parent >= 0) & (self.nodes.tree_t == self.number)).nonzero()[:, 0]
        above = self.loc(parent[tile])
        above[:, 3] += 1
        if not torch.equal(places[tile], above):
            raise ValueError("N3Tree: a tile's place is not that of its parent")

    @classmethod
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
        """Builds the whole tree of a dense volume: levels by the volume's filter, cut into bricks.

        A node is CONSTANT where all finest voxels in reach of its brick are equal, EMPTY where
        they are all at most `threshold`; neither has a brick or children.

        Args:
            volume: A volume, which becomes channel "value", or one volume for each channel, all of
                one extent.
            brick_size: Voxels along a side of a brick without border, >= 2.
            border: Voxels around a brick; from 1 on no seam shows.
            branching: N >= 2.
            threshold: Regions with no value above it are EMPTY: they are never drawn, whatever the
                transfer function. None keeps every value.
            device: Where the pools lie.
            progress: Told how many levels are done.

        Returns:
            A tree with every node resident.

        Raises:
            ValueError: An argument is out of its range, or channels differ in extent, spacing or
                origin.

        Source: Crassin et al., "GigaVoxels", I3D 2009, section 3; docs/design.md, section 2.
        """
        volumes = dict(volume) if isinstance(volume, Mapping) else {"value": volume}
        first = check_channels("from_volume", volumes)
        check.whole("from_volume", "branching", branching, low=2, high=16)
        if threshold is not None:
            threshold = check.number("from_volume", "threshold", threshold)
        channels = {n: Channel(v.data.dtype, v.data.shape[3]) for n, v in volumes.items()}
        BrickPool(0, channels, brick_size=brick_size, border=border)  # its checks, before the work
        depth = 0
        while brick_size * branching**depth < max(first.extent):
            depth += 1

        sizes = {"branching": branching, "brick_size": brick_size, "border": border}
        plan = _Plan.make(volumes, depth, threshold, sizes, progress)
        tree = cls(
            NodePool(plan.tiles, channels, branching=branching, device=device),
            BrickPool(plan.bricks, channels, brick_size=brick_size, border=border, device=device),
            depth=depth,
            extent=first.extent,
            spacing=first.spacing,
            origin=first.origin,
            value_range={name: volume.value_range for name, volume in volumes.items()},
        )
        plan.link(tree)
        for name, volume_ in volumes.items():
            levels = volume_levels(volume_, depth + 1, **sizes)
            for done, level in enumerate(levels):
                plan.fill(tree, name, depth - done, level)
                progress("bricks", done + 1, depth + 1)
        return tree


def check_channels(where: str, volumes: Mapping[str, Volume]) -> Volume:
    """Returns the first of some volumes, all of which must have one extent, spacing and origin."""
    if not volumes:
        raise ValueError(f"{where}: volume must name at least one channel")
    for name, volume in volumes.items():
        if not isinstance(volume, Volume):
            raise ValueError(
                f"{where}: volume must be a Volume (gv.Volume(data, spacing)), "
                f"got {type(volume).__name__} for channel {name!r}"
            )
    first, *others = volumes.values()
    for volume in others:
        if (volume.extent, volume.spacing, volume.origin) != (
            *(first.extent, first.spacing, first.origin),
        ):
            raise ValueError(
                f"{where}: channels must share extent, spacing and origin: {first} and {volume}"
            )
    return first


class _Plan:
    """Which nodes exist and what they hold, by depth, before any pool is made.

    region: for each depth (gz, gy, gx) int32: DATA nodes hold their brick slot, others CONSTANT or
        EMPTY.
    tile: for each depth (gz, gy, gx) int32: tile of the node's children, or TERMINAL.
    """

    def __init__(self, depth: int, branching: int) -> None:
        self.depth, self.branching = depth, branching
        self.region: dict[int, Tensor] = {}
        self.tile: dict[int, Tensor] = {}
        self.constant: dict[tuple[str, int], Tensor] = {}
        self.range: dict[tuple[str, int], Tensor] = {}
        self.tiles, self.bricks = 1, 0

    @classmethod
    def make(
        cls,
        volumes: Mapping[str, Volume],
        depth: int,
        threshold: float | None,
        sizes: dict[str, int],
        progress: Progress,
    ) -> _Plan:
        plan = cls(depth, sizes["branching"])
        constant: dict[int, Tensor] = {}
        empty: dict[int, Tensor] = {}
        for name, volume in volumes.items():
            for done, level in enumerate(volume_levels(volume, depth + 1, **sizes)):
                at = depth - done
                flat = (level.low == level.high).all(-1)
                below = torch.zeros_like(flat)
                if threshold is not None:
                    below = (level.high <= threshold).all(-1)
                constant[at] = constant.get(at, flat) & flat
                empty[at] = empty.get(at, below) & below
                plan.constant[name, at] = torch.where(flat[..., None], level.low, level.mean)
                plan.range[name, at] = torch.stack((level.low, level.high), -2)
                progress("levels", done + 1, depth + 1)
        for at in range(depth + 1):
            plan._number(at, constant[at], empty[at])
        return plan

    def _number(self, at: int, constant: Tensor, empty: Tensor) -> None:
        """Gives tiles and slots to the nodes of a depth whose parents have data."""
        data = ~(constant | empty)
        if at > 0:
            index = [torch.arange(size) // self.branching for size in data.shape]
            data &= (self.tile[at - 1] >= 0)[torch.meshgrid(*index, indexing="ij")]
        region = torch.where(empty, EMPTY, CONSTANT).to(torch.int32)
        slots = self.bricks + torch.arange(int(data.sum()), dtype=torch.int32)
        region[data] = slots
        self.region[at], self.bricks = region, self.bricks + slots.numel()
        tile = torch.full(data.shape, TERMINAL, dtype=torch.int32)
        if at < self.depth:
            tile[data] = self.tiles + torch.arange(slots.numel(), dtype=torch.int32)
            self.tiles += slots.numel()
        self.tile[at] = tile

    def link(self, tree: N3Tree) -> None:
        """Writes the node pool and the constants."""
        nodes = tree.nodes
        device, n, dim = tree.device, self.branching, nodes.nodes_per_tile
        nodes.child_tn[:], nodes.brick_tn[:] = TERMINAL, EMPTY  # also the nodes beyond the extent
        self._link_nodes(
            tree, 0, torch.zeros((1, 3), dtype=torch.int64), torch.zeros(1, dtype=torch.int64)
        )
        for at in range(self.depth):
            parent = (self.tile[at] >= 0).nonzero()  # (k, 3) z y x
            tile = self.tile[at][tuple(parent.T)].to(torch.int64)
            here = tile.to(device)
            nodes.loc_t4[here, :3] = parent.flip(1).to(torch.int32).to(device)
            nodes.loc_t4[here, 3] = at + 1
            nodes.parent_t[here] = self._node_index(at, parent, dim).to(torch.int32).to(device)
            shape = torch.tensor(self.region[at + 1].shape)
            for child in range(dim):
                offset = torch.tensor([child // n**2, child // n % n, child % n])
                zyx = parent * n + offset
                inside = (zyx < shape).all(1)
                self._link_nodes(tree, at + 1, zyx[inside], tile[inside] * dim + child)

    def _link_nodes(self, tree: N3Tree, at: int, zyx: Tensor, node: Tensor) -> None:
        nodes, place, here = tree.nodes, tuple(zyx.T), node.to(tree.device)
        region = self.region[at][place].to(tree.device)
        nodes.child_tn.view(-1)[here] = self.tile[at][place].to(tree.device)
        nodes.brick_tn.view(-1)[here] = region
        owned = region >= 0
        tree.bricks.owner_b[region[owned].long()] = here[owned].to(torch.int32)
        for pool, plan in ((nodes.constants, self.constant), (nodes.ranges, self.range)):
            for name, words in pool.items():
                value = round_to(plan[name, at][place], words.dtype).to(tree.device)
                movable(words).flatten(0, 1)[here] = movable(value)

    def _node_index(self, at: int, zyx: Tensor, dim: int) -> Tensor:
        """Node index of the nodes at a depth: tile of the parent's children, then the child's
        place.
        """
        if at == 0:
            return torch.zeros(zyx.shape[0], dtype=torch.int64)
        n = self.branching
        tile = self.tile[at - 1][tuple((zyx // n).T)].to(torch.int64)
        z, y, x = (zyx % n).unbind(1)
        return tile * dim + (z * n + y) * n + x

    def fill(self, tree: N3Tree, name: str, at: int, level: Level) -> None:
        """Cuts the bricks of a depth out of its level."""
        pool = tree.bricks
        bricks = movable(pool.bricks[name])
        data = (self.region[at] >= 0).nonzero()
        slots = self.region[at][tuple(data.T)].to(torch.int64)
        for start in range(0, data.shape[0], _BATCH):
            part = slice(start, start + _BATCH)
            brick = cut_bricks(level.values, data[part], pool.brick_size, pool.border)
            bricks[slots[part].to(tree.device)] = movable(brick).to(tree.device)
