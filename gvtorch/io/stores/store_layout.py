"""The layout of a store on disk.

    STORE.zarr/zarr.json             metadata; written last, so a store that has it is complete
    STORE.zarr/0, 1, ...             (z, y, x) or (c, z, y, x), the mean pyramid, 0 the finest;
                                     with several time points (t, c, z, y, x), all other arrays
                                     begin with t, too, and coarse/TIME/ replaces coarse/
    STORE.zarr/gvtorch/blocks/0 ...  (gz, gy, gx, s, s, s, c), s = block + 2 border, a chunk each;
                                     borders are the neighbours' voxels, repeated at the volume's
                                     faces; blocks of CONSTANT and EMPTY cells only are not written
    STORE.zarr/gvtorch/cells/0 ...   (gz, gy, gx, 3, c) low, high, mean of every cell of 8^3 voxels
    STORE.zarr/gvtorch/labels        (k,) int64, increasing: the label of each index, for labels
                                     wider than 16 bits, which are indexed
    STORE.zarr/gvtorch/coarse/ ...   values of coarse voxels other than means; see coarse.py
    STORE.zarr/.gvtorch-work         during conversion only: manifest, journal, low, high pyramids

Shards of pyramid, blocks and cells cover the same cube of voxels, and one task of the converter
writes them. For labels, coarse voxels hold the most frequent, cells the smallest, not the mean.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from reprlib import repr as brief
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np  # not at run time: `gvtorch --help` imports this module

VERSION = 1  # of stores with one time point; those with more have 2
CELL = 8  # voxels along a side of a cell
BORDER = 1  # voxels around a block; a cell's low and high cover that many around it, too
BLOCKS = (32, 64)  # voxels along a side of a block
WORK = ".gvtorch-work"
MANIFEST, JOURNAL = "manifest.json", "journal.jsonl"  # in it, of one store
RESUME_ADVICE = "the same command with --resume (in Python: resume=True) goes on"
MAX_STORE_VOXELS = 2**40
MAX_TIMES = 2**20
DTYPES = {"uint8": 1, "int8": 1, "uint16": 2, "int16": 2, "float16": 2, "float32": 4}  # bytes
GROUPS = ("gvtorch", "gvtorch/blocks", "gvtorch/cells")
_PYRAMID_CHUNK = 64  # voxels
_CELL_CHUNK = 16  # cells
_LABEL_CHUNK = 2**16
_COARSE_SHARD = 128  # voxels along a side of a shard of a coarse channel
WRITE_ZEROS = "store_data_equal_to_fill_value"  # zeros, too: a missing chunk is an error


def value_dtype(stored: np.dtype, *, labels: bool = False) -> str:
    """Returns the name of the dtype that values are read as: bool becomes uint8, and wide numbers
    become float32 unless they are labels.
    """
    if stored.kind == "b":
        return "uint8"
    if labels:
        return stored.name
    return "float32" if stored.kind in "iuf" and stored.name not in DTYPES else stored.name


@dataclass(frozen=True, kw_only=True)
class StoreLayout:
    """The parameters of a store, from which the sizes of its arrays follow. Picklable."""

    extent: tuple[int, int, int]  # x y z
    dtype: str
    width: int
    block: int = BLOCKS[0]
    threshold: float | None = None  # regions with no value above it are EMPTY
    value_range: Sequence[Sequence[float]] | None = None  # [low, high] of each channel
    times: int = 1  # time points
    label_count: int | None = None  # size of the table of labels, where they are indexed
    files_sum: int | None = None  # checksum of the list of checksums, see checksums.py

    @property
    def axes(self) -> str:
        """Axes of the pyramid's arrays."""
        return "tczyx" if self.times > 1 else "czyx" if self.width > 1 else "zyx"

    @property
    def levels(self) -> int:
        """Number of levels; the last one is one cell."""
        return 1 + max(0, math.ceil(math.log2(max(self.extent) / CELL)))

    @property
    def voxel_bytes(self) -> int:
        """Bytes of a voxel with all its channels."""
        return DTYPES[self.dtype] * self.width

    @property
    def shard(self) -> int:
        """Voxels along a side of the cube that one shard covers."""
        return 256 if self.voxel_bytes <= 2 else 128

    @property
    def bordered_side(self) -> int:
        """Voxels along a side of a block with its border."""
        return self.block + 2 * BORDER

    def shape(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) voxels of a level."""
        x, y, z = (-(-n // 2**level) for n in self.extent)
        return (z, y, x)

    def grid(self, level: int, side: int) -> tuple[int, int, int]:
        """(z, y, x) number of cubes of `side` voxels that cover a level."""
        z, y, x = (-(-n // side) for n in self.shape(level))
        return (z, y, x)

    def shards(self, level: int) -> tuple[int, int, int]:
        """(z, y, x) number of shards of a level; each is a task of the converter."""
        return self.grid(level, self.shard)

    @property
    def voxels(self) -> int:
        """Voxels of all levels and times."""
        return self.times * sum(math.prod(self.shape(level)) for level in range(self.levels))

    def shard_indices(self, level: int) -> Iterator[tuple[int, ...]]:
        """Indices of all shards of a level: (z, y, x), or (t, z, y, x) of several time points."""
        times = [self.times] if self.times > 1 else []
        return itertools.product(*map(range, (*times, *self.shards(level))))

    def at_time(self, array: Any, time: int) -> Any:
        """Returns an array of the store at one time point, without the time axis."""
        return array[time] if self.times > 1 else array

    def pyramid(self, level: int, *, path: str = "") -> dict[str, Any]:
        """Spec of the pyramid's array of a level."""
        channel_axis = [self.width] if "c" in self.axes else []
        return self._array(
            path or str(level),
            shape=[*channel_axis, *self.shape(level)],
            shard=[*channel_axis, *[self.shard] * 3],
            chunk=[1] * len(channel_axis) + [_PYRAMID_CHUNK] * 3,
            dimension_names=self.axes,
        )

    def blocks(self, level: int) -> dict[str, Any]:
        """Spec of the array of bordered blocks of a level."""
        path, item_shape = f"gvtorch/blocks/{level}", [self.bordered_side] * 3 + [self.width]
        return self._grid_array(path, level, self.block, self.shard, item_shape, write_zeros=False)

    def cells(self, level: int) -> dict[str, Any]:
        """Spec of the array of low, high, mean of a level."""
        path, item_shape = f"gvtorch/cells/{level}", [3, self.width]
        return self._grid_array(path, level, CELL, self.shard, item_shape, _CELL_CHUNK)

    def coarse_folder(self, time: int) -> str:
        """Returns the folder of a time point's coarse channels."""
        return "gvtorch/coarse" if self.times == 1 else f"gvtorch/coarse/{time}"

    def coarse(self, level: int, folder: str, width: int) -> dict[str, Any]:
        """Spec of the bordered blocks of a coarse channel in its folder, at a level from 1 on."""
        path, item_shape = f"{folder}/{level}", [self.bordered_side] * 3 + [width]
        layout = dataclasses.replace(self, dtype="float16", times=1)
        return layout._grid_array(path, level, self.block, _COARSE_SHARD, item_shape)

    def labels(self) -> dict[str, Any]:
        """Spec of the table of indexed labels."""
        count = self.label_count or 0
        shard = -(-count // _LABEL_CHUNK) * _LABEL_CHUNK
        layout = dataclasses.replace(self, dtype="int64", times=1)
        return layout._array("gvtorch/labels", shape=[count], shard=[shard], chunk=[_LABEL_CHUNK])

    def bounds(self, level: int) -> list[dict[str, Any]]:
        """Specs of the temporary arrays of the smallest and largest finest value in each voxel.
        Level 0 needs none (its values are both), nor does the last (no level is made from it).
        """
        needed = 0 < level < self.levels - 1
        paths = [f"{WORK}/{bound}/{level}" for bound in ("low", "high")]
        return [self.pyramid(level, path=path) for path in paths] if needed else []

    def _grid_array(
        self,
        path: str,
        level: int,
        side: int,
        shard_side: int,
        item_shape: list[int],
        chunk_items: int = 1,
        *,
        write_zeros: bool = True,
    ) -> dict[str, Any]:
        """Spec of an array of items of `item_shape`, one for each cube of `side` voxels of a level;
        `chunk_items` are the items along a side of a chunk.
        """
        return self._array(
            path,
            shape=[*self.grid(level, side), *item_shape],
            shard=[shard_side // side] * 3 + item_shape,
            chunk=[chunk_items] * 3 + item_shape,
            write_zeros=write_zeros,
        )

    def _array(
        self,
        path: str,
        *,
        shape: list[int],
        shard: list[int],
        chunk: list[int],
        dimension_names: str = "",
        write_zeros: bool = True,
    ) -> dict[str, Any]:
        if self.times > 1:  # each time point has shards of its own
            shape, shard, chunk = [self.times, *shape], [1, *shard], [1, *chunk]
        item_bytes = {**DTYPES, "int64": 8}[self.dtype]
        has_byte_order = item_bytes > 1
        little_endian = {"name": "bytes", "configuration": {"endian": "little"}}
        crc = {"name": "crc32c"}
        shuffle = "shuffle" if has_byte_order else "noshuffle"
        blosc = {"cname": "lz4", "clevel": 5, "shuffle": shuffle, "blocksize": 0}
        blosc["typesize"] = item_bytes
        bytes_codec = little_endian if has_byte_order else {"name": "bytes"}
        sharding = {
            "chunk_shape": chunk,
            "codecs": [bytes_codec, {"name": "blosc", "configuration": blosc}, crc],
            "index_codecs": [little_endian, crc],
        }
        metadata: dict[str, Any] = {
            "shape": shape,
            "data_type": self.dtype,
            "fill_value": 0.0 if self.dtype.startswith("float") else 0,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": shard}},
            "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
        }
        if dimension_names:
            metadata["dimension_names"] = list(dimension_names)
        return {"path": path, "driver": "zarr3", "metadata": metadata, WRITE_ZEROS: write_zeros}

    def attributes(self, placement: dict[str, Any]) -> dict[str, Any]:
        """Returns the metadata of a complete store; `placement` is its spacing and origin."""
        return {
            "version": VERSION + (self.times > 1),
            "extent": list(self.extent),
            **({"times": self.times} if self.times > 1 else {}),
            **({} if self.label_count is None else {"label_count": self.label_count}),
            **placement,
            "dtype": self.dtype,
            "channels": self.width,
            "block": self.block,
            "border": BORDER,
            "cell": CELL,
            "levels": self.levels,
            "branching": 2,
            "threshold": self.threshold,
            "value_range": self.value_range,
            "complete": True,
        }

    @classmethod
    def parse(cls, location: str, attributes: Any) -> StoreLayout:
        """Reads `attributes`; raises ValueError unless they are what `convert` writes."""
        if not isinstance(attributes, dict) or attributes.get("complete") is not True:
            raise ValueError(
                f"{location}: half-written or damaged: zarr.json does not say complete"
            )
        if (version := attributes.get("version")) not in (VERSION, VERSION + 1):
            raise ValueError(
                f"{location}: store version {brief(version)}, this reads "
                f"{VERSION} and {VERSION + 1}"
            )
        optional = dict.fromkeys(("label_count", "files_sum", "threshold"))
        given: dict[str, Any] = {"times": 1, **optional, **attributes}
        extent: Any = given.get("extent")
        ranges: Any = given.get("value_range")
        checks: dict[str, Any] = {
            "extent": _is_list(extent, 3)
            and all(_is_whole(n, 1, MAX_STORE_VOXELS) for n in extent),
            "times": _is_whole(given["times"], *((2, MAX_TIMES) if version > 1 else (1, 1))),
            "dtype": given.get("dtype") in list(DTYPES),
            "label_count": given["label_count"] is None
            or _is_whole(given["label_count"], 1, 2**24),
            "files_sum": given["files_sum"] is None or _is_whole(given["files_sum"], 0, 2**32 - 1),
            "channels": _is_whole(given.get("channels"), 1, 2**16),
            "block": given.get("block") in BLOCKS,
            "border": given.get("border") == BORDER,
            "cell": given.get("cell") == CELL,
            "branching": given.get("branching") == 2,
            "threshold": given["threshold"] is None or is_number(given["threshold"]),
            "value_range": _is_list(ranges, given.get("channels"))
            and all(_is_list(pair, 2) for pair in ranges)
            and all(is_number(low) and is_number(high) and low <= high for low, high in ranges),
        }
        if invalid := [key for key, is_valid in checks.items() if not is_valid]:
            value = brief(attributes.get(invalid[0]))
            raise ValueError(f"{location}: damaged: gvtorch.{invalid[0]} is {value}")
        copied = ("dtype", "block", "value_range", "times", "label_count", "files_sum", "threshold")
        fields = {key: given[key] for key in copied}
        return cls(extent=tuple(given["extent"]), width=given["channels"], **fields)


@dataclass(frozen=True, kw_only=True)
class CoarseChannel:
    """A coarse channel of a store: float16 numbers of all voxels above the finest level."""

    width: int
    made_of: dict[str, Any]  # what it was computed from, as JSON
    generation: int = 0  # times it was replaced: readers of an older one fail, and read no mixture

    def attributes(self) -> dict[str, Any]:
        """Returns its metadata."""
        return {"version": VERSION, **dataclasses.asdict(self)}

    def folder(self, name: str) -> str:
        """Returns the name of its folder."""
        return f"{name}.{self.generation}"

    @classmethod
    def parse(cls, location: str, attributes: Any) -> dict[str, CoarseChannel]:
        """Returns the channels in a store's metadata, by name; raises ValueError unless they are as
        `make_channel` writes them.
        """
        channels = attributes.get("channels") if isinstance(attributes, dict) else None
        if not isinstance(channels, dict):
            raise ValueError(f"{location}: damaged: gvtorch/coarse names no channels")
        parsed = {}
        for name, entry in channels.items():
            if not (
                is_name(name)
                and isinstance(entry, dict)
                and isinstance(entry.get("made_of"), dict)
                and entry.get("version") == VERSION
                and _is_whole(entry.get("width"), 1, 2**12)
                and _is_whole(entry.get("generation"), 0, 2**31)
            ):
                raise ValueError(
                    f"{location}: damaged: gvtorch/coarse has {brief(entry)} for {brief(name)}"
                )
            parsed[name] = cls(**{key: entry[key] for key in ("width", "made_of", "generation")})
        return parsed


def is_name(value: Any) -> bool:
    """Returns whether a value may name a channel: 1 to 64 letters, digits, "-" and "_"."""
    return isinstance(value, str) and re.fullmatch(r"[\w-]{1,64}", value, re.ASCII) is not None


def is_number(value: Any) -> bool:
    """Returns whether a value from JSON is a number, not a bool, and finite as a float."""
    is_real = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_real and -sys.float_info.max <= value <= sys.float_info.max


def _is_list(value: Any, size: Any) -> bool:
    return isinstance(value, list) and len(value) == size


def _is_whole(value: Any, low: int, high: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
