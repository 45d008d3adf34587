"""The op `voxelize`: twin, C++ and CUDA, and closed forms."""

from __future__ import annotations

import io

import pytest
import torch
from helpers import DEVICES

from gvtorch.ops import voxelize
from gvtorch.ops.reference.voxelize import box_share


def cubes(side: int = 8, dtype=torch.float32, device="cpu", count: int = 5, each: int = 7):
    """Cubes with random triangles, some without area, some twice, and a cube without any."""
    generator = torch.Generator().manual_seed(side)
    middle = torch.rand((count * each, 1, 3), generator=generator) * (side + 4) - 2
    corner = middle + 2 * torch.randn((count * each, 3, 3), generator=generator)
    corner[0] = corner[0, 0]  # a point
    corner[1, 2] = corner[1, 1]  # a line
    corner[3] = corner[2]
    first = torch.cat((torch.arange(count + 1) * each, torch.tensor([count * each])))
    arguments = (
        corner.to(dtype),
        torch.rand(count * each, generator=generator) < 0.7,
        first,
        (torch.rand((count + 1, 3), generator=generator) * side).to(dtype),
        torch.randint(-1, 2, (count + 1,), dtype=torch.int32, generator=generator),
        torch.tensor([1.0, 1.3, 1.7], dtype=dtype),
    )
    return (*(one.to(device) for one in arguments), side, 1.25)


@pytest.mark.parametrize("side", [1, 3, 8, 10, 16])
def test_compiled_is_the_twin_in_every_bit(compiled, side):
    given = cubes(side, device=DEVICES[compiled])
    expected = voxelize(*given, backend="reference")
    found = voxelize(*given, backend=compiled)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)
    distance, nearest, winding, coverage = found
    assert (nearest[-1] == -1).all() and (distance[-1] == torch.inf).all()
    assert len(winding.unique()) > 1 and 0 < coverage.mean() < 1


def test_float64_agrees_to_rounding(compiled):
    given = cubes(dtype=torch.float64, device=DEVICES[compiled])
    expected = voxelize(*given, backend="reference")
    for one, other in zip(voxelize(*given, backend=compiled), expected, strict=True):
        assert torch.allclose(one.double(), other.double(), rtol=0, atol=1e-12, equal_nan=True)


def test_share_of_a_box_below_a_plane_is_its_volume():
    """Against the box's exact share, by inclusion and exclusion of its corners, in float64."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn((20000, 3), generator=generator, dtype=torch.float64)
    normal = normal[(normal.abs() / normal.abs().sum(1, keepdim=True)).amin(1) > 0.02]
    unit = normal / normal.norm(dim=1, keepdim=True)
    voxel = torch.tensor([1.0, 1.4, 0.6], dtype=torch.float64)
    offset = (torch.rand(len(unit), generator=generator, dtype=torch.float64) - 0.5) * 2
    size = unit.abs() * voxel
    total = torch.zeros_like(offset)
    for corner in range(8):
        picked = [axis for axis in range(3) if corner >> axis & 1]
        rest = offset + size.sum(1) / 2 - sum(size[:, axis] for axis in picked)
        total += (-1) ** len(picked) * rest.clamp(min=0) ** 3
    exact = total / (6 * size.prod(1))
    assert (box_share(normal, offset, voxel) - exact).abs().max() < 1e-9
    single = box_share(normal.float(), offset.float(), voxel.float())
    assert (single - exact).abs().max() < 1e-3


def test_share_of_planes_along_the_axes():
    for axis in range(3):
        normal = torch.zeros(101, 3)
        normal[:, axis] = -3.0
        offset = torch.linspace(-0.7, 0.7, 101)
        exact = (offset + 0.5).clamp(0, 1)
        assert (box_share(normal, offset, torch.ones(3)) - exact).abs().max() < 1 / 1024


@pytest.mark.parametrize("solid", [True, False])
def test_a_plane_fills_its_exact_share(backend, solid):
    """Of every voxel that it cuts, to 1/64: counted at 32^3 places in each."""
    normal = torch.nn.functional.normalize(torch.tensor([0.36, -0.48, 0.8]), dim=0)
    u = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.tensor([1.0, 0, 0])), dim=0)
    v = torch.linalg.cross(normal, u)
    middle = torch.tensor([4.0, 4.1, 3.7])
    far = 60.0
    corner = torch.stack((middle + far * u, middle - far * u + 2 * far * v, middle - far * (u + v)))
    if torch.linalg.cross(corner[1] - corner[0], corner[2] - corner[0]) @ normal < 0:
        corner = corner.flip(0)
    start = middle - 3 * normal  # inside, below the plane
    device = DEVICES[backend]
    given = (corner[None], torch.tensor([solid]), torch.tensor([0, 1]), start[None])
    given = (*given, torch.tensor([1 if solid else 0], dtype=torch.int32), torch.ones(3))
    found = voxelize(*(one.to(device) for one in given), 8, 1.5, backend=backend)
    at = (torch.arange(8 * 32) + 0.5) / 32
    z, y, x = torch.meshgrid(at, at, at, indexing="ij")
    height = (torch.stack((x, y, z), -1) - middle) @ normal
    filled = height < 0 if solid else height.abs() < 0.75
    share = filled.float().view(8, 32, 8, 32, 8, 32).mean((1, 3, 5))
    assert (found[3][0].cpu() - share).abs().max() < 1 / 64
    assert ((share > 0) & (share < 1)).sum() > 50
    centres = height.view(8, 32, 8, 32, 8, 32)[:, 15:17, :, 15:17, :, 15:17].mean((1, 3, 5))
    assert (found[0][0].cpu() - centres.abs()).abs().max() < 1e-4
    if solid:
        assert torch.equal(found[2][0].cpu() != 0, centres < 0)


def test_opcheck(compiled):
    given = cubes(4, device=DEVICES[compiled])
    torch.library.opcheck(torch.ops.gvtorch.voxelize.default, given)
    wide = cubes(4, torch.float64, DEVICES[compiled])
    torch.library.opcheck(torch.ops.gvtorch.voxelize.default, wide)


class _Module(torch.nn.Module):
    def forward(
        self,
        corner: torch.Tensor,
        solid: torch.Tensor,
        first: torch.Tensor,
        start: torch.Tensor,
        winding: torch.Tensor,
        voxel: torch.Tensor,
    ) -> torch.Tensor:
        found = torch.ops.gvtorch.voxelize(corner, solid, first, start, winding, voxel, 4, 1.0)
        return found[3]


@pytest.mark.filterwarnings("ignore")
def test_scripts_compiles_and_exports(compiled):
    *tensors, _, _ = cubes(4, device=DEVICES[compiled])
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
    ("place", "value", "said"),
    [
        (0, torch.zeros(3, 3), "corner_m33 must be (m, 3, 3) float32"),
        (0, torch.zeros(2, 3, 3, dtype=torch.int32), "corner_m33 must be float32 or float64"),
        (1, torch.zeros(2, dtype=torch.bool), "solid_m must be (35,) bool"),
        (2, torch.zeros(3, dtype=torch.int64), "first_k must be (7,) int64"),
        (3, torch.zeros(6, 3, dtype=torch.float64), "start_k3 must be"),
        (5, torch.zeros(4), "voxel_3 must be (3,) float32"),
        (6, 17, "side must be"),
        (7, -1.0, "thickness must be"),
    ],
)
def test_bad_arguments_are_told_in_a_line(place, value, said):
    given = [*cubes()]
    given[place] = value
    with pytest.raises(ValueError, match="voxelize: ") as error:
        voxelize(*given)
    assert "\n" not in str(error.value)
    assert said in str(error.value)


def test_memory_stays_safe_without_the_python_checks(compiled):
    good = cubes(device=DEVICES[compiled])
    for place, value in (
        (1, good[1][:3]),
        (3, good[3][:2].contiguous()),
        (4, good[4][:1]),
        (5, good[5][:2]),
        (6, 17),
        (6, 0),
    ):
        given = [*good]
        given[place] = value
        with pytest.raises(RuntimeError, match="gvtorch"):
            torch.ops.gvtorch.voxelize(*given)
    beyond = [*good]
    beyond[2] = good[2] * 1000 - 5  # lists that lead out of the triangles are cut
    torch.ops.gvtorch.voxelize(*beyond)
