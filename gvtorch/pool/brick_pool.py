"""`BrickPool`: bricks of voxels in any number of named, typed channels."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ..base import check
from .channel import Channel, phrase


class BrickPool:
    """Slots for `capacity` bricks of brick_size ** 3 voxels, with `border` voxels around each.

    Attributes:
        brick_size: Voxels along a side of a brick, without the border.
        border: Voxels around a brick, copied from its neighbours.
        channels: What each voxel holds, by name.
        bricks: For each channel (b, z, y, x, c) voxels, sides of brick_size + 2 * border.
        stamp_b: (b,) int32 usage stamp: the last frame in which a ray sampled the brick, or after
            which it was written; -1 for never.
        born_b: (b,) int32 first frame that could draw the brick, 0 if it was there from the start.
        owner_b: (b,) int32 index of the node that the brick was made for, -1 for a free slot.
        shared_b: (b,) bool, whether other nodes may point to the brick as well (aliases).
    """

    def __init__(
        self,
        capacity: int,
        channels: Mapping[str, Channel],
        *,
        brick_size: int = 8,
        border: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        """Allocates the pool: every slot is free.

        Args:
            capacity: Number of bricks, 0 or more.
            channels: What each voxel holds, by name.
            brick_size: Voxels along a side, without the border, >= 2.
            border: Voxels around, 0 to 16; from 1 on, trilinear samples meet without a seam.
            device: Device of the tensors.

        Raises:
            ValueError: A number is out of its range, or there is no channel.
        """
        check.whole("BrickPool", "capacity", capacity, low=0, high=2**31 - 1)
        check.whole("BrickPool", "brick_size", brick_size, low=2, high=256)
        check.whole("BrickPool", "border", border, low=0, high=16)
        if not channels:
            raise ValueError("BrickPool: channels must name at least one channel")
        self.brick_size, self.border = brick_size, border
        self.channels = dict(channels)
        side = brick_size + 2 * border
        self.bricks = {
            name: torch.zeros((capacity, side, side, side, c.width), dtype=c.dtype, device=device)
            for name, c in channels.items()
        }
        self.stamp_b = torch.full((capacity,), -1, dtype=torch.int32, device=device)
        self.born_b = torch.zeros((capacity,), dtype=torch.int32, device=device)
        self.owner_b = torch.full((capacity,), -1, dtype=torch.int32, device=device)
        self.shared_b = torch.zeros((capacity,), dtype=torch.bool, device=device)

    @property
    def fields(self) -> dict[str, Tensor]:
        """All tensors by name; channels as `bricks.NAME`."""
        channels = {f"bricks.{name}": tensor for name, tensor in self.bricks.items()}
        names = ("stamp_b", "born_b", "owner_b", "shared_b")
        return channels | {name: getattr(self, name) for name in names}

    @property
    def capacity(self) -> int:
        """Number of slots."""
        return self.stamp_b.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of all fields."""
        return sum(field.nbytes for field in self.fields.values())

    def __repr__(self) -> str:
        """Shows slots, sizes, channels and memory."""
        return (
            f"BrickPool({self.capacity} bricks of {self.brick_size}^3+{self.border}, "
            f"{phrase(self.channels)}, {self.nbytes / 1e6:.1f} MB on {self.stamp_b.device})"
        )
