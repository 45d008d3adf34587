"""Label volumes: labels of any width are kept, and coarse levels hold the most frequent label."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.labels import SPACING, WIDE, kept, numbers

import gvtorch as gv
from gvtorch.base import labels as base
from gvtorch.base.downsample import pool_majority
from gvtorch.pool.pyramid import volume_levels

# --- what a volume keeps


@pytest.mark.parametrize(
    ("dtype", "low", "high"),
    [
        ("bool", 0, 1),
        ("uint8", 0, 255),
        ("int8", -128, 127),
        ("uint16", 0, 65535),
        ("int16", -32768, 32767),
        ("int32", -(2**31), 2**31 - 1),
        ("uint32", 0, 2**32 - 1),
        ("int64", -(2**63), 2**63 - 1),
        ("uint64", 0, 2**63 - 1),
        (">i4", -(2**31), 2**31 - 1),
        ("float64", -(2**53), 2**53),
    ],
)
def test_labels_of_every_dtype_are_kept_exactly(dtype, low, high):
    whole = np.array([low, high, high - 1, low + 1, 0, *range(min(20, high))]).astype(dtype)
    data = np.resize(whole, (5, 6, 7))
    volume = gv.Volume(data, labels=True)
    assert np.array_equal(kept(volume), data.astype(np.int64)) and volume.filter == "majority"
    narrow = np.dtype(dtype).itemsize <= 2
    assert (volume.label_values is None) == narrow
    assert volume.info.labels and volume.data.dtype.itemsize == (data.itemsize if narrow else 1)
    if not narrow:
        assert torch.equal(volume.label_values, torch.from_numpy(np.unique(data.astype(np.int64))))
    assert np.array_equal(kept(gv.read_volume(volume)), kept(volume))
    if np.dtype(dtype).isnative:
        again = gv.Volume(torch.from_numpy(data), info=gv.ImageInfo(labels=True))
        assert torch.equal(again.data, volume.data)


@pytest.mark.parametrize("count", [256, 257, 65536, 65537, 70000])
def test_as_few_bits_as_the_labels_need(count):
    data = np.arange(count).repeat(2)[: 2 * count].reshape(2, count, 1) * 7 + 2**40
    volume = gv.Volume(data, labels=True)
    assert volume.data.dtype == getattr(torch, base.index_dtype(count).name)
    assert volume.data.dtype.itemsize == (1 if count <= 256 else 2 if count <= 65536 else 4)
    assert np.array_equal(kept(volume), data)


def test_whole_floats_are_labels_and_nan_can_be_replaced():
    data = np.array([[[0.0, 3.0, np.nan, 2.0**60]]])
    volume = gv.Volume(data, labels=True, nan=0)
    assert kept(volume).tolist() == [[[0, 3, 0, 2**60]]]
    with pytest.raises(ValueError, match="must be whole numbers, got nan"):
        gv.Volume(data, labels=True)
    with pytest.raises(ValueError, match=r"must be whole numbers, got 0\.5"):
        gv.Volume(np.full((2, 2, 2), 0.5), labels=True)


def test_what_does_not_fit_is_one_clear_error():
    with pytest.raises(ValueError, match=r"below 2\^63, got 9223372036854775808: renumber them"):
        gv.Volume(np.full((2, 2, 2), 2**63, np.uint64), labels=True)
    with pytest.raises(ValueError, match="holds 16777217 labels or more, at most 16777216 fit"):
        base.check_count("Volume", 2**24 + 1)
    base.check_count("Volume", 2**24)
    for source in (np.zeros((2, 2, 2), complex), np.zeros(3, int), "labels", np.zeros((0, 2, 2))):
        with pytest.raises(ValueError, match="Volume: ") as caught:
            gv.Volume(source, labels=True)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("dtype", ["int32", "uint32", "int64", "uint64"])
def test_wide_integers_never_merge_in_silence(dtype):
    data = np.full((3, 3, 3), WIDE, dtype)
    for labels in (data, torch.from_numpy(data)):
        with pytest.raises(ValueError, match=r"16777217.*labels=True \(--labels\)") as caught:
            gv.Volume(labels)
        assert "\n" not in str(caught.value)
    assert gv.Volume(data - 1).data.unique().tolist() == [2**24]
    if dtype.startswith("int"):
        with pytest.raises(ValueError, match="-16777217"):
            gv.Volume(-data)
    assert gv.Volume(data.astype(np.float64)).data.unique().tolist() == [2**24]


# --- coarse levels


def brute_majority(values: np.ndarray, factor: int, background: float | None) -> np.ndarray:
    shape = [-(-n // factor) for n in values.shape[:3]]
    out = np.empty((*shape, values.shape[3]), values.dtype)
    for z, y, x, c in np.ndindex(out.shape):
        index = [
            np.minimum(np.arange(factor) + factor * block, n - 1)
            for block, n in zip((z, y, x), values.shape, strict=False)
        ]
        labels, counts = np.unique(values[..., c][np.ix_(*index)], return_counts=True)
        order = sorted(zip(-counts, labels == background, labels, strict=True))
        out[z, y, x, c] = order[0][2]
    return out


@pytest.mark.parametrize("background", [None, 0, 2])
@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32"])
@pytest.mark.parametrize("factor", [2, 3])
def test_majority_is_that_of_every_block(factor, dtype, background):
    for count, seed in ((2, 0), (4, 1), (40, 2)):
        values = numbers(9, 8, 11, 2, count=count, seed=seed).astype(dtype)
        values[:4] = values[0, 0, 0]  # blocks of one label
        actual = pool_majority(values, factor, background)
        assert actual.dtype == values.dtype
        assert np.array_equal(actual, brute_majority(values, factor, background))
        assert np.array_equal(actual[1:], pool_majority(values[factor:], factor, background))


def test_a_sheet_one_voxel_thick_stays():
    """Half of each block is background, at every level: ties are won by the foreground."""
    data = np.zeros((32, 32, 32), np.int64)
    data[13] = WIDE
    volume = gv.Volume(data, labels=True)
    for level in volume_levels(volume, 5, branching=2, brick_size=4, border=1):
        assert (level.values == 1).any((1, 2, 3)).sum() == 1 and level.values.max() == 1


def test_a_tree_holds_no_label_that_the_volume_has_not():
    volume = gv.Volume(
        numbers(21, 18, 25, count=9).astype(np.int64) ** 20 + 3, SPACING, labels=True
    )
    there = set(volume.data.unique().tolist())
    for branching, threshold in itertools.product((2, 3), (None, 3.0)):
        channels = {"label": volume, "value": gv.Volume(volume.data.float(), SPACING)}
        tree = gv.N3Tree.from_volume(channels, 4, branching=branching, threshold=threshold)
        assert set(tree.bricks.bricks["label"].unique().tolist()) <= there
        brick = tree.nodes.brick_tn < 0
        assert set(tree.nodes.constants["label"][brick].unique().tolist()) <= there


def test_a_threshold_is_not_for_labels():
    volume = gv.Volume(numbers(8, 8, 8), labels=True)
    for make in (gv.N3Tree.from_volume, gv.VolumeProducer):
        with pytest.raises(ValueError, match="threshold is for values; labels are hidden by"):
            make(volume, threshold=0)


def test_replacing_a_label_volume_keeps_its_filter():
    volume = gv.Volume(numbers(4, 4, 4), labels=True, info=gv.ImageInfo(unit="micrometer"))
    assert volume.info == replace(gv.ImageInfo(unit="micrometer"), labels=True)
