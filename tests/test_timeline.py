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
    return [e for e in json.loads(path.read_text())["traceEvents"] if e["ph"] == "X"]


def test_times_and_nesting_are_those_of_the_stages(tmp_path):
    path = tmp_path / "t.json"

    def work() -> None:
        with stage("other"):
            time.sleep(0.02)

    with gv.Timeline(path) as trace:
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
    by_name = {e["name"]: e for e in spans(path)}
    assert set(by_name) == {"outer", "inner", "other"}
    for name, least in (("inner", 0.03), ("other", 0.02), ("outer", 0.05)):
        assert by_name[name]["dur"] >= 1e6 * least - 1
    outer, inner = by_name["outer"], by_name["inner"]
    assert outer["ts"] <= inner["ts"]
    assert inner["ts"] + inner["dur"] <= outer["ts"] + outer["dur"] + 1e-3
    assert by_name["other"]["tid"] != outer["tid"] == inner["tid"]
    names = {e["tid"]: e["args"]["name"] for e in content if e["ph"] == "M"}
    assert names[by_name["other"]["tid"]] == "host: reader"
    (count,) = (e for e in content if e["ph"] == "C")
    assert count["args"] == {"loaded": 7} and not stages._timelines


def test_a_timeline_that_is_opened_again_begins_anew(tmp_path):
    path = tmp_path / "t.json"
    trace = gv.Timeline(path)
    for name in ("first", "second"):
        with trace, stage(name):
            with pytest.raises(RuntimeError, match="Timeline: it is open already"):
                trace.__enter__()
            trace.count("bricks", loaded=7)
        (span,) = spans(path)
        assert span["name"] == name and span["ts"] >= 0
    with pytest.raises(ValueError, match="Timeline: path must be a str or PathLike, got int"):
        gv.Timeline(3)


def test_a_trace_is_written_after_a_mistake_too(tmp_path):
    with pytest.raises(ZeroDivisionError), gv.Timeline(tmp_path / "t.json"), stage("broken"):
        raise ZeroDivisionError
    assert [e["name"] for e in spans(tmp_path / "t.json")] == ["broken"]
    with stage("after"):
        pass


@pytest.mark.parametrize(
    ("path", "message"), [("t.txt", "path must end in .json"), ("no/t.json", "folder not found")]
)
def test_bad_paths_are_named(tmp_path, path, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        gv.Timeline(tmp_path / path)


@pytest.mark.backend("cpp")
def test_a_flight_is_traced(scan_store, tmp_path):
    """Every stage occurs as often, and takes as long, as the frames' statistics say."""
    run = gvtorch(
        *("fly", scan_store, "-o", tmp_path / "f", "--frames", "3", "--size", "40x32"),
        *("--backend", "cpp"),  # on CUDA each stage occurs twice
        *("--trace", tmp_path / "t.json", "--stats", tmp_path / "s.jsonl"),
    )
    assert run.returncode == 0, run.stderr
    events = spans(tmp_path / "t.json")
    names = [event["name"] for event in events]
    assert set(names) >= STEPS | {"frame", "save", "read"}
    assert names.count("frame") == names.count("save") == 3
    lines = [json.loads(line)["stages"] for line in (tmp_path / "s.jsonl").read_text().splitlines()]
    for name in ("rays", "trace"):
        milliseconds = sum(event["dur"] for event in events if event["name"] == name) / 1e3
        assert milliseconds == pytest.approx(sum(event[name] for event in lines), rel=0.2, abs=2)
    frames = [event for event in events if event["name"] == "frame"]
    inside = [event for event in events if event["name"] == "trace"]
    for event in inside:
        assert any(f["ts"] <= event["ts"] < f["ts"] + f["dur"] for f in frames)
    readers = {event["tid"] for event in events if event["name"] == "read"}
    assert frames[0]["tid"] not in readers


@pytest.mark.backend("cpp")
def test_pictures_are_the_same_while_traced(blobs, tmp_path):
    shader, camera = gv.TransferFunction.preset("gray", 0, 1), gv.Camera.orbit(width=16, height=12)
    tree = gv.N3Tree.from_volume(blobs)
    plain = gv.render(tree, camera, shader)
    with gv.Timeline(tmp_path / "t.json"):
        traced = gv.render(tree, camera, shader)
    assert torch.equal(plain.color, traced.color) and set(traced.stats.stages) == set(
        plain.stats.stages
    )


def test_ranges_of_nvtx_have_the_stages_names(blobs, monkeypatch):
    """As under NVIDIA's tools, but with a library that only records its calls."""
    calls: list[str] = []

    @contextmanager
    def named(text: str):
        calls.append(f"+{text}")
        yield
        calls.append(f"-{text}")

    monkeypatch.setattr(torch.cuda.nvtx, "range", named)
    with stage("quiet"):
        assert calls == []
    monkeypatch.setattr(stages, "_NVTX_ENABLED", True)
    gv.render(
        gv.N3Tree.from_volume(blobs),
        gv.Camera.orbit(width=4, height=4),
        gv.TransferFunction.preset("gray", 0, 1),
    )
    assert calls[:2] == ["+gvtorch.prepare", "-gvtorch.prepare"]
    assert {"+gvtorch.rays", "+gvtorch.trace", "-gvtorch.trace"} <= set(calls)
    assert len(calls) % 2 == 0


@pytest.mark.backend("cuda")
def test_the_device_has_a_track_of_its_own(blobs, tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("backend cuda: there is no device")
    tree = gv.N3Tree.from_volume(blobs, device="cuda")
    shader, camera = gv.TransferFunction.preset("gray", 0, 1), gv.Camera.orbit(width=64, height=48)
    gv.render(tree, camera, shader)
    with gv.Timeline(tmp_path / "t.json", device="cuda"):
        gv.render(tree, camera, shader)
    traces = [e for e in spans(tmp_path / "t.json") if e["name"] == "trace"]
    assert {e["tid"] == 0 for e in traces} == {True, False}
    assert all(e["ts"] >= 0 and e["dur"] > 0 for e in traces)
