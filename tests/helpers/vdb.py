"""Writes grids as OpenVDB and NanoVDB files, by the descriptions of the formats at the heads of
gvtorch/io/formats/openvdb.py and nanovdb.py.
"""

from __future__ import annotations

import pickle
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gvtorch.io.reading import open_source

SIDE = {0: 32, 1: 16}  # entries along a side of an upper and of a lower node
REACH = (4096, 128, 8)  # voxels along a side of an entry of the root, an upper and a lower node
ZIP, ACTIVE, BLOSC = 1, 2, 4
Position = tuple[int, int, int]


@dataclass
class Grid:
    """A grid: leaves are (512, c) values and (512,) bool, true where active; tiles of the root (0),
    of uppers (1) and of lowers (2) are a value (c,) by their first voxel.
    """

    kind: str
    background: Any
    leaves: dict[Position, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    tiles: tuple[dict[Position, Any], ...] = ({}, {}, {})
    name: str = "density"
    metadata: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    map: tuple[str, bytes] = ("UniformScaleMap", struct.pack("<15d", *(0.5,) * 3, *(0,) * 12))
    half: bool = False
    parent: str = ""

    @property
    def dtype(self) -> np.dtype:
        """Dtype of one component."""
        kinds = {"float": "f4", "double": "f8", "int32": "i4", "int64": "i8", "bool": "?"}
        kinds |= {"mask": "?", "vec3s": "f4", "vec3d": "f8", "vec3i": "i4"}
        return np.dtype(kinds[self.kind])

    def value(self, value: Any) -> np.ndarray:
        """Returns a value as (c,)."""
        width = 3 if self.kind.startswith("vec3") else 1
        return np.broadcast_to(np.asarray(value, self.dtype), (width,))

    def dense(self, low: Position, high: Position) -> np.ndarray:
        """Returns the voxels (i, j, k, c) of a box: tiles, overwritten by leaves."""
        out = np.empty((*np.subtract(high, low), len(self.value(0))), self.dtype)
        out[...] = self.value(self.background)

        def paint(corner: Position, block: np.ndarray, half: bool) -> None:
            side = len(block)
            begin = np.maximum(np.subtract(low, corner), 0)
            end = np.minimum(np.subtract(high, corner), side)
            if (begin < end).all():
                part = block[tuple(map(slice, begin, end))]
                target = tuple(map(slice, begin + corner - low, end + corner - low))
                out[target] = part.astype("f2") if half else part

        for reach, tiles in zip(REACH[::-1], self.tiles[::-1], strict=True):
            for corner, value in tiles.items():
                block = np.broadcast_to(self.value(value), (reach,) * 3 + out.shape[3:])
                paint(corner, block, self.half and reach != 4096)
        for corner, (values, _) in self.leaves.items():
            paint(corner, values.reshape(8, 8, 8, -1), self.half)
        return out


def text(content: str) -> bytes:
    """Returns a string as OpenVDB writes it."""
    return struct.pack("<I", len(content)) + content.encode()


def metadata(entries: dict[str, tuple[str, bytes]]) -> bytes:
    """Returns metadata as OpenVDB writes it."""
    parts = [text(n) + text(k) + struct.pack("<I", len(v)) + v for n, (k, v) in entries.items()]
    return struct.pack("<I", len(parts)) + b"".join(parts)


def bits(flags: np.ndarray) -> bytes:
    """Returns a mask; its first bit is the lowest of the first byte."""
    return np.packbits(np.asarray(flags, bool), bitorder="little").tobytes()


class VdbWriter:
    """Writes grids of one file version and packing."""

    def __init__(self, version: int = 224, packing: int = ACTIVE) -> None:
        self.version, self.packing = version, packing
        self.codes: set[int] = set()  # codes of inactive values that were used

    def write(self, path: Path, *grids: Grid, has_offsets: bool = True) -> Path:
        """Writes a file."""
        out = struct.pack("<qIII?", 0x56444220, self.version, 10, 0, has_offsets)
        out += struct.pack("<?", bool(self.packing)) if self.version < 222 else b""
        out += b"0" * 36 + metadata({"creator": ("string", b"tests"), "odd": ("matrix", b"1234")})
        out += struct.pack("<i", len(grids))
        for grid in grids:
            kind = f"Tree_{grid.kind}_5_4_3" + "_HalfFloat" * grid.half
            out += text(grid.name) + text(kind) + text(grid.parent)
            head = struct.pack("<I", self.packing) if self.version >= 222 else b""
            head += metadata(grid.metadata) + text(grid.map[0]) + grid.map[1]
            tree, leaves = (b"", b"") if grid.parent else self.tree(grid)
            start = len(out) + 24
            tree_end = start + len(head) + len(tree)
            first = 0 if grid.parent else tree_end  # leaf; 0 where a tree is shared
            out += struct.pack("<3q", start, first, tree_end + len(leaves)) + head + tree + leaves
        path.write_bytes(out)
        return path

    def tree(self, grid: Grid) -> tuple[bytes, bytes]:
        """Returns the topology, and the values of leaves."""
        origins = [set(grid.leaves) | set(grid.tiles[2]), set(grid.tiles[1])]
        lowers = sorted({tuple(n // 128 * 128 for n in origin) for origin in origins[0]})
        uppers = sorted({tuple(n // 4096 * 4096 for n in p) for p in (*lowers, *origins[1])})
        out = struct.pack("<I", 1) + grid.value(grid.background).tobytes()
        out += struct.pack("<2I", len(grid.tiles[0]), len(uppers))
        for origin, value in grid.tiles[0].items():
            out += struct.pack("<3i", *origin) + grid.value(value).tobytes() + b"\x01"
        leaves = b""
        for upper in uppers:
            below = [p for p in lowers if tuple(n // 4096 * 4096 for n in p) == upper]
            out += struct.pack("<3i", *upper) + self.node(grid, 0, upper, below)
            for lower in below:
                inside = [p for p in grid.leaves if tuple(n // 128 * 128 for n in p) == lower]
                inside.sort()
                out += self.node(grid, 1, lower, inside)
                out += b"".join(bits(grid.leaves[origin][1]) for origin in inside)
                leaves += b"".join(self.leaf(grid, origin) for origin in inside)
        return out, leaves

    def node(self, grid: Grid, level: int, origin: Position, children: list[Position]) -> bytes:
        """Returns masks and tiles of an upper (0) or a lower (1) node."""
        n, side = SIDE[level], REACH[level + 1]
        active, values = np.zeros(n**3, bool), np.tile(grid.value(grid.background), (n**3, 1))
        is_child = active.copy()

        def index(position: Position) -> int:
            return int(np.ravel_multi_index(np.subtract(position, origin) // side, (n, n, n)))

        is_child[[index(position) for position in children]] = True
        for position, value in grid.tiles[level + 1].items():
            if tuple(p // REACH[level] * REACH[level] for p in position) == origin:
                active[index(position)] = sum(position) % 16 == 0  # some are
                values[index(position)] = value
        if self.version < 222:
            return bits(is_child) + bits(active) + self.numbers(grid, values[~is_child])
        return bits(is_child) + bits(active) + self.values(grid, values, active)

    def leaf(self, grid: Grid, origin: Position) -> bytes:
        """Returns the values of a leaf."""
        values, active = grid.leaves[origin]
        head = bits(active)
        if grid.kind in ("mask", "bool"):
            head += struct.pack("<3i", *origin)
            return head + bits(values[:, 0]) * (grid.kind == "bool")
        if self.version < 222:
            return head + struct.pack("<3ib", *origin, 1) + self.numbers(grid, values)
        return head + self.values(grid, values, active)

    def values(self, grid: Grid, values: np.ndarray, active: np.ndarray) -> bytes:
        """Returns the values of a node; the code of the inactive ones follows from their values."""
        back = grid.value(grid.background)
        minus = ~back if back.dtype.kind == "b" else -back
        code, extra = 6, b""
        if self.packing & ACTIVE:
            inactive = list(dict.fromkeys(map(tuple, values[~active].tolist())))
            b, m = tuple(back.tolist()), tuple(minus.tolist())
            others = [np.array(value, grid.dtype).tobytes() for value in inactive]
            if set(inactive) <= {b}:
                code = 0
            elif inactive == [m]:
                code = 1
            elif len(inactive) == 1:
                code, extra = 2, others[0]
            elif set(inactive) == {b, m}:
                code, extra = 3, bits((values == back).all(1) & ~active)
            elif len(inactive) == 2 and b in inactive:
                rest = others[1 - inactive.index(b)]
                code, extra = 4, rest + bits((values == back).all(1) & ~active)
            elif len(inactive) == 2:
                chosen = (values == inactive[1]).all(1) & ~active
                code, extra = 5, others[0] + others[1] + bits(chosen)
        self.codes.add(code)
        written = values[active] if code != 6 else values
        return struct.pack("<B", code) + extra + self.numbers(grid, written)

    def numbers(self, grid: Grid, values: np.ndarray) -> bytes:
        """Returns numbers, packed."""
        content = np.ascontiguousarray(values.astype("f2") if grid.half else values).tobytes()
        if (self.version < 222 and not self.packing) or not self.packing & (ZIP | BLOSC):
            return content
        if self.packing & ZIP:
            packed = zlib.compress(content)
        else:
            import imagecodecs

            size = grid.dtype.itemsize
            packed = imagecodecs.blosc_encode(content, compressor="lz4", typesize=size)
        if len(packed) >= len(content):
            return struct.pack("<q", -len(content)) + content
        return struct.pack("<q", len(packed)) + packed


#: From NanoVDB's PNanoVDB.h: the type's number; bytes of a root, before a tile's value, of a tile;
#: before an upper's entries, of an upper, the same of a lower, of an entry; before a leaf's values,
#: of a leaf.
NANO = {
    "float": (1, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 2144),
    "double": (2, 96, 24, 32, 8256, 270400, 1088, 33856, 8, 128, 4224),
    "int16": (3, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 1120),
    "int32": (4, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 2144),
    "int64": (5, 96, 24, 32, 8256, 270400, 1088, 33856, 8, 128, 4224),
    "Vec3f": (6, 96, 20, 32, 8256, 532544, 1088, 66624, 16, 128, 6272),
    "Vec3d": (7, 128, 24, 64, 8288, 794720, 1120, 99424, 24, 160, 12448),
    "Mask": (8, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 16, 96),
    "bool": (11, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 160),
    "Fp4": (13, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 352),
    "Fp8": (14, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 608),
    "Fp16": (15, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 1120),
    "FpN": (16, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 96),
    "Vec4f": (17, 96, 20, 64, 8288, 532576, 1120, 66656, 16, 128, 8320),
    "Vec4d": (18, 160, 24, 64, 8320, 1056896, 1152, 132224, 32, 160, 16544),
    "Vec3u8": (24, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 1632),
    "Vec3u16": (25, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 128, 3200),
    "uint8": (26, 64, 20, 32, 8256, 270400, 1088, 33856, 8, 96, 608),
}
NANO_DTYPES = {
    "float": "f4", "double": "f8", "int16": "i2", "int32": "i4", "int64": "i8", "Vec3f": "f4",
    "Vec3d": "f8", "Mask": "?", "bool": "?", "Vec4f": "f4", "Vec4d": "f8", "Vec3u8": "u1",
    "Vec3u16": "u2", "uint8": "u1",
}  # fmt: skip


def _nano_leaf(
    kind: str, rng: np.random.Generator, steps: int | None
) -> tuple[bytes, np.ndarray, bytes]:
    """Returns a leaf's values as bytes and as (512, c) or (512,), and its header before codes."""
    dtype, width = _numbers(kind)
    if steps:
        codes = rng.integers(0, 2**steps, 512)
        flags = codes[:, None] >> np.arange(steps) & 1
        minimum, step = np.float32(0.25), np.float32(0.125)
        head = struct.pack("<2f", minimum, step)
        return bits(flags.reshape(-1)), codes.astype("f4") * step + minimum, head
    if dtype.kind == "b":
        values = rng.random(512) < 0.5
        return bits(values), values, b""
    values = rng.integers(0, 100, (512, width)).astype(dtype)
    return values.tobytes(), values, b""


def _numbers(kind: str) -> tuple[np.dtype, int]:
    return np.dtype(NANO_DTYPES.get(kind, "f4")), int(kind[3]) if kind[:3] == "Vec" else 1


def nano_grid(kind: str, rng: np.random.Generator, bits_of_leaf: int = 8) -> tuple[bytes, Any]:
    """Returns a NanoVDB grid of two leaves at (-8, 0, 0) and (0, 8, 16), and tiles at (0, 0, 16),
    of 8 voxels, (128, 0, 0), of 128, and (8192, 0, 0), of 4096; and the number of its type with its
    (16, 16, 24, c) voxels from (-8, 0, 0) on.
    """
    number, root, tile_value, tile, up, upper, low, lower, entry, values, leaf = NANO[kind]
    dtype, width = _numbers(kind)
    steps = {"Fp4": 4, "Fp8": 8, "Fp16": 16, "FpN": bits_of_leaf}.get(kind)
    leaf += 64 * bits_of_leaf if kind == "FpN" else 0
    at_root = 672 + 64
    at_upper = [at_root + root + 3 * tile, at_root + root + 3 * tile + upper]
    at_lower = [at_upper[1] + upper, at_upper[1] + upper + lower]
    at_leaf = [at_lower[1] + lower, at_lower[1] + lower + leaf]
    out = bytearray(at_leaf[1] + leaf)
    struct.pack_into("<QQII", out, 0, 0x314244566F6E614E, 0, 32 << 21 | 6 << 10, 0)
    struct.pack_into("<IIQ", out, 24, 0, 1, len(out))
    struct.pack_into("<2I", out, 632, 2, number)
    struct.pack_into("<3I", out, 672 + 32, 2, 2, 2)
    out[296 + 88 : 296 + 88 + 72] = np.diag((0.5, 0.25, 2.0)).tobytes()
    struct.pack_into("<3d", out, 528, 10, 20, 30)
    struct.pack_into("<4q", out, 672, at_leaf[0] - 672, at_lower[0] - 672, at_upper[0] - 672, 64)
    struct.pack_into("<6iI", out, at_root, -8, 0, 0, 7, 15, 23, 3)
    back, fill = (np.full(width, n).astype(dtype) for n in (1, 3))
    offset = at_root + (32 if dtype.itemsize == 8 else 28)
    out[offset : offset + back.nbytes] = back.tobytes()
    box = np.tile(back, (16, 16, 24, 1))
    box[8:, :8, 16:] = fill
    offset = at_root + root + 2 * tile
    struct.pack_into("<Qq", out, offset, 2 << 42, 0)
    out[offset + tile_value : offset + tile_value + fill.nbytes] = fill.tobytes()
    for n, leaf_origin in enumerate(((-8, 0, 0), (0, 8, 16))):
        keys = [(p & 0xFFFFFFFF) >> 12 for p in leaf_origin]
        key = keys[0] << 42 | keys[1] << 21 | keys[2]
        struct.pack_into("<Qq", out, at_root + root + n * tile, key, at_upper[n] - at_root)
        cells = [p // 128 % 32 for p in leaf_origin], [p // 8 % 16 for p in leaf_origin]
        for base, count, cell, entries, child in (
            (at_upper[n], 32, cells[0], up, at_lower[n]),
            (at_lower[n], 16, cells[1], low, at_leaf[n]),
        ):
            index = int(np.ravel_multi_index(cell, (count,) * 3))
            for cell_index in range(count**3):
                begin = base + entries + cell_index * entry
                out[begin : begin + back.nbytes] = back.tobytes()
            out[base + 32 + count**3 // 8 + index // 8] |= 1 << index % 8
            struct.pack_into("<q", out, base + entries + index * entry, child - base)
        if n:
            for begin in (at_lower[n] + low + 2 * entry, at_upper[n] + up + 1024 * entry):
                out[begin : begin + fill.nbytes] = fill.tobytes()
        content, found, head = _nano_leaf(kind, rng, steps)
        out[at_leaf[n] + 15 : at_leaf[n] + 16] = bytes(
            [steps.bit_length() - 1 << 5 if steps else 0]
        )
        out[at_leaf[n] + 80 : at_leaf[n] + 80 + len(head)] = head
        begin = at_leaf[n] + values
        out[begin : begin + len(content)] = content
        i, j, k = (p - o for p, o in zip(leaf_origin, (-8, 0, 0), strict=True))
        box[i : i + 8, j : j + 8, k : k + 8] = found.reshape(8, 8, 8, width)
    return bytes(out), (number, box)


def nano_file(
    path: Path,
    *grids: tuple[str, int, bytes],
    codec: int = 0,
    count_length: bool = True,
    compressor: str = "lz4",
) -> Path:
    """Writes grids (name, number of the type, content) into a segment of a `.nvdb` file."""
    heads, parts = b"", b""
    for name, kind, content in grids:
        packed = content
        if codec == 1:
            packed = zlib.compress(content)
        elif codec == 2:
            import imagecodecs

            half = len(content) // 2 // 8 * 8
            packed, *rest = (
                imagecodecs.blosc_encode(part, compressor=compressor, typesize=4)
                for part in (content[:half], content[half:])
            )
            packed += struct.pack("<Q", len(rest[0])) + rest[0]
            first = len(packed) - 8 - len(rest[0])
        length = struct.pack("<Q", first if codec == 2 else len(packed)) if codec else b""
        size = len(packed) + len(length) * count_length
        heads += struct.pack(
            "<4Q2I6d6i3d8I2HI", len(content), size, 0, 0, kind, 2, *(0,) * 6, *(0,) * 6,
            *(0,) * 3, len(name) + 1, *(0,) * 7, codec, 0, 32 << 21,
        ) + name.encode() + b"\0"  # fmt: skip
        parts += length + packed
    head = struct.pack("<8sIHH", b"NanoVDB2", 32 << 21 | 6 << 10, len(grids), codec)
    path.write_bytes(head + heads + parts)
    return path


LOW, HIGH = (-20, -12, -4), (30, 20, 40)
BOX = {
    "file_bbox_min": ("vec3i", struct.pack("<3i", *LOW)),
    "file_bbox_max": ("vec3i", struct.pack("<3i", *(n - 1 for n in HIGH))),
}


def leaf_values(grid: Grid, rng: np.random.Generator) -> None:
    """Adds leaves whose inactive values use each of the seven codes, and tiles."""
    width = len(grid.value(0))
    back = grid.value(grid.background)
    minus = ~back if grid.dtype.kind == "b" else -back
    inactive = [[back], [minus], [back * 2], [minus, back], [back * 2, back],
                [back * 2, back * 3], [back * 2, back * 3, back * 4], [back]]  # fmt: skip
    for number, kinds in enumerate(inactive):
        active = rng.random(512) < (0.3 if number < 7 else 1)
        values = rng.integers(-50, 50, (512, width)).astype(grid.dtype)
        if grid.dtype.kind == "b":
            values = rng.random((512, 1)) < 0.5
        kind_index = np.arange(512) % len(kinds)
        values[~active] = np.stack(kinds)[kind_index[~active]]
        if grid.kind == "mask":
            values = active[:, None].copy()
        origin = ((number % 3 - 2) * 8, (number // 3 - 1) * 8, 8)
        grid.leaves[origin] = values, active
    tile_value = back.dtype.type(1) if grid.dtype.kind == "b" else (back * 5).astype(grid.dtype)
    grid.tiles = ({}, {(128, 0, 0): tile_value}, {(16, 8, 16): tile_value, (16, 0, 16): tile_value})


def assert_reads(path, expected, **options) -> None:
    """Asserts that a grid is read as it was written, whole and in parts."""
    source = open_source(path, **options)
    actual = source.read_times(0, 1)[0]
    expected_zyx = expected.transpose(2, 1, 0, 3)
    assert actual.shape == expected_zyx.shape
    assert np.array_equal(actual, expected_zyx.astype(actual.dtype))
    rng = np.random.default_rng(5)
    for _ in range(20):
        low = [int(rng.integers(0, n)) for n in actual.shape[:3]]
        high = [int(rng.integers(a, n)) + 1 for a, n in zip(low, actual.shape[:3], strict=True)]
        part = pickle.loads(pickle.dumps(source)).read_region(low, high)
        assert np.array_equal(part, actual[tuple(map(slice, low, high))])
