"""Which rays of a converging picture are traced next."""

from __future__ import annotations

import torch

import gvtorch as gv
from gvtorch.engine.ray_subsets import RaySubsets

CPU = torch.device("cpu")
LOADED = gv.FrameStats(produced={"bricks": 3})


def test_scouts_go_first():
    subsets = RaySubsets(32 * 32, 32, CPU, scouts_first=True)
    assert subsets.next.nonzero()[:, 0].tolist() == [0, 16, 16 * 32, 16 * 32 + 16]
    missed = torch.ones(32 * 32, dtype=torch.bool)
    subsets.update(missed, LOADED, 0)
    assert int(subsets.next.sum()) == 4 and not subsets.done
    subsets.update(~missed, gv.FrameStats(), 0)
    assert subsets.done == 4 and int(subsets.next.sum()) == 60
    subsets.update(~missed, gv.FrameStats(), 0)
    assert subsets.done == 64 and int(subsets.next.sum()) == 32 * 32 - 64
    subsets.update(~missed, gv.FrameStats(), 0)
    assert subsets.over and subsets.complete


def test_a_few_scouts_go_on_with_the_others():
    subsets = RaySubsets(64 * 64, 64, CPU, scouts_first=True)
    missed = torch.zeros(64 * 64, dtype=torch.bool)
    missed[0] = True
    subsets.update(missed, LOADED, 0)
    assert subsets.done == 15 and int(subsets.next.sum()) == 256 - 15 and subsets.next[0]
    subsets.trace_all()
    assert int(subsets.next.sum()) == 64 * 64 - 15


def test_scouts_that_get_nothing_do_not_end_the_picture():
    subsets, missed = RaySubsets(256, 16, CPU, scouts_first=True), torch.ones(256, dtype=torch.bool)
    subsets.update(missed, gv.FrameStats(produced={"bricks": 0}), 0)
    assert not subsets.over and subsets.next.all(), "every ray gets a colour"
    subsets.update(missed, gv.FrameStats(produced={"bricks": 0}), 0)
    assert subsets.over and not subsets.complete


def test_all_go_first_where_little_is_missing():
    subsets = RaySubsets(64, 8, CPU, scouts_first=False)
    assert subsets.next.all()
    subsets.update(torch.ones(64, dtype=torch.bool), LOADED, 0)
    assert subsets.next.nonzero()[:, 0].tolist() == [0]


def test_subsets_are_halved_where_nothing_moves(monkeypatch):
    monkeypatch.setattr("gvtorch.engine.ray_subsets._STRIDES", (1,))
    subsets = RaySubsets(16, 16, CPU, scouts_first=False)
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
    assert subsets.over and subsets.complete and subsets.done == 16
    subsets = RaySubsets(1, 1, CPU, scouts_first=False)
    subsets.update(everyone[:1], full, 0)
    assert subsets.over and not subsets.complete, "a ray that does not fit alone is given up"
