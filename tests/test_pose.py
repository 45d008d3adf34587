"""Trees that are turned in the world (`RenderOptions.pose`): a camera and lights that are turned
with them see the same picture.
"""

from __future__ import annotations

import warnings
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.shaders import SHADERS
from helpers.traces import SHADER
from helpers.trees import copy_to

import gvtorch as gv
from gvtorch.tracing.pose import Pose

DEGREES = (20, -35, 50)
BACKENDS = [pytest.param(b, marks=pytest.mark.backend(b)) for b in DEVICES]


def matrix_of(degrees=DEGREES, shift=(30.0, -12.0, 7.0), mirrored: bool = False) -> np.ndarray:
    """Returns (4, 4): a rotation about x, then y, then z, and a shift."""
    matrix = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0, 1.0])
    for axis, angle in enumerate(np.radians(degrees)):
        a, b = [n for n in range(3) if n != axis]
        rotation = np.eye(4)
        rotation[[a, b], [a, b]] = np.cos(angle)
        rotation[a, b], rotation[b, a] = -np.sin(angle), np.sin(angle)
        matrix = rotation @ matrix
    matrix[:3, 3] = shift
    return matrix


POSES = {
    "a shift": matrix_of((0, 0, 0)),
    "a turn": matrix_of(),
    "a mirror": matrix_of(mirrored=True),
}


def turned(matrix: np.ndarray, vectors: torch.Tensor) -> torch.Tensor:
    return vectors.double() @ torch.from_numpy(matrix[:3, :3]).T


def rays_in_the_world(matrix: np.ndarray, rays: gv.Rays) -> gv.Rays:
    """Returns rays that see in the world what `rays` see in the tree's axes."""
    rays64 = rays.to(dtype=torch.float64)
    origin = turned(matrix, rays64.origin) + torch.from_numpy(matrix[:3, 3])
    return replace(rays64, origin=origin, direction=turned(matrix, rays64.direction))


def light_in_the_world(matrix: np.ndarray, shader: gv.Shader) -> gv.Shader:
    """Returns the shader, its light turned with the tree."""
    light = getattr(shader, "light", None)
    if isinstance(light, gv.DirectionalLight):
        light = replace(light, direction=(matrix[:3, :3] @ light.direction).tolist())
    elif isinstance(light, gv.PointLight):
        light = replace(light, position=(matrix @ (*light.position, 1.0))[:3].tolist())
    else:
        return shader
    copied = copy(shader)
    copied.light = light
    return copied


def camera(tree: gv.N3Tree, size: int = 20) -> gv.Rays:
    return gv.Camera.orbit(30, 25, 1.6, None, size, size).placed(tree.box).rays()


def assert_same_picture(actual: gv.Hits, expected: gv.Hits, matrix: np.ndarray, **near) -> None:
    """Asserts equal hits, except for the normals, which are turned with the tree."""
    for name in ("color", "alpha", "depth", "features"):
        x, y = (getattr(hits, name) for hits in (actual, expected))
        if y is not None:
            torch.testing.assert_close(x, y, **near)
    if expected.normal is not None:
        normal = turned(matrix, expected.normal.cpu()).to(actual.normal)
        torch.testing.assert_close(actual.normal, normal, **near)
    for name in ("samples", "label"):
        if getattr(expected, name) is not None:
            assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def some(hits: gv.Hits, mask: torch.Tensor) -> gv.Hits:
    """Returns the hits of some rays, (r,) bool."""
    return replace(
        hits, **{n: t[mask.to(t.device)] for n, t in vars(hits).items() if t is not None}
    )


NEAR = {"atol": 1e-9, "rtol": 1e-9}  # for float64


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", SHADERS)
def test_a_tree_that_is_turned_is_seen_by_a_camera_that_is_turned(tree_of_channels, name, backend):
    tree = copy_to(tree_of_channels, DEVICES[backend])
    rays, shader = camera(tree, 8 if backend == "reference" else 20), SHADERS[name]
    options = {"dtype": torch.float64, "backend": backend}
    if backend == "reference":
        options["step"] = 2.6
    expected = gv.trace(tree, rays.to(tree.device), shader, **options)
    assert (expected.alpha > 0.1).any()
    for matrix in POSES.values() if backend != "reference" else [POSES["a mirror"]]:
        world = rays_in_the_world(matrix, rays).to(tree.device)
        lit = light_in_the_world(matrix, shader)
        actual = gv.trace(tree, world, lit, pose=matrix, **options)
        same = (actual.samples == expected.samples).cpu()  # by rounding, a ray may graze a face
        assert same.float().mean() > 0.95
        assert_same_picture(*(some(hits, same) for hits in (actual, expected)), matrix, **NEAR)


@pytest.fixture
def tree(blobs) -> gv.N3Tree:
    return gv.N3Tree.from_volume(blobs, 4)


SUN = gv.DirectionalLight((1.0, -1.0, -2.0))


@pytest.mark.backend("cpp")
def test_clip_lens_and_lighting_stay_in_the_world(tree):
    """They are in world units, whatever the pose; here they are turned with the tree."""
    rays, matrix = camera(tree), matrix_of()
    world = rays_in_the_world(matrix, rays)
    middle = tree.box.mean(0).numpy()
    normal = np.array([0.6, 0.0, 0.8])
    out = matrix[:3, :3] @ normal
    faces = {
        "own": (*normal, -normal @ middle),
        "world": (*out, -normal @ middle - out @ matrix[:3, 3]),
    }
    suns = {"own": SUN, "world": light_in_the_world(matrix, gv.Lit(SHADER, light=SUN)).light}
    for caps in (False, True):
        for lighting in (False, True):
            hits = {}
            for frame, traced in (("own", rays), ("world", world)):
                options = {
                    "clip": gv.Clip(planes=[faces[frame]], caps=caps),
                    "dtype": torch.float64,
                    "pose": matrix if frame == "world" else None,
                }
                if lighting:
                    options["lighting"] = gv.Lighting(lights=[suns[frame]], shadows=True)
                hits[frame] = gv.trace(tree, traced, gv.Lit(SHADER, light=suns[frame]), **options)
            assert (hits["own"].alpha > 0.1).any()
            torch.testing.assert_close(hits["world"].color, hits["own"].color, atol=1e-5, rtol=0)
    lens = gv.ThinLens(aperture=2.0, focus=40.0)
    blurred = [
        gv.trace(tree, traced, SHADER, lens=lens, dtype=torch.float64, pose=pose)
        for traced, pose in ((rays, None), (world, matrix))
    ]
    torch.testing.assert_close(blurred[1].color, blurred[0].color, atol=1e-9, rtol=0)


@pytest.mark.backend("cpp")
def test_a_module_shader_is_told_places_and_ways_of_the_world(tree):
    seen: list[torch.Tensor] = []

    class Told(torch.nn.Module):
        def forward(self, values, positions, directions, lengths):
            seen.extend((positions, directions))
            return values.expand(-1, 3), values.clamp(0, 1) * 0.2

    rays, matrix = camera(tree, 6), matrix_of()
    shader = gv.ModuleShader(Told())
    options = {"dtype": torch.float64, "stop_alpha": 1}
    expected = gv.trace(tree, rays, shader, **options)
    actual = gv.trace(tree, rays_in_the_world(matrix, rays), shader, pose=matrix, **options)
    torch.testing.assert_close(actual.color, expected.color, **NEAR)
    tree_positions, tree_directions, world_places, world_ways = seen
    shift = torch.from_numpy(matrix[:3, 3])
    torch.testing.assert_close(world_places, turned(matrix, tree_positions) + shift, **NEAR)
    torch.testing.assert_close(world_ways, turned(matrix, tree_directions), **NEAR)


@pytest.mark.parametrize("shader", [SHADER, gv.Lit(SHADER), gv.Projection("mean", SHADER)])
@pytest.mark.backend("cpp")
def test_streamed_equals_resident_and_an_orbit_camera_stands_around_it(blobs, shader):
    matrix = matrix_of(shift=(300.0, 0.0, 0.0))
    view = gv.Camera.orbit(40, 20, None, None, 48, 32)
    resident = gv.render(gv.N3Tree.from_volume(blobs), view, shader, pose=matrix)
    assert 0.01 < (resident.alpha > 0.05).float().mean() < 0.9
    edge = torch.cat([resident.alpha[0], resident.alpha[-1], *resident.alpha[:, [0, -1]]])
    assert bool((edge == 0).all()), "all of the turned box is in the picture"
    with gv.Engine(gv.VolumeProducer(blobs), brick_pool="4 MB") as engine:
        streamed = engine.render(view, shader, pose=matrix)
        other = engine.render(view, shader)
    assert torch.equal(streamed.color, resident.color)
    assert torch.equal(streamed.depth, resident.depth)
    assert not torch.equal(other.color, streamed.color)


@pytest.mark.backend("cpp")
def test_a_cost_counts_what_the_picture_samples(tree):
    view = gv.Camera.orbit(40, 20, None, None, 24, 16)
    picture = gv.render(tree, view, SHADER, pose=matrix_of())
    assert torch.equal(gv.cost(tree, view, SHADER, pose=matrix_of()).samples, picture.samples)


@pytest.mark.parametrize(
    "pose, message",
    [
        (np.diag([2.0, 1, 1, 1]), "neither stretch nor shear"),
        (np.eye(3), r"pose must be \(4, 4\)"),
        (np.full((4, 4), np.nan), "finite"),
        ("up", "numbers"),
        ({"a": np.eye(4)}, "poses by name are for trees by name"),
        (torch.eye(4, requires_grad=True), "gradient"),
    ],
)
def test_what_is_no_pose_is_told_in_a_line(tree, pose, message):
    with pytest.raises((ValueError, RuntimeError), match=message) as error:
        gv.render(tree, gv.Camera.orbit(0, 0, None, None, 8, 8), SHADER, pose=pose)
    assert "\n" not in str(error.value)


def test_poses_by_name_are_refused_by_the_function_that_was_called(tree):
    view, pose = gv.Camera.orbit(0, 0, None, None, 8, 8), {"a": np.eye(4)}
    rays = view.placed(tree.box).rays()
    for name, call in {
        "render": lambda: gv.render(tree, view, SHADER, pose=pose),
        "trace": lambda: gv.trace(tree, rays, SHADER, pose=pose),
        "cost": lambda: gv.cost(tree, view, SHADER, pose=pose),
    }.items():
        with pytest.raises(ValueError, match=f"^{name}: poses by name are for trees by name"):
            call()


def test_poses_of_several_trees_go_by_name(tree):
    view = gv.Camera.orbit(0, 0, None, None, 8, 8)
    trees = {"a": tree, "b": tree}
    with pytest.raises(ValueError, match="by name"):
        gv.render(trees, view, SHADER, pose=np.eye(4))
    with pytest.raises(ValueError, match="no such tree; there is a, b"):
        gv.render(trees, view, SHADER, pose={"c": np.eye(4)})


def test_a_box_that_is_turned_lies_in_the_box_around_it():
    box = torch.tensor([[-1.0, 2, 3], [4, 5, 9]], dtype=torch.float64)
    pose = Pose.of("test", "pose", matrix_of())
    around = pose.box(box)
    inside = box[0] + torch.rand(1000, 3, dtype=torch.float64) * (box[1] - box[0])
    placed = pose.world_positions(inside)
    assert bool(((placed >= around[0]) & (placed <= around[1])).all())
    assert bool((placed.amax(0) > around[1] - 2).all())
    assert bool((placed.amin(0) < around[0] + 2).all())


def test_voxels_that_are_kept_tell_how_to_turn_them(tmp_path):
    """The pose of a file's oblique voxels moves them to the positions that the file states."""
    nibabel = pytest.importorskip("nibabel")
    for mirrored in (False, True):
        affine = matrix_of(mirrored=mirrored) @ np.diag([0.7, 1.0, 1.6, 1.0])
        data = np.random.default_rng(0).random((5, 6, 7)).astype(np.float32)
        nibabel.save(nibabel.Nifti1Image(data, affine), tmp_path / "a.nii")
        for origin in (None, (1.0, 2.0, 3.0)):
            with pytest.warns(UserWarning, match="info.pose turns them"):
                volume = gv.read_volume(tmp_path / "a.nii", oblique="keep", origin=origin)
            pose = Pose.of("test", "pose", volume.info.pose)
            index = torch.tensor([[0, 0, 0], [4, 5, 6], [2, 0, 5]], dtype=torch.float64)
            local = index * torch.tensor(volume.spacing) + torch.tensor(volume.origin)
            expected = index.numpy() @ affine[:3, :3].T + (
                affine[:3, 3] if origin is None else origin
            )
            np.testing.assert_allclose(pose.world_positions(local).numpy(), expected, atol=1e-5)
            assert np.array_equal(volume.data[..., 0].numpy(), data.T)
        assert volume.info.describe()["pose"]
        store = gv.convert(volume, tmp_path / f"{mirrored}.zarr")
        assert store.info.pose == gv.read_volume(store.location).info.pose == volume.info.pose
    sheared = affine.copy()
    sheared[:3, 0] += 0.3 * sheared[:3, 1]
    nibabel.save(nibabel.Nifti1Image(data, sheared), tmp_path / "a.nii")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert gv.read_volume(tmp_path / "a.nii", oblique="keep").info.pose is None
