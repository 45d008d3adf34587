"""The fused shaders beside the plain transfer function: each lays ready what `shade_rays` reads.

What a shader does with an interval is told in csrc/shaders.h. All attributes may be edited: the
next picture is made with them, and nothing is compiled.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal, cast

import torch
from torch import Tensor

from ..base import check
from ..ops import ShadeArguments
from ..ops.shading import (
    Number,
    ProjectionKind,
    ProjectionNumbers,
    ShaderKind,
    StoredColorNumbers,
    Triple,
    pack,
)
from ..pool import Channel, N3Tree
from .lights import Headlight, Light, Material
from .preintegrated import integrated_table
from .transfer_function import Table, TransferFunction

_KEPT_TABLES = 4


@dataclass(frozen=True, kw_only=True)
class Intervals:
    """How rays are cut, and in which dtype they are traced."""

    smallest_spacing: float  # world units; the reference length where none was given
    step: float  # world length of the shortest interval
    levels: int  # lengths of intervals, each twice the one before
    dtype: torch.dtype


class Shader(ABC):
    """A fused shader.

    Attributes:
        kind: Which shader of `shade_rays`; None: the plain transfer function's kernel reads its
            table.
        whole: It sees a ray in one go: what cuts rays into pieces refuses it.
        channel: Name of the channel whose value it reads; None: that of the options.
        component: Which number of it; None: that of the options.
        normals: Name of a channel of 3 numbers that holds normals; None: the gradient's.
        other: Name of the second channel it reads, or None.
        other_component: Which number of it colours a surface.
    """

    kind: int | str | None
    whole: bool = False
    channel: str | None = None
    component: int | None = None
    normals: str | None = None
    other: str | None = None
    other_component: int = 0

    @abstractmethod
    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """Returns the colours as the kernel reads them, on the tree's device."""

    def own(self, tree: N3Tree) -> tuple[Any, ...]:
        """Returns the shader's own numbers, a record of `ops.shading`; most have none."""
        return ()

    def material(self) -> Material:
        """Returns light and material; shaders without a light have any."""
        return _UNLIT

    def features(self, tree: N3Tree) -> int:
        """Returns how many features it gives."""
        return 0

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that it names itself."""
        return tuple(n for n in (self.channel, self.normals, self.other) if n is not None)

    def parameters(self, tree: N3Tree, dtype: torch.dtype) -> Tensor:
        """Returns `parameter_54`, with lights and materials as they are now."""
        scale, offset = 1.0, 0.0
        if self.normals is not None:
            scale = 1 / _unit_of(tree.bricks.channels[self.normals].dtype)
            if tree.bricks.channels[self.normals].dtype in (torch.uint8, torch.uint16):
                scale, offset = 2 * scale, -1.0
        parameters = (
            self.material()
            .parameters()
            ._replace(own=self.own(tree), normal_scale=scale, normal_offset=offset)
        )
        return parameters.pack(dtype, tree.device)

    def arguments(self, where: str, tree: N3Tree, intervals: Intervals) -> ShadeArguments:
        """Returns what `shade_rays` reads of the shader beside its table.

        Raises:
            ValueError: A channel that it names is not there, or of the wrong width.
        """
        for name in self.channels:
            if name not in tree.bricks.bricks:
                known = ", ".join(tree.channel_names)
                raise ValueError(f"{where}: unknown channel {name!r}; the tree has {known}")
        if self.normals is not None and tree.bricks.channels[self.normals].width != 3:
            width = tree.bricks.channels[self.normals].width
            raise ValueError(
                f"{where}: normals need 3 numbers a voxel, {self.normals!r} has {width}"
            )
        if self.other is not None:
            width = tree.bricks.channels[self.other].width
            check.whole(
                where, "component of the colour", self.other_component, low=0, high=width - 1
            )
        bricks, constants = tree.bricks.bricks, tree.nodes.constants
        return ShadeArguments(
            shader=int(self.kind) if isinstance(self.kind, int) else 0,
            features=self.features(tree),
            normal_bzyxc=None if self.normals is None else bricks[self.normals],
            normal_tnc=None if self.normals is None else constants[self.normals],
            other_bzyxc=None if self.other is None else bricks[self.other],
            other_tnc=None if self.other is None else constants[self.other],
            other_component=self.other_component,
        )

    @property
    def op(self) -> str | None:
        """Name of its own op; None: that of the fused shaders."""
        return self.kind if isinstance(self.kind, str) else None


class LitShader(Shader):
    """A shader with a light and a material; see `Material` and csrc/shaders.h.

    Attributes:
        shadows: Whether a cone goes from each sample to the light: matter on the way takes from
            diffuse light and highlight. A `Headlight` throws no shadows.
    """

    shadows = False

    def __init__(
        self,
        *,
        normals: str | None = None,
        light: Light | None = None,
        ambient: Number = 0.2,
        diffuse: Number = 0.8,
        specular: Number = 0.3,
        shininess: Number = 40.0,
    ) -> None:
        """Takes light and material.

        Args:
            normals: Name of a channel of 3 numbers that holds normals (unsigned integers stand for
                -1 to 1); the gradient's if left out.
            light: A `Headlight` if left out.
            ambient: Factor of the base colour.
            diffuse: Factor of base colour, light and cosine.
            specular: Factor of the highlight.
            shininess: Exponent of the highlight.

        Raises:
            ValueError: A number is negative or not finite.
        """
        self.normals, self.light = normals, light or Headlight()
        self.ambient, self.diffuse = ambient, diffuse
        self.specular, self.shininess = specular, shininess
        self.material()

    def material(self) -> Material:
        """Returns light and material, checked."""
        return Material(
            light=self.light,
            ambient=self.ambient,
            diffuse=self.diffuse,
            specular=self.specular,
            shininess=self.shininess,
        )

    def unlit(self) -> LitShader:
        """Returns the same without its light: base colours, and normals."""
        bare = copy(self)
        bare.ambient, bare.diffuse, bare.specular, bare.shadows = 1.0, 0.0, 0.0, False
        return bare

    def arguments(self, where: str, tree: N3Tree, intervals: Intervals) -> ShadeArguments:
        """See `Shader`."""
        given = super().arguments(where, tree, intervals)
        if self.shadows:
            if self.kind not in _SHADOWED:
                raise ValueError(f"{where}: shadows per sample are for Lit and StoredColor")
            return given._replace(shader=int(_SHADOWED[self.kind]))
        return given

    def matter(self) -> Shader:
        """Returns what a wide cone meets: base colours, alpha, and normals."""
        return self.unlit()

    def blocker(self) -> FusedShader:
        """Returns what stands in the way of light: only its alpha counts."""
        return self.matter()


class Lit(LitShader):
    """The transfer function, lit by Blinn and Phong on both sides of a surface."""

    kind = ShaderKind.LIT

    def __init__(self, transfer: TransferFunction, *, shadows: bool = False, **light: Any) -> None:
        """Takes a transfer function.

        Args:
            transfer: The transfer function.
            shadows: Whether matter takes light from what lies behind it; see `LitShader`.
            **light: `normals`, `light`, `ambient`, `diffuse`, `specular` and `shininess` as in
                `Isosurface`.
        """
        super().__init__(**light)
        self.transfer, self.shadows = _transfer("Lit", transfer), shadows

    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """See `Shader`."""
        return plain_table(self.transfer, tree, intervals)

    def blocker(self) -> FusedShader:
        """See `LitShader`."""
        return self.transfer


class PreIntegrated(Shader):
    """The transfer function, integrated over what lies between two samples: thin shells in the
    function need no finer steps.
    """

    kind = ShaderKind.PRE_INTEGRATED

    def __init__(self, transfer: TransferFunction) -> None:
        """Takes a transfer function."""
        self.transfer = _transfer("PreIntegrated", transfer)
        self._tables: dict[tuple[Any, ...], Table] = {}

    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """See `Shader`. The last tables are kept."""
        transfer = self.transfer
        reference = transfer.reference or intervals.smallest_spacing
        key = (
            *(transfer.opacity.tobytes(), transfer.color.tobytes(), reference),
            *(intervals.step, intervals.levels, intervals.dtype, str(tree.device)),
        )
        if key not in self._tables:
            length = intervals.step / reference
            table = integrated_table(
                transfer, length, intervals.levels, intervals.dtype, tree.device
            )
            if len(self._tables) == _KEPT_TABLES:
                self._tables.pop(next(iter(self._tables)))
            self._tables[key] = table
        return self._tables[key]


class StoredColor(LitShader):
    """Colour and opacity as each voxel holds them: a channel of 4 numbers, linear red, green, blue
    and opacity per reference length. Integers stand for 0 to 1. Or 24 numbers, these for each of
    six directions, as `Volume.directional` makes them: a ray sees those that it goes along.
    """

    kind = ShaderKind.STORED_COLOR
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

    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """Says how many lengths of intervals there are; its colours are not read."""
        return one_color((1.0, 1.0, 1.0), tree, intervals)

    def own(self, tree: N3Tree) -> tuple[Any, ...]:
        """See `Shader`."""
        scale = 1 / _unit_of(tree.bricks.channels[str(self.channel)].dtype)
        reference = self.reference or min(tree.spacing)
        directional = tree.bricks.channels[str(self.channel)].width != 4
        return StoredColorNumbers(
            scale=scale,
            reference=reference,
            premultiplied=float(self.premultiplied or directional),
            lit=self.lit or self.shadows,
        )

    def unlit(self) -> StoredColor:
        """See `LitShader`."""
        bare = cast("StoredColor", super().unlit())
        bare.lit = True
        return bare

    def blocker(self) -> StoredColor:
        """See `LitShader`; it needs no normals."""
        bare = copy(self)
        bare.lit = bare.shadows = False
        return bare

    def arguments(self, where: str, tree: N3Tree, intervals: Intervals) -> ShadeArguments:
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
        return super().arguments(where, tree, intervals)


class Projection(Shader):
    """The maximum, minimum or mean of the value along each ray, coloured by the transfer function's
    colours and opaque. `Hits.features` (r, 1) holds the value itself (0 beside the box), depth
    where the extreme is or, for the mean, where the ray enters.
    """

    kind = ShaderKind.PROJECTION
    whole = True

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
        self.which, self.transfer = which, _transfer("Projection", transfer)

    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """See `Shader`."""
        return plain_table(self.transfer, tree, intervals)

    def own(self, tree: N3Tree) -> tuple[Any, ...]:
        """See `Shader`."""
        return ProjectionNumbers(ProjectionKind[self.which.upper()])

    def features(self, tree: N3Tree) -> int:
        """The value."""
        return 1


class Features(Shader):
    """All numbers of a channel, composited front to back with the transfer function's alpha: they
    come out as `Hits.features` (r, c). Any number of them.
    """

    kind = ShaderKind.FEATURES

    def __init__(self, transfer: TransferFunction, channel: str) -> None:
        """Takes the transfer function of the density, and the name of the features' channel."""
        self.transfer, self.other = _transfer("Features", transfer), _name("Features", channel)

    def table(self, tree: N3Tree, intervals: Intervals) -> Table:
        """See `Shader`."""
        return plain_table(self.transfer, tree, intervals)

    def features(self, tree: N3Tree) -> int:
        """As many as the channel holds."""
        return tree.bricks.channels[str(self.other)].width


FusedShader = TransferFunction | Shader
_SHADOWED: dict[int | str | None, int] = {
    ShaderKind.LIT: ShaderKind.SHADOWED_LIT,
    ShaderKind.STORED_COLOR: ShaderKind.SHADOWED_COLOR,
}
_UNLIT = Material(light=Headlight(), ambient=1.0, diffuse=0.0, specular=0.0, shininess=1.0)


def _transfer(where: str, transfer: Any) -> TransferFunction:
    if not isinstance(transfer, TransferFunction):
        kind = type(transfer).__name__
        raise ValueError(f"{where}: transfer must be a TransferFunction, got {kind}")
    return transfer


def _name(where: str, channel: Any) -> str:
    if not isinstance(channel, str):
        raise ValueError(f"{where}: channel must be a name, got {channel!r}")
    return channel


def plain_table(transfer: TransferFunction, tree: N3Tree, intervals: Intervals) -> Table:
    i = intervals
    return transfer.table(i.smallest_spacing, i.step, i.levels, i.dtype, tree.device)


def one_color(color: Triple, tree: N3Tree, intervals: Intervals) -> Table:
    row = pack((color, 1.0), intervals.dtype, tree.device)
    return Table(
        table_lm4=row.expand(intervals.levels, 2, 4).contiguous(),
        domain_2=pack((0.0, 1.0), intervals.dtype, tree.device),
        opaque_m=torch.arange(1, 3, dtype=torch.int32, device=tree.device),
    )


def _unit_of(dtype: torch.dtype) -> float:
    """The number that stands for 1."""
    return 1.0 if dtype.is_floating_point else float(torch.iinfo(dtype).max)
