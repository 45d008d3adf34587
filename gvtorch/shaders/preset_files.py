"""Transfer functions of other programs: reads presets of ParaView and 3D Slicer as opacity (v, a)
and colour (v, r, g, b), linear light.

Their colours are sRGB, and ParaView interpolates in other colour spaces: such curves are sampled
finely enough for linear interpolation.

Source: Moreland, "Diverging color maps for scientific visualization", ISVC 2009 (Msh).
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..base import check
from ..base.declared import did_you_mean
from ..base.messages import one_line
from .presets import RAMP, SAMPLES, Pair, Points, converted, linear

_GRID = 2**14  # cells of the grid that points are moved to, which keeps tables short
_PARTS = 16  # least parts between two colours, if the grid is fine enough
_FEW = 2048  # parts in all, if there are few colours
_SRGB_PARTS = 32  # linear pieces from black to white that approximate sRGB
_BENT = 128  # parts of a curve between two opacities
_STRAIGHT, _SUDDEN = 0.01, 0.99  # VTK sharpness: below it is linear, above a step, else a curve
_UNSATURATED = 0.05  # radians; colours with less saturation in Msh count as grey
_APART = 0.33 * math.pi  # colours with hues farther apart are mixed through white, as in VTK


@np.errstate(all="ignore")  # infinities and NaN are rejected later
def read_preset(path: str | Path, name: str | None) -> tuple[Pair, float | None, bool]:
    """Reads a preset of ParaView (.json) or 3D Slicer (.vp, .vp.json, or an .xml with several named
    presets, such as its presets.xml).

    Returns:
        The points; the reference length of opacities, None if the file has none; and whether the
        values are only relative, as in ParaView.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file holds something else, or has no such preset, or several and no name was
            given.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"transfer function file not found: {file}")
    try:
        if file.suffix == ".vp":
            _only(name)
            return _slicer(file, _of_vp(file.read_text("utf-8"))), None, False
        if file.suffix == ".xml":
            nodes = ElementTree.parse(file).iter("VolumeProperty")
            found = {node.get("name") or node.get("id") or "": node.attrib for node in nodes}
            return _slicer(file, _chosen(file, found, name)), None, False
        content = check.json_file("transfer function file", file)
        if isinstance(content, dict) and "volumeProperties" in content:
            _only(name)
            return *_of_vp_json(file, content), False
        items = content if isinstance(content, list) else [content]
        if not all(
            isinstance(i, dict) and i.keys() & {"RGBPoints", "IndexedColors"} for i in items
        ):
            raise ValueError(
                'expected {"opacity": ..., "color": ...}, a list of ParaView presets '
                '({"Name": ..., "RGBPoints": ...}) or "volumeProperties" of 3D Slicer'
            )
        found = {str(item.get("Name", number)): item for number, item in enumerate(items)}
        maps = {key: item for key, item in found.items() if "RGBPoints" in item}
        if name in found.keys() - maps or not maps:  # ParaView's lists may hold both kinds
            raise ValueError(
                "holds colours of categories (IndexedColors), which are not a function"
            )
        return _of_paraview(file, _chosen(file, maps, name)), None, True
    except OverflowError:
        raise ValueError(f"{file}: holds a number that is too large") from None
    except (KeyError, TypeError, IndexError, ElementTree.ParseError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{file}: not a file of the kind that its ending says: {error!r}"
        ) from None
    except ValueError as error:
        told = one_line(error)
        raise ValueError(told if told.startswith(str(file)) else f"{file}: {told}") from None


def _only(name: str | None) -> None:
    if name is not None:
        raise ValueError(f"holds one preset, without a name: leave {name!r} out")


def _chosen(file: Path, found: Mapping[str, Any], name: str | None) -> Any:
    if name is None and len(found) == 1:
        return next(iter(found.values()))
    if name in found:
        return found[str(name)]
    what = f"has no preset {name!r}" if name else "has several presets, name one as in FILE:NAME"
    close = did_you_mean(name or "", found)
    raise ValueError(f"{what}; it has {', '.join(found) or 'none'}{close}")


def _of_vp(text: str) -> Mapping[str, Any]:
    """Parses nine lines: interpolation, shade, diffuse, ambient, specular, power, three lists."""
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) < 9:
        raise ValueError(f"a .vp file has 9 lines, this one {len(lines)}")
    names = ("scalarOpacity", "gradientOpacity", "colorTransfer")
    return {"shade": lines[1].strip(), **dict(zip(names, lines[6:9], strict=True))}


def _slicer(file: Path, told: Mapping[str, Any]) -> Pair:
    """Parses points from strings that hold a count and as many numbers."""
    opacity = _counted(told["scalarOpacity"], 2)
    gradient = _counted(told.get("gradientOpacity", "4 0 1 255 1"), 2)
    _tell_lost(file, gradient, shaded=str(told.get("shade", "0")) not in ("0", "false"))
    return _points(_opacities(opacity), _counted(told["colorTransfer"], 4))


def _counted(text: str, width: int) -> np.ndarray:
    count, *numbers = [float(part) for part in text.split()]
    if count != len(numbers) or len(numbers) % width or not numbers:
        raise ValueError(f"{text[:40]!r} must be a count and as many numbers, {width} a point")
    return np.array(numbers).reshape(-1, width)


def _of_vp_json(file: Path, content: Mapping[str, Any]) -> tuple[Pair, float | None]:
    part = content["volumeProperties"][0]["components"][0]
    color = [(p["x"], *p["color"], *_bent(p)) for p in part["rgbTransferFunction"]["points"]]
    gradient = [(p["x"], p["y"]) for p in part.get("gradientOpacity", {}).get("points", ())]
    if part.get("disableGradientOpacity"):
        gradient = []
    bent = [(p["x"], p["y"], *_bent(p)) for p in part["scalarOpacity"]["points"]]
    _tell_lost(file, np.array(gradient or [(0, 1)]), shaded=bool(part.get("shade")))
    reference = part.get("scalarOpacityUnitDistance")
    return _points(_opacities(np.array(bent, float)), np.array(color, float)), reference


def _bent(point: Mapping[str, float]) -> tuple[float, float]:
    return point.get("midpoint", 0.5), point.get("sharpness", 0.0)


def _tell_lost(file: Path, gradient: np.ndarray, shaded: bool) -> None:
    lost = ["opacity by gradient"] if (gradient[:, 1] != 1).any() else []
    lost += ["shading, which --shader lit has (gv.Lit)"] if shaded else []
    if lost:
        warnings.warn(f"{file}: not kept: {'; '.join(lost)}", stacklevel=5)


def _of_paraview(file: Path, item: Mapping[str, Any]) -> Pair:
    nodes = np.array(item["RGBPoints"], float).reshape(-1, 4)
    space = str(item.get("ColorSpace", "RGB"))
    if space in ("Lab/CIEDE2000", "LabCIEDE2000"):
        warnings.warn(f"{file}: not kept: ColorSpace {space!r}, taken as 'Lab'", stacklevel=4)
        space = "Lab"
    if space == "CIELAB":  # one map that ParaView ships has it, and ParaView reads it as RGB
        space = "RGB"
    known = ("RGB", "HSV", "Lab", "Diverging", "Step")
    if space not in known:
        raise ValueError(f"ColorSpace must be one of {', '.join(known)}, got {space!r}")
    if item.get("Points"):
        opacity = _opacities(np.array(item["Points"], float).reshape(-1, 4))
    else:
        low, high = nodes[0, 0], nodes[-1, 0]
        opacity = np.array([(low + v * (high - low), a) for v, a in RAMP])
    return _points(opacity, nodes, space, wrap=bool(item.get("HSVWrap", False)))


def paraview_item(opacity: np.ndarray, color: np.ndarray) -> dict[str, list[float]]:
    """Returns ParaView's "RGBPoints" and "Points" for opacities (k, 2) and colours (m, 4)."""
    encoded = partial(converted, "linear_rgb_to_rgb")
    nodes, ways = [color[0]], np.abs(np.diff(encoded(color[:, 1:]), axis=0)).max(1)
    for first, last, way in zip(color[:-1], color[1:], ways, strict=True):
        parts = max(1, math.ceil(_SRGB_PARTS * way))
        nodes += [first + at / parts * (last - first) for at in range(1, parts + 1)]
    points = np.array(nodes)
    points[:, 1:] = encoded(points[:, 1:])
    middles = np.broadcast_to((0.5, 0.0), (len(opacity), 2))  # midpoint and sharpness: straight
    told = np.column_stack((opacity, middles))
    return {"RGBPoints": points.ravel().tolist(), "Points": told.ravel().tolist()}


def _opacities(nodes: np.ndarray) -> np.ndarray:
    """Returns points (k, 2) from nodes (v, a), or (v, a, midpoint, sharpness) as in VTK."""
    nodes = nodes[np.argsort(nodes[:, 0], kind="stable")]
    if nodes.shape[1] == 2:
        return nodes
    points = []
    for (v, a, midpoint, sharp), (w, b, *_) in itertools.pairwise(nodes):
        middle = _inside(midpoint)
        places = np.array([0, *_around(middle)])
        if _STRAIGHT <= sharp <= _SUDDEN:
            half = np.arange(_BENT // 2) / (_BENT // 2)  # the same number before and after midpoint
            places = np.concatenate((half * middle, middle + half * (1 - middle)))
        shares = _share(places, middle, sharp)
        points += list(zip(v + places * (w - v), a + shares * (b - a), strict=True))
    return np.array([*points, nodes[-1, :2]])


def _inside(midpoint: float) -> float:
    return min(max(midpoint, 1e-5), 1 - 1e-5)


def _around(middle: float) -> tuple[float, float]:
    return middle - 1e-9, middle


def _share(place: np.ndarray, middle: float, sharp: float) -> np.ndarray:
    """Returns the weight of the second node, 0 to 1, by VTK's definition: 1/2 at the midpoint. At
    sharpness 0 it is piecewise linear, at 1 a step; in between, positions are bent towards the
    midpoint, and go through a cubic whose end slopes fall with sharpness.
    """
    s = np.where(place < middle, 0.5 * place / middle, 0.5 + 0.5 * (place - middle) / (1 - middle))
    if sharp < _STRAIGHT:
        return s
    if sharp > _SUDDEN:
        return (place >= middle).astype(float)
    power = 1 + 10 * sharp
    low = 0.5 * (2 * s.clip(max=0.5)) ** power
    s = np.where(s < 0.5, low, 1 - 0.5 * (2 * (1 - s.clip(min=0.5))) ** power)
    slope = 1 - sharp
    s2, s3 = s * s, s * s * s
    return (-2 * s3 + 3 * s2 + (s3 - 2 * s2 + s + s3 - s2) * slope).clip(0, 1)


def _points(
    opacity: np.ndarray, nodes: np.ndarray, space: str = "RGB", *, wrap: bool = False
) -> Pair:
    """Returns opacity and linear colour on one grid. `nodes` are (value, sRGB), and may also have a
    midpoint and a sharpness.
    """
    if not len(nodes) or not len(opacity):
        raise ValueError("holds no points")
    nodes = nodes[np.argsort(nodes[:, 0], kind="stable")]
    if not (np.isfinite(opacity).all() and np.isfinite(nodes).all()):
        raise ValueError("its numbers must be finite")
    ends = np.concatenate((opacity[:, 0], nodes[:, 0]))
    low, high = float(ends.min()), float(ends.max())
    step = ((high - low) or 1.0) / _GRID
    parts = max(_PARTS, _FEW // len(nodes))
    values, colors = [nodes[:1, 0]], [nodes[:1, 1:4]]
    for first, last in itertools.pairwise(nodes):
        cells = (last[0] - first[0]) / step
        count = max(1, math.ceil(SAMPLES * cells / _GRID), min(parts, int(cells)))
        share = np.arange(1, count + 1) / count
        bend = tuple(first[4:])
        if bend not in ((), (0.5, 0)):
            share = np.sort(np.append(share, _around(_inside(bend[0]))))
        values.append(first[0] + share * (last[0] - first[0]))
        if bend:
            share = _share(share, _inside(bend[0]), bend[1])
        if space == "Step":  # the upper node's colour begins right at the lower node
            values[-1], share = np.array([first[0], last[0]]), np.ones(2)
        colors.append(_between(first[1:4], last[1:4], share, space, wrap))
    light = linear(np.concatenate(colors).clip(0, 1))
    colored = np.column_stack((np.concatenate(values), light))
    return _on_grid(opacity, low, step), _on_grid(colored, low, step)


def _on_grid(points: np.ndarray, low: float, step: float) -> Points:
    """Moves points to the grid; of several at one position the first and last become a ramp."""
    kept: list[tuple[float, ...]] = []
    last = -1
    places = np.rint((points[:, 0] - low) / step).astype(int)
    for at, run in itertools.groupby(
        zip(places, points[:, 1:].tolist(), strict=True), lambda p: p[0]
    ):
        rows = [row for _, row in run]
        jump = rows[0] != rows[-1] and last < at  # else one row, so that values don't shift upwards
        for row in (rows[0], rows[-1]) if jump else rows[-1:]:
            last = max(int(at), last + 1)
            kept.append((low + last * step, *row))
    return kept


def _between(
    first: np.ndarray, last: np.ndarray, share: np.ndarray, space: str, wrap: bool
) -> np.ndarray:
    """Returns (k, 3) sRGB, interpolated between two colours in a colour space."""
    t = share[:, None]
    if space in ("RGB", "Step"):
        return first + t * (last - first)
    if space == "HSV":
        a, b = (converted("rgb_to_hsv", color) for color in (first, last))
        a[0], b[0] = a[0] / (2 * math.pi), b[0] / (2 * math.pi)
        if wrap and abs(a[0] - b[0]) > 0.5:
            (a if a[0] < b[0] else b)[0] += 1
        mixed = a + t * (b - a)
        mixed[:, 0] = mixed[:, 0] % 1 * 2 * math.pi
        return converted("hsv_to_rgb", mixed)
    a, b = (converted("rgb_to_lab", color) for color in (first, last))
    mixed = a + t * (b - a) if space == "Lab" else _diverging(a, b, share)
    light = converted("lab_to_rgb", mixed, clip=False)
    return light / light.max(1, keepdims=True).clip(1)  # scales down what is too bright, as VTK


def _diverging(first: np.ndarray, last: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Returns (k, 3) Lab, interpolated by Moreland's method: through white if hues differ much."""
    ends = [_msh(first), _msh(last)]
    (m1, s1, h1), (m2, s2, h2) = ends
    apart = abs(h1 - h2)
    white = np.array([max(m1, m2, 88.0), 0.0, 0.0])
    if min(s1, s2) > _UNSATURATED and min(apart, 2 * math.pi - apart) > _APART:
        halves = [(ends[0], white, share[share <= 0.5] * 2)]
        halves += [(white, ends[1], share[share > 0.5] * 2 - 1)]
    else:
        halves = [(ends[0], ends[1], share)]
    mixed = np.concatenate([_msh_mix(*half) for half in halves])
    m, s, h = mixed.T
    return np.column_stack((m * np.cos(s), m * np.sin(s) * np.cos(h), m * np.sin(s) * np.sin(h)))


def _msh(lab: np.ndarray) -> np.ndarray:
    """Returns Lab in polar coordinates: magnitude, and saturation and hue as angles."""
    m = float(np.linalg.norm(lab))
    s = math.acos(float(lab[0]) / m) if m > 1e-3 else 0.0
    return np.array([m, s, math.atan2(lab[2], lab[1]) if s > 1e-3 else 0.0])


def _msh_mix(first: np.ndarray, last: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Mixes linearly in Msh; an unsaturated end takes the other's hue, turned away from it."""
    a, b = first.copy(), last.copy()
    spun = False
    for gray, other in ((a, b), (b, a)):
        if gray[1] < _UNSATURATED < other[1]:
            m, s, h = other
            gray[2], spun = h, True
            if m < gray[0] - 0.1:
                spin = s * math.sqrt(gray[0] ** 2 - m**2) / (m * math.sin(s))
                gray[2] = h + spin if h > -0.3 * math.pi else h - spin
    way = b - a
    if not spun:  # a spun hue of a dark colour may be more than a full turn away
        way[2] = (way[2] + math.pi) % (2 * math.pi) - math.pi  # the shorter way around
    return a + share[:, None] * way
