// Vectors of kLanes numbers, one for each ray of a packet: the compiler's (GCC and Clang "vector extensions"), as wide
// as the instruction set that this file is compiled for. Only what these lack is written for each set: loads from many
// addresses, and which lanes of a mask are set.
#pragma once

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include "hd.h"

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

// Comparisons and functions as in hd.h: which of two comes out where one is no number is the same.
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
GV_HD Ints floor_int(Floats value) {
  const Ints whole = truncated(value);
  return whole + (to_floats(whole) > value);
}

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
GV_HD Floats log2_exact(Floats value) {
  const Ints bits = (Ints)value;
  const Floats mantissa = (Floats)((bits & 0x007fffff) | 0x3f800000);
  const Mask large = mantissa > 1.41421356f;
  const Floats exponent = to_floats((bits >> 23) - 127 - large);
  const Floats m = large ? mantissa * 0.5f : mantissa;
  const Floats s = (m - 1.0f) / (m + 1.0f);
  const Floats z = s * s;
  Floats series = Floats{} + 0.320598898f;
  series = series * z + 0.412198583f;
  series = series * z + 0.577078016f;
  series = series * z + 0.961796694f;
  series = series * z + 2.885390082f;
  return exponent + series * s;
}
GV_HD Floats exp2_exact(Floats value) {
  const Floats x = clamp(value, Floats{} - 126.0f, Floats{} + 126.0f);
  const Ints whole = floor_int(x + 0.5f);
  const Floats f = x - to_floats(whole);
  Floats series = Floats{} + 1.52527338e-5f;
  series = series * f + 1.54035304e-4f;
  series = series * f + 1.33335581e-3f;
  series = series * f + 9.61812911e-3f;
  series = series * f + 5.55041087e-2f;
  series = series * f + 2.40226507e-1f;
  series = series * f + 6.93147181e-1f;
  series = series * f + 1.0f;
  return value > -126.0f ? series * (Floats)((whole + 127) << 23) : Floats{};
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
