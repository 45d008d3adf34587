// The CUDA library: the same functors, one thread an index. It needs the CPU library, which defines the ops.

#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/tensor.h>

#include <cstdint>

namespace gvtorch {

struct Cuda {};

template <class Functor>
__global__ void run_functor(Functor functor, int64_t count) {
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t index = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; index < count; index += stride) {
    functor(index);
  }
}

template <class Device, class Functor>
void for_each(const torch::stable::Tensor& like, int64_t count, const Functor& functor) {
  if (count == 0) return;
  constexpr int64_t kBlock = 128;
  const torch::stable::accelerator::DeviceGuard guard(like.get_device_index());
  void* stream = nullptr;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(like.get_device_index(), &stream));
  const int64_t blocks = (count + kBlock - 1) / kBlock;
  const auto grid = static_cast<unsigned>(blocks < 0x7fffffff ? blocks : 0x7fffffff);
  run_functor<<<grid, kBlock, 0, static_cast<cudaStream_t>(stream)>>>(functor, count);
  const cudaError_t status = cudaGetLastError();
  STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: kernel launch failed: ", cudaGetErrorString(status));
}

}  // namespace gvtorch

#include "entry.h"

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CUDA, library) {
  library.impl("trace_rays", TORCH_BOX(&gvtorch::trace_rays<gvtorch::Cuda>));
}
