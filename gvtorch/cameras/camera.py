"""`Camera`: one camera or a batch, of one of the `models`, and the rays through its pixels.

Conventions: camera axes are OpenCV's (x right, y down, z forward); pixel (i, j) covers [i, i + 1)
x [j, j + 1) of the image plane, its centre is at +0.5 (so do gsplat and nerfstudio; kornia puts
centres at integers, and `from_kornia` and `to_kornia` shift the principal point by half a pixel).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..base import check
from ..base.constants import MAX_PICTURE_SIDE
from ..base.records import Rays
from ..pool.staging import upload
from .models import MODELS, CameraColumns, CameraModel, PixelRows, last_rising_angle, model_of
from .poses import (
    Coordinates,
    Numbers,
    Up,
    batches,
    check_matrices,
    continued,
    look_at_pose,
    orbit_pose,
    upward,
)

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

_FIT_FRACTION = 0.98  # share of half the picture's width or height that a fitted box takes


class CameraForm(NamedTuple):
    """What cameras must share to be drawn by the same graph."""

    cameras: int  # their number
    height: int  # pixels
    width: int
    batched: bool
    model: CameraModel
    distorted: bool
    window: tuple[int, int]  # see `Camera`

    def __str__(self) -> str:
        return f"{self.cameras} of {self.width}x{self.height} pixels ({self.model})"


class Camera:
    """Cameras that share width, height and model. Threads may share them while none changes them.

    Attributes:
        viewmats: (n, 4, 4) float64, world (or box) to camera.
        Ks: (n, 3, 3) float64 intrinsics in pixels; focal lengths are pixels a unit of slope
            (pinhole), a radian (fisheye, panorama), or a world unit or side of the box (ortho).
        radial_coeffs: (n, 4) float64 distortion of a fisheye.
        max_angle: (n,) float64 radians; a fisheye's rays beyond it have an empty range.
        window: First row of this camera, which may be a strip, and rows of the whole picture.
        sample: Number of this sample among those of its pixels; see `Rays.sample`.
        batched: False for one camera whose pictures have no batch dimension.
        fitted: Half width and height of the whole picture at distance 1 if `placed` is to find the
            distance from the box's proportions; else None.
    """

    sample = 0
    fitted: tuple[float, float] | None = None
    columns: Any = CameraColumns  # of `numbers`

    def __init__(
        self,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        *,
        model: CameraModel = "pinhole",
        radial_coeffs: Numbers | None = None,
        max_angle: float = 180.0,
        frame: Coordinates = Coordinates.WORLD,
    ) -> None:
        """Takes matrices (4, 4) and (3, 3), or batches (n, 4, 4) and (n, 3, 3); see the class.

        Args:
            viewmats, Ks: World to camera, and intrinsics.
            width, height: Pixels.
            model: pinhole, ortho, fisheye (equidistant) or panorama (equirectangular).
            radial_coeffs: (4,) or (n, 4) of a fisheye, as OpenCV and gsplat have them.
            max_angle: Of a fisheye, degrees from the axis; pixels beyond show the background.
            frame: What positions are relative to.

        Raises:
            ValueError: A wrong shape, a value that is not finite, a focal length that is not
                positive or a matrix that is no rotation.
        """
        model_of("Camera", model)
        self.model, self.frame = model, frame
        self.width = check.integer("Camera", "width", width, low=1, high=MAX_PICTURE_SIDE)
        self.height = check.integer("Camera", "height", height, low=1, high=MAX_PICTURE_SIDE)
        self.window = (0, self.height)
        view, K = batches("Camera", viewmats=(viewmats, (4, 4)), Ks=(Ks, (3, 3)))
        self.batched = view.dim() == 3
        self.viewmats, self.Ks = view.reshape(-1, 4, 4), K.reshape(-1, 3, 3)
        check_matrices(self.viewmats, self.Ks)
        angle = check.number("Camera", "max_angle", max_angle, low=0, high=180, open_low=True)
        self.max_angle = torch.full(
            (len(self),), math.radians(angle), dtype=torch.float64, device="cpu"
        )
        self.radial_coeffs = torch.zeros(len(self), 4, dtype=torch.float64, device="cpu")
        if radial_coeffs is not None:
            self._distort(check.reals("Camera", "radial_coeffs", radial_coeffs))
        self.distorted = bool((self.radial_coeffs != 0).any())

    def _distort(self, coefficients: Tensor) -> None:
        if not MODELS[self.model].has_distortion:
            raise ValueError(f"Camera: radial_coeffs are for a fisheye, got model {self.model!r}")
        shape, count = tuple(coefficients.shape), len(self)
        if shape not in ((4,), (1, 4), (count, 4)):
            raise ValueError(f"Camera: radial_coeffs must be (4,) or ({count}, 4), got {shape}")
        self.radial_coeffs = coefficients.expand(count, 4).contiguous()
        rising = [last_rising_angle(row) for row in self.radial_coeffs]
        self.max_angle = torch.minimum(
            self.max_angle, torch.tensor(rising, dtype=torch.float64, device="cpu")
        )

    @classmethod
    def orbit(
        cls,
        azimuth: Numbers = 30.0,
        elevation: Numbers = 20.0,
        distance: Numbers | None = None,
        fov: float | None = None,
        width: int = 512,
        height: int = 512,
        model: CameraModel = "pinhole",
        *,
        up: Up = "+y",
        fit: bool = False,
    ) -> Camera:
        """Looks at the centre of the scene's box from a sphere around it.

        position = centre + distance * L * (sin az cos el, sin el, cos az cos el), L the box's
        largest side, where +y is up. For another `up` this is rotated: +x still points to the right
        at azimuth 0 (+y, where up is nearly x), so with +z up the eye is at -y.

        Args:
            azimuth: Degrees; a number, or (n,) for a batch.
            elevation: Degrees; a number or (n,).
            distance: In largest sides of the box, > 0; a number or (n,); 2.4 if left out.
            fov, width, height, model: See `look_at`.
            up: +x, -x, +y, -y, +z, -z, or (3,) world.
            fit: Finds the distance from which the whole box just fits into the picture, when the
                camera is `placed`. For a fisheye or panorama the box spans at most 90 degrees.

        Raises:
            ValueError: A number is out of its range, or both `fit` and a distance are given.
        """
        context = "Camera.orbit"
        if fit and distance is not None:
            raise ValueError(f"{context}: fit finds the distance: leave it out, got {distance!r}")
        distance = (1.0 if fit else 2.4) if distance is None else distance
        numbers = {"azimuth": azimuth, "elevation": elevation, "distance": distance}
        az, el, distances = batches(context, **{n: (value, ()) for n, value in numbers.items()})
        if bool((distances <= 0).any()):
            raise ValueError(f"{context}: distance must be > 0, got {distance!r}")
        axis = None if isinstance(up, str) and up == "+y" else upward(context, up)
        view = orbit_pose(az.deg2rad(), el.deg2rad(), distances, axis)
        camera = _aimed(context, view, distances, fov, width, height, model, Coordinates.BOX)
        if fit:
            focal = camera.Ks[0, (0, 1), (0, 1)].tolist()
            camera.fitted = (0.5 * width / focal[0], 0.5 * height / focal[1])
        return camera

    @classmethod
    def fit(
        cls,
        box: Sequence[Sequence[float]] | Tensor,
        azimuth: Numbers = 30.0,
        elevation: Numbers = 20.0,
        fov: float | None = None,
        width: int = 512,
        height: int = 512,
        model: CameraModel = "pinhole",
        *,
        up: Up = "+y",
    ) -> Camera:
        """Looks at a box, (2, 3) world, from the distance at which all of it just fits into the
        picture, as `orbit` with `fit` does; the camera is in world units.
        """
        corners = check.reals("Camera.fit", "box", box, (2, 3))
        if not bool((corners[1] > corners[0]).all()):
            got = corners.tolist()
            raise ValueError(f"Camera.fit: box must have its low corner below, got {got}")
        camera = cls.orbit(azimuth, elevation, None, fov, width, height, model, up=up, fit=True)
        return camera.placed(corners)

    @classmethod
    def look_at(
        cls,
        eye: Sequence[float] | Tensor,
        target: Sequence[float] | Tensor,
        up: Up = (0.0, 1.0, 0.0),
        fov: float | None = None,
        width: int = 512,
        height: int = 512,
        model: CameraModel = "pinhole",
    ) -> Camera:
        """Looks from `eye` at `target`, in world units.

        Args:
            eye: (3,) or (n, 3).
            target: (3,) or (n, 3).
            up: (3,) or (n, 3), or a name such as "+z"; where it is parallel to the view, -z is used
                instead (or +y, if the view is along z).
            fov: Vertical field of view, degrees. By default 30 for a pinhole and for an
                orthographic camera, which shows what a pinhole would at the target's distance; 180
                for a fisheye, whose circle is as high as the picture, and for a panorama, twice as
                wide as high.
            width, height: Pixels.
            model: Name of the camera model.

        Raises:
            ValueError: A position is not finite, up is zero, or eye and target are the same.
        """
        context = "Camera.look_at"
        up = upward(context, up) if isinstance(up, str) else up
        eye_, target_, up_ = batches(context, eye=(eye, (3,)), target=(target, (3,)), up=(up, (3,)))
        if bool((up_ == 0).all(-1).any()):
            raise ValueError(f"{context}: up must not be zero")
        forward = target_ - eye_
        length = forward.norm(dim=-1, keepdim=True)
        if bool((length == 0).any()):
            raise ValueError(f"{context}: eye and target are at the same position, {eye!r}")
        view = look_at_pose(eye_, forward / length, up_)
        return _aimed(context, view, length[..., 0], fov, width, height, model, Coordinates.WORLD)

    @classmethod
    def from_viewmat_K(
        cls,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        camera_model: CameraModel = "pinhole",
        radial_coeffs: Tensor | None = None,
    ) -> Camera:
        """Takes gsplat's arguments: (..., 4, 4) world-to-camera (OpenCV), (..., 3, 3) intrinsics,
        the camera model by its name there, and (..., 4) coefficients of a fisheye. Leading
        dimensions are flattened to one batch.
        """
        matrices = {"viewmats": viewmats, "Ks": Ks}
        given = (check.reals("Camera.from_viewmat_K", *item) for item in matrices.items())
        view, K = (m.flatten(0, -3) if m.dim() > 3 else m for m in given)
        if isinstance(radial_coeffs, Tensor) and radial_coeffs.dim() > 2:
            radial_coeffs = radial_coeffs.flatten(0, -2)
        return Camera(view, K, width, height, model=camera_model, radial_coeffs=radial_coeffs)

    @classmethod
    def from_kornia(cls, camera: PinholeCamera) -> Camera:
        """Takes kornia's `PinholeCamera` (a batch), whose pixel centres are at integers."""
        if not hasattr(camera, "extrinsics"):  # kornia takes a second to import
            raise ValueError(
                f"Camera.from_kornia: takes a PinholeCamera, got {check.as_text(camera)}"
            )
        sizes = torch.stack((camera.height, camera.width)).long().unique(dim=1)
        if sizes.shape[1] != 1:
            raise ValueError("Camera.from_kornia: all cameras must have one height and width")
        Ks = camera.intrinsics[:, :3, :3].to("cpu", torch.float64).clone()
        Ks[:, :2, 2] += 0.5
        view = camera.extrinsics.to("cpu", torch.float64)
        return Camera(view, Ks, int(sizes[1, 0]), int(sizes[0, 0]))

    def to_kornia(self) -> Any:
        """Returns the batch as kornia's `PinholeCamera`, float64.

        Raises:
            ValueError: The camera is no pinhole.
        """
        from kornia.geometry.camera import PinholeCamera

        if self.model != "pinhole":
            raise ValueError(f"Camera.to_kornia: the camera must be a pinhole, is {self.model!r}")
        intrinsics = torch.eye(4, dtype=torch.float64, device="cpu").repeat(len(self), 1, 1)
        intrinsics[:, :3, :3] = self.Ks
        intrinsics[:, :2, 2] -= 0.5
        size = torch.ones(len(self), dtype=torch.float64, device="cpu")
        return PinholeCamera(intrinsics, self.viewmats, self.height * size, self.width * size)

    def __len__(self) -> int:
        """Number of cameras."""
        return self.viewmats.shape[0]

    def __repr__(self) -> str:
        count = f"{len(self)} x " if self.batched else ""
        size, frame = f"{count}{self.width}x{self.height}", self.frame.value
        return f"{type(self).__name__}({size}, {self.model}, in {frame} units)"

    def __getitem__(self, index: int) -> Camera:
        """Returns one camera of the batch."""
        first = range(len(self))[index]
        changes = {name: getattr(self, name)[first : first + 1] for name in _BATCHED_FIELDS}
        return self._copy_with(**changes, batched=False)

    def _copy_with(self, **changes: Any) -> Camera:
        camera = object.__new__(type(self))
        vars(camera).update(vars(self), **changes)
        return camera

    @property
    def form(self) -> CameraForm:
        """What cameras must share to be drawn by the same graph."""
        size = (len(self), self.height, self.width)
        return CameraForm(*size, self.batched, self.model, self.distorted, self.window)

    def same(self, other: Camera) -> bool:
        """Whether another camera has the same rays; does not wait for a device."""
        own, theirs = ((camera.form, camera.frame, camera.fitted) for camera in (self, other))
        return own == theirs and all(
            torch.equal(getattr(self, name), getattr(other, name)) for name in _BATCHED_FIELDS
        )

    def placed(self, box: Tensor) -> Camera:
        """Returns the camera in world units, given the (2, 3) box of the scene."""
        if self.frame is Coordinates.WORLD:
            return self
        check.instance("Camera.placed", "box", box, Tensor)
        # NumPy, here and in `numbers`: calls of torch take longer, and release the GIL, for which
        # the frame would queue again and again behind the threads that read a store.
        low, high = box.numpy()
        centre, side, Ks = (low + high) / 2, (high - low).max(), self.Ks
        view = self.viewmats.numpy().copy()
        rotation, translation = view[:, :3, :3], view[:, :3, 3]
        turned_centre = _sum_of_three(rotation.swapaxes(0, 2), centre).T
        if self.fitted is None:
            translation[:] = translation * side - turned_centre
            scale: Any = side
        else:
            corners = torch.stack([box[corner, (0, 1, 2)] for corner in _CORNERS])
            in_camera = (corners - torch.from_numpy(centre)) @ torch.from_numpy(rotation).mT
            half_extents = [_FIT_FRACTION * half_extent for half_extent in self.fitted]
            distance, scale = MODELS[self.model].fit(in_camera, *half_extents)  # (n,) each
            translation[:] = -turned_centre
            translation[:, 2] += distance.numpy()
            scale = scale[:, None]
        if MODELS[self.model].parallel:
            Ks = Ks.clone()
            Ks[:, (0, 1), (0, 1)] /= scale
        changes = {"viewmats": torch.from_numpy(view), "Ks": Ks}
        return self._copy_with(**changes, frame=Coordinates.WORLD, fitted=None)

    def pixel_width(self, distance: float) -> float:
        """Returns the width of a pixel in world units: of a pinhole at a distance along its axis,
        of an orthographic camera at any distance.

        Raises:
            ValueError: It is a fisheye or a panorama, a batch, or relative to a box.
        """
        context, model = "Camera.pixel_width", MODELS.get(self.model)
        placed = len(self) == 1 and self.frame is Coordinates.WORLD
        if model is None or not (model.planar and placed):  # None: of a `CustomCamera`
            wanted = "one pinhole or ortho camera in the world"
            raise ValueError(f"{context}: takes {wanted}, got {self}")
        distance = check.number(context, "distance", distance, low=0, open_low=True)
        return (1.0 if model.parallel else distance) / float(self.Ks[0, 0, 0])

    def shifted(self, dx: float, dy: float, sample: int | None = None) -> Camera:
        """Returns the camera whose rays pass (dx, dy) pixels to the right of and below the centres
        of the pixels, with another `sample` number if given.
        """
        Ks = self.Ks.clone()
        Ks[:, :2, 2] -= torch.tensor([dx, dy], dtype=torch.float64, device="cpu")
        return self._copy_with(Ks=Ks, sample=self.sample if sample is None else sample)

    def strip(self, first: int, end: int) -> Camera:
        """Returns the camera of the rows [first, end) of each picture."""
        window = (self.window[0] + first, self.window[1])
        return self.shifted(0, first)._copy_with(height=end - first, window=window)

    def numbers(self, device: torch.device | str = "cpu") -> Tensor:
        """Returns what `pixel_rays` reads, (n, 26) float64, see `CameraColumns`; does not block.

        Raises:
            ValueError: The camera is relative to a box: call `placed(box)` first.
        """
        if self.frame is not Coordinates.WORLD:
            raise ValueError("Camera.rays: an orbit camera has no position: call placed(tree.box)")
        view, intrinsics = self.viewmats.numpy(), self.Ks.numpy()
        rotation, translation = view[:, :3, :3], view[:, :3, 3]
        focal, centre = intrinsics[:, (0, 1), (0, 1)], intrinsics[:, :2, 2] - 0.5
        position = -_sum_of_three(rotation.swapaxes(0, 1), translation.T[..., None])  # -R^T t
        pixel, zero = 1 / focal.min(1, keepdims=True), np.zeros((len(self), 1))
        cone = (pixel, zero) if MODELS[self.model].parallel else (zero, pixel)
        range_ = (zero, zero + math.inf)
        lens = (self.radial_coeffs.numpy(), self.max_angle.numpy()[:, None])
        parts = (rotation.reshape(-1, 9), position, focal, centre, *cone, *range_, *lens)
        numbers = np.concatenate((*parts, zero + self.sample), 1)
        return upload(torch.from_numpy(numbers), torch.device(device))

    def thinned(self, stride: int) -> Camera:
        """Returns the camera with one ray per stride x stride pixels; see `numbers_ahead`."""
        height, width = (-(-size // stride) for size in (self.height, self.width))
        return self._copy_with(height=height, width=width, window=(0, height))

    def numbers_ahead(self, now: Tensor, before: Tensor, frames: float, stride: int) -> Tensor:
        """Returns the numbers of the camera `thinned` by `stride`, extrapolated by `frames` frames
        from the `numbers` of the last two frames; see `continued`. Each ray passes through the
        middle of its pixels, and its cone is as wide as one of them.
        """
        at = CameraColumns
        moved = continued(now, before, frames, at.POSE, at.ROTATION)
        moved[:, at.FOCAL] /= stride
        moved[:, at.CENTER] = (moved[:, at.CENTER] - (stride - 1) / 2) / stride
        return moved

    def pixel_rays(self, numbers: Tensor, rows: tuple[int, int]) -> Rays:
        """Returns the rays through the pixel centres of whole rows, from the result of `numbers`.
        `rows`: the first one and the one after the last, counted through the batch.
        """
        pixels = PixelRows(numbers, rows, self.width, self.height, self.distorted)
        return MODELS[self.model].rays(pixels)

    def pixel_samples(self, numbers: Tensor, rows: tuple[int, int]) -> Tensor:
        """Returns `Rays.sample` of whole rows, counted as for `pixel_rays`."""
        row = torch.arange(*rows, device=numbers.device)
        column = torch.arange(self.width, device=numbers.device)
        samples = numbers[:, self.columns.SAMPLE]
        pictures = samples.reshape(len(self), -1)[:, 0]  # custom: a row per ray, all alike
        sample = pictures[row // self.height].to(torch.int64) << 32
        first = (self.window[0] + row % self.height) * self.width
        return ((sample + first)[:, None] + column).flatten()

    def blocks(self, pixels: int) -> Iterator[tuple[int, int]]:
        """Yields the rows of all pictures in blocks of about this many pixels, at least one row
        each: first row and the row after the last, as `pixel_rays` takes them.
        """
        rows, block = len(self) * self.height, max(1, pixels // self.width)
        for first in range(0, rows, block):
            yield first, min(first + block, rows)

    def image(self, column: Tensor) -> Tensor:
        """Returns values (r,) or (r, c) of all pixels as a picture (h, w, c), or (n, h, w, c)."""
        shape = (self.height, self.width, -1)
        return column.reshape(len(self), *shape) if self.batched else column.reshape(shape)

    def rays(self, device: torch.device | str = "cpu", rows: tuple[int, int] | None = None) -> Rays:
        """Returns the rays through pixel centres, camera by camera, row by row, in float64; `rows`
        as for `pixel_rays`, by default all.

        Raises:
            ValueError: The camera is relative to a box: call `placed(box)` first.
        """
        return self.pixel_rays(self.numbers(device), rows or (0, len(self) * self.height))


_BATCHED_FIELDS = ("viewmats", "Ks", "radial_coeffs", "max_angle")  # one row per camera
_CORNERS = list(itertools.product((0, 1), repeat=3))


def _sum_of_three(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sums values (3, ...) times weights (3, ...) over the three, in order."""
    return values[0] * weights[0] + values[1] * weights[1] + values[2] * weights[2]


def _aimed(
    context: str,
    view: Tensor,
    distance: Tensor,
    fov: float | None,
    width: int,
    height: int,
    model: CameraModel,
    frame: Coordinates,
) -> Camera:
    """Returns cameras with a centred axis; `distance` (...) is that of the target."""
    camera_model = model_of(context, model)
    fov = camera_model.checked_fov(context, camera_model.fov if fov is None else fov)
    check.integer(context, "width", width, low=1, high=MAX_PICTURE_SIDE)
    check.integer(context, "height", height, low=1, high=MAX_PICTURE_SIDE)
    fx, fy = camera_model.focal(math.radians(fov), width, height)
    Ks = torch.tensor(
        [[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]], dtype=torch.float64, device="cpu"
    )
    if camera_model.parallel:
        Ks = Ks.repeat(*distance.shape, 1, 1)
        Ks[..., (0, 1), (0, 1)] /= distance[..., None]
    max_angle = min(180.0, fov / 2) if camera_model.has_distortion else 180.0
    return Camera(view, Ks, width, height, model=model, max_angle=max_angle, frame=frame)
