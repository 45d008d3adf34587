"""The op `splat`: twin, C++ and CUDA in every bit; against independently computed integrals; sums;
hostile input."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from helpers import DEVICES, ROOT
from helpers.points import share_below
from torch import Tensor

from gvtorch.ops import splat
from gvtorch.ops.splat import shares
from gvtorch.points.grid import point_shares
from gvtorch.points.points import Points
from gvtorch.points.sorted import sort_points
from gvtorch.points.splat import Cubes, values

REAL = torch.float64
RADII = (0.0, 5e-324, 1e-305, 1e-5, 0.02, 0.1, 0.7, 40.0, 1e200)


class Given(NamedTuple):
    """The op's arguments, by name."""

    edge_k3e: Tensor
    low_k3: Tensor
    narrow_b: Tensor
    narrow_s2: Tensor
    voxel_n3: Tensor
    value_nc: Tensor
    wide_b: Tensor
    wide_t2: Tensor
    center_m3: Tensor
    radius_m: Tensor
    value_mc: Tensor

    def to(self, device: str) -> Given:
        return Given(*(one.to(device) for one in self))


def whole(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.int64)


def some(
    cubes: int = 5, side: int = 6, width: int = 3, rows: int = 200, runs: int = 30, seed: int = 1
) -> Given:
    """Returns cubes anywhere, lists of any length that share rows, points inside, outside and at
    edges, of all kinds of radii; spans that are empty, run backwards or leave the table.
    """
    random = torch.Generator().manual_seed(seed)

    def real(*shape: int) -> Tensor:
        return torch.rand(shape, generator=random, dtype=REAL)

    def ints(low: int, high: int, *shape: int) -> Tensor:
        return torch.randint(low, high, shape, generator=random)

    def lists() -> tuple[Tensor, Tensor]:
        begin = ints(-2, rows + 2, runs)
        spans = torch.stack((begin, begin + ints(-3, 24, runs)), 1)
        inner = ints(0, runs + 1, max(0, cubes - 1)).sort()[0]
        return torch.cat((whole(0), inner, whole(runs)))[: cubes + 1], spans

    edge = real(cubes, 3, 1) + 0.05 * torch.arange(side + 1)
    edge[..., -1] = edge[..., -2]  # clipped at a box: a voxel without extent
    center = 1.5 * real(rows, 3)
    if cubes:
        center[::7] = edge[ints(0, cubes, len(center[::7])), :, ints(0, side + 1, 1)[0]]
    radius = torch.tensor(RADII, dtype=REAL)[ints(0, len(RADII), rows)]
    value = [(real(rows, width) - 0.4) * 10.0 ** ints(-3, 4, rows, 1) for _ in range(2)]
    value[0][5], value[1][5], value[1][6] = 1e300, -1e300, 5e-324
    place = ints(-2, side + 2, rows, 3)
    low = ints(-2, 3, cubes, 3)
    return Given(edge, low, *lists(), place, value[0], *lists(), center, radius, value[1])


def bits(values: Tensor) -> Tensor:
    return values.cpu().view(torch.int64)


SHAPES = [
    {},
    {"side": 1},
    {"width": 1},
    {"width": 9, "side": 3},
    {"width": 300, "side": 2, "rows": 60},
    {"side": 37, "cubes": 1, "width": 8},
    {"cubes": 1, "runs": 1},
    {"cubes": 40, "side": 2, "runs": 12},
    {"runs": 0},
    {"cubes": 0},
]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_compiled_is_the_twin_in_every_bit(compiled, shape):
    given = some(**shape)
    expected = splat(*given, backend="reference")
    found = splat(*given.to(DEVICES[compiled]), backend=compiled)
    cubes, side, width = len(given.low_k3), given.edge_k3e.shape[2] - 1, given.value_nc.shape[1]
    assert found.shape == expected.shape == (cubes, side, side, side, width)
    assert torch.equal(bits(found), bits(expected))
    assert torch.equal(bits(splat(*given.to(DEVICES[compiled]))), bits(expected))
    assert bool(expected.any()) == bool(cubes and shape.get("runs", 1))
    assert not (bits(expected) == torch.iinfo(torch.int64).min).any(), "no sum is -0"


@pytest.mark.parametrize("kind", ["narrow", "wide"])
def test_each_kind_alone_is_the_twin_and_lists_may_be_empty(compiled, kind):
    given, none = some(cubes=12, runs=9), torch.zeros(13, dtype=torch.int64)
    alone = given._replace(**{"wide_b" if kind == "narrow" else "narrow_b": none})
    expected = splat(*alone, backend="reference")
    assert torch.equal(bits(splat(*alone.to(DEVICES[compiled]))), bits(expected))
    begin = given.narrow_b if kind == "narrow" else given.wide_b
    bare = begin[1:] == begin[:-1]
    assert bare.any() and not expected[bare].any() and expected[~bare].any()
    nothing = alone._replace(narrow_b=none, wide_b=none).to(DEVICES[compiled])
    assert not splat(*nothing, backend=compiled).any()


@pytest.mark.parametrize("instructions", ["baseline", "avx2"])
@pytest.mark.backend("cpp")
def test_all_instruction_sets_give_the_same_bits(instructions, tmp_path):
    """The other tests use the widest instruction set of the machine."""
    given = some()
    torch.save(list(given), tmp_path / "given.pt")
    code = (
        "import torch; from gvtorch.ops import splat; "
        "torch.save(splat(*torch.load('given.pt'), backend='cpp'), 'found.pt')"
    )
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "GVTORCH_CPU": instructions, "PYTHONPATH": str(ROOT)},
    )
    assert run.returncode == 0, run.stderr
    found = torch.load(tmp_path / "found.pt")
    assert torch.equal(bits(found), bits(splat(*given, backend="reference")))


def one_point(radius: float, side: int = 8, center: tuple = (0.31, -0.12, 0.07)) -> Given:
    """Returns a cube of side 2 around the origin, and a point with the values 1 and 2 in it."""
    edge = torch.linspace(-1, 1, side + 1, dtype=REAL).expand(1, 3, -1).contiguous()
    none = (whole(0, 0), torch.zeros((0, 2), dtype=torch.int64), torch.zeros((0, 3)).long())
    own = (whole(0, 1), whole((0, 1)), torch.tensor([center], dtype=REAL))
    value = (torch.tensor([radius], dtype=REAL), torch.tensor([[1.0, 2.0]], dtype=REAL))
    return Given(edge, whole((0, 0, 0)), *none, torch.zeros((0, 2), dtype=REAL), *own, *value)


@pytest.mark.parametrize("radius", [0.03, 0.4, 3.0])
def test_a_voxel_holds_the_integral_of_the_spline(backend, radius):
    """By the midpoint rule over the density, and by another closed form, of four uniform random
    numbers (Irwin, Hall)."""
    center = (0.31, -0.12, 0.07)
    given = one_point(radius, center=center)
    found = splat(*given.to(DEVICES[backend]), backend=backend).cpu().numpy()[0]
    fine = 1 << 15
    places = (np.arange(8 * fine) + 0.5) / (4 * fine) - 1
    shares = []
    for at in center:
        far = 2 * np.abs(places - at) / radius
        inner = 2 / 3 - far**2 + far**3 / 2
        density = np.where(far < 1, inner, np.clip(2 - far, 0, None) ** 3 / 6) * 2 / radius
        shares.append(density.reshape(8, fine).sum(1) / (4 * fine))
        edges = given.edge_k3e[0, 0].numpy()
        assert np.allclose(shares[-1], np.diff(share_below(edges, at, radius)), atol=2e-8)
    exact = [np.diff(share_below(edges, at, radius)) for at in center]
    for (x, y, z), tolerance in ((shares, 1e-7), (exact, 1e-14)):
        expected = z[:, None, None] * y[:, None] * x
        assert np.allclose(found[..., 0], expected, rtol=0, atol=tolerance)
    assert np.array_equal(found[..., 1], 2 * found[..., 0])


@pytest.mark.parametrize("radius", [0.0, 1e-310, 1e-12, 0.02, 0.69])
def test_mass_is_kept_to_rounding_of_float64(backend, radius):
    given = one_point(radius).to(DEVICES[backend])
    for side in (1, 2, 3, 8, 33):
        edge = torch.linspace(-1, 1, side + 1, dtype=REAL).expand(1, 3, -1).contiguous()
        held = splat(*given._replace(edge_k3e=edge.to(DEVICES[backend])), backend=backend)
        total = held.sum((0, 1, 2, 3)).cpu().numpy()
        assert np.allclose(total, [1, 2], rtol=4e-16 * side, atol=0)


@pytest.mark.parametrize("center", [(0.25, -0.5, 0.0), (0.3, -0.45, 0.1)])
def test_a_point_without_a_radius_is_wholly_in_the_upper_voxel_at_an_edge(backend, center):
    given = one_point(0.0, center=center).to(DEVICES[backend])
    held = splat(*given, backend=backend)[0, ..., 0]
    assert held[4, 2, 5] == 1 and held.sum() == 1
    tiny = splat(*given._replace(radius_m=given.radius_m + 1e-320), backend=backend)[0, ..., 0]
    assert tiny.sum() == 1 and tiny[4, 2, 5] == (1 if center[0] == 0.3 else 0.125)


def test_lists_are_added_up_in_their_order(backend):
    """Adding 1e16, 1 and -1e16 keeps the 1 only in some orders."""
    given = one_point(0.0)
    numbers = torch.tensor([[1e16], [1.0], [-1e16]], dtype=REAL)
    places = given._replace(
        center_m3=given.center_m3.expand(3, 3).contiguous(),
        radius_m=torch.zeros(3, dtype=REAL),
        value_mc=numbers,
        value_nc=numbers,
        voxel_n3=whole((5, 3, 4)).expand(3, 3).contiguous(),
    )
    for order, expected in (((0, 1, 2), 0.0), ((0, 2, 1), 1.0), ((1, 0, 2), 0.0)):
        runs = whole(*((one, one + 1) for one in order))
        for kind in ("narrow", "wide"):
            lists = {f"{kind}_b": whole(0, 3), f"{kind}_{'s' if kind == 'narrow' else 't'}2": runs}
            other = {"wide_b" if kind == "narrow" else "narrow_b": whole(0, 0)}
            put = places._replace(**{**lists, **other}).to(DEVICES[backend])
            held = splat(*put, backend=backend)
            assert held[0, 4, 3, 5, 0] == expected and held.sum() == expected


def test_rows_far_out_and_numbers_that_are_none_stay_where_they_are(compiled):
    """No value in tables and lists leads to an invalid memory address."""
    given = some()
    far = 2**63 - 1
    given.narrow_b[1], given.narrow_b[2] = -far - 1, far
    given.narrow_s2[::3], given.wide_t2[::3] = whole(-far - 1, 40), whole(150, far)
    given.wide_b[2] = far
    given.low_k3[0], given.voxel_n3[::5] = -far - 1, far
    given.center_m3[::4], given.center_m3[1::8] = math.nan, math.inf
    given.radius_m[::9], given.radius_m[1::9], given.radius_m[2::9] = -1.0, math.inf, math.nan
    expected = splat(*given, backend="reference")
    assert torch.equal(bits(splat(*given.to(DEVICES[compiled]), backend=compiled)), bits(expected))
    assert expected.any() and not expected.isnan().any()


def test_opcheck(compiled):
    given = some(cubes=3, side=4, rows=40, runs=6).to(DEVICES[compiled])
    torch.library.opcheck(torch.ops.gvtorch.splat.default, tuple(given))


@pytest.mark.filterwarnings("ignore")  # torch deprecates its own TorchScript
def test_scripts_compiles_and_exports(compiled):
    class Splat(torch.nn.Module):
        def __init__(self, given: Given) -> None:
            super().__init__()
            for name, value in given._asdict().items():
                self.register_buffer(name, value)

        def forward(self, edge_k3e: Tensor, low_k3: Tensor) -> Tensor:
            narrow = (self.narrow_b, self.narrow_s2, self.voxel_n3, self.value_nc)
            wide = (self.wide_b, self.wide_t2, self.center_m3, self.radius_m, self.value_mc)
            return torch.ops.gvtorch.splat(*(edge_k3e, low_k3, *narrow), *wide)

    given = some(cubes=3, side=4, rows=40, runs=6).to(DEVICES[compiled])
    module, places = Splat(given), (given.edge_k3e, given.low_k3)
    expected = splat(*given, backend=compiled)
    assert torch.equal(torch.jit.script(module)(*places), expected)
    fast = torch.compile(module, fullgraph=True, backend="aot_eager", dynamic=True)
    assert torch.equal(fast(*places), expected)
    edges = torch.export.Dim("edges", min=3, max=1 << 10)
    shapes = [{2: edges}, None]
    program = torch.export.export(module, places, dynamic_shapes=shapes).module()
    assert torch.equal(program(*places), expected)
    fewer = given.edge_k3e[..., :4].contiguous()
    assert torch.equal(program(fewer, given.low_k3), splat(fewer, *given[1:], backend=compiled))

    def checked(value_nc: Tensor) -> Tensor:
        return splat(*given._replace(value_nc=value_nc * 2.0), backend=compiled)

    fast = torch.compile(checked, fullgraph=True, backend="aot_eager")
    assert torch.equal(fast(given.value_nc), checked(given.value_nc))


BAD = {
    "edge_k3e": (lambda one: one[:, :2].contiguous(), lambda one: one[..., :1].contiguous()),
    "low_k3": (lambda one: one[:1], lambda one: one.int()),
    "narrow_b": (lambda one: one[:-1], lambda one: one.int()),
    "narrow_s2": (lambda one: one.int(), lambda one: one.t()),
    "voxel_n3": (lambda one: one[1:], lambda one: one.int()),
    "value_nc": (lambda one: one.float(), lambda one: one[:, :0].contiguous()),
    "wide_b": (lambda one: one[:-1], lambda one: one.double()),
    "wide_t2": (lambda one: one.double(), lambda one: one.t()),
    "center_m3": (lambda one: one[1:], lambda one: one.float()),
    "radius_m": (lambda one: one[:-1], lambda one: one.float()),
    "value_mc": (lambda one: one[:, 1:].contiguous(), lambda one: one.float()),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_named_and_memory_stays_safe_without_that(compiled, name):
    given = some().to(DEVICES[compiled])
    assert set(BAD) == set(Given._fields)
    for spoil in BAD[name]:
        bad = given._replace(**{name: spoil(getattr(given, name))})
        with pytest.raises(ValueError, match="splat: "):
            splat(*bad)
        with pytest.raises(RuntimeError, match="gvtorch: "):
            torch.ops.gvtorch.splat(*bad)


def test_no_gradient_is_lost(compiled):
    given = some().to(DEVICES[compiled])
    given.value_mc.requires_grad_()
    with pytest.raises(RuntimeError, match="splat: gradients by value_mc would be lost"):
        splat(*given, backend=compiled)


def test_points_in_numpy_have_the_shares_of_the_twin():
    edge, center = np.linspace(-1, 1, 12).repeat(3).reshape(12, 3).T.copy(), np.array([0, 0.1, 2])
    radius = np.array([0.5, 0.0, 3.0])
    expected = shares(*map(torch.from_numpy, (edge, center, radius)))
    found = point_shares(edge, center, radius)
    assert np.array_equal(found, expected.numpy())
    exact = [np.diff(share_below(edge[i], center[i], radius[i])) for i in range(3)]
    assert np.allclose(found, exact, rtol=0, atol=1e-15)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("branching, level", [(2, 0), (2, 2), (3, 1)])
def test_voxels_of_points_are_those_of_the_twin(monkeypatch, branching, level):
    random = torch.Generator().manual_seed(2)
    place, value = (torch.rand((900, n), generator=random) for n in (3, 2))
    radius = torch.tensor([0.0, 0.03, 0.2])[torch.randint(0, 3, (900,), generator=random)]
    points = sort_points(Points(place, value, radius=radius), 36, branching=branching)
    cubes = Cubes(np.array([(-1, 3, 2), (7, 0, 5), (40, 0, 0)]), 6, level)
    found = values(points, cubes)
    monkeypatch.setattr("gvtorch.points.splat.splat", partial(splat, backend="reference"))
    assert np.array_equal(found, values(points, cubes))
    assert found[1].any() and not found[0, ..., 0, :].any() and not found[2].any()
