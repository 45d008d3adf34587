// Voxels that hold labels (the numbers of things in a segmentation): each position shows the label of its nearest
// voxel, and no two labels are ever mixed.
//
// Equal to ops/reference/labels.py.
#pragma once

#include "shaders/light.h"
#include "shaders/plain.h"

namespace gvtorch::GV_NAMESPACE {

constexpr int32_t kMaxReach = 3;  // voxels

// The table has a row for each label: consecutive whole numbers, from the first row's value on. Where two levels blend,
// their colours do. The normal is the mean offset to the voxels of other labels around the position, weighted by a tent
// that ends half a voxel beyond `border` voxels, 1 to 3.
template <class T>
struct Labels : ShaderFacts {
  static constexpr bool kReadsAll = true;
  static constexpr int32_t kFeatures = 1;  // 1 + the row of the label where depth is recorded
  using Sum = ShadeSum<T>;
  TransferTable<T> transfer;
  T step;
  Light<T> light;
  int32_t component;

  explicit Labels(const ShadeArgs& args)
      : transfer(args), step(static_cast<T>(args.step)), light(args), component(args.component) {}

  struct Numbers {
    T lit;  // 1 or 0
  };
  // What one of the nodes adds for an interval.
  struct Contribution {
    Row<T> row{};      // premultiplied
    Vec3<T> normal{};  // times alpha
    int32_t label = 0;
  };

  template <class RangeOf>
  GV_HD bool hides_ranges(const RangeOf& range_of) const {
    const auto range = range_of(component);
    const Transfer<T> table(transfer);
    const int32_t first = row_of(table, range.low), last = row_of(table, range.high);
    return table.opaque_m[last] == (first > 0 ? table.opaque_m[first - 1] : 0);
  }
  template <class V, class AnyProbe>
  GV_HD void add(MaskOf<V> mask, const Interval<V>& interval, AnyProbe& probe, ShadeSum<V>& sum) const {
    Row<V> row{};
    Vec3<V> normal{};
    probe.each_lane(mask, [&](int lane, const auto& lane_probe) {
      const Contribution contribution = blended(take_lane<Interval<T>>(interval, lane), lane_probe);
      const T clear = lane_of(sum.clear, lane), clear_after = clear * (1 - contribution.row.alpha);
      if (clear_after < sum.hit_clear && clear >= sum.hit_clear) {
        lane_of(sum.feature_c, lane)[0] = static_cast<T>(1 + contribution.label);
      }
      put_lane(row, lane, contribution.row);
      for (int axis = 0; axis < 3; ++axis) set_lane(normal[axis], lane, contribution.normal[axis]);
    });
    const MaskOf<V> shown = mask && row.alpha > 0;
    if (!any(shown)) return;
    sum.add_normal(normal, sum.clear, shown);
    sum.add_premultiplied(row, interval, shown);
  }

 private:
  GV_HD static int32_t row_of(const Transfer<T>& table, T label) {
    return static_cast<int32_t>(clamp(label - table.low, static_cast<T>(0), table.last));
  }
  // Blends both nodes; the label is the finer node's, or the coarser one's where the finer node shows nothing.
  GV_HD Contribution blended(const Interval<T>& interval, const Probe<T>& probe) const {
    Contribution result;
    GV_NO_UNROLL
    for (int node = 0; node <= static_cast<int>(probe.mixed); ++node) {
      const Contribution contribution = contribution_of(interval, probe, node == 0 ? probe.fine : probe.coarse);
      if (node == 0) {
        result = contribution;
        continue;
      }
      if (!(result.row.alpha > 0)) result.label = contribution.label;
      result.row = probe.between(result.row, contribution.row, interval.middle);
      result.normal = probe.between(result.normal, contribution.normal, interval.middle);
    }
    return result;
  }
  GV_HD Contribution contribution_of(const Interval<T>& interval, const Probe<T>& probe, const Spot<T>& spot) const {
    const Transfer<T> table(transfer);
    const T t = interval.middle;
    Contribution result;
    int32_t cell[3] = {0, 0, 0};
    T from_center[3] = {0, 0, 0}, label;
    if (spot.brick < 0) {
      label = probe.value_of(spot, t);
    } else {
      find(probe.channels, spot.at(t), cell, from_center);
      label = probe.value_in(spot, cell[0], cell[1], cell[2]);
    }
    result.label = row_of(table, label);
    Row<T> row = load_row(&table.table_lm[(interval.odd ? 0 : interval.level) * table.rows + result.label]);
    if (!(row.alpha > 0)) return result;
    if (interval.odd) row.alpha = stretch(row.alpha, interval.length / step);
    if (own_numbers<Numbers>(light.parameters).lit > 0) {
      if (spot.brick >= 0) result.normal = normal(probe, spot, cell, from_center, label);
      row = light.shade(row, result.normal, probe, t);
    }
    for (int axis = 0; axis < 3; ++axis) result.normal[axis] = result.normal[axis] * row.alpha;
    result.row = {row.red * row.alpha, row.green * row.alpha, row.blue * row.alpha, row.alpha};
    return result;
  }
  // Finds the node's voxel whose cube contains a position, and its offset from the voxel's centre; a face that two
  // voxels share belongs to the upper one.
  GV_HD static void find(const Channels& channels, const Vec3<T>& position, int32_t (&cell)[3], T (&from_center)[3]) {
    const T half = static_cast<T>(0.5);
    for (int axis = 0; axis < 3; ++axis) {
      const T low = static_cast<T>(channels.border), high = static_cast<T>(channels.side - 1 - channels.border);
      const T clamped = clamp(position[axis] + half, low, high + static_cast<T>(1));
      cell[axis] = smaller(static_cast<int32_t>(clamped), channels.side - 1 - channels.border);
      from_center[axis] = clamp(position[axis] - static_cast<T>(cell[axis]), -half, half);
    }
  }
  // Unit normal along the mean offset, turned towards the eye. Beyond the brick, its outermost voxels are repeated.
  GV_HD Vec3<T> normal(const Probe<T>& probe, const Spot<T>& spot, const int32_t (&cell)[3], const T (&from_center)[3],
                       T label) const {
    const int32_t reach = larger(smaller(probe.channels.border, kMaxReach), 1), last = probe.channels.side - 1;
    T weight[3][2 * kMaxReach + 1], moment[3][2 * kMaxReach + 1];  // per axis: weights, and weights times offsets
    for (int axis = 0; axis < 3; ++axis) {
      for (int k = -reach; k <= reach; ++k) {
        const T offset = static_cast<T>(k) - from_center[axis];
        const T tent = static_cast<T>(reach) + static_cast<T>(0.5) - absolute(offset);
        weight[axis][k + reach] = larger(tent, static_cast<T>(0));
        moment[axis][k + reach] = weight[axis][k + reach] * offset;
      }
    }
    const auto clamped_cell = [&](int axis, int k) { return smaller(larger(cell[axis] + k - reach, 0), last); };
    Vec3<T> n{0, 0, 0};
    GV_NO_UNROLL
    for (int k = 0; k <= 2 * reach; ++k) {
      T plane = 0, along_x = 0, along_y = 0;
      GV_NO_UNROLL
      for (int j = 0; j <= 2 * reach; ++j) {
        T row = 0, along = 0;
        for (int i = 0; i <= 2 * reach; ++i) {
          const T voxel_label = probe.value_in(spot, clamped_cell(0, i), clamped_cell(1, j), clamped_cell(2, k));
          const T differs = voxel_label == label ? static_cast<T>(0) : static_cast<T>(1);
          row = row + weight[0][i] * differs;
          along = along + moment[0][i] * differs;
        }
        plane = plane + weight[1][j] * row;
        along_x = along_x + weight[1][j] * along;
        along_y = along_y + moment[1][j] * row;
      }
      n.x = n.x + weight[2][k] * along_x;
      n.y = n.y + weight[2][k] * along_y;
      n.z = n.z + moment[2][k] * plane;
    }
    for (int axis = 0; axis < 3; ++axis) n[axis] = n[axis] * (spot.scale / probe.cube[axis]);
    return light.to_eye(n, probe.sight.direction);
  }
};

}  // namespace gvtorch::GV_NAMESPACE
