"""Producers of fields: their bricks, regions and ranges."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from helpers.pictures import GRAY, camera
from helpers.shapes import ball, block, nodes_of, random_points

import gvtorch as gv
from gvtorch.fields import Field
from gvtorch.producers import Layout

sdf = gv.sdf


def test_a_solid_holds_the_share_of_each_voxel():
    """Against 10^3 points per voxel: exact where the plane faces an axis, elsewhere to 0.09."""
    producer = gv.FieldProducer(gv.Solid(ball(), colors=False), 32, box=((-1,) * 3, (1,) * 3))
    nodes = nodes_of(producer, 3)
    density = producer.fill(nodes).data["density"][..., 0]
    axis = (torch.arange(10) + 0.5) / 10 - 0.5
    offsets = torch.cartesian_prod(axis, axis, axis) * producer.spacing[0]
    true = torch.stack(
        [(ball()(nodes.positions + offset) < 0).float() for offset in offsets.split(1)]
    ).mean(0)
    error = (density - true).abs()
    assert error.max() < 0.1 and error.mean() < 0.005
    volume = density[:, 1:-1, 1:-1, 1:-1].sum() * producer.spacing[0] ** 3
    assert math.isclose(float(volume), 4 / 3 * math.pi * 0.7**3, rel_tol=5e-3)


class Waves(Field):
    """Two channels."""

    def forward(self, points):
        return {"a": points.sum(-1).sin(), "b": torch.stack((points[..., 0], points[..., 2]), -1)}


@pytest.mark.parametrize("branching", [2, 3])
def test_a_coarse_level_is_the_mean_of_what_lies_below(branching):
    """One level above the finest, exactly the mean of the values in the middles of the voxels
    below; further up, as far as `samples` resolve the field."""
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
            bricks = coarse.fill(nodes).data[name] if depth < 3 else fine.fill(nodes).data[name]
            side = 4 * len(axis)
            grid = bricks.view(*(len(axis),) * 3, 4, 4, 4, -1).permute(0, 3, 1, 4, 2, 5, 6)
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
    """The engine's bricks of the finest level, against a resident tree of the same values."""
    field, box = gv.sdf.Box((1.0, 0.8, 0.6), round=0.2), ((-0.8,) * 3, (0.8,) * 3)
    producer = gv.FieldProducer(gv.Solid(field, colors=False), 32, box=box)
    axis = (torch.arange(32) + 0.5) / 32 * 1.6 - 0.8
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    values = (0.5 - field(torch.stack((x, y, z), -1)) / 0.05).clamp(0, 1)
    volume = gv.Volume(values, (0.05,) * 3, (axis[0].item(),) * 3)
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


def test_infinite_values_fail_and_halves_do_not():
    view, shader = gv.Camera.orbit(width=4, height=4), gv.TransferFunction.preset("gray", 0, 1)
    inner = gv.FieldProducer(Given(lambda p: p[..., 0].half()), 16, box=BOX)
    outer = gv.FieldProducer(Given(lambda p: p[..., 0] / 0), 16, box=BOX)
    with gv.Engine(inner) as engine:
        assert engine.render(view, shader).alpha.any()
    with pytest.raises(gv.ProductionError, match="channel 'value' holds NaN or infinite values"):
        gv.Engine(outer)


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
        (
            lambda: gv.FieldProducer(torch.nn.ModuleList()),
            "FieldProducer: field must be a field, got ModuleList, which has no forward",
        ),
        (
            lambda: gv.FieldProducer(torch.nn.Linear(2, 1), box=BOX),
            "FieldProducer: field Linear failed: RuntimeError: mat1 and mat2 shapes cannot be mult",
        ),
        (lambda: gv.FieldProducer(Waves()), "box must be given: the field does not say"),
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
        (lambda: gv.FieldProducer(Waves(), box=BOX, threshold={"c": 1}), "unknown channel 'c'; "),
        (lambda: gv.FieldProducer(Waves(), box=BOX, dtype=torch.int8), "dtype must be float32 or"),
    ],
)
def test_bad_fields_are_named(call, message):
    with pytest.raises(ValueError) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)


class Odd(sdf.Distance):
    """Returns a wrong value, given as an option, from one of its methods."""

    def __init__(self, method, answer):
        super().__init__()
        self.__dict__[method] = answer

    def forward(self, points):
        return points.norm(dim=-1) - 0.5


@pytest.mark.parametrize(
    ("method", "answer", "message"),
    [
        ("alike", lambda c, h: c[:1, 0], "Odd.alike: must give (8,) int64 numbers, got (1,) float"),
        ("alike", lambda c, h: 0, "Odd.alike: must give (8,) int64 numbers, got int"),
        ("near", lambda c, h: 3, "Odd.near: answer must be a Field, got int"),
        ("bounds", lambda c, h: c[0], "Odd.bounds: 'value' must be two tensors, low and high"),
        ("bounds", lambda c, h: (c, c), "'value' must be (8,) or (8, 1) each, got (8, 3) float64"),
        ("forward", lambda p: p, "shape Odd must give (8, 10, 10, 10) distances at (8, 10, 10, 10"),
    ],
)
def test_what_a_shape_tells_wrongly_is_named(method, answer, message):
    odd = Odd(method, answer)
    rough = gv.Hypertexture(odd, 16, thickness=0.1, box=BOX)
    layout = Layout.of(rough, 8, 1, torch.device("cpu"))
    rough.prepare(layout)
    positions = torch.cartesian_prod(*(torch.arange(2),) * 3)
    nodes = gv.Nodes(torch.cat((positions, torch.ones_like(positions[:, :1])), 1), layout)
    with pytest.raises(ValueError) as caught:
        (rough.classify if method == "bounds" else rough.fill)(nodes)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("error", [MemoryError, torch.OutOfMemoryError])
def test_memory_that_is_short_is_no_fault_of_a_field(error):
    def forward(points):
        raise error("no more")

    with pytest.raises(error, match="no more"):
        gv.FieldProducer(Given(forward), box=BOX)


class Torn(gv.Field):
    """Fails beyond a position, or in its bounds of boxes, with a message of two lines."""

    def __init__(self, end, bounded=False):
        super().__init__()
        self.end, self.bounded = end, bounded

    def forward(self, points):
        if (points[..., 0] > self.end).any():
            raise RuntimeError("torn\nin two")
        return points[..., 0]

    def bounds(self, center, half):
        if self.bounded:
            raise RuntimeError("torn\nin two")


TORN = "FieldProducer: field Torn failed: RuntimeError: torn in two"


@pytest.mark.parametrize("torn", [Torn(0.3), Torn(9, bounded=True)])
def test_a_root_that_a_field_can_not_make_is_one_line(torn):
    with pytest.raises(gv.ProductionError) as caught:
        gv.Engine(gv.FieldProducer(torn, 64, box=BOX))
    assert str(caught.value) == f"Engine: the root of tree 'scene' can't be made: {TORN}"
    assert isinstance(caught.value.__cause__.__cause__, RuntimeError)


@pytest.mark.backend("cpp")
def test_a_brick_that_a_field_can_not_make_is_one_line():
    producer = gv.FieldProducer(Torn(9), 64, box=BOX)
    with gv.Engine(producer, strict=True) as engine:
        producer.field.end = 0.9
        with pytest.raises(gv.ProductionError) as caught:
            engine.render(camera(24), GRAY)
        assert str(caught.value).endswith(TORN) and str(engine.failures[0]).endswith(TORN)
    assert isinstance(caught.value.__cause__.__cause__, RuntimeError)


@pytest.mark.parametrize("change", ["half", "bfloat16", "float", "double"])
def test_a_net_may_change_its_dtype_around_fields(change):
    """Shapes stay where they are, in every bit; layers of the net follow."""
    turned = sdf.rotated(sdf.Box((0.5, 0.3, 0.2)), (0, 0, 1), 0.3)

    def net() -> torch.nn.ModuleDict:
        producer = gv.FieldProducer(turned - sdf.Sphere(0.3), 18, branching=3)
        return torch.nn.ModuleDict(
            {"world": copy.deepcopy(producer), "head": torch.nn.Linear(3, 3)}
        )

    def picture(producer: gv.Producer) -> torch.Tensor:
        with gv.Engine(producer) as engine:
            return engine.render(camera(8, distance=1.3), GRAY).color

    changed = getattr(net(), change)()
    assert changed["head"].weight.dtype == getattr(torch.ones(1), change)().dtype
    assert torch.equal(picture(changed["world"]), picture(net()["world"]))
    assert all(buffer.is_meta for buffer in changed.to("meta").buffers())


@pytest.mark.parametrize("layer", [torch.nn.BatchNorm1d(3), torch.nn.Dropout(0.5)])
def test_a_network_in_training_mode_is_refused_and_left_as_it_is(layer):
    """Its values would depend on which voxels are computed together, or on chance."""

    class Network(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = copy.deepcopy(layer)

        def forward(self, points):
            return self.layer(points.reshape(-1, 3)).sum(1).sigmoid().view(points.shape[:-1])

    network = Network()
    state = copy.deepcopy(network.state_dict())
    producer = gv.FieldProducer(network, 16, box=BOX)
    assert network.layer.training and str(network.state_dict()) == str(state)
    name = type(layer).__name__
    with pytest.raises(gv.ProductionError, match=f"holds a {name} in training mode.* call eval"):
        gv.Engine(producer)
    network.eval()
    with gv.Engine(producer) as engine:
        assert engine.render(camera(4, distance=1.3), GRAY).stats.failed == 0
        network.train()
        engine.render(camera(24, distance=1.3), GRAY)
        assert "call eval" in str(engine.failures[0])
    assert str(network.state_dict()) == str(state)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", [torch.float32, torch.uint8])
def test_nan_of_a_field_costs_its_bricks_alone(dtype):
    """Positions with x > 1/2 give NaN: their bricks are named, the others are drawn."""

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


def test_integers_that_are_not_finite_fail_beside_another_channel_too():
    field = Given(lambda points: points[..., 0].clamp(0, 1))
    torn = gv.FieldProducer(field, 64, box=BOX, channels={"value": gv.Channel(torch.uint8)})
    whole = gv.FieldProducer(field, 64, box=BOX)
    field.function = lambda points: torch.where(points[..., 0] > 0.6, math.nan, 0.5)
    nodes = nodes_of(torn, 1)
    alone, joined = torn.fill(nodes), gv.JoinedProducer({"a": torn, "b": whole}).fill(nodes)
    assert alone.kind.unique().tolist() == [-1, gv.Region.DATA]
    assert torch.equal(joined.kind, alone.kind)


class Bounded(Field):
    """A field that returns the interval it is given."""

    def __init__(self, interval, box=None):
        super().__init__()
        self.interval, self.corners = interval, box

    def forward(self, points):
        return points[..., 0]

    def bounds(self, center, half):
        return self.interval(center[:, 0])

    def box(self):
        return self.corners


@pytest.mark.parametrize(
    ("interval", "message"),
    [
        (lambda x: (x, x * math.nan), "'value' must be low <= high everywhere, and not NaN"),
        (lambda x: (x + 1, x), "'value' must be low <= high everywhere, and not NaN"),
        (lambda x: (x[:0], x[:0]), "'value' must be (8,) or (8, 1) each, got (0,)"),
        (lambda x: (x, x, x), "'value' must be two tensors, low and high, got 3 items"),
        (lambda x: x, "'value' must be two tensors, low and high, got Tensor"),
        (lambda x: {"value": (0, 1)}, "'value' must be two tensors, low and high, got 2 items"),
    ],
)
def test_bad_intervals_are_named(interval, message):
    producer = gv.FieldProducer(Bounded(interval), 64, box=BOX)
    with pytest.raises(ValueError) as caught:
        producer.classify(nodes_of(producer, 1))
    assert str(caught.value).startswith("Bounded.bounds: ") and message in str(caught.value)
    with pytest.raises(gv.ProductionError, match=r"Bounded\.bounds: 'value' must be") as error:
        gv.Engine(producer)
    assert "\n" not in str(error.value)


def test_what_is_unknown_is_no_error():
    """Infinite intervals are valid but state nothing; infinite boxes must be replaced."""
    unknown = gv.FieldProducer(Bounded(lambda x: (x - math.inf, x + math.inf)), 64, box=BOX)
    assert (unknown.classify(nodes_of(unknown, 1)).kind == gv.Region.DATA).all()
    for box in (torch.full((2, 3), math.nan), torch.tensor([[-math.inf] * 3, [1.0] * 3])):
        with pytest.raises(ValueError, match="box must be given: the field does not say where"):
            gv.FieldProducer(Bounded(lambda x: None, box), 64)


@pytest.mark.long
def test_joined_bricks_compile_whole():
    parts = {"a": sdf.Sphere(0.7), "b": sdf.Box()}
    fields = {name: gv.Solid(shape, colors=False) for name, shape in parts.items()}
    joined = gv.JoinedProducer({n: gv.FieldProducer(f, 32, box=BOX) for n, f in fields.items()})
    nodes = nodes_of(joined, 1)
    expected = joined.fill(nodes).data
    compiled = torch.compile(joined.fill, fullgraph=True, dynamic=False, backend="eager")
    for name, rows in compiled(nodes).data.items():
        assert torch.equal(rows, expected[name])


@pytest.mark.parametrize("colors", [False, True])
def test_producers_of_fields_compile_whole(colors):
    """Nothing breaks the graph: neither gradients nor intervals read values on the host."""
    shape = sdf.SmoothUnion(ball(), block(), 0.2) - sdf.Sphere(0.4)
    producer = gv.FieldProducer(gv.Solid(shape, colors=colors), 64)
    nodes = nodes_of(producer, 2)

    def ask(loc):
        requested = gv.Nodes(loc, nodes.layout)
        regions = producer.classify(requested)
        return producer.fill(requested).data, regions.kind, regions.ranges

    expected = ask(nodes.loc)  # the layout caches what it makes
    compiled = torch.compile(ask, fullgraph=True, dynamic=False, backend="aot_eager")
    data, kind, ranges = compiled(nodes.loc)
    assert torch.equal(kind, expected[1])
    for name, rows in expected[0].items():
        assert torch.equal(data[name], rows) and torch.equal(ranges[name], expected[2][name])


def test_values_at_points_need_no_engine():
    producer, points = gv.FieldProducer(Waves(), box=BOX), random_points(10)
    values = producer.at(points)
    assert torch.equal(values["a"][:, 0], points.sum(-1).sin()) and values["b"].shape == (10, 2)


def test_deep_voxels_are_told_apart():
    """2^33 voxels a side: positions are float64, and values those of the field there."""
    bulb = gv.Mandelbulb(8, iterations=20)
    producer = gv.FieldProducer(bulb, 2**33)
    assert producer.dtype == torch.float64
    assert gv.FieldProducer(bulb, 2**16).dtype == torch.float32
    layout = Layout.of(producer, 8, 1, torch.device("cpu"))
    directions = torch.nn.functional.normalize(random_points(400), dim=1)
    near, far = torch.zeros(400, 1).double(), torch.full((400, 1), 1.3).double()
    for _ in range(50):  # bisects to the surface: `middle` is inside, the end outside
        middle = (near + far) / 2
        inside = bulb(directions * middle)[:, None] < 0
        near, far = torch.where(inside, middle, near), torch.where(inside, far, middle)
    points = directions * near
    voxel = ((points - layout.origin_3) / layout.spacing_3).floor().to(torch.int64)
    depth = torch.full_like(voxel[:, :1], layout.depth)
    nodes = gv.Nodes(torch.cat((voxel // 8, depth), 1), layout)
    rgba = producer.fill(nodes).data["rgba"]
    across = (rgba[:, :, :, 1:, 3] - rgba[:, :, :, :-1, 3]).abs().amax((1, 2, 3))
    assert (across > 0).double().mean() > 0.3, "bricks of 2e-9 of the box see the surface"
    positions = nodes.center[:, None, None, None] + nodes.local_positions
    side = nodes.voxel_size[:, :1, None, None]
    expected = (0.5 - bulb(positions) / side).clamp(0, 1)
    assert (rgba[..., 3] - expected).abs().max() < 1e-3
    empty = producer.classify(nodes).kind == gv.Region.EMPTY
    assert not rgba[empty].any()
