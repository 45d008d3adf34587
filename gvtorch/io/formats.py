"""`read_volume`: a file or folder -> `Volume`, each format through its own library.

Every reader looks at the header first and refuses an extent that does not fit, before memory is
taken. Nothing is unpickled. RAW and NPY are read here; NIfTI, NRRD, TIFF and FITS need `pip
install 'gvtorch[io]'`.
"""

from __future__ import annotations

import bz2
import gzip
import importlib
import re
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..base import check
from ..base.volume import Volume, check_extent

_RAW_NAME = re.compile(r"_(\d+)x(\d+)x(\d+)_([a-z]+\d+)(?:_?(le|be))?(?=[._]|$)")


class _Grid:
    """What a reader found: data (z, y, x[, c]) and its place, where the file tells it."""

    def __init__(
        self,
        data: np.ndarray,
        spacing: Sequence[float] | None = None,
        origin: Sequence[float] | None = None,
    ) -> None:
        self.data, self.spacing, self.origin = data, spacing, origin


def read_volume(
    path: str | Path,
    *,
    shape: Sequence[int] | None = None,
    dtype: str | np.dtype | None = None,
    spacing: Sequence[float] | None = None,
    origin: Sequence[float] | None = None,
    key: str | None = None,
    nan: float | None = None,
) -> Volume:
    """Reads a volume.

    Formats: RAW (`.raw`, `.raw.gz`; x fastest), `.npy`, `.npy.gz`, `.npy.bz2`, `.npz`, NIfTI
        (`.nii`, `.nii.gz`),
    NRRD (`.nrrd`, `.nhdr`), TIFF (`.tif`, `.tiff`, or a folder of them), FITS (`.fits`,
    `.fits.gz`). NumPy arrays are (z, y, x) or (z, y, x, c). NIfTI and NRRD with axes along the
    world's are turned to x, y, z; oblique ones keep their voxel axes, with a warning.

    Args:
        path: The file, or a folder of TIFF slices.
        shape: RAW only: (x, y, z) voxels; the name's `_XxYxZ_dtype` if left out.
        dtype: RAW only: a NumPy dtype, as in "int16" or ">i2"; the name's if left out.
        spacing: (x, y, z) world units; overrides the file's. 1 where neither tells.
        origin: (x, y, z) world place of the first voxel's centre; overrides the file's. 0 where
            neither tells.
        key: `.npz` only: which array; needed where there are several.
        nan: Value for voxels that are NaN or infinite; they are refused if left out.

    Returns:
        The volume, dtype kept (64 and 32 bit integers and float64 become float32).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The format is unknown, the file is damaged or too short, or an argument does
            not fit.
        ImportError: A library is missing; the message tells which pip command brings it.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"volume not found: {path}")
    reader, what = _reader(path, key)
    if reader is not _read_raw and (shape is not None or dtype is not None):
        raise ValueError(f"{path}: shape and dtype are for RAW files, {what} files tell their own")
    if key is not None and not path.name.lower().endswith(".npz"):
        raise ValueError(f"{path}: key is for NPZ files, this is {what}")
    try:
        grid = _read_raw(path, shape, dtype) if reader is _read_raw else reader(path)
    except (ImportError, FileNotFoundError):
        raise
    except Exception as error:  # damaged files make the format libraries raise anything
        reason = str(error) or type(error).__name__
        prefix = "" if reason.startswith(str(path)) else f"{path}: can't be read as {what}: "
        raise ValueError(prefix + " ".join(reason.split())) from error
    return Volume(
        grid.data,
        spacing=spacing if spacing is not None else grid.spacing or (1.0, 1.0, 1.0),
        origin=origin if origin is not None else grid.origin or (0.0, 0.0, 0.0),
        name=path.name,
        nan=nan,
    )


def _reader(path: Path, key: str | None) -> tuple[Callable[..., _Grid], str]:
    if path.is_dir():
        return _read_tiff_folder, "a folder of TIFF slices"
    name = path.name.lower()
    readers: dict[tuple[str, ...], tuple[Callable[..., _Grid], str]] = {
        (".raw", ".raw.gz"): (_read_raw, "RAW"),
        (".npy", ".npy.gz", ".npy.bz2"): (_read_npy, "NumPy"),
        (".npz",): (lambda path: _read_npz(path, key), "NumPy"),
        (".nii", ".nii.gz"): (_read_nifti, "NIfTI"),
        (".nrrd", ".nhdr"): (_read_nrrd, "NRRD"),
        (".tif", ".tiff"): (_read_tiff, "TIFF"),
        (".fits", ".fits.gz", ".fit"): (_read_fits, "FITS"),
    }
    for endings, found in readers.items():
        if name.endswith(endings):
            return found
    known = ", ".join(ending for endings in readers for ending in endings)
    raise ValueError(
        f"{path}: unknown volume format; known endings: {known}, or a folder of TIFF slices"
    )


def need(module: str, package: str, path: Path) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{path}: reading this format needs {package}: pip install 'gvtorch[io]' ({error})"
        ) from None


def unpacked_size(path: Path) -> int:
    """Bytes that a packed file holds, as far as it tells without being unpacked; else 0."""
    if path.name.lower().endswith(".npz") and zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            return max((item.file_size for item in archive.infolist()), default=0)
    if path.suffix.lower() == ".gz" and path.is_file() and path.stat().st_size > 4:
        with path.open("rb") as file:  # the last four bytes, modulo 2^32
            file.seek(-4, 2)
            told = int.from_bytes(file.read(4), "little")
        return max(told, path.stat().st_size)
    return path.stat().st_size


# --- RAW and NumPy
# ----------------------------------------------------------------------------------------


def _open(path: Path) -> IO[bytes]:
    if path.name.lower().endswith(".gz"):
        return gzip.open(path, "rb")  # type: ignore[return-value]
    return bz2.open(path, "rb") if path.name.lower().endswith(".bz2") else path.open("rb")


def raw_header(
    path: Path, shape: Sequence[int] | None, dtype: str | np.dtype | None
) -> tuple[tuple[int, int, int], np.dtype]:
    """Returns (x, y, z) voxels and dtype of a RAW file, from the arguments or its name."""
    named = _RAW_NAME.search(path.name.lower())
    if shape is None:
        if named is None:
            raise ValueError(
                f"{path}: a RAW file needs its extent: "
                "name it *_XxYxZ_dtype.raw or pass shape and dtype"
            )
        shape = [int(named[axis]) for axis in (1, 2, 3)]
    if dtype is None:
        if named is None:
            raise ValueError(
                f"{path}: a RAW file needs its dtype: name it *_XxYxZ_dtype.raw or pass dtype"
            )
        dtype = named[4]
        order = {"be": ">", "le": "<", None: "<"}[named[5]]
    else:
        order = "="
    try:
        kind = np.dtype(dtype)
    except TypeError:
        raise ValueError(f"{path}: dtype must be a NumPy dtype, got {dtype!r}") from None
    if kind.kind not in "iuf":
        raise ValueError(f"{path}: dtype must be an integer or a float, got {dtype!r}")
    if order != "=":
        kind = kind.newbyteorder(order)  # type: ignore[arg-type]
    if len(shape) != 3:
        raise ValueError(f"{path}: shape must be three numbers X,Y,Z, got {tuple(shape)}")
    x, y, z = (int(size) for size in shape)
    return (x, y, z), kind


def check_raw_size(path: Path, shape: tuple[int, int, int], kind: np.dtype, size: int) -> None:
    """Raises ValueError unless a RAW file has just the bytes that its extent takes."""
    x, y, z = shape
    expected = x * y * z * kind.itemsize
    if size != expected:
        got = f"{size}" if size < expected or path.suffix == ".raw" else "more"
        raise ValueError(
            f"{path}: {x}x{y}x{z} {kind.name} takes {expected} bytes, the file has {got}"
        )


def _read_raw(
    path: Path, shape: Sequence[int] | None = None, dtype: str | np.dtype | None = None
) -> _Grid:
    (x, y, z), kind = raw_header(path, shape, dtype)
    check_extent(str(path), (x, y, z))
    expected = x * y * z * kind.itemsize
    with _open(path) as file:
        content = file.read(expected + 1)
    size = path.stat().st_size if path.suffix == ".raw" else len(content)
    check_raw_size(path, (x, y, z), kind, size)
    return _Grid(np.frombuffer(content, kind).reshape(z, y, x))


def npy_header(file: IO[bytes], where: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns shape, Fortran order and dtype of a .npy stream, which is then at its data."""
    version = np.lib.format.read_magic(file)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read_header is None:
        raise ValueError(f"{where}: .npy version {version} is unknown")
    shape, fortran, dtype = read_header(file)
    if dtype.hasobject:
        raise ValueError(f"{where}: holds Python objects, not numbers")
    return shape, fortran, dtype


def _read_array(file: IO[bytes], where: str) -> np.ndarray:
    """Reads one .npy stream, its extent checked before its data is read."""
    shape, fortran, dtype = npy_header(file, where)
    check_extent(where, shape)
    expected = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    content = file.read(expected)
    if len(content) != expected:
        raise ValueError(
            f"{where}: {shape} {dtype} takes {expected} bytes, the file has {len(content)}"
        )
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


def _read_npy(path: Path) -> _Grid:
    with _open(path) as file:
        return _Grid(_read_array(file, str(path)))


def _read_npz(path: Path, key: str | None) -> _Grid:
    with zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        if key is None and len(names) != 1:
            raise ValueError(
                f"{path}: holds {len(names)} arrays, choose one with key: {', '.join(names)}"
            )
        chosen = names[0] if key is None else key
        if chosen not in names:
            raise ValueError(f"{path}: has no array {chosen!r}; it holds {', '.join(names)}")
        with archive.open(f"{chosen}.npy") as file:
            return _Grid(_read_array(file, str(path)))


# --- through libraries
# ------------------------------------------------------------------------------------


def _read_nifti(path: Path) -> _Grid:
    nibabel = need("nibabel", "nibabel", path)
    image = nibabel.load(path)
    check_extent(str(path), image.shape)
    if len(image.shape) not in (3, 4):
        raise ValueError(f"{path}: expected 3 or 4 dimensions, got {image.shape}")
    return _turned(path, np.asanyarray(image.dataobj), np.asarray(image.affine))


def _read_nrrd(path: Path) -> _Grid:
    nrrd = need("nrrd", "pynrrd", path)
    with path.open("rb") as file:
        header = nrrd.read_header(file)
    check_extent(str(path), [int(size) for size in header["sizes"]])
    data, header = nrrd.read(str(path), index_order="F")
    axis, affine = nrrd_place(header, data.ndim)
    return _turned(path, data if axis is None else np.moveaxis(data, axis, -1), affine)


def nrrd_place(header: dict[str, Any], rank: int) -> tuple[int | None, np.ndarray]:
    """Returns the axis that counts components, if any, and the (4, 4) place of the others."""
    directions = np.asarray(header.get("space directions", np.zeros((0, 3))), dtype=np.float64)
    spacings = np.asarray(header.get("spacings", np.zeros(0)), dtype=np.float64)
    kinds = list(header.get("kinds", ()))
    axis = None
    if rank == 4:  # one axis counts components: the one that is no place, else the first
        places = [np.isfinite(row).all() for row in directions] or list(np.isfinite(spacings))
        axis = places.index(False) if False in places else 0
        if kinds:
            axis = next(
                (i for i, kind in enumerate(kinds) if kind not in ("domain", "space")), axis
            )
        directions, spacings = (
            np.delete(a, axis, 0) if len(a) == 4 else a for a in (directions, spacings)
        )
    affine = np.eye(4)
    if directions.shape == (3, 3) and np.isfinite(directions).all():
        affine[:3, :3] = directions.T
    elif spacings.shape == (3,) and np.isfinite(spacings).all():
        affine[:3, :3] = np.diag(spacings)
    place = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    if place.shape == (3,) and np.isfinite(place).all():
        affine[:3, 3] = place
    return axis, affine


def orientation(
    path: Path, affine: np.ndarray, sizes: Sequence[int]
) -> tuple[list[int], list[bool], list[float], list[float]]:
    """Lays voxel axes along the world's; oblique ones stay as they are.

    Args:
        path: For messages.
        affine: (4, 4) voxel to world.
        sizes: Voxels along each voxel axis.

    Returns:
        For world axes x, y, z: which voxel axis lies along it, whether it runs backwards, spacing
        and origin.
    """
    matrix, place = affine[:3, :3], affine[:3, 3]
    lengths = np.linalg.norm(matrix, axis=0)
    if not np.isfinite(affine).all() or (lengths == 0).any():
        raise ValueError(f"{path}: the header's voxel axes are degenerate: {matrix.tolist()}")
    world_axis = np.abs(matrix).argmax(axis=0)  # of each voxel axis
    along = np.abs(matrix[world_axis, [0, 1, 2]]) / lengths
    if sorted(world_axis.tolist()) != [0, 1, 2] or (along < 1 - 1e-4).any():
        warnings.warn(
            f"{path.name}: voxel axes are oblique; the world's axes are taken along them",
            stacklevel=6,
        )
        return [0, 1, 2], [False] * 3, lengths.tolist(), place.tolist()
    order = np.argsort(world_axis)
    spacing = matrix[[0, 1, 2], order]
    origin = place.astype(np.float64).copy()
    for axis in range(3):
        if spacing[axis] < 0:
            origin[axis] += spacing[axis] * (sizes[order[axis]] - 1)
    return order.tolist(), (spacing < 0).tolist(), np.abs(spacing).tolist(), origin.tolist()


def _turned(path: Path, data_xyz: np.ndarray, affine: np.ndarray) -> _Grid:
    """Lays (x, y, z[, c]) data along the world's axes: permutes and flips."""
    order, flips, spacing, origin = orientation(path, affine, data_xyz.shape)
    data = np.moveaxis(data_xyz, order, (0, 1, 2))
    for axis, backwards in enumerate(flips):
        if backwards:
            data = np.flip(data, axis)
    return _Grid(_to_zyx(data), spacing, origin)


def _to_zyx(data_xyz: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.swapaxes(data_xyz, 0, 2))


def _read_tiff(path: Path) -> _Grid:
    tifffile = need("tifffile", "tifffile", path)
    with tifffile.TiffFile(path) as file:
        series = file.series[0]
        check_extent(str(path), series.shape)
        return _Grid(_zyxc(path, series.asarray(), series.axes), tiff_spacing(file))


def tiff_letters(path: Path, shape: Sequence[int], axes: str) -> str:
    """Returns what each axis of a TIFF series is: z, y, x, c, or - for one of size 1 to drop."""
    letters = "".join(
        "-" if size == 1 and letter not in "ZYX" else letter
        for size, letter in zip(shape, axes, strict=True)
    )
    others = [letter for letter in letters if letter not in "ZYXCS-"]
    if "Z" not in letters and len(others) == 1 and others[0] in "QI":
        letters, others = letters.replace(others[0], "Z"), []  # pages without a meaning: slices
    channels = [letter for letter in letters if letter in "CS"]
    if others or len(channels) > 1 or letters.count("Y") != 1 or letters.count("X") != 1:
        raise ValueError(
            f"{path}: axes {axes} {tuple(shape)}; expected Z, Y, X and at most one of C, S"
        )
    return letters.replace("S", "C").lower()


def _zyxc(path: Path, data: np.ndarray, axes: str) -> np.ndarray:
    """Lays an array out as (z, y, x[, c]) by the letters tifffile gives its axes."""
    letters = tiff_letters(path, data.shape, axes)
    data = data.squeeze(tuple(i for i, letter in enumerate(letters) if letter == "-"))
    letters = letters.replace("-", "")
    if "z" not in letters:
        data, letters = data[None], "z" + letters
    return data.transpose([letters.index(letter) for letter in "zyxc" if letter in letters])


def tiff_spacing(file: Any) -> tuple[float, float, float] | None:
    """Voxel size as ImageJ writes it: slices apart in the description, pixels per unit in the
    tags.
    """
    described = file.imagej_metadata
    if not described or "spacing" not in described:
        return None
    tags = file.pages[0].tags
    sides = []
    for name in ("XResolution", "YResolution"):
        pixels, units = tags[name].value if name in tags else (1, 1)
        sides.append(units / pixels if pixels > 0 else 1.0)
    return (sides[0], sides[1], float(described["spacing"]))


def tiff_slices(path: Path) -> list[Path]:
    """Returns the slices of a folder in natural order."""
    slices = [p for p in path.iterdir() if p.suffix.lower() in (".tif", ".tiff")]
    if not slices:
        raise ValueError(f"{path}: no .tif or .tiff slices in this folder")

    def natural(file: Path) -> list[tuple[int, str]]:
        return [
            (int(part or 0), part) if part.isdigit() else (-1, part)
            for part in re.split(r"(\d+)", file.name)
        ]

    return sorted(slices, key=natural)


def _read_tiff_folder(path: Path) -> _Grid:
    tifffile = need("tifffile", "tifffile", path)
    slices = tiff_slices(path)
    first = tifffile.imread(slices[0])
    check_extent(str(path), (len(slices), *first.shape))
    if first.ndim not in (2, 3):
        raise ValueError(f"{slices[0]}: expected one slice (y, x) or (y, x, c), got {first.shape}")
    data = np.empty((len(slices), *first.shape), first.dtype)
    for index, file in enumerate(slices):
        image = tifffile.imread(file)
        if image.shape != first.shape or image.dtype != first.dtype:
            raise ValueError(
                f"{file}: {image.shape} {image.dtype} differs from "
                f"{first.shape} {first.dtype} of {slices[0].name}"
            )
        data[index] = image
    return _Grid(data)


def _read_fits(path: Path) -> _Grid:
    """Spacing is 1: FITS axes have units of their own (degrees, m/s), a box in space has one."""
    fits = need("astropy.io.fits", "astropy", path)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*truncated.*")
        with fits.open(path, memmap=False) as units:
            cubes = [unit for unit in units if unit.is_image and len(unit.shape) >= 3]
            if not cubes:
                raise ValueError(f"{path}: holds no image of three dimensions")
            shape = cubes[0].shape
            check_extent(str(path), shape)
            if any(size != 1 for size in shape[:-3]):
                raise ValueError(f"{path}: expected a cube, got {shape}")
            return _Grid(np.asarray(cubes[0].data).reshape(shape[-3:]))


def describe(volume: Volume, bins: int = 32) -> dict[str, Any]:
    """Returns extent, dtype, place, range and histogram of a volume as plain values."""
    check.whole("describe", "bins", bins, low=1)
    low, high = volume.value_range
    values = (
        volume.data.numpy()
        if str(volume.data.dtype) != "torch.bfloat16"
        else volume.data.float().numpy()
    )
    counts, _ = np.histogram(values, bins=bins, range=(low, high) if high > low else (low, low + 1))
    return {
        "name": volume.name,
        "extent": list(volume.extent),
        "channels": int(volume.data.shape[3]),
        "dtype": str(volume.data.dtype).removeprefix("torch."),
        "spacing": list(volume.spacing),
        "origin": list(volume.origin),
        "range": [low, high],
        "mean": float(values.mean(dtype=np.float64)),
        "histogram": [int(count) for count in counts],
        "bytes": volume.data.nbytes,
    }
