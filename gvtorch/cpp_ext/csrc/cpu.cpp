// The CPU library: defines the ops (entry.h) and runs every functor on torch's threads.

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <string_view>
#include <vector>

#include "entry/entry_cache.h"
#include "entry/entry_mesh.h"
#include "entry/entry_noise.h"
#include "entry/entry_segments.h"
#include "packets/chunks.h"
#include "packets/trace_chunks.h"

namespace gvtorch {

// packet.cpp, compiled once for each instruction set.
namespace baseline {
extern const Chunks chunks;
}  // namespace baseline
#ifdef GV_X86
namespace avx2 {
extern const Chunks chunks;
}  // namespace avx2
namespace avx512 {
extern const Chunks chunks;
}  // namespace avx512
#endif

struct Processor {
  const char* name;
  const Chunks& chunks;
};

// The widest instructions that this processor has; GVTORCH_CPU=baseline, avx2 or avx512 asks for fewer.
inline Processor find_processor() {
#ifdef GV_X86
  const char* named = std::getenv("GVTORCH_CPU");
  const std::string_view asked = named == nullptr ? "avx512" : named;
  __builtin_cpu_init();
  const bool wide = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("f16c");
  if (asked == "avx512" && wide && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
    return {"avx512", avx512::chunks};
  }
  if ((asked == "avx512" || asked == "avx2") && wide) return {"avx2", avx2::chunks};
#endif
  return {"baseline", baseline::chunks};
}

inline const Processor& processor() {
  static const Processor found = find_processor();
  return found;
}

// A user's shader is compiled for the same (cpp_ext/user.py).
extern "C" __attribute__((visibility("default"))) const char* gvtorch_instructions() { return processor().name; }

void FusedShaders::run(const Tensor& like, ShadeArgs args, bool wide) {
  if (wide) return shade_fused<double>(like, args);
  if (!(args.shader == kPlainShader ? packs(args) : shades(args))) return shade_fused<float>(like, args);
  trace_chunks<Device>(like, args, [&](int64_t begin, int64_t end) { processor().chunks.shade(args, begin, end); });
}

void voxelize(const Tensor& like, const VoxelizeArgs& args) {
  constexpr int64_t kRows = 16;  // at a time
  const int64_t rows = args.cubes * args.side * args.side;
  const auto chunk = [&](int64_t number) {
    processor().chunks.voxelize(args, number * kRows, std::min(rows, (number + 1) * kRows));
  };
  for_each(like, (rows + kRows - 1) / kRows, chunk, 1);
}

void make_noise(const Tensor& like, const NoiseArgs& args, int64_t points) {
  if (is_wide(like)) return noise_each<double>(like, args, points);
  constexpr int64_t kChunk = 1 << 11;
  const auto chunk = [&](int64_t number) {
    processor().chunks.noise(args, number * kChunk, std::min(points, (number + 1) * kChunk));
  };
  for_each(like, (points + kChunk - 1) / kChunk, chunk, 1);
}

// See cache.h. Threads count chunks, then take them: ranks do not depend on the number of threads.
template <class List>
void compact(const Tensor& like, int64_t count, const List& list) {
  constexpr int64_t kChunk = 1 << 11;
  const int64_t chunks = (count + kChunk - 1) / kChunk;
  std::vector<Counts> before(static_cast<size_t>(chunks) + 1);  // each chunk; all stand behind the last
  const auto count_chunk = [&](int64_t chunk) {
    const int64_t end = std::min(count, (chunk + 1) * kChunk);
    Counts own{};
    for (int64_t index = chunk * kChunk; index < end; ++index) own.add(list.flags(index));
    before[chunk + 1] = own;
  };
  for_each(like, chunks, count_chunk, 1);
  for (int64_t chunk = 0; chunk < chunks; ++chunk) before[chunk + 1] = before[chunk] + before[chunk + 1];
  const Counts all = before.back();
  const auto take_chunk = [&](int64_t chunk) {
    if (before[chunk].any == before[chunk + 1].any) return;
    const int64_t end = std::min(count, (chunk + 1) * kChunk);
    const List own = list;  // which nothing written can alias
    int64_t rank = before[chunk].listed;
    for (int64_t index = chunk * kChunk; index < end; ++index) {
      const int32_t flags = own.flags(index);
      if ((flags & kTouched) == 0) continue;
      own.take(index, flags, rank, all.listed);
      rank += flags & kListed;
    }
  };
  for_each(like, chunks, take_chunk, 1);
  for (int64_t rank = all.listed; rank < list.places(); ++rank) list.blank(rank);
  list.total(all.listed, all.seen);
}

}  // namespace gvtorch

STABLE_TORCH_LIBRARY(gvtorch, library) {
  gvtorch::define(library, gvtorch::RayOps{});
  gvtorch::define(library, gvtorch::SegmentOps{});
  gvtorch::define(library, gvtorch::CacheOps{});
  gvtorch::define(library, gvtorch::MeshOps{});
  gvtorch::define(library, gvtorch::NoiseOps{});
}

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) {
  gvtorch::implement(library, gvtorch::RayOps{});
  gvtorch::implement(library, gvtorch::SegmentOps{});
  gvtorch::implement(library, gvtorch::CacheOps{});
  gvtorch::implement(library, gvtorch::MeshOps{});
  gvtorch::implement(library, gvtorch::NoiseOps{});
}
