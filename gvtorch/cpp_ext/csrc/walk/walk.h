// From node to node along a ray: which node a visit stands in, what is marked there, where the visit ends, and which
// intervals are taken in it. What is made of them a visitor tells: that of shade_rays.h or segments.h. Packets
// have a walk of their own (packet_walk.h).
#pragma once

#include "base/arguments.h"
#include "walk/brick.h"
#include "walk/ray.h"
#include "walk/shade.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class T>
struct TraceOptions {
  T step;         // world length of the shortest interval
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

// Which nodes show nothing: looked at once, when the first ray comes, on the CPU, where most nodes are never visited.
// On a GPU, where many threads would each do it again, before the rays are traced: see NodeWords.
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

// A visit: the two nodes that answer, and where they do. That ends with the node's box, or where other levels are
// wanted.
template <class T>
struct Visit : Extent<T> {
  Holder fine, coarse;  // of the wanted level and of the one above it: the same where they do not blend
  T voxel, above;       // world size of a voxel of either level
  T seen;               // distance at which the node was looked up
  int32_t wanted;       // the level
  bool hidden;          // neither marked nor sampled
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
  int32_t* stamp_b;
  T stop_clear, hit_clear;  // transmittance at which a ray ends, and at which its depth is taken

  static constexpr int64_t kShare = 16;  // see for_each.h

  explicit Walk(const TraceArgs& args)
      : rays{args.origin_r3, args.direction_r3, args.cone_r2,  args.range_r2,
             args.place_33,  args.cone_scale,   is_deep(args), args.clear_r},
        order{args.rays, args.width},
        tree{args.child_tn,
             args.brick_tn,
             args.request_tn,
             args.stamp_t,
             args.root,
             args.root / args.nodes_per_tile,
             args.branching,
             args.nodes_per_tile,
             args.max_depth,
             digit_bits_of(args.branching),
             static_cast<int32_t>(args.nodes / args.nodes_per_tile),
             static_cast<int32_t>(args.bricks)},
        levels(args.root_voxel, args.side - 2 * args.border, args.branching),
        options{static_cast<T>(args.step), args.by_level},
        hits{static_cast<T*>(args.color_r3), static_cast<T*>(args.alpha_r1), static_cast<T*>(args.depth_r1),
             args.samples_r, args.missed_r},
        frame_1(args.frame_1),
        stamp_b(args.stamp_b),
        stop_clear(1 - static_cast<T>(args.stop_alpha)),
        hit_clear(1 - static_cast<T>(args.depth_alpha)) {}

  // Goes along a ray to its end, or until the visitor has enough. Digits: see `with_digits`. A visitor has:
  //
  //   kSeesEmpty                       EMPTY nodes count
  //   missed()                         a bool&: something that is seen was not there
  //   more()                           the ray goes on to another node
  //   words(node)                      its NodeWords, concealed where nothing in the node is seen
  //   enter(ray, visit, digits)        what the visitor has to know of a visit, `node` below
  //   uniform(node)                    the visit may be taken as one interval
  //   region(node, start, end)         takes it so
  //   take(node, at, alike, last)      takes up to so many whole intervals, or the ray's last one, which is cut at
  //                                    the far side; returns how many
  //   sees()                           the ray goes on in this node
  //   finish(node)                     all intervals of the visit have been taken
  template <class Digits, class Visitor>
  GV_HD void follow(const Ray<T>& ray, Intervals<T>& at, Visitor& visitor) const {
    int32_t wanted = 0;
    while (at.inside()) {
      if (is_ahead(at.start, wanted)) continue;
      if (!visitor.more()) return;
      visit<Digits>(ray, at, visitor, wanted);
    }
  }

  // Whether a ray waits for the others of its warp (on CUDA; results do not depend on it). In each turn a warp visits
  // one node a ray and samples as long as the ray with the most intervals there. Rays that cut a corner of one more
  // node fall a turn behind, and then long and short runs fall together. So a ray waits while it is more than the side
  // of a node ahead of the warp's hindmost one, which never waits.
  GV_HD bool is_ahead(T start, int32_t wanted) const {
    return start - smallest_together(start) > levels.voxel[wanted] * levels.scale[0];
  }

  // One node: finds it, marks it, and takes all intervals whose middle lies in it.
  template <class Digits, class Visitor>
  GV_HD void visit(const Ray<T>& ray, Intervals<T>& at, Visitor& visitor, int32_t& wanted) const {
    const T middle = at.middle();
    Digits digits(tree, levels, rays, ray, middle);
    const auto words = [&](int32_t node) { return visitor.words(node); };
    Visit<T> visit = find(ray, digits, at.cone(middle), words, wanted, visitor.missed());
    visit.seen = middle;
    const bool empty = !Visitor::kSeesEmpty && visit.fine.brick == kEmpty && visit.coarse.brick == kEmpty;
    if (visit.hidden || visit.fine.node < 0 || empty) return at.leave(true, visit);
    auto node = visitor.enter(ray, visit, digits);
    if (visitor.uniform(node)) {
      const T entry = at.start;
      at.leave(true, visit);
      return visitor.region(node, entry, smaller(at.start, at.stop));
    }
    march(visit, at, visitor, node);
    visitor.finish(node);
  }

  // All intervals of a visit that are still to come.
  template <class Visitor, class Node>
  GV_HD void march(const Extent<T>& extent, Intervals<T>& at, Visitor& visitor, Node& node) const {
    do {
      const bool last = at.cut();
      const int32_t alike = last ? 1 : at.run(true, extent);
      const int32_t taken = visitor.take(node, at, alike, last);
      at.go(true, at.count + static_cast<T>(taken));
      if (last) return;
    } while (visitor.sees() && at.stays(extent));
  }

  // Finds the node in which an interval's middle lies; marks what is used and what is missing. `wanted` is the depth
  // that the visit before wanted. Level of detail: the first depth whose voxel fits into the cone (packet_walk.h
  // decides likewise for many rays; Levels.wanted in the twin).
  template <class Digits, class Words>
  GV_HD Visit<T> find(const Ray<T>& ray, Digits& digits, T cone, const Words& words, int32_t& wanted,
                      bool& missed) const {
    const T infinity = static_cast<T>(INFINITY);
    while (wanted < tree.max_depth && levels.voxel[wanted] > cone) ++wanted;
    while (wanted > 0 && !(levels.voxel[wanted - 1] > cone)) --wanted;
    Visit<T> visit;
    visit.wanted = wanted;
    visit.voxel = levels.voxel[wanted];
    visit.above = wanted > 0 ? levels.voxel[wanted - 1] : infinity;
    const bool reached = visit.voxel <= cone;
    const bool blend = reached && wanted > 0;
    visit.cone_low = reached ? visit.voxel : -infinity;
    visit.cone_high = reached ? visit.above : visit.voxel;

    const Place place = descend(tree, digits, wanted, blend, *frame_1, words);
    visit.exit = ray.leave([&](int axis, bool upper) { return digits.face(axis, place.depth, upper); });
    visit.hidden = place.hidden && (place.depth < wanted || !blend);
    if (!visit.hidden && mark_missing(place, wanted, blend, cone)) missed = true;

    // The two levels that blend; below the finest level, or where both are the same node, only one is read.
    visit.fine = place.fine;
    visit.coarse = place.coarse.node >= 0 ? place.coarse : visit.fine;
    if (!visit.hidden && visit.fine.brick >= 0) store_stamp(&stamp_b[visit.fine.brick], *frame_1);
    const bool other = visit.coarse.node != visit.fine.node;
    if (!visit.hidden && other && visit.coarse.brick >= 0) store_stamp(&stamp_b[visit.coarse.brick], *frame_1);
    return visit;
  }

  // Asks for what is not there, and tells whether it did. Straight to the wanted level, or level by level: then a
  // brick is there before its node is subdivided. A node that is absent or too coarse always leads to a request.
  GV_HD bool mark_missing(const Place& place, int32_t wanted, bool blend, T cone) const {
    const bool absent = place.brick == kAbsent;
    const bool deeper = place.depth < wanted && place.tile == kAbsent;
    const bool above = blend && place.depth == wanted && tree.brick_of(place.parent) == kAbsent;
    if (deeper && !(options.by_level && absent)) request(place.node, place.depth, cone, kSubdivide);
    if (absent && (options.by_level || !deeper || place.fine.node < 0)) {
      request(place.node, place.depth, cone, kLoad);
    }
    if (above) request(place.parent, place.depth - 1, cone, kLoad);
    return absent || deeper || above;
  }

  // Priority: how wide one voxel of the node is on the screen, in sixteenths of a pixel, up to 128 pixels.
  GV_HD void request(int32_t node, int32_t depth, T cone, int32_t kind) const {
    const T most = static_cast<T>(kPriorityMask);
    const T priority = cone > 0 ? smaller(levels.voxel[depth] / cone * 16, most) : most;
    if (tree.request_tn == nullptr) return;
    post_request(&tree.request_tn[node], kind | static_cast<int32_t>(priority));
  }

  // What a ray gives. `moved`: from the camera to where depth counts from.
  GV_HD void store(int64_t number, const Accumulator<T>& sum, T moved, int32_t samples) const {
    hits.color_r3[3 * number] = sum.red;
    hits.color_r3[3 * number + 1] = sum.green;
    hits.color_r3[3 * number + 2] = sum.blue;
    hits.alpha_r1[number] = 1 - sum.clear;
    hits.depth_r1[number] = sum.depth + moved;
    hits.samples_r[number] = samples;
    hits.missed_r[number] = sum.missed;
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
