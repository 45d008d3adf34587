"""Pictures that are refined from frame to frame, and pictures written strip by strip."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import torch
from helpers import DEVICES
from helpers.pictures import GRAY
from helpers.producers import Held
from helpers.waits import nobody_waits

import gvtorch as gv
from gvtorch.pictures.progressive import jitter, strip_rows

PARTS = ("color", "alpha", "depth")


def supersampled(tree, size: int, across: int, backend: str) -> torch.Tensor:
    """Returns colour and alpha by a grid of `across`^2 rays a pixel, with the pixels' cones."""
    camera = gv.Camera.orbit(distance=1.6, width=size * across, height=size * across)
    fine = gv.render(tree, camera, GRAY, backend=backend, cone_scale=across * 4 / 3)
    both = torch.cat((fine.color, fine.alpha), -1).double().cpu()
    return both.reshape(size, across, size, across, 4).mean((1, 3))


def test_jitter_fills_the_pixel_evenly():
    assert jitter(0) == (0.0, 0.0)
    for count in (16, 64, 256, 1024):
        offsets = np.array([jitter(index) for index in range(count)])
        assert np.abs(offsets).max() <= 0.5 and np.abs(offsets[: count - 1].mean(0)).max() < 1e-15
        # Star discrepancy over a grid of boxes: far below that of random points, 1 / sqrt(count).
        corners = np.linspace(-0.5, 0.5, 33)
        inside = (offsets[:, None, None, 0] < corners[:, None]) & (
            offsets[:, None, None, 1] < corners
        )
        area = (corners[:, None] + 0.5) * (corners + 0.5)
        assert np.abs(inside.mean(0) - area).max() < 3 / count**0.85


def test_the_mean_converges_to_the_supersampled_picture(blobs, compiled):
    """The error falls about as 1 / n."""
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[compiled])
    truth = supersampled(tree, 24, 32, compiled)
    camera = gv.Camera.orbit(distance=1.6, width=24, height=24)
    progressive = gv.Progressive(partial(gv.render, tree, shader=GRAY, backend=compiled))
    errors = {}
    for count in (1, 5, 17, 65, 257):
        picture = progressive.refine(camera, count)
        assert progressive.count == count
        mean = torch.cat((picture.color, picture.alpha), -1).double().cpu()
        errors[count] = float((mean - truth).square().mean().sqrt())
    counts = [1, 5, 17, 65]
    slope = np.polyfit(np.log(counts), np.log([errors[count] for count in counts]), 1)[0]
    assert slope < -0.8 and errors[65] < errors[1] / 40, errors
    assert errors[257] < errors[1] / 30, "where the grid that it is compared with has its own error"


def test_the_first_frame_is_the_plain_picture_and_all_are_deterministic(blobs, backend):
    tree = gv.N3Tree.from_volume(blobs, device=DEVICES[backend])
    camera = gv.Camera.orbit(width=16, height=12)
    render = partial(gv.render, tree, shader=GRAY, backend=backend, background=(0.1, 0.2, 0.3))
    plain = render(camera)
    runs = []
    for _ in range(2):
        progressive = gv.Progressive(render)
        first = progressive.frame(camera)
        for name in PARTS:
            assert torch.equal(getattr(first, name), getattr(plain, name))
        runs.append(progressive.refine(camera, 5))
    for name in PARTS:
        assert torch.equal(getattr(runs[0], name), getattr(runs[1], name))
    assert torch.equal(runs[0].depth, plain.depth) and not torch.equal(runs[0].color, plain.color)
    frames = [render(camera.shifted(*jitter(index))).color.double() for index in range(5)]
    torch.testing.assert_close(runs[0].color.double(), torch.stack(frames).mean(0))


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(
    "shader", [gv.Lit(GRAY), gv.Isosurface(0.4), gv.Projection("maximum", GRAY)]
)
def test_what_has_no_mean_is_that_of_the_centres(blobs, shader):
    tree, camera = gv.N3Tree.from_volume(blobs, 8), gv.Camera.orbit(width=20, height=14)
    layer = gv.Layer(torch.zeros(14, 20, 3), torch.full((14, 20, 1), 1e3))
    refined = gv.Progressive(partial(gv.render, tree, shader=shader, layer=layer))
    first, last = refined.frame(camera), refined.refine(camera, 6)
    assert not torch.equal(first.color, last.color)
    for name in ("depth", "nearest", "normal", "features"):
        assert torch.equal(getattr(last, name), getattr(first, name)), name


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye", "panorama", "custom"])
def test_a_camera_that_moves_begins_anew(blobs, model):
    tree = gv.N3Tree.from_volume(blobs)
    kind = "pinhole" if model == "custom" else model
    views = [gv.Camera.orbit(a, 20, 0.8, None, 12, 8, kind).placed(tree.box) for a in (0, 9)]
    if model == "custom":
        views = [gv.CustomCamera(view.rays()) for view in views]
    render = partial(gv.render, tree, shader=GRAY)
    progressive = gv.Progressive(render)
    progressive.refine(views[0], 3)
    moved = progressive.frame(views[1])
    assert progressive.count == 1 and torch.equal(moved.color, render(views[1]).color)
    progressive.frame(views[1])
    assert progressive.count == 2
    progressive.reset()
    progressive.frame(views[1])
    assert progressive.count == 1
    rays = views[0].rays()
    for count in (1, 2):
        progressive.frame(rays)
        assert progressive.count == count


@pytest.mark.backend("cpp")
def test_frames_that_miss_something_do_not_stay_in_the_mean(blobs):
    """A stalled store, then one that answers: the mean is over complete frames only."""
    tree = gv.N3Tree.from_volume(blobs, 4)
    camera = gv.Camera.orbit(distance=1.0, width=24, height=20)
    whole = [gv.render(tree, camera.shifted(*jitter(k)), GRAY) for k in range(24)]
    producer = Held(blobs)
    with gv.Engine(producer, brick_size=4) as engine:
        progressive = gv.Progressive(partial(engine.frame, shader=GRAY))
        for _ in range(4):
            coarse = progressive.frame(camera)
        assert coarse.missed.any() and not coarse.missed.all()
        stuck = coarse.missed[..., 0]
        newest = engine.frame(camera.shifted(*jitter(3)), GRAY)[0]
        assert torch.equal(coarse.color[stuck], newest.color[stuck]), "the newest, no mean"
        assert (coarse.color - whole[3].color).abs().max() > 0.02, "the test must see a difference"
        producer.hold = False
        producer.release()
        for _ in range(20):
            picture = progressive.frame(camera)
        assert progressive.count == 24 and not picture.missed.any()
    colors = torch.stack([drawn.color for drawn in whole]).double()
    expected = colors[-12:].mean(0)  # any run of complete frames is near it
    assert (picture.color - expected).abs().max() < 0.1 * (coarse.color - expected).abs().max()


@pytest.mark.backend("cuda")
def test_refining_on_cuda_waits_for_nobody(blobs):
    camera = gv.Camera.orbit(distance=1.2, width=32, height=24)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4, device="cuda") as engine:
        progressive = gv.Progressive(partial(engine.render, shader=GRAY))
        whole = progressive.refine(camera, 12)
        graph = engine.capture(camera, GRAY)
        for render in (partial(engine.frame, shader=GRAY), graph.replay):
            progressive = gv.Progressive(render)
            progressive.refine(camera, 2)
            with nobody_waits():
                picture = progressive.refine(camera, 12)
            torch.testing.assert_close(picture.color, whole.color)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("background", ["colour", "gradient", "image", "environment", "none"])
@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_strips_make_the_whole_picture(blobs, tmp_path, model, background):
    behind = {
        "colour": (0.1, 0.2, 0.3),
        "gradient": gv.Gradient((1, 0, 0), (0, 0, 1)),
        "image": torch.rand(50, 40, 3),
        "environment": gv.Environment(torch.rand(6, 12, 3)),
        "none": None,
    }[background]
    tree = gv.N3Tree.from_volume(blobs)
    camera = gv.Camera.orbit(30, 20, 0.9, None, 40, 50, model)
    render = partial(gv.render, tree, shader=GRAY, background=behind)
    whole, reports = render(camera), []
    limit = 40 * 400 * 9
    assert strip_rows(limit, 40, 50) == 8
    stats = gv.render_tiles(
        *(render, camera, tmp_path / "a.npy"),
        memory=limit,
        progress=lambda stage, done, total: reports.append((stage, done, total)),
    )
    assert reports == [("rows", min(8 * n, 50), 50) for n in range(1, 8)]
    assert stats.samples == whole.stats.samples and stats.rays == 2000
    array = np.load(tmp_path / "a.npy")
    for name, part in zip(PARTS, (slice(0, 3), slice(3, 4), slice(4, 5)), strict=True):
        np.testing.assert_allclose(array[..., part], getattr(whole, name), rtol=1e-5, atol=1e-6)
    for bits in (8, 16, 32):
        gv.render_tiles(render, camera, tmp_path / "a.tif", bits=bits, memory=limit)
        whole.save(tmp_path / "b.tif", bits=bits)
        strips, image = (gv.read_image(tmp_path / f"{name}.tif") for name in "ab")
        assert strips.shape == (50, 40, 4 if behind is None else 3)
        torch.testing.assert_close(strips, image, atol=2 / 2 ** min(bits, 16), rtol=1e-5)
    for bits in (8, 16):
        gv.render_tiles(render, camera, tmp_path / "a.png", bits=bits, memory=limit)
        whole.save(tmp_path / "b.png", bits=bits)
        strips, image = (gv.read_image(tmp_path / f"{name}.png") for name in "ab")
        assert strips.shape == image.shape
        torch.testing.assert_close(strips, image, atol=2 / 2**bits, rtol=1e-5)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["a.npy", "a.png", "a.tif", "b.png", "b.tif"]


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("shader", [gv.Lit(GRAY), gv.Projection("mean", GRAY)], ids=["lit", "mean"])
def test_strips_of_pictures_with_normals_and_with_any_number_of_features(blobs, tmp_path, shader):
    render = partial(gv.render, gv.N3Tree.from_volume(blobs), shader=shader)
    camera = gv.Camera.orbit(width=20, height=24)
    gv.render_tiles(render, camera, tmp_path / "a.tif", memory=20 * 400 * 9)
    render(camera).save(tmp_path / "b.tif")
    strips, image = (gv.read_image(tmp_path / f"{name}.tif") for name in "ab")
    assert torch.equal(strips, image) and image.max() > 0.1


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("alpha", [None, 0.5])
def test_strips_take_their_part_of_a_layer(blobs, tmp_path, alpha):
    tree, camera = gv.N3Tree.from_volume(blobs), gv.Camera.orbit(30, 20, 0.9, None, 40, 50)
    depth = torch.rand(50, 40, 1) * 40
    opacity = None if alpha is None else torch.full_like(depth, alpha)
    layer = gv.Layer(torch.rand(50, 40, 3), depth, opacity)
    render = partial(gv.render, tree, shader=GRAY, layer=layer)
    gv.render_tiles(render, camera, tmp_path / "a.npy", memory=40 * 400 * 9)
    array = np.load(tmp_path / "a.npy")
    np.testing.assert_allclose(array[..., :3], render(camera).color, rtol=1e-5, atol=1e-6)


@pytest.mark.backend("cpp")
def test_an_engine_streams_strip_by_strip(blobs, tmp_path):
    camera = gv.Camera.orbit(distance=1.2, width=40, height=50)
    whole = gv.render(gv.N3Tree.from_volume(blobs, 4), camera, GRAY)
    with gv.Engine(gv.VolumeProducer(blobs), brick_size=4) as engine:
        parts = []

        def render(strip):
            picture = engine.render(strip, GRAY)
            parts.append(picture.stats)
            return picture

        stats = gv.render_tiles(render, camera, tmp_path / "a.npy", memory=40 * 400 * 12)
    assert stats.converged and stats.rays == 2000 and len(parts) > 1
    assert stats.frames == sum(part.frames for part in parts)
    assert stats.produced["bricks"] == sum(part.produced["bricks"] for part in parts) > 0
    assert stats.bricks_used == max(part.bricks_used for part in parts)
    np.testing.assert_allclose(np.load(tmp_path / "a.npy")[..., :3], whole.color, atol=1e-6)


MEASURE = """
import resource, sys, threading, torch
from functools import partial
import gvtorch as gv
torch.set_num_threads(1)
tree = gv.N3Tree.from_volume(gv.Volume(torch.ones(4, 4, 4)))
shader = gv.TransferFunction.preset("gray", 0, 2)
render = partial(gv.render, tree, shader=shader)
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
size = int(sys.argv[1])
gv.render_tiles(render, gv.Camera.orbit(width=64, height=64), "warm.tif")
before = peak()
camera = gv.Camera.orbit(width=size, height=size)
for name in sys.argv[2:]:
    gv.render_tiles(render, camera, name, memory="24 MB")
print(peak() - before)
"""


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_memory_is_bounded_whatever_the_size(tmp_path):
    """The layers of 2048^2 pixels alone would take 100 MB."""
    names = ["a.png", "a.tif", "a.npy"]
    command = [sys.executable, "-c", MEASURE, "2048", *names]
    run = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert float(run.stdout) < 60
    for name in names:
        assert gv.read_image(tmp_path / name).shape[:2] == (2048, 2048)


def test_what_breaks_off_leaves_no_file(blobs, tmp_path):
    tree, calls = gv.N3Tree.from_volume(blobs), []

    def render(camera):
        calls.append(camera)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return gv.render(tree, camera, GRAY)

    camera = gv.Camera.orbit(width=16, height=16)
    with pytest.raises(KeyboardInterrupt):
        gv.render_tiles(render, camera, tmp_path / "a.tif", memory=16 * 400 * 4)
    assert len(calls) == 3 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t, c: gv.Progressive(3), "render must be callable, got int"),
        (lambda t, c: gv.Progressive(print).refine(c, 0), "samples must be an int >= 1, got 0"),
        (lambda t, c: gv.Progressive(print).frame(3), "camera must be a Camera, got int"),
        (lambda t, c: gv.render_tiles(3, c, t / "a.tif"), "render must be callable, got int"),
        (lambda t, c: gv.render_tiles(repr, c, t / "a.tif"), "returns must be a Picture, got str"),
        (lambda t, c: gv.Progressive(repr).frame(c), "returns must be a Picture, got str"),
        (
            lambda t, c: gv.render_tiles(print, c, t / "a.exr"),
            "must end in .png, .tif or .npy, got",
        ),
        (lambda t, c: gv.render_tiles(print, c, t / "b" / "a.tif"), "folder not found"),
        (lambda t, c: gv.render_tiles(print, c, t / "a.tif", bits=9), "8, 16 or 32 bits, got 9"),
        (lambda t, c: gv.render_tiles(print, c, t / "a.tif", memory="x"), "memory must be bytes"),
        (lambda t, c: gv.render_tiles(print, None, t / "a.tif"), "camera must be a Camera"),
        (
            lambda t, c: gv.render_tiles(print, gv.Camera.orbit([0.0, 1.0]), t / "a.tif"),
            "camera must be one, got a batch of 2",
        ),
    ],
)
def test_bad_input_is_named(tmp_path, call, message):
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        call(tmp_path, gv.Camera.orbit(width=8, height=8))
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
