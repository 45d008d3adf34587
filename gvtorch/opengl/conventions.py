"""OpenGL's cameras and depth: matrices that draw the pixels of a `Camera`, and depth buffers as
distances along its rays.

Conventions: OpenGL's eye space has x right, y up, z backward. The pixel in row j and column i has
its centre at (i + 0.5, j + 0.5) in both. Rows run downwards here and upwards in OpenGL, so flip an
image that comes from `glReadPixels` (`image.flip(0)`). Matrices are float64 and act on columns:
`clip = projection @ modelview @ (x, y, z, 1)`; OpenGL stores columns, so pass it `matrix.mT`.

Source: OpenGL 4.6 core specification, sections 13.6 (clip space) and 13.8 (window coordinates).
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import torch
from torch import Tensor

from ..base import check
from ..cameras.camera import Camera
from ..cameras.poses import Coordinates
from ..pool.staging import upload

_AXES = torch.tensor([1, -1, -1, 1], dtype=torch.float64, device="cpu")  # flips y and z


class ClipDepth(Enum):
    """The range of clip space's z / w, as `glClipControl` sets it."""

    NEGATIVE_ONE_TO_ONE = "negative_one_to_one"  # OpenGL's default
    ZERO_TO_ONE = "zero_to_one"  # Direct3D's and Vulkan's; best for reversed depth


def matrices(
    camera: Camera,
    near: float,
    far: float = math.inf,
    *,
    clip_depth: ClipDepth = ClipDepth.NEGATIVE_ONE_TO_ONE,
    reversed_z: bool = False,
) -> tuple[Tensor, Tensor]:
    """Makes the matrices with which OpenGL draws the pixels of a camera.

    Args:
        camera: Pinhole cameras in world units (an orbit camera: `camera.placed(tree.box)`).
        near: Distance of the near plane along the view axis, world units.
        far: Distance of the far plane along the view axis, world units; may be infinite.
        clip_depth: What `glClipControl` is set to.
        reversed_z: Window depth is 1 at the near plane and 0 at the far one; needs `glDepthFunc`
            with GREATER and a buffer cleared to 0. In float32 with ZERO_TO_ONE the relative error
            of a distance is about the same everywhere.

    Returns:
        projection and modelview, both (4, 4) float64, or (n, 4, 4) for a batch.

    Raises:
        ValueError: The camera is of another model, or an orbit camera without a position, or not
            0 < near < far.
    """
    context = "opengl.matrices"
    if check.instance(context, "camera", camera, Camera).model != "pinhole":
        raise ValueError(f"{context}: camera must be a pinhole camera, got {camera!r}")
    if camera.frame is not Coordinates.WORLD:
        raise ValueError(f"{context}: an orbit camera has no position yet, call placed(tree.box)")
    near = check.number(context, "near", near, low=0, open_low=True)
    if far != math.inf:
        far = check.number(context, "far", far, low=near, open_low=True)
    check.instance(context, "clip_depth", clip_depth, ClipDepth)
    (fx, fy), (cx, cy) = camera.Ks[:, (0, 1), (0, 1)].unbind(1), camera.Ks[:, :2, 2].unbind(1)
    projection = torch.zeros(len(camera), 4, 4, dtype=torch.float64, device="cpu")
    projection[:, 0, 0], projection[:, 0, 2] = 2 * fx / camera.width, 1 - 2 * cx / camera.width
    projection[:, 1, 1], projection[:, 1, 2] = 2 * fy / camera.height, 2 * cy / camera.height - 1
    ratio = near / far  # 0 for a far plane at infinity
    slope, offset = -1 / (1 - ratio), -near / (1 - ratio)  # window depth 0 to 1 as z / w
    if reversed_z:
        slope, offset = ratio / (1 - ratio), -offset
    if clip_depth is ClipDepth.NEGATIVE_ONE_TO_ONE:
        slope, offset = 2 * slope + 1, 2 * offset
    projection[:, 2, 2], projection[:, 2, 3] = slope, offset
    projection[:, 3, 2] = -1
    modelview = _AXES[:, None] * camera.viewmats
    return (projection, modelview) if camera.batched else (projection[0], modelview[0])


def camera(projection: Tensor, modelview: Tensor, width: int, height: int) -> Camera:
    """Makes the camera whose rays go through the pixels that OpenGL draws with these matrices.

    Args:
        projection: (4, 4) or (n, 4, 4) perspective without skew; its near and far planes do not
            matter.
        modelview: (4, 4) or (n, 4, 4) world to eye, without scale.
        width: Pixels of the viewport.
        height: Pixels of the viewport.

    Raises:
        ValueError: `projection` is not that of a pinhole camera, or `Camera` refuses the matrices.
    """
    context = "opengl.camera"
    matrix, orthographic = _projection(context, projection)
    if orthographic:
        raise ValueError(f"{context}: projection must be perspective, got an orthographic one")
    check.integer(context, "width", width, low=1)
    check.integer(context, "height", height, low=1)
    intrinsics = torch.zeros_like(matrix[..., :3, :3])
    intrinsics[..., 0, 0] = matrix[..., 0, 0] * width / 2
    intrinsics[..., 0, 2] = (1 - matrix[..., 0, 2]) * width / 2
    intrinsics[..., 1, 1] = matrix[..., 1, 1] * height / 2
    intrinsics[..., 1, 2] = (1 + matrix[..., 1, 2]) * height / 2
    intrinsics[..., 2, 2] = 1
    view = _AXES[:, None] * check.reals(context, "modelview", modelview)
    return Camera(view, intrinsics, width, height)


def ray_distance(
    window_depth: Tensor,
    projection: Tensor,
    *,
    clip_depth: ClipDepth = ClipDepth.NEGATIVE_ONE_TO_ONE,
) -> Tensor:
    """Converts a depth buffer into distances along the rays, as `Layer` takes them.

    Does not wait for the device. The error is that of the buffer's rounding: a window depth off by
    e puts a perspective distance d off by about e * d^2 / near. e is 2^-25 far away in float32 and
    2^-25 everywhere in 24 bits; reversed, float32 keeps a relative error of about 2^-24.

    Args:
        window_depth: (h, w, 1) or (n, h, w, 1) floats from 0 to 1, the first row at the top.
        projection: (4, 4), or (n, 4, 4) one for each picture: perspective or orthographic, depth
            reversed or not.
        clip_depth: What `glClipControl` was set to.

    Returns:
        Shape of `window_depth`, float64: world distance along the ray, from the eye (from the plane
        through the eye if the projection is orthographic); +inf where the buffer holds the depth of
        the far plane, to which it is cleared: nothing was drawn there.

    Raises:
        ValueError: A wrong shape or dtype, or another kind of projection.
    """
    context = "opengl.ray_distance"
    pixels = _Pixels.of(context, "window_depth", window_depth, projection, clip_depth)
    depth = window_depth.to(torch.float64)
    if pixels.orthographic:
        z = (pixels.offset - depth) / pixels.slope
    else:
        z = pixels.offset / (depth + pixels.slope)
    return torch.where(depth == pixels.far, torch.inf, z * pixels.stretch)


def window_depth(
    distance: Tensor,
    projection: Tensor,
    *,
    clip_depth: ClipDepth = ClipDepth.NEGATIVE_ONE_TO_ONE,
) -> Tensor:
    """Converts distances along the rays into a depth buffer that OpenGL can test against: the
    inverse of `ray_distance`.

    Args:
        distance: (h, w, 1) or (n, h, w, 1) floats, such as `Picture.depth`.
        projection: See `ray_distance`, also for `clip_depth` and the errors.

    Returns:
        Shape of `distance`, float64, clamped to 0 to 1: points before the near plane get its depth,
        points beyond the far plane, and +inf, get that of the far plane.
    """
    pixels = _Pixels.of("opengl.window_depth", "distance", distance, projection, clip_depth)
    z = distance.to(torch.float64) / pixels.stretch
    if pixels.orthographic:
        depth = pixels.offset - pixels.slope * z
    else:
        depth = pixels.offset / z - pixels.slope
    return depth.clamp(0, 1)


class _Pixels(NamedTuple):
    """Coefficients that convert the depth of each pixel of an image, on the image's device.

    Window depth (0 to 1) from z along the view axis: offset / z - slope in a perspective, offset -
    slope * z in an orthographic projection.
    """

    slope: Tensor  # (n, 1, 1, 1) or (1, 1, 1)
    offset: Tensor
    far: Tensor  # window depth of the far plane
    stretch: Tensor  # (n, h, w, 1) or (h, w, 1) distance along the ray, divided by z
    orthographic: bool

    @classmethod
    def of(
        cls, context: str, name: str, image: Tensor, projection: Tensor, clip_depth: ClipDepth
    ) -> _Pixels:
        """Checks an image and its projection, and returns the coefficients."""
        matrix, orthographic = _projection(context, projection)
        check.instance(context, "clip_depth", clip_depth, ClipDepth)
        batch = matrix.shape[:-2]
        fits = isinstance(image, Tensor) and image.is_floating_point() and image.shape[-1:] == (1,)
        if not (fits and image.dim() == matrix.dim() + 1 and image.shape[:-3] == batch):
            expected = f"({batch[0]}, h, w, 1)" if batch else "(h, w, 1)"
            raise ValueError(
                f"{context}: {name} must be {expected} floats as projection is "
                f"{'a batch' if batch else 'one'}, got {check.describe(image)}"
            )
        slope, offset = matrix[..., 2, 2], matrix[..., 2, 3]
        if clip_depth is ClipDepth.NEGATIVE_ONE_TO_ONE:  # window depth is (z + 1) / 2
            slope, offset = slope / 2, offset / 2
            if orthographic:
                offset = offset + 0.5
            else:
                slope = slope - 0.5
        far = (slope < 0 if orthographic else offset < 0).to(slope)
        terms = (matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 0, 2], matrix[..., 1, 2])
        coefficients = upload(torch.stack((*terms, slope, offset, far), -1), image.device)
        sx, sy, ax, ay, slope, offset, far = coefficients[..., None, None, None].unbind(-4)
        if orthographic:
            return cls(slope, offset, far, torch.ones_like(slope), orthographic)
        *_, height, width, _ = image.shape
        x = torch.arange(width, dtype=torch.float64, device=image.device)[:, None]
        y = torch.arange(height, dtype=torch.float64, device=image.device)[:, None, None]
        tan_x = ((2 * x + 1) / width - 1 + ax) / sx
        tan_y = (1 - (2 * y + 1) / height + ay) / sy
        stretch = (1 + tan_x * tan_x + tan_y * tan_y).sqrt()
        return cls(slope, offset, far, stretch, orthographic)


def _projection(context: str, projection: Tensor) -> tuple[Tensor, bool]:
    """Returns a projection, checked, in float64 on the CPU, and whether it is orthographic."""
    matrix = check.reals(context, "projection", projection)
    if matrix.dim() not in (2, 3) or matrix.shape[-2:] != (4, 4):
        raise ValueError(
            f"{context}: projection must be (4, 4) or (n, 4, 4), got {tuple(matrix.shape)}"
        )
    p = matrix.view(-1, 4, 4)
    last_row = p[0, 3].tolist()
    orthographic = last_row == [0, 0, 0, 1]
    if not (orthographic or last_row == [0, 0, -1, 0]) or bool((p[:, 3] != p[:1, 3]).any()):
        raise ValueError(
            f"{context}: projection must end in the row (0, 0, -1, 0) (perspective) or "
            f"(0, 0, 0, 1) (orthographic), got {last_row}"
        )
    zero_column = 2 if orthographic else 3  # column whose x and y must be 0
    zeros = torch.stack((p[:, 0, 1], p[:, 1, 0], p[:, 2, 0], p[:, 2, 1]), 1)
    zeros = torch.cat((zeros, p[:, :2, zero_column]), 1)
    depth_scale = p[:, 2, 2 if orthographic else 3]
    valid = (zeros == 0).all() & (depth_scale != 0).all()
    if not bool(valid & (p[:, 0, 0] > 0).all() & (p[:, 1, 1] > 0).all()):
        raise ValueError(
            f"{context}: projection must be without skew or rotation, scale x and y by "
            f"more than 0 and keep depths apart, got {matrix.tolist()}"
        )
    return matrix, orthographic
