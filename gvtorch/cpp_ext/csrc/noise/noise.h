// Noise of one frequency at a point: gradient, value, simplex and cellular noise. Twin and sources:
// ops/reference/noise.py, with the same order of operations. T is as in arithmetic.h: one point, or one in each lane.
#pragma once

#include <type_traits>

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch {

enum class NoiseKind : int32_t { kPerlin, kValue, kSimplex, kNearest, kSecond, kApart, kCount };

// Salts are 32 bits; a period of 0 means none; jitter and reach are for cellular noise. In scope for the limits:
// points
#define GV_NOISE(X)                     \
  X(Reals, point_pn, args.axes* points) \
  X(Int, kind, kNoiseKinds)             \
  X(Count, salt_x, kAny)                \
  X(Count, salt_y, kAny)                \
  X(Count, salt_z, kAny)                \
  X(Int, period_x, kAny)                \
  X(Int, period_y, kAny)                \
  X(Int, period_z, kAny)                \
  X(Float, jitter, kAny)                \
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
  using UInt = UIntOf<T>;
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
  static GV_HD UInt shifted(UInt bits, int by) { return (UInt)((Signed)bits >> by); }
  // A float's bits as a T.
  static GV_HD T from_bits(UInt bits) {
    if constexpr (sizeof(T) == sizeof(UInt)) return bit_cast<T>(bits);
    if constexpr (sizeof(T) != sizeof(UInt)) return static_cast<T>(bit_cast<float>(bits));
  }
  static GV_HD T to_real_signed(UInt bits) { return to_real<T>((Signed)bits); }

  GV_HD UInt scramble(UInt lattice, int axis) const {
    UInt bits = (lattice ^ salt[axis]) * kFirstFactor;
    bits = (bits ^ shifted(bits, 15)) * kSecondFactor;
    return bits ^ shifted(bits, 13);
  }
  static GV_HD UInt join(UInt first, UInt second) {
    const UInt bits = (first ^ second) * kFirstFactor;
    return (bits ^ shifted(bits, 15)) * kSecondFactor;
  }
  static GV_HD UInt wrapped(UInt lattice, int32_t every) {
    if (every == 0) return lattice;
    const Signed remainder = (Signed)lattice % every;
    return (UInt)(remainder < 0 ? remainder + every : remainder);
  }
  // Adding 0 turns -0 into 0.
  static GV_HD T offset_from(T position, Signed floor) { return position - to_real<T>(floor) + static_cast<Real>(0); }

  // --- Gradients

  // A gradient of two components of 1 or -1 and one of 0, chosen by `bits`.
  static GV_HD Vec3<T> slope(UInt bits) {
    const UInt third = shifted(bits, 8);
    const UInt is_x = ~shifted(third + kThird, 31), is_z = ~shifted(kThird - third, 31);
    const UInt first = ((bits << 25) & kTopBit) | kOneBits, second = ((bits << 24) & kTopBit) | kOneBits;
    const UInt x = first & is_x, z = second & is_z;
    return {from_bits(x), from_bits((first ^ x) | (second ^ z)), from_bits(z)};
  }
  static GV_HD T ramp(UInt bits, const T* away) {
    const Vec3<T> gradient = slope(bits);
    const T total = gradient.x * away[0] + gradient.y * away[1];
    if constexpr (N == 2) return total;
    if constexpr (N == 3) return total + gradient.z * away[2];
  }
  static GV_HD T fade(T t) {
    const T inner = (t * static_cast<Real>(6) - static_cast<Real>(15)) * t + static_cast<Real>(10);
    return t * t * t * inner;
  }

  // --- Kinds

  // A coordinate, or 0 from 2^29 on, where cells, those of the skewed lattice too, might not be counted in 32 bits.
  static GV_HD T bounded(T coordinate) {
    constexpr auto kMaxCoordinate = static_cast<Real>(0x1p29);
    const T zero{};
    return select(coordinate >= kMaxCoordinate, zero, select(coordinate <= -kMaxCoordinate, zero, coordinate));
  }

  // Interpolates corner(bits, away) between the 2^N corners of the point's cell.
  template <class Corner>
  GV_HD T between(const T* position, const Corner& corner) const {
    UInt end[3][2];
    T offset[3][2], weight[3];
    for (int axis = 0; axis < N; ++axis) {
      const Signed floor = floor_int(position[axis]);
      offset[axis][0] = offset_from(position[axis], floor);
      offset[axis][1] = offset[axis][0] - static_cast<Real>(1);
      weight[axis] = fade(offset[axis][0]);
      end[axis][0] = scramble(wrapped((UInt)floor, period[axis]), axis);
      end[axis][1] = scramble(wrapped((UInt)floor + 1u, period[axis]), axis);
    }
    T along_z[2];
    for (int z = 0; z < N - 1; ++z) {
      T along_y[2];
      for (int y = 0; y < 2; ++y) {
        T along_x[2];
        for (int x = 0; x < 2; ++x) {
          UInt bits = join(end[0][x], end[1][y]);
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

  GV_HD T perlin(const T* position) const {
    return between(position, [](UInt bits, const T* away) { return ramp(bits, away); });
  }
  GV_HD T value(const T* position) const {
    return between(position, [](UInt bits, const T*) { return to_real_signed(bits) * static_cast<Real>(0x1p-31); });
  }

  GV_HD UInt simplex_hash(UInt* lattice) const {
    if constexpr (N == 3) {
      const UInt total = lattice[0] + lattice[1] + lattice[2];
      for (int axis = 0; axis < 3; ++axis) lattice[axis] = wrapped(6u * lattice[axis] - total, 6 * period[axis]);
    }
    UInt bits = scramble(lattice[0], 0);
    for (int axis = 1; axis < N; ++axis) bits = join(bits, scramble(lattice[axis], axis));
    return bits;
  }
  GV_HD T simplex(const T* position) const {
    constexpr double kSkew = N == 2 ? 0.3660254037844386 : 1 / 3.0;
    constexpr double kUnskew = N == 2 ? 0.21132486540518713 : 1 / 6.0;
    constexpr double kScale = N == 2 ? 70.148 : 76.880;
    T skew = position[0], unskew = T{}, offset[3];
    for (int axis = 1; axis < N; ++axis) skew = skew + position[axis];
    skew = skew * static_cast<Real>(kSkew);
    Signed floor[3], rank[3];
    for (int axis = 0; axis < N; ++axis) {
      floor[axis] = floor_int(position[axis] + skew);
      unskew = axis == 0 ? to_real<T>(floor[0]) : unskew + to_real<T>(floor[axis]);
      rank[axis] = Signed{};
    }
    unskew = unskew * static_cast<Real>(kUnskew);
    for (int axis = 0; axis < N; ++axis) offset[axis] = position[axis] - (to_real<T>(floor[axis]) - unskew);
    for (int i = 0; i < N; ++i) {
      for (int j = i + 1; j < N; ++j) {
        const Signed above = select(offset[i] >= offset[j], Signed{} + 1, Signed{});
        rank[i] = rank[i] + above;
        rank[j] = rank[j] + (1 - above);
      }
    }
    T total{};
    for (int corner = 0; corner <= N; ++corner) {
      T away[N];
      UInt lattice[N];
      for (int axis = 0; axis < N; ++axis) {
        const Signed step = select(rank[axis] + corner >= N, Signed{} + 1, Signed{});  // 1 for the `corner` largest
        away[axis] = offset[axis] - to_real<T>(step) + static_cast<Real>(corner * kUnskew);
        lattice[axis] = (UInt)floor[axis] + (UInt)step;
      }
      T square = away[0] * away[0];
      for (int axis = 1; axis < N; ++axis) square = square + away[axis] * away[axis];
      const T difference = static_cast<Real>(0.5) - square, zero{};
      const T falloff = select(difference < zero, zero, difference);
      total = total + falloff * falloff * (falloff * falloff) * ramp(simplex_hash(lattice), away);
    }
    return total * static_cast<Real>(kScale);
  }

  GV_HD T cellular(const T* position, NoiseKind feature) const {
    constexpr int kMaxSteps = 5;
    UInt end[3][kMaxSteps];
    T low[3][kMaxSteps], unknown{};
    const int steps = 2 * reach + 1;
    const auto spread = static_cast<Real>(jitter / 1023);
    for (int axis = 0; axis < N; ++axis) {
      const Signed floor = floor_int(position[axis]);
      const T offset = offset_from(position[axis], floor);
      unknown = unknown + offset * static_cast<Real>(0);
      const T least = static_cast<Real>(0.5 * (1 - jitter)) - offset;
      for (int step = 0; step < steps; ++step) {
        end[axis][step] = scramble(wrapped((UInt)floor + static_cast<uint32_t>(step - reach), period[axis]), axis);
        low[axis][step] = least + static_cast<Real>(step - reach);
      }
    }
    T first = T{} + static_cast<Real>(reach * reach), second = first;
    for (int z = 0; z < (N == 3 ? steps : 1); ++z) {
      for (int y = 0; y < steps; ++y) {
        const UInt row = N == 3 ? join(end[N - 1][z], end[1][y]) : end[1][y];
        for (int x = 0; x < steps; ++x) {
          const UInt bits = join(row, end[0][x]);
          const int cell[3] = {x, y, z};
          T square{};
          for (int axis = 0; axis < N; ++axis) {
            const T random_offset = to_real_signed(shifted(bits, 2 + 10 * axis) & 1023u);
            const T distance = random_offset * spread + low[axis][cell[axis]];
            square = square + distance * distance;
          }
          second = smaller(second, larger(first, square));
          first = smaller(first, square);
        }
      }
    }
    // `unknown` is NaN where a coordinate is NaN, else 0.
    const T nearest = square_root(first) + unknown, second_nearest = square_root(second) + unknown;
    return feature == NoiseKind::kNearest  ? nearest
           : feature == NoiseKind::kSecond ? second_nearest
                                           : second_nearest - nearest;
  }

  template <NoiseKind kKind>
  GV_HD T make(const T* position) const {
    if constexpr (kKind == NoiseKind::kPerlin) return perlin(position);
    if constexpr (kKind == NoiseKind::kValue) return value(position);
    if constexpr (kKind == NoiseKind::kSimplex) return simplex(position);
    if constexpr (kKind >= NoiseKind::kNearest) return cellular(position, kKind);
  }
};

// Calls body(kind, axes), both as compile-time constants; the kind is kFirst or one of those after it.
template <NoiseKind kFirst = NoiseKind::kPerlin, class Body>
void with_noise(const NoiseArgs& args, const Body& body) {
  constexpr auto kNext = static_cast<NoiseKind>(static_cast<int32_t>(kFirst) + 1);
  if constexpr (kNext != NoiseKind::kCount) {
    if (args.kind != static_cast<int32_t>(kFirst)) return with_noise<kNext>(args, body);
  }
  const std::integral_constant<NoiseKind, kFirst> kind{};
  if (args.axes == 2) return body(kind, std::integral_constant<int, 2>{});
  body(kind, std::integral_constant<int, 3>{});
}

// An index is a point.
template <class T, NoiseKind kKind, int N>
struct MakeNoise {
  NoiseArgs args;

  GV_HD void operator()(int64_t index) const {
    const T* point = static_cast<const T*>(args.point_pn) + N * index;
    T position[N];
    for (int axis = 0; axis < N; ++axis) position[axis] = NoiseAt<T, N>::bounded(point[axis]);
    static_cast<T*>(args.value_p)[index] = NoiseAt<T, N>(args).template make<kKind>(position);
  }
};

#ifndef __CUDACC__
// Makes the noise of the float32 points begin to end, a vector of them at a time.
template <NoiseKind kKind, int N>
void noise_in_lanes(const NoiseArgs& args, int64_t begin, int64_t end) {
  const NoiseAt<Floats, N> noise(args);
  for (int64_t index = begin; index < end; index += kLanes) {
    const int64_t count = end - index < kLanes ? end - index : kLanes;
    const float* point = static_cast<const float*>(args.point_pn) + N * index;
    float last[N * kLanes] = {}, value[kLanes];
    if (count < kLanes) {
      memcpy(last, point, static_cast<size_t>(N * count) * sizeof(float));
      point = last;
    }
    Floats position[N];
    for (int axis = 0; axis < N; ++axis) position[axis] = noise.bounded(pick(point + axis, N * lane_numbers()));
    const Floats values = noise.template make<kKind>(position);
    memcpy(value, &values, sizeof(value));
    memcpy(static_cast<float*>(args.value_p) + index, value, static_cast<size_t>(count) * sizeof(float));
  }
}
#endif

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
