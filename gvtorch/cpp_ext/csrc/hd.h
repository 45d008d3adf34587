// What every kernel header stands on: the host/device marker, plain vectors, atomics on integers, and the
// two transcendental functions of the renderer.
//
// Kernels are functors of ONE index, `GV_HD void operator()(int64_t) const`, and are run by `for_each`
// (for_each.h). No other header in this folder but entry*.h knows torch.
//
// log2 and exp2 in float32 are written with + - * / and bit moves alone, always in the same order, so that the
// torch twin (ops/reference/march.py), the CPU and the GPU agree to the last bit. Series: Abramowitz and Stegun,
// "Handbook of Mathematical Functions", 1964, 4.1.27 (logarithm by atanh) and 4.2.1 (exponential).
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

// The CPU's kernels are compiled once for each instruction set, each in a namespace of its own: a function that the
// linker merges would else run instructions that a machine does not have.
#ifndef GV_NAMESPACE
#define GV_NAMESPACE plain
#endif

#ifdef __CUDACC__
#define GV_HD __host__ __device__ __forceinline__
#define GV_CALL __host__ __device__ __noinline__
#else
#define GV_HD inline __attribute__((always_inline))
#define GV_CALL __attribute__((noinline))
#endif

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class T>
struct Vec3 {
  T x, y, z;
  GV_HD T& operator[](int axis) { return axis == 0 ? x : (axis == 1 ? y : z); }
  GV_HD T operator[](int axis) const { return axis == 0 ? x : (axis == 1 ? y : z); }
};

// Comparisons are written so that a NaN ends at the lower bound: an index made from the result is always valid.
template <class T>
GV_HD T clamp(T value, T low, T high) {
#ifdef __CUDA_ARCH__
  if constexpr (static_cast<T>(0.5) != 0) return fmin(fmax(value, low), high);
#endif
  const T raised = value > low ? value : low;
  return raised < high ? raised : high;
}

template <class T>
GV_HD T smaller(T a, T b) {
  return b < a ? b : a;
}

template <class T>
GV_HD T larger(T a, T b) {
  return b > a ? b : a;
}

// floor of a value that fits an int32. Without SSE4.1 (the baseline of x86-64) std::floor is a call.
template <class T>
GV_HD int32_t floor_int(T value) {
  const int32_t whole = static_cast<int32_t>(value);
  return whole - (static_cast<T>(whole) > value ? 1 : 0);
}

// 16-bit floats as they are stored; every one of them is a float.
struct Half {
  uint16_t bits;
};
struct BFloat16 {
  uint16_t bits;
};

template <class To, class From>
GV_HD To bit_cast(From value) {
  static_assert(sizeof(To) == sizeof(From));
  To out;
  memcpy(&out, &value, sizeof(out));
  return out;
}

// Bits of a positive number, up to the highest one that is set.
GV_HD int32_t bit_width(int32_t value) {
#ifdef __CUDA_ARCH__
  return 32 - __clz(value);
#else
  return 32 - __builtin_clz(static_cast<uint32_t>(value));
#endif
}

// Voxel to number. Halves by moving their bits and scaling, which is exact for denormals too.
template <class T, class Voxel>
GV_HD T number(Voxel voxel) {
  return static_cast<T>(voxel);
}
template <class T>
GV_HD T number(BFloat16 voxel) {
  return static_cast<T>(bit_cast<float>(static_cast<uint32_t>(voxel.bits) << 16));
}
template <class T>
GV_HD T number(Half voxel) {
  const uint32_t sign = static_cast<uint32_t>(voxel.bits & 0x8000) << 16;
  const uint32_t magnitude = voxel.bits & 0x7fff;
  const float scaled = bit_cast<float>(magnitude << 13) * 5.192296858534828e33f;  // 2^112: the biases' difference
  const uint32_t bits = magnitude < 0x7c00 ? bit_cast<uint32_t>(scaled) : (magnitude << 13) | 0x7f800000;
  return static_cast<T>(bit_cast<float>(sign | bits));
}

// Base-2 logarithm of a positive, normal float.
GV_HD float log2_exact(float value) {
  const int32_t bits = bit_cast<int32_t>(value);
  float exponent = static_cast<float>((bits >> 23) - 127);
  float mantissa = bit_cast<float>((bits & 0x007fffff) | 0x3f800000);
  if (mantissa > 1.41421356f) {
    mantissa = mantissa * 0.5f;
    exponent = exponent + 1.0f;
  }
  const float s = (mantissa - 1.0f) / (mantissa + 1.0f);
  const float z = s * s;
  float series = 0.320598898f;
  series = series * z + 0.412198583f;
  series = series * z + 0.577078016f;
  series = series * z + 0.961796694f;
  series = series * z + 2.885390082f;
  return exponent + series * s;
}

// 2 to the power of `value`; 0 below -126, the largest power below 127 above it.
GV_HD float exp2_exact(float value) {
  if (!(value > -126.0f)) return 0.0f;
  const float x = smaller(value, 126.0f);
  const int32_t whole = floor_int(x + 0.5f);
  const float f = x - static_cast<float>(whole);
  float series = 1.52527338e-5f;
  series = series * f + 1.54035304e-4f;
  series = series * f + 1.33335581e-3f;
  series = series * f + 9.61812911e-3f;
  series = series * f + 5.55041087e-2f;
  series = series * f + 2.40226507e-1f;
  series = series * f + 6.93147181e-1f;
  series = series * f + 1.0f;
  return series * bit_cast<float>((whole + 127) << 23);
}

GV_HD double log2_exact(double value) { return ::log2(value); }
GV_HD double exp2_exact(double value) { return ::exp2(value); }

// Stamps: many rays store the same value, so a relaxed store is enough; the read first spares the cache line.
GV_HD void store_stamp(int32_t* word, int32_t stamp) {
#ifdef __CUDA_ARCH__
  if (*reinterpret_cast<volatile int32_t*>(word) != stamp) *reinterpret_cast<volatile int32_t*>(word) = stamp;
#else
  if (__atomic_load_n(word, __ATOMIC_RELAXED) != stamp) __atomic_store_n(word, stamp, __ATOMIC_RELAXED);
#endif
}

// A byte that several threads may fill with the same value.
GV_HD uint8_t load_byte(const uint8_t* byte) {
#ifdef __CUDA_ARCH__
  return *byte;
#else
  return __atomic_load_n(byte, __ATOMIC_RELAXED);
#endif
}
GV_HD void store_byte(uint8_t* byte, uint8_t value) {
#ifdef __CUDA_ARCH__
  *byte = value;
#else
  __atomic_store_n(byte, value, __ATOMIC_RELAXED);
#endif
}

// Joins `wish` into a request word: kind bits (above kPriorityMask) by OR, priority by maximum. Commutative, so
// the word does not depend on the order of the rays.
constexpr int32_t kPriorityMask = 0xffff;
constexpr int32_t kLoad = 1 << 16;
constexpr int32_t kSubdivide = 1 << 17;

GV_HD int32_t join_request(int32_t word, int32_t wish) {
  const int32_t kinds = (word | wish) & ~kPriorityMask;
  return kinds | larger(word & kPriorityMask, wish & kPriorityMask);
}

GV_HD void post_request(int32_t* word, int32_t wish) {
#ifdef __CUDA_ARCH__
  int32_t seen = *reinterpret_cast<volatile int32_t*>(word);
  for (int32_t joined = join_request(seen, wish); joined != seen; joined = join_request(seen, wish)) {
    const int32_t before = atomicCAS(word, seen, joined);
    if (before == seen) return;
    seen = before;
  }
#else
  int32_t seen = __atomic_load_n(word, __ATOMIC_RELAXED);
  for (int32_t joined = join_request(seen, wish); joined != seen; joined = join_request(seen, wish)) {
    if (__atomic_compare_exchange_n(word, &seen, joined, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) return;
  }
#endif
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
