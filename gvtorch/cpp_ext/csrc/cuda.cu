// The CUDA library: the same functors, one thread an index. It needs the CPU library, which defines the ops.

#include <cuda_runtime.h>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>
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

template <class Keep>
struct KeepFlag {
  Keep keep;
  __device__ int32_t operator()(int64_t index) const { return keep(index) ? 1 : 0; }
};

template <class Keep, class Put>
struct PutKept {
  Keep keep;
  Put put;
  const int32_t* rank_n;  // exclusive
  int64_t count;
  int64_t* kept;
  __device__ void operator()(int64_t index) const {
    const bool keeps = keep(index);
    const int64_t rank = rank_n[index];
    if (keeps) put(index, rank);
    if (index == count - 1) *kept = rank + (keeps ? 1 : 0);
  }
};

// Calls put(index, rank) for every index that `keep` accepts, ranks in order; writes their number on the device.
template <class Device, class Keep, class Put>
void compact(const torch::stable::Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept) {
  using torch::headeronly::ScalarType;
  if (count == 0) return;  // the counts are zero already
  const torch::stable::accelerator::DeviceGuard guard(like.get_device_index());
  void* stream = nullptr;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(like.get_device_index(), &stream));
  const auto on = static_cast<cudaStream_t>(stream);
  const auto flags = thrust::make_transform_iterator(thrust::counting_iterator<int64_t>(0), KeepFlag<Keep>{keep});
  torch::stable::Tensor rank = torch::stable::new_empty(like, {count}, ScalarType::Int);
  auto* rank_n = static_cast<int32_t*>(rank.mutable_data_ptr());
  size_t bytes = 0;
  cudaError_t status = cub::DeviceScan::ExclusiveSum(nullptr, bytes, flags, rank_n, count, on);
  STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: scan failed: ", cudaGetErrorString(status));
  torch::stable::Tensor scratch = torch::stable::new_empty(like, {static_cast<int64_t>(bytes)}, ScalarType::Byte);
  status = cub::DeviceScan::ExclusiveSum(scratch.mutable_data_ptr(), bytes, flags, rank_n, count, on);
  STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: scan failed: ", cudaGetErrorString(status));
  for_each<Device>(like, count, PutKept<Keep, Put>{keep, put, rank_n, count, kept});
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
