"""Poses of cameras, (4, 4) float64 from the world to the camera: made from positions, directions
and angles, checked, and extrapolated from frame to frame. Axes are OpenCV's: x right, y down, z
forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.volume import DIRECTIONS

Numbers = float | Sequence[float] | Tensor
Up = str | Sequence[float] | Tensor  # a name of `DIRECTIONS` such as "+z", or (3,) world
_MAX_TURN_RADIANS = 0.1  # from frame to frame; a camera that turns by more has jumped


class Coordinates(Enum):
    """What positions and lengths are relative to."""

    WORLD = "world"  # world units
    BOX = "box"  # the scene's box: its centre is 0 and its largest side 1

    @classmethod
    def of(cls, context: str, value: Coordinates | str) -> Coordinates:
        """Returns the member of this name; raises ValueError where there is none."""
        try:
            return cls(value)
        except ValueError:
            raise ValueError(f"{context}: frame must be 'world' or 'box', got {value!r}") from None

    def unit(self, box: Tensor) -> float:
        """Returns their unit of length in world units, given the (2, 3) box of the scene."""
        return 1.0 if self is Coordinates.WORLD else float((box[1] - box[0]).max())


def batches(context: str, **values: tuple[Any, tuple[int, ...]]) -> list[Tensor]:
    """Returns numbers of one camera (*shape), or of n cameras (n, *shape), broadcast; `values` are
    pairs of the numbers and their `shape`. Raises ValueError where they do not match.
    """
    parsed, sizes = [], []
    for name, (value, shape) in values.items():
        numbers = check.reals(context, name, value)
        batch = numbers.dim() - len(shape)
        if batch not in (0, 1) or numbers.shape[batch:] != shape:
            batch_shape = str(("n", *shape)).replace("'", "")
            got = tuple(numbers.shape)
            raise ValueError(
                f"{context}: {name} must be {shape or 'a number'} or {batch_shape}, got {got}"
            )
        parsed.append((numbers, shape))
        sizes.append(numbers.shape[:batch])
    try:
        size = np.broadcast_shapes(*sizes)  # torch's imports sympy: half a second
    except ValueError:
        raise ValueError(
            f"{context}: {', '.join(values)} do not match, they have different lengths"
        ) from None
    return [numbers.expand((*size, *shape)).contiguous() for numbers, shape in parsed]


def check_matrices(viewmats: Tensor, Ks: Tensor) -> None:
    """Raises ValueError unless these are poses (n, 4, 4) and intrinsics (n, 3, 3)."""
    rotation, bottom = viewmats[:, :3, :3], viewmats.new_tensor([0, 0, 0, 1])
    error = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64, device="cpu")).abs().max()
    rotates = error <= 1e-3 and (torch.linalg.det(rotation) >= 0).all()
    last = (viewmats[:, 3] == bottom).all() and (Ks[:, 2] == bottom[1:]).all()
    for wanted, holds in {
        "Ks must have positive focal lengths": (Ks[:, (0, 1), (0, 1)] > 0).all(),
        "viewmats must hold rotations (orthonormal, determinant +1)": rotates,
        "last rows must be (0, 0, 0, 1) of viewmats, (0, 0, 1) of Ks": last,
        "Ks must have no skew": (Ks[:, (0, 1), (1, 0)] == 0).all(),
    }.items():
        if not holds:
            raise ValueError(f"Camera: {wanted}")


def upward(context: str, up: Up) -> Tensor:
    """Returns the up direction, (3,) float64, from a name such as "+z" or three numbers; raises
    ValueError where it is neither, or zero.
    """
    if isinstance(up, str):
        if up not in DIRECTIONS:
            names = ", ".join(DIRECTIONS)
            raise ValueError(f"{context}: up must be one of {names} or three numbers, got {up!r}")
        axis, sign = divmod(DIRECTIONS.index(up), 2)
        return torch.eye(3, dtype=torch.float64, device="cpu")[axis] * (1 - 2 * sign)
    direction = torch.tensor(check.triple(context, "up", up), dtype=torch.float64, device="cpu")
    if not bool(direction.any()):
        raise ValueError(f"{context}: up must not be zero")
    return direction


def orbit_pose(az: Tensor, el: Tensor, distance: Tensor, up: Tensor | None) -> Tensor:
    """Returns poses (..., 4, 4) that look at the origin from azimuths, elevations (radians) and
    distances (...), see `Camera.orbit`; `up` is (3,), or None for +y.
    """
    outward = torch.stack((az.sin() * el.cos(), el.sin(), az.cos() * el.cos()), -1)
    sign = torch.where(el.cos() < -1e-12, -1.0, 1.0)  # keeps up upward beyond a pole
    right = torch.stack((sign * az.cos(), torch.zeros_like(az), -sign * az.sin()), -1)
    if up is not None:
        axes = _orbit_axes(up)
        outward, right = outward @ axes, right @ axes
    return _pose(outward * distance[..., None], -outward, right)


def _orbit_axes(up: Tensor) -> Tensor:
    """Returns (3, 3), the directions of an orbit's x, y and z axes for another `up`."""
    up = up / up.norm()
    right = torch.zeros_like(up)
    right[int(up[0].abs() > 0.9)] = 1
    right = right - (right @ up) * up
    right = right / right.norm()
    return torch.stack((right, up, torch.linalg.cross(right, up)))


def look_at_pose(eye: Tensor, forward: Tensor, up: Tensor) -> Tensor:
    """Returns poses (..., 4, 4) at positions `eye` that look along unit vectors `forward`, (..., 3)
    each. Where `up` (..., 3) is parallel to the view, -z is used instead (+y for a view along z).
    """
    right = torch.linalg.cross(forward, up)
    along_z = forward[..., 2:3].abs() > 0.9
    fallback = torch.where(along_z, *forward.new_tensor([[0, 1, 0], [0, 0, -1]]))
    parallel = right.norm(dim=-1, keepdim=True) < 1e-9 * up.norm(dim=-1, keepdim=True) + 1e-300
    right = torch.where(parallel, torch.linalg.cross(forward, fallback), right)
    return _pose(eye, forward, right / right.norm(dim=-1, keepdim=True))


def _pose(eye: Tensor, forward: Tensor, right: Tensor) -> Tensor:
    """Returns (..., 4, 4), world to camera, from a position and two orthonormal directions."""
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack((right, down, forward), dim=-2)
    view = torch.eye(4, dtype=torch.float64, device="cpu").repeat(*eye.shape[:-1], 1, 1)
    view[..., :3, :3] = rotation
    view[..., :3, 3] = -(rotation @ eye[..., None])[..., 0]
    return view


def continued(now: Tensor, before: Tensor, frames: float, moving: slice, axes: slice) -> Tensor:
    """Extrapolates the numbers (n, c) float64 of cameras, or of rays, by `frames` frames, given
    those of now and of one frame before; does not wait for the device. The columns `moving` change;
    `axes`, some of these, hold unit vectors, three columns each: where one of them turned by more
    than 0.1 radian, that row stays as it is now.
    """
    motion = now - before
    turn_squared = motion[:, axes].unflatten(1, (-1, 3)).square().sum(2).amax(1, keepdim=True)
    follows = turn_squared <= _MAX_TURN_RADIANS * _MAX_TURN_RADIANS
    moved = now.clone()
    moved[:, moving] += torch.where(follows, frames * motion[:, moving], 0.0)
    return moved
