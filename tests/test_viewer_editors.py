"""Requests of the page's editors: slices, time, node boxes, labels, files of presets."""

from __future__ import annotations

import itertools
import json
import threading

import numpy as np
import pytest
import torch
from helpers import ROOT, gvtorch
from helpers.labels import cells
from helpers.pictures import GRAY
from helpers.stores import noise
from helpers.viewer import FUNCTION, TIMEOUT, Grown, Page, bright_ball, pixels, turned_camera

import gvtorch as gv
from gvtorch.io.stores.conversion import convert
from gvtorch.viewer import scene
from gvtorch.viewer.scene import node_boxes
from gvtorch.viewer.slices import Planes, panes
from gvtorch.viewer.state import Development, Eye, Slices
from gvtorch.viewer.view import new_session

pytestmark = pytest.mark.backend("cpp")
TIMES = 3


def sliced(page: Page, **slices) -> tuple[dict, np.ndarray]:
    """Changes the slices, and waits for the final picture with planes through that position."""
    page.send("change", state={"slices": slices})

    def come() -> bool:
        head = page.pictures[-1][0] if page.pictures else {}
        layout, position = head.get("layout"), slices.get("position")
        return bool(layout) and head["final"] and position in (None, layout["x"]["position"])

    page.until(come)
    return page.final()


def cut_out(image: np.ndarray, rectangle: list[int]) -> np.ndarray:
    left, top, width, height = rectangle
    return image[top : top + height, left : left + width]


def test_slices_are_those_of_slice_picture_beside_the_picture(session):
    """Every plane to the last bit, before JPEG; the 3D picture equals one of its part's size."""
    page, volume = Page(session, 404, 304), bright_ball()
    page.final()
    head, seen = sliced(page, position=[25.2, 19.0, 14.9])
    layout = head["layout"]
    page.send("still", width=404, height=304)
    page.until(lambda: page.files)
    still = pixels(page.files["picture.png"])
    span = gv.window(volume, background=True)
    for axis, index in (("x", 25), ("y", 19), ("z", 15)):
        scale = layout[axis]["image"][2] / 40
        expected = gv.slice_picture(volume, axis, index, span=span, scale=scale).to_srgb8().numpy()
        assert np.array_equal(cut_out(still, layout[axis]["image"]), expected), axis
    page.files.clear()
    sliced(page, position=[25.0, 19.0, 15.0], colors="shader")
    page.send("still", width=404, height=304)
    page.until(lambda: page.files)
    actual = cut_out(pixels(page.files["picture.png"]), layout["z"]["image"])
    scale = layout["z"]["image"][2] / 40
    expected = gv.slice_picture(volume, "z", 15, colors=FUNCTION, scale=scale).to_srgb8().numpy()
    assert np.array_equal(actual, expected)
    width, height = layout["view"][2:]
    tree = gv.N3Tree.from_volume(volume)
    camera = session.state.camera.camera(width, height, tree.box)
    alone = gv.Progressive(lambda view: gv.render(tree, view, FUNCTION)).refine(camera, 16)
    assert np.array_equal(cut_out(still, layout["view"]), alone.to_srgb8().numpy())
    assert np.abs(seen.astype(int) - still).mean() < 2 and seen.shape == (304, 404, 3)


def test_edges_of_a_plane_are_where_the_page_is_told(session):
    """The brightest voxel of the ball is where the edges sent to the page put it."""
    page = Page(session, 404, 304)
    page.final()
    middle = [0.65 * 40 - 0.5, 0.5 * 40 - 0.5, 0.4 * 40 - 0.5]
    layout = sliced(page, position=middle)[0]["layout"]
    seen = pixels(page.pictures[-1][1]).astype(int).sum(-1)
    for axis in "xyz":
        plane = layout[axis]
        part = cut_out(seen, plane["image"])
        rows, columns = np.nonzero(part >= part.max() - 3)
        for (name, first, last), pixel, count in (
            (plane["columns"], columns.mean(), part.shape[1]),
            (plane["rows"], rows.mean(), part.shape[0]),
        ):
            position = first + (pixel + 0.5) / count * (last - first)
            assert abs(position - middle["xyz".index(name)]) < 1, (axis, name)


def test_a_plane_that_moves_leaves_the_picture_as_it_is(session, monkeypatch):
    page = Page(session, 204, 154)
    page.final()
    sliced(page, position=[10.0, 10.0, 10.0])
    frames = []
    real = session.scene.frame
    monkeypatch.setattr(session.scene, "frame", lambda *a, **k: frames.append(1) or real(*a, **k))
    before, count = page.final()[1], len(page.pictures)
    for z in (11.0, 12.0, 13.0):
        head, seen = sliced(page, position=[10.0, 10.0, z])
    assert not frames and head["samples"] == 16 and len(page.pictures) > count
    left, top, width, height = head["layout"]["view"]
    inner = [left + 8, top + 8, width - 8, height - 8]  # JPEG's blocks reach across parts
    assert np.abs(cut_out(seen, inner).astype(int) - cut_out(before, inner)).max() <= 4
    page.send("change", state={"slices": None})
    page.until(lambda: page.pictures[-1][0]["final"] and not page.pictures[-1][0]["layout"])


def test_a_plane_that_takes_long_or_fails_holds_up_no_picture(session, monkeypatch):
    page = Page(session, 204, 154)
    page.final()
    sliced(page, position=[10.0, 10.0, 10.0])
    go, real = threading.Event(), Planes._render_plane

    def slow(self, axis, state, pixel):
        assert go.wait(TIMEOUT)
        if state.slices.position[2] == 30:
            raise OSError("chunk 3\nis gone")
        return real(self, axis, state, pixel)

    monkeypatch.setattr(Planes, "_render_plane", slow)
    page.send("change", state={"slices": {"position": [10.0, 10.0, 20.0]}})
    camera = turned_camera(page.camera, 0.5)
    page.send("move", camera=camera, moving=False)
    page.until(lambda: page.pictures[-1][0]["camera"]["eye"] == camera["eye"])
    page.until(lambda: page.pictures[-1][0]["samples"] == 16)
    assert not page.pictures[-1][0]["final"], "a plane is still on its way"
    go.set()
    page.final()
    page.send("change", state={"slices": {"position": [10.0, 10.0, 30.0]}})
    text = page.next("error", 0)["text"]
    assert text == "a slice can't be read: chunk 3 is gone"
    page.final()
    monkeypatch.setattr(Planes, "_render_plane", real)
    page.send("do", what="retry")
    page.until(lambda: page.pictures[-1][0]["final"] and page.of_type("error")[-1]["text"] == text)


def test_slices_of_a_store_read_no_finer_than_pixels(scan_store, monkeypatch):
    store = gv.Store.open(scan_store)
    state = gv.ViewState(shader=GRAY, slices=Slices())
    levels_read, real = [], gv.Store.read_region

    def read(self, level, low, high, **options):
        levels_read.append(level)
        return real(self, level, low, high, **options)

    monkeypatch.setattr(gv.Store, "read_region", read)
    planes = Planes(store, lambda problem: None)
    camera = gv.Camera.orbit(width=8, height=8)
    picture = gv.render(gv.N3Tree.from_volume(bright_ball(8)), camera, GRAY)
    sizes = {}
    for size in (2000, 200, 60):
        parts = panes(size, size)
        levels_read.clear()
        composed = planes.composed(picture, state, size, size, wait=True)
        assert composed.complete and composed.picture.color.shape == (size, size, 3)
        sizes[size] = set(levels_read)
        for axis in "xyz":
            left, top, width, height = composed.layout[axis]["image"]
            pane = parts[axis]
            assert pane.left <= left and left + width <= pane.left + pane.width
            assert pane.top <= top and top + height <= pane.top + pane.height
    assert 0 in sizes[2000] and min(sizes[60]) > min(sizes[200]) - 1 and max(sizes[60]) >= 1


def test_slices_of_labels_have_their_colours():
    data = cells((12, 13, 14), 9, seed=3) * 1000003  # indexed: wider than 16 bits
    volume = gv.Volume(data, labels=True)
    session = new_session(volume, gv.Labels({1000003: (1.0, 0.0, 0.0)}, visible=[1000003]))
    try:
        page = Page(session, 204, 154)
        page.final()
        labels = page.of_type("welcome")[0]["labels"]
        assert labels["names"] == sorted(set(data.ravel().tolist())) and labels["count"] == 9
        layout = sliced(page, position=[7.0, 6.0, 5.0])[0]["layout"]
        page.send("still", width=204, height=154)
        page.until(lambda: page.files)
        actual = cut_out(pixels(page.files["picture.png"]), layout["z"]["image"])
        rows = ((np.arange(actual.shape[0]) + 0.5) * 13 / actual.shape[0]).astype(int)
        columns = ((np.arange(actual.shape[1]) + 0.5) * 14 / actual.shape[1]).astype(int)
        names = data[5][np.ix_(rows, columns)]
        changed_colors = {1000003: (1.0, 0.0, 0.0)}
        colors = dict(zip(labels["names"], labels["colors"], strict=True)) | changed_colors
        light = torch.tensor([colors[n] for n in names.ravel().tolist()]).view(*names.shape, 3)
        expected = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        assert np.abs(actual / 255 - expected).max() < 0.01
    finally:
        session.close()


def test_what_has_no_voxels_has_no_slices(session):
    session_ = new_session(gv.FieldProducer(gv.Solid(gv.sdf.Sphere(4.0)), 32), GRAY)
    try:
        page = Page(session_)
        page.final()
        page.send("change", state={"slices": {}})
        assert "no voxels of its own" in page.next("refused", 0)["text"]
        assert page.next("state", 0)["state"]["slices"] is None
    finally:
        session_.close()
    page = Page(session)
    for wrong, message in (
        ({"position": [1, 2]}, "3 items"),
        ({"window": [3, 3]}, "window must rise"),
        ({"colors": "red"}, "'gray' or 'shader'"),
    ):
        count = len(page.of_type("refused"))
        page.send("change", state={"slices": wrong})
        assert message in page.next("refused", count)["text"]


def test_render_makes_the_picture_of_a_state_with_slices_and_cost(tmp_path):
    """`gvtorch render --state` equals the page's still of the same state, to the last bit."""
    volume = bright_ball()
    np.save(tmp_path / "ball.npy", volume.data[..., 0].numpy())
    common = {
        "shader": FUNCTION,
        "options": gv.RenderOptions(step=0.4, background=(0.1, 0.2, 0.3)),
        "camera": Eye(eye=(90, 60, 70), target=(20, 20, 20)),
        "develop": Development(samples=2, exposure=0.5),
    }
    for name, more in (
        ("slices", {"slices": Slices(position=(20, 22, 15), window=(10, 200))}),
        ("coloured", {"slices": Slices(colors="shader")}),
        ("blend", {"show": "samples", "blend": 0.4}),
        ("both", {"show": "nodes", "blend": 0.5, "slices": Slices()}),
        ("lit", {"show": "samples", "blend": 0.4, "shader": gv.Lit(FUNCTION)}),
    ):
        state = gv.ViewState(**{**common, **more})
        state.save(tmp_path / "view.json")
        run = gvtorch(
            *("render", tmp_path / "ball.npy", "-o", tmp_path / "a.png", "--size", "120x90"),
            *("--state", tmp_path / "view.json"),
        )
        assert run.returncode == 0, run.stderr
        seen = pixels((tmp_path / "a.png").read_bytes())
        tree = gv.N3Tree.from_volume(volume)
        session = new_session(tree, state=tmp_path / "view.json")
        try:
            assert session.state.to_json() == state.to_json()
            still = session.ask(lambda s=session: s.still(s.state.camera, 120, 90))
        finally:
            session.close()
        assert np.array_equal(seen, still.to_srgb8().numpy()) and seen.std() > 5, name
        if name == "blend":
            settings = {**state.settings(), "shader": FUNCTION}
            camera = state.camera.camera(120, 90, tree.box)
            progressive = gv.Progressive(lambda view, s=settings, t=tree: gv.render(t, view, **s))
            base = state.develop.develop(progressive.refine(camera, 2)).color
            cost = gv.cost(tree, camera, **settings).picture("samples")
            mixed = torch.lerp(base, cost.color, 0.4 * cost.alpha)
            assert (still.color - mixed).abs().max() < 1e-6


# Time.


@pytest.fixture(scope="module")
def beat(tmp_path_factory) -> str:
    """A store of three time points."""
    folder = tmp_path_factory.mktemp("times")
    data = np.stack([noise((20, 24, 28, 1), seed=n)[..., 0] // (TIMES - n) for n in range(TIMES)])
    np.save(folder / "beat.npy", data)
    convert(folder / "beat.npy", folder / "beat.zarr", axes="tzyx")
    return str(folder / "beat.zarr")


def test_time_points_of_a_store_are_gone_through(beat, tmp_path):
    session = new_session(beat, FUNCTION)
    try:
        page = Page(session, 96, 64)
        _, first = page.final()
        assert page.of_type("welcome")[0]["time"]["times"] == TIMES
        pictures = [first]
        for time in (1, 2):
            page.send("change", state={"time": time})
            page.until(
                lambda t=time: page.pictures[-1][0]["time"] == t and page.pictures[-1][0]["final"]
            )
            pictures.append(page.final()[1])
        a, second, third = (image.astype(int) for image in pictures)
        assert np.abs(a - second).max() > 20 and np.abs(second - third).max() > 20
        for wrong in (3, 0.5, -1):
            count = len(page.of_type("refused"))
            page.send("change", state={"time": wrong})
            assert "one of 3 time points, 0 to 2" in page.next("refused", count)["text"]
        assert session.state.time == 2
        session.ask(lambda: session.state.save(tmp_path / "view.json"))
    finally:
        session.close()
    run = gvtorch(
        *("render", beat, "-o", tmp_path / "a.png", "--size", "96x64"),
        *("--state", tmp_path / "view.json"),
    )
    assert run.returncode == 0, run.stderr
    seen = pixels((tmp_path / "a.png").read_bytes()).astype(int)
    assert np.abs(seen - third).mean() < 1 < np.abs(seen - second).mean()
    session = new_session(beat, state=tmp_path / "view.json")
    try:
        assert session.scene.time == 2 and session.scene.data.time == 2
    finally:
        session.close()


def test_a_time_point_that_can_not_be_read_is_told_and_the_one_before_stays(beat):
    session = new_session(beat, FUNCTION)
    try:
        page = Page(session, 96, 64)
        _, before = page.final()
        real, go = session.scene.reopen, threading.Event()

        def reopen(time: int):
            assert go.wait(TIMEOUT)
            if time == 1:
                raise OSError("the disk\nis gone")
            return real(time)

        session.scene.reopen = reopen
        page.send("change", state={"time": 1})
        _, still = page.moved(page.camera)  # pictures continue meanwhile
        assert np.array_equal(still, before)
        go.set()
        assert page.next("error", 0)["text"] == "time 1: the disk is gone"
        page.until(lambda: page.of_type("state")[-1]["state"]["time"] == 0)
        page.send("change", state={"time": 2})
        page.until(lambda: page.pictures[-1][0]["time"] == 2 and page.pictures[-1][0]["final"])
    finally:
        session.close()


def test_a_clock_of_a_producer_is_set():
    producer = gv.FieldProducer(Grown(), 32, box=((-10, -10, -10), (10, 10, 10)))
    session = new_session(producer, gv.TransferFunction([(0.4, 0), (0.6, 1)]))
    try:
        page = Page(session)
        _, before = page.final()
        assert page.of_type("welcome")[0]["time"] == {"times": None}
        assert page.of_type("welcome")[0]["state"]["time"] == 3.0
        page.send("change", state={"time": 8.0})
        page.until(lambda: page.pictures[-1][0]["time"] == 8 and page.pictures[-1][0]["final"])
        assert (page.final()[1] > 100).sum() > 3 * (before > 100).sum() > 0
    finally:
        session.close()
    session = new_session(bright_ball(), FUNCTION)
    try:
        page = Page(session)
        assert page.camera and page.of_type("welcome")[0]["time"] is None
        page.send("change", state={"time": 1})
        assert "nothing changes with time" in page.next("refused", 0)["text"]
    finally:
        session.close()


# Node boxes.


def test_node_boxes_are_the_nodes_whose_bricks_were_read(monkeypatch):
    tree = gv.N3Tree.from_volume(gv.Volume(noise((20, 24, 28, 1)), spacing=(1.0, 2.0, 1.5)))
    camera = gv.Camera.orbit(30, 20, width=64, height=48)
    gv.render(tree, camera, GRAY)
    eye = tuple((-camera.placed(tree.box).viewmats[0, :3, :3].mT
                 @ camera.placed(tree.box).viewmats[0, :3, 3]).tolist())  # fmt: skip
    answer = node_boxes(tree, eye)
    expected = set()
    for tile, child in itertools.product(*map(range, tree.nodes.brick_tn.shape)):
        brick = int(tree.nodes.brick_tn[tile, child])
        if brick >= 0 and int(tree.bricks.stamp_b[brick]) == tree.frame:
            node = torch.tensor([tile * tree.nodes.nodes_per_tile + child])
            expected.add(tuple(tree.loc(node)[0].tolist()))
    assert set(map(tuple, answer["boxes"])) == expected and answer["count"] == len(expected) > 10
    low, size = np.array(answer["low"]), np.array(answer["size"])
    far = [
        np.linalg.norm(low + (np.array(loc[:3]) + 0.5) / 2 ** loc[3] * size - eye)
        for loc in answer["boxes"]
    ]
    assert far == sorted(far)
    monkeypatch.setattr(scene, "_MAX_BOXES", 5)
    few = node_boxes(tree, eye)
    assert few["boxes"] == answer["boxes"][:5] and few["count"] == answer["count"]
    x, y, z, depth = answer["boxes"][0]
    share = 2.0**-depth
    low = np.add(answer["low"], np.multiply((x, y, z), share) * answer["size"])
    assert (low >= tree.box[0].numpy() - 1e-9).all() and (low < tree.box[1].numpy()).all()


def test_node_boxes_come_with_each_picture_as_long_as_they_are_wanted(session):
    page = Page(session)
    page.final()
    page.send("nodes", on=True)
    answer = page.next("nodes", 0)
    assert 0 < len(answer["boxes"]) <= answer["count"]
    count = len(page.of_type("nodes"))
    page.moved(turned_camera(page.camera, 1.0))
    assert len(page.of_type("nodes")) > count
    page.send("nodes", on=False)
    session.ask(lambda: None)
    count = len(page.of_type("nodes"))
    page.moved(page.camera)
    assert len(page.of_type("nodes")) == count


# Labels, and files of presets.


def test_the_table_of_labels_changes_colours_and_what_is_shown():
    data = cells((16, 16, 16), 6, seed=1, dtype=np.uint8)
    session = new_session(gv.Volume(data, labels=True))
    try:
        page = Page(session)
        page.final()
        labels = page.of_type("welcome")[0]["labels"]
        assert labels["names"] == [0, 1, 2, 3, 4, 5] and labels["count"] == 6
        assert np.allclose(labels["colors"], gv.Labels()(np.arange(6))[:, :3], atol=1e-4)
        shader = {**page.of_type("welcome")[0]["state"]["shader"], "lit": False}
        shader |= {"visible": [2], "colors": {"2": [1.0, 0.0, 0.0]}}
        page.send("change", state={"shader": shader})
        page.until(lambda: page.of_type("state"))
        page.until(lambda: page.pictures[-1][0]["final"])
        _, seen = page.moved(turned_camera(page.camera, 0.2))
        assert seen[..., 0].max() > 200 and seen[..., 1:].max() < 60
        assert session.state.shader.visible == [2]
        for wrong in ({"visible": ["two"]}, {"colors": {"two": [1, 0, 0]}}, {"visible": [0.5]}):
            count = len(page.of_type("refused"))
            page.send("change", state={"shader": {**shader, **wrong}})
            assert "\n" not in page.next("refused", count)["text"]
    finally:
        session.close()


def test_labels_called_with_numbers_give_the_colours_of_the_table():
    shader = gv.Labels({3: (1.0, 0.0, 0.0), 9: (0.25, 0.5, 1.0)}, opacity={9: 0.5}, visible=[3, 9])
    colors = shader(np.array([[3, 9], [4, 0]]))
    assert colors.shape == (2, 2, 4)
    assert colors[0].tolist() == [[1, 0, 0, 1], [0.25, 0.5, 1, 0.5]]
    assert (colors[1, :, 3] == 0).all() and (colors[1, 0, :3] > 0).any()


def test_files_of_other_programs_are_read(session):
    page = Page(session)
    page.final()
    presets = json.loads((ROOT / "tests" / "paraview_presets.json").read_text())
    page.send("read", file="p.json", text=json.dumps(presets[:1]), low=10.0, high=90.0)
    preset = page.next("preset", 0)
    opacity = np.array(preset["function"]["opacity"])
    assert (opacity[0, 0], opacity[-1, 0]) == (10, 90) and preset["name"] == "p.json"
    own_function = {"opacity": [[0, 0], [9, 1]], "color": [[0, 1, 0, 0]]}
    page.send("read", file="mine.JSON", text=json.dumps(own_function), low=10.0, high=90.0)
    assert page.next("preset", 1)["function"]["opacity"] == own_function["opacity"]
    attributes = 'scalarOpacity="4 0 0 9 1" colorTransfer="8 0 1 0 0 9 0 0 1" shade="1"'
    both = "".join(f'<VolumeProperty name="{name}" {attributes}/>' for name in ("A", "B"))
    page.send("read", file="presets.xml", text=f"<MRML>{both}</MRML>", name="B")
    preset = page.next("preset", 2)
    assert preset["name"] == "B" and preset["function"]["opacity"][-1] == [9, 1]
    assert preset["lost"] == ["presets.xml: not kept: shading, which --shader lit has (gv.Lit)"]


def test_colours_are_saved_for_paraview(session):
    page = Page(session)
    page.final()
    page.send("export", name="Two colours")
    page.until(lambda: page.files)
    (item,) = json.loads(page.files["paraview.json"])
    assert item["Name"] == "Two colours" and item["ColorSpace"] == "RGB"
    assert item["Points"] == [20, 0, 0.5, 0, 200, 0.6, 0.5, 0]
    page.send("change", state={"shader": {"kind": "DistanceField"}})
    page.send("export")
    assert "no transfer function" in page.next("refused", 0)["text"]


@pytest.fixture(scope="module")
def refusing_page():
    """A page of one view for all presets that are none."""
    opened = new_session(bright_ball(), FUNCTION, engine={"time_budget": None})
    page = Page(opened)
    page.final()
    yield page
    opened.close()


BOMB = "<!DOCTYPE a [" + "".join(
    f'<!ENTITY e{n} "{f"&e{n - 1};" * 20 if n else "x" * 20}">' for n in range(12)
)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("a.exe", "", "must end in .vp.json, .json"),
        ("../../a", "", "must end in"),
        ("a.json", "{", "a.json"),
        ("a.json", "[]", "a.json: "),
        ("a.json", '{"opacity": [[1, 0], [0, 1]]}', "a.json: "),
        ("a.vp", "1\n2", "a .vp file has 9 lines"),
        ("a.xml", "<MRML/>", "a.xml"),
        ("a.xml", "<MRML", "a.xml"),
        ("a.xml", BOMB + "]><MRML>&e11;</MRML>", "a.xml"),
        ("a.vp.json", '{"volumeProperties": []}', "a.vp.json"),
    ],
)
def test_what_is_no_preset_is_refused_in_a_line(refusing_page, file, text, message):
    page = refusing_page
    count = len(page.of_type("refused"))
    page.send("read", file=file, text=text)
    line = page.next("refused", count)["text"]
    assert message in line and "\n" not in line and "/tmp" not in line and len(line) < 600
    page.moved(turned_camera(page.camera, 0.1 * (count + 1)))


@pytest.mark.parametrize("name", ["mr", "em", "cloud", "galaxy"])
def test_named_presets_show_what_they_are_for(name):
    function = gv.TransferFunction.preset(name, 0, 100)
    alpha = function(np.linspace(0, 100, 101))[:, 3]
    rising = np.diff(alpha) >= 0
    assert (~rising[np.diff(alpha) != 0]).all() if name == "em" else rising.all()
    assert alpha.max() >= 0.5 and alpha.min() == 0
    tree = gv.N3Tree.from_volume(bright_ball(16))
    picture = gv.render(
        tree, gv.Camera.orbit(width=16, height=16), gv.TransferFunction.preset(name, 0, 255)
    )
    assert picture.color.std() > 0.02


@pytest.mark.parametrize("kind", ["producer", "stored", "store"])
def test_producers_that_hold_voxels_have_slices(kind, scan_store, tmp_path):
    """For a store, `gvtorch render --state` also equals the page's still."""
    volume = bright_ball()
    subject = {
        "producer": lambda: gv.VolumeProducer(volume),
        "stored": lambda: gv.StoredProducer(scan_store),
        "store": lambda: str(scan_store),
    }[kind]()
    state = gv.ViewState(shader=GRAY, slices=Slices(), develop=Development(samples=1))
    session = new_session(subject, state=state)
    try:
        still = session.ask(lambda: session.still(session.state.camera, 160, 120), 120)
        parts = panes(160, 120)
        image = still.to_srgb8().numpy()
        assert all(cut_out(image, list(parts[name])).std() > 2 for name in ("x", "y", "z", "view"))
        session.state.save(tmp_path / "view.json")
    finally:
        session.close()
    if kind == "store":
        run = gvtorch(
            *("render", scan_store, "-o", tmp_path / "a.png", "--size", "160x120"),
            *("--state", tmp_path / "view.json"),
        )
        assert run.returncode == 0, run.stderr
        assert np.array_equal(pixels((tmp_path / "a.png").read_bytes()), image)
