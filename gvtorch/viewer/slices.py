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
from ..io.http import retry_refused
from ..io.stores.store import Store
from ..io.window import window
from ..pictures import Picture
from ..shaders import Labels, Shader
from ..tracing import slice_picture
from ..tracing.slices import GAP, UP, PlaneView, radiological_views
from .state import ViewState, transfer_of

_CACHED_PLANES = 48  # planes in the cache
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

    def __init__(self, data: Volume | Store, on_read: Callable[[str], None]) -> None:
        """`on_read` is called, from another thread, with "" when a plane has been read, or with the
        reason why it can't be.
        """
        self.data, self._on_read = data, on_read
        self._low = np.array(data.origin) - np.array(data.spacing) / 2  # world corners
        self._high = self._low + np.array(data.spacing) * np.array(data.extent)
        self._images: OrderedDict[Any, np.ndarray] = OrderedDict()
        self._newest_images: dict[str, np.ndarray] = {}  # by axis
        self._failed: set[Any] = set()
        self._windows: dict[int, tuple[float, float]] = {}
        self._requests: dict[str, tuple[Any, ViewState, float]] = {}  # by axis
        self._reading_key: Any = None
        self._closed = False
        self._wake = Condition()
        Thread(target=self._read_planes, name="gvtorch planes", daemon=True).start()

    @cached_property
    def views(self) -> dict[str, PlaneView]:
        """The view of each plane: radiological if the data's anatomical directions are known."""
        plain_views = {axis: PlaneView("", up) for axis, up in UP.items()}
        return radiological_views(self.data.info.space) or plain_views

    def position(self, state: ViewState) -> tuple[float, float, float]:
        """Returns the world position through which the planes go, clamped to the data."""
        position = (self._low + self._high) / 2
        if state.slices is not None and state.slices.position is not None:
            position = np.array(state.slices.position)
        x, y, z = np.clip(position, self._low, self._high).tolist()
        return x, y, z

    def index(self, axis: str, state: ViewState) -> int:
        """Returns the index, along an axis, of the finest voxel in which `position` lies."""
        n = "xyz".index(axis)
        voxel = (self.position(state)[n] - self.data.origin[n]) / self.data.spacing[n]
        return min(max(int(np.floor(voxel + 0.5)), 0), self.data.extent[n] - 1)

    def composed(
        self, picture: Picture, state: ViewState, width: int, height: int, wait: bool = False
    ) -> Composed:
        """Returns a picture of all parts.

        Args:
            picture: Developed, of the size of its part or smaller.
            state: Has the position of the planes, and their colours.
            width, height: Pixels.
            wait: Whether to wait for voxels; else the last planes are shown until the new are read.

        Raises:
            ValueError, OSError: With `wait`, a plane can't be read.
        """
        parts = panes(width, height)
        color = torch.full((height, width, 3), _BACKGROUND, device="cpu")
        view = parts["view"]
        _paste(color, view, _resized(picture.color.detach().cpu().float(), view))
        layout: dict[str, Any] = {"view": list(view)}
        pixel_size = max(self._pixel_size(axis, parts[axis]) for axis in "xyz")
        complete = True
        for axis in "xyz":
            image, is_current = self._image(axis, state, pixel_size, wait)
            complete &= is_current
            layout[axis] = self._plane_layout(axis, parts[axis], pixel_size)
            layout[axis]["position"] = self.position(state)
            if image is not None:
                _paste(color, Pane(*layout[axis]["image"]), torch.from_numpy(image))
        ones = torch.ones(height, width, 1, device="cpu")
        infinite = ones * torch.inf
        composite = Picture(
            color=color,
            alpha=ones,
            depth=infinite,
            nearest=infinite,
            samples=ones.int(),
            stats=picture.stats,
        )
        return Composed(composite, layout, complete)

    def _sides(self, axis: str) -> tuple[str, str]:
        """Returns the axes along the columns and rows of the picture of a plane."""
        row = self.views[axis].up[1]
        return next(n for n in "xyz" if n not in (axis, row)), row

    def _pixel_size(self, axis: str, pane: Pane) -> float:
        """Returns the world size of a pixel at which a plane fits its part."""
        size = dict(zip("xyz", self._high - self._low, strict=True))
        column, row = self._sides(axis)
        return float(max(size[column] / pane.width, size[row] / pane.height))

    def _level(self, axis: str, pixel_size: float) -> int:
        """Returns the coarsest level whose voxels are no larger than a pixel."""
        if not isinstance(self.data, Store):
            return 0
        voxel_size = min(self.data.spacing["xyz".index(n)] for n in self._sides(axis))
        return int(np.clip(np.floor(np.log2(pixel_size / voxel_size)), 0, self.data.levels - 1))

    def _plane_layout(self, axis: str, pane: Pane, pixel_size: float) -> dict[str, Any]:
        """Returns the layout of a plane: which part of the picture it takes, where its image lies
        in that part, and its edges in world coordinates.
        """
        corners = (self._low.tolist(), self._high.tolist())
        low, high = (dict(zip("xyz", corner, strict=True)) for corner in corners)
        column, row = self._sides(axis)
        view = self.views[axis]
        width = min(pane.width, max(1, round((high[column] - low[column]) / pixel_size)))
        height = min(pane.height, max(1, round((high[row] - low[row]) / pixel_size)))
        column_edges = (low[column], high[column])
        row_edges = (high[row], low[row]) if view.up[0] == "+" else (low[row], high[row])
        left = pane.left + (pane.width - width) // 2
        top = pane.top + (pane.height - height) // 2
        return {
            "pane": list(pane),
            "image": [left, top, width, height],
            "columns": [column, *(column_edges[::-1] if view.mirrored else column_edges)],
            "rows": [row, *row_edges],
            "step": self.data.spacing["xyz".index(axis)],
            "name": view.name or f"across {axis}",
        }

    def _image(
        self, axis: str, state: ViewState, pixel_size: float, wait: bool
    ) -> tuple[np.ndarray | None, bool]:
        """Returns the newest picture (h, w, 3) of a plane, and whether no newer one will come."""
        key = (axis, self.index(axis, state), round(pixel_size, 9), self._color_key(state))
        if wait and key not in self._images:
            self._cache_image(key, self._render_plane(axis, state, pixel_size))
        with self._wake:
            image = self._images.get(key)
            if image is not None:
                self._images.move_to_end(key)
                self._newest_images[axis] = image
            elif key not in self._failed and key != self._reading_key:
                self._requests[axis] = key, state, pixel_size
                self._wake.notify()
            return self._newest_images.get(axis), image is not None or key in self._failed

    def _read_planes(self) -> None:
        """Runs in the thread that reads: for each axis, the plane that was wanted last."""
        while True:
            with self._wake:
                while not (self._requests or self._closed):
                    self._wake.wait()
                if self._closed:
                    return
                axis, (key, state, pixel_size) = self._requests.popitem()
                self._reading_key = key
            reason = ""
            try:
                self._cache_image(key, self._render_plane(axis, state, pixel_size))
            except Exception as error:  # whatever it was, the view goes on
                reason = one_line(error)
            with self._wake:
                self._reading_key = None
                if reason:
                    self._failed.add(key)
            self._on_read(reason and f"a slice can't be read: {reason}")

    def _cache_image(self, key: Any, image: np.ndarray) -> None:
        with self._wake:
            self._images[key] = image
            while len(self._images) > _CACHED_PLANES:
                self._images.popitem(last=False)

    def _color_key(self, state: ViewState) -> Any:
        """Returns the part of the state on which the colours depend, as a key."""
        assert state.slices is not None
        uses_shader = state.slices.colors == "shader" or self.data.info.labels
        shader = repr(_shader_key(state.shader)) if uses_shader else None
        return state.slices.window, shader, state.component

    def _render_plane(self, axis: str, state: ViewState, pixel_size: float) -> np.ndarray:
        assert state.slices is not None
        level, sides = self._level(axis, pixel_size), self._sides(axis)
        voxel_size = min(self.data.spacing["xyz".index(n)] for n in sides) * 2**level
        colors = self._colors(state)
        limits = None
        if colors is None:
            limits = state.slices.window or self._auto_window(state.component)
        is_anatomical = self.views[axis].name != ""
        picture = slice_picture(
            *(self.data, axis, self.index(axis, state)),
            span=limits,
            colors=colors,
            component=state.component,
            level=level,
            scale=voxel_size / pixel_size,
            up=None if is_anatomical else self.views[axis].up,
            radiological=is_anatomical,
            letters=is_anatomical,
        )
        return picture.color.numpy()

    def _auto_window(self, component: int) -> tuple[float, float]:
        if component not in self._windows:
            self._windows[component] = window(self.data, component=component, background=True)
        return self._windows[component]

    def _colors(self, state: ViewState) -> Callable[[np.ndarray], np.ndarray] | None:
        """Returns the function that colours values; None: grays."""
        assert state.slices is not None
        if self.data.info.labels:
            return state.shader if isinstance(state.shader, Labels) else Labels()
        if state.slices.colors == "gray":
            return None
        return transfer_of(state.shader)

    def retry(self) -> None:
        """Allows planes that could not be read to be read again."""
        retry_refused()
        with self._wake:
            self._failed.clear()

    def close(self) -> None:
        """Ends the thread; does not wait for what it reads."""
        with self._wake:
            self._closed = True
            self._wake.notify()


def _shader_key(shader: Shader) -> Any:
    """Returns a key that differs if two shaders colour values differently."""
    transfer = transfer_of(shader)
    if transfer is not None:
        return transfer.to_json()
    return (shader.colors, shader.visible) if isinstance(shader, Labels) else None


def _resized(color: Tensor, pane: Pane) -> Tensor:
    """Scales an image (h, w, 3) to the size of a part."""
    if color.shape[:2] == (pane.height, pane.width):
        return color
    planar = color.movedim(-1, 0)[None]
    size = (pane.height, pane.width)
    resized = torch.nn.functional.interpolate(planar, size, mode="bilinear", align_corners=False)
    return resized[0].movedim(0, -1)


def _paste(color: Tensor, pane: Pane, image: Tensor) -> None:
    """Writes an image into its part; what is larger is cut."""
    height, width = min(pane.height, image.shape[0]), min(pane.width, image.shape[1])
    color[pane.top : pane.top + height, pane.left : pane.left + width] = image[:height, :width]
