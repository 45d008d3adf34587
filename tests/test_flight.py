"""Films of key frames: states between states, and the camera's path through its keys."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import gvtorch
from helpers.viewer import pixels
from hypothesis import given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base import check
from gvtorch.cameras.motion import exponential, logarithm
from gvtorch.viewer.state import Development, Eye

HOT = gv.TransferFunction([(0, 0), (100, 0.5), (200, 1)], [(0, 1, 0, 0), (255, 0, 0, 1)])
FRONT = Eye(eye=(0, 0, 5), target=(0, 0, 0))


def orbit(degrees: float, distance: float = 5.0, target=(0.0, 0.0, 0.0)) -> Eye:
    turn = math.radians(degrees)
    x, y, z = target
    return Eye(eye=(x + distance * math.sin(turn), y, z + distance * math.cos(turn)), target=target)


def shown(camera: Eye = FRONT, shader: gv.Shader = HOT, **options) -> gv.ViewState:
    return gv.ViewState(shader=shader, options=gv.RenderOptions(**options), camera=camera)


def place(eye: Eye) -> np.ndarray:
    view = eye.camera(2, 2, torch.zeros(2, 3)).viewmats[0]
    return np.array([*eye.eye, *eye.target, *view.flatten().tolist(), eye.fov])


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=7, max_size=7))
def test_a_pose_is_the_exponential_of_its_logarithm(numbers):
    """Its powers equal those of the matrix, by torch's exponential."""
    step = torch.tensor(numbers, dtype=torch.float64)
    step[1:4] *= 0.95 * math.pi / max(float(step[1:4].norm()), 3.0)
    pose = exponential(step)
    assert torch.allclose(logarithm(pose), step, rtol=1e-9, atol=1e-9)
    x, y, z = step[1:4].tolist()
    flow = torch.zeros(4, 4, dtype=torch.float64)
    flow[:3, :3] = flow.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    flow[(0, 1, 2), (0, 1, 2)] = step[0]
    flow[:3, 3] = step[4:]
    assert torch.allclose(pose, torch.linalg.matrix_exp(flow), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("turn", [(math.pi, 0, 0), (0, math.pi, 0), (1e-9, 0, 0), (0, 0, 0)])
def test_half_turns_and_none_have_a_logarithm(turn):
    step = torch.tensor([0.0, *turn, 1.0, 2.0, 3.0], dtype=torch.float64)
    again = exponential(logarithm(exponential(step)))
    assert torch.allclose(again, exponential(step), atol=1e-12)


def test_keys_are_exact_and_an_orbit_is_a_circle():
    """Four keys at uneven times with one angular speed: the camera is where a turntable's is."""
    times = (0.0, 1.0, 2.5, 4.0)
    keys = [(time, shown(orbit(60 * time, 5.0, (3.0, 2.0, 1.0)))) for time in times]
    flight = gv.Flight(keys)
    for time, state in keys:
        assert flight.at(time) is state
    for time in np.linspace(0, 4, 23):
        actual = flight.at(time).camera
        assert np.allclose(place(actual), place(orbit(60 * time, 5.0, (3.0, 2.0, 1.0))), atol=1e-9)
    assert flight.at(-1) is keys[0][1] and flight.at(9) is keys[-1][1]


def test_a_zoom_comes_nearer_by_the_same_factor_and_ends_at_its_target():
    """From a distance of 3 to 3e-9, looking at the target all the time."""
    end = (0.3, 0.2, 0.1)
    flight = gv.Flight([(0, shown(orbit(0, 3.0))), (9, shown(orbit(50, 3e-9, end)))])
    for second in range(1, 9):
        eye = flight.at(second).camera
        assert math.isclose(math.dist(eye.eye, eye.target), 3 * 10.0**-second, rel_tol=1e-7)
        assert math.dist(eye.target, end) < 0.2 * math.dist(eye.eye, eye.target)


def test_no_velocity_jumps():
    """Differences on both sides of a key agree, for the camera and for every number."""
    clip = [gv.Clip(planes=[(1, 0, 0, d)], boxes=[((d, 0, 0), (d + 1, 2, 3))]) for d in range(5)]
    cameras = [
        Eye(eye=(0, 1, 9), target=(0, 0, 0)),
        Eye(eye=(6, 3, 5), target=(1, 0, 0), fov=40),
        Eye(eye=(5, -2, -1), target=(0, 2, 1), fov=20, up=(0.3, 1, 0)),
        Eye(eye=(1, -2, -3), target=(0, 0, 0), fov=35),
    ]
    points = ([(0, 0), (9, 1)], [(5, 0.5), (30, 1)], [(7, 0), (40, 0.1)], [(8, 0.2), (41, 1)])
    times = (0, 1.0, 2.5, 3.0)
    flight = gv.Flight(
        [
            (t, shown(camera, gv.Lit(gv.TransferFunction(p), ambient=0.1 * t), clip=c, step=1 + t))
            for t, camera, p, c in zip(times, cameras, points, clip, strict=False)
        ]
    )

    def numbers(time: float) -> np.ndarray:
        state = flight.at(time)
        return np.array(
            [
                *place(state.camera),
                *np.ravel(state.shader.transfer.opacity),
                state.shader.ambient,
                *np.ravel(state.options.clip.planes),
                *np.ravel(state.options.clip.boxes),
                state.options.step,
            ]
        )

    tiny = 1e-5
    course = np.stack([numbers(t) for t in np.arange(0, 3.01, 0.01)])
    fastest = abs(np.diff(course, axis=0)).max() / 0.01
    for key in times[1:-1]:
        before = (numbers(key) - numbers(key - tiny)) / tiny
        after = (numbers(key + tiny) - numbers(key)) / tiny
        assert abs(before).max() > 0.1
        assert abs(before - after).max() < 1e-3 * fastest, key
    assert np.linalg.norm(np.diff(course[:, :3], axis=0), axis=1).max() < 0.5, "the eye's way"


def test_a_camera_rests_between_two_keys_of_one_place():
    flight = gv.Flight(
        [(0, shown(orbit(0))), (1, shown(orbit(40))), (2, shown(orbit(40))), (3, shown(orbit(90)))]
    )
    for time in np.linspace(1, 2, 9):
        assert np.allclose(place(flight.at(time).camera), place(orbit(40)), atol=1e-12)


def test_a_closed_flight_runs_on_through_its_ends():
    keys = [(t, shown(orbit(120 * t, 5 + (t == 1)), step=1 + t % 3)) for t in range(4)]
    keys[-1] = (3, keys[0][1])
    flight = gv.Flight(keys)
    assert flight.closed and flight.count(10) == 30
    tiny = 1e-6
    before = place(keys[0][1].camera) - place(flight.at(3 - tiny).camera)
    after = place(flight.at(tiny).camera) - place(keys[0][1].camera)
    assert abs(before - after).max() < 1e-4 * abs(after).max()
    assert [round(s.camera.fov, 3) for s in flight.states(10)] == [30.0] * 30
    opened = gv.Flight(keys[:-1])
    assert not opened.closed and opened.count(10) == 21
    assert [*opened.states(10)][-1] is keys[2][1]


def test_points_of_a_function_slide_or_the_function_fades():
    many = gv.TransferFunction([(0, 0.0), (50, 0.2), (80, 0.8), (200, 1)])
    slid = gv.Flight(
        [
            (0, shown(shader=HOT)),
            (2, shown(shader=gv.TransferFunction([(50, 0), (52, 1), (54, 1)]))),
        ]
    ).at(1)
    assert np.allclose(slid.shader.opacity, [(25, 0), (76, 0.75), (127, 1)])
    faded = gv.Flight([(0, shown(shader=HOT)), (2, shown(shader=many))]).at(0.5)
    values = np.linspace(-10, 260, 99)
    mixed = 0.75 * HOT(values)[:, 3] + 0.25 * many(values)[:, 3]
    assert np.allclose(faded.shader(values)[:, 3], mixed, atol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_what_lies_between_states_is_a_state(seed):
    """Windows, boxes and points keep their order, whatever the keys are."""
    rng = np.random.default_rng(seed)
    count, keys = int(rng.integers(2, 6)), []

    def number() -> float:
        return float(rng.uniform(-1, 1) * 10 ** rng.uniform(-3, 3))

    def gap() -> float:
        return float(10 ** rng.uniform(-3, 3))

    for n in range(count):
        low, wide = number(), gap()
        values = np.cumsum([number(), gap(), gap()])
        opacity = [(v, rng.uniform()) for v in values]
        channel = gv.ChannelLook(window=(low, low + wide), color=(0, 1, 0))
        channels = gv.Channels([channel, gv.TransferFunction(opacity)])
        clip = gv.Clip(boxes=[((low, 0, 0), (low + wide, 1, 1))])
        keys.append((float(n), shown(orbit(number()), channels, clip=clip)))
    flight = gv.Flight(keys)
    for time in np.linspace(0, count - 1, 13):
        assert isinstance(flight.at(time), gv.ViewState)


def test_what_has_no_between_switches_at_its_key():
    first = gv.ViewState(shader=HOT, camera=FRONT, develop=Development(samples=2))
    second = gv.ViewState(
        shader=gv.Isosurface(3.5),
        options=gv.RenderOptions(lod="finest", clip=gv.Clip(planes=[(1, 0, 0, 1)])),
        develop=Development(samples=8, tone="aces"),
        camera=Eye(eye=(0, 0, 6), target=(0, 0, 0), model="fisheye"),
        component=1,
    )
    flight = gv.Flight([(0, first), (1, second), (2, second)])
    for time, state in ((0.999, first), (1, second), (1.5, second)):
        actual = flight.at(time)
        assert type(actual.shader) is type(state.shader)
        assert actual.develop == state.develop and actual.component == state.component
        assert (actual.options.lod, actual.options.clip is None) == (
            *(state.options.lod, state.options.clip is None),
        )
        assert actual.camera.model == state.camera.model
    module = gv.ModuleShader(gv.TransferModule(HOT, 1.0))
    kept = gv.Flight([(0, shown(shader=module)), (1, shown(orbit(30), shader=module))])
    assert kept.at(0.5).shader is module


def test_a_flight_comes_back_from_its_file(tmp_path):
    """Keys that leave something out inherit it from the key before."""
    keys = [(0, shown(step=0.25)), (1.5, shown(orbit(30))), (4, shown(orbit(80)))]
    gv.Flight(keys).save(tmp_path / "keys.json")
    again = gv.Flight.read(tmp_path / "keys.json", shown(shader=gv.Isosurface(1)))
    for time in (0, 0.7, 1.5, 3.2):
        assert again.at(time).to_json() == gv.Flight(keys).at(time).to_json()
    content = [
        {"time": 0, "state": {"options": {"step": 0.25}}},
        {"time": 2, "state": {"camera": {"eye": [1, 0, 5], "target": [0, 0, 0]}}},
        {"time": 3, "state": "views/a.json"},
    ]
    (tmp_path / "views").mkdir()
    shown(orbit(70), gv.Isosurface(7)).save(tmp_path / "views" / "a.json")
    (tmp_path / "some.json").write_text(json.dumps(content))
    flight = gv.Flight.read(tmp_path / "some.json", shown())
    assert flight.at(2).options.step == 0.25 and flight.at(0).camera == FRONT
    assert flight.at(3).shader.value == 7 and flight.at(3).camera == orbit(70)
    assert repr(flight) == "Flight(3 keys, 3 s)"


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (1.0, 2.0, -0.5)])
def test_a_turntable_goes_around_once(up):
    """At any time the camera is the first one, turned by torch's exponential."""
    first = Eye(eye=(1, 2, 5), target=(0.5, 0, 0), up=up, fov=20)
    flight = gv.Flight.turntable(shown(first), 8)
    assert flight.closed and flight.seconds == 8 and flight.at(8).camera == first
    axis = torch.tensor(up, dtype=torch.float64)
    x, y, z = (2 * math.pi * axis / axis.norm()).tolist()
    spin = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    target = torch.tensor(first.target, dtype=torch.float64)
    away = torch.tensor(first.eye, dtype=torch.float64) - target
    for time in (0.0, 1.0, 2.77, 4.0, 7.9):
        camera = flight.at(time).camera
        expected = target + torch.linalg.matrix_exp(spin * time / 8) @ away
        assert torch.allclose(torch.tensor(camera.eye, dtype=torch.float64), expected, atol=1e-9)
        assert np.allclose(camera.target, first.target) and camera.fov == 20
    with pytest.raises(ValueError, match="the state has no camera"):
        gv.Flight.turntable(gv.ViewState(shader=HOT))


@pytest.mark.backend("cpp")
def test_a_saved_view_is_turned(small, tmp_path):
    """Its first picture is the saved one; flags may not repeat what the view specifies."""
    state = shown(Eye(eye=(60, 20, 8), target=(12, 10, 8), up=(0, 0, 1)), step=0.4)
    state.save(tmp_path / "v.json")
    saved, film = ("--state", tmp_path / "v.json", "--size", "40x30"), tmp_path / "f"
    run = gvtorch("fly", small, "-o", film, *saved, "--turntable", "1", "--fps", "4")
    assert run.returncode == 0 and "4 pictures" in run.stdout, run.stderr
    run = gvtorch("render", small, "-o", tmp_path / "one.png", *saved)
    assert run.returncode == 0, run.stderr
    assert (film / "0000.png").read_bytes() == (tmp_path / "one.png").read_bytes()
    pictures = [pixels(file.read_bytes()) for file in sorted(film.iterdir())]
    assert len({p.tobytes() for p in pictures}) == 4 and all(p.std() > 5 for p in pictures)
    for flags in (("--orbit", "1,2"), ("--fov", "20"), ("--step", "1"), ("--tf", "hot")):
        run = gvtorch("fly", small, "-o", tmp_path / "no", *saved, *flags)
        assert run.returncode == 2 and f"--state sets what {flags[0]} sets" in run.stderr
    for content in ("[]", "{", '{"shader": 7}'):
        (tmp_path / "bad.json").write_text(content)
        run = gvtorch("fly", small, "-o", tmp_path / "no", "--state", tmp_path / "bad.json")
        assert run.returncode == 2 and len(run.stderr.splitlines()) == 1, run.stderr
        assert run.stderr.count("bad.json") == 1, run.stderr
    assert not (tmp_path / "no").exists()


BAD = (
    ([], "must be a list of keys"),
    ({}, "must be a list of keys"),
    ([{"time": 0}], "key 0: must be"),
    ([{"time": "soon", "state": {}}], "key 0: Flight: time must be a number"),
    ([{"time": 0, "state": {"options": {"step": -1}}}], "key 0: render: step"),
    ([{"time": 0, "state": "no.json"}], "state not found"),
    ([{"time": 1, "state": {}}, {"time": 1, "state": {}}], "key 1 at 1 s must come after 1 s"),
)


@pytest.mark.parametrize(("content", "message"), BAD)
def test_bad_files_of_keys_are_one_line(small, tmp_path, content, message):
    (tmp_path / "k.json").write_text(json.dumps(content))
    run = gvtorch("fly", small, "-o", tmp_path / "f", "--keys", tmp_path / "k.json")
    assert run.returncode == 2 and message in run.stderr and len(run.stderr.splitlines()) == 1
    assert not (tmp_path / "f").exists()


def test_flags_that_the_keys_tell_are_refused(small, tmp_path):
    state = {"camera": {"eye": [60, 20, 8], "target": [12, 10, 8]}, "options": {"step": 0.4}}
    (tmp_path / "k.json").write_text(json.dumps([{"time": 0, "state": state}]))
    for flags in (("--turntable", "2"), ("--orbit", "1,2"), ("--fov", "20"), ("--step", "1")):
        run = gvtorch("fly", small, "-o", tmp_path / "f", "--keys", tmp_path / "k.json", *flags)
        assert run.returncode == 2 and f"--keys sets what {flags[0]} sets" in run.stderr
    run = gvtorch("fly", small, "-o", tmp_path / "f", "--keys", tmp_path / "no.json")
    assert run.returncode == 2 and "key frames not found" in run.stderr


@pytest.mark.backend("cpp")
def test_fly_reads_each_file_of_a_flight_once(tmp_path, monkeypatch):
    """So that files which change meanwhile can't change a film between its parts."""
    np.save(tmp_path / "series.npy", np.random.default_rng(0).random((3, 8, 8, 8), np.float32))
    for n in range(2):
        shown(orbit(30 * n)).save(tmp_path / f"{n}.json")
    content = [{"time": 0, "state": "0.json"}, {"time": 2, "state": {"time": 2}}]
    (tmp_path / "k.json").write_text(json.dumps(content))
    read, json_file = [], check.json_file

    def counted(kind, path):
        read.append(Path(path).name)
        return json_file(kind, path)

    monkeypatch.setattr(check, "json_file", counted)
    data = ("fly", tmp_path / "series.npy", "--axes", "tzyx", "--size", "8x8")
    run = gvtorch(*data, "-o", tmp_path / "a", "--keys", tmp_path / "k.json", "--frames", "3")
    assert run.returncode == 0, run.stderr
    assert sorted(read) == ["0.json", "k.json"]
    read.clear()
    flags = ("--state", tmp_path / "1.json", "--turntable", "1", "--fps", "3", "--times", "all")
    run = gvtorch(*data, "-o", tmp_path / "b", *flags)
    assert run.returncode == 0, run.stderr
    assert read == ["1.json"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gv.Flight([]), "at least one key"),
        (lambda: gv.Flight([(0, gv.ViewState(shader=HOT))]), "key 0 has no camera"),
        (lambda: gv.Flight([(0, 3)]), "state must be a ViewState"),
        (lambda: gv.Flight([(0, shown())]).at(math.nan), "time must be finite"),
        (lambda: [*gv.Flight([(0, shown())]).states(0)], "fps must be finite and > 0"),
        (
            lambda: gv.Flight(
                [(n, shown(clip=gv.Clip(planes=[(1 - 2 * n, 0, 0, 0)]))) for n in (0, 1)]
            ).at(0.5),
            "at 0.5 s, after key 0",
        ),
    ],
)
def test_wrong_flights_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.backend("cpp")
def test_a_film_of_keys_is_streamed_as_it_is_resident(scan_store, tmp_path):
    """Each picture equals the one that Python renders from the state between the keys."""
    volume = gv.read_volume(scan_store.with_name("ball.npy"), spacing=(1, 1, 2))
    tree = gv.N3Tree.from_volume(volume)
    middle = tuple(tree.box.mean(0).tolist())
    shaders = [gv.TransferFunction.preset("hot", low, 200) for low in (0, 90)]
    keys = [
        (n, gv.ViewState(
            shader=gv.Lit(shaders[n]),
            options=gv.RenderOptions(clip=gv.Clip(planes=[(1.0, 0, 0, -10.0 - 12 * n)])),
            develop=Development(samples=2),
            camera=orbit(200 + 50 * n, 180.0, middle),
        ))
        for n in (0, 1)
    ]  # fmt: skip
    flight = gv.Flight(keys)
    flight.save(tmp_path / "k.json")
    common = ("--keys", tmp_path / "k.json", "--fps", "2", "--size", "40x32")
    for name, data, more in (("s", scan_store, ()), ("r", scan_store.with_name("ball.npy"),
                                                     ("--spacing", "1,1,2"))):  # fmt: skip
        run = gvtorch("fly", data, "-o", tmp_path / name, *common, *more)
        assert run.returncode == 0 and "3 pictures" in run.stdout, run.stderr
    for number, state in enumerate(flight.states(2)):
        file = f"{number:04d}.png"
        seen = pixels((tmp_path / "s" / file).read_bytes())
        assert np.array_equal(seen, pixels((tmp_path / "r" / file).read_bytes()))
        expected = state.picture(tree, 40, 32).to_srgb8().numpy()
        assert np.array_equal(seen, expected) and seen.std() > 5
    with gv.Engine(gv.StoredProducer(str(scan_store))) as engine:
        again = flight.at(0.5).picture(engine, 40, 32).to_srgb8().numpy()
    assert np.array_equal(again, pixels((tmp_path / "s" / "0001.png").read_bytes()))
    with pytest.raises(ValueError, match="must have a camera"):
        gv.ViewState(shader=HOT).picture(tree, 8, 8)


@pytest.mark.backend("cpp")
def test_costs_in_a_film_lie_over_the_picture_as_in_a_still(scan_store, tmp_path):
    """For a store too, whose costs are those of the data that the picture loaded."""
    eye = Eye(eye=(150, 40, 56), target=(20, 24, 56), up=(0, 0, 1))
    saved = ("--state", tmp_path / "v.json", "--size", "40x30")
    for blend, shader in ((1.0, HOT), (0.4, gv.Lit(HOT))):
        gv.ViewState(shader=shader, camera=eye, show="samples", blend=blend).save(
            tmp_path / "v.json"
        )
        run = gvtorch("fly", scan_store, "-o", tmp_path / "f", *saved, "--frames", "1")
        assert run.returncode == 0, run.stderr
        run = gvtorch("render", scan_store, "-o", tmp_path / "one.png", *saved)
        assert run.returncode == 0, run.stderr
        seen = pixels((tmp_path / "f" / "0000.png").read_bytes())
        assert np.array_equal(seen, pixels((tmp_path / "one.png").read_bytes())) and seen.std() > 5
