"""Points drawn as points: they have their voxels' light, also in transition, and can be hidden."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

import gvtorch as gv

LOOK = gv.StoredColor("value", premultiplied=True)
BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
EXTENT = 64
SIZE = 65


def star(position, light=(1.0, 0.5, 0.25), **options) -> gv.PointProducer:
    points = gv.Points([position], [(*light, 1e-6)])
    return gv.PointProducer(points, extent=EXTENT, box=BOX, drawn=True, **options)


def total_light(producer, engine, away, position) -> np.ndarray:
    """Returns (3,): the light of all pixels times the squared distance from a star, as the mean
    over eyes that look past it by fractions of a pixel."""
    direction, total = np.array([0.48, 0.6, 0.64]), np.zeros(3)
    eye = tuple(np.array(position) + away * direction)
    straight = gv.Camera.look_at(eye, position, fov=40, width=SIZE, height=SIZE)
    for shift in itertools.product((0, 0.25, 0.5, 0.75), repeat=2):
        camera = straight.shifted(*shift)
        layer = gv.point_layer(producer, camera)
        picture = engine.render(camera, LOOK, layer=layer, stop_alpha=1.0, dtype=torch.float64)
        assert picture.stats.converged
        total += picture.color.sum((0, 1)).numpy() * away**2 / 16
    return total


@pytest.mark.long
@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    "position", [(0.0156, 0.0156, 0.0156), (0.27, -0.11, 0.003), (0.5, 0.49, -0.3)]
)
def test_a_star_keeps_its_light_from_voxels_to_a_point(position):
    producer = star(position)
    focal = 0.5 * SIZE / np.tan(np.radians(20))
    switch = 2 / EXTENT * focal * 0.75  # a finest voxel is as wide as a pixel's cone
    expected = (2 / EXTENT) ** 2 * focal**2 * np.array([1.0, 0.5, 0.25])
    with gv.Engine(producer, brick_size=8, brick_pool="8 MB") as engine:
        ratios = {
            away: total_light(producer, engine, away * switch, position) / expected
            for away in (0.05, 0.5, 0.9, 1.0, 1.15, 1.35, 1.5, 1.7, 1.85, 2.0, 2.2, 3.0)
        }
    for away, light in ratios.items():
        # Beyond, only voxels are seen, and their middle is not the star's position.
        assert np.allclose(light, 1, atol=0.02 if away < 2 else 0.08), (away, light)


@pytest.mark.backend("cpp")
def test_without_the_layer_the_light_is_lost_near_and_kept_far():
    point, camera = (0.0, 0.0, 0.0), gv.Camera.look_at((0, 0, 0.5), (0, 0, 0), width=33, height=33)
    producer = star(point)
    with gv.Engine(producer, brick_pool="8 MB") as engine:
        assert not engine.render(camera, LOOK).color.any()
        layer = gv.point_layer(producer, camera)
        assert engine.render(camera, LOOK, layer=layer).color.sum() > 0
        far = gv.Camera.look_at((0, 0, 40), (0, 0, 0), width=33, height=33)
        assert not gv.point_layer(producer, far).color.any()
        assert engine.render(far, LOOK, dtype=torch.float64).color.sum() > 0


@pytest.mark.backend("cpp")
def test_dust_hides_a_point_behind_it_and_not_one_before():
    dust = gv.Points([(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0, 4000.0)], radius=0.3)
    behind, before = (0.0, 0.0, -0.7), (0.0, 0.0, 0.7)
    seen = []
    for position in (behind, before):
        star_ = gv.Points([position], [(1.0, 1.0, 1.0, 1e-6)], radius=0.0)
        both = gv.Points(
            np.concatenate((dust.positions, star_.positions)),
            np.concatenate((dust.values, star_.values)),
            radius=np.concatenate((dust.radius, star_.radius)),
        )
        producer = gv.PointProducer(both, extent=EXTENT, box=BOX, drawn=True)
        camera = gv.Camera.look_at((0, 0, 0.9), (0, 0, 0), fov=40, width=SIZE, height=SIZE)
        with gv.Engine(producer, brick_pool="8 MB") as engine:
            layer = gv.point_layer(producer, camera)
            picture = engine.render(camera, LOOK, layer=layer)
        seen.append(float(picture.color.sum() / layer.color.sum()))
    assert seen[0] < 0.3 and seen[1] > 0.99


def test_points_of_a_pixel_add_up_and_have_a_mean_distance():
    points = gv.Points([(0, 0, 0.2), (0, 0, -0.2)], [(1, 0, 0, 1e-6), (0, 1, 0, 1e-6)])
    producer = gv.PointProducer(points, extent=64, box=BOX, drawn=True)
    camera = gv.Camera.look_at((0, 0, 0.8), (0, 0, 0), width=33, height=33)
    layer = gv.point_layer(producer, camera)
    red, green = layer.color.sum((0, 1))[:2].tolist()
    assert red / green == pytest.approx((1.0 / 0.6) ** 2, rel=1e-4)
    middle = float(layer.depth[16, 16])
    assert middle == pytest.approx((0.6 * red + 1.0 * green) / (red + green), rel=1e-3)
    assert torch.isinf(layer.depth[0, 0]) and not layer.alpha[0, 0].any()
    numbers = {"size": torch.tensor(1.5), "reference": torch.tensor(producer.spacing[0])}
    again = gv.point_layer(producer, camera, **numbers)
    assert torch.allclose(again.color, layer.color)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: gv.point_layer(gv.PointProducer(torch.rand(5, 3)), c), "drawn=True"),
        (lambda c: gv.point_layer(gv.PointProducer(torch.rand(5, 3), drawn=True), c), "4 values"),
        (lambda c: gv.point_layer(None, c), "producer must be a PointProducer"),
        (lambda c: gv.point_layer(star((0, 0, 0)), gv.Camera.orbit(model="ortho")), "pinhole"),
        (lambda c: gv.point_layer(star((0, 0, 0)), c, size=0), "size must be"),
        (lambda c: gv.point_layer(star((0, 0, 0)), c, reference=0), "reference must be"),
        (lambda c: gv.point_layer(star((0, 0, 0)), c, cone_scale=-1), "cone_scale must be"),
    ],
)
def test_what_can_t_be_drawn_is_told(call, message):
    with pytest.raises(ValueError, match=message):
        call(gv.Camera.orbit())
