"""The records that the ops of rays take: rays, what they go through, and how a shader colours it;
and segments and samples, which some ops give and others take. `trace.py` checks them.

A field is an argument of the ops' schemas, of the same name and in the same order as in
cpp_ext/csrc/base/arguments.h, where the ops' lists stand. The last part of a tensor's name tells
its shape, a letter or digit a dimension: r rays, t tiles, n nodes of a tile, b brick slots, z y x
voxels, c numbers of a voxel, l lengths of intervals, m rows of a table. All tensors are contiguous
and on one device.
"""
# No `from __future__ import annotations` here: TorchScript reads the types of the fields.

from typing import NamedTuple

from torch import Tensor

from ..base import constants as config
from ..base.records import Rays


class RayArguments(NamedTuple):
    """World rays, in float64."""

    origin_r3: Tensor  # world units
    direction_r3: Tensor  # of unit length
    cone_r2: Tensor  # cone width at distance 0 and its growth, world units; zeros: finest level
    range_r2: Tensor  # first and last distance, world units
    width: int = 0  # pixels of a row, if the rays are rows of a picture (traced in tiles), else 0
    clear_r: Tensor | None = None  # transmittance with which rays begin; None: 1

    @classmethod
    def of(cls, rays: Rays) -> "RayArguments":
        """Takes rays of any dtype."""
        return cls(
            rays.origin.double().contiguous(),
            rays.direction.double().contiguous(),
            rays.cone.double().contiguous(),
            rays.range.double().contiguous(),
            rays.width,
            None if rays.transmittance is None else rays.transmittance.double().contiguous(),
        )

    def some(self, which: Tensor) -> "RayArguments":
        """The rays `which` (k,) int64 of them, without a transmittance."""
        origin, direction, cone, limits = (column[which] for column in self[:4])
        return RayArguments(origin, direction, cone, limits)


class TraceArguments(NamedTuple):
    """What stays the same from ray to ray. `sample_bricks` reads the first fields alone.

    The table's dtype, float32 or float64, is the one in which rays are traced.
    """

    # Where the tree lies, and how rays are cut into intervals.
    place_33: Tensor  # float64 low corner of the scene in the world, size of the root cube in the
    # world, high corner of the scene in tree units
    branching: int  # N, nodes of a tile along an axis
    max_depth: int  # depth of the finest level
    border: int  # voxels of border on each side of a brick
    root_voxel: float  # world size of a depth-0 voxel: a cone this wide wants depth 0
    cone_scale: float  # factor on cones
    step: float  # world length of the shortest interval between samples
    # A channel of the pool.
    bricks_bzyxc: Tensor  # s = brick size + 2 border voxels along z, y and x
    constant_tnc: Tensor  # same dtype: the value of CONSTANT nodes (and the mean of EMPTY ones)
    range_tn2c: Tensor  # same dtype: smallest and largest value in reach of a node's brick: a node
    # that shows nothing is neither entered, sampled nor requested
    component: int  # which of the c values the transfer function reads
    # The node pool; words are int32, requests int16.
    child_tn: Tensor  # tile of a node's children, or ABSENT, TERMINAL
    brick_tn: Tensor  # a node's brick slot, or ABSENT, EMPTY, CONSTANT
    request_tn: Tensor  # request words; written: what rays missed
    stamp_t: Tensor  # last frame that used a tile; written
    stamp_b: Tensor  # last frame that used a brick; written
    frame_1: Tensor  # number of this frame
    root: int  # index of the root node
    # The transfer function.
    table_lm4: Tensor  # linear RGB and the alpha of an interval of step * 2^l; m >= 2; begins at a
    # multiple of 16 bytes. (l, m, m, 4) for the pre-integrated shader: premultiplied colour and
    # alpha by the value in front (rows) and behind
    domain_2: Tensor  # same dtype: value of the first row, value of the last row
    opaque_m: Tensor  # int32, how many rows of the table up to this one have an opacity
    # When a ray ends.
    stop_alpha: float = config.STOP_ALPHA  # at this alpha; 1 integrates to the end
    depth_alpha: float = config.DEPTH_ALPHA  # depth is where alpha passes this
    by_level: bool = False  # a node's brick is requested before its children; else the wanted level

    @property
    def channel(self) -> tuple:
        """Where the tree lies, the bricks and the constants: all that `sample_bricks` reads."""
        return self[:9]


class ShadeArguments(NamedTuple):
    """Which fused shader, or a user's, and what it reads beside; see csrc/shaders/shaders.h."""

    shader: int = 0  # a `shading.shader_number`; 0 for a user's op
    features: int = 0  # numbers it gives: c of features, 1 of projections and labels, else 0
    normal_bzyxc: Tensor | None = None  # channel of normals, c = 3; None takes the gradient's
    normal_tnc: Tensor | None = None  # its constants
    other_bzyxc: Tensor | None = None  # second channel: colours an isosurface, or is the features
    other_tnc: Tensor | None = None  # its constants
    other_component: int = 0  # which number of the second channel colours an isosurface


class Segments(NamedTuple):
    """Runs of samples, ray after ray and front to back along each.

    A segment is all the intervals of one length that a ray takes in one node, or one piece: the
    last interval of a ray, cut at the far side, or a region of one value. Where two levels blend,
    two nodes answer, the fine one first; else both are the same.
    """

    ray_index: Tensor  # (s,) int32
    node: Tensor  # (s, 2) int32
    brick: Tensor  # (s, 2) int32 slots, or EMPTY, CONSTANT
    depth: Tensor  # (s, 3) int32 of both nodes, and the one that the cone asked for
    interval: Tensor  # (s, 3) int32 number of the first, how many, level; -1: a piece
    distance: Tensor  # (s, 3) from where the ray enters the box: base of the numbers, end, look-up
    t0: Tensor  # (s,) world distance from the camera at which the first interval starts
    t1: Tensor  # (s,) and at which the last one ends
    counts: Tensor  # (r, 3) int32 segments, samples and nodes visited of each ray
    state: Tensor  # (r, 3) where each ray goes on: base, number and level of its next interval
    missed: Tensor  # (r,) bool, something that the ray saw was not there


class Samples(NamedTuple):
    """Samples of segments, ray after ray and front to back along each."""

    segment: Tensor  # (k,) int32
    number: Tensor  # (k,) int32 interval of the segment, from 0
    offset: Tensor  # (r + 1,) int64 where each ray's samples begin, and how many there are
