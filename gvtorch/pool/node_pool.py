"""`NodePool`: node tiles as flat tensors, one row a tile."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..base import check
from ..base.constants import ABSENT
from ..base.volume import movable
from .channel import Channel, phrase


class NodePool:
    """Slots for `capacity` node tiles of n = branching ** 3 sibling nodes each.

    Node index = tile * n + child, child = (z * branching + y) * branching + x. A fresh tile's nodes
    have neither children nor brick. Trees of several N may share a pool, whose tiles are then as
    wide as the widest: n = largest N ** 3.

    Attributes:
        branching: N of the widest tree.
        channels: What each voxel holds, by name.
        child_tn: (t, n) int32 tile of the node's children, or ABSENT (not loaded), TERMINAL (none).
        brick_tn: (t, n) int32 slot of the node's brick, or ABSENT, EMPTY, CONSTANT.
        request_tn: (t, n) int32 what rays have requested since the words were last cleared.
        loc_t4: (t, 4) int32 x, y, z of the tile's parent node at its own depth, and the depth of
            the tile's nodes; node x at that depth = loc x * N + child x.
        parent_t: (t,) int32 index of the node whose children this tile holds, -1 for a root tile.
        tree_t: (t,) int32 number of the tree that owns the tile.
        stamp_t: (t,) int32 usage stamp: the last frame in which a ray passed through, or after
            which the tile was written; -1 for never.
        shared_t: (t,) bool, whether other nodes may point to the tile as well (aliases).
        constants: For each channel (t, n, c): the value of CONSTANT nodes, the mean of EMPTY ones.
        ranges: For each channel (t, n, 2, c): smallest and largest value in reach of the node's
            brick, at all levels; all that the dtype can hold where it is not known.
    """

    def __init__(
        self,
        capacity: int,
        channels: Mapping[str, Channel] | None = None,
        *,
        branching: int = 2,
        device: torch.device | str = "cpu",
    ) -> None:
        """Allocates the pool: every tile is free.

        Args:
            capacity: Number of tiles.
            channels: What each voxel holds, by name; a node keeps a constant and a range of each.
            branching: N >= 2, of the widest tree.
            device: Device of the tensors.

        Raises:
            ValueError: A number is out of its range, or nodes could not be counted in int32.
        """
        check.whole("NodePool", "capacity", capacity, low=1)
        check.whole("NodePool", "branching", branching, low=2, high=16)
        n = branching**3
        if capacity * n >= 2**31:
            raise ValueError(
                f"NodePool: {capacity} tiles of {n} nodes are more than int32 can name"
            )
        self.branching, self.channels = branching, dict(channels or {})
        self.child_tn = torch.full((capacity, n), ABSENT, dtype=torch.int32, device=device)
        self.brick_tn = torch.full((capacity, n), ABSENT, dtype=torch.int32, device=device)
        self.request_tn = torch.zeros((capacity, n), dtype=torch.int32, device=device)
        self.loc_t4 = torch.zeros((capacity, 4), dtype=torch.int32, device=device)
        self.parent_t = torch.full((capacity,), -1, dtype=torch.int32, device=device)
        self.tree_t = torch.zeros((capacity,), dtype=torch.int32, device=device)
        self.stamp_t = torch.full((capacity,), -1, dtype=torch.int32, device=device)
        self.shared_t = torch.zeros((capacity,), dtype=torch.bool, device=device)
        self.constants: dict[str, Tensor] = {}
        self.ranges: dict[str, Tensor] = {}
        for name, channel in self.channels.items():
            shape = (capacity, n, channel.width)
            self.constants[name] = torch.zeros(shape, dtype=channel.dtype, device=device)
            limits = torch.tensor(channel.limits, dtype=torch.float64).to(channel.dtype)
            ends = movable(limits.to(device))[:, None].expand(capacity, n, 2, channel.width)
            self.ranges[name] = ends.contiguous().view(channel.dtype)

    @property
    def fields(self) -> dict[str, Tensor]:
        """All tensors by name; those of a channel as `constants.NAME` and `ranges.NAME`."""
        plain = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        constants = {f"constants.{name}": value for name, value in self.constants.items()}
        return plain | constants | {f"ranges.{name}": v for name, v in self.ranges.items()}

    @property
    def capacity(self) -> int:
        """Number of tiles."""
        return self.child_tn.shape[0]

    @property
    def nodes_per_tile(self) -> int:
        """n = N ** 3."""
        return self.child_tn.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes of all fields."""
        return sum(field.nbytes for field in self.fields.values())

    def __repr__(self) -> str:
        """Shows tiles, nodes a tile, channels and memory."""
        return (
            f"NodePool({self.capacity} tiles of {self.nodes_per_tile} nodes, "
            f"{phrase(self.channels) or 'no channels'}, {self.nbytes / 1e6:.1f} MB "
            f"on {self.child_tn.device})"
        )
