"""Colours and opacities seen from six directions, against independent filters and rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.marcher import trilinear
from helpers.rays import rays_along

import gvtorch as gv
from gvtorch.base.downsample import pool_directional
from gvtorch.base.volume import DIRECTIONS
from gvtorch.io.stores.conversion import convert
from gvtorch.pool.pyramid import volume_levels

RED, GREEN = (1.0, 0.1, 0.0), (0.0, 0.9, 0.2)
SIZES = {"brick_size": 4, "border": 1}


def wall(side: int, column: int, spacing=(1.0, 1.0, 1.0)) -> gv.Volume:
    """Returns an opaque wall of two voxels across x: red at `column`, green behind it."""
    rgba = torch.zeros((side, side, side, 4))
    rgba[:, :, column] = torch.tensor((*RED, 1.0))
    rgba[:, :, column + 1] = torch.tensor((*GREEN, 1.0))
    return gv.Volume(rgba, spacing)


def straight(device: str, direction, cone: float, box: torch.Tensor, grid: int = 3) -> gv.Rays:
    """Returns rays of one direction and one width through points around the box's centre."""
    along = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    side = (box[1] - box[0]).max()
    shift = torch.cartesian_prod(*(torch.linspace(-0.2, 0.2, grid).double() for _ in "xyz")) * side
    origin = box.mean(0) + shift - 2 * side * along
    return rays_along(origin, along, cone, device)


def shoot(volume: gv.Volume, backend: str, direction, cone: float, branching: int = 2, **options):
    """Returns the hits of straight rays of one width, in float64."""
    return shoot_at(planted(volume, backend, branching), backend, direction, cone, **options)


def planted(volume: gv.Volume, backend: str, branching: int) -> gv.N3Tree:
    return gv.N3Tree.from_volume(volume, **SIZES, branching=branching, device=DEVICES[backend])


def shoot_at(tree: gv.N3Tree, backend: str, direction, cone: float, **options):
    rays = straight(DEVICES[backend], direction, cone, tree.box)
    options |= {"backend": backend, "dtype": torch.float64, "cone_scale": 1.0, "stop_alpha": 1.0}
    hits = gv.trace(tree, rays, gv.StoredColor("value", premultiplied=True), **options)
    return hits.color.cpu().numpy(), hits.alpha[:, 0].cpu().numpy()


# --- the filter


def composited(rgba: np.ndarray, lengths: float) -> np.ndarray:
    """Returns (4,): premultiplied colour and alpha of voxels (k, 4), composited front to back."""
    color, clear = np.zeros(3), 1.0
    for red, green, blue, opacity in rgba:
        alpha = 1 - (1 - opacity) ** lengths
        straight_color = np.array([red, green, blue]) / opacity
        color = color + clear * alpha * straight_color
        clear *= 1 - alpha
    return np.array([*color, 1 - clear])


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (6.0, 2.0, 3.5)])
@pytest.mark.parametrize("factor", [2, 3])
def test_a_voxel_is_what_its_columns_show_on_average(factor, sides):
    random = np.random.default_rng(1)
    fine = random.uniform(0.05, 0.9, (2 * factor - 1, factor, factor, 24))
    coarse = pool_directional(fine, factor, sides)
    assert coarse.shape == (2, 1, 1, 24)
    whole = np.concatenate((fine, fine[-1:]))  # the last voxel repeated
    for block in range(2):
        part = whole[factor * block : factor * (block + 1)]
        for number, name in enumerate(DIRECTIONS):
            axis = 2 - "xyz".index(name[1])
            columns = np.moveaxis(part[..., 4 * number : 4 * number + 4], axis, 0)
            columns = columns if name[0] == "+" else columns[::-1]
            seen = [
                composited(columns[:, i, j], sides[axis]) for i, j in np.ndindex(factor, factor)
            ]
            *color, alpha = np.mean(seen, 0)
            opacity = 1 - (1 - alpha) ** (1 / (factor * sides[axis]))
            expected = np.array([*(np.array(color) / alpha * opacity), opacity])
            actual = coarse[block, 0, 0, 4 * number : 4 * number + 4]
            np.testing.assert_allclose(actual, expected, rtol=1e-12)


@pytest.mark.parametrize("branching", [2, 3])
def test_a_wall_stays_opaque_and_each_side_keeps_its_colour(branching):
    side = branching**3
    volume = wall(side, branching).directional(dtype=torch.float32)
    levels = volume_levels(volume, 4, branching=branching, **SIZES)
    across = 1.0  # alpha of a voxel with the wall in it, seen along the wall
    for number, level in enumerate(levels):
        rgba = level.values.clone().unflatten(-1, (6, 4))
        x = branching // branching**number  # where the voxels with the wall are
        if number:
            assert torch.equal(
                rgba[..., x, 0, :], torch.tensor((*RED, 1.0)).expand_as(rgba[..., x, 0, :])
            )
            assert torch.equal(rgba[..., x, 1, 3], torch.ones_like(rgba[..., x, 1, 3]))
            green = torch.tensor(GREEN).expand_as(rgba[..., x, 1, :3])
            torch.testing.assert_close(rgba[..., x, 1, :3], green)
            filled = 2 if number == 1 else 1
            across = filled / branching * (1 - (1 - across) ** branching)
            expected = 1 - (1 - across) ** (1 / branching**number)
            for direction in range(2, 6):
                seen = rgba[..., x, direction, :]
                torch.testing.assert_close(seen[..., 3], torch.full_like(seen[..., 3], expected))
            if number == 1:
                mean = torch.tensor([(a + b) / 2 for a, b in zip(RED, GREEN, strict=True)])
                torch.testing.assert_close(
                    seen[..., :3] / seen[..., 3:], mean.expand_as(seen[..., :3])
                )
        rgba[..., x, :, :] = 0
        if number == 0:
            rgba[..., x + 1, :, :] = 0
        assert not rgba.any(), "nothing but the wall is seen"


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 0.8, 1.5)])
def test_a_homogeneous_medium_is_the_same_at_every_level(spacing, dtype):
    medium = gv.Volume(torch.tensor([0.2, 0.5, 0.7, 0.3]).expand(9, 9, 9, 4), spacing)
    volume = medium.directional(dtype=dtype)
    for level in volume_levels(volume, 5, branching=2, **SIZES):
        expected = volume.data[:1, :1, :1].float().expand_as(level.values)
        tolerance = {"rtol": 4 * torch.finfo(dtype).eps, "atol": 0}
        torch.testing.assert_close(level.values.float(), expected, **tolerance)


# --- rays


@pytest.mark.parametrize("branching", [2, 3])
def test_no_light_leaks_through_a_wall_and_its_sides_do_not_mix(backend, branching):
    side = 4 * branching**2
    plain = wall(side, side // 2 - branching)
    six = planted(plain.directional(), backend, branching)
    for level in (1, 2):
        cone = float(branching**level)
        for direction, color in (((1, 0, 0), RED), ((-1, 0, 0), GREEN)):
            seen, alpha = shoot_at(six, backend, direction, cone)
            assert alpha.min() > 0.99
            np.testing.assert_allclose(seen / alpha[:, None], [color] * len(seen), atol=1e-3)
        for direction, near in (((1, 0.9, 0), 0), ((-1, 0.7, -0.5), 1)):
            seen, alpha = shoot_at(six, backend, direction, cone)
            assert alpha.min() > 0.85, "a sample takes what lies half a voxel beside the wall"
            assert (seen[:, near] > 1.5 * seen[:, 1 - near]).all(), "its own side's colour prevails"
    seen, alpha = shoot(plain, backend, (1, 0, 0), cone, branching)
    assert alpha.max() < 0.97 and seen[:, 1].min() > 0.3, "means leak, and mix red with green"


@pytest.mark.parametrize("branching", [2, 3])
def test_a_homogeneous_medium_is_that_of_one_direction(backend, branching):
    side = 4 * branching**2
    medium = gv.Volume(torch.tensor([0.2, 0.5, 0.7, 0.06]).expand(side, side, side, 4))
    six = medium.directional(dtype=torch.float32)
    ramp = torch.linspace(0.2, 1.0, side)[:, None]  # along y: no node is CONSTANT
    medium.data, six.data = medium.data * ramp, six.data * ramp
    single = gv.Volume(six.data[..., :4])
    for cone in (0.0, 1.3):
        direction = (1.0, 0.0, 0.4)
        (color, alpha), (same_color, same_alpha) = (
            shoot(volume, backend, direction, cone, branching) for volume in (single, six)
        )
        assert 0.1 < alpha.min() and alpha.max() < 0.99
        tolerance = 0 if cone == 0 else 0.02
        np.testing.assert_allclose(same_color, color, atol=tolerance)
        np.testing.assert_allclose(same_alpha, alpha, atol=tolerance)


@pytest.mark.parametrize("direction", [(1, 0.5, 0.3), (-1, 2, 0.3), (0.2, -0.5, -3), (-1, -1, 1)])
def test_a_ray_sees_the_three_directions_that_it_goes_along(backend, direction):
    """The six directions differ in the finest voxels, too; nothing is visible along +x."""
    random = np.random.default_rng(2)
    data = random.uniform(0, 0.3, (8, 8, 8, 24)).astype(np.float32)
    data[..., :4] = 0
    seen, alpha = shoot(gv.Volume(data), backend, direction, 0.0, lod="finest", step=0.7)
    rays = straight("cpu", direction, 0.0, torch.tensor([[-0.5] * 3, [7.5] * 3]))
    d = rays.direction[0].numpy()
    for ray, origin in enumerate(rays.origin.numpy()):
        with np.errstate(divide="ignore"):
            low, high = (-0.5 - origin) / d, (7.5 - origin) / d
        near, far = np.minimum(low, high).max(), np.maximum(low, high).min()
        color, clear = np.zeros(3), 1.0
        starts = near + 0.7 * np.arange(int(np.ceil((far - near) / 0.7)))
        ends = np.minimum(starts + 0.7, far)
        positions = origin + ((starts + ends) / 2)[:, None] * d
        samples = np.zeros((len(starts), 4))
        for axis in range(3):
            first = 4 * (2 * axis + int(d[axis] < 0))
            values = [trilinear(data[..., first + i], positions) for i in range(4)]
            samples += d[axis] ** 2 * np.stack(values, 1)
        for rgba, length in zip(samples, ends - starts, strict=True):
            share = 1 - (1 - rgba[3]) ** length
            color += clear * share * rgba[:3] / rgba[3]
            clear *= 1 - share
        np.testing.assert_allclose(seen[ray], color, rtol=1e-5)
        np.testing.assert_allclose(alpha[ray], 1 - clear, rtol=1e-5)


# --- what is refused


def rgba(value: float = 0.5, channels: int = 4, dtype=torch.float32) -> gv.Volume:
    return gv.Volume(torch.full((4, 4, 4, channels), value).to(dtype))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: rgba(channels=3).directional(),
            "needs red, green, blue and opacity, got 3 numbers",
        ),
        (lambda: rgba(1.5).directional(), "opacity must lie in 0 to 1, got 1.5 to 1.5"),
        (lambda: rgba(-0.5).directional(), "opacity must lie in 0 to 1, got -0.5 to -0.5"),
        (
            lambda: rgba().directional(dtype=torch.uint8),
            "dtype must be float16, bfloat16 or float32",
        ),
    ],
)
def test_bad_volumes_have_one_clear_message(make, message):
    with pytest.raises(ValueError, match=r"Volume\.directional: ") as caught:
        make()
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_integers_stand_for_0_to_1():
    volume = rgba(255, dtype=torch.uint8).directional()
    assert volume.filter == "directional" and torch.equal(volume.data, torch.ones_like(volume.data))


def test_units_and_axes_are_kept():
    data = torch.rand(2, 3, 4, 4)
    info = gv.ImageInfo(unit="micrometer", space="right-anterior-superior", quantity="light")
    facts = gv.Volume(data, info=info).directional().info
    assert (facts.unit, facts.space, facts.quantity) == (info.unit, info.space, None)


def test_a_store_refuses_six_directions(tmp_path):
    with pytest.raises(ValueError, match="convert: a store's levels are means"):
        convert(rgba().directional(), tmp_path / "out.zarr")


def test_the_reference_length_is_that_of_the_filter():
    tree = gv.N3Tree.from_volume(rgba().directional())
    camera = gv.Camera.orbit(width=4, height=4)
    with pytest.raises(ValueError, match="that of the smallest spacing, 1; got reference 2"):
        gv.render(tree, camera, gv.StoredColor("value", reference=2.0))
    gv.render(tree, camera, gv.StoredColor("value", reference=1.0))
