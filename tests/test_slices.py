"""Planes of voxels as pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import gvtorch

import gvtorch as gv
from gvtorch.pictures.letters import _GLYPH_ROWS


@pytest.fixture(scope="module")
def volume() -> gv.Volume:
    values = np.random.default_rng(1).integers(0, 256, (14, 12, 10)).astype(np.uint8)
    info = gv.ImageInfo(unit="millimeter")
    return gv.Volume(values, (1, 1, 2), (5, 0, -4), info=info)


@pytest.fixture(scope="module")
def store(volume, tmp_path_factory):
    folder = tmp_path_factory.mktemp("slices")
    np.save(folder / "a.npy", volume.data[..., 0].numpy())
    placement = {"spacing": volume.spacing, "origin": volume.origin}
    return gv.convert(folder / "a.npy", folder / "a.zarr", **placement, workers=1)


def numbers(picture: gv.Picture) -> np.ndarray:
    """Returns the sRGB numbers of a gray picture."""
    pixels = picture.to_srgb8().numpy()
    assert (pixels[..., :1] == pixels).all()
    return pixels[..., 0]


def test_a_voxel_is_its_own_number(volume, store):
    """Across each axis; across z, rows run down, else z is up; pixels are as long as voxels."""
    zyx = volume.data[..., 0].numpy()
    for data in (volume, store):
        cut = {a: numbers(gv.slice_picture(data, a, 3, span=(0, 255))) for a in "xyz"}
        assert np.array_equal(cut["z"], zyx[3])
        assert np.array_equal(cut["y"], zyx[::-1, 3].repeat(2, 0))
        assert np.array_equal(cut["x"], zyx[::-1, :, 3].repeat(2, 0))
        turned = gv.slice_picture(data, "x", 3, span=(0, 255), up="-y", scale=2)
        assert np.array_equal(numbers(turned), zyx[:, :, 3].T.repeat(2, 0).repeat(4, 1))


def test_three_planes_in_line(volume):
    zyx = volume.data[..., 0].numpy()
    picture = numbers(gv.slice_picture(volume, "all", (1, "50%", 13), span=(0, 255)))
    assert picture.shape == (28 + 4 + 12, 10 + 4 + 12)
    assert np.array_equal(picture[:28, :10], zyx[::-1, 6].repeat(2, 0))
    assert np.array_equal(picture[:28, 14:], zyx[::-1, :, 1].repeat(2, 0))
    assert np.array_equal(picture[32:, :10], zyx[13])
    assert not picture[28:32].any() and not picture[32:, 10:].any()


@pytest.mark.parametrize(
    ("position", "index"),
    [
        *[(0.0, 0), (0.5, 7), (1.0, 13), (5, 5), ("50%", 7), ("13", 13), ("-4mm", 0)],
        *[("-3.1mm", 0), ("-2.9 mm", 1), ("0.2cm", 3), ("-2000um", 1)],
        *[("-2000 \u00b5m", 1), ("-2000\u03bcm", 1), (np.float32(0.5), 7), (np.int8(5), 5)],
    ],
)
def test_places(volume, position, index):
    picture = gv.slice_picture(volume, "z", position, span=(0, 255))
    assert np.array_equal(numbers(picture), volume.data[index, ..., 0].numpy())


def test_a_coarse_level_is_that_of_the_store(store):
    level = store.read_region(1, (0, 0, 0), store.level_extent(1)[::-1])[..., 0]
    picture = gv.slice_picture(store, "z", 7, level=1, span=(0, 255))
    assert np.array_equal(numbers(picture), level[3])


def test_a_store_is_read_in_the_plane_alone(store, monkeypatch):
    read = []
    plain = gv.Store.read_region
    monkeypatch.setattr(
        gv.Store, "read_region", lambda s, *a, **k: read.append(a) or plain(s, *a, **k)
    )
    gv.slice_picture(store, "y", 5, span=(0, 255))
    assert read == [(0, [0, 5, 0], [14, 6, 10])]


def test_colours_and_components():
    data = torch.zeros(2, 3, 4, 2)
    data[0, 1, 2, 1] = 1
    volume = gv.Volume(data)
    colors = gv.TransferFunction([(0, 0)], [(0, 0, 0, 1), (1, 1, 0.5, 0)])
    picture = gv.slice_picture(volume, "z", 0, colors=colors, component=1)
    assert picture.color[1, 2].tolist() == [1, 0.5, 0] and picture.alpha.min() == 1
    assert (picture.color.sum((0, 1)) == torch.tensor([1, 0.5, 11])).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axis": "w"}, "axis must be 'x', 'y', 'z' or 'all'"),
        ({"position": 1.5}, "position must be finite and >= 0 and <= 1"),
        ({"position": 14}, "position along z must be an int >= 0 and <= 13"),
        ({"position": "here"}, "position must be a share such as 50%"),
        ({"position": "99mm"}, "99mm lies beyond the data, z is -5 to 23 millimeter"),
        ({"position": "-1e400mm"}, "-1e400mm lies beyond the data"),
        ({"colors": lambda v: v}, r"colors must return red, green, blue .*, got \(12, 10\) of"),
        ({"colors": lambda v: None}, "colors must return red, green, blue"),
        ({"colors": lambda v: np.zeros((*v.shape, 2))}, "colors must return red, green, blue"),
        ({"position": ("1", "2", "3")}, "position must be one for"),
        ({"axis": "all", "position": (0.5, 0.5)}, "position must be one or three, for x, y and z"),
        ({"up": "+z"}, r"up must be \+y, -y, \+x or -x across z"),
        ({"axis": "all", "up": "+z"}, "up is for one plane"),
        ({"level": 1}, "level is for stores"),
        ({"component": 1}, "component must be an int >= 0 and <= 0"),
        ({"scale": 0}, "scale must be finite and > 0"),
        ({"scale": 6e4}, "pixels are more than 65536"),
        ({"scale": 1e308}, "scale must be finite and > 0 and <= 65536"),
        ({"span": (0, 1), "colors": gv.TransferFunction([(0, 1)])}, "span is for grays"),
    ],
)
def test_mistakes(volume, options, message):
    with pytest.raises(ValueError, match=message):
        gv.slice_picture(volume, **options)


def test_the_command(volume, store, tmp_path):
    file = tmp_path / "a.npy"
    np.save(file, volume.data[..., 0].numpy())
    for path, flags in ((file, ("--spacing", "1,1,2")), (store.location, ())):
        out = tmp_path / "s.png"
        run = gvtorch(
            "slice", path, *flags, "--axis", "y", "--position", "3", "--window", "0,255", "-o", out
        )
        assert run.returncode == 0, run.stderr
        assert "10x28" in run.stdout
        actual = gv.pictures.read_files._read_png(out)[..., 0]
        assert np.array_equal(actual, volume.data.numpy()[::-1, 3, :, 0].repeat(2, 0))
        run = gvtorch("slice", path, *flags, "--axis", "all", "--position", "1,50%,2", "-o", out)
        assert run.returncode == 0, run.stderr
        viridis = gvtorch("slice", path, *flags, "--tf", "viridis", "-o", tmp_path / "v.png")
        assert viridis.returncode == 0, viridis.stderr
        colors = gv.pictures.read_files._read_png(tmp_path / "v.png")
        assert (colors.max((0, 1)) > 100).all() and (colors[..., 0] != colors[..., 1]).any()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--position", "1,2"], "--position must be one, or three"),
        (["--axis", "all", "--position", "1,2"], "--position must be one, or three"),
        (["--level", "1"], "--level is for stores; make one"),
        (["--image", "a"], "--image is for stores"),
        (["--window", "3,2"], "--window must be LO,HI with LO < HI"),
        (["--window", "3%,2"], "--window must be LO,HI with LO < HI"),
        (["--window", "wide"], "--window must be LO,HI, P%,P%, auto or full"),
        (["--window", "9%,2%"], "percent must be a low and a high one"),
        (["--axis", "w"], "invalid choice"),
    ],
)
def test_flags_that_do_nothing_or_are_wrong(volume, tmp_path, flags, message):
    np.save(tmp_path / "a.npy", volume.data[..., 0].numpy())
    run = gvtorch("slice", tmp_path / "a.npy", "-o", tmp_path / "a.png", *flags)
    assert run.returncode == 2 and len(run.stderr.splitlines()) == 1, run.stderr
    assert message in run.stderr and not (tmp_path / "a.png").exists()


def patient(space: str | None) -> gv.Volume:
    """Returns a volume whose numbers encode a voxel's position: z, y, x."""
    values = np.arange(48 * 50 * 52, dtype=np.float32).reshape(48, 50, 52)
    return gv.Volume(values, info=gv.ImageInfo(space=space))


RAS, LPS = "right-anterior-superior", "left-posterior-superior"


def test_patients_are_seen_as_radiologists_see_them():
    """Front, or head, up; the patient's right on the left, in a sagittal plane the front."""
    values = patient(RAS).data[..., 0].numpy()
    for space, data in ((RAS, values), (LPS, values[:, ::-1, ::-1])):  # the same patient
        volume = gv.Volume(data.copy(), info=gv.ImageInfo(space=space))
        mid = {"x": 20, "y": 20, "z": 20} if space == RAS else {"x": 31, "y": 29, "z": 20}
        span = (0, float(values.max()))
        cut = {
            n: gv.slice_picture(volume, n, p, span=span, radiological=True).color[..., 0].numpy()
            for n, p in mid.items()
        }
        grays = gv.slice_picture(patient(None), "z", 0, span=span)  # any: only the order counts
        assert grays.color.shape[:2] == (50, 52)

        def order(image: np.ndarray) -> np.ndarray:
            return image.ravel().argsort().argsort()

        assert np.array_equal(order(cut["z"]), order(values[20, ::-1, ::-1])), space
        assert np.array_equal(order(cut["y"]), order(values[::-1, 20, ::-1])), space
        assert np.array_equal(order(cut["x"]), order(values[::-1, ::-1, 20])), space


def test_letters_stand_at_the_edges_and_nowhere_else():
    options = {"span": (0, 1e6), "radiological": True}
    plain = gv.slice_picture(patient(RAS), "z", 0, **options).color
    drawn = gv.slice_picture(patient(RAS), "z", 0, **options, letters=True).color
    changed = (plain != drawn).any(2)
    for edge in (changed[:12], changed[-12:], changed[:, :12], changed[:, -12:]):
        assert edge.any()
    assert not changed[14:-14, 14:-14].any()
    small = gv.Volume(np.zeros((9, 9, 9), np.float32), info=gv.ImageInfo(space=RAS))
    assert not gv.slice_picture(small, **options, letters=True).color.any()


def test_letters_of_three_planes_have_one_size():
    """Also if one of the planes is narrow: a dot is a pixel, as for the narrowest."""
    body = gv.Volume(np.zeros((330, 330, 60), np.float32), info=gv.ImageInfo(space=RAS))
    image = gv.slice_picture(body, "all", 0.5, span=(0, 1), radiological=True, letters=True).color
    dots = {name: sum(row.bit_count() for row in rows) for name, rows in _GLYPH_ROWS.items()}
    white = (image == 1).all(2)
    coronal, sagittal, axial = white[:330, :60], white[:330, 64:], white[334:, :60]
    for plane, letters in ((coronal, "SLIR"), (sagittal, "SPIA"), (axial, "ALPR")):
        assert int(plane.sum()) == sum(dots[letter] for letter in letters)


def test_labels_have_the_colours_of_labels(tmp_path):
    """Also wide ones, of which voxels hold indices; the command leaves the background black."""
    labels = np.zeros((3, 4, 5), np.int64)
    labels[0, 1], labels[0, 2] = 70000, 2**40
    volume = gv.Volume(labels, labels=True)
    looks = gv.Labels({70000: (1.0, 0.0, 0.0)})
    plane = gv.slice_picture(volume, "z", 0, colors=looks).color
    assert torch.equal(plane[1], torch.tensor([[1.0, 0.0, 0.0]]).expand(5, 3))
    assert np.allclose(plane[2].numpy(), looks(np.array([2**40]))[0, :3])
    gv.convert(volume, tmp_path / "l.zarr")
    out = tmp_path / "a.npz"
    assert gvtorch("slice", tmp_path / "l.zarr", "-o", out, "--position", "0").returncode == 0
    drawn = np.load(out)["color"]
    assert np.allclose(drawn[1:3, 0], gv.Labels()(labels[0, 1:3, 0])[:, :3])
    assert not drawn[0].any() and not drawn[3].any()


@pytest.mark.parametrize(
    ("space", "options", "message"),
    [
        (None, {"radiological": True}, "does not say where its axes point"),
        ("right-left-superior", {"radiological": True}, "does not say where its axes point"),
        (RAS, {"radiological": True, "up": "+y"}, "a fixed up"),
        (RAS, {"letters": True}, "letters are for radiological planes"),
    ],
)
def test_views_that_can_not_be_are_refused(space, options, message):
    with pytest.raises(ValueError, match=message):
        gv.slice_picture(patient(space), **options)


def test_the_command_shows_patients(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    data = patient(RAS).data[..., 0].numpy().T
    nibabel.save(nibabel.Nifti1Image(data, np.eye(4)), tmp_path / "a.nii")
    out = tmp_path / "a.png"
    run = gvtorch("slice", tmp_path / "a.nii", "-o", out)
    assert run.returncode == 0 and "axial: right is on the left" in run.stdout
    run = gvtorch("slice", tmp_path / "a.nii", "-o", tmp_path / "c.png", "--axis", "all")
    assert run.returncode == 0
    assert "coronal and axial: right is on the left, sagittal: front is on the left" in run.stdout
    run = gvtorch("slice", tmp_path / "a.nii", "-o", tmp_path / "b.png", "--plain")
    assert run.returncode == 0 and out.read_bytes() != (tmp_path / "b.png").read_bytes()


def test_a_picture_larger_than_memory_is_refused_before_it_is_made(monkeypatch):
    volume = gv.Volume(torch.rand(4, 64, 64))
    monkeypatch.setattr("os.sysconf", lambda _: 1000)
    with pytest.raises(ValueError, match="slice_picture: the picture takes"):
        gv.slice_picture(volume, scale=10, span=(0, 1))
