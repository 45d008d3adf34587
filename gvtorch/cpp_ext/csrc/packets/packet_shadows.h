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
  PacketWalk<Kernel, Values, Shader> tracer;  // of cones; it keeps the paths of the last ones
  int32_t points = 0;                         // how many wait
  LitPoint<Floats> point[kPoints / kLanes];
  float weight[kPoints], share[kPoints];  // weight: share of the picture; share: of the light, see Light::in_shadow
  int32_t ray_lane[kPoints];
  int32_t cones = 0;  // how many are to be traced
  LightCone<float> cone[kPoints];
  int32_t cone_point[kPoints];

  PacketShadows(const Kernel& kernel, const Values& values, const ShadeArgs& args)
      : light(kernel.light),
        shader{{}, kernel.shader},
        tracer(kernel, shader, values, args, kernel.light.faintest(kernel.stop_clear)) {}

  // True if `put` may find no room.
  GV_HD bool is_full() const { return points > kPoints - kLanes; }
  // Puts an interval of each lane of `mask`.
  GV_HD void put(Mask mask, const LitPoint<Floats>& lit_point, const LightCone<Floats>& to_light, Packet& packet) {
    if (is_full()) add_all(packet);
    const Floats weights = packet.sum.clear * lit_point.base.alpha;
    for_lanes(mask, [&](int lane) {
      put(lane, take_lane<LitPoint<float>>(lit_point, lane), take_lane<LightCone<float>>(to_light, lane),
          weights[lane]);
    });
  }
  GV_HD void put(int lane, const LitPoint<float>& lit_point, const LightCone<float>& to_light, float lane_weight) {
    put_lane(point[points / kLanes], points % kLanes, lit_point);
    weight[points] = lane_weight;
    share[points] = 1;
    ray_lane[points] = lane;
    if (light.receives(lit_point)) {
      cone[cones] = to_light;
      cone_point[cones++] = points;
    }
    ++points;
  }
  // Adds all that wait.
  GV_CALL void add_all(Packet& packet) {
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

 private:
  GV_CALL void trace(Packet& packet) {
    const auto begin_lane = [&](int lane, int64_t number) {
      tracer.begin_cone(lane, cone[number], packet, ray_lane[cone_point[number]]);
      put_lane(tracer.sum, lane, typename Shader::Sum());
      return number;
    };
    const auto end_lane = [&](int lane) {
      const int32_t number = cone_point[tracer.items[lane]];
      share[number] = tracer.sum.clear[lane];
      packet.samples[ray_lane[number]] += tracer.samples[lane];
      packet.sum.missed[ray_lane[number]] |= tracer.sum.missed[lane];
    };
    tracer.follow(0, cones, begin_lane, end_lane);
    cones = 0;
  }
};

}  // namespace gvtorch::GV_NAMESPACE
