"""Stores of several channels: written, interrupted and resumed, streamed together, drawn lit."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import gvtorch, meshes
from helpers.stores import stopped_at

import gvtorch as gv
from gvtorch.io.stores.channels import channel_names
from gvtorch.io.stores.store_layout import WORK
from gvtorch.meshes.voxelizer import Voxelizer
from gvtorch.producers import Layout, Nodes, Region

NAMES = ("coverage", "color", "normal")


@pytest.fixture(scope="module")
def mesh() -> gv.Mesh:
    torus = meshes.torus(1.0, 0.4, (48, 24))
    color = np.random.default_rng(0).random((len(torus.faces), 3, 4)).astype(np.float32)
    color[..., 3] = 1
    return gv.Mesh(vertices=torus.vertices, faces=torus.faces, color=color)


@pytest.fixture(scope="module")
def store(tmp_path_factory, mesh) -> Path:
    path = tmp_path_factory.mktemp("store") / "torus.zarr"
    gv.voxelize(mesh, path, resolution=70, channels=NAMES)
    return path


def contents(folder: Path) -> dict[str, str]:
    """Returns a digest of every file of a folder."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
    }


def test_each_channel_is_a_store_of_its_own(store, mesh):
    assert channel_names(store) == NAMES and not (store / WORK).exists()
    first = gv.Store.open(store)
    assert first.info.quantity == "coverage" and "color, normal" in first.dropped[0]
    grid = Voxelizer(mesh, resolution=70, channels=NAMES)
    whole = ((0, 0, 0), grid.extent[::-1])
    expected = grid.region(*whole)
    for name in NAMES:
        opened = gv.Store.open(store, image=name)
        assert opened.has_blocks and opened.extent == grid.extent
        actual = opened.read_region(0, *whole)
        assert np.array_equal(actual, expected[name].numpy()), name
    with pytest.raises(ValueError, match=r"has no image 'normals'.*; it holds .*coverage.*normal"):
        gv.Store.open(store, image="normals")


def test_channels_are_streamed_together_as_a_resident_tree(store, mesh):
    grid = Voxelizer(mesh, resolution=70, channels=NAMES)
    voxels = grid.region((0, 0, 0), grid.extent[::-1])
    placement = (grid.spacing,) * 3, grid.origin
    names = ("color", "normal")
    tree = gv.N3Tree.from_volume({n: gv.Volume(voxels[n], *placement) for n in names}, 8)
    shader = gv.StoredColor("color", premultiplied=True, normals="normal")
    camera = gv.Camera.orbit(25, 40, 1.3, width=64, height=48)
    expected = gv.render(tree, camera, shader, lod="finest")
    with gv.Engine(gv.StoredChannels(store, names)) as engine:
        actual = engine.render(camera, shader, lod="finest")
    assert torch.equal(actual.color, expected.color) and expected.alpha.mean() > 0.2


def test_a_node_is_uniform_where_all_channels_are(store):
    joined = gv.StoredChannels(store)
    assert joined.host_bytes == sum(p.host_bytes for p in joined.producers.values()) > 0
    layout = Layout.of(joined, 8, 1, torch.device("cpu"))
    joined.prepare(layout)
    positions = torch.cartesian_prod(*(torch.arange(-(-n // 8)) for n in joined.extent))
    nodes = Nodes(torch.cat((positions, torch.full((len(positions), 1), layout.depth)), 1), layout)
    kind = joined.classify(nodes).result().kind
    each = [p.classify(nodes).result().kind for p in joined.producers.values()]
    data = torch.stack(each) == Region.DATA
    assert torch.equal(kind == Region.DATA, data.any(0))
    assert (data.any(0) & ~data.all(0)).any() and (kind != Region.DATA).any()
    joined.close()


def test_producers_that_do_not_go_together_are_told(mesh):
    first = gv.MeshProducer(mesh, resolution=32)
    other = gv.MeshProducer(mesh, resolution=48, channels=("distance",))
    both = gv.MeshProducer(mesh, resolution=32, channels=("color", "normal"))
    octaves = gv.OctaveProducer(gv.noise.SplineSum(), 64, box=((0,) * 3, (1,) * 3))
    for producers, message in (
        ({}, "at least one"),
        ({"a": first, "b": other}, "extent of 'b' is"),
        ({"a": both}, "must have one channel"),
        ({"a": 3}, "must be a Producer"),
        ({"a": octaves}, "'a' needs its parents' bricks"),
    ):
        with pytest.raises(ValueError, match="JoinedProducer: ") as error:
            gv.JoinedProducer(producers)
        assert message in str(error.value) and "\n" not in str(error.value)


def test_what_a_store_has_not_is_told(store, tmp_path):
    with pytest.raises(ValueError, match="unknown channel 'distance'; the store has coverage, c"):
        gv.StoredChannels(store, ("distance",))
    plain = tmp_path / "plain.zarr"
    gv.voxelize(meshes.box(), plain, resolution=16)
    with pytest.raises(ValueError, match="not a store of several channels"):
        gv.StoredChannels(plain)


def test_colours_are_drawn_lit_in_one_line(store, tmp_path):
    flags = ("--size", "64x48", "--camera", "orbit:25,40", "-o")
    run = gvtorch("render", store, *flags, tmp_path / "a.npy")
    assert run.returncode == 0 and not run.stderr, run.stderr
    camera = gv.Camera.orbit(25, 40, width=64, height=48, fit=True)
    producer = gv.StoredChannels(store, ("color", "normal"))
    reference = 0.3 * producer.spacing[0]
    shader = gv.StoredColor("color", premultiplied=True, normals="normal", reference=reference)
    with gv.Engine(producer) as engine:
        expected = engine.render(camera, shader)
    actual = torch.from_numpy(np.load(tmp_path / "a.npy"))[..., :3].float()
    assert (actual - expected.color.reshape(actual.shape)).abs().max() < 2e-3
    other = gvtorch("render", store, *flags, tmp_path / "b.npy", "--image", "coverage")
    assert other.returncode == 0, other.stderr
    assert not np.array_equal(np.load(tmp_path / "b.npy"), np.load(tmp_path / "a.npy"))
    bad = gvtorch("render", store, *flags, tmp_path / "c.npy", "--image", "glow")
    assert bad.returncode == 2 and "has no image 'glow'" in bad.stderr
    bad = gvtorch("render", store, *flags, tmp_path / "c.npy", "--channel", "0:red")
    assert bad.returncode == 2 and "--channel is not for" in bad.stderr


@pytest.mark.long
def test_a_broken_off_store_goes_on_and_is_the_same(tmp_path, mesh, monkeypatch):
    options = {"resolution": 150, "channels": NAMES, "workers": 1}
    whole = tmp_path / "whole" / "a.zarr"
    whole.parent.mkdir()
    gv.voxelize(mesh, whole, **options)
    target = tmp_path / "a.zarr"
    message = "the same command with --resume"
    with stopped_at(monkeypatch, 9), pytest.raises(KeyboardInterrupt, match=message):
        gv.voxelize(mesh, target, **options)
    assert (target / "coverage" / "zarr.json").exists() and not (target / "zarr.json").exists()
    with pytest.raises(FileExistsError, match="half-written"):
        gv.voxelize(mesh, target, **options)
    with pytest.raises(ValueError, match="begun with another source"):
        gv.voxelize(mesh, target, **options | {"band": 6}, resume=True)
    gv.voxelize(mesh, target, **options, resume=True)
    assert contents(target) == contents(whole)
    with pytest.raises(FileExistsError, match="there is a store already"):
        gv.voxelize(mesh, target, **options)


@pytest.mark.parametrize(
    ("manifest", "channels"), [("manifest.json", NAMES), ("channels.json", NAMES[0])]
)
def test_what_another_converter_has_begun_stays(tmp_path, mesh, manifest, channels):
    target = tmp_path / "a.zarr"
    begun = target / ".gvtorch-work" / manifest
    begun.parent.mkdir(parents=True)
    begun.write_text("{}")
    for resume in (False, True):
        with pytest.raises(FileExistsError, match="exists and is not a store"):
            gv.voxelize(mesh, target, resolution=20, channels=channels, resume=resume)
    assert begun.read_text() == "{}"


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="kills a process")
def test_a_killed_voxelization_goes_on_and_is_the_same(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    ball = meshes.sphere(5)
    file = tmp_path / "ball.ply"
    trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(file)
    flags = ["--resolution", "140", "--channels", "coverage,distance", "--workers", "1"]
    whole, target = tmp_path / "whole.zarr", tmp_path / "killed.zarr"
    assert gvtorch("voxelize", file, "-o", whole, *flags).returncode == 0
    command = [sys.executable, "-m", "gvtorch", "voxelize", file, "-o", target, *flags]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    journal = target / "coverage" / WORK / "journal.jsonl"
    while process.poll() is None and not (journal.exists() and journal.read_bytes()):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not (target / "zarr.json").exists()
    done = gvtorch("voxelize", file, "-o", target, *flags, "--resume")
    assert done.returncode == 0, done.stderr
    names = {name: digest for name, digest in contents(whole).items() if "/c/" in name}
    assert {n: d for n, d in contents(target).items() if "/c/" in n} == names and len(names) > 20


def test_bad_channels_are_told_in_a_line(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for names in ("colour", "color,color", ""):
        flags = ("-o", tmp_path / "a.zarr", "--channels", names)
        run = gvtorch("voxelize", tmp_path / "a.obj", *flags)
        assert run.returncode == 2 and run.stderr.count("\n") == 1, run.stderr
        assert "channels must be some of coverage, distance" in run.stderr
        assert not (tmp_path / "a.zarr").exists()
    flags = ("-o", tmp_path / "a.zarr", "--texture", "a.png", "--channels", "coverage,normal")
    run = gvtorch("voxelize", tmp_path / "a.obj", *flags)
    assert run.returncode == 2 and "--texture is for --channels color" in run.stderr
