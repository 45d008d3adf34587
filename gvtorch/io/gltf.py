"""`plain_gltf`: checks a glTF file, and rewrites what trimesh would not read as the specification
says: integers that stand for fractions, moved or second texture coordinates, colours of vertices
that have a material, and triangle fans.

Source: glTF 2.0 specification (Khronos), sections 3.6, 3.7 and 3.9; its extensions
KHR_mesh_quantization and KHR_texture_transform.
"""

from __future__ import annotations

import base64
import copy
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {width: name for name, width in _WIDTHS.items()}
_FAN = 6  # the mode of a primitive
#: The attribute that holds vertex colours: trimesh drops COLOR_0 where there is a material.
COLORS = "_COLOR_0"
#: Extensions that a file may require. Others pack or replace what is read here.
_EXTENSIONS = (
    *("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_", "KHR_materials_"),
    "EXT_texture_webp",
)


def plain_gltf(content: bytes, packed: bool, read: Callable[[str], bytes]) -> bytes:
    """Returns a file with the same meshes that trimesh reads as the specification says.

    Args:
        content: A .gltf file, or a .glb one if `packed`.
        packed: Whether the header and the first buffer are chunks of the file.
        read: Returns the content of a buffer in another file, by its name.

    Raises:
        ValueError: The file needs an extension that is not read, or an accessor claims more values
            than its buffer holds, or has numbers that trimesh would not find, and read as zeros.
    """
    length = int.from_bytes(content[12:16], "little") if packed else len(content)
    header_start = 20 if packed else 0
    header = json.loads(content[header_start : header_start + length])
    _check(header)
    meshes = copy.deepcopy(header.get("meshes"))
    plain = _Plain(header, memoryview(content)[header_start + length + 8 :], read)
    for mesh in header.get("meshes", ()):
        for primitive in mesh["primitives"]:
            plain.rewrite(primitive)
    if header.get("meshes") == meshes:
        return content
    if plain.added:
        uri = "data:application/octet-stream;base64," + base64.b64encode(plain.added).decode()
        header["buffers"].append({"byteLength": len(plain.added), "uri": uri})
    text = json.dumps(header).encode()
    if not packed:
        return text
    text += b" " * (-len(text) % 4)
    chunks = content[20 + length :]
    sizes = struct.pack("<II4s", 20 + len(text) + len(chunks), len(text), b"JSON")
    return content[:8] + sizes + text + chunks


def _check(header: dict[str, Any]) -> None:
    for name in header.get("extensionsRequired", ()):
        if not str(name).startswith(_EXTENSIONS):
            raise ValueError(f"it needs the extension {name}, which is not read")
    for view in header.get("bufferViews", ()):
        if min(view.get("byteOffset", 0), view["byteLength"]) < 0:
            raise ValueError("a part of a buffer lies before its start")
    for number, accessor in enumerate(header.get("accessors", ())):
        if "bufferView" not in accessor or "sparse" in accessor:
            raise ValueError(f"accessor {number} is sparse or packed by an extension")
        length = header["bufferViews"][accessor["bufferView"]]["byteLength"]
        if not 0 <= accessor["count"] <= length or accessor.get("byteOffset", 0) < 0:
            raise ValueError(f"accessor {number} has {accessor['count']} values in {length} bytes")


class _Plain:
    """Rewrites primitives of a header; `added` holds the numbers of a further buffer for them."""

    def __init__(
        self, header: dict[str, Any], chunk: memoryview, read: Callable[[str], bytes]
    ) -> None:
        self.header, self.added = header, bytearray()
        self._chunk, self._read = chunk, read
        self._buffers: dict[int, bytes | memoryview] = {}
        self._copies: dict[Any, int] = {}  # accessors made, by what they were made of

    def rewrite(self, primitive: dict[str, Any]) -> None:
        """Refers a primitive to accessors that trimesh reads right."""
        attributes, look = primitive["attributes"], {}
        if "material" in primitive:
            look = self.header["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
        texture = look.get("baseColorTexture", {})
        transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
        chosen = transform.get("texCoord", texture.get("texCoord", 0))
        sources = {"POSITION": "POSITION", "TEXCOORD_0": f"TEXCOORD_{chosen}", COLORS: "COLOR_0"}
        for name, number in [(name, attributes.get(source)) for name, source in sources.items()]:
            attributes.pop(name, None)
            if number is not None:
                attributes[name] = self._plain_accessor(name, number, transform)
                counts = [
                    self.header["accessors"][attributes[n]]["count"] for n in ("POSITION", name)
                ]
                if counts[0] != counts[1]:
                    raise ValueError(
                        f"{name.lstrip('_')} has {counts[1]} values for {counts[0]} vertices"
                    )
        attributes.pop("COLOR_0", None)
        if primitive.get("mode") == _FAN:
            self._split_fan(primitive)

    def _values(self, number: int) -> np.ndarray:
        """Returns (n, width) the numbers of an accessor; fractions as float32."""
        accessor = self.header["accessors"][number]
        view = self.header["bufferViews"][accessor["bufferView"]]
        dtype, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        values: np.ndarray = np.ndarray(
            (accessor["count"], width),
            dtype,
            self._buffer(view["buffer"]),
            view.get("byteOffset", 0) + accessor.get("byteOffset", 0),
            (view.get("byteStride") or width * dtype.itemsize, dtype.itemsize),
        )
        if accessor.get("normalized") and dtype.kind in "iu":
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1)
        return values

    def _buffer(self, number: int) -> bytes | memoryview:
        if number not in self._buffers:
            uri = self.header["buffers"][number].get("uri")
            _, inline, text = (uri or "").partition("base64,")
            content = base64.b64decode(text) if inline else self._read(uri) if uri else self._chunk
            self._buffers[number] = content
        return self._buffers[number]

    def _plain_accessor(self, name: str, number: int, transform: dict[str, Any]) -> int:
        """Returns the number of an accessor of the same values as floats, texture coordinates moved
        by `transform`; the same accessor if trimesh reads it right.
        """
        accessor = self.header["accessors"][number]
        transform = transform if name == "TEXCOORD_0" else {}
        if not accessor.get("normalized") and not transform:
            return number
        key = number, json.dumps(transform)
        if key not in self._copies:
            values = self._values(number)
            if transform:
                u, v = (values * transform.get("scale", (1, 1))).T
                angle = transform.get("rotation", 0.0)
                cosine, sine = np.cos(angle), np.sin(angle)
                turned = np.stack((cosine * u + sine * v, cosine * v - sine * u), 1)
                values = turned + transform.get("offset", (0, 0))
            self._copies[key] = self._add(values.astype("<f4"), 5126)
        return self._copies[key]

    def _split_fan(self, primitive: dict[str, Any]) -> None:
        if "indices" in primitive:
            corners = self._values(primitive["indices"])[:, 0].astype("<u4")
        else:
            count = self.header["accessors"][primitive["attributes"]["POSITION"]]["count"]
            corners = np.arange(count, dtype="<u4")
        first = np.broadcast_to(corners[:1], max(len(corners) - 2, 0))
        triangles = np.stack((first, corners[1:-1], corners[2:]), 1).reshape(-1, 1)
        primitive.pop("mode")
        primitive["indices"] = self._add(np.ascontiguousarray(triangles), 5125)

    def _add(self, values: np.ndarray, component: int) -> int:
        """Returns the number of a new accessor that holds `values`, (n, width)."""
        buffers, views, accessors = (
            self.header[name] for name in ("buffers", "bufferViews", "accessors")
        )
        place = {"byteOffset": len(self.added), "byteLength": values.nbytes}
        kind = {"componentType": component, "type": _TYPES[values.shape[1]]}
        self.added += values.tobytes()
        views.append({"buffer": len(buffers), **place})
        accessors.append({"bufferView": len(views) - 1, "count": len(values), **kind})
        return len(accessors) - 1
