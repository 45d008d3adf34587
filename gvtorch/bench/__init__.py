"""The workloads of `gvtorch bench`: what each measures, and how it is run.

Nothing here needs torch until a workload runs, so that the command line can list them at once.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .record import Record, Settings

#: What each workload does; the function of that name is in the module given by `_MODULES`.
WORKLOADS = {
    "march": "ray marching in memory: fog, a shell, clouds and a scan; also by other renderers",
    "first_hit": "the first opaque voxel of a thin shell, 1920x1080; also by other renderers",
    "calls": "the overhead of a call: small pictures, one by one and 1,000 in one batch",
    "bricks": "time and memory of ray marching with brick sizes 4 to 32 and borders 0 to 2",
    "shaders": "each shader compared with a simpler one, in memory and in the engine",
    "lens": "depth of field in the engine: more blur needs coarser levels and fewer bricks",
    "opengl": "pictures read from OpenGL and drawn to it, in shared buffers or through the host",
    "view": "the viewer: pictures a second, and the delay after a mouse move; also other viewers",
    "frame": "the engine: frames that load nothing, the cache's share of them, and a cold start",
    "deep": "frames of a patch of a surface, in a tree of the patch and in one 16 times as wide",
    "lru": "1 M slots sorted by last use, compared with torch.sort",
    "compact": "the requests of 8 M nodes collected, compared with torch.nonzero",
    "produce": "10^3-voxel bricks computed by the library's producers, eager and compiled",
    "noise": "noise at points, compared with its torch twin, NumPy and noise libraries",
    "stream": "10^3-voxel bricks loaded from host memory into the pool, compared with a plain copy",
    "convert": "a volume file converted to a store",
    "voxelize": "a mesh of 100,000 triangles to voxels and to a store; also by other libraries",
    "blocks": "random blocks with borders read from a store, compared with tensorstore and zarr",
}
_RENDERERS = ("grid_sample", "warp", "drjit", "vtk")
#: What workloads are compared with, by the names in `--peers`; the others have no peers.
COMPARED_WITH = {
    **{"march": _RENDERERS, "first_hit": _RENDERERS, "view": ("viser", "trame")},
    "noise": ("pyfastnoiselite", "pyfastnoisesimd"),
    **{"voxelize": ("trimesh", "igl"), "blocks": ("tensorstore", "zarr")},
}
SAVES_PICTURES = ("march", "first_hit")
_MODULES = {
    **dict.fromkeys(("march", "first_hit", "calls", "bricks"), "march"),
    **{"frame": "frames", "deep": "frames"},
    **{"shaders": "shaders", "lens": "lens", "opengl": "exchange"},
    **{"stream": "frames", "lru": "cache", "compact": "cache", "produce": "produce"},
    **{"noise": "noise", "voxelize": "voxelize", "view": "view"},
    **{"convert": "storage", "blocks": "storage"},
}


class Unavailable(ValueError):
    """A workload needs something that is not available here, or has no case of the given name."""


def run(name: str, settings: Settings) -> Record:
    """Runs a workload.

    Raises:
        ValueError: There is no such workload.
        Unavailable: The workload can't run here, or no case has `only` in its name.
    """
    from .record import Record, noting_other_processes

    if name not in WORKLOADS:
        raise ValueError(f"bench: unknown workload {name!r}; known: {', '.join(WORKLOADS)}")
    record = Record(name, settings)
    with noting_other_processes(record):
        getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)(record)
    if not record.rows:
        raise Unavailable(f"bench: no case of {name} has {settings.only!r} in its name")
    return record
