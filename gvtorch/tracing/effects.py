"""`TreeTrace`: a tree's tracer, wrapped in the options' effects: depth of field, clip, lighting."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from ..base.records import Hits, Rays
from ..ops.reference.march import Transfer
from ..ops.shading import pack
from ..shaders.shader import CutSurface, Shader
from .clip import Clipped
from .composite import TraceRays, box_span, tree_span
from .lighting import Lighted
from .options import RenderOptions
from .pose import world_box
from .thin_lens import ThinLens, ThroughLens
from .tracer import Tracer


@dataclass(frozen=True, eq=False)
class TreeTrace:
    """The tracers of a tree."""

    box: Tensor  # (2, 3) float64 world corners around the tree
    trace: TraceRays  # the tracer, wrapped by `with_effects`
    tracer: Tracer  # the tree alone

    @classmethod
    def of(
        cls, tracer: Tracer, options: RenderOptions, scene_box: Tensor | None = None
    ) -> TreeTrace:
        """Wraps a tracer; `scene_box` (2, 3) is for scenes that hold more than its tree."""
        box = world_box(tracer.tree.box, tracer.pose)
        trace = with_effects(tracer, options, box if scene_box is None else scene_box)
        return cls(box, trace, tracer)


def box_spans(trees: Sequence[TreeTrace], rays: Rays) -> Tensor:
    """Returns (m, r, 2) distances of rays in the trees' boxes; last < first where they miss."""
    spans = []
    for tree in trees:
        tree_rays = tree.tracer.to_tree(rays)
        origin = tree_rays.origin
        low, high = pack((tree.tracer.tree.box,), origin.dtype, origin.device).view(2, 3)
        first, last = box_span(low, high, origin, tree_rays.direction)
        near, far = rays.range.to(first).unbind(1)
        spans.append(torch.stack((torch.maximum(first, near), torch.minimum(last, far)), 1))
    return torch.stack(spans)


def with_effects(tracer: Tracer, options: RenderOptions, box: Tensor) -> TraceRays:
    """Wraps a tree's tracer in the effects of the options. Each ray passes through lighting, then
    the clip, then the lens, then the tree; cones to the lights only through clip and tree. `box`:
    (2, 3) world corners of the scene, all trees together. Raises ValueError if the shader must see
    a whole ray at once, and the options cut rays into pieces or draw caps; or if it has no normals,
    and there is lighting.
    """
    check_fits(tracer.shader, options)
    lens = options.lens and options.lens.placed(box)
    if options.lighting is None:
        return _clipped(tracer, options, box, lens)
    shader = tracer.shader
    unlit = _clipped(tracer.with_shader(shader.unlit(), options), options, box, lens)
    lights = options.lighting.lights
    cone_options = replace(options, lod="auto")
    matter = None
    if options.lighting.indirect:
        matter_options = replace(cone_options, depth_alpha=0.25 * options.stop_alpha)
        matter = _clipped(tracer.with_shader(shader.matter(), matter_options), options, box)
    return Lighted(
        trace=unlit,
        blocker=_clipped(tracer.with_shader(shader.blocker(), cone_options), options, box),
        matter=matter,
        lighting=options.lighting.placed(box),
        lights=(shader.own_light(),) if lights is None else lights,
        material=shader.material(),
        voxel=max(tracer.tree.spacing),
        cone_scale=options.cone_scale,
        lens=lens,
    )


def check_fits(shader: Shader, options: RenderOptions) -> None:
    """Raises ValueError if a shader does not support the options: see `with_effects`."""
    if options.lighting is not None:
        shader.unlit()
        if options.lighting.indirect:
            shader.matter()
    clip, layer = options.clip, options.layer
    features = {
        "lens": options.lens is not None,
        "clip with caps": clip is not None and clip.caps,
        "clip of several pieces": clip is not None and not clip.whole and not shader.projection,
        "translucent layer": layer is not None and layer.alpha is not None,
    }
    for name, is_used in features.items():
        if is_used and shader.whole_ray:
            kind = type(shader).__name__
            raise ValueError(f"render: {kind} sees a ray in one go, so it has no {name}")


def _clipped(
    tracer: Tracer, options: RenderOptions, box: Tensor, lens: ThinLens | None = None
) -> TraceRays:
    """Wraps a tracer in the lens (in world units) and the options' clip."""
    opened_shader = tracer.shader if options.clip is None else tracer.shader.opened()
    if opened_shader is not tracer.shader:
        tracer = tracer.with_shader(opened_shader, options)
    trace: TraceRays = tracer
    if lens is not None:
        trace = ThroughLens(trace, lens, options.cone_scale)
    if options.clip is None:
        return trace
    surface = tracer.shader.cut_surface() if options.clip.caps else None
    together = None if tracer.shader.projection is None else partial(_project_pieces, tracer)
    return Clipped(
        trace,
        options.clip,
        box,
        step=tracer.arguments.step,
        depth_alpha=options.depth_alpha,
        slab=_slab(surface, tracer, options, trace),
        unlit=options.lighting is not None,
        together=together,
    )


def _slab(
    surface: CutSurface | None, tracer: Tracer, options: RenderOptions, trace: TraceRays
) -> TraceRays | None:
    """Returns the tracer of the intervals behind cuts; None: `trace` traces them, too."""
    if surface is not None:
        return _surface_slab(surface, tracer, options)
    if tracer.label_names is None:
        return None
    # A cap shows the label right behind the cut, however thin the matter is there.
    trace_label = tracer.with_shader(tracer.shader, replace(options, depth_alpha=0.0))

    def slab(rays: Rays) -> Hits:
        return replace(trace(rays), label=trace_label(replace(rays, transmittance=None)).label)

    return slab


def _surface_slab(surface: CutSurface, tracer: Tracer, options: RenderOptions) -> TraceRays:
    """Returns the tracer of the intervals behind cuts through isosurfaces: opaque where the first
    value is inside the surface, in its unlit colour. Under a clip the isosurface itself is hollow.
    """
    trace_value = tracer.with_shader(surface.value, options)
    trace_colors = surface.colors and tracer.with_shader(surface.colors, options)

    def slab(rays: Rays) -> Hits:
        hits = trace_value(rays)
        assert hits.features is not None
        colors = trace_colors(rays).color if trace_colors else hits.color
        color = colors * pack((surface.color,), colors.dtype, colors.device)
        level = pack((surface.level,), color.dtype, color.device)
        inside = (hits.features >= level) != surface.below
        inside = inside & (hits.depth < torch.inf)
        return replace(
            hits,
            color=torch.where(inside, color, 0),
            alpha=torch.where(inside, hits.alpha, 1 - rays.light().to(hits.alpha)),
            depth=torch.where(inside, hits.depth, torch.inf),
            features=None,
        )

    return slab


def _project_pieces(tracer: Tracer, pieces: Iterable[Rays]) -> Hits:
    """Projects pieces of the same rays: to the largest or smallest value of all, at the nearest
    point that has it, or to the mean, weighted by the pieces' lengths inside the tree's box.
    """
    rays, kind = list(pieces), tracer.shader.projection
    hits = [tracer(piece) for piece in rays]
    depths = torch.stack([h.depth for h in hits])  # (pieces, r, 1)
    is_hit = depths < torch.inf
    values = torch.stack([h.features for h in hits if h.features is not None])
    if kind == "mean":
        lengths = torch.stack([_length_inside(tracer, piece) for piece in rays])
        lengths = torch.where(is_hit, lengths.to(values)[..., None], 0)
        value = (values * lengths).sum(0) / lengths.sum(0).clamp(min=1e-30)
    else:
        sign = 1 if kind == "maximum" else -1
        best = torch.where(is_hit, sign * values, -torch.inf).amax(0)
        is_hit, value = is_hit & (sign * values == best), sign * best
    depth = torch.where(is_hit, depths, torch.inf).amin(0)
    seen = depth < torch.inf
    value = torch.where(seen, value, 0)
    light = rays[0].light().to(depth)
    color = Transfer(tracer.arguments).look_up(value[:, 0])[:, :3]
    return Hits(
        color=torch.where(seen, light * color, 0),
        alpha=torch.where(seen, 1, 1 - light),
        depth=depth,
        samples=torch.stack([h.samples for h in hits]).sum(0, dtype=torch.int32),
        missed=torch.stack([h.missed for h in hits]).any(0),
        normal=hits[0].normal,
        features=value,
    )


def _length_inside(tracer: Tracer, rays: Rays) -> Tensor:
    """Returns (r,) the world length of each ray inside the tree's box."""
    tree_rays = tracer.to_tree(rays)
    enter, leave = tree_span(tracer.tree.place, tree_rays.origin, tree_rays.direction)
    first, last = rays.range.unbind(1)
    return (torch.minimum(last, leave) - torch.maximum(first, enter)).clamp(min=0)
