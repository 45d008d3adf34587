"""Fixtures, and a summary that states how many tests ran on each backend."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import gc
import importlib
import importlib.util
import os
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from hypothesis import strategies

import gvtorch as gv
from gvtorch.ops import unavailable
from gvtorch.viewer.state import Development
from gvtorch.viewer.view import new_session

pytest.register_assert_rewrite("helpers")
from helpers import ABSENT, DATA, DEVICES, TESTS, browser, gvtorch, slowness  # noqa: E402
from helpers.compiled import prepared_compiler  # noqa: E402
from helpers.viewer import BANDS, FUNCTION, bright_ball  # noqa: E402

_REQUIRED = os.environ.get("GVTORCH_REQUIRE", "")
_FIRST = ("test_user_packets.py", "test_stored.py", "test_soak.py", "test_viewer_hands.py")
#: On a machine that is starved of its processor a part of the tests is skipped, for a reason that
#: begins like this; the summary counts them. GVTORCH_WHOLE=1 runs all tests, GVTORCH_WHOLE=0 the
#: part on any machine. Where it is not set, `pytest_configure` sets it, for all processes of a run.
_STARVED = "left out: "
_ran: Counter[str] = Counter()
_absent: set[str] = set()
_left_out: Counter[str] = Counter()


def pytest_configure(config: pytest.Config) -> None:
    """Registers the markers. Finds out whether the machine is starved of its processor, as on a
    host that is shared with many: all tests would take hours there. Tests that are named in the
    call always run.
    """
    config.addinivalue_line(
        "markers",
        "backend(name): runs on this backend, in OpenGL or a browser; counted in the summary",
    )
    config.addinivalue_line("markers", "long: left out on a machine that is starved, see _STARVED")
    if "GVTORCH_WHOLE" not in os.environ:
        times = min(slowness() for _ in range(20))
        starved = times >= 2 and config.args == ["tests"]
        reason = f"this machine takes {times:.1f} times as long as usual"
        os.environ["GVTORCH_WHOLE"] = f"0: {reason}" if starved else "1"


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Each worker imports a part of the test files first, so that pytest rewrites the assertions
    of each file once, not once per worker: the others read what it has written.

    What is imported stays until the process ends, so Python's garbage collector need not search it:
    neither during the imports nor, a third of a second each time, during the tests.
    """
    gc.disable()
    if hasattr(session.config, "workerinput") and session.config.args == ["tests"]:
        number, count = (session.config.workerinput[k] for k in ("workerid", "workercount"))
        for file in sorted(TESTS.glob("test_*.py"))[int(number[2:]) :: count]:
            with contextlib.suppress(Exception, pytest.skip.Exception):  # collection reports them
                importlib.import_module(file.stem)
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Moves tests by hypothesis to the front: in processes that had run thousands of other tests,
    Python 3.11's interpreter was seen to loop forever at the first instruction of hypothesis' code.
    Files of long tests that would be among the last come next, or other processes wait for them.
    """

    def place(item: pytest.Item) -> tuple[bool, bool]:
        by_hypothesis = getattr(getattr(item, "obj", None), "is_hypothesis_test", False)
        return not by_hypothesis, item.path.name not in _FIRST

    items.sort(key=place)
    if os.environ["GVTORCH_WHOLE"] != "1":
        _thin_out(items)


def _thin_out(items: list[pytest.Item]) -> None:
    """Leaves out the tests marked as long, which take minutes on such a machine, and two thirds of
    the cases of each test that has six or more, chosen by their names.
    """

    def runs_here(item: pytest.Item) -> bool:
        return "cuda" not in _devices(item) or not unavailable()["cuda"]

    cases = Counter(item.nodeid.partition("[")[0] for item in items if runs_here(item))
    reason = f"{_STARVED}{os.environ['GVTORCH_WHOLE'].partition(': ')[2] or 'GVTORCH_WHOLE=0'}"
    for item in filter(runs_here, items):
        name = item.nodeid
        many = cases[name.partition("[")[0]] >= 6
        if item.get_closest_marker("long") or (many and zlib.crc32(name.encode()) % 3):
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(params=["reference", "cpp", "cuda"])
def backend(request: pytest.FixtureRequest) -> str:
    """Every backend that can run here."""
    reason = unavailable()[request.param]
    if reason:
        pytest.skip(f"backend {request.param}: {reason}")
    return request.param


@pytest.fixture(params=["cpp", "cuda"])
def compiled(request: pytest.FixtureRequest) -> str:
    """Every compiled backend that can run here."""
    reason = unavailable()[request.param]
    if reason:
        pytest.skip(f"backend {request.param}: {reason}")
    return request.param


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A temporary cache folder of compiled shaders: each is compiled once for all tests. torch
    precompiles no header, because the tests compile too few graphs with its default backend, and
    takes the processor's word for its instruction sets, which it would prove by a compilation each.
    """
    with pytest.MonkeyPatch.context() as patch:
        base = tmp_path_factory.getbasetemp()
        folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
        patch.setenv("GVTORCH_CACHE", str(folder))
        patch.setenv("TORCHINDUCTOR_CPP_CACHE_PRECOMPILE_HEADERS", "0")
        patch.setenv("TORCHINDUCTOR_VEC_ISA_OK", "1")
        yield folder


@pytest.fixture(scope="session", autouse=True)
def tokens_of_classes() -> Iterator[None]:
    """Each command tokenizes the sources of its classes for its help, a third of its time before it
    does anything: in the tests' process, each class is tokenized once.
    """
    kind = tyro._docstrings._ClassTokenization
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kind, "make", staticmethod(functools.cache(kind.make)))
        yield


@pytest.fixture(scope="session", autouse=True)
def distributed_tensors() -> Iterator[None]:
    """`assert_close` would import torch.distributed, for over a second, to find that there are no
    distributed tensors.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.testing._comparison, "_HAS_DTENSOR", False, raising=False)
        yield


@pytest.fixture(scope="session", autouse=True)
def characters(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Hypothesis lists all characters and keeps the list on disk: one process makes it for all."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        with tmp_path_factory.getbasetemp().with_name("characters.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            strategies.characters(codec="utf-8").validate()


@pytest.fixture(scope="session")
def quick(cache: Path) -> str:
    """A compiler that does not optimise, shared by all processes so that they share its cache."""
    folder = cache.parent / "quick"
    with cache.with_name("quick.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            folder.mkdir()
            prepared_compiler(folder)
    return str(folder / "c++")


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    file = tmp_path_factory.mktemp("cli") / "ball_24x20x16_uint8.raw"
    z, y, x = np.mgrid[0:16, 0:20, 0:24]
    ball = np.clip(8 - np.sqrt((x - 12) ** 2 + (y - 10) ** 2 + (z - 8) ** 2), 0, 1) * 200
    file.write_bytes(ball.astype(np.uint8).tobytes())
    return file


@pytest.fixture(scope="session")
def scan_store(tmp_path_factory) -> Path:
    """A ball of 40 x 48 x 56 voxels as a store, made by the command."""
    folder = tmp_path_factory.mktemp("store")
    z, y, x = np.mgrid[-1:1:56j, -1:1:48j, -1:1:40j]
    np.save(folder / "ball.npy", (255 * np.clip(1.2 - x**2 - y**2 - z**2, 0, 1)).astype(np.uint8))
    run = gvtorch("convert", folder / "ball.npy", folder / "ball.zarr", "--spacing", "1,1,2")
    assert run.returncode == 0, run.stderr
    return folder / "ball.zarr"


@pytest.fixture(scope="session")
def aneurism() -> gv.Volume:
    return gv.read_volume(DATA / "aneurism_256x256x256_uint8.raw.gz")


@pytest.fixture(scope="session")
def stent() -> gv.Volume:
    return gv.read_volume(DATA / "stent_256x128x128_int16.npz")


@pytest.fixture(scope="session")
def blobs() -> gv.Volume:
    """A small smooth float32 volume with odd extents, anisotropic voxels and empty space around."""
    z, y, x = np.mgrid[0:37, 0:29, 0:45].astype(np.float32)
    value = np.zeros_like(x)
    for cx, cy, cz, r in ((14, 10, 12, 7), (30, 18, 22, 9), (22, 14, 30, 4)):
        distance = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
        value = np.maximum(value, np.clip(r - distance, 0, 3) / 3)
    return gv.Volume(torch.from_numpy(value), spacing=(1.0, 0.8, 1.5), origin=(5.0, -3.0, 2.0))


@pytest.fixture(scope="session")
def channels(blobs) -> dict[str, gv.Volume]:
    """The blobs with a colour and a normal in each voxel, both of 8 bits, and a label."""
    value = blobs.data[..., 0]
    z, y, x = torch.meshgrid(*(torch.linspace(0, 1, n) for n in value.shape), indexing="ij")
    rgba = torch.stack((x, y, z, value), -1)
    normal = torch.stack(torch.gradient(value)[::-1], -1)
    normal = torch.nn.functional.normalize(normal, dim=-1) * 0.5 + 0.5
    placement = blobs.spacing, blobs.origin
    six = gv.Volume(rgba, *placement).directional()
    six.data = six.data * torch.linspace(0.6, 1.0, 24).to(six.data)  # all six differ
    return {
        "value": blobs,
        "rgba": gv.Volume((rgba * 255).round().to(torch.uint8), *placement),
        "premultiplied": gv.Volume(
            torch.cat((rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]), -1), *placement
        ),
        "six": six,
        "normal": gv.Volume((normal * 255).round().to(torch.uint8), *placement),
        "label": gv.Volume((value * 6).to(torch.int64) * 1000, *placement, labels=True),
    }


@pytest.fixture(scope="session")
def tree_of_channels(channels) -> gv.N3Tree:
    return gv.N3Tree.from_volume(channels, 4)


@pytest.fixture
def session():
    """A view of a ball, without a server."""
    opened = new_session(bright_ball(), FUNCTION, engine={"time_budget": None})
    yield opened
    opened.close()
    assert not opened._thread.is_alive()


@pytest.fixture(scope="module")
def chromium():
    """The browser; without one, a skip that the summary reports."""
    if reason := browser.why_no_browser():
        pytest.skip(f"browser: {reason}")
    with browser.running_chromium() as process:
        yield process


@pytest.fixture
def viewer():
    """A view of a ball, served."""
    state = gv.ViewState(shader=BANDS, develop=Development(samples=2))
    with gv.view(bright_ball(), state=state, browser=False, wait=False) as served_view:
        yield served_view


@pytest.fixture
def tab(chromium, viewer):
    """The viewer's page in the browser; fails if the page has logged errors or warnings."""
    opened_tab = browser.Tab(chromium, viewer.url)
    opened_tab.until("app?.state")
    opened_tab.final()
    yield opened_tab
    complaints = opened_tab.complaints
    opened_tab.close()
    assert not complaints


def _devices(item: pytest.Item) -> set[str]:
    """Returns the backends that a case has as parameters."""
    values = getattr(item, "callspec", None)
    params = values.params.values() if values else ()
    return {value for value in params if isinstance(value, str) and value in DEVICES}


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Adds a test's backends to the properties of its report, which workers send to the main
    process; skips it if it is marked for CUDA and there is none.
    """
    names = _devices(item)
    marked = {mark.args[0] for mark in item.iter_markers("backend")}
    item.user_properties += [("backend", name) for name in sorted(names | marked or {"no backend"})]
    if "cuda" in marked and (reason := unavailable()["cuda"]):
        pytest.skip(f"backend cuda: {reason}")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    backends = [value for name, value in report.user_properties if name == "backend"]
    if report.skipped and isinstance(report.longrepr, tuple):
        reason = report.longrepr[2]
        if ABSENT in reason:
            _absent.add(reason.partition(ABSENT)[2])
        if _STARVED in reason:
            _left_out[reason.partition(_STARVED)[2]] += 1
    if report.when == "call" and report.passed:
        _ran.update(backends)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    groups = ("reference", "cpp", "cuda", "opengl", "browser", "no backend")
    counts = ", ".join(f"{name} {_ran[name]}" for name in groups)
    terminalreporter.write_line(f"passed by backend: {counts}")
    for name, reason in unavailable().items():
        if reason:
            terminalreporter.write_line(f"backend {name} did not run: {reason}")
    if reason := browser.why_no_browser():
        terminalreporter.write_line(f"browser did not run: {reason}")
    for reason, count in _left_out.items():
        line = f"{count} cases were left out: {reason} (GVTORCH_WHOLE=1 runs all)"
        terminalreporter.write_line(line)
    for name in _missing():
        terminalreporter.write_line(f"GVTORCH_REQUIRE: {name} did not run, so the tests failed")
    for path in sorted(_absent):
        terminalreporter.write_line(f"did not run for want of shared data: {path}")


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """With GVTORCH_REQUIRE=cpp,opengl,io, fails a run in which no test passed on the C++ backend or
    in OpenGL, or in which a library of a format, the video, the cluster or the rasteriser is
    missing.
    """
    if hasattr(session.config, "workerinput"):
        return  # a worker: the main process decides
    if session.exitstatus == 0 and _missing():
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _missing() -> list[str]:
    """Returns what GVTORCH_REQUIRE names and did not run."""
    libraries = (
        "nibabel nrrd tifffile imagecodecs astropy OpenEXR av PIL matplotlib distributed zarr "
        "yaozarrs ome_zarr_models vtk moderngl aiohttp anywidget h5py jupyterlab trimesh pydicom "
        "pylibCZIrw nd2 readlif mrcfile SimpleITK xarray fsspec tensorstore h5netcdf igl"
    ).split()
    _ran["io"] = int(all(importlib.util.find_spec(name) for name in libraries))
    return [name for name in filter(None, _REQUIRED.split(",")) if not _ran[name]]
