"""`SurfaceFile`: writes triangles that arrive part by part to a PLY or binary glTF file.

Vertices and triangles are collected in temporary files first, since both formats begin with their
numbers; memory holds a part at a time.

Sources: Turk, "The PLY polygon file format", 1994; glTF 2.0 specification (Khronos), sections 3.6
and 4.4.
"""

from __future__ import annotations

import json
import shutil
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from ..base.whole_file import whole_file

ENDINGS = (".ply", ".glb")
_MAX_VERTICES = 2**31 - 1  # that int32 can index
_COPY_BYTES = 1 << 24  # at a time
_CHUNK_ALIGNMENT = 4  # chunks of a .glb end at multiples of this


def check_surface_path(context: str, path: Path) -> None:
    """Raises ValueError or FileNotFoundError unless a surface may be written there."""
    if path.suffix not in ENDINGS:
        raise ValueError(f"{context}: path must end in {' or '.join(ENDINGS)}, got {str(path)!r}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{context}: folder not found: {path.parent}")


class SurfaceFile:
    """A file of triangles that appears once it is complete:

    with SurfaceFile(path, origin, step).opened() as file:
        file.add(vertices, faces)

    Attributes:
        vertices: Number of vertices so far.
        triangles: Number of triangles so far.
    """

    def __init__(self, path: Path, origin: np.ndarray, step: float) -> None:
        """Describes the file: a .ply holds world positions, float32 if that resolves a thousandth
        of `step`, else float64; a .glb holds float32 relative to `origin`, its translation.
        """
        self._path, self._origin = path, origin
        self._is_glb, self._step = path.suffix == ".glb", step
        self.vertices = self.triangles = 0
        self._bounds = np.array([[np.inf] * 3, [-np.inf] * 3])

    @contextmanager
    def opened(self) -> Iterator[SurfaceFile]:
        """Yields itself; writes the file at the end, or nothing after an error."""
        folder = self._path.parent
        with (
            whole_file(self._path) as draft,
            tempfile.TemporaryFile(dir=folder) as self._vertex_file,
            tempfile.TemporaryFile(dir=folder) as self._face_file,
        ):
            yield self
            with draft.open("wb") as file:
                (self._write_glb if self._is_glb else self._write_ply)(file)

    def add(self, positions: np.ndarray, faces: np.ndarray) -> None:
        """Appends (v, 3) float64 world x y z, and (f, 3) indices of all vertices added so far."""
        self.vertices += len(positions)
        self.triangles += len(faces)
        if self.vertices > _MAX_VERTICES:
            raise ValueError(f"{self._path}: over {_MAX_VERTICES} vertices: take a coarser level")
        if self._is_glb:
            local = (positions - self._origin).astype("<f4")
            self._vertex_file.write(local.tobytes())
            self._face_file.write(faces.astype("<u4").tobytes())
            positions = local
        else:
            self._vertex_file.write(positions.astype("<f8").tobytes())
            rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
            rows["count"], rows["corners"] = 3, faces
            self._face_file.write(rows.tobytes())
        if len(positions):
            self._bounds[0] = np.minimum(self._bounds[0], positions.min(0))
            self._bounds[1] = np.maximum(self._bounds[1], positions.max(0))

    def _write_ply(self, file: IO[bytes]) -> None:
        largest = max(1.0, float(np.abs(self._bounds).max())) if self.vertices else 1.0
        needs_double = np.spacing(np.float32(largest)) > self._step / 1000
        property_type = "double" if needs_double else "float"
        lines = [
            *("ply", "format binary_little_endian 1.0", f"element vertex {self.vertices}"),
            *(f"property {property_type} {axis}" for axis in "xyz"),
            *(f"element face {self.triangles}", "property list uchar int vertex_indices"),
            "end_header\n",
        ]
        file.write("\n".join(lines).encode())
        self._vertex_file.seek(0)
        while part := self._vertex_file.read(_COPY_BYTES):
            file.write(part if needs_double else np.frombuffer(part, "<f8").astype("<f4").tobytes())
        self._face_file.seek(0)
        shutil.copyfileobj(self._face_file, file, _COPY_BYTES)

    def _write_glb(self, file: IO[bytes]) -> None:
        sizes = 12 * self.vertices, 12 * self.triangles
        header = json.dumps(self._gltf_header(*sizes), separators=(",", ":")).encode()
        header += b" " * (-len(header) % _CHUNK_ALIGNMENT)
        total = 12 + 8 + len(header) + 8 + sum(sizes)
        if total >= 2**32:
            raise ValueError(f"{self._path}: .glb ends at 4 GB, {total / 1e9:.1f} GB came: .ply")
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(header), b"JSON") + header)
        file.write(struct.pack("<I4s", sum(sizes), b"BIN\0"))
        for temporary in (self._vertex_file, self._face_file):
            temporary.seek(0)
            shutil.copyfileobj(temporary, file, _COPY_BYTES)

    def _gltf_header(self, vertex_bytes: int, face_bytes: int) -> dict[str, object]:
        """Returns the JSON of a .glb, given the sizes of both parts in bytes."""
        bounds = {"min": self._bounds[0].tolist(), "max": self._bounds[1].tolist()}
        primitive = {"attributes": {"POSITION": 0}, "indices": 1, "material": 0}
        color = {"baseColorFactor": [0.8, 0.8, 0.8, 1], "metallicFactor": 0, "roughnessFactor": 0.6}
        views = [(0, vertex_bytes, 34962), (vertex_bytes, face_bytes, 34963)]
        parts = [
            (5126, self.vertices, {"type": "VEC3", **bounds}),
            (5125, 3 * self.triangles, {"type": "SCALAR"}),
        ]
        return {
            "asset": {"version": "2.0", "generator": "gvtorch"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "translation": self._origin.tolist()}],
            "meshes": [{"primitives": [primitive]}],
            "materials": [{"pbrMetallicRoughness": color}],
            "buffers": [{"byteLength": vertex_bytes + face_bytes}],
            "bufferViews": [
                {"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target}
                for offset, size, target in views
            ],
            "accessors": [
                {"bufferView": view, "componentType": kind, "count": count, **fields}
                for view, (kind, count, fields) in enumerate(parts)
            ],
        }
