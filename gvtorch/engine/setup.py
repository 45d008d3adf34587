"""Sets up an engine: its options, pools, and a tree with its root for every producer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypedDict

import torch

from ..base import check
from ..base.constants import ABSENT, CONSTANT, EMPTY, REQUEST_LOAD, REQUEST_SUBDIVIDE, TERMINAL
from ..base.messages import reason
from ..base.volume import movable
from ..cache import Cache
from ..cache.write import write_slots
from ..io.resources import amount, memory_free
from ..pool import BrickPool, Channel, N3Tree, NodePool
from ..producers import Layout, Nodes, Producer, Region
from ..producers.answer import checked_bricks, checked_regions, raise_first
from .device_frame import DeviceFrame
from .host_frame import HostFrame
from .production import Production, ProductionError
from .request_batch import ProducedTree

_TILE_BYTES = 16 + 4 * 3 + 1 + 4  # of a tile besides its nodes: NodePool's fields, order of use
_BRICK_BYTES = 4 * 3 + 1 + 4  # of a brick besides its voxels


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """How an engine stores and streams its scene. `help(gv.Engine)` shows these texts.

    Attributes:
        node_pool: Bytes of node words, constants and ranges; a number or a text as in "8 MB".
            Bookkeeping (`Engine.memory`) takes about 50 bytes more per tile of 8 nodes.
        brick_pool: Bytes of voxels, likewise; bookkeeping takes 17 bytes more per brick.
        device: Device of the pools, on which rays are traced.
        brick_size: Voxels along a side of a brick, without the border.
        border: Voxels around a brick; with 1 or more no seam shows.
        loading: straight: directly to the wanted level; levels: level by level.
        order: coarse or fine: which levels are served first.
        load_budget: Most bricks made in a frame; never more than 256 MB of them.
        subdivide_budget: Most node tiles made in a frame.
        time_budget: Most milliseconds of production in a frame; None: no limit.
        scout_rounds: Most passes of scouts, each at most a sixteenth of the rays, before a picture
            while something is missing.
        patience: Seconds until an answer that does not come is given up.
        coarse_share: Share of the brick slots that also hold coarse channels, if there are any;
            the finest level is left with the others.
        strict: Whether to raise when something can't be produced.
        monitor: Whether to time the stages and remember the last frames, for `report`.
    """

    node_pool: int | str = "8 MB"
    brick_pool: int | str = "256 MB"
    device: torch.device | str = "cpu"
    brick_size: int = 8
    border: int = 1
    loading: Literal["straight", "levels"] = "straight"
    order: Literal["coarse", "fine"] = "coarse"
    load_budget: int = 4096
    subdivide_budget: int = 4096
    time_budget: float | None = None
    scout_rounds: int = 2
    patience: float = 120.0
    coarse_share: float = 0.25
    strict: bool = False
    monitor: bool = True

    __repr__ = check.summary

    def __post_init__(self) -> None:
        context, time_budget = "Engine", self.time_budget
        check.one_of(context, "loading", self.loading, ("straight", "levels"))
        check.one_of(context, "order", self.order, ("coarse", "fine"))
        if time_budget is not None:
            time_budget = check.number(context, "time_budget", time_budget, low=0, open_low=True)
        vars(self).update(
            load_budget=check.integer(context, "load_budget", self.load_budget, low=1),
            subdivide_budget=check.integer(
                context, "subdivide_budget", self.subdivide_budget, low=1
            ),
            scout_rounds=check.integer(context, "scout_rounds", self.scout_rounds, low=0),
            brick_size=check.integer(context, "brick_size", self.brick_size, low=2, high=256),
            border=check.integer(context, "border", self.border, low=0, high=16),
            patience=check.number(context, "patience", self.patience, low=0, open_low=True),
            coarse_share=check.number(
                context, "coarse_share", self.coarse_share, low=0, high=1, open_low=True
            ),
            time_budget=time_budget,
        )
        for name in ("strict", "monitor"):
            check.instance(context, name, getattr(self, name), bool)


class EngineSettings(TypedDict, total=False):
    """The fields of `EngineOptions` as keyword arguments of `Engine`, for type checkers."""

    node_pool: int | str
    brick_pool: int | str
    device: torch.device | str
    brick_size: int
    border: int
    loading: Literal["straight", "levels"]
    order: Literal["coarse", "fine"]
    load_budget: int
    subdivide_budget: int
    time_budget: float | None
    scout_rounds: int
    patience: float
    coarse_share: float
    strict: bool
    monitor: bool


def make_pools(
    producers: Mapping[str, Producer], options: EngineOptions, device: torch.device
) -> tuple[NodePool, BrickPool]:
    """Makes both pools, with as many slots as their bytes hold."""
    if not producers:
        raise ValueError("Engine: scene must have at least one producer")
    channels = _all_channels(producers)
    fine = {name: channel for name, channel in channels.items() if not channel.coarse}
    if not fine:
        raise ValueError("Engine: producers must have a channel that is not coarse")
    branching = max(producer.branching for producer in producers.values())
    tile_nbytes = branching**3 * (8 + 3 * sum(channel.nbytes for channel in fine.values()))
    fine_nbytes, all_nbytes = brick_bytes(fine, options), brick_bytes(channels, options)
    roots, coarse = len(producers), 0
    if all_nbytes > fine_nbytes:
        pool_nbytes = check.nbytes("Engine", "brick_pool", options.brick_pool)
        mean_nbytes = fine_nbytes + options.coarse_share * (all_nbytes - fine_nbytes)
        coarse = int(options.coarse_share * pool_nbytes / mean_nbytes)
        # At least one slot is left for bricks of the finest level.
        coarse = max(roots + 1, min(coarse, (pool_nbytes - fine_nbytes) // all_nbytes))
    coarse_nbytes = coarse * (all_nbytes - fine_nbytes)
    tiles = _count_slots("node_pool", options.node_pool, tile_nbytes, roots + 1 + branching)
    bricks = _count_slots(
        "brick_pool", options.brick_pool, fine_nbytes, max(roots, coarse) + 1, coarse_nbytes
    )
    parts = {
        "node_pool": tiles * tile_nbytes,
        "brick_pool": bricks * fine_nbytes + coarse_nbytes,
        "their bookkeeping": tiles * (_TILE_BYTES + 2 * branching**3) + bricks * _BRICK_BYTES,
    }
    _check_memory(parts, sum(producer.host_bytes for producer in producers.values()), device)
    nodes = NodePool(tiles, channels, branching=branching, device=device)
    shape = {"brick_size": options.brick_size, "border": options.border, "coarse": coarse}
    return nodes, BrickPool(bricks, channels, **shape, device=device)


def _check_memory(parts: dict[str, int], cache_nbytes: int, device: torch.device) -> None:
    """Raises ValueError if the device lacks memory for the pools, whose `parts` take these bytes,
    or the host for the producers' caches.
    """
    host_parts = {"host caches": cache_nbytes}
    needs = [(device, parts), (torch.device("cpu"), host_parts)]
    if device.type == "cpu":
        needs = [(device, parts | host_parts)]
    for memory_device, needed in needs:
        cuda = memory_device.type == "cuda"
        free = torch.cuda.mem_get_info(memory_device)[0] if cuda else memory_free()
        if sum(needed.values()) > free:
            listing = ", ".join(f"{name} {amount(size)}" for name, size in needed.items() if size)
            total = amount(sum(needed.values()))
            has = f"{memory_device} has {amount(free)} free"
            raise ValueError(f"Engine: {listing} take {total}, {has}")


def _count_slots(
    name: str, pool_size: int | str, slot_nbytes: int, min_count: int, coarse_nbytes: int = 0
) -> int:
    """Returns how many slots fit into a pool's bytes, less those set aside for coarse channels."""
    size = check.nbytes("Engine", name, pool_size)
    count = max(0, size - coarse_nbytes) // slot_nbytes
    if count < min_count:
        beside = f" beside {coarse_nbytes} bytes for coarse channels" if coarse_nbytes else ""
        raise ValueError(
            f"Engine: {name} of {size} bytes holds {count} slots of {slot_nbytes} bytes{beside}, "
            f"at least {min_count} are needed ({min_count * slot_nbytes + coarse_nbytes} bytes)"
        )
    return count


def _all_channels(producers: Mapping[str, Producer]) -> dict[str, Channel]:
    """Returns the channels of all producers, which must agree on those that they share."""
    channels: dict[str, Channel] = {}
    for name, producer in producers.items():
        check.instance("Engine", f"tree {name!r}", producer, Producer)
        if "channels" not in vars(producer):
            kind = type(producer).__name__
            raise ValueError(f"Engine: {kind}.__init__ must call super().__init__(extent, ...)")
        for channel_name, channel in producer.channels.items():
            if channels.setdefault(channel_name, channel) != channel:
                raise ValueError(
                    f"Engine: trees disagree on channel {channel_name!r}: "
                    f"{channels[channel_name]} and {channel}"
                )
    return channels


def brick_bytes(channels: Mapping[str, Channel], options: EngineOptions) -> int:
    """Returns the bytes of a brick's voxels, its border and all channels counted."""
    side = options.brick_size + 2 * options.border
    return side**3 * sum(channel.nbytes for channel in channels.values())


def make_tree(
    cache: Cache, options: EngineOptions, scene: dict[str, Layout], name: str, producer: Producer
) -> ProducedTree:
    """Makes a tree with its root node, which is never given away, and adds it to the `scene`."""
    nodes = cache.nodes
    device = nodes.child_tn.device
    layout = Layout.of(producer, options.brick_size, options.border, device)
    number, layout = len(scene), replace(layout, scene=scene)
    scene[name] = layout
    if producer.layout is not None:
        raise ValueError(
            f"Engine: the producer of tree {name!r} serves another engine, or another tree of this "
            "one: close that engine, or make another producer"
        )
    producer.to(device)
    producer.prepare(layout)
    tree = N3Tree(
        *(nodes, cache.bricks),
        depth=layout.depth,
        extent=producer.extent,
        spacing=producer.spacing,
        origin=producer.origin,
        root=number * nodes.nodes_per_tile,
        branching=producer.branching,
        value_range=producer.value_range,
        labels=producer.labels,
    )
    tree.made_of = dict(producer.made_of)
    cache.aliases.trees[number] = tree
    nodes.child_tn[number], nodes.brick_tn[number] = TERMINAL, EMPTY
    nodes.tree_t[number] = number
    if any(channel.coarse for channel in producer.channels.values()):
        cache.finest[number] = layout.depth
    source = ProducedTree(name, tree, producer, layout, options.patience)
    try:
        fill_root(cache, source)
    except BaseException:  # Ctrl-C as well
        producer.close()
        raise
    producer.layout = layout  # it serves this engine now
    return source


def fill_root(cache: Cache, source: ProducedTree) -> None:
    """Writes the root's content into its slots, which are reserved for it. Raises `ProductionError`
    if the producer fails.
    """
    try:
        _fill_root(cache, source)
    except Exception as error:
        raise ProductionError(
            f"Engine: the root of tree {source.name!r} can't be made: {reason(error)}"
        ) from error


def _fill_root(cache: Cache, source: ProducedTree) -> None:
    nodes, index, producer = cache.nodes, source.tree.root, source.producer
    tile = index // nodes.nodes_per_tile
    loc = torch.zeros((1, 4), dtype=torch.int64, device=nodes.child_tn.device)
    root = Nodes(loc, source.layout, coarse=bool(cache.finest[tile] > 0))
    regions = checked_regions(source.wait(source.ask(REQUEST_SUBDIVIDE, root)), root, producer)
    raise_first(regions.errors)
    for channel, stored in nodes.ranges.items():
        unknown = cache.bricks.channels[channel].unknown_range(1, device=stored.device)
        movable(stored)[tile, 0] = movable(regions.ranges.get(channel, unknown))[0]
    kind, constants = Region(int(regions.kind[0])), regions.constants
    if kind in (Region.DATA, Region.DATA_MAX_DEPTH):
        bricks = checked_bricks(source.wait(source.ask(REQUEST_LOAD, root)), root, producer)
        raise_first(bricks.errors)
        brick_kind = kind if bricks.kind is None else Region(int(bricks.kind[0]))
        if brick_kind not in (Region.DATA, Region.DATA_MAX_DEPTH):
            kind, constants = brick_kind, bricks.constants
    if kind == Region.ALIAS:
        raise ValueError("the root can't be an ALIAS")
    for channel, tensor in constants.items():
        movable(nodes.constants[channel])[tile, 0] = movable(tensor)[0]
    if kind in (Region.EMPTY, Region.CONSTANT):
        nodes.brick_tn.view(-1)[index] = EMPTY if kind == Region.EMPTY else CONSTANT
        return
    if source.layout.depth > 0 and kind != Region.DATA_MAX_DEPTH:
        nodes.child_tn.view(-1)[index] = ABSENT
    slot = torch.tensor([tile], device=root.loc.device)
    write_slots(cache, slot, slot * nodes.nodes_per_tile, bricks.data)


def make_recorded_frame(
    production: Production, batch: int, fit: bool
) -> DeviceFrame | HostFrame | None:
    """Returns the recorded frame of these producers; None where they answer neither all on the
    device nor all from the host, have coarse channels, or need parents' bricks on the host.
    """
    producers = [source.producer for source in production.trees.values()]
    if any(channel.coarse for producer in producers for channel in producer.channels.values()):
        return None
    if all(producer.on_device for producer in producers):
        return DeviceFrame(production, batch, fit)
    if all(producer.on_host and not producer.needs_parent for producer in producers):
        return HostFrame(production, batch, fit)
    return None
