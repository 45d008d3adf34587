"""What a peer is asked, what it answers, and which peers can run."""

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
_HOME = {
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
    """A renderer, made ready for a task; what making takes is not timed."""

    #: What it renders otherwise than the task says, and where it runs, in a sentence.
    differs: str

    @classmethod
    def refuses(cls, device: torch.device) -> str:
        """Tells why it can't run on a device, or nothing."""
        return ""

    @abstractmethod
    def __init__(self, task: Task) -> None:
        """Takes the scene to where it is rendered."""

    @abstractmethod
    def render(self) -> None:
        """Renders once, all of what is timed."""

    @abstractmethod
    def picture(self) -> Tensor:
        """Returns the last picture: (r, 4) float32, premultiplied colour and alpha, row by row."""


def spans(task: Task) -> Tensor:
    """(r, 2) distances at which the rays enter and leave the scene's box, float64; the first is
    not below 0, and not below the last where a ray misses the box.
    """
    box = task.scene.box.to(task.device)
    a, b = ((corner - task.rays.origin) / task.rays.direction for corner in box)
    first, last = torch.minimum(a, b).amax(1).clamp(min=0), torch.maximum(a, b).amin(1)
    return torch.stack((first, torch.maximum(first, last)), 1)


def bake(shader: TransferFunction, step: float, rows: int) -> np.ndarray:
    """Samples a transfer function over [0, 255]: (rows, 4) float64 colour, not premultiplied, and
    opacity of a step in world units; 255 k + 1 rows hit every value that is a multiple of 1 / k.
    """
    table = shader(np.linspace(0, 255, rows))
    with np.errstate(divide="ignore"):
        table[:, 3] = -np.expm1(np.log1p(-table[:, 3]) * step / (shader.reference or 1.0))
    return table


def find(record: Record) -> dict[str, type[Peer]]:
    """Returns the renderers that can run; the record tells why others can't."""
    wanted = record.settings.peers
    ready = {}
    for name, module in _HOME.items():
        if wanted is not None and name not in wanted:
            continue
        try:
            peer = importlib.import_module(f".{module}", __package__).Marcher
        except ImportError:
            record.peers[name] = f"not installed ({PEERS[name]})"
            continue
        reason = peer.refuses(record.settings.device)
        record.peers[name] = reason or "ran"
        if not reason:
            ready[name] = peer
            record.note(f"{name}: {peer.differs}")
    return ready
