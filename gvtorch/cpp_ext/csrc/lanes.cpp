// Tracing on the CPU in float32, compiled once for each instruction set (build.py), GV_NAMESPACE its name. Nothing of
// torch or of the standard library's templates may stand here: see hd.h.
#include "lanes.h"

#include "trace.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

void trace_chunk(const TraceArgs& args, int64_t begin, int64_t end) {
  with_voxel(args.voxel, [&](auto voxel) {
    const TraceRay<float, decltype(voxel), Lanes> body(args);
    KeptPath path;
    for (int64_t index = begin; index < end; ++index) body.trace(index, path);
  });
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
