"""From a tree's tracer to what the options make of it: depth of field, clip, lighting."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from ..shaders.lights import LitShader
from .caps import SurfaceSlab
from .clip import Clipped
from .composite import Trace
from .lighting import Lighted
from .options import RenderOptions
from .projection_pieces import ProjectedPieces
from .thin_lens import ThinLens, ThroughLens
from .tracer import Tracer


def around(tracer: Tracer, options: RenderOptions, box: Tensor) -> Trace:
    """Wraps a tree's tracer in what the options ask for. Each ray goes through lighting, then the
    clip, then the lens, then the tree; cones to the lights go through clip and tree alone.

    Args:
        tracer: Traces rays of one frame through one tree.
        options: How the picture is made.
        box: (2, 3) world corners of the scene, all trees together.

    Raises:
        ValueError: The shader must see a ray in one go, and the options cut rays into pieces or
            draw caps; or it has no normals, and there is lighting.
    """
    _check_whole(tracer, options)
    lens = options.lens and options.lens.placed(box)
    if options.lighting is None:
        return _clipped(tracer, options, box, lens)
    shader = tracer.shader
    unlit = shader.unlit()
    assert isinstance(shader, LitShader)  # others raise
    cones = replace(options, lod="auto")
    matter = None
    if options.lighting.indirect:
        early = replace(cones, depth_alpha=0.25 * options.stop_alpha)
        matter = _clipped(tracer.seeing(shader.matter(), early), options, box)
    return Lighted(
        _clipped(tracer.seeing(unlit, options), options, box, lens),
        blocker=_clipped(tracer.seeing(shader.blocker(), cones), options, box),
        matter=matter,
        lighting=options.lighting.placed(box),
        shader=shader,
        voxel=max(tracer.tree.spacing),
        cone_scale=options.cone_scale,
        lens=lens,
    )


def _check_whole(tracer: Tracer, options: RenderOptions) -> None:
    """Raises ValueError if the shader must see a ray in one go, and the options do not let it."""
    shader, clip, layer = tracer.shader, options.clip, options.layer
    if not shader.whole_ray:
        return
    cuts = {
        "lens": options.lens is not None,
        "clip with caps": clip is not None and clip.caps,
        "clip of several pieces": clip is not None and not clip.whole and not shader.projection,
        "translucent layer": layer is not None and layer.alpha is not None,
    }
    for name, cut in cuts.items():
        if cut:
            kind = type(shader).__name__
            raise ValueError(f"render: {kind} sees a ray in one go, so it has no {name}")


def _clipped(
    tracer: Tracer,
    options: RenderOptions,
    box: Tensor,
    lens: ThinLens | None = None,
) -> Trace:
    """A tracer with the lens (in world units) and the options' clip."""
    trace: Trace = tracer
    if lens is not None:
        trace = ThroughLens(trace, lens, options.cone_scale)
    if options.clip is None:
        return trace
    slab: Trace | None = None
    together: ProjectedPieces | None = None
    surface = tracer.shader.cut_surface() if options.clip.caps else None
    if surface is not None:
        slab = SurfaceSlab(surface, lambda shader: tracer.seeing(shader, options))
    if tracer.shader.projection is not None:
        together = ProjectedPieces(tracer, tracer.shader.projection)
    return Clipped(
        trace,
        options.clip,
        box,
        step=tracer.arguments.step,
        depth_alpha=options.depth_alpha,
        slab=slab,
        unlit=options.lighting is not None,
        together=together,
    )
