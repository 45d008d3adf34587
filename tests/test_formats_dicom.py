"""DICOM: series written by SimpleITK (GDCM), and files written by pydicom."""

from __future__ import annotations

import locale
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers import Library
from helpers.damage import assert_robust
from helpers.stores import noise, stopped_at

import gvtorch as gv
from gvtorch.io.reading import open_source
from gvtorch.io.stores.conversion import convert

pydicom = Library("pydicom")
itk = Library("SimpleITK")

SHAPE = (6, 9, 12)  # z y x
SPACING = (0.5, 0.75, 2.5)
ORIGIN = (-10.0, 20.0, 5.0)  # LPS
CT = "1.2.840.10008.5.1.4.1.1.2"


@pytest.fixture(autouse=True)
def same_locale() -> Iterator[None]:
    """Restores the locale: GDCM leaves the C locale, in which Python opens text as ASCII."""
    before = locale.setlocale(locale.LC_ALL)
    yield
    locale.setlocale(locale.LC_ALL, before)


def write_series(
    folder: Path,
    data: np.ndarray,
    *,
    series: int = 1,
    packed: str = "",
    tags: dict[str, str] | None = None,
    direction: tuple[float, ...] = (1, 0, 0, 0, 1, 0, 0, 0, 1),
    depths: list[float] | None = None,
) -> Path:
    """Writes (z, y, x) slices by SimpleITK; their names do not reveal their order."""
    folder.mkdir(parents=True, exist_ok=True)
    image = itk.GetImageFromArray(data)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(direction)
    writer = itk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    if packed:
        writer.UseCompressionOn()
        writer.SetCompressor(packed)
    axes = np.array(direction).reshape(3, 3)
    for z in range(len(data)):
        depth = z * SPACING[2] if depths is None else depths[z]
        position = np.array(ORIGIN) + axes[:, 2] * depth
        values = {
            "0008|0060": "CT",
            "0008|0016": CT,
            "0008|0018": f"1.2.3.{series}.{z + 1}",
            "0020|000d": "1.2.3",
            "0020|000e": f"1.2.3.{series}",
            "0020|0011": str(series),
            "0008|103e": f"scan {series}",
            "0020|0013": str(z + 1),
            "0020|0032": "\\".join(f"{v:.6f}" for v in position),
            "0020|0037": "\\".join(f"{v:.6f}" for v in (*axes[:, 0], *axes[:, 1])),
            "0018|0050": "9",  # thickness differs from the distance of slices
            **(tags or {}),
        }
        slice_image = image[:, :, z]
        for tag, value in values.items():
            slice_image.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"i{(7 * z + 3) % 101:03d}_{series}.dcm"))
        writer.Execute(slice_image)
    return folder


@pytest.fixture
def data() -> np.ndarray:
    return noise((*SHAPE, 1), "int16")[..., 0] // 16


RESCALED = {"0028|1052": "-1024", "0028|1053": "1", "0028|1050": "40", "0028|1051": "400"}


@pytest.mark.parametrize("packed", ["", "JPEG", "JPEGLS", "JPEG2000", "RLE"])
def test_a_series_of_gdcm(tmp_path, data, packed):
    stored = data - 1024
    folder = write_series(tmp_path / "ct", stored, packed=packed, tags=RESCALED)
    syntax = pydicom.dcmread(next(folder.iterdir())).file_meta.TransferSyntaxUID
    assert syntax.is_compressed == bool(packed), syntax.name
    for path in (folder, next(folder.iterdir())):
        volume = gv.read_volume(path)
        assert volume.extent == SHAPE[::-1]
        # x and y of RAS are opposite to those of LPS.
        assert np.array_equal(volume.data[..., 0].numpy(), stored[:, ::-1, ::-1])
        assert volume.spacing == pytest.approx(SPACING)
        low = (10 - 11 * SPACING[0], -20 - 8 * SPACING[1], 5)
        assert volume.origin == pytest.approx(low)
        assert volume.info.unit == "millimeter" and volume.info.quantity == "HU"
        low, high = volume.info.channels[0].window
        assert (low, high) == pytest.approx((-160, 239))
    source = open_source(folder)
    assert not source.whole
    assert np.array_equal(
        source.read_region((2, 1, 3), (5, 4, 9)), volume.data[2:5, 1:4, 3:9].numpy()
    )


def test_the_same_scan_as_nifti_lies_at_the_same_place(tmp_path, data):
    turned = (0, 0, 1, -1, 0, 0, 0, -1, 0)  # sagittal
    folder = write_series(tmp_path / "ct", data, direction=turned)
    reader = itk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder)))
    itk.WriteImage(reader.Execute(), str(tmp_path / "a.nii"))
    dicom, nifti = gv.read_volume(folder), gv.read_volume(tmp_path / "a.nii")
    assert dicom.extent == nifti.extent != SHAPE[::-1]
    assert dicom.spacing == pytest.approx(nifti.spacing)
    assert dicom.origin == pytest.approx(nifti.origin, abs=1e-4)
    assert np.array_equal(dicom.data.numpy(), nifti.data.numpy())


def test_several_series_are_asked_about(tmp_path, data):
    write_series(tmp_path / "study" / "a", data, series=2)
    write_series(tmp_path / "study" / "b", data[:3] + 1, series=5)
    with pytest.raises(ValueError, match=r"holds 2 series.*key.*2 \(scan 2, 6 files\), 5 \(scan 5"):
        gv.read_volume(tmp_path / "study")
    for key in ("5", "scan 5", "1.2.3.5"):
        assert gv.read_volume(tmp_path / "study", key=key).extent == (12, 9, 3)
    with pytest.raises(ValueError, match="has no series '7'"):
        gv.read_volume(tmp_path / "study", key="7")
    first_file = next((tmp_path / "study" / "a").iterdir())
    assert gv.read_volume(first_file).extent == (12, 9, 6)  # its series


@pytest.mark.parametrize(
    ("depths", "message"),
    [
        ([0, 1, 2, 4, 5, 6], r"1 slice is missing after slice 3 of 6: the next lies 2 mm"),
        ([0, 1, 2.5, 4, 4.5, 6], "not evenly spaced: 0.5 to 1.5 mm"),
        ([0, 1, 2, 2, 3, 4], "slices occur 1 to 2 times"),
    ],
)
def test_slices_that_are_not_even_are_refused(tmp_path, data, depths, message):
    write_series(tmp_path / "ct", data, depths=depths)
    with pytest.raises(ValueError, match=message):
        gv.read_volume(tmp_path / "ct")


def test_slices_may_run_downwards_and_lie_over_each_other(tmp_path, data):
    write_series(tmp_path / "ct", data, depths=[-1.25 * z for z in range(6)])
    volume = gv.read_volume(tmp_path / "ct")
    assert volume.spacing == pytest.approx((0.5, 0.75, 1.25))
    assert np.array_equal(volume.data[..., 0].numpy(), data[::-1, ::-1, ::-1])
    assert volume.origin[2] == pytest.approx(5 - 5 * 1.25)


def test_images_of_one_place_are_times(tmp_path, data):
    for t in range(3):
        tags = {"0008|0018": "", "0020|0100": str(t + 1), "0018|1060": str(40.0 * t)}
        del tags["0008|0018"]
        tags["0020|000e"] = "1.2.3.9"
        write_series(tmp_path / "ct", data + t, series=20 + t, tags=tags)
    source = open_source(tmp_path / "ct")
    assert source.times == 3 and source.extent == (12, 9, 6)
    assert (source.info.time_step, source.info.time_unit) == (40, "millisecond")
    assert np.array_equal(source.read_times(0, 1)[0][..., 0], data[:, ::-1, ::-1])


def test_a_series_converts(tmp_path, data, monkeypatch):
    folder = write_series(tmp_path / "ct", data)
    store = convert(folder, tmp_path / "a.zarr")
    volume = gv.read_volume(folder)
    assert store.spacing == pytest.approx(SPACING) and store.info.unit == "millimeter"
    assert np.array_equal(store.read_region(0, (0, 0, 0), SHAPE), volume.data.numpy())
    first, *_, last = sorted(folder.iterdir())
    with stopped_at(monkeypatch, 1), pytest.raises(KeyboardInterrupt):
        convert(first, tmp_path / "b.zarr", workers=1)
    os.utime(last, ns=(1, 1))
    with pytest.raises(ValueError, match="the source is not the one that it was begun with"):
        convert(first, tmp_path / "b.zarr", resume=True)


# --- files of pydicom


def dataset(**fields: object):
    from pydicom.dataset import FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian

    file = pydicom.Dataset()
    file.file_meta = FileMetaDataset()
    file.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    file.file_meta.MediaStorageSOPClassUID = file.SOPClassUID = CT
    file.file_meta.MediaStorageSOPInstanceUID = file.SOPInstanceUID = "1.2.3.4"
    file.SeriesInstanceUID, file.Modality = "1.2.3", "MR"
    file.SamplesPerPixel, file.PhotometricInterpretation = 1, "MONOCHROME2"
    file.BitsAllocated, file.BitsStored, file.HighBit, file.PixelRepresentation = 16, 12, 11, 0
    for name, value in fields.items():
        setattr(file, name, value)
    return file


def enhanced(data: np.ndarray):
    """Returns a multi-frame image whose frames are stored from the last to the first."""
    file = dataset(NumberOfFrames=len(data), Rows=data.shape[1], Columns=data.shape[2])
    shared, measures, orientation = pydicom.Dataset(), pydicom.Dataset(), pydicom.Dataset()
    measures.PixelSpacing = [0.75, 0.5]
    orientation.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = [measures], [orientation]
    file.SharedFunctionalGroupsSequence = [shared]
    each = []
    for z in reversed(range(len(data))):
        frame, position, value = pydicom.Dataset(), pydicom.Dataset(), pydicom.Dataset()
        position.ImagePositionPatient = [0, 0, 2 * z]
        value.RescaleSlope, value.RescaleIntercept, value.RescaleType = 0.5, z, "US"
        frame.PlanePositionSequence = [position]
        frame.PixelValueTransformationSequence = [value]
        each.append(frame)
    file.PerFrameFunctionalGroupsSequence = each
    file.PixelData = data[::-1].astype("<u2").tobytes()
    return file


def test_enhanced_images(tmp_path, data):
    data = np.abs(data)
    file = tmp_path / "enhanced.dcm"
    enhanced(data).save_as(file, enforce_file_format=True)
    volume = gv.read_volume(file)
    assert volume.spacing == (0.5, 0.75, 2)
    expected = data * 0.5 + np.arange(len(data))[:, None, None]
    assert np.array_equal(volume.data[..., 0].numpy(), expected[:, ::-1, ::-1].astype("f4"))


def test_deflated_files(tmp_path, data):
    """All of such a file but its first group is packed; it is smaller than its image."""
    data = np.abs(data) // 16 * 16
    several = enhanced(data)
    several.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.1.99"
    several.save_as(tmp_path / "enhanced.dcm", enforce_file_format=True)
    assert (tmp_path / "enhanced.dcm").stat().st_size < data.size * 2
    volume = gv.read_volume(tmp_path / "enhanced.dcm")
    expected = data * 0.5 + np.arange(len(data))[:, None, None]
    assert np.array_equal(volume.data[..., 0].numpy(), expected[:, ::-1, ::-1].astype("f4"))
    source = open_source(tmp_path / "enhanced.dcm")
    part = source.read_region((2, 0, 0), (3, 4, 5))
    assert np.array_equal(part, volume.data.numpy()[2:3, :4, :5])


def test_color_and_images_without_a_place(tmp_path):
    rgb = noise((2, 5, 7, 3))
    for z, image in enumerate(rgb):
        file = dataset(Rows=5, Columns=7, InstanceNumber=2 - z, PlanarConfiguration=0)
        file.SamplesPerPixel, file.PhotometricInterpretation = 3, "RGB"
        file.BitsAllocated, file.BitsStored, file.HighBit = 8, 8, 7
        file.PixelData, file.SOPInstanceUID = image.tobytes() + b"\0", f"1.2.{z}"
        file.save_as(tmp_path / f"{z}", enforce_file_format=True)
    with pytest.warns(UserWarning, match="not kept: slices have no place"):
        volume = gv.read_volume(tmp_path)
    assert np.array_equal(volume.data.numpy(), rgb[::-1, ::-1, ::-1])
    assert [channel.name for channel in volume.info.channels] == ["red", "green", "blue"]


def test_a_modality_s_table_is_told(tmp_path, data):
    """The table is not applied, so the values are not Hounsfield units."""
    table = pydicom.Dataset()
    table.LUTDescriptor, table.ModalityLUTType, table.LUTData = [3, 0, 16], "HU", bytes(6)
    file = dataset(Rows=data.shape[1], Columns=data.shape[2], Modality="CT")
    image = np.abs(data[0]).astype("<u2")
    file.ModalityLUTSequence, file.PixelData = [table], image.tobytes()
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    with pytest.warns(UserWarning, match="the modality's table: values are those that it looks"):
        volume = gv.read_volume(tmp_path / "a.dcm")
    assert volume.info.quantity is None
    assert np.array_equal(volume.data[0, ..., 0].numpy(), image[::-1, ::-1])


@pytest.mark.parametrize(
    ("fields", "value", "dtype"),
    [
        ({"PixelRepresentation": 1}, -5, "int16"),
        ({"BitsStored": 16, "HighBit": 15}, 60_000, "uint16"),
    ],
)
def test_images_of_a_series_may_store_numbers_differently(tmp_path, fields, value, dtype):
    images = np.full((3, 5, 7), 9, "<i4")
    images[2] = value
    for z, image in enumerate(images):
        file = dataset(Rows=5, Columns=7, InstanceNumber=z, SOPInstanceUID=f"1.2.{z}")
        file.PixelSpacing, file.ImageOrientationPatient = [1, 1], [1, 0, 0, 0, 1, 0]
        file.ImagePositionPatient, file.PixelData = [0, 0, z], image.astype("<u2").tobytes()
        for name, own in fields.items() if z else ():
            setattr(file, name, own)
        file.save_as(tmp_path / f"{z}", enforce_file_format=True)
    values = gv.read_volume(tmp_path).data[..., 0].numpy()
    assert values.dtype == dtype and np.array_equal(values, images)


def test_a_mapping_to_real_world_values_is_told(tmp_path, data):
    mapping, image = pydicom.Dataset(), np.abs(data[0]).astype("<u2")
    mapping.RealWorldValueSlope, mapping.RealWorldValueIntercept = 2.0, 1.0
    file = dataset(Rows=data.shape[1], Columns=data.shape[2], PixelData=image.tobytes())
    file.RealWorldValueMappingSequence = [mapping]
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    with pytest.warns(UserWarning, match="the mapping to real world values: values are as stored"):
        volume = gv.read_volume(tmp_path / "a.dcm")
    assert np.array_equal(volume.data[0, ..., 0].numpy(), image[::-1, ::-1])


@pytest.mark.parametrize(("tag", "dtype"), [("Float", "<f4"), ("DoubleFloat", "<f8")])
def test_pixels_that_are_floats(tmp_path, data, tag, dtype):
    image = data[0].astype(dtype) / 7
    file = dataset(Rows=image.shape[0], Columns=image.shape[1], BitsAllocated=8 * image.itemsize)
    for name in ("BitsStored", "HighBit", "PixelRepresentation"):
        delattr(file, name)
    setattr(file, f"{tag}PixelData", image.tobytes())
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    actual = gv.read_volume(tmp_path / "a.dcm").data[0, ..., 0].numpy()
    assert np.array_equal(actual, image[::-1, ::-1].astype("f4"))


def test_values_that_do_not_begin_at_the_lowest_bit_are_refused(tmp_path, data):
    file = dataset(Rows=data.shape[1], Columns=data.shape[2], HighBit=15)
    file.PixelData = (np.abs(data[0]).astype("<u2") % 4096 << 4).tobytes()
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    with pytest.raises(ValueError, match="High Bit is 15 of 12 bits; expected 11"):
        gv.read_volume(tmp_path / "a.dcm")


def test_pixels_that_share_their_colour(tmp_path):
    """Two pixels take four bytes; without a distance of pixels, the header tells their shape."""
    file = dataset(Rows=40, Columns=60, PlanarConfiguration=0, PixelAspectRatio=[3, 2])
    file.SamplesPerPixel, file.PhotometricInterpretation = 3, "YBR_FULL_422"
    file.BitsAllocated, file.BitsStored, file.HighBit = 8, 8, 7
    image = np.full((40, 30, 4), 128, "u1")  # luma, luma, blue, red: grey
    image[..., 0], image[..., 1] = noise((2, 40, 30))
    file.PixelData = image.tobytes()
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    volume = gv.read_volume(tmp_path / "a.dcm")
    expected = image[..., :2].reshape(40, 60)[::-1, ::-1, None]
    assert np.abs(volume.data[0].numpy().astype(int) - expected).max() <= 1
    assert volume.spacing == (2, 3, 1) and volume.info.unit is None


@pytest.mark.parametrize("codec", ["jpeg", "ljpeg"])
def test_frames_through_imagecodecs(tmp_path, codec):
    import imagecodecs
    from pydicom.encaps import encapsulate

    image = np.linspace(0, 200, 32 * 40).reshape(32, 40).astype("u1")
    encode = imagecodecs.jpeg8_encode if codec == "jpeg" else imagecodecs.ljpeg_encode
    file = dataset(Rows=32, Columns=40, ImagePositionPatient=[0, 0, 0], SpacingBetweenSlices=3)
    file.BitsAllocated, file.BitsStored, file.HighBit = 8, 8, 7
    file.file_meta.TransferSyntaxUID = f"1.2.840.10008.1.2.4.{50 if codec == 'jpeg' else 70}"
    file.PixelData = encapsulate([encode(image)])
    file["PixelData"].is_undefined_length = True
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    volume = gv.read_volume(tmp_path / "a.dcm")
    assert np.abs(volume.data[0, ..., 0].numpy().astype(int) - image[::-1, ::-1]).max() <= (
        3 if codec == "jpeg" else 0
    )
    file.Rows = 4000  # the frame's own header says something else
    file.save_as(tmp_path / "b.dcm", enforce_file_format=True)
    with pytest.raises(ValueError, match="a frame is of"):
        gv.read_volume(tmp_path / "b.dcm")


def test_hostile_files_take_no_memory(tmp_path, data):
    file = dataset(Rows=65535, Columns=30000, PixelData=b"\0" * 64)
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    with pytest.raises(ValueError, match="its images take 3932100000 bytes, the file has"):
        gv.read_volume(tmp_path / "a.dcm")
    file = dataset(Rows=10, Columns=10, NumberOfFrames=10**9, PixelData=b"\0" * 64)
    file.save_as(tmp_path / "b.dcm", enforce_file_format=True)
    with pytest.raises(ValueError, match="1000000000 frames in a file that is too short"):
        gv.read_volume(tmp_path / "b.dcm")


def test_broken_files_give_one_line(tmp_path, data):
    enhanced(np.abs(data)).save_as(tmp_path / "e.dcm", enforce_file_format=True)
    assert_robust(tmp_path / "e.dcm", tmp_path / "one")
    folder = write_series(tmp_path / "ct", data, packed="JPEGLS")
    assert_robust(folder, tmp_path / "many", min_refused=10)


@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("dtype", ["u1", "<u2"])
def test_run_lengths_are_unpacked_no_further_than_the_frame(tmp_path, samples, dtype):
    """Segments that do not end, lie behind the end, or are too short."""
    imagecodecs = pytest.importorskip("imagecodecs")
    image = noise((5, 7, samples), np.dtype(dtype).name)
    bits = 8 * image.dtype.itemsize
    file = dataset(Rows=5, Columns=7, BitsAllocated=bits, BitsStored=bits, HighBit=bits - 1)
    file.SamplesPerPixel, file.PlanarConfiguration = samples, 0
    file.PhotometricInterpretation = "RGB" if samples == 3 else "MONOCHROME2"
    file.PixelData = image.tobytes() + bytes(image.nbytes % 2)
    file.compress("1.2.840.10008.1.2.5", encoding_plugin="pydicom")
    file.save_as(tmp_path / "a.dcm", enforce_file_format=True)
    volume = gv.read_volume(tmp_path / "a.dcm")
    assert np.array_equal(volume.data.numpy()[0], image[::-1, ::-1])

    planes = [
        image[..., n].tobytes()[k :: bits // 8] for n in range(samples) for k in range(bits // 8)
    ]
    packed = [bytes(imagecodecs.packbits_encode(plane)) for plane in planes]
    for first in (b"\x81\x07" * 100_000, packed[0][: len(packed[0]) // 2], None):
        parts = [packed[0] if first is None else first, *packed[1:]]
        starts = np.cumsum([64, *(len(part) for part in parts)])[:-1].tolist()
        starts = [*starts[:-1], 10**9] if first is None else starts
        head = np.array([len(parts), *starts, *[0] * (15 - len(parts))], "<u4").tobytes()
        frame = head + b"".join(parts)
        file.PixelData = pydicom.encaps.encapsulate([frame + bytes(len(frame) % 2)])
        file.save_as(tmp_path / "b.dcm", enforce_file_format=True)
        with pytest.raises(ValueError, match=r"b\.dcm"):
            gv.read_volume(tmp_path / "b.dcm")
