"""Rays that the CPU traces in packets: each bit is the reference's, for all instruction sets."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from test_trace_rays import camera_rays, forget, run
from torch import Tensor

import gvtorch as gv

TRANSFER = gv.TransferFunction.from_points(
    [(0.2, 0), (0.5, 0.05), (0.9, 0.6)], [(0.2, 1, 0.3, 0.1), (0.9, 0.2, 0.6, 1)]
)
SUN = gv.DirectionalLight((1.0, -1.0, 0.0), (1.0, 0.9, 0.8))
LAMP = gv.PointLight((10.0, 50.0, 30.0))
SHADERS = {
    "plain": TRANSFER,
    "lit": gv.Lit(TRANSFER),
    "lit by the sun": gv.Lit(TRANSFER, light=SUN, shininess=7.3),
    "lit by a lamp": gv.Lit(TRANSFER, light=LAMP),
    "lit by stored normals": gv.Lit(TRANSFER, normals="normal", light=SUN),
    "lit by stored normals and a lamp": gv.Lit(TRANSFER, normals="normal", light=LAMP),
    "pre-integrated": gv.PreIntegrated(TRANSFER),
    "stored colour": gv.StoredColor("rgba"),
    "stored colour, lit": gv.StoredColor("rgba", premultiplied=True, lit=True, light=LAMP),
    "stored colour, stored normals": gv.StoredColor("rgba", lit=True, normals="normal"),
    "isosurface": gv.Isosurface(0.45, light=LAMP),
    "distance field": gv.DistanceField(offset=0.4),
    "maximum": gv.Projection("maximum", TRANSFER),
    "minimum": gv.Projection("minimum", TRANSFER),
    "mean": gv.Projection("mean", TRANSFER),
    "features": gv.Features(TRANSFER, "rgba"),
}
INSTRUCTIONS = ["baseline", "avx2", "avx512"]

_SHADED = """
import sys, torch
sys.path.insert(0, {tests!r})
from test_packets import SHADERS, shaded
torch.save({{name: shaded(shader, "cpp") for name, shader in SHADERS.items()}}, {file!r})
"""


@cache
def scene(branching: int = 2) -> gv.N3Tree:
    """Rough and smooth matter, between a region of zeros and one of another single value."""
    generator = torch.Generator().manual_seed(4)
    coarse = torch.rand((1, 5, 12, 12, 12), generator=generator)
    numbers = torch.nn.functional.interpolate(coarse, size=(37, 37, 37), mode="trilinear")[0]
    value = numbers[4] + 0.1 * torch.rand((37, 37, 37), generator=generator)
    value[:14, :, :], value[:, 24:, :20] = 0.0, 0.35
    rgba = numbers[:4].movedim(0, -1).clone()
    rgba[..., 3] *= 0.3 * (value > 0.2)
    normal = torch.nn.functional.normalize(numbers[:3].movedim(0, -1) - 0.5, dim=-1)
    return gv.N3Tree.from_volume(
        {
            "value": gv.Volume(value),
            "rgba": gv.Volume((rgba * 255).round().to(torch.uint8)),
            "normal": gv.Volume((normal * 127).round().to(torch.int8)),
        },
        4,
        branching=branching,
        threshold=0.0,
    )


def cut(rays: gv.Rays) -> gv.Rays:
    """Rays that begin within the box, each elsewhere, with a part of their light, and end there."""
    first = torch.linspace(30.0, 45.0, len(rays.origin), dtype=torch.float64)
    limits = torch.stack((first, first + 17.3), 1)
    return replace(rays, range=limits, transmittance=torch.linspace(0.05, 1.0, len(first)).double())


def shaded(shader: gv.Shader, backend: str, branching: int = 2) -> list[Tensor]:
    """All that a shader's traces write."""
    tree, found = scene(branching), []
    holes = forget(tree, 0.3, 5)
    for which, size, options in (
        (tree, 21, {}),
        (tree, 5, {}),  # cones as wide as several voxels: levels blend
        (tree, 11, {"lod": "finest", "step": 1.3}),
        (tree, 11, {"stop_alpha": 0.6, "depth_alpha": 0.5}),
        (holes, 14, {}),
    ):
        rays = camera_rays(which, size, distance=1.5)
        for some in (rays, cut(rays)):
            hits, marks = run(which, backend, some, shader, **options)
            found += [*hits.values(), *marks.values()]
    return found


@cache
def expected(name: str) -> list[Tensor]:
    return shaded(SHADERS[name], "reference")


@pytest.fixture(scope="module")
def of_instructions(tmp_path_factory) -> dict[str, dict[str, list[Tensor]]]:
    """What each instruction set gives, by its name and the shader's."""
    found = {}
    for instructions in INSTRUCTIONS:
        file = str(tmp_path_factory.mktemp("packets") / "hits.pt")
        program = _SHADED.format(tests=os.path.dirname(__file__), file=file)
        environment = {**os.environ, "GVTORCH_CPU": instructions}
        subprocess.run([sys.executable, "-c", program], env=environment, check=True)
        found[instructions] = torch.load(file, weights_only=True)
    return found


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", SHADERS)
@pytest.mark.parametrize("instructions", INSTRUCTIONS)
def test_every_bit_is_the_reference_s(of_instructions, instructions, name):
    found = of_instructions[instructions][name]
    for one, other in zip(found, expected(name), strict=True):
        assert torch.equal(one.nan_to_num(7), other.nan_to_num(7))
    assert sum(len(one.unique()) for one in found) > 1000, "the test must see something"


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
@pytest.mark.parametrize("name", ["plain", "lit", "maximum", "isosurface"])
def test_bricks_beyond_2_gib_are_read_as_others_are(name, dtype):
    factor = 1 if dtype.is_floating_point else 2
    values = torch.rand((24, 24, 24), generator=torch.Generator().manual_seed(2))
    tree = gv.N3Tree.from_volume(gv.Volume((values * factor).to(dtype)), 4)
    rays = camera_rays(tree, 9, distance=1.4)
    near = gv.trace(tree, rays, SHADERS[name])
    bricks, voxels = tree.bricks, tree.bricks.bricks["value"]
    used = bricks.capacity
    first = 2**31 // voxels[0].nbytes + 1
    # Pages that nobody touches take no memory.
    far = np.zeros((first + used, *voxels.shape[1:]), voxels.numpy().dtype)
    far[first:] = voxels.numpy()
    bricks.bricks["value"] = torch.from_numpy(far)
    bricks.stamp_b = torch.full((first + used,), -1, dtype=torch.int32)
    tree.nodes.brick_tn[tree.nodes.brick_tn >= 0] += first
    hits = gv.trace(tree, rays, SHADERS[name])
    assert near.alpha.max() > 0.3 and (bricks.stamp_b[first:] == tree.frame).any()
    for field, there in vars(near).items():
        assert there is None or torch.equal(getattr(hits, field), there), field
