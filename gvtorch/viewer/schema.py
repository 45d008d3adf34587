"""Converts objects of Python and the command line to plain JSON and back, by their constructors'
type hints; and describes these hints to the page, which makes its controls from them.

So there is one list of options: a field of a dataclass or a shader is in the state file, in the
messages and in the page, and the object's own checks refuse wrong values. In JSON an object is
`{"kind": "Lit", ...}`, with the constructor's arguments by name; what JSON can't hold (a module, an
image) is `{"kept": "..."}`, which means the value that is there already.
"""

from __future__ import annotations

import functools
import inspect
import itertools
import math
import types
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import MISSING, fields, is_dataclass, replace
from enum import Enum
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from torch import Tensor

from ..base import check
from ..base.explicit import option_texts
from ..pictures import Gradient
from ..pictures.background import Background
from ..shaders import (
    ChannelLook,
    Channels,
    DirectionalLight,
    Headlight,
    Labels,
    PointLight,
    Shader,
    TransferFunction,
    built_in,
)
from ..tracing import Clip, Lighting, RenderOptions, ThinLens

MAX_ITEMS = 4096  # of a list
_MAX_NUMBERS = 4 * MAX_ITEMS  # of an array: a row of a transfer function has four
_MAX_DEPTH = 16  # of objects in objects

#: Classes that JSON may name, by name.
KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(TransferFunction, Channels, ChannelLook, Labels, Gradient, RenderOptions),
        *(Headlight, DirectionalLight, PointLight, Clip, Lighting, ThinLens),
        *(getattr(built_in, name) for name in built_in.__all__),
    )
}
#: Reads arguments of constructors that are stored under another name, or in another form.
_ARGUMENT_READERS: dict[tuple[str, str], Any] = {
    ("Features", "channel"): lambda shader: shader.other,
    ("Gradient", "top"): lambda gradient: gradient.ends[0],
    ("Gradient", "bottom"): lambda gradient: gradient.ends[1],
    ("Labels", "colors"): lambda labels: labels.linear_colors(),
    ("Channels", "looks"): lambda channels: [
        replace(look, color=look.function(n, len(channels.looks)).color[-1, 1:])
        if look.transfer is None
        else look
        for n, look in enumerate(channels.looks)
    ],
}
#: Arguments that no control changes: they belong to the scene, not to its look.
_SCENE_ARGUMENTS = {
    "RenderOptions": ("layer", "pose", "dtype", "backend", "channel", "component"),
    "Lit": ("in_the_way",),
    "DistanceField": ("value",),
    "Labels": ("normals",),
}
#: Range of a slider; the objects themselves check which values are allowed.
SLIDERS: dict[tuple[str, str], tuple[float, float]] = {
    ("RenderOptions", "step"): (0.1, 4),
    ("RenderOptions", "stop_alpha"): (0.5, 1),
    ("RenderOptions", "depth_alpha"): (0, 0.9),
    ("RenderOptions", "cone_scale"): (0.25, 8),
    ("Lit", "ambient"): (0, 2),
    ("Lit", "diffuse"): (0, 2),
    ("Lit", "specular"): (0, 2),
    ("Lit", "shininess"): (1, 200),
    ("Labels", "opacity"): (0, 1),
    ("ChannelLook", "opacity"): (0, 1),
    ("DirectionalLight", "angle"): (0, 60),
    ("Lighting", "shadows"): (0, 1),
    ("Lighting", "shadow_cones"): (1, 16),
    ("Lighting", "occlusion"): (0, 1),
    ("Lighting", "indirect"): (0, 2),
    ("Lighting", "cones"): (1, 64),
    ("Lighting", "reach"): (0.01, 1),
    ("ThinLens", "aperture"): (0, 0.3),
    ("ThinLens", "focus"): (0.1, 6),
    ("Clip", "cap_opacity"): (0.05, 1),
    ("Clip", "cap_light"): (0, 1),
    ("Eye", "fov"): (5, 120),
    ("ViewState", "blend"): (0, 1),
    ("Development", "exposure"): (-5, 5),
    ("Development", "samples"): (1, 64),
}


@functools.cache
def arguments(kind: Any) -> dict[str, tuple[Any, Any]]:
    """Returns type hint and default (`inspect.Parameter.empty`: none) of each argument that a
    constructor takes, including those that it passes on to its base class.
    """
    collected: dict[str, tuple[Any, Any]] = {}
    excluded = _SCENE_ARGUMENTS.get(kind.__name__, ())
    for base in kind.__mro__:
        if "__init__" not in vars(base) or base is object:
            continue
        hints = get_type_hints(base.__init__)
        passes_on = False
        for parameter in [*inspect.signature(base.__init__).parameters.values()][1:]:
            if parameter.kind is parameter.VAR_KEYWORD:
                passes_on = True
            elif parameter.name not in collected and parameter.name not in excluded:
                collected[parameter.name] = (hints.get(parameter.name, Any), parameter.default)
        if not passes_on:
            break
    return collected


def encode(value: Any) -> Any:
    """Returns an object as plain JSON; what JSON can't hold as `{"kept": ...}`."""
    if isinstance(value, Enum):
        value = value.value
    elif isinstance(value, (np.ndarray, np.generic, Tensor)):
        side, count = max(value.shape, default=0), math.prod(value.shape)
        is_small = side <= MAX_ITEMS and count <= _MAX_NUMBERS
        value = value.tolist() if is_small else _kept_marker(value)
    elif isinstance(value, Set):
        value = sorted(value)
    if isinstance(value, float):
        value = value if math.isfinite(value) else None
    elif isinstance(value, (Mapping, list, tuple, range)) and len(value) > MAX_ITEMS:
        value = _kept_marker(value)
    elif isinstance(value, Mapping):
        value = {str(name): encode(item) for name, item in value.items()}
    elif isinstance(value, (list, tuple, range)):
        value = [encode(item) for item in value]
    elif not (value is None or isinstance(value, (bool, int, str))):
        value = _encode_object(value)
    return value


def _encode_object(value: Any) -> dict[str, Any]:
    name = type(value).__name__
    if not (KINDS.get(name) is type(value) or is_dataclass(value)):
        return _kept_marker(value)
    kind: Any = type(value)
    values = {arg: _argument(value, arg) for arg in arguments(kind)}
    return {"kind": name, **{arg: encode(item) for arg, item in values.items()}}


def _argument(owner: Any, name: str) -> Any:
    for base in type(owner).__mro__:
        if reader := _ARGUMENT_READERS.get((base.__name__, name)):
            return reader(owner)
    return getattr(owner, name)


def _kept_marker(value: Any) -> dict[str, str]:
    return {"kept": repr(value)[:200]}


def decode(path: str, hint: Any, content: Any, current: Any = None, depth: int = 0) -> Any:
    """Makes an object of plain JSON by a type hint.

    Args:
        path: Of the content in the JSON, such as "state.options"; begins messages.
        hint: The type that it must have.
        content: What `json.loads` returned.
        current: The present value, for what the JSON leaves out or marks as kept.
        depth: Number of objects around this one.

    Raises:
        ValueError: The content is not of the type, or the object refuses it.
    """
    if depth > _MAX_DEPTH:
        raise ValueError(f"{path}: objects in objects in objects, more than {_MAX_DEPTH}")
    if isinstance(content, dict) and set(content) == {"kept"}:
        if current is not None:
            return current
        if hint is not Any:  # Any: JSON as it is
            kept = content["kept"]
            raise ValueError(f"{path}: JSON can't represent what was here: {kept!r:.200}")
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    named = content.get("kind") if isinstance(content, dict) else None
    problems = []
    for choice in sorted(choices, key=lambda choice: getattr(choice, "__name__", "") != named):
        try:
            return _decode_type(path, choice, content, current, depth)
        except _WrongType as error:
            problems.append(str(error))
    expected = " or ".join(dict.fromkeys(problems))
    raise ValueError(f"{path}: must be {expected}, got {check.quoted(content)}")


class _WrongType(Exception):
    """The content is of another type."""


def _decode_type(path: str, hint: Any, content: Any, current: Any, depth: int) -> Any:
    origin = get_origin(hint)
    is_class = isinstance(hint, type) and origin is None and hint is not Any
    if origin in (list, tuple, Sequence, Iterable):
        decoded = _decode_sequence(path, hint, content, current, depth)
    elif origin in (dict, Mapping):
        decoded = _decode_mapping(path, hint, content, depth)
    elif is_class and issubclass(hint, Enum):
        decoded = hint(_checked_simple(Literal[tuple(member.value for member in hint)], content))
    elif is_class and hint not in (float, *_TYPE_NAMES, type(None), Tensor, np.ndarray):
        decoded = _decode_object(path, hint, content, current, depth)
    else:
        decoded = _checked_simple(hint, content)
    return decoded


def _checked_simple(hint: Any, content: Any) -> Any:
    """Checks and returns a value that is no list and no object, or (Any) JSON as it is."""
    if hint is float:
        return _decode_number(content)
    hint = Literal[None] if hint in (None, type(None)) else hint
    if hint in _TYPE_NAMES:
        if type(content) is not hint:
            raise _WrongType(_TYPE_NAMES[hint])
    elif get_origin(hint) is Literal:
        choices = get_args(hint)
        if not any(type(content) is type(choice) and content == choice for choice in choices):
            names = ("null" if choice is None else repr(choice) for choice in choices)
            raise _WrongType(" or ".join(names))
    elif hint is not Any:
        raise _WrongType("something else")
    return content


def _decode_number(content: Any) -> float:
    if isinstance(content, bool) or not isinstance(content, (int, float)):
        raise _WrongType("a number")
    try:
        number = float(content)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):  # as of 1e999
        raise _WrongType("a finite number")
    return number


_TYPE_NAMES: dict[type, str] = {int: "a whole number", bool: "true or false", str: "a text"}


def _decode_sequence(path: str, hint: Any, content: Any, current: Any, depth: int) -> Any:
    if not isinstance(content, list):
        raise _WrongType("a list")
    if len(content) > MAX_ITEMS:
        raise ValueError(f"{path}: {len(content)} items, more than {MAX_ITEMS}")
    item_hints = get_args(hint)
    fixed = get_origin(hint) is tuple and item_hints[1:] != (...,)
    if fixed and len(item_hints) != len(content):
        raise _WrongType(f"{len(item_hints)} items")
    if not fixed:
        item_hints = (item_hints[0] if item_hints else Any,) * len(content)
    is_same_size = isinstance(current, (list, tuple)) and len(current) == len(content)
    old_items = current if is_same_size else [None] * len(content)
    rows = zip(item_hints, content, old_items, strict=True)
    items = [
        decode(f"{path}[{i}]", item_hint, item, old_item, depth + 1)
        for i, (item_hint, item, old_item) in enumerate(rows)
    ]
    return tuple(items) if get_origin(hint) is tuple else items


def _decode_mapping(path: str, hint: Any, content: Any, depth: int) -> Any:
    if not isinstance(content, dict) or len(content) > MAX_ITEMS:
        raise _WrongType("an object by name")
    key_type, value_hint = get_args(hint)
    decoded = {}
    for name, item in content.items():
        try:
            key = key_type(name)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        decoded[key] = decode(f"{path}.{name}", value_hint, item, None, depth + 1)
    return decoded


def _decode_object(path: str, hint: type, content: Any, current: Any, depth: int) -> Any:
    if not isinstance(content, dict):
        raise _WrongType(f"a {hint.__name__}")
    name = content.get("kind", (hint if current is None else type(current)).__name__)
    kind: Any = KINDS.get(name) if isinstance(name, str) else None
    if kind is None and name == hint.__name__ and is_dataclass(hint):
        kind = hint
    if kind is None or not issubclass(kind, hint):
        raise _WrongType(f"a {hint.__name__}")
    hints = arguments(kind)
    unknown = sorted(str(field) for field in set(content) - set(hints) - {"kind"})
    if unknown:
        raise ValueError(f"{path}: {kind.__name__} has no {unknown[0]!r:.80}")
    current = current if type(current) is kind else None
    values: dict[str, Any] = {}
    for arg, (arg_hint, default) in hints.items():
        old_value = None if current is None else _argument(current, arg)
        if arg in content:
            values[arg] = decode(f"{path}.{arg}", arg_hint, content[arg], old_value, depth + 1)
        elif current is not None:
            values[arg] = old_value
        elif default is inspect.Parameter.empty:
            raise ValueError(f"{path}: {kind.__name__} needs {arg!r}")
    if current is not None:
        parameters = inspect.signature(kind).parameters
        excluded = _SCENE_ARGUMENTS.get(kind.__name__, ())
        values |= {arg: getattr(current, arg) for arg in excluded if arg in parameters}
    try:
        return kind(**values)
    except (TypeError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from None


def control_for(hint: Any, owner: str = "", name: str = "") -> dict[str, Any]:
    """Returns the description from which the page makes the control of a type hint: its `type`, and
    depending on it `choices`, `items`, the `kind` of an object, or the `range` of a slider;
    `optional` if None is allowed. What has no control is of type "kept".
    """
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    descriptions = (_describe_hint(choice, owner, name) for choice in choices)
    controls = [description for description in descriptions if description is not None]
    optional = any(choice in (None, type(None)) for choice in choices)
    if not controls:
        return {"type": "kept"}
    if controls[0]["type"] == "choice":
        controls = controls[:1]  # a name that may also be given as text
    combined = dict(controls[0])
    if len(controls) > 1:
        parts = [
            control.get("choices", ()) if control["type"] == "one of" else (control,)
            for control in controls
        ]
        combined = {"type": "one of", "choices": [*itertools.chain.from_iterable(parts)]}
    return combined | ({"optional": True} if optional else {})


def _describe_hint(hint: Any, owner: str, name: str) -> dict[str, Any] | None:
    origin, inner = get_origin(hint), get_args(hint)
    is_class = isinstance(hint, type) and origin is None and hint is not Any
    is_three = origin is tuple and inner == (float,) * 3
    if origin is Literal:
        description: dict[str, Any] | None = {"type": "choice", "choices": list(inner)}
    elif hint in (bool, int, float, str):
        description = {"type": {bool: "flag", int: "whole", float: "number", str: "text"}[hint]}
        slider_range = _slider_range(owner, name) if hint in (int, float) else None
        description |= {} if slider_range is None else {"range": slider_range}
    elif is_three or (hint == Sequence[float] and name in _TRIPLE_FIELDS):
        description = {"type": "color" if name in _COLOR_FIELDS else "triple"}
    elif origin is tuple and inner == (float, float):
        description = {"type": "pair"}
    elif origin in (list, tuple, Sequence) and inner:
        description = {"type": "list", "items": control_for(inner[0])}
    else:
        description = _describe_class(hint) if is_class else None
    return description


def _describe_class(hint: type) -> dict[str, Any] | None:
    if issubclass(hint, Enum):
        return {"type": "choice", "choices": [member.value for member in hint]}
    if hint in (Shader, Background):
        names = (name for name, kind in KINDS.items() if issubclass(kind, hint))
        objects = [{"type": "object", "kind": name} for name in names]
        return objects[0] if len(objects) == 1 else {"type": "one of", "choices": objects}
    if hint in KINDS.values() or is_dataclass(hint):
        return {"type": "object", "kind": hint.__name__}
    return None


_COLOR_FIELDS = ("top", "bottom", "background", "ambient", "color")
_TRIPLE_FIELDS = (*_COLOR_FIELDS, "direction", "position")


def _slider_range(owner: str, name: str) -> tuple[float, float] | None:
    kind = KINDS.get(owner)
    names = [base.__name__ for base in kind.__mro__] if kind is not None else [owner]
    if kind is not None and issubclass(kind, Shader):
        names.append("Lit")
    ranges = (SLIDERS.get((class_name, name)) for class_name in names)
    return next(filter(None, ranges), None)


def describe_kind(kind: type) -> dict[str, Any]:
    """Returns a class's text, and for each of its fields the description, default and text."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        texts |= option_texts(base)
    declared = {field.name: field for field in fields(kind)} if is_dataclass(kind) else {}
    controls = {}
    for name, (hint, default) in arguments(kind).items():
        control = control_for(hint, kind.__name__, name)
        if default is not inspect.Parameter.empty and default is not None:
            factory = getattr(declared.get(name), "default_factory", MISSING)
            control["default"] = encode(default if factory is MISSING else factory())
        if name in declared and "range" in declared[name].metadata:
            control["range"] = declared[name].metadata["range"]
        controls[name] = control | ({"text": texts[name]} if name in texts else {})
    return {"fields": controls, "text": (inspect.getdoc(kind) or "").partition("\n")[0]}
