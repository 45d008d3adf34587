"""Pictures: the result of a render, its background, and how it is shown, refined and written."""

from .background import Backdrop, Environment, Gradient
from .overlay import ColorBar, Overlay
from .picture import Picture
from .progressive import Progressive, render_tiles
from .read_files import read_image
from .video import Video

__all__ = [
    "Backdrop",
    "ColorBar",
    "Environment",
    "Gradient",
    "Overlay",
    "Picture",
    "Progressive",
    "Video",
    "read_image",
    "render_tiles",
]
