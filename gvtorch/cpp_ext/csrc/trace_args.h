// The arguments of `trace_rays` as plain pointers and numbers: what entry.h hands to the kernels, however they were
// compiled. No function stands here, so this header means the same in every file.
#pragma once

#include <cstdint>

namespace gvtorch {

enum class VoxelType { kUInt8, kInt8, kInt16, kUInt16, kHalf, kBFloat16, kFloat };

struct TraceArgs {
  const double *origin_r3, *direction_r3, *cone_r2, *range_r2, *place_33, *clear_r;
  const int32_t *child_tn, *brick_tn;
  int32_t *request_tn, *stamp_t;
  const void *bricks_bzyxc, *constant_tnc, *range_tn2c;
  int32_t* stamp_b;
  const void *table_lm4, *domain_2;
  const int32_t *opaque_m, *frame_1;
  void *color_r3, *alpha_r1, *depth_r1;
  int32_t* samples_r;
  uint8_t* hidden_tn;  // scratch, see HideNode
  bool* missed_r;
  int64_t rays, width, bricks, nodes;
  VoxelType voxel;
  int32_t root, nodes_per_tile, branching, max_depth, side, border, channels, component, rows, levels;
  double cone_scale, root_voxel, step, stop_alpha, depth_alpha;
  bool by_level;
};

// The shaders of `shade_rays`, numbered as in ops/shading.py.
enum class ShaderKind {
  kLit,
  kPreIntegrated,
  kStoredColor,
  kIsosurface,
  kProjection,
  kFeatures,
  kShadowedLit,
  kShadowedColor
};
constexpr int64_t kShaderKinds = 8;
constexpr bool is_stored_color(ShaderKind kind) {
  return kind == ShaderKind::kStoredColor || kind == ShaderKind::kShadowedColor;
}
constexpr int32_t kDirections = 6;  // +x -x +y -y +z -z: a stored colour may have four numbers for each

// The arguments of `shade_rays`: those of `trace_rays`, and what shaders read and give beside.
struct ShadeArgs : TraceArgs {
  ShaderKind shader;
  const void *normal_bzyxc, *normal_tnc, *other_bzyxc, *other_tnc;  // null: there is no such channel
  VoxelType normal_voxel, other_voxel;
  int32_t other_channels, other_component, features;
  const void* parameter_54;
  int32_t parameters;  // how many numbers there are: 20, and behind them a user's own
  void *normal_r3, *features_rc;
};

}  // namespace gvtorch
