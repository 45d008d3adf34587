"""Constants that more than one floor needs. What a user may change is an argument with this as its
default.
"""

from __future__ import annotations

#: The pixel cone is taken this much wider than the pixel, so that a level of detail is chosen a
#: little early rather than late. Source: the original engine's factor (devkit, GvRendererKernel
#: documentation: 1.333).
CONE_OVERESTIMATE = 4 / 3

#: A ray ends where its alpha reaches this; 1 integrates to the far side. Source: Crassin et al.,
#: I3D 2009.
STOP_ALPHA = 0.99

#: The depth of a ray is where its alpha passes this; rays that stay below have depth +inf.
DEPTH_ALPHA = 0.1

#: Shortest interval, in voxels of the finest level.
STEP = 0.5

#: Most voxels that a volume read at once may have (2^31).
MAX_VOXELS = 2**31

#: Most intervals that a ray counts from one base: their number is kept in a float32.
MAX_INTERVALS = 2**23

#: Above so many voxels a side of the root cube, places are worked out in float64: float32 would
#: tell them to 1/128 of a voxel at best.
DEEP_VOXELS = 2**18

#: Most nodes of the finest level along a side of the root cube: float64 counts them.
MOST_NODES = 2**50

#: Node words, see cpp_ext/csrc/walk/tree.h.
ABSENT = -1
TERMINAL = -2
EMPTY = -2
CONSTANT = -3

#: Request words, see cpp_ext/csrc/base/hd.h: kind bits above a priority of 11 bits. With
#: the pending bits they take 15 bits of an int16, which is never negative.
REQUEST_PRIORITY = 0x7FF
REQUEST_LOAD = 1 << 11
REQUEST_SUBDIVIDE = 1 << 12
REQUEST_KINDS = REQUEST_LOAD | REQUEST_SUBDIVIDE
#: Kinds shifted by this are pending: asked for, not here yet, see cpp_ext/csrc/cache/cache.h.
REQUEST_PENDING_SHIFT = 2
