"""Volumes at positions that float64 can't resolve: the same one-line error from every format and
command, without a NumPy warning before it.
"""

from __future__ import annotations

import json
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers import gvtorch

import gvtorch as gv
from gvtorch.io.reading import open_source

REASON = r"degenerate|must (be|lie)|can't be read|damaged"
VOXELS = np.arange(120, dtype="<f4")
PLAIN = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
Place = tuple[tuple[float, ...], tuple[float, ...]]


def nrrd(folder: Path, place: Place) -> Path:
    rows = " ".join(f"({','.join(map(repr, row))})" for row in np.diag(place[0]).tolist())
    head = f"NRRD0004\ntype: float\ndimension: 3\nsizes: 4 5 6\nendian: little\nencoding: raw\n\
space: left-posterior-superior\nspace directions: {rows}\n\
space origin: ({','.join(map(repr, place[1]))})\n\n"
    (folder / "a.nrrd").write_bytes(head.encode() + VOXELS.tobytes())
    return folder / "a.nrrd"


def metaimage(folder: Path, place: Place) -> Path:
    spacing, origin = (" ".join(map(repr, part)) for part in place)
    head = f"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n\
TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = {origin}\nElementSpacing = {spacing}\n\
DimSize = 4 5 6\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
    (folder / "a.mha").write_bytes(head.encode() + VOXELS.tobytes())
    return folder / "a.mha"


def nifti(folder: Path, place: Place) -> Path:
    raw = bytearray(352)
    struct.pack_into("<i", raw, 0, 348)
    struct.pack_into("<8h", raw, 40, 3, 4, 5, 6, 1, 1, 1, 1)
    struct.pack_into("<2h", raw, 70, 16, 32)
    with np.errstate(over="ignore"):
        raw[76:108] = np.float32([1, *place[0], 0, 0, 0, 0]).tobytes()
        raw[256:280] = np.float32([0, 0, 0, *place[1]]).tobytes()
    struct.pack_into("<f", raw, 108, 352.0)
    struct.pack_into("<h", raw, 252, 1)
    raw[344:348] = b"n+1\0"
    (folder / "a.nii").write_bytes(bytes(raw) + VOXELS.tobytes())
    return folder / "a.nii"


def vti(folder: Path, place: Place) -> Path:
    spacing, origin = (" ".join(map(repr, part)) for part in place)
    (folder / "a.vti").write_text(
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian"><ImageData '
        f'WholeExtent="0 1 0 1 0 1" Origin="{origin}" Spacing="{spacing}" '
        'Direction="1 0 0 0 1 0 0 0 1"><Piece Extent="0 1 0 1 0 1"><PointData><DataArray '
        'type="Float32" Name="s" format="ascii">1 2 3 4 5 6 7 8</DataArray></PointData></Piece>'
        "</ImageData></VTKFile>"
    )
    return folder / "a.vti"


def zarr(folder: Path, place: Place) -> Path:
    transforms = [
        {"type": kind, "scale" if kind == "scale" else kind: list(part)}
        for kind, part in zip(("scale", "translation"), place, strict=True)
    ]
    image = {
        "version": "0.4",
        "axes": [{"name": name, "type": "space"} for name in "zyx"],
        "datasets": [{"path": "0", "coordinateTransformations": transforms}],
    }
    array = {"zarr_format": 2, "shape": [4, 5, 6], "chunks": [4, 5, 6], "dtype": "<f4"}
    array |= {"compressor": None, "fill_value": 0, "order": "C", "filters": None}
    store = folder / "a.zarr"
    (store / "0").mkdir(parents=True, exist_ok=True)
    (store / ".zgroup").write_text('{"zarr_format": 2}')
    (store / ".zattrs").write_text(json.dumps({"multiscales": [image]}))
    (store / "0" / ".zarray").write_text(json.dumps(array))
    (store / "0" / "0.0.0").write_bytes(VOXELS.tobytes())
    return store


FORMATS = {
    "nrrd": (nrrd, "nrrd"),
    "mha": (metaimage, None),
    "nii": (nifti, "nibabel"),
    "vti": (vti, None),
    "zarr": (zarr, "tensorstore"),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_places_beyond_numbers_are_one_line(tmp_path, kind):
    write, library = FORMATS[kind]
    if library:
        pytest.importorskip(library)
    spacing, origin = PLAIN
    assert open_source(write(tmp_path, PLAIN)).spacing == spacing
    for number in (1e308, 1e200, np.inf, -np.inf, np.nan, -1e308, 1e30, 5e-324, 0.0):
        for placement in (
            ((number, 1.0, 1.0), origin),
            ((number,) * 3, origin),
            (spacing, (number, 0.0, 0.0)),
        ):
            with np.errstate(over="ignore"):
                n = float(np.float32(number)) if kind == "nii" else number
            if (placement[0] is spacing and abs(n) < 1e15) or (placement[0] is not spacing and
                                                               1e-60 <= n <= 1e60):  # fmt: skip
                continue  # valid
            if kind == "nii" and placement[0] is not spacing and n <= 0:
                continue  # nibabel repairs it, see below
            path = write(tmp_path, placement)
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                for read in (open_source, gv.read_volume, gv.Store.open):
                    if (read == gv.Store.open) != (kind == "zarr"):
                        continue
                    with pytest.raises(ValueError, match=REASON) as caught:
                        read(path)
                    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("far", [1e16, 1e20, 1e300, 1e308])
def test_voxels_that_float64_does_not_tell_apart_are_refused_everywhere(tmp_path, far):
    """`info` and `convert` once accepted them; `render` showed nothing, or blamed its camera."""
    path = vti(tmp_path, ((1.0, 1.0, 1.0), (far, 0.0, 0.0)))
    np.save(tmp_path / "a.npy", VOXELS.reshape(4, 5, 6))
    moved = (tmp_path / "a.npy", "--spacing", f"{1 / far:g},1,1")
    assert gvtorch("info", *moved).returncode == (0 if far < 1e60 else 2)
    for command in ("info", "render", "slice", "convert"):
        more = {"info": (), "convert": (tmp_path / "b.zarr",)}.get(command, ("-o", "a.png"))
        run = gvtorch(command, path, *more, cwd=tmp_path)
        assert run.returncode == 2 and run.stderr.count("\n") == 1, run.stderr
        assert "origin must lie within 1.1259e+15 voxels of 0" in run.stderr
    for make in (gv.Volume, lambda data, **place: gv.Producer(4, **place)):
        with pytest.raises(ValueError, match="origin must lie within"):
            make(np.zeros((4, 4, 4), np.uint8), origin=(far, 0, 0))
    edge = gv.Volume(np.zeros((4, 4, 4), np.uint8), origin=(-(2.0**50), 0, 0))
    assert edge.origin[0] + edge.spacing[0] / 8 > edge.origin[0]


def test_what_nibabel_mends_in_a_header_is_told_once_and_of_the_file(tmp_path, capfd):
    pytest.importorskip("nibabel")
    path = nifti(tmp_path, ((0.0, -2.0, 3.0), PLAIN[1]))
    with pytest.warns(UserWarning, match=r"a\.nii: not kept: pixdim.* should be non-zero"):
        volume = gv.read_volume(path)
    assert volume.spacing == (1, 2, 3) and capfd.readouterr().err == ""
