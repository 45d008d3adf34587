// TraceRay: one ray from the scene's near side to its far side. Descend, skip or sample, look the value up in the
// transfer function, composite front to back, and mark what was used and what was missed.
//
// Equal to `trace_rays` in ops/reference/march.py: integers exactly, and every float operation in the same order.
// Method: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and Detailed Voxel
// Rendering", I3D 2009, sections 3 and 4; Crassin, PhD thesis 2011, chapter 6.
#pragma once

#include "shade.h"
#include "walk.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

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

template <class T, class Voxel>
struct TraceRay : Walk<T> {
  using Walk<T>::tree;
  using Walk<T>::levels;
  using Walk<T>::options;
  using Walk<T>::hits;
  BrickView<Voxel> bricks;
  TransferView<T> transfer;
  uint8_t* hidden_tn;

  explicit TraceRay(const TraceArgs& args)
      : Walk<T>(args),
        bricks{static_cast<const Voxel*>(args.bricks_bzyxc),
               static_cast<const Voxel*>(args.constant_tnc),
               static_cast<const Voxel*>(args.range_tn2c),
               args.stamp_b,
               args.bricks,
               args.side,
               args.border,
               args.channels,
               args.component},
        transfer(args),
        hidden_tn(args.hidden_tn) {}

  GV_HD void operator()(int64_t index) const {
    NoPath path;
    trace(index, path);
  }

  template <class Path>
  GV_HD void trace(int64_t index, Path& path) const {
    const int64_t number = this->order(index);
    if (number < 0) return;
    const Ray<T> ray(this->rays, number);
    Intervals<T> at(ray, options.step, transfer.levels);
    const Transfer<T> shader(transfer);
    Accumulator<T> sum;
    sum.clear = static_cast<T>(this->rays.clear(number));
    const T stop_clear = 1 - options.stop_alpha;
    int32_t samples = 0;
    int32_t wanted = 0;
    const bool powers = tree.digit_bits > 0;
    while (at.inside() && sum.clear > stop_clear) {
      samples += powers ? visit<BitDigits<T>>(ray, shader, path, at, wanted, sum)
                        : visit<Digits<T>>(ray, shader, path, at, wanted, sum);
    }
    store(number, sum, ray.moved, samples);
  }

  GV_HD void store(int64_t number, const Accumulator<T>& sum, T moved, int32_t samples) const {
    hits.color_r3[3 * number] = sum.red;
    hits.color_r3[3 * number + 1] = sum.green;
    hits.color_r3[3 * number + 2] = sum.blue;
    hits.alpha_r1[number] = 1 - sum.clear;
    hits.depth_r1[number] = sum.depth + moved;
    hits.samples_r[number] = samples;
    hits.missed_r[number] = sum.missed;
  }

  // Whether a node shows nothing, looked at once.
  GV_HD bool hides(const Transfer<T>& shader, int32_t node) const {
    uint8_t known = load_byte(&hidden_tn[node]);
    if (known == kUnknown) {
      known = HideNode<T, Voxel>::hidden(bricks, shader, node) ? kHidden : kShown;
      store_byte(&hidden_tn[node], known);
    }
    return known == kHidden;
  }

  // One node: finds it, marks it, and takes all intervals whose middle lies in it. Returns the samples taken.
  template <class Number, class Path>
  GV_HD int32_t visit(const Ray<T>& ray, const Transfer<T>& shader, Path& path, Intervals<T>& at, int32_t& wanted,
                      Accumulator<T>& sum) const {
    const auto hides = [&](int32_t node) { return this->hides(shader, node); };
    const T middle = at.middle();
    Number digits(tree, ray.at(middle));
    const Visit<T> visit = this->find(ray, digits, at.cone(middle), hides, bricks.stamp_b, path, wanted, sum.missed);
    const Holder& fine = visit.fine;
    const Holder& coarse = visit.coarse;
    if (visit.clear || fine.node < 0 || (fine.brick == kEmpty && coarse.brick == kEmpty)) {
      this->leave(at, visit);
      return 0;
    }
    Run<T, Voxel> run;
    run.fine = run.coarse = aim(bricks, levels, fine, digits, ray.origin, ray.direction);
    run.mixed = coarse.node != fine.node;
    if (run.mixed) run.coarse = aim(bricks, levels, coarse, digits, ray.origin, ray.direction);
    run.voxel = visit.voxel;
    run.blend = 1 / (visit.above - visit.voxel);
    run.stop_clear = 1 - options.stop_alpha;
    run.hit_clear = 1 - options.depth_alpha;
    const bool uniform = run.fine.voxels == nullptr && run.coarse.voxels == nullptr;
    if (uniform && run.fine.constant == run.coarse.constant) {  // one interval, in closed form
      const T entry = at.start;
      this->leave(at, visit);
      add_piece(shader, run, run.fine.constant, entry, smaller(at.start, at.stop), sum);
      return 1;
    }
    return march_node(shader, run, visit, at, sum);
  }

  // All intervals of a node that are still to come. Returns the samples taken.
  GV_HD int32_t march_node(const Transfer<T>& shader, const Run<T, Voxel>& run, const Visit<T>& visit, Intervals<T>& at,
                           Accumulator<T>& sum) const {
    int32_t samples = 0;
    do {
      if (at.cut()) {
        const T value = OneByOne::value(bricks, run, at, at.middle());
        add_piece(shader, run, value, at.start, at.stop, sum);
        at.skip(1);
        return samples + 1;
      }
      const int32_t alike = at.run(visit.exit, visit.cone_low, visit.cone_high);
      const int32_t taken = OneByOne::march(bricks, shader, run, at, alike, sum);
      samples += taken;
      at.skip(taken);
    } while (sum.clear > run.stop_clear && this->stays(at, visit));
    return samples;
  }

  // Adds an interval of any length.
  GV_HD void add_piece(const Transfer<T>& shader, const Run<T, Voxel>& run, T value, T start, T end,
                       Accumulator<T>& sum) const {
    Row<T> row = shader.look_up(shader.find(value), 0);
    row.alpha = stretch(row.alpha, (end - start) / options.step);
    sum.add(row, start, end - start, run.hit_clear);
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
