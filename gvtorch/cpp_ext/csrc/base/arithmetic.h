// Arithmetic on T: float, double, or on the CPU a vector of either (simd.h), as `Floats`, a number for each ray of a
// packet. Code written for T serves both one ray and a packet:
//
//   RealOf<T>, IntOf<T>, MaskOf<T>    type of one number; of a whole number per lane; of a comparison's result per lane
//   select(mask, a, b)                a where the mask is set, else b
//   any(mask)                         true if some lane is set
//   for_lanes(mask, body)             body(lane) for each lane that is set; `lane_of` and `set_lane` read and write it
//
// Masks are combined by && || and !. A single ray is one lane: its mask is a bool, for which && and || stop early.
//
// log2 and exp2 use only + - * / and bit operations, always in the same order, so that the torch
// twin (ops/reference/exact.py), the CPU and the GPU agree to the last bit. Series: Abramowitz and Stegun, "Handbook of
// Mathematical Functions", 1964, 4.1.27 (logarithm by atanh) and 4.2.1 (exponential).
#pragma once

#include <type_traits>

#include "base/hd.h"
#ifndef __CUDACC__
#include "base/simd.h"
#endif

namespace gvtorch::GV_NAMESPACE {

template <class T>
struct LanesOf {
  using Real = T;
  using Int = int32_t;
  using UInt = uint32_t;  // sums wrap
  using Bits = std::conditional_t<sizeof(T) == sizeof(int64_t), int64_t, int32_t>;
  using Mask = bool;
  using Pointer = T*;
  static constexpr bool kPacket = false;
  static GV_HD bool all() { return true; }
};

template <class T>
GV_HD T select(bool mask, T a, T b) {
  return mask ? a : b;
}
GV_HD bool any(bool mask) { return mask; }
template <class Body>
GV_HD void for_lanes(bool mask, const Body& body) {
  if (mask) body(0);
}
template <class T>
GV_HD T lane_of(T value, int) {
  return value;
}
template <class T>
GV_HD void set_lane(T& value, int, T lane_value) {
  value = lane_value;
}
// The smallest value among the threads of a warp that run this together; values are not negative. On the CPU, and on
// GPUs before compute capability 8.0, which have no such instruction, the thread's own value.
GV_HD float warp_minimum(float value) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  return __uint_as_float(__reduce_min_sync(__activemask(), __float_as_uint(value)));
#else
  return value;
#endif
}
GV_HD double warp_minimum(double value) { return value; }
template <class T>
GV_HD T pick(const T* table, int32_t index) {
  return table[index];
}

// The same number in every lane. Subtracting 0 changes no bit.
template <class T, class Number>
GV_HD T broadcast(Number value) {
  return value - T{};
}
// A whole number as a T.
template <class T>
GV_HD T to_real(int32_t value) {
  return static_cast<T>(value);
}
template <class T>
GV_HD int32_t truncated(T value) {
  return static_cast<int32_t>(value);
}
template <class T>
GV_HD T square_root(T value) {
  return sqrt(value);
}

// If one of two is NaN, rays and packets return the same one of them. `clamp` turns NaN into the lower bound, so that
// an index made from the result is always valid.
template <class T>
GV_HD T smaller(T a, T b) {
  return b < a ? b : a;
}
template <class T>
GV_HD T larger(T a, T b) {
  return b > a ? b : a;
}
template <class T>
GV_HD T clamp(T value, T low, T high) {
#ifdef __CUDA_ARCH__
  if constexpr (static_cast<T>(0.5) != 0) return fmin(fmax(value, low), high);
#endif
  const T raised = value > low ? value : low;
  return raised < high ? raised : high;
}

#ifndef __CUDACC__
struct LanePointers {
  float* lane[kLanes];
};

template <>
struct LanesOf<Floats> {
  using Real = float;
  using Int = Ints;
  using UInt = UInts;
  using Bits = Ints;
  using Mask = Ints;
  using Pointer = LanePointers;
  static constexpr bool kPacket = true;
  static GV_HD Ints all() { return Ints{} == 0; }
};

template <>
struct LanesOf<Doubles> {
  using Real = double;
  using Int = Longs;
  using Bits = Longs;
  using Mask = Longs;
};

GV_HD Doubles select(Longs mask, Doubles a, Doubles b) { return mask ? a : b; }
GV_HD Longs select(Longs mask, Longs a, Longs b) { return mask ? a : b; }
GV_HD Floats select(Mask mask, Floats a, Floats b) { return mask ? a : b; }
GV_HD Ints select(Mask mask, Ints a, Ints b) { return mask ? a : b; }
GV_HD float lane_of(Floats value, int lane) { return value[lane]; }
GV_HD int32_t lane_of(Ints value, int lane) { return value[lane]; }
GV_HD float* lane_of(const LanePointers& pointers, int lane) { return pointers.lane[lane]; }
GV_HD void set_lane(Floats& value, int lane, float lane_value) { value[lane] = lane_value; }
GV_HD void set_lane(Ints& value, int lane, int32_t lane_value) { value[lane] = lane_value; }
GV_HD void set_lane(Ints& mask, int lane, bool lane_value) { mask[lane] = lane_value ? -1 : 0; }
GV_HD void set_lane(LanePointers& pointers, int lane, float* lane_value) { pointers.lane[lane] = lane_value; }
template <class T>
GV_HD Vec3<float> lane_of(const Vec3<T>& value, int lane) {
  return {lane_of(value.x, lane), lane_of(value.y, lane), lane_of(value.z, lane)};
}
template <class T>
GV_HD void set_lane(Vec3<T>& value, int lane, const Vec3<float>& lane_value) {
  for (int axis = 0; axis < 3; ++axis) set_lane(value[axis], lane, lane_value[axis]);
}

template <class T>
GV_HD T to_real(Ints value) {
  return to_floats(value);
}
template <class T>
GV_HD T to_real(Longs value) {
  return __builtin_convertvector(value, T);
}
GV_HD Floats clamp(Floats value, Floats low, Floats high) { return smaller(high, larger(low, value)); }
GV_HD Floats clamp(Floats value, float low, float high) {
  return clamp(value, broadcast<Floats>(low), broadcast<Floats>(high));
}
#endif

template <class T>
using RealOf = typename LanesOf<T>::Real;
template <class T>
using IntOf = typename LanesOf<T>::Int;
template <class T>
using UIntOf = typename LanesOf<T>::UInt;
template <class T>
using MaskOf = typename LanesOf<T>::Mask;
template <class T>
GV_HD MaskOf<T> all_lanes() {
  return LanesOf<T>::all();
}
template <class T>
constexpr bool kPacket = LanesOf<T>::kPacket;

// Defines a struct's `each_member`, which calls body(a's member, b's member) for each member that a lane's
// copy needs. `calls`: GV_BOTH(member) of each, and each_member(a, b, body) of its base.
#define GV_BOTH(member) body(a.member, b.member);
#define GV_EACH_MEMBER(calls)                                   \
  template <class A, class B, class Body>                       \
  GV_HD static void each_member(A& a, B& b, const Body& body) { \
    calls                                                       \
  }

// Copies one lane out of a struct of all lanes, and back.
template <class Lane, class Lanes>
GV_HD Lane take_lane(const Lanes& lanes, int lane) {
  Lane result;
  Lanes::each_member(lanes, result, [&](const auto& member, auto& out) { out = lane_of(member, lane); });
  return result;
}
template <class Lanes, class Lane>
GV_HD void put_lane(Lanes& lanes, int lane, const Lane& lane_struct) {
  Lanes::each_member(lanes, lane_struct, [&](auto& member, const auto& in) { set_lane(member, lane, in); });
}

template <class T>
GV_HD T absolute(T value) {
  return larger(value, -value);
}
// The value clamped to [0, 1].
template <class T>
GV_HD T saturate(T value) {
  return clamp(value, static_cast<RealOf<T>>(0), static_cast<RealOf<T>>(1));
}

// floor of a value that fits an int32; lanes that are not used may hold any value. Without SSE4.1 (the baseline of
// x86-64) std::floor is a call.
template <class T>
GV_HD IntOf<T> floor_int(T value) {
  const IntOf<T> integer = truncated(value);
  return select(to_real<T>(integer) > value, bit_cast<IntOf<T>>(bit_cast<UIntOf<T>>(integer) - 1u), integer);
}

// Base-2 logarithm of a positive, normal float.
template <class T>
GV_HD T log2_exact(T value) {
  const auto bits = bit_cast<IntOf<T>>(value);
  const T fraction = bit_cast<T>((bits & 0x007fffff) | 0x3f800000);
  const auto large = fraction > 1.41421356f;
  const T mantissa = select(large, fraction * 0.5f, fraction);
  const IntOf<T> power = (bits >> 23) - 127;
  const T exponent = to_real<T>(select(large, power + 1, power));
  const T s = (mantissa - 1.0f) / (mantissa + 1.0f);
  const T z = s * s;
  T series = broadcast<T>(0.320598898f);
  series = series * z + 0.412198583f;
  series = series * z + 0.577078016f;
  series = series * z + 0.961796694f;
  series = series * z + 2.885390082f;
  return exponent + series * s;
}

// (2^f - 1) / f for f in [-0.5, 0.5].
template <class T>
GV_HD T exp2_slope(T f) {
  T series = broadcast<T>(1.52527338e-5f);
  series = series * f + 1.54035304e-4f;
  series = series * f + 1.33335581e-3f;
  series = series * f + 9.61812911e-3f;
  series = series * f + 5.55041087e-2f;
  series = series * f + 2.40226507e-1f;
  return series * f + 6.93147181e-1f;
}

// 2 to the power of `value`: 0 at -126 and below, 2^126 above 126.
template <class T>
GV_HD T exp2_exact(T value) {
  const auto normal = value > -126.0f;
  if (!any(normal)) return T{};
  const T x = smaller(value, broadcast<T>(126.0f));
  const auto integer = floor_int(x + 0.5f);
  const T f = x - to_real<T>(integer);
  const T series = exp2_slope(f) * f + 1.0f;
  return select(normal, series * bit_cast<T>((bit_cast<UIntOf<T>>(integer) + 127u) << 23), T{});
}

// Splits a positive, normal number: it is the returned fraction, in [1/2, 1), times 2^power.
template <class T>
GV_HD T fraction_of(T value, IntOf<T>& power) {
  using Word = typename LanesOf<RealOf<T>>::Bits;
  constexpr bool kDouble = sizeof(Word) == sizeof(double);
  constexpr Word kFractionBits = kDouble ? 52 : 23, kHalfPower = kDouble ? 1022 : 126;
  const auto bits = bit_cast<typename LanesOf<T>::Bits>(value);
  power = static_cast<IntOf<T>>((bits >> kFractionBits) - kHalfPower);
  return bit_cast<T>((bits & ((Word{1} << kFractionBits) - 1)) | (kHalfPower << kFractionBits));
}

// A positive, normal number split for logarithms: the exponent of the nearest power of two, and the natural logarithm
// of the remaining factor, s * series.
template <class T>
struct LogParts {
  T exponent, s, series;
};
template <class T>
GV_HD LogParts<T> log_parts(T value) {
  using Real = RealOf<T>;
  IntOf<T> power;
  const T fraction = fraction_of(value, power);
  const auto large = fraction > static_cast<Real>(0.70710678);
  const T mantissa = select(large, fraction, fraction + fraction);
  const T exponent = to_real<T>(select(large, power, power - 1));
  const T s = (mantissa - static_cast<Real>(1)) / (mantissa + static_cast<Real>(1));
  const T z = s * s;
  T series = broadcast<T>(static_cast<Real>(2.0 / 19));
  for (int32_t odd = 17; odd > 0; odd -= 2) series = series * z + static_cast<Real>(2.0 / odd);
  return {exponent, s, series};
}

// Natural logarithm of a positive, normal number, in both precisions; infinity and NaN are returned as they are.
template <class T>
GV_HD T log_exact(T value) {
  using Real = RealOf<T>;
  const LogParts<T> parts = log_parts(value);
  const T logarithm = parts.exponent * static_cast<Real>(0.6931471805599453) + parts.s * parts.series;
  return select(value < static_cast<Real>(INFINITY), logarithm, value);
}

// The base-2 logarithm, and powers of two, in float64, by longer series.
GV_HD double log2_exact(double value) {
  const LogParts<double> parts = log_parts(value);
  return parts.exponent + parts.series * parts.s * 1.4426950408889634;
}
GV_HD double exp2_slope(double f) {
  constexpr double kSeries[] = {6.778726354822545e-14,  1.3691488853904128e-12, 2.5678435993488206e-11,
                                4.4455382718708116e-10, 7.054911620801123e-09,  1.01780860092397e-07,
                                1.321548679014431e-06,  1.5252733804059841e-05, 0.0001540353039338161,
                                0.0013333558146428443,  0.009618129107628477,   0.05550410866482158,
                                0.24022650695910072,    0.6931471805599453};
  double series = kSeries[0];
  for (int term = 1; term < 14; ++term) series = series * f + kSeries[term];
  return series;
}
GV_HD double exp2_exact(double value) {
  if (!(value > -1022.0)) return 0;
  const double x = smaller(value, 1022.0);
  const int32_t integer = floor_int(x + 0.5);
  const double f = x - integer;
  return (exp2_slope(f) * f + 1.0) * bit_cast<double>(static_cast<int64_t>(integer + 1023) << 52);
}

// A range of indices, clamped to [0, count] whatever `ends` holds.
struct Span {
  int64_t begin, end;

  GV_HD Span(const int64_t* ends, int64_t count)
      : begin(clamp<int64_t>(ends[0], 0, count)), end(clamp<int64_t>(ends[1], 0, count)) {}
};

// The share of light absorbed after `halvings` halvings: 1 - 2^-halvings, without cancellation where that is small.
template <class T>
GV_HD T absorbed_by(T halvings) {
  const auto thin = halvings < static_cast<RealOf<T>>(0.5);
  return select(thin, exp2_slope(-halvings) * halvings, 1 - exp2_exact(-halvings));
}

}  // namespace gvtorch::GV_NAMESPACE
