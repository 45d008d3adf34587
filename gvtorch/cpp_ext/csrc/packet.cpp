// Tracing on the CPU in float32, compiled once for each instruction set (build.py), GV_NAMESPACE its name. Nothing of
// torch or of the standard library's templates may stand here: see hd.h.
#include "packet.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class Voxel, bool kFar>
void trace_packets(const TraceRay<float, Voxel>& kernel, int64_t begin, int64_t end) {
  Packet<Voxel, kFar> packet(kernel);
  for (int64_t index = begin; index < end; index += kLanes) packet.trace(index, smaller(index + kLanes, end));
}

void trace_chunk(const TraceArgs& args, int64_t begin, int64_t end) {
  with_voxel(args.voxel, [&](auto voxel) {
    using Voxel = decltype(voxel);
    const TraceRay<float, Voxel> kernel(args);
    if (!Packet<Voxel, false>::takes(kernel)) {
      KeptPath path;
      for (int64_t index = begin; index < end; ++index) kernel.trace(index, path);
    } else if (Packet<Voxel, false>::stride_of(kernel.bricks) * kernel.bricks.bricks > INT32_MAX) {
      trace_packets<Voxel, true>(kernel, begin, end);
    } else {
      trace_packets<Voxel, false>(kernel, begin, end);
    }
  });
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
