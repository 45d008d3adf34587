"""Arguments of producers, fields, meshes and points that are wrong, or of extreme size: one line
says what is wrong, and nothing hangs, overflows or is taken silently.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import gvtorch as gv
from gvtorch import noise, sdf
from gvtorch.shaders.shader import Sampling

BALL = sdf.Sphere()
TALL = ((-1, -1, -1), (1, 1, 3))
BOX = torch.tensor(TALL)
POINTS = [[0.0, 0, 0], [1, 1, 2]]
PLACES, WHOLE = torch.rand(4, 3), torch.zeros(4, 3, dtype=torch.int64)
VOLUME = gv.Volume(torch.rand(8, 8, 8, 2))
PICTURE, GRAY = torch.ones(2, 4, 3), gv.TransferFunction.preset("gray", 0, 1)
BYTES = np.full((4, 4, 4), 255, np.uint8)


def triangle(**fields):
    return gv.Mesh(**{"vertices": np.eye(3), "faces": [[0, 1, 2]], **fields})


@pytest.mark.parametrize("extent", [(32, 32), "32", None, 32.5, math.nan, (32, 32, 0)])
@pytest.mark.parametrize(
    "make",
    [
        lambda extent: gv.FieldProducer(BALL, extent),
        lambda extent: gv.FieldProducer(BALL, extent, box=TALL),
        lambda extent: gv.Hypertexture(BALL, extent, thickness=0.1),
        lambda extent: gv.PointProducer(POINTS, extent=extent),
        gv.Producer,
    ],
)
def test_every_producer_says_what_an_extent_must_be(make, extent):
    with pytest.raises(ValueError, match=r"extent must be (an int >= 1|a number or \(x, y, z\))"):
        make(extent)


def test_integers_of_numpy_are_extents():
    """Along the longest side of the box, as other integers are: voxels are cubes."""
    size = np.int64(32)
    assert gv.FieldProducer(BALL, size, box=TALL).extent == (16, 16, 32)
    assert gv.FieldProducer(BALL, size).extent == gv.FieldProducer(BALL, 32).extent
    assert gv.Hypertexture(BALL, size, thickness=0.1, box=TALL).extent == (16, 16, 32)
    assert gv.PointProducer(POINTS, extent=size).extent == (16, 16, 32)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: noise.fbm(PLACES, lacunarity=1e300), "noise.fbm: 6 octaves of lacunarity 1e+300"),
        (lambda: noise.fbm(PLACES, gain=1e300), "6 octaves of lacunarity 2 and gain 1e+300 exceed"),
        (lambda: noise.fbm(PLACES, lacunarity=math.inf, period=4), "lacunarity must be finite"),
        (lambda: noise.fbm(PLACES, lacunarity=math.nan, period=4), "lacunarity must be finite"),
        (lambda: noise.warp(PLACES, seed=2**62), "noise.warp: seed must be an int"),
        (lambda: noise.warp(PLACES, seed="a"), "noise.warp: seed must be an int"),
        (lambda: noise.bounds(noise.cellular, 5), "nothing is known of 'cellular' in 5 dim"),
        (lambda: noise.OctaveSum(settled="a"), "noise.OctaveSum: settled must be a number"),
        (lambda: gv.Julia((1e21, 0, 0)), "Julia: length of the constant must be finite and <= 1e"),
        (lambda: gv.Mandelbulb(colors=5), "colors must be (3, 3) numbers, got ()"),
        (lambda: gv.Mandelbulb(colors=((2, 0, 0),) * 3), "Mandelbulb: colors must be in 0 to 1"),
        (lambda: sdf.Repeat(sdf.Sphere(0.3), (1, 1, 1), (3,)), "count must be (x, y, z), got (3,)"),
        (lambda: sdf.Repeat(sdf.Sphere(0.3), (1, 1, 1), 3), "count must be (x, y, z), got 3"),
        (lambda: sdf.Plane((1e200, 0, 0)), "Plane: normal must have a direction"),
        (lambda: sdf.rotated(BALL, (1e200, 0, 0), 90), "rotated: axis must have a direction"),
        (lambda: gv.warp(BALL, sdf.Sphere(), 0.1)(PLACES), "offset must give (..., 3) at (..., 3)"),
        (
            lambda: gv.FieldProducer(BALL, 8).at(WHOLE),
            "FieldProducer.at: points must be (..., 3) fl",
        ),
        (lambda: gv.Hypertexture(BALL, 8, thickness=1).at(WHOLE), "at: points must be (..., 3) fl"),
        (lambda: gv.stack(a_b=BALL, a=gv.stack(b=BALL))(PLACES), "two channels are named 'a_b'"),
        (
            lambda: gv.blend(gv.stack(a=BALL), gv.stack(a=BALL, b=BALL), BALL)(PLACES),
            "Blend: both fields must have the same channels, got a and a, b",
        ),
        (lambda: gv.stack(values=BALL), "Stack: bad name of a channel: attribute 'values' already"),
        (lambda: gv.JoinedProducer({"a.b": gv.Producer(8)}), "bad name of a channel: module name"),
        (lambda: gv.Producer(8, value_range={"value": 3}), "value_range['value'] must be (2,) num"),
        (lambda: gv.Producer(8, value_range={"value": "ab"}), "value_range['value'] must be numbe"),
        (lambda: gv.Producer(8, value_range=[1]), "value_range must be a dict by channel, got a l"),
        (lambda: gv.Producer(8, labels=[1]), "labels must be a dict by channel, got a list"),
        (lambda: triangle(faces=5), "mesh: faces must be (n, 3), got (1,)"),
        (lambda: triangle(faces=[[0, 1, 2], [1]]), "mesh: faces must be (n, 3) numbers"),
        (lambda: triangle(faces=None), "mesh: faces must be (n, 3) numbers"),
        (lambda: triangle(vertices=None), "mesh: vertices must be (n, 3) numbers"),
        (lambda: gv.Material(color=(1, 1)), "material '': color must be (4,) numbers, got (2,)"),
        (lambda: gv.Material(color=(1, 1, 1, math.nan)), "material '': color must be finite"),
        (lambda: gv.Material(color=(255, 0, 0, 255)), "material '': color must be finite, li"),
        (lambda: gv.Material(color=(1, -1, 0, 1)), "opacity 0 to 1, got -1 to 1, opacity up to 1"),
        (lambda: triangle(color=np.full((1, 3, 4), 255, np.uint8)), "mesh: color must be finite"),
        (lambda: triangle(color=np.full((1, 3, 4), math.nan)), "mesh: color must be finite, light"),
        (lambda: triangle(uv=np.full((1, 3, 2), math.nan)), "mesh: uv must be finite, got NaN"),
        (lambda: gv.Material(texture=np.ones((4, 4, 4))), "texture must be (h, w, 4) uint8, got"),
        (lambda: gv.Material(texture=BYTES[..., :3]), "uint8, got (4, 4, 3) uint8"),
        (lambda: gv.Material(texture=BYTES[:0]), "uint8, got (0, 4, 4) uint8"),
        (lambda: triangle(materials=None), "mesh: materials must be a list, got None"),
        (lambda: triangle(materials=("a",)), "mesh: each of materials must be a Material, got str"),
        (lambda: gv.MeshProducer(triangle(), channels=5), "channels must be a list, got 5"),
        (lambda: gv.MeshProducer(triangle(), band=1e300), "voxelize: band must be finite and >= 2"),
        (lambda: gv.SampledDistance.of_mesh(triangle(), resolution=2**20), "GiB"),
        (lambda: gv.Points(np.eye(3), np.eye(3)).lit(), "values of 3 numbers: light is one number"),
        (lambda: gv.PointProducer(POINTS, box=3), "sort_points: box must be two corners, got 3"),
        (lambda: gv.CameraPath(5, 5), "CameraPath: eye must be a list, got 5"),
        (lambda: gv.CameraPath([(0, 0, 1)], [(0, 0, 0)], fov=30), "fov must be a list, got 30"),
        (lambda: gv.write_cameras("a.json", 5), "cameras must be a Camera or Mapping, got int"),
        (lambda: gv.Environment(PICTURE, rotation="up"), "rotation must be numbers, got 'up'"),
        (lambda: gv.Environment(PICTURE, rotation=torch.eye(3) * 1j), "must be real numbers, got"),
        (lambda: gv.Overlay("wide", 64), "Overlay: width must be an int >= 1, got 'wide'"),
        (lambda: gv.Overlay(64, 64, text=5), "Overlay: text must be a str, got int"),
        (lambda: gv.Overlay(64, 64, bar=GRAY), "Overlay: bar must be a ColorBar, got Trans"),
        (lambda: gv.Overlay(64, 64, pixel=1, unit=5), "Overlay: unit must be a str, got int"),
        (lambda: gv.ColorBar(colors=5, low=0, high=1), "ColorBar: colors must be callable, got 5"),
        (lambda: gv.TransferModule(5, 1.0), "shader must be a TransferFunction, got int"),
        (lambda: gv.TransferModule(GRAY, -1), "TransferModule: spacing must be"),
        (lambda: gv.Camera.orbit().placed(5), "Camera.placed: box must be a Tensor, got int"),
        (lambda: gv.Camera.from_kornia(5), "from_kornia: takes a PinholeCamera, got 5"),
        (lambda: gv.Camera.from_viewmat_K("a", 5, 4, 4), "viewmats must be numbers, got 'a'"),
        (
            lambda: gv.CustomCamera.from_directions(PICTURE, 5),
            "direction must be a Tensor, got int",
        ),
        (lambda: gv.CustomCamera.from_directions(5, PICTURE), "origin must be a Tensor, got int"),
        (lambda: gv.CameraPath.orbit(5), "CameraPath.orbit: box must be (2, 3) numbers"),
        (lambda: gv.CameraPath.orbit(BOX, azimuth="x"), "azimuth must be a number, got 'x'"),
        (lambda: gv.CameraPath.orbit(BOX, fit_size=5), "fit_size must be a list, got 5"),
        (lambda: gv.read_cameras(5), "read_cameras: path must be a str or PathLike, got int"),
        (lambda: gv.splat(POINTS, 5), "splat: store must be a str or PathLike, got int"),
        (lambda: gv.Filtered.of("tree", VOLUME, GRAY), "Filtered: tree must be a N3Tree, got str"),
        (lambda: gv.Channels(3), "Channels: looks must be a list, got 3"),
        (lambda: gv.Channels.of(VOLUME, components=5), "components must be a list, got 5"),
        (lambda: gv.ModuleShader(print, channels=5), "channels must be names, got 5"),
        (lambda: gv.ModuleShader(print, channels=()), "channels must be names, got ()"),
        (
            lambda: gv.TransferFunction.preset("gray", 0, 1e308),
            "stretched: high must be finite",
        ),
        (lambda: noise.SplineSum().bricks([PLACES] * 3, 0.0), "SplineSum: side must be finite and"),
        (lambda: noise.perlin(5), "noise.perlin: points must be (..., n) or n tensors"),
        (lambda: gv.Material(texture="wood.png"), "uint8, got 'wood.png'"),
    ],
)
def test_bad_arguments_have_one_clear_line(call, message):
    with pytest.raises(ValueError) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_boxes_of_extreme_fractals_are_finite():
    """Orbits of the largest constants and of the most steps."""
    for fractal in (
        gv.Julia((1e20, 0, 0)),
        gv.Julia((0, 0, 1e20), 64),
        gv.Mandelbox(2.5, iterations=1000),
    ):
        assert torch.isfinite(fractal.box()).all()
    assert fractal.box()[1, 0] == 14 / 3


def test_a_point_that_is_nan_has_no_distance_in_a_volume():
    shape = gv.SampledDistance(gv.Volume(torch.rand(8, 8, 8, 1)))
    assert shape(torch.tensor([[math.nan, 0, 0], [1, math.nan, 2]])).isnan().all()
    assert torch.isfinite(shape(torch.tensor([[1.0, 2, 3]]))).all()


def test_points_may_be_as_wide_as_float64_goes():
    box = ((0, 0, 0), (0.1, 0.1, 0.1))
    producer = gv.PointProducer([[0.05] * 3], radius=1e308, extent=8, box=box)
    assert producer.at(torch.full((1, 3), 0.05))["value"].abs().max() < 1e-6


def test_labels_of_the_smallest_reference_length_are_opaque_or_absent():
    volume = gv.Volume((torch.rand(8, 8, 8, 1) * 3).to(torch.uint8), labels=True)
    tree = gv.N3Tree.from_volume(volume)
    sampling = Sampling(smallest_spacing=1.0, step=0.5, levels=30)
    table = gv.Labels(reference=5e-324, opacity=0.5).table_of(tree, "value", sampling)
    assert (table.table_lm4[:, 0, 3] == 0).all() and (table.table_lm4[:, 1:3, 3] == 1).all()


def test_no_points_have_no_values():
    producer = gv.VolumeProducer(gv.Volume(torch.rand(8, 8, 8, 2)))
    values = producer.at(torch.empty(4, 0, 3))["value"]
    assert values.shape == (4, 0, 2) and values.dtype == torch.float32
