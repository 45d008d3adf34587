"""Three planes of voxels beside the picture: the layout of a page's picture, the world extent that
each plane shows, and a thread that reads the voxels, so that rendering does not wait for them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from functools import cached_property
from threading import Condition, Thread
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..base.messages import one_line
from ..base.volume import Volume
from ..io.http import ask_again
from ..io.stores.store import Store
from ..io.window import window
from ..pictures import Picture
from ..shaders import Labels, Shader
from ..tracing import slice_picture
from ..tracing.slices import UP, PlaneView, radiological_views
from .state import ViewState, transfer_of

GAP = 4  # pixels between the four parts
_KEPT = 48  # planes in the cache
_BACKGROUND = 0.004  # linear light where there is no plane


class Pane(NamedTuple):
    """A part of a picture, in pixels."""

    left: int
    top: int
    width: int
    height: int


def panes(width: int, height: int) -> dict[str, Pane]:
    """Returns the parts: the planes across y and x above the plane across z and the picture, so
    that neighbouring planes line up along their common axis.
    """
    w, h = max(1, (width - GAP) // 2), max(1, (height - GAP) // 2)
    right, below = w + GAP, h + GAP
    rest = max(1, width - right), max(1, height - below)
    return {
        "y": Pane(0, 0, w, h),
        "x": Pane(right, 0, rest[0], h),
        "z": Pane(0, below, w, rest[1]),
        "view": Pane(right, below, *rest),
    }


class Composed(NamedTuple):
    """A picture with planes beside it."""

    picture: Picture
    layout: dict[str, Any]  # the position of each part, and each plane's edges in the world
    complete: bool  # whether no plane is still being read


class Planes:
    """The planes of a volume or a store.

    Attributes:
        data: The volume or store that is cut.
    """

    def __init__(self, data: Volume | Store, arrived: Callable[[str], None]) -> None:
        """`arrived` is called, from another thread, with "" when a plane has been read, or with the
        reason why it can't be.
        """
        self.data, self._arrived = data, arrived
        self._made: OrderedDict[Any, np.ndarray] = OrderedDict()
        self._newest: dict[str, np.ndarray] = {}  # by axis
        self._failed: dict[Any, str] = {}
        self._windows: dict[int, tuple[float, float]] = {}
        self._wanted: dict[str, tuple[Any, ViewState, float]] = {}  # by axis
        self._reading: Any = None
        self._closed = False
        self._wake = Condition()
        Thread(target=self._read, name="gvtorch planes", daemon=True).start()

    @cached_property
    def views(self) -> dict[str, PlaneView]:
        """The view of each plane: radiological if the data's anatomical directions are known."""
        return radiological_views(self.data.info.space) or {
            axis: PlaneView("", up) for axis, up in UP.items()
        }

    def place(self, state: ViewState) -> tuple[float, float, float]:
        """Returns the world position through which the planes go, clamped to the data."""
        low, high = self._ends()
        at = (low + high) / 2
        if state.slices is not None and state.slices.at is not None:
            at = np.array(state.slices.at)
        x, y, z = np.clip(at, low, high).tolist()
        return x, y, z

    def index(self, axis: str, state: ViewState) -> int:
        """Returns the index, along an axis, of the finest voxel in which `place` lies."""
        n = "xyz".index(axis)
        found = (self.place(state)[n] - self.data.origin[n]) / self.data.spacing[n]
        return min(max(int(np.floor(found + 0.5)), 0), self.data.extent[n] - 1)

    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        step, extent = np.array(self.data.spacing), np.array(self.data.extent)
        low = np.array(self.data.origin) - step / 2
        return low, low + step * extent

    def composed(
        self, picture: Picture, state: ViewState, width: int, height: int, wait: bool = False
    ) -> Composed:
        """Returns a picture of all parts.

        Args:
            picture: Developed, of the size of its part or smaller.
            state: Has the position of the planes, and their colours.
            width: Pixels.
            height: Pixels.
            wait: Whether to wait for voxels; else the last planes are shown until the new are read.

        Raises:
            ValueError, OSError: With `wait`, a plane can't be read.
        """
        parts = panes(width, height)
        color = torch.full((height, width, 3), _BACKGROUND)
        view = parts["view"]
        _put(color, view, _fitted(picture.color.detach().cpu().float(), view))
        layout: dict[str, Any] = {"view": list(view)}
        pixel = max(self._pixel(axis, parts[axis]) for axis in "xyz")
        complete = True
        for axis in "xyz":
            image, known = self._image(axis, state, pixel, wait)
            complete &= known
            layout[axis] = self._told(axis, parts[axis], pixel) | {"at": self.place(state)}
            if image is not None:
                _put(color, Pane(*layout[axis]["image"]), torch.from_numpy(image))
        one = torch.ones(height, width, 1)
        far = one * torch.inf
        made = Picture(
            color=color, alpha=one, depth=far, nearest=far, samples=one.int(), stats=picture.stats
        )
        return Composed(made, layout, complete)

    def _sides(self, axis: str) -> tuple[str, str]:
        """Returns the axes along the columns and rows of the picture of a plane."""
        row = self.views[axis].up[1]
        return next(n for n in "xyz" if n not in (axis, row)), row

    def _pixel(self, axis: str, pane: Pane) -> float:
        """Returns the world size of a pixel at which a plane fits its part."""
        low, high = self._ends()
        size = dict(zip("xyz", high - low, strict=True))
        column, row = self._sides(axis)
        return float(max(size[column] / pane.width, size[row] / pane.height))

    def _level(self, axis: str, pixel: float) -> int:
        """Returns the coarsest level whose voxels are no larger than a pixel."""
        if not isinstance(self.data, Store):
            return 0
        least = min(self.data.spacing["xyz".index(n)] for n in self._sides(axis))
        return int(np.clip(np.floor(np.log2(pixel / least)), 0, self.data.levels - 1))

    def _told(self, axis: str, pane: Pane, pixel: float) -> dict[str, Any]:
        """Returns the layout of a plane: its part, its picture there, its edges in the world."""
        low, high = (dict(zip("xyz", one.tolist(), strict=True)) for one in self._ends())
        column, row = self._sides(axis)
        view = self.views[axis]
        width = min(pane.width, max(1, round((high[column] - low[column]) / pixel)))
        height = min(pane.height, max(1, round((high[row] - low[row]) / pixel)))
        across = (low[column], high[column])
        down = (high[row], low[row]) if view.up[0] == "+" else (low[row], high[row])
        left = pane.left + (pane.width - width) // 2
        top = pane.top + (pane.height - height) // 2
        return {
            "pane": list(pane),
            "image": [left, top, width, height],
            "columns": [column, *(across[::-1] if view.mirrored else across)],
            "rows": [row, *down],
            "step": self.data.spacing["xyz".index(axis)],
            "name": view.name or f"across {axis}",
        }

    def _image(
        self, axis: str, state: ViewState, pixel: float, wait: bool
    ) -> tuple[np.ndarray | None, bool]:
        """Returns the newest picture (h, w, 3) of a plane, and whether no newer one will come."""
        key = (axis, self.index(axis, state), round(pixel, 9), self._look(state))
        if wait and key not in self._made:
            self._keep(key, self._cut(axis, state, pixel))
        with self._wake:
            made = self._made.get(key)
            if made is not None:
                self._made.move_to_end(key)
                self._newest[axis] = made
            elif key not in self._failed and key != self._reading:
                self._wanted[axis] = key, state, pixel
                self._wake.notify()
            return self._newest.get(axis), made is not None or key in self._failed

    def _read(self) -> None:
        """Runs in the thread that reads: for each axis, the plane that was wanted last."""
        while True:
            with self._wake:
                while not (self._wanted or self._closed):
                    self._wake.wait()
                if self._closed:
                    return
                axis, (key, state, pixel) = self._wanted.popitem()
                self._reading = key
            try:
                self._keep(key, self._cut(axis, state, pixel))
                problem = ""
            except Exception as error:  # whatever it was, the view goes on
                self._failed[key] = one_line(error)
                problem = f"a slice can't be read: {self._failed[key]}"
            self._reading = None
            self._arrived(problem)

    def _keep(self, key: Any, image: np.ndarray) -> None:
        with self._wake:
            self._made[key] = image
            while len(self._made) > _KEPT:
                self._made.popitem(last=False)

    def _look(self, state: ViewState) -> Any:
        """Returns the part of the state on which the colours depend, as a key."""
        assert state.slices is not None
        coloured = state.slices.colors == "shader" or self.data.info.labels
        shader = repr(_colors_told(state.shader)) if coloured else None
        return state.slices.window, shader, state.component

    def _cut(self, axis: str, state: ViewState, pixel: float) -> np.ndarray:
        """Reads and colours a plane."""
        assert state.slices is not None
        level, sides = self._level(axis, pixel), self._sides(axis)
        voxel = min(self.data.spacing["xyz".index(n)] for n in sides) * 2**level
        colors = self._colors(state)
        span = None
        if colors is None:
            span = state.slices.window or self._found_window(state.component)
        known = self.views[axis].name != ""
        made = slice_picture(
            *(self.data, axis, self.index(axis, state)),
            span=span,
            colors=colors,
            component=state.component,
            level=level,
            scale=voxel / pixel,
            up=None if known else self.views[axis].up,
            radiological=known,
            letters=known,
        )
        return made.color.numpy()

    def _found_window(self, component: int) -> tuple[float, float]:
        if component not in self._windows:
            found = window(self.data, component=component, background=True)
            self._windows[component] = found
        return self._windows[component]

    def _colors(self, state: ViewState) -> Callable[[np.ndarray], np.ndarray] | None:
        """Returns the function that colours values; None: grays."""
        assert state.slices is not None
        if self.data.info.labels:
            shader = state.shader if isinstance(state.shader, Labels) else Labels()
            names = self.data.label_values
            return shader if names is None else lambda values: shader(names.numpy()[values])
        if state.slices.colors == "gray":
            return None
        return transfer_of(state.shader)

    def retry(self) -> None:
        """Allows planes that could not be read to be read again."""
        ask_again()
        self._failed.clear()

    def close(self) -> None:
        """Ends the thread; does not wait for what it reads."""
        with self._wake:
            self._closed = True
            self._wake.notify()


def _colors_told(shader: Shader) -> Any:
    """Returns a key that differs if two shaders colour values differently."""
    transfer = transfer_of(shader)
    if transfer is not None:
        return transfer.to_json()
    return (shader.colors, shader.visible) if isinstance(shader, Labels) else None


def _fitted(color: Tensor, pane: Pane) -> Tensor:
    """Scales an image (h, w, 3) to the size of a part."""
    if color.shape[:2] == (pane.height, pane.width):
        return color
    planar = color.movedim(-1, 0)[None]
    size = (pane.height, pane.width)
    made = torch.nn.functional.interpolate(planar, size, mode="bilinear", align_corners=False)
    return made[0].movedim(0, -1)


def _put(color: Tensor, pane: Pane, image: Tensor) -> None:
    """Writes an image into its part; what is larger is cut."""
    height, width = min(pane.height, image.shape[0]), min(pane.width, image.shape[1])
    color[pane.top : pane.top + height, pane.left : pane.left + width] = image[:height, :width]
