"""Joins the compiled ops to torch: loads the libraries and gives each op its fake (shapes without
data).

The schema of an op stands once, in cpp_ext/csrc/entry.h.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .. import cpp_ext


def available() -> dict[str, str]:
    """Returns, for `reference`, `cpp` and `cuda`, an empty text or the reason why it can't be
    used."""
    return {"reference": "", **_reasons}


def _fake_trace_rays(origin_r3: Tensor, *_args: object) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rays = origin_r3.shape[0]
    return (
        origin_r3.new_empty((rays, 3)),
        origin_r3.new_empty((rays, 1)),
        origin_r3.new_empty((rays, 1)),
        origin_r3.new_empty((rays,), dtype=torch.int32),
    )


_reasons = cpp_ext.load()
if not _reasons["cpp"]:
    torch.library.register_fake("gvtorch::trace_rays", _fake_trace_rays)
