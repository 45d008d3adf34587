"""Channels of one image: a dense marcher, closed forms, channel looks, and the command line."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest
import torch
from helpers import DEVICES, gvtorch
from helpers.marcher import box_of, orbit_rays, trilinear
from helpers.rays import camera_rays
from helpers.traces import assert_equal, trace

import gvtorch as gv
from gvtorch import cpp_ext
from gvtorch.base.image_info import COLORS
from gvtorch.shaders.channels import DEFAULT_COLORS, MAX_CHANNELS, channel_color
from gvtorch.tools.parse import parse_channels

SPACING, ORIGIN = (1.0, 0.8, 1.3), (3.0, -2.0, 5.0)
MODES = ["additive", "opacity"]
FUNCTIONS = [  # component, reference length, function
    (
        2,
        1.1,
        gv.TransferFunction([(50, 0), (90, 0.3), (200, 0.6)], [(50, 1, 0, 0), (200, 1, 1, 0)]),
    ),
    (0, None, gv.TransferFunction([(20, 0), (120, 0.5)], [(0, 0, 1, 0)])),
    (1, 3.0, gv.TransferFunction([(100, 0), (130, 0.8), (160, 0)], [(0, 0.1, 0.2, 1)])),
]
for _, reference, function in FUNCTIONS:
    function.reference = reference


def looks() -> list[gv.ChannelLook]:
    return [gv.ChannelLook(transfer=f, component=c) for c, _, f in FUNCTIONS]


def blobs(width: int = 3, extent=(23, 31, 19)) -> np.ndarray:
    """Returns (z, y, x, c) smooth numbers from 0 to 255."""
    coarse = torch.rand((1, width, 5, 5, 5), generator=torch.Generator().manual_seed(width))
    field = torch.nn.functional.interpolate(coarse, size=extent[::-1], mode="trilinear")[0]
    return ((field - 0.5) * 1.6 + 0.5).clamp(0, 1).movedim(0, -1).numpy() * 255


def seen_from_outside(data) -> tuple[np.ndarray, np.ndarray]:
    return orbit_rays(box_of(data.shape[:3], SPACING, ORIGIN), 30, 20, 1.6, 30, 15, 15)


@functools.cache
def dense(mode: str, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns color (r, 3) and alpha (r,) by the formula, in float64, without tree or table."""
    data = blobs().round()
    eye, direction = seen_from_outside(data)
    box = box_of(data.shape[:3], SPACING, ORIGIN)
    with np.errstate(divide="ignore"):
        a, b = (box[0] - eye) / direction, (box[1] - eye) / direction
    near, far = np.minimum(a, b).max(1).clip(0), np.maximum(a, b).min(1)
    color, clear = np.zeros_like(direction), np.ones(len(direction))
    for k in range(int(np.ceil((far - near).max() / step)) + 1):
        start = near + k * step
        end = np.minimum(start + step, far)
        on = start < far
        middle, length = ((start + end) / 2)[:, None], (end - start)
        index = (eye + middle * direction - ORIGIN) / SPACING
        layers = []
        for component, reference, function in FUNCTIONS:
            value = trilinear(data[..., component].astype(np.float64), index)
            rgb = np.stack(
                [np.interp(value, function.color[:, 0], c) for c in function.color.T[1:]]
            )
            alpha = np.interp(value, *function.opacity.T)
            layers.append((rgb.T, -np.log2(1 - alpha) * length / (reference or min(SPACING))))
        each = np.array([halvings for _, halvings in layers])
        total = each.max(0) if mode == "additive" else each.sum(0)
        glow = sum(rgb * halvings[:, None] for rgb, halvings in layers)
        on &= total > 0
        alpha = np.where(on, 1 - 2.0**-total, 0)
        color += (clear * alpha / np.where(on, total, 1))[:, None] * glow
        clear = clear * (1 - alpha)
    return color, 1 - clear


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", MODES)
def test_the_picture_is_that_of_a_dense_marcher(backend, mode, dtype):
    data = blobs().round().astype(np.uint8)
    tree = gv.N3Tree.from_volume(gv.Volume(data, SPACING, ORIGIN), 4, device=DEVICES[backend])
    eye, direction = seen_from_outside(data)
    rays = gv.Rays(
        origin=torch.from_numpy(eye.copy()),
        direction=torch.from_numpy(direction),
        cone=torch.zeros(len(eye), 2),
        range=torch.tensor([0.0, np.inf], dtype=torch.float64).repeat(len(eye), 1),
    )
    options = {"lod": "finest", "step": 1.2, "stop_alpha": 1.0, "dtype": dtype}
    hits, _ = trace(tree, backend, rays, gv.Channels(looks(), mode), **options)
    color, alpha = dense(mode, 1.2 * min(SPACING))
    assert alpha.max() > 0.9 and len(np.unique(color.round(2), axis=0)) > 50
    assert np.abs(hits["color"].numpy() - color).max() < 1e-4
    assert np.abs(hits["alpha"].numpy()[:, 0] - alpha).max() < 1e-4


def ways(tree: gv.N3Tree, rays: gv.Rays) -> np.ndarray:
    """Returns the lengths (r,) of rays within a tree's box."""
    low, high = tree.box.cpu().numpy()
    origin, direction = rays.origin.cpu().numpy(), rays.direction.cpu().numpy()
    with np.errstate(divide="ignore"):
        a, b = (low - origin) / direction, (high - origin) / direction
    near, far = np.minimum(a, b).max(1).clip(0), np.maximum(a, b).min(1)
    return (far - near).clip(0)


@pytest.mark.parametrize("regions", ["one value", "bricks"])
@pytest.mark.parametrize("mode", MODES)
def test_no_step_and_no_level_changes_even_matter(backend, mode, regions):
    """Closed form, from any distance, for a CONSTANT region, and for bricks that nearly are."""
    values = (25.0, 105.0, 52.0)  # thin
    data = np.broadcast_to(np.array(values, np.float32), (24, 24, 24, 3)).copy()
    if regions == "bricks":
        data += np.random.default_rng(1).uniform(-1e-4, 1e-4, data.shape).astype(np.float32)
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4, device=DEVICES[backend])
    assert bool(tree.bricks.capacity) is (regions == "bricks")
    shader = gv.Channels(looks(), mode)
    rgba = {c: (f(np.array(values[c])), reference or 1.0) for c, reference, f in FUNCTIONS}
    each = np.array([-np.log2(1 - r[3]) / reference for r, reference in rgba.values()])
    glow = sum(r[:3] * h for (r, _), h in zip(rgba.values(), each, strict=True))
    total = each.max() if mode == "additive" else each.sum()
    # Each distance with one step; another one in each mode and for the other regions.
    steps = np.roll((0.25, 0.5, 2.0), MODES.index(mode) + (regions == "bricks"))
    for distance, step in zip((0.8, 6.0, 60.0), steps.tolist(), strict=True):
        rays = camera_rays(tree, 7, distance=distance)
        hits, _ = trace(tree, backend, rays, shader, step=step, stop_alpha=1.0)
        alpha = 1 - 2.0 ** -(total * ways(tree, rays))
        assert 0.2 < alpha.max() < 0.95
        assert np.abs(hits["alpha"].numpy()[:, 0] - alpha).max() < 2e-5
        color = alpha[:, None] * (glow / total)
        assert np.abs(hits["color"].numpy() - color).max() < 2e-5


@pytest.mark.parametrize("mode", MODES)
def test_a_channel_alone_is_its_transfer_function(backend, mode):
    data = blobs(1)
    tree = gv.N3Tree.from_volume(gv.Volume(data, SPACING), 4, device=DEVICES[backend])
    function = FUNCTIONS[0][2]
    for distance in (0.3, 1.6, 5.0):
        rays = camera_rays(tree, 12, distance=distance)
        alone, _ = trace(tree, backend, rays, function)
        hits, _ = trace(tree, backend, rays, gv.Channels([function], mode))
        for name in ("color", "alpha"):
            torch.testing.assert_close(hits[name], alone[name], atol=2e-5, rtol=0)
    assert alone["alpha"].max() > 0.3


def test_what_is_added_keeps_its_brightness_and_what_is_mixed_does_not(backend):
    """Red and green matter at one position: yellow, or half as bright."""
    data = np.full((9, 9, 9, 2), 100, np.uint8)
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4, device=DEVICES[backend])
    two = [gv.ChannelLook(color=c, window=(0, 100), opacity=0.9) for c in ("red", "green")]
    rays = camera_rays(tree, 5, distance=1.2)
    for mode, bright in (("additive", 1.0), ("opacity", 0.5)):
        hits, _ = trace(tree, backend, rays, gv.Channels(two, mode))
        middle = hits["color"][12] / hits["alpha"][12]
        torch.testing.assert_close(middle, torch.tensor([bright, bright, 0.0]))
    expected, _ = trace(tree, backend, rays, gv.Channels(two[:1]))
    hits, _ = trace(tree, backend, rays, gv.Channels(two))
    torch.testing.assert_close(hits["alpha"], expected["alpha"]), "it hides as much as one alone"


DTYPES = ["uint8", "int16", "uint16", "float16", "bfloat16", "float32"]
WIDTHS = [1, 2, 3, 5, 16]


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_every_dtype_and_width(compiled, dtype, width):
    data = torch.from_numpy(blobs(width, (20, 17, 13)) / 2).to(getattr(torch, dtype))
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4)
    order = torch.randperm(width, generator=torch.Generator().manual_seed(3)).tolist()
    mixed = [
        gv.ChannelLook(window=(20 + c, 110 + c), component=c, color=DEFAULT_COLORS[c])
        for c in order
    ]
    number, other = DTYPES.index(dtype), WIDTHS.index(width)  # each pair of values is met
    mode, distance = MODES[(number + other) % 2], (0.9, 4.0)[(number // 2 + other // 2) % 2]
    rays = camera_rays(tree, 10, distance=distance)
    shader = gv.Channels(mixed, mode)
    expected, _, actual = assert_equal(tree, compiled, rays, shader)
    for name in ("color", "alpha", "depth", "samples"):
        assert torch.equal(actual[name], expected[name]), name
    backwards, _ = trace(tree, compiled, rays, gv.Channels(mixed[::-1], mode))
    torch.testing.assert_close(backwards["color"], expected["color"], atol=1e-5, rtol=0)
    assert expected["alpha"].max() > 0.1


@pytest.mark.backend("cpp")
def test_a_node_is_left_out_where_no_channel_shows_anything():
    """Each channel is visible at one end of the box; nodes between are neither read nor sampled."""
    data = np.zeros((16, 16, 64, 2), np.uint8)
    data += np.random.default_rng(2).integers(0, 9, data.shape, dtype=np.uint8)
    data[:, :, :14, 0] += 100
    data[:, :, 50:, 1] += 100
    tree = gv.N3Tree.from_volume(gv.Volume(data), 4)
    rays = camera_rays(tree, 24, distance=1.4)
    first, second = (gv.ChannelLook(window=(50, 120), component=c) for c in (0, 1))
    both = gv.Channels([first, second])
    samples = {}
    for name, visible in (("one", (True, False)), ("two", (False, True)), ("both", (True, True))):
        first.visible, second.visible = visible
        samples[name] = int(gv.trace(tree, rays, both).samples.sum())
    assert samples["both"] <= samples["one"] + samples["two"]
    assert max(samples["one"], samples["two"]) < samples["both"]
    first.visible = second.visible = False
    hits = gv.trace(tree, rays, both)
    assert int(hits.samples.sum()) == 0 and float(hits.alpha.max()) == 0


def test_an_engine_draws_each_bit_of_the_resident_tree(backend):
    if backend == "reference":
        pytest.skip("the twin takes its time")
    channels = {"value": gv.Volume(blobs(5, (40, 36, 44)).round().astype(np.uint16), SPACING)}
    shader = gv.Channels([gv.ChannelLook(window=(90 + c, 220)) for c in range(5)])
    camera = gv.Camera.orbit(width=32, height=24, distance=1.5)
    device = DEVICES[backend]
    resident = gv.render(gv.N3Tree.from_volume(channels, 8, device=device), camera, shader)
    slot = 10**3 * 2 * 5
    with gv.Engine(
        gv.VolumeProducer(channels), brick_size=8, brick_pool=60 * slot, device=device
    ) as engine:
        picture = engine.render(camera, shader)
        assert picture.stats.converged
        for name in ("color", "alpha", "depth"):
            assert torch.equal(getattr(picture, name), getattr(resident, name)), name
        shader.looks[2].color = "white"
        edited = engine.render(camera, shader)
    assert (edited.color - picture.color).abs().max() > 0.05
    assert resident.alpha.max() > 0.5


@pytest.mark.parametrize(
    "edit",
    [
        lambda s: setattr(s.looks[0], "color", (0.0, 0.3, 1.0)),
        lambda s: setattr(s.looks[0], "window", (10.0, 90.0)),
        lambda s: setattr(s.looks[1], "visible", False),
        lambda s: setattr(s.looks[1], "component", 2),
        lambda s: setattr(s.looks[1], "opacity", 0.05),
        lambda s: setattr(s, "mode", "opacity"),
        lambda s: s.looks.pop(),
        lambda s: s.looks.reverse(),
    ],
)
def test_looks_may_be_edited_between_pictures(edit):
    def shader() -> gv.Channels:
        return gv.Channels([gv.ChannelLook(window=(60, 200), component=c) for c in (0, 1)])

    tree = gv.N3Tree.from_volume(gv.Volume(blobs()), 8)
    camera = gv.Camera.orbit(width=24, height=24, distance=1.6)
    kept, new = shader(), shader()
    before = gv.render(tree, camera, kept)
    edit(kept)
    after = gv.render(tree, camera, kept)
    edit(new)
    assert torch.equal(after.color, gv.render(tree, camera, new).color)
    assert (after.color - before.color).abs().max() > 0.02


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("mode", MODES)
def test_clip_layer_and_lens_take_channels(mode):
    tree = gv.N3Tree.from_volume(gv.Volume(blobs()), 8)
    camera = gv.Camera.orbit(width=24, height=24, distance=1.6)
    shader = gv.Channels([gv.ChannelLook(window=(60, 200)) for _ in range(3)], mode)
    whole = gv.render(tree, camera, shader, stop_alpha=1.0)
    low, high = tree.box.tolist()
    middle = (low[0] + high[0]) / 2
    halves = [(low, (middle, *high[1:])), ((middle, *low[1:]), high)]
    parts = gv.render(tree, camera, shader, stop_alpha=1.0, clip=gv.Clip(boxes=halves))
    assert (parts.color - whole.color).abs().max() < 0.03, "a ray in two pieces"
    half = gv.render(tree, camera, shader, clip=gv.Clip(boxes=halves[:1]))
    assert (half.color - whole.color).abs().max() > 0.1
    blurred = gv.render(tree, camera, shader, lens=gv.ThinLens(aperture=3.0, focus=40.0))
    assert 0.005 < (blurred.color - whole.color).abs().max()
    wall = gv.Layer(torch.ones(24, 24, 3), torch.full((24, 24, 1), 1e3))
    behind = gv.render(tree, camera, shader, stop_alpha=1.0, layer=wall)
    torch.testing.assert_close(behind.color, whole.color + 1 - whole.alpha, atol=1e-5, rtol=0)


def test_what_an_image_tells_of_its_channels_is_how_they_look():
    data = blobs(4)
    image_info = gv.ImageInfo(
        channels=(
            gv.ChannelInfo(name="DAPI", color=(0.0, 0.0, 1.0), window=(10, 200)),
            gv.ChannelInfo(name="GFP", color=(0.0, 0.5, 0.0), active=False),
            gv.ChannelInfo(name="actin"),
            gv.ChannelInfo(window=(5, 6)),
        )
    )
    shader = gv.Channels.of(gv.Volume(data, info=image_info), opacity=0.3)
    first, second, third, last = shader.looks
    assert (first.name, first.color, first.window) == ("DAPI", (0.0, 0.0, 1.0), (10, 200))
    assert second.visible is False and second.color == pytest.approx((0, 0.21404, 0), abs=1e-5)
    assert third.visible and third.color is None and last.window == (5, 6)
    low, high = np.percentile(data[..., 2], (50, 99.9))
    assert third.window == pytest.approx((low, high), rel=1e-5)
    assert [look.component for look in shader.looks] == [0, 1, 2, 3] and first.opacity == 0.3
    some = gv.Channels.of(gv.Volume(data, info=image_info), "opacity", components=(2, 1))
    assert [look.name for look in some.looks] == ["actin", "GFP"] and some.looks[1].visible
    assert repr(some) == "Channels([actin, GFP], 'opacity')"
    look = gv.ChannelLook(window=(0, 1), name="GFP")
    assert repr(look) == "ChannelLook(window=(0, 1), name='GFP')"


def test_channels_that_are_not_told_are_told_apart():
    many = gv.Channels.of(gv.Volume(blobs(16)))
    colors = [look.function(index, 16).color[-1, 1:] for index, look in enumerate(many.looks)]
    far = [np.abs(a - b).max() for i, a in enumerate(colors) for b in colors[:i]]
    assert len(colors) == 16 and min(far) > 0.1
    assert [tuple(c) for c in colors[1:3]] == [(0, 1, 0), (1, 0, 0)]
    alone = gv.Channels.of(gv.Volume(blobs(1)))
    assert tuple(alone.looks[0].function(0, 1).color[-1, 1:]) == (1, 1, 1)


@pytest.mark.parametrize(
    ("values", "window"),
    [
        ([0.0] * 9999 + [500.0], (0.0, 500.0)),  # rarer than a thousandth
        ([3.0] * 10000, (3.0, 4.0)),  # of one value
        ([*range(9995), *[1e9] * 5], (4999.5, 9989.0)),  # a few hot voxels do not spoil it
    ],
)
def test_windows_are_robust(values, window):
    data = np.array(values, np.float32).reshape(10, 10, 100)
    actual = gv.Channels.of(gv.Volume(data)).looks[0].window
    assert actual == pytest.approx(window, rel=1e-4)


def test_a_store_tells_windows_by_a_coarse_level(tmp_path):
    data = blobs(2, (40, 36, 44)).round().astype(np.uint8)
    np.save(tmp_path / "v.npy", data)
    assert gvtorch("convert", tmp_path / "v.npy", tmp_path / "v.zarr").returncode == 0
    coarse = gv.Channels.of(gv.Store.open(tmp_path / "v.zarr"))
    exact = gv.Channels.of(gv.Volume(data))
    for look, other in zip(coarse.looks, exact.looks, strict=True):
        assert look.window == pytest.approx(other.window, abs=1)


@pytest.mark.backend("cpp")
def test_any_window_has_a_table():
    """Its corner points lie on rows of the table, however their numbers round."""
    tree = gv.N3Tree.from_volume(gv.Volume(blobs(1, (5, 5, 5))), 4)
    numbers = np.random.default_rng(4).uniform(-3, 3, (40, 2))
    for low, length in numbers.tolist():
        look = gv.ChannelLook(window=(low, low + 10**length), color="white")
        assert look.function(0, 1).opacity[-1].tolist() == [low + 10**length, 0.5]
        rows = look.function(0, 1).rows()[2]
        assert len(rows) == 1025 and (np.diff(rows[:, 3]) > 0).all()
    gv.render(tree, gv.Camera.orbit(width=4, height=4), gv.Channels([look]))


@pytest.mark.parametrize(
    ("color", "linear"),
    [
        ("red", (1, 0, 0)),
        ("#FF00ff", (1, 0, 1)),
        ("#808080", (0.21586,) * 3),
        ((0.2, 0.3, 0.4), (0.2, 0.3, 0.4)),
    ],
)
def test_colors_by_name_number_and_value(color, linear):
    assert channel_color("x", color) == pytest.approx(linear, abs=1e-5)
    assert all(len(channel_color("x", name)) == 3 for name in COLORS)


def looks_of(**options) -> list[gv.ChannelLook]:
    return [gv.ChannelLook(**{"window": (0, 1), **options})]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gv.Channels([]), "takes 1 to 16 channels, got 0"),
        (lambda: gv.Channels(looks_of() * 17), "takes 1 to 16 channels, got 17"),
        (lambda: gv.Channels(looks_of(), "sum"), "mode must be 'additive' or 'opacity', got 'sum'"),
        (lambda: gv.Channels(["red"]), "channel 0 must be a ChannelLook, got str"),
        (lambda: gv.Channels([gv.ChannelLook()]), "window=(low, high) or a transfer function is"),
        (lambda: gv.Channels(looks_of(window=(2, 2))), "channel 0: window must rise, got 2 to 2"),
        (lambda: gv.Channels(looks_of(window=3)), "window must be (low, high), got 3"),
        (lambda: gv.Channels(looks_of(color="blurple")), "is not a colour; known: #RRGGBB"),
        (lambda: gv.Channels(looks_of(color=(0, 0, 2))), "colour must be finite and >= 0 and <= 1"),
        (lambda: gv.Channels(looks_of(opacity=2)), "channel 0: opacity must be finite"),
        (lambda: gv.Channels(looks_of(component=-1)), "component of channel 0 must be an int >= 0"),
        (
            lambda: gv.Channels(looks_of(transfer=FUNCTIONS[0][2], name="GFP")),
            "channel 0 (GFP): it has a transfer function, so no window",
        ),
        (lambda: gv.Channels.of(3), "image must be a Volume or Store, got int"),
        (lambda: gv.Channels.of(gv.Volume(np.zeros((2, 2, 2, 20)))), "components=[0, 1, ...]"),
        (
            lambda: gv.Channels.of(gv.Volume(np.zeros((2, 2, 2))), components=[1]),
            "component must be an int >= 0 and <= 0, got 1",
        ),
    ],
)
def test_bad_looks_have_one_clear_message(make, message):
    with pytest.raises(ValueError) as caught:
        make()
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_component_that_is_not_there_is_one_clear_error(compiled):
    tree = gv.N3Tree.from_volume(gv.Volume(blobs(2)), 8, device=DEVICES[compiled])
    with pytest.raises(ValueError, match="component must be an int >= 0 and <= 1, got 3"):
        gv.render(tree, gv.Camera.orbit(width=4, height=4), gv.Channels(looks_of(component=3)))


@pytest.mark.backend("cpp")
def test_a_table_that_leads_nowhere_reads_nothing_else():
    """The op reads no other memory, whatever numbers a table holds."""
    from gvtorch.tracing.tracer import Tracer

    tree = gv.N3Tree.from_volume(gv.Volume(blobs(3)), 4)
    rays, shader = camera_rays(tree, 8), gv.Channels(looks())
    for dtype in (torch.float32, torch.float64):
        for row, column, number in (
            *((0, 0, wrong) for wrong in (1e9, -5.0, float("nan"), 16.0)),
            *((1, 0, wrong) for wrong in (1e9, -1e9, float("nan"))),
            *((1, 2, wrong) for wrong in (1e30, float("inf"), float("nan"))),
            *((2, 3, wrong) for wrong in (1e9, 0.0, 1.0, float("nan"), -3.0)),
        ):
            tracer = Tracer(tree, shader, gv.RenderOptions(dtype=dtype))
            table = tracer.arguments.table_lm4.clone()
            table[:, row, column] = number
            tracer.arguments = tracer.arguments._replace(table_lm4=table)
            assert tracer(rays).samples.shape == (64,)


@pytest.fixture(scope="module")
def two_channels(tmp_path_factory):
    """Two balls, each in its own channel, as a file and as a store."""
    folder = tmp_path_factory.mktemp("channels")
    z, y, x = np.mgrid[0:20, 0:20, 0:32]
    balls = [4000 * (np.hypot(np.hypot(x - c, y - 10), z - 10) < 7) for c in (8, 23)]
    np.save(folder / "v.npy", np.stack(balls, -1).astype(np.uint16))
    assert gvtorch("convert", folder / "v.npy", folder / "v.zarr").returncode == 0
    return folder


def test_a_name_that_no_channel_has_is_answered_with_those_that_they_have():
    info = gv.ImageInfo(channels=[gv.ChannelInfo(name="DAPI"), gv.ChannelInfo(name="GFP")])
    cells = gv.Volume(torch.zeros(2, 3, 4, 2), info=info)
    assert [n.component for n in parse_channels("GFP:red", cells).looks] == [1]
    with pytest.raises(ValueError, match="got 'RFP:red'; the channels are DAPI, GFP"):
        parse_channels("RFP:red", cells)


@pytest.mark.parametrize("name", ["v.npy", "v.zarr"])
def test_the_command_line_shows_channels(two_channels, tmp_path, name):
    def picture(*flags: str) -> np.ndarray:
        out = tmp_path / "out.npy"
        camera = ("--camera", "orbit:0,0,1.6", "--size", "32x32", "-o", out, "--shader", "channels")
        done = gvtorch("render", two_channels / name, *camera, *flags)
        assert done.returncode == 0, done.stderr
        return np.load(out)[..., :3]

    left, right = np.s_[14:18, 8:11], np.s_[14:18, 21:24]
    auto = picture()
    assert auto[left].mean((0, 1)).argmax() == 2 and auto[right].mean((0, 1)).argmax() == 1
    image = picture("--channel", "1:#ff0000:100,4000;0:yellow:auto")
    assert image[left].min((0, 1))[:2].min() > 0.3 and image[left].max((0, 1))[2] < 0.01
    assert image[right][..., 0].min() > 0.3 and image[right][..., 1:].max() < 0.01
    alone = picture("--channel", "1")
    assert alone[right].min() > 0.3 and alone[left].max() < 0.01
    half, whole = (picture("--channel", f"0:red:0,{high};opacity") for high in (8000, 4000))
    assert 0.2 * whole[left].max() < half[left].max() < 0.8 * whole[left].max()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--channel", "0"], "--channel is for --shader channels"),
        (["--shader", "channels", "--tf", "bone"], "--tf is not for --shader channels"),
        (["--shader", "channels", "--component", "1"], "--component is not for --shader"),
        (["--shader", "channels", "--channel", "x:red"], "must hold NUMBER:COLOR:LO,HI"),
        (["--shader", "channels", "--channel", "0;0"], "names channel 0 twice"),
        (["--shader", "channels", "--channel", "opacity"], "name channels, too"),
        (["--shader", "channels", "--channel", "2"], "component must be an int >= 0 and <= 1"),
        (["--shader", "channels", "--channel", "0:nocolor"], "is not a colour"),
        (["--shader", "channels", "--channel", "0:red:5"], "window must be 2 numbers"),
        (["--shader", "channels", "--channel", "0:red:5,5"], "--channel 0: window must rise"),
    ],
)
def test_a_mistake_on_the_command_line_is_one_line(two_channels, tmp_path, flags, message):
    done = gvtorch("render", two_channels / "v.npy", "-o", tmp_path / "out.png", *flags)
    assert done.returncode == 2 and message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_most_channels_are_as_many_as_the_kernels_read():
    text = (cpp_ext.SOURCES / "shaders" / "probe.h").read_text()
    assert re.findall(r"kMaxNumbers = (\d+);", text) == [str(MAX_CHANNELS)]
    assert len(set(DEFAULT_COLORS)) == MAX_CHANNELS
