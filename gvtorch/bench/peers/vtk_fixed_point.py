"""VTK's `vtkFixedPointVolumeRayCastMapper`: multithreaded fixed-point arithmetic on the CPU, which
skips transparent blocks.

The mapper's steps are called directly, because they need no display: the picture is read from its
memory.
"""

from __future__ import annotations

import ctypes

import numpy as np
import torch
import vtkmodules.vtkRenderingOpenGL2
import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401  (registers the classes that render)
from torch import Tensor
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkObject
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
from vtkmodules.vtkRenderingCore import (
    vtkColorTransferFunction,
    vtkRenderer,
    vtkRenderWindow,
    vtkVolume,
    vtkVolumeProperty,
)
from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

from .peer import Peer, Task

_ONE = 0x7FFF  # 1.0 in VTK's pictures


class Marcher(Peer):
    """The mapper with linear interpolation, no shading, one ray a pixel."""

    differences = (
        "15-bit fixed point, interpolated values rounded to whole numbers; the box ends at the "
        "outermost voxel centres, half a voxel earlier; samples lie elsewhere along a ray; "
        "a ray ends at alpha 0.992"
    )

    @classmethod
    def why_unavailable(cls, device: torch.device) -> str:
        return "" if device.type == "cpu" else "runs on the CPU only"

    def __init__(self, task: Task) -> None:
        """Passes volume, transfer function and camera to VTK."""
        vtkObject.GlobalWarningDisplayOff()
        scene, camera = task.scene, task.camera
        self.width, self.height, self.extent = camera.width, camera.height, scene.volume.extent
        voxels = scene.volume.data[..., 0].contiguous().numpy()
        self.image = vtkImageData()
        self.image.SetDimensions(*self.extent)
        self.image.GetPointData().SetScalars(numpy_to_vtk(voxels.ravel(), deep=True))
        self.mapper = vtkFixedPointVolumeRayCastMapper()
        self.mapper.SetInputData(self.image)
        self.mapper.AutoAdjustSampleDistancesOff()
        self.mapper.SetImageSampleDistance(1.0)
        self.mapper.SetSampleDistance(scene.step)
        self.mapper.IntermixIntersectingGeometryOff()
        self.mapper.SetNumberOfThreads(torch.get_num_threads())
        opacity, color = vtkPiecewiseFunction(), vtkColorTransferFunction()
        for value, (red, green, blue, alpha) in enumerate(scene.shader(np.arange(256.0)).tolist()):
            opacity.AddPoint(value, alpha)
            color.AddRGBPoint(value, red, green, blue)
        properties = vtkVolumeProperty()
        properties.SetInterpolationTypeToLinear()
        properties.ShadeOff()
        properties.SetScalarOpacity(opacity)
        properties.SetColor(color)
        properties.SetScalarOpacityUnitDistance(scene.shader.reference or 1.0)
        self.volume = vtkVolume()
        self.volume.SetMapper(self.mapper)
        self.volume.SetProperty(properties)
        self.renderer, self.window = vtkRenderer(), vtkRenderWindow()
        self.renderer.AddVolume(self.volume)
        self.window.SetOffScreenRendering(1)
        self.window.SetSize(self.width, self.height)
        self.window.AddRenderer(self.renderer)
        view = camera.viewmats[0].numpy()
        eye = -view[:3, :3].T @ view[:3, 3]
        vtk_camera = self.renderer.GetActiveCamera()
        vtk_camera.SetPosition(*eye)
        vtk_camera.SetFocalPoint(*(eye + view[2, :3]))
        vtk_camera.SetViewUp(*-view[1, :3])
        tangent = 0.5 * self.height / float(camera.Ks[0, 1, 1])
        vtk_camera.SetViewAngle(2 * np.degrees(np.arctan(tangent)))
        self.renderer.ResetCameraClippingRange()

    def render(self) -> None:
        """Runs the mapper's steps: image, tables, rays."""
        last = [n - 1 for n in self.extent]
        box = [0, last[0], 0, last[1], 0, last[2]]
        self.mapper.PerImageInitialization(self.renderer, self.volume, 0, [0.0] * 3, [1.0] * 3, box)
        self.mapper.PerVolumeInitialization(self.renderer, self.volume)
        self.mapper.PerSubVolumeInitialization(self.renderer, self.volume, 0)
        self.mapper.RenderSubVolume()

    def picture(self) -> Tensor:
        """Returns the picture, top row first; 0 outside the used part of the mapper's image."""
        image = self.mapper.GetRayCastImage()
        (width, height), (x, y) = image.GetImageInUseSize(), image.GetImageOrigin()
        stride, rows = image.GetImageMemorySize()
        address = int(image.GetImage().split("_")[1], 16)
        memory = (ctypes.c_uint16 * (4 * stride * rows)).from_address(address)
        used = np.ctypeslib.as_array(memory).reshape(rows, stride, 4)[:height, :width]
        full = np.zeros((self.height, self.width, 4), np.float32)
        full[y : y + height, x : x + width] = used / np.float32(_ONE)
        return torch.from_numpy(full[::-1].copy()).reshape(-1, 4)
