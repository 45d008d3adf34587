"""A program may set torch's defaults: `torch.set_default_device` decides where a factory function
makes a tensor if the call names no device. `tests/test_golden_scenes.py` traces scenes with other
defaults."""

from __future__ import annotations

import ast

import numpy as np
import pytest
import torch
from helpers import ROOT

import gvtorch as gv

FACTORIES = set(
    "arange as_tensor asarray empty eye full linspace logspace ones rand randint randn randperm "
    "scalar_tensor tensor tril_indices triu_indices zeros".split()
)


def unnamed(source: str) -> list[str]:
    """Returns the lines that use a factory function without saying on which device."""
    tree = ast.parse(source)
    named = {
        id(call.func)
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and {"device", None} & {k.arg for k in call.keywords}
    }
    return [
        f"{node.lineno}: torch.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and ast.unparse(node.value) == "torch"
        and node.attr in FACTORIES
        and id(node) not in named
    ]


def test_every_factory_call_names_its_device():
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in sorted((ROOT / "gvtorch").rglob("*.py"))
        for line in unnamed(path.read_text(encoding="utf-8"))
    ]
    assert not found, "\n".join(found)
    assert unnamed("x = map(torch.arange, sizes)\ny = torch.zeros(3)") == [
        "1: torch.arange",
        "2: torch.zeros",
    ]


@pytest.fixture
def other_device():
    torch.set_default_device("meta")
    yield
    torch.set_default_device(None)


def test_fields_meshes_and_cameras_ignore_the_default_device(other_device):
    box = gv.sdf.rotated(gv.sdf.Box((0.5, 0.5, 0.5)), (1, 2, 3), 40)
    producer = gv.FieldProducer(gv.Solid(gv.sdf.Sphere(0.6) - box), 32)
    mesh = gv.MeshProducer(gv.Mesh(vertices=np.eye(3), faces=np.array([[0, 1, 2]])), resolution=16)
    tensors = []
    for source, shader in (
        (producer, gv.StoredColor("rgba", lit=True)),
        (mesh, gv.TransferFunction.from_points([(0, 0), (1, 1)])),
    ):
        with gv.Engine(source, load_budget=512) as engine:
            camera = gv.CameraPath.orbit(engine.box).camera(0.5, 24, 16)
            picture = engine.render(camera, shader)
        tensors += [engine.box, camera.viewmats, picture.color, picture.alpha, picture.depth]
        assert float(picture.alpha.max()) > 0
    assert {tensor.device.type for tensor in tensors} == {"cpu"}
