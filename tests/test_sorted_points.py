"""Points on disk: sorted with little memory, equal to points in memory, complete or absent."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

import gvtorch as gv
from gvtorch.points import sorted as sorting
from gvtorch.points.points import Points
from gvtorch.points.splat import Cubes, ranges, region, values
from gvtorch.points.table import Runs, grouped

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def cloud(count: int = 30_000, wide: bool = True) -> Points:
    random = np.random.default_rng(5)
    positions = np.clip(random.normal(0, 0.3, (count, 3)), -0.99, 0.99).astype(np.float32)
    positions[: count // 8] = 0.25  # thousands in one voxel
    radius = random.choice([0, 0.01, 0.1], count).astype(np.float32) if wide else None
    return Points(positions, random.uniform(-0.2, 1, (count, 2)).astype(np.float32), radius=radius)


@pytest.mark.parametrize(("branching", "wide"), [(2, False), (3, False), (3, True)])
def test_points_on_disk_are_those_in_memory(tmp_path, wide, branching):
    points = cloud(wide=wide)
    options = {"extent": 96, "box": BOX, "branching": branching}
    memory = gv.sort_points(points, **options)
    disk = gv.sort_points(points, **options, folder=tmp_path / "a.points", memory="2 MB")
    assert len(disk) == len(memory) == 30_000
    random = np.random.default_rng(1)
    for level in range(memory.grid.levels):
        low = random.integers(-9, 96 // branching**level, (40, 3))
        first, second = (values(source, Cubes(low, 10, level)) for source in (memory, disk))
        assert np.allclose(first, second, rtol=1e-12, atol=1e-12)
        for a, b in zip(
            *(ranges(first, Cubes(low, 10, level)) for first in (memory, disk)), strict=True
        ):
            assert np.allclose(a, b, rtol=1e-5)
    whole = region(disk, (3, 0, 5), (90, 96, 77))
    part = region(disk, (30, 11, 40), (50, 12, 60))
    assert np.allclose(whole[27:47, 11:12, 35:55], part, rtol=1e-12, atol=1e-15)


def test_the_folder_is_there_when_all_is_done_and_not_before(tmp_path, monkeypatch):
    target = tmp_path / "a.points"

    def interrupted(self):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(sorting._Sorter, "add_up", interrupted)
        gv.sort_points(cloud(), folder=target)
    assert not list(tmp_path.iterdir()), "nothing is left"
    result = gv.sort_points(cloud(), folder=target)
    assert [path.name for path in tmp_path.iterdir()] == ["a.points"]
    with pytest.raises(FileExistsError, match="is there already"):
        gv.sort_points(cloud(), folder=target)
    again = gv.SortedPoints.open(target)
    assert repr(again) == repr(result) and "30000" in repr(again)


@pytest.mark.parametrize("damage", range(6))
def test_a_damaged_folder_is_named(tmp_path, damage):
    target = tmp_path / "a.points"
    gv.sort_points(cloud(2000), folder=target)
    meta = target / "points.json"
    if damage == 0:
        (target / "points_0.value").write_bytes(b"1234")
    elif damage == 1:
        (target / "points_0.code").unlink()
    elif damage == 2:
        meta.write_text("{")
    elif damage == 3:
        meta.write_text("[1]")
    else:
        metadata = json.loads(meta.read_text())
        metadata["grid"]["extent"], metadata["width"] = [[2**40] * 3, [0, 1, 1]][damage - 4], "x"
        meta.write_text(json.dumps(metadata))
    with pytest.raises(ValueError) as caught:
        gv.PointProducer(target)
    assert str(target) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("column", "kind"),
    [("code", ["|O", []]), ("code", ["<f8", []]), ("position", ["<f8", [1, 3]]), ("value", None)],
)
def test_a_folder_of_other_columns_is_refused(tmp_path, column, kind):
    """Objects of Python once ended the process."""
    target = tmp_path / "a.points"
    gv.sort_points(cloud(2000), folder=target)
    metadata = json.loads((target / "points.json").read_text())
    kinds = metadata["points"]["0"]["kinds"]
    kinds.pop(column)
    kinds.update({} if kind is None else {column: kind})
    (target / "points.json").write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match=f"no sorted points: .*column '{column}'"):
        gv.PointProducer(target)


def test_a_folder_makes_the_picture_of_its_points(tmp_path):
    points = cloud(4000)
    gv.sort_points(points, 64, box=BOX, folder=tmp_path / "a.points")
    shader = gv.Projection("maximum", gv.TransferFunction.preset("gray", 0, 1))
    pictures = []
    for producer in (
        gv.PointProducer(points, extent=64, box=BOX),
        gv.PointProducer(tmp_path / "a.points"),
    ):
        with gv.Engine(producer, brick_pool="4 MB") as engine:
            pictures.append(engine.render(gv.Camera.orbit(width=48, height=40), shader).color)
    assert torch.equal(*pictures) and pictures[0].std() > 0.05
    with pytest.raises(ValueError, match="have an extent, a box and N already"):
        gv.PointProducer(tmp_path / "a.points", extent=64)


def test_runs_are_merged_in_order():
    random = np.random.default_rng(2)
    runs = Runs(None, "runs", 50)
    code = random.integers(0, 40, 1000)
    code[300:700] = 7  # more than a block
    for part in np.split(code, 20):
        runs.append({"code": part, "value": np.ones(len(part))})
    blocks = list(runs.sorted())
    assert np.array_equal(np.concatenate([block["code"] for block in blocks]), np.sort(code))
    total = list(grouped(iter(blocks), {"value": np.add.reduceat}, 3))
    sums = np.zeros(14)
    for rows in total:
        sums[rows["code"]] += rows["value"]
    assert np.array_equal(sums, np.bincount(code // 3, minlength=14))
    assert sum(len(rows["code"]) for rows in total) == len(np.unique(code // 3))


_CHILD = """
import resource, sys
import numpy as np
import gvtorch as gv
from gvtorch.points.splat import Cubes, values
COUNT = 10_000_000

class Source:
    def __len__(self):
        return COUNT
    def blocks(self, count):
        count = min(count, 250_000)
        for start in range(0, COUNT, count):
            random = np.random.default_rng(start)
            n = min(count, COUNT - start)
            yield gv.Points(random.random((n, 3), np.float32), np.ones((n, 1), np.float32))

gv.Engine  # the libraries are there from now on
gv.sort_points(gv.Points(np.zeros((9, 3))))
told = open("/proc/self/status").read()
used = int(told.split("VmData:")[1].split()[0]) * 1024
resource.setrlimit(resource.RLIMIT_DATA, (used + (160 << 20),) * 2)
try:
    np.ones(200 << 20, np.uint8)
    print("there is no limit")
except MemoryError:
    pass
box = ((0, 0, 0), (1, 1, 1))
made = gv.sort_points(Source(), 2048, box=box, folder=sys.argv[1], memory="48 MB")
root = values(made, Cubes(np.zeros((1, 3), int), 1, made.grid.levels - 1))
print(len(made), root.sum() * 8 ** (made.grid.levels - 1))
"""


@pytest.mark.long
def test_ten_million_points_are_sorted_in_little_memory(tmp_path):
    command = [sys.executable, "-c", _CHILD, str(tmp_path / "a.points")]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert run.stdout.split() == ["10000000", "10000000.0"], run.stderr[-2000:]
    size = sum(file.stat().st_size for file in (tmp_path / "a.points").iterdir())
    assert size > 200 << 20, "more than the memory that it had"
