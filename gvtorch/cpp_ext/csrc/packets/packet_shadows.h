// The shadows that fall on a packet's samples: each sample traces a cone to the light, and cones go in packets too.
#pragma once

#include "packets/packet_walk.h"

namespace gvtorch::GV_NAMESPACE {

// The intervals of a packet that wait to be added, so that many cones to the light are traced at a time: few lanes need
// one at once. Only colours wait, which nothing else depends on; they are added in the order of each ray.
template <class Kernel, class Values>
struct PacketShadows {
  using Shader = ShadowShader<float, typename Kernel::Shader>;
  using Packet = PacketWalk<Kernel, Values>;
  static constexpr int32_t kPoints = 256;

  const Light<float>& light;
  const Shader shader;
  PacketWalk<Kernel, Values, Shader> walk;  // of cones; it keeps the paths of the last ones
  int32_t points = 0;                       // how many wait
  LitPoint<Floats> point[kPoints / kLanes];
  float weight[kPoints], share[kPoints];  // weight: share of the picture; share: of the light, see Light::in_shadow
  int32_t ray_lane[kPoints];
  int32_t cones = 0;  // how many are to be traced
  LightCone<float> cone[kPoints];
  int32_t cone_point[kPoints];

  PacketShadows(const Kernel& kernel, const Values& values, const ShadeArgs& args)
      : light(kernel.light),
        shader{{}, kernel.shader},
        walk(kernel, shader, values, args, kernel.light.faintest(kernel.stop_clear)) {}

  // Puts an interval of each lane of `mask`.
  GV_HD void put(Mask mask, const LitPoint<Floats>& lit_point, const LightCone<Floats>& to_light, Packet& packet) {
    if (points > kPoints - kLanes) add_all(packet);
    const Mask receives = light.receives(lit_point);
    const Floats weights = packet.sum.clear * lit_point.base.alpha;
    for_lanes(mask, [&](int lane) {
      put_lane(point[points / kLanes], points % kLanes, take_lane<LitPoint<float>>(lit_point, lane));
      weight[points] = weights[lane];
      share[points] = 1;
      ray_lane[points] = lane;
      if (receives[lane]) {
        cone[cones] = take_lane<LightCone<float>>(to_light, lane);
        cone_point[cones++] = points;
      }
      ++points;
    });
  }
  // Adds all that wait.
  __attribute__((noinline)) void add_all(Packet& packet) {
    trace(packet);
    for (int32_t first = 0; first < points; first += kLanes) {
      Floats shares;
      memcpy(&shares, share + first, sizeof(shares));
      const Row<Floats> colors = light.in_shadow(point[first / kLanes], shares);
      for (int32_t i = first; i < smaller(first + kLanes, points); ++i) {
        packet.sum.add_light(ray_lane[i], take_lane<Row<float>>(colors, i - first), weight[i]);
      }
    }
    points = 0;
  }
  // The share of the light that a cone of a lane lets through, while nothing waits.
  GV_HD float share_of(int lane, const LightCone<float>& lane_cone, Packet& packet) {
    ray_lane[0] = lane;
    cone[0] = lane_cone;
    cone_point[0] = 0;
    cones = 1;
    trace(packet);
    return share[0];
  }

 private:
  __attribute__((noinline)) void trace(Packet& packet) {
    const auto begin_lane = [&](int lane, int64_t number) {
      walk.begin_cone(lane, cone[number], packet, ray_lane[cone_point[number]]);
      put_lane(walk.sum, lane, typename Shader::Sum{1, false, walk.stop_clear});
      return number;
    };
    const auto end_lane = [&](int lane) {
      const int32_t number = cone_point[walk.numbers[lane]];
      share[number] = walk.sum.clear[lane];
      packet.samples[ray_lane[number]] += walk.samples[lane];
      packet.sum.missed[ray_lane[number]] |= walk.sum.missed[lane];
    };
    walk.follow(0, cones, begin_lane, end_lane);
    cones = 0;
  }
};

}  // namespace gvtorch::GV_NAMESPACE
