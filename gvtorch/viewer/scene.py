"""`Scene`: what a view looks at, whatever it was given: an engine, a producer, a resident tree, a
volume, a store or a path; and how it is rendered, a frame at a time, by the thread that owns it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from os import PathLike, fspath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base.arrays import as_volume
from ..base.image_info import ImageInfo
from ..base.stage import Progress, no_progress
from ..base.volume import Volume
from ..cameras import Camera
from ..engine import Engine, EngineOptions, FrameStats
from ..io.ngff import is_zarr
from ..io.reading import read_volume
from ..io.store import Store
from ..io.window import looked_at, window
from ..ops import available
from ..pictures import Picture
from ..pool import N3Tree
from ..producers import Producer, StoredProducer, VolumeProducer
from ..shaders import Channels, Labels, Shader, TransferFunction
from ..shaders.presets import IN_HU
from ..tracing import cost, render
from .state import ViewState

BINS = 256  # of a histogram, at most
_LOOKED_AT = 1 << 20  # values by which whole numbers are known
_BUDGET = 40.0  # milliseconds of production a frame, so that none takes long


@dataclass
class Scene:
    """What is looked at; used by one thread.

    Attributes:
        name: For people.
        engine: That streams it, or None.
        tree: Resident, or None.
        data: The volume or store behind it, if known.
        remake: Makes the producer again, where the engine is the view's own.
    """

    name: str
    engine: Engine | None = None
    tree: N3Tree | None = None
    data: Volume | Store | None = None
    remake: Callable[[], Producer] | None = None

    @property
    def box(self) -> Tensor:
        """(2, 3) float64 world corners."""
        if self.engine is not None:
            return self.engine.box
        assert self.tree is not None
        return self.tree.box

    @property
    def info(self) -> ImageInfo:
        """What is known of the numbers."""
        return ImageInfo() if self.data is None else self.data.info

    @property
    def trees(self) -> list[N3Tree]:
        """All trees."""
        if self.engine is not None:
            return [one.tree for one in self.engine.trees.values()]
        return [] if self.tree is None else [self.tree]

    def frame(self, camera: Camera, state: ViewState, progress: Progress = no_progress) -> Picture:
        """Renders what is there now; what is missing is on its way to the next frame."""
        common: Any = {"shader": state.shader, "progress": progress, **state.settings()}
        if self.engine is not None:
            picture, stats = self.engine.frame(camera, **common)
            stats.settle()
            return picture
        assert self.tree is not None
        return render(self.tree, camera, **common)

    def cost(self, camera: Camera, state: ViewState, progress: Progress) -> Picture:
        """Renders what the last frame cost in false colours."""
        shader = getattr(state.shader, "transfer", None) or state.shader
        (tree,) = self.trees[:1]
        found = cost(tree, camera, shader, progress=progress, **state.settings())
        return found.picture(state.show)  # type: ignore[arg-type]

    def first_shader(self) -> Shader:
        """Returns a shader that shows something, where nobody named one."""
        data = self.data
        if data is None:
            return self._shader_of_tree()
        if data.info.labels:
            return Labels()
        width = data.width if isinstance(data, Store) else data.data.shape[3]
        if 1 < width <= 16 and len(data.info.channels) == width:
            return Channels.of(data)
        if data.info.quantity == "HU":
            return TransferFunction.preset(IN_HU["bone"])
        return TransferFunction.preset("gray", *window(data))

    def _shader_of_tree(self) -> Shader:
        tree = self.trees[0]
        name = tree.channel_names[0]
        if name in tree.labels:
            return Labels()
        low, high = (0.0, 1.0)
        producers = self.engine.trees.values() if self.engine is not None else ()
        for one in producers:
            low, high = one.producer.value_range.get(name, (low, high))
        return TransferFunction.preset("gray", low, high)

    def histogram(self, component: int, in_view: bool) -> dict[str, Any]:
        """Counts values: of the bricks that the last frame read, or of all, as far as a sample
        tells. Returns low, high, and at most BINS counts.
        """
        values = self._in_view(component) if in_view or self.data is None else None
        if values is None and self.data is not None:
            values = looked_at(self.data)[..., component].ravel()
        if values is None or not len(values):
            return {"low": 0.0, "high": 1.0, "counts": [0] * BINS}
        low, high = float(values.min()), float(values.max())
        high = high if high > low else low + 1.0
        bins = BINS
        if bool((values[:_LOOKED_AT] == np.rint(values[:_LOOKED_AT])).all()):
            apart = float(np.diff(np.unique(values[:_LOOKED_AT])).min(initial=high - low))
            width = apart * max(1, math.ceil((high - low) / apart / BINS))  # else some stay empty
            low, bins = low - apart / 2, math.ceil((high - low + apart) / width)
            high = low + bins * width
        counts, _ = np.histogram(values, bins, (low, high))
        return {"low": low, "high": high, "counts": counts.tolist()}

    def _in_view(self, component: int) -> np.ndarray | None:
        tree = self.trees[0]
        bricks = tree.bricks
        pool = bricks.bricks[tree.channel_names[0]]
        used = (bricks.stamp_b == tree.frame).nonzero()[:4096, 0]
        if not len(used):
            return None
        inner = slice(bricks.border, bricks.border + bricks.brick_size)
        raw = pool.view(torch.int16) if pool.dtype == torch.uint16 else pool
        found = raw[used].view(pool.dtype)[:, inner, inner, inner, component]
        found = found.float() if found.dtype == torch.bfloat16 else found
        values = found.cpu().numpy().ravel().astype(np.float32)
        return values[np.isfinite(values)]

    def failures(self) -> list[str]:
        """What could not be produced, the newest last."""
        return [] if self.engine is None else [str(one) for one in self.engine.failures]

    def retry(self) -> None:
        """Lets what could not be produced be asked for again."""
        if self.engine is not None:
            self.engine.forget_failures()

    def resize(self, **options: Any) -> None:
        """Makes the engine anew with other `EngineOptions`; what was there is made again.

        Raises:
            ValueError: The engine is not the view's own, or refuses the options; then the old one
                goes on.
        """
        if self.engine is None or self.remake is None:
            raise ValueError("view: the engine was handed in: its memory is its owner's to set")
        before = self.engine.options
        wanted = replace(before, **options)
        self.engine.close()
        try:
            self.engine = Engine(self.remake(), **vars(wanted))
        except (ValueError, RuntimeError):
            self.engine = Engine(self.remake(), **vars(before))
            raise

    def settled(self, picture: Picture) -> bool:
        """Whether a picture shows all that can be had."""
        stats = picture.stats
        if not isinstance(stats, FrameStats):
            return True
        made = sum(stats.produced.values())
        return stats.converged or not (made or stats.pending or stats.deferred)

    def close(self) -> None:
        """Closes an engine that is the view's own."""
        if self.engine is not None and self.remake is not None:
            self.engine.close()


def open_scene(what: Any, **options: Any) -> Scene:
    """Returns the scene of anything that can be looked at.

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
    options.setdefault("time_budget", _BUDGET)
    if "device" not in options and not available()["cuda"]:
        options["device"] = "cuda"
    if isinstance(what, Mapping) and all(isinstance(one, Producer) for one in what.values()):
        return Scene(", ".join(what), Engine(what, **options), remake=lambda: what)  # type: ignore
    if isinstance(what, Producer):
        return Scene(repr(what), Engine(what, **options), remake=lambda: what)
    data = _data_of(what)
    options.setdefault("border", 2 if data.info.labels else EngineOptions.border)

    def remake() -> Producer:
        return VolumeProducer(data) if isinstance(data, Volume) else StoredProducer(data)

    return Scene(data.name, Engine(remake(), **options), data=data, remake=remake)


def _data_of(what: Any) -> Volume | Store:
    if isinstance(what, (Volume, Store)):
        return what
    if isinstance(what, (str, PathLike)):
        path = fspath(what)
        return Store.open(path) if is_zarr(path) else read_volume(path)
    try:
        return as_volume(what, where="view")
    except ValueError as error:
        known = "an Engine, Producer, N3Tree, Volume, Store, array or path"
        raise ValueError(f"view: takes {known}: {error}") from None
