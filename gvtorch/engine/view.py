"""`View`: what a frame shows, from the camera's rays to the picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor

from ..base.records import Hits, RenderStats
from ..base.stage import Progress, no_progress
from ..cameras import Camera
from ..pictures import Picture
from ..shaders.shader import Shader, check_shader
from ..tracing import RenderOptions
from ..tracing.around import around
from ..tracing.composite import Trace, trace_trees
from ..tracing.pixels import develop, trace_camera
from ..tracing.tracer import Tracer
from .request_batch import ProducedTree

#: A shader for all trees, or one for each by name.
Shaders = Shader | Mapping[str, Shader]
#: Hits of an earlier pass, which are overwritten, and which (r,) bool of their rays to trace again.
Again = tuple[Hits, Tensor]


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """A camera in the world, what traces its rays, and how the picture is made."""

    camera: Camera
    numbers: Tensor  # of the camera, on the engine's device
    trace_rays: Trace  # through all trees
    options: RenderOptions

    @property
    def rays(self) -> int:
        """Number of rays."""
        return len(self.camera) * self.camera.height * self.camera.width

    def hits(self, progress: Progress = no_progress, again: Again | None = None) -> Hits:
        """Makes the camera's rays and traces them, all or some of them again; they mark what they
        use and request what is missing.
        """
        view = (self.camera, self.numbers, self.trace_rays, self.options)
        return trace_camera(*view, progress, again=again)

    def picture(self, hits: Hits, stats: RenderStats) -> Picture:
        """Puts the hits over the background."""
        return develop(hits, self.camera, self.numbers, self.options, stats)


def trace_scene(
    trees: Mapping[str, ProducedTree],
    shaders: Shaders,
    options: RenderOptions,
    box: Tensor,
    **frame: Any,
) -> Trace:
    """Returns what traces rays through all trees.

    Args:
        trees: By name.
        shaders: One for all, or one for each by name.
        options: Of the picture.
        box: (2, 3) world corners around all trees.
        **frame: See `Tracer`.

    Raises:
        ValueError: A tree has no shader, or not the channel that its shader reads.
    """
    traces = []
    for name, source in trees.items():
        tree, channels = source.tree, source.producer.channels
        shader: Any = shaders.get(name) if isinstance(shaders, Mapping) else shaders
        check_shader("frame", f"shader of tree {name!r}", shader)
        channel = options.channel or next(iter(channels))
        for needed in (channel, *shader.channels):
            if needed not in channels:
                known = ", ".join(channels)
                raise ValueError(f"frame: tree {name!r} has no channel {needed!r}; it has {known}")
        chosen = replace(options, channel=channel)
        traces.append((tree.box, around(Tracer(tree, shader, chosen, **frame), chosen, box)))
    return partial(trace_trees, traces)
