// The ops of rays on the CPU: in packets, or one by one in float64.

#include "entry/entry.h"
#include "packets/processor.h"
#include "packets/trace_chunks.h"
#include "shaders/shade_each.h"

namespace gvtorch {

void FusedShaders::run(const Tensor& like, ShadeArgs args, bool in_float64) {
  if (in_float64) return shade_fused<double>(like, args);
  trace_chunks(like, args, processor().chunks.shade);
}

}  // namespace gvtorch

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) { gvtorch::implement(library, gvtorch::RayOps{}); }
