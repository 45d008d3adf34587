"""Films: what is written is read back."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

import gvtorch as gv
from gvtorch.base.records import RenderStats
from gvtorch.pictures.tone import from_srgb

WIDTH, HEIGHT = 48, 32


def picture(number: int, height: int = HEIGHT) -> gv.Picture:
    """Returns a gradient with a bright square that moves."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, WIDTH), indexing="ij")
    color = torch.stack((x, y, 0.3 * torch.ones_like(x)), -1)
    color[4:12, 6 * number : 6 * number + 8] = 0.95
    ones = torch.ones_like(x)[..., None]
    return gv.Picture(
        color=from_srgb(color),
        alpha=ones,
        depth=ones,
        nearest=ones,
        samples=ones.int(),
        stats=RenderStats(),
    )


def written(path, fps: int, count: int = 6) -> list[np.ndarray]:
    with gv.Video(path, WIDTH, HEIGHT, fps=fps) as video:
        assert not path.exists(), "a film appears when it is whole"
        for number in range(count):
            video.add(picture(number))
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    return [picture(number).to_srgb8().numpy().astype(int) for number in range(count)]


@pytest.mark.parametrize(("suffix", "tolerance"), [(".gif", 6), (".webp", 5)])
@pytest.mark.parametrize("fps", [7, 30])
def test_gif_and_webp_loop_at_their_speed(tmp_path, suffix, tolerance, fps):
    Image = pytest.importorskip("PIL.Image")
    expected = written(tmp_path / f"a{suffix}", fps)
    duration = 0.0
    with Image.open(tmp_path / f"a{suffix}") as film:
        assert film.n_frames == 6 and film.info["loop"] == 0
        for number, frame in enumerate(expected):
            film.seek(number)
            decoded = np.array(film.convert("RGB")).astype(int)
            duration += film.info.get("duration") or 0
            assert np.abs(decoded - frame).mean() < tolerance
    if suffix == ".gif":
        assert abs(duration - 6000 / fps) <= 5, "rounding to hundredths does not add up"


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_film_that_is_written_again_begins_anew(tmp_path, suffix):
    Image = pytest.importorskip("PIL.Image")
    video = gv.Video(tmp_path / f"a{suffix}", WIDTH, HEIGHT, fps=10)
    for count in (3, 2):
        with video:
            for number in range(count):
                video.add(picture(number))
        with Image.open(tmp_path / f"a{suffix}") as film:
            assert film.n_frames == count


def test_what_is_no_picture_is_told(tmp_path):
    with gv.Video(tmp_path / "a.gif", WIDTH, HEIGHT) as video:
        video.add(picture(0))
        with pytest.raises(ValueError, match="Video: picture must be a Picture, got int"):
            video.add(5)


def test_mp4(tmp_path):
    av = pytest.importorskip("av")
    expected = written(tmp_path / "a.mp4", 12)
    with av.open(str(tmp_path / "a.mp4")) as file:
        decoded = [frame.to_ndarray(format="rgb24").astype(int) for frame in file.decode(video=0)]
        assert file.streams.video[0].average_rate == 12
        codec = file.streams.video[0].codec_context
        tags = codec.color_primaries, codec.color_trc, codec.colorspace, codec.color_range
        assert tags == (1, 13, 6, 1), "players decode what was encoded, whatever its size"
    assert len(decoded) == 6
    for frame, other in zip(decoded, expected, strict=True):
        assert np.abs(frame - other).mean() < 12


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.webp"])
def test_a_mistake_leaves_nothing(tmp_path, name):
    with pytest.raises(ZeroDivisionError), gv.Video(tmp_path / name, WIDTH, HEIGHT) as video:
        video.add(picture(0))
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda t: gv.Video(t / "a.avi", 8, 8), r"path must end in \.mp4, \.gif, \.webp"),
        (lambda t: gv.Video(t / "a.mp4", 7, 8), "size must be even for .mp4, got 7x8"),
        (lambda t: gv.Video(t / "a.gif", 8, 8, fps=51), "fps must be an int >= 1 and <= 50"),
        (lambda t: gv.Video(t / "a.webp", 8, 8, fps=0), "fps must be an int >= 1 and <= 1000"),
        (lambda t: gv.Video(t / "x" / "a.gif", 8, 8), "folder not found"),
        (lambda t: gv.Video(t / "a.mp4", 0, 8), "width must be an int >= 1 and <= 16384, got 0"),
        (lambda t: gv.Video(t / "a.gif", 8, -2), "height must be an int >= 1"),
        (lambda t: gv.Video(t / "a.webp", 8, 16384), "height must be an int >= 1 and <= 16383"),
        (lambda t: gv.Video(t / "a.gif", "8", 8), "width must be an int"),
    ],
)
def test_bad_films_are_named(tmp_path, make, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        make(tmp_path)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_film_without_pictures_is_none(tmp_path, name):
    with pytest.raises(ValueError, match=f"no picture was added to .*{name}"):
        with gv.Video(tmp_path / name, WIDTH, HEIGHT):
            pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_pictures_are_added_within_the_block_only(tmp_path, name):
    video = gv.Video(tmp_path / name, WIDTH, HEIGHT)
    with pytest.raises(RuntimeError, match="within its with block"):
        video.add(picture(0))
    with video:
        video.add(picture(0))
    with pytest.raises(RuntimeError, match="within its with block"):
        video.add(picture(0))


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_film_that_can_not_be_opened_leaves_nothing(tmp_path, monkeypatch, name):
    video = gv.Video(tmp_path / name, WIDTH, HEIGHT)

    def fail(part):
        part.touch()
        raise OSError("no encoder")

    monkeypatch.setattr(video._film, "open", fail)
    with pytest.raises(OSError, match="no encoder"), video:
        pass
    assert not list(tmp_path.iterdir())


def test_pictures_of_another_size_are_refused(tmp_path):
    with (
        pytest.raises(ValueError, match=r"picture must be \(32, 48, 3\), got \(30, 48, 3\)"),
        gv.Video(tmp_path / "a.gif", WIDTH, HEIGHT) as video,
    ):
        video.add(picture(0, height=30))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "library"), [("a.gif", "PIL"), ("a.mp4", "av")])
def test_a_missing_library_tells_the_command(tmp_path, monkeypatch, name, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=r"pip install 'gvtorch\[video\]'"):
        gv.Video(tmp_path / name, 8, 8)
