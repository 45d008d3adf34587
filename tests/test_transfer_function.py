"""Transfer functions: points, files, presets, and the table that the kernel reads."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.shaders.presets import CT_PRESETS, PRESETS
from gvtorch.shaders.shader import Sampling


def table_of(function, spacing=1.0, step=1.0, levels=1, dtype=torch.float32):
    return function.table(
        Sampling(
            smallest_spacing=spacing,
            step=step,
            levels=levels,
            dtype=dtype,
            device=torch.device("cpu"),
        )
    )


def look_up(function: gv.TransferFunction, value: np.ndarray) -> np.ndarray:
    """Looks values up in the table as the kernel does, in float64."""
    table = table_of(function, dtype=torch.float64)
    rows = table.table_lm4[0].numpy()
    low, high = table.domain_2.tolist()
    position = np.clip((value - low) / (high - low) * (len(rows) - 1), 0, len(rows) - 1)
    cell = np.minimum(np.floor(position), len(rows) - 2).astype(int)
    weight = (position - cell)[:, None]
    return rows[cell] + weight * (rows[cell + 1] - rows[cell])


@given(
    corners=st.lists(st.integers(-2000, 60000), min_size=1, max_size=9, unique=True),
    seed=st.integers(0, 99),
)
def test_the_table_is_the_function_when_corners_are_whole_numbers(corners, seed):
    random = np.random.default_rng(seed)
    corners = sorted(corners)
    function = gv.TransferFunction.from_points(
        [(v, random.random()) for v in corners], [(v, *random.random(3)) for v in corners[::2]]
    )
    if corners[-1] - corners[0] > 65535:
        return
    value = random.uniform(corners[0] - 100, corners[-1] + 100, 500)
    np.testing.assert_allclose(look_up(function, value), function(value), atol=1e-9)


def test_tables_have_corners_on_rows_and_a_thousand_rows_or_so():
    function = gv.TransferFunction.from_points([(0, 0), (40, 0), (60, 0.5), (255, 1)])
    assert table_of(function).table_lm4.shape == (1, 51 * 21 + 1, 4)


def test_each_length_of_interval_has_its_alpha():
    function = gv.TransferFunction.from_points([(0, 0), (1, 0.5), (2, 1)], reference=3)
    value = np.linspace(0, 2, 2049)
    assert table_of(function, step=0.75, levels=5).table_lm4.shape == (5, 1025, 4)
    for level in range(5):
        alpha = table_of(function, step=0.75, levels=5, dtype=torch.float64).table_lm4[level, :, 3]
        exact = 1 - (1 - function(value[::2])[:, 3]) ** (0.75 * 2**level / 3)
        np.testing.assert_allclose(alpha.numpy(), exact, atol=1e-12)


def test_long_tables_have_fewer_lengths():
    function = gv.TransferFunction.from_points([(0, 0), (1, 0.5), (2, 0), (1e6, 0)])
    levels, rows, _ = table_of(function, levels=20).table_lm4.shape
    assert rows == 10**6 + 1 and levels == 4


def test_an_edited_function_has_another_table_and_the_same_one_is_kept():
    function = gv.TransferFunction.from_points([(0, 0), (1, 0.5)])
    first = table_of(function)
    assert table_of(function) is first
    function.opacity[1, 1] = 0.25
    assert table_of(function).table_lm4[0, -1, 3] == 0.25


def test_corners_without_a_shared_grid_are_sampled_finely():
    points = [(0.0, 0.0), (2**-0.5, 0.9), (1.1**0.5, 0.1), (1.2345678, 1.0)]
    function = gv.TransferFunction.from_points(points)
    value = np.linspace(-0.1, 1.3, 10001)
    assert np.abs(look_up(function, value) - function(value)).max() < 1e-3


def test_corners_too_close_for_any_table_are_refused():
    function = gv.TransferFunction.from_points([(0, 0), (1e-3, 0.5), (2e-3, 0), (1e6, 0)])
    with pytest.raises(ValueError, match=r"values .* are too close for a table of"):
        table_of(function)


def test_far_corners_on_a_fine_grid_are_exact():
    function = gv.TransferFunction.from_points([(0, 0), (1, 0.5), (2, 0), (1e6, 0)])
    value = np.linspace(0, 3, 1001)
    np.testing.assert_allclose(look_up(function, value), function(value), atol=1e-9)


def test_values_beyond_the_corners_keep_the_last_value():
    function = gv.TransferFunction.from_points([(10, 0.25), (20, 0.75)], [(0, 1, 0, 0)])
    assert function(np.array([-5.0, 15.0, 99.0]))[:, 3].tolist() == [0.25, 0.5, 0.75]
    assert function(np.array([7.0]))[0, :3].tolist() == [1, 0, 0]


def test_one_point_is_a_constant():
    function = gv.TransferFunction.from_points([(0, 0.5)])
    assert (look_up(function, np.array([-3.0, 0.0, 8.0]))[:, 3] == 0.5).all()


def test_reference_is_the_smallest_spacing_unless_given():
    points = [(0, 0), (1, 0.5)]
    for reference, expected in ((None, 0.25), (3, 3)):
        function = gv.TransferFunction(points, [(0, 1, 1, 1)], reference)
        alpha = float(table_of(function, spacing=0.25, step=0.125).table_lm4[0, -1, 3])
        assert alpha == pytest.approx(1 - 0.5 ** (0.125 / expected))


def test_json_round_trip(tmp_path):
    function = gv.TransferFunction.from_points([(0, 0), (1, 1)], [(0, 1, 0.5, 0)], reference=2)
    file = tmp_path / "tf.json"
    file.write_text(function.to_json())
    again = gv.TransferFunction.from_json(file)
    assert np.array_equal(again.opacity, function.opacity) and again.reference == 2
    assert np.array_equal(again.color, function.color)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_stretch_over_the_data(name):
    function = gv.TransferFunction.preset(name, -500, 1500)
    assert function.opacity[0, 0] == -500 and function.opacity[-1, 0] == 1500
    assert function.opacity[:, 1].max() > 0.3
    gv.TransferFunction.preset(name, 3, 3)


def srgb(linear: np.ndarray) -> np.ndarray:
    """Returns sRGB of linear values (IEC 61966-2-1)."""
    root = 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, root)


@pytest.mark.parametrize("name", sorted(CT_PRESETS))
def test_presets_of_scans_have_values_of_their_own(name):
    function = gv.TransferFunction.preset(name)
    low, high, _ = function.corners()
    assert low >= -1000 and -300 < high <= 1500
    assert function(np.array([-1024.0]))[0, 3] == 0, "air is clear"
    other = gv.TransferFunction.preset(name, 0, 1)
    np.testing.assert_allclose(other.opacity[:, 1], function.opacity[:, 1])
    np.testing.assert_allclose(other.opacity[:, 0], (function.opacity[:, 0] - low) / (high - low))


@pytest.mark.parametrize("name", ["viridis", "tab10", "matplotlib:bone"])
def test_colour_maps_are_those_of_matplotlib(name):
    maps = pytest.importorskip("matplotlib").colormaps
    function = gv.TransferFunction.preset(name, 10, 20)
    fractions = np.arange(256) / 255
    expected = maps[name.removeprefix("matplotlib:")](fractions)[:, :3]
    actual = function(10 + 10 * fractions)
    np.testing.assert_allclose(srgb(actual[:, :3]), expected, atol=1e-6)
    assert (
        actual[0, 3] == 0 and actual[-1, 3] == 0.5 and table_of(function).table_lm4.shape[1] < 5000
    )


def test_presets_need_values_or_have_them():
    with pytest.raises(ValueError, match="preset 'gray' is stretched over values: give low and hi"):
        gv.TransferFunction.preset("gray")
    with pytest.raises(ValueError, match="give low and high"):
        gv.TransferFunction.preset("ct-bone", 3)
    with pytest.raises(ValueError, match="high must be >= low, got 400 and -100"):
        gv.TransferFunction.preset("gray", 400, -100)
    with pytest.raises(ValueError, match=r"unknown preset 'bnoe'.*\(did you mean bone"):
        gv.TransferFunction.preset("bnoe", 0, 1)


def test_without_matplotlib_the_command_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ValueError, match=r"pip install 'gvtorch\[color\]'"):
        gv.TransferFunction.preset("viridis", 0, 1)


def test_saved_functions_come_back(tmp_path):
    function = gv.TransferFunction([(0, 0), (3, 1)], [(1, 1, 0.5, 0)], reference=2)
    function.save(tmp_path / "a.json")
    again = gv.TransferFunction.from_file(tmp_path / "a.json")
    assert again.to_json() == function.to_json() and not again.relative
    with pytest.raises(ValueError, match=r"path must end in \.json"):
        function.save(tmp_path / "a.txt")
    with pytest.raises(ValueError, match="holds one function"):
        gv.TransferFunction.from_file(tmp_path / "a.json", "a")


def paraview(tmp_path, **item):
    item = {"Name": "one", "RGBPoints": [0, 0, 0, 0, 1, 1, 1, 1], **item}
    other = {"Name": "two", "RGBPoints": [0, 1, 0, 0, 1, 1, 0, 0]}
    (tmp_path / "pv.json").write_text(json.dumps([other, item]))
    return gv.TransferFunction.from_file(tmp_path / "pv.json", "one")


COOL_WARM = [0, 0.231, 0.298, 0.753, 10, 0.706, 0.016, 0.149]


@pytest.mark.parametrize(
    ("space", "wrap", "points"),
    [
        ("RGB", False, [-4, 0.9, 0.1, 0.2, 0, 0.2, 0.8, 0.5, 7, 0, 0, 0.4]),
        ("HSV", False, [0, 0, 0, 1, 10, 1, 0, 0]),
        ("HSV", True, [0, 1, 0, 1, 3, 1, 0.9, 0, 10, 0.1, 0, 0.9]),
        ("Lab", False, [0, 0.1, 0, 0.4, 4, 0.8, 0.3, 0.3, 10, 1, 1, 0.8]),
        ("Diverging", False, COOL_WARM),
        ("Diverging", False, [0, 0.231, 0.298, 0.753, 5, 0.865, 0.865, 0.865, 10, 0.7, 0.02, 0.15]),
        ("Diverging", False, [0, 0.1, 0.5, 0.2, 10, 0.5, 0.1, 0.6]),
    ],
)
def test_colours_of_paraview_are_those_of_vtk(tmp_path, space, wrap, points):
    vtk = pytest.importorskip("vtkmodules.vtkRenderingCore")
    expected = vtk.vtkColorTransferFunction()
    getattr(expected, f"SetColorSpaceTo{space}")()
    expected.SetHSVWrap(int(wrap))
    for i in range(0, len(points), 4):
        expected.AddRGBPoint(*points[i : i + 4])
    function = paraview(tmp_path, ColorSpace=space, HSVWrap=wrap, RGBPoints=points)
    assert function.relative and table_of(function).table_lm4.shape[1] < 20_000
    values = np.linspace(points[0], points[-4], 301)
    colors = srgb(function(values)[:, :3])
    np.testing.assert_allclose(colors, [expected.GetColor(v) for v in values], atol=0.02)


def test_steps_of_paraview(tmp_path):
    vtk = pytest.importorskip("vtkmodules.vtkRenderingCore")
    points = [0, 1, 0, 0, 4, 0, 1, 0, 10, 0, 0, 1]
    expected = vtk.vtkColorTransferFunction()
    expected.SetColorSpaceToStep()
    for i in range(0, len(points), 4):
        expected.AddRGBPoint(*points[i : i + 4])
    function = paraview(tmp_path, ColorSpace="Step", RGBPoints=points)
    for value in (0.01, 1, 3.99, 4.01, 6, 9.9):
        assert function(np.array([value]))[0, :3].tolist() == list(expected.GetColor(value))


@settings(deadline=None)  # the first call of a process imports and compiles
@given(
    middle=st.floats(0.05, 0.95),
    sharp=st.one_of(st.just(0.0), st.floats(0.02, 0.99)),  # above, versions of VTK differ
    alphas=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_bent_opacities_are_those_of_vtk(tmp_path_factory, middle, sharp, alphas):
    vtk = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    expected = vtk.vtkPiecewiseFunction()
    expected.AddPoint(-3, alphas[0], middle, sharp)
    expected.AddPoint(5, alphas[1], 0.5, 0)
    points = [-3, alphas[0], middle, sharp, 5, alphas[1], 0.5, 0]
    folder = tmp_path_factory.mktemp("pv")
    function = paraview(folder, RGBPoints=[-3, 0, 0, 0, 5, 1, 1, 1], Points=points)
    values = np.linspace(-3, 5, 97)
    colors = function(values)[:, 3]
    np.testing.assert_allclose(colors, [expected.GetValue(v) for v in values], atol=0.02)


PARAVIEW = Path(__file__).with_name("paraview_presets.json")
EVALUATED = json.loads(PARAVIEW.with_name("paraview_values.json").read_text("utf-8"))


@pytest.mark.parametrize("name", EVALUATED)
def test_presets_that_paraview_wrote_are_what_it_evaluates(name):
    """ParaView 5.11 exported the presets, and evaluated red, green, blue and opacity at 40 values
    of each, none of which is a point of the function.
    """
    values, *color, alpha = np.array(EVALUATED[name]).T
    colors = gv.TransferFunction.from_file(PARAVIEW, name)(values)
    np.testing.assert_allclose(srgb(colors[:, :3]), np.transpose(color), atol=0.004)
    np.testing.assert_allclose(colors[:, 3], alpha, atol=0.002)


def test_categories_among_presets_of_paraview_are_told(tmp_path):
    with pytest.raises(ValueError, match=r"holds colours of categories \(IndexedColors\)"):
        gv.TransferFunction.from_file(PARAVIEW, "Categories")
    with pytest.raises(ValueError, match=r"several presets, name one.* it has RGB, curves"):
        gv.TransferFunction.from_file(PARAVIEW)
    alone = json.loads(PARAVIEW.read_text("utf-8"))[-1:]
    (tmp_path / "a.json").write_text(json.dumps(alone))
    with pytest.raises(ValueError, match="holds colours of categories"):
        gv.TransferFunction.from_file(tmp_path / "a.json")


def test_a_space_that_paraview_does_not_know_but_ships_is_straight(tmp_path):
    """Its "Blue - Green - Orange" says CIELAB, which ParaView interprets as RGB."""
    function = paraview(tmp_path, ColorSpace="CIELAB", RGBPoints=COOL_WARM)
    colors = srgb(function(np.array([2.5]))[:, :3])
    np.testing.assert_allclose(colors, [[0.34975, 0.2275, 0.602]], atol=0.004)


def test_a_narrow_curve_stays_in_its_place(tmp_path):
    """The curve has more parts than the table has cells there."""
    vtk = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    points = [0, 0.1, 0.5, 0, 100, 0.7, 0.3, 0.1, 104, 0.3, 0.5, 0, 3000, 0.5, 0.5, 0]
    expected = vtk.vtkPiecewiseFunction()
    for i in range(0, len(points), 4):
        expected.AddPoint(*points[i : i + 4])
    function = paraview(tmp_path, RGBPoints=[0, 0, 0, 0, 3000, 1, 1, 1], Points=points)
    values = np.linspace(99, 106, 50)
    np.testing.assert_allclose(
        function(values)[:, 3], [expected.GetValue(v) for v in values], atol=0.03
    )


OPACITY, COLOR = "6 -1000 0 100 0.25 2000 1", "12 -1000 0 0 0 100 0.5 0.25 0 2000 1 1 1"
LINES = ["1", "0", "0.9", "0.1", "0.2", "10", OPACITY, "4 0 1 255 1", COLOR]


def mrml(name: str, **texts: str) -> str:
    texts = {
        "scalarOpacity": OPACITY,
        "colorTransfer": COLOR,
        "gradientOpacity": "4 0 1 9 1",
    } | texts
    return (
        f'<VolumeProperty name="{name}" ' + " ".join(f'{k}="{v}"' for k, v in texts.items()) + "/>"
    )


def test_presets_of_slicer(tmp_path):
    """As .vp, as .vp.json, and by name from a file of many."""
    (tmp_path / "a.vp").write_text("\n".join(LINES) + "\n")
    both = mrml("CT-One") + mrml("CT-Two", shade="1", scalarOpacity="4 0 0 1 1")
    (tmp_path / "presets.xml").write_text(f"<MRML>{both}</MRML>")
    component = {
        "rgbTransferFunction": {
            "points": [
                {"x": -1000, "color": [0, 0, 0]},
                {"x": 100, "color": [0.5, 0.25, 0]},
                {"x": 2000, "color": [1, 1, 1]},
            ]
        },
        "scalarOpacity": {
            "points": [{"x": -1000, "y": 0}, {"x": 100, "y": 0.25}, {"x": 2000, "y": 1}]
        },
        "scalarOpacityUnitDistance": 2.5,
    }
    content = {"volumeProperties": [{"components": [component]}]}
    (tmp_path / "a.vp.json").write_text(json.dumps(content))
    for file, name in (("a.vp", None), ("presets.xml", "CT-One"), ("a.vp.json", None)):
        function = gv.TransferFunction.from_file(tmp_path / file, name)
        colors = function(np.array([-1000, 100, 1050, 2000.0]))
        np.testing.assert_allclose(colors[:, 3], [0, 0.25, 0.625, 1], atol=1e-4)
        expected = np.array([[0, 0, 0], [0.5, 0.25, 0], [0.75, 0.625, 0.5], [1, 1, 1]])
        np.testing.assert_allclose(srgb(colors[:, :3]), expected, atol=2e-3)
        assert not function.relative and function.reference == (2.5 if "json" in file else None)
    with pytest.warns(UserWarning, match="not kept: shading"):
        gv.TransferFunction.from_file(tmp_path / "presets.xml", "CT-Two")


@pytest.mark.parametrize("name", ["hot", "viridis", "galaxy", "ct-vessels"])
def test_what_is_saved_for_paraview_comes_back(tmp_path, name):
    """Opacities exactly, colours up to invisible differences."""
    function = gv.TransferFunction.preset(name, -100.0, 900.0)
    (tmp_path / "a.json").write_text(function.to_paraview(name))
    back = gv.TransferFunction.from_file(tmp_path / "a.json", name)
    values = np.linspace(-100, 900, 3001)
    colors, expected = back(values), function(values)
    np.testing.assert_allclose(colors[:, 3], expected[:, 3], atol=2e-3)
    assert np.abs(srgb(colors[:, :3]) - srgb(expected[:, :3])).max() < 4e-3


def vp_json(tmp_path, **fields):
    color = [{"x": 0, "color": [0, 0.2, 1]}, {"x": 10, "color": [1, 0.4, 0.5]}]
    component = {
        "rgbTransferFunction": {"points": color},
        "scalarOpacity": {"points": [{"x": 0, "y": 0}, {"x": 10, "y": 1}]},
        **fields,
    }
    (tmp_path / "a.vp.json").write_text(
        json.dumps({"volumeProperties": [{"components": [component]}]})
    )
    return gv.TransferFunction.from_file(tmp_path / "a.vp.json")


@pytest.mark.parametrize(("middle", "sharp"), [(0.5, 0), (0.3, 0), (0.7, 0.4), (0.2, 1.0)])
def test_bent_colours_of_slicer_are_those_of_vtk(tmp_path, middle, sharp):
    vtk = pytest.importorskip("vtkmodules.vtkRenderingCore")
    expected = vtk.vtkColorTransferFunction()
    first = {"x": 0, "color": [0, 0.2, 1], "midpoint": middle, "sharpness": sharp}
    last = {"x": 10, "color": [1, 0.4, 0.5], "midpoint": 0.5, "sharpness": 0}
    for p in (first, last):
        expected.AddRGBPoint(p["x"], *p["color"], p["midpoint"], p["sharpness"])
    function = vp_json(tmp_path, rgbTransferFunction={"points": [first, last]})
    values = (np.arange(100) + 0.5) / 10
    colors = srgb(function(values)[:, :3])
    np.testing.assert_allclose(colors, [expected.GetColor(v) for v in values], atol=0.004)


def test_disabled_opacity_by_gradient_is_not_missed(tmp_path, recwarn):
    gradient = {"points": [{"x": 0, "y": 0}, {"x": 9, "y": 1}]}
    vp_json(tmp_path, gradientOpacity=gradient, disableGradientOpacity=True)
    assert not recwarn.list
    with pytest.warns(UserWarning, match="not kept: opacity by gradient"):
        vp_json(tmp_path, gradientOpacity=gradient)


def test_jumps_and_doubled_points_of_slicer(tmp_path):
    jump = mrml("A", scalarOpacity="12 0 0 0 0 10 0 10 1 20 1 20 1")
    (tmp_path / "a.xml").write_text(f"<MRML>{jump}</MRML>")
    function = gv.TransferFunction.from_file(tmp_path / "a.xml")
    assert function(np.array([9.7, 10.3]))[:, 3].tolist() == [0, 1]
    assert table_of(function).table_lm4.shape[1] < 20_000


def test_what_is_lost_is_told(tmp_path):
    lines = [*LINES[:7], "4 0 0 255 1", LINES[8]]
    (tmp_path / "a.vp").write_text("\n".join(lines))
    with pytest.warns(UserWarning, match="not kept: opacity by gradient"):
        gv.TransferFunction.from_file(tmp_path / "a.vp")
    with pytest.warns(UserWarning, match="taken as 'Lab'"):
        paraview(tmp_path, ColorSpace="Lab/CIEDE2000")


@pytest.mark.parametrize(
    ("file", "text", "name", "message"),
    [
        ("a.vp", "1\n2\n", None, "a .vp file has 9 lines, this one 2"),
        ("a.vp", "\n".join([*LINES[:6], "5 1 2", *LINES[7:]]), None, "must be a count and as many"),
        ("a.vp", "\n".join([*LINES[:6], "2 x y", *LINES[7:]]), None, "could not convert"),
        ("a.vp", "\n".join([*LINES[:6], "2 nan 1", *LINES[7:]]), None, "must be finite"),
        ("a.vp", "\n".join([*LINES[:6], "2 1 7", *LINES[7:]]), None, r"must lie in \[0, 1\]"),
        ("a.vp", "\n".join(LINES), "CT", "holds one preset, without a name: leave 'CT' out"),
        ("a.xml", "<MRML><", None, "not a file of the kind that its ending says"),
        (
            "a.xml",
            "<MRML></MRML>",
            None,
            "has several presets, name one as in FILE:NAME; it has none",
        ),
        ("a.xml", mrml("CT-A"), "CT-B", r"no preset 'CT-B'; it has CT-A \(did you mean CT-A\?\)"),
        ("a.json", "[{}]", None, "expected {.opacity.*a list of ParaView presets"),
        ("a.json", '[{"RGBPoints": [0, 1]}]', None, "cannot reshape"),
        (
            "a.json",
            '[{"RGBPoints": [0,0,0,0], "ColorSpace": "XYZ"}]',
            None,
            "ColorSpace must be one",
        ),
        ("a.json", '{"volumeProperties": []}', None, "not a file of the kind that its ending says"),
        ("a.json", '{"color": []}', None, 'expected an object with "opacity"'),
        ("a.txt", "", None, "not a JSON file"),
    ],
)
def test_bad_files_of_others_get_one_line(tmp_path, file, text, name, message):
    (tmp_path / file).write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        gv.TransferFunction.from_file(tmp_path / file, name)
    assert str(error.value).startswith(str(tmp_path)) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("opacity", "color", "message"),
    [
        ([(0, 0), (0, 1)], [(0, 1, 1, 1)], "opacity values must increase, got 0 before 0"),
        ([(5, 0), (2, 1)], [(0, 1, 1, 1)], "opacity values must increase, got 5 before 2"),
        ([(0, 0)], [(2, 1, 1, 1), (1, 0, 0, 0)], "color values must increase"),
        ([], [(0, 1, 1, 1)], "opacity must be a list of points"),
        ([(0, 0, 0)], [(0, 1, 1, 1)], "opacity must be a list of points"),
        ("abc", [(0, 1, 1, 1)], "opacity must be a list of points"),
        (None, [(0, 1, 1, 1)], "opacity must be a list of points"),
        ([(0, 2)], [(0, 1, 1, 1)], r"opacity numbers must lie in \[0, 1\]"),
        ([(0, 0)], [(0, 1, -1, 1)], r"color numbers must lie in \[0, 1\]"),
        ([(0, float("nan"))], [(0, 1, 1, 1)], "opacity must be finite"),
    ],
)
def test_bad_points_are_named(opacity, color, message):
    with pytest.raises(ValueError, match=message):
        gv.TransferFunction.from_points(opacity, color)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a JSON file"),
        ("[1]", 'expected an object with "opacity"'),
        (json.dumps({"opacity": [[0, 0]], "colour": []}), "unknown key 'colour'"),
        (json.dumps({"opacity": [[1, 0], [0, 1]]}), "opacity values must increase"),
        (json.dumps({"opacity": [[0, 0]], "reference": -1}), "reference must be finite and > 0"),
    ],
)
def test_bad_files_are_named(tmp_path, text, message):
    file = tmp_path / "tf.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        gv.TransferFunction.from_json(file)


def test_missing_file_and_preset():
    with pytest.raises(FileNotFoundError, match=r"nowhere\.json"):
        gv.TransferFunction.from_json("nowhere.json")
    with pytest.raises(ValueError, match="unknown preset 'lungs'; known: bone, cloud, ct-bone"):
        gv.TransferFunction.preset("lungs", 0, 1)


def test_points_a_rounding_apart_are_drawn_or_told_in_a_line():
    """The values of an opacity and of a colour point may differ in their last bit, or be equal."""
    for value in (1.0, 1e6, 3.0000000000000004):
        near = float(np.nextafter(value, 0))
        transfer = gv.TransferFunction(
            [(0, 0), (near, 0.5), (2e6, 1)], [(0, 0, 0, 0), (value, 1, 1, 1)]
        )
        try:
            picture = gv.render(gv.Volume(torch.rand(8, 8, 8)), gv.Camera.orbit(), transfer)
            assert picture.color.isfinite().all()
        except ValueError as error:
            assert "too close" in str(error) and "\n" not in str(error)
