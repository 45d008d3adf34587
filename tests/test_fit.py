"""Views that the pools can't hold, in frames served on the device; on CUDA also as one graph."""

from __future__ import annotations

import time

import pytest
import torch
from helpers import DEVICES
from helpers.recorded import COMPILED, TRANSFER, Ball, Frames, view

import gvtorch as gv
from gvtorch.engine import host_frame


@pytest.mark.parametrize("backend", COMPILED)
def test_views_that_the_pools_cannot_hold_are_drawn_at_levels_that_fit(backend):
    device, wide, shader = DEVICES[backend], view(64, 0), gv.Isosurface(0.5)
    small = {"brick_pool": "0.6 MB", "node_pool": "2 MB", "device": device}
    results = []
    for fit in (True, False):
        with gv.Engine(Ball(1024), **small) as engine:
            frames = Frames(engine, wide, shader, 512, 0, fit)
            for _ in range(25):
                _, stats = frames.frame()
            results.append(stats)
            engine.validate()
    fitting, unfitted = results
    assert unfitted.misses > 50 and unfitted.coarser == 1
    assert fitting.misses == 0 and fitting.converged and 1 < fitting.coarser < 3
    with gv.Engine(Ball(1024), brick_pool="64 MB", device=device) as engine:
        whole, stats = Frames(engine, wide, shader, 512, 0, True).whole()
        assert stats.coarser == 1, "where all fits, nothing is coarser"
        assert torch.equal(whole.color, Frames(engine, wide, shader, 512).whole()[0].color)


@pytest.mark.parametrize("backend", COMPILED)
def test_rays_of_one_s_own_fit_as_their_camera_does(backend):
    device, camera = DEVICES[backend], view(64, 0)
    small = {"brick_pool": "0.6 MB", "node_pool": "2 MB", "device": device}
    factors, pictures = [], []
    for by_ray in (False, True):
        with gv.Engine(Ball(1024), **small) as engine:
            rays = camera.placed(engine.view("test", camera, TRANSFER, {}).box).rays()
            seen = gv.CustomCamera(rays, 64, 64) if by_ray else camera
            frames = Frames(engine, seen, gv.Isosurface(0.5), 512, 0, True)
            for _ in range(25):
                hits, stats = frames.frame()
            assert stats.misses == 0 and stats.converged
            factors.append(stats.coarser)
            pictures.append(hits.color.cpu())
    assert factors[0] == factors[1] > 1
    assert torch.equal(*pictures)


@pytest.mark.parametrize("backend", COMPILED)
def test_views_that_fit_again_are_as_asked_for(backend):
    small = {"brick_pool": "1.2 MB", "node_pool": "2 MB", "device": DEVICES[backend]}
    with gv.Engine(Ball(1024), **small) as engine:
        frames = Frames(engine, view(64, 0), TRANSFER, 512, 0, True)
        for _ in range(12):
            _, stats = frames.frame()
        assert stats.coarser > 1
        frames.look_from(gv.Camera.orbit(0, 20, 6.0, None, 64, 64))
        for _ in range(80):
            _, stats = frames.frame()
        assert stats.coarser == 1 and stats.converged


@pytest.mark.parametrize("backend", COMPILED)
def test_views_fit_where_producers_answer_from_the_host(backend):
    """There, pending bricks count as well, because they are not requested again."""
    axis = torch.linspace(-1, 1, 96)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    waves = 0.5 + 0.5 * torch.sin(9 * x) * torch.sin(8 * y) * torch.sin(7 * z)
    for fit in (False, True):
        options = {"brick_pool": "60 kB", "node_pool": "2 MB", "device": DEVICES[backend]}
        with gv.Engine(gv.VolumeProducer(gv.Volume(waves)), **options) as engine:
            frames = Frames(engine, view(64, 0), TRANSFER, 512, 0, fit)
            assert isinstance(frames.served, host_frame.HostFrame)
            for _ in range(60):
                _, stats = frames.frame()
                time.sleep(0.02)
            engine.validate()
        assert stats.converged == fit and (stats.coarser > 1) == fit


@pytest.mark.backend("cuda")
def test_a_graph_fits_as_well():
    small = {"brick_pool": "1.2 MB", "node_pool": "2 MB", "device": "cuda"}
    with gv.Engine(Ball(1024), **small) as engine:
        graph = engine.capture(view(64, 0), TRANSFER, fit=True)
        for _ in range(40):
            _, stats = graph.replay(view(64, 0))
        assert stats.converged and 1 < stats.coarser < 3
        engine.validate()

    class Unsaid(Ball):
        on_device = False

    with gv.Engine(Unsaid(), device="cuda") as engine:
        with pytest.raises(ValueError, match="fit needs replays that serve"):
            engine.capture(view(64, 0), TRANSFER, fit=True)
        with pytest.raises(ValueError, match="look_ahead needs replays that serve"):
            engine.capture(view(64, 0), TRANSFER, look_ahead=4)
