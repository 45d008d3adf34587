"""Scenes streamed from a store: the same bits as in memory, and what happens when reads fail."""

from __future__ import annotations

import random
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import DEVICES, shared
from helpers.pictures import FIELDS, assert_same_picture, camera
from helpers.stores import Handler, serving

import gvtorch as gv
from gvtorch.bench.storage import MemorySampler
from gvtorch.engine import ProductionError
from gvtorch.io.stores.conversion import convert
from gvtorch.io.stores.store import Store
from gvtorch.producers.stored import HostCache

GRAY = gv.TransferFunction.preset("gray", 0, 255)
VIEW = camera(distance=1.4)


@pytest.fixture(scope="session")
def cloud() -> gv.Volume:
    """Smooth noise in a ball, empty space around it; extents are multiples of nothing."""
    generator = torch.Generator().manual_seed(5)
    coarse = torch.rand((1, 1, 9, 8, 11), generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (75, 67, 90), mode="trilinear")[0, 0]
    axes = [torch.linspace(-1, 1, n) for n in fine.shape]
    radius = torch.stack(torch.meshgrid(*axes, indexing="ij")).norm(dim=0)
    values = (fine * (1 - radius).clamp(min=0) * 400).clamp(max=255)
    return gv.Volume(values.to(torch.uint8), (1.0, 1.5, 0.8), (3.0, 4.0, 5.0))


@pytest.fixture(scope="session")
def whole(tmp_path_factory, cloud) -> Path:
    folder = tmp_path_factory.mktemp("stores") / "cloud.zarr"
    convert(cloud, folder)
    return folder


@pytest.fixture
def served(whole):
    """URL of the folder that holds the store."""
    with serving(whole.parent) as url:
        yield url


@pytest.fixture
def store(tmp_path, whole) -> Path:
    """A copy that may be damaged."""
    return Path(shutil.copytree(whole, tmp_path / "cloud.zarr"))


@pytest.mark.parametrize("loading", ["straight", "levels"])
@pytest.mark.parametrize("scan", ["aneurism", "stent", "tooth", "cloud"])
def test_a_small_pool_over_a_store_gives_the_picture_of_the_volume(
    request, tmp_path, compiled, scan, loading
):
    if scan == "tooth":
        volume = gv.read_volume(shared("volumes/tooth_103x94x161_uint8.raw.gz"))
    else:
        volume = request.getfixturevalue(scan)
    device, view = DEVICES[compiled], VIEW
    shader = gv.TransferFunction.preset("gray", *volume.value_range)
    resident = gv.render(gv.N3Tree.from_volume(volume, device=device), view, shader)
    convert(volume, tmp_path / "a.zarr", block=32 if loading == "straight" else 64)
    bricks = int(1.25 * resident.stats.bricks_used) + 8
    options = {"brick_pool": bricks * 1000 * volume.data.element_size(), "device": device}
    producer = gv.StoredProducer(tmp_path / "a.zarr", host_cache="3 MB")
    with gv.Engine(producer, loading=loading, **options) as engine:
        picture = engine.render(view, shader)
        engine.validate()
        assert picture.stats.converged and picture.stats.failed == 0
        assert_same_picture(picture, resident)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize(("brick_size", "border"), [(4, 1), (8, 0), (8, 2), (12, 1), (16, 1)])
def test_any_brick_size_and_border_can_be_streamed(whole, cloud, brick_size, border):
    view, options = camera(32, distance=1.4), {"brick_size": brick_size, "border": border}
    with gv.Engine(gv.StoredProducer(whole), **options) as engine:
        picture = engine.render(view, GRAY)
        assert picture.stats.converged and picture.stats.failed == 0
    expected = gv.render(gv.N3Tree.from_volume(cloud, brick_size, border), view, GRAY)
    # If a brick is not a whole number of cells, fewer regions are known to be uniform.
    assert (picture.color - expected.color).abs().max() < 1e-4
    assert expected.alpha.max() > 0.3


@pytest.mark.backend("cpp")
def test_a_threshold_is_kept_by_the_store(tmp_path, cloud):
    convert(cloud, tmp_path / "a.zarr", threshold=60)
    tree = gv.N3Tree.from_volume(cloud, threshold=60)
    with gv.Engine(gv.StoredProducer(tmp_path / "a.zarr")) as engine:
        picture = engine.render(VIEW, GRAY)
    assert_same_picture(picture, gv.render(tree, VIEW, GRAY))


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("loading", ["straight", "levels"])
def test_the_order_in_which_reads_come_back_does_not_matter(whole, cloud, monkeypatch, loading):
    """Every read has a random delay, in four threads."""
    resident = gv.render(gv.N3Tree.from_volume(cloud), VIEW, GRAY)
    pick = random.Random(11)
    for name in ("read_blocks", "read_cells"):
        read = getattr(Store, name)

        def late(self, *arguments, read=read, **options):
            time.sleep(pick.uniform(0, 0.01))
            return read(self, *arguments, **options)

        monkeypatch.setattr(Store, name, late)
    bricks = int(1.3 * resident.stats.bricks_used)
    for _ in range(3):
        producer = gv.StoredProducer(whole, host_cache="100 kB")
        with gv.Engine(producer, brick_pool=bricks * 1000, loading=loading) as engine:
            picture = engine.render(VIEW, GRAY)
            engine.validate()
            assert picture.stats.converged
            assert_same_picture(picture, resident)


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("channels", [None, [2, 0]])
def test_channels_of_a_store_are_components(tmp_path, cloud, channels):
    """Three channels on disk; all or two of them are read, in a chosen order."""
    values = cloud.data[..., 0]
    three = torch.stack((values // 4, values // 2, values), -1)
    volume = gv.Volume(three, cloud.spacing, cloud.origin)
    convert(volume, tmp_path / "a.zarr")
    picked = gv.Volume(three[..., channels] if channels else three, cloud.spacing, cloud.origin)
    tree = gv.N3Tree.from_volume(picked)
    for component in range(picked.data.shape[3]):
        expected = gv.render(tree, camera(24, distance=1.4), GRAY, component=component)
        producer = gv.StoredProducer(tmp_path / "a.zarr", channels=channels)
        with gv.Engine(producer) as engine:
            picture = engine.render(camera(24, distance=1.4), GRAY, component=component)
        for name in FIELDS:
            assert torch.equal(getattr(picture, name), getattr(expected, name)), name
        assert expected.alpha.max() > 0.05


@pytest.mark.backend("cpp")
def test_what_a_transfer_function_does_not_show_is_not_read(whole, monkeypatch):
    read, seen = Store.read_blocks, []

    def count(self, level, zyx, **options):
        seen.append(len(zyx))
        return read(self, level, zyx, **options)

    monkeypatch.setattr(Store, "read_blocks", count)
    loads = []
    for opacity in ([(0, 0), (1, 0.2)], [(120, 0), (121, 0.2)], [(254, 0), (255, 0.2)]):
        seen.clear()
        with gv.Engine(gv.StoredProducer(whole)) as engine:
            shader = gv.TransferFunction.from_points(opacity)
            stats = engine.render(VIEW, shader, lod="finest").stats
        loads.append((stats.produced["bricks"], sum(seen)))
    assert loads[0] > loads[1] > loads[2], loads
    assert loads[2][0] < 0.2 * loads[0][0]


@pytest.mark.backend("cpp")
def test_a_block_is_read_once_while_the_host_cache_holds_it(whole, monkeypatch):
    read, seen = Store.read_blocks, []

    def count(self, level, zyx, **options):
        seen.extend((level, *position) for position in np.asarray(zyx).tolist())
        return read(self, level, zyx, **options)

    monkeypatch.setattr(Store, "read_blocks", count)
    with gv.Engine(gv.StoredProducer(whole), brick_pool="400 kB") as engine:
        for azimuth in (0, 90, 180, 270):
            engine.render(
                camera(24, azimuth=azimuth, distance=1.4), GRAY, max_frames=40, lod="finest"
            )
        assert engine.frames > 8
    assert len(seen) == len(set(seen)) > 20


def test_the_host_cache_is_bounded_and_drops_the_oldest():
    cache, reads = HostCache(1000), []

    def read(missing):
        reads.append(missing)
        return {key: np.zeros(300, np.uint8) for key in missing}

    keys = [("block", 0, 0, 0, n) for n in range(5)]
    for key in (*keys[:3], keys[0], keys[3]):  # 0 is used again, so 1 is the oldest
        cache.get([key], read)
        assert cache.nbytes <= 1000
    cache.get([keys[0], keys[2], keys[3]], read)
    assert reads == [[keys[0]], [keys[1]], [keys[2]], [keys[3]]]
    assert cache.get([keys[4]], lambda missing: dict.fromkeys(missing, "damaged")) == ["damaged"]
    with pytest.raises(RuntimeError, match="odd"):
        cache.get([keys[4]], lambda missing: (_ for _ in ()).throw(RuntimeError("odd")))
    assert isinstance(cache.get([keys[4]], read)[0], np.ndarray), "errors are not kept"


def blocks(store: Path, level: int = 0) -> list[Path]:
    folder = store / f"gvtorch/blocks/{level}/c"
    return sorted(file for file in folder.rglob("*") if file.is_file())


def missing(store: Path) -> str:
    blocks(store)[0].unlink()
    return "missing chunk"


def corrupt(store: Path) -> str:
    file = blocks(store)[0]
    content = bytearray(file.read_bytes())
    content[200:230] = bytes(30)
    file.write_bytes(content)
    return "block ("


def gone(store: Path) -> str:
    shutil.rmtree(store)
    return "cloud.zarr"


@pytest.mark.backend("cpp")
@pytest.mark.parametrize("fault", [missing, corrupt, gone])
@pytest.mark.parametrize("loading", ["straight", "levels"])
def test_a_damaged_store_gives_a_complete_coarser_picture(store, cloud, fault, loading):
    expected = gv.render(gv.N3Tree.from_volume(cloud), VIEW, GRAY, lod="finest")
    with gv.Engine(gv.StoredProducer(store, timeout=5), loading=loading, patience=9) as engine:
        for _ in range(2):
            engine.frame(VIEW, GRAY, lod="finest")  # the damage comes while it runs
        reason = fault(store)
        picture = engine.render(VIEW, GRAY, lod="finest")
        engine.validate()
        stats = picture.stats
        assert stats.converged and stats.failed == len(engine.failures) > 0
        assert reason in engine.failures[0].message and str(store) in engine.failures[0].message
        assert "\n" not in str(engine.failures[0])
        covered = (picture.alpha > 0.02).float().mean()
        assert covered > 0.6 * (expected.alpha > 0.02).float().mean(), "complete, if coarse"
        if fault is not gone:
            assert (picture.color - expected.color).square().mean().sqrt() < 0.1


@pytest.mark.backend("cpp")
def test_strict_raises_the_first_fault(store):
    with gv.Engine(gv.StoredProducer(store), strict=True) as engine:
        reason = missing(store)
        with pytest.raises(ProductionError, match=reason) as caught:
            engine.render(VIEW, GRAY, lod="finest")
        assert "tree 'scene', depth 4, node (" in str(caught.value)


@pytest.mark.backend("cpp")
def test_a_store_that_errors_now_and_then_recovers(whole, monkeypatch):
    """Every third read fails once; failed bricks are requested again after `forget_failures`."""
    with gv.Engine(gv.StoredProducer(whole)) as engine:
        expected = engine.render(VIEW, GRAY)
    read, calls = Store.read_blocks, []

    def flaky(self, level, zyx, **options):
        calls.append(1)
        if len(calls) % 3 == 0:
            raise OSError("the network is down")
        return read(self, level, zyx, **options)

    monkeypatch.setattr(Store, "read_blocks", flaky)
    with gv.Engine(gv.StoredProducer(whole)) as engine:
        picture = engine.render(VIEW, GRAY)
        assert picture.stats.failed > 0
        assert any("the network is down" in failure.message for failure in engine.failures)
        for _ in range(50):
            if not engine.failures:
                break
            engine.forget_failures()
            picture = engine.render(VIEW, GRAY)
        assert_same_picture(picture, expected)


@pytest.mark.backend("cpp")
def test_a_store_that_stalls_does_not_hang(served, whole):
    """A server becomes slow at some moment."""
    with gv.Engine(gv.StoredProducer(f"{served}/{whole.name}", timeout=0.3), patience=5) as engine:
        for _ in range(2):
            engine.frame(camera(16, distance=1.4), GRAY)
        Handler.delay = 2.0
        start = time.monotonic()
        picture = engine.render(camera(16, distance=1.4), GRAY)
        assert time.monotonic() - start < 20
        assert picture.stats.failed > 0 and picture.alpha.max() > 0.05
        assert "no answer within 0.3 s" in engine.failures[0].message
        engine.validate()


@pytest.mark.backend("cpp")
def test_a_foreign_image_is_streamed_as_well(tmp_path, cloud):
    """A plain OME-Zarr pyramid, its coarse levels missing: no cells, no bordered blocks."""
    import zarr

    group = zarr.open_group(tmp_path / "plain.zarr", mode="w", zarr_format=2)
    values = cloud.data[..., 0].numpy()
    group.create_array("0", data=values, chunks=(20, 33, 41))
    spacing = list(cloud.spacing[::-1])
    transform = [{"type": "scale", "scale": spacing}]
    transform.append({"type": "translation", "translation": list(cloud.origin[::-1])})
    group.attrs["multiscales"] = [
        {
            "version": "0.4",
            "axes": [{"name": n, "type": "space"} for n in "zyx"],
            "datasets": [{"path": "0", "coordinateTransformations": transform}],
        }
    ]
    resident = gv.render(gv.N3Tree.from_volume(cloud), VIEW, GRAY)
    pictures = []
    for pool in ("9 MB", 1000 * int(1.3 * resident.stats.bricks_used + 300)):
        with gv.Engine(gv.StoredProducer(tmp_path / "plain.zarr"), brick_pool=pool) as engine:
            picture = engine.render(VIEW, GRAY)
            engine.validate()
            assert picture.stats.converged and picture.stats.failed == 0
            pictures.append(picture)
    assert_same_picture(*pictures)
    assert (pictures[0].color - resident.color).abs().max() < 1e-4


@pytest.mark.long
@pytest.mark.backend("cpp")
def test_a_store_of_1024_cubed_from_small_pools(tmp_path):
    """A generated volume of 1 GiB, converted by two processes in less than 2 GB: pools of a
    sixteenth give the same picture as pools that hold everything.
    """
    raw = np.lib.format.open_memmap(
        tmp_path / "big.npy", mode="w+", dtype=np.uint8, shape=(1024,) * 3
    )
    pick = np.random.default_rng(2)
    for _ in range(60):
        center, radius = pick.uniform(100, 924, 3), pick.uniform(10, 90)
        low = np.maximum(center - radius - 1, 0).astype(int)
        high = np.minimum(center + radius + 2, 1024).astype(int)
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        axes = zip(np.ogrid[box], center, strict=True)
        distance = sum(((a - c) ** 2).astype(np.float32) for a, c in axes) ** 0.5
        ball = (np.clip(radius - distance, 0, 8) * 25).astype(np.uint8)
        raw[box] = np.maximum(raw[box], ball)
    raw.flush()
    del raw
    folder = tmp_path / "big.zarr"
    with MemorySampler() as memory:
        convert(tmp_path / "big.npy", folder, workers=2)
    assert 1e8 < memory.peak - memory.initial < 2e9, "all processes, without what was there before"
    (tmp_path / "big.npy").unlink()
    views = [camera(64, distance=d, azimuth=a) for d, a in ((1.3, 20), (0.3, 200))]
    with gv.Engine(gv.StoredProducer(folder), brick_pool="900 MB", node_pool="40 MB") as engine:
        expected = [engine.render(view, GRAY) for view in views]
        assert not any(engine.render(view, GRAY).stats.evicted["bricks"] for view in views)
    largest = max(picture.stats.bricks_used for picture in expected)
    assert largest * 1000 < 64e6
    for loading in ("straight", "levels"):
        options = {"brick_pool": int(1.3 * largest) * 1000, "node_pool": "4 MB", "loading": loading}
        with gv.Engine(gv.StoredProducer(folder, host_cache="40 MB"), **options) as engine:
            for view, picture in zip(views, expected, strict=True):
                assert_same_picture(engine.render(view, GRAY), picture)
            engine.validate()


def test_one_thread_reads_a_folder_and_four_a_url(whole, served):
    links = (whole, f"file://{whole}", f"{served}/cloud.zarr")
    assert [gv.StoredProducer(link).workers for link in links] == [1, 1, 4]
    assert gv.StoredProducer(whole, workers=3).workers == 3


def test_another_engine_may_use_it_after_the_first(whole):
    producer, pictures = gv.StoredProducer(whole), []
    for _ in range(2):
        with gv.Engine(producer) as engine:
            pictures.append(engine.render(VIEW, GRAY).color)
    assert torch.equal(*pictures)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: gv.StoredProducer(p / "none.zarr"), "none.zarr"),
        (lambda p: gv.StoredProducer(p, host_cache="x"), "host_cache must be bytes"),
        (lambda p: gv.StoredProducer(p, timeout=0), "timeout must be finite and > 0"),
        (lambda p: gv.StoredProducer(p, workers=0), "workers must be an int >= 1"),
    ],
)
def test_bad_arguments_are_named(tmp_path, call, message):
    with pytest.raises((ValueError, OSError)) as caught:
        call(tmp_path)
    assert message in str(caught.value) and "\n" not in str(caught.value)
