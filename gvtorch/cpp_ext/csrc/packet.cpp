// Tracing and noise on the CPU in float32, compiled once for each instruction set (build.py), GV_NAMESPACE its name.
// Nothing of torch or of the standard library's templates may stand here: see hd.h.
#include "noise/noise.h"
#include "packets/packet_walk.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

void shade_chunk(const ShadeArgs& args, int64_t begin, int64_t end) {
  if (args.shader != kPlainShader) {
    return with_shader<float>(args.shader, [&](auto type) {
      using Type = decltype(type);
      if constexpr (!Type::kShadows) trace_packets<typename Type::Shader, AnyValues>(args, begin, end);
    });
  }
  const bool far = brick_bytes(args.voxel, args.side, args.channels) * args.bricks > INT32_MAX;
  with_voxel(args.voxel, [&](auto voxel) {
    using Voxel = decltype(voxel);
    if (far) return trace_packets<Plain<float>, TypedValues<Voxel, true>>(args, begin, end);
    return trace_packets<Plain<float>, TypedValues<Voxel, false>>(args, begin, end);
  });
}

void noise_chunk(const NoiseArgs& args, int64_t begin, int64_t end) {
  with_noise(args, [&](auto kind, auto axes) { noise_in_lanes<kind.value, axes.value>(args, begin, end); });
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
