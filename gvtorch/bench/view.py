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
from .peers.pages import DIFFERENCES, PAGES, PEER_MODULES, PageSetup, served_page
from .record import Record, summarize
from .scenes import BenchScene, scan_or_fog

_RATES = (25.0, 60.0)  # requested pictures a second
_MOVE_INTERVAL = 1 / 60  # seconds between camera messages, as when a user drags


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
        "page: a client without a browser; ms: from the camera's message to decoded pixels; p95 "
        "ms: 95 % are faster; share: rendered pixels while the camera moves, relative to full "
        "resolution; first ms: to the first picture; rest ms: to the first at full resolution"
    )
    _drag_pages(record, scene, sizes)


def _turn(record: Record, case: str, scene: BenchScene, size: tuple[int, int], rate: float) -> None:
    from ..viewer.server import Server
    from ..viewer.view import new_session

    options: dict[str, Any] = {"device": record.settings.device}
    seconds = 0.5 if record.settings.quick else min(10.0, record.settings.seconds)
    opened = new_session(scene.volume, scene.shader, scene.camera(*size), engine=options)
    with closing(opened) as session, closing(Server(session)) as server:
        delays, first_ms, rest_ms, shares, duration = asyncio.run(
            _client(server.url, size, rate, seconds)
        )
    record.add(
        case,
        "page",
        summarize(delays),
        p95_ms=_p95(delays),
        pictures_per_second=len(delays) / duration,
        share=statistics.median(shares),
        first_ms=first_ms,
        rest_ms=rest_ms,
    )


def _p95(times: list[float]) -> float:
    return sorted(times)[math.ceil(0.95 * len(times)) - 1]


def _drag_pages(record: Record, scene: BenchScene, sizes: tuple[tuple[int, int], ...]) -> None:
    """Measures our page and those of peers in a browser, dragged in the same way."""
    settings = record.settings
    reason = browser.why_no_browser()
    peers = [name for name, module in PEER_MODULES.items() if record.has_peer(name, module, reason)]
    pages = [name for name in PAGES if name.split()[0] in peers]
    if reason:
        record.note(f"measurements in a browser are left out: {reason}")
    if reason or (settings.quick and not pages):
        return
    seconds, jumps = (0.5, 1) if settings.quick else (settings.seconds, 16)
    from playwright.sync_api import Error

    threads = torch.get_num_threads()
    with browser.running_chromium() as chromium:
        for size in ((960, 540),) if settings.quick else sizes:
            case = f"{scene.name}, {size[0]}x{size[1]}, in a browser"
            if not record.wants(case):
                continue
            side = scene.volume.extent[0]
            setup = PageSetup(side=side, size=size, device=str(settings.device), threads=threads)
            for who in ("gvtorch", *pages):
                settings.tell(f"view: {case}: {who}")
                try:
                    with served_page(who, setup) as url:
                        page = browser.Page(chromium, url, PAGES[who][1], size)
                        result = page.drag(seconds, jumps)
                        page.close()
                except (RuntimeError, Error) as error:
                    record.note(f"{case}: {who}: {' '.join(str(error).split())[:120]}")
                    continue
                timing = summarize(result.delays)
                figures = {"p95_ms": _p95(result.delays), "pictures_per_second": result.rate}
                record.add(case, who, timing, **figures, **record.relative_to_first(case, timing))
                record.note(f"{who}: {DIFFERENCES[who]}")
    record.note(
        "in a browser: ms: from a jump of the pointer, after 0.4 s of dragging, to the browser's "
        "first frame that shows it; pictures / s: while the mouse drags; Chromium has no window, "
        "and draws and decodes on the same cores"
    )


async def _client(url: str, size: tuple[int, int], rate: float, seconds: float) -> tuple[Any, ...]:
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
        camera = {n: v for n, v in welcome["state"]["camera"].items() if n != "kind"}
        start = time.perf_counter()
        width, height = size
        await ws.send_json({"type": "hello", "width": width, "height": height, "rate": rate})
        await ws.send_json({"type": "change", "state": {"develop": {"samples": 1}}})

        async def receive_picture() -> tuple[dict[str, Any], tuple[int, int]]:
            while True:
                message = await ws.receive()
                if message.type == aiohttp.WSMsgType.BINARY:
                    break
                if message.type != aiohttp.WSMsgType.TEXT:
                    raise RuntimeError(f"view: the socket closed: {message}")
            (length,) = struct.unpack("<I", message.data[:4])
            header = json.loads(message.data[4 : 4 + length])
            image = Image.open(io.BytesIO(message.data[4 + length :]))
            image.load()
            await ws.send_json({"type": "ack", "number": header["number"]})
            return header, image.size

        first_ms = rest_ms = 0.0
        while True:
            header, shown_size = await receive_picture()
            now = 1e3 * (time.perf_counter() - start)
            first_ms = first_ms or now
            rest_ms = rest_ms or (now if shown_size == size else 0.0)
            if header["final"] and shown_size == size:
                break
        delays, shares = [], []
        turn_start = time.perf_counter()

        async def turn() -> None:
            angle = 0.0
            while (now := time.perf_counter()) < turn_start + seconds:
                angle += 0.01
                turned = {**camera, "eye": _turned_eye(camera, angle)}
                sent = 1e3 * (now - turn_start) + 1e-3
                await ws.send_json({"type": "move", "camera": turned, "moving": True, "sent": sent})
                await asyncio.sleep(_MOVE_INTERVAL)

        turn_task = asyncio.ensure_future(turn())
        while time.perf_counter() < turn_start + seconds:
            header, shown_size = await receive_picture()
            if header["sent"]:
                delays.append(1e3 * (time.perf_counter() - turn_start) - header["sent"])
                shares.append(shown_size[0] * shown_size[1] / (width * height))
        await turn_task
        return delays, first_ms, rest_ms, shares, time.perf_counter() - turn_start


def _turned_eye(camera: dict[str, Any], angle: float) -> list[float]:
    """Returns a camera's eye, turned about +y through its target."""
    x, y, z = (a - b for a, b in zip(camera["eye"], camera["target"], strict=True))
    c, s = math.cos(angle), math.sin(angle)
    turned = (c * x + s * z, y, c * z - s * x)
    return [a + b for a, b in zip(turned, camera["target"], strict=True)]
