"""`MeshProducer`: bricks of triangles, at every level."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import meshes

import gvtorch as gv
from gvtorch.meshes.voxelizer import Voxelizer
from gvtorch.producers import Layout, Nodes, Region

CPU = torch.device("cpu")
#: Tolerance of voxels, and the share of voxels that may exceed it.
BOUNDS = {
    "coverage": (1, 2e-4),
    "distance": (1e-5, 2e-4),
    "color": (2e-3, 2e-4),
    "normal": (1, 5e-3),
    "material": (0, 2e-4),
}
ALL = ("coverage", "distance", "color", "normal", "material")


def all_nodes(layout: Layout, depth: int) -> Nodes:
    count = -(-torch.tensor(layout.extent) // (layout.brick_size << (layout.depth - depth)))
    positions = torch.cartesian_prod(*(torch.arange(int(n)) for n in count))
    return Nodes(torch.cat((positions, torch.full((len(positions), 1), depth)), 1), layout)


@pytest.fixture(scope="module")
def mesh() -> gv.Mesh:
    return meshes.joined(meshes.torus(1.0, 0.4, (48, 24)), meshes.sheet(3, 1.3))


@pytest.fixture(scope="module")
def world(mesh):
    """A producer of all channels, its layout, and its finest voxels as a store has them."""
    producer = gv.MeshProducer(mesh, resolution=100, channels=ALL)
    layout = Layout.of(producer, 8, 1, CPU)
    producer.prepare(layout)
    x, y, z = producer.extent
    voxels = Voxelizer(mesh, resolution=100, channels=ALL).region((0, 0, 0), (z, y, x))
    return producer, layout, voxels


def cut(voxels: torch.Tensor, nodes: Nodes) -> torch.Tensor:
    """Cuts bricks with border out of finest voxels, clamped at the faces as a volume's are."""
    from gvtorch.ops import cut_bricks

    return cut_bricks(voxels.contiguous(), nodes.loc[:, [2, 1, 0]].contiguous(), 8, 1)


def inner(nodes: Nodes, voxels: torch.Tensor) -> torch.Tensor:
    """Returns (k, s, s, s): true for voxels of finest bricks that lie in the volume."""
    size = torch.tensor(voxels.shape[:3])
    indices = nodes.loc[:, [2, 1, 0], None] * 8 + torch.arange(-1, 9)
    inside = (indices >= 0) & (indices < size[:, None])
    return inside[:, 0, :, None, None] & inside[:, 1, None, :, None] & inside[:, 2, None, None, :]


def test_finest_bricks_hold_the_store_s_voxels(world):
    producer, layout, voxels = world
    nodes = all_nodes(layout, layout.depth)
    bricks = producer.fill(nodes).data
    there = inner(nodes, voxels["coverage"])
    for name, expected in voxels.items():
        actual, stored = (values[there].double() for values in (bricks[name], cut(expected, nodes)))
        error = (actual - stored).abs().amax(1)
        # Cubes begin elsewhere, so float32 rounds differently: of two triangles at equal distance,
        # the other one may give the normal.
        bound, share = BOUNDS[name]
        assert (error > bound).double().mean() < share, name


def test_regions_are_proved_at_every_level(world):
    """EMPTY and CONSTANT nodes hold one value, in their bricks and in the finest voxels."""
    producer, layout, voxels = world
    alone = gv.MeshProducer(producer.voxelizer.mesh, resolution=100)
    seen = []
    for depth in range(layout.depth + 1):
        nodes = all_nodes(layout, depth)
        for source in (producer, alone):
            regions = source.classify(nodes)
            proved = regions.kind != Region.DATA
            if not proved.any():
                continue
            bricks = source.fill(nodes[proved]).data
            for name, values in bricks.items():
                value = regions.constants[name][proved]
                assert torch.equal(values, value[:, None, None, None].expand_as(values)), name
            scale = 2 ** (layout.depth - depth)
            for loc, value in zip(
                nodes.loc[proved].tolist(), regions.constants["coverage"][proved], strict=True
            ):
                low = [max(0, (n * 8 - 1) * scale) for n in loc[2::-1]]
                high = [((n + 1) * 8 + 1) * scale for n in loc[2::-1]]
                box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
                assert (voxels["coverage"][box] == value).all()
        kinds = alone.classify(nodes).kind
        seen.append([int((kinds == kind).sum()) for kind in Region])
    assert seen[0][Region.DATA] == 1
    assert seen[-1][Region.EMPTY] > 100 and seen[-1][Region.CONSTANT] >= 3


def test_a_coarse_voxel_is_nearly_the_mean_below(world):
    """One level up to rounding; further up, as exact as planes in eighths of a voxel are."""
    producer, layout, voxels = world
    bounds = {  # scale: mean and largest difference of coverage, and of distances in voxels
        2: (2.5e-4, 1 / 255, 1e-5, 1e-4),
        4: (1.2e-3, 0.06, 0.02, 0.2),
        8: (5e-3, 0.08, 0.09, 0.5),
    }
    for scale, bound in bounds.items():
        depth = layout.depth - scale.bit_length() + 1
        nodes = all_nodes(layout, depth)
        bricks = producer.fill(nodes).data
        for name, unit, (mean, max_error) in (
            ("coverage", 255.0, bound[:2]),
            ("distance", producer.spacing[0], bound[2:]),
        ):
            values = voxels[name].double() / unit
            z, y, x = (n // scale for n in values.shape[:3])
            values = values[: z * scale, : y * scale, : x * scale]
            below = values.reshape(z, scale, y, scale, x, scale).mean((1, 3, 5))
            level = torch.zeros(*(8 * (int(n) + 1) for n in nodes.loc[:, [2, 1, 0]].amax(0)))
            for (a, b, c, _), brick in zip(nodes.loc.tolist(), bricks[name], strict=True):
                node_slices = (slice(8 * n, 8 * n + 8) for n in (c, b, a))
                level[tuple(node_slices)] = brick[1:-1, 1:-1, 1:-1, 0] / unit
            error = (level[:z, :y, :x] - below).abs()
            assert error.mean() < mean and error.max() < max_error, (name, scale)


def test_bricks_of_all_levels_are_made_together(world):
    """As on a device, where the host does not check which are coarse: one call that reads no value
    gives the bits of bricks that are made level by level.
    """
    producer, layout, _ = world
    assert producer.on_device
    nodes = [all_nodes(layout, depth)[::7] for depth in (layout.depth, 1, layout.depth - 1, 0)]
    loc = torch.cat([part.loc for part in nodes])
    mixed = Nodes(loc[torch.randperm(len(loc), generator=torch.Generator().manual_seed(0))], layout)
    expected = producer.fill(mixed).data
    low = mixed.box[:, 0] - layout.border * mixed.voxel_size
    voxel, coarse = mixed.voxel_size[:, 0], mixed.depth < layout.depth
    assert 0 < coarse.sum() < len(loc)
    together = producer.voxelizer.cubes(low, voxel, layout.side, coarse_k=coarse)
    for name, values in expected.items():
        assert torch.equal(together[name], values), name


def test_the_volume_stays_from_level_to_level():
    """For a solid, to a thousandth, up to the level at which rounding of voxels is larger."""
    ball = meshes.sphere(4)
    producer = gv.MeshProducer(ball, resolution=128)
    layout = Layout.of(producer, 8, 1, CPU)
    producer.prepare(layout)
    for depth in range(1, layout.depth + 1):
        nodes = all_nodes(layout, depth)
        filled = producer.fill(nodes).data["coverage"][:, 1:-1, 1:-1, 1:-1].double().sum() / 255
        size = producer.spacing[0] * 2 ** (layout.depth - depth)
        assert float(filled) * size**3 == pytest.approx(meshes.volume(ball), rel=1e-3)


def test_coverage_of_solids_is_the_mean_below_at_every_level():
    """Except for rounding, also for parts thinner than voxels: one sample equals eight."""
    mesh = meshes.joined(meshes.torus(1.0, 0.3, (40, 20)), meshes.box((-1, -1, 0.5), (1, 1, 0.52)))
    producer = gv.MeshProducer(mesh, resolution=64)
    layout = Layout.of(producer, 8, 1, CPU)
    producer.prepare(layout)
    finest = producer.voxelizer.region((0, 0, 0), producer.extent[::-1])["coverage"]
    edge = 8 << layout.depth
    whole = torch.zeros(edge, edge, edge, dtype=torch.float64)
    whole[tuple(slice(0, n) for n in finest.shape[:3])] = finest[..., 0]
    for depth in range(layout.depth):
        nodes = all_nodes(layout, depth)
        bricks = producer.fill(nodes).data["coverage"][:, 1:-1, 1:-1, 1:-1, 0].double()
        scale, side = 1 << (layout.depth - depth), 8 << depth
        below = whole.view(side, scale, side, scale, side, scale).mean((1, 3, 5))
        for loc, brick in zip(nodes.loc.tolist(), bricks, strict=True):
            node_slices = tuple(slice(8 * n, 8 * n + 8) for n in (loc[2], loc[1], loc[0]))
            assert (brick - below[node_slices]).abs().max() <= 1.01


def test_streamed_is_the_resident_tree_of_its_voxels(world):
    """At the finest level, with small pools."""
    producer, _, voxels = world
    placement = producer.spacing, producer.origin
    tree = gv.N3Tree.from_volume({"coverage": gv.Volume(voxels["coverage"], *placement)}, 8)
    alone = gv.MeshProducer(producer.voxelizer.mesh, resolution=100)
    engine = gv.Engine(alone)
    camera = gv.Camera.orbit(25, 50, 1.3, width=64, height=48)
    for lod, bound in (("finest", 0.003), ("auto", 0.02)):
        surface = gv.Isosurface(127, (0.8, 0.7, 0.6))
        options = {"lod": lod}
        expected = gv.render(tree, camera, surface, **options)
        actual = engine.render(camera, surface, **options)
        error = (actual.color - expected.color).abs()
        assert error.mean() < bound and (error > 0.1).double().mean() < 0.02
        assert expected.alpha.mean() > 0.2


def test_deep_levels_are_made_where_one_looks():
    """2^26 voxels along a side: a finest brick is compared with the plane of its triangle."""
    ball = meshes.of_corners(meshes.sphere(2).corners)
    producer = gv.MeshProducer(ball, resolution=2**26, channels=("distance",))
    layout = Layout.of(producer, 8, 1, CPU)
    producer.prepare(layout)
    corner = ball.corners[40]
    point = corner.mean(0)
    index = (point - np.array(producer.origin)) / producer.spacing[0] + 0.5
    loc = torch.tensor([[*(int(n) // 8 for n in index), layout.depth]])
    nodes = Nodes(loc, layout)
    assert producer.classify(nodes).kind.item() == Region.DATA
    actual = producer.fill(nodes).data["distance"][0, ..., 0].double()
    normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    normal /= np.linalg.norm(normal)
    local = [axis[0].double() for axis in nodes.local_axes]
    shift = nodes.center[0].numpy() - point
    height = sum(n * (x + s) for n, x, s in zip(normal, local, shift, strict=True))
    exact = height.clamp(-producer.voxelizer.band, producer.voxelizer.band)
    assert (actual - exact).abs().max() < 1e-3 * producer.spacing[0]


def test_a_file_is_read(tmp_path):
    pytest.importorskip("trimesh", reason="trimesh is not installed")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    producer = gv.MeshProducer(tmp_path / "a.obj", resolution=32)
    assert producer.extent == (32, 32, 5)
    with pytest.raises(ValueError, match="channels must be some of"):
        gv.MeshProducer(tmp_path / "a.obj", channels=("value",))


def test_what_is_no_mesh_is_told():
    with pytest.raises(ValueError, match="MeshProducer: mesh must be a Mesh, str or Path, got i"):
        gv.MeshProducer(3)
