"""Triangles and voxels in one picture: VTK's OpenGL draws rings and a disk that cross a scan.

VTK takes our camera; its colours and depth buffer come back as a layer. They stay on the GPU if
CUDA and OpenGL use the same one.
"""

import math
import sys
from ctypes.util import find_library
from dataclasses import dataclass
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

DATA = Path(__file__).parent / "data"
EYE, TARGET, UP = (-260.0, -340.0, 190.0), (63.5, 63.5, 127.5), (0.0, 0.0, 1.0)
BACKGROUND = (0.02, 0.02, 0.03)
RINGS = [(74, 62, 180), (80, 58, 140), (76, 54, 100)]  # centres, around the vessel
DISK = (64, 64, 58)


def actor(source, place, color) -> vtk.vtkActor:
    """The triangles of a source, moved to a place."""
    mapper, result = vtk.vtkPolyDataMapper(), vtk.vtkActor()
    mapper.SetInputConnection(source.GetOutputPort())
    mapper.ScalarVisibilityOff()
    result.SetMapper(mapper)
    result.SetPosition(*place)
    result.GetProperty().SetColor(*color)
    result.GetProperty().SetAmbient(0.35)
    return result


def rasterise(actors, camera: gv.Camera, near: float, far: float, device="cpu") -> gv.Layer:
    """Draws triangles for the pixels of a camera in world units."""
    vtk.vtkObject.GlobalWarningDisplayOff()  # else it warns of each display it did not find
    renderer, window = vtk.vtkRenderer(), vtk.vtkRenderWindow()
    window.SetOffScreenRendering(True)
    window.SetMultiSamples(0)  # a pixel has one depth
    window.SetSize(camera.width, camera.height)
    window.AddRenderer(renderer)
    for each in actors:
        renderer.AddActor(each)
    projection, modelview = gv.opengl.matrices(camera, near, far)
    _, up, back = modelview[:3, :3]
    place = -(modelview[:3, :3].T @ modelview[:3, 3])
    view = renderer.GetActiveCamera()
    view.SetPosition(*place.tolist())
    view.SetFocalPoint(*(place - back).tolist())
    view.SetViewUp(*up.tolist())
    view.SetClippingRange(near, far)
    matrix = vtk.vtkMatrix4x4()
    matrix.DeepCopy(projection.flatten().tolist())
    view.SetExplicitProjectionTransformMatrix(matrix)
    view.UseExplicitProjectionTransformMatrixOn()
    window.Render()

    window.MakeCurrent()
    frame = window.GetRenderFramebuffer()
    frame.Bind(frame.GetReadMode())
    with gv.opengl.Exchange(camera.width, camera.height, device) as exchange:
        color, depth = exchange.read_color()[..., :3], exchange.read_depth()
        print(exchange)
    linear = rgb_to_linear_rgb(color.movedim(-1, 0)).movedim(0, -1)
    return gv.Layer(linear, gv.opengl.ray_distance(depth, projection))


@dataclass
class Settings:
    """Renders the bundled stent with rings around it."""

    output: Path = Path("mixed_triangles.png")
    size: int = 512
    device: str = "cpu"


def main(settings: Settings) -> None:
    """Draws the triangles, then the voxels in front of and around them."""
    size, device = settings.size, settings.device
    camera = gv.Camera.look_at(EYE, TARGET, UP, fov=30, width=size, height=size)
    torus = vtk.vtkParametricTorus()
    torus.SetRingRadius(34)
    torus.SetCrossSectionRadius(3)
    ring, disk = vtk.vtkParametricFunctionSource(), vtk.vtkDiskSource()
    ring.SetParametricFunction(torus)
    ring.SetUResolution(200)
    ring.SetVResolution(40)
    disk.SetInnerRadius(0)
    disk.SetOuterRadius(70)
    disk.SetCircumferentialResolution(200)
    actors = [actor(ring, place, (0.2, 0.75, 0.55)) for place in RINGS]
    actors.append(actor(disk, DISK, (0.3, 0.5, 0.9)))
    layer = rasterise(actors, camera, near=200, far=1000, device=device)

    volume = gv.read_volume(DATA / "stent_256x128x128_int16.npz")
    tree = gv.N3Tree.from_volume(volume, device=device)
    shader = gv.TransferFunction.from_json(DATA / "stent.json")
    picture = gv.render(tree, camera, shader, background=BACKGROUND, layer=layer)
    picture.save(settings.output)
    drawn = layer.depth < math.inf
    before = drawn & (picture.depth < layer.depth)
    print(f"{settings.output}: {drawn.sum()} pixels of triangles, voxels before {before.sum()}")


if __name__ == "__main__":
    main(tyro.cli(Settings))
