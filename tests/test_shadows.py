"""Shadows inside a medium, one cone per sample, against closed forms and a dense marcher."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.marcher import box_of, march, trilinear
from helpers.rays import rays_along
from helpers.shading import MATT

import gvtorch as gv
from gvtorch.tracing.tracer import Tracer

SPACING, ORIGIN = (1.0, 0.8, 1.5), (5.0, -3.0, 2.0)
SUN = gv.DirectionalLight((0.6, -1.0, 0.3))
LAMP = gv.PointLight((19.0, 30.0, 12.0))
INSIDE = gv.PointLight((11.0, 2.0, 9.0))


def fog(seed: int, side: int = 16) -> np.ndarray:
    """Returns (z, y, x) float32 noise with a hole."""
    value = np.random.default_rng(seed).uniform(0, 1, (side, side, side)).astype(np.float32)
    value[:, side * 9 // 16 :, : side * 7 // 16] = 0
    return value


def tree_of(value: np.ndarray, backend: str, branching: int = 2) -> gv.N3Tree:
    """Returns density, colours of that opacity, and zero normals, which always face the light."""
    placement = SPACING, ORIGIN
    zero = np.zeros((*value.shape, 3), np.float32)
    rgba = np.concatenate((zero + 1, value[..., None]), -1)
    channels = {"value": value, "none": zero, "rgba": rgba}
    volumes = {name: gv.Volume(data, *placement) for name, data in channels.items()}
    return gv.N3Tree.from_volume(volumes, 4, branching=branching, device=DEVICES[backend])


def rays_through(box: np.ndarray, device: str, count: int = 12) -> gv.Rays:
    """Returns rays from all sides to points in a box."""
    random = np.random.default_rng(3)
    target = box[0] + random.uniform(0.2, 0.8, (count, 3)) * (box[1] - box[0])
    along = random.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    origins = torch.from_numpy(target - 60 * along)
    return rays_along(origins, torch.from_numpy(along), device=device)


def to_light(light, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns directions (k, 3) and distances (k,) from points to a light."""
    if isinstance(light, gv.DirectionalLight):
        aim = -np.array(light.direction) + 0 * point
        return aim / np.linalg.norm(aim, axis=1, keepdims=True), np.full(len(point), np.inf)
    aim = np.array(light.position) - point
    distance = np.linalg.norm(aim, axis=1)
    return aim / distance[:, None], distance


def seen(value, rays, light, transfer, step) -> np.ndarray:
    """Returns the light (r,) of rays, marched densely, also from each sample to the light."""
    box, out = box_of(value.shape, SPACING, ORIGIN), []
    spacing, origin = np.array(SPACING), np.array(ORIGIN)
    for eye, d in zip(rays.origin.cpu().numpy(), rays.direction.cpu().numpy(), strict=True):
        low, high = (box[0] - eye) / d, (box[1] - eye) / d
        near, far = np.minimum(low, high).max(), np.maximum(low, high).min()
        start = near + step * np.arange(int(np.ceil((far - near) / step)))
        end = np.minimum(start + step, far)
        points = eye + ((start + end) / 2)[:, None] * d
        alpha = transfer(trilinear(value, (points - origin) / spacing))[:, 3]
        alpha = 1 - (1 - alpha) ** (end - start)
        direction, distance = to_light(light, points)
        _, taken, _ = march(
            *(value, SPACING, ORIGIN, (points, direction), transfer, 1.0, step),
            first=step,
            last=np.maximum(distance, step),
        )
        clear = np.concatenate(([1.0], np.cumprod(1 - alpha)[:-1]))
        out.append((clear * alpha * (1 - taken)).sum())
    return np.array(out)


@pytest.mark.parametrize(
    ("light", "branching"),
    [(SUN, 2), (LAMP, 3), (INSIDE, 2)],
    ids=["sun, N = 2", "lamp, N = 3", "lamp inside, N = 2"],
)
@pytest.mark.parametrize("stored", [False, True], ids=["function", "stored colour"])
def test_each_sample_stands_in_the_shadow_of_what_lies_before_its_light(
    backend, light, branching, stored
):
    """For each pair of light, shader and precision, as the twin takes a second for each."""
    value = fog(1, 10)
    tree = tree_of(value, backend, branching)
    rays = rays_through(box_of(value.shape, SPACING, ORIGIN), DEVICES[backend])
    dtype = torch.float64 if stored == (light is LAMP) else torch.float32
    options = {"backend": backend, "lod": "finest", "dtype": dtype}
    options |= {"step": 1.0, "stop_alpha": 1.0}
    linear = gv.TransferFunction.from_points([(0, 0), (1, 0.2)], [(0, 1, 1, 1)], reference=1.0)

    def function(v):
        return np.stack((*[np.ones_like(v)] * 3, v if stored else 0.2 * v), -1)

    shading = {"normals": "none", "light": light, "shadows": True, **MATT}
    shader = gv.StoredColor("rgba", reference=1.0, **shading)
    if not stored:
        shader = gv.Lit(linear, **shading)
    hits = gv.trace(tree, rays, shader, **options)
    expected = seen(value, rays, light, function, min(SPACING))
    assert expected.max() > 0.05
    for column in hits.color.cpu().numpy().T:
        np.testing.assert_allclose(column, expected, rtol=2e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_light_decays_with_depth_in_a_homogeneous_medium(backend, dtype):
    """exp(-extinction * depth): a ray straight across has a constant depth, also in one node of one
    value.
    """
    tree = tree_of(np.full((16, 16, 16), 0.5, np.float32), backend)
    low, high = tree.box
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    depth = torch.tensor([1.0, 2.0, 3.0, 5.0], dtype=torch.float64)
    flat = torch.zeros((4, 2), dtype=torch.float64)
    rays = gv.Rays(
        origin=torch.stack((depth * 0, high[1] - depth, depth * 0 + low[2] + 9), 1),
        direction=torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(4, 3).contiguous(),
        cone=flat,
        range=flat + torch.tensor([0.0, torch.inf]),
    ).to(DEVICES[backend])
    extinction = 0.3
    transfer = gv.TransferFunction.from_points([(0, 1 - np.exp(-extinction))], [(0, 1, 1, 1)])
    transfer.reference = 1.0
    for slope in (0.0, 1.0):
        sun = gv.DirectionalLight(tuple((-up + slope * torch.tensor([0.0, 0.0, 0.5])).tolist()))
        shader = gv.Lit(transfer, light=sun, shadows=True, **MATT)
        step = 0.5 if backend == "reference" else 0.25
        options = gv.RenderOptions(
            backend=backend, dtype=dtype, lod="finest", step=step / min(SPACING), stop_alpha=1.0
        )
        hits = Tracer(tree, shader, options)(rays)
        distance = depth * np.sqrt(1 + (0.5 * slope) ** 2)
        expected = torch.exp(-extinction * (distance - step))  # its first interval is left out
        actual = (hits.color / hits.alpha).cpu().double()
        torch.testing.assert_close(actual, expected[:, None].expand(4, 3), rtol=1e-4, atol=0)


def test_a_shadow_of_a_wide_light_is_softer_and_coarser(backend):
    """Half of a slab lies below a plate, whose edge is the edge of the shadow."""
    value = np.zeros((32, 32, 32), np.float32)
    value[4:8] = 1.0  # what the shadow falls on
    value[24:26, :, :16] = 1.0
    volume = gv.Volume(value)
    tree = gv.N3Tree.from_volume(volume, 4, device=DEVICES[backend])
    transfer = gv.TransferFunction.from_points([(0, 0), (1, 0.9)], [(0, 1, 1, 1)])
    across = torch.linspace(6.0, 26.0, 41, dtype=torch.float64)
    flat = torch.zeros((41, 2), dtype=torch.float64)
    rays = gv.Rays(
        origin=torch.stack((across, across * 0 + 15.5, across * 0 + 16), 1),
        direction=torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(41, 3).contiguous(),
        cone=flat + torch.tensor([1.0, 0.0]),
        range=flat + torch.tensor([0.0, torch.inf]),
    ).to(DEVICES[backend])
    options = {"backend": backend}
    edges, samples = [], []
    for angle in (0.0, 20.0, 60.0):
        sun = gv.DirectionalLight((0.0, 0.0, -1.0), angle=angle)
        lit = gv.Lit(transfer, light=sun, shadows=True, **MATT)
        hits = gv.trace(tree, rays, lit, **options)
        light = (hits.color[:, 0] / hits.alpha[:, 0]).cpu()
        light = light / light[-1]
        assert light[0] < 0.35 and light[-8:].min() > 0.9
        edge = across[int((light > 0.5).nonzero()[0])]
        assert 13 < edge < 18, "the shadow ends below the plate's edge"
        edges.append(int(((light > 0.2) & (light < 0.8)).sum()))
        samples.append(int(hits.samples.sum()))
    assert edges[0] < edges[1] < edges[2] and samples[0] > samples[1] > samples[2]


def test_a_headlight_and_no_light_at_all_throw_no_shadow(backend):
    tree = tree_of(fog(2), backend)
    rays = rays_through(tree.box.numpy(), DEVICES[backend])
    transfer = gv.TransferFunction.from_points([(0.2, 0), (1, 0.3)], [(0, 1, 1, 1)])
    options = {"backend": backend, "lod": "finest"}
    plain, shadowed = (
        gv.trace(tree, rays, gv.Lit(transfer, shadows=shadows), **options)
        for shadows in (False, True)
    )
    assert torch.equal(plain.color, shadowed.color) and plain.color.max() > 0.05
    assert torch.equal(plain.samples, shadowed.samples)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rays_do_not_depend_on_those_whose_cones_are_traced_with_theirs(compiled, dtype):
    """Packets and warps gather the cones of their rays, of which there may be any number."""
    value = fog(6)
    tree = tree_of(value, compiled)
    transfer = gv.TransferFunction([(0.2, 0), (1, 0.08)])
    shader = gv.Lit(transfer, normals="none", light=LAMP, shadows=True)
    rays = rays_through(box_of(value.shape, SPACING, ORIGIN), DEVICES[compiled], 70)
    together = vars(gv.trace(tree, rays, shader, step=0.4, dtype=dtype, backend=compiled))
    assert float(together["alpha"].min()) < 0.9 and int(together["samples"].min()) > 200
    for part in (slice(1), slice(5, 38), slice(3, 70, 2), slice(64, 70)):
        alone = gv.trace(tree, rays[part], shader, step=0.4, dtype=dtype, backend=compiled)
        for name, values in vars(alone).items():
            assert values is None or torch.equal(values, together[name][part]), name


def test_a_surface_has_no_shadows_per_sample():
    surface = gv.Isosurface(0.5)
    surface.shadows = True
    tree = gv.N3Tree.from_volume(gv.Volume(fog(2)))
    with pytest.raises(ValueError, match="render: shadows per sample are for Lit and StoredColor"):
        gv.render(tree, gv.Camera.orbit(width=4, height=4), surface)


def test_what_is_only_seen_in_a_shadow_is_streamed_too():
    """The object that throws the shadow is outside of the picture."""
    value = np.zeros((64, 64, 64), np.float32)
    value[4:8] = 1.0
    value[44:48, 24:40, 20:40] = 1.0
    volume = gv.Volume(value)
    transfer = gv.TransferFunction.from_points([(0, 0), (1, 0.9)], [(0, 1, 1, 1)])
    camera = gv.Camera.look_at(
        (32.0, 31.0, 30.0), (32.0, 32.0, 4.0), (0, 1, 0), fov=50, width=16, height=16
    )
    sun = gv.DirectionalLight((0.0, 0.0, -1.0))
    used = {}
    for shadows in (False, True):
        lit = gv.Lit(transfer, light=sun, shadows=shadows, ambient=0.1, specular=0.0)
        resident = gv.render(gv.N3Tree.from_volume(volume, 8), camera, lit)
        with gv.Engine(gv.VolumeProducer(volume), brick_size=8) as engine:
            picture = engine.render(camera, lit)
            used[shadows] = picture.stats.bricks_used
        assert picture.stats.converged
        torch.testing.assert_close(picture.color, resident.color, atol=2e-3, rtol=0)
    assert used[True] > used[False] and picture.color.min() < 0.5 * picture.color.max()
