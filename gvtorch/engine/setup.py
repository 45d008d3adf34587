"""What an engine is made of: options, pools, and a tree with its root for every producer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch

from ..base import check
from ..base.constants import ABSENT, CONSTANT, EMPTY, TERMINAL
from ..base.volume import movable
from ..cache import Cache
from ..pool import BrickPool, Channel, N3Tree, NodePool
from ..producers import Nodes, Producer, Region
from ..producers.answer import checked_bricks, checked_regions, layout_of
from .jobs import Plant
from .production import ProductionError


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """How the engine keeps its scene."""

    node_pool: int | str = "8 MB"  # bytes of node words, constants and ranges
    brick_pool: int | str = "256 MB"  # bytes of voxels
    device: torch.device | str = "cpu"
    brick_size: int = 8  # voxels along a side, without the border
    border: int = 1  # voxels around a brick; from 1 on no seam shows
    loading: Literal["straight", "levels"] = "straight"  # to the wanted level, or one by one
    order: Literal["coarse", "fine"] = "coarse"  # which levels are served first
    load_budget: int = 4096  # most bricks a frame
    subdivide_budget: int = 4096  # most node tiles a frame
    time_budget: float | None = None  # most milliseconds of production a frame
    scout_rounds: int = 2  # rounds of a sixteenth of the rays before a frame that missed something
    patience: float = 120.0  # seconds until an answer that does not come is given up
    strict: bool = False  # raise when something can't be produced
    monitor: bool = True  # time the stages and remember the last frames, for `report`

    def __post_init__(self) -> None:
        """Checks what the pools and the scheduler do not check themselves."""
        if self.loading not in ("straight", "levels"):
            raise ValueError(
                f"Engine: loading must be 'straight' or 'levels', got {self.loading!r}"
            )
        check.number("Engine", "patience", self.patience, low=0, open_low=True)
        for name in ("load_budget", "subdivide_budget"):
            check.whole("Engine", name, getattr(self, name), low=1)
        check.whole("Engine", "scout_rounds", self.scout_rounds, low=0)
        for name in ("strict", "monitor"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"Engine: {name} must be bool, got {getattr(self, name)!r}")


def _raise_first(errors: Mapping[int, str]) -> None:
    for message in errors.values():
        raise ValueError(message)


def make_pools(
    producers: Mapping[str, Producer], options: EngineOptions, device: torch.device
) -> tuple[NodePool, BrickPool]:
    """Makes both pools, of as many slots as their bytes hold."""
    channels: dict[str, Channel] = {}
    if not producers:
        raise ValueError("Engine: scene must have at least one producer")
    for name, producer in producers.items():
        check.instance("Engine", f"tree {name!r}", producer, Producer)
        if "channels" not in vars(producer):
            kind = type(producer).__name__
            raise ValueError(f"Engine: {kind}.__init__ must call super().__init__(extent, ...)")
        for channel, what in producer.channels.items():
            if channels.setdefault(channel, what) != what:
                raise ValueError(
                    f"Engine: trees disagree on channel {channel!r}: {channels[channel]} and {what}"
                )
    branching = max(producer.branching for producer in producers.values())
    node_bytes = 8 + 3 * sum(channel.nbytes for channel in channels.values())
    roots, capacity = len(producers), {}
    for name, slot in (
        ("node_pool", branching**3 * node_bytes),
        ("brick_pool", brick_bytes(channels, options)),
    ):
        size = check.nbytes("Engine", name, getattr(options, name))
        capacity[name] = size // slot
        least = roots + 1 + (branching if name == "node_pool" else 0)
        if capacity[name] < least:
            raise ValueError(
                f"Engine: {name} of {size} bytes holds {capacity[name]} slots of {slot} bytes, "
                f"at least {least} are needed ({least * slot} bytes)"
            )
        check.memory("Engine", name, size, device)
    nodes = NodePool(capacity["node_pool"], channels, branching=branching, device=device)
    bricks = BrickPool(
        capacity["brick_pool"],
        channels,
        brick_size=options.brick_size,
        border=options.border,
        device=device,
    )
    return nodes, bricks


def brick_bytes(channels: Mapping[str, Channel], options: EngineOptions) -> int:
    """Returns the bytes of a brick's voxels, its border and all channels counted."""
    where = "Engine"
    size = check.whole(where, "brick_size", options.brick_size, low=2, high=256)
    border = check.whole(where, "border", options.border, low=0, high=16)
    return (size + 2 * border) ** 3 * sum(channel.nbytes for channel in channels.values())


def make_plant(
    cache: Cache, options: EngineOptions, number: int, name: str, producer: Producer
) -> Plant:
    """Makes a tree with its root node, which stays for ever.

    Raises:
        ValueError: The producer serves another engine.
        ProductionError: The root can't be produced.
    """
    nodes, bricks = cache.nodes, cache.bricks
    device = nodes.child_tn.device
    depth = 0
    while options.brick_size * producer.branching**depth < max(producer.extent):
        depth += 1
    layout = layout_of(producer, depth, options.brick_size, options.border, device)
    if producer.layout is not None:
        raise ValueError(
            f"Engine: the producer of tree {name!r} serves another engine: "
            "close that one, or make another producer"
        )
    producer.to(device)
    producer.prepare(layout)
    tree = N3Tree(
        *(nodes, bricks),
        depth=depth,
        extent=producer.extent,
        spacing=producer.spacing,
        origin=producer.origin,
        root=number * nodes.nodes_per_tile,
        branching=producer.branching,
        value_range=producer.value_range,
    )
    nodes.child_tn[number], nodes.brick_tn[number] = TERMINAL, EMPTY
    nodes.tree_t[number] = number
    plant = Plant(name, tree, producer, layout)
    root = Nodes(torch.zeros((1, 4), dtype=torch.int64, device=device), layout)
    try:
        _fill_root(cache, plant, root, options.patience)
    except Exception as error:
        producer.close()
        reason = str(error) or type(error).__name__
        raise ProductionError(
            f"Engine: the root of tree {name!r} can't be made: {reason}"
        ) from error
    producer.layout = layout  # it serves this engine now
    return plant


def _fill_root(cache: Cache, plant: Plant, root: Nodes, patience: float) -> None:
    nodes, index = cache.nodes, plant.tree.root
    number = index // nodes.nodes_per_tile
    answer = _now(plant.producer.classify(root), patience)
    regions = checked_regions(answer, root, plant.producer)
    _raise_first(regions.errors)
    for channel, tensor in regions.ranges.items():
        movable(nodes.ranges[channel])[number, 0] = movable(tensor)[0]
    kind, constants = Region(int(regions.kind[0])), regions.constants
    if kind in (Region.DATA, Region.DATA_MAX_DEPTH):
        answer = _now(plant.producer.fill(root), patience)
        bricks = checked_bricks(answer, root, plant.producer)
        _raise_first(bricks.errors)
        found = kind if bricks.kind is None else Region(int(bricks.kind[0]))
        if found not in (Region.DATA, Region.DATA_MAX_DEPTH):
            kind, constants = found, bricks.constants
    if kind == Region.ALIAS:
        raise ValueError("the root can't be an ALIAS")
    for channel, tensor in constants.items():
        movable(nodes.constants[channel])[number, 0] = movable(tensor)[0]
    if kind in (Region.EMPTY, Region.CONSTANT):
        nodes.brick_tn.view(-1)[index] = EMPTY if kind == Region.EMPTY else CONSTANT
        return
    slot = torch.tensor([number], dtype=torch.int32, device=root.loc.device)
    cache.put_bricks(slot, slot.to(torch.int64) * nodes.nodes_per_tile, bricks.data)
    if plant.layout.depth > 0 and kind != Region.DATA_MAX_DEPTH:
        nodes.child_tn.view(-1)[index] = ABSENT


def _now(answer: Any, patience: float) -> Any:
    return answer.result(patience) if hasattr(answer, "result") else answer
