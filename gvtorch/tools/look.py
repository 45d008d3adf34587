"""`Look`: the flags that say how a scene is shown, of `gvtorch render` and `gvtorch fly`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from ..base.declared import declared_names
from .common import numbers
from .image import parse_background
from .light import parse_lighting

if TYPE_CHECKING:
    import torch

    from ..cameras import Camera
    from ..cameras.models import CameraModel
    from ..shaders import Shader, TransferFunction
    from ..tracing import Clip, ThinLens

    ShaderName = str
else:
    CameraModel = str  # checked by the camera, since its module would load torch
    ShaderName = Literal[(*declared_names("shaders.built_in", "BY_NAME"), "filtered", "labels")]


@dataclass(frozen=True, kw_only=True)
class Look:
    """How it is shown."""

    camera_model: Annotated[CameraModel, arg(metavar="MODEL")] = "pinhole"
    """pinhole, ortho (parallel), fisheye (equidistant) or panorama (equirectangular)"""
    fov: Annotated[float | None, arg(metavar="DEG")] = None
    """vertical field of view; 30, or 180 of a fisheye or panorama, if left out"""
    size: Annotated[str, arg(metavar="WxH")] = "512x512"
    """pixels"""
    tf: Annotated[str | None, arg(metavar="FILE|PRESET")] = None
    """transfer function: a JSON file, or a preset over the data's range: gray, hot, vessels, bone,
    tissue; gray if left out, or the function of a store's filtered colours"""
    shader: ShaderName = "plain"
    """what is made of the values; filtered: plain, but right from afar (stores: gvtorch filter);
    labels: each in its colour, also if left out where there are labels"""
    value: Annotated[float | None, arg(metavar="VALUE")] = None
    """of the isosurface"""
    step: Annotated[float, arg(metavar="VOXELS")] = 0.5
    """distance between samples"""
    lod: Literal["auto", "finest"] = "auto"
    """auto: voxels as wide as a pixel's cone; finest: the data as it is"""
    background: Annotated[str, arg(metavar="R,G,B|FILE")] = "0,0,0"
    """linear, 0 to 1; R,G,B/R,G,B from top to bottom; transparent; or an environment map, PNG, EXR,
    TIFF or NPY"""
    stop_alpha: Annotated[float, arg(metavar="ALPHA")] = 0.99
    """a ray ends at this alpha; 1 integrates to the end"""
    clip: Annotated[str | None, arg(metavar="KIND:NUMBERS;...")] = None
    """what is kept: plane:A,B,C,D where A x + B y + C z + D >= 0; box:X,Y,Z,X,Y,Z (low corner, high
    corner); cut:X,Y,Z,X,Y,Z goes; caps draws the cut as a surface; in largest sides of the box,
    its centre is 0"""
    lens: Annotated[str | None, arg(metavar="APERTURE,FOCUS")] = None
    """depth of field: diameter of the lens and distance that is sharp, in largest sides of the
    box"""
    lighting: Annotated[str | None, arg(metavar="KIND:NUMBERS;...")] = None
    """of the lit shaders: sun:X,Y,Z,DEGREES (the way it shines, how wide it looks);
    lamp:X,Y,Z,RADIUS (world units); sky:R,G,B; shadows:, occlusion:, indirect:, factors; reach:, of
    the last two, in largest sides of the box"""
    component: Annotated[int, arg(metavar="N")] = 0
    """which number of a voxel is shown"""
    brick_size: Annotated[int, arg(metavar="VOXELS")] = 8
    """side of a brick"""
    border: Annotated[int, arg(metavar="VOXELS")] = 1
    """voxels around a brick"""
    backend: Literal["auto", "reference", "cpp", "cuda"] = "auto"
    """what traces the rays"""

    def options(self) -> dict[str, Any]:
        """Fields of `RenderOptions`."""
        return {
            "step": self.step,
            "lod": self.lod,
            "background": parse_background(self.background),
            "stop_alpha": self.stop_alpha,
            "clip": parse_clip(self.clip) if self.clip else None,
            "lens": parse_lens(self.lens) if self.lens else None,
            "lighting": parse_lighting(self.lighting) if self.lighting else None,
            "component": self.component,
            "backend": self.backend,
        }

    def device(self) -> torch.device:
        """CUDA where the backend runs there."""
        import torch

        from ..ops import available
        from ..ops.trace import choose_backend

        wants_cuda = self.backend == "cuda" or (self.backend == "auto" and not available()["cuda"])
        device = torch.device("cuda" if wants_cuda else "cpu")
        choose_backend(self.backend, device)
        return device

    def chosen(self, low: float, high: float, labels: bool = False) -> Shader:
        """Returns the shader asked for, its transfer function read or spanned over the range; of
        labels, theirs.
        """
        from ..shaders import Filtered, Labels
        from ..shaders.built_in import BY_NAME

        if self.shader == "labels" or (labels and self.shader == "plain"):
            if self.tf is not None or self.value is not None:
                flag = "--tf" if self.value is None else "--value"
                raise ValueError(f"{flag} is for values; labels have colours of their own")
            return Labels()
        transfer = parse_transfer(self.tf or "gray", low, high)
        if (self.value is None) == (self.shader == "isosurface"):
            raise ValueError("--value and --shader isosurface belong together")
        if self.shader == "filtered":  # its colours are made with the tree
            return Filtered(transfer, component=self.component)
        return BY_NAME[self.shader](transfer, self.value or 0.0)


def parse_transfer(text: str, low: float, high: float) -> TransferFunction:
    """Reads a transfer function from a JSON file, or spans a preset over the range."""
    from ..shaders import TransferFunction

    if text.endswith(".json") or Path(text).is_file():
        return TransferFunction.from_json(text)
    return TransferFunction.preset(text, low, high)


def parse_camera(
    text: str,
    up: str,
    fov: float | None,
    width: int,
    height: int,
    model: CameraModel = "pinhole",
) -> Camera:
    """Makes a camera from `orbit:AZ,EL,DIST` or `look:ex,ey,ez,tx,ty,tz`.

    Raises:
        ValueError: The text is neither, or a number is out of its range.
    """
    from ..cameras import Camera

    kind, _, rest = text.partition(":")
    if kind == "orbit":
        azimuth, elevation, distance = numbers("--camera orbit", rest, 3, float)
        return Camera.orbit(azimuth, elevation, distance, fov, width, height, model)
    if kind == "look":
        values = numbers("--camera look", rest, 6, float)
        upward = numbers("--up", up, 3, float)
        return Camera.look_at(values[:3], values[3:], upward, fov, width, height, model)
    raise ValueError(f"--camera must be orbit:AZ,EL,DIST or look:ex,ey,ez,tx,ty,tz, got {text!r}")


def parse_clip(text: str) -> Clip:
    """Makes a clip from items such as `plane:0,0,1,0;cut:0,0,0,1,1,1;caps`.

    Raises:
        ValueError: An item is of no known kind, or its numbers are refused by `Clip`.
    """
    from ..tracing import Clip

    found: dict[str, list[Any]] = {"plane": [], "box": [], "cut": []}
    caps = False
    for item in text.split(";"):
        kind, _, rest = item.strip().partition(":")
        if kind == "caps" and not rest:
            caps = True
        elif kind in found:
            values = numbers(f"--clip {kind}", rest, 4 if kind == "plane" else 6, float)
            found[kind].append(values if kind == "plane" else (values[:3], values[3:]))
        else:
            raise ValueError(f"--clip must hold plane:, box:, cut: or caps, got {item.strip()!r}")
    return Clip(
        planes=found["plane"], boxes=found["box"], without=found["cut"], frame="box", caps=caps
    )


def parse_lens(text: str) -> ThinLens:
    """Makes a lens from `APERTURE,FOCUS`."""
    from ..tracing import ThinLens

    aperture, focus = numbers("--lens", text, 2, float)
    return ThinLens(aperture=aperture, focus=focus, frame="box")
