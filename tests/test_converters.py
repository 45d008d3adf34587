"""Several converters of one target; damaged journals, and files that have changed since."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import gvtorch
from helpers.stores import assert_holds, noise

import gvtorch as gv
from gvtorch.io.reading import as_source
from gvtorch.io.stores import conversion, shard, unfinished
from gvtorch.io.stores.channels import convert_channels
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.store import Store
from gvtorch.io.stores.store_layout import WORK

SHAPE = (20, 30, 260, 1)  # two shards a row


@pytest.fixture
def data() -> np.ndarray:
    return noise(SHAPE)


@pytest.fixture
def raw(tmp_path, data) -> Path:
    file = tmp_path / "a_260x30x20_uint8.raw"
    file.write_bytes(data.tobytes())
    return file


def listed(folder: Path) -> dict[str, bytes]:
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def test_a_converter_that_starts_at_the_same_time_leaves_a_finished_store_alone(
    tmp_path, raw, monkeypatch
):
    target, other = tmp_path / "a.zarr", noise(SHAPE, seed=1)
    original, before = conversion.plan_of, {}

    def plan(*args):
        """Lets the other converter start later and finish first."""
        if not before:
            before["running"] = b""
            convert(gv.Volume(other), target)
            before.update(listed(target))
        return original(*args)

    monkeypatch.setattr(conversion, "plan_of", plan)
    with pytest.raises(FileExistsError, match="there is a store already"):
        convert(raw, target)
    del before["running"]
    assert listed(target) == before and not (target / WORK).exists()
    assert_holds(Store.open(target), other)


def test_a_converter_does_not_take_over_what_another_has_begun(tmp_path, raw, data, monkeypatch):
    target, original = tmp_path / "a.zarr", conversion.plan_of

    def plan(*args):
        with monkeypatch.context() as patch:
            patch.setattr(conversion, "plan_of", original)
            patch.setattr(shard, "write_shard", lambda *_: 1 / 0)
            patch.setattr(conversion, "check_room", lambda *_: None)
            patch.setattr(conversion, "estimate_of", lambda *_: None)
            with pytest.raises(ZeroDivisionError):
                convert(raw, target, workers=1)
        return original(*args)

    with monkeypatch.context() as patch:
        patch.setattr(conversion, "plan_of", plan)
        with pytest.raises(FileExistsError, match="half-written; continue with --resume"):
            convert(raw, target)
    assert_holds(convert(raw, target, resume=True), data)


def test_channels_of_another_converter_are_not_taken_for_ones_own(tmp_path, monkeypatch):
    target, original = tmp_path / "a.zarr", unfinished.as_json
    mine, other = (
        {"a": as_source("test", np.full((9, 9, 9), number, np.uint8), "zyx")} for number in (1, 2)
    )

    def meanwhile(value):
        with monkeypatch.context() as patch:
            patch.setattr(unfinished, "as_json", original)
            with contextlib.suppress(OSError):
                convert_channels(other, target)
        return original(value)

    with monkeypatch.context() as patch:
        patch.setattr(unfinished, "as_json", meanwhile)
        store = convert_channels(mine, target)
    assert (store.read_region(0, (0, 0, 0), (9, 9, 9)) == 1).all()


def test_the_lock_of_a_target_that_went_away_is_taken_anew(tmp_path, monkeypatch):
    import fcntl

    target, original, turns = tmp_path / "a.zarr", fcntl.flock, []

    def flock(*args):
        if not turns:
            shutil.rmtree(target)  # as another converter may, with the lock file that is open here
        turns.append(args)
        return original(*args)

    monkeypatch.setattr(fcntl, "flock", flock)
    with unfinished.claimed(target, {}, resume=False):
        assert len(turns) == 2 and (target / WORK / "lock").exists()


def test_resume_of_a_finished_store_says_so(tmp_path, raw, data):
    target = tmp_path / "a.zarr"
    assert gvtorch("convert", raw, target).returncode == 0
    before = listed(target)
    run = gvtorch("convert", raw, target, "--resume")
    assert run.returncode == 0 and "is finished already" in run.stdout
    assert listed(target) == before
    run = gvtorch("convert", raw, target)
    assert run.returncode == 2 and "there is a store already" in run.stderr
    np.save(tmp_path / "other.npy", np.zeros((5, 5, 5), np.int16))
    for flags, message in (
        ((raw, target, "--block", "64"), "with block 32, now it is 64"),
        ((raw, target, "--threshold", "9"), "with threshold None, now it is 9.0"),
        ((raw, target, "--spacing", "1,1,9"), "with spacing (1.0, 1.0, 1.0), now it is"),
        ((raw, target, "--labels"), "with labels False, now it is True"),
        ((tmp_path / "other.npy", target), "is finished, with extent"),
    ):
        run = gvtorch("convert", *flags, "--resume")
        assert run.returncode == 2 and message in run.stderr, run.stderr
    assert listed(target) == before
    series, one = np.stack([data] * 3), tmp_path / "one.zarr"
    gv.convert(series, one, axes="tzyxc", time=1)
    assert gv.convert(series, one, axes="tzyxc", time=1, resume=True).times == 1
    with pytest.raises(ValueError, match="is finished, with times 1, now it is 3"):
        gv.convert(series, one, axes="tzyxc", resume=True)
    raw.unlink()
    assert gvtorch("convert", raw, target, "--resume").returncode == 0


# --- the journal


@pytest.fixture
def begun(tmp_path, raw, monkeypatch) -> Path:
    """A half-written store, of which three tasks are done."""
    original, ran = shard.write_shard, []

    def write(task, level, position):
        if len(ran) == 3:
            raise ZeroDivisionError
        result = original(task, level, position)
        if task.root["driver"] == "file":
            ran.append(position)
        return result

    with monkeypatch.context() as patch:
        patch.setattr(shard, "write_shard", write)
        with pytest.raises(ZeroDivisionError):
            convert(raw, tmp_path / "a.zarr", workers=1)
    return tmp_path / "a.zarr"


def tasks_of_resuming(raw: Path, target: Path, monkeypatch) -> list[tuple[int, ...]]:
    original, ran = shard.write_shard, []

    def write(task, level, position):
        ran.append((level, *position))
        return original(task, level, position)

    with monkeypatch.context() as patch:
        patch.setattr(shard, "write_shard", write)
        convert(raw, target, workers=1, resume=True)
    return ran


@pytest.mark.parametrize("kind", ["cut", "changed", "nonsense", "empty"])
def test_a_damaged_line_of_the_journal_has_its_task_done_again(begun, raw, data, monkeypatch, kind):
    journal = begun / WORK / "journal.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    assert len(lines) == 3
    lines[1] = {
        "cut": lines[1][:-20],  # the next line joins it
        "changed": lines[1].replace('"voxels": ', '"voxels": 1'),
        "nonsense": "[" * 10**5 + "\n",
        "empty": "\n",
    }[kind]
    again = json.loads(journal.read_text().splitlines()[1])["task"]
    journal.write_text("".join(lines))
    ran = tasks_of_resuming(raw, begun, monkeypatch)
    assert tuple(again) in ran and (0, 0, 0, 0) not in ran
    assert_holds(Store.open(begun), data)


def test_the_journal_is_there_as_a_whole_at_any_time(begun, raw, data, monkeypatch):
    """A crash while it is rewritten loses nothing that is done."""
    before = (begun / WORK / "journal.jsonl").read_bytes()

    def crash(*_):
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(unfinished, "rename", crash)
        with pytest.raises(ZeroDivisionError):
            convert(raw, begun, workers=1, resume=True)
    assert (begun / WORK / "journal.jsonl").read_bytes() == before
    assert len(tasks_of_resuming(raw, begun, monkeypatch)) == 5
    assert_holds(Store.open(begun), data)


# --- files copied over others


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("whole") / "a.zarr"
    two = np.stack([noise((40, 40, 300, 1), seed=seed) for seed in (0, 1)])
    np.save(target.with_name("a.npy"), two[..., 0])
    convert(target.with_name("a.npy"), target, axes="tzyx", workers=1)
    return target


@pytest.fixture
def copied(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "b.zarr"))


def refusals(target: Path) -> list[str]:
    """Returns the errors of reading the first time point in each of three ways."""
    try:
        store = Store.open(target)
    except (ValueError, OSError) as error:
        return [str(error)]
    messages = []
    positions = np.array(list(np.ndindex(*store.block_grid(0))))
    messages += sorted(set(store.read_blocks(0, positions)[1].values()))
    for read, size in ((store.read_cells, store.cell_grid(0)), (store.read_region, None)):
        try:
            read(0, (0, 0, 0), size or store.level_extent(0)[::-1])
        except OSError as error:
            messages.append(str(error))
    return messages


def test_whole_stores_are_read(whole, copied):
    assert refusals(whole) == refusals(copied) == []


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("gvtorch/cells/0/c/0/0/0/0/0/0", "gvtorch/cells/0/c/0/0/0/1/0/0"),
        ("gvtorch/cells/0/c/0/0/0/1/0/0", "gvtorch/cells/0/c/1/0/0/1/0/0"),
        ("gvtorch/blocks/0/c/0/0/0/0/0/0/0/0", "gvtorch/blocks/0/c/1/0/0/0/0/0/0/0"),
        ("0/c/0/0/0/0/0", "0/c/1/0/0/0/0"),
    ],
)
def test_a_file_copied_over_another_is_an_error(copied, name, other):
    assert (copied / name).exists()
    shutil.copyfile(copied / other, copied / name)
    messages = refusals(copied)
    assert messages and all(name in message and "checksum" in message for message in messages)


def test_metadata_that_is_not_what_was_written_is_an_error(copied, whole):
    root = copied / "zarr.json"
    content = json.loads(root.read_text())
    content["attributes"]["gvtorch"]["spacing"] = [1.0, 1.0, 1.5]
    root.write_text(json.dumps(content))
    assert refusals(copied) == [f"{copied}: damaged: gvtorch's metadata is not what was written"]
    content["attributes"]["gvtorch"]["spacing"] = [1.0, 1.0, 1.0]
    content["attributes"]["ome"]["omero"] = {"channels": []}  # other tools may write there
    root.write_text(json.dumps(content, indent=3))
    assert refusals(copied) == []
    sums = copied / "gvtorch/checksums.json"
    listed = sums.read_text()
    for text in ("{}", '{"files": {}}', "[" * 10**5, None):
        sums.unlink() if text is None else sums.write_text(text)
        messages = refusals(copied)
        assert len(messages) >= 3 and all("checksums.json" in m for m in messages), messages
    sums.write_text(listed)
    assert refusals(copied) == []


def test_a_store_without_checksums_is_read(copied):
    root = copied / "zarr.json"
    content = json.loads(root.read_text())
    attributes = content["attributes"]["gvtorch"]
    del attributes["checksum"], attributes["files_sum"]
    root.write_text(json.dumps(content))
    (copied / "gvtorch/checksums.json").unlink()
    assert refusals(copied) == []


def test_a_streamed_node_of_a_wrong_file_fails_alone(copied):
    name = "gvtorch/blocks/0/c/0/0/0/1/0/0/0/0"
    shutil.copyfile(copied / name.replace("c/0", "c/1", 1), copied / name)
    with gv.Engine(gv.StoredProducer(str(copied))) as engine:
        transfer = gv.TransferFunction.preset("gray", 0, 255)
        for azimuth in (0, 90, 180, 270):
            view = gv.Camera.orbit(azimuth, width=24, height=16, distance=1)
            picture = engine.render(view, transfer, lod="finest")
            assert torch.isfinite(picture.color).all()
        assert {"checksum" in failure.message for failure in engine.failures} == {True}
        assert all(
            failure.loc[3] == engine.trees["scene"].tree.depth for failure in engine.failures
        )
