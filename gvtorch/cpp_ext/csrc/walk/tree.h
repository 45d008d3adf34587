// The N3 tree as kernels see it: borrowed pointers into the node pool, and the descent from the root to the
// node that a sample needs.
//
// A node tile is N*N*N sibling nodes; node = tile * nodes_per_tile + child, child = (z * N + y) * N + x. The root
// node is child 0 of a tile of its own. Trees of several N share a pool: its tiles are as wide as the widest. Words of
// a node (GigaVoxels keeps two: Crassin et al., I3D 2009, section 4.1):
//
//   child_tn    >= 0 tile of its children | kAbsent: not made yet | kTerminal: nothing finer exists
//   brick_tn    >= 0 brick slot | kAbsent: not loaded yet | kEmpty | kConstant: one value, see constant_tnc
//   request_tn  what rays ask for, see post_request in hd.h
//
// Tree units: the root is the cube [0,1]^3. A descent that restarts from the root needs no stack (Horn et al.,
// "Interactive k-d tree GPU raytracing", I3D 2007, kd-restart; Crassin, PhD thesis 2011, 6.1).
#pragma once

#include "base/arithmetic.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

constexpr int32_t kAbsent = -1;
constexpr int32_t kTerminal = -2;
constexpr int32_t kEmpty = -2;
constexpr int32_t kConstant = -3;
constexpr int32_t kMostLevels = 63;

// Numbers of each depth, divided down from the root's.
template <class T>
struct Levels {
  T voxel[kMostLevels];  // world size of a voxel
  T size[kMostLevels];   // tree units: a node's box
  T scale[kMostLevels];  // voxels a tree unit

  Levels(T root_voxel, T brick, int32_t branching) {
    voxel[0] = root_voxel;
    size[0] = 1;
    for (int32_t depth = 0; depth < kMostLevels; ++depth) {
      if (depth > 0) voxel[depth] = voxel[depth - 1] / static_cast<T>(branching);
      if (depth > 0) size[depth] = size[depth - 1] / static_cast<T>(branching);
      scale[depth] = brick / size[depth];
    }
  }
};

struct TreeView {
  const int32_t* child_tn;
  const int32_t* brick_tn;
  int32_t* request_tn;
  int32_t* stamp_t;
  int32_t root, root_tile;
  int32_t branching;  // N
  int32_t nodes_per_tile;
  int32_t max_depth;
  int32_t digit_bits;  // where N is a power of two and all digits of a place fit a word, else 0
};

inline int32_t digit_bits_of(int32_t branching, int32_t max_depth) {
  const int32_t bits = branching == 2 ? 1 : branching == 4 ? 2 : branching == 8 ? 3 : branching == 16 ? 4 : 0;
  return bits * max_depth <= 30 ? bits : 0;
}

// A node whose brick answers for a place. node < 0: nobody answers.
struct Holder {
  int32_t node = -1;
  int32_t brick = kAbsent;
  int32_t depth = 0;
};

// Where a descent ended: the wanted level's holder and the holder of the level above it (they blend), and what a
// request may name. The same descent ends in the same node all over the node's box.
struct Place {
  int32_t node = -1;
  int32_t parent = -1;
  int32_t depth = 0;
  int32_t brick = kAbsent;  // words of the node
  int32_t tile = kAbsent;
  bool hidden = false;  // nothing in the node or below it is seen
  Holder fine;
  Holder coarse;
};

// The digits of a place in base N, from the root down. Any N: each digit from what the one above left over.
template <class T>
struct Digits {
  Vec3<T> position, local;
  int32_t branching;

  GV_HD Digits(const TreeView& tree, Vec3<T> position)
      : position(position), local(position), branching(tree.branching) {}
  GV_HD int32_t step(Vec3<T>& left, int axis) const {
    const T scaled = left[axis] * static_cast<T>(branching);
    const int32_t digit = clamp(floor_int(scaled), 0, branching - 1);
    left[axis] = scaled - static_cast<T>(digit);
    return digit;
  }
  // Which child of the node at level - 1; asked for level after level.
  GV_HD int32_t child(int32_t) {
    const int32_t z = step(local, 2), y = step(local, 1), x = step(local, 0);
    return (z * branching + y) * branching + x;
  }
  // Low corner of the node at a level.
  GV_HD Vec3<T> corner(int32_t level, const Levels<T>& levels) const {
    Vec3<T> left = position;
    Vec3<T> sum{0, 0, 0};
    for (int32_t depth = 1; depth <= level; ++depth) {
      for (int axis = 0; axis < 3; ++axis) {
        sum[axis] = sum[axis] + static_cast<T>(step(left, axis)) * levels.size[depth];
      }
    }
    return sum;
  }
};

// N a power of two: all digits are the bits of one number, and every corner is exact.
template <class T>
struct BitDigits {
  Vec3<int32_t> cell;
  int32_t bits, top;

  GV_HD BitDigits(const TreeView& tree, Vec3<T> position)
      : bits(tree.digit_bits), top(tree.digit_bits * tree.max_depth) {
    const T cells = static_cast<T>(1 << top);
    for (int axis = 0; axis < 3; ++axis) cell[axis] = static_cast<int32_t>(position[axis] * cells);
  }
  GV_HD int32_t child(int32_t level) const {
    const int32_t shift = top - level * bits;
    const int32_t mask = (1 << bits) - 1;
    const int32_t y = (cell.y >> shift) & mask;
    return (((cell.z >> shift) & mask) << (2 * bits)) | (y << bits) | ((cell.x >> shift) & mask);
  }
  GV_HD Vec3<T> corner(int32_t level, const Levels<T>& levels) const {
    const int32_t shift = top - level * bits;
    const T size = levels.size[level];
    return {static_cast<T>(cell.x >> shift) * size, static_cast<T>(cell.y >> shift) * size,
            static_cast<T>(cell.z >> shift) * size};
  }
};

// Descends to `wanted` depth, or as far as tiles exist and something is seen; stamps every tile on the way.
// The coarse holder is looked for where two levels blend.
template <class Number, class Hides>
GV_HD Place descend(const TreeView& tree, Number& digits, int32_t wanted, bool blend, int32_t frame,
                    const Hides& hides) {
  Place place;
  place.node = tree.root;
  int32_t own_tile = tree.root_tile;  // of the node
  for (;;) {
    store_stamp(&tree.stamp_t[own_tile], frame);
    place.brick = tree.brick_tn[place.node];
    place.tile = tree.child_tn[place.node];
    place.hidden = hides(place.node);
    if (place.brick != kAbsent) {
      if (blend && place.depth < wanted) place.coarse = {place.node, place.brick, place.depth};
      place.fine = {place.node, place.brick, place.depth};
    }
    if (place.depth == wanted || place.tile < 0 || place.hidden) return place;
    place.depth = place.depth + 1;
    place.parent = place.node;
    own_tile = place.tile;
    place.node = own_tile * tree.nodes_per_tile + digits.child(place.depth);
  }
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
