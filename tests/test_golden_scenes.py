"""The bits of 230 random scenes, as hashes in `golden_scenes.json`.

The scenes are those of `helpers/golden_scenes.py`, rendered only through the public interface, so
that files behind it can move. A change that must keep all bits keeps the hashes; one that is meant
to change some rewrites them::

    python tests/test_golden_scenes.py --write

Hashes are of raw bytes, in groups: "picture" is the floats that are returned, "counts" everything
that was counted, with the marks in the pools, and "library" the floats whose last bits depend on
torch.

Most of a picture is the same on every processor, because the kernels are written for that. Before
them, cameras, tables and lights are computed in float64 by torch and numpy, whose sines, logarithms
and matrix products differ by an ulp from machine to machine; rounded to float32, as a traced ray or
a table's row is, they almost surely agree. Therefore

- pictures traced in float64 are hashed as float32. Some scenes need no such function (rays made
  here by + - * / and roots; surfaces and projections, whose alpha is 0 or 1; no highlight): these
  are hashed as they are, also in float64.
- `TransferModule`, alone and within `gv.cost`, computes logarithms in the dtype of the samples, so
  it is traced in float64.
- what torch computes after the kernel, in float32 or in so many steps that an ulp is visible, is
  the group "library": normals composited from several pieces, depths of modules, colours by
  `gv.Lighting`. It is compared only on the CPU, and only where torch's functions give the bits that
  they gave when the file was written (`library`).
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections import Counter
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.golden_scenes import (
    CAMERAS,
    LATER,
    LIGHTS,
    LOOKS,
    METHODS,
    MODULES,
    SCENES,
    VALUE_RANGES,
    Settings,
    box_of,
    camera_of,
    described,
    numbers,
    options_of,
    settings,
    shader_of,
    volumes,
)
from torch import Tensor
from torch.nn.functional import normalize

import gvtorch as gv

FILE = Path(__file__).with_name("golden_scenes.json")
GROUP = 10  # scenes a test
ABSENT = -1  # in `brick_tn` and `child_tn`
PRIORITY = 0x7FF  # bits of request words
PICTURE = ("color", "alpha", "depth", "nearest", "normal", "features")
Found = dict[str, list[Any]]


@torch.no_grad()
def traced(s: Settings, backend: str) -> Found:
    """Returns the picture's floats, and everything that was counted."""
    device = "cuda" if backend == "cuda" else "cpu"
    if s["way"] in ("engine", "levels"):
        return _streamed(s, backend, device)
    low, high = VALUE_RANGES[s["value"]]
    threshold = None if s["threshold"] is None else low + (high - low) * s["threshold"]
    sizes = {"branching": s["branching"], "threshold": threshold, "device": device}
    tree = gv.N3Tree.from_volume(volumes(s), s["brick"], s["border"], **sizes)
    camera, shader = camera_of(s), shader_of(s)
    if isinstance(shader, gv.ModuleShader):
        shader.module.to(device)
    nodes, bricks = tree.nodes, tree.bricks
    if s["way"] == "tracer":
        return _module(s, tree, camera, shader)
    if s["way"] == "holes":
        for number, pointers in enumerate((nodes.brick_tn, nodes.child_tn)):
            gone = numbers(10 * s["seed"] + 6 + number, *pointers.shape) < 0.3
            pointers[torch.from_numpy(gone).to(device) & (pointers >= 0)] = ABSENT
    options = options_of(s)
    if s["way"] == "cost":
        cost = gv.cost(tree, camera, shader, backend=backend, **options)
        images, counts = [cost.lod, cost.age, cost.fill], [cost.samples, cost.nodes]
        return {"picture": images, "counts": counts, "library": []}
    picture = gv.render(tree, camera, shader, backend=backend, **options)
    parts = _parts(s, picture)
    used = [picture.stats.samples, picture.stats.tiles_used, picture.stats.bricks_used]
    parts["counts"] += [*used, _wide(nodes.request_tn), nodes.stamp_t, bricks.stamp_b]
    return parts


def _wide(request_tn: torch.Tensor) -> torch.Tensor:
    """Returns request words as they are hashed: int32, priorities of 16 bits."""
    requests = request_tn.to(torch.int32)
    priority = requests & PRIORITY
    top = torch.where(priority == PRIORITY, 0xFFFF, priority)
    return ((requests - priority) << 5) | top


def _parts(s: Settings, *pictures: gv.Picture) -> Found:
    rounded = by_torch(s)
    parts: Found = {"picture": [], "counts": [], "library": []}
    for picture in pictures:
        for name in PICTURE:
            parts["library" if name in rounded else "picture"].append(getattr(picture, name))
        parts["counts"] += [picture.samples, picture.missed]
        parts["counts"] += [] if picture.label is None else [picture.label]
    return parts


def by_torch(s: Settings) -> set[str]:
    """Returns the images whose last bits depend on torch, not on the kernels."""
    if s["hashed"] == "float32":
        return set()
    pieces = "lens" in s or s.get("caps") or s.get("clip") in ("boxes", "without")
    pieces = pieces or s.get("layer") == "translucent" or s.get("two_trees")
    names = {"normal"} if pieces else set()
    names |= {"color"} if "lighting" in s else set()
    return names | ({"depth", "nearest"} if s["look"] in MODULES else set())


def _module(s: Settings, tree: gv.N3Tree, camera: gv.Camera | gv.Rays, shader: Any) -> Found:
    """Traces a scene with a `TreeTracer`."""
    names = ("component", "step", "stop_alpha", "depth_alpha", "cone_scale")
    tracer = gv.TreeTracer(tree, shader, channel="value", **{name: s[name] for name in names})
    rays = camera.placed(tree.box).rays() if isinstance(camera, gv.Camera) else camera
    rays = rays.to(tree.device)
    color, alpha, depth, samples, normal, features = tracer.hits(
        rays.origin, rays.direction, rays.cone, rays.range
    )
    images = [color, alpha, depth, normal, features]
    return {"picture": images, "counts": [samples], "library": []}


def _streamed(s: Settings, backend: str, device: str) -> Found:
    """Renders with an engine of small pools: its first frame, and the converged picture."""
    low, high = box_of(s)
    scene = {"one": volumes(s)}
    if s["two_trees"]:
        scene["two"] = volumes(s, 1.25 * float(high[0] - low[0]))
    producers = {}
    for name, channels in scene.items():
        producers[name] = gv.VolumeProducer(channels, hold=s["hold"])
        producers[name].branching = s["branching"]
    widths = [v.data.shape[3] * v.data.element_size() for v in scene["one"].values()]
    slot = (s["brick"] + 2 * s["border"]) ** 3 * sum(widths)
    around = s.get("lighting") in ("occlusion", "indirect", "everything")
    slots = (2 if around else 1) * s["slots"]  # a ray's cones see many bricks, which must fit
    options = options_of(s)
    camera, shader = camera_of(s), shader_of(s)
    if isinstance(shader, gv.ModuleShader):
        shader.module.to(device)
    with gv.Engine(
        producers,
        brick_pool=slots * slot * len(producers),
        node_pool=(8 + 3 * sum(widths)) * s["branching"] ** 3 * 400,
        brick_size=s["brick"],
        border=s["border"],
        loading="levels" if s["way"] == "levels" else "straight",
        order=s["order"],
        scout_rounds=s["scouts"],
        device=device,
    ) as engine:
        first, stats = engine.frame(camera, shader, backend=backend, **options)
        requests = [*stats.requests.values(), stats.misses]
        last = engine.render(camera, shader, backend=backend, **options)
        assert last.stats.converged
    parts = _parts(s, first, last)
    parts["counts"] += requests
    return parts


def digest(parts: Iterable[Any], hashed: str) -> str:
    """Returns 16 hex digits of the bytes and shapes of what was returned."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            rounded = hashed == "float32" and part.dtype == torch.float64
            array = (part.to(torch.float32) if rounded else part).cpu().contiguous().numpy()
            total.update(str(array.shape).encode() + array.tobytes())
        else:
            total.update(str(part).encode())
    return total.hexdigest()[:16]


def hashes(seed: int, backend: str) -> dict[str, str]:
    """Returns a scene's hash for each group that is not empty."""
    s = settings(seed)
    groups = traced(s, backend)
    return {group: digest(parts, s["hashed"]) for group, parts in groups.items() if parts}


@cache
def library() -> str:
    """Returns a hash of what torch's functions give on this machine."""
    x = torch.from_numpy(numbers(1, 999, 3))
    square = x[:3].T @ x[:3]
    functions = ("sin", "cos", "tan", "asin", "log2", "exp2", "log1p", "expm1", "sqrt")
    results = [getattr(y, name)() for name in functions for y in (x, x.float())]
    results += [x**7.3, square, normalize(x, dim=1), normalize(x.float(), dim=1)]
    return digest(results, "raw")


# --- the tests


def quick(s: Settings) -> bool:
    """Returns whether the torch twin is fast for a scene; it does not support `TreeTracer`."""
    if s["way"] == "tracer" or "shadows" in s["look"] or "lighting" in s:
        return False
    return s["way"] not in ("engine", "levels") or s["look"] in ("transfer", "maximum")


def promised(s: Settings, backend: str) -> bool:
    """Returns whether a backend has the bits of `cpp` and is tested: the twin in every second."""
    if backend == "cpp":
        return True
    return s["dtype"] == "float32" and (backend == "cuda" or (quick(s) and s["seed"] % 2 == 0))


@cache
def golden() -> dict[str, Any]:
    return json.loads(FILE.read_text(encoding="utf-8"))


@pytest.mark.parametrize("group", range(SCENES // GROUP))
def test_every_bit_is_as_it_was(backend, group):
    wrong, tried = [], 0
    groups = {"picture", "counts"}
    if backend != "cuda" and library() == golden()["library"]:
        groups.add("library")
    for seed in range(group * GROUP, (group + 1) * GROUP):
        s = settings(seed)
        if promised(s, backend):
            tried += 1
            actual, expected = hashes(seed, backend), golden()["scenes"][seed]
            assert actual.keys() == expected.keys()
            parts = sorted(
                part for part in groups & expected.keys() if actual[part] != expected[part]
            )
            wrong += [f"{' and '.join(parts)} of {described(s)}"] if parts else []
    assert not wrong, f"{len(wrong)} of {tried} scenes changed:\n" + "\n".join(wrong)


@pytest.mark.long
def test_the_default_device_of_torch_changes_no_bit(backend):
    """A program may make its own tensors elsewhere."""
    seeds = [seed for seed in range(0, SCENES, 6) if promised(settings(seed), backend)]
    torch.set_default_device("meta")
    try:
        actual = {seed: hashes(seed, backend) for seed in seeds}
    finally:
        torch.set_default_device(None)
    for seed in seeds:
        for part in {"picture", "counts"} & actual[seed].keys():
            assert actual[seed][part] == golden()["scenes"][seed][part], described(settings(seed))


def test_every_setting_is_drawn():
    """Every option occurs at least a few times."""
    scenes = [settings(seed) for seed in range(SCENES)]
    choices = {
        **{"look": (*LOOKS, *LATER), "way": METHODS, "camera": CAMERAS, "light": LIGHTS},
        "value": VALUE_RANGES,
        **{"branching": (2, 3, 4), "brick": (4, 8, 16), "border": (0, 1, 2), "width": (1, 2, 3)},
        **{"lod": ("auto", "finest"), "hashed": ("raw", "float32"), "inside": (True, False)},
        "clip": ("planes", "box", "boxes", "matrix", "without"),
        "lighting": ("shadows", "cones", "occlusion", "indirect", "everything"),
        "layer": ("opaque", "translucent"),
        "background": ("black", "color", "gradient", "image", "none"),
    }
    for name, values in choices.items():
        count = Counter(s.get(name) for s in scenes)
        assert all(count[value] >= 3 for value in values), (name, count)
    count = Counter((s["dtype"], s["hashed"]) for s in scenes)
    assert min(count.values()) >= 5 and len(count) == 3, count
    assert sum("lens" in s for s in scenes) >= 10 and sum(s.get("caps", 0) for s in scenes) >= 10


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit("usage: python tests/test_golden_scenes.py --write")
    lines = ",\n".join(json.dumps(hashes(seed, "cpp")) for seed in range(SCENES))
    text = f'{{"library": "{library()}", "scenes": [\n{lines}\n]}}\n'
    FILE.write_text(text, encoding="utf-8")
