// The basis of every kernel header: host/device markers, vectors of three, conversion of voxels to numbers, and
// atomics. Arithmetic is in arithmetic.h.
//
// Kernels are functors of ONE index, `GV_HD void operator()(int64_t) const`, and are run by `for_each`
// (for_each.h). Of the headers, only that one, shade_each.h, trace_chunks.h and entry*.h include torch.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

// The CPU's kernels are compiled once for each instruction set, each in its own namespace. Otherwise the linker would
// merge functions, which might then run instructions that a machine does not have. The namespace is declared inline
// here, and stays so in all headers.
#ifndef GV_NAMESPACE
#define GV_NAMESPACE plain
#endif
namespace gvtorch {
inline namespace GV_NAMESPACE {}
}  // namespace gvtorch
#ifdef __clang__
#pragma clang diagnostic ignored "-Winline-namespace-reopened-noninline"
#endif

#ifdef __CUDACC__
#define GV_HD __host__ __device__ __forceinline__
#define GV_CALL __host__ __device__ __noinline__
#define GV_RARE GV_HD  // code that few rays reach: on a CPU a call, which keeps the loops around it small
#else
#define GV_HD inline __attribute__((always_inline))
#define GV_CALL __attribute__((noinline))
#define GV_RARE GV_CALL
#endif

// Before a loop that nvcc must not unroll.
#ifdef __CUDA_ARCH__
#define GV_NO_UNROLL _Pragma("unroll 1")
#else
#define GV_NO_UNROLL
#endif

namespace gvtorch::GV_NAMESPACE {

template <class T>
struct Vec3 {
  T x, y, z;
  GV_HD T& operator[](int axis) { return axis == 0 ? x : (axis == 1 ? y : z); }
  GV_HD T operator[](int axis) const { return axis == 0 ? x : (axis == 1 ? y : z); }
};

// Also for vectors of lanes (A) and of numbers (B).
template <class A, class B>
GV_HD Vec3<A> minus(Vec3<A> a, Vec3<B> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class A, class B>
GV_HD auto dot(Vec3<A> a, Vec3<B> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

// 16-bit floats as they are stored; a float32 holds each exactly.
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

// A half that is converted without an instruction for halves.
struct PlainHalf {
  uint16_t bits;
};

// Converts a voxel to a number.
template <class T, class Voxel>
GV_HD T number(Voxel voxel) {
  return static_cast<T>(voxel);
}
template <class T>
GV_HD T number(BFloat16 voxel) {
  return static_cast<T>(bit_cast<float>(static_cast<uint32_t>(voxel.bits) << 16));
}
// Shifts the bits of a half and scales, exact for denormals too.
template <class T>
GV_HD T number(PlainHalf voxel) {
  const uint32_t sign = static_cast<uint32_t>(voxel.bits & 0x8000) << 16;
  const uint32_t magnitude = voxel.bits & 0x7fff;
  const float scaled = bit_cast<float>(magnitude << 13) * 5.192296858534828e33f;  // 2^112: the biases' difference
  const uint32_t bits = magnitude < 0x7c00 ? bit_cast<uint32_t>(scaled) : (magnitude << 13) | 0x7f800000;
  return static_cast<T>(bit_cast<float>(sign | bits));
}
template <class T>
GV_HD T number(Half voxel) {
#ifdef __CUDA_ARCH__
  float number;
  asm("cvt.f32.f16 %0, %1;" : "=f"(number) : "h"(voxel.bits));
  return static_cast<T>(number);
#else
  return number<T>(PlainHalf{voxel.bits});
#endif
}

// Stamps: many rays store the same value, so a relaxed store is enough; reading first avoids most stores and keeps the
// cache line shared. On a GPU the read may hit the first-level cache, which is not coherent: an old value there costs
// one more store, while a read past it (volatile) waits some 200 cycles.
GV_HD void store_stamp(int32_t* word, int32_t stamp) {
#ifdef __CUDA_ARCH__
  if (*word != stamp) *word = stamp;
#else
  if (__atomic_load_n(word, __ATOMIC_RELAXED) != stamp) __atomic_store_n(word, stamp, __ATOMIC_RELAXED);
#endif
}

// Adds atomically to a count, int32_t or int64_t.
template <class T>
GV_HD void add_to(T* count, T more) {
#ifdef __CUDA_ARCH__
  using Word = std::conditional_t<sizeof(T) == 8, unsigned long long, T>;
  atomicAdd(reinterpret_cast<Word*>(count), static_cast<Word>(more));
#else
  __atomic_fetch_add(count, more, __ATOMIC_RELAXED);
#endif
}
// Raises a number atomically to at least `minimum`.
GV_HD void raise_to(int32_t* count, int32_t minimum) {
#ifdef __CUDA_ARCH__
  atomicMax(count, minimum);
#else
  int32_t current = __atomic_load_n(count, __ATOMIC_RELAXED);
  while (current < minimum &&
         !__atomic_compare_exchange_n(count, &current, minimum, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
#endif
}

// Joins a request into a request word, which is never negative: kind bits (above kPriorityMask) by OR, priority by
// maximum. This is commutative, so the word does not depend on the order of the rays.
constexpr int32_t kPriorityMask = 0x7ff;
constexpr int32_t kLoad = 1 << 11;
constexpr int32_t kSubdivide = 1 << 12;

template <class Word>
GV_HD Word join_request(Word word, int32_t request) {
  const int32_t kinds = (word | request) & ~kPriorityMask;
  const int32_t old_priority = word & kPriorityMask, new_priority = request & kPriorityMask;
  return static_cast<Word>(kinds | (new_priority > old_priority ? new_priority : old_priority));
}

GV_HD void post_request(int16_t* word, int32_t request) {
#ifdef __CUDA_ARCH__
  auto* bits = reinterpret_cast<unsigned short*>(word);
  auto current = *reinterpret_cast<volatile unsigned short*>(bits);
  for (auto joined = join_request(current, request); joined != current; joined = join_request(current, request)) {
    const auto previous = atomicCAS(bits, current, joined);
    if (previous == current) return;
    current = previous;
  }
#else
  int16_t current = __atomic_load_n(word, __ATOMIC_RELAXED);
  for (int16_t joined = join_request(current, request); joined != current; joined = join_request(current, request)) {
    if (__atomic_compare_exchange_n(word, &current, joined, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) return;
  }
#endif
}

}  // namespace gvtorch::GV_NAMESPACE
