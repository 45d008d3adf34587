"""The page's editors in a real browser: slices, planes, labels, time, node boxes, presets, undo."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers import ROOT
from helpers.browser import Tab
from helpers.labels import cells
from helpers.stores import noise
from helpers.viewer import BANDS, TIMEOUT, Grown, Page

import gvtorch as gv
from gvtorch.io.stores.conversion import convert
from gvtorch.viewer.state import Development

pytestmark = pytest.mark.backend("browser")


def differs(first: np.ndarray, second: np.ndarray) -> int:
    return int(np.abs(first.astype(int) - second).max()) if first.shape == second.shape else 255


def middle(tab: Tab, axis: str, x: float = 0.5, y: float = 0.5) -> tuple[float, float]:
    """Returns a point of the picture of a plane, in page coordinates."""
    left, top, width, height = tab.app(f"app.slices.layout.{axis}.image")
    box, ratio = tab.page.locator(".gv-stage").bounding_box(), tab.app("app.view.ratio")
    return (box["x"] + (left + x * width) / ratio, box["y"] + (top + y * height) / ratio)


def with_slices(tab: Tab) -> np.ndarray:
    tab.page.get_by_label("Three slices beside").click()
    tab.until("!!app.slices.layout && app.view.head.final")
    tab.pause(300)
    return tab.final()


def test_slices_are_moved_by_click_drag_and_wheel(tab, viewer):
    alone = tab.final()
    before = with_slices(tab)
    assert differs(before, alone) > 60
    position = viewer.session.ask(lambda: viewer.state.slices.position)
    assert np.allclose(position, 19.5)
    tab.page.mouse.click(*middle(tab, "z", 0.65, 0.25))  # x to the right, y down
    tab.until(lambda: viewer.state.slices.position != position)
    tab.final()
    x, y, z = viewer.session.ask(lambda: viewer.state.slices.position)
    assert abs(x - 25.5) < 0.5 and abs(y - 9.5) < 0.5 and z == 19.5
    tab.page.mouse.move(*middle(tab, "z"))
    for _ in range(4):
        tab.page.mouse.wheel(0, 100)
        tab.pause(30)
    tab.until(lambda: viewer.state.slices.position[2] == 15.5)
    tab.until("!app.stateBefore")
    scrolled = tab.final()
    left, top, width, height = tab.app("app.slices.layout.z.image")
    part = np.s_[top : top + height, left : left + width]
    assert differs(scrolled[part], before[part]) > 30
    tab.drag(middle(tab, "x", 0.2, 0.2), middle(tab, "x", 0.8, 0.4))  # y to the right, z up
    tab.until(lambda: abs(viewer.state.slices.position[1] - 31.5) < 0.6)
    assert abs(viewer.state.slices.position[2] - 23.5) < 0.6
    camera, steps = tab.app("app.camera.eye"), tab.app("app.history.done.length")
    assert 4 <= steps <= 7  # on a busy machine the wheel pauses in between
    for _ in range(steps - 1):  # all except that slices are shown
        tab.page.get_by_label("Undo").click()
    tab.until("app.state.slices.position.every((one) => one === 19.5)")
    tab.page.get_by_label("Redo").click()
    tab.until(lambda: abs(viewer.state.slices.position[0] - 25.5) < 0.5)
    # The picture in its part of the canvas can be turned as before; the planes stay.
    area = tab.app("app.view.pictureArea")
    box = tab.page.locator(".gv-stage").bounding_box()
    start = (box["x"] + area["left"] + area["width"] / 2, box["y"] + area["top"] + 60)
    tab.drag(start, (start[0] + 40, start[1] + 10))
    tab.until(lambda: not np.allclose(tab.app("app.camera.eye"), camera))
    tab.page.get_by_label("Three slices beside").click()
    tab.until("!app.view.head.layout && app.view.head.final")
    assert viewer.state.slices is None


def test_a_double_click_beside_planes_looks_at_what_is_hit(tab):
    seen = with_slices(tab).max(-1)
    left, top, width, height = tab.app("app.view.pictureRect")
    rows, columns = np.nonzero(seen[top : top + height, left : left + width] > 150)
    box, ratio = tab.page.locator(".gv-stage").bounding_box(), tab.app("app.view.ratio")
    tab.page.mouse.dblclick(
        box["x"] + (left + columns.mean()) / ratio, box["y"] + (top + rows.mean()) / ratio
    )
    tab.pause(700)
    centre = np.array([0.65, 0.5, 0.4]) * 40 - 0.5
    assert 3 < np.linalg.norm(np.subtract(tab.app("app.camera.target"), centre)) < 10


def handle(tab: Tab, kind: str) -> tuple[float, float]:
    """Returns the position of a handle in the page."""
    x, y, ratio = tab.app(
        f"[...app.view.handles.find((h) => h.kind === '{kind}').at, app.view.ratio]"
    )
    box = tab.page.locator(".gv-stage").bounding_box()
    return (box["x"] + x / ratio, box["y"] + y / ratio)


def test_a_plane_is_moved_and_tilted_by_its_handles(tab, viewer):
    before = tab.final()
    tab.open("Clip")
    tab.page.get_by_text("add one facing me").click()
    tab.until("app.state.options.clip?.planes.length === 1")
    faced = tab.app("app.state.options.clip.planes[0]")
    tab.drag((200, 330), (330, 330))  # turned, so that the plane is seen from the side
    tab.pause(250)
    tab.until(lambda: differs(tab.final(), before) > 60)
    cut = tab.final()
    x, y = handle(tab, "plane")
    dx, dy = tab.app("app.view.handles.find((h) => h.kind === 'plane').step")
    span = np.hypot(dx, dy)
    tab.drag((x, y), (x + 25 * dx / span, y + 25 * dy / span))
    tab.until(lambda: viewer.state.options.clip.planes[0][3] != faced[3])
    moved = viewer.session.ask(lambda: list(viewer.state.options.clip.planes[0]))
    assert np.allclose(moved[:3], faced[:3]) and moved[3] > faced[3] + 0.02
    assert differs(tab.final(), cut) > 30
    # The handle followed the pointer.
    assert np.allclose(handle(tab, "plane"), (x + 25 * dx / span, y + 25 * dy / span), atol=3)
    anchor, (x, y) = handle(tab, "plane"), handle(tab, "tilt")
    tab.drag((x, y), (x, y - 30))
    tab.until(lambda: not np.allclose(viewer.state.options.clip.planes[0][:3], faced[:3]))
    tilted = viewer.session.ask(lambda: list(viewer.state.options.clip.planes[0]))
    assert abs(np.linalg.norm(tilted[:3]) - 1) < 1e-9 and np.dot(tilted[:3], faced[:3]) < 0.99
    assert handle(tab, "tilt")[1] < y - 8 and np.allclose(handle(tab, "plane"), anchor, atol=40)
    for _ in range(3):
        tab.page.get_by_label("Undo").click()
    tab.until("app.state.options.clip === null")


def test_labels_are_coloured_and_hidden_by_their_table(chromium):
    data = cells((24, 24, 24), 30, seed=2, dtype=np.uint8)
    state = gv.ViewState(shader=gv.Labels(lit=False), develop=Development(samples=1))
    with gv.view(gv.Volume(data, labels=True), state=state, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        before = tab.final()
        assert tab.page.locator(".gv-label").count() == 30
        tab.page.locator("input[placeholder='find a label']").fill("17")
        row = tab.page.locator(".gv-label:has-text('17')")
        tab.until(lambda: tab.page.locator(".gv-label").count() == 1)
        row.get_by_text("only").click()
        tab.until(lambda: viewer.state.shader.visible == [17])
        tab.until(lambda: differs(tab.final(), before) > 60)
        assert (tab.final().max(-1) > 30).sum() > 10
        row.locator("input[type=color]").evaluate(
            "(e) => { e.value = '#ff0000'; e.dispatchEvent(new Event('input'));"
            " e.dispatchEvent(new Event('change')); }"
        )
        tab.until(lambda: viewer.state.shader.colors == {17: [1, 0, 0]})
        tab.until(lambda: tab.final()[..., 0].max() > 200 and tab.final()[..., 1].max() < 60)
        tab.page.get_by_role("button", name="all", exact=True).click()
        tab.until(lambda: viewer.state.shader.visible is None)
        row.locator("input[type=checkbox]").uncheck()
        tab.until(lambda: viewer.state.shader.visible == [n for n in range(1, 30) if n != 17])
        for _ in range(4):
            tab.page.get_by_label("Undo").click()
        tab.until(lambda: viewer.state.shader.visible is None)
        tab.until(lambda: differs(tab.final(), before) <= 3)
        assert viewer.state.shader.colors is None and not tab.complaints
        tab.close()


@pytest.fixture(scope="module")
def beat(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("times")
    data = np.stack([noise((20, 24, 28, 1), seed=n)[..., 0] // (3 - n) for n in range(3)])
    np.save(folder / "beat.npy", data)
    convert(folder / "beat.npy", folder / "beat.zarr", axes="tzyx")
    return str(folder / "beat.zarr")


@pytest.mark.long
def test_time_is_slid_and_played(chromium, beat):
    state = gv.ViewState(shader=BANDS, develop=Development(samples=1))
    with gv.view(beat, state=state, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        before = tab.final()
        assert "1 of 3" in tab.page.locator(".gv-time").inner_text()
        tab.page.locator(".gv-time input").evaluate(
            "(e) => { e.value = 2; e.dispatchEvent(new Event('input'));"
            " e.dispatchEvent(new Event('change')); }"
        )
        tab.until("app.view.head.time === 2 && app.view.head.final")
        assert differs(tab.final(), before) > 20 and viewer.state.time == 2
        tab.page.get_by_label("Undo").click()
        tab.until("app.view.head.time === 0 && app.view.head.final")
        assert differs(tab.final(), before) <= 3
        tab.page.get_by_role("button", name="Play").click()
        for time in (1, 2, 0):
            tab.until(f"app.view.head.time === {time}")
        tab.page.get_by_role("button", name="Stop").click()
        tab.until("!app.times.playing && !app.stateBefore")
        assert not tab.complaints
        tab.close()


def test_a_clock_has_a_slider(chromium):
    producer = gv.FieldProducer(Grown(), 32, box=((-10, -10, -10), (10, 10, 10)))
    function = gv.TransferFunction([(0.4, 0), (0.6, 1)])
    state = gv.ViewState(shader=function, develop=Development(samples=1))
    with gv.view(producer, state=state, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        before = (tab.final() > 100).sum()
        tab.page.locator(".gv-time input").evaluate(
            "(e) => { e.value = 8; e.dispatchEvent(new Event('change')); }"
        )
        tab.until("app.view.head.time === 8 && app.view.head.final")
        assert (tab.final() > 100).sum() > 3 * before and producer.time == 8
        assert not tab.complaints
        tab.close()


def strokes(tab: Tab) -> int:
    """Returns how many pixels are drawn over the picture."""
    return tab.page.evaluate(
        """() => { const c = document.querySelector(".gv-over");
        const all = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        return all.filter((value, n) => n % 4 === 3 && value > 0).length; }"""
    )


def test_node_boxes_are_drawn_over_the_picture(tab):
    before = strokes(tab)
    tab.page.locator(".gv-tick:has-text('nodes') input").check()
    tab.until("app.nodes.message?.boxes.length > 0")
    assert strokes(tab) > before + 2000
    message, box = tab.app("app.nodes.message"), np.array(tab.app("app.box"))
    ends = np.array(tab.app("app.nodes.message.boxes.map((_, n) => app.nodes.box(n))"))
    assert (ends[:, 0] >= box[0] - 1e-6).all() and (ends[:, 1] <= box[1] + 1e-6).all()
    assert (ends[:, 1] > ends[:, 0]).all() and message["count"] == len(ends)
    tab.drag((340, 210), (400, 230))
    tab.pause(300)
    tab.final()
    tab.page.locator(".gv-tick:has-text('nodes') input").uncheck()
    tab.pause(100)
    assert strokes(tab) < before + 1000


def test_costs_lie_over_the_picture(tab, viewer):
    before = tab.final()
    tab.page.locator("label.gv-row:has-text('show') select").select_option("samples")
    tab.until(lambda: viewer.state.show == "samples")
    tab.until(lambda: differs(tab.final(), before) > 60)
    whole = tab.final()
    row = tab.page.locator("label.gv-row:has-text('blend') input[type=number]")
    row.fill("0.5")
    row.press("Enter")
    tab.until(lambda: viewer.state.blend == 0.5)
    tab.until(lambda: differs(tab.final(), whole) > 20)
    assert differs(tab.final(), before) > 20
    tab.page.get_by_label("Undo").click()
    tab.page.get_by_label("Undo").click()
    tab.until(lambda: viewer.state.show == "picture")
    tab.until(lambda: differs(tab.final(), before) <= 3)


def choose(tab: Tab, path) -> None:
    """Chooses a file of a transfer function in the page."""
    with tab.page.expect_file_chooser() as chooser:
        tab.page.get_by_label("Load a transfer function").click()
    chooser.value.set_files(path)


def test_presets_of_files_and_of_ones_own(tab, viewer, tmp_path):
    choose(tab, ROOT / "tests" / "paraview_presets.json")
    select = tab.page.locator(".gv-bar select").first
    tab.until("app.presets.file?.names.length > 3")
    before = viewer.session.ask(viewer.state.shader.to_json)
    select.select_option("HSV")
    tab.until(lambda: viewer.session.ask(viewer.state.shader.to_json) != before)
    expected = gv.TransferFunction.from_file(ROOT / "tests" / "paraview_presets.json", "HSV")
    colors = viewer.session.ask(viewer.state.shader.color.tolist)
    assert expected.relative and len(colors) == len(expected.color) > 1000
    ends = expected.stretched(0, 255)  # those of the function before
    assert np.allclose(colors, ends.color, atol=1e-9)
    attributes = 'scalarOpacity="4 0 0 9 1" colorTransfer="8 0 1 0 0 9 0 0 1"'
    both = "".join(f'<VolumeProperty name="{name}" {attributes}/>' for name in ("CT-A", "MR-B"))
    (tmp_path / "presets.xml").write_text(f"<MRML>{both}</MRML>")
    choose(tab, tmp_path / "presets.xml")
    tab.until("app.presets.file.names.length === 2")
    select.select_option("MR-B")
    tab.until("app.transfer().opacity.at(-1)[0] === 9")
    name = tab.page.locator("input[placeholder='name']")
    target = tab.page.locator("select[title='Where these colours are saved']")
    for action, file in (("save file", "few.json"), ("ParaView", "paraview.json")):
        target.select_option(action)
        name.fill("few")
        with tab.page.expect_download() as saved:
            tab.page.get_by_title("Save these colours").click()
        assert saved.value.suggested_filename == file
        saved.value.save_as(tmp_path / file)
        assert gv.TransferFunction.from_file(tmp_path / file).opacity[-1, 0] == 9
    target.select_option("save mine")
    name.fill("my colours")
    name.press("Enter")
    tab.until("!!document.querySelector(\".gv-bar optgroup[label='mine']\")")
    select.select_option("galaxy")
    tab.until("app.transfer().opacity.length === 6")
    tab.page.reload()
    tab.until("app?.state")
    tab.final()
    tab.page.locator(".gv-bar select").first.select_option("my colours")
    tab.until("app.transfer().opacity.at(-1)[0] === 9")
    tab.page.get_by_text("forget").click()
    tab.until("!document.querySelector(\".gv-bar optgroup[label='mine']\")")
    (tmp_path / "bad.json").write_text('{"opacity": [[1, 0], [0, 1]]}')
    choose(tab, tmp_path / "bad.json")
    note = tab.page.locator(".gv-note.gv-bad")
    tab.until(lambda: "bad.json" in note.inner_text() if note.count() else False)
    assert tab.app("app.transfer().opacity.at(-1)[0]") == 9


def test_every_edit_is_undone_and_done_again(tab, viewer, tmp_path):
    """Edits of the state, the camera's fields, memory, and a loaded state."""
    first = viewer.session.ask(viewer.state.to_json)
    for section in ("Sampling", "Camera", "Memory"):
        tab.open(section)

    def fill(name: str, value: str) -> None:
        row = tab.page.locator(f"label.gv-row:has(> .gv-name:text-is('{name}')) input")
        row.last.fill(value)
        row.last.press("Enter")

    was = viewer.session.ask(lambda: viewer.session.scene.engine.options.brick_pool)
    fill("step", "0.8")
    fill("fov", "41")
    fill("brick pool", "2 MB")
    tab.until(lambda: viewer.session.scene.engine.options.brick_pool == "2 MB")
    state = {**first, "develop": {**first["develop"], "exposure": 1.5}}
    (tmp_path / "view.json").write_text(json.dumps({**state, "camera": None}))
    with tab.page.expect_file_chooser() as chooser:
        tab.page.get_by_label("Load what was saved").click()
    chooser.value.set_files(tmp_path / "view.json")
    tab.until(lambda: viewer.state.develop.exposure == 1.5)
    tab.page.get_by_label("Undo").click()
    tab.until(lambda: viewer.state.develop.exposure == 0 and viewer.state.options.step == 0.8)
    tab.page.get_by_label("Undo").click()
    tab.until(lambda: viewer.session.scene.engine.options.brick_pool == was)
    tab.page.get_by_label("Undo").click()
    tab.until("app.camera.fov === 30")
    tab.page.get_by_label("Undo").click()
    tab.until(lambda: viewer.state.options.step == first["options"]["step"])
    for _ in range(4):
        tab.page.get_by_label("Redo").click()
    tab.until(lambda: viewer.state.develop.exposure == 1.5)
    tab.until("app.camera.fov === 41")
    tab.until(lambda: viewer.session.scene.engine.options.brick_pool == "2 MB")
    tab.final()


def test_a_file_that_is_no_state_leaves_the_view_as_it_is(tab, viewer, tmp_path):
    before, camera = viewer.session.ask(viewer.state.to_json), tab.app("app.camera")
    note = tab.page.locator(".gv-note")
    for content in ({"camera": {"eye": 5}}, {"camera": 7}, {"shader": None}, [1], 5):
        (tmp_path / "view.json").write_text(json.dumps(content))
        tab.app("(app.notify('nothing'), null)")
        with tab.page.expect_file_chooser() as chooser:
            tab.page.get_by_label("Load what was saved").click()
        chooser.value.set_files(tmp_path / "view.json")
        tab.until(lambda: "nothing" not in note.inner_text())
        tab.until("document.querySelector('.gv-note').classList.contains('gv-bad')")
    tab.pause(300)
    assert tab.app("app.camera") == camera
    assert viewer.session.ask(viewer.state.to_json) == before
    assert tab.app("app.state") == {name: before[name] for name in before if name != "camera"}
    tab.drag((300, 300), (420, 330))
    tab.until(f"JSON.stringify(app.camera) !== {json.dumps(json.dumps(camera))}")
    tab.final()


def test_views_become_the_keys_of_a_film(tab, viewer, tmp_path):
    """`gvtorch fly --keys` reads them; keys are shown, moved, removed, undone and loaded."""
    tab.open("Film")
    tab.page.get_by_text("add this view").click()
    first = tab.app("app.camera")
    tab.drag((200, 330), (330, 360))
    tab.until(lambda: tab.app("app.camera.eye") != first["eye"])
    second = tab.app("app.camera")
    tab.page.get_by_text("add this view").click()
    times = tab.page.locator("input[title='Seconds']")
    times.nth(1).fill("3.5")
    times.nth(1).press("Enter")
    tab.until("app.film.keys[1].time === 3.5")
    with tab.page.expect_download() as saved:
        tab.page.get_by_label("Save the keys").click()
    assert saved.value.suggested_filename == "keys.json"
    saved.value.save_as(tmp_path / "keys.json")
    flight = gv.Flight.read(tmp_path / "keys.json", viewer.session.ask(lambda: viewer.state))
    assert len(flight) == 2 and flight.seconds == 3.5
    for time, camera in ((0, first), (3.5, second)):
        assert np.allclose(flight.at(time).camera.eye, camera["eye"])
    tab.page.get_by_title("Show this key").first.click()
    tab.until(lambda: tab.app("app.camera.eye") == first["eye"])
    times.nth(1).fill("0")  # the first key has it
    times.nth(1).press("Enter")
    tab.until("!!document.querySelector('.gv-note.gv-bad')")
    assert times.nth(1).input_value() == "3.5"
    tab.page.get_by_title("Remove this key").first.click()
    tab.until("app.film.keys.length === 1 && app.film.keys[0].time === 3.5")
    tab.page.get_by_label("Undo").click()
    tab.until("app.film.keys.length === 2")
    (tmp_path / "bad.json").write_text('[{"time": 0}]')
    for file, count in (("bad.json", 2), ("keys.json", 2)):
        with tab.page.expect_file_chooser() as chooser:
            tab.page.get_by_label("Load keys").click()
        chooser.value.set_files(tmp_path / file)
        tab.until(f"app.film.keys.length === {count}")


def test_a_field_keeps_what_is_typed_while_the_view_changes(tab, viewer):
    """The panel is rebuilt once the number is entered; a rebuild before would end the edit."""
    for section in ("Film", "Sampling"):
        tab.open(section)
    tab.page.get_by_text("add this view").click()
    seconds = tab.page.locator("input[title='Seconds']")
    step = tab.page.locator("label.gv-row:has(> .gv-name:text-is('step')) input").last
    other = Page(viewer.session)
    tab.until("Object.keys(app.clients).length === 2")

    def change(size: float) -> None:
        field_text = step.input_value()
        other.send("change", state={"options": {"step": size}})
        tab.until(f"app.state.options.step === {size}")
        assert step.input_value() == field_text

    for typed, size in (("3.5", 0.6), ("4.5", 0.8)):
        seconds.select_text()
        change(size)
        tab.page.keyboard.type(typed)
        change(size + 0.125)
        if typed == "3.5":
            tab.page.keyboard.press("Enter")
        else:
            tab.page.locator(".gv-stage").focus()
        tab.until(f"app.film.keys[0].time === {typed}")
        tab.until(lambda size=size: step.input_value() == str(size + 0.125))


@pytest.mark.long
def test_every_shader_becomes_every_other(tab):
    """Common fields are kept; fields that only share a name are not."""
    row = tab.page.locator("label.gv-row:has(> span:text-is('shader')) select")
    names = row.locator("option").all_inner_texts()
    assert len(names) > 6 and tab.app("app.state.shader.kind") == "TransferFunction"
    knots = tab.app("app.state.shader.opacity")
    for first in range(len(names)):
        for second in range(first):
            for chosen in (first, second):
                row.select_option(label=names[chosen])
                kind = "".join(word.capitalize() for word in names[chosen].split())
                tab.until(f"app.state.shader.kind === '{kind}'")
    assert tab.app("app.transfer()?.opacity ?? app.lastTransfer.opacity") == knots
    tab.final()
    assert not tab.page.locator(".gv-note.gv-bad").count() and not tab.complaints


TOUCH = """() => {
  for (const part of document.querySelectorAll(".gv-panel details")) part.open = true;
  for (const box of document.querySelectorAll(".gv-panel input:not([type=file]), .gv-panel select"))
    for (const what of ["input", "change"]) box.dispatchEvent(new Event(what, { bubbles: true }));
}"""


@pytest.mark.long
def test_every_control_of_every_shader_is_touched(tab, viewer):
    """Each control sends the value that it shows: no code of the page fails; and a number that is
    typed where there is no slider is accepted.
    """
    row = tab.page.locator("label.gv-row:has(> span:text-is('shader')) select")
    for name in row.locator("option").all_inner_texts():
        row.select_option(label=name)
        tab.until("!app.stateBefore")
        tab.page.evaluate(TOUCH)
        tab.pause(50)
    assert not tab.complaints
    row.select_option(label="Isosurface")
    tab.until("app.state.shader.kind === 'Isosurface'")
    value = tab.page.locator("label.gv-row:has(> span:text-is('value')) input").first
    value.fill("123.5")
    value.press("Enter")
    tab.until(lambda: viewer.session.ask(lambda: viewer.state.shader, TIMEOUT).value == 123.5)


# Chooses every shader, then the options of each list (of other lists than the shader's: the last),
# each starting from that shader; returns what was refused.
CHOOSE = """async () => {
  const app = document.querySelector(".gv").app, refused = [];
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  for (const type of ["refused", "error"]) {
    app.link.on(type, ({ text }) => refused.push(`${doing}: ${text}`));
  }
  const settled = async () => {
    const before = refused.length;
    await pause(25);
    while (refused.length === before && !app.view.head?.final) await pause(5);
    await pause(10);
  };
  const lists = (names) => [...document.querySelectorAll(".gv-panel details")]
    .filter((one) => names.includes(one.firstChild.textContent))
    .flatMap((one) => { one.open = true; return [...one.querySelectorAll("select")]; });
  const all = () => lists(["Shader", "Picture", "Light and lens", "Sampling"]);
  const choose = async (list, n) => {
    const row = list.closest(".gv-row").textContent;
    doing = `${app.state.shader.kind}, ${row}: ${list.options[n].text}`;
    list.selectedIndex = n;
    list.dispatchEvent(new Event("change", { bubbles: true }));
    await settled();
  };
  let doing = "";
  for (let kind = 0; kind < lists(["Shader"])[0].options.length; kind++) {
    await choose(lists(["Shader"])[0], kind);
    const start = app.state;
    for (let at = 1; at < all().length; at++) {
      const own = at < lists(["Shader"]).length, count = all()[at].options.length;
      for (let n = own ? 0 : count - 1; n < count && !all()[at].disabled; n++) {
        await choose(all()[at], n);
        app.replaceState(start);
        await settled();
      }
    }
  }
  return refused;
}"""


def test_nothing_is_offered_that_is_refused(chromium):
    """In a scene with a second channel, by which surfaces may be coloured."""
    data = np.random.default_rng(1).random((12, 12, 12, 4), np.float32)
    channels = {"value": gv.Volume(data[..., 0]), "stored": gv.Volume(data)}
    state = gv.ViewState(
        shader=gv.TransferFunction.preset("gray", 0, 1), develop=Development(samples=1)
    )
    with gv.view(gv.VolumeProducer(channels), state=state, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url, viewport={"width": 560, "height": 240})
        tab.until("app?.state")
        tab.final()
        assert tab.page.evaluate(CHOOSE) == []
        assert not tab.complaints
        tab.close()


def test_another_shader_leaves_out_what_it_does_not_take(tab, viewer):
    """Lighting is removed, reported in one line, and returns when the choice is undone. A surface
    in a scene of one channel can't be coloured by another.
    """
    row = tab.page.locator("label.gv-row:has(> span:text-is('shader')) select")
    row.select_option(label="Lit")
    tab.open("Light and lens")
    tab.page.locator("label.gv-row:has-text('lighting') select").select_option("Lighting")
    tab.until(lambda: viewer.state.options.lighting is not None)
    row.select_option(label="Projection")
    tab.until(lambda: viewer.state.options.lighting is None)
    assert "lighting needs normals" in tab.page.locator(".gv-note.gv-shown").inner_text()
    for name in ("lighting", "lens"):
        tab.until(tab.page.locator(f"label.gv-row:has-text('{name}') select").is_disabled)
    tab.page.get_by_label("Undo").click()
    tab.until(lambda: viewer.state.options.lighting is not None)
    tab.page.get_by_label("Redo").click()
    tab.until(lambda: viewer.state.options.lighting is None)
    row.select_option(label="Isosurface")
    tab.until(lambda: isinstance(viewer.state.shader, gv.Isosurface))
    tab.final()
    colors = tab.page.locator("label.gv-row:has(> span:text-is('color')) option")
    assert colors.all_inner_texts() == []
    assert not tab.page.locator(".gv-note.gv-bad").count()


def test_a_surface_is_saved_by_its_buttons(tab, viewer, tmp_path):
    """Both kinds of files; a level without a surface is refused in one line."""
    row = tab.page.locator("label.gv-row:has(> span:text-is('shader')) select")
    row.select_option(label="Isosurface")
    tab.until("app.state.shader.kind === 'Isosurface'")
    level, counts = tab.page.get_by_title("Level of detail; 0 is the finest"), []
    for button, name in (("PLY", "ply"), ("glTF", "glb")):
        with tab.page.expect_download() as saved:
            tab.page.get_by_role("button", name=button, exact=True).click()
        file = tmp_path / f"surface.{name}"
        assert saved.value.suggested_filename.endswith(f".{name}")
        saved.value.save_as(file)
        counts.append(len(gv.read_mesh(file).faces))
    assert counts[0] == counts[1] > 500
    level.fill("99")
    level.press("Tab")
    tab.page.get_by_role("button", name="PLY", exact=True).click()
    tab.until("!!document.querySelector('.gv-note.gv-bad')")
    assert "level" in tab.page.locator(".gv-note.gv-bad").inner_text()
    assert not tab.complaints
