// The transfer function as a table; an Interval of a ray; and ShadeSum, which composites intervals from front to back.
// T is as in arithmetic.h.
#pragma once

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch::GV_NAMESPACE {

// Red, green, blue, and the alpha of an interval; aligned for load_row and for packets.
template <class T>
struct alignas(16) alignas(T) Row {
  T red, green, blue, alpha;

  GV_HD T operator[](int column) const {
    return column == 0 ? red : (column == 1 ? green : (column == 2 ? blue : alpha));
  }
  GV_EACH_MEMBER(GV_BOTH(red) GV_BOTH(green) GV_BOTH(blue) GV_BOTH(alpha))
};
constexpr int kAlpha = 3;

// f(a, b) of two numbers, or member by member of two rows or vectors; other structs have an overload next to them.
template <class V, class F>
GV_HD V combined(V a, V b, const F& f) {
  return f(a, b);
}
template <class V, class F>
GV_HD Row<V> combined(const Row<V>& a, const Row<V>& b, const F& f) {
  return {f(a.red, b.red), f(a.green, b.green), f(a.blue, b.blue), f(a.alpha, b.alpha)};
}
template <class V, class F>
GV_HD Vec3<V> combined(const Vec3<V>& a, const Vec3<V>& b, const F& f) {
  return {f(a.x, b.x), f(a.y, b.y), f(a.z, b.z)};
}
// `select` for everything that `combined` accepts.
template <class Mask, class Numbers>
GV_HD Numbers choose(Mask mask, const Numbers& a, const Numbers& b) {
  return combined(a, b, [&](auto x, auto y) { return select(mask, x, y); });
}

// True if no lane of a packet has alpha. False for a single ray, where the test costs more than it saves.
template <class T>
GV_HD bool all_transparent(MaskOf<T> mask, T alpha) {
  if constexpr (kPacket<T>) return !any(mask && alpha > 0);
  return false;
}

// Builds a row of column(0) to column(kAlpha); colours stay 0 where no lane of a packet has alpha.
template <class T, class Column>
GV_HD Row<T> make_row(MaskOf<T> mask, const Column& column) {
  Row<T> row{};
  row.alpha = column(kAlpha);
  if (all_transparent(mask, row.alpha)) return row;
  row.red = column(0);
  row.green = column(1);
  row.blue = column(2);
  return row;
}

// A row of float32 in one load of 16 bytes: left to itself, nvcc reads its numbers one by one.
template <class T>
GV_HD Row<T> load_row(const Row<T>* row) {
#ifdef __CUDA_ARCH__
  if constexpr (sizeof(T) == sizeof(float)) {
    const float4 four = *reinterpret_cast<const float4*>(row);
    return {four.x, four.y, four.z, four.w};
  }
#endif
  return *row;
}

template <class T>
struct RowPair {
  Row<T> first, second;

  GV_HD T at(T weight, int column) const { return first[column] + weight * (second[column] - first[column]); }
};

// Position of a value in the table: a row, and the weight of the next one.
template <class T>
struct Cell {
  IntOf<T> row;
  T weight;
};

// Ends of a range, moved outwards: interpolation may round beyond them.
template <class T>
GV_HD T a_little_below(T value) {
  return value - absolute(value) * static_cast<RealOf<T>>(9.5367431640625e-7);  // 2^-20
}
template <class T>
GV_HD T a_little_above(T value) {
  return value + absolute(value) * static_cast<RealOf<T>>(9.5367431640625e-7);
}

// The table as kernels carry it: as pointers, since only a GPU can read its own memory.
template <class T>
struct TransferView {
  const Row<T>* table_lm;   // for each length of interval, step * 2^l
  const T* domain_2;        // value of the first row, value of the last row
  const int32_t* opaque_m;  // number of rows with an opacity, up to and including this one
  int32_t rows;

  explicit TransferView(const TraceArgs& args)
      : table_lm(static_cast<const Row<T>*>(args.table_lm4)),
        domain_2(static_cast<const T*>(args.domain_2)),
        opaque_m(args.opaque_m),
        rows(args.rows) {}
};

// The transfer function with its domain read: once per ray on a GPU, once per kernel on the CPU.
template <class T>
struct Transfer {
  const Row<T>* table_lm;
  const int32_t* opaque_m;
  T low, high, scale, last;
  int32_t rows;

  Transfer() = default;
  // A table whose first row is at the value `low`, with `scale` rows per unit of the value.
  GV_HD Transfer(const Row<T>* table_lm, const int32_t* opaque_m, T low, T scale, int32_t rows)
      : table_lm(table_lm),
        opaque_m(opaque_m),
        low(low),
        high(low + static_cast<T>(rows - 1) / scale),
        scale(scale),
        last(static_cast<T>(rows - 1)),
        rows(rows) {}
  GV_HD explicit Transfer(const TransferView<T>& view)
      : table_lm(view.table_lm),
        opaque_m(view.opaque_m),
        low(view.domain_2[0]),
        high(view.domain_2[1]),
        last(static_cast<T>(view.rows - 1)),
        rows(view.rows) {
    scale = last / (high - low);
  }
#ifndef __CUDACC__
  explicit Transfer(const TraceArgs& args) : Transfer(TransferView<T>(args)) {}
#endif

  template <class V>
  GV_HD V row_position(V value) const {
    return clamp((value - low) * scale, static_cast<T>(0), last);
  }
  template <class V>
  GV_HD Cell<V> find(V value) const {
    const V position = row_position(value);
    const IntOf<V> row = smaller(truncated(position), broadcast<IntOf<V>>(rows - 2));
    return {row, position - to_real<V>(row)};
  }

  // Row index + offset, and the next one.
  GV_HD RowPair<T> rows_at(int32_t index, int32_t offset = 0) const {
    const Row<T>* const row = table_lm + (index + offset);
    return {load_row(row), load_row(row + 1)};
  }
#ifndef __CUDACC__
  GV_HD RowPair<Floats> rows_at(Ints index, int32_t offset = 0) const {
    RowPair<Floats> rows;
    load_row_pairs(&table_lm[offset].red, index, &rows.first.red, &rows.second.red);
    return rows;
  }
#endif

  // Colour and alpha of a value in an interval of a level. Lanes outside `mask` are undefined.
  template <class V>
  GV_HD Row<V> look_up(V value, IntOf<V> level, MaskOf<V> mask = all_lanes<V>()) const {
    return look_up(value, level, mask, rows);
  }
  // The same in a table of several functions, with `level_rows` rows per level.
  template <class V>
  GV_HD Row<V> look_up(V value, IntOf<V> level, MaskOf<V> mask, int32_t level_rows) const {
    const Cell<V> cell = find(value);
    const RowPair<V> pair = rows_at(level * level_rows + cell.row);
    return make_row<V>(mask, [&](int column) { return pair.at(cell.weight, column); });
  }

  // True if no value in the range has an opacity. The range is widened: interpolation may round beyond its ends.
  template <class V>
  GV_HD MaskOf<V> transparent(V smallest, V largest) const {
    const IntOf<V> before = floor_int(row_position(a_little_below(smallest))) - 1;
    const IntOf<V> end = -floor_int(-row_position(a_little_above(largest)));
    return pick(opaque_m, end) == select(before < 0, IntOf<V>{}, pick(opaque_m, larger(before, IntOf<V>{})));
  }
};

// The member of a shader from which it makes a Transfer.
#ifdef __CUDACC__
template <class T>
using TransferTable = TransferView<T>;
#else
template <class T>
using TransferTable = Transfer<T>;
#endif

// Alpha over a length of `lengths` intervals of level 0, from the alpha of one.
template <class T>
GV_HD T stretch(T alpha, T lengths) {
  using Real = RealOf<T>;
  const T transmittance = 1 - alpha, opaque = broadcast<T>(static_cast<Real>(1));
  const auto translucent = transmittance > static_cast<Real>(1.1754944e-38f);
  if (!any(translucent)) return opaque;
  return select(translucent, 1 - exp2_exact(log2_exact(transmittance) * lengths), opaque);
}

// An interval of a ray, or of each ray of a packet.
template <class T>
struct Interval {
  T start, end, length, middle;  // distances, world units
  IntOf<T> level{};              // the length is step * 2^level, unless `odd`
  T value;                       // in the middle
  T front, back;                 // values at both ends, for shaders with kEnds
  bool odd = false;              // of any length, with level 0

  // Makes the interval from `start` to `end` odd.
  GV_HD void set_odd() {
    odd = true;
    length = end - start;
    middle = start + length * static_cast<RealOf<T>>(0.5);
  }
  // Without the values, of which a shader has only some.
  GV_EACH_MEMBER(GV_BOTH(start) GV_BOTH(end) GV_BOTH(length) GV_BOTH(middle) GV_BOTH(level) GV_BOTH(odd))
};

// The sums of a ray, or of each ray of a packet.
template <class T>
struct ShadeSum {
  using Real = RealOf<T>;
  using Mask = MaskOf<T>;
  T red{}, green{}, blue{};
  T clear = broadcast<T>(static_cast<Real>(1));  // transmittance
  T depth = broadcast<T>(static_cast<Real>(INFINITY));
  Mask missed{};                           // visible data was missing
  Vec3<T> normal{};                        // towards the eye, weighted by share
  Real hit_clear;                          // transmittance at which depth is recorded
  typename LanesOf<T>::Pointer feature_c;  // of each lane

  // Adds an interval of a colour, premultiplied or not.
  GV_HD void add(const Row<T>& row, const Interval<T>& interval, Mask mask = all_lanes<T>()) {
    add_light(row, clear * row.alpha, mask);
    absorb(row.alpha, interval, mask);
  }
  GV_HD void add_premultiplied(const Row<T>& row, const Interval<T>& interval, Mask mask) {
    add_light(row, clear, mask);
    absorb(row.alpha, interval, mask);
  }
  // Adds light in a lane, weighted by `share`.
  GV_HD void add_light(int lane, const Row<Real>& row, Real share) {
    set_lane(red, lane, lane_of(red, lane) + share * row.red);
    set_lane(green, lane, lane_of(green, lane) + share * row.green);
    set_lane(blue, lane, lane_of(blue, lane) + share * row.blue);
  }
  GV_HD void add_normal(Vec3<T> n, T share, Mask mask = all_lanes<T>()) {
    for (int axis = 0; axis < 3; ++axis) normal[axis] = select(mask, normal[axis] + share * n[axis], normal[axis]);
  }

  GV_EACH_MEMBER(GV_BOTH(red) GV_BOTH(green) GV_BOTH(blue) GV_BOTH(clear) GV_BOTH(depth) GV_BOTH(missed) GV_BOTH(normal)
                     GV_BOTH(hit_clear) GV_BOTH(feature_c))

  // Takes the light that an interval absorbs. Depth is where in the interval the transmittance falls to hit_clear, as
  // if the interval were homogeneous.
  GV_HD void absorb(T alpha, const Interval<T>& interval, Mask mask = all_lanes<T>()) {
    const T clear_after = clear * (1 - alpha);
    for_lanes(mask && clear_after < hit_clear && clear >= hit_clear, [&](int lane) {
      const Real fraction = hit_fraction(lane_of(clear, lane), lane_of(alpha, lane), hit_clear);
      set_lane(depth, lane, lane_of(interval.start, lane) + fraction * lane_of(interval.length, lane));
    });
    clear = select(mask, clear_after, clear);
  }

 private:
  GV_HD void add_light(const Row<T>& row, T share, Mask mask) {
    red = select(mask, red + share * row.red, red);
    green = select(mask, green + share * row.green, green);
    blue = select(mask, blue + share * row.blue, blue);
  }
  // Fraction of an interval after which the transmittance is hit_clear.
  GV_HD static Real hit_fraction(Real clear, Real alpha, Real hit_clear) {
    const Real transmittance = 1 - alpha;
    if (!(transmittance > static_cast<Real>(1.1754944e-38f))) return 0;
    return saturate(log2_exact(hit_clear / clear) / log2_exact(transmittance));
  }
};

}  // namespace gvtorch::GV_NAMESPACE
