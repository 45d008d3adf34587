"""Other renderers of the same picture, each in a file of its own that imports what it needs."""

from __future__ import annotations

import importlib

from ..record import Record
from .peer import Peer, Task, bake

__all__ = ["PEERS", "Peer", "Task", "bake", "find"]

#: Module of each peer, by the name that tables show, and what must be installed for it.
PEERS = {
    "grid_sample": ("grid_sample", "torch"),
    "warp": ("warp_nanovdb", "warp-lang"),
    "drjit": ("drjit_loop", "drjit"),
    "vtk": ("vtk_fixed_point", "vtk"),
}


def find(record: Record) -> dict[str, type[Peer]]:
    """Returns the peers that can run; the record tells why others can't.

    Raises:
        ValueError: A peer was asked for whose name is unknown.
    """
    wanted = record.settings.peers
    unknown = sorted(set(wanted or ()) - set(PEERS))
    if unknown:
        raise ValueError(f"bench: unknown peer {unknown[0]!r}; known: {', '.join(PEERS)}")
    ready = {}
    for name in PEERS if wanted is None else wanted:
        module, package = PEERS[name]
        try:
            peer = importlib.import_module(f".{module}", __name__).Marcher
        except ImportError:
            record.peers[name] = f"not installed ({package})"
            continue
        reason = peer.refuses(record.settings.device)
        record.peers[name] = reason or "ran"
        if not reason:
            ready[name] = peer
            record.note(f"{name}: {peer.differs}")
    return ready
