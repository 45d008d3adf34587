"""Part of the torch twin: the lit transfer function, and the base of all fused shaders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from ..shading import LightKind
from .light import Light, Shadows
from .march import Interval, Plain, Probe, Walk
from .tree import ChannelBricks


@dataclass
class Lit(Plain):
    """The lit transfer function, and the base of all fused shaders."""

    light: Light
    other: ChannelBricks | None  # the second channel
    features: Tensor  # (r, c) sums
    shadows: Shadows | None
    bricks: ClassVar[type[ChannelBricks]] = ChannelBricks  # how it reads its channel
    integrates: ClassVar[bool] = False  # its table is (l, m, m, 4)
    colored: ClassVar[bool] = False  # its channel holds colours: see `channel_widths`
    filtered: ClassVar[int] = 0  # above 0: width of the colours in its second channel, of which
    # only the pool's first bricks have them
    feature_count: ClassVar[int | None] = 0  # None: as many as its second channel is wide

    def __post_init__(self) -> None:
        self.normal = torch.zeros_like(self.light.direction)  # (r, 3) sum

    def same(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """As `Visitor.same`; false for shadows, and for stored normals with a point light."""
        same = torch.ones_like(fine, dtype=torch.bool)
        for channel in (self.channel, self.light.normals, self.other):
            if channel is not None:
                numbers = channel.constant_nc
                same = same & (numbers[fine] == numbers[coarse]).all(1)
        has_normals = self.light.normals is not None
        varies = self.light.parameters.light_kind == LightKind.POINT and has_normals
        return (same | (fine == coarse)) & (self.shadows is None) & (not varies)

    def add(self, interval: Interval, probe: Probe, mask: Tensor) -> None:
        self.lit(self.rgba(interval, probe), interval, probe, mask)

    def lit(self, rgba: Tensor, interval: Interval, probe: Probe, mask: Tensor) -> None:
        """Lights an interval and adds it."""
        t, shown = interval.middle, mask & (rgba[:, 3] > 0)
        normal = self.light.normal_at(probe, t)
        is_headlight = self.light.parameters.light_kind == LightKind.HEADLIGHT
        shadow = None  # no shadows
        if self.shadows is not None and not is_headlight:
            shadow = partial(self.light_share, self.shadows, t, shown)
        color = self.light.shade(rgba[:, :3], normal, t, shadow)
        color = torch.where(shown[:, None], color, rgba[:, :3])
        weight = self.sum.clear * rgba[:, 3]
        self.add_normal(weight[:, None] * normal, shown)
        self.sum.add(torch.cat((color, rgba[:, 3:]), 1), interval, mask)

    def add_normal(self, normal: Tensor, mask: Tensor) -> None:
        """Adds normals (r, 3), weighted by light, where `mask` is true."""
        self.normal = torch.where(mask[:, None], self.normal + normal, self.normal)

    def light_share(self, shadows: Shadows, t: Tensor, shown: Tensor, facing: Tensor) -> Tensor:
        """Returns (r,) the share of light that reaches t (r,), where it is seen and faces it."""
        shader = replace(self, shadows=None)
        return shadows.light_share(shader, t, *self.light.towards(t), shown & facing, self.light)

    def done(self, walk: Walk) -> None:
        """Finishes after the last interval."""
