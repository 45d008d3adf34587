// Voxels that hold labels (the numbers of things in a segmentation): each position shows the label of its nearest
// voxel, and no two labels are ever mixed.
//
// Equal to ops/reference/shaders.py and labels.py.
#pragma once

#include "shaders/plain.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

constexpr int32_t kMostReach = 3;  // voxels

// The table has a row for each label: consecutive whole numbers, from the first row's value on. Where two levels blend,
// their colours do. The normal is the mean offset to the voxels of other labels around the position, weighted by a tent
// that ends half a voxel beyond `border` voxels, 1 to 3.
template <class T>
struct Labels : ShaderFacts {
  static constexpr bool kReadsAll = true;
  static constexpr int32_t kFeatures = 1;  // 1 + the row of the label where depth is recorded
  template <class V>
  using SumOf = ShadeSum<V>;
  using Sum = SumOf<T>;
  TransferTable<T> transfer;
  T step;
  Light<T> light;
  int32_t component;

  explicit Labels(const ShadeArgs& args)
      : transfer(args), step(static_cast<T>(args.step)), light(args), component(args.component) {}

  struct Own {
    T lit;  // 1 or 0
  };
  // What one of the nodes adds for an interval.
  struct Look {
    Row<T> row{};      // premultiplied
    Vec3<T> normal{};  // times alpha
    int32_t label = 0;
  };

  template <class RangeOf>
  GV_HD bool hides_ranges(const RangeOf& range_of) const {
    const auto range = range_of(component);
    const Transfer<T> places(transfer);
    const int32_t first = row_of(places, range.low), last = row_of(places, range.high);
    return places.opaque_m[last] == (first > 0 ? places.opaque_m[first - 1] : 0);
  }
  template <class V, class Eye>
  GV_HD void add(MaskOf<V> which, const Piece<V>& piece, Eye& probe, SumOf<V>& sum) const {
    Row<V> row{};
    Vec3<V> normal{};
    probe.each(which, [&](int lane, const auto& one) {
      const Look look =
          blended(lane_of(piece.middle, lane), lane_of(piece.length, lane), lane_of(piece.level, lane), piece.odd, one);
      const T clear = lane_of(sum.clear, lane), left = clear * (1 - look.row.alpha);
      if (left < sum.hit_clear && clear >= sum.hit_clear) {
        lane_of(sum.feature_c, lane)[0] = static_cast<T>(1 + look.label);
      }
      set_lane(row.red, lane, look.row.red);
      set_lane(row.green, lane, look.row.green);
      set_lane(row.blue, lane, look.row.blue);
      set_lane(row.alpha, lane, look.row.alpha);
      for (int axis = 0; axis < 3; ++axis) set_lane(normal[axis], lane, look.normal[axis]);
    });
    const MaskOf<V> shown = which && row.alpha > 0;
    if (!any(shown)) return;
    sum.add_normal(normal, sum.clear, shown);
    sum.add_light(row, sum.clear, shown);
    sum.absorb(row.alpha, piece.start, piece.length, sum.hit_clear, shown);
  }
  GV_HD void done(Sum&) const {}

 private:
  GV_HD static int32_t row_of(const Transfer<T>& places, T label) {
    return static_cast<int32_t>(clamp(label - places.low, static_cast<T>(0), places.last));
  }
  // Blends both nodes; the label is the finer node's, or the coarser one's where the finer node shows nothing.
  GV_HD Look blended(T t, T length, int32_t level, bool odd, const Probe<T>& probe) const {
    Look look;
#ifdef __CUDA_ARCH__
#pragma unroll 1
#endif
    for (int which = 0; which <= static_cast<int>(probe.mixed); ++which) {
      const Look one = look_at(t, length, level, odd, probe, which == 0 ? probe.fine : probe.coarse);
      if (which == 0) {
        look = one;
        continue;
      }
      if (!(look.row.alpha > 0)) look.label = one.label;
      look.row = probe.between(look.row, one.row, t);
      look.normal = probe.between(look.normal, one.normal, t);
    }
    return look;
  }
  GV_HD Look look_at(T t, T length, int32_t level, bool odd, const Probe<T>& probe, const Spot<T>& spot) const {
    const Transfer<T> places(transfer);
    Look look;
    int32_t cell[3] = {0, 0, 0};
    T from[3] = {0, 0, 0}, label;
    if (spot.brick < 0) {
      label = probe.value_of(spot, t);
    } else {
      find(probe.channels, spot.at(t), cell, from);
      label = probe.value_in(spot, cell[0], cell[1], cell[2]);
    }
    look.label = row_of(places, label);
    Row<T> row = load_row(&places.table_lm[(odd ? 0 : level) * places.rows + look.label]);
    if (!(row.alpha > 0)) return look;
    if (odd) row.alpha = stretch(row.alpha, length / step);
    if (own_numbers<Own>(light.parameters).lit > 0) {
      if (spot.brick >= 0) look.normal = normal(probe, spot, cell, from, label);
      row = light.shade(row, look.normal, probe, t);
    }
    for (int axis = 0; axis < 3; ++axis) look.normal[axis] = look.normal[axis] * row.alpha;
    look.row = {row.red * row.alpha, row.green * row.alpha, row.blue * row.alpha, row.alpha};
    return look;
  }
  // Finds the node's voxel whose cube contains a position, and the offset `from` the voxel's centre; a face that two
  // voxels share belongs to the upper one.
  GV_HD static void find(const Channels& channels, const Vec3<T>& at, int32_t (&cell)[3], T (&from)[3]) {
    const T half = static_cast<T>(0.5);
    for (int axis = 0; axis < 3; ++axis) {
      const T low = static_cast<T>(channels.border), high = static_cast<T>(channels.side - 1 - channels.border);
      const T place = clamp(at[axis] + half, low, high + static_cast<T>(1));
      cell[axis] = smaller(static_cast<int32_t>(place), channels.side - 1 - channels.border);
      from[axis] = clamp(at[axis] - static_cast<T>(cell[axis]), -half, half);
    }
  }
  // Unit normal along the mean offset, turned towards the eye. Beyond the brick, its outermost voxels are repeated.
  GV_HD Vec3<T> normal(const Probe<T>& probe, const Spot<T>& spot, const int32_t (&cell)[3], const T (&from)[3],
                       T label) const {
    const int32_t reach = larger(smaller(probe.channels.border, kMostReach), 1), last = probe.channels.side - 1;
    T share[3][2 * kMostReach + 1], way[3][2 * kMostReach + 1];  // per axis: weights, and weights times offsets
    for (int axis = 0; axis < 3; ++axis) {
      for (int k = -reach; k <= reach; ++k) {
        const T offset = static_cast<T>(k) - from[axis];
        const T left = static_cast<T>(reach) + static_cast<T>(0.5) - absolute(offset);
        share[axis][k + reach] = larger(left, static_cast<T>(0));
        way[axis][k + reach] = share[axis][k + reach] * offset;
      }
    }
    const auto beside = [&](int axis, int k) { return smaller(larger(cell[axis] + k - reach, 0), last); };
    Vec3<T> n{0, 0, 0};
#ifdef __CUDA_ARCH__
#pragma unroll 1
#endif
    for (int k = 0; k <= 2 * reach; ++k) {
      T plane = 0, along_x = 0, along_y = 0;
#ifdef __CUDA_ARCH__
#pragma unroll 1
#endif
      for (int j = 0; j <= 2 * reach; ++j) {
        T row = 0, along = 0;
        for (int i = 0; i <= 2 * reach; ++i) {
          const T other = probe.value_in(spot, beside(0, i), beside(1, j), beside(2, k));
          const T differs = other == label ? static_cast<T>(0) : static_cast<T>(1);
          row = row + share[0][i] * differs;
          along = along + way[0][i] * differs;
        }
        plane = plane + share[1][j] * row;
        along_x = along_x + share[1][j] * along;
        along_y = along_y + way[1][j] * row;
      }
      n.x = n.x + share[2][k] * along_x;
      n.y = n.y + share[2][k] * along_y;
      n.z = n.z + way[2][k] * plane;
    }
    for (int axis = 0; axis < 3; ++axis) n[axis] = n[axis] * (spot.scale / probe.cube[axis]);
    return light.to_eye(n, probe.sight.direction);
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
