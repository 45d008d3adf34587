"""Bricks cut out of a level: kernel equals twin, and both equal numpy's padding by the edge."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import DEVICES
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gvtorch import ops

DTYPES = (
    *(torch.uint8, torch.int16, torch.uint16, torch.float16, torch.bfloat16),
    *(torch.float32, torch.float64),
)


def level(shape: tuple[int, ...], dtype: torch.dtype, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 200, shape, generator=generator).to(dtype)


def by_padding(values: torch.Tensor, position: torch.Tensor, size: int, border: int) -> np.ndarray:
    """Cuts bricks from a level that is padded far enough on all sides."""
    far = (int(position.abs().max()) + 2) * size + border if len(position) else 0
    padded = np.pad(values.double().numpy(), ((far, far),) * 3 + ((0, 0),), mode="edge")
    side = size + 2 * border
    low = position.numpy() * size - border + far
    cut = [padded[z : z + side, y : y + side, x : x + side] for z, y, x in low]
    return np.stack(cut) if cut else np.zeros((0, side, side, side, values.shape[3]))


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data(), size=st.integers(1, 5), border=st.integers(0, 2))
def test_bricks_are_cut_with_borders_and_clamped_at_the_faces(backend, data, size, border):
    shape = [data.draw(st.integers(1, 12)) for _ in range(3)]
    values = level((*shape, data.draw(st.integers(1, 3))), data.draw(st.sampled_from(DTYPES)))
    rows = st.tuples(*[st.integers(-2, 13 // size + 1)] * 3)
    position = torch.tensor(data.draw(st.lists(rows, max_size=9)), dtype=torch.int64).view(-1, 3)
    device = DEVICES[backend]
    cut = ops.cut_bricks(values.to(device), position.to(device), size, border, backend=backend)
    assert cut.dtype == values.dtype
    assert np.array_equal(cut.cpu().double().numpy(), by_padding(values, position, size, border))


def test_a_level_may_be_any_view(backend):
    values = level((9, 7, 11, 2), torch.float32).to(DEVICES[backend])
    position = torch.tensor([[0, 1, 1], [1, 0, 2]], device=values.device)
    turned = values.transpose(0, 2)
    cut = ops.cut_bricks(turned, position, 4, 1, backend=backend)
    assert torch.equal(cut, ops.cut_bricks(turned.contiguous(), position, 4, 1, backend=backend))


def test_cut_bricks_passes_opcheck(compiled):
    values = level((5, 6, 7, 1), torch.uint8).to(DEVICES[compiled])
    position = torch.tensor([[0, 0, 1]], device=values.device)
    torch.library.opcheck(torch.ops.gvtorch.cut_bricks.default, (values, position, 4, 1))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda v, p: ops.cut_bricks(v[0], p, 4, 1), "values_zyxc must be (z, y, x, c)"),
        (lambda v, p: ops.cut_bricks(v, p.int(), 4, 1), "place_k3 must be (k, 3) int64"),
        (lambda v, p: ops.cut_bricks(v, p, 0, 1), "brick_size must be an int >= 1"),
        (lambda v, p: ops.cut_bricks(v, p, 4, -1), "border must be an int >= 0"),
        (lambda v, p: ops.cut_bricks(v[:0], p, 4, 1), "values_zyxc has no voxels"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError) as caught:
        call(level((4, 4, 4, 1), torch.uint8), torch.zeros((1, 3), dtype=torch.int64))
    assert message in str(caught.value)


def test_bricks_beyond_any_level_are_its_edge(backend):
    values = level((3, 4, 5, 2), torch.uint8).to(DEVICES[backend])
    far = torch.tensor([[2**63 - 1, 0, -(2**63)], [0, 2**62, 1]], device=values.device)
    near = far.clamp(-9, 9)
    bricks = ops.cut_bricks(values, far, 2, 1, backend=backend)
    assert torch.equal(bricks, ops.cut_bricks(values, near, 2, 1, backend=backend))
