"""`NodePool` and `BrickPool`: slots for node tiles and bricks, as flat tensors, one row per slot;
and `Channel`: what a voxel holds.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from ..base import check
from ..base.arrays import as_volume
from ..base.constants import ABSENT, MAX_BRANCHING
from ..base.volume import CHANNEL_DTYPES, Volume, movable

_SHARED_ATTRIBUTES = ("extent", "spacing", "origin")  # what the volumes of one tree share


@dataclass(frozen=True)
class Channel:
    """What a voxel of a channel holds: `width` numbers of `dtype`. A coarse channel exists only
    above the finest level: it describes the finest voxels below each coarse voxel.
    """

    dtype: torch.dtype = torch.float32  # of the numbers: integers of 8 or 16 bits, floats to 32
    width: int = 1  # numbers in a voxel
    coarse: bool = False  # whether only coarse bricks have it

    def __post_init__(self) -> None:
        if self.dtype not in CHANNEL_DTYPES:
            names = ", ".join(str(dtype).removeprefix("torch.") for dtype in CHANNEL_DTYPES)
            raise ValueError(f"Channel: dtype must be one of {names}, got {self.dtype}")
        vars(self)["width"] = check.integer("Channel", "width", self.width, low=1)
        check.instance("Channel", "coarse", self.coarse, bool)

    @classmethod
    def of(cls, volume: Volume) -> Channel:
        """Returns the channel that holds a volume's voxels."""
        return cls(volume.data.dtype, volume.width)

    @property
    def nbytes(self) -> int:
        """Bytes of one voxel."""
        return self.dtype.itemsize * self.width

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest number of the dtype."""
        dtype_info = torch.finfo if self.dtype.is_floating_point else torch.iinfo
        return (dtype_info(self.dtype).min, dtype_info(self.dtype).max)

    def unknown_range(self, *shape: int, device: torch.device | str) -> Tensor:
        """Returns (*shape, 2, width) ranges of nodes of which nothing is known: `limits`."""
        size = (*shape, self.width)
        ends = [torch.full(size, n, dtype=self.dtype, device=device) for n in self.limits]
        return torch.stack([movable(end) for end in ends], -2).view(self.dtype)


def phrase(channels: Mapping[str, Channel]) -> str:
    """Returns channels as one phrase for a repr, as in "density float32x1, color uint8x4"."""
    return ", ".join(
        f"{name} {str(channel.dtype).removeprefix('torch.')}x{channel.width}"
        + " of coarse bricks" * channel.coarse
        for name, channel in channels.items()
    )


def volumes_by_channel(context: str, volume: Volume | Mapping[str, Volume]) -> dict[str, Volume]:
    """Returns volumes by channel name; one volume alone becomes channel "value".

    Arrays become volumes, see `as_volume`.

    Raises ValueError if there is none, one is not a volume, a name is no str, or they differ in
    extent, spacing or origin.
    """
    by_name = dict(volume) if isinstance(volume, Mapping) else {"value": volume}
    for name in by_name:
        check.instance(context, "name of a channel", name, str)
    volumes = {
        name: as_volume(array, context=f"{context}: channel {name!r}")
        for name, array in by_name.items()
    }
    if not volumes:
        raise ValueError(f"{context}: volume must name at least one channel")
    first, *others = volumes.values()
    for other in others:
        if any(getattr(other, name) != getattr(first, name) for name in _SHARED_ATTRIBUTES):
            raise ValueError(
                f"{context}: channels must share extent, spacing and origin: {first} and {other}"
            )
    return volumes


def checked_threshold(context: str, threshold: Any, volumes: Mapping[str, Volume]) -> float | None:
    """Returns a user's threshold; raises ValueError where it is not a number, or where all channels
    are labels, whose order means nothing.
    """
    if threshold is None:
        return None
    if all(volume.info.labels for volume in volumes.values()):
        raise ValueError(f"{context}: threshold is for values; labels are hidden by the shader")
    return check.number(context, "threshold", threshold)


def labels_by_channel(volumes: Mapping[str, Volume]) -> dict[str, Tensor | None]:
    """Returns `N3Tree.labels` of the volumes that a tree is made of."""
    return {name: volume.label_values for name, volume in volumes.items() if volume.info.labels}


class _Pool:
    channels: dict[str, Channel]

    @property
    def fields(self) -> dict[str, Tensor]:
        """All tensors by name; those of a channel as `ranges.NAME`."""
        tensors: dict[str, Tensor] = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                tensors[name] = value
            elif isinstance(value, dict) and name != "channels" and name[0] != "_":
                tensors |= {f"{name}.{channel}": tensor for channel, tensor in value.items()}
        return tensors

    @property
    def capacity(self) -> int:
        """Number of slots."""
        return next(len(field) for field in vars(self).values() if isinstance(field, Tensor))

    @property
    def nbytes(self) -> int:
        """Bytes of all fields."""
        return sum(field.nbytes for field in self.fields.values())

    def to(self, device: torch.device | str) -> Self:
        """Returns the pool with its fields on a device; fields already there are shared."""
        other = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(other, name, value.to(device))
            elif isinstance(value, dict):
                setattr(other, name, {key: _move(tensor, device) for key, tensor in value.items()})
        return other

    def _describe(self, slots: str) -> str:
        device = next(iter(self.fields.values())).device
        return (
            f"{type(self).__name__}({self.capacity} {slots}, "
            f"{phrase(self.channels) or 'no channels'}, {self.nbytes / 1e6:.1f} MB on {device})"
        )


def _move(value: Any, device: torch.device | str) -> Any:
    """Returns a tensor on a device, as a leaf that requires gradients if it did; else the value."""
    if not isinstance(value, Tensor):
        return value
    moved = value.detach().to(device)
    is_shared = moved.data_ptr() == value.data_ptr()
    return value if is_shared else moved.requires_grad_(value.requires_grad)


_WriteState = tuple[int, int]


def _write_state(voxels: Tensor) -> _WriteState:
    """Returns a tensor's address and how often it was written in place, or -1 for an inference
    tensor, of which torch does not count that.
    """
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor  # in a transform of torch.func
    while not torch.compiler.is_compiling() and wrapped(voxels):
        voxels = torch._C._functorch.get_unwrapped(voxels)
    return (voxels.data_ptr(), -1 if voxels.is_inference() else voxels._version)


class NodePool(_Pool):
    """Slots for `capacity` node tiles of n = branching ** 3 sibling nodes each.

    Node index = tile * n + child, child = (z * branching + y) * branching + x. A fresh tile's nodes
    have neither children nor brick. Trees of several N may share a pool, whose tiles are then as
    wide as the widest: n = largest N ** 3. Threads must hold `Engine.lock` to read an engine's.

    Attributes:
        branching: N of the widest tree.
        channels: What each voxel holds, by name.
        child_tn: (t, n) int32 tile of the node's children, or ABSENT (not loaded), TERMINAL (none).
        brick_tn: (t, n) int32 slot of the node's brick, or ABSENT, EMPTY, CONSTANT.
        request_tn: (t, n) int16 what rays have requested since the words were last cleared.
        loc_t4: (t, 4) int32 x, y, z of the tile's parent node at its own depth, and the depth of
            the tile's nodes; node x at that depth = loc x * N + child x.
        parent_t: (t,) int32 index of the node whose children this tile holds, -1 for a root tile.
        tree_t: (t,) int32 number of the tree that owns the tile.
        stamp_t: (t,) int32 usage stamp: the last frame in which a ray passed through, or after
            which the tile was written; -1 for never.
        shared_t: (t,) bool, whether other nodes may point to the tile as well (aliases).
        constants: For each channel that is not coarse (t, n, c): the value of CONSTANT nodes, the
            mean of EMPTY ones.
        ranges: For each of these (t, n, 2, c): smallest and largest value in reach of the node's
            brick, at all levels; the dtype's limits where it is not known.
    """

    def __init__(
        self,
        capacity: int,
        channels: Mapping[str, Channel] | None = None,
        *,
        branching: int = 2,
        device: torch.device | str = "cpu",
    ) -> None:
        """Allocates `capacity` >= 1 free tiles for trees with N up to `branching` >= 2.

        Raises:
            ValueError: A number is out of its range, or node indices would not fit into int32.
        """
        capacity = check.integer("NodePool", "capacity", capacity, low=1)
        branching = check.integer("NodePool", "branching", branching, low=2, high=MAX_BRANCHING)
        n = branching**3
        if capacity * n >= 2**31:
            raise ValueError(f"NodePool: {capacity} tiles of {n} nodes: more than int32 can name")
        self.branching, self.channels = branching, dict(channels or {})

        def words(value: int, *shape: int) -> Tensor:
            return torch.full((capacity, *shape), value, dtype=torch.int32, device=device)

        self.child_tn, self.brick_tn = words(ABSENT, n), words(ABSENT, n)
        self.request_tn = torch.zeros((capacity, n), dtype=torch.int16, device=device)
        self.loc_t4 = words(0, 4)
        self.parent_t, self.tree_t, self.stamp_t = words(-1), words(0), words(-1)
        self.shared_t = torch.zeros((capacity,), dtype=torch.bool, device=device)
        self.constants: dict[str, Tensor] = {}
        self.ranges: dict[str, Tensor] = {}
        for name, channel in self.channels.items():
            if channel.coarse:
                continue
            shape = (capacity, n, channel.width)
            self.constants[name] = torch.zeros(shape, dtype=channel.dtype, device=device)
            self.ranges[name] = channel.unknown_range(capacity, n, device=device)

    @property
    def nodes_per_tile(self) -> int:
        """n = N ** 3."""
        return self.child_tn.shape[1]

    def __repr__(self) -> str:
        return self._describe(f"tiles of {self.nodes_per_tile} nodes")


class BrickPool(_Pool):
    """Slots for `capacity` bricks of brick_size ** 3 voxels, with `border` voxels around each, in
    any number of named, typed channels. Threads must hold `Engine.lock` to read an engine's pool.

    Attributes:
        brick_size: Voxels along a side of a brick, without the border.
        border: Voxels around a brick, copied from its neighbours.
        channels: What each voxel holds, by name.
        coarse: How many slots, the first ones, hold coarse channels as well. All bricks that have
            such channels lie there, and no others except those of roots.
        bricks: For each channel (b, z, y, x, c) voxels, sides of brick_size + 2 * border; a coarse
            channel has `coarse` bricks.
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
        coarse: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Allocates `capacity` free slots, 0 or more.

        `brick_size` is at least 2, `border` 0 to 16; with 1 or more, trilinear samples meet without
        a seam.

        Raises:
            ValueError: A number is out of its range, or there is no channel.
        """
        capacity = check.integer("BrickPool", "capacity", capacity, low=0, high=2**31 - 1)
        brick_size = check.integer("BrickPool", "brick_size", brick_size, low=2, high=256)
        border = check.integer("BrickPool", "border", border, low=0, high=16)
        if not channels:
            raise ValueError("BrickPool: channels must name at least one channel")
        self.brick_size, self.border = brick_size, border
        self.coarse = check.integer("BrickPool", "coarse", coarse, low=0, high=capacity)
        self.channels = dict(channels)
        cube = (brick_size + 2 * border,) * 3
        self.bricks = {
            name: torch.zeros(
                (coarse if c.coarse else capacity, *cube, c.width), dtype=c.dtype, device=device
            )
            for name, c in channels.items()
        }

        def words(value: int) -> Tensor:
            return torch.full((capacity,), value, dtype=torch.int32, device=device)

        self.stamp_b, self.born_b, self.owner_b = words(-1), words(0), words(-1)
        self.shared_b = torch.zeros((capacity,), dtype=torch.bool, device=device)
        self._checked_states: dict[str, _WriteState] = {}  # by channel, when last checked
        self._edited: set[str] = set()
        self._reported: set[str] = set()

    def __getitem__(self, channel: str) -> Tensor:
        """Returns the voxels of a channel, (b, z, y, x, c) with borders, to read or to edit."""
        check.instance("BrickPool", "channel", channel, str)
        check.channel("BrickPool", channel, self.bricks, "it")
        return self.bricks[channel]

    def __setitem__(self, channel: str, voxels: Tensor) -> None:
        """Replaces a channel's voxels with another tensor, such as a parameter."""
        current = self[channel]
        check.tensor("BrickPool", channel, voxels, current.shape, current.dtype, current.device)
        if not voxels.is_contiguous():
            raise ValueError(f"BrickPool: {channel} must be contiguous")
        self.bricks[channel] = voxels

    def to(self, device: torch.device | str) -> Self:
        """Returns the pool on a device, with the same channels marked as edited."""
        other = super().to(device)
        other._note_states()
        return other

    def __getstate__(self) -> dict[str, Any]:
        """Looks for edits first: the tensors of a copy have other addresses."""
        self.edited()
        return vars(self).copy()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a copied or pickled pool, with the same channels marked as edited."""
        vars(self).update(state)
        self._edited, self._reported = set(self._edited), set(self._reported)
        self._note_states()

    def in_order(self) -> None:
        """Marks ranges, borders and coarse levels as up to date with the voxels."""
        fine = (name for name, channel in self.channels.items() if not channel.coarse)
        self._checked_states = {name: _write_state(self.bricks[name]) for name in fine}
        self._edited.clear()

    def edited(self) -> list[str]:
        """Returns the channels that were written or replaced since `in_order`, as far as torch
        counts it: a write in place through the tensor, a view or a parameter is counted, one
        through `.data`, NumPy or a pointer is not.
        """
        for name, previous in self._checked_states.items():
            state = _write_state(self.bricks[name])
            if state != previous:
                self._checked_states[name] = state
                self._edited.add(name)
                self._reported.discard(name)
        return sorted(self._edited)

    def new_edits(self, learned: bool = False) -> list[str]:
        """Returns the edited channels that were not returned before: each edit once. `learned`:
        without those that require gradients.
        """

        def is_learned(voxels: Tensor) -> bool:
            return voxels.requires_grad or check.has_tangent(voxels)

        new = [name for name in self.edited() if name not in self._reported]
        new = [name for name in new if not (learned and is_learned(self.bricks[name]))]
        self._reported.update(new)
        return new

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Lets the block write voxels and their ranges: this does not count as an edit."""
        self.edited()
        try:
            yield
        finally:
            self._note_states()

    def _note_states(self) -> None:
        """Takes note of the tensors as they are: from now on `edited` looks for later writes."""
        self._checked_states = {n: _write_state(self.bricks[n]) for n in self._checked_states}

    def __repr__(self) -> str:
        return self._describe(f"bricks of {self.brick_size}^3+{self.border}")
