"""Small files that claim more than a machine has, or never end: each is refused in one line, with
little memory and time, and `convert` reports what `read_volume` reports.
"""

from __future__ import annotations

import base64
import bz2
import gzip
import json
import os
import resource
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import hostile, slowness

import gvtorch as gv
from gvtorch.io import budget, mesh_file, resources
from gvtorch.io.picture_size import picture_size

MEMORY = 1500 << 20  # bytes of address space beyond what the libraries use
SECONDS = 8  # of processor time a file, on a machine that is not busy

READER = """
import json, resource, sys, time, warnings
import gvtorch as gv
from gvtorch.io import budget
from gvtorch.io.stores import conversion_plan
from gvtorch.io.reading import open_source
warnings.simplefilter("ignore")
paths, memory, slowness = json.loads(sys.stdin.read())
budget.SECONDS, budget.SECONDS_A_BYTE = 0.3 * slowness, 0
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + memory, -1))

def convert(path):
    source = conversion_plan.source_of(path, None, None, None, None, False, {})
    source.read_region((0, 0, 0), source.extent[::-1])

for path in paths:
    told = []
    for read in (gv.read_volume, convert):
        begin = time.process_time()
        try:
            read(path)
            told += ["read", ""]
        except (ValueError, OSError) as error:
            told += ["refused", str(error)]
        except BaseException as error:
            told += [type(error).__name__, str(error)]
        told.append(time.process_time() - begin)
    print(json.dumps(told), flush=True)
"""
HONEST = ("cards.fits", "tiles.tif")  # wasteful, but valid


def test_files_that_eat_a_machine_are_refused(tmp_path):
    paths, slow = hostile.write_all(tmp_path), slowness()
    run = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", READER],
        input=json.dumps([[str(path) for path in paths], MEMORY, slow]),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("[")]
    failed = paths[len(lines)].name if len(lines) < len(paths) else ""
    assert run.returncode == 0 and not failed, f"{failed}: {run.returncode} {run.stderr[-2000:]}"
    for path, (kind, message, seconds, other, _, more) in zip(paths, lines, strict=True):
        assert kind == other == ("read" if path.name in HONEST else "refused"), (path.name, message)
        assert kind == "read" or ("\n" not in message and str(tmp_path) in message), message
        assert "MemoryError" not in message and "allocate" not in message, message
        assert max(seconds, more) < SECONDS * slow, (path.name, seconds, more)


def test_what_is_larger_than_memory_is_told_before(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", np.zeros((100, 100, 100), np.uint8))
    np.save(tmp_path / "b.npy", np.zeros((100, 100, 100), np.uint8))
    monkeypatch.setattr(resources, "memory_free", lambda: 10**6)
    with pytest.raises(ValueError, match=r"a\.npz: takes 2\.0 MB of memory, 1\.0 MB are free"):
        gv.read_volume(tmp_path / "a.npz")
    assert gv.read_volume(tmp_path / "b.npy").extent == (100, 100, 100)  # it stays in its file


@pytest.mark.parametrize("encoding", ["gzip", "bzip2", "text", "raw"])
@pytest.mark.parametrize("lines", [0, 2])
def test_nrrd_data_behind_lines_and_bytes(tmp_path, encoding, lines):
    data = np.arange(24, dtype="<i2").reshape(2, 3, 4)
    numbers = " ".join(map(str, data.ravel())).encode()
    packed = {
        "gzip": lambda: gzip.compress(b"ab" + data.tobytes()),
        "bzip2": lambda: bz2.compress(b"ab" + data.tobytes()),
        "text": lambda: b"  " + numbers,
        "raw": lambda: b"ab" + data.tobytes(),
    }[encoding]()
    Path(tmp_path / "a.nrrd").write_bytes(
        f"NRRD0004\ntype: short\ndimension: 3\nsizes: 4 3 2\nencoding: {encoding}\nendian: little\n"
        f"line skip: {lines}\nbyte skip: 2\n\n".encode()
        + b"a line\n" * lines
        + packed
    )
    assert np.array_equal(gv.read_volume(tmp_path / "a.nrrd").data[..., 0].numpy(), data)


def test_nrrd_data_at_the_end_whatever_lines_come_before(tmp_path):
    data = np.arange(24, dtype="u1").reshape(2, 3, 4)
    Path(tmp_path / "a.nrrd").write_bytes(
        b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 4 3 2\nencoding: raw\nline skip: 1\n"
        b"byte skip: -1\n\na line\nabc" + data.tobytes()
    )
    assert np.array_equal(gv.read_volume(tmp_path / "a.nrrd").data[..., 0].numpy(), data)


@pytest.mark.parametrize("kind", ["mesh", "points"])
def test_meshes_and_points_unpack_to_no_more_than_free_memory(tmp_path, monkeypatch, kind):
    if kind == "mesh":
        file, read = tmp_path / "a.obj.gz", gv.read_mesh
        file.write_bytes(gzip.compress(b"v 1 2 3\n" * 10**5))
    else:
        file, read = tmp_path / "a.npz", gv.read_points
        np.savez_compressed(file, position=np.zeros((10**5, 3), np.float32))
    assert file.stat().st_size < 10_000
    for module in (resources, mesh_file):
        monkeypatch.setattr(module, "memory_free", lambda: 10**6)
    with pytest.raises(ValueError, match=r"(unpacks to|takes) .*memory") as caught:
        read(file)
    assert "\n" not in str(caught.value)


def fits_table(columns: list[str], rows: int, width: int, data: bytes) -> bytes:
    """Returns a FITS file of an empty image and a table with the given header values."""
    cards = ["XTENSION= 'BINTABLE'", "BITPIX  = 8", "NAXIS   = 2", f"NAXIS1  = {width}"]
    cards += [f"NAXIS2  = {rows}", "PCOUNT  = 0", "GCOUNT  = 1", f"TFIELDS = {len(columns)}"]
    for column, kind in enumerate(columns, 1):
        cards += [f"TTYPE{column}  = '{'xyzw'[column - 1]}'", f"TFORM{column}  = '{kind}'"]
    head = "".join(card.ljust(80) for card in [*cards, "END"])
    return hostile.fits(["BITPIX  = 8", "NAXIS   = 0"]) + head.ljust(2880).encode() + data


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz", "a.fit"])
def test_a_table_of_points_is_read_as_far_as_its_header_tells(tmp_path, name):
    pytest.importorskip("astropy")
    write = gzip.compress if name == "a.fits.gz" else bytes
    rows = np.arange(30, dtype=">f4").reshape(10, 3)
    honest = fits_table(["1E"] * 3, 10, 12, rows.tobytes().ljust(2880, b"\0"))
    (tmp_path / name).write_bytes(write(honest))
    assert np.array_equal(gv.read_points(tmp_path / name).positions, rows)
    message = "its rows take 13194139533312" if name == "a.fits.gz" else "may have been truncated"
    for count in (2**40, 2**62):
        (tmp_path / name).write_bytes(write(fits_table(["1E"] * 3, count, 12, bytes(2880))))
        with pytest.raises(ValueError, match=f"{message}|cannot fit 'int'") as error:
            gv.read_points(tmp_path / name)
        assert "\n" not in str(error.value)
    lists = fits_table(["1E", "1E", "1E", "1PE(9)"], 1, 20, bytes(2880))
    (tmp_path / name).write_bytes(write(lists))
    assert len(gv.read_points(tmp_path / name)) == 1


@pytest.mark.parametrize("damage", ["bomb", "no end"])
def test_a_packed_table_of_points_eats_no_memory(tmp_path, damage, monkeypatch):
    pytest.importorskip("astropy")
    monkeypatch.setattr(budget, "SECONDS", 0.3)
    monkeypatch.setattr(budget, "MEMORY", 10**8)
    begin = hostile.fits(["BITPIX  = 8", "NAXIS   = 1", "NAXIS1  = 500000000000"])
    if damage == "no end":
        begin = b"SIMPLE  =                    T".ljust(2880)
    blank = gzip.compress(b" " * (1 << 24), 1)
    (tmp_path / "a.fits.gz").write_bytes(gzip.compress(begin) + blank * 60)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"a\.fits\.gz: ") as caught:
        gv.read_points(tmp_path / "a.fits.gz")
    assert "\n" not in str(caught.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000


def test_a_name_does_not_tell_how_fits_is_packed(tmp_path):
    """A packed file's values were once read from the packed bytes themselves."""
    fits = pytest.importorskip("astropy.io.fits")
    data = np.random.default_rng(0).integers(0, 255, (20, 20, 20), np.uint8)
    fits.PrimaryHDU(data).writeto(tmp_path / "b.fits")
    content = (tmp_path / "b.fits").read_bytes()
    (tmp_path / "a.fits").write_bytes(gzip.compress(content))
    (tmp_path / "b.fits.gz").write_bytes(content)
    for name in ("a.fits", "b.fits.gz"):
        assert np.array_equal(gv.read_volume(tmp_path / name).data[..., 0].numpy(), data)
    for read in (gv.read_volume, gv.read_points):
        (tmp_path / "c.fits").write_bytes(bz2.compress(content))
        with pytest.raises(ValueError, match=r"c\.fits: is not a FITS file"):
            read(tmp_path / "c.fits")


@pytest.mark.parametrize("name", ["a.pvcc", "a.json", "a.ply", "a.obj.gz", "a.npz"])
def test_a_pipe_is_no_file_of_cameras_meshes_or_points(tmp_path, name):
    """Reading a pipe would wait forever."""
    os.mkfifo(tmp_path / name)
    readers = [gv.read_cameras, gv.CameraPath.from_json, gv.TransferFunction.from_file]
    readers += [gv.read_mesh] * name.startswith(("a.ply", "a.obj"))
    readers += [gv.read_points] * name.endswith(("ply", "npz"))
    for read in readers:
        with pytest.raises((FileNotFoundError, ValueError)):
            read(tmp_path / name)


def gltf(**other: object) -> dict[str, object]:
    """Returns a triangle in glTF, in which some fields are replaced."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    content = base64.b64encode(positions + np.arange(3, dtype="<u4").tobytes()).decode()
    buffer = {"uri": f"data:application/octet-stream;base64,{content}", "byteLength": 48}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "buffers": [buffer],
        "bufferViews": [VIEW, {"buffer": 0, "byteOffset": 36, "byteLength": 12}],
        "accessors": [POSITIONS, {**POSITIONS, "bufferView": 1, "componentType": 5125}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        **other,
    }


VIEW = {"buffer": 0, "byteOffset": 0, "byteLength": 36}
POSITIONS = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
ACCESSORS = {
    "billions": {**POSITIONS, "count": 10**9},
    "without numbers": {k: v for k, v in POSITIONS.items() if k != "bufferView"} | {"count": 10**9},
    "before": {**POSITIONS, "byteOffset": -36},
    "less than none": {**POSITIONS, "count": -1},
    "sparse": {**POSITIONS, "sparse": {"count": 1}},
}


@pytest.mark.parametrize("name", ACCESSORS)
def test_what_a_gltf_tells_of_is_there(tmp_path, name):
    """Trimesh replaces missing data by zeros: 24 GB, or another picture."""
    pytest.importorskip("trimesh")
    file = tmp_path / "a.gltf"
    indices = {**POSITIONS, "bufferView": 1, "componentType": 5125, "type": "SCALAR"}
    file.write_text(json.dumps(gltf(accessors=[POSITIONS, indices])))
    assert len(gv.read_mesh(file).faces) == 1
    file.write_text(json.dumps(gltf(accessors=[ACCESSORS[name], indices])))
    with pytest.raises(ValueError, match=r"a\.gltf: can't be read as gltf: accessor 0 (has|is)"):
        gv.read_mesh(file)
    view = {**VIEW, "byteOffset": -12}
    file.write_text(json.dumps(gltf(accessors=[POSITIONS, indices], bufferViews=[view, VIEW])))
    with pytest.raises(ValueError, match=r"a part of a buffer lies before its start"):
        gv.read_mesh(file)


@pytest.mark.filterwarnings("ignore:Image size")
@pytest.mark.parametrize("kind", ["obj", "--texture"])
def test_textures_that_eat_a_machine_are_refused(tmp_path, kind):
    """160 kB of pixels unpack to 676 MB, and need more meanwhile; a file has twenty of them."""
    pytest.importorskip("trimesh")
    (tmp_path / "a.png").write_bytes(hostile.png(13000, 13000))
    names, texture = [f"m{n}" for n in range(20)], None
    lines = [f"newmtl {name}\nmap_Kd a.png" for name in names]
    if kind == "--texture":
        lines, texture = [], tmp_path / "a.png"
    (tmp_path / "a.mtl").write_text("\n".join(lines))
    faces = "".join(f"usemtl {name}\nf 1/1 2/1 3/1\n" for name in names)
    text = f"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n{faces}"
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(ValueError, match=r"textures take .* GB of memory, at most") as caught:
        gv.read_mesh(tmp_path / "a.obj", texture=texture)
    assert "\n" not in str(caught.value)


def test_a_mesh_reads_no_more_than_memory_takes(tmp_path, monkeypatch):
    pytest.importorskip("trimesh")
    with (tmp_path / "a.bin").open("wb") as file:
        file.truncate(10**7)
    (tmp_path / "a.gltf").write_text(json.dumps(gltf(buffers=[{"uri": "a.bin"}])))
    (tmp_path / "a.stl").write_bytes(bytes(10**7))
    monkeypatch.setattr(resources, "memory_free", lambda: 10**7)
    with pytest.raises(ValueError, match=r"names a\.bin: takes 40\.0 MB of memory, 10\.0 MB are"):
        gv.read_mesh(tmp_path / "a.gltf")
    with pytest.raises(ValueError, match=r"a\.stl: takes 40\.0 MB of memory, 10\.0 MB are free"):
        gv.read_mesh(tmp_path / "a.stl")


def test_a_ply_of_fewer_than_no_rows_is_refused(tmp_path):
    """Bytes of its header were once read as points."""
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"element a -4\nproperty float b\nelement vertex 3\n{names}end_header\n"
    file = tmp_path / "a.ply"
    file.write_bytes(f"ply\nformat binary_little_endian 1.0\n{head}".encode() + bytes(36))
    with pytest.raises(ValueError, match=r"a\.ply: .*it declares -4 of a"):
        gv.read_points(file)


@pytest.mark.parametrize("kind", ["external", "virtual", "link", "soft link", "behind another"])
def test_hdf5_reads_regular_files_beside_it(tmp_path, kind):
    """A pipe has no end, and a file must not name other folders."""
    h5py = pytest.importorskip("h5py")
    data = np.arange(512, dtype=np.uint8).reshape(8, 8, 8)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "raw").write_bytes(data.tobytes())
    for name in ("in/other.h5", "far.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            file["a"] = data

    def write(file: Path, name: str) -> None:
        with h5py.File(file, "w") as root:
            if kind == "external":
                root.create_dataset("a", data.shape, "u1", external=[(name, 0, 512)])
            elif kind in ("virtual", "behind another"):
                layout = h5py.VirtualLayout(data.shape, "u1")
                layout[:] = h5py.VirtualSource(name, "a", data.shape)
                root.create_virtual_dataset("a", layout)
            else:
                root["b" if kind == "soft link" else "a"] = h5py.ExternalLink(name, "/a")
                if kind == "soft link":
                    root["a"] = h5py.SoftLink("/b")

    file = tmp_path / "in" / "a.h5"
    external = str(tmp_path / "in" / "raw") if kind == "external" else "other.h5"
    write(file, external)
    assert np.array_equal(gv.read_volume(file, key="a", axes="zyx").data[..., 0].numpy(), data)
    (tmp_path / "in" / "pipe.h5").symlink_to("../pipe")
    os.mkfifo(tmp_path / "in" / "own")
    for name in ("../pipe", "pipe.h5", "../far.h5", str(tmp_path / "in" / "own")):
        write(file, str(tmp_path / "in" / name) if kind == "external" else name)
        if kind == "behind another":
            write(tmp_path / "in" / "other.h5", name)
            write(file, "other.h5")
        with pytest.raises(ValueError, match=r"is in another folder|is not a regular file"):
            gv.read_volume(file, key="a", axes="zyx")


@pytest.mark.parametrize("kind", ["behind another", "numbered files", "numbered data sets"])
def test_hdf5_virtual_data_sets_do_not_lead_elsewhere(tmp_path, kind):
    """By way of another of the same file, or by a pattern for names, %b, that HDF5 expands."""
    h5py = pytest.importorskip("h5py")
    data = np.arange(512, dtype=np.uint8).reshape(8, 8, 8)
    (tmp_path / "in").mkdir()
    with h5py.File(tmp_path / "far0.h5", "w") as file:
        file["b0"] = data
    with h5py.File(tmp_path / "in" / "a.h5", "w") as root:
        layout = h5py.VirtualLayout(data.shape, "u1")
        layout[:] = h5py.VirtualSource("../far0.h5", "b0", data.shape)
        root.create_virtual_dataset("b0", layout)
        file_name = b"../far%b.h5" if kind == "numbered files" else b"."
        name = {"behind another": b"b0", "numbered files": b"b0"}.get(kind, b"b%b")
        space = h5py.h5s.create_simple(data.shape, (h5py.h5s.UNLIMITED, 8, 8))
        count = (1 if name == b"b0" and file_name == b"." else h5py.h5s.UNLIMITED, 1, 1)
        space.select_hyperslab((0, 0, 0), count, data.shape, data.shape)
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_virtual(space, file_name, name, h5py.h5s.create_simple(data.shape))
        h5py.h5d.create(root.id, b"a", h5py.h5t.STD_U8LE, space, settings)
    with pytest.raises(ValueError, match=r"is in another folder|names with % are not read"):
        gv.read_volume(tmp_path / "in" / "a.h5", key="a", axes="zyx")


def test_hdf5_reads_coordinates_of_files_beside_it(tmp_path):
    """Those of a dimension scale, which may be a virtual data set as well."""
    h5py = pytest.importorskip("h5py")
    (tmp_path / "in").mkdir()
    for name in ("in/other.h5", "far.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            file["b"] = np.arange(8.0) * 3
    file = tmp_path / "in" / "a.h5"
    for name in ("other.h5", "../far.h5"):
        with h5py.File(file, "w") as root:
            root["a"] = np.zeros((8, 8, 8), np.uint8)
            layout = h5py.VirtualLayout((8,), "f8")
            layout[:] = h5py.VirtualSource(name, "b", (8,))
            root.create_virtual_dataset("x", layout).make_scale("x")
            root["a"].dims[2].attach_scale(root["x"])
        if name == "other.h5":
            assert gv.read_volume(file, key="a", axes="zyx").spacing[0] == 3
    with pytest.raises(ValueError, match=r"a\.h5: names \S*far\.h5, which is in another folder"):
        gv.read_volume(file, key="a", axes="zyx")


def picture_in_tiff(
    folder: Path, packed: bytes, number: int, *, color: bool = False, tiled: bool = True
) -> Path:
    """Writes a TIFF of 16 x 16 whose only tile, or strip, is a packed picture."""
    tiles = [(322, 3, 1, 16), (323, 3, 1, 16), (324, 4, 1, 0), (325, 4, 1, len(packed))]
    strip = [(278, 3, 1, 16), (279, 4, 1, len(packed))]
    tags = [(256, 3, 1, 16), (257, 3, 1, 16), (259, 3, 1, number), (277, 3, 1, 1 + 2 * color)]
    tags += [(262, 3, 1, 2)] * color + (tiles if tiled else strip)
    head = hostile.tiff(tags, pixels=0)
    offset = head.index(struct.pack("<HHI", 324 if tiled else 273, 4, 1)) + 8
    head = head[:offset] + struct.pack("<I", len(head)) + head[offset + 4 :]
    (folder / "a.tif").write_bytes(head + packed)
    return folder / "a.tif"


@pytest.mark.parametrize(
    ("codec", "number"),
    [
        ("png", 34933), ("jpeg", 7), ("jpeg2k", 34712), ("jpegxr", 34934), ("jpegxl", 50002),
        ("webp", 50001), ("lerc", 34887),
    ],
)  # fmt: skip
@pytest.mark.parametrize("tiled", [True, False])
def test_a_picture_larger_than_its_tile_is_refused(tmp_path, codec, number, tiled):
    """It was once unpacked as a whole, and cropped to a strip."""
    imagecodecs = pytest.importorskip("imagecodecs")
    color = codec == "webp"
    encode = getattr(imagecodecs, f"{codec}_encode")

    def write(rows: int) -> Path:
        packed = bytes(encode(np.full((rows, 16, 3)[: 2 + color], 7, np.uint8)))
        return picture_in_tiff(tmp_path, packed, number, color=color, tiled=tiled)

    data = gv.read_volume(write(16)).data.numpy()
    assert data.shape == (1, 16, 16, 3 if color else 1) and np.abs(data - 7.0).max() <= 1
    with pytest.raises(ValueError, match="picture of 400 rows and 16 columns, more than its 16 an"):
        gv.read_volume(write(400))


def test_a_strip_of_jpeg_is_no_taller_than_it_says(tmp_path):
    """Not even by a whole block: such rows were once dropped silently."""
    imagecodecs = pytest.importorskip("imagecodecs")
    packed = imagecodecs.jpeg_encode(np.full((24, 16), 7, np.uint8))
    with pytest.raises(ValueError, match="picture of 24 rows and 16 columns, more than its 16 and"):
        gv.read_volume(picture_in_tiff(tmp_path, packed, 7, tiled=False))


def test_a_film_in_a_tile_is_refused(tmp_path):
    """All its pictures would be unpacked, one after the other."""
    imagecodecs = pytest.importorskip("imagecodecs")
    film = np.arange(5 * 16 * 16, dtype=np.uint8).reshape(5, 16, 16)
    for some, usual in ((film[:1], True), (film, False)):
        for packed in (imagecodecs.jpegxl_encode(some), in_parts(imagecodecs.jpegxl_encode(some))):
            assert imagecodecs.jpegxl_decode(packed).shape[-2:] == (16, 16)
            assert picture_size(packed) == ((16, 16) if usual else None)
            if not usual:
                with pytest.raises(
                    ValueError, match="tile 0 is not a picture whose size can be read"
                ):
                    gv.read_volume(picture_in_tiff(tmp_path, packed, 50002))


def in_parts(codestream: bytes) -> bytes:
    """Returns JPEG XL in boxes, the first of which ends within the header."""
    if codestream[:2] != b"\xff\x0a":
        return codestream
    parts = (b"\0\0\0\0" + codestream[:5], b"\x80\0\0\x01" + codestream[5:])
    boxes = [b"\0\0\0\x0cJXL \r\n\x87\n", b"\0\0\0\x14ftypjxl \0\0\0\0jxl "]
    boxes += [struct.pack(">I", 8 + len(part)) + b"jxlp" + part for part in parts]
    return b"".join(boxes)


def test_forged_heads_of_pictures_tell_no_size():
    """A second frame of JPEG, and boxes of JPEG 2000 that hide which codestream is unpacked."""
    imagecodecs = pytest.importorskip("imagecodecs")
    small, large = (np.zeros((n, n), np.uint8) for n in (16, 4000))
    head, second = (imagecodecs.jpeg_encode(data) for data in (small, large))
    frames = [data[(start := data.index(b"\xff\xc0")) : start + 13] for data in (head, second)]
    assert picture_size(head) == (16, 16)
    assert picture_size(head.replace(frames[0], b"".join(frames))) is None
    head, second = (imagecodecs.jpeg2k_encode(data, codecformat="jp2") for data in (small, large))
    codestream = second.index(b"jp2c") - 4
    first = head.index(b"jp2c") - 4
    assert picture_size(head) == (16, 16) and picture_size(second) == (4000, 4000)
    # The size is that of the codestream, whatever the header before claims.
    assert picture_size(head[:first] + second[codestream:]) == (4000, 4000)
    # A box with a length of 64 bits, and one without an end.
    wide = struct.pack(">I4sQ", 1, b"free", 16 + 40) + head[first : first + 40]
    assert picture_size(head[:first] + wide + second[codestream:]) == (4000, 4000)
    endless = struct.pack(">I4s", 0, b"free") + head[first:]
    assert picture_size(head[:first] + endless) is None


@pytest.mark.parametrize("name", ["NDTiff.index", "a_MMStack_1.ome.tif"])
def test_a_stack_of_micromanager_reads_its_own_folder(tmp_path, name):
    """Its index names files, and files of similar names are opened."""
    text = b'{"MajorVersion": 3}\0'
    (tmp_path / "in").mkdir()
    file = tmp_path / "in" / "a_MMStack.ome.tif"
    file.write_bytes(hostile.tiff([(51123, 2, len(text), text)]))
    with pytest.warns(UserWarning, match="failed to read summary"):
        assert gv.read_volume(file).extent == (8, 8, 1)
    os.mkfifo(tmp_path / "pipe")
    if name == "NDTiff.index":
        axes, other = b'{"z": 0}', b"../pipe"
        entry = struct.pack("<I", len(axes)) + axes + struct.pack("<I", len(other)) + other
        (tmp_path / "in" / name).write_bytes(entry + struct.pack("<IiiiiIii", 0, 8, 8, *[0] * 5))
    else:
        (tmp_path / "in" / name).symlink_to("../pipe")
    with pytest.raises(ValueError, match="is in another folder"):
        gv.read_volume(file)


@pytest.mark.parametrize("kind", ["mhd", "nhdr", "ome.tif"])
def test_what_a_header_names_is_a_regular_file(tmp_path, kind):
    """A pipe has no end. Headers of detached data may name files of any folder, which is their
    purpose; OME-XML may name only files of its own folder.
    """
    data = np.arange(64, dtype=np.uint8).reshape(4, 4, 4)
    (tmp_path / "in").mkdir()
    for name in ("in/own.raw", "far.raw"):
        (tmp_path / name).write_bytes(data.tobytes())
    os.mkfifo(tmp_path / "in" / "pipe")
    (tmp_path / "in" / "link").symlink_to("../far.raw")
    file = tmp_path / "in" / f"a.{kind}"

    def write(name: str) -> None:
        if kind == "mhd":
            text = "NDims = 3\nDimSize = 4 4 4\nElementType = MET_UCHAR\n"
            text += f"ElementDataFile = {name}"
        else:
            text = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 4 4\nencoding: raw\n"
            text += f"data file: {name}\n\n"
        ids = (
            '<TiffData IFD="0" FirstZ="{}" PlaneCount="1"><UUID FileName="{}">{}</UUID></TiffData>'
        )
        ifds = ids.format(0, file.name, 0) + ids.format(1, name.replace(".", "&#46;"), 1)
        file.write_bytes(hostile.ome(2, 1, ifds) if kind == "ome.tif" else text.encode())

    if kind != "ome.tif":
        write("own.raw")
        assert sorted(gv.read_volume(file).data.flatten().tolist()) == [*range(64)]
    for name in ("../far.raw", "link", str(tmp_path / "far.raw"), "pipe"):
        write(name)
        if kind != "ome.tif" and name != "pipe":
            assert sorted(gv.read_volume(file).data.flatten().tolist()) == [*range(64)]
            continue
        with pytest.raises(ValueError, match=r"is in another folder|is not a regular file"):
            gv.read_volume(file)


def test_a_small_packed_nifti_takes_no_memory(tmp_path):
    """100 bytes once took two gigabytes before they were recognised as too few."""
    nibabel = pytest.importorskip("nibabel")
    head = bytearray(nibabel.Nifti1Image(np.zeros((4, 4, 4), np.uint8), np.eye(4)).to_bytes())
    struct.pack_into("<3h", head, 42, 2000, 2000, 500)
    file = tmp_path / "a.nii.gz"
    file.write_bytes(gzip.compress(bytes(head)))
    with pytest.raises(ValueError, match=r"takes 2000000000 bytes, which \d+ can't unpack to"):
        gv.read_volume(file)


@pytest.mark.parametrize("kind", ["mha", "nrrd"])
@pytest.mark.parametrize("number", [300, -1, 10**30])
def test_text_holds_only_numbers_of_its_type(tmp_path, kind, number):
    """300 was once read as 44."""
    heads = {
        "mha": "NDims = 3\nDimSize = 4 4 4\nElementType = MET_UCHAR\nBinaryData = False\n"
        "ElementDataFile = LOCAL\n",
        "nrrd": "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 4 4\nencoding: text\n\n",
    }
    file = tmp_path / f"a.{kind}"
    file.write_text(heads[kind] + "0 " * 63 + str(number))
    with pytest.raises(ValueError, match=r"holds numbers that uint8 does not"):
        gv.read_volume(file)


def test_nrrd_of_an_unknown_order_of_bytes_is_refused(tmp_path):
    head = "NRRD0004\ntype: short\ndimension: 3\nsizes: 4 4 4\nencoding: raw\nendian: middle\n\n"
    (tmp_path / "a.nrrd").write_bytes(head.encode() + bytes(128))
    with pytest.raises(ValueError, match="endian 'middle' is neither little nor big"):
        gv.read_volume(tmp_path / "a.nrrd")


def test_names_of_axes_lead_to_no_other_folder(tmp_path):
    """Coordinates of an axis are read only from the array of its name in the same folder."""
    zarr = pytest.importorskip("zarr")
    for folder, name, step in (("in", "z", 3), ("", "z", 5)):
        along = zarr.create_array(tmp_path / folder / name, shape=(4,), dtype="f4")
        along[:] = np.arange(4) * step
    for name, spacing in (("z", 3), ("../z", 1), (str(tmp_path / "z"), 1)):
        names = (name, "y", "x")
        array = zarr.create_array(
            tmp_path / "in" / "a",
            shape=(4, 4, 4),
            dtype="u1",
            dimension_names=names,
            overwrite=True,
        )
        array[:] = 1
        volume = gv.read_volume(tmp_path / "in" / "a", axes="zyx")
        assert volume.spacing == (1, 1, spacing), name
