"""Rays that the CPU traces in packets, in a separate process for each instruction set."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import gvtorch as gv
from gvtorch import cpp_ext
from helpers import TESTS
from helpers.processes import CONTEXT
from helpers.rays import camera_rays
from helpers.traces import trace
from helpers.trees import with_holes

INSTRUCTIONS = ["baseline", "avx2", "avx512"]


class Run(NamedTuple):
    process: BaseProcess
    file: Path


def start(
    function: Callable[[], object], folder: Path, instructions: str, **environment: str
) -> Run:
    """Calls a function of a test file in a new process, which saves what it returns. Nothing has
    been traced there before: the instruction set is chosen at the first call of a kernel, and is
    the one asked for, or the widest of this process if that is narrower.
    """
    asked = INSTRUCTIONS.index(instructions)
    least = min(asked, INSTRUCTIONS.index(cpp_ext.instructions()))
    module, name, file = function.__module__, function.__name__, folder / f"{instructions}.pt"
    variables = {**os.environ, "GVTORCH_CPU": instructions, **environment}
    code = (
        f"import os, sys, torch; os.environ.clear(); os.environ.update({variables!r})\n"
        "from gvtorch.cpp_ext import instructions\n"
        f"assert instructions() in {INSTRUCTIONS[least : asked + 1]}\n"
        f"sys.path.insert(0, {str(TESTS)!r}); from {module} import {name}\n"
        f"torch.save({name}(), {str(file)!r})"
    )
    process = CONTEXT.Process(target=exec, args=(code, {}))
    process.start()
    return Run(process, file)


def result(run: Run):
    """Returns the tensors that the function returned."""
    run.process.join(600)
    assert run.process.exitcode == 0
    return torch.load(run.file, weights_only=True)


TRANSFER = gv.TransferFunction.from_points(
    [(0.2, 0), (0.5, 0.05), (0.9, 0.6)], [(0.2, 1, 0.3, 0.1), (0.9, 0.2, 0.6, 1)]
)


LAMP = gv.PointLight((10.0, 50.0, 30.0))


@cache
def scene(branching: int = 2, side: int = 37) -> gv.N3Tree:
    """Returns a tree of rough and smooth values, with a region of zeros and a constant one."""
    part = side / 37
    generator = torch.Generator().manual_seed(4)
    coarse = torch.rand((1, 5, 12, 12, 12), generator=generator)
    numbers = torch.nn.functional.interpolate(coarse, size=(side,) * 3, mode="trilinear")[0]
    value = numbers[4] + 0.1 * torch.rand((side,) * 3, generator=generator)
    value[: round(14 * part)], value[:, round(24 * part) :, : round(20 * part)] = 0.0, 0.35
    rgba = numbers[:4].movedim(0, -1).clone()
    rgba[..., 3] *= 0.3 * (value > 0.2)
    normal = torch.nn.functional.normalize(numbers[:3].movedim(0, -1) - 0.5, dim=-1)
    six = gv.Volume(rgba).directional()
    six.data = six.data * torch.linspace(0.6, 1.0, 24)  # all six differ
    return gv.N3Tree.from_volume(
        {
            "value": gv.Volume(value),
            "six": gv.Volume((six.data * 255).round().to(torch.uint8)),
            "rgba": gv.Volume((rgba * 255).round().to(torch.uint8)),
            "normal": gv.Volume((normal * 127).round().to(torch.int8)),
        },
        4,
        branching=branching,
        threshold=0.0,
    )


def cut_rays(rays: gv.Rays, side: int = 37) -> gv.Rays:
    """Returns rays that begin and end within the box, each elsewhere, with reduced light."""
    first = torch.linspace(30.0, 45.0, len(rays.origin), dtype=torch.float64)
    limits = torch.stack((first, first + 17.3), 1) * (side / 37)
    return replace(rays, range=limits, transmittance=torch.linspace(0.05, 1.0, len(first)).double())


def joined_rays(whole: gv.Rays, cut: gv.Rays) -> gv.Rays:
    """Returns both, in one picture; the light of whole rays is 1."""
    columns = {
        name: torch.cat((getattr(whole, name), getattr(cut, name)))
        for name in ("origin", "direction", "cone", "range")
    }
    transmittance = torch.cat((whole.light(), cut.light()))[:, 0]
    return gv.Rays(**columns, width=whole.width, transmittance=transmittance)


def shaded(shader: gv.Shader, backend: str, branching: int = 2) -> list[Tensor]:
    """Returns everything that a shader's traces write."""
    tree, results = scene(branching), []
    holes = with_holes(tree, 0.3, 5)
    pictures = [
        (tree, 21, {}),
        (tree, 5, {}),  # cones as wide as several voxels: levels blend
        (tree, 11, {"lod": "finest", "step": 1.3}),
        (tree, 11, {"stop_alpha": 0.6, "depth_alpha": 0.5}),
        (holes, 14, {}),
    ]
    for traced_tree, size, options in pictures:
        rays = camera_rays(traced_tree, size, distance=1.5)
        cut = cut_rays(rays)
        for traced_rays in (rays, cut) if size < 10 else (joined_rays(rays, cut),):
            results += written(traced_tree, backend, traced_rays, shader, **options)
    return results


def written(tree: gv.N3Tree, backend: str, rays: gv.Rays, shader, **options) -> list[Tensor]:
    hits, marks = trace(tree, backend, rays, shader, **options)
    return [*hits.values(), *marks.values()]


def shaded_in_few_steps(shader: gv.Shader, backend: str, branching: int = 2) -> list[Tensor]:
    """Returns everything that a shader's traces write. The time of the twin is that of its steps,
    hardly that of its rays: therefore whole rays have long steps, and some cut ones short steps.
    """
    side = 23 if branching == 2 else 37
    tree = scene(branching, side)
    holes = with_holes(tree, 0.3, 5)
    pictures = [
        (tree, 21, {"step": 2.1}),
        (tree, 5, {"step": 0.8}),  # cones as wide as several voxels: levels blend
        (tree, 11, {"lod": "finest", "step": 2.6}),
        (holes, 14, {"step": 1.7, "stop_alpha": 0.6, "depth_alpha": 0.5}),
    ]
    if shadows := getattr(shader, "shadows", False):  # the twin traces a cone from each sample
        pictures = [(tree, 21, {"step": 2.6}), (holes, 14, {"lod": "finest", "step": 3.9})]
    results = []
    for traced_tree, size, options in pictures:
        rays = camera_rays(traced_tree, size, distance=1.5)
        joined = joined_rays(rays, cut_rays(rays, side))
        results += written(traced_tree, backend, joined, shader, **options)
    if not shadows:
        cut = cut_rays(camera_rays(tree, 9, distance=1.5), side)
        short = torch.stack((cut.range[:, 0], cut.range[:, 0] + 4.2), 1)
        results += written(tree, backend, replace(cut, range=short), shader)
    return results
