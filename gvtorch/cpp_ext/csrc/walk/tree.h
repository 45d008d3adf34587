// The N3 tree as kernels see it: borrowed pointers into the node pool, and the descent from the root to the
// node that a sample needs.
//
// A node tile is N*N*N sibling nodes; node = tile * nodes_per_tile + child, child = (z * N + y) * N + x. The root
// node is child 0 of a tile of its own. Trees of different N may share a pool: its tiles have room for the largest N.
// Words of a node (GigaVoxels stores two: Crassin et al., I3D 2009, section 4.1):
//
//   child_tn    >= 0 tile of its children | kAbsent: not made yet | kTerminal: nothing finer exists
//   brick_tn    >= 0 brick slot | kAbsent: not loaded yet | kEmpty | kConstant: one value, see constant_tnc
//   request_tn  what rays request, see post_request in hd.h; null where nobody reads it
//
// Tree units: the root is the cube [0,1]^3. float32 holds the corners of nodes exactly where N is a power of two and
// the root is at most kMaxShallowVoxels wide; other trees are *deep*: their positions are float64. A descent that
// restarts from the root needs no stack (Horn et al., "Interactive k-d tree GPU raytracing", I3D 2007, kd-restart;
// Crassin, PhD thesis 2011, 6.1).
#pragma once

#include <type_traits>

#include "base/arguments.h"
#include "walk/ray.h"

namespace gvtorch::GV_NAMESPACE {

constexpr int32_t kAbsent = -1;
constexpr int32_t kTerminal = -2;
constexpr int32_t kEmpty = -2;
constexpr int32_t kConstant = -3;
constexpr int32_t kConcealed = -3;  // instead of a tile: nothing in the node or below it is visible
constexpr int32_t kMaxLevels = 63;
constexpr double kMaxShallowVoxels = 1 << 18;
constexpr double kMaxNodes = 1LL << 50;  // along a side of the root cube: float64 counts them

// Constants of each depth.
template <class T>
struct Levels {
  T voxel[kMaxLevels];            // world size of a voxel
  T scale[kMaxLevels];            // voxels per tree unit
  T size[kMaxLevels];             // tree units: side of a node's box
  double exact_size[kMaxLevels];  // the same in float64
  double count[kMaxLevels];       // nodes along a side of the root cube

  Levels(double root_voxel, double brick, int32_t branching) {
    double nodes = 1;
    for (int32_t depth = 0; depth < kMaxLevels; ++depth) {
      voxel[depth] = static_cast<T>(root_voxel / nodes);
      scale[depth] = static_cast<T>(brick * nodes);
      exact_size[depth] = 1 / nodes;
      size[depth] = static_cast<T>(exact_size[depth]);
      count[depth] = nodes;
      nodes *= branching;
    }
  }
};

// The words of a node that a ray reads, in one load.
struct alignas(8) NodeWords {
  int32_t brick, tile;
};

struct TreeView {
  const int32_t* child_tn;
  const int32_t* brick_tn;
  int16_t* request_tn;
  int32_t* stamp_t;
  int32_t root, root_tile;
  int32_t branching;  // N
  int32_t nodes_per_tile;
  int32_t max_depth;
  int32_t digit_bits;  // log2(N); 0: N is no power of two
  int32_t tiles, bricks;

  // Words of a node. An index beyond its pool counts as absent, so that no word, whoever wrote it, leads out of the
  // pools.
  GV_HD int32_t tile_of(int32_t node) const { return checked_word(child_tn[node], tiles); }
  GV_HD int32_t brick_of(int32_t node) const { return checked_word(brick_tn[node], bricks); }
  GV_HD NodeWords words_of(int32_t node, bool hidden) const {
    return {brick_of(node), hidden ? kConcealed : larger(tile_of(node), kTerminal)};  // never kConcealed by itself
  }
  GV_HD static int32_t checked_word(int32_t word, int32_t count) { return word < count ? word : kAbsent; }
};

inline int32_t digit_bits_of(int64_t branching) {
  int32_t bits = 1;
  while (int64_t{1} << bits < branching) ++bits;
  return int64_t{1} << bits == branching ? bits : 0;
}
inline bool is_deep(const TraceArgs& args) {
  double voxels = args.side - 2 * args.border;
  for (int32_t depth = 0; depth < args.max_depth; ++depth) voxels *= args.branching;
  return digit_bits_of(args.branching) == 0 || voxels > kMaxShallowVoxels;
}

// A node whose brick is read at a position. node < 0: there is none.
struct Holder {
  int32_t node = -1;
  int32_t brick = kAbsent;
  int32_t depth = 0;
};

// Result of a descent: the holders of the wanted level and of the level above it, which blend, and what requests refer
// to. From every position in the node's box, the descent ends in the same node.
struct Descent {
  int32_t node = -1;
  int32_t parent = -1;
  int32_t depth = 0;
  int32_t brick = kAbsent;  // words of the node
  int32_t tile = kAbsent;
  bool hidden = false;  // nothing in the node or below it is visible
  Holder fine;
  Holder coarse;
};

// The nodes around the position at distance t of a ray, from the base-N digits of its finest node's number. `child`,
// called for one level after the other, returns which child of the node above it is; `face`, the offset of the node's
// lower or upper face from the ray's origin.
//
// This one is for any tree, in float64.
template <class T>
struct Digits {
  static constexpr bool kDeep = true;  // where RayView::deep is set
  const Levels<T>& levels;
  Vec3<double> origin;
  Vec3<int64_t> cell;                  // number of the node at the finest level, below 2^51
  Vec3<int64_t> parent_cell{0, 0, 0};  // number of the node above the next child, at its level
  int32_t branching, bits, max_depth;

  GV_HD Digits(const TreeView& tree, const Levels<T>& levels, const RayView& rays, const Ray<T>& ray, T t)
      : levels(levels), branching(tree.branching), bits(tree.digit_bits), max_depth(tree.max_depth) {
    const Vec3<double> position = ray.along(t, rays.deep);
    for (int axis = 0; axis < 3; ++axis) {
      const double high = rays.deep ? upper_bound_of(rays, axis) : static_cast<double>(ray.upper_bound[axis]);
      origin[axis] = ray.exact_origin(axis);
      cell[axis] = cell_at(levels, max_depth, position[axis], high);
    }
  }
  GV_HD Digits(const TreeView& tree, const Levels<T>& levels, Vec3<double> origin, Vec3<int64_t> cell)
      : levels(levels),
        origin(origin),
        cell(cell),
        branching(tree.branching),
        bits(tree.digit_bits),
        max_depth(tree.max_depth) {}

  // Largest position in the scene along an axis, where the tree is deep.
  GV_HD static double upper_bound_of(const RayView& rays, int axis) {
    return rays.high(axis) * (1 - 8.8817841970012523e-16);  // 2^-50
  }
  GV_HD static int64_t cell_at(const Levels<T>& levels, int32_t max_depth, double position, double high) {
    return static_cast<int64_t>(clamp(position, 0.0, high) * levels.count[max_depth]);
  }
  // True if both positions lie in the same node of a level.
  GV_HD bool in_same_node(const Digits& other, int32_t level) const {
    bool same = true;
    for (int axis = 0; axis < 3; ++axis) same = same && cell_of(axis, level) == other.cell_of(axis, level);
    return same;
  }
  // Makes the next `child` a child of the node of this level.
  GV_HD void start_below(int32_t level) {
    for (int axis = 0; axis < 3; ++axis) parent_cell[axis] = cell_of(axis, level);
  }
  GV_HD int32_t child(int32_t level) {
    Vec3<int32_t> digit;
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t level_cell = cell_of(axis, level);
      digit[axis] =
          static_cast<int32_t>(bits > 0 ? level_cell & ((1 << bits) - 1) : level_cell - parent_cell[axis] * branching);
      parent_cell[axis] = level_cell;
    }
    return (digit.z * branching + digit.y) * branching + digit.x;
  }
  GV_HD T face(int axis, int32_t level, bool upper) const {
    return static_cast<T>(static_cast<double>(cell_of(axis, level) + upper) * levels.exact_size[level] - origin[axis]);
  }

 private:
  // Divides by a power of N; where that is no shift, by a product that may be off by one and is corrected.
  GV_HD int64_t cell_of(int axis, int32_t level) const {
    if (bits > 0) return cell[axis] >> (max_depth - level) * bits;
    const auto cells_per_node = static_cast<int64_t>(levels.count[max_depth - level]);
    const auto quotient = static_cast<int64_t>(static_cast<double>(cell[axis]) * levels.exact_size[max_depth - level]);
    const int64_t remainder = cell[axis] - quotient * cells_per_node;
    return remainder < 0 ? quotient - 1 : remainder < cells_per_node ? quotient : quotient + 1;
  }
};

// For trees that are not deep: digits are the bits of one number, and float32 holds every corner exactly.
struct BitDigits {
  static constexpr bool kDeep = false;
  const Levels<float>& levels;
  Vec3<float> origin;
  Vec3<int32_t> cell;
  int32_t bits, top;

  GV_HD BitDigits(const TreeView& tree, const Levels<float>& levels, const RayView&, const Ray<float>& ray, float t)
      : levels(levels), origin(ray.origin), bits(tree.digit_bits), top(tree.digit_bits * tree.max_depth) {
    const Vec3<float> position = ray.at(t);
    const float cells = static_cast<float>(1 << top);
    for (int axis = 0; axis < 3; ++axis) cell[axis] = static_cast<int32_t>(position[axis] * cells);
  }
  GV_HD int32_t child(int32_t level) const {
    const int32_t shift = top - level * bits;
    const int32_t mask = (1 << bits) - 1;
    const int32_t y = (cell.y >> shift) & mask;
    return (((cell.z >> shift) & mask) << (2 * bits)) | (y << bits) | ((cell.x >> shift) & mask);
  }
  GV_HD float face(int axis, int32_t level, bool upper) const {
    return static_cast<float>((cell[axis] >> (top - level * bits)) + upper) * levels.size[level] - origin[axis];
  }
};

// Returns body of a null pointer to the type of digits for rays of T in a tree; the type can't be default-constructed.
template <class T, class Body>
auto with_digits(const TraceArgs& args, const Body& body) {
  if constexpr (std::is_same_v<T, float>) {
    if (!is_deep(args)) return body(static_cast<BitDigits*>(nullptr));
  }
  return body(static_cast<Digits<T>*>(nullptr));
}

// Descends to `wanted` depth, or as far as tiles exist and something is visible; stamps every tile on the way.
// The coarse holder is set where two levels blend. read_words(node) returns the node's NodeWords.
template <class AnyDigits, class ReadWords>
GV_HD Descent descend(const TreeView& tree, AnyDigits& digits, int32_t wanted, bool blend, int32_t frame,
                      const ReadWords& read_words) {
  Descent descent;
  descent.node = tree.root;
  int32_t holding_tile = tree.root_tile;  // the tile that holds the node
  for (;;) {
    const NodeWords node_words = read_words(descent.node);
    store_stamp(&tree.stamp_t[holding_tile], frame);
    descent.brick = node_words.brick;
    descent.tile = node_words.tile;
    descent.hidden = node_words.tile == kConcealed;
    if (descent.brick != kAbsent) {
      if (blend && descent.depth < wanted) descent.coarse = {descent.node, descent.brick, descent.depth};
      descent.fine = {descent.node, descent.brick, descent.depth};
    }
    if (descent.depth == wanted || descent.tile < 0 || descent.hidden) return descent;
    descent.depth = descent.depth + 1;
    descent.parent = descent.node;
    holding_tile = descent.tile;
    descent.node = holding_tile * tree.nodes_per_tile + digits.child(descent.depth);
  }
}

}  // namespace gvtorch::GV_NAMESPACE
