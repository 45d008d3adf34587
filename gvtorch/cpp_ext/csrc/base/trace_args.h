// The arguments of `trace_rays` and `shade_rays` as plain pointers and numbers: what entry.h hands to the kernels,
// however they were compiled; and the kinds of things that Python names by numbers. No function that is not constexpr
// stands here, so this header means the same in every file.
#pragma once

#include "base/arguments.h"

namespace gvtorch {

struct TraceArgs {
  GV_RAYS(GV_VIEW)
  GV_CHANNEL(GV_VIEW)
  GV_WALK(GV_VIEW)

  void *color_r3, *alpha_r1, *depth_r1;
  int32_t* samples_r;
  bool* missed_r;
  uint8_t* hidden_tn;  // scratch, see hide_nodes

  int64_t rays, bricks, nodes;
  VoxelType voxel;
  int32_t nodes_per_tile, side, channels, rows, levels;
};

enum class LightKind { kHeadlight, kDirectional, kPoint };
enum class ProjectionKind { kMaximum, kMinimum, kMean };
constexpr int32_t kDirections = 6;  // +x -x +y -y +z -z: a stored colour may have four numbers for each

// The numbers of a fused shader, `parameter_54`, by name; a user's own stand behind them.
template <class T>
struct Parameters {
  T light_place[3];  // of a point light; of a directional one: the way it shines
  T light_kind;      // a LightKind
  T light_color[3], ambient;
  T diffuse, specular, shininess;
  T light_width;  // of a cone to the light: its growth (directional), or the width at the light (point)
  T own[4];       // the shader's own: its Own, see shaders.h
  T normal_scale, normal_offset, unused[2];  // a stored normal is number * scale + offset
};
constexpr int32_t kParameters = sizeof(Parameters<float>) / sizeof(float);

// Of what is optional, null: there is no such channel.
struct ShadeArgs : TraceArgs {
  GV_SHADE(GV_VIEW)

  VoxelType normal_voxel, other_voxel;
  int32_t other_channels;
  int32_t parameters;  // how many numbers there are: 20, and behind them a user's own
  void *normal_r3, *features_rc;
};

// Those of the plain transfer function, which is a shader as well.
struct PlainArgs : ShadeArgs {
  explicit PlainArgs(const TraceArgs& args) : ShadeArgs{} { static_cast<TraceArgs&>(*this) = args; }
};

}  // namespace gvtorch
