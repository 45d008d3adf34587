"""The op contract: opcheck, TorchScript, compile, export, and a C++ process without Python."""

from __future__ import annotations

import io
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from helpers import DEVICES, ROOT
from helpers.rays import camera_rays, world_rays
from helpers.traces import SHADER, arguments
from helpers.trees import copy_to

import gvtorch as gv
from gvtorch import cpp_ext
from gvtorch.ops import trace_rays

pytestmark = pytest.mark.filterwarnings("ignore")  # torch deprecates its own TorchScript


@pytest.fixture
def tracer(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    return gv.TreeTracer(tree, SHADER)


@pytest.fixture
def rays(tracer, blobs):
    return world_rays(gv.N3Tree.from_volume(blobs).box, 33, tracer.child_tn.device)


def assert_same(actual, expected) -> None:
    assert len(actual) == len(expected) == 4
    for a, b in zip(actual, expected, strict=True):
        assert torch.equal(a.cpu(), b.cpu())
    assert expected[1].max() > 0.3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opcheck(blobs, compiled, dtype):
    tree = copy_to(gv.N3Tree.from_volume(blobs, 4), DEVICES[compiled])
    rays, trace_args = arguments(tree, 5, dtype=dtype)
    torch.library.opcheck(torch.ops.gvtorch.trace_rays.default, (*rays, *trace_args))


def test_fake_gives_shapes_without_data(blobs, compiled):
    from torch._subclasses.fake_tensor import FakeTensorMode

    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    rays, trace_args = arguments(tree, 5)
    with FakeTensorMode() as mode:
        values = (*rays, *trace_args)
        fake = [mode.from_tensor(v) if isinstance(v, torch.Tensor) else v for v in values]
        color, alpha, depth, samples, missed = torch.ops.gvtorch.trace_rays(*fake)
    assert color.shape == (5, 3) and alpha.shape == depth.shape == (5, 1)
    assert samples.shape == missed.shape == (5,)
    assert samples.dtype == torch.int32 and missed.dtype == torch.bool


def test_torchscript_saves_and_loads(tracer, rays):
    expected = tracer(*rays)
    scripted = torch.jit.script(tracer)
    assert_same(scripted(*rays), expected)
    file = io.BytesIO()
    torch.jit.save(scripted, file)
    file.seek(0)
    loaded = torch.jit.load(file)
    assert_same(loaded(*rays), expected)


def test_compiles_without_graph_breaks(tracer, rays):
    compiled_module = torch.compile(tracer, fullgraph=True, backend="aot_eager", dynamic=True)
    assert_same(compiled_module(*rays), tracer(*rays))
    shorter = tuple(t[:20] for t in rays)
    assert_same(compiled_module(*shorter), tracer(*shorter))


@pytest.mark.backend("cpp")
def test_compiles_with_the_default_backend(blobs):
    """Inductor compiles the code around the op, and calls the op itself."""
    tree = gv.N3Tree.from_volume(blobs, 4)
    tracer = gv.TreeTracer(tree, SHADER)
    rays = world_rays(tree.box, 33, "cpu")
    assert_same(torch.compile(tracer, fullgraph=True)(*rays), tracer(*rays))


def test_the_checked_function_compiles(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    rays, trace_args = arguments(tree, 7)

    def shoot(origin: torch.Tensor) -> torch.Tensor:
        moved = rays._replace(origin_r3=origin * 1.0)
        color, alpha, *_ = trace_rays(moved, trace_args, backend=compiled)
        return color + alpha

    fast = torch.compile(shoot, fullgraph=True, backend="aot_eager")
    assert torch.equal(fast(rays.origin_r3), shoot(rays.origin_r3))


def test_exports_with_a_dynamic_ray_count(tracer, rays):
    count = torch.export.Dim("rays", min=2, max=1 << 24)
    program = torch.export.export(tracer, rays, dynamic_shapes=[{0: count}] * 4)
    assert_same(program.module()(*rays), tracer(*rays))
    shorter = tuple(t[11:22].contiguous() for t in rays)
    assert_same(program.module()(*shorter), tracer(*shorter))
    file = io.BytesIO()
    torch.export.save(program, file)
    file.seek(0)
    assert_same(torch.export.load(file).module()(*rays), tracer(*rays))


def test_module_equals_render(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    rays = camera_rays(tree, 16, distance=1.2)
    picture = gv.render(
        *(tree, gv.Camera.orbit(width=16, height=16, distance=1.2), SHADER), lod="finest"
    )
    names = ("origin", "direction", "cone", "range")
    tensors = {n: getattr(rays, n).float().to(tree.device) for n in names}
    tensors["cone"] = torch.zeros_like(tensors["cone"])
    color, alpha, _, _ = gv.TreeTracer(tree, SHADER)(**tensors)
    # The module's rays are rounded to float32 in the world, the renderer's only in the tree.
    assert (color.reshape(16, 16, 3) - picture.color).abs().max() < 5e-3
    assert (alpha.reshape(16, 16, 1) - picture.alpha).abs().mean() < 1e-4


@pytest.mark.parametrize("scale", [None, 3.0])
def test_module_traces_a_camera_s_rays_as_the_renderer_does(blobs, compiled, scale):
    """At the level of detail that their cones require."""
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    rays = camera_rays(tree, 16, distance=3.0).to(tree.device)
    options = {} if scale is None else {"cone_scale": scale}
    hits = gv.trace(tree, rays, SHADER, backend=compiled, **options)
    columns = (rays.origin, rays.direction, rays.cone, rays.range)
    fields = gv.TreeTracer(tree, SHADER, **options)(*columns)
    assert_same(fields, (hits.color, hits.alpha, hits.depth, hits.samples))


def test_memory_stays_safe_without_the_python_checks(blobs, compiled):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    rays, trace_args = arguments(tree, 5)
    good = {**rays._asdict(), **trace_args._asdict()}
    for name, value in (
        ("direction_r3", rays.direction_r3[:3].contiguous()),
        ("table_lm4", trace_args.table_lm4[:, :1].contiguous()),
        ("stamp_t", trace_args.stamp_t[:1]),
        ("constant_tnc", trace_args.constant_tnc[:1]),
        ("root", 10**6),
        ("component", 3),
        ("border", 9),
        ("branching", 40),
    ):
        with pytest.raises(RuntimeError, match="gvtorch"):
            torch.ops.gvtorch.trace_rays(*{**good, name: value}.values())


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_a_cpp_process_without_python_loads_the_archive(blobs, tmp_path):
    """Compiles tests/cpp/render.cpp against libtorch only, and compares what it prints."""
    compiler = shutil.which("g++") or pytest.fail("g++ is needed, as for the extension itself")
    tree = gv.N3Tree.from_volume(blobs, 4)
    tracer = gv.TreeTracer(tree, SHADER)
    rays = world_rays(tree.box, 33, "cpu")
    expected = tracer(*rays)
    torch.jit.save(torch.jit.script(tracer), tmp_path / "tracer.pt")
    torch.jit.save(torch.jit.script(_Rays(rays)), tmp_path / "rays.pt")
    libtorch = Path(torch.__file__).parent
    program = tmp_path / "render"
    subprocess.run(
        [
            *(
                compiler,
                "-std=c++20",
                "-O0",
                str(ROOT / "tests" / "cpp" / "render.cpp"),
                "-o",
                str(program),
            ),
            *(
                "-isystem",
                str(libtorch / "include"),
                "-isystem",
                str(libtorch / "include/torch/csrc/api/include"),
            ),
            *(f"-L{libtorch / 'lib'}", f"-Wl,-rpath,{libtorch / 'lib'}"),
            *("-Wl,--no-as-needed", "-ltorch", "-ltorch_cpu", "-lc10", "-ldl"),
        ],
        check=True,
    )
    library = cpp_ext.FOLDER / "libgvtorch_cpu.so"
    run = subprocess.run(
        [program, library, tmp_path / "tracer.pt", tmp_path / "rays.pt"],
        check=True,
        capture_output=True,
        text=True,
    )
    color, alpha, samples = (float(number) for number in run.stdout.split())
    assert samples == int(expected[3].sum()) > 0
    assert abs(color - float(expected[0].double().sum())) < 1e-6
    assert abs(alpha - float(expected[1].double().sum())) < 1e-6


class _Rays(torch.nn.Module):
    """Carries tensors to the C++ process."""

    def __init__(self, rays: tuple[torch.Tensor, ...]) -> None:
        super().__init__()
        for name, tensor in zip(("origin", "direction", "cone", "range"), rays, strict=True):
            self.register_buffer(name, tensor)

    def forward(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        return self.origin, self.direction, self.cone, self.range
