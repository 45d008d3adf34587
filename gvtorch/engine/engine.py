"""`Engine`: scenes larger than memory, streamed by what the rays ask for. `Engine.frame` is the
whole method on one page; everything else here sets it up and repeats it.

Source: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and
Detailed Voxel Rendering", I3D 2009; Crassin, PhD thesis 2011.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import cached_property, partial
from typing import Any, Literal, Unpack

import torch
from torch import Tensor

from ..base import check
from ..base.records import FrameStats, Hits, Rays, add
from ..base.stage import Progress, collect_timings, mark, milliseconds, no_progress, stage
from ..cache import Cache, Listed, Scheduler, Wishes
from ..cameras import Camera
from ..cameras.custom import as_camera
from ..ops.trace import choose_backend
from ..pictures import Picture
from ..producers import Producer
from ..shaders.fused import Shader
from ..tracing import ModuleShader, RenderOptions
from ..tracing.around import around
from ..tracing.composite import Trace, trace_trees
from ..tracing.options import RenderSettings, render_options
from ..tracing.pixels import develop, empty_hits, trace_camera
from ..tracing.tracer import AnyShader, check_shader, tracer_of
from .jobs import Plant
from .production import Failure, Production
from .readback import Arrivals, Numbers
from .report import Report
from .setup import EngineOptions, brick_bytes, make_plant, make_pools
from .turns import Turns, scouts

Scene = Producer | Mapping[str, Producer]
Shaders = AnyShader | Mapping[str, AnyShader]
_View = tuple[Camera, torch.device, Trace, RenderOptions]  # of `trace_camera`

_LISTED = 1 << 17  # most nodes with a wish that one frame lists
_PAYLOAD = 256 * 10**6  # most bytes of voxels produced in one frame


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
        self.device = check.device("Engine", self.options.device)
        producers = dict(scene) if isinstance(scene, Mapping) else {"scene": scene}
        nodes, bricks = make_pools(producers, self.options, self.device)
        self.cache = Cache(nodes, bricks, len(producers))
        most_loads = max(1, _PAYLOAD // brick_bytes(bricks.channels, self.options))
        scheduler = Scheduler(
            order=self.options.order,
            loads=min(self.options.load_budget, most_loads),
            subdivisions=self.options.subdivide_budget,
            milliseconds=self.options.time_budget,
        )
        self.scheduler = scheduler
        self.production = Production(
            self.cache, scheduler, self.options.patience, self.options.strict
        )
        self.frames, self._closed = 0, False
        self._frame_1 = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._arrivals = Arrivals()
        self._missed: Tensor | None = None  # (r,) bool, of the last picture's rays
        self._report = Report()
        self.plants: dict[str, Plant] = {}
        try:
            for number, (name, producer) in enumerate(producers.items()):
                self.plants[name] = make_plant(self.cache, self.options, number, name, producer)
        except Exception:
            self.close()
            raise

    def frame(
        self,
        camera: Camera | Rays,
        shader: Shaders,
        *,
        progress: Progress = no_progress,
        **options: Unpack[RenderSettings],
    ) -> tuple[Picture, FrameStats]:
        """Produces what the last picture missed, then renders one from what is there.

        While something is missing, a few rays go ahead of the picture, so that the tree grows by
        more than a level a frame (`EngineOptions.scout_rounds`), and the host waits for them. Else,
        on CUDA, nobody waits for the device: the picture is on its way when this returns.

        Args:
            camera: One camera or a batch; an orbit camera stands around the scene's box. Or rays in
                world units; see `gvtorch.render`.
            shader: The transfer function or another shader, or one for each tree by name.
            progress: Told how many rays are done.
            **options: Fields of `RenderOptions`.

        Returns:
            The picture, complete but perhaps coarse, and what it cost. `stats.converged` tells
            that nothing was missing.

        Raises:
            ValueError: An argument is of the wrong type or out of its range.
            ProductionError: A node can't be produced, and the engine is strict.
        """
        camera = as_camera("frame", camera).placed(self.box)
        chosen = render_options("frame", options, camera)
        hits, stats = self._pass(camera, shader, chosen, progress)
        return develop(hits, camera, chosen, stats), stats

    def _pass(
        self,
        camera: Camera,
        shader: Shaders,
        chosen: RenderOptions,
        progress: Progress,
        again: tuple[Hits, Tensor] | None = None,
    ) -> tuple[Hits, FrameStats]:
        """One frame: what `frame` does, for all rays or for some of them once more."""
        stats = self._begin(chosen)
        with self._unbroken(), self._timed(stats):
            self._catch_up(stats)  # 1, 2, 3, 4
            trace = self._tracer(shader, chosen)
            view = camera, self.device, trace, chosen
            numbers = camera.numbers(self.device)
            if again is None:
                self._scout(view, numbers, stats)
            self._count_up()
            hits = trace_camera(*view, progress, again=again, numbers=numbers)  # 5, 6
            self._send(stats, hits, *self._collect(hits.samples))  # 7, 8
        if self.options.monitor:
            self._report.add(stats)
        self.production.raise_if_strict()
        return hits, stats

    def _catch_up(self, stats: FrameStats, wait: bool = False) -> None:
        """Serves what the last frame missed and writes the answers that came, once its counts are
        here. Where they are not, the frame goes on without, unless an earlier one is known to have
        missed something, an answer is due, or the host is too far ahead.
        """
        last = self._arrivals.catch_up(wait or self.production.due)
        if not self._arrivals:
            if last is not None:
                self.cache.make_room(last.numbers.tiles_unused, last.numbers.bricks_unused)
                self.scheduler.begin()
                if last.numbers.listed:
                    # Nothing was written since it was traced: its nodes are those that rays saw.
                    wishes = last.listed.read(self.cache.nodes, last.numbers.wishes())
                    self._serve(wishes, stats)
            with stage("write"):
                self.production.write(self.production.late(), stats)

    def _scout(self, view: _View, numbers: Tensor, stats: FrameStats) -> None:
        """Sends rays ahead of the picture: while answers are written at once, some of those that
        missed something are traced again, and what they miss next is served within this frame.

        They count as rays of the last picture: what any of these used, and what was written since,
        stays. What is too much for budgets or pools is left to the whole picture.
        """
        camera, written = view[0], 0
        count = len(camera) * camera.height * camera.width
        hits = None
        for _ in range(self.options.scout_rounds):
            if sum(stats.produced.values()) == written or stats.capacity_exceeded:
                break  # there is nothing more to see, or no room for it
            written = sum(stats.produced.values())
            if hits is None:
                hits = empty_hits(self.device, view[-1].dtype, count)
                if self._missed is not None and len(self._missed) == count:
                    hits.missed.copy_(self._missed)
                else:  # a picture of another size
                    hits.missed.fill_(True)
            where = scouts(hits.missed, camera.width)
            trace_camera(*view, no_progress, again=(hits, where), numbers=numbers)
            listed, sent = self._collect(hits.samples[:0])
            counts = Numbers(*sent.tolist())  # a frame that misses something waits anyway
            add(stats.requests, counts.wishes())
            self.cache.make_room(counts.tiles_unused, counts.bricks_unused)
            self._serve(listed.read(self.cache.nodes, counts.wishes()), stats)

    def _serve(self, wishes: Wishes, stats: FrameStats) -> None:
        """Chooses wishes, asks for them, and writes the answers that are here at once."""
        with stage("schedule"):
            pending = self.production.pending
            room = {kind: max(0, n - pending[kind]) for kind, n in self.cache.room().items()}
            served, deferred, exceeded = self.scheduler.choose(wishes, room)
            if exceeded:
                coarser = self.cache.stand_ins(wishes, room)
                served, deferred, _ = self.scheduler.choose(coarser, room)
            stats.deferred += deferred
            stats.capacity_exceeded |= exceeded
        with stage("produce"):
            answers = self.production.ask([*self.plants.values()], served)
        with stage("write"):
            self.production.write(answers, stats)

    def _collect(self, samples: Tensor) -> tuple[Listed, Tensor]:
        """What a traced frame leaves on the device: the wishes, and (10,) int64 `Numbers`, the
        sum of (r,) samples among them.
        """
        with stage("requests"):
            listed = self.cache.requests(min(_LISTED, self.cache.nodes.child_tn.numel()))
        with stage("lru"):
            use = self.cache.sort_by_use(self._frame_1)
        with stage("count"):
            total = samples.sum(dtype=torch.int64).view(1)
            return listed, torch.cat((listed.count, use, total))

    def _send(self, stats: FrameStats, hits: Hits, listed: Listed, numbers: Tensor) -> None:
        """Sends a frame's counts to the host; until they are here no slot may be taken."""
        nodes, bricks = self.cache.nodes, self.cache.bricks
        stats.nodes, stats.bricks = nodes.child_tn.numel(), bricks.capacity
        stats.rays, stats.bytes = len(hits.missed), nodes.nbytes + bricks.nbytes
        self._missed = hits.missed
        self.cache.make_room(0, 0)
        self._arrivals.send(stats, listed, numbers)

    @contextmanager
    def _timed(self, stats: FrameStats) -> Iterator[None]:
        """Adds the time of a block to a frame's; of each stage, too, if the engine is monitored."""
        start = mark(self.device)
        with collect_timings(self.device) if self.options.monitor else nullcontext() as timings:
            yield
        end = mark(self.device)

        def arrive() -> None:
            stats.milliseconds += milliseconds(start, end)
            if timings is not None:
                add(stats.stages, timings.as_dict())

        stats.later(arrive)

    def render(
        self,
        camera: Camera | Rays,
        shader: Shaders,
        mode: Literal["interactive", "balanced", "converge"] = "converge",
        *,
        productions: int = 4,
        max_frames: int = 1000,
        progress: Progress = no_progress,
        **options: Unpack[RenderSettings],
    ) -> Picture:
        """Renders a picture over one or more frames.

        Args:
            camera: See `frame`.
            shader: See `frame`.
            mode: interactive: one frame, as `frame` gives it; balanced: `productions` frames, of
                which the last is shown; converge: until no ray misses anything that can be served.
                Rays that miss nothing are done; where the pools are too small for all rays, groups
                of them take turns, so that pools that hold what one ray needs, and the coarser
                bricks that stand in for it on the way, give the whole picture.
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
        camera = as_camera("render", camera).placed(self.box)
        chosen = render_options("render", options, camera)
        if mode == "interactive":
            return self.frame(camera, shader, **options)[0]
        count = len(camera) * camera.height * camera.width
        turns = Turns(count, camera.width, self.device)
        total, hits = FrameStats(), None
        for number in range(1, most + 1):
            again = (hits, turns.now) if mode == "converge" and hits is not None else None
            hits, stats = self._pass(camera, shader, chosen, no_progress, again)
            with self._unbroken(), self._timed(stats):
                self._catch_up(stats, wait=True)
            self.production.raise_if_strict()
            total.add(stats)
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
        stats = stats.of_picture(total)
        return develop(hits, camera, chosen, stats)

    def capture(
        self, camera: Camera | Rays, shader: Shaders, **options: Unpack[RenderSettings]
    ) -> FrameGraph:
        """Records a frame as a CUDA graph, for cameras of this number and size.

        Renders a frame first, as `frame` does.

        Args:
            camera: See `frame`.
            shader: See `frame`.
            **options: Fields of `RenderOptions`; a replay reads the layer's tensors where they
                lie.

        Raises:
            ValueError: The engine is on no CUDA device, the layer is on another, a shader is a
                module, or see `frame`.
            ProductionError: See `frame`.
        """
        shaders = shader.values() if isinstance(shader, Mapping) else (shader,)
        if any(isinstance(one, ModuleShader) for one in shaders):
            raise ValueError(
                "Engine.capture: a ModuleShader can't be recorded: the host waits in it"
            )
        if self.device.type != "cuda":
            raise ValueError(f"Engine.capture: the engine must be on CUDA, it is on {self.device}")
        camera = as_camera("capture", camera)
        chosen = render_options("capture", options, camera)
        if chosen.layer is not None:
            chosen.layer.check_device("capture", self.device)
        self.frame(camera, shader, **vars(chosen))  # loads what is loaded at first use
        return FrameGraph(self, camera, shader, chosen)

    @property
    def steady(self) -> bool:
        """Whether the last frame whose counts are here missed nothing; nobody waits."""
        return self._arrivals.steady

    @cached_property
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
        return self.cache.memory()

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
        """The statistics of the next frame."""
        if self._closed:
            raise ValueError("Engine: it is closed")
        return FrameStats(
            frame=self.frames + 1,
            backend=choose_backend(options.backend, self.device),
            pending=sum(self.production.pending.values()),
            failed=self.production.failed,
        )

    def _count_up(self) -> None:
        """Starts a picture: what is stamped with its number is in use."""
        self.frames += 1
        self.cache.frame = self.frames
        self._frame_1.fill_(self.frames)
        for plant in self.plants.values():
            plant.tree.frame = self.frames

    def _tracer(self, shader: Shaders, options: RenderOptions) -> Trace:
        box, trees = self.box, []
        for name, plant in self.plants.items():
            one: Any = shader.get(name) if isinstance(shader, Mapping) else shader
            if not isinstance(one, ModuleShader):
                check_shader("frame", f"shader of tree {name!r}", one)
            known = plant.producer.channels
            channel = options.channel or next(iter(known))
            for needed in (channel, *(one.channels if isinstance(one, Shader) else ())):
                if needed not in known:
                    raise ValueError(
                        f"frame: tree {name!r} has no channel {needed!r}; it has {', '.join(known)}"
                    )
            chosen = dataclasses.replace(options, channel=channel)
            by_level = self.options.loading == "levels"
            frame = {"by_level": by_level, "frame_1": self._frame_1}
            tracer = tracer_of(plant.tree, one, chosen, **frame)
            trees.append((plant.tree.box, around(tracer, chosen, box)))
        return partial(trace_trees, trees)


class FrameGraph:
    """A frame as one CUDA graph, which costs the host a single call. `Engine.capture` makes it.

    A replay is the frame that `Engine.frame` would render, but it produces nothing. Where the
    engine is not steady any more, something was missed or an answer is on its way, and
    `Engine.frame` goes on until it is::

        render = graph.replay if engine.steady else partial(engine.frame, shader=shader)
        picture, stats = render(camera)
    """

    def __init__(
        self, engine: Engine, camera: Camera, shader: Shaders, options: RenderOptions
    ) -> None:
        """Records the frame; see `Engine.capture`."""
        self._engine, self._options = engine, options
        self._camera = camera.placed(engine.box)
        self._numbers = self._camera.numbers(engine.device).clone()  # a replay's camera goes here
        self._trace = engine._tracer(shader, options)
        self._graph = torch.cuda.CUDAGraph()
        with (
            torch.cuda.device(engine.device),
            torch.cuda.graph(self._graph, capture_error_mode="thread_local"),
        ):
            hits = trace_camera(
                *(self._camera, engine.device, self._trace, options, no_progress),
                numbers=self._numbers,
            )
            self._hits, self._left = hits, engine._collect(hits.samples)
            self._picture = develop(hits, self._camera, options, FrameStats(), self._numbers)

    def replay(self, camera: Camera | Rays) -> tuple[Picture, FrameStats]:
        """Renders a frame; nobody waits for the device.

        Args:
            camera: As many cameras of the same size as were captured.

        Returns:
            The picture, which the next replay overwrites, and what it cost; see `Engine.frame`.

        Raises:
            ValueError: The camera differs in number or size, or the engine is closed.
        """
        camera = as_camera("replay", camera)
        form, own = camera.form, self._camera.form
        if form != own:
            raise ValueError(
                f"replay: camera must be {own[0]} of {own[2]}x{own[1]} pixels as captured "
                f"({own[4]}), got {form[0]} of {form[2]}x{form[1]} ({form[4]})"
            )
        engine = self._engine
        stats = engine._begin(self._options)
        with torch.cuda.device(engine.device), engine._timed(stats):
            engine._count_up()
            self._numbers.copy_(camera.placed(engine.box).numbers(engine.device))
            with stage("replay"):
                self._graph.replay()
            engine._send(stats, self._hits, *self._left)
        while engine._arrivals.crowded:
            engine._arrivals.take()
        if engine.options.monitor:
            engine._report.add(stats)
        return dataclasses.replace(self._picture, stats=stats), stats


def _most_frames(mode: str, productions: int, max_frames: int) -> int:
    check.whole("render", "productions", productions, low=1)
    check.whole("render", "max_frames", max_frames, low=1)
    limits = {"interactive": 1, "balanced": productions, "converge": max_frames}
    if mode not in limits:
        raise ValueError(
            f"render: mode must be 'interactive', 'balanced' or 'converge', got {mode!r}"
        )
    return limits[mode]
