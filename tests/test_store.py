"""Reading stores: ours, bit for bit, and any other OME-Zarr image; and everything that can fail."""

from __future__ import annotations

import gzip
import itertools
import json
import math
import shutil
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest
import tensorstore as ts
import torch
from helpers.stores import Handler, assert_holds, block_of, noise, serving, write_foreign
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base.boxes import repeat_edges
from gvtorch.base.downsample import pool_mean
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.level_reader import StoreError
from gvtorch.io.stores.store import Store

DTYPES = ["uint8", "int8", "uint16", "int16", "float16", "float32"]


@settings(
    max_examples=16,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    long=st.integers(1, 170),
    short=st.tuples(st.integers(1, 35), st.integers(1, 35)),
    axis=st.integers(0, 2),
    dtype=st.sampled_from(DTYPES),
    width=st.sampled_from([1, 3]),
    block=st.sampled_from([32, 64]),
    seed=st.integers(0, 99),
)
def test_a_store_has_the_bits_of_the_pyramid(
    tmp_path, long, short, axis, dtype, width, block, seed
):
    shape = [*short]
    shape.insert(axis, long)
    data = noise((*shape, width), dtype, seed)
    folder = tmp_path / "property.zarr"
    shutil.rmtree(folder, ignore_errors=True)
    store = convert(gv.Volume(data, (1, 2, 3), (4, 5, 6)), folder, block=block, workers=1)
    assert store.spacing == (1, 2, 3) and store.origin == (4, 5, 6)
    low, high = data.min((0, 1, 2)), data.max((0, 1, 2))
    assert store.value_range == list(zip(low.tolist(), high.tolist(), strict=True))
    assert_holds(store, data)


def test_voxels_beyond_a_grid_are_those_of_its_edge():
    """Of boxes that reach beyond a grid, lie inside it, or miss it."""
    pick = np.random.default_rng(1)
    for _ in range(300):
        low, shape, start = pick.integers(-9, 9, 3), pick.integers(1, 6, 3), pick.integers(-3, 4, 3)
        high, data = low + pick.integers(1, 9, 3), noise((*shape, 2))
        index = [
            np.arange(a, b).clip(0, n - 1)
            for a, b, n in zip(low - start, high - start, shape, strict=True)
        ]
        assert np.array_equal(repeat_edges(data, start, low, high), data[np.ix_(*index)])


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    return noise((70, 45, 90, 1))


@pytest.fixture(scope="module")
def whole(tmp_path_factory, data) -> Path:
    """A store that no test changes."""
    folder = tmp_path_factory.mktemp("stores") / "whole.zarr"
    convert(gv.Volume(data, (1, 1, 2)), folder)
    return folder


@pytest.fixture
def damaged(tmp_path, whole) -> Path:
    """A copy for damaging."""
    return Path(shutil.copytree(whole, tmp_path / "damaged.zarr"))


def test_metadata_is_ome_zarr(whole, data):
    import ome_zarr_models
    import yaozarrs
    import zarr

    yaozarrs.validate_zarr_store(str(whole))
    group = zarr.open_group(whole, mode="r")
    image = ome_zarr_models.open_ome_zarr(group)
    assert type(image).__name__ == "Image" and image.ome_zarr_version == "0.5"
    assert np.array_equal(group["0"][:], data[..., 0])
    transforms = image.ome_attributes.multiscales[0].datasets[1].coordinateTransformations
    assert transforms[0].scale == [4.0, 2.0, 2.0] and transforms[1].translation == [1.0, 0.5, 0.5]
    assert group["gvtorch/blocks/0"].chunks == (1, 1, 1, 34, 34, 34, 1)


def test_channels_have_their_axis(tmp_path):
    import yaozarrs

    data = noise((20, 30, 40, 3), "uint16")
    convert(gv.Volume(data), tmp_path / "rgb.zarr")
    yaozarrs.validate_zarr_store(str(tmp_path / "rgb.zarr"))
    store = Store.open(tmp_path / "rgb.zarr", channels=[2, 0])
    assert store.width == 2 and store.value_range is not None and len(store.value_range) == 2
    assert_holds(store, np.ascontiguousarray(data[..., [2, 0]]))


def test_empty_blocks_are_not_written_and_read_right(tmp_path):
    data = np.zeros((64, 64, 64, 1), np.uint8)
    data[:, :, 40:] = np.random.default_rng(0).integers(0, 9, (64, 64, 24, 1))
    data[5, 5, 60] = 200
    full = convert(gv.Volume(data), tmp_path / "full.zarr")
    cut = convert(gv.Volume(data), tmp_path / "cut.zarr", threshold=100)
    assert cut.threshold == 100 and full.threshold is None
    sizes = [s.describe()["disk bytes"] for s in (full, cut)]
    assert sizes[1] < sizes[0]
    assert_holds(full, data)
    assert_holds(cut, data)


def test_regions_beyond_the_volume_repeat_its_faces(whole, data):
    store = Store.open(whole)
    actual = store.read_region(0, (-3, 40, 85), (2, 50, 99))
    z, y, x = np.arange(-3, 2), np.arange(40, 50), np.arange(85, 99)
    expected = data[np.ix_(z.clip(0), y.clip(0, 44), x.clip(0, 89))]
    assert np.array_equal(actual, expected)
    assert (store.read_region(0, (-9, -9, -9), (-8, -8, -8)) == data[0, 0, 0]).all()
    with pytest.raises(ValueError, match="low < high"):
        store.read_region(0, (0, 0, 0), (0, 1, 1))
    with pytest.raises(ValueError, match="lies outside the grid"):
        store.read_blocks(0, np.array([[0, 0, 3]]))
    with pytest.raises(ValueError, match="lies outside the grid"):
        store.read_cells(0, (0, 0, 0), (99, 1, 1))
    with pytest.raises(ValueError, match="level must be an int >= 0 and <= 4"):
        store.read_region(5, (0, 0, 0), (1, 1, 1))


def test_many_threads_read_the_same(whole, data):
    store = Store.open(whole)
    positions = np.array(list(np.ndindex(*store.block_grid(0))) * 4)
    expected, _ = store.read_blocks(0, positions)
    wrong = []

    def read() -> None:
        for _ in range(3):
            if not np.array_equal(store.read_blocks(0, positions)[0], expected):
                wrong.append(1)

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


# --- damage


def first_file(folder: Path) -> Path:
    return next(file for file in sorted((folder / "c").rglob("*")) if file.is_file())


def test_a_missing_chunk_is_an_error_of_its_block(damaged, data):
    first_file(damaged / "gvtorch/blocks/0").unlink()
    store = Store.open(damaged)
    positions = np.array(list(np.ndindex(*store.block_grid(0))))
    errors = store.read_blocks(0, positions)[1]
    varied = [i for i, position in enumerate(positions) if np.ptp(block_of(data, position, 32))]
    assert sorted(errors) == varied
    z, y, x = positions[varied[0]]
    name = f"{damaged}: block ({z}, {y}, {x}) z y x of level 0: missing chunk"
    assert errors[varied[0]] == name
    assert not store.read_blocks(1, positions[:1])[1], "other levels are whole"


def test_a_missing_shard_of_cells_is_an_error(damaged):
    first_file(damaged / "gvtorch/cells/0").unlink()
    store = Store.open(damaged)
    with pytest.raises(StoreError, match=r"cells/0: shard \(0, 0, 0\) z y x: missing chunk"):
        store.read_cells(0, (0, 0, 0), (2, 2, 2))


@pytest.mark.parametrize("width", [1, 2])
def test_a_missing_shard_of_the_pyramid_is_an_error(tmp_path, width):
    data = noise((10, 10, 300, width))
    data[:, :, :100] = 0
    store = convert(gv.Volume(data), tmp_path / "a.zarr")
    assert not store.read_region(0, (-2, -2, -2), (5, 5, 5)).any(), "zeros that are there"
    files = sorted(file for file in (tmp_path / "a.zarr/0/c").rglob("*") if file.is_file())
    files[-1].unlink()
    store = Store.open(tmp_path / "a.zarr")
    assert np.array_equal(store.read_region(0, (0, 0, 0), (10, 10, 256)), data[:, :, :256])
    with pytest.raises(StoreError, match=r"a\.zarr/0: shard \(0, 0, 1\) z y x: missing chunk"):
        store.read_region(0, (-2, 0, 200), (10, 10, 310))


def test_a_corrupt_chunk_is_an_error_of_its_block_alone(damaged, data):
    file = first_file(damaged / "gvtorch/blocks/0")
    content = bytearray(file.read_bytes())
    content[100] ^= 0xFF
    file.write_bytes(content)
    store = Store.open(damaged)
    positions = np.array(list(np.ndindex(*store.block_grid(0))))
    blocks, errors = store.read_blocks(0, positions)
    assert len(errors) == 1
    ((bad, text),) = errors.items()
    assert text.startswith(f"{damaged}: block") and "level 0" in text and "\n" not in text
    assert not blocks[bad].any()
    for i in set(range(len(positions))) - {bad}:
        assert np.array_equal(blocks[i], block_of(data, positions[i], 32))
    file = first_file(damaged / "0")
    file.write_bytes(file.read_bytes()[:-7])
    with pytest.raises(StoreError, match=r"damaged\.zarr/0"):
        store.read_region(0, (0, 0, 0), (9, 9, 9))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"complete": False}, "half-written or damaged"),
        ({"version": 3}, "store version 3, this reads 1 and 2"),
        ({"version": 2}, "damaged: gvtorch.times"),
        ({"times": 2}, "damaged: gvtorch.times"),
        ({"version": 2, "times": 2}, "metadata and level 0 differ"),
        ({"extent": [2**41, 1, 1]}, "damaged: gvtorch.extent"),
        ({"extent": [90, 45, 71]}, "metadata and level 0 differ"),
        ({"block": 33}, "damaged: gvtorch.block"),
        ({"value_range": [[0]]}, "damaged: gvtorch.value_range"),
        ({"value_range": [[0, math.nan]]}, "damaged: gvtorch.value_range"),
        ({"value_range": [[False, True]]}, "damaged: gvtorch.value_range"),
        ({"value_range": [[2, 1]]}, "damaged: gvtorch.value_range"),
        ({"threshold": math.inf}, "damaged: gvtorch.threshold"),
        ({"threshold": 10**400}, "damaged: gvtorch.threshold"),
        ({"dtype": "float64"}, "damaged: gvtorch.dtype"),
    ],
)
def test_wrong_metadata_is_refused(damaged, change, message):
    file = damaged / "zarr.json"
    content = json.loads(file.read_text())
    content["attributes"]["gvtorch"].update(change)
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        Store.open(damaged)


def test_what_is_no_store_is_refused(tmp_path, whole):
    with pytest.raises(FileNotFoundError, match="store not found"):
        Store.open(tmp_path / "none.zarr")
    with pytest.raises(ValueError, match=r"not a store: has neither zarr.json nor .zattrs"):
        Store.open(tmp_path)
    (tmp_path / "zarr.json").write_text('{"node_type": "group", "attri')
    with pytest.raises(ValueError, match="damaged JSON"):
        Store.open(tmp_path)
    (tmp_path / "zarr.json").write_text('{"node_type": "group", "attributes": {}}')
    with pytest.raises(ValueError, match="has no multiscale image"):
        Store.open(tmp_path)
    (tmp_path / "zarr.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="damaged JSON"):
        Store.open(tmp_path)
    with pytest.raises(ValueError, match="group"):
        Store.open(whole / "0")
    with pytest.raises(ValueError, match="has no image 'other'"):
        Store.open(whole, image="other")
    with pytest.raises(ValueError, match="has no time 1"):
        Store.open(whole, time=1)
    with pytest.raises(ValueError, match=r"has no channels \[1\]"):
        Store.open(whole, channels=[1])


# --- foreign images


def pyramid(data_zyxc: np.ndarray, count: int) -> list[np.ndarray]:
    """Returns levels of factor 2, finest first."""
    levels = [data_zyxc]
    for _ in range(count - 1):
        levels.append(pool_mean(levels[-1], 2))
    return levels


@pytest.mark.parametrize(
    ("version", "sharded", "axes", "dtype"),
    [
        (2, False, "zyx", "uint8"),
        (2, False, "tczyx", ">u2"),
        (3, False, "czyx", "int16"),
        (3, True, "zyx", "float32"),
        (3, True, "tczyx", "uint8"),
        (3, False, "xyzc", "int8"),
    ],
)
def test_foreign_images_hold_the_same(tmp_path, version, sharded, axes, dtype):
    width = 2 if "c" in axes else 1
    kind = np.dtype(dtype).newbyteorder("=").name
    data = noise((37, 30, 50, width), kind)
    stored = []
    for level in pyramid(data, 3):  # coarser ones are missing and made on demand
        letters = "zyxc"
        array = level if "c" in axes else level[..., 0]
        if "t" in axes:
            array, letters = np.stack([array * 0, array]), "tzyxc"
        array = array.transpose([letters.index(a) for a in axes])
        stored.append(array.astype(dtype))
    scales = [[0.5 * 2.0**n if a in "zyx" else 1.0 for a in axes] for n in range(3)]
    write_foreign(tmp_path, stored, axes, scales, version=version, sharded=sharded)
    store = Store.open(tmp_path, time=1 if "t" in axes else 0)
    assert not store.has_blocks and store.value_range is None and store.spacing == (0.5,) * 3
    assert store.width == width and store.dtype == getattr(torch, kind)
    assert_holds(store, data)
    with pytest.raises(ValueError, match="has no cells"):
        store.read_cells(0, (0, 0, 0), (1, 1, 1))
    if width == 2:
        opened = Store.open(tmp_path, time=1 if "t" in axes else 0, channels=[1])
        assert_holds(opened, np.ascontiguousarray(data[..., 1:]))


def test_scales_that_leave_z_alone(tmp_path):
    data = noise((12, 40, 70, 1))
    levels = [data, pool_mean(data, (1, 2, 2)), pool_mean(pool_mean(data, (1, 2, 2)), (1, 2, 2))]
    scales = [[4.0, 1, 1], [4.0, 2, 2], [4.0, 4, 4]]
    write_foreign(tmp_path, [level[..., 0] for level in levels], "zyx", scales)
    store = Store.open(tmp_path)
    assert store.spacing == (1, 1, 4) and store.levels == 5
    for level, factor in ((1, (2, 1, 1)), (2, (4, 1, 1))):
        expected = pool_mean(levels[level], factor)
        actual = store.read_region(level, (0, 0, 0), expected.shape[:3])
        assert np.array_equal(actual, expected)
    third = pool_mean(pool_mean(levels[2], (4, 1, 1)), 2)
    actual = store.read_region(3, (0, 0, 0), third.shape[:3])
    assert np.abs(actual.astype(int) - third).max() <= 1, "rounded once or twice"


def test_scales_that_dropped_a_last_voxel(tmp_path):
    """Many writers halve 45 to 22: beyond that, the outermost voxel is repeated."""
    data = noise((45, 45, 45, 1))
    half = pool_mean(data[:44, :44, :44], 2)
    write_foreign(
        tmp_path, [data[..., 0], half[..., 0]], "zyx", [[1.0] * 3, [45 / 22] * 3], version=2
    )
    store = Store.open(tmp_path)
    actual = store.read_region(1, (0, 0, 0), (23, 23, 23))
    assert np.array_equal(actual[:22, :22, :22], half) and np.array_equal(
        actual[22, :22, :22], half[-1]
    )


@pytest.mark.parametrize("differs", ["times", "channels", "dtype", "place"])
def test_levels_that_differ_in_more_than_size_are_made_instead(tmp_path, differs):
    data = np.full((3, 2, 16, 16, 16), 7, np.uint8)
    half = data[:, :, ::2, ::2, ::2] + 90
    half = {"times": half[:2], "channels": half[:, :1], "dtype": half + 0.5}.get(differs, half)
    write_foreign(tmp_path, [data, half], "tczyx", [[1.0] * 5, [1.0, 1.0, 2.0, 2.0, 2.0]])
    if differs == "place":
        file = tmp_path / "zarr.json"
        content = json.loads(file.read_text())
        level = content["attributes"]["ome"]["multiscales"][0]["datasets"][1]
        move = {"type": "translation", "translation": [0, 0, 0, 0, 40]}
        level["coordinateTransformations"].append(move)
        file.write_text(json.dumps(content))
    values = Store.open(tmp_path, time=2, channels=[1]).read_region(1, (0, 0, 0), (8, 8, 8))
    assert (values == 7).all()


def test_two_dimensional_images_are_one_slice(tmp_path):
    data = noise((1, 40, 70, 1))
    write_foreign(tmp_path, [data[0, ..., 0]], "yx", [[1.0, 1.0]])
    assert_holds(Store.open(tmp_path), data)


def test_images_by_name_and_folder(tmp_path):
    data = noise((9, 9, 9, 1))
    write_foreign(tmp_path / "0", [data[..., 0]], "zyx", [[1.0] * 3], version=2, name="first")
    write_foreign(tmp_path / "b", [data[..., 0] + 1], "zyx", [[1.0] * 3], version=2)
    (tmp_path / ".zgroup").write_text('{"zarr_format": 2}')
    (tmp_path / ".zattrs").write_text('{"bioformats2raw.layout": 3}')
    assert Store.open(tmp_path).read_region(0, (0, 0, 0), (1, 1, 1))[0, 0, 0, 0] == data[0, 0, 0, 0]
    other = Store.open(tmp_path, image="b")
    assert other.read_region(0, (0, 0, 0), (1, 1, 1))[0, 0, 0, 0] == data[0, 0, 0, 0] + 1
    assert Store.open(tmp_path / "0", image="first").extent == (9, 9, 9)
    with pytest.raises(ValueError, match=r"has no image '\.\./0'.*; it holds a$"):
        Store.open(tmp_path / "b", image="../0")
    several = [{"name": name} for name in ("x" * 100, *"bcdefg")]
    (tmp_path / ".zattrs").write_text(json.dumps({"multiscales": several}))
    with pytest.raises(ValueError, match=r"; it holds 'x+\.\.\.x+', b, c, d, e and 2 more$"):
        Store.open(tmp_path, image="none")


def test_foreign_mistakes_are_one_line(tmp_path):
    cube = np.zeros((4, 4, 4), np.complex64)
    write_foreign(tmp_path / "a", [cube], "zyx", [[1.0] * 3], version=2)
    with pytest.raises(ValueError, match="dtype complex64 is unknown; known: uint8"):
        Store.open(tmp_path / "a")
    write_foreign(tmp_path / "b", [cube.real], "zyx", [[1.0] * 3])
    file = tmp_path / "b" / "s0" / "zarr.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "shape": [2**20] * 3}))
    with pytest.raises(ValueError, match="voxels are more than"):
        Store.open(tmp_path / "b")
    grid = {"name": "regular", "configuration": {"chunk_shape": [2**14] * 3}}
    file.write_text(json.dumps({**content, "chunk_grid": grid}))
    with pytest.raises(ValueError, match="a chunk takes"):
        Store.open(tmp_path / "b")
    file.write_text("{")
    with pytest.raises(ValueError, match="damaged JSON"):
        Store.open(tmp_path / "b")
    root = tmp_path / "b" / "zarr.json"
    root.write_text(root.read_text().replace('"s0"', '"../a/s0"'))
    with pytest.raises(ValueError, match="needs a path inside the store"):
        Store.open(tmp_path / "b")


def test_levels_that_are_missing_are_made_once(tmp_path, monkeypatch):
    data = noise((140, 10, 10, 1))
    write_foreign(tmp_path, [data[..., 0]], "zyx", [[1.0] * 3])
    store = Store.open(tmp_path)
    assert_holds(store, data)
    monkeypatch.setattr(store._levels, "_pool", lambda *_: pytest.fail("made again"))
    store.read_region(2, (0, 0, 0), (35, 3, 3))


# --- over the network


@pytest.fixture
def served(whole):
    """URL of the folder that holds the store."""
    with serving(whole.parent) as url:
        yield url


def test_a_store_behind_http(served, data):
    store = Store.open(f"{served}/whole.zarr")
    assert store.has_blocks
    positions = np.array(list(itertools.islice(np.ndindex(*store.block_grid(0)), 5)))
    blocks, errors = store.read_blocks(0, positions)
    assert not errors
    for block, position in zip(blocks, positions, strict=True):
        assert np.array_equal(block, block_of(data, position, 32))
    with pytest.raises(ValueError, match="not a store"):
        Store.open(f"{served}/none.zarr")


@pytest.mark.parametrize("version", [2, 3])
def test_a_server_is_asked_once_for_labels(tmp_path, version, monkeypatch):
    write_foreign(tmp_path / "a", [noise((5, 6, 7))], "zyx", [[1.0] * 3], version=version)
    asked: list[str] = []
    answer = Handler.do_GET
    monkeypatch.setattr(Handler, "do_GET", lambda self: (asked.append(self.path), answer(self)))
    with serving(tmp_path) as url:
        Store.open(f"{url}/a")
    assert len([path for path in asked if "labels" in path]) == 1, asked


def test_reads_end_in_time(served):
    store = Store.open(f"{served}/whole.zarr")
    Handler.delay = 1.5
    positions = np.array([[0, 0, 2]])
    for read in (
        lambda: store.read_blocks(0, positions, timeout=0.2),
        lambda: store.read_region(0, (0, 0, 0), (9, 9, 9), timeout=0.2),
        lambda: store.read_cells(0, (0, 0, 0), (1, 1, 1), timeout=0.2),
    ):
        with pytest.raises(TimeoutError, match=r"no answer within 0\.2 s"):
            read()


class OddHandler(Handler):
    """Serves as `how` says: files that are not there, or what is sent of others."""

    how = ""

    def do_GET(self) -> None:
        file = Path(self.translate_path(self.path))
        if file.is_file() and self.how not in ("gzip", "deflate"):
            super().do_GET()
            return
        content = b" <!doctype html><title>app</title>"
        if file.is_file():
            pack = gzip.compress if self.how == "gzip" else zlib.compress
            content = pack(file.read_bytes())
        is_missing = not file.is_file() and self.how != "page"
        self.send_response((403 if self.how == "forbidden" else 404) if is_missing else 200)
        if file.is_file():
            self.send_header("Content-Encoding", self.how)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)


@pytest.mark.parametrize("how", ["forbidden", "page", "gzip", "deflate"])
def test_servers_that_answer_in_ways_of_their_own(tmp_path, how, monkeypatch):
    """Buckets that can't be listed; apps that send a page for any path; files packed on the way."""
    monkeypatch.setattr(OddHandler, "how", how)
    empty = np.zeros((40, 300, 40), np.uint8)
    empty[:, 280:] = noise((40, 20, 40))
    convert(gv.Volume(empty), tmp_path / "own", threshold=1)  # not all shards of blocks are there
    write_foreign(tmp_path / "foreign", [empty + 1], "zyx", [[1.0] * 3], version=2)
    with serving(tmp_path, OddHandler) as url:
        for name, expected in (("own", empty), ("foreign", empty + 1)):
            store = Store.open(f"{url}/{name}")
            assert np.array_equal(store.read_region(0, (0, 0, 0), empty.shape)[..., 0], expected)
            positions = np.array(list(np.ndindex(*store.block_grid(0))))
            _, errors = store.read_blocks(0, positions)
            assert not errors or how == "page", errors
        with pytest.raises(ValueError, match=r"not a store: has neither zarr\.json nor"):
            Store.open(f"{url}/none")


def test_stores_in_memory_open_too():
    from gvtorch.io.stores.tensorstores import context

    root = ts.KvStore.open("memory://gvtorch-test/", context=context()).result()
    image = {"axes": ["z", "y", "x"], "datasets": [{"path": "0"}]}
    root["zarr.json"] = json.dumps(
        {"node_type": "group", "attributes": {"ome": {"multiscales": [image]}}}
    )
    array = ts.open(
        {"driver": "zarr3", "kvstore": "memory://gvtorch-test/0/"},
        **{"dtype": ts.uint8, "shape": [5, 6, 7], "create": True, "context": context()},
    ).result()
    array[...] = np.arange(5 * 6 * 7, dtype=np.uint8).reshape(5, 6, 7)
    store = Store.open("memory://gvtorch-test/")
    assert store.extent == (7, 6, 5)
    expected = math.prod((5, 6, 7)) - 1
    assert store.read_region(0, (4, 5, 6), (5, 6, 7))[0, 0, 0, 0] == expected
