"""The flags `--tf` and `--window`: which transfer function, and over which values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .common import numbers

if TYPE_CHECKING:
    from ..base.volume import Volume
    from ..io.stores.store import Store
    from ..shaders import TransferFunction

_ENDINGS = (".json", ".vp", ".xml")  # of files of transfer functions


def check_component(data: Volume | Store, component: int) -> None:
    """Raises ValueError, which tells what there is, where voxels have no such number."""
    width = data.width
    if 0 <= component < width:
        return
    names = [channel.name for channel in data.info.channels]
    names += [""] * (width - len(names))
    told = ", ".join(f"{n} ({name})" if name else str(n) for n, name in enumerate(names))
    what = "one number" if width == 1 else f"{width} numbers"
    raise ValueError(f"--component {component}: a voxel has {what}: {told}")


def chosen_transfer(
    name: str | None,
    span: str | None,
    data: Volume | Store,
    component: int,
    *,
    background: bool = False,
) -> TransferFunction:
    """Returns the transfer function that `--tf` names, stretched over what `--window` tells. Left
    out, files and presets in Hounsfield units keep their own values, and others are stretched over
    what `window` finds (see there for `background`). Where the data are in Hounsfield units, `bone`
    and others stand for those presets.
    """
    from ..shaders import TransferFunction
    from ..shaders.presets import CT_PRESETS, IN_HU

    check_component(data, component)
    name = name or "gray"
    file, _, inner = name.rpartition(":")
    if Path(name).is_file() or name.endswith(_ENDINGS):
        transfer = TransferFunction.from_file(name)
    elif file and (Path(file).is_file() or file.endswith(_ENDINGS)):
        transfer = TransferFunction.from_file(file, inner)
    elif name in CT_PRESETS:
        transfer = TransferFunction.preset(name)
    elif span in (None, "auto") and name in IN_HU and data.info.quantity == "HU":
        return TransferFunction.preset(IN_HU[name])
    else:
        transfer = TransferFunction.preset(name, 0, 1)
        transfer.relative = True
    if span is None and not transfer.relative:
        return transfer
    values = parse_window(span or "auto", data, component, background=background)
    return transfer.stretched(*values)


def parse_window(
    text: str, data: Volume | Store, component: int, *, background: bool = False
) -> tuple[float, float]:
    """Returns the values of LO,HI, P%,P%, `auto` or `full`; for `background` see `window`.

    Raises:
        ValueError: The text is none of these, or the values are out of order.
    """
    from ..io.window import value_range, window

    check_component(data, component)
    if text == "auto":
        return window(data, component=component, background=background)
    if text == "full":
        return value_range(data)
    try:
        low, high = numbers("--window", text.replace("%", ""), 2, float)
    except ValueError:
        wanted = "--window must be LO,HI, P%,P%, auto or full"
        raise ValueError(f"{wanted}, got {text!r}") from None
    if text.count("%") == 2 and all(part.endswith("%") for part in text.split(",")):
        return window(data, (low, high), component=component)
    if "%" in text or not low < high:
        raise ValueError(f"--window must be LO,HI with LO < HI, or P%,P%, got {text!r}")
    return low, high
