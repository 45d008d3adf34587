"""What goes wrong in a view and must leave it consistent: states that are refused, scenes that
can't be made again, views that close early.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY
from helpers.viewer import FUNCTION, TIMEOUT, Grown, Page, bright_ball, turned_camera

import gvtorch as gv
from gvtorch.shaders import Labels
from gvtorch.viewer import view
from gvtorch.viewer.scene import Scene
from gvtorch.viewer.server import Server
from gvtorch.viewer.state import Development, Eye, Slices, ViewState
from gvtorch.viewer.view import new_session

pytestmark = pytest.mark.backend("cpp")
CLOCK_BOX = ((-10, -10, -10), (10, 10, 10))


@pytest.mark.parametrize(
    "shader",
    [Labels(visible=list(range(5000))), Labels(colors={n: (1.0, 0.0, 0.0) for n in range(5000)})],
    ids=["list", "mapping"],
)
def test_a_state_with_more_items_than_json_may_hold_comes_back(shader):
    state = ViewState(shader=shader)
    content = state.to_json()
    changed = state.changed(content)
    assert changed.to_json() == content
    assert changed.shader.visible == shader.visible and changed.shader.colors == shader.colors


def test_labels_and_channels_are_saved_with_the_colours_that_they_show():
    """Names, sRGB arrays and defaults become linear numbers, and sets of labels lists."""
    for shader in (
        Labels(np.array([[0, 0, 0], [255, 0, 0]], np.uint8), visible={2, 1}),
        Labels({1: "#ff0000"}, visible=frozenset((1, 2))),
    ):
        content = ViewState(shader=shader).to_json()["shader"]
        loaded = ViewState(shader=GRAY).changed({"shader": content}).shader
        assert np.array_equal(loaded(np.arange(4)), shader(np.arange(4)))
        assert loaded.visible == [1, 2] and loaded(np.array([1]))[0, :3].tolist() == [1, 0, 0]
    shader = gv.Channels([gv.ChannelLook(window=(0, 1), color="green"),
                          gv.ChannelLook(window=(0, 1)), GRAY])  # fmt: skip
    content = ViewState(shader=shader).to_json()["shader"]
    assert [look["color"] for look in content["looks"]] == [[0, 1, 0], [0, 1, 0], None]
    loaded = ViewState(shader=GRAY).changed({"shader": content}).shader
    for n, (look, other) in enumerate(zip(loaded.looks, shader.looks, strict=True)):
        assert np.array_equal(look.function(n, 3).color, other.function(n, 3).color)


def test_a_message_names_the_wrong_label_once():
    state = ViewState(shader=Labels())
    content = {"kind": "Labels", "colors": {"5": [1, 2, 3, 4, 5]}}
    with pytest.raises(ValueError) as error:
        state.changed({"shader": content})
    assert str(error.value).count("state.shader.colors") <= 1, error.value


def test_an_eye_far_from_the_origin_is_fitted_along_its_own_direction():
    box = torch.tensor([[0, 0, 0], [4, 4, 4]], dtype=torch.float64) + 1e8
    eye = Eye(eye=(1e8 + 1.5, 1e8, 1e8 + 2), target=(1e8, 1e8, 1e8)).fitted(box, 64, 64)
    away = np.subtract(eye.eye, eye.target)
    assert np.allclose(away / np.linalg.norm(away), [0.6, 0, 0.8], atol=1e-6)
    assert np.allclose(eye.target, 1e8 + 2)


def test_an_eye_too_near_its_target_is_refused_before_it_is_drawn():
    with pytest.raises(ValueError, match="eye and target must differ"):
        Eye(eye=(0, 0, 1e-200), target=(0, 0, 0))


def test_an_eye_has_the_fields_of_view_that_cameras_have():
    for fov in (0, 1e-13, 180, float("nan")):
        with pytest.raises(ValueError, match="Eye: fov must be finite and >= 1e-12 and <= 179"):
            Eye(eye=(0, 0, 1), target=(0, 0, 0), fov=fov)
    assert Eye(eye=(0, 0, 1), target=(0, 0, 0), fov=1e-12).camera(8, 8, torch.eye(3)[:2])


def test_a_scene_that_can_not_be_made_again_stays_as_it_was():
    """Of the new time point no producer can be made."""
    first, second = bright_ball(), bright_ball()

    def remake(data):
        if data is second:
            raise OSError("the disk is gone")
        return gv.VolumeProducer(data)

    engine = gv.Engine(remake(first))
    scene = Scene("ball", engine, data=first, remake=remake, times=2)
    with pytest.raises(OSError, match="the disk is gone"):
        scene.show_time(1.0, second)
    assert scene.data is first and scene.time == 0
    camera = gv.Camera.orbit(width=8, height=8).placed(scene.box)
    assert scene.frame(camera, ViewState(shader=FUNCTION)).color.shape == (8, 8, 3)
    scene.close()


def test_a_time_point_that_can_not_be_shown_is_told_and_the_state_goes_back():
    session = new_session(bright_ball(), FUNCTION)
    try:
        page = Page(session)
        page.final()

        def reopen(time: int):
            return gv.Volume(torch.zeros(8, 8, 8, 3))  # the shader shows one of two channels

        def prepare() -> None:
            scene, remake = session.scene, session.scene.remake

            def one_component(data):
                if data.width > 1:
                    raise ValueError("there is another width")
                return remake(data)

            scene.times, scene.reopen, scene.remake = 3, reopen, one_component

        session.ask(prepare)
        page.send("change", state={"time": 1})
        assert page.next("error", 0)["text"] == "time 1: there is another width"
        page.until(lambda: page.of_type("state")[-1]["state"]["time"] == 0)
        page.moved(turned_camera(page.camera, 0.3))
    finally:
        session.close()


@dataclass
class Speed:
    """What a growing ball is made of."""

    size: int = 32


def growing(settings: Speed) -> gv.Producer:
    return gv.FieldProducer(Grown(), settings.size, box=CLOCK_BOX)


def test_a_time_point_chosen_while_another_fails_is_shown():
    session, chosen = new_session(bright_ball(), FUNCTION), threading.Event()

    def reopen(time: int) -> gv.Volume:
        if time == 1:
            chosen.wait(TIMEOUT)
            raise OSError("the disk is gone")
        return bright_ball()

    try:
        page = Page(session)
        page.final()
        session.ask(lambda: vars(session.scene).update(times=3, reopen=reopen))
        for time_point in (1, 2):
            page.send("change", state={"time": time_point})
        page.next("state", 1)
        chosen.set()
        assert "time 1: the disk is gone" in page.next("error", 0)["text"]
        page.until(lambda: page.pictures[-1][0]["time"] == 2)
    finally:
        session.close()


def test_a_scene_that_is_made_again_keeps_the_time_of_its_clocks():
    session = new_session(growing, gv.TransferFunction([(0.4, 0), (0.6, 1)]))
    try:
        page = Page(session)
        page.final()
        page.send("change", state={"time": 8.0})
        page.until(lambda: page.pictures[-1][0]["time"] == 8 and page.pictures[-1][0]["final"])
        page.send("set", name="size", value=16)
        page.next("parameters", 0)
        assert session.ask(lambda: [producer.time for producer in session.scene.producers]) == [8.0]
    finally:
        session.close()


def test_a_state_that_can_not_be_drawn_gives_back_the_time_too():
    producer = growing(Speed())
    session = new_session(producer, gv.TransferFunction([(0.4, 0), (0.6, 1)]))
    try:
        page = Page(session)
        page.final()
        broken = {"kind": "Features", "channel": "none"}
        broken["transfer"] = page.of_type("welcome")[0]["state"]["shader"]
        page.send("change", state={"time": 8.0, "shader": broken})
        assert "unknown channel 'none'" in page.next("error", 0)["text"]
        page.until(lambda: page.of_type("state")[-1]["state"]["time"] == 3.0)
        assert session.ask(lambda: (session.scene.time, producer.time)) == (3.0, 3.0)
    finally:
        session.close()


def test_a_refused_change_leaves_the_camera_where_it_was(session):
    page = Page(session)
    page.final()
    camera = turned_camera(page.camera, 0.5)
    page.send("change", state={"time": 5.0, "camera": camera})
    assert "nothing changes with time" in page.next("refused", 0)["text"]
    assert page.next("camera", 0)["camera"]["eye"] == page.camera["eye"]
    assert session.ask(lambda: list(page.client.eye.eye)) == page.camera["eye"]


def test_costs_of_a_stream_are_shown_once_nothing_is_missing():
    """Frames go on until all data are loaded, although the picture itself is not shown."""
    options = {"load_budget": 4, "time_budget": None, "brick_size": 8}
    session = new_session(bright_ball(64), FUNCTION, engine=options)
    try:
        page = Page(session, 128, 96)
        page.send("change", state={"show": "lod"})
        page.until(lambda: page.pictures and page.pictures[-1][0]["final"])
        camera = session.state.camera.camera(64, 48, session.scene.box)
        frame = session.ask(lambda: session.scene.frame(camera, session.state))
        assert frame.stats.misses == 0
    finally:
        session.close()


def wait_for(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.001)


def test_a_question_to_a_view_that_closes_is_answered_at_once(session):
    begun, go = threading.Event(), threading.Event()

    def wait() -> None:
        begun.set()
        assert go.wait(TIMEOUT)

    session.post(wait)
    assert begun.wait(TIMEOUT)
    errors = []

    def ask() -> None:
        try:
            session.ask(lambda: None, timeout=TIMEOUT)
        except Exception as error:
            errors.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    wait_for(lambda: session._tasks)
    closing = threading.Thread(target=session.close)
    closing.start()
    wait_for(lambda: session._closed)
    go.set()
    closing.join(TIMEOUT)
    asking.join(TIMEOUT)
    assert [type(error) for error in errors] == [RuntimeError]


def test_a_surface_ends_with_its_view(session, monkeypatch):
    from gvtorch.viewer import export

    begun, go, stopped = threading.Event(), threading.Event(), threading.Event()

    def endless(*_arguments, progress, **_options):
        begun.set()
        assert go.wait(TIMEOUT)
        try:
            progress("surface", 1, 2)
        except BaseException:
            stopped.set()
            raise

    monkeypatch.setattr(export, "export_surface", endless)
    page = Page(session)
    page.send("surface", value=100.0)
    assert begun.wait(TIMEOUT)
    session.close()
    go.set()
    assert stopped.wait(TIMEOUT)


def test_a_still_that_can_not_be_written_is_told_and_the_view_goes_on(session, monkeypatch):
    from gvtorch.viewer import still

    def full(*_arguments, **_options):
        raise MemoryError("no memory for the PNG")

    monkeypatch.setattr(still, "image_file", full)
    page = Page(session)
    page.final()
    page.send("still", width=32, height=32)
    assert page.next("refused", 0)["text"] == "still: no memory for the PNG"
    page.moved(turned_camera(page.camera, 0.3))


def test_figures_that_can_not_be_made_are_told_and_the_view_goes_on(session, monkeypatch):
    page = Page(session)
    page.final()
    monkeypatch.setattr(
        session, "_frame_figures", lambda picture: {}["no such figure"], raising=True
    )
    session.ask(lambda: setattr(page.client, "monitor", True))
    session._figures_time = 0.0
    page.send("move", camera=turned_camera(page.camera, 0.3), moving=False)
    assert "no such figure" in page.next("error", 0)["text"]
    session.ask(lambda: setattr(page.client, "monitor", False))
    page.moved(turned_camera(page.camera, 0.6))


def test_a_widget_that_can_not_be_made_closes_its_view(monkeypatch):
    from gvtorch.viewer import notebook

    def missing(session):
        raise ImportError("view in a notebook needs anywidget")

    monkeypatch.setattr(sys.modules["gvtorch.viewer.view"], "in_notebook", lambda: True)
    monkeypatch.setattr(notebook, "widget", missing)
    before = threading.enumerate()  # views of other tests may take a while to end
    with pytest.raises(ImportError, match="anywidget"):
        view(bright_ball(16))
    new = [thread for thread in threading.enumerate() if thread not in before]
    assert not [thread for thread in new if thread.name == "gvtorch view"]


@dataclass
class Needed:
    """A dataclass without a default."""

    radius: float


def needs(settings: Needed) -> gv.Producer:
    return growing(Speed())


def test_functions_of_something_else_are_refused_in_a_line():
    for function in (needs, partial(growing, Speed()), len, lambda: None):
        with pytest.raises(ValueError, match="view: ") as error:
            new_session(function)
        assert "\n" not in str(error.value)


def test_names_of_hosts_are_compared_without_case_and_tokens_survive_the_address(session):
    server = Server(session, allow=["Render.Box"], token="a+b &c=é")
    try:
        assert server.is_allowed("render.box:80") and not server.is_allowed("other.box")
        assert parse_qs(urlsplit(server.url).query)["token"] == [server.token]
        assert " " not in server.url
    finally:
        server.close()


@pytest.mark.parametrize("options", [{"token": 5}, {"allow": "render.box"}, {"host": 5}])
def test_wrong_arguments_of_a_server_are_refused(session, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        Server(session, **options)


def test_the_state_of_a_view_is_a_file_or_a_state():
    with pytest.raises(ValueError, match="view: state must be a"):
        new_session(bright_ball(8), GRAY, state=5)


def test_a_window_of_slices_may_be_a_list():
    """It is kept as the tuple that it is a key of; other windows and names are refused."""
    slices = Slices(window=[20, 100])
    assert slices == Slices(window=(20.0, 100.0)) and hash(slices.window)
    for wrong in ({"window": (1, 2, 3)}, {"window": 5}, {"window": (2, 1)}, {"colors": "blue"}):
        with pytest.raises(ValueError, match=f"Slices: {next(iter(wrong))} must"):
            Slices(**wrong)


def test_numbers_of_numpy_and_torch_become_those_of_json():
    """A picture's message holds the camera's."""
    eye = Eye(eye=(0, 0, 9), target=(0, 0, 0), fov=np.float32(20))
    develop = Development(samples=np.int64(4), exposure=torch.tensor(0.5))
    state = ViewState(shader=FUNCTION, camera=eye, develop=develop, time=np.float32(1), blend=1)
    kept = (eye.fov, develop.samples, develop.exposure, state.time, state.blend, state.component)
    assert [type(number) for number in kept] == [float, int, float, float, float, int]


@pytest.mark.parametrize("wrong", [{"shader": 5}, {"options": {}}, {"show": "nodez"}])
def test_a_state_of_something_else_is_refused(wrong):
    with pytest.raises(ValueError, match=f"ViewState: {next(iter(wrong))} must be"):
        ViewState(**{"shader": FUNCTION, **wrong})


class Waves(gv.Producer):
    """A producer with parameters of float64, one of them NaN."""

    def __init__(self) -> None:
        super().__init__(32)
        self.height = torch.nn.Parameter(torch.tensor(0.5, dtype=torch.float64))
        self.phase = torch.nn.Parameter(torch.tensor([float("nan"), 1.0]))

    def fill(self, nodes):
        return nodes.positions[..., :1].sin().float()


def test_parameters_keep_their_dtype_and_pages_read_them_whatever_they_are():
    """JSON has no NaN: a page that is sent one shows nothing."""
    producer, texts = Waves(), []
    session = new_session(producer, GRAY)
    try:
        session.join(texts.append)
        page = Page(session)
        assert page.camera and not any("NaN" in str(text) for text in texts)
        assert page.of_type("welcome")[0]["parameters"]["phase"]["value"] == [None, 1.0]
        page.send("set", name="height", value=0.1)
        page.next("parameters", 0)
        assert producer.height.item() == 0.1
    finally:
        session.close()


@dataclass
class Size:
    side: int = 16


def cube(size: Size) -> gv.Producer:
    data = np.zeros((size.side,) * 3, np.uint8)
    data[: size.side // 2] = 200
    return gv.VolumeProducer(gv.Volume(data))


def test_a_scene_of_another_size_has_its_own_box_and_slices():
    session = new_session(cube, FUNCTION)
    try:
        page = Page(session, 200, 160)
        page.send("change", state={"slices": {"position": [7, 7, 7]}})
        page.until(lambda: page.pictures and page.pictures[-1][0]["layout"])
        page.final()
        page.send("set", name="side", value=32)
        assert page.next("parameters", 0)["box"] == [[-0.5] * 3, [31.5] * 3]
        page.until(lambda: page.pictures[-1][0]["layout"]["x"]["columns"][2] == 31.5)
    finally:
        session.close()


def test_a_shader_that_does_not_scatter_takes_the_place_of_one_that_does():
    """`octaves` are left out, and their control is dimmed; also of a light at the eye."""
    sun = gv.DirectionalLight((1, -1, -2))
    session = new_session(bright_ball(), gv.Lit(FUNCTION, light=sun, octaves=2))
    try:
        page = Page(session)
        page.final()
        assert "Lit.octaves" not in page.of_type("welcome")[0]["unfit"]
        page.send("change", state={"shader": {"kind": "Isosurface", "value": 90, "octaves": 2}})
        answer = page.next("state", 0)
        assert "left out: render: shadows per sample are for Lit" in page.of_type("note")[0]["text"]
        assert answer["state"]["shader"]["octaves"] == 0 and "Isosurface.octaves" in answer["unfit"]
        page.send("change", state={"shader": {"value": 80}})  # of the present kind
        shader = page.next("state", 1)["state"]["shader"]
        assert shader["kind"] == "Isosurface" and shader["value"] == 80
        page.final()
        assert not page.of_type("error") and not page.of_type("refused")
    finally:
        session.close()
