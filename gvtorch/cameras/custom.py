"""`CustomCamera`: pictures along arbitrary rays."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..base.check import describe, instance, integer
from ..base.records import Rays
from ..pool.staging import upload
from .camera import Camera
from .poses import Coordinates, continued


class RayColumns:
    """Columns of `CustomCamera.numbers`, of which a row is a ray: the fields of `Rays`."""

    LINE = slice(0, 6)  # the next two
    ORIGIN = slice(0, 3)
    DIRECTION = slice(3, 6)
    CONE = slice(6, 8)
    RANGE = slice(8, 10)
    SAMPLE = slice(10, 11)


class CustomCamera(Camera):
    """An arbitrary ray for each pixel, in world units. Its pictures are like any other."""

    model: Any = "custom"
    distorted = False
    columns = RayColumns

    def __init__(self, rays: Rays, width: int | None = None, height: int | None = None) -> None:
        """Takes rays row by row, picture by picture.

        Args:
            rays: n * height * width rays; more than one picture makes a batch.
            width: Pixels; by default `rays.width`, or else all rays in one row.
            height: Pixels; by default all rows.

        Raises:
            ValueError: The number of rays is no multiple of a picture's pixels, or a shape is
                wrong, or (checked on the CPU only) a number is NaN, or a direction is not of unit
                length.
        """
        columns: list[Tensor] = []
        expected_rows: int | str = "r"
        for name, size in (("origin", 3), ("direction", 3), ("cone", 2), ("range", 2)):
            column: Any = getattr(rays, name, None)
            is_valid = isinstance(column, Tensor) and column.is_floating_point()
            is_valid = is_valid and column.dim() == 2 and column.shape[1] == size
            if not is_valid or expected_rows not in ("r", len(column)):
                wanted, got = f"({expected_rows}, {size}) float", describe(column)
                raise ValueError(f"CustomCamera: rays.{name} must be {wanted}, got {got}")
            columns.append(column)
            expected_rows = len(column)
        if rays.transmittance is not None:
            raise ValueError("CustomCamera: rays of a picture must have no transmittance, got some")
        count = len(rays.origin)
        width = rays.width or count if width is None else width
        self.width = integer("CustomCamera", "width", width, low=1)
        rows = count // self.width
        self.height = integer("CustomCamera", "height", rows if height is None else height, low=1)
        self.window = (0, self.height)
        if count % (self.width * self.height):
            pixels = f"{self.width}x{self.height} pixels"
            raise ValueError(f"CustomCamera: {count} rays do not make pictures of {pixels}")
        columns.append(torch.zeros_like(columns[0][:, :1]))
        self._rays = torch.cat([column.to(torch.float64) for column in columns], 1)
        if rays.direction.device.type == "cpu":
            if bad := int(self._rays.isnan().any(1).sum()):
                raise ValueError(f"CustomCamera: rays must not be NaN, {bad} are")
            if bad := int(((rays.direction.norm(dim=1) - 1).abs() > 1e-3).sum()):
                raise ValueError(f"CustomCamera: directions must be of unit length, {bad} are not")
        self.frame, self.batched = Coordinates.WORLD, count > self.width * self.height

    @classmethod
    def from_directions(
        cls,
        origin: Tensor,
        direction: Tensor,
        *,
        cone: Tensor | None = None,
        range: Tensor | None = None,
    ) -> CustomCamera:
        """Takes rays in the shape of their picture.

        Args:
            origin: (h, w, 3) or (n, h, w, 3) world units, or what broadcasts to it.
            direction: (h, w, 3) or (n, h, w, 3) of any length but 0.
            cone: (..., 2) width at the origin and growth per unit distance; by default it follows
                from the differences between neighbouring rays.
            range: (..., 2) first and last distance; 0 and infinity by default.

        Raises:
            ValueError: A shape is wrong, or (checked on the CPU only) a number NaN, a direction 0.
        """
        instance("CustomCamera", "direction", direction, Tensor)
        if direction.dim() not in (3, 4) or direction.shape[-1] != 3 or not direction.numel():
            wanted = "(h, w, 3) or (n, h, w, 3)"
            raise ValueError(f"CustomCamera: direction must be {wanted}, got {describe(direction)}")
        direction = normalize(direction.to(torch.float64), dim=-1, eps=1e-300)
        if range is None:
            range = torch.stack((direction.new_zeros(()), direction.new_full((), torch.inf)))
        shaped = {"direction": direction}
        for name, part, size in (("origin", origin, 3), ("cone", cone, 2), ("range", range, 2)):
            shape = (*direction.shape[:-1], size)
            if part is None:
                shaped[name] = _neighbour_cones(shaped["origin"], direction)
                continue
            instance("CustomCamera", name, part, Tensor)
            try:
                shaped[name] = part.to(direction).expand(shape)
            except RuntimeError:
                wanted = f"broadcast to {shape}, got {describe(part)}"
                raise ValueError(f"CustomCamera: {name} must {wanted}") from None
        flat: dict[str, Any] = {n: part.reshape(-1, part.shape[-1]) for n, part in shaped.items()}
        height, width = direction.shape[-3:-1]
        camera = cls(Rays(**flat), width, height)
        camera.batched = direction.dim() == 4
        return camera

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self._rays) // (self.width * self.height)

    def _pictures(self, rays: Tensor | None = None) -> Tensor:
        """Returns its rays (n, h, w, c), or other `rays` (r, c) of pictures of this size."""
        rays = self._rays if rays is None else rays
        return rays.view(-1, self.height, self.width, rays.shape[1])

    def __getitem__(self, index: int) -> Camera:
        """Returns one camera of the batch."""
        return self._copy_with(_rays=self._pictures()[index].flatten(0, 1), batched=False)

    def same(self, other: Camera) -> bool:
        """Whether the other has the same tensor of rays."""
        return isinstance(other, CustomCamera) and self._rays is other._rays

    def placed(self, box: Tensor) -> Camera:
        """Returns itself: rays are in world units."""
        return self

    def shifted(self, dx: float, dy: float, sample: int | None = None) -> Camera:
        """Returns the camera with its rays moved by dx and dy times the step to a neighbour."""
        lines, rays = self._pictures()[..., RayColumns.LINE], self._rays.clone()
        moved = lines + dx * _ray_step(lines, -2) + dy * _ray_step(lines, -3)
        origin, direction = moved.flatten(0, 2).split(3, 1)
        rays[:, RayColumns.ORIGIN] = origin
        rays[:, RayColumns.DIRECTION] = direction / direction.norm(dim=1, keepdim=True)
        if sample is not None:
            rays[:, RayColumns.SAMPLE] = sample
        return self._copy_with(_rays=rays)

    def strip(self, first: int, end: int) -> Camera:
        """Returns the camera of the rows [first, end) of each picture."""
        rays = self._pictures()[:, first:end].flatten(0, 2)
        window = (self.window[0] + first, self.window[1])
        return self._copy_with(_rays=rays, height=end - first, window=window)

    def numbers(self, device: torch.device | str = "cpu") -> Tensor:
        """Returns (r, 11) float64, see `RayColumns`."""
        return upload(self._rays, torch.device(device))

    def thinned(self, stride: int) -> Camera:
        """Returns the camera with one ray per stride x stride pixels; see `numbers_ahead`."""
        rays = self._pictures()[:, ::stride, ::stride]
        height, width = rays.shape[1:3]
        changes = {"height": height, "width": width, "window": (0, height)}
        return self._copy_with(_rays=rays.flatten(0, 2), **changes)

    def numbers_ahead(self, now: Tensor, before: Tensor, frames: float, stride: int) -> Tensor:
        """Returns the numbers of the camera `thinned` by `stride`, extrapolated by `frames` frames
        from the `numbers` of the last two frames; see `continued`.
        """
        pictures = (self._pictures(numbers) for numbers in (now, before))
        now, before = (rays[:, ::stride, ::stride].flatten(0, 2) for rays in pictures)
        return continued(now, before, frames, RayColumns.LINE, RayColumns.DIRECTION)

    def pixel_rays(self, numbers: Tensor, rows: tuple[int, int]) -> Rays:
        """Returns the rays of whole rows, from the result of `numbers`."""
        part = numbers[rows[0] * self.width : rows[1] * self.width]
        return Rays(
            origin=part[:, RayColumns.ORIGIN],
            direction=part[:, RayColumns.DIRECTION],
            cone=part[:, RayColumns.CONE],
            range=part[:, RayColumns.RANGE],
            width=self.width,
        )


def as_camera(context: str, camera: Camera | Rays) -> Camera:
    """Returns a user's camera; rays become a `CustomCamera`. Raises ValueError if it is neither."""
    if isinstance(camera, Rays):
        return CustomCamera(camera)
    return instance(context, "camera", camera, Camera)


def _neighbour_cones(origin: Tensor, direction: Tensor) -> Tensor:
    """Returns cones (..., h, w, 2) from the differences between neighbouring rays, the larger of
    both axes of the picture. Source: Igehy, "Tracing ray differentials", SIGGRAPH 1999.
    """
    steps = [[_ray_step(f, axis).norm(dim=-1) for axis in (-3, -2)] for f in (origin, direction)]
    return torch.stack([torch.maximum(*pair) for pair in steps], -1)


def _ray_step(field: Tensor, axis: int) -> Tensor:
    """Returns the change of (..., h, w, c) per pixel: central differences, 0 along a lone row."""
    if field.shape[axis] == 1:
        return torch.zeros_like(field)
    return torch.gradient(field, dim=axis)[0]
