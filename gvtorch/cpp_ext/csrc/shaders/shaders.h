// The fused shaders, which turn the values along a ray into colour. `ShadeRay` (shade_rays.h) and `PacketWalk`
// (packet_walk.h) walk the tree and call them.
//
// A shader is a small struct, copied into the kernel:
//
//   explicit Shader(const ShadeArgs&)             on the host: borrows tables and parameters
//   kEnds                                         intervals have values at their two ends, else in their middle
//   kSeesEmpty                                    EMPTY nodes are shaded too, with their mean value
//   SumOf<V> : ShadeSum<V>, Sum = SumOf<T>        the state of a ray; `clear` at 1 - stop_alpha ends the ray
//   hides(low, high, sum)                         true if no value in [low, high] changes the sum: the node is skipped.
//                                                 Without kHidesAlike, it is written for V, like `add`
//   kHidesAlike                                   `hides` ignores the sum: nodes are hidden from all rays alike
//   kReadsAll, hides_ranges(range_of)             `add` reads all numbers through its probe; intervals have no value.
//                                                 hides_ranges then replaces `hides`: range_of(component) returns the
//                                                 smallest and largest value (low, high) that one of a voxel's numbers
//                                                 has in the node
//   add(mask, interval, probe, sum)               adds an interval; `probe` reads any channel at any distance
//   kSurface, surface(probe, sum)                 called where depth was set, with a probe of the node found there
//   done(sum)                                     called after the last interval
//
// A shader that receives shadows also has
//
//   alpha(mask, interval, probe)                  share that an interval absorbs of the light from behind
//   add(mask, interval, probe, sum, shadow...)    `shadow`: see Light::add
//
// T is float or double. `add` is written once for a ray (V is T) and for a packet (V is Floats, see arithmetic.h), in
// which each lane of `mask` adds an interval; interval, probe and sum are of V. `probe.select_lanes(mask)` limits what
// is read from then on to fewer lanes, `probe.each_lane(mask, body)` passes each lane's own probe. `alpha` is written
// once as well. Everything else is called for one ray.
//
// An interval belongs to the node that contains its middle. Its ends may lie up to half an interval outside; they are
// still read in this node, clamped to its brick's outermost voxel centres. With a border of 1 and steps of at most a
// voxel this clamp changes nothing, so an end has the same value from both sides; and since all values read lie in the
// node's range, skipping a hidden node changes no bit.
//
// Equal to ops/reference/shaders.py and lit.py. Sources: Blinn, "Models of light reflection for computer synthesized
// pictures", SIGGRAPH 1977; Engel, Kraus, Ertl, "High-quality pre-integrated volume rendering using
// hardware-accelerated pixel shading", Graphics Hardware 2001; Levoy, "Display of surfaces from volume data", IEEE CG&A
// 1988.
#pragma once

#include "shaders/channels.h"
#include "shaders/labels.h"
#include "shaders/stored_color.h"

namespace gvtorch::GV_NAMESPACE {

// The transfer function, lit.
template <class T>
struct Lit : Plain<T> {
  static constexpr bool kShort = false;
  using Plain<T>::transfer;
  using Plain<T>::step;
  Light<T> light;

  explicit Lit(const ShadeArgs& args) : Plain<T>(args), light(args) {}

  template <class V, class AnyProbe>
  GV_HD V alpha(MaskOf<V> mask, const Interval<V>& interval, const AnyProbe&) const {
    return look_up(Transfer<T>(transfer), interval.value, interval, step, mask).alpha;
  }
  template <class V, class AnyProbe, class... Shadow>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum,
                 const Shadow&... shadow) const {
    const Row<V> row = look_up(Transfer<T>(transfer), interval.value, interval, step, mask);
    const MaskOf<V> shown = mask && row.alpha > 0;
    if (!any(shown)) return;
    probe.select_lanes(shown);
    light.add(shown, row, probe, interval, sum, shadow...);
  }
};

// What one node adds for an interval, lit.
template <class V>
struct LitRow {
  Row<V> row{};      // premultiplied colour in the light, and alpha
  Vec3<V> normal{};  // times alpha
};
template <class V, class F>
GV_HD LitRow<V> combined(const LitRow<V>& a, const LitRow<V>& b, const F& f) {
  return {combined(a.row, b.row, f), combined(a.normal, b.normal, f)};
}

// The lit transfer function, filtered: Filtered's numbers are followed by the mean products xx xy xz yy yz zz of the
// components of the normals below a voxel, times its alpha.
template <class T>
struct FilteredLit : FromAfar<T, Lit<T>, FilteredLit<T>> {
  static constexpr int32_t kFiltered = 10;
  using Numbers = typename Filtered<T>::Numbers;
  using FromAfar<T, Lit<T>, FilteredLit<T>>::FromAfar;

  template <class V>
  GV_HD void add_contribution(MaskOf<V> mask, const LitRow<V>& lit_row, const Interval<V>& interval,
                              ShadeSum<V>& sum) const {
    sum.add_normal(lit_row.normal, sum.clear, mask && lit_row.row.alpha > 0);
    sum.add_premultiplied(lit_row.row, interval, mask);
  }
  // What one of the nodes adds; 0 in other lanes.
  template <class V, class AnyProbe, class Node>
  GV_HD LitRow<V> contribution(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, const Node& node) const {
    const MaskOf<V> colored = mask && node.in_first_slots(this->bricks), uncolored = mask && !colored;
    LitRow<V> lit_row;
    if (any(uncolored)) lit_row = by_function(uncolored, interval, probe, node);
    if (!any(colored)) return lit_row;
    return choose(colored, by_colors(colored, interval, probe, node), lit_row);
  }

 private:
  template <class V, class AnyProbe, class Node>
  GV_HD LitRow<V> by_function(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, const Node& node) const {
    const V t = interval.middle;
    const Row<V> row = look_up(Transfer<T>(this->transfer), probe.value_of(node, t), interval, this->step, mask);
    const MaskOf<V> shown = mask && row.alpha > 0;
    if (!any(shown)) return {};
    probe.select_lanes(shown);
    const Vec3<V> n = this->light.to_eye(probe.differences(node, t), probe.sight.direction);
    return times_alpha(shown, this->light.shade(row, n, probe, t), n);
  }
  template <class V, class AnyProbe, class Node>
  GV_HD LitRow<V> by_colors(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, const Node& node) const {
    const V t = interval.middle;
    probe.select_lanes(mask);
    const auto& colors = probe.channels.other;
    const Vec3<V> d = probe.sight.direction;
    const auto read = [&](MaskOf<V> lanes, int32_t first) { return probe.four_of(lanes, colors, first, node, t); };
    const Row<V> color = by_direction(mask, d, colors.width, read, kFiltered);
    const V stored_alpha = saturate(color.alpha);
    const V alpha = stretch(stored_alpha,
                            interval.length * probe.scale_of(node) / own_numbers<Numbers>(this->light.parameters).side);
    const MaskOf<V> shown = mask && stored_alpha > 0 && alpha / stored_alpha > 0;
    if (!any(shown)) return {};
    const bool sided = colors.width != kFiltered;
    Vec3<V> front{}, n;
    Moments<V> m = sided ? moments_seen(shown, read, d, front) : moments(shown, read, 0);
    m = {m.xx / stored_alpha, m.xy / stored_alpha, m.xz / stored_alpha,
         m.yy / stored_alpha, m.yz / stored_alpha, m.zz / stored_alpha};
    front = {front.x / stored_alpha, front.y / stored_alpha, front.z / stored_alpha};
    const Row<V> base{color.red / stored_alpha, color.green / stored_alpha, color.blue / stored_alpha, alpha};
    const Row<V> row = this->light.shade_rough(base, m, sided, front, probe, t, n);
    return times_alpha(shown, row, unit(n));
  }
  template <class AnyMask, class Read>
  GV_HD static auto moments(AnyMask mask, const Read& read, int32_t first) {
    const auto a = read(mask, first + 4), b = read(mask, first + 6);
    return Moments<decltype(a.red + b.red)>{a.red, a.green, a.blue, a.alpha, b.blue, b.alpha};
  }
  // The moments of the normals seen along direction d, and in `front` the mean of these normals: those seen along an
  // axis are turned against the ray's direction along it.
  template <class V, class Read>
  GV_HD static Moments<V> moments_seen(MaskOf<V> mask, const Read& read, const Vec3<V>& d, Vec3<V>& front) {
    Moments<V> sum{};
    GV_NO_UNROLL
    for (int axis = 0; axis < 3; ++axis) {
      const MaskOf<V> against = mask && d[axis] < 0;
      const auto read_moments = [&](MaskOf<V> lanes, int32_t first) { return moments(lanes, read, first); };
      const Moments<V> m = of_side<V>(mask, against, 2 * kFiltered * axis, read_moments, kFiltered);
      const Vec3<V> column = axis == 0   ? Vec3<V>{m.xx, m.xy, m.xz}
                             : axis == 1 ? Vec3<V>{m.xy, m.yy, m.yz}
                                         : Vec3<V>{m.xz, m.yz, m.zz};
      const V weight = d[axis] * d[axis], total = m.trace(), along_axis = column[axis];
      V scale{};
      const MaskOf<V> nonzero = mask && total > 0 && along_axis > 0;
      if (any(nonzero)) scale = select(nonzero, square_root(total / along_axis) * weight, scale);
      scale = select(against, scale, -scale);
      sum = combined(sum, m, [&](V a, V b) { return a + weight * b; });
      front = {front.x + scale * column.x, front.y + scale * column.y, front.z + scale * column.z};
    }
    return sum;
  }
  template <class V>
  GV_HD static LitRow<V> times_alpha(MaskOf<V> mask, const Row<V>& row, const Vec3<V>& n) {
    const V a = select(mask, row.alpha, V{});
    const auto weighted = [&](V number) { return select(mask, number * a, V{}); };
    return {{weighted(row.red), weighted(row.green), weighted(row.blue), a},
            {weighted(n.x), weighted(n.y), weighted(n.z)}};
  }
};

// The shader of rays to a light (shadow rays): only the transmittance through what another shader shows.
template <class T, class Shader>
struct ShadowShader : ShaderFacts {
  static constexpr bool kToLight = true;
  static_assert(Shader::kHidesAlike, "the same nodes are hidden from the rays to the light");
  template <class V>
  struct SumOf {
    V clear = broadcast<V>(static_cast<T>(1));  // transmittance
    MaskOf<V> missed{};

    GV_EACH_MEMBER(GV_BOTH(clear) GV_BOTH(missed))
  };
  using Sum = SumOf<T>;
  const Shader& shader;

  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, const AnyProbe& probe, SumOf<V>& sum) const {
    sum.clear = select(mask, sum.clear * (1 - shader.alpha(mask, interval, probe)), sum.clear);
  }
};

// Pre-integrated transfer function: a table (l, m, m) over the values at both ends of an interval, of premultiplied
// colour and alpha. Outside its domain it is constant: such parts of an interval are added in front and behind.
template <class T>
struct PreIntegrated : ShaderFacts {
  static constexpr bool kEnds = true, kIntegrates = true;
  using Sum = ShadeSum<T>;
  TransferTable<T> transfer;
  T step;

  explicit PreIntegrated(const ShadeArgs& args) : transfer(args), step(static_cast<T>(args.step)) {}

  GV_HD bool hides(T low, T high, const Sum&) const { return Transfer<T>(transfer).transparent(low, high); }
  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe&, ShadeSum<V>& sum) const {
    const Transfer<T> table(transfer);
    V lengths = broadcast<V>(static_cast<T>(1));
    if (interval.odd) lengths = interval.length / step;
    const auto pair = [&](V from, V to) { return between(table, from, to, interval.level, mask); };
    const V front = clamp(interval.front, table.low, table.high);
    const V back = clamp(interval.back, table.low, table.high);
    const MaskOf<V> outside = mask && !(front == back || (front == interval.front && back == interval.back));
    Row<V> row = pair(front, back);
    if (!any(outside)) {
      row = with_length(row, lengths);
    } else {
      const V rate = lengths / absolute(interval.back - interval.front);
      const Row<V> before = with_length(pair(front, front), rate * absolute(front - interval.front));
      const Row<V> behind = with_length(pair(back, back), rate * absolute(interval.back - back));
      const Row<V> parts = over(over(before, with_length(row, rate * absolute(back - front))), behind);
      row = choose(outside, parts, with_length(row, lengths));
    }
    if (all_transparent(mask, row.alpha)) return;
    sum.add_premultiplied(row, interval, mask);
  }
  // The row of an interval from one value to another, of a length that the table has.
  template <class V>
  GV_HD Row<V> between(const Transfer<T>& table, V from, V to, IntOf<V> level, MaskOf<V> mask) const {
    const Cell<V> front = table.find(from), back = table.find(to);
    const int32_t rows = table.rows;
    const IntOf<V> index = (level * rows + front.row) * rows + back.row;
    const RowPair<V> nearer = table.rows_at(index), farther = table.rows_at(index, rows);
    return make_row<V>(mask, [&](int column) {
      const V near = nearer.at(back.weight, column), far = farther.at(back.weight, column);
      return near + front.weight * (far - near);
    });
  }
  // The same values over another length.
  template <class V>
  GV_HD static Row<V> with_length(const Row<V>& row, V lengths) {
    const MaskOf<V> changes = row.alpha > 0 && !(lengths == 1);
    if (!any(changes)) return row;
    const V alpha = select(lengths > 0, stretch(row.alpha, lengths), V{});
    const V scale = alpha / row.alpha;
    return choose(changes, {row.red * scale, row.green * scale, row.blue * scale, alpha}, row);
  }
  template <class V>
  GV_HD static Row<V> over(const Row<V>& a, const Row<V>& b) {
    const V transmittance = 1 - a.alpha;
    return {a.red + transmittance * b.red, a.green + transmittance * b.green, a.blue + transmittance * b.blue,
            a.alpha + transmittance * b.alpha};
  }
};

// The first position where the value crosses a level, in either direction. Four bisections and a secant: an interval of
// a voxel is narrowed to a sixteenth, which is then assumed linear. The value at the end of the last interval is kept,
// so that no crossing is lost between two nodes that round differently.
template <class T>
struct Isosurface : ShaderFacts {
  static constexpr bool kEnds = true, kSurface = true;
  template <class V>
  struct SumOf : ShadeSum<V> {
    V last_value{};
    V last_end = broadcast<V>(static_cast<T>(-INFINITY));  // +INFINITY: the ray began inside, without a surface there
    V share{};                                             // transmittance in front of the surface

    GV_EACH_MEMBER(ShadeSum<V>::each_member(a, b, body); GV_BOTH(last_value) GV_BOTH(last_end) GV_BOTH(share))
  };
  using Sum = SumOf<T>;
  TransferTable<T> transfer;
  Light<T> light;
  int32_t color_component;

  explicit Isosurface(const ShadeArgs& args) : transfer(args), light(args), color_component(args.other_component) {}

  struct Numbers {
    T level;
    T filled;         // 1: solid where the value is not below the level; -1: where it is; 0: nowhere
    T scale;          // of the second channel's four numbers, which are the colour; 0: the transfer function's colour
    T premultiplied;  // 1: the colour is stored times the fourth number
  };
  GV_HD const Numbers& numbers() const { return own_numbers<Numbers>(light.parameters); }
  GV_HD bool hides(T low, T high, const Sum&) const {
    const T level = numbers().level, filled = numbers().filled;
    return (!(filled < 0) && a_little_above(high) < level) || (!(filled > 0) && a_little_below(low) >= level);
  }
  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, SumOf<V>& sum) const {
    using Mask = MaskOf<V>;
    const T level = numbers().level, filled = numbers().filled;
    const Mask below = interval.front < level;
    const Mask jumped = sum.last_end == interval.start && (sum.last_value < level) != below;
    const Mask solid = filled == 0 ? Mask{} : filled > 0 ? !below : below;
    const Mask hits_start = mask && (jumped || solid);
    const Mask crosses = mask && !hits_start && below != (interval.back < level);
    V hit_t = interval.start;
    if (any(crosses)) {
      probe.select_lanes(crosses);
      V near = interval.start, far = interval.end, near_value = interval.front, far_value = interval.back;
      GV_NO_UNROLL
      for (int step = 0; step < 4; ++step) {
        const V middle = near + (far - near) * static_cast<T>(0.5);
        const V value = probe.value(middle);
        const Mask same = (value < level) == below;
        near = select(same, middle, near);
        near_value = select(same, value, near_value);
        far = select(same, far, middle);
        far_value = select(same, far_value, value);
      }
      const V fraction = saturate((level - near_value) / (far_value - near_value));
      hit_t = select(crosses, near + fraction * (far - near), hit_t);
    }
    const Mask hit = hits_start || crosses, passed = mask && !hit;
    const Mask begins = hits_start && !jumped && sum.last_end == static_cast<T>(-INFINITY);
    sum.share = select(hit, sum.clear, sum.share);
    sum.clear = select(hit, V{}, sum.clear);
    sum.depth = select(hit, hit_t, sum.depth);
    sum.last_value = select(passed, interval.back, sum.last_value);
    sum.last_end = select(passed, interval.end, sum.last_end);
    sum.last_end = select(begins, broadcast<V>(static_cast<T>(INFINITY)), sum.last_end);
  }
  GV_HD Row<T> color_at(const Probe<T>& probe, T t) const {
    const auto& color_channel = probe.channels.other;
    if (numbers().scale > 0 && color_channel.width >= 4) {
      const Row<T> stored = probe.four_at(true, color_channel, 0, t);
      const T opacity = stored.alpha * numbers().scale;
      const T divisor = numbers().premultiplied > 0 && opacity > 0 ? opacity : 1;
      return {stored.red * numbers().scale / divisor, stored.green * numbers().scale / divisor,
              stored.blue * numbers().scale / divisor, 0};
    }
    return Transfer<T>(transfer).look_up(
        color_channel.exists() ? probe.number_at(color_channel, color_component, t) : numbers().level, 0);
  }
  GV_HD void surface(const Probe<T>& probe, Sum& sum) const {
    const T t = sum.depth;
    const Vec3<T> n = sum.last_end == static_cast<T>(INFINITY) ? Vec3<T>{0, 0, 0} : light.normal(probe, t);
    const Row<T> row = light.shade(color_at(probe, t), n, probe, t);
    sum.red = sum.share * row.red;
    sum.green = sum.share * row.green;
    sum.blue = sum.share * row.blue;
    sum.normal = n;
  }
};

// Maximum, minimum or mean of the value along the ray, coloured by the transfer function. A node that can't change a
// maximum or minimum is skipped.
template <class T>
struct Projection : ShaderFacts {
  static constexpr bool kSeesEmpty = true, kHidesAlike = false;
  static constexpr int32_t kFeatures = 1;  // the value
  template <class V>
  struct SumOf : ShadeSum<V> {
    V value{};    // extreme so far, or sum of value * length
    V length{};   // sum of lengths
    V value_t{};  // distance of the extreme; for a mean, of the first interval's start

    GV_EACH_MEMBER(ShadeSum<V>::each_member(a, b, body); GV_BOTH(value) GV_BOTH(length) GV_BOTH(value_t))
  };
  using Sum = SumOf<T>;
  TransferTable<T> transfer;
  const Parameters<T>* parameters;

  explicit Projection(const ShadeArgs& args)
      : transfer(args), parameters(static_cast<const Parameters<T>*>(args.parameter_54)) {}

  struct Numbers {
    T kind;  // a ProjectionKind
  };
  GV_HD ProjectionKind kind() const {
    return static_cast<ProjectionKind>(static_cast<int32_t>(own_numbers<Numbers>(parameters).kind));
  }
  template <class V>
  GV_HD MaskOf<V> hides(V low, V high, const SumOf<V>& sum) const {
    if (kind() == ProjectionKind::kMean) return MaskOf<V>{};
    const bool highest = kind() == ProjectionKind::kMaximum;
    const MaskOf<V> no_gain = highest ? a_little_above(high) <= sum.value : a_little_below(low) >= sum.value;
    return sum.length > 0 && no_gain;
  }
  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe&, SumOf<V>& sum) const {
    const MaskOf<V> first = mask && !(sum.length > 0);
    if (kind() == ProjectionKind::kMean) {
      sum.value_t = select(first, interval.start, sum.value_t);
      sum.value = select(mask, sum.value + interval.value * interval.length, sum.value);
    } else {
      const bool highest = kind() == ProjectionKind::kMaximum;
      const MaskOf<V> exceeds = highest ? interval.value > sum.value : interval.value < sum.value;
      const MaskOf<V> better = first || (mask && exceeds);
      sum.value = select(better, interval.value, sum.value);
      sum.value_t = select(better, interval.middle, sum.value_t);
    }
    sum.length = select(mask, sum.length + interval.length, sum.length);
  }
  GV_HD void done(Sum& sum) const {
    if (!(sum.length > 0)) return;
    const T value = kind() == ProjectionKind::kMean ? sum.value / sum.length : sum.value;
    const Row<T> row = Transfer<T>(transfer).look_up(value, 0);
    sum.red = sum.clear * row.red;
    sum.green = sum.clear * row.green;
    sum.blue = sum.clear * row.blue;
    sum.clear = 0;
    sum.depth = sum.value_t;
    sum.feature_c[0] = value;
  }
};

// All numbers of a second channel, composited with the transfer function's alpha. The output holds the sums, so there
// may be any number of them.
template <class T>
struct Features : Plain<T> {
  static constexpr int32_t kFeatures = Plain<T>::kAsOther;
  using Plain<T>::Plain;

  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum) const {
    const Row<V> row = look_up(Transfer<T>(this->transfer), interval.value, interval, this->step, mask);
    const V share = sum.clear * row.alpha;
    const MaskOf<V> shown = mask && share > 0;
    if (any(shown)) {
      probe.select_lanes(shown);
      const auto& features = probe.channels.other;
      for (int32_t c = 0; c < features.width; ++c) {
        const V number = probe.number_at(features, c, interval.middle);
        for_lanes(shown, [&](int lane) {
          T& feature = lane_of(sum.feature_c, lane)[c];
          feature = feature + lane_of(share, lane) * lane_of(number, lane);
        });
      }
    }
    sum.add(row, interval, mask);
  }
};

// The transfer function, with the optical depth of an interval scaled by the gradient's length over `full`, at most 1
// (after Levoy 1988, "region boundary surfaces").
template <class T>
struct GradientMagnitude : Plain<T> {
  struct Numbers {
    T full;  // gradient length of full density, in units of the value per world unit
  };
  const Parameters<T>* parameters;

  explicit GradientMagnitude(const ShadeArgs& args)
      : Plain<T>(args), parameters(static_cast<const Parameters<T>*>(args.parameter_54)) {}

  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum) const {
    Row<V> row = look_up(Transfer<T>(this->transfer), interval.value, interval, this->step, mask);
    const MaskOf<V> shown = mask && row.alpha > 0;
    if (!any(shown)) return;
    probe.select_lanes(shown);
    const Vec3<V> slope = probe.gradient(interval.middle);
    const V fraction = saturate(square_root(dot(slope, slope)) / own_numbers<Numbers>(parameters).full);
    row.alpha = select(fraction > 0, stretch(row.alpha, fraction), V{});
    sum.add(row, interval, shown);
  }
};

// The fused shaders: X(kind, struct, true if each sample traces a cone to the light), in the order of their numbers, as
// in SHADER_KINDS of ops/reference/shaders.py.
#define GV_SHADERS(X)                            \
  X(Lit, Lit, false)                             \
  X(PreIntegrated, PreIntegrated, false)         \
  X(StoredColor, StoredColor, false)             \
  X(Isosurface, Isosurface, false)               \
  X(Projection, Projection, false)               \
  X(Features, Features, false)                   \
  X(ShadowedLit, Lit, true)                      \
  X(ShadowedColor, StoredColor, true)            \
  X(GradientMagnitude, GradientMagnitude, false) \
  X(Filtered, Filtered, false)                   \
  X(ChannelMix, ChannelMix, false)               \
  X(Labels, Labels, false)                       \
  X(FilteredLit, FilteredLit, false)

#define GV_KIND(kind, Shader, shadows) k##kind,
enum class ShaderKind : int32_t { GV_SHADERS(GV_KIND) kCount };
#undef GV_KIND

template <class Kind, bool kWithShadows>
struct ShaderType {
  using Shader = Kind;
  static constexpr bool kShadows = kWithShadows;
};

// Returns body(ShaderType) for the shader of a kind.
template <class T, class Body>
auto with_shader(int32_t kind, const Body& body) {
#define GV_CASE(kind, Shader, shadows) \
  case ShaderKind::k##kind:            \
    return body(ShaderType<Shader<T>, shadows>{});
  switch (static_cast<ShaderKind>(kind)) {
    GV_SHADERS(GV_CASE)
    default:
      return body(ShaderType<Plain<T>, false>{});
  }
#undef GV_CASE
}

}  // namespace gvtorch::GV_NAMESPACE
