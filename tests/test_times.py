"""Several time points: read one by one, converted all, streamed one at a time."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import gvtorch, run_cli
from helpers.stores import assert_holds, noise, write_foreign

import gvtorch as gv
from gvtorch.base.image_info import ChannelInfo, ImageInfo
from gvtorch.io.stores import conversion_plan, shard
from gvtorch.io.stores.conversion import convert, estimate
from gvtorch.io.stores.store import Store

TIMES = 3


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    """(t, z, y, x) values with another range at each time."""
    return np.stack([noise((20, 37, 150, 1), seed=n)[..., 0] // (TIMES - n) for n in range(TIMES)])


@pytest.fixture(scope="module")
def npy(tmp_path_factory, data) -> Path:
    file = tmp_path_factory.mktemp("times") / "beat.npy"
    np.save(file, data)
    return file


@pytest.fixture(scope="module")
def store(tmp_path_factory, npy) -> Path:
    folder = tmp_path_factory.mktemp("times") / "beat.zarr"
    convert(npy, folder, axes="tzyx", spacing=(1, 2, 3))
    return folder


def save_nifti(path: Path, data: np.ndarray) -> Path:
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(data.T.copy(), np.diag([0.5, 0.25, 2, 1]))
    image.header.set_xyzt_units("micron", "msec")
    image.header["pixdim"][4] = 40
    image.header["toffset"] = 5
    nibabel.save(image, path)
    return path


# --- reading


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_a_nifti_of_four_dimensions_is_time(tmp_path, data, ending):
    path = save_nifti(tmp_path / f"a.{ending}", data)
    with pytest.warns(UserWarning) as caught:
        first = gv.read_volume(path)
    assert [str(warning.message) for warning in caught] == [
        f"{path}: has 3 time points, this is the first; time=N (--time N) reads another, up to 2"
    ]
    assert np.array_equal(first.data[..., 0].numpy(), data[0])
    for time in range(TIMES):
        volume = gv.read_volume(path, time=time)
        assert np.array_equal(volume.data[..., 0].numpy(), data[time])
        assert volume.spacing == (0.5, 0.25, 2)
    info = volume.info
    assert (info.unit, info.time_unit) == ("micrometer", "millisecond")
    assert (info.time_step, info.time_origin) == (40, 5)
    for wrong in (3, -1, 1.5, "1"):
        with pytest.raises(ValueError, match=r"has no time .*; it has 3 time points, 0 to 2"):
            gv.read_volume(path, time=wrong)


def test_a_nifti_of_five_dimensions_has_channels(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    data = np.random.default_rng(0).normal(size=(6, 5, 4, 1, 3)).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(data, np.eye(4)), tmp_path / "vector.nii")
    volume = gv.read_volume(tmp_path / "vector.nii")
    assert np.array_equal(volume.data.numpy(), data[:, :, :, 0].transpose(2, 1, 0, 3))
    both = np.random.default_rng(1).normal(size=(6, 5, 4, 2, 3)).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(both, np.eye(4)), tmp_path / "both.nii.gz")
    volume = gv.read_volume(tmp_path / "both.nii.gz", time=1)
    assert np.array_equal(volume.data.numpy(), both[:, :, :, 1].transpose(2, 1, 0, 3))


def test_one_time_has_none_but_the_first(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((5, 6, 7), np.uint8))
    assert gv.read_volume(tmp_path / "a.npy", time=0).extent == (7, 6, 5)
    with pytest.raises(ValueError, match="has no time 1; it has 1 time point, which is 0"):
        gv.read_volume(tmp_path / "a.npy", time=1)
    with pytest.raises(ValueError, match="has no time 1; it has 1 time point"):
        convert(gv.Volume(np.zeros((5, 6, 7), np.uint8)), tmp_path / "a.zarr", time=1)


# --- stores


def test_every_time_has_the_bits_of_its_own_pyramid(store, data):
    for time in range(TIMES):
        opened = Store.open(store, time=time)
        assert (opened.times, opened.time, opened.spacing) == (TIMES, time, (1, 2, 3))
        assert opened.value_range == [(float(data.min()), float(data.max()))], "of all times"
        assert_holds(opened, data[time, ..., None])
    with pytest.raises(ValueError, match="has no time 3; it has 3 time points, 0 to 2"):
        Store.open(store, time=3)


def test_the_metadata_is_that_of_five_axes(store, data):
    import ome_zarr_models
    import yaozarrs
    import zarr

    yaozarrs.validate_zarr_store(str(store))
    group = zarr.open_group(store, mode="r")
    image = ome_zarr_models.open_ome_zarr(group)
    assert [axis.name for axis in image.ome_attributes.multiscales[0].axes] == list("tczyx")
    assert np.array_equal(group["0"][:, 0], data)
    assert group["1"].shape == (TIMES, 1, 10, 19, 75)


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_time_step_and_units_go_all_the_way(tmp_path, data, ending):
    path = save_nifti(tmp_path / f"a.{ending}", data)
    store = convert(path, tmp_path / "a.zarr")
    attributes = json.loads((tmp_path / "a.zarr/zarr.json").read_text())["attributes"]
    (image,) = attributes["ome"]["multiscales"]
    assert image["axes"][0] == {"name": "t", "type": "time", "unit": "millisecond"}
    assert image["axes"][4] == {"name": "x", "type": "space", "unit": "micrometer"}
    scale, move = (t.popitem()[1] for t in image["datasets"][1]["coordinateTransformations"])
    assert scale == [40, 1, 4, 0.5, 1] and move == [5, 0, 1, 0.125, 0.25]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = gv.read_volume(path).info
        assert store.info == expected == gv.read_volume(tmp_path / "a.zarr").info
    for time in range(TIMES):
        assert_holds(Store.open(tmp_path / "a.zarr", time=time), data[time, ..., None])
    facts = Store.open(tmp_path / "a.zarr", time=1).describe()
    assert (facts["times"], facts["time"], facts["time step"]) == (3, 1, "40 millisecond")


def test_one_time_makes_a_store_without(tmp_path, npy, data):
    store = convert(npy, tmp_path / "a.zarr", axes="tzyx", time=1)
    plain = convert(gv.Volume(data[1]), tmp_path / "b.zarr")
    assert store.times == 1
    assert_holds(store, data[1, ..., None])
    for file in (tmp_path / "b.zarr").rglob("*"):
        twin = tmp_path / "a.zarr" / file.relative_to(tmp_path / "b.zarr")
        if file.is_file() and file != tmp_path / "b.zarr/zarr.json":
            assert twin.read_bytes() == file.read_bytes()
    assert plain.layout == store.layout


def test_a_store_of_times_converts_to_itself(tmp_path, store):
    again = convert(store, tmp_path / "again.zarr")
    assert again.times == TIMES and again.info == Store.open(store).info
    for file in store.rglob("*"):
        if file.is_file() and file.name not in ("zarr.json", "checksums.json"):
            twin = tmp_path / "again.zarr" / file.relative_to(store)
            assert twin.read_bytes() == file.read_bytes()


def test_foreign_times_come_over(tmp_path):
    data = noise((9, 17, 25, 2), "int16")
    stored = np.stack([data + n for n in range(TIMES)]).transpose(0, 4, 1, 2, 3)
    scales = [[0.5, 1.0, 2.0, 1.0, 1.0]]
    write_foreign(tmp_path / "a", [stored], "tczyx", scales, version=2)
    for time in (None, 2):
        target = tmp_path / f"{time}.zarr"
        store = convert(tmp_path / "a", target, time=time)
        assert store.times == (TIMES if time is None else 1)
        assert store.info.time_step == (0.5 if time is None else None), "no axis, no step"
        for number in range(store.times):
            moment = number if time is None else time
            assert_holds(Store.open(target, time=number), data + moment)


def test_resume_goes_on_in_the_middle_of_times(tmp_path, npy, data, monkeypatch):
    original, ran = shard.write_shard, []

    def crash(task, level, position):
        if task.root["driver"] == "file":
            if len(ran) == 4:
                raise RuntimeError("broken off")
            ran.append((level, *position))
        return original(task, level, position)

    target = tmp_path / "a.zarr"
    with monkeypatch.context() as patch:
        patch.setattr(shard, "write_shard", crash)
        with pytest.raises(RuntimeError):
            convert(npy, target, axes="tzyx", workers=1)
    assert all(len(task) == 5 for task in ran)
    with pytest.raises(ValueError, match="was begun with times 3, now it is 1"):
        convert(npy, target, axes="tzyx", time=0, resume=True)
    store = convert(npy, target, axes="tzyx", resume=True)
    for time in range(store.times):
        assert_holds(Store.open(target, time=time), data[time, ..., None])


def test_processes_convert_times(tmp_path, data, monkeypatch):
    monkeypatch.setattr(conversion_plan, "_FEW_TASKS", 1)
    path = save_nifti(tmp_path / "a.nii.gz", data)  # staged, so that all processes read it
    estimated = estimate(path, tmp_path / "a.zarr", workers=2)
    assert estimated.tasks == 18 and estimated.source_bytes == data.nbytes
    convert(path, tmp_path / "a.zarr", workers=2)
    for time in range(TIMES):
        assert_holds(Store.open(tmp_path / "a.zarr", time=time), data[time, ..., None])


def test_a_missing_shard_of_one_time_is_its_own(tmp_path, npy, data):
    target = tmp_path / "a.zarr"
    convert(npy, target, axes="tzyx")
    for name in ("0", "gvtorch/cells/0", "gvtorch/blocks/0"):
        next(file for file in (target / name / "c/1").rglob("*") if file.is_file()).unlink()
    assert_holds(Store.open(target, time=0), data[0, ..., None])
    assert_holds(Store.open(target, time=2), data[2, ..., None])
    store = Store.open(target, time=1)
    with pytest.raises(OSError, match=r"a\.zarr/0: shard \(0, 0, 0\) z y x: missing chunk"):
        store.read_region(0, (0, 0, 0), (9, 9, 9))
    with pytest.raises(OSError, match="missing chunk"):
        store.read_cells(0, (0, 0, 0), (2, 2, 2))


# --- pictures


@pytest.mark.backend("cpp")
def test_each_time_is_streamed_as_its_volume_is_rendered(store, data):
    camera = gv.Camera.orbit(30, 20, 1.6, 30, 24, 24)
    shader = gv.TransferFunction.from_points([(0, 0), (255, 0.2)])
    seen = []
    for time in range(TIMES):
        volume = gv.Volume(data[time], (1, 2, 3))
        expected = gv.render(gv.N3Tree.from_volume(volume), camera, shader)
        with gv.Engine(gv.StoredProducer(store, time=time)) as engine:
            picture = engine.render(camera, shader)
            assert torch.equal(picture.color, expected.color)
            assert torch.equal(picture.depth, expected.depth)
        seen.append(picture.color.sum().item())
    assert len(set(seen)) == TIMES


@pytest.mark.backend("cpp")
def test_the_command_line_takes_a_time(tmp_path, npy, capsys):
    target, picture = tmp_path / "a b.zarr", tmp_path / "a.npy"
    code, out, err = run_cli(capsys, "convert", npy, target)
    assert code == 2 and err.count("\n") == 1 and "--axes" in err and "'tzyx'" in err
    code, out, err = run_cli(capsys, "convert", npy, target, "--axes", "tzyx")
    assert (code, err) == (0, "") and "150x37x20 at 3 times, 6 levels" in out
    code, out, err = run_cli(capsys, "info", target, "--time", 2, "--json")
    assert code == 0 and (json.loads(out)["times"], json.loads(out)["time"]) == (3, 2)
    code, out, err = run_cli(capsys, "info", target, "--time", 3)
    assert code == 2 and "has no time 3; it has 3 time points, 0 to 2" in err
    pictures = []
    size = ("--size", "16x16", "--brick-pool", "9 MB")
    for time in (0, 2):
        code, out, err = run_cli(capsys, "render", target, "-o", picture, "--time", time, *size)
        assert (code, err) == (0, "")
        pictures.append(np.load(picture)[..., :3])
        code, out, err = run_cli(
            *(capsys, "render", npy, "-o", picture, "--time", time, "--axes", "tzyx"),
            *("--size", "16x16"),
        )
        assert (code, err) == (0, "")
    assert np.abs(pictures[0] - pictures[1]).max() > 0.01
    code, out, err = run_cli(
        *(capsys, "fly", target, "-o", tmp_path / "f", "--time", 1, "--frames", 1, *size)
    )
    assert (code, err) == (0, "")


@pytest.mark.backend("cpp")
def test_filtered_colours_of_every_time(tmp_path, npy, capsys):
    target = tmp_path / "a.zarr"
    convert(npy, target, axes="tzyx")
    code, _, err = run_cli(capsys, "filter", target, "--tf", "gray", "--directions", "one")
    assert (code, err) == (0, "")
    camera = gv.Camera.orbit(30, 20, 9, 30, 16, 16)
    for time in range(TIMES):
        store = Store.open(target, time=time)
        assert list(store.coarse) == ["filtered"]
        shader = gv.Filtered.stored(store)
        with gv.Engine(gv.StoredProducer(store, filtered=shader)) as engine:
            picture = engine.render(camera, shader)
            assert picture.stats.failed == 0 and picture.alpha.max() > 0
        alone = tmp_path / f"{time}.zarr"
        convert(npy, alone, axes="tzyx", time=time)
        gv.Filtered.add_to(Store.open(alone), shader.transfer, directions=False)
        same = gv.Filtered.stored(Store.open(alone))
        with gv.Engine(gv.StoredProducer(alone, filtered=same)) as engine:
            assert torch.equal(engine.render(camera, same).color, picture.color)
    import zarr

    assert "coarse" in zarr.open_group(target, mode="r")["gvtorch"], "groups all the way"


def test_info_of_channels_and_times_together(tmp_path):
    info = ImageInfo(
        unit="nanometer",
        channels=(ChannelInfo(name="DAPI", color=(0, 0, 1), window=(3, 90)), ChannelInfo()),
    )
    volume = gv.Volume(noise((9, 9, 9, 2)), info=info)
    assert convert(volume, tmp_path / "a.zarr").info == info
    assert gv.read_volume(tmp_path / "a.zarr").info == info


@pytest.mark.parametrize("kind", ["npy", "zarr"])
def test_a_film_over_time(tmp_path, kind):
    """One picture per time point, from the start of an orbit; more pictures are spread evenly."""
    data = np.zeros((4, 6, 8, 10), np.uint8)
    for moment, values in enumerate(data):
        values[:, :, 2 * moment : 2 * moment + 2] = 200
    file = tmp_path / "a.npy"
    np.save(file, data)
    flags = ("--axes", "tzyx")
    if kind == "zarr":
        assert gvtorch("convert", file, tmp_path / "a.zarr", *flags, "--workers", 1).returncode == 0
        file, flags = tmp_path / "a.zarr", ()
    options = ("--size", "24x24", "--window", "0,200", *flags)

    def fly(*more) -> list[bytes]:
        folder = tmp_path / "f"
        shutil.rmtree(folder, ignore_errors=True)
        run = gvtorch("fly", file, "-o", folder, *options, *more)
        assert run.returncode == 0, run.stderr
        assert "time points" not in run.stderr
        return [frame.read_bytes() for frame in sorted(folder.glob("*.png"))]

    whole = fly("--times", "all", "--orbit", "30,20,2.4")
    assert len(whole) == len(set(whole)) == 4
    for moment in range(4):
        out = tmp_path / "one.png"
        camera = ("--camera", "orbit:30,20,2.4", "--time", moment)
        run = gvtorch("render", file, "-o", out, *options, *camera)
        assert run.returncode == 0 and out.read_bytes() == whole[moment]
    some = fly("--times", "1-2", "--frames", 5, "--orbit", "30,20,2.4")
    assert some == [whole[n] for n in (1, 1, 1, 2, 2)]
    assert len(set(fly("--times", "0-0", "--turntable", "0.12"))) == 3, "the camera moves"
    for wrong, message in (("3-9", "from 0 to 3"), ("x", "must be all or A-B")):
        run = gvtorch("fly", file, "-o", tmp_path / "g", *options, "--times", wrong)
        assert run.returncode == 2 and message in run.stderr and not (tmp_path / "g").exists()
    both = gvtorch("fly", file, "-o", tmp_path / "g", *options, "--times", "all", "--time", 1)
    assert both.returncode == 2 and "leave one out" in both.stderr


def test_keys_of_a_film_tell_the_time_point(tmp_path):
    """It is the nearest to the keys' time, which is interpolated smoothly."""
    data = np.zeros((4, 6, 8, 10), np.uint8)
    for moment, values in enumerate(data):
        values[:, :, 2 * moment : 2 * moment + 2] = 200
    np.save(tmp_path / "a.npy", data)
    eye = {"eye": [4, 3, 40], "target": [4, 3, 3], "up": [0, 1, 0]}
    options = ("--axes", "tzyx", "--size", "24x24", "--window", "0,200")
    options = (*options, "--keys", tmp_path / "keys.json", "--frames", 5)

    def fly(last: float, *more):
        keys = [{"time": t, "state": {"time": last * t, "camera": eye}} for t in (0.0, 1.0)]
        (tmp_path / "keys.json").write_text(json.dumps(keys))
        return gvtorch("fly", tmp_path / "a.npy", "-o", tmp_path / "f", *options, *more)

    assert fly(2).returncode == 0
    played = [frame.read_bytes() for frame in sorted((tmp_path / "f").glob("*.png"))]
    order = [played.index(frame) for frame in played]
    assert len(order) == 5 and len(set(order)) == 3 and order == sorted(order)
    for last, flags, message in (
        (2, ("--time", 1), "--keys sets what --time sets"),
        (2, ("--times", "all"), "--keys sets what --times sets"),
        (9, (), "time must be from 0 to 3 of"),
    ):
        run = fly(last, *flags)
        assert run.returncode == 2 and message in run.stderr and run.stderr.count("\n") == 1
