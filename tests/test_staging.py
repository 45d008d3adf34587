"""Staging: upload of bricks from the host to the device. The ring itself is tested on the CPU as
well, where copies finish at once."""

from __future__ import annotations

import random
import warnings
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.pictures import GRAY, camera
from helpers.waits import nobody_waits

import gvtorch as gv
from gvtorch.base import constants as config
from gvtorch.ops import unavailable
from gvtorch.pool.staging import BrickTable, Staging, TableRows, wide_rows


def landed(result, channel="value") -> torch.Tensor:
    """Returns all bricks of `SentBricks`, and releases its bytes."""
    pieces = []
    for chunk in result.chunks:
        with chunk as data:
            pieces.append(data[channel].clone().cpu())
    return torch.cat(pieces)


def voxels(count, dtype=torch.uint8, width=1, side=10, seed=0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randint(0, 120, (count, side, side, side, width), generator=generator)
    return numbers.to(dtype)


@pytest.fixture(params=["cpp", "cuda"])
def device(request) -> torch.device:
    reason = unavailable()[request.param]
    if reason:
        pytest.skip(f"backend {request.param}: {reason}")
    return torch.device(DEVICES[request.param])


def test_what_is_sent_arrives_while_the_ring_wraps_many_times(device):
    """Channels of several dtypes, from tensors and tables, in batches of any size."""
    table = BrickTable(voxels(3000, seed=1))
    pick = random.Random(4)
    ring = Staging(1 << 20, 1000 + 6000 + 4000, device)
    sent = 0
    for step in range(60):
        count = pick.randint(1, 900)
        row = torch.randint(0, 3000, (count,), generator=torch.Generator().manual_seed(step))
        wide = voxels(count, torch.uint16, 3, seed=step)
        real = voxels(count, torch.float32, 1, seed=step + 1)
        result = ring.send({"value": table[row], "wide": wide, "real": real})
        assert result.sent == count or result.chunks
        assert [chunk.begin for chunk in result.chunks][:1] == [0][: len(result.chunks)]
        many = len(result.chunks)
        for chunk in result.chunks:
            with chunk as data:
                here = slice(chunk.begin, chunk.end)
                assert torch.equal(data["value"].cpu(), table.bricks[row[here]])
                assert torch.equal(data["wide"].cpu().int(), wide[here].int())
                assert torch.equal(data["real"].cpu(), real[here])
        if device.type == "cuda":
            torch.cuda.synchronize()
        sent += result.sent * 11000
        assert many == 0 or result.chunks[-1].end == result.sent
    assert sent > 10 * ring.nbytes


def test_a_payload_larger_than_a_chunk_is_cut(device):
    bricks = voxels(6000)
    ring = Staging(6000 * 1000, 1000, device)
    result = ring.send({"value": bricks})
    assert len(result.chunks) > 2 and result.sent == 6000 and len(result.rest["value"]) == 0
    assert all(1000 * (chunk.end - chunk.begin) <= ring.chunk for chunk in result.chunks)
    assert torch.equal(landed(result), bricks)


def test_a_full_ring_takes_fewer_bricks_and_waits_for_none(device):
    bricks = voxels(20000)
    ring = Staging(4_000_000, 1000, device)
    first = ring.send({"value": bricks})
    assert 0 < first.sent < 20000 and len(first.rest["value"]) == 20000 - first.sent
    full = ring.send({"value": bricks})
    assert full.sent == 0 and full.chunks == [] and len(full.rest["value"]) == 20000
    assert torch.equal(landed(first), bricks[: first.sent]), "what is under way is left alone"
    if device.type == "cuda":
        torch.cuda.synchronize()
    again = ring.send({"value": bricks[first.sent :]})
    assert again.sent > 0
    assert torch.equal(landed(again), bricks[first.sent : first.sent + again.sent])


def test_what_nobody_reads_any_more_gives_its_bytes_back(device):
    ring = Staging(4_000_000, 1000, device)
    for _ in range(5):
        result = ring.send({"value": voxels(8000)})
        assert result.sent > 4000
        if device.type == "cuda":
            torch.cuda.synchronize()
        del result  # an interrupted frame


def test_a_brick_larger_than_a_chunk_has_a_ring_of_its_size(device):
    bricks = voxels(5, torch.float32, 4, side=80)
    ring = Staging(1000, bricks[0].nbytes, device)
    result = ring.send({"value": bricks})
    assert result.sent == 4
    assert torch.equal(landed(result), bricks[:4])


@pytest.mark.parametrize("device", [pytest.param("cuda", marks=pytest.mark.backend("cuda"))])
def test_pinned_bricks_are_copied_from_where_they_are(device):
    ring = Staging(8_000_000, 1000, torch.device(device))
    bricks = voxels(5000).pin_memory()
    result = ring.send({"value": bricks, "pageable": voxels(5000, seed=3)})
    expected = bricks.clone()
    del bricks  # the source of the copy lives until then
    junk = [torch.full((2_500_000,), 7, dtype=torch.uint8).pin_memory() for _ in range(4)]
    assert result.sent == len(expected) - len(result.rest["value"]) > 1000 and len(junk) == 4
    assert torch.equal(landed(result), expected[: result.sent])


def test_several_threads_may_send(device):
    ring = Staging(40_000_000, 1000, device)
    batches = [voxels(1500, seed=seed) for seed in range(12)]
    with ThreadPoolExecutor(4) as threads:
        results = list(threads.map(lambda b: ring.send({"value": b}), batches))
    for result, bricks in zip(results, batches, strict=True):
        assert torch.equal(landed(result), bricks)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.bfloat16, torch.float32])
@pytest.mark.parametrize("side", [2, 3, 5, 10])
def test_rows_are_moved_in_the_widest_words_that_fit(dtype, side):
    pool, rows = voxels(7, dtype, side=side), voxels(9, dtype, side=side, seed=3)[2:6]
    to, words_rows = wide_rows(pool, rows)
    to.index_copy_(0, torch.tensor([6, 0, 3, 2]), words_rows)
    assert torch.equal(
        pool[[6, 0, 3, 2]].float() if dtype != torch.uint16 else to[[6, 0, 3, 2]],
        rows.float() if dtype != torch.uint16 else words_rows,
    )
    assert to.itemsize == np.gcd(8, np.gcd(side**3 * dtype.itemsize, rows.data_ptr()))


def test_bad_tables_are_named():
    with pytest.raises(ValueError, match="BrickTable: bricks must be contiguous"):
        BrickTable(torch.zeros(3, 4, 4, 4))
    with pytest.raises(ValueError, match="BrickTable: bricks hold NaN"):
        BrickTable(torch.full((3, 4, 4, 4, 1), float("nan")))
    table = BrickTable(voxels(5))
    with pytest.raises(ValueError, match="BrickTable: rows must be 0 to 4"):
        table[torch.tensor([0, 5])]
    some = table[torch.tensor([4, 1, 1])]
    assert isinstance(some, TableRows) and some.shape == (3, 10, 10, 10, 1)
    assert torch.equal(some[torch.tensor([0, 2])].gather(), table.bricks[[4, 1]])


class Numbered(gv.Producer):
    """Bricks in which every voxel identifies its node, in two channels."""

    where = "host"

    def __init__(self, side: int = 50):
        self.bricks = side**3
        channels = {"value": gv.Channel(torch.uint8), "wide": gv.Channel(torch.uint16, 2)}
        super().__init__(8 * side, channels=channels)

    def make(self, loc):
        row = (loc * torch.tensor([1, 101, 10007, 31], device=loc.device)).sum(1)
        number = row[:, None] * 7 + torch.arange(1000, device=loc.device)
        value = (number % 251).to(torch.uint8).view(-1, 10, 10, 10)
        wide = torch.stack((number % 32749, number // 7 % 32749), -1).to(torch.int16)
        return {"value": value, "wide": wide.view(torch.uint16).view(-1, 10, 10, 10, 2)}

    def fill(self, nodes):
        where = self.where
        if where == "mixed":
            half = len(nodes) // 2
            where = ("host", "device", "later")[int(nodes.loc[half].sum()) % 3]
        if where == "never" and not (nodes.depth == 0).any():
            return Future()
        bricks = self.make(nodes.loc if where == "device" else nodes.loc.cpu())
        if where != "later" or (nodes.depth == 0).any():
            return bricks
        future: Future = Future()
        THREAD.submit(future.set_result, bricks)
        return future


THREAD = ThreadPoolExecutor(1)


def grown(producer, device, **options) -> gv.Engine:
    """Returns an engine whose tree has all tiles and no brick except the root's."""
    pools = {"node_pool": "40 MB", "brick_pool": f"{(producer.bricks + 100) * 5} kB"}
    engine = gv.Engine(producer, device=device, **{**pools, **options})
    nodes = engine.cache.nodes
    for depth in range(producer.layout.depth):
        lacks = (nodes.child_tn == config.ABSENT).flatten()
        lacks &= (nodes.loc_t4[:, 3] == depth).repeat_interleave(nodes.nodes_per_tile)
        lacks &= linked(engine)
        serve(engine, lacks.nonzero()[:, 0], config.REQUEST_SUBDIVIDE)
    return engine


def side_on(device) -> int:
    """Returns bricks along a side, 125,000 in all on a GPU, else fewer."""
    return 50 if device.type == "cuda" else 24


def linked(engine) -> torch.Tensor:
    nodes = engine.cache.nodes
    some = nodes.parent_t >= 0
    some[0] = True
    some = some.repeat_interleave(nodes.nodes_per_tile)
    some[1 : nodes.nodes_per_tile] = False
    return some


def finest(engine) -> torch.Tensor:
    """Returns nodes of the finest level that lack their bricks."""
    nodes, depth = engine.cache.nodes, engine.trees["scene"].layout.depth
    lacks = (nodes.brick_tn == config.ABSENT).flatten() & linked(engine)
    lacks &= (nodes.loc_t4[:, 3] == depth).repeat_interleave(nodes.nodes_per_tile)
    return lacks.nonzero()[:, 0]


def serve(engine, node, kind) -> gv.FrameStats:
    """Serves requests as a frame does, without tracing rays."""
    stats = gv.FrameStats()
    engine.production.write(engine.production.late_answers(), stats)
    engine.production.write(engine.production.ask({kind: node}), stats)
    return stats


def assert_slots_hold_what_the_producer_made(engine, nodes) -> None:
    source, cache = engine.trees["scene"], engine.cache
    slot = cache.nodes.brick_tn.view(-1)[nodes].long()
    assert bool((slot > 0).all()) and len(slot.unique()) == len(slot)
    assert torch.equal(cache.bricks.owner_b[slot].long(), nodes)
    for some in torch.arange(len(nodes)).split(5000):
        answer = source.producer.make(source.tree.loc(nodes[some.to(nodes.device)]))
        chosen_slots = slot[some.to(slot.device)]
        for name, pool in cache.bricks.bricks.items():
            held = wide_rows(pool)[0][chosen_slots]
            assert torch.equal(
                held,
                answer[name]
                .to(held.device)
                .view_as(pool[: len(chosen_slots)])
                .view(len(chosen_slots), -1)
                .view(held.dtype),
            ), name


@pytest.mark.parametrize("where", ["host", "device", "later", "mixed"])
def test_slots_hold_what_the_producer_made(device, where):
    """Bricks in random order, answered on the host and on the device, now and later."""
    producer = Numbered(side_on(device))
    producer.where = where
    with grown(producer, device) as engine:
        nodes = finest(engine)
        assert len(nodes) == producer.bricks
        mixed = torch.randperm(len(nodes), generator=torch.Generator().manual_seed(2))
        nodes = nodes[mixed.to(device)][: 100_000 if device.type == "cuda" else 10_000]
        todo, moved = batches(nodes), 0
        for _ in range(2000):
            batch = todo.pop() if todo else nodes[:0]
            moved += serve(engine, batch, config.REQUEST_LOAD).bytes_uploaded
            if not todo and not engine.production.pending[config.REQUEST_LOAD]:
                break
            engine.production.wait(limit=0.01)
        assert moved == len(nodes) * 5000 and len(engine.production.failures) == 0
        engine.validate()
        assert_slots_hold_what_the_producer_made(engine, nodes)


@pytest.mark.parametrize("device", [pytest.param("cuda", marks=pytest.mark.backend("cuda"))])
@pytest.mark.parametrize("where", ["host", "device"])
def test_the_host_waits_a_few_times_a_batch_whatever_its_size(device, where):
    producer = Numbered()
    producer.where = where
    with grown(producer, device) as engine:
        nodes = finest(engine)
        serve(engine, nodes[:10], config.REQUEST_LOAD)
        counts = []
        for size in (10, 1000):
            batch, nodes = nodes[-size:], nodes[:-size]
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                with nobody_waits("warn"):
                    stats = serve(engine, batch, config.REQUEST_LOAD)
            assert stats.produced["bricks"] == size
            counts.append(sum("synchroniz" in str(warning.message) for warning in caught))
        assert max(counts) <= 6, counts


def batches(nodes) -> list[torch.Tensor]:
    pick, some, begin = random.Random(1), [], 0
    while begin < len(nodes):
        size = pick.choice((1, 7, 300, 4000, 9000))
        some.append(nodes[begin : begin + size])
        begin += size
    return some


@pytest.mark.parametrize("where", ["host", "later"])
def test_what_finds_no_room_is_held_until_a_later_frame(device, where):
    """A payload many times larger than the ring, in one frame: the ring takes what fits."""
    with grown(Numbered(side_on(device)), device, load_budget=1000) as engine:
        if device.type == "cpu":
            engine.production.staging = Staging(5_000_000, 5000, device)
        producer, nodes = engine.trees["scene"].producer, finest(engine)[:10_000]
        producer.where = where
        serve(engine, nodes[:1], config.REQUEST_LOAD)
        serve(engine, nodes[1:], config.REQUEST_LOAD)
        assert (engine.cache.nodes.brick_tn.view(-1)[nodes] >= 0).sum() < len(nodes)
        assert engine.production.pending[config.REQUEST_LOAD] > 0
        for _ in range(10_000):
            engine.production.wait(limit=0.01)
            stats = serve(engine, nodes[:0], config.REQUEST_LOAD)
            if not engine.production.pending[config.REQUEST_LOAD]:
                break
            assert stats.failed == 0
        engine.validate()
        assert_slots_hold_what_the_producer_made(engine, nodes)


def test_a_producer_that_never_answers_stalls_no_frame(device):
    producer = Numbered()
    producer.where = "never"
    with gv.Engine(producer, device=device, brick_pool="50 MB") as engine:
        for _ in range(12):
            _, stats = engine.frame(camera(24), GRAY)
        assert stats.pending > 0 and stats.produced["bricks"] == 0
        engine.validate()


SMALL, WIDE = {"brick_size": 4}, {"brick_size": 6, "border": 2}


@pytest.mark.parametrize("backend", ["cpp", "cuda"])
@pytest.mark.parametrize(
    ("hold", "dtype", "sizes"),  # each pair of values
    [
        *(("voxels", torch.uint8, SMALL), ("bricks", torch.uint8, WIDE)),
        *(("mapped", torch.uint8, SMALL), ("voxels", torch.uint16, WIDE)),
        *(("bricks", torch.uint16, SMALL), ("mapped", torch.uint16, WIDE)),
        *(("voxels", torch.float32, SMALL), ("bricks", torch.float32, WIDE)),
        ("mapped", torch.float32, SMALL),
    ],
)
def test_bricks_cut_ahead_give_the_picture_of_the_volume(blobs, backend, hold, dtype, sizes):
    if unavailable()[backend]:
        pytest.skip(f"backend {backend}: {unavailable()[backend]}")
    values = blobs.data * (1 if dtype == torch.float32 else 250)
    volume = gv.Volume(
        values.to(torch.int32).to(dtype) if dtype == torch.uint16 else values.to(dtype),
        blobs.spacing,
        blobs.origin,
    )
    shader = gv.TransferFunction.preset("gray", *volume.value_range)
    tree = gv.N3Tree.from_volume(volume, *sizes.values(), device=DEVICES[backend])
    view = camera(24, distance=1.3)
    expected = gv.render(tree, view, shader)
    producer = gv.VolumeProducer(volume, hold=hold)
    with gv.Engine(producer, device=DEVICES[backend], **sizes) as engine:
        picture = engine.render(view, shader)
        engine.validate()
    assert torch.equal(picture.color, expected.color) and expected.alpha.max() > 0.3
