"""Records of the ops on rays: the rays, the tree and transfer function that they are traced with,
and the shader; and the segments and samples that go from op to op. `trace.py` checks them.

Each field is an argument of the ops' schemas, with the name and the order it has in
cpp_ext/csrc/base/arguments.h, which lists all arguments. The last part of a tensor's name is its
shape, one letter or digit a dimension: r rays, t tiles, n nodes of a tile, b brick slots, z y x
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
    clear_r: Tensor | None = None  # transmittance at the start of each ray; None: 1

    @classmethod
    def of(cls, rays: Rays) -> "RayArguments":
        """Converts rays of any dtype."""
        columns = (rays.origin, rays.direction, rays.cone, rays.range)
        origin, direction, cone, ranges = (column.double().contiguous() for column in columns)
        light = rays.transmittance
        clear = None if light is None else light.double().contiguous()
        return cls(origin, direction, cone, ranges, rays.width, clear)

    def some(self, index: Tensor) -> "RayArguments":
        """Returns the rays at the indices `index` (k,) int64, without a transmittance."""
        origin, direction, cone, ranges = (column[index] for column in self[:4])
        return RayArguments(origin, direction, cone, ranges)


class TraceArguments(NamedTuple):
    """What all rays share: tree, pools, transfer function. `sample_bricks` reads only `channel`.

    Rays are traced in the table's dtype, float32 or float64.
    """

    # Placement of the tree, and how rays are cut into intervals.
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
    constant_tnc: Tensor  # same dtype: the value of CONSTANT nodes, the mean of EMPTY ones
    range_tn2c: Tensor  # same dtype: smallest and largest value in reach of a node's brick. A node
    # whose range is all transparent is neither entered, sampled nor requested
    component: int  # which of the c values the transfer function reads
    # The node pool; words are int32, requests int16.
    child_tn: Tensor  # tile of a node's children, or ABSENT, TERMINAL
    brick_tn: Tensor  # a node's brick slot, or ABSENT, EMPTY, CONSTANT
    request_tn: Tensor  # request words; mutated: what rays missed
    stamp_t: Tensor  # last frame that used a tile; mutated
    stamp_b: Tensor  # last frame that used a brick; mutated
    frame_1: Tensor  # number of this frame
    root: int  # index of the root node
    # The transfer function.
    table_lm4: Tensor  # linear RGB and the alpha of an interval of step * 2^l; m >= 2; begins at a
    # multiple of 16 bytes. (l, m, m, 4) for the pre-integrated shader: premultiplied colour and
    # alpha by the value in front (rows) and behind
    domain_2: Tensor  # same dtype: value of the first row, value of the last row
    opaque_m: Tensor  # int32, number of rows up to and including this one that have an opacity
    # When a ray ends.
    stop_alpha: float = config.STOP_ALPHA  # at this alpha; 1 integrates to the end
    depth_alpha: float = config.DEPTH_ALPHA  # depth is where alpha passes this
    by_level: bool = False  # request a node's brick before its children; else the wanted level's

    @property
    def channel(self) -> tuple:
        """Placement of the tree, bricks and constants: all that `sample_bricks` reads."""
        return self[:9]


class ShadeArguments(NamedTuple):
    """The fused or user's shader, and the further channels it reads; see csrc/shaders/shaders.h."""

    shader: int = 0  # number of its kind (`reference.shaders.shader_number`); 0 for a user's op
    features: int = 0  # width of its features: c for Features, 1 for Projection and Labels, else 0
    normal_bzyxc: Tensor | None = None  # channel of normals, c = 3; None: normals from the gradient
    normal_tnc: Tensor | None = None  # its constants
    other_bzyxc: Tensor | None = None  # second channel: colours of isosurfaces, filtered, features
    other_tnc: Tensor | None = None  # its constants
    other_component: int = 0  # which number of the second channel colours an isosurface


class Segments(NamedTuple):
    """Runs of samples, ray after ray and front to back along each.

    A segment is a run of intervals of one length that a ray takes in one node, or one odd interval:
    the last one of a ray, cut at the far side, or a whole region of one value. Where two levels
    blend, values come from two nodes, the fine one first; else both are the same node.
    """

    ray_index: Tensor  # (s,) int32
    node: Tensor  # (s, 2) int32
    brick: Tensor  # (s, 2) int32 slots, or EMPTY, CONSTANT
    depth: Tensor  # (s, 3) int32 depths of both nodes, and the depth that the cone asked for
    interval: Tensor  # (s, 3) int32 number of the first, how many, level (-1: an odd interval)
    distance: Tensor  # (s, 3) from where the ray enters the box: base from which intervals are
    # numbered, end of the last one, and where the node was looked up
    t0: Tensor  # (s,) world distance from the camera at which the first interval starts
    t1: Tensor  # (s,) and at which the last one ends
    counts: Tensor  # (r, 3) int32 segments, samples and nodes visited of each ray
    state: Tensor  # (r, 3) base, number and level of each ray's next interval, to resume from
    missed: Tensor  # (r,) bool, a node or brick that the ray needed was absent


class Samples(NamedTuple):
    """Samples of segments, ray after ray and front to back along each."""

    segment: Tensor  # (k,) int32
    number: Tensor  # (k,) int32 index of the interval in its segment, from 0
    offset: Tensor  # (r + 1,) int64 index of each ray's first sample; the last is the total
