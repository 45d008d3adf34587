"""The cache's ops: kernel equals twin, and both equal plain Python."""

from __future__ import annotations

import pytest
import torch
from helpers import DEVICES
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gvtorch import ops
from gvtorch.base import constants as config

LOAD, SUBDIVIDE = config.REQUEST_LOAD, config.REQUEST_SUBDIVIDE
PENDING = config.REQUEST_PENDING_SHIFT
fixed = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
words = st.sampled_from(
    [kinds << 11 | priority for kinds in range(16) for priority in (0, 1, 77, 0x7FF)]
)


def int32(values, device="cpu") -> torch.Tensor:
    return torch.tensor(values, dtype=torch.int32, device=device)


def requests(values, device="cpu") -> torch.Tensor:
    return torch.tensor(values, dtype=torch.int16, device=device).view(-1, 8)


@fixed
@given(request_words=st.lists(words, min_size=8, max_size=200), capacity=st.integers(1, 250))
def test_compact_requests_lists_open_requests_and_keeps_pending_ones(
    backend, request_words, capacity
):
    count = len(request_words) // 8 * 8
    request = requests(request_words[:count], DEVICES[backend])
    node, word, counts = ops.compact_requests(request, capacity, backend=backend)
    expected = []
    for index, before in enumerate(request_words[:count]):
        kinds = before & (LOAD | SUBDIVIDE) & ~(before >> PENDING)
        if kinds:
            expected.append((index, kinds | before & config.REQUEST_PRIORITY))
    kept = expected[:capacity]
    requested = sum(1 for before in request_words[:count] if before & (LOAD | SUBDIVIDE))
    by_kind = [sum(1 for _, word in kept if word & kind) for kind in (LOAD, SUBDIVIDE)]
    assert counts.tolist() == [len(kept), len(expected), requested, *by_kind]
    assert list(zip(node.tolist(), word.tolist(), strict=True))[: len(kept)] == kept
    assert set(node.tolist()[len(kept) :]) <= {-1}
    left = [before & (LOAD | SUBDIVIDE) << PENDING for before in request_words[:count]]
    assert request.view(-1).tolist() == left


@fixed
@given(
    data=st.data(),
    listed=st.integers(1, 20),
    batch=st.integers(1, 30),
    coarse_first=st.booleans(),
    room=st.tuples(st.integers(-2, 30), st.integers(-2, 30)),
)
def test_requests_are_chosen_by_list_level_and_size(
    backend, data, listed, batch, coarse_first, room
):
    """There are few levels and sizes, so that many requests tie and their order decides; some nodes
    lie outside the pool of 10 tiles.
    """
    device, loc = DEVICES[backend], torch.zeros((10, 4), dtype=torch.int32)
    loc[:, 3] = torch.tensor(data.draw(st.lists(st.integers(0, 2), min_size=10, max_size=10)))
    numbers = st.lists(st.integers(-1, 85), min_size=listed, max_size=listed)
    sizes = st.sampled_from([0, 7, config.REQUEST_PRIORITY])
    kinds = st.sampled_from([0, LOAD, SUBDIVIDE, LOAD | SUBDIVIDE])
    asked = [[], []]
    for rows in asked:
        list_words = st.lists(st.tuples(kinds, sizes).map(sum), min_size=listed, max_size=listed)
        rows += [data.draw(numbers), data.draw(list_words)]
    node, priority = ops.choose_requests(
        int32(asked, device),
        loc.to(device),
        torch.tensor(room, device=device),
        8,
        batch,
        coarse_first,
        backend=backend,
    )
    candidates = []
    for number, (nodes, list_words) in enumerate(asked):
        for index, (n, word) in enumerate(zip(nodes, list_words, strict=True)):
            if 0 <= n < 80:
                level = int(loc[n // 8, 3]) * (1 if coarse_first else -1)
                size = word & config.REQUEST_PRIORITY
                candidates.append(((number, level, -size, index), n, word, size))
    candidates.sort()
    for row, (kind, limit) in enumerate(((LOAD, room[1]), (SUBDIVIDE, room[0]))):
        chosen = [(n, size) for _, n, word, size in candidates if word & kind]
        chosen = chosen[: max(0, min(batch, limit))]
        expected = [*chosen, *[(-1, 0)] * (batch - len(chosen))]
        assert list(zip(node[row].tolist(), priority[row].tolist(), strict=True)) == expected


@fixed
@given(data=st.data(), size=st.integers(1, 60))
def test_lru_equals_a_python_list_over_random_traces(backend, data, size):
    """Frames use random slots and take some; the model is a list whose used slots move back."""
    device = DEVICES[backend]
    order = torch.arange(size, dtype=torch.int32, device=device)
    stamp = torch.full((size,), -1, dtype=torch.int32, device=device)
    model = list(range(size))
    for frame in range(1, data.draw(st.integers(1, 8)) + 1):
        used = data.draw(st.sets(st.integers(0, size - 1)))
        stamp[torch.tensor(sorted(used), dtype=torch.int64, device=device)] = frame
        order, unused = ops.lru_partition(order, stamp, int32([frame], device), backend=backend)
        model = [s for s in model if s not in used] + [s for s in model if s in used]
        assert order.tolist() == model and int(unused) == size - len(used)
        take = data.draw(st.integers(0, int(unused)))
        order = torch.cat((order[take:], order[:take]))
        model = model[take:] + model[:take]


def owned_slots(data, nodes: int, slots: int) -> tuple[list[int], list[int], list[bool]]:
    """Draws pointers, owners and shared flags as a pool has them: an owner points to its slot, any
    other node only to shared slots.
    """
    shared = data.draw(st.lists(st.booleans(), min_size=slots, max_size=slots))
    owners = data.draw(st.permutations(range(nodes)))[:slots]
    kept = data.draw(st.lists(st.booleans(), min_size=slots, max_size=slots))
    owner = [node if keep else -1 for node, keep in zip(owners, kept, strict=False)]
    owner += [-1] * (slots - len(owner))
    free = [-3, -2, -1, *(slot for slot in range(slots) if shared[slot])]
    pointer = data.draw(st.lists(st.sampled_from(free), min_size=nodes, max_size=nodes))
    for slot, node in enumerate(owner):
        if node >= 0:
            pointer[node] = slot
    return pointer, owner, shared


@fixed
@given(data=st.data(), tiles=st.integers(1, 6), slots=st.integers(0, 30))
def test_unlink_takes_slots_from_all_their_nodes(backend, data, tiles, slots):
    device = DEVICES[backend]
    pointer, owner, shared = owned_slots(data, 8 * tiles, slots)
    leaving = data.draw(st.lists(st.integers(-1, slots + 3), unique=True, max_size=10))
    pointer_tn, owner_s = int32(pointer, device).view(-1, 8), int32(owner, device)
    shared_s = torch.tensor(shared, dtype=torch.bool, device=device)
    ops.unlink(pointer_tn, owner_s, shared_s, int32(leaving, device), backend=backend)
    assert pointer_tn.view(-1).tolist() == [-1 if p >= 0 and p in leaving else p for p in pointer]
    assert owner_s.tolist() == [-1 if slot in leaving else o for slot, o in enumerate(owner)]


@fixed
@given(data=st.data(), tiles=st.integers(1, 6), slots=st.integers(0, 30))
def test_orphan_clears_the_owner_of_what_leaving_tiles_held(backend, data, tiles, slots):
    device = DEVICES[backend]
    pointer, owner, _ = owned_slots(data, 8 * tiles, slots)
    leaving = data.draw(st.lists(st.integers(-1, tiles + 3), unique=True, max_size=10))
    owner_s = int32(owner, device)
    pointer_tn = int32(pointer, device).view(-1, 8)
    ops.orphan(pointer_tn, owner_s, int32(leaving, device), backend=backend)
    assert owner_s.tolist() == [-1 if o >= 0 and o // 8 in leaving else o for o in owner]
    assert pointer_tn.view(-1).tolist() == pointer


@fixed
@given(data=st.data(), tiles=st.integers(1, 8))
def test_link_writes_pointers_and_takes_requests_back(backend, data, tiles):
    nodes = tiles * 8
    device = DEVICES[backend]
    pointer = data.draw(st.lists(st.integers(-3, 99), min_size=nodes, max_size=nodes))
    request = data.draw(st.lists(words, min_size=nodes, max_size=nodes))
    chosen = data.draw(st.lists(st.integers(0, nodes - 1), unique=True, max_size=nodes))
    values = data.draw(st.lists(st.integers(-3, 99), min_size=len(chosen), max_size=len(chosen)))
    kind = data.draw(st.sampled_from([LOAD, SUBDIVIDE]))
    a, b = int32(pointer, device).view(-1, 8), requests(request, device)
    node_k, word_k = int32([*chosen, -1], device), int32([*values, 5], device)
    ops.link(a, b, node_k, word_k, kind, backend=backend)
    for node, value in zip(chosen, values, strict=True):
        pointer[node] = value
        request[node] &= ~(kind | kind << PENDING)
    assert a.view(-1).tolist() == pointer and b.view(-1).tolist() == request


@fixed
@given(data=st.data(), slots=st.integers(1, 30))
def test_link_bricks_gives_nodes_slots_of_their_own(backend, data, slots):
    device, nodes = DEVICES[backend], 24
    chosen = data.draw(st.lists(st.integers(0, nodes - 1), unique=True, max_size=slots))
    taken = data.draw(st.permutations(range(slots)))[: len(chosen)]
    request = data.draw(st.lists(words, min_size=nodes, max_size=nodes))
    brick = [-1] * nodes
    before = {"owner": [7] * slots, "stamp": [3] * slots, "born": [2] * slots}
    there = [int32(brick, device).view(-1, 8), requests(request, device)]
    there += [int32(w, device) for w in before.values()]
    there.append(torch.ones(slots, dtype=torch.bool, device=device))
    node_k = torch.tensor([*chosen, -1, nodes], device=device)
    slot_k, frame = int32([*taken, 0, 0], device), int32([9], device)
    ops.link_bricks(*there, node_k, slot_k, frame, backend=backend)
    shared = [True] * slots
    for node, slot in zip(chosen, taken, strict=True):
        brick[node], shared[slot] = slot, False
        request[node] &= ~(LOAD | LOAD << PENDING)
        before["owner"][slot], before["stamp"][slot], before["born"][slot] = node, 9, 10
    expected = [brick, request, *before.values(), shared]
    assert [t.flatten().tolist() for t in there] == expected


@fixed
@given(data=st.data(), tiles=st.integers(2, 12), width=st.sampled_from([1, 4, 8]))
def test_link_tiles_writes_tiles_and_hangs_them_below_nodes(backend, data, tiles, width):
    device, per_tile = DEVICES[backend], 8
    fresh = data.draw(st.sets(st.integers(1, tiles - 1), max_size=per_tile))
    old = [n for n in range(tiles * per_tile) if n // per_tile not in fresh]
    asking = data.draw(st.lists(st.sampled_from(old), unique=True, min_size=len(fresh)))
    rows = data.draw(st.permutations(range(len(asking))))[: len(fresh)]
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 2**20)))

    def draw(*shape: int) -> torch.Tensor:
        return torch.randint(-3, 50, shape, dtype=torch.int32, generator=generator)

    request = data.draw(st.lists(words, min_size=tiles * per_tile, max_size=tiles * per_tile))
    pool = [draw(tiles, per_tile), draw(tiles, per_tile), requests(request)]
    pool += [draw(tiles, 4), draw(tiles), draw(tiles), draw(tiles)]
    pool.append(torch.ones(tiles, dtype=torch.bool))
    tile_values = [draw(len(asking), width), draw(len(asking), width), torch.tensor(asking).long()]
    tile_values.append(draw(len(asking), 4).long())
    there = [t.to(device) for t in pool]
    row_k, tile_k = torch.tensor([*rows, -1]), int32([*sorted(fresh), 0])
    given_ = [t.to(device) for t in (*tile_values, row_k, tile_k)]
    ops.link_tiles(*there, *given_, 5, int32([9], device), backend=backend)

    child, brick, asked, loc, parent, tree, stamp, shared = pool
    for row, tile in zip(rows, sorted(fresh), strict=True):
        child[tile], brick[tile], asked[tile] = config.TERMINAL, config.EMPTY, 0
        child[tile, :width], brick[tile, :width] = tile_values[0][row], tile_values[1][row]
        x, y, z, depth = tile_values[3][row].tolist()
        loc[tile] = int32([x, y, z, depth + 1])
        parent[tile], tree[tile], stamp[tile], shared[tile] = asking[row], 5, 9, False
    for row, tile in zip(rows, sorted(fresh), strict=True):
        child.view(-1)[asking[row]] = tile
        asked.view(-1)[asking[row]] &= ~(SUBDIVIDE | SUBDIVIDE << PENDING)
    assert [t.tolist() for t in there] == [t.tolist() for t in pool]


@fixed
@given(data=st.data(), slots=st.integers(1, 20), width=st.sampled_from([1, 3, 4, 16, 30, 48]))
def test_put_rows_writes_rows_into_slots(backend, data, slots, width):
    device = DEVICES[backend]
    chosen = data.draw(st.lists(st.integers(0, slots - 1), unique=True, max_size=slots))
    slots_of_rows = data.draw(st.permutations([*chosen, -1, slots]))
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 2**20)))
    target, rows = (
        torch.randint(256, (n, width), dtype=torch.uint8, generator=generator)
        for n in (slots, len(slots_of_rows))
    )
    there = target.to(device)
    slot_k = torch.tensor(slots_of_rows, device=device)
    ops.put_rows(there, slot_k, rows.to(device), backend=backend)
    for slot, row in zip(slots_of_rows, rows, strict=True):
        if 0 <= slot < slots:
            target[slot] = row
    assert torch.equal(there.cpu(), target)


def a_pool(data, branching: int, tiles: int) -> dict[str, torch.Tensor]:
    """Draws random tiles, with more nodes a tile than N^3, as a pool for wider trees has."""
    per_tile = branching**3 + data.draw(st.sampled_from([0, 5]))
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 2**20)))

    def draw(low: int, high: int, *shape: int) -> torch.Tensor:
        return torch.randint(low, high, shape, dtype=torch.int32, generator=generator)

    return {
        "pointer_tn": draw(-2, 2, tiles, per_tile),
        "loc_t4": draw(0, 30, tiles, 4),
        "parent_t": draw(-1, 2, tiles),
        "tree_t": draw(0, 2, tiles),
        "shared_t": draw(0, 3, tiles) == 0,
    }


@fixed
@given(data=st.data(), branching=st.integers(2, 4), tiles=st.integers(1, 12))
def test_nodes_tell_their_places_and_what_they_lack(backend, data, branching, tiles):
    pool = a_pool(data, branching, tiles)
    per_tile = pool["pointer_tn"].shape[1]
    children = branching**3
    node = [t * per_tile + c for t in range(tiles) for c in range(children)]
    home = [(*pool["loc_t4"][n // per_tile].tolist(), n % per_tile) for n in node]
    expected = [
        (x * branching + c % branching, y * branching + c // branching % branching,
         z * branching + c // branching**2, depth)
        for x, y, z, depth, c in home
    ]  # fmt: skip
    there = {name: words_.to(DEVICES[backend]) for name, words_ in pool.items()}
    node_k = torch.tensor([*node, -1, tiles * per_tile], device=DEVICES[backend])
    loc = ops.locate(there["loc_t4"], node_k, branching, per_tile, backend=backend)
    assert loc.tolist() == [list(position) for position in expected] + [[-1] * 4] * 2

    moved = data.draw(st.sets(st.integers(0, len(node) - 1)))
    asked_loc = loc.clone()
    asked_loc[torch.tensor(sorted(moved), dtype=torch.int64, device=loc.device), 1] += 1
    tree, root = 1, data.draw(st.sampled_from(node))
    lacks = ops.lacking(
        *there.values(), node_k, asked_loc, tree, root, branching, backend=backend
    ).tolist()
    for row, index in enumerate(node):
        tile = index // per_tile
        hangs = pool["parent_t"][tile] >= 0 or pool["shared_t"][tile] or index == root
        bare = pool["pointer_tn"].view(-1)[index] == config.ABSENT
        in_tree = pool["tree_t"][tile] == tree and row not in moved
        assert lacks[row] == bool(hangs and bare and in_tree)
    assert lacks[len(node) :] == [False, False]


def test_kernels_equal_twins_on_a_large_pool(compiled):
    device, generator = DEVICES[compiled], torch.Generator().manual_seed(3)
    request = torch.randint(0, 1 << 15, (200_000, 8), generator=generator, dtype=torch.int16)
    request *= torch.randint(0, 2, request.shape, generator=generator, dtype=torch.int16)
    there = request.clone().to(device)
    expected = ops.compact_requests(request, 300_000, backend="reference")
    actual = ops.compact_requests(there, 300_000, backend=compiled)
    assert all(torch.equal(a.cpu(), e) for a, e in zip(actual, expected, strict=True))
    assert torch.equal(there.cpu(), request) and int(expected[2][1]) > 300_000

    order = torch.randperm(500_000, generator=generator).to(torch.int32)
    stamp = torch.randint(0, 3, (500_000,), generator=generator, dtype=torch.int32)
    frame = int32([1])
    expected = ops.lru_partition(order, stamp, frame, backend="reference")
    actual = ops.lru_partition(*(t.to(device) for t in (order, stamp, frame)), backend=compiled)
    assert all(torch.equal(a.cpu(), e) for a, e in zip(actual, expected, strict=True))

    tiles, per_tile = 150_000, 8
    pool = [
        torch.randint(-1, high, shape, generator=generator, dtype=torch.int32)
        for high, shape in ((2, (tiles, per_tile)), (99, (tiles, 4)), (5, (tiles,)), (2, (tiles,)))
    ]
    pool.append(torch.randint(0, 2, (tiles,), generator=generator).to(torch.bool))
    node = torch.randint(-5, tiles * per_tile + 5, (1_000_000,), generator=generator)
    loc = ops.locate(pool[1], node, 2, per_tile, backend="reference")
    there = [words_.to(device) for words_ in (*pool, node, loc)]
    actual = ops.locate(there[1], there[5], 2, per_tile, backend=compiled)
    assert torch.equal(actual.cpu(), loc)
    expected = ops.lacking(*pool, node, loc, 1, 0, 2, backend="reference")
    actual = ops.lacking(*there, 1, 0, 2, backend=compiled)
    assert torch.equal(actual.cpu(), expected) and 0 < int(expected.sum()) < len(node)

    for listed in (3000, 30_000):  # few are compared, many are sorted
        asked = torch.randint(0, tiles * per_tile, (2, 2, listed), generator=generator).int()
        asked[:, 1] &= LOAD | SUBDIVIDE | 15  # few sizes
        asked[0, 0, 2000:] = -1
        given = asked, pool[1], torch.tensor([900, 5000])
        for order_ in (True, False):
            expected = ops.choose_requests(*given, per_tile, 1024, order_, backend="reference")
            there = [one.to(device) for one in given]
            actual = ops.choose_requests(*there, per_tile, 1024, order_, backend=compiled)
            assert all(torch.equal(a.cpu(), e) for a, e in zip(actual, expected, strict=True))
            assert (expected[0] >= 0).sum(1).tolist() == [1024, 900]


def test_cache_ops_pass_opcheck(compiled):
    device = DEVICES[compiled]
    words = int32([[5, 0, 2, -3]], device)
    request = torch.tensor([[1 << 11, 0, 3 << 11, 9 << 11]], dtype=torch.int16, device=device)
    table, frame = torch.ops.gvtorch, int32([1], device)
    node_locs = torch.zeros((1, 4), dtype=torch.int64, device=device)
    row, none = torch.zeros_like(frame).long(), torch.zeros_like(frame)
    for op, arguments in (
        (table.compact_requests, (request, 3)),
        (
            table.choose_requests,
            (int32([[[1, 0], [LOAD, 9]]], device), words, node_locs[0, :2].clone(), 4, 3, True),
        ),
        (table.lru_partition, (int32([2, 0, 1], device), int32([1, 0, 1], device), frame)),
        (table.unlink, (words, frame.clone(), frame.bool(), int32([0, -1], device))),
        (table.orphan, (words, frame.clone(), int32([0, -1], device))),
        (table.link, (words, request, frame, frame, LOAD)),
        (
            table.link_bricks,
            (
                words,
                request,
                *[frame.clone() for _ in range(3)],
                frame.bool(),
                row,
                none,
                frame,
            ),
        ),
        (
            table.link_tiles,
            (
                *(words.clone(), words.clone(), request, words.clone()),
                *[frame.clone() for _ in range(3)],
                frame.bool(),
                *(words, words, row, node_locs, row, none),
                *(1, frame),
            ),
        ),
        (table.put_rows, (request.view(torch.uint8), row, request.view(torch.uint8).clone())),
        (table.locate, (words, frame.long(), 2, 4)),
        (
            table.lacking,
            (*(words, words, frame, frame, frame.bool(), frame.long(), node_locs), 1, 0, 2),
        ),
    ):
        torch.library.opcheck(op.default, arguments)


def test_slots_that_do_not_exist_were_not_used(backend):
    device = DEVICES[backend]
    order, stamp = int32([0, -1, 5, 1], device), int32([3, 3], device)
    sorted_slots, unused = ops.lru_partition(order, stamp, int32([3], device), backend=backend)
    assert sorted_slots.tolist() == [-1, 5, 0, 1] and int(unused) == 2


def test_nothing_to_do(backend):
    device = DEVICES[backend]
    none, frame = int32([], device), int32([1], device)
    request, words = requests([0] * 8, device), int32([0] * 8, device).view(1, 8)
    assert ops.compact_requests(request, 4, backend=backend)[2].tolist() == [0] * 5
    assert int(ops.lru_partition(none, none, frame, backend=backend)[1]) == 0
    ops.unlink(words, none, none.bool(), none, backend=backend)
    ops.orphan(words, none, none, backend=backend)
    ops.link(words, request, none, none, LOAD, backend=backend)
    locs = torch.zeros((1, 4), dtype=torch.int32, device=device)
    loc = ops.locate(locs, none.long(), 2, 8, backend=backend)
    pool = words, locs, frame, frame, frame.bool()
    lacks = ops.lacking(*pool, none.long(), loc, 0, 0, 2, backend=backend)
    assert loc.shape == (0, 4) and lacks.shape == (0,)
    assert not request.any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: ops.compact_requests(w.float(), 4), "request_tn must be (t, n) int16"),
        (lambda w: ops.compact_requests(w.short().T, 4), "request_tn must be contiguous"),
        (lambda w: ops.compact_requests(w.short(), 0), "capacity must be an int >= 1"),
        (
            lambda w: ops.choose_requests(w, w[:, :4].clone(), w[0, :2].long(), 8, 1, True),
            "asked_l2k must be (l, 2, k) int32",
        ),
        (lambda w: ops.lru_partition(w, w[0], w[0, :1]), "order_k must be (k,)"),
        (lambda w: ops.unlink(w, w[0], w[0, :3] > 0, w[0]), "shared_s must be (8,) bool"),
        (lambda w: ops.orphan(w, w[0], w), "tile_k must be (k,)"),
        (lambda w: ops.link(w, w.short(), w[0], w[0, :2], LOAD), "word_k must be (8,)"),
        (
            lambda w: ops.link_bricks(w, w.short(), *[w[0]] * 3, w[0], w[0].long(), w[0], w[0, :1]),
            "shared_b must be (8,) bool",
        ),
        (
            lambda w: ops.link_tiles(
                *(w, w, w.short()),
                w[:, :4].clone(),
                *[w[:, 0].clone()] * 3,
                w[:, 0] > 0,
                *[torch.zeros((2, 9), dtype=torch.int32)] * 2,
                *[w[0].long()] * 4,
                0,
                w[0, :1],
            ),
            "tile_k must be (k,) int32",
        ),
        (
            lambda w: ops.put_rows(w.view(torch.uint8), w[0].long(), w.view(torch.uint8)),
            "rows_kb must be",
        ),
        (lambda w: ops.locate(w, w[0].long(), 2, 8), "loc_t4 must be (t, 4) int32"),
        (lambda w: ops.locate(w[:, :4].clone(), w[0], 2, 8), "node_k must be (k,) int64"),
        (
            lambda w: ops.locate(w[:, :4].clone(), w[0].long(), 1, 8),
            "branching must be an int >= 2",
        ),
        (
            lambda w: ops.lacking(w, w[:, :4].clone(), *[w[0]] * 3, w[0].long(), w, 0, 0, 2),
            "parent_t must be (4,) int32",
        ),
        (lambda w: ops.link(w, w.short(), w[0], w[0], 3), "kind must be REQUEST_LOAD"),
        (lambda w: ops.link(w, w.short(), w[0], w[0], "x"), "kind must be an int"),
        (lambda w: ops.link(w, w.short(), w[0], w[0], LOAD, backend="gpu"), "backend must be auto"),
        (
            lambda w: ops.choose_requests(
                w.view(1, 2, 16), w[:, :4].clone(), w[0, :2].long(), 8, 1, "fine"
            ),
            "coarse_first must be a bool, got str",
        ),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError) as caught:
        call(torch.zeros((4, 8), dtype=torch.int32))
    assert message in str(caught.value)
