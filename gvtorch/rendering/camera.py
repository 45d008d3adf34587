"""`Camera`: pinhole cameras, one or a batch, and the rays through their pixels.

Conventions: camera axes are OpenCV's (x right, y down, z forward); pixel (i, j) covers [i, i + 1)
    x [j, j + 1) of
the image plane, its centre is at +0.5 (so do gsplat and nerfstudio; kornia puts centres at
integers, and `from_kornia` and `to_kornia` shift the principal point by half a pixel).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .. import check
from ..frame import Rays

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

Numbers = float | Sequence[float] | Tensor


class Frame(Enum):
    """What a camera's position is measured in."""

    WORLD = "world"  # world units
    BOX = "box"  # the scene's box: its centre is 0 and its largest side 1

    @classmethod
    def of(cls, where: str, value: Frame | str) -> Frame:
        """Returns the frame of this name; raises ValueError where there is none."""
        try:
            return cls(value)
        except ValueError:
            raise ValueError(f"{where}: frame must be 'world' or 'box', got {value!r}") from None


class Camera:
    """Pinhole cameras that share width and height.

    Attributes:
        viewmats: (n, 4, 4) float64, world (or box) to camera.
        Ks: (n, 3, 3) float64 intrinsics in pixels.
        width: Pixels.
        height: Pixels.
        frame: Whether positions are in the world or relative to the box of what is rendered.
        batched: False for one camera whose pictures have no batch dimension.
    """

    def __init__(
        self,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        *,
        frame: Frame = Frame.WORLD,
    ) -> None:
        """Takes matrices (4, 4) and (3, 3), or batches (n, 4, 4) and (n, 3, 3).

        Raises:
            ValueError: A wrong shape, a value that is not finite, a focal length that is not
                positive or a rotation that is none.
        """
        self.width = check.whole("Camera", "width", width, low=1, high=65536)
        self.height = check.whole("Camera", "height", height, low=1, high=65536)
        view = torch.as_tensor(viewmats, dtype=torch.float64)
        intrinsics = torch.as_tensor(Ks, dtype=torch.float64)
        for name, matrix, side in (("viewmats", view, 4), ("Ks", intrinsics, 3)):
            if matrix.dim() not in (2, 3) or matrix.shape[-2:] != (side, side):
                raise ValueError(
                    f"Camera: {name} must be ({side}, {side}) or (n, {side}, {side}), "
                    f"got {tuple(matrix.shape)}"
                )
            if not bool(torch.isfinite(matrix).all()):
                raise ValueError(f"Camera: {name} must be finite, got NaN or infinity")
        self.batched = view.dim() == 3 or intrinsics.dim() == 3
        count = max(m.shape[0] if m.dim() == 3 else 1 for m in (view, intrinsics))
        try:
            self.viewmats = view.expand(count, 4, 4).contiguous()
            self.Ks = intrinsics.expand(count, 3, 3).contiguous()
        except RuntimeError:
            raise ValueError(
                f"Camera: viewmats {tuple(view.shape)} and Ks {tuple(intrinsics.shape)} "
                "do not match"
            ) from None
        if bool((self.Ks[:, (0, 1), (0, 1)] <= 0).any()):
            raise ValueError("Camera: Ks must have positive focal lengths")
        rotation = self.viewmats[:, :3, :3]
        error = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64)).abs().max()
        if error > 1e-3 or bool((torch.linalg.det(rotation) < 0).any()):
            raise ValueError("Camera: viewmats must hold rotations (orthonormal, determinant +1)")
        bottom = torch.tensor([0, 0, 0, 1], dtype=torch.float64)
        if bool((self.viewmats[:, 3] != bottom).any() or (self.Ks[:, 2] != bottom[1:]).any()):
            raise ValueError("Camera: last rows must be (0, 0, 0, 1) of viewmats, (0, 0, 1) of Ks")
        if bool((self.Ks[:, (0, 1), (1, 0)] != 0).any()):
            raise ValueError("Camera: Ks must have no skew")
        self.frame = frame

    @classmethod
    def orbit(
        cls,
        azimuth: Numbers = 30.0,
        elevation: Numbers = 20.0,
        distance: Numbers = 2.4,
        fov: float = 30.0,
        width: int = 512,
        height: int = 512,
    ) -> Camera:
        """Looks at the centre of the scene's box from a sphere around it; up is +y.

        position = centre + distance * L * (sin az cos el, sin el, cos az cos el), L the box's
        largest side.

        Args:
            azimuth: Degrees; a number, or (n,) for a batch.
            elevation: Degrees, likewise.
            distance: In largest sides of the box, likewise, > 0.
            fov: Vertical field of view, degrees.
            width: Pixels.
            height: Pixels.

        Raises:
            ValueError: A number is not finite or out of its range.
        """
        turn, lift, far = (
            _numbers("Camera.orbit", name, value)
            for name, value in (
                *(("azimuth", azimuth), ("elevation", elevation)),
                ("distance", distance),
            )
        )
        if bool((far <= 0).any()):
            raise ValueError(f"Camera.orbit: distance must be > 0, got {distance!r}")
        try:
            turn, lift, far = torch.broadcast_tensors(turn.deg2rad(), lift.deg2rad(), far)
        except RuntimeError:
            raise ValueError(
                "Camera.orbit: azimuth, elevation and distance have different lengths"
            ) from None
        if far.dim() > 1:
            raise ValueError(
                "Camera.orbit: azimuth, elevation and distance must be numbers or (n,), "
                f"got {tuple(far.shape)}"
            )
        zero = torch.zeros_like(turn)
        outward = torch.stack(
            (turn.sin() * lift.cos(), lift.sin(), turn.cos() * lift.cos()), dim=-1
        )
        over = torch.where(lift.cos() < -1e-12, -1.0, 1.0)  # beyond a pole up is still +y
        right = torch.stack((over * turn.cos(), zero, -over * turn.sin()), dim=-1)
        view = _viewmat(outward * far[..., None], -outward, right)
        return cls(
            view, _intrinsics("Camera.orbit", fov, width, height), width, height, frame=Frame.BOX
        )

    @classmethod
    def look_at(
        cls,
        eye: Sequence[float] | Tensor,
        target: Sequence[float] | Tensor,
        up: Sequence[float] | Tensor = (0.0, 1.0, 0.0),
        fov: float = 30.0,
        width: int = 512,
        height: int = 512,
    ) -> Camera:
        """Stands at `eye` and looks at `target`, in world units.

        Args:
            eye: (3,) or (n, 3).
            target: (3,) or (n, 3).
            up: (3,) or (n, 3); where it is parallel to the view, -z takes its place (or +y, if up
                is z).
            fov: Vertical field of view, degrees.
            width: Pixels.
            height: Pixels.

        Raises:
            ValueError: A place is not finite, up is zero, or eye and target are the same.
        """
        places = []
        for name, value in (("eye", eye), ("target", target), ("up", up)):
            place = _numbers("Camera.look_at", name, value)
            if place.dim() not in (1, 2) or place.shape[-1] != 3:
                raise ValueError(
                    f"Camera.look_at: {name} must be (3,) or (n, 3), got {tuple(place.shape)}"
                )
            places.append(place)
        try:
            eye_, target_, up_ = torch.broadcast_tensors(*places)
        except RuntimeError:
            raise ValueError("Camera.look_at: eye, target and up have different lengths") from None
        if bool((up_ == 0).all(-1).any()):
            raise ValueError("Camera.look_at: up must not be zero")
        forward = target_ - eye_
        length = forward.norm(dim=-1, keepdim=True)
        if bool((length == 0).any()):
            raise ValueError(f"Camera.look_at: eye and target are the same place, {eye!r}")
        forward = forward / length
        right = torch.linalg.cross(forward, up_)
        other = torch.where(
            forward[..., 2:3].abs() > 0.9,
            forward.new_tensor([0, 1, 0]),
            forward.new_tensor([0, 0, -1]),
        )
        parallel = right.norm(dim=-1, keepdim=True) < 1e-9 * up_.norm(dim=-1, keepdim=True) + 1e-300
        right = torch.where(parallel, torch.linalg.cross(forward, other), right)
        right = right / right.norm(dim=-1, keepdim=True)
        view = _viewmat(eye_, forward, right)
        return cls(view, _intrinsics("Camera.look_at", fov, width, height), width, height)

    @classmethod
    def from_viewmat_K(cls, viewmats: Tensor, Ks: Tensor, width: int, height: int) -> Camera:
        """Takes gsplat's matrices: (..., 4, 4) world-to-camera (OpenCV) and (..., 3, 3).

        Leading dimensions are laid in a row: the cameras are a batch of their product.
        """
        flat = []
        for name, matrix in (("viewmats", viewmats), ("Ks", Ks)):
            matrices = _numbers("Camera.from_viewmat_K", name, matrix)
            many = matrices.dim() > 3
            flat.append(matrices.reshape(-1, *matrices.shape[-2:]) if many else matrices)
        return cls(flat[0], flat[1], width, height)

    @classmethod
    def from_kornia(cls, camera: PinholeCamera) -> Camera:
        """Takes kornia's `PinholeCamera` (a batch). Its pixel centres are at integers, ours at
        +0.5.
        """
        sizes = torch.stack((camera.height, camera.width)).long().unique(dim=1)
        if sizes.shape[1] != 1:
            raise ValueError("Camera.from_kornia: all cameras must have one height and width")
        Ks = camera.intrinsics[:, :3, :3].detach().to("cpu", torch.float64).clone()
        Ks[:, :2, 2] += 0.5
        view = camera.extrinsics.detach().to("cpu", torch.float64)
        return cls(view, Ks, int(sizes[1, 0]), int(sizes[0, 0]))

    def to_kornia(self) -> Any:
        """Returns the batch as kornia's `PinholeCamera`, float64."""
        from kornia.geometry.camera import PinholeCamera

        intrinsics = torch.eye(4, dtype=torch.float64).repeat(len(self), 1, 1)
        intrinsics[:, :3, :3] = self.Ks
        intrinsics[:, :2, 2] -= 0.5
        size = torch.ones(len(self), dtype=torch.float64)
        return PinholeCamera(intrinsics, self.viewmats, self.height * size, self.width * size)

    def __len__(self) -> int:
        """Number of cameras."""
        return self.viewmats.shape[0]

    def __getitem__(self, index: int) -> Camera:
        """Returns one camera of the batch."""
        return Camera(
            self.viewmats[index], self.Ks[index], self.width, self.height, frame=self.frame
        )

    def placed(self, box: Tensor) -> Camera:
        """Returns the camera in world units, given the (2, 3) box of the scene."""
        if self.frame is Frame.WORLD:
            return self
        centre, side = (box[0] + box[1]) / 2, (box[1] - box[0]).max()
        view = self.viewmats.clone()
        rotation = view[:, :3, :3]
        view[:, :3, 3] = view[:, :3, 3] * side - rotation @ centre
        placed = Camera(view, self.Ks, self.width, self.height)
        placed.batched = self.batched
        return placed

    def numbers(self, device: torch.device | str = "cpu") -> Tensor:
        """Returns (n, 20) float64, what `pixel_rays` reads; on CUDA the copy makes nobody wait.

        Raises:
            ValueError: The camera is relative to a box: call `placed(box)` first.
        """
        if self.frame is not Frame.WORLD:
            raise ValueError("Camera.rays: an orbit camera has no place yet, call placed(tree.box)")
        rotation, translation = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        focal, centre = self.Ks[:, (0, 1), (0, 1)], self.Ks[:, :2, 2] - 0.5
        position = -(translation[:, None] @ rotation)[:, 0]  # -R^T t
        zero = torch.zeros_like(focal[:, :1])
        cone = torch.cat((zero, 1 / focal.min(1, keepdim=True).values), 1)
        range_ = torch.cat((zero, zero + math.inf), 1)
        parts = (rotation.flatten(1), position, focal, centre, cone, range_)
        numbers, device = torch.cat(parts, 1), torch.device(device)
        if device.type == "cuda":
            return numbers.pin_memory().to(device, non_blocking=True)
        return numbers.to(device)

    def rays(self, device: torch.device | str = "cpu", rows: tuple[int, int] | None = None) -> Rays:
        """Returns the rays through pixel centres, camera by camera, row by row, in float64.

        Args:
            device: Where they are made.
            rows: First row and the row after the last, counted through the batch; all if left out.

        Raises:
            ValueError: The camera is relative to a box: call `placed(box)` first.
        """
        everything = (0, len(self) * self.height)
        return pixel_rays(self.numbers(device), self.width, self.height, rows or everything)


def pixel_rays(numbers: Tensor, width: int, height: int, rows: tuple[int, int]) -> Rays:
    """Returns the rays through the pixel centres of whole rows; nobody waits for the device.

    Args:
        numbers: (n, 20) float64, a row a camera: world-to-camera rotation (9), position (3), focal
            lengths and principal point (2, 2; pixel centres at integers), cone (2), range (2).
        width: Pixels.
        height: Pixels.
        rows: First row and the row after the last, counted through the batch.
    """
    first, end = rows
    row = torch.arange(first, end, device=numbers.device)  # (y,)
    if len(numbers) > 1:
        numbers, row = numbers[row // height], row % height  # one for each row
    rotation, position = numbers[:, :9].unflatten(1, (3, 3)), numbers[:, 9:12]  # (k, 3, 3), (k, 3)
    (fx, fy), (cx, cy) = numbers[:, 12:14].unbind(1), numbers[:, 14:16].unbind(1)
    column = torch.arange(width, dtype=torch.float64, device=numbers.device)
    x, y = (column - cx[:, None]) / fx[:, None], (row - cy) / fy  # (k, w), (y,)
    length = (x * x + (y * y + 1)[:, None]).sqrt_()  # (y, w)
    across, down = x[..., None] * rotation[:, None, 0], y[:, None] * rotation[:, 1] + rotation[:, 2]
    direction = (across + down[:, None]).div_(length[..., None])  # (y, w, 3)

    def spread(values: Tensor) -> Tensor:
        """(r, c) of (k, c): one camera's is not copied."""
        if len(values) == 1:
            return values.expand(length.numel(), -1)
        return values[:, None].expand(-1, width, -1).reshape(length.numel(), -1)

    return Rays(
        origin=spread(position),
        direction=direction.reshape(-1, 3),
        cone=spread(numbers[:, 16:18]),
        range=spread(numbers[:, 18:20]),
        width=width,
    )


def _numbers(where: str, name: str, value: Any) -> Tensor:
    try:
        tensor = torch.as_tensor(value, dtype=torch.float64).detach().cpu()
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{where}: {name} must be numbers, got {value!r}") from None
    if not bool(torch.isfinite(tensor).all()):
        raise ValueError(f"{where}: {name} must be finite, got {value!r}")
    return tensor


def _viewmat(eye: Tensor, forward: Tensor, right: Tensor) -> Tensor:
    """World-to-camera matrix (..., 4, 4) from a place and two orthonormal directions."""
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack((right, down, forward), dim=-2)
    view = torch.eye(4, dtype=torch.float64).repeat(*eye.shape[:-1], 1, 1)
    view[..., :3, :3] = rotation
    view[..., :3, 3] = -(rotation @ eye[..., None])[..., 0]
    return view


def _intrinsics(where: str, fov: float, width: int, height: int) -> Tensor:
    angle = check.number(where, "fov", fov, low=0, high=179, open_low=True)
    check.whole(where, "width", width, low=1, high=65536)
    check.whole(where, "height", height, low=1, high=65536)
    focal = 0.5 * height / math.tan(0.5 * math.radians(angle))
    return torch.tensor(
        [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64
    )
