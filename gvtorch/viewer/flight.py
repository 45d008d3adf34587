"""`Flight`: a film's key frames, each a `ViewState` at a time, and the states between them.

Numbers follow monotone cubics (smooth.py), so what is allowed at the keys is allowed between
them: opacities, clips, lights, exposure, all floats of the state's JSON. The camera moves as
`cameras/motion.py` describes; its field of view is interpolated like any number. The points of a
transfer function slide if all keys have the same number of them; else the functions are resampled
at the points of all keys, and blended. Whatever else differs (names, switches, whole numbers, kinds
of shaders, lists of other lengths) keeps the value of a key until the next key.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.messages import one_line
from ..base.whole_file import write_text
from ..cameras import Camera
from ..cameras.motion import Motion
from .smooth import Smooth
from .state import Eye, ViewState, saved_state

Curve = Callable[[float], Any]
MAX_PICTURES = 2**31  # most pictures of a film
_TURN_KEYS = 4  # keys of a turntable: between them the camera turns, so that the circle is exact
#: Fields whose numbers increase along an axis, and must do so between keys too.
_INCREASING_FIELDS = {
    ("TransferFunction", "opacity"): (2, 0, slice(0, 1)),  # dimensions, axis, columns of the last
    ("TransferFunction", "color"): (2, 0, slice(0, 1)),
    ("ChannelLook", "window"): (1, 0, slice(None)),
    ("Slices", "window"): (1, 0, slice(None)),
    ("Clip", "boxes"): (3, 1, slice(None)),
    ("Clip", "without"): (3, 1, slice(None)),
}


class Flight:
    """View states as a function of time, smooth between keys.

    Attributes:
        keys: (seconds, state) of each key, in order; each state has a camera.
        closed: Whether the last key shows the same as the first, with others between: then the
            flight runs smoothly on from its end to its start, and a film of it loops.
    """

    def __init__(self, keys: Sequence[tuple[float, ViewState]]) -> None:
        """Takes the keys.

        Args:
            keys: Times in seconds, increasing, and the state shown at each.

        Raises:
            ValueError: There is no key, a time does not come after the one before, or a state has
                no camera.
        """
        if not len(keys):
            raise ValueError("Flight: at least one key is needed")
        times = [check.number("Flight", f"time of key {n}", key[0]) for n, key in enumerate(keys)]
        states = [check.instance("Flight", "state", key[1], ViewState) for key in keys]
        for n, (previous, time) in enumerate(pairwise(times), 1):
            if time <= previous:
                raise ValueError(f"Flight: key {n} at {time:g} s must come after {previous:g} s")
        cameras = [state.camera for state in states]
        if None in cameras:
            raise ValueError(f"Flight: key {cameras.index(None)} has no camera")
        self.keys = list(zip(times, states, strict=True))
        self._times, self._states = times, states
        contents = [state.changed(state.to_json()).to_json() for state in states]  # 1 becomes 1.0
        self.closed = len(keys) > 2 and contents[0] == contents[-1]
        fields = [{n: value for n, value in c.items() if n != "camera"} for c in contents]
        self._content_curve = _curve(times, fields, self.closed)
        self._eyes = eyes = [camera for camera in cameras if camera is not None]
        self._motion = Motion(times, [_pose(eye) for eye in eyes], self.closed)
        self._fov_curve = Smooth(times, [np.array(eye.fov) for eye in eyes], self.closed)

    @classmethod
    def read(cls, path: str | Path, now: ViewState) -> Flight:
        """Reads keys from a .json file: [{"time": seconds, "state": {...}}, ...]; a state may be
        the path of a state file, relative to this file's folder. Fields that the first state leaves
        out come from `now`, those that a later one leaves out from the key before it.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It holds something else; the message names file and key.
        """
        return KeyFile(path).flight(now)

    @classmethod
    def turntable(cls, state: ViewState, seconds: float = 10.0) -> Flight:
        """Returns a flight once around the target of a state's camera, about the camera's up
        vector; it ends where it begins.

        Raises:
            ValueError: The state has no camera, or `seconds` is not positive.
        """
        check.instance("Flight", "state", state, ViewState)
        seconds = check.number("Flight", "seconds", seconds, low=0, open_low=True)
        if (eye := state.camera) is None:
            raise ValueError("Flight: the state has no camera")
        up, target = np.array(eye.up) / np.linalg.norm(eye.up), np.array(eye.target)
        away = np.array(eye.eye) - target
        keys = [(0.0, state)]
        for n in range(1, _TURN_KEYS):  # Rodrigues' rotation of the part across the axis
            angle = 2 * np.pi * n / _TURN_KEYS
            axial = (up @ away) * up
            turned = axial + np.cos(angle) * (away - axial) + np.sin(angle) * np.cross(up, away)
            camera = replace(eye, eye=tuple((target + turned).tolist()))
            keys.append((seconds * n / _TURN_KEYS, replace(state, camera=camera)))
        return cls([*keys, (seconds, state)])

    def save(self, path: str | Path) -> None:
        """Writes a .json file, as `read` takes it."""
        if Path(path).suffix != ".json":
            raise ValueError(f"Flight: path must end in .json, got {str(path)!r}")
        content = [{"time": time, "state": state.to_json()} for time, state in self.keys]
        write_text(Path(path), json.dumps(content, indent=1) + "\n")

    @property
    def seconds(self) -> float:
        """Time from the first key to the last, in seconds."""
        return self._times[-1] - self._times[0]

    def at(self, time: float) -> ViewState:
        """Returns the state at a time: exactly a key's state at its time, the first state before
        the first key, the last after the last.

        Raises:
            ValueError: The state between two keys is invalid: a clip plane turns over, ...
        """
        time = check.number("Flight", "time", time)
        n = bisect_right(self._times, time) - 1
        if n < 0 or self._times[n] == time or n == len(self._times) - 1:
            return self._states[max(n, 0)]
        eye = _eye(self._motion.at(time), float(self._fov_curve.at(time)), self._eyes[n])
        try:
            state = self._states[n].changed(self._content_curve(time))
        except ValueError as error:
            raise ValueError(f"Flight: at {time:g} s, after key {n}: {one_line(error)}") from None
        return replace(state, camera=eye)

    def along(self, share: float) -> ViewState:
        """Returns the state at a share of the flight's time, 0 to 1."""
        share = check.number("Flight", "share", share, low=0, high=1)
        return self.at(self._times[-1] if share == 1 else self._times[0] + share * self.seconds)

    def states(self, fps: float = 25) -> Iterator[ViewState]:
        """Yields the state of each picture of a film with `fps` pictures a second, from the first
        key to the last; of a closed flight without the last, which is the first of the next round.
        """
        count = self.count(fps)
        steps = max(1, count if self.closed else count - 1)
        for n in range(count):
            yield self.along(n / steps)

    def count(self, fps: float = 25) -> int:
        """Returns the number of pictures of a film."""
        fps = check.number("Flight", "fps", fps, low=0, open_low=True)
        if self.seconds * fps > MAX_PICTURES:
            raise ValueError(
                f"Flight: {self.seconds:g} s of {fps:g} pictures each are more than "
                f"{MAX_PICTURES} pictures"
            )
        return max(1, round(self.seconds * fps) + (not self.closed))

    def __len__(self) -> int:
        return len(self.keys)

    def __repr__(self) -> str:
        return f"Flight({len(self)} keys, {self.seconds:g} s{', closed' * self.closed})"


class _SavedKey(NamedTuple):
    time: Any  # seconds, unchecked
    fields: Any  # of its state, unchecked
    path: Path | None  # the state's own file


class StateFile:
    """A saved state, read once, for a flight once around its target.

    Attributes:
        path: The file.
        first_fields: The fields of the state, unchecked.
    """

    def __init__(self, path: str | Path) -> None:
        """Reads the file; see `saved_state`."""
        self.path, self.first_fields = path, saved_state(path)

    def flight(self, now: ViewState) -> Flight:
        """Returns the flight; `now` supplies what the state leaves out."""
        return Flight.turntable(now.changed(self.first_fields, self.path))


class KeyFile:
    """The content of a file of key frames and of the state files that it names, read once.

    Attributes:
        path: The file.
        first_fields: The fields of the first key's state, unchecked.
    """

    def __init__(self, path: str | Path) -> None:
        """Reads the files; see `Flight.read`."""
        content = check.json_file("key frames", path)
        if not isinstance(content, list) or not content:
            raise ValueError(f'{path}: must be a list of keys {{"time": ..., "state": ...}}')
        self.path = path
        self._keys: list[_SavedKey] = []
        for n, key in enumerate(content):
            if not isinstance(key, dict) or set(key) != {"time", "state"}:
                raise ValueError(f'{path}: key {n}: must be {{"time": ..., "state": ...}}')
            state = key["state"]
            try:
                state_path = Path(path).parent / state if isinstance(state, str) else None
                fields = state if state_path is None else saved_state(state_path)
            except ValueError as error:
                raise ValueError(f"{path}: key {n}: {one_line(error)}") from None
            self._keys.append(_SavedKey(key["time"], fields, state_path))
        self.first_fields: dict[str, Any] = self._keys[0].fields

    def flight(self, now: ViewState) -> Flight:
        """Returns the flight; `now` supplies what the first state leaves out. ValueError: a key or
        a state is wrong.
        """
        keys = []
        for n, key in enumerate(self._keys):
            label = f"{self.path}: key {n}"
            now = now.changed(key.fields, label if key.path is None else f"{label}: {key.path}")
            keys.append((check.number(f"{label}: Flight", "time", key.time), now))
        try:
            return Flight(keys)
        except ValueError as error:
            raise ValueError(f"{self.path}: {one_line(error)}") from None


def _pose(eye: Eye) -> Tensor:
    """Returns a camera's pose in the world (4, 4): its axes (x right, y down, z forward), scaled by
    the distance from eye to target, and the target as their origin.
    """
    view = Camera.look_at(eye.eye, eye.target, eye.up).viewmats[0]
    target = torch.tensor(eye.target, dtype=torch.float64, device="cpu")
    distance = (target - torch.tensor(eye.eye, dtype=torch.float64, device="cpu")).norm()
    pose = torch.eye(4, dtype=torch.float64, device="cpu")
    pose[:3, :3], pose[:3, 3] = distance * view[:3, :3].T, target
    return pose


def _eye(pose: Tensor, fov: float, previous: Eye) -> Eye:
    """Returns the camera of a pose, with the camera model of the key before."""
    down, forward, origin = pose[:3, 1], pose[:3, 2], pose[:3, 3]
    vectors = (origin - forward, origin, -down / down.norm())
    eye, target, up = (tuple(vector.tolist()) for vector in vectors)
    return Eye(eye=eye, target=target, up=up, fov=fov, model=previous.model)


def _curve(
    times: Sequence[float], values: Sequence[Any], closed: bool, field_key: Any = None
) -> Curve:
    """Returns plain JSON as a function of time: smooth through consecutive keys whose values have
    one form, else the value of the key before. `field_key`: class and field that hold the values.
    """
    forms = [_value_form(value, field_key) for value in values]
    starts = [0, *(n for n in range(1, len(forms)) if forms[n] != forms[n - 1]), len(forms)]
    closed = closed and len(starts) == 2
    runs = [
        (times[a], times[b - 1], _smooth_curve(times[a:b], values[a:b], closed, field_key))
        for a, b in pairwise(starts)
    ]
    begins = [begin for begin, _, _ in runs]

    def evaluate(time: float) -> Any:
        begin, end, curve = runs[max(0, bisect_right(begins, time) - 1)]
        return curve(min(max(time, begin), end))

    return evaluate


def _value_form(value: Any, field_key: Any) -> Any:
    """Returns the form of a value; only values of equal form are interpolated."""
    if isinstance(value, float):
        return "number"
    if isinstance(value, dict):
        return ("kept",) if "kept" in value else (value.get("kind"), *sorted(value))
    if isinstance(value, list):
        if field_key in _INCREASING_FIELDS and field_key[0] == "TransferFunction":
            return "points"
        numbers = _as_array(value)
        return ("list", len(value)) if numbers is None else ("numbers", numbers.shape)
    return "other"


def _as_array(value: Any) -> np.ndarray | None:
    """Returns a list of floats, or of lists of them, as an array; None for anything else."""
    flat = value if isinstance(value, list) else []
    while flat and isinstance(flat[0], list):
        flat = [item for part in flat if isinstance(part, list) for item in part]
    if not flat or not all(isinstance(item, float) for item in flat):
        return None
    try:
        return np.array(value, np.float64)
    except ValueError:  # of different lengths
        return None


def _smooth_curve(
    times: Sequence[float], values: Sequence[Any], closed: bool, field_key: Any
) -> Curve:
    """Returns the curve through values of one form."""
    first = values[0]
    if isinstance(first, float):
        return _number_curve(times, [np.array(value) for value in values], closed)
    arrays = [array for value in values if (array := _as_array(value)) is not None]
    if arrays:
        if len({array.shape for array in arrays}) > 1:
            arrays = _resampled(arrays)
        return _number_curve(times, arrays, closed, field_key)
    if isinstance(first, list):
        items = [_curve(times, [v[n] for v in values], closed) for n in range(len(first))]
        return lambda time: [curve(time) for curve in items]
    if isinstance(first, dict) and "kept" not in first:
        fields = {
            name: _curve(times, [v[name] for v in values], closed, (first.get("kind"), name))
            for name in first
        }
        return lambda time: {name: curve(time) for name, curve in fields.items()}
    return lambda time: values[max(0, bisect_right(times, time) - 1)]


def _number_curve(
    times: Sequence[float], arrays: Sequence[np.ndarray], closed: bool, field_key: Any = None
) -> Curve:
    """Returns the curve through arrays of one shape. Numbers that must increase along an axis are
    interpolated as their first one and the gaps between them, which stay positive.
    """
    dimensions, axis, columns = _INCREASING_FIELDS.get(field_key, (None, 0, slice(None)))
    if arrays[0].ndim != dimensions:
        smooth = Smooth(times, arrays, closed)
        return lambda time: smooth.at(time).tolist()
    deltas = [np.copy(array) for array in arrays]
    for array in deltas:
        array[..., columns] = np.diff(array[..., columns], axis=axis, prepend=0)
    gaps = Smooth(times, deltas, closed)

    def evaluate(time: float) -> Any:
        values = gaps.at(time).copy()
        values[..., columns] = np.cumsum(values[..., columns], axis=axis)
        return values.tolist()

    return evaluate


def _resampled(functions: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Resamples piecewise linear functions, rows (value, number, ...), at the values of all."""
    values = np.unique(np.concatenate([function[:, 0] for function in functions]))
    return [
        np.stack([values, *(np.interp(values, function[:, 0], c) for c in function.T[1:])], 1)
        for function in functions
    ]
