"""`Clip`: the region of interest, from planes and boxes. Rays are cut in float64 into the pieces to
keep, so it works with every shader, and clipped space is neither sampled nor requested.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.records import Hits, Rays
from ..cameras.poses import Coordinates
from .composite import TraceRays, indices_if_few, reaches_depth, scatter_hits, trace_pieces

Face = tuple[float, ...]  # unit normal and offset (a, b, c, d): inside, a x + b y + c z + d >= 0
Numbers = Sequence[Sequence[float]] | Tensor
_MIN_CAP_ALPHA = 1e-4  # a cap is drawn where one interval behind the cut has more alpha than this


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """The region that is kept: inside all planes, inside at least one box if there are any, and
    inside no box of `without`.

    A box is either its low and high corner, ((x, y, z), (x, y, z)), or a (4, 4) matrix that maps
    the unit cube [0, 1]^3 to it.
    """

    planes: Numbers = ()  # (p, 4): (a, b, c, d) keeps where a x + b y + c z + d >= 0
    boxes: Sequence[Numbers] = ()  # to keep
    without: Sequence[Numbers] = ()  # to remove
    frame: Coordinates | str = Coordinates.WORLD  # or the scene's box: centre 0, largest side 1
    caps: bool = False  # draws a flat surface where a cut passes through matter
    cap_opacity: float = 1.0  # of caps
    cap_light: float = 0.5  # share of caps' light that comes from the eye; without `Lighting` only

    def __post_init__(self) -> None:
        cap_opacity = check.number(
            "Clip", "cap_opacity", self.cap_opacity, low=0, high=1, open_low=True
        )
        vars(self).update(
            frame=Coordinates.of("Clip", self.frame),
            caps=check.instance("Clip", "caps", self.caps, bool),
            cap_opacity=cap_opacity,
            cap_light=check.number("Clip", "cap_light", self.cap_light, low=0, high=1),
        )
        _ = self._checked_faces

    def __repr__(self) -> str:
        counts = [f"{name}={len(getattr(self, name))}" for name in Faces._fields]
        frame = Coordinates(self.frame).value
        return f"Clip({', '.join(counts)}, caps={self.caps}, in {frame} units)"

    @property
    def whole(self) -> bool:
        """Whether at most one piece of each ray is kept, and no cap is drawn."""
        return len(self.boxes) <= 1 and not len(self.without) and not self.caps

    @cached_property
    def _checked_faces(self) -> Faces:
        """The clip's faces, checked and in the units of `frame`."""
        for name in Faces._fields:
            if not _is_list(getattr(self, name)):
                kind = type(getattr(self, name)).__name__
                raise ValueError(f"Clip: {name} must be a list, got {kind}")
        planes = [_face(f"planes[{i}]", plane) for i, plane in enumerate(self.planes)]
        boxes = [_box(f"boxes[{i}]", box) for i, box in enumerate(self.boxes)]
        without = [_box(f"without[{i}]", box) for i, box in enumerate(self.without)]
        if len(boxes) == 1:  # the faces of a single box act as planes
            return Faces(planes + boxes[0], [], without)
        return Faces(planes, boxes, without)

    def faces(self, box: Tensor) -> Faces:
        """Returns the faces in world units, given the (2, 3) box of the scene."""
        if self.frame is Coordinates.WORLD:
            return self._checked_faces
        centre, side = ((box[0] + box[1]) / 2).tolist(), Coordinates.BOX.unit(box)

        def to_world(faces: list[Face]) -> list[Face]:
            return [(*n, d * side - _dot(n, centre)) for *n, d in faces]

        planes, boxes, without = self._checked_faces
        return Faces(to_world(planes), [*map(to_world, boxes)], [*map(to_world, without)])


class Faces(NamedTuple):
    """The convex sets of a clip, as lists of faces whose normals point inwards."""

    planes: list[Face]
    boxes: list[list[Face]]
    without: list[list[Face]]


class _FaceCrossing(NamedTuple):
    """A face and rays, in float64. The face's numbers stay on the host, so nothing blocks."""

    normal: Sequence[float]
    height: Tensor  # (r,) signed distance of each ray's origin from the face, > 0 inside
    rate: Tensor  # (r,) growth of the height per unit distance along the ray


class _FaceCrossings(NamedTuple):
    """`Faces`, and where rays meet them: computed once for all pieces and caps."""

    planes: list[_FaceCrossing]
    boxes: list[list[_FaceCrossing]]
    without: list[list[_FaceCrossing]]

    @staticmethod
    def of(faces: Faces, rays: Rays) -> _FaceCrossings:
        """Computes where rays meet the faces."""
        origin, direction = (
            vectors.to(torch.float64).mT.contiguous() for vectors in (rays.origin, rays.direction)
        )

        def meet(face_list: list[Face]) -> list[_FaceCrossing]:
            return [
                _FaceCrossing(n, _dot(n, [*origin]) + d, _dot(n, [*direction]))
                for *n, d in face_list
            ]

        return _FaceCrossings(
            meet(faces.planes), [*map(meet, faces.boxes)], [*map(meet, faces.without)]
        )

    def select(self, index: Tensor) -> _FaceCrossings:
        """Returns the same for some of the rays."""

        def select_rays(crossings: list[_FaceCrossing]) -> list[_FaceCrossing]:
            return [
                _FaceCrossing(crossing.normal, crossing.height[index], crossing.rate[index])
                for crossing in crossings
            ]

        return _FaceCrossings(
            select_rays(self.planes),
            [*map(select_rays, self.boxes)],
            [*map(select_rays, self.without)],
        )

    def pieces(self, limits: Tensor) -> list[Tensor]:
        """Returns the kept pieces (r, 2) of the limits (r, 2), nearest first. There are as many as
        a ray can have; a piece that a ray does not have ends where it begins.
        """
        first, last = _convex_span(self.planes, *limits.unbind(1))
        last = torch.maximum(first, last)
        if not (self.boxes or self.without):
            return [torch.stack((first, last), 1)]
        unbounded = torch.full_like(first, -torch.inf), torch.full_like(first, torch.inf)
        boxes, without = ([_convex_span(faces, *unbounded) for faces in sets] for sets in self[1:])
        all_ends = [end.clamp(first, last) for span in boxes + without for end in span]
        ends = torch.stack([first, last, *all_ends], 1).sort(1).values
        low, high = ends[:, :-1], ends[:, 1:]
        middle = (low + high) / 2  # all points between two neighbouring ends are kept, or none
        kept = torch.full_like(middle, not boxes, dtype=torch.bool)
        for a, b in boxes:
            kept = kept | ((a[:, None] <= middle) & (middle <= b[:, None]))
        for a, b in without:
            kept = kept & ~((a[:, None] <= middle) & (middle <= b[:, None]))
        begins = kept.clone()
        begins[:, 1:] &= ~kept[:, :-1]
        piece_number = begins.cumsum(1)
        pieces = []
        for piece in range(1, max(1, len(boxes)) + len(without) + 1):
            in_piece = kept & (piece_number == piece)
            a = torch.where(in_piece, low, torch.inf).amin(1)
            b = torch.where(in_piece, high, -torch.inf).amax(1)
            span = torch.stack((a, b), 1)
            pieces.append(torch.where((a < b)[:, None], span, first[:, None]))
        return pieces

    def facing(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Returns (r,) cosines between each ray and the normal of the face that it crosses at
        distances t (r,), and (r, 3) that normal, towards the eye. The face is the nearest to that
        point of those through which the ray enters the kept region.
        """
        nearest, cosine = torch.full_like(t, torch.inf), torch.ones_like(t)
        normal = [torch.zeros_like(t)] * 3
        planes, boxes, without = self
        kept = [(1, face) for faces in (planes, *boxes) for face in faces]
        cut = [(-1, face) for faces in without for face in faces]
        for side, (face_normal, height, rate) in kept + cut:
            distance = torch.where(side * rate > 0, (height + t * rate).abs(), torch.inf)
            nearer = distance < nearest
            cosine = torch.where(nearer, rate.abs(), cosine)
            sides = zip(face_normal, normal, strict=True)
            normal = [torch.where(nearer, -side * n, old) for n, old in sides]
            nearest = torch.minimum(distance, nearest)
        return cosine, torch.stack(normal, 1)


@dataclass(frozen=True, eq=False)
class Clipped:
    """Traces the kept pieces of rays, and the caps in front of them, in one frame."""

    trace: TraceRays  # traces a piece
    clip: Clip
    box: Tensor  # (2, 3) world corners of the scene
    step: float  # world length of the shortest interval: a cap is coloured by one behind the cut
    depth_alpha: float  # depth is where alpha passes this
    slab: TraceRays | None = None  # traces the intervals that give caps their colour; None: `trace`
    unlit: bool = False  # caps are not lit here, because `Lighting` lights them later
    #: Traces all pieces of each ray; None: each piece is composited over those behind it.
    together: Callable[[Iterable[Rays]], Hits] | None = None

    @cached_property
    def _faces(self) -> Faces:
        return self.clip.faces(self.box)

    def __call__(self, rays: Rays) -> Hits:
        """Traces rays in world units."""
        rays = replace(rays, range=rays.range.to(torch.float64))
        crossings = self.meet(rays)
        pieces = [replace(rays, range=kept) for kept in crossings.pieces(rays.range)]
        if self.together is not None and not self.clip.caps:
            return self.together(pieces)
        cap = partial(self._cap, crossings, rays.range[:, 0]) if self.clip.caps else None
        return trace_pieces(self.trace, pieces, cap=cap)

    def meet(self, rays: Rays) -> _FaceCrossings:
        """Computes where rays in world units meet the faces."""
        return _FaceCrossings.of(self._faces, rays)

    def _cap(self, crossings: _FaceCrossings, range_start: Tensor, piece: Rays) -> Hits:
        """Returns the caps of pieces that begin at a cut, not at `range_start` (r,). One interval
        behind the cut gives the colour, the features, and whether there is matter at all.
        """
        first, last = piece.range.unbind(1)
        end = torch.where(first > range_start, torch.minimum(first + self.step, last), first)
        index = indices_if_few(first < end)
        if index is not None:
            caps = self._cap(crossings.select(index), range_start[index], piece[index])
            return scatter_hits(piece, index, caps)
        slab = (self.slab or self.trace)(replace(piece, range=torch.stack((first, end), 1)))
        before = piece.light()[:, 0].to(slab.color)  # transmittance before the cap
        absorbed = before - (1 - slab.alpha[:, 0])  # light absorbed by the slab
        alpha = torch.where(absorbed > _MIN_CAP_ALPHA * before, self.clip.cap_opacity, 0.0).to(
            before
        )
        facing, normal = crossings.facing(first)
        light = 1 - (0.0 if self.unlit else self.clip.cap_light) * (1 - facing)
        absorbed = torch.where(alpha > 0, absorbed, 1.0)
        feature_scale = before * alpha / absorbed
        scale = before * alpha * light.to(before) / absorbed
        after = before * (1 - alpha)
        hit = reaches_depth(before, after, self.depth_alpha)
        return Hits(
            color=slab.color * scale[:, None],
            alpha=(1 - after)[:, None],
            depth=torch.where(hit, first.to(before), torch.inf)[:, None],
            samples=slab.samples,
            missed=slab.missed,
            normal=None if slab.normal is None else normal.to(before) * (alpha > 0)[:, None],
            features=None if slab.features is None else slab.features * feature_scale[:, None],
            label=None if slab.label is None else torch.where(hit[:, None], slab.label, -1),
        )


def _is_list(value: Any) -> bool:
    """Returns whether a value is a list, or a tensor or array of at least one dimension."""
    arrays = (Tensor, np.ndarray)
    return isinstance(value, Sequence) or (isinstance(value, arrays) and value.ndim > 0)


def _face(name: str, numbers: Any) -> Face:
    a, b, c, d = check.reals("Clip", name, numbers, (4,)).tolist()
    length = math.hypot(a, b, c)
    if not 0 < length < math.inf:
        raise ValueError(f"Clip: {name} has a normal of length {length:g}: {numbers!r}")
    return (a / length, b / length, c / length, d / length)


def _box(name: str, numbers: Any) -> list[Face]:
    """Returns the six faces of a box."""
    if not _is_list(numbers):
        raise ValueError(f"Clip: {name} must be two corners or a (4, 4) matrix, got {numbers!r}")
    if len(numbers) == 2:
        low, high = check.reals("Clip", name, numbers, (2, 3))
        if not bool((low < high).all()):
            raise ValueError(
                f"Clip: {name} must have its low corner below its high one on each axis, "
                f"got {low.tolist()} and {high.tolist()}"
            )
        axes, start, end = torch.eye(3, dtype=torch.float64, device="cpu"), low, high
    else:
        matrix = check.reals("Clip", name, numbers, (4, 4))
        volume, sides = torch.linalg.det(matrix).abs(), matrix[:3, :3].norm(dim=0)
        if matrix[3].tolist() != [0, 0, 0, 1] or not bool(volume > 1e-12 * sides.prod()):
            raise ValueError(
                f"Clip: {name} must be an affine matrix that can be inverted, got {matrix.tolist()}"
            )
        inverse = torch.linalg.inv(matrix)
        length = inverse[:3, :3].norm(dim=1)
        axes = inverse[:3, :3] / length[:, None]
        start, end = -inverse[:3, 3] / length, (1 - inverse[:3, 3]) / length
    faces: list[Face] = []
    for axis, a, b in zip(axes, start.tolist(), end.tolist(), strict=True):
        faces += [(*axis.tolist(), -a), (*(-axis).tolist(), b)]
    return faces


def _convex_span(
    faces: Sequence[_FaceCrossing], first: Tensor, last: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns (r,) first and last distance, within [first, last], at which rays are inside all
    faces; last < first where they miss.
    """
    for _, height, rate in faces:
        t = -height / rate
        first = torch.where(rate > 0, torch.maximum(first, t), first)
        last = torch.where(rate < 0, torch.minimum(last, t), last)
        last = torch.where((rate == 0) & (height < 0), -torch.inf, last)
    return first, last


def _dot(normal: Sequence[float], vector: Sequence[Any]) -> Any:
    """Returns the dot product with a vector of three numbers or three (r,) columns."""
    x, y, z = vector
    return normal[0] * x + normal[1] * y + normal[2] * z
