"""Traces for Perfetto and NVTX ranges, which have the stages' names."""

from __future__ import annotations

import json
import threading
import time
from contextlib import contextmanager

import pytest
import torch
from helpers import gvtorch

import gvtorch as gv
from gvtorch.base import stage as stages
from gvtorch.base.stage import stage

STEPS = {"rays", "trace", "requests", "lru", "schedule", "produce", "write"}


def spans(path) -> list[dict]:
    return [one for one in json.loads(path.read_text())["traceEvents"] if one["ph"] == "X"]


def test_times_and_nesting_are_those_of_the_stages(tmp_path):
    path = tmp_path / "t.json"

    def work() -> None:
        with stage("other"):
            time.sleep(0.02)

    with gv.Trace(path) as trace:
        with stage("outer"):
            with stage("inner"):
                time.sleep(0.03)
            thread = threading.Thread(target=work, name="reader")
            thread.start()
            thread.join()
        trace.count("bricks", loaded=7)
    with stage("after"):
        pass
    content = json.loads(path.read_text())["traceEvents"]
    found = {one["name"]: one for one in spans(path)}
    assert set(found) == {"outer", "inner", "other"}
    for name, least in (("inner", 0.03), ("other", 0.02), ("outer", 0.05)):
        assert found[name]["dur"] >= 1e6 * least - 1
    outer, inner = found["outer"], found["inner"]
    assert outer["ts"] <= inner["ts"]
    assert inner["ts"] + inner["dur"] <= outer["ts"] + outer["dur"] + 1e-3
    assert found["other"]["tid"] != outer["tid"] == inner["tid"]
    names = {one["tid"]: one["args"]["name"] for one in content if one["ph"] == "M"}
    assert names[found["other"]["tid"]] == "host: reader"
    (count,) = (one for one in content if one["ph"] == "C")
    assert count["args"] == {"loaded": 7} and not stages._traces


def test_a_trace_is_written_after_a_mistake_too(tmp_path):
    with pytest.raises(ZeroDivisionError), gv.Trace(tmp_path / "t.json"), stage("broken"):
        raise ZeroDivisionError
    assert [one["name"] for one in spans(tmp_path / "t.json")] == ["broken"]
    with stage("after"):
        pass


@pytest.mark.parametrize(
    ("path", "message"), [("t.txt", "path must end in .json"), ("no/t.json", "folder not found")]
)
def test_bad_paths_are_named(tmp_path, path, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        gv.Trace(tmp_path / path)


@pytest.mark.backend("cpp")
def test_a_flight_is_traced(scan_store, tmp_path):
    """Every stage occurs as often, and takes as long, as the frames' statistics say."""
    run = gvtorch(
        *("fly", scan_store, "-o", tmp_path / "f", "--frames", "3", "--size", "40x32"),
        *("--trace", tmp_path / "t.json", "--stats", tmp_path / "s.jsonl"),
    )
    assert run.returncode == 0, run.stderr
    found = spans(tmp_path / "t.json")
    names = [one["name"] for one in found]
    assert set(names) >= STEPS | {"frame", "save", "read"}
    assert names.count("frame") == names.count("save") == 3
    told = [json.loads(line)["stages"] for line in (tmp_path / "s.jsonl").read_text().splitlines()]
    for name in ("rays", "trace"):
        milliseconds = sum(one["dur"] for one in found if one["name"] == name) / 1e3
        assert milliseconds == pytest.approx(sum(one[name] for one in told), rel=0.2, abs=2)
    frames = [one for one in found if one["name"] == "frame"]
    inside = [one for one in found if one["name"] == "trace"]
    for one in inside:
        assert any(f["ts"] <= one["ts"] < f["ts"] + f["dur"] for f in frames)
    readers = {one["tid"] for one in found if one["name"] == "read"}
    assert frames[0]["tid"] not in readers


@pytest.mark.backend("cpp")
def test_pictures_are_the_same_while_traced(blobs, tmp_path):
    shader, camera = gv.TransferFunction.preset("gray", 0, 1), gv.Camera.orbit(width=16, height=12)
    tree = gv.N3Tree.from_volume(blobs)
    plain = gv.render(tree, camera, shader)
    with gv.Trace(tmp_path / "t.json"):
        traced = gv.render(tree, camera, shader)
    assert torch.equal(plain.color, traced.color) and set(traced.stats.stages) == set(
        plain.stats.stages
    )


def test_ranges_of_nvtx_have_the_stages_names(blobs, monkeypatch):
    """As under NVIDIA's tools, but with a library that only records its calls."""
    told: list[str] = []

    @contextmanager
    def named(text: str):
        told.append(f"+{text}")
        yield
        told.append(f"-{text}")

    monkeypatch.setattr(torch.cuda.nvtx, "range", named)
    with stage("quiet"):
        assert told == []
    monkeypatch.setattr(stages, "_NVTX_ENABLED", True)
    gv.render(
        gv.N3Tree.from_volume(blobs),
        gv.Camera.orbit(width=4, height=4),
        gv.TransferFunction.preset("gray", 0, 1),
    )
    assert told[:2] == ["+gvtorch.prepare", "-gvtorch.prepare"]
    assert {"+gvtorch.rays", "+gvtorch.trace", "-gvtorch.trace"} <= set(told)
    assert len(told) % 2 == 0


@pytest.mark.backend("cuda")
def test_the_device_has_a_track_of_its_own(blobs, tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("backend cuda: there is no device")
    tree = gv.N3Tree.from_volume(blobs, device="cuda")
    shader, camera = gv.TransferFunction.preset("gray", 0, 1), gv.Camera.orbit(width=64, height=48)
    gv.render(tree, camera, shader)
    with gv.Trace(tmp_path / "t.json", device="cuda"):
        gv.render(tree, camera, shader)
    traces = [one for one in spans(tmp_path / "t.json") if one["name"] == "trace"]
    assert {one["tid"] == 0 for one in traces} == {True, False}
    assert all(one["ts"] >= 0 and one["dur"] > 0 for one in traces)
