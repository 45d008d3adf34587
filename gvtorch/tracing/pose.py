"""`Pose`: where a tree stands in the world. Rays are turned into the tree's own axes before they go
through it, and what they bring back is turned out again; distances stay as they are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.records import Hits, Rays
from ..ops.shading import LightKind, ShadeParameters

_ROUNDING = 1e-5  # by how much a turn given in float32 may be none


@dataclass(frozen=True, repr=False)
class Pose:
    """A turn, mirrored or not, and a shift. The numbers stay on the host: nobody waits for them."""

    turn: tuple[tuple[float, ...], ...]  # (3, 3), from own axes to the world's
    shift: tuple[float, ...]  # (3,) world place of the own origin

    @classmethod
    def of(cls, where: str, name: str, matrix: Any) -> Pose:
        """Returns the pose of a (4, 4) matrix from own axes to the world; a pose as it is. Raises
        ValueError if it is no such matrix, or stretches or shears.
        """
        if isinstance(matrix, Pose):
            return matrix
        numbers = check.reals(where, name, matrix, (4, 4))
        turn = numbers[:3, :3]
        off = float((turn.T @ turn - torch.eye(3, dtype=torch.float64)).abs().max())
        if numbers[3].tolist() != [0, 0, 0, 1] or off > _ROUNDING:
            raise ValueError(
                f"{where}: {name} must turn and shift, and neither stretch nor shear, "
                f"got {numbers.tolist()}"
            )
        left, _, right = torch.linalg.svd(turn)  # the nearest that keeps lengths
        return cls(tuple(map(tuple, (left @ right).tolist())), tuple(numbers[:3, 3].tolist()))

    def inside(self, rays: Rays) -> Rays:
        """World rays in own axes, in float64."""
        origin, direction = rays.origin.double(), rays.direction.double()
        columns = [o - s for o, s in zip(origin.unbind(1), self.shift, strict=True)]
        back = tuple(zip(*self.turn, strict=True))
        own = rays.to(dtype=torch.float64)
        return replace(
            own, origin=_turned(back, columns), direction=_turned(back, direction.unbind(1))
        )

    def outside(self, hits: Hits) -> Hits:
        """Hits with their normals in the world's axes."""
        return hits if hits.normal is None else replace(hits, normal=self.ways(hits.normal))

    def ways(self, own: Tensor) -> Tensor:
        """World directions (r, 3) of directions in own axes."""
        return _turned(self.turn, own.unbind(1))

    def places(self, own: Tensor) -> Tensor:
        """World places (r, 3) of places in own axes."""
        turned = self.ways(own).unbind(1)
        return torch.stack([p + s for p, s in zip(turned, self.shift, strict=True)], 1)

    def lit(self, parameter_54: Tensor) -> Tensor:
        """A shader's numbers (5, 4) with its light in own axes; see `ShadeParameters`."""
        given = ShadeParameters.read(parameter_54)
        light = torch.as_tensor(given.light).double()
        at_a_place = torch.as_tensor(given.light_kind) == LightKind.POINT
        moved = [
            torch.where(at_a_place, a - s, a)
            for a, s in zip(light.unbind(0), self.shift, strict=True)
        ]
        back = tuple(zip(*self.turn, strict=True))
        own = _turned(back, [column[None] for column in moved])[0].to(parameter_54)
        return torch.cat((own, parameter_54.reshape(-1)[3:])).view_as(parameter_54)

    def box(self, own: Tensor) -> Tensor:
        """(2, 3) corners of the world's box around a box in own axes."""
        columns = own.unbind(1)
        corners = torch.stack([torch.stack(one) for one in product(*columns)])
        placed = self.places(corners)
        return torch.stack((placed.amin(0), placed.amax(0)))

    def __repr__(self) -> str:
        return f"Pose(turn={self.turn}, shift={self.shift})"


#: (4, 4), from a tree's own axes to the world's.
Matrix = Pose | Tensor | np.ndarray | Sequence[Sequence[float]]


def checked_poses(where: str, given: Any) -> Any:
    """Returns a matrix as a `Pose`, and matrices by name as poses by name; None as it is."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        return {name: Pose.of(where, f"pose of {name!r}", one) for name, one in given.items()}
    return Pose.of(where, "pose", given)


def poses_of(where: str, names: Collection[str], given: Any) -> dict[str, Pose | None]:
    """Returns the pose of each tree, given what `checked_poses` returned; raises ValueError if a
    name is that of no tree, or there is one pose for several trees.
    """
    if given is None or isinstance(given, Mapping):
        by_name: Mapping[str, Pose] = given or {}
        for name in by_name:
            if name not in names:
                raise ValueError(
                    f"{where}: pose of {name!r}: there is no such tree; there is {', '.join(names)}"
                )
        return {name: by_name.get(name) for name in names}
    if len(names) > 1:
        raise ValueError(f"{where}: poses of several trees must be given by name")
    return dict.fromkeys(names, given)


def world_box(own: Tensor, pose: Pose | None) -> Tensor:
    """(2, 3) corners of the world's box around that of a tree."""
    return own if pose is None else pose.box(own)


def _turned(rows: Sequence[Sequence[float]], columns: Sequence[Tensor]) -> Tensor:
    """(r, 3) of three columns (r,); sums in order, so that every device has the same bits."""
    x, y, z = columns
    return torch.stack([a * x + b * y + c * z for a, b, c in rows], 1)
