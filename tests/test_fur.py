"""`Fur` against its formula in NumPy, and its bounds against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import numpy_noise

import gvtorch as gv

FALL = (0.1, -0.5, 0.2)


def fur(shape=None, **options):
    options = {"length": 0.2, "frequency": 9.0, "fall": FALL, "seed": 3, **options}
    return gv.Fur(shape or gv.sdf.Sphere(1.0), **options)


def random_points(count):
    """Points near the unit sphere."""
    random = torch.Generator().manual_seed(0)
    direction = torch.randn((count, 3), generator=random, dtype=torch.float64)
    away = 0.8 + 0.5 * torch.rand((count, 1), generator=random, dtype=torch.float64)
    return direction / direction.norm(dim=1, keepdim=True) * away


@pytest.mark.parametrize("size", [0.0, 0.05])
def test_values_are_those_of_the_formula(size):
    points = random_points(200)
    values = fur().filtered(points, torch.full_like(points, size))["value"]
    for point, value in zip(points.numpy(), values.tolist(), strict=True):
        away = np.linalg.norm(point) - 1
        height = away / 0.2
        root = point / np.linalg.norm(point) - np.array(FALL) * 0.2 * height**2
        hair = numpy_noise.perlin((root * 9).tolist(), 3) * math.exp(-0.82 * (size * 9) ** 2)
        inside = np.clip((0.45 + 0.7 * hair - height) * 5, 0, 1)
        assert value == pytest.approx(inside * (0.1 + 0.9 * np.clip(height, 0, 1)), abs=1e-9)
    if not size:
        torch.testing.assert_close(fur()(points)["value"], values)
    assert 0.05 < (values == 0).double().mean() < 0.95 and values.max() > 0.5


@pytest.mark.parametrize(
    "shape", [gv.sdf.Sphere(1.0), gv.sdf.SmoothUnion(gv.sdf.Sphere(), gv.sdf.Box(), 0.3)]
)
def test_bounds_hold_in_random_boxes(shape):
    random = torch.Generator().manual_seed(1)
    center = 3 * torch.rand((20_000, 3), generator=random, dtype=torch.float64) - 1.5
    half = 0.2 * torch.rand((20_000, 3), generator=random, dtype=torch.float64) ** 2
    low, high = fur(shape).bounds(center, half)["value"]
    for _ in range(8):
        spread = 2 * torch.rand(center.shape, generator=random, dtype=torch.float64) - 1
        value = fur(shape)(center + spread * half)["value"]
        assert bool(((low <= value) & (value <= high)).all())
    assert min((high == 0).sum(), (low == high).sum() - (high == 0).sum()) > 1000


def test_a_picture_of_fur_is_made_of_few_bricks():
    producer = gv.FieldProducer(fur(), 256)
    transfer = gv.TransferFunction.from_points([(0.02, 0), (0.1, 0.5), (1, 0.6)])
    picture = gv.Engine(producer).render(gv.Camera.orbit(width=48, height=48), transfer)
    assert picture.stats.converged and picture.stats.bricks_used < 32**3 / 4
    assert picture.alpha.max() > 0.98 and picture.alpha.min() == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": 0}, "Fur: length must be finite and > 0, got 0"),
        ({"frequency": math.inf}, "Fur: frequency must be finite and > 0, got inf"),
        ({"shape": 3}, "Fur: shape must be a Distance, got int"),
        ({"seed": 0.5}, "Fur: seed must be an int"),
    ],
)
def test_bad_input_gives_one_clear_line(options, message):
    with pytest.raises(ValueError, match="Fur") as error:
        fur(**options)
    assert str(error.value).startswith(message) and "\n" not in str(error.value)
