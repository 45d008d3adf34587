"""`FrameSteps`: the steps of a frame, from which `Engine.frame` and captured frames are made."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext

import torch
from torch import Tensor

from ..base import check
from ..base.lasting import in_transform, lasting
from ..base.records import Hits, add
from ..base.stage import Progress, collect_timings, mark, milliseconds, no_progress, stage
from ..cache import Cache, RequestList, Scheduler
from ..ops.registry import choose_backend
from ..producers import Layout, Producer
from ..tracing import RenderOptions
from ..tracing.pixels import Again, View, empty_hits
from .host_frame import HostFrame
from .production import Production
from .ray_subsets import scouts
from .recorded import RecordedFrame
from .renewal import renew_tree
from .request_batch import ProducedTree
from .setup import EngineOptions, brick_bytes, make_pools, make_tree
from .stats import Collected, Counts, FrameStats, Readback, Readbacks

Scene = Producer | Mapping[str, Producer]

_MAX_LISTED_NODES = 1 << 17  # most nodes whose requests one frame lists
_REPORTED_FRAMES = 1000  # most frames in a report
_MAX_PRODUCED_BYTES = 256 * 10**6  # most bytes of voxels produced in one frame


class FrameSteps:
    """The state of an engine, and the steps of its frames; see `Engine`, which documents both."""

    @lasting
    def __init__(self, scene: Scene, options: EngineOptions) -> None:
        """Allocates the pools and makes the root of every tree."""
        self.options, self.lock = options, threading.RLock()
        self._rendering = False
        self.device = check.device("Engine", self.options.device)
        producers = dict(scene) if isinstance(scene, Mapping) else {"scene": scene}
        for name in producers:
            check.instance("Engine", "name of a tree", name, str)
        nodes, bricks = make_pools(producers, self.options, self.device)
        self.cache = Cache(nodes, bricks, len(producers))
        max_loads = max(1, _MAX_PRODUCED_BYTES // brick_bytes(bricks.channels, self.options))
        self.scheduler = Scheduler(
            order=self.options.order,
            loads=min(self.options.load_budget, max_loads),
            subdivisions=self.options.subdivide_budget,
            milliseconds=self.options.time_budget,
        )
        by_level = self.options.loading == "levels"
        self.production = Production(self.cache, self.scheduler, by_level, self.options.strict)
        self.trees = self.production.trees
        self.readbacks = Readbacks()
        self.frames, self._closed = 0, False
        self._missed: Tensor | None = None  # (r,) bool, which rays of the last picture missed
        self._recent_stats: deque[FrameStats] = deque(maxlen=_REPORTED_FRAMES)  # for the report
        self._versions: dict[str, int] = {}  # of the content that the trees hold
        self._host_frames: list[HostFrame] = []  # captured, with producers on the host
        try:
            layouts: dict[str, Layout] = {}
            for name, producer in producers.items():
                self.trees[name] = make_tree(self.cache, self.options, layouts, name, producer)
                self._versions[name] = producer.version
        except BaseException:  # Ctrl-C as well
            self.close()
            raise

    @contextmanager
    def new_frame(self, options: RenderOptions) -> Iterator[FrameStats]:
        """Collects the statistics of the frame that the block renders, and keeps other threads out.
        If the block raises, only nodes whose answers are on their way stay marked as pending.
        """
        with self.lock:
            if self._closed:
                raise ValueError("Engine: it is closed")
            if in_transform():
                hint = "render a resident tree in it"
                raise RuntimeError(f"Engine: torch.func can't transform writes into pools: {hint}")
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
            self._restore_pending()
            raise
        end = mark(self.device)

        def complete() -> None:
            stats.milliseconds += milliseconds(start, end)
            if timings is not None:
                add(stats.stages, timings.as_dict())

        stats.later(complete)
        if monitor:
            self._recent_stats.append(stats)
        self.production.failures.raise_if_strict()

    @lasting
    def serve_last_frame(self, stats: FrameStats, wait: bool = False) -> None:
        """Serves the requests of the last frame and writes answers that came late.

        If the last frame's counts have not arrived, nothing is served now: rays ask again for what
        they still miss. The host waits for the counts only if an earlier frame is known to have
        requests, if an answer is due, if the host is too far ahead, or if `wait` is true.
        """
        self.renew()
        self._release()
        newest = self.readbacks.catch_up(wait or self.production.due)
        if self.readbacks:
            return
        if newest is not None:  # nothing was written since it was traced: its nodes are still there
            self.scheduler.begin()
            self.production.serve(newest.requests, newest.wait(), stats)
        with stage("write"):
            self.production.write(self.production.late_answers(), stats)

    def renew(self) -> None:
        """Drops nodes and bricks that producers have reported as changed (`Producer.changed`), and
        remakes the roots of their trees; the host waits for that. The next frames make the rest.
        """
        changed = self._changed_trees()
        if not changed:
            return
        self._release()
        self.readbacks.catch_up(wait=True)  # their requests are dropped
        for source in changed:
            self.production.forget(source)
            old_version, producer = self._versions[source.name], source.producer
            version = producer.version  # another thread may change it further meanwhile
            renew_tree(self.cache, source, producer.changes(old_version))
            self._versions[source.name] = version
        self._missed = None

    def _release(self, keep: RecordedFrame | None = None) -> None:
        """Drops the answers that are on their way to captured frames, except to `keep`. Captured
        frames whose graphs are gone are dropped altogether, with their buffers.
        """
        for host_frame in list(self._host_frames):
            if host_frame is not keep:
                host_frame.release()
            if host_frame.abandoned:
                host_frame.close()
                self._host_frames.remove(host_frame)

    def _restore_pending(self) -> None:
        """Marks the nodes whose answers are on their way as pending, and no others. Answers to
        captured frames are dropped first: their nodes would be requested again, and written twice.
        """
        self._release()
        self.production.restore_pending()

    def scout(self, view: View, stats: FrameStats) -> None:
        """Traces some rays before the picture: while answers are written at once, some rays that
        missed something are traced again, and what they miss next is served within this frame.

        Scouts stamp what they use with the frame number of the last picture, as a write does. So a
        slot is kept if that picture used it, if a scout did, or if it was written since. Requests
        that exceed the budgets or the pools are left to the picture.
        """
        produced_count, hits = 0, None
        for _ in range(self.options.scout_rounds):
            if sum(stats.produced.values()) == produced_count or stats.capacity_exceeded:
                break  # nothing new to see, or no room for more
            produced_count = sum(stats.produced.values())
            if hits is None:
                hits = empty_hits(self.device, view.options.dtype, view.ray_count)
                if self._missed is not None and len(self._missed) == view.ray_count:
                    hits.missed.copy_(self._missed)
            view.hits(again=(hits, scouts(hits.missed, view.camera.width)))
            collected = self.collect_requests_and_use(hits.samples[:0])
            counts = Counts(*collected.numbers.tolist())  # waits: this frame misses something
            add(stats.requests, counts.by_kind())
            self.production.serve(collected.requests, counts, stats)

    def trace(
        self, view: View, progress: Progress = no_progress, again: Again | None = None
    ) -> Hits:
        """Traces a picture's rays, or those that `again` selects, under a new frame number."""
        self._number_picture()
        self.cache.frame_1.fill_(self.frames)
        return view.hits(progress, again=again)

    def _number_picture(self) -> None:
        """Gives the next picture its number, with which rays stamp what they use. Its copy on the
        device, `Cache.frame_1`, is written by `trace`, or counted up by a graph.
        """
        self.frames += 1
        for source in self.trees.values():
            source.tree.frame = self.frames

    def collect_requests_and_use(self, samples: Tensor) -> Collected:
        """Lists the requests of a traced frame and clears their words, sorts the slots by use, and
        counts both and the sum of (r,) samples; all results stay on the device.
        """
        with stage("requests"):
            capacity = min(_MAX_LISTED_NODES, self.cache.nodes.child_tn.numel())
            requests = RequestList.collect(self.cache, capacity)
        with stage("lru"):
            use = self.cache.sort_by_use()
        with stage("count"):
            sample_count = samples.sum(dtype=torch.int64).view(1)
            return Collected(requests, torch.cat((requests.count, use, sample_count)))

    def read_back(self, stats: FrameStats, hits: Hits, collected: Collected) -> None:
        """Starts copying a frame's counts to the host; until they arrive no slot may be taken."""
        nodes, bricks = self.cache.nodes, self.cache.bricks
        stats.nodes, stats.bricks = nodes.child_tn.numel(), bricks.capacity
        stats.rays, stats.bytes = len(hits.missed), nodes.nbytes + bricks.nbytes
        self._missed = hits.missed
        self.cache.make_room(0, 0)
        self.readbacks.append(Readback(stats, collected, self.readbacks))

    @property
    def steady(self) -> bool:
        """True if the newest frame read back missed nothing; does not block."""
        return self.readbacks.steady

    @property
    def changed(self) -> bool:
        """Whether a producer's content has changed since its tree was last renewed."""
        return bool(self._changed_trees())

    def _changed_trees(self) -> list[ProducedTree]:
        sources = self.trees.values()
        return [s for s in sources if s.producer.version != self._versions[s.name]]

    def close(self) -> None:
        """Waits for the frame that another thread is rendering, then drops all answers on their way
        and closes the producers' files and threads.
        """
        self._closed = True  # another thread's picture gets no further frame
        with self.lock:
            for host_frame in self._host_frames:
                host_frame.close()
            self.production.close()
            for source in self.trees.values():
                if source.producer.layout is source.layout:  # else another engine may use it now
                    source.producer.close()
                    source.producer.layout = None
