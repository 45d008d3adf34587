"""Colours of mesh files as voxels: several materials, wide textures, vertex colours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import Library, meshes

import gvtorch as gv
from gvtorch.meshes.voxelizer import Voxelizer

trimesh = Library("trimesh")
Image = Library("PIL.Image")


def linear(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def straight(mesh: gv.Mesh, point: tuple[float, float, float], resolution: int = 96) -> list[float]:
    """Returns the colour at a point of the surface, not premultiplied."""
    grid = Voxelizer(mesh, resolution=resolution, channels=("color",))
    index = [round((p - o) / grid.spacing) for p, o in zip(point, grid.origin, strict=True)]
    low = [n - 1 for n in index[::-1]]
    colors = grid.region(low, [n + 3 for n in low])["color"].float().view(-1, 4)
    best = colors[colors[:, 3].argmax()]
    return (best[:3] / best[3]).tolist()


def test_parts_of_a_gltf_have_materials_of_their_own(tmp_path):
    """A wide texture, a tall one, and only a colour factor, side by side in one file."""
    scene = trimesh.Scene()
    wide = np.zeros((2, 512, 3), np.uint8)
    wide[:, :256], wide[:, 256:] = (255, 0, 0), (0, 0, 255)
    tall = np.zeros((512, 2, 3), np.uint8)
    tall[:256], tall[256:] = (0, 255, 0), (255, 255, 0)
    material_fields = (
        {"baseColorTexture": Image.fromarray(wide)},
        {"baseColorTexture": Image.fromarray(tall), "baseColorFactor": [0.5, 0.5, 0.5, 1.0]},
        {"baseColorFactor": [0.25, 0.5, 0.75, 1.0]},
    )
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    for number, fields in enumerate(material_fields):
        material = trimesh.visual.material.PBRMaterial(name=f"m{number}", **fields)
        part = trimesh.Trimesh(
            square + np.array([1.5 * number, 0, 0]),
            [[0, 1, 2], [0, 2, 3]],
            visual=trimesh.visual.TextureVisuals(uv=square[:, :2], material=material),
            process=False,
        )
        scene.add_geometry(part)
    scene.export(tmp_path / "three.glb")
    mesh = gv.read_mesh(tmp_path / "three.glb")
    assert sorted(m.name for m in mesh.materials) == ["m0", "m1", "m2"]
    half = 128 / 255  # a factor is stored in 8 bits
    for position, expected in (
        ((0.25, 0.5, 0), (1, 0, 0)),
        ((0.75, 0.5, 0), (0, 0, 1)),
        ((2.0, 0.8, 0), (0, half, 0)),
        ((2.0, 0.2, 0), (half, half, 0)),
        ((3.5, 0.5, 0), (0.25, 0.5, 0.75)),
    ):
        assert straight(mesh, position, 200) == pytest.approx(expected, abs=0.01), position
    grid = Voxelizer(mesh, resolution=100, channels=("material",))
    materials = grid.region((0, 0, 0), grid.extent[::-1])["material"]
    assert torch.unique(materials).tolist() == [0, 1, 2, 3]


def test_colours_of_an_obj_s_vertices_shade_into_each_other(tmp_path):
    (tmp_path / "a.obj").write_text(
        "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 1 0\nv 0 1 0 1 0 0\nf 1 2 3\nf 1 3 4\n"
    )
    mesh = gv.read_mesh(tmp_path / "a.obj")
    for x in (0.1, 0.5, 0.9):
        assert straight(mesh, (x, 0.4, 0)) == pytest.approx((1 - x, x, 0), abs=0.02)


def test_materials_of_an_obj_have_their_colours(tmp_path):
    text = "newmtl a\nKd 0.8 0.2 0.1\nnewmtl b\nKd 0.1 0.6 0.3\n"
    (tmp_path / "a.mtl").write_text(text)
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 2 0 0\nv 2 1 0\n"
        "usemtl a\nf 1 2 3\nusemtl b\nf 2 4 5\n"
    )
    mesh = gv.read_mesh(tmp_path / "a.obj")
    first, second = straight(mesh, (0.7, 0.3, 0)), straight(mesh, (1.7, 0.3, 0))
    assert first == pytest.approx([linear(n) for n in (0.8, 0.2, 0.1)], abs=0.01)
    assert second == pytest.approx([linear(n) for n in (0.1, 0.6, 0.3)], abs=0.01)


def test_textures_repeat():
    """Texture coordinates outside of [0, 1], also large and negative ones."""
    texture = np.zeros((4, 4, 4), np.uint8)
    texture[..., 3], texture[:, :2, 0], texture[:, 2:, 1] = 255, 255, 255
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    for shift in (0.0, -3.0, 1000.0):
        mesh = gv.Mesh(
            vertices=square,
            faces=faces,
            uv=2 * square[faces][..., :2] + shift,
            materials=(gv.Material(color=(1.0,) * 4, texture=texture),),
        )
        for x, expected in ((0.125, (1, 0, 0)), (0.375, (0, 1, 0)), (0.625, (1, 0, 0))):
            assert straight(mesh, (x, 0.5, 0)) == pytest.approx(expected, abs=0.02), (x, shift)


def test_sizes_beyond_all_numbers_are_told():
    for scale in (1e200, 1e-200):
        with pytest.raises(ValueError, match=r"mesh: size must be 1e-30 to 1e\+30 world"):
            gv.Mesh(vertices=meshes.box().vertices * scale, faces=meshes.box().faces)
    for scale in (1e25, 1e-25):
        box = gv.Mesh(vertices=meshes.box().vertices * scale, faces=meshes.box().faces)
        grid = Voxelizer(box, resolution=32)
        covered = grid.region((0, 0, 0), grid.extent[::-1])["coverage"].double().sum() / 255
        assert float(covered) * (grid.spacing / scale) ** 3 == pytest.approx(0.28, rel=0.01)
        painted = Voxelizer(box, resolution=16, channels=("color", "material"))
        inside = painted.constants(torch.tensor([True]))
        assert inside["color"][0].tolist() == pytest.approx([0.8, 0.8, 0.8, 1], abs=1e-3)
