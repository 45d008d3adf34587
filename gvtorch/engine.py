"""`Engine`: scenes larger than memory, streamed by what the rays ask for. `Engine.frame` is the
whole method on one page; everything else here sets it up and repeats it.

Source: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and
Detailed Voxel Rendering", I3D 2009; Crassin, PhD thesis 2011.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from . import check
from .cache import KINDS, Cache, Scheduler
from .config import ABSENT, CONSTANT, EMPTY, TERMINAL
from .frame import FrameStats, Hits, Rays
from .ops.trace import choose_backend
from .pool import BrickPool, Channel, N3Tree, NodePool
from .producers import Nodes, Producer, Region
from .producers.answer import checked_bricks, checked_regions, layout_of
from .production import Failure, Plant, Production, ProductionError
from .rendering import Camera, Picture, RenderOptions, TransferFunction
from .rendering.renderer import (
    Tracer,
    check_type,
    composite_trees,
    develop,
    render_options,
    trace_camera,
)
from .report import Report
from .stage import Progress, collect_timings, no_progress, stage
from .turns import Turns
from .volume import movable

Scene = Producer | Mapping[str, Producer]
Shaders = TransferFunction | Mapping[str, TransferFunction]

_LISTED = 1 << 17  # most nodes with a wish that one frame lists
_PAYLOAD = 256 * 10**6  # most bytes of voxels produced in one frame


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
        for name in ("strict", "monitor"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"Engine: {name} must be bool, got {getattr(self, name)!r}")


class Engine:
    """A scene of one or more trees in one pair of pools.

    Attributes:
        options: How it was made.
        cache: Pools and order of use.
        production: What is on its way, and what failed.
        plants: Trees and their producers, by name.
    """

    def __init__(self, scene: Scene, **options: Any) -> None:
        """Takes the memory and makes the root of every tree.

        Args:
            scene: A producer, or one for each tree by name.
            **options: Fields of `EngineOptions`.

        Raises:
            ValueError: An option is unknown or out of its range, the pools are too small for the
                roots, or producers do not agree on a channel.
            ProductionError: A root can't be produced.
        """
        unknown = sorted(set(options) - set(EngineOptions.__dataclass_fields__))
        if unknown:
            known = ", ".join(EngineOptions.__dataclass_fields__)
            raise ValueError(f"Engine: unknown option {unknown[0]!r}; known: {known}")
        self.options = EngineOptions(**options)
        self.device = _device(self.options.device)
        producers = dict(scene) if isinstance(scene, Mapping) else {"scene": scene}
        nodes, bricks = _pools(producers, self.options, self.device)
        self.cache = Cache(nodes, bricks, len(producers))
        brick_bytes = _brick_bytes(bricks.channels, self.options)
        scheduler = Scheduler(
            order=self.options.order,
            loads=min(self.options.load_budget, max(1, _PAYLOAD // brick_bytes)),
            subdivisions=self.options.subdivide_budget,
            milliseconds=self.options.time_budget,
        )
        self.scheduler = scheduler
        self.production = Production(
            self.cache, scheduler, self.options.patience, self.options.strict
        )
        self.frames, self._closed = 0, False
        self._frame_1 = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._report = Report()
        self.plants: dict[str, Plant] = {}
        try:
            for number, (name, producer) in enumerate(producers.items()):
                self.plants[name] = self._plant(number, name, producer)
        except Exception:
            self.close()
            raise

    def frame(
        self,
        camera: Camera,
        shader: Shaders,
        *,
        progress: Progress = no_progress,
        **options: Any,
    ) -> tuple[Picture, FrameStats]:
        """Renders one picture from what is there, then produces what it missed.

        Args:
            camera: One camera or a batch; an orbit camera stands around the scene's box.
            shader: The transfer function, or one for each tree by name.
            progress: Told how many rays are done.
            **options: Fields of `RenderOptions`.

        Returns:
            The picture, complete but perhaps coarse, and what it cost. `stats.converged` tells
            that nothing was missing.

        Raises:
            ValueError: An argument is of the wrong type or out of its range.
            ProductionError: A node can't be produced, and the engine is strict.
        """
        chosen = render_options("frame", camera, options)
        hits, stats = self._pass(camera, shader, chosen, progress)
        return develop(hits, camera, chosen.background, stats), stats

    def _pass(
        self,
        camera: Camera,
        shader: Shaders,
        chosen: RenderOptions,
        progress: Progress,
        again: tuple[Hits, Tensor] | None = None,
    ) -> tuple[Hits, FrameStats]:
        """One frame: what `frame` does, for all rays or for some of them once more."""
        start = time.perf_counter()
        stats = self._begin(chosen)
        timer = collect_timings() if self.options.monitor else nullcontext(stats.stages)
        with self._unbroken(), timer as timings:
            with stage("write"):
                self.production.write(self.production.late(), stats)
            trace = self._tracer(shader, chosen)
            world, device = camera.placed(self.box), self.device
            hits = trace_camera(world, device, trace, chosen.dtype, progress, again=again)  # 1, 2
            with stage("requests"):
                wishes = self.cache.requests(min(_LISTED, self.cache.nodes.child_tn.numel()))  # 3
            with stage("lru"):
                self.cache.sort_by_use(self._frame_1)  # 4
            with stage("schedule"):
                room = self._room()
                served, deferred, exceeded = self.scheduler.choose(wishes, room)  # 5
                if exceeded:
                    coarser = self.cache.stand_ins(wishes, room)
                    served, deferred, _ = self.scheduler.choose(coarser, room)
            late = sum(self.production.pending.values())
            with stage("produce"):
                answers = self.production.ask([*self.plants.values()], served)  # 6
            with stage("write"):
                self.production.write(answers, stats)  # 7
            with stage("count"):
                self._count(stats, hits, wishes)
        stats.deferred, stats.capacity_exceeded = deferred, stats.capacity_exceeded or exceeded
        stats.converged = not (len(wishes) or wishes.overflow or late)
        stats.stages = dict(timings)
        stats.milliseconds = 1e3 * (time.perf_counter() - start)
        if self.options.monitor:
            self._report.add(stats)
        self.production.raise_if_strict()
        return hits, stats

    def render(
        self,
        camera: Camera,
        shader: Shaders,
        mode: Literal["interactive", "balanced", "converge"] = "converge",
        *,
        productions: int = 4,
        max_frames: int = 1000,
        progress: Progress = no_progress,
        **options: Any,
    ) -> Picture:
        """Renders a picture over one or more frames.

        Args:
            camera: See `frame`.
            shader: See `frame`.
            mode: interactive: one frame; balanced: `productions` frames, of which the last is
                shown; converge: until no ray misses anything that can be served. Rays that miss
                nothing are done; where the pools are too small for all rays, groups of them take
                turns, so that pools that hold what one ray needs, and the coarser bricks that
                stand in for it on the way, give the whole picture.
            productions: Frames of a balanced picture.
            max_frames: Most frames of a converged picture; `stats.converged` tells whether they
                were enough.
            progress: Told how many rays of a converging picture are done.
            **options: Fields of `RenderOptions`.

        Returns:
            The picture; its `stats` add up milliseconds, produced, evicted and bytes over all
            frames, tell the most tiles and bricks that one frame used, and else the last frame.
            `capacity_exceeded` tells that rays had to take turns, or that some got nothing.

        Raises:
            ValueError: The mode is unknown, or see `frame`.
            ProductionError: See `frame`.
        """
        most = _most_frames(mode, productions, max_frames)
        chosen = render_options("render", camera, options)
        count = len(camera) * camera.height * camera.width
        turns = Turns(count, camera.width, self.device)
        total, hits = FrameStats(), None
        for number in range(1, most + 1):
            again = (hits, turns.now) if mode == "converge" and hits is not None else None
            hits, stats = self._pass(camera, shader, chosen, no_progress, again)
            _add_up(total, stats)
            if mode == "converge":
                turns.take(hits.missed, stats, total.failed)
                if number == most - 1:
                    turns.everyone()
                progress("rays", turns.done, turns.count)
                if turns.over:
                    break
                if stats.pending:  # another pass would not see more; it may take as long as one
                    self.production.wait(stats.milliseconds / 1e3)
            elif stats.converged:
                break
            elif stats.pending and number < most:  # as long as another frame would take
                self.production.wait(limit=stats.milliseconds / 1e3)
            total.failed = stats.failed
        assert hits is not None
        if mode == "converge":
            total.converged, total.capacity_exceeded = turns.whole, turns.crowded
        else:
            total.converged = stats.converged
            total.capacity_exceeded = stats.capacity_exceeded
        total.frames, total.rays = number, turns.count
        total.samples = int(hits.samples.sum(dtype=torch.int64))
        summed = {name: getattr(total, name) for name in _SUMMED}
        return develop(hits, camera, chosen.background, dataclasses.replace(stats, **summed))

    @property
    def box(self) -> Tensor:
        """(2, 3) float64 world corners around all trees."""
        boxes = torch.stack([plant.tree.box for plant in self.plants.values()])
        return torch.stack((boxes[:, 0].amin(0), boxes[:, 1].amax(0)))

    @property
    def failures(self) -> list[Failure]:
        """The last nodes that could not be produced, by name; `stats.failed` counts all."""
        return list(self.production.failures)

    def forget_failures(self) -> None:
        """Lets nodes that could not be produced be asked for again."""
        self.production.forget_failures()

    def memory(self) -> dict[str, int]:
        """Returns bytes: what the pools hold, and the bookkeeping apart."""
        nodes, bricks = self.cache.nodes, self.cache.bricks
        content = (
            nodes.child_tn,
            nodes.brick_tn,
            *nodes.constants.values(),
            *nodes.ranges.values(),
        )
        node_bytes = sum(tensor.nbytes for tensor in content)
        brick_bytes = sum(tensor.nbytes for tensor in bricks.bricks.values())
        order = sum(lru.order.nbytes for lru in self.cache.lru.values())
        return {
            "node_pool": node_bytes,
            "brick_pool": brick_bytes,
            "bookkeeping": nodes.nbytes + bricks.nbytes - node_bytes - brick_bytes + order,
        }

    def report(self) -> Report:
        """Returns what the last frames took: print it, or `as_dict()` for JSON."""
        self._report.occupancy = {
            "tiles": float((self.cache.nodes.parent_t >= 0).float().mean()),
            "bricks": float((self.cache.bricks.owner_b >= 0).float().mean()),
        }
        self._report.memory = self.memory()
        return self._report

    def validate(self) -> None:
        """Raises ValueError unless the pools are in order: see `N3Tree` and `Cache`."""
        for plant in self.plants.values():
            plant.tree.validate()
        self.cache.validate()

    def close(self) -> None:
        """Lets go of what is on its way, and of the producers' files and threads."""
        self._closed = True
        self.production.close()
        for plant in self.plants.values():
            plant.producer.close()
            plant.producer.layout = None

    def __enter__(self) -> Engine:
        """Returns itself; leaving the block closes it."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Closes it."""
        self.close()

    @contextmanager
    def _unbroken(self) -> Iterator[None]:
        """Leaves nothing marked as on its way that is not, whatever breaks a frame off."""
        try:
            yield
        except BaseException:
            self.production.mark_anew()
            raise

    def _begin(self, options: RenderOptions) -> FrameStats:
        """Counts the frame up: what is stamped with its number is in use."""
        if self._closed:
            raise ValueError("Engine: it is closed")
        self.frames += 1
        self._frame_1.fill_(self.frames)
        for plant in self.plants.values():
            plant.tree.frame = self.frames
        backend = choose_backend(options.backend, self.device)
        return FrameStats(frame=self.frames, backend=backend)

    def _tracer(self, shader: Shaders, options: RenderOptions) -> Callable[[Rays], Hits]:
        tracers = []
        for name, plant in self.plants.items():
            one: Any = shader.get(name) if isinstance(shader, Mapping) else shader
            check_type("frame", f"shader of tree {name!r}", one, TransferFunction)
            known = plant.producer.channels
            channel = options.channel or next(iter(known))
            if channel not in known:
                raise ValueError(
                    f"frame: tree {name!r} has no channel {channel!r}; it has {', '.join(known)}"
                )
            tracers.append(
                Tracer(
                    plant.tree,
                    one,
                    dataclasses.replace(options, channel=channel),
                    by_level=self.options.loading == "levels",
                )
            )
        if len(tracers) == 1:
            return tracers[0]
        return lambda rays: composite_trees(tracers, rays)

    def _room(self) -> dict[int, int]:
        pending = self.production.pending
        return {kind: max(0, n - pending[kind]) for kind, n in self.cache.room().items()}

    def _count(self, stats: FrameStats, hits: Hits, wishes: Any) -> None:
        nodes, bricks = self.cache.nodes, self.cache.bricks
        stats.rays = hits.alpha.shape[0]
        stats.samples = int(hits.samples.sum(dtype=torch.int64))
        stats.nodes, stats.bricks = nodes.child_tn.numel(), bricks.capacity
        stats.bytes = nodes.nbytes + bricks.nbytes
        stats.tiles_used = int((nodes.stamp_t == self.frames).sum())
        stats.bricks_used = int((bricks.stamp_b == self.frames).sum())
        stats.requests = {name: int((wishes.kind == kind).sum()) for name, kind in KINDS.items()}
        stats.misses, stats.overflow = wishes.misses, wishes.overflow
        stats.pending = sum(self.production.pending.values())
        stats.failed = self.production.failed

    def _plant(self, number: int, name: str, producer: Producer) -> Plant:
        """Makes a tree with its root node, which stays for ever."""
        options, nodes, bricks = self.options, self.cache.nodes, self.cache.bricks
        depth = 0
        while options.brick_size * producer.branching**depth < max(producer.extent):
            depth += 1
        layout = layout_of(producer, depth, options.brick_size, options.border, self.device)
        if producer.layout is not None:
            raise ValueError(
                f"Engine: the producer of tree {name!r} serves another engine: "
                "close that one, or make another producer"
            )
        producer.to(self.device)
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
        root = Nodes(torch.zeros((1, 4), dtype=torch.int64, device=self.device), layout)
        try:
            self._fill_root(plant, root)
        except Exception as error:
            producer.close()
            reason = str(error) or type(error).__name__
            raise ProductionError(
                f"Engine: the root of tree {name!r} can't be made: {reason}"
            ) from error
        producer.layout = layout  # it serves this engine now
        return plant

    def _fill_root(self, plant: Plant, root: Nodes) -> None:
        nodes, index = self.cache.nodes, plant.tree.root
        number = index // nodes.nodes_per_tile
        regions = checked_regions(self._now(plant.producer.classify(root)), root, plant.producer)
        _raise_first(regions.errors)
        for channel, tensor in regions.ranges.items():
            movable(nodes.ranges[channel])[number, 0] = movable(tensor)[0]
        kind, constants = Region(int(regions.kind[0])), regions.constants
        if kind in (Region.DATA, Region.DATA_MAX_DEPTH):
            bricks = checked_bricks(self._now(plant.producer.fill(root)), root, plant.producer)
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
        slot = torch.tensor([number], dtype=torch.int32, device=self.device)
        self.cache.put_bricks(slot, slot.to(torch.int64) * nodes.nodes_per_tile, bricks.data)
        if plant.layout.depth > 0 and kind != Region.DATA_MAX_DEPTH:
            nodes.child_tn.view(-1)[index] = ABSENT

    def _now(self, answer: Any) -> Any:
        return answer.result(self.options.patience) if hasattr(answer, "result") else answer


def _most_frames(mode: str, productions: int, max_frames: int) -> int:
    check.whole("render", "productions", productions, low=1)
    check.whole("render", "max_frames", max_frames, low=1)
    limits = {"interactive": 1, "balanced": productions, "converge": max_frames}
    if mode not in limits:
        raise ValueError(
            f"render: mode must be 'interactive', 'balanced' or 'converge', got {mode!r}"
        )
    return limits[mode]


def _device(device: torch.device | str) -> torch.device:
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError):
        raise ValueError(f"Engine: device must name a device, got {device!r}") from None
    if found.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("Engine: device 'cuda' can't be used here: torch sees no CUDA device")
    return found


def _raise_first(errors: Mapping[int, str]) -> None:
    for message in errors.values():
        raise ValueError(message)


def _pools(
    producers: Mapping[str, Producer], options: EngineOptions, device: torch.device
) -> tuple[NodePool, BrickPool]:
    """Makes both pools, of as many slots as their bytes hold."""
    channels: dict[str, Channel] = {}
    if not producers:
        raise ValueError("Engine: scene must have at least one producer")
    for name, producer in producers.items():
        check_type("Engine", f"tree {name!r}", producer, Producer)
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
        ("brick_pool", _brick_bytes(channels, options)),
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


def _brick_bytes(channels: Mapping[str, Channel], options: EngineOptions) -> int:
    where = "Engine"
    size = check.whole(where, "brick_size", options.brick_size, low=2, high=256)
    border = check.whole(where, "border", options.border, low=0, high=16)
    return (size + 2 * border) ** 3 * sum(channel.nbytes for channel in channels.values())


_SUMMED = (
    *("frames", "milliseconds", "stages", "rays", "samples", "tiles_used", "bricks_used"),
    *("produced", "evicted", "bytes_uploaded", "converged", "capacity_exceeded"),
)


def _add_up(total: FrameStats, stats: FrameStats) -> None:
    total.milliseconds += stats.milliseconds
    total.bytes_uploaded += stats.bytes_uploaded
    total.tiles_used = max(total.tiles_used, stats.tiles_used)
    total.bricks_used = max(total.bricks_used, stats.bricks_used)
    for name in ("stages", "produced", "evicted"):
        sums = getattr(total, name)
        for key, value in getattr(stats, name).items():
            sums[key] = sums.get(key, 0) + value
