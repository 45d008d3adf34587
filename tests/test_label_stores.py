"""Labels in files and stores: indexed, converted, resumed, streamed; on the command line."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from helpers import gvtorch
from helpers.labels import SPACING, WIDE, cells, kept, numbers

import gvtorch as gv
from gvtorch.io import label_source
from gvtorch.io.reading import open_source
from gvtorch.pool.pyramid import volume_levels


def same_as_resident(store: gv.Store, volume: gv.Volume) -> None:
    shader, cameras = gv.Labels(), [gv.Camera.orbit(30, 20, d, width=24, height=20) for d in (1, 5)]
    tree = gv.N3Tree.from_volume(volume, 8)
    with gv.Engine(gv.StoredProducer(store), brick_size=8) as engine:
        for camera in cameras:
            resident, picture = gv.render(tree, camera, shader), engine.render(camera, shader)
            assert picture.stats.converged and not engine.failures
            for name in ("color", "alpha", "depth", "label", "normal"):
                assert torch.equal(getattr(picture, name), getattr(resident, name)), name


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("kind", ["int64 file", "packed file", "volume", "uint16 file"])
def test_a_store_keeps_labels(tmp_path, kind):
    data = cells((70, 50, 60), 40, dtype=np.uint16 if "uint16" in kind else np.int64)
    data = data if "uint16" in kind else np.where(data % 4 == 0, 0, data * 2**33 - 9)
    file = tmp_path / ("labels.npy" if "packed" not in kind else "labels.npz")
    np.save(file, data) if file.suffix == ".npy" else np.savez_compressed(file, data)
    volume = gv.read_volume(file, labels=True, spacing=SPACING)
    assert np.array_equal(kept(volume), data)
    source = volume if kind == "volume" else file
    placement = {} if kind == "volume" else {"spacing": SPACING}
    store = gv.convert(source, tmp_path / "labels.zarr", labels=True, workers=1, **placement)
    assert store.info.labels and (store.label_values is None) == ("uint16" in kind)
    again = gv.read_volume(tmp_path / "labels.zarr")
    assert again.info.labels and np.array_equal(kept(again), data)
    levels = volume_levels(volume, store.levels, branching=2, brick_size=8, border=1)
    for number, level in enumerate(levels):
        z, y, x = level.values.shape[:3]
        stored = store.read_region(number, (0, 0, 0), (z, y, x))
        assert np.array_equal(stored, level.values.numpy()), number
    same_as_resident(store, volume)


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_a_store_of_more_labels_than_16_bits_count_by_processes(tmp_path):
    data = np.random.default_rng(0).integers(0, 80_000, (150, 140, 130)) * 2**40 + 5
    np.save(tmp_path / "many.npy", data)
    store = gv.convert(tmp_path / "many.npy", tmp_path / "many.zarr", labels=True, workers=2)
    assert store.dtype == torch.float32 and len(store.label_values) == len(np.unique(data))
    assert np.array_equal(kept(gv.read_volume(tmp_path / "many.zarr")), data)


def test_converting_labels_resumes_without_finding_them_again(tmp_path, monkeypatch):
    data = cells((300, 40, 30), 20) * 2**35
    np.save(tmp_path / "a.npy", data)
    options = {"labels": True, "executor": ThreadPoolExecutor(1), "workers": 1}

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "converting" and done:
            raise RuntimeError("the power is gone")

    with pytest.raises(RuntimeError, match="the power is gone"):
        gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", progress=stop, **options)
    with pytest.raises(FileExistsError, match="half-written"):
        gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", **options)
    with pytest.raises(ValueError, match="was begun with"):
        gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", resume=True, nan=0, **options)
    monkeypatch.setattr(label_source, "distinct", None)  # calling it would fail
    store = gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", resume=True, **options)
    assert np.array_equal(kept(gv.read_volume(tmp_path / "a.zarr")), data)
    assert store.label_values.tolist() == np.unique(data).tolist()


def test_a_label_that_comes_while_it_is_read_is_an_error(tmp_path):
    np.save(tmp_path / "a.npy", cells((20, 20, 20), 5) * WIDE)
    source = open_source(tmp_path / "a.npy", labels=True)
    for labels in ([0, WIDE, 2 * WIDE, 3 * WIDE], [0, 5 * WIDE], [7]):
        counted = label_source.IndexSource.of(source, np.array(labels))
        with pytest.raises(OSError, match="changed while it was read: a label is new"):
            counted.read_region((0, 0, 0), (20, 20, 20))


def test_damaged_label_tables_are_told(tmp_path):
    np.save(tmp_path / "a.npy", cells((20, 20, 20), 5) * WIDE)
    gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", labels=True)
    file = tmp_path / "a.zarr" / "zarr.json"
    text = file.read_text()
    for count, message in ((0, "damaged"), (6, "damaged"), ('"x"', "damaged"), (2**25, "damaged")):
        file.write_text(text.replace('"label_count": 5', f'"label_count": {count}'))
        with pytest.raises(ValueError, match=message):
            gv.Store.open(tmp_path / "a.zarr")
    file.write_text(text)
    for part in (tmp_path / "a.zarr" / "gvtorch" / "labels").rglob("c/*"):
        part.write_bytes(part.read_bytes()[:-3])
    with pytest.raises((ValueError, OSError)):
        gv.Store.open(tmp_path / "a.zarr")


def test_files_of_wide_integers_never_merge_in_silence(tmp_path):
    data = cells((40, 30, 20), 5) + WIDE
    np.save(tmp_path / "a.npy", data)
    np.savez(tmp_path / "a.npz", data)
    for name in ("a.npy", "a.npz"):
        for work in (gv.read_volume, lambda file: gv.convert(file, tmp_path / "a.zarr")):
            with pytest.raises((ValueError, OSError), match=r"labels=True \(--labels\)") as caught:
                work(tmp_path / name)
            assert "\n" not in str(caught.value)


def test_what_conversion_refuses(tmp_path):
    volume = gv.Volume(numbers(8, 8, 8), labels=True)
    with pytest.raises(ValueError, match="threshold is for values"):
        gv.convert(volume, tmp_path / "a.zarr", threshold=1)
    with pytest.raises(ValueError, match=r"must hold labels: gv\.Volume\(data, labels=True\)"):
        gv.convert(gv.Volume(numbers(8, 8, 8)), tmp_path / "a.zarr", labels=True)
    np.save(tmp_path / "half.npy", np.full((4, 4, 4), 0.5))
    with pytest.raises((ValueError, OSError), match="labels must be whole numbers"):
        gv.convert(tmp_path / "half.npy", tmp_path / "a.zarr", labels=True)
    assert not (tmp_path / "a.zarr" / "zarr.json").exists()


@pytest.mark.backend("cpp")
def test_the_command_line_shows_labels(tmp_path):
    np.save(tmp_path / "a.npy", cells((24, 22, 26), 9) * WIDE)
    size = ("--size", "24x20")
    refused = gvtorch("render", "a.npy", "-o", "a.png", *size, cwd=tmp_path)
    assert refused.returncode == 2 and "--labels" in refused.stderr
    done = gvtorch(
        *("render", "a.npy", "--labels", "-o", "a.png", "--npz", "a.npz", *size), cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    run = gvtorch("convert", "a.npy", "a.zarr", "--labels", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    for shader in ((), ("--shader", "labels")):
        done = gvtorch(
            *("render", "a.zarr", "-o", "b.png", "--npz", "b.npz", *size, *shader), cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
        with np.load(tmp_path / "a.npz") as a, np.load(tmp_path / "b.npz") as b:
            assert np.array_equal(a["label"], b["label"]) and a["label"].max() > WIDE
            assert np.array_equal(a["color"], b["color"])
    for flags in (("--tf", "bone"), ("--shader", "labels", "--tf", "bone"), ("--threshold", "0")):
        done = gvtorch("render", "a.npy", "--labels", "-o", "a.png", *flags, cwd=tmp_path)
        assert done.returncode == 2 and "labels" in done.stderr, flags
        assert len(done.stderr.splitlines()) == 1
    info = gvtorch("info", "a.zarr", cwd=tmp_path).stdout
    assert "labels" in info


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", ["uint32", "uint8"])
def test_label_images_that_another_library_wrote(tmp_path, dtype):
    """By zarr, with one level: coarser levels are made by majority; wide labels are indexed."""
    zarr = pytest.importorskip("zarr")
    data = (cells((40, 36, 44), 12) * (2**28 - 1 if dtype == "uint32" else 21)).astype(dtype)
    group = zarr.open_group(tmp_path / "cells.zarr", mode="w", zarr_format=3)
    group.create_array("0", data=data, chunks=(16, 16, 16))
    axes = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    scale = [{"type": "scale", "scale": [1.3, 0.8, 1.0]}]
    datasets = [{"path": "0", "coordinateTransformations": scale}]
    images = [{"name": "cells", "axes": axes, "datasets": datasets}]
    group.attrs["ome"] = {"version": "0.5", "multiscales": images, "image-label": {}}
    volume = gv.read_volume(tmp_path / "cells.zarr")
    assert volume.info.labels and np.array_equal(kept(volume), data.astype(np.int64))
    store = gv.Store.open(tmp_path / "cells.zarr")
    if dtype == "uint8":
        same_as_resident(store, volume)
    else:
        with pytest.raises(ValueError, match=r"labels of <u4 must be indexed first: gvtorch"):
            gv.StoredProducer(store)
    converted = gv.convert(tmp_path / "cells.zarr", tmp_path / "own.zarr")
    assert converted.info.labels and converted.spacing == SPACING
    same_as_resident(converted, volume)
