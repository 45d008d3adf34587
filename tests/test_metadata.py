"""Units, channels, shapes and other metadata: from files of other libraries into `ImageInfo`, into
stores, and back; what is not kept is named in a line.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers.stores import read_with_warnings

import gvtorch as gv
from gvtorch.base.image_info import ChannelInfo

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
    volume, warned = read_with_warnings(tmp_path / "a.nii", time=1)
    assert (volume.info.unit, volume.info.time_unit) == expected and not warned
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
        volume, warned = read_with_warnings(tmp_path / f"a.{ending}")
        assert not warned and volume.spacing == (0.5, 1.5, 2.5)
        actual = volume.data[..., 0].numpy()
        if ending == "nrrd":  # in the file's space
            assert volume.info.space == "left-posterior-superior"
            assert volume.origin == (10, 20, 30) and np.array_equal(actual, data)
        else:  # x right, y anterior: both have the opposite sign
            assert volume.info.unit == "millimeter"
            assert volume.origin == (-10 - 6 * 0.5, -20 - 5 * 1.5, 30)
            assert np.array_equal(actual, data[:, ::-1, ::-1])
    moving = sitk.JoinSeries([image, image + 7], 0.0, 4.0)
    sitk.WriteImage(moving, str(tmp_path / "t.nii"))
    volume, _ = read_with_warnings(tmp_path / "t.nii", time=1)
    assert np.array_equal(volume.data[..., 0].numpy(), (data + 7)[:, ::-1, ::-1])
    assert volume.info.time_step == 4.0
    vector = sitk.Compose(image, image + 1, image + 2)
    for ending in ("nii", "nrrd"):
        sitk.WriteImage(vector, str(tmp_path / f"v.{ending}"))
        volume, _ = read_with_warnings(tmp_path / f"v.{ending}")
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
    volume, warned = read_with_warnings(tmp_path / "a.nii")
    assert volume.info.channels == (ChannelInfo(window=(-100, 300)),)
    assert warned == [
        f"{tmp_path}/a.nii: not kept: the qform, which differs from the sform; 1 header extensions"
    ]
    content = bytearray((tmp_path / "a.nii").read_bytes())
    content[123] = 7  # xyzt_units
    (tmp_path / "b.nii").write_bytes(content)
    assert "xyzt_units 7, which are none" in read_with_warnings(tmp_path / "b.nii")[1][0]


def test_colours_of_nifti(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    rgb = np.random.default_rng(0).integers(0, 255, (4, 5, 6, 3)).astype(np.uint8)
    kind = np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.save(
        nibabel.Nifti1Image(rgb.view(kind).reshape(4, 5, 6), np.eye(4)), tmp_path / "a.nii.gz"
    )
    volume, _ = read_with_warnings(tmp_path / "a.nii.gz")
    assert np.array_equal(volume.data.numpy(), rgb.transpose(2, 1, 0, 3))
    assert [channel.name for channel in volume.info.channels] == ["red", "green", "blue"]


# --- NRRD


@pytest.mark.parametrize(
    ("centers", "spacing", "origin"),
    [("cell", (0.5, 1, 2), (1.25, 2.5, 4)), ("node", (2 / 3, 1.2, 2.4), (1, 2, 3))],
)
def test_ends_of_axes_of_nrrd(tmp_path, centers, spacing, origin):
    """For cells these are the outer sides, for nodes the positions of the first and last one."""
    fields = f"axis mins: 1 2 3\naxis maxs: 3 8 15\ncenters: {centers} {centers} {centers}\n"
    head = f"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 4 6 6\nencoding: raw\n{fields}\n"
    (tmp_path / "a.nrrd").write_bytes(head.encode() + bytes(144))
    volume, _ = read_with_warnings(tmp_path / "a.nrrd")
    assert volume.spacing == pytest.approx(spacing) and volume.origin == pytest.approx(origin)


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
    volume, warned = read_with_warnings(tmp_path / "a.nrrd")
    assert np.array_equal(volume.data.numpy(), data.transpose(3, 2, 1, 0))
    assert volume.spacing == (2, 3, 4) and volume.info.quantity == "HU"
    assert (volume.info.unit, volume.info.space) == ("micrometer", "right-anterior-superior")
    assert warned == [f"{tmp_path}/a.nrrd: not kept: key/value pairs modality"]
    header = {
        "kinds": ["domain", "domain", "domain", "time"],
        "spacings": [0.5, 0.6, 0.7, 20],
        "units": ["mm", "mm", "mm", "ms"],
        "axis mins": [0, 0, 0, 100],
        "centerings": ["node"] * 4,
    }
    nrrd.write(str(tmp_path / "t.nrrd"), data, header)
    volume, warned = read_with_warnings(tmp_path / "t.nrrd", time=3)
    assert np.array_equal(volume.data[..., 0].numpy(), data[..., 3].T) and not warned
    assert volume.spacing == (0.5, 0.6, 0.7) and volume.info.unit == "millimeter"
    assert (volume.info.time_step, volume.info.time_unit) == (20, "millisecond")
    assert volume.info.time_origin == 100
    nrrd.write(
        str(tmp_path / "u.nrrd"), data[0], {"space dimension": 3, "space units": ["furlong"] * 3}
    )
    assert (
        "units of space furlong, furlong, furlong" in read_with_warnings(tmp_path / "u.nrrd")[1][0]
    )


def test_nrrd_without_kinds_is_asked_about(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    data = np.arange(7 * 6 * 5 * 4, dtype=np.int16).reshape(7, 6, 5, 4)  # fastest first
    nrrd.write(str(tmp_path / "a.nrrd"), data, {"encoding": "raw"})
    with pytest.raises(ValueError, match=r"what are the axes of shape \(4, 5, 6, 7\)"):
        gv.read_volume(tmp_path / "a.nrrd")
    volume, _ = read_with_warnings(tmp_path / "a.nrrd", axes="tzyx", time=2)
    assert np.array_equal(volume.data[..., 0].numpy(), data[..., 2].T)
    volume, _ = read_with_warnings(tmp_path / "a.nrrd", axes="zyxc")
    assert np.array_equal(volume.data.numpy(), data.transpose(3, 2, 1, 0))


def test_nrrd_axes_may_be_named_in_any_order(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    data = np.arange(7 * 6 * 5, dtype=np.int16).reshape(7, 6, 5)  # fastest first
    nrrd.write(str(tmp_path / "a.nrrd"), data, {"spacings": [1, 2, 3], "axis mins": [4, 5, 6]})
    volume, _ = read_with_warnings(tmp_path / "a.nrrd", axes="xyz")
    assert np.array_equal(volume.data[..., 0].numpy(), data)
    assert volume.spacing == (3, 2, 1) and volume.origin == (7.5, 6, 4.5)
    nrrd.write(str(tmp_path / "b.nrrd"), data, {"space directions": np.eye(3), "space": "RAS"})
    with pytest.raises(ValueError, match="axes must be z, y, x in this order: its header"):
        gv.read_volume(tmp_path / "b.nrrd", axes="xyz")


def test_nrrd_of_a_colour_picture_is_no_volume(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    data = np.arange(3 * 6 * 5, dtype=np.uint8).reshape(3, 6, 5)
    nrrd.write(str(tmp_path / "a.nrrd"), data, {"kinds": ["RGB-color", "domain", "domain"]})
    with pytest.raises(ValueError, match="three axes of space, got kinds rgb-color, domain"):
        gv.read_volume(tmp_path / "a.nrrd")
    volume, _ = read_with_warnings(tmp_path / "a.nrrd", axes="zyx")
    assert np.array_equal(volume.data[..., 0].numpy(), data.T)
    nrrd.write(str(tmp_path / "b.nrrd"), data, {"kinds": ["domain", "domain", "list"]})
    assert read_with_warnings(tmp_path / "b.nrrd")[0].extent == (3, 6, 5)


def test_nrrd_colours_have_names(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    data = np.zeros((4, 5, 6, 7), np.uint8)
    nrrd.write(str(tmp_path / "a.nrrd"), data, {"kinds": ["RGBA-color", *["domain"] * 3]})
    volume, _ = read_with_warnings(tmp_path / "a.nrrd")
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
        volume, _ = read_with_warnings(tmp_path / name, axes=axes, time=0, **options)
        assert volume.extent == extent and volume.data.shape[3] == width
        letters = axes or "zyxc"[: len(shape)]
        index = {"t": 0, "c": width - 1, "z": extent[2] - 1, "y": 3, "x": 2}
        expected = data[tuple(index[letter] for letter in letters)]
        assert volume.data[index["z"], 3, 2, width - 1] == expected


@pytest.mark.parametrize(
    ("shape", "axes", "message"),
    [
        ((3, 7, 8, 9), None, "'zyxc', 'czyx' or 'tzyx'"),
        ((4, 7, 8, 3), None, "'zyxc', 'czyx' or 'tzyx'"),
        (
            (20, 8, 9, 64),
            None,
            r"what are the axes of shape \(20, 8, 9, 64\)\? Name them with axes",
        ),
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


# --- damage


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
    for offset in range(len(content) - data.nbytes):
        for bad in (0x00, 0x39) if offset % 2 == 0 else (0xFF,):
            broken.write_bytes(content[:offset] + bytes([bad]) + content[offset + 1 :])
            try:
                gv.read_volume(broken, nan=0, time=0)
            except ValueError as error:
                assert "\n" not in str(error) and str(broken) in str(error), str(error)
                refused += 1
            except MemoryError:
                pytest.fail(f"byte {offset} as {bad} takes memory")
    assert refused > 25
