"""Arithmetic that every backend rounds alike: the same bits as csrc/base/arithmetic.h."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.compiler import is_compiling
from torch.jit import is_tracing
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from ...base.check import has_tangent

TINY = 1.1754944e-38  # smallest normal float32: a transmittance not above it counts as opaque


def clamp(value: Tensor, low: float | Tensor, high: float | Tensor) -> Tensor:
    """Clamps values; NaN becomes the lower bound. Bounds are numbers, or of the values' dtype."""
    raised = torch.where(value > low, value, low)
    return torch.where(raised < high, raised, high)


def divide(a: Tensor | float, b: Tensor | float, like: Tensor) -> Tensor:
    """Returns a / b, rounded once. Given a number, torch itself multiplies by a reciprocal. Never
    blocks.
    """
    a, b = (n if isinstance(n, Tensor) else torch.full_like(like, n) for n in (a, b))
    return torch.div(a.to(like), b.to(like).expand(like.shape))


def smaller(a: Tensor, b: Tensor) -> Tensor:
    """Returns b where it is smaller, else a."""
    return torch.where(b < a, b, a)


def larger(a: Tensor, b: Tensor) -> Tensor:
    """Returns b where it is larger, else a."""
    return torch.where(b > a, b, a)


def _as_numpy(value: Tensor) -> np.ndarray | None:
    """Returns floats on the CPU as an array, or None where something tracks operations on them:
    gradients of either mode, a compiler, a recording, a transform of `torch.func`.
    """
    if value.device.type != "cpu" or type(value) is not Tensor or value.requires_grad:
        return None
    tracked = is_compiling() or is_tracing() or is_in_torch_dispatch_mode()
    if tracked or value.dtype not in (torch.float32, torch.float64):
        return None
    try:
        return None if has_tangent(value) else value.numpy()
    except RuntimeError:  # a tensor of `torch.func` has no memory
        return None


def sqrt_exact(value: Tensor) -> Tensor:
    """Returns the square root, rounded once. torch's may be an ulp off on the CPU, NumPy's is not.
    Where NumPy can't be used, float64 roots are corrected by the remainder, whose product is exact
    when split into halves (Dekker, "A floating-point technique for extending the available
    precision", 1971).
    """
    array = _as_numpy(value)
    if array is not None:
        with np.errstate(invalid="ignore"):
            return torch.from_numpy(np.sqrt(array, out=np.empty_like(array)))  # `out`: for 0 axes
    root = torch.sqrt(value.to(torch.float64))
    if value.dtype != torch.float64:
        return root.to(value.dtype)
    approximate = root.detach()
    scaled = approximate * 134217729.0  # 2^27 + 1
    high = scaled - (scaled - approximate)
    low, square = approximate - high, approximate * approximate
    remainder = value.detach() - square - (high * high - square + 2 * high * low + low * low)
    correctable = (approximate > 0) & (approximate < 1e140)
    return root + torch.where(correctable, remainder / (2 * approximate), 0.0)


def _polynomial(x: Tensor, highest: float, *coefficients: float) -> Tensor:
    total = torch.full_like(x, highest)
    for coefficient in coefficients:
        total = total * x + coefficient
    return total


def log2_exact(value: Tensor) -> Tensor:
    """Returns the base-2 logarithm of positive normal numbers, by + - * / alone.

    Source: Abramowitz and Stegun, "Handbook of Mathematical Functions", 1964, 4.1.27.
    """
    if value.dtype == torch.float64:
        exponent, s, series = _log_series(value)
        return exponent + series * s * 1.4426950408889634
    bits = value.contiguous().view(torch.int32)
    exponent = ((bits >> 23) - 127).to(torch.float32)
    mantissa = ((bits & 0x007FFFFF) | 0x3F800000).view(torch.float32)
    high = mantissa > 1.41421356
    mantissa = torch.where(high, mantissa * 0.5, mantissa)
    exponent = torch.where(high, exponent + 1, exponent)
    s = (mantissa - 1) / (mantissa + 1)
    z = s * s
    series = _polynomial(z, 0.320598898, 0.412198583, 0.577078016, 0.961796694, 2.885390082)
    return exponent + series * s


def log_exact(value: Tensor) -> Tensor:
    """Returns the natural logarithm of positive normal numbers, by + - * / alone in both
    precisions; infinity and NaN as they are. Source: as `log2_exact`.
    """
    detached = value.detach()
    exponent, s, series = _log_series(detached)
    finite = exponent * 0.6931471805599453 + s * series
    logarithm = torch.where(detached < torch.inf, finite, detached)
    if not (value.requires_grad or has_tangent(value)):
        return logarithm
    slope = torch.log(value)  # torch differentiates it, in both modes and again
    return logarithm + (slope - slope.detach())


def _log_series(value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Splits numbers into 2^e * m with m near 1. Returns e, and two factors of log(m):
    s = (m - 1) / (m + 1), and 2 + 2/3 s^2 + 2/5 s^4 ...
    """
    fraction, power = torch.frexp(value)
    large = fraction > 0.70710678
    mantissa = torch.where(large, fraction, fraction + fraction)
    s = (mantissa - 1) / (mantissa + 1)
    series = _polynomial(s * s, *(2 / odd for odd in range(19, 0, -2)))
    return torch.where(large, power, power - 1).to(value.dtype), s, series


#: ln(2)^k / k! for k from 14 to 1.
_SLOPE = (
    *(6.778726354822545e-14, 1.3691488853904128e-12, 2.5678435993488206e-11),
    *(4.4455382718708116e-10, 7.054911620801123e-09, 1.01780860092397e-07),
    *(1.321548679014431e-06, 1.5252733804059841e-05, 0.0001540353039338161),
    *(0.0013333558146428443, 0.009618129107628477, 0.05550410866482158),
    *(0.24022650695910072, 0.6931471805599453),
)


def _exp2_slope(f: Tensor) -> Tensor:
    """Returns (2^f - 1) / f for f in [-0.5, 0.5]."""
    if f.dtype == torch.float64:
        return _polynomial(f, *_SLOPE)
    low = (1.52527338e-5, 1.54035304e-4, 1.33335581e-3, 9.61812911e-3)
    return _polynomial(f, *low, 5.55041087e-2, 2.40226507e-1, 6.93147181e-1)


def exp2_exact(value: Tensor) -> Tensor:
    """Returns 2^value, by + - * alone: 0 where the value is at most -126, and never above 2^126; in
    float64 -1022 and 2^1022.

    Source: Abramowitz and Stegun, "Handbook of Mathematical Functions", 1964, 4.2.1.
    """
    is_double = value.dtype == torch.float64
    max_exponent, bias, digits = (1022, 1023, 52) if is_double else (126, 127, 23)
    underflows = ~(value > -max_exponent)
    x = torch.where(underflows, 0.0, smaller(value, torch.full_like(value, float(max_exponent))))
    integer = torch.floor(x + 0.5)
    f = x - integer
    series = _exp2_slope(f) * f + 1.0
    bits = (integer.to(torch.int64 if is_double else torch.int32) + bias) << digits
    return torch.where(underflows, 0.0, series * bits.view(value.dtype))


def absorbed_by(halvings: Tensor) -> Tensor:
    """Returns 1 - 2^-halvings, the share of light that is absorbed; accurate if small, too."""
    thin = halvings < 0.5
    small = torch.where(thin, halvings, 0.0)
    return torch.where(thin, _exp2_slope(-small) * small, 1 - exp2_exact(-halvings))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Returns (r,) dot products of (r, 3), added from x to z."""
    product = a * b
    return product[:, 0] + product[:, 1] + product[:, 2]


def unit(v: Tensor) -> Tensor:
    """Returns (r, 3) vectors of length 1, or 0 where there is no direction."""
    columns = v.mT.contiguous()  # (3, r): passes over numbers side by side are several times faster
    x, y, z = columns.abs()
    largest = larger(larger(x, y), z)
    has_direction = (largest > 0) & (largest < torch.inf)
    scaled = columns / torch.where(has_direction, largest, 1.0)
    x, y, z = scaled * scaled
    length = sqrt_exact(x + y + z)
    return torch.where(has_direction, scaled / length, 0.0).mT.contiguous()


def power(x: Tensor, exponent: float | Tensor) -> Tensor:
    """Returns x^exponent for x in [0, 1]."""
    positive = x > TINY
    raised = exp2_exact(log2_exact(torch.where(positive, x, 1.0)) * exponent)
    return torch.where(positive, raised, 0.0)


def stretch(alpha: Tensor, lengths: Tensor) -> Tensor:
    """Returns the alphas of intervals of given lengths, from the alphas of length 1."""
    transmittance = 1 - alpha
    opaque = ~(transmittance > TINY)
    stretched = 1 - exp2_exact(log2_exact(torch.where(opaque, 0.5, transmittance)) * lengths)
    return torch.where(opaque, 1.0, stretched)
