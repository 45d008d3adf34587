// The CPU library: defines the ops (entry.h) and runs every functor on torch's threads. The ops of rays are implemented
// in cpu_rays.cpp, those of segments in cpu_segments.cpp, so that they compile in parallel.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "entry/entry_all.h"
#include "packets/processor.h"

namespace gvtorch {

// The instruction set in use; users' shaders are compiled for the same one (cpp_ext/user.py).
extern "C" __attribute__((visibility("default"))) const char* gvtorch_instructions() { return processor().name; }

// See cache.h. Threads count chunks, then process them: ranks do not depend on the number of threads.
template <class List>
void compact(const Tensor&, int64_t count, const List& list) {
  constexpr int64_t kChunk = 1 << 11;
  const int64_t chunks = (count + kChunk - 1) / kChunk;
  std::vector<Counts> counts_before(static_cast<size_t>(chunks) + 1);  // each chunk; the last entry is the total
  for_chunks(count, kChunk, [&](int64_t begin, int64_t end) {
    Counts counts{};
    for (int64_t index = begin; index < end; ++index) counts.add(list.flags(index));
    counts_before[begin / kChunk + 1] = counts;
  });
  for (int64_t chunk = 0; chunk < chunks; ++chunk)
    counts_before[chunk + 1] = counts_before[chunk] + counts_before[chunk + 1];
  const Counts all = counts_before.back();
  for_chunks(count, kChunk, [&](int64_t begin, int64_t end) {
    const Counts &before_chunk = counts_before[begin / kChunk], &after_chunk = counts_before[begin / kChunk + 1];
    if (before_chunk.any_flags == after_chunk.any_flags) return;
    const List list_copy = list;  // a copy, which nothing written can alias
    int64_t rank = before_chunk.listed;
    for (int64_t index = begin; index < end; ++index) {
      const int32_t flags = list_copy.flags(index);
      if ((flags & kTouched) == 0) continue;
      list_copy.process(index, flags, rank, all.listed);
      rank += flags & kListed;
    }
  });
  for (int64_t rank = all.listed; rank < list.entries(); ++rank) list.clear_entry(rank);
  list.store_totals(all.listed, all.counted);
}

void sort_keys(const Tensor&, int64_t* keys, int64_t count) { std::sort(keys, keys + count); }

}  // namespace gvtorch

STABLE_TORCH_LIBRARY(gvtorch, library) { gvtorch::define(library, gvtorch::AllOps{}); }

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) { gvtorch::implement(library, gvtorch::OtherOps{}); }
