"""What runs an op: the backend of a call, and `op`, which makes an op of its twin."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

from ..base import check
from .registry import available

Backend = Literal["auto", "reference", "cpp", "cuda"]
Words = Annotated[Tensor, torch.int32]
Longs = Annotated[Tensor, torch.int64]
Flags = Annotated[Tensor, torch.bool]
_Twin = TypeVar("_Twin", bound=Callable[..., Any])


@functools.cache
def choose_backend(backend: str, device: torch.device) -> str:
    """Returns the backend that runs on `device`: `auto` takes the compiled one where there is one.

    Raises:
        ValueError: The backend is unknown, can't be used here, or does not run on `device`.
    """
    if backend not in ("auto", "reference", "cpp", "cuda"):
        raise ValueError(f"backend must be auto, reference, cpp or cuda, got {backend!r}")
    compiled = {"cpu": "cpp", "cuda": "cuda"}.get(device.type)
    if backend == "auto":
        return compiled if compiled and not available()[compiled] else "reference"
    reason = available()[backend]
    if reason:
        raise ValueError(f"backend {backend!r} can't be used here: {reason}")
    if backend not in ("reference", compiled):
        raise ValueError(f"backend {backend!r} does not run on device {device}")
    return backend


def op(also: Callable[..., None] | None = None) -> Callable[[_Twin], _Twin]:
    """Makes an op of its twin: checks what comes, and calls the compiled op of the twin's name, or
    the twin, as its argument `backend` says: auto, reference, cpp or cuda.

    Tensors must be contiguous, on one device, and of the shape that their name ends with (of any,
    if it has no such end) and the dtype of Words, Longs or Flags; numbers inside their range. Else
    the op raises ValueError.

    Args:
        also: One more check, which gets the arguments by name.
    """

    def made_of(twin: _Twin) -> _Twin:
        where, signature = twin.__name__, inspect.signature(twin)
        names = [name for name in signature.parameters if name != "backend"]
        hints = get_type_hints(twin, include_extras=True).items()
        marks = {name: get_args(hint)[1] for name, hint in hints if get_origin(hint) is Annotated}
        ranges = {name: mark for name, mark in marks.items() if isinstance(mark, range)}
        tensors = [
            (name, check.shape_of(name) if "_" in name else "", dtype)
            for dtype in (torch.int32, torch.int64, torch.bool)
            for name, mark in marks.items()
            if mark == dtype
        ]

        @functools.wraps(twin)
        def run(*given: Any, backend: Backend = "auto", **named: Any) -> Any:
            if named or len(given) != len(names):
                bound = signature.bind(*given, **named)
                bound.apply_defaults()
                given = tuple(bound.arguments.values())[: len(names)]
            by_name, device = dict(zip(names, given, strict=True)), given[0].device
            fields = [
                (name, by_name[name], shape or "abcd"[: by_name[name].dim()], dtype)
                for name, shape, dtype in tensors
            ]
            check.tensors(where, device, fields)
            for name, inside in ranges.items():
                check.whole(where, name, by_name[name], low=inside[0], high=inside[-1])
            if also is not None:
                also(**by_name)
            if choose_backend(backend, device) == "reference":
                return twin(*given, backend="reference")
            return getattr(torch.ops.gvtorch, where)(*given)

        return cast("_Twin", run)

    return made_of
