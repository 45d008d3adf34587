// The CPU library: defines the ops (entry.h) and runs every functor on torch's threads. The ops of rays are implemented
// in cpu_rays.cpp, those of segments in cpu_segments.cpp, so that they compile side by side.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "entry/entry_cache.h"
#include "entry/entry_camera.h"
#include "entry/entry_fields.h"
#include "entry/entry_mesh.h"
#include "entry/entry_noise.h"
#include "entry/entry_points.h"
#include "packets/processor.h"

namespace gvtorch {

// A user's shader is compiled for the same (cpp_ext/user.py).
extern "C" __attribute__((visibility("default"))) const char* gvtorch_instructions() { return processor().name; }

void voxelize(const Tensor& like, const VoxelizeArgs& args) {
  constexpr int64_t kRows = 16;  // at a time
  const int64_t rows = args.cubes * args.side * args.side;
  const auto chunk = [&](int64_t number) {
    processor().chunks.voxelize(args, number * kRows, std::min(rows, (number + 1) * kRows));
  };
  for_each(like, (rows + kRows - 1) / kRows, chunk, 1);
}

// Points of float32, a chunk at a time.
template <class Args>
void in_chunks(const Tensor& like, void (*run)(const Args&, int64_t, int64_t), const Args& args, int64_t points,
               int64_t chunk) {
  const auto some = [&](int64_t number) { run(args, number * chunk, std::min(points, (number + 1) * chunk)); };
  for_each(like, (points + chunk - 1) / chunk, some, 1);
}

void make_noise(const Tensor& like, const NoiseArgs& args, int64_t points) {
  if (is_wide(like)) return noise_each<double>(like, args, points);
  in_chunks(like, processor().chunks.noise, args, points, 1 << 11);
}

void follow_points(const Tensor& like, const OrbitArgs& args) {
  in_chunks(like, processor().chunks.orbits, args, args.points, 1 << 9);
}

void splat_points(const Tensor& like, const SplatArgs& args) {
  const auto part = [&](int64_t number) { processor().chunks.splat(args, number, number + 1); };
  for_each(like, SplatPart{args}.parts(), part, 1);
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

void sort_keys(const Tensor&, int64_t* keys, int64_t count) { std::sort(keys, keys + count); }

}  // namespace gvtorch

STABLE_TORCH_LIBRARY(gvtorch, library) {
  gvtorch::define(library, gvtorch::RayOps{});
  gvtorch::define(library, gvtorch::SegmentOps{});
  gvtorch::define(library, gvtorch::CacheOps{});
  gvtorch::define(library, gvtorch::MeshOps{});
  gvtorch::define(library, gvtorch::CameraOps{});
  gvtorch::define(library, gvtorch::NoiseOps{});
  gvtorch::define(library, gvtorch::PointOps{});
  gvtorch::define(library, gvtorch::FieldOps{});
}

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) {
  gvtorch::implement(library, gvtorch::CacheOps{});
  gvtorch::implement(library, gvtorch::MeshOps{});
  gvtorch::implement(library, gvtorch::CameraOps{});
  gvtorch::implement(library, gvtorch::NoiseOps{});
  gvtorch::implement(library, gvtorch::PointOps{});
  gvtorch::implement(library, gvtorch::FieldOps{});
}
