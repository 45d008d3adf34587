"""`noise`: gradient, value, simplex and cellular noise at points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..base import check
from .reference import noise as twin
from .registry import Backend, fake_of, runs_twin

KINDS = twin.KINDS


def noise(
    point_pn: Tensor,  # (p, n)
    kind: str,
    *,
    seed: int = 0,
    period: Sequence[int] = (0, 0, 0),
    jitter: float = 1.0,
    reach: int = 1,
    backend: Backend = "auto",
) -> Tensor:
    """Evaluates a noise of one frequency at p points, in the plane (n = 2) or in space (n = 3).

    On all backends and devices every bit is the same. Where gradients by the points are recorded,
    `auto` runs the twin, which torch can differentiate.

    Args:
        point_pn: (p, n) float32 or float64, in cells; beyond 2^29 they count as 0; NaN gives NaN.
        kind: perlin, value, simplex; F1, F2 or F2-F1 of cellular noise.
        seed: Each seed gives a different noise.
        period: Number of cells after which the noise repeats along x, y, z; 0: never.
        jitter: How far the points of cellular noise stray in their cells, 0 to 1.
        reach: How many cells to each side cellular noise searches, 1 or 2.
        backend: auto, reference, cpp or cuda.

    Returns:
        (p,) of the same dtype.

    Raises:
        ValueError: A tensor of the wrong shape or dtype, or a number out of its range.
    """
    context = "noise"
    check.instance(context, "point_pn", point_pn, Tensor)
    n = point_pn.shape[1] if point_pn.dim() == 2 else 0
    if n not in (2, 3) or point_pn.dtype not in (torch.float32, torch.float64):
        got = check.describe(point_pn)
        raise ValueError(f"{context}: point_pn must be (p, 2) or (p, 3) floats, got {got}")
    check.one_of(context, "kind", kind, KINDS)
    seed = check.integer(context, "seed", seed, low=-(2**63))
    jitter = check.number(context, "jitter", jitter, low=0, high=1)
    reach = check.integer(context, "reach", reach, low=1, high=2)
    if not isinstance(period, Sequence) or len(period) > 3:
        raise ValueError(f"{context}: period must be numbers of cells, one an axis, got {period!r}")
    cells = (*period, 0, 0, 0)[:3]
    x, y, z = (check.integer(context, "period", count, low=0, high=2**28) for count in cells)
    kind_index, salts = KINDS.index(kind), twin.salts(seed)
    if runs_twin(backend, point_pn):
        arguments = twin.NoiseArguments(salts, (x, y, z), jitter, reach)
        return twin.noise(point_pn, kind_index, arguments)
    scalars = (*(salt & 0xFFFFFFFF for salt in salts), x, y, z, jitter, reach)
    return torch.ops.gvtorch.noise(point_pn.contiguous(), kind_index, *scalars)


@fake_of("noise", gradients=False)
def _fake_values(*, point_pn: Tensor, **_: Any) -> Tensor:
    return point_pn.new_empty((point_pn.shape[0],))
