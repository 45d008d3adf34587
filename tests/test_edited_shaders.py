"""Attributes of shaders and lights are checked and converted when they are edited, as they are in
the constructor.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY, camera

import gvtorch as gv


def ramp() -> gv.TransferFunction:
    return gv.TransferFunction([(0, 0), (1, 0.5)])


def sun() -> gv.DirectionalLight:
    return gv.DirectionalLight((0, -1, 0))


@pytest.mark.parametrize(
    ("make", "name", "value", "message"),
    [
        (ramp, "opacity", [(0, 0), (0, 1)], "TransferFunction: opacity values must increase"),
        (ramp, "opacity", [(0, 2)], "TransferFunction: opacity numbers must lie in [0, 1]"),
        (ramp, "opacity", 3, "TransferFunction: opacity must be a list of points (value, alpha)"),
        (ramp, "color", [(0, 1, 1)], "TransferFunction: color must be a list of points"),
        (ramp, "reference", 0, "TransferFunction: reference must be finite and > 0"),
        (sun, "direction", (0, 0, 0), "DirectionalLight: direction must not be zero"),
        (sun, "angle", 200, "DirectionalLight: angle must be finite and >= 0 and <= 120"),
        (sun, "color", (1, -1, 0), "DirectionalLight: color must be finite and >= 0"),
        (lambda: gv.PointLight((0, 0, 0)), "radius", -1, "PointLight: radius must be finite and"),
        (gv.Headlight, "color", "white", "Headlight: color must be three numbers"),
        (lambda: gv.Lit(GRAY), "ambient", -0.1, "Lit: ambient must be finite and >= 0"),
        (lambda: gv.Lit(GRAY), "light", "sun", "Lit: light must be a Headlight, Direct"),
        (lambda: gv.Lit(GRAY), "transfer", None, "Lit: transfer must be a TransferFunction"),
        (lambda: gv.Lit(GRAY), "shadows", "no", "Lit: shadows must be true or false"),
        (lambda: gv.Lit(GRAY), "in_the_way", 1, "Lit: in_the_way must be a Shader, got int"),
        (lambda: gv.Lit(GRAY), "normals", 3, "Lit: normals must be a name, got 3"),
        (lambda: gv.PreIntegrated(GRAY), "transfer", 1, "PreIntegrated: transfer must be a Trans"),
        (lambda: gv.Isosurface(0.5), "value", "high", "Isosurface: value must be a number"),
        (lambda: gv.Isosurface(0.5), "value", torch.zeros(2), "Isosurface: value must be a number"),
        (lambda: gv.Isosurface(0.5), "color", (2, 0, 0), "Isosurface: color must be finite and"),
        (gv.DistanceField, "filled", 2, "DistanceField: filled must be true or false"),
        (lambda: gv.Projection("max", GRAY), "which", "most", "Projection: which must be 'maxim"),
        (lambda: gv.StoredColor("c"), "reference", -1, "StoredColor: reference must be finite"),
        (lambda: gv.StoredColor("c"), "channel", None, "StoredColor: channel must be a name"),
        (lambda: gv.Features(GRAY, "f"), "other", 7, "Features: channel must be a name"),
        (lambda: gv.GradientMagnitude(GRAY), "full", 0, "GradientMagnitude: full must be finite"),
        (lambda: gv.ModuleShader(print), "samples", 1, "ModuleShader: samples must be an int >= 6"),
        (lambda: gv.ModuleShader(print), "channels", "a", "ModuleShader: channels must be names"),
        (lambda: gv.Filtered(GRAY), "component", -1, "Filtered: component must be an int >= 0"),
    ],
)
def test_an_edit_is_checked_when_it_is_made(make, name, value, message):
    thing = make()
    before = getattr(thing, name)
    with pytest.raises(ValueError) as caught:
        setattr(thing, name, value)
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)
    assert getattr(thing, name) is before


def test_an_edit_is_converted_as_by_the_constructor(blobs):
    tree = gv.N3Tree.from_volume(blobs)
    shader = ramp()
    shader.opacity, shader.color = [(0, 0), (1, 0.9)], [(0, 1, 0, 0)]
    assert isinstance(shader.opacity, np.ndarray) and shader.opacity.dtype == np.float64
    rebuilt = gv.TransferFunction([(0, 0), (1, 0.9)], [(0, 1, 0, 0)])
    pictures = [gv.render(tree, camera(16), function).color for function in (shader, rebuilt)]
    assert torch.equal(*pictures)
    projection = gv.Projection("min", GRAY)
    assert projection.which == "minimum"
    projection.which = "max"
    pictures = [gv.render(tree, camera(16), function).color for function in (
        projection, gv.Projection("maximum", GRAY))]  # fmt: skip
    assert torch.equal(*pictures) and projection.which == "maximum"


def test_what_was_edited_in_place_is_checked_by_the_next_picture(blobs):
    tree = gv.N3Tree.from_volume(blobs)
    transfer, level = ramp(), torch.tensor(0.5)
    surface, lamp = gv.Isosurface(level), gv.PointLight(torch.zeros(3))
    lit = gv.Lit(GRAY, light=lamp)
    for shader in (transfer, surface, lit):
        gv.render(tree, camera(8), shader)
    transfer.opacity[1, 1] = 2
    level.fill_(torch.nan)
    lamp.position.fill_(torch.inf)
    for shader, message in (
        (transfer, "opacity numbers must lie in"),
        (surface, "Isosurface: value must be finite"),
        (lit, "PointLight: position must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            gv.render(tree, camera(8), shader)


def test_colour_and_channel_of_a_surface_are_edited_one_after_the_other(blobs):
    tree = gv.N3Tree.from_volume(blobs)
    surface = gv.Isosurface(0.5)
    surface.color = GRAY
    with pytest.raises(ValueError, match="color=None and color_channel belong together"):
        gv.render(tree, camera(8), surface)
    surface.other = "value"
    expected = gv.render(tree, camera(8), gv.Isosurface(0.5, GRAY, color_channel="value"))
    assert torch.equal(gv.render(tree, camera(8), surface).color, expected.color)


def test_attributes_have_the_names_of_the_arguments():
    surface = gv.Isosurface(0.5, None, color_channel="rgba", color_component=2)
    assert (surface.color_channel, surface.color_component) == ("rgba", 2)
    surface.color_channel, surface.color_component = "other", 1
    assert (surface.other, surface.other_component) == ("other", 1)
    with pytest.raises(ValueError, match="must be an int >= 0"):
        surface.color_component = -1
    field = gv.DistanceField(offset=0.2)
    field.offset = 0.4
    assert (field.value, field.offset) == (0.4, 0.4)
