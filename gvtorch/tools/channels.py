"""`--channel`: which channels are shown, and how."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..base.digits import whole_number
from .common import numbers

if TYPE_CHECKING:
    from ..base.volume import Volume
    from ..io.stores.store import Store
    from ..shaders import Channels


def parse_channels(text: str | None, image: Volume | Store) -> Channels:
    """Makes a shader of an image's channels: all of them as it tells, or those of items such as
    `0:green:100,4000;2:#ff00ff:auto;3`, which replace what it tells.

    Raises:
        ValueError: An item is none, or of a channel that is not there.
    """
    from ..shaders import Channels
    from ..shaders.channels import channel_color, window_of

    if text is None:
        return Channels.of(image)
    items = [item.strip() for item in text.split(";")]
    names = {one.name: str(number) for number, one in enumerate(image.info.channels) if one.name}
    wanted: dict[int, list[str]] = {}
    for item in items:
        name, *rest = item.split(":")
        number = whole_number(names.get(name, name))
        if item == "opacity":
            continue
        if number is None or len(rest) > 2:
            raise ValueError(
                "--channel must hold NUMBER:COLOR:LO,HI, or a name for the number, where what is "
                f"left out or auto is the image's, or opacity; got {item!r}"
            )
        if number in wanted:
            raise ValueError(f"--channel names channel {number} twice")
        wanted[number] = rest
    if not wanted:
        raise ValueError("--channel opacity: name channels, too, as in 0;1;opacity")
    mode: Any = "opacity" if "opacity" in items else "additive"
    shader = Channels.of(image, mode, components=list(wanted))
    for look, (component, told) in zip(shader.looks, wanted.items(), strict=True):
        color, window = (*told, "auto", "auto")[:2]
        where = f"--channel {component}"
        if color not in ("", "auto"):
            look.color = channel_color(where, color)
        if window not in ("", "auto"):
            low, high = numbers(f"{where}: window", window, 2, float)
            look.window = window_of(where, (low, high))
    return shader
