"""Fields: values against NumPy, intervals against brute force, and what producers make of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY, camera

import gvtorch as gv
from gvtorch.fields import Field
from gvtorch.fields.fractals import Power
from gvtorch.producers import Layout

sdf = gv.sdf
RED, BLUE = (0.9, 0.2, 0.1), (0.1, 0.3, 0.8)


def np_sphere(p, radius=0.7):
    return np.sqrt((p**2).sum(-1)) - radius


def np_box(p, size=(1.0, 0.6, 0.8), round=0.1):
    """The farthest face inside, the nearest point of the inner box outside."""
    half = np.array(size) / 2 - round
    nearest = np.clip(p, -half, half)
    outside = np.sqrt(((p - nearest) ** 2).sum(-1))
    inside = (np.abs(p) - half).max(-1)
    return np.where(outside > 0, outside, inside) - round


def np_smooth(a, b, width):
    """Quilez' polynomial in its other form: max(width - |a - b|, 0)^2 / (4 width) below the min."""
    return np.minimum(a, b) - np.maximum(width - np.abs(a - b), 0) ** 2 / (4 * width)


def ball():
    return sdf.Sphere(0.7, color=RED)


def block():
    return sdf.Box((1.0, 0.6, 0.8), round=0.1, color=BLUE)


def np_torus(p, radius=0.6, tube=0.2):
    """The nearest of the ring's middle points is at the same angle."""
    angle = np.arctan2(p[:, 1], p[:, 0])
    ring = radius * np.stack((np.cos(angle), np.sin(angle), 0 * angle), 1)
    return np.linalg.norm(p - ring, axis=1) - tube


def np_capsule(p, a=(-0.3, 0.1, 0.2), b=(0.4, -0.2, 0.5), radius=0.25):
    along = np.array(b) - a
    share = np.clip((p - a) @ along / (along @ along), 0, 1)
    return np.linalg.norm(p - (np.array(a) + share[:, None] * along), axis=1) - radius


def np_gyroid(p, period=1.3):
    x, y, z = 2 * np.pi / period * p.T
    waves = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    return waves * period / (2 * np.pi * 3**0.5)


def np_cylinder(p, radius=0.4, half=0.5):
    """The nearest point of the solid, or the nearest wall from within."""
    rho = np.hypot(p[:, 0], p[:, 1])
    outside = np.hypot(np.maximum(rho - radius, 0), np.maximum(np.abs(p[:, 2]) - half, 0))
    return np.where(outside > 0, outside, np.maximum(rho - radius, np.abs(p[:, 2]) - half))


def np_square_ring(p, radius=0.6):
    flat = np.stack((np.hypot(p[:, 0], p[:, 1]) - radius, p[:, 2], 0 * p[:, 0]), 1)
    return np_box(flat, (0.4, 0.3, 0.5), 0.05)


def np_repeated(p, counts=(4, 1, 0)):
    """The nearest of all of them."""
    found = np.full(len(p), np.inf)
    for x in range(-counts[0], counts[0] + 1):
        for y in range(-counts[1], counts[1] + 1):
            found = np.minimum(found, np_capsule(p - np.array((1.5 * x, 1.1 * y, 0))))
    return found


def np_twisted(p, rate=1.5):
    angle = -rate * p[:, 2]
    x = np.cos(angle) * p[:, 0] - np.sin(angle) * p[:, 1]
    y = np.sin(angle) * p[:, 0] + np.cos(angle) * p[:, 1]
    return np_box(np.stack((x, y, p[:, 2]), 1))


def np_sponge(p, levels=3):
    """The largest of a cube and of bars along all axes, of all sizes."""
    found = np_box(p, (1, 1, 1), 0)
    for cell in 3.0 ** -np.arange(levels):
        x, y, z = np.abs((p + cell / 2) % cell - cell / 2).T
        for one, other in ((x, y), (y, z), (z, x)):
            found = np.maximum(found, cell / 6 - np.maximum(one, other))
    return found


def np_turned(p, degrees=40):
    """About (1, 1, 1), by SciPy's convention: the angle of a rotation vector."""
    k, a = np.ones(3) / 3**0.5, np.deg2rad(-degrees)
    cross = np.cross(k, p)
    q = p * np.cos(a) + cross * np.sin(a) + k * (p @ k)[:, None] * (1 - np.cos(a))
    return np_box(q)


STRETCH = ((1.2, 0.3, 0.0), (0.0, 0.7, 0.0), (0.1, 0.0, 1.0))


def np_stretched(p):
    least = np.linalg.svd(np.array(STRETCH))[1].min()
    q = np.linalg.solve(np.array(STRETCH), (p - np.array((0.1, 0.2, -0.1))).T).T
    return least * np_box(q)


def capsule():
    return sdf.Capsule((-0.3, 0.1, 0.2), (0.4, -0.2, 0.5), 0.25, color=BLUE)


#: By name: the shape, and its value by NumPy.
SHAPES = {
    "sphere": (ball, np_sphere),
    "box": (block, np_box),
    "union": (lambda: ball() | block(), lambda p: np.minimum(np_sphere(p), np_box(p))),
    "intersection": (lambda: ball() & block(), lambda p: np.maximum(np_sphere(p), np_box(p))),
    "difference": (lambda: ball() - block(), lambda p: np.maximum(np_sphere(p), -np_box(p))),
    "smooth union": (
        lambda: sdf.SmoothUnion(ball(), block(), 0.3),
        lambda p: np_smooth(np_sphere(p), np_box(p), 0.3),
    ),
    "smooth intersection": (
        lambda: sdf.SmoothIntersection(ball(), block(), 0.3),
        lambda p: -np_smooth(-np_sphere(p), -np_box(p), 0.3),
    ),
    "smooth difference": (
        lambda: sdf.SmoothDifference(ball(), block(), 0.3),
        lambda p: -np_smooth(-np_sphere(p), np_box(p), 0.3),
    ),
    "torus": (lambda: sdf.Torus(0.6, 0.2), np_torus),
    "capsule": (capsule, np_capsule),
    "plane": (lambda: sdf.Plane((1, 2, -2), 0.3), lambda p: p @ [1 / 3, 2 / 3, -2 / 3] - 0.3),
    "gyroid": (lambda: sdf.Gyroid(1.3), np_gyroid),
    "gyroid shell": (
        lambda: sdf.Shell(sdf.Gyroid(1.3), 0.1) & ball(),
        lambda p: np.maximum(np.abs(np_gyroid(p)) - 0.05, np_sphere(p)),
    ),
    "sponge": (lambda: sdf.Menger(3), np_sponge),
    "extrusion": (lambda: sdf.Extrusion(sdf.Sphere(0.4), 1.0), np_cylinder),
    "revolution": (
        lambda: sdf.Revolution(sdf.Box((0.4, 0.3, 0.5), round=0.05), 0.6),
        np_square_ring,
    ),
    "offset": (lambda: sdf.Offset(block(), 0.1), lambda p: np_box(p) - 0.1),
    "shell": (lambda: sdf.Shell(block(), 0.1), lambda p: np.abs(np_box(p)) - 0.05),
    "moved": (
        lambda: sdf.moved(capsule(), 0.1, 0.2, -0.3),
        lambda p: np_capsule(p - [0.1, 0.2, -0.3]),
    ),
    "rotated": (lambda: sdf.rotated(block(), (1, 1, 1), 40), np_turned),
    "scaled": (lambda: sdf.scaled(block(), 0.5), lambda p: 0.5 * np_box(p / 0.5)),
    "stretched": (lambda: sdf.Transform(block(), STRETCH, (0.1, 0.2, -0.1)), np_stretched),
    "twist": (lambda: sdf.Twist(block(), 1.5), np_twisted),
    "repeated": (lambda: sdf.Repeat(capsule(), (1.5, 1.1, 0), (9, 3, 1)), np_repeated),
    "repeated for ever": (
        lambda: sdf.Repeat(capsule(), (1.5, 1.1, 0)),
        lambda p: np_repeated(p, (4, 4, 0)),
    ),
}


def np_escape(p, step, constant, iterations, bailout, estimate):
    """A point at a time."""
    found = np.full(len(p), -1.0)
    for row, point in enumerate(p):
        z, apart, c = point, 1.0, point if constant is None else np.array(constant)
        for turn in range(iterations + 1):
            if np.linalg.norm(z) > bailout:
                found[row] = estimate(np.linalg.norm(z), apart)
                break
            if turn < iterations:
                z, grown = step(z)
                z, apart = z + c, grown * apart + (constant is None)
    return found


def np_power(z, n):
    """White and Nylander's formula, with the angle from the z axis."""
    r, polar, around = (
        np.linalg.norm(z),
        np.arctan2(np.hypot(z[0], z[1]), z[2]),
        np.arctan2(z[1], z[0]),
    )
    turned = np.sin(n * polar) * np.cos(n * around), np.sin(n * polar) * np.sin(n * around)
    return r**n * np.array((*turned, np.cos(n * polar))), n * r ** (n - 1)


def np_fold(z, scale):
    z = np.array([2 - v if v > 1 else -2 - v if v < -1 else v for v in z])
    r = np.linalg.norm(z)
    grown = 4.0 if r < 0.5 else 1 / r**2 if r < 1 else 1.0
    return scale * grown * z, abs(scale) * grown


def np_log(r, apart):
    return r * np.log(r) / (2 * apart)


#: By name: the fractal, and its value by NumPy.
FRACTALS = {
    "bulb": (
        lambda: gv.Mandelbulb(8, iterations=6),
        lambda p: np_escape(p, lambda z: np_power(z, 8), None, 6, 2.0, np_log),
    ),
    "bulb of 3": (
        lambda: gv.Mandelbulb(3, iterations=7),
        lambda p: np_escape(p, lambda z: np_power(z, 3), None, 7, 2.0, np_log),
    ),
    "julia": (
        lambda: gv.Julia((-0.2, 0.5, 0.3), 2, iterations=9),
        lambda p: np_escape(p, lambda z: np_power(z, 2), (-0.2, 0.5, 0.3), 9, 2.0, np_log),
    ),
    "mandelbox": (
        lambda: gv.Mandelbox(2.0, iterations=12),
        lambda p: np_escape(p, lambda z: np_fold(z, 2.0), None, 12, 10.8, np.divide),
    ),
}
ALL = {**SHAPES, **FRACTALS}


@pytest.fixture(params=SHAPES, name="named")
def _named(request):
    make, by_numpy = SHAPES[request.param]
    return make(), by_numpy


@pytest.fixture(params=ALL)
def shape(request):
    return ALL[request.param][0]()


@pytest.mark.parametrize("name", FRACTALS)
def test_fractals_are_those_of_numpy(name):
    make, by_numpy = FRACTALS[name]
    points = random_points(1500, 10.0 if name == "mandelbox" else 3.0)
    expected, found = by_numpy(points.numpy()), make()(points).numpy()
    same = np.isclose(found, expected, rtol=1e-6, atol=1e-12)
    assert same.mean() > 0.999 and (expected < 0).any(), "rounding may tip who escapes"


class Burning(gv.Iteration):
    """A step of one's own: the bulb's of n = 2, of coordinates without their signs."""

    def __init__(self):
        super().__init__()
        self.power = Power(2)

    def forward(self, z):
        return self.power(z.abs())


def test_any_iteration_makes_a_fractal_and_what_is_not_known_is_not_proven():
    shape, points = gv.Fractal(Burning(), iterations=8), random_points(500, 3.0)
    expected = np_escape(points.numpy(), lambda z: np_power(np.abs(z), 2), None, 8, 2.0, np_log)
    assert np.isclose(shape(points).numpy(), expected, rtol=1e-6).mean() > 0.995
    center, half = random_boxes(2000)
    low, high = shape.bounds(center, half)
    value = shape(inside(center, half, 20))
    assert (value >= low[:, None]).all() and (value <= high[:, None]).all()
    center, half = torch.full((1, 3), 5.0).double(), torch.full((1, 3), 0.1).double()
    assert shape.bounds(center, half)[0] > 0, "beyond the bailout it escapes at once"
    with pytest.raises(ValueError, match="Fractal: iteration must be a Iteration, got int"):
        gv.Fractal(3)
    with pytest.raises(ValueError, match="colors must be three colours, got 1"):
        gv.Mandelbulb(colors=((0, 0, 0),))


def random_points(count, side=4.0, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return side * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5)


def random_boxes(count, seed=1):
    """Centres and half sides, from large to tiny, most of them near the origin."""
    generator = torch.Generator().manual_seed(seed)
    half = 10 ** (-3 * torch.rand(count, 1, generator=generator, dtype=torch.float64))
    shape = 0.2 + torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return random_points(count, 3.0, seed + 1), half * shape


def inside(center, half, count, seed=3):
    """(k, count, 3) points of boxes: their corners, and others by chance."""
    corners = torch.cartesian_prod(*(torch.tensor([-1.0, 1.0], dtype=torch.float64),) * 3)
    generator = torch.Generator().manual_seed(seed)
    others = 2 * torch.rand(len(center), count - 8, 3, generator=generator).double() - 1
    at = torch.cat((corners.expand(len(center), 8, 3), others), 1)
    return center[:, None] + half[:, None] * at


def test_values_are_those_of_numpy(named):
    shape, by_numpy = named
    points = random_points(20_000)
    expected = np.asarray(by_numpy(points.numpy()))
    assert np.abs(shape(points).numpy() - expected).max() < 1e-12
    single = shape(points.float())
    assert single.dtype == torch.float32 and np.abs(single.numpy() - expected).max() < 2e-6


def test_intervals_hold_in_random_boxes(shape):
    """10^5 boxes: no value at 27 points of each lies beyond, and the slope is never passed."""
    center, half = random_boxes(100_000)
    low, high = shape.bounds(center, half)
    steep = shape.slope(center, half)
    for at in torch.arange(len(center)).split(20_000):
        points = inside(center[at], half[at], 27)
        value = shape(points)
        assert (value >= low[at, None] - 1e-12).all() and (value <= high[at, None] + 1e-12).all()
        change = (value[:, :13] - value[:, 13:26]).abs()
        way = (points[:, :13] - points[:, 13:26]).norm(dim=-1)
        assert (change <= steep[at, None] * way * (1 + 1e-9) + 1e-12).all()
    if not isinstance(shape, gv.Mandelbox):  # all boxes lie within it
        assert ((low > 0) | (high < 0)).double().mean() > 0.15, "and they say something"


def test_gradients_are_those_of_differences(named):
    shape, _ = named
    points, step = random_points(5000), 1e-6
    steps = step * torch.eye(3, dtype=torch.float64)
    by_steps = torch.stack(
        [(shape(points + one) - shape(points - one)) / (2 * step) for one in steps], -1
    )
    apart = (shape.gradient(points) - by_steps).abs().amax(1)
    assert apart.quantile(0.99) < 1e-6, "but where two surfaces meet"


def test_nothing_lies_beyond_a_box(shape):
    box = shape.box()
    if box is not None:
        low, high = box.unbind(0)
        points = random_points(100_000, 14.0 if isinstance(shape, gv.Mandelbox) else 8.0)
        found = shape(points) < 0
        assert found.any() and ((points >= low) & (points <= high)).all(1)[found].all()


def test_shapes_have_the_colour_of_what_is_nearer():
    union, points = ball() | block(), random_points(2000)
    value, color = union.surface(points)
    nearer = torch.where(
        (block()(points) < ball()(points))[:, None], torch.tensor(BLUE), torch.tensor(RED)
    )
    assert torch.equal(value, union(points)) and torch.allclose(color, nearer.double())
    smooth = sdf.SmoothUnion(ball(), block(), 0.3).surface(points)[1]
    low, high = torch.tensor((RED, BLUE)).double().aminmax(dim=0)
    assert ((smooth >= low - 1e-6) & (smooth <= high + 1e-6)).all()
    center, half = random_boxes(20_000)
    for shape in (union, ball() - block(), sdf.SmoothUnion(ball(), block(), 0.3)):
        low, high = shape.colors(center, half)
        found = shape.surface(inside(center, half, 12))[1]
        assert (found >= low[:, None] - 1e-6).all() and (found <= high[:, None] + 1e-6).all()
        assert (low == high).all(1).double().mean() > 0.02, "of shapes that nearly touch"


def nodes_of(producer, depth, brick_size=4, border=1):
    """All nodes of a level."""
    layout = Layout.of(producer, brick_size, border, torch.device("cpu"))
    axis = torch.arange(producer.branching**depth)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    loc = torch.stack((x, y, z, torch.full_like(x, depth)), -1).flatten(0, 2)
    return gv.Nodes(loc, layout)


def test_no_voxel_is_dropped(shape):
    """All nodes of depth 6 in bricks of 2^3: what is called EMPTY or CONSTANT is, in every voxel,
    and every value is in its range."""
    side = 7.0 if isinstance(shape, gv.Mandelbox) else 1.1
    producer = gv.FieldProducer(shape, 128, box=((-side,) * 3, (side,) * 3))
    told = dict.fromkeys(gv.Region, 0)
    for depth in (3, 6):
        nodes = nodes_of(producer, depth, brick_size=2)
        regions = producer.classify(nodes)
        for at in torch.arange(len(nodes)).split(20_000):
            data = producer.fill(nodes[at]).data
            kind = regions.kind[at]
            rgba = data["rgba"].flatten(1, 3)
            assert not rgba[kind == gv.Region.EMPTY].any()
            for name, voxels in data.items():
                rows = voxels.flatten(1, 3)
                constant = regions.constants[name][at][:, None]
                assert (rows == constant)[kind == gv.Region.CONSTANT].all(), name
                low, high = regions.ranges[name][at].unbind(1)
                assert (rows >= low[:, None]).all() and (rows <= high[:, None]).all(), name
            for region in gv.Region:
                told[region] += int((kind == region).sum())
    least = 0.001 if isinstance(shape, gv.Mandelbox) else 0.25
    assert told[gv.Region.EMPTY] > least * sum(told.values())


def test_a_solid_holds_the_share_of_each_voxel():
    """Against 16^3 points a voxel: exact where the plane faces an axis, elsewhere to 0.09."""
    producer = gv.FieldProducer(gv.Solid(ball(), colors=False), 32, box=((-1,) * 3, (1,) * 3))
    nodes = nodes_of(producer, 3)
    density = producer.fill(nodes).data["density"][..., 0]
    places = (torch.arange(16) + 0.5) / 16 - 0.5
    offsets = torch.cartesian_prod(places, places, places) * producer.spacing[0]
    true = torch.stack(
        [(ball()(nodes.positions + one) < 0).float() for one in offsets.split(1)]
    ).mean(0)
    apart = (density - true).abs()
    assert apart.max() < 0.1 and apart.mean() < 0.005
    volume = density[:, 1:-1, 1:-1, 1:-1].sum() * producer.spacing[0] ** 3
    assert math.isclose(float(volume), 4 / 3 * math.pi * 0.7**3, rel_tol=5e-3)


class Waves(Field):
    """Two channels."""

    def forward(self, points):
        return {"a": points.sum(-1).sin(), "b": torch.stack((points[..., 0], points[..., 2]), -1)}


@pytest.mark.parametrize("branching", [2, 3])
def test_a_coarse_level_is_the_mean_of_what_lies_below(branching):
    """One level above the finest: exactly the mean of the voxels' middles below. Further up: as far
    as `samples` resolve the field."""
    extent = 4 * branching**3
    fine = gv.FieldProducer(
        Waves(), extent, box=((-1,) * 3, (1,) * 3), branching=branching, samples=1
    )
    coarse = gv.FieldProducer(Waves(), extent, box=((-1,) * 3, (1,) * 3), branching=branching)
    below = {}
    for depth in (3, 2, 1, 0):
        axis = torch.arange(branching**depth)
        nodes = nodes_of(coarse, depth, border=0)
        for name in ("a", "b"):
            made = coarse.fill(nodes).data[name] if depth < 3 else fine.fill(nodes).data[name]
            side = 4 * len(axis)
            grid = made.view(*(len(axis),) * 3, 4, 4, 4, -1).permute(0, 3, 1, 4, 2, 5, 6)
            grid = grid.reshape(side, side, side, -1)
            if name in below:
                n = branching
                mean = below[name].view(side, n, side, n, side, n, -1).mean((1, 3, 5))
                assert (grid - mean).abs().max() < (1e-6 if depth == 2 else 0.05)
                below[name] = mean
            else:
                below[name] = grid


@pytest.mark.backend("cpp")
def test_a_field_is_rendered_as_its_dense_volume():
    """All bricks by the engine, finest level, against a resident tree of the same values."""
    field, box = gv.sdf.Box((1.0, 0.8, 0.6), round=0.2), ((-0.8,) * 3, (0.8,) * 3)
    producer = gv.FieldProducer(gv.Solid(field, colors=False), 32, box=box)
    places = (torch.arange(32) + 0.5) / 32 * 1.6 - 0.8
    z, y, x = torch.meshgrid(places, places, places, indexing="ij")
    values = (0.5 - field(torch.stack((x, y, z), -1)) / 0.05).clamp(0, 1)
    volume = gv.Volume(values, (0.05,) * 3, (places[0].item(),) * 3)
    tree = gv.N3Tree.from_volume({"density": volume}, 4)
    expected = gv.render(tree, camera(32), GRAY, lod="finest")
    with gv.Engine(producer, brick_size=4) as engine:
        picture = engine.render(camera(32), GRAY, lod="finest")
        engine.validate()
    assert picture.stats.converged and expected.alpha.max() > 0.5
    assert (picture.color - expected.color).abs().max() < 1e-4


class Given(torch.nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, points):
        return self.function(points)


BOX = ((0, 0, 0), (1, 1, 1))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sdf.Sphere(math.nan), "Sphere: radius must be finite"),
        (lambda: sdf.Sphere(-1), "Sphere: radius must be finite and > 0"),
        (lambda: sdf.Box((1, 1, math.inf)), "Box: size must be finite"),
        (lambda: sdf.Box(round=2), "Box: round must be finite"),
        (lambda: sdf.Sphere(color=(2, 0, 0)), "Sphere: color must be in 0 to 1"),
        (lambda: sdf.Union(sdf.Sphere(), 3), "Union: second must be a Distance, got int"),
        (lambda: sdf.SmoothUnion(ball(), ball(), 0), "SmoothUnion: width must be finite and > 0"),
        (lambda: sdf.Plane((0, 0, 0)), "Plane: normal must have a direction"),
        (lambda: sdf.rotated(ball(), (0, 0, 0), 3), "rotated: axis must have a direction"),
        (lambda: sdf.scaled(ball(), 0), "Transform: matrix must have an inverse"),
        (lambda: sdf.Transform(ball(), torch.eye(4)), "Transform: matrix must be (3, 3) numbers"),
        (lambda: sdf.Shell(ball(), -1), "Shell: thickness must be finite and > 0"),
        (lambda: sdf.Repeat(ball(), (1, 3, 3)), "Repeat: the shape must lie within its cell"),
        (lambda: sdf.Repeat(sdf.Gyroid(), (1, 3, 3)), "within its cell, it has no box"),
        (lambda: sdf.Repeat(ball(), (2, 0, 0), (2, 1, 1)), "Repeat: count must be odd"),
        (lambda: sdf.Repeat(ball(), (0, 0, 0)), "Repeat: period must be >= 0"),
        (lambda: gv.FieldProducer(3), "FieldProducer: field must be a Module, got int"),
        (lambda: gv.FieldProducer(Waves()), "box must be given: the field does not tell"),
        (
            lambda: gv.FieldProducer(Waves(), box=((0, 0, 0), (1, 1, math.inf))),
            "box must be finite",
        ),
        (
            lambda: gv.FieldProducer(Given(lambda p: p[0]), box=BOX),
            "field must give (2, 5) or (2, 5, c) for 'value' at (2, 5, 3) points, got (5, 3)",
        ),
        (lambda: gv.FieldProducer(Given(lambda p: 3), box=BOX), "field must give a tensor, or"),
        (lambda: gv.FieldProducer(Given(torch.isnan), box=BOX), "field must give floats for"),
        (
            lambda: gv.FieldProducer(Waves(), box=BOX, channels={"a": gv.Channel()}),
            "channels must be {'a': 1, 'b': 2} numbers wide, got {'a': 1}",
        ),
        (lambda: gv.FieldProducer(Waves(), box=BOX, samples=0), "samples must be an int >= 1"),
        (lambda: gv.FieldProducer(Waves(), box=BOX, threshold={"c": 1}), "threshold has channel"),
        (lambda: gv.FieldProducer(Waves(), box=BOX, dtype=torch.int8), "dtype must be torch.fl"),
    ],
)
def test_bad_fields_are_named(call, message):
    with pytest.raises(ValueError) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
def test_nan_of_a_field_costs_its_bricks_alone(dtype):
    """Places with x > 1/2 give NaN: their bricks are named, the others are drawn."""

    def half(points):
        x = points[..., 0]
        return torch.where(x > 0.6, math.nan, x.clamp(0, 1))

    channels = {"value": gv.Channel(dtype)}
    field = Given(lambda p: half(p) if p.shape[1:] != (10, 10, 10, 3) else p[..., 0].clamp(0, 1))
    producer = gv.FieldProducer(field, 64, box=BOX, channels=channels, samples=1)
    with gv.Engine(producer, brick_size=8) as engine:
        field.function = half
        picture = engine.render(camera(16), GRAY, lod="finest")
        engine.validate()
        assert picture.stats.failed and torch.isfinite(picture.color).all()
        message = "NaN" if dtype.is_floating_point else "the values are not finite"
        assert all(message in failure.message for failure in engine.failures)
        assert all(
            failure.loc[0] * 8 + 9 > 0.6 * 64 for failure in engine.failures if failure.loc[3] == 3
        )


@pytest.mark.parametrize("colors", [False, True])
def test_producers_of_fields_compile_whole(colors):
    """Nothing breaks the graph: neither gradients nor intervals ask the host."""
    shape = sdf.SmoothUnion(ball(), block(), 0.2) - sdf.Sphere(0.4)
    producer = gv.FieldProducer(gv.Solid(shape, colors=colors), 64)
    nodes = nodes_of(producer, 2)

    def ask(loc):
        asked = gv.Nodes(loc, nodes.layout)
        regions = producer.classify(asked)
        return producer.fill(asked).data, regions.kind, regions.ranges

    expected = ask(nodes.loc)  # the layout keeps what it makes once
    compiled = torch.compile(ask, fullgraph=True, dynamic=False, backend="aot_eager")
    data, kind, ranges = compiled(nodes.loc)
    assert torch.equal(kind, expected[1])
    for name, rows in expected[0].items():
        assert torch.equal(data[name], rows) and torch.equal(ranges[name], expected[2][name])


def test_values_at_points_need_no_engine():
    producer, points = gv.FieldProducer(Waves(), box=BOX), random_points(10)
    found = producer.at(points)
    assert torch.equal(found["a"][:, 0], points.sum(-1).sin()) and found["b"].shape == (10, 2)


def test_deep_voxels_are_told_apart():
    """2^33 voxels a side: places are float64 by themselves, and values those of the field there."""
    bulb = gv.Mandelbulb(8, iterations=20)
    producer = gv.FieldProducer(bulb, 2**33)
    assert producer.dtype == torch.float64
    assert gv.FieldProducer(bulb, 2**16).dtype == torch.float32
    layout = Layout.of(producer, 8, 1, torch.device("cpu"))
    ways = torch.nn.functional.normalize(random_points(400), dim=1)
    near, far = torch.zeros(400, 1).double(), torch.full((400, 1), 1.3).double()
    for _ in range(50):  # onto the surface: the middle is inside, the end is not
        middle = (near + far) / 2
        inside = bulb(ways * middle)[:, None] < 0
        near, far = torch.where(inside, middle, near), torch.where(inside, far, middle)
    points = ways * near
    voxel = ((points - layout.origin_3) / layout.spacing_3).floor().to(torch.int64)
    depth = torch.full_like(voxel[:, :1], layout.depth)
    nodes = gv.Nodes(torch.cat((voxel // 8, depth), 1), layout)
    rgba = producer.fill(nodes).data["rgba"]
    across = (rgba[:, :, :, 1:, 3] - rgba[:, :, :, :-1, 3]).abs().amax((1, 2, 3))
    assert (across > 0).double().mean() > 0.3, "bricks of 2e-9 of the box see the surface"
    places = nodes.center[:, None, None, None] + nodes.local_positions
    side = nodes.voxel_size[:, :1, None, None]
    expected = (0.5 - bulb(places) / side).clamp(0, 1)
    assert (rgba[..., 3] - expected).abs().max() < 1e-3
    empty = producer.classify(nodes).kind == gv.Region.EMPTY
    assert not rgba[empty].any()
