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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from torch import Tensor

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

MOST_ITEMS = 4096  # of a list
_MOST_NUMBERS = 4 * MOST_ITEMS  # of an array: a row of a transfer function has four
MOST_DEPTH = 16  # of objects in objects

#: Classes that JSON may name, by name.
KINDS: dict[str, type] = {
    one.__name__: one
    for one in (
        *(TransferFunction, Channels, ChannelLook, Labels, Gradient, RenderOptions),
        *(Headlight, DirectionalLight, PointLight, Clip, Lighting, ThinLens),
        *(getattr(built_in, name) for name in built_in.__all__),
    )
}
#: Reads arguments of constructors that are stored under another name, or in another form.
_KEPT_AS: dict[tuple[str, str], Any] = {
    ("Isosurface", "color_channel"): lambda one: one.other,
    ("Isosurface", "color_component"): lambda one: one.other_component,
    ("DistanceField", "offset"): lambda one: one.value,
    ("Features", "channel"): lambda one: one.other,
    ("Gradient", "top"): lambda one: one.ends[0],
    ("Gradient", "bottom"): lambda one: one.ends[1],
}
#: Arguments that no control changes: they belong to the scene, not to its look.
_OF_THE_SCENE = {
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
    found: dict[str, tuple[Any, Any]] = {}
    left_out = _OF_THE_SCENE.get(kind.__name__, ())
    for base in kind.__mro__:
        if "__init__" not in vars(base) or base is object:
            continue
        hints = get_type_hints(base.__init__)
        hands_on = False
        for one in [*inspect.signature(base.__init__).parameters.values()][1:]:
            if one.kind is one.VAR_KEYWORD:
                hands_on = True
            elif one.name not in found and one.name not in left_out:
                found[one.name] = (hints.get(one.name, Any), one.default)
        if not hands_on:
            break
    return found


def encode(value: Any) -> Any:
    """Returns an object as plain JSON; what JSON can't hold as `{"kept": ...}`."""
    if isinstance(value, Enum):
        value = value.value
    elif isinstance(value, (np.ndarray, np.generic, Tensor)):
        small = (
            max(value.shape, default=0) <= MOST_ITEMS and math.prod(value.shape) <= _MOST_NUMBERS
        )
        value = value.tolist() if small else _kept(value)
    if isinstance(value, float):
        value = value if math.isfinite(value) else None
    elif isinstance(value, Mapping):
        value = {str(name): encode(one) for name, one in value.items()}
    elif isinstance(value, (list, tuple, range)):
        value = [encode(one) for one in value]
    elif not (value is None or isinstance(value, (bool, int, str))):
        value = _encoded_object(value)
    return value


def _encoded_object(value: Any) -> dict[str, Any]:
    name = type(value).__name__
    if not (KINDS.get(name) is type(value) or is_dataclass(value)):
        return _kept(value)
    kind: Any = type(value)
    known = {arg: _argument(value, arg) for arg in arguments(kind)}
    return {"kind": name, **{arg: encode(one) for arg, one in known.items()}}


def _argument(owner: Any, name: str) -> Any:
    read = next(
        (_KEPT_AS[c.__name__, name] for c in type(owner).__mro__ if (c.__name__, name) in _KEPT_AS),
        None,
    )
    return getattr(owner, name) if read is None else read(owner)


def _kept(value: Any) -> dict[str, str]:
    return {"kept": repr(value)[:200]}


def decode(where: str, hint: Any, content: Any, now: Any = None, depth: int = 0) -> Any:
    """Makes an object of plain JSON by a type hint.

    Args:
        where: Begins messages.
        hint: The type that it must have.
        content: What `json.loads` returned.
        now: The present value, for what the JSON leaves out or marks as kept.
        depth: Number of objects around this one.

    Raises:
        ValueError: The content is not of the type, or the object refuses it.
    """
    if depth > MOST_DEPTH:
        raise ValueError(f"{where}: objects in objects in objects, more than {MOST_DEPTH}")
    if isinstance(content, dict) and set(content) == {"kept"}:
        if now is not None:
            return now
        if hint is not Any:  # Any: JSON as it is
            raise ValueError(
                f"{where}: JSON can't represent what was here: {content['kept']!r:.200}"
            )
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    problems = []
    for choice in sorted(choices, key=lambda one: not _fits(one, content)):
        try:
            return _decoded(where, choice, content, now, depth)
        except _Other as other:
            problems.append(str(other))
    wanted = " or ".join(dict.fromkeys(problems))
    raise ValueError(f"{where}: must be {wanted}, got {_brief(content)}")


class _Other(Exception):
    """The content is of another type."""


def _brief(content: Any) -> str:
    text = repr(content)
    return text if len(text) < 80 else text[:77] + "..."


def _fits(hint: Any, content: Any) -> bool:
    """Returns whether a class is the one that the content names."""
    return isinstance(content, dict) and getattr(hint, "__name__", "") == content.get("kind")


def _decoded(where: str, hint: Any, content: Any, now: Any, depth: int) -> Any:
    origin = get_origin(hint)
    is_class = isinstance(hint, type) and origin is None and hint is not Any
    if origin in (list, tuple, Sequence, Iterable):
        made = _sequence(where, hint, content, now, depth)
    elif origin in (dict, Mapping):
        made = _mapping(where, hint, content, depth)
    elif is_class and hint not in (float, *_WORDS, type(None), Tensor, np.ndarray):
        whole = issubclass(hint, Enum)
        made = _named(hint, content) if whole else _object(where, hint, content, now, depth)
    else:
        made = _simple(hint, content)
    return made


def _simple(hint: Any, content: Any) -> Any:
    """Checks and returns a value that is no list and no object, or (Any) JSON as it is."""
    if hint is float:
        return _number(content)
    hint = Literal[None] if hint in (None, type(None)) else hint
    if hint in _WORDS:
        if type(content) is not hint:
            raise _Other(_WORDS[hint])
    elif get_origin(hint) is Literal:
        known = get_args(hint)
        if not any(content is one or (type(content) is str and content == one) for one in known):
            raise _Other(" or ".join("null" if one is None else repr(one) for one in known))
    elif hint is not Any:
        raise _Other("something else")
    return content


def _named(hint: type[Enum], content: Any) -> Enum:
    names = [one.value for one in hint]
    if not isinstance(content, str) or content not in names:
        raise _Other(" or ".join(map(repr, names)))
    return hint(content)


def _number(content: Any) -> float:
    if isinstance(content, bool) or not isinstance(content, (int, float)):
        raise _Other("a number")
    try:
        number = float(content)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):  # as of 1e999
        raise _Other("a finite number")
    return number


_WORDS: dict[type, str] = {int: "a whole number", bool: "true or false", str: "a text"}


def _sequence(where: str, hint: Any, content: Any, now: Any, depth: int) -> Any:
    if not isinstance(content, list):
        raise _Other("a list")
    if len(content) > MOST_ITEMS:
        raise ValueError(f"{where}: {len(content)} items, more than {MOST_ITEMS}")
    inner = get_args(hint)
    fixed = get_origin(hint) is tuple and inner[1:] != (...,)
    if fixed and len(inner) != len(content):
        raise _Other(f"{len(inner)} items")
    before = now if isinstance(now, (list, tuple)) and len(now) == len(content) else None
    items = [
        decode(
            f"{where}[{i}]",
            inner[i] if fixed else (inner[0] if inner else Any),
            one,
            None if before is None else before[i],
            depth + 1,
        )
        for i, one in enumerate(content)
    ]
    return tuple(items) if get_origin(hint) is tuple else items


def _mapping(where: str, hint: Any, content: Any, depth: int) -> Any:
    if not isinstance(content, dict) or len(content) > MOST_ITEMS:
        raise _Other("an object by name")
    key, value = get_args(hint)
    made = {}
    for name, one in content.items():
        try:
            made[key(name)] = decode(f"{where}.{name}", value, one, None, depth + 1)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{where}: {error}") from None
    return made


def _object(where: str, hint: type, content: Any, now: Any, depth: int) -> Any:
    if not isinstance(content, dict):
        raise _Other(f"a {hint.__name__}")
    name = content.get("kind", hint.__name__)
    kind: Any = KINDS.get(name) if isinstance(name, str) else None
    if kind is None and name == hint.__name__ and is_dataclass(hint):
        kind = hint
    if kind is None or not issubclass(kind, hint):
        raise _Other(f"a {hint.__name__}")
    known = arguments(kind)
    unknown = sorted(str(one) for one in set(content) - set(known) - {"kind"})
    if unknown:
        raise ValueError(f"{where}: {kind.__name__} has no {unknown[0]!r:.80}")
    now = now if type(now) is kind else None
    given: dict[str, Any] = {}
    for arg, (inner, default) in known.items():
        before = None if now is None else _argument(now, arg)
        if arg in content:
            given[arg] = decode(f"{where}.{arg}", inner, content[arg], before, depth + 1)
        elif now is not None:
            given[arg] = before
        elif default is inspect.Parameter.empty:
            raise ValueError(f"{where}: {kind.__name__} needs {arg!r}")
    if now is not None:
        own = inspect.signature(kind).parameters
        left_out = _OF_THE_SCENE.get(kind.__name__, ())
        given |= {arg: getattr(now, arg) for arg in left_out if arg in own}
    try:
        return kind(**given)
    except (TypeError, OverflowError, RuntimeError) as error:
        raise ValueError(f"{where}: {error}") from None


def control_for(hint: Any, owner: str = "", name: str = "") -> dict[str, Any]:
    """Returns the description from which the page makes the control of a type hint: its `type`, and
    depending on it `choices`, `items`, the `kind` of an object, or the `range` of a slider;
    `optional` if None is allowed. What has no control is of type "kept".
    """
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    told = [found for one in choices if (found := _described(one, owner, name)) is not None]
    optional = any(one in (None, type(None)) for one in choices)
    if not told:
        return {"type": "kept"}
    if told[0]["type"] == "choice":
        told = told[:1]  # a name that may also be given as text
    answer = dict(told[0])
    if len(told) > 1:
        parts = [one.get("choices", ()) if one["type"] == "one of" else (one,) for one in told]
        answer = {"type": "one of", "choices": [*itertools.chain.from_iterable(parts)]}
    return answer | ({"optional": True} if optional else {})


def _described(hint: Any, owner: str, name: str) -> dict[str, Any] | None:
    origin, inner = get_origin(hint), get_args(hint)
    is_class = isinstance(hint, type) and origin is None and hint is not Any
    is_three = origin is tuple and inner == (float,) * 3
    if origin is Literal:
        told: dict[str, Any] | None = {"type": "choice", "choices": list(inner)}
    elif hint in (bool, int, float, str):
        told = {"type": {bool: "flag", int: "whole", float: "number", str: "text"}[hint]}
        span = _slider(owner, name) if hint in (int, float) else None
        told |= {} if span is None else {"range": span}
    elif is_three or (hint == Sequence[float] and name in _THREE):
        told = {"type": "color" if name in _COLORS else "triple"}
    elif origin is tuple and inner == (float, float):
        told = {"type": "pair"}
    elif origin in (list, tuple, Sequence) and inner:
        told = {"type": "list", "items": control_for(inner[0])}
    else:
        told = _described_class(hint) if is_class else None
    return told


def _described_class(hint: type) -> dict[str, Any] | None:
    if issubclass(hint, Enum):
        return {"type": "choice", "choices": [one.value for one in hint]}
    if hint in (Shader, Background):
        named = [
            {"type": "object", "kind": name} for name, one in KINDS.items() if issubclass(one, hint)
        ]
        return named[0] if len(named) == 1 else {"type": "one of", "choices": named}
    if hint in KINDS.values() or is_dataclass(hint):
        return {"type": "object", "kind": hint.__name__}
    return None


_COLORS = ("top", "bottom", "background", "ambient", "color")
_THREE = (*_COLORS, "direction", "position")


def _slider(owner: str, name: str) -> tuple[float, float] | None:
    kind = KINDS.get(owner)
    names = [c.__name__ for c in kind.__mro__] if kind is not None else [owner]
    if kind is not None and issubclass(kind, Shader):
        names.append("Lit")
    return next((SLIDERS[one, name] for one in names if (one, name) in SLIDERS), None)


def describe_kind(kind: type) -> dict[str, Any]:
    """Returns a class's text, and for each of its fields the description, default and text."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        texts |= option_texts(base)
    declared = {one.name: one for one in fields(kind)} if is_dataclass(kind) else {}
    told = {}
    for name, (hint, default) in arguments(kind).items():
        one = control_for(hint, kind.__name__, name)
        if default is not inspect.Parameter.empty and default is not None:
            made = getattr(declared.get(name), "default_factory", MISSING)
            one["default"] = encode(default if made is MISSING else made())
        if name in declared and "range" in declared[name].metadata:
            one["range"] = declared[name].metadata["range"]
        told[name] = one | ({"text": texts[name]} if name in texts else {})
    return {"fields": told, "text": (inspect.getdoc(kind) or "").partition("\n")[0]}
