"""`render`: camera -> rays -> trace -> picture."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from ..base.records import Hits, Rays, RenderStats
from ..base.stage import Progress, collect_timings, no_progress, stage
from ..cameras.camera import Camera
from ..cameras.custom import as_camera
from ..ops import shade_rays, trace_rays
from ..ops.trace import Backend, choose_backend, most_intervals
from ..pictures.background import Background, checked_background
from ..pictures.picture import Picture
from ..pool import N3Tree
from ..shaders.fused import FusedShader, Intervals, Shader
from ..shaders.transfer_function import TransferFunction, interval_levels
from .around import around
from .clip import Clip
from .layer import Layer
from .lighting import Lighting
from .module_shader import ModuleShader, ModuleTracer
from .pieces import Trace
from .thin_lens import ThinLens

AnyShader = FusedShader | ModuleShader
_RAYS_A_BLOCK = {"cpu": 1 << 16, "cuda": 1 << 22}  # small on the CPU, so that progress shows


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How a picture is made."""

    step: float = config.STEP  # shortest interval, in voxels of the finest level
    lod: Literal["auto", "finest"] = "auto"  # auto: voxels as wide as the pixel cone
    # A colour (linear RGB), an object of `background.py`, an image (h, w, 3) or None: transparent.
    background: tuple[float, float, float] | Background | Tensor | None = (0.0, 0.0, 0.0)
    stop_alpha: float = config.STOP_ALPHA  # a ray ends here; 1 integrates to the end
    depth_alpha: float = config.DEPTH_ALPHA  # depth is where alpha passes this
    cone_scale: float = config.CONE_OVERESTIMATE  # widens the pixel cone
    channel: str | None = None  # name of the channel the shader reads; None: the first
    component: int = 0  # which number of the channel
    layer: Layer | None = None  # what another renderer drew: voxels go before and behind it
    clip: Clip | None = None  # the region of interest; None: everything
    lens: ThinLens | None = None  # depth of field; None: all is sharp
    lighting: Lighting | None = None  # shadows and light from all around; None: the shader's own
    backend: Backend = "auto"
    dtype: torch.dtype = torch.float32  # float64 for trees deeper than about 2^16 voxels

    def __post_init__(self) -> None:
        """Checks every option."""
        where = "render"
        check.number(where, "step", self.step, low=0, open_low=True)
        if self.lod not in ("auto", "finest"):
            raise ValueError(f"{where}: lod must be 'auto' or 'finest', got {self.lod!r}")
        checked_background(where, self.background)
        check.number(where, "stop_alpha", self.stop_alpha, low=0, high=1, open_low=True)
        check.number(where, "depth_alpha", self.depth_alpha, low=0, high=1)
        if self.depth_alpha >= self.stop_alpha:
            raise ValueError(
                f"{where}: depth_alpha must be below stop_alpha, "
                f"got {self.depth_alpha} and {self.stop_alpha}"
            )
        check.number(where, "cone_scale", self.cone_scale, low=0, open_low=True)
        check.whole(where, "component", self.component, low=0)
        for name, value, kind in (
            ("clip", self.clip, Clip),
            ("layer", self.layer, Layer),
            ("lens", self.lens, ThinLens),
            ("lighting", self.lighting, Lighting),
        ):
            if value is not None:
                check_type(where, name, value, kind)
        if self.lens is not None and self.lod == "finest":
            raise ValueError(f"{where}: a lens blurs by level of detail: lod must be 'auto'")
        if self.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{where}: dtype must be float32 or float64, got {self.dtype}")


def render(
    tree: N3Tree,
    camera: Camera | Rays,
    shader: AnyShader,
    *,
    progress: Progress = no_progress,
    **options: Any,
) -> Picture:
    """Renders a resident tree.

    Args:
        tree: What to render, on the device that renders it; its stamps and request words are
            written.
        camera: One camera or a batch; an orbit camera stands around the tree's box. Or rays in
            world units, which make a picture as wide as they tell, or of one row.
        shader: The transfer function, in data units, or another shader.
        progress: Told how many rays are done.
        **options: Fields of `RenderOptions`.

    Returns:
        The picture, (h, w, c) for one camera and (n, h, w, c) for a batch.

    Raises:
        ValueError: An option is unknown or out of its range, or the backend can't be used.
    """
    camera = as_camera("render", camera)
    chosen = render_options("render", camera, options)
    check_type("render", "tree", tree, N3Tree)
    start = time.perf_counter()
    with collect_timings(tree.device) as timings:
        with stage("prepare"):
            tree.frame += 1
            trace = around(tracer_of(tree, shader, chosen), chosen, tree.box)
        placed = camera.placed(tree.box)
        hits = trace_camera(placed, tree.device, trace, chosen, progress)
        with stage("picture"):
            stats = RenderStats(
                backend=choose_backend(chosen.backend, tree.device),
                rays=hits.alpha.shape[0],
                samples=int(hits.samples.sum(dtype=torch.int64)),
                nodes=tree.nodes.child_tn.numel(),
                bricks=tree.bricks.capacity,
                bytes=tree.nbytes,
                tiles_used=int((tree.nodes.stamp_t == tree.frame).sum()),
                bricks_used=int((tree.bricks.stamp_b == tree.frame).sum()),
            )
            picture = develop(hits, placed, chosen, stats)
    stats.stages = timings.as_dict()
    stats.milliseconds = 1e3 * (time.perf_counter() - start)
    return picture


def render_options(where: str, camera: Camera, options: dict[str, Any]) -> RenderOptions:
    """Checks a user's options, for a camera."""
    unknown = sorted(set(options) - set(RenderOptions.__dataclass_fields__))
    if unknown:
        raise ValueError(
            f"{where}: unknown option {unknown[0]!r}; "
            f"known: {', '.join(RenderOptions.__dataclass_fields__)}"
        )
    chosen = RenderOptions(**options)
    background = checked_background(where, chosen.background)
    if isinstance(background, Background):
        background.check(where, camera)
    layer = chosen.layer and chosen.layer.cut(where, camera)
    return replace(chosen, background=background, layer=layer)


def check_type(where: str, name: str, value: Any, kind: type) -> None:
    """Raises ValueError unless a user's argument is of a class."""
    if not isinstance(value, kind):
        raise ValueError(f"{where}: {name} must be a {kind.__name__}, got {type(value).__name__}")


def check_shader(where: str, name: str, value: Any) -> None:
    """Raises ValueError unless a user's argument is a transfer function or another fused shader."""
    if not isinstance(value, (Shader, TransferFunction)):
        kind = type(value).__name__
        raise ValueError(
            f"{where}: {name} must be a TransferFunction or another shader, got {kind}"
        )


def develop(
    hits: Hits,
    camera: Camera,
    options: RenderOptions,
    stats: RenderStats,
    numbers: Tensor | None = None,
) -> Picture:
    """Puts the hits of a camera's rays over the background, in the camera's shape.

    Args:
        hits: Of all pixels.
        camera: Placed in the world.
        options: What `render_options` gave.
        stats: What the picture cost.
        numbers: What `camera.numbers` gave, where it lies on the device already.
    """
    color, nearest = hits.color, hits.depth
    background: Any = options.background
    if isinstance(background, Background):
        numbers = camera.numbers(color.device) if numbers is None else numbers
        color = color + (1 - hits.alpha) * background.behind(camera, numbers, color.dtype)
    elif background is not None and any(background):
        color = color + (1 - hits.alpha) * _constants(background, color)
    if options.layer is not None:
        layer = options.layer.distance(hits.depth.device).to(hits.depth.dtype)
        nearest = torch.minimum(hits.depth, layer)
    shape = (len(camera), camera.height, camera.width)
    images = {
        "color": color.reshape(*shape, 3),
        "alpha": hits.alpha.reshape(*shape, 1),
        "depth": hits.depth.reshape(*shape, 1),
        "nearest": nearest.reshape(*shape, 1),
        "samples": hits.samples.reshape(*shape, 1),
        "missed": hits.missed.reshape(*shape, 1),
    }
    for name in ("normal", "features"):
        field = getattr(hits, name)
        if field is not None:
            images[name] = field.reshape(*shape, field.shape[1])
    if not camera.batched:
        images = {name: image[0] for name, image in images.items()}
    return Picture(**images, transparent=background is None, stats=stats)


def _constants(numbers: Sequence[float], like: Tensor) -> Tensor:
    """(k,) numbers as arguments of kernels: nothing is copied, so nobody waits for the device."""
    return torch.stack([torch.full((), n, dtype=like.dtype, device=like.device) for n in numbers])


def empty_hits(device: torch.device, dtype: torch.dtype, pixels: int) -> Hits:
    """Takes the memory of a picture."""
    widths = {"color": (3,), "alpha": (1,), "depth": (1,)}
    reals = {n: torch.empty((pixels, *w), dtype=dtype, device=device) for n, w in widths.items()}
    samples = torch.empty(pixels, dtype=torch.int32, device=device)
    return Hits(**reals, samples=samples, missed=torch.empty_like(samples, dtype=torch.bool))


def trace_camera(
    camera: Camera,
    device: torch.device,
    trace_rays: Trace,
    options: RenderOptions,
    progress: Progress,
    *,
    again: tuple[Hits, Tensor] | None = None,
    numbers: Tensor | None = None,
) -> Hits:
    """Traces all rays of a camera, or of a batch, block after block of whole rows: rays take more
    memory than the picture they make.

    Args:
        camera: Placed in the world.
        device: Where the rays are traced.
        trace_rays: Traces world rays.
        options: The dtype of the hits, and the layer that they are mixed with.
        progress: Told how many rows are done.
        again: Hits of an earlier pass, which are overwritten, and which (pixels,) bool of them
            are traced once more.
        numbers: What `camera.numbers` gave, where it lies on the device already.

    Raises:
        ValueError: The picture is larger than the device's memory.
    """
    rows, width = len(camera) * camera.height, camera.width
    block = max(1, _RAYS_A_BLOCK[device.type] // width)
    size = rows * width * (8 * options.dtype.itemsize + 5)  # the colour twice
    check.memory("render", f"a picture of {rows * width} pixels", size, device)
    numbers = camera.numbers(device) if numbers is None else numbers
    layer = None if options.layer is None else options.layer.pixels(device)
    hits, where = again or (None, None)
    if hits is None and rows > block:
        hits = empty_hits(
            device, options.dtype, rows * width
        )  # too large a one fails before the first ray
    for top in range(0, rows, block):
        end = min(top + block, rows)
        pixels: slice | Tensor = slice(top * width, end * width)
        with stage("rays"):
            if where is None:
                rays = camera.pixel_rays(numbers, (top, end))
            else:
                which = where[pixels].nonzero()[:, 0]
                rays = _some_rays(numbers, camera, top, which)
                pixels = which + top * width
        if len(rays.origin):
            with stage("trace"):
                if layer is None:
                    part = trace_rays(rays)
                else:
                    part = layer[pixels].trace(trace_rays, rays, options.stop_alpha)
            if hits is None:
                hits = part  # the only block
            else:
                for name, field in vars(part).items():
                    if field is None:
                        continue
                    if vars(hits)[name] is None:
                        vars(hits)[name] = field.new_empty((rows * width, *field.shape[1:]))
                    vars(hits)[name][pixels] = field
        progress("rays", end, rows)
    assert hits is not None
    return hits


def _some_rays(numbers: Tensor, camera: Camera, top: int, which: Tensor) -> Rays:
    """Rays of the pixels `which` (k,), rising, counted from row `top`: the rows that hold them are
    made, then they alone are kept.
    """
    width = camera.width
    ends = torch.stack((which[0], which[-1])).tolist() if len(which) else (0, -1)
    first, last = (end // width for end in ends)
    rays = camera.pixel_rays(numbers, (top + first, top + last + 1))
    return rays[which - first * width]


def trace(
    tree: N3Tree, rays: Rays, shader: AnyShader, options: RenderOptions | None = None
) -> Hits:
    """Traces any world rays through a tree as one frame.

    Args:
        tree: The tree; its stamps and request words are written.
        rays: Rays in world units, on the tree's device.
        shader: The transfer function, or another shader.
        options: Lod, step and the like; `background` is not used.

    Returns:
        Colour, alpha, depth and samples of each ray, in `options.dtype`.

    Raises:
        ValueError: The channel is unknown, the step too short, or the backend can't be used.
    """
    tree.frame += 1
    chosen = options or RenderOptions()
    return around(tracer_of(tree, shader, chosen), chosen, tree.box)(rays)


def tracer_of(
    tree: N3Tree,
    shader: AnyShader,
    options: RenderOptions,
    **frame: Any,
) -> Tracer | ModuleTracer:
    """Returns what traces a frame of a tree with a shader; `frame` as for `Tracer`.

    Raises:
        ValueError: It is no shader, or see `Tracer`.
    """
    if isinstance(shader, ModuleShader):
        walls = Tracer(tree, shader.walls, options, **frame)
        channel = options.channel or tree.channel_names[0]
        return ModuleTracer(tree, shader, walls.arguments, channel)
    check_shader("render", "shader", shader)
    return Tracer(tree, shader, options, **frame)


class Tracer:
    """One frame of a tree, `tree.frame`: traces any number of batches of rays."""

    def __init__(
        self,
        tree: N3Tree,
        shader: FusedShader,
        options: RenderOptions,
        *,
        by_level: bool = False,
        frame_1: Tensor | None = None,
    ) -> None:
        """Lays the op's arguments ready; see `trace` and, for `by_level`, `trace_rays`. `frame_1`
        (1,) int32 is the frame's number on the device, if it lies there already.
        """
        choose_backend(options.backend, tree.device)
        own = shader if isinstance(shader, Shader) else None
        channel = (own and own.channel) or options.channel or tree.channel_names[0]
        if channel not in tree.bricks.bricks:
            known = ", ".join(tree.channel_names)
            raise ValueError(f"render: unknown channel {channel!r}; the tree has {known}")
        step = options.step * min(tree.spacing)
        most_intervals(float((tree.box[1] - tree.box[0]).norm()), step)
        self.tree = tree
        if frame_1 is None:
            frame_1 = torch.full((1,), tree.frame, dtype=torch.int32, device=tree.device)
        scale = options.cone_scale * tree.flatness if options.lod == "auto" else 0.0
        levels = interval_levels(tree.root_voxel, step) if scale else 1
        intervals = Intervals(
            smallest_spacing=min(tree.spacing), step=step, levels=levels, dtype=options.dtype
        )
        if isinstance(shader, TransferFunction):
            table = vars(shader.table(min(tree.spacing), step, levels, options.dtype, tree.device))
        elif shader.kind is None:
            table = vars(shader.table(tree, intervals))
        else:
            table = shader.arguments("render", tree, intervals)
        component = own.component if own and own.component is not None else options.component
        self.shader = None if own is None or own.kind is None else own
        self.dtype = options.dtype
        self.arguments: dict[str, Any] = {
            "place_33": tree.place,
            "child_tn": tree.nodes.child_tn,
            "brick_tn": tree.nodes.brick_tn,
            "request_tn": tree.nodes.request_tn,
            "stamp_t": tree.nodes.stamp_t,
            "bricks_bzyxc": tree.bricks.bricks[channel],
            "constant_tnc": tree.nodes.constants[channel],
            "range_tn2c": tree.nodes.ranges[channel],
            "stamp_b": tree.bricks.stamp_b,
            **table,
            "frame_1": frame_1,
            "branching": tree.branching,
            "root": tree.root,
            "max_depth": tree.depth,
            "border": tree.bricks.border,
            "component": component,
            "cone_scale": scale,
            "root_voxel": tree.root_voxel,
            "step": step,
            "stop_alpha": options.stop_alpha,
            "depth_alpha": options.depth_alpha,
            "by_level": by_level,
            "backend": options.backend,
        }

    def seeing(self, shader: FusedShader, options: RenderOptions) -> Tracer:
        """Returns what traces the same frame with another shader."""
        frame = {name: self.arguments[name] for name in ("by_level", "frame_1")}
        return Tracer(self.tree, shader, options, **frame)

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units."""
        columns = (rays.origin, rays.direction, rays.cone, rays.range)
        origin, direction, cone, limits = (c.to(torch.float64).contiguous() for c in columns)
        clear = None if rays.clear is None else rays.clear.to(torch.float64).contiguous()
        given = {"width": rays.width, "clear_r": clear, **self.arguments}
        if self.shader is None:
            fields = trace_rays(origin, direction, cone, limits, **given)
            return Hits(**dict(zip(_FIELDS, fields, strict=False)))
        found = shade_rays(
            origin_r3=origin,
            direction_r3=direction,
            cone_r2=cone,
            range_r2=limits,
            parameter_54=self.shader.parameters(self.tree, self.dtype),
            **given,
        )
        return Hits(**dict(zip(_FIELDS, found, strict=True)))


_FIELDS = ("color", "alpha", "depth", "samples", "missed", "normal", "features")


def composite_trees(trees: Sequence[tuple[Tensor, Trace]], rays: Rays) -> Hits:
    """Traces rays through several trees, each a (2, 3) box and what traces it, and puts them one
    over the other, nearest box first.

    Right wherever boxes do not overlap along a ray; where they do, the nearer box as a whole comes
    first.
    """
    near = torch.stack([_entry(box, rays) for box, _ in trees])  # (m, r)
    order = near.argsort(dim=0, stable=True)
    hits = [trace(rays) for _, trace in trees]
    fields = {name: torch.stack([vars(one)[name] for one in hits]) for name in _FIELDS[:5]}
    which = order[:, :, None]
    over = {name: fields[name] for name in ("color", "alpha")}
    for name in ("normal", "features"):
        given = [vars(one)[name] for one in hits if vars(one)[name] is not None]
        if given and len({field.shape[1] for field in given}) > 1:
            raise ValueError("render: trees must give as many features each")
        if given:
            none = torch.zeros_like(given[0])
            found = [vars(one)[name] for one in hits]
            over[name] = torch.stack([none if field is None else field for field in found])
    if "normal" in over:
        over["normal"] = over["normal"] * over["alpha"]
    over = {name: field.gather(0, which.expand_as(field)) for name, field in over.items()}
    depths = fields["depth"].gather(0, which)
    total = {name: field[0] for name, field in over.items()}
    for behind in range(1, len(trees)):
        clear = 1 - total["alpha"]
        total = {name: total[name] + clear * field[behind] for name, field in over.items()}
    if "normal" in total:
        total["normal"] = torch.nn.functional.normalize(total["normal"], dim=1)
    return Hits(
        **total,
        depth=depths.amin(0),
        samples=fields["samples"].sum(0, dtype=torch.int32),
        missed=fields["missed"].any(0),
    )


def _entry(box: torch.Tensor, rays: Rays) -> torch.Tensor:
    """(r,) distance at which rays enter a world box, +inf where they pass it by."""
    low, high = _constants(box.flatten().tolist(), rays.origin).view(2, 3)
    a, b = (low - rays.origin) / rays.direction, (high - rays.origin) / rays.direction
    first, last = torch.fmin(a, b).amax(1), torch.fmax(a, b).amin(1)
    return torch.where(first <= last, first.clamp(min=0), torch.inf)
