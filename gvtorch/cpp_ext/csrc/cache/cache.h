// The cache's ops on bare words: what rays asked for becomes a list, nodes tell their places and whether they still
// lack what they asked for, slots are ordered by use, pointers to slots that change hands are cleared, new pointers are
// written.
//
// Equal to ops/reference/cache.py in every integer. What a device brings (cpu.cpp, cuda.cu):
//   for_each(n, body)     body(index)
//   compact(n, list)      list.flags(index) says whether an index is listed and whether it is touched at all, and
//                         list.put(index, rank) is called for those that are, ranks rising with the index,
//                         list.touch(index) for all that are touched, list.blank(rank) for every place left over,
//                         list.total(listed, seen) once
//   split(n, keep, put, kept)  put(index, rank) for all: those that keep accepts first, then the others
// Method: Crassin et al., "GigaVoxels", I3D 2009, section 5 (usage stamps, LRU by compaction, request lists).
#pragma once

#include "walk/tree.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Pending bits stand above the kind bits: asked for, answer not here yet. Such a request is not listed again.
constexpr int32_t kPendingShift = 2;
constexpr int32_t kKinds = kLoad | kSubdivide;
constexpr int32_t kPending = kKinds << kPendingShift;

GV_HD int32_t open_kinds(int32_t word) { return word & kKinds & ~(word >> kPendingShift); }

constexpr int32_t kListed = 1;   // it is to be put
constexpr int32_t kSeen = 2;     // it is only counted
constexpr int32_t kTouched = 4;  // it is to be touched

// Lists requests and clears them; what a full list has no place for is only counted.
struct ListRequests {
  int32_t* request_tn;
  int32_t* node_k;
  int32_t* word_k;
  int64_t* count_3;  // kept, found, requested
  int64_t capacity;

  GV_HD int32_t flags(int64_t node) const {
    const int32_t word = request_tn[node];
    return (open_kinds(word) != 0 ? kListed : 0) | ((word & kKinds) != 0 ? kSeen : 0) |
           ((word & ~kPending) != 0 ? kTouched : 0);
  }
  GV_HD void put(int64_t node, int64_t rank) const {
    if (rank >= capacity) return;
    const int32_t word = request_tn[node];
    node_k[rank] = static_cast<int32_t>(node);
    word_k[rank] = open_kinds(word) | (word & kPriorityMask);
  }
  GV_HD void touch(int64_t node) const { request_tn[node] &= kPending; }
  GV_HD int64_t places() const { return capacity; }
  GV_HD void blank(int64_t rank) const {
    node_k[rank] = -1;
    word_k[rank] = 0;
  }
  GV_HD void total(int64_t listed, int64_t seen) const {
    count_3[0] = smaller(listed, capacity);
    count_3[1] = listed;
    count_3[2] = seen;
  }
};

// Stamps as one bit a slot, eight to an index: the order of use visits slots at random, and bits fit near caches.
struct PackUse {
  const int32_t* stamp_s;
  int64_t slots;
  const int32_t* frame_1;
  uint8_t* bits;
  GV_HD void operator()(int64_t index) const {
    const int32_t frame = *frame_1;
    const int64_t first = 8 * index;
    const int64_t here = smaller<int64_t>(8, slots - first);
    int32_t word = 0;
    for (int64_t slot = 0; slot < here; ++slot) word |= (stamp_s[first + slot] == frame ? 1 : 0) << slot;
    bits[index] = static_cast<uint8_t>(word);
  }
};

struct FlagUse {
  const int32_t* order_k;
  const uint8_t* bits;
  uint64_t slots;
  uint8_t* used_k;
  GV_HD void operator()(int64_t index) const {
    const auto slot = static_cast<uint32_t>(order_k[index]);  // a negative one is out of range
    used_k[index] = slot < slots ? (bits[slot / 8] >> (slot % 8)) & 1 : 0;
  }
};

struct KeepUnused {
  const uint8_t* used_k;
  GV_HD bool operator()(int64_t index) const { return used_k[index] == 0; }
};

// The same from the stamps, for a device that reads at random without waiting.
struct KeepUnstamped {
  const int32_t* order_k;
  const int32_t* stamp_s;
  uint64_t slots;
  const int32_t* frame_1;
  GV_HD bool operator()(int64_t index) const {
    const auto slot = static_cast<uint32_t>(order_k[index]);
    return !(slot < slots && stamp_s[slot] == *frame_1);
  }
};

struct PutSlot {
  const int32_t* order_k;
  int32_t* out_k;
  GV_HD void operator()(int64_t index, int64_t rank) const { out_k[rank] = order_k[index]; }
};

struct MarkSlot {
  const int32_t* slot_k;
  uint8_t* leaving_s;
  int64_t slots;
  GV_HD void operator()(int64_t index) const {
    const int32_t slot = slot_k[index];
    if (slot >= 0 && slot < slots) leaving_s[slot] = 1;
  }
};

// A word names a slot when it is >= 0; `divisor` turns node indices into tiles.
struct ClearPointer {
  int32_t* pointer_m;
  const uint8_t* leaving_s;
  int64_t slots;
  int32_t divisor;
  GV_HD void operator()(int64_t index) const {
    const int32_t word = pointer_m[index];
    if (word >= 0 && word / divisor < slots && leaving_s[word / divisor]) pointer_m[index] = -1;
  }
};

// node_k names each node once; -1 is a place that is not taken.
struct WritePointer {
  int32_t* pointer_tn;
  int32_t* request_tn;
  const int32_t* node_k;
  const int32_t* word_k;
  int64_t nodes;
  int32_t kind;
  GV_HD void operator()(int64_t index) const {
    const int32_t node = node_k[index];
    if (node < 0 || node >= nodes) return;
    pointer_tn[node] = word_k[index];
    request_tn[node] &= ~(kind | (kind << kPendingShift));
  }
};

// Gives nodes the bricks in slots, which are theirs from now on.
struct LinkBrick {
  int32_t* brick_tn;
  int32_t* request_tn;
  int32_t* owner_b;
  int32_t* stamp_b;
  int32_t* born_b;
  bool* shared_b;
  const int64_t* node_k;
  const int32_t* slot_k;
  int64_t nodes, slots;
  int32_t frame;

  GV_HD void operator()(int64_t index) const {
    const int64_t node = node_k[index];
    const int32_t slot = slot_k[index];
    if (node < 0 || node >= nodes || slot < 0 || slot >= slots) return;
    owner_b[slot] = static_cast<int32_t>(node);
    stamp_b[slot] = frame;
    born_b[slot] = frame + 1;
    shared_b[slot] = false;
    brick_tn[node] = slot;
    request_tn[node] &= ~(kLoad | (kLoad << kPendingShift));
  }
};

// Writes tiles and hangs them below nodes: an index is a word of a tile. Words beyond those of the tree are TERMINAL
// and EMPTY. A node's own tile is not among those written.
struct LinkTile {
  int32_t* child_tn;
  int32_t* brick_tn;
  int32_t* request_tn;
  int32_t* loc_t4;
  int32_t* parent_t;
  int32_t* tree_t;
  int32_t* stamp_t;
  bool* shared_t;
  const int32_t* child_jw;
  const int32_t* brick_jw;
  const int64_t* node_j;
  const int64_t* loc_j4;
  const int64_t* row_k;
  const int32_t* tile_k;
  int64_t tiles, rows;
  int32_t per_tile, width, tree, frame;

  GV_HD void operator()(int64_t index) const {
    const int64_t which = index / per_tile;
    const auto child = static_cast<int32_t>(index - which * per_tile);
    const int64_t tile = tile_k[which];
    const int64_t row = row_k[which];
    if (tile < 0 || tile >= tiles || row < 0 || row >= rows) return;
    const int64_t node = node_j[row];
    if (node < 0 || node >= tiles * per_tile) return;
    const int64_t word = tile * per_tile + child;
    child_tn[word] = child < width ? child_jw[row * width + child] : kTerminal;
    brick_tn[word] = child < width ? brick_jw[row * width + child] : kEmpty;
    request_tn[word] = 0;
    if (child > 0) return;
    for (int32_t part = 0; part < 4; ++part) {
      loc_t4[4 * tile + part] = static_cast<int32_t>(loc_j4[4 * row + part]) + (part == 3 ? 1 : 0);
    }
    parent_t[tile] = static_cast<int32_t>(node);
    tree_t[tile] = tree;
    stamp_t[tile] = frame;
    shared_t[tile] = false;
    child_tn[node] = static_cast<int32_t>(tile);
    request_tn[node] &= ~(kSubdivide | (kSubdivide << kPendingShift));
  }
};

// Where nodes lie: x, y, z and depth of each, from those of its tile; -1 for an index that is no node's.
struct LocateNodes {
  const int32_t* loc_t4;
  const int64_t* node_k;
  int64_t* loc_k4;
  int64_t nodes;
  int32_t per_tile, branching;

  GV_HD void operator()(int64_t index) const {
    const int64_t node = node_k[index];
    for (int32_t part = 0; part < 4; ++part) loc_k4[4 * index + part] = at(node, part);
  }
  // x, y, z or depth.
  GV_HD int64_t at(int64_t node, int32_t part) const {
    if (node < 0 || node >= nodes) return -1;
    const int64_t tile = node / per_tile;
    const int64_t above = loc_t4[4 * tile + part];
    if (part == 3) return above;
    auto digit = static_cast<int32_t>(node - tile * per_tile);
    for (int32_t axis = 0; axis < part; ++axis) digit /= branching;
    return above * branching + digit % branching;
  }
};

// Which nodes still stand for the places that were asked for, reached from a parent or from an alias, and still have
// nothing there.
struct FindLacking {
  LocateNodes places;  // its loc_k4 is not written
  const int32_t* pointer_tn;
  const int32_t* parent_t;
  const int32_t* tree_t;
  const bool* shared_t;
  const int64_t* loc_k4;
  bool* lacks_k;
  int32_t tree;
  int64_t root;

  GV_HD void operator()(int64_t index) const {
    const int64_t node = places.node_k[index];
    bool lacks = node >= 0 && node < places.nodes;
    if (lacks) {
      const int64_t tile = node / places.per_tile;
      lacks = (parent_t[tile] >= 0 || shared_t[tile] || node == root) && tree_t[tile] == tree &&
              pointer_tn[node] == kAbsent;
      for (int32_t part = 0; part < 4; ++part) lacks = lacks && places.at(node, part) == loc_k4[4 * index + part];
    }
    lacks_k[index] = lacks;
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
