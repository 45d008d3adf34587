"""What stands behind a picture on the command line, and how `gvtorch render` develops it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from .common import flags_given, numbers

if TYPE_CHECKING:
    from ..cameras import Camera
    from ..pictures import Picture

KINDS = (".png", ".exr", ".npy", ".npz", ".tif")
STRIPS = (".npy", ".tif")  # written strip by strip: the picture may be larger than memory


def in_strips(suffix: str, width: int, height: int) -> bool:
    """Whether a picture is written strip by strip; PNG where it is larger than one."""
    from ..base import check
    from ..pictures.progressive import STRIP, strip_rows

    rows = strip_rows(check.nbytes("render", "memory", STRIP), width, height)
    return suffix in STRIPS or (suffix == ".png" and rows < height)


@dataclass(frozen=True, kw_only=True)
class Develop:
    """How the picture is developed."""

    samples: Annotated[int, arg(metavar="N")] = 1
    """rays a pixel, at places of their own"""
    tone: Literal["none", "reinhard", "aces"] = "none"
    """curve from scene light to the display"""
    exposure: Annotated[float, arg(metavar="STOPS")] = 0.0
    """the light is multiplied by 2^STOPS"""

    def given(self) -> list[str]:
        """Flags that differ from what they are if left out."""
        return flags_given(self)

    def wrap(self, render: Callable[[Camera], Picture]) -> Callable[[Camera], Picture]:
        """Returns what renders a camera with all samples, tone-mapped."""
        from ..base import check
        from ..pictures import Progressive
        from ..pictures.tone import checked_curve

        check.whole("render", "--samples", self.samples, low=1)
        checked_curve("render", self.tone, self.exposure)

        def developed(camera: Camera) -> Picture:
            if self.samples > 1:
                picture = Progressive(render).refine(camera, self.samples)
            else:
                picture = render(camera)
            if self.tone == "none" and self.exposure == 0:
                return picture
            return picture.tone_map(self.tone, exposure=self.exposure)

        return developed


def parse_background(text: str) -> Any:
    """Returns a background from R,G,B, two of them (top/bottom), `transparent`, or the file of an
    environment map.

    Raises:
        ValueError: The text is none of these; or see `Environment.read`.
    """
    from ..pictures import Environment, Gradient

    if text == "transparent":
        return None
    if Path(text).suffix in (".png", ".exr", ".npy", ".tif"):
        return Environment.read(text)
    top, slash, bottom = text.partition("/")
    if slash:
        return Gradient(*(tuple(numbers("--background", part, 3, float)) for part in (top, bottom)))
    return tuple(numbers("--background", text, 3, float))
