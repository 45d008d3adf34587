// Traces kLanes rays at once with any shader of shaders.h, in float32; each lane is in its own node and interval. A
// lane computes what its ray computes alone, so every bit is the same.
//
// This and packet_path.h are a second walk next to that of walk.h, for two reasons. Lanes keep the path of their last
// descent, and the next descent continues where it departs from that path; a GPU's threads would keep it in local
// memory, which takes twice as long as to restart from the root. And lanes whose run of intervals has ended wait while
// the others march on together, until too few are left. Rare cases (the cut interval at the far side, a brick that
// packets don't read, a request) are handled lane by lane, by the functions for a single ray.
#pragma once

#include "packets/packet_path.h"
#include "shaders/shade_rays.h"

namespace gvtorch::GV_NAMESPACE {

// A lane's Sum of those of all lanes; put_lane puts it back. UserSums, which keeps a Sum for each lane, has overloads
// of both, see user_shader.h.
template <class Sum, class Sums>
GV_HD Sum sum_of(const Sums& sums, int lane) {
  return take_lane<Sum>(sums, lane);
}
// The lanes of `mask` in which no value between low and high changes the sum.
template <class Shader, class Sums>
GV_HD Mask hides_of(const Shader& shader, Mask mask, Floats low, Floats high, const Sums& sums) {
  return mask && shader.hides(low, high, sums);
}

struct PacketChannels {
  const PacketChannel value, normal, other;
};

// See packet_shadows.h.
template <class Kernel, class Values>
struct PacketShadows;
struct NoShadows {
  template <class... Arguments>
  explicit NoShadows(const Arguments&...) {}
};

// The walk of a packet, and the probe (see probe.h) of its lanes that march. Kernel: the ShadeRay that traces one ray
// alone. Shader: the kernel's, or its ShadowShader for cones to the light. Values: TypedValues or AnyValues.
template <class Kernel, class Values, class Shader = typename Kernel::Shader>
struct PacketWalk : PacketPath {
  using Number = Floats;
  using RayProbe = typename Kernel::RayProbe;
  using Sum = typename Shader::Sum;
  static constexpr bool kEnds = Shader::kEnds, kShadowed = Kernel::kShadows && !Shader::kToLight;

  const Kernel& kernel;
  const Shader& shader;
  const Values values;
  const PacketChannels channels;
  const int64_t packet_bricks;
  const float stop_clear;

  int64_t items[kLanes];  // of the rays, or of the cones to the light, in the lanes; -1: none
  Mask alive{};
  typename Shader::template SumOf<Floats> sum;
  Ints samples{};

  // The run of intervals that a lane is in.
  Mask marching{};  // lanes whose values are read
  Ints remaining{};
  Floats last_value{};  // value at the end of the last interval

  std::conditional_t<kShadowed, PacketShadows<Kernel, Values>, NoShadows> shadows;

  PacketWalk(const Kernel& kernel, const Shader& shader, const Values& values, const ShadeArgs& args, float stop_clear)
      : PacketPath(kernel, kernel.channels, Kernel::kHidesAlike ? args.hidden_tn : nullptr, values.slot_bytes(),
                   kernel.lengths),
        kernel(kernel),
        shader(shader),
        values(values),
        channels{{kernel.channels.value, args.side, args.bricks},
                 {kernel.channels.normal, args.side, args.bricks},
                 {kernel.channels.other, args.side, args.bricks}},
        packet_bricks(args.packet_bricks),
        stop_clear(stop_clear),
        shadows(kernel, values, args) {}

  // Traces the rays at positions begin to end of the order.
  GV_HD void trace(int64_t begin, int64_t end) {
    const auto begin_lane = [&](int lane, int64_t position) {
      const int64_t ray_number = walk.order(position);
      if (ray_number < 0) return ray_number;
      begin_ray(lane, ray_number);
      put_lane(sum, lane, kernel.first_sum(ray_number));
      return ray_number;
    };
    follow(begin, end, begin_lane, [&](int lane) { end_ray(lane); });
  }

  // Follows items, numbers `next` to end - 1, to their ends, kLanes at a time. begin_lane(lane, item) begins an item in
  // a lane and returns what `items` is to hold there: -1 where there is nothing to follow, and the lane takes the
  // next item. end_lane(lane) is called for all others at the end.
  template <class Begin, class End>
  GV_HD void follow(int64_t next, int64_t end, const Begin& begin_lane, const End& end_lane) {
    while (next < end) {
      for (int lane = 0; lane < kLanes; ++lane) {
        items[lane] = -1;
        while (items[lane] < 0 && next < end) items[lane] = begin_lane(lane, next++);
        set_lane(alive, lane, items[lane] >= 0);
      }
      alive = alive & intervals.inside() & (sum.clear > stop_clear);
      remaining = samples = Ints{};
      last_value = Floats{};
      while (any(alive)) {
        const Mask waiting = alive & (remaining == 0);
        if (any(waiting)) advance(waiting);
        Mask ready = alive & (remaining > 0);
        const int32_t enough = count(alive) / 2 + 1;
        while (count(ready) >= enough) ready = march(ready);
      }
      if constexpr (kShadowed) shadows.add_all(*this);
      for (int lane = 0; lane < kLanes; ++lane) {
        if (items[lane] >= 0) end_lane(lane);
      }
    }
  }

  // The functions of Probe, for all lanes that march.
  GV_HD Floats value(Floats t) const {
    const Floats value = value_in(fine, t);
    return any(mixed & marching) ? between(value, value_in(coarse, t), t) : value;
  }
  GV_HD Floats number_at(const PacketChannel& channel, int32_t component, Floats t) const {
    const Floats number = number_in(channel, component, fine, fine_depth, t);
    return any(mixed & marching) ? between(number, number_in(channel, component, coarse, coarse_depth, t), t) : number;
  }
  GV_HD Row<Floats> four_at(Mask mask, const PacketChannel& channel, int32_t first, Floats t) const {
    const Row<Floats> row = four_in(mask, channel, first, fine, fine_depth, t);
    const Mask blended = mixed & mask;
    return any(blended) ? between(row, four_in(blended, channel, first, coarse, coarse_depth, t), t) : row;
  }
  GV_HD void numbers_at(const PacketChannel& channel, Components<float> components, int32_t count, Floats t,
                        Floats* out) const {
    numbers_in(channel, components, count, fine, fine_depth, t, out);
    if (!any(mixed & marching)) return;
    Floats coarse_numbers[kMaxNumbers];
    numbers_in(channel, components, count, coarse, coarse_depth, t, coarse_numbers);
    for (int32_t i = 0; i < count; ++i) out[i] = between(out[i], coarse_numbers[i], t);
  }
  GV_HD Vec3<Floats> gradient(Floats t) const {
    const Vec3<Floats> slope = differences(fine, fine_depth, t);
    return any(mixed & marching) ? between(slope, differences(coarse, coarse_depth, t), t) : slope;
  }

  GV_HD Floats value_of(const PacketBrick& brick, Floats t) const { return value_in(brick, t); }
  GV_HD Row<Floats> four_of(Mask mask, const PacketChannel& channel, int32_t component, const PacketBrick& brick,
                            Floats t) const {
    return channel.four(mask, component, brick.brick, brick.at(t));
  }
  GV_HD Floats scale_of(const PacketBrick& brick) const { return pick(walk.levels.scale, depth_of(brick)); }
  GV_HD Vec3<Floats> differences(const PacketBrick& brick, Floats t) const {
    return differences(brick, depth_of(brick), t);
  }
  GV_HD Floats weight(Floats t) const { return saturate((intervals.cone(t) - voxel) * blend_scale); }

  template <class Numbers>
  GV_HD Numbers between(const Numbers& finer, const Numbers& coarser, Floats t) const {
    const Floats coarse_weight = weight(t);
    return combined(finer, coarser, [&](Floats a, Floats b) { return mixed ? a + coarse_weight * (b - a) : a; });
  }

  GV_HD void select_lanes(Mask mask) { marching = mask; }
  // Calls body(lane, probe) with the lane's own probe.
  template <class Body>
  GV_HD void each_lane(Mask mask, const Body& body, PrefetchedGradient<float>* prefetched = nullptr) const {
    const double* cube = walk.rays.place_33 + 3;
    for_lanes(mask, [&](int lane) {
      const Sight<float> lane_sight = take_lane<Sight<float>>(sight, lane);
      const Spot<float> fine_spot = spot_of(lane, fine, fine_depth);
      const bool two_nodes = mixed[lane] != 0;
      RayProbe probe(kernel.channels, lane_sight, fine_spot,
                     two_nodes ? spot_of(lane, coarse, coarse_depth) : fine_spot, two_nodes, intervals.cone_near[lane],
                     intervals.cone_growth[lane], voxel[lane], blend_scale[lane],
                     {static_cast<float>(cube[0]), static_cast<float>(cube[1]), static_cast<float>(cube[2])});
      probe.prefetched = prefetched;
      body(lane, probe);
    });
  }

 private:
  GV_HD void end_ray(int lane) {
    auto&& lane_sum = sum_of<Sum>(sum, lane);
    if constexpr (Shader::kSurface) {
      if (lane_sum.depth < INFINITY) {
        const Ray<float> lane_ray(walk.rays, items[lane]);
        const Sight<float> lane_sight = take_lane<Sight<float>>(sight, lane);
        if (walk.rays.deep) {
          kernel.template surface<Digits<float>>(lane_ray, lane_sight, lane_sum);
        } else {
          kernel.template surface<BitDigits>(lane_ray, lane_sight, lane_sum);
        }
      }
    }
    kernel.finish(items[lane], ray.moved[lane], samples[lane], lane_sum);
  }

  // For lanes whose run has ended: begins the next one in the same node, or visits the next node.
  GV_HD void advance(Mask waiting) {
    const Mask finished = waiting & (number > intervals.count);
    intervals.move_to(finished, number);
    alive = alive & ~(waiting & ~(intervals.inside() & (sum.clear > stop_clear)));
    const Mask same_node = finished & alive & intervals.stays(extent);
    const Mask visits = waiting & alive & ~same_node;
    if (any(same_node)) begin_run(same_node);
    if (any(visits)) visit(visits);
    alive = alive & ~(waiting & (remaining == 0) & ~(intervals.inside() & (sum.clear > stop_clear)));
  }

  // The same as Walk::visit.
  GV_HD void visit(Mask mask) {
    const Found found = find_nodes(mask);
    sum.missed = sum.missed | found.lacking;
    if (any(found.shown)) {
      Mask flat = kernel.template shades_each_position<Shader>() ? Mask{} : found.uniform;
      each_lane(flat & mixed, [&](int lane, const Probe<float>& probe) { set_lane(flat, lane, probe.uniform()); });
      const Mask runs = found.shown & ~flat;
      if (any(runs)) begin_run(runs);
      if (any(flat)) add_region(flat);
    }
    leave(found.nothing);
  }
  GV_CALL Found find_nodes(Mask mask) {  // inlined, it makes the march of a projection a seventh slower
    if constexpr (Kernel::kHidesAlike) {
      return find(mask, Shader::kSeesEmpty);
    } else {
      return find(mask, Shader::kSeesEmpty, [&](Mask active, Ints node) {
        Floats low{}, high{};
        for_lanes(active, [&](int lane) {
          const auto range = kernel.range_of(node[lane]);
          low[lane] = range.low;
          high[lane] = range.high;
        });
        return hides_of(shader, active, low, high, sum);
      });
    }
  }
  bool hides(int32_t node) const final { return kernel.hides(node); }

  // Begins a run of alike intervals; lanes that need care march alone to the end of the visit at once.
  GV_HD void begin_run(Mask mask) {
    const Ints end = first_of(Ints{} + static_cast<int32_t>(packet_bricks));
    const Mask beyond = (fine.stored & (fine.brick >= end)) | (mixed & coarse.stored & (coarse.brick >= end));
    const Mask marches_alone = mask & (intervals.cut() | beyond);
    if (any(marches_alone)) {
      march_alone(marches_alone);
      fine.forget(marches_alone);  // reads that lanes ignore must stay in the pool too
      coarse.forget(marches_alone);
      mask = mask & ~marches_alone;
    }
    remaining = mask ? intervals.run(mask, extent) : remaining;
    number = mask ? intervals.count : number;
    if constexpr (kEnds) {
      marching = mask;
      if (any(mask)) last_value = mask ? value(intervals.start) : last_value;
    }
  }

  // Adds a region of one value as one interval.
  GV_HD void add_region(Mask mask) {
    Interval<Floats> interval;
    interval.start = intervals.start;
    leave(mask);
    interval.end = smaller(intervals.start, intervals.stop);
    interval.set_odd();
    interval.value = interval.front = interval.back = fine.constant;
    samples = samples - mask;
    marching = mask;
    add(mask, interval);
  }

  // Takes one interval in all lanes that march; returns those whose run goes on. So that the next sample never waits
  // for this one's colour, a lane whose ray has ended marches on without effect to the end of its run.
  GV_HD Mask march(Mask mask) {
    marching = mask;
    Interval<Floats> interval;
    interval.middle = intervals.middle_of(number);
    interval.start = intervals.start_of(number);
    interval.end = intervals.start_of(number + 1.0f);
    interval.length = intervals.length;
    interval.level = intervals.level;
    number = number - to_floats(mask);
    remaining = remaining + mask;
    if constexpr (kEnds) {
      interval.front = last_value;
      interval.back = last_value = value(interval.end);
    } else if constexpr (!Shader::kReadsAll) {
      interval.value = value(interval.middle);
    }
    const Mask seeing = mask & (sum.clear > stop_clear);
    samples = samples - seeing;
    add(seeing, interval);
    return mask & (remaining > 0);
  }

  GV_HD void add(Mask mask, const Interval<Floats>& interval) {
    if constexpr (kShadowed) {
      const auto add_lit = [&](Mask shown, const LitPoint<Floats>& point, const LightCone<Floats>& cone) {
        shadows.put(shown, point, cone, *this);
        sum.absorb(point.base.alpha, interval, shown);
      };
      shader.add(mask, interval, *this, sum, add_lit);
    } else {
      shader.add(mask, interval, *this, sum);
    }
  }

  GV_CALL void march_alone(Mask mask) {
    each_lane(mask, [&](int lane, const RayProbe& probe) {
      auto lane_intervals = take_lane<Intervals<float>>(intervals, lane);
      const Extent<float> lane_extent{extent.exit[lane], extent.cone_low[lane], extent.cone_high[lane]};
      auto&& lane_sum = sum_of<Sum>(sum, lane);
      const auto add_lit = [&](const Interval<float>& interval, const LitPoint<float>& point,
                               const LightCone<float>& cone, int32_t&) {
        if constexpr (kShadowed) {
          if (shadows.is_full()) {  // adding changes this lane's sum too
            put_lane(sum, lane, lane_sum);
            shadows.add_all(*this);
            lane_sum = sum_of<Sum>(sum, lane);
          }
          shadows.put(lane, point, cone, lane_sum.clear * point.base.alpha);
          lane_sum.absorb(point.base.alpha, interval);
        }
      };
      typename Kernel::template Visitor<Shader, std::decay_t<decltype(add_lit)>> visitor{kernel,   shader,     nullptr,
                                                                                         lane_sum, stop_clear, add_lit};
      kernel.march(lane_extent, lane_intervals, visitor, probe);
      put_lane(sum, lane, lane_sum);
      put_lane(intervals, lane, lane_intervals);
      samples[lane] += visitor.samples;
      number[lane] = lane_intervals.count;
    });
  }

  GV_HD Floats value_in(const PacketBrick& brick, Floats t) const {
    const Floats value = values.read(brick.brick, brick.at(t));
    return brick.stored ? value : brick.constant;
  }
  GV_HD Floats number_in(const PacketChannel& channel, int32_t component, const PacketBrick& brick, Ints depth,
                         Floats t) const {
    Floats number = channel.read(component, brick.brick, brick.at(t));
    for_lanes(marching & ~brick.stored,
              [&](int lane) { number[lane] = channel.constant<float>(node_of(lane, depth), component); });
    return number;
  }
  GV_HD Row<Floats> four_in(Mask mask, const PacketChannel& channel, int32_t first, const PacketBrick& brick,
                            Ints depth, Floats t) const {
    Row<Floats> row = four_of(mask & brick.stored, channel, first, brick, t);
    for_lanes(mask & ~brick.stored, [&](int lane) {
      const auto constant = [&](int32_t number) {
        return channel.constant<float>(node_of(lane, depth), first + number);
      };
      put_lane(row, lane, Row<float>{constant(0), constant(1), constant(2), constant(3)});
    });
    return row;
  }
  GV_HD void numbers_in(const PacketChannel& channel, Components<float> components, int32_t count,
                        const PacketBrick& brick, Ints depth, Floats t, Floats* out) const {
    channel.numbers(components, count, brick.brick, brick.at(t), out);
    for_lanes(marching & ~brick.stored, [&](int lane) {
      for (int32_t i = 0; i < count; ++i) out[i][lane] = channel.constant<float>(node_of(lane, depth), components[i]);
    });
  }
  GV_HD Vec3<Floats> differences(const PacketBrick& brick, Ints depth, Floats t) const {
    const Floats scale = pick(walk.levels.scale, depth);
    Vec3<Floats> slope = values.rise(brick.brick, brick.at(t));
    for (int axis = 0; axis < 3; ++axis) {
      const Floats per_unit = scale / static_cast<float>(walk.rays.place_33[3 + axis]);
      slope[axis] = brick.stored ? slope[axis] * per_unit : Floats{};
    }
    return slope;
  }
};

// Traces the rays at positions begin to end of the order.
template <class Shader, class Values, bool kShadows = false>
void trace_packets(const ShadeArgs& args, int64_t begin, int64_t end) {
  using Kernel = ShadeRay<float, Shader, BitDigits, kShadows, typename Values::Voxel>;
  const Kernel kernel(args);
  const Values values(kernel.channels.value, args.side, args.component, args.bricks);
  PacketWalk<Kernel, Values> packet(kernel, kernel.shader, values, args, kernel.stop_clear);
  packet.trace(begin, end);
}

}  // namespace gvtorch::GV_NAMESPACE
