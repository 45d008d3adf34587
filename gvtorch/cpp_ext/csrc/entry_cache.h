// The ops of cache and pools: from tensors to the functors of cache.h and cut.h. Included once by cpu.cpp and once by
// cuda.cu, each of which brings its own `compact` and `split`.
#pragma once

#include "cache.h"
#include "cut.h"
#include "entry.h"

namespace gvtorch {

template <class Device, class List>
void compact(const Tensor& like, int64_t count, const List& list);
template <class Device, class Keep, class Put>
void split(const Tensor& like, int64_t count, const Keep& keep, const Put& put, int64_t* kept);

constexpr const char* kCompactRequestsSchema =
    "compact_requests(Tensor(a!) request_tn, int capacity) -> (Tensor node_k, Tensor word_k, Tensor count_3)";
constexpr const char* kLruPartitionSchema =
    "lru_partition(Tensor order_k, Tensor stamp_s, Tensor frame_1) -> (Tensor order_k, Tensor unused_1)";
constexpr const char* kUnlinkSchema = "unlink(Tensor(a!) pointer, Tensor slot_k, int slots, int divisor) -> ()";
constexpr const char* kLinkSchema =
    "link(Tensor(a!) pointer_tn, Tensor(b!) request_tn, Tensor node_k, Tensor word_k, int kind) -> ()";
constexpr const char* kLocateSchema =
    "locate(Tensor loc_t4, Tensor node_k, int branching, int per_tile) -> Tensor loc_k4";
constexpr const char* kLackingSchema =
    "lacking(Tensor pointer_tn, Tensor loc_t4, Tensor parent_t, Tensor tree_t, Tensor shared_t, Tensor node_k, "
    "Tensor loc_k4, int tree, int root, int branching) -> Tensor lacks_k";
constexpr const char* kLinkBricksSchema =
    "link_bricks(Tensor(a!) brick_tn, Tensor(b!) request_tn, Tensor(c!) owner_b, Tensor(d!) stamp_b, "
    "Tensor(e!) born_b, Tensor(f!) shared_b, Tensor node_k, Tensor slot_k, int frame) -> ()";
constexpr const char* kLinkTilesSchema =
    "link_tiles(Tensor(a!) child_tn, Tensor(b!) brick_tn, Tensor(c!) request_tn, Tensor(d!) loc_t4, "
    "Tensor(e!) parent_t, Tensor(f!) tree_t, Tensor(g!) stamp_t, Tensor(h!) shared_t, Tensor child_jw, "
    "Tensor brick_jw, Tensor node_j, Tensor loc_j4, Tensor row_k, Tensor tile_k, int tree, int frame) -> ()";

constexpr const char* kCutBricksSchema =
    "cut_bricks(Tensor values_zyxc, Tensor place_k3, int brick_size, int border) -> Tensor bricks_kzyxc";

inline const int64_t* nodes_in(const Tensor& tensor) { return static_cast<const int64_t*>(tensor.const_data_ptr()); }

template <class Device>
std::tuple<Tensor, Tensor, Tensor> compact_requests(const Tensor& request_tn, int64_t capacity) {
  require(request_tn, "request_tn", request_tn, ScalarType::Int);
  STD_TORCH_CHECK(capacity >= 1 && request_tn.numel() <= INT32_MAX, "gvtorch: capacity or request_tn out of range");
  Tensor node_k = torch::stable::new_empty(request_tn, {capacity});
  Tensor word_k = torch::stable::new_empty(request_tn, {capacity});
  Tensor count_3 = torch::stable::new_empty(request_tn, {3}, ScalarType::Long);
  auto* count = static_cast<int64_t*>(count_3.mutable_data_ptr());
  compact<Device>(request_tn, request_tn.numel(),
                  ListRequests{words_out(request_tn), words_out(node_k), words_out(word_k), count, capacity});
  return {node_k, word_k, count_3};
}

template <class Device>
std::tuple<Tensor, Tensor> lru_partition(const Tensor& order_k, const Tensor& stamp_s, const Tensor& frame_1) {
  for (const auto& [tensor, name] :
       {std::tuple<const Tensor&, const char*>{order_k, "order_k"}, {stamp_s, "stamp_s"}, {frame_1, "frame_1"}}) {
    require(tensor, name, order_k, ScalarType::Int);
  }
  require_numel(frame_1, "frame_1", 1);
  Tensor sorted_k = torch::stable::new_empty(order_k, {order_k.numel()});
  Tensor unused_1 = torch::stable::new_empty(order_k, {1}, ScalarType::Long);
  auto* unused = static_cast<int64_t*>(unused_1.mutable_data_ptr());
  const int64_t size = order_k.numel();
  const int64_t slots = stamp_s.numel();
  const PutSlot put{words_in(order_k), words_out(sorted_k)};
  if constexpr (Device::kReadsAtRandom) {
    const KeepUnstamped keep{words_in(order_k), words_in(stamp_s), static_cast<uint64_t>(slots), words_in(frame_1)};
    split<Device>(order_k, size, keep, put, unused);
  } else {
    Tensor used_k = torch::stable::new_empty(order_k, {size}, ScalarType::Byte);
    Tensor used_s = torch::stable::new_empty(order_k, {(slots + 7) / 8}, ScalarType::Byte);
    auto* flags = static_cast<uint8_t*>(used_k.mutable_data_ptr());
    auto* bits = static_cast<uint8_t*>(used_s.mutable_data_ptr());
    for_each<Device>(order_k, (slots + 7) / 8, PackUse{words_in(stamp_s), slots, words_in(frame_1), bits});
    for_each<Device>(order_k, size, FlagUse{words_in(order_k), bits, static_cast<uint64_t>(slots), flags});
    split<Device>(order_k, size, KeepUnused{flags}, put, unused);
  }
  return {sorted_k, unused_1};
}

template <class Device>
void unlink(const Tensor& pointer, const Tensor& slot_k, int64_t slots, int64_t divisor) {
  require(pointer, "pointer", pointer, ScalarType::Int);
  require(slot_k, "slot_k", pointer, ScalarType::Int);
  STD_TORCH_CHECK(slots >= 0 && divisor >= 1 && divisor <= INT32_MAX, "gvtorch: slots or divisor out of range");
  Tensor leaving_s = torch::stable::new_zeros(pointer, {slots}, ScalarType::Byte);
  auto* leaving = static_cast<uint8_t*>(leaving_s.mutable_data_ptr());
  for_each<Device>(pointer, slot_k.numel(), MarkSlot{words_in(slot_k), leaving, slots});
  for_each<Device>(pointer, pointer.numel(),
                   ClearPointer{words_out(pointer), leaving, slots, static_cast<int32_t>(divisor)});
}

template <class Device>
void link(const Tensor& pointer_tn, const Tensor& request_tn, const Tensor& node_k, const Tensor& word_k,
          int64_t kind) {
  for (const auto& [tensor, name] : {std::tuple<const Tensor&, const char*>{pointer_tn, "pointer_tn"},
                                     {request_tn, "request_tn"},
                                     {node_k, "node_k"},
                                     {word_k, "word_k"}}) {
    require(tensor, name, pointer_tn, ScalarType::Int);
  }
  require_numel(request_tn, "request_tn", pointer_tn.numel());
  require_numel(word_k, "word_k", node_k.numel());
  STD_TORCH_CHECK(kind == kLoad || kind == kSubdivide, "gvtorch: kind must be LOAD or SUBDIVIDE");
  for_each<Device>(pointer_tn, node_k.numel(),
                   WritePointer{words_out(pointer_tn), words_out(request_tn), words_in(node_k), words_in(word_k),
                                pointer_tn.numel(), static_cast<int32_t>(kind)});
}

inline LocateNodes places_of(const Tensor& loc_t4, const Tensor& node_k, int64_t branching, int64_t per_tile) {
  require(loc_t4, "loc_t4", node_k, ScalarType::Int);
  require(node_k, "node_k", node_k, ScalarType::Long);
  require_numel(loc_t4, "loc_t4", loc_t4.numel() / 4 * 4);
  STD_TORCH_CHECK(branching >= 2 && branching <= INT16_MAX, "gvtorch: branching out of range");
  STD_TORCH_CHECK(per_tile >= 1 && per_tile <= INT32_MAX, "gvtorch: per_tile out of range");
  return {words_in(loc_t4),
          nodes_in(node_k),
          nullptr,
          loc_t4.numel() / 4 * per_tile,
          static_cast<int32_t>(per_tile),
          static_cast<int32_t>(branching)};
}

template <class Device>
Tensor locate(const Tensor& loc_t4, const Tensor& node_k, int64_t branching, int64_t per_tile) {
  LocateNodes places = places_of(loc_t4, node_k, branching, per_tile);
  Tensor loc_k4 = torch::stable::new_empty(node_k, {node_k.numel(), 4});
  places.loc_k4 = static_cast<int64_t*>(loc_k4.mutable_data_ptr());
  for_each<Device>(node_k, node_k.numel(), places);
  return loc_k4;
}

template <class Device>
Tensor lacking(const Tensor& pointer_tn, const Tensor& loc_t4, const Tensor& parent_t, const Tensor& tree_t,
               const Tensor& shared_t, const Tensor& node_k, const Tensor& loc_k4, int64_t tree, int64_t root,
               int64_t branching) {
  const int64_t tiles = parent_t.numel();
  const int64_t per_tile = tiles > 0 ? pointer_tn.numel() / tiles : 1;
  const LocateNodes places = places_of(loc_t4, node_k, branching, per_tile);
  require(pointer_tn, "pointer_tn", node_k, ScalarType::Int);
  require(parent_t, "parent_t", node_k, ScalarType::Int);
  require(tree_t, "tree_t", node_k, ScalarType::Int);
  require(shared_t, "shared_t", node_k, ScalarType::Bool);
  require(loc_k4, "loc_k4", node_k, ScalarType::Long);
  require_numel(pointer_tn, "pointer_tn", tiles * per_tile);
  require_numel(loc_t4, "loc_t4", 4 * tiles);
  require_numel(tree_t, "tree_t", tiles);
  require_numel(shared_t, "shared_t", tiles);
  require_numel(loc_k4, "loc_k4", 4 * node_k.numel());
  Tensor lacks_k = torch::stable::new_empty(node_k, {node_k.numel()}, ScalarType::Bool);
  for_each<Device>(node_k, node_k.numel(),
                   FindLacking{places, words_in(pointer_tn), words_in(parent_t), words_in(tree_t),
                               static_cast<const bool*>(shared_t.const_data_ptr()), nodes_in(loc_k4),
                               static_cast<bool*>(lacks_k.mutable_data_ptr()), static_cast<int32_t>(tree), root});
  return lacks_k;
}

template <class Device>
void link_bricks(const Tensor& brick_tn, const Tensor& request_tn, const Tensor& owner_b, const Tensor& stamp_b,
                 const Tensor& born_b, const Tensor& shared_b, const Tensor& node_k, const Tensor& slot_k,
                 int64_t frame) {
  const int64_t slots = owner_b.numel();
  for (const auto& [tensor, name, size] :
       {std::tuple<const Tensor&, const char*, int64_t>{brick_tn, "brick_tn", brick_tn.numel()},
        {request_tn, "request_tn", brick_tn.numel()},
        {owner_b, "owner_b", slots},
        {stamp_b, "stamp_b", slots},
        {born_b, "born_b", slots},
        {slot_k, "slot_k", node_k.numel()}}) {
    require(tensor, name, brick_tn, ScalarType::Int);
    require_numel(tensor, name, size);
  }
  require(shared_b, "shared_b", brick_tn, ScalarType::Bool);
  require_numel(shared_b, "shared_b", slots);
  require(node_k, "node_k", brick_tn, ScalarType::Long);
  for_each<Device>(brick_tn, node_k.numel(),
                   LinkBrick{words_out(brick_tn), words_out(request_tn), words_out(owner_b), words_out(stamp_b),
                             words_out(born_b), static_cast<bool*>(shared_b.mutable_data_ptr()), nodes_in(node_k),
                             words_in(slot_k), brick_tn.numel(), slots, static_cast<int32_t>(frame)});
}

template <class Device>
void link_tiles(const Tensor& child_tn, const Tensor& brick_tn, const Tensor& request_tn, const Tensor& loc_t4,
                const Tensor& parent_t, const Tensor& tree_t, const Tensor& stamp_t, const Tensor& shared_t,
                const Tensor& child_jw, const Tensor& brick_jw, const Tensor& node_j, const Tensor& loc_j4,
                const Tensor& row_k, const Tensor& tile_k, int64_t tree, int64_t frame) {
  const int64_t tiles = parent_t.numel();
  const int64_t rows = node_j.numel();
  for (const auto& [tensor, name, size] :
       {std::tuple<const Tensor&, const char*, int64_t>{child_tn, "child_tn", child_tn.numel()},
        {brick_tn, "brick_tn", child_tn.numel()},
        {request_tn, "request_tn", child_tn.numel()},
        {loc_t4, "loc_t4", 4 * tiles},
        {parent_t, "parent_t", tiles},
        {tree_t, "tree_t", tiles},
        {stamp_t, "stamp_t", tiles},
        {child_jw, "child_jw", child_jw.numel()},
        {brick_jw, "brick_jw", child_jw.numel()},
        {tile_k, "tile_k", row_k.numel()}}) {
    require(tensor, name, child_tn, ScalarType::Int);
    require_numel(tensor, name, size);
  }
  require(shared_t, "shared_t", child_tn, ScalarType::Bool);
  require_numel(shared_t, "shared_t", tiles);
  for (const auto& [tensor, name, size] : {std::tuple<const Tensor&, const char*, int64_t>{node_j, "node_j", rows},
                                           {loc_j4, "loc_j4", 4 * rows},
                                           {row_k, "row_k", row_k.numel()}}) {
    require(tensor, name, child_tn, ScalarType::Long);
    require_numel(tensor, name, size);
  }
  const int64_t per_tile = tiles > 0 ? child_tn.numel() / tiles : 0;
  const int64_t width = rows > 0 ? child_jw.numel() / rows : 0;
  STD_TORCH_CHECK(child_tn.numel() == tiles * per_tile && child_jw.numel() == rows * width && width <= per_tile,
                  "gvtorch: child_tn or child_jw has the wrong shape");
  const LinkTile link{words_out(child_tn),
                      words_out(brick_tn),
                      words_out(request_tn),
                      words_out(loc_t4),
                      words_out(parent_t),
                      words_out(tree_t),
                      words_out(stamp_t),
                      static_cast<bool*>(shared_t.mutable_data_ptr()),
                      words_in(child_jw),
                      words_in(brick_jw),
                      nodes_in(node_j),
                      nodes_in(loc_j4),
                      nodes_in(row_k),
                      words_in(tile_k),
                      tiles,
                      rows,
                      static_cast<int32_t>(per_tile),
                      static_cast<int32_t>(width),
                      static_cast<int32_t>(tree),
                      static_cast<int32_t>(frame)};
  for_each<Device>(child_tn, row_k.numel() * per_tile, link);
}

inline int64_t bytes_of(ScalarType dtype) {
  switch (dtype) {
    case ScalarType::Byte:
    case ScalarType::Char:
    case ScalarType::Bool:
      return 1;
    case ScalarType::Short:
    case ScalarType::UInt16:
    case ScalarType::Half:
    case ScalarType::BFloat16:
      return 2;
    case ScalarType::Int:
    case ScalarType::UInt32:
    case ScalarType::Float:
      return 4;
    case ScalarType::Long:
    case ScalarType::UInt64:
    case ScalarType::Double:
      return 8;
    default:
      STD_TORCH_CHECK(false, "gvtorch: bricks can't be cut of this dtype");
  }
}

template <class Device>
Tensor cut_bricks(const Tensor& values_zyxc, const Tensor& place_k3, int64_t brick_size, int64_t border) {
  require(place_k3, "place_k3", values_zyxc, ScalarType::Long);
  require(values_zyxc, "values_zyxc", values_zyxc, values_zyxc.scalar_type());
  STD_TORCH_CHECK(values_zyxc.dim() == 4 && values_zyxc.numel() > 0, "gvtorch: values_zyxc must be (z, y, x, c)");
  STD_TORCH_CHECK(brick_size >= 1 && brick_size <= 1024 && border >= 0 && border <= 1024,
                  "gvtorch: brick_size or border out of range");
  const int64_t bricks = place_k3.numel() / 3, side = brick_size + 2 * border, channels = values_zyxc.size(3);
  require_numel(place_k3, "place_k3", 3 * bricks);
  Tensor bricks_kzyxc = torch::stable::new_empty(values_zyxc, {bricks, side, side, side, channels});
  for_each<Device>(values_zyxc, bricks * side,
                   CutBricks{static_cast<const char*>(values_zyxc.const_data_ptr()),
                             nodes_in(place_k3),
                             static_cast<char*>(bricks_kzyxc.mutable_data_ptr()),
                             {values_zyxc.size(0), values_zyxc.size(1), values_zyxc.size(2)},
                             channels * bytes_of(values_zyxc.scalar_type()),
                             bricks * side,
                             static_cast<int32_t>(brick_size),
                             static_cast<int32_t>(border)});
  return bricks_kzyxc;
}

template <class Library>
void define_cache(Library& library) {
  for (const char* schema : {kCompactRequestsSchema, kLruPartitionSchema, kUnlinkSchema, kLinkSchema, kLinkBricksSchema,
                             kLinkTilesSchema, kLocateSchema, kLackingSchema, kCutBricksSchema})
    library.def(schema);
}

}  // namespace gvtorch

#define GV_IMPLEMENT_CACHE(library, Device)                                        \
  library.impl("compact_requests", TORCH_BOX(&gvtorch::compact_requests<Device>)); \
  library.impl("lru_partition", TORCH_BOX(&gvtorch::lru_partition<Device>));       \
  library.impl("unlink", TORCH_BOX(&gvtorch::unlink<Device>));                     \
  library.impl("link", TORCH_BOX(&gvtorch::link<Device>));                         \
  library.impl("link_bricks", TORCH_BOX(&gvtorch::link_bricks<Device>));           \
  library.impl("link_tiles", TORCH_BOX(&gvtorch::link_tiles<Device>));             \
  library.impl("locate", TORCH_BOX(&gvtorch::locate<Device>));                     \
  library.impl("lacking", TORCH_BOX(&gvtorch::lacking<Device>));                   \
  library.impl("cut_bricks", TORCH_BOX(&gvtorch::cut_bricks<Device>))
