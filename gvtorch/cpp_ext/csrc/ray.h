// Rays: from the world into tree units, where they meet the scene, and the intervals they are cut into.
//
// The samples of a ray are fixed before anything is read. An interval is step * 2^level long, the longest that is not
// longer than the cone is wide where it starts; level 0 where even `step` is. A value is taken in its middle and
// stands for its length; the last one is cut at the far side. What is skipped therefore never moves a sample, and data
// that begins behind skipped space gets each of its samples, the first included.
#pragma once

#include "hd.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

struct RayView {
  const double* origin_r3;     // world
  const double* direction_r3;  // world, unit length
  const double* cone_r2;       // world: width at the origin, growth per unit
  const double* range_r2;      // world: first and last distance
  const double* place_33;      // world: low corner of the scene, size of the root cube; tree units: its high corner
  double cone_scale;
  const double* clear_r = nullptr;  // transmittance with which a ray begins; null: 1

  GV_HD double clear(int64_t index) const { return clear_r == nullptr ? 1.0 : clear_r[index]; }
};

// One ray in tree units (a distance along it stays a world length), begun where it enters the scene: float32 then
// counts from there, however far the camera is.
template <class T>
struct Ray {
  Vec3<T> origin, direction;
  Vec3<T> inverse;  // of the direction
  Vec3<T> high;     // corner of the scene; its low corner is 0
  T cone_near, cone_growth;
  T first, last;
  T moved;  // distance from the camera to the origin

  GV_HD Ray(const RayView& rays, int64_t index) {
    Vec3<double> from, along;
    double near = -INFINITY;
    for (int axis = 0; axis < 3; ++axis) {
      const double size = rays.place_33[3 + axis];
      from[axis] = (rays.origin_r3[3 * index + axis] - rays.place_33[axis]) / size;
      along[axis] = rays.direction_r3[3 * index + axis] / size;
      const double low = -from[axis] / along[axis];
      const double far = (rays.place_33[6 + axis] - from[axis]) / along[axis];
      if (along[axis] != 0) near = larger(near, smaller(low, far));
    }
    const double shift = near > 0 && near < static_cast<double>(INFINITY) ? near : 0;
    const double growth = rays.cone_r2[2 * index + 1] * rays.cone_scale;
    cone_near = static_cast<T>(rays.cone_r2[2 * index] * rays.cone_scale + growth * shift);
    cone_growth = static_cast<T>(growth);
    first = static_cast<T>(rays.range_r2[2 * index] - shift);
    last = static_cast<T>(rays.range_r2[2 * index + 1] - shift);
    moved = static_cast<T>(shift);
    for (int axis = 0; axis < 3; ++axis) {
      origin[axis] = static_cast<T>(from[axis] + shift * along[axis]);
      direction[axis] = static_cast<T>(along[axis]);
      inverse[axis] = 1 / direction[axis];
      high[axis] = static_cast<T>(rays.place_33[6 + axis]);
    }
    clip();
  }

  // A cone of its own from a place inside the scene; `way` in the world.
  GV_HD Ray(Vec3<T> place, Vec3<T> way, Vec3<T> cube, Vec3<T> high, T cone_near, T cone_growth, T last)
      : origin(place),
        direction{way.x / cube.x, way.y / cube.y, way.z / cube.z},
        inverse{1 / direction.x, 1 / direction.y, 1 / direction.z},
        high(high),
        cone_near(cone_near),
        cone_growth(cone_growth),
        first(0),
        last(last),
        moved(0) {
    clip();
  }

  // Slab test (Kay and Kajiya, "Ray tracing complex scenes", 1986).
  // A ray that no face bounds (no direction, NaN, infinite) is closed, so that no loop runs on for ever.
  GV_HD void clip() {
    for (int axis = 0; axis < 3; ++axis) {
      if (direction[axis] == 0) {
        if (!(origin[axis] >= 0 && origin[axis] <= high[axis])) last = first;
        continue;
      }
      const T a = -origin[axis] / direction[axis];
      const T b = (high[axis] - origin[axis]) / direction[axis];
      first = larger(first, smaller(a, b));
      last = smaller(last, larger(a, b));
    }
    if (!(last < static_cast<T>(INFINITY))) last = first;
  }

  // Where the ray is at distance t, inside the root cube: a place on the scene's high face belongs to the scene.
  GV_HD Vec3<T> at(T t) const {
    const T inner = static_cast<T>(0.9999999);
    Vec3<T> place;
    for (int axis = 0; axis < 3; ++axis) {
      place[axis] = clamp(origin[axis] + t * direction[axis], static_cast<T>(0), high[axis] * inner);
    }
    return place;
  }

  // Distance at which the ray leaves a box.
  GV_HD T leave(Vec3<T> corner, T size) const {
    T exit = static_cast<T>(INFINITY);
    for (int axis = 0; axis < 3; ++axis) {
      if (direction[axis] == 0) continue;
      const T face = direction[axis] > 0 ? corner[axis] + size : corner[axis];
      exit = smaller(exit, (face - origin[axis]) * inverse[axis]);
    }
    return exit;
  }
};

constexpr int32_t kMostIntervals = 1 << 23;  // counted in a float32

// Where a ray stands in its fixed sequence of intervals. Starts are products, not sums of roundings.
template <class T>
struct Intervals {
  T near, growth, step, stop;
  int32_t top;  // longest level
  int32_t level = 0;
  T base, length, shortness;  // start = base + count * length; shortness: 1 / length
  T count = 0;
  T start;

  GV_HD Intervals(const Ray<T>& ray, T step, int32_t levels)
      : near(ray.cone_near),
        growth(ray.cone_growth),
        step(step),
        stop(ray.last),
        top(levels - 1),
        base(ray.first),
        length(step),
        shortness(1 / step),
        start(ray.first) {
    choose_level();
  }
  Intervals() = default;
  GV_HD T cone(T t) const { return near + growth * t; }
  GV_HD T start_of(T number) const { return base + number * length; }
  GV_HD T middle_of(T number) const { return base + (number + static_cast<T>(0.5)) * length; }
  GV_HD bool inside() const { return start < stop && count < kMostIntervals; }
  // The last interval, which ends at the far side.
  GV_HD bool cut() const { return !(start_of(count + 1) <= stop); }
  GV_HD T middle() const { return cut() ? start + (stop - start) * static_cast<T>(0.5) : middle_of(count); }

  GV_HD bool fits(T width) const {
    return (level == 0 || !(width < length)) && (level == top || !(width >= length + length));
  }
  GV_HD void choose_level() {
    const T width = cone(start);
    if (fits(width)) return;
    base = start;
    count = 0;
    level = 0;
    length = step;
    while (!fits(width) && level < top) {
      length = length + length;
      level = level + 1;
    }
    shortness = 1 / length;
  }
  GV_HD void skip(int32_t intervals) {
    count = count + static_cast<T>(intervals);
    start = start_of(count);
    choose_level();
  }
  // How many intervals from this one on are alike: whole, of one length, their middles before `exit`, the cone there in
  // [low, high). At least 1. All bounds are monotone along the ray, also where the cone narrows, so the last one tells
  // for all.
  GV_HD int32_t run(T exit, T low, T high) const {
    T limit = smaller(exit, stop);
    if (growth > 0) limit = smaller(limit, (smaller(high, level == top ? high : length + length) - near) / growth);
    if (growth < 0) limit = smaller(limit, (larger(low, level == 0 ? low : length) - near) / growth);
    const T most = static_cast<T>(kMostIntervals);
    int32_t alike = floor_int(clamp((limit - start) * shortness + 1, static_cast<T>(1), most - count));
    while (alike > 1 && !same(count + static_cast<T>(alike - 1), exit, low, high)) --alike;
    return alike;
  }
  GV_HD bool same(T number, T exit, T low, T high) const {
    const T width = cone(middle_of(number));
    return middle_of(number) < exit && start_of(number + 1) <= stop && width >= low && width < high &&
           fits(cone(start_of(number)));
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
