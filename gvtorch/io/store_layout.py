"""How a store lies on disk, and tensorstore's settings; nothing is read or written here.

    STORE.zarr/zarr.json             metadata; written last, so a store that has it is whole
    STORE.zarr/0, 1, ...             (z, y, x) or (c, z, y, x), the mean pyramid, 0 the finest
    STORE.zarr/gvtorch/blocks/0 ...  (gz, gy, gx, s, s, s, c), s = block + 2 border, a chunk each,
                                     its border the true neighbours, repeated at the volume's faces;
                                     blocks of CONSTANT and EMPTY cells only are not written
    STORE.zarr/gvtorch/cells/0 ...   (gz, gy, gx, 3, c) low, high, mean of every cell of 8^3 voxels
    STORE.zarr/.gvtorch-work         only while it is made: manifest, journal, low and high pyramids

A shard of any array covers the same cube of voxels, and one task of the converter writes it.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .resources import cores

VERSION = 1
CELL = 8  # voxels along a side of a cell
BORDER = 1  # voxels around a block, and around a cell for its low and high
BLOCKS = (32, 64)  # voxels along a side of a block
WORK = ".gvtorch-work"
MOST_VOXELS = 2**40
DTYPES = ("uint8", "int8", "uint16", "int16", "float16", "float32")
GROUPS = ("gvtorch", "gvtorch/blocks", "gvtorch/cells")
_PLAIN_CHUNK = 64  # voxels
_CELL_CHUNK = 16  # cells
_KEEP = "store_data_equal_to_fill_value"  # zeros are written too: what is missing then shows


def value_dtype(stored: np.dtype) -> str:
    """Name of the dtype that values are read as: bool becomes uint8, wide numbers float32."""
    if stored.kind == "b":
        return "uint8"
    return "float32" if stored.kind in "iuf" and stored.name not in DTYPES else stored.name


@functools.cache
def context() -> Any:
    """tensorstore's resources: no cache (the pools and their host cache are it), few threads."""
    import tensorstore as ts

    return ts.Context(
        {
            "cache_pool": {"total_bytes_limit": 0},
            "data_copy_concurrency": {"limit": min(8, cores())},
            "file_io_concurrency": {"limit": min(16, 2 * cores())},
            "http_request_concurrency": {"limit": 16},
        }
    )


def kvstore(location: str | Path) -> Any:
    """Returns tensorstore's spec of a folder: a path, or a URL that it knows."""
    text = str(location)
    if re.match(r"[a-z0-9+]{2,}://", text):
        return text if text.endswith("/") or "?" in text else text + "/"
    return {"driver": "file", "path": f"{Path(text).absolute()}/"}


@dataclass(frozen=True, kw_only=True)
class StoreLayout:
    """Sizes of a store; picklable."""

    extent: tuple[int, int, int]  # x y z
    dtype: str
    width: int
    block: int = 32

    @property
    def levels(self) -> int:
        """Number of levels: the last one is one cell."""
        return level_count(self.extent)

    @property
    def shard(self) -> int:
        """Voxels along a side of the cube that one shard covers."""
        return 256 if np.dtype(self.dtype).itemsize * self.width <= 2 else 128

    @property
    def stored(self) -> int:
        """Voxels along a side of a block with its border."""
        return self.block + 2 * BORDER

    def shape(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) voxels of a level."""
        return level_shape(self.extent, level)

    def grid(self, level: int, side: int) -> tuple[int, int, int]:
        """(z, y, x) number of cubes of `side` voxels that cover a level."""
        z, y, x = (-(-n // side) for n in self.shape(level))
        return (z, y, x)

    def shards(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) number of shards of a level: one a task of the converter."""
        return self.grid(level, self.shard)

    def plain(self, level: int, *, path: str | None = None) -> dict[str, Any]:
        """Spec of the pyramid's array of a level."""
        first = [self.width] if self.width > 1 else []
        return _array(
            path or str(level),
            shape=[*first, *self.shape(level)],
            shard=[*first, *[self.shard] * 3],
            chunk=[1] * len(first) + [_PLAIN_CHUNK] * 3,
            dtype=self.dtype,
            names="czyx"[-3 - len(first) :],
            keep=True,
        )

    def blocks(self, level: int) -> dict[str, Any]:
        """Spec of the array of bordered blocks of a level."""
        inside = [self.stored] * 3 + [self.width]
        return _array(
            f"gvtorch/blocks/{level}",
            shape=[*self.grid(level, self.block), *inside],
            shard=[*[self.shard // self.block] * 3, *inside],
            chunk=[1, 1, 1, *inside],
            dtype=self.dtype,
        )

    def cells(self, level: int) -> dict[str, Any]:
        """Spec of the array of low, high, mean of a level."""
        inside = [3, self.width]
        return _array(
            f"gvtorch/cells/{level}",
            shape=[*self.grid(level, CELL), *inside],
            shard=[*[self.shard // CELL] * 3, *inside],
            chunk=[*[_CELL_CHUNK] * 3, *inside],
            dtype=self.dtype,
            keep=True,
        )

    def bound(self, which: str, level: int) -> dict[str, Any]:
        """Spec of the temporary array of smallest ("low") or largest ("high") finest values."""
        return self.plain(level, path=f"{WORK}/{which}/{level}")


def level_count(extent: Sequence[int]) -> int:
    """Levels until a volume is one cell."""
    return 1 + max(0, math.ceil(math.log2(max(extent) / CELL)))


def level_shape(extent: Sequence[int], level: int) -> tuple[int, int, int]:
    """(z, y, x) voxels of a level of a volume of `extent` (x, y, z)."""
    x, y, z = (-(-n // 2**level) for n in extent)
    return (z, y, x)


def opened(root: Any, spec: dict[str, Any], mode: str = "read") -> Any:
    """Begins to open an array of a store; returns tensorstore's future.

    Args:
        root: What `kvstore` returned.
        spec: What a method of `StoreLayout` returned.
        mode: "read"; "write" to it; "create" it if it is not there.
    """
    import tensorstore as ts

    left_out = {"read": ("path", "metadata", _KEEP), "write": ("path", "metadata")}
    store = {key: value for key, value in spec.items() if key not in left_out.get(mode, ("path",))}
    store["kvstore"] = child(root, spec["path"])
    return ts.open(store, context=context(), open=True, create=mode == "create")


def child(root: Any, path: str) -> Any:
    """Spec of a folder inside a folder."""
    if isinstance(root, str):
        base, mark, query = root.partition("?")
        return f"{base.rstrip('/')}/{path}/{mark}{query}"
    return {**root, "path": f"{root.get('path', '')}{path}/"}


def _array(
    path: str,
    *,
    shape: list[int],
    shard: list[int],
    chunk: list[int],
    dtype: str,
    names: str | None = None,
    keep: bool = False,
) -> dict[str, Any]:
    little = {"name": "bytes", "configuration": {"endian": "little"}}
    size = np.dtype(dtype).itemsize
    packed = {
        "cname": "lz4",
        "clevel": 5,
        "shuffle": "shuffle" if size > 1 else "noshuffle",
        "typesize": size,
        "blocksize": 0,
    }
    inner = [
        little if size > 1 else {"name": "bytes"},
        {"name": "blosc", "configuration": packed},
        {"name": "crc32c"},
    ]
    sharding = {
        "chunk_shape": chunk,
        "codecs": inner,
        "index_codecs": [little, {"name": "crc32c"}],
    }
    metadata: dict[str, Any] = {
        "shape": shape,
        "data_type": dtype,
        "fill_value": 0 if np.dtype(dtype).kind != "f" else 0.0,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": shard}},
        "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
    }
    if names:
        metadata["dimension_names"] = list(names)
    return {
        "path": path,
        "driver": "zarr3",
        "metadata": metadata,
        _KEEP: keep,
    }
