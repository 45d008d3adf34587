"""`Scene`: what a view shows, made of an engine, a producer, a resident tree, a volume, a store or
a path; it is rendered frame by frame by the thread that owns it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from os import PathLike, fspath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base.arrays import as_volume
from ..base.image_info import SIGNED_DISTANCE, ImageInfo
from ..base.stage import Progress, no_progress
from ..base.volume import Volume, movable, to_numpy
from ..cameras import Camera
from ..engine import Engine, FrameStats
from ..io.reading import open_source, read_volume
from ..io.stores.ngff import is_zarr
from ..io.stores.store import Store
from ..io.window import sample_values, window
from ..ops.registry import device_of
from ..pictures import Picture
from ..pool import N3Tree
from ..producers import Producer, StoredProducer, VolumeProducer
from ..shaders import Channels, DistanceField, Labels, Shader, TransferFunction
from ..shaders.labels import label_rows
from ..shaders.presets import IN_HU
from ..tracing import cost, render
from .schema import MAX_ITEMS
from .state import ViewState

BINS = 256  # of a histogram, at most
_MAX_BOXES = 1500  # most boxes of nodes that are sent to a page
_LABELS_PER_PART = 1 << 16  # labels that are searched at once
_CHECKED_VALUES = 1 << 20  # values that are checked for being whole numbers
EngineScene = Producer | Mapping[str, Producer]
Remake = Callable[[Volume | Store | None], EngineScene]
_BUDGET_MS = 40.0  # milliseconds of production a frame, so that none takes long


@dataclass
class Scene:
    """The scene of a view; used by one thread."""

    name: str  # for people
    engine: Engine | None = None  # that streams it
    tree: N3Tree | None = None  # resident
    data: Volume | Store | None = None  # that it shows, if known
    #: Makes the producer of `data` again; None: the engine belongs to the caller.
    remake: Remake | None = None
    times: int = 1  # time points of the series that `data` is one of
    reopen: Callable[[int], Volume | Store] | None = None  # at another time; from any thread
    time: float = 0.0  # shown now: the number of a time point, or the time of producers' clocks
    _resident: Volume | None = field(default=None, repr=False)  # voxels of a tree
    _labels: np.ndarray | None = field(default=None, repr=False)  # of the data that is shown

    def __post_init__(self) -> None:
        if self.times == 1 and (clocks := self._clocks()):
            self.time = clocks[0].time

    @property
    def box(self) -> Tensor:
        """(2, 3) float64 world corners."""
        if self.engine is not None:
            return self.engine.box
        assert self.tree is not None
        return self.tree.box

    @property
    def info(self) -> ImageInfo:
        """What is known of the values."""
        return ImageInfo() if self.data is None else self.data.info

    @property
    def trees(self) -> list[N3Tree]:
        if self.engine is not None:
            return [source.tree for source in self.engine.trees.values()]
        return [] if self.tree is None else [self.tree]

    @property
    def producers(self) -> list[Producer]:
        return [] if self.engine is None else [s.producer for s in self.engine.trees.values()]

    def frame(self, camera: Camera, state: ViewState, progress: Progress = no_progress) -> Picture:
        """Renders with the data that is loaded now; what is missing is requested."""
        common: Any = {"shader": state.shader, "progress": progress, **state.settings()}
        if self.engine is not None:
            picture, stats = self.engine.frame(camera, **common)
            stats.settle()
            return picture
        assert self.tree is not None
        return render(self.tree, camera, **common)

    def cost(self, camera: Camera, state: ViewState, progress: Progress) -> Picture:
        """Renders what a frame costs with the data loaded now, in false colours."""
        (tree,) = self.trees[:1]
        return state.cost_picture(partial(cost, tree, progress=progress), camera)

    def voxels(self, purpose: str) -> Volume | Store:
        """Returns the voxels of which planes and surfaces are made.

        Raises:
            ValueError: It has no voxels of its own, or they are not all in memory.
        """
        if self.data is not None:
            return self.data
        if self.tree is None:
            producers = self.producers
            voxels = _voxels_of(producers[0]) if len(producers) == 1 else None
            if voxels is None:
                raise ValueError(f"{purpose}: this scene has no voxels of its own")
            return voxels
        if self._resident is None:
            self._resident = self.tree.to_volume()
        return self._resident

    def first_shader(self) -> Shader:
        """Returns the default shader, which fits the data."""
        data = self.data
        if data is None:
            return self._shader_of_tree()
        if data.info.labels:
            return Labels()
        if 1 < data.width <= 16 and len(data.info.channels) == data.width:
            return Channels.of(data)
        if data.info.quantity == SIGNED_DISTANCE:
            return DistanceField()
        if data.info.quantity == "HU":
            return TransferFunction.preset(IN_HU["bone"])
        return TransferFunction.preset("gray", *window(data))

    def _shader_of_tree(self) -> Shader:
        tree = self.trees[0]
        name = tree.channel_names[0]
        if name in tree.labels:
            return Labels()
        low, high = (0.0, 1.0)
        for producer in self.producers:
            low, high = producer.value_range.get(name, (low, high))
        return TransferFunction.preset("gray", low, high)

    def histogram(self, component: int, in_view: bool) -> dict[str, Any]:
        """Counts the values of the bricks that the last frame read, or of a sample of all values.
        Returns in_view (whether they are of those bricks, as all are if `data` is None), low,
        high, and at most BINS counts.
        """
        in_view = in_view or self.data is None
        values = self._values_in_view(component) if in_view else None
        if values is None and self.data is not None:
            values = sample_values(self.data)[..., component].ravel()
        if values is None or not len(values):
            return {"in_view": in_view, "low": 0.0, "high": 1.0, "counts": [0] * BINS}
        low, high = float(values.min()), float(values.max())
        high = high if high > low else low + 1.0
        bins = BINS
        if bool((values[:_CHECKED_VALUES] == np.rint(values[:_CHECKED_VALUES])).all()):
            gap = float(np.diff(np.unique(values[:_CHECKED_VALUES])).min(initial=high - low))
            width = gap * max(1, math.ceil((high - low) / gap / BINS))  # no empty bins
            low, bins = low - gap / 2, math.ceil((high - low + gap) / width)
            high = low + bins * width
        counts, _ = np.histogram(values, bins, (low, high))
        return {"in_view": in_view, "low": low, "high": high, "counts": counts.tolist()}

    def _values_in_view(self, component: int) -> np.ndarray | None:
        tree = self.trees[0]
        bricks = tree.bricks
        pool = bricks.bricks[tree.channel_names[0]]
        slots = (bricks.stamp_b == tree.frame).nonzero()[:4096, 0]
        if not len(slots):
            return None
        inner = slice(bricks.border, bricks.border + bricks.brick_size)
        voxels = movable(pool)[slots].view(pool.dtype)[:, inner, inner, inner, component]
        values = to_numpy(voxels.cpu()).ravel().astype(np.float32)
        return values[np.isfinite(values)]

    def _clocks(self) -> list[Any]:
        """Returns the producers that have a clock (`Producer.time`)."""
        return [producer for producer in self.producers if hasattr(producer, "time")]

    def describe_time(self) -> dict[str, Any] | None:
        """Returns what a time slider needs: the number of time points (None for a clock), and step,
        origin and unit of a series' times; None if nothing changes with time.
        """
        if self.times > 1:
            info = self.info
            time_axis = {"step": info.time_step, "origin": info.time_origin, "unit": info.time_unit}
            return {"times": self.times, **time_axis}
        return {"times": None} if self._clocks() else None

    def describe_labels(self, text: str = "") -> dict[str, Any] | None:
        """Returns the first labels of the first channel whose number contains a text, their default
        colours, and the number of all such labels; None if the channel has no labels.
        """
        tree = self.trees[0]
        channel = tree.channel_names[0]
        if channel not in tree.labels:
            return None
        if self._labels is None:
            if tree.labels[channel] is None and isinstance(self.data, Volume):
                self._labels = self.data.data[..., 0].unique().cpu().numpy().astype(np.int64)
            else:
                self._labels = label_rows(tree, channel)[1]
        names = self._labels
        if text:  # in parts, since numbers take more memory as texts
            parts = np.array_split(names, len(names) // _LABELS_PER_PART + 1)
            names = np.concatenate([p[np.char.find(p.astype(str), text) >= 0] for p in parts])
        first = names[:MAX_ITEMS]
        colors = Labels()(first)[:, :3].round(4)
        return {"names": first.tolist(), "colors": colors.tolist(), "count": len(names)}

    def check_state(self, state: ViewState) -> None:
        """Raises ValueError where there is no such time, or no such component."""
        time = state.time
        if self.data is not None:
            self.data.info.check_component("state: component", state.component, self.data.width)
        if self.times > 1:
            if time != int(time) or not 0 <= time < self.times:
                raise ValueError(
                    f"state: time must be one of {self.times} time points, 0 to {self.times - 1}, "
                    f"got {time:g}"
                )
        elif time != self.time and not self._clocks():
            raise ValueError(f"state: nothing changes with time here, got time {time:g}")

    def set_clocks(self, time: float) -> None:
        """Sets the time of the producers that have a clock; what differs is produced again."""
        for producer in self._clocks():
            if producer.time != time:
                producer.time = time
        self.time = time

    def show_time(self, time: float, data: Volume | Store) -> None:
        """Shows another time point of a series: `data` is what `reopen` returned."""
        self._restart(self.remake, data)
        self.data, self.time = data, time

    def failures(self) -> list[str]:
        """Returns messages on what could not be produced, the newest last."""
        return [] if self.engine is None else [str(failure) for failure in self.engine.failures]

    def retry(self) -> None:
        """Allows what could not be produced to be requested again."""
        if self.engine is not None:
            self.engine.forget_failures()

    def resize(self, remake: Remake | None = None, **options: Any) -> None:
        """Recreates the engine with other `EngineOptions`, or with what `remake` makes instead; its
        data is loaded again.

        Raises:
            ValueError: The engine belongs to the caller; or it refuses the options, and is
                recreated with the old ones.
        """
        self._restart(remake or self.remake, self.data, **options)
        if remake is not None:
            self.remake = remake
            self.set_clocks(self.time)

    def _restart(self, remake: Remake | None, data: Volume | Store | None, **options: Any) -> None:
        """Closes the engine and makes another of what `remake` makes of `data`; if that fails,
        makes the old one again and raises.
        """
        if self.engine is None or self.remake is None or remake is None:
            raise ValueError("view: the engine was passed in: its owner sets its memory")
        self._labels = None
        old_options = self.engine.options
        new_options = replace(old_options, **options)
        producer = remake(data)
        self.engine.close()
        try:
            self.engine = Engine(producer, **vars(new_options))
        except Exception:
            self.engine = Engine(self.remake(self.data), **vars(old_options))
            raise

    def settled(self, picture: Picture) -> bool:
        """Returns whether a picture shows all data that can be loaded."""
        stats = picture.stats
        if not isinstance(stats, FrameStats):
            return True
        produced = sum(stats.produced.values())
        return stats.converged or not (produced or stats.pending or stats.deferred)

    def close(self) -> None:
        """Closes the engine unless it belongs to the caller."""
        if self.engine is not None and self.remake is not None:
            self.engine.close()


def open_scene(what: Any, **options: Any) -> Scene:
    """Returns the scene of anything that can be viewed.

    Args:
        what: An `Engine`, a `Producer`, several by name, an `N3Tree`, a `Volume`, an array, a
            `Store`, or a path or URL of one.
        **options: Fields of `EngineOptions`, where an engine is made.

    Raises:
        ValueError: It is none of these, or an option does not fit.
        FileNotFoundError: There is nothing at the path.
    """
    if isinstance(what, (Engine, N3Tree)):
        if options:
            raise ValueError(f"view: {next(iter(options))} is set where the scene is made already")
        return Scene(repr(what), *((what, None) if isinstance(what, Engine) else (None, what)))
    options.setdefault("time_budget", _BUDGET_MS)
    options.setdefault("device", device_of("auto"))
    is_several = isinstance(what, Mapping) and all(isinstance(p, Producer) for p in what.values())
    if is_several or isinstance(what, Producer):
        name = ", ".join(what) if is_several else repr(what)
        return Scene(name, Engine(what, **options), remake=lambda _: what)
    data = _open_data(what)
    options.setdefault("border", data.info.default_border)
    return streamed_scene(data, _producer_of, series_of(what), **options)


def streamed_scene(
    data: Volume | Store, remake: Remake, series: dict[str, Any], **options: Any
) -> Scene:
    """Returns the scene of a volume or a store, which is one of a series (see `series_of`);
    `options` are fields of `EngineOptions`.
    """
    engine = Engine(remake(data), **{"time_budget": _BUDGET_MS, **options})
    return Scene(data.name, engine, data=data, remake=remake, **series)


def _producer_of(data: Volume | Store | None) -> Producer:
    """Makes the producer of a volume or a store."""
    assert data is not None
    return VolumeProducer(data) if isinstance(data, Volume) else StoredProducer(data)


def series_of(what: Any, **options: Any) -> dict[str, Any]:
    """Returns the fields of a `Scene` that describe the time series of a path or a store; `options`
    are those of `read_volume`.
    """
    if isinstance(what, (str, PathLike)):
        path, first = fspath(what), options.pop("time", None) or 0
        if is_zarr(path):
            return series_of(Store.open(path, time=first))
        open_options = {name: value for name, value in options.items() if name != "nan"}
        times = open_source(path, **open_options).times

        def reopen(time: int) -> Volume:
            return read_volume(path, **options, time=time)

        return {"times": times, "reopen": reopen, "time": float(first)}
    if isinstance(what, Store):
        return {"times": what.times, "reopen": what.at_time, "time": float(what.time)}
    return {}


def _voxels_of(producer: Producer) -> Volume | Store | None:
    """Returns the volume or store of which a producer makes bricks, or None."""
    if isinstance(producer, StoredProducer):
        return producer.store
    if isinstance(producer, VolumeProducer):
        return next(iter(producer.volumes.values()))
    return None


def _open_data(what: Any) -> Volume | Store:
    if isinstance(what, (Volume, Store)):
        return what
    if isinstance(what, (str, PathLike)):
        path = fspath(what)
        return Store.open(path) if is_zarr(path) else read_volume(path)
    try:
        return as_volume(what, context="view")
    except ValueError as error:
        accepted = "an Engine, Producer, N3Tree, Volume, Store, array or path"
        raise ValueError(f"view: takes {accepted}: {error}") from None


def node_boxes(tree: N3Tree, eye: tuple[float, float, float]) -> dict[str, Any]:
    """Returns the nodes whose bricks the last frame read, those nearest to an eye first.

    Returns:
        boxes: At most _MAX_BOXES [x, y, z, depth], see `N3Tree.loc`.
        count: Number of all these nodes.
        low, size: World corner and sides of the root.
        branching: N.
    """
    nodes, bricks = tree.nodes, tree.bricks
    has_brick = (nodes.tree_t == tree.number)[:, None] & (nodes.brick_tn >= 0)
    tile, child = has_brick.nonzero().unbind(1)
    brick = nodes.brick_tn[tile, child].to(torch.int64)
    read = bricks.stamp_b[brick] == tree.frame
    loc = tree.loc(tile[read] * nodes.nodes_per_tile + child[read])
    low, size, _ = tree.place.unbind(0)
    fraction = float(tree.branching) ** -loc[:, 3:].to(torch.float64)
    centre = low + (loc[:, :3] + 0.5) * fraction * size  # (k, 3) world
    distance = (centre - centre.new_tensor(eye)).norm(dim=1)
    nearest = distance.argsort(stable=True)[:_MAX_BOXES]
    return {
        "boxes": loc[nearest].tolist(),
        "count": len(loc),
        "low": low.tolist(),
        "size": size.tolist(),
        "branching": tree.branching,
    }
