// The fused shaders: what a ray makes of the values it meets. `ShadeRay` (shade_rays.h) walks the tree and calls them;
// the plain transfer function has a kernel of its own (trace.h).
//
// A shader is a small struct, copied into the kernel:
//
//   explicit Shader(const ShadeArgs&)             on the host: borrows tables and parameters
//   kEnds                                         its values are those at an interval's two ends, else in the middle
//   kSeesEmpty                                    EMPTY nodes count, with their mean value
//   struct Sum : ShadeSum<T>                      what it keeps of a ray; `clear` at 1 - stop_alpha ends the ray
//   hides(low, high, sum)                         true: no value in [low, high] changes the sum. The node is left out
//   kHidesAlike                                   it does not look at the sum: nodes are hidden from all rays alike
//   add(piece, probe, sum)                        adds an interval; `probe` reads any channel at any distance
//   kSurface, surface(probe, sum)                 where depth was set: `probe` then stands in the node of that place
//   done(sum)                                     after the last interval
//
// One that shadows fall on has, beside,
//
//   alpha(piece, probe)                           of an interval: what it takes from the light behind it
//   add(piece, probe, sum, shadow)                `shadow(t, way, length, growth)`: share of the light that comes there
//
// An interval lies in the node in which its middle lies. Its ends may stand up to half an interval outside; they are
// read in this node all the same, where a brick's outermost voxel centres bound them. With a border of 1 and steps of
// at most a voxel that bound is never reached, so an end is the same number from both sides; and since all that is read
// lies in the node's range, leaving a hidden node out changes no bit.
//
// Equal to ops/reference/shaders.py. Sources: Blinn, "Models of light reflection for computer synthesized pictures",
// SIGGRAPH 1977; Engel, Kraus, Ertl, "High-quality pre-integrated volume rendering using hardware-accelerated pixel
// shading", Graphics Hardware 2001; Levoy, "Display of surfaces from volume data", IEEE CG&A 1988.
#pragma once

#include "probe.h"
#include "shade.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class T>
struct Piece {
  T start, end, length, middle;  // distances, world units
  int32_t level;                 // a whole interval of step * 2^level; -1: any length
  T value;                       // in the middle
  T front, back;                 // at both ends, where the shader is of kEnds
};

template <class T>
struct ShadeSum : Accumulator<T> {
  Vec3<T> normal{0, 0, 0};  // towards the eye, weighted by share
  T hit_clear;              // transmittance at which depth is taken
  T* feature_c;

  GV_HD void add_normal(Vec3<T> n, T share) {
    for (int axis = 0; axis < 3; ++axis) normal[axis] = normal[axis] + share * n[axis];
  }
};

// Values a little apart: interpolation may round beyond the ends of a range.
template <class T>
GV_HD T a_little_below(T value) {
  return value - larger(value, -value) * static_cast<T>(9.5367431640625e-7);  // 2^-20
}
template <class T>
GV_HD T a_little_above(T value) {
  return value + larger(value, -value) * static_cast<T>(9.5367431640625e-7);
}

// The function with the alpha of an interval of any length.
template <class T>
GV_HD Row<T> look_up(const Transfer<T>& transfer, T value, const Piece<T>& piece, T step) {
  Row<T> row = transfer.look_up(transfer.find(value), piece.level < 0 ? 0 : piece.level);
  if (piece.level < 0) row.alpha = stretch(row.alpha, piece.length / step);
  return row;
}

// x^power for x in [0, 1].
template <class T>
GV_HD T power_of(T x, T power) {
  return x > static_cast<T>(1.1754944e-38f) ? exp2_exact(log2_exact(x) * power) : static_cast<T>(0);
}

// Blinn-Phong, on both sides of a surface. Rows of parameter_54: light x y z and its kind; its red green blue, ambient;
// diffuse, specular, shininess, and the width of a cone to the light: its growth (directional), or the width at
// the light (point); then those that shaders name, and in the last the stored normal's scale and offset.
constexpr int32_t kParameters = 20;
template <class T>
struct Light {
  static constexpr int32_t kHeadlight = 0, kDirectional = 1, kPoint = 2;
  const T* parameter_54;

  // The normal at distance t, towards the eye: stored, or the gradient's.
  GV_HD Vec3<T> normal(const Probe<T>& probe, T t) const {
    Vec3<T> n;
    if (probe.channels.normal.given()) {
      for (int axis = 0; axis < 3; ++axis) {
        n[axis] = probe.number_at(probe.channels.normal, axis, t) * parameter_54[16] + parameter_54[17];
      }
    } else {
      n = probe.gradient(t);
    }
    n = unit(n);
    if (dot(n, probe.sight.direction) > 0) n = {-n.x, -n.y, -n.z};
    return n;
  }
  // Colour of a place in the light. Where there is no normal, it is lit as if it faced the light, without a highlight.
  template <class... Shadow>
  GV_HD Row<T> shade(Row<T> base, Vec3<T> n, const Probe<T>& probe, T t, const Shadow&... shadow) const {
    const Vec3<T> d = probe.sight.direction;
    const Vec3<T> given{parameter_54[0], parameter_54[1], parameter_54[2]};
    const int32_t kind = static_cast<int32_t>(parameter_54[3]);
    Vec3<T> to_light{-d.x, -d.y, -d.z};
    T length = static_cast<T>(INFINITY), growth = parameter_54[11];
    if (kind == kDirectional) to_light = unit(Vec3<T>{-given.x, -given.y, -given.z});
    if (kind == kPoint) {
      const Vec3<T> place = probe.sight.at(t);
      const Vec3<T> way{given.x - place.x, given.y - place.y, given.z - place.z};
      to_light = unit(way);
      length = sqrt(dot(way, way));
      growth = growth / length;
    }
    T facing = 1, highlight = 0;
    if (dot(n, n) > 0) {
      facing = larger(static_cast<T>(0), dot(n, to_light));
      const Vec3<T> half = unit(Vec3<T>{to_light.x - d.x, to_light.y - d.y, to_light.z - d.z});
      if (facing > 0) highlight = power_of(larger(static_cast<T>(0), dot(n, half)), parameter_54[10]);
    }
    if constexpr (sizeof...(shadow) > 0) {
      if (facing > 0 && kind != kHeadlight) {
        const T share = (shadow(t, to_light, length, growth), ...);
        facing = facing * share;
        highlight = highlight * share;
      }
    }
    const T diffuse = parameter_54[8] * facing;
    const T specular = parameter_54[9] * highlight;
    const T ambient = parameter_54[7];
    Row<T> lit = base;
    lit.red = base.red * (ambient + diffuse * parameter_54[4]) + specular * parameter_54[4];
    lit.green = base.green * (ambient + diffuse * parameter_54[5]) + specular * parameter_54[5];
    lit.blue = base.blue * (ambient + diffuse * parameter_54[6]) + specular * parameter_54[6];
    return lit;
  }
};

// The transfer function, lit.
template <class T>
struct Lit {
  static constexpr bool kEnds = false, kSeesEmpty = false, kSurface = false, kHidesAlike = true;
  using Sum = ShadeSum<T>;
  TransferView<T> transfer;
  Light<T> light;
  T step;

  explicit Lit(const ShadeArgs& args)
      : transfer(args), light{static_cast<const T*>(args.parameter_54)}, step(static_cast<T>(args.step)) {}

  template <class Any>
  GV_HD bool hides(T low, T high, const Any&) const {
    return Transfer<T>(transfer).transparent(low, high);
  }
  GV_HD T alpha(const Piece<T>& piece, const Probe<T>&) const {
    return look_up(Transfer<T>(transfer), piece.value, piece, step).alpha;
  }
  template <class... Shadow>
  GV_HD void add(const Piece<T>& piece, const Probe<T>& probe, Sum& sum, const Shadow&... shadow) const {
    Row<T> row = look_up(Transfer<T>(transfer), piece.value, piece, step);
    if (row.alpha > 0) {
      const Vec3<T> n = light.normal(probe, piece.middle);
      row = light.shade(row, n, probe, piece.middle, shadow...);
      sum.add_normal(n, sum.clear * row.alpha);
    }
    sum.add(row, piece.start, piece.length, sum.hit_clear);
  }
  GV_HD void done(Sum&) const {}
};

// Colour and opacity of each voxel; the value is the opacity. Row 3 of the parameters: scale of the numbers, reference
// length, whether colours are premultiplied, whether they are lit. A channel may hold four numbers for each of six
// directions (Crassin et al., "Interactive indirect illumination using voxel cone tracing", CGF 2011): a ray reads
// the three that it goes along, weighted by the squares of its direction, whose sum is 1.
template <class T>
struct StoredColor {
  static constexpr bool kEnds = false, kSeesEmpty = false, kSurface = false, kHidesAlike = true;
  using Sum = ShadeSum<T>;
  Light<T> light;

  explicit StoredColor(const ShadeArgs& args) : light{static_cast<const T*>(args.parameter_54)} {}

  template <class Any>
  GV_HD bool hides(T, T high, const Any&) const {
    return !(a_little_above(high) > 0);
  }
  GV_HD T opacity_of(const Piece<T>& piece, const Probe<T>& probe) const {
    const T value = probe.channels.value.width == 4 ? piece.value : seen(probe, 3, piece.middle);
    return clamp(value * light.parameter_54[12], static_cast<T>(0), static_cast<T>(1));
  }
  GV_HD T alpha(const Piece<T>& piece, const Probe<T>& probe) const {
    return stretch(opacity_of(piece, probe), piece.length / light.parameter_54[13]);
  }
  template <class... Shadow>
  GV_HD void add(const Piece<T>& piece, const Probe<T>& probe, Sum& sum, const Shadow&... shadow) const {
    const T scale = light.parameter_54[12];
    const T opacity = opacity_of(piece, probe);
    if (!(opacity > 0)) return;
    T color[3];
#ifdef __CUDA_ARCH__
#pragma unroll 1
#endif
    for (int i = 0; i < 3; ++i) {
      color[i] = seen(probe, i, piece.middle) * scale;
      if (light.parameter_54[14] > 0) color[i] = color[i] / opacity;
    }
    Row<T> row{color[0], color[1], color[2], stretch(opacity, piece.length / light.parameter_54[13])};
    if (light.parameter_54[15] > 0) {
      const Vec3<T> n = light.normal(probe, piece.middle);
      row = light.shade(row, n, probe, piece.middle, shadow...);
      sum.add_normal(n, sum.clear * row.alpha);
    }
    sum.add(row, piece.start, piece.length, sum.hit_clear);
  }
  // One of the four numbers, as it is seen along the ray: to the bit that of one direction, where all six are equal.
  GV_HD static T seen(const Probe<T>& probe, int32_t number, T t) {
    const ChannelView& channel = probe.channels.value;
    const Vec3<T> d = probe.sight.direction;
    const bool directional = channel.width > 4;
    const T z = probe.number_at(channel, directional ? number + 16 + (d.z < 0 ? 4 : 0) : number, t);
    T value = z;
#ifdef __CUDA_ARCH__
#pragma unroll 1
#endif
    for (int axis = 0; directional && axis < 2; ++axis) {
      const T other = probe.number_at(channel, number + 8 * axis + (d[axis] < 0 ? 4 : 0), t);
      value = value + d[axis] * d[axis] * (other - z);
    }
    return value;
  }
  GV_HD void done(Sum&) const {}
};

// What a shader takes from the light that goes through: the shader of rays that go to a light.
template <class T, class Shader>
struct Veil {
  static constexpr bool kEnds = false, kSeesEmpty = false, kHidesAlike = Shader::kHidesAlike;
  struct Sum {
    T clear = 1;  // transmittance
    bool missed = false;
  };
  const Shader& shader;

  GV_HD bool hides(T low, T high, const Sum& sum) const { return shader.hides(low, high, sum); }
  GV_HD void add(const Piece<T>& piece, const Probe<T>& probe, Sum& sum) const {
    sum.clear = sum.clear * (1 - shader.alpha(piece, probe));
  }
};

// A table over the values at both ends of an interval, (l, m, m): premultiplied colour and alpha. Beyond its domain the
// function is constant: the parts of an interval that lie there are added before and behind.
template <class T>
struct PreIntegrated {
  static constexpr bool kEnds = true, kSeesEmpty = false, kSurface = false, kHidesAlike = true;
  using Sum = ShadeSum<T>;
  TransferView<T> transfer;
  T step;

  explicit PreIntegrated(const ShadeArgs& args) : transfer(args), step(static_cast<T>(args.step)) {}

  GV_HD bool hides(T low, T high, const Sum&) const { return Transfer<T>(transfer).transparent(low, high); }
  GV_HD void add(const Piece<T>& piece, const Probe<T>&, Sum& sum) const {
    const T lengths = piece.level < 0 ? piece.length / step : static_cast<T>(1);
    const int64_t level = piece.level < 0 ? 0 : piece.level;
    const Transfer<T> places(transfer);
    const T low = transfer.domain_2[0];
    const T high = transfer.domain_2[1];
    const T front = clamp(piece.front, low, high);
    const T back = clamp(piece.back, low, high);
    Row<T> row = pair(places, front, back, level);
    if (front == back || (front == piece.front && back == piece.back)) {
      row = part(row, lengths);
    } else {
      const T share = lengths / size_of(piece.back - piece.front);
      row = part(row, share * size_of(back - front));
      row = over(part(pair(places, front, front, level), share * size_of(front - piece.front)), row);
      row = over(row, part(pair(places, back, back, level), share * size_of(piece.back - back)));
    }
    const T red = sum.red + sum.clear * row.red;
    const T green = sum.green + sum.clear * row.green;
    const T blue = sum.blue + sum.clear * row.blue;
    sum.add({0, 0, 0, row.alpha}, piece.start, piece.length, sum.hit_clear);
    sum.red = red;
    sum.green = green;
    sum.blue = blue;
  }
  // What an interval of a length of the table shows, from one value to another.
  GV_HD Row<T> pair(const Transfer<T>& places, T in_front, T behind, int64_t level) const {
    const Cell<T> front = places.find(in_front);
    const Cell<T> back = places.find(behind);
    const int64_t rows = transfer.rows;
    const Row<T>* corner = transfer.table_lm + ((level * rows + front.row) * rows + back.row);
    return mix(mix(corner[0], corner[1], back.weight), mix(corner[rows], corner[rows + 1], back.weight), front.weight);
  }
  // The same values over another length.
  GV_HD static Row<T> part(Row<T> row, T lengths) {
    if (!(row.alpha > 0) || lengths == 1) return row;
    if (!(lengths > 0)) return {0, 0, 0, 0};
    const T alpha = stretch(row.alpha, lengths);
    const T scale = alpha / row.alpha;
    return {row.red * scale, row.green * scale, row.blue * scale, alpha};
  }
  GV_HD static Row<T> over(Row<T> a, Row<T> b) {
    const T kept = 1 - a.alpha;
    return {a.red + kept * b.red, a.green + kept * b.green, a.blue + kept * b.blue, a.alpha + kept * b.alpha};
  }
  GV_HD static T size_of(T value) { return larger(value, -value); }
  GV_HD static Row<T> mix(const Row<T>& a, const Row<T>& b, T weight) {
    return {a.red + weight * (b.red - a.red), a.green + weight * (b.green - a.green),
            a.blue + weight * (b.blue - a.blue), a.alpha + weight * (b.alpha - a.alpha)};
  }
  GV_HD void done(Sum&) const {}
};

// The first place where the value passes row 3, number 0 of the parameters, in either direction. Four bisections and a
// secant: an interval of a voxel is cut to a sixteenth before its rest is taken for linear. The side on which the last
// interval ended is kept, so that no crossing is lost between two nodes that round differently.
template <class T>
struct Isosurface {
  static constexpr bool kEnds = true, kSeesEmpty = false, kSurface = true, kHidesAlike = true;
  struct Sum : ShadeSum<T> {
    T before = 0;
    T before_end = static_cast<T>(-INFINITY);
    T share = 0;  // of the light, that came to the surface
  };
  TransferView<T> transfer;
  Light<T> light;
  int32_t color_component;

  explicit Isosurface(const ShadeArgs& args)
      : transfer(args), light{static_cast<const T*>(args.parameter_54)}, color_component(args.other_component) {}

  GV_HD bool hides(T low, T high, const Sum&) const {
    return a_little_above(high) < iso() || a_little_below(low) >= iso();
  }
  GV_HD void add(const Piece<T>& piece, const Probe<T>& probe, Sum& sum) const {
    const T level = iso();
    const bool below = piece.front < level;
    if (sum.before_end == piece.start && (sum.before < level) != below) return hit(piece.start, sum);
    if (below != (piece.back < level)) {
      T near = piece.start, far = piece.end, near_value = piece.front, far_value = piece.back;
#ifdef __CUDA_ARCH__
#pragma unroll 1
#endif
      for (int step = 0; step < 4; ++step) {
        const T middle = near + (far - near) * static_cast<T>(0.5);
        const T value = probe.value(middle);
        const bool same = (value < level) == below;
        near = same ? middle : near;
        near_value = same ? value : near_value;
        far = same ? far : middle;
        far_value = same ? far_value : value;
      }
      const T part = clamp((level - near_value) / (far_value - near_value), static_cast<T>(0), static_cast<T>(1));
      return hit(near + part * (far - near), sum);
    }
    sum.before = piece.back;
    sum.before_end = piece.end;
  }
  GV_HD void surface(const Probe<T>& probe, Sum& sum) const {
    const T t = sum.depth;
    const Vec3<T> n = light.normal(probe, t);
    const T value = probe.channels.other.given() ? probe.number_at(probe.channels.other, color_component, t) : iso();
    const Transfer<T> colors(transfer);
    const Row<T> row = light.shade(colors.look_up(colors.find(value), 0), n, probe, t);
    sum.red = sum.share * row.red;
    sum.green = sum.share * row.green;
    sum.blue = sum.share * row.blue;
    sum.normal = n;
  }
  GV_HD void done(Sum&) const {}

 private:
  GV_HD T iso() const { return light.parameter_54[12]; }
  GV_HD static void hit(T t, Sum& sum) {
    sum.share = sum.clear;
    sum.clear = 0;
    sum.depth = t;
  }
};

// Maximum, minimum or mean of the value along the ray, coloured by the transfer function. Row 3, number 0 of the
// parameters tells which. A node that can't change a maximum or minimum is left out.
template <class T>
struct Projection {
  static constexpr bool kEnds = false, kSeesEmpty = true, kSurface = false, kHidesAlike = false;
  static constexpr int32_t kMaximum = 0, kMinimum = 1, kMean = 2;
  struct Sum : ShadeSum<T> {
    T found = 0;   // extreme so far, or sum of value * length
    T length = 0;  // sum of lengths
    T at = 0;      // where the extreme is; where the first interval starts
  };
  TransferView<T> transfer;
  const T* parameter_54;

  explicit Projection(const ShadeArgs& args) : transfer(args), parameter_54(static_cast<const T*>(args.parameter_54)) {}

  GV_HD int32_t kind() const { return static_cast<int32_t>(parameter_54[12]); }
  GV_HD bool hides(T low, T high, const Sum& sum) const {
    if (!(sum.length > 0)) return false;
    const int32_t which = kind();
    return which == kMaximum ? a_little_above(high) <= sum.found
                             : which == kMinimum && a_little_below(low) >= sum.found;
  }
  GV_HD void add(const Piece<T>& piece, const Probe<T>&, Sum& sum) const {
    const int32_t which = kind();
    const bool first = !(sum.length > 0);
    if (which == kMean) {
      if (first) sum.at = piece.start;
      sum.found = sum.found + piece.value * piece.length;
    } else if (first || (which == kMaximum ? piece.value > sum.found : piece.value < sum.found)) {
      sum.found = piece.value;
      sum.at = piece.middle;
    }
    sum.length = sum.length + piece.length;
  }
  GV_HD void done(Sum& sum) const {
    if (!(sum.length > 0)) return;
    const T value = kind() == kMean ? sum.found / sum.length : sum.found;
    const Transfer<T> colors(transfer);
    const Row<T> row = colors.look_up(colors.find(value), 0);
    sum.red = sum.clear * row.red;
    sum.green = sum.clear * row.green;
    sum.blue = sum.clear * row.blue;
    sum.clear = 0;
    sum.depth = sum.at;
    sum.feature_c[0] = value;
  }
};

// All numbers of a second channel, composited with the transfer function's alpha. Sums lie in the output: any number.
template <class T>
struct Features {
  static constexpr bool kEnds = false, kSeesEmpty = false, kSurface = false, kHidesAlike = true;
  using Sum = ShadeSum<T>;
  TransferView<T> transfer;
  T step;

  explicit Features(const ShadeArgs& args) : transfer(args), step(static_cast<T>(args.step)) {}

  GV_HD bool hides(T low, T high, const Sum&) const { return Transfer<T>(transfer).transparent(low, high); }
  GV_HD void add(const Piece<T>& piece, const Probe<T>& probe, Sum& sum) const {
    const Row<T> row = look_up(Transfer<T>(transfer), piece.value, piece, step);
    const T share = sum.clear * row.alpha;
    const ChannelView& features = probe.channels.other;
    for (int32_t c = 0; share > 0 && c < features.width; ++c) {
      sum.feature_c[c] = sum.feature_c[c] + share * probe.number_at(features, c, piece.middle);
    }
    sum.add(row, piece.start, piece.length, sum.hit_clear);
  }
  GV_HD void done(Sum&) const {}
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
