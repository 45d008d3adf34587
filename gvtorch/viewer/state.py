"""`ViewState`: all that a view shows, as one JSON; `Eye`, its camera. `gvtorch view --state FILE`,
`gvtorch render --state FILE` and the page share this format.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from pathlib import Path
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from ..base import check
from ..base.image_info import up_and_front
from ..base.messages import one_line
from ..base.records import RenderStats
from ..base.whole_file import write_text
from ..cameras import Camera
from ..cameras.models import MODELS, CameraModel, model_of
from ..cameras.poses import Up, upward
from ..engine import Engine
from ..pictures import Picture, Progressive
from ..pictures.tone import ToneCurve, checked_curve
from ..pool import N3Tree
from ..shaders import Shader, TransferFunction
from ..shaders.channels import window_of
from ..tracing import Cost, RenderOptions, render
from .schema import decode, encode

Triple = tuple[float, float, float]
_MAX_COORDINATE = 1e30  # largest coordinate, so that a ray's numbers stay finite
_MIN_DISTANCE = 1e-100  # from eye to target, so that its square does not become 0
Show = Literal["picture", "samples", "nodes", "lod", "age", "fill"]


@dataclass(frozen=True, kw_only=True)
class Eye:
    """Where a camera stands, in world units.

    Attributes:
        eye: Position of the camera.
        target: Point in the middle of the picture; an orthographic camera shows as much as a
            pinhole camera does at this distance.
        up: Direction that is up in the picture.
        fov: Vertical field of view, degrees.
        model: pinhole, ortho, fisheye or panorama.
    """

    eye: Triple
    target: Triple
    up: Triple = (0.0, 1.0, 0.0)
    fov: float = 30.0
    model: CameraModel = "pinhole"

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            vars(self)[name] = check.triple("Eye", name, getattr(self, name))
        vars(self)["fov"] = model_of("Eye", self.model).checked_fov("Eye", self.fov)
        if max(abs(number) for number in (*self.eye, *self.target, *self.up)) > _MAX_COORDINATE:
            raise ValueError(f"Eye: eye, target and up must be at most {_MAX_COORDINATE:g}")
        if math.dist(self.eye, self.target) < _MIN_DISTANCE or not any(self.up):
            raise ValueError("Eye: eye and target must differ, and up must not be zero")

    def camera(self, width: int, height: int, box: Tensor) -> Camera:
        """Returns the camera; an orthographic one is moved back until all of the (2, 3) box is in
        front of it.
        """
        camera = Camera.look_at(self.eye, self.target, self.up, self.fov, width, height, self.model)
        if MODELS[self.model].parallel:
            corners = torch.cartesian_prod(*box.T.to(torch.float64))  # (8, 3)
            rotation, translation = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
            nearest = float((corners @ rotation.mT + translation)[:, 2].min())
            camera.viewmats[0, 2, 3] += max(0.0, 0.02 * float((box[1] - box[0]).max()) - nearest)
        return camera

    @classmethod
    def of(cls, camera: Camera, box: Tensor) -> Self:
        """Returns the eye of a camera, given the scene's (2, 3) box; its target is the point of the
        view axis nearest to the middle of the box.

        Raises:
            ValueError: The camera is a batch.
        """
        if camera.batched:
            raise ValueError(f"view: camera must be one, got a batch of {len(camera)}")
        placed = camera.placed(box)
        rotation, translation = placed.viewmats[0, :3, :3], placed.viewmats[0, :3, 3]
        eye, forward = -(rotation.mT @ translation), rotation[2]
        distance = float((box.mean(0) - eye) @ forward)
        distance = distance if distance > 0 else float((box[1] - box[0]).max())
        model, focal = placed.model, float(placed.Ks[0, 1, 1])
        half_height = 0.5 * placed.height / focal
        if MODELS[model].parallel:
            fov = 30.0
            distance = half_height / math.tan(math.radians(fov / 2))
            eye = eye + forward * (float((box.mean(0) - eye) @ forward) - distance)
        else:
            is_planar = MODELS[model].planar
            fov = math.degrees(2 * math.atan(half_height) if is_planar else 2 * half_height)
        vectors = {"eye": eye, "target": eye + distance * forward, "up": -rotation[1]}
        triples: Any = {name: tuple(vector.tolist()) for name, vector in vectors.items()}
        return cls(**triples, fov=round(fov, 9), model=model)

    @classmethod
    def first(
        cls, box: Tensor, width: int, height: int, up: Up | None = None, space: str | None = None
    ) -> Self:
        """Returns the default eye: it sees the whole (2, 3) box, in a picture of such a shape; a
        patient, whom `ImageInfo.space` tells, upright and from the front.
        """
        default_up, front = up_and_front(space)
        up = default_up if up is None else up
        camera = Camera.orbit(front + 30, 20, width=width, height=height, up=up, fit=True)
        return replace(cls.of(camera, box), up=tuple(upward("view", up).tolist()))

    def fitted(self, box: Tensor, width: int, height: int) -> Self:
        """Returns the eye that looks the same way and sees the whole (2, 3) box."""
        eye, target = torch.tensor((self.eye, self.target), dtype=torch.float64, device="cpu")
        centre, radius = box.mean(0), float((box[1] - box[0]).norm()) / 2
        half_angle = math.radians(min(self.fov, 100.0)) / 2
        aspect = min(1.0, max(1, width) / max(1, height))
        distance = radius / max(1e-3, math.sin(half_angle)) / aspect
        position = centre - (target - eye) / (target - eye).norm() * distance
        return replace(self, eye=tuple(position.tolist()), target=tuple(centre.tolist()))


@dataclass(frozen=True, kw_only=True)
class Development:
    """How a picture at rest is developed.

    Attributes:
        samples: Rays a pixel of a picture at rest.
        tone: Curve from the light of the scene to the display: none, reinhard or aces.
        exposure: Stops: the light is multiplied by 2^exposure first.
    """

    samples: int = 16
    tone: ToneCurve = "none"
    exposure: float = 0.0

    def __post_init__(self) -> None:
        samples = check.integer("Development", "samples", self.samples, low=1, high=65536)
        exposure = checked_curve("Development", self.tone, self.exposure)
        vars(self).update(samples=samples, exposure=exposure)

    def develop(self, picture: Picture) -> Picture:
        """Returns the picture with its light mapped to the display."""
        if self.tone == "none" and self.exposure == 0:
            return picture
        return picture.tone_map(self.tone, exposure=self.exposure)

    def take(self, render: Callable[[Camera], Picture], camera: Camera) -> Picture:
        """Renders the picture of a camera at rest: the mean of all samples, developed. Its
        statistics have the times, rays and samples of all of them.
        """
        if self.samples == 1:
            return self.develop(render(camera))
        stats: list[RenderStats] = []

        def counted(view: Camera) -> Picture:
            picture = render(view)
            stats.append(picture.stats)
            return picture

        mean = Progressive(counted).refine(camera, self.samples)
        total = reduce(lambda before, now: now.after(before), stats)
        return self.develop(replace(mean, stats=total))


@dataclass(frozen=True, kw_only=True)
class Slices:
    """Three planes of voxels beside the picture, exact to the voxel (`gv.slice_picture`).

    Attributes:
        position: World position through which they go; the middle of the box if left out.
        window: Values shown as black and white; found automatically if left out.
        colors: Grays, or the colours of the shader (without its opacity). Labels always have
            theirs.
    """

    position: Triple | None = None
    window: tuple[float, float] | None = None
    colors: Literal["gray", "shader"] = "gray"

    def __post_init__(self) -> None:
        if self.position is not None:
            vars(self)["position"] = check.triple("Slices", "position", self.position)
        if self.window is not None:
            vars(self)["window"] = window_of("Slices", self.window)
        check.one_of("Slices", "colors", self.colors, ("gray", "shader"))


@dataclass(frozen=True, kw_only=True)
class ViewState:
    """All that a view shows.

    Attributes:
        shader: What turns values into colour.
        options: Picture options: step, level of detail, background, clip, lens, lighting, ...
        develop: Samples, tone and exposure.
        show: The picture, or in its place what each ray cost, see `gv.cost`.
        blend: Share of such a cost picture that lies over the picture; 1 shows it alone.
        slices: Three planes beside the picture, or none.
        time: Time point of a series, from 0; or the time of producers that have a clock.
        component: Which number of a voxel is shown.
        camera: Where the camera stands; None: where it sees the whole box.
    """

    shader: Shader
    options: RenderOptions = field(default_factory=RenderOptions)
    develop: Development = field(default_factory=Development)
    show: Show = "picture"
    blend: float = 1.0
    slices: Slices | None = None
    time: float = 0.0
    component: int = 0
    camera: Eye | None = None

    def __post_init__(self) -> None:
        check.instance("ViewState", "shader", self.shader, Shader)
        check.instance("ViewState", "options", self.options, RenderOptions)
        check.one_of("ViewState", "show", self.show, get_args(Show))
        vars(self).update(
            component=check.integer("ViewState", "component", self.component, low=0),
            blend=check.number("ViewState", "blend", self.blend, low=0, high=1),
            time=check.number("ViewState", "time", self.time),
        )
        if self.component != self.options.component:
            vars(self)["options"] = replace(self.options, component=self.component)

    @property
    def is_plain(self) -> bool:
        """Whether it shows the picture alone, without planes beside it and without costs."""
        return self.slices is None and self.show == "picture"

    def settings(self) -> dict[str, Any]:
        """Returns the fields of `RenderOptions` as keyword arguments."""
        return dict(vars(self.options))

    def picture(self, what: N3Tree | Engine, width: int, height: int) -> Picture:
        """Renders what a view shows at rest: all samples of its camera, developed.

        Args:
            what: A resident tree; or an engine, until nothing is missing.
            width, height: Pixels.

        Raises:
            ValueError: The state has no camera, or shows costs: see `gv.cost`.
        """
        if self.camera is None:
            raise ValueError("ViewState.picture: the state must have a camera")
        if self.show != "picture":
            raise ValueError(f"ViewState.picture: must show 'picture', not {self.show!r}")
        renderer = what.render if isinstance(what, Engine) else partial(render, what)
        return self.taken(renderer, self.camera.camera(width, height, what.box))

    def taken(self, render: Callable[..., Picture], camera: Camera) -> Picture:
        """Renders the picture at rest; `render` takes the camera, and by name shader and options.
        It is without costs and planes, see `with_costs` and `Planes.composed`.
        """
        renderer = partial(render, shader=self.shader, **self.settings())
        return self.develop.take(renderer, camera)

    def cost_picture(self, cost: Callable[..., Cost], camera: Camera) -> Picture:
        """Renders the costs that `show` names, in false colours; `cost` takes the camera, and by
        name shader and options. The shader's transfer function stands for the shader, unlit.

        Raises:
            ValueError: The shader has no transfer function.
        """
        assert self.show != "picture"
        settings = {**self.settings(), "lighting": None}
        return cost(camera, shader=costed(self.shader), **settings).picture(self.show)

    def with_costs(self, picture: Picture, costs: Callable[[], Picture]) -> Picture:
        """Returns the developed picture, or costs in its place or blended over it, as the state
        says. Calls `costs` only if the state shows them; render the picture first, since the costs
        of a stream are those of the data that it loaded.
        """
        if self.show == "picture":
            return picture
        top = costs()
        if self.blend == 1:
            return top
        weight = self.blend * top.alpha.to(picture.color)
        return replace(top, color=torch.lerp(picture.color, top.color.to(picture.color), weight))

    def to_json(self) -> dict[str, Any]:
        """Returns the state as plain values, ready for JSON."""
        return encode(self)

    def changed(self, content: Any, source: str | Path = "") -> ViewState:
        """Returns the state with the fields of plain JSON in place of its own; fields that it
        leaves out, or marks as kept, stay.

        Raises:
            ValueError: A field is unknown, or a value out of its range; the message begins with
                `source`, where the JSON comes from.
        """
        try:
            return decode("state", ViewState, content, self)
        except ValueError as error:
            raise ValueError(f"{source}: {one_line(error)}" if source else str(error)) from None

    def save(self, path: str | Path) -> None:
        """Writes a .json file."""
        if Path(path).suffix != ".json":
            raise ValueError(f"state: path must end in .json, got {str(path)!r}")
        write_text(Path(path), json.dumps(self.to_json(), indent=1) + "\n")

    def read(self, path: str | Path) -> ViewState:
        """Returns the state with the fields of a .json file in place of its own.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It holds something else; the message names it.
        """
        return self.changed(saved_state(path), path)


def transfer_of(shader: Shader) -> TransferFunction | None:
    """Returns a shader's transfer function, which may be the shader itself or that of the shader
    which it filters, or None.
    """
    if isinstance(shader, TransferFunction):
        return shader
    inner = getattr(shader, "transfer", None)
    return None if inner is None else transfer_of(inner)


def costed(shader: Shader) -> TransferFunction:
    """Returns the transfer function with which a shader's costs are shown; raises ValueError if it
    has none.
    """
    return check.instance("cost", "shader", transfer_of(shader) or shader, TransferFunction)


def saved_state(path: str | Path) -> dict[str, Any]:
    """Returns the fields of a state's .json file, some of them or all, unchecked.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds something else.
    """
    content = check.json_file("state", path)
    if not isinstance(content, dict) or not isinstance(content.get("options", {}), dict):
        raise ValueError(f"{path}: not a state: it must be an object with the state's fields")
    return content
