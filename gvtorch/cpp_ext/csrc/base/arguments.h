// The arguments of the ops on rays, each declared once, in lists of lines
//
//   X(kind, name, limit)
//
// `kind` is one of the types below: what the argument is in the op's schema, what torch hands over, which dtype a
// tensor must have, and what the kernels get. `limit` keeps memory safe: how many numbers a tensor holds, or what an
// int stays below (it is never negative); kAny where that is told elsewhere. It is an expression of the sizes that the
// function knows in which the list is checked (check_rays, check_trace in entry.h). An X makes one thing of each line:
//
//   GV_VIEW    a member of the struct that kernels read   here, for trace_args.h
//   GV_FIELD   a member of the struct that torch fills    entry.h, as the others
//   GV_WORD    its words in the schema
//   GV_TYPE    its type, in the order of the schema
//   GV_CHECK   its check
//   GV_LAY     the step from torch's struct to the kernels'
//
// An op's list is a row of groups: trace_rays has GV_RAYS, GV_CHANNEL and GV_WALK, shade_rays these and GV_SHADE (see
// entry.h, entry_segments.h; the lists of the cache's ops stand in entry_cache.h). ops/arguments.py holds the
// same fields with what they mean, shape by shape; tests/test_arguments.py holds the two equal.
#pragma once

#include <cstdint>

namespace gvtorch {

enum class VoxelType { kUInt8, kInt8, kInt16, kUInt16, kHalf, kBFloat16, kFloat };

constexpr int64_t kAny = -1;

namespace kinds {

struct AnyReal;   // float32 or float64: the dtype in which an op computes
struct AnyVoxel;  // that of a channel

// A tensor of T. alias: it is written in place, under this letter of the schema.
template <class T, char kAliasLetter = 0, bool kMayBeNone = false>
struct TensorOf {
  using Value = T;
  using View = const T*;
  static constexpr char kAlias = kAliasLetter;
  static constexpr bool kOptional = kMayBeNone;
};
template <char kAlias, class T = int32_t>
struct Written : TensorOf<T, kAlias> {
  using View = T*;
};
template <char kAlias>
using WrittenFlags = Written<kAlias, bool>;
template <class Any, bool kOptional = false>
struct Untyped : TensorOf<Any, 0, kOptional> {
  using View = const void*;
};

using World = TensorOf<double>;
using MaybeWorld = TensorOf<double, 0, true>;
using Words = TensorOf<int32_t>;
using Longs = TensorOf<int64_t>;
using Flags = TensorOf<bool>;
using Reals = Untyped<AnyReal>;
using MaybeReals = Untyped<AnyReal, true>;
using Voxels = Untyped<AnyVoxel>;
using MaybeVoxels = Untyped<AnyVoxel, true>;

struct Int {
  using View = int32_t;
};
struct Count {  // an int that torch.compile need not know, of any size
  using View = int64_t;
};
struct Float {
  using View = double;
};
struct Bool {
  using View = bool;
};

}  // namespace kinds

// World rays. rays
#define GV_RAYS(X)                 \
  X(World, origin_r3, 3 * rays)    \
  X(World, direction_r3, 3 * rays) \
  X(World, cone_r2, 2 * rays)      \
  X(World, range_r2, 2 * rays)     \
  X(Int, width, kAny)              \
  X(MaybeWorld, clear_r, rays)

// Where the tree lies, how rays are cut, and a channel. side, nodes, channels
#define GV_CHANNEL(X)            \
  X(World, place_33, 9)          \
  X(Int, branching, 17)          \
  X(Int, max_depth, kMostLevels) \
  X(Int, border, (side + 1) / 2) \
  X(Float, root_voxel, kAny)     \
  X(Float, cone_scale, kAny)     \
  X(Float, step, kAny)           \
  X(Voxels, bricks_bzyxc, kAny)  \
  X(Voxels, constant_tnc, nodes* channels)

// The node pool, the transfer function, and where rays end. channels, nodes, tiles, bricks, table, rows
#define GV_WALK(X)                            \
  X(Voxels, range_tn2c, 2 * nodes * channels) \
  X(Int, component, channels)                 \
  X(Words, child_tn, nodes)                   \
  X(Words, brick_tn, nodes)                   \
  X(Written<'a'>, request_tn, nodes)          \
  X(Written<'b'>, stamp_t, tiles)             \
  X(Written<'c'>, stamp_b, bricks)            \
  X(Words, frame_1, 1)                        \
  X(Int, root, nodes)                         \
  X(Reals, table_lm4, table)                  \
  X(Reals, domain_2, 2)                       \
  X(Words, opaque_m, rows)                    \
  X(Float, stop_alpha, kAny)                  \
  X(Float, depth_alpha, kAny)                 \
  X(Bool, by_level, kAny)

// What a shader reads beside.
#define GV_SHADE(X)                  \
  X(Int, shader, kAny)               \
  X(Int, features, kAny)             \
  X(MaybeVoxels, normal_bzyxc, kAny) \
  X(MaybeVoxels, normal_tnc, kAny)   \
  X(MaybeVoxels, other_bzyxc, kAny)  \
  X(MaybeVoxels, other_tnc, kAny)    \
  X(Int, other_component, kAny)      \
  X(Reals, parameter_54, kAny)

#define GV_VIEW(kind, name, limit) kinds::kind::View name;

}  // namespace gvtorch
