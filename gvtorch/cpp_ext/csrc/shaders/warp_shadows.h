// The shadows that fall on the samples of a warp's rays, on a GPU: its threads trace the cones to the light together.
#pragma once

#include "shaders/light.h"

#ifdef __CUDACC__
namespace gvtorch::GV_NAMESPACE {

constexpr int32_t kWarpThreads = 32, kBlockWarps = 4;

// The intervals of one ray that wait to be added. A thread with kPoints of them waits as well, until the rays of all
// threads of the warp do or have ended; then each thread traces a cone of any of the rays. Otherwise few threads would
// trace one at a time while the others wait. Only colours wait, which nothing else depends on; they are added in the
// order of each ray. (packets/packet_shadows.h does the same on a CPU.)
template <class T, class Kernel>
class WarpShadows {
 public:
  // `warp_lanes`: the threads of the warp that have a ray.
  __device__ WarpShadows(const Kernel& kernel, const Ray<T>& ray, const Sight<T>& sight, unsigned warp_lanes)
      : kernel(kernel), memory(shared()), lanes(warp_lanes), lane(threadIdx.x % kWarpThreads) {
    memory.ray[lane] = ray;
    memory.sight[lane] = sight;
  }
  // Adds an interval.
  __device__ void add(const Piece<T>& piece, const LitPoint<T>& lit_point, const LightCone<T>& to_light,
                      ShadeSum<T>& sum, int32_t& samples) {
    point[points] = lit_point;
    weight[points] = sum.clear * lit_point.base.alpha;
    sum.absorb(lit_point.base.alpha, piece);
    if (kernel.light.receives(lit_point)) {
      receiving |= 1u << points;
      memory.cone_t[cones++][lane] = to_light.t;
    }
    if (++points == kPoints) add_all(false, sum, samples);
  }
  // Adds what waits when the ray has ended, and helps the other rays until they have.
  __device__ void finish(ShadeSum<T>& sum, int32_t& samples) {
    while (!add_all(true, sum, samples)) {
    }
  }

 private:
  static constexpr int32_t kPoints = 8;
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
      const T share = (receiving >> i & 1) != 0 ? memory.share[traced++][lane] : static_cast<T>(1);
      sum.add_light(0, kernel.light.in_shadow(point[i], share), weight[i]);
    }
    samples += memory.samples[lane];
    sum.missed = sum.missed || memory.missed[lane] != 0;
    points = cones = 0;
    receiving = 0;
    return all_ended;
  }

  // Traces the cones of all rays; waits until all threads call it. Returns true if `ended` is true for all.
  __device__ __noinline__ bool trace(bool ended) {
    const unsigned before = lanes & ((1u << lane) - 1);
    int32_t total = 0;
    GV_NO_UNROLL
    for (int32_t i = 0; i < kPoints; ++i) {
      const unsigned having = __ballot_sync(lanes, cones > i);
      if (cones > i) memory.cone[total + __popc(having & before)] = static_cast<uint8_t>(i * kWarpThreads + lane);
      total += __popc(having);
    }
    memory.samples[lane] = memory.missed[lane] = 0;
    __syncwarp(lanes);
    for (int32_t next = __popc(before); next < total; next += __popc(lanes)) {
      const int32_t i = memory.cone[next] / kWarpThreads, owner = memory.cone[next] % kWarpThreads;
      const Sight<T>& sight = memory.sight[owner];
      int32_t samples = 0;
      bool missed = false;
      const LightCone<T> cone = kernel.light.towards(Eye{sight}, memory.cone_t[i][owner]);
      memory.share[i][owner] = kernel.light_share(memory.ray[owner], sight, cone, samples, missed);
      atomicAdd(&memory.samples[owner], samples);
      if (missed) memory.missed[owner] = 1;
    }
    __syncwarp(lanes);
    return __all_sync(lanes, ended);
  }

  const Kernel& kernel;
  Memory& memory;
  const unsigned lanes;
  const int32_t lane;
  LitPoint<T> point[kPoints];
  T weight[kPoints];       // share of the picture
  unsigned receiving = 0;  // a bit for each point: it needs a cone
  int32_t points = 0, cones = 0;
};

}  // namespace gvtorch::GV_NAMESPACE
#endif
