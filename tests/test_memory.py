"""Memory budgets hold: of pools with all their bookkeeping, and of conversions."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers import gvtorch
from helpers.stores import noise

import gvtorch as gv
from gvtorch.engine import setup
from gvtorch.io import resources
from gvtorch.io.reading import open_source
from gvtorch.io.stores import conversion


@pytest.mark.parametrize("channels", ["value", "both"])
@pytest.mark.parametrize("branching", [2, 3])
def test_the_bookkeeping_is_what_was_counted(blobs, channels, branching, monkeypatch):
    volumes = {"value": blobs} if channels == "value" else {"value": blobs, "other": blobs}
    producer = gv.VolumeProducer(volumes)
    producer.branching = branching
    counted = []
    original = setup._check_memory
    monkeypatch.setattr(setup, "memory_free", lambda: 0)
    with pytest.raises(ValueError, match=r"Engine: node_pool .*, their bookkeeping .* has 0\.0 kB"):
        gv.Engine(producer, brick_pool="4 MB", node_pool="1 MB")
    monkeypatch.undo()

    def count(parts, cache_nbytes, device):
        counted.append({name.removeprefix("their "): size for name, size in parts.items()})
        original(parts, cache_nbytes, device)

    monkeypatch.setattr(setup, "_check_memory", count)
    with gv.Engine(producer, brick_pool="4 MB", node_pool="1 MB") as engine:
        for name, size in engine.memory().items():
            assert counted[0][name] == pytest.approx(size, rel=1e-3), name


def test_host_caches_count_as_well(tmp_path, monkeypatch):
    gv.convert(gv.Volume(noise((9, 9, 9, 1))), tmp_path / "a.zarr", workers=1)
    monkeypatch.setattr(setup, "memory_free", lambda: 10**9)
    pools = {"brick_pool": "4 MB", "node_pool": "1 MB"}
    with gv.Engine(gv.StoredProducer(tmp_path / "a.zarr", host_cache="900 MB"), **pools):
        pass
    with pytest.raises(ValueError, match=r"host caches 996\.0 MB take .* cpu has 1\.00 GB free"):
        gv.Engine(gv.StoredProducer(tmp_path / "a.zarr", host_cache="996 MB"), **pools)


def planned(monkeypatch, source, target, **options) -> int:
    """Returns the number of workers that a conversion would use."""
    plans = []

    def stop(_target, _needs):
        raise ZeroDivisionError

    def estimate(plan):
        plans.append(plan)

    monkeypatch.setattr(conversion, "estimate_of", estimate)
    monkeypatch.setattr(conversion, "check_room", stop)
    with pytest.raises(ZeroDivisionError):
        gv.convert(source, target, **options)
    return plans[0].workers


def test_workers_follow_memory(tmp_path, monkeypatch):
    file = tmp_path / "a_600x600x600_uint8.raw"
    with file.open("wb") as sparse:
        sparse.truncate(600**3)
    target = tmp_path / "a.zarr"
    monkeypatch.setattr(conversion.resources, "cores", lambda: 16)
    monkeypatch.setattr(conversion.resources, "memory_free", lambda: 64 * 10**9)
    assert planned(monkeypatch, file, target) == 16
    assert planned(monkeypatch, file, target, memory="8 GB") == 12
    assert planned(monkeypatch, file, target, memory="2 GB", workers=4) == 2
    assert planned(monkeypatch, file, target, memory="8 GB", workers=4) == 4
    with pytest.raises(ValueError, match=r"memory of 500\.0 MB is too little"):
        gv.convert(file, target, memory="500 MB")
    monkeypatch.setattr(conversion.resources, "memory_free", lambda: 3 * 10**9)
    assert planned(monkeypatch, file, target) == 4
    assert not target.exists()
    run = gvtorch("convert", file, target, "--memory", "1 MB")
    assert run.returncode == 2 and "memory of 1.0 MB is too little" in run.stderr, run.stderr


def test_pages_of_a_tiff_count(tmp_path):
    import tifffile

    data = np.zeros((5, 64, 32), np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", data, compression="zlib", rowsperstrip=64)
    tifffile.imwrite(tmp_path / "b.tif", data, compression="zlib", rowsperstrip=8)
    assert open_source(tmp_path / "a.tif").unpacked_bytes == 64 * 32 * 2
    assert open_source(tmp_path / "b.tif").unpacked_bytes == 8 * 32 * 2


@pytest.mark.parametrize("given", [{}, {"GOMP_SPINCOUNT": "7"}, {"OMP_WAIT_POLICY": "active"}])
def test_threads_of_openmp_sleep_soon_unless_the_user_tells_otherwise(given):
    code = "import gvtorch, os; print(os.environ.get('GOMP_SPINCOUNT'))"
    env = {n: v for n, v in os.environ.items() if n not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    run = subprocess.run(
        [sys.executable, "-c", code], env=env | given, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == given.get("GOMP_SPINCOUNT", "None" if given else "2000")
    assert torch.get_num_threads() >= 1


@pytest.mark.parametrize(
    ("cgroup", "group", "files", "left"),
    [
        ("0::/", "", "v2", 3000),
        ("0::/pod/job", "pod", "v2", 3000),
        ("0::/a/../b", "none", "v2", None),
        ("3:cpu:/\n4:memory,hugetlb:/docker/1\n0::/", "memory", "v1", 3000),
        ("3:cpu:/docker/1", "memory", "v1", None),
        ("0::/", "", "unlimited", None),
    ],
)
def test_a_container_has_the_memory_that_its_limit_leaves(
    tmp_path, monkeypatch, cgroup, group, files, left
):
    """Its group may be the one that it is in, one above, or the root of what it sees."""
    proc, groups = tmp_path / "proc", tmp_path / "groups"
    (proc / "self").mkdir(parents=True)
    (groups / group).mkdir(parents=True)
    (proc / "meminfo").write_text("MemTotal: 99 kB\nMemAvailable: 9 kB\n")
    (proc / "self/cgroup").write_text(cgroup + "\n")
    limit, usage, prefix = resources._GROUP_V1 if files == "v1" else resources._GROUP_V2
    (groups / group / limit).write_text("max\n" if files == "unlimited" else "8000\n")
    (groups / group / usage).write_text("7000\n")
    stat = f"{prefix}inactive_file 1500\n{prefix}active_file 500\nanon 5000\ninactive_file_x 9\n"
    (groups / group / "memory.stat").write_text(stat)
    monkeypatch.setattr(resources, "_PROC", proc)
    monkeypatch.setattr(resources, "_CGROUPS", groups)
    assert resources.memory_free() == (9 * 1024 if left is None else left)
