"""`gvtorch info` describes every volume without an error."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from helpers import gvtorch

import gvtorch as gv


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_the_whole_range_of_a_dtype(dtype):
    data = torch.zeros(3, 4, 5, dtype=dtype)
    info = torch.finfo(dtype)
    data[0, 0, 0], data[1, 1, 1] = info.min, info.max
    facts = gv.Volume(data).describe(bins=7)
    assert facts["histogram"] == [1, 0, 0, 58, 0, 0, 1] and facts["mean"] == 0
    assert facts["range"] == [info.min, info.max]


@pytest.mark.parametrize("value", [0.0, 7.0, -3e30, 1e-30, 65504.0])
def test_flat_data(value):
    facts = gv.Volume(np.full((3, 4, 5), value, np.float32)).describe()
    assert sum(facts["histogram"]) == facts["histogram"][0] == 60
    assert facts["mean"] == pytest.approx(value)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float16", "float32"])
def test_one_label_and_neighbours(dtype):
    data = np.zeros((3, 4, 5), dtype)
    data[1, 2, 3] = 1
    facts = gv.Volume(data).describe()
    assert facts["histogram"][0] == 59 and facts["histogram"][-1] == 1


def test_labels_beyond_int16_are_told():
    data = np.full((2, 3, 4), 40_000, np.uint16)
    data[0] = 0
    assert gv.Volume(data, labels=True).describe()["labels"] == "1, 40000 to 40000"


def test_the_command_tells_it(tmp_path):
    data = np.zeros((3, 4, 5), np.float32)
    data[0, 0, 0], data[1, 1, 1] = -3e38, 3e38
    np.save(tmp_path / "a.npy", data)
    run = gvtorch("info", tmp_path / "a.npy", "--json")
    assert run.returncode == 0 and sum(json.loads(run.stdout)["histogram"]) == 60, run.stderr
