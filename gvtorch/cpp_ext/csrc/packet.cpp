// Tracing on the CPU in float32, compiled once for each instruction set (build.py), GV_NAMESPACE its name. Nothing of
// torch or of the standard library's templates may stand here: see hd.h.
#include "packet.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

void trace_chunk(const TraceArgs& args, int64_t begin, int64_t end) {
  with_voxel(args.voxel, [&](auto voxel) {
    const TraceRay<float, decltype(voxel)> kernel(args);
    if (Packet<decltype(voxel)>::takes(kernel)) {
      Packet<decltype(voxel)> packet(kernel);
      for (int64_t index = begin; index < end; index += kLanes) packet.trace(index, smaller(index + kLanes, end));
    } else {
      KeptPath path;
      for (int64_t index = begin; index < end; ++index) kernel.trace(index, path);
    }
  });
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
