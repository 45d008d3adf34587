"""Connects the compiled ops to torch: loads the libraries, chooses the backend of a call, turns
twins into ops, and registers their fakes, which give output shapes without data.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

from .. import cpp_ext
from ..base import check

Backend = Literal["auto", "reference", "cpp", "cuda"]
Words = Annotated[Tensor, torch.int32]
Longs = Annotated[Tensor, torch.int64]
Requests = Annotated[Tensor, torch.int16]
Flags = Annotated[Tensor, torch.bool]
Bytes = Annotated[Tensor, torch.uint8]
Doubles = Annotated[Tensor, torch.float64]
Count = Annotated[int, range(2**31)]  # what an int32 can count
_INT64 = range(-(2**63), 2**63)
_DTYPES = (torch.int32, torch.int64, torch.int16, torch.bool, torch.uint8, torch.float64)
_Twin = TypeVar("_Twin", bound=Callable[..., Any])
_Fake = TypeVar("_Fake", bound=Callable[..., Any])

#: Name of an op -> its fake. Those of the modules that are loaded; `gvtorch.ops` loads all.
FAKES: dict[str, Callable[..., Any]] = {}
_libraries: dict[str, torch.library.Library] = {}  # kernels last as long as these
_reasons = cpp_ext.load()  # why a backend can't be used, as far as one knows without using CUDA


def unavailable() -> dict[str, str]:
    """Returns why each of reference, cpp, cuda can't be used here; an empty text if it can. Where
    that asks CUDA's driver, processes that are forked later can't use CUDA.
    """
    reasons = {"reference": "", **_reasons}
    if not reasons["cuda"] and not torch.cuda.is_available():
        reasons["cuda"] = "torch can't use the CUDA device: its driver is too old, or fails"
    return reasons


def device_of(backend: str) -> torch.device:
    """Returns the device that a backend runs on; for auto, CUDA if it can be used here."""
    on_cuda = backend == "cuda" or (backend == "auto" and not unavailable()["cuda"])
    return torch.device("cuda" if on_cuda else "cpu")


def choose_backend(backend: str, device: torch.device) -> str:
    """Returns the backend to run on `device`; `auto` is the compiled one where it is available.

    Raises:
        ValueError: The backend is unknown, can't be used here, or does not run on `device`.
    """
    if backend not in ("auto", "reference", "cpp", "cuda"):
        raise ValueError(f"backend must be auto, reference, cpp or cuda, got {backend!r}")
    compiled = {"cpu": "cpp", "cuda": "cuda"}.get(device.type)
    if backend == "auto":
        return compiled if compiled and not _reasons[compiled] else "reference"
    if reason := _reasons.get(backend):
        raise ValueError(f"backend {backend!r} can't be used here: {reason}")
    if backend not in ("reference", compiled):
        raise ValueError(f"backend {backend!r} does not run on device {device}")
    return backend


def runs_twin(backend: str, *tensors: Tensor, has_backward: bool = False) -> bool:
    """Returns whether a call runs the twin: as `backend` says or, for auto, where gradients by its
    tensors are recorded, since torch can differentiate the twin. If the op itself has a backward,
    only where that is not enough: in forward mode, and for the transforms of `torch.func`. Raises
    as `choose_backend` does.
    """
    chosen = choose_backend(backend, tensors[0].device)
    if chosen == "reference" or backend != "auto":
        return chosen == "reference"
    recorded = [t for t in tensors if torch.is_grad_enabled() and t.requires_grad]
    if has_backward:  # compilers see the op as it is
        is_transformed = torch._C._functorch.is_gradtrackingtensor
        recorded = [t for t in recorded if not torch.compiler.is_compiling() and is_transformed(t)]
    return bool(recorded) or any(map(check.has_tangent, tensors))


def op(
    extra_check: Callable[..., None] | None = None,
    *,
    fake: Callable[..., Any] = lambda **_: None,
    gradients: bool = True,
) -> Callable[[_Twin], _Twin]:
    """Turns a twin into an op: it checks the arguments, then calls the compiled op of the twin's
    name or the twin itself, as the argument `backend` says: auto, reference, cpp or cuda.

    Tensors must be contiguous, on one device, of the dtype that their annotation names (Words,
    Longs, Requests, Flags, Bytes or Doubles) and of the shape in the suffix of their name; numbers
    must be in their range. Else the op raises ValueError. `extra_check` is a further check, which
    gets the arguments by name. `fake` and `gradients`: see `fake_of`.
    """

    def decorate(twin: _Twin) -> _Twin:
        op_name, signature = twin.__name__, inspect.signature(twin)
        fake_of(op_name, gradients=gradients)(fake)
        names = [name for name in signature.parameters if name != "backend"]
        hints = get_type_hints(twin, include_extras=True)
        places = list(enumerate(names))
        kinds = {name: _INT64 if hints[name] is int else hints[name] for name in names}
        kinds |= {n: get_args(k)[1] for n, k in kinds.items() if get_origin(k) is Annotated}
        ranges = [(place, name) for place, name in places if isinstance(kinds[name], range)]
        flags = [(place, name) for place, name in places if kinds[name] is bool]
        tensors = [
            (place, name, check.shape_of(name), dtype)
            for dtype in _DTYPES
            for place, name in places
            if kinds[name] == dtype
        ]

        @functools.wraps(twin)
        def run(*given: Any, backend: Backend = "auto", **kwargs: Any) -> Any:
            args = list(given)
            if kwargs or len(args) != len(names):
                bound = signature.bind(*args, **kwargs)
                bound.apply_defaults()
                args = list(bound.arguments.values())[: len(names)]
            device = check.instance(op_name, names[0], args[0], Tensor).device
            fields = [(name, args[place], shape, dtype) for place, name, shape, dtype in tensors]
            check.tensors(op_name, device, fields)
            for name, value, _, dtype in fields:
                if dtype == torch.float64:
                    check.no_gradient(op_name, name, value)
            for place, name in ranges:
                low, high = kinds[name][0], kinds[name][-1]
                args[place] = check.integer(op_name, name, args[place], low=low, high=high)
            for place, name in flags:
                check.instance(op_name, name, args[place], bool)
            if extra_check is not None:
                extra_check(**dict(zip(names, args, strict=True)))
            if choose_backend(backend, device) == "reference":
                return twin(*args, backend="reference")
            return getattr(torch.ops.gvtorch, op_name)(*args)

        return cast("_Twin", run)

    return decorate


def fake_of(op_name: str, *, gradients: bool = True) -> Callable[[_Fake], _Fake]:
    """Makes a function the fake of a compiled op: it gets the op's arguments by the names in the
    schema, and returns tensors of the right shape and dtype, whatever is in them.

    `gradients=False` is for an op that has no backward and returns floats of inputs which may
    require a gradient: it then raises if one does. (An op that is itself a backward would otherwise
    lose second derivatives.)
    """

    def register(fake: _Fake) -> _Fake:
        FAKES[op_name] = fake
        if not _reasons["cpp"]:
            op = getattr(torch.ops.gvtorch, op_name)
            _register_fake(op, fake)
            if not gradients:
                _refuse_gradients(op)
        return fake

    return register


@functools.cache
def add_user_op(name: str) -> None:
    """Registers the fake of the op of a loaded user's shader, and makes it refuse gradients."""
    op = getattr(torch.ops.gvtorch_user, name)
    _register_fake(op, FAKES["shade_rays"])
    _refuse_gradients(op)


def argument_names(op: Any) -> tuple[str, ...]:
    """Returns the names of a compiled op's arguments, in order."""
    return tuple(argument.name for argument in op.default._schema.arguments)


def _register_fake(op: Any, fake: Callable[..., Any]) -> None:
    names = argument_names(op)

    def by_name(*args: Any, **kwargs: Any) -> Any:
        return fake(**dict(zip(names, args, strict=False)), **kwargs)

    torch.library.register_fake(op.default.name(), by_name)


def _refuse_gradients(op: Any) -> None:
    """Makes an op without a backward raise where an input requires a gradient: its outputs would
    require one too, and yield None. Autograd calls this in every mode: eager, script, compile,
    export.
    """
    names = argument_names(op)
    namespace, _, op_name = op.default.name().partition("::")
    if namespace not in _libraries:
        _libraries[namespace] = torch.library.Library(namespace, "IMPL")

    def kernel(dispatch_keys: Any, *args: Any) -> Any:
        for position, value in enumerate(args):
            if isinstance(value, Tensor) and check.is_recorded(value):
                raise check.lost_gradient(op_name, names[position])
        return op.default.redispatch(dispatch_keys & torch._C._after_autograd_keyset, *args)

    _libraries[namespace].impl(op_name, kernel, "Autograd", with_keyset=True)
