"""`composite`: sums of samples along rays, early termination, and gradients."""

from __future__ import annotations

import pytest
import torch
from helpers import DEVICES
from helpers.traces import packed

from gvtorch.ops import composite


@pytest.mark.parametrize("stop_alpha", [0.6, 1.0])
def test_composite_is_the_sum_over_the_ray(backend, stop_alpha):
    """Against a loop in Python floats."""
    alpha, feature, offset, clear = packed(device=DEVICES[backend])
    total, left, before = composite(
        *(alpha, feature, offset, clear), stop_alpha=stop_alpha, backend=backend
    )
    ended = 0
    for ray in range(len(clear)):
        light, sums = float(clear[ray]), [0.0] * 4
        for k in range(int(offset[ray]), int(offset[ray + 1])):
            if stop_alpha < 1 and light <= 1 - stop_alpha:
                assert before[k] == 0
                ended += 1
                continue
            assert abs(float(before[k]) - light) < 1e-12
            sums = [
                s + light * float(alpha[k]) * float(f)
                for s, f in zip(sums, feature[k], strict=True)
            ]
            light *= 1 - float(alpha[k])
        assert abs(float(left[ray]) - light) < 1e-12
        assert (total[ray].cpu() - torch.tensor(sums).double()).abs().max() < 1e-6
    assert (ended > 0) == (stop_alpha < 1)


@pytest.mark.parametrize("stop_alpha", [0.6, 1.0])
def test_composite_passes_gradcheck(backend, stop_alpha):
    alpha, feature, offset, clear = packed(device=DEVICES[backend])
    alpha[3] = 1.0  # opaque: 1 - alpha must not be a divisor
    leaves = [t.requires_grad_() for t in (alpha, feature, clear)]

    def add(alpha, feature, clear):
        return composite(alpha, feature, offset, clear, stop_alpha=stop_alpha, backend=backend)[:2]

    assert torch.autograd.gradcheck(add, leaves)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_composite_equals_reference(compiled, dtype):
    many = packed(3, 500, dtype)
    expected = composite(*many, stop_alpha=0.9, backend="reference")
    actual = composite(*(t.to(DEVICES[compiled]) for t in many), stop_alpha=0.9, backend=compiled)
    for a, b in zip(actual, expected, strict=True):
        assert torch.equal(a.cpu(), b)
