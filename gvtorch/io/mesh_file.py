"""`read_mesh`: reads a file of triangles as a `Mesh`, with trimesh: OBJ, PLY, STL, glTF, OFF; the
parts of a scene are transformed to their positions and joined.
"""

from __future__ import annotations

import gzip
import io
import math
import zlib
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from ..base import check
from ..base.image_info import array_from_srgb
from ..base.messages import need_library, one_line
from ..meshes.mesh import MOST_FACES, Material, Mesh
from .gltf import COLORS, plain_gltf
from .polygons import cut_polygons, plain_obj
from .resources import amount, check_memory, memory_free

#: Endings that are read, also followed by .gz. Other formats of trimesh need more libraries, or
#: unpickle the content of files.
ENDINGS = ("obj", "ply", "stl", "gltf", "glb", "off")
_MEMORY_PER_BYTE = 4  # bytes of memory that reading takes for each byte of a file, at least
_MAX_TEXTURE_BYTES = 1500 * 10**6  # bytes of memory that decoding textures may take, for any file
_TEXTURE_PER_BYTE = 100  # and for each byte of it and of the files that it refers to


def read_mesh(path: str | Path, *, texture: str | Path | None = None) -> Mesh:
    """Reads a mesh with its textures, vertex colours and materials, and all parts of a scene. Files
    that it refers to are read only from its folder and below; nothing is downloaded.

    Args:
        path: A file whose name ends in obj, ply, stl, gltf, glb or off, or these and .gz.
        texture: An image that replaces the textures and colours of all materials; the mesh must
            have texture coordinates.

    Returns:
        The mesh.

    Raises:
        FileNotFoundError: The file or the texture does not exist.
        ValueError: The file has another format, is damaged, has no triangles, positions that are
            NaN or indices out of range, or needs a texture or buffer that is missing or in another
            folder; the mesh has no texture coordinates for `texture`; or an argument is no path.
        ImportError: trimesh is not installed.
    """
    check.instance("read_mesh", "path", path, str, PathLike)
    check.instance("read_mesh", "texture", texture or "", str, PathLike)
    path = Path(path)
    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    if ending not in ENDINGS:
        raise ValueError(f"{path}: a mesh's name must end in {', '.join(ENDINGS)} (or .gz behind)")
    if not path.is_file():
        raise FileNotFoundError(f"file not found: {path}")
    trimesh = need_library(f"{path}: a mesh", "trimesh", extra="mesh")
    content = _read_content(path)
    _check_claims(path, ending, content)
    resolver: Any = _FolderResolver(path)
    try:
        if ending == "obj":
            content = cut_polygons(plain_obj(content))
        if ending in ("gltf", "glb"):
            content = plain_gltf(content, ending == "glb", resolver.get)
        options: Any = {"file_type": ending, "process": False, "allow_remote": False}
        loaded = trimesh.load(io.BytesIO(content), resolver=resolver, **options)
        _check_textures(_images(loaded), len(content) + resolver.size)
        # In a scene, `dump` applies the transforms.
        parts = loaded.dump(concatenate=False) if isinstance(loaded, trimesh.Scene) else [loaded]
        parts = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # a damaged file may raise anything
        reason = resolver.problem or one_line(error)
        raise ValueError(f"{path}: can't be read as {ending}: {reason}") from error
    if resolver.problem:
        raise ValueError(f"{path}: {resolver.problem}")
    if not parts:
        raise ValueError(f"{path}: has no triangles")
    has_images = bool(resolver.images) or ending in ("gltf", "glb")
    mesh = _join_parts(path, ending, parts, has_images or texture is not None)
    return mesh if texture is None else _with_texture(mesh, Path(texture))


def _with_texture(mesh: Mesh, texture: Path) -> Mesh:
    """Returns the mesh with one image as the texture of all materials."""
    if mesh.uv is None:
        raise ValueError(f"{mesh.name}: has no texture coordinates for {texture}")
    if not texture.is_file():
        raise FileNotFoundError(f"file not found: {texture}")
    from PIL import Image

    try:
        with Image.open(texture) as image:
            _check_textures([image], texture.stat().st_size)
            pixels = np.asarray(image.convert("RGBA"), np.uint8)
    except (OSError, ValueError, SyntaxError) as error:
        raise ValueError(f"{texture}: can't be read as an image: {error}") from None
    look = Material(color=(1.0, 1.0, 1.0, 1.0), texture=pixels)
    return replace(mesh, materials=tuple(replace(look, name=m.name) for m in mesh.materials))


def _read_content(path: Path) -> bytes:
    if not path.name.lower().endswith(".gz"):
        check_memory(str(path), path.stat().st_size * _MEMORY_PER_BYTE)
        return path.read_bytes()
    max_bytes = memory_free() // _MEMORY_PER_BYTE
    try:
        with gzip.open(path) as stream:
            content = stream.read(max_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{path}: can't be unpacked: {error}") from None
    if len(content) > max_bytes:
        limit = amount(max_bytes)
        raise ValueError(f"{path}: unpacks to more than {limit}, what free memory can take")
    return content


def _images(loaded: Any) -> list[Any]:
    """Returns the textures that trimesh found, which are not decoded yet."""
    parts = getattr(loaded, "geometry", {"": loaded}).values()
    materials = (getattr(getattr(part, "visual", None), "material", None) for part in parts)
    unique = {id(m): m for m in materials}.values()
    images = (getattr(m, "baseColorTexture", getattr(m, "image", None)) for m in unique)
    return [image for image in images if image is not None]


def _check_textures(images: list[Any], size: int) -> None:
    """Raises ValueError if decoding images takes more memory than files of `size` bytes justify."""
    sizes = [4 * math.prod(image.size) for image in images]
    needed_bytes = sum(sizes) + 2 * max(sizes, default=0)  # they are decoded one after another
    limit = min(_MAX_TEXTURE_BYTES + _TEXTURE_PER_BYTE * size, memory_free())
    if needed_bytes > limit:
        needed = amount(needed_bytes)
        raise ValueError(f"its textures take {needed} of memory, at most {amount(limit)}")


def _parse_count(word: bytes) -> int:
    """Returns the number in a header's word, 0 if it is none; 19 digits suffice to compare it."""
    return int(word.lstrip(b"0")[:19] or b"0") if word.isdigit() else 0


def _check_claims(path: Path, ending: str, content: bytes) -> None:
    """Raises ValueError, before memory is allocated, if a header claims too many triangles."""
    claimed = 0
    if ending == "stl" and len(content) >= 84 and not content[:5].lower() == b"solid":
        claimed = int.from_bytes(content[80:84], "little")
    if ending == "ply":
        for line in content[:65536].partition(b"end_header")[0].splitlines():
            tokens = line.split()
            if tokens[:2] in ([b"element", b"face"], [b"element", b"vertex"]) and len(tokens) == 3:
                claimed = max(claimed, _parse_count(tokens[2]))
    if ending == "off":
        numbers = content[:4096].split()[1:3]
        claimed = max(map(_parse_count, numbers), default=0)
    if claimed > (size := len(content)):  # each takes more than a byte
        raise ValueError(f"{path}: declares {claimed} triangles or vertices in {size} bytes")
    if claimed > MOST_FACES:
        raise ValueError(f"{path}: at most {MOST_FACES} triangles, it declares {claimed}")


class _FolderResolver:
    """Reads the files that a mesh refers to for trimesh, from the mesh's folder and below it."""

    def __init__(self, path: Path) -> None:
        self._folder, self.problem = path.absolute().parent, ""
        self.images = self.size = 0  # number of image files read; bytes of all files read

    def get(self, name: str) -> bytes:
        """Returns a file's content."""
        plain_name = str(name).strip().replace("\\", "/")
        if not (self._folder / plain_name).is_file():
            plain_name = unquote(plain_name)
        shown = one_line(plain_name)
        if "://" in plain_name:
            self.problem = f"names {shown}, and nothing is fetched"
            raise ValueError(self.problem)
        file = (self._folder / plain_name).resolve()
        inside = file.is_relative_to(self._folder.resolve())
        if not inside or not file.is_file():
            problem = "is not there" if inside else "is in another folder"
            # An OBJ may name a material library that does not exist: the mesh is white then.
            if not plain_name.lower().endswith(".mtl"):
                self.problem = f"names {shown}, which {problem}"
            raise FileNotFoundError(f"{shown} {problem}")
        self.images += file.suffix.lower() not in (".mtl", ".bin")
        self.size += file.stat().st_size
        try:
            check_memory(f"names {shown}", self.size * _MEMORY_PER_BYTE)
        except ValueError as error:
            self.problem = str(error)
            raise
        return file.read_bytes()

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def namespaced(self, _namespace: str) -> _FolderResolver:
        """Returns itself: trimesh's namespaces are not used."""
        return self


def _join_parts(path: Path, ending: str, parts: list[Any], mapped: bool) -> Mesh:
    """Joins trimesh's meshes. If not `mapped`, no image was read: images in them are trimesh's
    default, and are left out.
    """
    vertices, faces, colors, uvs, numbers = [], [], [], [], []
    materials: list[Material] = []
    material_numbers: dict[int, int] = {}
    vertex_count = 0
    for part in parts:
        part_faces = np.asarray(part.faces, np.int64)
        part_vertices = np.asarray(part.vertices, np.float64)
        for index in (part_faces.min(), part_faces.max()):
            if not 0 <= index < len(part_vertices):
                raise ValueError(
                    f"{path}: a triangle refers to vertex {index}, there are {len(part_vertices)}"
                )
        faces.append(part_faces + vertex_count)
        vertices.append(part_vertices)
        vertex_count += len(part_vertices)
        visual = part.visual
        uv = getattr(visual, "uv", None)
        uv_of_vertices = np.zeros((len(part_vertices), 2)) if uv is None else np.asarray(uv)
        uvs.append(uv_of_vertices[part_faces][..., :2])
        material = getattr(visual, "material", None)
        colors.append(_colors(part, part_faces, ending))
        if colors[-1] is not None and _alpha_mode(material, ending) == "OPAQUE":
            colors[-1][..., 3] = 1
        if id(material) not in material_numbers:
            material_numbers[id(material)] = len(materials)
            materials.append(_material(path, material, ending, mapped and uv is not None))
        numbers.append(np.full(len(part_faces), material_numbers[id(material)]))
    is_colored = any(color is not None for color in colors)
    white = [np.ones((*part.shape, 4), np.float32) for part in faces]
    filled = [own if color is None else color for own, color in zip(white, colors, strict=True)]
    textured = mapped and any(getattr(p.visual, "uv", None) is not None for p in parts)
    return Mesh(
        vertices=np.concatenate(vertices),
        faces=np.concatenate(faces),
        color=np.concatenate(filled) if is_colored else None,
        uv=np.concatenate(uvs).astype(np.float32) if textured else None,
        material=np.concatenate(numbers),
        materials=tuple(materials),
        name=str(path),
    )


def _colors(part: Any, faces: np.ndarray, ending: str) -> np.ndarray | None:
    """Returns (f, 3, 4) float32 linear colours of triangle corners; None if there are none. Colours
    are stored linear in glTF, as sRGB in other formats.
    """
    visual, attributes = part.visual, part.vertex_attributes
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[faces]
    elif visual.kind == "face":
        colors = np.repeat(np.asarray(visual.face_colors)[:, None], 3, axis=1)
    else:
        stored = attributes.get(COLORS, attributes.get("color"))
        if stored is None or np.asarray(stored).shape[-1] not in (3, 4):
            return None
        colors = np.asarray(stored)[faces]
    linear = colors.astype(np.float32) / (255 if colors.dtype == np.uint8 else 1)
    if linear.shape[-1] == 3:
        linear = np.concatenate((linear, np.ones_like(linear[..., :1])), -1)
    if ending not in ("gltf", "glb"):
        linear[..., :3] = array_from_srgb(linear[..., :3])
    return linear


def _opacity(material: Any) -> float:
    """Returns the opacity from an MTL file: d, or 1 - Tr; 1 if it has neither."""
    properties = material.kwargs
    name = "d" if "d" in properties else "tr"
    try:
        value = float(properties[name][-1])  # after the option -halo, if there is one
    except (KeyError, IndexError, ValueError):
        return 1.0
    return min(max(value if name == "d" else 1 - value, 0.0), 1.0)


def _alpha_mode(material: Any, ending: str) -> str:
    """Returns how a glTF material uses alpha: OPAQUE (it ignores it), MASK or BLEND; "" for others.

    Source: glTF 2.0 specification (Khronos), section 3.9.4.
    """
    if material is None or ending not in ("gltf", "glb"):
        return ""
    return str(getattr(material, "alphaMode", None) or "OPAQUE")


def _material(path: Path, material: Any, ending: str, mapped: bool) -> Material:
    """Converts a material of trimesh; white if there is none."""
    is_gltf = ending in ("gltf", "glb")
    image = getattr(material, "baseColorTexture" if is_gltf else "image", None)
    if material is None or (image is not None and not is_gltf and not mapped):
        return Material(color=(1.0, 1.0, 1.0, 1.0))
    base_color = getattr(material, "baseColorFactor", None) if is_gltf else material.main_color
    if base_color is None or (image is not None and not is_gltf):
        color = np.ones(4)  # a texture replaces the colour, except in glTF
    else:
        scale = 255 if np.asarray(base_color).dtype.kind in "ui" else 1
        color = np.asarray(base_color, np.float64) / scale
    if ending == "obj":
        color[3] *= _opacity(material)
    if not is_gltf:
        color[:3] = array_from_srgb(color[:3])
    texture = None
    if image is not None and mapped:
        try:
            texture = np.asarray(image.convert("RGBA"), np.uint8)
        except (OSError, ValueError, SyntaxError) as error:
            raise ValueError(f"{path}: a texture can't be read: {error}") from None
    mode = _alpha_mode(material, ending)
    if mode in ("OPAQUE", "MASK"):
        cutoff = -1.0 if mode == "OPAQUE" else material.alphaCutoff
        cutoff = 0.5 if cutoff is None else cutoff
        if texture is not None:
            is_seen = texture[..., 3] * color[3] >= 255 * cutoff
            texture = np.concatenate((texture[..., :3], np.uint8(255) * is_seen[..., None]), -1)
        color[3] = 1.0 if texture is not None else color[3] >= cutoff
    red, green, blue, opacity = (float(n) for n in color)
    name = str(getattr(material, "name", "") or "")
    return Material(name=name, color=(red, green, blue, opacity), texture=texture)
