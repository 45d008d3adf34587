"""Gradients that would be lost raise an error, by one rule, in eager, scripted, compiled and
exported programs; nothing raises where no gradients are recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers import DEVICES
from helpers.compiled import HEADER, users_shader
from helpers.pictures import GRAY, camera

import gvtorch as gv

SHADERS = {"plain": GRAY, "lit": gv.Lit(GRAY)}
COLUMNS = ("origin_r3", "direction_r3", "cone_r2", "range_r2")


def lost(by: str) -> str:
    return f"gradients by {by} would be lost: only gv.ModuleShader gives gradients, by its param"


@pytest.fixture
def tree(blobs):
    return gv.N3Tree.from_volume(blobs, 8)


def rays_of(tree: gv.N3Tree) -> gv.Rays:
    return camera(4, distance=1.3).placed(tree.box).rays()


def columns(rays: gv.Rays) -> list[torch.Tensor]:
    return [rays.origin, rays.direction, rays.cone, rays.range]


def scripted(tracer: gv.TreeTracer) -> Callable:
    return torch.jit.script(tracer)


def compiled(tracer: gv.TreeTracer) -> Callable:
    torch._dynamo.reset()
    return torch.compile(tracer, fullgraph=True, backend="aot_eager")


MODES = {"eager": lambda tracer: tracer, "script": scripted, "compile": compiled}


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", SHADERS)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("leaf", [*COLUMNS, "bricks_bzyxc", "table_lm4", "parameter_54"])
def test_one_rule_in_every_mode(tree, name, mode, leaf):
    """For rays, voxels, tables and the shader's numbers."""
    if leaf == "parameter_54" and name == "plain":
        pytest.skip("the plain shader has no numbers")
    tracer, inputs = gv.TreeTracer(tree, SHADERS[name]), columns(rays_of(tree))
    if leaf in COLUMNS:
        index = COLUMNS.index(leaf)
        inputs[index] = inputs[index].clone().requires_grad_()
    else:
        setattr(tracer, leaf, getattr(tracer, leaf).clone().requires_grad_())
    run = MODES[mode](tracer)
    with pytest.raises(RuntimeError) as caught:
        run(*inputs)
    assert lost(leaf) in str(caught.value)
    with torch.no_grad():
        assert not run(*inputs)[0].requires_grad


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", SHADERS)
def test_an_exported_program_raises_when_it_runs_and_when_it_is_made(tree, name):
    tracer, inputs = gv.TreeTracer(tree, SHADERS[name]), columns(rays_of(tree))
    program = torch.export.export(tracer, tuple(inputs)).module()
    program(*inputs)
    inputs[0] = inputs[0].clone().requires_grad_()
    for run in (program, lambda *rays: torch.export.export(tracer, rays)):
        with pytest.raises(RuntimeError) as caught:
            run(*inputs)
        assert lost("origin_r3") in str(caught.value)


@pytest.mark.parametrize("name", SHADERS)
def test_rays_and_voxels_of_a_fused_shader_raise(blobs, backend, name):
    tree = gv.N3Tree.from_volume(blobs, 8, device=DEVICES[backend])
    rays, options = rays_of(tree).to(tree.device), {"backend": backend}
    bent = replace(rays, direction=rays.direction.clone().requires_grad_())
    for trace in (gv.trace, gv.render):
        with pytest.raises(RuntimeError, match=lost("(origin|direction)_r3")):  # rays may be moved
            trace(tree, bent, SHADERS[name], **options)
        with torch.no_grad():
            trace(tree, bent, SHADERS[name], **options)
    tree.bricks["value"].requires_grad_()
    for trace in (gv.trace, gv.render):
        with pytest.raises(RuntimeError, match=lost("bricks_bzyxc")):
            trace(tree, rays, SHADERS[name], **options)
        with torch.no_grad():
            assert not trace(tree, rays, SHADERS[name], **options).color.requires_grad


def test_a_module_shader_has_gradients_by_voxels_and_none_by_rays(tree):
    rays, shader = rays_of(tree), gv.ModuleShader(lambda v, *_: (v.expand(-1, 3), v.clamp(0, 1)))
    bent = replace(rays, origin=rays.origin.clone().requires_grad_())
    with pytest.raises(RuntimeError, match=lost("origin_r3")):
        gv.trace(tree, bent, shader)
    pool = tree.bricks["value"].requires_grad_()
    gv.trace(tree, rays, shader).color.sum().backward()
    assert pool.grad is not None and pool.grad.abs().max() > 0


def test_numbers_that_leave_torch_raise(tree, blobs):
    view, number = camera(4, distance=1.3), torch.tensor(0.5, requires_grad=True)
    three = torch.tensor([0.3, 0.2, 0.9], requires_grad=True)
    pose = torch.eye(4, dtype=torch.float64, requires_grad=True)
    for make, by in (
        (lambda: gv.render(tree, view, gv.Isosurface(number)), "value"),
        (lambda: gv.Lit(GRAY, light=gv.PointLight(three)), "position"),
        (lambda: gv.TransferFunction([(0, 0), (1, number)]), "opacity"),
        (lambda: gv.Camera(pose, torch.eye(3), 8, 8), "viewmats"),
        (lambda: gv.Camera.look_at(three, (0, 0, 0)), "eye"),
        (lambda: gv.Camera.look_at((1, 1, 1), (0, 0, 0), fov=number * 60), "fov"),
        (lambda: gv.render(tree, view, GRAY, step=number), "step"),
        (lambda: gv.Clip(planes=three.new_ones(1, 4) * number), "planes[0]"),
    ):
        with pytest.raises(RuntimeError) as caught:
            make()
        assert lost(by) in str(caught.value) and "\n" not in str(caught.value)
        with torch.no_grad():
            make()


def test_a_volume_tells_how_voxels_are_learned(blobs):
    data = blobs.data.clone().requires_grad_()
    with pytest.raises(RuntimeError, match=r"take detach\(\); to learn voxels, .* gv.ModuleShader"):
        gv.Volume(data)
    assert torch.equal(gv.Volume(data.detach()).data, blobs.data)
    with torch.no_grad():
        assert not gv.Volume(data).data.requires_grad


@pytest.mark.backend("cpp")
def test_a_compiled_shader_raises_too(tree, monkeypatch, quick):
    monkeypatch.setenv("CXX", quick)
    shader = users_shader(HEADER, "mine::Plain", transfer=GRAY)
    rays = rays_of(tree)
    with pytest.raises(RuntimeError, match=lost("cone_r2")):
        gv.trace(tree, replace(rays, cone=rays.cone.clone().requires_grad_()), shader)


def test_ops_that_make_floats_refuse_what_they_would_lose(backend):
    device = DEVICES[backend]
    camera_nc = torch.rand(1, 26, dtype=torch.float64, device=device, requires_grad=True)
    with pytest.raises(RuntimeError, match="pinhole_rays: gradients by camera_nc would be lost"):
        gv.ops.pinhole_rays(camera_nc, 0, 2, 2, 2, backend=backend)
    values = torch.rand(4, 4, 4, 1, device=device, requires_grad=True)
    position = torch.zeros(1, 3, dtype=torch.int64, device=device)
    with pytest.raises(RuntimeError, match="cut_bricks: gradients by values_zyxc would be lost"):
        gv.ops.cut_bricks(values, position, 2, 1, backend=backend)
    with torch.no_grad():
        assert not gv.ops.cut_bricks(values, position, 2, 1, backend=backend).requires_grad


def test_the_voxelizer_refuses_gradients_of_triangles():
    corner = torch.rand(1, 3, 3, dtype=torch.float64, requires_grad=True)
    none = torch.zeros(1, 3, dtype=torch.float64)
    with pytest.raises(RuntimeError, match="voxelize: gradients by corner_f33 would be lost"):
        gv.ops.voxelize(corner, torch.ones(1).bool(), torch.zeros(1, 6), none, none, 4, 0.0)
