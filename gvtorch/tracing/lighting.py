"""`Lighting`: shadows, ambient occlusion and one bounce of indirect light, by cones.

A pixel is traced with its shader's unlit colours. From the surface point it sees, cones are traced
to the lights and over the hemisphere, through the same tree, at the level of detail of their width;
nodes they miss are requested like any others. The cone to a light is as wide as the light looks
from there, which gives soft shadows.

Sources: Crassin, Neyret, Sainz, Green, Eisemann, "Interactive indirect illumination using voxel
cone tracing", Computer Graphics Forum 2011; Crassin, PhD thesis 2011, on voxel cone tracing; Blinn,
"Models of light reflection for computer synthesized pictures", SIGGRAPH 1977.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..base import check
from ..base.records import Hits, Rays
from ..cameras.poses import Coordinates
from ..ops import RayArguments
from ..ops.reference.exact import divide, dot, power, sqrt_exact, unit
from ..ops.shading import ShadeParameters, Triple, pack
from ..shaders.lights import (
    CONE_OF_DISC,
    DirectionalLight,
    Headlight,
    Light,
    PointLight,
    a_triple,
)
from .composite import TraceRays, behind, indices_if_few, over
from .thin_lens import ThinLens

#: Where cones begin, in voxels. Cones to lights are lifted `_SHADOW_LIFT` above the surface.
#: Hemisphere cones are lifted less, `_HEMISPHERE_LIFT`, to sample crevices, and start marching
#: after `_HEMISPHERE_START`.
_SHADOW_LIFT, _HEMISPHERE_LIFT, _HEMISPHERE_START = 1.5, 1.0, 1.5
_MIN_LIFT_COSINE = 0.5  # smallest cosine to the normal along which a light's cone is lifted
#: Growth of hemisphere cones; wider ones blur what they meet.
_MAX_CONE_GROWTH = 2 * math.tan(math.radians(1))
#: Steps of the sequence of directions: 2^32 over the plastic number, and over its square.
_SEQUENCE_STEPS = (3242174889, 2447445414)
_MASK_32 = (1 << 32) - 1
#: Width of the shadow cones of bounced light, relative to the cone that met matter.
_BOUNCE_CONE_SCALE = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighting:
    """The light of a scene, for a shader with normals: `Lit`, `StoredColor`, `Isosurface` or
    `DistanceField`. It uses the shader's material.

    Colour of a pixel = base * (material.ambient * ambient * (1 - occlusion)
    + material.diffuse * (direct + indirect)) + material.specular * highlight.
    """

    lights: Sequence[Light] | None = None  # None: the shader's own
    shadows: float = 1.0  # how dark full shadow is, 0 to 1; 0: no cone is traced
    shadow_cones: int = 1  # to each light that has a size; more make penumbras more exact
    occlusion: float = 0.0  # share of the ambient light that matter nearby can block, 0 to 1
    indirect: float = 0.0  # factor of the light that comes from lit matter nearby
    cones: int = 16  # over the hemisphere, for occlusion and indirect light
    reach: float | None = None  # of occlusion and indirect light; None: a quarter of the box's side
    frame: Coordinates | str = Coordinates.WORLD  # of reach: or largest sides of the scene's box
    ambient: Triple = (1.0, 1.0, 1.0)  # light from all directions, linear RGB

    def __post_init__(self) -> None:
        context = "Lighting"
        if not isinstance(self.lights, Sequence | None):
            kind = type(self.lights).__name__
            raise ValueError(f"{context}: lights must be a sequence of lights, got {kind}")
        for number, light in enumerate(self.lights or ()):
            name = f"lights[{number}]"
            check.instance(context, name, light, Headlight, DirectionalLight, PointLight)
        reach = self.reach
        if reach is not None:
            reach = check.number(context, "reach", reach, low=0, open_low=True)
        vars(self).update(
            shadows=check.number(context, "shadows", self.shadows, low=0, high=1),
            shadow_cones=check.integer(
                context, "shadow_cones", self.shadow_cones, low=1, high=1024
            ),
            occlusion=check.number(context, "occlusion", self.occlusion, low=0, high=1),
            indirect=check.number(context, "indirect", self.indirect, low=0),
            cones=check.integer(context, "cones", self.cones, low=1, high=1024),
            reach=reach,
            frame=Coordinates.of(context, self.frame),
            ambient=a_triple(low=0)(self, "ambient", self.ambient),
        )

    __repr__ = check.summary

    def placed(self, box: Tensor) -> Lighting:
        """Returns the lighting with its reach in world units, given the scene's (2, 3) box."""
        frame, reach = Coordinates(self.frame), self.reach
        if reach is None:
            frame, reach = Coordinates.BOX, 0.25
        return replace(self, reach=reach * frame.unit(box), frame=Coordinates.WORLD)


@dataclass(frozen=True)
class _Points:
    """The points where rays met matter, one per ray, float64 in world units."""

    position: Tensor  # (r, 3)
    normal: Tensor  # (r, 3) unit, towards the eye
    has_normal: Tensor  # (r,) bool, the shader gave the normal; else it is the direction to the eye
    eye: Tensor  # (r, 3) unit direction, back along the ray
    width: Tensor  # (r,) of the ray's cone there
    is_hit: Tensor  # (r,) bool, the ray met matter
    headlight: Tensor | None  # (r, 3) a headlight's position; None: the origin of these rays
    row_width: int  # pixels of a row, see `Rays.width`
    tally: _Tally  # of all rays of the pixels

    def select(self, index: Tensor) -> _Points:
        """Returns some of the points, with a new tally."""
        columns = {n: c[index] for n, c in vars(self).items() if isinstance(c, Tensor)}
        counters = (self.tally.samples, self.tally.missed)
        tally = _Tally(*(count.new_zeros(len(index)) for count in counters))
        return replace(self, **columns, row_width=0, tally=tally)


class _Tally:
    """Samples and misses of all rays of a pixel."""

    def __init__(self, samples: Tensor, missed: Tensor) -> None:
        self.samples, self.missed = samples, missed

    def __call__(self, hits: Hits) -> Hits:
        """Adds the counts of some hits, and returns the hits."""
        self.samples, self.missed = self.samples + hits.samples, self.missed | hits.missed
        return hits

    def add_some(self, index: Tensor, other: _Tally) -> None:
        """Adds the counts of some pixels."""
        self.samples = self.samples.index_add(0, index, other.samples)
        self.missed = self.missed.index_put((index,), self.missed[index] | other.missed)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighted:
    """Traces rays of one frame, then cones from the points that they hit, and lights the points."""

    trace: TraceRays  # traces the eye's rays: unlit colours and normals
    blocker: TraceRays  # traces cones of which only alpha is used
    matter: TraceRays | None  # traces cones to matter that reflects light; None: none reflects
    lighting: Lighting  # in world units
    lights: Sequence[Light]  # in world units
    material: ShadeParameters  # how matter reflects light
    voxel: float  # world size of the finest voxel's largest side
    cone_scale: float  # as in `RenderOptions`
    lens: ThinLens | None = None  # depth of field of the eye's rays, in world units

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units."""
        hits = self.trace(rays)
        color, m = hits.color, self.material
        factors = (self.lighting.ambient, m.ambient, m.diffuse, m.specular)
        sky, (ambient, diffuse, specular) = pack(factors, color.dtype, color.device).split(3)
        tally = _Tally(hits.samples, hits.missed)
        points = self._points(rays, hits, tally)
        direct, highlight = self._direct_light(points, self.lighting.shadow_cones)
        unblocked, bounced = self._hemisphere(points, rays)
        light = ambient * sky * unblocked.to(color)
        light = light + diffuse * (direct + bounced).to(color)
        # Light absorbed by this piece of the ray.
        absorbed = hits.alpha - (1 - rays.light()).to(color)
        color = color * light + absorbed * specular * highlight.to(color)
        color = torch.where(hits.alpha > 0, color, 0.0)  # a closed ray may have no direction
        return replace(hits, color=color, samples=tally.samples, missed=tally.missed)

    def _points(
        self, rays: Rays, hits: Hits, tally: _Tally, headlight: Tensor | None = None
    ) -> _Points:
        """Returns the points that the eye's rays hit, or, given a `headlight`, those of cones."""
        origin, direction, cone = RayArguments.of(rays)[:3]
        depth = hits.depth[:, 0].to(torch.float64)
        is_hit = depth < torch.inf
        t = torch.where(is_hit, depth, 0.0)
        width = (cone[:, 0] + cone[:, 1] * t) * self.cone_scale
        if headlight is not None:
            width = _BOUNCE_CONE_SCALE * width
        elif self.lens is not None:
            width = width + self.lens.cone(t)
        eye = -direction
        normal = torch.zeros_like(eye) if hits.normal is None else hits.normal.to(eye)
        has_normal = (normal != 0).any(1)
        return _Points(
            position=origin + t[:, None] * direction,
            normal=torch.where(has_normal[:, None], unit(normal), eye),
            has_normal=has_normal & is_hit,
            eye=eye,
            width=width,
            is_hit=is_hit,
            headlight=headlight,
            row_width=rays.width,
            tally=tally,
        )

    def _direct_light(self, points: _Points, cones: int) -> tuple[Tensor, Tensor]:
        """Returns (r, 3) diffuse light and (r, 3) highlights of all lights, with their shadows. A
        point without a normal faces every light and has no highlight.
        """
        (shininess,) = pack((self.material.shininess,), torch.float64, points.eye.device)
        diffuse = highlights = torch.zeros_like(points.position)
        for light in self.lights:
            color = pack((light.color,), torch.float64, points.eye.device)
            beam, *_ = _light_direction(light, points)
            facing = dot(points.normal, beam).clamp(min=0)
            facing = torch.where(points.has_normal, facing, 1.0)
            half_vector = unit(beam + points.eye)
            highlight = power(dot(points.normal, half_vector).clamp(0, 1), shininess)
            highlight = torch.where(points.has_normal & (facing > 0), highlight, 0.0)
            light_size = getattr(light, "angle", getattr(light, "radius", 0.0))
            # A tensor is not read: that would block.
            count = cones if isinstance(light_size, Tensor) or light_size else 1
            fraction = self._visible_fraction(light, count, points, beam, facing > 0)
            light_color = fraction[:, None] * color
            diffuse = diffuse + facing[:, None] * light_color
            highlights = highlights + highlight[:, None] * light_color
        return diffuse, highlights

    def _visible_fraction(
        self, light: Light, cones: int, points: _Points, beam: Tensor, facing: Tensor
    ) -> Tensor:
        """Returns (r,) the share of a light that reaches points; all of the eye's `Headlight`."""
        at_eye = isinstance(light, Headlight) and points.headlight is None
        if not self.lighting.shadows or at_eye:
            return torch.ones_like(points.width)
        index = indices_if_few(facing & points.is_hit)
        if index is not None:
            subset = points.select(index)
            fraction = self._visible_fraction(light, cones, subset, beam[index], facing[index])
            points.tally.add_some(index, subset.tally)
            return torch.ones_like(points.width).index_put((index,), fraction)
        points = self._lifted_points(points, _SHADOW_LIFT, beam)
        beam, distance, size = _light_direction(light, points)
        growth = 2 * CONE_OF_DISC / math.sqrt(cones) * size
        right, up = _orthogonal_pair(beam)
        start = torch.zeros_like(distance)
        end = torch.where(facing & points.is_hit, distance, start)
        blocked = torch.zeros_like(distance)
        for x, y in _disc_points(cones):
            cone_direction = unit(beam + size[:, None] * (x * right + y * up))
            cone_rays = self._cones_from(points, cone_direction, growth, start, end)
            hits = points.tally(self.blocker(cone_rays))
            alpha = hits.alpha[:, 0]
            blocked = blocked + divide(alpha, cones, alpha)
        return 1 - self.lighting.shadows * blocked

    def _hemisphere(self, points: _Points, rays: Rays) -> tuple[Tensor, Tensor]:
        """Returns (r, 1) the share of the ambient light that is not occluded, and (r, 3) light that
        matter around the points reflects; a `Headlight` is where the eye's rays begin. Matter
        farther away than half of the reach blocks half as much.
        """
        unblocked = torch.ones_like(points.position[:, :1])
        bounced = torch.zeros_like(points.position)
        lighting, reach = self.lighting, self.lighting.reach
        if not (lighting.occlusion or lighting.indirect):
            return unblocked, bounced
        assert reach is not None
        index = indices_if_few(points.is_hit)
        if index is not None:
            subset = points.select(index)
            fraction, light = self._hemisphere(subset, rays[index])
            points.tally.add_some(index, subset.tally)
            return unblocked.index_put((index,), fraction), bounced.index_put((index,), light)
        trace = self.blocker if self.matter is None else self.matter
        is_hit = points.is_hit.to(torch.float64)
        start = _HEMISPHERE_START * is_hit * points.width.clamp(min=self.voxel)
        end = torch.maximum(start, reach * is_hit)
        middle = torch.maximum(start, reach / 2 * is_hit)
        lifted = self._lifted_points(points, _HEMISPHERE_LIFT)
        eye, weight = rays.origin.to(torch.float64), 1 / lighting.cones
        (diffuse,) = pack((self.material.diffuse,), torch.float64, eye.device)
        assert rays.sample is not None
        for direction in _hemisphere_directions(points.normal, rays.sample, lighting.cones):
            # Cones stay above the surface.
            growth = dot(direction, points.normal).clamp(0, _MAX_CONE_GROWTH)
            near_cones = self._cones_from(lifted, direction, growth, start, middle)
            far_cones = self._cones_from(lifted, direction, growth, middle, end)
            front = trace(near_cones)
            hits = points.tally(over(front, trace(behind(far_cones, front)), dimmed=True))
            absorbed = (front.alpha + hits.alpha).to(unblocked) / 2
            unblocked = unblocked - lighting.occlusion * weight * absorbed
            if self.matter is not None:
                matter = self._points(near_cones, hits, points.tally, eye)
                reflected = diffuse * self._direct_light(matter, 1)[0] * hits.color
                bounced = bounced + weight * torch.where(matter.is_hit[:, None], reflected, 0.0)
        return unblocked, lighting.indirect * bounced

    def _lifted_points(self, points: _Points, lift: float, beam: Tensor | None = None) -> _Points:
        """Returns the points lifted `lift` voxels above the surface, or, where the eye's ray is
        wider than a voxel, `lift` of its widths: along `beam` (r, 3) if given and not grazing, so
        that the shadow stays where it is; else along the normal.
        """
        direction = points.normal
        if beam is not None:
            cosine = dot(direction, beam)[:, None]
            direction = direction + (beam - cosine * direction) / cosine.clamp(min=_MIN_LIFT_COSINE)
        height = lift * points.width.clamp(min=self.voxel)[:, None]
        return replace(points, position=points.position + height * direction)

    def _cones_from(
        self, points: _Points, direction: Tensor, growth: Tensor, start: Tensor, end: Tensor
    ) -> Rays:
        """Returns cones from points, as wide there as the eye's ray; their width grows by `growth`
        (r,) per unit distance. A cone that ends where it starts is not traced.
        """
        cone = torch.stack((points.width, growth), 1)
        return Rays(
            origin=points.position,
            direction=direction,
            cone=divide(cone, self.cone_scale, cone),
            range=torch.stack((start, end), 1),
            width=points.row_width,
        )


def _light_direction(light: Light, points: _Points) -> tuple[Tensor, Tensor, Tensor]:
    """Returns (r, 3) unit directions and (r,) distances to a light, and (r,) radius / distance."""
    nothing, device = torch.zeros_like(points.width), points.eye.device
    if isinstance(light, DirectionalLight):
        to_light = -pack((light.direction,), torch.float64, device)
        beam = unit(to_light.expand_as(points.position))  # of any length but 0
        size = pack((light.size,), torch.float64, device).expand_as(nothing)
        return beam, torch.full_like(nothing, torch.inf), size
    if isinstance(light, PointLight):
        position, radius = pack((light.position, light.radius), torch.float64, device).split((3, 1))
    elif points.headlight is None:
        return points.eye, nothing, nothing
    else:
        position, radius = points.headlight, nothing
    to_light = position - points.position
    distance = sqrt_exact(dot(to_light, to_light))
    return unit(to_light), distance, radius / distance.clamp(min=1e-30)


def _disc_points(count: int) -> Iterator[tuple[float, float]]:
    """Yields points (x, y) spread evenly over the unit disc; for one, its centre (Vogel, 1979)."""
    for number in range(count):
        radius = math.sqrt((number + 0.5) / count) if count > 1 else 0.0
        angle = number * math.pi * (3 - math.sqrt(5))
        yield radius * math.cos(angle), radius * math.sin(angle)


def _orthogonal_pair(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Returns two (r, 3) unit vectors orthogonal to (r, 3) unit vectors and to each other (Duff et
    al., "Building an orthonormal basis, revisited", 2017).
    """
    x, y, z = axis.unbind(1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z)
    a = -1 / (sign + z)
    b = x * y * a
    right = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), 1)
    return right, torch.stack((b, sign + y * y * a, -y), 1)


def _hemisphere_directions(normal: Tensor, sample: Tensor, count: int) -> Iterator[Tensor]:
    """Yields `count` directions (r, 3), cosine-weighted around (r, 3) normals, from a sequence that
    fills the unit square evenly (Roberts, 2018). It begins at a different position for each pixel,
    and continues from sample to sample. Made of integers, + - * / and roots: the same bits on every
    device.
    """
    right, up = _orthogonal_pair(normal)
    begin_x = _hash_32((sample & _MASK_32) + 1)
    begin_y = _hash_32(begin_x + _SEQUENCE_STEPS[0])
    first_index = (sample >> 32) * count
    for number in range(count):
        x, y = (
            ((begin + (first_index + number) * step) & _MASK_32).to(torch.float64) * 2.0**-32
            for begin, step in zip((begin_x, begin_y), _SEQUENCE_STEPS, strict=True)
        )
        cosine, sine = _cosine_sine(y)
        tangent = cosine[:, None] * right + sine[:, None] * up
        yield unit(sqrt_exact(1 - x)[:, None] * normal + sqrt_exact(x)[:, None] * tangent)


def _hash_32(number: Tensor) -> Tensor:
    """Returns (r,) hashes below 2^32, uncorrelated for neighbours (as Wellons' lowbias32, 2018)."""
    for shift in (16, 15):
        number = ((number ^ (number >> shift)) * 0x7FEB352D) & _MASK_32
    return number ^ (number >> 16)


def _cosine_sine(turns: Tensor) -> tuple[Tensor, Tensor]:
    """Returns cosine and sine of (r,) turns in [0, 1), to 4e-6."""
    quarter = torch.floor(4 * turns + 0.5)
    angle = (4 * turns - quarter) * (math.pi / 2)
    square = angle * angle
    cosine = 1 - square * (1 / 2 - square * (1 / 24 - square * (1 / 720)))
    sine = angle * (1 - square * (1 / 6 - square * (1 / 120 - square * (1 / 5040))))
    swapped, flips_sine = quarter % 2 == 1, (quarter == 2) | (quarter == 3)
    flips_cosine = (quarter == 1) | (quarter == 2)
    a, b = torch.where(swapped, sine, cosine), torch.where(swapped, cosine, sine)
    return torch.where(flips_cosine, -a, a), torch.where(flips_sine, -b, b)
