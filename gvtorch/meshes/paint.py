"""`Paint`: colour, normal and material at points on a mesh."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from .geometry import Geometry
from .mesh import Mesh

_CREASE = 0.9  # cosine between a corner's mean normal and its triangle's; less is a sharp edge


class Paint:
    """Colours, textures, normals and materials of a geometry's triangles.

    Attributes:
        material: (f,) int64 material of each triangle.
        mean_color: (4,) mean colour of the surface, weighted by area.
        main_material: The material with the largest area.
    """

    def __init__(self, mesh: Mesh, geometry: Geometry) -> None:
        """Copies colours, textures and normals to the geometry's device."""
        mesh_face, device = geometry.mesh_face.numpy(), geometry.corner.device

        def to_device(values: np.ndarray | None) -> Tensor | None:
            return None if values is None else torch.from_numpy(values[mesh_face]).to(device)

        material = to_device(mesh.material)
        assert material is not None
        self.material, self._color, self._uv = material, to_device(mesh.color), to_device(mesh.uv)
        material_colors = [entry.color for entry in mesh.materials]
        self._material_color = torch.tensor(material_colors, dtype=torch.float32, device=device)
        textures = [entry.texture for entry in mesh.materials]
        self._texel, self._texture_layout = None, None
        if self._uv is not None and any(texture is not None for texture in textures):
            self._texel, self._texture_layout = _pack_textures(textures, device)
        self._normal = _corner_normals(mesh, geometry)
        area = geometry.area
        unit = 2.0 ** -math.frexp(float(area.max()))[1]  # so that float32 holds them, exactly
        area = (unit * area).to(torch.float32)
        third = torch.full((len(area), 3), 1 / 3, dtype=torch.float32, device=device)
        color = self.color(torch.arange(len(area), device=device), third)
        area_fraction = (area / area.sum().clamp(min=1e-30))[:, None]
        self.mean_color = (color * area_fraction).sum(0)
        sums = area.new_zeros(len(material_colors)).index_add_(0, material, area)
        self.main_material = int(sums.argmax())

    def color(self, face_p: Tensor, weight_p3: Tensor) -> Tensor:
        """Returns (p, 4) float32 linear RGB and opacity at points on triangles `face_p` (p,), given
        by the weights (p, 3) of their corners.
        """
        material = self.material[face_p]
        color = self._material_color[material]
        if self._color is not None:
            color = color * (self._color[face_p] * weight_p3[..., None]).sum(1)
        if self._uv is not None and self._texel is not None and self._texture_layout is not None:
            uv = (self._uv[face_p] * weight_p3[..., None]).sum(1)
            color = color * _bilinear(self._texel, self._texture_layout[material], uv)
        return color

    def normal(self, face_p: Tensor, weight_p3: Tensor) -> Tensor:
        """Returns (p, 3) float32 unit normals, interpolated except across sharp edges."""
        normal = (self._normal[face_p] * weight_p3[..., None]).sum(1)
        return torch.nn.functional.normalize(normal, dim=1)


def _linear(texture: Tensor) -> Tensor:
    """Returns (h, w, 4) float16 linear RGB and opacity from sRGB bytes (IEC 61966-2-1)."""
    value = torch.arange(256, dtype=torch.float32, device="cpu") / 255
    table = torch.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    rgb = table[texture[..., :3].long()]
    return torch.cat((rgb, texture[..., 3:].float() / 255), -1).to(torch.float16)


def _pack_textures(
    textures: Sequence[np.ndarray | None], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Returns (n, 4) float16 texels of all textures, row after row, and (m, 3) int64 the first
    texel, height and width of each texture. A missing texture is one white texel.
    """
    white = torch.ones((1, 1, 4), dtype=torch.float16, device="cpu")
    texels: dict[int, Tensor] = {}
    firsts, layouts, parts, total = dict[int, int](), [], [], 0
    for texture in textures:
        if id(texture) not in texels:
            srgb = None if texture is None else torch.tensor(texture, device="cpu")
            texels[id(texture)] = white if srgb is None else _linear(srgb)
            firsts[id(texture)] = total
            parts.append(texels[id(texture)].view(-1, 4))
            total += len(parts[-1])
        height, width, _ = texels[id(texture)].shape
        layouts.append((firsts[id(texture)], height, width))
    return torch.cat(parts).to(device), torch.tensor(layouts, device=device)


def _bilinear(texel: Tensor, layout_p3: Tensor, uv: Tensor) -> Tensor:
    """Returns (p, 4) bilinear samples of repeating textures; v runs upwards."""
    first, height, width = layout_p3.unbind(1)
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    x0, y0 = x.floor(), y.floor()
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    total = torch.zeros((len(uv), 4), dtype=torch.float32, device=uv.device)
    for dy, wy in ((0, 1 - fy), (1, fy)):
        for dx, wx in ((0, 1 - fx), (1, fx)):
            row, column = (y0 + dy).long() % height, (x0 + dx).long() % width
            total += wx * wy * texel[first + row * width + column].float()
    return total


def _corner_normals(mesh: Mesh, geometry: Geometry) -> Tensor:
    """Returns (f, 3, 3) float32: at each corner the mean of the normals that meet there, weighted
    by angle (Thuermer, Wuethrich, "Computing vertex normals from polygonal facets", J. Graphics
    Tools 1998); at sharp edges the triangle's normal.
    """
    corner = geometry.corner
    _, position_index = np.unique(mesh.vertices, axis=0, return_inverse=True)
    vertex = torch.from_numpy(position_index.reshape(-1)[mesh.faces[geometry.mesh_face.numpy()]])
    vertex = vertex.to(corner.device)
    unit = torch.nn.functional.normalize
    edge = unit(corner.roll(-1, 1) - corner, dim=2)
    angle = torch.acos((edge * -edge.roll(1, 1)).sum(2).clamp(-1, 1))
    a, b, c = corner.unbind(1)
    face_normal = unit(torch.linalg.cross(b - a, c - a), dim=1)[:, None].expand(-1, 3, 3)
    sums = face_normal.new_zeros((int(vertex.max()) + 1, 3))
    sums.index_add_(0, vertex.flatten(), (face_normal * angle[..., None]).reshape(-1, 3))
    mean = unit(sums, dim=1)[vertex]
    smooth = (mean * face_normal).sum(2, keepdim=True) > _CREASE
    return torch.where(smooth, mean, face_normal).to(torch.float32)
