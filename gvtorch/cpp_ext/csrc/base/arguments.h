// The arguments of ops and kernels, each declared once, in lists of lines
//
//   X(kind, name, limit)
//
// `kind` is one of the types below: it defines the argument's type in the op's schema, what torch passes, the dtype of
// a tensor, and what kernels get. `limit` keeps memory safe: how many numbers a tensor holds, or what an int is below
// (it is never negative); kAny where that is checked elsewhere. It may use the sizes in `args`, the kernels' struct,
// and the local variables that the line above the list names. An X makes one thing of each line:
//
//   GV_VIEW    a member of the struct that kernels read; GV_TYPED_VIEW, of a struct template of the real type T
//   GV_FIELD   a member of the struct that torch fills (in entry.h, like those below)
//   GV_SCHEMA  its text in the schema
//   GV_TYPE    its type, in the order of the schema
//   GV_CHECK_AND_SET
//              its check, and the copy from torch's struct to the kernels'
//
// An op's list consists of groups: trace_rays has GV_RAYS, GV_CHANNEL and GV_WALK, shade_rays these and GV_SHADE; those
// of segments are in entry_segments.h, the cache's in cache.h. ops/arguments.py documents the arguments on rays, with
// their shapes; tests/test_arguments.py checks that both are equal.
#pragma once

#include <cstdint>
#include <type_traits>

namespace gvtorch {

enum class VoxelType { kUInt8, kInt8, kInt16, kUInt16, kHalf, kBFloat16, kFloat };

constexpr int64_t kAny = -1;

namespace kinds {

struct AnyReal;   // float32 or float64: the real type, in which an op computes
struct AnyVoxel;  // the dtype of a channel

// A kind's View<Real> is what kernels get; Real: the real type, or void if only a kernel knows it.
//
// A tensor of T. kAlias: it is written in place, under this letter of the schema. kOptional: it may be None.
template <class T, char kAlias = 0, bool kOptional = false>
struct TensorOf {
  template <class Real>
  using Number = std::conditional_t<std::is_same_v<T, AnyReal>, Real, std::conditional_t<std::is_class_v<T>, void, T>>;
  template <class Real>
  using View = std::conditional_t<kAlias == 0, const Number<Real>*, Number<Real>*>;
};
using World = TensorOf<double>;
using MaybeWorld = TensorOf<double, 0, true>;
using Words = TensorOf<int32_t>;
using Longs = TensorOf<int64_t>;
using Flags = TensorOf<bool>;
using Bytes = TensorOf<uint8_t>;
using Reals = TensorOf<AnyReal>;
using MaybeReals = TensorOf<AnyReal, 0, true>;
using Voxels = TensorOf<AnyVoxel>;
using MaybeVoxels = TensorOf<AnyVoxel, 0, true>;  // each with its own dtype
template <char kAlias>
using Written = TensorOf<int32_t, kAlias>;
template <char kAlias>
using Requests = TensorOf<int16_t, kAlias>;
template <char kAlias>
using WrittenFlags = TensorOf<bool, kAlias>;
template <char kAlias>
using WrittenBytes = TensorOf<uint8_t, kAlias>;

template <class T>
struct NumberOf {
  template <class Real>
  using View = std::conditional_t<std::is_same_v<T, double> && !std::is_void_v<Real>, Real, T>;
};
using Int = NumberOf<int32_t>;
using Count = NumberOf<int64_t>;  // an int of any size, in the schema a SymInt: torch.compile need not know it
using Float = NumberOf<double>;
using Bool = NumberOf<bool>;

}  // namespace kinds

// World rays.
#define GV_RAYS(X)                      \
  X(World, origin_r3, 3 * args.rays)    \
  X(World, direction_r3, 3 * args.rays) \
  X(World, cone_r2, 2 * args.rays)      \
  X(World, range_r2, 2 * args.rays)     \
  X(Int, width, kAny)                   \
  X(MaybeWorld, clear_r, args.rays)

// Placement and shape of the tree, how rays are cut, and a channel.
#define GV_CHANNEL(X)                 \
  X(World, place_33, 9)               \
  X(Int, branching, 17)               \
  X(Int, max_depth, kMaxLevels)       \
  X(Int, border, (args.side + 1) / 2) \
  X(Float, root_voxel, kAny)          \
  X(Float, cone_scale, kAny)          \
  X(Float, step, kAny)                \
  X(Voxels, bricks_bzyxc, kAny)       \
  X(Voxels, constant_tnc, args.nodes* args.voxel_width)

// Node pool, transfer function, and where rays end. In scope for the limits: tiles, rows
#define GV_WALK(X)                                         \
  X(Voxels, range_tn2c, 2 * args.nodes * args.voxel_width) \
  X(Int, component, args.voxel_width)                      \
  X(Words, child_tn, args.nodes)                           \
  X(Words, brick_tn, args.nodes)                           \
  X(Requests<'a'>, request_tn, args.nodes)                 \
  X(Written<'b'>, stamp_t, tiles)                          \
  X(Written<'c'>, stamp_b, args.bricks)                    \
  X(Words, frame_1, 1)                                     \
  X(Int, root, args.nodes)                                 \
  X(Reals, table_lm4, kAny)                                \
  X(Reals, domain_2, 2)                                    \
  X(Words, opaque_m, rows)                                 \
  X(Float, stop_alpha, kAny)                               \
  X(Float, depth_alpha, kAny)                              \
  X(Bool, by_level, kAny)

// What a shader reads in addition.
#define GV_SHADE(X)                  \
  X(Int, shader, kAny)               \
  X(Int, features, kAny)             \
  X(MaybeVoxels, normal_bzyxc, kAny) \
  X(MaybeVoxels, normal_tnc, kAny)   \
  X(MaybeVoxels, other_bzyxc, kAny)  \
  X(MaybeVoxels, other_tnc, kAny)    \
  X(Int, other_component, kAny)      \
  X(Reals, parameter_54, kAny)

#define GV_VIEW(kind, name, limit) kinds::kind::View<void> name;
#define GV_TYPED_VIEW(kind, name, limit) kinds::kind::template View<T> name{};

struct TraceArgs {
  GV_RAYS(GV_VIEW)
  GV_CHANNEL(GV_VIEW)
  GV_WALK(GV_VIEW)

  void *color_r3, *alpha_r1, *depth_r1;
  int32_t* samples_r;
  bool* missed_r;
  uint8_t* hidden_tn;  // scratch, see trace_chunks.h

  int64_t rays, bricks, nodes;
  int64_t packet_bricks;  // how many of the bricks, from the first on, packets read; see trace_chunks.h
  int64_t table;          // how many numbers table_lm4 has
  VoxelType voxel;
  int32_t nodes_per_tile, side;
  int32_t voxel_width;    // numbers per voxel
  int32_t rows, lengths;  // table_lm4 has a table of `rows` rows for each of `lengths` lengths of intervals
};

enum class LightKind { kHeadlight, kDirectional, kPoint };
enum class ProjectionKind { kMaximum, kMinimum, kMean };
constexpr int32_t kDirections = 6;  // +x -x +y -y +z -z: a stored colour may have four numbers for each

// The numbers of a fused shader, `parameter_54`, by name; the uniforms of a user's shader follow them.
template <class T>
struct Parameters {
  T light_vector[3];  // position of a point light; direction in which a directional one shines
  T light_kind;       // a LightKind
  T light_color[3], ambient;
  T diffuse, specular, shininess;
  T light_width;                  // of a cone to the light: its growth (directional), or the width at the light (point)
  T own[4];                       // the shader's struct Numbers, see shaders.h
  T normal_scale, normal_offset;  // a stored normal is number * scale + offset
  T octaves, anisotropy;          // of multiple scattering; 0 octaves: a surface is lit
};
constexpr int32_t kParameters = sizeof(Parameters<float>) / sizeof(float);

constexpr int32_t kPlainShader = -1;  // the transfer function alone

// Optional channels are null where they are absent.
struct ShadeArgs : TraceArgs {
  GV_SHADE(GV_VIEW)

  VoxelType normal_voxel, other_voxel;
  int32_t other_width, other_bricks;  // numbers per voxel of the second channel; how many bricks have it
  int32_t uniforms;                   // how many numbers follow the kParameters of parameter_54
  void *normal_r3, *features_rc;
};

}  // namespace gvtorch
