"""The task of a peer (`Task`), its interface (`Peer`), and which peers can run (`find`)."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...base.records import Rays
from ...cameras import Camera
from ...shaders import TransferFunction
from ..record import PEERS, Record
from ..scenes import BenchScene

#: The module of each renderer.
_MODULES = {
    "grid_sample": "grid_sample",
    "warp": "warp_nanovdb",
    "drjit": "drjit_loop",
    "vtk": "vtk_fixed_point",
}


@dataclass(frozen=True, kw_only=True)
class Task:
    """A picture to render. The scene's voxels are cubes of 1 world unit, voxel 0 is at 0."""

    scene: BenchScene
    camera: Camera
    rays: Rays  # of the camera, on the device
    stop_alpha: float
    device: torch.device


class Peer(ABC):
    """A renderer that is prepared for a task; its construction is not timed."""

    #: How its picture differs from what the task specifies, and where it runs, in a sentence.
    differences: str

    @classmethod
    def why_unavailable(cls, device: torch.device) -> str:
        """Returns why it can't run on a device; an empty string if it can."""
        return ""

    @abstractmethod
    def __init__(self, task: Task) -> None:
        """Copies the scene to where it is rendered."""

    @abstractmethod
    def render(self) -> None:
        """Renders once; only this call is timed."""

    @abstractmethod
    def picture(self) -> Tensor:
        """Returns the last picture: (r, 4) float32, premultiplied colour and alpha, row by row."""


def spans(task: Task) -> Tensor:
    """Returns (r, 2) float64 distances at which the rays enter and leave the scene's box: none is
    below 0, and both are equal where a ray misses the box.
    """
    box = task.scene.box.to(task.device)
    a, b = ((corner - task.rays.origin) / task.rays.direction for corner in box)
    first, last = torch.minimum(a, b).amax(1).clamp(min=0), torch.maximum(a, b).amin(1)
    return torch.stack((first, torch.maximum(first, last)), 1)


def bake(shader: TransferFunction, step: float, rows: int) -> np.ndarray:
    """Samples a transfer function over [0, 255]. Returns (rows, 4) float64: colour, not
    premultiplied, and opacity of one step (world units); with 255 k + 1 rows, every multiple of
    1 / k is a row.
    """
    table = shader(np.linspace(0, 255, rows))
    with np.errstate(divide="ignore"):
        table[:, 3] = -np.expm1(np.log1p(-table[:, 3]) * step / (shader.reference or 1.0))
    return table


def find_peers(record: Record) -> dict[str, type[Peer]]:
    """Returns the renderers that can run; stores in the record why others can't."""
    chosen = record.settings.peers
    available = {}
    for name, module in _MODULES.items():
        if chosen is not None and name not in chosen:
            continue
        try:
            peer = importlib.import_module(f".{module}", __package__).Marcher
        except ImportError:
            record.peers[name] = f"not installed ({PEERS[name]})"
            continue
        reason = peer.why_unavailable(record.settings.device)
        record.peers[name] = reason or "ran"
        if not reason:
            available[name] = peer
            record.note(f"{name}: {peer.differences}")
    return available
