// Where the rays of a packet stand in their fixed sequences of intervals.
#pragma once

#include "ray.h"
#include "simd.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Twin of Intervals. `which`: the lanes that a change is for.
struct PacketIntervals {
  Floats near, growth, stop;
  Floats base, length, shortness, count, start;
  Ints level;
  float step;
  int32_t top;

  GV_HD Floats cone(Floats t) const { return near + growth * t; }
  GV_HD Floats start_of(Floats number) const { return base + number * length; }
  GV_HD Floats middle_of(Floats number) const { return base + (number + 0.5f) * length; }
  GV_HD Mask inside() const { return (start < stop) & (count < static_cast<float>(kMostIntervals)); }
  GV_HD Mask cut() const { return ~(start_of(count + 1.0f) <= stop); }
  GV_HD Floats middle() const { return cut() ? start + (stop - start) * 0.5f : middle_of(count); }
  GV_HD Mask fits(Floats width) const {
    return ((level == 0) | ~(width < length)) & ((level == top) | ~(width >= length + length));
  }
  GV_HD void choose_level(Mask which) {
    const Floats width = cone(start);
    const Mask wrong = which & ~fits(width);
    if (!any(wrong)) return;
    base = wrong ? start : base;
    count = wrong ? Floats{} : count;
    level = wrong ? Ints{} : level;
    length = wrong ? Floats{} + step : length;
    for (;;) {
      const Mask longer = wrong & ~fits(width) & (level < top);
      if (!any(longer)) break;
      length = longer ? length + length : length;
      level = level - longer;
    }
    shortness = wrong ? 1.0f / length : shortness;
  }
  // Goes on to the interval `number`.
  GV_HD void go(Mask which, Floats number) {
    count = which ? number : count;
    start = which ? start_of(count) : start;
    choose_level(which);
  }
  GV_HD Ints run(Mask which, Floats exit, Floats low, Floats high) const {
    Floats limit = smaller(exit, stop);
    const Floats longest = level == top ? high : length + length;
    limit = growth > 0.0f ? smaller(limit, (smaller(high, longest) - near) / growth) : limit;
    const Mask narrows = growth < 0.0f;
    if (any(narrows)) {
      const Floats shortest = level == 0 ? low : length;
      limit = narrows ? smaller(limit, (larger(low, shortest) - near) / growth) : limit;
    }
    const Floats most = static_cast<float>(kMostIntervals) - count;
    Ints alike = floor_int(clamp((limit - start) * shortness + 1.0f, Floats{} + 1.0f, most));
    for (;;) {
      const Mask over = which & (alike > 1) & ~same(count + to_floats(alike - 1), exit, low, high);
      if (!any(over)) return alike;
      alike = alike + over;
    }
  }
  GV_HD Mask same(Floats number, Floats exit, Floats low, Floats high) const {
    const Floats middle = middle_of(number);
    const Floats width = cone(middle);
    return (middle < exit) & (start_of(number + 1.0f) <= stop) & (width >= low) & (width < high) &
           fits(cone(start_of(number)));
  }
  GV_HD Mask stays(Floats exit, Floats low, Floats high) const {
    const Floats here = middle();
    const Floats width = cone(here);
    return inside() & (here < exit) & (width >= low) & (width < high);
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
