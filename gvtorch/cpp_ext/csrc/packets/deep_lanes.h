// The positions of a packet's lanes in a deep tree: in float64 and int64, and so lane by lane. Independent of the
// shader, so that it is compiled once.
#pragma once

#include "base/simd.h"
#include "walk/tree.h"

namespace gvtorch::GV_NAMESPACE {

struct DeepLanes {
  const RayView& rays;
  const TreeView& tree;
  const Levels<float>& levels;
  Vec3<double> origin[kLanes];
  Vec3<int64_t> cell[kLanes]{};

  DeepLanes(const RayView& rays, const TreeView& tree, const Levels<float>& levels)
      : rays(rays), tree(tree), levels(levels) {}
  // Begins a ray in a lane; `cell` is still that of the previous ray.
  GV_HD void begin(int lane, const Ray<float>& ray) {
    for (int axis = 0; axis < 3; ++axis) origin[lane][axis] = ray.exact_origin(axis);
  }

  // The lane's position at distance t of a ray.
  GV_HD Vec3<double> along(int lane, const Vec3<float>& direction, float t) const {
    Vec3<double> position;
    for (int axis = 0; axis < 3; ++axis) {
      position[axis] = origin[lane][axis] + static_cast<double>(t) * static_cast<double>(direction[axis]);
    }
    return position;
  }
  // See PacketPath::move_to.
  GV_CALL Ints move_to(Mask mask, const Vec3<Floats>& direction, Floats t, Ints deepest) {
    Vec3<double> high;
    for (int axis = 0; axis < 3; ++axis) high[axis] = Digits<float>::upper_bound_of(rays, axis);
    for_lanes(mask, [&](int lane) {
      const Digits<float> old_digits = digits(lane);
      const Vec3<double> position = along(lane, lane_of(direction, lane), t[lane]);
      for (int axis = 0; axis < 3; ++axis) {
        cell[lane][axis] = Digits<float>::cell_at(levels, tree.max_depth, position[axis], high[axis]);
      }
      const Digits<float> new_digits = digits(lane);
      int32_t level = deepest[lane];
      while (level > 0 && !new_digits.in_same_node(old_digits, level)) --level;
      deepest[lane] = level;
    });
    return deepest;
  }
  GV_CALL Ints child(Mask mask, int32_t level) const {
    Ints children{};
    for_lanes(mask, [&](int lane) {
      Digits<float> lane_digits = digits(lane);
      lane_digits.start_below(level - 1);
      children[lane] = lane_digits.child(level);
    });
    return children;
  }
  GV_CALL Floats face(Mask mask, int axis, Ints level, Mask upper) const {
    Floats offsets{};
    for_lanes(mask, [&](int lane) { offsets[lane] = digits(lane).face(axis, level[lane], upper[lane] != 0); });
    return offsets;
  }

 private:
  GV_HD Digits<float> digits(int lane) const { return {tree, levels, origin[lane], cell[lane]}; }
};

}  // namespace gvtorch::GV_NAMESPACE
