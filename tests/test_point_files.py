"""Files of points: those of other libraries, errors and warnings in one line, and stores."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import gvtorch, shared
from helpers.damage import break_file
from helpers.stores import stopped_at

import gvtorch as gv
from gvtorch.io.stores.store_layout import WORK
from gvtorch.points.splat import region

RANDOM = np.random.default_rng(7)
COUNT = 500
PLACE = RANDOM.uniform(-3, 5, (COUNT, 3)).astype(np.float32)
MASS = RANDOM.uniform(0.1, 9, COUNT).astype(np.float32)
RADIUS = RANDOM.uniform(0, 0.4, COUNT).astype(np.float32)
RGB = RANDOM.integers(0, 256, (COUNT, 3)).astype(np.uint8)
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def write_ply(path, layout="binary_little_endian"):
    """Writes x y z, mass as double, colours as bytes, radius; a camera before, faces after."""
    names = [("x", "float"), ("y", "float"), ("z", "float"), ("mass", "double")]
    names += [(name, "uchar") for name in ("red", "green", "blue")] + [("radius", "float32")]
    order = ORDERS.get(layout, "<")
    kinds = [
        (n, order + {"float": "f4", "double": "f8", "uchar": "u1", "float32": "f4"}[k])
        for n, k in names
    ]
    rows = np.zeros(COUNT, kinds)
    for axis, name in enumerate("xyz"):
        rows[name] = PLACE[:, axis]
    rows["mass"], rows["radius"] = MASS, RADIUS
    for axis, name in enumerate(("red", "green", "blue")):
        rows[name] = RGB[:, axis]
    head = ["ply", f"format {layout} 1.0", "comment made by hand"]
    if layout != "ascii":
        head += ["element camera 2", "property short a", "property uchar b"]
    head += [f"element vertex {COUNT}", *(f"property {k} {n}" for n, k in names)]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    if layout == "ascii":
        body = "\n".join(" ".join(repr(v.item()) for v in row) for row in rows) + "\n3 0 1 2\n"
        path.write_bytes("\n".join(head).encode() + b"\n" + body.encode())
    else:
        faces = b"\3" + np.arange(3, dtype=order + "i4").tobytes()
        path.write_bytes("\n".join(head).encode() + b"\n" + bytes(6) + rows.tobytes() + faces)
    return path


def write_npz(path):
    np.savez(path, position_pc=PLACE, mass=MASS, rgb=RGB, radius=RADIUS, note=np.arange(3))
    return path


def write_fits(path):
    table = pytest.importorskip("astropy.table", reason="astropy is not installed")
    content = {"x": PLACE[:, 0], "Y": PLACE[:, 1], "z": PLACE[:, 2], "Mass": MASS}
    content |= {"rgb": RGB, "RADIUS": RADIUS, "name": np.array(["star"] * COUNT)}
    table.Table(content).write(path)
    return path


WRITERS = {
    "a.npz": write_npz,
    "a.fits": write_fits,
    "little.ply": write_ply,
    "big.ply": lambda path: write_ply(path, "binary_big_endian"),
    "text.ply": lambda path: write_ply(path, "ascii"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_is_read_whole_and_in_parts(tmp_path, name):
    path = WRITERS[name](tmp_path / name)
    points = gv.read_points(path)
    assert np.array_equal(points.positions, PLACE)
    assert np.allclose(points.values[:, 0], MASS, rtol=1e-7)
    assert np.array_equal(points.radius, RADIUS)
    srgb = RGB / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    assert np.allclose(points.colors, linear)
    parts = list(gv.PointFile(path).blocks(120))
    assert [len(part) for part in parts] == [120, 120, 120, 120, 20]
    assert np.array_equal(np.concatenate([part.positions for part in parts]), PLACE)


def test_other_libraries_wrote_them(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    colors = np.concatenate((RGB, np.full_like(RGB[:, :1], 255)), 1)
    for encoding in ("binary", "ascii"):
        path = tmp_path / f"{encoding}.ply"
        cloud = trimesh.PointCloud(PLACE, colors=colors)
        path.write_bytes(trimesh.exchange.ply.export_ply(cloud, encoding=encoding))
        points = gv.read_points(path)
        assert np.allclose(points.positions, PLACE, atol=1e-5)
        assert points.colors[RGB == 255] == pytest.approx(1)


def test_real_stars_are_read():
    path = shared("points/hyg_stars_107857.npz")
    points = gv.read_points(path)
    assert len(points) == 107_857 and np.abs(points.positions).max() < 979
    assert points.values.max() == pytest.approx(67_484, rel=1e-4) and points.colors is None


def test_what_may_be_meant_is_asked_for(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, place=PLACE, mass=MASS, flux=MASS * 2, u=MASS, v=MASS, w=MASS)
    with pytest.raises(ValueError, match=r"which columns are positions\? It has place \(3\), mass"):
        gv.read_points(path)
    with pytest.raises(ValueError, match="mass or flux may be its values: say which"):
        gv.read_points(path, positions="place")
    points = gv.read_points(path, positions="u,v,w", values=["flux", "mass"], radius=0.5)
    assert points.values.shape == (COUNT, 2) and (points.values[:, 0] == 2 * MASS).all()
    assert (points.positions == MASS[:, None]).all() and (points.radius == 0.5).all()
    with pytest.raises(ValueError, match="has no column 'q'; it has place, mass"):
        gv.read_points(path, positions="q")
    with pytest.raises(ValueError, match=r"read_points: unknown option 'radii'; known: .*radius"):
        gv.read_points(path, radii=0.5)
    with pytest.raises(ValueError, match="positions must be 3 numbers, the columns are 1"):
        gv.read_points(path, positions="u", values="u")


@pytest.mark.parametrize("name", WRITERS)
def test_damage_gets_one_line_that_names_the_file(tmp_path, name):
    whole = WRITERS[name](tmp_path / name).read_bytes()
    refused = 0
    for number in range(40):
        path = tmp_path / f"{number}_{name}"
        path.write_bytes(break_file(whole, number))
        try:
            gv.read_points(path)
        except (ValueError, OSError) as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
    assert refused > 12


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("format ascii 1.0\nelement vertex 99999999999\nproperty float x", "it has"),
        ("format ascii 1.0\nelement vertex 2\nproperty list uchar int x", "have lists"),
        ("format ascii 1.0\nelement face 2\nproperty float x", "come after face"),
        ("element vertex 2\nproperty float x", "no format"),
        ("format ascii 1.0", "no vertices"),
        ("format ascii 1.0\nelement vertex 2\nproperty quad x", "quad"),
    ],
)
def test_a_strange_ply_is_named(tmp_path, head, message):
    path = tmp_path / "a.ply"
    path.write_text(f"ply\n{head}\nend_header\n1\n2\n")
    with pytest.raises(ValueError) as caught:
        gv.read_points(path)
    assert str(path) in str(caught.value) and message in str(caught.value)


@pytest.mark.parametrize("red", ["255", "300", "-1", "1.5"])
def test_text_beyond_an_integer_of_ply_is_refused(tmp_path, red):
    fields = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    fields = "".join(f"property float {axis}\n" for axis in "xyz") + fields
    head = f"ply\nformat ascii 1.0\ncomment M\u00fcller\nelement vertex 1\n{fields}end_header\n"
    (tmp_path / "a.ply").write_text(f"{head}1 2 3 {red} 0 0\n")
    if red == "255":
        assert gv.read_points(tmp_path / "a.ply").colors[0].tolist() == [1, 0, 0]
        return
    with pytest.raises(ValueError, match=r"red holds numbers that uint8 does not"):
        gv.read_points(tmp_path / "a.ply")


def test_missing_values_of_fits_are_no_numbers(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    columns = [fits.Column(name, "D", array=np.arange(4.0)) for name in "xyz"]
    columns.append(fits.Column("flux", "J", null=-99, array=np.array([5, -99, 7, 8])))
    columns.append(fits.Column("mass", "J", null=-99, array=np.array([5, 6, 7, 8])))
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "a.fits")
    with pytest.raises(ValueError, match="values must be finite, got NaN"):
        gv.read_points(tmp_path / "a.fits", values="flux")
    assert gv.read_points(tmp_path / "a.fits", values="mass").values[1] == 6
    rows = np.zeros(2, [(name, ">i2") for name in ("x", "y", "z", "flux")])
    rows["flux"] = 10, -99
    table = fits.BinTableHDU(rows)
    table.header.update({"TNULL4": -99, "TSCAL4": 0.5, "TZERO4": 3})  # what is stored is missing
    table.writeto(tmp_path / "b.fits")
    with pytest.raises(ValueError, match="values must be finite, got NaN"):
        gv.read_points(tmp_path / "b.fits")


def test_columns_of_another_length_are_told(tmp_path):
    positions = np.random.default_rng(0).random((9, 3))
    np.savez(tmp_path / "a.npz", positions=positions, values=np.ones(9), radius=np.ones(8))
    with pytest.warns(UserWarning, match=r"not read, since others have 9 rows: radius \(8\)"):
        assert gv.read_points(tmp_path / "a.npz").radius is None


def test_that_only_centres_of_gaussians_are_read_is_told(tmp_path):
    names = ["x", "y", "z", "f_dc_0", "opacity", "scale_0", "rot_0"]
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 9\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    rows = np.random.default_rng(0).random((9, len(names)), np.float32)
    (tmp_path / "a.ply").write_bytes(head.encode() + rows.tobytes())
    with pytest.warns(UserWarning, match="of 3D Gaussians only the centres are read"):
        points = gv.read_points(tmp_path / "a.ply")
    assert np.array_equal(points.positions, rows[:, :3]) and points.radius is None


def test_no_pickle_is_loaded_and_nan_is_told(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, position=PLACE, value=np.array([{}] * COUNT))
    with pytest.raises(ValueError, match=r"a\.npz"):
        gv.read_points(path)
    np.savez(path, position=PLACE * np.nan)
    with pytest.raises(ValueError, match=r"a\.npz.*positions must be finite"):
        gv.read_points(path)
    with pytest.raises(FileNotFoundError):
        gv.read_points(tmp_path / "b.npz")
    with pytest.raises(ValueError, match="must end in npz, ply"):
        gv.read_points(tmp_path / "b.xyz")


# --- Stores


def test_a_store_holds_the_histogram_and_its_means(tmp_path):
    path, store = write_ply(tmp_path / "a.ply"), tmp_path / "a.zarr"
    box = "-4,-4,-4,6,6,6"
    run = gvtorch("splat", path, "-o", store, "--extent", 50, "--box", box, "--radius", 0)
    assert run.returncode == 0 and "50x50x50, " in run.stdout, run.stderr
    opened = gv.Store.open(store)
    assert not (store / WORK).exists() and opened.info.quantity == "value"
    edges = [np.linspace(-4, 6, 51)] * 3
    expected = np.histogramdd(PLACE[:, ::-1].astype(float), edges, weights=MASS)[0]
    held = opened.read_region(0, (0, 0, 0), (50, 50, 50))[..., 0]
    assert np.allclose(held, expected, rtol=1e-5, atol=1e-6)
    coarse = opened.read_region(1, (0, 0, 0), (25, 25, 25))[..., 0]
    means = expected.reshape(25, 2, 25, 2, 25, 2).mean((1, 3, 5))
    assert np.allclose(coarse, means, rtol=1e-5, atol=1e-6)
    assert opened.origin == pytest.approx((-3.9,) * 3)


def test_light_has_colours_and_the_producer_s_voxels(tmp_path):
    path = write_npz(tmp_path / "a.npz")
    store = gv.splat(path, tmp_path / "a.zarr", extent=64, channel="color", opacity=0.01)
    producer = gv.PointProducer(gv.read_points(path).lit(0.01), extent=64)
    assert store.extent == producer.extent and store.spacing == pytest.approx(producer.spacing)
    z, y, x = store.extent[::-1]
    held = store.read_region(0, (0, 0, 0), (z, y, x))
    assert np.allclose(held, region(producer.points, (0, 0, 0), (z, y, x)), 1e-6)
    light = gv.read_points(path).lit(0.01).values.sum(0)
    assert np.allclose(held.sum((0, 1, 2), dtype=np.float64), light, rtol=1e-5)


def test_a_broken_off_splat_goes_on(tmp_path, monkeypatch):
    path, store = write_npz(tmp_path / "a.npz"), tmp_path / "a.zarr"
    options = {"extent": 300, "workers": 1}
    with (
        stopped_at(monkeypatch, 3),
        pytest.raises(KeyboardInterrupt, match="the same command with --resume"),
    ):
        gv.splat(path, store, **options)
    assert (store / WORK / "points" / "points.json").exists()
    with pytest.raises(ValueError, match="begun with other points or settings"):
        gv.splat(path, store, **options, radius=0.3, resume=True)
    opened = gv.splat(path, store, **options, resume=True)
    total = opened.read_region(0, (0, 0, 0), opened.extent[::-1]).sum(dtype=np.float64)
    assert total == pytest.approx(MASS.sum(), rel=1e-5)


def test_a_splat_that_fails_leaves_what_another_process_has_in_the_folder(tmp_path):
    lock = tmp_path / "a.zarr" / ".gvtorch-work" / "lock"
    for begun in (False, True):
        if begun:
            lock.parent.mkdir(parents=True)
            lock.touch()
        with pytest.raises(ValueError, match="no point lies in the box"):
            gv.splat(gv.Points(PLACE), tmp_path / "a.zarr", box=((1e6,) * 3, (2e6,) * 3))
        assert lock.exists() == begun and (tmp_path / "a.zarr").exists() == begun


@pytest.mark.long
def test_points_in_memory_go_to_worker_processes(tmp_path):
    store = gv.splat(gv.Points(PLACE, MASS), tmp_path / "a.zarr", extent=300, workers=2)
    total = store.read_region(0, (0, 0, 0), store.extent[::-1]).sum(dtype=np.float64)
    assert total == pytest.approx(MASS.sum(), rel=1e-5)


def test_mistakes_leave_nothing_behind(tmp_path):
    path = write_npz(tmp_path / "a.npz")
    store = tmp_path / "a.zarr"
    for options, message in (
        (("--box", "8,8,8,9,9,9"), "no point lies in the box"),
        (("--values", "mess"), "has no column 'mess'"),
        (("--box", "1,2"), "--box must be 6 numbers"),
        (("--extent", "x"), "--extent must be a whole number, got 'x'"),
        (("--opacity", "0.5"), "--opacity and --colors are for --channels color"),
        (("--colors", "values"), "--opacity and --colors are for --channels color"),
        (("--radius", 1e308), "box must be finite"),
        (("--extent", str(2**30)), "more voxels than a 64-bit number tells apart"),
        (("--channels", "color", "--opacity", 2), "opacity must be"),
    ):
        run = gvtorch("splat", path, "-o", store, *options)
        assert run.returncode == 2 and message in run.stderr, run.stderr
        assert len(run.stderr.splitlines()) == 1 and not store.exists()
