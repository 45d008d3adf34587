// The CUDA library: the same functors, one thread an index. It needs the CPU library, which defines the ops.

#include <cstdint>
#include <cub/block/block_reduce.cuh>
#include <cub/block/block_scan.cuh>

#include "base/for_each.h"
#include "cache/cache.h"
#include "shaders/shade_each.h"
#include "walk/trace.h"

namespace gvtorch {

template <class Device, class T>
void trace_as(const torch::stable::Tensor& like, TraceArgs args) {
  ShadeRay<T, Plain<T>> hider{PlainArgs(args)};
  const torch::stable::Tensor hidden_tn = hide_nodes<Device>(like, args.nodes, hider);
  args.hidden_tn = hider.hidden_tn;
  with_voxel(args.voxel, [&](auto voxel) {
    const TraceRay<T, decltype(voxel)> kernel(args);
    for_each<Device>(like, kernel.order.count(), kernel);
  });
}

template <class Device>
void trace(const torch::stable::Tensor& like, TraceArgs args, bool wide) {
  wide ? trace_as<Device, double>(like, args) : trace_as<Device, float>(like, args);
}

template <class Device>
void shade(const torch::stable::Tensor& like, ShadeArgs args, bool wide) {
  const auto run = [&](const auto& kernel) { shade_each<Device>(like, args.nodes, kernel); };
  if (wide) {
    with_rays<double>(args, run);
  } else {
    with_rays<float>(args, run);
  }
}

// The primitives of cache.h in three kernels: blocks count chunks, one block adds the counts up, and blocks place
// their chunks. What a chunk has nothing of is not read again.
constexpr int kThreads = 256;
constexpr int kScanThreads = 1024;
constexpr int64_t kChunk = 8 * kThreads;

// Found in each chunk, in the chunks before it, seen, touched; the totals of found and seen stand behind the last.
struct ChunkCounts {
  int32_t *found, *first, *seen, *touched;
  int64_t* total_2;
};

__device__ __forceinline__ int32_t warp_sum(int32_t value) {
  for (int offset = 16; offset > 0; offset /= 2) value += __shfl_xor_sync(0xffffffff, value, offset);
  return value;
}

template <class Flags>
__global__ void __launch_bounds__(kThreads) count_chunks(Flags flags, int64_t count, ChunkCounts counts) {
  __shared__ int32_t sum[3];
  if (threadIdx.x < 3) sum[threadIdx.x] = 0;
  __syncthreads();
  const int64_t first = blockIdx.x * kChunk + threadIdx.x;
  int32_t found = 0, seen = 0, any = 0;
#pragma unroll
  for (int64_t offset = 0; offset < kChunk; offset += kThreads) {
    const int32_t here = first + offset < count ? flags(first + offset) : 0;
    found += here & kListed;
    seen += (here & kSeen) / kSeen;
    any |= here;
  }
  found = warp_sum(found);
  seen = warp_sum(seen);
  any = __any_sync(0xffffffff, any & kTouched) ? kTouched : 0;
  if (threadIdx.x % 32 == 0) {
    if (found > 0) atomicAdd(&sum[0], found);
    if (seen > 0) atomicAdd(&sum[1], seen);
    if (any != 0) atomicOr(&sum[2], any);
  }
  __syncthreads();
  if (threadIdx.x != 0) return;
  counts.found[blockIdx.x] = sum[0];
  counts.seen[blockIdx.x] = sum[1];
  counts.touched[blockIdx.x] = sum[2];
}

__global__ void __launch_bounds__(kScanThreads) add_chunks(ChunkCounts counts, int64_t chunks) {
  using Scan = cub::BlockScan<int32_t, kScanThreads>;
  using Reduce = cub::BlockReduce<int64_t, kScanThreads>;
  __shared__ typename Scan::TempStorage scratch;
  __shared__ typename Reduce::TempStorage reduce_scratch;
  int64_t before = 0;
  int64_t seen = 0;
  for (int64_t start = 0; start < chunks; start += kScanThreads) {
    const int64_t chunk = start + threadIdx.x;
    const int32_t found = chunk < chunks ? counts.found[chunk] : 0;
    if (chunk < chunks) seen += counts.seen[chunk];
    int32_t rank = 0, here = 0;
    Scan(scratch).ExclusiveSum(found, rank, here);
    if (chunk < chunks) counts.first[chunk] = static_cast<int32_t>(before + rank);
    before += here;
    __syncthreads();
  }
  seen = Reduce(reduce_scratch).Sum(seen);
  if (threadIdx.x != 0) return;
  counts.total_2[0] = before;
  counts.total_2[1] = seen;
}

// body(index, flags, rank) for the indices of the block's chunk; rank: listed ones before it.
template <class Flags, class Body>
__device__ void visit_chunk(const Flags& flags, int64_t count, int64_t rank, const Body& body) {
  __shared__ int32_t before[kThreads / 32];  // listed in each warp
  const int warp = threadIdx.x / 32;
  const int lane = threadIdx.x % 32;
  for (int64_t offset = 0; offset < kChunk; offset += kThreads) {
    const int64_t index = blockIdx.x * kChunk + offset + threadIdx.x;
    const int32_t here = index < count ? flags(index) : 0;
    const unsigned votes = __ballot_sync(0xffffffff, (here & kListed) != 0);
    if (lane == 0) before[warp] = __popc(votes);
    __syncthreads();
    int64_t own = rank + __popc(votes & ((1u << lane) - 1));
    for (int other = 0; other < kThreads / 32; ++other) {
      if (other < warp) own += before[other];
      rank += before[other];
    }
    if (index < count) body(index, here, own);
    __syncthreads();
  }
}

template <class List>
struct ListFlags {
  List list;
  __device__ int32_t operator()(int64_t index) const { return list.flags(index); }
};

template <class Keep>
struct KeepFlags {
  Keep keep;
  __device__ int32_t operator()(int64_t index) const { return keep(index) ? kListed | kTouched : kTouched; }
};

template <class List>
__global__ void __launch_bounds__(kThreads) place_listed(List list, int64_t count, ChunkCounts counts) {
  const int64_t threads = static_cast<int64_t>(gridDim.x) * kThreads;
  const int64_t thread = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  for (int64_t rank = counts.total_2[0] + thread; rank < list.places(); rank += threads) list.blank(rank);
  if (thread == 0) list.total(counts.total_2[0], counts.total_2[1]);
  if (counts.touched[blockIdx.x] == 0) return;
  visit_chunk(ListFlags<List>{list}, count, counts.first[blockIdx.x], [&](int64_t index, int32_t flags, int64_t rank) {
    if ((flags & kListed) != 0) list.put(index, rank);
    if ((flags & kTouched) != 0) list.touch(index);
  });
}

template <class Keep, class Put>
__global__ void __launch_bounds__(kThreads)
    place_split(Keep keep, Put put, int64_t count, ChunkCounts counts, int64_t* kept) {
  const int64_t total = counts.total_2[0];
  if (blockIdx.x == 0 && threadIdx.x == 0) *kept = total;
  visit_chunk(KeepFlags<Keep>{keep}, count, counts.first[blockIdx.x], [&](int64_t index, int32_t flags, int64_t rank) {
    put(index, (flags & kListed) != 0 ? rank : total + index - rank);
  });
}

// The memory and the stream of the three kernels.
struct Pass {
  torch::stable::accelerator::DeviceGuard guard;
  int64_t chunks;
  torch::stable::Tensor words;
  ChunkCounts counts;
  cudaStream_t stream;

  Pass(const torch::stable::Tensor& like, int64_t count)
      : guard(like.get_device_index()),
        chunks((count + kChunk - 1) / kChunk > 0 ? (count + kChunk - 1) / kChunk : 1),
        words(torch::stable::new_empty(like, {2 + 2 * chunks}, torch::headeronly::ScalarType::Long)) {
    void* current = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(like.get_device_index(), &current));
    stream = static_cast<cudaStream_t>(current);
    counts.total_2 = static_cast<int64_t*>(words.mutable_data_ptr());
    counts.found = reinterpret_cast<int32_t*>(counts.total_2 + 2);
    counts.first = counts.found + chunks;
    counts.seen = counts.first + chunks;
    counts.touched = counts.seen + chunks;
  }
  unsigned blocks() const { return static_cast<unsigned>(chunks); }
  template <class Flags>
  void count(const Flags& flags, int64_t size) const {
    count_chunks<<<blocks(), kThreads, 0, stream>>>(flags, size, counts);
    add_chunks<<<1, kScanThreads, 0, stream>>>(counts, chunks);
  }
  static void check() {
    const cudaError_t status = cudaGetLastError();
    STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: kernel launch failed: ", cudaGetErrorString(status));
  }
};

template <class Device, class List>
void compact(const torch::stable::Tensor& like, int64_t count, const List& list) {
  const Pass pass(like, count);
  pass.count(ListFlags<List>{list}, count);
  place_listed<<<pass.blocks(), kThreads, 0, pass.stream>>>(list, count, pass.counts);
  Pass::check();
}

template <class Device, class Keep, class Put>
void split(const torch::stable::Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  const Pass pass(like, count);
  pass.count(KeepFlags<Keep>{keep}, count);
  place_split<<<pass.blocks(), kThreads, 0, pass.stream>>>(keep, put, count, pass.counts, kept);
  Pass::check();
}

}  // namespace gvtorch

#include "entry/entry_cache.h"
#include "entry/entry_segments.h"

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CUDA, library) {
  gvtorch::implement<gvtorch::Cuda>(library, gvtorch::RayOps{});
  gvtorch::implement<gvtorch::Cuda>(library, gvtorch::SegmentOps{});
  gvtorch::implement<gvtorch::Cuda>(library, gvtorch::CacheOps{});
}
