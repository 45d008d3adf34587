"""Pages that show the bench's scan, each served by its own process: ours, viser's and trame's.

Each function of `PAGES` sends the address of its page into a pipe, and serves until its process
ends. A peer is used as in its own examples; `DIFFERS` states how its page differs from ours.
"""

from __future__ import annotations

import contextlib
import io
import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch

from ..scenes import BenchScene, scan_or_fog

_RATE = 25.0  # requested pictures a second while the camera moves
_STARTS = 120.0  # seconds within which a page must be served


@dataclass(frozen=True, kw_only=True)
class Site:
    """What a page shows, and what renders it."""

    side: int  # voxels a side of the scan
    size: tuple[int, int]  # (width, height) pixels of the picture
    device: str  # where gvtorch renders
    threads: int  # CPU threads of the page's process


def gvtorch_page(site: Site, ready: Connection) -> None:
    """Serves our viewer, as `gvtorch view` does."""
    from ...viewer.server import Server
    from ...viewer.view import new_session

    scene = scan_or_fog(site.side)
    session = new_session(
        scene.volume, scene.shader, scene.camera(*site.size), engine={"device": site.device}
    )
    develop = replace(session.state.develop, samples=1)  # so that it comes to rest soon
    session.state = replace(session.state, develop=develop)
    ready.send(Server(session).url)
    threading.Event().wait()


def _viser(site: Site, ready: Connection) -> tuple[Any, BenchScene]:
    """Starts viser's server with the scene's camera and nothing else in the picture."""
    import viser

    scene = scan_or_fog(site.side)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server.scene.world_axes.visible = False
    view = scene.camera(*site.size).viewmats[0]
    eye = -view[:3, :3].T @ view[:3, 3]
    first = server.initial_camera
    first.position, first.look_at = tuple(eye.tolist()), tuple(scene.box.mean(0).tolist())
    first.up, first.fov = (0.0, 1.0, 0.0), float(np.radians(30))
    ready.send(f"http://127.0.0.1:{server.get_port()}")
    return server, scene


def viser_pictures(site: Site, ready: Connection) -> None:
    """Serves viser's page with gvtorch's pictures as background, each rendered at full resolution
    from the latest camera of the page.
    """
    from ...cameras import Camera
    from ...pool import N3Tree
    from ...tracing import render

    moved = threading.Event()
    server, scene = _viser(site, ready)
    tree = N3Tree.from_volume(scene.volume).to(site.device)

    @server.on_client_connect
    def _(client: Any) -> None:
        client.camera.on_update(lambda _: moved.set())
        moved.set()

    while True:
        moved.wait()
        moved.clear()
        for client in server.get_clients().values():
            at = client.camera
            camera = Camera.look_at(
                at.position.tolist(),
                at.look_at.tolist(),
                at.up_direction.tolist(),
                fov=float(np.degrees(at.fov)),
                width=site.size[0],
                height=site.size[1],
            )
            shown = render(tree, camera, scene.shader).to_srgb8()
            client.scene.set_background_image(shown.cpu().numpy(), format="jpeg", jpeg_quality=80)


def viser_mesh(site: Site, ready: Connection) -> None:
    """Serves viser's page, which draws the scan's surface itself, by WebGL."""
    from ...io.surface import extract_surface

    server, scene = _viser(site, ready)
    mesh = extract_surface(scene.volume, scene.surface)
    server.scene.add_mesh_simple("/surface", mesh.vertices, mesh.faces, color=(220, 60, 40))
    threading.Event().wait()


def trame_page(site: Site, ready: Connection) -> None:
    """Serves trame's remote view of VTK's volume renderer on the CPU, which renders fewer pixels
    while the user interacts.
    """
    from trame.app import get_server
    from trame.ui.html import DivLayout
    from trame.widgets.vtk import VtkRemoteView
    from vtkmodules.vtkInteractionStyle import vtkInteractorStyleTrackballCamera
    from vtkmodules.vtkRenderingCore import vtkRenderWindowInteractor

    from .peer import Task
    from .vtk_fixed_point import Marcher

    scene, torch_device = scan_or_fog(site.side), torch.device("cpu")
    camera = scene.camera(*site.size)
    task = Task(scene=scene, camera=camera, rays=camera.rays(), stop_alpha=1.0, device=torch_device)
    shown = Marcher(task)
    shown.mapper.AutoAdjustSampleDistancesOn()
    hand = vtkRenderWindowInteractor()
    hand.SetRenderWindow(shown.window)
    hand.SetInteractorStyle(vtkInteractorStyleTrackballCamera())
    hand.SetDesiredUpdateRate(_RATE)
    hand.Initialize()
    server = get_server("bench")
    with DivLayout(server):
        VtkRemoteView(shown.window, style="position:absolute;inset:0")

    @server.controller.add("on_server_ready")
    def _(**_told: Any) -> None:
        ready.send(f"http://127.0.0.1:{server.port}")

    server.start(
        port=0, host="127.0.0.1", open_browser=False, show_connection_info=False, timeout=0
    )


#: The module that each peer's page needs.
NEEDS = {"viser": "viser", "trame": "trame_vtk"}
#: The function that serves each page, and the selector of the element that shows the picture.
PAGES = {
    "gvtorch": (gvtorch_page, "canvas.gv-picture"),
    "viser": (viser_pictures, "canvas"),
    "viser mesh": (viser_mesh, "canvas"),
    "trame": (trame_page, "img, canvas"),
}
#: How each page differs, for the notes of a record.
DIFFERS = {
    "gvtorch": "fewer pixels while the camera moves, for 25 pictures a second",
    "viser": "has no volumes: gvtorch's pictures, whole, as the background of its page",
    "viser mesh": "has no volumes: the scan's isosurface, drawn by the browser",
    "trame": "VTK's vtkFixedPointVolumeRayCastMapper on the CPU, fewer rays while the camera "
    "moves, for 25 pictures a second",
}


@contextlib.contextmanager
def served(who: str, site: Site) -> Iterator[str]:
    """Serves a page in a process, and yields its address; RuntimeError if it does not start."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(who, site, theirs), daemon=True)
    process.start()
    try:
        end = time.monotonic() + _STARTS
        while not ours.poll(0.2):
            if not process.is_alive() or time.monotonic() > end:
                raise RuntimeError(f"view: the page of {who} did not start")
        yield ours.recv()
    finally:
        process.terminate()
        process.join()


def _serve(who: str, site: Site, ready: Connection) -> None:
    torch.set_num_threads(site.threads)
    logging.disable()  # closed pages are not reported
    with contextlib.redirect_stdout(io.StringIO()):
        PAGES[who][0](site, ready)
