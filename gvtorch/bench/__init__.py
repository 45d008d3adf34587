"""The workloads of `gvtorch bench`: what each measures, and how it is run.

Nothing here needs torch until a workload runs, so that the command line can list them at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .record import Record, Settings

#: What each workload does; the function of that name is in the module given by `_HOME`.
WORKLOADS = {
    "march": "rays through resident trees: fog, shell, clouds and a scan, beside peers",
    "first_hit": "the first opaque voxel of a thin shell, 1920x1080, beside peers",
    "calls": "what a call costs beside its rays: small pictures, one by one and 1,000 at once",
    "bricks": "marching with brick sizes 4 to 32 and borders 0 to 2, and their memory",
    "shaders": "each shader beside the plain transfer function, resident and in the engine",
    "lens": "the engine through lenses: more blur, coarser levels, fewer bricks",
    "opengl": "pictures out of OpenGL and into it, in shared buffers and through the host",
    "view": "a page of the viewer: pictures a second, from the hand to the picture; beside peers",
    "frame": "the engine: a steady frame and the cache's share of it, a cold start",
    "deep": "steady frames of a surface in a tree of 13 levels, and of its patch in one of 9",
    "lru": "1 M slots ordered by use, beside torch.sort",
    "compact": "requests listed out of 8 M nodes, beside torch.nonzero",
    "produce": "10^3-voxel bricks made by the producers of the library, eager and compiled",
    "noise": "noise at points, beside its twin, NumPy and libraries of noise",
    "stream": "10^3-voxel bricks from host memory into the pool, beside a plain copy",
    "convert": "a volume file to a store",
    "voxelize": "a mesh of 100,000 triangles to voxels and to a store, beside peers",
    "blocks": "random blocks with border out of a store, beside tensorstore and zarr",
}
_HOME = {
    **dict.fromkeys(("march", "first_hit", "calls", "bricks"), "march"),
    **{"frame": "frames", "deep": "frames"},
    **{"shaders": "shaders", "lens": "lens", "opengl": "exchange"},
    **{"stream": "frames", "lru": "cache", "compact": "cache", "produce": "produce"},
    **{"noise": "noise", "voxelize": "voxelize", "view": "view"},
    **{"convert": "storage", "blocks": "storage"},
}


class Unavailable(ValueError):
    """A workload needs something that is not available here."""


def run(name: str, settings: Settings) -> Record:
    """Runs a workload.

    Raises:
        ValueError: There is no such workload or peer, or no case has `only` in its name.
        Unavailable: The workload can't run here.
    """
    from .record import PEERS, Record, elsewhere

    for what, wanted, known in (
        ("workload", (name,), WORKLOADS),
        ("peer", settings.peers or (), PEERS),
    ):
        unknown = sorted(set(wanted) - set(known))
        if unknown:
            raise ValueError(f"bench: unknown {what} {unknown[0]!r}; known: {', '.join(known)}")
    record = Record(name, settings)
    with elsewhere(record):
        getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)(record)
    if not record.rows:
        raise ValueError(f"bench: no case of {name} has {settings.only!r} in its name")
    return record
