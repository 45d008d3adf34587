"""Rays in pieces, and cones that narrow: every backend, against one go and against a plain loop."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from conftest import DEVICES
from test_trace_rays import SHADER, assert_equal, camera_rays, forget, run

import gvtorch as gv
from gvtorch.rendering.pieces import trace_pieces
from gvtorch.rendering.renderer import Tracer


@pytest.fixture(scope="module")
def noise() -> gv.Volume:
    """No two voxels alike: nothing is EMPTY, CONSTANT or hidden."""
    generator = torch.Generator().manual_seed(3)
    return gv.Volume(0.05 + 0.1 * torch.rand(40, 40, 40, generator=generator))


def narrowing(rays: gv.Rays, near: float, end: float) -> gv.Rays:
    """The rays with cones that are `near` wide at their origin and 0 at distance `end`."""
    cone = torch.tensor([near, -near / end], dtype=torch.float64).expand(len(rays.origin), 2)
    return dataclasses.replace(rays, cone=cone.contiguous())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("branching", [2, 3])
@pytest.mark.parametrize(("near", "end"), [(14.0, 140.0), (9.0, 90.0), (6.0, 60.0), (40.0, 61.0)])
def test_narrowing_cones_equal_the_reference(blobs, compiled, branching, near, end, dtype):
    tree = gv.N3Tree.from_volume(blobs, 4, branching=branching)
    for distance in (0.3, 1.3):  # beyond `end` a cone is as one of width 0
        rays = narrowing(camera_rays(tree, distance=distance), near, end)
        result, marks = assert_equal(tree, compiled, rays, dtype=dtype)
    assert result["alpha"].max() > 0.2 and (marks["brick"] == 1).any()


@pytest.mark.parametrize("seed", range(3))
def test_narrowing_cones_ask_for_the_same(blobs, compiled, seed):
    tree = forget(gv.N3Tree.from_volume(blobs, 4), 0.5, seed)
    rays = narrowing(camera_rays(tree, distance=1.3), 12.0, 90.0)
    result, marks = assert_equal(tree, compiled, rays)
    assert marks["request"].any() and result["missed"].any()


@pytest.mark.parametrize("growth", [-0.2, -0.05, 0.0, 0.08])
def test_intervals_are_as_long_as_the_cone_is_wide_where_they_start(noise, backend, growth):
    """Every interval of a ray through noise is a sample: they are counted by a plain loop."""
    tree = gv.N3Tree.from_volume(noise, 4)
    shader = gv.TransferFunction.from_points([(0, 0.001), (1, 0.002)])
    near = 9.0 if growth < 0 else 1.0
    rays = gv.Rays(
        origin=torch.tensor([[-10.0, 17.3, 11.9]], dtype=torch.float64),
        direction=torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64),
        cone=torch.tensor([[near, growth]], dtype=torch.float64),
        range=torch.tensor([[0.0, torch.inf]], dtype=torch.float64),
    )
    result, _ = run(tree, backend, rays, shader, cone_scale=1.0, stop_alpha=1.0)
    start, stop, count = 9.5, 49.5, 0  # the box begins half a voxel before the first centre
    while start < stop:
        length = 0.5
        while 2 * length <= near + growth * start and 2 * length <= tree.root_voxel:
            length *= 2
        start, count = start + length, count + 1
    assert int(result["samples"]) == count >= 8


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_ray_in_pieces_is_the_ray_in_one_go(blobs, backend, dtype):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[backend])
    rays = camera_rays(tree, distance=1.3).to(tree.device)
    low, high = tree.box
    origin, direction = rays.origin.cpu(), rays.direction.cpu()
    a, b = (low - origin) / direction, (high - origin) / direction
    enter = torch.minimum(a, b).amax(1).to(tree.device)
    step = 0.5 * min(tree.spacing)
    cuts = [enter + n * step for n in (0, 40, 62, 63, 90)]  # whole intervals: the same samples
    ends = [*cuts, torch.full_like(enter, torch.inf)]
    options = gv.RenderOptions(backend=backend, lod="finest", dtype=dtype)
    tracer = Tracer(tree, SHADER, options)
    whole = tracer(rays)
    joined = trace_pieces(
        tracer,
        [
            dataclasses.replace(rays, range=torch.stack(pair, 1))
            for pair in itertools.pairwise(ends)
        ],
    )
    tolerance = 2e-5 if dtype == torch.float32 else 1e-9
    for name in ("color", "alpha"):
        torch.testing.assert_close(
            getattr(joined, name), getattr(whole, name), rtol=0, atol=tolerance
        )
    both = whole.depth.isfinite() & joined.depth.isfinite()
    assert both.sum() > 40 and (whole.depth.isfinite() != joined.depth.isfinite()).sum() <= 1
    assert (whole.depth - joined.depth)[both].abs().max() < 1e-3
    # A cut may fall a rounding beside the interval's end, which then is a sample of its own.
    assert (whole.samples - joined.samples).abs().max() <= 5
    assert whole.alpha.max() > 0.95, "some rays must end early"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_share_that_a_ray_begins_with_equals_the_reference(blobs, compiled, dtype):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree, distance=1.3)
    generator = torch.Generator().manual_seed(5)
    clear = torch.rand(len(rays.origin), generator=generator, dtype=torch.float64)
    clear[::7], clear[1::7] = 0.0, 1.0
    result, _ = assert_equal(tree, compiled, dataclasses.replace(rays, clear=clear), dtype=dtype)
    closed = clear == 0
    assert not result["samples"][closed].any() and (result["alpha"][closed] == 1).all()
    full, _ = run(tree, compiled, rays, dtype=dtype, stop_alpha=1.0)
    part, _ = run(tree, compiled, dataclasses.replace(rays, clear=clear), stop_alpha=1.0)
    np.testing.assert_allclose(part["color"], full["color"] * clear[:, None], atol=2e-6)


@pytest.mark.parametrize(
    "clear", [torch.ones(4, dtype=torch.float64), torch.ones(3, 1, dtype=torch.float64)]
)
def test_a_wrong_share_is_one_clear_error(blobs, clear):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = dataclasses.replace(camera_rays(tree)[:3], clear=clear)
    with pytest.raises(ValueError, match=r"clear_r must be \(3,\) float64"):
        Tracer(tree, SHADER, gv.RenderOptions())(rays)
