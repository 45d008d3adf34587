// The transfer function as a table, and front-to-back compositing.
#pragma once

#include "hd.h"
#include "trace_args.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Red, green, blue, and the alpha of an interval; aligned, so that a row is one load (two of float64).
template <class T>
struct alignas(16) Row {
  T red, green, blue, alpha;
};

template <class T>
struct TransferView {
  const Row<T>* table_lm;   // for each length of interval, step * 2^l
  const T* domain_2;        // value of the first row, value of the last row
  const int32_t* opaque_m;  // rows with an opacity up to this one, itself included
  int32_t rows;
  int32_t levels;

  explicit TransferView(const TraceArgs& args)
      : table_lm(static_cast<const Row<T>*>(args.table_lm4)),
        domain_2(static_cast<const T*>(args.domain_2)),
        opaque_m(args.opaque_m),
        rows(args.rows),
        levels(args.levels) {}
};

// Where a value stands in the table: between two rows.
template <class T>
struct Cell {
  int32_t row;
  T weight;
};

// The transfer function with its numbers read once a ray.
template <class T>
struct Transfer {
  const Row<T>* table_lm;
  const int32_t* opaque_m;
  T low, scale, last;
  int32_t rows;

  GV_HD explicit Transfer(const TransferView<T>& view)
      : table_lm(view.table_lm),
        opaque_m(view.opaque_m),
        low(view.domain_2[0]),
        last(static_cast<T>(view.rows - 1)),
        rows(view.rows) {
    scale = last / (view.domain_2[1] - low);
  }

  GV_HD Cell<T> find(T value) const {
    const T place = clamp((value - low) * scale, static_cast<T>(0), last);
    const int32_t row = smaller(static_cast<int32_t>(place), rows - 2);
    return {row, place - static_cast<T>(row)};
  }

  GV_HD Row<T> look_up(Cell<T> cell, int32_t level) const {
    const Row<T>* rows_m = table_lm + static_cast<int64_t>(level) * rows;
    const Row<T> a = rows_m[cell.row];
    const Row<T> b = rows_m[cell.row + 1];
    return {a.red + cell.weight * (b.red - a.red), a.green + cell.weight * (b.green - a.green),
            a.blue + cell.weight * (b.blue - a.blue), a.alpha + cell.weight * (b.alpha - a.alpha)};
  }

  // No value between the two is seen. They are taken a little apart: interpolation may round beyond its ends.
  GV_HD bool transparent(T smallest, T largest) const {
    const T slack = static_cast<T>(9.5367431640625e-7);  // 2^-20
    const T below = smallest - larger(smallest, -smallest) * slack;
    const T above = largest + larger(largest, -largest) * slack;
    const int32_t first = floor_int(clamp((below - low) * scale, static_cast<T>(0), last));
    const int32_t end = -floor_int(-clamp((above - low) * scale, static_cast<T>(0), last));
    return opaque_m[end] == (first > 0 ? opaque_m[first - 1] : 0);
  }
};

// Alpha of a length, from the alpha of an interval of level 0.
template <class T>
GV_HD T stretch(T alpha, T lengths) {
  const T kept = 1 - alpha;
  if (!(kept > static_cast<T>(1.1754944e-38f))) return 1;
  return 1 - exp2_exact(log2_exact(kept) * lengths);
}

template <class T>
struct Accumulator {
  T red = 0, green = 0, blue = 0;
  T clear = 1;  // transmittance
  T depth = static_cast<T>(INFINITY);
  bool missed = false;  // something that was seen was not there

  // Adds an interval. Depth is where, inside it, the transmittance fell to hit_clear, as if it were of one value.
  GV_HD void add(const Row<T>& row, T start, T length, T hit_clear) {
    const T share = clear * row.alpha;
    const T left = clear * (1 - row.alpha);
    red = red + share * row.red;
    green = green + share * row.green;
    blue = blue + share * row.blue;
    if (left < hit_clear && clear >= hit_clear) depth = start + reach(row.alpha, hit_clear) * length;
    clear = left;
  }
  // Part of an interval after which the transmittance is hit_clear.
  GV_HD T reach(T alpha, T hit_clear) const {
    const T kept = 1 - alpha;
    if (!(kept > static_cast<T>(1.1754944e-38f))) return 0;
    return clamp(log2_exact(hit_clear / clear) / log2_exact(kept), static_cast<T>(0), static_cast<T>(1));
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
