"""Octaves of scattering: against their sum in closed form, and against a path tracer in NumPy
(benchmarks/cloud_light.py), which is itself tested against closed forms.
"""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
import torch
from helpers import DEVICES, ROOT
from helpers.rays import camera_rays, rays_along

import gvtorch as gv
from gvtorch.tracing.tracer import Tracer

EXTINCTION, SIDE = 0.3, 16
SUN = (0.3, -1.0, 0.2)
ALBEDO = (1.0, 0.7, 0.3)


@pytest.fixture(scope="module")
def script():
    """The benchmark, as a module."""
    spec = importlib.util.spec_from_file_location(
        "cloud_light", ROOT / "benchmarks" / "cloud_light.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["cloud_light"] = module
    spec.loader.exec_module(module)
    return module


def transfer(color=ALBEDO) -> gv.TransferFunction:
    return gv.TransferFunction([(0, 1 - np.exp(-EXTINCTION))], [(0, *color)], 1.0)


def phase(g: float, cosine: float) -> float:
    return (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5


@pytest.mark.parametrize(
    ("octaves", "g", "dtype"),
    [
        (1, 0.0, torch.float32),
        (1, 0.7, torch.float64),
        (3, 0.0, torch.float64),
        (5, 0.85, torch.float32),
        (5, -0.4, torch.float64),
    ],
)
def test_octaves_in_a_homogeneous_medium(backend, octaves, g, dtype):
    """A ray across a cube has a constant depth below the lit face: there each octave is
    0.55^n albedo^(1 + 2n) phase(0.6^n g) transmittance^(1 / 2^n).
    """
    volume = gv.Volume(np.ones((SIDE,) * 3, np.float32))
    tree = gv.N3Tree.from_volume(volume, 4, device=DEVICES[backend])
    depth = torch.tensor([1.0, 2.0, 6.0, 12.0], dtype=torch.float64)
    positions = torch.stack((depth * 0 - 3, SIDE - 0.5 - depth, depth * 0 + 7), 1)
    rays = rays_along(positions, (1.0, 0.0, 0.0), device=DEVICES[backend])
    sun = gv.DirectionalLight((0, -1, 0), color=(1.0, 2.0, 0.5))
    shader = gv.Lit(transfer(), light=sun, octaves=octaves, anisotropy=g, ambient=0.1, diffuse=0.7)
    step = 1.0 if backend == "reference" else 0.25
    options = gv.RenderOptions(
        backend=backend, dtype=dtype, lod="finest", step=step, stop_alpha=1.0
    )
    hits = Tracer(tree, shader, options)(rays)
    clear = np.exp(-EXTINCTION * (depth.numpy() - step))[:, None]  # the first interval is left out
    albedo, light = np.array(ALBEDO), np.array((1.0, 2.0, 0.5))
    expected = 0.1 * albedo + 0.7 * light * sum(
        0.55**n * albedo ** (1 + 2 * n) * phase(0.6**n * g, 0.0) * clear ** (0.5**n)
        for n in range(octaves)
    )
    actual = (hits.color / hits.alpha).double().cpu().numpy()
    np.testing.assert_allclose(actual, expected, rtol=2e-4)


def test_light_from_ahead_goes_on(backend):
    """The sign of the cosine: forward scattering is bright where the eye looks towards the sun."""
    tree = gv.N3Tree.from_volume(
        gv.Volume(np.ones((8, 8, 8), np.float32)), 4, device=DEVICES[backend]
    )
    rays = rays_along(torch.tensor([[4.0, 4.0, -5.0]]).double(), (0, 0, 1), device=DEVICES[backend])
    light = []
    for direction in ((0, 0, -1), (0, 0, 1)):  # against the eye, and with it
        lit = gv.Lit(
            transfer((1, 1, 1)), light=gv.DirectionalLight(direction), octaves=1, anisotropy=0.6
        )
        light.append(float(Tracer(tree, lit, gv.RenderOptions(backend=backend))(rays).color[0, 0]))
    assert light[0] > 5 * light[1] > 0


def test_one_octave_to_all_sides_is_a_medium_without_normals():
    """It equals `shadows=True` with a channel of zero normals, which it does not need."""
    value = np.random.default_rng(2).uniform(0, 1, (12, 12, 12)).astype(np.float32)
    zero = np.zeros((12, 12, 12, 3), np.float32)
    tree = gv.N3Tree.from_volume({"value": gv.Volume(value), "none": gv.Volume(zero)}, 4)
    ramp = gv.TransferFunction([(0.3, 0), (1, 0.5)], [(0, 0.9, 0.8, 0.5)])
    options = {"light": gv.DirectionalLight(SUN), "ambient": 0.2, "specular": 0.0}
    rays = camera_rays(tree, 12)
    bare = gv.trace(tree, rays, gv.Lit(ramp, normals="none", shadows=True, **options))
    # Octaves follow light further, below a share of 0.01.
    fine = gv.trace(tree, rays, gv.Lit(ramp, octaves=1, **options))
    torch.testing.assert_close(fine.color, bare.color, rtol=1e-5, atol=1e-6)
    assert torch.equal(fine.samples, bare.samples)


def test_thick_clouds_do_not_end_at_the_first_shadow(backend):
    """Where single scattering is black, the fifth octave is not: light is followed further."""
    volume = gv.Volume(np.ones((SIDE,) * 3, np.float32))
    tree = gv.N3Tree.from_volume(volume, 4, device=DEVICES[backend])
    dense = gv.TransferFunction([(0, 1 - np.exp(-3.0))], [(0, 1, 1, 1)], 1.0)
    origin = torch.tensor([[-3.0, SIDE - 10.5, 7.0]]).double()
    rays = rays_along(origin, (1.0, 0.0, 0.0), device=DEVICES[backend])
    lit = gv.Lit(dense, light=gv.DirectionalLight((0, -1, 0)), octaves=5, ambient=0.0, diffuse=1.0)
    options = gv.RenderOptions(backend=backend, lod="finest", step=0.25)
    hits = Tracer(tree, lit, options)(rays)
    clear = np.exp(-3.0 * 9.75)
    expected = sum(0.55**n * clear ** (0.5**n) for n in range(5))
    assert float(hits.color[0, 0] / hits.alpha[0, 0]) == pytest.approx(expected, rel=1e-3)


def test_what_is_refused():
    tree = gv.N3Tree.from_volume(gv.Volume(np.ones((8, 8, 8), np.float32)), 4)
    rays, sun = camera_rays(tree, 2), gv.DirectionalLight(SUN)
    for bad in (-1, 6, 2.5, True, "3"):
        with pytest.raises(ValueError, match="Lit: octaves must be an int >= 0 and <= 5"):
            gv.Lit(transfer(), octaves=bad)
    with pytest.raises(ValueError, match="anisotropy"):
        gv.Lit(transfer(), octaves=1, anisotropy=1.0)
    with pytest.raises(ValueError, match="octaves of scattering need a sun or lamp"):
        gv.trace(tree, rays, gv.Lit(transfer(), octaves=2))
    with pytest.raises(ValueError, match="for Lit and StoredColor"):
        gv.trace(tree, rays, gv.Isosurface(0.5, light=sun, octaves=2))


def test_the_path_tracer_keeps_energy(script):
    """A ball that absorbs nothing sends out as much light as it gets from the sun."""
    positions = np.stack(np.meshgrid(*(np.arange(14) - 6.5,) * 3, indexing="ij"), -1)
    ball = (0.5 * (np.linalg.norm(positions, axis=-1) < 5)).astype(np.float32)
    rng, count, reach = np.random.default_rng(0), 30000, 8
    steps = np.arange(0, 13.001, 0.1)
    grid = np.stack(np.meshgrid(steps, steps, steps[::2], indexing="ij"), -1).reshape(-1, 3)
    depth = script.Cloud(ball).at(grid).reshape(len(steps), len(steps), -1).sum(2) * 0.2
    taken = (1 - np.exp(-depth)).sum() * 0.1**2
    for g in (0.0, 0.6):
        cloud = script.Cloud(ball, 1.0, g)
        vectors = rng.normal(size=(count, 3))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        offsets = np.cross(vectors, rng.normal(size=(count, 3)))
        offsets *= (reach * np.sqrt(rng.random(count)) / np.linalg.norm(offsets, axis=1))[:, None]
        sent, error = script.path_trace(cloud, 6.5 + offsets - 20 * vectors, vectors, 2, seed=1)
        assert sent.mean() * np.pi * reach**2 == pytest.approx(taken, rel=0.04)
        assert error.mean() > 0


def test_the_path_tracer_with_hardly_any_albedo_scatters_once(script):
    """A homogeneous cube, lit and seen along one axis: a closed form."""
    density = np.zeros((18, 18, 18), np.float32)
    density[1:-1, 1:-1, 1:-1] = 0.2
    for g in (0.0, 0.5):
        cloud = script.Cloud(density, 1e-4, g)  # the sun is along +z, seen from there
        eye, ray = np.array([[8.5, 8.5, 30.0]]), np.array([[0.0, 0.0, -1.0]])
        light, error = script.path_trace(cloud, *(np.repeat(a, 4000, 0) for a in (eye, ray)), 2)
        depth = 0.2 * 16  # a ramp of one voxel at either end
        expected = 1e-4 * phase(g, -1.0) * (1 - np.exp(-2 * depth)) / 2
        assert light.mean() == pytest.approx(expected, rel=0.03)
        assert error.mean() < 2 * expected


def test_octaves_come_nearer_to_the_path_tracer(script):
    """On clouds that the constants were not fitted to."""
    off: dict[int, list[float]] = {1: [], 5: []}
    shape = script.noisy(24)
    for g, sun in ((0.0, (0.5, 0.4, -0.8)), (0.5, (0.2, 0.95, -0.1)), (0.85, (-0.4, 0.3, 0.85))):
        cloud = script.Cloud(0.6 * shape, 1.0, g, script.eye_to_world(np.array(sun)))
        results = script.compare(cloud, 7, 32, [1, 5])
        for octaves, differences in off.items():
            differences.append(results[octaves][1])
        assert results[1][0] < 0.6 and 0.5 < results[5][0] < 1.5
    assert np.sqrt(np.mean(np.square(off[5]))) < 0.6 * np.sqrt(np.mean(np.square(off[1])))
