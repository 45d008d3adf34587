// The CUDA library: the same functors, one thread an index. It needs the CPU library, which defines the ops.

#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <cub/device/device_scan.cuh>

#include "trace.h"

namespace gvtorch {

struct Cuda {};

#ifndef GV_TRY_MIN
#define GV_TRY_MIN 8
#endif
// 8 blocks of 128 on a multiprocessor leave 64 registers to a thread: waiting for memory is what tracing must hide.
constexpr int kBlock = 128;
template <class Functor>
__global__ void __launch_bounds__(kBlock, GV_TRY_MIN) run_functor(Functor functor, int64_t count) {
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t index = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; index < count; index += stride) {
    functor(index);
  }
}

template <class Device, class Functor>
void for_each(const torch::stable::Tensor& like, int64_t count, const Functor& functor) {
  if (count == 0) return;
  const torch::stable::accelerator::DeviceGuard guard(like.get_device_index());
  void* stream = nullptr;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(like.get_device_index(), &stream));
  const int64_t blocks = (count + kBlock - 1) / kBlock;
  const auto grid = static_cast<unsigned>(blocks < 0x7fffffff ? blocks : 0x7fffffff);
  run_functor<<<grid, kBlock, 0, static_cast<cudaStream_t>(stream)>>>(functor, count);
  const cudaError_t status = cudaGetLastError();
  STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: kernel launch failed: ", cudaGetErrorString(status));
}

template <class Device, class T, class Voxel>
void trace_as(const torch::stable::Tensor& like, TraceArgs args) {
  using torch::headeronly::ScalarType;
  torch::stable::Tensor hidden_tn = torch::stable::new_empty(like, {args.nodes}, ScalarType::Byte);
  auto* hidden = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
  args.hidden_tn = hidden;
  const TraceRay<T, Voxel> body(args);
  for_each<Device>(like, args.nodes, HideNode<T, Voxel>{body.bricks, body.transfer, hidden});
  for_each<Device>(like, body.order.count(), body);
}

template <class Device>
void trace(const torch::stable::Tensor& like, const TraceArgs& args, bool wide) {
  with_voxel(args.voxel, [&](auto voxel) {
    using Voxel = decltype(voxel);
    if (wide) {
      trace_as<Device, double, Voxel>(like, args);
    } else {
      trace_as<Device, float, Voxel>(like, args);
    }
  });
}

// The primitives of cache.h. Blocks count chunks, a scan tells where each begins, and blocks place them; a chunk of
// which nothing is kept is not read again.
constexpr int kThreads = 256;
constexpr int64_t kChunk = 16 * kThreads;

template <class Keep>
__global__ void __launch_bounds__(kThreads) count_chunks(Keep keep, int64_t count, int32_t* found_c, int64_t* sum) {
  __shared__ int32_t total;
  if (threadIdx.x == 0) total = 0;
  __syncthreads();
  const int64_t first = blockIdx.x * kChunk + threadIdx.x;
  int32_t found = 0;
#pragma unroll
  for (int64_t offset = 0; offset < kChunk; offset += kThreads) {
    if (first + offset < count && keep(first + offset)) ++found;
  }
  found = __reduce_add_sync(0xffffffff, found);
  if (threadIdx.x % 32 == 0 && found > 0) atomicAdd(&total, found);
  __syncthreads();
  if (threadIdx.x != 0) return;
  if (found_c != nullptr) found_c[blockIdx.x] = total;
  if (sum != nullptr && total > 0) atomicAdd(reinterpret_cast<unsigned long long*>(sum), total);
}

template <bool kAll, class Keep, class Put>
__global__ void __launch_bounds__(kThreads)
    place_chunks(Keep keep, Put put, int64_t count, const int32_t* found_c, const int32_t* first_c, int64_t* kept) {
  __shared__ int32_t before[kThreads / 32 + 1];  // kept in the warps before each, and in all
  const int warp = threadIdx.x / 32;
  const int lane = threadIdx.x % 32;
  const int64_t total = int64_t{first_c[gridDim.x - 1]} + found_c[gridDim.x - 1];
  if (blockIdx.x == 0 && threadIdx.x == 0) *kept = total;
  if (!kAll && found_c[blockIdx.x] == 0) return;
  int64_t rank = first_c[blockIdx.x];
  for (int64_t offset = 0; offset < kChunk; offset += kThreads) {
    const int64_t index = blockIdx.x * kChunk + offset + threadIdx.x;
    const bool keeps = index < count && keep(index);
    const unsigned votes = __ballot_sync(0xffffffff, keeps);
    if (lane == 0) before[warp + 1] = __popc(votes);
    if (threadIdx.x == 0) before[0] = 0;
    __syncthreads();
    if (threadIdx.x == 0) {
      for (int other = 1; other <= kThreads / 32; ++other) before[other] += before[other - 1];
    }
    __syncthreads();
    const int64_t own = rank + before[warp] + __popc(votes & ((1u << lane) - 1));
    if (keeps) {
      put(index, own);
    } else if (kAll && index < count) {
      put(index, total + index - own);
    }
    rank += before[kThreads / 32];
    __syncthreads();
  }
}

// The grid of a pass over chunks, and the stream it runs on.
struct Pass {
  torch::stable::accelerator::DeviceGuard guard;
  cudaStream_t stream = nullptr;
  unsigned chunks;
  Pass(const torch::stable::Tensor& like, int64_t count)
      : guard(like.get_device_index()), chunks(static_cast<unsigned>((count + kChunk - 1) / kChunk)) {
    void* current = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(like.get_device_index(), &current));
    stream = static_cast<cudaStream_t>(current);
  }
  static void check(cudaError_t status) {
    STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: kernel launch failed: ", cudaGetErrorString(status));
  }
};

template <class Device, class Keep>
void count(const torch::stable::Tensor& like, int64_t size, const Keep& keep, int64_t* kept) {
  if (size == 0) return;  // the counts are zero already
  const Pass pass(like, size);
  count_chunks<<<pass.chunks, kThreads, 0, pass.stream>>>(keep, size, nullptr, kept);
  Pass::check(cudaGetLastError());
}

template <bool kAll, class Keep, class Put>
void place(const torch::stable::Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  using torch::headeronly::ScalarType;
  if (count == 0) return;
  const Pass pass(like, count);
  torch::stable::Tensor words = torch::stable::new_empty(like, {2, pass.chunks}, ScalarType::Int);
  auto* found_c = static_cast<int32_t*>(words.mutable_data_ptr());
  int32_t* first_c = found_c + pass.chunks;
  count_chunks<<<pass.chunks, kThreads, 0, pass.stream>>>(keep, count, found_c, nullptr);
  Pass::check(cudaGetLastError());
  size_t bytes = 0;
  Pass::check(cub::DeviceScan::ExclusiveSum(nullptr, bytes, found_c, first_c, pass.chunks, pass.stream));
  torch::stable::Tensor scratch = torch::stable::new_empty(like, {static_cast<int64_t>(bytes)}, ScalarType::Byte);
  Pass::check(cub::DeviceScan::ExclusiveSum(scratch.mutable_data_ptr(), bytes, found_c, first_c, pass.chunks,
                                            pass.stream));
  place_chunks<kAll><<<pass.chunks, kThreads, 0, pass.stream>>>(keep, put, count, found_c, first_c, kept);
  Pass::check(cudaGetLastError());
}

template <class Device, class Keep, class Put>
void compact(const torch::stable::Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  place<false>(like, count, keep, put, kept);
}

template <class Device, class Keep, class Put>
void split(const torch::stable::Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  place<true>(like, count, keep, put, kept);
}

}  // namespace gvtorch

#include "entry.h"

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CUDA, library) {
  library.impl("trace_rays", TORCH_BOX(&gvtorch::trace_rays<gvtorch::Cuda>));
  library.impl("compact_requests", TORCH_BOX(&gvtorch::compact_requests<gvtorch::Cuda>));
  library.impl("lru_partition", TORCH_BOX(&gvtorch::lru_partition<gvtorch::Cuda>));
  library.impl("unlink", TORCH_BOX(&gvtorch::unlink<gvtorch::Cuda>));
  library.impl("link", TORCH_BOX(&gvtorch::link<gvtorch::Cuda>));
}
