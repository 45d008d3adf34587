"""`view`: the viewer's pictures a second, and its latency from a camera move to the picture,
compared with peers."""

from __future__ import annotations

import asyncio
import io
import json
import math
import statistics
import struct
import time
from contextlib import closing
from typing import Any

import torch

from . import Unavailable, browser
from .peers.pages import DIFFERS, NEEDS, PAGES, Site, served
from .record import Record, spread
from .scenes import BenchScene, scan_or_fog

_RATES = (25.0, 60.0)  # requested pictures a second
_HELD = 1 / 60  # seconds between camera messages, as when a user drags


def view(record: Record) -> None:
    """Measures a client that turns a scan for some seconds over a local websocket."""
    try:
        import aiohttp  # noqa: F401
        import PIL  # noqa: F401
    except ImportError as error:
        raise Unavailable(f"view needs {error.name}: pip install 'gvtorch[view]'") from None
    quick = record.settings.quick
    scene = scan_or_fog(32 if quick else 256, record.note)
    sizes = ((48, 32),) if quick else ((960, 540), (1920, 1080))
    for size in sizes:
        for rate in _RATES[:1] if quick else _RATES:
            case = f"{scene.name}, {size[0]}x{size[1]}, {rate:g} wanted"
            if record.wants(case):
                record.settings.tell(f"view: {case}")
                _turn(record, case, scene, size, rate)
    record.note(
        "ms: from the camera's message to decoded pixels, of a page without a browser; p95 of the "
        "same; share: of the pixels that were rendered while it moved; first: to the first picture "
        "of a page, rest: until the first at full resolution"
    )
    _beside(record, scene, sizes)


def _turn(record: Record, case: str, scene: BenchScene, size: tuple[int, int], rate: float) -> None:
    from ..viewer.server import Server
    from ..viewer.view import new_session

    options: dict[str, Any] = {"device": record.settings.device}
    seconds = 0.5 if record.settings.quick else min(10.0, record.settings.seconds)
    opened = new_session(scene.volume, scene.shader, scene.camera(*size), engine=options)
    with closing(opened) as session, closing(Server(session)) as server:
        waited, first, rest, shares, lasted = asyncio.run(_page(server.url, size, rate, seconds))
    record.add(
        case,
        "page",
        spread(waited),
        p95_ms=_p95(waited),
        pictures_per_second=len(waited) / lasted,
        share=statistics.median(shares),
        first_ms=first,
        rest_ms=rest,
    )


def _p95(times: list[float]) -> float:
    return sorted(times)[math.ceil(0.95 * len(times)) - 1]


def _beside(record: Record, scene: BenchScene, sizes: tuple[tuple[int, int], ...]) -> None:
    """Measures our page and those of peers in a browser, dragged in the same way."""
    settings = record.settings
    why = browser.absent()
    peers = [name for name, module in NEEDS.items() if record.has_peer(name, module, why)]
    shown = [one for one in PAGES if one.split()[0] in peers]
    if why:
        record.note(f"in a browser: left out, {why}")
    if why or (settings.quick and not shown):
        return
    seconds, jumps = (0.5, 1) if settings.quick else (settings.seconds, 16)
    from playwright.sync_api import Error

    threads = torch.get_num_threads()
    with browser.running() as chromium:
        for size in ((960, 540),) if settings.quick else sizes:
            case = f"{scene.name}, {size[0]}x{size[1]}, in a browser"
            if not record.wants(case):
                continue
            side = scene.volume.extent[0]
            site = Site(side=side, size=size, device=str(settings.device), threads=threads)
            for who in ("gvtorch", *shown):
                settings.tell(f"view: {case}: {who}")
                try:
                    with served(who, site) as url:
                        page = browser.Page(chromium, url, PAGES[who][1], size)
                        seen = page.drag(seconds, jumps)
                        page.close()
                except (RuntimeError, Error) as error:
                    record.note(f"{case}: {who}: {' '.join(str(error).split())[:120]}")
                    continue
                timing = spread(seen.waited)
                rate = {"p95_ms": _p95(seen.waited), "pictures_per_second": seen.rate}
                record.add(case, who, timing, **rate, **record.beside_first(case, timing))
                record.note(f"{who}: {DIFFERS[who]}")
    record.note(
        "in a browser: ms from a jump of the pointer, after 0.4 s of dragging, to the first of the "
        "browser's frames that shows it; pictures / s while it drags; Chromium without a window, "
        "which draws and decodes on the same cores"
    )


async def _page(url: str, size: tuple[int, int], rate: float, seconds: float) -> tuple[Any, ...]:
    """Acts as a page does: waits until the picture is final, then turns the camera. Returns the
    milliseconds of each picture, of the first one and of the first at full resolution, the share of
    the pixels that each picture has, and the seconds of turning.
    """
    import aiohttp
    from PIL import Image

    address, _, query = url.partition("?")
    async with (
        aiohttp.ClientSession() as client,
        client.ws_connect(f"{address}ws?{query}", max_msg_size=0) as ws,
    ):
        welcome = json.loads(await ws.receive_str())
        eye = {n: v for n, v in welcome["state"]["camera"].items() if n != "kind"}
        start = time.perf_counter()
        width, height = size
        await ws.send_json({"type": "hello", "width": width, "height": height, "rate": rate})
        await ws.send_json({"type": "change", "state": {"develop": {"samples": 1}}})

        async def picture() -> tuple[dict[str, Any], tuple[int, int]]:
            while True:
                message = await ws.receive()
                if message.type == aiohttp.WSMsgType.BINARY:
                    break
                if message.type != aiohttp.WSMsgType.TEXT:
                    raise RuntimeError(f"view: the socket closed: {message}")
            (length,) = struct.unpack("<I", message.data[:4])
            head = json.loads(message.data[4 : 4 + length])
            image = Image.open(io.BytesIO(message.data[4 + length :]))
            image.load()
            await ws.send_json({"type": "ack", "number": head["number"]})
            return head, image.size

        first = rest = 0.0
        while True:
            head, shown = await picture()
            now = 1e3 * (time.perf_counter() - start)
            first = first or now
            rest = rest or (now if shown == size else 0.0)
            if head["final"] and shown == size:
                break
        waited, shares = [], []
        begun = time.perf_counter()

        async def turn() -> None:
            angle = 0.0
            while (now := time.perf_counter()) < begun + seconds:
                angle += 0.01
                camera = {**eye, "eye": _around(eye, angle)}
                sent = 1e3 * (now - begun) + 1e-3
                await ws.send_json({"type": "move", "camera": camera, "moving": True, "sent": sent})
                await asyncio.sleep(_HELD)

        hand = asyncio.ensure_future(turn())
        while time.perf_counter() < begun + seconds:
            head, shown = await picture()
            if head["sent"]:
                waited.append(1e3 * (time.perf_counter() - begun) - head["sent"])
                shares.append(shown[0] * shown[1] / (width * height))
        await hand
        return waited, first, rest, shares, time.perf_counter() - begun


def _around(eye: dict[str, Any], angle: float) -> list[float]:
    """Returns the eye, turned about +y through the target."""
    x, y, z = (a - b for a, b in zip(eye["eye"], eye["target"], strict=True))
    c, s = math.cos(angle), math.sin(angle)
    turned = (c * x + s * z, y, c * z - s * x)
    return [a + b for a, b in zip(turned, eye["target"], strict=True)]
