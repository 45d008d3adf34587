"""The flag `--lighting`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .common import numbers

if TYPE_CHECKING:
    from ..tracing import Lighting

_FACTORS = ("shadows", "occlusion", "indirect", "reach")


def parse_lighting(text: str) -> Lighting:
    """Makes light from items such as `sun:-1,-2,-1,4;occlusion:0.8;reach:0.1`.

    Raises:
        ValueError: An item is of no known kind, or its numbers are refused by `Lighting`.
    """
    from ..shaders import DirectionalLight, PointLight
    from ..tracing import Lighting

    lights: list[Any] = []
    given: dict[str, Any] = {}
    for item in text.split(";"):
        kind, _, rest = item.strip().partition(":")
        flag = f"--lighting {kind}"
        if kind in ("sun", "lamp"):
            *place, size = numbers(flag, rest, 4, float)
            sun = kind == "sun"
            lights.append(
                DirectionalLight(place, angle=size) if sun else PointLight(place, radius=size)
            )
        elif kind == "sky":
            given["ambient"] = numbers(flag, rest, 3, float)
        elif kind in _FACTORS:
            (given[kind],) = numbers(flag, rest, 1, float)
        else:
            raise ValueError(
                f"--lighting must hold sun:, lamp:, sky:, {':, '.join(_FACTORS)}:, "
                f"got {item.strip()!r}"
            )
    return Lighting(lights=lights or None, frame="box", **given)
