"""Other renderers of the same picture, each in a file of its own that imports what it needs."""

from __future__ import annotations

import importlib

from .. import PEERS
from ..record import Record
from .peer import Peer, Task, bake

__all__ = ["Peer", "Task", "bake", "find"]

#: The module of each renderer.
_HOME = {
    "grid_sample": "grid_sample",
    "warp": "warp_nanovdb",
    "drjit": "drjit_loop",
    "vtk": "vtk_fixed_point",
}


def find(record: Record) -> dict[str, type[Peer]]:
    """Returns the renderers that can run; the record tells why others can't."""
    wanted = record.settings.peers
    ready = {}
    for name, module in _HOME.items():
        if wanted is not None and name not in wanted:
            continue
        try:
            peer = importlib.import_module(f".{module}", __name__).Marcher
        except ImportError:
            record.peers[name] = f"not installed ({PEERS[name]})"
            continue
        reason = peer.refuses(record.settings.device)
        record.peers[name] = reason or "ran"
        if not reason:
            ready[name] = peer
            record.note(f"{name}: {peer.differs}")
    return ready
