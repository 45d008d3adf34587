"""Broken input by the thousand: readers, metadata of stores, JSON of every kind, arguments of ops.

Each input is made from a seed. A plain run tries a few; `make fuzz MINUTES=60` tries random seeds
for that long. An input that breaks something is stored in `found` and tried in every run.
"""

from __future__ import annotations

import gzip
import json
import os
import random
import resource
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.vdb import ZIP, Grid, VdbWriter, nano_file, nano_grid

import gvtorch as gv
from gvtorch.io import budget, reading
from gvtorch.ops.registry import FAKES
from gvtorch.viewer.state import Eye

# Libraries leave files open that they can't read.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)
SECONDS = 60 * float(os.environ.get("GVTORCH_FUZZ", "0"))  # make fuzz
PLAIN_INPUTS = 40  # inputs of each kind in a plain run
FOUND = Path(__file__).parent / "found"
SLOW = 10.0  # seconds of processor time that one input may take
MEMORY = 2 * 10**9  # bytes that it may take
REFUSALS = (ValueError, OSError)  # errors by which input is refused


def broken(content: bytes, pick: random.Random) -> bytes:
    """Cuts, changes and repeats bytes, and overwrites some with extreme numbers."""
    damaged = bytearray(content)
    for _ in range(pick.choice((1, 2, 8))):
        i = pick.randrange(len(damaged)) if damaged else 0
        edit = pick.randrange(5)
        if edit == 0:
            del damaged[i:]
        elif edit == 1:
            damaged[i : i + 1] = bytes([pick.randrange(256)])
        elif edit == 2:
            damaged[i : i + 4] = pick.choice((b"\xff" * 4, bytes(4), b"\x7f\xff\xff\xff", b"-1"))
        elif edit == 3:
            damaged[i:i] = damaged[i : i + pick.randrange(64)]
        else:
            damaged[i : i + 3] = pick.choice((b"999999999", b"-1", b"1e999", b"nan", b"[[[", b"\0"))
    return bytes(damaged)


Attempt = Callable[[random.Random], tuple[str, Callable[[], bytes], str]]


def first_fault(kind: str, attempt: Attempt) -> str:
    """Runs `attempt` for seeds; it returns what went wrong or "", a function that returns the
    input, and the input's name. Returns the first fault, also of time or memory, or "". A crash
    ends the tests.
    """
    start_time, seed = time.monotonic(), 0
    first_seed = random.randrange(10**9) if SECONDS else 0
    while seed < PLAIN_INPUTS or time.monotonic() < start_time + SECONDS / 4:
        cpu_start, memory_before = time.process_time(), most_memory()
        fault, content, name = attempt(random.Random(f"{kind} {first_seed + seed}"))
        seconds, memory = time.process_time() - cpu_start, most_memory() - memory_before
        if seconds > SLOW:
            fault = fault or f"{seconds:.1f} s"
        if memory > MEMORY:
            fault = fault or f"{memory / 1e9:.1f} GB"
        if fault:
            if SECONDS:
                (FOUND / f"{kind}-{first_seed + seed}-{name}").write_bytes(content())
            return f"{kind} {first_seed + seed}: {fault}"
        seed += 1
    rate = seed / (time.monotonic() - start_time)
    print(f"{kind}: {seed} inputs, {rate:.0f}/s, without a fault")
    return ""


def most_memory() -> int:
    """Returns the peak memory of this process in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def outcome(call: Callable[[], Any], *expected_errors: type[BaseException]) -> str:
    """Returns which error a call raised wrongly, or ""."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
    except (*REFUSALS, *expected_errors) as error:
        return "" if "\n" not in str(error) or expected_errors else f"several lines: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


FREE = 2 * 10**8  # bytes: a sparse grid of a few kB may claim a huge box, and is read if it fits


def refuse_large(context: str, nbytes: int) -> None:
    if nbytes > FREE:
        raise ValueError(f"{context}: takes {nbytes} bytes")


@pytest.fixture(autouse=True)
def short_budget(monkeypatch):
    monkeypatch.setattr(budget, "SECONDS", 2.0)
    monkeypatch.setattr(reading, "check_memory", refuse_large)


# --- readers


Whole = dict[str, tuple[bytes, Callable[[Path], Any]]]  # a file's content, and its reader


def volumes(folder: Path) -> Whole:
    """Writes a small file in every volume format that can be written here."""
    data = (np.arange(4 * 5 * 6).reshape(4, 5, 6) % 200).astype(np.uint8)
    np.save(folder / "a.npy", data)
    np.savez_compressed(folder / "a.npz", a=data)
    (folder / "a_6x5x4_uint8.raw.gz").write_bytes(gzip.compress(data.tobytes()))
    head = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 6 5 4\nencoding: {}\n\n"
    (folder / "a.nrrd").write_bytes(head.format("raw").encode() + data.tobytes())
    (folder / "b.nrrd").write_bytes(head.format("gzip").encode() + gzip.compress(data.tobytes()))
    (folder / "a.mha").write_bytes(
        b"ObjectType = Image\nNDims = 3\nDimSize = 6 5 4\nElementType = MET_UCHAR\n"
        b"ElementDataFile = LOCAL\n" + data.tobytes()
    )
    import nibabel
    import tifffile
    from astropy.io import fits

    tifffile.imwrite(folder / "a.tif", data, photometric="minisblack", compression="zlib")
    axes = {"axes": "ZYX", "PhysicalSizeX": 1.5}
    tifffile.imwrite(folder / "b.ome.tif", data, photometric="minisblack", metadata=axes)
    tifffile.imwrite(folder / "c.tif", data, imagej=True)
    nibabel.save(nibabel.Nifti1Image(data, np.eye(4)), folder / "a.nii.gz")
    nibabel.save(nibabel.Nifti1Image(data, np.eye(4)), folder / "b.nii")
    fits.PrimaryHDU(data).writeto(folder / "a.fits")
    rng = np.random.default_rng(0)
    values, active = rng.integers(-9, 9, (512, 1)).astype(np.float32), rng.random(512) < 0.5
    VdbWriter().write(folder / "a.vdb", Grid("float", 7, {(0, 0, 0): (values, active)}))
    VdbWriter(packing=ZIP).write(folder / "b.vdb", Grid("float", 7, {(8, 0, 0): (values, active)}))
    grid, (number, _) = nano_grid("float", rng)
    nano_file(folder / "a.nvdb", ("density", number, grid))
    nano_file(folder / "b.nvdb", ("density", number, grid), codec=1)
    return read_by(folder, lambda file: gv.read_volume(file, nan=0))


def read_by(folder: Path, read: Callable[[Path], Any]) -> Whole:
    return {file.name: (file.read_bytes(), read) for file in sorted(folder.iterdir())}


def meshes(folder: Path) -> Whole:
    """Writes triangles in every format that trimesh can write."""
    import trimesh

    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    for ending in ("obj", "ply", "stl", "glb", "off"):
        mesh.export(folder / f"mesh.{ending}")
    (folder / "packed.obj.gz").write_bytes(gzip.compress((folder / "mesh.obj").read_bytes()))
    return read_by(folder, gv.read_mesh)


def images(folder: Path) -> Whole:
    """Writes a picture in every format that can be read back."""
    tree = gv.N3Tree.from_volume(gv.Volume(np.arange(8, dtype=np.uint8).reshape(2, 2, 2)))
    transfer = gv.TransferFunction.preset("hot", 0, 7)
    picture = gv.render(tree, gv.Camera.orbit(width=9, height=7), transfer)
    for ending in ("png", "exr", "tif", "npy"):
        picture.save(folder / f"image.{ending}")
    return read_by(folder, gv.read_image)


def points(folder: Path) -> Whole:
    positions = np.random.default_rng(0).random((9, 3)).astype(np.float32)
    np.savez_compressed(folder / "points.npz", position=positions, mass=positions[:, 0])
    head = "ply\nformat {} 1.0\nelement vertex 9\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    text = head.format("ascii") + "end_header\n" + "\n".join("1 2 3" for _ in positions)
    (folder / "text.ply").write_text(text)
    binary = head.format("binary_little_endian") + "end_header\n"
    (folder / "points.ply").write_bytes(binary.encode() + positions.tobytes())
    return read_by(folder, gv.read_points)


def looks(folder: Path) -> Whole:
    """Writes cameras, camera paths, states of a view, key frames."""
    camera = gv.Camera.look_at((1, 2, 3), (0, 0, 0), width=8, height=6)
    for name in ("cameras.json", "camera.pvcc"):
        gv.write_cameras(folder / name, camera)
    contents = read_by(folder, gv.read_cameras)
    keys = [{"eye": [n, 0, 5], "target": [0, 0, 0], "fov": 30} for n in range(3)]
    contents["path.json"] = (json.dumps(keys).encode(), gv.CameraPath.from_json)
    transfer = gv.TransferFunction.preset("bone", 0, 1)
    state = gv.ViewState(shader=gv.Lit(transfer), camera=Eye(eye=(0, 0, 5), target=(0, 0, 0)))
    contents["state.json"] = (json.dumps(state.to_json()).encode(), state.read)
    frames = [{"time": n, "state": state.to_json()} for n in range(2)]
    contents["keys.json"] = (json.dumps(frames).encode(), lambda file: gv.Flight.read(file, state))
    return contents


def test_readers(tmp_path_factory):
    """A broken file is read, or refused in one line."""
    whole, folder = dict[str, Any](), tmp_path_factory.mktemp("broken")
    for kind in (volumes, meshes, points, looks, images):
        whole |= kind(tmp_path_factory.mktemp(kind.__name__))

    def attempt(pick: random.Random) -> tuple[str, Callable[[], bytes], str]:
        name = pick.choice(sorted(whole))
        content, read = whole[name]
        if name.endswith(".json") and pick.random() < 0.7:
            content = json.dumps(changed(json.loads(content), pick)).encode()
        else:
            content = broken(content, pick)
        (folder / name).write_bytes(content)
        return outcome(lambda: read(folder / name)), lambda: content, name

    assert not first_fault("reader", attempt)


# --- stores


def test_metadata_of_stores(tmp_path):
    """A store with a broken file is read, or refused in one line."""
    target = tmp_path / "a.zarr"
    gv.convert(gv.Volume(np.ones((9, 9, 9), np.uint8)), target, workers=1)
    files = sorted(file for file in target.rglob("*") if file.is_file())
    whole = {file: file.read_bytes() for file in files}

    def attempt(pick: random.Random) -> tuple[str, Callable[[], bytes], str]:
        file = pick.choice(files)
        content = broken(whole[file], pick)
        file.write_bytes(content)

        def read() -> None:
            store = gv.Store.open(target)
            z, y, x = (min(9, n) for n in store.extent[::-1])
            store.read_region(0, (0, 0, 0), (z, y, x))
            store.read_blocks(0, np.zeros((1, 3), np.int64))

        wrong = outcome(read)
        file.write_bytes(whole[file])
        return wrong, lambda: content, file.name

    assert not first_fault("store", attempt)


# --- JSON of every kind


def value(pick: random.Random, depth: int = 0) -> Any:
    """Returns a random JSON value, with extreme numbers."""
    kind = pick.randrange(9 if depth < 4 else 6)
    if kind < 6:
        ends = (0, -1, 2**63, 10**400, 1e308, -1e-320, 0.5)
        return (pick.choice(ends), "", "x" * 50, None, True, pick.random())[kind]
    items = [value(pick, depth + 1) for _ in range(pick.randrange(4))]
    return items if kind < 8 else {str(n): item for n, item in enumerate(items)}


def changed(content: Any, pick: random.Random) -> Any:
    """Returns a JSON value with a random part replaced."""
    if isinstance(content, (dict, list)) and content and pick.random() < 0.8:
        keys = sorted(content) if isinstance(content, dict) else list(range(len(content)))
        result: Any = dict(content) if isinstance(content, dict) else list(content)
        key = pick.choice(keys)
        result[key] = changed(result[key], pick)
        return result
    return value(pick)


def test_json_of_every_kind(tmp_path):
    """Broken JSON is read, or refused in one line."""
    look = gv.TransferFunction.from_points([(0, 0), (1, 1)], [(0, 1, 1, 1)])
    look.save(tmp_path / "tf.json")
    kinds = dict.fromkeys(("tf.json", "presets.json"), gv.TransferFunction.from_file)
    (tmp_path / "presets.json").write_text(
        json.dumps([{"Name": "a", "ColorSpace": "RGB", "RGBPoints": [0, 0, 0, 0, 1, 1, 1, 1],
                     "Points": [0, 0, 0.5, 0, 1, 1, 0.5, 0]}])
    )  # fmt: skip
    whole = {name: json.loads((tmp_path / name).read_text()) for name in kinds}

    def attempt(pick: random.Random) -> tuple[str, Callable[[], bytes], str]:
        name = pick.choice(sorted(kinds))
        text = json.dumps(changed(whole[name], pick)).encode()
        text = broken(text, pick) if pick.random() < 0.3 else text
        file = tmp_path / f"broken_{name}"
        file.write_bytes(text)
        return outcome(lambda: kinds[name](file)), lambda: text, name

    assert not first_fault("json", attempt)


# --- arguments of ops


def random_tensor(pick: random.Random) -> torch.Tensor:
    integers = (torch.int16, torch.int32, torch.int64, torch.bool, torch.uint8)
    dtypes = (*integers, torch.float32, torch.float64)
    shape = [pick.choice((0, 1, 2, 3, 4, 8)) for _ in range(pick.randrange(6))]
    dtype, seed = pick.choice(dtypes), pick.randrange(2**31)
    generator = torch.Generator().manual_seed(seed)
    if dtype.is_floating_point:
        values = torch.rand(shape, generator=generator, dtype=dtype) * pick.choice((1, 1e30, -5))
        if values.numel() and pick.random() < 0.3:
            values.view(-1)[0] = pick.choice((torch.nan, torch.inf, -torch.inf))
        return values
    span = {torch.bool: (0, 2), torch.uint8: (0, 256)}.get(dtype, (-4, pick.choice((9, 2**31 - 1))))
    return torch.randint(*span, shape, generator=generator).to(dtype)


def test_arguments_of_ops(blobs):
    """Some arguments of a valid op call are replaced: it returns, or raises RuntimeError; it must
    not read or write out of bounds, which `make asan` checks.
    """
    from helpers.traces import SHADER, arguments, packed

    tree = gv.N3Tree.from_volume(blobs, 4)
    rays, trace_arguments = arguments(tree, 4, SHADER)
    request, order = tree.nodes.request_tn, torch.arange(8, dtype=torch.int32)
    calls: dict[str, tuple[Any, ...]] = {
        "trace_rays": (*rays, *trace_arguments),
        "count_segments": (*rays, *trace_arguments, None, 0, False),
        "compact_requests": (request, 8),
        "choose_requests": (
            order.view(1, 2, 4) << 9,
            tree.nodes.loc_t4,
            torch.arange(2) + 2,
            *(8, 3, True),
        ),
        "lru_partition": (order, order.clone(), torch.ones(1, dtype=torch.int32)),
        "locate": (tree.nodes.loc_t4, torch.arange(8), 2, 8),
        "cut_bricks": (torch.rand(8, 8, 8, 1), torch.zeros((2, 3), dtype=torch.int64), 4, 1),
        "composite": (*packed(dtype=torch.float32), 0.01),
    }
    assert set(calls) <= set(FAKES)

    def attempt(pick: random.Random) -> tuple[str, Callable[[], bytes], str]:
        name = pick.choice(sorted(calls))
        values = [v.clone() if isinstance(v, torch.Tensor) else v for v in calls[name]]
        for _ in range(pick.choice((1, 1, 2))):
            i = pick.randrange(len(values))
            if isinstance(values[i], torch.Tensor):
                new = random_tensor(pick)
                keeps_shape = new.numel() and pick.random() < 0.6
                if keeps_shape:  # the right shape, with other content
                    old = values[i]
                    flat = new.flatten().repeat(-(-max(1, old.numel()) // new.numel()))
                    new = flat[: old.numel()].view(old.shape).to(old.dtype)
                values[i] = new
            elif values[i] is not None:
                small = (-1, 0, 1, 7, 0.0, float("nan"), 1e-4)  # 1e-9 would be a step of much work
                values[i] = (
                    type(values[i])(pick.choice(small))
                    if isinstance(values[i], float)
                    else pick.choice((-1, 0, 1, 3, 2**62))
                )
        op = getattr(torch.ops.gvtorch, name)
        fault = outcome(lambda: op(*values), RuntimeError, TypeError)
        return fault, lambda: repr(values).encode(), name

    assert not first_fault("op", attempt)


FILES = sorted(file for file in FOUND.iterdir() if file.name.startswith(("reader-", "json-")))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_what_was_found_is_mended(file, tmp_path):
    """Files are named by kind, seed, and the name of the input."""
    kind, _, name = file.name.split("-", 2)
    copy = tmp_path / name
    copy.write_bytes(file.read_bytes())
    if kind == "json":
        assert not outcome(lambda: gv.TransferFunction.from_file(copy))
    else:
        assert not outcome(lambda: gv.read_volume(copy, nan=0))
