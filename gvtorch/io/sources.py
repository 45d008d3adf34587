"""`Source`: a volume file of any size, read region by region; `open_source` makes one.

A source is plain data (path, offset, axes), so that worker processes can have it; files are opened
in the process that reads. The formats' headers are read in formats.py.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..base.volume import CHANNEL_DTYPES, Volume
from . import formats
from .layout import DTYPES, MOST_VOXELS
from .machine import amount, memory_free
from .store import Store

_TIMEOUT = 600.0  # seconds for one read of another store
_NRRD_TYPES = {
    **{name: "i1" for name in ("signed char", "int8")},
    **{name: "u1" for name in ("uchar", "unsigned char", "uint8")},
    **{name: "i2" for name in ("short", "short int", "signed short", "signed short int", "int16")},
    **{name: "u2" for name in ("ushort", "unsigned short", "unsigned short int", "uint16")},
    **{name: "i4" for name in ("int", "signed int", "int32")},
    **{name: "u4" for name in ("uint", "unsigned int", "uint32")},
    **{name: "i8" for name in ("longlong", "long long", "long long int", "int64")},
    **{name: "u8" for name in ("ulonglong", "unsigned long long", "uint64")},
    **{"float": "f4", "double": "f8"},
}


@dataclass(frozen=True, kw_only=True)
class Source:
    """A volume in a file, as an array that lies there with axes in some order.

    Attributes:
        path: The file or folder.
        kind: How the array is read: "mapped", "nifti", "fits", "pages", "files" or "store".
        shape: Of the array as it lies there.
        axes: A letter for each of its axes: z, y, x, c, or - for one of size 1 to drop.
        stored: NumPy dtype as it lies there, with byte order.
        flips: Letters of axes that run backwards.
        offset: Bytes before the array.
        fortran: First axis fastest.
        files: One slice a file.
        spacing: (x, y, z) world units.
        origin: (x, y, z) world units.
        unit: Unit of length, or None.
    """

    path: str
    kind: str
    shape: tuple[int, ...]
    axes: str
    stored: str
    flips: str = ""
    offset: int = 0
    fortran: bool = False
    files: tuple[str, ...] = ()
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: str | None = None

    def __post_init__(self) -> None:
        """Checks sizes and dtype."""
        voxels = math.prod(self.size(axis) for axis in "zyx")
        if min(self.shape) < 1 or voxels > MOST_VOXELS:
            sizes = " x ".join(str(n) for n in self.shape)
            raise ValueError(f"{self.path}: extent {sizes} is empty or above {MOST_VOXELS} voxels")
        if self.dtype not in DTYPES:
            raise ValueError(f"{self.path}: values of dtype {self.stored} have no place in a store")

    @property
    def extent(self) -> tuple[int, int, int]:
        """(x, y, z) voxels."""
        return (self.size("x"), self.size("y"), self.size("z"))

    @property
    def width(self) -> int:
        """Number of channels."""
        return self.size("c")

    @property
    def dtype(self) -> str:
        """What values are read as: wider ones become float32, as in `Volume`."""
        kind = np.dtype(self.stored)
        if kind.kind == "b":
            return "uint8"
        kept = {str(dtype).removeprefix("torch.") for dtype in CHANNEL_DTYPES}
        return kind.name if kind.name in kept or kind.kind not in "iuf" else "float32"

    @property
    def nbytes(self) -> int:
        """Bytes of all values as they are read."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize

    @property
    def resident(self) -> int:
        """Bytes of memory that it takes."""
        return 0

    def size(self, axis: str) -> int:
        """Voxels along an axis, 1 where it has none."""
        return self.shape[self.axes.index(axis)] if axis in self.axes else 1

    def read_box(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Reads the box `low` to `high`, (z, y, x), which must lie inside.

        Returns:
            (z, y, x, c) of `dtype`.

        Raises:
            OSError: The file can't be read any more, or is damaged.
        """
        place = dict(zip("zyx", zip(low, high, strict=True), strict=True))
        index: list[Any] = []
        for axis, size in zip(self.axes, self.shape, strict=True):
            if axis == "-":
                index.append(slice(0, 1))
                continue
            a, b = place.get(axis, (0, size))
            index.append(slice(size - b, size - a) if axis in self.flips else slice(a, b))
        try:
            data = _READERS[self.kind](self, tuple(index))
        except OSError:
            raise
        except Exception as error:  # damaged files make the format libraries raise anything
            reason = " ".join(str(error).split()) or type(error).__name__
            raise OSError(f"{self.path}: can't be read: {reason}") from error
        letters = self.axes.replace("-", "")
        data = data.reshape(
            [n for n, axis in zip(data.shape, self.axes, strict=True) if axis != "-"]
        )
        for axis in "zyxc":
            if axis not in letters:
                data, letters = data[None], axis + letters
        data = data.transpose([letters.index(axis) for axis in "zyxc"])
        for axis in self.flips:
            data = np.flip(data, "zyx".index(axis))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # float64 beyond float32: infinite
            return np.array(data, self.dtype, order="C")


@dataclass(frozen=True, kw_only=True)
class Array:
    """A volume in memory, with what `Source` has."""

    path: str
    data: np.ndarray  # (z, y, x, c)
    spacing: tuple[float, float, float]
    origin: tuple[float, float, float]
    unit: str | None = None

    @classmethod
    def of(cls, volume: Volume) -> Array:
        """Takes a volume."""
        if str(volume.data.dtype).removeprefix("torch.") not in DTYPES:
            raise ValueError(f"{volume.name}: {volume.data.dtype} has no place in a store")
        data = volume.data.numpy()
        return cls(path=volume.name, data=data, spacing=volume.spacing, origin=volume.origin)

    @classmethod
    def read(cls, path: Path, options: dict[str, Any]) -> Array:
        """Reads a file that can't be read in parts.

        Raises:
            ValueError: It is damaged, or does not fit into memory.
        """
        free, size = memory_free(), formats.unpacked_size(path)
        if 2 * size > free:  # what was read, and what it is converted to
            raise ValueError(
                f"{path}: can only be read as a whole, which takes {amount(2 * size)}, and "
                f"{amount(free)} of memory are free: unpack it first"
            )
        return dataclasses.replace(cls.of(formats.read_volume(path, **options)), path=str(path))

    @property
    def extent(self) -> tuple[int, int, int]:
        """(x, y, z) voxels."""
        z, y, x, _ = self.data.shape
        return (x, y, z)

    @property
    def width(self) -> int:
        """Number of channels."""
        return int(self.data.shape[3])

    @property
    def dtype(self) -> str:
        """Name of the NumPy dtype."""
        return self.data.dtype.name

    @property
    def nbytes(self) -> int:
        """Bytes of all values."""
        return self.data.nbytes

    @property
    def resident(self) -> int:
        """Bytes of memory that it takes."""
        return self.data.nbytes

    def read_box(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Returns the box `low` to `high`, see `Source.read`."""
        return self.data[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]


def _read_mapped(source: Source, index: tuple[slice, ...]) -> np.ndarray:
    # Mapped anew for every read: pages of a mapping that stays count as this process's memory.
    order: Any = "F" if source.fortran else "C"
    kind = np.dtype(source.stored)
    data = np.memmap(source.path, kind, "r", source.offset, source.shape, order)
    return np.array(data[index])


def _read_nifti(source: Source, index: tuple[slice, ...]) -> np.ndarray:
    nibabel = formats.need("nibabel", "nibabel", Path(source.path))
    return np.asanyarray(nibabel.load(source.path).dataobj[index])


def _read_fits(source: Source, index: tuple[slice, ...]) -> np.ndarray:
    """Scaled images, plane by plane; those that are not scaled are mapped."""
    fits = formats.need("astropy.io.fits", "astropy", Path(source.path))
    first = (0,) * (len(index) - 3)
    with fits.open(source.path, memmap=False) as units:
        section = _cube(units).section
        planes = range(*index[-3].indices(source.shape[-3]))
        found = np.stack([np.asarray(section[(*first, z)])[index[-2:]] for z in planes])
    return found.reshape((1,) * len(first) + found.shape)


def _read_pages(source: Source, index: tuple[slice, ...]) -> np.ndarray:
    pages = _series(source.path).pages
    first = len(source.shape) - (3 if source.axes.endswith("c") else 2)
    spans = [range(*span.indices(n)) for span, n in zip(index[:first], source.shape, strict=False)]
    (slices,) = [span for span, axis in zip(spans, source.axes, strict=False) if axis == "z"] or [
        range(1)
    ]
    data = np.stack([pages[i].asarray()[index[first:]] for i in slices])
    return data.reshape([*map(len, spans), *data.shape[1:]])


def _read_files(source: Source, index: tuple[slice, ...]) -> np.ndarray:
    tifffile = formats.need("tifffile", "tifffile", Path(source.path))
    found = []
    for file in source.files[index[0]]:
        image = tifffile.imread(file)
        if image.shape != source.shape[1:] or image.dtype != np.dtype(source.stored):
            raise OSError(f"{file}: {image.shape} {image.dtype} differs from the first slice")
        found.append(image[index[1:]])
    return np.stack(found)


def _read_store(source: Source, index: tuple[slice, ...]) -> np.ndarray:
    low, high = [s.start for s in index[:3]], [s.stop for s in index[:3]]
    return _store(source.path).read_region(0, low, high, timeout=_TIMEOUT)


_READERS: dict[str, Callable[[Source, tuple[slice, ...]], np.ndarray]] = {
    "mapped": _read_mapped,
    "nifti": _read_nifti,
    "fits": _read_fits,
    "pages": _read_pages,
    "files": _read_files,
    "store": _read_store,
}


@functools.lru_cache(maxsize=4)
def _series(path: str) -> Any:
    return formats.need("tifffile", "tifffile", Path(path)).TiffFile(path).series[0]


@functools.lru_cache(maxsize=4)
def _store(path: str) -> Store:
    return Store.open(path)


def _cube(units: Any) -> Any:
    cubes = [unit for unit in units if unit.is_image and len(unit.shape) >= 3]
    if not cubes or any(size != 1 for size in cubes[0].shape[:-3]):
        raise ValueError("holds no image of three dimensions")
    return cubes[0]


# --- opening


def open_source(
    path: str | Path, *, shape: Sequence[int] | None = None, dtype: str | None = None
) -> Source | None:
    """Opens a volume for reading in regions.

    Args:
        path: A file or folder that `read_volume` knows, or an OME-Zarr image (folder or URL).
        shape: RAW only: (x, y, z) voxels.
        dtype: RAW only: a NumPy dtype.

    Returns:
        The source, or None where the format can only be read as a whole (packed files).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The header is damaged, or the extent too large.
    """
    text = str(path)
    if "://" in text or text.rstrip("/").endswith(".zarr") or _is_zarr(Path(path)):
        return _of_store(text)
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"volume not found: {path}")
    if path.is_dir():
        return _of_folder(path)
    readers: dict[str, Callable[[Path], Source | None]] = {
        ".raw": lambda path: _of_raw(path, shape, dtype),
        ".npy": _of_npy,
        ".nii": _of_nifti,
        ".nrrd": _of_nrrd,
        ".nhdr": _of_nrrd,
        ".tif": _of_tiff,
        ".tiff": _of_tiff,
        ".fits": _of_fits,
        ".fit": _of_fits,
    }
    reader = readers.get(path.suffix.lower())
    try:
        return reader(path) if reader else None
    except (ImportError, FileNotFoundError):
        raise
    except Exception as error:  # damaged files make the format libraries raise anything
        reason = str(error) or type(error).__name__
        prefix = "" if reason.startswith(str(path)) else f"{path}: can't be read: "
        raise ValueError(prefix + " ".join(reason.split())) from error


def _is_zarr(path: Path) -> bool:
    return any((path / name).is_file() for name in ("zarr.json", ".zattrs", ".zgroup"))


def _of_store(path: str) -> Source:
    store = Store.open(path)
    x, y, z = store.extent
    return Source(
        path=path,
        kind="store",
        shape=(z, y, x, store.width),
        axes="zyxc",
        stored=str(store.dtype).removeprefix("torch."),
        spacing=store.spacing,
        origin=store.origin,
        unit=store.unit,
    )


def _of_raw(path: Path, shape: Sequence[int] | None, dtype: str | None) -> Source:
    (x, y, z), kind = formats.raw_header(path, shape, dtype)
    source = Source(path=str(path), kind="mapped", shape=(z, y, x), axes="zyx", stored=kind.str)
    formats.check_raw_size(path, (x, y, z), kind, path.stat().st_size)
    return source


def _of_npy(path: Path) -> Source:
    with path.open("rb") as file:
        shape, fortran, dtype = formats.npy_header(file, str(path))
        offset = file.tell()
    if len(shape) not in (3, 4):
        raise ValueError(f"{path}: data must be (z, y, x) or (z, y, x, c), got shape {shape}")
    source = Source(
        path=str(path),
        kind="mapped",
        shape=tuple(int(n) for n in shape),
        axes="zyxc"[: len(shape)],
        stored=dtype.str,
        offset=offset,
        fortran=fortran,
    )
    _check_bytes(source)
    return source


def _check_bytes(source: Source) -> None:
    expected = source.offset + math.prod(source.shape) * np.dtype(source.stored).itemsize
    size = os.stat(source.path).st_size
    if size < expected:
        raise ValueError(f"{source.path}: its array ends at byte {expected}, the file has {size}")


def _placed(
    path: Path, affine: np.ndarray, shape: Sequence[int], axis: int | None
) -> dict[str, Any]:
    """What `Source` is told about axes that lie in the world by an affine."""
    places = [i for i in range(len(shape)) if i != axis]
    order, flips, spacing, origin = formats.orientation(path, affine, [shape[i] for i in places])
    letters = ["c"] * len(shape)
    for letter, voxel_axis in zip("xyz", order, strict=True):
        letters[places[voxel_axis]] = letter
    return {
        "axes": "".join(letters),
        "flips": "".join(a for a, backwards in zip("xyz", flips, strict=True) if backwards),
        "spacing": tuple(spacing),
        "origin": tuple(origin),
    }


def _of_nifti(path: Path) -> Source:
    nibabel = formats.need("nibabel", "nibabel", path)
    image = nibabel.load(path)
    shape = tuple(int(n) for n in image.shape)
    if len(shape) not in (3, 4):
        raise ValueError(f"{path}: expected 3 or 4 dimensions, got {shape}")
    one = np.asanyarray(image.dataobj[(slice(0, 1),) * len(shape)])
    place = _placed(path, np.asarray(image.affine), shape, 3 if len(shape) == 4 else None)
    return Source(path=str(path), kind="nifti", shape=shape, stored=one.dtype.str, **place)


def _of_nrrd(path: Path) -> Source | None:
    nrrd = formats.need("nrrd", "pynrrd", path)
    with path.open("rb") as file:
        header = nrrd.read_header(file)
        offset = file.tell()
    data = header.get("data file", header.get("datafile"))
    skip = int(header.get("byte skip", header.get("byteskip", 0)))
    lines = int(header.get("line skip", header.get("lineskip", 0)))
    kind = _NRRD_TYPES.get(str(header["type"]).lower().removesuffix("_t"))
    if header["encoding"] != "raw" or kind is None or lines or skip < 0:
        return None
    if data is not None:
        if not isinstance(data, str) or data.startswith("LIST") or "%" in data:
            return None
        offset = 0
    file_path = path if data is None else path.parent / data
    shape = tuple(int(n) for n in header["sizes"])
    if len(shape) not in (3, 4):
        return None
    order = ">" if header.get("endian") == "big" else "<"
    axis, affine = formats.nrrd_place(header, len(shape))
    source = Source(
        path=str(file_path),
        kind="mapped",
        shape=shape,
        stored=np.dtype(order + kind).str,
        offset=offset + skip,
        fortran=True,
        **_placed(path, affine, shape, axis),
    )
    _check_bytes(source)
    return source


def _of_tiff(path: Path) -> Source | None:
    tifffile = formats.need("tifffile", "tifffile", path)
    with tifffile.TiffFile(path) as file:
        series = file.series[0]
        letters = formats.tiff_letters(path, series.shape, series.axes)
        told: dict[str, Any] = {
            "path": str(path),
            "shape": tuple(int(n) for n in series.shape),
            "axes": letters,
            "spacing": formats.tiff_spacing(file) or (1.0, 1.0, 1.0),
        }
        if series.dataoffset is not None:
            kind = series.dtype.newbyteorder(file.byteorder).str
            return Source(kind="mapped", stored=kind, offset=int(series.dataoffset), **told)
        page = 3 if letters.endswith("yxc") else 2
        if letters[-page:] not in ("yx", "yxc") or letters[:-page].replace("-", "") not in (
            "",
            "z",
        ):
            return None
        return Source(kind="pages", stored=series.dtype.str, **told)


def _of_folder(path: Path) -> Source:
    tifffile = formats.need("tifffile", "tifffile", path)
    slices = formats.tiff_slices(path)
    first = tifffile.imread(slices[0])
    if first.ndim not in (2, 3):
        raise ValueError(f"{slices[0]}: expected one slice (y, x) or (y, x, c), got {first.shape}")
    return Source(
        path=str(path),
        kind="files",
        shape=(len(slices), *first.shape),
        axes="zyxc"[: 1 + first.ndim],
        stored=first.dtype.str,
        files=tuple(str(file) for file in slices),
    )


def _of_fits(path: Path) -> Source:
    fits = formats.need("astropy.io.fits", "astropy", path)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*truncated.*")
        with fits.open(path, memmap=False) as units:
            cube = _cube(units)
            shape = tuple(int(n) for n in cube.shape)
            plain = not any(key in cube.header for key in ("BSCALE", "BZERO", "BLANK"))
            one = np.asarray(cube.section[(slice(0, 1),) * len(shape)])
            offset = int(cube.fileinfo()["datLoc"])
            plain = plain and not isinstance(cube, fits.CompImageHDU)
    axes = "-" * (len(shape) - 3) + "zyx"
    told: dict[str, Any] = {"path": str(path), "shape": shape, "axes": axes}
    if not plain:
        return Source(kind="fits", stored=one.dtype.str, **told)
    source = Source(kind="mapped", stored=one.dtype.newbyteorder(">").str, offset=offset, **told)
    _check_bytes(source)
    return source
