"""`RenderOptions`: the options of a picture, checked once. Functions that render show them as their
keyword arguments (base/explicit.py). `RenderSettings` declares the same for type checkers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypedDict

import torch
from torch import Tensor

from ..base import check
from ..base import constants as config
from ..cameras.camera import Camera
from ..ops.registry import Backend
from ..pictures.background import Background, checked_background
from .clip import Clip
from .layer import Layer
from .lighting import Lighting
from .pose import Matrix, checked_poses
from .thin_lens import ThinLens


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Options of a picture. `help` of rendering functions shows these texts. Threads may share one.

    Attributes:
        step: Shortest interval, in voxels of the finest level, > 0.
        lod: auto: voxels as wide as the pixel cone; finest: the finest level everywhere.
        background: A colour (linear RGB, 0 to 1), a `Gradient`, `Backdrop` or `Environment`, an
            image (h, w, 3) of the picture's size, or None: transparent.
        stop_alpha: A ray ends at this alpha, 0 to 1; 1 integrates to the end.
        depth_alpha: Depth is where alpha passes this, below `stop_alpha`.
        cone_scale: Widens the pixel cone by this factor, > 0; larger reads coarser voxels.
        channel: Name of the channel that the shader reads; None: the first.
        component: Which number of the channel, from 0.
        layer: Another renderer's picture, composited with the voxels by depth.
        clip: The region of interest; None: everything.
        lens: Depth of field; None: all is sharp.
        lighting: Shadows, ambient occlusion and indirect light; None: the shader's own light.
        pose: Placement of a tree: a (4, 4) matrix from its axes to the world's that rotates and
            shifts (and may mirror), or one for each tree by name; None: its axes are the world's.
        backend: auto, reference, cpp or cuda; all give the same bits.
        dtype: Of rays and picture: float32, or float64 for very thin media and narrow cones.
    """

    step: float = config.STEP
    lod: Literal["auto", "finest"] = "auto"
    background: tuple[float, float, float] | Background | Tensor | None = (0.0, 0.0, 0.0)
    stop_alpha: float = config.STOP_ALPHA
    depth_alpha: float = config.DEPTH_ALPHA
    cone_scale: float = config.CONE_OVERESTIMATE
    channel: str | None = None
    component: int = 0
    layer: Layer | None = None
    clip: Clip | None = None
    lens: ThinLens | None = None
    lighting: Lighting | None = None
    pose: Matrix | Mapping[str, Matrix] | None = None
    backend: Backend = "auto"
    dtype: torch.dtype = torch.float32

    def __post_init__(self) -> None:
        context = "render"
        vars(self).update(
            step=check.number(context, "step", self.step, low=0, open_low=True),
            background=checked_background(context, self.background),
            stop_alpha=check.number(
                context, "stop_alpha", self.stop_alpha, low=0, high=1, open_low=True
            ),
            depth_alpha=check.number(context, "depth_alpha", self.depth_alpha, low=0, high=1),
            cone_scale=check.number(context, "cone_scale", self.cone_scale, low=0, open_low=True),
            component=check.integer(context, "component", self.component, low=0),
            pose=checked_poses(context, self.pose),
        )
        check.one_of(context, "lod", self.lod, ("auto", "finest"))
        if self.depth_alpha >= self.stop_alpha:
            got = f"{self.depth_alpha} and {self.stop_alpha}"
            raise ValueError(f"{context}: depth_alpha must be below stop_alpha, got {got}")
        check.instance(context, "backend", self.backend, str)
        kinds = dict(channel=str, clip=Clip, layer=Layer, lens=ThinLens, lighting=Lighting)
        for name, kind in kinds.items():
            if getattr(self, name) is not None:
                check.instance(context, name, getattr(self, name), kind)
        if self.lens is not None and self.lod == "finest":
            raise ValueError(f"{context}: a lens blurs by level of detail: lod must be 'auto'")
        if self.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{context}: dtype must be float32 or float64, got {self.dtype}")

    __repr__ = check.summary


class RenderSettings(TypedDict, total=False):
    """The fields of `RenderOptions`, all optional."""

    step: float
    lod: Literal["auto", "finest"]
    background: tuple[float, float, float] | Background | Tensor | None
    stop_alpha: float
    depth_alpha: float
    cone_scale: float
    channel: str | None
    component: int
    layer: Layer | None
    clip: Clip | None
    lens: ThinLens | None
    lighting: Lighting | None
    pose: Matrix | Mapping[str, Matrix] | None
    backend: Backend
    dtype: torch.dtype


def render_options(
    context: str, settings: Mapping[str, Any], camera: Camera | None = None
) -> RenderOptions:
    """Returns a user's options, with the layer cut to the camera if there is one. Raises ValueError
    if one is unknown, of the wrong type or out of its range, or does not fit the camera's pictures.
    """
    check.known_options(context, settings, RenderSettings)
    options = RenderOptions(**settings)
    if camera is None:
        return options
    if isinstance(options.background, Background):
        options.background.check(context, camera)
    if options.layer is None:
        return options
    return replace(options, layer=options.layer.cut(context, camera))
