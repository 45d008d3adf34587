// The cache's ops on plain words: list the requests of rays and choose which are served, order slots by use, clear
// pointers to slots that change hands, write new pointers, find the locs of nodes and whether these still lack what
// they requested, and cut bricks out of a level. Each op's arguments are declared before its functors, see arguments.h.
//
// Equal to the twins in ops/cache.py in every integer. What each device defines (cpu.cpp, cuda.cu):
//   compact(n, list)   list.flags(index) returns which of kListed, kCounted and kTouched each index is
//                      list.process(index, flags, rank, listed)  is called for every touched index, as listed and
//                                                                counted ones are. rank: how many listed indices
//                                                                precede it; listed: how many there are
//                      list.clear_entry(rank)                    is called for every unused one of list.entries()
//                      list.store_totals(listed, counted)        is called once
//   sort_keys(keys, n) sorts n numbers in ascending order
// Method: Crassin et al., "GigaVoxels", I3D 2009, section 5 (usage stamps, LRU by compaction, request lists).
#pragma once

#include <cstring>

#include "base/arguments.h"
#include "walk/tree.h"

namespace gvtorch::GV_NAMESPACE {

constexpr int32_t kListed = 1, kCounted = 2, kTouched = 4;

// How many indices are listed, and counted; `any_flags` is not 0 if one has a flag.
struct Counts {
  int32_t listed, counted, any_flags;

  GV_HD void add(int32_t flags) {
    listed += flags & kListed;
    counted += (flags & kCounted) / kCounted;
    any_flags |= flags;
  }
  GV_HD Counts operator+(const Counts& other) const {
    return {listed + other.listed, counted + other.counted, any_flags + other.any_flags};
  }
};

// --- Requests

// Pending bits are above the kind bits: requested, and the answer not written yet. Such a request is not listed again.
constexpr int32_t kPendingShift = 2;
constexpr int32_t kKinds = kLoad | kSubdivide;
constexpr int32_t kPending = kKinds << kPendingShift;

GV_HD int32_t open_kinds(int32_t word) { return word & kKinds & ~(word >> kPendingShift); }
// Clears a request that has been answered.
GV_HD void clear_request(int16_t& word, int32_t kind) { word &= ~(kind | (kind << kPendingShift)); }

#define GV_COMPACT_REQUESTS(X) X(Requests<'a'>, request_tn, kAny) X(Int, capacity, kAny)

// Lists requests and clears them; those beyond the capacity of the list are only counted.
struct ListRequests {
  GV_COMPACT_REQUESTS(GV_VIEW)
  int32_t *node_k, *word_k;
  int64_t* count_5;  // kept, found, requested; loads among those kept, and subdivisions

  GV_HD int32_t flags(int64_t node) const {
    const int32_t word = request_tn[node];
    return (open_kinds(word) != 0 ? kListed : 0) | ((word & kKinds) != 0 ? kCounted : 0) |
           ((word & ~kPending) != 0 ? kTouched : 0);
  }
  GV_HD void process(int64_t node, int32_t flags, int64_t rank, int64_t) const {
    if ((flags & kListed) != 0 && rank < capacity) {
      const int32_t word = request_tn[node];
      node_k[rank] = static_cast<int32_t>(node);
      word_k[rank] = open_kinds(word) | (word & kPriorityMask);
      if ((word_k[rank] & kLoad) != 0) add_to<int64_t>(&count_5[3], 1);
      if ((word_k[rank] & kSubdivide) != 0) add_to<int64_t>(&count_5[4], 1);
    }
    request_tn[node] &= kPending;
  }
  GV_HD int64_t entries() const { return capacity; }
  GV_HD void clear_entry(int64_t rank) const {
    node_k[rank] = -1;
    word_k[rank] = 0;
  }
  GV_HD void store_totals(int64_t listed, int64_t counted) const {
    count_5[0] = smaller<int64_t>(listed, capacity);
    count_5[1] = listed;
    count_5[2] = counted;
  }
};

#define GV_CHOOSE_REQUESTS(X)                       \
  X(Words, asked_l2k, 2 * args.lists * args.listed) \
  X(Words, loc_t4, 4 * args.tiles)                  \
  X(Longs, room_2, 2)                               \
  X(Int, per_tile, kAny)                            \
  X(Int, batch, kAny)                               \
  X(Bool, coarse_first, kAny)

constexpr int64_t kNoKey = INT64_MAX;      // not a request of a node of the pool
constexpr int64_t kComparers = 16;         // threads that share the comparisons of a request
constexpr int64_t kMaxCompared = 1 << 15;  // longer lists are sorted
constexpr int64_t kIndices = int64_t{1} << 31;

struct ChooseArgs {
  GV_CHOOSE_REQUESTS(GV_VIEW)
  int64_t lists, listed, tiles;
  int64_t* key_lk;              // rank, index in the lists, and two bits of kinds: lower keys are served first
  int32_t *end_l, *before_2lk;  // end of each list's requests; how many loads, and subdivisions, have lower keys
  int64_t* node_2b;             // loads, then subdivisions
  int32_t* priority_2b;

  GV_HD int64_t node_at(int64_t index) const { return asked_l2k[index + index / listed * listed]; }
  GV_HD int32_t word_at(int64_t index) const { return asked_l2k[index + (index / listed + 1) * listed]; }
  // Serves a request as a load (`kind` 0) or a subdivision (1) if the `rank` ones before it leave room.
  GV_HD void serve(int64_t kind, int64_t rank, int64_t index) const {
    const int64_t room = room_2[1 - kind];  // tiles, bricks
    if (rank >= smaller<int64_t>(batch, room)) return;
    node_2b[kind * batch + rank] = node_at(index);
    priority_2b[kind * batch + rank] = word_at(index) & kPriorityMask;
  }
};

// Computes the keys of requests, and clears the outputs.
struct RankRequests : ChooseArgs {
  GV_HD void operator()(int64_t index) const {
    if (index < int64_t{2} * batch) {
      node_2b[index] = -1;
      priority_2b[index] = 0;
    }
    if (index >= lists * listed) return;
    const int64_t node = node_at(index), list = index / listed;
    const int32_t word = word_at(index);
    key_lk[index] = kNoKey;
    if (node < 0 || node >= tiles * per_tile || (word & kKinds) == 0) return;
    const int64_t depth = loc_t4[4 * (node / per_tile) + 3];
    const int32_t inverse_priority = kPriorityMask - (word & kPriorityMask);
    const int64_t rank = (list << 20) + (coarse_first ? depth : -depth) * (kPriorityMask + 1) + inverse_priority;
    key_lk[index] = (rank * kIndices + index) * 4 + (word & kKinds) / kLoad;
    raise_to(&end_l[list], static_cast<int32_t>(index % listed + 1));
  }
};

// Counts the requests with lower keys than each. An index is a request and one of the kComparers threads that share it,
// each of which compares every kComparers-th of the others. Most frames have some hundred requests: comparing each with
// each costs less than sorting lists of full capacity.
struct CompareRequests : ChooseArgs {
  GV_HD void operator()(int64_t number) const {
    const int64_t index = number % (lists * listed), first = number / (lists * listed);
    const int64_t own_key = key_lk[index];
    if (own_key == kNoKey) return;
    int32_t loads = 0, subdivisions = 0;
    for (int64_t list = 0; list < lists; ++list) {
      const int64_t* const key_k = key_lk + list * listed;
      const int32_t end = end_l[list];
      for (auto other = static_cast<int32_t>(first); other < end; other += kComparers) {
        const int64_t key = key_k[other];
        if (key >= own_key) continue;
        loads += static_cast<int32_t>(key & 1);
        subdivisions += static_cast<int32_t>(key >> 1 & 1);
      }
    }
    if (loads > 0) add_to(&before_2lk[index], loads);
    if (subdivisions > 0) add_to(&before_2lk[lists * listed + index], subdivisions);
  }
};

struct ServeRequests : ChooseArgs {
  GV_HD void operator()(int64_t index) const {
    if (key_lk[index] == kNoKey) return;
    for (int64_t kind = 0; kind < 2; ++kind) {
      if ((key_lk[index] >> kind & 1) != 0) serve(kind, before_2lk[kind * lists * listed + index], index);
    }
  }
};

// ServeRequests for sorted keys, for loads or for subdivisions; see `compact`.
struct ServeSorted : ChooseArgs {
  int64_t kind;

  GV_HD int32_t flags(int64_t index) const {
    const int64_t key = key_lk[index];
    return key != kNoKey && (key >> kind & 1) != 0 ? kListed | kTouched : 0;
  }
  GV_HD void process(int64_t index, int32_t, int64_t rank, int64_t) const {
    serve(kind, rank, (key_lk[index] >> 2) & (kIndices - 1));
  }
  GV_HD int64_t entries() const { return 0; }
  GV_HD void clear_entry(int64_t) const {}
  GV_HD void store_totals(int64_t, int64_t) const {}
};

// --- The order of use

#define GV_LRU_PARTITION(X) X(Words, order_k, kAny) X(Words, stamp_s, kAny) X(Words, frame_1, 1)

struct UseArgs {
  GV_LRU_PARTITION(GV_VIEW)
  int64_t slots;
  uint8_t *used_s, *used_k;  // a bit per slot; a byte per entry of the order
  int32_t* sorted_k;
  int64_t* unused_1;
};

// Packs stamps to a bit per slot, eight per index: the order of use reads slots at random, and bits fit near caches.
struct PackUse : UseArgs {
  GV_HD void operator()(int64_t index) const {
    const int32_t frame = *frame_1;
    const int64_t first = 8 * index;
    const int64_t count = smaller<int64_t>(8, slots - first);
    int32_t bits = 0;
    for (int64_t slot = 0; slot < count; ++slot) bits |= (stamp_s[first + slot] == frame ? 1 : 0) << slot;
    used_s[index] = static_cast<uint8_t>(bits);
  }
};

struct FlagUse : UseArgs {
  GV_HD void operator()(int64_t index) const {
    const auto slot = static_cast<uint32_t>(order_k[index]);  // a negative one is out of range
    used_k[index] = slot < slots ? (used_s[slot / 8] >> (slot % 8)) & 1 : 0;
  }
};

// Moves slots that the frame did not use before the others. kFromStamps: stamps are read, on a device where random
// reads cost little; else FlagUse has run.
template <bool kFromStamps>
struct SplitByUse : UseArgs {
  GV_HD bool used(int64_t index) const {
    if constexpr (!kFromStamps) return used_k[index] != 0;
    const auto slot = static_cast<uint32_t>(order_k[index]);
    return slot < slots && stamp_s[slot] == *frame_1;
  }
  GV_HD int32_t flags(int64_t index) const { return kTouched | static_cast<int32_t>(!used(index)); }
  GV_HD void process(int64_t index, int32_t flags, int64_t rank, int64_t listed) const {
    const int64_t used_position = listed + index - rank;
    const int64_t mask = -static_cast<int64_t>(flags & kListed);  // no branch: it would often be mispredicted
    sorted_k[used_position + ((rank - used_position) & mask)] = order_k[index];
  }
  GV_HD int64_t entries() const { return 0; }
  GV_HD void clear_entry(int64_t) const {}
  GV_HD void store_totals(int64_t listed, int64_t) const { *unused_1 = listed; }
};

// --- Pointers

#define GV_UNLINK(X)                \
  X(Written<'a'>, pointer_tn, kAny) \
  X(Written<'b'>, owner_s, kAny)    \
  X(Flags, shared_s, args.slots)    \
  X(Words, slot_k, kAny)

struct UnlinkArgs {
  GV_UNLINK(GV_VIEW)
  int64_t nodes, slots;
  uint8_t* leaving_s;
  int32_t* any_shared;
};

// An index is one of the slots that change hands.
struct TakeFromOwner : UnlinkArgs {
  GV_HD void operator()(int64_t index) const {
    const int32_t slot = slot_k[index];
    if (slot < 0 || slot >= slots) return;
    const int32_t owner = owner_s[slot];
    if (owner >= 0 && owner < nodes && pointer_tn[owner] == slot) pointer_tn[owner] = kAbsent;
    owner_s[slot] = kAbsent;
    if (!shared_s[slot]) return;
    leaving_s[slot] = 1;
    store_stamp(any_shared, 1);
  }
};

// An index is kWordsPerIndex words. Only shared slots have pointers other than their owner's.
struct ClearShared : UnlinkArgs {
  static constexpr int64_t kWordsPerIndex = 16;

  GV_HD void operator()(int64_t index) const {
    if (*any_shared == 0) return;
    const int64_t end = smaller(nodes, (index + 1) * kWordsPerIndex);
    for (int64_t node = index * kWordsPerIndex; node < end; ++node) {
      const int32_t word = pointer_tn[node];
      if (word >= 0 && word < slots && leaving_s[word] != 0) pointer_tn[node] = kAbsent;
    }
  }
};

#define GV_ORPHAN(X)             \
  X(Words, pointer_tn, kAny)     \
  X(Written<'a'>, owner_s, kAny) \
  X(Words, tile_k, kAny)

// An index is a node of a tile that changes hands.
struct ClearOwner {
  GV_ORPHAN(GV_VIEW)
  int64_t tiles, slots, per_tile;

  GV_HD void operator()(int64_t index) const {
    const int64_t entry = index / per_tile;
    const int64_t tile = tile_k[entry];
    if (tile < 0 || tile >= tiles) return;
    const int64_t node = tile * per_tile + (index - entry * per_tile);
    const int32_t slot = pointer_tn[node];
    if (slot >= 0 && slot < slots && owner_s[slot] == node) owner_s[slot] = kAbsent;
  }
};

#define GV_LINK(X)                         \
  X(Written<'a'>, pointer_tn, kAny)        \
  X(Requests<'b'>, request_tn, args.nodes) \
  X(Words, node_k, kAny)                   \
  X(Words, word_k, count)                  \
  X(Int, kind, kAny)

// node_k holds each node at most once; -1 is an unused entry.
struct WritePointer {
  GV_LINK(GV_VIEW)
  int64_t nodes;

  GV_HD void operator()(int64_t index) const {
    const int32_t node = node_k[index];
    if (node < 0 || node >= nodes) return;
    pointer_tn[node] = word_k[index];
    clear_request(request_tn[node], kind);
  }
};

#define GV_LINK_BRICKS(X)                    \
  X(Written<'a'>, brick_tn, kAny)            \
  X(Requests<'b'>, request_tn, args.nodes)   \
  X(Written<'c'>, owner_b, kAny)             \
  X(Written<'d'>, stamp_b, args.slots)       \
  X(Written<'e'>, born_b, args.slots)        \
  X(WrittenFlags<'f'>, shared_b, args.slots) \
  X(Longs, node_k, kAny)                     \
  X(Words, slot_k, count)                    \
  X(Words, frame_1, 1)

// Links nodes to the bricks in slots, and makes the nodes their owners.
struct LinkBrick {
  GV_LINK_BRICKS(GV_VIEW)
  int64_t nodes, slots;

  GV_HD void operator()(int64_t index) const {
    const int64_t node = node_k[index];
    const int32_t slot = slot_k[index];
    if (node < 0 || node >= nodes || slot < 0 || slot >= slots) return;
    owner_b[slot] = static_cast<int32_t>(node);
    stamp_b[slot] = *frame_1;
    born_b[slot] = *frame_1 + 1;
    shared_b[slot] = false;
    brick_tn[node] = slot;
    clear_request(request_tn[node], kLoad);
  }
};

#define GV_LINK_TILES(X)                                  \
  X(Written<'a'>, child_tn, args.tiles* args.per_tile)    \
  X(Written<'b'>, brick_tn, args.tiles* args.per_tile)    \
  X(Requests<'c'>, request_tn, args.tiles* args.per_tile) \
  X(Written<'d'>, loc_t4, 4 * args.tiles)                 \
  X(Written<'e'>, parent_t, args.tiles)                   \
  X(Written<'f'>, tree_t, args.tiles)                     \
  X(Written<'g'>, stamp_t, args.tiles)                    \
  X(WrittenFlags<'h'>, shared_t, args.tiles)              \
  X(Words, child_jw, args.rows* args.width)               \
  X(Words, brick_jw, args.rows* args.width)               \
  X(Longs, node_j, args.rows)                             \
  X(Longs, loc_j4, 4 * args.rows)                         \
  X(Longs, row_k, kAny)                                   \
  X(Words, tile_k, count)                                 \
  X(Int, tree, kAny)                                      \
  X(Words, frame_1, 1)

// Writes tiles and links them to their parent nodes: an index is a node of a tile. Nodes beyond the tree's N^3 become
// TERMINAL and EMPTY. The tile that holds a parent node is not among those written.
struct LinkTile {
  GV_LINK_TILES(GV_VIEW)
  int64_t tiles, rows;
  int32_t per_tile, width;

  GV_HD void operator()(int64_t index) const {
    const int64_t entry = index / per_tile;
    const auto child = static_cast<int32_t>(index - entry * per_tile);
    const int64_t tile = tile_k[entry];
    const int64_t row = row_k[entry];
    if (tile < 0 || tile >= tiles || row < 0 || row >= rows) return;
    const int64_t node = node_j[row];
    if (node < 0 || node >= tiles * per_tile) return;
    const int64_t child_node = tile * per_tile + child;
    child_tn[child_node] = child < width ? child_jw[row * width + child] : kTerminal;
    brick_tn[child_node] = child < width ? brick_jw[row * width + child] : kEmpty;
    request_tn[child_node] = 0;
    if (child > 0) return;
    for (int32_t component = 0; component < 4; ++component) {
      loc_t4[4 * tile + component] = static_cast<int32_t>(loc_j4[4 * row + component]) + (component == 3 ? 1 : 0);
    }
    parent_t[tile] = static_cast<int32_t>(node);
    tree_t[tile] = tree;
    stamp_t[tile] = *frame_1;
    shared_t[tile] = false;
    child_tn[node] = static_cast<int32_t>(tile);
    clear_request(request_tn[node], kSubdivide);
  }
};

#define GV_PUT_ROWS(X)                          \
  X(WrittenBytes<'a'>, target_sb, slots* bytes) \
  X(Longs, slot_k, kAny)                        \
  X(Bytes, rows_kb, count* bytes)

// Writes rows into slots, in words as wide as the rows allow: an index is a word. A slot of -1 is an unused entry.
template <class Word>
struct PutRows {
  GV_PUT_ROWS(GV_VIEW)
  int64_t slots, width;

  GV_HD void operator()(int64_t index) const {
    const int64_t row = index / width;
    const int64_t slot = slot_k[row];
    if (slot < 0 || slot >= slots) return;
    reinterpret_cast<Word*>(target_sb)[slot * width + (index - row * width)] =
        reinterpret_cast<const Word*>(rows_kb)[index];
  }
};

// --- Locs

#define GV_LOCATE(X)               \
  X(Words, loc_t4, 4 * tiles)      \
  X(Longs, node_k, kAny)           \
  X(Int, branching, INT16_MAX + 1) \
  X(Int, per_tile, kAny)

// Computes the locs of nodes (x, y, z, depth) from those of their tiles; -1 for an index that is not a node.
struct LocateNodes {
  GV_LOCATE(GV_VIEW)
  int64_t* loc_k4;
  int64_t nodes;

  GV_HD void operator()(int64_t index) const {
    const int64_t node = node_k[index];
    for (int32_t component = 0; component < 4; ++component) loc_k4[4 * index + component] = coordinate(node, component);
  }
  // A part of a node's loc: x, y, z or depth.
  GV_HD int64_t coordinate(int64_t node, int32_t component) const {
    if (node < 0 || node >= nodes) return -1;
    const int64_t tile = node / per_tile;
    const int64_t parent = loc_t4[4 * tile + component];
    if (component == 3) return parent;
    auto digit = static_cast<int32_t>(node - tile * per_tile);
    for (int32_t axis = 0; axis < component; ++axis) digit /= branching;
    return parent * branching + digit % branching;
  }
};

#define GV_LACKING(X)                   \
  X(Words, pointer_tn, tiles* per_tile) \
  X(Words, loc_t4, 4 * tiles)           \
  X(Words, parent_t, tiles)             \
  X(Words, tree_t, tiles)               \
  X(Flags, shared_t, tiles)             \
  X(Longs, node_k, kAny)                \
  X(Longs, loc_k4, 4 * count)           \
  X(Int, tree, kAny)                    \
  X(Int, root, kAny)                    \
  X(Int, branching, INT16_MAX + 1)

// Finds which nodes are still those of the requested locs, reachable from a parent or from an alias, and still have no
// pointer.
struct FindLacking {
  GV_LACKING(GV_VIEW)
  LocateNodes locator;  // its loc_k4 is not written
  bool* lacks_k;

  GV_HD void operator()(int64_t index) const {
    const int64_t node = node_k[index];
    bool lacks = node >= 0 && node < locator.nodes;
    if (lacks) {
      const int64_t tile = node / locator.per_tile;
      lacks = (parent_t[tile] >= 0 || shared_t[tile] || node == root) && tree_t[tile] == tree &&
              pointer_tn[node] == kAbsent;
      for (int32_t component = 0; component < 4; ++component)
        lacks = lacks && locator.coordinate(node, component) == loc_k4[4 * index + component];
    }
    lacks_k[index] = lacks;
  }
};

// --- Bricks out of a level

#define GV_CUT_BRICKS(X)         \
  X(Voxels, values_zyxc, kAny)   \
  X(Longs, place_k3, 3 * bricks) \
  X(Int, brick_size, 1025)       \
  X(Int, border, 1025)

// Borders come from the neighbours, clamped at the level's faces. An index is a plane of a brick. Sizes are in voxels,
// (z, y, x); a voxel has `bytes` bytes, with all its channels. Bricks are scattered over a level, so each row is a
// cache miss: the rows of a later plane are prefetched.
struct CutBricks {
  GV_CUT_BRICKS(GV_VIEW)
  char* bricks_kzyxc;
  int64_t size_3[3];
  int64_t bytes, planes;

  GV_HD int32_t side() const { return brick_size + 2 * border; }
  GV_HD int64_t low(int64_t plane, int32_t axis) const {
    const int64_t index = place_k3[3 * (plane / side()) + axis], bound = int64_t{1} << 50;  // beyond any level
    return larger(-bound, smaller(index, bound)) * brick_size - border;
  }
  GV_HD int64_t clamp_to_level(int64_t voxel, int32_t axis) const {
    return larger<int64_t>(0, smaller<int64_t>(voxel, size_3[axis] - 1));
  }
  // Address of the voxel x = 0 of a row.
  GV_HD const char* row(int64_t plane, int32_t y) const {
    const int64_t z = clamp_to_level(low(plane, 0) + plane % side(), 0);
    return static_cast<const char*>(values_zyxc) +
           (z * size_3[1] + clamp_to_level(low(plane, 1) + y, 1)) * size_3[2] * bytes;
  }

  GV_HD void operator()(int64_t plane) const {
#ifndef __CUDA_ARCH__
    constexpr int64_t kAhead = 4;
    if (plane + kAhead < planes) {
      const int64_t x = clamp_to_level(low(plane + kAhead, 2), 2);
      for (int32_t y = 0; y < side(); ++y) __builtin_prefetch(row(plane + kAhead, y) + x * bytes);
    }
#endif
    const int64_t first = low(plane, 2);
    const bool in_level = first >= 0 && first + side() <= size_3[2];
    char* to = bricks_kzyxc + plane * side() * side() * bytes;
    for (int32_t y = 0; y < side(); ++y, to += side() * bytes) {
      const char* from = row(plane, y);
      if (in_level) {
        memcpy(to, from + first * bytes, side() * bytes);
        continue;
      }
      for (int32_t x = 0; x < side(); ++x) memcpy(to + x * bytes, from + clamp_to_level(first + x, 2) * bytes, bytes);
    }
  }
};

}  // namespace gvtorch::GV_NAMESPACE
