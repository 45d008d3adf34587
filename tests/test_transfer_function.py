"""Transfer functions: points, files, presets, and the table that the kernel reads."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.shaders.presets import PRESETS
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
    """What the kernel does with the table, in float64."""
    table = table_of(function, dtype=torch.float64)
    rows = table.table_lm4[0].numpy()
    low, high = table.domain_2.tolist()
    place = np.clip((value - low) / (high - low) * (len(rows) - 1), 0, len(rows) - 1)
    cell = np.minimum(np.floor(place), len(rows) - 2).astype(int)
    weight = (place - cell)[:, None]
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
    with pytest.raises(ValueError, match="unknown preset 'lungs'; known: bone, ct-bone, ct-lung"):
        gv.TransferFunction.preset("lungs", 0, 1)
