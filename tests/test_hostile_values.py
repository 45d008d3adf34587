"""Full disks, numbers beyond float's range, values at the ends of their types: one line each, and
nothing is lost.
"""

from __future__ import annotations

import ctypes
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import gvtorch
from helpers.pictures import GRAY

import gvtorch as gv
from gvtorch import bench
from gvtorch.base.digits import whole_number
from gvtorch.base.whole_file import save_npy
from gvtorch.bench import tables
from gvtorch.points.table import Table
from gvtorch.tools import cli
from gvtorch.tools.bench import Bench
from gvtorch.tools.common import parse_size
from gvtorch.tools.parse import parse_channels

HUGE = 10**400
VIEW = gv.Camera.orbit(width=8, height=8)
KINDS = ("png", "exr", "npz", "npy", "tif")


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """Limits the size of files: writing beyond it fails as on a full disk, in any library. Modules
    imported meanwhile are not kept as bytecode: Python 3.11 would keep the part that it can write.
    """
    before, kept = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = kept


@pytest.fixture(scope="module")
def picture() -> gv.Picture:
    tree = gv.N3Tree.from_volume(gv.Volume(torch.rand(8, 8, 8)))
    rendered = gv.render(tree, gv.Camera.orbit(width=100, height=80), GRAY)
    noise = torch.rand(rendered.color.shape, generator=torch.Generator().manual_seed(0))
    return replace(rendered, color=noise)


@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_is_told_and_the_old_picture_stays(tmp_path, picture, kind):
    file = tmp_path / f"a.{kind}"
    file.write_bytes(b"old")
    with full_disk(2000), pytest.raises(OSError, match=r"a\.\w+") as caught:
        picture.save(file)
    assert "\n" not in str(caught.value)
    assert file.read_bytes() == b"old" and [*tmp_path.iterdir()] == [file]
    picture.save(file)
    assert file.stat().st_size > 2000


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_the_command_line_tells_of_a_full_disk_in_a_line(tmp_path, small, kind):
    with full_disk(500):
        run = gvtorch("render", small, "-o", tmp_path / f"a.{kind}", "--size", "64x64")
    assert run.returncode == 2, run.stderr
    assert run.stderr.startswith("gvtorch: error: ") and run.stderr.count("\n") == 1, run.stderr
    assert not [*tmp_path.iterdir()]


ENDS = {
    "half": np.array([-65504, 65504, 0, 1], np.float16),
    "single": np.array([-3.4028235e38, 3.4028235e38, 0, 1], np.float32),
    "constant": np.full(4, 3.4028235e38, np.float32),
    "denormal": np.array([0, 1e-45], np.float32),
    "neighbours": np.array([1, 1.001], np.float16),
    "zero": np.zeros(4, np.float16),
    "bytes": np.full(4, 7, np.uint8),
    "label": np.full(4, 70_000, np.int64),
}


@pytest.mark.parametrize("name", ENDS)
def test_info_of_values_at_the_ends(tmp_path, name):
    values = np.zeros((len(ENDS[name]), 2, 3), ENDS[name].dtype)
    values[:] = ENDS[name][:, None, None]
    np.save(tmp_path / "a.npy", values)
    for flags in ((), ("--json",)):
        run = gvtorch("info", tmp_path / "a.npy", *flags)
        assert run.returncode == 0 and "range" in run.stdout, run.stderr


def test_bars_of_any_counts():
    for counts in ([0, 0], [0, 1], [1], [2**62, 1], [3, 6, 2**53 + 1]):
        assert cli._sparkline(counts)


NUMBERS = {
    "camera": lambda: gv.Camera.orbit(HUGE),
    "function": lambda: gv.TransferFunction.from_points([(0, 0), (HUGE, 1)]),
    "spacing": lambda: gv.Volume(torch.zeros(4, 4, 4), spacing=(HUGE, 1, 1)),
    "ratio": lambda: gv.Volume(torch.zeros(4, 4, 4), spacing=(1e300, 1e-300, 1)),
    "denormal": lambda: gv.Volume(torch.zeros(4, 4, 4), spacing=(5e-324, 1, 1)),
    "light": lambda: gv.Headlight((HUGE, 1, 1)),
    "one number": lambda: gv.Headlight(np.float32(1)),
    "several lights": lambda: gv.Lit(GRAY, light=np.array([1.0, 2.0])),
    "border": lambda: gv.BrickPool(1, {"value": gv.Channel()}, border=2**63 - 1),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_out_of_range_have_one_clear_line(name):
    with pytest.raises(ValueError, match=r"must|greater") as caught:
        NUMBERS[name]()
    assert "\n" not in str(caught.value) and "ambiguous" not in str(caught.value)


WRONG = (None, 3, "x", b"x", ["value"], {}, object(), torch.zeros(3), torch.tensor(0), np.zeros(3))
CALLS = {
    "slice": gv.slice_picture,
    "colors": lambda x: gv.slice_picture(_volume(), colors=x),
    "span": lambda x: gv.slice_picture(_volume(), span=x),
    "place": lambda x: gv.slice_picture(_volume(), position=x),
    "places": lambda x: gv.slice_picture(_volume(), position=(torch.zeros(3), x, x)),
    "window": gv.window,
    "percent": lambda x: gv.window(_volume(), x),
    "points": gv.sort_points,
    "info": lambda x: gv.Volume(torch.zeros(4, 4, 4), info=x),
    "preset": gv.TransferFunction.preset,
    "channels": lambda x: gv.Producer(4, channels=x),
    "voxels": lambda x: gv.N3Tree.from_volume(_volume()).bricks[x],
    "whole": lambda x: gv.Volume(torch.zeros(4, 4, 4)).describe(x),
}
FINE = {  # valid arguments of each
    **dict.fromkeys(("colors", "span", "percent", "info"), (type(None),)),
    "place": (int, torch.Tensor),
    "channels": (type(None), dict),
    "whole": (int,),
    "options": (type(None), str),
}
NAMED = {  # and None: the first channel
    "options": lambda x: gv.RenderOptions(channel=x),
    "shader": lambda x: gv.render(_tree(), VIEW, gv.Channels([gv.ChannelLook()], channel=x)),
    "volume": lambda x: _tree().to_volume(x),
    "tracer": lambda x: gv.TreeTracer(_tree(), GRAY, channel=x),
    "surface": lambda x: gv.extract_surface(_tree(), 0.5, channel=x),
}


def _volume() -> gv.Volume:
    return gv.Volume(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)))


def _tree() -> gv.N3Tree:
    return gv.N3Tree.from_volume(_volume())


@pytest.mark.parametrize("name", [*CALLS, *NAMED])
def test_objects_of_a_wrong_class_have_one_clear_line(name):
    """Instead of an AttributeError at first use, or the "ambiguous" truth value of tensors."""
    call = {**CALLS, **NAMED}[name]
    for wrong in WRONG:
        if type(wrong) in FINE.get(name, (type(None),) if name in NAMED else ()):
            continue
        with pytest.raises(ValueError, match=r"must|channel|preset") as caught:
            call(wrong)
        text = str(caught.value)
        assert "\n" not in text and "ambiguous" not in text and len(text) < 700, text


def test_no_field_of_view_is_too_small_to_divide_by():
    for fov in (5e-324, 1e-300, 0, -1, np.nan):
        with pytest.raises(ValueError, match="fov must be"):
            gv.Camera.look_at((9, 9, 9), (0, 0, 0), fov=fov)
    assert gv.Camera.look_at((9, 9, 9), (0, 0, 0), fov=1e-12).Ks.isfinite().all()


@pytest.mark.parametrize("text", ["\u00b2", "\u0663", "9" * 5000, "+1", "1_0", ""])
def test_only_plain_digits_are_numbers_of_keys_and_flags(text):
    assert whole_number(text) is None
    assert whole_number("007") == 7
    for flag in (f"{text}x8", f"8x{text}"):
        with pytest.raises(ValueError, match="--size must be WIDTHxHEIGHT"):
            parse_size(flag)
    with pytest.raises(ValueError, match="--channel must hold NUMBER"):
        parse_channels(f"{text}:green", _volume())


def test_numbers_without_an_end_are_told():
    with pytest.raises(ValueError, match="must be an int >= 1, got a number of 16610 bits"):
        _volume().describe(10**5000)
    with pytest.raises(
        ValueError, match=r"must be three numbers, got 30000: \(0, 0.* \.\.\. .*0\)$"
    ):
        gv.Volume(torch.zeros(4, 4, 4), spacing=(0,) * 30_000)


@pytest.mark.parametrize("text", ["[" * 10**5, "1" * 5000, f'{{"opacity": [[{HUGE}, 0], [1, 1]]}}'])
def test_json_of_any_depth_and_length_is_told(tmp_path, small, text):
    file = tmp_path / "a.json"
    file.write_text(text)
    for command in (
        ("render", small, "--tf", file, "-o", tmp_path / "a.png"),
        ("fly", small, "--path", file, "-o", tmp_path / "a.mp4"),
    ):
        run = gvtorch(*command)
        assert run.returncode == 2 and "Traceback" not in run.stderr, run.stderr
        assert run.stderr.count("\n") == 1 and len(run.stderr) < 20_000, run.stderr


def test_a_damaged_directory_of_an_archive_is_told(tmp_path):
    file = tmp_path / "a.npz"
    np.savez_compressed(file, a=np.zeros((4, 4, 4), np.uint8))
    whole = file.read_bytes()
    begin = whole.index(b"PK\x01\x02")
    for seed in range(60):
        pick = np.random.default_rng(seed)
        broken = bytearray(whole)
        for _ in range(4):
            broken[pick.integers(begin, len(whole))] = pick.integers(256)
        file.write_bytes(broken)
        try:
            gv.read_volume(file)
        except (ValueError, OSError) as error:
            assert str(Path(file)) in str(error) and "\n" not in str(error)


def test_lights_take_arrays(picture):
    volume = gv.Volume(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)))
    expected, actual = (
        gv.render(volume, VIEW, gv.Lit(GRAY, light=gv.Headlight(color))).color
        for color in ((0.5, 0.25, 1.0), np.array([0.5, 0.25, 1.0]))
    )
    assert torch.equal(actual, expected)


ESCAPES = "\x1b]0;name\x07\x1b[2J\x9b31m\nline \\[bold] [red]"


def test_no_name_gives_commands_to_a_terminal(tmp_path, capfd):
    """Names of files and their contents are untrusted."""
    volume, store = tmp_path / f"{ESCAPES}.npy", tmp_path / f"{ESCAPES}.zarr"
    np.save(volume, np.arange(512, dtype=np.uint16).reshape(8, 8, 8))
    for name in ("a", ESCAPES):
        np.savez(tmp_path / "two.npz", **{"a": np.zeros((4, 4, 4)), name: np.ones((4, 4, 4))})
    cli.main(["info", str(volume)])
    cli.main(["convert", str(volume), str(store), "--workers", "1"])
    cli.main(["info", str(store)])
    cli.main(["render", str(store), "-o", str(tmp_path / f"{ESCAPES}.png"), "--size", "8x8"])
    for args in (["info", str(tmp_path / "two.npz")], ["render", str(volume), "--level", "1"]):
        with pytest.raises(SystemExit):
            cli.main([*args, "-o", "a.png"] if args[0] == "render" else args)
    output = "".join(capfd.readouterr())
    control_chars = [char for char in output if ord(char) < 32 or 127 <= ord(char) < 160]
    assert set(control_chars) == {"\n"}, output
    assert output.count("error: ") == 2 and output.splitlines()[-1].startswith("gvtorch: error: ")
    assert "[bold]" in output and "[red]" in output


def test_a_table_takes_what_looks_like_markup(capfd):
    cli._print_table({"channel info": {"0": "\\[/bold]", "1": "[/x]\x1b[2J"}, "name": "\\[/y]"})
    output = capfd.readouterr().out
    assert all(word in output for word in ("0: \\[/bold]", "1: [/x]\\x1b[2J", "\\[/y]"))


@pytest.mark.parametrize("kind", ["png", "npy", "mp4", "json", "ply"])
def test_no_link_that_was_planted_is_written_through(tmp_path, picture, monkeypatch, kind):
    """Neither at the guessed name of a temporary file, nor at the file itself."""
    victim, file = tmp_path / "victim", tmp_path / f"a.{kind}"
    victim.write_bytes(b"mine")

    def film() -> None:
        with gv.Video(file, 100, 80) as video:
            video.add(picture)

    write = {
        "mp4": film,
        "json": lambda: gv.TransferFunction.from_points([(0, 0), (1, 1)]).save(file),
        "ply": lambda: gv.export_surface(_volume(), 0.5, file),
    }.get(kind, lambda: picture.save(file))
    names = [tmp_path / f"tmpguessed.{kind}", file, file.with_name(f".{file.name}.draft")]
    for link in names:
        link.symlink_to(victim)
    monkeypatch.setattr(tempfile, "_name_sequence", iter(["guessed", *"abcdefgh"]))
    write()
    assert victim.read_bytes() == b"mine" and file.is_file() and not file.is_symlink()
    assert {path.name for path in tmp_path.iterdir()} == {"victim", *(x.name for x in names)}


def _as_anybody() -> None:
    """Drops the capabilities by which root may write into read-only folders."""
    for right in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        ctypes.CDLL(None).prctl(24, right, 0, 0, 0)  # PR_CAPBSET_DROP


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="rights of root are Linux's")
def test_a_folder_that_may_not_be_written_is_one_line_of_every_command(tmp_path, small):
    np.savez(tmp_path / "p.npz", positions=np.random.default_rng(1).random((50, 3)))
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    gvtorch("convert", small, tmp_path / "s.zarr")
    folder = tmp_path / "closed"
    folder.mkdir()
    shutil.copytree(tmp_path / "s.zarr", folder / "s.zarr")
    for path in (*folder.rglob("*"), folder):
        path.chmod(0o555 if path.is_dir() else 0o444)
    size = ("--size", "16x16")
    commands = [
        ("render", small, "-o", folder / "a.png", *size),
        ("slice", small, "-o", folder / "a.png"),
        ("fly", small, "-o", folder / "a", "--frames", "2", *size),
        ("fly", small, "-o", folder / "a.mp4", "--frames", "2", *size),
        ("surface", small, "--iso", "0.5", "-o", folder / "a.ply"),
        ("convert", small, folder / "a.zarr"),
        ("voxelize", tmp_path / "m.obj", "-o", folder / "a.zarr", "--resolution", "8"),
        ("splat", tmp_path / "p.npz", "-o", folder / "a.zarr", "--resolution", "8"),
        ("filter", folder / "s.zarr"),
    ]
    before = sorted(folder.rglob("*"))
    program = f"""
import contextlib, io, sys
from gvtorch.tools.cli import main
for words in {[[str(word) for word in command] for command in commands]!r}:
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            main(words)
        print(0)
    except SystemExit as end:
        print(end.code, said.getvalue().count("\\n"), said.getvalue().strip())
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                         preexec_fn=_as_anybody, timeout=300, check=False)  # fmt: skip
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    lines = run.stdout.splitlines()
    assert run.returncode == 0 and len(lines) == len(commands), run.stdout + run.stderr
    for command, line in zip(commands, lines, strict=True):
        prefix = "2 1 gvtorch: error: [Errno 13] Permission denied: "
        assert line.startswith(prefix) and str(folder) in line, (command, line)
    assert sorted(folder.rglob("*")) == before


def test_a_full_disk_leaves_saved_functions_as_they_were(tmp_path):
    file, function = tmp_path / "a.json", gv.TransferFunction.from_points([(0, 0), (1, 1)])
    function.save(file)
    before = file.read_bytes()
    longer = gv.TransferFunction.from_points([(n / 100, 0.5) for n in range(101)])
    with full_disk(len(before)), pytest.raises(OSError, match=r"a\.json"):
        longer.save(file)
    assert file.read_bytes() == before and [*tmp_path.iterdir()] == [file]


def test_a_full_disk_leaves_the_figures_of_a_flight_as_they_were(tmp_path, small):
    stats = tmp_path / "s.jsonl"
    stats.write_text("old")
    flags = ("--size", "8x8", "--frames", "2", "--stats", stats)
    with full_disk(600):
        run = gvtorch("fly", small, "-o", tmp_path / "f", *flags)
    assert run.returncode == 2 and run.stderr.count("\n") == 1 and "s.jsonl" in run.stderr
    assert stats.read_text() == "old" and {p.name for p in tmp_path.iterdir()} == {"s.jsonl", "f"}


@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_that_is_full_at_the_very_end_is_told(tmp_path, picture, kind):
    """The last bytes of a .npy were once lost silently, and the old picture with them."""
    file = tmp_path / f"a.{kind}"
    picture.save(file)
    whole = file.read_bytes()
    file.write_bytes(b"old")
    for missing in (1, 100, 1000, 4000, 5000):
        with full_disk(len(whole) - missing), pytest.raises(OSError, match=r"a\.\w+"):
            picture.save(file)
        assert file.read_bytes() == b"old" and [*tmp_path.iterdir()] == [file]
    with full_disk(len(whole)):
        picture.save(file)
    assert file.read_bytes() == whole or kind == "npz"  # it contains the time


def test_points_and_arrays_on_a_disk_that_is_full_at_the_very_end_are_told(tmp_path):
    values = np.arange(3000, dtype=np.float32)
    for missing in (1, 100, 3000):
        table, file = Table(tmp_path, "t"), tmp_path / "a.npy"
        with full_disk(12_000 - missing), pytest.raises(OSError, match="can't be written"):
            table.append({"code": values})
        with full_disk(12_128 - missing), pytest.raises(OSError):
            save_npy(file, values)
        for left in tmp_path.iterdir():
            left.unlink()
    save_npy(file, values.reshape(30, 100)[:, ::2].T)
    assert np.array_equal(np.load(file), values.reshape(30, 100)[:, ::2].T)


@pytest.mark.parametrize("size", [0, 300, 3000, 9000])
def test_a_full_disk_is_told_with_the_file_that_is_too_long(tmp_path, size):
    """For files within a store, which no user had named, the error once named none."""
    rng = np.random.default_rng(1)
    np.save(tmp_path / "a.npy", rng.integers(0, 256, (64, 64, 64), dtype=np.uint8))
    np.savez(tmp_path / "p.npz", positions=rng.random((500, 3)))
    gvtorch("convert", tmp_path / "a.npy", tmp_path / "s.zarr")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    for command in (
        ("convert", tmp_path / "a.npy", tmp_path / "new.zarr", "--workers", "1"),
        ("splat", tmp_path / "p.npz", "-o", tmp_path / "more.zarr", "--resolution", "64"),
        ("filter", tmp_path / "s.zarr"),
    ):
        with full_disk(size):
            run = gvtorch(*command)
        assert run.returncode == 2 and run.stderr.count("\n") == 1, run.stderr
        assert str(tmp_path) in run.stderr, run.stderr
    assert all(file.read_bytes() == content for file, content in before.items())


def test_a_full_disk_leaves_the_figures_of_a_workload_as_they_were(tmp_path, monkeypatch):
    content = {"workload": "w", "machine": "m", "peers": {}, "notes": ["x" * 1000]}
    monkeypatch.setattr(bench, "run", lambda *_: SimpleNamespace(as_dict=lambda: content))
    monkeypatch.setattr(tables, "file_name", lambda _: "a.json")
    (tmp_path / "a.json").write_text("old")
    with full_disk(500), pytest.raises(OSError, match=r"a\.json"):
        Bench(name="march", output=tmp_path, json=True).run()
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.json", "old")]
