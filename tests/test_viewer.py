"""Sessions and their pages, without a server or a browser."""

from __future__ import annotations

import gc
import time
import weakref
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from helpers.pictures import GRAY
from helpers.viewer import FUNCTION, Page, bright_ball, pixels, turned_camera

import gvtorch as gv
from gvtorch.base.stage import no_progress
from gvtorch.io.surface import export_surface
from gvtorch.viewer import export
from gvtorch.viewer.client import image_file
from gvtorch.viewer.scene import Scene
from gvtorch.viewer.view import new_session

pytestmark = pytest.mark.backend("cpp")


def test_a_page_gets_the_picture_that_python_makes(session):
    """Coarse at once, then all samples: as `gv.Progressive` renders a resident tree, except for
    JPEG's losses."""
    page = Page(session, 96, 64)
    head, seen = page.final()
    first, data = page.pictures[0]
    assert first["number"] == 1 and pixels(data).shape[0] <= 64
    assert head["samples"] == session.state.develop.samples == 16
    tree = gv.N3Tree.from_volume(bright_ball())
    camera = session.state.camera.camera(96, 64, tree.box)
    drawn = gv.Progressive(lambda view: gv.render(tree, view, FUNCTION)).refine(camera, 16)
    expected = drawn.to_srgb8().numpy()
    assert seen.shape == expected.shape == (64, 96, 3) and expected.std() > 10
    assert np.array_equal(seen, pixels(image_file(drawn, "JPEG", quality=94, subsampling=0))), (
        "to the last bit, before JPEG"
    )
    assert np.abs(seen.astype(int) - expected).mean() < 1


def test_pictures_stop_when_nothing_changes_and_go_on_when_something_does(session):
    page = Page(session)
    page.final()
    count = len(page.pictures)
    assert session.ask(lambda: [c.wants_picture() for c in session.clients.values()]) == [False]
    _, before = page.final()
    _, after = page.moved(turned_camera(page.camera, 1.0))
    assert len(page.pictures) > count and np.abs(before.astype(int) - after).max() > 60
    page.send("change", state={"options": {"background": [0.0, 0.5, 0.0]}})
    page.until(
        lambda: page.pictures[-1][0]["final"] and pixels(page.pictures[-1][1])[0, 0, 1] > 150
    )
    state = page.of_type("state")[-1]["state"]
    assert state["options"]["background"] == [0.0, 0.5, 0.0] and state["options"]["step"] == 0.5
    whole = {name: c for name, c in page.of_type("welcome")[0]["state"].items() if name != "camera"}
    page.send("change", state=whole)  # as undo does
    page.until(
        lambda: page.of_type("state")[-1]["state"]["options"]["background"] == [0.0, 0.0, 0.0]
    )
    assert not page.of_type("refused")


def test_at_most_one_picture_is_on_its_way(session):
    """A page that does not acknowledge gets no second picture, and does not delay others."""
    slow, page = Page(session, acks=False), Page(session)
    slow.until(lambda: slow.pictures)
    camera = page.camera
    for step in range(20):
        camera = turned_camera(camera, 0.2)
        for sender in (slow, page):
            sender.send("move", camera=camera, moving=step < 19)
    page.until(lambda: page.pictures and page.pictures[-1][0]["camera"]["eye"] == camera["eye"])
    page.final()
    assert len(slow.pictures) == 1
    slow.acks = True
    slow.send("ack", number=slow.pictures[0][0]["number"])
    head, _ = slow.moved(camera)
    assert head["camera"]["eye"] == camera["eye"]


def test_two_pages_have_cameras_of_their_own_and_may_follow(session):
    first, second = Page(session), Page(session)
    _, still = second.final()
    there = turned_camera(first.camera, 0.7)
    _, moved = first.moved(there)
    assert np.array_equal(second.final()[1], still) and not np.array_equal(moved, still)
    second.send("follow", client=first.client.number)
    second.until(lambda: second.of_type("camera"))
    further = turned_camera(there, 0.7)
    _, seen = first.moved(further)
    second.until(lambda: np.allclose(second.pictures[-1][0]["camera"]["eye"], further["eye"]))
    assert np.array_equal(second.final()[1], seen)
    assert second.of_type("clients")[-1]["clients"] == {"1": None, "2": 1}
    session.leave(first.client)
    second.until(lambda: second.of_type("clients")[-1]["clients"] == {"2": None})
    second.moved(there)
    second.send("follow", client=7)
    assert "there is no client 7" in second.next("refused", 0)["text"]


def test_a_change_is_seen_by_all_and_a_wrong_one_by_nobody(session):
    first, second = Page(session), Page(session)
    _, before = second.final()
    function = {"kind": "TransferFunction", "opacity": [[20, 0], [60, 1]], "color": [[0, 0, 1, 0]]}
    first.send("change", state={"shader": function})
    second.until(lambda: second.of_type("state"))
    second.until(
        lambda: (
            second.pictures[-1][0]["final"] and pixels(second.pictures[-1][1])[..., 0].max() < 60
        )
    )
    assert pixels(second.pictures[-1][1])[..., 1].max() > 200 > before[..., 1].min()
    state_count = len(second.of_type("state"))
    for wrong in ({"shader": {"kind": "Lit"}}, {"options": {"step": -1}}, {"nothing": 1}):
        count = len(first.of_type("refused"))
        first.send("change", state=wrong)
        text = first.next("refused", count)["text"]
        assert "\n" not in text and text
    first.session.receive(first.client, b"\xff\xfe")
    first.session.receive(first.client, "[1, 2]")
    first.until(lambda: len(first.of_type("refused")) == 5)
    assert len(second.of_type("state")) == state_count and not second.of_type("refused")
    assert session.state.shader.opacity.tolist() == [[20, 0], [60, 1]]


def test_a_state_that_can_not_be_drawn_gives_way_to_the_last_that_could(session):
    """It is well-formed, but the tree has no such channel."""
    page = Page(session)
    _, before = page.final()
    page.send(
        "change",
        state={
            "shader": {
                "kind": "Features",
                "transfer": page.of_type("welcome")[0]["state"]["shader"],
                "channel": "none",
            }
        },
    )
    assert "unknown channel 'none'" in page.next("error", 0)["text"]
    page.until(
        lambda: (
            page.of_type("state")
            and page.of_type("state")[-1]["state"]["shader"]["kind"] == "TransferFunction"
        )
    )
    page.moved(turned_camera(page.camera, 0.1))
    _, after = page.moved(page.camera)
    assert np.abs(after.astype(int) - before).max() <= 2


def test_what_is_hit_histograms_presets_and_stills(session):
    page = Page(session, 64, 48)
    page.final()
    page.send("pick", x=0.5, y=0.5, purpose="focus")
    corner = {"x": 0.0, "y": 0.0}
    page.send("pick", **corner)
    page.until(lambda: len(page.of_type("picked")) == 2)
    hit, missed = page.of_type("picked")
    assert missed["place"] is None and hit["purpose"] == "focus"
    if hit["place"] is None:  # the ball is not in the middle
        rows, columns = np.nonzero(page.final()[1].max(-1) > 120)
        page.send("pick", x=float(columns.mean() / 64), y=float(rows.mean() / 48))
        hit = page.next("picked", 2)
    centre = (np.array([0.65, 0.5, 0.4]) * 40) - 0.5
    away = np.linalg.norm(np.array(hit["place"]) - centre)
    assert 3 < away < 10, "on the ball's surface"
    page.send("histogram", in_view=False)
    bars = page.next("histogram", 0)
    values = bright_ball().data.numpy()
    assert sum(bars["counts"]) == values.size and bars["low"] <= 0 and bars["high"] >= values.max()
    assert bars["counts"] == np.bincount(values.ravel()).tolist(), "a bar for each whole number"
    page.send("histogram", in_view=True)
    bars = page.next("histogram", 1)
    assert 0 < sum(bars["counts"]) < values.size * 2
    page.send("preset", name="hot", low=0.0, high=200.0)
    function = page.next("preset", 0)["function"]
    assert function["color"] == gv.TransferFunction.preset("hot", 0, 200).color.tolist()
    page.send("preset", name="no")
    assert "unknown preset 'no'" in page.next("refused", 0)["text"]
    page.send("still", width=80, height=40)
    page.until(lambda: page.files)
    still = pixels(page.files["picture.png"])
    tree = gv.N3Tree.from_volume(bright_ball())
    camera = session.state.camera.camera(80, 40, tree.box)
    progressive = gv.Progressive(lambda view: gv.render(tree, view, FUNCTION)).refine(camera, 16)
    assert np.array_equal(still, progressive.to_srgb8().numpy())


def test_figures_and_cost_pictures(session):
    page = Page(session)
    page.final()
    page.send("monitor", on=True)
    figures = page.next("figures", 0)
    assert (
        figures["samples"] > 0
        and "trace" in figures["stages"]
        and figures["report"]["occupancy"]["bricks"] > 0
    )
    assert figures["rays"] == 64 * 48
    page.send("change", state={"show": "samples"})
    page.until(lambda: page.of_type("state"))
    page.until(lambda: pixels(page.pictures[-1][1]).shape == (24, 32, 3))
    page.send("do", what="fit")
    page.next("camera", 0)


class Broken(gv.Producer):
    """A store that goes away: from then on, bricks that are not yet made fail."""

    alive = True

    def fill(self, nodes):
        if not self.alive:
            raise OSError("the disk is gone")
        depth = nodes.depth[:, None, None, None, None].float()
        return {"value": depth.expand(*nodes.positions.shape[:-1], 1)}


def test_a_scene_that_dies_is_told_and_the_picture_goes_on():
    producer = Broken(512)
    session = new_session(producer, gv.TransferFunction([(0, 0.01), (9, 0.2)]))
    try:
        page = Page(session)
        page.final()
        producer.alive = False
        near = {**page.camera, "target": [256.0, 256, 256], "eye": [300.0, 280, 520]}
        page.send("move", camera=near, moving=False)
        failure = page.next("failed", 0)
        assert "the disk is gone" in failure["text"] and failure["count"] > 0
        _, seen = page.moved(near)
        assert seen.max() > 0
        producer.alive = True
        page.send("do", what="retry")
        page.until(lambda: not page.of_type("busy") or page.of_type("busy")[-1]["misses"] == 0)
        page.final()
        assert session.ask(lambda: len(session.scene.engine.production.failures)) == 0
    finally:
        session.close()


@dataclass
class Settings:
    """The settings of a scene."""

    radius: float = field(default=10.0, metadata={"range": (1, 20)})
    hollow: bool = False


class Hollow(gv.Producer):
    """Its root can't be made."""

    def fill(self, nodes):
        raise OSError("nothing is there")


def ball(settings: Settings) -> gv.Producer:
    if settings.hollow:
        return Hollow(64)
    shape = gv.sdf.Sphere(settings.radius)
    return gv.FieldProducer(gv.Solid(shape), 64, box=((-20, -20, -20), (20, 20, 20)))


def test_fields_of_a_dataclass_and_parameters_of_a_module_become_controls():
    session = new_session(ball, gv.TransferFunction([(0.4, 0), (0.6, 1)]))
    try:
        page = Page(session)
        _, before = page.final()
        parameters = page.of_type("welcome")[0]["parameters"]
        assert parameters["radius"] == {"type": "number", "range": [1, 20], "value": 10.0}
        assert parameters["hollow"] == {"type": "flag", "value": False}
        page.send("set", name="radius", value=4.0)
        assert page.next("parameters", 0)["parameters"]["radius"]["value"] == 4.0
        share = page.until(lambda: (page.final()[1] > 128).sum() / (before > 128).sum() % 1.0)
        assert abs(share - (4 / 10) ** 2) < 0.06
        page.send("set", name="radius", value="large")
        assert "radius: must be a number" in page.next("refused", 0)["text"]
        page.send("set", name="weight", value=1)
        assert "no parameter 'weight'" in page.next("refused", 1)["text"]
        page.send("set", name="hollow", value=True)
        assert "nothing is there" in page.next("refused", 2)["text"]
        page.send("set", name="radius", value=10.0)  # the scene still works
        page.until(lambda: np.array_equal(page.final()[1], before))
    finally:
        session.close()

    class Level(gv.Producer):
        def __init__(self):
            super().__init__(32)
            self.level = torch.nn.Parameter(torch.tensor(0.1))

        def fill(self, nodes):
            return {"value": self.level.detach().expand(*nodes.positions.shape[:-1], 1).clone()}

    session = new_session(Level(), GRAY)
    try:
        page = Page(session)
        _, before = page.final()
        value = page.of_type("welcome")[0]["parameters"]["level"]
        assert value["type"] == "number" and abs(value["value"] - 0.1) < 1e-6
        page.send("set", name="level", value=0.9)
        page.until(lambda: page.final()[1].max() > before.max())
    finally:
        session.close()


def test_memory_is_set_while_it_is_looked_at(session):
    page = Page(session)
    _, before = page.final()
    page.send("resize", engine={"brick_pool": "2 MB"})
    assert page.next("engine", 0)["engine"]["brick_pool"] == "2 MB"
    assert session.ask(lambda: session.scene.engine.options.brick_pool) == "2 MB"
    page.moved(turned_camera(page.camera, 0.1))
    _, after = page.moved(page.camera)
    assert np.abs(after.astype(int) - before).max() <= 2
    page.send("resize", engine={"brick_pool": "2 B"})
    page.next("refused", 0)
    page.send("resize", engine={"device": "cuda"})
    assert "'device' can't be set" in page.next("refused", 1)["text"]
    page.moved(turned_camera(page.camera, 0.2))


@pytest.mark.parametrize("kind", ["tree", "engine", "producer", "store", "array", "path", "labels"])
def test_anything_can_be_looked_at(kind, scan_store, tmp_path):
    volume = bright_ball(16)
    np.save(tmp_path / "ball.npy", volume.data[..., 0].numpy())
    subject = {
        "tree": lambda: gv.N3Tree.from_volume(volume),
        "engine": lambda: gv.Engine(gv.VolumeProducer(volume)),
        "producer": lambda: gv.VolumeProducer(volume),
        "store": lambda: gv.Store.open(scan_store),
        "array": volume.data[..., 0].numpy,
        "path": lambda: str(tmp_path / "ball.npy"),
        "labels": lambda: gv.Volume((volume.data > 100).to(torch.uint8), labels=True),
    }[kind]()
    session = new_session(subject)
    try:
        page = Page(session)
        _, seen = page.final()
        assert seen.max() > 60, kind
    finally:
        session.close()
    if kind == "engine":
        subject.frame(gv.Camera.orbit(width=8, height=8), FUNCTION)  # its owner may go on using it
        subject.close()
    with pytest.raises(ValueError, match="view: takes an Engine"):
        new_session(object())
    with pytest.raises(FileNotFoundError):
        new_session(tmp_path / "no.npy")


def test_a_thousand_moves_leave_nothing_behind(session):
    page = Page(session, 32, 24)
    page.final()
    camera = page.camera

    def wander(times: int) -> None:
        nonlocal camera
        for _ in range(times):
            camera = turned_camera(camera, 0.05)
            page.send("move", camera=camera, moving=True)
            if len(page.pictures) > 20:
                del page.pictures[:-5]
        page.moved(camera)

    wander(200)
    gc.collect()
    before = len(gc.get_objects())
    wander(1000)
    gc.collect()
    assert len(gc.get_objects()) - before < 400
    client = weakref.ref(page.client)
    session.leave(page.client)
    del page.client
    session.ask(lambda: None)
    gc.collect()
    assert client() is None


def test_a_surface_is_handed_over_as_a_file(session, monkeypatch, tmp_path):
    """It equals that of `gvtorch surface`; progress is reported, and errors are one line."""
    page = Page(session)
    page.final()
    monkeypatch.setattr(export, "_PROGRESS_SECONDS", 0.0)
    expected = tmp_path / "a.ply"
    export_surface(bright_ball(), 100.0, expected)
    page.send("surface", value=100.0, format="ply")
    page.until(lambda: "surface.ply" in page.files)
    assert page.files["surface.ply"] == expected.read_bytes()
    assert all(0 < message["done"] < message["total"] for message in page.of_type("exporting"))
    page.until(lambda: session._export and not session._export.busy)
    page.send("surface", value=1e6)
    assert "1e+06" in page.next("refused", 0)["text"]
    page.until(lambda: session._export and not session._export.busy)
    monkeypatch.setattr(export, "_MAX_FILE_BYTES", 100)
    page.send("surface", value=100.0)
    assert "gvtorch surface" in page.next("refused", 1)["text"]
    assert [*page.files] == ["surface.ply"]
    page.final()


def test_who_follows_one_that_follows_moves_too(session):
    first, second, third = (Page(session) for _ in range(3))
    second.send("follow", client=first.client.number)
    third.send("follow", client=second.client.number)
    first.send("follow", client=third.client.number)  # in a circle
    circle = {"1": 3, "2": 1, "3": 2}
    third.until(lambda: [m["clients"] for m in third.of_type("clients")][-1:] == [circle])
    there = turned_camera(first.camera, 0.5)
    first.moved(there)

    def seen(page: Page) -> bool:
        return np.allclose(page.pictures[-1][0]["camera"]["eye"], there["eye"])

    for page in (second, third):
        page.until(lambda p=page: seen(p))
        assert seen(page)


def test_others_go_on_while_a_still_is_taken_and_it_ends_with_its_page(session):
    first, second = Page(session), Page(session)
    first.final()
    second.final()
    first.send("change", state={"develop": {"samples": 4096}}, rest=True)
    first.send("still", width=200, height=200)
    first.send("still", width=64, height=48)
    assert "one is being made already" in first.next("refused", 0)["text"]
    second.send("pick", x=0.5, y=0.5)
    second.next("picked", 0)
    assert not first.files and session.ask(lambda: len(session._stills)) == 1
    session.leave(first.client)
    second.until(lambda: not session._stills)
    second.send("still", width=200, height=200)
    session.ask(lambda: None)
    begin = time.monotonic()
    session.close()
    assert time.monotonic() - begin < 10 and not session._thread.is_alive()


def test_a_draft_that_takes_long_gives_way_to_a_newer_view(session, monkeypatch):
    """The next has fewer pixels; a page that leaves, and a view that closes, end it at once."""
    page = Page(session, 256, 256)
    page.final()
    frame, sizes, ended = Scene.frame, [], []

    def slow(scene, camera, state, progress=no_progress):
        sizes.append(camera.width)
        try:
            for row in range(1, 500):
                time.sleep(0.005 if camera.width > 200 else 0)
                progress("rays", row, 500)
        except BaseException:
            ended.append(camera.width)
            raise
        return frame(scene, camera, state, progress)

    monkeypatch.setattr(Scene, "frame", slow)
    session.ask(lambda: setattr(page.client, "_pixel_ms", 1e-9))
    for angle in (0.1, 0.2):
        page.send("move", camera=turned_camera(page.camera, angle), moving=True)
        page.until(lambda: sizes)
    page.until(lambda: len(sizes) > 1)
    assert ended[0] == sizes[0] == 256 > sizes[1]
    for end in (session.leave, lambda _: session.close()):
        sizes.clear()
        page = Page(session, 256, 256)
        page.until(lambda: sizes)
        ended.clear()
        end(page.client)
        page.until(lambda: ended)  # a frame that goes on to its end does not add to it


class Haze(torch.nn.Module):
    """A shader with a parameter; notes whether gradients by it are recorded."""

    def __init__(self):
        super().__init__()
        self.gain, self.recorded = torch.nn.Parameter(torch.tensor(0.01)), set()

    def forward(self, values, positions, directions, lengths):
        alpha = (self.gain * values).clamp(0, 1)
        self.recorded.add(alpha.requires_grad)
        return alpha.expand(-1, 3), alpha


def test_pages_and_tiles_record_no_gradients_of_a_module_shader(tmp_path):
    """Sixteen samples a pixel would hold those of sixteen pictures."""
    session = new_session(bright_ball(), gv.ModuleShader(haze := Haze()))
    try:
        Page(session, 24, 16).final()
    finally:
        session.close()
    assert haze.recorded == {False}
    tree, camera = gv.N3Tree.from_volume(bright_ball()), gv.Camera.orbit(width=8, height=8)
    seen: list[gv.Picture] = []

    def draw(part: gv.Camera) -> gv.Picture:
        seen.append(gv.render(tree, part, gv.ModuleShader(haze)))
        return seen[-1]

    gv.render_tiles(draw, camera, tmp_path / "a.npy")
    assert not any(picture.color.requires_grad for picture in seen)
    draw(camera)
    assert seen[-1].color.requires_grad and haze.recorded == {False, True}


def test_whole_states_with_what_json_can_not_tell_are_taken():
    module = gv.ModuleShader(gv.TransferModule(FUNCTION, 1.0))
    session = new_session(bright_ball(), module)
    try:
        page = Page(session)
        page.until(lambda: page.of_type("welcome"))
        state = page.of_type("welcome")[0]["state"]
        assert set(state["shader"]) == {"kept"}
        page.send("change", state={**state, "develop": {"exposure": 1.0}}, rest=True)
        page.until(lambda: session.state.develop.exposure == 1.0)
        assert session.state.shader is module and not page.of_type("refused")
    finally:
        session.close()
