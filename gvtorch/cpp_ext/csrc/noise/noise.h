// Noise of one frequency at a point: gradient, value, simplex and cellular noise. Twin and sources:
// ops/reference/noise.py, with the same order of operations. T is as in arithmetic.h: one point, or one in each lane.
#pragma once

#include <type_traits>

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch {

enum class NoiseKind : int32_t { kPerlin, kValue, kSimplex, kNearest, kSecond, kApart, kCount };

// Sizes in limits: points, axes. Salts are 32 bits; a period of 0 means none; jitter and reach are for cellular noise.
#define GV_NOISE(X)                \
  X(Reals, point_pn, axes* points) \
  X(Int, kind, kNoiseKinds)        \
  X(Count, salt_x, kAny)           \
  X(Count, salt_y, kAny)           \
  X(Count, salt_z, kAny)           \
  X(Int, period_x, kAny)           \
  X(Int, period_y, kAny)           \
  X(Int, period_z, kAny)           \
  X(Float, jitter, kAny)           \
  X(Int, reach, 3)

constexpr int64_t kNoiseKinds = static_cast<int64_t>(NoiseKind::kCount);

struct NoiseArgs {
  GV_NOISE(GV_VIEW)
  int32_t axes;
  void* value_p;
};

inline namespace GV_NAMESPACE {

constexpr uint32_t kFirstFactor = 0x2C1B3C6D, kSecondFactor = 0x297A2D39;
constexpr uint32_t kThird = 2796203;  // 2^23 / 3
constexpr uint32_t kTopBit = 0x80000000, kOneBits = 0x3F800000;

// The noise of points of N coordinates.
template <class T, int N>
struct NoiseAt {
  using Words = WordOf<T>;
  using Signed = IntOf<T>;
  using Real = RealOf<T>;

  uint32_t salt[3];
  int32_t period[3];
  double jitter;
  int32_t reach;

  GV_HD explicit NoiseAt(const NoiseArgs& args)
      : salt{static_cast<uint32_t>(args.salt_x), static_cast<uint32_t>(args.salt_y),
             static_cast<uint32_t>(args.salt_z)},
        period{args.period_x, args.period_y, args.period_z},
        jitter(args.jitter),
        reach(args.reach) {}

  // --- The lattice

  // A shift that keeps the sign.
  static GV_HD Words shifted(Words bits, int by) { return (Words)((Signed)bits >> by); }
  // A float's bits as a T.
  static GV_HD T from_bits(Words bits) {
    if constexpr (sizeof(T) == sizeof(Words)) return bit_cast<T>(bits);
    if constexpr (sizeof(T) != sizeof(Words)) return static_cast<T>(bit_cast<float>(bits));
  }
  static GV_HD T to_real_signed(Words bits) { return to_real<T>((Signed)bits); }

  GV_HD Words scramble(Words lattice, int axis) const {
    Words bits = (lattice ^ salt[axis]) * kFirstFactor;
    bits = (bits ^ shifted(bits, 15)) * kSecondFactor;
    return bits ^ shifted(bits, 13);
  }
  static GV_HD Words join(Words first, Words second) {
    const Words bits = (first ^ second) * kFirstFactor;
    return (bits ^ shifted(bits, 15)) * kSecondFactor;
  }
  static GV_HD Words wrapped(Words lattice, int32_t every) {
    if (every == 0) return lattice;
    const Signed left = (Signed)lattice % every;
    return (Words)(left < 0 ? left + every : left);
  }
  // Adding 0 turns -0 into 0.
  static GV_HD T offset_from(T place, Signed floor) { return place - to_real<T>(floor) + static_cast<Real>(0); }

  // --- Gradients

  // A gradient of two components of 1 or -1 and one of 0, chosen by `bits`.
  struct Slope {
    T x, y, z;
  };
  static GV_HD Slope slope(Words bits) {
    const Words third = shifted(bits, 8);
    const Words is_x = ~shifted(third + kThird, 31), is_z = ~shifted(kThird - third, 31);
    const Words first = ((bits << 25) & kTopBit) | kOneBits, second = ((bits << 24) & kTopBit) | kOneBits;
    const Words x = first & is_x, z = second & is_z;
    return {from_bits(x), from_bits((first ^ x) | (second ^ z)), from_bits(z)};
  }
  static GV_HD T ramp(Words bits, const T* away) {
    const Slope own = slope(bits);
    const T total = own.x * away[0] + own.y * away[1];
    if constexpr (N == 2) return total;
    if constexpr (N == 3) return total + own.z * away[2];
  }
  static GV_HD T fade(T t) {
    const T inner = (t * static_cast<Real>(6) - static_cast<Real>(15)) * t + static_cast<Real>(10);
    return t * t * t * inner;
  }

  // --- Kinds

  // A coordinate, or 0 from 2^29 on, where cells, those of the skewed lattice too, might not be counted in 32 bits.
  static GV_HD T counted(T place) {
    constexpr auto kMost = static_cast<Real>(0x1p29);
    const T none{};
    return select(place >= kMost, none, select(place <= -kMost, none, place));
  }

  // Interpolates corner(bits, away) between the 2^N corners of the point's cell.
  template <class Corner>
  GV_HD T between(const T* place, const Corner& corner) const {
    Words end[3][2];
    T offset[3][2], weight[3];
    for (int axis = 0; axis < N; ++axis) {
      const Signed floor = floor_int(place[axis]);
      offset[axis][0] = offset_from(place[axis], floor);
      offset[axis][1] = offset[axis][0] - static_cast<Real>(1);
      weight[axis] = fade(offset[axis][0]);
      end[axis][0] = scramble(wrapped((Words)floor, period[axis]), axis);
      end[axis][1] = scramble(wrapped((Words)floor + 1u, period[axis]), axis);
    }
    T along_z[2];
    for (int z = 0; z < N - 1; ++z) {
      T along_y[2];
      for (int y = 0; y < 2; ++y) {
        T along_x[2];
        for (int x = 0; x < 2; ++x) {
          Words bits = join(end[0][x], end[1][y]);
          T away[3] = {offset[0][x], offset[1][y], T{}};
          if constexpr (N == 3) {
            bits = join(bits, end[2][z]);
            away[2] = offset[2][z];
          }
          along_x[x] = corner(bits, away);
        }
        along_y[y] = along_x[0] + weight[0] * (along_x[1] - along_x[0]);
      }
      along_z[z] = along_y[0] + weight[1] * (along_y[1] - along_y[0]);
    }
    if constexpr (N == 2) return along_z[0];
    if constexpr (N == 3) return along_z[0] + weight[2] * (along_z[1] - along_z[0]);
  }

  GV_HD T perlin(const T* place) const {
    return between(place, [](Words bits, const T* away) { return ramp(bits, away); });
  }
  GV_HD T value(const T* place) const {
    return between(place, [](Words bits, const T*) { return to_real_signed(bits) * static_cast<Real>(0x1p-31); });
  }

  GV_HD Words simplex_hash(Words* place) const {
    if constexpr (N == 3) {
      const Words total = place[0] + place[1] + place[2];
      for (int axis = 0; axis < 3; ++axis) place[axis] = wrapped(6u * place[axis] - total, 6 * period[axis]);
    }
    Words bits = scramble(place[0], 0);
    for (int axis = 1; axis < N; ++axis) bits = join(bits, scramble(place[axis], axis));
    return bits;
  }
  GV_HD T simplex(const T* place) const {
    constexpr double kSkew = N == 2 ? 0.3660254037844386 : 1 / 3.0;
    constexpr double kUnskew = N == 2 ? 0.21132486540518713 : 1 / 6.0;
    constexpr double kScale = N == 2 ? 70.148 : 76.880;
    T skew = place[0], back = T{}, offset[3];
    for (int axis = 1; axis < N; ++axis) skew = skew + place[axis];
    skew = skew * static_cast<Real>(kSkew);
    Signed floor[3], rank[3];
    for (int axis = 0; axis < N; ++axis) {
      floor[axis] = floor_int(place[axis] + skew);
      back = axis == 0 ? to_real<T>(floor[0]) : back + to_real<T>(floor[axis]);
      rank[axis] = Signed{};
    }
    back = back * static_cast<Real>(kUnskew);
    for (int axis = 0; axis < N; ++axis) offset[axis] = place[axis] - (to_real<T>(floor[axis]) - back);
    for (int one = 0; one < N; ++one) {
      for (int other = one + 1; other < N; ++other) {
        const Signed above = select(offset[one] >= offset[other], Signed{} + 1, Signed{});
        rank[one] = rank[one] + above;
        rank[other] = rank[other] + (1 - above);
      }
    }
    T total{};
    for (int corner = 0; corner <= N; ++corner) {
      T away[N];
      Words at[N];
      for (int axis = 0; axis < N; ++axis) {
        const Signed step = select(rank[axis] + corner >= N, Signed{} + 1, Signed{});  // 1 for the `corner` largest
        away[axis] = offset[axis] - to_real<T>(step) + static_cast<Real>(corner * kUnskew);
        at[axis] = (Words)floor[axis] + (Words)step;
      }
      T square = away[0] * away[0];
      for (int axis = 1; axis < N; ++axis) square = square + away[axis] * away[axis];
      const T left = static_cast<Real>(0.5) - square, none{};
      const T near = select(left < none, none, left);
      total = total + near * near * (near * near) * ramp(simplex_hash(at), away);
    }
    return total * static_cast<Real>(kScale);
  }

  GV_HD T cellular(const T* place, NoiseKind feature) const {
    constexpr int kMost = 5;
    Words end[3][kMost];
    T low[3][kMost], unknown{};
    const int steps = 2 * reach + 1;
    const auto spread = static_cast<Real>(jitter / 1023);
    for (int axis = 0; axis < N; ++axis) {
      const Signed floor = floor_int(place[axis]);
      const T offset = offset_from(place[axis], floor);
      unknown = unknown + offset * static_cast<Real>(0);
      const T least = static_cast<Real>(0.5 * (1 - jitter)) - offset;
      for (int step = 0; step < steps; ++step) {
        end[axis][step] = scramble(wrapped((Words)floor + static_cast<uint32_t>(step - reach), period[axis]), axis);
        low[axis][step] = least + static_cast<Real>(step - reach);
      }
    }
    T first = T{} + static_cast<Real>(reach * reach), second = first;
    for (int z = 0; z < (N == 3 ? steps : 1); ++z) {
      for (int y = 0; y < steps; ++y) {
        const Words row = N == 3 ? join(end[N - 1][z], end[1][y]) : end[1][y];
        for (int x = 0; x < steps; ++x) {
          const Words bits = join(row, end[0][x]);
          const int at[3] = {x, y, z};
          T square{};
          for (int axis = 0; axis < N; ++axis) {
            const T stray = to_real_signed(shifted(bits, 2 + 10 * axis) & 1023u);
            const T distance = stray * spread + low[axis][at[axis]];
            square = square + distance * distance;
          }
          second = smaller(second, larger(first, square));
          first = smaller(first, square);
        }
      }
    }
    // `unknown` is NaN where a coordinate is NaN, else 0.
    const T near = square_root(first) + unknown, next = square_root(second) + unknown;
    return feature == NoiseKind::kNearest ? near : feature == NoiseKind::kSecond ? next : next - near;
  }

  template <NoiseKind kKind>
  GV_HD T make(const T* place) const {
    if constexpr (kKind == NoiseKind::kPerlin) return perlin(place);
    if constexpr (kKind == NoiseKind::kValue) return value(place);
    if constexpr (kKind == NoiseKind::kSimplex) return simplex(place);
    if constexpr (kKind >= NoiseKind::kNearest) return cellular(place, kKind);
  }
};

// Calls body(kind, axes), both as compile-time constants.
template <class Body>
void with_noise(const NoiseArgs& args, const Body& body) {
  const auto with_axes = [&](auto kind) {
    if (args.axes == 2) return body(kind, std::integral_constant<int, 2>{});
    return body(kind, std::integral_constant<int, 3>{});
  };
  switch (static_cast<NoiseKind>(args.kind)) {
    case NoiseKind::kPerlin:
      return with_axes(std::integral_constant<NoiseKind, NoiseKind::kPerlin>{});
    case NoiseKind::kValue:
      return with_axes(std::integral_constant<NoiseKind, NoiseKind::kValue>{});
    case NoiseKind::kSimplex:
      return with_axes(std::integral_constant<NoiseKind, NoiseKind::kSimplex>{});
    case NoiseKind::kNearest:
      return with_axes(std::integral_constant<NoiseKind, NoiseKind::kNearest>{});
    case NoiseKind::kSecond:
      return with_axes(std::integral_constant<NoiseKind, NoiseKind::kSecond>{});
    default:
      return with_axes(std::integral_constant<NoiseKind, NoiseKind::kApart>{});
  }
}

// An index is a point.
template <class T, NoiseKind kKind, int N>
struct MakeNoise {
  NoiseArgs args;

  GV_HD void operator()(int64_t index) const {
    const T* point = static_cast<const T*>(args.point_pn) + N * index;
    T place[N];
    for (int axis = 0; axis < N; ++axis) place[axis] = NoiseAt<T, N>::counted(point[axis]);
    static_cast<T*>(args.value_p)[index] = NoiseAt<T, N>(args).template make<kKind>(place);
  }
};

#ifndef __CUDACC__
// Makes the noise of the float32 points begin to end, a vector of them at a time.
template <NoiseKind kKind, int N>
void noise_in_lanes(const NoiseArgs& args, int64_t begin, int64_t end) {
  const NoiseAt<Floats, N> noise(args);
  for (int64_t index = begin; index < end; index += kLanes) {
    const int64_t some = end - index < kLanes ? end - index : kLanes;
    const float* point = static_cast<const float*>(args.point_pn) + N * index;
    float last[N * kLanes] = {}, value[kLanes];
    if (some < kLanes) {
      memcpy(last, point, static_cast<size_t>(N * some) * sizeof(float));
      point = last;
    }
    Floats at[N];
    for (int axis = 0; axis < N; ++axis) at[axis] = noise.counted(pick(point + axis, N * lane_numbers()));
    const Floats found = noise.template make<kKind>(at);
    memcpy(value, &found, sizeof(value));
    memcpy(static_cast<float*>(args.value_p) + index, value, static_cast<size_t>(some) * sizeof(float));
  }
}
#endif

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
