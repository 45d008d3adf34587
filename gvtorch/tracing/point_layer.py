"""`point_layer`: draws points as such where they are too near to be shown by voxels.

A `PointProducer(drawn=True)` leaves points out of its finest level, where a voxel would be wider
than a pixel. The renderer blends between the two finest levels by the width of a pixel; here a
point gets the share of its light that is lost there, so that its total light stays the same.
"""

from __future__ import annotations

import numpy as np
import torch

from ..base import check
from ..base import constants as config
from ..cameras.camera import Camera
from ..points.grid import point_shares
from ..points.splat import narrow_near
from ..producers.points import PointProducer
from .layer import Layer

_POINTS_PER_BLOCK = 1 << 17  # points drawn together
_MIN_ALPHA = 1e-7  # opacity of pixels that emit light and hide nothing
_MIN_DEPTH_VOXELS = 1e-3  # finest voxels from the eye; nothing is drawn nearer


def point_layer(
    producer: PointProducer,
    camera: Camera,
    *,
    size: float = 1.5,
    reference: float | None = None,
    cone_scale: float = config.CONE_OVERESTIMATE,
) -> Layer:
    """Returns those points of a producer that are too near for its voxels, as the `layer=` of a
    picture of `gv.StoredColor("value", premultiplied=True)`. A point sends as much light as its
    voxel would, spread over pixels; points in a pixel share a depth.

    Args:
        producer: With `drawn=True`, and values of light and opacity, as of `Points.lit`.
        camera: One pinhole camera.
        size: Radius of a point along the picture's sides, in pixels.
        reference: The shader's `reference`, world units; the smallest spacing if left out.
        cone_scale: The picture's `cone_scale`.

    Raises:
        ValueError: The producer draws no points or has other values, or the camera is of another
            kind.
    """
    context = "point_layer"
    check.instance(context, "producer", producer, PointProducer)
    if not producer.drawn or producer.points.width != 4:
        raise ValueError(
            f"{context}: needs PointProducer(drawn=True) of 4 values, as of Points.lit"
        )
    check.instance(context, "camera", camera, Camera)
    if camera.model != "pinhole" or camera.batched:
        raise ValueError(f"{context}: the camera must be one pinhole camera, got {camera!r}")
    size = check.number(context, "size", size, low=0.5, high=64)
    cone_scale = check.number(context, "cone_scale", cone_scale, low=0, open_low=True)
    if reference is not None:
        reference = check.number(context, "reference", reference, low=0, open_low=True)
    points, grid = producer.points, producer.points.grid
    placed = camera.placed(torch.tensor([grid.low, grid.high], dtype=torch.float64, device="cpu"))
    view, K = placed.viewmats[0].numpy(), placed.Ks[0].numpy()
    eye = -view[:3, 3] @ view[:3, :3]
    # The blend of levels: 0 where a pixel is as wide as a finest voxel, 1 as one of the next level.
    finest = float(grid.spacing_3.max())
    growth = cone_scale / min(K[0, 0], K[1, 1])
    reach = finest * grid.branching / growth
    voxel_light = float(np.prod(grid.spacing_3)) / (
        float(grid.spacing_3.min()) if reference is None else reference
    )
    height, width = placed.height, placed.width
    total = np.zeros((height * width, 5))  # of a pixel: light, opacity, light * distance
    near_points = narrow_near(points, eye, reach + grid.branching * 2 * finest)
    for start in range(0, len(near_points), _POINTS_PER_BLOCK):
        rows = {
            name: column[near_points[start : start + _POINTS_PER_BLOCK]]
            for name, column in points.points[0].rows.items()
        }
        position = rows["position"].astype(np.float64)
        xyz = position @ view[:3, :3].T + view[:3, 3]
        coarse = grid.spacing_3 * grid.branching
        coarse_center = (np.floor((position - grid.low) / coarse) + 0.5) * coarse + grid.low
        cone = growth * np.linalg.norm(coarse_center - eye, axis=1)
        fraction = np.clip((finest * grid.branching - cone) / (finest * (grid.branching - 1)), 0, 1)
        shown = (fraction > 0) & (xyz[:, 2] > _MIN_DEPTH_VOXELS * finest)
        xyz, fraction, value = xyz[shown], fraction[shown], rows["value"][shown].astype(np.float64)
        depth, distance = xyz[:, 2], np.linalg.norm(xyz, axis=1)
        # A pixel's solid angle is z^3 / (distance^3 fx fy).
        fraction *= voxel_light * K[0, 0] * K[1, 1] * distance / depth**3
        x = K[0, 0] * xyz[:, 0] / depth + K[0, 2]
        y = K[1, 1] * xyz[:, 1] / depth + K[1, 2]
        _draw(total, (height, width), (x, y), size, np.c_[fraction[:, None] * value, distance])
    return _layer(total, (height, width))


def _layer(total: np.ndarray, shape: tuple[int, int]) -> Layer:
    """Returns a layer, given the sums (p, 5) of pixels."""
    light = total[:, :3]
    bright = light.sum(1)
    shown = (bright > 0) | (total[:, 3] > 0)
    mean = np.divide(
        total[:, 4], bright + total[:, 3], where=shown, out=np.full(len(bright), np.inf)
    )
    alpha = np.where(shown, np.clip(1 - np.exp(-total[:, 3]), _MIN_ALPHA, 1), 0)
    images = (
        torch.from_numpy(image).to(torch.float32).view(*shape, -1) for image in (light, mean, alpha)
    )
    return Layer(*images)


def _draw(
    total: np.ndarray,
    shape: tuple[int, int],
    pixel_xy: tuple[np.ndarray, np.ndarray],
    size: float,
    point_k5: np.ndarray,
) -> None:
    """Adds points' light and opacity (k, 4) and distance, at `pixel_xy` (k,), to pixels (p, 5)."""
    height, width = shape
    x, y = pixel_xy
    inside = (x > -size) & (x < width + size) & (y > -size) & (y < height + size)
    x, y, point = x[inside], y[inside], point_k5[inside]
    weight = point[:, :4].sum(1)
    point = np.c_[point[:, :4], weight * point[:, 4]]
    count = int(np.ceil(2 * size)) + 1
    first = [np.floor(coordinate - size).astype(np.int64) for coordinate in (x, y)]
    edge = np.arange(count + 1)
    reach = np.full(len(x), size)
    along, down = (
        point_shares((start[:, None] + edge).astype(np.float64), coordinate, reach)
        for start, coordinate in zip(first, (x, y), strict=True)
    )
    for dy in range(count):
        for dx in range(count):
            column, row = first[0] + dx, first[1] + dy
            in_picture = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            pixel = row[in_picture] * width + column[in_picture]
            fraction = (along[:, dx] * down[:, dy])[in_picture]
            for number in range(5):
                weights = fraction * point[in_picture, number]
                total[:, number] += np.bincount(pixel, weights, len(total))
