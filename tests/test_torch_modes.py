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
