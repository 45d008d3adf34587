"""Distance fields and fractals: values against NumPy, intervals and slopes against brute force."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers.shapes import (
    ALL,
    BLUE,
    FRACTALS,
    RED,
    SHAPES,
    ball,
    block,
    np_escape,
    np_log,
    np_power,
    points_inside,
    random_boxes,
    random_points,
)

import gvtorch as gv
from gvtorch.fields.field import box_distance
from gvtorch.fields.fractals import Power

sdf = gv.sdf
BOXES = 20_000  # in which each shape's bounds are tested


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
    expected, actual = by_numpy(points.numpy()), make()(points).numpy()
    same = np.isclose(actual, expected, rtol=1e-6, atol=1e-12)
    assert same.mean() > 0.999 and (expected < 0).any(), "rounding may tip who escapes"


class Burning(gv.Iteration):
    """A user-defined step: the bulb's with n = 2, of the coordinates' absolute values."""

    def __init__(self):
        super().__init__()
        self.power = Power(2)

    def forward(self, z):
        return self.power(z.abs())


class Mine(gv.Iteration):
    """A built-in step, as a user-defined one."""

    def __init__(self, step):
        super().__init__()
        self.step, self.logarithmic = step, step.logarithmic

    def forward(self, z):
        return self.step(z)


def test_any_iteration_makes_a_fractal_and_what_is_not_known_is_not_proven():
    shape, points = gv.Fractal(Burning(), iterations=8), random_points(500, 3.0)
    expected = np_escape(points.numpy(), lambda z: np_power(np.abs(z), 2), None, 8, 2.0, np_log)
    assert np.isclose(shape(points).numpy(), expected, rtol=1e-6).mean() > 0.995
    center, half = random_boxes(2000)
    low, high = shape.bounds(center, half)
    value = shape(points_inside(center, half, 20))
    assert (value >= low[:, None]).all() and (value <= high[:, None]).all()
    center, half = torch.full((1, 3), 5.0).double(), torch.full((1, 3), 0.1).double()
    assert shape.bounds(center, half)[0] > 0, "beyond the bailout it escapes at once"
    with pytest.raises(ValueError, match="Fractal: iteration must be a Iteration, got int"):
        gv.Fractal(3)
    with pytest.raises(ValueError, match=r"colors must be \(3, 3\) numbers, got \(1, 3\)"):
        gv.Mandelbulb(colors=((0, 0, 0),))


def test_values_are_those_of_numpy(named):
    shape, by_numpy = named
    points = random_points(20_000)
    expected = np.asarray(by_numpy(points.numpy()))
    assert np.abs(shape(points).numpy() - expected).max() < 1e-12
    single = shape(points.float())
    assert single.dtype == torch.float32 and np.abs(single.numpy() - expected).max() < 2e-6


@pytest.mark.parametrize(
    "make",
    [
        lambda: sdf.Repeat(
            sdf.Transform(block(), ((0.5, 0.3, 0), (0, 0.4, 0.2), (0, 0, 0.3))), (2, 2, 0)
        ),
        lambda: sdf.Repeat(sdf.Box() & sdf.Plane((1, 1, 1), -0.3), (1, 0, 0)),
        lambda: sdf.Repeat(sdf.Box() - sdf.Plane((-1, -1, 0), 0.3), (0, 1, 0), (1, 3, 1)),
    ],
)
@pytest.mark.parametrize("by", [0.0, 0.2])
def test_intervals_of_repeated_shapes_hold_where_cells_change(make, by):
    """A value that is no distance may be less at the next but one copy, and jumps there."""
    shape = sdf.Offset(make(), by)
    center, half = random_boxes(5000)
    low, high = shape.bounds(center, half)
    value = shape(points_inside(center, half, 27))
    assert (value >= low[:, None] - 1e-12).all() and (value <= high[:, None] + 1e-12).all()
    assert ((low > 0) | (high < 0)).double().mean() > 0.15, "and they say something"


def test_intervals_hold_in_random_boxes(shape):
    """`BOXES` boxes: no value at 27 points of each is outside, and no slope is exceeded."""
    center, half = random_boxes(BOXES)
    low, high = shape.bounds(center, half)
    steep = shape.slope(center, half)
    for rows in torch.arange(len(center)).split(20_000):
        points = points_inside(center[rows], half[rows], 27)
        value = shape(points)
        assert (value >= low[rows, None] - 1e-12).all() and (
            value <= high[rows, None] + 1e-12
        ).all()
        change = (value[:, :13] - value[:, 13:26]).abs()
        distance = (points[:, :13] - points[:, 13:26]).norm(dim=-1)
        assert (change <= steep[rows, None] * distance * (1 + 1e-9) + 1e-12).all()
    if not isinstance(shape, gv.Mandelbox):  # all boxes lie within it
        assert ((low > 0) | (high < 0)).double().mean() > 0.15, "and they say something"


def test_gradients_are_those_of_differences(named):
    shape, _ = named
    points, step = random_points(5000), 1e-6
    steps = step * torch.eye(3, dtype=torch.float64)
    by_steps = torch.stack(
        [(shape(points + shift) - shape(points - shift)) / (2 * step) for shift in steps], -1
    )
    error = (shape.gradient(points) - by_steps).abs().amax(1)
    assert error.quantile(0.99) < 1e-6, "but where two surfaces meet"


class Constant(sdf.Sphere):
    def forward(self, points):
        return torch.ones_like(points[..., 0])


def test_gradients_are_the_same_where_nothing_is_recorded():
    points = random_points(300)
    for make in [*(make for make, _ in ALL.values()), Constant]:
        shape = make()
        expected = shape.surface_and_gradient(points.clone())
        with torch.no_grad():
            parts = shape.surface_and_gradient(points)
        with torch.inference_mode():
            inferred = shape.surface_and_gradient(points.clone())
        assert all(map(torch.equal, parts, expected)), type(shape)
        assert all(map(torch.equal, inferred, expected)), type(shape)
        assert not any(part.requires_grad for part in parts)


def test_gradients_of_normals_are_those_of_a_closed_form():
    """Where something is recorded: by a parameter in backward mode, by points in forward mode."""
    points, shape = random_points(50), sdf.Sphere()
    shape.scale = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
    shape.forward = lambda at: (at * at).sum(-1) * shape.scale
    shape.gradient(points).sum().backward()
    assert torch.allclose(shape.scale.grad, 2 * points.sum())
    with torch.no_grad():
        _, change = torch.func.jvp(shape.gradient, (points,), (torch.ones_like(points),))
        with torch.autograd.forward_ad.dual_level():
            dual = torch.autograd.forward_ad.make_dual(points, torch.ones_like(points))
            tangent = torch.autograd.forward_ad.unpack_dual(shape.gradient(dual)).tangent
    assert torch.allclose(change, torch.full_like(points, 4.0))
    assert tangent is not None and torch.allclose(tangent, change)


def test_shapes_do_not_load_a_compiler():
    """`torch.func` would, at its first use, which takes seconds."""
    code = """
import sys, torch, gvtorch as gv
shape = gv.sdf.Box() | gv.sdf.Gyroid()
with gv.Engine(gv.FieldProducer(shape, 16, box=((-1,) * 3, (1,) * 3))) as engine:
    engine.render(gv.Camera.orbit(width=4, height=4), gv.TransferFunction.preset("gray", 0, 1))
print("torch._dynamo" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_distance_to_a_box_is_that_to_its_nearest_face_edge_or_corner():
    """Points are as far beyond a box's faces as listed; boxes, sponges and caps share it."""
    beyond = torch.tensor([(3, 4, 12), (3, -1, 4), (-2, 5, -1), (-3, -2, -1), (0, -1, -1)]).double()
    distance = torch.tensor([13, 5, 5, -1, 0]).double()
    assert torch.equal(box_distance(beyond), distance)
    assert torch.equal(gv.sdf.Box((8, 8, 8))(beyond + 4), distance)
    assert torch.equal(gv.sdf.Menger(0)(beyond / 16 + 0.5), distance / 16)
    disc, points = gv.sdf.Extrusion(gv.sdf.Sphere(1), 2), [(4, 0, 5), (0.5, 0, 5), (0.5, 0, 0)]
    assert torch.equal(disc(torch.tensor(points).double()), torch.tensor([5, 4, -0.5]).double())


def test_nothing_lies_beyond_a_box(shape):
    box = shape.box()
    if box is not None:
        low, high = box.unbind(0)
        points = random_points(100_000, 14.0 if isinstance(shape, gv.Mandelbox) else 8.0)
        inside = shape(points) < 0
        assert inside.any() and ((points >= low) & (points <= high)).all(1)[inside].all()


@pytest.mark.parametrize("iterations", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "make",
    [
        lambda **few: gv.Mandelbulb(8, **few),
        lambda **few: gv.Mandelbulb(2, bailout=4.0, **few),
        lambda **few: gv.Mandelbulb(3, bailout=1.2, **few),
        lambda **few: gv.Julia((-0.2, 0.5, 0.3), 2, **few),
        lambda **few: gv.Julia((0.0, 0.0, 0.0), 5, **few),
        lambda **few: gv.Mandelbox(2.0, **few),
        lambda **few: gv.Mandelbox(-1.5, **few),
    ],
)
def test_the_box_of_a_fractal_holds_what_has_not_escaped_after_few_steps(make, iterations):
    shape = make(iterations=iterations)
    low, high = shape.box()
    points = random_points(300_000, float(2.4 * high.max()))
    inside = points[shape(points) < 0]
    assert len(inside) > 20 and ((inside >= low) & (inside <= high)).all()


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
        colors = shape.surface(points_inside(center, half, 12))[1]
        assert (colors >= low[:, None] - 1e-6).all() and (colors <= high[:, None] + 1e-6).all()
        assert (low == high).all(1).double().mean() > 0.02, "of shapes that nearly touch"


@pytest.mark.parametrize("name", ALL)
def test_what_matters_near_a_box_has_the_same_bits(name):
    """Float32 values, colours and gradients, in boxes of various sizes up to the whole."""
    shape = ALL[name][0]()
    size = 7.0 if name == "mandelbox" else 1.2
    random = torch.Generator().manual_seed(4)
    for wide in (0.01, 0.06, 0.3, 1.0):
        for _ in range(12):
            middle = (2 * torch.rand(1, 3, generator=random, dtype=torch.float64) - 1) * size
            center = middle + wide * size * (torch.rand(5, 3, generator=random).double() - 0.5)
            half = torch.full_like(center, 0.2 * wide * size)
            points = points_inside(center, half, 30).float()
            near = shape.near(center, half)
            for a, b in zip(near.surface(points), shape.surface(points), strict=True):
                assert torch.equal(a, b)
            assert torch.equal(near(points), shape(points))


def test_what_does_not_matter_is_not_asked():
    class Counted(sdf.Sphere):
        asked = 0

        def forward(self, points):
            Counted.asked += len(points)
            return super().forward(points)

    far = sdf.moved(Counted(0.1), 5, 0, 0)
    shape = sdf.SmoothUnion(sdf.rotated(ball() | far, (0, 0, 1), 90), block(), 0.1) - far
    center, half = torch.zeros(3, 3).double(), torch.full((3, 3), 0.8).double()
    near = gv.Solid(shape).near(center, half)
    Counted.asked = 0
    near.filtered(torch.zeros(7, 3), torch.ones(7, 3))
    assert Counted.asked == 0 and isinstance(near.shape, sdf.SmoothUnion)
    gv.Solid(shape).filtered(torch.zeros(7, 3), torch.ones(7, 3))
    assert Counted.asked > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "shape",
    [
        gv.Mandelbulb(8, iterations=6),
        gv.Mandelbulb(7, iterations=12),
        gv.Julia((-0.2, 0.5, 0.3), 2, iterations=12),
        gv.Mandelbox(2.0, iterations=12),
    ],
    ids=lambda shape: f"{type(shape).__name__} {shape.iterations}",
)
def test_fractals_do_not_depend_on_which_points_come_together(shape, dtype):
    points = random_points(3001, 2.4).to(dtype)
    value, color = shape.surface(points)
    assert torch.equal(shape(points), value) and (value > 0).any() and (value < 0).any()
    assert torch.equal(shape.surface(points[7:1000])[1], color[7:1000])
    assert shape(points[0]).shape == () and torch.equal(shape(points[0]), value[0])
    shape.iteration = Mine(shape.iteration)
    for a, b in zip(shape.surface(points), (value, color), strict=True):
        assert torch.equal(a, b), "a step of one's own is followed alike"


def test_a_repeated_shape_knows_its_box_on_the_device_that_it_is_on():
    shape = gv.sdf.Repeat(gv.sdf.Sphere(1.0), (3.0, 3.0, 0.0), (3, 5, None))
    assert shape.box().tolist() == [[-4, -7, -1], [4, 7, 1]]
    assert shape.to("meta").box().is_meta


def test_a_julia_set_takes_any_three_numbers():
    points = 3 * torch.rand(200, 3) - 1.5
    values = [
        gv.Julia(c)(points)
        for c in ((0.1, 0.2, 0.3), torch.tensor((0.1, 0.2, 0.3), dtype=torch.float64))
    ]
    assert torch.equal(*values) and values[0].unique().numel() > 10
    with pytest.raises(ValueError, match="constant must be three numbers"):
        gv.Julia(())


def test_a_shape_without_end_is_bounded_by_what_it_is_cut_with():
    endless = sdf.moved(sdf.Repeat(sdf.Sphere(0.2), (1, 1, 0)), x=0.5)
    assert endless.box() is None
    assert (endless & sdf.Box((4, 4, 4))).box().tolist() == [[-2, -2, -2], [2, 2, 2]]
    with pytest.raises(ValueError, match="must lie within its cell, it has no box"):
        sdf.Repeat(endless, (1, 1, 1))


LONG = sdf.scaled(sdf.Sphere(), 4, 1, 1)  # its value rises by 1/4 per unit of length along x
CROSSED = sdf.Box((2, 8, 4)) & sdf.Box((8, 2, 4))  # its value is the larger of two distances


@pytest.mark.parametrize(
    "make",
    [
        lambda: sdf.Offset(LONG, 0.5),
        lambda: sdf.Shell(LONG, 0.5),
        lambda: sdf.SmoothUnion(LONG, LONG, 1.0),
        lambda: sdf.Offset(sdf.moved(LONG, 1, 0, 1) | sdf.Sphere(), 0.5),
        lambda: sdf.Offset(sdf.Twist(sdf.rotated(LONG, (0, 0, 1), 30), 0.5) & sdf.Sphere(4), 0.5),
        lambda: sdf.Offset(sdf.Revolution(sdf.Extrusion(LONG, 1.0), 1.0), 0.5),
        lambda: sdf.Offset(sdf.Repeat(LONG, (9, 0, 3), (3, 1, 1)), 0.4),
        lambda: sdf.SmoothIntersection(sdf.Offset(LONG, 1.0), sdf.Sphere(7), 0.1),
        lambda: sdf.Offset(sdf.Extrusion(sdf.Twist(sdf.Torus(), 1.0), 1.0), 0.5),
        lambda: sdf.Offset(sdf.rotated(CROSSED, (0, 0, 1), 45), 0.8),
        lambda: sdf.Offset(sdf.Twist(CROSSED, 0.5), 0.8),
        lambda: sdf.Offset(gv.Mandelbulb(), 0.5),
        lambda: sdf.Shell(gv.Mandelbox(), 1.0),
    ],
)
def test_boxes_hold_what_grows_from_stretched_shapes(make):
    """Where space is stretched, beyond a corner of an intersection, and around a fractal, an offset
    reaches farther in the world than in the value.
    """
    shape, points = make(), random_points(40_000, 14.0)
    low, high = shape.box()
    inside = points[shape(points) < 0]
    assert len(inside) > 20 and ((inside >= low) & (inside <= high)).all()
