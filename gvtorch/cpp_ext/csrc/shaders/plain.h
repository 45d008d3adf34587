// Plain, the simplest shader, and what all shaders begin with: ShaderFacts, the facts that each declares; `look_up`,
// the transfer function over an interval; and their own parameters. The head of shaders.h explains what a shader is. T
// is float or double; V is T, or Floats for a packet (arithmetic.h).
#pragma once

#include "shaders/probe.h"
#include "walk/shade.h"

namespace gvtorch::GV_NAMESPACE {

// The transfer function's colour of a value, and its alpha over an interval of any length.
template <class T, class V>
GV_HD Row<V> look_up(const Transfer<T>& transfer, V value, const Interval<V>& interval, T step,
                     MaskOf<V> mask = all_lanes<V>()) {
  Row<V> row = transfer.look_up(value, interval.level, mask);
  if (interval.odd) row.alpha = stretch(row.alpha, interval.length / step);
  return row;
}

// A shader's own parameters by name: a struct of at most four numbers.
template <class Numbers, class T>
GV_HD const Numbers& own_numbers(const Parameters<T>* parameters) {
  static_assert(sizeof(Numbers) <= sizeof(parameters->own));
  return *reinterpret_cast<const Numbers*>(parameters->own);
}

// Facts about a shader that the compiler must know: the walks and the checks of arguments read them. A shader inherits
// these defaults and overrides what differs. The first line and kReadsAll are explained in the head of shaders.h.
struct ShaderFacts {
  static constexpr bool kEnds = false, kSeesEmpty = false, kSurface = false, kHidesAlike = true;
  static constexpr bool kReadsAll = false;
  static constexpr bool kShort = false;       // `add` is short: its loop may be compiled several times
  static constexpr bool kToLight = false;     // it follows rays to a light, see ShadowShader
  static constexpr bool kIntegrates = false;  // its table is (l, m, m, 4)
  static constexpr bool kColored = false;     // its channel holds red, green, blue and opacity, once or by direction
  static constexpr int32_t kFiltered = 0;     // above 0: numbers that a voxel of its second channel has, once or for
                                              // each of six directions; only the pool's first bricks have the channel
  static constexpr int32_t kFeatures = 0;     // how many numbers it writes to sum.feature_c; they begin as 0
  static constexpr int32_t kAsOther = -1;     // for kFeatures: as many as the second channel holds
  template <class V>
  using SumOf = ShadeSum<V>;
  template <class Sum>
  GV_HD void done(Sum&) const {}
};

// The plain transfer function. Table: TransferTable or Transfer.
template <class T, class Table = TransferTable<T>>
struct Plain : ShaderFacts {
  static constexpr bool kShort = true;
  using Sum = ShadeSum<T>;
  Table transfer;
  T step;

  explicit Plain(const TraceArgs& args) : transfer(args), step(static_cast<T>(args.step)) {}
  template <class OtherTable>
  GV_HD explicit Plain(const Plain<T, OtherTable>& other) : transfer(other.transfer), step(other.step) {}

  template <class AnySum>
  GV_HD bool hides(T low, T high, const AnySum&) const {
    return Transfer<T>(transfer).transparent(low, high);
  }
  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe&, ShadeSum<V>& sum) const {
    const Row<V> row = look_up(Transfer<T>(transfer), interval.value, interval, step, mask);
    if (!all_transparent(mask, row.alpha)) sum.add(row, interval, mask);
  }
};

// The shader that a ray carries, with what all of its samples need already read from memory.
template <class Shader>
GV_HD const Shader& ready_for_ray(const Shader& shader) {
  return shader;
}
template <class T>
GV_HD Plain<T, Transfer<T>> ready_for_ray(const Plain<T>& shader) {
  return Plain<T, Transfer<T>>(shader);
}

}  // namespace gvtorch::GV_NAMESPACE
