"""`Look`: the flags that say how a scene is shown, of `gvtorch view`, `render` and `fly`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ..base.declared import declared_names, declared_texts
from ..base.image_info import SIGNED_DISTANCE, up_and_front
from .common import given_flags, option, parse_numbers
from .parse import (
    parse_background,
    parse_channels,
    parse_clip,
    parse_lens,
    parse_lighting,
    parse_transfer,
)

if TYPE_CHECKING:
    import torch

    from ..base.volume import Volume
    from ..cameras import Camera
    from ..cameras.models import CameraModel
    from ..cameras.poses import Up
    from ..io.stores.store import Store
    from ..shaders import Shader

    ShaderName = str
else:
    CameraModel = str  # checked by the camera, since its module would load torch
    ShaderName = Literal[
        (
            *declared_names("shaders.built_in", "BY_NAME"),
            *("filtered", "filtered-lit", "channels", "labels", "colors"),
        )
    ]

_STATE_FIELDS = {  # fields that a part of a saved state sets too
    "shader": ("tf", "window", "shader", "channel", "value"),
    "camera": ("camera_model", "fov", "up"),
    "component": ("component",),
}


def _shader_help() -> str:
    """Returns what each shader shows; equal texts in a row are told once."""
    texts = declared_texts("shaders.built_in", "BY_NAME")
    parts = [", ".join(names) + f": {text}" for text, names in groupby(texts, texts.__getitem__)]
    return "; ".join(
        (
            *parts,
            "filtered, filtered-lit: as plain and lit, but correct from afar (stores need gvtorch "
            "filter, or gvtorch filter --lit)",
            "channels: all numbers of a voxel, see --channel",
            "labels: one colour each, the default for labels",
            "colors: those stored for a mesh, lit (by its normals, if stored), the default for "
            "these",
        )
    )


@dataclass(frozen=True, kw_only=True)
class Look:
    """How the scene is shown."""

    # pinhole, ortho (parallel), fisheye (equidistant) or panorama (equirectangular)
    camera_model: Annotated[CameraModel, option(metavar="MODEL")] = "pinhole"
    # vertical field of view in degrees; if left out: 30, or 180 for fisheye and panorama
    fov: Annotated[float | None, option(metavar="DEG")] = None
    # up direction in the picture: +x, -x, +y, -y, +z, -z or X,Y,Z; if left out: +z, the head, for
    # scans of patients, else +y
    up: Annotated[str | None, option(metavar="+z|X,Y,Z")] = None
    # transfer function: gray, hot, vessels, bone, tissue, mr, em, cloud or galaxy; ct-bone,
    # ct-soft, ct-lung or ct-vessels (in Hounsfield units); a matplotlib colour map; or a file of
    # gvtorch, ParaView or 3D Slicer (.json, .vp, .xml), with FILE:NAME for one preset in it; if
    # left out: gray, or the function of a store's filtered colours
    tf: Annotated[str | None, option(metavar="FILE|PRESET")] = None
    # values that the transfer function is stretched over: LO,HI; percentiles P%,P%; full (the whole
    # range); or auto (by the histogram, without its background); if left out: auto, except for ct-
    # presets and files with values of their own
    window: Annotated[str | None, option(metavar="LO,HI")] = None
    shader: Annotated[ShaderName, option(help=_shader_help())] = "plain"
    # channels to show with --shader channels: number or name, colour (a name or #RRGGBB) and
    # window; parts left out or auto come from the file, or are chosen; the item opacity makes
    # channels hide each other instead of adding up
    channel: Annotated[str | None, option(metavar="N:COLOR:LO,HI;...")] = None
    # value of the surface, for --shader isosurface; signed distances (level sets, and --channel
    # distance of gvtorch voxelize) are solid below it, and shown so at 0 without --tf and --window
    value: Annotated[float | None, option(metavar="VALUE")] = None
    # distance between samples along a ray, in voxels of the finest level
    step: Annotated[float, option(metavar="VOXELS")] = 0.5
    # auto: level whose voxels are as wide as a pixel's cone; finest: the finest level everywhere
    lod: Literal["auto", "finest"] = "auto"
    # factor that widens a pixel's cone: larger values use coarser voxels; if left out: 4/3;
    # with --samples 16, 0.33 (a quarter of it) shows the finest detail
    cone_scale: Annotated[float | None, option(metavar="FACTOR")] = None
    # linear colour, 0 to 1; R,G,B/R,G,B (top to bottom); transparent; or an environment map (PNG,
    # EXR, TIFF or NPY)
    background: Annotated[str, option(metavar="R,G,B|FILE")] = "0,0,0"
    # alpha at which a ray ends; 1 integrates to the end
    stop_alpha: Annotated[float, option(metavar="ALPHA")] = 0.99
    # region to keep: plane:A,B,C,D keeps where A x + B y + C z + D >= 0; box:X,Y,Z,X,Y,Z (low
    # corner, high corner) keeps a box; cut:X,Y,Z,X,Y,Z removes one; caps fills the cut with a
    # surface; in largest sides of the scene's box, from its centre
    clip: Annotated[str | None, option(metavar="KIND:NUMBERS;...")] = None
    # depth of field: diameter of the lens and distance in focus, in largest sides of the scene's
    # box
    lens: Annotated[str | None, option(metavar="APERTURE,FOCUS")] = None
    # for lit shaders: sun:X,Y,Z,DEGREES (direction of its light, angular diameter);
    # lamp:X,Y,Z,RADIUS (world units); sky:R,G,B (ambient light); shadows: and
    # occlusion: (strength, 0 to 1); indirect: (factor); reach: (distance for occlusion
    # and indirect, in largest sides of the scene's box)
    lighting: Annotated[str | None, option(metavar="KIND:NUMBERS;...")] = None
    # index of the number to show, for voxels with several
    component: Annotated[int, option(metavar="N")] = 0
    # voxels along a side of a brick
    brick_size: Annotated[int, option(metavar="VOXELS")] = 8
    # voxels of overlap around a brick; if left out: 1, or 2 for labels, to smooth slanted faces
    border: Annotated[int | None, option(metavar="VOXELS")] = None
    # implementation that traces the rays; auto: cuda if available, else cpp, else reference
    backend: Literal["auto", "reference", "cpp", "cuda"] = "auto"

    def options(self) -> dict[str, Any]:
        """Returns fields of `RenderOptions`."""
        if self.stop_alpha != Look().stop_alpha and not self._accumulates():
            raise ValueError(f"--stop-alpha is for what adds up along a ray, not for {self.shader}")
        if self.cone_scale is not None and self.lod == "finest" and self.lighting is None:
            raise ValueError("--cone-scale is for --lod auto, or for the cones of --lighting")
        names = ("step", "lod", "stop_alpha", "component", "backend")
        return {
            **{name: getattr(self, name) for name in names},
            **({} if self.cone_scale is None else {"cone_scale": self.cone_scale}),
            "background": parse_background(self.background),
            "clip": None if self.clip is None else parse_clip(self.clip),
            "lens": None if self.lens is None else parse_lens(self.lens),
            "lighting": None if self.lighting is None else parse_lighting(self.lighting),
        }

    def _accumulates(self) -> bool:
        """Whether colours add up along a ray, until its alpha reaches --stop-alpha."""
        from ..shaders import TransferFunction
        from ..shaders.built_in import BY_NAME, named_shader

        if self.shader not in BY_NAME:
            return True
        shader = named_shader(self.shader, TransferFunction([(0, 1)]))
        return shader.projection is None and shader.cut_surface() is None

    def files(self) -> dict[str, str | None]:
        """Returns the files that are read in addition to the volume, by flag."""
        return {"--tf": self.tf, "--background": self.background}

    def check_state(
        self,
        state_flag: str,
        state: Mapping[str, Any],
        other_flags: Sequence[str] = (),
        camera: str | None = None,
    ) -> None:
        """Raises ValueError if a flag would have no effect, because a saved state sets the same.

        Args:
            state_flag: The flag that gives the state.
            state: The state's fields, unchecked.
            other_flags: Further given flags that any state sets.
            camera: Value of --camera.
        """
        parts = [part for part in _STATE_FIELDS if state.get(part) is not None]
        fields = {name for part in parts for name in _STATE_FIELDS[part]}
        fields |= set(state.get("options", ()))
        flags = [*other_flags, *["--camera"] * (camera is not None and "camera" in parts)]
        flags += [flag for flag in given_flags(self) if flag[2:].replace("-", "_") in fields]
        if flags:
            raise ValueError(f"{state_flag} sets what {flags[0]} sets: leave one out")

    def device(self) -> torch.device:
        """Returns the device that the backend needs; ValueError if it can't be used here."""
        from ..ops.registry import choose_backend, device_of

        device = device_of(self.backend)
        choose_backend(self.backend, device)
        return device

    def brick_layout(self, data: Volume | Store) -> tuple[int, int]:
        """Returns the side of a brick, and the voxels around it."""
        border = data.info.default_border if self.border is None else self.border
        return self.brick_size, border

    def up_direction(self) -> Up | None:
        """Returns the up direction of `--up`, or None if it is left out."""
        if self.up is None or (self.up[:1] in ("+", "-") and self.up[1:].isalpha()):
            return self.up
        if self.up in ("x", "y", "z"):
            return f"+{self.up}"
        if "," not in self.up:
            raise ValueError(f"--up must be +x, -x, +y, -y, +z, -z or X,Y,Z, got {self.up!r}")
        return parse_numbers("--up", self.up, 3, float)

    def refuse_flags(self, reason: str, *more_names: str) -> None:
        """Raises ValueError if a flag of transfer functions, or one of `more_names`, is given."""
        for name in ("tf", "window", "value", *more_names):
            if getattr(self, name) != getattr(Look(), name):
                raise ValueError(f"--{name} is not for --shader {self.shader}: {reason}")

    def make_shader(self, data: Volume | Store) -> Shader:
        """Returns the shader that the flags choose, with its transfer function read from a file or
        stretched over the data; `Labels` for data that holds labels, and the surface of signed
        distances.
        """
        from ..shaders import DistanceField, Filtered, Isosurface, Labels, Lit
        from ..shaders.built_in import named_shader

        if self.shader == "channels":
            self.refuse_flags("it takes --channel", "component")
            return parse_channels(self.channel, data)
        if self.channel is not None:
            raise ValueError("--channel is for --shader channels")
        if self.shader == "colors":
            raise ValueError("--shader colors is for stores of meshes: --channels color,normal")
        if self.shader == "labels" or (self.shader == "plain" and data.info.labels):
            self.refuse_flags("labels have colours of their own")
            data.info.check_component("--component", self.component, data.width)
            return Labels()
        if (self.value is None) == (self.shader == "isosurface"):
            raise ValueError("--value and --shader isosurface belong together")
        is_distance = data.info.quantity == SIGNED_DISTANCE
        is_default = (self.shader, self.tf, self.window) == ("plain", None, None)
        if self.shader == "isosurface" or (is_distance and is_default):
            for flag, value in (("--tf", self.tf), ("--window", self.window)):
                if value is not None:
                    raise ValueError(f"{flag} is for values: an isosurface has one")
            data.info.check_component("--component", self.component, data.width)
            level = self.value or 0.0
            return DistanceField(offset=level) if is_distance else Isosurface(level)
        _warn_of_other_channels(data, self.component)
        transfer = parse_transfer(self.tf, self.window, data, self.component)
        if self.shader in ("filtered", "filtered-lit"):  # its colours are made with the tree
            lit_or_plain = Lit(transfer) if self.shader == "filtered-lit" else transfer
            return Filtered(lit_or_plain, component=self.component)
        return named_shader(self.shader, transfer)


def _warn_of_other_channels(data: Volume | Store, component: int) -> None:
    """Warns if the first of several channels is shown, as it is by default."""
    names = [channel.name for channel in data.info.channels]
    if len(names) > 1 and component == 0:
        first_name = f" ({names[0]})" if names[0] else ""
        warnings.warn(
            f"channel 0{first_name} of {len(names)} is shown: --component N shows another, "
            "--shader channels all",
            stacklevel=2,
        )


def parse_orbit(flag: str, text: str) -> tuple[float, float, float | None]:
    """Returns azimuth, elevation and distance of AZ,EL, AZ,EL,fit or AZ,EL,DIST; the distance is
    None if the whole box is to be in the picture. Raises ValueError for any other text.
    """
    numbers = text.removesuffix(",fit")
    count = numbers.count(",") + 1
    if count not in (2, 3) or (count == 3 and numbers != text):
        raise ValueError(f"{flag} must be AZ,EL or AZ,EL,DIST, got {text!r}")
    azimuth, elevation, *distance = parse_numbers(flag, numbers, count, float)
    return azimuth, elevation, distance[0] if distance else None


def default_orbit(space: str | None) -> str:
    """Returns AZ,EL of the default camera: a little from the side, and from above."""
    return f"{up_and_front(space)[1] + 30:g},20"


def parse_camera(
    text: str | None, look: Look, width: int, height: int, space: str | None = None
) -> Camera:
    """Makes a camera from `orbit:AZ,EL`, `orbit:AZ,EL,DIST`, `look:ex,ey,ez,tx,ty,tz`, or
    `file:PATH` or `file:PATH,NAME`; the defaults of the up direction and of the position depend on
    `space` (see `up_and_front`). Raises ValueError for anything else.
    """
    from ..cameras import Camera

    up = look.up_direction() or up_and_front(space)[0]
    projection = (look.fov, width, height, look.camera_model)
    text = f"orbit:{default_orbit(space)}" if text is None else text
    kind, _, rest = text.partition(":")
    if kind == "orbit":
        azimuth, elevation, distance = parse_orbit("--camera orbit", rest)
        fit = distance is None
        return Camera.orbit(azimuth, elevation, distance, *projection, up=up, fit=fit)
    if kind == "look":
        values = parse_numbers("--camera look", rest, 6, float)
        return Camera.look_at(values[:3], values[3:], up, *projection)
    if kind == "file":
        return _camera_of_file(rest, look, width, height)
    raise ValueError(
        "--camera must be orbit:AZ,EL, orbit:AZ,EL,DIST, look:ex,ey,ez,tx,ty,tz or file:PATH, "
        f"got {text!r}"
    )


def _camera_of_file(text: str, look: Look, width: int, height: int) -> Camera:
    """Returns the only camera of PATH, or the camera NAME of PATH,NAME."""
    from ..cameras import read_cameras

    model = None if look.camera_model == "pinhole" else look.camera_model
    for flag, value in (("--fov", look.fov), ("--up", look.up), ("--camera-model", model)):
        if value is not None:
            raise ValueError(f"--camera file: sets what {flag} sets: leave one out")
    path, comma, name = text.rpartition(",")
    if not comma or Path(text).exists():
        path, name = text, ""
    cameras = read_cameras(path, width=width, height=height)
    if not name and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name not in cameras:
        listing = ", ".join(list(cameras)[:5]) + (", ..." if len(cameras) > 5 else "")
        raise ValueError(f"--camera file:{path},NAME must name one of {listing}, got {name!r}")
    return cameras[name]
