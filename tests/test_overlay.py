"""Overlays: colour bars, scale bars, text, in strips as in whole pictures; PNG row by row."""

from __future__ import annotations

import io
import itertools
import warnings

import numpy as np
import pytest
import torch
from helpers import Library, gvtorch
from helpers.viewer import pixels

import gvtorch as gv
from gvtorch.base.records import RenderStats
from gvtorch.base.units import unit_symbol
from gvtorch.pictures.files import write_png_rows
from gvtorch.pictures.overlay import _labels, _length_text, _round_below, _ticks
from gvtorch.tools.annotations import _color_bar

Library("PIL")
HOT = gv.TransferFunction.preset("hot", 0, 200)


def black(width: int = 320, height: int = 240, light: float = 0.0) -> gv.Picture:
    color = torch.full((height, width, 3), light)
    one = torch.ones(height, width, 1)
    return gv.Picture(
        color=color, alpha=0 * one, depth=one, nearest=one, samples=one.int(), stats=RenderStats()
    )


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.parametrize("rows", [1, 7, 64])
def test_png_rows_come_back(tmp_path, bits, count, rows):
    """Read by Pillow, or for 16 bits another decoder: noise, a gradient and one colour."""
    from imagecodecs import png_decode

    rng = np.random.default_rng(bits + count)
    image = rng.integers(0, 2**bits, (50, 31, count)).astype(f"uint{bits}")
    image[20:40] = np.linspace(0, 2**bits - 1, 31)[:, None]
    image[40:] = 7
    strips = (image[first_row : first_row + rows] for first_row in range(0, 50, rows))
    write_png_rows(tmp_path / "a.png", image.shape, bits, strips)
    content = (tmp_path / "a.png").read_bytes()
    assert np.array_equal(png_decode(content), image)
    if bits == 8:
        from PIL import Image

        with Image.open(io.BytesIO(content)) as read:
            read.load()
            assert np.array_equal(np.asarray(read), image)
    flat = np.full((50, 31, count), 9, f"uint{bits}")
    write_png_rows(tmp_path / "b.png", flat.shape, bits, [flat])
    assert (tmp_path / "b.png").stat().st_size < 200 < len(content)


def test_a_scale_bar_is_as_long_as_it_says():
    """Its white line, in pixels, times the pixel's width, is 1, 2 or 5 times a power of ten."""
    for pixel, unit, expected in ((0.11, "micrometer", 5.0), (0.3, None, 20.0), (7e-4, "mm", 0.05)):
        drawn = gv.Overlay(320, 240, pixel=pixel, unit=unit).over(black()).color.numpy()
        white = (drawn > 0.99).all(-1)
        rows = np.flatnonzero(white.sum(1) > 0.5 * expected / pixel)
        columns = np.flatnonzero(white[rows[0]])
        assert abs((columns[-1] - columns[0] + 1) * pixel - expected) < 2.5 * pixel
        assert columns[0] < 20 and rows[0] > 200, "at the lower left"
    assert [unit_symbol(u) for u in ("micrometer", "mm", "ly", None)] == ["µm", "mm", "ly", ""]


@pytest.mark.parametrize(
    ("length", "unit", "text"),
    [
        (2e-5, "m", "20 µm"),
        (1e6, "nanometer", "1 mm"),
        (5e-13, "meter", "0.5 pm"),
        (20000.0, "angstrom", "2 µm"),
        (5e6, "kilometer", "5e+06 km"),
        (5000.0, "um", "5000 µm"),
        (0.002, "mm", "0.002 mm"),
        (1e-6, "parsec", "1e-06 parsec"),
        (1e6, None, "1e+06"),
    ],
)
def test_a_scale_bar_tells_few_digits(length, unit, text):
    assert _length_text(length, unit) == text


def test_a_pixel_is_as_wide_as_the_rays_are_apart():
    for model in ("pinhole", "ortho"):
        camera = gv.Camera.look_at((0, 0, 9), (0, 0, 1), width=65, height=33, model=model)
        rays = camera.rays()
        hits = rays.origin + rays.direction * (8 / -rays.direction[:, 2:])
        middle = hits.view(33, 65, 3)[16]
        wide = float(middle[40, 0] - middle[39, 0])
        assert abs(camera.pixel_width(8.0) - wide) < 1e-9
    fisheye = gv.Camera.look_at((0, 0, 9), (0, 0, 1), model="fisheye", width=4, height=4)
    for bad in (gv.Camera.orbit(), fisheye, gv.CustomCamera(fisheye.rays())):
        with pytest.raises(ValueError, match="takes one pinhole or ortho camera in the world"):
            bad.pixel_width(8.0)


def test_a_colour_bar_has_the_colours_of_the_function():
    bar = gv.ColorBar(colors=HOT, low=0, high=200, title="HU")
    drawn = gv.Overlay(400, 300, bar=bar).over(black(400, 300))
    srgb = drawn.to_srgb8().numpy().astype(int)
    frame = (srgb == 255).all(-1)
    right = 400 - 9 - 4  # within the bar, left of its margin
    column = srgb[:, right]
    ends = np.flatnonzero(frame[:, right])
    top, bottom = ends[0], ends[-1]
    assert 0.4 * 300 < bottom - top < 0.55 * 300
    rows = np.arange(top + 4, bottom - 3)
    values = np.interp(rows, (top + 1, bottom - 1), (200, 0))
    expected = gv.Picture(
        **{**vars(black(1, len(rows))), "color": torch.from_numpy(HOT(values)[:, None, :3]).float()}
    ).to_srgb8()
    assert np.abs(column[rows] - expected.numpy()[:, 0]).max() < 8
    assert (srgb[:top, 300:] > 200).all(-1).any(), "the title"


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 1, 6), (140, 1500, 3), (-3, 3, 4), (0, 255, 6), (1e-9, 7e-9, 4), (1000, 1001, 6)],
)
def test_ticks_are_few_and_round(low, high, expected):
    ticks = _ticks(low, high)
    assert 3 <= len(ticks) <= 6 and low - 1e-9 * high <= ticks[0] and ticks[-1] <= high * (1 + 1e-9)
    steps = np.diff(ticks)
    assert np.allclose(steps, steps[0]) and np.isclose(_round_below(steps[0]), steps[0])
    assert len(ticks) >= expected - 1


def test_ticks_that_differ_late_are_told_apart():
    assert _labels(_ticks(1e6, 1e6 + 2)) == [f"{1e6 + n / 2:.10g}" for n in range(5)]
    assert _labels(_ticks(0, 1)) == ["0", "0.2", "0.4", "0.6", "0.8", "1"]


def test_overlays_blend_in_linear_light_and_are_opaque_where_nothing_was():
    drawn = gv.Overlay(320, 240, text="Mk").over(black(light=0.5))
    assert drawn.color.max() > 0.75 and drawn.color.min() < 0.2, "white, with a dark rim"
    same = drawn.color == 0.5
    assert same.float().mean() > 0.95 and torch.equal(same.all(-1, keepdim=True), drawn.alpha == 0)
    assert drawn.alpha.max() > 0.95
    two = gv.Overlay(320, 240, text="Mk\nMk").over(black(light=0.5))
    lines = [int((picture.color != 0.5).sum()) for picture in (drawn, two)]
    assert abs(lines[1] - 2 * lines[0]) < 0.02 * lines[0]


def test_strips_are_the_whole(tmp_path):
    bar = gv.ColorBar(colors=HOT, low=0, high=200)
    overlay = gv.Overlay(320, 240, bar=bar, pixel=0.2, text="one\ntwo")
    whole = overlay.over(black(light=0.3)).color
    for rows in (1, 17, 100):
        strips = [
            overlay.over(black(320, min(rows, 240 - row), 0.3), row).color
            for row in range(0, 240, rows)
        ]
        assert torch.equal(torch.cat(strips), whole)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gv.Overlay(40, 20, text="a long text"), "has no room"),
        (lambda: gv.Overlay(320, 240, pixel=0), "pixel must be finite and > 0"),
        (lambda: gv.ColorBar(colors=HOT, low=1, high=1), "high must be > low"),
        (lambda: gv.Overlay(320, 240).over(black(300)), "must be 320 wide, got 300x240"),
    ],
)
def test_wrong_overlays_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def letters(text: str, **options) -> np.ndarray:
    """Returns where letters are white, (h, w) bool."""
    return (gv.Overlay(320, 240, text=text, **options).over(black()).color > 0.5).all(-1).numpy()


@pytest.mark.parametrize("letter", ["\u00b5", "\u03bc", "\u00c5", "\u212b"])
def test_units_of_microscopy_are_not_boxes(letter):
    """A micro sign is a u with a stem below its left side, an angstrom an A with a ring above."""
    plain = "u" if letter in "\u00b5\u03bc" else "A"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drawn, base = letters(f"M{letter}m"), letters(f"M{plain}m")
        unit = "micrometer" if plain == "u" else "angstrom"
        gv.Overlay(320, 240, pixel=0.1, unit=unit)
    assert drawn[base].all(), "the letter itself stays"
    rows, columns = np.nonzero(drawn & ~base)
    lines = np.flatnonzero(base.any(1))
    baseline, top = lines[-1], np.flatnonzero(letters(f"{plain}").any(1))[0]
    m_width = np.flatnonzero(letters("M").any(0))[-1]
    assert columns.min() > m_width and columns.max() < np.flatnonzero(base.any(0))[-1] - 4
    if plain == "u":
        assert rows.max() >= baseline + 2 and np.ptp(columns) <= 2, "a thin stem"
    else:
        assert rows.max() <= top and 2 <= top - rows.min() <= 5, "a ring on its top"


def test_black_ink_is_for_light_pictures():
    bar = gv.ColorBar(colors=HOT, low=0, high=200, title="HU")
    for light, ink in ((0.0, "white"), (1.0, "black")):
        drawn = gv.Overlay(320, 240, bar=bar, pixel=0.1, text="Mk", ink=ink).over(
            black(light=light)
        )
        left = drawn.color[:, :160]  # without the bar's colours
        assert float((left - light).abs().max()) > 0.99
        rim = gv.Overlay(320, 240, pixel=0.1, text="Mk", ink=ink).over(black(light=1 - light))
        assert 0.5 < float((rim.color - 1 + light).abs().max()) < 0.99, "the rim, nearly as light"
    with pytest.raises(ValueError, match="Overlay: ink must be 'white' or 'black', got 'red'"):
        gv.Overlay(320, 240, ink="red")


def test_letters_that_the_font_lacks_are_told():
    with pytest.warns(UserWarning, match="the font of pictures has no 漢"):
        gv.Overlay(320, 240, text="漢 a")


@pytest.mark.backend("cpp")
def test_render_and_fly_draw(scan_store, tmp_path, monkeypatch):
    """Whole, in strips, and in the pictures of a flight: the same pixels."""
    flags = ("--size", "200x160", "--tf", "hot", "--bar", "--scale-bar", "--annotate", "ball")
    still = (*flags, "--camera", "orbit:30,20,2")
    run = gvtorch("render", scan_store, "-o", tmp_path / "a.png", *still)
    assert run.returncode == 0, run.stderr
    plain = gvtorch("render", scan_store, "-o", tmp_path / "p.png", *flags[:4], *still[-2:])
    assert plain.returncode == 0
    monkeypatch.setattr("gvtorch.pictures.progressive.STRIP", 200 * 400 * 12)
    monkeypatch.setattr(gv.render_tiles, "__kwdefaults__",
                        {**gv.render_tiles.__kwdefaults__, "memory": 200 * 400 * 12})  # fmt: skip
    run = gvtorch("render", scan_store, "-o", tmp_path / "b.png", *still)
    assert run.returncode == 0, run.stderr
    run = gvtorch(
        "fly", scan_store, "-o", tmp_path / "f", "--frames", "1", "--orbit", "30,20,2", *flags
    )
    assert run.returncode == 0, run.stderr
    names = ("a.png", "b.png", "p.png", "f/0000.png")
    whole, strips, without, flown = (pixels((tmp_path / name).read_bytes()) for name in names)
    assert np.array_equal(whole, strips) and np.array_equal(whole, flown)
    assert 300 < (whole != without).any(-1).sum() < 0.3 * whole[..., 0].size
    for more, message in (
        (("--shader", "isosurface", "--value", "9", "--bar"), "--bar is for transfer functions"),
        (("--show", "samples", "--bar"), "--bar is for pictures"),
        (("--camera-model", "fisheye", "--scale-bar"), "takes one pinhole or ortho camera"),
    ):
        run = gvtorch("render", scan_store, "-o", tmp_path / "c.png", "--size", "200x160", *more)
        assert run.returncode == 2 and message in run.stderr, run.stderr
    assert not (tmp_path / "c.png").exists()


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    ("background", "ink"), [("0.9,1,0.9", 0), ("1,1,1/0.5,0.6,0.8", 0), ("0.1,0.1,0.1", 255)]
)
def test_ink_stands_out_from_the_background(small, tmp_path, background, ink):
    flags = ("--background", background, "--annotate", "Mk", "--size", "480x400")
    assert gvtorch("render", small, "-o", tmp_path / "a.png", *flags).returncode == 0
    corner = pixels((tmp_path / "a.png").read_bytes())[:40, :80].astype(int)
    assert (abs(corner - ink).max(-1) < 60).sum() > 20


def test_a_title_tells_the_same_once():
    info = gv.ImageInfo(channels=(gv.ChannelInfo(name="density"),), quantity="density")
    assert _color_bar(HOT, info, 0).title == "density"
    assert _color_bar(gv.Filtered(gv.Lit(HOT)), info, 0).colors is HOT


@pytest.mark.backend("cpp")
def test_nothing_seen_is_told_of_strips_too(small, tmp_path):
    run = gvtorch(
        *("render", small, "-o", tmp_path / "a.png", "--size", "1024x720"),
        *("--tf", "hot", "--window", "900,1000", "--step", "4"),
    )
    assert run.returncode == 0 and "nothing is seen: values range from" in run.stderr
    assert pixels((tmp_path / "a.png").read_bytes()).shape == (720, 1024, 3)


def test_a_small_picture_has_room_or_says_so():
    """Also where positions of ticks are not sums of powers of two."""
    fits = 0
    for width, height in itertools.product(range(8, 80, 9), range(6, 60, 3)):
        for low, high in ((0.0, 255.0), (0.0, 1.0), (-1e-3, 3.7)):
            bar = gv.ColorBar(colors=lambda v: np.zeros((len(v), 4)), low=low, high=high)
            try:
                gv.Overlay(width, height, bar=bar)
                fits += 1
            except ValueError as error:
                assert "has no room" in str(error), (width, height, low, high)
    assert fits > 50
