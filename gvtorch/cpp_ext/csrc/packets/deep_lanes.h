// The positions of a packet's lanes in a deep tree: in float64 and int64, and so lane by lane. Independent of the
// shader, so that it is compiled once.
#pragma once

#include "base/simd.h"
#include "walk/tree.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

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
    for (int axis = 0; axis < 3; ++axis) origin[lane][axis] = ray.place(axis);
  }

  // See PacketWalk::go.
  GV_CALL Ints go(Mask which, const Vec3<Floats>& direction, Floats t, Ints known) {
    Vec3<double> high;
    for (int axis = 0; axis < 3; ++axis) high[axis] = Digits<float>::inner_of(rays, axis);
    for_lanes(which, [&](int lane) {
      const Digits<float> before = digits(lane);
      for (int axis = 0; axis < 3; ++axis) {
        const double place =
            origin[lane][axis] + static_cast<double>(t[lane]) * static_cast<double>(direction[axis][lane]);
        cell[lane][axis] = Digits<float>::cell_at(levels, tree.max_depth, place, high[axis]);
      }
      const Digits<float> now = digits(lane);
      int32_t level = known[lane];
      while (level > 0 && !now.shares(before, level)) --level;
      known[lane] = level;
    });
    return known;
  }
  GV_CALL Ints child(Mask which, int32_t level) const {
    Ints found{};
    for_lanes(which, [&](int lane) {
      Digits<float> own = digits(lane);
      own.start_below(level - 1);
      found[lane] = own.child(level);
    });
    return found;
  }
  GV_CALL Floats face(Mask which, int axis, Ints level, Mask upper) const {
    Floats found{};
    for_lanes(which, [&](int lane) { found[lane] = digits(lane).face(axis, level[lane], upper[lane] != 0); });
    return found;
  }

 private:
  GV_HD Digits<float> digits(int lane) const { return {tree, levels, origin[lane], cell[lane]}; }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
