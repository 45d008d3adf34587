"""Pages that show the bench's scan, each served by its own process: ours, viser's and trame's.

Each function of `PAGES` sends the address of its page into a pipe, and serves until its process
ends. A peer is used as in its own examples; `DIFFERENCES` states how its page differs from ours.
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

_PICTURE_RATE = 25.0  # requested pictures a second while the camera moves
_START_TIMEOUT = 120.0  # seconds within which a page must be served


@dataclass(frozen=True, kw_only=True)
class PageSetup:
    """What a page shows, and what renders it."""

    side: int  # voxels a side of the scan
    size: tuple[int, int]  # (width, height) pixels of the picture
    device: str  # where gvtorch renders
    threads: int  # CPU threads of the page's process


def gvtorch_page(setup: PageSetup, pipe: Connection) -> None:
    """Serves our viewer, as `gvtorch view` does."""
    from ...viewer.server import Server
    from ...viewer.view import new_session

    scene = scan_or_fog(setup.side)
    session = new_session(
        scene.volume, scene.shader, scene.camera(*setup.size), engine={"device": setup.device}
    )
    develop = replace(session.state.develop, samples=1)  # so that it comes to rest soon
    session.state = replace(session.state, develop=develop)
    pipe.send(Server(session).url)
    threading.Event().wait()


def _viser(setup: PageSetup, pipe: Connection) -> tuple[Any, BenchScene]:
    """Starts viser's server with the scene's camera and nothing else in the picture."""
    import viser

    scene = scan_or_fog(setup.side)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server.scene.world_axes.visible = False
    view = scene.camera(*setup.size).viewmats[0]
    eye = -view[:3, :3].T @ view[:3, 3]
    initial = server.initial_camera
    initial.position, initial.look_at = tuple(eye.tolist()), tuple(scene.box.mean(0).tolist())
    initial.up, initial.fov = (0.0, 1.0, 0.0), float(np.radians(30))
    pipe.send(f"http://127.0.0.1:{server.get_port()}")
    return server, scene


def viser_pictures(setup: PageSetup, pipe: Connection) -> None:
    """Serves viser's page with gvtorch's pictures as background, each rendered at full resolution
    from the latest camera of the page.
    """
    from ...cameras import Camera
    from ...pool import N3Tree
    from ...tracing import render

    camera_moved = threading.Event()
    server, scene = _viser(setup, pipe)
    tree = N3Tree.from_volume(scene.volume).to(setup.device)

    @server.on_client_connect
    def _(client: Any) -> None:
        client.camera.on_update(lambda _: camera_moved.set())
        camera_moved.set()

    while True:
        camera_moved.wait()
        camera_moved.clear()
        for client in server.get_clients().values():
            page_camera = client.camera
            camera = Camera.look_at(
                page_camera.position.tolist(),
                page_camera.look_at.tolist(),
                page_camera.up_direction.tolist(),
                fov=float(np.degrees(page_camera.fov)),
                width=setup.size[0],
                height=setup.size[1],
            )
            picture = render(tree, camera, scene.shader).to_srgb8()
            client.scene.set_background_image(picture.cpu().numpy(), format="jpeg", jpeg_quality=80)


def viser_mesh(setup: PageSetup, pipe: Connection) -> None:
    """Serves viser's page, which draws the scan's surface itself, by WebGL."""
    from ...io.surface import extract_surface

    server, scene = _viser(setup, pipe)
    mesh = extract_surface(scene.volume, scene.surface)
    server.scene.add_mesh_simple("/surface", mesh.vertices, mesh.faces, color=(220, 60, 40))
    threading.Event().wait()


def trame_page(setup: PageSetup, pipe: Connection) -> None:
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

    scene, torch_device = scan_or_fog(setup.side), torch.device("cpu")
    camera = scene.camera(*setup.size)
    task = Task(scene=scene, camera=camera, rays=camera.rays(), stop_alpha=1.0, device=torch_device)
    marcher = Marcher(task)
    marcher.mapper.AutoAdjustSampleDistancesOn()
    interactor = vtkRenderWindowInteractor()
    interactor.SetRenderWindow(marcher.window)
    interactor.SetInteractorStyle(vtkInteractorStyleTrackballCamera())
    interactor.SetDesiredUpdateRate(_PICTURE_RATE)
    interactor.Initialize()
    server = get_server("bench")
    with DivLayout(server):
        VtkRemoteView(marcher.window, style="position:absolute;inset:0")

    @server.controller.add("on_server_ready")
    def _(**_kwargs: Any) -> None:
        pipe.send(f"http://127.0.0.1:{server.port}")

    server.start(
        port=0, host="127.0.0.1", open_browser=False, show_connection_info=False, timeout=0
    )


#: The module that each peer's page needs.
PEER_MODULES = {"viser": "viser", "trame": "trame_vtk"}
#: The function that serves each page, and the selector of the element that shows the picture.
PAGES = {
    "gvtorch": (gvtorch_page, "canvas.gv-picture"),
    "viser": (viser_pictures, "canvas"),
    "viser mesh": (viser_mesh, "canvas"),
    "trame": (trame_page, "img, canvas"),
}
#: How each page differs, for the notes of a record.
DIFFERENCES = {
    "gvtorch": "renders fewer pixels while the camera moves, for 25 pictures a second",
    "viser": "can't draw volumes: the page's background is gvtorch's picture at full resolution",
    "viser mesh": "can't draw volumes: the browser draws the scan's isosurface",
    "trame": "VTK's vtkFixedPointVolumeRayCastMapper on the CPU, fewer rays while the camera "
    "moves, for 25 pictures a second",
}


@contextlib.contextmanager
def served_page(who: str, setup: PageSetup) -> Iterator[str]:
    """Serves a page in a process, and yields its address; RuntimeError if it does not start."""
    context = get_context("spawn")
    receiver, sender = context.Pipe()
    process = context.Process(target=_serve, args=(who, setup, sender), daemon=True)
    process.start()
    try:
        deadline = time.monotonic() + _START_TIMEOUT
        while not receiver.poll(0.2):
            if not process.is_alive() or time.monotonic() > deadline:
                raise RuntimeError(f"view: the page of {who} did not start")
        yield receiver.recv()
    finally:
        process.terminate()
        process.join()


def _serve(who: str, setup: PageSetup, pipe: Connection) -> None:
    torch.set_num_threads(setup.threads)
    logging.disable()  # closed pages are not reported
    with contextlib.redirect_stdout(io.StringIO()):
        PAGES[who][0](setup, pipe)
