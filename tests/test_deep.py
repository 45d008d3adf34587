"""Deep worlds: 2^33 voxels a side, seen from 10^-9 of the box away. Pictures are compared with
closed forms, and backends with each other.
"""

from __future__ import annotations

import math

import pytest
import torch
from helpers import DEVICES
from helpers.rays import camera_rays
from helpers.traces import SHADER, arguments, assert_equal, trace
from helpers.trees import copy_to, with_holes
from helpers.worlds import Menger, Solid, ball, bulb, meets_menger, torus

import gvtorch as gv
from gvtorch.base.constants import MAX_INTERVALS
from gvtorch.ops import RayArguments, list_samples, sample_bricks, trace_rays, trace_segments
from gvtorch.ops.reference.rays import is_deep
from gvtorch.producers.producer import Layout, Nodes
from gvtorch.tracing.tracer import Tracer

NEAR = 2e-9  # 10^-9 of the box
SURFACE = gv.Isosurface(0.5)
DEEP = [(2, 30), (3, 19), (4, 15)]


def engine(world: gv.Producer, **options) -> gv.Engine:
    return gv.Engine(world, **{"brick_pool": 96 << 20, "node_pool": 24 << 20} | options)


def camera_above(point, normal, size=32, height=NEAR, **options) -> gv.Camera:
    """Returns a camera `height` above a point of a surface, looking along the surface and down."""
    point, normal = (torch.tensor(v, dtype=torch.float64) for v in (point, normal))
    normal = normal / normal.norm()
    side = torch.linalg.cross(normal, torch.tensor([0.1, 0.7, 0.7], dtype=torch.float64))
    eye = point + height * normal
    target = eye + height * (side / side.norm() - 0.5 * normal)
    view_options = {"up": tuple(normal.tolist()), "width": size, "height": size} | options
    return gv.Camera.look_at(tuple(eye.tolist()), tuple(target.tolist()), **view_options)


def ball_meets(rays: gv.Rays, radius: float):
    """Returns the distances to a ball, and the outward normals there."""
    origin, direction = rays.origin.double(), rays.direction.double()
    along = (origin * direction).sum(1)
    over = (origin * origin).sum(1) - radius * radius
    root = along * along - over
    t = torch.where((root > 0) & (along < 0), over / (root.clamp(min=0).sqrt() - along), torch.inf)
    return t, (origin + t[:, None] * direction) / radius


def torus_meets(rays: gv.Rays, ring: float, tube: float):
    """Returns the same of a torus, by sphere tracing from the eye and Newton's method."""
    origin, direction = rays.origin.double(), rays.direction.double()
    gap = torus(ring, tube)
    t = torch.zeros_like(origin[:, 0])
    for step in range(300):
        hit = origin + t[:, None] * direction
        flat = hit * torch.tensor([1.0, 1.0, 0.0])
        normal = (hit - ring * flat / flat.norm(dim=1, keepdim=True)) / tube
        fall = (normal * direction).sum(1) if step > 250 else -1.0
        t = t + gap(*hit.unbind(1)) / fall
    return t, normal


def pixels_beside(picture, rays, t, normal):
    """Returns (r,): the surface's displacement across the ray, in pixels; -1: no hit."""
    depth = picture.depth.flatten().double()
    cosine = -(normal * rays.direction.double()).sum(1)
    error = (depth - t).abs() * cosine / (rays.cone[:, 1].double() * t)
    return torch.where(depth < torch.inf, error, -1.0)


@pytest.mark.parametrize("shape", ["ball", "torus"])
@pytest.mark.parametrize("branching, depth", DEEP)
def test_a_surface_is_where_it_should_be(branching, depth, shape):
    """Far better than a tenth of a pixel, though a pixel is 10^-12 of the box there."""
    if shape == "ball":
        up = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)
        world, point = Solid(ball(0.8), depth, branching), 0.8 * up
    else:
        up = torch.tensor([0.6, 0.64, 0.48], dtype=torch.float64)
        ring = 0.6 * torch.tensor([0.6, 0.64, 0.0]) / math.hypot(0.6, 0.64)
        world, point = Solid(torus(0.6, 0.3), depth, branching), ring.double() + 0.3 * up
    camera = camera_above(point.tolist(), up.tolist())
    rays = camera.rays()
    t, normal = ball_meets(rays, 0.8) if shape == "ball" else torus_meets(rays, 0.6, 0.3)
    with engine(world) as scene:
        for dtype in (torch.float32, torch.float64):
            picture = scene.render(camera, SURFACE, dtype=dtype)
            assert picture.stats.converged
            error = pixels_beside(picture, rays, t, normal)
            assert (error >= 0).all() and error.quantile(0.99) < 1e-4
            # Where N > 2, some intervals end more than a fine voxel behind their brick's border.
            assert error.max() < (1e-4 if branching == 2 else 0.2)
            off = (picture.normal.reshape(-1, 3).double() - normal).norm(dim=1)
            assert off.max() < 2e-3, "the normal's angle"


@pytest.mark.parametrize("height", [1e-3, 1e-6, NEAR])
def test_a_camera_outside_the_box(height):
    """It looks at the scene's face from far and near; rays begin where they enter the box."""
    world = Solid(lambda x, y, z: (0.999999 - x) + 0 * y * z, 30, filled=False)
    camera = camera_above((1.0, 0.2, 0.3), (1, 0, 0), height=height)
    rays = camera.rays()
    t = ((0.999999 - rays.origin[:, 0]) / rays.direction[:, 0]).double()
    with engine(world) as scene:
        picture = scene.render(camera, SURFACE)
        normal = torch.tensor([[1.0, 0, 0]], dtype=torch.float64).expand(len(t), 3)
        seen = picture.depth.flatten() < torch.inf
        error = pixels_beside(picture, rays, t, normal)[seen]
        assert seen.float().mean() > 0.5 and error.max() < 0.1, error.max()


def test_a_sponge_is_cut_as_whole_numbers_tell():
    """Menger's, N = 3, depth 19: rays meet the cells that exact arithmetic meets."""
    depth, point = 19, torch.tensor([0.25, 0.75, 0.25], dtype=torch.float64)
    size = 3.0**-17  # of the cell in whose hole the eye is: nine of the smallest cells
    low = (point / size).floor() * size
    eye, target = (low + size * torch.tensor(v) for v in ([0.5, 0.47, 0.52], [0.2, 0.85, 0.3]))
    camera = gv.Camera.look_at(
        tuple(eye.tolist()), tuple(target.tolist()), up=(0, 0, 1), fov=70, width=24, height=24
    )
    rays = camera.rays()
    t = torch.tensor(
        [meets_menger(o, d, depth) for o, d in zip(rays.origin, rays.direction, strict=True)]
    )
    with engine(Menger(depth, depth), brick_size=9) as scene:
        depth_r = scene.render(camera, SURFACE).depth.flatten().double()
    error = (depth_r - t).abs() / (rays.cone[:, 1].double() * t)
    assert (depth_r < torch.inf).all()
    # Edges are rounded by half a voxel; rays that hit faces agree.
    assert (error < 0.1).float().mean() > 0.75, error.quantile(0.75)


@pytest.mark.long
def test_a_fractal_is_the_same_in_float64():
    up = torch.tensor([0.3, -0.4, 0.86], dtype=torch.float64)
    up = up / up.norm()
    near, far = 0.2, 1.2
    for _ in range(80):  # finds the bulb's surface from outside
        middle = 0.5 * (near + far)
        outside = bool(bulb(*(middle * up)) < -1e-13)
        near, far = (near, middle) if outside else (middle, far)
    camera = camera_above((far * up).tolist(), up.tolist(), height=2e-8, size=16)
    with engine(Solid(bulb, 30, filled=False)) as scene:
        single = scene.render(camera, SURFACE)
        double = scene.render(camera, SURFACE, dtype=torch.float64)
    seen = (single.depth < torch.inf) & (double.depth < torch.inf)
    assert ((single.depth < torch.inf) != (double.depth < torch.inf)).float().mean() < 0.01
    assert seen.float().mean() > 0.3
    error = (single.depth - double.depth).abs()[seen] / double.depth[seen]
    pixel = float(camera.rays().cone[0, 1])
    assert error.double().quantile(0.8) < 1e-3 * pixel, "rays that graze it aside"


# --- backends, requests, shaders


LIT = gv.Lit(gv.TransferFunction.from_points([(0, 0), (1, 0.9)], [(0, 1, 0.2, 0), (1, 0, 0.5, 1)]))
SHADOWED = gv.Lit(LIT.transfer, light=gv.DirectionalLight((0.2, 0.4, -1), angle=60), shadows=True)
LOOKS = {"plain": LIT.transfer, "lit": LIT, "surface": SURFACE, "shadowed": SHADOWED}


@pytest.fixture(scope="module", params=DEEP, ids=lambda p: f"{p[0]}^{p[1]}")
def deep(request):
    """A tree of a scene in an engine, and the rays of its camera."""
    branching, depth = request.param
    camera = camera_above((0.288, 0.384, 0.64), (0.36, 0.48, 0.8), size=8)
    world = Solid(ball(0.8), depth, branching)
    with engine(world, brick_pool="12 MB", node_pool="2 MB") as scene:
        assert scene.render(camera, SHADOWED).stats.converged
        tree = scene.trees["scene"].tree
        assert is_deep(Tracer(tree, SURFACE, gv.RenderOptions()).arguments)
        yield tree, camera.rays()


@pytest.mark.parametrize(
    ("name", "dtype"),
    [*((name, torch.float32) for name in LOOKS), *((n, torch.float64) for n in ("lit", "surface"))],
)
def test_compiled_equals_reference(compiled, deep, name, dtype):
    tree, rays = deep
    result, marks, _ = assert_equal(tree, compiled, rays, LOOKS[name], dtype=dtype)
    assert result["alpha"].max() > 0.9 and (marks["brick"] > 0).any()


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_missing_nodes_give_equal_pictures_and_requests(compiled, deep, share):
    tree, rays = deep
    for seed in range(3):
        _, marks, _ = assert_equal(with_holes(tree, share, seed), compiled, rays, LIT.transfer)
        assert marks["request"].any()


def test_segments_and_samples_are_equal(compiled, deep):
    tree, rays = deep
    for dtype in (torch.float32, torch.float64):
        results = []
        for backend in ("reference", compiled):
            copy = copy_to(tree, DEVICES[backend])
            traced = Tracer(copy, LIT.transfer, gv.RenderOptions(dtype=dtype)).arguments
            args = RayArguments.of(rays.to(DEVICES[backend]))
            segments = trace_segments(args, traced, backend=backend)
            values = sample_bricks(args, traced, segments, list_samples(segments), backend=backend)
            results.append([*segments, values])
        assert len(results[0][0]) > 1000
        for expected, actual in zip(*results, strict=True):
            assert torch.equal(actual.cpu(), expected)


def test_single_and_double_agree(compiled, deep):
    """Shadows, too: a cone to the light begins at a position as precise as the eye's."""
    tree, rays = deep
    for name, shader in LOOKS.items():
        single, _ = trace(tree, compiled, rays, shader)
        double, _ = trace(tree, compiled, rays, shader, dtype=torch.float64)
        error = (single["color"].double() - double["color"]).abs().max()
        assert error < 2e-3, (name, error)


def test_a_sponge_zoomed_in_is_itself():
    """No jitter, no cracks: Menger's sponge, magnified 81 times, is the sponge, down to 10^-7."""
    point = torch.tensor([0.25, 0.75, 0.25], dtype=torch.float64)
    pictures = []
    with engine(Menger(19, 21), brick_size=9, brick_pool="64 MB") as scene:
        used = []
        for level in (2, 6, 10, 14):
            size = 3.0**-level
            low = (point / size).floor() * size
            eye, target = (
                low + size * torch.tensor(v) for v in ([0.5, 0.47, 0.52], [0.9, 0.6, 0.3])
            )
            camera = gv.Camera.look_at(
                *(tuple(eye.tolist()), tuple(target.tolist())), up=(0, 0, 1), width=48, height=48
            )
            picture = scene.render(camera, SURFACE, cone_scale=8)
            assert picture.stats.converged
            pictures.append(picture.depth.double() / size)
            used.append(picture.stats.bricks_used)
    for picture in pictures[1:]:
        error = (picture - pictures[0]).abs() / pictures[0]
        assert error.quantile(0.9) < 0.02 and error.median() < 0.003
    assert max(used) < 1.2 * min(used), "as much memory at every depth"


# --- long rays and short steps


def test_counting_goes_on_from_a_new_base(blobs, compiled):
    """After 2^23 intervals of one length: the same segments, and no interval is skipped."""
    tree = gv.N3Tree.from_volume(blobs, 4)
    rays = camera_rays(tree, 6, distance=1.3)
    results = []
    for backend in ("reference", compiled):
        copy = copy_to(tree, DEVICES[backend])
        options = gv.RenderOptions(lod="finest", dtype=torch.float64)
        traced = Tracer(copy, SHADER, options).arguments
        args = RayArguments.of(rays.to(DEVICES[backend]))
        whole = trace_segments(args, traced, backend=backend)
        state = whole.state.clone()
        count = float(MAX_INTERVALS - 3)
        enters = torch.zeros_like(state[:, 0])
        state[:, 0], state[:, 1], state[:, 2] = enters - count * traced.step, count, 0
        again = trace_segments(args, traced, state, backend=backend)
        assert int((again.interval[:, 0] == 0).sum()) > 0, "there is a new base"
        assert torch.equal(again.counts[:, 1], whole.counts[:, 1])
        torch.testing.assert_close(again.t1, whole.t1[: len(again.t1)], atol=1e-6, rtol=0)
        results.append(again)
    for expected, actual in zip(*results, strict=True):
        assert torch.equal(actual.cpu(), expected)


def test_a_ray_of_more_intervals_than_a_float_counts():
    """A haze of 2^26 intervals, too many for one base, absorbs what its closed form says."""
    world = Solid(lambda x, y, z: 1 + 0 * (x + y + z), 22)  # full
    rays = gv.Rays(
        origin=torch.tensor([[-2.0, 0.1, 0.1]], dtype=torch.float64),
        direction=torch.tensor([[1.0, 0, 0]], dtype=torch.float64),
        cone=torch.zeros((1, 2), dtype=torch.float64),
        range=torch.tensor([[0, math.inf]], dtype=torch.float64),
    )
    haze = gv.TransferFunction.from_points([(0, 0), (1, 0.3)], [(0, 1, 1, 1)], reference=1.0)
    with engine(world) as scene:
        hits = scene.render(rays, haze, lod="finest", dtype=torch.float64)
        torch.testing.assert_close(float(hits.alpha), 1 - 0.7**2, atol=1e-7, rtol=0)
        with pytest.raises(ValueError, match=r"lod='auto' takes longer ones.*float64 tells more"):
            scene.render(rays, haze, lod="finest")
        with pytest.raises(ValueError, match=r"step cuts a ray of .* \(take a longer step\)"):
            scene.render(rays, haze, step=1e-9)


def test_which_trees_are_deep():
    def deep(depth, branching=2, brick=8):
        world = Solid(ball(0.8), depth, branching)
        with engine(world, brick_size=brick, brick_pool="1 MB", node_pool="1 MB") as scene:
            tree = scene.trees["scene"].tree
            return is_deep(Tracer(tree, SURFACE, gv.RenderOptions()).arguments)

    assert not deep(15) and deep(16)
    assert not deep(7, 4) and deep(8, 4)
    assert deep(1, 3), "no float32 is a third"


def test_a_tree_deeper_than_float64_counts_is_refused(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    ray_args, traced = arguments(tree, 2)
    with pytest.raises(ValueError, match=r"branching 2, max_depth 51: over 2\^50"):
        trace_rays(ray_args, traced._replace(max_depth=51))


# --- producers


def test_local_places_are_exact_at_any_depth():
    layout = Layout(
        depth=30,
        branching=2,
        brick_size=8,
        border=1,
        extent=(8 << 30,) * 3,
        spacing=(2.0**-32, 2.0**-32, 2.0**-31),
        origin=(0.0, 0.0, 0.0),
        device=torch.device("cpu"),
    )
    loc = torch.tensor([[2**30 - 1, 3, 2**29 + 5, 30], [0, 0, 0, 0], [7, 5, 1, 3]])
    nodes = Nodes(loc, layout)
    x, y, z = nodes.local_axes
    center = nodes.center
    assert x.dtype == torch.float32 and center.dtype == torch.float64
    size = nodes.voxel_size
    for axis, local in enumerate((x, y, z)):
        steps = local.flatten(1).double() / size[:, axis, None]
        assert torch.equal(steps, torch.arange(-4.5, 5).expand(3, 10).double())
        whole = center[:, axis, None] + local.flatten(1).double()
        voxel = loc[:, axis, None] * 8 + torch.arange(-1, 9)
        exact = (voxel.double() + 0.5) * size[:, axis, None] - 0.5 * layout.spacing[axis]
        torch.testing.assert_close(whole, exact, atol=0, rtol=1e-15)
    every = nodes.local_positions
    assert every.shape == (3, 10, 10, 10, 3)
    for axis, local in enumerate((x, y, z)):
        assert torch.equal(every[..., axis], local.expand(3, 10, 10, 10))
    shallow = Nodes(loc[1:], layout)
    near = shallow.center[:, None, None, None] + shallow.local_positions
    torch.testing.assert_close(shallow.positions, near.float())
