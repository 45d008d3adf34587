"""`Pose`: the placement of a tree in the world. Rays are transformed into the tree's axes before
they are traced, and their hits back into the world; distances stay as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.records import Hits, Rays
from ..ops.shading import LightKind, ShadeParameters

_ROUNDING = 1e-5  # largest deviation from a rotation: a matrix may be given in float32


@dataclass(frozen=True, repr=False)
class Pose:
    """A rotation, mirrored or not, and a shift. Its numbers are on the host, so nothing blocks."""

    turn: tuple[tuple[float, ...], ...]  # (3, 3), from the tree's axes to the world's
    shift: tuple[float, ...]  # (3,) world position of the tree's origin

    @classmethod
    def of(cls, context: str, name: str, matrix: Any) -> Pose:
        """Returns the pose of a (4, 4) matrix from the tree's axes to the world's; a pose as it is.
        Raises ValueError if it is no such matrix, or stretches or shears.
        """
        if isinstance(matrix, Pose):
            return matrix
        numbers = check.reals(context, name, matrix, (4, 4))
        turn = numbers[:3, :3]
        deviation = float(
            (turn.T @ turn - torch.eye(3, dtype=torch.float64, device="cpu")).abs().max()
        )
        if numbers[3].tolist() != [0, 0, 0, 1] or deviation > _ROUNDING:
            raise ValueError(
                f"{context}: {name} must turn and shift, and neither stretch nor shear, "
                f"got {numbers.tolist()}"
            )
        left, _, right = torch.linalg.svd(turn)  # their product: the nearest orthogonal matrix
        return cls(tuple(map(tuple, (left @ right).tolist())), tuple(numbers[:3, 3].tolist()))

    @cached_property
    def _inverse(self) -> tuple[tuple[float, ...], ...]:
        """(3, 3), from the world's axes to the tree's."""
        return tuple(zip(*self.turn, strict=True))

    def to_tree(self, rays: Rays) -> Rays:
        """Returns world rays in the tree's axes, in float64."""
        rays = rays.to(dtype=torch.float64)
        columns = [o - s for o, s in zip(rays.origin.unbind(1), self.shift, strict=True)]
        return replace(
            rays,
            origin=_rotate(self._inverse, columns),
            direction=_rotate(self._inverse, rays.direction.unbind(1)),
        )

    def to_world(self, hits: Hits) -> Hits:
        """Returns hits with their normals in the world's axes."""
        return (
            hits if hits.normal is None else replace(hits, normal=self.world_vectors(hits.normal))
        )

    def world_vectors(self, directions: Tensor) -> Tensor:
        """Returns world directions (r, 3) of directions in the tree's axes."""
        return _rotate(self.turn, directions.unbind(1))

    def world_positions(self, positions: Tensor) -> Tensor:
        """Returns world positions (r, 3) of positions in the tree's axes."""
        rotated = self.world_vectors(positions).unbind(1)
        return torch.stack([p + s for p, s in zip(rotated, self.shift, strict=True)], 1)

    def light_to_tree(self, parameter_54: Tensor) -> Tensor:
        """Returns `ShadeParameters` (5, 4) with the light in the tree's axes."""
        parameters = ShadeParameters.read(parameter_54)
        light = torch.as_tensor(parameters.light, device=parameter_54.device).double()
        is_point = (
            torch.as_tensor(parameters.light_kind, device=parameter_54.device) == LightKind.POINT
        )
        columns = [
            torch.where(is_point, a - s, a)
            for a, s in zip(light.unbind(0), self.shift, strict=True)
        ]
        light_3 = _rotate(self._inverse, [column[None] for column in columns])[0].to(parameter_54)
        return torch.cat((light_3, parameter_54.reshape(-1)[3:])).view_as(parameter_54)

    def box(self, tree_box: Tensor) -> Tensor:
        """Returns (2, 3) corners of the world box around a box in the tree's axes."""
        columns = tree_box.unbind(1)
        corners = torch.stack([torch.stack(corner) for corner in product(*columns)])
        world_corners = self.world_positions(corners)
        return torch.stack((world_corners.amin(0), world_corners.amax(0)))

    def __repr__(self) -> str:
        return f"Pose(turn={self.turn}, shift={self.shift})"


#: (4, 4), from a tree's axes to the world's.
Matrix = Pose | Tensor | np.ndarray | Sequence[Sequence[float]]


def checked_poses(context: str, poses: Any) -> Any:
    """Returns a matrix as a `Pose`, and matrices by name as poses by name; None as it is."""
    if poses is None:
        return None
    if isinstance(poses, Mapping):
        return {
            name: Pose.of(context, f"pose of {name!r}", matrix) for name, matrix in poses.items()
        }
    return Pose.of(context, "pose", poses)


def poses_of(context: str, names: Collection[str], poses: Any) -> dict[str, Pose | None]:
    """Returns the pose of each tree, given a result of `checked_poses`; raises ValueError if a name
    is that of no tree, or there is one pose for several trees.
    """
    if poses is None or isinstance(poses, Mapping):
        by_name: Mapping[str, Pose] = poses or {}
        for name in by_name:
            if name not in names:
                raise ValueError(
                    f"{context}: pose of {name!r}: there is no such tree; "
                    f"there is {', '.join(names)}"
                )
        return {name: by_name.get(name) for name in names}
    if len(names) > 1:
        raise ValueError(f"{context}: poses of several trees must be given by name")
    return dict.fromkeys(names, poses)


def pose_alone(context: str, poses: Any) -> Pose | None:
    """Returns the pose of a tree that has no name, given a result of `checked_poses`; raises
    ValueError if poses are given by name.
    """
    if isinstance(poses, Mapping):
        raise ValueError(f"{context}: poses by name are for trees by name")
    pose: Pose | None = poses
    return pose


def world_box(tree_box: Tensor, pose: Pose | None) -> Tensor:
    """Returns (2, 3) corners of the world box around a tree's box."""
    return tree_box if pose is None else pose.box(tree_box)


def _rotate(rows: Sequence[Sequence[float]], columns: Sequence[Tensor]) -> Tensor:
    """Returns (r, 3) products of a matrix and columns (r,), in one order: equal bits everywhere."""
    x, y, z = columns
    return torch.stack([a * x + b * y + c * z for a, b, c in rows], 1)
