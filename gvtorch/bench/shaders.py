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
from ..shaders.built_in import BY_NAME
from ..tracing import Lighting, trace
from .march import Size, difference, op_milliseconds, rates, rgba
from .record import Record, clock
from .scenes import BenchScene, aneurism, fog_dense, worn

_WIDE = 16  # components of the widest channel
_OWN = Path(__file__).with_name("own_shader.h")
SUN = DirectionalLight((1.0, -2.0, -1.5), angle=4.0)


@dataclass(frozen=True, kw_only=True)
class ShaderCase:
    """A shader with its options (a look), and the name of the look that it is compared with."""

    name: str
    shader: Callable[[BenchScene], Shader]
    options: Mapping[str, Any] = field(default_factory=dict)  # of `RenderOptions`
    beside: str = "plain"
    twin: bool = False  # must draw the same picture as `beside`
    slow: bool = False  # left out of scenes with only one channel
    compiles: bool = False  # left out where there is no compiler


def _named(name: str, scene: BenchScene) -> Shader:
    return BY_NAME[name](scene.shader, scene.surface)


def _module(scene: BenchScene) -> Shader:
    module = TransferModule(scene.shader, min(scene.volume.spacing))
    return ModuleShader(module, hidden_by=scene.shader)


def _own(scene: BenchScene) -> Shader:
    return CompiledShader(_OWN, "Own", transfer=scene.shader)


def _cones(name: str, *, occlusion: float = 0.0, indirect: float = 0.0) -> ShaderCase:
    light = Lighting(lights=(SUN,), occlusion=occlusion, indirect=indirect)
    return ShaderCase(
        name=f"isosurface, {name}",
        shader=lambda scene: Isosurface(scene.surface),
        options={"lighting": light},
        beside="isosurface",
    )


#: The measured looks, each after the look in its `beside`. A look is left out of scenes that lack
#: a channel of its shader.
LOOKS = (
    *(ShaderCase(name=name, shader=partial(_named, name)) for name in BY_NAME),
    _cones("shadow"),
    _cones("shadow, occlusion", occlusion=1.0),
    _cones("shadow, occlusion, bounce", occlusion=1.0, indirect=1.0),
    ShaderCase(name="lit by stored normals", shader=lambda s: Lit(s.shader, normals="normal")),
    ShaderCase(name="stored colour", shader=lambda _: StoredColor("rgba")),
    ShaderCase(name="stored colour, lit", shader=lambda _: StoredColor("rgba", lit=True)),
    ShaderCase(
        name="lit, shadows per sample",
        shader=lambda s: Lit(s.shader, light=SUN, shadows=True),
        slow=True,
    ),
    ShaderCase(name="distance field", shader=lambda s: DistanceField(offset=s.surface)),
    ShaderCase(name="3 features", shader=lambda s: Features(s.shader, "normal")),
    ShaderCase(name=f"{_WIDE} features", shader=lambda s: Features(s.shader, "numbers")),
    ShaderCase(name="module", shader=_module, twin=True, slow=True),
    ShaderCase(name="user's header", shader=_own, twin=True, slow=True, compiles=True),
    ShaderCase(name="plain, step 1", shader=lambda s: s.shader, options={"step": 1.0}),
    ShaderCase(
        name="pre-integrated, step 1",
        shader=lambda s: PreIntegrated(s.shader),
        options={"step": 1.0},
        beside="plain, step 1",
    ),
)


@torch.no_grad()
def shaders(record: Record) -> None:
    """Measures each look in resident trees of three scenes, and in the engine for the first."""
    settings = record.settings
    side, size = 256, (512, 512)
    if settings.quick:
        side, size = 32, (24, 16)
    elif settings.device.type == "cuda":
        size = (1920, 1080)  # fewer rays would not fill the GPU
    for make in (aneurism, fog_dense, worn):  # mostly empty, all sampled, rays that end soon
        try:
            scene = make(side)
        except FileNotFoundError:
            record.note("aneurism: left out, its file comes with the source and is not here")
            continue
        volumes = {"value": scene.volume}
        if make is aneurism:
            volumes |= _channels(scene)
        pictures = _resident(record, scene, volumes, size)
        if make is aneurism:
            _streamed(record, scene, volumes, size, pictures)
    record.note(
        "times: of the look named beside, in the same case. Differences: of the module from the "
        "plain picture, of the engine from the resident tree's. module: TransferModule, hidden by "
        "its function. user's header: the plain function as a CompiledShader. op_ms: the op alone"
    )


def _resident(
    record: Record, scene: BenchScene, volumes: Mapping[str, Volume], size: Size
) -> dict[str, Tensor]:
    """Adds the rows of a resident tree; returns the pictures by look."""
    case = f"{scene.name}, resident, {size[0]}x{size[1]}"
    if not _wanted(record, case):
        return {}
    record.settings.tell(f"{case}: making the tree")
    tree = N3Tree.from_volume(volumes, device=record.settings.device)
    rays = scene.camera(*size).rays(tree.device)

    def frame(shader: Shader, **options: Any) -> Hits:
        return trace(tree, rays, shader, **options)

    return _measure(record, case, scene, volumes, frame, {})


def _streamed(
    record: Record,
    scene: BenchScene,
    volumes: Mapping[str, Volume],
    size: Size,
    resident: Mapping[str, Tensor],
) -> None:
    """Adds the rows of an engine, each once the picture has converged."""
    case = f"{scene.name}, engine, {size[0]}x{size[1]}"
    if not _wanted(record, case):
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

        def frame(shader: Shader, **options: Any) -> Picture:
            return engine.frame(camera, shader, background=None, **options)[0]

        def converge(shader: Shader, **options: Any) -> None:
            engine.render(camera, shader, background=None, **options)
            if not engine.frame(camera, shader, background=None, **options)[1].converged:
                record.note(f"{case}: it was not steady")

        _measure(record, case, scene, volumes, frame, resident, converge)


def _measure(
    record: Record,
    case: str,
    scene: BenchScene,
    channels: Collection[str],
    frame: Callable[..., Hits | Picture],
    others: Mapping[str, Tensor],
    prepare: Callable[..., object] | None = None,
) -> dict[str, Tensor]:
    """Adds a row for each look that is wanted and that the channels allow; returns the pictures
    (r, 4) by look. `frame` renders one frame with a shader and options, `prepare` is called before
    it is timed, and `others` are pictures by look that are compared with those of this case.
    """
    medians: dict[str, float] = {}
    pictures: dict[str, Tensor] = {}
    for look in _wanted(record, case):
        if look.compiles and not _compiles(record.settings.device):
            record.note(f"{look.name}: left out, there is no compiler for {record.settings.device}")
            continue
        shader = look.shader(scene)
        if not set(shader.channels) <= set(channels) or (look.slow and len(channels) == 1):
            continue
        if isinstance(shader, ModuleShader):
            shader.to(record.settings.device)
        record.settings.tell(f"{case}: {look.name}")
        options = {"step": scene.step, **look.options}
        if prepare is not None:
            prepare(shader, **options)
        run = partial(frame, shader, **options)
        timing = clock(run, record.settings)
        shown = timing.last  # not rendered again: a module takes long
        medians[look.name], pictures[look.name] = timing.median, rgba(shown)
        figures = {"beside": look.beside, "times": timing.median / medians[look.beside]}
        figures |= rates(shown, timing)
        figures["op_ms"] = None if shader.uses_torch else op_milliseconds(run, record.settings)
        other = others.get(look.name, pictures[look.beside] if look.twin else None)
        if other is not None:
            figures["max_difference"] = difference(pictures[look.name], other)["max_difference"]
        record.add(case, look.name, timing, **figures)
    return pictures


def _compiles(device: torch.device) -> bool:
    """Returns whether a header can be compiled for a device."""
    host = shutil.which(compilers.find_cxx()[0])
    return bool(host and (device.type == "cpu" or compilers.find_nvcc()))


def _wanted(record: Record, case: str) -> list[ShaderCase]:
    """Returns the looks of a case that are wanted, and those that they are compared with."""
    names = {look.name for look in LOOKS if record.wants(f"{case}, {look.name}")}
    for look in reversed(LOOKS):
        if look.name in names:
            names.add(look.beside)
    return [look for look in LOOKS if look.name in names]


def _channels(scene: BenchScene) -> dict[str, Volume]:
    """Returns normals, colours and numbers computed from voxel values: constant where these are."""
    value = scene.volume.data[..., 0].float()
    normal = torch.nn.functional.normalize(torch.stack(torch.gradient(value)[::-1], -1), dim=-1)
    color = torch.from_numpy(scene.shader(value.numpy()))
    color[..., :3] *= color[..., 3:] > 0
    numbers = (value[..., None] * torch.arange(1.0, _WIDE + 1)).remainder(256)
    channels = {"normal": 255 * (0.5 + 0.5 * normal), "rgba": 255 * color, "numbers": numbers}
    return {name: Volume(data.round().to(torch.uint8)) for name, data in channels.items()}
