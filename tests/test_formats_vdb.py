"""OpenVDB and NanoVDB: files by OpenVDB, Houdini and NanoVDB, what `warp` reads from them and
writes, and files that the tests write in every number type, packing and version.
"""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from helpers import Library, gvtorch, shared
from helpers.damage import assert_robust
from helpers.vdb import (
    ACTIVE,
    BLOSC,
    BOX,
    HIGH,
    LOW,
    NANO,
    ZIP,
    Grid,
    VdbWriter,
    assert_reads,
    leaf_values,
    nano_file,
    nano_grid,
)

import gvtorch as gv
from gvtorch.io.reading import open_source
from gvtorch.io.stores import conversion_plan

Library("imagecodecs")


@pytest.mark.parametrize("name", ["wdas_cloud_sixteenth", "dragon_smoke"])
def test_openvdb_reads_the_same(name):
    path = shared(f"vdb/{name}.vdb")
    dense = np.load(shared(f"vdb/{name}_dense.npz"))
    assert_reads(path, dense["density"][..., None])
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
    """It equals the closed form, where the file's transform puts it."""
    volume = gv.read_volume(shared("vdb/torus.nvdb"))
    values = volume.data[..., 0].numpy()
    z, y, x = (np.arange(n) for n in values.shape)
    positions = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], -1) * volume.spacing
    positions += np.array(volume.origin) - np.array((1.0, 2.0, 3.0))
    band = np.abs(values) < 0.25
    axis = int(np.argmin([np.ptp(positions[band][:, n]) for n in range(3)]))  # the torus's axis
    flat = np.delete(positions, axis, -1)
    ring = (np.ptp(flat[values < 0], axis=0).mean() - np.ptp(positions[values < 0][:, axis])) / 2
    tube = np.hypot(np.linalg.norm(flat, axis=-1) - ring, positions[..., axis])
    off = tube[band] - values[band]
    assert off.std() < 0.05 and ring > 0.5


def test_vectors_of_nanovdb_are_channels(tmp_path):
    volume = gv.read_volume(shared("vdb/test_vec_grid.nvdb"))
    assert volume.data.shape == (21, 21, 21, 3) and volume.spacing == (0.25,) * 3
    assert float(volume.data.min()) == -240 and float(volume.data.double().mean()) == 0
    with pytest.raises(ValueError, match="grid 'grid-0' holds OnIndex, not a grid"):
        gv.read_volume(shared("vdb/test_index_grid.nvdb"))


def test_warp_reads_the_same(tmp_path):
    """In another process: what warp reads from three files, voxel by voxel."""
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
        box = [str(n) for n in (*low, *size)]
        command = [sys.executable, tmp_path / "a.py", source.path, tmp_path / "a.npy", *box]
        subprocess.run(command, check=True, capture_output=True)
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
    grid = Grid(kind, False if kind in ("bool", "mask") else 7, metadata=BOX)
    leaf_values(grid, rng)
    writer = VdbWriter(packing=packing)
    path = writer.write(tmp_path / "a.vdb", grid)
    assert_reads(path, grid.dense(LOW, HIGH))
    if packing & ACTIVE and kind in ("float", "vec3d"):
        assert writer.codes == {0, 1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("version", [220, 221, 222, 223])
@pytest.mark.parametrize("packing", [0, ZIP])
def test_older_files(tmp_path, version, packing):
    grid = Grid("float", 7, metadata=BOX)
    leaf_values(grid, np.random.default_rng(3))
    assert_reads(VdbWriter(version, packing).write(tmp_path / "a.vdb", grid), grid.dense(LOW, HIGH))


@pytest.mark.parametrize("kind", ["float", "vec3s"])
def test_half_floats(tmp_path, kind):
    grid = Grid(kind, 0.1, metadata=BOX, half=True)
    rng = np.random.default_rng(3)
    active = rng.random(512) < 0.5
    values = np.where(active[:, None], rng.random((512, len(grid.value(0)))), 0.1)
    grid.leaves[(0, 0, 0)] = values.astype(grid.dtype), active
    path = VdbWriter(packing=ZIP | ACTIVE).write(tmp_path / "a.vdb", grid)
    actual = open_source(path).grid().fill((0, 0, 0), (8, 8, 8)).reshape(512, -1)
    halves = grid.leaves[(0, 0, 0)][0].astype(np.float16).astype(np.float32)
    assert np.array_equal(actual[active], halves[active])
    assert np.array_equal(actual[~active], np.full_like(actual[~active], 0.1))  # written in full


def test_tiles_and_far_away_boxes(tmp_path):
    """Tiles of the root, of uppers and of lowers; what has no leaf takes no memory."""
    grid = Grid("float", -1.0, name="fog")
    grid.leaves[(8, 0, 0)] = np.arange(512, dtype="f4")[:, None], np.ones(512, bool)
    grid.tiles = ({(-8192, 0, 4096): 2.0}, {(256, 128, 0): 3.0}, {(16, 8, 0): 4.0})
    path = VdbWriter().write(tmp_path / "a.vdb", grid)
    source = open_source(path)  # without a box in the file: that of all nodes and tiles
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
    first = Grid("float", 7, metadata=BOX, name="heat")
    leaf_values(first, rng)
    second = Grid("vec3s", 0, metadata=BOX, name="density")
    leaf_values(second, rng)
    move = struct.pack("<18d", 1, 2, 3, *(2.0,) * 3, *(0,) * 12)
    third = Grid("float", 0, metadata=BOX, name="density\x1e1", map=("ScaleTranslateMap", move),
                 parent="heat")  # fmt: skip
    path = VdbWriter().write(tmp_path / "a.vdb", first, second, third)
    for key in ("heat", "0", "/heat"):
        assert_reads(path, first.dense(LOW, HIGH), key=key)
    assert_reads(path, second.dense(LOW, HIGH), key="density")
    source = open_source(path, key="density[1]")
    assert_reads(path, first.dense(LOW, HIGH), key="density[1]")
    assert source.spacing == (2, 2, 2)
    assert source.origin == tuple(2.0 * n + t for n, t in zip(LOW, (1, 2, 3), strict=True))
    with pytest.warns(
        UserWarning, match=r"not kept: 2 other grids; key .* 0 'heat', 1 'density', 2"
    ):
        assert open_source(path).width == 3
    names = [channel.name for channel in gv.read_volume(f"{path}:/density").info.channels]
    assert names == ["density.x", "density.y", "density.z"]
    with pytest.raises(
        ValueError, match=r"has no grid 'x'; it holds 0 'heat', .* 2 'density\[1\]'"
    ):
        open_source(path, key="x")


def test_transforms(tmp_path):
    turned = np.zeros((4, 4))  # for row vectors: i maps to -y, j to z, k to x
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
            assert volume.data[z, y, x, 0] == grid.dense(voxel, np.add(voxel, 1))[0, 0, 0, 0]


@pytest.mark.parametrize("kind", NANO)
def test_every_kind_of_nanovdb(tmp_path, kind):
    rng = np.random.default_rng(1)
    for codec, bits in zip((0, 1, 2, 1, 0), (1, 2, 4, 8, 16), strict=True):
        content, (number, box) = nano_grid(kind, rng, bits)
        path = nano_file(tmp_path / f"{codec}{bits}.nvdb", ("a", number, content), codec=codec)
        assert_reads(path, box)
        source = open_source(path)
        assert source.spacing == (0.5, 0.25, 2.0) and source.origin == (6, 20, 30)
        for low, expected in ((127, (1, 3)), (255, (3, 1)), (8191, (1, 3)), (12287, (3, 1))):
            pair = source.grid().fill((low, 3, 3), (low + 2, 4, 4))[:, 0, 0, 0]
            assert np.array_equal(pair, np.array(expected).astype(pair.dtype))


def test_several_grids_of_nanovdb(tmp_path):
    rng = np.random.default_rng(1)
    grids = {kind: nano_grid(kind, rng) for kind in ("float", "Vec3f")}
    parts = [(kind, number, content) for kind, (content, (number, _)) in grids.items()]
    for codec, counted in ((0, True), (1, True), (1, False), (2, False)):
        path = nano_file(
            tmp_path / f"{codec}{counted}.nvdb", *parts, codec=codec, count_length=counted
        )
        both = path.read_bytes() * 2  # a second segment
        path.write_bytes(both)
        for key, kind in (("float", "float"), ("3", "Vec3f")):
            assert_reads(path, grids[kind][1][1], key=key)
        with pytest.raises(ValueError, match="no grid 'x'; it holds 0 'float', 1 'Vec3f', 2 'flo"):
            open_source(path, key="x")


def test_the_command_line_and_stores(tmp_path, monkeypatch):
    grid = Grid("float", 0.0, metadata=BOX)
    leaf_values(grid, np.random.default_rng(3))
    path = VdbWriter(packing=BLOSC | ACTIVE).write(tmp_path / "a.vdb", grid)
    info = gvtorch("info", path)
    assert info.returncode == 0 and "50, 32, 44" in info.stdout, info
    for command in (
        ("render", path, "-o", "a.png", "--size", "40x30"),
        ("slice", path, "-o", "b.png"),
    ):
        done = gvtorch(*command, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    monkeypatch.setattr(conversion_plan, "_FEW_TASKS", 1)  # in processes
    store = gv.convert(path, tmp_path / "a.zarr", workers=2)
    dense = grid.dense(LOW, HIGH).transpose(2, 1, 0, 3)
    assert np.array_equal(store.read_region(0, (0, 0, 0), dense.shape[:3]), dense)


@pytest.mark.parametrize("packing", [0, ZIP, ZIP | ACTIVE, BLOSC | ACTIVE])
def test_broken_files_of_openvdb(tmp_path, packing):
    grid = Grid("float", 7, metadata=BOX)
    leaf_values(grid, np.random.default_rng(3))
    assert_robust(
        VdbWriter(packing=packing).write(tmp_path / "a.vdb", grid), tmp_path, min_refused=20
    )


@pytest.mark.parametrize("codec", [0, 1, 2])
def test_broken_files_of_nanovdb(tmp_path, codec):
    content, (number, _) = nano_grid("float", np.random.default_rng(1))
    path = nano_file(tmp_path / "a.nvdb", ("a", number, content), codec=codec)
    assert_robust(path, tmp_path, min_refused=20)
