"""`ModuleShader`: any `nn.Module` as a shader, for whatever torch can compute and differentiate.

It is at least ten times slower than a shader in the kernel. tracing/tracer.py walks its rays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, instance_of, optional, whole_between
from .shader import ColorTable, Sampling, Shader, row_and_fraction
from .transfer_function import TransferFunction

#: Samples of one ray that are shaded at once; therefore the minimum of `ModuleShader.samples`.
PART_SAMPLES = 64
_HIDES_NOTHING = TransferFunction.from_points([(0, 1)])


class ModuleShader(Shader, torch.nn.Module):
    """A module as a shader: `module(values, positions, directions, lengths)` returns colour and
    opacity of samples. The shader is itself an `nn.Module` with the given one as its submodule:
    `parameters()`, `state_dict()` and `.to(device)` reach the given module.

    For k samples the module gets `values` (k, c) of all channels, concatenated, in data units;
    `positions` (k, 3) and `directions` (k, 3) in world units; and `lengths` (k, 1), the world
    lengths of the samples' intervals. It returns linear RGB (k, 3), not premultiplied, and the
    alpha (k, 1) over those lengths, in [0, 1], of the values' dtype or, where autocast is on, of
    autocast's. Its parameters must be on the tree's device.

    Pictures have gradients with respect to the parameters, and to floating-point bricks that
    require them. All samples then stay in memory until the backward pass; without gradients
    (`torch.no_grad`) memory is bounded by `samples`.

    Attributes:
        module: The module.
        channels: Names of the channels it reads; empty: that of `RenderOptions.channel`.
        hidden_by: A transfer function; where it shows nothing, nodes are not sampled or requested.
        samples: About how many samples are shaded at once; None: 2^20 on the CPU and 2^24 on CUDA,
            where each batch waits for the device.
    """

    uses_torch = True
    channels: tuple[str, ...] = ()
    hidden_by: TransferFunction | None
    samples: int | None
    checks: ClassVar[Mapping[str, Check]] = {
        "module": lambda owner, name, value: _callable(value),
        "channels": lambda owner, name, value: _names(value),
        "hidden_by": optional(instance_of(TransferFunction)),
        "samples": optional(whole_between(PART_SAMPLES)),
    }

    def __init__(
        self,
        module: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
        channels: Sequence[str] | None = None,
        *,
        hidden_by: TransferFunction | None = None,
        samples: int | None = None,
    ) -> None:
        """See the class; raises ValueError if the module can't be called or a number is wrong."""
        super().__init__()
        self.module, self.hidden_by, self.samples = module, hidden_by, samples
        self.channels = () if channels is None else channels  # type: ignore[assignment]
        if channels is not None and not self.channels:
            raise ValueError(f"ModuleShader: channels must be names, got {channels!r}")

    def __repr__(self) -> str:
        name = getattr(self.module, "__name__", type(self.module).__name__)
        return f"ModuleShader({name}, channels={self.channels})"

    def table(self, sampling: Sampling) -> ColorTable:
        """Returns the table of `hidden_by`, of which only the values it hides matter."""
        return (self.hidden_by or _HIDES_NOTHING).table(sampling)

    def forward(
        self, values: Tensor, positions: Tensor, directions: Tensor, lengths: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns the module's colour (k, 3) and alpha (k, 1) of samples, checked.

        Raises:
            ValueError: The module returns something of another shape or dtype, a colour that is not
                finite, or an alpha outside of [0, 1].
        """
        output = self.module(values, positions, directions, lengths)
        if not (isinstance(output, Sequence) and len(output) == 2):
            got = f"{len(output)} parts" if isinstance(output, Sequence) else type(output).__name__
            raise ValueError(f"ModuleShader: the module must give colour and alpha, got {got}")
        color, alpha = (_uncast(part, values) for part in output)
        count, dtype, device = len(values), values.dtype, values.device
        check.tensor("ModuleShader", "the module's colour", color, (count, 3), dtype, device)
        check.tensor("ModuleShader", "the module's alpha", alpha, (count, 1), dtype, device)
        if not bool(((alpha >= 0) & (alpha <= 1)).all()):
            raise ValueError("ModuleShader: the module's alpha must lie in [0, 1]")
        if not bool(torch.isfinite(color).all()):
            raise ValueError("ModuleShader: the module's colour must be finite")
        return color, alpha


def _uncast(part: Any, values: Tensor) -> Any:
    """Returns what a module gave; in the dtype of the values if autocast has changed that."""
    kind = values.device.type
    if isinstance(part, Tensor) and torch.is_autocast_enabled(kind):
        return part.to(values.dtype) if part.dtype == torch.get_autocast_dtype(kind) else part
    return part


def _callable(module: Any) -> Any:
    if not callable(module):
        raise ValueError(f"ModuleShader: module must be callable, got {type(module).__name__}")
    return module


def _names(channels: Any) -> tuple[str, ...]:
    if not isinstance(channels, Sequence) or isinstance(channels, str):
        raise ValueError(f"ModuleShader: channels must be names, got {channels!r}")
    return tuple(channels)


class TransferModule(torch.nn.Module):
    """A transfer function as a module with its rows as parameters; equivalent to the kernel's.

    Attributes:
        rows: (m, 4) linear RGB and opacity per reference length, at evenly spaced values.
    """

    def __init__(self, shader: TransferFunction, spacing: float) -> None:
        """Copies a transfer function; `spacing`, the smallest of the volume in world units, is the
        reference length of opacity if the function has none.
        """
        super().__init__()
        check.instance("TransferModule", "shader", shader, TransferFunction)
        spacing = check.number("TransferModule", "spacing", spacing, low=0, open_low=True)
        self.reference = float(shader.reference or spacing)
        table = shader.table(Sampling(smallest_spacing=spacing, step=self.reference))
        self.low, high = table.domain_2.tolist()
        self.scale = (len(table.opaque_m) - 1) / (high - self.low)
        self.rows = torch.nn.Parameter(table.table_lm4[0].clone())

    def __repr__(self) -> str:
        return f"TransferModule(rows={check.as_text(self.rows)}, from {self.low:g})"

    def shows(self, values: Tensor) -> Tensor:
        """Returns which values have an opacity, a bool tensor of the same shape."""
        row_position = ((values - self.low) * self.scale).clamp(0, len(self.rows) - 1)
        opaque = self.rows[:, 3] > 0
        return opaque[row_position.floor().long()] | opaque[row_position.ceil().long()]

    def forward(
        self, values: Tensor, positions: Tensor, directions: Tensor, lengths: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns colour (k, 3) and alpha (k, 1) of the first channel's first number."""
        row_position = (values[:, :1] - self.low) * self.scale
        row, fraction = row_and_fraction(row_position, len(self.rows))
        rows = self.rows.to(values.dtype)
        a, b = rows[row[:, 0]], rows[row[:, 0] + 1]
        rgb = a[:, :3] + fraction * (b[:, :3] - a[:, :3])
        alpha_a, alpha_b = (
            -torch.expm1(lengths / self.reference * torch.log1p(-side[:, 3:].clamp(0, 1 - 2**-23)))
            for side in (a, b)
        )
        return rgb, alpha_a + fraction * (alpha_b - alpha_a)
