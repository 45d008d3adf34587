"""Sizes, streams, devices and instruction sets that change nothing but the speed."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from helpers.packets import INSTRUCTIONS, result, start
from helpers.rays import camera_rays
from helpers.traces import SHADER
from helpers.trees import copy_to

import gvtorch as gv

FIELDS = ("color", "alpha", "depth", "samples")


@cache
def traced() -> list[torch.Tensor]:
    """Returns pictures of voxels of each size, with blended levels, on the CPU."""
    values = torch.rand(32, 32, 32, generator=torch.Generator().manual_seed(4))
    results = []
    for dtype, factor in ((torch.uint8, 255), (torch.float16, 1), (torch.float32, 1)):
        tree = gv.N3Tree.from_volume(gv.Volume((values * factor).to(dtype)), 8)
        shader = gv.TransferFunction.from_points([(0.3 * factor, 0), (factor, 0.2)])
        for size in (33, 7):  # cones as wide as a voxel, and as several
            hits = gv.trace(tree, camera_rays(tree, size, distance=1.5), shader)
            results += [getattr(hits, name) for name in FIELDS]
    return results


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("instructions", INSTRUCTIONS)
def test_every_instruction_set_gives_the_same_bits(instructions, tmp_path):
    actual = result(start(traced, tmp_path, instructions))
    for a, b in zip(actual, traced(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.backend("cuda")
def test_cuda_brick_pool_of_more_than_4_gib(blobs):
    small = gv.N3Tree.from_volume(blobs, 8, device="cuda")
    rays = camera_rays(small, 64, distance=1.3).to("cuda")
    expected = gv.trace(small, rays, SHADER)
    channel = gv.Channel(torch.float32)
    used, size = small.bricks.capacity, 10**3 * 4
    large = gv.BrickPool(5 * 2**30 // size, {"value": channel}, brick_size=8, device="cuda")
    first = large.capacity - used
    large.bricks["value"].fill_(0.9)
    large.bricks["value"][first:] = small.bricks.bricks["value"]
    small.nodes.brick_tn[small.nodes.brick_tn >= 0] += first
    small.bricks = large
    actual = gv.trace(small, rays, SHADER)
    assert all(torch.equal(getattr(actual, n), getattr(expected, n)) for n in FIELDS)
    assert (large.stamp_b[first:] == small.frame).any() and expected.alpha.max() > 0.3


@pytest.mark.backend("cuda")
def test_cuda_sixteen_million_rays_in_one_call(blobs):
    tree = gv.N3Tree.from_volume(blobs, 8, device="cuda")
    rays = gv.Camera.orbit(width=4096, height=4096, distance=1.3).placed(tree.box).rays("cuda")
    whole = gv.trace(tree, rays, SHADER)
    part = rays.origin.shape[0] // 4
    for begin in range(0, 4 * part, part):
        some = gv.trace(tree, rays[begin : begin + part], SHADER)
        for name in FIELDS:
            assert torch.equal(getattr(whole, name)[begin : begin + part], getattr(some, name))


@pytest.mark.backend("cuda")
def test_cuda_streams(blobs):
    tree = copy_to(gv.N3Tree.from_volume(blobs, 8), "cuda")
    rays = camera_rays(tree, 64, distance=1.3).to("cuda")
    expected = gv.trace(tree, rays, SHADER)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(10**8)
        late = rays.origin + 0  # made on this stream, after the sleep
        moved = gv.Rays(origin=late, direction=rays.direction, cone=rays.cone, range=rays.range)
        actual = gv.trace(tree, moved, SHADER)
    stream.synchronize()
    assert all(torch.equal(getattr(actual, n), getattr(expected, n)) for n in FIELDS)


@pytest.mark.backend("cuda")
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one CUDA device")
def test_cuda_second_device(blobs):
    tree = gv.N3Tree.from_volume(blobs, 8)
    rays = camera_rays(tree, 64, distance=1.3)
    expected = gv.trace(tree, rays, SHADER)
    with torch.cuda.device(0):
        actual = gv.trace(copy_to(tree, "cuda:1"), rays.to("cuda:1"), SHADER)
        producer = gv.VolumeProducer(blobs)
        with gv.Engine(producer, device="cuda:1") as engine:
            camera = gv.Camera.orbit(width=32, height=32, distance=1.3)
            picture = engine.render(camera, SHADER)
    assert all(torch.equal(getattr(actual, n).cpu(), getattr(expected, n)) for n in FIELDS)
    resident = gv.render(tree, camera, SHADER)
    assert picture.stats.converged and torch.equal(picture.color.cpu(), resident.color)


@pytest.mark.backend("cuda")
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one CUDA device")
def test_cuda_frames_are_captured_on_each_device(blobs):
    """One after the other: torch's default stream for recording lies on the first device."""
    cameras = [gv.Camera.orbit(turn, 20, width=32, height=32, distance=1.3) for turn in (0, 90)]
    expected = [gv.render(gv.N3Tree.from_volume(blobs), camera, SHADER) for camera in cameras]
    for device in ("cuda:1", "cuda:0", "cuda:1"):
        with gv.Engine(gv.VolumeProducer(blobs), device=device) as engine:
            graph = engine.capture(cameras[0], SHADER)
            for camera, picture in zip(cameras, expected, strict=True):
                for _ in range(100):
                    actual, stats = graph.replay(camera)
                    if stats.converged:
                        break
                assert stats.converged and torch.equal(actual.color.cpu(), picture.color)
