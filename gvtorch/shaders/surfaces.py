"""The shaders of surfaces: where a value passes a level."""

from __future__ import annotations

from typing import Any

import torch

from ..ops.shading import IsosurfaceNumbers, Number, ShaderKind, Triple, pack
from ..pool import N3Tree
from .fused import Intervals, LitShader, Shader, one_color, plain_table
from .lights import check_number, check_triple
from .solid import solid_table
from .transfer_function import Table, TransferFunction


class Isosurface(LitShader):
    """The first place where the value passes a level, opaque and lit. Where a cap cuts it, it
    is filled with what is not below the level.
    """

    kind = ShaderKind.ISOSURFACE
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

    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """See `Shader`."""
        if isinstance(self.color, TransferFunction):
            return plain_table(self.color, tree, intervals)
        return one_color(self.color, tree, intervals)

    def own(self, tree: N3Tree) -> tuple[Any, ...]:
        """See `Shader`."""
        return IsosurfaceNumbers(self.value)

    def matter(self) -> Shader:
        """See `LitShader`.

        Raises:
            ValueError: It has no colour of its own.
        """
        if isinstance(self.color, TransferFunction):
            raise ValueError("Isosurface: indirect light needs a surface of one colour")
        return Solid(self, self.color)

    def blocker(self) -> Shader:
        """See `LitShader`."""
        return Solid(self, None)


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


class Solid(Shader):
    """An isosurface as wide cones meet it, see `solid_table`.

    Of a distance field, matter lies below the level and the value changes as places do. Else it
    lies above, and a value changes from half of the level to three halves over four voxels.
    """

    widest = 16  # voxels, of a distance field's ramp

    def __init__(self, surface: Isosurface, color: Triple | None) -> None:
        """Takes the surface and its colour; None where its alpha alone counts."""
        self.kind = None if color is None else ShaderKind.LIT
        self.surface, self.color = surface, (0.0, 0.0, 0.0) if color is None else color
        self.channel, self.component = surface.channel, surface.component
        self.normals = surface.normals

    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """See `Shader`."""
        voxel = intervals.smallest_spacing
        value_1 = pack((self.surface.value,), intervals.dtype, tree.device)
        if self.surface.distance:
            most_1 = torch.full_like(value_1, self.widest / 2 * voxel)
            slope_1 = torch.ones_like(value_1)
        else:
            most_1 = value_1.abs() / 2
            slope_1 = most_1 / (2 * voxel)
        return solid_table(
            *(value_1, slope_1, most_1, self.color),
            above=not self.surface.distance,
            step=intervals.step,
            levels=intervals.levels,
        )
