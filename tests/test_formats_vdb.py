"""OpenVDB and NanoVDB: files of OpenVDB, Houdini and NanoVDB, what `warp` reads of them and
writes, and files that the tests write in every kind of numbers, packing and version.
"""

from __future__ import annotations

import pickle
import struct
import subprocess
import sys
import tracemalloc
import warnings
import zlib

import numpy as np
import pytest
from helpers import gvtorch, shared
from helpers.damage import assert_told
from helpers.vdb import ACTIVE, BLOSC, NANO, ZIP, Grid, VdbWriter, nano_file, nano_grid

import gvtorch as gv
from gvtorch.io import conversion_plan
from gvtorch.io.reading import open_source

pytest.importorskip("imagecodecs")
LOW, HIGH = (-20, -12, -4), (30, 20, 40)
BOX = {
    "file_bbox_min": ("vec3i", struct.pack("<3i", *LOW)),
    "file_bbox_max": ("vec3i", struct.pack("<3i", *(n - 1 for n in HIGH))),
}


def leaf_values(grid: Grid, rng: np.random.Generator) -> None:
    """Adds leaves whose inactive values are told in each of the seven ways, and tiles."""
    width = len(grid.value(0))
    back = grid.value(grid.background)
    minus = ~back if grid.dtype.kind == "b" else -back
    inactive = [[back], [minus], [back * 2], [minus, back], [back * 2, back],
                [back * 2, back * 3], [back * 2, back * 3, back * 4], [back]]  # fmt: skip
    for number, kinds in enumerate(inactive):
        active = rng.random(512) < (0.3 if number < 7 else 1)
        values = rng.integers(-50, 50, (512, width)).astype(grid.dtype)
        if grid.dtype.kind == "b":
            values = rng.random((512, 1)) < 0.5
        which = np.arange(512) % len(kinds)
        values[~active] = np.stack(kinds)[which[~active]]
        if grid.kind == "mask":
            values = active[:, None].copy()
        place = ((number % 3 - 2) * 8, (number // 3 - 1) * 8, 8)
        grid.leaves[place] = values, active
    one = back.dtype.type(1) if grid.dtype.kind == "b" else (back * 5).astype(grid.dtype)
    grid.tiles = ({}, {(128, 0, 0): one}, {(16, 8, 16): one, (16, 0, 16): one})


def check(path, expected, **options) -> None:
    """A grid is read as it was written, whole and in parts."""
    source = open_source(path, **options)
    found = source.read_times(0, 1)[0]
    wanted = expected.transpose(2, 1, 0, 3)
    assert found.shape == wanted.shape
    assert np.array_equal(found, wanted.astype(found.dtype))
    rng = np.random.default_rng(5)
    for _ in range(20):
        low = [int(rng.integers(0, n)) for n in found.shape[:3]]
        high = [int(rng.integers(a, n)) + 1 for a, n in zip(low, found.shape[:3], strict=True)]
        part = pickle.loads(pickle.dumps(source)).read_region(low, high)
        assert np.array_equal(part, found[tuple(map(slice, low, high))])


@pytest.mark.parametrize("name", ["wdas_cloud_sixteenth", "dragon_smoke"])
def test_openvdb_reads_the_same(name):
    path = shared(f"vdb/{name}.vdb")
    dense = np.load(shared(f"vdb/{name}_dense.npz"))
    check(path, dense["density"][..., None])
    volume = gv.read_volume(path)
    step = float(dense["voxel_size"])
    assert volume.spacing == pytest.approx((step,) * 3)
    assert volume.origin == pytest.approx(dense["index_min"] * step)
    assert volume.info.quantity == "density" and volume.info.channels[0].name == "density"


@pytest.mark.parametrize(
    ("name", "voxels", "background", "inside", "checksum"),
    [("rocks", 764416, 0.6, 508283, 1664966626), ("torus", 12288, 0.3, 604, 1913441531)],
)
def test_level_sets_of_nanovdb(name, voxels, background, inside, checksum):
    """Voxels in leaves, voxels inside and the checksum of all: as warp 1.19 reads them."""
    source = open_source(shared(f"vdb/{name}.nvdb"))
    assert source.info.quantity == "signed distance"
    grid = source.grid()
    assert len(grid.origins[2]) * 512 == voxels
    assert grid.background == pytest.approx(background)
    values = source.grid().fill(source.low, np.add(source.low, source.shape))
    assert np.abs(values).max() == pytest.approx(background)
    assert np.count_nonzero(values < 0) == inside and zlib.crc32(values.tobytes()) == checksum


def test_torus_of_nanovdb_is_a_torus():
    """The closed form, where the file's transform puts it."""
    volume = gv.read_volume(shared("vdb/torus.nvdb"))
    values = volume.data[..., 0].numpy()
    z, y, x = (np.arange(n) for n in values.shape)
    places = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], -1) * volume.spacing
    places += np.array(volume.origin) - np.array((1.0, 2.0, 3.0))
    band = np.abs(values) < 0.25
    axis = int(np.argmin([np.ptp(places[band][:, n]) for n in range(3)]))  # around which it turns
    flat = np.delete(places, axis, -1)
    ring = (np.ptp(flat[values < 0], axis=0).mean() - np.ptp(places[values < 0][:, axis])) / 2
    tube = np.hypot(np.linalg.norm(flat, axis=-1) - ring, places[..., axis])
    off = tube[band] - values[band]
    assert off.std() < 0.05 and ring > 0.5


def test_vectors_of_nanovdb_are_channels(tmp_path):
    volume = gv.read_volume(shared("vdb/test_vec_grid.nvdb"))
    assert volume.data.shape == (21, 21, 21, 3) and volume.spacing == (0.25,) * 3
    assert float(volume.data.min()) == -240 and float(volume.data.double().mean()) == 0
    with pytest.raises(ValueError, match="grid 'grid-0' holds OnIndex, which is no grid"):
        gv.read_volume(shared("vdb/test_index_grid.nvdb"))


def test_warp_reads_the_same(tmp_path):
    """In a process of its own: what warp reads of three files, voxel by voxel."""
    pytest.importorskip("warp", reason="the peer warp-lang is not installed")
    program = """
import sys, numpy as np, warp as wp
@wp.kernel
def look(v: wp.uint64, low: wp.vec3i, n: wp.vec3i, out: wp.array(dtype=float)):
    t = wp.tid()
    out[t] = wp.volume_lookup_f(
        v, low[0] + t // (n[1] * n[2]), low[1] + (t // n[2]) % n[1], low[2] + t % n[2])
path, target, *numbers = sys.argv[1:]
low, size = np.array(numbers, int).reshape(2, 3)
with open(path, "rb") as file:
    volume = wp.Volume.load_from_nvdb(file, device="cpu")
out = wp.zeros(int(size.prod()), dtype=float, device="cpu")
wp.launch(look, dim=len(out), device="cpu",
          inputs=[volume.id, wp.vec3i(*low.tolist()), wp.vec3i(*size.tolist()), out])
np.save(target, out.numpy().reshape(size))
"""
    (tmp_path / "a.py").write_text(program)  # warp reads the source of its kernels
    for name in ("rocks", "torus"):
        source = open_source(shared(f"vdb/{name}.nvdb"))
        low, size = np.array(source.low) - 20, np.array(source.shape) + 40
        told = [str(n) for n in (*low, *size)]
        words = [sys.executable, tmp_path / "a.py", source.path, tmp_path / "a.npy", *told]
        subprocess.run(words, check=True, capture_output=True)
        assert np.array_equal(
            source.grid().fill(low, low + size)[..., 0], np.load(tmp_path / "a.npy")
        )


@pytest.mark.parametrize(
    ("kind", "packing"),
    [
        *((kind, p) for kind in ("float", "vec3d") for p in (0, ZIP, ACTIVE, ZIP | ACTIVE)),
        *((kind, BLOSC | ACTIVE) for kind in ("float", "double", "int32", "int64", "bool")),
        *((kind, BLOSC | ACTIVE) for kind in ("mask", "vec3s", "vec3d", "vec3i")),
        *(("bool", 0), ("mask", ZIP)),
    ],
)
def test_every_kind_of_openvdb(tmp_path, kind, packing):
    rng = np.random.default_rng(3)
    grid = Grid(kind, False if kind in ("bool", "mask") else 7, told=BOX)
    leaf_values(grid, rng)
    writer = VdbWriter(packing=packing)
    path = writer.write(tmp_path / "a.vdb", grid)
    check(path, grid.dense(LOW, HIGH))
    if packing & ACTIVE and kind in ("float", "vec3d"):
        assert writer.codes == {0, 1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("version", [220, 221, 222, 223])
@pytest.mark.parametrize("packing", [0, ZIP])
def test_older_files(tmp_path, version, packing):
    grid = Grid("float", 7, told=BOX)
    leaf_values(grid, np.random.default_rng(3))
    check(VdbWriter(version, packing).write(tmp_path / "a.vdb", grid), grid.dense(LOW, HIGH))


@pytest.mark.parametrize("kind", ["float", "vec3s"])
def test_half_floats(tmp_path, kind):
    grid = Grid(kind, 0.1, told=BOX, half=True)
    rng = np.random.default_rng(3)
    active = rng.random(512) < 0.5
    values = np.where(active[:, None], rng.random((512, len(grid.value(0)))), 0.1)
    grid.leaves[(0, 0, 0)] = values.astype(grid.dtype), active
    path = VdbWriter(packing=ZIP | ACTIVE).write(tmp_path / "a.vdb", grid)
    found = open_source(path).grid().fill((0, 0, 0), (8, 8, 8)).reshape(512, -1)
    halves = grid.leaves[(0, 0, 0)][0].astype(np.float16).astype(np.float32)
    assert np.array_equal(found[active], halves[active])
    assert np.array_equal(found[~active], np.full_like(found[~active], 0.1))  # told in full


def test_tiles_and_far_away_boxes(tmp_path):
    """Tiles of the root, of uppers and of lowers; what no leaf needs takes no memory."""
    grid = Grid("float", -1.0, name="fog")
    grid.leaves[(8, 0, 0)] = np.arange(512, dtype="f4")[:, None], np.ones(512, bool)
    grid.tiles = ({(-8192, 0, 4096): 2.0}, {(256, 128, 0): 3.0}, {(16, 8, 0): 4.0})
    path = VdbWriter().write(tmp_path / "a.vdb", grid)
    source = open_source(path)  # no box is told: that of all nodes and tiles
    assert source.low == (-8192, 0, 0) and source.extent == (8192 + 384, 4096, 8192)
    for low in (
        (-8200, -4, 4090),
        (250, 120, -4),
        (0, 0, -4),
        (370, 250, 120),
        (-4100, 4090, 8180),
    ):
        high = tuple(n + 20 for n in low)
        assert np.array_equal(source.grid().fill(low, high), grid.dense(low, high))


def test_several_grids_and_shared_trees(tmp_path):
    rng = np.random.default_rng(3)
    first = Grid("float", 7, told=BOX, name="heat")
    leaf_values(first, rng)
    second = Grid("vec3s", 0, told=BOX, name="density")
    leaf_values(second, rng)
    move = struct.pack("<18d", 1, 2, 3, *(2.0,) * 3, *(0,) * 12)
    third = Grid("float", 0, told=BOX, name="density\x1e1", map=("ScaleTranslateMap", move),
                 parent="heat")  # fmt: skip
    path = VdbWriter().write(tmp_path / "a.vdb", first, second, third)
    for key in ("heat", "0", "/heat"):
        check(path, first.dense(LOW, HIGH), key=key)
    check(path, second.dense(LOW, HIGH), key="density")
    source = open_source(path, key="density[1]")
    check(path, first.dense(LOW, HIGH), key="density[1]")
    assert source.spacing == (2, 2, 2)
    assert source.origin == tuple(2.0 * n + t for n, t in zip(LOW, (1, 2, 3), strict=True))
    with pytest.warns(UserWarning, match=r"not kept: 2 other grids; key .* heat, density, density"):
        assert open_source(path).width == 3
    names = [one.name for one in gv.read_volume(f"{path}:/density").info.channels]
    assert names == ["density.x", "density.y", "density.z"]
    with pytest.raises(ValueError, match=r"has no grid 'x'; it holds heat, density, density\[1\]"):
        open_source(path, key="x")


def test_transforms(tmp_path):
    turned = np.zeros((4, 4))  # of row vectors: i goes along -y, j along z, k along x
    turned[0, 1], turned[1, 2], turned[2, 0], turned[3] = -2, 3, 4, (5, 6, 7, 1)
    maps = {
        "TranslationMap": (struct.pack("<3d", 1, 2, 3), (1, 1, 1), (1, 2, 3)),
        "ScaleMap": (struct.pack("<15d", 1, 2, 3, *(0,) * 12), (1, 2, 3), (0, 0, 0)),
        "AffineMap": (turned.tobytes(), (4, 2, 3), None),
    }
    values = np.arange(512, dtype="f4")[:, None], np.ones(512, bool)
    for name, (content, spacing, origin) in maps.items():
        grid = Grid("float", 0.0, leaves={(0, 0, 0): values}, map=(name, content))
        volume = gv.read_volume(VdbWriter().write(tmp_path / "a.vdb", grid))
        assert volume.spacing == spacing
        if origin is not None:
            assert volume.origin == origin
            continue
        for voxel in ((0, 0, 0), (7, 0, 0), (1, 2, 3)):
            world = np.array((*voxel, 1)) @ turned
            x, y, z = np.rint((world[:3] - volume.origin) / spacing).astype(int)
            assert volume.data[z, y, x, 0] == grid.at(voxel)[0]


@pytest.mark.parametrize("kind", NANO)
def test_every_kind_of_nanovdb(tmp_path, kind):
    rng = np.random.default_rng(1)
    for codec, bits in zip((0, 1, 2, 1, 0), (1, 2, 4, 8, 16), strict=True):
        content, (number, box) = nano_grid(kind, rng, bits)
        path = nano_file(tmp_path / f"{codec}{bits}.nvdb", ("a", number, content), codec=codec)
        check(path, box)
        source = open_source(path)
        assert source.spacing == (0.5, 0.25, 2.0) and source.origin == (6, 20, 30)
        for low, wanted in ((127, (1, 3)), (255, (3, 1)), (8191, (1, 3)), (12287, (3, 1))):
            pair = source.grid().fill((low, 3, 3), (low + 2, 4, 4))[:, 0, 0, 0]
            assert np.array_equal(pair, np.array(wanted).astype(pair.dtype))


def test_several_grids_of_nanovdb(tmp_path):
    rng = np.random.default_rng(1)
    made = {kind: nano_grid(kind, rng) for kind in ("float", "Vec3f")}
    parts = [(kind, number, content) for kind, (content, (number, _)) in made.items()]
    for codec, counted in ((0, True), (1, True), (1, False), (2, False)):
        path = nano_file(
            tmp_path / f"{codec}{counted}.nvdb", *parts, codec=codec, count_length=counted
        )
        both = path.read_bytes() * 2  # a second segment
        path.write_bytes(both)
        for key, kind in (("float", "float"), ("3", "Vec3f")):
            check(path, made[kind][1][1], key=key)
        with pytest.raises(
            ValueError, match="has no grid 'x'; it holds float, Vec3f, float, Vec3f"
        ):
            open_source(path, key="x")


def test_the_command_line_and_stores(tmp_path, monkeypatch):
    grid = Grid("float", 0.0, told=BOX)
    leaf_values(grid, np.random.default_rng(3))
    path = VdbWriter(packing=BLOSC | ACTIVE).write(tmp_path / "a.vdb", grid)
    told = gvtorch("info", path)
    assert told.returncode == 0 and "50, 32, 44" in told.stdout, told
    for words in (
        ("render", path, "-o", "a.png", "--size", "40x30"),
        ("slice", path, "-o", "b.png"),
    ):
        done = gvtorch(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    monkeypatch.setattr(conversion_plan, "_FEW", 1)  # in processes
    store = gv.convert(path, tmp_path / "a.zarr", workers=2)
    dense = grid.dense(LOW, HIGH).transpose(2, 1, 0, 3)
    assert np.array_equal(store.read_region(0, (0, 0, 0), dense.shape[:3]), dense)


@pytest.mark.parametrize("packing", [0, ZIP, ZIP | ACTIVE, BLOSC | ACTIVE])
def test_broken_files_of_openvdb(tmp_path, packing):
    grid = Grid("float", 7, told=BOX)
    leaf_values(grid, np.random.default_rng(3))
    assert_told(VdbWriter(packing=packing).write(tmp_path / "a.vdb", grid), tmp_path, least=20)


@pytest.mark.parametrize("codec", [0, 1, 2])
def test_broken_files_of_nanovdb(tmp_path, codec):
    content, (number, _) = nano_grid("float", np.random.default_rng(1))
    path = nano_file(tmp_path / "a.nvdb", ("a", number, content), codec=codec)
    assert_told(path, tmp_path, least=20)


def refused(path, content: bytes, reason: str) -> None:
    path.write_bytes(content)
    with pytest.raises(ValueError, match=reason) as told:
        gv.read_volume(path)
    assert "\n" not in str(told.value) and str(path) in str(told.value)


def test_hostile_files_of_openvdb(tmp_path):
    grid = Grid("float", 7, told=BOX)
    leaf_values(grid, np.random.default_rng(3))
    path = tmp_path / "a.vdb"
    good = VdbWriter().write(path, grid).read_bytes()
    refused(path, b"\0" * 100, "does not begin as VDB files do")
    refused(path, good[:8] + struct.pack("<I", 219) + good[12:], "is of file version 219")
    refused(path, good[:-700], "in a file of")
    huge = {name: (kind, struct.pack("<3i", *(n,) * 3)) for (name, (kind, _)), n in
            zip(BOX.items(), (-(2**31), 2**31 - 1), strict=True)}  # fmt: skip
    refused(path, VdbWriter().write(path, Grid("float", 7, told=huge)).read_bytes(), "voxels")
    refused(path, VdbWriter().write(path, Grid("float", 7)).read_bytes(), "the grid is empty")
    frustum = Grid("float", 7, told=BOX, map=("NonlinearFrustumMap", b"\0" * 200))
    refused(path, VdbWriter().write(path, frustum).read_bytes(), "NonlinearFrustumMap")
    points = VdbWriter().write(path, grid).read_bytes()
    points = points.replace(b"Tree_float_5_4_3", b"Tree_ptdat_5_4_3")
    refused(path, points, "is a Tree_ptdat_5_4_3; known are")
    lonely = Grid("float", 7, told=BOX, parent="other")
    refused(path, VdbWriter().write(path, lonely).read_bytes(), "shares the tree of 'other'")
    stream = VdbWriter().write(path, grid, places=False).read_bytes()
    refused(path, stream, "a stream that does not tell where its grids lie")


def whole_leaf() -> tuple[np.ndarray, np.ndarray]:
    return np.arange(512, dtype="f4")[:, None], np.ones(512, bool)


@pytest.mark.parametrize("x", [1, -3, 4, 4095])
def test_entries_of_a_root_lie_on_its_grid(tmp_path, x):
    """Others were read into leaves beside their places."""
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
    """One of vectors was read from a tree of numbers, three voxels at a time."""
    owner = Grid("float", 7, told=BOX, name="heat", leaves={(0, 0, 0): whole_leaf()})
    for kind in ("vec3s", "double", "int32", "mask"):
        path = tmp_path / f"{kind}.vdb"
        VdbWriter().write(path, owner, Grid(kind, 0, told=BOX, name="other", parent="heat"))
        with pytest.raises(
            ValueError, match=f"'other' is a Tree_{kind}_5_4_3, the tree that it sh"
        ):
            open_source(path, key="other")
    half = Grid("float", 0, told=BOX, name="half", parent="heat", half=True)
    check(VdbWriter().write(path, owner, half), owner.dense(LOW, HIGH), key="half")


def test_places_of_grids_and_leaves_are_in_order(tmp_path):
    """Grids over one another, or leaves told elsewhere, gave other values without a word."""
    path = tmp_path / "a.vdb"
    two = [Grid("float", 7, name=n, leaves={(0, 0, 0): whole_leaf()}) for n in ("a", "b")]
    good = VdbWriter(packing=0).write(path, *two).read_bytes()
    second = good.index(b"\1\0\0\0b\x10\0\0\0Tree_float")
    first = good.index(b"\1\0\0\0a\x10\0\0\0Tree_float")
    places = [first + 29, second + 29]  # of three numbers each
    told = [struct.unpack_from("<3q", good, place) for place in places]
    assert told[0][2] == second and told[1][2] == len(good)

    def changed(which: int, number: int, value: int) -> bytes:
        out = bytearray(good)
        struct.pack_into("<q", out, places[which] + 8 * number, value)
        return bytes(out)

    for which, number, value, reason in (
        (1, 0, told[0][0], "from .* expected in this order"),  # the other's head
        (0, 2, first, "expected in this order"),  # backwards, without an end
        (0, 0, -1, "expected in this order"),
        (1, 1, told[1][2] + 1, "expected in this order"),
        (0, 1, told[0][1] + 4, r"leaves begin at \d+, the nodes above end at"),
        (0, 1, told[0][1] - 4, r"leaves begin at \d+, the nodes above end at"),
        (1, 2, told[1][1] + 100, f"ends at {told[1][1] + 100}, within"),  # within a leaf
    ):
        path.write_bytes(changed(which, number, value))
        with pytest.raises(ValueError, match=reason):
            gv.read_volume(path, key="ab"[which])


def test_a_background_of_nan_is_no_voxel(tmp_path):
    """All tiles were taken for others than the background: 4096^3 voxels for a leaf."""
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
    """Numpy's warnings came before it; `info` took places that `render` refused."""
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
            continue  # large, and told
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
    """Whole leaves around a line of voxels took 64 times of it: 16 GB for a file of 12 kB."""
    high = [3, 5, 1]
    high[axis] = 1_000_003
    box = {
        "file_bbox_min": ("vec3i", struct.pack("<3i", -3, 0, 0)),
        "file_bbox_max": ("vec3i", struct.pack("<3i", *(n - 1 for n in high))),
    }
    places = [
        tuple(n // 8 * 8 if k == axis else 0 for k in range(3)) for n in (0, 65536, 1_000_000)
    ]
    grid = Grid("float", 7, told=box, leaves=dict.fromkeys(places, whole_leaf()))
    source = open_source(VdbWriter().write(tmp_path / "a.vdb", grid))
    source.grid()
    tracemalloc.start()
    found = source.read_times(0, 1)[0, ..., 0].T
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.shape == tuple(b + 3 * (k == 0) for k, b in enumerate(high))
    assert taken < 2 * found.nbytes + 64 * 2**20
    for place in (*places, (0, 0, 0)):
        low = [max(0, p + 3 * (k == 0) - 9) for k, p in enumerate(place)]
        part = found[tuple(slice(a, a + 30) for a in low)]
        begin = tuple(a - 3 * (k == 0) for k, a in enumerate(low))
        end = tuple(a + n for a, n in zip(begin, part.shape, strict=True))
        assert np.array_equal(part, grid.dense(begin, end)[..., 0])


def test_long_names_and_keys_are_short_lines(tmp_path):
    long = "x" * 100_000
    path = tmp_path / "a.vdb"
    values = {(0, 0, 0): whole_leaf()}
    for told in ({"name": long}, {"map": (long, b"")}):
        content = VdbWriter().write(path, Grid("float", 0.0, leaves=values, **told)).read_bytes()
        refused(path, content, "a name of 100000 bytes")
    many = [Grid("float", 0.0, name=f"{n}{long[:4000]}", leaves=values) for n in range(9)]
    VdbWriter().write(path, *many)
    for key in (long, "\u00b2", "9" * 5000, "9", "-1"):
        with pytest.raises(ValueError, match="has no grid") as told:
            open_source(path, key=key)
        assert len(str(told.value)) < 2000 and str(path) in str(told.value)


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

    def changed(at: int, layout: str, *numbers: int) -> bytes:
        out = bytearray(good)
        struct.pack_into(layout, out, begin + at, *numbers)
        return bytes(out)

    refused(path, b"NanoVDB2" + struct.pack("<I", 29 << 21) + good[12:], "of version 29")
    refused(path, b"NotVDB.." + good[8:], "expected NanoVDB of version 32")
    refused(path, changed(736 + 24, "<I", 2**31), "a root of")
    refused(path, changed(736 + 64 + 8, "<q", 2**40), "a node lies outside of the grid")
    first, second = struct.unpack_from("<q", content, 808)[0], 736 + 64 + 32 + 8
    refused(path, changed(second, "<q", first), "several places of the tree share a node")
    refused(path, changed(736, "<6i", *(0,) * 3, *(-9,) * 3), "has no active voxel")


def test_nodes_of_nanovdb_are_those_that_the_grid_tells_of(tmp_path):
    """Each gave other values without a word: another type's, half of the tree, tiles nowhere."""
    content, (number, _) = nano_grid("float", np.random.default_rng(1))
    _, head, _, tile, _, size, entries, lower_size, *_ = NANO["float"]
    path, root = tmp_path / "a.nvdb", 736 + head
    (upper,) = struct.unpack_from("<q", content, root + 8)
    leaf_at = root + 3 * tile + 2 * size + entries + 15 * 256 * 8  # in the first lower node
    (leaf,) = struct.unpack_from("<q", content, leaf_at)
    assert leaf == 2 * lower_size

    def forged(at: int, layout: str, value: int, kind: int = number) -> bytes:
        out = bytearray(content)
        struct.pack_into(layout, out, at, value)
        return nano_file(path, ("a", kind, bytes(out))).read_bytes()

    refused(path, forged(0, "<B", content[0], NANO["int16"][0]), "of type 1, its file tells of 3")
    for count in (0, 1):
        refused(path, forged(736 + 24, "<I", count), "nodes, leaves first; it tells of")
    for at in range(3):
        refused(path, forged(672 + 32 + 4 * at, "<I", 9), "nodes, leaves first; it tells of")
    (key,) = struct.unpack_from("<Q", content, root)
    for bit in (20, 41, 62, 63):
        refused(path, forged(root, "<Q", key | 1 << bit), "of no voxel's place")
    for step in (1, 8, 16, -8):
        refused(path, forged(root + 8, "<q", upper + step), "at no multiple of 32 bytes")
    for step in (32, -32, 2112, -lower_size, -2 * lower_size):
        refused(path, forged(leaf_at, "<q", leaf + step), "lie over each other")
    refused(path, forged(root + 8, "<q", -736), "a node lies outside")


def test_codes_that_are_no_numbers_are_voxels_that_are_none(tmp_path):
    content, (number, _) = nano_grid("Fp8", np.random.default_rng(1))
    out = bytearray(content)
    at = len(content) - NANO["Fp8"][-1] + 80
    out[at : at + 8] = np.float32([np.nan, np.inf]).tobytes()
    path = nano_file(tmp_path / "a.nvdb", ("a", number, bytes(out)))
    with pytest.raises(ValueError, match="holds 512 values that are NaN"):
        gv.read_volume(path)
    assert gv.read_volume(path, nan=0).data.isfinite().all()


@pytest.mark.parametrize("compressor", ["lz4", "zstd", "blosclz"])
def test_only_the_first_block_of_blosc_is_unpacked_for_a_head(tmp_path, compressor):
    """A file of 33 KB took 2 GB: all its blocks lay at one place."""
    content, (number, box) = nano_grid("float", np.random.default_rng(1))
    large = content + bytes(64 << 20)
    path = nano_file(tmp_path / "a.nvdb", ("a", number, large), codec=2, compressor=compressor)
    tracemalloc.start()
    open_source(path)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size < 2 << 20 and taken < 4 << 20
    check(path, box)
    good = path.read_bytes()
    at = good.index(b"a\0") + 2 + 8  # behind the name and the part's length
    for place, number, message in (
        (8, 2**31 - 1, "blosc_decompress"),
        (16, 2**31 - 1, "at byte 2147483647"),
        (8, 100, "a block of 100 bytes"),
    ):
        bad = bytearray(good)
        struct.pack_into("<I", bad, at + place, number)
        refused(path, bytes(bad), message)


@pytest.mark.parametrize(
    ("at", "content", "message"),
    [
        (736 + 24, struct.pack("<I", 10_000_000), "a root of 10000000 entries"),
        (None, b"", "two entries of the root lie at one place"),
    ],
)
def test_roots_of_nanovdb_hold_few_entries_each_at_its_place(tmp_path, at, content, message):
    """Of millions at one place each part that was read looked at all."""
    data, (number, _) = nano_grid("float", np.random.default_rng(3))
    head = 736 + NANO["float"][1]
    size = NANO["float"][3]
    if at is None:  # the tile lies where the first upper node does
        at, content = head + 2 * size, data[head : head + 8]
    data = data[:at] + content + data[at + len(content) :]
    file = nano_file(tmp_path / "a.nvdb", ("density", number, data))
    with pytest.raises(ValueError, match=message):
        gv.read_volume(file)
