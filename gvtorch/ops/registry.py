"""Connects the compiled ops to torch: loads the libraries, chooses the backend of a call, turns
twins into ops, and registers a fake (output shapes without data) for each op. Fakes receive their
arguments by the names in the op's schema, see cpp_ext/csrc.
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
_DTYPES = (torch.int32, torch.int64, torch.int16, torch.bool, torch.uint8, torch.float64)
_Twin = TypeVar("_Twin", bound=Callable[..., Any])


def unavailable() -> dict[str, str]:
    """Returns why each of reference, cpp, cuda can't be used here; an empty text if it can."""
    return {"reference": "", **_reasons}


def device_of(backend: str) -> torch.device:
    """Returns the device that a backend runs on; for auto, CUDA if it can be used here."""
    on_cuda = backend == "cuda" or (backend == "auto" and not unavailable()["cuda"])
    return torch.device("cuda" if on_cuda else "cpu")


@functools.cache
def choose_backend(backend: str, device: torch.device) -> str:
    """Returns the backend to run on `device`; `auto` is the compiled one where it is available.

    Raises:
        ValueError: The backend is unknown, can't be used here, or does not run on `device`.
    """
    if backend not in ("auto", "reference", "cpp", "cuda"):
        raise ValueError(f"backend must be auto, reference, cpp or cuda, got {backend!r}")
    compiled = {"cpu": "cpp", "cuda": "cuda"}.get(device.type)
    if backend == "auto":
        return compiled if compiled and not unavailable()[compiled] else "reference"
    reason = unavailable()[backend]
    if reason:
        raise ValueError(f"backend {backend!r} can't be used here: {reason}")
    if backend not in ("reference", compiled):
        raise ValueError(f"backend {backend!r} does not run on device {device}")
    return backend


uncached_backend = choose_backend.__wrapped__  # torch.compile warns of caches


def runs_twin(backend: str, *tensors: Tensor) -> bool:
    """Returns whether a call runs the twin: as `backend` says or, for auto, where gradients by its
    tensors are recorded, since torch can differentiate the twin. Raises as `choose_backend` does.
    """
    needs_gradient = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    chosen = uncached_backend(backend, tensors[0].device)
    return chosen == "reference" or (needs_gradient and backend == "auto")


def op(extra_check: Callable[..., None] | None = None) -> Callable[[_Twin], _Twin]:
    """Turns a twin into an op: it checks the arguments, then calls the compiled op of the twin's
    name or the twin itself, as the argument `backend` says: auto, reference, cpp or cuda.

    Tensors must be contiguous, on one device, of the dtype that their annotation names (Words,
    Longs, Requests, Flags, Bytes or Doubles) and of the shape in the suffix of their name (any
    shape without one); numbers must be in their range. Else the op raises ValueError. `extra_check`
    is a further check, which gets the arguments by name.
    """

    def decorate(twin: _Twin) -> _Twin:
        op_name, signature = twin.__name__, inspect.signature(twin)
        names = [name for name in signature.parameters if name != "backend"]
        hints = get_type_hints(twin, include_extras=True).items()
        annotations = {
            name: get_args(hint)[1] for name, hint in hints if get_origin(hint) is Annotated
        }
        ranges = {
            name: annotation
            for name, annotation in annotations.items()
            if isinstance(annotation, range)
        }
        positions = {name: position for position, name in enumerate(names)}
        tensors = [
            (positions[name], name, check.shape_of(name) if "_" in name else "", dtype)
            for dtype in _DTYPES
            for name, annotation in annotations.items()
            if annotation == dtype
        ]

        @functools.wraps(twin)
        def run(*args: Any, backend: Backend = "auto", **kwargs: Any) -> Any:
            if kwargs or len(args) != len(names):
                bound = signature.bind(*args, **kwargs)
                bound.apply_defaults()
                args = tuple(bound.arguments.values())[: len(names)]
            device = check.instance(op_name, names[0], args[0], Tensor).device
            fields = [
                (name, args[position], shape or _any_shape(op_name, name, args[position]), dtype)
                for position, name, shape, dtype in tensors
            ]
            check.tensors(op_name, device, fields)
            for position, name, _, dtype in tensors:
                if dtype == torch.float64:
                    check.no_gradient(op_name, name, args[position])
            for name, allowed in ranges.items():
                check.integer(
                    op_name, name, args[positions[name]], low=allowed[0], high=allowed[-1]
                )
            if extra_check is not None:
                extra_check(**dict(zip(names, args, strict=True)))
            if choose_backend(backend, device) == "reference":
                return twin(*args, backend="reference")
            return getattr(torch.ops.gvtorch, op_name)(*args)

        return cast("_Twin", run)

    return decorate


def _any_shape(context: str, name: str, value: Any) -> str:
    return "abcd"[: check.instance(context, name, value, Tensor).dim()]


def _names(op: Any) -> tuple[str, ...]:
    return tuple(argument.name for argument in op.default._schema.arguments)


def _register_fake(op: Any, fake: Callable[..., Any]) -> None:
    names = _names(op)

    def by_name(*args: Any, **kwargs: Any) -> Any:
        return fake(**dict(zip(names, args, strict=False)), **kwargs)

    torch.library.register_fake(op.default.name(), by_name)


def _trace_rays(*, origin_r3: Tensor, table_lm4: Tensor, **_: Any) -> tuple[Tensor, ...]:
    rays = origin_r3.shape[0]
    return (
        *(table_lm4.new_empty((rays, width)) for width in (3, 1, 1)),
        table_lm4.new_empty((rays,), dtype=torch.int32),
        table_lm4.new_empty((rays,), dtype=torch.bool),
    )


def _shade_rays(*, table_lm4: Tensor, features: int, **arguments: Any) -> tuple[Tensor, ...]:
    hits = _trace_rays(table_lm4=table_lm4, **arguments)
    rays = hits[0].shape[0]
    return (*hits, *(table_lm4.new_empty((rays, width)) for width in (3, features)))


def _count_segments(*, origin_r3: Tensor, domain_2: Tensor, **_: Any) -> tuple[Tensor, ...]:
    rays = origin_r3.shape[0]
    return (
        domain_2.new_empty((rays, 3), dtype=torch.int32),
        domain_2.new_empty((rays, 3)),
        domain_2.new_empty((rays,), dtype=torch.bool),
    )


def _write_segments(*, domain_2: Tensor, total: int, **_: Any) -> tuple[Tensor, ...]:
    widths = ((), (2,), (2,), (3,), (3,))
    words = (domain_2.new_empty((total, *width), dtype=torch.int32) for width in widths)
    return (*words, *(domain_2.new_empty((total, *width)) for width in ((3,), (), ())))


def _sample_bricks(
    *, bricks_bzyxc: Tensor, distance_s3: Tensor, segment_k: Tensor, **_: Any
) -> Tensor:
    return distance_s3.new_empty((segment_k.shape[0], bricks_bzyxc.shape[4]))


def _sample_bricks_backward(
    *, grad_kc: Tensor, bricks_bzyxc: Tensor, constant_tnc: Tensor, **_: Any
) -> tuple[Tensor, Tensor]:
    return grad_kc.new_empty(bricks_bzyxc.shape), grad_kc.new_empty(constant_tnc.shape)


def _composite(
    *, alpha_k: Tensor, feature_kc: Tensor, clear_r: Tensor, **_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    total = alpha_k.new_empty((clear_r.shape[0], feature_kc.shape[1]))
    return total, torch.empty_like(clear_r), torch.empty_like(alpha_k)


def _composite_backward(
    *, grad_left_r: Tensor, alpha_k: Tensor, feature_kc: Tensor, **_: Any
) -> tuple[Tensor, Tensor, Tensor]:
    return torch.empty_like(alpha_k), torch.empty_like(feature_kc), torch.empty_like(grad_left_r)


def _cut_bricks(*, values_zyxc: Tensor, place_k3: Tensor, brick_size: int, border: int) -> Tensor:
    side = brick_size + 2 * border
    return values_zyxc.new_empty((place_k3.shape[0], side, side, side, values_zyxc.shape[3]))


def _pinhole_rays(*, camera_nc: Tensor, rows: int, width: int, **_: Any) -> tuple[Tensor, ...]:
    return tuple(camera_nc.new_empty((rows * width, numbers)) for numbers in (3, 3, 2, 2))


def _voxelize(
    *, low_k3: Tensor, side: int, shares: bool, weights: bool, wide: bool, **_: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    cubes, shape = low_k3.shape[0], (side, side, side)
    float_volume = low_k3.new_empty((cubes, *shape), dtype=torch.float64 if wide else torch.float32)
    int_volume = torch.empty_like(float_volume, dtype=torch.int32)
    share = float_volume.new_empty((cubes if shares else 0, *shape))
    weight = float_volume.new_empty((cubes if weights else 0, *shape, 3))
    return float_volume, int_volume, torch.empty_like(int_volume), share, weight


def _splat(*, edge_k3e: Tensor, value_nc: Tensor, **_: Any) -> Tensor:
    side = edge_k3e.shape[2] - 1
    return edge_k3e.new_empty((edge_k3e.shape[0], side, side, side, value_nc.shape[1]))


FAKES: dict[str, Callable[..., Any]] = {
    "trace_rays": _trace_rays,
    "shade_rays": _shade_rays,
    "count_segments": _count_segments,
    "write_segments": _write_segments,
    "sample_bricks": _sample_bricks,
    "sample_bricks_backward": _sample_bricks_backward,
    "composite": _composite,
    "composite_backward": _composite_backward,
    "compact_requests": lambda *, request_tn, capacity: (
        request_tn.new_empty((capacity,), dtype=torch.int32),
        request_tn.new_empty((capacity,), dtype=torch.int32),
        request_tn.new_empty((5,), dtype=torch.int64),
    ),
    "choose_requests": lambda *, asked_l2k, batch, **_: (
        asked_l2k.new_empty((2, batch), dtype=torch.int64),
        asked_l2k.new_empty((2, batch)),
    ),
    "lru_partition": lambda *, order_k, **_: (
        torch.empty_like(order_k),
        order_k.new_empty((1,), dtype=torch.int64),
    ),
    "locate": lambda *, node_k, **_: node_k.new_empty((node_k.shape[0], 4)),
    "lacking": lambda *, node_k, **_: torch.empty_like(node_k, dtype=torch.bool),
    "cut_bricks": _cut_bricks,
    "pinhole_rays": _pinhole_rays,
    "voxelize": _voxelize,
    "splat": _splat,
    "orbits": lambda *, point_p3, **_: point_p3.new_empty((3, point_p3.shape[0])),
    "orbit_bounds": lambda *, center_k3, **_: center_k3.new_empty((2, center_k3.shape[0])),
    "noise": lambda *, point_pn, **_: point_pn.new_empty((point_pn.shape[0],)),
    **dict.fromkeys(
        ("unlink", "orphan", "link", "link_bricks", "link_tiles", "put_rows"), lambda **_: None
    ),
}


#: Ops that return floats of inputs that may require a gradient, and have no backward. (Those that
#: are one themselves would otherwise lose second derivatives.)
WITHOUT_GRADIENTS = (
    *("trace_rays", "shade_rays", "noise", "splat", "orbits", "orbit_bounds"),
    *("sample_bricks_backward", "composite_backward"),
)

_libraries: dict[str, torch.library.Library] = {}  # kernels last as long as these


def _refuse_gradients(op: Any) -> None:
    """Makes an op without a backward raise where an input requires a gradient: its outputs would
    require one too, and yield None. Autograd calls this in every mode: eager, script, compile and
    export.
    """
    names = _names(op)
    namespace, _, op_name = op.default.name().partition("::")
    if namespace not in _libraries:
        _libraries[namespace] = torch.library.Library(namespace, "IMPL")

    def kernel(dispatch_keys: Any, *args: Any) -> Any:
        if torch.is_grad_enabled():
            for position, value in enumerate(args):
                if isinstance(value, Tensor) and value.requires_grad:
                    raise check.lost_gradient(op_name, names[position])
        return op.default.redispatch(dispatch_keys & torch._C._after_autograd_keyset, *args)

    _libraries[namespace].impl(op_name, kernel, "Autograd", with_keyset=True)


@functools.cache
def add_user_op(name: str) -> None:
    """Registers the fake of the op of a loaded user's shader, and makes it refuse gradients."""
    op = getattr(torch.ops.gvtorch_user, name)
    _register_fake(op, _shade_rays)
    _refuse_gradients(op)


def _save_samples(ctx: Any, inputs: tuple, output: Tensor) -> None:
    for name, value in zip(_names(torch.ops.gvtorch.sample_bricks), inputs, strict=True):
        if name not in _DIFFERENTIABLE and isinstance(value, Tensor) and value.requires_grad:
            raise check.lost_gradient("sample_bricks", name)
    ctx.save_for_backward(*(value if isinstance(value, Tensor) else None for value in inputs))
    ctx.numbers = [None if isinstance(value, Tensor) else value for value in inputs]


def _sample_gradient(ctx: Any, grad_kc: Tensor) -> tuple[Tensor | None, ...]:
    """Returns the gradients by bricks and constants, in their dtype, and None for the rest."""
    pairs = zip(ctx.saved_tensors, ctx.numbers, strict=True)
    inputs = [number if tensor is None else tensor for tensor, number in pairs]
    bricks, constants = torch.ops.gvtorch.sample_bricks_backward(grad_kc.contiguous(), *inputs)
    names = _names(torch.ops.gvtorch.sample_bricks)
    dtype = inputs[names.index("bricks_bzyxc")].dtype
    grads = {"bricks_bzyxc": bricks.to(dtype), "constant_tnc": constants.to(dtype)}
    return tuple(grads.get(name) for name in names)


def _save_composite(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
    alpha_k, feature_kc, offset_r, _, ctx.stop_clear = inputs
    ctx.mark_non_differentiable(output[2])
    ctx.save_for_backward(alpha_k, feature_kc, offset_r, output[2])


def _composite_gradient(
    ctx: Any, grad_sum_rc: Tensor, grad_left_r: Tensor, _: Tensor
) -> tuple[Tensor | None, ...]:
    grads = (grad_sum_rc.contiguous(), grad_left_r.contiguous())
    backward = torch.ops.gvtorch.composite_backward
    alpha, feature, clear = backward(*grads, *ctx.saved_tensors, ctx.stop_clear)
    return alpha, feature, None, clear, None


#: Arguments of `sample_bricks` that have gradients.
_DIFFERENTIABLE = ("bricks_bzyxc", "constant_tnc")

_reasons = cpp_ext.load()
if not _reasons["cpp"]:
    for _name, _fake in FAKES.items():
        _register_fake(getattr(torch.ops.gvtorch, _name), _fake)
    for _name in WITHOUT_GRADIENTS:
        _refuse_gradients(getattr(torch.ops.gvtorch, _name))
    torch.library.register_autograd(
        "gvtorch::sample_bricks", _sample_gradient, setup_context=_save_samples
    )
    torch.library.register_autograd(
        "gvtorch::composite", _composite_gradient, setup_context=_save_composite
    )
