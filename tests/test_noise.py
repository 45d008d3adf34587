"""`gv.noise`: against NumPy, point by point; its bounds, periods and bits."""

from __future__ import annotations

import hashlib
import math
from functools import partial

import pytest
import torch
from helpers import numpy_noise

import gvtorch as gv
from gvtorch.ops.reference import noise as twin

noise = gv.noise
F2, WALLS = (partial(noise.cellular, feature=name) for name in ("F2", "F2-F1"))
FAR = partial(noise.cellular, feature="F2", reach=2)
ALL = {
    "perlin": noise.perlin,
    "value": noise.value,
    "simplex": noise.simplex,
    "F1": noise.cellular,
    "F2": F2,
    "F2-F1": WALLS,
    "F2 reach 2": FAR,
}
PLAIN = {
    "perlin": numpy_noise.perlin,
    "value": numpy_noise.value,
    "simplex": numpy_noise.simplex,
    "F1": numpy_noise.cellular,
    "F2": partial(numpy_noise.cellular, feature="F2"),
    "F2-F1": partial(numpy_noise.cellular, feature="F2-F1"),
    "F2 reach 2": partial(numpy_noise.cellular, feature="F2", reach=2),
}
named = pytest.mark.parametrize("name", ALL)
both = pytest.mark.parametrize("n", [2, 3])


def close(actual: torch.Tensor, expected: list[float]) -> None:
    right = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(actual, right, atol=1e-11, rtol=0)


def random_points(count: int, n: int, dtype=torch.float64, size: float = 40.0) -> torch.Tensor:
    random = torch.Generator().manual_seed(7)
    return (torch.rand((count, n), generator=random, dtype=dtype) - 0.5) * size


@named
@both
def test_noise_is_that_of_plain_numpy(name, n):
    points = random_points(120, n)
    points[:20] = points[:20].round()  # the lattice itself
    expected = [PLAIN[name](point, seed=5) for point in points.tolist()]
    actual = ALL[name](points, seed=5)
    torch.testing.assert_close(
        actual, torch.tensor(expected, dtype=torch.float64), atol=1e-12, rtol=0
    )
    narrow = ALL[name](points.float(), seed=5)
    assert narrow.dtype == torch.float32
    # float32 resolves positions to 2^-20 here; that times the slope, plus rounding of the sums.
    slope = noise.bounds(ALL[name], n).slope
    assert (narrow - actual).abs().max() < slope * n * 2.0**-20


@named
def test_periodic_noise_is_that_of_plain_numpy(name):
    points = random_points(100, 3)
    period = (6, 3, 9)
    expected = [PLAIN[name](point, seed=1, period=period) for point in points.tolist()]
    actual = ALL[name](points, seed=1, period=period)
    torch.testing.assert_close(
        actual, torch.tensor(expected, dtype=torch.float64), atol=1e-12, rtol=0
    )


@named
@both
def test_periods_are_exact(name, n):
    if name == "simplex" and n == 2:
        pytest.skip("triangles have no whole period")
    period = (6, 3, 9)[:n]
    points = (random_points(2000, n) * 64).round() / 64  # so that the shift is exact
    random = torch.Generator().manual_seed(1)
    shift = torch.randint(-4, 5, points.shape, generator=random) * torch.tensor(period)
    here, there = (ALL[name](p, period=period) for p in (points, points + shift))
    if name == "simplex":  # the skew rounds differently there
        torch.testing.assert_close(here, there, atol=1e-11, rtol=0)
    else:
        assert torch.equal(here, there)
    assert not torch.allclose(here, ALL[name](points + shift), atol=1e-3)


@both
def test_sums_repeat_with_the_period_of_their_first_octave(n):
    points = (random_points(2000, n) * 64).round() / 64
    for sum_of in (noise.fbm, noise.turbulence, noise.ridged):
        assert torch.equal(sum_of(points, period=5), sum_of(points + 5, period=5))
    moved = noise.warp(points + 5, period=5) - 5
    torch.testing.assert_close(noise.warp(points, period=5), moved, atol=1e-13, rtol=0)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("fbm", {}),
        ("turbulence", {}),
        ("ridged", {}),
        ("ridged", {"sharpness": 0.7}),
        ("warp", {"amplitude": 0.3}),
    ],
)
def test_fractal_sums_are_those_of_plain_numpy(name, changes):
    """One sharpness clamps the weights of ridges to 1, the other hardly does."""
    points = random_points(400, 3)
    options = {"octaves": 3, "lacunarity": 1.9, "gain": 0.6, "seed": 3, **changes}
    expected = [getattr(numpy_noise, name)(point, **options) for point in points.tolist()]
    actual = getattr(noise, name)(points, **options)
    right = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(actual, right, atol=1e-11, rtol=0)
    assert right.std() > 0.1


@named
@both
def test_bounds_hold_at_a_million_points(name, n):
    low, high, _ = noise.bounds(ALL[name], n)
    for seed in range(10):
        values = ALL[name](random_points(100_000, n, torch.float32, 2000.0), seed=seed)
        assert low - 2.0**-20 <= values.min() and values.max() <= high + 2.0**-20
    # A much tighter bound would be wrong.
    assert values.max() > 0.6 * high


@named
@both
def test_slopes_hold_at_150_000_points(name, n):
    slope, random = noise.bounds(ALL[name], n).slope, torch.Generator().manual_seed(3)
    steepest = 0.0
    for seed in range(10):
        points = random_points(15_000, n)
        step = torch.randn(points.shape, generator=random, dtype=torch.float64)
        step *= 1e-5 / step.norm(dim=1, keepdim=True)
        ends = (ALL[name](p, seed=seed) for p in (points - step, points + step))
        rise = (next(ends) - next(ends)).abs().max() / 2e-5
        steepest = max(steepest, float(rise))
    assert steepest <= slope * (1 + 1e-6)
    assert steepest > 0.6 * slope


@pytest.mark.parametrize(("n", "height", "slope"), [(2, 1.0, 2.75), (3, 1.0363538, 3.75)])
def test_bounds_of_gradient_noise_are_met_by_the_best_gradients(n, height, slope):
    """At the points where a search found the largest sums over corners with the best gradients."""
    half = torch.full((n,), 0.5, dtype=torch.float64)
    top = torch.tensor([0.48149221, 0.64474330, 0.5], dtype=torch.float64) if n == 3 else half
    edges = torch.tensor([numpy_noise.edge(word << 6) for word in range(0, 2**26, 99991)])
    edges = edges.unique(dim=0)[:, :n].to(torch.float64)
    u = torch.eye(n, dtype=torch.float64)[0]
    high = steep = 0.0
    for corner in torch.cartesian_prod(*[torch.arange(2.0, dtype=torch.float64)] * n):
        high += float(_weight(top, corner) * (edges @ (top - corner)).max())
        each = torch.where(corner == 1, half, 1 - half)
        change = (2 * corner[0] - 1) * 15 / 8 * each[1:].prod()
        steep += float((edges @ (_weight(half, corner) * u + change * (half - corner))).max())
    assert len(edges) >= 8 and high == pytest.approx(height, abs=1e-6)
    assert steep == pytest.approx(slope, abs=1e-9)
    bounds = noise.bounds(noise.perlin, n)
    assert bounds.high == pytest.approx(height, abs=1e-5) and bounds.slope == slope


def _weight(position: torch.Tensor, corner: torch.Tensor) -> torch.Tensor:
    fade = twin.fade(position)
    return torch.where(corner == 1, fade, 1 - fade).prod()


def test_bounds_of_sums_hold():
    points = random_points(200_000, 3)
    for gain, lacunarity in ((0.5, 2.0), (0.9, 1.7)):
        options = {"octaves": 4, "gain": gain, "lacunarity": lacunarity}
        low, high, slope = noise.fbm_bounds(**options)
        values = noise.fbm(points, **options)
        assert low <= values.min() and values.max() <= high
        rise = (noise.fbm(points + 1e-5, **options) - values).abs().max() / (1e-5 * 3**0.5)
        assert 0.2 * slope < rise <= slope
    assert 0 <= noise.turbulence(points).min() and 0 <= noise.ridged(points).min()
    assert noise.ridged(points).max() <= sum(0.5**n for n in range(6))


def test_bits_are_those_that_they_always_were():
    """On every device and in every version: points of whole numbers, hashed with their values."""
    index = torch.arange(3 * 4096, dtype=torch.float32).view(-1, 3)
    points = (index * 0.37109375) % 17 - 8.5
    values = [getattr(noise, name)(points, seed=9) for name in ("perlin", "value", "cellular")]
    digest = hashlib.sha256(torch.stack(values).numpy().tobytes()).hexdigest()
    assert digest[:16] == "c835f2927ff0d01e"


@named
def test_neither_chunks_nor_shapes_change_bits(name):
    points = random_points(5000, 3, torch.float32)
    once = ALL[name](points)
    for some in (1, 3, 15, 17, 2048, 2049):
        assert torch.equal(ALL[name](points[:some]), once[:some])
    assert torch.equal(ALL[name](points.view(10, 50, 10, 3)).flatten(), once)
    assert torch.equal(ALL[name](points.unbind(1)), once)
    x, y, z = points[:30].unbind(1)
    broad = ALL[name]((x, y[:, None], z[:, None, None]))
    grid = torch.stack(torch.meshgrid(z, y, x, indexing="ij")[::-1], -1)
    assert torch.equal(broad, ALL[name](grid))


def test_seeds_are_noises_apart():
    points = random_points(100_000, 3, torch.float32)
    values = torch.stack([noise.perlin(points, seed=seed) for seed in (0, 1, 2, -1, 2**40)])
    assert values.corrcoef().fill_diagonal_(0).abs().max() < 0.02


def test_hashes_of_neighbours_share_nothing():
    """Each used bit is set half of the time, and flips half of the time from one lattice point to
    the next.
    """
    index = torch.arange(-32, 32, dtype=torch.int32)
    x, y, z = (twin.scramble(index, salt) for salt in twin.salts(4))
    hashes = twin.join(twin.join(x, y[:, None]), z[:, None, None])
    bits = (hashes[..., None] >> torch.arange(2, 32)) & 1
    assert (bits.double().mean((0, 1, 2)) - 0.5).abs().max() < 0.01
    for axis in range(3):
        flips = bits.diff(dim=axis).abs().double().mean((0, 1, 2))
        assert (flips - 0.5).abs().max() < 0.01
    edges = torch.stack(twin.gradient(hashes, torch.float32), -1).view(-1, 3)
    kinds, counts = edges.unique(dim=0, return_counts=True)
    assert len(kinds) == 12 and bool((edges.abs().sum(1) == 2).all())
    assert (counts / len(edges) - 1 / 12).abs().max() < 0.002


def test_gradient_noise_has_the_gradients_of_autograd():
    points = random_points(8, 3).requires_grad_()
    for function in (noise.perlin, noise.simplex, noise.value, noise.fbm):
        assert torch.autograd.gradcheck(function, points)


@pytest.mark.parametrize("name", ["perlin", "simplex", "cellular", "fbm", "warp"])
def test_noise_compiles_to_one_graph(name):
    """Without graph breaks for values read on the host, and with the same bits on the CPU."""
    points, plain = random_points(3000, 3, torch.float32), getattr(noise, name)
    plain = partial(plain, octaves=2) if name in ("fbm", "warp") else plain
    compiled = torch.compile(plain, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(points, seed=3), plain(points, seed=3))


def test_fused_noise_has_the_same_bits():
    points = random_points(3000, 3, torch.float32)
    compiled = torch.compile(noise.perlin, fullgraph=True)
    assert torch.equal(compiled(points, seed=3), noise.perlin(points, seed=3))


P = torch.zeros(4, 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: noise.perlin(torch.zeros(4, 4)),
            "must be (..., n) or n tensors, n = 2 or 3",
        ),
        (lambda: noise.perlin(torch.zeros(4, 3).long()), "must be float32 or float64, got int64"),
        (lambda: noise.value((P[0], P[1].double())), "float32 or float64, got float32, float64"),
        (lambda: noise.perlin(P, period=(1, 2)), "period must be an int or 3 of them, got (1, 2)"),
        (lambda: noise.perlin(P, period=0), "period must be an int >= 1"),
        (lambda: noise.perlin(P, period=1.5), "period must be an int >= 1"),
        (lambda: noise.fbm(P, basis="perlin"), "basis must be a function such as noise.perlin"),
        (lambda: gv.ops.noise(P, "perlin", period=5), "period must be numbers of cells"),
        (lambda: noise.simplex(P, period=4), "period must be a multiple of 3, got 4"),
        (lambda: noise.simplex(P[:, :2], period=3), "in the plane there is no period"),
        (lambda: noise.cellular(P, feature="F3"), "feature must be 'F1'"),
        (lambda: noise.cellular(P, jitter=2), "jitter must be finite and >= 0 and <= 1, got 2"),
        (lambda: noise.cellular(P, reach=3), "reach must be an int >= 1 and <= 2, got 3"),
        (lambda: noise.fbm(P, octaves=0), "octaves must be an int >= 1 and <= 64, got 0"),
        (lambda: noise.fbm(P, gain=0), "gain must be finite and > 0, got 0"),
        (lambda: noise.fbm(P, period=2, lacunarity=1.5), "lacunarity must be whole, got 1.5"),
        (lambda: noise.bounds(torch.sin), "nothing is known of 'sin' in 3 dimensions"),
        (
            lambda: gv.ops.noise(P[0], "perlin"),
            "point_pn must be (p, 2) or (p, 3) floats, got (3,)",
        ),
        (lambda: gv.ops.noise(P, "brown"), "noise: kind must be 'perlin', "),
        (lambda: gv.ops.noise(P, "F1", jitter=math.nan), "jitter must be finite"),
        (lambda: gv.ops.noise(P, "perlin", period=(-1,)), "period must be an int >= 0"),
    ],
)
def test_bad_input_gives_one_clear_line(call, message):
    with pytest.raises(ValueError, match="noise") as error:
        call()
    assert message in str(error.value) and "\n" not in str(error.value)
