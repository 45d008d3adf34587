"""Everything that tracing writes on a backend, and comparison of two backends."""

from __future__ import annotations

import torch

import gvtorch as gv
from gvtorch.ops import RayArguments, TraceArguments
from gvtorch.tracing.tracer import Tracer
from helpers import DEVICES
from helpers.rays import camera_rays
from helpers.trees import copy_to

SHADER = gv.TransferFunction.from_points(
    opacity=[(0, 0), (0.2, 0), (0.6, 0.4), (1, 1)],
    color=[(0, 1, 0, 0), (0.5, 0.2, 0.8, 0.1), (1, 1, 1, 1)],
)


def trace(tree, backend, rays, shader=SHADER, **options):
    """Traces rays; returns hits and marks (everything `trace_rays` writes), moved to the CPU."""
    device = DEVICES[backend]
    copy = copy_to(tree, device)
    moved = rays.to(device)
    hits = gv.trace(copy, moved, shader, backend=backend, **options)
    result = {n: t.cpu() for n, t in vars(hits).items() if t is not None}
    marks = {
        "request": copy.nodes.request_tn,
        "tile": copy.nodes.stamp_t,
        "brick": copy.bricks.stamp_b,
    }
    return result, {n: t.cpu() for n, t in marks.items()}


def assert_equal(tree, backend, rays, shader=SHADER, **options):
    """Asserts that a backend's hits and marks equal the twin's: integers exactly, floats except for
    rounding. Returns the twin's hits and marks, and the backend's hits.
    """
    expected, expected_marks = trace(tree, "reference", rays, shader, **options)
    actual, marks = trace(tree, backend, rays, shader, **options)
    assert torch.equal(actual["samples"], expected["samples"])
    assert torch.equal(actual["missed"], expected["missed"])
    for name, mark in marks.items():
        assert torch.equal(mark, expected_marks[name]), name
    tolerance = 1e-5 if expected["color"].dtype == torch.float32 else 1e-12
    for name in {"color", "alpha", "depth", "normal", "features"} & {*expected}:
        torch.testing.assert_close(actual[name], expected[name], rtol=tolerance, atol=tolerance)
    assert ("label" in actual) == shader.reads_labels
    if shader.reads_labels:
        assert torch.equal(actual["label"], expected["label"])
    return expected, expected_marks, actual


def changed(records: tuple, change: dict) -> list:
    """Returns records with some fields replaced."""
    return [
        record._replace(**{name: value for name, value in change.items() if name in record._fields})
        for record in records
    ]


def arguments(
    tree: gv.N3Tree, rays: int, shader: gv.TransferFunction = SHADER, dtype=torch.float32
) -> tuple[RayArguments, TraceArguments]:
    """Returns arguments of the op for parallel rays through the middle of a tree."""
    device = tree.device
    real = {"dtype": torch.float64, "device": device}
    size = tree.box[1] - tree.box[0]
    fraction = 0.25 + torch.linspace(0, 0.1, rays, dtype=torch.float64)[:, None]
    direction = torch.tensor([0.3, 0.2, 1.0]) / torch.tensor([0.3, 0.2, 1.0]).norm()
    ray_arguments = RayArguments(
        origin_r3=(tree.box[0] + fraction * size).to(device),
        direction_r3=direction.to(**real).repeat(rays, 1),
        cone_r2=torch.tensor([[0.5, 0.02]], **real).repeat(rays, 1),
        range_r2=torch.tensor([[0.0, 1e9]], **real).repeat(rays, 1),
    )
    frame_1 = torch.tensor([3], dtype=torch.int32, device=device)
    traced = Tracer(tree, shader, gv.RenderOptions(dtype=dtype, cone_scale=1.0), frame_1=frame_1)
    return ray_arguments, traced.arguments


def op_arguments(tree, shader, dtype) -> list:
    """Returns the checked function's arguments for the rays of a camera."""
    rays = camera_rays(tree, 3).to(tree.device)
    tracer = Tracer(tree, shader, gv.RenderOptions(dtype=dtype))
    records = [RayArguments.of(rays)._replace(width=0), tracer.arguments, tracer.shading]
    return [*records, shader.parameter_tensor(tree, dtype)]


def packed(seed=0, rays=7, dtype=torch.float64, device="cpu"):
    generator = torch.Generator().manual_seed(seed)
    counts = torch.randint(0, 6, (rays,), generator=generator)
    counts[2] = 0
    offset = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
    alpha = torch.rand(int(offset[-1]), generator=generator, dtype=dtype)
    feature = torch.randn(int(offset[-1]), 4, generator=generator, dtype=dtype)
    clear = 0.5 + 0.5 * torch.rand(rays, generator=generator, dtype=dtype)
    return [t.to(device) for t in (alpha, feature, offset, clear)]
