// Shaders that read colours from voxels: stored ones, and those that a transfer function made of finer voxels.
//
// Equal to ops/reference/stored_color.py.
#pragma once

#include "shaders/light.h"
#include "shaders/plain.h"

namespace gvtorch::GV_NAMESPACE {

// Reads one of a voxel's two sides along an axis: the numbers from `first` on where a ray goes in the axis' direction,
// those from first + per_side on in lanes of `against`, where it goes against it.
template <class V, class Read>
GV_HD auto of_side(MaskOf<V> mask, MaskOf<V> against, int32_t first, const Read& read, int32_t per_side) {
  if constexpr (kPacket<V>) {
    const MaskOf<V> along = mask && !against;
    if (!any(against)) return read(along, first);
    if (!any(along)) return read(against, first + per_side);
    return choose(against, read(against, first + per_side), read(along, first));
  } else {
    return read(mask, against ? first + per_side : first);
  }
}

// A voxel's number, or four of them, as seen along direction d; read(mask, k) returns number k of the voxel, or the
// four that begin there. A channel may hold `per_side` numbers for each of six directions (Crassin et al., "Interactive
// indirect illumination using voxel cone tracing", CGF 2011): then the three on d's side of each axis are read and
// weighted by the squares of d, whose sum is 1. Where all six are equal, the result has the same bits as each.
template <class V, class Read>
GV_HD auto by_direction(MaskOf<V> mask, const Vec3<V>& d, int32_t width, const Read& read, int32_t per_side = 4) {
  if (width == per_side) return read(mask, 0);
  const auto side = [&](int axis) {
    return of_side<V>(mask, mask && d[axis] < 0, 2 * per_side * axis, read, per_side);
  };
  const auto z = side(2);
  auto seen = z;
  GV_NO_UNROLL
  for (int axis = 0; axis < 2; ++axis) {
    const auto more = combined(side(axis), z, [&](V a, V b) { return d[axis] * d[axis] * (a - b); });
    seen = combined(seen, more, [](V a, V b) { return a + b; });
  }
  return seen;
}

// Voxels that hold a colour: red, green, blue and opacity, or these four for each of six directions (see by_direction).
// Nodes are hidden by their opacity.
template <class T>
struct StoredColor : ShaderFacts {
  static constexpr bool kColored = true;
  using Sum = ShadeSum<T>;
  Light<T> light;

  explicit StoredColor(const ShadeArgs& args) : light(args) {}

  template <class AnySum>
  GV_HD bool hides(T, T high, const AnySum&) const {
    return !(a_little_above(high) > 0);
  }
  struct Numbers {
    T scale;               // of the stored numbers
    T reference_length;    // to which the stored opacity refers, world
    T premultiplied, lit;  // 1 or 0
  };
  GV_HD const Numbers& numbers() const { return own_numbers<Numbers>(light.parameters); }
  template <class V, class AnyProbe>
  GV_HD V opacity_of(MaskOf<V> mask, const Interval<V>& interval, const AnyProbe& probe) const {
    const auto& channel = probe.channels.value;
    const auto read = [&](MaskOf<V>, int32_t first) { return probe.number_at(channel, first + 3, interval.middle); };
    const V value = channel.width == 4 ? interval.value : of_sides<V>(mask, probe, read);
    return saturate(value * numbers().scale);
  }
  template <class V, class AnyProbe>
  GV_HD V alpha(MaskOf<V> mask, const Interval<V>& interval, const AnyProbe& probe) const {
    return stretch(opacity_of(mask, interval, probe), interval.length / numbers().reference_length);
  }
  template <class V, class AnyProbe, class... Shadow>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum,
                 const Shadow&... shadow) const {
    const auto& channel = probe.channels.value;
    const V t = interval.middle;
    if constexpr (kPacket<V>) {
      if (channel.width > 4) return add_by_direction(mask, interval, probe, sum, shadow...);
      const auto read = [&](int32_t number) { return probe.number_at(channel, number, t); };
      const auto stored = [&](MaskOf<V>) { return Row<V>{read(0), read(1), read(2), V{}}; };
      add_stored(mask, saturate(interval.value * numbers().scale), stored, interval, probe, sum, shadow...);
    } else {
      const auto read = [&](bool, int32_t first) {
        return probe.template four_at<sizeof...(Shadow) != 0>(true, channel, first, t);
      };
      const auto stored = [&](bool) { return channel.width == 4 ? read(true, 0) : of_sides<V>(true, probe, read); };
      add_stored(mask, opacity_of(mask, interval, probe), stored, interval, probe, sum, shadow...);
    }
  }

 private:
  // Adds an interval; stored(mask) returns the numbers as seen along the ray, of which the fourth is not read.
  template <class V, class Stored, class AnyProbe, class... Shadow>
  GV_HD void add_stored(MaskOf<V> mask, V opacity, const Stored& stored, const Interval<V>& interval, AnyProbe& probe,
                        ShadeSum<V>& sum, const Shadow&... shadow) const {
    const MaskOf<V> shown = mask && opacity > 0;
    if (!any(shown)) return;
    probe.select_lanes(shown);
    const Row<V> seen = stored(shown);
    const auto color = [&](V number) {
      const V scaled = number * numbers().scale;
      return numbers().premultiplied > 0 ? scaled / opacity : scaled;
    };
    const Row<V> row{color(seen.red), color(seen.green), color(seen.blue),
                     stretch(opacity, interval.length / numbers().reference_length)};
    if (numbers().lit > 0) {
      const MaskOf<V> absorbs = shown && row.alpha > 0;  // alpha rounds to 0 if the interval is short
      if (any(absorbs)) light.add(absorbs, row, probe, interval, sum, shadow...);
    } else {
      sum.add(row, interval, shown);
    }
  }
  // A packet's colours by direction: a call, which keeps the loop of other colours as fast as without these.
  template <class V, class AnyProbe, class... Shadow>
  GV_RARE void add_by_direction(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum,
                                const Shadow&... shadow) const {
    const auto& channel = probe.channels.value;
    const Vec3<V> d = probe.sight.direction;
    const V t = interval.middle;
    const auto number = [&](MaskOf<V>, int32_t first) { return probe.number_at(channel, first + 3, t); };
    const auto four = [&](MaskOf<V> lanes, int32_t first) { return probe.four_at(lanes, channel, first, t); };
    const auto stored = [&](MaskOf<V> shown) { return by_direction(shown, d, channel.width, four); };
    add_stored(mask, saturate(by_direction(mask, d, channel.width, number) * numbers().scale), stored, interval, probe,
               sum, shadow...);
  }
  template <class V, class AnyProbe, class Read>
  GV_RARE static auto of_sides(MaskOf<V> mask, const AnyProbe& probe, const Read& read) {
    return by_direction(mask, probe.sight.direction, probe.channels.value.width, read);
  }
};

// Shades with stored colours where a brick has them, else with a transfer function, `Base`. The colours, a second
// channel which only the first bricks of the pool have, were computed by the function from the finest voxels below each
// of their voxels. Where two levels blend, what they show is blended, not their values. `Shader` derives from this and
// has
//
//   contribution(mask, interval, probe, node)    what one of the nodes adds for an interval, of a type that `combined`
//                                                accepts
//   add_contribution(mask, added, interval, sum) adds it to the sum
template <class T, class Base, class Shader>
struct FromAfar : Base {
  int32_t bricks;  // number of bricks that have the second channel

  explicit FromAfar(const ShadeArgs& args) : Base(args), bricks(args.other_bricks) {}

  GV_HD const Base& plain() const { return *this; }
  template <class AnyProbe>
  GV_HD auto has_stored(const AnyProbe& probe) const {
    return probe.fine.in_first_slots(bricks) || (probe.mixed && probe.coarse.in_first_slots(bricks));
  }
  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum) const {
    const MaskOf<V> colored = mask && has_stored(probe), uncolored = mask && !colored;
    if (any(uncolored)) Base::add(uncolored, interval, probe, sum);
    if (!any(colored)) return;
    const Shader& shader = static_cast<const Shader&>(*this);
    auto fine = shader.contribution(colored, interval, probe, probe.fine);
    const MaskOf<V> mixed = colored && probe.mixed;
    if (any(mixed)) {
      const auto coarse = shader.contribution(mixed, interval, probe, probe.coarse);
      const V weight = probe.weight(interval.middle);
      fine = combined(fine, coarse, [&](V a, V b) { return select(mixed, a + weight * (b - a), a); });
    }
    shader.add_contribution(colored, fine, interval, sum);
  }
};

// The plain transfer function, filtered: the second channel holds premultiplied colour and alpha of an interval as long
// as the voxel, once or by direction, as for StoredColor.
template <class T>
struct Filtered : FromAfar<T, Plain<T>, Filtered<T>> {
  static constexpr int32_t kFiltered = 4;
  struct Numbers {
    T side;  // world size of the root cube
  };
  const Parameters<T>* parameters;

  explicit Filtered(const ShadeArgs& args)
      : FromAfar<T, Plain<T>, Filtered<T>>(args), parameters(static_cast<const Parameters<T>*>(args.parameter_54)) {}

  template <class V>
  GV_HD void add_contribution(MaskOf<V> mask, const Row<V>& color, const Interval<V>& interval,
                              ShadeSum<V>& sum) const {
    sum.add_premultiplied(color, interval, mask);
  }
  // Premultiplied colour and alpha of an interval in one of the nodes.
  template <class V, class AnyProbe, class Node>
  GV_HD Row<V> contribution(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, const Node& node) const {
    const V t = interval.middle;
    const MaskOf<V> colored = mask && node.in_first_slots(this->bricks), uncolored = mask && !colored;
    Row<V> row{};
    if (any(uncolored)) {
      const Row<V> plain =
          look_up(Transfer<T>(this->transfer), probe.value_of(node, t), interval, this->step, uncolored);
      row = {plain.red * plain.alpha, plain.green * plain.alpha, plain.blue * plain.alpha, plain.alpha};
    }
    if (!any(colored)) return row;
    probe.select_lanes(colored);
    const auto& colors = probe.channels.other;
    const Vec3<V> d = probe.sight.direction;
    const auto read = [&](MaskOf<V> lanes, int32_t first) { return probe.four_of(lanes, colors, first, node, t); };
    const Row<V> seen = by_direction(colored, d, colors.width, read);
    const V stored_alpha = saturate(seen.alpha);
    const V alpha =
        stretch(stored_alpha, interval.length * probe.scale_of(node) / own_numbers<Numbers>(parameters).side);
    const V scale = alpha / stored_alpha;
    const MaskOf<V> shown = colored && stored_alpha > 0;
    const auto choose = [&](V color, V plain) { return select(shown, color, select(colored, V{}, plain)); };
    return {choose(seen.red * scale, row.red), choose(seen.green * scale, row.green),
            choose(seen.blue * scale, row.blue), choose(alpha, row.alpha)};
  }
};

}  // namespace gvtorch::GV_NAMESPACE
