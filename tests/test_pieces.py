"""Rays in pieces, and narrowing cones: every backend, against whole rays and a plain loop."""

from __future__ import annotations

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.clips import CLIPS, is_kept
from helpers.marcher import trilinear
from helpers.rays import camera_rays, rays_of_cameras
from helpers.shaders import SHADERS
from helpers.traces import SHADER, assert_equal, trace
from helpers.trees import with_holes
from helpers.waits import nobody_waits

import gvtorch as gv
from gvtorch.tracing import clip, composite, lighting
from gvtorch.tracing.composite import trace_pieces
from gvtorch.tracing.effects import TreeTrace
from gvtorch.tracing.tracer import Tracer
from gvtorch.tracing.trees import trace_trees


@pytest.fixture(scope="module")
def noise() -> gv.Volume:
    """All voxels differ, so nothing is EMPTY, CONSTANT or hidden."""
    generator = torch.Generator().manual_seed(3)
    return gv.Volume(0.05 + 0.1 * torch.rand(40, 40, 40, generator=generator))


def narrowing(rays: gv.Rays, near: float, end: float) -> gv.Rays:
    """Returns the rays with cones that are `near` wide at the origin and 0 at distance `end`."""
    cone = torch.tensor([near, -near / end], dtype=torch.float64).expand(len(rays.origin), 2)
    return dataclasses.replace(rays, cone=cone.contiguous())


@pytest.mark.parametrize(
    ("near", "end", "branching", "dtype"),
    [
        (14.0, 140.0, 2, torch.float32),
        (14.0, 140.0, 3, torch.float64),
        (9.0, 90.0, 3, torch.float32),
        (6.0, 60.0, 2, torch.float64),
        (40.0, 61.0, 2, torch.float32),
        (40.0, 61.0, 3, torch.float64),
    ],
)
def test_narrowing_cones_equal_the_reference(blobs, compiled, branching, near, end, dtype):
    tree = gv.N3Tree.from_volume(blobs, 4, branching=branching)
    both = rays_of_cameras(tree, 24, 0.3, 1.3)
    rays = narrowing(both, near, end)  # beyond `end` a cone is as one of width 0
    result, marks, _ = assert_equal(tree, compiled, rays, dtype=dtype)
    assert result["alpha"][24 * 24 :].max() > 0.2 and (marks["brick"] == 1).any()


@pytest.mark.parametrize("seed", range(3))
def test_narrowing_cones_ask_for_the_same(blobs, compiled, seed):
    tree = with_holes(gv.N3Tree.from_volume(blobs, 4), 0.5, seed)
    rays = narrowing(camera_rays(tree, distance=1.3), 12.0, 90.0)
    result, marks, _ = assert_equal(tree, compiled, rays)
    assert marks["request"].any() and result["missed"].any()


@pytest.mark.parametrize("growth", [-0.2, -0.05, 0.0, 0.08])
def test_intervals_are_as_long_as_the_cone_is_wide_where_they_start(noise, backend, growth):
    """Every interval of a ray through noise is a sample; a plain loop counts them."""
    tree = gv.N3Tree.from_volume(noise, 4)
    shader = gv.TransferFunction.from_points([(0, 0.001), (1, 0.002)])
    near = 9.0 if growth < 0 else 1.0
    rays = gv.Rays(
        origin=torch.tensor([[-10.0, 17.3, 11.9]], dtype=torch.float64),
        direction=torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64),
        cone=torch.tensor([[near, growth]], dtype=torch.float64),
        range=torch.tensor([[0.0, torch.inf]], dtype=torch.float64),
    )
    result, _ = trace(tree, backend, rays, shader, cone_scale=1.0, stop_alpha=1.0)
    start, stop, count = 9.5, 49.5, 0  # the box begins half a voxel before the first centre
    while start < stop:
        length = 0.5
        while 2 * length <= near + growth * start and 2 * length <= tree.root_voxel:
            length *= 2
        start, count = start + length, count + 1
    assert int(result["samples"]) == count >= 8


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_ray_in_pieces_is_the_ray_in_one_go(blobs, backend, dtype):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[backend])
    rays = camera_rays(tree, distance=1.3).to(tree.device)
    low, high = tree.box
    origin, direction = rays.origin.cpu(), rays.direction.cpu()
    a, b = (low - origin) / direction, (high - origin) / direction
    enter = torch.minimum(a, b).amax(1).to(tree.device)
    step = 1.0 if backend == "reference" else 0.5  # the twin takes its time
    length = step * min(tree.spacing)  # whole intervals: the same samples
    cuts = [enter + int(n / step) * length for n in (0, 20, 31, 32, 45)]
    ends = [*cuts, torch.full_like(enter, torch.inf)]
    options = gv.RenderOptions(backend=backend, lod="finest", dtype=dtype, step=step)
    tracer = Tracer(tree, SHADER, options)
    whole = tracer(rays)
    joined = trace_pieces(
        tracer,
        [
            dataclasses.replace(rays, range=torch.stack(pair, 1))
            for pair in itertools.pairwise(ends)
        ],
    )
    tolerance = 2e-5 if dtype == torch.float32 else 1e-9
    for name in ("color", "alpha"):
        torch.testing.assert_close(
            getattr(joined, name), getattr(whole, name), rtol=0, atol=tolerance
        )
    both = whole.depth.isfinite() & joined.depth.isfinite()
    assert both.sum() > 40 and (whole.depth.isfinite() != joined.depth.isfinite()).sum() <= 1
    assert (whole.depth - joined.depth)[both].abs().max() < 1e-3
    # By rounding, a cut may miss an interval's end; the sliver is then an extra sample.
    assert (whole.samples - joined.samples).abs().max() <= 5
    assert whole.alpha.max() > 0.95, "some rays must end early"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_share_that_a_ray_begins_with_equals_the_reference(blobs, compiled, dtype):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree, distance=1.3)
    generator = torch.Generator().manual_seed(5)
    clear = torch.rand(len(rays.origin), generator=generator, dtype=torch.float64)
    clear[::7], clear[1::7] = 0.0, 1.0
    result, *_ = assert_equal(
        tree, compiled, dataclasses.replace(rays, transmittance=clear), dtype=dtype
    )
    closed = clear == 0
    assert not result["samples"][closed].any() and (result["alpha"][closed] == 1).all()
    full, _ = trace(tree, compiled, rays, dtype=dtype, stop_alpha=1.0)
    part, _ = trace(tree, compiled, dataclasses.replace(rays, transmittance=clear), stop_alpha=1.0)
    np.testing.assert_allclose(part["color"], full["color"] * clear[:, None], atol=2e-6)


@pytest.mark.parametrize(
    "clear", [torch.ones(4, dtype=torch.float64), torch.ones(3, 1, dtype=torch.float64)]
)
def test_a_wrong_share_is_one_clear_error(blobs, clear):
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = dataclasses.replace(camera_rays(tree)[:3], transmittance=clear)
    with pytest.raises(ValueError, match=r"clear_r must be \(3,\) float64"):
        Tracer(tree, SHADER, gv.RenderOptions())(rays)


# --- what a clip leaves, by every shader


@pytest.mark.parametrize("name", SHADERS)
def test_every_shader_is_cut_by_planes_and_boxes(tree_of_channels, compiled, name):
    """A plane ends rays where its formula says, and several pieces equal the twin's."""
    tree, shader = tree_of_channels, SHADERS[name]
    rays = camera_rays(tree, 10, distance=1.3)
    plane = (0.6, 0.0, -0.8, 8.0)
    normal = torch.tensor(plane[:3], dtype=torch.float64)
    height, rate = rays.origin @ normal + plane[3], rays.direction @ normal
    inward = rate > 0
    first = torch.where(inward, torch.maximum(rays.range[:, 0], -height / rate), rays.range[:, 0])
    last = torch.where(inward, rays.range[:, 1], torch.minimum(rays.range[:, 1], -height / rate))
    ends = torch.stack((first, torch.maximum(first, last)), 1)
    cut, _ = trace(tree, compiled, dataclasses.replace(rays, range=ends), shader.opened())
    clipped, _ = trace(tree, compiled, rays, shader, clip=gv.Clip(planes=[plane]))
    whole, _ = trace(tree, compiled, rays, shader)
    for field in ("color", "alpha", "depth", "features"):
        torch.testing.assert_close(clipped[field], cut[field], rtol=1e-4, atol=1e-4)
    assert (whole["color"] - clipped["color"]).abs().max() > 0.05
    caps = not isinstance(shader, gv.Projection)
    clip = dataclasses.replace(CLIPS["all"], caps=caps)
    pieces, *_ = assert_equal(tree, compiled, rays, shader, clip=clip, step=1.7)
    assert (whole["color"] - pieces["color"]).abs().max() > 0.05


@pytest.mark.parametrize("kind", ["maximum", "minimum", "mean"])
def test_a_projection_is_that_of_all_that_is_kept(blobs, compiled, kind):
    """Against points along each ray, a hundredth of a voxel apart; caps are refused."""
    density = 1 - blobs.data if kind == "minimum" else blobs.data
    tree = gv.N3Tree.from_volume(gv.Volume(density, blobs.spacing, blobs.origin), 4)
    ramp = gv.TransferFunction.from_points([(0, 0)], [(0, 0, 0, 0), (1, 1, 0.5, 0.2)])
    shader, rays = gv.Projection(kind, ramp), camera_rays(tree, 14, distance=1.2)
    options = {"lod": "finest", "step": 0.1}
    clear = torch.full((len(rays.origin),), 0.25, dtype=torch.float64)
    part = dataclasses.replace(rays, transmittance=clear)
    data, spacing = density[..., 0].double().numpy(), np.array(blobs.spacing)
    t = 20 + 0.01 * (np.arange(12000) + 0.5)
    low, high = tree.box.numpy()
    pick = {"maximum": np.max, "minimum": np.min, "mean": np.mean}[kind]
    for name in ("cut", "union", "all"):
        hits, _ = trace(tree, compiled, rays, shader, clip=CLIPS[name], **options)
        dimmed, _ = trace(tree, compiled, part, shader, clip=CLIPS[name], **options)
        compared = 0
        for ray in range(0, len(rays.origin), 5):
            points = rays.origin[ray].numpy() + t[:, None] * rays.direction[ray].numpy()
            kept = ((points >= low) & (points <= high)).all(1) & is_kept(CLIPS[name], points)
            if not kept.any():
                assert hits["alpha"][ray] == 0 and torch.isinf(hits["depth"][ray])
            if kept.sum() < 100:
                continue
            values = trilinear(data, (points[kept] - np.array(blobs.origin)) / spacing)
            value = pick(values)
            assert abs(float(hits["features"][ray, 0]) - value) < 0.01
            color = value * np.array([1, 0.5, 0.2])
            np.testing.assert_allclose(hits["color"][ray], color, atol=0.01)
            np.testing.assert_allclose(dimmed["color"][ray], 0.25 * color, atol=0.01)
            depth = float(hits["depth"][ray])
            if kind == "mean":
                assert abs(depth - t[kept][0]) < 0.05
            else:
                assert abs(values[np.abs(t[kept] - depth).argmin()] - value) < 0.01
            compared += 1
        assert compared > 15 and len(hits["features"].unique()) > 40
    with pytest.raises(ValueError, match="Projection sees a ray in one go, so it has no clip with"):
        trace(tree, compiled, rays, shader, clip=dataclasses.replace(CLIPS["cut"], caps=True))


def test_a_projection_in_pieces_has_the_bits_of_the_whole(blobs, compiled):
    """A box that removes nothing cuts rays into pieces, and their common colour is looked up."""
    ramp = gv.TransferFunction([(0.1, 0)], [(0.1, 0, 0, 1), (0.4, 1, 0.3, 0), (0.9, 1, 0, 0.2)])
    tree, shader = gv.N3Tree.from_volume(blobs, 4), gv.Projection("maximum", ramp)
    rays, nothing = camera_rays(tree, 24, distance=1.2), gv.Clip(without=[((500,) * 3, (501,) * 3)])
    whole, _ = trace(tree, compiled, rays, shader)
    pieces, _ = trace(tree, compiled, rays, shader, clip=nothing)
    assert len(whole["color"].unique()) > 200 and torch.equal(whole["color"], pieces["color"])


@pytest.mark.parametrize("kind", ["maximum", "minimum", "mean"])
def test_a_projection_in_pieces_is_streamed_and_waits_for_nobody(blobs, compiled, kind):
    device, camera = DEVICES[compiled], gv.Camera.orbit(30, 20, 1.2, width=24, height=20)
    shader, options = gv.Projection(kind, SHADER), {"clip": CLIPS["all"]}
    whole = gv.render(gv.N3Tree.from_volume(blobs, 4, device=device), camera, shader, **options)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, device=device) as engine:
        picture = engine.render(camera, shader, **options)
        engine.frame(camera, shader, **options)
        if compiled == "cuda":
            graph = engine.capture(camera, shader, **options)
        with nobody_waits(device=device):
            frame, _ = engine.frame(camera, shader, **options)
            again = graph.replay(camera)[0] if compiled == "cuda" else frame
    assert picture.stats.converged and whole.alpha.max() == 1
    for drawn in (picture, frame, again):
        for name in ("color", "alpha", "depth", "features"):
            assert torch.equal(getattr(drawn, name), getattr(whole, name)), name


def test_normals_of_three_trees_are_the_mean_by_the_light_that_each_takes():
    """Boxes in a row along z, met in reverse order by rays in the opposite direction."""
    generator = torch.Generator().manual_seed(5)
    boxes = [torch.tensor([[0.0, 0, z], [1, 1, z + 1]]) for z in (0, 2, 4)]
    hits = [
        gv.Hits(
            color=torch.rand(2, 3, generator=generator),
            alpha=torch.rand(2, 1, generator=generator),
            depth=torch.rand(2, 1, generator=generator),
            samples=torch.ones(2, dtype=torch.int32),
            missed=torch.zeros(2, dtype=torch.bool),
            normal=torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=1),
        )
        for _ in boxes
    ]
    rays = gv.Rays(
        origin=torch.tensor([[0.5, 0.5, -9.0], [0.5, 0.5, 9.0]]),
        direction=torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]),
        cone=torch.zeros(2, 2),
        range=torch.tensor([[0.0, torch.inf]]).repeat(2, 1),
    )
    trees = [
        TreeTrace(
            box.double(),
            lambda _, hit=hit: hit,
            SimpleNamespace(
                shader=gv.TransferFunction([(0, 0), (1, 1)]),
                to_tree=lambda rays: rays,
                learned=list,
                tree=SimpleNamespace(box=box),
            ),
        )
        for box, hit in zip(boxes, hits, strict=True)
    ]
    actual = trace_trees(trees, rays)
    for ray, ranked in enumerate((hits, hits[::-1])):
        a, b, c = (float(hit.alpha[ray]) for hit in ranked)
        shares = a, (1 - a) * b, (1 - a) * (1 - b) * c
        taken = sum(s * hit.normal[ray] for s, hit in zip(shares, ranked, strict=True))
        color = sum(
            w * hit.color[ray] for w, hit in zip((1, 1 - a, (1 - a) * (1 - b)), ranked, strict=True)
        )
        torch.testing.assert_close(actual.normal[ray], taken / taken.norm())
        torch.testing.assert_close(actual.color[ray], color)
        assert abs(float(actual.alpha[ray]) - sum(shares)) < 1e-6


LEFT_OUT = {
    "isosurface": gv.Isosurface(0.5, light=gv.DirectionalLight((1, 1, 2), angle=5)),
    "stored colour": gv.StoredColor("rgba", light=gv.PointLight((0, 0, 60), radius=2), diffuse=1),
    "features": gv.Features(gv.TransferFunction.preset("gray", 0, 1), "rgba"),
    "labels": gv.Labels(channel="label"),
}


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("name", LEFT_OUT)
def test_rays_that_the_cpu_leaves_out_change_no_bit(channels, monkeypatch, name):
    """Rays without a second piece, that do not begin at a cut, or whose pixels show nothing."""
    tree, pictures, left_out = gv.N3Tree.from_volume(channels), [], []
    light = gv.Lighting(occlusion=0.8, indirect=0.5, cones=3, reach=0.2, frame="box")
    cut = gv.Clip(without=[((0, 0, 0), (0.6, 0.6, 0.6))], frame="box", caps=True)
    options = {"clip": cut, "lighting": None if name == "features" else light}
    few = composite.indices_if_few

    def noted(some):
        kept_rays = few(some)
        left_out.append(kept_rays is not None)
        return kept_rays

    for chosen in (noted, lambda some: None):
        for room in (clip, composite, lighting):
            monkeypatch.setattr(room, "indices_if_few", chosen)
        view = gv.Camera.orbit(30, 20, 1.6, 30, 40, 28)
        pictures.append(gv.render(tree, view, LEFT_OUT[name], **options))
    first, second = map(vars, pictures)
    for field, values in first.items():
        if isinstance(values, torch.Tensor):
            assert torch.equal(values, second[field]), field
    assert any(left_out) and first["alpha"].max() > 0.5 and first["samples"].max() > 3
