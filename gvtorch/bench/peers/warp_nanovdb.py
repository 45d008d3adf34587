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
def _store_voxels(
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
    stop_alpha: float,
    picture: wp.array(dtype=wp.vec4),
) -> None:
    ray = wp.tid()
    origin, direction = origins[ray], directions[ray]
    t, last = limits[ray][0], limits[ray][1]
    transmittance = wp.float32(1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    while t < last and transmittance > 1.0 - stop_alpha:
        length = wp.min(step, last - t)
        position = origin + (t + 0.5 * length) * direction
        value = wp.volume_sample_f(volume, position, wp.Volume.LINEAR)
        row = table[int(value * scale + 0.5)]
        fraction = length / step
        color += transmittance * fraction * wp.vec3(row[0], row[1], row[2])
        transmittance *= 1.0 - fraction * row[3]
        t += step
    picture[ray] = wp.vec4(color[0], color[1], color[2], 1.0 - transmittance)


class Marcher(Peer):
    """Warp's compiled kernel, C++ on the CPU and CUDA on the GPU."""

    differences = (
        "float32 voxels in a sparse grid of the leaves that are not all zero, no empty space is "
        "skipped; opacity from the nearest of 4081 table rows, scaled linearly in a ray's last, "
        "shorter interval; on the CPU Warp has one thread"
    )

    def __init__(self, task: Task) -> None:
        """Makes the grid from the leaves that are not all zero; edge voxels are repeated once."""
        self.device = str(task.device)
        voxels = task.scene.volume.data[..., 0].numpy()
        tiles = wp.array(_tiles(voxels), dtype=int, device=self.device)
        self.volume = wp.Volume.allocate_by_tiles(tiles, 1.0, 0.0, device=self.device)
        source = wp.array(voxels, dtype=wp.uint8, device=self.device)
        wp.synchronize_device(self.device)  # Warp fills arrays on a stream of its own
        self._launch(_store_voxels, (len(tiles), *(_TILE,) * 3), [self.volume.id, source, tiles])
        rays = task.rays
        self.tensors = [
            rays.origin.float().contiguous(),
            rays.direction.float().contiguous(),
            spans(task).float().contiguous(),
            torch.zeros((len(rays.origin), 4), device=task.device),
        ]
        dtypes = (wp.vec3, wp.vec3, wp.vec2, wp.vec4)
        origins, directions, limits, self.output = (
            wp.from_torch(x, dtype=dtype) for x, dtype in zip(self.tensors, dtypes, strict=True)
        )
        rows = bake(task.scene.shader, task.scene.step, _ROWS)
        rows[:, :3] *= rows[:, 3:]
        table = wp.array(rows.astype(np.float32), dtype=wp.vec4, device=self.device)
        scale, step = (_ROWS - 1) / 255, task.scene.step
        self.inputs = [self.volume.id, origins, directions, limits, table, scale, step]
        self.inputs += [task.stop_alpha, self.output]
        wp.synchronize_device(self.device)

    def render(self) -> None:
        self._launch(_march, len(self.tensors[0]), self.inputs)

    def picture(self) -> Tensor:
        return self.tensors[-1]

    def _launch(self, kernel: Any, size: Any, inputs: list[Any]) -> None:
        stream = None  # torch's own, so that its events see the kernel
        if self.device.startswith("cuda"):
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        wp.launch(kernel, dim=size, inputs=inputs, device=self.device, stream=stream)


def _tiles(voxels: np.ndarray) -> np.ndarray:
    """Returns (k, 3) int32: first voxel x, y, z of each leaf that is not all zero."""
    padding = [(_TILE, _TILE + -n % _TILE) for n in voxels.shape]
    padded = np.pad(np.pad(voxels, 1, mode="edge"), [(a - 1, b - 1) for a, b in padding])
    z, y, x = (n // _TILE for n in padded.shape)
    occupied = padded.reshape(z, _TILE, y, _TILE, x, _TILE).any((1, 3, 5))
    return ((np.argwhere(occupied)[:, ::-1] - 1) * _TILE).astype(np.int32)
