"""Cameras and shaders of tests, and comparison of two pictures."""

from __future__ import annotations

import torch

import gvtorch as gv

GRAY = gv.TransferFunction.preset("gray", 0, 1)


FIELDS = ("color", "alpha", "depth", "samples")


def camera(size=48, **options) -> gv.Camera:
    return gv.Camera.orbit(**{"azimuth": 30, "elevation": 20, **options}, width=size, height=size)


def assert_same_picture(actual: gv.Picture, expected: gv.Picture) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name
    assert expected.alpha.max() > 0.3, "the test must see something"


def assert_close_picture(actual: gv.Picture, expected: gv.Picture, *, tolerance=1e-4) -> None:
    """Asserts that two pictures are equal except for rounding."""
    assert expected.alpha.max() > 0.5, "the test must see something"
    assert (actual.color - expected.color).abs().max() < tolerance
    assert (actual.alpha - expected.alpha).abs().max() < tolerance
    assert torch.equal(torch.isinf(actual.depth), torch.isinf(expected.depth))
    hit = torch.isfinite(expected.depth)
    assert (actual.depth - expected.depth)[hit].abs().max() < 1e-2


VESSELS = gv.TransferFunction.preset("vessels", 0, 255)
