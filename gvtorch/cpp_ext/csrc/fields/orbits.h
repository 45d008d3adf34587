// Orbits of escape-time fractals: of points, and of balls of points. Twin and sources: ops/reference/orbits.py, with
// the same order of operations. T is as in arithmetic.h: one point, or one in each lane.
#pragma once

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch {

enum class StepKind : int32_t { kPower, kFold, kCount };

// The parameters of orbits. `amount`: n of z^n, or the Mandelbox's scale; `julia`: each step adds constant_3, else the
// point's own position.
#define GV_ORBIT(X)                                    \
  X(Reals, constant_3, 3)                              \
  X(Reals, bailout_1, 1)                               \
  X(Int, kind, static_cast<int64_t>(StepKind::kCount)) \
  X(Float, amount, kAny)                               \
  X(Int, iterations, kAny)                             \
  X(Bool, julia, kAny)

#define GV_ORBITS(X) X(Reals, point_p3, 3 * args.points) GV_ORBIT(X)
#define GV_ORBIT_BOUNDS(X) X(Reals, center_k3, 3 * args.balls) X(Reals, reach_k, args.balls) GV_ORBIT(X)

struct OrbitArgs {
  GV_ORBITS(GV_VIEW)
  int64_t points;
  bool in_float64;  // else in float32
  void* result_3p;  // distance; the orbit's least distance from the origin, and from a coordinate plane
};

struct OrbitBoundsArgs {
  GV_ORBIT_BOUNDS(GV_VIEW)
  int64_t balls;
  void* ends_2k;
};

inline namespace GV_NAMESPACE {

constexpr double kDeepInside = 1, kLostBeyond = 1e3;  // INSIDE and FAR of the twin

template <class T>
GV_HD T from_planes(const Vec3<T>& z) {
  return smaller(smaller(absolute(z.x), absolute(z.y)), absolute(z.z));
}
template <class T>
GV_HD T number_of(double value) {
  return broadcast<T>(static_cast<RealOf<T>>(value));
}

// Calls body(whether it is set) for each bit of n below its highest set one, from high to low.
template <class Body>
GV_HD void for_bits(int32_t n, const Body& body) {
  int32_t bit = 1;
  while (bit <= n / 2) bit *= 2;
  while (bit > 1) {
    bit /= 2;
    body((n & bit) != 0);
  }
}
// value^n, for n >= 1.
template <class T>
GV_HD T product(T value, int32_t n) {
  T power = value;
  for_bits(n, [&](bool odd) {
    power = power * power;
    if (odd) power = power * value;
  });
  return power;
}
// The n-th power of a complex number.
template <class T>
GV_HD void complex_power(T& real, T& imaginary, int32_t n) {
  const T x = real, y = imaginary;
  for_bits(n, [&](bool odd) {
    const T a = (real - imaginary) * (real + imaginary), b = static_cast<RealOf<T>>(2) * real * imaginary;
    real = odd ? a * x - b * y : a;
    imaginary = odd ? a * y + b * x : b;
  });
}

// By how much a step stretches distances in a ball: `largest` between any two points; `low` to `high` between
// neighbours.
template <class T>
struct Stretch {
  T largest, low, high;
};

template <class T>
struct PowerStep {
  static constexpr bool kLogarithmic = true;
  int32_t n;

  GV_HD explicit PowerStep(double amount) : n(static_cast<int32_t>(amount)) {}
  GV_HD Vec3<T> operator()(const Vec3<T>& z, T& factor) const {
    const T axis_distance = square_root(larger(z.x * z.x + z.y * z.y, number_of<T>(1e-30)));
    const T radius = square_root(axis_distance * axis_distance + z.z * z.z);
    T cosine = z.x / axis_distance, sine = z.y / axis_distance, height = z.z, width = axis_distance;
    complex_power(cosine, sine, n);
    complex_power(height, width, n);
    factor = static_cast<RealOf<T>>(n) * product(radius, n - 1);
    return {width * cosine, width * sine, height};
  }
  GV_HD Stretch<T> stretch(const Vec3<T>& z, T reach) const {
    const T count = static_cast<T>(n), zero = 0, one = 1;
    const T axis_distance = square_root(z.x * z.x + z.y * z.y), radius = square_root(dot(z, z));
    const T inner_radius = larger(radius - reach, zero), outer_radius = radius + reach,
            safe_radius = larger(radius, number_of<T>(1e-30));
    const T ratio = smaller(reach / safe_radius, one);
    const T angle_change = ratio + static_cast<T>(0.5707963267948966) * (ratio * ratio * ratio);  // pi / 2 - 1
    T cosine = z.z / safe_radius, sine = axis_distance / safe_radius;
    complex_power(cosine, sine, n);
    const T sine_bound = absolute(sine) + count * angle_change;
    const T least_sine =
        larger(larger(axis_distance - reach, zero) / larger(outer_radius, number_of<T>(1e-30)), number_of<T>(1.0 / n));
    const T around = clamp(smaller(sine_bound, one) / least_sine, one, count);
    const T low = count * product(inner_radius, n - 1), high = count * product(outer_radius, n - 1);
    return {high * around, low, high};
  }
};

template <class T>
struct FoldStep {
  static constexpr bool kLogarithmic = false;
  RealOf<T> scale, size;

  GV_HD explicit FoldStep(double amount)
      : scale(static_cast<RealOf<T>>(amount)), size(static_cast<RealOf<T>>(amount < 0 ? -amount : amount)) {}
  GV_HD static Vec3<T> folded(const Vec3<T>& z) {
    Vec3<T> to;
    for (int axis = 0; axis < 3; ++axis) {
      to[axis] = static_cast<RealOf<T>>(2) * clamp(z[axis], number_of<T>(-1), number_of<T>(1)) - z[axis];
    }
    return to;
  }
  GV_HD Vec3<T> operator()(const Vec3<T>& z, T& factor) const {
    const Vec3<T> to = folded(z);
    const T inverted = static_cast<RealOf<T>>(1) / clamp(dot(to, to), number_of<T>(0.25), number_of<T>(1));
    const T scaled = inverted * scale;
    factor = inverted * size;
    return {to.x * scaled, to.y * scaled, to.z * scaled};
  }
  GV_HD Stretch<T> stretch(const Vec3<T>& z, T reach) const {
    const Vec3<T> to = folded(z);
    const T radius = square_root(dot(to, to)), half = number_of<T>(0.5), one = 1;
    const T near = clamp(radius - reach, half, one), far = clamp(radius + reach, half, one);
    const T high = size / (near * near);
    return {high, size / (far * far), high};
  }
};

// Estimates the distance from an orbit's radius and from how far (`separation`) neighbouring orbits have come apart.
template <class Step, class T>
GV_HD T estimate(T radius, T separation) {
  if constexpr (Step::kLogarithmic) return static_cast<RealOf<T>>(0.5) * radius * log_exact(radius) / separation;
  return radius / separation;
}

// Follows points. An index is a point.
template <class T, class Step>
struct FollowPoints {
  OrbitArgs args;

  GV_HD void follow(Vec3<T> z, T* result) const {
    using Real = RealOf<T>;
    const Real bailout = *static_cast<const Real*>(args.bailout_1), added_separation = args.julia ? 0 : 1;
    const auto* constants = static_cast<const Real*>(args.constant_3);
    Vec3<T> constant = z;
    for (int axis = 0; axis < 3; ++axis) {
      if (args.julia) constant[axis] = broadcast<T>(constants[axis]);
    }
    const Step step(args.amount);
    T radius = square_root(dot(z, z)), separation = number_of<T>(1), least_radius = radius, plane = from_planes(z);
    MaskOf<T> alive = radius <= bailout;
    for (int32_t iteration = 0; iteration < args.iterations && any(alive); ++iteration) {
      T factor;
      const Vec3<T> stepped = step(z, factor);
      for (int axis = 0; axis < 3; ++axis) z[axis] = select(alive, stepped[axis] + constant[axis], z[axis]);
      separation = select(alive, factor * separation + added_separation, separation);
      radius = square_root(dot(z, z));
      least_radius = smaller(least_radius, radius);
      plane = smaller(plane, from_planes(z));
      alive = radius <= bailout;
    }
    result[0] = select(alive, number_of<T>(-kDeepInside), estimate<Step>(radius, separation));
    result[1] = least_radius;
    result[2] = plane;
  }
  GV_HD void operator()(int64_t index) const {
    const T* point = static_cast<const T*>(args.point_p3) + 3 * index;
    T result[3];
    follow({point[0], point[1], point[2]}, result);
    for (int i = 0; i < 3; ++i) static_cast<T*>(args.result_3p)[i * args.points + index] = result[i];
  }
};

// Follows the centres of balls, and a radius within which the orbits of all points of a ball stay. An index is a ball.
template <class T, class Step>
struct FollowBalls {
  OrbitBoundsArgs args;

  GV_HD void operator()(int64_t index) const {
    const T* center = static_cast<const T*>(args.center_k3) + 3 * index;
    const auto* constants = static_cast<const T*>(args.constant_3);
    const T bailout = *static_cast<const T*>(args.bailout_1), first = static_cast<const T*>(args.reach_k)[index];
    const T infinity = static_cast<T>(INFINITY), deep = -kDeepInside;
    const Step step(args.amount);
    Vec3<T> z{center[0], center[1], center[2]};
    const Vec3<T> constant = args.julia ? Vec3<T>{constants[0], constants[1], constants[2]} : z;
    const T added_reach = args.julia ? T{} : first, added_separation = args.julia ? 0 : 1;
    T reach = first, low_separation = 1, high_separation = 1, low = infinity, high = -infinity;
    bool inside = true, diverged = false;  // inside: some orbit may be within the bailout radius
    for (int32_t iteration = 0;; ++iteration) {
      const T radius = square_root(dot(z, z)), inner_radius = larger(radius - reach, T{}),
              outer_radius = radius + reach;
      if (outer_radius > bailout) {
        low = smaller(low, estimate<Step>(larger(inner_radius, bailout), high_separation));
        high = larger(high, estimate<Step>(outer_radius, low_separation));
      }
      diverged = !(reach < static_cast<T>(kLostBeyond));
      inside = inner_radius <= bailout && !diverged;
      if (!inside || iteration == args.iterations) break;
      const Stretch<T> stretch = step.stretch(z, reach);
      T factor;
      const Vec3<T> stepped = step(z, factor);
      for (int axis = 0; axis < 3; ++axis) z[axis] = stepped[axis] + constant[axis];
      reach = stretch.largest * reach + added_reach;
      low_separation = stretch.low * low_separation + added_separation;
      high_separation = stretch.high * high_separation + added_separation;
    }
    auto* ends = static_cast<T*>(args.ends_2k);
    ends[index] = diverged ? deep : inside ? smaller(low, deep) : low;
    ends[args.balls + index] = diverged ? infinity : inside ? larger(high, deep) : high;
  }
};

// Calls body(Step*) with a null pointer, because steps have no default constructor.
template <class T, class Body>
void with_step(int32_t kind, const Body& body) {
  if (kind == static_cast<int32_t>(StepKind::kPower)) return body(static_cast<PowerStep<T>*>(nullptr));
  body(static_cast<FoldStep<T>*>(nullptr));
}

#ifndef __CUDACC__
// Follows the points begin to end, a vector of them at a time.
template <class T>
void orbits_in_lanes(const OrbitArgs& args, int64_t begin, int64_t end) {
  using Real = RealOf<T>;
  constexpr int64_t kPerVector = sizeof(T) / sizeof(Real);
  with_step<T>(args.kind, [&](auto* step) {
    const FollowPoints<T, std::decay_t<decltype(*step)>> points{args};
    for (int64_t index = begin; index < end; index += kPerVector) {
      const int64_t count = end - index < kPerVector ? end - index : kPerVector;
      const Real* point = static_cast<const Real*>(args.point_p3) + 3 * index;
      Vec3<T> position{};
      for (int64_t lane = 0; lane < count; ++lane) {
        for (int axis = 0; axis < 3; ++axis) position[axis][lane] = point[3 * lane + axis];
      }
      T result[3];
      points.follow(position, result);
      for (int i = 0; i < 3; ++i) {
        memcpy(static_cast<Real*>(args.result_3p) + i * args.points + index, &result[i],
               static_cast<size_t>(count) * sizeof(Real));
      }
    }
  });
}
#endif

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
