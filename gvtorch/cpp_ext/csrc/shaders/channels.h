// ChannelMix: voxels hold several numbers, called channels here, each with a transfer function of its own. At each
// sample all channels are mixed into one colour and one alpha.
//
// For an interval of length l, the function of channel i gives a colour c_i, and the opacity a_i of its reference
// length r_i. Alone, channel i halves the light h_i = -log2(1 - a_i) l / r_i times. All channels together halve it
// H times; the mode of the shader says how H is made:
//
//   opacity:   H = h_1 + h_2 + ...        each channel dims what the others let through
//   additive:  H = max(h_1, h_2, ...)     together they hide only as much as the densest one
//
// Then alpha = 1 - 2^-H, and the premultiplied colour is alpha (h_1 c_1 + h_2 c_2 + ...) / H. Both modes solve emission
// and absorption exactly for an even mixture in which channel i emits h_i c_i, so an interval that is cut in two shows
// the same. One channel alone shows what its function shows, in either mode. Channels of equal h show the mean of their
// colours in the mode opacity, and the sum of their colours, which may be above 1, in the mode additive.
//
// The table has four numbers a row. It begins with a head: one row (how many channels, 1 if additive, 0, 0), and a row
// for each channel (which number of a voxel, value of its function's first row, rows per unit of the value, how many
// rows). Then follow the rows of the functions, one channel after the other: red, green, blue, and h of an interval
// of length step * 2^level.
//
// Equal to ops/reference/channels.py. Source: Max, "Optical models for direct volume rendering", IEEE TVCG 1995.
#pragma once

#include "shaders/light.h"
#include "shaders/plain.h"

namespace gvtorch::GV_NAMESPACE {

// A whole number that a table holds, clamped to [0, maximum].
template <class T>
GV_HD int32_t whole_up_to(T number, int32_t maximum) {
  return static_cast<int32_t>(clamp(number, static_cast<T>(0), static_cast<T>(maximum)));
}

// The rows of one channel, as a transfer function.
template <class T>
struct ChannelRows : Transfer<T> {
  int32_t component;

  ChannelRows() = default;
  GV_HD ChannelRows(const TransferView<T>& all, const Row<T>& head, int32_t first, int32_t width)
      : Transfer<T>(all.table_lm + first, all.opaque_m + first, head.green, head.blue,
                    whole_up_to(head.alpha, all.rows - first)),
        component(whole_up_to(head.red, width - 1)) {}
};

template <class T>
struct ChannelMix : ShaderFacts {
  static constexpr bool kReadsAll = true;
  using Sum = ShadeSum<T>;
  TransferView<T> view;
  T step;
  int32_t width;
#ifndef __CUDACC__
  int32_t channel_count = 0;
  ChannelRows<T> cached_rows[kMaxNumbers];  // read once; on a GPU, rows are read where they are needed
#endif

  explicit ChannelMix(const ShadeArgs& args) : view(args), step(static_cast<T>(args.step)), width(args.voxel_width) {
#ifndef __CUDACC__
    read([&](int32_t i, const ChannelRows<T>& rows) {
      cached_rows[i] = rows;
      channel_count = i + 1;
    });
#endif
  }

  // True if no channel has an opacity in the node. range_of(component): smallest and largest value of a voxel's number.
  template <class RangeOf>
  GV_HD bool hides_ranges(const RangeOf& range_of) const {
    bool hides = true;
    each_channel([&](int32_t, const ChannelRows<T>& rows) {
      const auto range = range_of(rows.component);
      hides = hides && rows.transparent(range.low, range.high);
    });
    return hides;
  }
  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum) const {
    probe.select_lanes(mask);
    V values[kMaxNumbers];
    probe.numbers_at(probe.channels.value, Components<T>{&view.table_lm[1].red, 4, width}, count(), interval.middle,
                     values);
    V red{}, green{}, blue{}, total{};
    const bool additive = view.table_lm[0].green > 0;
    each_channel([&](int32_t i, const ChannelRows<T>& rows) {
      const Row<V> row = rows.look_up(values[i], interval.level, mask, view.rows);  // its alpha holds halvings
      red = red + row.alpha * row.red;
      green = green + row.alpha * row.green;
      blue = blue + row.alpha * row.blue;
      total = additive ? larger(total, row.alpha) : total + row.alpha;
    });
    const MaskOf<V> shown = mask && total > 0;
    if (!any(shown)) return;
    V halvings = total;
    if (interval.odd) halvings = total * (interval.length / step);
    const V alpha = absorbed_by(halvings), scale = alpha / total;
    sum.add_premultiplied({red * scale, green * scale, blue * scale, alpha}, interval, shown);
  }

 private:
  // Calls body(i, rows) for each channel. Whatever the head holds, no row outside the table is read.
  template <class Body>
  GV_HD void each_channel(const Body& body) const {
#ifdef __CUDACC__
    read(body);
#else
    for (int32_t i = 0; i < channel_count; ++i) body(i, cached_rows[i]);
#endif
  }
  template <class Body>
  GV_HD void read(const Body& body) const {
    int32_t first = 1 + declared_count();
    for (int32_t i = 0; i < declared_count() && first + 2 <= view.rows; ++i) {
      const ChannelRows<T> rows(view, view.table_lm[1 + i], first, width);
      if (rows.rows < 2) return;
      body(i, rows);
      first += rows.rows;
    }
  }
  GV_HD int32_t declared_count() const {
    return whole_up_to(view.table_lm[0].red, smaller(kMaxNumbers, view.rows - 1));
  }
  GV_HD int32_t count() const {
#ifdef __CUDACC__
    return declared_count();
#else
    return channel_count;
#endif
  }
};

}  // namespace gvtorch::GV_NAMESPACE
