"""`around`: what the options put around a tree's tracer, from the inside out."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from ..shaders.fused import LitShader, Projection, Shader
from ..shaders.surfaces import Isosurface
from .caps import SurfaceSlab
from .clip import Clipped
from .composite import Trace
from .lighting import Lighted
from .module_shader import ModuleTracer
from .options import RenderOptions
from .projection_pieces import ProjectedPieces
from .thin_lens import ThinLens, ThroughLens
from .tracer import Tracer


def around(tracer: Tracer | ModuleTracer, options: RenderOptions, box: Tensor) -> Trace:
    """Returns a tree's tracer with what the options put around it: the lens, then the clip, then
    the light, whose cones go through the clip, but not through the lens; `box` (2, 3) is the
    scene's.

    Raises:
        ValueError: The shader sees a ray in one go, and the options cut rays into pieces or draw
            caps; or it takes no light, and there is some.
    """
    clip = options.clip
    projects = isinstance(tracer.shader, Projection)  # puts pieces together in its own way
    cuts = {
        "lens": options.lens is not None,
        "clip with caps": clip is not None and clip.caps,
        "clip of several pieces": clip is not None and not clip.whole and not projects,
        "translucent layer": options.layer is not None and options.layer.alpha is not None,
    }
    if isinstance(tracer.shader, Shader) and tracer.shader.whole and any(cuts.values()):
        name = next(name for name, cut in cuts.items() if cut)
        kind = type(tracer.shader).__name__
        raise ValueError(f"render: {kind} sees a ray in one go, so it has no {name}")

    def through(sight: Tracer | ModuleTracer, lens: ThinLens | None = None) -> Trace:
        trace: Trace = sight
        if lens is not None:
            trace = ThroughLens(trace, lens, options.cone_scale)
        if options.clip is None:
            return trace
        slab: Trace | None = None
        together: ProjectedPieces | None = None
        if not isinstance(sight, ModuleTracer):
            if options.clip.caps and isinstance(sight.shader, Isosurface):
                slab = SurfaceSlab(sight.shader, lambda shader: sight.seeing(shader, options))
            if isinstance(sight.shader, Projection):
                together = ProjectedPieces(sight, sight.shader)
        given = {"step": tracer.arguments["step"], "depth_alpha": options.depth_alpha}
        unlit = options.lighting is not None
        return Clipped(trace, options.clip, box, slab=slab, unlit=unlit, together=together, **given)

    lens = options.lens and options.lens.placed(box)
    if options.lighting is None:
        return through(tracer, lens)
    shader = tracer.shader
    if isinstance(tracer, ModuleTracer) or not isinstance(shader, LitShader):
        kind = "TransferFunction" if shader is None else type(shader).__name__
        raise ValueError(
            "render: lighting needs normals: the shader must be Lit, StoredColor, Isosurface or "
            f"DistanceField, got {kind}"
        )
    cones = replace(options, lod="auto")
    matter = None
    if options.lighting.indirect:
        early = replace(cones, depth_alpha=0.25 * options.stop_alpha)
        matter = through(tracer.seeing(shader.matter(), early))
    return Lighted(
        through(tracer.seeing(shader.unlit(), options), lens),
        blocker=through(tracer.seeing(shader.blocker(), cones)),
        matter=matter,
        lighting=options.lighting.placed(box),
        material=shader.material(),
        voxel=max(tracer.tree.spacing),
        cone_scale=options.cone_scale,
        lens=lens,
    )
