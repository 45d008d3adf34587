"""Arrays of other libraries: read, converted part by part, built into trees, rendered."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from helpers import Library
from helpers.stores import noise

import gvtorch as gv
from gvtorch.io.reading import ObjectSource, open_source
from gvtorch.io.stores import conversion_plan
from gvtorch.io.stores.conversion import convert

xarray = Library("xarray")
dask = Library("dask.array")
zarr = Library("zarr")


@pytest.fixture
def grid() -> np.ndarray:
    return noise((7, 9, 12), "int16")


class Own:
    """Any object that offers `__array__`."""

    def __init__(self, data: np.ndarray) -> None:
        self.data = data

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return self.data


class Interface:
    def __init__(self, data: np.ndarray) -> None:
        self.__array_interface__ = data.__array_interface__
        self.kept = data


def labelled(grid) -> xarray.DataArray:
    coords = {
        "z": ("z", 5 + 2.0 * np.arange(7), {"units": "um"}),
        "y": ("y", -3.0 * np.arange(9), {"units": "um"}),
        "x": ("x", 500.0 * np.arange(12), {"units": "nm"}),
        "channel": ["a", "b"],
    }
    data = np.stack((grid, grid + 1))
    return xarray.DataArray(data, coords, ("channel", "z", "y", "x"), "cells", {"units": "HU"})


@pytest.mark.parametrize(
    "make",
    [
        Own,
        Interface,
        np.asfortranarray,
        torch.from_numpy,
        lambda grid: dask.from_array(grid, chunks=(4, 4, 4)),
        lambda grid: zarr.array(grid, chunks=(4, 4, 4)),
        lambda grid: xarray.DataArray(data=grid),
        lambda grid: grid.astype(">i2"),
    ],
    ids=["array", "interface", "fortran", "torch", "dask", "zarr", "xarray", "swapped"],
)
def test_any_array_is_a_volume(tmp_path, grid, make):
    array = make(grid)
    for volume in (gv.as_volume(array), gv.read_volume(array)):
        assert np.array_equal(volume.data[..., 0].numpy(), grid)
    store = convert(array, tmp_path / "a.zarr", spacing=(1, 2, 3))
    assert store.spacing == (1, 2, 3)
    assert np.array_equal(store.read_region(0, (0, 0, 0), grid.shape)[..., 0], grid)


def test_names_places_and_units_of_xarray(grid):
    for volume in (gv.as_volume(labelled(grid)), gv.read_volume(labelled(grid))):
        assert volume.data.shape == (7, 9, 12, 2) and volume.name == "cells"
        assert (
            volume.spacing == pytest.approx((500, 3000, 2000)) and volume.info.unit == "nanometer"
        )
        assert volume.origin == pytest.approx((0, -24000, 5000))
        assert np.array_equal(volume.data[..., 1].numpy(), grid[:, ::-1] + 1)
        assert [c.name for c in volume.info.channels] == ["a", "b"]
        assert volume.info.quantity == "HU"
    with pytest.raises(ValueError, match="is a set of arrays, take one of them: cells"):
        gv.as_volume(labelled(grid).to_dataset())


@pytest.mark.parametrize("option", [{"axes": "zyx"}, {"time": 1}, {"spacing": (1, 1, 2)}])
def test_a_volume_is_returned_as_it_is_or_refused(option):
    volume = gv.Volume(np.zeros((3, 4, 5), np.float32), (2, 2, 2))
    assert gv.as_volume(volume, time=0, nan=0.0) is volume
    with pytest.raises(ValueError, match=f"as_volume: {next(iter(option))} is for arrays; a Vol"):
        gv.as_volume(volume, **option)


def test_dask_computes_what_is_asked_for(tmp_path):
    requested: list[tuple[int, ...]] = []

    def block(block_info=None):
        low = [start for start, _ in block_info[None]["array-location"]]
        requested.append(tuple(low))
        return np.full((16, 16, 16), sum(low), "int16")

    lazy = dask.map_blocks(block, chunks=((16,) * 4,) * 3, dtype="int16")
    source = open_source(lazy)
    assert isinstance(source, ObjectSource) and not requested
    part = source.read_region((0, 17, 33), (16, 20, 40))
    assert requested == [(0, 16, 32)] and (part == 48).all()
    assert pickle.loads(pickle.dumps(open_source(zarr.zeros((3, 4, 5))))).extent == (5, 4, 3)


def test_lazy_arrays_convert_part_by_part(tmp_path, monkeypatch):
    data = noise((4, 150, 270), "uint16")
    lazy = xarray.DataArray(dask.from_array(data, chunks=64), dims=("z", "y", "x"))
    assert isinstance(open_source(lazy), ObjectSource)
    store = convert(lazy, tmp_path / "a.zarr", workers=1)
    assert np.array_equal(store.read_region(0, (0, 0, 0), data.shape)[..., 0], data)
    monkeypatch.setattr(conversion_plan, "_FEW_TASKS", 1)  # in processes
    store = convert(zarr.array(data), tmp_path / "b.zarr", workers=2)
    assert np.array_equal(store.read_region(0, (0, 0, 0), data.shape)[..., 0], data)


def test_memory_maps_are_mapped_again(tmp_path, grid):
    np.save(tmp_path / "a.npy", grid)
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    source = pickle.loads(pickle.dumps(open_source(mapped)))
    assert len(pickle.dumps(source)) < 2000 and source.file == str(tmp_path / "a.npy")
    assert np.array_equal(source.read_region((1, 2, 3), (4, 5, 6))[..., 0], grid[1:4, 2:5, 3:6])
    view = mapped[2:]
    assert np.array_equal(gv.read_volume(view).data[..., 0].numpy(), grid[2:])
    changed = np.load(tmp_path / "a.npy", mmap_mode="c")  # changes do not reach the file
    changed[:] = 7
    assert (gv.read_volume(changed).data == 7).all()


@pytest.mark.parametrize("make", [np.asarray, torch.as_tensor, Own, np.asfortranarray])
def test_wide_labels_of_arrays_are_kept_at_any_time(tmp_path, make):
    series = (1 << 40) + np.arange(3 * 4 * 5 * 6).reshape(3, 4, 5, 6) % 7
    given = make(series)
    with pytest.raises(ValueError, match=r"array: int64 values reach 1099511627782.*labels=True"):
        gv.read_volume(given, axes="tzyx", time=0)
    with pytest.raises(ValueError, match=r"array: int64 values reach 1099511627782.*labels=True"):
        convert(given, tmp_path / "a.zarr", axes="tzyx", workers=1)
    assert not (tmp_path / "a.zarr").exists()
    store = convert(given, tmp_path / "a.zarr", axes="tzyx", labels=True, workers=1)
    assert store.times == 3
    for time in (0, 2):
        read = gv.read_volume(given, axes="tzyx", time=time, labels=True)
        stored = gv.read_volume(tmp_path / "a.zarr", time=time)
        for volume in (read, stored):
            values = volume.label_values[volume.data[..., 0].long()]
            assert np.array_equal(values.numpy(), series[time])


def test_dates_of_xarray_are_times(grid):
    dates = np.datetime64("2026-11-30") + np.timedelta64(90, "m") * np.arange(3)
    axes = ("time", "z", "y", "x")
    series = xarray.DataArray(np.stack([grid] * 3), dims=axes, coords={"time": dates})
    for times in (dates, dates - dates[0]):
        info = gv.as_volume(series.assign_coords(time=times), time=1).info
        assert (info.time_step, info.time_unit, info.time_origin) == (5400, "second", 0)


def test_times_and_axes_are_asked_about(grid):
    four = np.stack([grid] * 3)
    with pytest.raises(ValueError, match=r"what are the axes of shape \(3, 7, 9, 12\)"):
        gv.as_volume(four)
    with pytest.warns(UserWarning, match="3 time points, this is the first"):
        gv.as_volume(four, axes="tzyx")
    assert gv.as_volume(four, axes="czyx").data.shape == (7, 9, 12, 3)
    assert gv.as_volume(grid[0], axes="yx").extent == (12, 9, 1)
    named = xarray.DataArray(four, dims=("time", "z", "y", "x"))
    assert np.array_equal(gv.as_volume(named, time=2).data[..., 0].numpy(), grid)


def test_options_of_arrays_are_not_for_volumes(tmp_path, grid):
    """A volume has its axes; before, they were ignored."""
    assert np.array_equal(gv.read_volume(gv.Volume(grid)).data[..., 0].numpy(), grid)
    with pytest.raises(ValueError, match=r"axes is for .* files, this is an array"):
        gv.read_volume(gv.Volume(grid), axes="xyz")
    with pytest.raises(ValueError, match="axes is for files and arrays, not for volumes"):
        convert(gv.Volume(grid), tmp_path / "a.zarr", axes="xyz")


@pytest.mark.parametrize("array", [None, "words", [1, 2], object(), {"a": 1}])
def test_what_is_no_array_is_named(array):
    with pytest.raises(ValueError, match=r"as_volume \(\w+\): expected a volume"):
        gv.as_volume(array)


def test_objects_and_words_are_refused():
    for data in (np.array([[["a"]]]), np.array([[[{}]]]), np.zeros((2, 2, 2), complex)):
        with pytest.raises(ValueError, match="must hold real numbers"):
            gv.as_volume(data)


def test_arrays_are_rendered(grid):
    camera = gv.Camera.orbit(30, 20, width=24, height=16)
    shader = gv.TransferFunction.preset("gray", *map(float, (grid.min(), grid.max())))
    tree = gv.N3Tree.from_volume(gv.Volume(grid))
    expected = gv.render(tree, camera, shader)
    for array in (grid, gv.Volume(grid), Own(grid), dask.from_array(grid)):
        picture = gv.render(array, camera, shader)
        assert torch.equal(picture.color, expected.color) and picture.alpha.max() > 0
    assert gv.N3Tree.from_volume({"a": grid, "b": gv.Volume(grid)}).bricks.channels.keys() == {
        "a",
        "b",
    }


def test_masked_values_are_not_there():
    data = np.arange(60).reshape(3, 4, 5)
    gaps = data % 7 == 0
    for dtype in ("u1", "f4", "f8", ">i2"):
        masked = np.ma.MaskedArray(data.astype(dtype), gaps)
        volume = gv.as_volume(masked, nan=-1)
        assert np.array_equal(volume.data[..., 0].numpy(), np.where(gaps, -1, data))
        with pytest.raises(ValueError, match="9 values that are NaN"):
            gv.as_volume(masked)
    nothing = gv.as_volume(np.ma.MaskedArray(data.astype("u1"), np.zeros_like(gaps)))
    assert nothing.data.numpy().dtype == np.uint8
    with pytest.raises(ValueError, match="int64 values reach 100000059"):
        gv.as_volume(np.ma.MaskedArray(data + 10**8, gaps), nan=0)
    with pytest.raises(ValueError, match="masked arrays: fill them first"):
        gv.as_volume(dask.from_array(masked, chunks=2), axes="zyx")
