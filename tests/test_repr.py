"""The repr of every public object is one short line, with shapes instead of contents."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import meshes
from helpers.pictures import GRAY

import gvtorch as gv
from gvtorch.producers import Layout

ORBIT = gv.Camera.orbit(width=8, height=6)
IMAGE = torch.rand(6, 8, 3)
VOXELS = torch.zeros(3, 10, 10, 10, 1, dtype=torch.uint8)


@pytest.fixture
def tree():
    return gv.N3Tree.from_volume(gv.Volume(torch.rand(8, 8, 8)), 4)


def test_objects_tell_of_themselves_in_one_line(tree):
    rays = ORBIT.placed(tree.box).rays()
    for thing, begin in (
        (ORBIT, "Camera(8x6, pinhole, in box units)"),
        (gv.Camera.orbit([0, 90], model="ortho"), "Camera(2 x 512x512, ortho, in box units)"),
        (gv.CustomCamera(rays), "CustomCamera(8x6, custom, in world units)"),
        (gv.CameraPath([(0, 0, 0)] * 2, [(1, 1, 1)] * 2), "CameraPath(2 keys)"),
        (rays[:5], "Rays((5, 3) float64 on cpu)"),
        (gv.trace(tree, rays, GRAY), "Hits((48, 3) float32 on cpu)"),
        (gv.render(tree, ORBIT, GRAY), "Picture(8x6, "),
        (gv.cost(tree, ORBIT, GRAY), "Cost(8x6, "),
        (gv.Clip(boxes=[((0, 0, 0), (1, 1, 1))]), "Clip(planes=0, boxes=1, without=0, caps=F"),
        (gv.Layer(IMAGE, IMAGE[..., :1]), "Layer(opaque, color=(6, 8, 3) float32 on cpu)"),
        (gv.Lighting(occlusion=1), "Lighting(occlusion=1.0)"),
        (gv.ThinLens(aperture=0.1, focus=2), "ThinLens(aperture=0.1, focus=2.0)"),
        (gv.RenderOptions(background=IMAGE), "RenderOptions(background=Backdrop((6, 8, 3) fl"),
        (gv.Gradient((0, 0, 0), (1, 1, 1)), "Gradient(top=(0.0, 0.0, 0.0), bottom="),
        (gv.Environment(IMAGE), "Environment((6, 8, 3) float32 on cpu)"),
        (gv.Progressive(print), "Progressive(None, 0 frames)"),
        (gv.Video("a.gif", 8, 6), "Video('a.gif', 8x6)"),
        (gv.Overlay(320, 240), "Overlay(320x240, 0 annotations)"),
        (gv.Timeline("a.json"), "Timeline('a.json', 0 stages)"),
        (tree, "N3Tree(8x8x8"),
        (GRAY, "TransferFunction(3 opacities, 2 colours, from 0 to 1)"),
        (gv.Lit(GRAY, normals="n"), "Lit(normals='n', transfer=TransferFunction("),
        (gv.sdf.Sphere() | gv.sdf.Box(), "Union(Sphere, Box)"),
        (gv.Solid(gv.Mandelbulb()), "Solid(Mandelbulb)"),
        (gv.PointProducer(torch.rand(9, 3), extent=8), "PointProducer("),
        (gv.Points(torch.rand(9, 3), radius=1), "Points(9, values of 1, radius)"),
        (gv.sort_points(gv.Points(torch.rand(9, 3)), 8), "SortedPoints(9, values of 1, "),
        (gv.FieldProducer(gv.sdf.Sphere(), 64), "FieldProducer(64x64x64 (x, y, z), N=2, rgba fl"),
        (gv.Isosurface(torch.tensor(2.0)), "Isosurface(value=() float32, color=(0.8"),
        (gv.Projection("mean", GRAY), "Projection(transfer=TransferFunction("),
        (gv.ModuleShader(torch.nn.Identity()), "ModuleShader(Identity, channels=())"),
        (gv.TransferModule(GRAY, 1.0), "TransferModule(rows=(1041, 4) float32, from 0)"),
        (gv.TreeTracer(tree, GRAY), "TreeTracer(N3Tree(8x8x8 (x, y, z), N=2"),
        (gv.EngineOptions(brick_size=4), "EngineOptions(brick_size=4)"),
        (gv.PointLight((1, 2, 3)), "PointLight(position=(1, 2, 3), color=(1.0, "),
    ):
        text = repr(thing)
        assert text.startswith(begin), text
        assert len(text) < 200 and "\n" not in text, text


def test_data_and_producers_tell_of_themselves_in_one_line(tmp_path):
    volume = gv.Volume(torch.arange(1000, dtype=torch.uint8).view(10, 10, 10) % 250)
    gv.convert(volume, tmp_path / "a.zarr")
    channels = {"a": gv.Channel(torch.int16), "b": gv.Channel(torch.uint8, 4)}
    layout = Layout.of(gv.Producer(100), 8, 1, torch.device("cpu"))
    kind = torch.zeros(5, dtype=torch.int64)
    for thing, begin in (
        (channels["b"], "Channel(dtype=torch.uint8, width=4, coarse=False)"),
        (
            gv.NodePool(20, channels),
            "NodePool(20 tiles of 8 nodes, a int16x1, b uint8x4, 0.0 MB",
        ),
        (
            gv.BrickPool(30, channels),
            "BrickPool(30 bricks of 8^3+1, a int16x1, b uint8x4, 0.2 ",
        ),
        (gv.N3Tree.from_volume(volume), "N3Tree(10x10x10 (x, y, z), N=2, depth=1, 2 tiles, 9 bri"),
        (gv.BrickTable(VOXELS), "BrickTable((3, 10, 10, 10, 1) uint8 on cpu, 0.0 MB)"),
        (gv.Nodes(kind[:, None], layout), "Nodes(5 on cpu, bricks of 8^3+1, tree depth 4)"),
        (gv.Regions(kind=kind, ranges={"a": kind}), "Regions(kind=(5,) int64, ranges={a: (5,) int"),
        (
            gv.Bricks(data={"a": VOXELS}, errors={2: "lost"}),
            "Bricks(data={a: (3, 10, 10, 10, 1) uint8})",
        ),
        (gv.Producer((4, 5, 6)), "Producer(4x5x6 (x, y, z), N=2, value float32x1)"),
        (gv.FromChildren(gv.Producer(8)), "FromChildren(8x8x8 (x, y, z), N=2, value float32x1)"),
        (gv.OctaveProducer(gv.noise.SplineSum(), 8), "OctaveProducer(8x8x8 (x, y, z), N=2, value"),
        (
            gv.MeshProducer(meshes.box(), resolution=32),
            "MeshProducer(32x24x16 (x, y, z), N=2, coverage uint8x1)",
        ),
        (
            gv.JoinedProducer({"solid": gv.MeshProducer(meshes.box(), resolution=32)}),
            "JoinedProducer(32x24x16 (x, y, z), N=2, solid uint8x1)",
        ),
        (meshes.box(), "Mesh(12 triangles, 1 materials, from (0, 0, 0) to (1, 0.7, 0.4))"),
        (gv.VolumeProducer(volume), "VolumeProducer(10x10x10 (x, y, z), N=2, value uint8x1)"),
        (gv.StoredProducer(tmp_path / "a.zarr"), "StoredProducer(10x10x10 (x, y, z), N=2, value"),
    ):
        text = repr(thing)
        assert text.startswith(begin), text
        assert len(text) < 200 and "\n" not in text, text


def test_a_file_of_points_tells_its_size_and_columns(tmp_path):
    np.savez(tmp_path / "a.npz", positions=np.zeros((9, 3)), radius=np.ones(9))
    text = repr(gv.PointFile(tmp_path / "a.npz"))
    assert text.startswith("PointFile('") and text.endswith("a.npz': 9 points, positions, radius)")
