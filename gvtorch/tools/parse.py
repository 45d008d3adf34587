"""Parsers of flags: colours, windows, channels, lights, clips, backgrounds. All raise ValueError,
which names the flag, for a text that they do not accept.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..base.digits import whole_number
from .common import parse_numbers

if TYPE_CHECKING:
    from ..base.volume import Volume
    from ..io.stores.store import Store
    from ..shaders import Channels, TransferFunction
    from ..tracing import Clip, Lighting, ThinLens

_TRANSFER_SUFFIXES = (".json", ".vp", ".xml")  # of files of transfer functions
_LIGHTING_FACTORS = ("shadows", "occlusion", "indirect", "reach")


def parse_transfer(
    name: str | None,
    window_text: str | None,
    data: Volume | Store,
    component: int,
    *,
    background: bool = False,
) -> TransferFunction:
    """Returns the transfer function that `--tf` names, stretched over the values of `--window`.
    Without a window, files with absolute values and presets in Hounsfield units keep their values,
    others are stretched over what `window` finds (see there for `background`). For data in
    Hounsfield units, `bone` and others mean the presets in these units.
    """
    from ..shaders import TransferFunction
    from ..shaders.presets import CT_PRESETS, IN_HU

    data.info.check_component("--component", component, data.width)
    name = "gray" if name is None else name
    file, _, preset = name.rpartition(":")
    if Path(name).is_file() or name.endswith(_TRANSFER_SUFFIXES):
        transfer = TransferFunction.from_file(name)
    elif file and (Path(file).is_file() or file.endswith(_TRANSFER_SUFFIXES)):
        transfer = TransferFunction.from_file(file, preset)
    elif name in CT_PRESETS:
        transfer = TransferFunction.preset(name)
    elif window_text in (None, "auto") and name in IN_HU and data.info.quantity == "HU":
        return TransferFunction.preset(IN_HU[name])
    else:
        transfer = TransferFunction.preset(name, 0, 1)
        transfer.relative = True
    if window_text is None and not transfer.relative:
        return transfer
    text = "auto" if window_text is None else window_text
    values = parse_window(text, data, component, background=background)
    return transfer.stretched(*values)


def parse_window(
    text: str, data: Volume | Store, component: int, *, background: bool = False
) -> tuple[float, float]:
    """Returns the values of LO,HI, P%,P%, `auto` or `full`; for `background` see `window`."""
    from ..io.window import value_range, window

    data.info.check_component("--component", component, data.width)
    if text == "auto":
        return window(data, component=component, background=background)
    if text == "full":
        return value_range(data)
    try:
        low, high = parse_numbers("--window", text.replace("%", ""), 2, float)
    except ValueError:
        expected = "--window must be LO,HI, P%,P%, auto or full"
        raise ValueError(f"{expected}, got {text!r}") from None
    if text.count("%") == 2 and all(part.endswith("%") for part in text.split(",")):
        return window(data, (low, high), component=component)
    if "%" in text or not low < high:
        raise ValueError(f"--window must be LO,HI with LO < HI, or P%,P%, got {text!r}")
    return low, high


def parse_channels(text: str | None, image: Volume | Store) -> Channels:
    """Makes a shader of an image's channels: all of them with the image's colours and windows, or
    those of items such as `0:green:100,4000;2:#ff00ff:auto;3`, which override these.
    """
    from ..shaders import Channels
    from ..shaders.channels import channel_color, window_of

    if text is None:
        return Channels.of(image)
    items = [item.strip() for item in text.split(";")]
    number_of = {c.name: str(number) for number, c in enumerate(image.info.channels) if c.name}
    known = f"; the channels are {', '.join(number_of)}" if number_of else ""
    settings_by_number: dict[int, list[str]] = {}
    for item in items:
        name, *settings = item.split(":")
        number = whole_number(number_of.get(name, name))
        if item == "opacity":
            continue
        if number is None or len(settings) > 2:
            raise ValueError(
                "--channel must hold NUMBER:COLOR:LO,HI, or a name for the number, where what is "
                f"left out or auto is the image's, or opacity; got {item!r}{known}"
            )
        if number in settings_by_number:
            raise ValueError(f"--channel names channel {number} twice")
        settings_by_number[number] = settings
    if not settings_by_number:
        raise ValueError("--channel opacity: name channels, too, as in 0;1;opacity")
    mode: Any = "opacity" if "opacity" in items else "additive"
    shader = Channels.of(image, mode, components=list(settings_by_number))
    for look, (component, settings) in zip(shader.looks, settings_by_number.items(), strict=True):
        color, window = (*settings, "auto", "auto")[:2]
        context = f"--channel {component}"
        if color not in ("", "auto"):
            look.color = channel_color(context, color)
        if window not in ("", "auto"):
            low, high = parse_numbers(f"{context}: window", window, 2, float)
            look.window = window_of(context, (low, high))
    return shader


def parse_lighting(text: str) -> Lighting:
    """Makes lighting from items such as `sun:-1,-2,-1,4;occlusion:0.8;reach:0.1`."""
    from ..shaders import DirectionalLight, PointLight
    from ..tracing import Lighting

    lights: list[Any] = []
    options: dict[str, Any] = {}
    for item in text.split(";"):
        kind, _, rest = item.strip().partition(":")
        flag = f"--lighting {kind}"
        if kind in ("sun", "lamp"):
            *vector, size = parse_numbers(flag, rest, 4, float)
            sun = kind == "sun"
            light = DirectionalLight(vector, angle=size) if sun else PointLight(vector, radius=size)
            lights.append(light)
        elif kind == "sky":
            options["ambient"] = parse_numbers(flag, rest, 3, float)
        elif kind in _LIGHTING_FACTORS:
            (options[kind],) = parse_numbers(flag, rest, 1, float)
        else:
            raise ValueError(
                f"--lighting must hold sun:, lamp:, sky:, {':, '.join(_LIGHTING_FACTORS)}:, "
                f"got {item.strip()!r}"
            )
    return Lighting(lights=lights or None, frame="box", **options)


def parse_clip(text: str) -> Clip:
    """Makes a clip from items such as `plane:0,0,1,0;cut:0,0,0,1,1,1;caps`."""
    from ..tracing import Clip

    shapes: dict[str, list[Any]] = {"plane": [], "box": [], "cut": []}
    caps = False
    for item in text.split(";"):
        kind, _, rest = item.strip().partition(":")
        if kind == "caps" and not rest:
            caps = True
        elif kind in shapes:
            values = parse_numbers(f"--clip {kind}", rest, 4 if kind == "plane" else 6, float)
            shapes[kind].append(values if kind == "plane" else (values[:3], values[3:]))
        else:
            raise ValueError(f"--clip must hold plane:, box:, cut: or caps, got {item.strip()!r}")
    planes, boxes, cuts = shapes.values()
    return Clip(planes=planes, boxes=boxes, without=cuts, frame="box", caps=caps)


def parse_lens(text: str) -> ThinLens:
    """Makes a lens from `APERTURE,FOCUS`."""
    from ..tracing import ThinLens

    aperture, focus = parse_numbers("--lens", text, 2, float)
    return ThinLens(aperture=aperture, focus=focus, frame="box")


def parse_background(text: str) -> Any:
    """Returns a background from R,G,B, two of them (top/bottom), `transparent`, or the file of an
    environment map.
    """
    from ..pictures import Environment, Gradient

    if text == "transparent":
        return None
    if Path(text).suffix[1:].isalpha():
        return Environment.read(text)
    parts = text.split("/", 1)
    colors = [tuple(parse_numbers("--background", part, 3, float)) for part in parts]
    return Gradient(*colors) if len(colors) == 2 else colors[0]
