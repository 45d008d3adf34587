"""`Annotations`: the flags of `gvtorch render` and `gvtorch fly` for annotations over a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from .common import Switch, given_flags, option

if TYPE_CHECKING:
    from ..base.image_info import ImageInfo
    from ..cameras import Camera
    from ..pictures import ColorBar, Overlay
    from ..shaders import Shader
    from ..viewer.state import ViewState


#: Luminance, linear, from which black and white differ by the same factor (WCAG).
_EQUAL_CONTRAST = 0.18


@dataclass(frozen=True, kw_only=True)
class Annotations:
    """What is drawn over the picture."""

    # draw a colour bar of the transfer function
    bar: Switch = False
    # draw a scale bar; in perspective it holds at the distance of what the camera looks at, the
    # middle of the box unless --state or --keys set another
    scale_bar: Switch = False
    # write text at the upper left; lines are separated by \n
    annotate: Annotated[str | None, option(metavar="TEXT")] = None

    def overlay(self, state: ViewState, info: ImageInfo, camera: Camera) -> Overlay | None:
        """Returns the overlay for what a state shows from a camera in the world, or None; its scale
        holds at the target of the state's camera. Raises ValueError if there are slices or costs,
        the shader has no bar, the camera no scale, or there is no room.
        """
        from ..pictures import Overlay

        flags, eye = given_flags(self), state.camera
        if not flags:
            return None
        if not state.is_plain:
            raise ValueError(f"{flags[0]} is for a picture alone: the view has slices or costs")
        assert eye is not None
        return Overlay(
            camera.width,
            camera.height,
            bar=_color_bar(state.shader, info, state.component) if self.bar else None,
            pixel=camera.pixel_width(math.dist(eye.eye, eye.target)) if self.scale_bar else None,
            unit=info.unit,
            text=self.annotate,
            ink="black" if _is_light(state.options.background) else "white",
        )


def _is_light(background: object) -> bool:
    """Returns whether black stands out more than white from a background: from its colour, or both
    ends of its gradient.
    """
    import numpy as np

    from ..pictures import Gradient
    from ..pictures.tone import LUMINANCE

    colors = background.ends if isinstance(background, Gradient) else [background]
    return all(
        isinstance(color, tuple) and np.dot(color, LUMINANCE) > _EQUAL_CONTRAST for color in colors
    )


def _color_bar(shader: Shader, info: ImageInfo, component: int) -> ColorBar:
    from ..pictures import ColorBar
    from ..viewer.state import transfer_of

    transfer = transfer_of(shader)
    if transfer is None:
        raise ValueError(f"--bar is for transfer functions, not for {type(shader).__name__}")
    values = [*transfer.opacity[:, 0], *transfer.color[:, 0]]
    names = [info.channels[component].name] if component < len(info.channels) else []
    title = ", ".join(dict.fromkeys(part for part in (*names, info.quantity) if part))
    return ColorBar(colors=transfer, low=min(values), high=max(values), title=title)
