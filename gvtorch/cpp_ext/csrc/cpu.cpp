// The CPU library: defines the ops (schemas in entry.h) and runs every functor on torch's threads.

#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <atomic>
#include <cstdint>

namespace gvtorch {

struct Cpu {};

// Threads draw chunks of neighbouring rays from a counter: long rays do not leave a thread idle. Nothing that a
// functor writes depends on which thread ran it.
template <class Device, class Functor>
void for_each(const torch::stable::Tensor&, int64_t count, const Functor& functor) {
  constexpr int64_t kChunk = 256;
  const int64_t chunks = (count + kChunk - 1) / kChunk;
  const int64_t workers = std::min<int64_t>(torch::stable::get_num_threads(), chunks);
  std::atomic<int64_t> next{0};
  torch::stable::parallel_for(0, workers, 1, [&](int64_t, int64_t) {
    for (int64_t chunk = next++; chunk < chunks; chunk = next++) {
      const int64_t end = std::min(count, (chunk + 1) * kChunk);
      for (int64_t index = chunk * kChunk; index < end; ++index) functor(index);
    }
  });
}

// Calls put(index, rank) for every index that `keep` accepts, in order; writes their number.
template <class Device, class Keep, class Put>
void compact(const torch::stable::Tensor&, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  int64_t rank = 0;
  for (int64_t index = 0; index < count; ++index) {
    if (keep(index)) put(index, rank++);
  }
  *kept = rank;
}

}  // namespace gvtorch

#include "entry.h"

STABLE_TORCH_LIBRARY(gvtorch, library) {
  library.def(gvtorch::kTraceRaysSchema);
  library.def(gvtorch::kCompactRequestsSchema);
  library.def(gvtorch::kLruPartitionSchema);
  library.def(gvtorch::kUnlinkSchema);
  library.def(gvtorch::kLinkSchema);
}

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) {
  library.impl("trace_rays", TORCH_BOX(&gvtorch::trace_rays<gvtorch::Cpu>));
  library.impl("compact_requests", TORCH_BOX(&gvtorch::compact_requests<gvtorch::Cpu>));
  library.impl("lru_partition", TORCH_BOX(&gvtorch::lru_partition<gvtorch::Cpu>));
  library.impl("unlink", TORCH_BOX(&gvtorch::unlink<gvtorch::Cpu>));
  library.impl("link", TORCH_BOX(&gvtorch::link<gvtorch::Cpu>));
}
