"""Voxel axes that are not parallel to the world's: resampled along these, or kept."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import Library
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import gvtorch as gv
from gvtorch.base.image_info import ImageInfo
from gvtorch.io.oblique import straighten
from gvtorch.io.reading import open_source
from gvtorch.io.source import MemorySource, place_axes
from gvtorch.io.stores.conversion import convert

nibabel = Library("nibabel")
SIZE = (14, 11, 9)  # voxels along the stored axes


def turn(degrees: tuple[float, float, float]) -> np.ndarray:
    """Returns the rotation about x, then y, then z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        cos, sin = np.cos(angle), np.sin(angle)
        a, b = [n for n in range(3) if n != axis]
        rotation = np.eye(3)
        rotation[a, a] = rotation[b, b] = cos
        rotation[a, b], rotation[b, a] = -sin, sin
        matrix = rotation @ matrix
    return matrix


def affine_of(degrees, spacing=(1.0, 1.0, 1.0), origin=(5.0, -7.0, 11.0)) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = turn(degrees) @ np.diag(spacing)
    affine[:3, 3] = origin
    return affine


def world_of(affine: np.ndarray, size=SIZE) -> np.ndarray:
    """Returns (i, j, k, 3): world positions of the stored voxels."""
    index = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), -1)
    return index @ affine[:3, :3].T + affine[:3, 3]


def centers(volume: gv.Volume) -> np.ndarray:
    """Returns (z, y, x, 3): world positions (x, y, z) of a volume's voxels."""
    axes = [
        np.arange(n) * s + o
        for n, s, o in zip(volume.extent, volume.spacing, volume.origin, strict=True)
    ]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack((x, y, z), -1)


def inner_index(volume: gv.Volume, affine: np.ndarray) -> np.ndarray:
    """Returns (z, y, x, 3): positions of its voxels in stored indices (i, j, k)."""
    return (centers(volume) - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T


def save(path: Path, data: np.ndarray, affine: np.ndarray) -> Path:
    nibabel.save(nibabel.Nifti1Image(data, affine), path)
    return path


def read(path: Path, **options) -> gv.Volume:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gv.read_volume(path, **options)


def assert_is_ramp(volume: gv.Volume, affine: np.ndarray, size, slope) -> None:
    """Asserts that inside the stored centres values are a linear function of the world."""
    index = inner_index(volume, affine)
    inside = ((index >= 0) & (index <= np.array(size) - 1)).all(-1)
    expected = centers(volume) @ slope + 3
    assert inside.sum() > 0.4 * np.prod(size)
    assert np.abs(volume.data[..., 0].numpy() - expected)[inside].max() < 1e-3


@pytest.mark.parametrize("ending", ["nii", "nii.gz", "nrrd"])
@pytest.mark.parametrize("degrees", [(0, 0, 30), (10, 20, 30), (45, 0, 0), (0, 90, 7)])
def test_a_linear_ramp_stays_at_its_place(tmp_path, ending, degrees):
    affine, slope = affine_of(degrees, (0.7, 1.0, 1.6)), np.array([0.5, -1.25, 2.0])
    data = (world_of(affine) @ slope + 3).astype(np.float32)
    path = tmp_path / f"a.{ending}"
    if ending == "nrrd":
        nrrd = pytest.importorskip("nrrd")
        header = {"space": "left-posterior-superior", "space directions": affine[:3, :3].T}
        nrrd.write(str(path), data, {**header, "space origin": affine[:3, 3]})
    else:
        affine = nibabel.load(save(path, data, affine)).affine  # rounded to float32
    volume = read(path)
    assert_is_ramp(volume, affine, SIZE, slope)
    low = np.array(volume.origin) - np.array(volume.spacing) / 2
    high = low + np.array(volume.spacing) * volume.extent
    corners = np.stack(np.meshgrid(*[(-0.5, n - 0.5) for n in SIZE], indexing="ij"), -1)
    positions = corners.reshape(-1, 3) @ affine[:3, :3].T + affine[:3, 3]
    assert (positions >= low - 1e-4).all() and (positions <= high + 1e-4).all(), "the whole box"
    assert (high - low <= np.ptp(positions, 0) + np.array(volume.spacing)).all(), "and no more"
    index = inner_index(volume, affine)
    outside = ((index < -0.51) | (index > np.array(SIZE) - 0.49)).any(-1)
    assert outside.any() and (volume.data[..., 0].numpy()[outside] == data.min()).all()


def test_as_torch_interpolates(tmp_path):
    affine = affine_of((12, -20, 33), (1.0, 0.8, 2.0))
    data = np.random.default_rng(3).normal(size=SIZE).astype(np.float32)
    volume = read(save(tmp_path / "a.nii", data, affine))
    index = inner_index(volume, nibabel.load(tmp_path / "a.nii").affine)
    unit = torch.from_numpy(2 * index / (np.array(SIZE) - 1) - 1)  # -1 to 1 between the centres
    values = torch.from_numpy(data.T.astype(np.float64))[None, None]
    expected = torch.nn.functional.grid_sample(
        values, unit[None], padding_mode="border", align_corners=True
    )[0, 0].numpy()
    inside = ((index > -0.499) & (index < np.array(SIZE) - 0.501)).all(-1)
    assert inside.sum() > 500
    assert np.abs(volume.data[..., 0].numpy() - expected)[inside].max() < 1e-4


def test_as_simpleitk_resamples(tmp_path):
    """Another library reads the same file at the same world positions."""
    sitk = pytest.importorskip("SimpleITK")
    affine = affine_of((25, 5, -40), (0.9, 1.1, 1.5))
    data = np.random.default_rng(4).integers(-900, 900, SIZE).astype(np.int16)
    path = save(tmp_path / "a.nii.gz", data, affine)
    volume, image = read(path), sitk.ReadImage(str(path))
    actual, expected = [], []
    positions = centers(volume)
    index = inner_index(volume, affine)
    inside = ((index > 0.01) & (index < np.array(SIZE) - 1.01)).all(-1)
    for voxel in np.argwhere(inside)[::23]:
        x, y, z = positions[tuple(voxel)]
        itk_index = image.TransformPhysicalPointToContinuousIndex((-x, -y, z))  # ITK's world is LPS
        expected.append(image.EvaluateAtContinuousIndex(itk_index, sitk.sitkLinear))
        actual.append(float(volume.data[(*voxel, 0)]))
    assert len(actual) > 20 and np.abs(np.subtract(actual, expected)).max() <= 0.51, "rounded"


def test_steps_are_as_long_as_voxels_in_their_direction():
    shape = (40, 40, 10)
    fields = place_axes("a", affine_of((5, 0, 0), (0.5, 0.5, 5)), shape)
    source = MemorySource.of(np.zeros((10, 40, 40, 1), np.int16), path="a")
    fields.pop("axes")
    with pytest.warns(UserWarning, match=r"turned by 5 degrees: resampled .*oblique='keep'"):
        straightened = straighten(source.__class__(**{**vars(source), **fields}))
    x, y, z = straightened.spacing
    assert x == 0.5 and y == pytest.approx(0.502, abs=1e-3) and 3 < z < 5
    with pytest.warns(UserWarning, match="45 degrees"):
        fields = place_axes("a", affine_of((0, 45, 0), (2, 2, 2)), shape)
        fields.pop("axes")
        straightened = straighten(source.__class__(**{**vars(source), **fields}))
    assert straightened.spacing == pytest.approx((2, 2, 2))


def test_one_line_tells_and_keep_keeps(tmp_path):
    data = np.random.default_rng(0).integers(0, 99, SIZE).astype(np.int16)
    path = save(tmp_path / "a.nii", data, affine_of((0, 0, 37)))
    with pytest.warns(UserWarning) as caught:
        volume = gv.read_volume(path)
    x, y, z = volume.extent
    assert [str(warning.message) for warning in caught] == [
        f"a.nii: voxel axes are turned by 37 degrees: resampled along the world's axes, "
        f"{x}x{y}x{z} voxels of 1 x 1 x 1; oblique='keep' (--oblique keep) keeps the voxels as "
        "they are"
    ]
    with pytest.warns(UserWarning, match="turned by 37 degrees: kept"):
        kept = gv.read_volume(path, oblique="keep")
    assert np.array_equal(kept.data[..., 0].numpy(), data.T)
    assert kept.spacing == pytest.approx((1, 1, 1))
    with pytest.raises(ValueError, match="oblique must be 'resample' or 'keep', got 'skip'"):
        gv.read_volume(path, oblique="skip")
    with pytest.raises(ValueError, match="leave spacing out"):
        gv.read_volume(path, spacing=(1, 1, 1))


def test_a_tilt_of_less_than_half_a_voxel_is_none(tmp_path):
    data = np.zeros((64, 64, 64), np.uint8)
    small = affine_of((0, 0, 0.3))  # 63 * sin 0.3 degrees is a third of a voxel
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert gv.read_volume(save(tmp_path / "a.nii", data, small)).extent == (64, 64, 64)
    with pytest.warns(UserWarning, match="turned by 0.6 degrees"):
        gv.read_volume(save(tmp_path / "b.nii", data, affine_of((0, 0, 0.6))))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    degrees=st.tuples(*[st.floats(-180, 180)] * 3),
    spacing=st.tuples(*[st.floats(0.3, 3)] * 3),
    seed=st.integers(0, 99),
    labels=st.booleans(),
)
def test_regions_have_the_bits_of_the_whole(degrees, spacing, seed, labels):
    rng = np.random.default_rng(seed)
    data = rng.integers(0, 200, (6, 7, 8, 2)).astype(np.uint8)
    fields = place_axes("a", affine_of(degrees, spacing), (8, 7, 6))
    if fields["oblique"] is None:
        return
    fields.pop("axes")
    source = MemorySource.of(data, path="a", info=ImageInfo(labels=labels))
    with pytest.warns(UserWarning, match="turned by"):
        straightened = straighten(type(source)(**{**vars(source), **fields}))
    whole = straightened.read_times(0, 1)[0]
    assert whole.dtype == np.uint8 and whole.shape == (*straightened.extent[::-1], 2)
    assert set(np.unique(whole)) <= ({0, *np.unique(data)} if labels else set(range(200)))
    straightened = pickle.loads(pickle.dumps(straightened))
    for _ in range(8):
        low = [int(rng.integers(0, n)) for n in whole.shape[:3]]
        high = [int(rng.integers(a, n)) + 1 for a, n in zip(low, whole.shape[:3], strict=True)]
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        assert np.array_equal(straightened.read_region(low, high), whole[box])


def test_labels_are_never_blended(tmp_path):
    affine = affine_of((15, 25, 35))
    data = np.where(np.indices(SIZE).sum(0) % 5 < 2, 40, 200).astype(np.uint8)
    image = nibabel.Nifti1Image(data, affine)
    image.header.set_intent("label")
    nibabel.save(image, tmp_path / "labels.nii")
    volume = read(tmp_path / "labels.nii")
    assert volume.info.labels and set(np.unique(volume.data)) == {0, 40, 200}
    index = inner_index(volume, affine)
    inside = ((index > -0.49) & (index < np.array(SIZE) - 0.51)).all(-1)
    i, j, k = (np.floor(index[..., n] + 0.5).clip(0, SIZE[n] - 1).astype(int) for n in range(3))
    tie = np.abs(index - np.floor(index) - 0.5).min(-1) < 1e-4
    sure = inside & ~tie
    assert np.array_equal(volume.data[..., 0].numpy()[sure], data[i, j, k][sure])


def test_only_what_is_needed_is_read(tmp_path, monkeypatch):
    """Only a region's part of the inner source; all of it, once, for a packed file."""
    data = np.random.default_rng(0).integers(0, 99, (64, 64, 64)).astype(np.int16)
    path = save(tmp_path / "a.nii", data, affine_of((0, 0, 30)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        source = open_source(path)
    seen = []
    original = MemorySource.read_box

    def count(self, low, high, times):
        if not hasattr(self, "inner"):
            seen.append(int(np.prod(np.subtract(high, low))))
        return original(self, low, high, times)

    monkeypatch.setattr("gvtorch.io.source.VolumeSource.read_box", count)
    x, y, z = (n // 2 for n in source.extent)
    source.read_region((z, y, x), (z + 8, y + 8, x + 8))
    assert len(seen) == 1 and seen[0] < 8 * 15 * 15


def test_convert_resamples_as_read_volume_does(tmp_path):
    data = np.random.default_rng(5).integers(0, 255, (60, 50, 70)).astype(np.uint8)
    for ending in ("nii", "nii.gz"):
        path = save(tmp_path / f"a.{ending}", data, affine_of((8, 0, 21), (1, 1, 2)))
        volume = read(path)
        with pytest.warns(UserWarning, match="resampled"):
            store = convert(path, tmp_path / f"{ending}.zarr")
        assert store.spacing == pytest.approx(volume.spacing)
        assert store.origin == pytest.approx(volume.origin)
        actual = store.read_region(0, (0, 0, 0), store.extent[::-1])
        assert np.array_equal(actual, volume.data.numpy())
    with pytest.warns(UserWarning, match="kept"):
        store = convert(path, tmp_path / "kept.zarr", oblique="keep")
    assert store.extent == (60, 50, 70)


def test_times_of_a_turned_image(tmp_path):
    affine = affine_of((0, 30, 0))
    data = np.random.default_rng(5).integers(0, 255, (*SIZE, 3)).astype(np.uint8)
    for ending in ("nii", "nii.gz"):
        path = save(tmp_path / f"a.{ending}", data, affine)
        with pytest.warns(UserWarning, match="resampled"):
            convert(path, tmp_path / f"{ending}.zarr")
        for time in range(3):
            alone = save(tmp_path / "alone.nii", data[..., time].copy(), affine)
            actual = gv.Store.open(tmp_path / f"{ending}.zarr", time=time)
            values = actual.read_region(0, (0, 0, 0), actual.extent[::-1])
            expected = read(alone).data.numpy()
            same = values == expected
            fill = (values == data[..., 0].min()) & (expected == data[..., time].min())
            assert (same | fill).all() and same.mean() > 0.5
