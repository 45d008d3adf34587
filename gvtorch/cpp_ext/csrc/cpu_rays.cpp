// The ops of rays on the CPU: in packets; one by one in float64, and where each sample traces a cone to the light.

#include "entry/entry.h"
#include "packets/processor.h"
#include "packets/trace_chunks.h"
#include "shaders/shade_each.h"

namespace gvtorch {

void FusedShaders::run(const Tensor& like, ShadeArgs args, bool in_float64) {
  if (in_float64) return shade_fused<double>(like, args);
  with_shader<float>(args.shader, [&](auto type) {
    using Type = decltype(type);
    if constexpr (Type::kShadows) return shade_as<float>(like, args, type);
    trace_chunks(like, args, processor().chunks.shade);
  });
}

}  // namespace gvtorch

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) { gvtorch::implement(library, gvtorch::RayOps{}); }
