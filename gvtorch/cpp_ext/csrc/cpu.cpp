// The CPU library: defines the ops (entry.h) and runs every functor on torch's threads.

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "base/for_each.h"
#include "cache/cache.h"
#include "packets/trace_chunks.h"
#include "shaders/shade_each.h"

namespace gvtorch {

// packet.cpp, compiled once for each instruction set.
namespace baseline {
void trace_chunk(const TraceArgs& args, int64_t begin, int64_t end);
void shade_chunk(const ShadeArgs& args, int64_t begin, int64_t end);
}  // namespace baseline
#ifdef GV_X86
namespace avx2 {
void trace_chunk(const TraceArgs& args, int64_t begin, int64_t end);
void shade_chunk(const ShadeArgs& args, int64_t begin, int64_t end);
}  // namespace avx2
namespace avx512 {
void trace_chunk(const TraceArgs& args, int64_t begin, int64_t end);
void shade_chunk(const ShadeArgs& args, int64_t begin, int64_t end);
}  // namespace avx512
#endif

// The widest instructions that this processor has; GVTORCH_CPU=baseline, avx2 or avx512 asks for fewer.
struct Processor {
  const char* name = "baseline";
  decltype(&baseline::trace_chunk) trace_chunk = &baseline::trace_chunk;
  decltype(&baseline::shade_chunk) shade_chunk = &baseline::shade_chunk;
  Processor() {
#ifdef GV_X86
    const char* asked = std::getenv("GVTORCH_CPU");
    const auto allows = [&](const char* set) { return asked == nullptr || std::strcmp(asked, set) == 0; };
    __builtin_cpu_init();
    const bool wide = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("f16c");
    if (allows("avx512") && wide && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
      name = "avx512";
      trace_chunk = &avx512::trace_chunk;
      shade_chunk = &avx512::shade_chunk;
    } else if ((allows("avx512") || allows("avx2")) && wide) {
      name = "avx2";
      trace_chunk = &avx2::trace_chunk;
      shade_chunk = &avx2::shade_chunk;
    }
#endif
  }
};

inline const Processor& processor() {
  static const Processor found;
  return found;
}

// A user's shader is compiled for the same (cpp_ext/user.py).
extern "C" __attribute__((visibility("default"))) const char* gvtorch_instructions() { return processor().name; }

// The primitives of cache.h. Threads count chunks, then place them: ranks do not depend on the number of threads.
struct Chunks {
  static constexpr int64_t kSize = 1 << 11;
  std::vector<int64_t> first;  // kept before each chunk, and in all

  // found(begin, end): how many are kept.
  template <class Found>
  Chunks(const torch::stable::Tensor& like, int64_t count, const Found& found)
      : first(static_cast<size_t>((count + kSize - 1) / kSize) + 1, 0) {
    for_each<Cpu>(
        like, static_cast<int64_t>(first.size()) - 1,
        [&](int64_t chunk) { first[chunk + 1] = found(chunk * kSize, std::min(count, (chunk + 1) * kSize)); }, 1);
    for (size_t chunk = 1; chunk < first.size(); ++chunk) first[chunk] += first[chunk - 1];
  }
  // body(begin, end, chunk) for each chunk.
  template <class Body>
  void place(const torch::stable::Tensor& like, int64_t count, const Body& body) const {
    for_each<Cpu>(
        like, static_cast<int64_t>(first.size()) - 1,
        [&](int64_t chunk) { body(chunk * kSize, std::min(count, (chunk + 1) * kSize), chunk); }, 1);
  }
};

template <class Device, class List>
void compact(const torch::stable::Tensor& like, int64_t count, const List& list) {
  std::atomic<int64_t> seen{0};
  std::vector<uint8_t> touched(static_cast<size_t>((count + Chunks::kSize - 1) / Chunks::kSize), 0);
  const Chunks chunks(like, count, [&](int64_t begin, int64_t end) {
    int32_t listed = 0, counted = 0, any = 0;
    for (int64_t index = begin; index < end; ++index) {
      const int32_t flags = list.flags(index);
      listed += flags & kListed;
      counted += (flags & kSeen) / kSeen;
      any |= flags;
    }
    touched[begin / Chunks::kSize] = (any & kTouched) != 0;
    seen += counted;
    return listed;
  });
  chunks.place(like, count, [&](int64_t begin, int64_t end, int64_t chunk) {
    int64_t rank = chunks.first[chunk];
    if (!touched[chunk]) return;
    for (int64_t index = begin; index < end; ++index) {
      const int32_t flags = list.flags(index);
      if ((flags & kListed) != 0) list.put(index, rank++);
      if ((flags & kTouched) != 0) list.touch(index);
    }
  });
  const int64_t total = chunks.first.back();
  for (int64_t rank = total; rank < list.places(); ++rank) list.blank(rank);
  list.total(total, seen);
}

template <class Device, class Keep, class Put>
void split(const torch::stable::Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  const Chunks chunks(like, count, [&](int64_t begin, int64_t end) {
    int32_t found = 0;
    for (int64_t index = begin; index < end; ++index) found += keep(index) ? 1 : 0;
    return found;
  });
  const int64_t total = chunks.first.back();
  chunks.place(like, count, [&](int64_t begin, int64_t end, int64_t chunk) {
    int64_t rank = chunks.first[chunk];
    int64_t behind = total + begin - rank;
    for (int64_t index = begin; index < end; ++index) {
      const int64_t mask = -static_cast<int64_t>(keep(index));  // no branch: half of them would be guessed wrong
      put(index, behind + ((rank - behind) & mask));
      rank -= mask;
      behind += 1 + mask;
    }
  });
  *kept = total;
}

template <class Device>
void trace(const torch::stable::Tensor& like, TraceArgs args, bool wide) {
  const PlainArgs plain(args);
  if (wide) {
    shade_each<Device>(like, args.nodes, ShadeRay<double, Plain<double>>(plain));
  } else if (packs(args)) {
    trace_chunks<Device>(like, args, [&](int64_t begin, int64_t end) { processor().trace_chunk(args, begin, end); });
  } else {
    shade_each<Device>(like, args.nodes, ShadeRay<float, Plain<float>>(plain));
  }
}

template <class Device>
void shade(const torch::stable::Tensor& like, ShadeArgs args, bool wide) {
  const auto run = [&](const auto& kernel) { shade_each<Device>(like, args.nodes, kernel); };
  if (wide) {
    with_rays<double>(args, run);
  } else if (shades(args)) {
    trace_chunks<Device>(like, args, [&](int64_t begin, int64_t end) { processor().shade_chunk(args, begin, end); });
  } else {
    with_rays<float>(args, run);
  }
}

}  // namespace gvtorch

#include "entry/entry_cache.h"
#include "entry/entry_segments.h"

STABLE_TORCH_LIBRARY(gvtorch, library) {
  gvtorch::define(library, gvtorch::RayOps{});
  gvtorch::define(library, gvtorch::SegmentOps{});
  gvtorch::define(library, gvtorch::CacheOps{});
}

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) {
  gvtorch::implement<gvtorch::Cpu>(library, gvtorch::RayOps{});
  gvtorch::implement<gvtorch::Cpu>(library, gvtorch::SegmentOps{});
  gvtorch::implement<gvtorch::Cpu>(library, gvtorch::CacheOps{});
}
