"""Several trees in one picture, against a dense marcher in NumPy, which has no trees."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import DEVICES

import gvtorch as gv
from gvtorch.tracing import pixels

WARM = gv.TransferFunction([(0, 0), (0.1, 0), (1, 0.5)], [(0, 0.2, 0, 0), (1, 1, 0.8, 0.3)])
COLD = gv.TransferFunction([(0, 0), (0.2, 0), (1, 0.4)], [(0, 0, 0.1, 0.4), (1, 0.4, 0.9, 1)])


def blob(extent: tuple[int, int, int], spacing, origin, center, width: float) -> gv.Volume:
    """Returns a smooth ball: (z, y, x) values of a Gaussian at a world position."""
    axes = [o + s * np.arange(n) for n, s, o in zip(extent, spacing, origin, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    square = (x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2
    return gv.Volume(np.exp(-square / width**2).astype(np.float32), spacing, origin)


@pytest.fixture(scope="module")
def volumes() -> dict[str, gv.Volume]:
    """Two volumes with different spacing and position, which overlap partly."""
    return {
        "ct": blob((24, 20, 28), (1.0, 1.2, 0.9), (0.0, 0.0, 0.0), (12, 11, 12), 7.0),
        "pet": blob((9, 8, 10), (2.3, 2.1, 2.0), (7.0, 5.0, -3.0), (16, 12, 8), 6.0),
    }


def about(middle, turn: np.ndarray) -> np.ndarray:
    """Returns (4, 4): a rotation about a point."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, middle - turn @ middle
    return pose


def view(size: int = 24) -> gv.Camera:
    return gv.Camera.look_at((40, -34, 30), (12, 11, 11), (0, 0, 1), 38, size, size)


def value_at(
    volume: gv.Volume, positions: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns trilinear values (k,) at world positions (k, 3), the outermost voxels repeated to the
    box's faces, and whether they lie in the box, which has a pose (4, 4).
    """
    data = volume.data[..., 0].double().numpy()
    local = (positions - pose[:3, 3]) @ pose[:3, :3]
    grid = (local - volume.origin) / volume.spacing
    inside = ((grid >= -0.5) & (grid <= np.array(volume.extent) - 0.5)).all(1)
    grid = grid.clip(0, np.array(volume.extent) - 1)
    low = np.minimum(grid.astype(int), np.array(volume.extent) - 2)
    part = grid - low
    value = np.zeros(len(positions))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, part, 1 - part).prod(1)
        x, y, z = (low + corner).T
        value += weight * data[z, y, x]
    return value, inside


def dense(
    volumes: list[gv.Volume],
    shaders: list[gv.TransferFunction],
    poses: list[np.ndarray],
    rays: gv.Rays,
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Marches straight through all volumes at once in float64: extinctions add."""
    origin, direction = rays.origin.numpy(), rays.direction.numpy()
    clear, color = np.ones(len(origin)), np.zeros((len(origin), 3))
    for t in np.array_split(np.arange(30, 85, step) + step / 2, 50):  # NumPy likes many at once
        positions = (origin + t[:, None, None] * direction).reshape(-1, 3)
        total, glow = np.zeros((len(t), len(origin))), np.zeros((len(t), len(origin), 3))
        for volume, shader, pose in zip(volumes, shaders, poses, strict=True):
            value, inside = value_at(volume, positions, pose)
            rgba = shader(value).reshape(*total.shape, 4)
            thick = -np.log1p(-rgba[..., 3]) / min(volume.spacing) * inside.reshape(total.shape)
            total, glow = total + thick, glow + thick[..., None] * rgba[..., :3]
        alpha = -np.expm1(-total * step)
        share = alpha / np.maximum(total, 1e-300)
        for row in range(len(t)):
            color = color + (clear * share[row])[:, None] * glow[row]
            clear = clear * (1 - alpha[row])
    return color, 1 - clear


#: Poses of the second volume: axes along the world's, and turned about its middle.
POSES = {
    "straight": np.eye(4),
    "turned": about((16.0, 12.0, 8.0), np.array([[2, -2, 1], [1, 2, 2], [-2, -1, 2]]) / 3),
}


@pytest.fixture(scope="module")
def composited(volumes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What the dense marcher shows of both volumes, by the second one's pose."""
    both, shaders, rays = [*volumes.values()], [WARM, COLD], view(10).rays()
    poses = {name: [np.eye(4), pose] for name, pose in POSES.items()}
    return {name: dense(both, shaders, pair, rays, 0.02) for name, pair in poses.items()}


@pytest.mark.parametrize(
    "backend", [pytest.param(b, marks=pytest.mark.backend(b)) for b in DEVICES]
)
@pytest.mark.parametrize("pose", POSES)
def test_trees_that_overlap_are_composited_by_sample_as_by_a_dense_marcher(
    volumes, composited, pose, backend
):
    size, step = 10, 0.5 if backend == "reference" else 0.05
    trees = {
        name: gv.N3Tree.from_volume(volume, 8, device=DEVICES[backend])
        for name, volume in volumes.items()
    }
    shaders = {"ct": WARM, "pet": COLD}
    actual = gv.render(
        *(trees, view(size), shaders),
        step=step,
        lod="finest",
        stop_alpha=1,
        dtype=torch.float64,
        backend=backend,
        pose={"pet": POSES[pose]},
    )
    poses = [np.eye(4), POSES[pose]]
    color, alpha = composited[pose]
    worst = 1e-4 if step < 0.1 else 4e-3
    assert np.abs(actual.color.cpu().numpy().reshape(-1, 3) - color).max() < worst
    assert np.abs(actual.alpha.cpu().numpy().ravel() - alpha).max() < worst
    separate = [
        gv.render(trees[n], view(size), shaders[n], lod="finest", pose=p)
        for n, p in zip(trees, poses, strict=True)
    ]
    both = (separate[0].alpha > 0.1) & (separate[1].alpha > 0.1)
    assert both.float().mean() > 0.05, "they are seen through each other"


def pictures(volumes, shaders, order=("ct", "pet"), size=24, **options) -> gv.Picture:
    trees = {name: gv.N3Tree.from_volume(volumes[name], 8) for name in order}
    return gv.render(trees, view(size), shaders, **options)


@pytest.mark.backend("cpp")
def test_the_order_of_trees_does_not_matter(volumes):
    shaders = {"ct": gv.Lit(WARM), "pet": COLD}
    a, b = (pictures(volumes, shaders, order) for order in (("ct", "pet"), ("pet", "ct")))
    for name in ("color", "alpha", "depth", "normal"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=1e-6, rtol=1e-6)
    assert torch.equal(a.samples, b.samples)
    assert (a.normal.norm(dim=-1) > 0.9).any()


@pytest.mark.backend("cpp")
def test_a_medium_twice_in_the_same_place_has_twice_the_extinction(volumes):
    """The ends of intervals coincide up to rounding; the slivers between must not matter."""
    volume = volumes["ct"]
    trees = {name: gv.N3Tree.from_volume(volume, 8) for name in ("a", "b")}
    for lod in ("auto", "finest"):
        options = {"lod": lod, "stop_alpha": 1}
        twice = gv.render(trees, view(), WARM, **options)
        once = gv.render(trees["a"], view(), WARM, **options)
        torch.testing.assert_close(1 - twice.alpha, (1 - once.alpha) ** 2, atol=4e-3, rtol=0)
        seen = once.alpha > 0.01
        assert seen.float().mean() > 0.2
        assert bool((twice.depth[seen] <= once.depth[seen] + 1e-4).all())


@pytest.mark.backend("cpp")
def test_depth_is_where_both_together_pass_it(volumes):
    """As steps get finer, the depth converges to that of the dense marcher's light."""
    both = {"ct": WARM, "pet": COLD}
    fine = pictures(volumes, both, step=0.02, lod="finest", stop_alpha=1)
    usual = pictures(volumes, both)
    rays = view().rays()
    depth = fine.depth.ravel().double()
    hit = depth < torch.inf
    assert hit.float().mean() > 0.1
    cut = gv.Rays(
        origin=rays.origin[hit],
        direction=rays.direction[hit],
        cone=rays.cone[hit],
        range=torch.stack((torch.zeros(int(hit.sum())), depth[hit]), 1).double(),
    )
    trees = {name: gv.N3Tree.from_volume(volumes[name], 8) for name in volumes}
    front = gv.trace(trees, cut, both, step=0.02, lod="finest", stop_alpha=1)
    assert (front.alpha - 0.1).abs().max() < 2e-3, "a tenth of the light is gone there"
    far = (usual.depth.ravel().double()[hit] - depth[hit]).abs()
    assert far.median() < 0.1 and bool((far < 2).all())


@pytest.mark.backend("cpp")
def test_a_surface_among_media_ends_the_ray_for_all(volumes):
    """The surface hides what is behind it, and is dimmed by what is in front of it."""
    trees = {name: gv.N3Tree.from_volume(volumes[name], 8) for name in volumes}
    surface = gv.Isosurface(0.6)
    actual = gv.render(trees, view(), {"ct": surface, "pet": COLD}, lod="finest", step=0.1)
    alone = gv.render(trees["ct"], view(), surface, lod="finest", step=0.1)
    depth = alone.depth.ravel().double()
    hit = depth < torch.inf
    rays = view().rays()
    limits = torch.stack((torch.zeros_like(depth), depth), 1)
    front = gv.trace(
        trees["pet"],
        gv.Rays(origin=rays.origin, direction=rays.direction, cone=rays.cone, range=limits),
        COLD,
        lod="finest",
        step=0.1,
    )
    expected = front.color + (1 - front.alpha) * alone.color.reshape(-1, 3) * hit[:, None]
    torch.testing.assert_close(actual.color.reshape(-1, 3), expected, atol=2e-5, rtol=0)
    assert (actual.alpha.ravel()[hit] == 1).all() and 20 < int(hit.sum()) < len(hit)
    assert bool((front.alpha[hit] > 0.05).any())


@pytest.mark.backend("cpp")
def test_a_layer_and_a_clip_cut_trees_that_overlap(volumes):
    shaders = {"ct": WARM, "pet": COLD}
    half = gv.Clip(planes=[(1, 0, 0, -12)])
    clipped = pictures(volumes, shaders, clip=half, stop_alpha=1)
    assert (
        0.05
        < (clipped.alpha > 0.02).float().mean()
        < (pictures(volumes, shaders, stop_alpha=1).alpha > 0.02).float().mean()
    )
    size = view().height
    wall = torch.full((size, size, 1), 45.0)
    layer = gv.Layer(torch.ones(size, size, 3), wall)
    drawn = pictures(volumes, shaders, layer=layer, stop_alpha=1)
    rays = view().rays()
    limits = torch.stack((torch.zeros(len(rays.origin)), torch.full((len(rays.origin),), 45.0)), 1)
    trees = {name: gv.N3Tree.from_volume(volumes[name], 8) for name in volumes}
    front = gv.trace(
        trees,
        gv.Rays(
            origin=rays.origin, direction=rays.direction, cone=rays.cone, range=limits.double()
        ),
        shaders,
        stop_alpha=1,
    )
    expected = front.color + (1 - front.alpha)
    torch.testing.assert_close(drawn.color.reshape(-1, 3), expected, atol=0.02, rtol=0)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("brick_pool", ["8 MB", "120 kB"])
@pytest.mark.backend("cpp")
def test_streamed_trees_that_overlap_equal_resident_ones(volumes, brick_pool, pose):
    shaders, poses = {"ct": WARM, "pet": gv.Lit(COLD)}, {"pet": POSES[pose]}
    resident = pictures(volumes, shaders, size=12, pose=poses)
    scene = {name: gv.VolumeProducer(volume) for name, volume in volumes.items()}
    with gv.Engine(scene, brick_pool=brick_pool) as engine:
        streamed = engine.render(view(12), shaders, pose=poses)
        engine.validate()
        assert streamed.stats.converged
        if engine.cache.bricks.capacity < 30:
            assert streamed.stats.capacity_exceeded, "rays took turns"
    for name in ("color", "alpha", "depth", "normal", "samples"):
        assert torch.equal(getattr(streamed, name), getattr(resident, name)), name


@pytest.mark.backend("cpp")
def test_rays_that_have_ended_ask_for_nothing_behind(volumes):
    """An opaque ball in the middle: what lies behind it in the other tree is not loaded."""
    solid = gv.TransferFunction([(0.2, 0), (0.25, 1)])
    faint = gv.TransferFunction([(0, 0.01)])
    big = gv.Volume(np.random.default_rng(1).random((64, 64, 64), np.float32), (0.4,) * 3)
    scene = {"ball": gv.VolumeProducer(volumes["ct"]), "all": gv.VolumeProducer(big)}
    camera = gv.Camera.look_at((12, 11, 60), (12, 11, 12), (0, 1, 0), 4, 16, 16)
    with gv.Engine(scene, brick_pool="16 MB") as engine:
        picture = engine.render(camera, {"ball": solid, "all": faint})
        assert (picture.alpha > 0.99).all()
        tree = engine.trees["all"].tree
        tiles = (engine.cache.nodes.tree_t == tree.number).nonzero()[:, 0]
        nodes = (tiles[:, None] * 8 + torch.arange(8)).flatten()
        loaded = nodes[engine.cache.nodes.brick_tn.view(-1)[nodes] >= 0]
        loc = tree.loc(loaded)
        finest = loc[loc[:, 3] == tree.depth]
        z = finest[:, 2].double() * 8 * 0.4
    assert len(finest) > 4 and z.max() > 20
    assert z.min() > 5, "the far side of the ball's tree"


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda t: gv.render({}, view(), WARM), "there must be a tree"),
        (lambda t: gv.render({"ct": t}, view(), {"pt": WARM}), "shader of tree 'ct'"),
        (lambda t: gv.render(t, view(), {"ct": WARM}), "shaders by name"),
        (lambda t: gv.render({"ct": 3}, view(), WARM), "expected a volume or an array"),
        (lambda t: gv.render({"ct": t}, view(), WARM, channel="x"), "'x'; tree 'ct' has"),
    ],
)
@pytest.mark.backend("cpp")
def test_mistakes_are_told_in_a_line(volumes, make, message):
    tree = gv.N3Tree.from_volume(volumes["pet"], 8)
    with pytest.raises(ValueError, match=message) as error:
        make(tree)
    assert "\n" not in str(error.value)


@pytest.mark.backend("cpp")
def test_what_some_blocks_of_rays_lack_is_nothing(volumes, monkeypatch):
    """Features of rays that meet nothing are 0, also if a block has only such rays."""
    monkeypatch.setattr(pixels, "_RAYS_PER_REPORT", 32)
    trees = {
        name: gv.N3Tree.from_volume(
            {"value": v, "more": gv.Volume(v.data + 1, v.spacing, v.origin)}
        )
        for name, v in volumes.items()
    }
    shader = gv.Features(WARM, "more")
    cameras = [view(16), gv.Camera.look_at((200, 0, 0), (300, 0, 0), (0, 0, 1), 38, 16, 16)]
    both = gv.Camera(
        torch.cat([v.viewmats for v in cameras]), torch.cat([v.Ks for v in cameras]), 16, 16
    )
    picture = gv.render(trees, both, shader, progress=lambda *_: None)
    assert float(picture.features[0].max()) > 0 and not picture.features[1].any()
    for index, camera in enumerate(cameras):
        alone = gv.render(trees, camera, shader)
        assert torch.equal(picture.features[index], alone.features)


def test_pre_integrated_media_overlap_as_others_do(volumes):
    trees = {name: gv.N3Tree.from_volume(volume) for name, volume in volumes.items()}
    fine = gv.render(trees, view(), {"ct": WARM, "pet": COLD}, step=0.1, lod="finest")
    shaders = {"ct": gv.PreIntegrated(WARM), "pet": gv.PreIntegrated(COLD)}
    actual = gv.render(trees, view(), shaders, step=0.5, lod="finest")
    assert float((actual.color - fine.color).abs().max()) < 0.01 < float(fine.color.max())


def test_labels_are_told_among_media(volumes):
    """A segmentation in another volume's smooth ball has the labels that it has alone."""
    values = volumes["ct"].data[..., 0]
    numbers = (values > 0.3).long() * 700_000_000_001 + (values > 0.7).long()
    labels = gv.Volume(numbers, volumes["ct"].spacing, volumes["ct"].origin, labels=True)
    trees = {
        "labels": gv.N3Tree.from_volume(labels, 8),
        "pet": gv.N3Tree.from_volume(volumes["pet"], 8),
    }
    shaders = {"labels": gv.Labels(), "pet": COLD}
    actual = gv.render(trees, view(), shaders)
    alone = gv.render(trees["labels"], view(), shaders["labels"])
    faint = gv.TransferFunction([(0, 1e-9)])
    through = gv.render(trees, view(), {**shaders, "pet": faint})
    assert sorted(set(alone.label.unique().tolist())) == [-1, 700_000_000_001]
    same = (through.label == alone.label).float().mean()
    assert same > 0.99, "but for pixels at the edge"
    hidden = (actual.label == -1) & (alone.label > 0)
    assert ((actual.label == alone.label) | hidden).float().mean() > 0.99
    assert (actual.label > 0).float().mean() > 0.05


@pytest.mark.backend("cpp")
def test_of_surfaces_the_nearest_is_seen(volumes):
    """Also where one has colours of a transfer function without opacity."""
    trees = {name: gv.N3Tree.from_volume(volumes[name], 8) for name in volumes}
    hue = gv.TransferFunction([(0, 0)], [(0, 1, 0, 0), (1, 0, 0, 1)])
    shaders = {"ct": gv.Isosurface(0.5, hue, color_channel="value"), "pet": gv.Isosurface(0.4)}
    actual = gv.render(trees, view(), shaders)
    ct, pet = (gv.render(trees[name], view(), shaders[name]) for name in trees)
    nearest = torch.where(ct.depth <= pet.depth, ct.color, pet.color)
    assert torch.equal(actual.color, nearest)
    assert torch.equal(actual.depth, torch.minimum(ct.depth, pet.depth))
    hit = [picture.depth < torch.inf for picture in (ct, pet)]
    assert (hit[0] & hit[1]).any(), "they overlap in the picture"
    assert (hit[0] & (ct.depth < pet.depth)).any() and (hit[1] & (pet.depth < ct.depth)).any()
