// The shadows that fall on the samples of rays: Shadows<T, Kernel> adds intervals with their shadows. On a CPU each ray
// traces its cones to the light by itself, at once; on a GPU a warp's threads trace those of its rays together.
#pragma once

#include "shaders/light.h"

namespace gvtorch::GV_NAMESPACE {

// The threads of a warp for which `value` is true, a bit each; 0 on a CPU.
GV_HD unsigned threads_where([[maybe_unused]] bool value) {
#ifdef __CUDA_ARCH__
  return __ballot_sync(__activemask(), value);
#else
  return 0;
#endif
}

#ifdef __CUDACC__

constexpr int32_t kWarpThreads = 32, kBlockWarps = 4;

// The intervals of one ray that wait to be added. A thread with kPoints of them waits as well, until the rays of all
// threads of the warp do or have ended; then each thread traces a cone of any of the rays. Otherwise few threads would
// trace one at a time while the others wait. Only colours wait, which nothing else depends on; they are added in the
// order of each ray. (packets/packet_shadows.h does the same on a CPU.)
template <class T, class Kernel>
class Shadows {
 public:
  // `threads`: those of the warp that have a ray.
  __device__ Shadows(const Kernel& kernel, const Ray<T>& ray, const Sight<T>& sight, unsigned threads)
      : kernel(kernel), memory(shared()), threads(threads), thread(threadIdx.x % kWarpThreads) {
    memory.ray[thread] = ray;
    memory.sight[thread] = sight;
  }
  // Adds an interval.
  __device__ void add(const Interval<T>& interval, const LitPoint<T>& lit_point, const LightCone<T>& to_light,
                      ShadeSum<T>& sum, int32_t& samples) {
    point[points] = lit_point;
    weight[points] = sum.clear * lit_point.base.alpha;
    sum.absorb(lit_point.base.alpha, interval);
    if (kernel.light.receives(lit_point)) {
      receiving |= 1u << points;
      memory.cone_t[cones++][thread] = to_light.t;
    }
    if (++points == kPoints) add_all(false, sum, samples);
  }
  // Adds what waits when the ray has ended, and helps the other rays until they have.
  __device__ void finish(ShadeSum<T>& sum, int32_t& samples) {
    while (!add_all(true, sum, samples)) {
    }
  }

 private:
  static constexpr int32_t kPoints = 4;
  struct Memory {  // of a warp; the last index is the ray's thread
    Ray<T> ray[kWarpThreads];
    Sight<T> sight[kWarpThreads];
    T cone_t[kPoints][kWarpThreads];  // distances along the rays at which their cones begin
    T share[kPoints][kWarpThreads];   // of the light that reaches these positions
    int32_t samples[kWarpThreads], missed[kWarpThreads];
    uint8_t cone[kPoints * kWarpThreads];  // indices of all cones in cone_t
  };
  static_assert(kPoints * kWarpThreads <= 256);
  struct Eye {
    using Number = T;
    const Sight<T>& sight;
  };

  __device__ static Memory& shared() {
    __shared__ Memory warps[kBlockWarps];
    return warps[threadIdx.x / kWarpThreads];
  }

  // Adds what waits. Returns true if all rays have ended.
  __device__ bool add_all(bool ended, ShadeSum<T>& sum, int32_t& samples) {
    const bool all_ended = trace(ended);
    int32_t traced = 0;
    GV_NO_UNROLL
    for (int32_t i = 0; i < points; ++i) {
      const T share = (receiving >> i & 1) != 0 ? memory.share[traced++][thread] : static_cast<T>(1);
      sum.add_light(0, kernel.light.in_shadow(point[i], share), weight[i]);
    }
    samples += memory.samples[thread];
    sum.missed = sum.missed || memory.missed[thread] != 0;
    points = cones = 0;
    receiving = 0;
    return all_ended;
  }

  // Traces the cones of all rays; waits until all threads call it. Returns true if `ended` is true for all.
  __device__ __noinline__ bool trace(bool ended) {
    const unsigned before = threads & ((1u << thread) - 1);
    int32_t total = 0;
    GV_NO_UNROLL
    for (int32_t i = 0; i < kPoints; ++i) {
      const unsigned having = __ballot_sync(threads, cones > i);
      if (cones > i) memory.cone[total + __popc(having & before)] = static_cast<uint8_t>(i * kWarpThreads + thread);
      total += __popc(having);
    }
    memory.samples[thread] = memory.missed[thread] = 0;
    __syncwarp(threads);
    for (int32_t next = __popc(before); next < total; next += __popc(threads)) {
      const int32_t i = memory.cone[next] / kWarpThreads, owner = memory.cone[next] % kWarpThreads;
      const Sight<T>& sight = memory.sight[owner];
      int32_t samples = 0;
      bool missed = false;
      const LightCone<T> cone = kernel.light.towards(Eye{sight}, memory.cone_t[i][owner]);
      memory.share[i][owner] = kernel.light_share(memory.ray[owner], sight, cone, samples, missed);
      atomicAdd(&memory.samples[owner], samples);
      if (missed) memory.missed[owner] = 1;
    }
    __syncwarp(threads);
    return __all_sync(threads, ended);
  }

  const Kernel& kernel;
  Memory& memory;
  const unsigned threads;
  const int32_t thread;
  LitPoint<T> point[kPoints];
  T weight[kPoints];       // share of the picture
  unsigned receiving = 0;  // a bit for each point: it needs a cone
  int32_t points = 0, cones = 0;
};

#else

template <class T, class Kernel>
struct Shadows {
  const Kernel& kernel;
  const Ray<T>& ray;
  const Sight<T>& sight;
  unsigned threads;

  void add(const Interval<T>& interval, const LitPoint<T>& point, const LightCone<T>& cone, ShadeSum<T>& sum,
           int32_t& samples) const {
    const bool receives = kernel.light.receives(point);
    const T share = receives ? kernel.light_share(ray, sight, cone, samples, sum.missed) : static_cast<T>(1);
    sum.add(kernel.light.in_shadow(point, share), interval);
  }
  void finish(ShadeSum<T>&, int32_t&) const {}
};

#endif

}  // namespace gvtorch::GV_NAMESPACE
