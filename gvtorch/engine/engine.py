"""`Engine`: renders scenes larger than memory, streaming what the rays request. `Engine.frame` is
the method as one call per stage; steps.py defines the stages.

Source: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and
Detailed Voxel Rendering", I3D 2009; Crassin, PhD thesis 2011.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from functools import cached_property, partial, wraps
from typing import Any, Literal, TypeVar, Unpack, cast

from torch import Tensor

from ..base import check
from ..base.explicit import explicit
from ..base.lasting import lasting
from ..base.records import Hits, Rays
from ..base.stage import Progress, check_progress, no_progress
from ..cameras import Camera
from ..cameras.custom import as_camera
from ..io.http import retry_refused
from ..pictures import Picture
from ..shaders.shader import Shader
from ..tracing import RenderOptions
from ..tracing.options import RenderSettings, render_options
from ..tracing.pixels import Again, View, empty_hits
from ..tracing.trees import Shaders, box_around, overlaps, tree_traces
from .frame_graph import FrameGraph
from .host_frame import HostFrame
from .production import Failure
from .ray_subsets import RaySubsets
from .setup import EngineOptions, EngineSettings, make_recorded_frame
from .stats import FrameStats, Report
from .steps import FrameSteps, Scene

_Method = TypeVar("_Method", bound=Callable[..., Any])


def _locked(method: _Method) -> _Method:
    """Lets a method of an engine run in one thread at a time."""

    @wraps(method)
    def run(self: FrameSteps, *args: Any, **kwargs: Any) -> Any:
        with self.lock:
            return method(self, *args, **kwargs)

    return cast("_Method", run)


class Engine(FrameSteps):
    """A scene of one or more trees in one pair of pools.

    Several threads may use an engine: they take turns, a picture at a time. A thread that does not
    render must hold `lock` to look at the pools. Producers are called by the thread that renders,
    and by one further thread for each captured frame; they must not render with the engine
    themselves, nor wait for a thread that does.

    Attributes:
        lock: Held while a picture is rendered (`threading.RLock`).
        options: The options that it was made with.
        trees: Trees and their producers, by name.
        cache: Pools, order of use and requests.
        scheduler: Chooses which requests are served.
        production: Serves requests; knows the answers on their way and the nodes that failed.
        readbacks: The frames whose counts are on their way to the host.
        frames: Number of the last picture.
    """

    @explicit(EngineOptions)
    def __init__(self, scene: Scene, **options: Unpack[EngineSettings]) -> None:
        """Allocates the pools and makes the root of every tree.

        Args:
            scene: A producer, or one for each tree by name.
            **options: Fields of `EngineOptions`.

        Raises:
            ValueError: An option is unknown or out of its range, the pools are too small for the
                roots, or producers do not agree on a channel.
            ProductionError: A root can't be produced.
        """
        check.known_options("Engine", options, EngineSettings)
        super().__init__(scene, EngineOptions(**options))

    @explicit(RenderOptions)
    @_locked
    def frame(
        self,
        camera: Camera | Rays,
        shader: Shaders,
        *,
        progress: Progress = no_progress,
        **options: Unpack[RenderSettings],
    ) -> tuple[Picture, FrameStats]:
        """Produces what the last picture missed, then renders a picture from what is in the pools.

        While something is missing, a few rays (scouts) are traced before the picture, so that the
        tree grows by more than a level a frame (`EngineOptions.scout_rounds`), and the host waits
        for them. Otherwise, on CUDA, it does not wait: the device may still render when this
        returns.

        Args:
            camera: One camera or a batch; an orbit camera is placed around the scene's box. Or rays
                in world units; see `gvtorch.render`.
            shader: The transfer function or another shader, or one for each tree by name.
            progress: Called with the number of rows of pixels that are done.
            **options: Fields of `RenderOptions`.

        Returns:
            The picture, complete but perhaps coarse, and its statistics. `stats.converged` is true
            if nothing was missing.

        Raises:
            ValueError: An argument is of the wrong type or out of its range.
            ProductionError: A node can't be produced, and the engine is strict.
        """
        check_progress("frame", progress)
        view = self.view("frame", camera, shader, options)
        with self.new_frame(view.options) as stats:
            self.serve_last_frame(stats)  # choose requests, produce, take slots, write, link
            self.scout(view, stats)  # the same for a few rays that are traced first
            hits = self.trace(view, progress)  # camera to rays to hits; rays mark use and requests
            collected = self.collect_requests_and_use(hits.samples)
            self.read_back(stats, hits, collected)  # for the next frame to serve
        return view.picture(hits, stats), stats

    def view(
        self, context: str, camera: Camera | Rays, shader: Shaders, options: RenderSettings
    ) -> View:
        """Checks the arguments of `frame`, and returns its view. Errors begin with `context`."""
        camera = as_camera(context, camera)
        chosen = render_options(context, options, camera)
        scene = {name: (s.tree, s.producer.channels) for name, s in self.trees.items()}
        by_level, frame_1 = self.production.by_level, self.cache.frame_1
        trees = tree_traces(context, scene, shader, chosen, by_level=by_level, frame_1=frame_1)
        return View.of(camera, trees, chosen)

    @explicit(RenderOptions)
    @_locked
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
            mode: interactive: one frame, as `frame` renders it; balanced: at most `productions`
                frames, of which the last is shown; converge: until no ray misses anything that can
                be served. Where the pools are too small for all rays, subsets are traced one after
                the other, so the pools need only hold what one ray needs and, on the way there, the
                coarser bricks that stand in for it.
            productions: Most frames of a balanced picture.
            max_frames: Most frames of a converged picture; `stats.converged` is false if they were
                too few.
            progress: Called with the number of rays of a converging picture that are done.
            **options: Fields of `RenderOptions`.

        Returns:
            The picture. Its `stats` are those of the last frame, except that times, produced,
            evicted and uploaded bytes are sums over all frames, and used tiles and bricks the
            maximum of one frame. `capacity_exceeded` of a converging picture: rays had to be traced
            in subsets.

        Raises:
            ValueError: The mode is unknown, or see `frame`.
            ProductionError: See `frame`.
        """
        check_progress("render", progress)
        check.integer("render", "productions", productions, low=1)
        check.integer("render", "max_frames", max_frames, low=1)
        check.one_of("render", "mode", mode, ("interactive", "balanced", "converge"))
        if mode == "interactive":
            return self.frame(camera, shader, **options)[0]
        view = self.view("render", camera, shader, options)
        if mode == "balanced":
            return view.picture(*self._balance(view, productions))
        return view.picture(*self._converge(view, max_frames, progress))

    def _balance(self, view: View, max_frames: int) -> tuple[Hits, FrameStats]:
        """Renders at most `max_frames` frames, until one has converged."""
        total = FrameStats()
        for frame_count in range(1, max_frames + 1):
            hits, stats = self._served_frame(view)
            total = stats.following(total)
            if stats.converged:
                break
            if stats.pending and frame_count < max_frames:  # at most as long as a frame takes
                self.production.wait(limit=stats.milliseconds / 1e3)
        total.frames = frame_count
        return hits, total

    def _converge(self, view: View, max_frames: int, progress: Progress) -> tuple[Hits, FrameStats]:
        """Renders at most `max_frames` frames, each with rays that still miss something."""
        missed, scouts_first = self._missed, max_frames > 1
        if missed is not None and len(missed) == view.ray_count:
            # If no ray missed anything, this picture will hardly miss anything.
            scouts_first = scouts_first and bool(missed.any())
        count, width = view.ray_count, view.camera.width
        subsets = RaySubsets(count, width, self.device, scouts_first=scouts_first)
        total, again = FrameStats(), None
        if scouts_first:
            again = empty_hits(self.device, view.options.dtype, count), subsets.next
        for frame_count in range(1, max_frames + 1):
            hits, stats = self._served_frame(view, again)
            subsets.update(hits.missed, stats, total.failed)
            total = stats.following(total)
            if frame_count == max_frames - 1:
                subsets.trace_all()
            progress("rays", subsets.done, subsets.count)
            if subsets.over:
                break
            if stats.pending:  # more answers are worth the time of a pass
                self.production.wait(stats.milliseconds / 1e3)
            again = hits, subsets.next
        total.converged, total.capacity_exceeded = subsets.complete, subsets.crowded
        total.frames = frame_count
        return hits, total

    def _served_frame(self, view: View, again: Again | None = None) -> tuple[Hits, FrameStats]:
        """Runs the stages of `frame`, for rays `again` if given; then serves its own requests."""
        with self.new_frame(view.options) as stats:
            self.serve_last_frame(stats)
            if again is None:
                self.scout(view, stats)
            hits = self.trace(view, again=again)
            self.read_back(stats, hits, self.collect_requests_and_use(hits.samples))
            self.serve_last_frame(stats, wait=True)
        return hits, stats

    @explicit(RenderOptions)
    @_locked
    @lasting
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
        tensors at the addresses that they have now. Where all producers are `on_device`, or all
        `on_host`, a replay also serves what earlier replays missed.

        Args:
            camera: Cameras of the number, size and model that replays will have.
            shader: For all trees, or one for each; no `ModuleShader`.
            batch: Most bricks that a replay makes, and most node tiles of each level. This limits
                each tree if producers are `on_host`, and all trees together if they are
                `on_device`; only these may deepen a tree by several levels in a replay.
            look_ahead: While the camera moves, a replay also requests what the picture this many
                frames later will miss if the motion continues, with a sixteenth of the picture's
                rays. The picture's own requests are served first. 0: no look-ahead.
            fit: While the pools can't hold what a view uses and requests, cones are widened so that
                it is drawn at levels that fit (`FrameStats.coarser` is the factor). Otherwise nodes
                that find no slot are requested again in every frame, and drawn from far ancestors.
            **options: Fields of `RenderOptions`.

        Raises:
            ValueError: The engine is not on CUDA, the layer is on another device, a shader is a
                module, trees overlap, replays do not serve but should `fit` or `look_ahead`, or see
                `frame`.
            ProductionError: See `frame`.
        """
        shaders = shader.values() if isinstance(shader, Mapping) else (shader,)
        if any(isinstance(each, Shader) and each.uses_torch for each in shaders):
            raise ValueError(
                "Engine.capture: a ModuleShader can't be recorded: the host waits for its results"
            )
        if self.device.type != "cuda":
            raise ValueError(f"Engine.capture: the engine must be on CUDA, it is on {self.device}")
        view = self.view("capture", camera, shader, options)
        if overlaps(view.trees):
            raise ValueError(
                "Engine.capture: trees that overlap can't be recorded: the host waits for them"
            )
        if view.options.layer is not None:
            view.options.layer.check_device(self.device)
        batch = check.integer("capture", "batch", batch, low=1, high=1 << 18)
        look_ahead = check.number("capture", "look_ahead", look_ahead, low=0, high=1000)
        check.instance("capture", "fit", fit, bool)
        render_frame = partial(self.frame, shader=shader, **options)
        render_frame(camera)  # warm-up before recording
        recorded = make_recorded_frame(self.production, batch, fit)
        if recorded is None and (fit or look_ahead):
            raise ValueError(
                f"Engine.capture: {'fit' if fit else 'look_ahead'} needs replays that serve: all "
                "producers on_device, or all on_host, without coarse channels"
            )
        graph = FrameGraph(self, view, recorded, render_frame, look_ahead)
        if isinstance(recorded, HostFrame):
            recorded.graph = weakref.ref(graph)
            self._host_frames.append(recorded)
        return graph

    @cached_property
    def box(self) -> Tensor:
        """(2, 3) float64 world corners around all trees, without any pose."""
        return box_around([source.tree.box for source in self.trees.values()])

    @property
    def failures(self) -> list[Failure]:
        """The newest nodes that could not be produced, at most 1000; `stats.failed` counts all."""
        return list(self.production.failures.newest)

    @_locked
    def forget_failures(self) -> None:
        """Lets failed nodes be requested again, and files that servers refused be read again."""
        retry_refused()
        self.production.failures.forget()
        self._restore_pending()

    def memory(self) -> dict[str, int]:
        """Returns bytes by name: content of each pool, and bookkeeping."""
        return self.cache.memory()

    @_locked
    def report(self) -> Report:
        """Returns times and rates of the last frames: print it, or `as_dict()` for JSON."""
        tiles, bricks = self.cache.nodes.parent_t, self.cache.bricks.owner_b
        slots = {"tiles": tiles, "bricks": bricks}
        occupancy = {name: float((owner >= 0).float().mean()) for name, owner in slots.items()}
        return Report(tuple(self._recent_stats), occupancy, self.memory())

    @_locked
    def validate(self) -> None:
        """Raises ValueError unless the pools are consistent: see `N3Tree` and `Cache`."""
        for source in self.trees.values():
            source.tree.validate()
        self.cache.validate()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def __reduce__(self) -> Any:
        hint = "make one in each process, of the producer, which can be pickled"
        raise TypeError(f"Engine: it can't be copied or pickled: {hint}")

    def __repr__(self) -> str:
        return f"Engine({', '.join(self.trees)} on {self.device}, {self.frames} frames)"
