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

namespace gvtorch::GV_NAMESPACE {

// A lane's Sum of those of all lanes, and back. UserSums, which keeps a Sum for each lane, has overloads, see
// user_shader.h.
template <class Sum, class Sums>
GV_HD Sum sum_of(const Sums& sums, int lane) {
  return take_lane<Sum>(sums, lane);
}
template <class Sums, class Sum>
GV_HD void put_sum(Sums& sums, int lane, const Sum& lane_sum) {
  put_lane(sums, lane, lane_sum);
}
// The lanes of `mask` in which no value between low and high changes the sum.
template <class Shader, class Sums>
GV_HD Mask hides_of(const Shader& shader, Mask mask, Floats low, Floats high, const Sums& sums) {
  return mask && shader.hides(low, high, sums);
}

struct PacketChannels {
  const PacketChannel value, normal, other;
};

// The walk of a packet, and the probe (see probe.h) of its lanes that march. Values: TypedValues or AnyValues.
template <class Shader, class Values>
struct PacketWalk {
  using Number = Floats;
  using Kernel = ShadeRay<float, Shader, BitDigits, false, typename Values::Voxel>;
  using RayProbe = typename Kernel::RayProbe;
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
  Intervals<Floats> intervals;
  Mask alive;
  Ints wanted;
  typename Shader::template SumOf<Floats> sum;
  Ints samples;

  // The last descent: the node of each level, negative (bit 31 is set) where it is hidden.
  Vec3<Ints> cell{};
  DeepLanes deep_lanes;  // in place of `cell` where the tree is deep
  Ints path_depth = Ints{} - 1;
  Ints path_node[kMaxLevels], path_brick[kMaxLevels], path_tile[kMaxLevels];

  // The run of intervals that a lane is in.
  Mask marching;  // lanes whose values are read
  Ints remaining;
  Floats number;
  Extent<Floats> extent;
  Floats voxel, blend_scale;
  Floats last_value;  // value at the end of the last interval
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
      const Mask waiting = alive & (remaining == 0);
      if (any(waiting)) advance(waiting);
      Mask ready = alive & (remaining > 0);
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
  using Visitor = typename Kernel::template Visitor<Shader>;

  GV_HD void load(int64_t begin, int64_t end) {
    alive = Mask{};
    remaining = wanted = samples = mixed = fine_depth = coarse_depth = Ints{};
    number = voxel = blend_scale = last_value = Floats{};
    extent = Extent<Floats>{};
    sum = {};
    fine = coarse = PacketBrick{};
    ray = Ray<Floats>{};
    intervals = Intervals<Floats>{};
    intervals.step = walk.step;
    intervals.top = kernel.lengths - 1;
    intervals.length = broadcast<Floats>(intervals.step);
    intervals.inverse_length = 1.0f / intervals.length;
    for (int axis = 0; axis < 3; ++axis) ray.upper_bound[axis] = Ray<Floats>::upper_bound_of(walk.rays, axis);
    for (int lane = 0; lane < kLanes; ++lane) {
      numbers[lane] = begin + lane < end ? walk.order(begin + lane) : -1;
      if (numbers[lane] < 0) continue;
      const Ray<float> lane_ray(walk.rays, numbers[lane]);
      put_lane(ray, lane, lane_ray);
      if (walk.rays.deep) deep_lanes.begin(lane, lane_ray);
      put_lane(sight, lane, Sight<float>(walk.rays, numbers[lane], lane_ray.moved));
      intervals.cone_near[lane] = lane_ray.cone_near;
      intervals.cone_growth[lane] = lane_ray.cone_growth;
      intervals.start[lane] = intervals.base[lane] = lane_ray.first;
      intervals.stop[lane] = lane_ray.last;
      float* feature_c = kernel.features_rc + numbers[lane] * kernel.features;
      for (int32_t c = 0; c < kernel.features; ++c) feature_c[c] = 0;
      sum.begin(lane, static_cast<float>(walk.rays.clear(numbers[lane])), kernel.hit_clear, feature_c);
      alive[lane] = -1;
    }
    intervals.choose_level(alive);
    alive = alive & intervals.inside() & (sum.clear > stop_clear);
  }

  GV_HD void end_ray(int lane) {
    auto&& lane_sum = sum_of<Sum>(sum, lane);
    if constexpr (Shader::kSurface) {
      if (lane_sum.depth < INFINITY) {
        const Ray<float> lane_ray(walk.rays, numbers[lane]);
        const Sight<float> lane_sight = take_lane<Sight<float>>(sight, lane);
        if (walk.rays.deep) {
          kernel.template surface<Digits<float>>(lane_ray, lane_sight, lane_sum);
        } else {
          kernel.template surface<BitDigits>(lane_ray, lane_sight, lane_sum);
        }
      }
    }
    kernel.finish(numbers[lane], ray.moved[lane], samples[lane], lane_sum);
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

  // The same as Walk::visit and Walk::find.
  GV_HD void visit(Mask mask) {
    const TreeView& tree = walk.tree;
    const Levels<float>& levels = walk.levels;
    const Floats middle = intervals.middle();
    const Floats cone = intervals.cone(middle);
    for (;;) {
      const Mask finer = mask & (wanted < tree.max_depth) & (pick(levels.voxel, wanted) > cone);
      if (!any(finer)) break;
      wanted = wanted - finer;
    }
    Floats voxel_above;
    for (;;) {
      voxel_above = pick(levels.voxel, larger(wanted - 1, Ints{}));
      const Mask coarser = mask & (wanted > 0) & ~(voxel_above > cone);
      if (!any(coarser)) break;
      wanted = wanted + coarser;
    }
    voxel_above = wanted > 0 ? voxel_above : Floats{} + INFINITY;
    const Floats wanted_voxel = pick(levels.voxel, wanted);
    const Mask reached = wanted_voxel <= cone;
    const Mask blend = reached & (wanted > 0);
    extent.cone_low = mask ? (reached ? wanted_voxel : Floats{} - INFINITY) : extent.cone_low;
    extent.cone_high = mask ? (reached ? voxel_above : wanted_voxel) : extent.cone_high;
    voxel = mask ? wanted_voxel : voxel;
    blend_scale = mask ? 1.0f / (voxel_above - wanted_voxel) : blend_scale;

    Ints depth, node, brick, tile;
    descend(mask, middle, depth, node, brick, tile);
    const Mask hides = node < 0;
    const Floats exit = ray.exit_distance([&](int axis, Mask upper) { return face(mask, axis, depth, upper); });
    extent.exit = mask ? exit : extent.exit;

    // The nodes whose bricks are read.
    Ints fine_level = depth, fine_brick = brick;
    for (;;) {
      const Mask higher = mask & (fine_level > 0) & (fine_brick == kAbsent);
      if (!any(higher)) break;
      fine_level = fine_level + higher;
      fine_brick = higher ? path_entry(path_brick, fine_level) : fine_brick;
    }
    Ints coarse_level = fine_level, coarse_brick = fine_brick;
    const Mask blends = mask & blend;
    if (any(blends)) {
      for (;;) {
        const Mask higher = blends & (coarse_level > 0) & ((coarse_level >= wanted) | (coarse_brick == kAbsent));
        if (!any(higher)) break;
        coarse_level = coarse_level + higher;
        coarse_brick = higher ? path_entry(path_brick, coarse_level) : coarse_brick;
      }
      const Mask has_coarse = blends & (coarse_level < wanted) & (coarse_brick != kAbsent);
      coarse_level = has_coarse ? coarse_level : fine_level;
      coarse_brick = has_coarse ? coarse_brick : fine_brick;
    }
    const Mask skipped = hides & ((depth < wanted) | ~blend);
    const Mask empty = Shader::kSeesEmpty ? Mask{} : (fine_brick == kEmpty) & (coarse_brick == kEmpty);
    const Mask shows_nothing = mask & (skipped | (fine_brick == kAbsent) | empty);

    const Mask seen = mask & ~skipped;
    const Mask lacks =
        seen & ((brick == kAbsent) | ((depth < wanted) & (tile == kAbsent)) |
                (blend & (depth == wanted) & (path_entry(path_brick, larger(depth - 1, Ints{})) == kAbsent)));
    if (any(lacks)) {
      sum.missed = sum.missed | lacks;
      for_lanes(lacks, [&](int lane) {
        Descent descent;
        descent.depth = depth[lane];
        descent.node = node[lane] & INT32_MAX;
        descent.parent = depth[lane] > 0 ? path_node[depth[lane] - 1][lane] & INT32_MAX : -1;
        descent.brick = brick[lane];
        descent.tile = tile[lane];
        if (fine_brick[lane] != kAbsent) descent.fine.node = path_node[fine_level[lane]][lane] & INT32_MAX;
        walk.mark_missing(descent, wanted[lane], blend[lane] != 0, cone[lane]);
      });
    }
    stamp(walk.stamp_b, seen & (fine_brick >= 0), fine_brick);
    stamp(walk.stamp_b, seen & (coarse_brick >= 0), coarse_brick);

    Mask runs = mask & ~shows_nothing;
    if (any(runs)) {
      const Mask two_nodes = coarse_level != fine_level;
      mixed = runs ? two_nodes : mixed;
      fine_depth = runs ? fine_level : fine_depth;
      coarse_depth = runs ? coarse_level : coarse_depth;
      set_brick(runs, fine_level, fine_brick, fine);
      const Mask both = runs & two_nodes;
      if (any(both)) set_brick(both, coarse_level, coarse_brick, coarse);
      Mask flat = runs & ~fine.stored & (~two_nodes | ~coarse.stored);
      if (kernel.shades_each_position()) flat = Mask{};
      each_lane(flat & two_nodes, [&](int lane, const Probe<float>& probe) { set_lane(flat, lane, probe.uniform()); });
      runs = runs & ~flat;
      if (any(runs)) begin_run(runs);
      if (any(flat)) add_region(flat);
    }
    leave(shows_nothing);
  }

  // The same as `descend` in tree.h, level by level for all lanes; those whose path is known to a deeper level wait.
  GV_HD void descend(Mask mask, Floats middle, Ints& depth, Ints& node, Ints& brick, Ints& tile) {
    const TreeView& tree = walk.tree;
    const Ints shared_depth = move_to(mask, middle, kKeepsPath ? smaller(path_depth, wanted) : Ints{} - 1);
    const Ints from = larger(shared_depth, Ints{});
    node = path_entry(path_node, from);
    brick = path_entry(path_brick, from);
    tile = path_entry(path_tile, from);
    depth = shared_depth;
    Mask going = mask & ((shared_depth < 0) | ~((shared_depth == wanted) | (tile < 0) | (node < 0)));
    int32_t level = kMaxLevels;
    for_lanes(going, [&](int lane) { level = smaller(level, shared_depth[lane] + 1); });
    for (; any(going); ++level) {
      const Mask active = going & (depth == level - 1);
      Ints next_node = Ints{} + tree.root, home_tile = Ints{} + tree.root_tile;
      if (level > 0) {
        home_tile = active ? tile : Ints{};
        next_node = home_tile * tree.nodes_per_tile + child(active, level);
      }
      next_node = active ? next_node : Ints{};
      stamp(tree.stamp_t, active, home_tile);
      const Ints brick_word = pick(tree.brick_tn, next_node), tile_word = pick(tree.child_tn, next_node);
      const Ints next_brick = brick_word < tree.bricks ? brick_word : Ints{} + kAbsent;  // as TreeView::checked_word
      const Ints next_tile = tile_word < tree.tiles ? tile_word : Ints{} + kAbsent;
      const Mask hides = hidden(active, next_node);
      node = active ? next_node | (hides & INT32_MIN) : node;
      brick = active ? next_brick : brick;
      tile = active ? next_tile : tile;
      path_node[level] = active ? node : path_node[level];
      path_brick[level] = active ? brick : path_brick[level];
      path_tile[level] = active ? tile : path_tile[level];
      depth = depth - active;
      going = going & ~(active & ((level == wanted) | (tile < 0) | hides));
    }
    path_depth = mask ? depth : path_depth;
  }

  // `move_to` moves lanes to their positions at distance t; it returns the deepest level, at most `deepest`, at which a
  // lane is in the same node as before. `child` and `face` are those of Digits and BitDigits: which child of the node
  // above a lane is in, and the offset of a face of its node from its ray's origin.
  GV_HD Ints move_to(Mask mask, Floats t, Ints deepest) {
    if (walk.rays.deep) return deep_lanes.move_to(mask, ray.direction, t, deepest);
    const TreeView& tree = walk.tree;
    const int32_t top = tree.digit_bits * tree.max_depth;
    const float cells = static_cast<float>(1 << top);
    Ints changed_bits{};
    const Vec3<Floats> position = ray.at(t);
    for (int axis = 0; axis < 3; ++axis) {
      const Ints new_cell = mask ? truncated(position[axis] * cells) : cell[axis];
      changed_bits = changed_bits | (cell[axis] ^ new_cell);
      cell[axis] = new_cell;
    }
    // A float's exponent gives the highest bit set. Rounding up to a power of two may make the result one level less.
    const Ints high = ((Ints)to_floats(changed_bits) >> 23) - 126;
    const Ints same_level = truncated(to_floats(top - high) / static_cast<float>(tree.digit_bits));
    return changed_bits == 0 ? deepest : smaller(deepest, same_level);
  }
  GV_HD Ints child(Mask mask, int32_t level) const {
    if (walk.rays.deep) return deep_lanes.child(mask, level);
    const int32_t bits = walk.tree.digit_bits, digit_mask = (1 << bits) - 1;
    const int32_t shift = bits * (walk.tree.max_depth - level);
    const Ints x = (cell.x >> shift) & digit_mask, y = (cell.y >> shift) & digit_mask,
               z = (cell.z >> shift) & digit_mask;
    return (z << (2 * bits)) | (y << bits) | x;
  }
  GV_HD Floats face(Mask mask, int axis, Ints level, Mask upper) const {
    if (walk.rays.deep) return deep_lanes.face(mask, axis, level, upper);
    const Ints shift = walk.tree.digit_bits * (walk.tree.max_depth - level);
    return to_floats((cell[axis] >> shift) - upper) * pick(walk.levels.size, level) - ray.origin[axis];
  }

  GV_HD Mask hidden(Mask mask, Ints node) {
    if constexpr (!kKeepsPath) {
      Floats low{}, high{};
      for_lanes(mask, [&](int lane) {
        const auto range = kernel.range_of(node[lane]);
        low[lane] = range.low;
        high[lane] = range.high;
      });
      return hides_of(shader, mask, low, high, sum);
    }
    const Ints states = gather(hidden_tn, node) & 0xff;
    Mask hides = mask & (states == kHidden);
    for_lanes(mask & (states == kUnknown), [&](int lane) { set_lane(hides, lane, kernel.hides(node[lane])); });
    return hides;
  }

  GV_HD void stamp(int32_t* stamps, Mask mask, Ints index) const {
    if (!any(mask)) return;
    const Mask old = mask & (pick_shared(stamps, mask ? index : Ints{}) != frame);
    for_lanes(old, [&](int lane) { store_stamp(&stamps[index[lane]], frame); });
  }

  // Each lane's entry at its own level.
  GV_HD static Ints path_entry(const Ints* path, Ints level) {
    return pick(reinterpret_cast<const int32_t*>(path), level * kLanes + lane_numbers());
  }

  GV_HD void leave(Mask mask) {
    intervals.leave(mask, extent);
    number = mask ? intervals.count : number;
  }

  GV_HD void set_brick(Mask mask, Ints holder_depth, Ints brick, PacketBrick& to) {
    const Mask stored = brick >= 0;
    const Floats scale = pick(walk.levels.scale, holder_depth);
    const float first = static_cast<float>(kernel.channels.border) - 0.5f;
    for (int axis = 0; axis < 3; ++axis) {
      const Floats offset = -face(mask, axis, holder_depth, Mask{}) * scale + first;
      const Floats slope = ray.direction[axis] * scale;
      to.offset[axis] = mask ? (stored ? offset : Floats{}) : to.offset[axis];
      to.slope[axis] = mask ? (stored ? slope : Floats{}) : to.slope[axis];
    }
    to.stored = mask ? stored : to.stored;
    to.brick = mask ? (stored ? values.first_of(brick) : Ints{}) : to.brick;
    for_lanes(mask & ~stored, [&](int lane) { to.constant[lane] = constant_of(lane, holder_depth); });
  }
  GV_HD float constant_of(int lane, Ints depth) const {
    return channels.value.constant<float>(node_of(lane, depth), kernel.channels.component);
  }
  GV_HD Ints depth_of(const PacketBrick& brick) const { return &brick == &fine ? fine_depth : coarse_depth; }
  GV_HD int32_t node_of(int lane, Ints depth) const { return path_node[depth[lane]][lane] & INT32_MAX; }

  // Begins a run of alike intervals; lanes that need care march alone to the end of the visit at once.
  GV_HD void begin_run(Mask mask) {
    const Ints last = values.first_of(Ints{} + static_cast<int32_t>(bricks - 1));
    const Mask end = (fine.stored & (fine.brick == last)) | (mixed & coarse.stored & (coarse.brick == last));
    const Mask marches_alone = mask & (intervals.cut() | end);
    if (any(marches_alone)) {
      march_alone(marches_alone);
      fine.brick = marches_alone ? Ints{} : fine.brick;  // reads that lanes ignore must stay in the pool too
      coarse.brick = marches_alone ? Ints{} : coarse.brick;
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
    Piece<Floats> piece;
    piece.start = intervals.start;
    leave(mask);
    piece.end = smaller(intervals.start, intervals.stop);
    piece.set_odd();
    piece.value = piece.front = piece.back = fine.constant;
    samples = samples - mask;
    marching = mask;
    shader.add(mask, piece, *this, sum);
  }

  // Takes one interval in all lanes that march; returns those whose run goes on. So that the next sample never waits
  // for this one's colour, a lane whose ray has ended marches on without effect to the end of its run.
  GV_HD Mask march(Mask mask) {
    marching = mask;
    Piece<Floats> piece;
    piece.middle = intervals.middle_of(number);
    piece.start = intervals.start_of(number);
    piece.end = intervals.start_of(number + 1.0f);
    piece.length = intervals.length;
    piece.level = intervals.level;
    number = number - to_floats(mask);
    remaining = remaining + mask;
    if constexpr (kEnds) {
      piece.front = last_value;
      piece.back = last_value = value(piece.end);
    } else if constexpr (!Shader::kReadsAll) {
      piece.value = value(piece.middle);
    }
    const Mask seeing = mask & (sum.clear > stop_clear);
    samples = samples - seeing;
    shader.add(seeing, piece, *this, sum);
    return mask & (remaining > 0);
  }

  __attribute__((noinline)) void march_alone(Mask mask) {
    each_lane(mask, [&](int lane, const RayProbe& probe) {
      auto lane_intervals = take_lane<Intervals<float>>(intervals, lane);
      const Extent<float> lane_extent{extent.exit[lane], extent.cone_low[lane], extent.cone_high[lane]};
      auto&& lane_sum = sum_of<Sum>(sum, lane);
      Visitor visitor{kernel, shader, nullptr, nullptr, lane_sum};
      kernel.march(lane_extent, lane_intervals, visitor, probe);
      put_sum(sum, lane, lane_sum);
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

}  // namespace gvtorch::GV_NAMESPACE
