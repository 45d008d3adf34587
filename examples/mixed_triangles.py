"""Triangles and voxels in one picture: VTK's OpenGL draws rings and a disk that cross a scan. It
uses our camera; its colours and depth buffer come back as a layer, on the GPU if both use it."""

import math
import sys
from ctypes.util import find_library
from pathlib import Path

import tyro
from kornia.color import rgb_to_linear_rgb

import gvtorch as gv

try:
    import vtk
except ImportError as error:
    sys.exit(f"mixed_triangles needs VTK: pip install 'gvtorch[triangles]' ({error})")
if sys.platform == "linux" and not (find_library("EGL") or find_library("OSMesa")):
    sys.exit("mixed_triangles needs OpenGL: a GPU's driver with EGL, or Mesa's EGL or OSMesa")

SCAN = Path(__file__).parent / "data" / "stent_256x128x128_int16.npz"
EYE, TARGET, UP = (-120.0, -300.0, -30.0), (68.0, 62.0, 126.0), (1.0, 0.3, 0.0)  # the body lies
SKY = gv.Gradient((0.05, 0.07, 0.11), (0.008, 0.009, 0.014))
RINGS = [(82, 58, 205), (80, 60, 170), (79, 58, 135), (76, 54, 100)]  # centres, around the vessel
DISK, BLUE, GREEN = (64, 64, 58), (0.3, 0.5, 0.9), (0.2, 0.75, 0.55)


def rasterise(parts, camera: gv.Camera, near: float, far: float, device="cpu") -> gv.Layer:
    """Draws parts (source, position, colour) with VTK for a camera in world units, as a layer."""
    vtk.vtkObject.GlobalWarningDisplayOff()  # else it warns of each display not found
    renderer, window = vtk.vtkRenderer(), vtk.vtkRenderWindow()
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)  # a pixel has one depth
    window.SetSize(camera.width, camera.height)
    window.AddRenderer(renderer)
    for source, position, color in parts:
        actor = vtk.vtkActor(
            mapper=vtk.vtkPolyDataMapper(scalar_visibility=False), position=position
        )
        actor.mapper.SetInputConnection(source.GetOutputPort())
        actor.property.color, actor.property.ambient, actor.property.specular = color, 0.25, 0.3
        renderer.AddActor(actor)
    projection, modelview = gv.opengl.matrices(camera, near, far)
    _, up, back = modelview[:3, :3]
    eye = -(modelview[:3, :3].T @ modelview[:3, 3])
    vtk_camera, matrix = renderer.GetActiveCamera(), vtk.vtkMatrix4x4()
    vtk_camera.SetPosition(*eye.tolist())
    vtk_camera.SetFocalPoint(*(eye - back).tolist())
    vtk_camera.SetViewUp(*up.tolist())
    vtk_camera.clipping_range = near, far
    matrix.DeepCopy(projection.flatten().tolist())
    vtk_camera.SetExplicitProjectionTransformMatrix(matrix)
    vtk_camera.UseExplicitProjectionTransformMatrixOn()
    window.Render()
    window.MakeCurrent()
    window.GetRenderFramebuffer().Bind(window.GetRenderFramebuffer().GetReadMode())
    with gv.opengl.Exchange(camera.width, camera.height, device) as exchange:
        color, depth = exchange.read_color()[..., :3], exchange.read_depth()
    linear = rgb_to_linear_rgb(color.movedim(-1, 0)).movedim(0, -1)
    return gv.Layer(linear, gv.opengl.ray_distance(depth, projection))


def main(output: Path = Path("mixed_triangles.png"), size: int = 720, device: str = "cpu") -> None:
    """Draws the triangles, then the voxels in front of and around them."""
    camera = gv.Camera.look_at(EYE, TARGET, UP, 22, size * 16 // 9, size)
    torus = vtk.vtkParametricTorus(ring_radius=32, cross_section_radius=2.5)
    ring = vtk.vtkParametricFunctionSource(u_resolution=200, v_resolution=40)
    ring.SetParametricFunction(torus)
    disk = vtk.vtkDiskSource(inner_radius=44, outer_radius=64, circumferential_resolution=200)
    parts = [(disk, DISK, BLUE), *((ring, position, GREEN) for position in RINGS)]
    layer = rasterise(parts, camera, near=100, far=1000, device=device)
    tree = gv.N3Tree.from_volume(gv.read_volume(SCAN), device=device)
    shader = gv.Lit(gv.TransferFunction.from_json(SCAN.with_name("stent.json")), ambient=0.3)
    picture = gv.render(tree, camera, shader, background=SKY, layer=layer)
    picture.save(output)
    print(f"{output}: {(layer.depth < math.inf).sum()} pixels of triangles")


if __name__ == "__main__":
    tyro.cli(main)
