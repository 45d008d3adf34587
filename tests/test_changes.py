"""Content that changes in a part of its box: what lies elsewhere stays in the pools, and the result
is as if the content had always been the new one.
"""

from __future__ import annotations

import pytest
import torch
from helpers.pictures import camera

import gvtorch as gv
from gvtorch.producers import Layout

sdf = gv.sdf
BOX = ((-1.0,) * 3, (1.0,) * 3)
GRAY = gv.TransferFunction.from_points([(0, 0), (1, 0.1)])
SMALL = {"brick_size": 4, "brick_pool": "16 MB"}
ROUGH = {"thickness": 0.1, "frequency": 4.0, "octaves": 2, "box": BOX}


class Bead(sdf.Distance):
    """A ball that rises at the edge of a plate."""

    def __init__(self, time=0.0):
        super().__init__()
        self.number("time", time)

    def forward(self, points):
        x, y, z = points.unbind(-1)
        return torch.stack((x, y + 0.2, z - self.time.to(z)), -1).norm(dim=-1) - 0.15


def ground():
    """Returns what stays: matter beyond x = -0.5, and the plate that the bead sits in."""
    return sdf.Plane((1, 0, 0), -0.5) | sdf.Box((0.1, 0.4, 1.8))


def field(shape, **options):
    return gv.FieldProducer(shape, 64, **{"box": BOX, "threshold": 0.0, **options})


def density(shape):
    return gv.Solid(shape, colors=False)


class Steps(gv.Producer):
    """Two boxes of 8^3 finest voxels in empty space; the second one's value may be set."""

    def __init__(self, value=0.5):
        super().__init__(64)
        self.value = value

    def fill(self, nodes):
        size, total = nodes.voxel_size[:, 0, None, None, None], 0
        for low, value in ((7.5, 1.0), (39.5, self.value)):
            x, y, z = (
                ((u + size / 2).clamp(max=low + 8) - (u - size / 2).clamp(min=low)).clamp(min=0)
                for u in nodes.axes
            )
            total = total + value * x * y * z / size**3
        return {"value": total.float()}

    @property
    def time(self):
        return self.value

    @time.setter
    def time(self, value):
        self.value = value
        self.changed(((39.5,) * 3, (47.5,) * 3))


MADE = {
    "shape": lambda t: field(ground() | Bead(t)),
    "smooth": lambda t: field(density(sdf.SmoothUnion(ground(), Bead(t), 0.1)), threshold=None),
    "cut": lambda t: field(density(ground() - Bead(t))),
    "stack": lambda t: field(gv.stack(a=density(ground() | Bead(t)), b=density(ground()))),
    "blend": lambda t: field(
        gv.blend(density(ground()), density(sdf.Sphere()), density(ground() | Bead(t)))
    ),
    "mask": lambda t: field(gv.mask(density(ground()), density(ground() - Bead(t)))),
    "warp": lambda t: field(gv.warp(density(ground() | Bead(t)), torch.nn.Tanh(), 0.1), samples=1),
    "joined": lambda t: gv.JoinedProducer(
        {
            "moving": field(density(ground() | Bead(t))),
            "still": field(density(ground())),
        }
    ),
    "from children": lambda t: gv.FromChildren(field(density(ground() | Bead(t)))),
    "hypertexture": lambda t: gv.Hypertexture(ground() | Bead(t), 64, **ROUGH),
    "of one's own": Steps,
}


def content(engine):
    """Returns for each node of a tree, by its loc, its region and its voxels."""
    (source,) = engine.trees.values()
    nodes, bricks, contents = engine.cache.nodes, engine.cache.bricks, {}
    tile = (nodes.parent_t >= 0).nonzero()[:, 0]
    node = (tile[:, None] * nodes.nodes_per_tile + torch.arange(nodes.nodes_per_tile)).flatten()
    for index, loc in zip(node.tolist(), source.tree.loc(node).tolist(), strict=True):
        word = int(nodes.brick_tn.view(-1)[index])
        held = [rows.flatten(0, 1)[index] for rows in nodes.constants.values()]
        if word >= 0:
            held += [rows[word] for rows in bricks.bricks.values()]
        contents[tuple(loc)] = (
            min(word, 0),
            held,
            [r.flatten(0, 1)[index] for r in nodes.ranges.values()],
        )
    return contents


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", MADE)
def test_what_lies_elsewhere_stays_and_all_is_as_if_it_had_always_been(name, monkeypatch):
    views = [(camera(24, distance=1.6), {"lod": "finest"}), (camera(16, distance=4), {})]
    locs, (first, second) = [], (0.2, 0.6)
    producer, late = MADE[name](first), MADE[name](second)
    fill = producer.fill
    monkeypatch.setattr(producer, "fill", lambda nodes: (locs.append(nodes.loc), fill(nodes))[1])
    with gv.Engine(producer, **SMALL) as engine, gv.Engine(late, **SMALL) as fresh:
        before = [engine.render(view, GRAY, **options).color for view, options in views]
        seen = []
        begun = torch.cat(locs)
        locs.clear()
        producer.time = second
        for (view, options), old in zip(views, before, strict=True):
            actual, expected = (e.render(view, GRAY, **options) for e in (engine, fresh))
            assert torch.equal(actual.color, expected.color)
            assert torch.equal(actual.depth, expected.depth)
            seen.append(not torch.equal(actual.color, old))
        assert any(seen)
        engine.validate()
        actual_nodes, there = content(engine), content(fresh)
        both = {*actual_nodes} & {*there}
        assert len(both) > 0.9 * len(there)
        for loc in both:
            word, held, ranges = actual_nodes[loc]
            expected_word, expected_held, expected_ranges = there[loc]
            assert word == expected_word or {word, expected_word} <= {0, -1}, loc
            if word == expected_word:
                for e, other in zip(held + ranges, expected_held + expected_ranges, strict=True):
                    assert torch.equal(e, other), loc
    assert 0 < len(torch.cat(locs)) < 0.5 * len(begun)


@pytest.mark.backend("cpp")
def test_a_world_may_become_empty_and_come_back():
    view = camera(16, distance=1.6)
    with gv.Engine(producer := field(density(Bead(0.0))), **SMALL) as engine:
        first = engine.render(view, GRAY)
        for time, seen in ((5.0, False), (0.0, True)):
            producer.time = time
            picture = engine.render(view, GRAY)
            engine.validate()
            assert torch.equal(picture.color, first.color) == seen == bool(picture.alpha.any())


class Failing(Steps):
    """`classify` fails while its value is 0."""

    def classify(self, nodes):
        if self.value == 0 and len(nodes) > 1:
            raise ValueError("no power")
        return super().classify(nodes)


@pytest.mark.backend("cpp")
def test_where_nodes_can_not_be_told_everything_is_asked_for_again():
    view = camera(16, distance=1.6)
    with gv.Engine(producer := Failing(), **SMALL) as engine:
        first = engine.render(view, GRAY)
        producer.time = 0
        assert engine.render(view, GRAY).stats.failed > 0
        engine.validate()
        assert {str(failure).rpartition(": ")[2] for failure in engine.failures} == {"no power"}
        producer.time = 0.5
        again = engine.render(view, GRAY)
        assert torch.equal(again.color, first.color) and not again.stats.failed


def test_where_it_has_changed_is_known_as_far_as_it_was_told():
    first, second = field(density(Bead(0.0))), field(density(Bead(0.3)))
    both, box = gv.JoinedProducer({"a": first, "b": second}), torch.tensor(BOX)
    first.changed(box)
    version = first.version
    second.changed(torch.stack((box, box + 2)))
    assert len(both.changes(0)) == 2 and len(both.changes(version)) == 1
    both.time = 0.5  # their clocks differed
    assert both.changes(version) is None
    version = both.version
    both.time = 0.7
    assert len(both.changes(version)) == 1 and first.changes(version) == second.changes(version)
    for _ in range(99):
        first.changed(box)
    assert both.changes(version) is None, "too many to remember"
    for wrong in (box[0], box.flatten(), "here", box + torch.nan, box.flip(0)):
        with pytest.raises(ValueError, match=r"FieldProducer\.changed: where must be"):
            first.changed(wrong)


@pytest.mark.parametrize("name", ["stack", "blend", "mask", "warp", "smooth"])
def test_what_matters_near_boxes_has_the_same_bits(name):
    """Bricks made with `Field.near`, which drops distant parts, equal those of the whole field."""
    producer = MADE[name](0.2)
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    axis = torch.arange(8)
    positions = torch.cartesian_prod(axis, axis, axis)
    nodes = gv.Nodes(torch.cat((positions, torch.full_like(positions[:, :1], 3)), 1), layout)
    whole, some = producer._evaluate(nodes, producer.field), producer.fill(nodes).data
    for channel, values in whole.items():
        assert torch.equal(values, some[channel]), channel


class Flat(gv.Producer):
    """One value everywhere; whether its range is told may change as well."""

    value, tells = 0.0, True

    def classify(self, nodes):
        ends = torch.full((len(nodes), 2, 1), self.value)
        kind = torch.full((len(nodes),), int(gv.Region.DATA))
        return gv.Regions(kind=kind, ranges={"value": ends} if self.tells else {})

    def fill(self, nodes):
        return torch.full((len(nodes), *(nodes.layout.side,) * 3), self.value)


@pytest.mark.backend("cpp")
def test_a_root_whose_range_is_no_longer_told_is_not_skipped_by_the_old_one():
    producer = Flat(16)
    with gv.Engine(producer, brick_pool="16 MB") as engine:
        assert engine.render(camera(16), GRAY).alpha.max() == 0
        producer.value, producer.tells = 1.0, False
        producer.changed()
        assert engine.render(camera(16), GRAY).alpha.max() > 0.3


@pytest.mark.backend("cpp")
def test_a_change_during_a_renewal_is_not_lost():
    """As another thread declares it, while the engine still makes what had changed before."""

    class Busy(Flat):
        later = None

        def fill(self, nodes):
            bricks = super().fill(nodes)
            if self.later is not None:
                self.value, self.later = self.later, None
                self.changed()
            return bricks

    producer = Busy(16)
    with gv.Engine(producer, brick_pool="16 MB") as engine:
        engine.render(camera(16), GRAY)
        producer.value, producer.later = 0.2, 1.0
        producer.changed()
        engine.frame(camera(16), GRAY)
        assert engine.changed, "and the next frame makes it"
        assert engine.render(camera(16), GRAY).alpha.max() > 0.3 and not engine.changed
