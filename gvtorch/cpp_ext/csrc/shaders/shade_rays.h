// ShadeRay traces one ray from the scene's near side to its far side: it descends the tree, skips or samples nodes,
// passes each interval to a shader of shaders.h, which composites front to back, and marks what it used and missed.
// With shadows, each sample traces a cone to the light through the same tree, and its samples, stamps and requests
// count as the ray's own.
//
// Equal to ops/reference/march.py and shaders.py: integers exactly, and every float operation in the same order.
// Method: Crassin, Neyret, Lefebvre, Eisemann, "GigaVoxels: Ray-Guided Streaming for Efficient and Detailed Voxel
// Rendering", I3D 2009, sections 3 and 4; Crassin, PhD thesis 2011, chapter 6.
#pragma once

#include <type_traits>

#include "shaders/shaders.h"
#include "shaders/shadows.h"

namespace gvtorch::GV_NAMESPACE {

// Digits: see `with_digits`. Voxel: dtype of the shader's value; void: known at run time only.
template <class T, class Kind, class Digits, bool kWithShadows = false, class Voxel = void>
struct ShadeRay : Walk<T> {
  using Shader = Kind;
  static constexpr bool kShadows = kWithShadows;
  using RayProbe = ProbeOf<T, Voxel>;
  using Walk<T>::tree;
  using Walk<T>::step;
  using Sum = typename Shader::Sum;
  // Reads of a known dtype are inlined, and a short shader's loop may be instantiated several times. kBlocksPerSM (see
  // for_each.h): 8 leave 64 registers to a thread, 4 leave 128.
  static constexpr bool kShort = !std::is_void_v<Voxel> && Shader::kShort;
  static constexpr int kBlocksPerSM = kShort && Shader::kFiltered == 0 ? 8 : 4;
  static constexpr bool kHidesAlike = Shader::kHidesAlike;
  Shader shader;
  Channels channels;
  Light<T> light;
  const void* range_tn2c;
  // For a shader with kHidesAlike, see shade_each.h:
  uint8_t* hidden_tn;             // on the CPU
  NodeWords* words_tn = nullptr;  // on a GPU
  int32_t lengths, features, directions;
  T *normal_r3, *features_rc;

  explicit ShadeRay(const ShadeArgs& args)
      : Walk<T>(args),
        shader(args),
        channels{{args.bricks_bzyxc, args.constant_tnc, args.voxel, args.voxel_width},
                 {args.normal_bzyxc, args.normal_tnc, args.normal_voxel, 3},
                 {args.other_bzyxc, args.other_tnc, args.other_voxel, args.other_width},
                 args.side,
                 args.border,
                 args.component},
        light(args),
        range_tn2c(args.range_tn2c),
        hidden_tn(args.hidden_tn),
        lengths(args.lengths),
        features(args.features),
        directions(Shader::kColored ? args.voxel_width / 4 : 1),
        normal_r3(static_cast<T*>(args.normal_r3)),
        features_rc(static_cast<T*>(args.features_rc)) {}

  GV_HD void operator()(int64_t index) const {
    const int64_t number = this->order(index);
    [[maybe_unused]] const unsigned threads = kShadows ? threads_where(number >= 0) : 0;
    if (number < 0) return;
    const Ray<T> ray(this->rays, number);
    const Sight<T> sight(this->rays, number, ray.moved);
    Intervals<T> intervals(ray, step, lengths);
    Sum sum = first_sum(number);
    const auto& ready = ready_for_ray(shader);
    const auto trace_ray = [&](const auto& add_lit) {
      Visitor<std::decay_t<decltype(ready)>, std::decay_t<decltype(add_lit)>> visitor{
          *this, ready, &sight, sum, this->stop_clear, add_lit};
      this->template follow<Digits>(ray, intervals, visitor);
      return visitor.samples;
    };
    int32_t samples;
    if constexpr (kShadows) {
      Shadows<T, ShadeRay> shadows{*this, ray, sight, threads};
      samples = trace_ray([&](const Interval<T>& interval, const LitPoint<T>& point, const LightCone<T>& cone,
                              int32_t& ray_samples) { shadows.add(interval, point, cone, sum, ray_samples); });
      shadows.finish(sum, samples);
    } else {
      samples = trace_ray(nullptr);
    }
    if constexpr (Shader::kSurface) {
      if (sum.depth < static_cast<T>(INFINITY)) surface<Digits>(ray, sight, sum);
    }
    finish(number, ray.moved, samples, sum);
  }

  // The sum of a ray before its first interval.
  GV_HD Sum first_sum(int64_t number) const {
    Sum sum;
    sum.clear = static_cast<T>(this->rays.clear(number));
    sum.hit_clear = this->hit_clear;
    sum.feature_c = features_rc + number * features;
    for (int32_t c = 0; c < features; ++c) sum.feature_c[c] = 0;
    return sum;
  }

  // Smallest and largest value of a node, over all directions.
  struct Range {
    T low, high;
  };
  GV_HD Range range_of(int32_t node) const { return range_of(node, channels.component); }
  GV_HD Range range_of(int32_t node, int32_t component) const {
    const int64_t row = int64_t{2} * node * channels.value.width + component;
    const auto read = [&](int64_t index) { return read_number<T>(range_tn2c, channels.value.type, index); };
    Range range{read(row), read(row + channels.value.width)};
    for (int32_t direction = 1; direction < directions; ++direction) {
      range.low = smaller(range.low, read(row + 4 * direction));
      range.high = larger(range.high, read(row + channels.value.width + 4 * direction));
    }
    return range;
  }
  // True if no value in the node's range changes the sum.
  template <class AnyShader>
  GV_HD bool hides(const AnyShader& shader, int32_t node, const typename AnyShader::Sum& sum) const {
    if constexpr (AnyShader::kReadsAll) {
      return shader.hides_ranges([&](int32_t component) { return range_of(node, component); });
    } else {
      const Range range = range_of(node);
      return shader.hides(range.low, range.high, sum);
    }
  }

  // The same for all rays, computed once per node.
  bool hides(int32_t node) const {
    uint8_t state = __atomic_load_n(&hidden_tn[node], __ATOMIC_RELAXED);  // several threads may write the same value
    if (state == kUnknown) {
      state = hides(shader, node, Sum()) ? kHidden : kShown;
      __atomic_store_n(&hidden_tn[node], state, __ATOMIC_RELAXED);
    }
    return state == kHidden;
  }
  GV_HD NodeWords node_words(int32_t node) const {
#ifdef __CUDA_ARCH__
    return words_tn[node];
#else
    return tree.words_of(node, hides(node));
#endif
  }

  // Shades where depth was set. This may be half an interval outside the visited node, so the node is looked up again.
  template <class AnyDigits>
  GV_HD void surface(const Ray<T>& ray, const Sight<T>& sight, Sum& sum) const {
    AnyDigits digits(tree, this->levels, this->rays, ray, sum.depth);
    int32_t wanted = 0;
    const auto read_words = [&](int32_t node) { return tree.words_of(node, false); };
    const Visit<T> visit = this->find(ray, digits, ray.cone(sum.depth), read_words, wanted, sum.missed);
    shader.surface(Probe<T>(channels, sight, this->rays, ray, visit, digits), sum);
  }

  // Called after the last interval: stores the results.
  GV_HD void finish(int64_t number, T moved, int32_t samples, Sum& sum) const {
    shader.done(sum);
    this->store(number, sum, moved, samples);
    if (normal_r3 == nullptr) return;
    const Vec3<T> normal = unit(sum.normal);
    for (int axis = 0; axis < 3; ++axis) normal_r3[3 * number + axis] = normal[axis];
  }

  // True if light varies in a node of one value, or it has to be taken in many intervals. AnyShader: the shader, or
  // its ShadowShader for a ray to a light.
  template <class AnyShader>
  GV_HD bool shades_each_position() const {
    if constexpr (!AnyShader::kToLight && kShadows) return true;
    if (AnyShader::kToLight && light.scatters()) return true;  // 1 - alpha of a long interval would round to 0
    return channels.normal.exists() && light.kind() == LightKind::kPoint;  // from a direction that varies
  }

  // Share of the light that reaches the position at the tip of a cone. The cone begins as wide as the ray's is there;
  // its first interval is left out, so that a position does not shadow itself.
  GV_HD T light_share(const Ray<T>& ray, const Sight<T>& sight, const LightCone<T>& cone, int32_t& samples,
                      bool& missed) const {
    const RayView& rays = this->rays;
    const Vec3<double> position = ray.along(cone.t, Digits::kDeep && rays.deep);
    const Ray<T> beam(rays, position, cone.direction, ray.cone(cone.t), cone.growth, cone.length);
    const Sight<T> eye(sight.at(cone.t), cone.direction);
    Intervals<T> intervals(beam, step, lengths);
    intervals.move_to(true, intervals.count + 1);
    const ShadowShader<T, Shader> shadow_shader{{}, shader};
    typename ShadowShader<T, Shader>::Sum sum;
    Visitor<ShadowShader<T, Shader>> visitor{*this, shadow_shader, &eye, sum, light.faintest(this->stop_clear)};
    this->template follow<Digits>(beam, intervals, visitor);
    samples += visitor.samples;
    missed = missed || sum.missed;
    return sum.clear;
  }

  // See Walk::follow. AnyShader: as above. AddLit: adds an interval with its shadow, add_lit(interval, point, cone,
  // samples); called only with kShadows.
  template <class AnyShader, class AddLit = std::nullptr_t>
  struct Visitor {
    static constexpr bool kSeesEmpty = AnyShader::kSeesEmpty, kEnds = AnyShader::kEnds;
    static constexpr bool kToLight = AnyShader::kToLight;
    const ShadeRay& kernel;
    const AnyShader& shader;
    const Sight<T>* sight;
    typename AnyShader::Sum& sum;
    T stop_clear;  // transmittance at which the ray ends
    AddLit add_lit{};
    int32_t samples = 0;

    GV_HD bool& missed() { return sum.missed; }
    GV_HD bool sees() const { return sum.clear > stop_clear; }
    GV_HD bool goes_on() const { return sees(); }
    template <class Node>
    GV_HD void finish(const Node&) const {}
    GV_HD NodeWords node_words(int32_t node) const {
      if constexpr (AnyShader::kHidesAlike) {
        return kernel.node_words(node);
      } else {
        return kernel.tree.words_of(node, kernel.hides(shader, node, sum));
      }
    }
    GV_HD RayProbe enter(const Ray<T>& ray, const Visit<T>& visit, const Digits& digits) const {
      return RayProbe(kernel.channels, *sight, kernel.rays, ray, visit, digits);
    }
    GV_HD bool uniform(const RayProbe& probe) const {
      return probe.uniform() && !kernel.template shades_each_position<AnyShader>();
    }
    GV_HD void region(const RayProbe& probe, T start, T end) {
      Interval<T> interval;
      interval.start = start;
      interval.end = end;
      interval.set_odd();
      interval.value = interval.front = interval.back = probe.value(interval.middle);
      if constexpr (AnyShader::kFiltered > 0) {
        shader.plain().add(true, interval, probe, sum);  // it has no brick, so no filtered colours
      } else {
        shader.add(true, interval, probe, sum);
      }
      ++samples;
    }
    GV_HD int32_t take_intervals(const RayProbe& probe, const Intervals<T>& intervals, int32_t run_length, bool last) {
      if constexpr (AnyShader::kFiltered > 0) {
        // It reads colours by itself; visits without any use the plain function.
        if (shader.has_stored(probe))
          return take_with(shader, [](T) { return T{}; }, probe, intervals, run_length, last);
        return take_intervals(ready_for_ray(shader.plain()), probe, intervals, run_length, last);
      } else if constexpr (AnyShader::kReadsAll) {
        return take_with(shader, [](T) { return T{}; }, probe, intervals, run_length, last);
      } else {
        return take_intervals(shader, probe, intervals, run_length, last);
      }
    }

   private:
    template <class ActiveShader>
    GV_HD int32_t take_intervals(const ActiveShader& active_shader, const RayProbe& probe,
                                 const Intervals<T>& intervals, int32_t run_length, bool last) {
      if (!kShort || last)
        return take_with(active_shader, [&](T t) { return probe.value(t); }, probe, intervals, run_length, last);
      const T last_number = intervals.count + static_cast<T>(run_length - 1);
      const T begin = kEnds ? intervals.start : intervals.middle_of(intervals.count);
      const T end = kEnds ? intervals.start_of(last_number + 1) : intervals.middle_of(last_number);
      return probe.with_value(begin, end, [&](const auto& value) {
        return take_with(active_shader, value, probe, intervals, run_length, false);
      });
    }
    template <class ActiveShader, class Value>
    GV_HD int32_t take_with(const ActiveShader& active_shader, const Value& value, const RayProbe& probe,
                            const Intervals<T>& intervals, int32_t run_length, bool last) {
      Interval<T> interval;
      T number = intervals.count;
      const T end = number + static_cast<T>(run_length);
      if (kEnds) interval.back = value(intervals.start);
      do {
        interval.start = intervals.start_of(number);
        interval.end = last ? intervals.stop : intervals.start_of(number + 1);
        if (last) {
          interval.set_odd();
        } else {
          interval.level = intervals.level;
          interval.length = intervals.length;
          interval.middle = intervals.middle_of(number);
        }
        if (kEnds) {
          interval.front = interval.back;
          interval.back = value(interval.end);
        } else {
          interval.value = value(interval.middle);
        }
        add(active_shader, interval, probe);
        number = number + 1;
      } while (number < end && sees());
      const int32_t taken = static_cast<int32_t>(number - intervals.count);
      samples += taken;
      return taken;
    }
    template <class ActiveShader>
    GV_HD void add(const ActiveShader& active_shader, const Interval<T>& interval, const RayProbe& probe) {
      if constexpr (kShadows && !kToLight) {
        active_shader.add(true, interval, probe, sum, [&](bool, const LitPoint<T>& point, const LightCone<T>& cone) {
          add_lit(interval, point, cone, samples);
        });
      } else {
        active_shader.add(true, interval, probe, sum);
      }
    }
  };
};

// Computes the words of a node, with what a shader with kHidesAlike hides.
template <class Kernel>
struct HideShaded {
  Kernel kernel;

  GV_HD void operator()(int64_t index) const {
    const auto node = static_cast<int32_t>(index);
    kernel.words_tn[node] = kernel.tree.words_of(node, kernel.hides(kernel.shader, node, typename Kernel::Sum()));
  }
};

}  // namespace gvtorch::GV_NAMESPACE
