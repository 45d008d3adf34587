"""The fused shaders against closed forms, on every backend."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import get_type_hints

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.shading import CENTRE, RADIUS, SPACING, ball, grid, parallel, phong, sphere

import gvtorch as gv
from gvtorch.fields.fractals import Fractal, FractalSettings
from gvtorch.ops.reference.shaders import IsosurfaceNumbers
from gvtorch.ops.shading import LightKind, ShadeParameters
from gvtorch.shaders.built_in import SurfaceSettings
from gvtorch.shaders.lights import LightSettings, LitShader
from gvtorch.tracing.tracer import Tracer

WHITE = gv.TransferFunction.from_points([(0, 1)], [(0, 1, 1, 1)])


def shoot(tree, rays, shader, backend, **options) -> dict[str, np.ndarray]:
    chosen = gv.RenderOptions(backend=backend, lod="finest", **options)
    hits = vars(Tracer(tree, shader, chosen)(rays))
    return {n: field.cpu().double().numpy() for n, field in hits.items() if field is not None}


@pytest.mark.parametrize("step", [0.5, 1.0, 2.0])
def test_a_crossing_is_as_exact_as_interpolation(backend, step):
    tree = ball(backend)
    for reach, most in ((9.0, 0.06), (10.5, 0.13), (10.9, 0.3)):
        rays = parallel(41, reach, DEVICES[backend])
        hits = shoot(tree, rays, gv.DistanceField(), backend, step=step)
        t, normal = sphere(rays)
        error, facing = (
            np.abs(hits["depth"][:, 0] - t) / min(SPACING),
            -(normal * rays.direction.cpu().numpy()).sum(1),
        )
        degrees, across = np.degrees(np.arccos(facing.min())), (error * facing).max()
        print(
            f"step {step}, to {degrees:.0f} degrees: off by {error.max():.3f}, {across:.3f} across"
        )
        assert error.max() < most and across < 0.04, "of the smallest side of a voxel"
        cosine = (hits["normal"] * normal).sum(1)
        assert cosine.min() > 0.995
    assert np.abs(np.linalg.norm(hits["normal"], axis=1) - 1).max() < 1e-5
    assert (hits["alpha"] == 1).all()


def test_an_offset_moves_the_surface_and_what_misses_stays_clear(backend):
    tree = ball(backend)
    rays = parallel(21, 12.5, DEVICES[backend])
    hits = shoot(tree, rays, gv.DistanceField(offset=-2.0), backend)
    with np.errstate(invalid="ignore"):
        t, _ = sphere(rays, RADIUS - 2)
    inside = np.isfinite(t)
    assert 0.2 < inside.mean() < 0.8
    found = hits["alpha"][:, 0] == 1
    assert (found != inside).mean() < 0.04, "only rays that graze the sphere may differ"
    both = found & inside
    grazing = np.abs(hits["depth"][both, 0] - t[both])
    assert np.quantile(grazing, 0.9) < 0.08
    assert np.isinf(hits["depth"][~found]).all() and (hits["normal"][~found] == 0).all()


def test_normals_show_no_seam_at_brick_faces(backend):
    """A tree with bricks of 4 gives the normals of one single brick."""
    rays = parallel(25, 9.0, DEVICES[backend])
    shader = gv.DistanceField()
    many, one = (shoot(ball(backend, brick_size=s), rays, shader, backend) for s in (4, 64))
    assert np.abs(many["normal"] - one["normal"]).max() < 1e-4
    assert np.abs(many["depth"] - one["depth"]).max() < 1e-4
    soft = gv.Lit(gv.TransferFunction.from_points([(-3, 0.8), (-1, 0)]), shininess=5)
    many, one = (shoot(ball(backend, brick_size=s), rays, soft, backend) for s in (4, 64))
    for field in ("color", "normal"):
        assert np.abs(many[field] - one[field]).max() < 1e-4
    assert many["alpha"].min() > 0.3


@pytest.mark.parametrize(
    ("stored", "kind"),  # where normals and light come from do not depend on each other
    [
        *((None, "head"), (None, "directional"), (None, "point")),
        *(("int8", "directional"), ("uint8", "point"), ("float32", "head")),
    ],
)
def test_phong_on_a_sphere(backend, kind, stored):
    offsets = grid((33, 39, 27), SPACING) - CENTRE
    outward = offsets / np.maximum(np.linalg.norm(offsets, axis=-1, keepdims=True), 1e-9)
    if stored == "int8":
        outward = np.round(outward * 127).astype(np.int8)
    elif stored == "uint8":
        outward = np.round((outward * 0.5 + 0.5) * 255).astype(np.uint8)
    more = {}
    if stored:
        kept = outward.astype(np.float32) if stored == "float32" else outward
        more["n"] = gv.Volume(kept, SPACING)
    tree = ball(backend, **more)
    rays = parallel(21, 9.0, DEVICES[backend])
    t, normal = sphere(rays)
    eye = -rays.direction.cpu().numpy()
    hit = rays.origin.cpu().numpy() - t[:, None] * eye
    color = (1.0, 0.8, 0.5)
    lights = {
        "head": (gv.Headlight(color), eye),
        "directional": (gv.DirectionalLight((2, -1, 2), color), np.array([[-2, 1, -2]]) / 3),
        "point": (gv.PointLight((0.0, 40.0, -20.0), color), np.array([[0.0, 40.0, -20.0]]) - hit),
    }
    light, to_light = lights[kind]
    to_light = to_light / np.linalg.norm(to_light, axis=1, keepdims=True) + 0 * normal
    shading = {"ambient": 0.1, "diffuse": 0.7, "specular": 0.4, "shininess": 12.0}
    normals = "n" if stored else None
    shader = gv.DistanceField((0.9, 0.5, 0.3), normals=normals, light=light, **shading)
    hits = shoot(tree, rays, shader, backend)
    base = np.array([0.9, 0.5, 0.3])
    expected = phong(normal, to_light, eye, base, np.array(color), **shading)
    assert expected.max() - expected.min() > 0.4
    assert np.abs(hits["color"] - expected).max() < 0.03


@pytest.mark.parametrize("shader", [gv.Lit, gv.PreIntegrated])
def test_without_light_or_gradient_the_plain_function_is_the_limit(backend, shader):
    """Ambient light alone keeps the colours; values that are constant along a ray integrate to the
    function itself.
    """
    transfer = gv.TransferFunction.from_points([(0, 0), (1, 0.3)], [(0, 1, 0, 0), (1, 0, 1, 1)])
    ramp = np.linspace(0, 1, 24, dtype=np.float32)[None, :, None] * np.ones((20, 1, 20), np.float32)
    tree = gv.N3Tree.from_volume(gv.Volume(ramp), 4, device=DEVICES[backend])
    rays = parallel(9, 7.0, DEVICES[backend], (0, 0.0, 1.0))
    shading = {"ambient": 1, "diffuse": 0, "specular": 0} if shader is gv.Lit else {}
    hits = shoot(tree, rays, shader(transfer, **shading), backend)
    plain = shoot(tree, rays, transfer, backend)
    assert plain["alpha"].max() > 0.8
    assert np.abs(hits["color"] - plain["color"]).max() < 3e-3
    assert np.abs(hits["alpha"] - plain["alpha"]).max() < 3e-3


SHELLS = gv.TransferFunction.from_points(
    opacity=[(0.4, 0), (0.401, 0.9), (0.419, 0.9), (0.42, 0)],
    color=[(0.4, 1, 0.5, 0.1), (0.42, 1, 0.5, 0.1)],
    reference=0.1,
)


def test_thin_shells_do_not_alias_at_step_1(backend):
    """Along a ramp of slope s, a shell from 0.4 to 0.42 is 0.02 / s long, whatever the step: its
    alpha is 1 - 0.1^(length / reference), except for its soft edges.
    """
    slope = 0.05  # a value's change per world unit: the shell is 0.4 long, the step 1
    ramp = (np.arange(40, dtype=np.float32) * slope)[:, None, None] * np.ones(
        (1, 40, 40), np.float32
    )
    tree = gv.N3Tree.from_volume(gv.Volume(ramp), 8, device=DEVICES[backend])
    rays = parallel(15, 6.0, DEVICES[backend], (0.15, 0.1, 1.0))
    cosine = float(rays.direction[0, 2])
    fine = np.linspace(0.4, 0.42, 100001)
    density = -np.log1p(-SHELLS(fine)[:, 3]) / 0.1
    alpha = -np.expm1(-density.mean() * 0.02 / (slope * cosine))
    # There is hardly any absorption outside of the shell, so all of its light arrives.
    expected = alpha * np.array([1, 0.5, 0.1])
    smooth = shoot(tree, rays, gv.PreIntegrated(SHELLS), backend, step=1.0, stop_alpha=1.0)
    plain = shoot(tree, rays, SHELLS, backend, step=1.0, stop_alpha=1.0)
    error = np.abs(smooth["color"] - expected).max()
    alias = np.abs(plain["color"] - expected).max()
    print(f"pre-integrated off by {error:.4f}, plain by {alias:.2f}")
    assert error < 0.02 and alias > 0.5
    finest = 0.02 if backend == "reference" else 0.004  # the twin takes its time
    middle = (0.41 / slope - rays.origin[:, 2]) / cosine  # there are the shells
    near = torch.stack((middle - 2, middle + 2), 1)
    finer = shoot(tree, replace(rays, range=near), SHELLS, backend, step=finest, stop_alpha=1.0)
    assert np.abs(finer["color"] - expected).max() < 0.02


def test_an_interval_that_leaves_the_table_counts_its_parts(backend):
    """A shell that takes a small part of an interval has the alpha of that part, and values beyond
    the function's end points have that of the rest.
    """
    slope = 0.3
    ramp = (np.arange(24, dtype=np.float32) * slope)[:, None, None] * np.ones(
        (1, 40, 40), np.float32
    )
    tree = gv.N3Tree.from_volume(gv.Volume(ramp), 8, device=DEVICES[backend])
    rays = parallel(9, 5.0, DEVICES[backend], (0, 0.0, 1.0))
    for behind in (0.0, 0.05):
        points = [(3.0, 0), (3.001, 0.9), (3.019, 0.9), (3.02, behind)]
        shell = gv.TransferFunction.from_points(points, [(3.0, 1, 0.5, 0.1)])
        density = -np.log1p(-shell(np.linspace(3.0, 3.02, 100001))[:, 3]).mean()
        rest = -np.log1p(-behind) * (23.5 - 3.02 / slope)
        expected = -np.expm1(-density * 0.02 / slope - rest)
        for step in (1.0, 2.0):
            hits = shoot(tree, rays, gv.PreIntegrated(shell), backend, step=step, stop_alpha=1.0)
            assert np.abs(hits["alpha"] - expected).max() < 3e-3
            assert np.abs(hits["color"][:, 1] - 0.5 * expected).max() < 3e-3


def test_pre_integration_on_a_step_function(backend):
    """Opaque red above 0.5, clear below: along a ramp, alpha has a closed form."""
    step = gv.TransferFunction.from_points(
        [(0, 0), (0.5, 0), (0.5001, 0.2), (1, 0.2)], [(0, 1, 0, 0)]
    )
    slope = 0.04
    ramp = (np.arange(25, dtype=np.float32) * slope)[:, None, None] * np.ones(
        (1, 40, 40), np.float32
    )
    tree = gv.N3Tree.from_volume(gv.Volume(ramp), 8, device=DEVICES[backend])
    rays = parallel(9, 5.0, DEVICES[backend], (0, 0.0, 1.0))
    depth = 24.5 - 0.5 / slope  # from where the value is 0.5 to the far face
    expected = 1 - 0.8**depth
    for length in (0.5, 1.0, 2.0, 3.0):
        hits = shoot(tree, rays, gv.PreIntegrated(step), backend, step=length, stop_alpha=1.0)
        assert np.abs(hits["alpha"] - expected).max() < 5e-3, length


@pytest.mark.parametrize("kind", ["maximum", "minimum", "mean"])
def test_projections_of_a_known_volume(backend, kind):
    """A trilinear ramp with one bright and one dark plane across the rays."""
    values = np.full((24, 20, 20), 0.5, np.float32)
    values[9:12], values[16:19] = 0.9, 0.1
    tree = gv.N3Tree.from_volume(gv.Volume(values), 4, device=DEVICES[backend])
    rays = parallel(7, 4.0, DEVICES[backend], (0, 0.0, 1.0))
    transfer = gv.TransferFunction.from_points([(0, 0)], [(0, 0, 0, 0), (1, 1, 0.5, 0.25)])
    hits = shoot(tree, rays, gv.Projection(kind, transfer), backend, step=0.25)
    expected = {"maximum": 0.9, "minimum": 0.1, "mean": 0.5}[kind]  # 3 planes up, 3 down
    assert np.abs(hits["features"] - expected).max() < 1e-5
    assert np.abs(hits["color"] - expected * np.array([1, 0.5, 0.25])).max() < 1e-4
    assert (hits["alpha"] == 1).all()
    near = float(CENTRE[2]) - 60
    z_range = {"maximum": (9, 11), "minimum": (16, 18), "mean": (-0.5, -0.5)}[kind]
    z = hits["depth"] + near
    assert (z >= z_range[0] - 1e-3).all() and (z <= z_range[1] + 1e-3).all()


def test_a_mean_counts_empty_regions(backend):
    values = np.zeros((32, 20, 20), np.float32)
    values[:8] = 1.0
    tree = gv.N3Tree.from_volume(gv.Volume(values), 4, threshold=0.0, device=DEVICES[backend])
    rays = parallel(5, 3.0, DEVICES[backend], (0, 0.0, 1.0))
    hits = shoot(tree, rays, gv.Projection("mean", WHITE), backend, step=0.25)
    assert np.abs(hits["features"] - 0.25).max() < 2e-3


def test_stored_colour_of_a_slab(backend):
    """Opacity a per reference length over a length L lets (1 - a)^(L / reference) through."""
    values = np.zeros((24, 20, 20, 4), np.uint8)
    values[...] = (255, 128, 0, 51)
    tree = gv.N3Tree.from_volume(gv.Volume(values), 4, device=DEVICES[backend])
    rays = parallel(5, 3.0, DEVICES[backend], (0.1, 0.2, 1.0))
    length = 24 / float(rays.direction[0, 2])
    alpha = 1 - 0.8 ** (length / 2.5)
    hits = shoot(tree, rays, gv.StoredColor("value", reference=2.5), backend, stop_alpha=1.0)
    assert np.abs(hits["alpha"] - alpha).max() < 1e-4
    assert np.abs(hits["color"] - alpha * np.array([1, 128 / 255, 0])).max() < 1e-4
    values[...] = (51, 26, 0, 51)
    tree = gv.N3Tree.from_volume(gv.Volume(values), 4, device=DEVICES[backend])
    shader = gv.StoredColor("value", reference=2.5, premultiplied=True)
    hits = shoot(tree, rays, shader, backend, stop_alpha=1.0)
    assert np.abs(hits["color"] - alpha * np.array([1, 26 / 51, 0])).max() < 1e-4


@pytest.mark.parametrize("count", [1, 5, 70])
def test_features_are_composited_like_colours(backend, count):
    """A feature that holds what the colour holds gives the colour."""
    rng = np.random.default_rng(3)
    density = rng.random((20, 24, 24)).astype(np.float32)
    weights = np.linspace(1, 0.1, count)
    more = (density[..., None] * weights).astype(np.float32)
    channels = {"value": gv.Volume(density), "f": gv.Volume(more)}
    tree = gv.N3Tree.from_volume(channels, 4, device=DEVICES[backend])
    gray = gv.TransferFunction.from_points([(0, 0), (1, 0.2)], [(0, 0, 0, 0), (1, 1, 1, 1)])
    rays = parallel(7, 6.0, DEVICES[backend])
    hits = shoot(tree, rays, gv.Features(gray, "f"), backend)
    assert hits["features"].shape == (len(rays.origin), count)
    assert np.abs(hits["features"] - hits["color"][:, :1] * weights).max() < 1e-4
    assert hits["features"].max() > 0.2


def test_parameters_read_back_as_they_were_packed():
    level = torch.tensor(0.25)
    parameters = ShadeParameters(
        (1.0, 2.0, 3.0), LightKind.POINT, (4.0, 5.0, 6.0), 7.0, 8.0, 9.0, 10.0, 11.0,
        own=IsosurfaceNumbers(level), normal_scale=2.0, normal_offset=-1.0,
    )  # fmt: skip
    packed = parameters.pack(torch.float64, torch.device("cpu"))
    assert packed.tolist() == [
        [1, 2, 3, LightKind.POINT], [4, 5, 6, 7], [8, 9, 10, 11], [0.25, 1, 0, 0], [2, -1, 0, 0],
    ]  # fmt: skip
    read = ShadeParameters.read(packed)
    assert read.own_as(IsosurfaceNumbers) == IsosurfaceNumbers(level)
    assert torch.equal(read.pack(torch.float64, torch.device("cpu")), packed)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 3.0])
def test_gradient_magnitude_scales_the_optical_depth_of_a_ramp(backend, share):
    ramp = np.broadcast_to(0.01 * np.arange(32, dtype=np.float32), (8, 8, 32))
    data = ramp.copy() if share else np.full((8, 8, 32), 0.5, np.float32)
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4, device=DEVICES[backend])
    transfer = gv.TransferFunction.from_points([(-1, 0.3), (1, 0.3)], reference=10)
    shader = gv.GradientMagnitude(transfer, 0.01 / share if share else None)
    rays = gv.Rays(
        origin=torch.tensor([[10.0, 3.7, -5.0]], dtype=torch.float64),
        direction=torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
        cone=torch.zeros(1, 2, dtype=torch.float64),
        range=torch.tensor([[0.0, torch.inf]], dtype=torch.float64),
    )
    hits = shoot(tree, rays.to(DEVICES[backend]), shader, backend, stop_alpha=1.0)
    expected = 1 - (1 - 0.3) ** (8 / 10 * min(share, 1.0))
    assert abs(float(hits["alpha"][0, 0]) - expected) < 2e-5


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (LitShader, LightSettings),
        (gv.Isosurface, SurfaceSettings),
        (Fractal, FractalSettings),
    ],
)
def test_keywords_that_classes_pass_on_are_those_of_their_base(kind, settings):
    hints = get_type_hints(kind.__init__)
    parameters = inspect.signature(kind.__init__).parameters.values()
    own = {p.name: hints[p.name] for p in parameters if p.kind is p.KEYWORD_ONLY}
    inherited = get_type_hints(LightSettings) if kind is gv.Isosurface else {}
    assert get_type_hints(settings) == own | inherited
