"""What traces the rays of a scene: all its trees, each with its shader."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from torch import Tensor

from ..shaders.shader import Shader, check_shader
from ..tracing import RenderOptions
from ..tracing.around import around
from ..tracing.composite import Trace, trace_trees
from ..tracing.tracer import Tracer
from .request_batch import ProducedTree

#: A shader for all trees, or one for each by name.
Shaders = Shader | Mapping[str, Shader]


def trace_scene(
    trees: Mapping[str, ProducedTree],
    shaders: Shaders,
    options: RenderOptions,
    box: Tensor,
    **frame: Any,
) -> Trace:
    """Returns what traces rays through all trees, which `box` (2, 3) holds; `frame` as in `Tracer`.

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
