// The arguments of `trace_rays` and `shade_rays` as plain pointers and numbers: what entry.h hands to the kernels,
// however they were compiled. No function stands here, so this header means the same in every file.
#pragma once

#include "arguments.h"

namespace gvtorch {

struct TraceArgs {
  GV_RAYS(GV_VIEW)
  GV_CHANNEL(GV_VIEW)
  GV_WALK(GV_VIEW)

  void *color_r3, *alpha_r1, *depth_r1;
  int32_t* samples_r;
  bool* missed_r;
  uint8_t* hidden_tn;  // scratch, see HideNode

  int64_t rays, bricks, nodes;
  VoxelType voxel;
  int32_t nodes_per_tile, side, channels, rows, levels;
};

constexpr int64_t kShaderKinds = 8;
constexpr bool is_stored_color(ShaderKind kind) {
  return kind == ShaderKind::kStoredColor || kind == ShaderKind::kShadowedColor;
}
constexpr int32_t kDirections = 6;  // +x -x +y -y +z -z: a stored colour may have four numbers for each

// Of what is optional, null: there is no such channel.
struct ShadeArgs : TraceArgs {
  GV_SHADE(GV_VIEW)

  VoxelType normal_voxel, other_voxel;
  int32_t other_channels;
  int32_t parameters;  // how many numbers there are: 20, and behind them a user's own
  void *normal_r3, *features_rc;
};

}  // namespace gvtorch
