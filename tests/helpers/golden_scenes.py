"""Random scenes, each made from its seed, through the public interface alone.

`settings` draws everything that defines a scene, as plain values; the functions after it make the
objects. Draws and objects are the same on every machine, except for what gvtorch computes.
"""

from __future__ import annotations

import math
import random
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

import gvtorch as gv

Settings = dict[str, Any]

LOOKS = (
    *("transfer", "lit", "lit by normals", "lit with shadows", "pre-integrated"),
    *("stored", "premultiplied", "six", "stored with shadows", "stored by normals"),
    *("isosurface", "coloured isosurface", "distance field", "maximum", "minimum", "mean"),
    *("features", "module", "transfer module", "plain"),
)
FIRST_LATER, LATER = 200, ("channels",) * 10 + ("labels",) * 20  # scenes from number FIRST_LATER on
SCENES = FIRST_LATER + len(LATER)
METHODS = (
    *("render", "render", "render", "holes", "holes"),
    *("engine", "engine", "levels", "tracer", "cost"),
)
VALUE_RANGES = {  # range of the values, by dtype
    "uint8": (0, 255),
    "int8": (-100, 100),
    "int16": (-1000, 3000),
    "uint16": (0, 60000),
    "float16": (0.0, 1.0),
    "bfloat16": (-0.5, 1.5),
    "float32": (0.0, 1.0),
}
CAMERAS = (
    *("pinhole", "pinhole", "orbit", "ortho", "fisheye", "bent fisheye", "panorama"),
    *("directions", "rays", "batch"),
)
LIGHTS = ("none", "head", "sun", "wide sun", "lamp", "wide lamp")
SURFACES = ("isosurface", "coloured isosurface", "distance field")
PROJECTIONS = ("maximum", "minimum", "mean")
STORED = ("stored", "premultiplied", "six", "stored with shadows", "stored by normals")
LIT = ("lit", "lit by normals", "lit with shadows", *STORED, *SURFACES, "labels")
MODULES = ("module", "transfer module")


# --- the settings of a scene


class Dice:
    """Draws settings. Uses only the parts of `random` that are guaranteed to stay the same."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed).random

    def number(self, low: float, high: float) -> float:
        return round(low + (high - low) * self._random(), 3)

    def whole(self, low: int, high: int) -> int:
        return low + int((high - low + 1) * self._random())

    def pick(self, *choices: Any) -> Any:
        return choices[int(len(choices) * self._random())]

    def chance(self, share: float) -> bool:
        return self._random() < share

    def triple(self, low: float, high: float) -> tuple[float, float, float]:
        return (self.number(low, high), self.number(low, high), self.number(low, high))


@cache
def settings(seed: int) -> Settings:
    """Returns everything that defines a scene, as plain values."""
    dice = Dice(seed)
    look, method = LOOKS[seed % len(LOOKS)], METHODS[seed // len(LOOKS) % len(METHODS)]
    if seed >= FIRST_LATER:
        look = LATER[seed - FIRST_LATER]
        method = METHODS[seed % (len(METHODS) - (look == "labels"))]  # `cost` supports no labels
    if method == "cost" and look != "transfer":  # it supports only transfer functions
        look, method = ("plain", method) if seed % 3 == 0 else (look, "render")
    if method == "tracer" and look in MODULES:
        method = "engine"
    double = dice.chance(0.2) and method != "tracer"
    if look == "transfer module" or method == "cost":
        double = True
    raw = double and look in (*SURFACES, *PROJECTIONS)
    s: Settings = {"seed": seed, "look": look, "way": method}
    s["dtype"] = "float64" if double else "float32"
    s["hashed"] = "float32" if double and not raw else "raw"
    s |= _volume(dice, look, method)
    s |= _shader(dice, s, raw)
    s |= _view(dice, raw)
    s |= _extras(dice, s) if not raw and method != "tracer" else {}
    s["lod"] = dice.pick("auto", "auto", "finest") if "lens" not in s else "auto"
    s["step"] = dice.pick(0.5, 0.5, 0.3, 1.0, 1.7, 3.0)
    s["stop_alpha"] = dice.pick(0.99, 0.99, 1.0, 0.6)
    s["depth_alpha"] = dice.pick(0.1, 0.1, 0.5, 0.02)
    s["cone_scale"] = dice.pick(4 / 3, 4 / 3, 1.0, 3.0)
    if method in ("engine", "levels"):
        s["slots"] = dice.pick(*{4: (40, 64, 96), 8: (16, 24, 48), 16: (10, 16)}[s["brick"]])
        s["hold"] = dice.pick("voxels", "bricks")
        s["order"] = dice.pick("coarse", "fine")
        s["scouts"] = dice.whole(0, 2)
        s["two_trees"] = dice.chance(0.2) and look not in MODULES
    return s


def _volume(dice: Dice, look: str, method: str) -> Settings:
    """Draws extent, position, bricks and channels."""
    brick = dice.pick(4, 4, 8, 8, 16)
    max_extent = {4: 30, 8: 44, 16: 60}[brick] if method in ("engine", "levels") else 44
    dtype = dice.pick(*VALUE_RANGES)
    if look == "distance field":
        dtype = dice.pick("float16", "float32")
    if look == "labels":
        dtype = dice.pick("uint8", "int8", "int16", "uint16")
    spacing = dice.pick((1.0, 1.0, 1.0), (0.5, 0.5, 0.5), dice.triple(0.4, 2.0))
    drawn: Settings = {
        "branching": dice.pick(2, 2, 3, 4),
        "brick": brick,
        "border": dice.pick(0, 1, 1, 1, 2),
        "extent": tuple(dice.whole(8, max_extent) for _ in range(3)),
        "spacing": spacing,
        "origin": dice.pick((0.0, 0.0, 0.0), dice.triple(-20, 20)),
        "value": dtype,
        "width": dice.pick(1, 1, 2, 3),
        "regions": dice.pick("rough", "empty", "constant", "both", "both"),
        "threshold": dice.pick(None, 0.0, 0.2),
        "color": dice.pick("uint8", "uint16", "float16", "bfloat16", "float32"),
        "normal": dice.pick("uint8", "int8", "uint16", "int16", "float16", "float32"),
    }
    if look == "labels":
        drawn |= {"threshold": None, "wide": dice.chance(0.5), "most": dice.pick(3, 9, 40)}
    if look == "six":
        drawn["color"] = dice.pick("float16", "bfloat16", "float32")
    if look == "channels":
        drawn["width"] = dice.whole(2, 5)
        spans = [(dice.number(0, 0.5), dice.number(0.1, 0.6)) for _ in range(drawn["width"])]
        drawn["windows"] = [(low, low + length) for low, length in spans]
        drawn["mode"] = dice.pick("additive", "opacity")
    drawn["component"] = dice.whole(0, drawn["width"] - 1)
    return drawn


def _shader(dice: Dice, s: Settings, raw: bool) -> Settings:
    """Draws the transfer function (values as fractions of their range), light and material."""
    count, even = dice.whole(2, 5), dice.chance(0.7) or s["look"] == "pre-integrated"
    cells = 16 if even else 997
    points = sorted({dice.whole(0, cells) for _ in range(count)} | {cells})
    alpha = [dice.number(0, 1) * dice.pick(0, 0.1, 0.5, 1) for _ in points]
    drawn: Settings = {
        "opacity": [(round(a / cells, 4), round(b, 4)) for a, b in zip(points, alpha, strict=True)],
        "colors": [(x, *dice.triple(0, 1)) for x in (0.0, 0.5, 1.0)[: dice.whole(1, 3)]],
        "reference": dice.pick(None, None, dice.number(0.3, 3.0)),
        "level": dice.number(0.25, 0.75),
        "light": dice.pick(*LIGHTS),
        "toward": dice.pick((1.0, -1.0, -1.0), (0.3, 0.2, 1.0), (-2.0, 0.5, 0.0)),
        "glow": dice.triple(0.3, 1.0),
        "material": [dice.number(*ends) for ends in ((0, 0.5), (0.3, 1), (0, 0.6), (1, 60))],
    }
    if "shadows" in s["look"]:
        drawn["light"] = dice.pick(*LIGHTS[2:])
    if raw:
        drawn["material"][2] = 0.0
    return drawn


def _view(dice: Dice, raw: bool) -> Settings:
    """Draws the camera."""
    drawn: Settings = {
        "camera": "rays" if raw else dice.pick(*CAMERAS),
        "size": (dice.whole(16, 28), dice.whole(12, 22)),
        "inside": dice.chance(0.15),
        "away": dice.number(0.3, 1.1),
        "from": dice.pick((1.0, 0.6, 0.7), (-0.4, 1.0, 0.3), (0.2, -0.9, 1.0), (0.0, 0.0, 1.0)),
        "aim": dice.triple(-0.1, 0.1),
        "fov": dice.number(25, 50),
    }
    drawn["inside"] |= drawn["camera"] == "panorama"
    if drawn["camera"] == "rays":
        drawn["rays"] = "float64" if raw else dice.pick("float32", "float64")
        drawn["rows"] = dice.chance(0.5)
    if drawn["camera"] in ("rays", "directions"):
        drawn["cone"] = dice.pick("pixel", "wide", "finest")
        drawn["ends"] = dice.chance(0.3)
    return drawn


def _extras(dice: Dice, s: Settings) -> Settings:
    """Draws the options (clip, lens, lighting, layer, background) that the shader supports."""
    look, drawn = s["look"], {}
    whole = look in PROJECTIONS
    if dice.chance(0.3):
        drawn["clip"] = dice.pick("planes", "box", "boxes", "matrix", "without")
        drawn["clip_in"] = dice.pick("box", "world")
        drawn["caps"] = dice.chance(0.5) and not whole
        drawn["cap"] = (dice.number(0.3, 1), dice.number(0, 1))
    if dice.chance(0.2) and not whole:
        drawn["lens"] = (dice.number(0.02, 0.3), dice.number(0.5, 2.0), dice.pick("box", "world"))
    if dice.chance(0.4) and look in LIT and s["way"] != "cost":
        drawn["lighting"] = dice.pick("shadows", "cones", "occlusion", "indirect", "everything")
        if look == "coloured isosurface" and drawn["lighting"] in ("indirect", "everything"):
            drawn["lighting"] = "occlusion"
        drawn["lamps"] = dice.pick((), ("sun",), ("lamp", "head"), ("wide sun", "wide lamp"))
        drawn["reach"] = dice.pick(None, dice.number(0.1, 0.5))
    if dice.chance(0.25):
        drawn["layer"] = dice.pick("opaque", "opaque" if whole else "translucent")
    drawn["background"] = dice.pick("black", "color", "gradient", "image", "none")
    if drawn["background"] == "gradient":  # CUDA's division by other heights is off by an ulp
        drawn["size"] = (s["size"][0], 16)
    return drawn


def described(s: Settings) -> str:
    """Returns one line that describes a scene."""
    return ", ".join(f"{name}={value}" for name, value in s.items())


# --- from settings to a scene


def numbers(seed: int, *shape: int) -> np.ndarray:
    """Returns numbers in [0, 1) of a bit generator whose stream is guaranteed to stay the same."""
    raw = np.random.PCG64(seed).random_raw(math.prod(shape))
    return (raw >> np.uint64(11)).astype(np.float64).reshape(shape) * 2.0**-53


def smooth(seed: int, extent: tuple[int, int, int], width: int) -> np.ndarray:
    """Interpolates (z, y, x, c) numbers in [0, 1] from a lattice of 5^3, using only + and *."""
    field = numbers(seed, 5, 5, 5, width)
    for axis, count in enumerate(reversed(extent)):
        position = np.arange(count) * (4 / max(1, count - 1))
        index = np.minimum(position.astype(np.int64), 3)
        fraction = (position - index).reshape([-1 if i == axis else 1 for i in range(4)])
        a, b = field.take(index, axis), field.take(index + 1, axis)
        field = a + fraction * (b - a)
    return field


def tensor(values: np.ndarray, dtype: str) -> Tensor:
    """Returns values in a channel's dtype, rounded once."""
    if dtype == "bfloat16":
        return torch.from_numpy(values.astype(np.float32)).to(torch.bfloat16)
    if "int" in dtype:
        values = np.rint(values)
    return torch.from_numpy(values.astype(dtype))


def volumes(s: Settings, shift: float = 0.0) -> dict[str, gv.Volume]:
    """Returns the channels that a scene's shader reads; `shift` moves them along x."""
    seed, extent, look = s["seed"], s["extent"], s["look"]
    field = smooth(10 * seed, extent, s["width"])
    value = ((field - 0.5) * 1.8 + 0.5).clip(0, 1) + 0.06 * (numbers(10 * seed + 1, *field.shape))
    colors = smooth(10 * seed + 2, extent, 4)
    normal = 2 * smooth(10 * seed + 3, extent, 3) - 1
    nx, ny, nz = extent
    low, high = VALUE_RANGES[s["value"]]
    if look == "distance field":
        z, y, x = np.mgrid[0:nz, 0:ny, 0:nx].astype(np.float64)
        (cx, cy, cz), (sx, sy, sz) = ((n - 1) / 2 for n in extent), s["spacing"]
        x, y, z = (x - cx) * sx, (y - cy) * sy, (z - cz) * sz
        radius = 0.35 * min(nx * sx, ny * sy, nz * sz)
        value = (np.sqrt(x * x + y * y + z * z) - radius)[..., None] + 0.2 * value
    else:
        value = low + (high - low) * value.clip(0, 1)
        for region, part, fraction in (
            ("empty", np.s_[: max(1, nz // 3)], 0.0),
            ("constant", np.s_[:, ny // 2 :, : 2 * nx // 3], 0.6),
        ):
            if s["regions"] in (region, "both"):
                value[part] = low + (high - low) * fraction
                colors[part], normal[part] = (0.2, 0.9, 0.4, fraction / 2), (0.0, 0.6, 0.8)
    spacing, (x, *rest) = s["spacing"], s["origin"]
    placement = spacing, (x + shift, *rest)
    if look == "labels":
        fractions = (value - low) / (high - low)
        label = np.floor(fractions * s["most"]) - (low < 0)
        label = label.astype(np.int64) * 2**33 if s["wide"] else label.astype(s["value"])
        return {"value": gv.Volume(torch.from_numpy(label), *placement, labels=True)}

    def whole(dtype: str) -> float:
        return 1.0 if "float" in dtype else float(np.iinfo(dtype).max)

    channels = {"value": gv.Volume(tensor(value, s["value"]), *placement)}
    if look == "six":
        rgba = gv.Volume(tensor(colors, "float32"), *placement)
        channels["color"] = rgba.directional(dtype=getattr(torch, s["color"]))
    elif look in (*STORED, "features", "coloured isosurface", "module"):
        if look == "premultiplied":
            colors[..., :3] *= colors[..., 3:]
        channels["color"] = gv.Volume(tensor(colors * whole(s["color"]), s["color"]), *placement)
    if look in ("lit by normals", "stored by normals"):
        if s["normal"] in ("uint8", "uint16"):
            normal = 0.5 * normal + 0.5
        channels["normal"] = gv.Volume(tensor(normal * whole(s["normal"]), s["normal"]), *placement)
    return channels


class Ink(torch.nn.Module):
    """A module whose bits depend on no library: it uses only + - * / and comparisons."""

    def __init__(self, low: float, high: float) -> None:
        super().__init__()
        self.low, self.scale = low, 1 / (high - low)

    def forward(
        self, values: Tensor, positions: Tensor, directions: Tensor, lengths: Tensor
    ) -> tuple[Tensor, Tensor]:
        fraction = ((values[:, :1] - self.low) * self.scale).clamp(0, 1)
        taken = 0.4 * fraction * lengths
        side = directions[:, :1] * 0.5 + 0.5
        far = 1 / (1 + positions[:, 2:] * positions[:, 2:])
        return torch.cat((fraction, side, far), 1), taken / (1 + taken)


def transfer_of(s: Settings) -> gv.TransferFunction:
    low, high = VALUE_RANGES[s["value"]]
    opacity, color = (
        [(low + (high - low) * v, *rest) for v, *rest in s[n]] for n in ("opacity", "colors")
    )
    return gv.TransferFunction.from_points(opacity, color, s["reference"])


def light_of(s: Settings, name: str) -> Any:
    low, high = box_of(s)
    lamp = tuple(low + (high - low) * (1.2, 1.5, -0.3))
    return {
        "none": lambda: None,
        "head": lambda: gv.Headlight(s["glow"]),
        "sun": lambda: gv.DirectionalLight(s["toward"], s["glow"]),
        "wide sun": lambda: gv.DirectionalLight(s["toward"], s["glow"], angle=12.0),
        "lamp": lambda: gv.PointLight(lamp, s["glow"]),
        "wide lamp": lambda: gv.PointLight(lamp, radius=0.2 * float((high - low).max())),
    }[name]()


def shader_of(s: Settings) -> Any:
    look, transfer = s["look"], transfer_of(s)
    names = ("ambient", "diffuse", "specular", "shininess")
    lit = {"light": light_of(s, s["light"]), **dict(zip(names, s["material"], strict=True))}
    low, high = VALUE_RANGES[s["value"]]
    level = low + (high - low) * s["level"]
    if look in ("transfer", "plain"):
        return transfer
    if look in PROJECTIONS:
        return gv.Projection(look, transfer)
    if look == "labels":
        factor = 2**33 if s["wide"] else 1
        opacity = {label * factor: s["level"] ** label for label in range(0, s["most"], 2)}
        visible = None if s["level"] < 0.5 else "all"
        lit |= {"lit": s["seed"] % 4 > 0, "reference": s["reference"]}
        return gv.Labels({factor: s["glow"]}, opacity, visible, **lit)
    if look in STORED:
        lit |= {"lit": s["level"] > 0.5, "shadows": "shadows" in look}
        lit |= {"premultiplied": look == "premultiplied"}
        lit |= {"normals": "normal"} if "normals" in look else {}
        lit |= {} if look == "six" else {"reference": s["reference"]}
        return gv.StoredColor("color", **lit)
    if look == "channels":
        windows = [tuple(low + (high - low) * end for end in window) for window in s["windows"]]
        looks = [gv.ChannelLook(component=c, window=window) for c, window in enumerate(windows)]
        extra = gv.ChannelLook(component=0, transfer=transfer)
        return gv.Channels([*looks[::-1], extra], s["mode"])
    colored = gv.TransferFunction.from_points([(0, 1)], [(0, 0.2, 0.1, 0.9), (200, 1, 0.8, 0)])
    surface = lit | {"filled": s["seed"] % 2 == 0}
    return {
        "lit": lambda: gv.Lit(transfer, **lit),
        "lit by normals": lambda: gv.Lit(transfer, normals="normal", **lit),
        "lit with shadows": lambda: gv.Lit(transfer, shadows=True, **lit),
        "pre-integrated": lambda: gv.PreIntegrated(transfer),
        "isosurface": lambda: gv.Isosurface(level, s["glow"], **surface),
        "coloured isosurface": lambda: gv.Isosurface(
            level, colored, color_channel="color", color_component=s["seed"] % 4, **surface
        ),
        "distance field": lambda: gv.DistanceField(s["glow"], offset=s["level"], **surface),
        "features": lambda: gv.Features(transfer, "color"),
        "module": lambda: gv.ModuleShader(
            Ink(low, high), ("value", "color"), hidden_by=transfer if s["level"] > 0.5 else None
        ),
        "transfer module": lambda: gv.ModuleShader(gv.TransferModule(transfer, min(s["spacing"]))),
    }[look]()


def box_of(s: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Returns the world corners of the scene."""
    extent, spacing, origin = (np.array(s[n], np.float64) for n in ("extent", "spacing", "origin"))
    low = origin - 0.5 * spacing
    return low, low + extent * spacing


def unit(v: np.ndarray) -> np.ndarray:
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return v / np.sqrt(x * x + y * y + z * z)[..., None]


def camera_of(s: Settings) -> gv.Camera | gv.Rays:
    low, high = box_of(s)
    (width, height), kind, side = s["size"], s["camera"], float((high - low).max())
    centre, direction = (low + high) / 2, unit(np.array(s["from"]))
    eye = centre + direction * (0.1 if s["inside"] else 0.3 + s["away"]) * side
    target = centre + np.array(s["aim"]) * side
    if kind in ("orbit", "batch"):
        distance = 0.2 if s["inside"] else 0.3 + s["away"]
        turn = 40 * s["fov"]
        turns = turn
        if kind == "batch":
            turns = torch.tensor([turn, turn + 70], dtype=torch.float64, device="cpu")
        return gv.Camera.orbit(turns, 100 * s["aim"][0], distance, s["fov"], width, height)
    if kind in ("directions", "rays"):
        return _own_rays(s, eye, target)
    model = kind.removeprefix("bent ")
    fov = {"fisheye": 2 * s["fov"], "panorama": 3 * s["fov"]}.get(model, s["fov"])
    up = (0.0, 0.0, 1.0) if s["aim"][1] > 0 else (0.1, 1.0, 0.2)
    camera = gv.Camera.look_at(tuple(eye), tuple(target), up, fov, width, height, model)
    if kind == "bent fisheye":
        bend = (0.05, -0.01, 0.002, 0.0)
        parts = camera.viewmats[0], camera.Ks[0], width, height
        camera = gv.Camera(*parts, model="fisheye", radial_coeffs=bend, max_angle=80.0)
    return camera


def _own_rays(s: Settings, eye: np.ndarray, target: np.ndarray) -> gv.Camera | gv.Rays:
    """Returns custom rays through a window, from origins that differ a little."""
    width, height = s["size"]
    forward = unit(target - eye)
    right = unit(np.array((forward[1], -forward[0] - 0.2, 0.1)))
    down = np.array(
        [forward[i - 2] * right[i - 1] - forward[i - 1] * right[i - 2] for i in range(3)]
    )
    v, u = np.mgrid[0:height, 0:width] * (0.8 / height) - 0.4
    offset = u[..., None] * right + v[..., None] * down
    direction, origin = unit(forward + offset), eye + 0.1 * offset
    pixel = 0.8 / height
    cone = {"pixel": (0.0, pixel), "wide": (0.1, 4 * pixel), "finest": (0.0, 0.0)}[s["cone"]]
    low, high = box_of(s)
    side = float((high - low).max())
    depth = (0.3 + s["away"]) * side
    span = (0.05 * side, 0.3 * side) if s["inside"] else (depth - 0.3 * side, depth + 0.1 * side)
    ends = span if s["ends"] else (0.0, math.inf)
    if s["camera"] == "directions":
        vectors = [torch.from_numpy(part) for part in (origin, direction)]
        cone_tensor = None if s["cone"] == "pixel" else torch.tensor(cone, device="cpu")
        limits = torch.tensor(ends, dtype=torch.float64, device="cpu")
        return gv.CustomCamera.from_directions(*vectors, cone=cone_tensor, range=limits)
    count = width * height
    columns = {
        "origin": origin.reshape(-1, 3),
        "direction": direction.reshape(-1, 3),
        "cone": np.broadcast_to(cone, (count, 2)),
        "range": np.broadcast_to(ends, (count, 2)),
    }
    rays = {n: torch.from_numpy(c.astype(s["rays"])) for n, c in columns.items()}
    return gv.Rays(**rays, width=width if s["rows"] else 0)


def clip_of(s: Settings) -> gv.Clip:
    low, high = box_of(s)
    centre, side = (low + high) / 2, float((high - low).max())
    inside, scale = s["clip_in"] == "box", 1.0 if s["clip_in"] == "box" else side
    middle = np.zeros(3) if inside else centre

    def corners(a: float, b: float) -> list[list[float]]:
        return [(middle + scale * np.array((x, x, x))).tolist() for x in (a, b)]

    def plane(a: float, b: float, c: float, d: float) -> list[float]:
        return [a, b, c, d * scale - float(a * middle[0] + b * middle[1] + c * middle[2])]

    matrix = np.array(
        [[0.6, 0.1, 0, -0.3], [0, 0.5, 0.2, -0.35], [-0.1, 0, 0.7, -0.2], [0, 0, 0, 1]]
    )
    matrix[:3] *= scale
    matrix[:3, 3] += middle
    args: dict[str, Any] = {
        "planes": {"planes": [plane(0, 0, -1, 0.1), plane(1, 0.5, 0.2, 0.2)]},
        "box": {"boxes": [corners(-0.3, 0.25)]},
        "boxes": {"boxes": [corners(-0.4, -0.05), corners(0.05, 0.4), corners(-0.1, 0.1)]},
        "matrix": {"boxes": [matrix], "planes": [plane(0, 1, 0, 0.3)]},
        "without": {"without": [corners(-0.2, 0.2), corners(0.1, 0.6)]},
    }[s["clip"]]
    opacity, light = s["cap"]
    return gv.Clip(**args, frame=s["clip_in"], caps=s["caps"], cap_opacity=opacity, cap_light=light)


def pixels_of(s: Settings) -> tuple[int, ...]:
    """Returns the shape of the scene's picture."""
    width, height = s["size"]
    if s["camera"] == "rays" and not s["rows"]:
        return (1, width * height)
    return (2, height, width) if s["camera"] == "batch" else (height, width)


def layer_of(s: Settings) -> gv.Layer:
    low, high = box_of(s)
    shape, side = pixels_of(s), float((high - low).max())
    draws = numbers(10 * s["seed"] + 4, *shape, 5)
    depth = (s["away"] * draws[..., 3:4] + 0.2) * side
    depth[draws[..., 4:] > 0.7] = math.inf
    alpha = None
    if s["layer"] == "translucent":
        alpha = torch.from_numpy(draws[..., 4:].astype(np.float32))
    color = torch.from_numpy(draws[..., :3].astype(np.float32))
    return gv.Layer(color, torch.from_numpy(depth.astype(np.float32)), alpha)


def options_of(s: Settings) -> dict[str, Any]:
    """Returns fields of `gv.RenderOptions`."""
    low, high = box_of(s)
    side = float((high - low).max())
    fields: dict[str, Any] = {n: s[n] for n in ("lod", "step", "stop_alpha", "depth_alpha")}
    fields |= {"cone_scale": s["cone_scale"], "component": s["component"]}
    fields |= {"dtype": getattr(torch, s["dtype"]), "channel": "value"}
    if "clip" in s:
        fields["clip"] = clip_of(s)
    if "lens" in s:
        aperture, focus, frame = s["lens"]
        scale = 1.0 if frame == "box" else side
        fields["lens"] = gv.ThinLens(aperture=aperture * scale, focus=focus * scale, frame=frame)
    if "lighting" in s:
        cones = {"shadow_cones": 3, "shadows": 0.8}
        cone_count = {"cones": 2 + s["seed"] % 4}  # what the cones read must fit in small pools
        occlusion = cone_count | {"occlusion": 0.8}
        bounce = cone_count | {"indirect": 0.7, "ambient": (0.5, 0.6, 0.7)}
        arguments = {
            "shadows": {},
            "cones": cones,
            "occlusion": occlusion,
            "indirect": bounce,
            "everything": cones | occlusion | bounce,
        }[s["lighting"]]
        lights = [light_of(s, name) for name in s["lamps"]] or None
        fields["lighting"] = gv.Lighting(lights=lights, reach=s["reach"], frame="box", **arguments)
    if "layer" in s:
        fields["layer"] = layer_of(s)
    image = numbers(10 * s["seed"] + 5, *pixels_of(s), 3).astype(np.float32)
    fields["background"] = {
        "black": (0.0, 0.0, 0.0),
        "color": (0.1, 0.5, 0.9),
        "gradient": gv.Gradient((0.2, 0.4, 1.0), (1.0, 0.5, 0.0)),
        "image": torch.from_numpy(image),
        "none": None,
    }[s.get("background", "black")]
    return fields
