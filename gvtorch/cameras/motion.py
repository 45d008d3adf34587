"""`Motion`: poses of a camera along a smooth path, from key frames with times.

A pose is a similarity transform: it turns, shifts and scales the axes of a camera that looks at the
origin from distance 1. Between two keys it moves along powers of the transform from one to the
other: an orbit stays a circle around its target, a zoom comes nearer by the same factor each second
and ends at the target, a shift is straight. Several keys are joined by the cubic curve of the
group, which passes through every key without a jump of velocity.

Source: Kim, Kim and Shin, "A general construction scheme for unit quaternion curves with simple
high order derivatives", SIGGRAPH 1995 (cumulative Bernstein basis), here in the group of
similarities; its exponential: Eade, "Lie groups for 2D and 3D transformations", 2013; Shepperd,
"Quaternion from rotation matrix", 1978.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

_MAX_SPEED_RATIO = 2.0  # largest speed at a key, over that of the slower neighbouring interval


class Motion:
    """Poses (4, 4) float64 by time."""

    def __init__(self, times: Sequence[float], poses: Sequence[Tensor], closed: bool) -> None:
        """Takes the keys: increasing times; poses (4, 4) float64, each a rotation times a positive
        scale, and a shift; and whether the path is `closed`: its last key is the first, and it
        continues there.
        """
        self._times, self._poses = list(times), list(poses)
        spans = [b - a for a, b in pairwise(times)]
        steps = [
            logarithm(torch.linalg.solve(a, b)) / span
            for (a, b), span in zip(pairwise(poses), spans, strict=True)
        ]
        pairs = zip(pairwise(steps), pairwise(spans), strict=True)
        speeds = [_key_velocity(*velocities, *durations) for velocities, durations in pairs]
        if closed and len(steps) > 1:
            joint = _key_velocity(steps[-1], steps[0], spans[-1], spans[0])
            speeds = [joint, *speeds, joint]
        else:
            speeds = [*steps[:1], *speeds, *steps[-1:]]
        # Of each interval: three steps, whose product leads to the next key.
        self._interval_steps = []
        for n, span in enumerate(spans):
            first, last = speeds[n] * span / 3, speeds[n + 1] * span / 3
            full_step = torch.linalg.solve(poses[n], poses[n + 1])
            middle = exponential(-first) @ full_step @ exponential(-last)
            self._interval_steps.append((first, logarithm(middle), last))

    def at(self, time: float) -> Tensor:
        """Returns the pose at a time; the first before the first key, the last after the last."""
        n = bisect_right(self._times, time) - 1
        if n < 0 or n >= len(self._interval_steps):
            return self._poses[max(n, 0)]
        s = (time - self._times[n]) / (self._times[n + 1] - self._times[n])
        pose = self._poses[n]
        weights = (1 - (1 - s) ** 3, s * s * (3 - 2 * s), s**3)
        for weight, step in zip(weights, self._interval_steps[n], strict=True):
            pose = pose @ exponential(weight * step)
        return pose


def _key_velocity(before: Tensor, after: Tensor, span_before: float, span_after: float) -> Tensor:
    """Returns the velocity at a key: that of the parabola through it and its neighbours, limited
    where an interval next to it is slow, so that a camera that rests between two keys does rest.
    """
    speed = (span_after * before + span_before * after) / (span_before + span_after)
    limit = _MAX_SPEED_RATIO * min(float(before.norm()), float(after.norm()))
    length = float(speed.norm())
    return speed if length <= limit else speed * (limit / length)


def exponential(step: Tensor) -> Tensor:
    """Returns the pose (4, 4) that a velocity (7,) reaches from the identity in time 1: growth (1),
    turning (3), shift (3).
    """
    scaled, integral = _flow(step)
    pose = torch.eye(4, dtype=step.dtype, device="cpu")
    pose[:3, :3], pose[:3, 3] = scaled, integral @ step[4:]
    return pose


def logarithm(pose: Tensor) -> Tensor:
    """Returns the velocity (7,) whose exponential is the pose, with the shortest turn."""
    scale = float(torch.linalg.det(pose[:3, :3])) ** (1 / 3)
    step = pose.new_zeros(7)
    step[0] = math.log(scale)
    step[1:4] = _rotation_vector(pose[:3, :3] / scale)
    step[4:] = torch.linalg.solve(_flow(step)[1], pose[:3, 3])
    return step


def _flow(step: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the scaled rotation (3, 3) by growth and turning in time 1, and its integral."""
    growth, angle = float(step[0]), float(step[1:4].norm())
    x, y, z = (step[1:4] / angle if angle > 0 else step[1:4]).tolist()
    cross = step.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    powers = torch.stack((torch.eye(3, dtype=step.dtype, device="cpu"), cross, cross @ cross))
    scale, rate = math.exp(growth), complex(growth, angle)
    exp_minus_1 = complex(
        math.expm1(growth) * math.cos(angle) - 2 * math.sin(angle / 2) ** 2,
        scale * math.sin(angle),
    )  # exp(rate) - 1, also where the rate is small
    mean = exp_minus_1 / rate if rate else 1 + 0j
    mean_growth = math.expm1(growth) / growth if growth else 1.0
    rotation_weights = step.new_tensor([1, math.sin(angle), 2 * math.sin(angle / 2) ** 2])
    integral_weights = step.new_tensor([mean_growth, mean.imag, mean_growth - mean.real])
    return (
        scale * torch.tensordot(rotation_weights, powers, 1),
        torch.tensordot(integral_weights, powers, 1),
    )


def _rotation_vector(rotation: Tensor) -> Tensor:
    """Returns axis times angle (3,) of a rotation, the angle from 0 to pi."""
    w, *vector = quaternion_of(rotation)
    xyz = rotation.new_tensor(vector)
    length = float(xyz.norm())
    angle = 2 * math.atan2(length, w)
    return xyz * (angle / length) if length > 0 else xyz


def quaternion_of(rotation: Tensor) -> list[float]:
    """Returns the unit quaternion w >= 0, x, y, z of a rotation (3, 3), float64."""
    r = rotation
    trace = float(r.trace())
    squares = [1 + trace, *(1 + 2 * float(r[n, n]) - trace for n in range(3))]  # 4 w^2, 4 x^2, ...
    largest = max(range(4), key=squares.__getitem__)
    skew = [float(r[2, 1] - r[1, 2]), float(r[0, 2] - r[2, 0]), float(r[1, 0] - r[0, 1])]
    if largest == 0:
        q = [squares[0], *skew]
    else:
        i = largest - 1
        q = [skew[i], *(float(r[i, n] + r[n, i]) for n in range(3))]
        q[largest] = squares[largest]
    length = sum(n * n for n in q) ** 0.5 * (-1 if q[0] < 0 else 1)
    return [n / length for n in q]


def rotation_of(quaternion: Sequence[float]) -> Tensor:
    """Returns the rotation (3, 3) of w, x, y, z of any length but 0."""
    length = sum(n * n for n in quaternion) ** 0.5
    w, x, y, z = (n / length for n in quaternion)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64, device="cpu")
