"""Forged OpenVDB and NanoVDB files: read as they say, or refused in one line."""

from __future__ import annotations

import struct
import tracemalloc
import warnings

import numpy as np
import pytest
from helpers import Library
from helpers.vdb import (
    BOX,
    HIGH,
    LOW,
    NANO,
    Grid,
    VdbWriter,
    assert_reads,
    leaf_values,
    nano_file,
    nano_grid,
)

import gvtorch as gv
from gvtorch.io.reading import open_source

Library("imagecodecs")


def refused(path, content: bytes, reason: str) -> None:
    path.write_bytes(content)
    with pytest.raises(ValueError, match=reason) as caught:
        gv.read_volume(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_hostile_files_of_openvdb(tmp_path):
    grid = Grid("float", 7, metadata=BOX)
    leaf_values(grid, np.random.default_rng(3))
    path = tmp_path / "a.vdb"
    good = VdbWriter().write(path, grid).read_bytes()
    refused(path, b"\0" * 100, "does not start like a VDB file")
    refused(path, good[:8] + struct.pack("<I", 219) + good[12:], "is of file version 219")
    refused(path, good[:-700], "in a file of")
    huge = {name: (kind, struct.pack("<3i", *(n,) * 3)) for (name, (kind, _)), n in
            zip(BOX.items(), (-(2**31), 2**31 - 1), strict=True)}  # fmt: skip
    refused(path, VdbWriter().write(path, Grid("float", 7, metadata=huge)).read_bytes(), "voxels")
    refused(path, VdbWriter().write(path, Grid("float", 7)).read_bytes(), "the grid is empty")
    frustum = Grid("float", 7, metadata=BOX, map=("NonlinearFrustumMap", b"\0" * 200))
    refused(path, VdbWriter().write(path, frustum).read_bytes(), "NonlinearFrustumMap")
    points = VdbWriter().write(path, grid).read_bytes()
    points = points.replace(b"Tree_float_5_4_3", b"Tree_ptdat_5_4_3")
    refused(path, points, "is a Tree_ptdat_5_4_3; known are")
    lonely = Grid("float", 7, metadata=BOX, parent="other")
    refused(path, VdbWriter().write(path, lonely).read_bytes(), "shares the tree of 'other'")
    stream = VdbWriter().write(path, grid, has_offsets=False).read_bytes()
    refused(path, stream, "a stream without the positions of its grids")


def whole_leaf() -> tuple[np.ndarray, np.ndarray]:
    return np.arange(512, dtype="f4")[:, None], np.ones(512, bool)


@pytest.mark.parametrize("x", [1, -3, 4, 4095])
def test_entries_of_a_root_lie_on_its_grid(tmp_path, x):
    """Others were once read into leaves at wrong positions."""
    path = tmp_path / "a.vdb"
    grid = Grid("float", 0.0, leaves={(4096, 0, 0): whole_leaf()})
    good = VdbWriter().write(path, grid).read_bytes()
    upper = struct.pack("<2I3i", 0, 1, 4096, 0, 0)
    assert good.count(upper) == 1
    content = good.replace(upper, struct.pack("<2I3i", 0, 1, 4096 + x, 0, 0))
    refused(path, content, rf"root lies at \[{4096 + x}, 0, 0\]; expected multiples of 4096")
    tile = Grid("float", 0.0, tiles=({(x, 0, 0): 2.0}, {}, {}))
    refused(path, VdbWriter().write(path, tile).read_bytes(), rf"root lies at \[{x}, 0, 0\]")


def test_a_shared_tree_is_of_the_same_kind(tmp_path):
    """A vector grid was once read from a tree of scalars, three voxels at a time."""
    owner = Grid("float", 7, metadata=BOX, name="heat", leaves={(0, 0, 0): whole_leaf()})
    for kind in ("vec3s", "double", "int32", "mask"):
        path = tmp_path / f"{kind}.vdb"
        VdbWriter().write(path, owner, Grid(kind, 0, metadata=BOX, name="other", parent="heat"))
        with pytest.raises(
            ValueError, match=f"'other' is a Tree_{kind}_5_4_3, the tree that it sh"
        ):
            open_source(path, key="other")
    half = Grid("float", 0, metadata=BOX, name="half", parent="heat", half=True)
    assert_reads(VdbWriter().write(path, owner, half), owner.dense(LOW, HIGH), key="half")


def test_places_of_grids_and_leaves_are_in_order(tmp_path):
    """Overlapping grids, or wrong offsets of leaves, once gave other values silently."""
    path = tmp_path / "a.vdb"
    two = [Grid("float", 7, name=n, leaves={(0, 0, 0): whole_leaf()}) for n in ("a", "b")]
    good = VdbWriter(packing=0).write(path, *two).read_bytes()
    second = good.index(b"\1\0\0\0b\x10\0\0\0Tree_float")
    first = good.index(b"\1\0\0\0a\x10\0\0\0Tree_float")
    positions = [first + 29, second + 29]  # offsets of three numbers each
    offsets = [struct.unpack_from("<3q", good, position) for position in positions]
    assert offsets[0][2] == second and offsets[1][2] == len(good)

    def changed(grid_index: int, number: int, value: int) -> bytes:
        out = bytearray(good)
        struct.pack_into("<q", out, positions[grid_index] + 8 * number, value)
        return bytes(out)

    for grid_index, number, value, reason in (
        (1, 0, offsets[0][0], "from .* expected in this order"),  # the other's head
        (0, 2, first, "expected in this order"),  # backwards, without an end
        (0, 0, -1, "expected in this order"),
        (1, 1, offsets[1][2] + 1, "expected in this order"),
        (0, 1, offsets[0][1] + 4, r"leaves begin at \d+, the nodes above end at"),
        (0, 1, offsets[0][1] - 4, r"leaves begin at \d+, the nodes above end at"),
        (1, 2, offsets[1][1] + 100, f"ends at {offsets[1][1] + 100}, within"),  # within a leaf
    ):
        path.write_bytes(changed(grid_index, number, value))
        with pytest.raises(ValueError, match=reason):
            gv.read_volume(path, key="ab"[grid_index])


def test_a_background_of_nan_is_no_voxel(tmp_path):
    """All tiles were once treated as not background: 4096^3 voxels for a leaf."""
    grid = Grid(
        "float", np.nan, leaves={(8, 0, 0): whole_leaf()}, tiles=({(4096, 0, 0): np.nan}, {}, {})
    )
    source = open_source(VdbWriter(packing=0).write(tmp_path / "a.vdb", grid))
    assert source.low == (8, 0, 0) and source.extent == (8, 8, 8)
    assert np.array_equal(
        source.read_times(0, 1)[0].ravel(), np.arange(512).reshape(8, 8, 8).T.ravel()
    )
    volume = gv.read_volume(source.path, nan=-1)
    assert float(volume.data.min()) == 0


@pytest.mark.parametrize("number", [1e308, 1e200, np.inf, -np.inf, np.nan, 1e50, 1e20])
def test_places_beyond_numbers_are_one_line(tmp_path, number):
    """Numpy's warnings once preceded it; `info` accepted positions that `render` refused."""
    maps = {
        "TranslationMap": struct.pack("<3d", number, 2, 3),
        "ScaleMap": struct.pack("<15d", 1, number, 3, *(0,) * 12),
        "ScaleTranslateMap": struct.pack("<18d", 1, 2, 3, *(number,) * 3, *(0,) * 12),
        "AffineMap": struct.pack(
            "<16d", number, number, 0, 0, *(0, 1, 0, 0), *(1, 0, 1, 0), 0, 0, 0, 1
        ),
    }
    for name, content in maps.items():
        if number < (1e100 if name == "AffineMap" else 1e60 if "Scale" in name else 0):
            continue  # large, but valid
        grid = Grid("float", 0.0, leaves={(8, 0, 0): whole_leaf()}, map=(name, content))
        path = VdbWriter().write(tmp_path / "a.vdb", grid)
        reason = r"degenerate|must be finite|within|spacing must be"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            refused(path, path.read_bytes(), reason)
            with pytest.raises(ValueError, match=reason):
                open_source(path)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_thin_boxes_take_no_more_than_they_hold(tmp_path, axis):
    """Whole leaves around a line of voxels once took 64 times as much: 16 GB for a 12 kB file."""
    high = [3, 5, 1]
    high[axis] = 1_000_003
    box = {
        "file_bbox_min": ("vec3i", struct.pack("<3i", -3, 0, 0)),
        "file_bbox_max": ("vec3i", struct.pack("<3i", *(n - 1 for n in high))),
    }
    origins = [
        tuple(n // 8 * 8 if k == axis else 0 for k in range(3)) for n in (0, 65536, 1_000_000)
    ]
    grid = Grid("float", 7, metadata=box, leaves=dict.fromkeys(origins, whole_leaf()))
    source = open_source(VdbWriter().write(tmp_path / "a.vdb", grid))
    source.grid()
    tracemalloc.start()
    voxels = source.read_times(0, 1)[0, ..., 0].T
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert voxels.shape == tuple(b + 3 * (k == 0) for k, b in enumerate(high))
    assert taken < 2 * voxels.nbytes + 64 * 2**20
    for origin in (*origins, (0, 0, 0)):
        low = [max(0, p + 3 * (k == 0) - 9) for k, p in enumerate(origin)]
        part = voxels[tuple(slice(a, a + 30) for a in low)]
        begin = tuple(a - 3 * (k == 0) for k, a in enumerate(low))
        end = tuple(a + n for a, n in zip(begin, part.shape, strict=True))
        assert np.array_equal(part, grid.dense(begin, end)[..., 0])


def test_long_names_and_keys_are_short_lines(tmp_path):
    long = "x" * 100_000
    path = tmp_path / "a.vdb"
    values = {(0, 0, 0): whole_leaf()}
    for options in ({"name": long}, {"map": (long, b"")}):
        content = VdbWriter().write(path, Grid("float", 0.0, leaves=values, **options)).read_bytes()
        refused(path, content, "a name of 100000 bytes")
    many = [Grid("float", 0.0, name=f"{n}{long[:4000]}", leaves=values) for n in range(9)]
    VdbWriter().write(path, *many)
    for key in (long, "\u00b2", "9" * 5000, "9", "-1"):
        with pytest.raises(ValueError, match="has no grid") as options:
            open_source(path, key=key)
        assert len(str(options.value)) < 2000 and str(path) in str(options.value)


def test_nan_is_refused_or_replaced(tmp_path):
    values = np.arange(512, dtype="f4")[:, None]
    values[5] = np.nan
    grid = Grid("float", 0.0, leaves={(0, 0, 0): (values, np.ones(512, bool))})
    path = VdbWriter().write(tmp_path / "a.vdb", grid)
    with pytest.raises(ValueError, match="NaN"):
        gv.read_volume(path)
    assert float(gv.read_volume(path, nan=0).data[5, 0, 0, 0]) == 0


def test_hostile_files_of_nanovdb(tmp_path):
    content, (number, _) = nano_grid("float", np.random.default_rng(1))
    path = tmp_path / "a.nvdb"
    good = nano_file(path, ("a", number, content)).read_bytes()
    begin = len(good) - len(content)

    def changed(offset: int, layout: str, *numbers: int) -> bytes:
        out = bytearray(good)
        struct.pack_into(layout, out, begin + offset, *numbers)
        return bytes(out)

    refused(path, b"NanoVDB2" + struct.pack("<I", 29 << 21) + good[12:], "of version 29")
    refused(path, b"NotVDB.." + good[8:], "expected NanoVDB of version 32")
    refused(path, changed(736 + 24, "<I", 2**31), "a root of")
    refused(path, changed(736 + 64 + 8, "<q", 2**40), "a node lies outside of the grid")
    first, second = struct.unpack_from("<q", content, 808)[0], 736 + 64 + 32 + 8
    refused(path, changed(second, "<q", first), "several positions of the tree share a node")
    refused(path, changed(736, "<6i", *(0,) * 3, *(-9,) * 3), "has no active voxel")


def test_nodes_of_nanovdb_are_those_that_the_grid_tells_of(tmp_path):
    """Each once gave wrong values silently: another type's, half of the tree, misplaced tiles."""
    content, (number, _) = nano_grid("float", np.random.default_rng(1))
    _, head, _, tile, _, size, entries, lower_size, *_ = NANO["float"]
    path, root = tmp_path / "a.nvdb", 736 + head
    (upper,) = struct.unpack_from("<q", content, root + 8)
    leaf_at = root + 3 * tile + 2 * size + entries + 15 * 256 * 8  # in the first lower node
    (leaf,) = struct.unpack_from("<q", content, leaf_at)
    assert leaf == 2 * lower_size

    def forged(offset: int, layout: str, value: int, kind: int = number) -> bytes:
        out = bytearray(content)
        struct.pack_into(layout, out, offset, value)
        return nano_file(path, ("a", kind, bytes(out))).read_bytes()

    refused(path, forged(0, "<B", content[0], NANO["int16"][0]), "of type 1, its file declares 3")
    for count in (0, 1):
        refused(path, forged(736 + 24, "<I", count), "nodes, leaves first; it declares")
    for offset in range(3):
        refused(path, forged(672 + 32 + 4 * offset, "<I", 9), "nodes, leaves first; it declares")
    (key,) = struct.unpack_from("<Q", content, root)
    for bit in (20, 41, 62, 63):
        refused(path, forged(root, "<Q", key | 1 << bit), "not a voxel's position")
    for step in (1, 8, 16, -8):
        refused(path, forged(root + 8, "<q", upper + step), "at no multiple of 32 bytes")
    for step in (32, -32, 2112, -lower_size, -2 * lower_size):
        refused(path, forged(leaf_at, "<q", leaf + step), "nodes of the tree overlap")
    refused(path, forged(root + 8, "<q", -736), "a node lies outside")


def test_codes_that_are_no_numbers_are_voxels_that_are_none(tmp_path):
    content, (number, _) = nano_grid("Fp8", np.random.default_rng(1))
    out = bytearray(content)
    offset = len(content) - NANO["Fp8"][-1] + 80
    out[offset : offset + 8] = np.float32([np.nan, np.inf]).tobytes()
    path = nano_file(tmp_path / "a.nvdb", ("a", number, bytes(out)))
    with pytest.raises(ValueError, match="holds 512 values that are NaN"):
        gv.read_volume(path)
    assert gv.read_volume(path, nan=0).data.isfinite().all()


@pytest.mark.parametrize("compressor", ["lz4", "zstd", "blosclz"])
def test_only_the_first_block_of_blosc_is_unpacked_for_a_head(tmp_path, compressor):
    """A file of 33 KB once took 2 GB, because all its blocks had the same offset."""
    content, (number, box) = nano_grid("float", np.random.default_rng(1))
    large = content + bytes(64 << 20)
    path = nano_file(tmp_path / "a.nvdb", ("a", number, large), codec=2, compressor=compressor)
    tracemalloc.start()
    open_source(path)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size < 2 << 20 and taken < 4 << 20
    assert_reads(path, box)
    good = path.read_bytes()
    header = good.index(b"a\0") + 2 + 8  # after the name and the part's length
    for field, number, message in (
        (8, 2**31 - 1, "blosc_decompress"),
        (16, 2**31 - 1, "at byte 2147483647"),
        (8, 100, "a block of 100 bytes"),
    ):
        bad = bytearray(good)
        struct.pack_into("<I", bad, header + field, number)
        refused(path, bytes(bad), message)


@pytest.mark.parametrize(
    ("offset", "content", "message"),
    [
        (736 + 24, struct.pack("<I", 10_000_000), "a root of 10000000 entries"),
        (None, b"", "two entries of the root have one position"),
    ],
)
def test_roots_of_nanovdb_hold_few_entries_each_at_its_place(tmp_path, offset, content, message):
    """With millions of them at one position, every part that was read visited all."""
    data, (number, _) = nano_grid("float", np.random.default_rng(3))
    head = 736 + NANO["float"][1]
    size = NANO["float"][3]
    if offset is None:  # the tile is at the position of the first upper node
        offset, content = head + 2 * size, data[head : head + 8]
    data = data[:offset] + content + data[offset + len(content) :]
    file = nano_file(tmp_path / "a.nvdb", ("density", number, data))
    with pytest.raises(ValueError, match=message):
        gv.read_volume(file)
