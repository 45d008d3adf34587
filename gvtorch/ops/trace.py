"""`trace_rays` and `shade_rays`: rays through an N3 tree, checked and sent to a backend."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..base import constants as config
from .arguments import RayArguments, ShadeArguments, TraceArguments
from .checks import check_shade, check_trace
from .op import Backend, choose_backend
from .reference import march, shaders


def trace_rays(
    rays: RayArguments, arguments: TraceArguments, *, backend: Backend = "auto"
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Traces rays through a tree and shades what they meet with a transfer function.

    Mutates `request_tn` (what rays missed), `stamp_t` and `stamp_b` (what rays used).

    Args:
        rays: The rays. Where they begin with a transmittance, the colour is what these pieces of
            rays add, and alpha is the whole rays' so far.
        arguments: What they go through.
        backend: auto, reference, cpp or cuda.

    Returns:
        color (r, 3) premultiplied linear RGB, alpha (r, 1), depth (r, 1) world units or +inf, in
        the table's dtype; samples (r,) int32, missed (r,) bool: something that the ray saw was not
        there.

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.

    Source: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels", I3D 2009, sections 3 and 4.
    """
    check_trace("trace_rays", rays, arguments)
    if choose_backend(backend, rays.origin_r3.device) == "reference":
        return march.trace_rays(rays, arguments)
    return torch.ops.gvtorch.trace_rays(*rays, *arguments)


def shade_rays(
    rays: RayArguments,
    arguments: TraceArguments,
    shading: ShadeArguments,
    parameter_54: Tensor,
    *,
    op: str | None = None,
    backend: Backend = "auto",
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Traces rays through a tree and shades what they meet with a fused shader, or a user's.

    Args:
        rays: The rays.
        arguments: What they go through.
        shading: Which shader, and its channels.
        parameter_54: (5, 4) in the table's dtype, as `shading.ShadeParameters` packs them. For a
            user's op (20 + k,): the same and its own k numbers.
        op: Name of a user's op, see `cpp_ext.user`; None: `shading.shader` tells which.
        backend: auto, reference, cpp or cuda.

    Returns:
        color, alpha, depth, samples, missed as `trace_rays`; normal (r, 3) in the world, towards
        the eye, unit or zero; features (r, c).

    Raises:
        ValueError: A tensor of the wrong shape, dtype or device, or a number out of its range.

    Source: Blinn, SIGGRAPH 1977; Engel, Kraus, Ertl, Graphics Hardware 2001.
    """
    check_shade("shade_rays", rays, arguments, shading, parameter_54, own=op is not None)
    if choose_backend(backend, rays.origin_r3.device) != "reference":
        return op_of(op)(*rays, *arguments, *shading, parameter_54)
    if op is not None:
        raise ValueError("shade_rays: a shader in C++ has no reference: write a ModuleShader")
    return shaders.shade_rays(rays, arguments, shading, parameter_54)


def op_of(name: str | None) -> Any:
    """Returns the op of a user's shader; None: that of the fused shaders."""
    if name is None:
        return torch.ops.gvtorch.shade_rays
    return getattr(torch.ops.gvtorch_user, name)


def most_intervals(length: float, step: float) -> int:
    """Returns how many intervals a ray of `length` can have.

    Raises:
        ValueError: More than a ray can count.
    """
    count = math.ceil(length / step)
    if count > config.MAX_INTERVALS:
        raise ValueError(
            f"step: {step:g} world units cuts a ray of {length:g} into {count} intervals, "
            f"more than {config.MAX_INTERVALS}"
        )
    return count
