"""The Mandelbulb from nearby: pictures of a tree of 2^33 voxels a side, compared with its formula,
stepped along each ray in NumPy, in float64.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import resident_bytes

import gvtorch as gv

BOX, STEPS = 2.4, 16
WAY = np.array([0.5, 0.32, 0.81])


def gap(points: np.ndarray) -> np.ndarray:
    """Returns distance estimates (...,) of points (..., 3), 0 inside: z^8 + c by angles."""
    c = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    z, slope = c.copy(), np.ones(c.shape[1:])
    radius = np.sqrt((z * z).sum(0))
    for _ in range(STEPS):
        on = radius <= 2
        theta = 8 * np.arctan2(np.hypot(z[0], z[1]), z[2])
        phi, power = 8 * np.arctan2(z[1], z[0]), radius**8
        turned = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)))
        slope = np.where(on, 8 * radius**7 * slope + 1, slope)
        z = np.where(on, power * turned + c, z)
        radius = np.sqrt((z * z).sum(0))
    outside = 0.5 * radius * np.log(np.maximum(radius, 1)) / slope
    return np.where(radius <= 2, 0.0, outside)


def surface_place() -> np.ndarray:
    """Returns where a line from outside first meets the bulb."""
    outside, inside = 1.3, 0.2
    for _ in range(6):
        along = np.linspace(outside, inside, 2001)
        first = int(np.argmax(gap(along[:, None] * WAY / np.linalg.norm(WAY)) == 0))
        outside, inside = along[first - 1], along[first]
    return outside * WAY / np.linalg.norm(WAY)


def camera(point: np.ndarray, level: int, size: int) -> gv.Camera:
    """Returns a camera 2^-level of the box away from `point`, where there is most room."""
    directions = np.random.default_rng(0).normal(size=(500, 3))
    eyes = point + BOX * 0.5**level * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    eye = eyes[gap(eyes).argmax()]
    return gv.Camera.look_at(tuple(eye), tuple(point), (0, 0, 1), fov=50, width=size, height=size)


def first_below(rays: gv.Rays, share: float, cone: np.ndarray, end: float) -> np.ndarray:
    """Returns the distances (r,) at which rays first come nearer to the bulb than a share of their
    cones, which are `cone` wide per unit of distance; +inf: none before `end`.
    """
    origin, direction = rays.origin.double().numpy(), rays.direction.double().numpy()
    t, distance = np.full(len(origin), 1e-3 * end), np.full(len(origin), np.inf)
    for _ in range(3000):
        open_ = np.isinf(distance) & (t < end)
        if not open_.any():
            break
        near = gap(origin[open_] + t[open_, None] * direction[open_])
        wide = cone[open_] * t[open_]
        hit = near < share * wide
        row = open_.nonzero()[0]
        distance[row[hit]] = t[row[hit]]
        t[row] += np.maximum(0.2 * near, 0.1 * wide)
    return distance


@pytest.fixture(scope="module")
def bulb():
    """An engine with a fixed pool, and a point of the surface."""
    with opened("24 MB") as engine:
        yield engine, surface_place()


def opened(bricks: str) -> gv.Engine:
    """Opens an engine with a fixed pool."""
    solid = gv.Solid(gv.Mandelbulb(8, iterations=STEPS), colors=False)
    producer = gv.FieldProducer(solid, 2**33, box=((-BOX / 2,) * 3, (BOX / 2,) * 3))
    assert producer.dtype == torch.float64
    return gv.Engine(producer, brick_pool=bricks, node_pool="8 MB")


def seen_from_near(engine: gv.Engine, point: np.ndarray, level: int, size: int) -> gv.Picture:
    """Renders a picture, and asserts that the drawn surface lies where estimates fall from a cone's
    width to a fiftieth of it: nothing is in front of that, and no hole is behind.
    """
    scale, view = 2.0, camera(point, level, size)
    picture = engine.render(view, gv.Isosurface(0.25), cone_scale=scale)
    engine.validate()
    assert picture.stats.converged and not picture.stats.failed
    rays = view.rays()
    cone = scale * 4 / 3 * rays.cone[:, 1].double().numpy()
    depth = picture.depth.flatten().double().numpy()
    far = 8 * BOX * 0.5**level
    early, late = (first_below(rays, share, cone, far) for share in (1.0, 0.02))
    seen = np.isfinite(late)
    assert seen.mean() > 0.5 and np.isfinite(depth[seen]).all(), "no holes"
    wide = 2 * cone * np.where(np.isfinite(depth), depth, 0)
    assert (depth > early - wide)[np.isfinite(depth)].all(), "nothing stands in the way"
    error = (depth - late)[seen] / wide[seen]
    assert np.quantile(error, 0.97) < 1, error.max()
    print(
        f"2^-{level}: {seen.mean():.2f} seen, {np.quantile(error, (0, 0.5, 0.97, 1))} cones beside"
    )
    return picture


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("level", [4, 20, 26, 30])
def test_a_picture_from_near_is_that_of_the_formula(bulb, level):
    seen_from_near(*bulb, level, 16)


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_a_flight_through_all_levels_is_that_of_the_formula():
    """From 2^-4 to 2^-30 of the box, with a pool that holds a part of what is seen on the way, and
    constant memory; back at the start, the picture has the same bits as before.
    """
    point, bricks_made = surface_place(), 0
    with opened("2 MB") as engine:
        for level in range(4, 31):
            picture = seen_from_near(engine, point, level, 20)
            bricks_made += picture.stats.produced["bricks"]
            if level == 4:
                first, memory = picture, engine.memory()
            if level == 10:
                resident = resident_bytes()
        assert bricks_made > 2 * engine.cache.bricks.capacity, "the pool was filled anew"
        assert engine.memory() == memory and resident_bytes() - resident < 20e6
        back = seen_from_near(engine, point, 4, 20)
        assert torch.equal(back.depth, first.depth) and torch.equal(back.color, first.color)


@pytest.mark.backend("cpp")
def test_single_and_double_see_the_same_from_near(bulb):
    """No jitter: float32 rays that begin 10^-8 of the box away meet what float64 rays do."""
    engine, point = bulb
    view = camera(point, 27, 16)
    shader = gv.Isosurface(0.25)
    single, double = (
        engine.render(view, shader, cone_scale=2.0, dtype=dtype)
        for dtype in (torch.float32, torch.float64)
    )
    assert torch.equal(torch.isfinite(single.depth), torch.isfinite(double.depth))
    seen = torch.isfinite(double.depth)
    error = (single.depth - double.depth).abs()[seen] / double.depth[seen]
    assert seen.float().mean() > 0.5 and error.double().quantile(0.9) < 1e-4
