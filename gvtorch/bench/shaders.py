"""`shaders`: steady frames of each shader, relative to a simpler one in the same scene."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..base.records import Hits
from ..base.volume import Volume
from ..cpp_ext import compilers
from ..engine.engine import Engine
from ..pictures import Picture
from ..pool import N3Tree
from ..producers import VolumeProducer
from ..shaders import (
    CompiledShader,
    DirectionalLight,
    DistanceField,
    Features,
    Isosurface,
    Lit,
    ModuleShader,
    PreIntegrated,
    Shader,
    StoredColor,
    TransferModule,
)
from ..shaders.built_in import BY_NAME, named_shader
from ..tracing import Lighting, trace
from .march import Size, difference, op_milliseconds, rates, rgba
from .record import Record, clock
from .scenes import BenchScene, aneurism, fog_dense, made, worn

_COMPONENTS = 16  # components of the widest channel
_USER_HEADER = Path(__file__).with_name("own_shader.h")
SUN = DirectionalLight((1.0, -2.0, -1.5), angle=4.0)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A shader with its options, and the name of the variant that it is compared with."""

    name: str
    shader: Callable[[BenchScene], Shader]
    options: Mapping[str, Any] = field(default_factory=dict)  # of `RenderOptions`
    baseline: str = "plain"
    twin: bool = False  # must draw the same picture as `baseline`
    slow: bool = False  # left out of scenes with only one channel
    compiles: bool = False  # left out where there is no compiler


def _built_in(name: str, scene: BenchScene) -> Shader:
    return named_shader(name, scene.shader, scene.surface)


def _module_shader(scene: BenchScene) -> Shader:
    module = TransferModule(scene.shader, min(scene.volume.spacing))
    return ModuleShader(module, hidden_by=scene.shader)


def _user_shader(scene: BenchScene) -> Shader:
    return CompiledShader(_USER_HEADER, "PlainTransfer", transfer=scene.shader)


def _cone_traced(name: str, *, occlusion: float = 0.0, indirect: float = 0.0) -> Variant:
    lighting = Lighting(lights=(SUN,), occlusion=occlusion, indirect=indirect)
    return Variant(
        name=f"isosurface, {name}",
        shader=lambda scene: Isosurface(scene.surface),
        options={"lighting": lighting},
        baseline="isosurface",
    )


#: The measured variants, each after its `baseline`. A variant is left out of scenes that lack a
#: channel of its shader.
VARIANTS = (
    *(Variant(name=name, shader=partial(_built_in, name)) for name in BY_NAME),
    _cone_traced("shadow"),
    _cone_traced("shadow, occlusion", occlusion=1.0),
    _cone_traced("shadow, occlusion, bounce", occlusion=1.0, indirect=1.0),
    Variant(name="lit by stored normals", shader=lambda s: Lit(s.shader, normals="normal")),
    Variant(name="stored colour", shader=lambda _: StoredColor("rgba")),
    Variant(name="stored colour, lit", shader=lambda _: StoredColor("rgba", lit=True)),
    Variant(
        name="lit, shadows per sample",
        shader=lambda s: Lit(s.shader, light=SUN, shadows=True),
        slow=True,
    ),
    Variant(name="distance field", shader=lambda s: DistanceField(offset=s.surface)),
    Variant(name="3 features", shader=lambda s: Features(s.shader, "normal")),
    Variant(name=f"{_COMPONENTS} features", shader=lambda s: Features(s.shader, "numbers")),
    Variant(name="module", shader=_module_shader, twin=True, slow=True),
    Variant(name="user's header", shader=_user_shader, twin=True, slow=True, compiles=True),
    Variant(name="plain, step 1", shader=lambda s: s.shader, options={"step": 1.0}),
    Variant(
        name="pre-integrated, step 1",
        shader=lambda s: PreIntegrated(s.shader),
        options={"step": 1.0},
        baseline="plain, step 1",
    ),
)


@torch.no_grad()
def shaders(record: Record) -> None:
    """Measures each variant in resident trees of three scenes, and in the engine for the first."""
    settings = record.settings
    side, size = 256, (512, 512)
    if settings.quick:
        side, size = 32, (24, 16)
    elif settings.device.type == "cuda":
        size = (1920, 1080)  # fewer rays would not fill the GPU
    for make in (aneurism, fog_dense, worn):  # mostly empty, all sampled, rays that end soon
        scene = made(make, side, record.note)
        if scene is None:
            continue
        volumes = {"value": scene.volume}
        if make is aneurism:
            volumes |= _extra_channels(scene)
        pictures = _measure_resident(record, scene, volumes, size)
        if make is aneurism:
            _measure_streamed(record, scene, volumes, size, pictures)
    record.note(
        "times: relative to the shader in column `beside`, in the same case; max difference: of "
        "module and user's header from the plain picture, of the engine from the resident tree's; "
        "module: a TransferModule, which skips what its function hides; user's header: the plain "
        "function as a CompiledShader; op ms: the compiled op alone"
    )


def _measure_resident(
    record: Record, scene: BenchScene, volumes: Mapping[str, Volume], size: Size
) -> dict[str, Tensor]:
    """Adds the rows of a resident tree; returns the pictures by variant."""
    case = f"{scene.name}, resident, {size[0]}x{size[1]}"
    if not _chosen_variants(record, case):
        return {}
    record.settings.tell(f"{case}: making the tree")
    tree = N3Tree.from_volume(volumes, device=record.settings.device)
    rays = scene.camera(*size).rays(tree.device)

    def render_frame(shader: Shader, **options: Any) -> Hits:
        return trace(tree, rays, shader, **options)

    return _measure(record, case, scene, volumes, render_frame, {})


def _measure_streamed(
    record: Record,
    scene: BenchScene,
    volumes: Mapping[str, Volume],
    size: Size,
    resident: Mapping[str, Tensor],
) -> None:
    """Adds the rows of an engine, each once the picture has converged."""
    case = f"{scene.name}, engine, {size[0]}x{size[1]}"
    if not _chosen_variants(record, case):
        return
    camera, quick = scene.camera(*size), record.settings.quick
    pools = ("1 MB", "4 MB") if quick else ("16 MB", "1 GB")
    with Engine(
        VolumeProducer(volumes),
        node_pool=pools[0],
        brick_pool=pools[1],
        device=record.settings.device,
        monitor=False,
    ) as engine:

        def render_frame(shader: Shader, **options: Any) -> Picture:
            return engine.frame(camera, shader, background=None, **options)[0]

        def converge(shader: Shader, **options: Any) -> None:
            engine.render(camera, shader, background=None, **options)
            if not engine.frame(camera, shader, background=None, **options)[1].converged:
                record.note(f"{case}: the picture had not converged when it was timed")

        _measure(record, case, scene, volumes, render_frame, resident, converge)


def _measure(
    record: Record,
    case: str,
    scene: BenchScene,
    channels: Collection[str],
    render_frame: Callable[..., Hits | Picture],
    expected: Mapping[str, Tensor],
    prepare: Callable[..., object] | None = None,
) -> dict[str, Tensor]:
    """Adds a row for each chosen variant that the channels allow; returns the pictures (r, 4) by
    variant. `render_frame` renders with a shader and options, `prepare` is called before it is
    timed, and `expected` are pictures by variant that are compared with those of this case.
    """
    medians: dict[str, float] = {}
    pictures: dict[str, Tensor] = {}
    for variant in _chosen_variants(record, case):
        if variant.compiles and not _can_compile(record.settings.device):
            record.note(f"{variant.name}: left out, no compiler for {record.settings.device}")
            continue
        shader = variant.shader(scene)
        if not set(shader.channels) <= set(channels) or (variant.slow and len(channels) == 1):
            continue
        if isinstance(shader, ModuleShader):
            shader.to(record.settings.device)
        record.settings.tell(f"{case}: {variant.name}")
        options = {"step": scene.step, **variant.options}
        if prepare is not None:
            prepare(shader, **options)
        run = partial(render_frame, shader, **options)
        timing = clock(run, record.settings)
        rendered = timing.last  # not rendered again: a module takes long
        medians[variant.name], pictures[variant.name] = timing.median, rgba(rendered)
        figures = {"beside": variant.baseline, "times": timing.median / medians[variant.baseline]}
        figures |= rates(rendered, timing)
        figures["op_ms"] = None if shader.uses_torch else op_milliseconds(run, record.settings)
        target = expected.get(variant.name, pictures[variant.baseline] if variant.twin else None)
        if target is not None:
            figures["max_difference"] = difference(pictures[variant.name], target)["max_difference"]
        record.add(case, variant.name, timing, **figures)
    return pictures


def _can_compile(device: torch.device) -> bool:
    """Returns whether a header can be compiled for a device."""
    host = shutil.which(compilers.find_cxx()[0])
    return bool(host and (device.type == "cpu" or compilers.find_nvcc()))


def _chosen_variants(record: Record, case: str) -> list[Variant]:
    """Returns the variants of a case that are to be run, and those that they are compared with."""
    names = {variant.name for variant in VARIANTS if record.wants(f"{case}, {variant.name}")}
    for variant in reversed(VARIANTS):
        if variant.name in names:
            names.add(variant.baseline)
    return [variant for variant in VARIANTS if variant.name in names]


def _extra_channels(scene: BenchScene) -> dict[str, Volume]:
    """Returns normals, colours and numbers computed from voxel values: constant where these are."""
    value = scene.volume.data[..., 0].float()
    normal = torch.nn.functional.normalize(torch.stack(torch.gradient(value)[::-1], -1), dim=-1)
    color = torch.from_numpy(scene.shader(value.numpy()))
    color[..., :3] *= color[..., 3:] > 0
    numbers = (value[..., None] * torch.arange(1.0, _COMPONENTS + 1, device="cpu")).remainder(256)
    channels = {"normal": 255 * (0.5 + 0.5 * normal), "rgba": 255 * color, "numbers": numbers}
    return {name: Volume(data.round().to(torch.uint8)) for name, data in channels.items()}
