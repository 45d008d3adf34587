"""Backgrounds, tone curves, sRGB, and files of pictures, written and read."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import torch
from helpers import DEVICES

import gvtorch as gv
from gvtorch.base.records import RenderStats
from gvtorch.pictures.tone import from_srgb, to_srgb, tone_map

HAZE = gv.TransferFunction.from_points([(0, 0), (1, 0.05)], [(0, 1, 0.5, 0.2), (1, 0.2, 0.9, 1)])
VIEW = {"distance": 1.2, "width": 20, "height": 14}


@pytest.fixture(scope="module")
def tree(blobs):
    return gv.N3Tree.from_volume(blobs)


@pytest.fixture
def clear(tree):
    """A picture without background: some pixels empty, some nearly opaque."""
    picture = gv.render(tree, gv.Camera.orbit(**VIEW), HAZE, background=None)
    assert picture.transparent and picture.alpha.min() == 0 and picture.alpha.max() > 0.4
    return picture


def made(color: torch.Tensor, alpha: torch.Tensor | None = None) -> gv.Picture:
    """Returns a picture of a given colour; transparent if alpha is given."""
    ones = torch.ones_like(color[..., :1])
    return gv.Picture(
        color=color,
        alpha=ones if alpha is None else alpha,
        depth=ones * math.inf,
        nearest=ones * math.inf,
        samples=ones.int(),
        transparent=alpha is not None,
        stats=RenderStats(),
    )


def srgb(x: np.ndarray) -> np.ndarray:
    """Returns sRGB of linear values (IEC 61966-2-1)."""
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def test_a_transparent_picture_over_a_colour_is_the_picture_over_it(tree, clear):
    for color in ((0.0, 0.0, 0.0), (0.2, 0.4, 0.6)):
        over = gv.render(tree, gv.Camera.orbit(**VIEW), HAZE, background=color)
        expected = clear.color + (1 - clear.alpha) * torch.tensor(color)
        assert torch.equal(over.color, expected) and torch.equal(over.alpha, clear.alpha)


def test_a_gradient_is_even_in_linear_light(tree, backend):
    tree = gv.N3Tree.from_volume(
        gv.Volume(torch.zeros(4, 4, 4)), device=DEVICES[backend]
    )  # nothing but background
    top, bottom = torch.tensor([0.9, 0.5, 2.0]), torch.tensor([0.1, 0.5, 0.0])
    behind = gv.Gradient(top.tolist(), bottom.tolist())
    picture = gv.render(
        tree,
        gv.Camera.orbit([0.0, 9.0], width=3, height=10),
        HAZE,
        backend=backend,
        background=behind,
    )
    fraction = (torch.arange(10) + 0.5)[:, None, None] / 10
    expected = (top + (bottom - top) * fraction).expand(2, 10, 3, 3)
    torch.testing.assert_close(picture.color.cpu(), expected)


def test_an_image_stands_behind_pixel_by_pixel(tree, clear):
    image = torch.rand(14, 20, 3)
    for background in (image, gv.Backdrop(image), image.double()):
        over = gv.render(tree, gv.Camera.orbit(**VIEW), HAZE, background=background)
        torch.testing.assert_close(over.color, clear.color + (1 - clear.alpha) * image)
    batch = gv.Camera.orbit([30.0, 60.0], **VIEW)
    images = torch.rand(2, 14, 20, 3)
    over = gv.render(tree, batch, HAZE, background=images)
    bare = gv.render(tree, batch, HAZE, background=None)
    torch.testing.assert_close(over.color, bare.color + (1 - bare.alpha) * images)


def test_an_environment_is_what_a_panorama_takes(backend):
    """Seen by a panorama camera along -z, each pixel is its texel; by any other camera, the texel
    in the ray's direction."""
    empty = gv.N3Tree.from_volume(gv.Volume(torch.zeros(4, 4, 4)), device=DEVICES[backend])
    image = torch.rand(12, 24, 3)
    sky = gv.Environment(image)
    camera = gv.Camera.look_at((0, 0, 9), (0, 0, 0), width=24, height=12, model="panorama")
    picture = gv.render(empty, camera, HAZE, backend=backend, background=sky)
    torch.testing.assert_close(picture.color.cpu(), image, atol=2e-6, rtol=0)
    turned = gv.Camera.look_at((0, 0, 9), (1, 0, 9), width=24, height=12, model="panorama")
    picture = gv.render(empty, turned, HAZE, backend=backend, background=sky)
    torch.testing.assert_close(picture.color.cpu(), image.roll(-6, 1), atol=2e-6, rtol=0)


def test_an_environment_blends_between_texels_and_around(backend):
    device = DEVICES[backend]
    image = torch.zeros(2, 4, 3)
    image[:, 0], image[:, 3] = 1.0, 3.0  # next to the seam, which lies in +z
    sky = gv.Environment(image)
    directions = torch.tensor(
        [[0, 0, 1.0], [1, 0, 1], [-1, 0, 1], [0, 1, 0], [0, 0, -1]], device=device
    ).double()
    colors = sky.look_up(directions / directions.norm(dim=1, keepdim=True))[:, 0].cpu()
    assert colors[[0, 1, 2, 4]].tolist() == pytest.approx([2, 3, 1, 0], abs=1e-5)
    up = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z is up in the world
    tall = gv.Environment(torch.linspace(1, 0, 64)[:, None, None].expand(64, 8, 3), rotation=up)
    seen = tall.look_up(torch.tensor([[0, 0, 1.0], [0, 0, -1]], device=device))[:, 0].cpu()
    assert seen.tolist() == pytest.approx([1, 0], abs=1e-6)


@pytest.mark.backend("cpp")
def test_an_engine_has_the_same_backgrounds(blobs, tree):
    sky = gv.Environment(torch.rand(6, 12, 3))
    with gv.Engine(gv.VolumeProducer(blobs)) as engine:
        for background in (None, sky, torch.rand(14, 20, 3), gv.Gradient((1, 0, 0), (0, 0, 1))):
            camera = gv.Camera.orbit(**VIEW)
            whole = gv.render(tree, camera, HAZE, background=background)
            for picture in (
                engine.render(camera, HAZE, background=background),
                engine.frame(camera, HAZE, background=background)[0],
            ):
                assert torch.equal(picture.color, whole.color)
                assert picture.transparent == (background is None)


def test_srgb_is_the_exact_curve_and_back():
    linear = torch.cat((torch.linspace(0, 1, 4097), torch.tensor([0.0031307, 0.0031309])))
    color = linear.double()[:, None].expand(-1, 3)[None]
    encoded = to_srgb(color)
    np.testing.assert_allclose(encoded.numpy(), srgb(color.numpy()), atol=1e-12)
    torch.testing.assert_close(from_srgb(encoded), color, atol=1e-7, rtol=0)


def test_curves_follow_their_formulas():
    x = torch.linspace(0, 12, 50)[:, None] * torch.tensor([1.0, 0.6, 0.2])
    doubled = tone_map(x, "none", exposure=1.0)
    torch.testing.assert_close(doubled, (2 * x).clamp(0, 1))
    light = 0.2126 * x[:, 0] + 0.7152 * x[:, 1] + 0.0722 * x[:, 2]
    factor = (1 + light / 9) / (1 + light)
    torch.testing.assert_close(
        tone_map(x, "reinhard", white=3.0), (x * factor[:, None]).clamp(0, 1)
    )
    assert tone_map(torch.full((1, 3), 3.0), "reinhard", white=3.0).tolist()[0] == pytest.approx(
        [1, 1, 1]
    )
    aces = tone_map(x, "aces")
    expected = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14)
    torch.testing.assert_close(aces, expected.clamp(0, 1))
    assert bool((aces[1:] >= aces[:-1]).all()) and aces.max() <= 1


@pytest.mark.parametrize("curve", ["none", "reinhard", "aces"])
def test_nan_and_infinity_are_black_and_white(curve, tmp_path):
    color = torch.tensor([math.nan, math.inf, -math.inf, 1e30, -1.0])[:, None].expand(5, 3)[None]
    for picture in (made(color), made(color).tone_map(curve)):
        assert picture.to_srgb8()[0, :, 0].tolist() == [0, 255, 0, 255, 0]
    picture = made(color, torch.tensor([0, math.nan, 1, 1, 1])[None, :, None])
    picture.save(tmp_path / "a.png")
    picture.save(tmp_path / "a.exr", bits=16)
    seen = gv.read_image(tmp_path / "a.png")
    assert seen[0, :, 3].tolist() == [0, 0, 1, 1, 1] and seen[0, 3, 0] == 1
    assert torch.isfinite(tone_map(color, curve)).all()
    for stops in (10, 100):
        bright = torch.tensor([[1e38, 0.0, 1.0], [math.inf, 1e30, 0]])
        mapped = tone_map(bright, curve, exposure=stops)
        assert torch.isfinite(mapped).all() and (mapped[:, 0] == 1).all()


def test_tone_of_a_transparent_picture_is_that_of_its_straight_colour(clear):
    mapped = clear.tone_map("aces", exposure=0.5)
    inside = (clear.alpha > 0)[..., 0]
    straight = clear.color[inside] / clear.alpha[inside]
    torch.testing.assert_close(
        mapped.color[inside], tone_map(straight, "aces", exposure=0.5) * clear.alpha[inside]
    )
    assert mapped.color[~inside].abs().max() == 0 and mapped.transparent


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_integer_files_hold_srgb_and_straight_alpha(tmp_path, clear, ending, bits):
    from imagecodecs import png_decode
    from tifffile import imread

    path = tmp_path / f"a{ending}"
    white = 2**bits - 1
    inside = (clear.alpha > 0)[..., 0].numpy()
    straight = np.divide(
        *(clear.color.double().numpy(), clear.alpha.double().numpy()),
        out=np.zeros((14, 20, 3)),
        where=inside[..., None],
    )
    clear.save(path, bits=bits)
    pixels = imread(path) if ending == ".tif" else png_decode(path.read_bytes())
    assert pixels.shape == (14, 20, 4) and pixels.dtype == f"uint{bits}"
    assert np.abs(pixels[..., 3] - clear.alpha[..., 0].numpy() * white).max() <= 0.51
    error = np.abs(pixels[..., :3] - srgb(straight.clip(0, 1)) * white)
    assert error.max() <= (0.51 if bits == 16 else 0.52)
    again = gv.read_image(path)
    torch.testing.assert_close(
        again[..., :3], torch.from_numpy(straight).float().clamp(0, 1), atol=3 / white, rtol=0
    )
    opaque = made(torch.rand(6, 5, 3))
    opaque.save(path, bits=bits)
    assert gv.read_image(path).shape == (6, 5, 3)
    torch.testing.assert_close(gv.read_image(path), opaque.color, atol=3 / white, rtol=0)


@pytest.mark.parametrize("bits", [16, 32])
def test_exr_holds_linear_light_and_every_layer(tmp_path, clear, bits):
    OpenEXR = pytest.importorskip("OpenEXR")
    path = tmp_path / "a.exr"
    clear.save(path, bits=bits)
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    kind = np.float16 if bits == 16 else np.float32
    expected = torch.cat((clear.color, clear.alpha), -1).numpy().astype(kind)
    for index, name in enumerate("RGBA"):
        assert channels[name].pixels.dtype == kind
        np.testing.assert_array_equal(channels[name].pixels, expected[..., index])
    np.testing.assert_array_equal(channels["Z"].pixels, clear.depth[..., 0].numpy())
    np.testing.assert_array_equal(channels["samples"].pixels, clear.samples[..., 0].numpy())
    read = gv.read_image(path).numpy()
    np.testing.assert_array_equal(read, expected.astype(np.float32))


def test_numpy_files_hold_every_layer(tmp_path, tree):
    picture = gv.render(tree, gv.Camera.orbit([0.0, 50.0], **VIEW), HAZE)
    picture.save(tmp_path / "a.npz")
    picture.save(tmp_path / "a.npy")
    with np.load(tmp_path / "a.npz") as file:
        for name in ("color", "alpha", "depth", "samples"):
            np.testing.assert_array_equal(file[name], getattr(picture, name).numpy())
        assert file["samples"].dtype == np.int32
        layers = [file[n].astype(np.float32) for n in ("color", "alpha", "depth", "samples")]
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), np.concatenate(layers, -1))


def test_a_batch_is_laid_side_by_side(tmp_path, tree):
    picture = gv.render(tree, gv.Camera.orbit([0.0, 50.0], **VIEW), HAZE)
    for ending in ("png", "tif", "exr"):
        if ending == "exr":
            pytest.importorskip("OpenEXR")
        picture.save(tmp_path / f"a.{ending}")
        image = gv.read_image(tmp_path / f"a.{ending}")
        assert image.shape[:2] == (14, 40)
        torch.testing.assert_close(image[:, 20:, :3], picture.color[1], atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p, t: p.save(t / "a.jpg"), "must end in .png, .tif, .exr, .npy or .npz, got"),
        (lambda p, t: p.save(t / "a.png", bits=12), ".png has 8 or 16 bits, got 12"),
        (lambda p, t: p.save(t / "no" / "a.png"), "folder not found"),
        (lambda p, t: p.tone_map("film"), "curve must be 'none', 'reinhard' or 'aces', got 'film'"),
        (lambda p, t: p.tone_map(exposure=math.nan), "exposure must be finite"),
        (lambda p, t: p.tone_map(white=0), "white must be finite and >= 1e-09 and <= 1e+09"),
        (lambda p, t: gv.Environment(torch.full((2, 2, 3), math.nan)), "image must be finite"),
        (
            lambda p, t: gv.Environment(torch.ones(3, 4)),
            "image must be (h, w, 3) floats, got (3, 4)",
        ),
        (
            lambda p, t: gv.Environment(torch.ones(0, 4, 3)),
            "image must be (h, w, 3) floats, got (0",
        ),
        (
            lambda p, t: gv.Backdrop(torch.full((2, 2, 3), math.nan)),
            "Backdrop: image must be finite",
        ),
        (
            lambda p, t: gv.RenderOptions(background=torch.ones(2, 2, 3, dtype=torch.uint8)),
            "(n, h, w, 3) floats, got (2, 2, 3) uint8",
        ),
        (
            lambda p, t: gv.Environment(torch.ones(2, 2, 3), rotation=torch.ones(3, 3)),
            "rotation must be (3, 3) and orthonormal",
        ),
        (lambda p, t: gv.Gradient((0, 0, -1), (0, 0, 0)), "top must be finite and >= 0"),
        (lambda p, t: gv.Gradient((0, 0, 0), (0, 0)), "bottom must be three numbers"),
        (lambda p, t: gv.RenderOptions(background="reddish"), "background must be three numbers"),
        (lambda p, t: gv.RenderOptions(background=torch.ones(3, 4)), "image must be (h, w, 3)"),
        (lambda p, t: gv.read_image(t / "a.gif"), "path must end in .png, .exr, .npy, .tif, got"),
        (lambda p, t: gv.read_image(t / "a.png"), "image not found"),
        (lambda p, t: gv.read_image(written(t / "b.png", b"x")), "b.png: can't be read: no PNG"),
        (lambda p, t: gv.read_image(written(t / "b.npy", b"x")), "b.npy: can't be read"),
        (lambda p, t: gv.read_image(flat(t / "c.npy")), "must hold (h, w, 3) numbers, got (3, 4)"),
        (lambda p, t: gv.read_image(tiff(t / "c.tif", 5)), "must be RGB, got SEPARATED"),
        (lambda p, t: gv.read_image(tiff(t / "b.tif", 6)), "must be RGB, got YCBCR"),
        (lambda p, t: gv.read_image(tiff(t / "b8.tif", 8)), "must be RGB, got CIELAB"),
    ],
)
def test_bad_input_is_named(tmp_path, call, message):
    picture = made(torch.rand(4, 4, 3))
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        call(picture, tmp_path)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not [path for path in tmp_path.iterdir() if path.name[0] not in "bc"]


def written(path, content: bytes):
    path.write_bytes(content)
    return path


def tiff(path, photometric: int):
    """Writes a TIFF of three numbers a pixel, or of four inks."""
    import tifffile

    pixels = np.zeros((3, 5, 4 if photometric == 5 else 3), np.uint8)
    tifffile.imwrite(path, pixels, photometric=photometric, planarconfig="contig")
    return path


def flat(path):
    np.save(path, np.ones((3, 4)))
    return path


def test_a_background_of_another_size_is_named(tree):
    camera = gv.Camera.orbit(**VIEW)
    with pytest.raises(ValueError, match=r"background image must be \(14, 20, 3\), got \(20, 14"):
        gv.render(tree, camera, HAZE, background=torch.ones(20, 14, 3))


@pytest.mark.parametrize(("ending", "library"), [("exr", "OpenEXR"), ("tif", "tifffile")])
def test_a_missing_library_is_named_and_leaves_no_file(tmp_path, monkeypatch, ending, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf"\.{ending} needs {library}: pip install"):
        made(torch.rand(4, 4, 3)).save(tmp_path / f"a.{ending}")
    assert not list(tmp_path.iterdir())


def test_a_folder_is_not_replaced(tmp_path):
    """The message names the picture, not the file that was to take its place."""
    (tmp_path / "a.png").mkdir()
    with pytest.raises(OSError, match=r"can't be written: Is a directory: '.*/a\.png'"):
        made(torch.rand(4, 4, 3)).save(tmp_path / "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    good = made(torch.rand(4, 4, 3))
    good.save(path)
    before = path.read_bytes()

    def full(part, **_layers):
        part.write_bytes(before[:100])
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        good.save(path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
