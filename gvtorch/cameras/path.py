"""`CameraPath`: a camera that moves, from key frames.

Positions, targets and fields of view run along Catmull-Rom curves, which pass through every key and
have no corners; fields of view stay between the smallest and the largest of the keys. Source:
Catmull and Rom, "A class of local interpolating splines", 1974.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..base import check
from ..base.messages import one_line
from .camera import Camera
from .models import CameraModel, model_of
from .poses import Up, upward

_DEFAULT_UP, _DEFAULT_FOV = (0.0, 1.0, 0.0), 30.0  # of keys that have none


class CameraPath:
    """Cameras along a path, given by a number from 0 (the first key) to 1 (the last)."""

    def __init__(
        self,
        eye: Sequence[Sequence[float]],
        target: Sequence[Sequence[float]],
        up: Sequence[Sequence[float]] | None = None,
        fov: Sequence[float] | None = None,
    ) -> None:
        """Takes the keys, one row each.

        Args:
            eye: (k, 3) world units, k >= 1.
            target: (k, 3) world units, the point in the middle of the picture.
            up: (k, 3); +y if left out.
            fov: (k,) vertical field of view, degrees; 30 if left out.

        Raises:
            ValueError: The lists differ in length, or a number is not finite.
        """
        eye = check.items("CameraPath", "eye", eye)
        count = len(eye)
        if count < 1:
            raise ValueError("CameraPath: at least one key is needed")
        up = [_DEFAULT_UP] * count if up is None else up
        fov = [_DEFAULT_FOV] * count if fov is None else fov
        given = {"eye": eye, "target": target, "up": up, "fov": fov}
        lists = {name: check.items("CameraPath", name, values) for name, values in given.items()}
        for name, values in lists.items():
            if len(values) != count:
                unit = "numbers" if name == "fov" else "rows as eye has"
                raise ValueError(f"CameraPath: {name} must have {count} {unit}, got {len(values)}")
        angles = [[check.number("CameraPath", "fov", v, low=0, high=360)] for v in lists.pop("fov")]
        rows = [[check.triple("CameraPath", n, v) for v in values] for n, values in lists.items()]
        parts = [torch.tensor(part, dtype=torch.float64, device="cpu") for part in (*rows, angles)]
        self._keys = torch.cat(parts, 1)  # (k, 10)

    @classmethod
    def orbit(
        cls,
        box: Tensor,
        model: CameraModel = "pinhole",
        fov: float | None = None,
        *,
        azimuth: float = 30.0,
        elevation: float = 20.0,
        distance: float | None = None,
        up: Up = "+y",
        fit_size: tuple[int, int] | None = None,
    ) -> CameraPath:
        """Goes once around a box (2, 3); see `Camera.orbit` for the numbers.

        Args:
            box: World.
            model: Name of the camera model.
            fov: Degrees; the model's default if left out.
            azimuth, elevation, distance, up: Of the start.
            fit_size: (width, height) of pictures that show the whole box all the way around: finds
                the distance, which stays the same.

        Raises:
            ValueError: As `Camera.orbit`.
        """
        context = "CameraPath.orbit"
        fov = model_of(context, model).fov if fov is None else fov
        box = check.reals(context, "box", box, (2, 3))
        azimuth = check.number(context, "azimuth", azimuth)
        azimuths = azimuth + torch.linspace(0, 360, 37, dtype=torch.float32, device="cpu")
        if fit_size is not None:
            if distance is not None:
                problem = f"fit_size finds the distance: leave it out, got {distance}"
                raise ValueError(f"{context}: {problem}")
            w, h = check.items(context, "fit_size", fit_size)
            fitted = Camera.orbit(azimuths, elevation, None, fov, w, h, model, up=up, fit=True)
            farthest = (box.mean(0) - _eye_positions(fitted.placed(box))).norm(dim=1).amax()
            distance = float(farthest / (box[1] - box[0]).max())
        cameras = Camera.orbit(azimuths, elevation, distance, width=1, height=1, up=up).placed(box)
        eye = _eye_positions(cameras)
        center = box.mean(0).expand_as(eye)
        ups = upward(context, up).expand_as(eye)
        if abs(math.cos(math.radians(elevation))) < 1e-9:  # at a pole `up` leads nowhere
            ups = -cameras.viewmats[:, 1, :3]
        return cls(eye.tolist(), center.tolist(), ups.tolist(), [fov] * len(eye))

    @classmethod
    def from_json(
        cls, path: str | Path, *, up: Up | None = None, fov: float | None = None
    ) -> CameraPath:
        """Reads a list of keys: [{"eye": [x, y, z], "target": [x, y, z], "up": ..., "fov": ...}].
        `up` and `fov` are for keys that have none; +y and 30 degrees if left out.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file holds something else, or `up` or `fov` is given although every key
                has its own; the message names the file.
        """
        keys = check.json_file("camera path", path)
        if not isinstance(keys, list) or not all(isinstance(key, Mapping) for key in keys):
            raise ValueError(f'{path}: must be a list of keys {{"eye": ..., "target": ...}}')
        for number, key in enumerate(keys):
            unknown = sorted(set(key) - {"eye", "target", "up", "fov"})
            missing = sorted({"eye", "target"} - set(key))
            if unknown or missing:
                problem = f"unknown {unknown[0]!r}" if unknown else f"{missing[0]!r} is missing"
                raise ValueError(f"{path}: key {number}: {problem}")
        for name, value in (("up", up), ("fov", fov)):
            if value is not None and all(name in key for key in keys):
                raise ValueError(f"{path}: each key has its own {name}: leave out {name}={value}")
        defaults = {
            "up": _DEFAULT_UP if up is None else upward("CameraPath", up).tolist(),
            "fov": _DEFAULT_FOV if fov is None else fov,
        }
        full_keys = [{**defaults, **key} for key in keys]
        try:
            names = ("eye", "target", "up", "fov")
            return cls(*([key[name] for key in full_keys] for name in names))
        except ValueError as error:
            raise ValueError(f"{path}: {one_line(error)}") from None

    def __repr__(self) -> str:
        return f"CameraPath({len(self._keys)} keys)"

    def camera(self, at: float, width: int, height: int, model: CameraModel = "pinhole") -> Camera:
        """Returns the camera at a position of the path.

        Args:
            at: 0 for the first key, 1 for the last; keys are evenly spaced.
            width, height: Pixels.
            model: Name of the camera model.
        """
        at = check.number("CameraPath", "at", at, low=0, high=1)
        last = len(self._keys) - 1
        position = at * last
        first = min(int(position), max(last - 1, 0))
        t = position - first
        index = torch.arange(first - 1, first + 3, device="cpu").clamp(0, last)
        a, b, c, d = self._keys[index]
        # Cubic through b and c, with the slope at each that of the chord between its neighbours.
        key = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
        fov = float(key[9].clamp(*self._keys[:, 9].aminmax()))
        eye, target, up = key[:3], key[3:6], key[6:9]
        return Camera.look_at(eye, target, up, fov, width, height, model)


def _eye_positions(cameras: Camera) -> Tensor:
    """Returns (n, 3) world positions of cameras."""
    rotation, translation = cameras.viewmats[:, :3, :3], cameras.viewmats[:, :3, 3:]
    return -(rotation.mT @ translation)[..., 0]
