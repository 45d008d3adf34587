// TraceRay: one ray from the scene's near side to its far side. Descend, skip or sample, look the value up in the
// transfer function, composite front to back, and mark what was used and what was missed.
//
// Equal to `trace_rays` in ops/reference.py: integers exactly, and every float operation in the same order.
// Method: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and Detailed Voxel
// Rendering", I3D 2009, sections 3 and 4; Crassin, PhD thesis 2011, chapter 6.
#pragma once

#include "brick.h"
#include "ray.h"
#include "shade.h"
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

// Calls body(Voxel{}) with the C++ type of a channel's voxels.
template <class Body>
void with_voxel(VoxelType type, const Body& body) {
  switch (type) {
    case VoxelType::kUInt8:
      return body(uint8_t{});
    case VoxelType::kInt8:
      return body(int8_t{});
    case VoxelType::kInt16:
      return body(int16_t{});
    case VoxelType::kUInt16:
      return body(uint16_t{});
    case VoxelType::kHalf:
      return body(Half{});
    case VoxelType::kBFloat16:
      return body(BFloat16{});
    case VoxelType::kFloat:
      return body(float{});
  }
}

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
    const int64_t x = tile % tiles * 8 + index % 8;
    const int64_t y = tile / tiles * 4 + index / 8 % 4;
    return x < width && y * width < rays ? y * width + x : -1;
  }
};

// What all samples of a run have in common. Where two levels blend, `coarse` gets the weight
// (cone - voxel) * blend, linear from the one's voxel to the other's.
template <class T, class Voxel>
struct Run {
  BrickRay<T, Voxel> fine, coarse;
  bool mixed;
  T voxel, blend;
  T stop_clear, hit_clear;
};

// Samples `count` whole intervals, or fewer when the ray ends; returns how many.
struct OneByOne {
  template <class T, class Voxel>
  GV_HD static int32_t march(const BrickView<Voxel>& bricks, const Transfer<T>& transfer, const Run<T, Voxel>& run,
                             const Intervals<T>& at, int32_t count, Accumulator<T>& sum) {
#ifdef __CUDA_ARCH__
    // The usual bricks, 8 and 16 voxels wide with a border of 1.
    if (!run.mixed && run.fine.voxels != nullptr && bricks.channels == 1) {
      const auto fixed = [&](auto side, T t) { return sample<decltype(side)::value>(bricks, run.fine, t); };
      if (bricks.side == 10)
        return march_by(transfer, run, at, count, sum, [&](T t) { return fixed(Number<10>{}, t); });
      if (bricks.side == 18)
        return march_by(transfer, run, at, count, sum, [&](T t) { return fixed(Number<18>{}, t); });
    }
#endif
    return march_by(transfer, run, at, count, sum, [&](T t) { return value(bricks, run, at, t); });
  }
  template <int32_t kValue>
  struct Number {
    static constexpr int32_t value = kValue;
  };
  template <class T, class Voxel, class Value>
  GV_HD static int32_t march_by(const Transfer<T>& transfer, const Run<T, Voxel>& run, const Intervals<T>& at,
                                int32_t count, Accumulator<T>& sum, const Value& value_at) {
    const T end = at.count + static_cast<T>(count);
    for (T number = at.count; number < end; number = number + 1) {
      const Row<T> row = transfer.look_up(transfer.find(value_at(at.middle_of(number))), at.level);
      sum.add(row, at.start_of(number), at.length, run.hit_clear);
      if (!(sum.clear > run.stop_clear)) return static_cast<int32_t>(number - at.count) + 1;
    }
    return count;
  }
  template <class T, class Voxel>
  GV_HD static T value(const BrickView<Voxel>& bricks, const Run<T, Voxel>& run, const Intervals<T>& at, T t) {
    const T fine = sample(bricks, run.fine, t);
    if (!run.mixed) return fine;
    const T weight = clamp((at.cone(t) - run.voxel) * run.blend, static_cast<T>(0), static_cast<T>(1));
    return fine + weight * (sample(bricks, run.coarse, t) - fine);
  }
};

// Which nodes show nothing: worked out before the rays go on a GPU, where many threads would each do it again; on the
// CPU, where most nodes are never visited, when the first ray comes.
constexpr uint8_t kUnknown = 0, kShown = 1, kHidden = 2;

template <class T, class Voxel>
struct HideNode {
  BrickView<Voxel> bricks;
  TransferView<T> transfer;
  uint8_t* hidden_tn;

  GV_HD void operator()(int64_t node) const {
    hidden_tn[node] = hidden(bricks, Transfer<T>(transfer), static_cast<int32_t>(node)) ? kHidden : kShown;
  }
  // Everything in reach of the node's brick, and so of every node below it, is transparent.
  GV_HD static bool hidden(const BrickView<Voxel>& bricks, const Transfer<T>& transfer, int32_t node) {
    const int64_t row = int64_t{2} * node * bricks.channels + bricks.component;
    return transfer.transparent(number<T>(bricks.range_tn2c[row]), number<T>(bricks.range_tn2c[row + bricks.channels]));
  }
};

template <class T, class Voxel, class March = OneByOne>
struct TraceRay {
  RayView rays;
  RayOrder order;
  TreeView tree;
  Levels<T> levels;
  BrickView<Voxel> bricks;
  TransferView<T> transfer;
  TraceOptions<T> options;
  HitView<T> hits;
  const int32_t* frame_1;
  uint8_t* hidden_tn;

  explicit TraceRay(const TraceArgs& args)
      : rays{args.origin_r3, args.direction_r3, args.cone_r2, args.range_r2, args.place_33, args.cone_scale,
             args.clear_r},
        order{args.rays, args.width},
        tree{args.child_tn,   args.brick_tn,
             args.request_tn, args.stamp_t,
             args.root,       args.root / args.nodes_per_tile,
             args.branching,  args.nodes_per_tile,
             args.max_depth,  digit_bits_of(args.branching, args.max_depth)},
        levels(static_cast<T>(args.root_voxel), static_cast<T>(args.side - 2 * args.border), args.branching),
        bricks{static_cast<const Voxel*>(args.bricks_bzyxc),
               static_cast<const Voxel*>(args.constant_tnc),
               static_cast<const Voxel*>(args.range_tn2c),
               args.stamp_b,
               args.bricks,
               args.side,
               args.border,
               args.channels,
               args.component},
        transfer{static_cast<const Row<T>*>(args.table_lm4), static_cast<const T*>(args.domain_2), args.opaque_m,
                 args.rows, args.levels},
        options{static_cast<T>(args.step), static_cast<T>(args.stop_alpha), static_cast<T>(args.depth_alpha),
                args.by_level},
        hits{static_cast<T*>(args.color_r3), static_cast<T*>(args.alpha_r1), static_cast<T*>(args.depth_r1),
             args.samples_r, args.missed_r},
        frame_1(args.frame_1),
        hidden_tn(args.hidden_tn) {}

  GV_HD void operator()(int64_t index) const {
    NoPath path;
    trace(index, path);
  }

  template <class Path>
  GV_HD void trace(int64_t index, Path& path) const {
    const int64_t number = order(index);
    if (number < 0) return;
    const Ray<T> ray(rays, number);
    Intervals<T> at(ray, options.step, transfer.levels);
    const Transfer<T> shader(transfer);
    Accumulator<T> sum;
    if (rays.clear_r != nullptr) sum.clear = static_cast<T>(rays.clear_r[number]);
    const T stop_clear = 1 - options.stop_alpha;
    int32_t samples = 0;
    int32_t wanted = 0;
    const bool powers = tree.digit_bits > 0;
    while (at.inside() && sum.clear > stop_clear) {
      samples += powers ? visit<BitDigits<T>>(ray, shader, path, at, wanted, sum)
                        : visit<Digits<T>>(ray, shader, path, at, wanted, sum);
    }
    hits.color_r3[3 * number] = sum.red;
    hits.color_r3[3 * number + 1] = sum.green;
    hits.color_r3[3 * number + 2] = sum.blue;
    hits.alpha_r1[number] = 1 - sum.clear;
    hits.depth_r1[number] = sum.depth + ray.moved;
    hits.samples_r[number] = samples;
    hits.missed_r[number] = sum.missed;
  }

  // One node: finds it, marks it, and takes all intervals whose middle lies in it. Returns the samples taken.
  template <class Number, class Path>
  GV_HD int32_t visit(const Ray<T>& ray, const Transfer<T>& shader, Path& path, Intervals<T>& at, int32_t& wanted,
                      Accumulator<T>& sum) const {
    // Level of detail: the first depth whose voxel fits into the cone.
    const T infinity = static_cast<T>(INFINITY);
    const T middle = at.middle();
    const T cone = at.cone(middle);
    while (wanted < tree.max_depth && levels.voxel[wanted] > cone) ++wanted;
    while (wanted > 0 && !(levels.voxel[wanted - 1] > cone)) --wanted;
    const T voxel = levels.voxel[wanted];
    const T above = wanted > 0 ? levels.voxel[wanted - 1] : infinity;
    const bool reached = voxel <= cone;
    const bool blend = reached && wanted > 0;
    const T cone_low = reached ? voxel : -infinity;
    const T cone_high = reached ? above : voxel;

    const auto hides = [&](int32_t node) {
      uint8_t known = load_byte(&hidden_tn[node]);
      if (known == kUnknown) {
        known = HideNode<T, Voxel>::hidden(bricks, shader, node) ? kHidden : kShown;
        store_byte(&hidden_tn[node], known);
      }
      return known == kHidden;
    };
    Number digits(tree, ray.at(middle));
    const Place place = descend(tree, digits, wanted, blend, *frame_1, hides, path);
    const T exit = ray.leave(digits.corner(place.depth, levels), levels.size[place.depth]);
    const bool clear = place.hidden && (place.depth < wanted || !blend);
    if (!clear && mark_missing(place, wanted, blend, cone)) sum.missed = true;

    // The two levels that blend; below the finest level, or where both are the same node, only one is read.
    const Holder fine = place.fine;
    const Holder coarse = place.coarse.node >= 0 ? place.coarse : fine;
    const bool nothing = clear || fine.node < 0 || (fine.brick == kEmpty && coarse.brick == kEmpty);
    if (!clear && fine.brick >= 0) store_stamp(&bricks.stamp_b[fine.brick], *frame_1);
    if (!clear && coarse.brick >= 0) store_stamp(&bricks.stamp_b[coarse.brick], *frame_1);
    if (nothing) {
      leave(at, exit, cone_low, cone_high);
      return 0;
    }
    Run<T, Voxel> run;
    run.fine = run.coarse = aim(bricks, levels, fine, digits, ray.origin, ray.direction);
    run.mixed = coarse.node != fine.node;
    if (run.mixed) run.coarse = aim(bricks, levels, coarse, digits, ray.origin, ray.direction);
    run.voxel = voxel;
    run.blend = 1 / (above - voxel);
    run.stop_clear = 1 - options.stop_alpha;
    run.hit_clear = 1 - options.depth_alpha;
    const bool uniform = run.fine.voxels == nullptr && run.coarse.voxels == nullptr;
    if (uniform && run.fine.constant == run.coarse.constant) {  // one interval, in closed form
      const T entry = at.start;
      leave(at, exit, cone_low, cone_high);
      add_piece(shader, run, run.fine.constant, entry, smaller(at.start, at.stop), sum);
      return 1;
    }
    int32_t samples = 0;
    do {
      if (at.cut()) {
        const T value = OneByOne::value(bricks, run, at, at.middle());
        add_piece(shader, run, value, at.start, at.stop, sum);
        at.skip(1);
        return samples + 1;
      }
      const int32_t alike = at.run(exit, cone_low, cone_high);
      const int32_t taken = March::march(bricks, shader, run, at, alike, sum);
      samples += taken;
      at.skip(taken);
    } while (sum.clear > run.stop_clear && stays(at, exit, cone_low, cone_high));
    return samples;
  }

  GV_HD static bool stays(const Intervals<T>& at, T exit, T cone_low, T cone_high) {
    const T middle = at.middle();
    const T cone = at.cone(middle);
    return at.inside() && middle < exit && cone >= cone_low && cone < cone_high;
  }

  // Goes to the first interval behind the node.
  GV_HD static void leave(Intervals<T>& at, T exit, T cone_low, T cone_high) {
    do at.skip(at.cut() ? 1 : at.run(exit, cone_low, cone_high));
    while (stays(at, exit, cone_low, cone_high));
  }

  // Adds an interval of any length.
  GV_HD void add_piece(const Transfer<T>& shader, const Run<T, Voxel>& run, T value, T start, T end,
                       Accumulator<T>& sum) const {
    Row<T> row = shader.look_up(shader.find(value), 0);
    row.alpha = stretch(row.alpha, (end - start) / options.step);
    sum.add(row, start, end - start, run.hit_clear);
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
