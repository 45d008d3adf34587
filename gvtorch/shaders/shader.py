"""`Shader`, the base of all shaders, with the methods that the tracer and the effects around it
call; and `ColorTable`, which the kernels read: rows of colour and alpha at evenly spaced values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, Checked, flag, name_text, optional, whole_between
from ..ops import ShadeArguments
from ..ops.reference.shaders import SHADER_KINDS, shader_number
from ..ops.shading import Number, ShadeParameters, Triple, pack
from ..pool import N3Tree

LARGEST = 1e300  # limit of values and lengths, so that their differences are finite
_MAX_TABLE_BYTES = 64 * 2**20  # limit for a table in float32
_CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How rays are cut into intervals, and the dtype and device they are traced in."""

    smallest_spacing: float  # world units; the default reference length of opacity
    step: float  # world length of the shortest interval
    levels: int = 1  # number of interval lengths: step * 2^l for l = 0 to levels - 1
    dtype: torch.dtype = torch.float32
    device: torch.device = _CPU

    def fitting(self, rows: int) -> int:
        """Returns how many interval lengths a table has if each takes `rows` rows: `levels`, or as
        many (at least 1) as keep the table within 64 MB in float32.
        """
        return max(1, min(self.levels, _MAX_TABLE_BYTES // (16 * rows)))

    def lengths(self, reference: float | None, levels: int) -> np.ndarray:
        """Returns (levels,) float64 lengths of intervals in units of a reference length, None: the
        smallest spacing; at most 1e300, so that an infinite length of a transparent value is still
        transparent.
        """
        shortest = min(self.step / (reference or self.smallest_spacing), LARGEST)
        with np.errstate(over="ignore"):
            return np.minimum(shortest * 2.0 ** np.arange(levels), LARGEST)


@dataclass(frozen=True, kw_only=True)
class ColorTable:
    """Colour and alpha by value, for each interval length; linear between rows."""

    table_lm4: Tensor  # (l, m, 4) linear RGB, alpha of an interval of step * 2^l; or (l, m, m, 4)
    domain_2: Tensor  # (2,) values of the first and the last row
    opaque_m: Tensor  # (m,) int32, how many rows up to and including this one have an opacity

    @classmethod
    def of(
        cls,
        table: np.ndarray,
        domain: tuple[float, float],
        visible_m: np.ndarray,
        sampling: Sampling,
    ) -> ColorTable:
        """Converts a float64 table, and which of its rows are visible, to dtype and device."""
        dtype, device = sampling.dtype, sampling.device
        return cls(
            table_lm4=torch.tensor(table, dtype=dtype, device=device),
            domain_2=torch.tensor(domain, dtype=dtype, device=device),
            opaque_m=torch.tensor(
                np.cumsum(visible_m, dtype=np.int32), dtype=torch.int32, device=device
            ),
        )


@dataclass(frozen=True, kw_only=True)
class CutSurface:
    """How a clip's cut through the inside of a surface is drawn: in its own colour, unlit."""

    level: Number  # the value at the surface
    below: bool  # True: inside is where the value is below the level; False: at or above it
    value: Shader  # returns the value at the cut as a feature, coloured white
    color: Triple  # linear RGB, multiplied by what `colors` shows
    colors: Shader | None  # shows the colour of another channel's value; None: white


class Shader(Checked):
    """What turns the values along a ray into colour. Attributes may be edited: they are checked and
    converted as by the constructor, and the next picture uses them; nothing is recompiled.
    Threads may share a shader as long as none edits it.

    Attributes:
        kind: Name of its C++ struct, which the op `shade_rays` runs; None: the shader is nothing
            but its table, and the op `trace_rays` draws it.
        op: Name of a user's op that runs instead of `shade_rays`.
        transfer: The transfer function of its colours; None: white and opaque.
        channel: Name of the channel whose value it reads; None: that of the options.
        component: Index of the number read from that channel; None: that of the options.
        normals: Name of a channel of 3 numbers that holds normals; None: gradients are the normals.
        other: Name of a second channel that it reads, or None.
        other_component: Index of the second channel's number that colours a surface.
        reads_coarse: Whether the second channel may be a coarse one, which only coarse bricks have.
        reads_labels: Whether it reads a channel of labels; other shaders would blend them.
        whole_ray: Whether it must see each ray in one pass: options that cut rays refuse it.
        uses_torch: Whether its colours are computed in torch, outside of the kernel. The host then
            waits for the device, so it can't be recorded as a CUDA graph.
    """

    kind: str | None = None
    op: str | None = None
    transfer: Shader | None = None
    channel: str | None = None
    component: int | None = None
    normals: str | None = None
    other: str | None = None
    other_component: int = 0
    reads_coarse: bool = False
    reads_labels: bool = False
    whole_ray: bool = False
    uses_torch: bool = False
    checks: ClassVar[Mapping[str, Check]] = {
        "channel": optional(name_text),
        "component": optional(whole_between(0)),
        "normals": optional(name_text),
        "other": optional(name_text),
        "other_component": whole_between(0),
        "shadows": flag,
    }

    def __repr__(self) -> str:
        """Returns the class name with its channels and parts."""
        names = ("channel", "normals", "transfer", "value", "which", "color", "other", "light")
        attributes = {name: getattr(self, name, None) for name in names}
        parts = [f"{n}={check.as_text(v)}" for n, v in attributes.items() if v is not None]
        return f"{type(self).__name__}({', '.join(parts)})"

    def changed(self, **attributes: Any) -> Self:
        """Returns a copy with other values of some attributes."""
        other = copy(self)
        for name, value in attributes.items():
            setattr(other, name, value)
        return other

    def table(self, sampling: Sampling) -> ColorTable:
        """Returns the colours as a table, the form in which the kernel reads them."""
        if self.transfer is None:
            return one_color((1.0, 1.0, 1.0), sampling)
        return self.transfer.table(sampling)

    def table_of(self, tree: N3Tree, channel: str, sampling: Sampling) -> ColorTable:
        """Returns `table` adapted to one channel of a tree; the same for all but `Labels`."""
        return self.table(sampling)

    def label_names(self, tree: N3Tree, channel: str) -> Tensor | None:
        """Returns (1 + m,) int64 on the tree's device: -1, then the label of each row of the table.
        The shader's only feature is then an index into it. None: the shader shows no labels.
        """
        return None

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that the shader itself sets, without those left to the options."""
        return tuple(n for n in (self.channel, self.normals, self.other) if n is not None)

    def finer(self, tree: N3Tree) -> float:
        """Returns by what factor voxels must be smaller than the pixel cone: with 2, levels are
        chosen as if pixels were half as wide.
        """
        return 1.0

    # Arguments of `shade_rays`.

    def own_numbers(self, tree: N3Tree) -> Sequence[Number]:
        """Returns the numbers of this kind of shader, a record beside its twin; most have none."""
        return ()

    def material(self) -> ShadeParameters:
        """Returns light and material."""
        return ShadeParameters()

    def feature_count(self, tree: N3Tree) -> int:
        """Returns the width c of `Hits.features` (r, c)."""
        if self.kind is None:
            return 0
        count = SHADER_KINDS[self.kind].twin.feature_count
        return tree.bricks.channels[str(self.other)].width if count is None else count

    def parameter_tensor(self, tree: N3Tree, dtype: torch.dtype) -> Tensor:
        """Returns `parameter_54` of `shade_rays` from the current light and material, after
        checking again all values that the host can read without blocking.
        """
        self.check_again()
        scale, offset = 1.0, 0.0
        if self.normals is not None:
            normal_dtype = tree.bricks.channels[self.normals].dtype
            scale = 1 / number_of_one(normal_dtype)
            if normal_dtype in (torch.uint8, torch.uint16):
                scale, offset = 2 * scale, -1.0
        own, material = self.own_numbers(tree), self.material()
        parameters = material._replace(own=own, normal_scale=scale, normal_offset=offset)
        return parameters.pack(dtype, tree.device)

    def shading(self, context: str, tree: N3Tree) -> ShadeArguments | None:
        """Returns the arguments of `shade_rays` that this shader adds to its table and parameters;
        None: `trace_rays` draws it from the table alone.

        Raises:
            ValueError: The tree has no channel of a name that it uses, or one of another width.
        """
        channels = tree.bricks.channels
        for name in self.channels:
            check.channel(context, name, channels)
            if not (self.reads_coarse and name == self.other):
                tree.fine_channel(context, name)
        if self.kind is None:
            return None
        check_width(f"{context}: normals need", tree, self.normals, 3)
        if self.other is not None:
            name, last = "component of the colour", channels[self.other].width - 1
            check.integer(context, name, self.other_component, low=0, high=last)
        bricks, constants = dict(tree.bricks.bricks), tree.nodes.constants
        if tree.depth == 0:  # the root is the finest level, so there are no coarse bricks
            bricks |= {n: bricks[n][:0] for n, channel in channels.items() if channel.coarse}
        return ShadeArguments(
            shader=0 if self.op else shader_number(self.kind),
            features=self.feature_count(tree),
            normal_bzyxc=None if self.normals is None else bricks[self.normals],
            normal_tnc=None if self.normals is None else constants[self.normals],
            other_bzyxc=None if self.other is None else bricks[self.other],
            other_tnc=constants.get(str(self.other)),
            other_component=self.other_component,
        )

    # Methods that the effects (clip, lens, lighting) call. `unlit`, `matter` and `blocker` raise
    # ValueError if the shader can't be lit.

    @property
    def shows_nothing(self) -> bool:
        """Whether its transfer function hides every value, so that no ray needs to be traced."""
        return False

    @property
    def projection(self) -> Literal["maximum", "minimum", "mean"] | None:
        """Which value along a ray it shows, of all pieces of a ray; None: they are composited."""
        return None

    def cut_surface(self) -> CutSurface | None:
        """Returns how a cut through the inside is drawn; None: a volume, drawn as anywhere else."""
        return None

    def opened(self) -> Shader:
        """Returns the shader for clips, with caps or not: it also shows surfaces from inside."""
        return self

    def unlit(self) -> Shader:
        """Returns the shader without its light, for `Lighting`: base colours and normals."""
        raise ValueError(
            "render: lighting needs normals: the shader must be Lit, StoredColor, Isosurface or "
            f"DistanceField, got {type(self).__name__}"
        )

    def own_light(self) -> Any:
        """Returns its light, for a `Lighting` without lights; None if it has none."""
        return None

    def matter(self) -> Shader:
        """Returns the shader for wide cones of indirect light: base colours, alpha, normals."""
        return self.unlit()

    def blocker(self) -> Shader:
        """Returns the shader that blocks the cones of `Lighting`: only its alpha counts."""
        return self.matter()


def one_color(color: Triple, sampling: Sampling) -> ColorTable:
    """Returns a table in which every value has one opaque colour, given in linear RGB."""
    row = pack((color, 1.0), sampling.dtype, sampling.device)
    return ColorTable(
        table_lm4=row.expand(sampling.levels, 2, 4).contiguous(),
        domain_2=pack((0.0, 1.0), sampling.dtype, sampling.device),
        opaque_m=torch.arange(1, 3, dtype=torch.int32, device=sampling.device),
    )


def alpha_over(length: np.ndarray | float, opacity: np.ndarray) -> np.ndarray:
    """Returns the alpha over lengths in reference lengths, given the opacity over one of these."""
    with np.errstate(divide="ignore"):
        return -np.expm1(length * np.log1p(-opacity))


def row_and_fraction(position: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Returns for positions in a table of `count` rows (0: the first), clamped to it, the int64 row
    before each, at most the last but one, and the fraction, 0 to 1, of the way to the next row.
    """
    position = position.clamp(0, count - 1)
    row = position.to(torch.int64).clamp(max=count - 2)
    return row, position - row


def interval_levels(root_voxel: float, step: float) -> int:
    """Returns how many interval lengths a tree needs, up to the side of a voxel of its root."""
    return max(1, math.ceil(math.log2(root_voxel / step)) + 1)


def check_shader(context: str, name: str, value: Any) -> None:
    """Raises ValueError unless a user's argument is a shader."""
    if not isinstance(value, Shader):
        wanted, kind = "a TransferFunction or another shader", type(value).__name__
        raise ValueError(f"{context}: {name} must be {wanted}, got {kind}")


def check_width(
    claim: str, tree: N3Tree, name: str | None, width: int, directional: int | None = None
) -> int:
    """Returns how many numbers a voxel has in a channel of a tree, `width` if there is no such
    channel. Raises ValueError, which begins with `claim`, unless they are `width`, or as many as
    hold six directions, `directional`.
    """
    channel = tree.bricks.channels.get(str(name))
    if channel is None or channel.width in (width, directional):
        return width if channel is None else channel.width
    directions = "" if directional is None else f", or {directional} for six directions"
    raise ValueError(f"{claim} {width} numbers a voxel{directions}, {name!r} has {channel.width}")


def number_of_one(dtype: torch.dtype) -> float:
    """Returns the stored number that means 1: 1.0 of floats, the largest value of integers."""
    return 1.0 if dtype.is_floating_point else float(torch.iinfo(dtype).max)
