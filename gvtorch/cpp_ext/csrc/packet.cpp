// Tracing on the CPU in float32, compiled once for each instruction set (build.py), GV_NAMESPACE its name. Nothing of
// torch or of the standard library's templates may stand here: see hd.h.
#include "packet.h"

#include "packet_shaders.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

void trace_chunk(const TraceArgs& args, int64_t begin, int64_t end) {
  with_voxel(args.voxel, [&](auto voxel) {
    using Voxel = decltype(voxel);
    const TraceRay<float, Voxel> kernel(args);
    const PacketPool pool(args.bricks_bzyxc, args.voxel, args.side, args.channels, args.component);
    if (!packs(args)) {
      KeptPath path;
      for (int64_t index = begin; index < end; ++index) kernel.trace(index, path);
    } else if (pool.far(args.bricks)) {
      trace_packets<TracePacket<Voxel, true>>(begin, end, kernel, pool, args);
    } else {
      trace_packets<TracePacket<Voxel, false>>(begin, end, kernel, pool, args);
    }
  });
}

// Whether packets take a shader's rays.
bool shades(const ShadeArgs& args) {
  if (!packs(args)) return false;
  switch (args.shader) {
    case ShaderKind::kStoredColor:
      return args.channels == 4;
    case ShaderKind::kPreIntegrated:
      return int64_t{args.levels} * args.rows * args.rows * PacketTable::kBytes <= INT32_MAX;
    case ShaderKind::kLit:
    case ShaderKind::kIsosurface:
    case ShaderKind::kProjection:
    case ShaderKind::kFeatures:
      return true;
    default:
      return false;
  }
}

void shade_chunk(const ShadeArgs& args, int64_t begin, int64_t end) {
  switch (args.shader) {
    case ShaderKind::kLit:
      return shade_packets<LitPacket>(args, begin, end);
    case ShaderKind::kPreIntegrated:
      return shade_packets<PreIntegratedPacket>(args, begin, end);
    case ShaderKind::kStoredColor:
      return shade_packets<StoredColorPacket>(args, begin, end);
    case ShaderKind::kIsosurface:
      return shade_packets<IsosurfacePacket>(args, begin, end);
    case ShaderKind::kProjection:
      return shade_packets<ProjectionPacket>(args, begin, end);
    case ShaderKind::kFeatures:
      return shade_packets<FeaturesPacket>(args, begin, end);
    default:
      return;
  }
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
