"""What torch's modes change: inference mode, autocast, deterministic algorithms, forward-mode
gradients, function transforms. Nothing that is kept depends on them, and nothing is lost silently.
"""

from __future__ import annotations

import math

import pytest
import torch
from helpers.pictures import GRAY, camera
from torch.autograd import forward_ad

import gvtorch as gv
from gvtorch.shaders.shader import Sampling

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


class Smooth(torch.nn.Module):
    """A module with smooth slopes: for differences."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor([[0.3, -0.2, 0.5, -1.0]]).double())

    def forward(self, values, positions, directions, lengths):
        out = (values @ self.weight.to(values)).sigmoid()
        return out[:, :3], 1 - torch.exp(-0.3 * out[:, 3:] * lengths)


def fine_rays(tree: gv.N3Tree) -> gv.Rays:
    return camera(3, distance=1.3).placed(tree.box).rays()


def test_transforms_of_torch_func_give_the_gradients_of_autograd(tree):
    """By parameters and by voxels; and what is cached inside serves after them."""
    view, shader = camera(3, distance=1.3), gv.ModuleShader(Smooth())

    class Traced(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.shader = shader

        def forward(self):
            return gv.render(tree, view, self.shader, dtype=torch.float64, stop_alpha=1.0).color

    def loss(parameters, voxels):
        tree.bricks["value"] = voxels
        return torch.func.functional_call(Traced(), parameters, ()).square().sum()

    parameters = dict(Traced().named_parameters())
    values = {name: value.detach() for name, value in parameters.items()}
    (second,) = torch.func.hessian(loss)(values, tree.bricks["value"]).values()
    assert all(matrix.isfinite().all() and matrix.abs().max() > 0 for matrix in second.values())
    voxels = tree.bricks["value"].clone().requires_grad_()
    expected = torch.autograd.grad(loss(parameters, voxels), [*parameters.values(), voxels])
    by_parameters, by_voxels = torch.func.grad(loss, argnums=(0, 1))(values, voxels.detach())
    for got, right in zip([*by_parameters.values(), by_voxels], expected, strict=True):
        torch.testing.assert_close(got, right, rtol=1e-6, atol=1e-9)
    moves = {name: torch.ones_like(value) for name, value in values.items()}
    turned = torch.cos(torch.arange(voxels.numel()).double()).view(voxels.shape).float()
    _, slope = torch.func.jvp(loss, (values, voxels.detach()), (moves, turned))
    total = sum((g * m).sum() for g, m in zip(expected[:-1], moves.values(), strict=True))
    torch.testing.assert_close(slope, total + (expected[-1].double() * turned).sum())


def test_an_engine_refuses_transforms_of_torch_func(blobs):
    view = camera(3, distance=1.3)
    with gv.Engine(gv.VolumeProducer(blobs)) as engine:
        before = engine.render(view, GRAY).color
        with pytest.raises(RuntimeError, match="can't transform writes into pools"):
            torch.func.grad(lambda gain: (gain * engine.render(view, GRAY).color).sum())(before)
        assert torch.equal(engine.render(view, GRAY).color, before)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("shader", [GRAY, gv.Lit(GRAY)], ids=["plain", "lit"])
def test_gradients_of_forward_mode_raise_where_they_would_be_lost(tree, shader):
    """torch drops them silently where an op has none."""
    rays = fine_rays(tree)
    tracer, columns = gv.TreeTracer(tree, shader), tracer_columns(rays)
    moved = torch.ones_like(rays.origin)
    with pytest.raises(RuntimeError, match="gradients by origin_r3 would be lost"):
        torch.func.jvp(lambda o: tracer(o, *columns[1:])[0], (columns[0],), (moved,))
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(columns[0], moved)
        for trace in (tracer, torch.jit.script(tracer)):
            with pytest.raises(RuntimeError, match="gradients by origin_r3 would be lost"):
                trace(dual, *columns[1:])
        assert tracer(dual.detach(), *columns[1:])[0].shape == (9, 3)
        voxels = tree.bricks["value"]
        tree.bricks["value"] = forward_ad.make_dual(voxels, torch.ones_like(voxels))
        for backend in ("cpp", "reference"):
            with pytest.raises(RuntimeError, match="gradients by bricks_bzyxc would be lost"):
                gv.trace(tree, rays, shader, backend=backend)
        with pytest.raises(RuntimeError, match="backend must be auto or reference"):
            gv.trace(tree, rays, learned(), backend="cpp")


def tracer_columns(rays: gv.Rays) -> list[torch.Tensor]:
    return [rays.origin, rays.direction, rays.cone, rays.range]


@pytest.fixture
def deterministic():
    count = torch.get_num_threads()
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(count)


@pytest.mark.backend("cpp")
def test_gradients_by_voxels_are_the_same_whether_torch_asks_for_that_or_not(tree, deterministic):
    shader, view = learned(), camera(32, distance=1.3)
    pool, grads = tree.bricks["value"].requires_grad_(), []
    for asks, threads in ((False, 1), (False, 3), (True, 1), (True, 3)):
        torch.use_deterministic_algorithms(asks)
        torch.set_num_threads(threads)
        pool.grad = None
        gv.render(tree, view, shader).color.sum().backward()
        grads.append(pool.grad)
    assert grads[0].any() and all(torch.equal(grad, grads[0]) for grad in grads)


@pytest.mark.filterwarnings("ignore")  # what dynamo can't follow, it leaves to Python
def test_a_compiled_function_may_make_the_table_of_a_shader():
    """dynamo follows NumPy in torch, which counts no bools unless told the dtype."""
    torch._dynamo.reset()
    sampling = Sampling(smallest_spacing=1.0, step=0.5)
    fresh = gv.TransferFunction(GRAY.opacity, GRAY.color)

    def rows() -> torch.Tensor:
        return fresh.table(sampling).opaque_m

    compiled = torch.compile(rows, backend="eager")
    expected = GRAY.table(sampling).opaque_m
    assert torch.equal(compiled(), expected)


@pytest.mark.backend("cpp")
def test_a_net_with_a_tracer_is_trained_by_distributed_data_parallel(tree, tmp_path):
    """Without broadcasting its buffers, as its docstring says: the requests are 16-bit integers."""
    view, tracer = camera(4, distance=1.3), gv.TreeTracer(tree, GRAY)
    assert "broadcast_buffers=False" in gv.TreeTracer.__doc__

    class Net(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.tracer, self.shader, self.tint = tracer, learned(), torch.nn.Linear(3, 3)

        def forward(self):
            color = gv.render(tree, view, self.shader).color
            return color + self.tint(self.tracer(*self.tracer.rays(view))[0])

    store = f"file://{tmp_path}/store"
    torch.distributed.init_process_group("gloo", init_method=store, rank=0, world_size=1)
    try:
        net = torch.nn.parallel.DistributedDataParallel(Net(), broadcast_buffers=False)
        for _ in range(2):
            net().sum().backward()
        assert all(parameter.grad.abs().sum() > 0 for parameter in net.parameters())
        with pytest.raises(RuntimeError, match="Invalid scalar type"):
            torch.nn.parallel.DistributedDataParallel(Net())
    finally:
        torch.distributed.destroy_process_group()
