"""A marcher on Warp's NanoVDB volumes: one thread a ray, trilinear samples of a sparse grid.

`from __future__ import annotations` is left out, because Warp reads the types of its kernels.
"""

# mypy: disable-error-code="valid-type"

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from .peer import Peer, Task, bake, spans

_ROWS = 255 * 16 + 1
_TILE = 8  # voxels along a side of a NanoVDB leaf

wp.config.log_level = wp.LOG_ERROR


@wp.kernel
def _store(
    volume: wp.uint64, voxels: wp.array3d(dtype=wp.uint8), tiles: wp.array2d(dtype=int)
) -> None:
    tile, i, j, k = wp.tid()
    x, y, z = tiles[tile, 0] + i, tiles[tile, 1] + j, tiles[tile, 2] + k
    a = wp.clamp(x, 0, voxels.shape[2] - 1)
    b = wp.clamp(y, 0, voxels.shape[1] - 1)
    c = wp.clamp(z, 0, voxels.shape[0] - 1)
    wp.volume_store_f(volume, x, y, z, float(voxels[c, b, a]))


@wp.kernel
def _march(
    volume: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    limits: wp.array(dtype=wp.vec2),
    table: wp.array(dtype=wp.vec4),
    scale: float,
    step: float,
    stop: float,
    picture: wp.array(dtype=wp.vec4),
) -> None:
    ray = wp.tid()
    origin, direction = origins[ray], directions[ray]
    t, last = limits[ray][0], limits[ray][1]
    clear = wp.float32(1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    while t < last and clear > 1.0 - stop:
        length = wp.min(step, last - t)
        place = origin + (t + 0.5 * length) * direction
        value = wp.volume_sample_f(volume, place, wp.Volume.LINEAR)
        row = table[int(value * scale + 0.5)]
        share = length / step
        color += clear * share * wp.vec3(row[0], row[1], row[2])
        clear *= 1.0 - share * row[3]
        t += step
    picture[ray] = wp.vec4(color[0], color[1], color[2], 1.0 - clear)


class Marcher(Peer):
    """Warp's compiled kernel, C++ on the CPU and CUDA on the GPU."""

    differs = (
        "float32 voxels in a sparse grid of leaves that are not zero, no skipping; opacity "
        "from the nearest of 4081 rows, linear in the last interval; on the CPU Warp has one thread"
    )

    def __init__(self, task: Task) -> None:
        """Makes the grid from the leaves that are not all zero; edge voxels are repeated once."""
        self.device = str(task.device)
        voxels = task.scene.volume.data[..., 0].numpy()
        tiles = wp.array(_tiles(voxels), dtype=int, device=self.device)
        self.volume = wp.Volume.allocate_by_tiles(tiles, 1.0, 0.0, device=self.device)
        source = wp.array(voxels, dtype=wp.uint8, device=self.device)
        wp.synchronize_device(self.device)  # Warp fills arrays on a stream of its own
        self._launch(_store, (len(tiles), *(_TILE,) * 3), [self.volume.id, source, tiles])
        rays = task.rays
        self.kept = [
            rays.origin.float().contiguous(),
            rays.direction.float().contiguous(),
            spans(task).float().contiguous(),
            torch.zeros((len(rays.origin), 4), device=task.device),
        ]
        kinds = (wp.vec3, wp.vec3, wp.vec2, wp.vec4)
        origins, directions, limits, self.out = (
            wp.from_torch(tensor, dtype=kind) for tensor, kind in zip(self.kept, kinds, strict=True)
        )
        rows = bake(task.scene.shader, task.scene.step, _ROWS)
        rows[:, :3] *= rows[:, 3:]
        table = wp.array(rows.astype(np.float32), dtype=wp.vec4, device=self.device)
        scale, step = (_ROWS - 1) / 255, task.scene.step
        self.inputs = [self.volume.id, origins, directions, limits, table, scale, step]
        self.inputs += [task.stop_alpha, self.out]
        wp.synchronize_device(self.device)

    def render(self) -> None:
        self._launch(_march, len(self.kept[0]), self.inputs)

    def picture(self) -> Tensor:
        return self.kept[-1]

    def _launch(self, kernel: Any, size: Any, inputs: list[Any]) -> None:
        stream = None  # torch's own, so that its events see the kernel
        if self.device.startswith("cuda"):
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        wp.launch(kernel, dim=size, inputs=inputs, device=self.device, stream=stream)


def _tiles(voxels: np.ndarray) -> np.ndarray:
    """Returns (k, 3) int32: first voxel x, y, z of each leaf that is not all zero."""
    around = [(_TILE, _TILE + -n % _TILE) for n in voxels.shape]
    edges = np.pad(np.pad(voxels, 1, mode="edge"), [(a - 1, b - 1) for a, b in around])
    z, y, x = (n // _TILE for n in edges.shape)
    some = edges.reshape(z, _TILE, y, _TILE, x, _TILE).any((1, 3, 5))
    return ((np.argwhere(some)[:, ::-1] - 1) * _TILE).astype(np.int32)
