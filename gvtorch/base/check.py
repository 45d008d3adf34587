"""Checks of user input. Errors are one line that names the caller, what was expected and what was
given.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import operator
import os
import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from .constants import MAX_EXTENT
from .messages import one_line

Kind = TypeVar("Kind")
_IMPORTED_BY = os.getpid()  # a process with another number was forked later


def describe(tensor: Any) -> str:
    """Returns shape, dtype and device of a tensor as one phrase, with its layout unless dense; or
    the type of anything else.
    """
    if not isinstance(tensor, Tensor):
        return type(tensor).__name__
    layout = "" if tensor.layout == torch.strided else f", {tensor.layout}"
    return f"{as_text(tensor)} on {tensor.device}{layout}".replace("torch.", "")


def summary(record: Any) -> str:
    """Returns one line on a dataclass: what differs from defaults, tensors by shape and dtype."""
    parts = []
    for field in fields(record):
        value = getattr(record, field.name)
        if field.repr and (isinstance(value, Tensor) or value not in (field.default, {})):
            parts.append(f"{field.name}={as_text(value)}")
    return f"{type(record).__name__}({', '.join(parts)})"


def as_text(value: Any) -> str:
    """Returns a value as text; for a tensor or array only its shape and dtype."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {as_text(item)}" for key, item in value.items()) + "}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    return repr(value)


def quoted(value: Any) -> str:
    """Returns a value as an error message shows it: one line of about 200 characters at most."""
    if isinstance(value, int) and value.bit_length() > 1000:
        return f"a number of {value.bit_length()} bits"  # Python refuses to print over 4,300 digits
    return one_line(as_text(value), 200)


def tensor(
    context: str,
    name: str,
    value: Any,
    shape: Sequence[int | str],
    dtype: torch.dtype,
    device: torch.device,
) -> None:
    """Raises ValueError unless `value` is a tensor of this shape (a letter matches any size), dtype
    and device: `where: name must be (r, 3) float32 on cpu, got (4, 2) float64 on cpu`.
    """
    fits = isinstance(value, Tensor) and value.dtype == dtype and value.device == device
    if fits and value.dim() == len(shape):
        pairs = zip(shape, value.shape, strict=True)
        if all(isinstance(expected, str) or expected == size for expected, size in pairs):
            return
    wanted = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    form = f"({wanted}) {str(dtype).removeprefix('torch.')} on {device}"
    raise ValueError(f"{context}: {name} must be {form}, got {describe(value)}")


_DIGIT_SIZES = {str(digit): digit for digit in range(10)}
#: Name, tensor, shape (a letter or digit per dimension) and dtype of a tensor to check, as in
#: ("origin_r3", origin_r3, "r3", float64).
Field = tuple[str, Tensor, str, torch.dtype]


def tensors(
    context: str,
    device: torch.device,
    fields: Iterable[Field],
    sizes: Mapping[str, int] | None = None,
) -> dict[str, int]:
    """Checks tensors and returns the size of each letter, which must be the same in all fields;
    `sizes` are known beforehand.

    Raises:
        ValueError: A tensor is not contiguous or not of its shape, dtype and device.
    """
    size_by_letter = {**_DIGIT_SIZES, **(sizes or {})}
    for name, value, shape, dtype in fields:
        count_before = len(size_by_letter)
        fits = isinstance(value, Tensor) and value.dtype == dtype and value.device == device
        if fits and value.dim() == len(shape):
            for letter, size in zip(shape, value.shape, strict=True):
                if size_by_letter.setdefault(letter, size) != size:
                    break
            else:
                if value.is_contiguous():
                    continue
                raise ValueError(f"{context}: {name} must be contiguous")
        # Those from the fields before this one.
        earlier_sizes = dict(itertools.islice(size_by_letter.items(), count_before))
        expected = [earlier_sizes.get(letter, letter) for letter in shape]
        # Raises, unless the only fault is a letter that has two sizes within this field.
        tensor(context, name, value, expected, dtype, device)
        raise ValueError(f"{context}: {name} must be ({', '.join(shape)}), got {describe(value)}")
    return size_by_letter


@functools.cache
def shape_of(name: str) -> str:
    """Returns the shape suffix of a name, "r3" for origin_r3. Bricks are cubes, so bricks_bzyxc
    gives "bsssc".
    """
    return name.rpartition("_")[2].replace("bzyx", "bsss")


def instance(context: str, name: str, value: Any, *kinds: type[Kind]) -> Kind:
    """Returns `value`; raises ValueError unless it is an instance of one of the classes."""
    if not isinstance(value, kinds):
        wanted = either(kind.__name__ for kind in kinds)
        raise ValueError(f"{context}: {name} must be a {wanted}, got {type(value).__name__}")
    return value


def either(words: Iterable[str]) -> str:
    """Returns "a, b or c" for words a, b and c."""
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def items(context: str, name: str, value: Any) -> tuple[Any, ...]:
    """Returns the items of a list or another iterable; ValueError for text and anything else."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ValueError(f"{context}: {name} must be a list, got {quoted(value)}")
    return tuple(value)


def text(context: str, name: str, value: Any) -> str | None:
    """Returns `value`; ValueError unless it is a str or None (`==` and `or` fail on arrays)."""
    return None if value is None else instance(context, name, value, str)


def float_dtype(context: str, dtype: Any) -> None:
    """Raises ValueError unless `dtype` is one of floats."""
    if not instance(context, "dtype", dtype, torch.dtype).is_floating_point:
        raise ValueError(f"{context}: dtype must be one of floats, got {dtype}")


def one_of(context: str, name: str, value: Any, allowed: Iterable[Any]) -> None:
    """Raises ValueError, which lists the known values, unless `value` is one of them."""
    choices = [*allowed]
    if getattr(value, "ndim", 0) or value not in choices:  # arrays have no truth value
        listing = either(map(repr, choices or [None]))
        raise ValueError(f"{context}: {name} must be {listing}, got {quoted(value)}")


def channel(context: str, name: str, channels: Collection[str], owner: str = "the tree") -> None:
    """Raises ValueError unless `name` is one of the `channels` of an `owner`."""
    if name not in channels:
        raise ValueError(
            f"{context}: unknown channel {quoted(name)}; {owner} has {', '.join(channels)}"
        )


def known_options(context: str, options: Mapping[str, Any], typed_dict: type) -> None:
    """Raises ValueError unless all options are keys of a `TypedDict`."""
    names = typed_dict.__annotations__
    unknown = sorted(set(options) - set(names))
    if unknown:
        raise ValueError(f"{context}: unknown option {unknown[0]!r}; known: {', '.join(names)}")


def no_gradient(context: str, name: str, value: Any) -> None:
    """Raises RuntimeError if a tensor requires gradients that autograd records but would lose.

    Works alike in eager, scripted, compiled and exported programs: ops/registry.py calls it for the
    arguments of ops, other modules call it where values leave torch.
    """
    if isinstance(value, Tensor) and is_recorded(value):
        raise lost_gradient(context, name)


def is_recorded(value: Tensor) -> bool:
    """Returns whether autograd records gradients by a tensor, backward or in forward mode."""
    return (value.requires_grad and torch.is_grad_enabled()) or has_tangent(value)


def has_tangent(value: Tensor) -> bool:
    """Returns whether autograd tracks a tensor in forward mode, as in `torch.func.jvp`."""
    return forward_ad._current_level >= 0 and forward_ad.unpack_dual(value).tangent is not None


def lost_gradient(context: str, name: str) -> RuntimeError:
    """Returns the error for a gradient that would be lost."""
    reason = (
        "only gv.ModuleShader gives gradients, by its parameters and by bricks that require them; "
        "else take detach() or torch.no_grad()"
    )
    if context.endswith("_backward"):
        reason = "for second derivatives backend must be 'reference'"
    return RuntimeError(f"{context}: gradients by {name} would be lost: {reason}")


def images(context: str, name: str, value: Any, channels: int, *, batch: bool = True) -> None:
    """Raises ValueError unless `value` is a non-empty float picture (h, w, channels) or, if `batch`
    is true, several (n, h, w, channels).
    """
    if (
        isinstance(value, Tensor)
        and value.is_floating_point()
        and value.dim() in ((3, 4) if batch else (3,))
        and value.shape[-1] == channels
        and value.numel()
    ):
        return
    wanted = f"(h, w, {channels})" + (f" or (n, h, w, {channels})" if batch else "")
    raise ValueError(f"{context}: {name} must be {wanted} floats, got {describe(value)}")


def device(context: str, value: Any) -> torch.device:
    """Returns a device as in `tensor.device`, CUDA always with an index; ValueError if it
    can't be used.
    """
    try:
        parsed = torch.device(value)
    except (RuntimeError, TypeError):
        raise ValueError(f"{context}: device must name a device, got {quoted(value)}") from None
    if parsed.type == "cpu":
        return torch.device("cpu")  # as in `tensor.device`, whatever the index
    if parsed.type != "cuda":
        try:
            number = torch.zeros((), device=parsed)
            number.item()  # fails on the device "meta"
            return number.device
        except (RuntimeError, AssertionError):
            raise ValueError(
                f"{context}: device {str(parsed)!r} can't be used here: torch can't read there"
            ) from None
    if not torch.cuda.is_available():
        raise ValueError(f"{context}: device 'cuda' can't be used here: torch sees no CUDA device")
    try:
        torch.cuda.init()
    except RuntimeError as error:
        reason = one_line(str(error).partition("\n")[0])
        if os.getpid() != _IMPORTED_BY:
            reason = "this process was forked; start it by 'spawn' or 'forkserver'"
        raise ValueError(f"{context}: device 'cuda' can't be used here: {reason}") from error
    index = torch.cuda.current_device() if parsed.index is None else parsed.index
    count = torch.cuda.device_count()
    if index >= count:
        seen = f"torch sees {count} of them"
        raise ValueError(f"{context}: device {parsed} can't be used here: {seen}")
    return torch.device("cuda", index)


def memory(context: str, label: str, nbytes: int, device: torch.device) -> None:
    """Raises ValueError if something takes more memory than the device has in all."""
    if device.type == "cuda":
        total = torch.cuda.get_device_properties(device).total_memory
    else:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if nbytes > total:
        raise ValueError(
            f"{context}: {label} takes {nbytes / 2**30:.1f} GiB, "
            f"{device} has {total / 2**30:.1f} GiB"
        )


_MIN_SIZE = 1e-60  # smallest allowed size: ratios and squares neither overflow nor become 0
_MAX_ORIGIN_VOXELS = 2.0**50  # from the world's origin: positions are exact to 1/8 voxel there
_MAX_JSON_BYTES = 1 << 26  # bytes of a user's file
_BYTE_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_BYTE_UNITS |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30, "TIB": 2**40}


def nbytes(context: str, name: str, value: Any) -> int:
    """Returns bytes from a number, "8 MB" (10^6) or "8 MiB" (2^20); ValueError otherwise."""
    if isinstance(value, str):
        match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([A-Za-z]*)\s*", value)
        unit = _BYTE_UNITS.get(match[2].upper()) if match else None
        if match is None or unit is None:
            got = quoted(value)
            raise ValueError(f'{context}: {name} must be bytes, as in "256 MB", got {got}')
        value = int(min(float(match[1]) * unit, 2.0**63))
    return integer(context, name, value, low=1, high=2**62)


def integers_in(context: str, name: str, value: Tensor, low: int, high: int) -> None:
    """Raises ValueError unless all integers of a tensor are in [low, high]."""
    extremes = (int(value.amin()), int(value.amax())) if value.numel() else ()
    bad = next((extreme for extreme in extremes if not low <= extreme <= high), None)
    if bad is not None:
        raise ValueError(f"{context}: {name} holds {bad}, must be {low} to {high}")


def number(
    context: str,
    name: str,
    value: Any,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    open_low: bool = False,
) -> float:
    """Returns `value` as a float; ValueError unless finite and in [low, high] (or (low, high]).
    Text and complex numbers are none, though `float` takes some of them.
    """
    no_gradient(context, name, value)
    try:
        if isinstance(value, (str, bytes)) or _is_complex(value):
            raise TypeError
        result = float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # the last from tensors
        raise ValueError(f"{context}: {name} must be a number, got {quoted(value)}") from None
    inside = low < result <= high if open_low else low <= result <= high
    if not (math.isfinite(result) and inside):
        lower = f" and {'>' if open_low else '>='} {low:g}" if low > -math.inf else ""
        upper = f" and <= {high:g}" if high < math.inf else ""
        raise ValueError(f"{context}: {name} must be finite{lower}{upper}, got {quoted(value)}")
    return result


def _is_complex(value: Any) -> bool:
    return "complex" in str(getattr(value, "dtype", ""))


def integer(context: str, name: str, value: Any, *, low: int, high: int = sys.maxsize) -> int:
    """Returns `value` as an int; raises ValueError unless it is a whole number in [low, high]."""
    try:
        integer = operator.index(value)
    except (TypeError, RuntimeError):  # from tensors and arrays
        integer = None
    if isinstance(value, bool) or integer is None or not low <= integer <= high:
        upper = f" and <= {high}" if high < sys.maxsize else ""
        raise ValueError(f"{context}: {name} must be an int >= {low}{upper}, got {quoted(value)}")
    return integer


def branching_two(context: str, branching: Any, feature: str) -> None:
    """Raises ValueError unless N is 2, as `feature` requires: its levels halve the resolution."""
    if branching != 2:
        raise ValueError(f"{context}: branching must be 2 for {feature}, got {quoted(branching)}")


def triple(
    context: str,
    name: str,
    value: Any,
    *,
    positive: bool = False,
    low: float = -math.inf,
    high: float = math.inf,
) -> tuple[float, float, float]:
    """Returns (x, y, z); raises ValueError unless they are finite, in [low, high], and positive if
    `positive`.
    """
    no_gradient(context, name, value)
    if isinstance(value, Tensor):
        value = value.tolist()
    try:
        items = tuple(value)
    except TypeError:
        raise ValueError(f"{context}: {name} must be three numbers, got {quoted(value)}") from None
    if len(items) != 3:
        got = f"{len(items)}: {quoted(value)}"
        raise ValueError(f"{context}: {name} must be three numbers, got {got}")
    x, y, z = (number(context, name, item, low=low, high=high) for item in items)
    if positive and min(x, y, z) <= 0:
        raise ValueError(f"{context}: {name} must be positive, got {(x, y, z)}")
    if positive and not _MIN_SIZE <= min(x, y, z) <= max(x, y, z) <= 1 / _MIN_SIZE:
        limits = f"{_MIN_SIZE:g} to {1 / _MIN_SIZE:g}"
        raise ValueError(f"{context}: {name} must be {limits}, got {(x, y, z)}")
    return (x, y, z)


def box(context: str, value: Any) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Returns two corners, (x, y, z) each; ValueError unless all sides are positive."""
    try:
        low, high = value
    except (TypeError, ValueError):
        raise ValueError(f"{context}: box must be two corners, got {quoted(value)}") from None
    low, high = (triple(context, "box", corner) for corner in (low, high))
    sides = [b - a for a, b in zip(low, high, strict=True)]
    triple(context, "sides of the box", sides, positive=True)
    return low, high


def extent_of(context: str, extent: int | Sequence[int]) -> tuple[int, int, int]:
    """Returns voxels along x, y, z, given these or one number for all; ValueError otherwise."""
    sizes = tuple(extent) if isinstance(extent, Sequence) else (extent,) * 3
    if len(sizes) != 3:
        raise ValueError(f"{context}: extent must be a number or (x, y, z), got {extent!r}")
    x, y, z = (integer(context, "extent", size, low=1, high=MAX_EXTENT) for size in sizes)
    return x, y, z


def extent_in(
    context: str, extent: int | Sequence[int], corners: Sequence[Sequence[float]]
) -> tuple[int, int, int]:
    """Returns an extent (x, y, z) as it is. A single number is the extent along a box's longest
    side; the others are chosen so that voxels are cubes, or nearly so. ValueError if it is neither.
    """
    sizes = extent_of(context, extent)
    if isinstance(extent, Sequence):
        return sizes
    low, high = box(context, corners)
    sides = [b - a for a, b in zip(low, high, strict=True)]
    x, y, z = (max(1, round(sizes[0] * side / max(sides))) for side in sides)
    return x, y, z


def grid_placement(
    context: str, spacing: Any, origin: Any, extent: Sequence[int]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Returns spacing and origin, (x, y, z) each, of a grid of `extent` voxels (x, y, z); raises
    ValueError if it is so far from 0 that float64 can't resolve its voxels.
    """
    steps = triple(context, "spacing", spacing, positive=True)
    position = triple(context, "origin", origin)
    for step, first, count in zip(steps, position, extent, strict=True):
        if max(abs(first), abs(first + step * count)) > _MAX_ORIGIN_VOXELS * step:
            raise ValueError(
                f"{context}: origin must lie within {_MAX_ORIGIN_VOXELS:g} voxels of 0, got "
                f"{position} with voxels of {steps}"
            )
    return steps, position


def json_file(kind: str, path: str | Path) -> Any:
    """Returns the content of a user's JSON file; raises FileNotFoundError or ValueError."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"{kind} not found: {file}")
    if file.stat().st_size > _MAX_JSON_BYTES:
        raise ValueError(f"{file}: not a {kind}: it has more than {_MAX_JSON_BYTES} bytes")
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: not a JSON file: {one_line(error)}") from None


def real_array(value: Any) -> np.ndarray:
    """Returns numbers of any shape as an array, which may share their memory; TypeError or
    ValueError for text, complex numbers, masked ones and anything else.
    """
    array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    if array.dtype.kind not in "biuf" or np.ma.is_masked(value):
        raise TypeError
    return array


def reals(context: str, name: str, value: Any, shape: tuple[int, ...] | None = None) -> Tensor:
    """Returns a float64 CPU tensor, which is a copy; ValueError unless finite and of `shape`, if
    that is given.
    """
    no_gradient(context, name, value)
    if _is_complex(value):
        raise ValueError(f"{context}: {name} must be real numbers, got {quoted(value)}")
    try:
        numbers = torch.as_tensor(value, dtype=torch.float64, device="cpu").detach().cpu().clone()
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise ValueError(f"{context}: {name} must be numbers, got {quoted(value)}") from None
    if shape is not None and numbers.shape != shape:
        raise ValueError(f"{context}: {name} must be {shape} numbers, got {tuple(numbers.shape)}")
    if not bool(torch.isfinite(numbers).all()):
        got = "NaN or infinity" if hasattr(value, "dtype") else quoted(value)
        raise ValueError(f"{context}: {name} must be finite, got {got}")
    return numbers
