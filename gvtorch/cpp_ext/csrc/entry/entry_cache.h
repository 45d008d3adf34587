// The ops of cache and pools: from tensors to the functors of cache.h and cut.h. Included once by cpu.cpp and once by
// cuda.cu, each of which brings its own `compact` and `split`. How lists become ops: entry.h.
#pragma once

#include "cache/cache.h"
#include "cache/cut.h"
#include "entry/entry.h"

namespace gvtorch {

template <class Device, class List>
void compact(const Tensor& like, int64_t count, const List& list);
template <class Device, class Keep, class Put>
void split(const Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept);

inline const int32_t* words_in(const Tensor& tensor) { return data<const int32_t>(tensor); }
inline int32_t* words_out(const Tensor& tensor) { return data<int32_t>(tensor); }
inline const int64_t* longs_in(const Tensor& tensor) { return data<const int64_t>(tensor); }

// --- Requests and the order of use

#define GV_COMPACT_REQUESTS(X) X(Written<'a'>, request_tn, kAny) X(Int, capacity, kAny)
GV_OP(CompactRequestsOp, "compact_requests", GV_COMPACT_REQUESTS, "(Tensor node_k, Tensor word_k, Tensor count_3)");

template <class Device>
std::tuple<Tensor, Tensor, Tensor> run(const CompactRequestsOp& a) {
  const Like like{a.request_tn};
  GV_COMPACT_REQUESTS(GV_CHECK)
  STD_TORCH_CHECK(a.capacity >= 1 && a.request_tn.numel() <= INT32_MAX, "gvtorch: no capacity, or too many nodes");
  Tensor node_k = torch::stable::new_empty(a.request_tn, {a.capacity});
  Tensor word_k = torch::stable::new_empty(a.request_tn, {a.capacity});
  Tensor count_3 = torch::stable::new_empty(a.request_tn, {3}, ScalarType::Long);
  compact<Device>(
      a.request_tn, a.request_tn.numel(),
      ListRequests{words_out(a.request_tn), words_out(node_k), words_out(word_k), data<int64_t>(count_3), a.capacity});
  return {node_k, word_k, count_3};
}

#define GV_LRU_PARTITION(X) X(Words, order_k, kAny) X(Words, stamp_s, kAny) X(Words, frame_1, 1)
GV_OP(LruPartitionOp, "lru_partition", GV_LRU_PARTITION, "(Tensor order_k, Tensor unused_1)");

template <class Device>
std::tuple<Tensor, Tensor> run(const LruPartitionOp& a) {
  const Like like{a.order_k};
  GV_LRU_PARTITION(GV_CHECK)
  const Tensor& order_k = a.order_k;
  const int64_t size = order_k.numel(), slots = a.stamp_s.numel();
  Tensor sorted_k = torch::stable::new_empty(order_k, {size});
  Tensor unused_1 = torch::stable::new_empty(order_k, {1}, ScalarType::Long);
  const PutSlot put{words_in(order_k), words_out(sorted_k)};
  const int32_t *stamps = words_in(a.stamp_s), *frame = words_in(a.frame_1);
  if constexpr (Device::kReadsAtRandom) {
    const KeepUnstamped keep{words_in(order_k), stamps, static_cast<uint64_t>(slots), frame};
    split<Device>(order_k, size, keep, put, data<int64_t>(unused_1));
  } else {
    Tensor used_k = torch::stable::new_empty(order_k, {size}, ScalarType::Byte);
    Tensor used_s = torch::stable::new_empty(order_k, {(slots + 7) / 8}, ScalarType::Byte);
    auto *flags = data<uint8_t>(used_k), *bits = data<uint8_t>(used_s);
    for_each<Device>(order_k, (slots + 7) / 8, PackUse{stamps, slots, frame, bits});
    for_each<Device>(order_k, size, FlagUse{words_in(order_k), bits, static_cast<uint64_t>(slots), flags});
    split<Device>(order_k, size, KeepUnused{flags}, put, data<int64_t>(unused_1));
  }
  return {sorted_k, unused_1};
}

// --- Pointers

#define GV_UNLINK(X)             \
  X(Written<'a'>, pointer, kAny) \
  X(Words, slot_k, kAny)         \
  X(Int, slots, kAny)            \
  X(Int, divisor, kAny)
GV_OP(UnlinkOp, "unlink", GV_UNLINK, "()");

template <class Device>
void run(const UnlinkOp& a) {
  const Like like{a.pointer};
  GV_UNLINK(GV_CHECK)
  STD_TORCH_CHECK(a.divisor >= 1, "gvtorch: divisor out of range");
  Tensor leaving_s = torch::stable::new_zeros(a.pointer, {a.slots}, ScalarType::Byte);
  auto* leaving = data<uint8_t>(leaving_s);
  for_each<Device>(a.pointer, a.slot_k.numel(), MarkSlot{words_in(a.slot_k), leaving, a.slots});
  for_each<Device>(a.pointer, a.pointer.numel(),
                   ClearPointer{words_out(a.pointer), leaving, a.slots, static_cast<int32_t>(a.divisor)});
}

#define GV_LINK(X)                   \
  X(Written<'a'>, pointer_tn, kAny)  \
  X(Written<'b'>, request_tn, nodes) \
  X(Words, node_k, kAny)             \
  X(Words, word_k, count)            \
  X(Int, kind, kAny)
GV_OP(LinkOp, "link", GV_LINK, "()");

template <class Device>
void run(const LinkOp& a) {
  const Like like{a.pointer_tn};
  const int64_t nodes = a.pointer_tn.numel(), count = a.node_k.numel();
  GV_LINK(GV_CHECK)
  STD_TORCH_CHECK(a.kind == kLoad || a.kind == kSubdivide, "gvtorch: kind must be LOAD or SUBDIVIDE");
  for_each<Device>(a.pointer_tn, count,
                   WritePointer{words_out(a.pointer_tn), words_out(a.request_tn), words_in(a.node_k),
                                words_in(a.word_k), nodes, static_cast<int32_t>(a.kind)});
}

#define GV_LINK_BRICKS(X)               \
  X(Written<'a'>, brick_tn, kAny)       \
  X(Written<'b'>, request_tn, nodes)    \
  X(Written<'c'>, owner_b, kAny)        \
  X(Written<'d'>, stamp_b, slots)       \
  X(Written<'e'>, born_b, slots)        \
  X(WrittenFlags<'f'>, shared_b, slots) \
  X(Longs, node_k, kAny)                \
  X(Words, slot_k, count)               \
  X(Int, frame, kAny)
GV_OP(LinkBricksOp, "link_bricks", GV_LINK_BRICKS, "()");

template <class Device>
void run(const LinkBricksOp& a) {
  const Like like{a.brick_tn};
  const int64_t nodes = a.brick_tn.numel(), slots = a.owner_b.numel(), count = a.node_k.numel();
  GV_LINK_BRICKS(GV_CHECK)
  LinkBrick args{};
  GV_LINK_BRICKS(GV_LAY)
  args.nodes = nodes;
  args.slots = slots;
  for_each<Device>(a.brick_tn, count, args);
}

#define GV_LINK_TILES(X)                       \
  X(Written<'a'>, child_tn, tiles* per_tile)   \
  X(Written<'b'>, brick_tn, tiles* per_tile)   \
  X(Written<'c'>, request_tn, tiles* per_tile) \
  X(Written<'d'>, loc_t4, 4 * tiles)           \
  X(Written<'e'>, parent_t, tiles)             \
  X(Written<'f'>, tree_t, tiles)               \
  X(Written<'g'>, stamp_t, tiles)              \
  X(WrittenFlags<'h'>, shared_t, tiles)        \
  X(Words, child_jw, rows* width)              \
  X(Words, brick_jw, rows* width)              \
  X(Longs, node_j, rows)                       \
  X(Longs, loc_j4, 4 * rows)                   \
  X(Longs, row_k, kAny)                        \
  X(Words, tile_k, count)                      \
  X(Int, tree, kAny)                           \
  X(Int, frame, kAny)
GV_OP(LinkTilesOp, "link_tiles", GV_LINK_TILES, "()");

template <class Device>
void run(const LinkTilesOp& a) {
  const Like like{a.child_tn};
  const int64_t tiles = a.parent_t.numel(), rows = a.node_j.numel(), count = a.row_k.numel();
  const int64_t per_tile = tiles > 0 ? a.child_tn.numel() / tiles : 0;
  const int64_t width = rows > 0 ? a.child_jw.numel() / rows : 0;
  GV_LINK_TILES(GV_CHECK)
  STD_TORCH_CHECK(width <= per_tile || rows == 0, "gvtorch: child_jw is wider than a tile");
  LinkTile args{};
  GV_LINK_TILES(GV_LAY)
  args.tiles = tiles;
  args.rows = rows;
  lay(args.per_tile, per_tile);
  lay(args.width, width);
  for_each<Device>(a.child_tn, count * per_tile, args);
}

// --- Places

#define GV_LOCATE(X)               \
  X(Words, loc_t4, 4 * tiles)      \
  X(Longs, node_k, kAny)           \
  X(Int, branching, INT16_MAX + 1) \
  X(Int, per_tile, kAny)
GV_OP(LocateOp, "locate", GV_LOCATE, "Tensor loc_k4");

template <class Device>
Tensor run(const LocateOp& a) {
  const Like like{a.node_k};
  const int64_t tiles = a.loc_t4.numel() / 4, count = a.node_k.numel();
  GV_LOCATE(GV_CHECK)
  STD_TORCH_CHECK(a.branching >= 2 && a.per_tile >= 1, "gvtorch: branching or per_tile out of range");
  Tensor loc_k4 = torch::stable::new_empty(a.node_k, {count, 4});
  LocateNodes args{};
  GV_LOCATE(GV_LAY)
  args.loc_k4 = data<int64_t>(loc_k4);
  args.nodes = tiles * a.per_tile;
  for_each<Device>(a.node_k, count, args);
  return loc_k4;
}

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
GV_OP(LackingOp, "lacking", GV_LACKING, "Tensor lacks_k");

template <class Device>
Tensor run(const LackingOp& a) {
  const Like like{a.node_k};
  const int64_t tiles = a.parent_t.numel(), count = a.node_k.numel();
  const int64_t per_tile = tiles > 0 ? a.pointer_tn.numel() / tiles : 1;
  GV_LACKING(GV_CHECK)
  STD_TORCH_CHECK(a.branching >= 2 && per_tile >= 1 && per_tile <= INT32_MAX,
                  "gvtorch: branching or tile out of range");
  Tensor lacks_k = torch::stable::new_empty(a.node_k, {count}, ScalarType::Bool);
  const LocateNodes places{words_in(a.loc_t4),
                           longs_in(a.node_k),
                           nullptr,
                           tiles * per_tile,
                           static_cast<int32_t>(per_tile),
                           static_cast<int32_t>(a.branching)};
  for_each<Device>(a.node_k, count,
                   FindLacking{places, words_in(a.pointer_tn), words_in(a.parent_t), words_in(a.tree_t),
                               data<const bool>(a.shared_t), longs_in(a.loc_k4), data<bool>(lacks_k),
                               static_cast<int32_t>(a.tree), a.root});
  return lacks_k;
}

// --- Bricks out of a level

#define GV_CUT_BRICKS(X)         \
  X(Voxels, values_zyxc, kAny)   \
  X(Longs, place_k3, 3 * bricks) \
  X(Int, brick_size, 1025)       \
  X(Int, border, 1025)
GV_OP(CutBricksOp, "cut_bricks", GV_CUT_BRICKS, "Tensor bricks_kzyxc");

template <class Device>
Tensor run(const CutBricksOp& a) {
  const Tensor& values = a.values_zyxc;
  const Like like{values, ScalarType::Float, values.scalar_type()};
  const int64_t bricks = a.place_k3.numel() / 3;
  GV_CUT_BRICKS(GV_CHECK)
  STD_TORCH_CHECK(values.dim() == 4 && values.numel() > 0, "gvtorch: values_zyxc must be (z, y, x, c)");
  STD_TORCH_CHECK(a.brick_size >= 1, "gvtorch: brick_size out of range");
  const int64_t side = a.brick_size + 2 * a.border, channels = values.size(3);
  Tensor bricks_kzyxc = torch::stable::new_empty(values, {bricks, side, side, side, channels});
  for_each<Device>(values, bricks * side,
                   CutBricks{data<const char>(values),
                             longs_in(a.place_k3),
                             data<char>(bricks_kzyxc),
                             {values.size(0), values.size(1), values.size(2)},
                             channels * static_cast<int64_t>(values.element_size()),
                             bricks * side,
                             static_cast<int32_t>(a.brick_size),
                             static_cast<int32_t>(a.border)});
  return bricks_kzyxc;
}

using CacheOps = Types<CompactRequestsOp, LruPartitionOp, UnlinkOp, LinkOp, LinkBricksOp, LinkTilesOp, LocateOp,
                       LackingOp, CutBricksOp>;

}  // namespace gvtorch
