// Light: how a position is lit, from its colour, its normal and the share of the light that reaches it.
// T is float or double; V is T, or Floats for a packet (arithmetic.h).
//
// Sources: Blinn, "Models of light reflection for computer synthesized pictures", SIGGRAPH 1977; Wrenninge, Kulla,
// Lundqvist, "Oz: the great and volumetric", SIGGRAPH 2013 talks; Henyey, Greenstein, "Diffuse radiation in the
// galaxy", ApJ 93, 1941.
#pragma once

#include "shaders/probe.h"
#include "walk/shade.h"

namespace gvtorch::GV_NAMESPACE {

// x^power for x in [0, 1].
template <class T, class Power>
GV_HD T power_of(T x, Power power) {
  const MaskOf<T> positive = x > static_cast<RealOf<T>>(1.1754944e-38f);
  if (!any(positive)) return T{};
  return select(positive, exp2_exact(log2_exact(x) * power), T{});
}

// Factors of an octave of scattering over the one before it: of its light, and of its anisotropy. Fitted to path traced
// clouds (benchmarks/cloud_light.py).
constexpr double kOctaveLight = 0.55, kOctaveDirection = 0.6;
constexpr int kMaxOctaves = 16;

// The moments of normals that no light reaches are stored divided by this: see shaders/coarse_colors.py.
constexpr double kFaint = 32;

// Mean products of the components of normals.
template <class T>
struct Moments {
  T xx, xy, xz, yy, yz, zz;

  GV_HD T trace() const { return xx + yy + zz; }
  GV_HD Vec3<T> times(const Vec3<T>& v) const {
    return {xx * v.x + xy * v.y + xz * v.z, xy * v.x + yy * v.y + yz * v.z, xz * v.x + yz * v.y + zz * v.z};
  }
};
// f(a, b) of each number.
template <class T, class F>
GV_HD Moments<T> combined(const Moments<T>& a, const Moments<T>& b, const F& f) {
  return {f(a.xx, b.xx), f(a.xy, b.xy), f(a.xz, b.xz), f(a.yy, b.yy), f(a.yz, b.yz), f(a.zz, b.zz)};
}

// A position as the light finds it, if nothing lies between.
template <class V>
struct LitPoint {
  Row<V> base;          // its colour, and an interval's alpha
  V facing, highlight;  // factors of its diffuse and specular light
  V cosine;             // of the angle between the ray and the direction to the light

  GV_EACH_MEMBER(Row<V>::each_member(a.base, b.base, body); GV_BOTH(facing) GV_BOTH(highlight) GV_BOTH(cosine))
};

// A cone to the light. Distances are world lengths.
template <class V>
struct LightCone {
  V t;                // distance along the ray at which it begins
  Vec3<V> direction;  // world, unit length
  V length, growth;   // distance to the light; how much the cone grows per unit of length

  GV_EACH_MEMBER(GV_BOTH(t) GV_BOTH(direction) GV_BOTH(length) GV_BOTH(growth))
};

// Blinn-Phong, on both sides of a surface; or the light that a medium scatters.
template <class T>
struct Light {
  const Parameters<T>* parameters;

  explicit Light(const ShadeArgs& args) : parameters(static_cast<const Parameters<T>*>(args.parameter_54)) {}

  // True for a scattering medium, which has no normals.
  GV_HD bool scatters() const { return parameters->octaves > 0; }
  // How many octaves of scattering are summed, whatever number the parameters hold.
  GV_HD int32_t octaves() const {
    return static_cast<int32_t>(clamp(parameters->octaves, static_cast<T>(0), static_cast<T>(kMaxOctaves)));
  }

  GV_HD LightKind kind() const { return static_cast<LightKind>(static_cast<int32_t>(parameters->light_kind)); }

  // The unit normal at distance t, towards the eye: the stored one, or the gradient's direction. 0 in a medium.
  template <class AnyProbe, class V = typename AnyProbe::Number>
  GV_HD Vec3<V> normal(const AnyProbe& probe, typename AnyProbe::Number t) const {
    Vec3<V> n{};
    if (scatters()) return n;
    if (probe.channels.normal.exists()) {
      for (int axis = 0; axis < 3; ++axis) {
        n[axis] =
            probe.number_at(probe.channels.normal, axis, t) * parameters->normal_scale + parameters->normal_offset;
      }
    } else {
      n = probe.gradient(t);
    }
    return to_eye(n, probe.sight.direction);
  }
  // The unit normal along a vector of any length, towards the eye that looks along d.
  template <class V>
  GV_HD static Vec3<V> to_eye(Vec3<V> n, const Vec3<V>& d) {
    n = unit(n);
    const MaskOf<V> faces_away = dot(n, d) > 0;
    for (int axis = 0; axis < 3; ++axis) n[axis] = select(faces_away, -n[axis], n[axis]);
    return n;
  }
  // The cone to the light from distance t of the probe's ray.
  template <class AnyProbe, class V = typename AnyProbe::Number>
  GV_HD LightCone<V> towards(const AnyProbe& probe, typename AnyProbe::Number t) const {
    const Parameters<T>& p = *parameters;
    const Vec3<V> d = probe.sight.direction;
    LightCone<V> cone{t, {-d.x, -d.y, -d.z}, broadcast<V>(static_cast<T>(INFINITY)), broadcast<V>(p.light_width)};
    if (kind() == LightKind::kDirectional) {
      for (int axis = 0; axis < 3; ++axis) cone.direction[axis] = broadcast<V>(-p.light_vector[axis]);
      cone.direction = unit(cone.direction);
    }
    if (kind() == LightKind::kPoint) {
      const Vec3<V> position = probe.sight.at(t);
      Vec3<V> to_light;
      for (int axis = 0; axis < 3; ++axis) to_light[axis] = p.light_vector[axis] - position[axis];
      cone.direction = unit(to_light);
      cone.length = square_root(dot(to_light, to_light));
      cone.growth = cone.growth / cone.length;
    }
    return cone;
  }
  // A position seen along d. Without a normal (n is 0), it is lit as if it faced the light, without a highlight.
  template <class V>
  GV_HD LitPoint<V> point_of(const Row<V>& base, const Vec3<V>& n, const Vec3<V>& d, const Vec3<V>& to_light) const {
    LitPoint<V> point{base, broadcast<V>(static_cast<T>(1)), V{}, dot(d, to_light)};
    const MaskOf<V> has_normal = dot(n, n) > 0;
    if (any(has_normal)) {
      point.facing = select(has_normal, larger(V{}, dot(n, to_light)), point.facing);
      const Vec3<V> half_vector = unit(minus(to_light, d));
      const MaskOf<V> faces = has_normal && point.facing > 0;
      if (any(faces)) {
        const V highlight = power_of(larger(V{}, dot(n, half_vector)), parameters->shininess);
        point.highlight = select(faces, highlight, point.highlight);
      }
    }
    return point;
  }
  // Lit colour of a position without shadows.
  template <class AnyProbe, class V = typename AnyProbe::Number>
  GV_HD Row<V> shade(const Row<typename AnyProbe::Number>& base, const Vec3<typename AnyProbe::Number>& n,
                     const AnyProbe& probe, typename AnyProbe::Number t) const {
    const LitPoint<V> point = point_of(base, n, probe.sight.direction, towards(probe, t).direction);
    return lit(base, point.facing, point.highlight);
  }
  // True where a position's colour depends on how much light reaches it.
  template <class V>
  GV_HD MaskOf<V> receives(const LitPoint<V>& point) const {
    return kind() == LightKind::kHeadlight ? MaskOf<V>{} : point.facing > 0;
  }
  // Lit colour of a position that `share` of the light reaches.
  template <class V>
  GV_HD Row<V> in_shadow(const LitPoint<V>& point, V share) const {
    if (scatters() && kind() != LightKind::kHeadlight) return scattered(point.base, point.cosine, share);
    return lit(point.base, point.facing * share, point.highlight * share);
  }
  // Adds an interval, lit; with shadows, `shadow(mask, point, cone)` adds it, by `in_shadow`.
  template <class V, class AnyProbe, class... Shadow>
  GV_HD void add(MaskOf<V> mask, const Row<V>& base, const AnyProbe& probe, const Interval<V>& interval,
                 ShadeSum<V>& sum, const Shadow&... shadow) const {
    const Vec3<V> n = normal(probe, interval.middle);
    const LightCone<V> cone = towards(probe, interval.middle);
    const LitPoint<V> point = point_of(base, n, probe.sight.direction, cone.direction);
    sum.add_normal(n, sum.clear * base.alpha, mask);
    if constexpr (sizeof...(shadow) > 0) {
      (shadow(mask, point, cone), ...);
    } else {
      sum.add(lit(base, point.facing, point.highlight), interval, mask);
    }
  }
  // Lights a base colour by the factors of its diffuse (`facing`) and specular (`highlight`) light.
  template <class V>
  GV_HD Row<V> lit(const Row<V>& base, V facing, V highlight) const {
    const Parameters<T>& p = *parameters;
    const V diffuse = p.diffuse * facing;
    const V specular = p.specular * highlight;
    const auto lit = [&](V color, int channel) {
      const T light = p.light_color[channel];
      return color * (p.ambient + diffuse * light) + specular * light;
    };
    return {lit(base.red, 0), lit(base.green, 1), lit(base.blue, 2), base.alpha};
  }

  // Lit colour of rough surfaces of which only the moments of their normals are known; sets `normal` to a vector along
  // the normals, towards the eye. Where the trace is 0, they are lit as if they faced the light. `front` is used if
  // `sided`: the mean normal of what is seen from one side, scaled as the moments; light from behind then adds nothing.
  //
  // The moments give the mean and deviation of the normals' cosine with the light, on the side that the eye sees; it is
  // assumed to be uniformly distributed, as it is for the normals of a ball. Highlights: Toksvig, "Mipmapping normal
  // maps", 2005, for a spread that is the same to all sides of a main normal.
  template <class AnyProbe, class V>
  GV_HD Row<V> shade_rough(const Row<V>& base, Moments<V> m, bool sided, const Vec3<V>& front, const AnyProbe& probe,
                           V t, Vec3<V>& normal) const {
    const T zero = 0, one = 1, two = 2, three = 3, shininess = parameters->shininess;
    const Vec3<V> d = probe.sight.direction;
    const V total = m.trace(), unity = broadcast<V>(one);
    const V share = clamp(static_cast<T>(kFaint) * total, zero, one), divisor = select(total > 0, total, unity);
    m = {m.xx / divisor, m.xy / divisor, m.xz / divisor, m.yy / divisor, m.yz / divisor, m.zz / divisor};
    const V square = m.xx * m.xx + m.yy * m.yy + m.zz * m.zz + two * (m.xy * m.xy + m.xz * m.xz + m.yz * m.yz);
    const Vec3<V> to_light = towards(probe, t).direction;
    normal = m.times(d);
    for (int axis = 0; axis < 3; ++axis) normal[axis] = -normal[axis];
    const V seen_rms = square_root(larger(V{}, -dot(d, normal)));
    // The ratio of a mean magnitude to its root mean square.
    const V mean_per_rms = static_cast<T>(0.8) + static_cast<T>(0.2) * square;
    V mean = mean_per_rms * dot(to_light, normal) / select(seen_rms > 0, seen_rms, unity);
    if (sided) mean = smaller(mean, mean_per_rms * dot(to_light, front) / divisor);
    const V half_width = square_root(three * larger(V{}, dot(to_light, m.times(to_light)) - mean * mean));
    const V upper_part = clamp(mean + half_width, V{}, two * half_width);
    const V facing = upper_part * upper_part / select(half_width > 0, two * two * half_width, unity) +
                     larger(V{}, mean - half_width);

    const Vec3<V> half_vector = unit(minus(to_light, d));
    const V alignment = square_root(clamp(static_cast<T>(1.5) * square - static_cast<T>(0.5), zero, one));
    const V spread = (one - alignment) / three;
    const V correction = static_cast<T>(0.9) * (spread * spread);
    const V along = dot(half_vector, m.times(half_vector)) - spread + correction / three;
    const V effective_shininess = shininess / (one + shininess * spread);
    const V brightness = (one + effective_shininess) / (one + shininess);
    V highlight{};
    const MaskOf<V> faces = facing > 0;
    if (any(faces)) {
      const V cosine = clamp(along / (alignment + correction), zero, one);
      highlight = select(faces, brightness * power_of(cosine, effective_shininess * static_cast<T>(0.5)), highlight);
    }
    return lit(base, one - share + share * facing, share * highlight);
  }

  // Colour of a position in a medium, from the share of light that reaches it unscattered (`clear`). The first octave
  // is single scattering; the others approximate more and more scatterings: each has half the optical depth of the one
  // before, is weaker, more coloured and less directed.
  template <class V>
  GV_HD Row<V> scattered(const Row<V>& base, V cosine, V clear) const {
    const Parameters<T>& p = *parameters;
    const V albedo[3] = {base.red, base.green, base.blue};
    V weight[3] = {albedo[0], albedo[1], albedo[2]}, sum[3] = {};
    T g = p.anisotropy;
    GV_NO_UNROLL
    for (int32_t octave = octaves(); octave > 0; --octave) {
      const V share = phase(g, cosine) * clear;
      for (int i = 0; i < 3; ++i) {
        sum[i] = sum[i] + weight[i] * share;
        weight[i] = weight[i] * (albedo[i] * albedo[i]) * static_cast<T>(kOctaveLight);
      }
      g = g * static_cast<T>(kOctaveDirection);
      clear = square_root(clear);
    }
    const auto lit = [&](int i) { return albedo[i] * p.ambient + p.diffuse * p.light_color[i] * sum[i]; };
    return {lit(0), lit(1), lit(2), base.alpha};
  }
  // The Henyey-Greenstein phase function, scaled to a mean of 1 over all directions.
  template <class V>
  GV_HD static V phase(T g, V cosine) {
    const T square = g * g;
    const V base = 1 + square - 2 * g * cosine;
    return (1 - square) / (base * square_root(base));
  }
  // The transmittance at which rays to the light end: so small because the last octave uses a root of it.
  GV_HD T faintest(T stop_clear) const {
    GV_NO_UNROLL
    for (int32_t octave = octaves(); octave > 1; --octave) stop_clear = stop_clear * stop_clear;
    return stop_clear;
  }
};

}  // namespace gvtorch::GV_NAMESPACE
