// Rays: conversion from the world into tree units, clipping to the scene, and the intervals they are cut into.
//
// The samples of a ray are fixed before anything is read. An interval is step * 2^level long: the longest length that
// does not exceed the cone's width where the interval starts, or level 0 where even `step` does. It is sampled in its
// middle; the last interval is cut at the far side. Skipping space therefore never moves a sample, and data behind
// skipped space gets all of its samples, the first included.
#pragma once

#include "base/arithmetic.h"

namespace gvtorch::GV_NAMESPACE {

struct RayView {
  const double* origin_r3;     // world
  const double* direction_r3;  // world, unit length
  const double* cone_r2;       // world: width at the origin, growth per unit
  const double* range_r2;      // world: first and last distance
  const double* place_33;      // world: low corner of the scene, size of the root cube; tree units: scene's high corner
  double cone_scale;
  bool deep;                        // positions are computed in float64, see tree.h
  const double* clear_r = nullptr;  // transmittance with which a ray begins; null: 1

  GV_HD double clear(int64_t index) const { return clear_r == nullptr ? 1.0 : clear_r[index]; }
  // The scene's high corner, clamped to the root cube whatever the tensor holds: node indices are computed from it.
  GV_HD double high(int axis) const {
    const double corner = place_33[6 + axis];
    return corner > 0 ? smaller(corner, 1.0) : 0.0;
  }
};

// One ray, or the rays of a packet, in tree units (distances along it stay world lengths). The origin is moved to where
// the ray enters the scene, so float32 suffices however far the camera is. Rounding errors of distances are below the
// cone's width; those of positions are not, so deep trees subtract positions in float64 before they round.
template <class T>
struct Ray {
  using Real = RealOf<T>;
  Vec3<T> origin, direction;
  Vec3<T> rest;            // what rounding removed from the origin, in a deep tree; else 0
  Vec3<T> inverse;         // of the direction
  Vec3<Real> upper_bound;  // largest position in the scene along each axis: points on its high face are clamped to it
  T cone_near, cone_growth;
  T first, last;
  T moved;  // distance from the camera to the origin

  Ray() = default;
  GV_HD Ray(const RayView& rays, int64_t index) {
    Vec3<double> from, along, start;
    double entry = -INFINITY, zero = 0;
    bool moves = false;
    for (int axis = 0; axis < 3; ++axis) {
      const double size = rays.place_33[3 + axis];
      from[axis] = (rays.origin_r3[3 * index + axis] - rays.place_33[axis]) / size;
      along[axis] = rays.direction_r3[3 * index + axis] / size;
      zero += 0 * (from[axis] + along[axis]);
      moves = moves || along[axis] != 0;
      const double face = along[axis] > 0 ? -from[axis] : rays.high(axis) - from[axis];  // the nearer one
      if (along[axis] != 0) entry = larger(entry, face / along[axis]);
    }
    const double shift = entry > 0 && entry < static_cast<double>(INFINITY) ? entry : 0;
    const double growth = rays.cone_r2[2 * index + 1] * rays.cone_scale;
    cone_near = static_cast<T>(rays.cone_r2[2 * index] * rays.cone_scale + growth * shift);
    cone_growth = static_cast<T>(growth);
    first = static_cast<T>(rays.range_r2[2 * index] - shift);
    last = static_cast<T>(rays.range_r2[2 * index + 1] - shift);
    moved = static_cast<T>(shift);
    for (int axis = 0; axis < 3; ++axis) {
      start[axis] = from[axis] + shift * along[axis];
      direction[axis] = static_cast<T>(along[axis]);
    }
    begin(rays, start);
    if (!moves || !(zero == 0)) last = first;  // without a direction, or with NaN or infinity
  }

  // A secondary cone from a position inside the scene (tree units), along a direction in the world. `near` and
  // `growth`: its width there and per unit of length, the latter before cone_scale.
  GV_HD Ray(const RayView& rays, Vec3<double> start, Vec3<T> world_direction, T near, T growth, T last)
      : cone_near(near), cone_growth(growth * static_cast<T>(rays.cone_scale)), first(0), last(last), moved(0) {
    for (int axis = 0; axis < 3; ++axis) {
      direction[axis] = world_direction[axis] / static_cast<T>(rays.place_33[3 + axis]);
    }
    begin(rays, start);
  }

  // Slab test (Kay and Kajiya, "Ray tracing complex scenes", 1986).
  // A ray without a finite end (no face bounds it: zero, NaN or infinite direction) or whose cone is NaN gets an empty
  // range, so that every loop ends.
  GV_HD void begin(const RayView& rays, Vec3<double> start) {
    for (int axis = 0; axis < 3; ++axis) {
      origin[axis] = static_cast<T>(start[axis]);
      rest[axis] = rays.deep ? static_cast<T>(start[axis] - static_cast<double>(origin[axis])) : T{};
      inverse[axis] = 1 / direction[axis];
      upper_bound[axis] = upper_bound_of(rays, axis);
      const double from = exact_origin(axis), to = rays.high(axis);
      if (direction[axis] == 0) {
        if (!(from >= 0 && from <= to)) last = first;
        continue;
      }
      const T a = -origin[axis] / direction[axis];
      const T b = static_cast<T>(to - from) / direction[axis];
      first = larger(first, smaller(a, b));
      last = smaller(last, larger(a, b));
    }
    const bool is_cone = cone_near == cone_near && cone_growth == cone_growth;
    if (!is_cone || !(last < static_cast<T>(INFINITY))) last = first;
  }

  // Width of the cone at distance t.
  GV_HD T cone(T t) const { return cone_near + cone_growth * t; }

  // The origin along an axis, with what rounding removed.
  GV_HD double exact_origin(int axis) const {
    return static_cast<double>(origin[axis]) + static_cast<double>(rest[axis]);
  }

  // Position at distance t.
  GV_HD Vec3<double> along(T t, bool deep) const {
    Vec3<double> position;
    for (int axis = 0; axis < 3; ++axis) {
      position[axis] = deep ? exact_origin(axis) + static_cast<double>(t) * static_cast<double>(direction[axis])
                            : static_cast<double>(origin[axis] + t * direction[axis]);
    }
    return position;
  }

  // Position at distance t, clamped to the scene.
  GV_HD Vec3<T> at(T t) const {
    Vec3<T> position;
    for (int axis = 0; axis < 3; ++axis) {
      position[axis] = clamp(origin[axis] + t * direction[axis], static_cast<Real>(0), upper_bound[axis]);
    }
    return position;
  }
  GV_HD static Real upper_bound_of(const RayView& rays, int axis) {
    return static_cast<Real>(rays.high(axis)) * static_cast<Real>(0.9999999);
  }

  // Distance at which the ray leaves a box; face(axis, upper): offset of its lower or upper face from the origin.
  template <class Face>
  GV_HD T exit_distance(const Face& face) const {
    T exit = broadcast<T>(static_cast<Real>(INFINITY));
    for (int axis = 0; axis < 3; ++axis) {
      const T distance = face(axis, direction[axis] > 0) * inverse[axis];
      exit = select(direction[axis] == 0, exit, smaller(exit, distance));
    }
    return exit;
  }

  GV_EACH_MEMBER(GV_BOTH(origin) GV_BOTH(direction) GV_BOTH(inverse) GV_BOTH(moved))
};

// The part of a ray for which a tree lookup stays valid: up to `exit`, and while the cone is in [cone_low, cone_high).
template <class T>
struct Extent {
  T exit, cone_low, cone_high;

  GV_HD MaskOf<T> holds(T t, T cone) const { return t < exit && cone >= cone_low && cone < cone_high; }
};

constexpr int32_t kMaxIntervals = 1 << 23;  // counted from one base: float32 holds every count + 1/2 below it

// A ray's current interval in its fixed sequence. Starts are products, so rounding errors do not add up. `mask`: the
// lanes that a call changes or tests.
template <class T>
struct Intervals {
  using Real = RealOf<T>;
  using Mask = MaskOf<T>;
  T cone_near, cone_growth, stop;
  Real step;
  int32_t top;  // level of the longest intervals
  IntOf<T> level{};
  T base, length, inverse_length;  // start = base + count * length; inverse_length: 1 / length
  T count{};
  T start;

  GV_HD Intervals(const Ray<T>& ray, T step, int32_t lengths)
      : cone_near(ray.cone_near),
        cone_growth(ray.cone_growth),
        stop(ray.last),
        step(step),
        top(lengths - 1),
        base(ray.first),
        length(step),
        inverse_length(1 / step),
        start(ray.first) {
    choose_level(true);
  }
  Intervals() = default;
  GV_HD T cone(T t) const { return cone_near + cone_growth * t; }
  GV_HD T start_of(T number) const { return base + number * length; }
  GV_HD T middle_of(T number) const { return base + (number + static_cast<Real>(0.5)) * length; }
  GV_HD Mask inside() const { return start < stop; }
  // True for the last interval, which is cut at the far side.
  GV_HD Mask cut() const { return !(start_of(count + static_cast<Real>(1)) <= stop); }
  GV_HD T middle() const { return select(cut(), start + (stop - start) * static_cast<Real>(0.5), middle_of(count)); }

  GV_HD Mask fits(T width) const {
    return (level == 0 || !(width < length)) && (level == top || !(width >= length + length));
  }
  GV_HD void choose_level(Mask mask) {
    const T width = cone(start);
    const Mask full = count >= static_cast<Real>(kMaxIntervals);
    const Mask misfits = mask && (full || !fits(width));
    if (!any(misfits)) return;
    start = select(mask && full && !(start > base), stop, start);  // intervals too short to move it: the ray ends
    base = select(misfits, start, base);
    count = select(misfits, T{}, count);
    level = select(misfits, IntOf<T>{}, level);
    length = select(misfits, broadcast<T>(step), length);
    for (;;) {
      const Mask longer = misfits && !fits(width) && level < top;
      if (!any(longer)) break;
      length = select(longer, length + length, length);
      level = select(longer, level + 1, level);
    }
    inverse_length = select(misfits, 1 / length, inverse_length);
  }
  // Moves to interval `number`, counted from `base` in intervals of this length.
  GV_HD void move_to(Mask mask, T number) {
    count = select(mask, number, count);
    start = select(mask, start_of(count), start);
    choose_level(mask);
  }
  // Number of alike intervals from this one on: whole, of one length, in the extent. At least 1. All bounds are
  // monotone along the ray, also where the cone narrows, so it suffices to test the last interval.
  GV_HD IntOf<T> run(Mask mask, const Extent<T>& extent) const {
    T limit = smaller(extent.exit, stop);
    if (any(cone_growth > 0)) {
      const T longest = smaller(extent.cone_high, select(level == top, extent.cone_high, length + length));
      limit = select(cone_growth > 0, smaller(limit, (longest - cone_near) / cone_growth), limit);
    }
    if (any(cone_growth < 0)) {
      const T shortest = larger(extent.cone_low, select(level == 0, extent.cone_low, length));
      limit = select(cone_growth < 0, smaller(limit, (shortest - cone_near) / cone_growth), limit);
    }
    const T one = broadcast<T>(static_cast<Real>(1)), longest_run = static_cast<Real>(kMaxIntervals) - count;
    IntOf<T> run_length = truncated(clamp((limit - start) * inverse_length + one, one, longest_run));
    for (;;) {
      const Mask excess = mask && run_length > 1 && !is_alike(count + to_real<T>(run_length - 1), extent);
      if (!any(excess)) return run_length;
      run_length = select(excess, run_length - 1, run_length);
    }
  }
  GV_HD Mask is_alike(T number, const Extent<T>& extent) const {
    const T middle = middle_of(number);
    return extent.holds(middle, cone(middle)) && start_of(number + static_cast<Real>(1)) <= stop &&
           fits(cone(start_of(number)));
  }
  // True if this interval lies in the extent.
  GV_HD Mask stays(const Extent<T>& extent) const {
    const T t = middle();
    return inside() && extent.holds(t, cone(t));
  }
  // Moves to the first interval beyond the extent.
  GV_HD void leave(Mask mask, const Extent<T>& extent) {
    for (Mask inside = mask; any(inside); inside = inside && stays(extent)) {
      const Mask uncut = inside && !cut();
      IntOf<T> run_length = broadcast<IntOf<T>>(1);
      if (any(uncut)) run_length = select(uncut, run(uncut, extent), run_length);
      move_to(inside, count + to_real<T>(run_length));
    }
  }

  GV_EACH_MEMBER(GV_BOTH(cone_near) GV_BOTH(cone_growth) GV_BOTH(stop) GV_BOTH(step) GV_BOTH(top) GV_BOTH(level)
                     GV_BOTH(base) GV_BOTH(length) GV_BOTH(inverse_length) GV_BOTH(count) GV_BOTH(start))
};

}  // namespace gvtorch::GV_NAMESPACE
