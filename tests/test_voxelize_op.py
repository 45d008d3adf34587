"""The op `voxelize`: twin, C++ and CUDA, and closed forms."""

from __future__ import annotations

import functools
import io

import numpy as np
import pytest
import torch
from helpers import DEVICES, meshes

import gvtorch as gv
from gvtorch.meshes.geometry import Hierarchy
from gvtorch.ops import voxelize
from gvtorch.ops.reference.voxelize import box_share


def cubes(side: int = 8, device="cpu", each: int = 40):
    """Returns cubes of voxels near and far, some out of reach, one left out, and random triangles,
    some of which have no area, some of which occur twice.
    """
    generator = torch.Generator().manual_seed(side)
    middle = torch.rand((each, 1, 3), generator=generator) * (side + 4) - 2
    corner = (middle + 2 * torch.randn((each, 3, 3), generator=generator)).double()
    corner[0] = corner[0, 0]  # a point
    corner[1, 2] = corner[1, 1]  # a line
    corner[3] = corner[2]
    hierarchy = Hierarchy(corner)
    sizes = ((1, 1, 3), (0.7, 1.3, torch.inf), (1.2, 1.2, 0.5), (1, 1, -1), (0, 1, 1), (0.01, 1, 2))
    arguments = (
        corner[hierarchy.order].contiguous(),
        torch.rand(each, generator=generator) < 0.7,
        hierarchy.box,
        torch.rand((len(sizes), 3), generator=generator).double() * 2 - 1,
        torch.tensor(sizes, dtype=torch.float64),
    )
    return (*(t.to(device) for t in arguments), side, 1.25)


def all_arguments(
    args, detail: float = 0.0, shares: bool = True, weights: bool = True, wide: bool = False
):
    """Returns arguments of the bare op."""
    return (*args, detail, shares, weights, wide)


@functools.cache
def twins_answer(side: int) -> tuple[torch.Tensor, ...]:
    return voxelize(*cubes(side), weights=True, backend="reference")


@pytest.mark.parametrize("side", [1, 3, 8, 10, 16, 20])
@pytest.mark.parametrize("detail", [0.0, 0.9])
def test_compiled_is_the_twin_in_every_bit(compiled, side, detail):
    """Also where voxels are searched one by one, as for small triangles."""
    args, expected = cubes(side, DEVICES[compiled]), twins_answer(side)
    actual = voxelize(*args, weights=True, detail=detail, backend=compiled)
    for a, b in zip(actual, expected, strict=True):
        assert torch.equal(a.cpu(), b)
    distance, nearest, winding, coverage, weight = actual
    assert (nearest[3:5] == -1).all() and (distance[3:5] == torch.inf).all()
    assert (winding[4] == 0).all() and (coverage[4] == 0).all()
    assert len(winding.unique()) > 1 and 0 < coverage.mean() < 1
    assert torch.equal((nearest >= 0).float(), weight.sum(-1).round())


def test_float64_agrees_to_rounding(compiled):
    args = cubes(device=DEVICES[compiled])
    expected = voxelize(*args, weights=True, wide=True, backend="reference")
    actual = voxelize(*args, weights=True, wide=True, backend=compiled)
    assert actual[0].dtype == torch.float64
    for a, b in zip(actual, expected, strict=True):
        assert torch.allclose(a.double(), b.double(), rtol=0, atol=1e-12)


def test_triangles_beyond_float32_are_nowhere(backend):
    """Where their distances overflow: they neither count nor hide others, alone or among them."""
    *mesh, low, size, side, thickness = cubes(8, DEVICES[backend])
    far = torch.full((1, 3, 3), 1e300, dtype=torch.float64, device=DEVICES[backend])
    for triangles in (far, torch.cat((mesh[0], far))):
        hierarchy = Hierarchy(triangles)
        corner, solid = triangles[hierarchy.order].contiguous(), torch.ones(len(triangles)).bool()
        arguments = (corner, solid.to(low.device), hierarchy.box, low, size, side, thickness)
        result = voxelize(*arguments, weights=True, backend=backend)
        assert (corner[result.nearest[result.nearest >= 0]] < 1e300).all()
        assert torch.equal(result.distance < torch.inf, result.nearest >= 0)
        assert (result.nearest >= 0).any() == (len(corner) > 1)


def test_a_large_hierarchy_is_gone_through(compiled):
    """5,000 triangles in five levels of boxes, against brute force."""
    args = cubes(4, DEVICES[compiled], each=5000)
    expected = voxelize(*args, backend="reference")
    for a, b in zip(voxelize(*args, backend=compiled), expected, strict=True):
        assert torch.equal(a, b)


def test_share_of_a_box_below_a_plane_is_its_volume():
    """Against the box's exact share, by inclusion and exclusion of its corners, in float64."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn((20000, 3), generator=generator, dtype=torch.float64)
    normal = normal[(normal.abs() / normal.abs().sum(1, keepdim=True)).amin(1) > 0.02]
    unit = normal / normal.norm(dim=1, keepdim=True)
    offset = (torch.rand(len(unit), generator=generator, dtype=torch.float64) - 0.5) * 2
    size = unit.abs()
    total = torch.zeros_like(offset)
    for corner in range(8):
        picked = [axis for axis in range(3) if corner >> axis & 1]
        rest = offset + size.sum(1) / 2 - sum(size[:, axis] for axis in picked)
        total += (-1) ** len(picked) * rest.clamp(min=0) ** 3
    exact = total / (6 * size.prod(1))
    assert (box_share(normal, offset) - exact).abs().max() < 1e-9
    single = box_share(normal.float(), offset.float())
    assert (single - exact).abs().max() < 1e-3


def test_share_of_planes_along_the_axes():
    for axis in range(3):
        normal = torch.zeros(101, 3)
        normal[:, axis] = -3.0
        offset = torch.linspace(-0.7, 0.7, 101)
        exact = (offset + 0.5).clamp(0, 1)
        assert (box_share(normal, offset) - exact).abs().max() < 1 / 1024


@pytest.mark.parametrize("solid", [True, False])
def test_a_plane_fills_its_exact_share(backend, solid):
    """For every voxel that it cuts, to 1/64: counted at 32^3 points in each."""
    normal = torch.nn.functional.normalize(torch.tensor([0.36, -0.48, 0.8]), dim=0)
    u = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.tensor([1.0, 0, 0])), dim=0)
    v = torch.linalg.cross(normal, u)
    middle = torch.tensor([4.0, 4.1, 3.7])
    far = 60.0
    corner = torch.stack((middle + far * u, middle - far * u + 2 * far * v, middle - far * (u + v)))
    if torch.linalg.cross(corner[1] - corner[0], corner[2] - corner[0]) @ normal < 0:
        corner = corner.flip(0)
    faces = corner.double()[None]
    if solid:  # closed far away, behind it
        apex = (middle - 500 * normal).double()
        others = [torch.stack((faces[0, (i + 1) % 3], faces[0, i], apex)) for i in range(3)]
        faces = torch.stack((faces[0], *others))
    hierarchy = Hierarchy(faces)
    size = torch.tensor([[1.0, 1.0, torch.inf]], dtype=torch.float64)
    device = DEVICES[backend]
    args = (faces[hierarchy.order].contiguous(), torch.full((len(faces),), solid), hierarchy.box)
    args = (*args, torch.zeros(1, 3, dtype=torch.float64), size)
    outputs = voxelize(*(t.to(device) for t in args), 8, 1.5, backend=backend)
    axis = (torch.arange(8 * 32) + 0.5) / 32
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    height = (torch.stack((x, y, z), -1) - middle) @ normal
    filled = height < 0 if solid else height.abs() < 0.75
    share = filled.float().view(8, 32, 8, 32, 8, 32).mean((1, 3, 5))
    assert (outputs[3][0].cpu() - share).abs().max() < 1 / 64
    assert ((share > 0) & (share < 1)).sum() > 50
    centres = height.view(8, 32, 8, 32, 8, 32)[:, 15:17, :, 15:17, :, 15:17].mean((1, 3, 5))
    assert (outputs[0][0].cpu() - centres.abs()).abs().max() < 1e-4
    if solid:
        assert torch.equal(outputs[2][0].cpu() != 0, centres < 0)


def filled(mesh: gv.Mesh, backend, side: int = 8, solid: bool = True, wide: bool = False):
    """Returns shares (side, side, side) of a cube of voxels of side 1 that begins at 0."""
    faces = torch.from_numpy(mesh.corners)
    hierarchy = Hierarchy(faces)
    size = torch.tensor([[1.0, 1.0, 2.0]], dtype=torch.float64)
    args = (faces[hierarchy.order].contiguous(), torch.full((len(faces),), solid), hierarchy.box)
    args = (*args, torch.zeros(1, 3, dtype=torch.float64), size)
    device = DEVICES[backend]
    outputs = voxelize(*(t.to(device) for t in args), side, 1.0, wide=wide, backend=backend)
    return outputs[3][0].cpu().double()


@pytest.mark.parametrize("wide", [False, True])
def test_a_box_along_the_axes_fills_the_product_of_its_sides(backend, wide):
    """Edges, corners and a box within a voxel; faces on those of voxels, where rounding must not
    matter.
    """
    axis = torch.arange(8, dtype=torch.float64)
    for low, high in (
        ((1.3, 2.6, 0.25), (6.1, 6.2, 7.9)),
        ((2, 2, 2), (5, 6, 4)),
        ((2, 2.5, 3.25), (5, 6, 3.5)),
        ((3.2, 3.3, 3.4), (3.9, 3.5, 3.8)),
        ((-9, -9, -9), (4.5, 20, 20)),
    ):
        sides = [
            ((axis + 1).clamp(max=b) - axis.clamp(min=a)).clamp(min=0)
            for a, b in zip(low, high, strict=True)
        ]
        exact = sides[2][:, None, None] * sides[1][:, None] * sides[0]
        actual = filled(meshes.box(low, high), backend, wide=wide)
        assert (actual - exact).abs().max() < 2e-6


def test_a_turned_box_fills_what_lies_in_its_six_planes(compiled):
    """Counted at 32^3 points per voxel, also where an edge or a corner passes."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4))).Q.double()
    half, middle = torch.tensor([3.1, 2.2, 0.4]).double(), torch.tensor([4.1, 3.9, 4.2]).double()
    corners = torch.from_numpy(meshes.box(tuple(-half), tuple(half)).corners) @ turn + middle
    if torch.linalg.det(turn) < 0:
        corners = corners.flip(1)
    axis = (torch.arange(8 * 32).double() + 0.5) / 32
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    local = (torch.stack((x, y, z), -1) - middle) @ turn.T
    share = (local.abs() < half).all(-1).double().view(8, 32, 8, 32, 8, 32).mean((1, 3, 5))
    actual = filled(meshes.of_corners(corners.numpy()), compiled)
    assert (actual - share).abs().max() < 1 / 128
    assert ((share > 0.02) & (share < 0.98)).sum() > 50
    assert actual.sum() == pytest.approx(float(8 * half.prod()), rel=1e-6)


def test_the_volume_of_a_solid_is_kept_in_voxels_of_any_size(compiled):
    """For a ball of 8192 triangles, eight of them in a voxel or a thousand; for two that cross, a
    voxel's share is at most 1.
    """
    ball = meshes.of_corners(meshes.sphere(5).corners * 3.7 + 4.03)
    for scale in (1, 0.5, 0.125):
        small = meshes.of_corners(ball.corners * scale)
        coverage = filled(small, compiled)
        assert coverage.sum() == pytest.approx(meshes.volume(small), rel=1e-5)
    across = meshes.of_corners(ball.corners + np.array((0.6, 0.3, 0.2)))
    both = filled(meshes.joined(ball, across), compiled)
    a, b = filled(ball, compiled), filled(across, compiled)
    assert both.max() == 1 and (both - (a + b).clamp(max=1)).abs().max() < 1e-5
    turned = meshes.of_corners(ball.corners[:, ::-1].copy())
    assert (filled(turned, compiled) - a).abs().max() < 1e-5


def test_opcheck(compiled):
    args = cubes(4, DEVICES[compiled])
    for options in ({}, {"shares": False}, {"weights": False}, {"wide": True}):
        torch.library.opcheck(torch.ops.gvtorch.voxelize.default, all_arguments(args, **options))


class _Module(torch.nn.Module):
    def forward(
        self,
        corner: torch.Tensor,
        solid: torch.Tensor,
        box: torch.Tensor,
        low: torch.Tensor,
        size: torch.Tensor,
    ) -> torch.Tensor:
        outputs = torch.ops.gvtorch.voxelize(
            corner, solid, box, low, size, 4, 1.0, 0.0, True, True, False
        )
        return outputs[3]


@pytest.mark.filterwarnings("ignore")
def test_scripts_compiles_and_exports(compiled):
    *tensors, _, _ = cubes(4, DEVICES[compiled])
    expected = _Module()(*tensors)
    file = io.BytesIO()
    torch.jit.save(torch.jit.script(_Module()), file)
    file.seek(0)
    assert torch.equal(torch.jit.load(file)(*tensors), expected)
    fast = torch.compile(_Module(), fullgraph=True, backend="aot_eager")
    assert torch.equal(fast(*tensors), expected)
    program = torch.export.export(_Module(), tuple(tensors))
    assert torch.equal(program.module()(*tensors), expected)


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (0, torch.zeros(3, 3), "corner_f33 must be (f, 3, 3) float64"),
        (0, torch.zeros(0, 3, 3, dtype=torch.float64), "corner_f33 must hold at least one"),
        (1, torch.zeros(2, dtype=torch.bool), "solid_f must be (40,) bool"),
        (2, torch.zeros(40, 6, dtype=torch.float64), "box_n6 must be (45, 6) float64"),
        (3, torch.zeros(6, 3), "low_k3 must be"),
        (4, torch.zeros(5, 3, dtype=torch.float64), "size_k3 must be (6, 3)"),
        (5, 33, "side must be"),
        (6, -1.0, "thickness must be"),
    ],
)
def test_bad_arguments_are_told_in_a_line(index, value, message):
    args = [*cubes()]
    args[index] = value
    with pytest.raises(ValueError, match="voxelize: ") as error:
        voxelize(*args)
    assert "\n" not in str(error.value)
    assert message in str(error.value)


def test_memory_stays_safe_without_the_python_checks(compiled):
    good = cubes(device=DEVICES[compiled])
    for index, value in (
        (0, good[0][:0].contiguous()),
        (1, good[1][:3]),
        (2, good[2][:40].contiguous()),
        (3, good[3][:2].contiguous()),
        (4, good[4][:1]),
        (5, 33),
        (5, 0),
    ):
        args = [*all_arguments(good)]
        args[index] = value
        with pytest.raises(RuntimeError, match="gvtorch"):
            torch.ops.gvtorch.voxelize(*args)
    nan = [*all_arguments(good)]
    nan[2], nan[4] = good[2] * torch.nan, good[4] * torch.nan
    torch.ops.gvtorch.voxelize(*nan)
