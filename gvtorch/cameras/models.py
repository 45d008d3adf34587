"""Camera models: from positions on the image plane, x = (u - cx) / fx and y = (v - cy) / fy, to
rays, on the device. Axes are OpenCV's: x right, y down, z forward.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.records import Rays
from ..ops import pinhole_rays
from ..ops.cameras import PinholeColumns

CameraModel = Literal["pinhole", "ortho", "fisheye", "panorama"]
_MIN_FOV = 1e-12  # degrees; of smaller ones focal lengths would not be finite
_NEWTON_STEPS = 20  # one that leaves the bracket halves it instead
_EDGE_TOLERANCE = 1 + 1e-12  # at the edges of fisheye and panorama
_MAX_HALF_ANGLE = math.radians(45)  # largest half angle that a fitted box spans in a wide view
#: Least distance of an ortho camera from the box's centre, over the nearest corner's.
_ORTHO_CLEARANCE = 1.02


class CameraColumns(PinholeColumns):
    """Columns of `Camera.numbers`: a pinhole's, and those that the op does not read."""

    COEFFICIENTS = slice(20, 24)  # of a fisheye
    MAX_ANGLE = slice(24, 25)  # of a fisheye's rays to the axis, radians
    SAMPLE = slice(25, 26)  # see `Rays.sample`


@dataclass(frozen=True)
class PixelRows:
    """Rows of pixels on the image planes of cameras: y rows of w pixels, r = y * w in all."""

    cameras: Tensor  # (n, 26) float64, see `CameraColumns`
    rows: tuple[int, int]  # the first one and the one after the last, counted through the batch
    width: int
    height: int  # of one picture
    distorted: bool  # the coefficients of a fisheye are used

    @cached_property
    def row(self) -> Tensor:
        """(y,) int64, counted through the batch."""
        return torch.arange(*self.rows, device=self.cameras.device)

    @cached_property
    def numbers(self) -> Tensor:
        """(k, 26) float64: k is 1 where all rows are one camera's, else y."""
        return self.cameras if len(self.cameras) == 1 else self.cameras[self.row // self.height]

    @cached_property
    def x(self) -> Tensor:
        """(k, w) float64."""
        column = torch.arange(self.width, dtype=torch.float64, device=self.cameras.device)
        return (column - self.center[:, :1]) / self.focal[:, :1]

    @cached_property
    def y(self) -> Tensor:
        """(y,) float64."""
        return (self.row % self.height - self.center[:, 1]) / self.focal[:, 1]

    @property
    def focal(self) -> Tensor:
        """(k, 2) focal lengths fx and fy, pixels."""
        return self.numbers[:, CameraColumns.FOCAL]

    @property
    def center(self) -> Tensor:
        """(k, 2) principal point, pixels."""
        return self.numbers[:, CameraColumns.CENTER]

    @property
    def rotation(self) -> Tensor:
        """(k, 3, 3) world to camera."""
        return self.numbers[:, CameraColumns.ROTATION].unflatten(1, (3, 3))

    @property
    def position(self) -> Tensor:
        """(k, 3) world."""
        return self.numbers[:, CameraColumns.POSITION]

    def spread(self, values: Tensor) -> Tensor:
        """Repeats (k, c) for all rays, (r, c); values of a single camera are not copied."""
        rays = (self.rows[1] - self.rows[0]) * self.width
        if len(values) == 1:
            return values.expand(rays, -1)
        return values[:, None].expand(-1, self.width, -1).reshape(rays, -1)

    def to_world(self, local: Tensor) -> Tensor:
        """Returns (y, w, 3) directions in camera axes as world directions."""
        parts = (local[..., i, None] * self.rotation[:, None, i] for i in range(3))
        return sum(parts, torch.zeros_like(local))

    def rays(
        self,
        direction: Tensor,
        *,
        origin: Tensor | None = None,
        widening: Tensor | None = None,
        inside: Tensor | None = None,
    ) -> Rays:
        """Returns the rays of all pixels. `direction` is (y, w, 3) or (r, 3), of unit length, and
        `origin` (y, w, 3), by default the camera's position; `widening` (y, w) is a factor on the
        cones, and pixels that are not `inside` (y, w) get an empty range.
        """
        cone = self.spread(self.numbers[:, CameraColumns.CONE])
        limits = self.spread(self.numbers[:, CameraColumns.RANGE])
        if widening is not None:
            cone = cone * widening.reshape(-1, 1)
        if inside is not None:
            limits = torch.where(inside.reshape(-1, 1), limits, 0.0)
        return Rays(
            origin=self.spread(self.position) if origin is None else origin.reshape(-1, 3),
            direction=direction.reshape(-1, 3),
            cone=cone,
            range=limits,
            width=self.width,
        )


class Model(ABC):
    """A camera model.

    Attributes:
        fov: Default vertical field of view, degrees.
        widest: Largest vertical field of view, degrees.
        parallel: Rays are parallel; focal lengths are pixels per world unit, and cones do not grow.
        planar: The image is a plane: all pixels are equally wide at a distance along the axis.
            Else its focal lengths are pixels per radian.
        has_distortion: Radial coefficients and a largest angle to the axis are allowed.
    """

    fov = 30.0
    widest = 179.0
    parallel = False
    planar = True
    has_distortion = False

    def checked_fov(self, context: str, fov: float) -> float:
        """Returns a vertical field of view, degrees; raises ValueError if it is out of range."""
        return check.number(context, "fov", fov, low=_MIN_FOV, high=self.widest)

    def focal(self, fov: float, width: int, height: int) -> tuple[float, float]:
        """Returns fx and fy for a vertical field of view, radians; if parallel, at distance 1."""
        length = 0.5 * height / math.tan(0.5 * fov)
        return length, length

    def fit(self, corners: Tensor, half_x: float, half_y: float) -> tuple[Tensor, Tensor]:
        """Returns the distance at which all corners of a box are in the picture, and the distance
        by which a parallel camera's focal lengths are divided, (n,) each. Corners (n, 8, 3) are
        relative to the box's centre, in camera axes; they may reach `half_x` and `half_y` from the
        middle of the image plane at distance 1.
        """
        depths, depth = self.edge_depth(corners, half_x, half_y), corners[..., 2]
        distance = (depths - depth).amax(1)
        return distance, distance

    def edge_depth(self, corners: Tensor, half_x: float, half_y: float) -> Tensor:
        """Returns the depth (n, 8) at which corners lie on the edge of what they may reach."""
        x, y, _ = corners.abs().unbind(-1)
        return torch.maximum(x / half_x, y / half_y)

    @abstractmethod
    def rays(self, pixels: PixelRows) -> Rays:
        """Returns the rays through the pixels' centres."""


class Pinhole(Model):
    """The direction is (x, y, 1)."""

    def rays(self, pixels: PixelRows) -> Rays:
        (first, end), sizes = pixels.rows, (pixels.width, pixels.height)
        columns = pinhole_rays(pixels.cameras.contiguous(), first, end - first, *sizes)
        fields = dict(zip(("origin", "direction", "cone", "range"), columns, strict=True))
        return Rays(**fields, width=pixels.width)


class Ortho(Model):
    """The origin moves by (x, y); all directions are (0, 0, 1)."""

    parallel = True

    def fit(self, corners: Tensor, half_x: float, half_y: float) -> tuple[Tensor, Tensor]:
        """Keeps the eye in front of the box, however small the scale is."""
        scale = self.edge_depth(corners, half_x, half_y).amax(1)
        return torch.maximum(scale, _ORTHO_CLEARANCE * corners[..., 2].abs().amax(1)), scale

    def rays(self, pixels: PixelRows) -> Rays:
        rotation = pixels.rotation
        across = pixels.x[..., None] * rotation[:, None, 0]
        down = pixels.y[:, None] * rotation[:, 1] + pixels.position
        return pixels.rays(pixels.spread(rotation[:, 2]), origin=across + down[:, None])


class Fisheye(Model):
    """Equidistant: the angle to the axis is the distance from the middle. With four coefficients it
    is the angle t for which t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) is that distance.

    Source: Kannala and Brandt, "A generic camera model and calibration method for conventional,
    wide-angle, and fish-eye lenses", PAMI 2006, eq. 6; OpenCV's fisheye model.
    """

    fov, widest, planar, has_distortion = 180.0, 360.0, False, True

    def focal(self, fov: float, width: int, height: int) -> tuple[float, float]:
        """A unit of the image plane is a radian."""
        return height / fov, height / fov

    def edge_depth(self, corners: Tensor, half_x: float, half_y: float) -> Tensor:
        """Keeps corners within a cone, which is convex: straight edges between them stay inside."""
        return corners[..., :2].norm(dim=-1) / math.tan(min(half_x, half_y, _MAX_HALF_ANGLE))

    def rays(self, pixels: PixelRows) -> Rays:
        x, y = pixels.x, pixels.y[:, None]
        k = pixels.numbers[:, CameraColumns.COEFFICIENTS]
        limit = pixels.numbers[:, CameraColumns.MAX_ANGLE]
        radius = (x * x + (y * y)).sqrt()  # (y, w)
        angle = undistort(radius, k, limit) if pixels.distorted else radius
        scale = torch.where(radius > 0, angle.sin() / radius, 1.0)
        across = torch.stack((x.expand_as(radius), y.expand_as(radius)), -1)
        local = torch.cat((scale[..., None] * across, angle.cos()[..., None]), -1)
        edge, widening = limit, None
        if pixels.distorted:
            edge = distort(limit, k)
            # Along the radius a pixel spans 1 / slope, across it sin(angle) / radius.
            widening = torch.maximum(1 / slope(angle, k), scale)
        inside = radius <= edge * _EDGE_TOLERANCE
        return pixels.rays(pixels.to_world(local), widening=widening, inside=inside)


class Panorama(Model):
    """Equirectangular: x is the longitude and y the latitude (down), in radians."""

    fov, widest, planar = 180.0, 180.0, False

    def focal(self, fov: float, width: int, height: int) -> tuple[float, float]:
        """A unit of the image plane is a radian; a picture spans twice the angle horizontally."""
        return width / (2 * fov), height / fov

    def edge_depth(self, corners: Tensor, half_x: float, half_y: float) -> Tensor:
        """Keeps corners within a frustum: straight edges would bulge out of a band of angles."""
        tangents = (math.tan(min(half_extent, _MAX_HALF_ANGLE)) for half_extent in (half_x, half_y))
        return super().edge_depth(corners, *tangents)

    def rays(self, pixels: PixelRows) -> Rays:
        latitude = pixels.y[:, None].expand(-1, pixels.x.shape[-1])
        longitude = pixels.x.expand_as(latitude)
        cos_latitude = latitude.cos()
        parts = (longitude.sin() * cos_latitude, latitude.sin(), longitude.cos() * cos_latitude)
        below_poles = latitude.abs() <= _EDGE_TOLERANCE * math.pi / 2
        inside = below_poles & (longitude.abs() <= _EDGE_TOLERANCE * math.pi)
        # A pixel spans 1 / fy radians down, and along its circle of latitude cos / fx.
        fx, fy = pixels.focal.unbind(1)
        span = torch.maximum(pixels.y.cos() / fx, 1 / fy) * torch.minimum(fx, fy)
        widening = span[:, None].expand_as(latitude)
        direction = pixels.to_world(torch.stack(parts, -1))
        return pixels.rays(direction, widening=widening, inside=inside)


#: Every camera model by its name.
MODELS: dict[str, Model] = {
    "pinhole": Pinhole(),
    "ortho": Ortho(),
    "fisheye": Fisheye(),
    "panorama": Panorama(),
}


def model_of(context: str, name: str) -> Model:
    """Returns the camera model of a name; raises ValueError where there is none."""
    check.one_of(context, "model", name, MODELS)
    return MODELS[name]


def distort(angle: Tensor, k: Tensor) -> Tensor:
    """Returns distances from the middle, in focal lengths, of angles (..., w); `k` is (..., 4)."""
    a2, (k1, k2, k3, k4) = angle * angle, k.split(1, -1)
    return angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))


def slope(angle: Tensor, k: Tensor) -> Tensor:
    """Returns the derivative of `distort` by the angle."""
    a2, (k1, k2, k3, k4) = angle * angle, k.split(1, -1)
    return 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))


def undistort(radius: Tensor, k: Tensor, limit: Tensor) -> Tensor:
    """Returns the angle in [0, limit] whose `distort` is the radius: by Newton's steps, and by
    halving the bracket where they leave it. `distort` must rise up to the limit.
    """
    low, high = torch.zeros_like(radius), limit.expand_as(radius)
    angle = torch.minimum(radius, high)
    for _ in range(_NEWTON_STEPS):
        excess = distort(angle, k) - radius
        low, high = torch.where(excess < 0, angle, low), torch.where(excess < 0, high, angle)
        step = angle - excess / slope(angle, k)
        in_bracket = (step > low - 1e-12) & (step < high + 1e-12)
        angle = torch.where(in_bracket, step, (low + high) / 2)
    return angle


def last_rising_angle(k: Tensor) -> float:
    """Returns the largest angle, at most pi, up to which `distort` rises; `k`: (4,) on the CPU."""
    k1, k2, k3, k4 = k.tolist()
    roots = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots.real[(abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return min([math.pi, *np.sqrt(real).tolist()])
