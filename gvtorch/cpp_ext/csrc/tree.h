// The N3 tree as kernels see it: borrowed pointers into the node pool, and the descent from the root to the
// node that a sample needs.
//
// A node tile is N*N*N sibling nodes; node = tile * nodes_per_tile + child, child = (z * N + y) * N + x. The root
// node is child 0 of a tile of its own. Trees of several N share a pool: its tiles are as wide as the widest. Words of
// a node (GigaVoxels keeps two: Crassin et al., I3D 2009, section 4.1):
//
//   child_tn    >= 0 tile of its children | kAbsent: not made yet | kTerminal: nothing finer exists
//   brick_tn    >= 0 brick slot | kAbsent: not loaded yet | kEmpty | kConstant: one value, see constant_tnc
//   request_tn  what rays wish for it, see post_request in hd.h
//
// Tree units: the root is the cube [0,1]^3. Restarting from the root for every node needs no stack
// (Horn et al., "Interactive k-d tree GPU raytracing", I3D 2007, kd-restart; Crassin, PhD thesis 2011, 6.1).
#pragma once

#include "hd.h"

namespace gvtorch {

constexpr int32_t kAbsent = -1;
constexpr int32_t kTerminal = -2;
constexpr int32_t kEmpty = -2;
constexpr int32_t kConstant = -3;

struct TreeView {
  const int32_t* child_tn;
  const int32_t* brick_tn;
  int32_t* request_tn;
  int32_t* stamp_t;
  int64_t root;
  int32_t branching;  // N
  int32_t nodes_per_tile;
  int32_t max_depth;
};

// A node whose brick answers for a place, and its box in tree units. node < 0: nobody answers.
template <class T>
struct Holder {
  int64_t node = -1;
  int32_t brick = kAbsent;
  Vec3<T> corner{0, 0, 0};
  T size = 1;
};

// Where a descent ended: the box in which the same descent gives the same answer, the wanted level's holder and
// the holder of the level above it (they blend), and the node indices a request may name.
template <class T>
struct Place {
  Vec3<T> corner{0, 0, 0};
  T size = 1;
  int32_t depth = 0;
  int64_t node = -1;
  int64_t parent = -1;
  Holder<T> fine;
  Holder<T> coarse;
};

// Descends to `wanted` depth or as far as tiles exist; stamps every tile on the way with `frame`.
template <class T>
GV_HD Place<T> descend(const TreeView& tree, Vec3<T> position, int32_t wanted, int32_t frame) {
  const T branching = static_cast<T>(tree.branching);
  Place<T> place;
  place.node = tree.root;
  Vec3<T> local = position;
  for (;;) {
    store_stamp(&tree.stamp_t[place.node / tree.nodes_per_tile], frame);
    const int32_t brick = tree.brick_tn[place.node];
    if (brick != kAbsent) {
      place.fine = Holder<T>{place.node, brick, place.corner, place.size};
      if (place.depth < wanted) place.coarse = place.fine;
    }
    const int32_t tile = tree.child_tn[place.node];
    if (place.depth == wanted || tile < 0) return place;

    place.size = place.size / branching;
    int64_t child = 0;
    for (int axis = 2; axis >= 0; --axis) {
      const T scaled = local[axis] * branching;
      const int32_t whole = clamp(floor_int(scaled), 0, tree.branching - 1);
      const T digit = static_cast<T>(whole);
      local[axis] = scaled - digit;
      place.corner[axis] = place.corner[axis] + digit * place.size;
      child = child * tree.branching + whole;
    }
    place.parent = place.node;
    place.node = static_cast<int64_t>(tile) * tree.nodes_per_tile + child;
    place.depth = place.depth + 1;
  }
}

}  // namespace gvtorch
