"""Windows: the range of values that is shown, from the data's histogram."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import SHARED, shared

import gvtorch as gv
from gvtorch.io.window import _SAMPLE_VOXELS, value_range
from gvtorch.tools.parse import parse_transfer

FILES = [
    "aneurism_256x256x256_uint8.raw.gz",
    "hdz2000_128_uint8.npy.bz2",
    "hydrogen_atom_128x128x128_uint8.raw.gz",
    "l1448_13co_105x105x53_float32.fits.gz",
    "mni_icbm152_t1_197x233x189_uint8.nii.gz",
    "stent_256x128x128_int16.npz",
    "tooth_103x94x161_uint8.raw.gz",
    "vismale_128x256x256_uint8.raw.gz",
]
#: Presets that show whole objects; `bone` and `tissue` show only dense parts.
SENSIBLE = ["gray", "hot", "vessels", "viridis"]
DENSE = ["mni", "stent", "tooth", "vismale"]


def noise(shape: tuple[int, ...] = (20, 30, 40)) -> np.ndarray:
    return np.random.default_rng(7).normal(size=shape).astype(np.float32)


@pytest.mark.backend("cpp")
@pytest.mark.filterwarnings("ignore:.*not kept. world coordinates")
@pytest.mark.parametrize("name", FILES)
def test_every_shared_volume_shows_at_once(name):
    """More than 5 % (other presets than gray: 3 %) and less than 90 % of all pixels show something,
    and 5 to 95 % of those that the box covers; and the picture is bright.
    """
    volume = gv.read_volume(shared(f"volumes/{name}"))
    tree = gv.N3Tree.from_volume(volume)
    camera = gv.Camera.orbit(fit=True, width=192, height=192)
    box = gv.render(tree, camera, gv.TransferFunction([(0, 1)])).alpha > 0.05
    for preset in SENSIBLE + ["bone", "tissue"] * name.startswith(tuple(DENSE)):
        picture = gv.render(tree, camera, parse_transfer(preset, None, volume, 0))
        seen = picture.alpha > 0.05
        share, inside = (float(part) for part in (seen.float().mean(), seen.sum() / box.sum()))
        fewest = 0.05 if preset == "gray" else 0.03
        assert fewest < share < 0.9 and 0.05 < inside < 0.95, (preset, share, inside)
        bright = float(picture.color[seen[..., 0]].amax(-1).quantile(0.95))
        assert bright > 0.2, (preset, bright)


def test_shared_files_are_all_named():
    folder = SHARED / "volumes"
    if folder.is_dir():
        assert sorted(file.name for file in folder.iterdir()) == FILES


def test_a_hot_voxel_changes_nothing_much():
    data = np.abs(noise())
    plain = gv.window(gv.Volume(data))
    data[3, 4, 5] = 1e6
    assert gv.window(gv.Volume(data)) == pytest.approx(plain, rel=0.02)
    assert plain[1] < 4 and gv.Volume(data).value_range[1] == 1e6


@pytest.mark.parametrize("air", [0.0, -1000.0, 3.7])
@pytest.mark.parametrize("spread", [0.0, 5.0])
def test_the_background_is_left_out(air, spread):
    """With 1,000 values of matter and 23,000 of air, whether air is one number or noise."""
    data = air + spread * noise()
    flat = data.ravel()
    flat[::24] = air + np.linspace(100, 300, 1000)
    low, high = gv.window(gv.Volume(data))
    assert air <= low < air + 25 and air + 295 < high <= air + 300
    dark, bright = gv.window(gv.Volume(data), background=True)
    assert bright == high and dark <= air + 1e-6
    assert gv.window(gv.Volume(data), (0, 50))[1] < air + 10


def test_percentiles_are_those_of_numpy():
    data = noise()
    for percent in ((0, 100), (5, 80.5)):
        actual = gv.window(gv.Volume(data), percent)
        assert actual == pytest.approx(np.percentile(data, percent))


def test_flat_data_and_components():
    flat = gv.window(gv.Volume(np.full((4, 5, 6), 9, np.uint8)))
    assert flat == (9, 10)
    two = np.stack((noise(), 100 + noise()), -1)
    volume = gv.Volume(two)
    assert gv.window(volume)[1] < 5 and gv.window(volume, component=1)[0] > 95
    with pytest.raises(ValueError, match="component must be an int >= 0 and <= 1"):
        gv.window(volume, component=2)
    with pytest.raises(ValueError, match="percent must be a low and a high one"):
        gv.window(volume, (60, 40))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.uint16, torch.int8])
def test_every_dtype(dtype):
    data = torch.arange(6 * 7 * 8).reshape(6, 7, 8) % 100
    low, high = gv.window(gv.Volume(data.to(torch.int32).to(dtype)), (0, 100))
    assert (low, high) == (0, 99)


def test_a_volume_and_its_store_have_one_window(tmp_path, monkeypatch):
    """Also where only a coarse level, or boxes of a file, are sampled."""
    data = np.abs(noise((50, 60, 70)))
    np.save(tmp_path / "a.npy", data)
    store = gv.convert(tmp_path / "a.npy", tmp_path / "a.zarr", workers=1)
    volume = gv.read_volume(tmp_path / "a.npy")
    assert gv.window(store) == gv.window(volume)
    fine = gv.window(volume, (5, 95))
    read = []
    plain = gv.Store.read_region
    monkeypatch.setattr(
        gv.Store, "read_region", lambda s, *a, **k: read.append(a) or plain(s, *a, **k)
    )
    monkeypatch.setattr("gvtorch.io.window._SAMPLE_VOXELS", 40_000)
    assert gv.window(store) == gv.window(volume) != fine
    assert [level for level, *_ in read] == [1]
    monkeypatch.setattr(gv.Store, "stored_level", lambda self, level: 0)
    read.clear()
    assert gv.window(store, (5, 95)) == pytest.approx(fine, rel=0.05)
    voxels = sum(np.prod(np.subtract(high, low)) for _, low, high in read)
    assert len(read) == 64 and 20_000 < voxels <= 40_000
    assert {level for level, *_ in read} == {0}


def test_a_foreign_image_of_one_level_is_read_in_part(tmp_path, monkeypatch):
    zarr = pytest.importorskip("zarr")
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    group.create_array("0", data=np.abs(noise((40, 40, 40))), chunks=(16, 16, 16))
    group.attrs["multiscales"] = [
        {
            "version": "0.4",
            "axes": [{"name": n, "type": "space"} for n in "zyx"],
            "datasets": [
                {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": [1, 1, 1]}]}
            ],
        }
    ]
    store = gv.Store.open(tmp_path / "a.zarr")
    monkeypatch.setattr("gvtorch.io.window._SAMPLE_VOXELS", 8_000)
    assert store.stored_level(store.levels - 1) == 0
    low, high = value_range(store)
    assert 0 <= low < 0.01 and 3 < high < 6
    expected = np.percentile(np.abs(noise((40, 40, 40))), (5, 95))
    assert gv.window(store, (5, 95)) == pytest.approx(expected, rel=0.15)


def test_names_in_hounsfield_units_where_a_scan_has_them():
    data = 1000 * noise()
    scan = gv.Volume(data, info=gv.ImageInfo(quantity="HU"))
    for name, preset in (("bone", "ct-bone"), ("tissue", "ct-soft"), ("vessels", "ct-vessels")):
        expected = gv.TransferFunction.preset(preset)
        for text in (None, "auto"):
            assert np.array_equal(parse_transfer(name, text, scan, 0).opacity, expected.opacity)
        spanned = parse_transfer(name, "-100,500", scan, 0).corners()[:2]
        assert spanned == (-100, 500)
        assert parse_transfer(name, None, gv.Volume(data), 0).corners()[0] != expected.corners()[0]
        assert np.array_equal(
            parse_transfer(preset, None, gv.Volume(data), 0).opacity, expected.opacity
        )
    assert parse_transfer("ct-lung", "full", scan, 0).corners()[:2] == scan.value_range


def test_files_keep_their_values_unless_a_window_is_given(tmp_path):
    transfer = gv.TransferFunction([(5, 0), (7, 1)], [(5, 0, 0, 0), (7, 1, 0, 0)])
    transfer.save(tmp_path / "own.json")
    (tmp_path / "pv.json").write_text('[{"Name": "a b", "RGBPoints": [0,0,0,0, 1,1,1,1]}]')
    volume = gv.Volume(noise())
    for name in (f"{tmp_path}/own.json",):
        assert parse_transfer(name, None, volume, 0).corners()[:2] == (5, 7)
        assert parse_transfer(name, "1,2", volume, 0).corners()[:2] == (1, 2)
    for name in (f"{tmp_path}/pv.json", f"{tmp_path}/pv.json:a b"):
        expected = gv.window(volume)
        assert parse_transfer(name, None, volume, 0).corners()[:2] == pytest.approx(expected)


def test_bounded():
    assert _SAMPLE_VOXELS <= 2**23
