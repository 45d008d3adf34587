// Where torch meets the kernels: the schema of every op, and the step from tensors to the borrowed views of the
// kernel headers. Included once by cpu.cpp and once by cuda.cu, each of which brings its own `trace`; and by every
// user's shader (user.cpp), which needs none. The cache's ops and those of segments: entry_cache.h, entry_segments.h.
//
// Only the LibTorch Stable ABI is used (torch/csrc/stable), so that one binary serves every torch >= 2.11.
// Messages for users are made in gvtorch/ops/*.py; the checks here only keep memory safe.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <optional>
#include <tuple>

#include "for_each.h"
#include "shade_rays.h"
#include "trace.h"

namespace gvtorch {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class Device>
void trace(const Tensor& like, TraceArgs args, bool wide);
template <class Device>
void shade(const Tensor& like, ShadeArgs args, bool wide);

// (a!) request words, (b!) tile stamps, (c!) brick stamps are written in place.
constexpr const char* kTraceRaysSchema =
    "trace_rays("
    "Tensor origin_r3, Tensor direction_r3, Tensor cone_r2, Tensor range_r2, Tensor place_33, "
    "Tensor child_tn, Tensor brick_tn, Tensor(a!) request_tn, Tensor(b!) stamp_t, "
    "Tensor bricks_bzyxc, Tensor constant_tnc, Tensor range_tn2c, Tensor(c!) stamp_b, "
    "Tensor table_lm4, Tensor domain_2, Tensor opaque_m, Tensor frame_1, "
    "int width, int branching, int root, int max_depth, int border, int component, "
    "float cone_scale, float root_voxel, float step, float stop_alpha, float depth_alpha, bool by_level, "
    "Tensor? clear_r=None"
    ") -> (Tensor color_r3, Tensor alpha_r1, Tensor depth_r1, Tensor samples_r, Tensor missed_r)";
// As trace_rays; the table is (l, m, m, 4) where the shader integrates. Tensor shape of features: (r, features).
constexpr const char* kShadeRaysSchema =
    "shade_rays("
    "Tensor origin_r3, Tensor direction_r3, Tensor cone_r2, Tensor range_r2, Tensor place_33, "
    "Tensor child_tn, Tensor brick_tn, Tensor(a!) request_tn, Tensor(b!) stamp_t, "
    "Tensor bricks_bzyxc, Tensor constant_tnc, Tensor range_tn2c, Tensor(c!) stamp_b, "
    "Tensor table, Tensor domain_2, Tensor opaque_m, Tensor frame_1, "
    "Tensor parameter_54, Tensor? normal_bzyxc, Tensor? normal_tnc, Tensor? other_bzyxc, Tensor? other_tnc, "
    "int shader, int features, int other_component, "
    "int width, int branching, int root, int max_depth, int border, int component, "
    "float cone_scale, float root_voxel, float step, float stop_alpha, float depth_alpha, bool by_level, "
    "Tensor? clear_r=None"
    ") -> (Tensor color_r3, Tensor alpha_r1, Tensor depth_r1, Tensor samples_r, Tensor missed_r, "
    "Tensor normal_r3, Tensor features_rc)";
inline void require(const Tensor& tensor, const char* name, const Tensor& like, ScalarType dtype) {
  STD_TORCH_CHECK(tensor.is_contiguous(), "gvtorch: ", name, " must be contiguous");
  STD_TORCH_CHECK(tensor.scalar_type() == dtype, "gvtorch: ", name, " has the wrong dtype");
  STD_TORCH_CHECK(tensor.device() == like.device(), "gvtorch: ", name, " lies on another device than the rays");
}

inline void require_numel(const Tensor& tensor, const char* name, int64_t expected) {
  STD_TORCH_CHECK(tensor.numel() == expected, "gvtorch: ", name, " must hold ", expected, " elements, got ",
                  tensor.numel());
}

inline VoxelType voxel_type(ScalarType dtype) {
  switch (dtype) {
    case ScalarType::Byte:
      return VoxelType::kUInt8;
    case ScalarType::Char:
      return VoxelType::kInt8;
    case ScalarType::Short:
      return VoxelType::kInt16;
    case ScalarType::UInt16:
      return VoxelType::kUInt16;
    case ScalarType::Half:
      return VoxelType::kHalf;
    case ScalarType::BFloat16:
      return VoxelType::kBFloat16;
    case ScalarType::Float:
      return VoxelType::kFloat;
    default:
      STD_TORCH_CHECK(false, "gvtorch: this channel dtype has no kernel");
  }
}

inline const int32_t* words_in(const Tensor& tensor) { return static_cast<const int32_t*>(tensor.const_data_ptr()); }
inline int32_t* words_out(const Tensor& tensor) { return static_cast<int32_t*>(tensor.mutable_data_ptr()); }

// What a traced ray gives.
struct HitTensors {
  Tensor color_r3, alpha_r1, depth_r1, samples_r, missed_r;
};

// Checks what both ray ops have in common and puts it into `args`. `integrates`: the table is (l, m, m, 4).
inline HitTensors lay_ready(TraceArgs& args, bool integrates, const Tensor& origin_r3, const Tensor& direction_r3,
                            const Tensor& cone_r2, const Tensor& range_r2, const Tensor& place_33,
                            const Tensor& child_tn, const Tensor& brick_tn, const Tensor& request_tn,
                            const Tensor& stamp_t, const Tensor& bricks_bzyxc, const Tensor& constant_tnc,
                            const Tensor& range_tn2c, const Tensor& stamp_b, const Tensor& table_lm4,
                            const Tensor& domain_2, const Tensor& opaque_m, const Tensor& frame_1, int64_t width,
                            int64_t branching, int64_t root, int64_t max_depth, int64_t border, int64_t component,
                            double cone_scale, double root_voxel, double step, double stop_alpha, double depth_alpha,
                            bool by_level, const std::optional<Tensor>& clear_r) {
  const ScalarType real = table_lm4.scalar_type();
  const ScalarType word = ScalarType::Int;
  const ScalarType voxel = bricks_bzyxc.scalar_type();
  STD_TORCH_CHECK(real == ScalarType::Float || real == ScalarType::Double,
                  "gvtorch: table_lm4 must be float32 or float64");
  STD_TORCH_CHECK(origin_r3.dim() == 2 && origin_r3.size(1) == 3, "gvtorch: origin_r3 must be (r, 3)");
  STD_TORCH_CHECK(bricks_bzyxc.dim() == 5 && bricks_bzyxc.size(1) >= 2 && bricks_bzyxc.size(1) <= 1024 &&
                      bricks_bzyxc.size(1) == bricks_bzyxc.size(2) && bricks_bzyxc.size(2) == bricks_bzyxc.size(3),
                  "gvtorch: bricks_bzyxc must be (b, s, s, s, c) with s >= 2");
  const int64_t rays = origin_r3.size(0);
  const int64_t side = bricks_bzyxc.size(1);
  const int64_t channels = bricks_bzyxc.size(4);
  STD_TORCH_CHECK(side * side * side * channels <= INT32_MAX / 8, "gvtorch: a brick is too large");
  STD_TORCH_CHECK(child_tn.dim() == 2, "gvtorch: child_tn must be (t, n)");
  const int64_t nodes = child_tn.numel();
  const int64_t nodes_per_tile = child_tn.size(1);
  STD_TORCH_CHECK(branching >= 2 && branching <= 16 && max_depth >= 0 && max_depth < kMostLevels &&
                      nodes_per_tile >= branching * branching * branching && nodes_per_tile <= INT32_MAX,
                  "gvtorch: tree out of range");
  STD_TORCH_CHECK(nodes <= INT32_MAX, "gvtorch: too many nodes in one pool");
  STD_TORCH_CHECK(root >= 0 && root < nodes, "gvtorch: root is not a node");
  STD_TORCH_CHECK(border >= 0 && side > 2 * border && component >= 0 && component < channels,
                  "gvtorch: border or component out of range");
  STD_TORCH_CHECK(step > 0 && root_voxel > 0, "gvtorch: step and root_voxel must be positive");
  STD_TORCH_CHECK(width >= 0 && (width == 0 || rays % width == 0), "gvtorch: rays are no rows of this width");
  STD_TORCH_CHECK(
      table_lm4.dim() >= 3 && table_lm4.size(0) >= 1 && table_lm4.size(1) >= 2 && table_lm4.size(1) <= INT32_MAX,
      "gvtorch: table_lm4 must be (l, m, 4) with m >= 2");

  for (const auto& [tensor, name, numel] :
       {std::tuple<const Tensor&, const char*, int64_t>{origin_r3, "origin_r3", 3 * rays},
        {direction_r3, "direction_r3", 3 * rays},
        {cone_r2, "cone_r2", 2 * rays},
        {range_r2, "range_r2", 2 * rays},
        {place_33, "place_33", 9}}) {
    require(tensor, name, origin_r3, ScalarType::Double);
    require_numel(tensor, name, numel);
  }
  if (clear_r.has_value()) {
    require(*clear_r, "clear_r", origin_r3, ScalarType::Double);
    require_numel(*clear_r, "clear_r", rays);
  }
  require(table_lm4, "table_lm4", origin_r3, real);
  const int64_t rows = integrates ? table_lm4.size(1) * table_lm4.size(1) : table_lm4.size(1);
  STD_TORCH_CHECK(table_lm4.dim() == (integrates ? 4 : 3), "gvtorch: table_lm4 has the wrong number of dimensions");
  require_numel(table_lm4, "table_lm4", table_lm4.size(0) * rows * 4);
  STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(table_lm4.const_data_ptr()) % 16 == 0,
                  "gvtorch: table_lm4 must begin at a multiple of 16 bytes");
  require(domain_2, "domain_2", origin_r3, real);
  require_numel(domain_2, "domain_2", 2);
  for (const auto& [tensor, name, numel] :
       {std::tuple<const Tensor&, const char*, int64_t>{child_tn, "child_tn", nodes},
        {brick_tn, "brick_tn", nodes},
        {request_tn, "request_tn", nodes},
        {stamp_t, "stamp_t", child_tn.size(0)},
        {stamp_b, "stamp_b", bricks_bzyxc.size(0)},
        {opaque_m, "opaque_m", table_lm4.size(1)},
        {frame_1, "frame_1", 1}}) {
    require(tensor, name, origin_r3, word);
    require_numel(tensor, name, numel);
  }
  require(bricks_bzyxc, "bricks_bzyxc", origin_r3, voxel);
  require(constant_tnc, "constant_tnc", origin_r3, voxel);
  require_numel(constant_tnc, "constant_tnc", nodes * channels);
  require(range_tn2c, "range_tn2c", origin_r3, voxel);
  require_numel(range_tn2c, "range_tn2c", 2 * nodes * channels);

  HitTensors found{torch::stable::new_empty(table_lm4, {rays, 3}), torch::stable::new_empty(table_lm4, {rays, 1}),
                   torch::stable::new_empty(table_lm4, {rays, 1}), torch::stable::new_empty(table_lm4, {rays}, word),
                   torch::stable::new_empty(table_lm4, {rays}, ScalarType::Bool)};
  const auto world = [](const Tensor& tensor) { return static_cast<const double*>(tensor.const_data_ptr()); };
  args.origin_r3 = world(origin_r3);
  args.direction_r3 = world(direction_r3);
  args.cone_r2 = world(cone_r2);
  args.range_r2 = world(range_r2);
  args.place_33 = world(place_33);
  args.clear_r = clear_r.has_value() ? world(*clear_r) : nullptr;
  args.child_tn = words_in(child_tn);
  args.brick_tn = words_in(brick_tn);
  args.request_tn = words_out(request_tn);
  args.stamp_t = words_out(stamp_t);
  args.bricks_bzyxc = bricks_bzyxc.const_data_ptr();
  args.constant_tnc = constant_tnc.const_data_ptr();
  args.range_tn2c = range_tn2c.const_data_ptr();
  args.stamp_b = words_out(stamp_b);
  args.table_lm4 = table_lm4.const_data_ptr();
  args.domain_2 = domain_2.const_data_ptr();
  args.opaque_m = words_in(opaque_m);
  args.frame_1 = words_in(frame_1);
  args.color_r3 = found.color_r3.mutable_data_ptr();
  args.alpha_r1 = found.alpha_r1.mutable_data_ptr();
  args.depth_r1 = found.depth_r1.mutable_data_ptr();
  args.samples_r = words_out(found.samples_r);
  args.missed_r = static_cast<bool*>(found.missed_r.mutable_data_ptr());
  args.rays = rays;
  args.width = width;
  args.root = static_cast<int32_t>(root);
  args.bricks = bricks_bzyxc.size(0);
  args.nodes = nodes;
  args.voxel = voxel_type(voxel);
  args.nodes_per_tile = static_cast<int32_t>(nodes_per_tile);
  args.branching = static_cast<int32_t>(branching);
  args.max_depth = static_cast<int32_t>(max_depth);
  args.side = static_cast<int32_t>(side);
  args.border = static_cast<int32_t>(border);
  args.channels = static_cast<int32_t>(channels);
  args.component = static_cast<int32_t>(component);
  args.rows = static_cast<int32_t>(table_lm4.size(1));
  args.levels = static_cast<int32_t>(table_lm4.size(0));
  args.cone_scale = cone_scale;
  args.root_voxel = root_voxel;
  args.step = step;
  args.stop_alpha = stop_alpha;
  args.depth_alpha = depth_alpha;
  args.by_level = by_level;
  return found;
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> trace_rays(
    const Tensor& origin_r3, const Tensor& direction_r3, const Tensor& cone_r2, const Tensor& range_r2,
    const Tensor& place_33, const Tensor& child_tn, const Tensor& brick_tn, const Tensor& request_tn,
    const Tensor& stamp_t, const Tensor& bricks_bzyxc, const Tensor& constant_tnc, const Tensor& range_tn2c,
    const Tensor& stamp_b, const Tensor& table_lm4, const Tensor& domain_2, const Tensor& opaque_m,
    const Tensor& frame_1, int64_t width, int64_t branching, int64_t root, int64_t max_depth, int64_t border,
    int64_t component, double cone_scale, double root_voxel, double step, double stop_alpha, double depth_alpha,
    bool by_level, const std::optional<Tensor>& clear_r) {
  TraceArgs args{};
  const HitTensors found = lay_ready(
      args, false, origin_r3, direction_r3, cone_r2, range_r2, place_33, child_tn, brick_tn, request_tn, stamp_t,
      bricks_bzyxc, constant_tnc, range_tn2c, stamp_b, table_lm4, domain_2, opaque_m, frame_1, width, branching, root,
      max_depth, border, component, cone_scale, root_voxel, step, stop_alpha, depth_alpha, by_level, clear_r);
  trace<Device>(origin_r3, args, table_lm4.scalar_type() == ScalarType::Double);
  return {found.color_r3, found.alpha_r1, found.depth_r1, found.samples_r, found.missed_r};
}

// A second channel of the same pool, with `width` numbers a voxel (0: any); null where there is none.
inline void lay_channel(const std::optional<Tensor>& bricks_bzyxc, const std::optional<Tensor>& constant_tnc,
                        const char* name, int64_t width, const Tensor& like_bzyxc, int64_t nodes, const void*& bricks,
                        const void*& constants, VoxelType& voxel, int32_t& numbers) {
  STD_TORCH_CHECK(bricks_bzyxc.has_value() == constant_tnc.has_value(), "gvtorch: ", name,
                  " needs bricks and constants");
  if (!bricks_bzyxc.has_value()) return;
  const ScalarType dtype = bricks_bzyxc->scalar_type();
  STD_TORCH_CHECK(
      bricks_bzyxc->dim() == 5 && bricks_bzyxc->size(4) >= 1 && (width == 0 || bricks_bzyxc->size(4) == width),
      "gvtorch: ", name, " has the wrong shape");
  const int64_t channels = bricks_bzyxc->size(4);
  for (int axis = 0; axis < 4; ++axis) {
    STD_TORCH_CHECK(bricks_bzyxc->size(axis) == like_bzyxc.size(axis), "gvtorch: ", name, " has other bricks");
  }
  const int64_t side = like_bzyxc.size(1);
  STD_TORCH_CHECK(side * side * side * channels <= INT32_MAX / 8, "gvtorch: a brick is too large");
  require(*bricks_bzyxc, name, like_bzyxc, dtype);
  require(*constant_tnc, name, like_bzyxc, dtype);
  require_numel(*constant_tnc, name, nodes * channels);
  bricks = bricks_bzyxc->const_data_ptr();
  constants = constant_tnc->const_data_ptr();
  voxel = voxel_type(dtype);
  numbers = static_cast<int32_t>(channels);
}

// The shaders of a library: what is asked of their arguments, and `run`, which shades all rays. A user's library has a
// class like this one (user.cpp).
struct FusedShaders {
  static bool integrates(int64_t shader) { return static_cast<ShaderKind>(shader) == ShaderKind::kPreIntegrated; }
  static void check(const ShadeArgs& args, int64_t shader) {
    STD_TORCH_CHECK(shader >= 0 && shader < kShaderKinds, "gvtorch: shader is unknown");
    const auto kind = static_cast<ShaderKind>(shader);
    STD_TORCH_CHECK(kind != ShaderKind::kFeatures || args.other_channels > 0, "gvtorch: other_bzyxc is missing");
    const bool colored = (args.channels == 4 || args.channels == 4 * kDirections) && args.component == 3;
    STD_TORCH_CHECK(!is_stored_color(kind) || colored, "gvtorch: bricks_bzyxc must hold red, green, blue and opacity");
    const int32_t given = kind == ShaderKind::kFeatures ? args.other_channels : kind == ShaderKind::kProjection ? 1 : 0;
    STD_TORCH_CHECK(args.features == given, "gvtorch: features is not what the shader gives");
    STD_TORCH_CHECK(args.parameters == kParameters, "gvtorch: parameter_54 must hold 20 elements, got ",
                    args.parameters);
  }
  template <class Device>
  static void run(const Tensor& like, const ShadeArgs& args, bool wide) {
    shade<Device>(like, args, wide);
  }
};

template <class Device, class Shaders = FusedShaders>
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> shade_rays(
    const Tensor& origin_r3, const Tensor& direction_r3, const Tensor& cone_r2, const Tensor& range_r2,
    const Tensor& place_33, const Tensor& child_tn, const Tensor& brick_tn, const Tensor& request_tn,
    const Tensor& stamp_t, const Tensor& bricks_bzyxc, const Tensor& constant_tnc, const Tensor& range_tn2c,
    const Tensor& stamp_b, const Tensor& table_lm4, const Tensor& domain_2, const Tensor& opaque_m,
    const Tensor& frame_1, const Tensor& parameter_54, const std::optional<Tensor>& normal_bzyxc,
    const std::optional<Tensor>& normal_tnc, const std::optional<Tensor>& other_bzyxc,
    const std::optional<Tensor>& other_tnc, int64_t shader, int64_t features, int64_t other_component, int64_t width,
    int64_t branching, int64_t root, int64_t max_depth, int64_t border, int64_t component, double cone_scale,
    double root_voxel, double step, double stop_alpha, double depth_alpha, bool by_level,
    const std::optional<Tensor>& clear_r) {
  ShadeArgs args{};
  args.shader = static_cast<ShaderKind>(shader);
  const HitTensors found =
      lay_ready(args, Shaders::integrates(shader), origin_r3, direction_r3, cone_r2, range_r2, place_33, child_tn,
                brick_tn, request_tn, stamp_t, bricks_bzyxc, constant_tnc, range_tn2c, stamp_b, table_lm4, domain_2,
                opaque_m, frame_1, width, branching, root, max_depth, border, component, cone_scale, root_voxel, step,
                stop_alpha, depth_alpha, by_level, clear_r);
  const ScalarType real = table_lm4.scalar_type();
  int32_t three = 0;
  lay_channel(normal_bzyxc, normal_tnc, "normal_bzyxc", 3, bricks_bzyxc, args.nodes, args.normal_bzyxc, args.normal_tnc,
              args.normal_voxel, three);
  lay_channel(other_bzyxc, other_tnc, "other_bzyxc", 0, bricks_bzyxc, args.nodes, args.other_bzyxc, args.other_tnc,
              args.other_voxel, args.other_channels);
  STD_TORCH_CHECK(!other_bzyxc.has_value() || (other_component >= 0 && other_component < args.other_channels),
                  "gvtorch: other_component out of range");
  require(parameter_54, "parameter_54", origin_r3, real);
  STD_TORCH_CHECK(features >= 0 && features <= INT32_MAX, "gvtorch: features out of range");
  args.features = static_cast<int32_t>(features);
  STD_TORCH_CHECK(parameter_54.numel() <= INT32_MAX, "gvtorch: parameter_54 is too large");
  args.parameters = static_cast<int32_t>(parameter_54.numel());
  Shaders::check(args, shader);
  Tensor normal_r3 = torch::stable::new_empty(table_lm4, {args.rays, 3});
  Tensor features_rc = torch::stable::new_empty(table_lm4, {args.rays, features});
  args.other_component = static_cast<int32_t>(other_component);
  args.parameter_54 = parameter_54.const_data_ptr();
  args.normal_r3 = normal_r3.mutable_data_ptr();
  args.features_rc = features_rc.mutable_data_ptr();
  Shaders::template run<Device>(origin_r3, args, real == ScalarType::Double);
  return {found.color_r3, found.alpha_r1, found.depth_r1, found.samples_r, found.missed_r, normal_r3, features_rc};
}

}  // namespace gvtorch
