// Where the lanes of a packet are: their rays and intervals, and the nodes that they visit. This part of a packet's
// walk is the same for all shaders and voxels, and is compiled once; again only for shaders that hide a node from some
// rays and not from others.
#pragma once

#include "packets/deep_lanes.h"
#include "packets/packet_brick.h"
#include "shaders/light.h"

namespace gvtorch::GV_NAMESPACE {

struct PacketPath {
  const Walk<float>& walk;
  const Channels& tree_channels;
  uint8_t* const hidden_tn;  // see kUnknown in walk.h; nullptr: hidden nodes differ from ray to ray
  const int32_t slot_bytes;  // PacketBrick::brick of slot 1
  const int32_t frame;
  const int32_t lengths;  // of intervals: how many there are

  // The ray that a lane follows. Lanes without one may hold any numbers.
  Ray<Floats> ray{};
  Sight<Floats> sight{};
  Intervals<Floats> intervals{};
  Ints wanted{};

  // The last descent: the node of each level, negative (bit 31 is set) where it is hidden.
  Vec3<Ints> cell{};
  DeepLanes deep_lanes;  // in place of `cell` where the tree is deep
  Ints path_depth = Ints{} - 1;
  Ints path_node[kMaxLevels], path_brick[kMaxLevels], path_tile[kMaxLevels];

  // The visit that a lane is in.
  Floats number{};  // of the next interval
  Extent<Floats> extent{};
  Floats voxel{}, blend_scale{};
  Mask mixed{};
  PacketBrick fine{}, coarse{};
  Ints fine_depth{}, coarse_depth{};

  PacketPath(const Walk<float>& walk, const Channels& tree_channels, uint8_t* hidden_tn, int32_t slot_bytes,
             int32_t lengths)
      : walk(walk),
        tree_channels(tree_channels),
        hidden_tn(hidden_tn),
        slot_bytes(slot_bytes),
        frame(*walk.frame_1),
        lengths(lengths),
        deep_lanes(walk.rays, walk.tree, walk.levels) {
    for (int axis = 0; axis < 3; ++axis) ray.upper_bound[axis] = Ray<Floats>::upper_bound_of(walk.rays, axis);
  }

  // Begins a ray in a lane.
  GV_CALL void begin_ray(int lane, int64_t ray_number) {
    const Ray<float> lane_ray(walk.rays, ray_number);
    put_ray(lane, lane_ray, {walk.rays, ray_number, lane_ray.moved}, {lane_ray, walk.step, lengths});
  }
  // Begins a cone in a lane, see ShadeRay::light_share; it begins on the ray of a lane of another packet.
  GV_CALL void begin_cone(int lane, const LightCone<float>& cone, const PacketPath& from, int from_lane) {
    const Vec3<float> origin = lane_of(from.ray.origin, from_lane), direction = lane_of(from.ray.direction, from_lane);
    Vec3<double> position;
    for (int axis = 0; axis < 3; ++axis) position[axis] = origin[axis] + cone.t * direction[axis];
    if (walk.rays.deep) position = from.deep_lanes.along(from_lane, direction, cone.t);
    const float near = from.intervals.cone_near[from_lane] + from.intervals.cone_growth[from_lane] * cone.t;
    const Ray<float> beam(walk.rays, position, cone.direction, near, cone.growth, cone.length);
    Intervals<float> beam_intervals(beam, walk.step, lengths);
    beam_intervals.move_to(true, beam_intervals.count + 1);
    put_ray(lane, beam, {take_lane<Sight<float>>(from.sight, from_lane).at(cone.t), cone.direction}, beam_intervals);
  }

  // What `find` returns: the lanes whose node shows something, for which `fine`, `coarse` and the fields beside them
  // are set; those of them whose node has one value; those whose node shows nothing; and those that want data that is
  // missing and was requested.
  struct Found {
    Mask shown, uniform, nothing, lacking;
  };
  // The same as Walk::find, for shaders that hide a node from all rays or from none.
  GV_CALL Found find(Mask mask, bool sees_empty) {
    return find(mask, sees_empty, [&](Mask active, Ints node) {
      const Ints states = gather(hidden_tn, node) & 0xff;
      Mask hidden = active & (states == kHidden);
      for_lanes(active & (states == kUnknown), [&](int lane) { set_lane(hidden, lane, hides(node[lane])); });
      return hidden;
    });
  }
  // The same for other shaders: hidden_from(mask, node) gives the lanes of `mask` to which their node shows nothing.
  template <class HiddenFrom>
  GV_HD Found find(Mask mask, bool sees_empty, const HiddenFrom& hidden_from) {
    const Floats middle = intervals.middle();
    const Floats cone = intervals.cone(middle);
    const Mask blend = choose_depth(mask, cone);

    Ints depth, node, brick, tile;
    descend(mask, middle, hidden_from, depth, node, brick, tile);
    const Mask hidden_nodes = node < 0;
    const Floats size = pick(walk.levels.size, depth);
    const Floats exit = ray.exit_distance([&](int axis, Mask upper) { return face(mask, axis, depth, size, upper); });
    extent.exit = mask ? exit : extent.exit;

    // The nodes whose bricks are read.
    Ints fine_level = depth, fine_brick = brick;
    climb(mask, Ints{} + kMaxLevels, fine_level, fine_brick);
    Ints coarse_level = fine_level, coarse_brick = fine_brick;
    const Mask blends = mask & blend;
    if (any(blends)) {
      climb(blends, wanted, coarse_level, coarse_brick);
      const Mask has_coarse = blends & (coarse_level < wanted) & (coarse_brick != kAbsent);
      coarse_level = has_coarse ? coarse_level : fine_level;
      coarse_brick = has_coarse ? coarse_brick : fine_brick;
    }
    const Mask skipped = hidden_nodes & ((depth < wanted) | ~blend);
    const Mask empty = sees_empty ? Mask{} : (fine_brick == kEmpty) & (coarse_brick == kEmpty);
    Found found;
    found.nothing = mask & (skipped | (fine_brick == kAbsent) | empty);
    found.shown = mask & ~found.nothing;

    const Mask seen = mask & ~skipped;
    found.lacking =
        seen & ((brick == kAbsent) | ((depth < wanted) & (tile == kAbsent)) |
                (blend & (depth == wanted) & (path_entry(path_brick, larger(depth - 1, Ints{})) == kAbsent)));
    for_lanes(found.lacking, [&](int lane) {
      Descent descent;
      descent.depth = depth[lane];
      descent.node = node[lane] & INT32_MAX;
      descent.parent = depth[lane] > 0 ? path_node[depth[lane] - 1][lane] & INT32_MAX : -1;
      descent.brick = brick[lane];
      descent.tile = tile[lane];
      if (fine_brick[lane] != kAbsent) descent.fine.node = path_node[fine_level[lane]][lane] & INT32_MAX;
      walk.mark_missing(descent, wanted[lane], blend[lane] != 0, cone[lane]);
    });
    stamp(walk.stamp_b, seen & (fine_brick >= 0), fine_brick);
    const Mask two_nodes = coarse_level != fine_level;
    stamp(walk.stamp_b, seen & two_nodes & (coarse_brick >= 0), coarse_brick);

    found.uniform = Mask{};
    if (any(found.shown)) {
      mixed = found.shown ? two_nodes : mixed;
      fine_depth = found.shown ? fine_level : fine_depth;
      coarse_depth = found.shown ? coarse_level : coarse_depth;
      set_brick(found.shown, fine_level, fine_brick, fine);
      const Mask both = found.shown & two_nodes;
      if (any(both)) set_brick(both, coarse_level, coarse_brick, coarse);
      found.uniform = found.shown & ~fine.stored & (~two_nodes | ~coarse.stored);
    }
    return found;
  }

  // Moves lanes behind the nodes that they are in.
  GV_HD void leave(Mask mask) {
    intervals.leave(mask, extent);
    number = mask ? intervals.count : number;
  }

  GV_HD Ints first_of(Ints slot) const {  // lanes without a brick may hold anything, so the product must wrap
    return reinterpret_cast<Ints>(reinterpret_cast<UInts>(slot) * static_cast<uint32_t>(slot_bytes));
  }
  GV_HD Ints depth_of(const PacketBrick& brick) const { return &brick == &fine ? fine_depth : coarse_depth; }
  GV_HD int32_t node_of(int lane, Ints depth) const { return path_node[depth[lane]][lane] & INT32_MAX; }
  GV_HD Spot<float> spot_of(int lane, const PacketBrick& brick, Ints depth) const {
    return {node_of(lane, depth), brick.stored[lane] ? path_brick[depth[lane]][lane] : kAbsent,
            walk.levels.scale[depth[lane]], lane_of(brick.offset, lane), lane_of(brick.slope, lane)};
  }

 protected:
  // True if no ray sees anything in a node; remembered in hidden_tn.
  virtual bool hides(int32_t node) const = 0;

 private:
  GV_HD void put_ray(int lane, const Ray<float>& lane_ray, const Sight<float>& lane_sight,
                     const Intervals<float>& lane_intervals) {
    put_lane(ray, lane, lane_ray);
    put_lane(sight, lane, lane_sight);
    put_lane(intervals, lane, lane_intervals);
    number[lane] = lane_intervals.count;
    if (walk.rays.deep) deep_lanes.begin(lane, lane_ray);
  }

  // Level of detail: sets `wanted`, the first depth whose voxel fits into the cone, and how it blends with the depth
  // above. Returns the lanes that do: where no voxel fits, the finest is read alone.
  GV_HD Mask choose_depth(Mask mask, Floats cone) {
    const Levels<float>& levels = walk.levels;
    Floats wanted_voxel = pick(levels.voxel, wanted);
    for (;;) {
      const Mask finer = mask & (wanted < walk.tree.max_depth) & (wanted_voxel > cone);
      if (!any(finer)) break;
      wanted = wanted - finer;
      wanted_voxel = pick(levels.voxel, wanted);
    }
    Floats voxel_above;
    for (;;) {
      voxel_above = pick(levels.voxel, larger(wanted - 1, Ints{}));
      const Mask coarser = mask & (wanted > 0) & ~(voxel_above > cone);
      if (!any(coarser)) break;
      wanted = wanted + coarser;
      wanted_voxel = coarser ? voxel_above : wanted_voxel;
    }
    voxel_above = wanted > 0 ? voxel_above : Floats{} + INFINITY;
    const Mask reached = wanted_voxel <= cone;
    extent.cone_low = mask ? (reached ? wanted_voxel : Floats{} - INFINITY) : extent.cone_low;
    extent.cone_high = mask ? (reached ? voxel_above : wanted_voxel) : extent.cone_high;
    voxel = mask ? wanted_voxel : voxel;
    blend_scale = mask ? 1.0f / (voxel_above - wanted_voxel) : blend_scale;
    return reached & (wanted > 0);
  }
  // Moves lanes up their paths while they are not above depth `below`, or have no brick.
  GV_HD void climb(Mask mask, Ints below, Ints& level, Ints& brick) const {
    for (;;) {
      const Mask higher = mask & (level > 0) & ((level >= below) | (brick == kAbsent));
      if (!any(higher)) return;
      level = level + higher;
      brick = higher ? path_entry(path_brick, level) : brick;
    }
  }

  // The same as `descend` in tree.h, level by level for all lanes; those whose path is known to a deeper level wait.
  template <class HiddenFrom>
  GV_HD void descend(Mask mask, Floats middle, const HiddenFrom& hidden_from, Ints& depth, Ints& node, Ints& brick,
                     Ints& tile) {
    const TreeView& tree = walk.tree;
    const Ints shared_depth = move_to(mask, middle, hidden_tn != nullptr ? smaller(path_depth, wanted) : Ints{} - 1);
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
      const Mask hidden_nodes = hidden_from(active, next_node);
      node = active ? next_node | (hidden_nodes & INT32_MIN) : node;
      brick = active ? next_brick : brick;
      tile = active ? next_tile : tile;
      path_node[level] = active ? node : path_node[level];
      path_brick[level] = active ? brick : path_brick[level];
      path_tile[level] = active ? tile : path_tile[level];
      depth = depth - active;
      going = going & ~(active & ((level == wanted) | (tile < 0) | hidden_nodes));
    }
    path_depth = mask ? depth : path_depth;
    depth = larger(depth, Ints{});  // an index, also in lanes outside `mask`
  }

  // `move_to` moves lanes to their positions at distance t; it returns the deepest level, at most `deepest`, at which a
  // lane is in the same node as before. `child` and `face` are those of Digits and BitDigits: which child of the node
  // above a lane is in, and the offset of a face of its node, which is `size` wide, from its ray's origin.
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
  GV_HD Floats face(Mask mask, int axis, Ints level, Floats size, Mask upper) const {
    if (walk.rays.deep) return deep_lanes.face(mask, axis, level, upper);
    const Ints shift = walk.tree.digit_bits * (walk.tree.max_depth - level);
    return to_floats((cell[axis] >> shift) - upper) * size - ray.origin[axis];
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

  GV_HD void set_brick(Mask mask, Ints holder_depth, Ints brick, PacketBrick& to) {
    const Mask stored = brick >= 0;
    const Floats scale = pick(walk.levels.scale, holder_depth), size = pick(walk.levels.size, holder_depth);
    const float first = static_cast<float>(tree_channels.border) - 0.5f;
    for (int axis = 0; axis < 3; ++axis) {
      const Floats offset = -face(mask, axis, holder_depth, size, Mask{}) * scale + first;
      const Floats slope = ray.direction[axis] * scale;
      to.offset[axis] = mask ? (stored ? offset : Floats{}) : to.offset[axis];
      to.slope[axis] = mask ? (stored ? slope : Floats{}) : to.slope[axis];
    }
    to.stored = mask ? stored : to.stored;
    to.brick = mask ? (stored ? first_of(brick) : Ints{}) : to.brick;
    for_lanes(mask & ~stored, [&](int lane) { to.constant[lane] = constant_of(lane, holder_depth); });
  }
  GV_HD float constant_of(int lane, Ints depth) const {
    return tree_channels.value.constant<float>(node_of(lane, depth), tree_channels.component);
  }
};

}  // namespace gvtorch::GV_NAMESPACE
