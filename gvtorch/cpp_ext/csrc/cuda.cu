// The CUDA library: the same functors, one thread per index. It needs the CPU library, which defines the ops.

#include <cub/block/block_reduce.cuh>
#include <cub/block/block_scan.cuh>
#include <cub/device/device_radix_sort.cuh>

#include "entry/entry_all.h"

namespace gvtorch {

void FusedShaders::run(const Tensor& like, ShadeArgs args, bool in_float64) {
  in_float64 ? shade_fused<double>(like, args) : shade_fused<float>(like, args);
}

// `compact` of cache.h in three kernels: blocks count chunks, one block adds the counts up, and blocks process their
// chunks. Chunks without flags are not read again.
constexpr int kThreads = 256;
constexpr int kScanThreads = 1024;
constexpr int64_t kChunk = 8 * kThreads;

template <class List>
__global__ void __launch_bounds__(kThreads) count_chunks(List list, int64_t count, Counts* chunk_c) {
  using Reduce = cub::BlockReduce<Counts, kThreads>;
  __shared__ typename Reduce::TempStorage scratch;
  const int64_t first = blockIdx.x * kChunk + threadIdx.x;
  Counts counts{};
#pragma unroll
  for (int64_t offset = 0; offset < kChunk; offset += kThreads) {
    if (first + offset < count) counts.add(list.flags(first + offset));
  }
  counts = Reduce(scratch).Sum(counts);
  if (threadIdx.x == 0) chunk_c[blockIdx.x] = counts;
}

// Replaces each chunk's counts by the sum of those before it; the total is stored after the last.
__global__ void __launch_bounds__(kScanThreads) add_chunks(Counts* chunk_c, int64_t chunks) {
  using Scan = cub::BlockScan<Counts, kScanThreads, cub::BLOCK_SCAN_WARP_SCANS>;
  __shared__ typename Scan::TempStorage scratch;
  Counts running_total{};
  for (int64_t start = 0; start < chunks; start += kScanThreads) {
    const int64_t chunk = start + threadIdx.x;
    Counts counts = chunk < chunks ? chunk_c[chunk] : Counts{}, all{};
    Scan(scratch).ExclusiveSum(counts, counts, all);
    if (chunk < chunks) chunk_c[chunk] = running_total + counts;
    running_total = running_total + all;
    __syncthreads();
  }
  if (threadIdx.x == 0) chunk_c[chunks] = running_total;
}

template <class List>
__global__ void __launch_bounds__(kThreads) process_chunks(List list, int64_t count, const Counts* chunk_c) {
  __shared__ int32_t listed[kThreads / 32];  // how many in each warp
  const int warp = threadIdx.x / 32;
  const int lane = threadIdx.x % 32;
  const Counts before_chunk = chunk_c[blockIdx.x], after_chunk = chunk_c[blockIdx.x + 1], all = chunk_c[gridDim.x];
  const int64_t threads = static_cast<int64_t>(gridDim.x) * kThreads;
  const int64_t thread = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  for (int64_t rank = all.listed + thread; rank < list.entries(); rank += threads) list.clear_entry(rank);
  if (thread == 0) list.store_totals(all.listed, all.counted);
  if (before_chunk.any_flags == after_chunk.any_flags) return;
  int64_t rank = before_chunk.listed;
  for (int64_t offset = 0; offset < kChunk; offset += kThreads) {
    const int64_t index = blockIdx.x * kChunk + offset + threadIdx.x;
    const int32_t flags = index < count ? list.flags(index) : 0;
    const unsigned votes = __ballot_sync(0xffffffff, (flags & kListed) != 0);
    if (lane == 0) listed[warp] = __popc(votes);
    __syncthreads();
    int64_t own_rank = rank + __popc(votes & ((1u << lane) - 1));
    for (int other_warp = 0; other_warp < kThreads / 32; ++other_warp) {
      if (other_warp < warp) own_rank += listed[other_warp];
      rank += listed[other_warp];
    }
    if ((flags & kTouched) != 0) list.process(index, flags, own_rank, all.listed);
    __syncthreads();
  }
}

template <class List>
void compact(const Tensor& like, int64_t count, const List& list) {
  const int64_t chunks = std::max<int64_t>((count + kChunk - 1) / kChunk, 1);
  const int64_t bytes = (chunks + 1) * static_cast<int64_t>(sizeof(Counts));
  const Tensor scratch = torch::stable::new_empty(like, {bytes}, ScalarType::Byte);
  auto* chunk_c = static_cast<Counts*>(scratch.mutable_data_ptr());
  const Launcher launch(like);
  launch(count_chunks<List>, chunks, kThreads, list, count, chunk_c);
  launch(add_chunks, 1, kScanThreads, chunk_c, chunks);
  launch(process_chunks<List>, chunks, kThreads, list, count, chunk_c);
}

void sort_keys(const Tensor& like, int64_t* keys, int64_t count) {
  const Launcher launch(like);
  const Tensor second_buffer = torch::stable::new_empty(like, {count}, ScalarType::Long);
  cub::DoubleBuffer<int64_t> buffers(keys, static_cast<int64_t*>(second_buffer.mutable_data_ptr()));
  size_t bytes = 0;
  const auto sort = [&](void* scratch) {
    const cudaError_t status = cub::DeviceRadixSort::SortKeys(scratch, bytes, buffers, count, 0, 64, launch.stream());
    STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: sorting failed: ", cudaGetErrorString(status));
  };
  sort(nullptr);  // only computes the size of the scratch memory
  const Tensor scratch = torch::stable::new_empty(like, {static_cast<int64_t>(bytes)}, ScalarType::Byte);
  sort(scratch.mutable_data_ptr());
  if (buffers.Current() != keys) {
    cudaMemcpyAsync(keys, buffers.Current(), count * sizeof(int64_t), cudaMemcpyDeviceToDevice, launch.stream());
  }
}

}  // namespace gvtorch

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CUDA, library) { gvtorch::implement(library, gvtorch::AllOps{}); }
