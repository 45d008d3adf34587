// The transfer function as a table, and front-to-back compositing, for all lanes of a packet: the twin of shade.h.
#pragma once

#include "shade.h"
#include "simd.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Twin of Cell.
struct PacketCell {
  Ints row;
  Floats weight;
};

// Twin of Transfer, its rows read one number at a time.
struct PacketTable : Transfer<float> {
  static constexpr int32_t kRed = 0, kAlpha = 3;  // green and blue lie between
  static constexpr int32_t kBytes = sizeof(Row<float>);

  using Transfer<float>::Transfer;

  GV_HD PacketCell find(Floats value) const {
    const Floats place = clamp((value - low) * scale, Floats{}, Floats{} + last);
    const Ints row = smaller(truncated(place), Ints{} + (rows - 2));
    return {row, place - to_floats(row)};
  }
  // Twin of Transfer::transparent, for a value alone.
  GV_HD Mask transparent(Floats value) const {
    const Floats slack = larger(value, -value) * 9.5367431640625e-7f;
    const auto place = [&](Floats at) { return clamp((at - low) * scale, Floats{}, Floats{} + last); };
    const Ints before = truncated(place(value - slack)) - 1;
    const Ints end = -floor_int(-place(value + slack));
    return pick(opaque_m, end) == (before < 0 ? Ints{} : pick(opaque_m, larger(before, Ints{})));
  }
  // A number of the table between two rows; `entry`: the first one's place in bytes.
  GV_HD Floats column(Ints entry, int32_t which, Floats weight) const {
    const float* first = &table_lm[0].red + which;
    const Floats a = (Floats)gather(first, entry);
    const Floats b = (Floats)gather(first + 4, entry);
    return a + weight * (b - a);
  }
};

GV_HD Floats stretch(Floats alpha, Floats lengths) {
  const Floats kept = 1.0f - alpha;
  return kept > 1.1754944e-38f ? 1.0f - exp2_exact(log2_exact(kept) * lengths) : Floats{} + 1.0f;
}

// Twin of Accumulator.
struct PacketSum {
  Floats red, green, blue;
  Floats clear, depth;
  Mask missed;

  // Lets an interval's alpha take its share of the light; colours are added before.
  GV_HD void absorb(Floats alpha, Floats start, Floats length, float hit_clear) {
    const Floats rest = clear * (1.0f - alpha);
    const Mask passed = (rest < hit_clear) & (clear >= hit_clear);
    if (any(passed))
      for_lanes(passed,
                [&](int lane) { depth[lane] = start[lane] + at(lane).reach(alpha[lane], hit_clear) * length[lane]; });
    clear = rest;
  }
  GV_HD Accumulator<float> at(int lane) const {
    return {red[lane], green[lane], blue[lane], clear[lane], depth[lane], missed[lane] != 0};
  }
  GV_HD void put(int lane, const Accumulator<float>& sum) {
    red[lane] = sum.red;
    green[lane] = sum.green;
    blue[lane] = sum.blue;
    clear[lane] = sum.clear;
    depth[lane] = sum.depth;
    missed[lane] = sum.missed ? -1 : 0;
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
