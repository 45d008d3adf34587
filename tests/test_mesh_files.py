"""Files of meshes: what trimesh wrote is read back; and `gvtorch voxelize`, a mesh to a store."""

from __future__ import annotations

import json
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import Library, gvtorch, meshes, shared
from helpers.stores import stopped_at

import gvtorch as gv
from gvtorch.io.mesh_source import MeshSource
from gvtorch.io.stores.store_layout import WORK
from gvtorch.meshes.voxelizer import Voxelizer

trimesh = Library("trimesh")

CUBE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"


def as_trimesh(mesh: gv.Mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "glb", "off", "gltf"])
def test_every_format_comes_back(tmp_path, ending):
    expected = meshes.torus(1.0, 0.4, (12, 8))
    file = tmp_path / f"torus.{ending}"
    if ending == "gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(
            trimesh.Scene(as_trimesh(expected))
        ).items():
            (tmp_path / name).write_bytes(content)
        file = tmp_path / "model.gltf"
    else:
        as_trimesh(expected).export(file)
    actual = gv.read_mesh(file)
    assert actual.name == str(file)
    order = np.lexsort(actual.corners.reshape(-1, 9).round(4).T)
    other = np.lexsort(expected.corners.reshape(-1, 9).round(4).T)
    assert np.abs(actual.corners[order] - expected.corners[other]).max() < 1e-6
    assert np.isclose(meshes.volume(actual), meshes.volume(expected), rtol=1e-5)


def test_parts_of_a_scene_stand_in_their_places(tmp_path):
    scene = trimesh.Scene()
    ball = as_trimesh(meshes.sphere(2))
    for number, shift in enumerate(((0, 0, 0), (3, 0, 0), (0, 5, 0))):
        pose = trimesh.transformations.translation_matrix(shift)
        pose[:3, :3] *= number + 1
        scene.add_geometry(ball, node_name=f"n{number}", transform=pose)
    scene.export(tmp_path / "three.glb")
    joined = gv.read_mesh(tmp_path / "three.glb")
    assert len(joined.faces) == 3 * len(ball.faces)
    assert np.allclose(joined.bounds, [[-3, -2, -3], [5, 8, 3]], atol=0.1)
    assert meshes.volume(joined) == pytest.approx((1 + 8 + 27) * ball.volume, rel=1e-5)


def test_colours_of_vertices_and_triangles(tmp_path):
    ball = as_trimesh(meshes.sphere(1))
    color = np.random.default_rng(0).integers(0, 256, (len(ball.vertices), 4), np.uint8)
    color[:, 3] = 255
    ball.visual.vertex_colors = color
    ball.export(tmp_path / "a.ply")
    actual = gv.read_mesh(tmp_path / "a.ply")
    value = color[ball.faces][..., :3] / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    assert actual.color is not None and np.abs(actual.color[..., :3] - linear).max() < 1e-6
    flat = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    flat.visual.face_colors = (
        color[: len(ball.faces)] if len(ball.faces) < len(color) else [255] * 4
    )
    flat.export(tmp_path / "b.ply")
    assert gv.read_mesh(tmp_path / "b.ply").color is not None


def write_textured(folder: Path, image: str = "dots.png") -> Path:
    from PIL import Image

    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[:2] = (255, 0, 0)
    Image.fromarray(pixels).save(folder / "dots.png")
    (folder / "a.mtl").write_text(f"newmtl dots\nKd 1 1 1\nmap_Kd {image}\n")
    uv = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    text = CUBE.split("f ", 1)[0] + uv + "usemtl dots\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    (folder / "a.obj").write_text("mtllib a.mtl\n" + text)
    return folder / "a.obj"


def test_textures_and_materials_of_an_obj(tmp_path):
    mesh = gv.read_mesh(write_textured(tmp_path))
    texture = mesh.materials[0].texture
    assert texture is not None and texture.shape == (4, 4, 4) and texture[0, 0, 0] == 255
    assert mesh.uv is not None and np.array_equal(mesh.uv, mesh.corners[..., :2].astype(np.float32))


@pytest.mark.parametrize(("line", "opacity"), [("d 0.25", 0.25), ("Tr 0.25", 0.75), ("d x", 1)])
def test_an_obj_s_material_may_let_light_through(tmp_path, line, opacity):
    (tmp_path / "a.mtl").write_text(f"newmtl glass\nKd 1 0 0\n{line}\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + CUBE.replace("f ", "usemtl glass\nf ", 1))
    assert gv.read_mesh(tmp_path / "a.obj").materials[0].color == (1, 0, 0, opacity)


def star(count: int, seed: int) -> np.ndarray:
    """Returns (n, 2) corners around the middle, counter-clockwise, at random distances from it."""
    angle = 2 * np.pi * np.arange(count) / count
    far = np.random.default_rng(seed).uniform(0.1, 1, count)
    return np.stack((far * np.cos(angle), far * np.sin(angle)), -1)


@pytest.mark.parametrize("count", [4, 5, 9, 60])
@pytest.mark.parametrize("clockwise", [False, True])
def test_polygons_that_are_not_convex_are_cut_within_themselves(tmp_path, count, clockwise):
    """Their triangles have the polygon's area and orientation; those of a fan would overlap."""
    flat = star(count, 3)[::-1] if clockwise else star(count, 3)
    tilt = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    tilt *= np.sign(np.linalg.det(tilt))
    positions = np.concatenate((flat, np.zeros((count, 1))), 1) @ tilt.T
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in positions.tolist()]
    corners = [f"{n + 1 if n % 2 else n - count}//1" for n in range(count)]
    lines += ["vn 0 0 1", "f " + " ".join(corners), "f 1//1 2//1 3//1"]
    (tmp_path / "a.obj").write_text("\r\n".join(lines) + "\r\n")
    mesh = gv.read_mesh(tmp_path / "a.obj")
    a, b, c = mesh.corners.transpose(1, 0, 2) @ tilt
    area = 0.5 * np.cross(b - a, c - a)[:, 2]
    after = np.roll(flat, -1, 0)
    whole = 0.5 * (flat[:, 0] * after[:, 1] - flat[:, 1] * after[:, 0]).sum()
    assert len(area) == count - 1 and (area[:-1] * np.sign(whole) > 0).all()
    assert area[:-1].sum() == pytest.approx(whole)


def test_what_crosses_itself_is_a_fan_and_huge_polygons_are_refused(tmp_path):
    text = "v 0 0 0\nv 2 2 0\nv 2 0 0\nv 0 1 0\nf 1 2 3 4\n"
    (tmp_path / "a.obj").write_text(text)
    assert len(gv.read_mesh(tmp_path / "a.obj").faces) == 2
    vertex_lines = "".join(f"v {x} {y} 0\n" for x, y in star(1001, 0).tolist())
    (tmp_path / "b.obj").write_text(vertex_lines + "f " + " ".join(map(str, range(1, 1002))))
    with pytest.raises(ValueError, match="a polygon of 1001 corners is not convex, at most 1000"):
        gv.read_mesh(tmp_path / "b.obj")


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 -3 -2\nf -4 -2 -1\nv 9 9 9\nv 8 8 8\n",
        CUBE.replace(" ", "\t"),
        CUBE.replace("\n", "\n  "),
        CUBE.replace("\n", " # corner\n"),
        "# made in C:\\models\\\n" + CUBE,
    ],
    ids=["corners counted backwards", "tabs", "indents", "comments", "a folder"],
)
def test_the_same_square_in_other_spellings_of_obj(tmp_path, text):
    (tmp_path / "a.obj").write_text(text)
    corners = gv.read_mesh(tmp_path / "a.obj").corners
    assert corners.tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
    ]
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf -4 -2 -1\n")
    with pytest.raises(ValueError, match=r"b\.obj: .*a corner -4 behind 3 vertices"):
        gv.read_mesh(tmp_path / "b.obj")


def write_gltf(file, attributes, texture=None, binary=False, **fields):
    """Writes one primitive; `attributes` are an array and whether its integers are fractions."""
    components = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}
    blob, views, accessors, primitive = b"", [], [], {"attributes": {}, **fields}
    for name, (values, normalized) in attributes.items():
        padded = np.zeros((len(values), 16 // values.itemsize), values.dtype)  # rows of 16 bytes
        padded[:, : values.shape[1]] = values
        place = {"byteOffset": len(blob), "byteLength": padded.nbytes, "byteStride": 16}
        views.append({"buffer": 0, **place})
        blob += padded.tobytes()
        kind = {"type": f"VEC{values.shape[1]}", "componentType": components[values.dtype.str[1:]]}
        counted = {"count": len(values), "normalized": normalized}
        primitive["attributes"][name] = len(accessors)
        accessors.append({"bufferView": len(views) - 1, **kind, **counted})
    header = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    header |= {"meshes": [{"primitives": [primitive]}], "bufferViews": views}
    header |= {"scene": 0, "accessors": accessors, "buffers": [{"byteLength": len(blob)}]}
    if texture is not None:
        header |= {"textures": [{"source": 0}], "images": [{"uri": "d%C3%A9%20ts.png"}]}
        header["materials"] = [
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **texture}}}
        ]
        primitive["material"] = 0
    if not binary:
        header["buffers"][0]["uri"] = "numbers.bin"
        (file.parent / "numbers.bin").write_bytes(blob)
        file.write_text(json.dumps(header))
        return
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(blob), b"BIN\0") + blob
    file.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]], np.float32)
WIDE = {"i1": 127, "u1": 255, "i2": 32767, "u2": 65535}


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("kind", WIDE)
def test_integers_of_gltf_may_be_fractions(tmp_path, kind, binary):
    """As the specification allows for texture coordinates and colours, and an extension for
    positions.
    """
    file = tmp_path / ("a.glb" if binary else "a.gltf")
    write_points(tmp_path / "d\u00e9 ts.png")
    whole = {"POSITION": POINTS, "TEXCOORD_0": POINTS[:, :2], "COLOR_0": POINTS[:, [0, 1, 2, 0]]}
    packed = {name: ((part * WIDE[kind]).astype(f"<{kind}"), True) for name, part in whole.items()}
    write_gltf(file, packed, {}, binary, mode=5)
    mesh = gv.read_mesh(file)
    write_gltf(file, {name: (part, False) for name, part in whole.items()}, {}, binary, mode=5)
    floats = gv.read_mesh(file)
    for name in ("corners", "uv", "color"):
        assert np.array_equal(getattr(mesh, name), getattr(floats, name)), name
    assert np.array_equal(mesh.color[..., :3], np.clip(mesh.corners, 0, 1))
    assert np.array_equal(np.unique(mesh.corners), [0, 1]) and len(mesh.faces) == 2


def write_points(file):
    from PIL import Image

    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(file)


@pytest.mark.parametrize(
    ("texture", "moved"),
    [
        ({}, lambda u, v: (u, v)),
        ({"texCoord": 1}, lambda u, v: (u / 4, v / 2)),
        ({"scale": [2, 3], "offset": [0.25, 0.5]}, lambda u, v: (2 * u + 0.25, 3 * v + 0.5)),
        ({"rotation": np.pi / 2}, lambda u, v: (v, -u)),  # counter-clockwise, v points down
        ({"rotation": np.pi / 2, "scale": [2, 3]}, lambda u, v: (3 * v, -2 * u)),
    ],
)
def test_texture_coordinates_of_gltf_are_chosen_and_moved(tmp_path, texture, moved):
    write_points(tmp_path / "d\u00e9 ts.png")
    uv = POINTS[:, :2]
    attributes = {"POSITION": POINTS, "TEXCOORD_0": uv, "TEXCOORD_1": uv / np.float32([4, 2])}
    choice = {"extensions": {"KHR_texture_transform": texture}}
    write_gltf(tmp_path / "a.gltf", {n: (a, False) for n, a in attributes.items()}, choice, mode=6)
    mesh = gv.read_mesh(tmp_path / "a.gltf")
    u, v = moved(*mesh.corners[..., :2].transpose(2, 0, 1))
    assert np.allclose(mesh.uv, np.stack((u, 1 - v), -1), atol=1e-6)
    assert mesh.corners.tolist() == POINTS[[[0, 1, 2], [0, 2, 3]]].tolist(), "a fan"


def test_attributes_of_gltf_are_as_many_as_vertices(tmp_path):
    file = tmp_path / "a.gltf"
    write_gltf(file, {"POSITION": (POINTS[:3], False), "COLOR_0": (POINTS[:2], False)})
    with pytest.raises(ValueError, match=r"a\.gltf: .*COLOR_0 has 2 values for 3 vertices"):
        gv.read_mesh(file)
    write_gltf(file, {"POSITION": (POINTS[:3], False)})
    header = json.loads(file.read_text())
    header["buffers"][0]["uri"] = "a\nb.bin"
    file.write_text(json.dumps(header))
    with pytest.raises(ValueError, match=r"a\.gltf: .*names a b\.bin, which is not there"):
        gv.read_mesh(file)


@pytest.mark.parametrize(
    ("mode", "alpha", "plain_alpha"),
    [
        ({}, [255, 255, 255], 1),
        ({"alphaMode": "MASK"}, [0, 0, 0], 0),
        ({"alphaMode": "MASK", "alphaCutoff": 0.25}, [0, 255, 255], 1),
        ({"alphaMode": "BLEND"}, [50, 200, 255], 0.4),
    ],
    ids=str,
)
def test_a_gltf_material_says_how_it_uses_alpha(tmp_path, mode, alpha, plain_alpha):
    """By default it is opaque, whatever alpha is."""
    from PIL import Image

    file = tmp_path / "a.gltf"
    pixels = np.array([[[9, 9, 9, a] for a in (50, 200, 255)]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "d\u00e9 ts.png")
    attributes = {name: (POINTS[:3, :n], False) for name, n in (("POSITION", 3), ("TEXCOORD_0", 2))}
    attributes["COLOR_0"] = (np.full((3, 4), 0.5, "f4"), False)
    write_gltf(file, attributes, {})
    header = json.loads(file.read_text())
    header["materials"][0] |= mode
    header["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, 0.4]
    file.write_text(json.dumps(header))
    mesh = gv.read_mesh(file)
    (material,) = mesh.materials
    assert material.texture[0, :, 3].tolist() == alpha
    assert material.color[3] == pytest.approx(0.4 if mode == {"alphaMode": "BLEND"} else 1)
    assert np.all(mesh.color[..., 3] == (0.5 if mode else 1))
    del header["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    file.write_text(json.dumps(header))
    assert gv.read_mesh(file).materials[0].color[3] == pytest.approx(plain_alpha)


def test_gltf_that_requires_what_is_not_read_is_refused(tmp_path):
    write_gltf(tmp_path / "a.gltf", {"POSITION": (POINTS[:3], False)})
    header = json.loads((tmp_path / "a.gltf").read_text())
    for name in ("EXT_meshopt_compression", "KHR_materials_unlit"):
        header["extensionsRequired"] = [name]
        (tmp_path / f"{name}.gltf").write_text(json.dumps(header))
    assert len(gv.read_mesh(tmp_path / "KHR_materials_unlit.gltf").faces) == 1
    with pytest.raises(ValueError, match="it needs the extension EXT_meshopt_compression"):
        gv.read_mesh(tmp_path / "EXT_meshopt_compression.gltf")


def test_a_texture_is_laid_on(tmp_path):
    file = write_textured(tmp_path)
    (tmp_path / "a.mtl").unlink()
    assert gv.read_mesh(file).materials[0].texture is None
    mesh = gv.read_mesh(file, texture=tmp_path / "dots.png")
    assert mesh.materials[0].texture is not None and mesh.uv is not None
    (tmp_path / "plain.obj").write_text(CUBE)
    with pytest.raises(ValueError, match="has no texture coordinates"):
        gv.read_mesh(tmp_path / "plain.obj", texture=tmp_path / "dots.png")


def test_real_files():
    castle = gv.read_mesh(shared("meshes/kaykit/building_castle_blue.gltf"))
    assert len(castle.faces) == 5659 and castle.uv is not None
    assert castle.materials[0].texture is not None
    assert castle.materials[0].texture.shape == (1024, 1024, 4)
    oak = gv.read_mesh(shared("meshes/oak_tree_leaves.ply.gz"))
    assert len(oak.faces) == 16046 and oak.color is not None
    spot = gv.read_mesh(
        shared("meshes/spot/spot_triangulated.obj.gz"),
        texture=shared("meshes/spot/spot_texture.png"),
    )
    assert spot.uv is not None
    side = np.abs(spot.uv - np.roll(spot.uv, 1, axis=1)).max()
    assert side < 0.2  # no triangle reaches from one chart to another


# --- Bad files


def stl(claimed: int) -> bytes:
    return bytes(80) + claimed.to_bytes(4, "little") + bytes(50)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", b"v 0 0 0\nv 1 0 0\n", "has no triangles"),
        ("a.obj", b"", "a.obj"),
        ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a.obj"),
        ("a.stl", stl(1_000_000_000), "declares 1000000000 triangles"),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
            b"property float y\nproperty float z\nelement face 1000000000\n"
            b"property list uchar int vertex_indices\nend_header\n",
            "declares 1000000000 triangles",
        ),
        ("a.off", b"OFF 3 1000000000 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "declares 1000000000"),
        ("a.gltf", b'{"asset": {"version": "2.0"}', "can't be read as gltf"),
        ("a.glb", bytes(64), "can't be read as glb"),
        ("a.obj.gz", b"no gzip", "can't be unpacked"),
        ("a.blend", b"x", "a mesh's name must end in"),
        ("a.pkl", b"x", "a mesh's name must end in"),
    ],
)
def test_bad_files_are_told_in_a_line(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    run = gvtorch("voxelize", tmp_path / name, "-o", tmp_path / "a.zarr")
    assert run.returncode == 2 and run.stderr.count("\n") == 1, run.stderr
    assert message in run.stderr and run.stderr.startswith("gvtorch: error: ")
    assert not (tmp_path / "a.zarr").exists()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: gv.read_mesh(3), "read_mesh: path must be a str or PathLike"),
        (lambda: gv.read_mesh("a.obj", texture=3), "read_mesh: texture must be a str or PathLike"),
        (lambda: gv.voxelize(3, "a"), "voxelize: mesh must be a Mesh, str or PathLike"),
        (lambda: gv.SampledDistance.of_mesh(3), "SampledDistance: mesh must be a Mesh"),
    ],
)
def test_what_is_no_mesh_is_told(call, message):
    with pytest.raises(ValueError) as caught:
        call()
    assert str(caught.value) == f"{message}, got int"


def test_missing_files_and_far_ones_are_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="file not found"):
        gv.read_mesh(tmp_path / "none.obj")
    file = write_textured(tmp_path, "none.png")
    with pytest.raises(ValueError, match=r"names none\.png, which is not there"):
        gv.read_mesh(file)
    write_textured(tmp_path, "../dots.png")
    with pytest.raises(ValueError, match=r"names \.\./dots\.png, which is in another folder"):
        gv.read_mesh(file)
    write_textured(tmp_path, "http://localhost:1/dots.png")
    with pytest.raises(ValueError, match="nothing is fetched"):
        gv.read_mesh(file)
    buffer = {"uri": "none.bin", "byteLength": 12}
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [buffer]}))
    with pytest.raises(ValueError, match=r"a\.gltf: .*none\.bin"):
        gv.read_mesh(tmp_path / "a.gltf")


def test_damaged_files_are_told(tmp_path):
    """Whatever bytes change, the result is a mesh, or a one-line error."""
    file = tmp_path / "a.glb"
    as_trimesh(meshes.torus(1.0, 0.4, (8, 6))).export(file)
    good = file.read_bytes()
    random, refused = np.random.default_rng(0), 0
    for _ in range(60):
        bad = bytearray(good[: random.integers(20, len(good))] if random.random() < 0.5 else good)
        for _ in range(random.integers(1, 20)):
            bad[random.integers(0, len(bad))] = random.integers(0, 256)
        file.write_bytes(bytes(bad))
        try:
            gv.read_mesh(file)
        except (ValueError, MemoryError) as error:
            assert "\n" not in str(error) and "a.glb" in str(error)
            refused += 1
    assert refused > 20


# --- Stores


@pytest.fixture(scope="module")
def torus_file(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("mesh") / "torus.ply"
    as_trimesh(meshes.torus(1.0, 0.4, (48, 24))).export(file)
    return file


@pytest.mark.parametrize("channel", ["coverage", "distance", "color", "normal", "material"])
def test_a_store_holds_the_voxels_and_their_means(tmp_path, torus_file, channel):
    store = tmp_path / "a.zarr"
    run = gvtorch("voxelize", torus_file, "-o", store, "--resolution", 90, "--channels", channel)
    assert run.returncode == 0 and "90x90x29" in run.stdout, run.stderr
    opened = gv.Store.open(store)
    grid = Voxelizer(gv.read_mesh(torus_file), resolution=90, channels=(channel,))
    x, y, z = grid.extent
    assert opened.extent == grid.extent and opened.spacing[0] == pytest.approx(grid.spacing)
    assert opened.origin == pytest.approx(grid.origin)
    whole = grid.region((0, 0, 0), (z, y, x))[channel].numpy()
    assert np.array_equal(opened.read_region(0, (0, 0, 0), (z, y, x)), whole)
    if channel == "coverage":
        coarse = opened.read_region(1, (0, 0, 0), (z // 2, y // 2, x // 2))
        means = whole[: z // 2 * 2].reshape(z // 2, 2, y // 2, 2, x // 2, 2, 1).mean((1, 3, 5))
        assert np.abs(coarse - means).max() <= 0.5
        assert opened.info.quantity == "coverage"
    assert opened.info.labels == (channel == "material")


@pytest.mark.long
def test_a_mesh_in_memory_goes_to_worker_processes(tmp_path):
    mesh = meshes.sphere(3)
    store = gv.voxelize(mesh, tmp_path / "a.zarr", resolution=300, workers=2)
    assert not (tmp_path / "a.zarr" / WORK).exists()
    total = store.read_region(0, (0, 0, 0), store.extent[::-1]).sum(dtype=np.float64) / 255
    assert total * store.spacing[0] ** 3 == pytest.approx(meshes.volume(mesh), rel=1e-3)


def test_a_broken_off_voxelization_goes_on(tmp_path, torus_file, monkeypatch):
    store = tmp_path / "a.zarr"
    command = ("voxelize", torus_file, "-o", store, "--resolution", 300, "--workers", 1)
    with stopped_at(monkeypatch, 3):
        run = gvtorch(*command)
    assert run.returncode == 130 and "2 of" in run.stderr
    assert "the same command with --resume" in run.stderr
    changed = gvtorch(*command, "--band", 6, "--resume")
    assert changed.returncode == 2 and "not the one that it was begun with" in changed.stderr
    done = gvtorch(*command, "--resume")
    assert done.returncode == 0, done.stderr
    assert gv.Store.open(store).extent == (300, 300, 89)


def test_a_source_travels_without_its_mesh(tmp_path, torus_file):
    source = MeshSource.of(torus_file, resolution=64)["coverage"]
    away = pickle.loads(pickle.dumps(source.staged(tmp_path)))
    assert away.mesh is None and len(pickle.dumps(away)) < 4000
    low, high = (2, 10, 10), (20, 40, 50)
    assert np.array_equal(away.read_region(low, high), source.read_region(low, high))


def test_a_dask_cluster_voxelizes(tmp_path, torus_file):
    distributed = pytest.importorskip("distributed", reason="dask is not installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address
        options = ("--resolution", 40, "--scheduler", address)
        run = gvtorch("voxelize", torus_file, "-o", tmp_path / "a.zarr", *options)
    assert run.returncode == 0, run.stderr


def test_a_torch_mesh_of_a_store_is_streamed(tmp_path, torus_file):
    store = gv.voxelize(torus_file, tmp_path / "a.zarr", resolution=64)
    engine = gv.Engine(gv.StoredProducer(store))
    camera = gv.Camera.orbit(30, 40, 1.5, width=48, height=48)
    picture = engine.render(camera, gv.Isosurface(127))
    assert torch.isfinite(picture.color).all() and picture.alpha.max() > 0.9
    engine.close() if hasattr(engine, "close") else None
