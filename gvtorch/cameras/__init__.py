"""Cameras: from pixels to rays."""

from .camera import Camera as Camera
from .custom import CustomCamera as CustomCamera
from .files import read_cameras as read_cameras
from .files import write_cameras as write_cameras
from .path import CameraPath as CameraPath
