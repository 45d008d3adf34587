"""A mesh as volumes that are read region by region (one `MeshSource` per channel), and `voxelize`,
which writes them into a store with the writer of `convert`.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import multiprocessing
import threading
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch

from ..base import check
from ..base.boxes import box_of
from ..base.image_info import PREMULTIPLIED, SIGNED_DISTANCE, ImageInfo
from ..base.stage import Progress, no_progress
from ..meshes.holes import SolidParts, warn_of_holes
from ..meshes.mesh import Material, Mesh
from ..meshes.voxelizer import CHANNELS, GridSettings, Voxelizer, check_channels
from .mesh_file import read_mesh
from .source import Index, VolumeSource
from .stores.channels import convert_channels
from .stores.conversion import convert
from .stores.store import Store
from .stores.unfinished import checksum, fingerprint

_LOCK = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class MeshSource(VolumeSource):
    """One channel of a mesh's finest voxels."""

    channel: str
    settings: tuple[tuple[str, Any], ...]  # `Voxelizer.settings`
    solid: SolidParts  # as the user chose
    identity: tuple[Any, ...]  # of mesh and settings: equal while these are unchanged
    mesh: Mesh | None = dataclasses.field(default=None, repr=False)  # with its holes filled
    file: str = ""  # holds the mesh, if that is not in memory

    @classmethod
    def of(
        cls,
        mesh_or_path: str | Path | Mesh,
        channels: str | Sequence[str] = "coverage",
        *,
        texture: str | Path | None = None,
        **settings: Unpack[GridSettings],
    ) -> dict[str, MeshSource]:
        """Reads a mesh, lays a grid around it, and returns a source per channel; see `voxelize`."""
        solid = settings.get("solid", "auto")
        if "resolution" in settings:  # all voxels are made, not only those that are seen
            check.integer("voxelize", "resolution", settings["resolution"], low=8, high=2**20)
        check.instance("voxelize", "mesh", mesh_or_path, Mesh, str, PathLike)
        names = check_channels("voxelize", channels)
        if isinstance(mesh_or_path, Mesh):
            if texture is not None:
                raise ValueError("voxelize: texture is for files: a Mesh has its own")
            mesh, identity, name = mesh_or_path, list[Any](), mesh_or_path.name
        else:
            mesh, name = read_mesh(mesh_or_path, texture=texture), str(mesh_or_path)
            identity = fingerprint(mesh_or_path)
        warn_of_holes(mesh, solid, stacklevel=3)
        identity.insert(0, checksum(v for name, v in _mesh_arrays(mesh).items() if name != "name"))
        voxelizer = Voxelizer(mesh, channels=names, **settings)
        sources = {}
        for channel in names:
            dtype, width = CHANNELS[channel]
            x, y, z = voxelizer.extent
            colors = PREMULTIPLIED if channel == "color" else ()
            quantity = SIGNED_DISTANCE if channel == "distance" else channel
            sources[channel] = cls(
                path=name,
                shape=(z, y, x, width),
                axes="zyxc",
                stored=str(dtype).removeprefix("torch."),
                spacing=(voxelizer.spacing,) * 3,
                origin=voxelizer.origin,
                info=ImageInfo(channels=colors, quantity=quantity, labels=channel == "material"),
                channel=channel,
                settings=tuple(voxelizer.settings.items()),
                solid=solid,
                identity=tuple(identity),
                mesh=voxelizer.mesh,
            )
        return sources

    def staged(self, folder: Path) -> MeshSource:
        if self.mesh is None:
            return self
        file, arrays = folder / "mesh.npz", _mesh_arrays(self.mesh)
        np.savez(file, **arrays)  # type: ignore[arg-type]
        return dataclasses.replace(self, mesh=None, file=str(file))

    def fingerprint(self) -> list[Any]:
        settings = {**dict(self.settings), "solid": self.solid}
        return [*self.identity, self.channel, *settings.values()]

    def read_stored(self, index: Index) -> np.ndarray:
        low, high = box_of(index[:3])
        with _LOCK:  # the first thread builds the hierarchy
            grid = _voxelizer(self)
        return grid.region(low, high)[self.channel].cpu().numpy()[..., index[3]]


@functools.lru_cache(maxsize=2)
def _voxelizer(source: MeshSource) -> Voxelizer:
    """Returns the voxelizer of a source, which is cached because every region needs it."""
    if multiprocessing.parent_process() is not None:
        torch.set_num_threads(1)  # one of several processes that share the cores
    mesh = _load_mesh(Path(source.file)) if source.mesh is None else source.mesh
    return Voxelizer(mesh, channels=(source.channel,), **dict(source.settings))


def voxelize(
    mesh: str | Path | Mesh,
    store: str | Path,
    *,
    channels: str | Sequence[str] = "coverage",
    texture: str | Path | None = None,
    block: int = 32,
    executor: Executor | None = None,
    workers: int | None = None,
    resume: bool = False,
    progress: Progress = no_progress,
    **settings: Unpack[GridSettings],
) -> Store:
    """Writes a mesh into a store, out of core: memory holds only the mesh and a few cubes of
    voxels. Large stores are written by worker processes, see `convert`.

    Args:
        mesh: A `Mesh`, or a file that `read_mesh` can read.
        store: The folder to create.
        channels: One or several of coverage, distance, color, normal and material; see `Voxelizer`.
            Several become stores side by side in the folder, for `StoredChannels`.
        texture: As in `read_mesh`; for files only.
        block, executor, workers, resume, progress: As in `convert`.
        **settings: resolution, band, thickness and solid, as in `gv.MeshProducer`.

    Returns:
        The open store; with several channels, that of the first. Its coarse levels are means of
        finer ones (for materials, the most frequent).

    Raises:
        ValueError, OSError, KeyboardInterrupt: As in `read_mesh` and `convert`.
    """
    check.known_options("voxelize", settings, GridSettings)
    sources = MeshSource.of(mesh, channels, **settings, texture=texture)
    options: dict[str, Any] = {"block": block, "executor": executor, "workers": workers}
    options |= {"resume": resume, "progress": progress}
    if len(sources) > 1:
        return convert_channels(sources, store, **options)
    return convert(next(iter(sources.values())), store, **options)


def _mesh_arrays(mesh: Mesh) -> dict[str, np.ndarray]:
    """Returns the data of a mesh as arrays by name."""
    materials = [{"name": material.name, "color": material.color} for material in mesh.materials]
    arrays = {"materials": np.array(json.dumps(materials)), "name": np.array(mesh.name)}
    for name in ("vertices", "faces", "color", "uv", "material"):
        if (value := getattr(mesh, name)) is not None:
            arrays[name] = value
    for number, material in enumerate(mesh.materials):
        if material.texture is not None:
            arrays[f"texture_{number}"] = material.texture
    return arrays


def _load_mesh(file: Path) -> Mesh:
    with np.load(file, allow_pickle=False) as content:
        arrays = dict(content)
    materials = []
    for number, fields in enumerate(json.loads(str(arrays.pop("materials")))):
        texture = arrays.pop(f"texture_{number}", None)
        materials.append(Material(**fields | {"color": tuple(fields["color"])}, texture=texture))
    return Mesh(**arrays | {"name": str(arrays["name"])}, materials=tuple(materials))
