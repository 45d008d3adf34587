// kLanes rays at once with a fused shader: the twin of ShadeRay, without shadows. The packets of the shaders are in
// packet_shaders.h. Dtypes are functions chosen once, and what a packet does not do for all lanes at once goes through
// the shader's own `add`, lane by lane.
#pragma once

#include "packet_walk.h"
#include "shade_rays.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class Voxel, bool kFar>
GV_CALL Floats read_packet(const PacketPool& pool, Ints brick, Floats x, Floats y, Floats z) {
  return trilinear<Voxel, kFar>(pool, kFar ? brick : brick * static_cast<int32_t>(pool.stride), {x, y, z});
}

// A channel whose dtype is known at run time. Bricks are told by their numbers.
struct PacketChannel {
  PacketPool pool;
  decltype(&read_packet<float, false>) reader;

  PacketChannel(const ChannelView& channel, int32_t side, int32_t component, int64_t bricks)
      : pool(channel.bricks_bzyxc, channel.type, side, channel.width, component) {
    with_voxel(channel.type, [&](auto voxel) {
      using Voxel = decltype(voxel);
      reader = pool.far(bricks) ? &read_packet<Voxel, true> : &read_packet<Voxel, false>;
    });
  }
  GV_HD Floats read(Ints brick, const Vec3<Floats>& at) const { return reader(pool, brick, at.x, at.y, at.z); }
};

// What Self has, beside `add` and constants as PacketWalk tells: get(lane, sum) and put(lane, sum), which copy what its
// shader's Sum has beyond ShadeSum; or sum_of(lane) and put_sum(lane, sum), where it keeps its lanes' Sums itself.
template <class Self, class Kind>
struct ShadePacket : PacketWalk<Self> {
  using Base = PacketWalk<Self>;
  using Shader = Kind;
  using Sum = typename Shader::Sum;
  using Base::at;
  using Base::coarse;
  using Base::fine;
  using Base::hit_clear;
  using Base::mixed;
  using Base::moved;
  using Base::numbers;
  using Base::self;
  using Base::sum;
  using Base::walk;
  static constexpr bool kEnds = Shader::kEnds, kSeesEmpty = Shader::kSeesEmpty, kKeepsPath = true;

  const ShadeRay<float, Shader>& kernel;
  const Shader& shader;
  const PacketChannel values;
  const PacketTable table;
  Ints rows{};                   // byte offset of the level's table
  Vec3<Floats> from{}, along{};  // the eye's ray in the world
  Vec3<Floats> normal{};

  ShadePacket(const ShadeRay<float, Shader>& kernel, const ShadeArgs& args)
      : Base(kernel, args),
        kernel(kernel),
        shader(kernel.shader),
        values(kernel.channels.value, args.side, args.component, args.bricks),
        table(TransferView<float>(args)) {}

  GV_HD void begin_ray(int lane) {
    const Sight<float> sight(walk.rays, numbers[lane], moved[lane]);
    for (int axis = 0; axis < 3; ++axis) {
      from[axis][lane] = sight.origin[axis];
      along[axis][lane] = sight.direction[axis];
    }
    with_sum(lane, [&](Sum& one) {
      one = Sum();
      one.clear = sum.clear[lane];
      one.hit_clear = hit_clear;
      one.feature_c = features_of(lane);
      for (int32_t c = 0; c < kernel.features; ++c) one.feature_c[c] = 0;
    });
  }
  GV_HD void end_ray(int lane) {
    with_sum(lane, [&](Sum& one) {
      if constexpr (Shader::kSurface) {
        if (one.depth < INFINITY) {
          const Ray<float> ray(walk.rays, numbers[lane]);
          const Intervals<float> at(ray, walk.options.step, this->lengths);
          int32_t wanted = this->wanted[lane];
          kernel.template surface<BitDigits<float>>(ray, sight_of(lane), at, wanted, one);
        }
      }
      kernel.finish(numbers[lane], moved[lane], this->samples[lane], one);
    });
  }
  GV_HD bool hides(int lane, int32_t node) {
    const bool hidden = kernel.hides(shader, node, self().sum_of(lane));
    if (Self::kKeepsPath) store_byte(&this->hidden_tn[node], hidden ? kHidden : kShown);
    return hidden;
  }
  GV_HD Ints first_of(Ints brick) const { return brick; }
  GV_HD Floats read(Ints brick, const Vec3<Floats>& at) const { return values.read(brick, at); }
  GV_HD float constant(int32_t node) const {
    const ChannelView& channel = kernel.channels.value;
    return read_number<float>(channel.constant_tnc, channel.type,
                              static_cast<int64_t>(node) * channel.width + kernel.channels.component);
  }
  GV_HD Mask uniform(Mask which) {
    for_lanes(which, [&](int lane) {
      const Sight<float> sight = sight_of(lane);
      which[lane] = probe_of(lane, sight).uniform() ? -1 : 0;
    });
    return which;
  }
  GV_HD void begin_run(Mask which) { rows = which ? at.level * (table.rows * PacketTable::kBytes) : rows; }

  __attribute__((noinline)) void add_region(int lane, float start, float end) {
    with_probe(lane,
               [&](const Probe<float>& probe, Sum& one) { shader.add(kernel.region(probe, start, end), probe, one); });
  }
  __attribute__((noinline)) int32_t march_node(int lane, const Visit<float>& visit, Intervals<float>& at) {
    int32_t taken = 0;
    with_probe(lane, [&](const Probe<float>& probe, Sum& one) {
      const auto add = [&](const Piece<float>& piece) { shader.add(piece, probe, one); };
      taken = kernel.template march_node<kEnds>(probe, visit, at, one, add);
    });
    return taken;
  }
  // One interval of one lane.
  __attribute__((noinline)) void add_alone(int lane, const PacketPiece& piece, KnownGradient<float>* known = nullptr) {
    Piece<float> one;
    one.start = piece.start[lane];
    one.end = piece.end[lane];
    one.middle = piece.middle[lane];
    one.length = at.length[lane];
    one.level = at.level[lane];
    if constexpr (kEnds) {
      one.front = piece.front[lane];
      one.back = piece.back[lane];
    } else {
      one.value = piece.value[lane];
    }
    with_probe(lane, [&](const Probe<float>& probe, Sum& sum) { shader.add(one, probe, sum); }, known);
  }

  // Lanes whose nodes all have bricks.
  GV_HD Mask stored() const { return fine.stored & (~mixed | coarse.stored); }
  // Twin of Probe::number_at for such lanes.
  GV_HD Floats number_at(const PacketChannel& channel, Mask which, Floats t) const {
    const Floats number = channel.read(fine.brick, fine.at(t));
    if (!any(mixed & which)) return number;
    return mixed ? number + this->weight(t) * (channel.read(coarse.brick, coarse.at(t)) - number) : number;
  }
  // Twin of Probe::gradient.
  GV_HD Vec3<Floats> gradient(Mask which, Floats t) {
    Vec3<Floats> slope = differences(fine, this->fine_depth, t);
    if (!any(mixed & which)) return slope;
    const Vec3<Floats> other = differences(coarse, this->coarse_depth, t);
    const Floats part = this->weight(t);
    for (int axis = 0; axis < 3; ++axis) {
      slope[axis] = mixed ? slope[axis] + part * (other[axis] - slope[axis]) : slope[axis];
    }
    return slope;
  }

  GV_HD bool shades_each_place() const { return kernel.shades_each_place(); }

  // Its Sum has nothing more, unless Self tells.
  GV_HD void get(int, Sum&) const {}
  GV_HD void put(int, const Sum&) {}
  GV_HD Sum sum_of(int lane) const {
    Sum one;
    static_cast<Accumulator<float>&>(one) = sum.at(lane);
    one.normal = {normal.x[lane], normal.y[lane], normal.z[lane]};
    one.hit_clear = hit_clear;
    one.feature_c = features_of(lane);
    static_cast<const Self*>(this)->get(lane, one);
    return one;
  }
  GV_HD void put_sum(int lane, const Sum& one) {
    sum.put(lane, one);
    for (int axis = 0; axis < 3; ++axis) normal[axis][lane] = one.normal[axis];
    self().put(lane, one);
  }

 private:
  GV_HD Vec3<Floats> differences(const PacketBrick& ray, Ints depth, Floats t) const {
    const Vec3<Floats> at = ray.at(t);
    const Floats scale = pick(walk.levels.scale, depth);
    Vec3<Floats> slope;
    for (int axis = 0; axis < 3; ++axis) {
      const auto beside = [&](float by) {
        return values.read(ray.brick,
                           {axis == 0 ? at.x + by : at.x, axis == 1 ? at.y + by : at.y, axis == 2 ? at.z + by : at.z});
      };
      const Floats rise = beside(0.5f) - beside(-0.5f);
      slope[axis] = ray.stored ? rise * (scale / static_cast<float>(walk.rays.place_33[3 + axis])) : Floats{};
    }
    return slope;
  }
  GV_HD Sight<float> sight_of(int lane) const {
    Sight<float> sight({from.x[lane], from.y[lane], from.z[lane]}, {along.x[lane], along.y[lane], along.z[lane]});
    sight.moved = moved[lane];
    return sight;
  }
  GV_HD Spot<float> spot_of(int lane, const PacketBrick& ray, Ints depth) const {
    return {this->node_of(lane, depth),
            ray.stored[lane] ? ray.brick[lane] : kAbsent,
            walk.levels.scale[depth[lane]],
            {ray.offset[0][lane], ray.offset[1][lane], ray.offset[2][lane]},
            {ray.slope[0][lane], ray.slope[1][lane], ray.slope[2][lane]}};
  }
  GV_HD Probe<float> probe_of(int lane, const Sight<float>& sight) const {
    const double* cube = walk.rays.place_33 + 3;
    const Spot<float> one = spot_of(lane, fine, this->fine_depth);
    const bool two = mixed[lane] != 0;
    return {kernel.channels,
            sight,
            one,
            two ? spot_of(lane, coarse, this->coarse_depth) : one,
            two,
            at.near[lane],
            at.growth[lane],
            this->voxel[lane],
            this->blend_scale[lane],
            {static_cast<float>(cube[0]), static_cast<float>(cube[1]), static_cast<float>(cube[2])}};
  }
  GV_HD float* features_of(int lane) const { return kernel.features_rc + numbers[lane] * kernel.features; }
  // body(sum) with a lane's own, which is kept.
  template <class Body>
  GV_HD void with_sum(int lane, const Body& body) {
    auto&& one = self().sum_of(lane);
    body(one);
    self().put_sum(lane, one);
  }
  template <class Body>
  GV_HD void with_probe(int lane, const Body& body, KnownGradient<float>* known = nullptr) {
    const Sight<float> sight = sight_of(lane);
    Probe<float> probe = probe_of(lane, sight);
    probe.known = known;
    with_sum(lane, [&](Sum& one) { body(probe, one); });
  }
};

// Traces a share of the rays with a packet of a shader.
template <class Packet>
void shade_packets(const ShadeArgs& args, int64_t begin, int64_t end) {
  const ShadeRay<float, typename Packet::Shader> kernel(args);
  trace_packets<Packet>(begin, end, kernel, args);
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
