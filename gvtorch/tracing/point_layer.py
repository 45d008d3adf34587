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

_BLOCK = 1 << 17  # points drawn together
_LEAST = 1e-7  # opacity of pixels that emit light and hide nothing
_NEAREST = 1e-3  # finest voxels from the eye; nothing is drawn nearer


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
    where = "point_layer"
    check.instance(where, "producer", producer, PointProducer)
    if not producer.drawn or producer.points.width != 4:
        raise ValueError(f"{where}: needs PointProducer(drawn=True) of 4 values, as of Points.lit")
    if camera.model != "pinhole" or camera.batched:
        raise ValueError(f"{where}: the camera must be one pinhole camera, got {camera!r}")
    check.number(where, "size", size, low=0.5, high=64)
    check.number(where, "cone_scale", cone_scale, low=0, open_low=True)
    if reference is not None:
        check.number(where, "reference", reference, low=0, open_low=True)
    points, grid = producer.points, producer.points.grid
    placed = camera.placed(torch.tensor([grid.low, grid.high], dtype=torch.float64))
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
    found = narrow_near(points, eye, reach + grid.branching * 2 * finest)
    for begin in range(0, len(found), _BLOCK):
        rows = {n: one[found[begin : begin + _BLOCK]] for n, one in points.points[0].rows.items()}
        place = rows["position"].astype(np.float64)
        seen = place @ view[:3, :3].T + view[:3, 3]
        coarse = grid.spacing_3 * grid.branching
        middle = (np.floor((place - grid.low) / coarse) + 0.5) * coarse + grid.low
        cone = growth * np.linalg.norm(middle - eye, axis=1)
        share = np.clip((finest * grid.branching - cone) / (finest * (grid.branching - 1)), 0, 1)
        some = (share > 0) & (seen[:, 2] > _NEAREST * finest)
        seen, share, value = seen[some], share[some], rows["value"][some].astype(np.float64)
        depth, away = seen[:, 2], np.linalg.norm(seen, axis=1)
        # A pixel's solid angle is z^3 / (distance^3 fx fy).
        share *= voxel_light * K[0, 0] * K[1, 1] * away / depth**3
        x = K[0, 0] * seen[:, 0] / depth + K[0, 2]
        y = K[1, 1] * seen[:, 1] / depth + K[1, 2]
        _draw(total, (height, width), (x, y), size, np.c_[share[:, None] * value, away])
    return _layer(total, (height, width))


def _layer(total: np.ndarray, shape: tuple[int, int]) -> Layer:
    """Returns a layer, given the sums (p, 5) of pixels."""
    light = total[:, :3]
    bright = light.sum(1)
    shown = (bright > 0) | (total[:, 3] > 0)
    mean = np.divide(
        total[:, 4], bright + total[:, 3], where=shown, out=np.full(len(bright), np.inf)
    )
    alpha = np.where(shown, np.clip(1 - np.exp(-total[:, 3]), _LEAST, 1), 0)
    images = (
        torch.from_numpy(one).to(torch.float32).view(*shape, -1) for one in (light, mean, alpha)
    )
    return Layer(*images)


def _draw(
    total: np.ndarray,
    shape: tuple[int, int],
    at: tuple[np.ndarray, np.ndarray],
    size: float,
    point_k5: np.ndarray,
) -> None:
    """Adds points' light and opacity (k, 4) and distance, at `at` (k,) pixels, to pixels (p, 5)."""
    height, width = shape
    x, y = at
    inside = (x > -size) & (x < width + size) & (y > -size) & (y < height + size)
    x, y, point = x[inside], y[inside], point_k5[inside]
    weight = point[:, :4].sum(1)
    point = np.c_[point[:, :4], weight * point[:, 4]]
    count = int(np.ceil(2 * size)) + 1
    first = [np.floor(one - size).astype(np.int64) for one in (x, y)]
    edge = np.arange(count + 1)
    reach = np.full(len(x), size)
    along, down = (
        point_shares((start[:, None] + edge).astype(np.float64), one, reach)
        for start, one in zip(first, (x, y), strict=True)
    )
    for dy in range(count):
        for dx in range(count):
            column, row = first[0] + dx, first[1] + dy
            here = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            pixel = row[here] * width + column[here]
            share = (along[:, dx] * down[:, dy])[here]
            for number in range(5):
                weights = share * point[here, number]
                total[:, number] += np.bincount(pixel, weights, len(total))
