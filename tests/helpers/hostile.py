"""Small files whose headers claim more data than a machine has, or that never end; each with the
file ending of its reader.
"""

from __future__ import annotations

import bz2
import gzip
import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

HUGE = 10**12
Tag = tuple[int, int, int, int | bytes]  # number, type, count, value


def tiff(tags: Sequence[Tag] = (), *, following: int = 0, pixels: int = 64) -> bytes:
    """Returns a TIFF of 8 x 8 bytes, with some of its tags replaced; `following` is the offset that
    it claims for its next page.
    """
    merged: dict[int, Tag] = {
        number: (number, 3, 1, value)
        for number, value in ((256, 8), (257, 8), (258, 8), (259, 1), (262, 1), (277, 1), (278, 8))
    }
    merged[279] = (279, 4, 1, pixels)
    merged |= {tag[0]: tag for tag in tags}
    merged.setdefault(273, (273, 4, 1, 0))
    data_begin = 8 + 2 + 12 * len(merged) + 4
    entries, data = b"", b""
    for number, code, count, value in sorted(merged.values()):
        if isinstance(value, bytes):
            value_bytes = struct.pack("<I", data_begin + len(data))
            data += value + bytes(len(value) % 2)
        else:
            value_bytes = struct.pack("<I", value)
        entries += struct.pack("<HHI", number, code, count) + value_bytes
    entry = struct.pack("<HHII", 273, 4, 1, 0)
    entries = entries.replace(entry, struct.pack("<HHII", 273, 4, 1, data_begin + len(data)))
    head = b"II*\0" + struct.pack("<IH", 8, len(merged)) + entries + struct.pack("<I", following)
    return head + data + bytes(range(pixels))


def text(description: str) -> Tag:
    content = description.encode() + b"\0"
    return (270, 2, len(content), content)


def ome(z: int, t: int = 1, ifds: str = "<TiffData/>") -> bytes:
    return tiff(
        [
            text(
                '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/'
                '2016-06"><Image ID="Image:0"><Pixels DimensionOrder="XYZCT" ID="Pixels:0" '
                f'SizeC="1" SizeT="{t}" SizeX="8" SizeY="8" SizeZ="{z}" Type="uint8">'
                f'<Channel ID="Channel:0:0" SamplesPerPixel="1"/>{ifds}</Pixels></Image></OME>'
            )
        ]
    )


def nrrd(fields: str, data: bytes, sizes: str = "4 4 4") -> bytes:
    return f"NRRD0004\ntype: uchar\ndimension: 3\nsizes: {sizes}\n{fields}\n\n".encode() + data


def fits(cards: Sequence[str], data: bytes = b"") -> bytes:
    lines = ["SIMPLE  =                    T", *cards, "END"]
    head = "".join(line.ljust(80) for line in lines).encode()
    return head.ljust(-(-len(head) // 2880) * 2880) + data


def png(width: int, height: int) -> bytes:
    """Returns a black picture of any size, compressed to few bytes."""

    def part(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content).to_bytes(4, "big")
        return len(content).to_bytes(4, "big") + kind + content + check

    size = width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\x08\0\0\0\0"
    pixels = zlib.compress(bytes((width + 1) * height), 1)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", size) + part(b"IDAT", pixels) + part(b"IEND", b"")


def zeros(megabytes: int) -> bytes:
    """Returns a gzip stream of megabytes of zeros, a thousandth as long, without an end."""
    engine = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    block = engine.compress(bytes(1 << 20)) + engine.flush(zlib.Z_FULL_FLUSH)
    return b"\x1f\x8b\x08\0\0\0\0\0\0\x03" + block * megabytes


def tiff_files() -> dict[str, bytes]:
    """Returns by name TIFFs whose tags, pages or descriptions claim too much data."""
    description = "ImageJ=1.53k\nimages={0}\nslices={0}\nhyperstack=true\n"
    return {
        "cycle.tif": tiff(following=8),
        "ome_slices.tif": ome(10**9),
        "ome_times.tif": ome(10**6, 10**6),
        "ome_planes.tif": ome(4, 1, f'<TiffData IFD="0" PlaneCount="{10**9}"/>'),
        "ome_planes_2.tif": ome(10**7, 1, f'<TiffData IFD="0" PlaneCount="{10**7}"/>'),
        "imagej.tif": tiff([text(description.format(10**9))]),
        "imagej_packed.tif": tiff([text(description.format(10**8)), (259, 3, 1, 8)]),
        "imagej_few.tif": tiff([text(description.format(10**7))]),
        "shaped.tif": tiff([text('{"shape": [1000000000, 1000000, 8, 8]}')]),
        "shaped_few.tif": tiff([text('{"shape": [10000000, 8, 8]}')]),
        "text.tif": tiff([(270, 2, 2**32 - 1, 8)]),
        "strips.tif": tiff([(257, 4, 1, 2**31 - 1), (278, 3, 1, 1), (273, 4, 2**31 - 1, 8)]),
        "size.tif": tiff([(256, 4, 1, 2**31 - 1), (257, 4, 1, 2**31 - 1)]),
        "tiles.tif": tiff(
            [(322, 4, 1, 2**31 - 16), (323, 4, 1, 2**31 - 16), (324, 4, 1, 8), (325, 4, 1, 64)]
        ),
        "tiny_tiles.tif": tiff(
            [
                (256, 4, 1, 2**31 - 1),
                (257, 4, 1, 2**31 - 1),
                (322, 4, 1, 16),
                (323, 4, 1, 16),
                (324, 4, 1, 8),
                (325, 4, 1, 64),
            ]
        ),
        "depth.tif": tiff([(32997, 4, 1, 2**31 - 1)]),
        "samples.tif": tiff([(277, 3, 1, 65535), (284, 3, 1, 2)]),
        "pages.tif": tiff([(330, 4, 2**30, 8)]),
        "stk.tif": tiff([(33629, 5, 10**9, 8), (33628, 4, 10**9, 8)]),
        "lsm.tif": tiff([(34412, 1, 2**31, 8)]),
        "nih.tif": tiff([(43314, 1, 2**31, 8)]),
        "mm.tif": tiff([text('{"PropertyValues": []}'), (51123, 2, 2**31, 8)]),
    }


def nrrd_files() -> dict[str, bytes]:
    """Returns by name NRRDs with huge sizes and skips, wrong fields, and streams without an end."""
    return {
        "lines.nrrd": nrrd(f"encoding: raw\nline skip: {HUGE}", bytes(64)),
        "bytes.nrrd": nrrd(f"encoding: raw\nbyte skip: {HUGE}", bytes(64)),
        "sizes.nrrd": nrrd("encoding: gzip", zeros(1), f"{10**6} {10**6} {10**6}"),
        "skip.nrrd": nrrd(f"encoding: gzip\nbyte skip: {10**10}", zeros(3000)),
        "ends.nrrd": nrrd("encoding: raw", bytes(65)),
        "none.nrrd": nrrd("encoding: raw", b"", "0 4 4"),
        "dims.nrrd": nrrd("encoding: raw", bytes(64)).replace(b"dimension: 3", b"dimension: 4"),
        "endian.nrrd": nrrd("encoding: raw", bytes(128)).replace(b"uchar", b"short"),
        "bomb.nrrd": nrrd("encoding: gzip", zeros(2500)),
        "bomb_2.nrrd": nrrd("encoding: bzip2", bz2.compress(bytes(1 << 26)) * 100),
        "wide.nrrd": nrrd("encoding: raw", b"", f"{10**400} 4 4"),
        "list.nrrd": nrrd(f"encoding: raw\ndata file: %d.raw 1 {HUGE} 1", b""),
        "axes.nrrd": nrrd("encoding: raw", b"", "1 " * 10**5),
    }


def fits_files() -> dict[str, bytes]:
    """Returns by name FITS files of too many axes or cards, and some that unpack without an end."""
    axes = [f"NAXIS{n}  = {10**7}" for n in (1, 2, 3)]
    cube = ["BITPIX  = 8", "NAXIS   = 3", *(f"NAXIS{n}  = 4" for n in (1, 2, 3))]
    flat = ["BITPIX  = 8", "NAXIS   = 1", f"NAXIS1  = {10**10}", "EXTEND  = T"]
    return {
        "cube.fits": fits(["BITPIX  = 8", "NAXIS   = 3", *axes]),
        "dims.fits": fits(
            ["BITPIX  = 8", "NAXIS   = 999", *(f"NAXIS{n:<3}= 1" for n in range(1, 1000))]
        ),
        "negative.fits": fits(["BITPIX  = 8", "NAXIS   = 3", "NAXIS1  = -4", *axes[1:]]),
        "cards.fits": fits([f"COMMENT {n}" for n in range(20_000)] + cube, bytes(2880)),
        "bomb.fits.gz": gzip.compress(fits(cube, bytes(64))) + zeros(2500),
        "before.fits.gz": gzip.compress(fits(flat)) + zeros(3000),
    }


def write_all(folder: Path) -> list[Path]:
    """Writes the files; returns their paths, and those of pipes and a device without an end."""
    shape = b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000, 1000000, 1000000), }"
    files = {**tiff_files(), **nrrd_files(), **fits_files()}
    files["shape.npy"] = b"\x93NUMPY\x01\0v\0" + shape.ljust(117) + b"\n"
    files["bomb_4x4x4_uint8.raw.gz"] = zeros(2500)
    files["wide_9000x9000x9000_uint8.raw.gz"] = zeros(1)
    paths = []
    for name, content in files.items():
        path = folder / name
        path.write_bytes(content)
        paths.append(path)
    for name in ("pipe.tif", "pipe_4x4x4_uint8.raw"):
        os.mkfifo(folder / name)
        paths.append(folder / name)
    (folder / "slices").mkdir()
    os.mkfifo(folder / "slices" / "a.png")
    (folder / "device.nhdr").write_bytes(
        nrrd("encoding: raw\nline skip: 1\ndata file: /dev/zero", b"")
    )
    (folder / "pipe.mhd").write_text(
        "ObjectType = Image\nNDims = 3\nDimSize = 4 4 4\nElementType = MET_UCHAR\n"
        "ElementDataFile = pipe.tif\n"
    )
    return [*paths, folder / "slices", folder / "device.nhdr", folder / "pipe.mhd"]
