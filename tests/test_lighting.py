"""Shadows, occlusion and indirect light by cones, against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.rays import rays_along
from helpers.shading import MATT, ball, grid, parallel, phong, sphere

import gvtorch as gv

SKY = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0}
FLOOR, SIZE = 8.0, 64


def places(size: int = SIZE) -> np.ndarray:
    """Returns x, y, z of the voxels of a cube."""
    return np.moveaxis(grid((size,) * 3), -1, 0)


def tree_of(distance: np.ndarray, backend: str) -> gv.N3Tree:
    return gv.N3Tree.from_volume(gv.Volume(distance.astype(np.float32)), device=DEVICES[backend])


def down(x, height: float, z, device: str, width: float = 0.5) -> gv.Rays:
    """Returns rays down from a height at positions (x, z)."""
    x, z = np.broadcast_arrays(np.asarray(x, float), z)
    origin = torch.tensor(np.stack((x, np.full_like(x, height), z), -1))
    return rays_along(origin, [0.0, -1.0, 0.0], width, device)


def light_on(tree, rays, shader, backend, *, plain=None, **lighting) -> np.ndarray:
    """Returns the lit colours (r, 3) of rays."""
    options = {"backend": backend, "lighting": gv.Lighting(**lighting), **(plain or {})}
    return gv.trace(tree, rays, shader, **options).color.cpu().double().numpy()


@pytest.fixture
def backend(compiled: str) -> str:
    """Compiled backends only: the twin, which equals them (test_lighting_frames.py), is slow."""
    return compiled


# --- the material


@pytest.mark.parametrize("kind", ["head", "directional", "point"])
def test_phong_on_a_sphere(backend, kind):
    tree = ball(backend)
    rays = parallel(15, 9.0, DEVICES[backend])
    t, normal = sphere(rays)
    eye = -rays.direction.cpu().numpy()
    points = rays.origin.cpu().numpy() - t[:, None] * eye
    tint = (1.0, 0.8, 0.5)
    light, to_light = {
        "head": (gv.Headlight(tint), eye),
        "directional": (gv.DirectionalLight((2, -1, 2), tint), np.array([[-2, 1, -2]]) / 3),
        "point": (gv.PointLight((0.0, 40.0, -20.0), tint), np.array([[0.0, 40.0, -20.0]]) - points),
    }[kind]
    to_light = to_light / np.linalg.norm(to_light, axis=1, keepdims=True) + 0 * normal
    shading = {"ambient": 0.1, "diffuse": 0.7, "specular": 0.4, "shininess": 12.0}
    base = np.array([0.9, 0.5, 0.3])
    shader = gv.DistanceField(tuple(base), **shading)
    color = light_on(tree, rays, shader, backend, lights=(light,), ambient=(1.0, 0.5, 0.2))
    expected = phong(normal, to_light, eye, base, np.array(tint), **shading)
    expected += base * 0.1 * (np.array([1.0, 0.5, 0.2]) - 1)  # the sky's colour
    assert expected.max() - expected.min() > 0.4
    assert np.abs(color - expected).max() < 0.03, "a convex body casts no shadow on its lit side"


def test_without_cones_it_is_the_shader_s_own_light(blobs, backend):
    light = gv.PointLight((0.0, 40.0, 60.0), (1.0, 0.9, 0.8), radius=5.0)
    camera = gv.Camera.orbit(width=16, height=16, distance=1.3)
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[backend])
    for shader in (
        gv.Isosurface(0.5, (0.9, 0.4, 0.2), light=light, shininess=9.0),
        gv.Isosurface(0.5, light=gv.Headlight(), specular=0.0),
    ):
        plain = gv.render(tree, camera, shader, backend=backend)
        for lighting in (gv.Lighting(shadows=0), gv.Lighting(shadows=0, lights=(shader.light,))):
            same = gv.render(tree, camera, shader, backend=backend, lighting=lighting)
            torch.testing.assert_close(same.color, plain.color, rtol=0, atol=2e-5)
            assert torch.equal(same.depth, plain.depth) and torch.equal(same.normal, plain.normal)
        both = gv.Lighting(shadows=0, lights=(shader.light, shader.light), ambient=(0, 0, 0))
        bright = gv.render(tree, camera, shader, backend=backend, lighting=both).color
        dark = gv.render(
            *(tree, camera, shader),
            backend=backend,
            lighting=dataclasses.replace(both, lights=(shader.light,)),
        ).color
        torch.testing.assert_close(bright, 2 * dark, rtol=0, atol=1e-5)
    assert plain.alpha.max() == 1


def test_a_ray_that_begins_behind_something_has_its_share_of_the_light(backend):
    rays = parallel(7, 9.0, DEVICES[backend])
    quarter = torch.full((len(rays.origin),), 0.25).to(rays.origin)
    shader = gv.DistanceField(light=gv.DirectionalLight((0.3, -0.5, 1)))
    whole, part = (
        light_on(ball(backend), some, shader, backend)
        for some in (rays, dataclasses.replace(rays, transmittance=quarter))
    )
    np.testing.assert_allclose(part, 0.25 * whole, atol=1e-6)


def test_translucent_matter_is_lit_where_it_is_seen(blobs, backend):
    """Where colour and gradient are constant along a ray, lighting per sample and pixel agree."""
    ramp = np.linspace(0, 1, 24, dtype=np.float32)[:, None, None] * np.ones((1, 20, 20), np.float32)
    tree = gv.N3Tree.from_volume(gv.Volume(ramp), 4, device=DEVICES[backend])
    transfer = gv.TransferFunction.from_points([(0, 0), (1, 0.3)], [(0, 0.9, 0.6, 0.3)])
    shader = gv.Lit(transfer, light=gv.DirectionalLight((0.3, -0.5, 1)), shininess=7.0)
    camera = gv.Camera.orbit(175, 10, 1.6, 20, 12, 12)
    expected = gv.render(tree, camera, shader, backend=backend)
    same = gv.render(tree, camera, shader, backend=backend, lighting=gv.Lighting(shadows=0))
    assert expected.alpha.max() > 0.8
    torch.testing.assert_close(same.color, expected.color, rtol=0, atol=2e-3)


# --- shadows


CENTRE, RADIUS = np.array([32.0, 40.0, 32.0]), 9.0


def over_floor(
    backend: str, kind: str = "distance", centre: np.ndarray = CENTRE, radius: float = RADIUS
) -> tuple[gv.N3Tree, gv.Shader]:
    """A ball over a floor."""
    x, y, z = places()
    body = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) - radius
    distance = np.minimum(body, y - FLOOR)
    if kind == "distance":
        return tree_of(distance, backend), gv.DistanceField((1, 1, 1), **MATT)
    share = np.clip(0.5 - distance / 2, 0, 1)
    if kind == "density":
        return tree_of(share, backend), gv.Isosurface(0.5, (1, 1, 1), **MATT)
    solid = gv.TransferFunction.from_points([(0, 0), (0.4, 0), (0.6, 0.9), (1, 0.9)])
    return tree_of(share, backend), gv.Lit(solid, **MATT)


def sun_seen(
    points: np.ndarray, targets: np.ndarray, centre: np.ndarray = CENTRE, radius: float = RADIUS
) -> np.ndarray:
    """Returns (p,): share of unit directions (p, m, 3) from points that the ball does not block."""
    away = points - centre
    b = (targets * away[:, None]).sum(-1)
    c = (away**2).sum(-1)[:, None] - radius**2
    return 1 - ((b**2 > c) & (b < 0)).mean(1)


def disc(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    number = np.arange(count)
    radius, turn = np.sqrt((number + 0.5) / count), number * np.pi * (3 - np.sqrt(5))
    return radius * np.cos(turn), radius * np.sin(turn)


def shadow_of(light, x: np.ndarray, *body) -> np.ndarray:
    """Returns the visible share of a light right above the ball, from (x, FLOOR, 32)."""
    points = np.stack((x, np.full_like(x, FLOOR), np.full_like(x, 32.0)), -1)
    u, v = disc()
    if isinstance(light, gv.DirectionalLight):
        half = math.tan(math.radians(light.angle) / 2)
        directions = np.stack((u * half, np.ones_like(u), v * half), -1)[None].repeat(len(x), 0)
    else:
        beam = np.array(light.position) - points
        axis = beam / np.linalg.norm(beam, axis=1, keepdims=True)
        side = np.cross(axis, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        up = np.cross(axis, side)
        spread = u[None, :, None] * side[:, None] + v[None, :, None] * up[:, None]
        directions = beam[:, None] + light.radius * spread
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return sun_seen(points, directions, *body)


def crossing(x: np.ndarray, seen: np.ndarray, share: float) -> float:
    """Returns the x, interpolated, from which on more than a share of the light is visible."""
    last = int(np.nonzero(seen < share)[0].max())
    a, b = seen[last], seen[last + 1]
    return float(x[last] + (share - a) / (b - a) * (x[last + 1] - x[last]))


LIGHTS = {
    "small sun": gv.DirectionalLight((0, -1, 0), angle=4.0),
    "sun": gv.DirectionalLight((0, -1, 0), angle=10.0),
    "lamp": gv.PointLight((32.0, 120.0, 32.0), radius=6.0),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_umbra_and_penumbra_of_a_ball(backend, name):
    """Where 10%, 50% and 90% of the light arrive, to less than a voxel. What one cone grazes is
    estimated, see `solid.py`; 16 narrow cones for the same disc give the same edges.
    """
    tree, shader = over_floor(backend)
    light, x = LIGHTS[name], np.linspace(32, 56, 97)
    expected = shadow_of(light, x)
    rays = down(x, FLOOR + 8, 32.0, DEVICES[backend])
    for cones, max_error, mean in ((1, 0.7, 0.055), (16, 0.45, 0.045)):
        options = {"lights": (light,), "shadow_cones": cones}
        seen = light_on(tree, rays, shader, backend, **options)[:, 0]
        to_light = np.array(getattr(light, "position", (0, 1e6, 0))) - np.stack(
            (x, np.full_like(x, FLOOR), np.full_like(x, 32.0)), -1
        )
        seen = seen / (to_light[:, 1] / np.linalg.norm(to_light, axis=1))
        wrong = [crossing(x, seen, s) - crossing(x, expected, s) for s in (0.1, 0.5, 0.9)]
        error = float(np.sqrt(((seen - expected) ** 2).mean()))
        print(f"{name}, {cones} cones: {np.round(wrong, 2)} voxels, rms {error:.3f}")
        assert np.abs(wrong).max() < max_error and error < mean
        assert seen[0] < 0.01 and seen[-1] > 0.99


def test_a_wide_sun_behind_a_ball(backend):
    """The sun is 20 degrees wide; the ball has a radius of 12 and is 40 above the floor."""
    body, x = (np.array([32.0, FLOOR + 40, 32.0]), 12.0), np.linspace(32, 60, 113)
    tree, shader = over_floor(backend, "distance", *body)
    light = gv.DirectionalLight((0, -1, 0), angle=20.0)
    expected = shadow_of(light, x, *body)
    assert expected[0] < 0.01 and 0.3 < expected[48] < 0.7 and expected[-1] > 0.97
    rays = down(x, FLOOR + 8, 32.0, DEVICES[backend])
    for cones, max_error in ((1, 0.06), (16, 0.04)):
        seen = light_on(tree, rays, shader, backend, lights=(light,), shadow_cones=cones)[:, 0]
        error = float(np.sqrt(((seen - expected) ** 2).mean()))
        print(f"{cones} cones: rms {error:.3f}")
        assert error < max_error


@pytest.mark.parametrize("degrees", [60.0, 45.0, 30.0])
def test_a_low_sun_casts_its_shadow_where_it_should(backend, degrees):
    """Cones begin above the visible point, but in the direction of the sun: the shadow is right to
    half a voxel, seen from the sun.
    """
    sine, cosine = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    x, y, z = places()
    centre = np.array([40.0 - 16 * cosine / sine, FLOOR + 16, 32.0])  # its shadow's is at x = 40
    body = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) - RADIUS
    tree = tree_of(np.minimum(body, y - FLOOR), backend)
    light = gv.DirectionalLight((cosine, -sine, 0), angle=4.0)
    u, v = (part * math.tan(math.radians(light.angle) / 2) for part in disc())
    directions = np.stack((-cosine + sine * u, sine + cosine * u, v), -1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    xs = np.linspace(40, 62, 177)
    floor = np.stack((xs, np.full_like(xs, FLOOR), np.full_like(xs, 32.0)), -1)
    expected = sun_seen(floor, directions[None].repeat(len(xs), 0), centre)
    rays, shader = down(xs, FLOOR + 3, 32.0, DEVICES[backend]), gv.DistanceField((1, 1, 1), **MATT)
    seen = light_on(tree, rays, shader, backend, lights=(light,))[:, 0] / sine
    wrong = sine * (crossing(xs, seen, 0.5) - crossing(xs, expected, 0.5))
    print(f"{degrees} degrees: {wrong:.2f} voxels")
    assert abs(wrong) < 0.5


@pytest.mark.parametrize("length", [1e-30, 1e-13, 1e30])
def test_a_sun_s_direction_may_have_any_length(backend, length):
    tree, shader = over_floor(backend)
    rays = down([32.0, 58.0], FLOOR + 8, 32.0, DEVICES[backend])
    color = light_on(tree, rays, shader, backend, lights=(gv.DirectionalLight((0, -length, 0)),))
    np.testing.assert_allclose(color[:, 0], [0, 1], atol=1e-3)


@pytest.mark.parametrize("kind", ["distance", "density", "lit"])
@pytest.mark.parametrize("far", [False, True])
def test_a_light_without_a_size_casts_a_hard_shadow(backend, kind, far):
    tree, shader = over_floor(backend, kind)
    x = np.linspace(32, 60, 113)
    light = gv.DirectionalLight((0, -1, 0)) if far else gv.PointLight((32.0, 120.0, 32.0))
    edge = RADIUS if far else 112 * math.tan(math.asin(RADIUS / 80))
    color = light_on(
        tree, down(x, FLOOR + 8, 32.0, DEVICES[backend]), shader, backend, lights=(light,)
    )[:, 0]
    dark, bright = color[x < 32 + edge - 1.5], color[x > 32 + edge + 1.5]
    assert len(dark) > 25 and len(bright) > 10
    assert dark.max() < 0.01 and bright.min() > 0.5
    facing = 1 if far else 112 / np.hypot(112, x[x > 32 + edge + 1.5] - 32)
    assert np.abs(bright - facing).max() < 0.03


@pytest.mark.parametrize("width", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("gap", [1.0, 4.0])
def test_a_lamp_below_a_ceiling_is_not_in_its_shadow(backend, width, gap):
    """A cone begins above the visible point, but ends at the lamp."""
    _, y, _ = places()
    distance, lamp = np.minimum(y - FLOOR, 50 - y), (32.0, 50 - gap, 32.0)
    x = np.array([32.0, 36.0, 44.0])
    rays = down(x, FLOOR + 12, 32.0, DEVICES[backend], width)
    for tree, shader in (
        (tree_of(distance, backend), gv.DistanceField((1, 1, 1), **MATT)),
        (
            tree_of(np.clip(0.5 - distance / 2, 0, 1), backend),
            gv.Isosurface(0.5, (1, 1, 1), **MATT),
        ),
    ):
        color = light_on(tree, rays, shader, backend, lights=(gv.PointLight(lamp),))[:, 0]
        facing = (lamp[1] - FLOOR) / np.hypot(lamp[1] - FLOOR, x - lamp[0])
        np.testing.assert_allclose(color, facing, atol=0.06)


def test_shadows_are_as_strong_as_they_are_told(backend):
    tree, shader = over_floor(backend)
    rays = down([32.0, 58.0], FLOOR + 8, 32.0, DEVICES[backend])
    light = {"lights": (gv.DirectionalLight((0, -1, 0)),)}
    for strength in (0.0, 0.4, 1.0):
        color = light_on(tree, rays, shader, backend, shadows=strength, **light)
        np.testing.assert_allclose(color[:, 0], [1 - strength, 1], atol=1e-3)


def test_a_thin_medium_absorbs_what_it_should(backend):
    """A cloud of opacity a per unit, h thick over an opaque floor, lets (1 - a)^h of the light
    through, whatever the light's size.
    """
    _, y, _ = places(32)
    value = np.where(y < 6, 1.0, np.where((y > 14) & (y < 22), 0.5, 0.0))
    transfer = gv.TransferFunction.from_points([(0, 0), (0.5, 0.1), (0.9, 0.1), (1, 1)])
    tree = tree_of(value, backend)
    rays = down(np.linspace(13, 18, 5), 12.0, 16.0, DEVICES[backend])
    for angle in (0.0, 8.0):
        light = gv.DirectionalLight((0, -1, 0), angle=angle)
        color = light_on(tree, rays, gv.Lit(transfer, **MATT), backend, lights=(light,))
        np.testing.assert_allclose(color, 0.9**7, atol=0.02)  # voxels 15 to 21


def test_what_is_clipped_away_casts_no_shadow(backend):
    tree, shader = over_floor(backend)
    rays = down([32.0, 34.0], FLOOR + 8, 32.0, DEVICES[backend])
    for clip, seen in (
        (gv.Clip(planes=[(0, -1, 0, 20.0)]), 1.0),
        (gv.Clip(without=[((20, 25, 20), (45, 60, 45))]), 1.0),
        (gv.Clip(planes=[(0, -1, 0, 40.0)]), 0.0),
    ):
        color = light_on(
            *(tree, rays, shader, backend),
            plain={"clip": clip},
            lights=(gv.DirectionalLight((0, -1, 0)),),
        )
        np.testing.assert_allclose(color, seen, atol=1e-3)


def test_a_cap_stands_in_the_light_alone(backend):
    """A sloping cut through a floor, seen from above, faces the sun, or turns away from it."""
    tree, shader = over_floor(backend, "density")
    slope = math.radians(50)
    normal = (math.sin(slope), math.cos(slope), 0.0)
    plane = (-normal[0], -normal[1], 0.0, 5 * normal[1] + 32 * normal[0])
    rays = down([34.0, 36.0], 60.0, 32.0, DEVICES[backend])
    for sun, expected in ((normal, 1.0), ((0.0, 1.0, 0.0), normal[1]), ((-1.0, 0.1, 0.0), 0.0)):
        light = gv.DirectionalLight(tuple(-n for n in sun))
        clip = gv.Clip(planes=[plane], caps=True)
        options = {"lights": (light,), "plain": {"clip": clip}}
        np.testing.assert_allclose(
            light_on(tree, rays, shader, backend, **options), expected, atol=0.02
        )


def test_a_lamp_inside_matter_lights_nothing(backend):
    tree, shader = over_floor(backend)
    rays = down([20.0, 32.0, 50.0], FLOOR + 8, 32.0, DEVICES[backend])
    inside = gv.PointLight(tuple(CENTRE))
    assert np.abs(light_on(tree, rays, shader, backend, lights=(inside,))).max() < 1e-3
    at_the_place = gv.PointLight((20.0, FLOOR, 32.0))
    assert np.isfinite(light_on(tree, rays, shader, backend, lights=(at_the_place,))).all()


# --- light from all around


def segment(height: np.ndarray) -> np.ndarray:
    """Returns the part of the unit disc beyond a chord: what a wall blocks of a cosine-weighted
    hemisphere, counting directions that reach it within 1 (Nusselt's analogue).
    """
    s = np.clip(height, -1, 1)
    return (np.arccos(s) - s * np.sqrt(1 - s * s)) / np.pi


def open_sky(x: np.ndarray, z: np.ndarray | None, reach: float) -> np.ndarray:
    """Returns (p,): the share of the sky seen from a floor, x off one wall and z off another; walls
    beyond half of the reach block half.
    """
    seen = np.zeros(len(x))
    u, v = disc(100_000)
    for far in (reach / 2, reach):
        blocked = u[None] >= x[:, None] / far
        if z is not None:
            blocked |= v[None] >= z[:, None] / far
        else:
            np.testing.assert_allclose(blocked.mean(1), segment(x / far), atol=1e-3)
        seen += (1 - blocked.mean(1)) / 2
    return seen


def corner(walls: int, backend: str, kind: str = "distance") -> tuple[gv.N3Tree, gv.Shader]:
    """Returns a floor with one wall or two on it, and its shader."""
    x, y, z = places()
    distance = y - FLOOR
    for axis in (x, z)[:walls]:
        distance = np.minimum(distance, axis - FLOOR)
    if kind == "distance":
        return tree_of(distance, backend), gv.DistanceField((1, 1, 1), **SKY)
    tree = tree_of(np.clip(0.5 - distance, 0, 1), backend)
    if kind == "density":
        return tree, gv.Isosurface(0.5, (1, 1, 1), **SKY)
    opaque = gv.TransferFunction.from_points([(0.3, 0), (0.6, 0.9)])
    return tree, gv.Lit(opaque, **SKY)


@pytest.mark.parametrize("kind", ["distance", "density", "medium"])
@pytest.mark.parametrize("walls", [0, 1, 2])
def test_occlusion_at_an_edge_and_in_a_corner(backend, kind, walls):
    """An edge leaves 1/2 of the sky, a corner of three planes 1/4. Sixteen cones sample all
    directions, and each meets a wall or does not: they are right to 0.07 next to one wall, to 0.1
    next to two. A floor alone is not darkened.
    """
    tree, shader = corner(walls, backend, kind)
    reach, away = 16.0, np.array([1.6, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 13.0, 18.0, 24.0])
    x = FLOOR + away if walls else np.full_like(away, 40.0)
    z = FLOOR + away if walls > 1 else np.full_like(away, 40.0)
    rays = down(x, FLOOR + 20, z, DEVICES[backend])
    whole = {"plain": {"stop_alpha": 1.0}, "reach": reach}
    seen = light_on(tree, rays, shader, backend, occlusion=1, **whole)[:, 0]
    expected = np.ones_like(away)
    if walls:
        expected = open_sky(away, away if walls > 1 else None, reach)
    print(f"{kind}, {walls} walls: {np.round(seen, 2)}, expected {np.round(expected, 2)}")
    assert np.abs(seen - expected).max() < (1e-4, 0.07, 0.1)[walls]
    assert np.sqrt(((seen - expected) ** 2).mean()) < (1e-4, 0.04, 0.06)[walls]
    if walls:
        limit = (None, 0.5, 0.25)[walls]
        assert (
            abs(open_sky(np.array([1e-6]), np.array([1e-6]) if walls > 1 else None, 1.0)[0] - limit)
            < 1e-3
        )
        assert seen[-1] > 0.985 and (np.diff(seen) > -0.05).all()
    half = light_on(tree, rays, shader, backend, occlusion=0.5, **whole)[:, 0]
    np.testing.assert_allclose(half, (1 + seen) / 2, atol=1e-5)


def test_a_lit_wall_shines_on_the_floor(backend):
    """A wall under a light that shines along (-1, -1, 0) sends albedo * cos 45 * its share of the
    hemisphere, here from within the reach.
    """
    tree, _ = corner(1, backend)
    base, away = np.array([0.8, 0.4, 0.2]), np.array([2.0, 3.0, 4.0, 6.0, 9.0, 14.0, 20.0, 30.0])
    shader = gv.DistanceField(tuple(base), **MATT)
    rays = down(FLOOR + away, FLOOR + 20, 32.0, DEVICES[backend])
    light = {"lights": (gv.DirectionalLight((-1, -1, 0)),), "reach": 24.0}
    direct = light_on(tree, rays, shader, backend, **light)
    both = light_on(tree, rays, shader, backend, indirect=1, **light)
    np.testing.assert_allclose(direct, base * math.sqrt(0.5) + 0 * both, atol=0.01)
    bounced = both - direct
    expected = base**2 * math.sqrt(0.5) * segment(away / 24.0)[:, None]
    print(np.round(bounced[:, 0], 3), np.round(expected[:, 0], 3))
    assert np.abs(bounced - expected).max() < 0.04, "of 0.2: a cone meets the wall or not"
    assert bounced[0, 0] > 0.1 and abs(bounced[-1, 0]) < 1e-6
    np.testing.assert_allclose(bounced[:4, 1] / bounced[:4, 0], 0.25, atol=0.01)
    twice = light_on(tree, rays, shader, backend, indirect=2, **light) - direct
    np.testing.assert_allclose(twice, 2 * bounced, atol=1e-5)
    away_from_it = {**light, "lights": (gv.DirectionalLight((1, -1, 0)),)}
    dark = light_on(tree, rays, shader, backend, indirect=1, **away_from_it)
    plain = light_on(tree, rays, shader, backend, **away_from_it)
    np.testing.assert_allclose(dark, plain, atol=1e-3)  # the wall's own side is in shadow


def test_a_headlight_bounces_as_a_lamp_at_the_eye(backend):
    """Also where a ball stands between the eye and the wall."""
    x, y, z = places()
    ball = np.sqrt((x - 16) ** 2 + (y - 18) ** 2 + (z - 32) ** 2) - 4
    wall = tree_of(np.minimum(np.minimum(x, y) - FLOOR, ball), backend)
    shader = gv.DistanceField((0.8, 0.8, 0.8), **MATT)
    eye = np.array([40.0, 30.0, 32.0])
    rays = down(FLOOR + np.array([2.0, 4.0, 8.0, 14.0]), 30.0, 32.0, DEVICES[backend])
    direction = rays.origin.cpu().numpy() * [1, 0, 1] + [0, FLOOR, 0] - eye
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin, direction = (torch.tensor(v + 0 * direction).to(rays.origin) for v in (eye, direction))
    rays = dataclasses.replace(rays, origin=origin, direction=direction)
    headlight, lamp = (
        [
            light_on(tree, rays, shader, backend, lights=(light,), reach=24.0, indirect=factor)
            for tree in (corner(1, backend)[0], wall)
            for factor in (0.0, 1.0)
        ]
        for light in (gv.Headlight(), gv.PointLight(tuple(eye)))
    )
    np.testing.assert_allclose(headlight[1], lamp[1], atol=1e-6)
    bare, blocked = headlight[1] - headlight[0], headlight[3] - headlight[2]
    print(np.round((bare[:, 0], blocked[:, 0]), 3))
    assert bare.min() > 0.05 and (blocked[:2] < 0.8 * bare[:2]).all()


def test_a_white_floor_turns_red_beside_a_red_wall(backend):
    x, y, z = places(48)
    alpha = np.clip(0.5 - np.minimum(x, y - 0.0 * z) / 2 + 4, 0, 1)
    red = x < y
    color = np.where(red[..., None], (0.9, 0.1, 0.1), (0.9, 0.9, 0.9))
    volume = gv.Volume(
        np.concatenate((color * alpha[..., None], alpha[..., None]), -1).astype(np.float32)
    )
    tree = gv.N3Tree.from_volume({"rgba": volume}, device=DEVICES[backend])
    shader = gv.StoredColor("rgba", premultiplied=True, **MATT)
    away = np.array([4.0, 7.0, 11.0, 18.0])
    rays = down(8 + away, 30.0, 24.0, DEVICES[backend])
    lights = (gv.DirectionalLight((-1, -1, 0)),)
    color = light_on(tree, rays, shader, backend, lights=lights, indirect=1, reach=20.0)
    ratio = color[:, 0] / color[:, 1]
    assert ratio[0] > 1.1 and (np.diff(ratio) < 0).all() and ratio[-1] < ratio[0] - 0.08
    assert color.max() < 0.9 * (math.sqrt(0.5) + 0.9 * 0.5), "no more light than comes in"
    plain = light_on(tree, rays, shader, backend, lights=lights)
    assert (color >= plain - 1e-6).all()
    np.testing.assert_allclose(plain[:, 0], plain[:, 1], atol=0.02)
