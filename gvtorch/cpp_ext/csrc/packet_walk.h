// kLanes rays at once from node to node, each in a node and an interval of its own: the twin of walk.h for float32 and
// an N that is a power of two. What is made of the values is told by `Self`, the packet of a shader (packet.h,
// packet_shaders.h), which derives from PacketWalk<Self>. Each lane does what its ray does alone, so every bit is the
// same.
//
// Lanes whose run of intervals has ended wait; the others march on together, until too few are left. What is rare (a
// region of one value, the cut interval at the far side, the pool's last brick, a wish) is done lane by lane by the
// functions of a single ray.
#pragma once

#include "packet_brick.h"
#include "packet_intervals.h"
#include "packet_shade.h"
#include "walk.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// An interval of every lane.
struct PacketPiece {
  Floats start, end, middle;
  Floats value;        // in the middle
  Floats front, back;  // at both ends, where the shader is of kEnds
};

// What Self has:
//
//   kEnds, kSeesEmpty       as in shaders.h
//   kKeepsPath              which nodes are hidden is the same for all rays
//   begin_ray(lane)         the lane has a new ray, numbers[lane]
//   end_ray(lane)           writes what is known of it
//   hides(lane, node)       nothing in the node is seen
//   first_of(brick)         PacketBrick::brick of the brick's number
//   read(brick, at)         the value at a place of a brick
//   constant(node)          the value of a node without a brick
//   uniform(which)          lanes in a region of one value, of those where two nodes answer and neither has a brick
//   add(seeing, piece)      adds an interval of those lanes
//   begin_run(which)        the lanes' next intervals are alike
//   shades_each_place()     a region of one value is sampled like others
//   add_region(lane, start, end)   adds a region of one value
//   march_node(lane, visit, at)    adds all intervals of a node that are to come; returns how many
template <class Self>
struct PacketWalk {
  const Walk<float>& walk;
  uint8_t* const hidden_tn;
  int32_t* const stamp_b;
  const int64_t bricks;
  const int32_t lengths, border;
  const float stop_clear, hit_clear;
  const int32_t frame;

  // Rays.
  int64_t numbers[kLanes];
  Floats origin[3], direction[3], inverse[3], moved;
  PacketIntervals at;
  Mask alive;
  Ints wanted;
  PacketSum sum;
  Ints samples;

  // The last descent: a node of each level, below 0 (bit 31) where it is hidden.
  Ints cell[3];
  Ints path_depth;
  Ints path_node[kMostLevels], path_brick[kMostLevels], path_tile[kMostLevels];

  // The run of intervals that a lane is in.
  Ints left;
  Floats number, exit, cone_low, cone_high;
  Floats voxel, blend_scale;
  Floats back;  // value where the last interval ended
  Mask mixed;
  PacketBrick fine, coarse;
  Ints fine_depth, coarse_depth;

  PacketWalk(const Walk<float>& walk, const TraceArgs& args)
      : walk(walk),
        hidden_tn(args.hidden_tn),
        stamp_b(args.stamp_b),
        bricks(args.bricks),
        lengths(args.levels),
        border(args.border),
        stop_clear(1 - walk.options.stop_alpha),
        hit_clear(1 - walk.options.depth_alpha),
        frame(*walk.frame_1) {
    path_depth = Ints{} - 1;
    for (int axis = 0; axis < 3; ++axis) cell[axis] = Ints{};
  }

  // Traces the rays at places begin to end of the order, at most kLanes.
  GV_HD void trace(int64_t begin, int64_t end) {
    load(begin, end);
    while (any(alive)) {
      const Mask waiting = alive & (left == 0);
      if (any(waiting)) go_on(waiting);
      Mask marching = alive & (left > 0);
      const int32_t enough = count(alive) / 2 + 1;
      while (count(marching) >= enough) marching = march(marching);
    }
    for (int lane = 0; lane < kLanes; ++lane) {
      const int64_t ray = numbers[lane];
      if (ray < 0) continue;
      self().end_ray(lane);
    }
  }

 protected:
  GV_HD Self& self() { return static_cast<Self&>(*this); }

  GV_HD void load(int64_t begin, int64_t end) {
    alive = Mask{};
    left = wanted = samples = mixed = fine_depth = coarse_depth = Ints{};
    number = exit = cone_low = cone_high = voxel = blend_scale = back = moved = Floats{};
    sum = PacketSum{};
    sum.clear = Floats{} + 1.0f;
    sum.depth = Floats{} + INFINITY;
    fine = coarse = PacketBrick{};
    at = PacketIntervals{};
    at.step = walk.options.step;
    at.top = lengths - 1;
    at.length = Floats{} + at.step;
    at.shortness = 1.0f / at.length;
    for (int axis = 0; axis < 3; ++axis) origin[axis] = direction[axis] = inverse[axis] = Floats{};
    for (int lane = 0; lane < kLanes; ++lane) {
      numbers[lane] = begin + lane < end ? walk.order(begin + lane) : -1;
      if (numbers[lane] < 0) continue;
      const Ray<float> ray(walk.rays, numbers[lane]);
      for (int axis = 0; axis < 3; ++axis) {
        origin[axis][lane] = ray.origin[axis];
        direction[axis][lane] = ray.direction[axis];
        inverse[axis][lane] = ray.inverse[axis];
      }
      at.near[lane] = ray.cone_near;
      at.growth[lane] = ray.cone_growth;
      at.start[lane] = at.base[lane] = ray.first;
      at.stop[lane] = ray.last;
      moved[lane] = ray.moved;
      sum.clear[lane] = static_cast<float>(walk.rays.clear(numbers[lane]));
      alive[lane] = -1;
      self().begin_ray(lane);
    }
    at.choose_level(alive);
    alive = alive & at.inside() & (sum.clear > stop_clear);
  }

  // Lanes without a run: begins the next one in the same node, or visits the next node.
  GV_HD void go_on(Mask waiting) {
    const Mask ran = waiting & (number > at.count);
    at.go(ran, number);
    alive = alive & ~(waiting & ~(at.inside() & (sum.clear > stop_clear)));
    const Mask again = ran & alive & at.stays(exit, cone_low, cone_high);
    Mask next = waiting & alive & ~again;
    if (any(again)) begin_run(again);
    if (any(next)) visit(next);
    alive = alive & ~(waiting & (left == 0) & ~(at.inside() & (sum.clear > stop_clear)));
  }

  // Twin of Walk::find, and of what a kernel does with the visit.
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
    cone_low = which ? (reached ? own : Floats{} - INFINITY) : cone_low;
    cone_high = which ? (reached ? above : own) : cone_high;
    voxel = which ? own : voxel;
    blend_scale = which ? 1.0f / (above - own) : blend_scale;

    Ints reach, node, brick, tile;
    descend(which, middle, reach, node, brick, tile);
    const Mask hides = node < 0;
    const Ints shift = tree.digit_bits * (tree.max_depth - reach);
    const Floats size = pick(levels.size, reach);
    Floats face = Floats{} + INFINITY;
    for (int axis = 0; axis < 3; ++axis) {
      const Floats low = to_floats(cell[axis] >> shift) * size;
      const Floats side = direction[axis] > 0.0f ? low + size : low;
      const Floats leave = (side - origin[axis]) * inverse[axis];
      face = direction[axis] == 0.0f ? face : smaller(face, leave);
    }
    exit = which ? face : exit;

    // The nodes whose bricks answer.
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
    const Mask empty = Self::kSeesEmpty ? Mask{} : (fine_brick == kEmpty) & (coarse_brick == kEmpty);
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
    stamp(stamp_b, seen & (fine_brick >= 0), fine_brick);
    stamp(stamp_b, seen & (coarse_brick >= 0), coarse_brick);

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
      if (self().shades_each_place()) flat = Mask{};
      if (any(flat & differ)) flat = flat & (~differ | self().uniform(flat & differ));
      if (any(flat)) {
        const Floats entry = at.start;
        leave(flat);
        for_lanes(flat,
                  [&](int lane) { self().add_region(lane, entry[lane], smaller(at.start[lane], at.stop[lane])); });
        samples = samples - flat;
        runs = runs & ~flat;
      }
      if (any(runs)) begin_run(runs);
    }
    leave(nothing);
  }

  // Twin of `descend` in tree.h, level by level for all lanes: those whose known part of the path ends deeper wait.
  GV_HD void descend(Mask which, Floats middle, Ints& reach, Ints& node, Ints& brick, Ints& tile) {
    const TreeView& tree = walk.tree;
    const int32_t top = tree.digit_bits * tree.max_depth;
    const float cells = static_cast<float>(1 << top);
    Ints parted{};
    for (int axis = 0; axis < 3; ++axis) {
      const float high = static_cast<float>(walk.rays.place_33[6 + axis]) * 0.9999999f;
      const Floats place = clamp(origin[axis] + middle * direction[axis], Floats{}, Floats{} + high);
      const Ints here = which ? truncated(place * cells) : cell[axis];
      parted = parted | (cell[axis] ^ here);
      cell[axis] = here;
    }
    // The exponent of a number tells its highest bit; rounded up to a power of two it tells one level too few.
    const Ints high = ((Ints)to_floats(parted) >> 23) - 126;
    const Ints equal = truncated(to_floats(top - high) / static_cast<float>(tree.digit_bits));
    Ints known = parted == 0 ? path_depth : smaller(path_depth, equal);
    known = Self::kKeepsPath ? smaller(known, wanted) : Ints{} - 1;
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
        const int32_t shift = top - level * tree.digit_bits, mask = (1 << tree.digit_bits) - 1;
        const Ints x = (cell[0] >> shift) & mask, y = (cell[1] >> shift) & mask, z = (cell[2] >> shift) & mask;
        home = here ? tile : Ints{};
        next = home * tree.nodes_per_tile + ((z << (2 * tree.digit_bits)) | (y << tree.digit_bits) | x);
      }
      next = here ? next : Ints{};
      stamp(tree.stamp_t, here, home);
      const Ints next_brick = pick(tree.brick_tn, next);
      const Ints next_tile = pick(tree.child_tn, next);
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

  GV_HD Mask hidden(Mask here, Ints node) {
    Mask hides{}, unknown = here;
    if constexpr (Self::kKeepsPath) {
      const Ints known = gather(hidden_tn, node) & 0xff;
      hides = here & (known == kHidden);
      unknown = here & (known == kUnknown);
    }
    for_lanes(unknown, [&](int lane) { hides[lane] = self().hides(lane, node[lane]) ? -1 : 0; });
    return hides;
  }

  GV_HD void stamp(int32_t* stamps, Mask which, Ints index) const {
    if (!any(which)) return;
    const Mask old = which & (pick(stamps, which ? index : Ints{}) != frame);
    for_lanes(old, [&](int lane) { store_stamp(&stamps[index[lane]], frame); });
  }

  // Each lane's entry of a level of its own.
  GV_HD static Ints own_lane(const Ints* path, Ints level) {
    return pick(reinterpret_cast<const int32_t*>(path), level * kLanes + lane_numbers());
  }

  // Goes to the first interval behind the node.
  GV_HD void leave(Mask which) {
    for (Mask inside = which; any(inside); inside = inside & at.stays(exit, cone_low, cone_high)) {
      const Ints whole = at.run(inside, exit, cone_low, cone_high);
      const Ints intervals = at.cut() ? Ints{} + 1 : whole;
      at.go(inside, at.count + to_floats(intervals));
    }
    number = which ? at.count : number;
  }

  GV_HD void aim(Mask which, Ints holder_depth, Ints brick, PacketBrick& ray) {
    const Mask stored = brick >= 0;
    const Floats scale = pick(walk.levels.scale, holder_depth);
    const Floats size = pick(walk.levels.size, holder_depth);
    const Ints shift = walk.tree.digit_bits * (walk.tree.max_depth - holder_depth);
    const float first = static_cast<float>(border) - 0.5f;
    for (int axis = 0; axis < 3; ++axis) {
      const Floats corner = to_floats(cell[axis] >> shift) * size;
      const Floats offset = (origin[axis] - corner) * scale + first;
      const Floats slope = direction[axis] * scale;
      ray.offset[axis] = which ? (stored ? offset : Floats{}) : ray.offset[axis];
      ray.slope[axis] = which ? (stored ? slope : Floats{}) : ray.slope[axis];
    }
    ray.stored = which ? stored : ray.stored;
    ray.brick = which ? (stored ? self().first_of(brick) : Ints{}) : ray.brick;
    for_lanes(which & ~stored, [&](int lane) { ray.constant[lane] = self().constant(node_of(lane, holder_depth)); });
  }
  GV_HD int32_t node_of(int lane, Ints depth) const { return path_node[depth[lane]][lane] & INT32_MAX; }

  // Begins the run of intervals that are alike; lanes that need care are done with the node at once.
  GV_HD void begin_run(Mask which) {
    const Ints last = self().first_of(Ints{} + static_cast<int32_t>(bricks - 1));
    const Mask end = (fine.stored & (fine.brick == last)) | (mixed & coarse.stored & (coarse.brick == last));
    const Mask careful = which & (at.cut() | end);
    if (any(careful)) {
      for_lanes(careful, [&](int lane) { march_alone(lane); });
      fine.brick = careful ? Ints{} : fine.brick;  // what other lanes read in vain must lie in the pool
      coarse.brick = careful ? Ints{} : coarse.brick;
      which = which & ~careful;
    }
    left = which ? at.run(which, exit, cone_low, cone_high) : left;
    number = which ? at.count : number;
    if constexpr (Self::kEnds) {
      if (any(which)) back = which ? value(which, at.start) : back;
    }
    self().begin_run(which);
  }

  // One interval of all lanes that march; returns those whose run goes on. Nothing that leads to the next sample waits
  // for this one's colour: a lane that has seen enough marches on in vain to the end of its run.
  GV_HD Mask march(Mask which) {
    PacketPiece piece;
    piece.middle = at.middle_of(number);
    piece.start = at.start_of(number);
    piece.end = at.start_of(number + 1.0f);
    number = number - to_floats(which);
    left = left + which;
    if constexpr (Self::kEnds) {
      piece.front = back;
      piece.back = back = value(which, piece.end);
    } else {
      piece.value = value(which, piece.middle);
    }
    const Mask seeing = which & (sum.clear > stop_clear);
    samples = samples - seeing;
    self().add(seeing, piece);
    return which & (left > 0);
  }

  GV_HD Floats value(Mask which, Floats t) {
    const Floats value = value_of(fine, t);
    if (!any(mixed & which)) return value;
    return mixed ? value + weight(t) * (value_of(coarse, t) - value) : value;
  }
  GV_HD Floats value_of(const PacketBrick& ray, Floats t) {
    const Floats value = self().read(ray.brick, ray.at(t));
    return ray.stored ? value : ray.constant;
  }
  // Of the coarse node.
  GV_HD Floats weight(Floats t) const { return clamp((at.cone(t) - voxel) * blend_scale, Floats{}, Floats{} + 1.0f); }

  __attribute__((noinline)) void march_alone(int lane) {
    Intervals<float> one;
    one.near = at.near[lane];
    one.growth = at.growth[lane];
    one.step = at.step;
    one.stop = at.stop[lane];
    one.top = at.top;
    one.level = at.level[lane];
    one.base = at.base[lane];
    one.length = at.length[lane];
    one.shortness = at.shortness[lane];
    one.count = at.count[lane];
    one.start = at.start[lane];
    Visit<float> visit;
    visit.exit = exit[lane];
    visit.cone_low = cone_low[lane];
    visit.cone_high = cone_high[lane];
    samples[lane] += self().march_node(lane, visit, one);
    at.level[lane] = one.level;
    at.base[lane] = one.base;
    at.length[lane] = one.length;
    at.shortness[lane] = one.shortness;
    at.count[lane] = one.count;
    at.start[lane] = one.start;
    number[lane] = one.count;
  }
};

// Whether packets can take the rays: their pools are as the loads above need them, which find nodes by 32-bit bytes.
inline bool packs(const TraceArgs& args) {
  constexpr int64_t kMostNodes = INT32_MAX / sizeof(int32_t);
  const PacketPool pool(args.bricks_bzyxc, args.voxel, args.side, args.channels, args.component);
  return digit_bits_of(args.branching, args.max_depth) > 0 && args.nodes <= kMostNodes && args.bricks >= 2 &&
         pool.fits();
}

template <class Packet, class... Args>
void trace_packets(int64_t begin, int64_t end, const Args&... args) {
  Packet packet(args...);
  for (int64_t index = begin; index < end; index += kLanes) packet.trace(index, smaller(index + kLanes, end));
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
