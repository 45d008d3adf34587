"""The op `noise`: twin, C++ and CUDA in every bit, and gradients."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import DEVICES
from helpers.packets import result, start

import gvtorch as gv
from gvtorch.ops import noise
from gvtorch.ops.reference import noise as twin

kinds = pytest.mark.parametrize("kind", twin.KINDS)
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def some_points(count: int, n: int, dtype=torch.float32, size: float = 300.0) -> torch.Tensor:
    """Returns random points, lattice points, their neighbours on both sides, and both zeros."""
    random = torch.Generator().manual_seed(3)
    points = (torch.rand((count, n), generator=random, dtype=torch.float64) - 0.5) * size
    points[:200] = points[:200].round()
    points[200:400] = points[200:400].round() + 1e-9
    points[400:600] = points[400:600].round() - 1e-9
    points[600:800] *= 1e5
    points[800:810], points[810:820] = -0.0, 0.0
    return points.to(dtype)


def bits(values: torch.Tensor) -> torch.Tensor:
    return values.cpu().view(torch.int32 if values.dtype == torch.float32 else torch.int64)


@kinds
@dtypes
@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("period", [(0, 0, 0), (6, 3, 9)])
def test_compiled_is_the_twin_in_every_bit(compiled, kind, dtype, n, period):
    points = some_points(5003, n, dtype).to(DEVICES[compiled])
    for options in ({}, {"jitter": 0.3, "reach": 2}):
        arguments = {"seed": -11, "period": period, **options}
        expected = noise(points.cpu(), kind, **arguments, backend="reference")
        actual = noise(points, kind, **arguments, backend=compiled)
        assert torch.equal(bits(actual), bits(expected)) and expected.std() > 0.05
        assert torch.equal(actual, noise(points, kind, **arguments))
        if not kind.startswith("F"):
            break


@kinds
def test_what_is_no_number_stays_so(compiled, kind):
    points = torch.zeros(40, 3, device=DEVICES[compiled])
    points[torch.arange(0, 40, 2), torch.arange(0, 40, 2) % 3] = math.nan
    for backend in ("reference", compiled):
        is_nan = noise(points, kind, backend=backend).isnan().tolist()
        assert is_nan == [True, False] * 20, backend
    assert noise(points[:0], kind).shape == (0,)


def digests(backend: str = "cpp") -> list[int]:
    """Returns those of the noise of each kind."""
    p = torch.arange(3999, dtype=torch.float32).view(-1, 3) * 0.37109375 - 300
    return [
        int((noise(p, kind, backend=backend).view(torch.int32) * 31).sum()) for kind in twin.KINDS
    ]


@pytest.mark.long
@pytest.mark.parametrize("instructions", ["baseline", "avx2"])
@pytest.mark.backend("cpp")
def test_all_instruction_sets_give_the_same_bits(instructions, tmp_path):
    """The other tests use the widest instruction set of the machine."""
    actual = result(start(digests, tmp_path, instructions))
    assert actual == digests("reference") and len(set(actual)) == 6


@dtypes
def test_coordinates_that_32_bits_cannot_count_are_0(backend, dtype):
    """Therefore octaves of any frequency stay within their bounds."""
    points = some_points(500, 3, dtype).to(DEVICES[backend])
    far = points.clone()
    far[::2, 0] = torch.tensor([2.0**29, -(2.0**40), 1e30, torch.inf, -torch.inf]).repeat(50)
    for kind in twin.KINDS:
        expected = noise(torch.where(far.abs() >= 2**29, 0.0, far), kind, backend=backend)
        actual = noise(far, kind, backend=backend)
        assert torch.equal(actual, expected) and bool(actual.isfinite().all())
    whole = gv.noise.fbm(points, octaves=64)
    bounds = gv.noise.fbm_bounds(octaves=64)
    assert bounds.low <= float(whole.min()) and float(whole.max()) <= bounds.high
    assert float((whole - gv.noise.fbm(points, octaves=28)).abs().max()) < 2.0**-27


@dtypes
def test_opcheck(compiled, dtype):
    points = some_points(50, 3, dtype).to(DEVICES[compiled])
    arguments = (points, 0, 1, 2, 3, 0, 0, 5, 1.0, 1)
    torch.library.opcheck(torch.ops.gvtorch.noise.default, arguments)


def test_memory_stays_safe_without_the_python_checks(compiled):
    points = torch.zeros(5, 3, device=DEVICES[compiled])
    good = (0, 1, 2, 3, 0, 0, 0, 1.0, 1)
    torch.ops.gvtorch.noise(points, *good)
    for bad in (
        (points[:, :1].contiguous(), *good),
        (points.double()[:, :2], *good),
        (points.long(), *good),
        (points, 6, *good[1:]),
        (points, *good[:-1], 3),
    ):
        with pytest.raises(RuntimeError, match="gvtorch: "):
            torch.ops.gvtorch.noise(*bad)


def test_gradients_are_those_of_the_twin_and_none_is_lost(compiled):
    points = some_points(1000, 3).to(DEVICES[compiled]).requires_grad_()
    (expected,) = torch.autograd.grad(noise(points, "perlin", backend="reference").sum(), points)
    (gradient,) = torch.autograd.grad(noise(points, "perlin").sum(), points)
    assert torch.equal(gradient, expected) and expected.abs().max() > 1
    value, pull = torch.func.vjp(lambda p: noise(p, "perlin"), points.detach())
    assert torch.equal(pull(torch.ones_like(value))[0], expected)
    with pytest.raises(RuntimeError, match="noise: gradients by point_pn would be lost"):
        noise(points, "perlin", backend=compiled)


def test_a_noisy_shape_has_normals():
    """Its distances contain noise, and its normals are their gradients."""

    class Bumpy(gv.sdf.Distance):
        exact = False

        def forward(self, points):
            return points.norm(dim=-1) - 1 + 0.1 * gv.noise.perlin(points * 4)

    points = torch.nn.functional.normalize(some_points(500, 3, torch.float64), dim=1)
    steps = 1e-6 * torch.eye(3, dtype=torch.float64)
    shape = Bumpy()
    by_steps = [(shape(points + shift) - shape(points - shift)) / 2e-6 for shift in steps]
    assert (shape.gradient(points) - torch.stack(by_steps, -1)).abs().max() < 1e-6
