"""`RenderOptions`: how a picture is made, checked once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from ..cameras.camera import Camera
from ..ops.trace import Backend
from ..pictures.background import Background, checked_background
from .clip import Clip
from .layer import Layer
from .lighting import Lighting
from .thin_lens import ThinLens


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How a picture is made."""

    step: float = config.STEP  # shortest interval, in voxels of the finest level
    lod: Literal["auto", "finest"] = "auto"  # auto: voxels as wide as the pixel cone
    # A colour (linear RGB), an object of `background.py`, an image (h, w, 3) or None: transparent.
    background: tuple[float, float, float] | Background | Tensor | None = (0.0, 0.0, 0.0)
    stop_alpha: float = config.STOP_ALPHA  # a ray ends here; 1 integrates to the end
    depth_alpha: float = config.DEPTH_ALPHA  # depth is where alpha passes this
    cone_scale: float = config.CONE_OVERESTIMATE  # widens the pixel cone
    channel: str | None = None  # name of the channel the shader reads; None: the first
    component: int = 0  # which number of the channel
    layer: Layer | None = None  # what another renderer drew: voxels go before and behind it
    clip: Clip | None = None  # the region of interest; None: everything
    lens: ThinLens | None = None  # depth of field; None: all is sharp
    lighting: Lighting | None = None  # shadows and light from all around; None: the shader's own
    backend: Backend = "auto"
    dtype: torch.dtype = torch.float32  # float64 for trees deeper than about 2^16 voxels

    def __post_init__(self) -> None:
        """Checks every option."""
        where = "render"
        check.number(where, "step", self.step, low=0, open_low=True)
        if self.lod not in ("auto", "finest"):
            raise ValueError(f"{where}: lod must be 'auto' or 'finest', got {self.lod!r}")
        checked_background(where, self.background)
        check.number(where, "stop_alpha", self.stop_alpha, low=0, high=1, open_low=True)
        check.number(where, "depth_alpha", self.depth_alpha, low=0, high=1)
        if self.depth_alpha >= self.stop_alpha:
            raise ValueError(
                f"{where}: depth_alpha must be below stop_alpha, "
                f"got {self.depth_alpha} and {self.stop_alpha}"
            )
        check.number(where, "cone_scale", self.cone_scale, low=0, open_low=True)
        check.whole(where, "component", self.component, low=0)
        for name, value, kind in (
            ("clip", self.clip, Clip),
            ("layer", self.layer, Layer),
            ("lens", self.lens, ThinLens),
            ("lighting", self.lighting, Lighting),
        ):
            if value is not None:
                check_type(where, name, value, kind)
        if self.lens is not None and self.lod == "finest":
            raise ValueError(f"{where}: a lens blurs by level of detail: lod must be 'auto'")
        if self.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{where}: dtype must be float32 or float64, got {self.dtype}")


def render_options(where: str, camera: Camera, options: dict[str, Any]) -> RenderOptions:
    """Checks a user's options, for a camera."""
    unknown = sorted(set(options) - set(RenderOptions.__dataclass_fields__))
    if unknown:
        raise ValueError(
            f"{where}: unknown option {unknown[0]!r}; "
            f"known: {', '.join(RenderOptions.__dataclass_fields__)}"
        )
    chosen = RenderOptions(**options)
    background = checked_background(where, chosen.background)
    if isinstance(background, Background):
        background.check(where, camera)
    layer = chosen.layer and chosen.layer.cut(where, camera)
    return replace(chosen, background=background, layer=layer)


def check_type(where: str, name: str, value: Any, kind: type) -> None:
    """Raises ValueError unless a user's argument is of a class."""
    if not isinstance(value, kind):
        raise ValueError(f"{where}: {name} must be a {kind.__name__}, got {type(value).__name__}")
