"""What torch's modes change: inference mode, autocast, deterministic algorithms, forward-mode
gradients, function transforms. Nothing that is kept depends on them, and nothing is lost silently.
"""

from __future__ import annotations

import math

import pytest
import torch
from helpers.pictures import GRAY, camera

import gvtorch as gv

BOX = ((-1, -1, -1), (1, 1, 1))


@pytest.fixture
def tree(blobs):
    return gv.N3Tree.from_volume(blobs, 8)


def learned() -> gv.ModuleShader:
    return gv.ModuleShader(gv.TransferModule(GRAY, 1.0))


@pytest.mark.parametrize("use", ["render", "refresh"])
def test_a_tree_is_trained_after_its_first_picture_was_made_in_inference_mode(tree, use):
    """As a training loop does that begins with a validation picture."""
    shader, view = learned(), camera(6, distance=1.3)
    with torch.inference_mode():
        gv.render(tree, view, shader)
        if use == "refresh":
            tree.bricks["value"].mul_(0.5)
            tree.refresh()
    pool = tree.bricks["value"].requires_grad_()
    gv.render(tree, view, shader).color.sum().backward()
    assert pool.grad.abs().sum() > 0 and shader.module.rows.grad.abs().sum() > 0


class Waves(gv.Field):
    def __init__(self) -> None:
        super().__init__()
        self.number("time", 0.0)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return (points[..., 0] + self.time.to(points)).sigmoid()


def test_a_clock_made_in_inference_mode_is_set_outside_of_it():
    with torch.inference_mode():
        producer = gv.FieldProducer(Waves(), 16, box=BOX)
    producer.time = 0.5
    value = producer.at(torch.zeros(1, 3))["value"]
    assert float(value) == pytest.approx(1 / (1 + math.exp(-0.5)))


class Network(torch.nn.Module):
    """A field as users learn it."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        self.weight = torch.nn.Parameter(torch.randn(1, 3, generator=generator))

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.linear(points.float(), self.weight).sigmoid()


def streamed(producer: gv.Producer) -> torch.Tensor:
    with gv.Engine(producer) as engine:
        return engine.render(camera(8, distance=1.3), GRAY).color


def turned_shape() -> torch.Tensor:
    turned = gv.sdf.rotated(gv.sdf.Box((0.5, 0.3, 0.2)), (0, 0, 1), 0.3)
    return streamed(gv.FieldProducer(gv.sdf.SmoothUnion(turned, gv.sdf.Sphere(0.3), 0.1), 16))


def half_voxels(refresh: bool) -> torch.Tensor:
    data = torch.rand(9, 9, 9, 1, generator=torch.Generator().manual_seed(2)).half()
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4)
    if refresh:
        tree.bricks["value"].mul_(0.5)
        tree.refresh()
    return gv.render(tree, camera(8, distance=1.3), GRAY).color


KEPT = {
    "turned shape": turned_shape,
    "network": lambda: streamed(gv.FieldProducer(Network(), 16, box=BOX)),
    "fractal": lambda: streamed(gv.FieldProducer(gv.Mandelbulb(4), 16)),
    "half voxels": lambda: half_voxels(refresh=False),
    "refreshed": lambda: half_voxels(refresh=True),
}


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("name", KEPT)
def test_what_is_kept_has_the_same_bits_under_autocast(name, dtype):
    """Bricks outlast the frame that made them, so they do not depend on how that was called."""
    expected = KEPT[name]()
    with torch.autocast("cpu", dtype):
        assert torch.equal(KEPT[name](), expected)
        assert torch.is_autocast_enabled("cpu")
    assert expected.max() > 0


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_a_module_shader_trains_under_autocast(tree, dtype):
    class Learned(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer, self.seen = torch.nn.Linear(1, 4), set()

        def forward(self, values, positions, directions, lengths):
            out = self.layer(values)
            self.seen.add((positions.dtype, out.dtype))
            return out[:, :3].sigmoid(), out[:, 3:].sigmoid() * 0.1

    module, view = Learned(), camera(6, distance=1.3)
    expected = gv.render(tree, view, gv.ModuleShader(module)).color
    module.seen.clear()
    with torch.autocast("cpu", dtype):
        color = gv.render(tree, view, gv.ModuleShader(module)).color
    assert module.seen == {(torch.float32, dtype)}  # the module runs in it, and nothing else
    assert color.dtype == torch.float32
    assert torch.allclose(color, expected, atol=0.02) and not torch.equal(color, expected)
    color.sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in module.parameters())
