"""A mesh as a volume that is read region by region (`MeshSource`), and `voxelize`, which writes it
into a store by the writer of `convert`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import multiprocessing
import threading
import zlib
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..base import check
from ..base.image_info import ChannelInfo, ImageInfo
from ..base.stage import Progress, no_progress
from ..meshes.mesh import Material, Mesh
from ..meshes.voxelizer import CHANNELS, Voxelizer
from .conversion import convert
from .mesh_file import read_mesh
from .source import VolumeSource
from .store import Store
from .unfinished import fingerprint

_COLORS = ("red", "green", "blue", "opacity")
_LOCK = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class MeshSource(VolumeSource):
    """One channel of a mesh's finest voxels."""

    channel: str
    resolution: int
    band: float
    thickness: float
    marks: tuple[Any, ...]  # what is the same while the mesh is
    mesh: Mesh | None = dataclasses.field(default=None, repr=False)
    file: str = ""  # where it lies, if not in memory

    @classmethod
    def of(
        cls, given: str | Path | Mesh, channel: str, resolution: int, band: float, thickness: float
    ) -> MeshSource:
        """Reads the mesh, and lays a grid around it; see `voxelize`."""
        if channel not in CHANNELS:
            raise ValueError(
                f"voxelize: channel must be one of {', '.join(CHANNELS)}, got {channel!r}"
            )
        mesh = given if isinstance(given, Mesh) else read_mesh(given)
        marks: list[Any] = [_checksum(mesh)]
        if not isinstance(given, Mesh):
            marks += fingerprint(given)
        told: dict[str, Any] = {"resolution": resolution, "band": band, "thickness": thickness}
        grid = Voxelizer(mesh, channels=(channel,), **told)
        dtype, width = CHANNELS[channel]
        x, y, z = grid.extent
        names = tuple(ChannelInfo(name=name) for name in _COLORS) if channel == "color" else ()
        return cls(
            path=str(given) if not isinstance(given, Mesh) else mesh.name,
            shape=(z, y, x, width),
            axes="zyxc",
            stored=str(dtype).removeprefix("torch."),
            spacing=(grid.spacing,) * 3,
            origin=grid.origin,
            info=ImageInfo(channels=names, quantity=channel, labels=channel == "material"),
            channel=channel,
            **told,
            marks=tuple(marks),
            mesh=mesh,
        )

    def staged(self, folder: Path) -> MeshSource:
        """Writes the mesh to a file in the folder."""
        if self.mesh is None:
            return self
        file = folder / "mesh.npz"
        _save(self.mesh, file)
        return dataclasses.replace(self, mesh=None, file=str(file))

    def fingerprint(self) -> list[Any]:
        """The mesh, and what is made of it."""
        return [*self.marks, self.channel, self.resolution, self.band, self.thickness]

    def command(self, store: str) -> tuple[str, ...]:
        """As `gvtorch voxelize` takes it."""
        numbers = {"resolution": self.resolution, "band": self.band, "thickness": self.thickness}
        told = [word for name, n in numbers.items() for word in (f"--{name}", f"{n:g}")]
        return ("gvtorch", "voxelize", self.path, "-o", store, "--channel", self.channel, *told)

    def read_stored(self, index: tuple[slice, ...]) -> np.ndarray:
        """Makes a part."""
        low, high = [one.start for one in index[:3]], [one.stop for one in index[:3]]
        return self.read_region(low, high)[..., index[3]]

    def read_region(self, low: Sequence[int], high: Sequence[int]) -> np.ndarray:
        """Makes the box `low` to `high`, (z, y, x), as (z, y, x, c)."""
        with _LOCK:  # the first thread builds the hierarchy
            grid = _voxelizer(self)
        return grid.region(low, high)[self.channel].numpy()


@functools.lru_cache(maxsize=2)
def _voxelizer(source: MeshSource) -> Voxelizer:
    """Kept, for every region of a source needs it."""
    if multiprocessing.parent_process() is not None:
        torch.set_num_threads(1)  # one of several processes that share the cores
    mesh = _load(Path(source.file)) if source.mesh is None else source.mesh
    return Voxelizer(
        mesh,
        resolution=source.resolution,
        channels=(source.channel,),
        band=source.band,
        thickness=source.thickness,
    )


def voxelize(
    mesh: str | Path | Mesh,
    store: str | Path,
    *,
    resolution: int = 1024,
    channel: str = "coverage",
    band: float = 4.0,
    thickness: float = 1.0,
    block: int = 32,
    executor: Executor | None = None,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress = no_progress,
) -> Store:
    """Writes a mesh into a store, out of core: what is in memory is the mesh and a few cubes of
    voxels.

    Larger ones start worker processes; a script that calls this needs the usual
    `if __name__ == "__main__":` around its work.

    Args:
        mesh: A `Mesh`, or a file that `read_mesh` knows.
        store: The folder to make.
        resolution: Finest voxels along the longest side.
        channel: coverage, distance, color, normal or material; see `Voxelizer`.
        band: Finest voxels up to which the nearest place of the surface counts.
        thickness: Finest voxels, of what bounds no solid.
        block, executor, workers, resume, progress: As of `convert`.

    Returns:
        The store, open. Its coarse levels are means of those below (of materials the most
        frequent).

    Raises:
        ValueError, OSError, KeyboardInterrupt: As of `read_mesh` and `convert`.
    """
    check.whole("voxelize", "resolution", resolution, low=8, high=2**20)
    source = MeshSource.of(mesh, channel, resolution, band, thickness)
    return convert(
        source,
        store,
        block=block,
        executor=executor,
        workers=workers,
        resume=resume,
        progress=progress,
    )


def _arrays(mesh: Mesh) -> dict[str, np.ndarray]:
    """What a mesh is made of, by name."""
    told = [{"name": one.name, "color": one.color} for one in mesh.materials]
    arrays = {"materials": np.array(json.dumps(told)), "name": np.array(mesh.name)}
    for name in ("vertices", "faces", "color", "uv", "material"):
        if (value := getattr(mesh, name)) is not None:
            arrays[name] = value
    for number, one in enumerate(mesh.materials):
        if one.texture is not None:
            arrays[f"texture_{number}"] = one.texture
    return arrays


def _checksum(mesh: Mesh) -> int:
    total = 0
    for name, value in _arrays(mesh).items():
        if name != "name":
            total = zlib.crc32(np.ascontiguousarray(value).tobytes(), total)
    return total


def _save(mesh: Mesh, file: Path) -> None:
    arrays: dict[str, Any] = _arrays(mesh)
    np.savez(file, **arrays)


def _load(file: Path) -> Mesh:
    with np.load(file, allow_pickle=False) as content:
        arrays = dict(content)
    materials = tuple(
        Material(**one | {"color": tuple(one["color"])}, texture=arrays.pop(f"texture_{i}", None))
        for i, one in enumerate(json.loads(str(arrays.pop("materials"))))
    )
    return Mesh(**arrays | {"name": str(arrays["name"])}, materials=materials)
