"""`Lighting`: shadows, ambient occlusion and one bounce of indirect light, by cones.

A pixel is traced with the colours that its shader gives without light. From the place it sees,
cones go to the lights and to all sides, through the same tree, at the level that their width asks
for; what they miss is streamed as what is seen is. A light as wide as it looks from there gives a
soft shadow.

Sources: Crassin, Neyret, Sainz, Green, Eisemann, "Interactive indirect illumination using voxel
cone tracing", Computer Graphics Forum 2011; Crassin, PhD thesis 2011, on voxel cone tracing; Blinn,
"Models of light reflection for computer synthesized pictures", SIGGRAPH 1977.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..base import check
from ..base.records import Hits, Rays
from ..cameras.camera import Frame
from ..ops.reference.exact import unit
from ..ops.shading import Triple, pack
from ..shaders.lights import (
    CONE_OF_DISC,
    DirectionalLight,
    Headlight,
    Light,
    Material,
    PointLight,
    check_light,
    check_triple,
)
from .composite import Trace, behind, over
from .thin_lens import ThinLens

#: Where secondary rays begin, in voxels: those to lights so far off the surface; those all around
#: closer, so that they stand in clefts, but begin only after a way.
_OFF, _CLOSE, _WAY = 1.5, 0.75, 1.5
_GRAZING = 0.5  # cosine to the normal
#: Share of a hemisphere's light, cosine counted, from less than 30 degrees off the normal; the
#: other five cones share the rest.
_UPRIGHT = 0.25
_TILT = math.radians(50)  # of those: the mean, cosine counted
_FINER = 0.5  # of the cone's width, is that of the cones that go on from where it ends
_WIDE = 2 * math.tan(math.radians(17))  # growth of all six; wider ones meet their own surface


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighting:
    """What light a scene stands in. It takes a shader with normals: `Lit`, `StoredColor`,
    `Isosurface` or `DistanceField`, of which it uses the material.

    Light of a pixel = base * (ambient * sky * (1 - occlusion) + diffuse * (direct + indirect))
    + specular * direct.
    """

    lights: Sequence[Light] | None = None  # None: the shader's own
    shadows: float = 1.0  # how much of the light they take away, 0 to 1; 0: no cone is traced
    shadow_cones: int = 1  # to each light that has a size; more: exacter penumbras
    occlusion: float = 0.0  # how much of the ambient light near matter takes away, 0 to 1
    indirect: float = 0.0  # factor of the light that comes from lit matter nearby
    reach: float | None = None  # of occlusion and indirect light; None: a quarter of the box
    frame: Frame | str = Frame.WORLD  # of reach: world units, or largest sides of the scene's box
    ambient: Triple = (1.0, 1.0, 1.0)  # light from all around, linear RGB

    def __post_init__(self) -> None:
        """Checks every number.

        Raises:
            ValueError: One is out of its range, or a light is none.
        """
        where = "Lighting"
        if self.lights is not None:
            if not isinstance(self.lights, Sequence):
                kind = type(self.lights).__name__
                raise ValueError(f"{where}: lights must be a sequence of lights, got {kind}")
            for number, light in enumerate(self.lights):
                check_light(f"{where}: lights[{number}]", light)
        check.number(where, "shadows", self.shadows, low=0, high=1)
        check.whole(where, "shadow_cones", self.shadow_cones, low=1, high=1024)
        check.number(where, "occlusion", self.occlusion, low=0, high=1)
        check.number(where, "indirect", self.indirect, low=0)
        if self.reach is not None:
            check.number(where, "reach", self.reach, low=0, open_low=True)
        object.__setattr__(self, "frame", Frame.of(where, self.frame))
        check_triple(where, "ambient", self.ambient, low=0.0)

    def __repr__(self) -> str:
        """Tells what differs from the defaults."""
        return check.brief(self)

    def placed(self, box: Tensor) -> Lighting:
        """Returns it in world units, given the (2, 3) box of the scene."""
        if self.reach is not None and self.frame is Frame.WORLD:
            return self
        side = float((box[1] - box[0]).max())
        reach = side * (0.25 if self.reach is None else self.reach)
        return dataclasses.replace(self, reach=reach, frame=Frame.WORLD)


@dataclass(frozen=True)
class _Places:
    """What rays see: one place each, float64 in the world."""

    position: Tensor  # (r, 3)
    normal: Tensor  # (r, 3) unit, towards the eye
    turned: Tensor  # (r,) bool, the normal is the shader's; else there is none, and it is the eye's
    eye: Tensor  # (r, 3) unit, to where the ray came from
    width: Tensor  # (r,) of the ray's cone there
    seen: Tensor  # (r,) bool, there is a place
    lamp: Tensor | None  # (r, 3) where a `Headlight` stands; None: at the eye of these rays
    row: int  # pixels of a row, see `Rays`


class _Tally:
    """What all rays of a pixel cost."""

    def __init__(self, hits: Hits) -> None:
        self.samples, self.missed = hits.samples, hits.missed

    def __call__(self, hits: Hits) -> Hits:
        """Adds some."""
        self.samples, self.missed = self.samples + hits.samples, self.missed | hits.missed
        return hits


class Lighted:
    """Traces rays, and from where they end to the light."""

    def __init__(
        self,
        trace: Trace,
        *,
        blocker: Trace,
        matter: Trace | None,
        lighting: Lighting,
        material: Material,
        voxel: float,
        cone_scale: float,
        lens: ThinLens | None = None,
    ) -> None:
        """Takes what traces the eye's rays without light.

        Args:
            trace: Traces the eye's rays: base colours, and normals.
            blocker: Traces cones whose alpha alone counts.
            matter: Traces cones that bring light back: base colours, and normals; None where there
                is no indirect light.
            lighting: In world units.
            material: How matter takes light.
            voxel: World size of the finest voxel's largest side.
            cone_scale: Factor that the tracers put on cones.
            lens: In world units.
        """
        self._trace, self._blocker, self._matter = trace, blocker, matter
        self._lighting, self._material = lighting, material
        self._lights = (material.light,) if lighting.lights is None else tuple(lighting.lights)
        self._voxel, self._cone_scale, self._lens = voxel, cone_scale, lens

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units."""
        hits = self._trace(rays)
        color, m = hits.color, self._material
        look = (self._lighting.ambient, m.ambient, m.diffuse, m.specular)
        sky, (ambient, diffuse, specular) = pack(look, color.dtype, color.device).split(3)
        tally, places = _Tally(hits), self._places(rays, hits, self._lens)
        matt, shine = self._direct(places, tally, self._lighting.shadow_cones)
        clear, bounced = self._around(places, rays.origin.to(torch.float64), tally)
        light = ambient * sky * clear.to(color)
        light = light + diffuse * (matt + bounced).to(color)
        taken = hits.alpha - (1 - rays.light()).to(color)  # of the light, by these rays themselves
        color = color * light + taken * specular * shine.to(color)
        color = torch.where(hits.alpha > 0, color, 0.0)  # a closed ray may have no direction
        return dataclasses.replace(hits, color=color, samples=tally.samples, missed=tally.missed)

    def _places(self, rays: Rays, hits: Hits, lens: ThinLens | None = None) -> _Places:
        """Where rays ended; `lens` is what they went through."""
        depth = hits.depth[:, 0].to(torch.float64)
        seen = depth < torch.inf
        t = torch.where(seen, depth, 0.0)
        origin, direction, cone = (
            column.to(torch.float64) for column in (rays.origin, rays.direction, rays.cone)
        )
        width = (cone[:, 0] + cone[:, 1] * t) * self._cone_scale
        if lens is not None:
            width = width + lens.cone(t)
        normal = torch.zeros_like(direction) if hits.normal is None else hits.normal.to(direction)
        turned = (normal != 0).any(1)
        return _Places(
            position=origin + t[:, None] * direction,
            normal=torch.where(turned[:, None], normalize(normal, dim=1), -direction),
            turned=turned & seen,
            eye=-direction,
            width=width,
            seen=seen,
            lamp=None,
            row=rays.width,
        )

    def _direct(self, places: _Places, tally: _Tally, cones: int) -> tuple[Tensor, Tensor]:
        """(r, 3) light by its cosine, and by the highlight's. A place without a normal faces the
        light and has no highlight.
        """
        (shininess,) = pack((self._material.shininess,), torch.float64, places.eye.device)
        matt = shine = torch.zeros_like(places.position)
        for light in self._lights:
            color = pack((light.color,), torch.float64, places.eye.device)
            beam, _ = _towards(light, places)
            facing = torch.where(places.turned, (places.normal * beam).sum(1).clamp(min=0), 1.0)
            half = normalize(beam + places.eye, dim=1)
            highlight = (places.normal * half).sum(1).clamp(0, 1) ** shininess
            highlight = torch.where(places.turned & (facing > 0), highlight, 0.0)
            clear = self._visible(
                light, 1 if _is_small(light) else cones, places, facing > 0, tally
            )
            lit = clear[:, None] * color
            matt, shine = matt + facing[:, None] * lit, shine + highlight[:, None] * lit
        return matt, shine

    def _visible(
        self,
        light: Light,
        cones: int,
        places: _Places,
        facing: Tensor,
        tally: _Tally,
    ) -> Tensor:
        """(r,) share of a light that is seen from places. The eye's own light is seen wherever the
        eye sees.
        """
        clear = torch.ones_like(places.width)
        if not self._lighting.shadows or (isinstance(light, Headlight) and places.lamp is None):
            return clear
        beam, _ = _towards(light, places)
        places = self._lifted(places, _OFF, beam)
        beam, distance = _towards(light, places)
        size = _size(light, distance)
        growth = 2 * CONE_OF_DISC / math.sqrt(cones) * size
        right, up = _beside(beam)
        start = torch.zeros_like(distance)
        end = torch.where(facing & places.seen, distance, start)
        blocked = torch.zeros_like(distance)
        for x, y in _disc(cones):
            aim = normalize(beam + size[:, None] * (x * right + y * up), dim=1)
            hits = tally(self._blocker(self._cone(places, aim, growth, start, end)))
            blocked = blocked + hits.alpha[:, 0] / cones
        return 1 - self._lighting.shadows * blocked

    def _around(self, places: _Places, eye: Tensor, tally: _Tally) -> tuple[Tensor, Tensor]:
        """(r, 1) share of the ambient light that comes through, and (r, 3) the light that matter
        sends, seen from `eye` (r, 3). What lies beyond half of the reach takes half.
        """
        clear, bounced = torch.ones_like(places.position[:, :1]), torch.zeros_like(places.position)
        lighting, reach = self._lighting, self._lighting.reach
        if not (lighting.occlusion or lighting.indirect):
            return clear, bounced
        assert reach is not None
        trace = self._blocker if self._matter is None else self._matter
        some = places.seen.to(torch.float64)
        start = _WAY * some * places.width.clamp(min=self._voxel)
        end = torch.maximum(start, reach * some)
        middle = torch.maximum(start, reach / 2 * some)
        growth = torch.full_like(end, _WIDE)
        lifted = self._lifted(places, _CLOSE)
        for weight, direction in _hemisphere(places.normal):
            first, second = (
                self._cone(lifted, direction, growth, *span)
                for span in ((start, middle), (middle, end))
            )
            front = trace(first)
            hits = tally(over(front, trace(behind(second, front)), dimmed=True))
            taken = (front.alpha + hits.alpha).to(clear) / 2
            clear = clear - lighting.occlusion * weight * taken
            if self._matter is not None:
                bounced = bounced + weight * self._sent(first, hits, eye, tally)
        return clear, lighting.indirect * bounced

    def _lifted(self, places: _Places, off: float, beam: Tensor | None = None) -> _Places:
        """The same `off` voxels above, or widths of what the eye's ray saw: on the way along
        `beam` (r, 3), if there is one and it does not graze, so that no shadow moves.
        """
        way = places.normal
        if beam is not None:
            rise = (way * beam).sum(1, keepdim=True)
            way = way + (beam - rise * way) / rise.clamp(min=_GRAZING)
        height = off * places.width.clamp(min=self._voxel)[:, None]
        return dataclasses.replace(places, position=places.position + height * way)

    def _cone(
        self, places: _Places, direction: Tensor, growth: Tensor, start: Tensor, end: Tensor
    ) -> Rays:
        """Cones from places, as wide there as what the eye's ray saw; `growth` is that of the width
        in the world. One that ends where it starts goes nowhere.
        """
        return Rays(
            origin=places.position,
            direction=direction,
            cone=torch.stack((places.width, growth), 1) / self._cone_scale,
            range=torch.stack((start, end), 1),
            width=places.row,
        )

    def _sent(self, rays: Rays, hits: Hits, eye: Tensor, tally: _Tally) -> Tensor:
        """(r, 3) light that matter sends back along cones that met it; a `Headlight` stays at the
        eye.
        """
        places = self._places(rays, hits)
        places = dataclasses.replace(places, width=_FINER * places.width, lamp=eye)
        matt, _ = self._direct(places, tally, 1)
        (diffuse,) = pack((self._material.diffuse,), torch.float64, matt.device)
        return torch.where(places.seen[:, None], diffuse * matt * hits.color, 0.0)


def _towards(light: Light, places: _Places) -> tuple[Tensor, Tensor]:
    """(r, 3) unit directions to a light, and (r,) how far it is."""
    if isinstance(light, Headlight) and places.lamp is None:
        return places.eye, torch.zeros_like(places.width)
    if isinstance(light, DirectionalLight):
        way = -pack((light.direction,), torch.float64, places.eye.device)
        beam = unit(way.expand_as(places.position))  # of any length but 0
        return beam, torch.full_like(places.width, torch.inf)
    place = places.lamp
    if isinstance(light, PointLight):
        place = pack((light.position,), torch.float64, places.eye.device)
    assert place is not None
    way = place - places.position
    return normalize(way, dim=1), way.norm(dim=1)


def _is_small(light: Light) -> bool:
    """Whether it is known to have no size."""
    size = getattr(light, "angle", getattr(light, "radius", 0.0))
    return not isinstance(size, Tensor) and size == 0


def _size(light: Light, distance: Tensor) -> Tensor:
    """(r,) radius of a light over how far it is."""
    if isinstance(light, Headlight):
        return torch.zeros_like(distance)
    if isinstance(light, PointLight):
        return pack((light.radius,), distance.dtype, distance.device) / distance.clamp(min=1e-30)
    angle = pack((light.angle,), distance.dtype, distance.device)
    return torch.tan(torch.deg2rad(angle) / 2).expand_as(distance)


def _disc(count: int) -> Iterator[tuple[float, float]]:
    """Places spread evenly over the unit disc; one is its centre (Vogel, 1979)."""
    for number in range(count):
        radius = math.sqrt((number + 0.5) / count) if count > 1 else 0.0
        turn = number * math.pi * (3 - math.sqrt(5))
        yield radius * math.cos(turn), radius * math.sin(turn)


def _beside(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two (r, 3) unit vectors across unit vectors and each other (Duff et al., "Building an
    orthonormal basis, revisited", 2017).
    """
    x, y, z = axis.unbind(1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z)
    a = -1 / (sign + z)
    b = x * y * a
    right = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), 1)
    return right, torch.stack((b, sign + y * y * a, -y), 1)


def _hemisphere(normal: Tensor) -> Iterator[tuple[float, Tensor]]:
    """Six cones over a hemisphere: weights that add up to 1, and (r, 3) directions."""
    yield _UPRIGHT, normal
    right, up = _beside(normal)
    for number in range(5):
        turn = number * 2 * math.pi / 5
        flat = math.cos(turn) * right + math.sin(turn) * up
        yield (1 - _UPRIGHT) / 5, math.cos(_TILT) * normal + math.sin(_TILT) * flat
