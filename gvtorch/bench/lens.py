"""`lens`: what depth of field costs in the engine, aperture by aperture."""

from __future__ import annotations

from functools import partial

from ..cameras import Camera
from ..engine.engine import Engine
from ..producers import VolumeProducer
from ..tracing import ThinLens
from .frames import until_converged
from .record import Record, clock
from .scenes import worn

_APERTURES = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8)  # in largest sides of the box
_FOCUS = 0.9  # in the same unit; a little in front of the box's middle


def lens(record: Record) -> None:
    """Measures steady frames of the worn sphere from nearby, and what is loaded before them."""
    settings = record.settings
    side, (width, height) = (32, (24, 16)) if settings.quick else (512, (1280, 720))
    settings.tell("lens: making the worn sphere")
    scene = worn(side)
    camera = Camera.orbit(30, 20, 1.1, 45, width, height)
    pools = ("1 MB", "2 MB") if settings.quick else ("16 MB", "384 MB")
    for aperture in _APERTURES:
        case = f"aperture {aperture:g}, {scene.name} {side}^3, {width}x{height}"
        if not record.wants(case):
            continue
        settings.tell(case)
        thin_lens = ThinLens(aperture=aperture, focus=_FOCUS, frame="box") if aperture else None
        producer = VolumeProducer(scene.volume)
        with Engine(
            producer,
            node_pool=pools[0],
            brick_pool=pools[1],
            device=settings.device,
            monitor=False,
        ) as engine:
            render_frame = partial(engine.frame, camera, scene.shader, lens=thin_lens)
            loaded, moved = 0, 0
            for _, stats in until_converged(render_frame):
                loaded, moved = loaded + stats.produced["bricks"], moved + stats.bytes_uploaded
            if not stats.converged:
                record.note(f"{case}: the picture had not converged when it was timed")
            timings = {"gvtorch": clock(render_frame, settings)}
            _, last_stats = timings["gvtorch"].last
            if settings.device.type == "cuda":
                graph = engine.capture(camera, scene.shader, lens=thin_lens)
                timings["captured"] = clock(partial(graph.replay, camera), settings, calls=20)
            brick_bytes = engine.memory()["brick_pool"] // engine.cache.bricks.capacity
        for who, timing in timings.items():
            record.add(
                *(case, who, timing),
                aperture=aperture,
                samples=last_stats.samples,
                bricks=last_stats.bricks_used,
                brick_bytes=last_stats.bricks_used * brick_bytes,
                loaded=loaded,
                moved_bytes=moved,
            )
    record.note(
        "aperture: the lens's diameter relative to the box's largest side (0: no lens), focused at "
        "0.9 sides; bricks: used by a frame that loads nothing; loaded: until the picture converged"
    )
    if settings.device.type == "cuda":
        record.note("captured: replayed as a CUDA graph, so that the host does not limit a frame")
