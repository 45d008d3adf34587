"""Filtered colours in stores: streamed from disk they have the bits of a resident tree, and missing
or damaged parts are reported.
"""

from __future__ import annotations

import functools
import json
import shutil

import numpy as np
import pytest
import torch
from helpers import gvtorch

import gvtorch as gv
from gvtorch.io.stores import coarse
from gvtorch.io.stores.store_layout import WORK

MISTY = gv.TransferFunction([(30, 0), (250, 0.08)], [(30, 1, 0.3, 0.1), (250, 1, 1, 1)])
OPAQUE = gv.TransferFunction([(100, 0), (120, 0.9)], [(100, 1, 0.3, 0.1), (250, 1, 1, 1)])


@functools.cache
def matter(dtype: torch.dtype = torch.uint8, width: int = 1) -> gv.Volume:
    """Returns rough matter and a region of zeros, more than one block wide, of odd extent."""
    generator = torch.Generator().manual_seed(2)
    coarse = torch.rand((width, 1, 9, 10, 11), generator=generator)
    value = torch.nn.functional.interpolate(coarse, size=(51, 39, 77), mode="trilinear")[:, 0]
    value = 200 * value + 55 * torch.rand(value.shape, generator=generator)
    value[:, :20] = 0
    data = value.movedim(0, -1).contiguous()
    if not dtype.is_floating_point:
        data = data.round()
    return gv.Volume(data.to(torch.int32).to(dtype) if dtype == torch.uint16 else data.to(dtype))


@functools.cache
def part(dtype: torch.dtype = torch.uint8, width: int = 1) -> gv.Volume:
    """Returns 24^3 voxels of it, for what does not depend on the number of blocks."""
    return gv.Volume(matter(dtype, width).data[:24, 15:39, :24].contiguous())


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """Stores of the matter, and of a part without colours and with misty ones; tests change copies
    of them.
    """
    folder = tmp_path_factory.mktemp("stores")
    gv.convert(matter(), folder / "plain.zarr")
    gv.convert(part(), folder / "part.zarr")
    shutil.copytree(folder / "part.zarr", folder / "misty.zarr")
    gv.Filtered.add_to(folder / "misty.zarr", MISTY)
    return folder


@pytest.fixture
def store(stores, tmp_path):
    return shutil.copytree(stores / "plain.zarr", tmp_path / "a.zarr")


@pytest.fixture
def part_store(stores, tmp_path):
    return shutil.copytree(stores / "part.zarr", tmp_path / "a.zarr")


@pytest.fixture
def misty_store(stores, tmp_path):
    return shutil.copytree(stores / "misty.zarr", tmp_path / "a.zarr")


CAMERAS = [gv.Camera.orbit(width=32, height=24, distance=distance) for distance in (1.0, 4.0, 12.0)]
_resident = {}


def resident_pictures(volume, shader, size: int, device: str) -> list[gv.Picture]:
    """Returns a resident tree's pictures, made once for each volume, function, size and device."""
    component = shader.component or 0
    key = (id(volume), str(shader.made_of), component, size, device)
    if key not in _resident:
        tree = gv.N3Tree.from_volume(volume, size, device=device)
        resident = gv.Filtered.of(
            tree, volume, shader.transfer, component=component, directions=None
        )
        # Holds the volume, so that no other one gets its number.
        _resident[key] = [gv.render(tree, camera, resident) for camera in CAMERAS], volume
    return _resident[key][0]


def check_streamed(path, volume, shader, size=8, device="cpu", **pools) -> None:
    pictures = resident_pictures(volume, shader, size, device)
    stored, pools = gv.Filtered.stored(path), {"brick_size": size, "device": device, **pools}
    with gv.Engine(gv.StoredProducer(path, filtered=stored), **pools) as engine:
        for camera, expected in zip(CAMERAS, pictures, strict=True):
            actual = engine.render(camera, stored)
            assert actual.stats.converged and not engine.failures
            for field in ("color", "alpha", "depth"):
                assert torch.equal(getattr(actual, field), getattr(expected, field)), field
        assert actual.alpha.max() > 0.05
        engine.validate()


@pytest.mark.parametrize("size", [8, 16])
@pytest.mark.parametrize("transfer", [MISTY, OPAQUE])
def test_streamed_from_disk_equals_resident(compiled, store, transfer, size):
    device = "cuda" if compiled == "cuda" else "cpu"
    before = {file: file.read_bytes() for file in store.rglob("*") if file.is_file()}
    shader = gv.Filtered.add_to(store, transfer, device=device)
    assert not (store / WORK).exists()
    assert all(file.read_bytes() == content for file, content in before.items())
    width = 4 if transfer is MISTY else 24
    assert {n: c.width for n, c in gv.Store.open(store).coarse.items()} == {"filtered": width}
    check_streamed(store, matter(), shader, size, device)
    pool = 60 * (size + 2) ** 3 * (2 * width)
    check_streamed(store, matter(), shader, size, device, brick_pool=pool)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("dtype", [torch.uint16, torch.float16, torch.float32])
def test_dtypes_and_components(tmp_path, dtype):
    volume = part(dtype, width=2)
    gv.convert(volume, tmp_path / "a.zarr")
    shader = gv.Filtered.add_to(tmp_path / "a.zarr", MISTY, component=1)
    check_streamed(tmp_path / "a.zarr", volume, shader)


@pytest.mark.backend("cpp")
def test_colours_of_several_functions_and_new_ones_of_a_name(store):
    first = gv.Filtered.add_to(store, MISTY, channel="mist")
    second = gv.Filtered.add_to(store, OPAQUE)
    assert sorted(gv.Store.open(store).coarse) == ["filtered", "mist"]
    for name, shader in (("mist", first), ("filtered", second)):
        assert gv.Filtered.stored(store, name).made_of == shader.made_of
    with pytest.raises(ValueError, match="'filtered' were made with another function or compon"):
        gv.StoredProducer(store, filtered=gv.Filtered(MISTY))
    gv.Filtered.add_to(store, MISTY)
    gv.StoredProducer(store, filtered=gv.Filtered(MISTY)).close()
    check_streamed(store, matter(), gv.Filtered(MISTY))
    described = gv.Store.open(store).describe()
    assert described["coarse channels"] == "mist, filtered"


@pytest.mark.backend("cpp")
def test_a_store_of_one_brick(tmp_path):
    volume = gv.Volume(torch.randint(0, 255, (8, 7, 6), dtype=torch.uint8))
    gv.convert(volume, tmp_path / "a.zarr")
    shader = gv.Filtered.add_to(tmp_path / "a.zarr", OPAQUE)
    check_streamed(tmp_path / "a.zarr", volume, shader)


def test_broken_off_work_leaves_the_store_as_it_was(misty_store):
    store = misty_store
    kept = gv.Filtered.stored(store).made_of

    def stop(stage: str):
        def progress(current: str, done: int, total: int) -> None:
            if current == stage:
                raise KeyboardInterrupt

        return progress

    for step in ("filtered", "writing"):
        with pytest.raises(KeyboardInterrupt):
            gv.Filtered.add_to(store, OPAQUE, progress=stop(step))
        assert not (store / WORK).exists() and gv.Filtered.stored(store).made_of == kept
        check_streamed(store, part(), gv.Filtered(MISTY))
    bad = gv.TransferFunction([(30, 0), (250, 0.08)])
    bad.opacity[1, 1] = float("nan")
    with pytest.raises(ValueError, match="opacity must be finite"):
        gv.Filtered.add_to(store, bad)
    shader = gv.Filtered.add_to(store, OPAQUE)
    check_streamed(store, part(), shader)
    folders = {file.name for file in (store / "gvtorch" / "coarse").iterdir()}
    assert folders == {"filtered.1", "zarr.json", ".lock"}


def test_one_at_a_time_and_nothing_is_forgotten(part_store):
    """Channels are added through one open store, by two writers at once, and during reading."""
    store = part_store
    opened, old = gv.Store.open(store), gv.Store.open(store)
    gv.Filtered.add_to(opened, MISTY, channel="mist")
    shader = gv.Filtered.add_to(opened, OPAQUE)
    assert sorted(gv.Store.open(store).coarse) == sorted(opened.coarse) == ["filtered", "mist"]
    gv.Filtered.add_to(old, MISTY, channel="late")  # opened before the other channels were added
    assert sorted(gv.Store.open(store).coarse) == ["filtered", "late", "mist"]

    def meanwhile(what: str, done: int, total: int) -> None:
        with pytest.raises(OSError, match="another process makes a coarse channel"):
            gv.Filtered.add_to(store, MISTY)

    gv.Filtered.add_to(store, MISTY, channel="two", progress=meanwhile)
    with gv.Engine(gv.StoredProducer(opened, filtered=shader)) as engine:
        gv.Filtered.add_to(store, OPAQUE)  # replaced: readers of the old ones get an error
        engine.render(gv.Camera.orbit(width=24, height=24, distance=3.0), shader)
        assert any("filtered.0" in failure.message for failure in engine.failures)


@pytest.mark.backend("cpp")
def test_channels_of_two_times_are_made_at_once(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", np.stack([matter().data.numpy()[..., 0]] * 2))
    gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", axes="tzyx")
    first, second = (gv.Store.open(tmp_path / "a.zarr", time=time) for time in (0, 1))
    original = coarse._map_level_file

    def map_file(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(coarse, "_map_level_file", original)
            if not second.coarse:
                gv.Filtered.add_to(second, MISTY)
        return original(*arguments)

    monkeypatch.setattr(coarse, "_map_level_file", map_file)
    gv.Filtered.add_to(first, MISTY)
    assert [*first.coarse] == [*second.coarse] == ["filtered"]


def test_channels_that_were_picked_are_refused(tmp_path):
    gv.convert(matter(width=2), tmp_path / "a.zarr")
    picked = gv.Store.open(tmp_path / "a.zarr", channels=[1])
    with pytest.raises(ValueError, match="are written into whole folders"):
        gv.Filtered.add_to(picked, MISTY)
    shader = gv.Filtered.add_to(tmp_path / "a.zarr", MISTY, component=1)
    with pytest.raises(ValueError, match="of all channels: leave channels out"):
        gv.StoredProducer(tmp_path / "a.zarr", channels=[1], filtered=shader)
    with pytest.raises(ValueError, match="another function or component"):
        gv.StoredProducer(tmp_path / "a.zarr", filtered=gv.Filtered(MISTY))
    with pytest.raises(ValueError, match="filtered must be a Filtered, got TransferFunction"):
        gv.StoredProducer(tmp_path / "a.zarr", filtered=MISTY)


def failures(path) -> list[str]:
    shader = gv.Filtered.stored(path)
    with gv.Engine(gv.StoredProducer(path, filtered=shader)) as engine:
        engine.render(gv.Camera.orbit(width=24, height=24, distance=3.0), shader)
        return [failure.message for failure in engine.failures]


@pytest.mark.backend("cpp")
def test_what_is_missing_or_damaged_is_told(store):
    gv.Filtered.add_to(store, OPAQUE)
    level = store / "gvtorch" / "coarse" / "filtered.0" / "1"
    (shard,) = (file for file in (level / "c").rglob("*") if file.is_file())
    whole = shard.read_bytes()
    shard.unlink()
    assert any("block" in text and "missing chunk" in text for text in failures(store))
    for damage in (whole[: len(whole) // 2], whole[:200] + b"\0" * 50 + whole[250:]):
        shard.write_bytes(damage)
        assert any("block" in text for text in failures(store))
    shard.write_bytes(whole)
    assert not failures(store)
    shutil.rmtree(level)
    assert any("coarse/filtered.0/1" in text for text in failures(store))


@pytest.mark.parametrize(
    "attributes",
    [
        {"channels": 3},
        {"channels": {"filtered": {}}},
        {"channels": {"filtered": {"version": 1, "made_of": {}}}},
        {"channels": {"../x": {"version": 1, "width": 4, "made_of": {}, "generation": 0}}},
        {"channels": {"filtered": {"version": 9, "width": 4, "made_of": {}}}},
        {"channels": {"filtered": {"version": 1, "width": True, "made_of": {}, "generation": 0}}},
        {
            "channels": {
                "filtered": {"version": 1, "width": 4, "made_of": {"opacity": 1}, "generation": 0}
            }
        },
        {
            "channels": {
                "filtered": {
                    "version": 1,
                    "width": 4,
                    "made_of": {"opacity": "x", "color": [], "reference": 0, "component": 0},
                    "generation": 0,
                }
            }
        },
        None,
    ],
)
def test_damaged_metadata_is_told(misty_store, attributes):
    store = misty_store
    file = store / "gvtorch" / "coarse" / "zarr.json"
    content = json.loads(file.read_text())
    content["attributes"] = attributes
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"a\.zarr: damaged"):
        gv.Filtered.stored(store)


def test_metadata_that_is_not_json_is_named(misty_store):
    store = misty_store
    (store / "gvtorch" / "coarse" / "zarr.json").write_text("[")
    with pytest.raises(ValueError, match=r"a\.zarr/gvtorch/coarse/zarr\.json: damaged JSON"):
        gv.Filtered.stored(store)


def test_mistakes_are_told(store, tmp_path):
    with pytest.raises(ValueError, match="component must be"):
        gv.Filtered.add_to(store, MISTY, component=1)
    for name in ("", "../x", "a/b", "x" * 65, "é", "value"):
        with pytest.raises(ValueError, match="channel's name is made of"):
            gv.Filtered.add_to(store, MISTY, channel=name)
    with pytest.raises(ValueError, match="'filtered' are not there; gvtorch filter"):
        gv.StoredProducer(store, filtered=gv.Filtered(MISTY))
    gv.Filtered.add_to(store, MISTY)
    shader = gv.Filtered.stored(store)
    for options in ({"brick_size": 4}, {"border": 2}, {"brick_size": 12}):
        with pytest.raises(ValueError, match="bricks of 8, 16, 32 voxels with a border of at most"):
            gv.Engine(gv.StoredProducer(store, filtered=shader), **options)
    other = tmp_path / "b.zarr"
    (other / "0").mkdir(parents=True)
    shutil.copytree(store / "0", other / "0", dirs_exist_ok=True)
    attributes = json.loads((store / "zarr.json").read_text())
    del attributes["attributes"]["gvtorch"]
    for image in attributes["attributes"]["ome"]["multiscales"]:
        image["datasets"] = image["datasets"][:1]
    (other / "zarr.json").write_text(json.dumps(attributes))
    with pytest.raises(ValueError, match=r"b\.zarr: coarse channels are written into whole"):
        gv.Filtered.add_to(other, MISTY)


@pytest.mark.backend("cpp")
def test_the_command_line(part_store, tmp_path):
    store, volume = part_store, part()
    far = ("--size", "24x16", "--camera", "orbit:20,10,9", "-o", tmp_path / "a.npy")
    done = gvtorch("render", store, "--shader", "filtered", *far)
    assert done.returncode == 2 and "gvtorch filter" in done.stderr
    done = gvtorch("filter", store, "--tf", "hot", "--directions", "six")
    assert done.returncode == 0 and "of colours in" in done.stdout, done.stderr
    tree = gv.N3Tree.from_volume(volume)
    hot = gv.TransferFunction.preset("hot", *gv.window(volume))
    shader = gv.Filtered.of(tree, volume, hot, directions=True)
    expected = gv.render(tree, gv.Camera.orbit(20, 10, 9, None, 24, 16), shader)
    for options in ((), ("--tf", "hot")):  # the function that the store records
        done = gvtorch("render", store, "--shader", "filtered", *far, *options)
        assert done.returncode == 0, done.stderr
        np.testing.assert_allclose(np.load(tmp_path / "a.npy")[..., :3], expected.color, atol=1e-6)
    for options in (("--tf", "bone"), ("--window", "3,5")):
        done = gvtorch("render", store, "--shader", "filtered", *far, *options)
        assert done.returncode == 2 and "made with another function" in done.stderr
    done = gvtorch("filter", tmp_path / "nothing.zarr")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
