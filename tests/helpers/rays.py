"""Rays of cameras, and along given directions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import gvtorch as gv


def rays_along(
    origin: Tensor, direction: Tensor | Sequence[float], cone: float = 0.0, device: str = "cpu"
) -> gv.Rays:
    """Returns endless rays from `origin` (r, 3), along one direction or one each, of one width."""
    zeros = torch.zeros((len(origin), 2), dtype=torch.float64)
    unit = torch.nn.functional.normalize(torch.as_tensor(direction).double(), dim=-1)
    rays = gv.Rays(
        origin=origin,
        direction=unit.expand_as(origin).contiguous(),
        cone=zeros + torch.tensor([cone, 0.0]),
        range=zeros + torch.tensor([0.0, torch.inf]),
    )
    return rays.to(device)


def camera_rays(tree, size=24, **options):
    return gv.Camera.orbit(width=size, height=size, **options).placed(tree.box).rays()


def rays_of_cameras(tree, size: int, *distances: float) -> gv.Rays:
    """Returns the rays of cameras at several distances, one camera's after another's: what the twin
    takes depends on the longest ray, not on their number.
    """
    cameras = [camera_rays(tree, size, distance=distance) for distance in distances]
    names = ("origin", "direction", "cone", "range")
    columns = {name: torch.cat([getattr(rays, name) for rays in cameras]) for name in names}
    return gv.Rays(**columns, width=size)


def world_rays(tree_box, count: int, device) -> tuple[torch.Tensor, ...]:
    camera = gv.Camera.orbit(width=count // 3, height=3, distance=1.2).placed(tree_box)
    rays = camera.rays()
    columns = (rays.origin, rays.direction, rays.cone, rays.range)
    return tuple(t.float().to(device) for t in columns)
