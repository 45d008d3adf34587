// Vectors of kLanes numbers, one for each ray of a packet: the compiler's (GCC and Clang "vector extensions"), as wide
// as the instruction set that this file is compiled for. Only what these lack is written for each set: the exact
// minimum and maximum, square roots, loads from many addresses, and which lanes of a mask are set.
#pragma once

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include "base/hd.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif
typedef float Floats __attribute__((vector_size(kLanes * 4)));
typedef int32_t Ints __attribute__((vector_size(kLanes * 4)));
using Mask = Ints;  // -1 or 0 in each lane

GV_HD Floats to_floats(Ints value) { return __builtin_convertvector(value, Floats); }
GV_HD Ints truncated(Floats value) { return __builtin_convertvector(value, Ints); }

GV_HD Ints lane_numbers() {
  Ints lane;
  for (int i = 0; i < kLanes; ++i) lane[i] = i;
  return lane;
}

// As in arithmetic.h: which of two comes out where one is no number is the same.
GV_HD Floats smaller(Floats a, Floats b) {
#if defined(__AVX512F__)
  return (Floats)_mm512_min_ps((__m512)b, (__m512)a);
#elif defined(__AVX2__)
  return (Floats)_mm256_min_ps((__m256)b, (__m256)a);
#elif defined(__SSE2__)
  return (Floats)_mm_min_ps((__m128)b, (__m128)a);
#else
  return b < a ? b : a;
#endif
}
GV_HD Floats larger(Floats a, Floats b) {
#if defined(__AVX512F__)
  return (Floats)_mm512_max_ps((__m512)b, (__m512)a);
#elif defined(__AVX2__)
  return (Floats)_mm256_max_ps((__m256)b, (__m256)a);
#elif defined(__SSE2__)
  return (Floats)_mm_max_ps((__m128)b, (__m128)a);
#else
  return b > a ? b : a;
#endif
}
GV_HD Ints smaller(Ints a, Ints b) { return b < a ? b : a; }
GV_HD Ints larger(Ints a, Ints b) { return b > a ? b : a; }
// value > low ? value : low, then raised < high ? raised : high.
GV_HD Floats clamp(Floats value, Floats low, Floats high) { return smaller(high, larger(low, value)); }
GV_HD Floats square_root(Floats value) {
#if defined(__AVX512F__)
  return (Floats)_mm512_sqrt_ps((__m512)value);
#elif defined(__AVX2__)
  return (Floats)_mm256_sqrt_ps((__m256)value);
#elif defined(__SSE2__)
  return (Floats)_mm_sqrt_ps((__m128)value);
#else
  for (int i = 0; i < kLanes; ++i) value[i] = sqrt(value[i]);
  return value;
#endif
}

// A bit for each lane that is set.
GV_HD uint32_t bits(Mask mask) {
#if defined(__AVX512F__)
  return _mm512_movepi32_mask((__m512i)mask);
#elif defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_ps((__m256)mask));
#elif defined(__SSE2__)
  return static_cast<uint32_t>(_mm_movemask_ps((__m128)mask));
#else
  uint32_t found = 0;
  for (int i = 0; i < kLanes; ++i) found |= static_cast<uint32_t>(mask[i] & 1) << i;
  return found;
#endif
}
GV_HD bool any(Mask mask) { return bits(mask) != 0; }
GV_HD int32_t count(Mask mask) { return __builtin_popcount(bits(mask)); }

// body(lane) for each lane that is set.
template <class Body>
GV_HD void for_lanes(Mask mask, const Body& body) {
  for (uint32_t left = bits(mask); left != 0; left &= left - 1) body(__builtin_ctz(left));
}

// 4 bytes at each address base + offset.
GV_HD Ints gather(const void* base, Ints offset) {
#if defined(__AVX512F__)
  return (Ints)_mm512_i32gather_epi32((__m512i)offset, base, 1);
#elif defined(__AVX2__)
  return (Ints)_mm256_i32gather_epi32(static_cast<const int*>(base), (__m256i)offset, 1);
#else
  Ints word;
  for (int lane = 0; lane < kLanes; ++lane) {
    int32_t one;
    memcpy(&one, static_cast<const char*>(base) + offset[lane], 4);
    word[lane] = one;
  }
  return word;
#endif
}
GV_HD Ints pick(const int32_t* table, Ints index) { return gather(table, index << 2); }
GV_HD Floats pick(const float* table, Ints index) { return (Floats)gather(table, index << 2); }

// The voxel in the low bytes of each word, as a number.
template <class Voxel>
struct Unpack;
template <>
struct Unpack<uint8_t> {
  GV_HD static Floats low(Ints word) { return to_floats(word & 0xff); }
};
template <>
struct Unpack<int8_t> {
  GV_HD static Floats low(Ints word) { return to_floats((word << 24) >> 24); }
};
template <>
struct Unpack<uint16_t> {
  GV_HD static Floats low(Ints word) { return to_floats(word & 0xffff); }
};
template <>
struct Unpack<int16_t> {
  GV_HD static Floats low(Ints word) { return to_floats((word << 16) >> 16); }
};
template <>
struct Unpack<BFloat16> {
  GV_HD static Floats low(Ints word) { return (Floats)(word << 16); }
};
template <>
struct Unpack<Half> {
  GV_HD static Floats low(Ints word) {
    const Ints magnitude = (word & 0x7fff) << 13;
    const Floats scaled = (Floats)magnitude * 5.192296858534828e33f;  // see `number` in hd.h
    const Ints value = magnitude < (0x7c00 << 13) ? (Ints)scaled : magnitude | 0x7f800000;
    return (Floats)(value | ((word & 0x8000) << 16));
  }
};
template <>
struct Unpack<float> {
  GV_HD static Floats low(Ints word) { return (Floats)word; }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
