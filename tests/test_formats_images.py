"""MetaImage by SimpleITK, MRC by mrcfile, VTK images by VTK."""

from __future__ import annotations

import os
import time
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers import Library
from helpers.damage import assert_robust
from helpers.stores import noise

import gvtorch as gv
from gvtorch.io.reading import open_source
from gvtorch.io.source import number_type
from gvtorch.io.stores.conversion import convert

itk = Library("SimpleITK")
mrcfile = Library("mrcfile")
vtk = Library("vtkmodules.all")
numpy_support = Library("vtkmodules.util.numpy_support")


@pytest.fixture
def grid() -> np.ndarray:
    return noise((7, 9, 12), "int16")


def assert_parts(path: str | Path, **options) -> gv.Volume:
    """Asserts that regions equal parts of the whole volume; returns it."""
    volume, source = gv.read_volume(path, **options), open_source(path, **options)
    z, y, x = volume.data.shape[:3]
    part = source.read_region((1, 2, 3), (z - 2, y - 1, x))
    assert np.array_equal(part, volume.data[1 : z - 2, 2 : y - 1, 3:].numpy())
    return volume


# --- MetaImage


def image(grid: np.ndarray, direction=(1, 0, 0, 0, 1, 0, 0, 0, 1), vector=False):
    itk_image = itk.GetImageFromArray(grid, isVector=vector)
    itk_image.SetSpacing((0.5, 2.0, 3.0))
    itk_image.SetOrigin((10.0, -20.0, 30.0))
    itk_image.SetDirection(direction)
    return itk_image


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("ending", ["mha", "mhd"])
@pytest.mark.parametrize(
    "direction", [(1, 0, 0, 0, 1, 0, 0, 0, 1), (0, 0, 1, -1, 0, 0, 0, -1, 0)], ids=str
)
def test_metaimage_lies_where_nifti_does(tmp_path, grid, ending, packed, direction):
    for name in (f"a.{ending}", "a.nii"):
        itk.WriteImage(image(grid, direction), str(tmp_path / name), packed)
    metaimage, nifti = assert_parts(tmp_path / f"a.{ending}"), gv.read_volume(tmp_path / "a.nii")
    assert metaimage.spacing == pytest.approx(nifti.spacing) and metaimage.extent == nifti.extent
    assert metaimage.origin == pytest.approx(nifti.origin)
    assert np.array_equal(metaimage.data.numpy(), nifti.data.numpy())
    assert metaimage.info.unit == "millimeter" and metaimage.info.space == "right-anterior-superior"
    assert open_source(tmp_path / f"a.{ending}").whole == packed


def test_metaimage_with_colors_times_and_other_types(tmp_path, grid):
    rgb = noise((7, 9, 12, 3))
    itk.WriteImage(image(rgb, vector=True), str(tmp_path / "rgb.mha"))
    volume = gv.read_volume(tmp_path / "rgb.mha")
    assert np.array_equal(volume.data.numpy(), rgb[:, ::-1, ::-1])
    four = np.stack([grid, grid + 1, grid + 2]).astype("float64")
    itk.WriteImage(itk.GetImageFromArray(four, isVector=False), str(tmp_path / "t.mha"))
    source = open_source(tmp_path / "t.mha", time=2)
    assert source.times == 3
    actual = source.read_region((0, 0, 0), (7, 9, 12))[..., 0]
    assert np.array_equal(actual, four[2, :, ::-1, ::-1].astype("float32"))


def write_mha(path: Path, content: bytes, **fields: str) -> Path:
    """Writes a file of 12x9x7 int16 numbers with the fields of a header that other programs use."""
    head = {"NDims": "3", "DimSize": "12 9 7", "ElementType": "MET_SHORT"}
    head |= fields | {"ElementDataFile": "LOCAL"}
    path.write_bytes("".join(f"{k} = {v}\n" for k, v in head.items()).encode() + content)
    return path


@pytest.mark.parametrize("true", ["True", "true", "T", "1"])
def test_metaimage_says_true_in_several_ways(tmp_path, grid, true):
    path, expected = tmp_path / "a.mha", grid[:, ::-1, ::-1]
    big = {"BinaryData": true, "BinaryDataByteOrderMSB": true}
    numbers = grid.astype(">i2").tobytes()
    packed = zlib.compress(numbers)
    is_packed = {"CompressedData": true, "CompressedDataSize": str(len(packed))}
    for content, fields in (
        (numbers, big),
        (packed, big | is_packed),
        (b"in between" + grid.tobytes(), {"HeaderSize": "-1"}),  # numbers are at the end
    ):
        volume = gv.read_volume(write_mha(path, content, **fields))
        assert np.array_equal(volume.data[..., 0].numpy(), expected), fields
        assert np.array_equal(itk.GetArrayFromImage(itk.ReadImage(str(path))), grid)


def test_metaimage_keeps_when_its_times_begin(tmp_path, grid):
    four = {"NDims": "4", "DimSize": "12 9 1 7", "Offset": "1 2 3 60", "ElementSpacing": "1 1 1 5"}
    info = open_source(write_mha(tmp_path / "a.mha", grid.tobytes(), **four)).info
    assert (info.time_step, info.time_origin) == (5, 60)


def test_metaimage_without_its_numbers(tmp_path, grid):
    itk.WriteImage(image(grid), str(tmp_path / "a.mhd"))
    (tmp_path / "a.raw").unlink()
    with pytest.raises((ValueError, OSError), match=r"a\.raw"):
        gv.read_volume(tmp_path / "a.mhd")


@pytest.mark.parametrize("packed", [False, True])
def test_broken_metaimages_give_one_line(tmp_path, grid, packed):
    itk.WriteImage(image(grid), str(tmp_path / "a.mha"), packed)
    assert_robust(tmp_path / "a.mha", tmp_path / "broken")


# --- MRC


@pytest.mark.parametrize("dtype", ["int8", "int16", "float32", "uint16", "float16"])
@pytest.mark.parametrize("ending", ["mrc", "map.gz", "mrc.bz2"])
def test_mrc(tmp_path, grid, dtype, ending):
    kind = {"gz": "gzip", "z2": "bzip2"}.get(ending[-2:])
    grid = np.abs(grid)
    file = tmp_path / f"a.{ending}"
    with mrcfile.new(file, data=(grid // 300).astype(dtype), compression=kind) as out:
        out.voxel_size = (1.5, 2.5, 4.0)
        out.header.origin = (10, 20, 30)
    volume = assert_parts(file)
    assert np.array_equal(volume.data[..., 0].float().numpy(), (grid // 300).astype("f4"))
    assert volume.spacing == pytest.approx((1.5, 2.5, 4)) and volume.info.unit == "angstrom"
    assert volume.origin == (10, 20, 30)
    assert open_source(file).whole == (kind is not None)


@pytest.mark.parametrize("order", ["<", ">"])
def test_bytes_of_imod_have_no_sign_unless_it_says_so(tmp_path, grid, order):
    """Its stamp and flags are at bytes 152 and 156 of the header."""
    file, signed = tmp_path / "a.mrc", grid.astype("i1")
    mrcfile.write(file, grid.astype(f"{order}i2"))
    head = bytearray(file.read_bytes()[:1024])
    head[12:16] = bytes(4)  # mode 0

    def read(stamp, flags):
        head[152:160] = np.array([stamp, flags], f"{order}i4").tobytes()
        file.write_bytes(head + signed.tobytes())
        return gv.read_volume(file).data[..., 0].numpy()

    for flags, dtype in ((0, "u1"), (1, "i1"), (4 + 8, "u1")):
        assert np.array_equal(read(1146047817, flags), signed.view(dtype))
    assert np.array_equal(read(0, 0), signed), "not of IMOD"
    with pytest.raises(ValueError, match="values of 4 bits"):
        read(1146047817, 16)


def test_mrc_axes_and_starts(tmp_path, grid):
    with mrcfile.new(tmp_path / "a.mrc", data=grid) as out:
        out.voxel_size = 2.0
        out.header.mapc, out.header.mapr, out.header.maps = 3, 2, 1  # z fastest
        out.header.nxstart, out.header.nzstart = 5, -7  # of columns, which are z
        out.set_extended_header(np.zeros(80, "V1"))
    volume = gv.read_volume(tmp_path / "a.mrc")
    assert np.array_equal(volume.data[..., 0].numpy(), grid.transpose(2, 1, 0))
    assert volume.origin[2] == 5 * volume.spacing[2] and volume.origin[0] == -7 * volume.spacing[0]
    store = convert(tmp_path / "a.mrc", tmp_path / "a.zarr")
    assert store.info.unit == "angstrom"


def test_mrc_with_a_slanted_cell(tmp_path):
    """A monoclinic cell: its edge c leans 20 degrees from z to -x. Values are linear in the world,
    so resampling keeps them.
    """
    lean = np.radians(20)
    columns, rows = 0.5 * np.array((1, 0, 0)), 3 * np.array((-np.sin(lean), 0, np.cos(lean)))
    steps = np.stack((2 * np.array((0, 1, 0)), rows, columns), 1)  # of sections, rows, columns
    index = np.stack(np.mgrid[4:11, 0:9, 0:12], -1)
    world = index @ steps.T
    with mrcfile.new(tmp_path / "a.mrc", data=(world @ (1, 2, 3)).astype("f4")) as out:
        out.header.mx, out.header.my, out.header.mz = 12, 7, 9  # of the edges a, b, c
        out.header.cella, out.header.cellb = (6.0, 14.0, 27.0), (90, 110, 90)
        out.header.mapc, out.header.mapr, out.header.maps, out.header.nzstart = 1, 3, 2, 4
    with pytest.warns(UserWarning, match="turned by 20 degrees: resampled"):
        volume = gv.read_volume(tmp_path / "a.mrc")
    positions = np.stack(np.mgrid[tuple(slice(n) for n in volume.extent)], -1) * volume.spacing
    positions += volume.origin
    stored = positions @ np.linalg.inv(steps).T - (4, 0, 0)
    inside = ((stored >= 0) & (stored <= (6, 8, 11))).all(-1)
    values = volume.data[..., 0].numpy().T
    assert inside.sum() > 400
    assert values[inside] == pytest.approx((positions @ (1, 2, 3))[inside], abs=1e-4)


def test_broken_maps_give_one_line(tmp_path, grid):
    mrcfile.write(tmp_path / "a.mrc", grid)
    assert_robust(tmp_path / "a.mrc", tmp_path / "broken")


# --- VTK


def vtk_image(grid: np.ndarray, name: str = "density", cells: bool = False):
    """Returns a VTK image of (z, y, x) or (z, y, x, c) values, with a second array."""
    result = vtk.vtkImageData()
    size = [n + cells for n in grid.shape[2::-1]]
    result.SetExtent(2, size[0] + 1, 0, size[1] - 1, 0, size[2] - 1)
    result.SetSpacing(0.5, 2, 3)
    result.SetOrigin(10, 20, 30)
    data = result.GetCellData() if cells else result.GetPointData()
    width = grid.shape[3] if grid.ndim == 4 else 1
    for add, called in ((0, name), (1, "other")):
        array = numpy_support.numpy_to_vtk((grid + add).reshape(-1, width), deep=True)
        array.SetName(called)
        (data.SetScalars if called == name else data.AddArray)(array)
    return result


def write_vti(file: Path, data, mode: str = "Appended", packer: str = "ZLib") -> Path:
    writer = vtk.vtkXMLImageDataWriter()
    writer.SetFileName(str(file))
    writer.SetInputData(data)
    getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{packer}")()
    writer.SetEncodeAppendedData(mode == "Appended" and packer == "LZMA")
    writer.Write()
    return file


@pytest.mark.parametrize(
    ("mode", "packer"),
    [
        ("Appended", "None"),
        ("Appended", "ZLib"),
        ("Appended", "LZ4"),
        ("Appended", "LZMA"),
        ("Binary", "None"),
        ("Binary", "ZLib"),
        ("Ascii", "None"),
    ],
)
@pytest.mark.parametrize("dtype", ["int16", "float64", "uint8"])
@pytest.mark.filterwarnings("ignore:.*other arrays.*")
def test_vti(tmp_path, grid, mode, packer, dtype):
    values = (grid // 300).astype(dtype)
    file = write_vti(tmp_path / "a.vti", vtk_image(values), mode, packer)
    volume = assert_parts(file)
    assert np.array_equal(volume.data[..., 0].float().numpy(), values.astype("f4"))
    assert volume.spacing == (0.5, 2, 3) and volume.origin == (11, 20, 30)
    assert volume.info.channels[0].name == "density"
    for key in ("other", "1"):
        other = gv.read_volume(file, key=key)
        assert np.array_equal(other.data.float(), (volume.data + 1).float())
    assert open_source(file).whole == ((mode, packer) != ("Appended", "None"))
    with pytest.raises(ValueError, match="has no array 'x'; it holds 0 'density', 1 'other'"):
        gv.read_volume(file, key="x")


@pytest.mark.filterwarnings("ignore:.*other arrays.*")
def test_vti_of_cells_vectors_and_turned_axes(tmp_path, grid):
    volume = gv.read_volume(write_vti(tmp_path / "c.vti", vtk_image(grid, cells=True)))
    assert np.array_equal(volume.data[..., 0].numpy(), grid)
    assert volume.origin == (11.25, 21, 31.5)
    rgb = noise((7, 9, 12, 3))
    volume = gv.read_volume(write_vti(tmp_path / "v.vti", vtk_image(rgb)))
    assert np.array_equal(volume.data.numpy(), rgb)
    turned = vtk_image(grid)
    turned.SetDirectionMatrix(0, 1, 0, -1, 0, 0, 0, 0, 1)
    volume = gv.read_volume(write_vti(tmp_path / "t.vti", turned))
    position = [0.0, 0.0, 0.0]
    turned.TransformIndexToPhysicalPoint((2 + 11, 0, 0), position)  # the lowest world y, x
    assert volume.origin == tuple(position) and volume.spacing == (2, 0.5, 3)
    assert np.array_equal(volume.data[..., 0].numpy(), grid[:, :, ::-1].transpose(0, 2, 1))


@pytest.mark.parametrize("kind", ["Binary", "ASCII"])
@pytest.mark.parametrize("cells", [False, True])
@pytest.mark.filterwarnings("ignore:.*other arrays.*")
def test_legacy_vtk(tmp_path, grid, kind, cells):
    writer = vtk.vtkStructuredPointsWriter()
    writer.SetFileName(str(tmp_path / "a.vtk"))
    writer.SetInputData(vtk_image(grid, cells=cells))
    getattr(writer, f"SetFileTypeTo{kind}")()
    writer.Write()
    volume = assert_parts(tmp_path / "a.vtk")
    assert np.array_equal(volume.data[..., 0].numpy(), grid)
    assert volume.spacing == (0.5, 2, 3)
    assert volume.origin == ((11.25, 21, 31.5) if cells else (11, 20, 30))
    other = gv.read_volume(tmp_path / "a.vtk", key="other")
    assert np.array_equal(other.data[..., 0].numpy(), grid + 1)


def write_legacy(file: Path, image, kind: str) -> Path:
    writer = vtk.vtkStructuredPointsWriter()
    writer.SetFileName(str(file))
    writer.SetInputData(image)
    getattr(writer, f"SetFileTypeTo{kind}")()
    writer.Write()
    return file


@pytest.mark.parametrize(
    ("dtype", "names"),
    [
        ("u1", "uchar, unsigned char, uint8, uint8_t, UInt8, UCHAR, unsigned_char"),
        ("i2", "short, short int, signed short int, int16, int16_t, SHORT"),
        ("u8", "ulonglong, unsigned long long, unsigned long long int, uint64, ULONG_LONG"),
        ("f4", "float, Float32, FLOAT"),
        (None, "long, unsigned int16, int int, unint, float int, signed float, float_t, bits"),
    ],
)
def test_names_of_numbers(dtype, names):
    """As spelled by NRRD, MetaImage, VTK and PLY."""
    assert {number_type(name) for name in names.split(", ")} == {dtype}


@pytest.mark.parametrize("kind", ["Binary", "ASCII"])
@pytest.mark.parametrize("dtype", ["uint8", "int8", "uint64", "ids"])
def test_kinds_of_numbers_of_legacy_vtk(tmp_path, kind, dtype):
    """VTK writes unsigned char as colours, in text as fractions of 255; and its ids as int."""
    grid = noise((3, 4, 5), "uint8" if dtype == "ids" else dtype)
    image = vtk_image(grid)
    if dtype == "ids":
        ids = vtk.vtkIdTypeArray()
        ids.SetNumberOfTuples(grid.size)
        for index, value in enumerate(grid.ravel().tolist()):
            ids.SetValue(index, value)
        image.GetPointData().SetScalars(ids)
    image.GetPointData().GetScalars().SetName("a 100%")
    volume = gv.read_volume(write_legacy(tmp_path / "a.vtk", image, kind), key="a 100%")
    assert np.array_equal(volume.data[..., 0].numpy(), grid.astype(volume.data.numpy().dtype))


@pytest.mark.parametrize("kind", ["Binary", "ASCII"])
def test_points_come_before_cells_in_legacy_vtk(tmp_path, grid, kind):
    """As in XML, in whatever order the file has them; VTK itself writes cells first."""
    image = vtk_image(grid)
    cells = np.arange(6 * 8 * 11, dtype="f4").reshape(6, 8, 11)
    array = numpy_support.numpy_to_vtk(cells.ravel(), deep=True)
    array.SetName("cells")
    image.GetCellData().AddArray(array)
    file = write_legacy(tmp_path / "a.vtk", image, kind)
    with pytest.warns(UserWarning, match=r"other arrays; key .*, 2 'cells'"):
        volume = gv.read_volume(file)
    assert np.array_equal(volume.data[..., 0].numpy(), grid)
    volume = gv.read_volume(file, key="cells")
    assert np.array_equal(volume.data[..., 0].numpy(), cells)


def test_scalars_come_before_other_arrays_in_both_vtk_formats(tmp_path, grid):
    image = vtk_image(grid, cells=True)
    array = numpy_support.numpy_to_vtk(np.zeros(image.GetNumberOfPoints(), "f4"), deep=True)
    array.SetName("at points")
    image.GetPointData().AddArray(array)
    for file in (
        write_vti(tmp_path / "a.vti", image),
        write_legacy(tmp_path / "a.vtk", image, "Binary"),
    ):
        with pytest.warns(UserWarning, match="other arrays"):
            volume = gv.read_volume(file)
        assert np.array_equal(volume.data[..., 0].numpy(), grid)


def test_words_of_legacy_vtk_have_any_case(tmp_path):
    head = "# vtk DataFile Version 3.0\na\nascii\ndataset structured_points\ndimensions 3 3 3\n"
    numbers = " ".join(map(str, range(27)))
    array = f"point_data 27\nscalars a short\nlookup_table default\n{numbers}\n"
    (tmp_path / "a.vtk").write_text(f"{head}{array}")
    assert gv.read_volume(tmp_path / "a.vtk").data.flatten().tolist() == list(range(27))


def test_other_vtk_files_are_named(tmp_path):
    (tmp_path / "a.vtk").write_bytes(b"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\n\n")
    with pytest.raises(ValueError, match=r"POLYDATA.*expected STRUCTURED_POINTS"):
        gv.read_volume(tmp_path / "a.vtk")


def test_raw_vti_of_more_values_than_fit_into_memory(tmp_path):
    """A store holds 2^40 voxels; the file here is sparse."""
    header = (
        b'<VTKFile type="ImageData"><ImageData WholeExtent="0 4095 0 2047 0 2047">'
        b'<Piece Extent="0 4095 0 2047 0 2047"><PointData><DataArray Name="a" type="UInt8" '
        b'format="appended" offset="0"/></PointData></Piece></ImageData>'
        b'<AppendedData encoding="raw">_'
    )
    file = tmp_path / "a.vti"
    file.write_bytes(header)
    os.truncate(file, len(header) + 4 + 2**34)
    with file.open("r+b") as stream:
        stream.seek(len(header) + 4 + 2**34 - 1)
        stream.write(b"\7")
    source = open_source(file)
    assert source.extent == (4096, 2048, 2048)
    assert source.read_region((2047, 2047, 4095), (2048, 2048, 4096)).item() == 7


@pytest.mark.parametrize(
    ("original", "instead", "message"),
    [
        (b'offset="0"', b'offset="99999999999"', r"begins at \d+, the file has"),
        (b"LittleEndian", b"MiddleEndian", "MiddleEndian"),
    ],
)
def test_a_vti_that_tells_what_is_not_there(tmp_path, grid, original, instead, message):
    file = write_vti(tmp_path / "a.vti", vtk_image(grid))
    content = file.read_bytes()
    assert original in content
    file.write_bytes(content.replace(original, instead))
    with pytest.raises(ValueError, match=message):
        gv.read_volume(file)


@pytest.mark.parametrize(
    ("mode", "packer"), [("Appended", "None"), ("Appended", "ZLib"), ("Binary", "ZLib")]
)
def test_broken_vti_gives_one_line(tmp_path, grid, mode, packer):
    assert_robust(write_vti(tmp_path / "a.vti", vtk_image(grid), mode, packer), tmp_path / "broken")


@pytest.mark.parametrize("kind", ["Binary", "ASCII"])
def test_broken_vtk_gives_one_line(tmp_path, grid, kind):
    writer = vtk.vtkStructuredPointsWriter()
    writer.SetFileName(str(tmp_path / "a.vtk"))
    writer.SetInputData(vtk_image(grid))
    getattr(writer, f"SetFileTypeTo{kind}")()
    writer.Write()
    assert_robust(tmp_path / "a.vtk", tmp_path / "broken", min_refused=8)


def vti_of_text(path, arrays: str, before: str = ""):
    """Writes a VTK image of 3 x 3 x 3 points whose numbers are inline in the XML."""
    extent = "0 2 0 2 0 2"
    path.write_text(
        f'<VTKFile type="ImageData"><ImageData WholeExtent="{extent}">{before}'
        f'<Piece Extent="{extent}"><PointData>{arrays}</PointData></Piece></ImageData></VTKFile>'
    )
    return path


NUMBERS = " ".join(map(str, range(27)))
ARRAY = '<DataArray type="UInt8" Name="{}" format="ascii">{}</DataArray>'


@pytest.mark.parametrize(
    "before",
    [
        f"<FieldData>{ARRAY.format('TimeValue', '0')}</FieldData>",
        f"<!-- {ARRAY.format('old', '7 ' * 27)} -->",
    ],
)
def test_numbers_of_vtk_are_found_behind_others(tmp_path, before):
    """ParaView writes the time before the image's array."""
    path = vti_of_text(tmp_path / "a.vti", ARRAY.format("a>b", NUMBERS), before)
    assert gv.read_volume(path).data.ravel().tolist() == list(range(27))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (NUMBERS.replace("26", "300"), "numbers that uint8 does not"),
        (NUMBERS.replace("26", "-1"), "numbers that uint8 does not"),
        (NUMBERS.replace("26", "2_6"), "words that are not numbers"),
        (NUMBERS + " 27", "27 numbers expected, got more"),
        ("1", "27 numbers expected, got 1 bytes"),
    ],
)
def test_words_of_vtk_that_are_other_numbers_are_refused(tmp_path, numbers, message):
    """300 was once read as 44."""
    with pytest.raises(ValueError, match=rf"a\.vti: .*{message}"):
        gv.read_volume(vti_of_text(tmp_path / "a.vti", ARRAY.format("a", numbers)))


def legacy_vtk(path, points: int, numbers: str, kind: str = "SCALARS a unsigned_char"):
    head = "# vtk DataFile Version 3.0\na\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 3 3 3\n"
    path.write_text(f"{head}POINT_DATA {points}\n{kind} 1\n{numbers}\n")
    return path


def test_legacy_vtk_that_contradicts_itself_is_refused(tmp_path):
    path = tmp_path / "a.vtk"
    assert gv.read_volume(legacy_vtk(path, 27, NUMBERS)).data.ravel().tolist() == list(range(27))
    with pytest.raises(ValueError, match="'POINT_DATA 99' of a grid that has 27"):
        gv.read_volume(legacy_vtk(path, 99, NUMBERS))
    with pytest.raises(ValueError, match="colours that are NaN or infinite"):
        gv.read_volume(legacy_vtk(path, 27, "nan " * 27, "COLOR_SCALARS a"))


@pytest.mark.parametrize("repeated", [b"<AppendedData ", b"<VTKFile><!--" + b"<DataArray "])
def test_tags_of_vtk_that_never_end_take_no_time(tmp_path, repeated):
    (tmp_path / "a.vti").write_bytes(b'<VTKFile type="ImageData">' + repeated * 200_000)
    begin = time.process_time()
    with pytest.raises(ValueError, match=r"a\.vti: "):
        gv.read_volume(tmp_path / "a.vti")
    assert time.process_time() - begin < 3


def test_a_line_of_vtk_without_end_takes_no_memory(tmp_path):
    with legacy_vtk(tmp_path / "a.vtk", 27, NUMBERS).open("r+b") as file:
        file.truncate(1 << 29)  # a hole of zeros
        file.seek(0, 2)
        file.write(b"\n")
    tracemalloc.start()
    assert gv.read_volume(tmp_path / "a.vtk").extent == (3, 3, 3)
    assert tracemalloc.get_traced_memory()[1] < 1 << 27
    tracemalloc.stop()
