"""Plain Zarr by zarr-python and xarray, N5 by tensorstore; raw files with any ending."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import Library
from helpers import gvtorch as run
from helpers.damage import assert_robust
from helpers.stores import noise

import gvtorch as gv
from gvtorch.io.reading import open_source
from gvtorch.io.stores.conversion import convert

zarr = Library("zarr")
xarray = Library("xarray")
ts = Library("tensorstore")


@pytest.fixture
def grid() -> np.ndarray:
    return noise((7, 9, 12), "int16")


@pytest.mark.parametrize("version", [2, 3])
def test_plain_zarr(tmp_path, grid, version):
    for name in ("a", "b.zarr"):
        array = zarr.create_array(
            str(tmp_path / name),
            shape=grid.shape,
            dtype="i2",
            chunks=(4, 4, 4),
            zarr_format=version,
        )
        array[:] = grid
        source = open_source(tmp_path / name)
        assert not source.whole and source.extent == (12, 9, 7)
        assert np.array_equal(
            source.read_region((1, 2, 3), (5, 4, 11))[..., 0], grid[1:5, 2:4, 3:11]
        )
        store = convert(tmp_path / name, tmp_path / f"{name}.out.zarr")
        assert np.array_equal(store.read_region(0, (0, 0, 0), grid.shape)[..., 0], grid)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.filterwarnings("ignore:.*onsolidated")
def test_zarr_of_xarray(tmp_path, grid, version):
    coords = {
        "z": ("z", 5 + 2.0 * np.arange(7), {"units": "um"}),
        "y": ("y", -3.0 * np.arange(9), {"units": "um"}),
        "x": ("x", 0.5 * np.arange(12), {"units": "um"}),
    }
    data = xarray.Dataset({"v": (("z", "y", "x"), grid), "w": (("z", "y", "x"), grid + 1)}, coords)
    data.to_zarr(tmp_path / "a", zarr_format=version, consolidated=False)
    with pytest.raises(ValueError, match=r"holds 2 arrays, choose one with key .*: v, w"):
        gv.read_volume(tmp_path / "a")
    for volume in (gv.read_volume(tmp_path / "a", key="w"), gv.read_volume(tmp_path / "a" / "w")):
        assert volume.spacing == (0.5, 3, 2) and volume.origin == (0, -24, 5)
        assert volume.info.unit == "micrometer"
        assert np.array_equal(volume.data[..., 0].numpy(), grid[:, ::-1] + 1)
    with pytest.raises(ValueError, match=r"has no array '\.\./b'"):
        gv.read_volume(tmp_path / "a", key="../b")


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("dtype", ["i2", "f4"])
@pytest.mark.filterwarnings("ignore:.*onsolidated")
def test_packed_zarr_of_xarray(tmp_path, version, dtype):
    """Values are scaled, and missing ones are NaN, as xarray reads them."""
    values = np.arange(60, dtype="f4").reshape(3, 4, 5) * 0.5
    values[1, 2, 3] = np.nan
    encoding = {"dtype": dtype, "_FillValue": -7} | (
        {"scale_factor": 0.25, "add_offset": 3.0} if dtype == "i2" else {}
    )
    data = xarray.Dataset({"v": (("z", "y", "x"), values)})
    options = {"zarr_format": version, "consolidated": False, "encoding": {"v": encoding}}
    data.to_zarr(tmp_path / "a", **options)
    actual = open_source(tmp_path / "a").read_region((0, 0, 0), values.shape)[..., 0]
    assert np.array_equal(actual, values, equal_nan=True)
    assert gv.read_volume(tmp_path / "a", nan=-1).data[1, 2, 3, 0] == -1


def n5(folder: Path, grid: np.ndarray, more: dict | None = None) -> Path:
    spec = {"driver": "n5", "kvstore": {"driver": "file", "path": f"{folder}/"}}
    size = {"dimensions": list(grid.shape[::-1]), "blockSize": [4] * grid.ndim}
    spec["metadata"] = {**size, "dataType": grid.dtype.name, "compression": {"type": "gzip"}}
    ts.open(spec, create=True).result().write(grid.T).result()
    if more:
        file = folder / "attributes.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), **more}))
    return folder


@pytest.mark.parametrize(
    "more",
    [
        {"pixelResolution": {"dimensions": [4.0, 5.0, 6.0], "unit": "nm"}, "offset": [1, 2, 3]},
        {"resolution": [4, 5, 6], "units": ["nm"] * 3, "translate": [1, 2, 3]},
        {"transform": {"scale": [6, 5, 4], "translate": [3, 2, 1], "units": ["nm"] * 3}},
    ],
)
def test_n5(tmp_path, grid, more):
    folder = n5(tmp_path / "a.n5" / "em" / "s0", grid, more)
    for path in (folder, tmp_path / "a.n5"):
        source = open_source(path)
        assert source.spacing == (4, 5, 6) and source.origin == (1, 2, 3)
        assert source.info.unit == "nanometer" and not source.whole
        assert np.array_equal(
            source.read_region((1, 2, 3), (5, 4, 11))[..., 0], grid[1:5, 2:4, 3:11]
        )
    n5(tmp_path / "a.n5" / "em" / "s1", grid[:, :, :4])
    with pytest.raises(ValueError, match=r"holds 2 arrays.*: em/s0, em/s1"):
        gv.read_volume(tmp_path / "a.n5")
    assert gv.read_volume(tmp_path / "a.n5", key="em/s1").extent == (4, 9, 7)
    n5(tmp_path / "four", noise((5, 7, 9, 12), "uint8"))
    with pytest.raises(ValueError, match="what are the axes of shape"):
        gv.read_volume(tmp_path / "four")
    assert gv.read_volume(tmp_path / "four", axes="czyx").data.shape == (7, 9, 12, 5)


def test_coarse_n5_lies_over_the_fine_one(tmp_path, grid):
    factors = {"pixelResolution": [4, 5, 6], "offset": [1, 2, 3], "downsamplingFactors": [2, 1, 4]}
    source = open_source(n5(tmp_path / "s1", grid, factors))
    assert source.spacing == (8, 5, 24)
    assert source.origin == (1 + 4 / 2, 2, 3 + 3 * 6 / 2)  # the centre of 2, 1 and 4 fine voxels


def test_hostile_chunks_take_no_memory(tmp_path):
    zarr.create_array(str(tmp_path / "a"), shape=(3000,) * 3, dtype="u1", chunks=(2000,) * 3)
    with pytest.raises(ValueError, match="a chunk takes 8000000000 bytes"):
        open_source(tmp_path / "a")


def test_a_folder_of_nothing_is_named(tmp_path):
    (tmp_path / "a.n5").mkdir()
    with pytest.raises(ValueError, match=r"holds no array of three or more axes"):
        gv.read_volume(tmp_path / "a.n5")


@pytest.mark.parametrize("kind", ["v2", "v3", "n5"])
def test_broken_arrays_give_one_line(tmp_path, grid, kind):
    if kind == "n5":
        assert_robust(n5(tmp_path / "a", grid[:4, :4, :8]), tmp_path / "broken")
        return
    array = zarr.create_array(
        str(tmp_path / "a"),
        shape=grid.shape,
        dtype="i2",
        chunks=(7, 9, 6),
        zarr_format=int(kind[1]),
    )
    array[:] = grid
    assert_robust(tmp_path / "a", tmp_path / "broken", min_refused=8)


# --- raw


@pytest.mark.parametrize("name", ["scan.bin", "x.dat", "noending", "a.vol.7"])
def test_raw_of_any_ending(tmp_path, grid, name):
    file = tmp_path / name
    file.write_bytes(b"head" + grid.tobytes())
    volume = gv.read_volume(file, shape=(12, 9, 7), dtype="<i2", offset=4)
    assert np.array_equal(volume.data[..., 0].numpy(), grid)
    store = convert(file, tmp_path / "a.zarr", shape=(12, 9, 7), dtype="<i2", offset=4)
    assert np.array_equal(store.read_region(0, (0, 0, 0), grid.shape)[..., 0], grid)
    with pytest.raises(ValueError, match="takes 1512 bytes, the file has 1516"):
        gv.read_volume(file, shape=(12, 9, 7), dtype="<i2")
    with pytest.raises(ValueError, match="offset must be an int >= 0, got -1"):
        gv.read_volume(file, shape=(12, 9, 7), dtype="<i2", offset=-1)
    with pytest.raises(ValueError, match=r"shape must be an int >= 0, got 7\.5"):
        gv.read_volume(file, shape=(12, 9, 7.5), dtype="<i2", offset=4)
    with pytest.raises(ValueError, match=r"unknown volume format.*shape and dtype"):
        gv.read_volume(file)


def test_the_command_reads_raw_of_any_ending(tmp_path, grid):
    (tmp_path / "a.bin").write_bytes(grid.tobytes())
    info = run("info", tmp_path / "a.bin", "--shape", "12,9,7", "--dtype", "int16", "--json")
    assert info.returncode == 0 and json.loads(info.stdout)["extent"] == [12, 9, 7], info.stderr
