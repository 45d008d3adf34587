"""Producers that answer at once, late or out of order, and an engine that checks its frames."""

from __future__ import annotations

import random
import time
from concurrent.futures import Future, ThreadPoolExecutor

import torch

import gvtorch as gv
from gvtorch.base import constants as config

SIZE = {"brick_size": 4, "brick_pool": "4 MB", "node_pool": "200 kB"}


class Ball(gv.Producer):
    """Density 1 in the middle, falling to 0 at distance 1."""

    def __init__(self, extent=32, **options):
        super().__init__(extent, box=((-1, -1, -1), (1, 1, 1)), **options)
        self.filled: list[torch.Tensor] = []

    def fill(self, nodes):
        self.filled.append(nodes.loc.clone())
        return {"value": (1 - nodes.positions.norm(dim=-1)).clamp(min=0)}


class Sponge(gv.Producer):
    """The Menger sponge: of 3^3 children, 7 are holes, 20 aliases of the whole. Needs one tile."""

    def __init__(self, levels=4):
        super().__init__(4 * 3**levels, branching=3, box=((0, 0, 0), (1, 1, 1)))
        self.classified = self.filled = 0

    def classify(self, nodes):
        self.classified += len(nodes)
        middle_axes = (nodes.loc[:, :3] % 3 == 1).sum(1)
        whole = torch.where(nodes.depth == 0, gv.Region.DATA, gv.Region.ALIAS)
        kind = torch.where((middle_axes >= 2) & (nodes.depth > 0), gv.Region.EMPTY, whole)
        return gv.Regions(kind=kind, alias=torch.zeros_like(nodes.loc))

    def fill(self, nodes):
        self.filled += len(nodes)
        side = nodes.layout.brick_size + 2 * nodes.layout.border
        return {"value": torch.full((len(nodes), side, side, side), 20 / 27)}


class Held(gv.VolumeProducer):
    """Holds its answers back until `release`, which gives them in random order."""

    def __init__(self, volume, seed=0):
        super().__init__(volume)
        self.held, self.hold, self.random = [], True, random.Random(seed)

    def later(self, answer, nodes):
        if not self.hold or (nodes.depth == 0).any():
            return answer(nodes)
        self.held.append((future := Future(), answer, nodes))
        return future

    def release(self):
        self.random.shuffle(self.held)
        for future, answer, nodes in self.held:
            future.set_result(answer(nodes))
        self.held.clear()

    def classify(self, nodes):
        return self.later(super().classify, nodes)

    def fill(self, nodes):
        return self.later(super().fill, nodes)


class Late(gv.VolumeProducer):
    """Answers from threads, after random delays, so in any order."""

    def __init__(self, volume: gv.Volume, seed: int = 0, max_delay: float = 0.004) -> None:
        super().__init__(volume)
        self.random, self.max_delay = random.Random(seed), max_delay
        self.threads = ThreadPoolExecutor(6)

    def later(self, answer, nodes: gv.Nodes) -> Future:
        delay = self.random.uniform(0, self.max_delay)

        def work():
            time.sleep(delay)
            return answer(nodes)

        return self.threads.submit(work)

    def classify(self, nodes):
        return self.later(super().classify, nodes)

    def fill(self, nodes):
        return self.later(super().fill, nodes)

    def close(self):
        self.threads.shutdown()


class Checked(gv.Engine):
    """Asserts after every frame that the pools are valid, and that no slot was taken that the last
    picture used.
    """

    def frame(self, *args, **options):
        nodes, bricks = self.cache.nodes, self.cache.bricks
        roots = len(self.trees)
        locked = nodes.brick_tn[:roots, 0].clone()
        owners = [bricks.owner_b.clone(), nodes.parent_t.clone()]
        used_b = (bricks.stamp_b == self.frames) & (owners[0] >= 0)
        used_t = (nodes.stamp_t == self.frames) & (owners[1] >= 0)
        picture, stats = super().frame(*args, **options)
        self.validate()
        assert torch.equal(bricks.owner_b[used_b], owners[0][used_b]), "a brick in use was taken"
        assert torch.equal(nodes.parent_t[used_t], owners[1][used_t]), "a tile in use was taken"
        assert torch.equal(nodes.brick_tn[:roots, 0], locked), "a root was touched"
        assert stats.tiles_used == int((nodes.stamp_t == self.frames).sum())
        assert stats.bricks_used == int((bricks.stamp_b == self.frames).sum())
        assert not (nodes.request_tn & config.REQUEST_KINDS).any(), "requests are cleared"
        return picture, stats
