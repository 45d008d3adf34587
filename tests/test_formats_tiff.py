"""TIFF: OME-TIFF, BigTIFF and ImageJ's, with all their metadata; and folders of images."""

from __future__ import annotations

import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers import Library
from helpers.damage import assert_robust
from helpers.stores import noise

import gvtorch as gv
from gvtorch.io.reading import open_source
from gvtorch.io.stores.conversion import convert

tifffile = Library("tifffile")
itk = Library("SimpleITK")
Image = Library("PIL.Image")


def ome(file: Path, data: np.ndarray, axes: str = "TCZYX", **options: object) -> Path:
    width = data.shape[axes.index("C")] if "C" in axes else 1
    metadata = {
        "axes": axes,
        "PhysicalSizeX": 300.0,
        "PhysicalSizeXUnit": "nm",
        "PhysicalSizeY": 0.4,
        "PhysicalSizeYUnit": "µm",
        "PhysicalSizeZ": 2e-3,
        "PhysicalSizeZUnit": "mm",
        "TimeIncrement": 1.5,
        "TimeIncrementUnit": "min",
        "Channel": {
            "Name": ["DAPI", "GFP", "Cy5"][:width],
            "Color": [65535, 0x00FF00FF, -16776961][:width],  # RGBA as a signed number
        },
    }
    tifffile.imwrite(file, data, metadata=metadata, photometric="minisblack", ome=True, **options)
    return file


PACKED = [
    {},
    {"compression": "zlib", "tile": (16, 32)},
    {"compression": "lzw", "rowsperstrip": 7, "predictor": True},
    {"bigtiff": True, "byteorder": ">", "compression": "zstd"},
]


@pytest.mark.parametrize("options", PACKED, ids=str)
def test_ome_tiff(tmp_path, options):
    data = noise((2, 3, 4, 40, 50), "uint16")
    source = open_source(ome(tmp_path / "a.ome.tif", data, **options))
    assert not source.whole and source.times == 2 and source.width == 3
    assert source.extent == (50, 40, 4)
    assert source.spacing == pytest.approx((300, 400, 2000)) and source.info.unit == "nanometer"
    assert (source.info.time_step, source.info.time_unit) == (1.5, "minute")
    assert [c.name for c in source.info.channels] == ["DAPI", "GFP", "Cy5"]
    assert [c.color for c in source.info.channels] == [(0, 0, 1), (0, 1, 0), (1, 0, 0)]
    whole = np.moveaxis(data[0], 0, -1)
    assert np.array_equal(source.read_times(0, 1)[0], whole)
    part = source.read_region((1, 5, 20), (3, 33, 45))
    assert np.array_equal(part, whole[1:3, 5:33, 20:45])


def test_times_without_slices_and_a_store(tmp_path):
    data = noise((3, 2, 40, 50), "uint8")
    file = ome(tmp_path / "a.ome.tif", data, "TCYX", compression="zlib")
    source = open_source(file)
    assert source.extent == (50, 40, 1) and source.times == 3
    store = convert(file, tmp_path / "a.zarr")
    assert store.info.unit == "nanometer" and store.width == 2


def test_ome_tiff_of_several_files(tmp_path):
    """A file per channel, each of which lists all."""
    data = noise((2, 3, 20, 30), "uint16")
    file = '<UUID FileName="{c}.tif">{c}</UUID>'
    plane = f'<TiffData FirstC="{{c}}" FirstZ="{{z}}" IFD="{{z}}">{file}</TiffData>'
    planes = "".join(plane.format(c=c, z=z) for c in range(2) for z in range(3))
    sizes = " ".join(
        f'Size{axis}="{n}"' for axis, n in zip("XYZCT", (30, 20, 3, 2, 1), strict=True)
    )
    for c in range(2):
        xml = f'<OME UUID="{c}"><Image><Pixels {sizes} DimensionOrder="XYZCT" Type="uint16">'
        xml += f"{planes}</Pixels></Image></OME>"
        options = {"metadata": None, "photometric": "minisblack", "compression": "zlib"}
        tifffile.imwrite(tmp_path / f"{c}.tif", data[c], description=xml, **options)
    whole = np.moveaxis(data, 0, -1)
    source = open_source(tmp_path / "1.tif")
    assert np.array_equal(source.read_region((1, 2, 3), (3, 19, 20)), whole[1:, 2:19, 3:20])
    store = convert(tmp_path / "0.tif", tmp_path / "a.zarr")
    assert np.array_equal(store.read_region(0, (0, 0, 0), (3, 20, 30)), whole)
    assert [Path(file).name for file in source.files] == [
        "0.tif",
        "1.tif",
    ]  # `resume` compares them


def test_several_series_and_pyramids(tmp_path):
    file = tmp_path / "a.ome.tif"
    fine, other = noise((3, 64, 64), "uint8"), noise((2, 5, 6), "uint8")
    with tifffile.TiffWriter(file) as out:
        options = {"photometric": "minisblack", "tile": (16, 16)}
        out.write(fine, subifds=1, metadata={"axes": "ZYX", "Name": "fine"}, **options)
        out.write(fine[:, ::2, ::2], subfiletype=1, **options)
        sizes = {"PhysicalSizeX": 7.0, "PhysicalSizeY": 7.0, "PhysicalSizeZ": 7.0}
        out.write(other, metadata={"axes": "ZYX", "Name": "other", **sizes}, **options)
    with pytest.warns(UserWarning, match=r"1 other series; key .* among 0 'fine', 1 'other'"):
        volume = gv.read_volume(file)
    assert np.array_equal(volume.data[..., 0].numpy(), fine)
    for key in ("1", "other", "/other"):
        volume = gv.read_volume(file, key=key)
        assert np.array_equal(volume.data[..., 0].numpy(), other) and volume.spacing[0] == 7
    with pytest.raises(ValueError, match="has no series '2'; it holds 0 'fine', 1 'other'"):
        gv.read_volume(file, key="2")


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_imagej(tmp_path, compression):
    data = noise((2, 4, 2, 9, 12), "uint16")
    tables = [
        np.stack([np.arange(256) * part for part in color]).astype("u1")
        for color in ((1, 0, 0), (0, 1, 1))
    ]
    file = tmp_path / "a.tif"
    tifffile.imwrite(
        file,
        data,
        imagej=True,
        resolution=(4, 2),
        compression=compression,
        metadata={
            "axes": "TZCYX",
            "spacing": 3.0,
            "unit": "\\u00B5m",
            "finterval": 2.5,
            "Ranges": (0.0, 100.0, 5.0, 200.0),
            "LUTs": tables,
            "mode": "composite",
        },
    )
    source = open_source(file)
    assert source.spacing == (0.25, 0.5, 3) and source.info.unit == "micrometer"
    assert (source.info.time_step, source.info.time_unit) == (2.5, "second")
    assert [c.window for c in source.info.channels] == [(0, 100), (5, 200)]
    assert [c.color for c in source.info.channels] == [(1, 0, 0), (0, 1, 1)]
    assert np.array_equal(source.read_times(0, 1)[0], np.moveaxis(data[0], 1, -1))


@pytest.mark.parametrize("packed", [False, True])
def test_tiff_of_simpleitk(tmp_path, packed):
    data = noise((5, 9, 12), "uint16")
    itk.WriteImage(itk.GetImageFromArray(data), str(tmp_path / "a.tif"), packed)
    volume = gv.read_volume(tmp_path / "a.tif")
    assert np.array_equal(volume.data[..., 0].numpy(), data)
    part = open_source(tmp_path / "a.tif").read_region((1, 2, 3), (3, 8, 9))
    assert np.array_equal(part[..., 0], data[1:3, 2:8, 3:9])


def test_colours_of_imagej(tmp_path):
    data = noise((4, 9, 12, 3), "uint8")
    tifffile.imwrite(tmp_path / "a.tif", data, imagej=True, metadata={"axes": "ZYXS", "spacing": 2})
    volume = gv.read_volume(tmp_path / "a.tif")
    assert np.array_equal(volume.data.numpy(), data) and volume.spacing[2] == 2
    assert [c.name for c in volume.info.channels] == ["red", "green", "blue"]
    assert volume.info.channels[1].color == (0, 1, 0)


@pytest.mark.parametrize(("kind", "tag"), [("miniswhite", "MinIsWhite"), ("palette", "palette")])
def test_values_that_are_shown_otherwise_are_told(tmp_path, kind, tag):
    data = noise((4, 9, 12), "uint8")
    options = {"colormap": np.zeros((3, 256), "uint16")} if kind == "palette" else {}
    tifffile.imwrite(tmp_path / "a.tif", data, photometric=kind, **options)
    with pytest.warns(UserWarning, match=f"not kept: .*{tag}"):
        volume = gv.read_volume(tmp_path / "a.tif")
    assert np.array_equal(volume.data[..., 0].numpy(), data)


def test_turned_pages_and_centimeters_are_told(tmp_path):
    file = tmp_path / "a.tif"
    options = {"resolution": (2000, 2000), "resolutionunit": "CENTIMETER"}
    tifffile.imwrite(file, noise((3, 8, 9)), extratags=[(274, "H", 1, 6, False)], **options)
    message = (
        "that its pages are to be shown turned or mirrored; the size of a pixel in centimeters"
    )
    with pytest.warns(UserWarning, match=message):
        gv.read_volume(file)
    (tmp_path / "s").mkdir()
    tifffile.imwrite(
        tmp_path / "s" / "0.tif", noise((1, 8, 9))[0], extratags=[(274, "H", 1, 6, False)]
    )
    with pytest.warns(UserWarning, match="not kept: that its pages are to be shown turned"):
        gv.read_volume(tmp_path / "s")


def test_a_file_that_ends_before_its_tiles(tmp_path):
    file = ome(tmp_path / "a.tif", noise((1, 1, 4, 40, 50), "uint16"), compression="zlib")
    with tifffile.TiffFile(file) as tiff:
        last = max(page.dataoffsets[-1] for page in tiff.pages)
    content = file.read_bytes()
    if last + 20 < len(content):
        content = content[: last + 20]
    file.write_bytes(content)
    with pytest.raises(ValueError):
        gv.read_volume(file)


@pytest.mark.parametrize("options", PACKED[:3], ids=str)
def test_broken_tiffs_give_one_line(tmp_path, options):
    file = ome(tmp_path / "a.ome.tif", noise((2, 3, 4, 40, 50), "uint16"), **options)
    assert_robust(file, tmp_path / "broken")


# --- folders of images


@pytest.mark.parametrize("ending", ["png", "jpg", "bmp", "tif"])
@pytest.mark.parametrize("shape", [(12, 40, 50), (12, 40, 50, 3)], ids=["gray", "rgb"])
def test_folders_of_pillow(tmp_path, ending, shape):
    z, y, x = np.mgrid[0:12, 0:40, 0:50]
    data = (8 * z + y + x).astype("u1")
    data = np.stack((data, data + 20, data + 40), -1) if len(shape) == 4 else data
    folder = tmp_path / "slices"
    folder.mkdir()
    for number, image in enumerate(data):
        Image.fromarray(image).save(folder / f"s{number}.{ending}")  # s10 comes after s9
    source = open_source(folder)
    actual = source.read_times(0, 1)[0]
    assert not source.whole and actual.shape == (12, 40, 50, data[0, 0, 0].size)
    expected = data.reshape(actual.shape).astype(int)
    assert np.abs(actual - expected).max() <= (8 if ending == "jpg" else 0)
    part = source.read_region((3, 4, 5), (11, 9, 30))
    assert np.array_equal(part, actual[3:11, 4:9, 5:30])
    if len(shape) == 4:
        assert [c.name for c in source.info.channels] == ["red", "green", "blue"]
    store = convert(folder, tmp_path / "a.zarr")
    assert np.array_equal(store.read_region(0, (0, 0, 0), (12, 40, 50)), actual)


@pytest.mark.parametrize("ending", ["jpg", "tif"])
def test_inks_are_no_light(tmp_path, ending):
    data = noise((3, 9, 12, 4), "uint8")
    for z, image in enumerate(data):
        Image.fromarray(image, "CMYK").save(tmp_path / f"{z}.{ending}")
    with pytest.warns(UserWarning, match="not kept: that its channels are inks"):
        volume = gv.read_volume(tmp_path)
    assert volume.data.shape[3] == 4 and volume.info.channels == ()


def test_wide_png_of_simpleitk(tmp_path):
    data = noise((3, 9, 12), "uint16")
    (tmp_path / "s").mkdir()
    for z, image in enumerate(data):
        itk.WriteImage(itk.GetImageFromArray(image), str(tmp_path / "s" / f"{z}.png"))
    assert np.array_equal(gv.read_volume(tmp_path / "s").data[..., 0].numpy(), data)


def test_folders_that_are_no_stack(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    image = Image.fromarray(np.zeros((4, 5), "u1"))
    image.save(folder / "a.png")
    image.resize((5, 5)).save(folder / "b.png")
    with pytest.raises(ValueError, match=r"b\.png: .* differs from \(4, 5\) uint8 of a\.png"):
        gv.read_volume(folder)
    image.save(folder / "c.bmp")
    with pytest.raises(ValueError, match="images of several kinds: 1 bmp and 2 png"):
        gv.read_volume(folder)


@pytest.mark.parametrize(
    ("names", "gap"),
    [
        ("s1 s2 s9 s10 s11", "s9.png follows s2.png"),
        ("scan3_05 scan3_10 scan3_20", "scan3_20.png follows scan3_10.png"),
        ("s0 s10 s20", ""),
        ("a1 b2 c9", ""),
        ("t1_z1 t1_z2 t2_z1 t2_z2", ""),
        ("only", ""),
    ],
)
def test_slices_that_seem_to_be_missing_are_told(tmp_path, names, gap):
    for name in names.split():
        Image.fromarray(np.zeros((4, 5), "u1")).save(tmp_path / f"{name}.png")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gv.read_volume(tmp_path)
    told = [f"{tmp_path}: not kept: gaps between the numbers of its slices: {gap}"] if gap else []
    assert [str(warning.message) for warning in caught] == told


def write_slices(folder: Path, images: np.ndarray, **options) -> Path:
    folder.mkdir()
    for number, image in enumerate(images):
        tifffile.imwrite(folder / f"{number}.tif", image, **options)
    return folder


def test_tiff_slices_have_rows_columns_and_colours(tmp_path):
    """Colours may come first; pages are no colours."""
    data = noise((5, 20, 30, 3))
    options = {"photometric": "rgb", "planarconfig": "separate"}
    planes = write_slices(tmp_path / "planes", data.transpose(0, 3, 1, 2), **options)
    assert np.array_equal(gv.read_volume(planes).data.numpy(), data)
    pages = write_slices(tmp_path / "pages", data, photometric="minisblack")
    with pytest.raises(ValueError, match=r"0\.tif: expected one slice, got QYX \(20, 30, 3\)"):
        gv.read_volume(pages)
    dark = write_slices(tmp_path / "dark", data[..., 0], photometric="miniswhite")
    with pytest.warns(UserWarning, match="not kept: that high values are meant to be dark"):
        assert np.array_equal(gv.read_volume(dark).data.numpy(), data[..., :1])


def test_metadata_of_other_programs_is_told(tmp_path):
    data = noise((5, 20, 30), "uint16")
    keys = [(34735, "H", 4, (1, 1, 0, 0), True)]
    for options, note in (
        ({"extratags": keys}, "metadata of geotiff"),
        ({"imagej": True, "metadata": {"axes": "ZYX", "xorigin": 5}}, "the position of its origin"),
    ):
        tifffile.imwrite(tmp_path / "a.tif", data, photometric="minisblack", **options)
        with pytest.warns(UserWarning, match=f"not kept: {note}"):
            assert np.array_equal(gv.read_volume(tmp_path / "a.tif").data[..., 0].numpy(), data)


def test_a_png_bomb_is_refused_by_its_header(tmp_path):
    def part(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    head = part(b"IHDR", struct.pack(">IIBBBBB", 2**20, 2**20, 8, 0, 0, 0, 0))
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head)
    with pytest.raises(ValueError, match="more than the 2147483648"):
        gv.read_volume(tmp_path / "s")


@pytest.mark.parametrize("ending", ["png", "jpg", "bmp"])
def test_broken_images_give_one_line(tmp_path, ending):
    folder = tmp_path / "slices"
    folder.mkdir()
    for number, image in enumerate(noise((3, 40, 50), "uint8")):
        Image.fromarray(image).save(folder / f"{number}.{ending}")
    assert_robust(folder, tmp_path / "broken")
