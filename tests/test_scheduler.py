"""The LRU order, and which requests are served."""

from __future__ import annotations

import torch

from gvtorch.base import constants as config
from gvtorch.cache import LRU, Requests, Scheduler

LOAD, SUBDIVIDE = config.REQUEST_LOAD, config.REQUEST_SUBDIVIDE


def test_lru_gives_slots_from_the_front_as_far_as_they_are_unused():
    lru = LRU(6, 2, torch.device("cpu"))
    assert lru.give(torch.ones(4, dtype=torch.bool), lru.free()).tolist() == [2, 3, 4, 5]
    stamp = torch.tensor([9, 9, 9, 1, 9, 1], dtype=torch.int32)
    lru.unused = int(lru.sort(stamp, torch.tensor([9], dtype=torch.int32)))
    assert lru.order.tolist() == [3, 5, 2, 4] and lru.unused == 2
    wants_slot = torch.tensor([False, True, False])
    assert lru.give(wants_slot, lru.free()).tolist() == [-1, 3, -1]
    assert lru.order.tolist() == [5, 2, 4, 3]
    lru.unused = 1
    assert lru.give(~wants_slot, lru.free()).tolist() == [5, -1, -1], "no more are unused"
    assert lru.order.tolist() == [2, 4, 3, 5]
    nothing = LRU(2, 2, torch.device("cpu"))
    assert nothing.give(wants_slot, nothing.free()).tolist() == [-1, -1, -1]


def test_slots_that_never_held_anything_stay_in_front_unread():
    lru, frame = LRU(6, 2, torch.device("cpu")), torch.tensor([9], dtype=torch.int32)
    assert lru.give(torch.ones(2, dtype=torch.bool), lru.free()).tolist() == [2, 3]
    assert lru.order.tolist() == [4, 5, 2, 3] and lru.fresh == 2
    stamp = torch.tensor([9, 9, 9, 1, -1, -1], dtype=torch.int32)
    assert int(lru.sort(stamp, frame)) == 3 and lru.order.tolist() == [4, 5, 3, 2]
    lru.unused = 3
    assert lru.give(torch.ones(3, dtype=torch.bool), lru.free()).tolist() == [4, 5, 3]
    assert lru.fresh == 0 and lru.order.tolist() == [2, 4, 5, 3]


def test_the_order_is_that_of_a_queue_however_often_slots_are_given():
    lru, queue = LRU(3000, 3, torch.device("cpu")), list(range(3, 3000))
    for turn in range(200):
        demand, limit = turn * 7 % 10 * (turn % 5 != 4), torch.tensor([turn * 11 % 14])
        count = min(demand, int(limit))
        slot = lru.give(torch.ones(demand, dtype=torch.bool), limit)
        assert slot.tolist() == queue[:count] + [-1] * (demand - count)
        queue = queue[count:] + queue[:count]
        assert lru.order.tolist() == queue
    assert lru.order.nbytes < lru.nbytes < 1.01 * lru.order.nbytes


def requests(depth, priority, coarse=None) -> dict[int, Requests]:
    none = torch.zeros(0, dtype=torch.int64)
    loads = Requests(
        node=torch.arange(len(depth)),
        depth=torch.tensor(depth),
        priority=torch.tensor(priority, dtype=torch.int32),
        coarse=coarse,
    )
    tiles = Requests(node=none, depth=none, priority=none.int())
    return {LOAD: loads, SUBDIVIDE: tiles}


def test_the_scheduler_serves_by_level_then_by_size_and_trims():
    listed = requests([3, 1, 2, 1], [5, 7, 1, 9])
    room = {LOAD: [10], SUBDIVIDE: [10]}
    for order, expected in (("coarse", [3, 1, 2, 0]), ("fine", [0, 2, 3, 1])):
        served, deferred, exceeded = Scheduler(order=order).choose(listed, room)
        assert served[LOAD].tolist() == expected and deferred == 0 and not exceeded
    served, deferred, _ = Scheduler(loads=3).choose(listed, room)
    assert served[LOAD].tolist() == [3, 1, 2] and deferred == 1
    room[LOAD] = [2]
    served, deferred, exceeded = Scheduler().choose(listed, room)
    assert served[LOAD].tolist() == [3, 1] and exceeded


def test_the_time_budget_learns_what_fits():
    scheduler = Scheduler(milliseconds=4.0)
    listed = requests([0] * 1000, [1] * 1000)
    room = {LOAD: [5000], SUBDIVIDE: [5000]}
    first, deferred, _ = scheduler.choose(listed, room)
    assert 0 < len(first[LOAD]) < 1000 and deferred == 1000 - len(first[LOAD])
    scheduler.learn(LOAD, 10, 1e-6)  # too few to learn from
    scheduler.learn(LOAD, 64, 1000.0)  # a slow start
    assert len(scheduler.choose(listed, room)[0][LOAD]) == 1
    for _ in range(40):
        scheduler.learn(LOAD, 100, 1.0)  # 100 bricks a millisecond
    assert len(scheduler.choose(listed, room)[0][LOAD]) >= 199, "half of the time is for bricks"


def served_with(cost, frames: int, milliseconds: float = 8.0) -> list[int]:
    """Returns bricks per frame if a batch of n takes cost(n) ms and rays always request more."""
    scheduler, counts = Scheduler(milliseconds=milliseconds), []
    listed, room = requests([0] * 4000, [1] * 4000), {LOAD: [5000], SUBDIVIDE: [5000]}
    for _ in range(frames):
        scheduler.begin()
        counts.append(len(scheduler.choose(listed, room)[0][LOAD]))
        scheduler.learn(LOAD, counts[-1], cost(counts[-1]))
    return counts


def test_a_call_s_own_cost_does_not_make_batches_small():
    """A call takes 6 ms and 0.01 ms per brick, and bricks have 4 ms of a frame: one a frame would
    take 6.01 ms, 200 take 8. A slow first call does not matter for long.
    """
    for first in (1.0, 100.0):
        calls = iter([first] + [1.0] * 100)
        counts = served_with(lambda n, calls=calls: next(calls) * (6 + 0.01 * n), 60)
        assert sum(counts[15:]) / 45 > 150 and max(counts) <= 400


def test_batches_are_as_large_as_the_time_allows():
    """With a fixed cost and without; slow bricks are served one or two a frame."""
    for fixed, each in ((0.0, 0.02), (1.0, 0.02), (0.0, 0.5), (2.0, 0.1)):
        counts = served_with(lambda n, fixed=fixed, each=each: fixed + each * n, 60)
        took = [fixed + each * n for n in counts[20:]]
        assert sum(took) / 40 > 0.75 * 4 and max(took) <= 1.4 * 4 + each
    slow = served_with(lambda n: 100.0 * n, 60)
    assert sum(slow[5:]) <= 1.3 * 55 and max(slow[5:]) <= 2


def test_each_kind_of_slot_serves_its_own_requests():
    """If coarse bricks need separate slots, the highest priorities of each kind are served."""
    coarse = torch.tensor([True, False, True, False, True, False])
    listed = requests([0] * 6, [9, 8, 7, 6, 5, 4], coarse)
    room = {LOAD: [1, 2], SUBDIVIDE: [0]}
    served, deferred, exceeded = Scheduler().choose(listed, room)
    assert served[LOAD].tolist() == [0, 1, 2] and exceeded and not deferred
    room[LOAD] = [3, 3]
    served, deferred, exceeded = Scheduler(loads=4).choose(listed, room)
    assert served[LOAD].tolist() == [0, 1, 2, 3] and not exceeded and deferred == 2
