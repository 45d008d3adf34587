"""Coarse levels made from children, for producers that can make only the finest level."""

from __future__ import annotations

from concurrent.futures import Future

import pytest
import torch
from helpers import DEVICES
from helpers.producers import Sponge

import gvtorch as gv
from gvtorch.producers.producer import Layout, Nodes

COMPILED = [pytest.param(b, marks=pytest.mark.backend(b)) for b in ("cpp", "cuda")]
LOOK = gv.TransferFunction.preset("gray", 0, 1)


def noise(shape, dtype=torch.float32, seed=0):
    random = torch.Generator().manual_seed(seed)
    values = torch.rand(shape, generator=random)
    values[: shape[0] // 2, : shape[1] // 3] = 0.0
    return values.to(dtype) if dtype.is_floating_point else (values * 200).to(dtype)


class Finest(gv.VolumeProducer):
    """A volume's producer that can make only the finest level."""

    later = False

    def __init__(self, volume, branching=2, **options):
        super().__init__(volume, branching=branching, **options)
        self.filled: list[tuple[int, ...]] = []

    def fill(self, nodes):
        assert (nodes.depth == nodes.layout.depth).all()
        self.filled += [tuple(loc) for loc in nodes.loc.tolist()]
        answer = super().fill(nodes)
        if not self.later:
            return answer
        future: Future = Future()
        future.set_result(answer)
        return future


def every_brick(producer, layout):
    """Returns by channel (k, z, y, x, c) the bricks of all nodes of each depth in the volume."""
    for depth in range(layout.depth + 1):
        step = layout.branching ** (layout.depth - depth) * layout.brick_size
        grid = [range(-(-n // step)) for n in layout.extent]
        loc = torch.cartesian_prod(*(torch.tensor([*axis]) for axis in grid))
        loc = torch.cat((loc, torch.full((len(loc), 1), depth)), 1)
        answer = producer.fill(Nodes(loc, layout))
        answer = answer.result() if isinstance(answer, Future) else answer
        yield depth, loc, answer.data


@pytest.mark.parametrize(
    ("shape", "branching", "dtypes"),
    [
        ((29, 23, 33), 2, [torch.float32]),
        ((29, 23, 33), 3, [torch.uint8, torch.float16]),
        ((16, 16, 16), 2, [torch.uint16, torch.bfloat16]),
        ((3, 40, 5), 2, [torch.int16]),
    ],
)
@pytest.mark.parametrize("threshold", [None, 0.0])
def test_coarse_levels_are_the_means_of_what_lies_below(shape, branching, dtypes, threshold):
    """They equal, in every bit, the levels that are made from the whole volume."""
    volumes = {str(n): gv.Volume(noise(shape, dtype, n)) for n, dtype in enumerate(dtypes)}
    fine = Finest(volumes, branching, threshold=threshold)
    whole = gv.VolumeProducer(volumes, threshold=threshold, branching=branching)
    producer = gv.FromChildren(fine)
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    for p in (producer, whole):
        p.prepare(layout)
    pairs = zip(every_brick(producer, layout), every_brick(whole, layout), strict=True)
    for (depth, _, actual), (_, _, expected) in pairs:
        for name, rows in expected.items():
            assert actual[name].dtype == rows.dtype
            assert torch.equal(actual[name].double(), rows.double()), depth


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize("later", [False, True])
def test_streamed_is_resident(backend, later):
    volume = gv.Volume(noise((40, 64, 50)))
    fine = Finest(volume, threshold=0.0, hold="bricks")
    fine.later = later
    device = DEVICES[backend]
    tree = gv.N3Tree.from_volume(volume, 4, threshold=0.0, device=device)
    options = {"brick_size": 4, "device": device, "brick_pool": "1 MB"}
    with gv.Engine(gv.FromChildren(fine), **options) as engine:
        for azimuth in (10, 130):
            for away in (0.5, 3.0):
                view = gv.Camera.orbit(azimuth, 20, away, None, 20, 20)
                picture, expected = engine.render(view, LOOK), gv.render(tree, view, LOOK)
                engine.validate()
                assert picture.stats.converged and not engine.failures
                assert torch.equal(picture.color, expected.color)


def test_finest_bricks_are_made_once_for_all_coarse_levels():
    fine = Finest(gv.Volume(noise((32, 32, 32))))
    producer = gv.FromChildren(fine)
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    producer.prepare(layout)
    for depth, _, _ in every_brick(producer, layout):
        if depth == layout.depth - 1:
            break
    assert len(fine.filled) == len({*fine.filled}) > 400


def test_what_is_known_to_be_empty_is_not_made():
    """But what has changed is made."""

    class Ball(gv.Producer):
        filled, value = 0, 1.0

        def classify(self, nodes):
            outside = nodes.center.norm(dim=1) - nodes.radius > 0.5
            return torch.where(outside, gv.Region.EMPTY, gv.Region.DATA)

        def fill(self, nodes):
            self.filled += len(nodes)
            return {"value": self.value * (nodes.positions.norm(dim=-1) < 0.4).float()}

    ball = Ball(64, box=((-1, -1, -1), (1, 1, 1)))
    with gv.Engine(gv.FromChildren(ball), brick_size=8) as engine:
        assert 50 < ball.filled < 300  # of 512
        (root,) = engine.cache.bricks.bricks["value"][:1, 1:-1, 1:-1, 1:-1].mean((1, 2, 3, 4))
        share = 4 / 3 * torch.pi * 0.4**3 / 8
        torch.testing.assert_close(float(root), share, atol=4e-4, rtol=0)
        ball.value = 0.5
        ball.changed()
        picture = engine.render(gv.Camera.orbit(0, 0, 1.0, None, 16, 16), LOOK)
        assert picture.stats.converged
        (root,) = engine.cache.bricks.bricks["value"][:1, 1:-1, 1:-1, 1:-1].mean((1, 2, 3, 4))
        torch.testing.assert_close(float(root), 0.5 * share, atol=2e-4, rtol=0)


def test_a_mixed_batch_is_as_its_parts():
    volume = gv.Volume(noise((32, 32, 32)))
    producer = gv.FromChildren(Finest(volume, threshold=0.0))
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    producer.prepare(layout)
    loc = torch.tensor([[1, 2, 3, 3], [0, 0, 0, 0], [7, 0, 1, 3], [1, 1, 0, 2]])
    both = producer.fill(Nodes(loc, layout)).data["value"]
    for row in range(4):
        alone = producer.fill(Nodes(loc[row : row + 1], layout)).data["value"]
        assert torch.equal(both[row : row + 1], alone)


def root_of(producer):
    """Returns the regions and bricks of a root and its first child."""
    layout = Layout.of(producer, 4, 1, torch.device("cpu"))
    producer.prepare(layout)
    nodes = Nodes(torch.tensor([[0, 0, 0, 0], [0, 0, 0, 1]]), layout)
    return producer.classify(nodes), producer.fill(nodes)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.FromChildren(3), "producer must be a Producer, got int"),
        (lambda: gv.FromChildren(gv.Producer(8), levels=0), "levels must be an int >= 1"),
        (
            lambda: gv.FromChildren(gv.Producer(8, labels={"value": None})),
            "FromChildren: Producer makes labels",
        ),
        (
            lambda: gv.FromChildren(
                gv.OctaveProducer(gv.noise.SplineSum(), 64, box=((0,) * 3, (1,) * 3))
            ),
            "OctaveProducer needs its parents' bricks",
        ),
        (
            lambda: gv.Engine(gv.FromChildren(gv.Producer(1024))),
            "the root of a tree 7 levels deep is made of 2097152 finest bricks; the most is "
            "levels=5",
        ),
        (lambda: root_of(gv.FromChildren(Sponge(2))), "Sponge must answer without alias"),
        (
            lambda: root_of(gv.JoinedProducer({"a": Sponge(2)})),
            "JoinedProducer: producers must answer without alias",
        ),
    ],
)
def test_bad_input_gives_one_clear_line(call, message):
    with pytest.raises(ValueError) as error:
        call()
    assert message in str(error.value) and "\n" not in str(error.value)
