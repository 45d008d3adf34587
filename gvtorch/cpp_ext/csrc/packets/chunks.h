// The functions that packet.cpp defines for each instruction set it is compiled for; each handles items begin to end.
#pragma once

#include <cstdint>

namespace gvtorch {

struct ShadeArgs;
struct VoxelizeArgs;
struct NoiseArgs;
struct OrbitArgs;
struct SplatArgs;

struct Chunks {
  void (*shade)(const ShadeArgs& args, int64_t begin, int64_t end);        // rays
  void (*voxelize)(const VoxelizeArgs& args, int64_t begin, int64_t end);  // rows of voxels
  void (*noise)(const NoiseArgs& args, int64_t begin, int64_t end);        // points, in float32
  void (*orbits)(const OrbitArgs& args, int64_t begin, int64_t end);       // points
  void (*splat)(const SplatArgs& args, int64_t begin, int64_t end);        // parts of cubes
};

}  // namespace gvtorch
