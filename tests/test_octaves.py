"""Octaves by level: what children inherit from their parents' bricks, against the direct sum."""

from __future__ import annotations

from functools import cache

import pytest
import torch

import gvtorch as gv

noise = gv.noise


def axes_of(corner: torch.Tensor, side: float) -> list[torch.Tensor]:
    """Returns voxel positions of 8^3 bricks with a border of 1, by their (k, 3) low corners."""
    reach = (torch.arange(-1, 9, dtype=torch.float64) + 0.5) * side
    return [corner[:, axis, None] + reach for axis in range(3)]


def descent(total, levels, count=40, side=1 / 16, seed=0):
    """Descends from `count` random bricks: by level, axes, voxel side, sums and settled octaves."""
    random = torch.Generator().manual_seed(seed)
    corner = torch.randint(-9, 9, (count, 3), generator=random) * 8.0 * side
    parents = child = None
    for _ in range(levels):
        axes = axes_of(corner, side)
        bricks, settled = total.bricks(axes, side, parents, child)
        yield axes, side, bricks, settled
        child = torch.randint(0, 2, (count, 3), generator=random)
        corner, side, parents = corner + child * 4 * side, side / 2, settled


def direct(total, axes, side):
    x, y, z = axes
    points = x[:, None, None, :], y[:, None, :, None], z[:, :, None, None]
    parts = [
        octave.amplitude * noise.perlin([p * octave.frequency for p in points], seed=octave.seed)
        for octave in total.held(side)
    ]
    return torch.stack(parts).sum(0)


@cache
def sums_of_levels() -> list[torch.Tensor]:
    """Returns the direct sums of a descent: what is settled changes neither them nor its path."""
    total = noise.OctaveSum(octaves=14, gain=0.6)
    return [direct(total, axes, side) for axes, side, _, _ in descent(total, 11, 25)]


def test_polynomials_are_inherited_exactly():
    random = torch.Generator().manual_seed(1)
    corner = torch.rand((20, 3), generator=random, dtype=torch.float64)
    child = torch.randint(0, 3, (20, 3), generator=random)

    def values(axes):
        x, y, z = axes[0][:, None, None, :], axes[1][:, None, :, None], axes[2][:, :, None, None]
        return (x**5 - x) * (y**4 + 2 * y) * (1 - z**5) + x - 2 * y * z

    parents = values(axes_of(corner, 0.1))
    children = values(axes_of(corner + child.double() * 0.8 / 3, 0.1 / 3))
    actual = noise.inherit(parents, child, branching=3)
    torch.testing.assert_close(actual, children, atol=1e-9, rtol=0)
    assert (noise.inherit(parents, child, branching=3, points=4) - children).abs().max() > 1e-4


@pytest.mark.parametrize(("settled", "max_error"), [(4, 0.2), (8, 8e-3), (16, 9e-4), (32, 9e-5)])
def test_levels_equal_the_direct_sum(settled, max_error):
    total = noise.OctaveSum(octaves=14, gain=0.6, settled=settled)
    worst = 0.0
    levels = zip(descent(total, 11, 25), sums_of_levels(), strict=True)
    for (_, side, bricks, _), expected in levels:
        worst, held = max(worst, float((bricks - expected).abs().max())), total.held(side)
    assert len(held) == 14 and 0.05 * max_error < worst < max_error


def test_what_is_never_settled_is_the_direct_sum():
    total = noise.OctaveSum(octaves=8, settled=float("inf"))
    for axes, side, bricks, settled in descent(total, 5):
        torch.testing.assert_close(bricks, direct(total, axes, side), atol=1e-12, rtol=0)
        assert not settled.any()
    assert total.evaluations == total.plain_evaluations


def test_a_level_evaluates_four_octaves_however_many_there_are():
    total = noise.OctaveSum(octaves=14, settled=16)
    before = 0
    for depth, (_, side, bricks, _) in enumerate(descent(total, 11)):
        evaluated, before = total.evaluations - before, total.evaluations
        held = len(total.held(side))
        assert held == min(depth + 4, 14)
        # Octaves whose cells are 2, 4, 8 and, for the last time, 16 voxels wide.
        assert evaluated == min(4, 14 - depth) * bricks.numel()
    assert total.evaluations < 0.45 * total.plain_evaluations


def test_bricks_without_parents_are_whole():
    total = noise.OctaveSum(octaves=10)
    for axes, side, bricks, settled in descent(total, 6):
        alone, calm = total.bricks(axes, side)
        assert (alone - direct(total, axes, side)).abs().max() < 1e-12
        assert (alone - bricks).abs().max() < 1e-3 and (calm - settled).abs().max() < 1e-3


def test_octaves_may_become_coarser():
    """With a lacunarity below 1, the octaves that settle first are the last ones."""
    total = noise.OctaveSum(frequency=2.0**10, lacunarity=0.5, octaves=14, gain=0.9)
    for axes, side, bricks, _ in descent(total, 9):
        expected = direct(total, axes, side)
        assert (bricks - expected).abs().max() < 0.01 and expected.abs().max() > 0.1


def of_values(function):
    return gv.OctaveProducer(noise.OctaveSum(), 8, values=lambda s, _: function(s)).at(
        torch.ones(1, 3)
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p, c: noise.inherit(p[..., 1:], c), "parents must be (k, s, s, s) floats, got (2,"),
        (lambda p, c: noise.inherit(p, c[:1]), "child must be (2, 3) int64, got (1, 3) int64"),
        (lambda p, c: noise.inherit(p, c, border=0), "border must be an int >= 1 and <= 4, got 0"),
        (lambda p, c: noise.inherit(p, c, points=11), "points must be an int >= 2 and <= 10"),
        (lambda p, c: noise.OctaveSum(settled=1), "settled must be >= hold, 2, got 1"),
        (
            lambda p, c: gv.OctaveProducer(noise.OctaveSum(), 8, values=3),
            "values must be a function",
        ),
        (lambda p, c: of_values(lambda s: s.mean()), "values must return (1, 10, 10, 10), got ()"),
        (lambda p, c: of_values(lambda s: 1.0), "values must return (1, 10, 10, 10), got float"),
    ],
)
def test_bad_input_gives_one_clear_line(call, message):
    with pytest.raises(ValueError, match=r"noise|Octave") as error:
        call(torch.zeros(2, 10, 10, 10), torch.zeros(2, 3, dtype=torch.int64))
    assert message in str(error.value) and "\n" not in str(error.value)
