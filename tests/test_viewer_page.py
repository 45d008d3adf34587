"""The page in a real browser: mouse and keyboard, and the requests that it makes."""

from __future__ import annotations

import asyncio
import base64
import json
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from helpers import gvtorch
from helpers.browser import Tab
from helpers.viewer import BANDS, bright_ball, pixels

import gvtorch as gv
from gvtorch.viewer.notebook import module_text
from gvtorch.viewer.server import page_files
from gvtorch.viewer.state import Development
from gvtorch.viewer.view import new_session

pytestmark = pytest.mark.backend("browser")
STAGE = (340.0, 210.0)  # the middle of the picture, in the page


#: As anywidget does, passes a model and an element to the module.
_MODEL = """async (text) => {
  const url = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  const takers = new Set();
  const view = (raw) => new DataView(Uint8Array.from(atob(raw), (c) => c.charCodeAt(0)).buffer);
  window.give = (text, raw) => takers.forEach((take) => take({ text }, raw ? [view(raw)] : []));
  const send = (content) => window.toPython(content);
  const on = (_, take) => takers.add(take), off = (_, take) => takers.delete(take);
  const model = { get: () => 400, on, off, send }, el = document.getElementById("cell");
  const end = await (await import(url)).default.render({ model, el });
  window.leave = () => { end(); return takers.size; };
}"""


def test_the_page_asks_for_nothing_outside(tab, viewer):
    """Only its modules, its style and one websocket, all from its own server."""
    hosts = {urlsplit(url).netloc for url in tab.requests}
    assert hosts == {f"127.0.0.1:{viewer.server.port}"}
    paths = {urlsplit(url).path.lstrip("/") for url in tab.requests}
    assert {
        name for name in page_files() if name.endswith((".js", ".css"))
    } <= paths and "ws" in paths
    for name, content in page_files().items():
        text = content.decode().replace("http://www.w3.org/2000/svg", "")
        for outside in (
            "://",
            "//cdn",
            "@import",
            "eval(",
            "innerHTML",
            "new Function",
        ):
            assert outside not in text, (name, outside)
        assert len(text.splitlines()) < 400, name
    assert tab.pixels().std() > 5


def test_the_canvas_shows_what_render_makes_of_the_saved_state(tab, tmp_path):
    """A screenshot equals `gvtorch render --state`, except for JPEG's losses."""
    tab.drag(STAGE, (400, 180))
    tab.page.mouse.wheel(0, -200)
    tab.pause(300)
    seen = tab.final()
    with tab.page.expect_download() as saved:
        tab.page.get_by_label("Save all that is shown").click()
    saved.value.save_as(tmp_path / "view.json")
    assert json.loads((tmp_path / "view.json").read_text())["camera"] is not None
    np.save(tmp_path / "ball.npy", bright_ball().data[..., 0].numpy())
    size = f"{seen.shape[1]}x{seen.shape[0]}"
    run = gvtorch(
        *("render", tmp_path / "ball.npy", "-o", tmp_path / "a.png"),
        *("--size", size, "--state", tmp_path / "view.json"),
    )
    assert run.returncode == 0, run.stderr
    expected = pixels((tmp_path / "a.png").read_bytes()).astype(int)
    assert expected.std() > 10 and np.abs(seen - expected).mean() < 0.5
    assert np.abs(seen - expected).max() < 40


def test_hands_turn_pan_zoom_and_fly(tab):
    before, camera = tab.final(), tab.app("app.camera")

    def after() -> tuple[np.ndarray, dict]:
        tab.pause(250)
        return tab.final(), tab.app("app.camera")

    def far(c: dict) -> float:
        return float(np.linalg.norm(np.subtract(c["eye"], c["target"])))

    def away(c: dict) -> np.ndarray:
        return np.subtract(c["eye"], c["target"]) / far(c)

    tab.drag(STAGE, (420, 230))
    turned, there = after()
    assert np.abs(turned.astype(int) - before).max() > 60
    assert np.allclose(there["target"], camera["target"]) and abs(far(there) - far(camera)) < 1e-6
    tab.drag(STAGE, (380, 210), button="right")
    _, panned = after()
    assert np.allclose(
        np.subtract(panned["eye"], there["eye"]), np.subtract(panned["target"], there["target"])
    )
    # What was under the pointer stays there: 40 of 420 pixels, at the target's distance.
    moved = np.linalg.norm(np.subtract(panned["target"], there["target"]))
    assert abs(moved - 40 / 210 * far(there) * np.tan(np.radians(15))) < 1e-3 * moved
    tab.page.mouse.move(300, 100)
    tab.page.mouse.wheel(0, -250)
    _, near = after()
    assert far(near) < 0.8 * far(panned) and not np.allclose(near["target"], panned["target"])
    tab.page.keyboard.down("w")
    tab.until(lambda: not np.allclose(tab.app("app.camera.eye"), near["eye"]))
    tab.page.keyboard.up("w")
    _, flown = after()
    assert abs(far(flown) - far(near)) < 1e-6 and not np.allclose(flown["eye"], near["eye"])
    tab.page.keyboard.press("f")
    tab.until(lambda: far(tab.app("app.camera")) > 1.3 * far(near))
    tab.page.keyboard.press("3")
    tab.until(lambda: np.allclose(away(tab.app("app.camera")), (0, 1, 0), atol=1e-6))
    tab.page.keyboard.press("o")
    flat, ortho = after()
    assert ortho["model"] == "ortho" and flat.std() > 5


def test_a_double_click_looks_at_what_is_hit(tab):
    rows, columns = np.nonzero(tab.final().max(-1) > 150)
    scale = tab.app("app.view.ratio")
    tab.page.mouse.dblclick(columns.mean() / scale, rows.mean() / scale)
    tab.pause(700)
    centre = np.array([0.65, 0.5, 0.4]) * 40 - 0.5
    assert 3 < np.linalg.norm(tab.app("app.camera.target") - centre) < 10
    tab.final()


def test_a_knot_is_dragged_added_removed_and_undone(tab, viewer):
    before = tab.final()
    box = tab.page.locator(".gv-tf").bounding_box()

    def knot_position(index: int) -> list[float]:
        point = f"app.transfer().opacity[{index}]"
        return tab.app(f"[app.panel.editor.x({point}[0]), app.panel.editor.y({point}[1])]")

    x, y = knot_position(1)
    tab.drag((box["x"] + x, box["y"] + y), (box["x"] + x + 8, box["y"] + 15))
    tab.until(lambda: np.abs(tab.final().astype(int) - before).max() > 30)
    opacity = viewer.session.ask(viewer.state.shader.opacity.tolist)
    assert opacity[1][1] > 0.8 and opacity[0] == [20, 0] and opacity[1][0] > 120
    assert opacity == tab.app("app.transfer().opacity")
    tab.page.mouse.click(box["x"] + x - 40, box["y"] + 100)
    tab.until("app.transfer().opacity.length === 4")
    x, y = knot_position(1)
    tab.page.mouse.click(box["x"] + x, box["y"] + y, button="right")
    tab.until("app.transfer().opacity.length === 3")
    for _ in range(3):
        tab.page.get_by_label("Undo").click()
    tab.until("app.transfer().opacity[1][0] === 120")
    tab.until(lambda: np.abs(tab.final().astype(int) - before).max() <= 3)


def test_the_window_is_dragged_in_the_picture_and_presets_apply(tab):
    before = tab.app("app.transfer().opacity.map((p) => p[0])")
    tab.page.keyboard.down("Alt")
    tab.drag(STAGE, (340, 150))
    tab.page.keyboard.up("Alt")
    after = tab.app("app.transfer().opacity.map((p) => p[0])")
    assert np.allclose(np.diff(after), np.diff(before), rtol=1e-6) and after[0] > before[0] + 5
    tab.page.locator(".gv-bar select").first.select_option("viridis")
    tab.until("app.transfer().color.length === 256")
    assert tab.app("app.transfer().opacity.map((p) => p[0])") == after
    tab.page.locator(".gv-bar select").first.select_option("hot")
    tab.until("app.transfer().color.length === 4")
    tab.final()


def test_the_crop_box_is_moved_by_its_handles(tab, viewer):
    before = tab.final()
    tab.open("Clip")
    tab.page.locator(".gv-row:has-text('crop box') input").check()
    tab.until("app.view.handles.length === 6")
    tab.final()
    of_x = "app.view.handles.find((one) => one.axis === 0 && one.side === 1)"
    handle = tab.app(f"[...{of_x}.at, ...{of_x}.step, app.view.ratio]")
    x, y, dx, dy, ratio = handle
    span = np.hypot(dx, dy)
    tab.drag((x / ratio, y / ratio), ((x - 60 * dx / span) / ratio, (y - 60 * dy / span) / ratio))
    tab.until(lambda: np.abs(tab.final().astype(int) - before).max() > 60)
    clip = viewer.session.ask(lambda: viewer.state.options.clip)
    assert clip.boxes[0][1][0] < 0.4 and clip.boxes[0][0] == [-0.5, -0.5, -0.5]
    tab.page.get_by_text("add one facing me").click()
    tab.until("app.state.options.clip.planes.length === 1")
    tab.page.locator(".gv-row:has-text('crop box') input").uncheck()
    tab.until("app.state.options.clip.boxes.length === 0")
    tab.final()


def test_every_shader_and_section_has_controls_that_work(tab, viewer):
    """Each offered shader draws; numbers, flags, colours and choices reach the server."""
    for section in ("Light and lens", "Sampling", "Camera", "Memory", "Monitor"):
        tab.open(section)
    for name in ("Lit", "Isosurface", "Projection", "Gradient magnitude", "Pre integrated"):
        tab.page.locator("details:has(> summary:text-is('Shader')) select").first.select_option(
            name
        )
        kind = name.title().replace(" ", "") if " " in name else name
        tab.until(lambda kind=kind: type(viewer.state.shader).__name__ == kind)
        tab.pause(100)
        assert tab.final().std() > 3, name
    tab.page.locator("details:has(> summary:text-is('Shader')) select").first.select_option("Lit")
    tab.until(lambda: type(viewer.state.shader).__name__ == "Lit")
    row = tab.page.locator("label.gv-row:has-text('diffuse') input[type=number]")
    row.fill("0.33")
    row.press("Enter")
    tab.until(lambda: viewer.state.shader.diffuse == 0.33)
    tab.page.locator("label.gv-row:has-text('shadows') input").check()
    tab.until(lambda: viewer.state.shader.shadows is True)
    tab.page.locator("label.gv-row:has-text('lens') select").select_option("Thin lens")
    tab.until(lambda: viewer.state.options.lens is not None)
    tab.page.locator("label.gv-row:has-text('lighting') select").select_option("Lighting")
    tab.until(lambda: viewer.state.options.lighting is not None)
    tab.page.locator("div.gv-row:has-text('lights') button").first.click()
    tab.until(lambda: len(viewer.state.options.lighting.lights or ()) == 1)
    tab.until("app.monitor.frames.length > 0")
    assert tab.page.locator(".gv-figures b").count() > 5
    tab.final()
    assert not tab.page.locator(".gv-note.gv-bad.gv-shown").count()


def test_two_pages_and_one_that_follows(tab, chromium, viewer):
    other = Tab(chromium, viewer.url)
    try:
        other.until("app?.state")
        other.final()
        tab.until("Object.keys(app.clients).length === 2")
        other.open("Camera")
        other.page.locator("label.gv-row:has-text('follow') select").select_option("page 1")
        tab.drag(STAGE, (410, 240))
        tab.pause(300)
        eye = tab.app("app.camera.eye")
        other.until(lambda: np.allclose(other.app("app.camera.eye"), eye))
        other.until(lambda: np.array_equal(other.final(), tab.final()))
        assert not other.complaints
    finally:
        other.close()
    tab.until("Object.keys(app.clients).length === 1")


def test_fingers_turn_and_pinch(chromium, viewer):
    tab = Tab(chromium, viewer.url, has_touch=True)
    try:
        tab.until("app?.state")
        tab.final()
        touch = tab.context.new_cdp_session(tab.page)

        def send(kind: str, *positions: tuple[float, float]) -> None:
            points = [{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(positions)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        eye = tab.app("app.camera.eye")
        send("touchStart", (150, 200))
        for step in range(5):
            send("touchMove", (150 + 10 * step, 200))
        send("touchEnd")
        tab.until(lambda: not np.allclose(tab.app("app.camera.eye"), eye))
        far = "Math.hypot(...app.camera.eye.map((x, n) => x - app.camera.target[n]))"
        before = tab.app(far)
        send("touchStart", (150, 200), (200, 200))
        for step in range(5):
            send("touchMove", (150 - 10 * step, 200), (200 + 10 * step, 200))
        send("touchEnd")
        tab.until(lambda: tab.app(far) < 0.6 * before)
        assert not tab.complaints
    finally:
        tab.close()


def test_a_view_that_ends_is_told(chromium):
    viewer = gv.view(bright_ball(), BANDS, browser=False, wait=False)
    tab = Tab(chromium, viewer.url)
    try:
        tab.until("app?.state")
        tab.final()
        viewer.close()
        tab.until("app.root.classList.contains('gv-lost')")
        note = tab.page.locator(".gv-note").inner_text()  # a busy machine may not report the end
        assert note.startswith(("The view was closed", "The view is gone"))
    finally:
        tab.close()
        viewer.close()


def test_the_notebook_mounts_the_same_page(chromium):
    """The module that anywidget loads, with a model that passes messages to a session as the widget
    does."""
    session = new_session(bright_ball(), BANDS)
    context = chromium.new_context(viewport={"width": 720, "height": 420})
    page, clients, complaints, waiting = context.new_page(), [], [], []
    page.on("pageerror", lambda error: complaints.append(str(error)))

    def take(_source, content):
        if content.get("joined"):
            clients.append(session.join(waiting.append))
        elif "joined" in content:
            session.leave(clients[0])
        else:
            session.receive(clients[0], content["text"])

    try:
        page.expose_binding("toPython", take)
        page.set_content("<div id='cell' style='width: 700px'></div>")
        page.add_style_tag(content=page_files()["style.css"].decode())
        page.evaluate(
            _MODEL,
            module_text(),
        )
        for _ in range(6000):
            page.wait_for_timeout(10)
            for data in [waiting.pop(0) for _ in range(len(waiting))]:
                raw = None if isinstance(data, str) else base64.b64encode(data).decode()
                page.evaluate(
                    "([text, raw]) => give(text, raw)", [data if raw is None else None, raw]
                )
            if page.evaluate("() => document.querySelector('.gv')?.app.view.head?.final"):
                break
        assert page.evaluate("() => document.querySelector('.gv').app.view.head.final")
        box = page.locator(".gv").bounding_box()
        assert box["height"] == 400 and not complaints
        assert page.evaluate("() => leave()") == 0, "the page that has left listens no more"
        assert session.ask(lambda: len(session.clients)) == 0
    finally:
        context.close()
        session.close()


def test_channels_and_labels_have_controls(chromium):
    """Colour, window and switch of a channel; a scene of labels is drawn without a function."""
    z, y, x = np.mgrid[0:16, 0:16, 0:16]
    two = gv.Volume(np.stack((x * 16, y * 16), -1).astype(np.uint8))
    shader = gv.Channels([gv.ChannelLook(window=(40.0, 250.0), color="red", name="tubulin"),
                          gv.ChannelLook(window=(40.0, 250.0), color="green")])  # fmt: skip
    state = gv.ViewState(shader=shader, develop=Development(samples=1))
    with gv.view(two, state=state, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        before = tab.final()
        assert before[..., 0].max() > 150 and before[..., 1].max() > 150
        swatches = tab.page.locator("input.gv-color")
        values = swatches.evaluate_all("(inputs) => inputs.map((input) => input.value)")
        assert "#ff0000" in values and "#00ff00" in values
        first = tab.page.locator("div.gv-group:has(> .gv-strong:text-is('tubulin'))")
        first.locator("label.gv-row:has-text('visible') input").uncheck()
        tab.until(lambda: tab.final()[..., 0].max() < 60)
        assert viewer.state.shader.looks[0].visible is False
        low = first.locator("label.gv-row:has-text('window') input").first
        low.fill("100")
        low.press("Enter")
        tab.until(lambda: viewer.state.shader.looks[0].window == (100, 250))
        assert viewer.state.shader.looks[1].name == "" and not tab.complaints
        tab.close()
    labels = gv.Volume((z > 8).astype(np.uint8) + 1, labels=True)
    with gv.view(labels, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        assert tab.final().max() > 80 and not tab.page.locator(".gv-tf").count()
        row = tab.page.locator("label.gv-row:has-text('ambient') input[type=number]")
        row.fill("0.9")
        row.press("Enter")
        tab.until(lambda: viewer.state.shader.ambient == 0.9)
        assert not tab.complaints
        tab.close()


def number_of(tab: Tab, name: str) -> Any:
    """Returns the field of a number, by its name in the panel."""
    return tab.page.locator(f"label.gv-row:has(> .gv-name:text-is('{name}')) input").last


def test_a_connection_that_was_lost_goes_on_where_it_was(tab, viewer):
    """The page keeps its camera and open sections, and gets the picture of its camera."""
    tab.open("Camera")
    tab.page.mouse.move(*STAGE)
    tab.page.mouse.wheel(0, -300)
    tab.pause(300)
    before, eye = tab.final(), tab.app("app.camera.eye")
    tab.app("app.view.head = null")
    server = viewer.server
    for socket in list(server._sockets):
        asyncio.run_coroutine_threadsafe(socket.close(), server._loop)
    after = tab.final()
    assert tab.app("app.camera.eye") == eye and np.array_equal(after, before)
    assert number_of(tab, "fov").is_visible()


def test_keys_pressed_anew_fly_no_faster(tab):
    """A key that is released and pressed before the next frame starts no second flight."""
    frames = tab.page.evaluate("""async () => {
      const stage = document.querySelector(".gv-stage");
      const { pointer } = document.querySelector(".gv").app;
      const fly = pointer.fly.bind(pointer);
      let calls = 0, frames = 0;
      pointer.fly = (...times) => { calls += 1; return fly(...times); };
      for (const type of ["keydown", "keyup", "keydown", "keyup", "keydown"]) {
        stage.dispatchEvent(new KeyboardEvent(type, { key: "w", bubbles: true }));
      }
      for (; frames < 6; frames += 1) await new Promise(requestAnimationFrame);
      stage.dispatchEvent(new KeyboardEvent("keyup", { key: "w", bubbles: true }));
      return [calls, frames];
    }""")
    assert abs(frames[0] - frames[1]) <= 1, frames


def test_a_hand_stops_a_gliding_camera(tab):
    tab.app("(app.faceAxis(0, 1), app.moveCamera({ ...app.camera, fov: 20 }, false), null)")
    tab.pause(400)
    assert tab.app("app.camera.fov") == 20
    tab.final()


def test_a_number_that_is_deleted_comes_back(tab, viewer):
    field = number_of(tab, "exposure")
    field.fill("2")
    field.press("Enter")
    tab.until(lambda: viewer.state.develop.exposure == 2)
    field.fill("")
    field.press("Enter")
    tab.pause(200)
    assert viewer.state.develop.exposure == 2 and field.input_value() == "2"


def test_refused_memory_is_shown_as_it_is(tab, viewer, chromium):
    """What was typed gives way to the memory there is; other pages are told of another one."""
    tab.open("Memory")
    pool = number_of(tab, "brick pool")
    before = pool.input_value()
    pool.fill("lots")
    pool.press("Enter")
    tab.until("app.note.classList.contains('gv-bad')")
    tab.until(lambda: number_of(tab, "brick pool").input_value() == before)
    other = Tab(chromium, viewer.url)
    try:
        other.until("app?.engine")
        pool.fill("3 MB")
        pool.press("Enter")
        other.until("app.engine.brick_pool === '3 MB'")
    finally:
        other.close()


def test_only_what_changes_something_is_undone(tab):
    """Orthographic and back are edits; a click on a point of a function is none."""
    steps = "app.history.done.length"
    canvas = tab.page.locator(".gv-tf").bounding_box()
    x = tab.app("app.panel.editor.x(app.panel.editor.f.opacity[1][0])")
    y = tab.app("app.panel.editor.y(0.3)")
    tab.page.mouse.click(canvas["x"] + x, canvas["y"] + y)
    assert tab.app("app.panel.editor.chosen.index") == 1 and tab.app(steps) == 0
    tab.page.get_by_label("Orthographic or perspective").click()
    assert tab.app("app.camera.model") == "ortho" and tab.app(steps) == 1
    tab.page.get_by_label("Undo").click()
    assert tab.app("app.camera.model") == "pinhole"
    tab.final()


def test_the_histogram_in_view_is_that_of_the_view(tab):
    tab.page.get_by_text("in view").click()
    tab.until("app.panel.editor.histogram.in_view")
    before = tab.app("app.panel.editor.histogram.counts")
    tab.page.mouse.move(*STAGE)
    for _ in range(8):  # inside the ball
        tab.page.mouse.wheel(0, -300)
    tab.pause(300)
    tab.final()
    tab.until(lambda: tab.app("app.panel.editor.histogram.counts") != before)


def test_a_scene_without_data_has_the_histogram_of_its_pictures(chromium):
    ball = gv.FieldProducer(gv.Solid(gv.sdf.Sphere(9)), 32, box=((-10,) * 3, (10,) * 3))
    with gv.view(ball, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        tab.final()
        tab.until("app.panel.editor.histogram.in_view")
        tab.until("app.panel.editor.histogram.counts.some((count) => count > 0)")
        tab.close()


def test_a_handle_moves_the_first_of_several_boxes(chromium):
    boxes = [((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), ((-0.4, -0.4, -0.4), (0.4, 0.4, 0.4))]
    clip = gv.Clip(boxes=boxes, frame="box")
    with gv.view(bright_ball(), BANDS, clip=clip, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        tab.app("(app.clip.moveFace(0, 1, -4), app.finishEdit(), null)")
        tab.until(lambda: viewer.state.options.clip.boxes[0][1][0] < 0.45)
        assert len(viewer.state.options.clip.boxes) == 2
        tab.close()


def test_of_more_labels_than_a_page_has_all_are_found_and_none_is_hidden_by_another(chromium):
    """A list of those that are shown could name only those that the page has."""
    names = np.arange(17**3, dtype=np.uint16).reshape(17, 17, 17)
    with gv.view(gv.Volume(names, labels=True), browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url)
        tab.until("app?.state")
        assert tab.page.get_by_text("4853 more: find them by number").is_visible()
        row = tab.page.locator(".gv-label:has-text('17')").first
        assert row.locator("input[type=checkbox]").is_disabled()
        row.get_by_text("only").click()
        tab.until(lambda: viewer.state.shader.visible == [17])
        assert row.locator("input[type=checkbox]").is_enabled()
        search = tab.page.locator("input[placeholder='find a label']")
        for text, label in (("4912", 4912), ("490", 4905)):
            search.fill(text)
            row = tab.page.locator(f".gv-label:has-text('{label}')")
            row.wait_for()
            row.locator("input[type=checkbox]").check()
        tab.until(lambda: viewer.state.shader.visible == [17, 4905, 4912])
        row.locator("input[type=checkbox]").uncheck()
        tab.until(lambda: viewer.state.shader.visible == [17, 4912])
        assert tab.page.locator(".gv-label").count() == 15  # 490 to 4490, 4900 to 4909
        search.fill("")
        tab.page.get_by_text("4853 more: find them by number").wait_for()
        assert not tab.complaints
        tab.close()


def test_keys_work_wherever_the_focus_is(tab, viewer):
    """On a fresh page, and beside a slider; in a field, keys are text."""
    tab.page.keyboard.press("o")
    tab.until("app.camera.model === 'ortho'")
    slider = tab.page.locator("label.gv-row:has(> .gv-name:text-is('exposure')) input[type=range]")
    slider.focus()
    tab.page.keyboard.press("ArrowRight")
    tab.until(lambda: viewer.state.develop.exposure > 0)
    tab.page.keyboard.press("f")
    tab.page.keyboard.press("Control+z")
    tab.until(lambda: viewer.state.develop.exposure == 0)
    number_of(tab, "exposure").focus()
    tab.page.keyboard.press("Control+z")
    tab.pause(100)
    assert tab.app("app.camera.model") == "ortho"
    tab.final()


def test_a_picture_that_can_not_be_shown_is_followed_by_others(tab, viewer):
    head = "{ number: 0, camera: app.camera }"
    tab.app(f"app.link.emit('picture', {{ head: {head}, bytes: new Uint8Array(9) }})")
    tab.until("app.note.classList.contains('gv-bad')")
    number = tab.app("app.view.head.number")
    tab.page.mouse.move(*STAGE)
    tab.page.mouse.wheel(0, -200)
    tab.until(f"app.view.head.number > {number}")
    tab.final()


def test_letters_that_are_not_drawn_are_not_hit(tab):
    """The letters of the axes, where the camera is no plane."""
    x, y = tab.app("app.view.axisLetters[0].at.map((number) => number / app.view.ratio)")
    assert tab.app(f"app.view.axisAt({x}, {y})")
    tab.app("(app.changeCamera({ ...app.camera, model: 'fisheye' }, true), null)")
    assert not tab.app(f"app.view.axisAt({x}, {y})")
    tab.final()


def test_what_is_too_long_for_a_message_keeps_the_connection(tab):
    number = tab.app("app.number")
    tab.app("app.presets.read('a.json', '\"'.repeat(700000), null)")  # twice as long in JSON
    tab.until("app.note.textContent.includes('read: 1400')")
    tab.pause(700)
    assert tab.app("app.number") == number


def test_a_slider_is_dragged_from_end_to_end(chromium):
    """One of an object whose JSON changes its length meanwhile."""
    lens = gv.ThinLens(aperture=0.05, focus=2, frame="box")
    state = gv.ViewState(shader=BANDS, options=gv.RenderOptions(lens=lens))
    with gv.view(bright_ball(), state=state, browser=False, wait=False) as viewer:
        tab = Tab(chromium, viewer.url, viewport={"width": 1000, "height": 900})
        tab.until("app?.state")
        for section in ("Colours", "Shader", "Picture"):
            tab.page.locator(f"summary:text-is('{section}')").click()
        tab.open("Light and lens")
        row = tab.page.locator("label.gv-row:has(> .gv-name:text-is('focus'))")
        box = row.locator("input[type=range]").bounding_box()
        x, y = box["x"] + box["width"] * 0.3, box["y"] + box["height"] / 2
        mouse = tab.page.mouse
        mouse.move(x, y)
        mouse.down()
        mouse.move(x + box["width"] * 0.2, y, steps=4)
        tab.app("(app.setCamera(app.camera), null)")  # as of a page that is followed
        mouse.move(x + box["width"] * 0.5, y, steps=4)
        mouse.up()
        tab.until(lambda: viewer.state.options.lens.focus > 4)
        assert not tab.complaints
        tab.close()
