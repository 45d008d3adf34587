// The ops of cache and pools: from tensors to the functors of cache.h. Included once by cpu.cpp and once by cuda.cu,
// each of which defines its own `compact` and `sort_keys`. How lists become ops: entry.h.
#pragma once

#include "cache/cache.h"
#include "entry/entry.h"

namespace gvtorch {

struct alignas(16) Bytes16 {  // the most that a thread moves at once
  int64_t part_2[2];
};

template <class List>
void compact(const Tensor& like, int64_t count, const List& list);
void sort_keys(const Tensor& like, int64_t* keys, int64_t count);

GV_OP(CompactRequestsOp, "compact_requests", GV_COMPACT_REQUESTS, "(Tensor node_k, Tensor word_k, Tensor count_5)");

inline auto run(const CompactRequestsOp& a) {
  const Like like{a.request_tn};
  ListRequests args{};
  GV_COMPACT_REQUESTS(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(a.capacity >= 1 && a.request_tn.numel() <= INT32_MAX, "gvtorch: no capacity, or too many nodes");
  Tensor node_k = make_output(args.node_k, a.request_tn, {a.capacity});
  Tensor word_k = make_output(args.word_k, a.request_tn, {a.capacity});
  Tensor count_5 = make_zeros(args.count_5, a.request_tn, {5});
  compact(a.request_tn, a.request_tn.numel(), args);
  return std::make_tuple(node_k, word_k, count_5);
}

GV_OP(ChooseRequestsOp, "choose_requests", GV_CHOOSE_REQUESTS, "(Tensor node_2b, Tensor priority_2b)");

inline auto run(const ChooseRequestsOp& a) {
  const Like like{a.asked_l2k};
  STD_TORCH_CHECK(a.asked_l2k.dim() == 3, "gvtorch: asked_l2k must be (l, 2, k)");
  ChooseArgs args{};
  args.lists = a.asked_l2k.size(0);
  args.listed = a.asked_l2k.size(2);
  args.tiles = a.loc_t4.numel() / 4;
  GV_CHOOSE_REQUESTS(GV_CHECK_AND_SET)
  const int64_t requests = args.lists * args.listed;
  STD_TORCH_CHECK(a.batch >= 1 && a.per_tile >= 1 && args.lists < 512 && requests <= INT32_MAX,
                  "gvtorch: no batch, no nodes, or too many");
  const Tensor key_lk = make_output(args.key_lk, a.asked_l2k, {requests});
  const Tensor counts = make_zeros(args.before_2lk, a.asked_l2k, {2 * requests + args.lists});
  args.end_l = args.before_2lk + 2 * requests;
  Tensor node_2b = make_output(args.node_2b, a.asked_l2k, {2, a.batch});
  Tensor priority_2b = make_output(args.priority_2b, a.asked_l2k, {2, a.batch});
  for_each(a.asked_l2k, std::max(requests, 2 * a.batch), RankRequests{args});
  if (requests <= kMaxCompared) {
    for_each(a.asked_l2k, requests * kComparers, CompareRequests{args});
    for_each(a.asked_l2k, requests, ServeRequests{args});
  } else {
    sort_keys(a.asked_l2k, args.key_lk, requests);
    for (int64_t kind = 0; kind < 2; ++kind) compact(a.asked_l2k, requests, ServeSorted{{args}, kind});
  }
  return std::make_tuple(node_2b, priority_2b);
}

GV_OP(LruPartitionOp, "lru_partition", GV_LRU_PARTITION, "(Tensor order_k, Tensor unused_1)");

inline auto run(const LruPartitionOp& a) {
  const Like like{a.order_k};
  const int64_t size = a.order_k.numel();
  UseArgs args{};
  args.slots = a.stamp_s.numel();
  GV_LRU_PARTITION(GV_CHECK_AND_SET)
  Tensor sorted_k = make_output(args.sorted_k, a.order_k, {size});
  Tensor unused_1 = make_output(args.unused_1, a.order_k, {1});
#ifdef __CUDACC__
  compact(a.order_k, size, SplitByUse<true>{args});
#else
  const int64_t bytes = (args.slots + 7) / 8;
  const Tensor used_s = make_output(args.used_s, a.order_k, {bytes});
  const Tensor used_k = make_output(args.used_k, a.order_k, {size});
  for_each(a.order_k, bytes, PackUse{args});
  for_each(a.order_k, size, FlagUse{args});
  compact(a.order_k, size, SplitByUse<false>{args});
#endif
  return std::make_tuple(sorted_k, unused_1);
}

GV_OP(UnlinkOp, "unlink", GV_UNLINK, "()");

inline void run(const UnlinkOp& a) {
  const Like like{a.pointer_tn};
  UnlinkArgs args{};
  args.nodes = a.pointer_tn.numel();
  args.slots = a.owner_s.numel();
  GV_UNLINK(GV_CHECK_AND_SET)
  const Tensor leaving_s = make_zeros(args.leaving_s, a.pointer_tn, {args.slots});
  const Tensor any_shared = make_zeros(args.any_shared, a.pointer_tn, {1});
  for_each(a.pointer_tn, a.slot_k.numel(), TakeFromOwner{args});
#ifndef __CUDACC__
  if (*args.any_shared == 0) return;
#endif
  constexpr int64_t kWordsPerIndex = ClearShared::kWordsPerIndex;
  for_each(a.pointer_tn, (args.nodes + kWordsPerIndex - 1) / kWordsPerIndex, ClearShared{args});
}

GV_OP(OrphanOp, "orphan", GV_ORPHAN, "()");

inline void run(const OrphanOp& a) {
  const Like like{a.pointer_tn};
  ClearOwner args{};
  GV_ORPHAN(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(a.pointer_tn.dim() == 2, "gvtorch: pointer_tn must be (t, n)");
  args.tiles = a.pointer_tn.size(0);
  args.per_tile = a.pointer_tn.size(1);
  args.slots = a.owner_s.numel();
  for_each(a.pointer_tn, a.tile_k.numel() * args.per_tile, args);
}

GV_OP(LinkOp, "link", GV_LINK, "()");

inline void run(const LinkOp& a) {
  const Like like{a.pointer_tn};
  const int64_t count = a.node_k.numel();
  WritePointer args{};
  args.nodes = a.pointer_tn.numel();
  GV_LINK(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(a.kind == kLoad || a.kind == kSubdivide, "gvtorch: kind must be LOAD or SUBDIVIDE");
  for_each(a.pointer_tn, count, args);
}

GV_OP(LinkBricksOp, "link_bricks", GV_LINK_BRICKS, "()");

inline void run(const LinkBricksOp& a) {
  const Like like{a.brick_tn};
  const int64_t count = a.node_k.numel();
  LinkBrick args{};
  args.nodes = a.brick_tn.numel();
  args.slots = a.owner_b.numel();
  GV_LINK_BRICKS(GV_CHECK_AND_SET)
  for_each(a.brick_tn, count, args);
}

GV_OP(LinkTilesOp, "link_tiles", GV_LINK_TILES, "()");

inline void run(const LinkTilesOp& a) {
  const Like like{a.child_tn};
  const int64_t count = a.row_k.numel();
  LinkTile args{};
  args.tiles = a.parent_t.numel();
  args.rows = a.node_j.numel();
  args.per_tile = args.tiles > 0 ? static_cast<int32_t>(a.child_tn.numel() / args.tiles) : 0;
  args.width = args.rows > 0 ? static_cast<int32_t>(a.child_jw.numel() / args.rows) : 0;
  GV_LINK_TILES(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(args.width <= args.per_tile || args.rows == 0, "gvtorch: child_jw is wider than a tile");
  for_each(a.child_tn, count * args.per_tile, args);
}

GV_OP(PutRowsOp, "put_rows", GV_PUT_ROWS, "()");

template <class Word>
void put_words(const PutRowsOp& a, int64_t slots, int64_t count, int64_t bytes) {
  const Like like{a.slot_k};
  PutRows<Word> args{};
  GV_PUT_ROWS(GV_CHECK_AND_SET)
  args.slots = slots;
  args.width = bytes / static_cast<int64_t>(sizeof(Word));
  for_each(a.target_sb, count * args.width, args);
}

inline void run(const PutRowsOp& a) {
  const int64_t slots = a.target_sb.size(0), count = a.slot_k.numel();
  const int64_t bytes = slots > 0 ? a.target_sb.numel() / slots : 0;
  const auto alignment_bits = reinterpret_cast<uintptr_t>(a.target_sb.data_ptr()) |
                              reinterpret_cast<uintptr_t>(a.rows_kb.data_ptr()) | static_cast<uintptr_t>(bytes);
  if (alignment_bits % sizeof(Bytes16) == 0) return put_words<Bytes16>(a, slots, count, bytes);
  if (alignment_bits % sizeof(int32_t) == 0) return put_words<int32_t>(a, slots, count, bytes);
  put_words<uint8_t>(a, slots, count, bytes);
}

GV_OP(LocateOp, "locate", GV_LOCATE, "Tensor loc_k4");

inline Tensor run(const LocateOp& a) {
  const Like like{a.node_k};
  const int64_t tiles = a.loc_t4.numel() / 4, count = a.node_k.numel();
  LocateNodes args{};
  GV_LOCATE(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(a.branching >= 2 && a.per_tile >= 1, "gvtorch: branching or per_tile out of range");
  args.nodes = tiles * a.per_tile;
  Tensor loc_k4 = make_output(args.loc_k4, a.node_k, {count, 4});
  for_each(a.node_k, count, args);
  return loc_k4;
}

GV_OP(LackingOp, "lacking", GV_LACKING, "Tensor lacks_k");

inline Tensor run(const LackingOp& a) {
  const Like like{a.node_k};
  const int64_t tiles = a.parent_t.numel(), count = a.node_k.numel();
  const int64_t per_tile = tiles > 0 ? a.pointer_tn.numel() / tiles : 1;
  FindLacking args{};
  GV_LACKING(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(a.branching >= 2 && per_tile >= 1 && per_tile <= INT32_MAX,
                  "gvtorch: branching or tile out of range");
  args.locator = {args.loc_t4, args.node_k, args.branching, static_cast<int32_t>(per_tile), nullptr, tiles * per_tile};
  Tensor lacks_k = make_output(args.lacks_k, a.node_k, {count});
  for_each(a.node_k, count, args);
  return lacks_k;
}

GV_OP(CutBricksOp, "cut_bricks", GV_CUT_BRICKS, "Tensor bricks_kzyxc");

inline Tensor run(const CutBricksOp& a) {
  const Tensor& values = a.values_zyxc;
  const Like like{values, ScalarType::Float, values.scalar_type()};
  const int64_t bricks = a.place_k3.numel() / 3;
  CutBricks args{};
  GV_CUT_BRICKS(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(values.dim() == 4 && values.numel() > 0, "gvtorch: values_zyxc must be (z, y, x, c)");
  STD_TORCH_CHECK(a.brick_size >= 1, "gvtorch: brick_size out of range");
  const int64_t side = args.side();
  Tensor bricks_kzyxc = torch::stable::new_empty(values, {bricks, side, side, side, values.size(3)});
  args.bricks_kzyxc = to_kernel(bricks_kzyxc);
  for (int axis = 0; axis < 3; ++axis) args.size_3[axis] = values.size(axis);
  args.bytes = values.size(3) * static_cast<int64_t>(values.element_size());
  args.planes = bricks * side;
  for_each(values, args.planes, args);
  return bricks_kzyxc;
}

using CacheOps = Types<CompactRequestsOp, ChooseRequestsOp, LruPartitionOp, UnlinkOp, OrphanOp, LinkOp, LinkBricksOp,
                       LinkTilesOp, PutRowsOp, LocateOp, LackingOp, CutBricksOp>;

}  // namespace gvtorch
