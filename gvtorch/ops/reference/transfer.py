"""Part of the torch twin: the transfer function and compositing, as csrc/walk/shade.h."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..arguments import TraceArguments
from .exact import TINY, clamp, divide, larger, log2_exact, smaller, stretch
from .rays import INF, Beam

_SLACK = 2.0**-20  # relative


@dataclass
class Piece:
    """An interval of every ray: a whole one, or an odd one of any length."""

    start: Tensor  # (r,)
    end: Tensor  # (r,)
    middle: Tensor  # (r,) where values are taken
    length: Tensor  # (r,)
    lengths: Tensor  # (r,) the same in shortest intervals
    odd: Tensor  # (r,) bool
    level: Tensor  # (r,) int64, of the whole interval that starts here
    base: Tensor  # (r,) where its level was chosen
    count: Tensor  # (r,) its number since then, as a float


class Accumulator:
    """Front-to-back sums of every ray."""

    def __init__(self, beam: Beam, hit_clear: Tensor, clear_r: Tensor | None) -> None:
        one = torch.ones_like(beam.first)
        self.color = torch.zeros_like(beam.origin)  # (r, 3) premultiplied
        self.clear = one if clear_r is None else clear_r.to(one)  # (r,) transmittance
        self.depth = one * INF  # (r,) where the transmittance falls to hit_clear; +inf: nowhere
        self.hit_clear = hit_clear  # ()

    def hits(self, beam: Beam) -> tuple[Tensor, Tensor, Tensor]:
        """Colours (r, 3), alphas (r, 1) and world depths (r, 1)."""
        return self.color, (1 - self.clear)[:, None], (self.depth + beam.moved)[:, None]

    def add(self, rgba: Tensor, piece: Piece, where: Tensor) -> None:
        """Adds an interval of a colour and an alpha where `where` is true."""
        share = self.clear * rgba[:, 3]
        self.add_light(share[:, None] * rgba[:, :3], where)
        self.absorb(rgba[:, 3], piece, where)

    def add_light(self, color: Tensor, where: Tensor) -> None:
        """Adds (r, 3) light that comes to the eye, where `where` is true."""
        self.color = torch.where(where[:, None], self.color + color, self.color)

    def absorb(self, alpha: Tensor, piece: Piece, where: Tensor) -> None:
        """Lets an interval take its share of the light where `where` is true. Depth is where,
        inside it, the transmittance fell to hit_clear, as if it were of one value.
        """
        kept = 1 - alpha
        left = self.clear * kept
        hit = where & (left < self.hit_clear) & (self.clear >= self.hit_clear)
        solid = ~(kept > TINY)
        part = log2_exact(torch.where(hit, self.hit_clear / self.clear, 1.0))
        part = part / log2_exact(torch.where(hit & ~solid, kept, 0.5))
        part = torch.where(solid, 0.0, clamp(part, 0, 1))
        self.depth = torch.where(hit, piece.start + part * piece.length, self.depth)
        self.clear = torch.where(where, left, self.clear)


class Transfer:
    """The transfer function: rows at even distances over a domain; see `TraceArguments`."""

    def __init__(self, a: TraceArguments) -> None:
        self.table_lm4, self.domain_2, self.opaque_m = a.table_lm4, a.domain_2, a.opaque_m

    def place(self, value: Tensor) -> Tensor:
        """(r,) rows of values, with a fraction."""
        low, high = self.domain_2.unbind(0)
        last = len(self.opaque_m) - 1
        return clamp((value - low) * divide(last, high - low, high), 0, last)

    def cell(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """(r,) int64 rows before values, and (r,) how far they are on the way to the next."""
        place = self.place(value)
        row = smaller(torch.floor(place), torch.full_like(place, len(self.opaque_m) - 2))
        return row.to(torch.int64), place - row

    def look_up(self, value: Tensor, level: Tensor | None = None) -> Tensor:
        """(r, 4) linear RGB and the alpha of an interval of each ray's level; None: the first."""
        row, weight = self.cell(value)
        which = torch.zeros_like(row) if level is None else level
        return mix(self.table_lm4[which, row], self.table_lm4[which, row + 1], weight)

    def interval(self, value: Tensor, piece: Piece) -> Tensor:
        """(r, 4) linear RGB and the alpha of an interval of one value."""
        odd, whole = self.look_up(value), self.look_up(value, piece.level)
        alpha = stretch(odd[:, 3], piece.lengths)[:, None]
        odd = torch.cat((odd[:, :3], alpha), 1)
        return torch.where(piece.odd[:, None], odd, whole)

    def transparent(self, smallest: Tensor, largest: Tensor) -> Tensor:
        """Bool: no value between the two is seen."""
        first = torch.floor(self.place(below(smallest))).to(torch.int64)
        end = torch.ceil(self.place(above(largest))).to(torch.int64)
        before = torch.where(first > 0, self.opaque_m[(first - 1).clamp(min=0)], 0)
        return self.opaque_m[end] == before


def mix(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """(r, c) numbers between two."""
    return a + weight[:, None] * (b - a)


def above(value: Tensor) -> Tensor:
    """A little more, since interpolation may round beyond its ends."""
    return value + larger(value, -value) * _SLACK


def below(value: Tensor) -> Tensor:
    """A little less."""
    return value - larger(value, -value) * _SLACK
