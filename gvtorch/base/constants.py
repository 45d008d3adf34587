"""Constants that several packages use. Those that a user may change are defaults of arguments."""

from __future__ import annotations

#: A pixel's cone is this many times as wide as the pixel, so that a coarser level is chosen a
#: little early rather than late. Source: the original engine's factor (devkit, GvRendererKernel
#: documentation: 1.333).
CONE_OVERESTIMATE = 4 / 3

#: A ray ends where its alpha reaches this; 1 integrates to the far side. Source: Crassin et al.,
#: I3D 2009.
STOP_ALPHA = 0.99

#: The depth of a ray is where its alpha exceeds this; rays that stay below have depth +inf.
DEPTH_ALPHA = 0.1

#: Shortest interval, in voxels of the finest level.
STEP = 0.5

#: Largest branching: N of a tree, whose nodes split into N^3.
MAX_BRANCHING = 16

#: Most voxels along a side of a scene that a producer makes.
MAX_EXTENT = 2**40

#: Most pixels along a side of a picture.
MAX_PICTURE_SIDE = 65536

#: Most voxels that a volume in memory may have (2^31).
MAX_VOXELS = 2**31

#: Most intervals that a ray counts from one base: the count is a float32.
MAX_INTERVALS = 2**23

#: Where the root cube has more voxels than this along a side, positions are computed in float64:
#: those in float32 would be exact to 1/128 of a voxel at best.
DEEP_VOXELS = 2**18

#: Most nodes of the finest level along a side of the root cube: float64 can count them.
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
#: Kind bits shifted by this are the pending bits: requested, and the answer is not written yet.
#: See cpp_ext/csrc/cache/cache.h.
REQUEST_PENDING_SHIFT = 2
