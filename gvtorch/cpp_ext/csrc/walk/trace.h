// TraceRay: one ray from the scene's near side to its far side. Descend, skip or sample, look the value up in the
// transfer function, composite front to back, and mark what was used and what was missed.
//
// Equal to `trace_rays` in ops/reference/march.py: integers exactly, and every float operation in the same order.
// Method: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and Detailed Voxel
// Rendering", I3D 2009, sections 3 and 4; Crassin, PhD thesis 2011, chapter 6.
#pragma once

#include "walk/shade.h"
#include "walk/walk.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// What all samples of a visit have in common. Where two levels blend, `coarse` gets the weight
// (cone - voxel) * blend, linear from the one's voxel to the other's.
template <class T, class Voxel>
struct Run {
  BrickRay<T, Voxel> fine, coarse;
  bool mixed;
  T voxel, blend;
};

template <class T, class Voxel>
struct TraceRay : Walk<T> {
  using Walk<T>::levels;
  using Walk<T>::options;
  BrickView<Voxel> bricks;
  TransferTable<T> transfer;
  int32_t lengths;
  const uint8_t* hidden_tn;

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
        lengths(args.levels),
        hidden_tn(args.hidden_tn) {}

  GV_HD void operator()(int64_t index) const {
    const int64_t number = this->order(index);
    if (number < 0) return;
    const Ray<T> ray(this->rays, number);
    Intervals<T> at(ray, options.step, lengths);
    Visitor visitor{*this, Transfer<T>(transfer)};
    visitor.sum.clear = static_cast<T>(this->rays.clear(number));
    this->follow(ray, at, visitor);
    this->store(number, visitor.sum, ray.moved, visitor.samples);
  }

  // See Walk::follow.
  struct Visitor {
    static constexpr bool kPowers = true, kSeesEmpty = false;
    const TraceRay& kernel;
    const Transfer<T> shader;
    Accumulator<T> sum{};
    int32_t samples = 0;

    GV_HD bool& missed() { return sum.missed; }
    GV_HD bool sees() const { return sum.clear > kernel.stop_clear; }
    GV_HD bool more() const { return sees(); }
    template <class Node>
    GV_HD void finish(const Node&) const {}
    GV_HD bool hides(int32_t node) const { return kernel.hidden_tn[node] == kHidden; }

    template <class Digits>
    GV_HD Run<T, Voxel> enter(const Ray<T>& ray, const Visit<T>& visit, const Digits& digits) const {
      Run<T, Voxel> run;
      run.fine = run.coarse = aim(kernel.bricks, kernel.levels, visit.fine, digits, ray.origin, ray.direction);
      run.mixed = visit.coarse.node != visit.fine.node;
      if (run.mixed) run.coarse = aim(kernel.bricks, kernel.levels, visit.coarse, digits, ray.origin, ray.direction);
      run.voxel = visit.voxel;
      run.blend = 1 / (visit.above - visit.voxel);
      return run;
    }
    GV_HD bool uniform(const Run<T, Voxel>& run) const {
      return run.fine.voxels == nullptr && run.coarse.voxels == nullptr && run.fine.constant == run.coarse.constant;
    }
    // One interval of any length.
    GV_HD void add(T value, T start, T end) {
      Row<T> row = shader.look_up(value, 0);
      row.alpha = stretch(row.alpha, (end - start) / kernel.options.step);
      sum.add(row, start, end - start, kernel.hit_clear);
      ++samples;
    }
    GV_HD void region(const Run<T, Voxel>& run, T start, T end) { add(run.fine.constant, start, end); }
    GV_HD int32_t take(const Run<T, Voxel>& run, const Intervals<T>& at, int32_t alike, bool last) {
      if (last) {
        add(value(run, at, at.middle()), at.start, at.stop);
        return 1;
      }
#ifdef __CUDA_ARCH__
      // The usual bricks, 8 and 16 voxels wide with a border of 1.
      if (!run.mixed && run.fine.voxels != nullptr && kernel.bricks.channels == 1) {
        if (kernel.bricks.side == 10)
          return take_by(at, alike, [&](T t) { return sample<10>(kernel.bricks, run.fine, t); });
        if (kernel.bricks.side == 18)
          return take_by(at, alike, [&](T t) { return sample<18>(kernel.bricks, run.fine, t); });
      }
#endif
      return take_by(at, alike, [&](T t) { return value(run, at, t); });
    }

   private:
    template <class Value>
    GV_HD int32_t take_by(const Intervals<T>& at, int32_t alike, const Value& value_at) {
      const T end = at.count + static_cast<T>(alike);
      int32_t taken = alike;
      for (T number = at.count; number < end; number = number + 1) {
        const Row<T> row = shader.look_up(value_at(at.middle_of(number)), at.level);
        sum.add(row, at.start_of(number), at.length, kernel.hit_clear);
        if (!sees()) {
          taken = static_cast<int32_t>(number - at.count) + 1;
          break;
        }
      }
      samples += taken;
      return taken;
    }
    GV_HD T value(const Run<T, Voxel>& run, const Intervals<T>& at, T t) const {
      const T fine = sample(kernel.bricks, run.fine, t);
      if (!run.mixed) return fine;
      const T weight = clamp((at.cone(t) - run.voxel) * run.blend, static_cast<T>(0), static_cast<T>(1));
      return fine + weight * (sample(kernel.bricks, run.coarse, t) - fine);
    }
  };
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
