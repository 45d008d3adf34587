// Where torch meets the kernels: the schema of every op, and the step from tensors to the borrowed views of the
// kernel headers. Included once by cpu.cpp and once by cuda.cu, each of which brings its own `for_each`.
//
// Only the LibTorch Stable ABI is used (torch/csrc/stable), so that one binary serves every torch >= 2.11.
// Messages for users are made in gvtorch/ops/*.py; the checks here only keep memory safe.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/BFloat16.h>
#include <torch/headeronly/util/Half.h>

#include <tuple>

#include "cache.h"
#include "trace.h"

namespace gvtorch {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// (a!) request words, (b!) tile stamps, (c!) brick stamps are written in place.
constexpr const char* kTraceRaysSchema =
    "trace_rays("
    "Tensor origin_r3, Tensor direction_r3, Tensor cone_r2, Tensor range_r2, Tensor bounds_23, "
    "Tensor child_tn, Tensor brick_tn, Tensor(a!) request_tn, Tensor(b!) stamp_t, "
    "Tensor bricks_bzyxc, Tensor constant_tnc, Tensor range_tn2c, Tensor(c!) stamp_b, "
    "Tensor table_m4, Tensor domain_3, Tensor opaque_m, Tensor frame_1, "
    "int branching, int root, int max_depth, int border, int component, "
    "float root_voxel, float step, float stop_alpha, float depth_alpha, bool by_level"
    ") -> (Tensor color_r3, Tensor alpha_r1, Tensor depth_r1, Tensor samples_r, Tensor missed_r)";
constexpr const char* kCompactRequestsSchema =
    "compact_requests(Tensor(a!) request_tn, int capacity) -> (Tensor node_k, Tensor word_k, Tensor count_3)";
constexpr const char* kLruPartitionSchema =
    "lru_partition(Tensor order_k, Tensor stamp_s, Tensor frame_1) -> (Tensor order_k, Tensor unused_1)";
constexpr const char* kUnlinkSchema = "unlink(Tensor(a!) pointer, Tensor slot_k, int slots, int divisor) -> ()";
constexpr const char* kLinkSchema =
    "link(Tensor(a!) pointer_tn, Tensor(b!) request_tn, Tensor node_k, Tensor word_k, int kind) -> ()";

inline void require(const Tensor& tensor, const char* name, const Tensor& like, ScalarType dtype) {
  STD_TORCH_CHECK(tensor.is_contiguous(), "gvtorch: ", name, " must be contiguous");
  STD_TORCH_CHECK(tensor.scalar_type() == dtype, "gvtorch: ", name, " has the wrong dtype");
  STD_TORCH_CHECK(tensor.device() == like.device(), "gvtorch: ", name, " lies on another device than the rays");
}

inline void require_numel(const Tensor& tensor, const char* name, int64_t expected) {
  STD_TORCH_CHECK(tensor.numel() == expected, "gvtorch: ", name, " must hold ", expected, " elements, got ",
                  tensor.numel());
}

inline void require_float(ScalarType dtype) {
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double,
                  "gvtorch: rays must be float32 or float64");
}

template <class T>
constexpr ScalarType scalar_type_of() {
  return sizeof(T) == 8 ? ScalarType::Double : ScalarType::Float;
}

// Calls `body(Voxel{})` with the C++ type of a channel's dtype.
template <class Body>
void with_voxel_type(ScalarType dtype, const Body& body) {
  switch (dtype) {
    case ScalarType::Byte:
      return body(uint8_t{});
    case ScalarType::Char:
      return body(int8_t{});
    case ScalarType::Short:
      return body(int16_t{});
    case ScalarType::UInt16:
      return body(uint16_t{});
    case ScalarType::Half:
      return body(torch::headeronly::Half{});
    case ScalarType::BFloat16:
      return body(torch::headeronly::BFloat16{});
    case ScalarType::Float:
      return body(float{});
    default:
      STD_TORCH_CHECK(false, "gvtorch: this channel dtype has no kernel");
  }
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> trace_rays(
    const Tensor& origin_r3, const Tensor& direction_r3, const Tensor& cone_r2, const Tensor& range_r2,
    const Tensor& bounds_23, const Tensor& child_tn, const Tensor& brick_tn, const Tensor& request_tn,
    const Tensor& stamp_t, const Tensor& bricks_bzyxc, const Tensor& constant_tnc, const Tensor& range_tn2c,
    const Tensor& stamp_b, const Tensor& table_m4, const Tensor& domain_3, const Tensor& opaque_m,
    const Tensor& frame_1, int64_t branching, int64_t root, int64_t max_depth, int64_t border, int64_t component,
    double root_voxel, double step, double stop_alpha, double depth_alpha, bool by_level) {
  const ScalarType real = origin_r3.scalar_type();
  const ScalarType word = ScalarType::Int;
  const ScalarType voxel = bricks_bzyxc.scalar_type();
  require_float(real);
  STD_TORCH_CHECK(origin_r3.dim() == 2 && origin_r3.size(1) == 3, "gvtorch: origin_r3 must be (r, 3)");
  STD_TORCH_CHECK(bricks_bzyxc.dim() == 5 && bricks_bzyxc.size(1) >= 2 &&
                      bricks_bzyxc.size(1) == bricks_bzyxc.size(2) && bricks_bzyxc.size(2) == bricks_bzyxc.size(3),
                  "gvtorch: bricks_bzyxc must be (b, s, s, s, c) with s >= 2");
  const int64_t rays = origin_r3.size(0);
  const int64_t side = bricks_bzyxc.size(1);
  const int64_t channels = bricks_bzyxc.size(4);
  STD_TORCH_CHECK(child_tn.dim() == 2, "gvtorch: child_tn must be (t, n)");
  const int64_t nodes = child_tn.numel();
  const int64_t nodes_per_tile = child_tn.size(1);
  STD_TORCH_CHECK(branching >= 2 && branching <= 16 && max_depth >= 0 && max_depth <= 62 &&
                      nodes_per_tile >= branching * branching * branching && nodes_per_tile <= INT32_MAX,
                  "gvtorch: tree out of range");
  STD_TORCH_CHECK(root >= 0 && root < nodes, "gvtorch: root is not a node");
  STD_TORCH_CHECK(border >= 0 && side > 2 * border && component >= 0 && component < channels,
                  "gvtorch: border or component out of range");
  STD_TORCH_CHECK(step > 0 && root_voxel > 0, "gvtorch: step and root_voxel must be positive");

  for (const auto& [tensor, name, numel] :
       {std::tuple<const Tensor&, const char*, int64_t>{origin_r3, "origin_r3", 3 * rays},
        {direction_r3, "direction_r3", 3 * rays},
        {cone_r2, "cone_r2", 2 * rays},
        {range_r2, "range_r2", 2 * rays},
        {bounds_23, "bounds_23", 6},
        {table_m4, "table_m4", table_m4.size(0) * 4},
        {domain_3, "domain_3", 3}}) {
    require(tensor, name, origin_r3, real);
    require_numel(tensor, name, numel);
  }
  STD_TORCH_CHECK(table_m4.size(0) >= 2, "gvtorch: table_m4 needs two rows");
  for (const auto& [tensor, name, numel] :
       {std::tuple<const Tensor&, const char*, int64_t>{child_tn, "child_tn", nodes},
        {brick_tn, "brick_tn", nodes},
        {request_tn, "request_tn", nodes},
        {stamp_t, "stamp_t", child_tn.size(0)},
        {stamp_b, "stamp_b", bricks_bzyxc.size(0)},
        {opaque_m, "opaque_m", table_m4.size(0)},
        {frame_1, "frame_1", 1}}) {
    require(tensor, name, origin_r3, word);
    require_numel(tensor, name, numel);
  }
  require(bricks_bzyxc, "bricks_bzyxc", origin_r3, voxel);
  require(constant_tnc, "constant_tnc", origin_r3, voxel);
  require_numel(constant_tnc, "constant_tnc", nodes * channels);
  require(range_tn2c, "range_tn2c", origin_r3, voxel);
  require_numel(range_tn2c, "range_tn2c", 2 * nodes * channels);

  Tensor color_r3 = torch::stable::new_empty(origin_r3, {rays, 3});
  Tensor alpha_r1 = torch::stable::new_empty(origin_r3, {rays, 1});
  Tensor depth_r1 = torch::stable::new_empty(origin_r3, {rays, 1});
  Tensor samples_r = torch::stable::new_empty(origin_r3, {rays}, word);
  Tensor missed_r = torch::stable::new_empty(origin_r3, {rays}, ScalarType::Bool);

  const auto run = [&](auto scalar) {
    using T = decltype(scalar);
    with_voxel_type(voxel, [&](auto stored) {
      using Voxel = decltype(stored);
      const auto real_in = [](const Tensor& tensor) { return static_cast<const T*>(tensor.const_data_ptr()); };
      const auto real_out = [](const Tensor& tensor) { return static_cast<T*>(tensor.mutable_data_ptr()); };
      const auto word_in = [](const Tensor& tensor) { return static_cast<const int32_t*>(tensor.const_data_ptr()); };
      const auto word_out = [](const Tensor& tensor) { return static_cast<int32_t*>(tensor.mutable_data_ptr()); };
      const TraceRay<T, Voxel> body{
          {real_in(origin_r3), real_in(direction_r3), real_in(cone_r2), real_in(range_r2), real_in(bounds_23)},
          {word_in(child_tn), word_in(brick_tn), word_out(request_tn), word_out(stamp_t), root,
           static_cast<int32_t>(branching), static_cast<int32_t>(nodes_per_tile), static_cast<int32_t>(max_depth)},
          {static_cast<const Voxel*>(bricks_bzyxc.const_data_ptr()),
           static_cast<const Voxel*>(constant_tnc.const_data_ptr()),
           static_cast<const Voxel*>(range_tn2c.const_data_ptr()), word_out(stamp_b), static_cast<int32_t>(side),
           static_cast<int32_t>(border), static_cast<int32_t>(channels), static_cast<int32_t>(component)},
          {real_in(table_m4), real_in(domain_3), word_in(opaque_m), static_cast<int32_t>(table_m4.size(0))},
          {static_cast<T>(root_voxel), static_cast<T>(step), static_cast<T>(stop_alpha), static_cast<T>(depth_alpha),
           by_level},
          {real_out(color_r3), real_out(alpha_r1), real_out(depth_r1), word_out(samples_r),
           static_cast<bool*>(missed_r.mutable_data_ptr())},
          word_in(frame_1)};
      for_each<Device>(origin_r3, rays, body);
    });
  };
  if (real == ScalarType::Double) {
    run(double{});
  } else {
    run(float{});
  }
  return {color_r3, alpha_r1, depth_r1, samples_r, missed_r};
}

inline const int32_t* words_in(const Tensor& tensor) { return static_cast<const int32_t*>(tensor.const_data_ptr()); }
inline int32_t* words_out(const Tensor& tensor) { return static_cast<int32_t*>(tensor.mutable_data_ptr()); }

template <class Device>
std::tuple<Tensor, Tensor, Tensor> compact_requests(const Tensor& request_tn, int64_t capacity) {
  require(request_tn, "request_tn", request_tn, ScalarType::Int);
  STD_TORCH_CHECK(capacity >= 1 && request_tn.numel() <= INT32_MAX, "gvtorch: capacity or request_tn out of range");
  Tensor node_k = torch::stable::new_empty(request_tn, {capacity});
  Tensor word_k = torch::stable::new_zeros(request_tn, {capacity});
  Tensor count_3 = torch::stable::new_zeros(request_tn, {3}, ScalarType::Long);
  torch::stable::fill_(node_k, -1);
  const int64_t nodes = request_tn.numel();
  auto* count = static_cast<int64_t*>(count_3.mutable_data_ptr());
  compact<Device>(request_tn, nodes, KeepOpenRequest{words_in(request_tn)},
                  PutRequest{words_in(request_tn), words_out(node_k), words_out(word_k), capacity}, count + 1);
  compact<Device>(request_tn, nodes, KeepWish{words_in(request_tn)}, PutNothing{}, count + 2);
  for_each<Device>(request_tn, 1, CapCount{count, capacity});
  for_each<Device>(request_tn, nodes, ClearWishes{words_out(request_tn)});
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
  Tensor unused_1 = torch::stable::new_zeros(order_k, {2}, ScalarType::Long);
  auto* count = static_cast<int64_t*>(unused_1.mutable_data_ptr());
  const int64_t size = order_k.numel();
  Tensor used_k = torch::stable::new_empty(order_k, {size}, ScalarType::Byte);
  auto* flags = static_cast<uint8_t*>(used_k.mutable_data_ptr());
  for_each<Device>(order_k, size,
                   FlagUse{words_in(order_k), words_in(stamp_s), stamp_s.numel(), words_in(frame_1), flags});
  for (const uint8_t used : {0, 1}) {
    const KeepByUse keep{flags, used};
    const PutSlot put{words_in(order_k), words_out(sorted_k), used ? count : count + 1};
    compact<Device>(order_k, size, keep, put, used ? count + 1 : count);
  }
  return {sorted_k, torch::stable::narrow(unused_1, 0, 0, 1)};
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

}  // namespace gvtorch
