"""Stills: whole pictures that pages ask for, in any size. They are rendered by the thread of the
session, a step at a time between the frames of pages.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

from ..base.messages import one_line
from ..pictures import Picture, Progressive
from .client import Client, Interrupted, image_file
from .scene import Scene
from .slices import Planes, panes
from .state import Eye, ViewState

Steps = Iterator[Picture | None]  # None until the last step, which yields the picture


def still_steps(
    scene: Scene,
    planes: Callable[[], Planes | None],
    state: ViewState,
    eye: Eye,
    size: tuple[int, int],
    unwanted: Callable[[], bool],
) -> Steps:
    """Renders a finished picture: nothing missing, every sample taken. Yields None between its
    steps, so that others get their frames, and the picture at the end.

    Args:
        planes: Returns the slices to draw beside it; called last.
        size: Width and height in pixels, with the slices.
        unwanted: Called between parts of the picture; returns whether nobody waits for it any more,
            in which case Interrupted is raised.
    """

    def stop_if_unwanted(_stage: str, _done: int, _total: int) -> None:
        if unwanted():
            raise Interrupted("nobody waits for this still any more")

    width, height = size if state.slices is None else panes(*size)["view"][2:]
    camera = eye.camera(width, height, scene.box)
    if scene.engine is not None:  # loads all data
        scene.engine.render(camera, state.shader, progress=stop_if_unwanted, **state.settings())
        yield None
    progressive = Progressive(lambda jittered: scene.frame(jittered, state, stop_if_unwanted))
    picture = progressive.frame(camera)
    while progressive.count < state.develop.samples:
        yield None
        picture = progressive.frame(camera)
    developed = state.develop.develop(picture)
    shown = state.with_costs(developed, lambda: scene.cost(camera, state, stop_if_unwanted))
    beside = planes()
    if beside is not None and state.slices is not None:
        shown = beside.composed(shown, state, *size, wait=True).picture
    yield shown


class Stills:
    """The stills that pages wait for, made in turns."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Client, Steps]] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, client: Client, steps: Steps) -> None:
        """Queues a still for a page; raises ValueError if the page waits for one already."""
        if any(waiting is client for waiting, _ in self._waiting):
            raise ValueError("still: one is being made already")
        self._waiting.append((client, steps))

    def run_step(self) -> None:
        """Runs the next step of the first still in the queue; sends it if that was the last."""
        client, steps = self._waiting.popleft()
        try:
            picture = next(steps)
            if picture is None:
                self._waiting.append((client, steps))
            else:
                client.send_file("picture.png", image_file(picture, "PNG"))
        except Interrupted:
            pass
        except Exception as error:  # whatever it was, the view goes on
            client.send_message("refused", text=f"still: {one_line(error)}")
