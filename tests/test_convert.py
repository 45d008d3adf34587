"""Converting volumes to stores: every source, every way to be interrupted, and the command."""

from __future__ import annotations

import bz2
import errno
import gzip
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from helpers import run_cli
from helpers.stores import assert_holds, noise, write_foreign

import gvtorch as gv
from gvtorch.io.formats import FORMATS, find_format
from gvtorch.io.reading import open_source
from gvtorch.io.stores import conversion, conversion_plan, shard
from gvtorch.io.stores.conversion import convert, estimate
from gvtorch.io.stores.store import Store
from gvtorch.io.stores.store_layout import WORK

ELSEWHERE = {
    "DICOM",
    "HDF5",
    "MetaImage",
    "MRC",
    "NanoVDB",
    "OpenVDB",
    "VTK",
    "Zarr",
    "N5",
    "CZI",
    "ND2",
    "LIF",
}  # formats that other tests convert
SHAPE = (9, 20, 300)  # z y x: two shards along x


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    return noise((*SHAPE, 1))


@pytest.fixture
def raw(tmp_path, data) -> Path:
    file = tmp_path / "scan_300x20x9_uint8.raw"
    file.write_bytes(data.tobytes())
    return file


# --- sources


def source_files(folder: Path) -> dict[str, Path]:
    """Writes one small volume in every format, in every variant that is read differently."""
    import nibabel
    import nrrd
    import tifffile
    from astropy.io import fits

    folder.mkdir(exist_ok=True)
    grid = noise((7, 9, 12, 1), "int16")[..., 0]
    turned = np.diag([-0.5, 2.0, 1.0, 1.0])
    turned[:3, 3] = (1, 2, 3)
    swapped = turned[:, [1, 0, 2, 3]]
    nibabel.save(nibabel.Nifti1Image(grid.T.copy(), turned), folder / "a.nii")
    nibabel.save(nibabel.Nifti1Image(grid.swapaxes(1, 2).T.copy(), swapped), folder / "swap.nii")
    nibabel.save(nibabel.Nifti1Image(grid.T.copy(), turned), folder / "a.nii.gz")
    scaled = nibabel.Nifti1Image(grid.T.copy(), turned)
    scaled.header.set_slope_inter(0.5, 3)
    nibabel.save(scaled, folder / "scaled.nii")
    header = {"space directions": turned[:3, :3], "space origin": [1, 2, 3], "space": "LPS"}
    for name, more in (("raw", {}), ("gzip", {}), ("raw", {"detached_header": True})):
        file = folder / (f"{name}.nhdr" if more else f"{name}.nrrd")
        nrrd.write(str(file), grid.T.copy(), {**header, "encoding": name}, index_order="F", **more)
    rgb = noise((7, 9, 12, 3))
    nrrd.write(
        str(folder / "rgb.nrrd"),
        rgb.transpose(3, 2, 1, 0).copy(),
        {"encoding": "raw", "kinds": ["vector", "space", "space", "space"]},
        index_order="F",
    )
    tifffile.imwrite(folder / "plain.tif", grid, photometric="minisblack", byteorder=">")
    tifffile.imwrite(folder / "packed.tif", grid, photometric="minisblack", compression="zlib")
    tifffile.imwrite(folder / "rgb.tif", rgb, photometric="rgb", compression="zlib")
    planes = np.stack((grid, grid + 1), 1)
    tifffile.imwrite(
        folder / "planes.tif", planes, imagej=True, metadata={"axes": "ZCYX"}, compression="zlib"
    )
    (folder / "slices").mkdir(exist_ok=True)
    for index, image in enumerate(grid):
        tifffile.imwrite(folder / "slices" / f"s{index}.tif", image)
    fits.writeto(folder / "a.fits", grid[None], overwrite=True)
    fits.writeto(folder / "u.fits", grid.astype(np.uint16), overwrite=True)
    fits.writeto(folder / "a.fits.gz", grid.astype(np.uint16), overwrite=True)
    packed = fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(grid)])
    packed.writeto(folder / "packed.fits", overwrite=True)
    np.save(folder / "c.npy", rgb)
    np.save(folder / "fortran.npy", np.asfortranarray(grid.astype(">f8")))
    np.savez(folder / "a.npz", grid)
    (folder / "c.npy.gz").write_bytes(gzip.compress((folder / "c.npy").read_bytes()))
    (folder / "f.npy.bz2").write_bytes(bz2.compress((folder / "fortran.npy").read_bytes()))
    write_foreign(folder / "a.zarr", [np.moveaxis(rgb, 3, 0)], "czyx", [[1, 3.0, 2, 1]], version=2)
    (folder / "a_12x9x7_int16be.raw").write_bytes(grid.astype(">i2").tobytes())
    (folder / "b_12x9x7_int16.raw.gz").write_bytes(gzip.compress(grid.tobytes()))
    names = sorted(p for p in folder.iterdir() if not p.name.endswith(".raw.part"))
    return {p.name: p for p in names}


def test_every_format_converts_to_what_read_volume_reads(tmp_path):
    whole = {"a.nii.gz", "gzip.nrrd", "a.npz", "b_12x9x7_int16.raw.gz"}
    whole |= {"a.fits.gz", "c.npy.gz", "f.npy.bz2"}
    files = source_files(tmp_path / "files")
    detached = files.pop("raw.raw", None)
    assert detached is not None and len(files) == 25
    formats = {find_format(str(file)).name for file in files.values()}
    assert formats == {f.name for f in FORMATS} - ELSEWHERE
    for name, file in files.items():
        volume = gv.read_volume(file)
        source = open_source(file)
        assert source.whole == (name in whole), name
        store = convert(file, tmp_path / f"{name}.zarr")
        assert (store.spacing, store.origin) == (volume.spacing, volume.origin), name
        data = volume.data.numpy()
        assert store.width == data.shape[3]
        assert np.array_equal(store.read_region(0, (0, 0, 0), data.shape[:3]), data), name
        box = source.read_region((2, 3, 4), (5, 4, 11))
        assert np.array_equal(box, data[2:5, 3:4, 4:11]), name


def test_an_ome_zarr_image_becomes_a_store(tmp_path):
    data = noise((20, 33, 40, 2), "uint16")
    write_foreign(tmp_path / "a", [np.moveaxis(data, 3, 0)], "czyx", [[1, 3.0, 2, 1]], version=2)
    store = convert(tmp_path / "a", tmp_path / "b.zarr", block=64)
    assert store.has_blocks and store.spacing == (1, 2, 3)
    assert_holds(store, data)
    again = convert(tmp_path / "b.zarr", tmp_path / "c.zarr", origin=(1, 1, 1))
    assert again.origin == (1, 1, 1)
    assert_holds(again, data)


def test_values_that_are_not_finite(tmp_path):
    data = noise(SHAPE, "float32")
    data[0, 0, 254:258] = np.nan  # around the seam of two shards: each is counted once
    data[1, 1, 1] = np.inf
    np.save(tmp_path / "a.npy", data)
    with pytest.raises(ValueError, match=r"5 values are NaN or infinite \(of 54000\); pass nan="):
        convert(tmp_path / "a.npy", tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "a.zarr").symlink_to(tmp_path / "mine")
    with pytest.raises(ValueError, match="5 values are NaN"):
        convert(tmp_path / "a.npy", tmp_path / "a.zarr")
    assert not list((tmp_path / "mine").iterdir())
    store = convert(tmp_path / "a.npy", tmp_path / "a.zarr", nan=7)
    assert_holds(store, np.where(np.isfinite(data), data, np.float32(7))[..., None])


# --- mistakes


def test_nothing_is_overwritten(tmp_path, raw):
    convert(raw, tmp_path / "a.zarr")
    with pytest.raises(FileExistsError, match="there is a store already"):
        convert(raw, tmp_path / "a.zarr")
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "a.zarr").rglob("*")}
    assert convert(raw, tmp_path / "a.zarr", resume=True).extent == (300, 20, 9)
    after = {file: file.stat().st_mtime_ns for file in (tmp_path / "a.zarr").rglob("*")}
    assert before == after
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(FileExistsError, match="exists and is not a store"):
        convert(raw, tmp_path / "mine")
    with pytest.raises(FileNotFoundError, match="folder not found"):
        convert(raw, tmp_path / "no" / "a.zarr")


def test_arguments_are_checked_before_the_work(tmp_path, raw):
    target = tmp_path / "a.zarr"
    for options, message in (
        ({"block": 48}, "block must be 32 or 64, got 48"),
        ({"threshold": "much"}, "threshold must be a number"),
        ({"workers": 0}, "workers must be an int >= 1"),
        ({"spacing": (1, 0, 1)}, "spacing must be positive"),
        ({"shape": (300, 20, 10), "dtype": "uint8"}, "takes 60000 bytes, the file has 54000"),
        ({"dtype": "text"}, "dtype must be a NumPy dtype"),
        ({"key": "a"}, "key is for .*NPZ, OME-Zarr.* files, this is RAW"),
    ):
        with pytest.raises(ValueError, match=message):
            convert(raw, target, **options)
    with pytest.raises(FileNotFoundError, match="volume not found"):
        convert(tmp_path / "none.raw", target)
    with pytest.raises(ValueError, match="bfloat16 can't be stored"):
        convert(gv.Volume(gv.Volume(np.zeros((2, 2, 2))).data.bfloat16()), target)
    assert not target.exists()


def test_what_does_not_fit_is_told_with_numbers(tmp_path, raw, monkeypatch):
    target = tmp_path / "a.zarr"
    (tmp_path / "b_300x20x9_uint8.raw.gz").write_bytes(gzip.compress(raw.read_bytes()))
    with monkeypatch.context() as patch:
        patch.setattr(conversion.resources, "memory_free", lambda: 1000)
        with pytest.raises(ValueError, match=r"unpack it first: takes .* of memory, 1\.0 kB"):
            convert(tmp_path / "b_300x20x9_uint8.raw.gz", target)
        with pytest.raises(OSError, match=r"takes up to .* MB of memory, 1\.0 kB are free"):
            convert(raw, target)
    with monkeypatch.context() as patch:
        usage = type("usage", (), {"free": 1000})
        patch.setattr(conversion.shutil, "disk_usage", lambda _: usage)
        with pytest.raises(OSError, match=r"the store takes about .* MB, 1\.0 kB are free"):
            convert(raw, target)
    assert not target.exists()


# --- interruptions


class Crash(Exception):
    """Any error that ends a conversion."""


def crash_after(monkeypatch, count: int, error: Exception) -> list[tuple[int, ...]]:
    """Lets `count` tasks run, then raises; returns the list of those that ran."""
    ran: list[tuple[int, ...]] = []
    original = shard.write_shard

    def write(job, level, position):
        if len(ran) == count:
            raise error
        result = original(job, level, position)
        if "memory" not in job.root["driver"]:
            ran.append((level, *position))
        return result

    monkeypatch.setattr(shard, "write_shard", write)
    return ran


def test_a_broken_conversion_goes_on_where_it_was(tmp_path, raw, data, monkeypatch):
    target = tmp_path / "a.zarr"
    with monkeypatch.context() as patch:
        crash_after(patch, 1, Crash())
        with pytest.raises(Crash):
            convert(raw, target, workers=1)
    message = "half-written: 1 of 8 shards are done; the same command with --resume"
    with pytest.raises(ValueError, match=message):
        Store.open(target)
    with pytest.raises(FileExistsError, match="half-written; continue with --resume"):
        convert(raw, target)
    with pytest.raises(ValueError, match="was begun with threshold None, now it is 5"):
        convert(raw, target, threshold=5, resume=True)
    journal = target / WORK / "journal.jsonl"
    journal.write_text(journal.read_text() + '{"task": [0, 0')  # killed while it wrote
    ran = crash_after(monkeypatch, -1, Crash())
    store = convert(raw, target, workers=1, resume=True)
    assert len(ran) == 7 and (0, 0, 0, 0) not in ran
    assert not (target / WORK).exists()
    assert_holds(store, data)


def test_resume_refuses_a_source_that_has_changed(tmp_path, raw, monkeypatch):
    with monkeypatch.context() as patch:
        crash_after(patch, 1, Crash())
        with pytest.raises(Crash):
            convert(raw, tmp_path / "a.zarr", workers=1)
    raw.write_bytes(bytes(len(raw.read_bytes())))
    os.utime(raw, ns=(1, 1))
    with pytest.raises(ValueError, match="the source is not the one that it was begun with"):
        convert(raw, tmp_path / "a.zarr", resume=True)


@pytest.mark.parametrize("kind", ["file", "slices", "image"])
def test_a_source_that_changes_meanwhile_is_told(tmp_path, raw, data, kind, monkeypatch):
    """Its store would hold parts of both versions. Other files beside slices do not count."""
    source = changed = raw
    if kind == "slices":
        source = tmp_path / "slices"
        source.mkdir()
        for number, plane in enumerate(data[..., 0]):
            changed = source / f"{number}.png"
            changed.write_bytes(pytest.importorskip("imagecodecs").png_encode(plane))
    elif kind == "image":
        source = write_foreign(tmp_path / "image", [data[..., 0]], "zyx", [[1.0] * 3])
        changed = source / "s0" / "c" / "0" / "0" / "0"
    original = shard.create_arrays

    def create(conversion, level):
        if "memory" not in conversion.root["driver"]:
            os.utime(changed, ns=(1, 1))
        original(conversion, level)

    with monkeypatch.context() as patch:
        patch.setattr(shard, "create_arrays", create)
        with pytest.raises(ValueError, match="has changed while it was converted; remove"):
            convert(source, tmp_path / "a.zarr", workers=1)
        with pytest.raises(ValueError, match="half-written"):
            Store.open(tmp_path / "a.zarr")
        changed = source / "log.txt" if kind == "slices" else tmp_path / "log.txt"
        changed.touch()
        assert_holds(convert(source, tmp_path / "b.zarr", workers=1), data)


def test_resume_refuses_an_image_whose_chunks_have_changed(tmp_path, data, monkeypatch):
    image = write_foreign(tmp_path / "image", [data[..., 0]], "zyx", [[1.0] * 3])
    with monkeypatch.context() as patch:
        crash_after(patch, 1, Crash())
        with pytest.raises(Crash):
            convert(image, tmp_path / "a.zarr", workers=1)
    chunk = image / "s0" / "c" / "0" / "0" / "0"
    os.utime(chunk, ns=(1, 1))
    with pytest.raises(ValueError, match="the source is not the one that it was begun with"):
        convert(image, tmp_path / "a.zarr", resume=True)


def test_a_store_within_the_folder_of_its_source_goes_on(tmp_path, data, monkeypatch):
    imagecodecs = pytest.importorskip("imagecodecs")
    for number, plane in enumerate(data[..., 0]):
        (tmp_path / f"{number}.png").write_bytes(imagecodecs.png_encode(plane))
    with monkeypatch.context() as patch:
        crash_after(patch, 1, Crash())
        with pytest.raises(Crash):
            convert(tmp_path, tmp_path / "a.zarr", workers=1)
    assert_holds(convert(tmp_path, tmp_path / "a.zarr", resume=True), data)


def test_work_that_a_kill_left_beside_a_finished_store_is_removed(tmp_path, raw, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("gvtorch.io.stores.unfinished.shutil.rmtree", lambda *_, **__: None)
        convert(raw, tmp_path / "a.zarr")
    assert (tmp_path / "a.zarr" / WORK / "manifest.json").exists()
    convert(raw, tmp_path / "a.zarr", resume=True)
    assert not (tmp_path / "a.zarr" / WORK).exists()


@pytest.mark.parametrize("kind", ["h5", "npz", "raw", "mhd", "npy"])
def test_resume_refuses_other_parts_of_the_same_file(tmp_path, kind, data, monkeypatch):
    """Another array, other axes or another byte order of a file; numbers beside their header."""
    file, target, cube = (
        tmp_path / f"a.{kind}",
        tmp_path / "a.zarr",
        data[:9, :9, :9, 0].astype("<i2"),
    )
    arrays, options = {"a": cube, "b": cube + 1}, {}
    before, after = {"key": "a"}, {"key": "b"}
    if kind == "h5":
        with pytest.importorskip("h5py").File(file, "w") as content:
            for name, array in arrays.items():
                content[name] = array
    elif kind == "npz":
        np.savez(file, **arrays)
    elif kind == "mhd":
        before = after = {}
        fields = "DimSize = 9 9 9\nElementType = MET_SHORT\nElementDataFile = a.bin\n"
        file.write_text(fields)
        (tmp_path / "a.bin").write_bytes(cube.tobytes())
    elif kind == "npy":
        np.save(file, cube)
        before, after = {"axes": "zyx"}, {"axes": "xyz"}
    else:
        file.write_bytes(cube.tobytes())
        before, after = {"dtype": "<i2"}, {"dtype": ">i2"}
        options = {"shape": (9, 9, 9)}
    with monkeypatch.context() as patch:
        crash_after(patch, 1, Crash())
        with pytest.raises(Crash):
            convert(file, target, workers=1, **options, **before)
    if kind == "mhd":
        os.utime(tmp_path / "a.bin", ns=(1, 1))
    with pytest.raises(ValueError, match="what is read of it differ"):
        convert(file, target, workers=1, resume=True, **options, **after)


def test_a_full_disk_is_told_and_goes_on(tmp_path, raw, data, monkeypatch):
    target = tmp_path / "a.zarr"

    class Full:
        def result(self):
            raise ValueError("RESOURCE_EXHAUSTED: Error writing: [OS error 28: No space left on")

    original = shard.begin_write
    with monkeypatch.context() as patch:
        patch.setattr(
            shard,
            "begin_write",
            lambda root, spec, *rest: (
                Full()
                if spec["path"] == "gvtorch/blocks/0" and root["driver"] == "file"
                else original(root, spec, *rest)
            ),
        )
        with pytest.raises(OSError, match="the disk is full") as caught:
            convert(raw, target, workers=1)
    assert caught.value.errno == errno.ENOSPC
    with pytest.raises(ValueError, match="half-written: 0 of 8"):
        Store.open(target)
    assert_holds(convert(raw, target, workers=1, resume=True), data)


def test_a_store_that_is_moved_away_meanwhile_is_named(tmp_path, raw):
    target, reports = tmp_path / "a.zarr", []

    def move(name: str, done: int, total: int) -> None:
        reports.append(name)
        if len(reports) == 2:
            target.rename(tmp_path / "elsewhere")  # at once, while a worker goes on writing

    with pytest.raises(OSError, match=re.escape(f"{target}/")):
        convert(raw, target, workers=1, progress=move)


KILLED = """
import sys, time
from gvtorch.io.stores import shard
from gvtorch.io.stores.conversion import convert
original = shard.write_shard
def slow(job, level, place):
    result = original(job, level, place)
    if job.root["driver"] == "file":
        time.sleep(0.2)
    return result
shard.write_shard = slow
convert(sys.argv[1], sys.argv[2], workers=1)
"""


def test_kill_9_and_resume(tmp_path, raw, data, monkeypatch):
    target = tmp_path / "a.zarr"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(raw), str(target)])
    journal = target / WORK / "journal.jsonl"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if journal.exists() and journal.read_text().count("\n") >= 3:
            break
        time.sleep(0.02)
    with pytest.raises(OSError, match="another process is converting to it"):
        convert(raw, target, resume=True)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = journal.read_text().count("\n")
    assert 3 <= done < 8
    with pytest.raises(ValueError, match=f"half-written: {done} of 8"):
        Store.open(target)
    ran = crash_after(monkeypatch, -1, Crash())
    store = convert(raw, target, workers=1, resume=True)
    assert len(ran) == 8 - done
    assert_holds(store, data)


# --- executors


def test_processes_write_the_same(tmp_path, data, raw, monkeypatch):
    monkeypatch.setattr(conversion_plan, "_FEW_TASKS", 1)
    seen: list[tuple[int, int]] = []
    store = convert(
        raw,
        tmp_path / "a.zarr",
        workers=2,
        progress=lambda _, done, total: seen.append((done, total)),
    )
    assert_holds(store, data)
    assert seen[0][0] == 0 and seen[-1][0] == seen[-1][1] > data.nbytes
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_threads_write_what_can_not_be_sent_to_processes(tmp_path, data, monkeypatch):
    monkeypatch.setattr(conversion_plan, "_FEW_TASKS", 0)
    with pytest.importorskip("h5py").File(tmp_path / "a.h5", "w") as content:
        content["data"] = data
        assert_holds(convert(content["data"], tmp_path / "a.zarr", axes="zyxc", workers=2), data)


def test_an_executor_of_ones_own(tmp_path, data, raw):
    with ThreadPoolExecutor(3) as pool:
        assert_holds(convert(raw, tmp_path / "a.zarr", executor=pool), data)


def test_processes_write_the_chosen_time_of_an_array(tmp_path):
    series = np.arange(3 * 8**3, dtype=np.uint16).reshape(3, 8, 8, 8)
    placement = {"spacing": (1, 2, 3), "origin": (4, 5, 6)}
    source = open_source(series, axes="tzyx", time=2, **placement)
    staged = source.staged(tmp_path)  # what worker processes read
    for name in ("time", "times", "extent", "spacing", "origin", "info", "stored", "dropped"):
        assert getattr(staged, name) == getattr(source, name)
    everything = (0, 0, 0), (8, 8, 8)
    assert np.array_equal(staged.read_region(*everything)[..., 0], series[2])


@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster(tmp_path, data, raw):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        store = convert(gv.Volume(data), tmp_path / "a.zarr", executor=client.get_executor())
        assert_holds(store, data)


# --- the command


def test_command_converts_and_tells(tmp_path, raw, data, capsys):
    target = tmp_path / "a.zarr"
    code, out, err = run_cli(capsys, "convert", raw, target, "--dry-run")
    assert code == 0 and not err and not target.exists()
    assert "disk free" in out and "memory" in out and re.search(r"seconds +\d+\.\d *\n", out)
    code, out, err = run_cli(
        capsys, "convert", raw, target, "--block", 64, "--spacing", "1,2,3", "--threshold", 4
    )
    assert (code, err) == (0, "") and "300x20x9, 7 levels" in out
    store = Store.open(target)
    assert (store.block, store.spacing, store.threshold) == (64, (1, 2, 3), 4)
    code, out, err = run_cli(capsys, "info", target, "--json")
    facts = json.loads(out)
    assert facts["extent"] == [300, 20, 9] and facts["dtype"] == "uint8" and facts["levels"] == 7
    assert facts["range"] == [[float(data.min()), float(data.max())]] and facts["disk bytes"] > 0
    table = run_cli(capsys, "info", target)[1]
    assert facts["unit"] is None and "unit" not in table
    assert f"[{data.min():g}, {data.max():g}]" in table, "as of volumes, not with all digits"
    code, out, err = run_cli(capsys, "convert", raw, target)
    assert code == 2 and err.count("\n") == 1 and "there is a store already" in err
    code, out, err = run_cli(
        capsys, "convert", raw, tmp_path / "b", "--workers", 2, "--scheduler", "tcp://x:1"
    )
    assert code == 2 and "leave --workers out" in err


def test_an_estimate_has_the_workers_that_memory_allows(tmp_path, monkeypatch):
    """As the conversion itself."""
    data = gv.Volume(noise((300, 300, 8, 1)))
    one, three = (estimate(data, tmp_path / "a.zarr", workers=n).memory_bytes for n in (1, 3))
    assert estimate(data, tmp_path / "a.zarr", workers=3, memory=(one + three) // 2).workers == 2
    assert estimate(data, tmp_path / "a.zarr", workers=3, memory=one).workers == 1
    with pytest.raises(ValueError, match="is too little, one worker takes"):
        estimate(data, tmp_path / "a.zarr", memory=one // 2)
    monkeypatch.setattr("gvtorch.io.stores.conversion_plan.resources.memory_free", lambda: 1)
    assert estimate(data, tmp_path / "a.zarr").workers == 1


def test_estimate_is_near_the_truth(tmp_path):
    data = noise((150, 150, 150, 1))
    estimated = estimate(gv.Volume(data), tmp_path / "a.zarr")
    store = convert(gv.Volume(data), tmp_path / "a.zarr")
    size = store.describe()["disk bytes"]
    assert estimated.disk_bytes == pytest.approx(size, rel=0.35)
    assert estimated.levels == store.levels and estimated.tasks == 6
    assert estimated.source_bytes == data.nbytes and estimated.seconds > 0
