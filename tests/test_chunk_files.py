"""Invalid files of chunks: Blosc that would unpack to gigabytes, files of any length, pipes,
folders. Each costs only its own chunk, and is reported in one line.
"""

from __future__ import annotations

import os
import struct
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import Library
from helpers.stores import noise, serving

import gvtorch as gv
from gvtorch.io import http, relay
from gvtorch.io.stores.chunk_files import METADATA_FILES, ChunkFiles, begin_read
from gvtorch.io.stores.tensorstores import kvstore, opened_at

ts = Library("tensorstore")

SHAPE = (12, 9, 10)
CHUNK = [4, 3, 5]
SHARD = [8, 6, 10]
LZ4 = {"cname": "lz4", "clevel": 5, "shuffle": "noshuffle", "blocksize": 0, "typesize": 2}
BLOSC = {"name": "blosc", "configuration": LZ4}
LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
BIG = {"name": "bytes", "configuration": {"endian": "big"}}
CRC = {"name": "crc32c"}
TURN = {"name": "transpose", "configuration": {"order": [2, 0, 1]}}


def zarr3(chunk: list[int], *codecs: dict[str, Any], **more: Any) -> dict[str, Any]:
    grid = {"name": "regular", "configuration": {"chunk_shape": chunk}}
    about = {"shape": list(SHAPE), "data_type": "uint16", "chunk_grid": grid, "codecs": codecs}
    return {"driver": "zarr3", "metadata": {**about, **more}}


def sharded(chunk: list[int], inner: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    configuration = {"chunk_shape": chunk, "codecs": inner, "index_codecs": [LITTLE, CRC], **more}
    return {"name": "sharding_indexed", "configuration": configuration}


def zarr2(**more: Any) -> dict[str, Any]:
    packed = {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 0, "blocksize": 0}
    about = {"shape": SHAPE, "chunks": CHUNK, "dtype": "<u2", "compressor": packed}
    return {"driver": "zarr", "metadata": {**about, **more}}


def n5() -> dict[str, Any]:
    packed = {"type": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 0, "blocksize": 0}
    about = {"dimensions": SHAPE, "blockSize": CHUNK, "dataType": "uint16"}
    return {"driver": "n5", "metadata": {**about, "compression": packed}}


KINDS = {  # kind of array, and the offset of the first chunk in its file
    "zarr2": (zarr2(), 0),
    "zarr2 F, folders": (zarr2(order="F", dimension_separator="/"), 0),
    "zarr3": (zarr3(CHUNK, LITTLE, BLOSC), 0),
    "zarr3, names of zarr2": (zarr3(CHUNK, LITTLE, BLOSC, chunk_key_encoding={"name": "v2"}), 0),
    "zarr3, turned, with sums": (zarr3(CHUNK, TURN, LITTLE, CRC, BLOSC, CRC), 0),
    "shards": (zarr3(SHARD, sharded(CHUNK, [LITTLE, BLOSC, CRC])), 0),
    "shards, turned inside": (zarr3(SHARD, sharded(CHUNK, [TURN, LITTLE, BLOSC])), 0),
    "shards, turned": (zarr3(SHARD, TURN, sharded([5, 4, 3], [LITTLE, BLOSC])), 0),
    "shards, index first": (
        zarr3(SHARD, sharded(CHUNK, [LITTLE, BLOSC], index_location="start", index_codecs=[BIG])),
        8 * 16,
    ),
    "n5": (n5(), 16),
}


@pytest.fixture(params=KINDS)
def stored(request, tmp_path) -> Path:
    """An empty array of each kind."""
    kind = KINDS[request.param][0]
    spec = {**kind, "kvstore": {"driver": "file", "path": f"{tmp_path}/a/"}}
    ts.open(spec, create=True).result()
    return tmp_path / "a"


def opened(location: str | Path, folder: Path) -> Any:
    heads = {"zarr.json": "zarr3", ".zarray": "zarr", "attributes.json": "n5"}
    driver = next(driver for name, driver in heads.items() if (folder / name).exists())
    return opened_at(kvstore(location), {"driver": driver}).result()


def read(view: Any) -> Any:
    return begin_read(view, ChunkFiles.of(view))


def box(index: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(slice(a * n, (a + 1) * n) for a, n in zip(index, CHUNK, strict=True))


def swell(folder: Path, offset: int) -> Path:
    """Makes the header of the only chunk claim that it holds a gigabyte."""
    (file,) = (
        path for path in folder.rglob("*") if path.is_file() and path.name not in METADATA_FILES
    )
    content = bytearray(file.read_bytes())
    assert 120 <= struct.unpack_from("<I", content, offset + 4)[0] <= 124
    struct.pack_into("<I", content, offset + 4, 1 << 30)
    file.write_bytes(content)
    return file


@pytest.mark.parametrize("remote", [False, True], ids=["disk", "http"])
@pytest.mark.parametrize("index", [(0, 0, 0), (1, 2, 1), (2, 0, 1)])
def test_a_chunk_that_swells_costs_itself(stored, request, index, remote, tmp_path):
    kind = request.node.callspec.params["stored"]
    array = opened(stored, stored)
    array[box(index)].write(7).result()
    assert (read(array).result() == 7).sum() == 60
    file = swell(stored, KINDS[kind][1])
    with serving(tmp_path) if remote else nullcontext(tmp_path) as root:
        array = opened(f"{root}/a", stored)
        lists = [range(cut.start, cut.stop) for cut in box(index)]
        points = array.vindex[tuple([0, cut.start] for cut in box(index))]
        for view in (array, array[box(index)], array.oindex[tuple(map(list, lists))], points):
            with pytest.raises(Exception, match=r"Blosc|40[03]"):
                read(view).result(timeout=30)
        if remote:
            assert "Blosc would make 1073741824 bytes of a chunk" in relay.with_urls(
                f'Error opening "a": {relay.relay_folder(f"{root}/a/").spec["base_url"]}'
                f"{file.relative_to(stored)}: "
            )
        if kind == "shards, turned":  # all chunks of a file are checked
            return
        others = [other for other in np.ndindex(3, 3, 2) if other != index]
        for other in others:
            assert not read(array[box(other)]).result(timeout=30).any()
        each = tuple((np.array(others) * CHUNK).T)
        assert not read(array.vindex[each]).result(timeout=30).any()
        files = ChunkFiles.of(array)
        assert bool(files.folder) != remote
        if files.folder:
            files.check(np.array(others))
            with pytest.raises(http.Endless, match="Blosc would make"):
                files.check(np.array([*others, index]))


@pytest.mark.parametrize("kind", ["pipe", "folder", "long", "device"])
def test_what_is_no_file_of_a_chunk_is_told(stored, kind):
    array = opened(stored, stored)
    array[box((0, 0, 0))].write(7).result()
    (file,) = (
        path for path in stored.rglob("*") if path.is_file() and path.name not in METADATA_FILES
    )
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "folder":
        file.mkdir()
    elif kind == "device":
        file.symlink_to("/dev/zero")
    else:
        with file.open("wb") as out:
            out.truncate(1 << 33)
    reason = "takes 8589934592 bytes, more than the" if kind == "long" else "is not a regular file"
    with pytest.raises(http.Endless, match=f"{file.relative_to(stored)}: {reason}"):
        read(array).result(timeout=60)
    assert not read(array[box((2, 2, 1))]).result().any()
    head = next(stored / head for head in METADATA_FILES if (stored / head).exists())
    head.unlink()
    file.rename(head)
    with pytest.raises(http.Endless, match=f"{head.name}: {reason}"):
        opened_at(kvstore(stored), {"driver": "n5"}).result(timeout=60)


def test_places_are_known_of_items_that_are_chunks_alone():
    zyx, item = np.array([[1, 2, 3], [4, 5, 6]]), (34, 34, 34, 1)
    plain = {"folder": "/", "separator": "/", "item_bytes": 1}
    for first, time in (((1, 1, 1), []), ((1, 1, 1, 1), [7])):
        files = ChunkFiles(**plain, file=(*first, *item), chunk=(*first, *item))
        expected = [[*time, *index, 0, 0, 0, 0] for index in zyx.tolist()]
        assert files.chunk_indices(7, zyx, item).tolist() == expected
        assert replace(files, transposed=True).chunk_indices(7, zyx, item) is None
        assert replace(files, chunk=(2, *files.chunk[1:])).chunk_indices(7, zyx, item) is None
        assert replace(files, chunk=(*files.chunk[:-1], 2)).chunk_indices(7, zyx, item) is None
    assert replace(files, chunk=item, file=item).chunk_indices(7, zyx, item) is None


def test_blosc_inside_another_codec_is_refused(tmp_path):
    packed = {"name": "gzip", "configuration": {"level": 5}}
    location = {"driver": "file", "path": f"{tmp_path}/a/"}
    spec = {**zarr3(CHUNK, LITTLE, BLOSC, packed), "kvstore": location}
    ts.open(spec, create=True).result().write(1).result()
    with pytest.raises(ValueError, match="a: Blosc lies inside gzip, where its output can't"):
        gv.read_volume(tmp_path / "a", axes="zyx")


def test_blocks_of_a_store_that_swell_cost_themselves(tmp_path):
    """Each kind of array that `convert` writes."""
    data = torch.from_numpy(noise((80, 70, 90), "float32"))[..., None]
    store = gv.convert(data, tmp_path / "a.zarr", block=32)
    blocks = np.argwhere(np.ones(store.block_grid(0)))
    good, errors = store.read_blocks(0, blocks)
    assert not errors
    for kind, read in (
        ("gvtorch/blocks/0", lambda: store.read_blocks(0, blocks)),
        ("gvtorch/cells/1", lambda: store.read_cells(1, (0, 0, 0), (1, 1, 1))),
        ("1", lambda: store.read_region(1, (0, 0, 0), (9, 9, 9))),
    ):
        files = ChunkFiles.of(opened(tmp_path / "a.zarr" / kind, tmp_path / "a.zarr" / kind))
        (file,) = (f for f in (tmp_path / "a.zarr" / kind / "c").rglob("0") if f.is_file())
        content = bytearray(file.read_bytes())
        begin = int(files.entries(bytes(content[files.index_part])).min())
        struct.pack_into("<I", content, begin + 4, (1 << 31) - 1)
        file.write_bytes(content)
        if kind == "gvtorch/blocks/0":
            actual, errors = read()
            assert len(errors) == 1 and "Blosc would make 2147483647 bytes" in next(
                iter(errors.values())
            )
            rest = np.delete(np.arange(len(blocks)), list(errors))
            assert np.array_equal(actual[rest], good[rest]) and not actual[list(errors)].any()
        else:
            with pytest.raises(OSError, match="Blosc would make 2147483647 bytes of a chunk"):
                read()
