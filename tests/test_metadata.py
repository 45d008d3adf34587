"""Units, channels, shapes and what is told beside: from files of other libraries into `ImageInfo`,
into stores, and back; and what is not kept is named in a line.
"""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.stores import noise, write_foreign
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base.image_info import ChannelInfo, ImageInfo
from gvtorch.io.conversion import convert
from gvtorch.io.store import Store
from gvtorch.tools.cli import main


def read(path: Path, **options) -> tuple[gv.Volume, list[str]]:
    """A volume, and the lines that reading it told."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        volume = gv.read_volume(path, **options)
    return volume, [str(one.message) for one in told]


# --- NIfTI


@pytest.mark.parametrize(
    ("units", "expected"),
    [
        (("mm", "sec"), ("millimeter", "second")),
        (("micron", "msec"), ("micrometer", "millisecond")),
        (("meter", "usec"), ("meter", "microsecond")),
        (("unknown", "unknown"), (None, None)),
    ],
)
def test_units_of_nifti(tmp_path, units, expected):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.zeros((4, 5, 6, 2), np.uint8), np.diag([2, 3, 4, 1]))
    image.header.set_xyzt_units(*units)
    image.header["pixdim"][4] = 1.5
    nibabel.save(image, tmp_path / "a.nii")
    volume, told = read(tmp_path / "a.nii", time=1)
    assert (volume.info.unit, volume.info.time_unit) == expected and not told
    assert volume.info.time_step == 1.5 and volume.info.space == "right-anterior-superior"
    assert volume.describe().get("unit") == expected[0]


def test_simpleitk_writes_nifti_that_comes_back(tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    data = np.random.default_rng(0).integers(-99, 99, (5, 6, 7)).astype(np.int16)
    image = sitk.GetImageFromArray(data)
    image.SetSpacing((0.5, 1.5, 2.5))
    image.SetOrigin((10, 20, 30))
    for ending in ("nii", "nii.gz", "nrrd"):
        sitk.WriteImage(image, str(tmp_path / f"a.{ending}"))
        volume, told = read(tmp_path / f"a.{ending}")
        assert not told and volume.spacing == (0.5, 1.5, 2.5)
        found = volume.data[..., 0].numpy()
        if ending == "nrrd":  # in the file's own space
            assert volume.info.space == "left-posterior-superior"
            assert volume.origin == (10, 20, 30) and np.array_equal(found, data)
        else:  # x right, y anterior: both run the other way
            assert volume.info.unit == "millimeter"
            assert volume.origin == (-10 - 6 * 0.5, -20 - 5 * 1.5, 30)
            assert np.array_equal(found, data[:, ::-1, ::-1])
    moving = sitk.JoinSeries([image, image + 7], 0.0, 4.0)
    sitk.WriteImage(moving, str(tmp_path / "t.nii"))
    volume, _ = read(tmp_path / "t.nii", time=1)
    assert np.array_equal(volume.data[..., 0].numpy(), (data + 7)[:, ::-1, ::-1])
    assert volume.info.time_step == 4.0
    vector = sitk.Compose(image, image + 1, image + 2)
    for ending in ("nii", "nrrd"):
        sitk.WriteImage(vector, str(tmp_path / f"v.{ending}"))
        volume, _ = read(tmp_path / f"v.{ending}")
        turned = data if ending == "nrrd" else data[:, ::-1, ::-1]
        expected = np.stack([turned, turned + 1, turned + 2], -1)
        assert np.array_equal(volume.data.numpy(), expected)


def test_what_a_nifti_header_tells_beside(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.zeros((4, 5, 6), np.int16), np.eye(4))
    image.header["cal_min"], image.header["cal_max"] = -100, 300
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", b"hello"))
    image.set_qform(np.diag([3, 3, 3, 1]), code=1)
    nibabel.save(image, tmp_path / "a.nii")
    volume, told = read(tmp_path / "a.nii")
    assert volume.info.channels == (ChannelInfo(window=(-100, 300)),)
    assert told == [
        f"{tmp_path}/a.nii: not kept: the qform, which differs from the sform; 1 header extensions"
    ]
    content = bytearray((tmp_path / "a.nii").read_bytes())
    content[123] = 7  # xyzt_units
    (tmp_path / "b.nii").write_bytes(content)
    assert "xyzt_units 7, which are none" in read(tmp_path / "b.nii")[1][0]


def test_colours_of_nifti(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    rgb = np.random.default_rng(0).integers(0, 255, (4, 5, 6, 3)).astype(np.uint8)
    kind = np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.save(
        nibabel.Nifti1Image(rgb.view(kind).reshape(4, 5, 6), np.eye(4)), tmp_path / "a.nii.gz"
    )
    volume, _ = read(tmp_path / "a.nii.gz")
    assert np.array_equal(volume.data.numpy(), rgb.transpose(2, 1, 0, 3))
    assert [channel.name for channel in volume.info.channels] == ["red", "green", "blue"]


# --- NRRD


def test_kinds_units_and_space_of_nrrd(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    data = np.arange(2 * 4 * 5 * 6, dtype=np.int16).reshape(2, 4, 5, 6)  # fastest first
    none = np.full(3, np.nan)
    header = {
        "space": "right-anterior-superior",
        "space directions": np.array([none, [2, 0, 0], [0, 3, 0], [0, 0, 4]]),
        "space units": ["um", "um", "um"],
        "kinds": ["vector", "domain", "domain", "domain"],
        "sample units": "HU",
        "modality": "CT",
    }
    nrrd.write(str(tmp_path / "a.nrrd"), data, header)
    volume, told = read(tmp_path / "a.nrrd")
    assert np.array_equal(volume.data.numpy(), data.transpose(3, 2, 1, 0))
    assert volume.spacing == (2, 3, 4) and volume.info.quantity == "HU"
    assert (volume.info.unit, volume.info.space) == ("micrometer", "right-anterior-superior")
    assert told == [f"{tmp_path}/a.nrrd: not kept: key/value pairs modality"]
    header = {
        "kinds": ["domain", "domain", "domain", "time"],
        "spacings": [0.5, 0.6, 0.7, 20],
        "units": ["mm", "mm", "mm", "ms"],
    }
    nrrd.write(str(tmp_path / "t.nrrd"), data, header)
    volume, told = read(tmp_path / "t.nrrd", time=3)
    assert np.array_equal(volume.data[..., 0].numpy(), data[..., 3].T) and not told
    assert volume.spacing == (0.5, 0.6, 0.7) and volume.info.unit == "millimeter"
    assert (volume.info.time_step, volume.info.time_unit) == (20, "millisecond")
    nrrd.write(str(tmp_path / "u.nrrd"), data[0], {"space dimension": 3, "space units": ["a"] * 3})
    assert "units of space a, a, a" in read(tmp_path / "u.nrrd")[1][0]


def test_nrrd_without_kinds_is_asked_about(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    data = np.arange(7 * 6 * 5 * 4, dtype=np.int16).reshape(7, 6, 5, 4)  # fastest first
    nrrd.write(str(tmp_path / "a.nrrd"), data, {"encoding": "raw"})
    with pytest.raises(ValueError, match=r"what are the axes of shape \(4, 5, 6, 7\)"):
        gv.read_volume(tmp_path / "a.nrrd")
    volume, _ = read(tmp_path / "a.nrrd", axes="tzyx", time=2)
    assert np.array_equal(volume.data[..., 0].numpy(), data[..., 2].T)
    volume, _ = read(tmp_path / "a.nrrd", axes="zyxc")
    assert np.array_equal(volume.data.numpy(), data.transpose(3, 2, 1, 0))


def test_nrrd_colours_have_names(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    data = np.zeros((4, 5, 6, 7), np.uint8)
    nrrd.write(str(tmp_path / "a.nrrd"), data, {"kinds": ["RGBA-color", *["domain"] * 3]})
    volume, _ = read(tmp_path / "a.nrrd")
    assert [channel.name for channel in volume.info.channels] == ["red", "green", "blue", "alpha"]


# --- shapes


@pytest.mark.parametrize(
    ("shape", "axes", "extent", "width"),
    [
        ((20, 8, 9), None, (9, 8, 20), 1),
        ((20, 8, 9, 4), None, (9, 8, 20), 4),
        ((20, 8, 9, 64), "zyxc", (9, 8, 20), 64),
        ((3, 7, 8, 9), "czyx", (9, 8, 7), 3),
        ((3, 7, 8, 9), "tzyx", (9, 8, 7), 1),
        ((3, 7, 8, 2), "zyxc", (8, 7, 3), 2),
        ((2, 3, 7, 8, 9), "tczyx", (9, 8, 7), 3),
        ((8, 9), "yx", (9, 8, 1), 1),
        ((9, 8), "xy", (9, 8, 1), 1),
    ],
)
def test_shapes_of_numpy_files(tmp_path, shape, axes, extent, width):
    data = np.random.default_rng(0).integers(0, 99, shape).astype(np.uint8)
    np.save(tmp_path / "a.npy", data)
    np.savez_compressed(tmp_path / "b.npz", data, data)
    for name, options in (("a.npy", {}), ("b.npz", {"key": "arr_1"})):
        volume, _ = read(tmp_path / name, axes=axes, time=0, **options)
        assert volume.extent == extent and volume.data.shape[3] == width
        letters = axes or "zyxc"[: len(shape)]
        place = {"t": 0, "c": width - 1, "z": extent[2] - 1, "y": 3, "x": 2}
        expected = data[tuple(place[letter] for letter in letters)]
        assert volume.data[place["z"], 3, 2, width - 1] == expected


@pytest.mark.parametrize(
    ("shape", "axes", "message"),
    [
        ((3, 7, 8, 9), None, "'zyxc', 'czyx' or 'tzyx'"),
        ((4, 7, 8, 3), None, "'zyxc', 'czyx' or 'tzyx'"),
        ((20, 8, 9, 64), None, r"what are the axes of shape \(20, 8, 9, 64\)\? Tell with axes"),
        ((20, 8, 9, 5), None, "'zyxc'"),
        ((2, 3, 7, 8, 9), None, "'tczyx'"),
        ((8, 9), None, "'yx'"),
        ((8,), None, "expected 2 to 5 axes"),
        ((3, 7, 8, 9), "zyx", "must be 4 letters"),
        ((3, 7, 8, 9), "czzx", "each once"),
        ((3, 7, 8, 9), "czyq", "among t, c, z, y, x"),
        ((3, 7, 8, 9), "tczx", "y and x among them"),
    ],
)
def test_shapes_that_are_not_sure_are_asked_about(tmp_path, shape, axes, message):
    np.save(tmp_path / "a.npy", np.zeros(shape, np.uint8))
    with pytest.raises(ValueError, match=message) as caught:
        gv.read_volume(tmp_path / "a.npy", axes=axes)
    assert "\n" not in str(caught.value) and "a.npy" in str(caught.value)


def test_axes_are_for_arrays_without_names(tmp_path):
    (tmp_path / "a_2x2x2_uint8.raw").write_bytes(bytes(8))
    with pytest.raises(ValueError, match=r"axes is for .*NPY, NPZ, NRRD.* files, this is RAW"):
        gv.read_volume(tmp_path / "a_2x2x2_uint8.raw", axes="zyx")


# --- OME-NGFF


names = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=12)
numbers = st.floats(-1e6, 1e6, width=32)
positive = st.floats(1e-3, 1e3)
bytes_8 = st.integers(0, 255).map(lambda n: n / 255)
channels = st.builds(
    ChannelInfo,
    name=names,
    color=st.none() | st.tuples(bytes_8, bytes_8, bytes_8),
    window=st.none() | st.tuples(numbers, numbers).map(lambda w: (min(w), max(w))),
    active=st.booleans(),
)
lengths = st.sampled_from(["angstrom", "micrometer", "millimeter", "meter", "parsec", "yard"])
infos = st.builds(
    ImageInfo,
    unit=st.none() | lengths,
    channels=st.just(()) | st.lists(channels, min_size=2, max_size=2),
    quantity=st.none() | st.just("HU"),
    space=st.none() | st.just("left-posterior-superior"),
    time_step=positive,
    time_origin=st.floats(-1e3, 1e3),
    time_unit=st.sampled_from(["second", "millisecond", "day"]),
)


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    info=infos,
    times=st.integers(1, 3),
    spacing=st.tuples(positive, positive, positive),
    origin=st.tuples(*[st.floats(-1e4, 1e4)] * 3),
    dtype=st.sampled_from(["uint8", "int16", "float32"]),
)
def test_what_ngff_holds_comes_back(tmp_path, info, times, spacing, origin, dtype):
    """A store, the same converted again, and a volume read from it tell what went in."""
    import yaozarrs

    from gvtorch.io.source import MemorySource

    for name in ("a.zarr", "b.zarr"):
        shutil.rmtree(tmp_path / name, ignore_errors=True)
    data = np.stack([noise((4, 5, 6, 2), dtype, seed=n) for n in range(times)])
    source = MemorySource.of(data, path="a", spacing=spacing, origin=origin, info=info)
    expected = info
    if times == 1:
        expected = ImageInfo(**{**vars(info), "time_step": None, "time_unit": None})
        expected = ImageInfo(**{**vars(expected), "time_origin": 0.0})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gvtorch.io.conversion.open_source", lambda *_, **__: source)
        patch.setattr("gvtorch.io.unfinished.fingerprint", lambda _: [])
        store = convert("a", tmp_path / "a.zarr", workers=1)
    yaozarrs.validate_zarr_store(str(tmp_path / "a.zarr"))
    for found in (store, convert(tmp_path / "a.zarr", tmp_path / "b.zarr", workers=1)):
        assert found.info == expected and not found.lost
        assert found.spacing == spacing and found.origin == origin and found.times == times
        for time in range(times):
            region = Store.open(found.location, time=time).read_region(0, (0, 0, 0), (4, 5, 6))
            assert np.array_equal(region, data[time])
    volume, told = read(tmp_path / "b.zarr", time=times - 1)
    assert volume.info == expected and not told
    assert volume.spacing == spacing and np.array_equal(volume.data.numpy(), data[-1])


OMERO = {
    "id": 1,
    "name": "cells",
    "channels": [
        {
            "label": "DAPI",
            "color": "0000FF",
            "window": {"min": 0, "max": 65535, "start": 200, "end": 1500},
            "active": True,
            "coefficient": 1,
            "family": "linear",
            "inverted": False,
        },
        {
            "label": "GFP",
            "color": "#00ff00",
            "window": {"min": 0, "max": 65535, "start": 10.5, "end": 900},
            "active": False,
        },
    ],
    "rdefs": {"defaultT": 0, "defaultZ": 3, "model": "color"},
}
TOLD = (
    ChannelInfo(name="DAPI", color=(0, 0, 1), window=(200, 1500)),
    ChannelInfo(name="GFP", color=(0, 1, 0), window=(10.5, 900), active=False),
)


def test_an_image_that_yaozarrs_wrote(tmp_path):
    """0.5: five axes with units, `omero`, labels beside it, and several series in a file."""
    from yaozarrs import v05
    from yaozarrs.write.v05 import write_bioformats2raw, write_image

    data = noise((3, 2 * 9, 20, 30), "uint16").reshape(3, 2, 9, 20, 30)
    axes = [
        v05.TimeAxis(name="t", unit="second"),
        v05.ChannelAxis(name="c"),
        *(v05.SpaceAxis(name=name, unit="micrometer") for name in "zyx"),
    ]

    def image(axes: list, scale: list[float], move: list[float]) -> v05.Image:
        transforms = [
            v05.ScaleTransformation(scale=scale),
            v05.TranslationTransformation(translation=move),
        ]
        dataset = v05.Dataset(path="0", coordinateTransformations=transforms)
        scales = v05.Multiscale(name="cells", axes=axes, datasets=[dataset])
        return v05.Image(multiscales=[scales], omero=v05.Omero.model_validate(OMERO))

    whole = image(axes, [30, 1, 2, 0.5, 0.25], [60, 0, 10, 20, 30])
    flat = image(axes[2:], [2, 0.5, 0.25], [0, 0, 0])
    label = v05.LabelImage.model_validate(
        {
            "multiscales": flat.multiscales,
            "image-label": {"colors": [{"label-value": 1, "rgba": [255, 0, 0, 255]}]},
        }
    )
    write_image(tmp_path / "a.zarr", whole, data, labels={"nuclei": (label, data[0, 0])})
    with pytest.warns(UserWarning, match=r"a\.zarr: not kept: the labels labels/nuclei"):
        store = convert(tmp_path / "a.zarr", tmp_path / "b.zarr")
    for found in (Store.open(tmp_path / "a.zarr"), store):
        info = found.info
        assert found.times == 3 and info.channels == TOLD
        assert (info.unit, info.time_unit) == ("micrometer", "second")
        assert (info.time_step, info.time_origin) == (30, 60)
        assert found.spacing == (0.25, 0.5, 2) and found.origin == (30, 20, 10)
    assert Store.open(tmp_path / "a.zarr").lost == ("the labels labels/nuclei",)
    volume, told = read(tmp_path / "b.zarr", time=2)
    assert np.array_equal(volume.data.numpy(), data[2].transpose(1, 2, 3, 0)) and not told
    nuclei = Store.open(tmp_path / "a.zarr", image="labels/nuclei")
    assert nuclei.info.labels and nuclei.lost == ("colors of the labels",)
    series = {name: (image(axes, [1.0] * 5, [0] * 5), data) for name in ("0", "1")}
    write_bioformats2raw(tmp_path / "two.zarr", series)
    assert Store.open(tmp_path / "two.zarr").lost == (
        "the images 1 beside 'cells' (key= or image= names one)",
    )


def test_an_image_that_ome_zarr_models_wrote(tmp_path):
    """0.4 on Zarr v2."""
    import zarr
    from ome_zarr_models.v04 import Image
    from ome_zarr_models.v04.axes import Axis
    from pydantic_zarr.v2 import ArraySpec

    data = noise((2 * 9, 20, 30, 1), "int16")[..., 0].reshape(2, 9, 20, 30)
    made = Image.new(
        array_specs=[ArraySpec.from_array(data, chunks=(1, 9, 16, 16))],
        paths=["full"],
        axes=[
            Axis(name="t", type="time", unit="hour"),
            *(Axis(name=name, type="space", unit="millimeter") for name in "zyx"),
        ],
        scales=[[0.5, 3, 2, 1]],
        translations=[[0, 1, 2, 3]],
        name="heart",
    )
    group = made.to_zarr(zarr.storage.LocalStore(tmp_path / "a"), path="")
    group["full"][...] = data
    store = convert(tmp_path / "a", tmp_path / "b.zarr")
    assert store.spacing == (1, 2, 3) and store.origin == (3, 2, 1) and store.times == 2
    assert (store.info.unit, store.info.time_unit) == ("millimeter", "hour")
    assert store.info.time_step == 0.5
    for time in range(2):
        volume, told = read(tmp_path / "a", time=time)
        assert np.array_equal(volume.data[..., 0].numpy(), data[time]) and not told


def with_omero(folder: Path, omero: object, version: int) -> Path:
    """Two channels, written by zarr-python."""
    data = noise((6, 7, 8, 2), "uint16").transpose(3, 0, 1, 2)
    write_foreign(folder, [data], "czyx", [[1.0] * 4], version=version)
    file = folder / (".zattrs" if version == 2 else "zarr.json")
    content = json.loads(file.read_text())
    (content if version == 2 else content["attributes"]["ome"])["omero"] = omero
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("version", [2, 3])
def test_channels_of_foreign_images(tmp_path, version):
    folder = with_omero(tmp_path / "a", OMERO, version)
    store = Store.open(folder)
    assert store.info.channels == TOLD and not store.lost
    assert Store.open(folder, channels=[1]).info.channels == TOLD[1:]
    volume, told = read(folder)
    assert volume.info.channels == TOLD and not told
    made = convert(folder, tmp_path / "b.zarr")
    assert made.info.channels == TOLD
    attributes = json.loads((tmp_path / "b.zarr/zarr.json").read_text())["attributes"]
    first = attributes["ome"]["omero"]["channels"][0]
    assert (first["label"], first["color"], first["active"]) == ("DAPI", "0000FF", True)
    assert (first["window"]["start"], first["window"]["end"]) == (200, 1500)
    assert made.describe()["channel info"] == {
        "0": "DAPI, #0000ff, 200 to 1500",
        "1": "GFP, #00ff00, 10.5 to 900, not shown at first",
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": "red"}, "color 'red' of channel 0"),
        ({"color": 255}, "color 255 of channel 0"),
        ({"window": {"start": 1}}, "window {'start': 1} of channel 0"),
        ({"window": {"start": 9, "end": 1}}, "of channel 0"),
        ({"window": {"start": float("nan"), "end": 1}}, "of channel 0"),
        ({"window": [0, 1]}, "window [0, 1] of channel 0"),
        ({"inverted": True}, "channel 0 is shown inverted"),
    ],
)
def test_damaged_channels_are_named_and_do_not_keep_it_shut(tmp_path, change, message):
    first, second = OMERO["channels"]
    folder = with_omero(tmp_path / "a", {"channels": [{**first, **change}, second]}, 3)
    volume, (line,) = read(folder)
    assert message in line and "\n" not in line and volume.info.channels[1] == TOLD[1]
    for omero, wanted in (
        ([], "holds no list of channels"),
        ({"channels": [first]}, "what is told of 1 channels, where there are 2"),
    ):
        with_omero(folder, omero, 3)
        volume, (line,) = read(folder)
        assert wanted in line and volume.info.channels == ()


def test_what_lies_beside_an_image_is_named(tmp_path):
    data = noise((6, 7, 8, 1), "uint8")[..., 0]
    several = tmp_path / "several"
    for name in "012":
        write_foreign(several / name, [data + int(name)], "zyx", [[1.0] * 3], version=2, name=name)
    (several / ".zgroup").write_text('{"zarr_format": 2}')
    (several / ".zattrs").write_text('{"bioformats2raw.layout": 3}')
    (several / "OME").mkdir()
    (several / "OME/.zattrs").write_text('{"series": ["0", "1", "2"]}')
    volume, (line,) = read(several)
    assert "not kept: the images 1, 2 beside '0'" in line and volume.data[0, 0, 0] == data[0, 0, 0]
    volume, told = read(several, key="2")
    assert not told and volume.data[0, 0, 0, 0] == data[0, 0, 0] + 2
    assert convert(several, tmp_path / "one.zarr", key="1").info == ImageInfo()
    assert Store.open(tmp_path / "one.zarr").read_region(0, (0,) * 3, (1,) * 3) == data[0, 0, 0] + 1
    labels = write_foreign(tmp_path / "cells", [data], "zyx", [[1.0] * 3])
    write_foreign(labels / "labels/nuclei", [data], "zyx", [[1.0] * 3])
    group = {"zarr_format": 3, "node_type": "group", "attributes": {"ome": {"labels": ["nuclei"]}}}
    (labels / "labels/zarr.json").write_text(json.dumps(group))
    assert "the labels labels/nuclei" in read(labels)[1][0]
    assert read(labels, key="labels/nuclei")[1] == []
    (tmp_path / "plate").mkdir()
    (tmp_path / "plate/.zgroup").write_text('{"zarr_format": 2}')
    (tmp_path / "plate/.zattrs").write_text('{"plate": {}}')
    write_foreign(tmp_path / "plate/A/1/0", [data], "zyx", [[1.0] * 3], version=2)
    with pytest.raises(ValueError, match="it is a plate: name a field of view, as in 'A/1/0'"):
        gv.read_volume(tmp_path / "plate")
    assert read(tmp_path / "plate", key="A/1/0")[0].extent == (8, 7, 6)


def test_axes_and_units_of_other_kinds(tmp_path):
    data = noise((3, 6, 7, 8), "uint8")
    folder = write_foreign(tmp_path / "a", [data], "czyx", [[1.0, 2.0, 3.0, 4.0]])
    file = folder / "zarr.json"
    content = json.loads(file.read_text())
    image = content["attributes"]["ome"]["multiscales"][0]
    image["axes"] = [
        {"name": "angle", "type": "angle"},
        {"name": "z", "type": "space", "unit": "micrometer"},
        {"name": "y", "type": "space", "unit": "nanometer"},
        {"name": "x", "type": "space", "unit": "nanometer"},
    ]
    image["coordinateTransformations"] = [{"type": "rotation", "rotation": []}]
    file.write_text(json.dumps(content))
    volume, (line,) = read(folder)
    assert np.array_equal(volume.data[..., 0].numpy(), data[0])
    assert volume.spacing == (4, 3, 2000) and volume.info.unit == "nanometer"
    assert "an axis that is none of t, c, z, y, x: the first of 3 is read" in line
    assert "a transformation of type 'rotation'" in line
    image["axes"][0] = {"name": "lambda", "type": "channel"}
    image["axes"][1]["unit"] = "parsec"
    file.write_text(json.dumps(content))
    volume, (line,) = read(folder)
    assert volume.data.shape[3] == 3 and volume.spacing == (4, 3, 2)
    assert "unit 'parsec' of z, where that of x is 'nanometer'" in line


def test_the_command_line_tells_and_names_components(tmp_path, capsys):
    folder = with_omero(tmp_path / "a.zarr", OMERO, 3)
    main(["info", str(folder)])
    out = capsys.readouterr().out
    assert "0: DAPI, #0000ff, 200 to 1500" in out
    with pytest.raises(SystemExit):
        main(["render", str(folder), "-o", str(tmp_path / "a.png"), "--component", "2"])
    err = capsys.readouterr().err
    assert err == "gvtorch: error: --component 2: a voxel has 2 numbers: 0 DAPI, 1 GFP\n"
    volume = gv.Volume(torch.zeros(3, 3, 3, 2), info=ImageInfo(channels=TOLD[:1]))
    with pytest.raises(ValueError, match="its info names 1 channels, it has 2"):
        convert(volume, tmp_path / "b.zarr")


# --- damage


def holders(value: object) -> list[tuple[object, object]]:
    """Every place of a JSON value, as what holds it and where."""
    found: list[tuple[object, object]] = []
    places = value.items() if isinstance(value, dict) else enumerate(value)  # type: ignore[arg-type]
    for key, inner in places:
        found.append((value, key))
        if isinstance(inner, (dict, list)):
            found += holders(inner)
    return found


def test_metadata_broken_anywhere_is_one_line(tmp_path):
    """Every value of an image's metadata is replaced by ones that do not belong there."""
    info = ImageInfo(unit="meter", channels=TOLD, time_step=2.0, quantity="HU")
    data = noise((9, 9, 9, 2))
    convert(gv.Volume(data, info=info), tmp_path / "own.zarr")
    foreign = with_omero(tmp_path / "foreign", OMERO, 3)
    refused = opened = 0
    for folder in (tmp_path / "own.zarr", foreign):
        file = folder / "zarr.json"
        whole = file.read_text()
        for number in range(len(holders(json.loads(whole)))):
            for bad in (None, "\u2028\n", -1, [], {}, 1e400, True, [[]], "../.."):
                content = json.loads(whole)
                holder, key = holders(content)[number]
                holder[key] = bad  # type: ignore[index]
                file.write_text(json.dumps(content))
                try:
                    Store.open(folder).describe()
                    opened += 1
                except (ValueError, OSError) as error:
                    assert "\n" not in str(error) and str(folder) in str(error), str(error)
                    refused += 1
        file.write_text(whole)
        assert np.array_equal(
            Store.open(folder).read_region(0, (0,) * 3, (1,) * 3).shape, (1, 1, 1, 2)
        )
    assert refused > 300 and opened > 100


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", ["nii", "nrrd"])
def test_headers_broken_anywhere_are_one_line(tmp_path, ending):
    data = np.arange(3 * 4 * 5, dtype=np.int16).reshape(3, 4, 5)
    whole, broken = tmp_path / f"a.{ending}", tmp_path / f"b.{ending}"
    if ending == "nii":
        nibabel = pytest.importorskip("nibabel")
        nibabel.save(nibabel.Nifti1Image(data, np.diag([1, 2, 3, 1])), whole)
    else:
        nrrd = pytest.importorskip("nrrd")
        header = {"kinds": ["domain"] * 3, "space": "RAS", "space directions": np.eye(3)}
        nrrd.write(str(whole), data, {**header, "encoding": "raw", "space units": ["mm"] * 3})
    content = whole.read_bytes()
    refused = 0
    for place in range(len(content) - data.nbytes):
        for bad in (0x00, 0xFF, 0x39):
            broken.write_bytes(content[:place] + bytes([bad]) + content[place + 1 :])
            try:
                gv.read_volume(broken, nan=0, time=0)
            except ValueError as error:
                assert "\n" not in str(error) and str(broken) in str(error), str(error)
                refused += 1
            except MemoryError:
                pytest.fail(f"byte {place} as {bad} takes memory")
    assert refused > 50
