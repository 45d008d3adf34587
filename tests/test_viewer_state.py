"""The state of a view: JSON to and from Python's objects, and what a page may send."""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Literal

import numpy as np
import pytest
import torch
from helpers import gvtorch
from helpers.viewer import bright_ball, pixels
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.viewer import schema
from gvtorch.viewer.protocol import MESSAGES, parse
from gvtorch.viewer.state import Development, Eye

FUZZED = 4000
HOT = gv.TransferFunction.preset("hot", 0, 255)
SHADERS = (
    HOT,
    gv.Lit(HOT, light=gv.PointLight((1, 2, 3), radius=0.5), shininess=7.0),
    gv.Isosurface(3.5, (1.0, 0.25, 0.0), filled=False),
    gv.Isosurface(3.5, HOT, color_channel="heat", color_component=1),
    gv.DistanceField(offset=2.0),
    gv.Projection("max", HOT),
    gv.PreIntegrated(HOT),
    gv.GradientMagnitude(HOT, 4.0),
    gv.Labels({1: "red", 7: (0.1, 0.2, 0.3)}, opacity=0.5),
    gv.Channels([gv.ChannelLook(window=(0.0, 1.0), color="green"), HOT], "opacity"),
    gv.Features(HOT, "more"),
    gv.StoredColor("rgba", premultiplied=True, lit=True),
)
OPTIONS = gv.RenderOptions(
    step=0.25,
    lod="finest",
    background=gv.Gradient((0.1, 0.2, 0.3), (0, 0, 0)),
    clip=gv.Clip(planes=[(0, 0, 1, 0.1)], boxes=[((0, 0, 0), (1, 1, 1))], frame="box", caps=True),
    lighting=gv.Lighting(lights=[gv.DirectionalLight((1, 2, 3), angle=3)], occlusion=0.5),
)
EYE = Eye(eye=(0, 0, 9), target=(0, 0.5, 0), up=(0, 1, 0), fov=20, model="ortho")


@pytest.mark.parametrize(
    ("space", "up", "front"),
    [
        ("right-anterior-superior", (0, 0, 1), 1),
        ("left-posterior-superior", (0, 0, 1), -1),
        (None, (0, 1, 0), None),
    ],
)
def test_patients_are_first_seen_upright_and_from_the_front(space, up, front):
    """As `gvtorch render` shows them."""
    scan = gv.Volume(np.zeros((9, 8, 7), np.float32), info=gv.ImageInfo(space=space))
    viewer = gv.view(scan, HOT, wait=False, browser=False)
    eye = viewer.state.camera
    viewer.close()
    assert np.allclose(eye.up, up)
    if front is not None:
        assert front * (eye.eye[1] - eye.target[1]) > 5, "+y is the front, or the back"
    turned = gv.view(scan, HOT, up="+x", wait=False, browser=False)
    assert np.allclose(turned.state.camera.up, (1, 0, 0))
    turned.close()


@pytest.mark.parametrize("shader", SHADERS, ids=lambda one: type(one).__name__)
def test_a_state_comes_back_from_its_json(shader):
    state = gv.ViewState(
        shader=shader, options=OPTIONS, develop=Development(tone="aces"), camera=EYE
    )
    content = json.loads(json.dumps(state.to_json()))
    back = gv.ViewState(shader=HOT).changed(content)
    assert back.to_json() == content
    assert type(back.shader) is type(shader) and back.camera == EYE
    assert back.options.lod == "finest" and back.develop.tone == "aces"


def test_what_json_leaves_out_or_can_not_tell_stays():
    module = gv.ModuleShader(gv.TransferModule(HOT, 1.0))
    image = torch.rand(4, 4, 3)
    options = gv.RenderOptions(step=0.3, background=image, stop_alpha=0.5)
    state = gv.ViewState(shader=module, options=options)
    content = json.loads(json.dumps(state.to_json()))
    assert set(content["shader"]) == {"kept"} and set(content["options"]["background"]) == {"kept"}
    back = state.changed(content)
    assert back.shader is module and back.options.background is options.background
    changed = state.changed({"options": {"stop_alpha": 0.75}})
    assert (changed.options.stop_alpha, changed.options.step) == (0.75, 0.3)
    assert changed.options.background is options.background
    with pytest.raises(ValueError, match="JSON can't represent"):
        gv.ViewState(shader=HOT).changed({"options": {"lens": {"kept": "a lens"}}})


def test_a_choice_among_large_numbers_is_accepted():
    hint = Literal[256, 1024]  # a field of a script's dataclass, of which the page makes a choice
    assert schema.decode("size", hint, json.loads("1024")) == 1024
    with pytest.raises(ValueError, match="must be 256 or 1024, got 512"):
        schema.decode("size", hint, 512)
    with pytest.raises(ValueError, match="must be 0 or 1, got True"):
        schema.decode("bit", Literal[0, 1], True)


def test_every_field_of_a_dataclass_is_in_the_state():
    """The state is derived from the dataclasses: a new option is in it without a list of names."""
    saved = gv.ViewState(shader=HOT, options=OPTIONS).to_json()["options"]
    field_names = set(vars(gv.RenderOptions())) - {
        "layer",
        "pose",
        "dtype",
        "backend",
        "channel",
        "component",
    }
    assert set(saved) == field_names | {"kind"}
    for kind in (gv.Clip, gv.Lighting, gv.ThinLens, gv.DirectionalLight, gv.ChannelLook):
        fields = {f.name for f in dataclasses.fields(kind)}
        assert set(schema.describe_kind(kind)["fields"]) == fields
    for owner, name in schema.SLIDERS:
        kind = {"ViewState": gv.ViewState, "Eye": Eye, "Development": Development}.get(owner)
        kind = kind or schema.KINDS[owner]
        assert "range" in schema.describe_kind(kind)["fields"][name], (owner, name)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"options": {"stp": 1}}, "RenderOptions has no 'stp'"),
        ({"options": {"step": -1}}, "step must be finite and > 0"),
        ({"options": {"step": "1"}}, "state.options.step: must be a number, got '1'"),
        ({"options": {"lod": "best"}}, "'auto' or 'finest'"),
        ({"options": {"clip": {"boxes": [[[1, 1, 1], [0, 0, 0]]]}}}, "low corner below"),
        ({"options": {"lens": {"focus": 1}}}, "ThinLens needs 'aperture'"),
        ({"shader": {"kind": "Engine"}}, "state.shader: must be a Shader"),
        ({"shader": {"kind": "Lit"}}, "Lit needs 'transfer'"),
        ({"shader": {"kind": "TransferFunction", "opacity": [[1, 0], [0, 1]]}}, "must increase"),
        ({"camera": {"eye": [0, 0, 0], "target": [0, 0, 0]}}, "must differ"),
        ({"camera": {"eye": [0, 0], "target": [0, 0, 0]}}, "3 items"),
        ({"develop": {"samples": 10**9}}, "<= 65536"),
        ({"component": True}, "a whole number"),
        ([], "must be a ViewState"),
    ],
)
def test_wrong_states_are_refused_in_one_line(content, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")) as refused:
        gv.ViewState(shader=HOT).changed(content)
    assert "\n" not in str(refused.value)


def test_an_eye_sees_what_its_camera_sees():
    """Rays of the camera, of its `Eye`, and back; an orthographic one is in front of the box."""
    box = torch.tensor([(0.0, 0, 0), (2, 3, 4)], dtype=torch.float64)
    for camera in (
        gv.Camera.orbit(40, 25, 2.0, width=20, height=10),
        gv.Camera.look_at((9, 3, 2), (1, 1, 1), fov=50, width=20, height=10),
        gv.Camera.orbit(40, 25, width=20, height=10, model="ortho"),
    ):
        placed = camera.placed(box)
        again = Eye.of(camera, box).camera(20, 10, box)
        rays, others = placed.rays(), again.rays()
        assert torch.allclose(rays.direction, others.direction, atol=1e-9)
        away = others.origin - rays.origin
        along = (away * rays.direction).sum(1, keepdim=True) * rays.direction
        assert torch.allclose(away, along, atol=1e-9), "the same lines"
        if camera.model == "ortho":
            corners = torch.cartesian_prod(*box.T)
            depth = (corners[:, None] - others.origin[None, :1]) @ others.direction[0]
            assert float(depth.min()) > 0
    with pytest.raises(ValueError, match="got a batch of 2"):
        Eye.of(gv.Camera.orbit([0, 1]), box)


def test_render_takes_a_saved_state(tmp_path):
    """`gvtorch render --state` equals Python's rendering of the same objects, to the last bit."""
    volume = bright_ball()
    np.save(tmp_path / "ball.npy", volume.data[..., 0].numpy())
    options = gv.RenderOptions(
        step=0.4, background=(0.1, 0.2, 0.3), clip=gv.Clip(planes=[(1, 0, 0, -20)])
    )
    eye = Eye(eye=(90, 60, 70), target=(20, 20, 20), fov=35)
    shader = gv.Lit(gv.TransferFunction.preset("viridis", 20, 200), specular=0.8)
    develop = Development(samples=3, exposure=1.0)
    state = gv.ViewState(shader=shader, options=options, camera=eye, develop=develop)
    state.save(tmp_path / "view.json")
    run = gvtorch(
        *("render", tmp_path / "ball.npy", "-o", tmp_path / "a.png", "--size", "64x48"),
        *("--state", tmp_path / "view.json"),
    )
    assert run.returncode == 0, run.stderr
    tree = gv.N3Tree.from_volume(volume)
    camera = eye.camera(64, 48, tree.box)
    progressive = gv.Progressive(lambda view: gv.render(tree, view, shader, **vars(options)))
    expected = progressive.refine(camera, 3).tone_map("none", exposure=1.0).to_srgb8().numpy()
    seen = pixels((tmp_path / "a.png").read_bytes())
    assert np.array_equal(seen, expected) and seen.std() > 5
    for flags, message in (
        (("--tf", "hot"), "--state sets what --tf sets"),
        (("--camera", "orbit:1,2"), "--state sets what --camera sets"),
        (("--samples", "4"), "--state sets what --samples sets"),
    ):
        run = gvtorch(
            *("render", tmp_path / "ball.npy", "-o", tmp_path / "b.png"),
            *("--state", tmp_path / "view.json", *flags),
        )
        assert run.returncode == 2 and message in run.stderr, run.stderr
    (tmp_path / "bad.json").write_text('{"options": {"step": 0}}')
    call = ("render", tmp_path / "ball.npy", "-o", tmp_path / "b.png", "--state")
    for file, message in (("bad.json", "bad.json: render: step"), ("no.json", "state not found")):
        run = gvtorch(*call, tmp_path / file)
        assert run.returncode == 2 and message in run.stderr, run.stderr
        assert len(run.stderr.splitlines()) == 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)
NAMES = sorted({name for kind in MESSAGES.values() for name in schema.arguments(kind)})
NAMES += [*schema.KINDS, "kind", "kept", "eye", "shader", "options", "clip", "lens", "opacity"]
TYPE = st.fixed_dictionaries({"type": st.sampled_from([*MESSAGES, "nothing"])})
NEAR = st.tuples(TYPE | st.just({}), st.dictionaries(st.sampled_from(NAMES), JSON, max_size=5)).map(
    lambda parts: {**parts[1], **parts[0]}
)


def assert_message_or_line(text: str | bytes) -> None:
    try:
        message = parse(text)
    except ValueError as error:
        assert 0 < len(str(error)) < 4000
        return
    assert type(message) in MESSAGES.values()


@settings(max_examples=700, deadline=None, suppress_health_check=list(HealthCheck))
@given(NEAR.map(json.dumps) | st.text() | st.binary())
def test_whatever_comes_is_a_message_or_a_line(text):
    assert_message_or_line(text)


@settings(max_examples=450, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_a_state_with_one_wrong_place_is_refused_or_another_state(data):
    """One number, name or object of a valid state is replaced by anything."""
    shader = data.draw(st.sampled_from(SHADERS))
    content = gv.ViewState(shader=shader, options=OPTIONS, camera=EYE).to_json()
    part, parent, key = content, None, None
    while isinstance(part, (dict, list)) and part and (parent is None or data.draw(st.booleans())):
        keys = [*part] if isinstance(part, dict) else [*range(len(part))]
        parent, key = part, data.draw(st.sampled_from(keys))
        part = part[key]
    parent[key] = data.draw(JSON)
    try:
        state = gv.ViewState(shader=HOT).changed(content)
    except ValueError as error:
        assert str(error)
    else:
        assert isinstance(state, gv.ViewState)
        json.dumps(state.to_json(), allow_nan=False)


def test_hostile_messages():
    deep = "[" * 100000
    for text in (
        deep,
        '{"type": "change", "state": ' + '{"options":' * 50 + "1" + "}" * 51,
        "x" * 2**21,
    ):
        with pytest.raises(ValueError, match=r"message|state|change"):
            gv.ViewState(shader=HOT).changed(parse(text).state)
    many = json.dumps({"kind": "TransferFunction", "opacity": [[n, 0.5] for n in range(5000)]})
    with pytest.raises(ValueError, match="5000 items, more than 4096"):
        gv.ViewState(shader=HOT).changed({"shader": json.loads(many)})
    for bad in ("NaN", "Infinity", "1e999"):
        text = '{"type": "pick", "x": BAD, "y": 0}'.replace("BAD", bad)
        with pytest.raises(ValueError, match=r"no number|must be a finite number"):
            parse(text)
    assert math.isfinite(parse('{"type": "pick", "x": 1, "y": 0}').x)


def test_damaged_messages_are_refused_or_messages():
    """Valid messages with a few bytes changed, cut or doubled."""
    rng = np.random.default_rng(11)
    state = gv.ViewState(shader=SHADERS[1], options=OPTIONS, camera=EYE).to_json()
    good = [
        json.dumps({"type": "change", "state": state}),
        json.dumps({"type": "move", "camera": state["camera"], "moving": True, "sent": 12.5}),
        '{"type": "hello", "width": 640, "height": 480, "rate": 30}',
        '{"type": "resize", "engine": {"brick_pool": "256 MB"}}',
        '{"type": "set", "name": "radius", "value": 4.5}',
    ]
    letters = np.frombuffer(b'0123456789-+.eE"{}[]:, abkt\\nu\xff', np.uint8)
    fine = 0
    for number in range(FUZZED):
        text = np.frombuffer(good[number % len(good)].encode(), np.uint8).copy()
        for index in rng.integers(0, len(text), rng.integers(1, 4)):
            text[index] = rng.choice(letters)
        cut = rng.integers(0, len(text), 2)
        parts = (text, text[: cut[0]], np.concatenate((text[: cut[0]], text[cut[1] :])))
        damaged = parts[rng.choice(3, p=(0.8, 0.1, 0.1))].tobytes()
        try:
            message = parse(damaged)
            changed = getattr(message, "state", None)
            if changed is not None:
                gv.ViewState(shader=HOT).changed(changed)
            fine += 1
        except ValueError as error:
            assert str(error)
    assert 0 < fine < FUZZED / 2
