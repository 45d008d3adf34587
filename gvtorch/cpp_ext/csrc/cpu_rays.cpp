// The ops of rays on the CPU: in packets where possible, else ray by ray.

#include "entry/entry.h"
#include "packets/processor.h"
#include "packets/trace_chunks.h"
#include "shaders/shade_each.h"

namespace gvtorch {

void FusedShaders::run(const Tensor& like, ShadeArgs args, bool in_float64) {
  if (in_float64) return shade_fused<double>(like, args);
  if (!(args.shader == kPlainShader ? packets_can_trace(args) : packets_can_shade(args)))
    return shade_fused<float>(like, args);
  trace_chunks(like, args, [&](int64_t begin, int64_t end) { processor().chunks.shade(args, begin, end); });
}

}  // namespace gvtorch

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) { gvtorch::implement(library, gvtorch::RayOps{}); }
