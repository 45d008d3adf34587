"""The built-in shaders: which channels each reads, and which arguments it passes to the kernel.

A shader stands in three files: its struct in cpp_ext/csrc/shaders, listed in shaders.h, which
defines what it does with an interval; its torch twin in ops/reference/shaders.py, with its line in
`SHADER_KINDS` and the record of numbers that only it has; and its class here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, Self, Unpack

import torch

from ..base import check
from ..base.checked import (
    Check,
    also_called,
    class_name,
    flag,
    instance_of,
    name_text,
    optional,
    positive,
)
from ..ops import ShadeArguments
from ..ops.reference.shaders import (
    GradientMagnitudeNumbers,
    IsosurfaceNumbers,
    ProjectionKind,
    ProjectionNumbers,
)
from ..ops.reference.stored_color import StoredColorNumbers
from ..ops.shading import COLOR_WIDTH, Number, Triple, channel_widths, pack
from ..pool import N3Tree
from .lights import LightSettings, LitShader, a_number, a_triple
from .shader import (
    ColorTable,
    CutSurface,
    Sampling,
    Shader,
    check_width,
    number_of_one,
    one_color,
)
from .transfer_function import TransferFunction, integrated_table

__all__ = [
    "DistanceField",
    "Features",
    "GradientMagnitude",
    "Isosurface",
    "Lit",
    "PreIntegrated",
    "Projection",
    "StoredColor",
]

_TRANSFER_CHECK = instance_of(TransferFunction)
_WHITE = TransferFunction.from_points([(0, 1)])
_COLOR_CHECK = a_triple(low=0, high=1)
_PROJECTIONS = {name: name for name in ("maximum", "minimum", "mean")}
_PROJECTIONS |= {"max": "maximum", "min": "minimum"}
# Of `WideIsosurface`:
_RAMP_ROWS = 1025  # of its table
_RAMP_INTERVALS = 3.0  # width of its ramp, in intervals; fitted so that penumbras agree best
_MAX_RAMP_VOXELS = 16  # largest width of a distance field's ramp, in voxels
_OPAQUE_LENGTH = 1e-20  # a reference length so short that any opacity above 0 becomes 1


class Lit(LitShader):
    """The transfer function with Blinn-Phong lighting on both sides of a surface.

    Attributes:
        in_the_way: Shader whose alpha blocks the cones of `Lighting`; None: the transfer function.
    """

    takes_shadows = True
    transfer: TransferFunction
    checks: ClassVar[Mapping[str, Check]] = {
        "transfer": _TRANSFER_CHECK,
        "in_the_way": optional(instance_of(Shader)),
    }

    def __init__(
        self,
        transfer: TransferFunction,
        *,
        shadows: bool = False,
        in_the_way: Shader | None = None,
        **light: Unpack[LightSettings],
    ) -> None:
        """See the class.

        Args:
            transfer: The transfer function.
            shadows: Whether matter between a sample and the light shadows the sample.
            in_the_way: Shader whose alpha blocks the cones of `Lighting`, such as a `Filtered` of
                the same function: these cones are wide, and mean values let too much light through.
                None: the transfer function.
            **light: `normals`, `light`, `ambient`, `diffuse`, `specular`, `shininess`, `octaves`
                and `anisotropy` of `LitShader`.
        """
        super().__init__(**light)
        self.transfer, self.shadows, self.in_the_way = transfer, shadows, in_the_way

    @property
    def kind(self) -> str:  # type: ignore[override]
        return "ShadowedLit" if self.shadows or self.octaves else "Lit"

    @property
    def shows_nothing(self) -> bool:
        return self.transfer.shows_nothing

    def blocker(self) -> Shader:
        return self.in_the_way or self.transfer


class PreIntegrated(Shader):
    """The transfer function, integrated between two samples: thin peaks need no finer steps."""

    kind = "PreIntegrated"
    transfer: TransferFunction
    checks: ClassVar[Mapping[str, Check]] = {"transfer": _TRANSFER_CHECK}

    def __init__(self, transfer: TransferFunction) -> None:
        self.transfer = transfer

    def table(self, sampling: Sampling) -> ColorTable:
        return self.transfer.kept(integrated_table, sampling)


class StoredColor(LitShader):
    """Colour and opacity stored in each voxel: a channel of 4 numbers, linear red, green, blue and
    opacity per reference length; integers are scaled to 0 to 1. Or 24 numbers, 4 for each of six
    directions, as `Volume.directional` makes them: a ray sees a mix of the three that it follows.
    """

    takes_shadows = True
    component = 3
    checks: ClassVar[Mapping[str, Check]] = {
        "channel": name_text,
        "reference": optional(positive),
        "premultiplied": flag,
        "lit": flag,
    }

    def __init__(
        self,
        channel: str,
        *,
        reference: float | None = None,
        premultiplied: bool = False,
        lit: bool = False,
        shadows: bool = False,
        **light: Unpack[LightSettings],
    ) -> None:
        """See the class.

        Args:
            channel: The channel.
            reference: World units for which opacity is given; the smallest spacing if left out, and
                always for six directions.
            premultiplied: Whether colours are stored multiplied by opacity, as they always are for
                six directions. Coarse levels then keep the colours of opaque voxels; otherwise the
                colours of transparent ones mix in.
            lit: Whether it is lit; always true with `normals`, shadows or `octaves`.
            shadows: As in `Lit`.
            **light: As in `Lit`; without `normals`, the normal is the gradient of the opacity (of
                that towards +x, where there are six directions).

        Raises:
            ValueError: A number is out of its range.
        """
        super().__init__(**light)
        self.channel = channel
        self.reference, self.premultiplied = reference, premultiplied
        self.lit, self.shadows = lit or self.normals is not None, shadows

    @property
    def kind(self) -> str:  # type: ignore[override]
        return "ShadowedColor" if self.shadows or self.octaves else "StoredColor"

    def own_numbers(self, tree: N3Tree) -> StoredColorNumbers:
        channel = tree.bricks.channels[str(self.channel)]
        return StoredColorNumbers(
            scale=1 / number_of_one(channel.dtype),
            reference=self.reference or min(tree.spacing),
            premultiplied=float(self.premultiplied or channel.width != COLOR_WIDTH),
            lit=self.lit or self.shadows or self.octaves > 0,
        )

    def unlit(self) -> Self:
        return super().unlit().changed(lit=True)

    def blocker(self) -> StoredColor:
        return self.changed(lit=False, shadows=False, octaves=0)

    def shading(self, context: str, tree: N3Tree) -> ShadeArguments | None:
        widths = channel_widths(COLOR_WIDTH)
        width = check_width(f"{context}: stored colour needs", tree, self.channel, *widths)
        if width != COLOR_WIDTH and self.reference not in (None, min(tree.spacing)):
            raise ValueError(
                f"{context}: {self.channel!r} has six directions, so its opacity is that of the "
                f"smallest spacing, {min(tree.spacing):g}; got reference {self.reference:g}"
            )
        return super().shading(context, tree)


class SurfaceSettings(LightSettings, total=False):
    """The keyword arguments of `Isosurface`, for `DistanceField`, which passes them on."""

    color_channel: str | None
    color_component: int
    premultiplied: bool
    filled: bool


class Isosurface(LitShader):
    """The first point of a ray where the value crosses a level, drawn opaque and lit. The solid is
    where the value is not below the level; it is filled, so its inside is seen where the scene's
    box cuts it, and by rays that begin in it.
    """

    kind = "Isosurface"
    distance = False  # the value is a distance in world units, negative inside
    color: Triple | TransferFunction | None
    color_channel = also_called("other")
    color_component = also_called("other_component")
    checks: ClassVar[Mapping[str, Check]] = {
        "value": a_number(),
        "color": lambda owner, name, value: (
            value
            if value is None or isinstance(value, TransferFunction)
            else _COLOR_CHECK(owner, name, value)
        ),
        "filled": flag,
        "premultiplied": flag,
    }

    def __init__(
        self,
        value: Number,
        color: Triple | TransferFunction | None = (0.8, 0.8, 0.8),
        *,
        color_channel: str | None = None,
        color_component: int = 0,
        premultiplied: bool = False,
        filled: bool = True,
        **light: Unpack[LightSettings],
    ) -> None:
        """Sets the level and how the surface looks.

        Args:
            value: The level, in data units.
            color: Linear red, green, blue, or a transfer function of the second channel's value.
                None: the colour stored in that channel, 4 numbers a voxel (see `StoredColor`).
            color_channel: Name of the second channel, if `color` is a transfer function or None.
            color_component: Index of the number that the transfer function reads from it.
            premultiplied: Whether stored colours are multiplied by their opacity.
            filled: False: a hollow shell, whose inner side is seen by rays that begin inside. A
                `Clip` always draws the surface so, and closes it with its caps, if it has any.
            **light: As in `Lit`.

        Raises:
            ValueError: A number is out of its range, or channel and colour do not fit.
        """
        super().__init__(**light)
        self.value, self.color, self.filled = value, color, filled
        self.other, self.other_component = color_channel, color_component
        self.premultiplied = premultiplied
        self._check_color()

    def _check_color(self) -> None:
        if (self.color is None or isinstance(self.color, TransferFunction)) == (self.other is None):
            parts = "a transfer function or color=None and color_channel"
            raise ValueError(f"{class_name(self)}: {parts} belong together")

    def shading(self, context: str, tree: N3Tree) -> ShadeArguments | None:
        self._check_color()
        if self.color is None:
            check_width(f"{context}: stored colour needs", tree, self.other, COLOR_WIDTH)
        return super().shading(context, tree)

    def table(self, sampling: Sampling) -> ColorTable:
        if isinstance(self.color, TransferFunction):
            return self.color.table(sampling)
        return one_color((1.0, 1.0, 1.0) if self.color is None else self.color, sampling)

    def own_numbers(self, tree: N3Tree) -> IsosurfaceNumbers:
        scale = 0.0
        if self.color is None:
            scale = 1 / number_of_one(tree.bricks.channels[str(self.other)].dtype)
        filled = (-1.0 if self.distance else 1.0) * self.filled
        return IsosurfaceNumbers(self.value, filled, scale, float(self.premultiplied))

    def opened(self) -> Isosurface:
        return self.changed(filled=False)

    def matter(self) -> WideIsosurface:
        if self.color is None or isinstance(self.color, TransferFunction):
            raise ValueError("Isosurface: indirect light needs a surface of one colour")
        return WideIsosurface(self, self.color)

    def blocker(self) -> WideIsosurface:
        return WideIsosurface(self, None)

    def cut_surface(self) -> CutSurface:
        value = Projection("maximum", _WHITE)
        value.channel, value.component = self.channel, self.component
        colors: Shader | None = None
        color = (1.0, 1.0, 1.0) if self.color is None else self.color
        if isinstance(color, TransferFunction):
            colors, color = Projection("maximum", color), (1.0, 1.0, 1.0)
            colors.channel, colors.component = self.other, self.other_component
        elif self.color is None:
            colors = StoredColor(
                str(self.other), reference=_OPAQUE_LENGTH, premultiplied=self.premultiplied
            )
        return CutSurface(
            level=self.value, below=self.distance, value=value, color=color, colors=colors
        )


class DistanceField(Isosurface):
    """The surface of a signed distance field, where it is `offset`; inside, it is smaller."""

    distance = True
    offset = also_called("value")

    def __init__(
        self,
        color: Triple | TransferFunction | None = (0.8, 0.8, 0.8),
        *,
        offset: Number = 0.0,
        **look: Unpack[SurfaceSettings],
    ) -> None:
        """See `Isosurface` for how the surface looks; `offset` is in the unit of the field."""
        super().__init__(offset, color, **look)


class WideIsosurface(Shader):
    """An isosurface for cones wider than a voxel. These read mean values, from which the share of
    the cone that the solid fills is estimated: opacity is a ramp around the level, wider for longer
    intervals, so that shadows are soft.

    In a distance field the solid lies below the level, and the value changes by 1 per unit of
    length. Otherwise it lies above, and the value is assumed to rise from half of the level to
    three halves over four voxels.
    """

    def __init__(self, surface: Isosurface, color: Triple | None) -> None:
        """Copies the surface's level and channels; `color` is None if only its alpha counts."""
        self.kind = None if color is None else "Lit"
        self.channel, self.component = surface.channel, surface.component
        self.normals = surface.normals
        self.level, self.distance = surface.value, surface.distance
        self.color = (0.0, 0.0, 0.0) if color is None else color

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`; computed on the device, where the level may be a tensor. Values more than
        `half_domain_1` (data units) away from the level, outside of the solid, can be skipped.
        """
        dtype, device = sampling.dtype, sampling.device
        value_1 = pack((self.level,), dtype, device)
        if self.distance:
            half_width = _MAX_RAMP_VOXELS / 2 * sampling.smallest_spacing
            half_domain_1 = torch.full_like(value_1, half_width)
            slope_1 = torch.ones_like(value_1)
        else:
            half_domain_1 = value_1.abs() / 2
            slope_1 = half_domain_1 / (2 * sampling.smallest_spacing)
        # At least so wide that the ramp is not a jump.
        half_domain_1 = torch.maximum(half_domain_1, 1e-5 * value_1.abs().clamp(min=1))
        length_l = sampling.step * 2 ** torch.arange(sampling.levels, dtype=dtype, device=device)
        half_ramp_l = (_RAMP_INTERVALS / 2 * slope_1 * length_l).clamp(min=1e-30)
        half_ramp_l = torch.minimum(half_ramp_l, half_domain_1)
        offset_m = half_domain_1 * torch.linspace(-1, 1, _RAMP_ROWS, dtype=dtype, device=device)
        inside_m = -offset_m if self.distance else offset_m
        color_4 = pack((self.color, 0.0), dtype, device)
        table = color_4.expand(sampling.levels, _RAMP_ROWS, 4).clone()
        fraction_lm = (0.5 + inside_m / (2 * half_ramp_l[:, None])).clamp(0, 1)
        # A cone that grazes a surface meets it in about four intervals, so each gets a quarter of
        # the optical depth.
        table[:, :, 3] = 1 - (1 - fraction_lm).sqrt().sqrt()
        visible_m = (table[:, :, 3] > 0).any(0)
        return ColorTable(
            table_lm4=table,
            domain_2=torch.cat((value_1 - half_domain_1, value_1 + half_domain_1)),
            opaque_m=visible_m.cumsum(0, dtype=torch.int32),
        )


class Projection(Shader):
    """The maximum, minimum or mean of the values along each ray, in the colours of the transfer
    function and opaque. `Hits.features` (r, 1) holds the value itself (0 where a ray misses the
    box); depth is that of the extreme or, for the mean, where the ray enters.
    """

    kind = "Projection"
    whole_ray = True
    which: Literal["maximum", "minimum", "mean"]
    projection = also_called("which")
    checks: ClassVar[Mapping[str, Check]] = {
        "which": lambda owner, name, value: _projection(value),
        "transfer": _TRANSFER_CHECK,
    }

    def __init__(
        self,
        which: Literal["maximum", "minimum", "mean", "max", "min"],
        transfer: TransferFunction,
    ) -> None:
        """Sets which projection to show, and its colours.

        Raises:
            ValueError: There is no such projection.
        """
        self.which = which  # type: ignore[assignment]
        self.transfer = transfer

    def own_numbers(self, tree: N3Tree) -> ProjectionNumbers:
        return ProjectionNumbers(ProjectionKind[self.which.upper()])


class Features(Shader):
    """All c numbers of a channel, composited front to back with the transfer function's alpha and
    returned as `Hits.features` (r, c). c may be any number. `other` is the name of this channel;
    `channel`, as of every shader, is that of the density.
    """

    kind = "Features"
    checks: ClassVar[Mapping[str, Check]] = {
        "transfer": _TRANSFER_CHECK,
        "other": lambda owner, _, value: name_text(owner, "channel", value),
    }

    def __init__(self, transfer: TransferFunction, channel: str) -> None:
        """Sets the transfer function of the density, and the name of the channel of features."""
        self.transfer, self.other = transfer, channel


class GradientMagnitude(Shader):
    """The transfer function with its optical depth multiplied by min(1, gradient length / `full`):
    boundaries show, and homogeneous regions between them become transparent.

    Source: Levoy, "Display of surfaces from volume data", IEEE CG&A 1988 (opacity by gradient).
    """

    kind = "GradientMagnitude"
    transfer: TransferFunction
    checks: ClassVar[Mapping[str, Check]] = {
        "transfer": _TRANSFER_CHECK,
        "full": optional(a_number(low=1e-30)),
    }

    def __init__(self, transfer: TransferFunction, full: Number | None = None) -> None:
        """Sets the transfer function, and the gradient from which it has its full opacity.

        Args:
            transfer: The transfer function.
            full: Length of the gradient, value per world unit; if left out, an eighth of the
                function's domain over one voxel.

        Raises:
            ValueError: `full` is not positive.
        """
        self.transfer, self.full = transfer, full

    def own_numbers(self, tree: N3Tree) -> GradientMagnitudeNumbers:
        low, high, _ = self.transfer.corners()
        domain = (high - low) / (8 * min(tree.spacing))
        return GradientMagnitudeNumbers(domain if self.full is None else self.full)


#: Single-channel shaders by name: what each shows, and how it is made of a transfer function and a
#: level. `gvtorch render --shader` offers them, and `gvtorch bench shaders` measures them.
BY_NAME: Mapping[str, tuple[str, Callable[[TransferFunction, float], Shader]]] = {
    "plain": ("transfer function alone", lambda transfer, _: transfer),
    "lit": ("with lighting", lambda transfer, _: Lit(transfer)),
    "preintegrated": (
        "plain, but keeps thin peaks of the function",
        lambda transfer, _: PreIntegrated(transfer),
    ),
    "isosurface": ("surface at --value", lambda _, level: Isosurface(level)),
    "maximum": ("of the values along a ray", lambda transfer, _: Projection("maximum", transfer)),
    "minimum": ("of the values along a ray", lambda transfer, _: Projection("minimum", transfer)),
    "mean": ("of the values along a ray", lambda transfer, _: Projection("mean", transfer)),
    "gradient": ("boundaries", lambda transfer, _: GradientMagnitude(transfer)),
}


def named_shader(name: str, transfer: TransferFunction, level: float = 0.0) -> Shader:
    """Returns the shader of `BY_NAME` for a transfer function and a level."""
    return BY_NAME[name][1](transfer, level)


def _projection(which: Any) -> str:
    check.one_of("Projection", "which", which, _PROJECTIONS)
    return _PROJECTIONS[which]
