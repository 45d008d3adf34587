"""`CompiledShader`: a user's C++ equals the built-in shaders, its library is cached by content, and
its mistakes are shown in the compiler's words.
"""

from __future__ import annotations

import io
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import DEVICES
from helpers.compiled import ADD, HEADER, only_included, quick_compiler, users_shader, write_header
from helpers.packets import result, start
from helpers.pictures import assert_close_picture
from helpers.rays import camera_rays, world_rays
from helpers.shaders import POINT
from helpers.traces import SHADER, op_arguments, trace
from helpers.trees import copy_to, with_holes

import gvtorch as gv
from gvtorch.cpp_ext import compilers, instructions, user

BANDS = {"density": 0.4, "width": 3.0, "fade": 0.005}
CAMERA = gv.Camera.orbit(30, 20, 1.3, width=24, height=24)
FORM = "a shader has GV_HD void add(const gv::Interval<T>&, const gv::Probe<T>&, Sum&)"
NOWHERE = "  static float nowhere(T);" + ADD.replace("COLOR", "T(nowhere(1))")


@pytest.fixture(scope="module")
def channels(blobs) -> dict[str, gv.Volume]:
    """The blobs, with a four-component colour and a normal in each voxel."""
    values = torch.rand(*blobs.data.shape[:3], 7, generator=torch.Generator().manual_seed(3))
    placement = blobs.spacing, blobs.origin
    normal = gv.Volume(2 * values[..., :3] - 1, *placement)
    return {"value": blobs, "normal": normal, "rgba": gv.Volume(values[..., 3:], *placement)}


@pytest.fixture(scope="module")
def tree(channels) -> gv.N3Tree:
    return gv.N3Tree.from_volume(channels, 4)


@pytest.fixture(autouse=True)
def no_optimising(monkeypatch, quick) -> None:
    """Compiles without optimisation; test_user_packets.py compares that with optimised code."""
    monkeypatch.setenv("CXX", quick)


def mine(name: str, **options) -> gv.CompiledShader:
    return users_shader(HEADER, f"mine::{name}", **options)


def assert_same(compiled: str, actual: dict, expected: dict, names) -> None:
    """Asserts equal bits on the CPU; on CUDA another kernel may round floats differently."""
    for name in names:
        if compiled == "cpp" or not expected[name].is_floating_point():
            assert torch.equal(actual[name], expected[name]), name
        else:
            tolerance = 1e-5 if expected[name].dtype == torch.float32 else 1e-12
            torch.testing.assert_close(actual[name], expected[name], rtol=tolerance, atol=tolerance)


FIELDS = ("color", "alpha", "depth", "samples", "missed")


# --- pictures


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lod", ["finest", "auto"])
def test_a_copy_of_the_transfer_function_has_the_same_bits(tree, compiled, lod, dtype):
    holes = with_holes(tree, 0.3, 1)
    for t in (tree, holes):
        rays = camera_rays(t, 16, distance=1.3)
        options = {"lod": lod, "dtype": dtype}
        expected, marks = trace(t, compiled, rays, SHADER, **options)
        actual, own_marks = trace(t, compiled, rays, mine("Plain", transfer=SHADER), **options)
        assert_same(compiled, actual, expected, FIELDS)
        assert_same(compiled, own_marks, marks, marks)
        assert bool(marks["request"].any()) == (t is holes)
        assert t is holes or expected["alpha"].max() > 0.9


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lights_normals_and_features_are_those_of_the_built_in(tree, compiled, dtype):
    light = {"normals": "normal", "light": POINT, "ambient": 0.3}
    rays = camera_rays(tree, 16)
    shader = mine("LitFeatures", transfer=SHADER, other="rgba", **light)
    actual, _ = trace(tree, compiled, rays, shader, dtype=dtype)
    lit, _ = trace(tree, compiled, rays, gv.Lit(SHADER, **light), dtype=dtype)
    assert_same(compiled, actual, lit, (*FIELDS, "normal"))
    assert lit["alpha"].max() > 0.9 and lit["normal"].norm(dim=1).max() > 0.99
    features, _ = trace(tree, compiled, rays, gv.Features(SHADER, "rgba"), dtype=dtype)
    assert actual["features"].shape[1] == 4
    assert_same(compiled, actual, features, ("features",))


def test_sums_of_ones_own_and_hiding(tree, compiled):
    rays = camera_rays(tree, 16)
    actual, marks = trace(tree, compiled, rays, mine("Highest", transfer=SHADER))
    expected, own_marks = trace(tree, compiled, rays, gv.Projection("maximum", SHADER))
    assert expected["features"].max() > 0.9
    assert_same(compiled, actual, expected, (*FIELDS, "features"))
    assert all(torch.equal(mark, own_marks[name]) for name, mark in marks.items())


def test_ends_and_surfaces(tree, compiled):
    """Its depth is the end of the interval in which the built-in shader finds the crossing."""
    rays = camera_rays(tree, 24, distance=1.2)
    options = {"lod": "finest", "step": 0.5}
    actual, _ = trace(tree, compiled, rays, mine("FirstEnd", uniforms={"level": 0.5}), **options)
    surface, _ = trace(tree, compiled, rays, gv.Isosurface(0.5), **options)
    hit = torch.isfinite(surface["depth"])[:, 0]
    assert hit.sum() > 20 and torch.equal(torch.isfinite(actual["depth"])[:, 0], hit)
    behind = (actual["depth"] - surface["depth"])[hit]
    assert behind.min() > -1e-5 and 0.2 < behind.max() < 0.5 * min(tree.spacing) + 1e-5
    value = actual["color"][hit, 0]
    assert value.min() > 0.5 - 1e-6 and value.max() > 0.55, "read in the node of the place"
    assert (actual["normal"][hit] * surface["normal"][hit]).sum(1).mean() > 0.95


def bands_as_module(
    eye: torch.Tensor, density: float, width: float, fade: float
) -> gv.ModuleShader:
    """The same formulas in torch, by positions instead of distances."""

    def shade(values, positions, directions, lengths):
        light = torch.exp(-(positions - eye.to(positions)).norm(dim=1, keepdim=True) * fade)
        wave = 0.5 + 0.5 * torch.sin(positions[:, 2:] / width)
        color = torch.cat((light * wave, light * (1 - wave), 0.5 * light), 1)
        return color, 1 - torch.exp(-density * values.clamp(min=0) * lengths)

    return gv.ModuleShader(shade)


@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lod", ["finest", "auto"])
def test_a_shader_of_ones_own_equals_its_module_twin(blobs, compiled, lod, dtype):
    tree = gv.N3Tree.from_volume(blobs, 4, device=DEVICES[compiled])
    eye = CAMERA.placed(tree.box).rays().origin[0].to(tree.device)
    options = {"lod": lod, "dtype": dtype}
    picture = gv.render(tree, CAMERA, mine("Bands", uniforms=BANDS), **options)
    assert_close_picture(gv.render(tree, CAMERA, bands_as_module(eye, **BANDS), **options), picture)


def test_an_engine_streams_what_it_sees(channels):
    for shader in (mine("Bands", uniforms=BANDS), mine("Highest", transfer=SHADER)):
        resident = gv.render(gv.N3Tree.from_volume(channels, 8), CAMERA, shader)
        with gv.Engine(gv.VolumeProducer(channels), brick_size=8) as engine:
            _, first = engine.frame(CAMERA, shader)
            picture = engine.render(CAMERA, shader)
        assert first.requests and picture.stats.converged
        assert resident.alpha.max() > 0.3
        assert (picture.color - resident.color).abs().max() < 2e-3


def test_uniforms_are_edited_without_a_compiler(tree, compiled, monkeypatch):
    tree = copy_to(tree, DEVICES[compiled])
    width = torch.tensor(3.0, device=tree.device)
    shader = mine("Bands", uniforms={**BANDS, "width": width})
    whole = mine("Bands", uniforms=torch.tensor([0.4, 3.0, 0.005], device=tree.device))
    before = gv.render(tree, CAMERA, shader)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("a compiler was called"))
    assert torch.equal(gv.render(tree, CAMERA, whole).color, before.color)
    shader.uniforms["density"] = 0.1
    thin = gv.render(tree, CAMERA, shader)
    assert (before.alpha - thin.alpha).max() > 0.1
    width.fill_(9.0)
    assert (gv.render(tree, CAMERA, shader).color - thin.color).abs().max() > 0.05
    whole.uniforms[:] = torch.tensor([0.1, 9.0, 0.005])
    assert torch.equal(gv.render(tree, CAMERA, whole).color, gv.render(tree, CAMERA, shader).color)


@pytest.mark.backend("cpp")
def test_it_goes_through_lenses_clips_layers_and_scenes(blobs):
    tree = gv.N3Tree.from_volume(blobs, 4)
    plain = mine("Plain", transfer=SHADER)
    layer = gv.Layer(
        torch.full((24, 24, 3), 0.2), torch.full((24, 24, 1), 60.0), torch.full((24, 24, 1), 0.5)
    )
    for options in (
        {"lens": gv.ThinLens(aperture=0.1, focus=1.3, frame="box")},
        {"clip": gv.Clip(planes=[(0, 0, -1, 20)], caps=True)},
        {"layer": layer},
    ):
        expected = gv.render(tree, CAMERA, SHADER, **options)
        assert expected.alpha.max() > 0.3
        assert torch.equal(gv.render(tree, CAMERA, plain, **options).color, expected.color)
        with pytest.raises(ValueError, match="CompiledShader sees a ray in one go, so it has no"):
            gv.render(tree, CAMERA, mine("Highest", transfer=SHADER), **options)
    sun = gv.Lighting(occlusion=0.5, indirect=0.5)
    lit = mine("LitFeatures", transfer=SHADER, other="value")
    bright, dark = (
        gv.render(tree, CAMERA, gv.Lit(SHADER), lighting=light).color for light in (None, sun)
    )
    assert (bright - dark).abs().max() > 0.1
    assert torch.equal(gv.render(tree, CAMERA, lit, lighting=sun).color, dark)
    far = gv.Volume(blobs.data, blobs.spacing, (105.0, -3.0, 2.0))
    scene = {"a": gv.VolumeProducer(blobs), "b": gv.VolumeProducer(far)}
    with gv.Engine(scene, brick_size=4, node_pool="1 MB", brick_pool="4 MB") as engine:
        both = engine.render(CAMERA, {"a": SHADER, "b": SHADER})
        mixed = engine.render(CAMERA, {"a": plain, "b": SHADER})
    assert torch.equal(mixed.color, both.color) and both.alpha.max() > 0.3


# --- the op's contract


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["Bands", "LitFeatures"])
def test_script_compile_export_and_pickle(tree, compiled, name):
    torch._dynamo.reset()
    tree = copy_to(tree, DEVICES[compiled])
    options = {"uniforms": BANDS} if name == "Bands" else {"transfer": SHADER, "other": "rgba"}
    tracer, rays = gv.TreeTracer(tree, mine(name, **options)), world_rays(tree.box, 33, tree.device)
    expected = tracer.hits(*rays)
    file = io.BytesIO()
    torch.jit.save(torch.jit.script(tracer), file)
    file.seek(0)
    program = torch.export.export(tracer, rays).module()
    fast = torch.compile(tracer.hits, fullgraph=True, backend="aot_eager")
    copy = pickle.loads(pickle.dumps(tracer))
    for hits in (torch.jit.load(file).hits(*rays), fast(*rays), copy.hits(*rays), program(*rays)):
        assert expected[1].max() > 0.1
        assert all(torch.equal(a, b) for a, b in zip(hits, expected, strict=False))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["Bands", "LitFeatures"])
def test_opcheck_and_memory_safety(tree, compiled, name, dtype):
    tree = copy_to(tree, DEVICES[compiled])
    options = {"uniforms": BANDS} if name == "Bands" else {"transfer": SHADER, "other": "rgba"}
    shader = mine(name, **options)
    rays, traced, shading, parameters = op_arguments(tree, shader, dtype)
    op = getattr(torch.ops.gvtorch_user, shader.op).default
    torch.library.opcheck(op, (*rays, *traced, *shading, parameters))
    short = parameters[: 19 if name == "LitFeatures" else -1].contiguous()
    for wrong, numbers in (
        (shading._replace(features=3), parameters),
        (shading._replace(shader=1), parameters),
        (shading, short),
    ):
        with pytest.raises(RuntimeError, match="gvtorch"):
            op(*rays, *traced, *wrong, numbers)


# --- the compiler and the cache


def made(header: Path) -> Path:
    """Returns the library, cached or new; with a compiler that only preprocesses, a text file."""
    return user.compiled(user.ShaderSource.read(header, "Own"), ())


def built(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.glob("shaders/*"))


def red(shader: gv.CompiledShader) -> float:
    """Returns the red that it draws for a block of ones."""
    tree = gv.N3Tree.from_volume(gv.Volume(torch.ones(8, 8, 8)), 8)
    return float(gv.render(tree, gv.Camera.orbit(width=1, height=1), shader).color[0, 0, 0])


def red_of_given() -> float:
    """Returns the red that `Own` draws, of the header or the pickle that the environment names."""
    given = Path(os.environ["GIVEN"])
    pickled = given.suffix == ".pkl"
    return red(pickle.loads(given.read_bytes()) if pickled else gv.CompiledShader(given, "Own"))


def in_processes(folder: Path, count: int, given: Path) -> list[float]:
    """Returns what `red_of_given` returns in several processes at once."""
    folders = [Path(tempfile.mkdtemp(dir=folder)) for _ in range(count)]
    runs = [start(red_of_given, one, instructions(), GIVEN=str(given)) for one in folders]
    return [result(run) for run in runs]


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_a_library_is_kept_by_content_and_two_processes_may_make_it(tmp_path, monkeypatch, quick):
    """The compiler counts its calls: two processes at once make one library, a third makes none;
    changes of the meaning make another one.
    """
    count = tmp_path / "calls"
    compiler = quick_compiler(tmp_path, f"echo call >> {count}", compiler=quick)
    (tmp_path / "color.h").write_text("constexpr float kColor = 0.25f;\n")
    body = '  // #include "none.h"\n' + ADD.replace("COLOR", "kColor")
    header = write_header(tmp_path, body)
    header.write_text('#include "color.h"\n' + header.read_text())
    environment = {"GVTORCH_CACHE": str(tmp_path / "cache"), "CXX": compiler}
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert in_processes(tmp_path, 2, header) == [0.25, 0.25]
    calls = count.read_text()
    assert 1 <= calls.count("call") <= 2
    first = built(tmp_path / "cache")
    assert len(first) == 1 and first[0].endswith(".so"), "nothing half-written is left"
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for file in (header, tmp_path / "color.h"):
        shutil.copy(file, moved)
    assert red(gv.CompiledShader(moved / "own.h", "Own")) == 0.25
    assert count.read_text() == calls, "the same content is the same library"
    (tmp_path / "color.h").write_text("constexpr float kColor = 0.75f;\n")
    assert red(gv.CompiledShader(header, "Own")) == 0.75, "two structs of one name, in one process"
    assert len(built(tmp_path / "cache")) == 2


@pytest.mark.parametrize(
    ("body", "name", "message"),
    [
        (ADD.replace("COLOR", "colour"), "Own", r"own.h:8:\d+: error: 'colour' was not declared"),
        ("", "Own", FORM),
        (ADD, "Mine", "'Mine' does not name a type"),
        (NOWHERE, "Own", r"undefined reference to ['`]Own<double>::nowhere\(double\)'"),
    ],
    ids=["a mistake", "no add", "no such struct", "no such function"],
)
@pytest.mark.backend("cpp")
def test_the_compilers_words_are_shown_as_they_are(tmp_path, monkeypatch, body, name, message):
    cache_folder, header = tmp_path / "cache", write_header(tmp_path, body)
    monkeypatch.setenv("GVTORCH_CACHE", str(cache_folder))
    with pytest.raises(gv.CompileError) as caught:
        gv.CompiledShader(header, name)
    first, *rest = str(caught.value).splitlines()
    assert first.startswith(f"{header}: {name} did not compile for the CPU with: ")
    assert compilers.find_cxx()[0] in first and "-ffp-contract=off" in first
    text = "\n".join(rest).replace("\u2018", "'").replace("\u2019", "'")
    assert re.search(message if "\\" in message else re.escape(message), text), text
    assert not built(cache_folder), "nothing of it is kept"


@pytest.mark.backend("cpp")
def test_without_a_compiler_or_a_folder_there_is_one_clear_line(tmp_path, monkeypatch):
    header = write_header(tmp_path, ADD.replace("COLOR", "1"))
    with monkeypatch.context() as patch:
        patch.setenv("CXX", "no-such-compiler -O1")
        with pytest.raises(RuntimeError) as caught:
            gv.CompiledShader(header, "Own")
    assert str(caught.value) == (
        "CompiledShader: no compiler 'no-such-compiler' to compile own.h for the CPU with; "
        "CXX names another"
    )
    monkeypatch.setenv("GVTORCH_CACHE", str(header))
    with pytest.raises(RuntimeError, match=r"own.h.*; GVTORCH_CACHE names another") as caught:
        gv.CompiledShader(header, "Own")
    assert "\n" not in str(caught.value)


@pytest.mark.backend("cpp")
def test_mistakes_have_one_clear_message(tree, tmp_path):
    for make, message in (
        (lambda: gv.CompiledShader(tmp_path / "a.h", "A"), "there is no header"),
        (lambda: gv.CompiledShader(None, "A"), "header must be a path, got None"),
        (lambda: gv.CompiledShader("a\0.h", "A"), r"header must be a path, got 'a\x00.h'"),
        (lambda: gv.CompiledShader(user.SOURCES / "user_shader.h", "A"), "has the name of the hea"),
        (lambda: gv.CompiledShader(sys.executable, "A"), "is not a text file"),
        (lambda: gv.CompiledShader(HEADER, "A" * 129), "of at most 128 letters, got 'AAA"),
        (
            lambda: gv.CompiledShader(HEADER, "mine::Bands; int x"),
            "name must be that of a C++ struct",
        ),
        (lambda: gv.CompiledShader(HEADER, 3), "C++ struct, of at most 128 letters, got 3"),
        (lambda: mine("Bands"), "uniforms must be density, width, fade, got none"),
        (lambda: mine("Bands", uniforms={**BANDS, "x": 1}), "got density, width, fade, x"),
        (
            lambda: mine("Bands", uniforms={**BANDS, "fade": float("nan")}),
            "uniform fade must be fin",
        ),
        (
            lambda: mine("Bands", uniforms={**BANDS, "fade": torch.ones(2)}),
            "fade must be one number",
        ),
        (lambda: mine("Bands", uniforms=torch.ones(2)), "uniforms must be (3,)"),
        (lambda: mine("Bands", uniforms=[1, 2, 3]), "must be a dict or a tensor, got [1, 2, 3]"),
        (lambda: mine("Bands", uniforms=torch.ones(3) * 1j), "must be real, got (3,) complex64"),
        (
            lambda: mine("Bands", uniforms={**BANDS, "fade": torch.tensor(1j)}),
            "uniform fade must be real",
        ),
        (
            lambda: gv.render(tree, CAMERA, mine("Bands", uniforms={**BANDS, "fade": 1e40})),
            "shader: 1e+40 is beyond what torch.float32 holds",
        ),
        (lambda: mine("Plain", uniforms={"a": 1}), "uniforms must be a (k,) tensor, got a"),
        (lambda: mine("Plain", transfer="bone"), "transfer must be a TransferFunction, got str"),
        (lambda: mine("Plain", light=3), "light must be a Headlight"),
        (lambda: gv.render(tree, CAMERA, mine("Plain", channel="heat")), "unknown channel 'heat'"),
        (
            lambda: gv.render(tree, CAMERA, mine("LitFeatures")),
            "those of a second channel: name other",
        ),
        (lambda: gv.render(tree, CAMERA, mine("Plain"), backend="reference"), "no reference"),
    ):
        with pytest.raises(ValueError) as caught:
            make()
        assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.backend("cpp")
def test_a_damaged_library_is_compiled_again(tmp_path, monkeypatch):
    """The file is cut to nothing, to half (which crashes the loader), and by its last byte; the
    compiler copies a library that was made once.
    """
    content = user.compiled(user.ShaderSource.read(HEADER, "mine::Plain"), ()).read_bytes()[:-32]
    (tmp_path / "made.so").write_bytes(content)
    compiler = tmp_path / "c++"
    compiler.write_text(f"#!/bin/sh\ncp {tmp_path}/made.so shader.so\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))
    source = user.ShaderSource.read(write_header(tmp_path, ADD.replace("COLOR", "0.5")), "Own")
    library = user.compiled(source, ())
    whole = library.read_bytes()
    assert whole[:-32] == content and whole.startswith(b"\x7fELF")
    for left in (0, len(whole) // 2, -1):
        library.write_bytes(whole[:left])
        assert user.compiled(source, ()) == library and library.read_bytes() == whole


@pytest.mark.backend("cpp")
def test_only_its_owner_writes_to_the_folder_of_libraries(tmp_path, monkeypatch):
    header, folder = (
        write_header(tmp_path, ADD.replace("COLOR", "0.5")),
        tmp_path / "cache" / "shaders",
    )
    monkeypatch.setenv("GVTORCH_CACHE", str(folder.parent))
    monkeypatch.setenv("CXX", only_included(tmp_path))
    old = os.umask(0)
    try:
        library = made(header)
    finally:
        os.umask(old)
    assert [*folder.iterdir()] == [library]
    assert folder.stat().st_mode & 0o777 == 0o700 and library.stat().st_mode & 0o022 == 0
    for mode in (0o770, 0o707):
        folder.chmod(mode)
        with pytest.raises(RuntimeError, match=r"others may write to .*shaders; GVTORCH_CACHE"):
            gv.CompiledShader(header, "Own")
    folder.chmod(0o700)
    if os.geteuid() == 0:
        os.chown(folder, 1, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(RuntimeError, match=r"shaders is another user's; GVTORCH_CACHE"):
        gv.CompiledShader(header, "Own")


@pytest.mark.backend("cpp")
def test_what_the_loader_refuses_is_told_in_its_words(tmp_path, monkeypatch):
    """The compiler writes no library; a folder mounted noexec has the same effect."""
    header, compiler = write_header(tmp_path, ADD.replace("COLOR", "0.5")), tmp_path / "c++"
    compiler.write_text(
        '#!/bin/sh\nfor word; do case $word in *.so) echo no > "$word"; esac; done\n'
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(RuntimeError, match=r"^CompiledShader: .*Own_.*\.so: file too short$"):
        gv.CompiledShader(header, "Own")


@pytest.mark.backend("cpp")
def test_a_header_that_changes_meanwhile_is_not_kept(tmp_path, monkeypatch):
    """Otherwise its last content would be found under its first."""
    header = write_header(tmp_path, ADD.replace("COLOR", "0.5"))
    monkeypatch.setenv("CXX", only_included(tmp_path, f"echo '// more' >> {header}"))
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))
    with pytest.raises(RuntimeError, match=r"own.h has changed: create the shader again"):
        gv.CompiledShader(header, "Own")
    assert built(tmp_path / "cache") == []


@pytest.mark.backend("cpp")
def test_folders_of_headers_that_the_environment_names_count(tmp_path, monkeypatch):
    header = write_header(tmp_path, ADD.replace("COLOR", "kColor"))
    header.write_text("#include <color.h>\n" + header.read_text())
    monkeypatch.setenv("CXX", only_included(tmp_path))
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))
    for color in ("0.25", "0.75"):
        folder = tmp_path / color
        folder.mkdir()
        (folder / "color.h").write_text(f"constexpr float kColor = {color}f;\n")
        monkeypatch.setenv("CPATH", str(folder))
        assert f"kColor = {color}f;" in made(header).read_text(errors="replace")


@pytest.mark.backend("cpp")
def test_what_is_included_otherwise_counts_as_well(tmp_path, monkeypatch):
    """Included by a macro, over two lines, or in brackets: no stale library is used."""
    header = write_header(tmp_path, ADD.replace("COLOR", "kA + kB + kC"))
    includes = '#define FILE_A "a.h"\n#include FILE_A\n#include \\\n"b.h"\n#include <c.h>\n'
    header.write_text(includes + header.read_text())
    (tmp_path / "found").mkdir()
    folders = {"a": tmp_path, "b": tmp_path, "c": tmp_path / "found"}
    values = dict.fromkeys("abc", 0.125)
    monkeypatch.setenv("CPATH", str(tmp_path / "found"))
    monkeypatch.setenv("CXX", only_included(tmp_path))
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))
    for changed in ("", "a", "c"):
        values |= {changed: 0.25} if changed else {}
        for name, value in values.items():
            text = f"constexpr float k{name.upper()} = {value}f;\n"
            (folders[name] / f"{name}.h").write_text(text)
        compiled_text = made(header).read_text(errors="replace")
        for name, value in values.items():
            assert f"k{name.upper()} = {value}f;" in compiled_text, (changed, name)


@pytest.mark.backend("cpp")
def test_what_another_process_has_noted_meanwhile_is_no_change(tmp_path, monkeypatch):
    """Two compile at once: one has noted an included file before the other has finished."""
    header = write_header(tmp_path, ADD)
    part = tmp_path / "part.h"
    part.write_text("")
    monkeypatch.setenv("GVTORCH_CACHE", str(tmp_path / "cache"))
    before = user.ShaderSource.read(header, "Own")
    compiler = tmp_path / "c++"
    note = f"echo '[\"{part}\"]' > {before.list_path}\necho > shader.so"
    compiler.write_text(f"#!/bin/sh\n{note}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    library = user.compiled(before, ())
    after = user.ShaderSource.read(header, "Own")
    assert after.op != before.op and after.op in library.name
    assert before.op in user.compiled(before, (), before.op).name, "one that is loaded keeps its op"
    part.write_text("int changed;")
    assert before.unchanged(), "which knew nothing of it"
    with pytest.raises(RuntimeError, match=r"own.h has changed: create the shader again"):
        after.unchanged()


@pytest.mark.backend("cpp")
def test_no_name_of_a_user_comes_to_a_shell(tmp_path, monkeypatch):
    """nvcc passes its arguments to a shell; the compiler of this test does so, too."""
    real, compiler = shutil.which(compilers.find_cxx()[0]), tmp_path / "c++"
    compiler.write_text(f'#!/bin/sh\neval "{real} $* -E"\n')
    compiler.chmod(0o755)
    folder = tmp_path / "a b;touch $(touch beside)`touch beside`"
    folder.mkdir()
    (folder / "color.h").write_text("constexpr float kColor = 0.5f;\n")
    header = write_header(folder, ADD.replace("COLOR", "kColor"), "own $(touch here);'\".h")
    header.write_text('#include "color.h"\n' + header.read_text())
    monkeypatch.setenv("CXX", str(compiler))
    monkeypatch.setenv("GVTORCH_CACHE", str(folder / "cache"))
    monkeypatch.chdir(tmp_path)
    assert "kColor = 0.5f;" in made(header).read_text(errors="replace")
    assert not [file for file in tmp_path.rglob("*") if file.name in ("beside", "here")]


@pytest.mark.backend("cpp")
def test_folders_above_and_libraries_are_looked_at(tmp_path, monkeypatch):
    header = write_header(tmp_path, ADD.replace("COLOR", "0.5"))
    cache = tmp_path / "above" / "cache"
    monkeypatch.setenv("GVTORCH_CACHE", str(cache))
    monkeypatch.setenv("CXX", only_included(tmp_path))
    left = cache / "shaders" / "draft-killed"
    left.mkdir(parents=True)
    os.utime(left, (1, 1))
    library = made(header)
    assert not left.exists(), "what a killed compilation left is gone"
    assert [*(cache / "shaders").iterdir()] == [library]
    for path in (library, cache.parent):
        mode = path.stat().st_mode
        path.chmod(0o777)
        with pytest.raises(RuntimeError, match=rf"others may write to {path}; GVTORCH_CACHE"):
            gv.CompiledShader(header, "Own")
        path.chmod(mode)


@pytest.mark.backend("cpp")
def test_it_is_unpickled_in_another_process(tmp_path):
    shader = gv.CompiledShader(write_header(tmp_path, ADD.replace("COLOR", "0.5")), "Own")
    kept, tracer = tmp_path / "shader.pkl", tmp_path / "tracer.pkl"
    kept.write_bytes(pickle.dumps(shader))
    assert in_processes(tmp_path, 1, kept) == [0.5]
    tree = gv.N3Tree.from_volume(gv.Volume(torch.ones(8, 8, 8)), 8)
    unknown = "x" * len(shader.op)  # a name that no library here has
    pickled = pickle.dumps(gv.TreeTracer(tree, shader))
    tracer.write_bytes(pickled.replace(shader.op.encode(), unknown.encode()))
    with pytest.raises(RuntimeError, match=r"TreeTracer: op x+ is not loaded: torch.ops.load_lib"):
        pickle.loads(tracer.read_bytes())


@pytest.mark.backend("cpp")
def test_cuda_gets_no_other_content_than_the_cpu_has(tmp_path):
    edited = replace(user.load_op(HEADER, "mine::Plain"), header=write_header(tmp_path, ADD))
    with pytest.raises(RuntimeError, match=r"own.h has changed: create the shader again"):
        user.load_cuda(edited)
