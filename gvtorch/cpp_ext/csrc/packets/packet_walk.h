// Traces kLanes rays at once with any shader of shaders.h, in float32; each lane is in its own node and interval. A
// lane computes what its ray computes alone, so every bit is the same.
//
// This is a second walk next to that of walk.h, for two reasons. Lanes keep the path of their last descent, and the
// next descent continues where it departs from that path; a GPU's threads would keep it in local memory, which takes
// twice as long as to restart from the root. And lanes whose run of intervals has ended wait while the others march on
// together, until too few are left. Rare cases (the cut interval at the far side, the pool's last brick, a request) are
// handled lane by lane, by the functions for a single ray.
#pragma once

#include "packets/deep_lanes.h"
#include "packets/packet_brick.h"
#include "shaders/shade_rays.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Copies one lane out of a struct of all lanes, and back.
template <class One, class All>
GV_HD One take_lane(const All& all, int lane) {
  One one;
  All::each(all, one, [&](const auto& own, auto& out) { out = lane_of(own, lane); });
  return one;
}
template <class All, class One>
GV_HD void put_lane(All& all, int lane, const One& one) {
  All::each(all, one, [&](auto& own, const auto& in) { set_lane(own, lane, in); });
}
// The same for Sums. UserSums, which keeps a Sum for each lane, has overloads, see user_shader.h.
template <class Sum, class Sums>
GV_HD Sum sum_of(const Sums& sums, int lane) {
  return take_lane<Sum>(sums, lane);
}
template <class Sums, class Sum>
GV_HD void put_sum(Sums& sums, int lane, const Sum& one) {
  put_lane(sums, lane, one);
}
// The lanes of `which` in which no value between low and high changes the sum.
template <class Shader, class Sums>
GV_HD Mask hides_of(const Shader& shader, Mask which, Floats low, Floats high, const Sums& sums) {
  return which && shader.hides(low, high, sums);
}

struct PacketChannels {
  const PacketChannel value, normal, other;
};

// The walk of a packet, and the probe (see probe.h) of its lanes that march. Values: TypedValues or AnyValues.
template <class Shader, class Values>
struct PacketWalk {
  using Number = Floats;
  using Kernel = ShadeRay<float, Shader, BitDigits, false, typename Values::Voxel>;
  using Eye = typename Kernel::Eye;
  using Sum = typename Shader::Sum;
  static constexpr bool kEnds = Shader::kEnds;
  static constexpr bool kKeepsPath = Kernel::kHidesAlike;  // else hidden nodes differ from ray to ray

  const Kernel& kernel;
  const Walk<float>& walk;
  const Shader& shader;
  const Values values;
  const PacketChannels channels;
  uint8_t* const hidden_tn;
  const int64_t bricks;
  const float stop_clear;
  const int32_t frame;

  // Rays.
  int64_t numbers[kLanes];
  Ray<Floats> ray;
  Sight<Floats> sight;
  Intervals<Floats> at;
  Mask alive;
  Ints wanted;
  typename Shader::template SumOf<Floats> sum;
  Ints samples;

  // The last descent: the node of each level, negative (bit 31 is set) where it is hidden.
  Vec3<Ints> cell{};
  DeepLanes deep_lanes;  // in place of `cell` where the tree is deep
  Ints path_depth = Ints{} - 1;
  Ints path_node[kMostLevels], path_brick[kMostLevels], path_tile[kMostLevels];

  // The run of intervals that a lane is in.
  Mask marching;  // lanes whose values are read
  Ints left;
  Floats number;
  Extent<Floats> extent;
  Floats voxel, blend_scale;
  Floats back;  // value at the end of the last interval
  Mask mixed;
  PacketBrick fine, coarse;
  Ints fine_depth, coarse_depth;

  PacketWalk(const Kernel& kernel, const ShadeArgs& args)
      : kernel(kernel),
        walk(kernel),
        shader(kernel.shader),
        values(kernel.channels.value, args.side, args.component, args.bricks),
        channels{{kernel.channels.value, args.side, args.bricks},
                 {kernel.channels.normal, args.side, args.bricks},
                 {kernel.channels.other, args.side, args.bricks}},
        hidden_tn(args.hidden_tn),
        bricks(args.bricks),
        stop_clear(kernel.stop_clear),
        frame(*kernel.frame_1),
        deep_lanes(walk.rays, walk.tree, walk.levels) {}

  // Traces the rays at positions begin to end of the order, at most kLanes.
  GV_HD void trace(int64_t begin, int64_t end) {
    load(begin, end);
    while (any(alive)) {
      const Mask waiting = alive & (left == 0);
      if (any(waiting)) go_on(waiting);
      Mask ready = alive & (left > 0);
      const int32_t enough = count(alive) / 2 + 1;
      while (count(ready) >= enough) ready = march(ready);
    }
    for (int lane = 0; lane < kLanes; ++lane) {
      if (numbers[lane] >= 0) end_ray(lane);
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
  GV_HD void numbers_at(const PacketChannel& channel, Components<float> components, int32_t count, Floats t,
                        Floats* out) const {
    numbers_in(channel, components, count, fine, fine_depth, t, out);
    if (!any(mixed & marching)) return;
    Floats other[kMostNumbers];
    numbers_in(channel, components, count, coarse, coarse_depth, t, other);
    for (int32_t i = 0; i < count; ++i) out[i] = between(out[i], other[i], t);
  }
  GV_HD Vec3<Floats> gradient(Floats t) const {
    const Vec3<Floats> slope = differences(fine, fine_depth, t);
    return any(mixed & marching) ? between(slope, differences(coarse, coarse_depth, t), t) : slope;
  }

  GV_HD Floats value_of(const PacketBrick& brick, Floats t) const { return value_in(brick, t); }
  GV_HD Row<Floats> four_of(Mask which, const PacketChannel& channel, int32_t component, const PacketBrick& brick,
                            Floats t) const {
    return channel.four(which, component, brick.brick, brick.at(t));
  }
  GV_HD Floats scale_of(const PacketBrick& brick) const { return pick(walk.levels.scale, depth_of(brick)); }
  GV_HD Vec3<Floats> differences(const PacketBrick& brick, Floats t) const {
    return differences(brick, depth_of(brick), t);
  }
  GV_HD Floats weight(Floats t) const { return clamp((at.cone(t) - voxel) * blend_scale, 0.0f, 1.0f); }

  template <class Some>
  GV_HD Some between(const Some& finer, const Some& coarser, Floats t) const {
    const Floats part = weight(t);
    return combined(finer, coarser, [&](Floats a, Floats b) { return mixed ? a + part * (b - a) : a; });
  }

  GV_HD void narrow(Mask which) { marching = which; }
  // Calls body(lane, probe) with the lane's own probe.
  template <class Body>
  GV_HD void each(Mask which, const Body& body, KnownGradient<float>* known = nullptr) const {
    const double* cube = walk.rays.place_33 + 3;
    for_lanes(which, [&](int lane) {
      const Sight<float> own_sight = take_lane<Sight<float>>(sight, lane);
      const Spot<float> one = spot_of(lane, fine, fine_depth);
      const bool two = mixed[lane] != 0;
      Eye probe(kernel.channels, own_sight, one, two ? spot_of(lane, coarse, coarse_depth) : one, two, at.near[lane],
                at.growth[lane], voxel[lane], blend_scale[lane],
                {static_cast<float>(cube[0]), static_cast<float>(cube[1]), static_cast<float>(cube[2])});
      probe.known = known;
      body(lane, probe);
    });
  }

 private:
  using Visitor = typename Kernel::template Visitor<Shader>;

  GV_HD void load(int64_t begin, int64_t end) {
    alive = Mask{};
    left = wanted = samples = mixed = fine_depth = coarse_depth = Ints{};
    number = voxel = blend_scale = back = Floats{};
    extent = Extent<Floats>{};
    sum = {};
    fine = coarse = PacketBrick{};
    ray = Ray<Floats>{};
    at = Intervals<Floats>{};
    at.step = walk.options.step;
    at.top = kernel.lengths - 1;
    at.length = splat<Floats>(at.step);
    at.shortness = 1.0f / at.length;
    for (int axis = 0; axis < 3; ++axis) ray.inner[axis] = Ray<Floats>::inner_of(walk.rays, axis);
    for (int lane = 0; lane < kLanes; ++lane) {
      numbers[lane] = begin + lane < end ? walk.order(begin + lane) : -1;
      if (numbers[lane] < 0) continue;
      const Ray<float> one(walk.rays, numbers[lane]);
      put_lane(ray, lane, one);
      if (walk.rays.deep) deep_lanes.begin(lane, one);
      put_lane(sight, lane, Sight<float>(walk.rays, numbers[lane], one.moved));
      at.near[lane] = one.cone_near;
      at.growth[lane] = one.cone_growth;
      at.start[lane] = at.base[lane] = one.first;
      at.stop[lane] = one.last;
      float* feature_c = kernel.features_rc + numbers[lane] * kernel.features;
      for (int32_t c = 0; c < kernel.features; ++c) feature_c[c] = 0;
      sum.begin(lane, static_cast<float>(walk.rays.clear(numbers[lane])), kernel.hit_clear, feature_c);
      alive[lane] = -1;
    }
    at.choose_level(alive);
    alive = alive & at.inside() & (sum.clear > stop_clear);
  }

  GV_HD void end_ray(int lane) {
    auto&& one = sum_of<Sum>(sum, lane);
    if constexpr (Shader::kSurface) {
      if (one.depth < INFINITY) {
        const Ray<float> own(walk.rays, numbers[lane]);
        const Sight<float> own_sight = take_lane<Sight<float>>(sight, lane);
        if (walk.rays.deep) {
          kernel.template surface<Digits<float>>(own, own_sight, one);
        } else {
          kernel.template surface<BitDigits>(own, own_sight, one);
        }
      }
    }
    kernel.finish(numbers[lane], ray.moved[lane], samples[lane], one);
  }

  // For lanes whose run has ended: begins the next one in the same node, or visits the next node.
  GV_HD void go_on(Mask waiting) {
    const Mask ran = waiting & (number > at.count);
    at.go(ran, number);
    alive = alive & ~(waiting & ~(at.inside() & (sum.clear > stop_clear)));
    const Mask again = ran & alive & at.stays(extent);
    const Mask next = waiting & alive & ~again;
    if (any(again)) begin_run(again);
    if (any(next)) visit(next);
    alive = alive & ~(waiting & (left == 0) & ~(at.inside() & (sum.clear > stop_clear)));
  }

  // The same as Walk::visit and Walk::find.
  GV_HD void visit(Mask which) {
    const TreeView& tree = walk.tree;
    const Levels<float>& levels = walk.levels;
    const Floats middle = at.middle();
    const Floats cone = at.cone(middle);
    for (;;) {
      const Mask finer = which & (wanted < tree.max_depth) & (pick(levels.voxel, wanted) > cone);
      if (!any(finer)) break;
      wanted = wanted - finer;
    }
    Floats above;
    for (;;) {
      above = pick(levels.voxel, larger(wanted - 1, Ints{}));
      const Mask coarser = which & (wanted > 0) & ~(above > cone);
      if (!any(coarser)) break;
      wanted = wanted + coarser;
    }
    above = wanted > 0 ? above : Floats{} + INFINITY;
    const Floats own = pick(levels.voxel, wanted);
    const Mask reached = own <= cone;
    const Mask blend = reached & (wanted > 0);
    extent.cone_low = which ? (reached ? own : Floats{} - INFINITY) : extent.cone_low;
    extent.cone_high = which ? (reached ? above : own) : extent.cone_high;
    voxel = which ? own : voxel;
    blend_scale = which ? 1.0f / (above - own) : blend_scale;

    Ints reach, node, brick, tile;
    descend(which, middle, reach, node, brick, tile);
    const Mask hides = node < 0;
    const Floats exit = ray.leave([&](int axis, Mask upper) { return face(which, axis, reach, upper); });
    extent.exit = which ? exit : extent.exit;

    // The nodes whose bricks are read.
    Ints fine_level = reach, fine_brick = brick;
    for (;;) {
      const Mask higher = which & (fine_level > 0) & (fine_brick == kAbsent);
      if (!any(higher)) break;
      fine_level = fine_level + higher;
      fine_brick = higher ? own_lane(path_brick, fine_level) : fine_brick;
    }
    Ints coarse_level = fine_level, coarse_brick = fine_brick;
    const Mask two = which & blend;
    if (any(two)) {
      for (;;) {
        const Mask higher = two & (coarse_level > 0) & ((coarse_level >= wanted) | (coarse_brick == kAbsent));
        if (!any(higher)) break;
        coarse_level = coarse_level + higher;
        coarse_brick = higher ? own_lane(path_brick, coarse_level) : coarse_brick;
      }
      const Mask found = two & (coarse_level < wanted) & (coarse_brick != kAbsent);
      coarse_level = found ? coarse_level : fine_level;
      coarse_brick = found ? coarse_brick : fine_brick;
    }
    const Mask clears = hides & ((reach < wanted) | ~blend);
    const Mask empty = Shader::kSeesEmpty ? Mask{} : (fine_brick == kEmpty) & (coarse_brick == kEmpty);
    const Mask nothing = which & (clears | (fine_brick == kAbsent) | empty);

    const Mask seen = which & ~clears;
    const Mask lacks =
        seen & ((brick == kAbsent) | ((reach < wanted) & (tile == kAbsent)) |
                (blend & (reach == wanted) & (own_lane(path_brick, larger(reach - 1, Ints{})) == kAbsent)));
    if (any(lacks)) {
      sum.missed = sum.missed | lacks;
      for_lanes(lacks, [&](int lane) {
        Place place;
        place.depth = reach[lane];
        place.node = node[lane] & INT32_MAX;
        place.parent = reach[lane] > 0 ? path_node[reach[lane] - 1][lane] & INT32_MAX : -1;
        place.brick = brick[lane];
        place.tile = tile[lane];
        if (fine_brick[lane] != kAbsent) place.fine.node = path_node[fine_level[lane]][lane] & INT32_MAX;
        walk.mark_missing(place, wanted[lane], blend[lane] != 0, cone[lane]);
      });
    }
    stamp(walk.stamp_b, seen & (fine_brick >= 0), fine_brick);
    stamp(walk.stamp_b, seen & (coarse_brick >= 0), coarse_brick);

    Mask runs = which & ~nothing;
    if (any(runs)) {
      const Mask differ = coarse_level != fine_level;
      mixed = runs ? differ : mixed;
      fine_depth = runs ? fine_level : fine_depth;
      coarse_depth = runs ? coarse_level : coarse_depth;
      aim(runs, fine_level, fine_brick, fine);
      const Mask both = runs & differ;
      if (any(both)) aim(both, coarse_level, coarse_brick, coarse);
      Mask flat = runs & ~fine.stored & (~differ | ~coarse.stored);
      if (kernel.shades_each_place()) flat = Mask{};
      each(flat & differ, [&](int lane, const Probe<float>& probe) { set_lane(flat, lane, probe.uniform()); });
      runs = runs & ~flat;
      if (any(runs)) begin_run(runs);
      if (any(flat)) add_region(flat);
    }
    leave(nothing);
  }

  // The same as `descend` in tree.h, level by level for all lanes; those whose path is known to a deeper level wait.
  GV_HD void descend(Mask which, Floats middle, Ints& reach, Ints& node, Ints& brick, Ints& tile) {
    const TreeView& tree = walk.tree;
    const Ints known = go(which, middle, kKeepsPath ? smaller(path_depth, wanted) : Ints{} - 1);
    const Ints from = larger(known, Ints{});
    node = own_lane(path_node, from);
    brick = own_lane(path_brick, from);
    tile = own_lane(path_tile, from);
    reach = known;
    Mask going = which & ((known < 0) | ~((known == wanted) | (tile < 0) | (node < 0)));
    int32_t level = kMostLevels;
    for_lanes(going, [&](int lane) { level = smaller(level, known[lane] + 1); });
    for (; any(going); ++level) {
      const Mask here = going & (reach == level - 1);
      Ints next = Ints{} + tree.root, home = Ints{} + tree.root_tile;
      if (level > 0) {
        home = here ? tile : Ints{};
        next = home * tree.nodes_per_tile + child(here, level);
      }
      next = here ? next : Ints{};
      stamp(tree.stamp_t, here, home);
      const Ints brick_word = pick(tree.brick_tn, next), tile_word = pick(tree.child_tn, next);
      const Ints next_brick = brick_word < tree.bricks ? brick_word : Ints{} + kAbsent;  // as TreeView::within
      const Ints next_tile = tile_word < tree.tiles ? tile_word : Ints{} + kAbsent;
      const Mask hides = hidden(here, next);
      node = here ? next | (hides & INT32_MIN) : node;
      brick = here ? next_brick : brick;
      tile = here ? next_tile : tile;
      path_node[level] = here ? node : path_node[level];
      path_brick[level] = here ? brick : path_brick[level];
      path_tile[level] = here ? tile : path_tile[level];
      reach = reach - here;
      going = going & ~(here & ((level == wanted) | (tile < 0) | hides));
    }
    path_depth = which ? reach : path_depth;
  }

  // `go` moves lanes to their positions at distance t; it returns the deepest level, at most `known`, at which a lane
  // is in the same node as before. `child` and `face` are those of Digits and BitDigits: which child of the node above
  // a lane is in, and the offset of a face of its node from its ray's origin.
  GV_HD Ints go(Mask which, Floats t, Ints known) {
    if (walk.rays.deep) return deep_lanes.go(which, ray.direction, t, known);
    const TreeView& tree = walk.tree;
    const int32_t top = tree.digit_bits * tree.max_depth;
    const float cells = static_cast<float>(1 << top);
    Ints parted{};
    const Vec3<Floats> place = ray.at(t);
    for (int axis = 0; axis < 3; ++axis) {
      const Ints here = which ? truncated(place[axis] * cells) : cell[axis];
      parted = parted | (cell[axis] ^ here);
      cell[axis] = here;
    }
    // A float's exponent gives the highest bit set. Rounding up to a power of two may make the result one level less.
    const Ints high = ((Ints)to_floats(parted) >> 23) - 126;
    const Ints equal = truncated(to_floats(top - high) / static_cast<float>(tree.digit_bits));
    return parted == 0 ? known : smaller(known, equal);
  }
  GV_HD Ints child(Mask which, int32_t level) const {
    if (walk.rays.deep) return deep_lanes.child(which, level);
    const int32_t bits = walk.tree.digit_bits, mask = (1 << bits) - 1;
    const int32_t shift = bits * (walk.tree.max_depth - level);
    const Ints x = (cell.x >> shift) & mask, y = (cell.y >> shift) & mask, z = (cell.z >> shift) & mask;
    return (z << (2 * bits)) | (y << bits) | x;
  }
  GV_HD Floats face(Mask which, int axis, Ints level, Mask upper) const {
    if (walk.rays.deep) return deep_lanes.face(which, axis, level, upper);
    const Ints shift = walk.tree.digit_bits * (walk.tree.max_depth - level);
    return to_floats((cell[axis] >> shift) - upper) * pick(walk.levels.size, level) - ray.origin[axis];
  }

  GV_HD Mask hidden(Mask here, Ints node) {
    if constexpr (!kKeepsPath) {
      Floats low{}, high{};
      for_lanes(here, [&](int lane) {
        const auto range = kernel.range_of(node[lane]);
        low[lane] = range.low;
        high[lane] = range.high;
      });
      return hides_of(shader, here, low, high, sum);
    }
    const Ints known = gather(hidden_tn, node) & 0xff;
    Mask hides = here & (known == kHidden);
    for_lanes(here & (known == kUnknown), [&](int lane) { set_lane(hides, lane, kernel.hides(node[lane])); });
    return hides;
  }

  GV_HD void stamp(int32_t* stamps, Mask which, Ints index) const {
    if (!any(which)) return;
    const Mask old = which & (pick_shared(stamps, which ? index : Ints{}) != frame);
    for_lanes(old, [&](int lane) { store_stamp(&stamps[index[lane]], frame); });
  }

  // Each lane's entry at its own level.
  GV_HD static Ints own_lane(const Ints* path, Ints level) {
    return pick(reinterpret_cast<const int32_t*>(path), level * kLanes + lane_numbers());
  }

  GV_HD void leave(Mask which) {
    at.leave(which, extent);
    number = which ? at.count : number;
  }

  GV_HD void aim(Mask which, Ints holder_depth, Ints brick, PacketBrick& to) {
    const Mask stored = brick >= 0;
    const Floats scale = pick(walk.levels.scale, holder_depth);
    const float first = static_cast<float>(kernel.channels.border) - 0.5f;
    for (int axis = 0; axis < 3; ++axis) {
      const Floats offset = -face(which, axis, holder_depth, Mask{}) * scale + first;
      const Floats slope = ray.direction[axis] * scale;
      to.offset[axis] = which ? (stored ? offset : Floats{}) : to.offset[axis];
      to.slope[axis] = which ? (stored ? slope : Floats{}) : to.slope[axis];
    }
    to.stored = which ? stored : to.stored;
    to.brick = which ? (stored ? values.first_of(brick) : Ints{}) : to.brick;
    for_lanes(which & ~stored, [&](int lane) { to.constant[lane] = constant_of(lane, holder_depth); });
  }
  GV_HD float constant_of(int lane, Ints depth) const {
    return channels.value.constant<float>(node_of(lane, depth), kernel.channels.component);
  }
  GV_HD Ints depth_of(const PacketBrick& brick) const { return &brick == &fine ? fine_depth : coarse_depth; }
  GV_HD int32_t node_of(int lane, Ints depth) const { return path_node[depth[lane]][lane] & INT32_MAX; }

  // Begins a run of alike intervals; lanes that need care march alone to the end of the visit at once.
  GV_HD void begin_run(Mask which) {
    const Ints last = values.first_of(Ints{} + static_cast<int32_t>(bricks - 1));
    const Mask end = (fine.stored & (fine.brick == last)) | (mixed & coarse.stored & (coarse.brick == last));
    const Mask careful = which & (at.cut() | end);
    if (any(careful)) {
      march_alone(careful);
      fine.brick = careful ? Ints{} : fine.brick;  // reads that lanes ignore must stay in the pool too
      coarse.brick = careful ? Ints{} : coarse.brick;
      which = which & ~careful;
    }
    left = which ? at.run(which, extent) : left;
    number = which ? at.count : number;
    if constexpr (kEnds) {
      marching = which;
      if (any(which)) back = which ? value(at.start) : back;
    }
  }

  // Adds a region of one value as one interval.
  GV_HD void add_region(Mask which) {
    Piece<Floats> piece;
    piece.odd = true;
    piece.start = at.start;
    leave(which);
    piece.end = smaller(at.start, at.stop);
    piece.length = piece.end - piece.start;
    piece.middle = piece.start + piece.length * 0.5f;
    piece.value = piece.front = piece.back = fine.constant;
    samples = samples - which;
    marching = which;
    shader.add(which, piece, *this, sum);
  }

  // Takes one interval in all lanes that march; returns those whose run goes on. So that the next sample never waits
  // for this one's colour, a lane whose ray has ended marches on without effect to the end of its run.
  GV_HD Mask march(Mask which) {
    marching = which;
    Piece<Floats> piece;
    piece.middle = at.middle_of(number);
    piece.start = at.start_of(number);
    piece.end = at.start_of(number + 1.0f);
    piece.length = at.length;
    piece.level = at.level;
    number = number - to_floats(which);
    left = left + which;
    if constexpr (kEnds) {
      piece.front = back;
      piece.back = back = value(piece.end);
    } else if constexpr (!Shader::kReadsAll) {
      piece.value = value(piece.middle);
    }
    const Mask seeing = which & (sum.clear > stop_clear);
    samples = samples - seeing;
    shader.add(seeing, piece, *this, sum);
    return which & (left > 0);
  }

  __attribute__((noinline)) void march_alone(Mask which) {
    each(which, [&](int lane, const Eye& probe) {
      auto one = take_lane<Intervals<float>>(at, lane);
      const Extent<float> own{extent.exit[lane], extent.cone_low[lane], extent.cone_high[lane]};
      auto&& own_sum = sum_of<Sum>(sum, lane);
      Visitor visitor{kernel, shader, nullptr, nullptr, own_sum};
      kernel.march(own, one, visitor, probe);
      put_sum(sum, lane, own_sum);
      put_lane(at, lane, one);
      samples[lane] += visitor.samples;
      number[lane] = one.count;
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
  GV_HD Spot<float> spot_of(int lane, const PacketBrick& brick, Ints depth) const {
    return {node_of(lane, depth), brick.stored[lane] ? path_brick[depth[lane]][lane] : kAbsent,
            walk.levels.scale[depth[lane]], lane_of(brick.offset, lane), lane_of(brick.slope, lane)};
  }
};

// Traces the rays at positions begin to end of the order.
template <class Shader, class Values>
void trace_packets(const ShadeArgs& args, int64_t begin, int64_t end) {
  const typename PacketWalk<Shader, Values>::Kernel kernel(args);
  PacketWalk<Shader, Values> packet(kernel, args);
  for (int64_t index = begin; index < end; index += kLanes) packet.trace(index, smaller(index + kLanes, end));
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
