"""`ThinLens`: depth of field by a double cone.

A ray's cone is its pixel's, widened by the circle of confusion, which shrinks towards the focus and
grows behind it. So it is traced as two pieces: a narrowing cone, then a widening one. Where the
picture is blurred, voxels as wide as the blur are read: fewer samples and fewer bricks.

Sources: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and
Detailed Voxel Rendering", I3D 2009, section 5; Crassin, PhD thesis 2011, on depth of field;
Potmesil and Chakravarty, "A lens and aperture camera model for synthetic image generation", 1981,
for the circle of confusion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..base import check
from ..base.records import Hits, Rays
from ..cameras.poses import Coordinates
from .composite import TraceRays, trace_pieces

#: Width of the lens's cone over the diameter d of the circle of confusion. Trilinear voxels of
#: side v blur with a variance of v^2 / 4, a disc with d^2 / 16, so v = d / 2 would blur as much.
#: The fitted value is smaller: the pixel's cone is added, and blurred density makes opaque things
#: grow.
_CONE_OF_LENS = 0.3


@dataclass(frozen=True, kw_only=True)
class ThinLens:
    """A lens in front of the camera that is sharp at one distance only.

    At distance t a pixel sees a disc of diameter aperture * |t - focus| / focus. Distances are
    along rays, so that a sphere around the eye is sharp, with every camera model.
    """

    aperture: float  # diameter of the lens, in the unit of `frame`
    focus: float  # distance at which things are sharp, in the unit of `frame`
    frame: Coordinates | str = Coordinates.WORLD  # or "box": largest sides of the scene's box

    def __post_init__(self) -> None:
        vars(self).update(
            aperture=check.number("ThinLens", "aperture", self.aperture, low=0),
            focus=check.number("ThinLens", "focus", self.focus, low=0, open_low=True),
            frame=Coordinates.of("ThinLens", self.frame),
        )

    __repr__ = check.summary

    def placed(self, box: Tensor) -> ThinLens:
        """Returns the lens in world units, given the (2, 3) box of the scene."""
        unit = Coordinates(self.frame).unit(box)
        return ThinLens(aperture=self.aperture * unit, focus=self.focus * unit)

    def cone(self, t: Tensor) -> Tensor:
        """Returns the width of the lens's cone at distances t, for a lens in world units."""
        return _CONE_OF_LENS * self.aperture / self.focus * (t - self.focus).abs()


@dataclass(frozen=True)
class ThroughLens:
    """Traces rays whose cones are widened by a lens."""

    trace: TraceRays
    lens: ThinLens  # in world units
    cone_scale: float  # the tracer's factor on cones; divided out, so it does not widen the lens's

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays up to the focus, then behind it."""
        return trace_pieces(self.trace, (self._piece(rays, -1), self._piece(rays, 1)))

    def _piece(self, rays: Rays, side: int) -> Rays:
        """Returns the pieces of rays before the focus (`side` -1) or behind it (1)."""
        cone, (first, last) = rays.cone.to(torch.float64), rays.range.to(torch.float64).unbind(1)
        focus = self.lens.focus
        lens_width = _CONE_OF_LENS * self.lens.aperture / self.cone_scale  # its cone at the eye
        width, growth = cone[:, 0] - side * lens_width, cone[:, 1] + side * lens_width / focus
        if side < 0:
            last = last.clamp(max=focus)
        else:
            first = first.clamp(min=focus)
        cone, span = torch.stack((width, growth), 1), torch.stack((first, last), 1)
        return replace(rays, cone=cone, range=span)
