"""Fields made of fields, values that change with time, and values at points without an engine."""

from __future__ import annotations

import pytest
import torch
from helpers.pictures import GRAY, camera

import gvtorch as gv
from gvtorch.fields import Field
from gvtorch.producers import Layout

BOX = ((-1, -1, -1), (1, 1, 1))


class Ramp(Field):
    """Rises along x, from 0 at -1 to 1 at 1, clamped to a part of that range."""

    def __init__(self, low=0.0, high=1.0):
        super().__init__()
        self.low, self.high = low, high

    def forward(self, points):
        return ((points[..., 0] + 1) / 2).clamp(self.low, self.high)

    def bounds(self, center, half):
        return self(center - half), self(center + half)


class Pulse(Field):
    """A ball that grows with time."""

    def __init__(self):
        super().__init__()
        self.number("time", 0.5)

    def forward(self, points):
        return (self.time - points.norm(dim=-1)).clamp(min=0)

    def bounds(self, center, half):
        far = center.norm(dim=1)
        reach = half.norm(dim=1)
        return (self.time - far - reach).clamp(min=0), (self.time - far + reach).clamp(min=0)


class Sway(torch.nn.Module):
    def forward(self, points):
        return 0.3 * (5 * points.flip(-1)).sin()


def random_points(count=4000):
    generator = torch.Generator().manual_seed(5)
    return 2.4 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1.2


FIELDS = {
    "warp": lambda: gv.warp(Pulse(), Sway(), max_offset=0.2),
    "blend": lambda: gv.blend(Ramp(0.2, 0.4), Pulse(), Ramp()),
    "mask": lambda: gv.mask(Pulse(), Ramp()),
    "stack": lambda: gv.stack(a=Ramp(), b=Pulse(), rock=gv.stack(c=Ramp(0.1, 0.3))),
}


@pytest.mark.parametrize("name", FIELDS)
def test_intervals_of_combinations_hold(name):
    field, generator = FIELDS[name](), torch.Generator().manual_seed(6)
    center = random_points(20_000)
    half = 10 ** (-2 * torch.rand(20_000, 1, generator=generator).double()) * torch.ones(3)
    offsets = 2 * torch.rand(20_000, 30, 3, generator=generator).double() - 1
    values, bounds = field(center[:, None] + half[:, None] * offsets), field.bounds(center, half)
    if isinstance(values, torch.Tensor):
        values, bounds = {"value": values}, {"value": bounds}
    assert {*values} == {*bounds}
    for channel, rows in values.items():
        low, high = bounds[channel]
        assert (rows >= low[:, None] - 1e-12).all() and (rows <= high[:, None] + 1e-12).all()
        assert ((high - low) < 0.5).double().mean() > 0.2


def test_combinations_are_what_their_words_say():
    points = random_points()
    ramp, pulse = Ramp()(points), Pulse()(points)
    assert torch.allclose(gv.mask(Pulse(), Ramp())(points), ramp * pulse)
    blend = gv.blend(Ramp(0.2, 0.4), Pulse(), Ramp())(points)
    assert torch.allclose(blend, (1 - ramp) * Ramp(0.2, 0.4)(points) + ramp * pulse)
    sway = Sway()(points)
    sway = sway * (0.2 / sway.norm(dim=1, keepdim=True)).clamp(max=1)
    assert torch.allclose(gv.warp(Pulse(), Sway(), max_offset=0.2)(points), Pulse()(points + sway))
    stack = gv.stack(a=Ramp(), rock=gv.stack(c=Ramp(0.1, 0.3)))(points)
    assert [*stack] == ["a", "rock_c"] and torch.equal(stack["a"], ramp)
    shape = gv.Painted(gv.sdf.Sphere(), Sway())
    assert torch.equal(shape.surface(points)[1], Sway()(points).clamp(0, 1))


def test_a_mask_hides_what_it_hides():
    """A plain module masked by a solid: it is averaged where the solid is, and only there."""
    network = torch.nn.Linear(3, 2)
    field = gv.mask(network, gv.Solid(gv.sdf.Sphere(0.7), colors=False))
    producer = gv.FieldProducer(field, 32, box=BOX, threshold=0)
    axis = torch.arange(8)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    nodes = gv.Nodes(torch.stack((x, y, z, torch.full_like(x, 3)), -1).flatten(0, 2), layout)
    kind, data = producer.classify(nodes).kind, producer.fill(nodes).data["value"]
    inside = (0.5 - (nodes.positions.norm(dim=-1) - 0.7) * 16).clamp(0, 1)[..., None]
    assert torch.allclose(data, network(nodes.positions) * inside, atol=1e-5)
    assert not data[kind == gv.Region.EMPTY].any() and (kind == gv.Region.EMPTY).sum() > 200
    shape = gv.FieldProducer(gv.mask(network, gv.sdf.Sphere(0.7)), 32, box=BOX, threshold=0)
    assert torch.equal(shape.fill(nodes).data["value"], data), "a distance stands for its solid"
    with pytest.raises(ValueError, match="takes no field with a margin"):
        gv.mask(network, gv.Solid(gv.Mandelbulb()))
    with pytest.raises(ValueError, match="needs one channel, got rgba, normal"):
        gv.mask(network, gv.Solid(gv.sdf.Sphere()))(torch.zeros(2, 3))


@pytest.mark.backend("cpp")
def test_another_time_is_made_anew_and_is_as_if_it_had_always_been():
    view = camera(32, distance=1.6)
    producer = gv.FieldProducer(Pulse(), 64, box=BOX, threshold=0.0)
    with gv.Engine(producer, brick_size=4) as engine:
        first = engine.render(view, GRAY)
        assert producer.time == 0.5 and not engine.changed
        producer.time = 0.9
        assert engine.changed
        second = engine.render(view, GRAY)
        engine.validate()
        assert not engine.changed and second.stats.produced["bricks"] > 0
        producer.time = 0.5
        third = engine.render(view, GRAY)
        engine.validate()
        again = engine.render(view, GRAY)
        assert not any(again.stats.produced.values())
    late = gv.FieldProducer(Pulse(), 64, box=BOX, threshold=0.0)
    late.time = 0.9
    with gv.Engine(late, brick_size=4) as engine:
        assert torch.equal(engine.render(view, GRAY).color, second.color)
    assert torch.equal(first.color, third.color) and not torch.equal(first.color, second.color)


@pytest.mark.backend("cpp")
def test_only_the_tree_that_changed_is_made_anew():
    """Two trees in one pool: what the unchanged one holds stays."""
    still = gv.FieldProducer(Ramp(-9, 9), 32, box=((2, -1, -1), (4, 1, 1)))
    moving = gv.FieldProducer(Pulse(), 32, box=BOX, threshold=0.0)
    view = gv.Camera.look_at((1.5, 0, 9), (1.5, 0, 0), (0, 1, 0), 40, 32, 32)
    with gv.Engine({"still": still, "moving": moving}, brick_size=4) as engine:
        engine.render(view, GRAY, lod="finest")
        pool = engine.cache.nodes
        before = int(((pool.tree_t == 0) & (pool.parent_t >= 0)).sum())
        moving.time = 0.8
        engine.frame(view, GRAY)
        engine.validate()
        assert int(((pool.tree_t == 0) & (pool.parent_t >= 0)).sum()) == before > 0
        assert engine.render(view, GRAY).stats.converged


@pytest.mark.parametrize(
    ("make", "context"),
    [
        (lambda p: gv.stack(a=Ramp(), b=p), "Stack: b"),
        (lambda p: gv.blend(p, Ramp(), Ramp()), "Blend: first"),
        (lambda p: gv.blend(Ramp(), p, Ramp()), "Blend: second"),
        (lambda p: gv.blend(Ramp(), Ramp(), p), "Blend: mask"),
        (lambda p: gv.mask(p, Ramp()), "Mask: field"),
        (lambda p: gv.mask(Ramp(), p), "Mask: mask"),
        (lambda p: gv.warp(p, Sway(), max_offset=0.2), "Warp: field"),
        (lambda p: gv.warp(Ramp(), p, max_offset=0.2), "Warp: offset"),
        (lambda p: gv.Painted(gv.sdf.Sphere(), p), "Painted: colors"),
        (lambda p: gv.FieldProducer(p, 32, box=BOX), "FieldProducer: field"),
    ],
)
def test_a_producer_is_no_field(make, context):
    with pytest.raises(ValueError, match=f"^{context} must be a field, got FieldProducer") as error:
        make(gv.FieldProducer(Ramp(), 32, box=BOX))
    assert "gv.JoinedProducer" in str(error.value) and "\n" not in str(error.value)


class Growing(gv.sdf.Sphere):
    """A ball whose radius is its time."""

    def __init__(self):
        super().__init__(0.5)
        self.number("time", 0.5)

    def forward(self, points):
        return points.norm(dim=-1) - self.time


def pulse():
    return gv.FieldProducer(Pulse(), 32, box=BOX, threshold=0.0)


CLOCKS = {
    "joined": lambda: gv.JoinedProducer({"value": pulse()}),
    "from children": lambda: gv.FromChildren(pulse()),
    "of joined": lambda: gv.FromChildren(gv.JoinedProducer({"value": pulse()})),
    "hypertexture": lambda: gv.Hypertexture(Growing(), 32, thickness=0.2, box=BOX),
}


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", CLOCKS)
def test_time_is_that_of_the_parts(name):
    view, seen = camera(32, distance=1.6), []
    with gv.Engine(producer := CLOCKS[name](), brick_size=4) as engine:
        for time in (0.5, 0.9):
            producer.time = time
            seen.append(engine.render(view, GRAY).color)
            engine.validate()
        assert producer.time == 0.9 and not engine.changed
    late = CLOCKS[name]()
    late.time = 0.9
    with gv.Engine(late, brick_size=4) as engine:
        assert torch.equal(engine.render(view, GRAY).color, seen[1])
    assert not torch.equal(*seen)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("change", ["time", "changed"])
def test_a_picture_of_joined_producers_follows_each_of_them(change):
    view, moving = camera(32, distance=1.6), pulse()
    still = gv.FieldProducer(Ramp(), 32, box=BOX)
    with gv.Engine(gv.JoinedProducer({"moving": moving, "still": still}), brick_size=4) as engine:
        first = engine.render(view, GRAY).color
        if change == "time":
            moving.time = 0.9
        else:
            moving.field.time.fill_(0.9)
            moving.changed()
        assert engine.changed
        assert not torch.equal(engine.render(view, GRAY).color, first)
        still.changed()
        assert engine.changed


@pytest.mark.parametrize(
    "make",
    [
        lambda: gv.FieldProducer(Ramp(), 32, box=BOX),
        lambda: gv.JoinedProducer({"a": gv.FieldProducer(Ramp(), 32, box=BOX)}),
        lambda: gv.FromChildren(gv.FieldProducer(Ramp(), 32, box=BOX)),
        lambda: gv.Hypertexture(gv.sdf.Sphere(), 32, thickness=0.2),
        lambda: gv.PointProducer(torch.rand(9, 3)),
    ],
)
def test_a_producer_without_a_time_says_so(make):
    producer = make()
    kind = type(producer).__name__
    with pytest.raises(AttributeError, match=f"^{kind}: no part of it keeps a number 'time'$"):
        producer.time = 1.0
    assert not hasattr(producer, "time") and producer.version == 0


def test_producers_are_joined_by_name():
    with pytest.raises(ValueError, match="producers must be producers by name, got a list"):
        gv.JoinedProducer([pulse()])


def test_a_time_is_a_number():
    with pytest.raises(ValueError, match="time must be finite"):
        gv.FieldProducer(Pulse(), 32, box=BOX).time = float("nan")


def test_a_network_becomes_a_producer():
    """Any module can: here one whose values at the voxels' centres are known."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2))
    producer = gv.FieldProducer(network, 16, box=BOX, samples=1)
    assert producer.channels == {"value": gv.Channel(torch.float32, 2)}
    points = random_points(50).float()
    assert torch.equal(producer.at(points)["value"], network(points))


class Watching(torch.nn.Module):
    """A network that notes whether gradients by its weights are recorded."""

    def __init__(self):
        super().__init__()
        self.network, self.recorded = torch.nn.Linear(3, 1), set()

    def forward(self, points):
        values = self.network(points)
        self.recorded.add(values.requires_grad)
        return values


def test_an_engine_records_no_gradients_of_a_producer():
    """They would take several times the memory of its bricks; what trains it calls `at`."""
    producer = gv.FieldProducer(field := Watching(), 32, box=BOX, samples=1)
    shader = gv.TransferFunction.preset("gray", 0, 1)
    with gv.Engine(producer) as engine:
        engine.frame(camera := gv.Camera.orbit(width=8, height=8), shader)
        engine.render(camera, shader)
        producer.changed()
        engine.frame(camera, shader)
    assert field.recorded == {False}
    producer.at(random_points(5).float())["value"].sum().backward()
    assert field.network.weight.grad is not None


@pytest.mark.backend("cpp")
def test_producers_of_any_kind_tell_values_at_points(blobs):
    """Trilinear between voxels, equal to a dense interpolation by torch."""
    points = torch.rand(500, 3).double() * 60 - 5
    producer = gv.VolumeProducer(blobs)
    values = producer.at(points)["value"][:, 0]
    data = blobs.data[..., 0].float()
    z, y, x = data.shape
    size = torch.tensor((x, y, z)).double()
    index = (points - torch.tensor(blobs.origin)) / torch.tensor(blobs.spacing)
    index = torch.minimum(index.clamp(min=0), size - 1)
    grid = (2 * index / (size - 1) - 1).float().view(1, 1, 1, -1, 3)
    expected = torch.nn.functional.grid_sample(data[None, None], grid, align_corners=True)
    assert (values - expected.flatten()).abs().max() < 1e-3 * data.abs().max()
    with gv.Engine(producer, brick_size=8) as engine:
        assert torch.allclose(producer.at(points)["value"][:, 0], values, atol=1e-4)
        assert engine.trees


def test_values_at_points_end_where_bricks_without_a_border_do():
    ramp = torch.arange(16.0).expand(16, 16, 16).contiguous()
    producer = gv.VolumeProducer(gv.Volume(ramp * ramp))
    points = torch.tensor([[3.25, 0, 9], [7.25, 9, 0], [7.75, 0, 0], [15, 3, 3]])
    with gv.Engine(producer, brick_size=8, border=0):
        assert producer.at(points)["value"][:, 0].tolist() == [10.75, 49, 64, 225]
    assert producer.at(points)["value"][:, 0].tolist() == [10.75, 52.75, 60.25, 225]


@pytest.mark.parametrize(
    "make",
    [
        lambda: gv.PointProducer(torch.rand(9, 3), extent=16),
        lambda: gv.FieldProducer(gv.sdf.Sphere(), 16),
        lambda: gv.Hypertexture(gv.sdf.Sphere(), 16, thickness=0.1),
    ],
)
def test_points_to_look_at_are_checked(make):
    producer = make()
    single = producer.at(torch.zeros(3))
    many = producer.at(torch.zeros(2, 3))
    for name, values in single.items():
        assert values.dim() == 1 and torch.equal(values, many[name][1])
        assert values.dtype == many[name].dtype
    for points, message in (
        ([0.0, 0.0, 0.0], "points must be a Tensor, got list"),
        (torch.zeros(6), r"points must be (..., 3)"),
        (torch.full((2, 3), torch.nan), "points must be finite"),
    ):
        with pytest.raises(ValueError) as caught:
            producer.at(points)
        assert message in str(caught.value)


def test_wider_nodes_are_the_same_voxels_and_more():
    producer = gv.FieldProducer(Ramp(), 32, box=BOX)
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    nodes = gv.Nodes(torch.tensor([[0, 0, 0, 0], [3, 1, 2, 2], [7, 7, 0, 3]]), layout)
    wide = nodes.wider(2)
    assert wide.positions.shape == (3, 10, 10, 10, 3)
    assert torch.equal(wide.positions[:, 2:-2, 2:-2, 2:-2], nodes.positions)
    assert nodes.wider(2).layout is wide.layout and nodes.wider(0).layout is layout


class Uniform(gv.Producer):
    """Voxels of 9, but every other brick is CONSTANT 3, or EMPTY, whatever its voxels are."""

    kind = gv.Region.CONSTANT
    dtype = torch.float32

    def fill(self, nodes):
        data = torch.full((len(nodes), *(nodes.layout.side,) * 3), 9).to(self.dtype)
        kind = torch.where(nodes.loc[:, 0] % 2 == 0, self.kind, gv.Region.DATA)
        constants = {"value": torch.full((len(nodes), 1), 3).to(self.dtype)}
        answer = {"constants": constants} if self.kind is gv.Region.CONSTANT else {}
        return gv.Bricks(data={"value": data}, kind=kind, **answer)


@pytest.mark.parametrize("dtype", [torch.float32, torch.uint16])
@pytest.mark.parametrize(("kind", "value"), [("CONSTANT", 3.0), ("EMPTY", 0.0)])
def test_voxels_of_a_brick_that_turns_out_uniform_do_not_count(dtype, kind, value):
    """Neither next to another channel's, nor in coarse levels, nor at points."""
    uniform = Uniform(32, channels={"value": gv.Channel(dtype)})
    uniform.kind, uniform.dtype = gv.Region[kind], dtype
    points = torch.tensor([[3.0, 3, 3], [11.0, 3, 3]])
    other = gv.VolumeProducer(gv.Volume(torch.rand(32, 32, 32, 1)))
    joined = gv.JoinedProducer({"a": uniform, "b": other})
    for producer, name in ((uniform, "value"), (joined, "a")):
        assert producer.at(points)[name][:, 0].tolist() == [value, 9.0]
        assert producer.at(points[1:])[name].item() == 9.0, "where no brick is uniform"
    children = gv.FromChildren(uniform)
    layout = Layout.of(children, 8, 1, torch.device("cpu"))
    coarse = children.bricks_at(torch.tensor([[0, 0, 0, 1]]), layout)["value"]
    assert coarse[0, 4, 4, [3, 6], 0].tolist() == [value, 9.0]


def test_points_in_a_brick_that_is_an_alias_are_refused():
    producer = Uniform(32)
    producer.kind = gv.Region.ALIAS
    with pytest.raises(ValueError, match=r"^Uniform.at: a brick is not finite, or an alias$"):
        producer.at(torch.tensor([[3.0, 3, 3]]))
