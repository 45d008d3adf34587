"""Shadows in the torch twin of `shade_rays`: from samples, cones go to the light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .march import Accumulator, Piece, Probe, walk
from .rays import Beam, Intervals
from .tree import Bricks, Tree

if TYPE_CHECKING:
    from .shaders import Shade


@dataclass
class Shadows:
    """What cones from samples to the light go through, and what they cost."""

    beam: Beam  # the eye's
    tree: Tree
    step: float
    levels: int  # lengths of intervals
    stop_clear: Tensor
    cone_scale: Tensor
    samples: Tensor  # (r,) int32
    missed: Tensor  # (r,) bool

    def share(
        self,
        shade: Shade,
        t: Tensor,
        way: Tensor,
        length: Tensor,
        growth: Tensor,
        where: Tensor,
    ) -> Tensor:
        """(r,) share of a light, `length` (r,) away, that comes to places t (r,), where `where` is
        true. A cone is as wide there as the eye's; its first interval is left out, so that a place
        does not stand in its own shadow.
        """
        which = where.nonzero()[:, 0]
        t, way = t[which], way[which]
        eye = self.beam
        beam = Beam(
            origin=eye.origin[which] + t[:, None] * eye.direction[which],
            direction=way / shade.cube,
            high=eye.high,
            cone_near=eye.cone_near[which] + eye.cone_growth[which] * t,
            cone_growth=growth[which] * self.cone_scale,
            first=torch.zeros_like(t),
            last=length[which],
            moved=torch.zeros_like(t),
        )
        beam.clip()
        at = Intervals.begin(beam, self.step, self.levels)
        at.next(torch.ones_like(where[which]))
        veil = Veil(shade, way, Accumulator.begin(beam))
        step = torch.tensor(self.step, dtype=t.dtype).to(t)
        samples, visit = walk(beam, at, self.tree, shade.channel, veil, step, self.stop_clear)
        self.samples[which] += samples
        self.missed[which] |= visit.missed
        return torch.ones_like(length).index_put((which,), veil.sum.clear)


@dataclass
class Veil:
    """What a shader takes from the light that goes through: the shader of rays to a light."""

    shade: Shade
    along: Tensor  # (r, 3) world
    sum: Accumulator
    sees_empty: bool = False

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """See `reference.Shader`."""
        return self.shade.hides(which, low, high)

    def same(self, bricks: Bricks, fine: Tensor, coarse: Tensor) -> Tensor:
        """See `reference.Shader`."""
        return self.shade.equal(fine, coarse)

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `reference.Shader`."""
        clear = self.sum.clear * (1 - self.shade.alpha(piece, probe, self.along))
        self.sum.clear = torch.where(where, clear, self.sum.clear)
