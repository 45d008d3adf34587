"""`Streaming`: the flags of an engine over a store; messages about its pictures."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ..base.messages import one_line
from .common import Switch, option
from .look import Look

if TYPE_CHECKING:
    from ..base.records import RenderStats
    from ..base.volume import Volume
    from ..engine import Engine, FrameStats
    from ..io.stores.store import Store
    from ..producers import Producer
    from ..shaders import Shader, StoredColor


@dataclass(frozen=True, kw_only=True)
class Streaming:
    """Stores: memory, and how data is loaded."""

    # memory for node tiles
    node_pool: Annotated[str, option(metavar="BYTES")] = "8 MB"
    # memory for bricks, on the device that renders
    brick_pool: Annotated[str, option(metavar="BYTES")] = "256 MB"
    # main memory for decoded blocks
    host_cache: Annotated[str, option(metavar="BYTES")] = "512 MB"
    # interactive: one frame; balanced: up to 4; converge (if left out): until nothing is missing
    mode: Annotated[
        Literal["interactive", "balanced", "converge"] | None,
        option(metavar="{interactive,balanced,converge}"),
    ] = None
    # most frames of a picture with --mode converge
    max_frames: Annotated[int, option(metavar="N")] = 1000
    # straight: load the wanted level directly; levels: level by level, from coarse to fine
    loading: Literal["straight", "levels"] = "straight"
    # image to show, by name or number, if the store has several
    image: Annotated[str | None, option(metavar="NAME")] = None
    # stop with an error if a block can't be read; otherwise that part is drawn coarser
    strict: Switch = False

    def open_store(self, path: str, time: int | None) -> Store:
        """Opens a store at a time point; warns if it has several and none was chosen."""
        from ..io.stores.channels import channel_names
        from ..io.stores.store import Store

        names = channel_names(path) if self.image is None else ()
        image = "color" if "color" in names else self.image
        store = Store.open(path, image=image, time=time or 0)
        if time is None and store.times > 1:
            warnings.warn(
                f"{path}: has {store.times} time points, this is the first; --time N shows "
                f"another, up to {store.times - 1}",
                stacklevel=2,
            )
        return store

    def _mesh_shader(self, store: Store, look: Look) -> StoredColor | None:
        """Returns the shader of a mesh's stored colours, lit by its normals if they are stored too;
        None if the store has none, or the flags choose another shader.
        """
        from ..io.stores.channels import channel_names
        from ..shaders import StoredColor

        if look.shader not in ("plain", "colors") or look.tf is not None:
            return None
        if store.info.quantity != "color" or store.width != 4:
            return None
        look.refuse_flags("colours are stored", "component", "channel")
        # An opaque voxel must be opaque within its own width: light enters no farther.
        options: dict[str, Any] = {"reference": 0.3 * min(store.spacing), "premultiplied": True}
        if self.image is None and "normal" in channel_names(store.location.rpartition("/")[0]):
            return StoredColor("color", normals="normal", **options)
        return StoredColor("value", lit=True, **options)

    def shader(self, store: Store, look: Look) -> Shader:
        from ..shaders import Filtered, Lit

        shader = self._mesh_shader(store, look) or look.make_shader(store)
        if not isinstance(shader, Filtered):
            return shader
        if look.tf is None and look.window is None:
            stored = Filtered.stored(store)
            if stored.numbers != shader.numbers:
                shader_flags = "--shader filtered" + "-lit" * isinstance(stored.transfer, Lit)
                raise ValueError(
                    f"{store.location}: its filtered colours are for {shader_flags}; "
                    "gvtorch filter, with --lit or without, makes others"
                )
            shader = stored
        if shader.component != look.component:
            raise ValueError(f"--component must be that of the colours, {shader.component}")
        return shader

    def producer(self, store: Store, shader: Shader) -> Producer:
        """Returns the producer that streams a store for its shader."""
        from ..producers import StoredChannels, StoredProducer
        from ..shaders import Filtered, StoredColor

        if isinstance(shader, StoredColor) and shader.normals is not None:
            folder = store.location.rpartition("/")[0]
            return StoredChannels(folder, shader.channels, host_cache=self.host_cache)
        filtered = shader if isinstance(shader, Filtered) else None
        return StoredProducer(store, host_cache=self.host_cache, filtered=filtered)

    def engine_options(self, look: Look, data: Volume | Store) -> dict[str, Any]:
        """Returns fields of `EngineOptions`."""
        brick_size, border = look.brick_layout(data)
        return {
            "node_pool": self.node_pool,
            "brick_pool": self.brick_pool,
            "brick_size": brick_size,
            "border": border,
            "loading": self.loading,
            "strict": self.strict,
            "device": look.device(),
        }


def cost_summary(stats: RenderStats) -> str:
    """Returns what a picture cost, in a few words."""
    from ..engine import FrameStats

    samples = f"{stats.samples / 1e6:.1f} M" if stats.samples >= 1e5 else f"{stats.samples:,}"
    text = f"{samples} samples in {stats.milliseconds:.0f} ms ({stats.backend})"
    if not isinstance(stats, FrameStats):
        return text
    bricks = f"{stats.bricks_used} bricks of {stats.bricks}"
    frames = f"{stats.frames} frame{'s' * (stats.frames > 1)}"
    return f"{text}, {frames}, {bricks}{_shortfall(stats)}"


def _shortfall(stats: FrameStats) -> str:
    if stats.capacity_exceeded and not stats.converged:
        return "; the pools are too small for this picture, parts of it are coarser"
    if stats.capacity_exceeded:
        return " (the pools are too small for all at once: rays took turns)"
    if stats.failed:
        return f"; {stats.failed} nodes failed, parts of it are coarser"
    return "" if stats.converged else "; not converged"


def print_failures(engine: Engine) -> None:
    for failure in engine.failures[:3]:
        print(f"gvtorch: {one_line(failure)}", file=sys.stderr)
    if len(engine.failures) > 3:
        print(f"gvtorch: {len(engine.production.failures)} nodes failed in all", file=sys.stderr)
