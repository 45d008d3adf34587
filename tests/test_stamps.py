"""Usage stamps of tiles: rays stamp the last tile of each descent, `mark_ancestors` those on the
way. Together they are all tiles that a ray passed through.
"""

from __future__ import annotations

import pytest
import torch
from helpers import DEVICES
from helpers.producers import Ball, Checked
from helpers.rays import camera_rays
from helpers.traces import SHADER
from helpers.trees import forget, on, share

import gvtorch as gv
from gvtorch.ops.reference.tree import Tree

GRAY = gv.TransferFunction.preset("gray", 0, 1)


@pytest.fixture
def passed(monkeypatch) -> set[int]:
    """Every tile on the way from the root to a node that a ray of the twin finds."""
    tiles: set[int] = set()
    descend = Tree.descend

    def recorded(self, position_r3, wanted_r, hides):
        found = descend(self, position_r3, wanted_r, hides)
        n, node = self.levels.branching, torch.full_like(found.node, self.arguments.root)
        for level in range(int(found.depth.max()) + 1):
            here, depth = found.depth >= level, torch.full_like(found.depth, level)
            x, y, z = (self.levels.cells(position_r3, depth) % n).unbind(1)
            if level:
                child = self.child_n[node] * self.per_tile + (z * n + y) * n + x
                node = torch.where(here, child, node)
            tiles.update((node[here] // self.per_tile).tolist())
        assert torch.equal(node, found.node)
        return found

    monkeypatch.setattr(Tree, "descend", recorded)
    return tiles


def stamped(nodes: gv.NodePool, frame: int) -> set[int]:
    return set((nodes.stamp_t == frame).nonzero()[:, 0].tolist())


@pytest.mark.parametrize("lod", ["auto", "finest"])
@pytest.mark.parametrize(("branching", "brick"), [(2, 2), (3, 2), (4, 2)])
@pytest.mark.parametrize("shares", [False, True])
def test_all_tiles_that_rays_passed_through_are_stamped(
    blobs, backend, passed, shares, branching, brick, lod
):
    """In trees with holes. Where tiles are shared, rays stamp each tile themselves."""
    tree = gv.N3Tree.from_volume(blobs, brick, branching=branching)
    tree = forget(share(tree, 1) if shares else tree, 0.1, 2)
    rays = camera_rays(tree, 24, distance=1.2)
    gv.trace(on(tree, "cpu"), rays, SHADER, backend="reference", lod=lod)
    expected = passed.copy()
    used = on(tree, DEVICES[backend])
    gv.trace(used, rays.to(used.device), SHADER, backend=backend, lod=lod)
    last = stamped(used.nodes, 1)
    used.nodes.mark_ancestors(torch.ones_like(used.nodes.stamp_t[:1]))
    assert stamped(used.nodes, 1) == expected and len(expected) > 10
    assert (last == expected) == shares


class Twice(Ball):
    """A ball in either half of the cube along x. The second half's nodes at depth 2 point to what
    the first half's nodes have, as far as that is there.
    """

    def classify(self, nodes):
        second = (nodes.depth == 2) & (nodes.loc[:, 0] >= 2)
        kind = torch.where(second, gv.Region.ALIAS, gv.Region.DATA)
        return gv.Regions(kind=kind, alias=nodes.loc - nodes.loc.new_tensor([2, 0, 0, 0]))

    def fill(self, nodes):
        half = nodes.positions.new_tensor([0.5, 0, 0])
        place = nodes.positions + torch.where(nodes.positions[..., :1] < 0, half, -half)
        return {"value": (1 - 2 * place.norm(dim=-1)).clamp(min=0)}


def looking_at(x: float) -> gv.Camera:
    return gv.Camera.look_at((x, 0.1, 3), (x, 0, 0), (0, 1, 0), 8, 24, 24)


def test_trees_of_one_pool_are_stamped_as_rays_passed_through_them(backend, passed):
    """N = 2 and 3, one with shared tiles; a steady frame by the twin, and the same once more."""
    scene = {"two": Ball(32), "twice": Twice(32), "three": Ball(27, branching=3)}
    size = {"brick_size": 2, "brick_pool": "4 MB", "node_pool": "2 MB"}
    device = DEVICES[backend]
    with Checked(scene, **size, device=device) as engine:
        for x in (-0.5, 0.5):
            engine.render(looking_at(x), GRAY)
        for x in (-0.5, 0.5, 0.0):
            engine.render(looking_at(x), GRAY)
            passed.clear()
            engine.frame(looking_at(x), GRAY, backend="reference")
            assert stamped(engine.cache.nodes, engine.frames) == passed and len(passed) > 20
            _, stats = engine.frame(looking_at(x), GRAY, backend=backend)
            assert stamped(engine.cache.nodes, engine.frames) == passed
            assert stats.tiles_used == len(passed)
        assert engine.cache.nodes.shared_t[len(scene) :].any()
        assert engine.cache.nodes.shared_t[: len(scene)].tolist() == [False, True, False]


def test_no_tile_on_the_way_to_a_shared_one_is_given_away(compiled):
    """Where slots are few, and the parents of shared tiles go first."""
    device, views = DEVICES[compiled], [looking_at(x) for x in (-0.5, 0.5, 0.2, -0.5, 0.5)]
    size = {"brick_size": 2, "brick_pool": "4 MB", "device": device}
    with gv.Engine(Twice(32), **size, node_pool="2 MB") as whole:
        expected = [whole.render(view, GRAY) for view in views]
    evicted = orphans = 0
    with Checked(Twice(32), **size, node_pool="12 kB") as engine:
        nodes = engine.cache.nodes
        for view, picture in zip(views, expected, strict=True):
            for _ in range(12):
                _, stats = engine.frame(view, GRAY)
                evicted += stats.evicted["tiles"]
                orphans += int((nodes.shared_t & (nodes.parent_t < 0))[1:].sum())
            assert torch.equal(engine.frame(view, GRAY)[0].alpha, picture.alpha)
    assert evicted and orphans, "the test must take slots away"
