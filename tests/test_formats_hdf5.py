"""HDF5 of h5py, NetCDF of xarray (h5netcdf)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import Library
from helpers.damage import assert_robust
from helpers.stores import noise

import gvtorch as gv
from gvtorch.io.reading import open_source
from gvtorch.io.stores.conversion import convert

h5py = Library("h5py")
xarray = Library("xarray")
Library("h5netcdf")


@pytest.fixture
def grid() -> np.ndarray:
    return noise((7, 9, 12), "int16")


def netcdf(file: Path, grid: np.ndarray, **encoding: object) -> Path:
    coordinates = {
        "depth": ("depth", 10.0 - 2.5 * np.arange(7), {"units": "mm"}),
        "y": ("y", 100 + 3.0 * np.arange(9), {"units": "mm"}),
        "x": ("x", 0.5 * np.arange(12), {"units": "cm"}),
    }
    attributes = {"long_name": "temperature", "units": "K"}
    data = xarray.Dataset({"T": (("depth", "y", "x"), grid, attributes)}, coordinates)
    data.to_netcdf(file, engine="h5netcdf", encoding={"T": encoding})
    return file


def test_hdf5_is_read_by_region(tmp_path, grid):
    file = tmp_path / "a.h5"
    with h5py.File(file, "w") as out:
        out.create_dataset("raw/image", data=grid, chunks=(4, 4, 4), compression="gzip")
        out.create_dataset("table", data=np.zeros((3, 4)))
    for path in (file, f"{file}:/raw/image", f"{file}:/raw"):
        source = open_source(path)
        assert not source.whole
        assert np.array_equal(source.read_times(0, 1)[0, ..., 0], grid)
        part = source.read_region((1, 2, 3), (5, 4, 11))
        assert np.array_equal(part[..., 0], grid[1:5, 2:4, 3:11])
    store = convert(f"{file}:/raw/image", tmp_path / "a.zarr")
    assert np.array_equal(store.read_region(0, (0, 0, 0), grid.shape)[..., 0], grid)


def test_several_sets_are_asked_about(tmp_path, grid):
    file = tmp_path / "a.h5"
    with h5py.File(file, "w") as out:
        out["a"], out["g/b"], out["words"] = grid, grid + 1, "text"
    with pytest.raises(
        ValueError, match=r"2 data sets, choose one with key .*: .*a\.h5:/a .*a\.h5:/g/b \(7"
    ):
        gv.read_volume(file)
    assert np.array_equal(gv.read_volume(file, key="g/b").data[..., 0].numpy(), grid + 1)
    with pytest.raises(ValueError, match="key is given twice, also as 'a'"):
        gv.read_volume(f"{file}:/g/b", key="a")
    with pytest.raises(ValueError, match="no data set '/c'; it holds a, g/b"):
        gv.read_volume(f"{file}:/c")
    with pytest.raises(ValueError, match="words must hold real numbers"):
        gv.read_volume(f"{file}:/words")
    with pytest.raises(FileNotFoundError):
        gv.read_volume(tmp_path / "none.h5:/a")


def test_files_of_a_virtual_data_set_that_are_missing_are_told(tmp_path, grid):
    """HDF5 fills in for them."""
    layout = h5py.VirtualLayout((2, *grid.shape), grid.dtype)
    for number, name in enumerate(("a.h5", "b.h5")):
        with h5py.File(tmp_path / name, "w") as file:
            file["d"] = grid
        layout[number] = h5py.VirtualSource(name, "d", grid.shape)
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file.create_virtual_dataset("d", layout)
    assert open_source(tmp_path / "v.h5", axes="tzyx").dropped == ()
    (tmp_path / "b.h5").unlink()
    with pytest.warns(UserWarning, match=r"not kept: 1 files that are not there, such as b\.h5"):
        volume = gv.read_volume(tmp_path / "v.h5", axes="tzyx", time=0)
    assert np.array_equal(volume.data[..., 0].numpy(), grid)


def test_axes_of_ilastik_and_imagej(tmp_path):
    data = noise((2, 7, 9, 12, 3), "uint8")
    tags = {"axes": [{"key": k, "resolution": r} for k, r in zip("tzyxc", (0, 2, 3, 4, 0))]}  # noqa: B905
    with h5py.File(tmp_path / "a.h5", "w") as out:
        out["exported_data"] = data
        out["exported_data"].attrs["axistags"] = json.dumps(tags)
        out["exported_data"].attrs["channel_names"] = ["a", "b", "c"]
    source = open_source(tmp_path / "a.h5")
    assert (source.axes, source.times, source.spacing) == ("tzyxc", 2, (4, 3, 2))
    assert [c.name for c in source.info.channels] == ["a", "b", "c"]
    with h5py.File(tmp_path / "b.h5", "w") as out:
        out["t0/channel0"] = data[0, ..., 0]
        out["t0/channel0"].attrs["element_size_um"] = [2.0, 0.5, 0.25]
        out["t0/channel0"].attrs["DIMENSION_LABELS"] = ["z", "y", "x"]
    source = open_source(tmp_path / "b.h5")
    assert source.spacing == (0.25, 0.5, 2) and source.info.unit == "micrometer"
    with h5py.File(tmp_path / "c.h5", "w") as out:
        out["d"] = data[0]
        out["e"] = data
    with pytest.raises(ValueError, match=r"what are the axes of shape \(2, 7, 9, 12, 3\)"):
        gv.read_volume(tmp_path / "c.h5", key="e")
    assert open_source(tmp_path / "c.h5", key="e", axes="tzyxc").times == 2


@pytest.mark.parametrize("packed", [False, True])
def test_netcdf_of_xarray(tmp_path, grid, packed):
    encoding = {"zlib": True, "chunksizes": (3, 4, 5)} if packed else {}
    volume = gv.read_volume(netcdf(tmp_path / "a.nc", grid, **encoding))
    assert volume.spacing == pytest.approx((0.5, 0.3, 0.25)) and volume.info.unit == "centimeter"
    assert volume.origin == pytest.approx((0, 10, -0.5))  # depths fall: the last is the lowest
    assert np.array_equal(volume.data[..., 0].numpy(), grid[::-1])
    assert volume.info.quantity == "K" and volume.info.channels[0].name == "temperature"


def test_packed_values_and_missing_ones(tmp_path, grid):
    values = grid.astype("f8") / 4
    values[0, 0, 0] = np.nan
    encoding = {"dtype": "int32", "scale_factor": 0.25, "add_offset": 3.0, "_FillValue": -99999}
    file = netcdf(tmp_path / "a.nc", values, **encoding)
    with pytest.raises(ValueError, match="1 values that are NaN"):
        gv.read_volume(file)
    volume = gv.read_volume(file, nan=-1)
    expected = np.where(np.isnan(values), -1, values)[::-1]
    assert np.array_equal(volume.data[..., 0].numpy(), expected.astype("f4"))


@pytest.mark.parametrize("attributes", [{"positive": "up"}, {"standard_name": "height"}])
def test_heights_are_vertical(tmp_path, grid, attributes):
    coords = {"height": ("height", 10.0 * np.arange(7), attributes | {"units": "m"})}
    axes = ("time", "height", "lat", "lon")
    xarray.Dataset({"v": (axes, grid[None])}, coords).to_netcdf(
        tmp_path / "a.nc", engine="h5netcdf"
    )
    volume = gv.read_volume(tmp_path / "a.nc")
    assert np.array_equal(volume.data[..., 0].numpy(), grid) and volume.spacing[2] == 10


def test_coordinates_may_be_packed(tmp_path, grid):
    """As those of GOES images are: small integers, with a factor and an offset."""
    steps = {"x": 0.25, "y": 2.0, "z": -0.5}
    sizes = dict(zip("zyx", grid.shape, strict=True))
    coords = {name: (name, step * np.arange(sizes[name]) + 3) for name, step in steps.items()}
    data = xarray.Dataset({"v": (("z", "y", "x"), grid)}, coords)
    packing = {"dtype": "i2", "add_offset": 3.0, "_FillValue": -1}
    encoding = {name: {**packing, "scale_factor": step} for name, step in steps.items()}
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf", encoding=encoding)
    data.to_zarr(tmp_path / "a", encoding=encoding, consolidated=False)
    for volume in (gv.read_volume(tmp_path / "a.nc"), gv.read_volume(tmp_path / "a", key="v")):
        assert volume.spacing == (0.25, 2, 0.5)
        assert volume.origin == (3, 3, 3 - 0.5 * (sizes["z"] - 1))
        assert np.array_equal(volume.data[..., 0].numpy(), grid[::-1])


@pytest.mark.parametrize(
    ("attributes", "gaps"),
    [
        ({"missing_value": np.array([3, 250], "u1")}, (3, 250)),
        ({"valid_range": np.array([10, 240], "u1")}, (*range(10), *range(241, 256))),
        ({"valid_min": np.uint8(0), "valid_max": np.uint8(200)}, range(201, 256)),
        ({"valid_max": np.uint8(200), "_FillValue": np.uint8(7)}, (7, *range(201, 256))),
        ({"valid_range": np.array([0, 255], "u1")}, ()),
    ],
)
def test_what_is_valid(tmp_path, attributes, gaps):
    data = np.arange(256, dtype="u1").reshape(4, 8, 8)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("d", data=data).attrs.update(attributes)
    volume = gv.read_volume(tmp_path / "a.h5", axes="zyx", nan=-1)
    expected = np.where(np.isin(data, list(gaps)), -1.0, data)
    assert np.array_equal(volume.data[..., 0].numpy(), expected)
    assert volume.data.numpy().dtype == (np.float32 if len(gaps) else np.uint8)


@pytest.mark.parametrize("scaled", [False, True])
def test_bytes_that_are_told_to_have_no_sign(tmp_path, grid, scaled):
    """As xarray reads them."""
    data = np.arange(-128, 128, dtype="i1").reshape(4, 8, 8)
    attributes = {"scale_factor": 0.5, "_FillValue": np.int8(-1)} if scaled else {}
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file.create_dataset("d", data=data).attrs.update({"_Unsigned": "true", **attributes})
    volume = gv.read_volume(tmp_path / "a.nc", axes="zyx", nan=-9)
    packed = xarray.Variable(tuple("zyx"), data, {"_Unsigned": "true", **attributes})
    peer = xarray.conventions.decode_cf_variable("d", packed)
    assert np.array_equal(volume.data[..., 0].numpy(), peer.fillna(-9).values)
    assert volume.data.max() == (127 if scaled else 255)


def test_a_data_set_that_is_handed_over_tells_that_its_values_are_packed(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("d", data=np.zeros((4, 5, 6), "i2"))
        dataset.attrs.update({"scale_factor": 2.0, "_FillValue": np.int16(0)})
        message = r"not kept: scale_factor, _FillValue: values are taken as they are stored"
        with pytest.warns(UserWarning, match=message):
            gv.as_volume(dataset, axes="zyx")


def test_wide_labels_with_a_value_for_none_stay_apart(tmp_path):
    """float32 would merge them; where they are no labels that is told."""
    labels = np.random.default_rng(3).integers(0, 50, (9, 8, 7)).astype("i4") + 2**25
    labels[0, 0, :2] = -1
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("d", data=labels).attrs["_FillValue"] = np.int32(-1)
    volume = gv.read_volume(tmp_path / "a.h5", axes="zyx", labels=True)
    assert np.array_equal(volume.label_values.numpy()[volume.data[..., 0].int().numpy()], labels)
    gv.convert(tmp_path / "a.h5", tmp_path / "a.zarr", labels=True, axes="zyx", workers=1)
    kept = gv.Store.open(tmp_path / "a.zarr").label_values
    assert np.array_equal(kept.numpy(), np.unique(labels))
    with pytest.raises(ValueError, match="int32 values reach 33554"):
        gv.read_volume(tmp_path / "a.h5", axes="zyx", nan=0)


def test_times_of_netcdf(tmp_path):
    data = noise((4, 3, 5, 6), "float32")
    cube = xarray.DataArray(data, dims=("time", "z", "lat", "lon"), name="v")
    cube["time"] = ("time", np.arange(4) * 6.0, {"units": "hours since 2000-01-01"})
    cube["lat"] = ("lat", 50 - 0.25 * np.arange(5), {"units": "degrees_north"})
    cube.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    source = open_source(tmp_path / "a.nc", time=2)
    assert (source.info.time_step, source.info.time_unit) == (6, "hour")
    assert source.info.unit is None and source.spacing == (1, 0.25, 1)
    assert np.array_equal(source.read_region((0, 0, 0), (3, 5, 6))[..., 0], data[2, :, ::-1])


@pytest.mark.parametrize(
    ("z_unit", "y_unit", "told"),
    [
        ("m", "degrees_north", "units of the axes (degrees_east, degrees_north, m)"),
        ("hPa", "degrees_east", "units of the axes (degrees_east, hPa)"),
        ("degrees", "degrees_north", ""),
        ("m", "km", "units of the axes (degrees_east, km, m)"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_units_that_can_not_be_compared_are_told(tmp_path, z_unit, y_unit, told):
    """The box of degrees and metres is as thin as their numbers say."""
    cube = xarray.DataArray(noise((3, 5, 6), "float32"), dims=("z", "lat", "lon"), name="v")
    for name, unit in (("z", z_unit), ("lat", y_unit), ("lon", "degrees_east")):
        cube[name] = (name, 10.0 * np.arange(cube.sizes[name]), {"units": unit})
    cube.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    source = open_source(tmp_path / "a.nc")
    assert source.spacing == (10, 10, 10) and source.info.unit is None
    assert [note.partition(":")[0] for note in source.dropped] == [told] * bool(told)


def test_classic_netcdf_is_told(tmp_path):
    (tmp_path / "a.nc").write_bytes(b"CDF\1" + bytes(100))
    with pytest.raises(ValueError, match="classic kind; nccopy -k nc4"):
        gv.read_volume(tmp_path / "a.nc")


def test_hostile_chunks_take_no_memory(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as out:
        out.create_dataset("a", (2000, 2000, 2000), "u1", chunks=(1500, 1500, 1500))
    with pytest.raises(ValueError, match="a chunk of a takes 3375000000 bytes"):
        open_source(tmp_path / "a.h5")


@pytest.mark.parametrize("packed", [False, True])
def test_broken_files_give_one_line(tmp_path, grid, packed):
    file = tmp_path / "a.h5"
    with h5py.File(file, "w") as out:
        more = {"chunks": (4, 4, 4), "compression": "gzip", "fletcher32": True} if packed else {}
        out.create_dataset("a", data=grid, **more)
    assert_robust(file, tmp_path / "broken")
    assert_robust(netcdf(tmp_path / "a.nc", grid), tmp_path / "broken2")
