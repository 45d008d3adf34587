"""Which rays of a converging picture are traced next."""

from __future__ import annotations

import torch

import gvtorch as gv
from gvtorch.engine.turns import Turns


def test_scouts_go_first():
    turns = Turns(64, 8, torch.device("cpu"))
    assert turns.now.all()
    turns.take(torch.ones(64, dtype=torch.bool), gv.FrameStats(produced={"bricks": 3}), 0)
    assert turns.now.nonzero()[:, 0].tolist() == [0, 4, 32, 36]
    turns.take(torch.zeros(64, dtype=torch.bool), gv.FrameStats(), 0)
    assert turns.done == 4 and int(turns.now.sum()) == 60
    turns.everyone()
    assert torch.equal(turns.now, ~torch.isin(torch.arange(64), torch.tensor([0, 4, 32, 36])))


def test_rays_take_turns_by_halves(monkeypatch):
    monkeypatch.setattr("gvtorch.engine.turns._STRIDE", 1)
    turns = Turns(16, 16, torch.device("cpu"))
    full = gv.FrameStats(capacity_exceeded=True, produced={"bricks": 0})
    everyone = torch.ones(16, dtype=torch.bool)
    for expected in (8, 4, 2, 1):
        turns.take(everyone, full, 0)
        assert int(turns.now.sum()) == expected and turns.crowded and not turns.over
    turns.take(~turns.now, full, 0)  # the one ray is done
    assert turns.done == 1 and int(turns.now.sum()) == 2
    turns.take(~turns.now, full, 0)
    assert turns.done == 3 and int(turns.now.sum()) == 4
    loaded = gv.FrameStats(produced={"bricks": 5})
    turns.take(everyone, loaded, 0)
    assert int(turns.now.sum()) == 4, "what moves goes on"
    turns.take(everyone, gv.FrameStats(converged=True), 0)
    assert turns.done == 7, "what can't be served is not waited for"
    turns.take(~turns.now, loaded, 0)
    turns.take(~turns.now, loaded, 0)
    assert turns.over and turns.whole and turns.done == 16
    turns = Turns(1, 1, torch.device("cpu"))
    turns.take(everyone[:1], full, 0)
    assert turns.over and not turns.whole, "a ray that does not fit alone is given up"
