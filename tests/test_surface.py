"""Isosurfaces: closed forms, no cracks across blocks, files that are read back."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers import gvtorch
from hypothesis import given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.io import surface
from gvtorch.meshes import contour as cells


def ball(n: int = 40, radius: float = 14.3, *, spacing=(1.0, 1.0, 1.0), middle=None) -> gv.Volume:
    """Returns the signed distance to a ball, in voxels; positive inside."""
    middle = [0.5 * n + 0.21] * 3 if middle is None else middle
    z, y, x = np.ogrid[:n, :n, :n]
    away = np.sqrt((x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2)
    return gv.Volume((radius - away).astype(np.float32), spacing, origin=(5.0, -3.0, 2.0))


def area_and_volume(mesh: gv.Mesh) -> tuple[float, float]:
    a, b, c = mesh.corners.transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    return 0.5 * float(np.linalg.norm(across, axis=1).sum()), float((a * across).sum()) / 6


def euler_number(mesh: gv.Mesh) -> int:
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return len(mesh.vertices) - len(np.unique(edges, axis=0)) + len(mesh.faces)


def assert_closed(mesh: gv.Mesh) -> None:
    """Asserts that each edge occurs once in each direction: in two triangles of one orientation."""
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there, back = (np.sort(w[:, 0] * len(mesh.vertices) + w[:, 1]) for w in (edges, edges[:, ::-1]))
    assert np.array_equal(there, back) and (np.diff(there) > 0).all()
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))


def triangles(mesh: gv.Mesh) -> np.ndarray:
    """Returns the corners of all triangles in a canonical order: the lowest corner first."""
    first = np.array([np.lexsort(three.T[::-1])[0] for three in mesh.corners])
    turned = (first[:, None] + np.arange(3)) % 3
    rows = mesh.corners[np.arange(len(first))[:, None], turned].reshape(-1, 9)
    return rows[np.lexsort(rows.T[::-1])]


@pytest.mark.parametrize("block", [5, 16, 64])
def test_a_ball_has_the_area_and_the_volume_of_a_ball(monkeypatch, block):
    monkeypatch.setattr(surface, "_BLOCK_CELLS", block)
    mesh = gv.extract_surface(ball(), 0.0)
    area, volume = area_and_volume(mesh)
    assert math.isclose(area, 4 * math.pi * 14.3**2, rel_tol=4e-3)
    assert math.isclose(volume, 4 / 3 * math.pi * 14.3**3, rel_tol=4e-3)
    assert euler_number(mesh) == 2
    assert_closed(mesh)
    radius = np.linalg.norm(mesh.vertices - (np.array([5, -3, 2]) + 20.21), axis=1)
    assert np.abs(radius - 14.3).max() < 0.02, "distances are linear but for the curvature"


def test_signed_distances_are_solid_below(tmp_path):
    """Level sets and distances to meshes grow outwards: the same triangles, the same picture."""
    solid = ball()
    info = gv.ImageInfo(quantity="signed distance")
    distances = gv.Volume(-solid.data, solid.spacing, solid.origin, info=info)
    store = gv.convert(distances, tmp_path / "d.zarr")
    expected = gv.extract_surface(solid, -1.5)
    for data in (distances, store):
        mesh = gv.extract_surface(data, 1.5)
        assert np.array_equal(triangles(mesh), triangles(expected))
        assert area_and_volume(mesh)[1] > 0
    for flags in (("--shader", "isosurface", "--value", "0"), ()):
        out = tmp_path / "a.npz"
        run = gvtorch("render", tmp_path / "d.zarr", "-o", out, "--size", "64x64", *flags)
        assert run.returncode == 0, run.stderr
        camera = gv.Camera.orbit(30, 20, fit=True, width=64, height=64)
        picture = gv.render(solid, camera, gv.Isosurface(0.0))
        assert torch.equal(torch.from_numpy(np.load(out)["alpha"]), picture.alpha)
    assert isinstance(gv.view(distances, wait=False, browser=False).state.shader, gv.DistanceField)
    with pytest.raises(ValueError, match="no surface at value -99"):
        gv.extract_surface(distances, -99.0)


def test_a_torus_has_a_hole_and_a_shell_two_sides():
    z, y, x = np.mgrid[:32, :32, :32] - 15.6
    torus = 4 - np.hypot(np.hypot(x, y) - 9, z)
    assert euler_number(gv.extract_surface(gv.Volume(torus), 0)) == 0
    shell = 2.2 - np.abs(np.sqrt(x**2 + y**2 + z**2) - 9.3)
    mesh = gv.extract_surface(gv.Volume(shell), 0)
    assert euler_number(mesh) == 4
    assert_closed(mesh)
    assert math.isclose(
        area_and_volume(mesh)[1], 4 / 3 * math.pi * (11.5**3 - 7.1**3), rel_tol=9e-3
    )


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.sampled_from([2, 3, 64]), st.booleans())
def test_noise_is_wrapped_without_cracks(seed, side, block, whole):
    """All kinds of cells and neighbours, in small blocks; whole numbers often equal the level."""
    rng = np.random.default_rng(seed)
    shape = rng.integers(2, side + 1, 3)
    data = rng.integers(0, 3, shape) if whole else rng.normal(size=shape)
    if data.max() < (1 if whole else 0):
        return
    value = 1.0 if whole else 0.0
    volume = gv.Volume(data.astype(np.float32))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface, "_BLOCK_CELLS", block)
        mesh = gv.extract_surface(volume, value)
    assert_closed(mesh)
    assert area_and_volume(mesh)[1] >= 0
    assert np.array_equal(triangles(mesh), triangles(gv.extract_surface(volume, value)))


def test_every_kind_of_cell_occurs_and_is_cut_whole():
    """Loops of n corners make n - 2 triangles, and together they pass all crossed edges."""
    tables = cells._tables()
    for kind in range(256):
        loops = cells._loops(kind)
        crossed = {
            e for e, (a, n) in enumerate(cells._EDGES) if (kind >> n ^ kind >> (n | 1 << a)) & 1
        }
        assert sorted(edge for loop in loops for edge in loop) == sorted(crossed)
        assert tables.triangles[kind] == sum(len(loop) - 2 for loop in loops)


def test_vertices_are_those_of_another_marching_cubes():
    """VTK puts the same vertices on the same edges; triangles may differ at saddles."""
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    z, y, x = np.mgrid[:23, :29, :31] * 0.37
    data = (np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)).astype(
        np.float32
    )
    image = vtkImageData()
    image.SetDimensions(31, 29, 23)
    image.GetPointData().SetScalars(numpy_to_vtk(data.ravel()))
    other = vtkFlyingEdges3D()
    other.SetInputData(image)
    other.SetValue(0, 0.3)
    other.ComputeNormalsOff()
    other.Update()
    theirs = vtk_to_numpy(other.GetOutput().GetPoints().GetData()).astype(np.float64)
    count = other.GetOutput().GetNumberOfPolys()
    ours = gv.extract_surface(gv.Volume(data), 0.3, caps=False)
    assert len(theirs) == len(ours.vertices) > 3000
    assert abs(count - len(ours.faces)) <= 0.002 * count
    from scipy.spatial import cKDTree

    away, nearest = cKDTree(ours.vertices).query(theirs)
    assert away.max() < 1e-5 and len(np.unique(nearest)) == len(theirs)


@pytest.mark.parametrize("caps", [True, False])
def test_what_leaves_the_box_is_closed_there_or_open(caps):
    """A ball around a corner of the box: an eighth of it."""
    mesh = gv.extract_surface(ball(40, 20.0, middle=(-0.5, -0.5, -0.5)), 0, caps=caps)
    if caps:
        assert_closed(mesh)
        area, volume = area_and_volume(mesh)
        assert math.isclose(volume, math.pi * 20**3 / 6, rel_tol=2e-3)
        assert math.isclose(area, 1.25 * math.pi * 20**2, rel_tol=1e-2)
        low = np.array([4.5, -3.5, 1.5])
        assert np.allclose(mesh.bounds[0], low) and (mesh.vertices >= low - 1e-12).all()
    else:
        assert np.allclose(mesh.bounds[0], [5, -3, 2]), "ends at the outermost voxel centres"


def test_streamed_is_resident_is_dense(tmp_path, monkeypatch):
    """A volume, its tree and its store, at each level, in blocks of any size."""
    monkeypatch.setattr(surface, "_BLOCK_CELLS", 24)
    volume = ball(75, 30.0, spacing=(1.0, 0.5, 2.0))
    store = gv.convert(_saved(tmp_path, volume), tmp_path / "s.zarr", spacing=(1.0, 0.5, 2.0))
    tree = gv.N3Tree.from_volume(gv.Volume(volume.data, volume.spacing, store.origin))
    for level in range(4):
        surfaces = [gv.extract_surface(source, 0.0, level=level) for source in (tree, store)]
        assert np.array_equal(triangles(surfaces[0]), triangles(surfaces[1])), level
        assert_closed(surfaces[0])
        full = 4 / 3 * math.pi * 30**3
        assert math.isclose(area_and_volume(surfaces[0])[1], full, rel_tol=0.02 * 4**level)
    finest = gv.Volume(volume.data, volume.spacing, store.origin)
    assert np.array_equal(triangles(gv.extract_surface(finest, 0.0)),
                          triangles(gv.extract_surface(store, 0.0)))  # fmt: skip


def _saved(folder, volume: gv.Volume):
    np.save(folder / "v.npy", volume.data[..., 0].numpy())
    return folder / "v.npy"


def test_blocks_without_the_surface_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(surface, "_BLOCK_CELLS", 16)
    store = gv.convert(_saved(tmp_path, ball(96, 12.0, middle=(20, 20, 20))), tmp_path / "s.zarr")
    read = []
    plain = gv.Store.read_region
    monkeypatch.setattr(
        gv.Store, "read_region", lambda self, *box: read.append(box) or plain(self, *box)
    )
    assert_closed(gv.extract_surface(store, 0.0))
    assert 0 < len(read) < 40, f"of {(100 // 16 + 1) ** 3} blocks"


@pytest.mark.parametrize("wide", [False, True])
def test_a_label_is_wrapped(tmp_path, wide):
    data = np.zeros((20, 22, 24), np.int64 if wide else np.uint8)
    data[4:9, 5:12, 6:20] = 5_000_000_000 if wide else 7
    data[9:14, 5:12, 6:20] = 3
    volume = gv.Volume(data, labels=True)
    np.save(tmp_path / "l.npy", data)
    store = gv.convert(tmp_path / "l.npy", tmp_path / "l.zarr", labels=True)
    for source in (volume, gv.N3Tree.from_volume(volume, border=2), store):
        mesh = gv.extract_surface(source, float(data.max()))
        assert_closed(mesh)
        _, filled = area_and_volume(mesh)
        assert 0.9 * 5 * 7 * 14 < filled < 5 * 7 * 14, "faces half-way between centres, bevelled"
        size = mesh.bounds[1] - mesh.bounds[0]
        assert np.allclose(size, (14, 7, 5))
    with pytest.raises(ValueError, match=r"label|no surface"):
        gv.extract_surface(volume, 9.0)


@pytest.mark.parametrize("ending", ["ply", "glb"])
@pytest.mark.parametrize("origin", [0.0, 3e6])
def test_files_come_back(tmp_path, monkeypatch, ending, origin):
    """As trimesh reads them; positions far from the origin keep their precision."""
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setattr(surface, "_BLOCK_CELLS", 16)
    volume = ball(30, 9.4)
    volume = gv.Volume(volume.data, (0.001, 0.002, 0.001), (origin, 2.0, 3.0))
    expected = gv.extract_surface(volume, 0)
    path = tmp_path / f"s.{ending}"
    size = gv.export_surface(volume, 0, path)
    assert size == (len(expected.vertices), len(expected.faces))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    loaded = trimesh.load(path, process=False)
    whole = loaded.to_geometry() if ending == "glb" else loaded
    assert np.array_equal(whole.faces, expected.faces)
    assert np.abs(whole.vertices - expected.vertices).max() < 2e-6
    assert whole.is_watertight and whole.is_winding_consistent and whole.volume > 0


def test_ctrl_c_leaves_the_file_that_was_there(tmp_path):
    path = tmp_path / "s.ply"
    path.write_text("old")

    def stop(stage: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gv.export_surface(ball(), 0, path, progress=stop)
    assert path.read_text() == "old" and [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda v, t: gv.extract_surface(v, 99), "no surface at value 99"),
        (lambda v, t: gv.export_surface(v, 99, t / "s.ply"), "no surface at value 99"),
        (lambda v, t: gv.extract_surface(v, math.nan), "value must be finite"),
        (lambda v, t: gv.extract_surface(v, 0, level=1), "level must be an int >= 0 and <= 0"),
        (lambda v, t: gv.extract_surface(v, 0, component=1), "component must be an int"),
        (lambda v, t: gv.extract_surface(v, 0, channel="heat"), "channel is for trees"),
        (
            lambda v, t: gv.extract_surface(gv.N3Tree.from_volume(v), 0, channel="heat"),
            "unknown channel",
        ),
        (lambda v, t: gv.extract_surface(7, 0), "what must be a Volume, Store or N3Tree, got int"),
        (lambda v, t: gv.export_surface(v, 0, t / "s.obj"), "path must end in .ply or .glb"),
        (lambda v, t: gv.export_surface(v, 0, t / "no" / "s.ply"), "folder not found"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, make, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        make(ball(12, 4.0), tmp_path)
    assert not [*tmp_path.iterdir()]


def test_the_command(scan_store, tmp_path):
    run = gvtorch("surface", scan_store, "-o", tmp_path / "a.ply", "--iso", "120", "--level", "1")
    assert run.returncode == 0 and "triangles" in run.stdout, run.stderr
    mesh = gv.read_mesh(tmp_path / "a.ply")
    expected = gv.extract_surface(gv.Store.open(scan_store), 120, level=1)
    assert len(mesh.faces) == len(expected.faces)
    assert np.abs(mesh.bounds - expected.bounds).max() < 1e-5
    data = scan_store.with_name("ball.npy")
    run = gvtorch("surface", data, "-o", tmp_path / "b.glb", "--value", "60", "--no-caps")
    assert run.returncode == 0, run.stderr
    for flags, message in (
        (("-o", tmp_path / "c.stl", "--value", "1"), "must end in .ply or .glb"),
        (("-o", tmp_path / "c.ply", "--value", "300"), "no surface at value 300"),
        (("-o", tmp_path / "c.ply", "--value", "3", "--level", "1"), "--level is for stores"),
    ):
        run = gvtorch("surface", data, *flags)
        assert run.returncode == 2 and message in run.stderr, run.stderr
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.ply", "b.glb"]


MEASURE = """
import resource, numpy as np
import gvtorch as gv
z, y, x = (0.4 * np.ogrid[:160, :160, :160][n].astype(np.float32) for n in range(3))
wave = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
volume = gv.Volume(wave)
gv.export_surface(gv.Volume(wave[:70, :70, :70]), 0.1, "warm.ply")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
size = gv.export_surface(volume, 0.1, "a.ply")
print(size.triangles, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


@pytest.mark.long
def test_memory_is_that_of_blocks_not_of_the_surface(tmp_path):
    command = [sys.executable, "-c", MEASURE]
    run = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    triangles, megabytes = map(float, run.stdout.split())
    written = (tmp_path / "a.ply").stat().st_size / 2**20
    assert triangles > 1.5e6 and written > 25 and megabytes < 0.5 * written, run.stdout


def test_bfloat16_and_half_are_read():
    volume = ball(20, 6.0)
    for dtype in (torch.bfloat16, torch.float16):
        mesh = gv.extract_surface(gv.Volume(volume.data.to(dtype)), 0)
        assert_closed(mesh)
