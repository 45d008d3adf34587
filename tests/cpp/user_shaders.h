// Shaders of tests/test_compiled_shader.py: twins of built-in ones, and one of its own.
#pragma once

#include "user_shader.h"

namespace mine {

// The plain transfer function.
template <class T>
struct Plain : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;

  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
    this->composite(this->look_up(interval.value, interval), interval, sum);
  }
};

// gv.Lit, which gives the features of gv.Features as well.
template <class T>
struct LitFeatures : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  static constexpr int32_t kFeatures = gv::UserShader<T>::kAsOther;

  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>& probe, gv::ShadeSum<T>& sum) const {
    gv::Row<T> row = this->look_up(interval.value, interval);
    if (row.alpha > 0) {
      const T share = sum.clear * row.alpha;
      const gv::ChannelView& other = probe.channels.other;
      for (int32_t c = 0; c < other.width; ++c) {
        sum.feature_c[c] = sum.feature_c[c] + share * probe.number_at(other, c, interval.middle);
      }
      const gv::Vec3<T> normal = this->light.normal(probe, interval.middle);
      row = this->light.shade(row, normal, probe, interval.middle);
      sum.add_normal(normal, share);
    }
    this->composite(row, interval, sum);
  }
};

// gv.Projection("maximum"): a Sum of its own, features, hidden by what was found, in one go.
template <class T>
struct Highest : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  static constexpr bool kSeesEmpty = true, kWhole = true;
  static constexpr int32_t kFeatures = 1;
  struct Sum : gv::ShadeSum<T> {
    T found = -INFINITY, at = 0;
  };

  GV_HD bool hides(T, T high, const Sum& sum) const { return gv::a_little_above(high) <= sum.found; }
  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>&, Sum& sum) const {
    if (!(interval.value > sum.found)) return;
    sum.found = interval.value;
    sum.at = interval.middle;
  }
  GV_HD void done(Sum& sum) const {
    if (!(sum.found > -INFINITY)) return;
    gv::Interval<T> whole{};
    whole.level = 0;
    const gv::Row<T> row = this->look_up(sum.found, whole);
    sum.red = row.red;
    sum.green = row.green;
    sum.blue = row.blue;
    sum.clear = 0;
    sum.depth = sum.at;
    sum.feature_c[0] = sum.found;
  }
};

// The first place above a level, without refinement: reads both ends, is coloured in the node where it lies.
template <class T>
struct FirstEnd : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  GV_UNIFORMS(level);
  static constexpr bool kEnds = true, kSurface = true;

  GV_HD bool hides(T, T high, const gv::ShadeSum<T>&) const { return gv::a_little_above(high) < this->uniform(level); }
  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
    if (interval.back < this->uniform(level)) return;
    sum.clear = 0;
    sum.depth = interval.end;
  }
  GV_HD void surface(const gv::Probe<T>& probe, gv::ShadeSum<T>& sum) const {
    sum.red = probe.value(sum.depth);
    sum.normal = this->light.normal(probe, sum.depth);
  }
};

// What is above a level, whatever the transfer function shows; hidden alike from all rays, as it tells.
template <class T>
struct Above : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  GV_UNIFORMS(level);
  static constexpr bool kHidesAlike = true;

  GV_HD bool hides(T, T high, const gv::ShadeSum<T>&) const { return gv::a_little_above(high) < this->uniform(level); }
  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
    const T over = interval.value - this->uniform(level);
    if (over > 0) this->composite({interval.value, over, 1, static_cast<T>(0.1)}, interval, sum);
  }
};

// The plain transfer function, which tells that its default hides alike.
template <class T>
struct PlainAlike : Plain<T> {
  using Plain<T>::Plain;
  static constexpr bool kHidesAlike = true;
};

// Where the value rises through one level after the other: all that a struct may tell anew, and hidden by what the ray
// has found and by what it still lets through.
template <class T>
struct Contours : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  GV_UNIFORMS(level, gap, least);
  static constexpr bool kEnds = true, kSeesEmpty = true, kSurface = true, kWhole = true;
  static constexpr int32_t kFeatures = 2;
  struct Sum : gv::ShadeSum<T> {
    int32_t found = 0;
    T ends[2] = {0, 0};  // of the last interval that was met
  };

  GV_HD T wanted(const Sum& sum) const { return this->uniform(level) + this->uniform(gap) * static_cast<T>(sum.found); }
  GV_HD bool hides(T, T high, const Sum& sum) const {
    return gv::a_little_above(high) < wanted(sum) || sum.clear < this->uniform(least);
  }
  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>& probe, Sum& sum) const {
    sum.ends[0] = interval.start;
    sum.ends[1] = interval.end;
    if (interval.back < wanted(sum) || sum.clear < this->uniform(least)) return;
    ++sum.found;
    sum.red = sum.red + sum.clear * probe.value(interval.middle);
    sum.blue = sum.blue + sum.clear * interval.front;
    sum.clear = sum.clear * static_cast<T>(0.75);
    if (!(sum.depth < INFINITY)) sum.depth = interval.end;
  }
  GV_HD void surface(const gv::Probe<T>& probe, Sum& sum) const {
    sum.green = probe.value(sum.depth);
    sum.normal = this->light.normal(probe, sum.depth);
  }
  GV_HD void done(Sum& sum) const {
    sum.feature_c[0] = static_cast<T>(sum.found);
    sum.feature_c[1] = sum.ends[0] + sum.ends[1];
  }
};

// Coloured by its place, darker with the distance from the camera.
template <class T>
struct Bands : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  GV_UNIFORMS(density, width, fade);

  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>& probe, gv::ShadeSum<T>& sum) const {
    const gv::Vec3<T> place = probe.sight.at(interval.middle);
    const T light = exp(-(interval.middle + probe.sight.moved) * this->uniform(fade));
    const T wave = static_cast<T>(0.5) + static_cast<T>(0.5) * sin(place.z / this->uniform(width));
    const T alpha = 1 - exp(-this->uniform(density) * gv::larger(interval.value, static_cast<T>(0)) * interval.length);
    this->composite({light * wave, light * (1 - wave), light * static_cast<T>(0.5), alpha}, interval, sum);
  }
};

}  // namespace mine
