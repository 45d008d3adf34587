"""`CompiledShader`: a user-defined shader, a small C++ header, as fast as the fused shaders.

cpp_ext/csrc/user_shader.h describes what the header must hold; cpp_ext/user.py compiles it and
caches the result.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, MutableMapping
from pathlib import Path
from typing import Any, ClassVar, Unpack

import torch
from torch import Tensor

from ..base import check
from ..base.checked import Check, instance_of, optional
from ..cpp_ext import user
from ..ops import ShadeArguments
from ..ops.registry import add_user_op
from ..ops.shading import Number, pack
from ..pool import N3Tree
from .lights import LightSettings, LitShader
from .transfer_function import TransferFunction

Uniforms = MutableMapping[str, Number] | Tensor


class CompiledShader(LitShader):
    """A shader made of a struct in a C++ header. It is compiled once and cached by its content.

    It can be used wherever a fused shader can. Uniforms, transfer function, light and material may
    be edited between frames without recompiling.

    Attributes:
        header: Absolute path of the header.
        op: Name of its op in `torch.ops.gvtorch_user`.
    """

    op: str
    checks: ClassVar[Mapping[str, Check]] = {"transfer": optional(instance_of(TransferFunction))}

    def __init__(
        self,
        header: str | os.PathLike[str],
        name: str,
        *,
        uniforms: Uniforms | None = None,
        transfer: TransferFunction | None = None,
        channel: str | None = None,
        component: int | None = None,
        other: str | None = None,
        other_component: int = 0,
        **light: Unpack[LightSettings],
    ) -> None:
        """Compiles the struct for the CPU, which takes seconds unless it is cached, and loads it.
        It is compiled for CUDA when it is first used with a tree on CUDA.

        Args:
            header: Path of the header.
            name: The name of a `template <class T> struct` in it, with its namespaces.
            uniforms: Its numbers by name, each a float or a tensor of one number; or all of them in
                one (k,) tensor, read in each frame. A struct without named uniforms takes any k.
            transfer: The transfer function that `look_up` and `hides` read.
            channel, component, other, other_component: See `Shader`.
            **light: As in `Lit`, for structs that use `light`.

        Raises:
            CompileError: The compiler rejects it; holds the compiler's output unchanged.
            RuntimeError: There is no compiler, the header changes while it is compiled, or the
                cache folder can't be written, is another user's, or is open to others' writes.
            ValueError: There is no such file, or uniforms are not those that the struct names.
        """
        super().__init__(**light)
        self.name = name
        self._use_compiled(user.load_op(header, name))
        self.transfer, self.channel, self.component = transfer, channel, component
        self.other, self.other_component = other, other_component
        self.uniforms = {} if uniforms is None else uniforms
        self._uniform_values()

    def _use_compiled(self, compiled: user.UserShader) -> None:
        self._compiled = compiled
        self.header, self.kind = compiled.header, compiled.name
        self.op, self.whole_ray = compiled.op, compiled.whole
        add_user_op(self.op)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a pickled shader: loads its op, compiling it if it is not in the cache."""
        self.__dict__.update(state)
        self._use_compiled(user.reload(self._compiled))

    @property
    def libraries(self) -> list[Path]:
        """The shared libraries of its op, CPU and CUDA. A process that only runs an archive or an
        exported program loads them with `torch.ops.load_library`.
        """
        return user.libraries(self.op)

    def feature_count(self, tree: N3Tree) -> int:
        """Returns the struct's `kFeatures`, or the width of the second channel if that is -1."""
        if self._compiled.features >= 0:
            return self._compiled.features
        if self.other is None:
            raise ValueError(f"{self.name}: its features are those of a second channel: name other")
        return tree.bricks.channels[self.other].width

    def parameter_tensor(self, tree: N3Tree, dtype: torch.dtype) -> Tensor:
        """Returns (20 + k,): the 20 numbers of any shader, then the current uniforms."""
        fixed = super().parameter_tensor(tree, dtype).reshape(-1)
        numbers = self._uniform_values()
        return torch.cat((fixed, pack(numbers, dtype, tree.device))) if numbers else fixed

    def shading(self, context: str, tree: N3Tree) -> ShadeArguments | None:
        """See `Shader`; compiles for CUDA if the tree is there, and raises as `__init__` does."""
        if tree.device.type == "cuda":
            user.load_cuda(self._compiled)
        return super().shading(context, tree)

    def _uniform_values(self) -> list[Any]:
        """Returns the uniforms in the struct's order, checked."""
        names, uniforms = self._compiled.uniforms, self.uniforms
        if isinstance(uniforms, Tensor):
            values: dict[str, Any] = {"uniforms": uniforms}
            count: int | str = "k" if names is None else len(names)
            check.tensor(self.name, "uniforms", uniforms, (count,), uniforms.dtype, uniforms.device)
        elif not isinstance(uniforms, Mapping):
            raise ValueError(f"{self.name}: uniforms must be a dict or a tensor, got {uniforms!r}")
        elif set(uniforms) != set(names or ()):
            expected = (
                ", ".join(names) if names else "none" if names is not None else "a (k,) tensor"
            )
            names_given = ", ".join(map(str, uniforms)) or "none"
            raise ValueError(f"{self.name}: uniforms must be {expected}, got {names_given}")
        else:
            values = {f"uniform {name}": uniforms[name] for name in names or ()}
        for label, value in values.items():
            if not isinstance(value, Tensor):
                check.number(self.name, label, value)
            elif value.numel() != 1 and value is not uniforms:
                got = check.describe(value)
                raise ValueError(f"{self.name}: {label} must be one number, got {got}")
            elif value.is_complex():
                raise ValueError(f"{self.name}: {label} must be real, got {check.describe(value)}")
        return list(values.values())
