"""Rays through resident trees, compared with peers that render the same picture: `march`,
`first_hit`, `calls` (little work per call) and `bricks` (a sweep of brick sizes).
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ..base.records import Hits, RenderStats
from ..cameras import Camera
from ..io.resources import memory_free
from ..pictures import Picture
from ..pool import N3Tree
from ..tracing import render, trace
from .peers.peer import Peer, Task, find_peers
from .record import Record, Settings, Timing, clock, time_once
from .scenes import SCENES, BenchScene, made, shell_sparse

_STOP_ALPHA = 0.99
Size = tuple[int, int]


def march(record: Record) -> None:
    """Measures all scenes at two sizes, with the finest level and levels by cone, and the peers."""
    quick = record.settings.quick
    sizes = [(24, 16)] if quick else [(512, 512), (1920, 1080)]
    peers = find_peers(record)
    for name, make in SCENES.items():
        chosen_sizes = [size for size in sizes if record.wants(_case_name(name, size))]
        if name == "clouds":
            chosen_sizes = chosen_sizes[:1]
        if not chosen_sizes:
            continue
        record.settings.tell(f"march: making {name}")
        scene = made(make, 32 if quick else 256, record.note)
        if scene is None:
            continue
        tree = N3Tree.from_volume(scene.volume, device=record.settings.device)
        for size in chosen_sizes:
            _compare(record, scene, tree, size, peers, ("finest", "auto"))
    record.note(
        "gvtorch auto: levels of detail chosen by the width of each ray's cone; differences are "
        "from the finest level's picture, over colour and alpha; op ms: the compiled op alone; ms: "
        "all of `trace`; times: relative to the case's first row"
    )


def first_hit(record: Record) -> None:
    """Measures a shell so opaque that a ray ends in the first voxel it meets."""
    quick = record.settings.quick
    size = (24, 16) if quick else (1920, 1080)
    scene = replace(shell_sparse(32 if quick else 256), name="first hit")
    peers = find_peers(record)
    if record.wants(_case_name(scene.name, size)):
        tree = N3Tree.from_volume(scene.volume, device=record.settings.device)
        _compare(record, scene, tree, size, peers, ("finest",))


def calls(record: Record) -> None:
    """Measures pictures of a thin shell so small that the overhead of a call dominates."""
    settings = record.settings
    count, small_side = (3, 8) if settings.quick else (1000, 64)
    scene = shell_sparse(32 if settings.quick else 64)
    tree = N3Tree.from_volume(scene.volume, device=settings.device)
    for side in (1, small_side):
        case = f"one picture, {side}x{side}"
        if not record.wants(case):
            continue
        camera = scene.camera(side, side)
        rays = camera.rays(settings.device)
        for who, run in (
            ("render", partial(render, tree, camera, scene.shader)),
            ("trace", partial(trace, tree, rays, scene.shader)),
        ):
            settings.tell(f"{case}: {who}")
            timing = clock(run, settings, calls=1 if settings.quick else 100)
            record.add(case, who, timing, op_ms=op_milliseconds(run, settings))
    case = f"{count:,} pictures, {small_side}x{small_side}"
    if not record.wants(case):
        return
    settings.tell(case)
    angles = torch.linspace(0, 360, count + 1, dtype=torch.float64, device="cpu")[:-1]
    cameras = Camera.orbit(angles, 20, 2.0, 30, small_side, small_side).placed(scene.box)
    single_cameras = [cameras[n] for n in range(count)]
    one_batch = partial(render, tree, cameras, scene.shader)

    def one_by_one() -> list[Picture]:
        return [render(tree, camera, scene.shader) for camera in single_cameras]

    singles = torch.stack([picture.color for picture in one_by_one()])
    same = bool(torch.equal(one_batch().color, singles))
    timings = {"one by one": clock(one_by_one, settings), "one batch": clock(one_batch, settings)}
    for who, timing in timings.items():
        times = timing.median / timings["one by one"].median
        record.add(case, who, timing, times=times, same=same)


def bricks(record: Record) -> None:
    """Measures the finest level of three scenes for every brick size and border."""
    quick, device = record.settings.quick, record.settings.device
    size = (24, 16) if quick else (512, 512)
    for name in ("fog dense", "shell sparse", "aneurism"):
        scene, first_picture = None, None
        for brick_size in (4, 8, 16, 32):
            for border in (1, 0, 2):  # 1 first: the others are compared with it
                case = f"{name}, {brick_size}^3 + {border}"
                if not record.wants(case):
                    continue
                record.settings.tell(f"bricks: {case}")
                scene = scene or SCENES[name](32 if quick else 256)
                needed_bytes = _tree_bytes(scene, brick_size, border)
                if needed_bytes > _memory_free(device):
                    record.note(f"{case}: left out, the tree may take {needed_bytes / 1e9:.1f} GB")
                    continue
                tree = N3Tree.from_volume(scene.volume, brick_size, border, device=device)
                camera = scene.camera(*size)
                run = _trace_call(tree, scene, camera, "finest", device)
                hits = run()
                picture = rgba(hits)
                first_picture = picture if first_picture is None else first_picture
                timing = clock(run, record.settings)
                sizes = {"scene": name, "brick_size": brick_size, "border": border}
                memory = {"tree_bytes": tree.nbytes, "bricks": tree.bricks.capacity}
                figures = sizes | rates(hits, timing) | difference(picture, first_picture) | memory
                record.add(case, "gvtorch", timing, **figures)
    record.note("differences are from the picture of the scene's first row")


def _case_name(name: str, size: Size) -> str:
    return f"{name}, {size[0]}x{size[1]}"


def _compare(
    record: Record,
    scene: BenchScene,
    tree: N3Tree,
    size: Size,
    peers: dict[str, type[Peer]],
    lods: tuple[str, ...],
) -> None:
    """Adds a row for each level of detail, then one for each peer."""
    settings, case = record.settings, _case_name(scene.name, size)
    device, camera = settings.device, scene.camera(*size)
    finest = torch.empty(0, device="cpu")
    for lod in lods:
        who = "gvtorch" if lod == "finest" else f"gvtorch {lod}"
        settings.tell(f"{case}: {who}")
        run = _trace_call(tree, scene, camera, lod, device)
        hits = run()
        timing = clock(run, settings)
        figures = rates(hits, timing) | {"op_ms": op_milliseconds(run, settings)}
        figures |= record.relative_to_first(case, timing)
        picture = rgba(hits)
        if lod == "finest":
            finest = picture
        else:
            figures |= difference(picture, finest)
        record.add(case, who, timing, **figures)
        _save(record, picture, f"{case} {who}", size)
    rays = camera.rays(device)
    task = Task(scene=scene, camera=camera, rays=rays, stop_alpha=_STOP_ALPHA, device=device)
    for name, peer_class in peers.items():
        settings.tell(f"{case}: {name}")
        peer = peer_class(task)
        timing = clock(peer.render, settings)
        picture = peer.picture().cpu()
        figures = {"rays_per_second": 1e3 * len(picture) / timing.median}
        figures |= record.relative_to_first(case, timing) | difference(picture, finest)
        record.add(case, name, timing, **figures)
        _save(record, picture, f"{case} {name}", size)


def _trace_call(
    tree: N3Tree, scene: BenchScene, camera: Camera, lod: str, device: torch.device
) -> Callable[[], Hits]:
    """Returns the call that is timed; its rays are made here."""
    rays = camera.rays(device)
    options: Any = {"lod": lod, "step": scene.step, "stop_alpha": _STOP_ALPHA}
    return lambda: trace(tree, rays, scene.shader, **options)


def rates(hits: Hits | Picture, timing: Timing) -> dict[str, Any]:
    """Returns the samples of one call, and its samples and rays per second."""
    samples = int(hits.samples.sum(dtype=torch.int64))
    return {
        "samples": samples,
        "samples_per_second": 1e3 * samples / timing.median,
        "rays_per_second": 1e3 * hits.samples.numel() / timing.median,
    }


def rgba(hits: Hits | Picture) -> Tensor:
    """Returns (r, 4) float32 colour and alpha on the CPU."""
    return torch.cat((hits.color, hits.alpha), -1).reshape(-1, 4).float().cpu()


def difference(picture: Tensor, other: Tensor) -> dict[str, float]:
    """Returns the largest, mean and rms difference of two pictures of one shape."""
    deviation = (picture - other).double().abs()
    return {
        "max_difference": float(deviation.max()),
        "mean_difference": float(deviation.mean()),
        "rms_difference": float(deviation.square().mean().sqrt()),
    }


def op_milliseconds(run: Callable[[], object], settings: Settings) -> float | None:
    """Returns median milliseconds inside the op of a fused shader; None if none is called."""
    with _OpTimer(settings.device) as timer:
        began = time.perf_counter()
        for _ in range(settings.repeats):
            run()
            if time.perf_counter() - began > settings.seconds:
                break
    return statistics.median(timer.times) if timer.times else None


class _OpTimer(TorchDispatchMode):
    """Times a fused shader's op whenever it is called."""

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.device = device
        self.times: list[float] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        call = partial(func, *args, **(kwargs or {}))
        if func.name() not in ("gvtorch::trace_rays", "gvtorch::shade_rays"):
            return call()
        milliseconds, result = time_once(call, self.device)
        self.times.append(milliseconds)
        return result


def _tree_bytes(scene: BenchScene, brick_size: int, border: int) -> int:
    """Returns an upper bound: all bricks of all levels, and the float32 pyramid they come from."""
    x, y, z = scene.volume.extent
    brick = (brick_size + 2 * border) ** 3
    cells = -(-x // brick_size) * -(-y // brick_size) * -(-z // brick_size)
    return (brick + 100) * cells * 8 // 7 + 40 * x * y * z


def _memory_free(device: torch.device) -> int:
    free = memory_free()
    return min(free, torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else free


def _save(record: Record, picture: Tensor, name: str, size: Size) -> None:
    folder = record.settings.pictures
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    image = picture.reshape(size[1], size[0], 4)
    zeros = torch.zeros_like(image[..., 3:])
    Picture(
        color=image[..., :3],
        alpha=image[..., 3:],
        depth=zeros,
        nearest=zeros,
        samples=zeros.int(),
        stats=RenderStats(),
    ).save(folder / f"{name.replace(', ', ' ').replace(' ', '_')}.png")
