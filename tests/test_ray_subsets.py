"""Which rays of a converging picture are traced next."""

from __future__ import annotations

import torch

import gvtorch as gv
from gvtorch.engine.ray_subsets import RaySubsets


def test_scouts_go_first():
    subsets = RaySubsets(64, 8, torch.device("cpu"))
    assert subsets.next.all()
    subsets.update(torch.ones(64, dtype=torch.bool), gv.FrameStats(produced={"bricks": 3}), 0)
    assert subsets.next.nonzero()[:, 0].tolist() == [0, 4, 32, 36]
    subsets.update(torch.zeros(64, dtype=torch.bool), gv.FrameStats(), 0)
    assert subsets.done == 4 and int(subsets.next.sum()) == 60
    subsets.trace_all()
    assert torch.equal(subsets.next, ~torch.isin(torch.arange(64), torch.tensor([0, 4, 32, 36])))


def test_subsets_are_halved_where_nothing_moves(monkeypatch):
    monkeypatch.setattr("gvtorch.engine.ray_subsets._STRIDE", 1)
    subsets = RaySubsets(16, 16, torch.device("cpu"))
    full = gv.FrameStats(capacity_exceeded=True, produced={"bricks": 0})
    everyone = torch.ones(16, dtype=torch.bool)
    for expected in (8, 4, 2, 1):
        subsets.update(everyone, full, 0)
        assert int(subsets.next.sum()) == expected and subsets.crowded and not subsets.over
    subsets.update(~subsets.next, full, 0)  # the one ray is done
    assert subsets.done == 1 and int(subsets.next.sum()) == 2
    subsets.update(~subsets.next, full, 0)
    assert subsets.done == 3 and int(subsets.next.sum()) == 4
    loaded = gv.FrameStats(produced={"bricks": 5})
    subsets.update(everyone, loaded, 0)
    assert int(subsets.next.sum()) == 4, "what moves goes on"
    subsets.update(everyone, gv.FrameStats(converged=True), 0)
    assert subsets.done == 7, "what can't be served is not waited for"
    subsets.update(~subsets.next, loaded, 0)
    subsets.update(~subsets.next, loaded, 0)
    assert subsets.over and subsets.whole and subsets.done == 16
    subsets = RaySubsets(1, 1, torch.device("cpu"))
    subsets.update(everyone[:1], full, 0)
    assert subsets.over and not subsets.whole, "a ray that does not fit alone is given up"
