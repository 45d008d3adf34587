"""Nodes that are the same as others: they share bricks and children for as long as both live."""

from __future__ import annotations

import functools
import itertools
import random
from concurrent.futures import Future

import pytest
import torch
from helpers import DEVICES
from helpers.producers import Sponge
from helpers.recorded import Frames
from helpers.worlds import meets_menger

import gvtorch as gv

COMPILED = [pytest.param(b, marks=pytest.mark.backend(b)) for b in ("cpp", "cuda")]
LOOK = gv.TransferFunction.preset("gray", 0, 1)
CELL, CELLS = 32, 4  # voxels of a cell, cells along a side


def world(cells: int = CELLS, seed: int = 0) -> gv.Volume:
    """Equal cells, each a few blobs with nothing around, so that borders of bricks agree."""
    random = torch.Generator().manual_seed(seed)
    inner = CELL // 2
    small = torch.rand((1, 1, inner // 4, inner // 4, inner // 4), generator=random)
    blob = torch.nn.functional.interpolate(small, size=(inner,) * 3, mode="trilinear")[0, 0]
    cell = torch.nn.functional.pad(blob, (CELL // 4,) * 6)
    return gv.Volume(cell.repeat(cells, cells, cells))


class Cells(gv.VolumeProducer):
    """A volume of equal cells, all but one of which are aliases of that one."""

    later = False

    def __init__(self, volume: gv.Volume, cell=(0, 0, 0), by_fill: bool = False, **options) -> None:
        super().__init__(volume, **options)
        self.one, self.by_fill = torch.tensor(cell), by_fill
        self.filled = self.asked = 0

    def same(self, nodes):
        """Returns the locs of alias targets, and which nodes are aliases."""
        depth = nodes.layout.depth - (CELL // nodes.layout.brick_size).bit_length() + 1
        loc = nodes.loc.cpu()
        is_cell = (loc[:, 3] == depth) & (loc[:, :3] != self.one).any(1)
        return torch.cat((self.one.expand(len(nodes), 3), loc[:, 3:]), 1), is_cell

    def classify(self, nodes):
        self.asked += len(nodes)
        regions = super().classify(nodes)
        goal, is_alias = self.same(nodes)
        is_alias = is_alias & (regions.kind == gv.Region.DATA) & (not self.by_fill)
        kind = torch.where(is_alias, gv.Region.ALIAS, regions.kind)
        return gv.Regions(kind=kind, constants=regions.constants, ranges=regions.ranges, alias=goal)

    def fill(self, nodes):
        self.filled += len(nodes)
        regions = super().fill(nodes)
        goal, is_alias = self.same(nodes)
        if not (self.by_fill and is_alias.any()):
            return regions
        kind = torch.where(is_alias, gv.Region.ALIAS, gv.Region.DATA)
        answer = gv.Bricks(data=regions.data, kind=kind, alias=goal)
        if not self.later:
            return answer
        future: Future = Future()
        future.set_result(answer)
        return future


def views(size=24):
    middle = CELL * CELLS / 2
    target = (middle,) * 3
    for azimuth, elevation, away in ((20, 30, 2.0), (200, -10, 0.9), (77, 70, 0.4)):
        camera = gv.Camera.orbit(azimuth, elevation, away, None, size, size)
        yield camera
    yield gv.Camera.look_at((target[0], target[1], -9.0), target, (0, 1, 0), 60, size, size)


@pytest.mark.parametrize("backend", COMPILED)
@pytest.mark.parametrize(
    ("loading", "by_fill"), [("straight", False), ("levels", False), ("levels", True)]
)
@pytest.mark.parametrize("cell", [(0, 0, 0), (3, 1, 2)])
def test_equal_cells_are_made_once(backend, loading, by_fill, cell):
    """It takes no more bricks than one cell; pictures equal the resident tree's in every bit."""
    source = Cells(world(), cell, by_fill, threshold=0.0)
    bricks, aliases = bricks_of_all_views(source, loading, DEVICES[backend])
    assert aliases == 63
    assert bricks < bricks_without_aliases(loading, DEVICES[backend]) / 45


@functools.cache
def bricks_without_aliases(loading: str, device: str) -> int:
    source = gv.VolumeProducer(world(), threshold=0.0)
    return bricks_of_all_views(source, loading, device)[0]


@functools.cache
def resident_pictures(device: str) -> list[gv.Picture]:
    tree = gv.N3Tree.from_volume(world(), 4, threshold=0.0, device=device)
    return [gv.render(tree, view, LOOK, lod="finest") for view in views()]


def bricks_of_all_views(source: gv.Producer, loading: str, device: str) -> tuple[int, int]:
    """Returns how many bricks and aliases an engine holds that has drawn all views."""
    options = {"brick_size": 4, "brick_pool": "16 MB", "loading": loading, "device": device}
    with gv.Engine(source, **options) as engine:
        for view, expected in zip(views(), resident_pictures(device), strict=True):
            picture = engine.render(view, LOOK, lod="finest")
            assert picture.stats.converged and torch.equal(picture.color, expected.color)
            assert torch.equal(picture.depth, expected.depth)
            engine.validate()
        return int((engine.cache.bricks.owner_b >= 0).sum()), len(engine.cache.aliases)


@pytest.mark.backend("cpp")
def test_a_target_that_no_ray_sees_is_made_and_stays():
    """The camera sees only one cell; the cell that it is an alias of lies behind the camera."""
    volume = world()
    producer = Cells(volume, (0, 0, 0), threshold=0.0)
    end = CELL * (CELLS - 0.5)
    view = gv.Camera.look_at((end, end, end - 12.0), (end, end, end), (0, 1, 0), 70, 24, 24)
    tree = gv.N3Tree.from_volume(volume, 4, threshold=0.0)
    with gv.Engine(producer, brick_size=4, brick_pool="300 kB", node_pool="12 kB") as engine:
        picture = engine.render(view, LOOK, lod="finest")
        expected = gv.render(tree, view, LOOK, lod="finest")
        assert picture.stats.converged and torch.equal(picture.color, expected.color)
        loc = torch.tensor([[0, 0, 0, 2]])
        assert int(engine.trees["scene"].tree.find(loc)) >= 0
        filled = producer.filled
        for _ in range(5):
            engine.frame(view, LOOK, lod="finest")
        assert producer.filled == filled, "nothing is made again"
        assert int(engine.trees["scene"].tree.find(loc)) >= 0


class Chain(gv.Producer):
    """Eight octants, some of them aliases of others by a table; each fill has its brightness."""

    def __init__(self, same: dict[int, tuple[int, int, int, int]], extent=32) -> None:
        super().__init__(extent)
        self.same, self.filled = same, []

    def classify(self, nodes):
        kind = torch.full((len(nodes),), int(gv.Region.DATA))
        goal = nodes.loc.clone()
        for row, loc in enumerate(nodes.loc.tolist()):
            octant = loc[0] + 2 * loc[1] + 4 * loc[2]
            if loc[3] == 1 and octant in self.same:
                kind[row], goal[row] = gv.Region.ALIAS, torch.tensor(self.same[octant])
        return gv.Regions(kind=kind, alias=goal)

    def fill(self, nodes):
        self.filled += [tuple(loc) for loc in nodes.loc.tolist()]
        octant = nodes.loc[:, :3] >> (nodes.depth - 1).clamp(min=0)[:, None]
        value = (1 + octant @ torch.tensor([1, 2, 4])) / 10.0
        side = nodes.layout.side
        return {"value": value[:, None, None, None].expand(-1, side, side, side).contiguous()}


def at(engine, loc):
    """Returns the brick words of the nodes at locs, -9 where there is no node."""
    node = engine.trees["scene"].tree.find(torch.tensor(loc))
    pointers = engine.cache.nodes.brick_tn.view(-1)
    return torch.where(node >= 0, pointers[node.clamp(min=0)], -9).tolist()


@pytest.mark.backend("cpp")
def test_an_alias_of_an_alias_is_the_last_one():
    chain = Chain({3: (0, 1, 0, 1), 2: (1, 0, 0, 1), 6: (1, 1, 0, 1)})
    with gv.Engine(chain, brick_size=4) as engine:
        picture = engine.render(gv.Camera.orbit(30, 20, 1.2, None, 24, 24), LOOK, lod="finest")
        engine.validate()
        assert picture.stats.converged
        slots = at(engine, [[1, 1, 0, 1], [0, 1, 0, 1], [1, 0, 0, 1], [0, 1, 1, 1]])
        assert len({*slots}) == 1
        octants = {tuple(c >> loc[3] - 1 for c in loc[:3]) for loc in chain.filled if loc[3]}
        assert not octants & {(0, 1, 0), (1, 1, 0), (0, 1, 1)}, "they are never asked for"
        assert len(octants) == 5


@pytest.mark.backend("cpp")
def test_an_alias_may_lie_below_another():
    """Octant 7 is an eighth of octant 6, which is octant 1: so an eighth of octant 1."""
    chain = Chain({7: (1, 2, 3, 2), 6: (1, 0, 0, 1)})
    with gv.Engine(chain, brick_size=4, loading="levels") as engine:
        assert engine.render(next(views()), LOOK, lod="finest").stats.converged
        engine.validate()
        alias, whole, real = at(engine, [[1, 1, 1, 1], [1, 2, 3, 2], [3, 0, 1, 2]])
        assert alias == whole == real >= 0
        assert all(loc[:3] != (1, 1, 1) or loc[3] != 1 for loc in chain.filled)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    "same", [{1: (0, 1, 0, 1), 2: (1, 0, 0, 1)}, {1: (0, 2, 0, 2), 2: (2, 0, 0, 2)}]
)
def test_aliases_that_lead_back_to_themselves_are_asked_for_themselves(same):
    chain = Chain(same)
    with gv.Engine(chain, brick_size=4) as engine:
        assert engine.render(next(views()), LOOK, lod="finest").stats.converged
        engine.validate()
        assert {(1, 0, 0, 1), (0, 1, 0, 1)} <= {*chain.filled} or len(chain.filled) > 100


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("goal", [(1, 0, 0, 1), (2, 1, 0, 2), (5, 2, 1, 3)])
def test_an_alias_of_what_lies_in_it_fails(goal):
    with gv.Engine(Chain({1: goal}), brick_size=4) as engine:
        engine.render(next(views()), LOOK, lod="finest")
        engine.validate()
        assert [failure.message for failure in engine.failures] == [
            f"alias {goal} lies in the node itself, (1, 0, 0, 1)"
        ]


@pytest.mark.backend("cpp")
def test_a_target_in_an_empty_region_is_empty():
    class Half(Chain):
        def classify(self, nodes):
            regions = super().classify(nodes)
            empty = (nodes.depth == 1) & (nodes.loc[:, 0] == 0) & (regions.kind == gv.Region.DATA)
            kind = torch.where(empty, int(gv.Region.EMPTY), regions.kind)
            return gv.Regions(kind=kind, alias=regions.alias)

    with gv.Engine(Half({7: (0, 3, 0, 2)}), brick_size=4) as engine:
        assert engine.render(next(views()), LOOK, lod="finest").stats.converged
        engine.validate()
        assert at(engine, [[1, 1, 1, 1], [0, 0, 0, 1]]) == [-2, -2]


@pytest.mark.backend("cpp")
def test_renewed_content_is_shared_again():
    volume, other = world(), world(seed=5)
    producer = Cells(volume, threshold=0.0)
    view = next(views())
    with gv.Engine(producer, brick_size=4, brick_pool="2 MB") as engine:
        engine.render(view, LOOK, lod="finest")
        producer.__init__(other, threshold=0.0)  # type: ignore[misc]
        producer.prepare(engine.trees["scene"].layout)
        producer.layout = engine.trees["scene"].layout
        producer.version += 1
        picture = engine.render(view, LOOK, lod="finest")
        engine.validate()
        tree = gv.N3Tree.from_volume(other, 4, threshold=0.0)
        expected = gv.render(tree, view, LOOK, lod="finest")
        assert torch.equal(picture.color, expected.color) and len(engine.cache.aliases) == 63


@pytest.mark.backend("cpp")
def test_a_sponge_of_one_tile_is_cut_as_whole_numbers_tell():
    """Menger's, 3^19 cells a side: one tile and one brick, from 10^-8 of the box away."""
    point = torch.tensor([0.25, 0.75, 0.25], dtype=torch.float64)
    size = 3.0**-17  # of the cell in whose hole the eye stands
    low = (point / size).floor() * size
    eye, target = (low + size * torch.tensor(v) for v in ([0.5, 0.47, 0.52], [0.2, 0.85, 0.3]))
    view = gv.Camera.look_at(tuple(eye.tolist()), tuple(target.tolist()), (0, 0, 1), 70, 16, 16)
    rays, sponge = view.rays(), Sponge(19)
    t = torch.tensor(
        [meets_menger(o, d, 19) for o, d in zip(rays.origin, rays.direction, strict=True)]
    )
    shader = gv.TransferFunction.from_points([(0, 0), (20 / 27, 1)])
    with gv.Engine(sponge, brick_size=4, node_pool="20 kB", brick_pool="20 kB") as engine:
        picture = engine.render(view, shader)
        engine.validate()
        assert picture.stats.converged and sponge.classified == 1 + 27 and sponge.filled == 1
    error = (picture.depth.flatten().double() - t).abs() / (rays.cone[:, 1].double() * t)
    print(error.quantile(0.5), error.quantile(0.75), error.max())
    assert (picture.depth < torch.inf).all() and error.quantile(0.75) < 1


class Forest(gv.Producer):
    """Cells of 32^3 voxels: a third are aliases of another tree's root, the others are half empty
    and half made of small copies of it.
    """

    def __init__(self, tree: str | None, goal=(0, 0, 0, 0), branching: int = 2) -> None:
        super().__init__(4 * branching**5, branching=branching)
        self.tree, self.goal, self.filled = tree, goal, 0

    def classify(self, nodes):
        diagonal = nodes.loc[:, :3].sum(1)
        alias = (nodes.depth == 2) & (diagonal % 3 == 0) | (nodes.depth == 3) & (diagonal % 2 == 0)
        kind = torch.where(nodes.depth < 3, gv.Region.DATA, gv.Region.EMPTY)
        kind = torch.where(alias, int(gv.Region.ALIAS), kind)
        goal = torch.tensor(self.goal).expand(len(nodes), 4)
        return gv.Regions(kind=kind, alias=goal, alias_tree=self.tree)

    def fill(self, nodes):
        return {"value": torch.zeros((len(nodes), *(nodes.layout.side,) * 3))}

    def whole(self, plant: gv.VolumeProducer) -> gv.Volume:
        """Returns the scene as a volume."""
        small, large = (level[..., 0].cpu() for level in plant._values["value"][-2:])
        voxels = torch.zeros((128, 128, 128))
        for z, y, x in itertools.product(range(8), repeat=3):
            if (x // 2 + y // 2 + z // 2) % 3 == 0:
                part = large[tuple(slice(c % 2 * 16, c % 2 * 16 + 16) for c in (z, y, x))]
            elif (x + y + z) % 2 == 0:
                part = small
            else:
                continue
            voxels[tuple(slice(c * 16, c * 16 + 16) for c in (z, y, x))] = part
        return gv.Volume(voxels)


@pytest.mark.parametrize("backend", COMPILED)
def test_a_forest_is_made_of_another_producers_tree(backend):
    """Instances cost no bricks, and follow when their target changes."""
    options = {"brick_size": 4, "brick_pool": "4 MB", "device": DEVICES[backend]}
    plant = gv.VolumeProducer(world(1), threshold=0.0)
    forest = Forest("plant")
    unseen = gv.TransferFunction.from_points([(0, 0), (1, 0)])
    shaders = {"plant": unseen, "forest": LOOK}
    with gv.Engine({"plant": plant, "forest": forest}, **options) as engine:
        for _ in range(2):
            tree = gv.N3Tree.from_volume(
                forest.whole(plant), 4, threshold=0.0, device=DEVICES[backend]
            )
            for view in views():
                picture = engine.render(view, shaders, lod="finest")
                expected = gv.render(tree, view, LOOK, lod="finest")
                engine.validate()
                assert picture.stats.converged and not picture.stats.failed
                assert torch.equal(picture.color, expected.color) and picture.alpha.max() > 0.5
            owner = engine.cache.bricks.owner_b
            number = engine.cache.nodes.tree_t[owner[owner >= 0] // 8]
            assert 200 < (number == 0).sum() <= 1 + 8 + 64 + 512 and (number == 1).sum() == 1
            plant.volumes["value"] = world(1, seed=7)
            plant.prepare(engine.trees["plant"].layout)
            plant.changed()


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("forest", "message"),
    [
        (Forest("tree"), "alias_tree must be 'plant' or 'forest', got 'tree'"),
        (Forest("plant", (0, 0, 0, 4)), "alias (0, 0, 0, 4) is no node of tree 'plant'"),
        (Forest("plant", branching=3), "tree 'plant' has N=2, this one N=3"),
        (Forest(None), "root"),
    ],
)
def test_wrong_targets_in_other_trees_are_named(forest, message):
    trees = {"plant": gv.VolumeProducer(world(1)), "forest": forest}
    with gv.Engine(trees, brick_size=4) as engine:
        engine.render(next(views()), LOOK, lod="finest")
        engine.validate()
        messages = [failure.message for failure in engine.failures]
        assert all(message in failure for failure in messages) and (messages or forest.tree is None)


@pytest.mark.backend("cuda")
def test_replays_are_left_to_the_host_while_there_are_aliases():
    volume, view = world(), next(views())
    with gv.Engine(Cells(volume, threshold=0.0), brick_size=4, device="cuda") as engine:
        graph = engine.capture(view, LOOK)
        for _ in range(200):
            picture, stats = graph.replay(view)
            if stats.settle().converged:
                break
        engine.validate()
        assert stats.converged and len(engine.cache.aliases) == 63
    tree = gv.N3Tree.from_volume(volume, 4, threshold=0.0, device="cuda")
    assert torch.equal(picture.color, gv.render(tree, view, LOOK).color)


def flight(seed: int, volume: gv.Volume, tree: gv.N3Tree, device: torch.device) -> tuple[bool, int]:
    """Flies once, with faults and renewals; returns whether its last picture was complete (then it
    equals the resident tree's), and how many tiles and bricks were evicted.
    """
    pick = random.Random(seed)
    cell = tuple(pick.randrange(CELLS) for _ in range(3))
    hold = pick.choice(["voxels", "bricks"])
    producer = Cells(volume, cell, pick.random() < 0.4, threshold=0.0, hold=hold)
    producer.later = pick.random() < 0.5
    options = {
        "brick_pool": pick.choice([20, 40, 150, 600]) * 6**3 * 4,
        "node_pool": pick.choice([12, 30, 100, 1000]) * 8 * 20,
        "load_budget": pick.choice([1, 7, 50, 4096]),
        "loading": pick.choice(["straight", "levels"]),
        "scout_rounds": pick.randrange(3),
    }
    evicted = 0
    with gv.Engine(producer, brick_size=4, device=device, **options) as engine:
        recorded = Frames(engine, next(views(10)), LOOK, 32) if producer.on_host else None
        for _ in range(pick.randrange(5, 40)):
            view = pick.choice([*views(10)])
            if pick.random() < 0.05:
                producer.changed()
            if recorded is not None and pick.random() < 0.2:
                recorded.look_from(view)
                recorded.frame()
                continue
            _, stats = engine.frame(view, LOOK, lod=pick.choice(["auto", "finest"]))
            evicted += sum(stats.evicted.values())
            engine.validate()
        picture = engine.render(view, LOOK, max_frames=120)
        engine.validate()
        assert not engine.failures
        if picture.stats.converged:
            expected = gv.render(tree, view, LOOK)
            assert torch.equal(picture.color, expected.color), seed
            assert torch.equal(picture.depth, expected.depth), seed
        return picture.stats.converged, evicted


@pytest.mark.long
@pytest.mark.parametrize("backend", COMPILED)
def test_random_flights_end_in_the_resident_picture(backend):
    volume, device = world(), DEVICES[backend]
    tree = gv.N3Tree.from_volume(volume, 4, threshold=0.0, device=device)
    ends = [flight(seed, volume, tree, device) for seed in range(16)]
    assert sum(whole for whole, _ in ends) > 7, ends
    assert sum(count for _, count in ends) > 100
