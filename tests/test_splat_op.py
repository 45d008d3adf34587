"""The op `splat`: twin, C++ and CUDA in every bit; against independently computed integrals; sums;
hostile input."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.packets import result, start
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


class Arguments(NamedTuple):
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

    def to(self, device: str) -> Arguments:
        return Arguments(*(t.to(device) for t in self))


def whole(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.int64)


def random_arguments(
    cubes: int = 5, side: int = 6, width: int = 3, rows: int = 200, runs: int = 30, seed: int = 1
) -> Arguments:
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
    position = ints(-2, side + 2, rows, 3)
    low = ints(-2, 3, cubes, 3)
    return Arguments(edge, low, *lists(), position, value[0], *lists(), center, radius, value[1])


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
    args = random_arguments(**shape)
    expected = splat(*args, backend="reference")
    actual = splat(*args.to(DEVICES[compiled]), backend=compiled)
    cubes, side, width = len(args.low_k3), args.edge_k3e.shape[2] - 1, args.value_nc.shape[1]
    assert actual.shape == expected.shape == (cubes, side, side, side, width)
    assert torch.equal(bits(actual), bits(expected))
    assert torch.equal(bits(splat(*args.to(DEVICES[compiled]))), bits(expected))
    assert bool(expected.any()) == bool(cubes and shape.get("runs", 1))
    assert not (bits(expected) == torch.iinfo(torch.int64).min).any(), "no sum is -0"


@pytest.mark.parametrize("kind", ["narrow", "wide"])
def test_each_kind_alone_is_the_twin_and_lists_may_be_empty(compiled, kind):
    args, none = random_arguments(cubes=12, runs=9), torch.zeros(13, dtype=torch.int64)
    alone = args._replace(**{"wide_b" if kind == "narrow" else "narrow_b": none})
    expected = splat(*alone, backend="reference")
    assert torch.equal(bits(splat(*alone.to(DEVICES[compiled]))), bits(expected))
    begin = args.narrow_b if kind == "narrow" else args.wide_b
    bare = begin[1:] == begin[:-1]
    assert bare.any() and not expected[bare].any() and expected[~bare].any()
    nothing = alone._replace(narrow_b=none, wide_b=none).to(DEVICES[compiled])
    assert not splat(*nothing, backend=compiled).any()


def splatted() -> Tensor:
    return splat(*random_arguments(), backend="cpp")


@pytest.mark.long
@pytest.mark.parametrize("instructions", ["baseline", "avx2"])
@pytest.mark.backend("cpp")
def test_all_instruction_sets_give_the_same_bits(instructions, tmp_path):
    """The other tests use the widest instruction set of the machine."""
    actual = result(start(splatted, tmp_path, instructions))
    assert torch.equal(bits(actual), bits(splat(*random_arguments(), backend="reference")))


def one_point(radius: float, side: int = 8, center: tuple = (0.31, -0.12, 0.07)) -> Arguments:
    """Returns a cube of side 2 around the origin, and a point with the values 1 and 2 in it."""
    edge = torch.linspace(-1, 1, side + 1, dtype=REAL).expand(1, 3, -1).contiguous()
    none = (whole(0, 0), torch.zeros((0, 2), dtype=torch.int64), torch.zeros((0, 3)).long())
    point = (whole(0, 1), whole((0, 1)), torch.tensor([center], dtype=REAL))
    value = (torch.tensor([radius], dtype=REAL), torch.tensor([[1.0, 2.0]], dtype=REAL))
    return Arguments(edge, whole((0, 0, 0)), *none, torch.zeros((0, 2), dtype=REAL), *point, *value)


@pytest.mark.parametrize("radius", [0.03, 0.4, 3.0])
def test_a_voxel_holds_the_integral_of_the_spline(backend, radius):
    """By the midpoint rule over the density, and by another closed form, of four uniform random
    numbers (Irwin, Hall)."""
    center = (0.31, -0.12, 0.07)
    args = one_point(radius, center=center)
    actual = splat(*args.to(DEVICES[backend]), backend=backend).cpu().numpy()[0]
    fine = 1 << 15
    positions = (np.arange(8 * fine) + 0.5) / (4 * fine) - 1
    shares = []
    for point_x in center:
        far = 2 * np.abs(positions - point_x) / radius
        inner = 2 / 3 - far**2 + far**3 / 2
        density = np.where(far < 1, inner, np.clip(2 - far, 0, None) ** 3 / 6) * 2 / radius
        shares.append(density.reshape(8, fine).sum(1) / (4 * fine))
        edges = args.edge_k3e[0, 0].numpy()
        assert np.allclose(shares[-1], np.diff(share_below(edges, point_x, radius)), atol=2e-8)
    exact = [np.diff(share_below(edges, point_x, radius)) for point_x in center]
    for (x, y, z), tolerance in ((shares, 1e-7), (exact, 1e-14)):
        expected = z[:, None, None] * y[:, None] * x
        assert np.allclose(actual[..., 0], expected, rtol=0, atol=tolerance)
    assert np.array_equal(actual[..., 1], 2 * actual[..., 0])


@pytest.mark.parametrize("radius", [0.0, 1e-310, 1e-12, 0.02, 0.69])
def test_mass_is_kept_to_rounding_of_float64(backend, radius):
    args = one_point(radius).to(DEVICES[backend])
    for side in (1, 2, 3, 8, 33):
        edge = torch.linspace(-1, 1, side + 1, dtype=REAL).expand(1, 3, -1).contiguous()
        held = splat(*args._replace(edge_k3e=edge.to(DEVICES[backend])), backend=backend)
        total = held.sum((0, 1, 2, 3)).cpu().numpy()
        assert np.allclose(total, [1, 2], rtol=4e-16 * side, atol=0)


@pytest.mark.parametrize("center", [(0.25, -0.5, 0.0), (0.3, -0.45, 0.1)])
def test_a_point_without_a_radius_is_wholly_in_the_upper_voxel_at_an_edge(backend, center):
    args = one_point(0.0, center=center).to(DEVICES[backend])
    held = splat(*args, backend=backend)[0, ..., 0]
    assert held[4, 2, 5] == 1 and held.sum() == 1
    tiny = splat(*args._replace(radius_m=args.radius_m + 1e-320), backend=backend)[0, ..., 0]
    assert tiny.sum() == 1 and tiny[4, 2, 5] == (1 if center[0] == 0.3 else 0.125)


def test_lists_are_added_up_in_their_order(backend):
    """Adding 1e16, 1 and -1e16 keeps the 1 only in some orders."""
    args = one_point(0.0)
    numbers = torch.tensor([[1e16], [1.0], [-1e16]], dtype=REAL)
    points = args._replace(
        center_m3=args.center_m3.expand(3, 3).contiguous(),
        radius_m=torch.zeros(3, dtype=REAL),
        value_mc=numbers,
        value_nc=numbers,
        voxel_n3=whole((5, 3, 4)).expand(3, 3).contiguous(),
    )
    for order, expected in (((0, 1, 2), 0.0), ((0, 2, 1), 1.0), ((1, 0, 2), 0.0)):
        runs = whole(*((row, row + 1) for row in order))
        for kind in ("narrow", "wide"):
            lists = {f"{kind}_b": whole(0, 3), f"{kind}_{'s' if kind == 'narrow' else 't'}2": runs}
            other = {"wide_b" if kind == "narrow" else "narrow_b": whole(0, 0)}
            put = points._replace(**{**lists, **other}).to(DEVICES[backend])
            held = splat(*put, backend=backend)
            assert held[0, 4, 3, 5, 0] == expected and held.sum() == expected


def test_rows_far_out_and_numbers_that_are_none_stay_where_they_are(compiled):
    """No value in tables and lists leads to an invalid memory address."""
    args = random_arguments()
    far = 2**63 - 1
    args.narrow_b[1], args.narrow_b[2] = -far - 1, far
    args.narrow_s2[::3], args.wide_t2[::3] = whole(-far - 1, 40), whole(150, far)
    args.wide_b[2] = far
    args.low_k3[0], args.voxel_n3[::5] = -far - 1, far
    args.center_m3[::4], args.center_m3[1::8] = math.nan, math.inf
    args.radius_m[::9], args.radius_m[1::9], args.radius_m[2::9] = -1.0, math.inf, math.nan
    expected = splat(*args, backend="reference")
    assert torch.equal(bits(splat(*args.to(DEVICES[compiled]), backend=compiled)), bits(expected))
    assert expected.any() and not expected.isnan().any()


def test_opcheck(compiled):
    args = random_arguments(cubes=3, side=4, rows=40, runs=6).to(DEVICES[compiled])
    torch.library.opcheck(torch.ops.gvtorch.splat.default, tuple(args))


@pytest.mark.filterwarnings("ignore")  # torch deprecates its own TorchScript
def test_scripts_compiles_and_exports(compiled):
    class Splat(torch.nn.Module):
        def __init__(self, args: Arguments) -> None:
            super().__init__()
            for name, value in args._asdict().items():
                self.register_buffer(name, value)

        def forward(self, edge_k3e: Tensor, low_k3: Tensor) -> Tensor:
            narrow = (self.narrow_b, self.narrow_s2, self.voxel_n3, self.value_nc)
            wide = (self.wide_b, self.wide_t2, self.center_m3, self.radius_m, self.value_mc)
            return torch.ops.gvtorch.splat(*(edge_k3e, low_k3, *narrow), *wide)

    args = random_arguments(cubes=3, side=4, rows=40, runs=6).to(DEVICES[compiled])
    module, positions = Splat(args), (args.edge_k3e, args.low_k3)
    expected = splat(*args, backend=compiled)
    assert torch.equal(torch.jit.script(module)(*positions), expected)
    fast = torch.compile(module, fullgraph=True, backend="aot_eager", dynamic=True)
    assert torch.equal(fast(*positions), expected)
    edges = torch.export.Dim("edges", min=3, max=1 << 10)
    shapes = [{2: edges}, None]
    program = torch.export.export(module, positions, dynamic_shapes=shapes).module()
    assert torch.equal(program(*positions), expected)
    fewer = args.edge_k3e[..., :4].contiguous()
    assert torch.equal(program(fewer, args.low_k3), splat(fewer, *args[1:], backend=compiled))

    def checked(value_nc: Tensor) -> Tensor:
        return splat(*args._replace(value_nc=value_nc * 2.0), backend=compiled)

    fast = torch.compile(checked, fullgraph=True, backend="aot_eager")
    assert torch.equal(fast(args.value_nc), checked(args.value_nc))


BAD = {
    "edge_k3e": (lambda t: t[:, :2].contiguous(), lambda t: t[..., :1].contiguous()),
    "low_k3": (lambda t: t[:1], lambda t: t.int()),
    "narrow_b": (lambda t: t[:-1], lambda t: t.int()),
    "narrow_s2": (lambda t: t.int(), lambda t: t.t()),
    "voxel_n3": (lambda t: t[1:], lambda t: t.int()),
    "value_nc": (lambda t: t.float(), lambda t: t[:, :0].contiguous()),
    "wide_b": (lambda t: t[:-1], lambda t: t.double()),
    "wide_t2": (lambda t: t.double(), lambda t: t.t()),
    "center_m3": (lambda t: t[1:], lambda t: t.float()),
    "radius_m": (lambda t: t[:-1], lambda t: t.float()),
    "value_mc": (lambda t: t[:, 1:].contiguous(), lambda t: t.float()),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_named_and_memory_stays_safe_without_that(compiled, name):
    args = random_arguments().to(DEVICES[compiled])
    assert set(BAD) == set(Arguments._fields)
    for spoil in BAD[name]:
        bad = args._replace(**{name: spoil(getattr(args, name))})
        with pytest.raises(ValueError, match="splat: "):
            splat(*bad)
        with pytest.raises(RuntimeError, match="gvtorch: "):
            torch.ops.gvtorch.splat(*bad)


def test_no_gradient_is_lost(compiled):
    args = random_arguments().to(DEVICES[compiled])
    args.value_mc.requires_grad_()
    with pytest.raises(RuntimeError, match="splat: gradients by value_mc would be lost"):
        splat(*args, backend=compiled)


def test_points_in_numpy_have_the_shares_of_the_twin():
    edge, center = np.linspace(-1, 1, 12).repeat(3).reshape(12, 3).T.copy(), np.array([0, 0.1, 2])
    radius = np.array([0.5, 0.0, 3.0])
    expected = shares(*map(torch.from_numpy, (edge, center, radius)))
    actual = point_shares(edge, center, radius)
    assert np.array_equal(actual, expected.numpy())
    exact = [np.diff(share_below(edge[i], center[i], radius[i])) for i in range(3)]
    assert np.allclose(actual, exact, rtol=0, atol=1e-15)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("branching, level", [(2, 0), (2, 2), (3, 1)])
def test_voxels_of_points_are_those_of_the_twin(monkeypatch, branching, level):
    random = torch.Generator().manual_seed(2)
    position, value = (torch.rand((900, n), generator=random) for n in (3, 2))
    radius = torch.tensor([0.0, 0.03, 0.2])[torch.randint(0, 3, (900,), generator=random)]
    points = sort_points(Points(position, value, radius=radius), 36, branching=branching)
    cubes = Cubes(np.array([(-1, 3, 2), (7, 0, 5), (40, 0, 0)]), 6, level)
    actual = values(points, cubes)
    monkeypatch.setattr("gvtorch.points.splat.splat", partial(splat, backend="reference"))
    assert np.array_equal(actual, values(points, cubes))
    assert actual[1].any() and not actual[0, ..., 0, :].any() and not actual[2].any()
