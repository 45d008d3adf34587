"""`Session`: a scene, its view state, and the pages that show it. One thread owns the scene and
renders for all pages in turn; whatever comes from the network is put into a queue that it empties
between frames. It never waits for a page: see `Client`.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import replace
from typing import Any

import torch

from ..base.messages import one_line
from ..base.units import unit_symbol
from ..base.volume import Volume
from ..cameras.models import MODELS
from ..engine import EngineOptions
from ..io.stores.store import Store
from ..pictures import Picture
from ..shaders import TransferFunction
from ..shaders.presets import CT_PRESETS, PRESETS
from . import protocol
from .client import Client, Send
from .export import SurfaceExport
from .files import read_function
from .fitting import trimmed, unfit
from .parameters import Parameters
from .protocol import parse
from .scene import Scene, node_boxes
from .schema import KINDS, decode, describe_kind, encode
from .slices import Planes
from .state import Development, Eye, Slices, ViewState, transfer_of
from .still import Steps, Stills, still_steps

_TICK_SECONDS = 0.02  # seconds between checks whether a camera has come to rest
_FIGURES_SECONDS = 0.25  # seconds between figures for monitors
_ENGINE_OPTIONS = (
    "brick_pool",
    "node_pool",
    "load_budget",
    "subdivide_budget",
    "time_budget",
    "loading",
)
#: Of matplotlib: a page offers them beside the presets, and keeps its opacity when one is chosen.
_COLOR_MAPS = ("viridis", "magma", "inferno", "plasma", "cividis", "turbo", "coolwarm")


class Session:
    """A scene that pages show.

    Attributes:
        state: What is shown; its camera is the one that new pages begin with.
        clients: The pages, by number.
        scene: The scene; only the session's thread uses it.
    """

    def __init__(
        self, scene: Scene, state: ViewState, parameters: Parameters | None = None
    ) -> None:
        self.scene, self.state, self.parameters = scene, state, parameters
        self.clients: dict[int, Client] = {}
        self._last_good_state = state  # the last state that was drawn
        self._client_count, self._last_drawn_client = 0, 0
        self._tasks: deque[Callable[[], None]] = deque()
        self._questions: set[Future[Any]] = set()  # of `ask`, without an answer
        self._stills = Stills()
        self._wake = threading.Condition()
        self._closed = False
        self._sent_failures: tuple[str, ...] = ()
        self._sent_busy: Any = None
        self._figures_time = 0.0
        self._planes: Planes | None = None
        self._export: SurfaceExport | None = None
        self._pending_time: float | None = None  # the time point that a thread reads now
        self._open_planes(state)
        self._thread = threading.Thread(target=self._run, name="gvtorch view", daemon=True)
        self._thread.start()

    # For any thread.

    def join(self, send: Send) -> Client:
        """Adds a page; `send` sends it a text or bytes, from any thread, without waiting."""
        with self._wake:
            self._client_count += 1
            assert self.state.camera is not None
            client = Client(self._client_count, send, self.state.camera)
        self.post(lambda: self._welcome(client))
        return client

    def leave(self, client: Client) -> None:
        client.gone = True
        self.post(lambda: self._goodbye(client))

    def receive(self, client: Client, text: str | bytes) -> None:
        """Handles a message of a page; answers a wrong one with the reason."""
        try:
            message = parse(text)
        except ValueError as error:
            client.send_message("refused", text=str(error))
            return
        if isinstance(message, protocol.Ack):
            client.ack(message.number)
            with self._wake:
                self._wake.notify()
            return
        self.post(lambda: self._take(client, message))

    def post(self, task: Callable[[], None]) -> None:
        """Queues a task for the thread that renders, between two frames; drops it once closed."""
        with self._wake:
            if self._closed:
                return
            self._tasks.append(task)
            self._wake.notify()

    def ask(self, question: Callable[[], Any], timeout: float = 60.0) -> Any:
        """Runs a function in the thread that renders; waits for its result and returns it.

        Raises:
            RuntimeError: The view is closed, or closes before it runs the function.
            TimeoutError: There is no result after `timeout` seconds.
        """
        future: Future[Any] = Future()

        def run_question() -> None:
            try:
                future.set_result(question())
            except Exception as error:
                future.set_exception(error)

        with self._wake:
            if self._closed:
                raise RuntimeError("view: it is closed")
            self._questions.add(future)
            self.post(run_question)
        is_done = bool(wait([future], timeout).done)
        self._questions.discard(future)
        if not is_done:
            raise TimeoutError("view: no answer")
        return future.result()

    def close(self) -> None:
        """Ends the thread and closes the scene."""
        with self._wake:
            if self._closed:
                return
            self._closed = True
            for client in list(self.clients.values()):
                client.gone = True
            self._wake.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=30)

    # The thread that renders.

    @torch.no_grad()  # pictures of module shaders would hold all their samples
    def _run(self) -> None:
        while self._step():
            pass
        if self._planes is not None:
            self._planes.close()
        for client in self.clients.values():
            client.end()
        self.clients.clear()
        self._tasks.clear()
        for future in list(self._questions):
            if not future.done():
                future.set_exception(RuntimeError("view: it is closed"))
        self._stills = Stills()
        self.scene.close()

    def _step(self) -> bool:
        """Runs queued tasks, draws a picture and a step of a still; returns False once closed."""
        with self._wake:
            while not (self._closed or self._tasks or self._stills or self._next_client()):
                is_unfinished = any(client.is_unfinished() for client in self.clients.values())
                self._wake.wait(_TICK_SECONDS if is_unfinished else None)
            if self._closed:
                return False
            tasks, self._tasks = self._tasks, deque()
        for task in tasks:
            try:
                task()
            except Exception as error:  # whatever it was, the view goes on
                self._broadcast("error", text=f"{type(error).__name__}: {error}")
        client = self._next_client()
        if client is not None:
            self._draw(client)
        if self._stills:
            self._stills.run_step()
        return True

    def _next_client(self) -> Client | None:
        """Returns the next client, in turn, that wants a picture, or None."""
        wanting = [number for number, client in self.clients.items() if client.wants_picture()]
        if not wanting:
            return None
        return self.clients[next((n for n in wanting if n > self._last_drawn_client), wanting[0])]

    def _draw(self, client: Client) -> None:
        self._last_drawn_client = client.number
        try:
            picture = client.draw(self.scene, self.state, self._is_outdated, self._planes)
            if picture is None:
                return
            self._last_good_state = self.state
            self._send_nodes(client)
            self._broadcast_busy(picture)
            self._broadcast_failures()
            if client.monitor and time.monotonic() - self._figures_time > _FIGURES_SECONDS:
                self._figures_time = time.monotonic()
                client.send_message("figures", **self._frame_figures(picture))
        except Exception as error:  # whatever it was, the view goes on
            self._report_failure(client, error)

    def _is_outdated(self) -> bool:
        return bool(self._tasks) or self._closed

    def _report_failure(self, client: Client, error: Exception) -> None:
        """Reports why a picture failed, and returns to the last state that was drawn."""
        self._broadcast("error", text=one_line(error))
        if self._last_good_state is not self.state:
            self.state = self._last_good_state
            self._broadcast_state(None)
            self._restart_pictures()
            self._update_time()
        else:
            client.pause()

    def _broadcast(self, kind: str, **content: Any) -> None:
        for client in self.clients.values():
            client.send_message(kind, **content)

    def _broadcast_state(self, excluded: Client | None) -> None:
        for client in self.clients.values():
            if client is not excluded:
                client.send_message("state", **self._state_content())

    def _state_content(self) -> dict[str, Any]:
        return {"state": self.state.to_json(), "unfit": unfit(self.state)}

    def _engine_content(self) -> dict[str, Any] | None:
        """Returns the options of the engine that a page may set; None if the caller owns it."""
        engine = self.scene.engine
        if engine is None or self.scene.remake is None:
            return None
        return {name: encode(getattr(engine.options, name)) for name in _ENGINE_OPTIONS}

    def _broadcast_busy(self, picture: Picture) -> None:
        stats = picture.stats
        busy = {
            "pending": getattr(stats, "pending", 0) + getattr(stats, "deferred", 0),
            "misses": getattr(stats, "misses", 0),
            "crowded": bool(getattr(stats, "capacity_exceeded", False)),
        }
        if busy != self._sent_busy:
            self._sent_busy = busy
            self._broadcast("busy", **busy)

    def _broadcast_failures(self) -> None:
        failures = tuple(self.scene.failures())
        if failures == self._sent_failures:
            return
        new = [failure for failure in failures if failure not in self._sent_failures]
        self._sent_failures = failures
        engine = self.scene.engine
        count = 0 if engine is None else len(engine.production.failures)
        if new:
            self._broadcast("failed", text=new[-1], count=count)

    def _frame_figures(self, picture: Picture) -> dict[str, Any]:
        stats = picture.stats.as_dict()
        names = ("milliseconds", "stages", "rays", "samples", "bricks_used", "tiles_used")
        of_streams = ("requests", "misses", "produced", "evicted", "miss_rate", "pending", "failed")
        figures = {name: stats[name] for name in (*names, *of_streams) if name in stats}
        engine = self.scene.engine
        if engine is not None:
            report = engine.report().as_dict()
            report_names = ("occupancy", "bricks_per_second", "hit_rate", "memory")
            figures["report"] = {name: report[name] for name in report_names}
        return figures

    # Messages of pages: `_take_NAME` handles the message NAME of the protocol.

    def _welcome(self, client: Client) -> None:
        self.clients[client.number] = client
        box, info = self.scene.box.tolist(), self.scene.info
        stored_channels = self.scene.trees[0].bricks.channels
        client.send_message(
            "welcome",
            client=client.number,
            name=self.scene.name,
            box=box,
            unit=unit_symbol(info.unit),
            time=self.scene.describe_time(),
            labels=self.scene.describe_labels(),
            channels=[channel.name for channel in info.channels],
            widths={name: channel.width for name, channel in stored_channels.items()},
            **self._state_content(),
            schema=schema(),
            models={
                name: {"parallel": model.parallel, "planar": model.planar}
                for name, model in MODELS.items()
            },
            presets=[*PRESETS, *CT_PRESETS, *_COLOR_MAPS],
            engine=self._engine_content(),
            parameters=None if self.parameters is None else self.parameters.describe(),
        )
        self._broadcast_clients()

    def _goodbye(self, client: Client) -> None:
        self.clients.pop(client.number, None)
        client.end()
        for other in self.clients.values():
            if other.follows == client.number:
                other.follows = None
        self._broadcast_clients()

    def _broadcast_clients(self) -> None:
        follows = {client.number: client.follows for client in self.clients.values()}
        self._broadcast("clients", clients=follows)

    def _take(self, client: Client, message: Any) -> None:
        """Handles a page's message; answers with the reason if it is refused."""
        if client.number not in self.clients:
            return
        try:
            take = getattr(self, f"_take_{type(message).__name__.lower()}")
            take(client, message)
        except (ValueError, OSError, ImportError, RuntimeError) as error:
            client.send_message("refused", text=one_line(error))
            if isinstance(message, protocol.Change):  # the page has changed its copies already
                client.send_message("state", **self._state_content())
                if message.state.get("camera") is not None:
                    client.send_message("camera", camera=encode(client.eye))

    def _take_hello(self, client: Client, message: protocol.Hello) -> None:
        client.resized(message.width, message.height, message.rate)

    def _take_move(self, client: Client, message: protocol.Move) -> None:
        self._move_camera(client, message.camera, message.moving, message.sent)

    def _move_camera(self, client: Client, eye: Eye, moving: bool, sent: float = 0.0) -> None:
        """Moves a page's camera and those of all pages that follow it, directly or indirectly."""
        client.move(eye, moving, sent)
        moved_numbers = {client.number}
        leader_numbers = deque(moved_numbers)
        while leader_numbers:
            leader_number = leader_numbers.popleft()
            for follower in self.clients.values():
                if follower.follows == leader_number and follower.number not in moved_numbers:
                    moved_numbers.add(follower.number)
                    leader_numbers.append(follower.number)
                    follower.move(eye, moving, 0.0)
                    follower.send_message("camera", camera=encode(eye))

    def _take_change(self, client: Client, message: protocol.Change) -> None:
        content = {name: value for name, value in message.state.items() if name != "camera"}
        camera, eye = message.state.get("camera"), client.eye
        if camera is not None:
            eye = decode("camera", Eye, camera, eye)
        state = self.state.changed(content)
        left_out: list[str] = []
        if type(state.shader) is not type(self.state.shader):
            state, left_out = trimmed(state)
        self.scene.check_state(state)
        self._open_planes(state)
        if camera is not None:  # nothing was refused
            self._move_camera(client, eye, not message.rest)
            client.send_message("camera", camera=encode(eye))
        if not content:
            return
        for reason in left_out:
            client.send_message("note", text=f"left out: {reason}")
        before, self.state = self.state, state
        self._broadcast_state(client if not message.rest else None)
        shows_planes = state.slices is not None and before.slices is not None
        if shows_planes and replace(before, slices=state.slices) == state:
            self._refresh_planes()
        else:
            self._restart_pictures(message.rest)
        self._update_time()

    # Planes beside the picture, and time.

    def _open_planes(self, state: ViewState) -> None:
        """Creates `Planes` if a state shows slices; raises ValueError if there are no voxels."""
        if state.slices is not None and self._planes is None:
            self._planes = Planes(self.scene.voxels("slices"), self._plane_arrived)

    def _plane_arrived(self, problem: str) -> None:
        """Called by the thread that reads planes; `problem` is the reason of a failure, or ""."""
        if problem:
            self.post(lambda: self._broadcast("error", text=problem))
        self.post(self._refresh_planes)

    def _refresh_planes(self) -> None:
        for client in self.clients.values():
            client.planes_changed = True

    def _update_time(self) -> None:
        """Shows the time of the state: a clock's at once, a series' once a thread has read it."""
        time_point = self.state.time
        if time_point == self.scene.time or self._pending_time is not None:
            return
        if self.scene.reopen is None:
            self.scene.set_clocks(time_point)
            return
        self._pending_time = time_point
        threading.Thread(target=self._read_time, args=(time_point,), daemon=True).start()

    def _read_time(self, time_point: float) -> None:
        """Reads a time point, in its own thread, so that rendering goes on."""
        assert self.scene.reopen is not None
        data: Volume | Store | Exception
        try:
            data = self.scene.reopen(int(time_point))
        except Exception as error:  # whatever it was, the view goes on
            data = error
        self.post(lambda: self._time_arrived(time_point, data))

    def _time_arrived(self, time_point: float, data: Volume | Store | Exception) -> None:
        """Shows a time point. If it can't be read or shown, sets the state back to the time that is
        shown, unless it wants another one meanwhile.
        """
        self._pending_time = None
        try:
            if isinstance(data, Exception):
                raise data
            self.scene.show_time(time_point, data)
        except Exception as error:  # whatever it was, the view goes on
            self._broadcast("error", text=f"time {time_point:g}: {one_line(error)}")
            if self.state.time == time_point:
                self.state = replace(self.state, time=self.scene.time)
                self._broadcast_state(None)
        else:
            self._show_new_data()
        self._update_time()

    def _show_new_data(self) -> None:
        """Restarts pictures and planes, of the scene's present data."""
        self._restart_pictures()
        if self._planes is not None:
            self._planes.close()
            self._planes = None
            self._open_planes(self.state)

    def _take_pick(self, client: Client, message: protocol.Pick) -> None:
        position = client.position_at(message.x, message.y)
        client.send_message("picked", place=position, purpose=message.purpose)

    def _take_histogram(self, client: Client, message: protocol.Histogram) -> None:
        histogram = self.scene.histogram(self.state.component, message.in_view)
        client.send_message("histogram", **histogram)

    def _take_find(self, client: Client, message: protocol.Find) -> None:
        labels = self.scene.describe_labels(message.text)
        if labels is None:
            raise ValueError("find: this scene has no labels")
        client.send_message("found", text=message.text, **labels)

    def _take_preset(self, client: Client, message: protocol.Preset) -> None:
        name = message.name
        limits = (None, None) if name in CT_PRESETS else (message.low, message.high)
        function = TransferFunction.preset(name, *limits)
        colors_only = name in _COLOR_MAPS
        client.send_message("preset", name=name, function=encode(function), colors_only=colors_only)

    def _take_read(self, client: Client, message: protocol.Read) -> None:
        function, notes = read_function(**vars(message))
        name = message.name or message.file
        client.send_message("preset", name=name, function=encode(function), lost=notes)

    def _take_export(self, client: Client, message: protocol.Export) -> None:
        transfer = transfer_of(self.state.shader)
        if transfer is None:
            raise ValueError("export: there is no transfer function")
        client.send_file("paraview.json", transfer.to_paraview(message.name).encode())

    def _take_nodes(self, client: Client, message: protocol.Nodes) -> None:
        client.nodes = message.on
        self._send_nodes(client)

    def _send_nodes(self, client: Client) -> None:
        if client.nodes and client.picture is not None:
            client.send_message("nodes", **node_boxes(self.scene.trees[0], client.eye.eye))

    def _take_resize(self, client: Client, message: protocol.Resize) -> None:
        unknown = sorted(set(message.engine) - set(_ENGINE_OPTIONS))
        if unknown:
            raise ValueError(
                f"resize: {unknown[0]!r:.60} can't be set; known: {', '.join(_ENGINE_OPTIONS)}"
            )
        if self.scene.engine is None:
            raise ValueError("resize: the scene is resident")
        options = decode("engine", EngineOptions, message.engine, self.scene.engine.options)
        self.scene.resize(**{name: getattr(options, name) for name in message.engine})
        self._broadcast("engine", engine=self._engine_content())
        self._restart_pictures()

    def _restart_pictures(self, resting: bool = True) -> None:
        for client in self.clients.values():
            client.restart(resting)

    def _take_set(self, client: Client, message: protocol.Set) -> None:
        if self.parameters is None:
            raise ValueError("set: there are no parameters")
        self.parameters.set(message.name, message.value, self.scene)
        box = self.scene.box.tolist()
        self._broadcast("parameters", parameters=self.parameters.describe(), box=box)
        self._show_new_data()

    def _take_follow(self, client: Client, message: protocol.Follow) -> None:
        leader = self.clients.get(message.client or 0)
        if message.client is not None and (leader is None or leader is client):
            raise ValueError(f"follow: there is no client {message.client}")
        client.follows = message.client
        if leader is not None:
            client.move(leader.eye, False, 0.0)
            client.send_message("camera", camera=encode(leader.eye))
        self._broadcast_clients()

    def _take_monitor(self, client: Client, message: protocol.Monitor) -> None:
        client.monitor = message.on
        if message.on and client.picture is not None:
            client.send_message("figures", **self._frame_figures(client.picture))

    def _take_still(self, client: Client, message: protocol.Still) -> None:
        size = message.width, message.height
        self._stills.add(client, self._still_steps(client.eye, size, lambda: client.gone))

    def _take_surface(self, client: Client, message: protocol.Surface) -> None:
        if self._export is not None and self._export.busy:
            raise ValueError("surface: one is being made already")
        data = self.scene.voxels("surface")
        self._export = SurfaceExport(client, message, data, self.state.component)

    def _take_do(self, client: Client, message: protocol.Do) -> None:
        if message.what == "retry":
            self.scene.retry()
            if self._planes is not None:
                self._planes.retry()
            self._restart_pictures()
        else:
            eye = client.eye.fitted(self.scene.box, *client.size)
            self._move_camera(client, eye, False)
            client.send_message("camera", camera=encode(eye))

    def still(self, eye: Eye, width: int, height: int) -> Picture:
        """Renders a finished picture: nothing missing, all samples."""
        *_, picture = self._still_steps(eye, (width, height), lambda: False)
        assert picture is not None
        return picture

    def _still_steps(self, eye: Eye, size: tuple[int, int], has_left: Callable[[], bool]) -> Steps:
        return still_steps(
            *(self.scene, lambda: self._planes, self.state, eye, size),
            unwanted=lambda: self._closed or has_left(),
        )


def schema() -> dict[str, Any]:
    """Returns the description that the page makes its controls of: the fields of each class."""
    kinds = (*KINDS.values(), Eye, Development, Slices, ViewState, EngineOptions)
    return {kind.__name__: describe_kind(kind) for kind in kinds}
