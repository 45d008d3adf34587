// From node to node along a ray: which node a visit stands in, what is marked there, and where the visit ends. The
// kernels on top of it, trace.h and shade_rays.h, take the samples.
#pragma once

#include "brick.h"
#include "ray.h"
#include "trace_args.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class T>
struct TraceOptions {
  T step;  // world length of the shortest interval
  T stop_alpha;
  T depth_alpha;
  bool by_level;  // a node's brick is asked for before its children
};

template <class T>
struct HitView {
  T* color_r3;
  T* alpha_r1;
  T* depth_r1;
  int32_t* samples_r;
  bool* missed_r;
};

// Which nodes show nothing: worked out before the rays go on a GPU, where many threads would each do it again; on the
// CPU, where most nodes are never visited, when the first ray comes.
constexpr uint8_t kUnknown = 0, kShown = 1, kHidden = 2;

// Rays of a picture are taken in tiles of 8 x 4 pixels, which share bricks; others in order.
struct RayOrder {
  int64_t rays;
  int64_t width;  // pixels of a row; 0: no picture

  GV_HD int64_t count() const { return width == 0 ? rays : (width + 7) / 8 * ((rays / width + 3) / 4) * 32; }
  // The ray at a place of the order; -1: none.
  GV_HD int64_t operator()(int64_t index) const {
    if (width == 0) return index;
    const int64_t tile = index / 32;
    const int64_t tiles = (width + 7) / 8;
    const int32_t bits = static_cast<int32_t>(index % 32);  // of x and y in turn, so that a half is a square
    const int64_t x = tile % tiles * 8 + ((bits & 1) | (bits >> 1 & 2) | (bits >> 2 & 4));
    const int64_t y = tile / tiles * 4 + ((bits >> 1 & 1) | (bits >> 2 & 2));
    return x < width && y * width < rays ? y * width + x : -1;
  }
};

// A visit: the two nodes that answer, and where the answer ends. It ends with the node's box, or where the cone leaves
// [cone_low, cone_high) and other levels are wanted.
template <class T>
struct Visit {
  Holder fine, coarse;  // of the wanted level and of the one above it: the same where they do not blend
  T exit, cone_low, cone_high;
  T voxel, above;  // world size of a voxel of either level
  bool clear;      // hidden: neither marked nor sampled
};

template <class T>
struct Walk {
  RayView rays;
  RayOrder order;
  TreeView tree;
  Levels<T> levels;
  TraceOptions<T> options;
  HitView<T> hits;
  const int32_t* frame_1;

  explicit Walk(const TraceArgs& args)
      : rays{args.origin_r3, args.direction_r3, args.cone_r2, args.range_r2,
             args.place_33,  args.cone_scale,   args.clear_r},
        order{args.rays, args.width},
        tree{args.child_tn,   args.brick_tn,
             args.request_tn, args.stamp_t,
             args.root,       args.root / args.nodes_per_tile,
             args.branching,  args.nodes_per_tile,
             args.max_depth,  digit_bits_of(args.branching, args.max_depth)},
        levels(static_cast<T>(args.root_voxel), static_cast<T>(args.side - 2 * args.border), args.branching),
        options{static_cast<T>(args.step), static_cast<T>(args.stop_alpha), static_cast<T>(args.depth_alpha),
                args.by_level},
        hits{static_cast<T*>(args.color_r3), static_cast<T*>(args.alpha_r1), static_cast<T*>(args.depth_r1),
             args.samples_r, args.missed_r},
        frame_1(args.frame_1) {}

  // Finds the node in which an interval's middle lies; marks what is used and what is missing. `wanted` is the depth
  // that the visit before wanted.
  template <class Number, class Hides, class Path>
  GV_HD Visit<T> find(const Ray<T>& ray, Number& digits, T cone, const Hides& hides, int32_t* stamp_b, Path& path,
                      int32_t& wanted, bool& missed) const {
    // Level of detail: the first depth whose voxel fits into the cone.
    const T infinity = static_cast<T>(INFINITY);
    while (wanted < tree.max_depth && levels.voxel[wanted] > cone) ++wanted;
    while (wanted > 0 && !(levels.voxel[wanted - 1] > cone)) --wanted;
    Visit<T> visit;
    visit.voxel = levels.voxel[wanted];
    visit.above = wanted > 0 ? levels.voxel[wanted - 1] : infinity;
    const bool reached = visit.voxel <= cone;
    const bool blend = reached && wanted > 0;
    visit.cone_low = reached ? visit.voxel : -infinity;
    visit.cone_high = reached ? visit.above : visit.voxel;

    const Place place = descend(tree, digits, wanted, blend, *frame_1, hides, path);
    visit.exit = ray.leave(digits.corner(place.depth, levels), levels.size[place.depth]);
    visit.clear = place.hidden && (place.depth < wanted || !blend);
    if (!visit.clear && mark_missing(place, wanted, blend, cone)) missed = true;

    // The two levels that blend; below the finest level, or where both are the same node, only one is read.
    visit.fine = place.fine;
    visit.coarse = place.coarse.node >= 0 ? place.coarse : visit.fine;
    if (!visit.clear && visit.fine.brick >= 0) store_stamp(&stamp_b[visit.fine.brick], *frame_1);
    if (!visit.clear && visit.coarse.brick >= 0) store_stamp(&stamp_b[visit.coarse.brick], *frame_1);
    return visit;
  }

  GV_HD static bool stays(const Intervals<T>& at, const Visit<T>& visit) {
    const T middle = at.middle();
    const T cone = at.cone(middle);
    return at.inside() && middle < visit.exit && cone >= visit.cone_low && cone < visit.cone_high;
  }

  // Goes to the first interval behind the node.
  GV_HD static void leave(Intervals<T>& at, const Visit<T>& visit) {
    do at.skip(at.cut() ? 1 : at.run(visit.exit, visit.cone_low, visit.cone_high));
    while (stays(at, visit));
  }

  // Asks for what is not there, and tells whether it did. Straight to the wanted level, or level by level: then a
  // brick is there before its node is subdivided.
  GV_HD bool mark_missing(const Place& place, int32_t wanted, bool blend, T cone) const {
    const bool absent = place.brick == kAbsent;
    const bool deeper = place.depth < wanted && place.tile == kAbsent;
    const bool above = blend && place.depth == wanted && tree.brick_tn[place.parent] == kAbsent;
    if (deeper && !(options.by_level && absent)) request(place.node, place.depth, cone, kSubdivide);
    if (absent && (options.by_level || !deeper || place.fine.node < 0)) {
      request(place.node, place.depth, cone, kLoad);
    }
    if (above) request(place.parent, place.depth - 1, cone, kLoad);
    return absent || deeper || above;
  }

  // Priority: how wide one voxel of the node is on the screen, in sixteenths of a pixel.
  GV_HD void request(int32_t node, int32_t depth, T cone, int32_t kind) const {
    const T most = static_cast<T>(kPriorityMask);
    const T priority = cone > 0 ? smaller(levels.voxel[depth] / cone * 16, most) : most;
    post_request(&tree.request_tn[node], kind | static_cast<int32_t>(priority));
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
