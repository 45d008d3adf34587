"""`Producer`, which makes the content of a tree, and the records of its answers. A producer knows
nodes by their location only, never pools and slots.

Source: Crassin et al., "GigaVoxels", I3D 2009, section 5; Crassin, PhD thesis 2011, chapter 7 (a
    producer may decline).
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor

from ..base import check
from ..base.check import extent_of
from ..base.constants import MAX_BRANCHING
from ..base.rows import distinct_rows
from ..base.volume import movable
from ..pool import Channel
from ..pool.pools import phrase
from ..pool.staging import TableRows, Voxels, on_device
from .nodes import Layout, Nodes

#: Returns (k,) bool: which of k nodes have changed, in their own voxels or in those below them.
ChangeTest = Callable[[Nodes], Tensor]
# Versions, shared by all producers: a later change has a larger one.
_version_numbers = itertools.count(1)
_version_lock = threading.Lock()  # any thread may declare a change
_MAX_CHANGES = 64  # changes that are kept; if more are asked for, everything may have changed


class Region(IntEnum):
    """What a node holds."""

    EMPTY = 0  # nothing to draw, neither here nor in its children
    CONSTANT = 1  # one value everywhere, also in its children
    DATA = 2  # voxels; its children may hold more detail
    DATA_MAX_DEPTH = 3  # voxels; its children hold no more detail and are never asked for
    ALIAS = 4  # the same as another node (the alias target), including everything below it


def by_depth(loc: Tensor) -> Iterator[tuple[int, Tensor]]:
    """Yields each depth among locs (k, 4), and the indices (m,) of the nodes at that depth; waits
    for the device.
    """
    for depth in loc[:, 3].unique().tolist():
        yield depth, (loc[:, 3] == depth).nonzero()[:, 0]


def _interpolate(bricks: Tensor, row: Tensor, position: Tensor) -> Tensor:
    """Returns (p, c) float32 values, interpolated trilinearly at `position` (p, 3), in
    voxels, in the bricks with indices `row` (p,) among `bricks` (k, z, y, x, c).
    """
    position = position.clamp(0, bricks.shape[1] - 1)  # bricks without a border end there
    low = position.floor().clamp(max=bricks.shape[1] - 2)
    fraction, low = (position - low).to(torch.float32), low.to(torch.int64)
    values = bricks.new_zeros((len(row), bricks.shape[-1]), dtype=torch.float32)
    for corner in itertools.product((0, 1), repeat=3):
        corner_offset = torch.tensor(corner, device=low.device)
        x, y, z = (low + corner_offset).unbind(1)
        weight = torch.where(corner_offset == 1, fraction, 1 - fraction).prod(1, keepdim=True)
        values += weight * bricks[row, z, y, x].to(torch.float32)
    return values


class Answer:
    """Base of answers of producers: tensors with a row for each of k items, mostly by channel."""

    def rows(self, row: Tensor) -> Self:
        """Returns the items with indices `row` (m,), with `errors` left empty."""

        def select(value: Any) -> Any:
            if isinstance(value, TableRows):
                return value[row]
            return movable(value)[row.to(value.device)].view(value.dtype)

        return self.each(select, errors={})

    def each(self, change: Callable[[Any], Any], **others: Any) -> Self:
        """Returns the answer with `change` applied to all tensors and rows, and fields `others`."""

        def changed(value: Any) -> Any:
            if isinstance(value, Mapping):
                return {name: changed(entry) for name, entry in value.items()}
            return change(value) if isinstance(value, (Tensor, TableRows)) else value

        fields = {name: changed(value) for name, value in vars(self).items()}
        return type(self)(**fields | others)

    def __repr__(self) -> str:
        return check.summary(self)


@dataclass(frozen=True, kw_only=True, repr=False)
class Regions(Answer):
    """Answer of `classify`: what each of k nodes holds. Constants and ranges are by channel."""

    kind: Tensor  # (k,) of `Region`
    constants: Mapping[str, Tensor] = field(default_factory=dict)  # (k, c), see `Region.CONSTANT`
    ranges: Mapping[str, Tensor] = field(default_factory=dict)  # (k, 2, c) smallest, largest value
    alias: Tensor | None = None  # (k, 4) int64 locs of alias targets, read where kind is ALIAS
    alias_tree: str | None = None  # name of the tree of the alias targets; None: this one
    errors: Mapping[int, str] = field(default_factory=dict, repr=False)  # by item, why it failed


@dataclass(frozen=True, kw_only=True, repr=False)
class Bricks(Answer):
    """Answer of `fill`: the voxels of k bricks, or why a brick has none.

    Voxels may be on the engine's device or in host memory, from which they are sent through pinned
    memory while the engine renders. For bricks that already exist in host memory, rows of a
    `BrickTable` are the fastest answer. Tensors in pinned memory are not copied at once, so they
    must not be changed afterwards.
    """

    data: Voxels  # for each channel (k, z, y, x, c), border included; read where kind is DATA
    kind: Tensor | None = None  # (k,) of `Region`, -1: not finite; None: all DATA
    constants: Mapping[str, Tensor] = field(default_factory=dict)  # as in `Regions`
    alias: Tensor | None = None  # as in `Regions`
    alias_tree: str | None = None  # as in `Regions`
    errors: Mapping[int, str] = field(default_factory=dict, repr=False)  # as in `Regions`

    def voxels(self, name: str) -> Tensor | TableRows:
        """Returns a channel's voxels; those of EMPTY and CONSTANT items are filled with their
        constants, or 0 without any, since `data` need not hold them.
        """
        values, kind = self.data[name], self.kind
        if kind is None:
            return values
        uniform = (kind == Region.EMPTY) | (kind == Region.CONSTANT)
        if kind.device.type == "cpu" and not uniform.any():  # CUDA would have to wait
            return values
        values = values.gather() if isinstance(values, TableRows) else values
        uniform = uniform.to(values.device)
        shape = (len(uniform), *(1,) * 3, -1)[: values.dim()]
        constant = self.constants.get(name, values.new_zeros(len(uniform))).to(values)
        stored = torch.where(uniform.view(shape), movable(constant).view(shape), movable(values))
        return stored.view(values.dtype)


class Producer(torch.nn.Module):
    """Base of producers. A subclass implements `fill`, which makes the bricks of a batch of nodes,
    and, if it saves work, `classify`, which returns what nodes hold.

    A producer is used by one engine, from one thread at a time: the one that renders, or that of a
    captured frame. Its futures may be completed in any thread.

    Attributes:
        patience: Seconds after which an answer that has not come counts as failed; None: the
            engine's, or the longest of the producers that it is made of.
        layout: Set by the engine that uses this producer; otherwise None.
        on_device: Whether `classify` and `fill` take and return only tensors on the engine's
            device, and never make the host wait or copy from host memory, so that `Engine.capture`
            can record them. Batches then have a fixed size and are padded with the root.
        on_host: Whether `classify` and `fill` take locs on the host (`Nodes.loc`), and soon return
            tensors there, or futures: a captured frame then calls them while the device renders.
        needs_parent: Whether `fill` needs the bricks of the nodes' parents (`Nodes.parents`): a
            node then waits until its parent has a brick. Engines on CUDA also record this if the
            producer is `on_device`.
        host_bytes: Bytes of host memory that it may fill while it is used.
        made_of: For coarse channels, by name, what they are made of: shaders compare it with what
            they need.
        version: Number of the content, which increases with each change: see `changed`.
        extent, spacing, origin, branching, channels, value_range, labels: See `__init__`.
    """

    version: int = 0

    patience: float | None = None
    on_device: bool = False
    on_host: bool = False
    needs_parent: bool = False
    host_bytes: int = 0
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
        labels: Mapping[str, Tensor | None] | None = None,
    ) -> None:
        """Sets where the content lies, and what voxels hold.

        Args:
            extent: Voxels of the finest level, one number or (x, y, z).
            channels: What a voxel holds, by name; one float32 "value" if left out.
            box: World corners ((x, y, z), (x, y, z)) that the extent fills; replaces spacing and
                origin.
            spacing: World size of a finest voxel, one number or (x, y, z).
            origin: World position of the centre of voxel 0.
            branching: N >= 2.
            value_range: Smallest and largest value of each channel for which they are known.
            labels: For channels that hold labels: (k,) int64, increasing, the label of each value;
                None: values are the labels. Coarse voxels of such channels hold labels, too.

        Raises:
            ValueError: A number is out of its range.
        """
        super().__init__()
        context = type(self).__name__
        self.extent = extent_of(context, extent)
        if box is not None:
            low, high = check.box(context, box)
            spacing = [(b - a) / n for a, b, n in zip(low, high, self.extent, strict=True)]
            origin = [a + 0.5 * s for a, s in zip(low, spacing, strict=True)]
        if isinstance(spacing, (int, float)):
            spacing = (spacing,) * 3
        self.spacing, self.origin = check.grid_placement(context, spacing, origin, self.extent)
        self.branching = check.integer(context, "branching", branching, low=2, high=MAX_BRANCHING)
        arguments = {"channels": channels, "value_range": value_range, "labels": labels}
        for argument, value in arguments.items():
            if value is not None and not isinstance(value, Mapping):
                kind = type(value).__name__
                raise ValueError(f"{context}: {argument} must be a dict by channel, got a {kind}")
        self.channels = dict(channels) if channels is not None else {"value": Channel()}
        for name, channel in self.channels.items():
            check.instance(context, f"channels[{name!r}]", channel, Channel)
        self.value_range, self.labels = dict(value_range or {}), dict(labels or {})
        for argument, by_channel in (("value_range", self.value_range), ("labels", self.labels)):
            for name in by_channel:
                check.channel(f"{context}: {argument}", name, self.channels, "the producer")
        for name, bounds in self.value_range.items():
            low, high = check.reals(context, f"value_range[{name!r}]", bounds, (2,))
            if low > high:
                raise ValueError(
                    f"{context}: value_range[{name!r}] must be (smallest, largest), got {bounds!r}"
                )
        self.made_of: dict[str, Any] = {}
        self._changes: deque[tuple[int, ChangeTest | None]] = deque(maxlen=_MAX_CHANGES)

    def prepare(self, layout: Layout) -> None:
        """Prepares for nodes of a layout. The engine calls it once, before any other method."""

    def classify(self, nodes: Nodes) -> Regions | Tensor | Future:
        """Returns what k nodes hold; all DATA unless overridden.

        DATA is always correct but costs memory. EMPTY and CONSTANT must be true of everything
        within the node's brick, border included, and within the bricks of all nodes below it.

        Returns:
            `Regions`, or only their (k,) kinds; either at once or as a future.
        """
        return torch.full((len(nodes),), Region.DATA, device=nodes.loc.device)

    def fill(self, nodes: Nodes) -> Bricks | Mapping[str, Tensor] | Tensor | Future:
        """Makes the voxels of k bricks, borders included.

        Coarse levels must be pre-filtered: a voxel is the mean over the space that it covers.

        Returns:
            `Bricks`, or only their voxels {channel: (k, z, y, x, c)}, or one tensor if there is one
            channel; either at once or as a future. Coarse channels (`Channel.coarse`) must be
            included if `nodes.coarse` is true, and only then.
        """
        raise NotImplementedError(f"{type(self).__name__}: fill is not implemented")

    def patience_in(self, engine_patience: float) -> float:
        """Returns `patience`; or, where that is None, the engine's."""
        return engine_patience if self.patience is None else self.patience

    def changed(self, where: ChangeTest | Tensor | Sequence[Any] | None = None) -> None:
        """Declares that the content has changed, for example to another time: in its next frame the
        engine drops what it holds of the changed nodes, and asks for them again.

        Args:
            where: World corners (2, 3) or (m, 2, 3) of boxes; voxels of all levels that lie outside
                of them must be unchanged. Or a function of `Nodes` that returns (k,) bool: which
                have changed, themselves or anything below them. Left out: everything.

        Raises:
            ValueError: Corners are not finite, of another shape, or the low one is not below.
        """
        if where is not None and not callable(where):
            context = f"{type(self).__name__}.changed"
            boxes = check.reals(context, "where", where)
            if boxes.dim() not in (2, 3) or boxes.shape[-2:] != (2, 3):
                got = check.as_text(boxes)
                raise ValueError(f"{context}: where must be (2, 3) or (m, 2, 3) corners, got {got}")
            if not bool((boxes[..., 0, :] <= boxes[..., 1, :]).all()):
                raise ValueError(
                    f"{context}: where must be low and high corners, got {boxes.tolist()}"
                )
            where = partial(Nodes.touch, boxes=boxes.view(-1, 2, 3))
        with _version_lock:
            version = next(_version_numbers)
            self._changes.append((version, where))
            self.version = version

    def changes(self, since: int) -> list[ChangeTest] | None:
        """Returns functions that find the nodes changed since a version; None: any may have."""
        newer = [finder for version, finder in list(self._changes) if version > since]
        finders = [finder for finder in newer if finder is not None]
        return finders if 0 < len(finders) == len(newer) < _MAX_CHANGES else None

    def differs(self, nodes: Nodes, before: float, after: float) -> Tensor:
        """Returns (k,) bool: which nodes differ between two times, in a voxel of their own, borders
        included, or in one below them. Unless overridden all do, if any part has a time.
        """
        return torch.full_like(nodes.depth, hasattr(self, "time"), dtype=torch.bool)

    @property
    def time(self) -> float:
        """The time of all parts that have a buffer `time` (`Field.number`), such as fields or other
        producers. Setting it calls `changed` for the nodes that `differs` returns, or for all if
        the parts had different times. AttributeError if no part has a time.
        """
        return float(self._clocks()[0])

    @time.setter
    def time(self, value: float) -> None:
        clocks = self._clocks()
        time = check.number(type(self).__name__, "time", value)
        old_times = {float(clock) for clock in clocks}
        for clock in clocks:
            clock.fill_(time)
        where = None
        if len(old_times) == 1:
            where = partial(self.differs, before=old_times.pop(), after=time)
        self.changed(where)

    @contextmanager
    def at_time(self, time: float) -> Iterator[None]:
        """Sets another time within a `with` block, without calling `changed`."""
        clocks = self._clocks()
        old_values = [float(clock) for clock in clocks]
        try:
            for clock in clocks:
                clock.fill_(time)
            yield
        finally:
            for clock, value in zip(clocks, old_values, strict=True):
                clock.fill_(value)

    def _clocks(self) -> list[Tensor]:
        if not (clocks := clocks_of(self)):
            raise AttributeError(f"{type(self).__name__}: no part of it keeps a number 'time'")
        return clocks

    def at(self, points: Tensor) -> dict[str, Tensor]:
        """Returns the values at world points (..., 3), for each channel (..., c) float32,
        interpolated between the eight nearest finest voxels as renderers do. Needs no engine;
        without one, each call prepares the producer for bricks of 8^3, because since the last call
        another may have prepared it for other bricks, or its data may have been edited in place.
        Where preparing is slow (`VolumeProducer`, `FromChildren`), pass many points in one call.

        Raises:
            ValueError: Points have another shape or are not finite, or a brick can't be made.
        """
        check_points(f"{type(self).__name__}.at", points)
        if self.layout is None:
            layout = Layout.of(self, 8, 1, points.device)
            self.prepare(layout)
        else:
            layout = self.layout
        if not points.numel():
            widths = {n: c.width for n, c in self.channels.items() if not c.coarse}
            return {n: points.new_zeros((*points.shape[:-1], c)).float() for n, c in widths.items()}
        position = (points.reshape(-1, 3).to(layout.origin_3) - layout.origin_3) / layout.spacing_3
        position = torch.minimum(position.clamp(min=0), layout.extent_3 - 1)  # in voxels
        depth = torch.full_like(position[:, :1], layout.depth)
        node = ((position + 0.5) / layout.brick_size).floor()
        node_loc = torch.cat((node, depth), 1).to(torch.int64)
        loc, row = distinct_rows(node_loc)
        bricks_of = self.bricks_at(loc, layout)
        brick_position = position - node_loc[:, :3] * layout.brick_size + layout.border
        values = {}
        for name, bricks in bricks_of.items():
            values[name] = _interpolate(bricks, row, brick_position).view(*points.shape[:-1], -1)
        return values

    def bricks_at(self, loc: Tensor, layout: Layout) -> dict[str, Tensor]:
        """Returns, by channel, the bricks (k, z, y, x, c) of nodes `loc` (k, 4) of one level; makes
        those of their parents first if they are needed. Raises ValueError if one can't be made.
        """
        parents = None
        if self.needs_parent and bool((loc[:, 3] > 0).all()):
            parent_loc = torch.cat((loc[:, :3] // layout.branching, loc[:, 3:] - 1), 1)
            parent_loc, row = distinct_rows(parent_loc)
            parent_bricks = self.bricks_at(parent_loc, layout)
            parents = {name: bricks[row] for name, bricks in parent_bricks.items()}
        answer = wait_for(self.fill(Nodes(loc, layout, parents=parents)))
        answer = self.as_bricks(answer)
        for message in answer.errors.values():
            raise ValueError(f"{type(self).__name__}.at: {message}")
        kind = answer.kind
        if kind is not None and bool(((kind < Region.EMPTY) | (kind == Region.ALIAS)).any()):
            raise ValueError(f"{type(self).__name__}.at: a brick is not finite, or an alias")
        shape = (len(loc), *(layout.side,) * 3, -1)
        return {n: on_device(answer.voxels(n), loc.device).view(shape) for n in answer.data}

    def as_bricks(self, answer: Any) -> Any:
        """Wraps an answer of `fill` in `Bricks`; returns `Bricks` and invalid answers unchanged."""
        if isinstance(answer, Tensor) and len(self.channels) == 1:
            answer = dict.fromkeys(self.channels, answer)
        return Bricks(data=answer) if isinstance(answer, Mapping) else answer

    def close(self) -> None:
        """Closes files and stops threads; does nothing unless overridden."""

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out the engine that it serves: a copy serves none."""
        return {name: value for name, value in vars(self).items() if name != "layout"}

    def __repr__(self) -> str:
        extent = "x".join(str(n) for n in self.extent)
        channels = phrase(self.channels)
        return f"{type(self).__name__}({extent} (x, y, z), N={self.branching}, {channels})"


class OfProducers(Producer):
    """Base of producers made of other producers: prepares, changes and closes all of them."""

    def parts(self) -> dict[str, Producer]:
        """Returns the producers that it is made of, by name."""
        raise NotImplementedError

    @property
    def version(self) -> int:  # type: ignore[override]
        """The latest version of any part."""
        return max(part.version for part in self.parts().values())

    @property
    def host_bytes(self) -> int:  # type: ignore[override]
        """The sum over all parts."""
        return sum(part.host_bytes for part in self.parts().values())

    def patience_in(self, engine_patience: float) -> float:
        """Returns `patience`; or, where that is None, the longest of the parts."""
        if self.patience is not None:
            return self.patience
        return max(part.patience_in(engine_patience) for part in self.parts().values())

    def changed(self, where: Any = None) -> None:
        """See `Producer.changed`; calls it for all parts."""
        for part in self.parts().values():
            part.changed(where)

    def changes(self, since: int) -> list[ChangeTest] | None:
        """See `Producer.changes`; returns the changes of all parts."""
        newer = [part for part in self.parts().values() if part.version > since]
        part_changes = [part.changes(since) for part in newer]
        known_changes = [changes for changes in part_changes if changes is not None]
        if len(known_changes) < len(part_changes):
            return None
        # Each change once.
        return [*dict.fromkeys(finder for changes in known_changes for finder in changes)]

    def differs(self, nodes: Nodes, before: float, after: float) -> Tensor:
        """Returns (k,) bool: the nodes in which any part with a time differs."""
        parts = [*self.parts().values()]
        timed = [part for part in parts if hasattr(part, "time")] or parts
        return torch.stack([part.differs(nodes, before, after) for part in timed]).any(0)

    def prepare(self, layout: Layout) -> None:
        for part in self.parts().values():
            part.prepare(layout)

    def close(self) -> None:
        for part in self.parts().values():
            part.close()


def check_points(context: str, points: Any, *, floats: bool = False) -> None:
    """Raises ValueError unless points are (..., 3) and finite, and floats if `floats` is true."""
    check.instance(context, "points", points, Tensor)
    if points.shape[-1:] != (3,) or (floats and not points.is_floating_point()):
        wanted, got = "(..., 3) floats" if floats else "(..., 3)", check.describe(points)
        raise ValueError(f"{context}: points must be {wanted}, got {got}")
    if not bool(torch.isfinite(points).all()):
        raise ValueError(f"{context}: points must be finite")


def clocks_of(module: torch.nn.Module) -> list[Tensor]:
    """Returns the buffers `time` of all parts that have one."""
    return [buffer for name, buffer in module.named_buffers() if name.rpartition(".")[2] == "time"]


def changed_nodes(changes: Sequence[ChangeTest], nodes: Nodes) -> Tensor:
    """Returns (k,) bool: which nodes any of the changes affects."""
    return torch.stack([finder(nodes) for finder in changes]).any(0)


def wait_for(answer: Any) -> Any:
    """Returns a producer's answer; waits for it if it is a future."""
    return answer.result() if isinstance(answer, Future) else answer
