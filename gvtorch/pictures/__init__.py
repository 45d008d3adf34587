"""Pictures: the result of a render, its background, and how it is shown, refined and written."""

from .background import Backdrop as Backdrop
from .background import Environment as Environment
from .background import Gradient as Gradient
from .overlay import ColorBar as ColorBar
from .overlay import Overlay as Overlay
from .picture import Picture as Picture
from .progressive import Progressive as Progressive
from .progressive import render_tiles as render_tiles
from .read_files import read_image as read_image
from .video import Video as Video
