// A user's shader in C++, which `CompiledShader` (shaders/compiled.py) compiles into an op. The user's header defines
// it:
//
//   #include "user_shader.h"
//
//   template <class T>  // float or double
//   struct Fog : gv::UserShader<T> {
//     GV_UNIFORMS(density);  // CompiledShader("fog.h", "Fog", uniforms={"density": 0.1})
//     using gv::UserShader<T>::UserShader;
//
//     GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
//       const T alpha = 1 - exp(-this->uniform(density) * interval.value * interval.length);
//       this->composite({1, 1, 1, alpha}, interval, sum);
//     }
//   };
//
// Only `add` is required. Everything else of a shader (see shaders.h) has a default here and may be overridden: kEnds,
// kSeesEmpty, kSurface and `surface`, Sum, hides, done; and kWhole and kFeatures. The struct is copied into the kernel.
// The default `hides` skips nodes in which the transfer function shows nothing; with the default Sum too, `add` need
// not be called for single intervals in which it shows nothing.
#pragma once

#include <type_traits>

#include "shaders/shade_rays.h"

namespace gvtorch::GV_NAMESPACE {

// Names the uniforms, numbers that Python sets; each name becomes an index for `uniform`.
#define GV_UNIFORMS(...)                             \
  enum Uniform : int32_t { __VA_ARGS__, kUniforms }; \
  static constexpr const char* kUniformNames = #__VA_ARGS__

template <class T>
struct UserShader : ShaderFacts {
  static constexpr bool kHidesAlike = false;
  static constexpr bool kWhole = false;     // true: a ray must not be traced in parts, each with its own Sum
  static constexpr int32_t kUniforms = -1;  // how many; -1, without GV_UNIFORMS: any number
  static constexpr const char* kUniformNames = "";
  using Sum = ShadeSum<T>;

  TransferTable<T> transfer;  // white and opaque where none was given
  Light<T> light;
  const T* uniform_k;
  int32_t uniforms;         // how many
  int32_t other_component;  // which number of the second channel the user chose
  T step;                   // world length of the shortest interval

  explicit UserShader(const ShadeArgs& args)
      : transfer(args),
        light(args),
        uniform_k(static_cast<const T*>(args.parameter_54) + kParameters),
        uniforms(args.uniforms),
        other_component(args.other_component),
        step(static_cast<T>(args.step)) {}

  GV_HD T uniform(int32_t index) const { return uniform_k[index]; }

  // The transfer function's colour of a value, and its alpha over the interval.
  GV_HD Row<T> look_up(T value, const Interval<T>& interval) const {
    return gvtorch::look_up(Transfer<T>(transfer), value, interval, step);
  }

  // Composites an interval behind the previous ones: its colour (not premultiplied) and alpha.
  GV_HD void composite(const Row<T>& row, const Interval<T>& interval, ShadeSum<T>& sum) const {
    sum.add(row, interval);
  }

  // True if the transfer function shows no value in [low, high].
  GV_HD bool hides(T low, T high, const ShadeSum<T>&) const { return Transfer<T>(transfer).transparent(low, high); }
};

// True if a shader has UserShader's `hides`, which depends on the transfer function alone.
template <class Shader, class = void>
constexpr bool kHidesByTransfer = false;
template <template <class> class Kind, class T>
constexpr bool kHidesByTransfer<Kind<T>, std::void_t<decltype(&Kind<T>::hides)>> =
    std::is_same_v<decltype(&Kind<T>::hides), decltype(&UserShader<T>::hides)>;

#ifndef __CUDACC__
// The user's Sums of a packet's rays. The walk reads `clear` and writes `missed`, which are vectors over the lanes.
template <class Sum>
struct UserSums {
  Sum of_lane[kLanes];
  Floats clear{};
  Mask missed{};
  int32_t gradient_requests = 0;  // how many lanes asked for a gradient at the last interval
};
template <class Sum>
GV_HD Sum& sum_of(UserSums<Sum>& sums, int lane) {
  sums.of_lane[lane].missed = sums.missed[lane] != 0;
  return sums.of_lane[lane];
}
template <class Sum>
GV_HD void put_lane(UserSums<Sum>& sums, int lane, const Sum& lane_sum) {
  if (&lane_sum != &sums.of_lane[lane]) sums.of_lane[lane] = lane_sum;
  sums.clear[lane] = lane_sum.clear;
  set_lane(sums.missed, lane, lane_sum.missed);
}
template <class Shader, class Sum>
GV_HD Mask hides_of(const Shader& shader, Mask mask, Floats low, Floats high, UserSums<Sum>& sums) {
  Mask hides{};
  for_lanes(mask, [&](int lane) { set_lane(hides, lane, shader.hides(low[lane], high[lane], sum_of(sums, lane))); });
  return hides;
}
#endif

// A user's shader as the walks call it. A packet is walked and its values are read for all lanes at once; the user's
// `add` is called for one lane after the other.
template <template <class> class Kind, class T>
struct CalledShader : Kind<T> {
  using Base = Kind<T>;
  using Base::Base;
  using Sum = typename Base::Sum;
  static constexpr bool kHidesAlike = kHidesByTransfer<Base> || Base::kHidesAlike;

  GV_HD void add(bool, const Interval<T>& interval, const Probe<T>& probe, Sum& sum) const {
    Base::add(interval, probe, sum);
  }

#ifndef __CUDACC__
  template <class V>
  using SumOf = UserSums<Sum>;
  // Lanes whose value is hidden are left out: it changes nothing, unless the user's own Sum counts it.
  static constexpr bool kLeavesOut = kHidesByTransfer<Base> && std::is_same_v<Sum, ShadeSum<T>> && !Base::kEnds;

  template <class Packet>
  GV_HD void add(Mask mask, const Interval<Floats>& intervals, Packet& packet, UserSums<Sum>& sums) const {
    if constexpr (kLeavesOut) mask = mask && !this->transfer.transparent(intervals.value, intervals.value);
    // The gradients of all lanes at once take about as long as two lanes' one by one.
    const bool prefetch = sums.gradient_requests >= 2;
    Vec3<Floats> slope{};
    if (prefetch) slope = packet.gradient(intervals.middle);
    sums.gradient_requests = 0;
    PrefetchedGradient<float> prefetched{NAN, {}, false};
    packet.each_lane(
        mask,
        [&](int lane, const Probe<T>& probe) {
          if (prefetch) prefetched = {intervals.middle[lane], lane_of(slope, lane), false};
          prefetched.requested = false;
          add_lane(lane, intervals, probe, sums);
          sums.gradient_requests += prefetched.requested ? 1 : 0;
        },
        &prefetched);
  }

 private:
  GV_CALL void add_lane(int lane, const Interval<Floats>& intervals, const Probe<T>& probe, UserSums<Sum>& sums) const {
    auto interval = take_lane<Interval<float>>(intervals, lane);
    if constexpr (Base::kEnds) {
      interval.front = intervals.front[lane];
      interval.back = intervals.back[lane];
    } else {
      interval.value = intervals.value[lane];
    }
    Sum& sum = sum_of(sums, lane);
    Base::add(interval, probe, sum);
    put_lane(sums, lane, sum);
  }
#endif
};

}  // namespace gvtorch::GV_NAMESPACE

namespace gv = gvtorch;
