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
    z, apart = c.copy(), np.ones(c.shape[1:])
    radius = np.sqrt((z * z).sum(0))
    for _ in range(STEPS):
        on = radius <= 2
        theta = 8 * np.arctan2(np.hypot(z[0], z[1]), z[2])
        phi, power = 8 * np.arctan2(z[1], z[0]), radius**8
        turned = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)))
        apart = np.where(on, 8 * radius**7 * apart + 1, apart)
        z = np.where(on, power * turned + c, z)
        radius = np.sqrt((z * z).sum(0))
    outside = 0.5 * radius * np.log(np.maximum(radius, 1)) / apart
    return np.where(radius <= 2, 0.0, outside)


def surface_place() -> np.ndarray:
    """Returns where a line from outside first meets the bulb."""
    outside, inside = 1.3, 0.2
    for _ in range(6):
        along = np.linspace(outside, inside, 2001)
        first = int(np.argmax(gap(along[:, None] * WAY / np.linalg.norm(WAY)) == 0))
        outside, inside = along[first - 1], along[first]
    return outside * WAY / np.linalg.norm(WAY)


def camera(place: np.ndarray, level: int, size: int) -> gv.Camera:
    """Returns a camera 2^-level of the box away from `place`, where there is most room."""
    ways = np.random.default_rng(0).normal(size=(500, 3))
    eyes = place + BOX * 0.5**level * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    eye = eyes[gap(eyes).argmax()]
    return gv.Camera.look_at(tuple(eye), tuple(place), (0, 0, 1), fov=50, width=size, height=size)


def first_below(rays: gv.Rays, share: float, cone: np.ndarray, end: float) -> np.ndarray:
    """Returns the distances (r,) at which rays first come nearer to the bulb than a share of their
    cones, which are `cone` wide per unit of distance; +inf: none before `end`.
    """
    origin, direction = rays.origin.double().numpy(), rays.direction.double().numpy()
    t, found = np.full(len(origin), 1e-3 * end), np.full(len(origin), np.inf)
    for _ in range(3000):
        open_ = np.isinf(found) & (t < end)
        if not open_.any():
            break
        near = gap(origin[open_] + t[open_, None] * direction[open_])
        wide = cone[open_] * t[open_]
        hit = near < share * wide
        row = open_.nonzero()[0]
        found[row[hit]] = t[row[hit]]
        t[row] += np.maximum(0.2 * near, 0.1 * wide)
    return found


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


def seen_from_near(engine: gv.Engine, place: np.ndarray, level: int, size: int) -> gv.Picture:
    """Renders a picture, and asserts that the drawn surface lies where estimates fall from a cone's
    width to a fiftieth of it: nothing is in front of that, and no hole is behind.
    """
    scale, view = 2.0, camera(place, level, size)
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
    beside = (depth - late)[seen] / wide[seen]
    assert np.quantile(beside, 0.97) < 1, beside.max()
    print(
        f"2^-{level}: {seen.mean():.2f} seen, {np.quantile(beside, (0, 0.5, 0.97, 1))} cones beside"
    )
    return picture


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("level", [4, 20, 26, 30])
def test_a_picture_from_near_is_that_of_the_formula(bulb, level):
    seen_from_near(*bulb, level, 16)


@pytest.mark.backend("cpp")
def test_a_flight_through_all_levels_is_that_of_the_formula():
    """From 2^-4 to 2^-30 of the box, with a pool that holds a part of what is seen on the way, and
    constant memory; back at the start, the picture has the same bits as before.
    """
    place, made = surface_place(), 0
    with opened("2 MB") as engine:
        for level in range(4, 31):
            picture = seen_from_near(engine, place, level, 20)
            made += picture.stats.produced["bricks"]
            if level == 4:
                first, memory = picture, engine.memory()
            if level == 10:
                resident = resident_bytes()
        assert made > 2 * engine.cache.bricks.capacity, "the pool was filled anew"
        assert engine.memory() == memory and resident_bytes() - resident < 20e6
        back = seen_from_near(engine, place, 4, 20)
        assert torch.equal(back.depth, first.depth) and torch.equal(back.color, first.color)


@pytest.mark.backend("cpp")
def test_single_and_double_see_the_same_from_near(bulb):
    """No jitter: float32 rays that begin 10^-8 of the box away meet what float64 rays do."""
    engine, place = bulb
    view = camera(place, 27, 16)
    look = gv.Isosurface(0.25)
    single, double = (
        engine.render(view, look, cone_scale=2.0, dtype=dtype)
        for dtype in (torch.float32, torch.float64)
    )
    assert torch.equal(torch.isfinite(single.depth), torch.isfinite(double.depth))
    seen = torch.isfinite(double.depth)
    beside = (single.depth - double.depth).abs()[seen] / double.depth[seen]
    assert seen.float().mean() > 0.5 and beside.double().quantile(0.9) < 1e-4
