// The cache's four ops on bare words: what rays asked for becomes a list, slots are ordered by use, pointers to
// slots that change hands are cleared, new pointers are written.
//
// Equal to ops/reference_cache.py in every integer. What a device brings (cpu.cpp, cuda.cu), each with the number of
// indices that keep accepts:
//   for_each(n, body)            body(index)
//   count(n, keep, kept)
//   compact(n, keep, put, kept)  put(index, rank) for the indices that keep accepts, ranks rising with the index
//   split(n, keep, put, kept)    put(index, rank) for all: those that keep accepts first, then the others
// Method: Crassin et al., "GigaVoxels", I3D 2009, section 5 (usage stamps, LRU by compaction, request lists).
#pragma once

#include "hd.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Pending bits stand above the kind bits: asked for, answer not here yet. Such a wish is not listed again.
constexpr int32_t kPendingShift = 2;
constexpr int32_t kKinds = kLoad | kSubdivide;
constexpr int32_t kPending = kKinds << kPendingShift;

GV_HD int32_t open_kinds(int32_t word) { return word & kKinds & ~(word >> kPendingShift); }

struct KeepOpenRequest {
  const int32_t* request_tn;
  GV_HD bool operator()(int64_t node) const { return open_kinds(request_tn[node]) != 0; }
};

// Lists a request; what a full list has no place for is only counted.
struct PutRequest {
  const int32_t* request_tn;
  int32_t* node_k;
  int32_t* word_k;
  int64_t capacity;
  GV_HD void operator()(int64_t node, int64_t rank) const {
    if (rank >= capacity) return;
    const int32_t word = request_tn[node];
    const int32_t kinds = open_kinds(word);
    node_k[rank] = static_cast<int32_t>(node);
    word_k[rank] = kinds | (word & kPriorityMask);
  }
};

struct KeepWish {
  const int32_t* request_tn;
  GV_HD bool operator()(int64_t node) const { return (request_tn[node] & kKinds) != 0; }
};

// (-, found, wished) -> (kept, found, wished).
struct CapCount {
  int64_t* count_3;
  int64_t capacity;
  GV_HD void operator()(int64_t) const { count_3[0] = smaller(count_3[1], capacity); }
};

struct ClearWishes {
  int32_t* request_tn;
  GV_HD void operator()(int64_t node) const {
    const int32_t word = request_tn[node];
    if ((word & ~kPending) != 0) request_tn[node] = word & kPending;
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

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
