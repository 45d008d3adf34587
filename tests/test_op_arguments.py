"""Arguments that the ops take but no shader or tree of gvtorch makes: each is harmless, and every
backend does with it what the reference does.
"""

from __future__ import annotations

import math

import pytest
import torch
from helpers import DEVICES
from helpers.rays import camera_rays
from helpers.shaders import SHADERS
from helpers.traces import SHADER, assert_equal
from helpers.trees import copy_to

import gvtorch as gv
from gvtorch.base.constants import ABSENT
from gvtorch.ops import RayArguments, shade_rays
from gvtorch.tracing.tracer import Tracer

_SCALE, _OCTAVES = 14, 18  # indices in parameter_54


def assert_same_as_reference(
    tree, backend: str, shader: gv.Shader, index: int, value: float
) -> None:
    results = []
    for name in (backend, "reference"):
        copy = copy_to(tree, DEVICES[name])
        tracer = Tracer(copy, shader, gv.RenderOptions(step=3.0))
        parameters = shader.parameter_tensor(copy, torch.float32)
        parameters.view(-1)[index] = value
        rays = RayArguments.of(camera_rays(copy, 8, distance=1.3).to(copy.device))
        hits = shade_rays(rays, tracer.arguments, tracer.shading, parameters, backend=name)
        results.append(hits)
    assert results[1][1].max() > 0.3, "the rays must see something"
    for actual, expected in zip(*results, strict=True):
        torch.testing.assert_close(actual.cpu(), expected.cpu(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "octaves"),  # one function reads the number for both
    [
        *(("scattering with shadows", n) for n in (0.5, 2.5, 40.0, 1e9, math.inf, math.nan, -1.0)),
        *(("colour that scatters, with shadows", n) for n in (1e9, math.nan)),
    ],
)
def test_any_number_of_octaves_ends(tree_of_channels, compiled, name, octaves):
    assert_same_as_reference(tree_of_channels, compiled, SHADERS[name], _OCTAVES, octaves)


@pytest.mark.parametrize("channel", [None, "value", "normal"])
def test_a_surface_reads_no_colour_that_is_not_there(tree_of_channels, compiled, channel):
    """A scale asks for four numbers of the second channel, which has 0, 1 or 3."""
    shader = SHADERS["isosurface"]
    if channel is not None:
        shader = gv.Isosurface(0.5, SHADER, color_channel=channel)
    assert_same_as_reference(tree_of_channels, compiled, shader, _SCALE, 1 / 255)


def test_a_surface_may_lie_where_no_node_is(compiled):
    """Half an interval outside of the node that was visited, below a root without a brick."""
    values = torch.rand((16, 16, 16), generator=torch.Generator().manual_seed(1))
    normals = torch.full((16, 16, 16, 3), 0.6)
    volumes = {"value": gv.Volume(values), "normal": gv.Volume(normals)}
    tree = gv.N3Tree.from_volume(volumes, 4, device=DEVICES[compiled])
    bricks = tree.nodes.brick_tn.view(-1)
    removed = torch.rand(bricks.shape, generator=torch.Generator().manual_seed(2)) < 0.6
    removed[tree.root] = True
    bricks[removed.to(bricks.device)] = ABSENT
    rays = camera_rays(tree, 24, distance=1.4)
    for step in (0.7, 2.9):
        shader = gv.Isosurface(0.5, normals="normal", light=gv.PointLight((40.0, 60.0, 50.0)))
        hits, *_ = assert_equal(tree, compiled, rays, shader, lod="finest", step=step)
        is_hit = hits["alpha"][:, 0] > 0
        no_normal = is_hit & (hits["normal"].norm(dim=1) == 0)
        assert 0 < no_normal.sum() < is_hit.sum(), "some must lie where no node is"
