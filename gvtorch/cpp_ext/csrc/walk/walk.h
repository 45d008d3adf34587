// Traversal of one ray, node by node: finds the node of each visit, marks what is used and what is missing, and finds
// where the visit ends and which intervals lie in it. A visitor (shade_rays.h, segments.h) defines what is done with
// them. Packets have their own walk (packet_path.h, packet_walk.h).
#pragma once

#include "base/arguments.h"
#include "walk/brick.h"
#include "walk/ray.h"
#include "walk/shade.h"

namespace gvtorch::GV_NAMESPACE {

// Whether a node is hidden. The CPU computes this when the first ray reaches a node, since most are never visited; a
// GPU, where many threads would repeat it, does so for all nodes before the rays are traced: see HideShaded.
constexpr uint8_t kUnknown = 0, kShown = 1, kHidden = 2;

// Rays of a picture are traced in tiles of 8 x 4 pixels, which share bricks; other rays in order.
struct RayOrder {
  int64_t rays;
  int64_t width;  // pixels of a row; 0: no picture

  GV_HD int64_t count() const { return width == 0 ? rays : (width + 7) / 8 * ((rays / width + 3) / 4) * 32; }
  // The ray at a position in the order; -1: none.
  GV_HD int64_t operator()(int64_t index) const {
    if (width == 0) return index;
    const int64_t tile = index / 32;
    const int64_t tiles = (width + 7) / 8;
    const int32_t bits = static_cast<int32_t>(index % 32);  // of x and y in turn: half a tile is a square
    const int64_t x = tile % tiles * 8 + ((bits & 1) | (bits >> 1 & 2) | (bits >> 2 & 4));
    const int64_t y = tile / tiles * 4 + ((bits >> 1 & 1) | (bits >> 2 & 2));
    return x < width && y * width < rays ? y * width + x : -1;
  }
};

// A visit: the two nodes whose bricks are read, and the part of the ray for which they are. It ends with the node's
// box, or where other levels are wanted.
template <class T>
struct Visit : Extent<T> {
  Holder fine, coarse;   // of the wanted level and of the one above it; equal where they do not blend
  T voxel, voxel_above;  // world size of a voxel of either level
  T lookup_t;            // distance at which the node was looked up
  int32_t wanted;        // depth that the level of detail asks for
  bool hidden;           // neither marked nor sampled
};

template <class T>
struct Walk {
  RayView rays;
  RayOrder order;
  TreeView tree;
  Levels<T> levels;
  T step;         // world length of the shortest interval
  bool by_level;  // a node's brick is requested before its children
  T *color_r3, *alpha_r1, *depth_r1;
  int32_t* samples_r;
  bool* missed_r;
  const int32_t* frame_1;
  int32_t* stamp_b;
  T stop_clear, hit_clear;  // transmittance at which a ray ends, and at which its depth is recorded

  static constexpr int64_t kChunkSize = 16;  // see for_each.h

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
        step(static_cast<T>(args.step)),
        by_level(args.by_level),
        color_r3(static_cast<T*>(args.color_r3)),
        alpha_r1(static_cast<T*>(args.alpha_r1)),
        depth_r1(static_cast<T*>(args.depth_r1)),
        samples_r(args.samples_r),
        missed_r(args.missed_r),
        frame_1(args.frame_1),
        stamp_b(args.stamp_b),
        stop_clear(1 - static_cast<T>(args.stop_alpha)),
        hit_clear(1 - static_cast<T>(args.depth_alpha)) {}

  // Follows a ray to its end, or until the visitor stops it. Digits: see `with_digits`. A visitor has:
  //
  //   kSeesEmpty                       true if EMPTY nodes are visited too
  //   missed()                         a bool&, set where visible data is missing
  //   goes_on()                        false if no further node is to be visited: the ray stops between two nodes
  //   node_words(node)                 the node's NodeWords, with kConcealed where nothing in it is visible
  //   enter(ray, visit, digits)        begins a visit; returns the visitor's data for it, `node` below
  //   uniform(node)                    true if the visit may be taken as one interval
  //   region(node, start, end)         takes the visit as one interval
  //   take_intervals(node, intervals, run_length, last)
  //                                    takes at most `run_length` whole intervals or, with `last`, the ray's last one,
  //                                    which is cut at the far side; returns how many it took
  //   sees()                           false if the ray stops within this node, because it can see no farther
  //   finish(node)                     ends a visit whose intervals have been taken
  template <class Digits, class Visitor>
  GV_HD void follow(const Ray<T>& ray, Intervals<T>& intervals, Visitor& visitor) const {
    int32_t wanted = 0;
    while (intervals.inside()) {
      if (is_ahead(intervals.start, wanted)) continue;
      if (!visitor.goes_on()) return;
      visit<Digits>(ray, intervals, visitor, wanted);
    }
  }

  // True if a ray has to wait for the others of its warp (on CUDA; results do not depend on it). In each turn, every
  // ray of a warp visits one node, and the turn lasts as long as the visit with the most intervals. Rays that do not
  // wait would soon be in different nodes, and in each turn one long visit would delay many short ones. A ray therefore
  // waits while it is more than a node's side ahead of the warp's hindmost ray, which never waits.
  GV_HD bool is_ahead(T start, int32_t wanted) const {
    return start - warp_minimum(start) > levels.voxel[wanted] * levels.scale[0];
  }

  // Visits one node: finds it, marks it, and takes all intervals whose middle lies in it.
  template <class Digits, class Visitor>
  GV_HD void visit(const Ray<T>& ray, Intervals<T>& intervals, Visitor& visitor, int32_t& wanted) const {
    const T middle = intervals.middle();
    Digits digits(tree, levels, rays, ray, middle);
    const auto node_words = [&](int32_t node) { return visitor.node_words(node); };
    Visit<T> visit = find(ray, digits, intervals.cone(middle), node_words, wanted, visitor.missed());
    visit.lookup_t = middle;
    const bool empty = !Visitor::kSeesEmpty && visit.fine.brick == kEmpty && visit.coarse.brick == kEmpty;
    if (visit.hidden || visit.fine.node < 0 || empty) return intervals.leave(true, visit);
    auto node = visitor.enter(ray, visit, digits);
    if (visitor.uniform(node)) {
      const T entry = intervals.start;
      intervals.leave(true, visit);
      return visitor.region(node, entry, smaller(intervals.start, intervals.stop));
    }
    march(visit, intervals, visitor, node);
    visitor.finish(node);
  }

  // Takes the remaining intervals of a visit.
  template <class Visitor, class Node>
  GV_HD void march(const Extent<T>& extent, Intervals<T>& intervals, Visitor& visitor, Node& node) const {
    do {
      const bool last = intervals.cut();
      const int32_t run_length = last ? 1 : intervals.run(true, extent);
      const int32_t taken = visitor.take_intervals(node, intervals, run_length, last);
      intervals.move_to(true, intervals.count + static_cast<T>(taken));
      if (last) return;
    } while (visitor.sees() && intervals.stays(extent));
  }

  // Finds the node in which an interval's middle lies; marks what is used and what is missing. `wanted` enters as the
  // depth that the previous visit wanted. Level of detail: the first depth whose voxel fits into the cone
  // (`PacketPath::choose_depth` is the same for packets, `Levels.wanted` in the twin).
  template <class Digits, class ReadWords>
  GV_HD Visit<T> find(const Ray<T>& ray, Digits& digits, T cone, const ReadWords& read_words, int32_t& wanted,
                      bool& missed) const {
    const T infinity = static_cast<T>(INFINITY);
    while (wanted < tree.max_depth && levels.voxel[wanted] > cone) ++wanted;
    while (wanted > 0 && !(levels.voxel[wanted - 1] > cone)) --wanted;
    Visit<T> visit;
    visit.wanted = wanted;
    visit.voxel = levels.voxel[wanted];
    visit.voxel_above = wanted > 0 ? levels.voxel[wanted - 1] : infinity;
    const bool reached = visit.voxel <= cone;
    const bool blend = reached && wanted > 0;
    visit.cone_low = reached ? visit.voxel : -infinity;
    visit.cone_high = reached ? visit.voxel_above : visit.voxel;

    const Descent descent = descend(tree, digits, wanted, blend, *frame_1, read_words);
    visit.exit = ray.exit_distance([&](int axis, bool upper) { return digits.face(axis, descent.depth, upper); });
    visit.hidden = descent.hidden && (descent.depth < wanted || !blend);
    if (!visit.hidden && mark_missing(descent, wanted, blend, cone)) missed = true;

    // The two levels that blend. Only one is read where both are the same node, as where no voxel fits into the cone.
    visit.fine = descent.fine;
    visit.coarse = descent.coarse.node >= 0 ? descent.coarse : visit.fine;
    if (!visit.hidden && visit.fine.brick >= 0) store_stamp(&stamp_b[visit.fine.brick], *frame_1);
    const bool two_nodes = visit.coarse.node != visit.fine.node;
    if (!visit.hidden && two_nodes && visit.coarse.brick >= 0) store_stamp(&stamp_b[visit.coarse.brick], *frame_1);
    return visit;
  }

  // Requests what is missing; returns whether anything is. Requests go straight to the wanted level, or level by level:
  // then a node has its brick before it is subdivided. A missing brick or too coarse a node always leads to a request.
  GV_HD bool mark_missing(const Descent& descent, int32_t wanted, bool blend, T cone) const {
    const bool brick_missing = descent.brick == kAbsent;
    const bool too_coarse = descent.depth < wanted && descent.tile == kAbsent;
    const bool parent_lacks = blend && descent.depth == wanted && tree.brick_of(descent.parent) == kAbsent;
    if (too_coarse && !(by_level && brick_missing)) request(descent.node, descent.depth, cone, kSubdivide);
    if (brick_missing && (by_level || !too_coarse || descent.fine.node < 0)) {
      request(descent.node, descent.depth, cone, kLoad);
    }
    if (parent_lacks) request(descent.parent, descent.depth - 1, cone, kLoad);
    return brick_missing || too_coarse || parent_lacks;
  }

  // Priority: the width of one of the node's voxels on the screen, in sixteenths of a pixel, up to 128 pixels.
  GV_HD void request(int32_t node, int32_t depth, T cone, int32_t kind) const {
    const T max_priority = static_cast<T>(kPriorityMask);
    const T priority = cone > 0 ? smaller(levels.voxel[depth] / cone * 16, max_priority) : max_priority;
    if (tree.request_tn == nullptr) return;
    post_request(&tree.request_tn[node], kind | static_cast<int32_t>(priority));
  }

  // Stores the results of a ray. `moved`: distance from the camera to the ray's origin, from where sum.depth counts.
  GV_HD void store(int64_t number, const ShadeSum<T>& sum, T moved, int32_t samples) const {
    color_r3[3 * number] = sum.red;
    color_r3[3 * number + 1] = sum.green;
    color_r3[3 * number + 2] = sum.blue;
    alpha_r1[number] = 1 - sum.clear;
    depth_r1[number] = sum.depth + moved;
    samples_r[number] = samples;
    missed_r[number] = sum.missed;
  }
};

}  // namespace gvtorch::GV_NAMESPACE
