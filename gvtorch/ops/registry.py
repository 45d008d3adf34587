"""Joins the compiled ops to torch: loads the libraries and gives each op its fake (shapes without
data).

The schema of an op stands once, in cpp_ext/csrc/entry*.h.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from .. import cpp_ext


def available() -> dict[str, str]:
    """Returns, for `reference`, `cpp` and `cuda`, an empty text or the reason why it can't be
    used."""
    return {"reference": "", **_reasons}


def _fake_trace_rays(*args: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    rays, table_lm4 = args[0].shape[0], args[13]
    return (
        table_lm4.new_empty((rays, 3)),
        table_lm4.new_empty((rays, 1)),
        table_lm4.new_empty((rays, 1)),
        table_lm4.new_empty((rays,), dtype=torch.int32),
        table_lm4.new_empty((rays,), dtype=torch.bool),
    )


def _fake_shade_rays(*args: Any) -> tuple[Tensor, ...]:
    rays, table, features = args[0].shape[0], args[13], args[23]
    return (
        *_fake_trace_rays(*args),
        table.new_empty((rays, 3)),
        table.new_empty((rays, features)),
    )


@functools.cache
def add_user_op(name: str) -> None:
    """Gives the op of a user's shader, which is loaded, its fake; once."""
    torch.library.register_fake(f"gvtorch_user::{name}", _fake_shade_rays)


def _fake_compact_requests(request_tn: Tensor, capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    words = request_tn.new_empty((capacity,))
    return words, torch.empty_like(words), request_tn.new_empty((3,), dtype=torch.int64)


def _fake_lru_partition(order_k: Tensor, stamp_s: Tensor, frame_1: Tensor) -> tuple[Tensor, Tensor]:
    return torch.empty_like(order_k), order_k.new_empty((1,), dtype=torch.int64)


def _fake_locate(loc_t4: Tensor, node_k: Tensor, branching: int, per_tile: int) -> Tensor:
    return node_k.new_empty((node_k.shape[0], 4))


def _fake_lacking(*args: Any) -> Tensor:
    node_k = args[5]
    return torch.empty_like(node_k, dtype=torch.bool)


def _fake_cut_bricks(values_zyxc: Tensor, place_k3: Tensor, brick_size: int, border: int) -> Tensor:
    side = brick_size + 2 * border
    return values_zyxc.new_empty((place_k3.shape[0], side, side, side, values_zyxc.shape[3]))


def _fake_count_segments(*args: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    rays, child_tn, domain_2 = args[0].shape[0], args[5], args[13]
    return (
        child_tn.new_empty((rays, 3)),
        domain_2.new_empty((rays, 3)),
        child_tn.new_empty((rays,), dtype=torch.bool),
    )


def _fake_write_segments(*args: Any) -> tuple[Tensor, ...]:
    child_tn, domain_2, total = args[5], args[13], args[-1]
    words = [child_tn.new_empty((total, *width)) for width in ((), (2,), (2,), (3,), (3,))]
    return (*words, *(domain_2.new_empty((total, *width)) for width in ((), (), (3,))))


def _fake_sample_bricks(*args: Any) -> Tensor:
    bricks_bzyxc, distance_s3, segment_k = args[5], args[12], args[13]
    return distance_s3.new_empty((segment_k.shape[0], bricks_bzyxc.shape[4]))


def _fake_sample_bricks_backward(grad_kc: Tensor, *args: Any) -> tuple[Tensor, Tensor]:
    return grad_kc.new_empty(args[5].shape), grad_kc.new_empty(args[6].shape)


def _fake_composite(
    alpha_k: Tensor, feature_kc: Tensor, offset_r: Tensor, clear_r: Tensor, stop_clear: float
) -> tuple[Tensor, Tensor, Tensor]:
    rays = clear_r.shape[0]
    total = alpha_k.new_empty((rays, feature_kc.shape[1]))
    return total, alpha_k.new_empty((rays,)), torch.empty_like(alpha_k)


def _fake_composite_backward(
    grad_sum_rc: Tensor, grad_left_r: Tensor, alpha_k: Tensor, feature_kc: Tensor, *_args: Any
) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(alpha_k), torch.empty_like(feature_kc), torch.empty_like(grad_left_r)


def _save_samples(ctx: Any, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:15])
    ctx.numbers = inputs[15:]


def _sample_gradient(ctx: Any, grad_kc: Tensor) -> tuple[Tensor | None, ...]:
    """The gradient by bricks and constants; in their own dtype."""
    saved = ctx.saved_tensors
    backward = torch.ops.gvtorch.sample_bricks_backward
    bricks, constants = backward(grad_kc.contiguous(), *saved, *ctx.numbers)
    dtype = saved[5].dtype
    return (*(None,) * 5, bricks.to(dtype), constants.to(dtype), *(None,) * 14)


def _save_composite(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
    alpha_k, feature_kc, offset_r, _, ctx.stop_clear = inputs
    ctx.mark_non_differentiable(output[2])
    ctx.save_for_backward(alpha_k, feature_kc, offset_r, output[2])


def _composite_gradient(
    ctx: Any, grad_sum_rc: Tensor, grad_left_r: Tensor, _: Tensor
) -> tuple[Tensor | None, ...]:
    grads = (grad_sum_rc.contiguous(), grad_left_r.contiguous())
    backward = torch.ops.gvtorch.composite_backward
    alpha, feature, clear = backward(*grads, *ctx.saved_tensors, ctx.stop_clear)
    return alpha, feature, None, clear, None


def _fake_in_place(*_args: object) -> None:
    return None


_reasons = cpp_ext.load()
if not _reasons["cpp"]:
    torch.library.register_fake("gvtorch::trace_rays", _fake_trace_rays)
    torch.library.register_fake("gvtorch::shade_rays", _fake_shade_rays)
    torch.library.register_fake("gvtorch::compact_requests", _fake_compact_requests)
    torch.library.register_fake("gvtorch::lru_partition", _fake_lru_partition)
    torch.library.register_fake("gvtorch::unlink", _fake_in_place)
    torch.library.register_fake("gvtorch::link", _fake_in_place)
    torch.library.register_fake("gvtorch::link_bricks", _fake_in_place)
    torch.library.register_fake("gvtorch::link_tiles", _fake_in_place)
    torch.library.register_fake("gvtorch::locate", _fake_locate)
    torch.library.register_fake("gvtorch::lacking", _fake_lacking)
    torch.library.register_fake("gvtorch::cut_bricks", _fake_cut_bricks)
    torch.library.register_fake("gvtorch::count_segments", _fake_count_segments)
    torch.library.register_fake("gvtorch::write_segments", _fake_write_segments)
    torch.library.register_fake("gvtorch::sample_bricks", _fake_sample_bricks)
    torch.library.register_fake("gvtorch::sample_bricks_backward", _fake_sample_bricks_backward)
    torch.library.register_fake("gvtorch::composite", _fake_composite)
    torch.library.register_fake("gvtorch::composite_backward", _fake_composite_backward)
    torch.library.register_autograd(
        "gvtorch::sample_bricks", _sample_gradient, setup_context=_save_samples
    )
    torch.library.register_autograd(
        "gvtorch::composite", _composite_gradient, setup_context=_save_composite
    )
