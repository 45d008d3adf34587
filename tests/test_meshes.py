"""Meshes: which parts bound a solid, distances, search of triangles, volume and area in voxels."""

from __future__ import annotations

import gzip

import numpy as np
import pytest
import torch
from helpers import meshes, shared

import gvtorch as gv
from gvtorch.meshes.geometry import Geometry
from gvtorch.meshes.mesh import solids
from gvtorch.meshes.voxelizer import Voxelizer

SHARED = {
    "bunny": "meshes/stanford_bunny_closed.obj.gz",
    "open bunny": "meshes/stanford_bunny.obj.gz",
    "spot": "meshes/spot/spot_triangulated.obj.gz",
    "castle": "meshes/kaykit/building_castle_blue.gltf",
}


def places(mesh: gv.Mesh, count: int, seed: int = 0, wider: float = 0.2) -> np.ndarray:
    """Returns random points in the mesh's box and around it."""
    low, high = mesh.bounds
    size = (high - low).max()
    random = np.random.default_rng(seed).random((count, 3))
    return low - wider * size + random * (high - low + 2 * wider * size)


def sums(mesh: gv.Mesh, resolution: int, **options) -> float:
    """Returns the sum of the coverage of all voxels, in world units."""
    grid = Voxelizer(mesh, resolution=resolution, **options)
    covered = grid.region((0, 0, 0), grid.extent[::-1])["coverage"]
    return float(covered.double().sum()) / 255 * grid.spacing**3


# --- What bounds a solid


def test_closed_parts_are_solid_and_open_ones_are_not():
    mesh = meshes.joined(meshes.sphere(2), meshes.sheet(3), meshes.torus(3.0, 0.2, (12, 8)))
    kept, solid = solids(mesh)
    assert len(kept) == len(mesh.faces)
    count = len(meshes.sphere(2).faces)
    assert solid[:count].all() and not solid[count : count + 18].any() and solid[count + 18 :].all()


def test_a_missing_triangle_opens_its_part_alone():
    ball, ring = meshes.sphere(2), meshes.torus(3.0, 0.2, (12, 8))
    mesh = meshes.joined(ball.only(np.arange(1, len(ball.faces))), ring)
    _, solid = solids(mesh)
    assert not solid[: len(ball.faces) - 1].any() and solid[len(ball.faces) - 1 :].all()


def test_a_turned_triangle_opens_its_part():
    faces = meshes.box().faces.copy()
    faces[3] = faces[3][::-1]
    _, solid = solids(gv.Mesh(vertices=meshes.box().vertices, faces=faces))
    assert not solid.any()


def test_copies_needles_and_points_do_no_harm():
    """The result has the same bits, wherever the degenerate triangles are listed."""
    ball = meshes.sphere(3)
    a, b, _ = ball.vertices[ball.faces[7]]
    bad = np.array([[a, a, a], [a, b, b], [a, b, a]])
    corners = np.concatenate((ball.corners[5:9][:, [1, 2, 0]], bad, ball.corners))
    mesh = meshes.of_corners(corners)
    grid, plain = (Voxelizer(m, resolution=48) for m in (mesh, ball))
    whole = ((0, 0, 0), plain.extent[::-1])
    assert len(grid.geometry.mesh_face) == len(ball.faces) and grid.geometry.solid.all()
    assert torch.equal(grid.region(*whole)["coverage"], plain.region(*whole)["coverage"])


def test_a_triangle_without_area_closes_a_gap():
    """A T-junction, closed by a triangle whose corners lie on one line."""
    square = meshes.box((0, 0, 0), (1, 1, 1))
    corners = square.corners
    a, b, c = corners[0]
    middle = 0.5 * (a + b)
    split = np.array([[a, middle, c], [middle, b, c], [a, b, middle]])
    mesh = meshes.of_corners(np.concatenate((split, corners[1:])))
    kept, solid = solids(mesh)
    assert len(kept) == 14 and solid.all()
    distance = Geometry(mesh).signed_distance(torch.tensor([[0.5, 0.5, 0.4], [0.5, 0.5, 1.25]]))
    assert torch.allclose(distance, torch.tensor([-0.4, 0.25]).double())


def test_triangles_back_to_back_are_a_sheet():
    flat = meshes.sheet(2)
    both = meshes.of_corners(np.concatenate((flat.corners, flat.corners[:, ::-1])))
    kept, solid = solids(both)
    assert len(kept) == len(flat.faces) and not solid.any()


def test_an_edge_of_three_faces_bounds_no_solid():
    """A box with a fin: all of it becomes a shell of the given thickness."""
    fin = np.array([[[-1, -0.7, -0.4], [1, -0.7, -0.4], [0, -1.5, -0.9]]])
    mesh = meshes.joined(meshes.box((-1, -0.7, -0.4), (1, 0.7, 0.4)), meshes.of_corners(fin))
    producer = gv.MeshProducer(mesh, resolution=128)
    assert not producer.voxelizer.geometry.solid.any()
    actual = sums(mesh, 128) / producer.voxelizer.thickness
    assert actual == pytest.approx(meshes.area(mesh), rel=0.01)


def test_an_inside_out_mesh_is_the_same_solid():
    ball = meshes.sphere(3)
    turned = meshes.of_corners(ball.corners[:, ::-1].copy())
    assert sums(turned, 40) == pytest.approx(sums(ball, 40), abs=1e-4)


# --- Distances


def test_signed_distance_of_a_box_in_closed_form():
    mesh = meshes.box((-1, -0.7, -0.4), (1, 0.7, 0.4))
    point = places(mesh, 20000)
    q = np.abs(point) - (1, 0.7, 0.4)
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)
    distance = Geometry(mesh).signed_distance(torch.from_numpy(point))
    assert np.abs(distance.numpy() - exact).max() < 1e-12


@pytest.mark.parametrize("name", SHARED)
def test_signed_distance_is_libigl_s(name):
    """At 30,000 points (open bunny: 10^4); the sign against igl's winding number of closed parts:
    the fast one, which is nowhere near 1/2, and at 2000 points the exact one.
    """
    igl = pytest.importorskip("igl", reason="the peer libigl is not installed")
    mesh = gv.read_mesh(shared(SHARED[name]))
    size = float((mesh.bounds[1] - mesh.bounds[0]).max())
    point = places(mesh, 10_000 if name == "open bunny" else 30_000)
    geometry = Geometry(mesh)
    distance = geometry.signed_distance(torch.from_numpy(point)).numpy()
    squared, *_ = igl.point_mesh_squared_distance(point, mesh.vertices, mesh.faces)
    assert np.abs(np.abs(distance) - np.sqrt(squared)).max() < 1e-5 * size
    closed = mesh.faces[geometry.mesh_face.numpy()][geometry.solid.numpy()]
    if not len(closed):
        assert (distance >= 0).all()
        return
    winding = igl.fast_winding_number(mesh.vertices, closed, point)
    exact = igl.winding_number(mesh.vertices, closed, point[:2000])
    assert np.abs(winding[:2000] - exact).max() < 0.01 < np.abs(np.abs(winding) - 0.5).min()
    assert np.array_equal(np.abs(winding) > 0.5, distance < 0) and (distance < 0).sum() > 600


@pytest.mark.parametrize("name", ["spot", "castle"])
def test_the_channel_of_distances_is_libigl_s(name):
    """20,000 voxels within the band, to 10^-5 of a voxel: float32 resolves distances of up to 8
    voxels to 10^-6.
    """
    igl = pytest.importorskip("igl", reason="the peer libigl is not installed")
    mesh = gv.read_mesh(shared(SHARED[name]))
    grid = Voxelizer(mesh, resolution=64, channels=("distance",), band=8)
    distance = grid.region((0, 0, 0), grid.extent[::-1])["distance"][..., 0]
    assert distance.dtype == torch.float32
    near = (distance.abs() < 0.999 * grid.band).nonzero().numpy()
    near = np.random.default_rng(0).permutation(near)[:20_000]
    point = near[:, ::-1] * grid.spacing + np.array(grid.origin)
    squared, *_ = igl.point_mesh_squared_distance(point, mesh.vertices, mesh.faces)
    closed = mesh.faces[grid.geometry.mesh_face.numpy()][grid.geometry.solid.numpy()]
    inside = np.abs(igl.fast_winding_number(mesh.vertices, closed, point)) > 0.5
    expected = np.where(inside, -1, 1) * np.sqrt(squared)
    error = np.abs(distance.numpy()[tuple(near.T)] - expected)
    assert error.max() < 1e-5 * grid.spacing and inside.sum() > 500


def test_nested_and_crossing_parts_have_whole_winding_numbers():
    outer = meshes.sphere(3)
    inner = meshes.of_corners(outer.corners * 0.5 + np.array((0.2, 0.0, 0.0)))
    across = meshes.of_corners(outer.corners + np.array((1.5, 0.0, 0.0)))
    geometry = Geometry(meshes.joined(outer, inner, across))
    point = torch.tensor([[0.2, 0.1, 0.1], [-0.8, 0, 0.1], [0.8, 0.1, 0], [1.5, 0, 0.1], [3, 0, 0]])
    assert geometry.winding(point.double()).tolist() == [2, 1, 2, 1, 0]


def test_rays_through_edges_and_corners_count_once():
    """Points whose rays meet edges and corners exactly: a grid through a box's corners."""
    mesh = meshes.box((0, 0, 0), (1, 1, 1))
    axis = torch.linspace(-0.5, 1.5, 9, dtype=torch.float64)
    point = torch.cartesian_prod(axis + 0.125, axis, axis)
    inside = ((point > 0) & (point < 1)).all(1)
    winding = Geometry(mesh).winding(point)
    sure = ~((point == 0) | (point == 1)).any(1)
    assert torch.equal(winding[sure] != 0, inside[sure])
    assert ((winding == 0) | (winding == 1)).all()


# --- The search


@pytest.fixture(scope="module")
def searched() -> tuple[gv.Mesh, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A mesh, corners (40, 3) of cubes of 8^3 points, these points (p, 3), and their distances (p,)
    to the nearest triangle by brute force.
    """
    mesh = meshes.joined(meshes.torus(1.0, 0.4, (24, 12)), meshes.sheet(3, 2.0))
    low = torch.from_numpy(places(mesh, 40, 3))
    z, y, x = torch.meshgrid(*[torch.arange(8) * 0.1 + 0.05] * 3, indexing="ij")
    positions = (low[:, None] + torch.stack((x, y, z), -1).view(-1, 3)).view(-1, 3)
    corner = Geometry(mesh).corner
    exact = torch.cat([distance_to(corner, part).amin(1) for part in positions.split(2000)])
    return mesh, low, positions, exact


@pytest.mark.parametrize("reach", [0.05, torch.inf])
@pytest.mark.parametrize("detail", [0.0, 1.0])
def test_the_search_misses_no_triangle(searched, reach, detail):
    """20,000 points, one by one and packed: the nearest triangle is that of brute force."""
    mesh, low, positions, exact = searched
    geometry = Geometry(mesh)
    geometry.detail = detail
    size = torch.tensor([0.1, 0.1, reach], dtype=torch.float64).expand(len(low), 3).contiguous()
    results = geometry.cubes(low, size, 8, 0.0, shares=False, weights=True, wide=False)
    near = exact < reach * (1 - 1e-5)
    distance, face = 0.1 * results.distance.view(-1), results.nearest.view(-1).long()
    assert (distance[near] - exact[near]).abs().max() < 1e-5
    assert (face[exact > reach * (1 + 1e-5)] == -1).all() and near.sum() > 300
    # The weights give the position itself.
    nearest = (results.weight.view(-1, 3, 1) * geometry.corner[face.clamp(min=0)]).sum(1)
    assert ((nearest - positions).norm(dim=1) - exact)[near].abs().max() < 1e-5


def distance_to(corner: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
    """Returns distances (p, f) by projection on the plane, or by dense points along edges."""
    a, b, c = corner.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    unit = normal / normal.norm(dim=1, keepdim=True)
    best = torch.full((len(positions), len(corner)), torch.inf, dtype=torch.float64)
    inside = torch.ones_like(best, dtype=torch.bool)
    for p, q in ((a, b), (b, c), (c, a)):
        offset = positions[:, None] - p
        along = ((offset * (q - p)).sum(2) / ((q - p) ** 2).sum(1)).clamp(0, 1)
        best = torch.minimum(best, (offset - along[..., None] * (q - p)).norm(dim=2))
        inside &= (torch.linalg.cross((q - p).expand_as(offset), offset) * unit).sum(2) >= 0
    plane = ((positions[:, None] - a) * unit).sum(2).abs()
    return torch.where(inside, plane, best)


def test_boxes_that_nothing_touches_hold_nothing():
    """10^5 random boxes: if no triangle is found, all of the box is beyond the reach."""
    mesh = meshes.torus(1.0, 0.4, (24, 12))
    geometry = Geometry(mesh)
    generator = torch.Generator().manual_seed(2)
    middle = torch.from_numpy(places(mesh, 100_000, 5))
    half = torch.rand((100_000, 1), generator=generator, dtype=torch.float64) ** 3 * 0.3
    reach = torch.full_like(half[:, 0], 0.02)
    parts, inside = geometry.touched(
        (middle - half).contiguous(), 2 * half[:, 0], reach, parts=2, wide=True
    )
    touched = parts.flatten(1).any(1)
    bare, size = middle[~touched], half[~touched]
    within = inside.flatten(1)[~touched]
    assert torch.equal(within.all(1), within.any(1))
    assert torch.equal(within[:, 0], geometry.signed_distance(bare) < 0)
    assert 30_000 < len(bare) < 90_000
    random = torch.rand(bare.shape, generator=generator, dtype=torch.float64)
    inner = (geometry.signed_distance(bare + (2 * random - 1) * size)).abs()
    assert (inner > 0.02).all()
    # The test is tight: some boxes are only just empty.
    assert (geometry.signed_distance(bare).abs() - size[:, 0] < 0.05).sum() > 100


# --- Voxels


def test_volume_of_solids_is_right_to_a_thousandth():
    for mesh, resolution in ((meshes.sphere(5), 96), (meshes.torus(), 96), (meshes.box(), 256)):
        assert sums(mesh, resolution) == pytest.approx(meshes.volume(mesh), rel=1e-3)


def test_area_of_sheets_is_right_to_a_hundredth():
    """Open parts get the given thickness."""
    ball = meshes.sphere(5)
    half = ball.only(np.flatnonzero(ball.corners[:, :, 2].min(1) > 0))
    for mesh in (half, meshes.sheet(4)):
        for thickness in (1.0, 2.0):
            grid = Voxelizer(mesh, resolution=256)
            thick = thickness * grid.spacing
            rim = 0.25 * np.pi * thick**2 / 2 * 4  # borders are round: half a disc along them
            actual = sums(mesh, 256, thickness=thickness)
            assert actual == pytest.approx(meshes.area(mesh) * thick, rel=0.01, abs=2 * rim)


@pytest.mark.parametrize("name", ["bunny", "spot"])
def test_volume_of_scanned_meshes(name):
    mesh = gv.read_mesh(shared(SHARED[name]))
    assert sums(mesh, 256) == pytest.approx(meshes.volume(mesh), rel=1e-3)


def test_volume_of_the_closed_parts_of_a_castle():
    """Two parts that cross, each one alone."""
    mesh = gv.read_mesh(shared(SHARED["castle"]))
    geometry = Geometry(mesh)
    closed = meshes.components(mesh.only(geometry.mesh_face.numpy()[geometry.solid.numpy()]))
    assert [len(part.faces) for part in closed] == [98, 200]
    for part in closed:
        assert sums(part, 96) == pytest.approx(meshes.volume(part), rel=1e-3)


def test_area_of_an_open_scan():
    """The bunny as it was scanned, with holes; and closed, as a shell."""
    for name in ("open bunny", "bunny"):
        mesh = gv.read_mesh(shared(SHARED[name]))
        grid = Voxelizer(mesh, resolution=160, solid="never")
        actual = sums(mesh, 160, solid="never") / grid.thickness
        assert actual == pytest.approx(meshes.area(mesh), rel=0.01)


def test_a_region_is_the_same_in_parts_and_whole():
    mesh = meshes.torus(1.0, 0.4, (48, 24))
    fields = {"resolution": 90, "channels": ("coverage", "distance", "color", "normal", "material")}
    grid = Voxelizer(mesh, **fields)
    x, y, z = grid.extent
    whole = grid.region((0, 0, 0), (z, y, x))
    part = grid.region((3, 17, 40), (20, 60, 71))
    for name, values in part.items():
        assert torch.equal(values, whole[name][3:20, 17:60, 40:71]), name


def test_channels_are_those_of_a_sphere():
    grid = Voxelizer(
        meshes.sphere(6), resolution=64, channels=("distance", "normal", "coverage"), band=5
    )
    x, y, z = grid.extent
    voxels = grid.region((0, 0, 0), (z, y, x))
    axis = [
        torch.arange(n) * grid.spacing + o for n, o in zip(grid.extent, grid.origin, strict=True)
    ]
    z, y, x = torch.meshgrid(axis[2], axis[1], axis[0], indexing="ij")
    positions = torch.stack((x, y, z), -1)
    radius = positions.norm(dim=-1)
    exact = (radius - 1).clamp(-grid.band, grid.band)
    assert (voxels["distance"][..., 0] - exact).abs().max() < 1e-3
    near = (radius - 1).abs() < 0.9 * grid.band
    unit = positions[near] / radius[near][:, None]
    assert (voxels["normal"][near] / 127 - unit).norm(dim=1).max() < 0.03
    assert (voxels["normal"][(radius - 1).abs() > 1.1 * grid.band] == 0).all()
    covered = voxels["coverage"][..., 0]
    assert (covered[radius < 0.9] == 255).all() and (covered[radius > 1.1] == 0).all()


def test_colours_come_of_textures_corners_and_materials():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    texture = np.zeros((2, 2, 4), np.uint8)
    texture[..., 3] = 255
    texture[0, 0, 0] = texture[0, 1, 1] = texture[1, 0, 2] = 255  # red, green; blue, black
    mesh = gv.Mesh(
        vertices=square,
        faces=faces,
        uv=square[faces][..., :2],
        color=np.full((2, 3, 4), (0.5, 0.5, 1.0, 1.0)),
        material=np.array([0, 0]),
        materials=(gv.Material(color=(1.0, 0.8, 0.5, 1.0), texture=texture),),
    )
    grid = Voxelizer(mesh, resolution=68, channels=("color", "material", "coverage"))
    x, y, z = grid.extent
    voxels = grid.region((0, 0, 0), (z, y, x))
    middle = z // 2
    color = voxels["color"][middle].float()
    opacity = color[..., 3:].clamp(min=0.1)
    assert (color[..., 3] * 255 - voxels["coverage"][middle, ..., 0]).abs().max() < 1
    straight = color[..., :3] / opacity
    red, green, blue, black = (straight[r, c] for r, c in ((50, 18), (50, 50), (18, 18), (18, 50)))
    assert torch.allclose(red, torch.tensor([0.5, 0.0, 0.0]), atol=0.02)
    assert torch.allclose(green, torch.tensor([0.0, 0.4, 0.0]), atol=0.02)
    assert torch.allclose(blue, torch.tensor([0.0, 0.0, 0.5]), atol=0.02)
    assert black.abs().max() < 0.02
    material = voxels["material"][middle, 4:-4, 4:-4]
    assert (material[voxels["coverage"][middle, 4:-4, 4:-4] > 127] == 1).all() and material.any()


# --- Bad input


def test_bad_meshes_are_told_in_a_line():
    box = meshes.box()
    nan = box.vertices.copy()
    nan[3, 1] = np.nan
    far = box.faces.copy()
    far[2, 0] = 8
    for changes, message in (
        ({"faces": np.zeros((0, 3))}, "has no triangles"),
        ({"vertices": nan}, "are NaN or infinite"),
        ({"faces": far}, "refers to vertex 8, there are 8"),
        ({"faces": -far}, "refers to vertex"),
        ({"material": np.full(12, 3)}, "refers to material 3, there are 1"),
        ({"material": np.full(12, -2)}, "refers to material -2, there are 1"),
        ({"vertices": np.zeros((8, 3))}, "all triangles lie in one point"),
        ({"vertices": np.zeros((8, 2))}, "vertices must be (n, 3)"),
        ({"vertices": np.ones((8, 3)) * 1j}, "vertices must be (n, 3) numbers"),
        ({"vertices": np.ma.masked_less(np.zeros((8, 3)), 1)}, "vertices must be (n, 3) numbers"),
        ({"uv": np.zeros((3, 3, 2))}, "uv must be (12, 3, 2)"),
    ):
        fields = {"vertices": box.vertices, "faces": box.faces} | changes
        with pytest.raises(ValueError, match="mesh: ") as error:
            gv.Mesh(**fields)
        assert message in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(ValueError, match="no triangle has three corners"):
        Voxelizer(gv.Mesh(vertices=box.vertices, faces=[[0, 1, 1]]))


def test_bad_settings_are_told_in_a_line():
    for options, message in (
        ({"resolution": 4}, "resolution must be"),
        ({"channels": ("colour",)}, "channels must be some of coverage"),
        ({"channels": ()}, "channels must be some of"),
        ({"band": 1.0}, "band must be"),
        ({"thickness": 0.0}, "thickness must be"),
    ):
        with pytest.raises(ValueError, match="voxelize: ") as error:
            Voxelizer(meshes.box(), **options)
        assert message in str(error.value)


def test_float32_s_end_does_not_matter():
    """A small mesh, a million units away, has the voxels of one at the origin."""
    ball = meshes.sphere(3)
    shift = np.array([2.0**20, -(2.0**19), 2.0**18])
    rounded = meshes.of_corners(np.round(ball.corners * 2**20) / 2**20)
    small = meshes.of_corners(rounded.corners * 2.0**-4 + shift)
    a, b = (Voxelizer(mesh, resolution=40) for mesh in (rounded, small))
    whole = ((0, 0, 0), a.extent[::-1])
    first, second = (grid.region(*whole)["coverage"].int() for grid in (a, b))
    assert (first - second).abs().max() <= 1 and first.max() == 255


def test_gz_is_what_it_packs(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    (tmp_path / "a.obj").write_text(text)
    (tmp_path / "b.obj.gz").write_bytes(gzip.compress(text.encode()))
    a, b = gv.read_mesh(tmp_path / "a.obj"), gv.read_mesh(tmp_path / "b.obj.gz")
    assert np.array_equal(a.corners, b.corners) and meshes.volume(a) == pytest.approx(1 / 6)
