// Runs a functor for each index: `for_each(like, count, functor)`, on the device of the tensor `like`. Each library has
// one version: a C++ compiler compiles the CPU's, nvcc the one for CUDA.
#pragma once

#ifdef __CUDACC__
#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>
#else
#include <atomic>
#endif
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <cstdint>
#include <type_traits>

namespace gvtorch {

#ifdef __CUDACC__

// Starts kernels on the device of `like`, in torch's current stream.
class Launcher {
 public:
  explicit Launcher(const torch::stable::Tensor& like) : guard(like.get_device_index()) {
    void* stream = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(like.get_device_index(), &stream));
    current = static_cast<cudaStream_t>(stream);
  }
  template <class... Parameter, class... Argument>
  void operator()(void (*kernel)(Parameter...), int64_t blocks, int threads, const Argument&... arguments) const {
    kernel<<<static_cast<unsigned>(blocks), threads, 0, current>>>(arguments...);
    const cudaError_t status = cudaGetLastError();
    STD_TORCH_CHECK(status == cudaSuccess, "gvtorch: kernel launch failed: ", cudaGetErrorString(status));
  }
  cudaStream_t stream() const { return current; }

 private:
  const torch::stable::accelerator::DeviceGuard guard;
  cudaStream_t current;
};

// Eight blocks of this size on a multiprocessor leave 64 registers to a thread; many threads hide waits for memory.
constexpr int kBlockThreads = 128;
// Functors may override this. Those that shade ask for fewer blocks, because they need more registers.
template <class Functor, class = void>
constexpr int kBlocksPerSM = 8;
template <class Functor>
constexpr int kBlocksPerSM<Functor, std::void_t<decltype(Functor::kBlocksPerSM)>> = Functor::kBlocksPerSM;
template <class Functor>
__global__ void __launch_bounds__(kBlockThreads, kBlocksPerSM<Functor>) run_functor(Functor functor, int64_t count) {
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t index = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; index < count; index += stride) {
    functor(index);
  }
}

template <class Functor>
void for_each(const torch::stable::Tensor& like, int64_t count, const Functor& functor) {
  if (count == 0) return;
  const int64_t blocks = std::min<int64_t>((count + kBlockThreads - 1) / kBlockThreads, INT32_MAX);
  Launcher{like}(run_functor<Functor>, blocks, kBlockThreads, functor, count);
}

#else

// How many indices a thread takes at a time. Functors whose indices take long override this with fewer.
template <class Functor, class = void>
constexpr int64_t kChunkSize = 256;
template <class Functor>
constexpr int64_t kChunkSize<Functor, std::void_t<decltype(Functor::kChunkSize)>> = Functor::kChunkSize;

// Calls body(begin, end) for all indices, in chunks of `chunk_size` that threads draw from a counter, so that long rays
// do not leave a thread idle. Nothing that a body writes may depend on which thread runs it.
template <class Body>
void for_chunks(int64_t count, int64_t chunk_size, const Body& body) {
  const int64_t chunks = (count + chunk_size - 1) / chunk_size;
  const int64_t workers = std::min<int64_t>(torch::stable::get_num_threads(), chunks);
  std::atomic<int64_t> next{0};
  torch::stable::parallel_for(0, workers, 1, [&](int64_t, int64_t) {
    for (int64_t chunk = next++; chunk < chunks; chunk = next++) {
      body(chunk * chunk_size, std::min(count, (chunk + 1) * chunk_size));
    }
  });
}

template <class Functor>
void for_each(const torch::stable::Tensor&, int64_t count, const Functor& functor) {
  for_chunks(count, kChunkSize<Functor>, [&](int64_t begin, int64_t end) {
    for (int64_t index = begin; index < end; ++index) functor(index);
  });
}

#endif

}  // namespace gvtorch
