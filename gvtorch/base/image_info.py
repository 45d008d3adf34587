"""`ImageInfo`: what a file says about its values apart from their grid: unit, channels, time, ...

torch and NumPy are not imported here, since readers of headers and `gvtorch --help` import it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

Rgb = tuple[float, float, float]
Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class ChannelInfo:
    """The name of one channel, and how it is meant to be shown."""

    name: str = ""
    color: Rgb | None = None  # sRGB, 0 to 1
    window: tuple[float, float] | None = None  # the values shown darkest and brightest
    active: bool = True  # whether it is shown at first

    def describe(self) -> str:
        """Returns name, colour and window in a few words."""
        parts = [self.name] if self.name else []
        if self.color is not None:
            parts.append("#" + to_hex(self.color))
        if self.window is not None:
            parts.append(f"{self.window[0]:g} to {self.window[1]:g}")
        return ", ".join(parts + ["not shown at first"] * (not self.active)) or "nothing told"


#: Colours of microscopists' usual lookup tables.
COLORS: dict[str, Rgb] = {
    **{"blue": (0.0, 0.0, 1.0), "green": (0.0, 1.0, 0.0), "red": (1.0, 0.0, 0.0)},
    **{"magenta": (1.0, 0.0, 1.0), "cyan": (0.0, 1.0, 1.0), "yellow": (1.0, 1.0, 0.0)},
    **{"orange": (1.0, 128 / 255, 0.0)},
    **dict.fromkeys(("white", "gray", "grey"), (1.0, 1.0, 1.0)),
}
#: The channels of light that adds up: premultiplied colour, and the opacity with which it occludes.
PREMULTIPLIED = tuple(ChannelInfo(name=name) for name in ("red", "green", "blue", "opacity"))


def color_channels(count: int = 3) -> tuple[ChannelInfo, ...]:
    """Returns `count` >= 3 channels of a colour image: red, green, blue; any others are alpha."""
    colors = [ChannelInfo(name=name, color=COLORS[name]) for name in ("red", "green", "blue")]
    return (*colors, *[ChannelInfo(name="alpha")] * (count - 3))


def to_hex(color: Rgb) -> str:
    """Returns a colour as RRGGBB."""
    return "".join(f"{round(255 * min(max(component, 0.0), 1.0)):02x}" for component in color)


def from_hex(text: str) -> Rgb:
    """Returns the colour of the text RRGGBB; raises ValueError for any other text."""
    red, green, blue = (component / 255 for component in bytes.fromhex(text))
    return (red, green, blue)


def array_from_srgb(color: np.ndarray) -> np.ndarray:
    """Returns linear light from sRGB in [0, 1], IEC 61966-2-1; in torch: `pictures/tone.py`."""
    import numpy as np

    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


#: `ImageInfo.quantity` of level sets and distances to meshes: world units, negative inside.
SIGNED_DISTANCE = "signed distance"


@dataclass(frozen=True, kw_only=True)
class ImageInfo:
    """What is known about an image's values; what a file does not say keeps its default."""

    unit: str | None = None  # of length, as OME-NGFF spells it: "micrometer", "millimeter", ...
    channels: tuple[ChannelInfo, ...] = ()  # one for each channel, or none
    quantity: str | None = None  # what the values measure, as in "HU"
    labels: bool = False  # values are label numbers, which must not be blended
    space: str | None = None  # where x, y, z point: "right-anterior-superior", ...
    pose: Rows | None = None  # (4, 4) to the world from the axes of oblique voxels kept as they are
    time_step: float | None = None  # from one time point to the next, in `time_unit`
    time_origin: float = 0.0  # of the first time point, in `time_unit`
    time_unit: str | None = None  # as OME-NGFF spells it: "second", ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", tuple(self.channels))

    @property
    def default_border(self) -> int:
        """Voxels of overlap around a brick: 1, or 2 for labels, to smooth their slanted faces."""
        return 2 if self.labels else 1

    def check_component(self, name: str, component: int, width: int) -> None:
        """Raises ValueError, which lists the components, unless the `width` numbers of a voxel
        have this one; `name` is what chose it.
        """
        if 0 <= component < width:
            return
        names = [channel.name for channel in self.channels]
        names += [""] * (width - len(names))
        listing = ", ".join(f"{n} ({name})" if name else str(n) for n, name in enumerate(names))
        count = "one number" if width == 1 else f"{width} numbers"
        raise ValueError(f"{name} {component}: a voxel has {count}: {listing}")

    def describe(self) -> dict[str, Any]:
        """Returns what is known as plain values."""
        info: dict[str, Any] = {"unit": self.unit, "quantity": self.quantity, "space": self.space}
        info["labels"] = self.labels or None
        if self.pose is not None:
            info["pose"] = "; ".join(" ".join(f"{n:.6g}" for n in row) for row in self.pose[:3])
        if self.time_step is not None:
            info["time step"] = f"{self.time_step:g} {self.time_unit or ''}".strip()
        info["channel info"] = {str(n): c.describe() for n, c in enumerate(self.channels)}
        return {name: value for name, value in info.items() if value}


def up_and_front(space: str | None) -> tuple[str, float]:
    """Returns the up direction and the azimuth of the front, given where x, y and z point
    (`ImageInfo.space`): for patients, the directions of the head and of the face.
    """
    axes = (space or "").split("-")
    if len(axes) == 3 and axes[2] == "superior" and axes[1] in ("anterior", "posterior"):
        return "+z", 180.0 if axes[1] == "anterior" else 0.0
    return "+y", 0.0
