"""`Engine`: scenes larger than memory, streamed by what the rays ask for. `Engine.frame` is the
method, stage by stage; the stages follow it.

Source: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and
Detailed Voxel Rendering", I3D 2009; Crassin, PhD thesis 2011.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import cached_property, partial, wraps
from typing import Any, Literal, TypeVar, Unpack, cast

import torch
from torch import Tensor

from ..base import check
from ..base.explicit import explicit
from ..base.records import Hits, Rays, add
from ..base.stage import Progress, collect_timings, mark, milliseconds, no_progress, stage
from ..cache import Cache, RequestList, Scheduler
from ..cameras import Camera
from ..cameras.custom import as_camera
from ..io.http import ask_again
from ..ops.trace import choose_backend
from ..pictures import Picture
from ..producers import Layout, Producer
from ..shaders.shader import Shader
from ..tracing import RenderOptions
from ..tracing.options import RenderSettings, render_options
from ..tracing.pixels import Again, View, empty_hits
from ..tracing.trees import (
    Shaders,
    TreeTrace,
    box_around,
    overlaps,
    trace_trees,
    tree_traces,
)
from .frame_graph import FrameGraph
from .host_frame import HostFrame
from .production import Failure, Production
from .ray_subsets import RaySubsets, scouts
from .renewal import renew_tree
from .setup import (
    EngineOptions,
    EngineSettings,
    brick_bytes,
    make_pools,
    make_recorded_frame,
    make_tree,
)
from .stats import Collected, Counts, FrameStats, Readback, Readbacks, Report

Scene = Producer | Mapping[str, Producer]

_MOST_LISTED = 1 << 17  # nodes whose requests one frame lists
_KEPT = 1000  # frames in a report
_MOST_PRODUCED = 256 * 10**6  # bytes of voxels produced in one frame
_Method = TypeVar("_Method", bound=Callable[..., Any])


def _alone(method: _Method) -> _Method:
    """Lets a method of an engine run in one thread at a time."""

    @wraps(method)
    def run(self: Engine, *given: Any, **named: Any) -> Any:
        with self.lock:
            return method(self, *given, **named)

    return cast("_Method", run)


class Engine:
    """A scene of one or more trees in one pair of pools.

    Several threads may use an engine: they take turns, a picture at a time. To look at its pools
    from another thread than the one that renders, hold `lock`. Producers are asked by the thread
    that renders, and by one of its own for each captured frame; they must not render with the
    engine themselves, nor wait for a thread that does.

    Attributes:
        lock: Held while a picture is rendered (`threading.RLock`).
        options: How it was made.
        trees: Trees and their producers, by name.
        cache: Pools, order of use and requests.
        scheduler: Which requests are served.
        production: Serves requests; what is on its way, and what failed.
        readbacks: The frames whose counts are on their way to the host.
        frames: Number of the last picture.
    """

    @explicit(EngineOptions)
    def __init__(self, scene: Scene, **options: Unpack[EngineSettings]) -> None:
        """Takes the memory and makes the root of every tree.

        Args:
            scene: A producer, or one for each tree by name.
            **options: Fields of `EngineOptions`.

        Raises:
            ValueError: An option is unknown or out of its range, the pools are too small for the
                roots, or producers do not agree on a channel.
            ProductionError: A root can't be produced.
        """
        check.known("Engine", options, EngineSettings)
        self.options, self.lock = EngineOptions(**options), threading.RLock()
        self._rendering = False
        self.device = check.device("Engine", self.options.device)
        producers = dict(scene) if isinstance(scene, Mapping) else {"scene": scene}
        for name in producers:
            check.instance("Engine", "name of a tree", name, str)
        nodes, bricks = make_pools(producers, self.options, self.device)
        self.cache = Cache(nodes, bricks, len(producers))
        most_loads = max(1, _MOST_PRODUCED // brick_bytes(bricks.channels, self.options))
        self.scheduler = Scheduler(
            order=self.options.order,
            loads=min(self.options.load_budget, most_loads),
            subdivisions=self.options.subdivide_budget,
            milliseconds=self.options.time_budget,
        )
        by_level = self.options.loading == "levels"
        self.production = Production(self.cache, self.scheduler, by_level, self.options.strict)
        self.trees = self.production.trees
        self.readbacks = Readbacks()
        self.frames, self._closed = 0, False
        self._missed: Tensor | None = None  # (r,) bool, of the last picture's rays
        self._last: deque[FrameStats] = deque(maxlen=_KEPT)  # for the report
        self._versions: dict[str, int] = {}  # of what they hold
        self.recorded: list[HostFrame] = []  # what producers on the host serve, without this frame
        try:
            layouts: dict[str, Layout] = {}
            for name, producer in producers.items():
                self.trees[name] = make_tree(self.cache, self.options, layouts, name, producer)
                self._versions[name] = producer.version
        except Exception:
            self.close()
            raise

    @explicit(RenderOptions)
    @_alone
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
        on CUDA, the host does not wait: the picture is on its way when this returns.

        Args:
            camera: One camera or a batch; an orbit camera stands around the scene's box. Or rays in
                world units; see `gvtorch.render`.
            shader: The transfer function or another shader, or one for each tree by name.
            progress: Told how many rows of pixels are done.
            **options: Fields of `RenderOptions`.

        Returns:
            The picture, complete but perhaps coarse, and what it cost. `stats.converged` tells
            that nothing was missing.

        Raises:
            ValueError: An argument is of the wrong type or out of its range.
            ProductionError: A node can't be produced, and the engine is strict.
        """
        view = self.view("frame", camera, shader, options)
        with self.new_frame(view.options) as stats:
            self.serve_last_frame(stats)  # choose requests, produce, take slots, write, link
            self.scout(view, stats)  # the same for a few rays that go ahead
            hits = self.trace(view, progress)  # camera to rays to hits; rays mark use and requests
            collected = self.collect_requests_and_use(hits.samples)
            self.read_back(stats, hits, collected)  # for the next frame to serve
        return view.picture(hits, stats), stats

    def view(
        self, where: str, camera: Camera | Rays, shader: Shaders, options: RenderSettings
    ) -> View:
        """Checks what a frame is to show; see `frame`. Errors begin with `where`."""
        camera = as_camera(where, camera)
        chosen = render_options(where, options, camera)
        trees = {name: source.tree for name, source in self.trees.items()}
        box = box_around(where, trees, chosen.pose)
        placed, trace = camera.placed(box), partial(trace_trees, self._tracers(shader, chosen, box))
        return View(placed, placed.numbers(self.device), trace, chosen, box)

    def _tracers(self, shaders: Shaders, options: RenderOptions, box: Tensor) -> list[TreeTrace]:
        """What traces rays through each tree of a scene, given its (2, 3) box."""
        scene = {name: (one.tree, one.producer.channels) for name, one in self.trees.items()}
        by_level, frame_1 = self.production.by_level, self.cache.frame_1
        return tree_traces(
            "frame", scene, shaders, options, box, by_level=by_level, frame_1=frame_1
        )

    @contextmanager
    def new_frame(self, options: RenderOptions) -> Iterator[FrameStats]:
        """Keeps the statistics of the frame that the block renders; the block has the engine for
        itself. If it raises, only what is on its way stays marked as pending.
        """
        with self.lock:
            if self._closed:
                raise ValueError("Engine: it is closed")
            if self._rendering:
                raise RuntimeError("Engine: a frame within a frame: a producer or progress renders")
            self._rendering = True
            try:
                yield from self._new_frame(options)
            finally:
                self._rendering = False

    def _new_frame(self, options: RenderOptions) -> Iterator[FrameStats]:
        stats = FrameStats(
            frame=self.frames + 1,
            backend=choose_backend(options.backend, self.device),
            pending=sum(self.production.pending.values()),
            failed=len(self.production.failures),
        )
        monitor, start = self.options.monitor, mark(self.device)
        try:
            with collect_timings(self.device) if monitor else nullcontext() as timings:
                yield stats
        except BaseException:
            self.production.restore_pending()
            raise
        end = mark(self.device)

        def complete() -> None:
            stats.milliseconds += milliseconds(start, end)
            if timings is not None:
                add(stats.stages, timings.as_dict())

        stats.later(complete)
        if monitor:
            self._last.append(stats)
        self.production.failures.raise_if_strict()

    def serve_last_frame(self, stats: FrameStats, wait: bool = False) -> None:
        """Serves the requests of the last frame and writes answers that came late.

        If the last frame's counts have not arrived, nothing is served now: rays ask again for what
        they still miss. The host waits for the counts only if an earlier frame is known to have
        requests, if an answer is due, if the host is too far ahead, or if `wait` is true.
        """
        self.renew()
        self.release()
        last = self.readbacks.catch_up(wait or self.production.due)
        if self.readbacks:
            return
        if last is not None:  # nothing was written since it was traced: its nodes are still there
            self.scheduler.begin()
            self.production.serve(last.requests, last.wait(), stats)
        with stage("write"):
            self.production.write(self.production.late(), stats)

    def renew(self) -> None:
        """Drops the nodes and bricks that producers say have changed (`Producer.changed`), and
        makes the roots of their trees anew; the host waits for that. The next frames make the rest.
        """
        changed = [s for n, s in self.trees.items() if s.producer.version != self._versions[n]]
        if not changed:
            return
        self.release()
        self.readbacks.catch_up(wait=True)  # what they list is no longer asked for
        for source in changed:
            self.production.forget(source)
            since, producer = self._versions[source.name], source.producer
            renew_tree(self.cache, source, producer.changes(since))
            self._versions[source.name] = producer.version
        self._missed = None

    def release(self, but: HostFrame | None = None) -> None:
        """Lets captured frames, `but` one, forget what is on its way to them."""
        for one in self.recorded:
            if one is not but:
                one.release()

    def scout(self, view: View, stats: FrameStats) -> None:
        """Sends rays ahead of the picture: while answers are written at once, some of those that
        missed something are traced again, and what they miss next is served within this frame.

        They have the frame number of the last picture: no slot is given away that it or they used,
        or that was written since. What is too much for budgets or pools is left to the whole
        picture.
        """
        written, hits = 0, None
        for _ in range(self.options.scout_rounds):
            if sum(stats.produced.values()) == written or stats.capacity_exceeded:
                break  # there is nothing more to see, or no room for it
            written = sum(stats.produced.values())
            if hits is None:
                hits = empty_hits(self.device, view.options.dtype, view.rays)
                if self._missed is not None and len(self._missed) == view.rays:
                    hits.missed.copy_(self._missed)
            view.hits(again=(hits, scouts(hits.missed, view.camera.width)))
            collected = self.collect_requests_and_use(hits.samples[:0])
            counts = Counts(*collected.numbers.tolist())  # what misses something waits anyway
            add(stats.requests, counts.by_kind())
            self.production.serve(collected.requests, counts, stats)

    def trace(
        self, view: View, progress: Progress = no_progress, again: Again | None = None
    ) -> Hits:
        """Traces a picture's rays, all or some of them again, under a frame number of its own."""
        self.number_picture()
        return view.hits(progress, again=again)

    def number_picture(self, on_device: bool = True) -> None:
        """Gives the next picture its number: what rays stamp with it is in use. The device is told
        unless it counts for itself.
        """
        self.frames += 1
        if on_device:
            self.cache.frame_1.fill_(self.frames)
        for source in self.trees.values():
            source.tree.frame = self.frames

    def collect_requests_and_use(self, samples: Tensor) -> Collected:
        """Takes the requests of a traced frame, brings the slots into the order of use, and counts
        both and the sum of (r,) samples; all stays on the device.
        """
        with stage("requests"):
            most = min(_MOST_LISTED, self.cache.nodes.child_tn.numel())
            requests = RequestList.collect(self.cache, most)
        with stage("lru"):
            use = self.cache.sort_by_use()
        with stage("count"):
            total = samples.sum(dtype=torch.int64).view(1)
            return Collected(requests, torch.cat((requests.count, use, total)))

    def read_back(self, stats: FrameStats, hits: Hits, collected: Collected) -> None:
        """Sends a frame's counts to the host; until they are here no slot may be taken."""
        nodes, bricks = self.cache.nodes, self.cache.bricks
        stats.nodes, stats.bricks = nodes.child_tn.numel(), bricks.capacity
        stats.rays, stats.bytes = len(hits.missed), nodes.nbytes + bricks.nbytes
        self._missed = hits.missed
        self.cache.make_room(0, 0)
        self.readbacks.append(Readback(stats, collected, self.readbacks))

    @explicit(RenderOptions)
    @_alone
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
        """Renders a picture over one or more frames; camera, shader and options as in `frame`.

        Args:
            camera: One camera, a batch, or rays.
            shader: For all trees, or one for each.
            mode: interactive: one frame, as `frame` gives it; balanced: `productions` frames, of
                which the last is shown; converge: until no ray misses anything that can be served.
                Where the pools are too small for all rays, subsets are traced one after the other,
                so the pools need only hold what one ray needs and the coarser bricks that stand in
                for it on the way.
            productions: Frames of a balanced picture.
            max_frames: Most frames of a converged picture; `stats.converged` tells whether they
                were enough.
            progress: Told how many rays of a converging picture are done.
            **options: Fields of `RenderOptions`.

        Returns:
            The picture; its `stats` are those of the last frame, but milliseconds, produced,
            evicted and bytes are sums over all frames, and tiles and bricks the most that one frame
            used. `capacity_exceeded` tells that rays had to be traced in subsets, or that some got
            nothing.

        Raises:
            ValueError: The mode is unknown, or see `frame`.
            ProductionError: See `frame`.
        """
        check.whole("render", "productions", productions, low=1)
        check.whole("render", "max_frames", max_frames, low=1)
        check.one_of("render", "mode", mode, ("interactive", "balanced", "converge"))
        if mode == "interactive":
            return self.frame(camera, shader, **options)[0]
        view = self.view("render", camera, shader, options)
        if mode == "balanced":
            return view.picture(*self._balance(view, productions))
        return view.picture(*self._converge(view, max_frames, progress))

    def _balance(self, view: View, most: int) -> tuple[Hits, FrameStats]:
        """Renders at most `most` frames, until one has converged."""
        total = FrameStats()
        for number in range(1, most + 1):
            hits, stats = self._served_frame(view)
            total = stats.following(total)
            if stats.converged:
                break
            if stats.pending and number < most:  # as long as another frame would take
                self.production.wait(limit=stats.milliseconds / 1e3)
        total.frames = number
        return hits, total

    def _converge(self, view: View, most: int, progress: Progress) -> tuple[Hits, FrameStats]:
        """Renders at most `most` frames, each of the rays that still miss something."""
        last, ahead = self._missed, most > 1
        if last is not None and len(last) == view.rays:
            ahead = ahead and bool(last.any())  # else this picture will hardly miss anything
        subsets = RaySubsets(view.rays, view.camera.width, self.device, ahead=ahead)
        total, again = FrameStats(), None
        if ahead:
            again = empty_hits(self.device, view.options.dtype, view.rays), subsets.next
        for number in range(1, most + 1):
            hits, stats = self._served_frame(view, again)
            subsets.update(hits.missed, stats, total.failed)
            total = stats.following(total)
            if number == most - 1:
                subsets.trace_all()
            progress("rays", subsets.done, subsets.count)
            if subsets.over:
                break
            if stats.pending:  # another pass would not see more; it may take as long as one
                self.production.wait(stats.milliseconds / 1e3)
            again = hits, subsets.next
        total.converged, total.capacity_exceeded = subsets.whole, subsets.crowded
        total.frames = number
        return hits, total

    def _served_frame(self, view: View, again: Again | None = None) -> tuple[Hits, FrameStats]:
        """A frame whose own requests are served before it ends."""
        with self.new_frame(view.options) as stats:
            self.serve_last_frame(stats)
            if again is None:
                self.scout(view, stats)
            hits = self.trace(view, again=again)
            self.read_back(stats, hits, self.collect_requests_and_use(hits.samples))
            self.serve_last_frame(stats, wait=True)
        return hits, stats

    @explicit(RenderOptions)
    @_alone
    def capture(
        self,
        camera: Camera | Rays,
        shader: Shaders,
        *,
        batch: int = 512,
        look_ahead: float = 0,
        fit: bool = False,
        **options: Unpack[RenderSettings],
    ) -> FrameGraph:
        """Records a frame as a CUDA graph, for cameras of this number and size.

        Renders a frame first, as `frame` does with the same arguments. A replay reads the layer's
        tensors where they lie. Where all producers are `on_device`, or all `on_host`, a replay also
        serves what the ones before missed.

        Args:
            camera: Cameras as those of the replays.
            shader: For all trees, or one for each; no `ModuleShader`.
            batch: Most bricks that a replay makes, and most node tiles of each level, for each
                tree. Where producers are `on_device`, a tree may deepen by several levels.
            look_ahead: While the camera moves, a replay also asks for what its picture so many
                frames on will miss, as far as the motion tells, by a sixteenth of the picture's
                rays. This is served behind what the picture itself missed. 0: only what is missed.
            fit: While the pools can't hold what a view uses and asks for, pixels count as wider, so
                that it is drawn at levels that fit (`FrameStats.coarser` tells how much); else what
                finds no slot is asked for again in every frame, and drawn from far above.
            **options: Fields of `RenderOptions`.

        Raises:
            ValueError: The engine is on no CUDA device, the layer is on another, a shader is a
                module, replays do not serve but should `fit`, or see `frame`.
            ProductionError: See `frame`.
        """
        shaders = shader.values() if isinstance(shader, Mapping) else (shader,)
        if any(isinstance(one, Shader) and one.uses_torch for one in shaders):
            raise ValueError(
                "Engine.capture: a ModuleShader can't be recorded: the host waits in it"
            )
        if self.device.type != "cuda":
            raise ValueError(f"Engine.capture: the engine must be on CUDA, it is on {self.device}")
        view = self.view("capture", camera, shader, options)
        if overlaps(self._tracers(shader, view.options, view.box)):
            raise ValueError(
                "Engine.capture: trees that overlap can't be recorded: the host waits for them"
            )
        if view.options.layer is not None:
            view.options.layer.check_device(self.device)
        check.whole("capture", "batch", batch, low=1, high=1 << 18)
        check.number("capture", "look_ahead", look_ahead, low=0, high=1000)
        check.instance("capture", "fit", fit, bool)
        again = partial(self.frame, shader=shader, **options)
        again(camera)  # loads what is loaded at first use
        served = make_recorded_frame(self.production, batch, fit)
        if fit and served is None:
            raise ValueError(
                "Engine.capture: fit needs replays that serve: all producers on_device, or all "
                "on_host, without coarse channels"
            )
        if isinstance(served, HostFrame):
            self.recorded.append(served)
        return FrameGraph(self, view, served, again, look_ahead)

    @property
    def steady(self) -> bool:
        """True if the newest frame read back missed nothing; does not block."""
        return self.readbacks.steady

    @property
    def changed(self) -> bool:
        """Whether a producer has told of another content since it was last asked."""
        return any(one.producer.version != self._versions[n] for n, one in self.trees.items())

    @cached_property
    def box(self) -> Tensor:
        """(2, 3) float64 world corners around all trees, where no pose turns them."""
        return box_around("Engine", {name: source.tree for name, source in self.trees.items()})

    @property
    def failures(self) -> list[Failure]:
        """The last nodes that could not be produced, by name; `stats.failed` counts all."""
        return list(self.production.failures.newest)

    @_alone
    def forget_failures(self) -> None:
        """Lets nodes that could not be produced be asked for again, and servers for their parts."""
        ask_again()
        self.production.failures.forget()
        self.production.restore_pending()

    def memory(self) -> dict[str, int]:
        """Returns bytes: what the pools hold, and the bookkeeping apart."""
        return self.cache.memory()

    @_alone
    def report(self) -> Report:
        """Returns what the last frames took: print it, or `as_dict()` for JSON."""
        tiles, bricks = self.cache.nodes.parent_t, self.cache.bricks.owner_b
        slots = {"tiles": tiles, "bricks": bricks}
        occupancy = {name: float((owner >= 0).float().mean()) for name, owner in slots.items()}
        return Report(self._last, occupancy, self.memory())

    @_alone
    def validate(self) -> None:
        """Raises ValueError unless the pools are in order: see `N3Tree` and `Cache`."""
        for source in self.trees.values():
            source.tree.validate()
        self.cache.validate()

    def close(self) -> None:
        """Lets go of what is on its way, and of the producers' files and threads, after the frame
        that another thread renders now.
        """
        self._closed = True  # a picture of many frames ends with this one
        with self.lock:
            for one in self.recorded:
                one.close()
            self.production.close()
            for source in self.trees.values():
                source.producer.close()
                source.producer.layout = None

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Engine({', '.join(self.trees)} on {self.device}, {self.frames} frames)"
