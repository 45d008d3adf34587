"""`orbits` and `orbit_bounds`: twin, C++ and CUDA in every bit, gradients, hostile input."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import DEVICES
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

import gvtorch as gv
from gvtorch.ops import Orbit, orbit_bounds, orbits
from gvtorch.ops.reference.exact import log_exact, sqrt_exact

CONSTANT, BAILOUT = (-0.55, 0.3, -0.25), 2.0
FORMS = {  # kind, amount, iterations, julia, bailout
    "bulb of 8": ("power", 8, 6, False, BAILOUT),
    "bulb of 7, long": ("power", 7, 40, False, BAILOUT),
    "bulb of 2": ("power", 2, 9, False, BAILOUT),
    "julia": ("power", 3, 12, True, BAILOUT),
    "box": ("fold", 2.0, 10, False, 11.0),
    "box inside out": ("fold", -2.0, 9, True, 7.0),
}
forms = pytest.mark.parametrize("form", FORMS)
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def wide(form: str) -> float:
    """Returns the side of a cube in which some orbits escape and others do not."""
    return 12.0 if form.startswith("box") else 3.0


def given(form: str, dtype: torch.dtype, device: str) -> Orbit:
    kind, amount, iterations, julia, bailout = FORMS[form]
    constant, limit = (torch.tensor(n, dtype=dtype, device=device) for n in (CONSTANT, [bailout]))
    return Orbit(constant, limit, kind, amount, iterations, julia)


def some_points(count: int, dtype: torch.dtype, size: float) -> torch.Tensor:
    """Returns random points, points on the axis and on planes, the origin, tiny and far points, and
    some with NaN.
    """
    random = torch.Generator().manual_seed(5)
    points = (torch.rand((count, 3), generator=random, dtype=torch.float64) - 0.5) * size
    points[:100, :2] = 0.0
    points[100:200, 0] = -0.0
    points[200:210] = 0.0
    points[210:300] *= 1e-20
    points[300:400] *= 1e4
    points[400:403, 0] = math.nan
    return points.to(dtype)


def bits(values: torch.Tensor) -> torch.Tensor:
    values = values.cpu()
    values = torch.where(values.isnan(), 0.0, values)  # NaN has many bit patterns
    return values.view(torch.int32 if values.dtype == torch.float32 else torch.int64)


@forms
@dtypes
def test_compiled_is_the_twin_in_every_bit(compiled, form, dtype):
    device = DEVICES[compiled]
    points = some_points(5003, dtype, wide(form))
    expected = orbits(points, given(form, dtype, "cpu"), backend="reference")
    actual = orbits(points.to(device), given(form, dtype, device), backend=compiled)
    assert torch.equal(bits(actual), bits(expected)) and torch.equal(
        actual.isnan().cpu(), expected.isnan()
    )
    assert actual.isnan().sum() == 9 and (expected[0] == -1).any() and (expected[0] > 0).any()
    assert torch.equal(bits(orbits(points.to(device), given(form, dtype, device))), bits(expected))


@forms
@dtypes
def test_bounds_are_the_twin_s_and_hold_what_points_give(compiled, form, dtype):
    device = DEVICES[compiled]
    random = torch.Generator().manual_seed(6)
    center = wide(form) * (torch.rand((4001, 3), generator=random, dtype=torch.float64) - 0.5)
    reach = 0.3 * torch.rand(4001, generator=random, dtype=torch.float64) ** 4
    center, reach = center.to(dtype), reach.to(dtype)
    reach[:3] = torch.tensor((0.0, math.inf, math.nan))
    expected = orbit_bounds(center, reach, given(form, dtype, "cpu"), backend="reference")
    parameters = given(form, dtype, device)
    actual = orbit_bounds(center.to(device), reach.to(device), parameters, backend=compiled)
    assert torch.equal(bits(actual), bits(expected))
    assert expected[:, 1:3].T.tolist() == [[-1, math.inf]] * 2, "nothing is proven"
    directions = torch.nn.functional.normalize(torch.randn((4001, 40, 3), generator=random), dim=-1)
    far = reach[:, None, None] * torch.rand((4001, 40, 1), generator=random).to(dtype)
    inside = (center[:, None] + directions.to(dtype) * far)[3:]
    value = orbits(inside.flatten(0, 1), given(form, dtype, "cpu"))[0].view(-1, 40)
    low, high = expected[:, 3:, None] if dtype == torch.float64 else expected[:, 3:, None].double()
    slack = 1e-3 if dtype == torch.float32 else 1e-12
    assert (value >= low - slack * low.abs()).all() and (value <= high + slack * high.abs()).all()
    assert (low > 0).float().mean() > 0.1, "much of the space is proven to be empty"


@dtypes
def test_logarithm(dtype):
    value = torch.logspace(-30, 30, 100_001, dtype=torch.float64).to(dtype)
    exact = value.double().log()
    error = (log_exact(value).double() - exact).abs() / exact.abs().clamp(min=1)
    assert error.max() < (3e-7 if dtype == torch.float32 else 4e-16)
    assert log_exact(torch.tensor([math.inf], dtype=dtype)).item() == math.inf
    three = torch.tensor(3.0, dtype=dtype, requires_grad=True)
    log_exact(three).backward()
    assert three.grad.item() == pytest.approx(1 / 3)


@dtypes
def test_square_roots_are_rounded_once_whoever_follows(dtype):
    """By NumPy where no autograd or tracing is active; otherwise torch's operations are seen."""
    value = torch.rand((500, 3), dtype=dtype, generator=torch.Generator().manual_seed(3)) + 0.01
    expected = torch.from_numpy(np.sqrt(value.numpy()))
    slope = 0.5 / expected
    leaf = value.clone().requires_grad_()
    roots = {
        "plain": sqrt_exact(value),
        "of a leaf": sqrt_exact(leaf).detach(),
        "by rows": torch.vmap(sqrt_exact)(value),
        "traced": torch.jit.trace(sqrt_exact, (value[:9] * 2,))(value),
        "of functions": make_fx(sqrt_exact)(value * 2)(value),
        "compiled": torch.compile(sqrt_exact, backend="eager", fullgraph=True)(value),
    }
    for operation, root in roots.items():
        assert torch.equal(root, expected), operation
    assert torch.equal(sqrt_exact(value[0, 0]), expected[0, 0])
    sqrt_exact(leaf).sum().backward()
    torch.testing.assert_close(leaf.grad, slope)
    torch.testing.assert_close(torch.func.grad(lambda v: sqrt_exact(v).sum())(value), slope)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(value, torch.ones_like(value))
        torch.testing.assert_close(forward_ad.unpack_dual(sqrt_exact(dual)).tangent, slope)


def test_gradients_of_a_fractal_are_the_same_in_both_modes_and_again():
    """A logarithm computed by hand lost those of forward mode, and second ones."""
    bulb = gv.Mandelbulb(4)
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(1)).double() * 0.5 + 0.1
    move = torch.linspace(-1, 1, 18).double().view(6, 3)

    def slope(at: torch.Tensor) -> torch.Tensor:
        return (torch.func.grad(lambda p: bulb(p).sum())(at) * move).sum()

    value, forward = torch.func.jvp(lambda p: bulb(p).sum(), (points,), (move,))
    ends = [float(bulb(points + h * move).sum()) for h in (1e-6, -1e-6)]
    assert float(value) == float(bulb(points).sum())
    assert float(forward) == pytest.approx(float(slope(points)), rel=1e-9)
    assert float(forward) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)
    second = float((torch.func.grad(slope)(points) * move).sum())
    ends = [float(slope(points + h * move)) for h in (1e-6, -1e-6)]
    assert second == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)


@forms
def test_gradients_are_those_of_small_steps(form):
    points = some_points(3000, torch.float64, wide(form))[500:]
    parameters = given(form, torch.float64, "cpu")
    value = orbits(points, parameters)[0]
    points = points[(value > 0.01) & (value < 0.5)][:50].requires_grad_()
    (slope,) = torch.autograd.grad(orbits(points, parameters)[0].sum(), points)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-7
        with torch.no_grad():
            ends = [orbits(points + sign * step, parameters)[0] for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / 2e-7
        near = torch.isclose(slope[:, axis], difference, rtol=1e-3, atol=1e-4)
        assert near.float().mean() > 0.9, "but where an orbit takes one more step"


def test_opcheck(compiled):
    device = DEVICES[compiled]
    points = some_points(20, torch.float32, 3.0).to(device)
    numbers = given("julia", torch.float32, device).arguments()
    torch.library.opcheck(torch.ops.gvtorch.orbits.default, (points, *numbers))
    balls = (points, torch.rand(20, device=device))
    torch.library.opcheck(torch.ops.gvtorch.orbit_bounds.default, (*balls, *numbers))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"point_p3": torch.zeros(4, 2)}, r"point_p3 must be \(p, 3\)"),
        ({"point_p3": torch.zeros(4, 3).half()}, "point_p3 must be float32 or float64"),
        ({"point_p3": torch.zeros(3, 4).mT}, "point_p3 must be contiguous"),
        ({"constant_3": torch.zeros(3).double()}, "constant_3 must be"),
        ({"bailout_1": torch.zeros(2)}, "bailout_1 must be"),
        ({"kind": "knot"}, "kind must be 'power'"),
        ({"amount": 1}, "amount must be"),
        ({"amount": 2.5}, "amount must be"),
        ({"iterations": 0}, "iterations must be"),
        ({"iterations": 10**9}, "iterations must be"),
    ],
)
def test_what_is_wrong_is_named(changed, message):
    points, fine = torch.zeros(4, 3), Orbit(torch.zeros(3), torch.full((1,), 2.0), "power", 8, 3)
    assert orbits(points, fine).shape == (3, 4)
    points = changed.get("point_p3", points)
    changed = {name: value for name, value in changed.items() if name != "point_p3"}
    with pytest.raises(ValueError, match=f"orbits: {message}"):
        orbits(points, fine._replace(**changed))


def test_compiled_and_exported_fields_hold_the_op():
    bulb = gv.Mandelbulb(8, iterations=5)
    points = some_points(1000, torch.float32, 3.0)[500:]
    graph = torch.export.export(bulb, (points,)).graph_module.code
    assert "gvtorch.orbits" in graph
    assert torch.equal(torch.compile(bulb, backend="eager")(points), bulb(points))
