// The CPU library: defines the ops (schemas in entry.h) and runs every functor on torch's threads.

#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <vector>

namespace gvtorch {

struct Cpu {};

// Threads draw `share` neighbouring indices at a time from a counter: long rays do not leave a thread idle. Nothing
// that a functor writes depends on which thread ran it.
template <class Device, class Functor>
void for_each(const torch::stable::Tensor&, int64_t count, const Functor& functor, int64_t share = 256) {
  const int64_t chunks = (count + share - 1) / share;
  const int64_t workers = std::min<int64_t>(torch::stable::get_num_threads(), chunks);
  std::atomic<int64_t> next{0};
  torch::stable::parallel_for(0, workers, 1, [&](int64_t, int64_t) {
    for (int64_t chunk = next++; chunk < chunks; chunk = next++) {
      const int64_t end = std::min(count, (chunk + 1) * share);
      for (int64_t index = chunk * share; index < end; ++index) functor(index);
    }
  });
}

// Calls put(index, rank) for every index that `keep` accepts, ranks in order; writes their number. Threads count
// chunks, then place them: ranks do not depend on the number of threads.
template <class Device, class Keep, class Put>
void compact(const torch::stable::Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  constexpr int64_t kChunk = 1 << 14;
  const int64_t chunks = (count + kChunk - 1) / kChunk;
  std::vector<int64_t> first(static_cast<size_t>(chunks) + 1, 0);
  for_each<Device>(
      like, chunks,
      [&](int64_t chunk) {
        const int64_t end = std::min(count, (chunk + 1) * kChunk);
        int32_t found = 0;
        for (int64_t index = chunk * kChunk; index < end; ++index) found += keep(index) ? 1 : 0;
        first[chunk + 1] = found;
      },
      1);
  for (int64_t chunk = 0; chunk < chunks; ++chunk) first[chunk + 1] += first[chunk];
  for_each<Device>(
      like, chunks,
      [&](int64_t chunk) {
        if (first[chunk] == first[chunk + 1]) return;
        const int64_t end = std::min(count, (chunk + 1) * kChunk);
        int64_t rank = first[chunk];
        for (int64_t index = chunk * kChunk; index < end; ++index) {
          if constexpr (Put::kDense) {  // written anyway, and over again until the kept one comes
            if (rank == first[chunk + 1]) return;
            put(index, rank);
            rank += keep(index) ? 1 : 0;
          } else if (keep(index)) {
            put(index, rank++);
          }
        }
      },
      1);
  *kept = first[chunks];
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
