"""`Clip`: the region of interest, from planes and boxes.

It acts on rays, so it is the same for every shader, and what is clipped is neither sampled nor
asked for. A ray is cut in float64 into the pieces of it that are kept, which are traced one after
the other. How many there can be follows from the number of boxes: those a ray has not are empty.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..base import check
from ..base.records import Hits, Rays
from ..cameras.camera import Frame
from .composite import Trace, behind, join, trace_pieces

Numbers = Sequence[Sequence[float]] | Tensor
Face = tuple[float, ...]  # unit normal and offset (a, b, c, d): inside, a x + b y + c z + d >= 0
_SEEN = 1e-4  # a cut through what has less alpha than this shows nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """What is kept of a scene: what lies inside all planes, inside some box if there are any, and
    inside no box of `without`.

    A box is its corners ((x, y, z), (x, y, z)), low and high, or a (4, 4) matrix that takes the
    unit cube [0, 1]^3 to it.
    """

    planes: Numbers = ()  # (p, 4): (a, b, c, d) keeps where a x + b y + c z + d >= 0
    boxes: Sequence[Numbers] = ()  # kept
    without: Sequence[Numbers] = ()  # cut away
    frame: Frame | str = Frame.WORLD  # world units, or the scene's box: centre 0, largest side 1
    caps: bool = False  # a cut through data is drawn as a flat surface
    cap_opacity: float = 1.0  # of that surface
    cap_light: float = 0.5  # share of its light that comes from the eye, where no `Lighting` is

    def __post_init__(self) -> None:
        """Checks all numbers.

        Raises:
            ValueError: A number is not finite, a normal is zero, a box has no volume, or a shape is
                wrong.
        """
        object.__setattr__(self, "frame", Frame.of("Clip", self.frame))
        check.number("Clip", "cap_opacity", self.cap_opacity, low=0, high=1, open_low=True)
        check.number("Clip", "cap_light", self.cap_light, low=0, high=1)
        _ = self._own

    @property
    def whole(self) -> bool:
        """Whether one piece is left of a ray, without a cap."""
        return len(self.boxes) <= 1 and not len(self.without) and not self.caps

    @cached_property
    def _own(self) -> Faces:
        """In the units of `frame`."""
        for name in ("planes", "boxes", "without"):
            if not isinstance(getattr(self, name), (Sequence, Tensor)):
                kind = type(getattr(self, name)).__name__
                raise ValueError(f"Clip: {name} must be a list, got {kind}")
        planes = list(self.planes)
        return Faces(
            [_face(f"planes[{i}]", plane) for i, plane in enumerate(planes)],
            [_box(f"boxes[{i}]", box) for i, box in enumerate(self.boxes)],
            [_box(f"without[{i}]", box) for i, box in enumerate(self.without)],
        )

    def faces(self, box: Tensor) -> Faces:
        """Returns the faces in world units, given the (2, 3) box of the scene."""
        if self.frame is Frame.WORLD:
            return self._own
        centre, side = ((box[0] + box[1]) / 2).tolist(), float((box[1] - box[0]).max())

        def place(faces: list[Face]) -> list[Face]:
            return [(*n, d * side - _dot(n, centre)) for *n, d in faces]

        planes, boxes, without = self._own
        return Faces(place(planes), [*map(place, boxes)], [*map(place, without)])


class Faces(NamedTuple):
    """The faces of a clip: convex sets, whose faces look inwards."""

    planes: list[Face]
    boxes: list[list[Face]]
    without: list[list[Face]]


class Clipped:
    """Traces what is kept of rays."""

    def __init__(
        self,
        trace: Trace,
        clip: Clip,
        box: Tensor,
        *,
        step: float,
        depth_alpha: float,
        slab: Trace | None = None,
        unlit: bool = False,
        together: Callable[[Iterable[Rays]], Hits] | None = None,
    ) -> None:
        """Takes what traces the pieces, the (2, 3) box of the scene, the shortest interval in world
        units, which is how deep a cap looks for its colour, where alpha means depth, what
        traces so far behind a cut, if that is not `trace`, whether caps get their light later, and
        what traces all pieces where one does not simply lie behind the other.
        """
        self._trace, self._clip, self._slab = trace, clip, slab or trace
        self._together = together or partial(trace_pieces, trace)
        self._step, self._hit_clear = step, 1 - depth_alpha
        self._cap_light = 0.0 if unlit else clip.cap_light
        planes, boxes, self._without = clip.faces(box)
        alone = len(boxes) == 1  # then what is kept is convex
        self._planes = planes + boxes[0] if alone else planes
        self._boxes = [] if alone else boxes

    def __call__(self, rays: Rays) -> Hits:
        """Traces the pieces of rays in world units, and the caps before them."""
        rays = dataclasses.replace(rays, range=rays.range.to(torch.float64))
        pieces = [dataclasses.replace(rays, range=kept) for kept in self.pieces(rays)]
        if not self._clip.caps:
            return self._together(pieces)
        front: Hits | None = None
        for piece in pieces:
            left = piece if front is None else behind(piece, front)
            cap = self._cap(left, rays.range[:, 0])
            front = cap if front is None else join(front, cap)
            front = join(front, self._trace(behind(piece, front)))
        assert front is not None
        return front

    def pieces(self, rays: Rays) -> list[Tensor]:
        """Returns (r, 2) first and last distances that are kept, nearest first, as many as a ray
        can have; an empty one ends where it begins.
        """
        first, last = _inside(self._planes, rays, *rays.range.unbind(1))
        last = torch.maximum(first, last)
        if not (self._boxes or self._without):
            return [torch.stack((first, last), 1)]
        everything = torch.full_like(first, -torch.inf), torch.full_like(first, torch.inf)
        boxes, without = (
            [_inside(faces, rays, *everything) for faces in faces_of]
            for faces_of in (self._boxes, self._without)
        )
        all_ends = [end.clamp(first, last) for span in boxes + without for end in span]
        ends = torch.stack([first, last, *all_ends], 1).sort(1).values
        low, high = ends[:, :-1], ends[:, 1:]
        middle = (low + high) / 2  # where something ends nothing changes between two ends
        kept = torch.full_like(middle, not boxes, dtype=torch.bool)
        for a, b in boxes:
            kept = kept | ((a[:, None] <= middle) & (middle <= b[:, None]))
        for a, b in without:
            kept = kept & ~((a[:, None] <= middle) & (middle <= b[:, None]))
        begins = kept.clone()
        begins[:, 1:] &= ~kept[:, :-1]
        number = begins.cumsum(1)
        pieces = []
        for piece in range(1, max(1, len(boxes)) + len(without) + 1):
            own = kept & (number == piece)
            a = torch.where(own, low, torch.inf).amin(1)
            b = torch.where(own, high, -torch.inf).amax(1)
            span = torch.stack((a, b), 1)
            pieces.append(torch.where((a < b)[:, None], span, first[:, None]))
        return pieces

    def _cap(self, piece: Rays, begin: Tensor) -> Hits:
        """What a cut shows where it is the beginning of a piece: one interval behind it tells the
        colour, features if there are, and whether there is anything.
        """
        first, last = piece.range.unbind(1)
        end = torch.where(first > begin, torch.minimum(first + self._step, last), first)
        slab = self._slab(dataclasses.replace(piece, range=torch.stack((first, end), 1)))
        clear = torch.ones_like(first) if piece.clear is None else piece.clear
        clear = clear.to(slab.color.dtype)
        share = clear - (1 - slab.alpha[:, 0])  # of the light, that the slab takes
        alpha = torch.where(share > _SEEN * clear, self._clip.cap_opacity, 0.0).to(clear)
        facing, normal = self._facing(piece, first)
        light = 1 - self._cap_light * (1 - facing)
        part = clear * alpha / torch.where(alpha > 0, share, 1.0)
        scale = clear * alpha * light.to(clear) / torch.where(alpha > 0, share, 1.0)
        left = clear * (1 - alpha)
        hit = (left < self._hit_clear) & (clear >= self._hit_clear)
        return Hits(
            color=slab.color * scale[:, None],
            alpha=(1 - left)[:, None],
            depth=torch.where(hit, first.to(clear), torch.inf)[:, None],
            samples=slab.samples,
            missed=slab.missed,
            normal=None if slab.normal is None else normal.to(clear) * (alpha > 0)[:, None],
            features=None if slab.features is None else slab.features * part[:, None],
        )

    def _facing(self, rays: Rays, t: Tensor) -> tuple[Tensor, Tensor]:
        """(r,) cosine between the ray and the normal of the face at distance t, and (r, 3) that
        normal, towards the eye: the nearest face of those through which rays come in.
        """
        nearest, cosine = torch.full_like(t, torch.inf), torch.ones_like(t)
        normal = [torch.zeros_like(t)] * 3
        kept = [face for faces in ([self._planes], self._boxes) for some in faces for face in some]
        cut = [face for faces in self._without for face in faces]
        for side, faces in ((1, kept), (-1, cut)):
            for face in faces:
                height, rate = _height(face, rays)
                away = torch.where(side * rate > 0, (height + t * rate).abs(), torch.inf)
                cosine = torch.where(away < nearest, rate.abs(), cosine)
                sides = zip(face, normal, strict=False)
                normal = [torch.where(away < nearest, -side * n, known) for n, known in sides]
                nearest = torch.minimum(away, nearest)
        return cosine, torch.stack(normal, 1)


def _height(face: Face, rays: Rays) -> tuple[Tensor, Tensor]:
    """(r,) how far each ray's origin lies inside of a face, and by how much that grows with t."""
    *normal, offset = face
    height = _dot(normal, rays.origin.to(torch.float64).unbind(1)) + offset
    return height, _dot(normal, rays.direction.to(torch.float64).unbind(1))


def _dot(normal: Sequence[float], vector: Sequence[Any]) -> Any:
    x, y, z = vector
    return normal[0] * x + normal[1] * y + normal[2] * z


def _inside(faces: list[Face], rays: Rays, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a convex set, (r,) each, cut out of [first, last]; they leave
    before they enter where they pass by.
    """
    for face in faces:
        height, rate = _height(face, rays)
        t = -height / rate
        first = torch.where(rate > 0, torch.maximum(first, t), first)
        last = torch.where(rate < 0, torch.minimum(last, t), last)
        last = torch.where((rate == 0) & (height < 0), -torch.inf, last)
    return first, last


def _face(name: str, numbers: Any) -> Face:
    a, b, c, d = _matrix(name, [numbers], (1, 4))[0].tolist()
    length = math.hypot(a, b, c)
    if length == 0:
        raise ValueError(f"Clip: {name} has a normal of length 0: {numbers!r}")
    return (a / length, b / length, c / length, d / length)


def _box(name: str, numbers: Any) -> list[Face]:
    """The six faces of a box."""
    if not hasattr(numbers, "__len__"):
        raise ValueError(f"Clip: {name} must be two corners or a (4, 4) matrix, got {numbers!r}")
    if len(numbers) == 2:
        low, high = _matrix(name, numbers, (2, 3))
        if not bool((low < high).all()):
            raise ValueError(
                f"Clip: {name} must have its low corner below its high one on each axis, "
                f"got {low.tolist()} and {high.tolist()}"
            )
        axes, start, end = torch.eye(3, dtype=torch.float64), low, high
    else:
        matrix = _matrix(name, numbers, (4, 4))
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


def _matrix(name: str, numbers: Any, shape: tuple[int, int]) -> Tensor:
    """A float64 matrix of this shape, finite, on the CPU."""
    try:
        matrix = torch.as_tensor(numbers, dtype=torch.float64).detach().cpu()
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"Clip: {name} must be {shape} numbers, got {numbers!r}") from None
    if matrix.shape != shape:
        raise ValueError(f"Clip: {name} must be {shape}, got {tuple(matrix.shape)}")
    if not bool(torch.isfinite(matrix).all()):
        raise ValueError(f"Clip: {name} must be finite, got {numbers!r}")
    return matrix
