"""`RenderedScene`: the scene of `gvtorch render` and `gvtorch fly`: a volume, built into a tree in
memory, or a store, streamed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ..io.stores.ngff import is_zarr
from .common import Bar, ReadOptions, given_flags, option, refuse_file_flags, refuse_store_flags
from .look import Look
from .streaming import Streaming, print_failures

if TYPE_CHECKING:
    from torch import Tensor

    from ..base.image_info import ImageInfo
    from ..base.volume import Volume
    from ..cameras import Camera
    from ..io.stores.store import Store
    from ..pictures import Picture
    from ..shaders import Shader
    from ..tracing import Cost
    from ..viewer.state import ViewState


@dataclass(frozen=True)
class RenderedScene:
    """A scene and the functions that render it."""

    render: Callable[..., Picture]  # of a camera
    shader: Shader
    cost: Callable[..., Cost]
    box: Tensor  # (2, 3) float64 world
    data: Volume | Store

    @property
    def info(self) -> ImageInfo:
        """What is known of the image."""
        return self.data.info

    def state(self, options: dict[str, Any]) -> ViewState:
        """Returns the flags as a state without a camera."""
        from ..tracing import RenderOptions
        from ..viewer.state import ViewState

        checked = RenderOptions(**options)
        return ViewState(shader=self.shader, options=checked, component=checked.component)

    def picture(self, state: ViewState, camera: Camera, picture: Picture | None = None) -> Picture:
        """Returns what a state shows from the given camera, without planes beside it: the picture
        (`picture`, if it is already rendered), or costs in its place or blended over it.
        """
        developed = state.taken(self.render, camera) if picture is None else picture
        return state.with_costs(developed, lambda: state.cost_picture(self.cost, camera))


@dataclass(frozen=True, kw_only=True)
class SceneFlags:
    """What is shown, and how."""

    # volumes only: never draw regions with no value above this
    threshold: Annotated[float | None, option(metavar="VALUE")] = None

    look: tyro.conf.OmitArgPrefixes[Look] = Look()
    streaming: tyro.conf.OmitArgPrefixes[Streaming] = Streaming()
    # How to read a volume file that does not say so itself; a store takes only --time.
    source: tyro.conf.OmitArgPrefixes[ReadOptions] = ReadOptions()

    @contextmanager
    def open(self, path: str, options: dict[str, Any], bar: Bar) -> Iterator[RenderedScene]:
        """Opens a volume or a store, to be rendered with these options; raises ValueError if a flag
        is for the other kind.
        """
        bar("reading", 0, 0)
        if is_zarr(path):
            with self._stream(path, options) as scene:
                yield scene
            return
        refuse_store_flags(path, given_flags(self.streaming))
        yield self._resident(path, options, bar)

    def _resident(self, path: str, options: dict[str, Any], bar: Bar) -> RenderedScene:
        """Builds the whole tree of a volume file."""
        from ..pool import N3Tree
        from ..shaders import Filtered
        from ..tracing import cost, render

        volume, look = self.source.read(path), self.look
        shader = look.make_shader(volume)
        tree = N3Tree.from_volume(
            *(volume, *look.brick_layout(volume)),
            threshold=self.threshold,
            device=look.device(),
            progress=bar,
        )
        if isinstance(shader, Filtered):
            shader = Filtered.of(
                tree, volume, shader.transfer, component=look.component, progress=bar
            )
        return RenderedScene(
            partial(render, tree, shader=shader, **options),
            shader,
            partial(cost, tree, shader=shader, **options),
            *(tree.box, volume),
        )

    def open_store(self, path: str) -> Store:
        """Opens a store; raises ValueError where a flag is for volume files."""
        if self.threshold is not None:
            raise ValueError("--threshold is for volumes; a store's is set by gvtorch convert")
        refuse_file_flags(self.source)
        return self.streaming.open_store(path, self.source.time)

    @contextmanager
    def _stream(self, path: str, options: dict[str, Any]) -> Iterator[RenderedScene]:
        """Streams a store, and reports at the end what failed."""
        from ..engine.engine import Engine
        from ..tracing import cost

        store, streaming, limit = self.open_store(path), self.streaming, self.streaming.max_frames
        mode = streaming.mode or "converge"
        if mode != "converge" and limit != Streaming().max_frames:
            raise ValueError(f"--max-frames is for --mode converge, not {mode}")
        shader = streaming.shader(store, self.look)
        producer = streaming.producer(store, shader)
        with Engine(producer, **streaming.engine_options(self.look, store)) as engine:
            (tree,) = (source.tree for source in engine.trees.values())
            yield RenderedScene(
                partial(engine.render, shader=shader, mode=mode, max_frames=limit, **options),
                shader,
                partial(cost, tree, shader=shader, **options),
                *(tree.box, store),
            )
            print_failures(engine)
