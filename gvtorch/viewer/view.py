"""`view`: opens anything that gvtorch renders in an interactive page."""

from __future__ import annotations

import sys
import threading
import webbrowser
from collections.abc import Iterable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

from ..base import check
from ..base.explicit import explicit
from ..cameras import Camera
from ..cameras.poses import Up
from ..pictures.picture import in_notebook
from ..shaders import Shader
from ..tracing import RenderOptions
from ..tracing.options import RenderSettings, render_options
from .parameters import Parameters
from .scene import Scene, open_scene
from .server import Server, aiohttp_web
from .session import Session
from .state import Eye, ViewState

ASPECT = (16, 9)  # shape of the picture to which the first camera fits the box


class Viewer:
    """A view that is served.

    Attributes:
        session: What is shown; see `Session`.
        server: The server of its page.
    """

    def __init__(self, session: Session, server: Server) -> None:
        self.session, self.server = session, server
        self._closed = threading.Event()

    @property
    def url(self) -> str:
        """The page's address."""
        return self.server.url

    @property
    def state(self) -> ViewState:
        """What is shown now; `gv.view(..., state=FILE)` reads what its `save` writes."""
        return self.session.state

    def wait(self) -> None:
        """Waits until the view is closed, or Ctrl-C."""
        try:
            self._closed.wait()
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Ends the view; an engine that the caller made stays open."""
        self.server.close()
        self.session.close()
        self._closed.set()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Viewer({self.url}, {len(self.session.clients)} pages)"


@explicit(RenderOptions)
def view(
    what: Any,
    shader: Shader | None = None,
    camera: Camera | None = None,
    *,
    up: Up | None = None,
    state: str | PathLike[str] | ViewState | None = None,
    engine: Mapping[str, Any] | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    allow: Iterable[str] = (),
    browser: bool | None = None,
    wait: bool | None = None,
    **options: Unpack[RenderSettings],
) -> Any:
    """Opens a page in the browser in which a scene can be explored and its look edited. In a
    notebook the page is shown below the cell.

    Args:
        what: A path or URL, `Volume`, array, `Store`, `N3Tree`, `Producer` or several by name,
            `Engine`, or a function from a dataclass to a producer, whose fields become controls.
        shader: What turns values into colour; one that fits the data if left out.
        camera: The first camera; one that sees the whole box if left out, patients upright and
            from the front.
        up: Up direction of a camera that is left out, such as "+z".
        state: A file that the page saved, or `Viewer.state`: replaces shader, camera and options.
        engine: Fields of `EngineOptions`, where an engine is made.
        host: Address to listen at. Other machines reach it at "0.0.0.0"; ssh -L PORT:localhost:PORT
            is the safer way.
        port: 0: any that is free.
        token: Secret that the page's address must hold; a new one if left out.
        allow: Further names under which pages may reach this machine.
        browser: Whether a browser is opened; if left out, unless a notebook shows the page.
        wait: Whether to wait until Ctrl-C; if left out, only in a script.
        **options: Fields of `RenderOptions`.

    Returns:
        A `Viewer`, or in a notebook a widget.

    Raises:
        ValueError: There is nothing to look at, or an argument is out of its range.
        FileNotFoundError: There is nothing at the path.
        ImportError: `gvtorch[view]` is not installed.
    """
    aiohttp_web()
    check.integer("view", "port", port, low=0, high=65535)
    session = new_session(what, shader, camera, up=up, state=state, engine=engine, **options)
    try:
        if in_notebook() and wait is None and browser is None:
            from .notebook import widget

            return widget(session)
        server = Server(session, host=host, port=port, token=token, allow=allow)
    except BaseException:
        session.close()
        raise
    viewer = Viewer(session, server)
    if browser or browser is None:
        webbrowser.open(viewer.url)
    if wait or (wait is None and not hasattr(sys, "ps1")):
        print(f"{viewer.url}\nCtrl-C ends the view.", flush=True)
        viewer.wait()
    return viewer


def new_session(
    what: Any,
    shader: Shader | None = None,
    camera: Camera | None = None,
    *,
    up: Up | None = None,
    state: str | PathLike[str] | ViewState | None = None,
    engine: Mapping[str, Any] | None = None,
    **options: Unpack[RenderSettings],
) -> Session:
    """Opens a scene and its session, without a page; see `view`."""
    parameters = None
    if callable(what) and not hasattr(what, "fill"):
        parameters = Parameters.of_function(what)
        what = parameters.producer
    scene = what if isinstance(what, Scene) else open_scene(what, **(engine or {}))
    try:
        if parameters is None and len(scene.producers) == 1:
            parameters = Parameters(scene.producers[0])
        if shader is None:
            shader = scene.first_shader()
        chosen = ViewState(
            shader=check.instance("view", "shader", shader, Shader),
            options=render_options("view", options),
            component=options.get("component", 0),
            time=scene.time,
        )
        if state is not None:
            check.instance("view", "state", state, ViewState, str, PathLike)
            chosen = state if isinstance(state, ViewState) else chosen.read(Path(state))
        if chosen.camera is None:
            if camera is None:
                eye = Eye.first(scene.box, *ASPECT, up, scene.info.space)
            else:
                eye = Eye.of(check.instance("view", "camera", camera, Camera), scene.box)
            chosen = replace(chosen, camera=eye)
        scene.check_state(chosen)
        if chosen.time != scene.time and scene.reopen is not None:
            scene.show_time(chosen.time, scene.reopen(int(chosen.time)))
        elif chosen.time != scene.time:
            scene.set_clocks(chosen.time)
        return Session(scene, chosen, parameters)
    except BaseException:
        scene.close()
        raise
