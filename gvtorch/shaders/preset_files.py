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
from .presets import (
    COLORMAP_OPACITY,
    COLORMAP_SAMPLES,
    FunctionPoints,
    Points,
    convert_colors,
    linear_from_srgb,
)

_GRID_CELLS = 2**14  # cells of the grid that points are moved to, which keeps tables short
_MIN_PARTS = 16  # least parts between two colours, if the grid is fine enough
_TOTAL_PARTS = 2048  # parts in all, if there are few colours
_SRGB_PARTS = 32  # linear pieces from black to white that approximate sRGB
_CURVE_PARTS = 128  # parts of a curve between two opacities
# VTK sharpness: below it is linear, above a step, else a curve.
_LINEAR_BELOW, _STEP_ABOVE = 0.01, 0.99
_UNSATURATED = 0.05  # radians; colours with less saturation in Msh count as grey
# Colours with hues farther apart are mixed through white, as in VTK.
_WHITE_HUE_ANGLE = 0.33 * math.pi


@np.errstate(all="ignore")  # infinities and NaN are rejected later
def read_preset(path: str | Path, name: str | None) -> tuple[FunctionPoints, float | None, bool]:
    """Reads a preset of ParaView (.json) or 3D Slicer (.vp, .vp.json, or an .xml with several named
    presets, such as its presets.xml).

    Returns:
        The points; the reference length of opacities, None if the file has none; and whether the
        values are only relative, as in ParaView.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds something else, has no such preset, or several, and no name was given.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"transfer function file not found: {file}")
    try:
        if file.suffix == ".vp":
            _refuse_name(name)
            return _slicer_points(file, _parse_vp(file.read_text("utf-8"))), None, False
        if file.suffix == ".xml":
            nodes = ElementTree.parse(file).iter("VolumeProperty")
            presets = {node.get("name") or node.get("id") or "": node.attrib for node in nodes}
            return _slicer_points(file, _choose(presets, name)), None, False
        content = check.json_file("transfer function file", file)
        if isinstance(content, dict) and "volumeProperties" in content:
            _refuse_name(name)
            return *_parse_vp_json(file, content), False
        items = content if isinstance(content, list) else [content]
        kinds = {"RGBPoints", "IndexedColors"}
        if not all(isinstance(item, dict) and item.keys() & kinds for item in items):
            raise ValueError(
                'expected {"opacity": ..., "color": ...}, a list of ParaView presets '
                '({"Name": ..., "RGBPoints": ...}) or "volumeProperties" of 3D Slicer'
            )
        presets = {str(item.get("Name", index)): item for index, item in enumerate(items)}
        maps = {key: item for key, item in presets.items() if "RGBPoints" in item}
        if name in presets.keys() - maps or not maps:  # ParaView's lists may hold both kinds
            raise ValueError("holds colours of categories (IndexedColors), which are no function")
        return _paraview_points(file, _choose(maps, name)), None, True
    except OverflowError:
        raise ValueError(f"{file}: holds a number that is too large") from None
    except (KeyError, TypeError, IndexError, ElementTree.ParseError, UnicodeDecodeError) as error:
        problem = f"not a file of the kind that its ending says: {error!r}"
        raise ValueError(f"{file}: {problem}") from None
    except ValueError as error:
        message = one_line(error)
        prefix = "" if message.startswith(str(file)) else f"{file}: "
        raise ValueError(prefix + message) from None


def _refuse_name(name: str | None) -> None:
    if name is not None:
        raise ValueError(f"holds one preset, without a name: leave {name!r} out")


def _choose(presets: Mapping[str, Any], name: str | None) -> Any:
    if name is None and len(presets) == 1:
        return next(iter(presets.values()))
    if name in presets:
        return presets[str(name)]
    reason = f"has no preset {name!r}" if name else "has several presets, name one as in FILE:NAME"
    hint = did_you_mean(name or "", presets)
    raise ValueError(f"{reason}; it has {', '.join(presets) or 'none'}{hint}")


def _parse_vp(text: str) -> Mapping[str, Any]:
    """Parses nine lines: interpolation, shade, diffuse, ambient, specular, power, three lists."""
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) < 9:
        raise ValueError(f"a .vp file has 9 lines, this one {len(lines)}")
    names = ("scalarOpacity", "gradientOpacity", "colorTransfer")
    return {"shade": lines[1].strip(), **dict(zip(names, lines[6:9], strict=True))}


def _slicer_points(file: Path, properties: Mapping[str, Any]) -> FunctionPoints:
    """Parses points from strings that hold a count and as many numbers."""
    opacity = _parse_counted(properties["scalarOpacity"], 2)
    gradient = _parse_counted(properties.get("gradientOpacity", "4 0 1 255 1"), 2)
    _warn_dropped(file, gradient, shaded=str(properties.get("shade", "0")) not in ("0", "false"))
    return _gridded_points(_opacities(opacity), _parse_counted(properties["colorTransfer"], 4))


def _parse_counted(text: str, width: int) -> np.ndarray:
    count, *numbers = [float(part) for part in text.split()]
    if count != len(numbers) or len(numbers) % width or not numbers:
        raise ValueError(f"{text[:40]!r} must be a count and as many numbers, {width} a point")
    return np.array(numbers).reshape(-1, width)


def _parse_vp_json(file: Path, content: Mapping[str, Any]) -> tuple[FunctionPoints, float | None]:
    component = content["volumeProperties"][0]["components"][0]
    colors = component["rgbTransferFunction"]["points"]
    color_nodes = np.array([(p["x"], *p["color"], *_curve_shape(p)) for p in colors], float)
    opacities = component["scalarOpacity"]["points"]
    opacity_nodes = np.array([(p["x"], p["y"], *_curve_shape(p)) for p in opacities], float)
    gradient = [(p["x"], p["y"]) for p in component.get("gradientOpacity", {}).get("points", ())]
    if component.get("disableGradientOpacity"):
        gradient = []
    _warn_dropped(file, np.array(gradient or [(0, 1)]), shaded=bool(component.get("shade")))
    points = _gridded_points(_opacities(opacity_nodes), color_nodes)
    return points, component.get("scalarOpacityUnitDistance")


def _curve_shape(point: Mapping[str, float]) -> tuple[float, float]:
    return point.get("midpoint", 0.5), point.get("sharpness", 0.0)


def _warn_dropped(file: Path, gradient: np.ndarray, shaded: bool) -> None:
    dropped = ["opacity by gradient"] if (gradient[:, 1] != 1).any() else []
    dropped += ["shading, which --shader lit has (gv.Lit)"] if shaded else []
    if dropped:
        warnings.warn(f"{file}: not kept: {'; '.join(dropped)}", stacklevel=5)


def _paraview_points(file: Path, item: Mapping[str, Any]) -> FunctionPoints:
    nodes = np.array(item["RGBPoints"], float).reshape(-1, 4)
    space = str(item.get("ColorSpace", "RGB"))
    if space in ("Lab/CIEDE2000", "LabCIEDE2000"):
        warnings.warn(f"{file}: not kept: ColorSpace {space!r}, taken as 'Lab'", stacklevel=4)
        space = "Lab"
    if space == "CIELAB":  # one map that ParaView ships has it, and ParaView reads it as RGB
        space = "RGB"
    spaces = ("RGB", "HSV", "Lab", "Diverging", "Step")
    if space not in spaces:
        raise ValueError(f"ColorSpace must be one of {', '.join(spaces)}, got {space!r}")
    if item.get("Points"):
        opacity = _opacities(np.array(item["Points"], float).reshape(-1, 4))
    else:
        low, high = nodes[0, 0], nodes[-1, 0]
        opacity = np.array([(low + v * (high - low), a) for v, a in COLORMAP_OPACITY])
    return _gridded_points(opacity, nodes, space, wrap=bool(item.get("HSVWrap", False)))


def paraview_item(opacity: np.ndarray, color: np.ndarray) -> dict[str, list[float]]:
    """Returns ParaView's "RGBPoints" and "Points" for opacities (k, 2) and colours (m, 4)."""
    encoded = partial(convert_colors, "linear_rgb_to_rgb")
    nodes, distances = [color[0]], np.abs(np.diff(encoded(color[:, 1:]), axis=0)).max(1)
    for first, last, distance in zip(color[:-1], color[1:], distances, strict=True):
        parts = max(1, math.ceil(_SRGB_PARTS * distance))
        nodes += [first + part / parts * (last - first) for part in range(1, parts + 1)]
    points = np.array(nodes)
    points[:, 1:] = encoded(points[:, 1:])
    middles = np.broadcast_to((0.5, 0.0), (len(opacity), 2))  # midpoint and sharpness: straight
    opacity_nodes = np.column_stack((opacity, middles))
    return {"RGBPoints": points.ravel().tolist(), "Points": opacity_nodes.ravel().tolist()}


def _opacities(nodes: np.ndarray) -> np.ndarray:
    """Returns points (k, 2) from nodes (v, a), or (v, a, midpoint, sharpness) as in VTK."""
    nodes = nodes[np.argsort(nodes[:, 0], kind="stable")]
    if nodes.shape[1] == 2:
        return nodes
    points = []
    for (v, a, midpoint, sharpness), (w, b, *_) in itertools.pairwise(nodes):
        middle = _clamped_midpoint(midpoint)
        positions = np.array([0, *_before_and_at(middle)])
        if _LINEAR_BELOW <= sharpness <= _STEP_ABOVE:
            # The same number before and after midpoint.
            fractions = np.arange(_CURVE_PARTS // 2) / (_CURVE_PARTS // 2)
            positions = np.concatenate((fractions * middle, middle + fractions * (1 - middle)))
        weights = _second_weight(positions, middle, sharpness)
        points += list(zip(v + positions * (w - v), a + weights * (b - a), strict=True))
    return np.array([*points, nodes[-1, :2]])


def _clamped_midpoint(midpoint: float) -> float:
    return min(max(midpoint, 1e-5), 1 - 1e-5)


def _before_and_at(middle: float) -> tuple[float, float]:
    return middle - 1e-9, middle


def _second_weight(position: np.ndarray, midpoint: float, sharpness: float) -> np.ndarray:
    """Returns the weight of the second node, 0 to 1, by VTK's definition: 1/2 at the midpoint. At
    sharpness 0 it is piecewise linear, at 1 a step; in between, positions are bent towards the
    midpoint, and go through a cubic whose end slopes fall with sharpness.
    """
    below, above = 0.5 * position / midpoint, 0.5 + 0.5 * (position - midpoint) / (1 - midpoint)
    s = np.where(position < midpoint, below, above)
    if sharpness < _LINEAR_BELOW:
        return s
    if sharpness > _STEP_ABOVE:
        return (position >= midpoint).astype(float)
    power = 1 + 10 * sharpness
    low = 0.5 * (2 * s.clip(max=0.5)) ** power
    s = np.where(s < 0.5, low, 1 - 0.5 * (2 * (1 - s.clip(min=0.5))) ** power)
    slope = 1 - sharpness
    s2, s3 = s * s, s * s * s
    return (-2 * s3 + 3 * s2 + (s3 - 2 * s2 + s + s3 - s2) * slope).clip(0, 1)


def _gridded_points(
    opacity: np.ndarray, nodes: np.ndarray, space: str = "RGB", *, wrap: bool = False
) -> FunctionPoints:
    """Returns opacity and linear colour on one grid; nodes: value, sRGB (, midpoint, sharpness)."""
    if not len(nodes) or not len(opacity):
        raise ValueError("holds no points")
    nodes = nodes[np.argsort(nodes[:, 0], kind="stable")]
    if not (np.isfinite(opacity).all() and np.isfinite(nodes).all()):
        raise ValueError("its numbers must be finite")
    all_values = np.concatenate((opacity[:, 0], nodes[:, 0]))
    low, high = float(all_values.min()), float(all_values.max())
    step = ((high - low) or 1.0) / _GRID_CELLS
    parts = max(_MIN_PARTS, _TOTAL_PARTS // len(nodes))
    values, colors = [nodes[:1, 0]], [nodes[:1, 1:4]]
    for first, last in itertools.pairwise(nodes):
        cells = (last[0] - first[0]) / step
        count = max(1, math.ceil(COLORMAP_SAMPLES * cells / _GRID_CELLS), min(parts, int(cells)))
        weights = np.arange(1, count + 1) / count
        curve_shape = tuple(first[4:])
        if curve_shape not in ((), (0.5, 0)):
            weights = np.sort(np.append(weights, _before_and_at(_clamped_midpoint(curve_shape[0]))))
        values.append(first[0] + weights * (last[0] - first[0]))
        if curve_shape:
            weights = _second_weight(weights, _clamped_midpoint(curve_shape[0]), curve_shape[1])
        if space == "Step":  # the upper node's colour begins right at the lower node
            values[-1], weights = np.array([first[0], last[0]]), np.ones(2)
        colors.append(_interpolated(first[1:4], last[1:4], weights, space, wrap))
    linear_colors = linear_from_srgb(np.concatenate(colors).clip(0, 1))
    colored = np.column_stack((np.concatenate(values), linear_colors))
    return _moved_to_grid(opacity, low, step), _moved_to_grid(colored, low, step)


def _moved_to_grid(points: np.ndarray, low: float, step: float) -> Points:
    """Moves points to the grid; of several at one position the first and last become a ramp."""
    moved: list[tuple[float, ...]] = []
    last_cell = -1
    cells = np.rint((points[:, 0] - low) / step).astype(int)
    placed = zip(cells, points[:, 1:].tolist(), strict=True)
    for cell, run in itertools.groupby(placed, lambda point: point[0]):
        rows = [row for _, row in run]
        # Without a jump one row, so that values don't shift upwards.
        jump = rows[0] != rows[-1] and last_cell < cell
        for row in (rows[0], rows[-1]) if jump else rows[-1:]:
            last_cell = max(int(cell), last_cell + 1)
            moved.append((low + last_cell * step, *row))
    return moved


def _interpolated(
    first: np.ndarray, last: np.ndarray, weights: np.ndarray, space: str, wrap: bool
) -> np.ndarray:
    """Returns (k, 3) sRGB, interpolated between two colours in a colour space."""
    t = weights[:, None]
    if space in ("RGB", "Step"):
        return first + t * (last - first)
    if space == "HSV":
        a, b = (convert_colors("rgb_to_hsv", color) for color in (first, last))
        a[0], b[0] = a[0] / (2 * math.pi), b[0] / (2 * math.pi)
        if wrap and abs(a[0] - b[0]) > 0.5:
            (a if a[0] < b[0] else b)[0] += 1
        mixed = a + t * (b - a)
        mixed[:, 0] = mixed[:, 0] % 1 * 2 * math.pi
        return convert_colors("hsv_to_rgb", mixed)
    a, b = (convert_colors("rgb_to_lab", color) for color in (first, last))
    mixed = a + t * (b - a) if space == "Lab" else _diverging(a, b, weights)
    rgb = convert_colors("lab_to_rgb", mixed, clip=False)
    return rgb / rgb.max(1, keepdims=True).clip(1)  # scales down what is too bright, as VTK


def _diverging(first: np.ndarray, last: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Returns (k, 3) Lab, interpolated by Moreland's method: through white if hues differ much."""
    ends = [_msh(first), _msh(last)]
    (m1, s1, h1), (m2, s2, h2) = ends
    hue_difference = min(abs(h1 - h2), 2 * math.pi - abs(h1 - h2))
    white = np.array([max(m1, m2, 88.0), 0.0, 0.0])
    if min(s1, s2) > _UNSATURATED and hue_difference > _WHITE_HUE_ANGLE:
        segments = [(ends[0], white, weights[weights <= 0.5] * 2)]
        segments += [(white, ends[1], weights[weights > 0.5] * 2 - 1)]
    else:
        segments = [(ends[0], ends[1], weights)]
    mixed = np.concatenate([_msh_mix(*segment) for segment in segments])
    m, s, h = mixed.T
    return np.column_stack((m * np.cos(s), m * np.sin(s) * np.cos(h), m * np.sin(s) * np.sin(h)))


def _msh(lab: np.ndarray) -> np.ndarray:
    """Returns Lab in polar coordinates: magnitude, and saturation and hue as angles."""
    m = float(np.linalg.norm(lab))
    s = math.acos(float(lab[0]) / m) if m > 1e-3 else 0.0
    return np.array([m, s, math.atan2(lab[2], lab[1]) if s > 1e-3 else 0.0])


def _msh_mix(first: np.ndarray, last: np.ndarray, weights: np.ndarray) -> np.ndarray:
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
    difference = b - a
    if not spun:  # a spun hue of a dark colour may be more than a full turn away
        # The shorter way around.
        difference[2] = (difference[2] + math.pi) % (2 * math.pi) - math.pi
    return a + weights[:, None] * difference
