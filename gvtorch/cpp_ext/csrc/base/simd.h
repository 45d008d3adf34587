// Vectors of kLanes numbers, one for each ray of a packet: GCC's and Clang's "vector extensions", as wide as the
// instruction set that this file is compiled for. Only what these lack is written for each set: exact minimum and
// maximum, square roots, loads from many addresses, and the set lanes of a mask as bits.
#pragma once

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include <type_traits>

#include "base/hd.h"

namespace gvtorch::GV_NAMESPACE {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
using Native = __m512;
#define GV_MM(name) _mm512_##name
#elif defined(__AVX2__)
constexpr int kLanes = 8;
using Native = __m256;
#define GV_MM(name) _mm256_##name
#else
constexpr int kLanes = 4;
#if defined(__SSE2__)
using Native = __m128;
#define GV_MM(name) _mm_##name
#endif
#endif
typedef float Floats __attribute__((vector_size(kLanes * 4)));
typedef int32_t Ints __attribute__((vector_size(kLanes * 4)));
typedef uint32_t UInts __attribute__((vector_size(kLanes * 4)));  // sums and products wrap
using Mask = Ints;                                                // -1 or 0 in each lane
typedef double Doubles __attribute__((vector_size(kLanes * 4)));  // half as many lanes
typedef int64_t Longs __attribute__((vector_size(kLanes * 4)));

GV_HD Floats to_floats(Ints value) { return __builtin_convertvector(value, Floats); }
GV_HD Ints truncated(Floats value) { return __builtin_convertvector(value, Ints); }

GV_HD Ints lane_numbers() {
  Ints lane;
  for (int i = 0; i < kLanes; ++i) lane[i] = i;
  return lane;
}

// As in arithmetic.h, also in which of two is returned if one is NaN; minimum and maximum without GV_MM are its own.
#ifdef GV_MM
GV_HD Floats smaller(Floats a, Floats b) { return (Floats)GV_MM(min_ps)((Native)b, (Native)a); }
GV_HD Floats larger(Floats a, Floats b) { return (Floats)GV_MM(max_ps)((Native)b, (Native)a); }
GV_HD Floats square_root(Floats value) { return (Floats)GV_MM(sqrt_ps)((Native)value); }
GV_HD Doubles square_root(Doubles value) { return (Doubles)GV_MM(sqrt_pd)((decltype(GV_MM(setzero_pd)()))value); }
#else
template <class T>
GV_HD T root_of_each(T value) {
  for (size_t i = 0; i < sizeof(value) / sizeof(value[0]); ++i) value[i] = sqrt(value[i]);
  return value;
}
GV_HD Floats square_root(Floats value) { return root_of_each(value); }
GV_HD Doubles square_root(Doubles value) { return root_of_each(value); }
#endif
// The set lanes as bits.
GV_HD uint32_t bits(Mask mask) {
#if defined(__AVX512F__)
  return _mm512_movepi32_mask((__m512i)mask);
#elif defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_ps((__m256)mask));
#elif defined(__SSE2__)
  return static_cast<uint32_t>(_mm_movemask_ps((__m128)mask));
#else
  uint32_t set_bits = 0;
  for (int i = 0; i < kLanes; ++i) set_bits |= static_cast<uint32_t>(mask[i] & 1) << i;
  return set_bits;
#endif
}
GV_HD bool any(Mask mask) { return bits(mask) != 0; }
GV_HD bool any(Longs mask) { return any((Mask)mask); }
GV_HD int32_t count(Mask mask) { return __builtin_popcount(bits(mask)); }

// Calls body(lane) for each lane that is set.
template <class Body>
GV_HD void for_lanes(Mask mask, const Body& body) {
  for (uint32_t remaining = bits(mask); remaining != 0; remaining &= remaining - 1) body(__builtin_ctz(remaining));
}

// Loads 4 bytes at each address base + kScale * offset.
template <int kScale = 1>
GV_HD Ints gather(const void* base, Ints offset) {
#if defined(__AVX512F__)
  return (Ints)_mm512_i32gather_epi32((__m512i)offset, base, kScale);
#elif defined(__AVX2__)
  return (Ints)_mm256_i32gather_epi32(static_cast<const int*>(base), (__m256i)offset, kScale);
#else
  Ints words;
  for (int lane = 0; lane < kLanes; ++lane) {
    int32_t word;
    memcpy(&word, static_cast<const char*>(base) + int64_t{kScale} * offset[lane], 4);
    words[lane] = word;
  }
  return words;
#endif
}
GV_HD Ints pick(const int32_t* table, Ints index) { return gather<4>(table, index); }
// The same for words that other threads may write meanwhile: each is read atomically.
GV_HD Ints pick_shared(const int32_t* table, Ints index) {
#if defined(__AVX2__)
  return pick(table, index);
#else
  Ints words;
  for (int lane = 0; lane < kLanes; ++lane) words[lane] = __atomic_load_n(table + index[lane], __ATOMIC_RELAXED);
  return words;
#endif
}
GV_HD Floats pick(const float* table, Ints index) { return (Floats)gather<4>(table, index); }

#ifdef GV_MM
// Transposes rows of four numbers: rows[i] holds those of the lanes i, i + 4, i + 8, ...; columns[k], number k of
// all.
GV_HD void transpose(const Native rows[4], Floats columns[4]) {
  const Native a = GV_MM(unpacklo_ps)(rows[0], rows[1]), b = GV_MM(unpacklo_ps)(rows[2], rows[3]);
  const Native c = GV_MM(unpackhi_ps)(rows[0], rows[1]), d = GV_MM(unpackhi_ps)(rows[2], rows[3]);
  columns[0] = (Floats)GV_MM(shuffle_ps)(a, b, 0x44);
  columns[1] = (Floats)GV_MM(shuffle_ps)(a, b, 0xee);
  columns[2] = (Floats)GV_MM(shuffle_ps)(c, d, 0x44);
  columns[3] = (Floats)GV_MM(shuffle_ps)(c, d, 0xee);
}
#endif

// Loads four floats at each row of four floats from base on; columns[0] gets the first of all lanes, and so on. A load
// per lane and a transposition replace four gathers, which would load each number alone.
GV_HD void load_rows(const float* base, Ints row, Floats columns[4]) {
#ifdef GV_MM
  int32_t lane[kLanes];
  memcpy(lane, &row, sizeof(lane));
  const auto load_four = [&](int i) { return _mm_loadu_ps(base + int64_t{4} * lane[i]); };
  Native rows[4];
  for (int i = 0; i < 4; ++i) {
#if defined(__AVX512F__)
    rows[i] = _mm512_castps128_ps512(load_four(i));
    rows[i] = _mm512_insertf32x4(rows[i], load_four(i + 4), 1);
    rows[i] = _mm512_insertf32x4(rows[i], load_four(i + 8), 2);
    rows[i] = _mm512_insertf32x4(rows[i], load_four(i + 12), 3);
#elif defined(__AVX2__)
    rows[i] = _mm256_insertf128_ps(_mm256_castps128_ps256(load_four(i)), load_four(i + 4), 1);
#else
    rows[i] = load_four(i);
#endif
  }
  transpose(rows, columns);
#else
  for (int i = 0; i < 4; ++i) columns[i] = pick(base + i, row << 2);
#endif
}

// Loads two such rows, the second right after the first: half as many loads, twice as wide.
GV_HD void load_row_pairs(const float* base, Ints row, Floats first[4], Floats second[4]) {
#if defined(__AVX2__)
  int32_t lane[kLanes];
  memcpy(lane, &row, sizeof(lane));
  const auto load_eight = [&](int i) { return _mm256_loadu_ps(base + int64_t{4} * lane[i]); };
  Floats halves[2][4];  // [h][i]: number i of half of the lanes; first rows of four lanes, their second rows, and so on
  for (int h = 0; h < 2; ++h) {
    Native rows[4];
    for (int i = 0; i < 4; ++i) {
#if defined(__AVX512F__)
      rows[i] = _mm512_insertf32x8(_mm512_castps256_ps512(load_eight(8 * h + i)), load_eight(8 * h + i + 4), 1);
#else
      rows[i] = load_eight(4 * h + i);
#endif
    }
    transpose(rows, halves[h]);
  }
  for (int i = 0; i < 4; ++i) {
    const auto low = (Native)halves[0][i], high = (Native)halves[1][i];
#if defined(__AVX512F__)
    first[i] = (Floats)_mm512_shuffle_f32x4(low, high, 0x88);
    second[i] = (Floats)_mm512_shuffle_f32x4(low, high, 0xdd);
#else
    first[i] = (Floats)_mm256_permute2f128_ps(low, high, 0x20);
    second[i] = (Floats)_mm256_permute2f128_ps(low, high, 0x31);
#endif
  }
#else
  load_rows(base, row, first);
  load_rows(base + 4, row, second);
#endif
}

// Converts the voxel in the low bytes of each word to a number.
template <class Voxel>
GV_HD Floats unpack(Ints word) {
  if constexpr (std::is_same_v<Voxel, float>) {
    return (Floats)word;
  } else if constexpr (std::is_same_v<Voxel, BFloat16>) {
    return (Floats)(word << 16);
  } else if constexpr (std::is_same_v<Voxel, Half>) {
    const Ints magnitude = (word & 0x7fff) << 13;
    const Floats scaled = (Floats)magnitude * 5.192296858534828e33f;  // see `number` in hd.h
    const Ints value = magnitude < (0x7c00 << 13) ? (Ints)scaled : magnitude | 0x7f800000;
    return (Floats)(value | ((word & 0x8000) << 16));
  } else {
    constexpr int kBits = 8 * sizeof(Voxel), kUnused = 32 - kBits;
    return to_floats(std::is_signed_v<Voxel> ? (word << kUnused) >> kUnused : word & ((1 << kBits) - 1));
  }
}

// Converts four consecutive voxels to numbers.
typedef float Floats4 __attribute__((vector_size(16)));
template <class Voxel>
GV_HD Floats4 four_numbers(const char* first) {
  Voxel voxel[4];
  memcpy(voxel, first, sizeof(voxel));
#if defined(__F16C__)
  if constexpr (std::is_same_v<Voxel, Half>) {
    return (Floats4)_mm_cvtph_ps(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(first)));
  }
#endif
  return Floats4{number<float>(voxel[0]), number<float>(voxel[1]), number<float>(voxel[2]), number<float>(voxel[3])};
}

}  // namespace gvtorch::GV_NAMESPACE
