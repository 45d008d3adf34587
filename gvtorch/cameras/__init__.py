"""Cameras: from pixels to rays."""

from .camera import Camera as Camera
from .custom import CustomCamera as CustomCamera
from .path import CameraPath as CameraPath
