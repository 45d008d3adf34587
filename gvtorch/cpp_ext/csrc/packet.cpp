// Tracing, voxelizing, noise, orbits and points on the CPU, compiled once for each instruction set (build.py), with
// GV_NAMESPACE as its name. Nothing of torch and no template of the standard library may be used here: see hd.h.
#include "fields/orbits.h"
#include "mesh/voxelize.h"
#include "noise/noise.h"
#include "packets/chunks.h"
#include "packets/packet_shadows.h"
#include "points/splat.h"

namespace gvtorch::GV_NAMESPACE {

void shade_chunk(const ShadeArgs& args, int64_t begin, int64_t end) {
  if (args.shader != kPlainShader) {
    return with_shader<float>(args.shader, [&](auto type) {
      using Type = decltype(type);
      trace_packets<typename Type::Shader, AnyValues, Type::kShadows>(args, begin, end);
    });
  }
  const bool far_offsets = brick_bytes(args.voxel, args.side, args.voxel_width) * args.bricks > INT32_MAX;
  with_voxel(args.voxel, [&](auto voxel) {
    using Voxel = decltype(voxel);
    if (far_offsets) return trace_packets<Plain<float>, TypedValues<Voxel, true>>(args, begin, end);
    return trace_packets<Plain<float>, TypedValues<Voxel, false>>(args, begin, end);
  });
}

template <class T>
void voxelize_rows(const VoxelizeArgs& args, int64_t begin, int64_t end) {
  const VoxelizePack<T> pack{args};
  for (int64_t row = begin; row < end; ++row) pack.write_winding(row);
  for (int64_t index = begin * pack.packs(); index < end * pack.packs(); ++index) pack(index);
}

void voxelize_chunk(const VoxelizeArgs& args, int64_t begin, int64_t end) {
  args.wide ? voxelize_rows<double>(args, begin, end) : voxelize_rows<float>(args, begin, end);
}

void noise_chunk(const NoiseArgs& args, int64_t begin, int64_t end) {
  with_noise(args, [&](auto kind, auto axes) { noise_in_lanes<kind.value, axes.value>(args, begin, end); });
}

void orbits_chunk(const OrbitArgs& args, int64_t begin, int64_t end) {
  args.in_float64 ? orbits_in_lanes<Doubles>(args, begin, end) : orbits_in_lanes<Floats>(args, begin, end);
}

void splat_chunk(const SplatArgs& args, int64_t begin, int64_t end) {
  const SplatPart splat_part{args};
  for (int64_t index = begin; index < end; ++index) splat_part(index);
}

extern const Chunks chunks;
const Chunks chunks = {shade_chunk, voxelize_chunk, noise_chunk, orbits_chunk, splat_chunk};

}  // namespace gvtorch::GV_NAMESPACE
