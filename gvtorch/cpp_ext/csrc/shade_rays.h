// ShadeRay: one ray through the tree with any shader of shaders.h. As TraceRay (trace.h), but dtypes are switches at
// run time, and each interval goes to the shader. With shadows, a cone goes from each sample to the light, through the
// same tree; its samples, stamps and requests count as the ray's own.
#pragma once

#include <type_traits>

#include "shaders.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class Shader, class = void>
struct HidesAlike : std::false_type {};
template <class Shader>
struct HidesAlike<Shader, std::void_t<decltype(Shader::kHidesAlike)>> : std::bool_constant<Shader::kHidesAlike> {};

// kPowers: an N that is a power of two has code of its own.
template <class T, class Shader, bool kShadows = false, bool kPowers = true>
struct ShadeRay : Walk<T> {
  using Walk<T>::tree;
  using Walk<T>::options;
  using Walk<T>::hits;
  using Sum = typename Shader::Sum;
  static constexpr int kBlocksAtOnce = 4;  // on a multiprocessor of CUDA: 128 registers
  static constexpr bool kHidesAlike = HidesAlike<Shader>::value;
  Shader shader;
  Channels channels;
  const T* parameter_54;
  const void* range_tn2c;
  int32_t* stamp_b;
  uint8_t* hidden_tn;  // on a GPU, of a shader with kHidesAlike
  int32_t lengths, features, directions;
  T *normal_r3, *features_rc;

  explicit ShadeRay(const ShadeArgs& args)
      : Walk<T>(args),
        shader(args),
        channels{{args.bricks_bzyxc, args.constant_tnc, args.voxel, args.channels},
                 {args.normal_bzyxc, args.normal_tnc, args.normal_voxel, 3},
                 {args.other_bzyxc, args.other_tnc, args.other_voxel, args.other_channels},
                 args.side,
                 args.border,
                 args.component},
        parameter_54(static_cast<const T*>(args.parameter_54)),
        range_tn2c(args.range_tn2c),
        stamp_b(args.stamp_b),
        hidden_tn(args.hidden_tn),
        lengths(args.levels),
        features(args.features),
        directions(std::is_same_v<Shader, StoredColor<T>> ? args.channels / 4 : 1),
        normal_r3(static_cast<T*>(args.normal_r3)),
        features_rc(static_cast<T*>(args.features_rc)) {}

  GV_HD void operator()(int64_t index) const {
    const int64_t number = this->order(index);
    if (number < 0) return;
    const Ray<T> ray(this->rays, number);
    const Sight<T> sight(this->rays, number, ray.moved);
    Intervals<T> at(ray, options.step, lengths);
    Sum sum;
    sum.clear = static_cast<T>(this->rays.clear(number));
    sum.hit_clear = 1 - options.depth_alpha;
    sum.feature_c = features_rc + number * features;
    for (int32_t c = 0; c < features; ++c) sum.feature_c[c] = 0;
    const T stop_clear = 1 - options.stop_alpha;
    int32_t samples = 0;
    int32_t wanted = 0;
    const bool powers = kPowers && tree.digit_bits > 0;
    while (at.inside() && sum.clear > stop_clear) {
      samples += powers ? visit<BitDigits<T>>(shader, ray, sight, at, wanted, sum)
                        : visit<Digits<T>>(shader, ray, sight, at, wanted, sum);
    }
    if constexpr (Shader::kSurface) {
      if (sum.depth < static_cast<T>(INFINITY)) {
        powers ? surface<BitDigits<T>>(ray, sight, at, wanted, sum) : surface<Digits<T>>(ray, sight, at, wanted, sum);
      }
    }
    finish(number, ray.moved, samples, sum);
  }

  // Nothing between the ends of the node's range changes the sum.
  template <class Any>
  GV_HD bool hides(const Any& shader, int32_t node, const typename Any::Sum& sum) const {
    const int64_t row = int64_t{2} * node * channels.value.width + channels.component;
    T low = read_number<T>(range_tn2c, channels.value.type, row);
    T high = read_number<T>(range_tn2c, channels.value.type, row + channels.value.width);
    for (int32_t other = 1; other < directions; ++other) {
      low = smaller(low, read_number<T>(range_tn2c, channels.value.type, row + 4 * other));
      high = larger(high, read_number<T>(range_tn2c, channels.value.type, row + channels.value.width + 4 * other));
    }
    return shader.hides(low, high, sum);
  }

  // All intervals of a node that are still to come, each given to add(piece). Returns the samples taken.
  template <bool kEnds, class Any, class Add>
  GV_HD int32_t march_node(const Probe<T>& probe, const Visit<T>& visit, Intervals<T>& at, const Any& sum,
                           const Add& add) const {
    const T stop_clear = 1 - options.stop_alpha;
    Piece<T> piece;
    int32_t samples = 0;
    do {
      const bool last = at.cut();
      const int32_t alike = last ? 1 : at.run(visit.exit, visit.cone_low, visit.cone_high);
      int32_t taken = 0;
      if (kEnds) piece.back = probe.value(at.start);
      do {
        const T number = at.count + static_cast<T>(taken);
        piece.start = at.start_of(number);
        piece.end = last ? at.stop : at.start_of(number + 1);
        if (last) {
          cut(piece);
        } else {
          piece.level = at.level;
          piece.length = at.length;
          piece.middle = at.middle_of(number);
        }
        if (kEnds) {
          piece.front = piece.back;
          piece.back = probe.value(piece.end);
        } else {
          piece.value = probe.value(piece.middle);
        }
        add(piece);
        ++taken;
      } while (taken < alike && sum.clear > stop_clear);
      samples += taken;
      at.skip(taken);
      if (last) return samples;
    } while (sum.clear > stop_clear && this->stays(at, visit));
    return samples;
  }

  // A region of one value, as one interval.
  GV_HD static Piece<T> region(const Probe<T>& probe, T start, T end) {
    Piece<T> piece;
    piece.start = start;
    piece.end = end;
    cut(piece);
    piece.value = piece.front = piece.back = probe.value(piece.middle);
    return piece;
  }

  // The place where depth was set may lie half an interval beside the node that found it.
  template <class Number>
  GV_HD void surface(const Ray<T>& ray, const Sight<T>& sight, const Intervals<T>& at, int32_t& wanted,
                     Sum& sum) const {
    Number digits(tree, ray.at(sum.depth));
    NoPath path;
    const auto hides = [](int32_t) { return false; };
    const Visit<T> visit = this->find(ray, digits, at.cone(sum.depth), hides, stamp_b, path, wanted, sum.missed);
    shader.surface(Probe<T>(channels, sight, this->rays, ray, this->levels, visit, digits), sum);
  }

  // What comes after the last interval.
  GV_HD void finish(int64_t number, T moved, int32_t samples, Sum& sum) const {
    shader.done(sum);
    const Vec3<T> normal = unit(sum.normal);
    hits.color_r3[3 * number] = sum.red;
    hits.color_r3[3 * number + 1] = sum.green;
    hits.color_r3[3 * number + 2] = sum.blue;
    hits.alpha_r1[number] = 1 - sum.clear;
    hits.depth_r1[number] = sum.depth + moved;
    hits.samples_r[number] = samples;
    hits.missed_r[number] = sum.missed;
    normal_r3[3 * number] = normal.x;
    normal_r3[3 * number + 1] = normal.y;
    normal_r3[3 * number + 2] = normal.z;
  }

  // Near a light, a stored normal is lit differently wherever it stands.
  GV_HD bool shades_each_place() const {
    return channels.normal.given() && static_cast<int32_t>(parameter_54[3]) == Light<T>::kPoint;
  }

 private:
  template <class Number, class Any>
  GV_HD int32_t visit(const Any& shader, const Ray<T>& ray, const Sight<T>& sight, Intervals<T>& at, int32_t& wanted,
                      typename Any::Sum& sum) const {
    constexpr bool shadows = kShadows && std::is_same_v<Any, Shader>;  // none on the way to a light
    const auto hides = [&](int32_t node) {
#ifdef __CUDA_ARCH__
      if constexpr (HidesAlike<Any>::value) return hidden_tn[node] == kHidden;
#endif
      return this->hides(shader, node, sum);
    };
    const T middle = at.middle();
    Number digits(tree, ray.at(middle));
    NoPath path;
    const Visit<T> visit = this->find(ray, digits, at.cone(middle), hides, stamp_b, path, wanted, sum.missed);
    const bool empty = !Any::kSeesEmpty && visit.fine.brick == kEmpty && visit.coarse.brick == kEmpty;
    if (visit.clear || visit.fine.node < 0 || empty) {
      this->leave(at, visit);
      return 0;
    }
    const Probe<T> probe(channels, sight, this->rays, ray, this->levels, visit, digits);
    if (!shadows && probe.uniform() && !shades_each_place()) {  // one interval; shadows differ within it
      const T entry = at.start;
      this->leave(at, visit);
      shader.add(region(probe, entry, smaller(at.start, at.stop)), probe, sum);
      return 1;
    }
    int32_t samples = 0;
    samples += march_node<Any::kEnds>(probe, visit, at, sum, [&](const Piece<T>& piece) {
      if constexpr (shadows) {
        shader.add(piece, probe, sum, [&](T t, Vec3<T> way, T length, T growth) {
          return share_of_light<Number>(ray, probe, t, way, length, growth, samples, sum.missed);
        });
      } else {
        shader.add(piece, probe, sum);
      }
    });
    return samples;
  }

  // How much light comes from `length` away to the place at distance t. The cone is as wide there as the ray's; its
  // first interval is left out, so that a place does not stand in its own shadow.
  template <class Number>
  GV_HD T share_of_light(const Ray<T>& ray, const Probe<T>& probe, T t, Vec3<T> way, T length, T growth,
                         int32_t& samples, bool& missed) const {
    const Vec3<T> place{ray.origin.x + t * ray.direction.x, ray.origin.y + t * ray.direction.y,
                        ray.origin.z + t * ray.direction.z};
    const Ray<T> beam(place, way, probe.cube, ray.high, ray.cone_near + ray.cone_growth * t,
                      growth * static_cast<T>(this->rays.cone_scale), length);
    const Sight<T> sight(probe.sight.at(t), way);
    Intervals<T> at(beam, options.step, lengths);
    at.skip(1);
    const Veil<T, Shader> veil{shader};
    typename Veil<T, Shader>::Sum sum;
    int32_t wanted = 0;
    while (at.inside() && sum.clear > 1 - options.stop_alpha) {
      samples += visit<Number>(veil, beam, sight, at, wanted, sum);
    }
    missed = missed || sum.missed;
    return sum.clear;
  }

  GV_HD static void cut(Piece<T>& piece) {
    piece.level = -1;
    piece.length = piece.end - piece.start;
    piece.middle = piece.start + piece.length * static_cast<T>(0.5);
  }
};

// Works out what a shader with kHidesAlike hides.
template <class Kernel>
struct HideShaded {
  Kernel kernel;

  GV_HD void operator()(int64_t node) const {
    const bool hidden = kernel.hides(kernel.shader, static_cast<int32_t>(node), typename Kernel::Sum());
    kernel.hidden_tn[node] = hidden ? kHidden : kShown;
  }
};

// Calls body(Shader) with the shader of a kind.
template <class T, class Body>
void with_shader(ShaderKind kind, const ShadeArgs& args, const Body& body) {
  switch (kind) {
    case ShaderKind::kLit:
      return body(ShadeRay<T, Lit<T>>(args));
    case ShaderKind::kPreIntegrated:
      return body(ShadeRay<T, PreIntegrated<T>>(args));
    case ShaderKind::kStoredColor:
      return body(ShadeRay<T, StoredColor<T>>(args));
    case ShaderKind::kIsosurface:
      return body(ShadeRay<T, Isosurface<T>>(args));
    case ShaderKind::kProjection:
      return body(ShadeRay<T, Projection<T>>(args));
    case ShaderKind::kFeatures:
      return body(ShadeRay<T, Features<T>>(args));
    case ShaderKind::kShadowedLit:
      return body(ShadeRay<T, Lit<T>, true>(args));
    case ShaderKind::kShadowedColor:
      return body(ShadeRay<T, StoredColor<T>, true>(args));
  }
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
