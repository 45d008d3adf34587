"""Forged pictures as input: each is read correctly or refused in one line, with little memory, and
the libraries that read them write nothing to the terminal.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import hostile
from helpers.damage import break_file

import gvtorch as gv
from gvtorch.io.picture_size import has_jpeg_end

MEMORY = 1 << 30  # bytes of address space beyond what the libraries use

READER = """
import json, resource, sys
import gvtorch as gv
paths, memory = json.loads(sys.stdin.read())
for path in paths[:4]:
    gv.read_image(path)  # the libraries are there from now on
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + memory, -1))
for path in paths:
    try:
        told = ["read", str(tuple(gv.read_image(path).shape))]
    except ValueError as error:
        told = ["refused", str(error)]
    except BaseException as error:
        told = [type(error).__name__, str(error)]
    print(json.dumps(told), flush=True)
"""


def png(columns: int, rows: int, bits: int, kind: int, pixels: bytes) -> bytes:
    def part(name: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + content))
        return struct.pack(">I", len(content)) + name + content + check

    head = struct.pack(">IIBBBBB", columns, rows, bits, kind, 0, 0, 0)
    packed = zlib.compress(pixels)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", packed) + part(b"IEND", b"")


def npy(shape: str, dtype: str) -> bytes:
    head = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0v\0" + head.ljust(117) + b"\n" + bytes(2000)


def honest(folder: Path) -> dict[str, Path]:
    values = np.random.default_rng(0).random((8, 9, 3)).astype(np.float32)
    paths = {end: folder / f"a.{end}" for end in ("png", "npy", "tif", "exr")}
    rows = b"".join(b"\0" + row.tobytes() for row in (values * 255).astype(np.uint8))
    paths["png"].write_bytes(png(9, 8, 8, 2, rows))
    np.save(paths["npy"], values)
    tifffile, exr = pytest.importorskip("tifffile"), pytest.importorskip("OpenEXR")
    tifffile.imwrite(paths["tif"], values)
    with exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage},
                  {"RGB": values}) as file:  # fmt: skip
        file.write(str(paths["exr"]))
    for end in ("npy", "tif", "exr"):
        assert np.array_equal(gv.read_image(paths[end]).numpy(), values)
    return paths


def forged(content: dict[str, bytes]) -> dict[str, bytes]:
    """Returns files by name, none of which is a valid picture."""
    files = {}
    for columns, rows in ((2**31 - 1, 2**31 - 1), (30_000, 30_000), (1, 2**31 - 1), (0, 5)):
        for bits, kind in ((8, 2), (16, 6), (16, 0)):
            files[f"{columns}x{rows}.{bits}.{kind}.png"] = png(columns, rows, bits, kind, b"1234")
        files[f"{columns}x{rows}.tif"] = hostile.tiff([(256, 4, 1, columns), (257, 4, 1, rows)])
        box = content["exr"].index(b"dataWindow\0box2i\0") + 21
        files[f"{columns}x{rows}.exr"] = (
            content["exr"][:box]
            + struct.pack("<4i", 0, 0, columns - 1, rows - 1)
            + content["exr"][box + 16 :]
        )
    for name, bytes_of in hostile.tiff_files().items():
        files[f"told.{name}"] = bytes_of
    for number, shape in enumerate(
        ("(1000000, 1000000, 3)", "(50000, 20000, 3)", "(-1, 5, 3)", "()")
    ):
        for kind in ("'<f4'", "'|O'", "'<c8'", "'|b1'"):
            files[f"{number}.{kind.strip(chr(39))[1:]}.npy"] = npy(shape, kind)
    files["zip.npy"] = b"PK\x03\x04" + bytes(100)
    files["parts.exr"] = content["exr"][:5] + b"\x10" + content["exr"][6:]
    files["cut.exr"] = content["exr"][:-300]
    files["cut.png"] = content["png"][:-20]
    return files


@pytest.mark.long
def test_forged_pictures_are_refused_in_a_line(tmp_path):
    """A PNG of 69 bytes once ended the process, a ZIP as NPY gave a traceback, an EXR 3 lines."""
    whole = honest(tmp_path)
    content = {end: path.read_bytes() for end, path in whole.items()}
    paths = [*whole.values()]
    for name, bytes_of in forged(content).items():
        paths.append(tmp_path / f"forged.{name}")
        paths[-1].write_bytes(bytes_of)
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.npy").mkdir()
    paths += [tmp_path / "pipe.png", tmp_path / "folder.npy"]
    for end, bytes_of in content.items():
        for number in range(40):
            paths.append(tmp_path / f"broken{number}.{end}")
            paths[-1].write_bytes(break_file(bytes_of, number))
    run = subprocess.run(
        [sys.executable, "-X", "faulthandler", "-c", READER],
        input=json.dumps([[str(path) for path in paths], MEMORY]),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("[")]
    failed = paths[len(lines)].name if len(lines) < len(paths) else ""
    assert run.returncode == 0, f"ended at {failed}: {run.stderr[-2000:]}"
    assert run.stderr == "" and len(run.stdout.splitlines()) == len(lines), run.stderr[:2000]
    for path, (kind, message) in zip(paths, lines, strict=True):
        broken = path.name.startswith("broken")
        allowed = (
            ("read", "refused") if broken else ("read",) if path in whole.values() else ("refused",)
        )
        assert kind in allowed, (path.name, kind, message)
        assert "\n" not in message and len(message) < 1700
        assert kind == "read" or str(path) in message, message


def test_a_volume_is_no_picture_and_planes_of_colour_are(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    planes = np.random.default_rng(0).integers(0, 256, (3, 6, 9), np.uint8)
    options = {"photometric": "rgb", "planarconfig": "separate"}
    tifffile.imwrite(tmp_path / "planes.tif", planes, **options)
    tifffile.imwrite(tmp_path / "pixels.tif", planes.transpose(1, 2, 0), photometric="rgb")
    pixels, as_planes = (gv.read_image(tmp_path / f"{n}.tif") for n in ("pixels", "planes"))
    assert pixels.shape == (6, 9, 3) and torch.equal(pixels, as_planes)
    stack = np.zeros((5, 8, 9), np.uint16)
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack")
    np.save(tmp_path / "stack.npy", stack)
    for name in ("stack.tif", "stack.npy"):
        with pytest.raises(ValueError, match=r"must hold \(h, w, 3\) numbers, got \(5, 8, 9\)"):
            gv.read_image(tmp_path / name)


@pytest.mark.parametrize(
    ("corner", "size"), [((2, 1), (20, 10)), ((-2, -1), (4, 4)), ((9, 0), (5, 6))]
)
def test_an_exr_of_a_part_of_its_picture_lies_where_it_belongs(tmp_path, corner, size):
    exr = pytest.importorskip("OpenEXR")
    values = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)
    (left, top), (width, height) = corner, size
    header = {
        "compression": exr.ZIP_COMPRESSION,
        "type": exr.scanlineimage,
        "dataWindow": tuple(np.array((left + n, top + m), np.int32) for n, m in ((0, 0), (7, 5))),
        "displayWindow": tuple(np.array(n, np.int32) for n in ((0, 0), (width - 1, height - 1))),
    }
    exr.File(header, {"RGB": values}).write(str(tmp_path / "a.exr"))
    plane = np.zeros((40, 40, 3), np.float32)  # from -10, -10
    plane[10 + top : 16 + top, 10 + left : 18 + left] = values
    expected = plane[10 : 10 + height, 10 : 10 + width]
    assert np.array_equal(gv.read_image(tmp_path / "a.exr").numpy(), expected)


def test_premultiplied_integers_of_a_tiff_become_straight(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    straight = np.random.default_rng(0).integers(0, 2**16, (6, 9, 4), np.uint16)
    straight[0, 0, 3], straight[0, 1] = 0, 65535
    alpha = straight[..., 3:] / 65535
    premultiplied = np.concatenate(((straight[..., :3] * alpha).round(), straight[..., 3:]), -1)
    for name, pixels, kind in (
        ("straight", straight, "unassalpha"),
        ("premultiplied", premultiplied.astype(np.uint16), "assocalpha"),
    ):
        path = tmp_path / f"{name}.tif"
        tifffile.imwrite(path, pixels, photometric="rgb", extrasamples=[kind])
    expected, read = (gv.read_image(tmp_path / f"{n}.tif") for n in ("straight", "premultiplied"))
    assert torch.equal(read[..., 3], expected[..., 3])
    assert ((read - expected).abs() * expected[..., 3:]).max() < 1e-4


def test_floats_of_pictures_beyond_float32_are_infinite_without_a_warning(tmp_path):
    np.save(tmp_path / "a.npy", np.full((2, 2, 3), 1e300))
    assert torch.isinf(gv.read_image(tmp_path / "a.npy")).all()
    with pytest.raises(ValueError, match="image must be finite"):
        gv.Environment.read(tmp_path / "a.npy")


@pytest.mark.parametrize("kind", ["jpg", "png", "bmp"])
def test_a_slice_that_is_cut_is_told_by_its_name(tmp_path, kind):
    """The missing end of a JPEG was once read as gray, without a warning."""
    codecs = pytest.importorskip("imagecodecs")
    encode = getattr(codecs, {"jpg": "jpeg8_encode"}.get(kind, f"{kind}_encode"))
    rng = np.random.default_rng(1)
    whole = [encode(rng.integers(0, 256, (30, 40), dtype=np.uint8)) for _ in range(3)]
    for number, content in enumerate(whole):
        (tmp_path / f"s{number}.{kind}").write_bytes(content)
    assert gv.read_volume(tmp_path).extent == (40, 30, 3)
    for number in (0, 2):
        file = tmp_path / f"s{number}.{kind}"
        for rest in (1, 2, 100, len(whole[number]) // 2)[2 * (kind == "png") :]:  # PNG ends before
            file.write_bytes(whole[number][:-rest])
            with pytest.raises(ValueError, match=r"can't be read|is truncated") as caught:
                gv.read_volume(tmp_path)
            assert str(file) in str(caught.value) and "\n" not in str(caught.value)
        file.write_bytes(whole[number])
    (tmp_path / f"s2.{kind}").write_bytes(encode(np.zeros((20, 40), np.uint8)))
    with pytest.raises(ValueError, match=rf"s2\.{kind}: \(20, 40\) differs from \(30, 40\)"):
        gv.read_volume(tmp_path)


def test_only_the_end_of_its_own_scans_ends_a_jpeg():
    codecs = pytest.importorskip("imagecodecs")
    pixels = np.random.default_rng(1).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    small, whole = codecs.jpeg8_encode(pixels[:8, :8].copy()), codecs.jpeg8_encode(pixels)
    inner = b"\xff\xe1" + struct.pack(">H", len(small) + 2) + small  # thumbnail with an end marker
    with_thumbnail = whole[:2] + inner + whole[2:]
    assert has_jpeg_end(whole) and has_jpeg_end(with_thumbnail) and has_jpeg_end(whole + b"more")
    assert np.array_equal(codecs.jpeg8_decode(with_thumbnail), codecs.jpeg8_decode(whole))
    for cut in (1, 2, 50, len(whole) // 2, len(whole) - 3):
        assert not has_jpeg_end(whole[:-cut]) and not has_jpeg_end(with_thumbnail[:-cut])
