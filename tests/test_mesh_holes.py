"""Holes: winding numbers of open meshes, against libigl, and filling of holes."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from helpers import gvtorch, meshes, shared

import gvtorch as gv
from gvtorch.meshes.holes import filled, rims, warning_of_holes
from gvtorch.meshes.mesh import facing_away, solids
from gvtorch.meshes.voxelizer import Voxelizer
from gvtorch.meshes.winding import WindingNumber


def without(mesh: gv.Mesh, *faces: int) -> gv.Mesh:
    return mesh.only(np.setdiff1d(np.arange(len(mesh.faces)), faces))


def cut(mesh: gv.Mesh, height: float) -> gv.Mesh:
    """Returns the triangles below a height."""
    return mesh.only(np.flatnonzero(mesh.corners[:, :, 2].max(1) < height))


def winding_number(mesh: gv.Mesh, points: Any) -> np.ndarray:
    positions = torch.from_numpy(np.asarray(points, np.float64))
    return WindingNumber(torch.from_numpy(mesh.corners))(positions).numpy()


def test_a_plane_hole_is_half_wound_around():
    """A box without its lid: 1 minus the solid angle of the lid inside, 1/2 on the lid."""
    box = meshes.box((-1, -1, -1), (1, 1, 1))
    lid = np.flatnonzero((box.corners[:, :, 2] == 1).all(1))
    opened = without(box, *lid)
    turns = winding_number(opened, [[0, 0, 0], [0, 0, 1], [0.3, -0.2, 1], [0, 0, 5], [0, 0, -1.5]])
    angle = 4 * np.arcsin(4 / (4 + 4 * 16)) / (4 * np.pi)  # of a 2 x 2 square, 4 away
    assert np.abs(turns[:4] - [5 / 6, 0.5, 0.5, angle]).max() < 1e-3
    assert abs(turns[4]) < 0.1


@pytest.mark.parametrize("name", ["open bunny", "castle", "ball"])
def test_winding_numbers_are_libigl_s(name):
    igl = pytest.importorskip("igl", reason="the peer libigl is not installed")
    if name == "ball":
        mesh = cut(meshes.sphere(5), 0.6)
    elif name == "castle":
        mesh = gv.read_mesh(shared("meshes/kaykit/building_castle_blue.gltf"))
    else:
        mesh = gv.read_mesh(shared("meshes/stanford_bunny.obj.gz"))
    low, high = mesh.bounds
    point = low - 0.1 + (high - low + 0.2) * np.random.default_rng(0).random((1000, 3))
    error = np.abs(winding_number(mesh, point) - igl.winding_number(*triangles(mesh), point))
    assert error.max() < 0.02 and error.mean() < 2e-3


def triangles(mesh: gv.Mesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices, mesh.faces


def test_rims_go_around_every_hole():
    ball = meshes.sphere(3)
    opened = without(ball, 0, 100, 101, 200)
    all_rims, _ = rims(opened)
    assert sorted(len(rim.face) for rim in all_rims) in ([3, 3, 4], [3, 3, 3, 3])
    assert not rims(ball)[0]


def test_filling_closes_what_has_holes():
    ball = meshes.sphere(4)
    opened = without(ball, 3, 4, 5, 300, 301, 700)
    closed = filled(opened)
    assert solids(closed)[1].all()
    assert meshes.volume(closed) == pytest.approx(meshes.volume(ball), rel=2e-3)
    assert filled(ball) is ball


def test_a_plane_hole_is_filled_by_its_plane():
    """Half a ball whose flat disc is missing; also inside out."""
    ball = meshes.sphere(4)
    half = cut(ball, 1e-9)
    for opened in (half, meshes.of_corners(half.corners[:, ::-1].copy())):
        closed = filled(opened)
        new = closed.corners[len(opened.faces) :]
        assert solids(closed)[1].all() and np.abs(new[..., 2]).max() < 2e-3
        assert abs(meshes.volume(closed)) == pytest.approx(meshes.volume(ball) / 2, rel=2e-3)


def test_triangles_that_face_the_other_way_are_turned():
    """Also if most of their part is listed after them, and if they belong to another part."""
    ball = meshes.sphere(3)
    for away in ([5], [0, 1, 2, 77], np.arange(0, 512, 7)):
        wrong = ball.turned(np.array(away))
        assert not solids(wrong)[1].any() and np.array_equal(facing_away(wrong), away)
        mended = filled(wrong)
        assert np.array_equal(mended.faces, ball.faces) and solids(mended)[1].all()
    opened = without(ball.turned(np.array([500])), 0, 300)
    assert len(rims(filled(opened))[0]) == 0 and solids(filled(opened))[1].all()


def test_a_strip_of_one_side_stays_as_it_is():
    turn = np.linspace(0, 2 * np.pi, 41)[:-1]
    side = np.array([-0.3, 0.3])[:, None]
    wide = 1 + side * np.cos(turn / 2)
    positions = np.stack((wide * np.cos(turn), wide * np.sin(turn), side * np.sin(turn / 2)), -1)
    low, high = np.arange(40), np.arange(40, 80)
    next_low, next_high = np.append(low[1:], 40), np.append(high[1:], 0)
    faces = np.stack((low, next_low, high, high, next_low, next_high), -1).reshape(-1, 3)
    strip = gv.Mesh(vertices=positions.reshape(-1, 3), faces=faces)
    assert not len(facing_away(strip))


def test_what_encloses_nothing_stays_a_sheet():
    leaf, ball = meshes.sheet(4), meshes.of_corners(meshes.sphere(3).corners + 3)
    closed = filled(meshes.joined(leaf, without(ball, 5)))
    _, solid = solids(closed)
    assert not solid[:32].any() and solid[32:].all()


def test_fillings_have_the_colours_around_them():
    ball = meshes.sphere(3)
    color = np.tile(np.array((0.2, 0.4, 0.6, 1.0), np.float32), (len(ball.faces), 3, 1))
    painted = gv.Mesh(
        vertices=ball.vertices,
        faces=ball.faces,
        color=color,
        uv=np.zeros((len(ball.faces), 3, 2)) + 0.25,
        material=np.full(len(ball.faces), 1),
        materials=(gv.Material(), gv.Material()),
    )
    closed = filled(without(painted, 3, 4))
    assert closed.color is not None and closed.uv is not None and closed.material is not None
    assert np.allclose(closed.color, color[0, 0]) and np.allclose(closed.uv, 0.25)
    assert (closed.material == 1).all() and len(closed.faces) > len(ball.faces)


@pytest.mark.long
def test_the_bunny_s_inside_is_where_libigl_winds_around_it():
    """The filled bunny is compared with igl's winding number of the open one, and its volume with
    that of a published closed bunny.
    """
    igl = pytest.importorskip("igl", reason="the peer libigl is not installed")
    opened = gv.read_mesh(shared("meshes/stanford_bunny.obj.gz"))
    with pytest.warns(UserWarning, match=r"5 holes of 223 edges leave 1 parts open"):
        gv.MeshProducer(opened, resolution=32)
    grid = Voxelizer(opened, resolution=64, solid="always")
    low, high = opened.bounds
    point = low + (high - low) * np.random.default_rng(1).random((3000, 3))
    inside = np.abs(igl.winding_number(*triangles(opened), point)) > 0.5
    actual = grid.geometry.signed_distance(torch.from_numpy(point)).numpy() < 0
    assert (actual != inside).mean() < 1e-3 and 500 < inside.sum() < 2500
    covered = grid.region((0, 0, 0), grid.extent[::-1])["coverage"].double().sum() / 255
    volume = abs(meshes.volume(grid.mesh))
    assert float(covered) * grid.spacing**3 == pytest.approx(volume, rel=2e-3)


def test_solid_tells_what_is_filled():
    ball = without(meshes.sphere(4), 7, 8)
    sums = {}
    for solid in ("auto", "always", "never"):
        grid = Voxelizer(ball, resolution=48, solid=solid)
        covered = grid.region((0, 0, 0), grid.extent[::-1])["coverage"].double().sum() / 255
        sums[solid] = float(covered) * grid.spacing**3
    assert sums["always"] == pytest.approx(meshes.volume(meshes.sphere(4)), rel=5e-3)
    assert sums["auto"] == sums["never"] == pytest.approx(4 * np.pi * grid.spacing, rel=0.02)
    closed = Voxelizer(meshes.sphere(4), resolution=48, solid="never")
    assert not closed.geometry.solid.any()
    with pytest.raises(ValueError, match="solid must be 'auto', 'always' or 'never', got 'yes'"):
        Voxelizer(ball, solid="yes")


def test_a_pole_that_is_computed_again_is_the_same_place():
    """sin(pi) is 1e-16 in float64: the usual sphere of latitudes counts as closed nevertheless."""
    rings = 24
    polar, around = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 48, endpoint=False)
    polar, around = polar[:, None], around[None]
    part = (
        np.sin(polar) * np.cos(around),
        np.sin(polar) * np.sin(around),
        np.cos(polar + 0 * around),
    )
    a = np.arange(rings * 48).reshape(rings, 48)
    b = np.roll(a, -1, 1)
    faces = np.stack(((a, a + 48, b), (b, a + 48, b + 48))).transpose(0, 2, 3, 1).reshape(-1, 3)
    ball = gv.Mesh(vertices=np.stack(part, -1).reshape(-1, 3), faces=faces)
    flat = gv.Mesh(vertices=ball.vertices.round(12), faces=faces)
    ends = [gv.MeshProducer(m, resolution=32).voxelizer for m in (ball, flat)]
    with pytest.raises(ValueError, match="faces must be whole numbers"):
        gv.Mesh(vertices=ball.vertices, faces=faces + 0.5)
    tensors = gv.Mesh(vertices=torch.from_numpy(ball.vertices), faces=torch.from_numpy(faces))
    assert np.array_equal(tensors.vertices, ball.vertices)
    assert np.array_equal(tensors.faces, faces)
    actual, expected = (m.region((0, 0, 0), m.extent)["coverage"].double().sum() for m in ends)
    assert float(actual) == pytest.approx(float(expected), rel=1e-6) and float(actual) > 5000 * 255


def test_a_field_of_a_mesh_tells_of_its_holes():
    ball = without(meshes.sphere(4), 7, 8)
    with pytest.warns(UserWarning, match='2 holes of 6 edges leave 1 parts open.*solid="always"'):
        gv.SampledDistance.of_mesh(ball, resolution=16)
    filled_up = gv.SampledDistance.of_mesh(ball, resolution=16, solid="always")
    assert float(filled_up(torch.zeros(1, 3))) < -0.5


def test_few_holes_are_told_in_a_line(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    ball = without(meshes.sphere(4), 7, 8)
    file = tmp_path / "ball.ply"
    trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(file)
    command = ("voxelize", file, "-o")
    run = gvtorch(*command, tmp_path / "a.zarr", "--resolution", 32)
    assert run.returncode == 0 and run.stderr.count("\n") == 1, run.stderr
    assert "2 holes of 6 edges" in run.stderr and "--solid always" in run.stderr
    run = gvtorch(*command, tmp_path / "b.zarr", "--resolution", 32, "--solid", "always")
    assert run.returncode == 0 and not run.stderr
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert warning_of_holes(meshes.sphere(3)) == warning_of_holes(meshes.sheet(4)) == ""
