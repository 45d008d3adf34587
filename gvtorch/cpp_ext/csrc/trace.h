// TraceRay: one ray from the scene's near side to its far side. Descend, skip or sample, look the value up in the
// transfer function, composite front to back, and mark what was used and what was missed.
//
// Equal to `trace_rays` in ops/reference.py: integers exactly, and every float operation in the same order.
// Method: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and Detailed Voxel
// Rendering", I3D 2009, sections 3 and 4; Crassin, PhD thesis 2011, chapter 6.
//
// The samples of a ray are fixed before anything is read: interval k + 1 starts where interval k ends, and its
// length is max(cone width there, step). A value is taken in the middle of an interval and stands for its length;
// the last one is cut at the far side. What is skipped therefore never moves a sample, and data that begins
// behind skipped space gets each of its samples, the first included.
#pragma once

#include "brick.h"

namespace gvtorch {

template <class T>
struct RayView {
  const T* origin_r3;     // tree units
  const T* direction_r3;  // tree units per world unit
  const T* cone_r2;       // world units: width at t = 0, growth per world unit
  const T* range_r2;      // world units: first and last t
  const T* bounds_23;     // tree units: the part of the root cube that the scene fills
};

template <class T>
struct TransferView {
  const T* table_m4;        // red, green, blue, opacity per reference length
  const T* domain_3;        // value of the first row, value of the last row, reference length (world units)
  const int32_t* opaque_m;  // rows with an opacity up to this one, itself included
  int32_t rows;
};

// The transfer function with its numbers read once a ray.
template <class T>
struct Transfer {
  const T* table_m4;
  const int32_t* opaque_m;
  T low, scale, last, reference;
  int32_t last_cell;

  GV_HD explicit Transfer(const TransferView<T>& view)
      : table_m4(view.table_m4),
        opaque_m(view.opaque_m),
        low(view.domain_3[0]),
        last(static_cast<T>(view.rows - 1)),
        reference(view.domain_3[2]),
        last_cell(view.rows - 2) {
    scale = last / (view.domain_3[1] - low);
  }

  // No value between the two is seen. They are taken a little apart: interpolation may round beyond its ends.
  GV_HD bool transparent(T smallest, T largest) const {
    const T slack = static_cast<T>(9.5367431640625e-7);  // 2^-20
    const T below = smallest - larger(smallest, -smallest) * slack;
    const T above = largest + larger(largest, -largest) * slack;
    const int32_t first = floor_int(clamp((below - low) * scale, static_cast<T>(0), last));
    const int32_t end = -floor_int(-clamp((above - low) * scale, static_cast<T>(0), last));
    return opaque_m[end] == (first > 0 ? opaque_m[first - 1] : 0);
  }
};

template <class T>
struct TraceOptions {
  T root_voxel;  // world size of a depth-0 voxel, largest axis
  T step;        // world length of the shortest interval
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

// The fixed sequence of intervals of one ray. While the length stays the same, an interval's start is a product,
// not a sum of roundings.
template <class T>
struct Intervals {
  T cone_near, cone_growth, step, stop;
  T base, length;
  T count = 0;
  T start, end, middle;

  GV_HD Intervals(T first, T last, T cone_near, T cone_growth, T step)
      : cone_near(cone_near), cone_growth(cone_growth), step(step), stop(last), base(first) {
    length = larger(cone(first), step);
    place(first);
  }
  GV_HD T cone(T t) const { return cone_near + cone_growth * t; }
  GV_HD bool inside() const { return start < stop; }
  GV_HD void place(T at) {
    start = at;
    end = smaller(at + length, stop);
    middle = start + (end - start) * static_cast<T>(0.5);
  }
  GV_HD void next() {
    count = count + 1;
    const T at = base + count * length;
    if (!(at > start)) {  // the step is below the resolution of T out here: end the ray
      start = stop;
      return;
    }
    const T wanted = larger(cone(at), step);
    if (wanted != length) {
      base = at;
      count = 0;
      length = wanted;
    }
    place(at);
  }
  // Jumps to an interval whose middle is still before `exit`, while the length is known to stay the same up to
  // there; next() walks the rest. Two intervals of slack make rounding harmless.
  GV_HD void leap(T exit) {
    const T limit = smaller(exit, stop);
    if (length != step || cone(limit) > step) return;
    const T target = floor((limit - base) / length) - 2;
    if (target > count) {
      count = target;
      place(base + count * length);
    }
  }
};

template <class T>
struct Accumulator {
  T red = 0, green = 0, blue = 0;
  T clear = 1;  // transmittance
  T depth = static_cast<T>(INFINITY);
  bool hit = false;
  bool missed = false;  // something that was seen was not there
};

template <class T>
GV_HD void composite(const Transfer<T>& transfer, T value, T start, T length, T hit_clear, Accumulator<T>& sum) {
  const T place = clamp((value - transfer.low) * transfer.scale, static_cast<T>(0), transfer.last);
  const int32_t cell = smaller(floor_int(place), transfer.last_cell);
  const T weight = place - static_cast<T>(cell);
  const T* row = transfer.table_m4 + static_cast<int64_t>(cell) * 4;
  const T opacity = row[3] + weight * (row[7] - row[3]);
  if (!(opacity > 0)) return;

  const bool opaque = opacity >= 1;
  const T decay = opaque ? static_cast<T>(0) : log2_exact(1 - opacity);
  const T kept = opaque ? static_cast<T>(0) : exp2_exact(decay * (length / transfer.reference));
  const T clear = sum.clear * kept;
  const T share = sum.clear - clear;
  sum.red = sum.red + share * (row[0] + weight * (row[4] - row[0]));
  sum.green = sum.green + share * (row[1] + weight * (row[5] - row[1]));
  sum.blue = sum.blue + share * (row[2] + weight * (row[6] - row[2]));
  if (!sum.hit && clear < hit_clear) {  // where, inside the interval, the transmittance fell to hit_clear
    sum.hit = true;
    const T into = opaque ? static_cast<T>(0) : log2_exact(hit_clear / sum.clear) / decay * transfer.reference;
    sum.depth = start + clamp(into, static_cast<T>(0), length);
  }
  sum.clear = clear;
}

template <class T, class Voxel>
struct TraceRay {
  RayView<T> rays;
  TreeView tree;
  BrickView<Voxel> bricks;
  TransferView<T> transfer;
  TraceOptions<T> options;
  HitView<T> hits;
  const int32_t* frame_1;

  GV_HD void operator()(int64_t ray) const {
    const Vec3<T> origin{rays.origin_r3[3 * ray], rays.origin_r3[3 * ray + 1], rays.origin_r3[3 * ray + 2]};
    const Vec3<T> direction{rays.direction_r3[3 * ray], rays.direction_r3[3 * ray + 1], rays.direction_r3[3 * ray + 2]};
    T first = rays.range_r2[2 * ray];
    T last = rays.range_r2[2 * ray + 1];
    clip(origin, direction, first, last);

    Intervals<T> at(first, last, rays.cone_r2[2 * ray], rays.cone_r2[2 * ray + 1], options.step);
    const Transfer<T> shader(transfer);
    Accumulator<T> sum;
    const T stop_clear = 1 - options.stop_alpha;
    const T hit_clear = 1 - options.depth_alpha;
    int32_t samples = 0;
    while (at.inside() && sum.clear > stop_clear) {
      samples += visit(origin, direction, shader, at, stop_clear, hit_clear, sum);
    }
    hits.color_r3[3 * ray] = sum.red;
    hits.color_r3[3 * ray + 1] = sum.green;
    hits.color_r3[3 * ray + 2] = sum.blue;
    hits.alpha_r1[ray] = 1 - sum.clear;
    hits.depth_r1[ray] = sum.depth;
    hits.samples_r[ray] = samples;
    hits.missed_r[ray] = sum.missed;
  }

  // Slab test (Kay and Kajiya, "Ray tracing complex scenes", 1986).
  // A ray that no face bounds (no direction, NaN, infinite) is closed, so that no loop runs on for ever.
  GV_HD void clip(Vec3<T> origin, Vec3<T> direction, T& first, T& last) const {
    for (int axis = 0; axis < 3; ++axis) {
      const T low = rays.bounds_23[axis];
      const T high = rays.bounds_23[3 + axis];
      if (direction[axis] == 0) {
        if (!(origin[axis] >= low && origin[axis] <= high)) last = first;
        continue;
      }
      const T a = (low - origin[axis]) / direction[axis];
      const T b = (high - origin[axis]) / direction[axis];
      first = larger(first, smaller(a, b));
      last = smaller(last, larger(a, b));
    }
    if (!(last < static_cast<T>(INFINITY))) last = first;
  }

  GV_HD T leave(Vec3<T> origin, Vec3<T> direction, const Place<T>& place) const {
    T exit = static_cast<T>(INFINITY);
    for (int axis = 0; axis < 3; ++axis) {
      if (direction[axis] == 0) continue;
      const T face = direction[axis] > 0 ? place.corner[axis] + place.size : place.corner[axis];
      exit = smaller(exit, (face - origin[axis]) / direction[axis]);
    }
    return exit;
  }

  // Priority: how wide one voxel of the node is on the screen, in sixteenths of a pixel.
  GV_HD void request(int64_t node, int32_t depth, T cone, int32_t kind) const {
    const T most = static_cast<T>(kPriorityMask);
    T voxel = options.root_voxel;
    for (int32_t level = 0; level < depth; ++level) voxel = voxel / static_cast<T>(tree.branching);
    const T priority = cone > 0 ? smaller(voxel / cone * 16, most) : most;
    post_request(&tree.request_tn[node], kind | static_cast<int32_t>(priority));
  }

  // One node: finds it, marks it, and takes all intervals whose middle lies in it. Returns the samples taken.
  GV_HD int32_t visit(Vec3<T> origin, Vec3<T> direction, const Transfer<T>& shader, Intervals<T>& at, T stop_clear,
                      T hit_clear, Accumulator<T>& sum) const {
    // Level of detail: the first depth whose voxel fits into the cone.
    const T cone = at.cone(at.middle);
    T voxel = options.root_voxel;
    T voxel_above = static_cast<T>(INFINITY);
    int32_t wanted = 0;
    while (wanted < tree.max_depth && voxel > cone) {
      voxel_above = voxel;
      voxel = voxel / static_cast<T>(tree.branching);
      ++wanted;
    }
    const bool blend = voxel <= cone && wanted > 0;
    const T cone_low = voxel <= cone ? voxel : static_cast<T>(-INFINITY);
    const T cone_high = voxel <= cone ? voxel_above : voxel;

    Vec3<T> position;
    const T one = 1;
    const T inner = static_cast<T>(0.9999999);  // a place on the scene's high face belongs to the scene
    for (int axis = 0; axis < 3; ++axis) {
      position[axis] =
          clamp(origin[axis] + at.middle * direction[axis], static_cast<T>(0), rays.bounds_23[3 + axis] * inner);
    }
    const Place<T> place = descend(tree, position, wanted, *frame_1);
    const T exit = leave(origin, direction, place);
    const bool clear = unseen(place.node, shader) && (!blend || place.depth < wanted || unseen(place.parent, shader));
    if (!clear && mark_missing(place, wanted, blend, cone)) sum.missed = true;

    // The two levels that blend; below the finest level, or where both are the same node, only one is read.
    const Holder<T> fine = place.fine;
    const Holder<T> coarse = blend && place.coarse.node >= 0 ? place.coarse : fine;
    const bool mixed = coarse.node != fine.node;
    const bool nothing = clear || fine.node < 0 || (fine.brick == kEmpty && coarse.brick == kEmpty);
    if (!clear && fine.brick >= 0) store_stamp(&bricks.stamp_b[fine.brick], *frame_1);
    if (!clear && coarse.brick >= 0) store_stamp(&bricks.stamp_b[coarse.brick], *frame_1);

    const BrickRay<T> fine_ray = aim(bricks, fine, origin, direction);
    const BrickRay<T> coarse_ray = aim(bricks, coarse, origin, direction);
    const bool uniform = fine_ray.base < 0 && coarse_ray.base < 0 && fine_ray.constant == coarse_ray.constant;
    if (nothing || uniform) {
      const T entry = at.start;
      at.leap(cone_high > at.cone(exit) && at.cone(exit) >= cone_low ? exit : at.start);
      do at.next();
      while (stays(at, exit, cone_low, cone_high));
      if (nothing) return 0;
      const T length = smaller(at.start, at.stop) - entry;
      composite(shader, fine_ray.constant, entry, length, hit_clear, sum);
      return 1;
    }

    const T levels = log2_exact(static_cast<T>(tree.branching));
    int32_t samples = 0;
    do {
      T value = sample(bricks, fine_ray, at.middle);
      if (mixed) {
        const T weight = clamp(log2_exact(at.cone(at.middle) / voxel) / levels, static_cast<T>(0), one);
        value = value + weight * (sample(bricks, coarse_ray, at.middle) - value);
      }
      composite(shader, value, at.start, at.end - at.start, hit_clear, sum);
      ++samples;
      at.next();
    } while (sum.clear > stop_clear && stays(at, exit, cone_low, cone_high));
    return samples;
  }

  GV_HD bool stays(const Intervals<T>& at, T exit, T cone_low, T cone_high) const {
    const T cone = at.cone(at.middle);
    return at.inside() && at.middle < exit && cone >= cone_low && cone < cone_high;
  }

  // Everything in reach of the node's brick, and so of every node below it, is transparent.
  GV_HD bool unseen(int64_t node, const Transfer<T>& shader) const {
    const int64_t row = 2 * node * bricks.channels + bricks.component;
    return shader.transparent(static_cast<T>(bricks.range_tn2c[row]),
                              static_cast<T>(bricks.range_tn2c[row + bricks.channels]));
  }

  // Asks for what is not there, and tells whether it did. Straight to the wanted level, or level by level: then a
  // brick is there before its node is subdivided.
  GV_HD bool mark_missing(const Place<T>& place, int32_t wanted, bool blend, T cone) const {
    const bool absent = tree.brick_tn[place.node] == kAbsent;
    const bool deeper = place.depth < wanted && tree.child_tn[place.node] == kAbsent;
    const bool above = blend && place.depth == wanted && tree.brick_tn[place.parent] == kAbsent;
    if (deeper && !(options.by_level && absent)) request(place.node, place.depth, cone, kSubdivide);
    if (absent && (options.by_level || !deeper || place.fine.node < 0)) {
      request(place.node, place.depth, cone, kLoad);
    }
    if (above) request(place.parent, place.depth - 1, cone, kLoad);
    return absent || deeper || above;
  }
};

}  // namespace gvtorch
