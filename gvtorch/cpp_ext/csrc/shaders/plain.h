// The facts that every shader declares, and the simplest shader: the plain transfer function. The head of shaders.h
// explains what a shader is.
#pragma once

#include "shaders/light.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Facts about a shader that the compiler must know: the walks and the checks of arguments read them. A shader inherits
// these defaults and overrides what differs. The first line and kReadsAll are explained in the head of shaders.h.
struct ShaderFacts {
  static constexpr bool kEnds = false, kSeesEmpty = false, kSurface = false, kHidesAlike = true;
  static constexpr bool kReadsAll = false;
  static constexpr bool kShort = false;       // `add` is short: its loop may be compiled several times
  static constexpr bool kToLight = false;     // it follows rays to a light, see Veil
  static constexpr bool kIntegrates = false;  // its table is (l, m, m, 4)
  static constexpr bool kColored = false;     // its channel holds red, green, blue and opacity, once or by direction
  static constexpr int32_t kFiltered = 0;     // above 0: numbers that a voxel of its second channel has, once or for
                                              // each of six directions; only the pool's first bricks have the channel
  static constexpr int32_t kFeatures = 0;     // how many numbers it writes to sum.feature_c; they begin as 0
  static constexpr int32_t kAsOther = -1;     // for kFeatures: as many as the second channel holds
  static bool packets_can_trace(const ShadeArgs&) { return true; }  // whether packets can trace its rays
};

// The plain transfer function. Table: TransferTable or Transfer.
template <class T, class Table = TransferTable<T>>
struct Plain : ShaderFacts {
  static constexpr bool kShort = true;
  template <class V>
  using SumOf = ShadeSum<V>;
  using Sum = SumOf<T>;
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
  GV_HD void add(MaskOf<V> mask, const Piece<V>& piece, AnyProbe&, SumOf<V>& sum) const {
    const Row<V> row = look_up(Transfer<T>(transfer), piece.value, piece, step, mask);
    if (!all_transparent(mask, row.alpha)) sum.add(row, piece, mask);
  }
  GV_HD void done(Sum&) const {}
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

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
