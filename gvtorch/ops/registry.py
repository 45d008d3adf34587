"""Joins the compiled ops to torch: loads the libraries and gives each op its fake (shapes without
data).

The schema of an op stands once, in cpp_ext/csrc/entry.h.
"""

from __future__ import annotations

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


def _fake_compact_requests(request_tn: Tensor, capacity: int) -> tuple[Tensor, Tensor, Tensor]:
    words = request_tn.new_empty((capacity,))
    return words, torch.empty_like(words), request_tn.new_empty((3,), dtype=torch.int64)


def _fake_lru_partition(order_k: Tensor, stamp_s: Tensor, frame_1: Tensor) -> tuple[Tensor, Tensor]:
    return torch.empty_like(order_k), order_k.new_empty((1,), dtype=torch.int64)


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
