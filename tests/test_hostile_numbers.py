"""Numbers, tensors and devices that are not what they must be: an error of one line, never a wrong
result in silence.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

import gvtorch as gv
from gvtorch import ops
from gvtorch.base import check
from gvtorch.bench.record import Settings

GRID = torch.rand(4, 5, 6, generator=torch.Generator().manual_seed(0))
COMPLEX = torch.complex(GRID, GRID)
NEGATED = COMPLEX.conj().imag  # torch has yet to change its sign


def line_of(call, *errors) -> str:
    """Returns the text of the ValueError, or one of `errors`, that a call must raise."""
    with pytest.raises(errors or ValueError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and "ambiguous" not in text and len(text) < 500
    return text


@pytest.mark.parametrize(
    "value",
    [
        *("1", b"1", 1j, None, [1.0], np.complex64(1), np.ones(3)),
        *(torch.tensor(1j), torch.zeros(3), torch.zeros((), device="meta")),
    ],
    ids=repr,
)
def test_only_real_numbers_are_numbers(value):
    assert "must be a number" in line_of(lambda: check.number("here", "x", value))
    assert "must be" in line_of(lambda: gv.RenderOptions(step=value)) if value is not None else True


@pytest.mark.parametrize(
    "value", [True, np.float32(0.5), np.int8(2), torch.tensor(2), torch.ones(1)]
)
def test_what_float_takes_of_numbers_is_one(value):
    assert check.number("here", "x", value) == float(value)


@pytest.mark.parametrize("value", ["123", ("1", "2", "3"), np.ones(3, np.complex64)], ids=repr)
def test_three_numbers_are_no_text(value):
    assert "must be" in line_of(lambda: gv.Volume(GRID, spacing=value))
    assert "must be" in line_of(lambda: gv.as_volume(GRID, spacing=value))
    assert "must be" in line_of(lambda: check.reals("here", "x", value, (3,)))


def test_errors_of_arrays_have_one_line():
    square = np.zeros((3, 3))
    for call in (
        lambda: check.box("here", square),
        lambda: check.box("here", torch.zeros(3, 3)),
        lambda: check.box("here", torch.tensor(3.0)),
        lambda: check.box("here", np.array(3.0)),
        lambda: check.one_of("here", "x", square, ("a", "b")),
        lambda: check.one_of("here", "x", np.array(["a"]), ("a", "b")),
        lambda: check.one_of("here", "x", "z" * 5000, ("a", "b")),
        lambda: check.device("here", square),
        lambda: check.nbytes("here", "x", "9" * 400),
        lambda: check.nbytes("here", "x", "9" * 400 + " TB"),
    ):
        assert line_of(call).startswith("here: ")


def test_devices_are_those_of_tensors_or_refused():
    assert check.device("here", "cpu:0") == gv.Volume(GRID).to("cpu:3").data.device == GRID.device
    for name in ("mps", "xla", "vulkan", "meta"):
        assert f"device '{name}' can't be used" in line_of(
            lambda name=name: check.device("x", name)
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_tensor_with_a_pending_sign_is_its_values(dtype):
    negated = COMPLEX.to(dtype=torch.complex64 if dtype == torch.float32 else torch.complex128)
    negated = negated.conj().imag
    assert negated.is_neg()
    for volume in (gv.Volume(negated), gv.as_volume(negated), gv.as_volume(negated, axes="xyz")):
        assert not volume.data.is_neg()
    assert torch.equal(gv.Volume(negated).data[..., 0], -GRID)
    whole = (negated * 9).round()
    assert torch.equal(
        gv.Volume(torch.complex(whole, -whole).conj().imag, labels=True).data,
        gv.Volume(whole.clone(), labels=True).data,
    )


@pytest.mark.parametrize(
    "data",
    [
        GRID.to_sparse(),
        torch.empty(4, 5, 6, device="meta"),
        np.ma.masked_array(GRID.numpy(), GRID.numpy() > 0.5),
        np.ma.masked_array(GRID.numpy(), False),
        COMPLEX,
    ],
    ids=["sparse", "meta", "masked", "masked nowhere", "complex"],
)
@pytest.mark.parametrize("labels", [False, True])
def test_grids_that_are_no_plain_array_are_refused(data, labels):
    assert line_of(lambda: gv.Volume(data, labels=labels)).startswith("Volume: ")
    if not isinstance(data, np.ma.MaskedArray):
        assert "must" in line_of(lambda: gv.as_volume(data, axes="xyz"))


def test_as_volume_takes_floats_that_numpy_lacks():
    assert gv.as_volume(GRID.bfloat16()).data.dtype == torch.bfloat16
    for dtype in (torch.bfloat16, torch.float8_e4m3fn):
        small = GRID.to(dtype)
        assert torch.equal(
            gv.as_volume(small, axes="xyz").data[..., 0], small.float().permute(2, 1, 0)
        )
        assert torch.equal(gv.Volume(small).data[..., 0].float(), small.float())


def test_as_volume_keeps_its_promises_for_tensors():
    for three in (np.array([1.0, 2.0, 3.0]), torch.tensor([1.0, 2.0, 3.0])):
        assert gv.as_volume(GRID, spacing=three).spacing == (1, 2, 3)
        assert gv.as_volume(GRID, origin=three).origin == (1, 2, 3)
    assert "three numbers" in line_of(lambda: gv.as_volume(GRID, spacing=()))
    for time in (5, "", [], 1.0, True):
        for data in (GRID, GRID.numpy()):
            assert "time must be" in line_of(lambda d=data, t=time: gv.as_volume(d, time=t))
    learned = GRID[None].clone().requires_grad_()
    assert "take detach()" in line_of(lambda: gv.as_volume(learned, axes="czyx"), RuntimeError)


@pytest.mark.parametrize("nan", ["x", np.nan, np.zeros(3)], ids=repr)
@pytest.mark.parametrize("labels", [False, True])
def test_the_value_for_gaps_is_always_checked(nan, labels):
    for data in (GRID, torch.zeros(3, 3, 3, dtype=torch.uint8)):
        assert "nan must be" in line_of(lambda d=data: gv.Volume(d, nan=nan, labels=labels))


@pytest.mark.parametrize("origin", [None, np.zeros((1, 3)), [[0, 0, 0]]], ids=repr)
def test_rays_are_tensors(origin):
    rows = torch.zeros(1, 3), torch.zeros(1, 2)
    columns = {"direction": rows[0], "cone": rows[1], "range": rows[1]}
    assert "Rays: origin must be a Tensor" in line_of(lambda: gv.Rays(origin=origin, **columns))


def test_bench_measures_on_processors_and_cuda_only():
    assert "device must be" in line_of(lambda: Settings(device=torch.device("meta")))


@pytest.mark.parametrize("points", [None, np.zeros((2, 3)), [[0.0, 0.0, 0.0]]], ids=repr)
def test_points_are_tensors(backend, points):
    orbit = ops.Orbit(torch.zeros(3), torch.tensor([4.0]), "power", 8, 4)
    for call in (
        lambda: ops.noise(points, "perlin", backend=backend),
        lambda: ops.orbits(points, orbit, backend),
        lambda: ops.orbit_bounds(points, torch.zeros(2), orbit, backend),
    ):
        assert "must be a Tensor" in line_of(call)


@pytest.mark.parametrize("number", [np.int8, np.uint8, np.int32, np.int64])
def test_seeds_and_periods_of_numpy_are_numbers(backend, number):
    points = torch.rand(9, 3, generator=torch.Generator().manual_seed(1))
    expected = ops.noise(points, "F1", seed=3, period=(4, 5, 6), reach=2)
    period = tuple(map(number, (4, 5, 6)))
    options = {"seed": number(3), "period": period, "reach": number(2), "backend": "cpp"}
    assert torch.equal(ops.noise(points, "F1", **options | {"backend": "reference"}), expected)
    assert torch.equal(ops.noise(points, "F1", **options), expected)
    assert "period" in line_of(lambda: ops.noise(points, "F1", period=(1, 2, 3, 4)))


@pytest.mark.backend("cpp")
def test_second_derivatives_are_not_lost():
    """The compiled ops have first ones only; the twins are torch, so they have all."""
    alpha, feature = torch.rand(5, requires_grad=True), torch.rand(5, 2)
    offset = torch.tensor([0, 5])

    def slope(backend: str) -> torch.Tensor:
        total, *_ = ops.composite(alpha, feature, offset, backend=backend)
        return torch.autograd.grad(total.square().sum(), alpha, create_graph=True)[0]

    assert slope("reference").requires_grad
    with pytest.raises(RuntimeError, match="gradients by grad_sum_rc would be lost"):
        slope("cpp")


def test_matrices_of_opengl_are_numbers():
    good = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, -1], [0, 0, -1, 0]])
    learned = good.clone().requires_grad_()
    for wrong in ("x", None, good * 1j, good * torch.nan):
        assert "projection must be" in line_of(lambda w=wrong: gv.opengl.camera(w, good, 4, 4))
        assert "modelview must be" in line_of(lambda w=wrong: gv.opengl.camera(good, w, 4, 4))
    with pytest.raises(RuntimeError, match="gradients by projection would be lost"):
        gv.opengl.camera(learned, torch.eye(4), 4, 4)
    assert "camera must be a Camera" in line_of(lambda: gv.opengl.matrices(None, 1.0))
    assert "near must be a number" in line_of(
        lambda: gv.opengl.matrices(gv.Camera.look_at((0, 0, 3), (0, 0, 0)), "1")
    )
