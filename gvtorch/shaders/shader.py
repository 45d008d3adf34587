"""`Shader`: what every shader tells the tracer, and the effects around it; and the tables that the
kernels read, rows of colour and alpha at even distances of the value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, Checked, as_name, flag, or_none, whole_between
from ..ops import ShadeArguments
from ..ops.shading import Number, ShadeParameters, Triple, pack, shader_number
from ..pool import N3Tree

_MOST_BYTES = 64 * 2**20  # of a table in float32
_CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How rays are cut into intervals; in which dtype, and on which device they are traced."""

    smallest_spacing: float  # world units; opacity's reference length where none was given
    step: float  # world length of the shortest interval
    levels: int = 1  # lengths of intervals, each twice the one before
    dtype: torch.dtype = torch.float32
    device: torch.device = _CPU

    def fitting(self, rows: int) -> int:
        """Returns for how many lengths a table is made, where each takes this many rows: fewer than
        `levels` where the table would take more than 64 MB.
        """
        return max(1, min(self.levels, _MOST_BYTES // (16 * rows)))


@dataclass(frozen=True, kw_only=True)
class ColorTable:
    """Colour and alpha by value, for each length of interval; linear between rows."""

    table_lm4: Tensor  # (l, m, 4) linear RGB, alpha of an interval of step * 2^l; or (l, m, m, 4)
    domain_2: Tensor  # (2,) value of the first row, of the last row
    opaque_m: Tensor  # (m,) int32, how many rows up to this one have an opacity

    @classmethod
    def of(
        cls, table: np.ndarray, domain: tuple[float, float], seen_m: np.ndarray, sampling: Sampling
    ) -> ColorTable:
        """Moves a table that was made in float64 to where rays are traced."""
        dtype, device = sampling.dtype, sampling.device
        return cls(
            table_lm4=torch.tensor(table, dtype=dtype, device=device),
            domain_2=torch.tensor(domain, dtype=dtype, device=device),
            opaque_m=torch.tensor(np.cumsum(seen_m), dtype=torch.int32, device=device),
        )


@dataclass(frozen=True, kw_only=True)
class CutSurface:
    """What a cut through the inside of a surface shows: its own colour, unlit."""

    level: Number  # the value at the surface
    below: bool  # inside is where the value is below the level, else where it is not
    value: Shader  # gives the value in front as a feature, in white
    color: Triple  # linear RGB, times what `colors` shows
    colors: Shader | None  # shows the colour of another channel's value; None: that is white


class Shader(Checked):
    """What turns the values along a ray into colour. Attributes may be edited: they are checked and
    converted as by the constructor, the next picture is made with them, and nothing is compiled.
    Threads may share one while none edits it.

    Attributes:
        kind: Name of its C++ struct, which the op `shade_rays` runs; None: its table is all, and
            the op `trace_rays` draws it.
        op: Name of a user's op, which runs in place of `shade_rays`.
        transfer: The transfer function of its colours; None: they are white and opaque.
        channel: Name of the channel whose value it reads; None: that of the options.
        component: Which number of it; None: that of the options.
        normals: Name of a channel of 3 numbers that holds normals; None: the gradient's.
        other: Name of a second channel that it reads, or None.
        other_component: Which number of it colours a surface.
        reads_coarse: The second channel may be a coarse one, which only coarse bricks have.
        reads_labels: It reads a channel of labels; others would blend them.
        whole_ray: It must see a ray in one go: what cuts rays into pieces refuses it.
        uses_torch: Its colours are made in torch, outside of the kernel. The host waits for the
            device meanwhile, so it is not recorded as a CUDA graph.
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
        "channel": or_none(as_name),
        "component": or_none(whole_between(0)),
        "normals": or_none(as_name),
        "other": or_none(as_name),
        "other_component": whole_between(0),
        "shadows": flag,
    }

    def __repr__(self) -> str:
        """Tells its channels, and what it is made of."""
        names = ("channel", "normals", "transfer", "value", "which", "color", "other", "light")
        given = {name: getattr(self, name, None) for name in names}
        parts = [f"{name}={check.shown(one)}" for name, one in given.items() if one is not None]
        return f"{type(self).__name__}({', '.join(parts)})"

    def table(self, sampling: Sampling) -> ColorTable:
        """Returns the colours as the kernel reads them."""
        if self.transfer is None:
            return one_color((1.0, 1.0, 1.0), sampling)
        return self.transfer.table(sampling)

    def table_of(self, tree: N3Tree, channel: str, sampling: Sampling) -> ColorTable:
        """Returns `table`, as a channel of a tree needs it."""
        return self.table(sampling)

    def label_names(self, tree: N3Tree, channel: str) -> Tensor | None:
        """Returns (1 + m,) int64: -1, and the label of each row of the table, on the tree's device;
        its one feature then is a row of these. None: it shows no labels.
        """
        return None

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that it names itself."""
        return tuple(n for n in (self.channel, self.normals, self.other) if n is not None)

    def finer(self, tree: N3Tree) -> float:
        """Returns by what factor levels are finer than the pixel cone asks for: their voxels count
        as so many times as large.
        """
        return 1.0

    # What `shade_rays` is told.

    def own_numbers(self, tree: N3Tree) -> Sequence[Number]:
        """Returns the shader's own numbers, a record of `ops.shading`; most have none."""
        return ()

    def material(self) -> ShadeParameters:
        """Returns light and material."""
        return ShadeParameters()

    def feature_count(self, tree: N3Tree) -> int:
        """Returns how many numbers `Hits.features` has."""
        return 0

    def parameter_tensor(self, tree: N3Tree, dtype: torch.dtype) -> Tensor:
        """Returns `parameter_54` of `shade_rays`, with lights and materials as they are now; what
        the host sees of them is checked.
        """
        self.check_again()
        scale, offset = 1.0, 0.0
        if self.normals is not None:
            kind = tree.bricks.channels[self.normals].dtype
            scale = 1 / number_of_one(kind)
            if kind in (torch.uint8, torch.uint16):
                scale, offset = 2 * scale, -1.0
        parameters = self.material()._replace(
            own=self.own_numbers(tree), normal_scale=scale, normal_offset=offset
        )
        return parameters.pack(dtype, tree.device)

    def shading(self, where: str, tree: N3Tree) -> ShadeArguments | None:
        """Returns what `shade_rays` reads of the shader beside its table; None: `trace_rays` draws
        the table, which is all.

        Raises:
            ValueError: A channel that it names is not there, or of the wrong width.
        """
        channels = tree.bricks.channels
        for name in self.channels:
            if name not in channels:
                known = ", ".join(tree.channel_names)
                raise ValueError(f"{where}: unknown channel {name!r}; the tree has {known}")
            if channels[name].coarse and not (self.reads_coarse and name == self.other):
                raise ValueError(f"{where}: only coarse bricks have channel {name!r}")
        if self.kind is None:
            return None
        if self.normals is not None and channels[self.normals].width != 3:
            raise ValueError(
                f"{where}: normals need 3 numbers a voxel, "
                f"{self.normals!r} has {channels[self.normals].width}"
            )
        if self.other is not None:
            last = channels[self.other].width - 1
            check.whole(where, "component of the colour", self.other_component, low=0, high=last)
        bricks, constants = dict(tree.bricks.bricks), tree.nodes.constants
        if tree.depth == 0:  # the root is of the finest level
            bricks |= {name: bricks[name][:0] for name, one in channels.items() if one.coarse}
        return ShadeArguments(
            shader=0 if self.op else shader_number(self.kind),
            features=self.feature_count(tree),
            normal_bzyxc=None if self.normals is None else bricks[self.normals],
            normal_tnc=None if self.normals is None else constants[self.normals],
            other_bzyxc=None if self.other is None else bricks[self.other],
            other_tnc=constants.get(str(self.other)),
            other_component=self.other_component,
        )

    # What the effects around it are told; ValueError where that asks for a light it has not.

    @property
    def projection(self) -> Literal["maximum", "minimum", "mean"] | None:
        """Which value along a ray it shows, so that pieces of the ray are put together accordingly;
        None: they are composited.
        """
        return None

    def cut_surface(self) -> CutSurface | None:
        """Returns what a cut through its inside shows; None: it is a volume, and shows itself."""
        return None

    def opened(self) -> Shader:
        """Returns the shader for a cut without a cap: it shows surfaces from inside, too."""
        return self

    def unlit(self) -> Shader:
        """Returns the shader without its light, for light by cones: base colours, and normals."""
        raise ValueError(
            "render: lighting needs normals: the shader must be Lit, StoredColor, Isosurface or "
            f"DistanceField, got {type(self).__name__}"
        )

    def matter(self) -> Shader:
        """Returns what a wide cone meets: base colours, alpha, and normals."""
        return self.unlit()

    def blocker(self) -> Shader:
        """Returns what stands in the way of light: only its alpha counts."""
        return self.matter()


def one_color(color: Triple, sampling: Sampling) -> ColorTable:
    """Returns the table of one opaque colour, linear RGB."""
    row = pack((color, 1.0), sampling.dtype, sampling.device)
    return ColorTable(
        table_lm4=row.expand(sampling.levels, 2, 4).contiguous(),
        domain_2=pack((0.0, 1.0), sampling.dtype, sampling.device),
        opaque_m=torch.arange(1, 3, dtype=torch.int32, device=sampling.device),
    )


def interval_levels(root_voxel: float, step: float) -> int:
    """Returns how many lengths of intervals a tree needs: up to that of a voxel of its root."""
    return max(1, math.ceil(math.log2(root_voxel / step)) + 1)


def check_shader(where: str, name: str, value: Any) -> None:
    """Raises ValueError unless a user's argument is a shader."""
    if not isinstance(value, Shader):
        kind = type(value).__name__
        raise ValueError(
            f"{where}: {name} must be a TransferFunction or another shader, got {kind}"
        )


def number_of_one(dtype: torch.dtype) -> float:
    """Returns the stored number that stands for 1."""
    return 1.0 if dtype.is_floating_point else float(torch.iinfo(dtype).max)
