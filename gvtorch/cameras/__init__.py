"""Cameras: from pixels to rays."""

from .camera import Camera
from .custom import CustomCamera
from .path import CameraPath

__all__ = ["Camera", "CameraPath", "CustomCamera"]
