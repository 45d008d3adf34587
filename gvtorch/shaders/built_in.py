"""The built-in shaders: what each reads, and what it tells the kernel.

A shader stands in three files, once in each: its struct in cpp_ext/csrc/shaders/shaders.h, which
tells what it does with an interval; its torch twin in ops/reference/shaders.py; and its class here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from typing import Any, Literal, Self

from ..base import check
from ..ops import ShadeArguments
from ..ops.shading import (
    GradientMagnitudeNumbers,
    IsosurfaceNumbers,
    Number,
    ProjectionKind,
    ProjectionNumbers,
    StoredColorNumbers,
    Triple,
)
from ..pool import Channel, N3Tree
from .integrated_table import integrated_table
from .lights import check_number, check_triple
from .lit import LitShader
from .shader import CutSurface, Shader, number_of_one
from .solid import Solid
from .tables import ColorTable, Sampling, TableCache, one_color
from .transfer_function import TransferFunction, check_transfer

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

_WHITE = TransferFunction.from_points([(0, 1)])


class Lit(LitShader):
    """The transfer function, lit by Blinn and Phong on both sides of a surface."""

    kind = "Lit"
    shadowed_kind = "ShadowedLit"

    def __init__(self, transfer: TransferFunction, *, shadows: bool = False, **light: Any) -> None:
        """Takes a transfer function.

        Args:
            transfer: The transfer function.
            shadows: Whether matter takes light from what lies behind it; see `LitShader`.
            **light: `normals`, `light`, `ambient`, `diffuse`, `specular` and `shininess` as in
                `Isosurface`.
        """
        super().__init__(**light)
        self.transfer, self.shadows = check_transfer("Lit", "transfer", transfer), shadows

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`."""
        return self.transfer.table(sampling)

    def blocker(self) -> TransferFunction:
        """See `Shader`."""
        return self.transfer


class PreIntegrated(Shader):
    """The transfer function, integrated over what lies between two samples: thin shells in the
    function need no finer steps.
    """

    kind = "PreIntegrated"

    def __init__(self, transfer: TransferFunction) -> None:
        """Takes a transfer function."""
        self.transfer = check_transfer("PreIntegrated", "transfer", transfer)
        self._tables = TableCache()

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`. The last tables are kept."""
        transfer = self.transfer
        key = transfer.key(sampling)
        return self._tables.get(key, lambda: integrated_table(transfer, sampling))


class StoredColor(LitShader):
    """Colour and opacity as each voxel holds them: a channel of 4 numbers, linear red, green, blue
    and opacity per reference length. Integers stand for 0 to 1. Or 24 numbers, these for each of
    six directions, as `Volume.directional` makes them: a ray sees those that it goes along.
    """

    kind = "StoredColor"
    shadowed_kind = "ShadowedColor"
    component = 3

    def __init__(
        self,
        channel: str,
        *,
        reference: float | None = None,
        premultiplied: bool = False,
        lit: bool = False,
        shadows: bool = False,
        **light: Any,
    ) -> None:
        """Takes the channel's name.

        Args:
            channel: The channel.
            reference: World units; the smallest spacing if left out, and for six directions.
            premultiplied: Whether colours are stored times opacity, as they are for six directions.
                Then coarse levels keep the colours of what is opaque; else air's colour mixes in.
            lit: Whether it is lit; so it is where `normals` are named, and with shadows.
            shadows: As in `Lit`.
            **light: `normals`, `light`, `ambient`, `diffuse`, `specular`, `shininess` as in
                `Isosurface`; without `normals`, they are the gradient's of the opacity (towards
                +x, where there are six directions).

        Raises:
            ValueError: The reference length is not positive, or see `Isosurface`.
        """
        super().__init__(**light)
        if reference is not None:
            check.number("StoredColor", "reference", reference, low=0, open_low=True)
        self.channel = _name("StoredColor", channel)
        self.reference, self.premultiplied = reference, premultiplied
        self.lit, self.shadows = lit or self.normals is not None, shadows

    def table(self, sampling: Sampling) -> ColorTable:
        """Says how many lengths of intervals there are; its colours are not read."""
        return one_color((1.0, 1.0, 1.0), sampling)

    def own_numbers(self, tree: N3Tree) -> StoredColorNumbers:
        """See `Shader`."""
        scale = 1 / number_of_one(tree.bricks.channels[str(self.channel)].dtype)
        reference = self.reference or min(tree.spacing)
        directional = tree.bricks.channels[str(self.channel)].width != 4
        return StoredColorNumbers(
            scale=scale,
            reference=reference,
            premultiplied=float(self.premultiplied or directional),
            lit=self.lit or self.shadows,
        )

    def unlit(self) -> Self:
        """See `Shader`."""
        bare = super().unlit()
        bare.lit = True
        return bare

    def blocker(self) -> StoredColor:
        """See `Shader`; it needs no normals."""
        bare = copy(self)
        bare.lit = bare.shadows = False
        return bare

    def shading(self, where: str, tree: N3Tree) -> ShadeArguments | None:
        """See `Shader`."""
        known = tree.bricks.channels.get(str(self.channel), Channel(width=4))
        if known.width not in (4, 24):
            raise ValueError(
                f"{where}: stored colour needs 4 numbers a voxel, or 24 for six directions, "
                f"{self.channel!r} has {known.width}"
            )
        if known.width == 24 and self.reference not in (None, min(tree.spacing)):
            raise ValueError(
                f"{where}: {self.channel!r} has six directions, so its opacity is that of the "
                f"smallest spacing, {min(tree.spacing):g}; got reference {self.reference:g}"
            )
        return super().shading(where, tree)


class Isosurface(LitShader):
    """The first place where the value passes a level, opaque and lit. Where a cap cuts it, it
    is filled with what is not below the level.
    """

    kind = "Isosurface"
    distance = False  # the value is a distance in world units, negative inside

    def __init__(
        self,
        value: Number,
        color: Triple | TransferFunction = (0.8, 0.8, 0.8),
        *,
        color_channel: str | None = None,
        color_component: int = 0,
        **light: Any,
    ) -> None:
        """Takes the level and how the surface looks.

        Args:
            value: The level, in data units.
            color: Linear red, green, blue, or a transfer function of the second channel's value.
            color_channel: Name of the second channel, for a transfer function.
            color_component: Which number of it.
            **light: normals: name of a channel of 3 numbers that holds normals (unsigned integers
                stand for -1 to 1), the gradient's if left out. light: a `Headlight` if left out.
                ambient, diffuse, specular: factors, 0.2, 0.8 and 0.3. shininess: exponent, 40.

        Raises:
            ValueError: A number is out of its range, or channel and colour do not fit.
        """
        super().__init__(**light)
        check_number("Isosurface", "value", value)
        if isinstance(color, TransferFunction) != (color_channel is not None):
            raise ValueError("Isosurface: a transfer function and color_channel belong together")
        if not isinstance(color, TransferFunction):
            check_triple("Isosurface", "color", color, low=0, high=1)
        self.value, self.color = value, color
        self.other, self.other_component = color_channel, color_component

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`."""
        if isinstance(self.color, TransferFunction):
            return self.color.table(sampling)
        return one_color(self.color, sampling)

    def own_numbers(self, tree: N3Tree) -> IsosurfaceNumbers:
        """See `Shader`."""
        return IsosurfaceNumbers(self.value)

    def matter(self) -> Solid:
        """See `Shader`.

        Raises:
            ValueError: It has no colour of its own.
        """
        if isinstance(self.color, TransferFunction):
            raise ValueError("Isosurface: indirect light needs a surface of one colour")
        return Solid(self, self.value, self.color, distance=self.distance)

    def blocker(self) -> Solid:
        """See `Shader`."""
        return Solid(self, self.value, None, distance=self.distance)

    def cut_surface(self) -> CutSurface:
        """See `Shader`."""
        value, colors = Projection("maximum", _WHITE), None
        value.channel, value.component = self.channel, self.component
        color = self.color
        if isinstance(color, TransferFunction):
            colors, color = Projection("maximum", color), (1.0, 1.0, 1.0)
            colors.channel, colors.component = self.other, self.other_component
        return CutSurface(
            level=self.value, below=self.distance, value=value, color=color, colors=colors
        )


class DistanceField(Isosurface):
    """The surface of a signed distance field: where the distance is `offset`, 0 if left out. Inside
    the distance is smaller.
    """

    distance = True

    def __init__(
        self,
        color: Triple | TransferFunction = (0.8, 0.8, 0.8),
        *,
        offset: Number = 0.0,
        **look: Any,
    ) -> None:
        """Takes how the surface looks, see `Isosurface`; `offset` is in the field's own unit."""
        super().__init__(offset, color, **look)


class Projection(Shader):
    """The maximum, minimum or mean of the value along each ray, coloured by the transfer function's
    colours and opaque. `Hits.features` (r, 1) holds the value itself (0 beside the box), depth
    where the extreme is or, for the mean, where the ray enters.
    """

    kind = "Projection"
    whole_ray = True

    def __init__(
        self, which: Literal["maximum", "minimum", "mean"], transfer: TransferFunction
    ) -> None:
        """Takes which one, and the colours.

        Raises:
            ValueError: There is no such projection.
        """
        if which not in ("maximum", "minimum", "mean"):
            raise ValueError(
                f"Projection: which must be 'maximum', 'minimum' or 'mean', got {which!r}"
            )
        self.which, self.transfer = which, check_transfer("Projection", "transfer", transfer)

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`."""
        return self.transfer.table(sampling)

    @property
    def projection(self) -> Literal["maximum", "minimum", "mean"]:
        """See `Shader`."""
        return self.which

    def own_numbers(self, tree: N3Tree) -> ProjectionNumbers:
        """See `Shader`."""
        return ProjectionNumbers(ProjectionKind[self.which.upper()])

    def feature_count(self, tree: N3Tree) -> int:
        """The value."""
        return 1


class Features(Shader):
    """All numbers of a channel, composited front to back with the transfer function's alpha: they
    come out as `Hits.features` (r, c). Any number of them.
    """

    kind = "Features"

    def __init__(self, transfer: TransferFunction, channel: str) -> None:
        """Takes the transfer function of the density, and the name of the features' channel."""
        self.transfer = check_transfer("Features", "transfer", transfer)
        self.other = _name("Features", channel)

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`."""
        return self.transfer.table(sampling)

    def feature_count(self, tree: N3Tree) -> int:
        """As many as the channel holds."""
        return tree.bricks.channels[str(self.other)].width


class GradientMagnitude(Shader):
    """The transfer function, the denser the faster the value changes: optical depth is times the
    gradient's length over `full`, 1 at most. So boundaries show, and what lies between them clears.

    Source: Levoy, "Display of surfaces from volume data", IEEE CG&A 1988 (opacity by gradient).
    """

    kind = "GradientMagnitude"

    def __init__(self, transfer: TransferFunction, full: Number | None = None) -> None:
        """Takes the transfer function, and the gradient at which its opacity is whole.

        Args:
            transfer: The transfer function.
            full: Length of the gradient, value per world unit; if left out, an eighth of the
                function's domain over one voxel.

        Raises:
            ValueError: `full` is not positive.
        """
        self.transfer = check_transfer("GradientMagnitude", "transfer", transfer)
        if full is not None:
            check_number("GradientMagnitude", "full", full, low=1e-30)
        self.full = full

    def table(self, sampling: Sampling) -> ColorTable:
        """See `Shader`."""
        return self.transfer.table(sampling)

    def own_numbers(self, tree: N3Tree) -> GradientMagnitudeNumbers:
        """See `Shader`."""
        low, high, _ = self.transfer.corners()
        domain = (high - low) / (8 * min(tree.spacing))
        return GradientMagnitudeNumbers(domain if self.full is None else self.full)


#: Shaders of one channel by name, made of a transfer function and a level: `gvtorch render
#: --shader` offers them, and `gvtorch bench shaders` measures them.
BY_NAME: Mapping[str, Callable[[TransferFunction, float], Shader]] = {
    "plain": lambda transfer, _: transfer,
    "lit": lambda transfer, _: Lit(transfer),
    "preintegrated": lambda transfer, _: PreIntegrated(transfer),
    "isosurface": lambda _, level: Isosurface(level),
    "maximum": lambda transfer, _: Projection("maximum", transfer),
    "minimum": lambda transfer, _: Projection("minimum", transfer),
    "mean": lambda transfer, _: Projection("mean", transfer),
    "gradient": lambda transfer, _: GradientMagnitude(transfer),
}


def _name(where: str, channel: Any) -> str:
    if not isinstance(channel, str):
        raise ValueError(f"{where}: channel must be a name, got {channel!r}")
    return channel
