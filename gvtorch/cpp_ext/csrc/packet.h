// kLanes rays at once through the tree, each in a node and an interval of its own: the twin of TraceRay for float32 and
// an N that is a power of two. Each lane does what TraceRay does, so every bit is the same.
//
// Lanes whose run of intervals has ended wait; the others march on together, until too few are left. What is rare (a
// region of one value, the cut interval at the far side, the pool's last brick, a wish) is done lane by lane by
// TraceRay's own functions.
#pragma once

#include "packet_intervals.h"
#include "trace.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Twin of BrickRay. A lane with a constant has no slope and reads the pool's first voxels in vain.
struct PacketBrick {
  Floats offset[3], slope[3];
  Floats constant;
  Mask stored;
  Ints brick;  // its first byte in the pool, or its number where that takes 64 bits
};

// kFar: offsets in the pool need 64 bits.
template <class Voxel, bool kFar>
struct Packet {
  using Kernel = TraceRay<float, Voxel>;
  static constexpr int32_t kBytes = sizeof(Voxel);

  const Kernel& kernel;
  const Transfer<float> shader;
  const float stop_clear, hit_clear;
  const int32_t frame;
  const int64_t stride;  // bytes of a brick

  // Rays.
  Floats origin[3], direction[3], inverse[3], moved;
  PacketIntervals at;
  Mask alive;
  Ints wanted;

  // The last descent: a node of each level, below 0 (bit 31) where it is hidden.
  Ints cell[3];
  Ints path_depth;
  Ints path_node[kMostLevels], path_brick[kMostLevels], path_tile[kMostLevels];

  // The run of intervals that a lane is in.
  Ints left;
  Floats number, exit, cone_low, cone_high;
  Floats voxel, blend_scale;
  Ints rows;  // byte offset of the level's table
  Mask mixed;
  PacketBrick fine, coarse;
  Ints fine_node, coarse_node;

  // Accumulator.
  Floats red, green, blue;
  Floats clear, depth;
  Ints samples;
  Mask missed;

  // What packets are made for. Loads of 4 bytes may reach behind a voxel, but never behind the pool; places in a brick
  // are counted in a float.
  static bool takes(const Kernel& kernel) {
    const int64_t bytes = stride_of(kernel.bricks);
    return kernel.tree.digit_bits > 0 && kernel.bricks.bricks > 1 && bytes >= 4 && bytes < 1 << 24;
  }
  static int64_t stride_of(const BrickView<Voxel>& view) {
    return int64_t{kBytes} * view.side * view.side * view.side * view.channels;
  }

  explicit Packet(const Kernel& kernel)
      : kernel(kernel),
        shader(kernel.transfer),
        stop_clear(1 - kernel.options.stop_alpha),
        hit_clear(1 - kernel.options.depth_alpha),
        frame(*kernel.frame_1),
        stride(stride_of(kernel.bricks)) {
    path_depth = Ints{} - 1;
    for (int axis = 0; axis < 3; ++axis) cell[axis] = Ints{};
  }

  // Traces the rays at places begin to end of the order, at most kLanes.
  GV_HD void trace(int64_t begin, int64_t end) {
    int64_t numbers[kLanes];
    load(begin, end, numbers);
    while (any(alive)) {
      const Mask waiting = alive & (left == 0);
      if (any(waiting)) go_on(waiting);
      Mask marching = alive & (left > 0);
      const int32_t enough = count(alive) / 2 + 1;
      while (count(marching) >= enough) marching = march(marching);
    }
    store(numbers);
  }

 private:
  GV_HD void load(int64_t begin, int64_t end, int64_t* numbers) {
    alive = Mask{};
    left = wanted = samples = missed = rows = mixed = Ints{};
    red = green = blue = number = exit = cone_low = cone_high = voxel = blend_scale = moved = Floats{};
    clear = Floats{} + 1.0f;
    depth = Floats{} + INFINITY;
    fine.stored = coarse.stored = Mask{};
    fine.brick = coarse.brick = Ints{};
    fine.constant = coarse.constant = Floats{};
    at.step = kernel.options.step;
    at.top = kernel.transfer.levels - 1;
    at.near = at.growth = at.stop = at.start = at.base = at.count = Floats{};
    at.level = Ints{};
    at.length = Floats{} + at.step;
    at.shortness = 1.0f / at.length;
    for (int axis = 0; axis < 3; ++axis) {
      origin[axis] = direction[axis] = inverse[axis] = Floats{};
      fine.offset[axis] = fine.slope[axis] = coarse.offset[axis] = coarse.slope[axis] = Floats{};
    }
    for (int lane = 0; lane < kLanes; ++lane) {
      numbers[lane] = begin + lane < end ? kernel.order(begin + lane) : -1;
      if (numbers[lane] < 0) continue;
      const Ray<float> ray(kernel.rays, numbers[lane]);
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
      clear[lane] = static_cast<float>(kernel.rays.clear(numbers[lane]));
      alive[lane] = -1;
    }
    at.choose_level(alive);
    alive = alive & at.inside() & (clear > stop_clear);
  }

  GV_HD void store(const int64_t* numbers) const {
    for (int lane = 0; lane < kLanes; ++lane) {
      const int64_t ray = numbers[lane];
      if (ray < 0) continue;
      kernel.hits.color_r3[3 * ray] = red[lane];
      kernel.hits.color_r3[3 * ray + 1] = green[lane];
      kernel.hits.color_r3[3 * ray + 2] = blue[lane];
      kernel.hits.alpha_r1[ray] = 1 - clear[lane];
      kernel.hits.depth_r1[ray] = depth[lane] + moved[lane];
      kernel.hits.samples_r[ray] = samples[lane];
      kernel.hits.missed_r[ray] = missed[lane] != 0;
    }
  }

  // Lanes without a run: begins the next one in the same node, or visits the next node.
  GV_HD void go_on(Mask waiting) {
    const Mask ran = waiting & (number > at.count);
    at.go(ran, number);
    alive = alive & ~(waiting & ~(at.inside() & (clear > stop_clear)));
    const Mask again = ran & alive & at.stays(exit, cone_low, cone_high);
    Mask next = waiting & alive & ~again;
    if (any(again)) begin_run(again);
    if (any(next)) visit(next);
    alive = alive & ~(waiting & (left == 0) & ~(at.inside() & (clear > stop_clear)));
  }

  // Twin of TraceRay::visit.
  GV_HD void visit(Mask which) {
    const TreeView& tree = kernel.tree;
    const Levels<float>& levels = kernel.levels;
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
    Ints fine_depth = reach, fine_brick = brick;
    for (;;) {
      const Mask higher = which & (fine_depth > 0) & (fine_brick == kAbsent);
      if (!any(higher)) break;
      fine_depth = fine_depth + higher;
      fine_brick = higher ? own_lane(path_brick, fine_depth) : fine_brick;
    }
    Ints coarse_depth = fine_depth, coarse_brick = fine_brick;
    const Mask two = which & blend;
    if (any(two)) {
      for (;;) {
        const Mask higher = two & (coarse_depth > 0) & ((coarse_depth >= wanted) | (coarse_brick == kAbsent));
        if (!any(higher)) break;
        coarse_depth = coarse_depth + higher;
        coarse_brick = higher ? own_lane(path_brick, coarse_depth) : coarse_brick;
      }
      const Mask found = two & (coarse_depth < wanted) & (coarse_brick != kAbsent);
      coarse_depth = found ? coarse_depth : fine_depth;
      coarse_brick = found ? coarse_brick : fine_brick;
    }
    const Mask clears = hides & ((reach < wanted) | ~blend);
    Mask nothing = which & (clears | (fine_brick == kAbsent) | ((fine_brick == kEmpty) & (coarse_brick == kEmpty)));

    const Mask seen = which & ~clears;
    const Mask lacks =
        seen & ((brick == kAbsent) | ((reach < wanted) & (tile == kAbsent)) |
                (blend & (reach == wanted) & (own_lane(path_brick, larger(reach - 1, Ints{})) == kAbsent)));
    if (any(lacks)) {
      missed = missed | lacks;
      for_lanes(lacks, [&](int lane) {
        Place place;
        place.depth = reach[lane];
        place.node = node[lane] & INT32_MAX;
        place.parent = reach[lane] > 0 ? path_node[reach[lane] - 1][lane] & INT32_MAX : -1;
        place.brick = brick[lane];
        place.tile = tile[lane];
        if (fine_brick[lane] != kAbsent) place.fine.node = path_node[fine_depth[lane]][lane] & INT32_MAX;
        kernel.mark_missing(place, wanted[lane], blend[lane] != 0, cone[lane]);
      });
    }
    stamp(kernel.bricks.stamp_b, seen & (fine_brick >= 0), fine_brick);
    stamp(kernel.bricks.stamp_b, seen & (coarse_brick >= 0), coarse_brick);

    Mask runs = which & ~nothing;
    if (any(runs)) {
      const Mask differ = coarse_depth != fine_depth;
      mixed = runs ? differ : mixed;
      aim(runs, fine_depth, fine_brick, fine);
      const Mask both = runs & differ;
      if (any(both)) aim(both, coarse_depth, coarse_brick, coarse);
      const Mask flat = runs & ~fine.stored & (~differ | (~coarse.stored & (fine.constant == coarse.constant)));
      if (any(flat)) {
        const Floats entry = at.start;
        leave(flat);
        for_lanes(flat, [&](int lane) {
          const float end = smaller(at.start[lane], at.stop[lane]);
          Accumulator<float> sum = accumulator(lane);
          kernel.add_piece(shader, run_of(lane), fine.constant[lane], entry[lane], end, sum);
          put(lane, sum);
        });
        samples = samples - flat;
        runs = runs & ~flat;
      }
      if (any(runs)) begin_run(runs);
    }
    leave(nothing);
  }

  // Twin of `descend` in tree.h, level by level for all lanes: those whose known part of the path ends deeper wait.
  GV_HD void descend(Mask which, Floats middle, Ints& reach, Ints& node, Ints& brick, Ints& tile) {
    const TreeView& tree = kernel.tree;
    const int32_t top = tree.digit_bits * tree.max_depth;
    const float cells = static_cast<float>(1 << top);
    Ints parted{};
    for (int axis = 0; axis < 3; ++axis) {
      const float high = static_cast<float>(kernel.rays.place_33[6 + axis]) * 0.9999999f;
      const Floats place = clamp(origin[axis] + middle * direction[axis], Floats{}, Floats{} + high);
      const Ints here = which ? truncated(place * cells) : cell[axis];
      parted = parted | (cell[axis] ^ here);
      cell[axis] = here;
    }
    // The exponent of a number tells its highest bit; rounded up to a power of two it tells one level too few.
    const Ints high = ((Ints)to_floats(parted) >> 23) - 126;
    const Ints equal = truncated(to_floats(top - high) / static_cast<float>(tree.digit_bits));
    Ints known = parted == 0 ? path_depth : smaller(path_depth, equal);
    known = smaller(known, wanted);
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

  GV_HD Mask hidden(Mask here, Ints node) const {
    const Ints known = gather(kernel.hidden_tn, node) & 0xff;
    Mask hides = here & (known == kHidden);
    for_lanes(here & (known == kUnknown), [&](int lane) { hides[lane] = kernel.hides(shader, node[lane]) ? -1 : 0; });
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
    const Floats scale = pick(kernel.levels.scale, holder_depth);
    const Floats size = pick(kernel.levels.size, holder_depth);
    const Ints shift = kernel.tree.digit_bits * (kernel.tree.max_depth - holder_depth);
    const float first = static_cast<float>(kernel.bricks.border) - 0.5f;
    for (int axis = 0; axis < 3; ++axis) {
      const Floats corner = to_floats(cell[axis] >> shift) * size;
      const Floats offset = (origin[axis] - corner) * scale + first;
      const Floats slope = direction[axis] * scale;
      ray.offset[axis] = which ? (stored ? offset : Floats{}) : ray.offset[axis];
      ray.slope[axis] = which ? (stored ? slope : Floats{}) : ray.slope[axis];
    }
    ray.stored = which ? stored : ray.stored;
    ray.brick = which ? (stored ? (kFar ? brick : brick * static_cast<int32_t>(stride)) : Ints{}) : ray.brick;
    const BrickView<Voxel>& bricks = kernel.bricks;
    for_lanes(which & ~stored, [&](int lane) {
      const int64_t node = path_node[holder_depth[lane]][lane] & INT32_MAX;
      ray.constant[lane] = gvtorch::number<float>(bricks.constant_tnc[node * bricks.channels + bricks.component]);
    });
  }

  // Begins the run of intervals that are alike; lanes that need care are done with the node at once.
  GV_HD void begin_run(Mask which) {
    const int32_t last = static_cast<int32_t>((kernel.bricks.bricks - 1) * (kFar ? 1 : stride));
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
    rows = which ? at.level * (shader.rows * static_cast<int32_t>(sizeof(Row<float>))) : rows;
  }

  // One interval of all lanes that march; returns those whose run goes on. Nothing that leads to the next sample waits
  // for this one's colour: a lane that has seen enough marches on in vain to the end of its run.
  GV_HD Mask march(Mask which) {
    const Floats t = at.middle_of(number);
    const Floats begin = at.start_of(number);
    number = number - to_floats(which);
    left = left + which;
    Floats value = sample(fine, t);
    if (any(mixed & which)) {
      const Floats weight = clamp((at.cone(t) - voxel) * blend_scale, Floats{}, Floats{} + 1.0f);
      value = mixed ? value + weight * (sample(coarse, t) - value) : value;
    }
    const Floats place = clamp((value - shader.low) * shader.scale, Floats{}, Floats{} + shader.last);
    const Ints row = smaller(truncated(place), Ints{} + (shader.rows - 2));
    const Floats weight = place - to_floats(row);
    const Ints entry = rows + row * static_cast<int32_t>(sizeof(Row<float>));
    const Mask seeing = which & (clear > stop_clear);
    const Floats alpha = seeing ? column(entry, 3, weight) : Floats{};
    samples = samples - seeing;
    if (any(alpha > 0.0f)) {
      const Floats share = clear * alpha;
      const Floats rest = clear * (1.0f - alpha);
      red = red + share * column(entry, 0, weight);
      green = green + share * column(entry, 1, weight);
      blue = blue + share * column(entry, 2, weight);
      const Mask passed = (rest < hit_clear) & (clear >= hit_clear);
      if (any(passed))
        for_lanes(passed, [&](int lane) {
          depth[lane] = begin[lane] + accumulator(lane).reach(alpha[lane], hit_clear) * at.length[lane];
        });
      clear = rest;
    }
    return which & (left > 0);
  }

  // One number of the table, between two rows.
  GV_HD Floats column(Ints entry, int32_t which, Floats weight) const {
    const float* first = &shader.table_lm[0].red + which;
    const Floats a = (Floats)gather(first, entry);
    const Floats b = (Floats)gather(first + 4, entry);
    return a + weight * (b - a);
  }

  // Twin of `sample` in brick.h.
  GV_HD Floats sample(const PacketBrick& ray, Floats t) const {
    const BrickView<Voxel>& view = kernel.bricks;
    const int32_t step_x = view.channels * kBytes;
    const int32_t step_y = step_x * view.side;
    const int32_t step_z = step_y * view.side;
    const Floats last = Floats{} + static_cast<float>(view.side - 1);
    Floats cell[3], weight[3];
    for (int axis = 0; axis < 3; ++axis) {
      const Floats place = clamp(ray.offset[axis] + t * ray.slope[axis], Floats{}, last);
      cell[axis] = smaller(to_floats(truncated(place)), last - 1.0f);
      weight[axis] = place - cell[axis];
    }
    const Ints corner = truncated(cell[2] * static_cast<float>(step_z) + cell[1] * static_cast<float>(step_y) +
                                  cell[0] * static_cast<float>(step_x));
    Floats plane[2];
    for (int z = 0; z < 2; ++z) {
      const Floats near = sample_row(ray.brick, corner + z * step_z, step_x, weight[0]);
      const Floats behind = sample_row(ray.brick, corner + (z * step_z + step_y), step_x, weight[0]);
      plane[z] = near + weight[1] * (behind - near);
    }
    const Floats value = plane[0] + weight[2] * (plane[1] - plane[0]);
    return ray.stored ? value : ray.constant;
  }

  // Two neighbours along x, blended. One load serves both where they lie in 4 bytes.
  GV_HD Floats sample_row(Ints brick, Ints offset, int32_t step_x, Floats weight) const {
    const Ints word = load_words(brick, offset);
    Ints next;
    if (kBytes <= 2 && step_x == kBytes) {
      next = (word >> (8 * kBytes % 32)) & ((1 << (8 * kBytes % 32)) - 1);
    } else {
      next = load_words(brick, offset + step_x);
    }
    const Floats from = Unpack<Voxel>::low(word);
    return from + weight * (Unpack<Voxel>::low(next) - from);
  }

  GV_HD Ints load_words(Ints brick, Ints offset) const {
    const char* base = reinterpret_cast<const char*>(kernel.bricks.bricks_bzyxc + kernel.bricks.component);
    if (!kFar) return gather(base, brick + offset);
    Ints word;
    for (int lane = 0; lane < kLanes; ++lane) {
      int32_t one;
      memcpy(&one, base + brick[lane] * stride + offset[lane], 4);
      word[lane] = one;
    }
    return word;
  }

  // A lane as TraceRay's own structs.
  GV_HD Accumulator<float> accumulator(int lane) const {
    return {red[lane], green[lane], blue[lane], clear[lane], depth[lane], missed[lane] != 0};
  }
  GV_HD void put(int lane, const Accumulator<float>& sum) {
    red[lane] = sum.red;
    green[lane] = sum.green;
    blue[lane] = sum.blue;
    clear[lane] = sum.clear;
    depth[lane] = sum.depth;
  }
  GV_HD BrickRay<float, Voxel> brick_of(const PacketBrick& ray, int lane) const {
    BrickRay<float, Voxel> one;
    one.constant = ray.constant[lane];
    if (!ray.stored[lane]) return one;
    one.voxels = kernel.bricks.bricks_bzyxc + kernel.bricks.component + ray.brick[lane] * (kFar ? stride : 1) / kBytes;
    for (int axis = 0; axis < 3; ++axis) {
      one.offset[axis] = ray.offset[axis][lane];
      one.slope[axis] = ray.slope[axis][lane];
    }
    return one;
  }
  GV_HD Run<float, Voxel> run_of(int lane) const {
    return {brick_of(fine, lane),
            brick_of(coarse, lane),
            mixed[lane] != 0,
            voxel[lane],
            blend_scale[lane],
            stop_clear,
            hit_clear};
  }
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
    Accumulator<float> sum = accumulator(lane);
    Visit<float> visit;
    visit.exit = exit[lane];
    visit.cone_low = cone_low[lane];
    visit.cone_high = cone_high[lane];
    samples[lane] += kernel.march_node(shader, run_of(lane), visit, one, sum);
    at.level[lane] = one.level;
    at.base[lane] = one.base;
    at.length[lane] = one.length;
    at.shortness[lane] = one.shortness;
    at.count[lane] = one.count;
    at.start[lane] = one.start;
    number[lane] = one.count;
    put(lane, sum);
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
