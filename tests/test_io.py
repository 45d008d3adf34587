"""Reading volumes: every format, and many ways in which a file can be wrong."""

from __future__ import annotations

import bz2
import gzip
import sys
import tracemalloc

import numpy as np
import pytest
import torch
from helpers import shared

import gvtorch as gv

EXTENT = (5, 4, 3)  # x y z


def grid(dtype="int16") -> np.ndarray:
    """Returns (z, y, x) values that encode their position."""
    z, y, x = np.mgrid[0:3, 0:4, 0:5]
    return (100 * z + 10 * y + x - 50).astype(dtype)


def assert_is_grid(volume: gv.Volume, dtype=torch.int16) -> None:
    assert volume.extent == EXTENT and volume.data.dtype == dtype
    assert np.array_equal(volume.data[..., 0].float().numpy(), grid("float32"))


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("dtype", "name"),
    [("<i2", "int16"), (">i2", "int16be"), ("<i2", "int16_le"), (">i2", "int16_be")],
)
def test_raw_by_name(tmp_path, dtype, name, packed):
    file = tmp_path / f"scan_5x4x3_{name}.raw{'.gz' if packed else ''}"
    content = grid(dtype).tobytes()
    file.write_bytes(gzip.compress(content) if packed else content)
    assert_is_grid(gv.read_volume(file))


@pytest.mark.parametrize(
    ("dtype", "expected"),
    [
        ("<f4", torch.float32),
        (">f4", torch.float32),
        ("float64", torch.float32),
        (">i4", torch.float32),
        ("int64", torch.float32),
        ("float16", torch.float16),
        ("int8", torch.int8),
    ],
)
def test_raw_by_options(tmp_path, dtype, expected):
    file = tmp_path / "scan.raw"
    values = grid(dtype) if dtype != "int8" else (grid() % 100).astype(dtype)
    file.write_bytes(values.tobytes())
    volume = gv.read_volume(file, shape=EXTENT, dtype=dtype, spacing=(1, 2, 3), origin=(4, 5, 6))
    assert volume.data.dtype == expected
    assert np.array_equal(volume.data[..., 0].float().numpy(), values.astype("float32"))
    assert volume.spacing == (1, 2, 3) and volume.origin == (4, 5, 6)


def test_numpy_files(tmp_path):
    np.save(tmp_path / "a.npy", grid())
    np.save(tmp_path / "f.npy", np.asfortranarray(grid(">i2")))
    np.savez(tmp_path / "one.npz", grid())
    np.savez_compressed(tmp_path / "two.npz", first=grid(), second=grid() * 0)
    (tmp_path / "a.npy.bz2").write_bytes(bz2.compress((tmp_path / "a.npy").read_bytes()))
    for name in ("a.npy", "f.npy", "one.npz", "a.npy.bz2"):
        assert_is_grid(gv.read_volume(tmp_path / name))
    assert_is_grid(gv.read_volume(tmp_path / "two.npz", key="first"))
    with pytest.raises(ValueError, match=r"2 arrays, choose one with key \(--key\): first, second"):
        gv.read_volume(tmp_path / "two.npz")
    with pytest.raises(ValueError, match="has no array 'third'"):
        gv.read_volume(tmp_path / "two.npz", key="third")


def test_channels_of_a_numpy_array(tmp_path):
    np.save(tmp_path / "rgb.npy", np.zeros((6, 4, 5, 3), np.uint8))
    assert gv.read_volume(tmp_path / "rgb.npy").data.shape == (6, 4, 5, 3)


def test_nifti_axes_come_out_along_the_world(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    plain = np.diag([2.0, 3.0, 4.0, 1.0])
    plain[:3, 3] = (10, 20, 30)
    nibabel.save(nibabel.Nifti1Image(grid().T.copy(), plain), tmp_path / "a.nii.gz")
    volume = gv.read_volume(tmp_path / "a.nii.gz")
    assert_is_grid(volume)
    assert volume.spacing == (2, 3, 4) and volume.origin == (10, 20, 30)
    # The same voxels stored with x and z exchanged and y running backwards.
    turned = np.zeros((4, 4))
    turned[2, 0], turned[1, 1], turned[0, 2], turned[3, 3] = 4, -3, 2, 1
    turned[:3, 3] = (10, 20 + 3 * 3, 30)
    stored = np.ascontiguousarray(grid()[:, ::-1, :])
    nibabel.save(nibabel.Nifti1Image(stored, turned), tmp_path / "b.nii")
    volume = gv.read_volume(tmp_path / "b.nii")
    assert_is_grid(volume)
    assert volume.spacing == (2, 3, 4) and volume.origin == (10, 20, 30)


@pytest.mark.parametrize("kind", ["nii.gz", "npy.gz", "npz"])
def test_packed_files_take_memory_once(tmp_path, kind):
    """Not twice, for unpacking and for reading."""
    data = np.arange(100 * 200 * 200, dtype=np.int16).reshape(100, 200, 200)
    file = tmp_path / f"a.{kind}"
    if kind == "nii.gz":
        nibabel = pytest.importorskip("nibabel")
        nibabel.save(nibabel.Nifti1Image(data.T, np.eye(4)), file)
    elif kind == "npz":
        np.savez_compressed(file, data)
    else:
        with gzip.open(file, "wb") as stream:
            np.save(stream, data)
    gv.read_volume(file)  # imports
    tracemalloc.start()
    try:
        volume = gv.read_volume(file)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert np.array_equal(volume.data[..., 0].numpy(), data)
    assert peak < data.nbytes + 5_000_000


def test_real_nifti():
    volume = gv.read_volume(shared("volumes/mni_icbm152_t1_197x233x189_uint8.nii.gz"))
    assert volume.extent == (197, 233, 189) and volume.data.dtype == torch.uint8
    assert volume.spacing == (1, 1, 1) and volume.origin == (-98, -134, -72)


def test_nrrd_attached_and_detached(tmp_path):
    nrrd = pytest.importorskip("nrrd")
    header = {"space": "left-posterior-superior", "space directions": np.diag([2.0, 3, 4])}
    header["space origin"] = np.array([1.0, 2, 3])
    nrrd.write(str(tmp_path / "a.nrrd"), grid(), header, index_order="C")
    nrrd.write(str(tmp_path / "b.nhdr"), grid(), {"spacings": [2.0, 3, 4]}, index_order="C")
    volume = gv.read_volume(tmp_path / "a.nrrd")
    assert_is_grid(volume)
    assert volume.spacing == (2, 3, 4) and volume.origin == (1, 2, 3)
    assert_is_grid(gv.read_volume(tmp_path / "b.nhdr"))
    nrrd.write(str(tmp_path / "50 %.nhdr"), grid(), {}, index_order="C")
    assert_is_grid(gv.read_volume(tmp_path / "50 %.nhdr"))
    assert gv.read_volume(tmp_path / "b.nhdr").spacing == (2, 3, 4)


def test_tiff_stack_and_folder(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "a.tif", grid(), photometric="minisblack")
    tifffile.imwrite(tmp_path / "big.tif", grid(), photometric="minisblack", byteorder=">")
    tifffile.imwrite(
        tmp_path / "ij.tif",
        grid(),
        imagej=True,
        resolution=(0.5, 0.25),
        metadata={"spacing": 3.0, "axes": "ZYX"},
    )
    assert_is_grid(gv.read_volume(tmp_path / "a.tif"))
    assert_is_grid(gv.read_volume(tmp_path / "big.tif"))
    assert gv.read_volume(tmp_path / "ij.tif").spacing == (2, 4, 3)
    four = np.stack((grid(), grid() + 1000), 1)  # z c y x, as ImageJ has it
    tifffile.imwrite(tmp_path / "zcyx.tif", four, imagej=True, metadata={"axes": "ZCYX"})
    volume = gv.read_volume(tmp_path / "zcyx.tif")
    assert volume.extent == EXTENT and volume.data.shape[3] == 2
    assert np.array_equal(volume.data[..., 1].numpy(), grid() + 1000)
    tifffile.imwrite(tmp_path / "w.ome.tif", four, metadata={"axes": "ZHYX"})
    with pytest.raises(ValueError, match="axes ZHYX"):
        gv.read_volume(tmp_path / "w.ome.tif")
    page = np.zeros((6, 7, 3), np.uint8)
    tifffile.imwrite(tmp_path / "rgb.tif", page, photometric="rgb")
    assert gv.read_volume(tmp_path / "rgb.tif").data.shape == (1, 6, 7, 3)
    folder = tmp_path / "slices"
    folder.mkdir()
    with pytest.raises(ValueError, match=r"no \.tif, \.tiff, \.png.* slices in this folder"):
        gv.read_volume(folder)
    for number, image in enumerate(np.concatenate([grid()] * 4)):
        tifffile.imwrite(folder / f"s{number}.tif", image)  # s10 comes after s9, not after s1
    volume = gv.read_volume(folder)
    assert np.array_equal(volume.data[9:, ..., 0].numpy(), grid())
    tifffile.imwrite(folder / "s3.tif", grid()[0, :2])
    with pytest.raises(ValueError, match=r"s3\.tif.*differs"):
        gv.read_volume(folder)


def test_fits_is_big_endian_float():
    with pytest.warns(UserWarning, match="not kept: world coordinates"):
        volume = gv.read_volume(shared("volumes/l1448_13co_105x105x53_float32.fits.gz"))
    assert volume.extent == (105, 105, 53) and volume.data.dtype == torch.float32
    assert volume.value_range == pytest.approx((-0.66, 4.0), abs=0.01)


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
def test_fits_of_several_images(tmp_path, name):
    fits = pytest.importorskip("astropy.io.fits")
    first, second = fits.PrimaryHDU(grid()), fits.ImageHDU(grid() * 2, name="SIGMA")
    first.header["BUNIT"], second.header["BZERO"] = "K", 1
    table = fits.BinTableHDU.from_columns([fits.Column("x", "E", array=[1.0])])
    fits.HDUList([first, fits.ImageHDU(grid()[0]), table, second]).writeto(tmp_path / name)
    with pytest.warns(UserWarning, match="1 other images; key .* 0 'PRIMARY', 1 'SIGMA'"):
        volume = gv.read_volume(tmp_path / name)
    assert_is_grid(volume)
    assert volume.info.quantity == "K"
    for key in ("SIGMA", "1"):
        values = gv.read_volume(tmp_path / name, key=key).data[..., 0].numpy()
        assert np.array_equal(values, grid() * 2 + 1)


def test_fits_with_nan(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    values = grid("float32")
    values[1, 2, 3] = np.nan
    fits.writeto(tmp_path / "a.fits", values)
    with pytest.raises(ValueError, match="1 values that are NaN or infinite"):
        gv.read_volume(tmp_path / "a.fits")
    assert gv.read_volume(tmp_path / "a.fits", nan=-7).data[1, 2, 3, 0] == -7


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a_5x4x3_int16.raw", grid().tobytes()[:-1], "takes 120 bytes, the file has 119"),
        ("a_5x4x3_int16.raw", grid().tobytes() + b"x", "takes 120 bytes, the file has 121"),
        (
            "a_5x4x3_int16.raw.gz",
            gzip.compress(grid().tobytes(), mtime=0)[:-9],
            "can't be read as RAW",
        ),
        (
            "a_5x4x3_int16.raw.gz",
            gzip.compress(grid().tobytes() * 2, mtime=0),
            "takes 120 bytes, the file has more",
        ),
        ("a_5x4x3_int16.raw.gz", b"no gzip", "can't be read as RAW"),
        ("a.raw", b"", "needs its extent"),
        ("a_5x4x3_text8.raw", b"", "dtype must be a NumPy dtype"),
        ("a_0x4x3_int16.raw", b"", "at least 1 in every direction, got 0 x 4 x 3"),
        ("a_2048x2048x2048_uint8.raw", b"", "more than the 2147483648"),
        ("a.npy", b"\x93NUMPY junk", ".npy version (32, 106) is unknown"),
        ("a.npy", b"", "can't be read as NPY"),
        ("a.npz", b"PK junk", "can't be read as NPZ"),
        ("a.npy.bz2", b"BZh junk", "can't be read as NPY"),
        ("a.nii", b"junk" * 200, "can't be read as NIfTI"),
        ("a.nii.gz", b"junk", "can't be read as NIfTI"),
        ("a.nrrd", b"NRRD0004\ntype: junk\n", "can't be read as NRRD"),
        ("a.tif", b"II*\0junk", "can't be read as TIFF"),
        ("a.fits", b"SIMPLE  = junk", "can't be read as FITS"),
        ("a.xyz", b"", "unknown volume format; known endings: ."),
        ("a.obj.gz", b"", "not a volume: gvtorch voxelize makes one of a mesh"),
        ("a.PLY", b"", "not a volume: gvtorch voxelize (or gvtorch splat, of points) makes one"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_named(tmp_path, name, content, message):
    library = {".nii": "nibabel", ".nrrd": "nrrd", ".tif": "tifffile", ".fits": "astropy"}
    for ending, module in library.items():
        if ending in name:
            pytest.importorskip(module)
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(ValueError) as caught:
        gv.read_volume(file)
    assert message in str(caught.value) and str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ending", ["nii", "nrrd", "tif", "fits", "npy"])
def test_every_cut_of_a_file_is_refused_or_whole(tmp_path, ending):
    """Cut at many places, a file gives a ValueError, never wrong voxels and never another error."""
    whole = tmp_path / f"a.{ending}"
    if ending == "nii":
        nibabel = pytest.importorskip("nibabel")
        nibabel.save(nibabel.Nifti1Image(grid().T.copy(), np.eye(4)), whole)
    elif ending == "nrrd":
        pytest.importorskip("nrrd").write(str(whole), grid(), index_order="C")
    elif ending == "tif":
        pytest.importorskip("tifffile").imwrite(whole, grid(), photometric="minisblack")
    elif ending == "fits":
        pytest.importorskip("astropy.io.fits").writeto(whole, grid())
    else:
        np.save(whole, grid())
    content = whole.read_bytes()
    cut = tmp_path / f"cut.{ending}"
    refused = 0
    for size in range(0, len(content), max(1, len(content) // 97)):
        cut.write_bytes(content[:size])
        try:
            assert_is_grid(gv.read_volume(cut))
        except ValueError:
            refused += 1
    assert refused > 50


def test_pickles_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[[{"a": 1}]]], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="Python objects"):
        gv.read_volume(tmp_path / "a.npy")


def test_hostile_extents_take_no_memory(tmp_path):
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999, 99999, 99999), }"
    header += b" " * (117 - len(header)) + b"\n"
    file = tmp_path / "a.npy"
    file.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(ValueError, match="more than the 2147483648"):
        gv.read_volume(file)


def test_missing_file_and_missing_library(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="volume not found"):
        gv.read_volume(tmp_path / "nowhere.raw")
    (tmp_path / "a.nii").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "nibabel", None)
    with pytest.raises(ImportError, match=r"needs nibabel: pip install 'gvtorch\[io\]'"):
        gv.read_volume(tmp_path / "a.nii")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.Volume(np.zeros((0, 3, 3))), "at least 1 in every direction"),
        (lambda: gv.Volume(np.zeros((3, 3))), r"data must be \(z, y, x\)"),
        (lambda: gv.Volume(np.zeros((3, 3, 3, 0))), "at least 1 in every direction"),
        (lambda: gv.Volume(np.zeros((3, 3, 3)), spacing=(1, -1, 1)), "spacing must be positive"),
        (lambda: gv.Volume(np.zeros((3, 3, 3)), spacing=(1, 1)), "spacing must be three numbers"),
        (lambda: gv.Volume(np.zeros((3, 3, 3)), spacing=(1, 1, np.nan)), "spacing must be finite"),
        (lambda: gv.Volume(np.zeros((3, 3, 3)), origin=(1, np.inf, 1)), "origin must be finite"),
        (lambda: gv.Volume(np.full((3, 3, 3), np.nan)), "27 values that are NaN"),
        (lambda: gv.Volume(np.zeros((3, 3, 3), complex)), "numbers, got dtype complex128"),
        (lambda: gv.Volume(np.array([[["a"]]])), "must hold numbers"),
        (lambda: gv.Volume([1, 2]), "must be a tensor or array, got list"),
        (lambda: gv.Volume(torch.zeros(1).expand(2048, 1024, 1025)), "more than the 2147483648"),
    ],
)
def test_bad_volumes_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_shape_is_for_raw_only(tmp_path):
    np.save(tmp_path / "a.npy", grid())
    with pytest.raises(ValueError, match="shape is for RAW files, this is NPY"):
        gv.read_volume(tmp_path / "a.npy", shape=(1, 2, 3))
