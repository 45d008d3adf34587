"""Part of the torch twin: shadows. From samples, cones go to the light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .march import Plain, Probe, Visitor, Walk
from .rays import Intervals
from .transfer import Piece


@dataclass
class Shadows:
    """What cones from samples to the light go through, and what they cost."""

    walk: Walk  # the eye's
    cube: Tensor  # (3,) world size of the root cube
    cone_scale: float

    def __post_init__(self) -> None:
        """No cone went yet."""
        self.samples = torch.zeros_like(self.walk.samples)
        self.missed = torch.zeros_like(self.walk.missed)

    def share(
        self,
        matter: Plain,
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
        t, way, eye = t[which], way[which], self.walk.at.beam[which]
        beam = replace(
            eye,
            origin=eye.origin + t[:, None] * eye.direction,
            direction=way / self.cube,
            cone_near=eye.cone(t),
            cone_growth=growth[which] * self.cone_scale,
            first=torch.zeros_like(t),
            last=length[which],
            moved=torch.zeros_like(t),
        ).clipped()
        length_l = self.walk.at.length_l
        at = Intervals.begin(beam, length_l[0], len(length_l))
        at.next(torch.ones_like(where[which]))
        veil = Veil(matter.transfer, matter.channel, matter, way, torch.ones_like(t))
        walk = Walk(at, self.walk.tree, matter.channel)
        walk.go(veil)
        self.samples[which] += walk.samples
        self.missed[which] |= walk.missed
        return torch.ones_like(length).index_put((which,), veil.clear)


@dataclass
class Veil(Visitor):
    """What matter takes from the light that goes through."""

    matter: Plain
    along: Tensor  # (r, 3) world
    clear: Tensor  # (r,) transmittance

    def hides(self, which: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """See `Visitor`."""
        return self.matter.hides(which, low, high)

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """See `Visitor`."""
        return self.matter.same(fine, coarse)

    def goes_on(self, leaves: Tensor) -> Tensor:
        """See `Visitor`."""
        return self.clear > self.matter.stop_clear

    def add(self, piece: Piece, probe: Probe, where: Tensor) -> None:
        """See `Visitor`."""
        clear = self.clear * (1 - self.matter.alpha(piece, probe, self.along))
        self.clear = torch.where(where, clear, self.clear)
