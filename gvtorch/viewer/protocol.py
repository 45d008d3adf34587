"""The messages between a view and its pages, as records. `schema` decodes those of a page, so a
wrong one is refused with a line that says what was expected.

A page gets texts, JSON objects with a `type`, and bytes: the length of a JSON head (4 bytes, little
endian), the head, then a JPEG, or a file that the head names. A page answers each picture with its
number (`Ack`); until then no other picture is sent to it.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any, Literal

from ..base import check
from .schema import decode
from .state import Eye

MAX_MESSAGE_BYTES = 1 << 20  # largest message from a page
_MIN_SIDE = 16  # pixels


@dataclass(frozen=True, kw_only=True)
class Hello:
    """The size of the picture: the first message, and sent again after each change of size."""

    width: int
    height: int
    rate: float = 25.0  # pictures a second that are wanted while something moves

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            check.integer("hello", name, getattr(self, name), low=_MIN_SIDE, high=8192)
        check.number("hello", "rate", self.rate, low=1, high=240)


@dataclass(frozen=True, kw_only=True)
class Move:
    """The camera, and whether it goes on moving."""

    camera: Eye
    moving: bool = False
    sent: float = 0.0  # the page's clock; comes back with the picture


@dataclass(frozen=True, kw_only=True)
class Ack:
    """The picture of this number was drawn."""

    number: int

    def __post_init__(self) -> None:
        check.integer("ack", "number", self.number, low=0, high=2**53)


@dataclass(frozen=True, kw_only=True)
class Change:
    """New values for part of the state, as `ViewState.changed` takes them."""

    state: dict[str, Any]
    rest: bool = True  # false while a slider is dragged


@dataclass(frozen=True, kw_only=True)
class Pick:
    """Asks for the world position seen at a point of the picture, 0 to 1 from its upper left."""

    x: float
    y: float
    purpose: str = ""  # comes back with the answer

    def __post_init__(self) -> None:
        check.number("pick", "x", self.x, low=0, high=1)
        check.number("pick", "y", self.y, low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class Histogram:
    """Asks for a histogram of the values."""

    in_view: bool = False


@dataclass(frozen=True, kw_only=True)
class Find:
    """Asks for the labels whose number contains a text."""

    text: str


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Asks for a named transfer function over a window; those in Hounsfield units ignore it."""

    name: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, kw_only=True)
class Read:
    """Sends the text of a file of transfer functions, of gvtorch or another program."""

    file: str
    text: str
    name: str | None = None  # which function, if the file has several
    low: float | None = None  # a function of relative values is stretched over low to high
    high: float | None = None


@dataclass(frozen=True, kw_only=True)
class Export:
    """Asks for the transfer function as ParaView's JSON."""

    name: str = "gvtorch"  # by which ParaView lists it


@dataclass(frozen=True, kw_only=True)
class Nodes:
    """Starts or stops the boxes of the tree's nodes that come with each picture."""

    on: bool = True


@dataclass(frozen=True, kw_only=True)
class Resize:
    """Recreates the engine with other memory and budgets."""

    engine: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Set:
    """Sets a parameter of the producer."""

    name: str
    value: Any


@dataclass(frozen=True, kw_only=True)
class Follow:
    """Follows another client's camera, or None."""

    client: int | None = None


@dataclass(frozen=True, kw_only=True)
class Monitor:
    """Starts or stops the figures of frames."""

    on: bool = True


@dataclass(frozen=True, kw_only=True)
class Still:
    """Asks for a picture of any size as a PNG."""

    width: int
    height: int

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            check.integer("still", name, getattr(self, name), low=_MIN_SIDE, high=16384)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Asks for the surface around values, or around a label, as a file of triangles."""

    value: float
    format: Literal["ply", "glb"] = "glb"
    level: int = 0  # of detail; 0 is the finest

    def __post_init__(self) -> None:
        check.number("surface", "value", self.value)
        check.integer("surface", "level", self.level, low=0)


@dataclass(frozen=True, kw_only=True)
class Do:
    """A command without arguments: show the whole box, or request again what failed."""

    what: Literal["fit", "retry"]


Message = (
    Hello | Move | Ack | Change | Pick | Histogram | Find | Preset | Read | Export | Nodes | Resize
    | Set | Follow | Monitor | Still | Surface | Do
)  # fmt: skip
MESSAGES: dict[str, type[Any]] = {message.__name__.lower(): message for message in Message.__args__}


def parse(text: str | bytes) -> Any:
    """Returns the message that a page sent.

    Raises:
        ValueError: The text is no message, or a value is out of its range.
    """
    if len(text) > MAX_MESSAGE_BYTES:
        raise ValueError(f"message: {len(text)} bytes, more than {MAX_MESSAGE_BYTES}")
    try:
        content = json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"message: not JSON: {error}") from None
    if not isinstance(content, dict):
        raise ValueError("message: must be an object with a type")
    kind = MESSAGES.get(content["type"]) if isinstance(content.get("type"), str) else None
    if kind is None:
        raise ValueError(f"message: type must be one of {', '.join(MESSAGES)}")
    fields = {name: value for name, value in content.items() if name != "type"}
    return decode(content["type"], kind, fields)


def _reject_constant(name: str) -> float:
    raise ValueError(f"{name} is no number")


def message_text(kind: str, **content: Any) -> str:
    """Returns a message to a page, as text."""
    return json.dumps({"type": kind, **content})


def binary_message(header: dict[str, Any], data: bytes) -> bytes:
    """Returns a picture or a file for a page, with its head, as bytes."""
    text = json.dumps(header).encode()
    return struct.pack("<I", len(text)) + text + data
