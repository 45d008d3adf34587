// From tensors to the views of segments.h: schemas and memory checks, as entry.h has them for the other ops.
#pragma once

#include <initializer_list>
#include <optional>
#include <vector>

#include "entry.h"
#include "segments.h"

namespace gvtorch {

// The tree's tensors as in `trace_rays`; of the transfer function only what tells which nodes are hidden.
#define GV_WALK_SCHEMA                                                                         \
  "Tensor origin_r3, Tensor direction_r3, Tensor cone_r2, Tensor range_r2, Tensor place_33, "  \
  "Tensor child_tn, Tensor brick_tn, Tensor(a!) request_tn, Tensor(b!) stamp_t, "              \
  "Tensor bricks_bzyxc, Tensor constant_tnc, Tensor range_tn2c, Tensor(c!) stamp_b, "          \
  "Tensor domain_2, Tensor opaque_m, Tensor frame_1, Tensor? state_r3, "                       \
  "int width, int branching, int root, int max_depth, int border, int component, int levels, " \
  "int limit, float cone_scale, float root_voxel, float step, bool by_level, bool by_node"
#define GV_SAMPLE_SCHEMA                                                                         \
  "Tensor origin_r3, Tensor direction_r3, Tensor cone_r2, Tensor range_r2, Tensor place_33, "    \
  "Tensor bricks_bzyxc, Tensor constant_tnc, Tensor ray_s, Tensor node_s2, Tensor brick_s2, "    \
  "Tensor depth_s3, Tensor interval_s3, Tensor distance_s3, Tensor segment_k, Tensor number_k, " \
  "int branching, int max_depth, int border, float cone_scale, float root_voxel, float step"

constexpr const char* kCountSegmentsSchema =
    "count_segments(" GV_WALK_SCHEMA ") -> (Tensor count_r3, Tensor state_r3, Tensor missed_r)";
constexpr const char* kWriteSegmentsSchema =
    "write_segments(" GV_WALK_SCHEMA
    ", Tensor first_r, SymInt total) -> (Tensor ray_s, Tensor node_s2, Tensor brick_s2, Tensor depth_s3, "
    "Tensor interval_s3, Tensor t0_s, Tensor t1_s, Tensor distance_s3)";
constexpr const char* kSampleBricksSchema = "sample_bricks(" GV_SAMPLE_SCHEMA ") -> Tensor value_kc";
constexpr const char* kSampleBricksBackwardSchema =
    "sample_bricks_backward(Tensor grad_kc, " GV_SAMPLE_SCHEMA ") -> (Tensor grad_bzyxc, Tensor grad_tnc)";
constexpr const char* kCompositeSchema =
    "composite(Tensor alpha_k, Tensor feature_kc, Tensor offset_r, Tensor clear_r, float stop_clear"
    ") -> (Tensor sum_rc, Tensor left_r, Tensor before_k)";
constexpr const char* kCompositeBackwardSchema =
    "composite_backward(Tensor grad_sum_rc, Tensor grad_left_r, Tensor alpha_k, Tensor feature_kc, "
    "Tensor offset_r, Tensor before_k, float stop_clear"
    ") -> (Tensor grad_alpha_k, Tensor grad_feature_kc, Tensor grad_clear_r)";
#undef GV_WALK_SCHEMA
#undef GV_SAMPLE_SCHEMA

struct Named {
  const Tensor& tensor;
  const char* name;
  int64_t numel;
};

inline void require_all(std::initializer_list<Named> all, const Tensor& like, ScalarType dtype) {
  for (const Named& one : all) {
    require(one.tensor, one.name, like, dtype);
    require_numel(one.tensor, one.name, one.numel);
  }
}

template <class T>
T* reals(const Tensor& tensor) {
  return static_cast<T*>(tensor.mutable_data_ptr());
}
inline const double* world(const Tensor& tensor) { return static_cast<const double*>(tensor.const_data_ptr()); }

// Calls body(T{}) with the type that a dtype of floats stands for.
template <class Body>
void with_real(ScalarType dtype, const char* name, const Body& body) {
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double, "gvtorch: ", name,
                  " must be float32 or float64");
  if (dtype == ScalarType::Double) {
    body(double{});
  } else {
    body(float{});
  }
}

inline void check_rays(const Tensor& origin_r3, const Tensor& direction_r3, const Tensor& cone_r2,
                       const Tensor& range_r2, const Tensor& place_33) {
  STD_TORCH_CHECK(origin_r3.dim() == 2 && origin_r3.size(1) == 3 && origin_r3.size(0) <= INT32_MAX,
                  "gvtorch: origin_r3 must be (r, 3)");
  const int64_t rays = origin_r3.size(0);
  require_all({{origin_r3, "origin_r3", 3 * rays},
               {direction_r3, "direction_r3", 3 * rays},
               {cone_r2, "cone_r2", 2 * rays},
               {range_r2, "range_r2", 2 * rays},
               {place_33, "place_33", 9}},
              origin_r3, ScalarType::Double);
}

inline void check_bricks(const Tensor& bricks_bzyxc, const Tensor& constant_tnc, const Tensor& like, int64_t border,
                         int64_t branching, int64_t max_depth, double step, double root_voxel) {
  STD_TORCH_CHECK(bricks_bzyxc.dim() == 5 && bricks_bzyxc.size(1) >= 2 && bricks_bzyxc.size(1) <= 1024 &&
                      bricks_bzyxc.size(1) == bricks_bzyxc.size(2) && bricks_bzyxc.size(2) == bricks_bzyxc.size(3),
                  "gvtorch: bricks_bzyxc must be (b, s, s, s, c) with s >= 2");
  const int64_t side = bricks_bzyxc.size(1);
  STD_TORCH_CHECK(side * side * side * bricks_bzyxc.size(4) <= INT32_MAX / 8, "gvtorch: a brick is too large");
  STD_TORCH_CHECK(constant_tnc.dim() == 3 && constant_tnc.size(2) == bricks_bzyxc.size(4) &&
                      constant_tnc.size(0) * constant_tnc.size(1) <= INT32_MAX,
                  "gvtorch: constant_tnc must be (t, n, c)");
  STD_TORCH_CHECK(branching >= 2 && branching <= 16 && max_depth >= 0 && max_depth < kMostLevels && border >= 0 &&
                      side > 2 * border && step > 0 && root_voxel > 0,
                  "gvtorch: tree out of range");
  require(bricks_bzyxc, "bricks_bzyxc", like, bricks_bzyxc.scalar_type());
  require(constant_tnc, "constant_tnc", like, bricks_bzyxc.scalar_type());
}

// Everything that a walk reads and writes.
struct WalkTensors {
  const Tensor &origin_r3, &direction_r3, &cone_r2, &range_r2, &place_33, &child_tn, &brick_tn, &request_tn, &stamp_t,
      &bricks_bzyxc, &constant_tnc, &range_tn2c, &stamp_b, &domain_2, &opaque_m, &frame_1;
  const std::optional<Tensor>& state_r3;
  int64_t width, branching, root, max_depth, border, component, levels, limit;
  double cone_scale, root_voxel, step;
  bool by_level, by_node;

  void check() const {
    check_rays(origin_r3, direction_r3, cone_r2, range_r2, place_33);
    check_bricks(bricks_bzyxc, constant_tnc, origin_r3, border, branching, max_depth, step, root_voxel);
    const int64_t rays = origin_r3.size(0), nodes = child_tn.numel(), channels = bricks_bzyxc.size(4);
    STD_TORCH_CHECK(child_tn.dim() == 2 && child_tn.size(1) >= branching * branching * branching && nodes <= INT32_MAX,
                    "gvtorch: child_tn must be (t, n)");
    STD_TORCH_CHECK(root >= 0 && root < nodes && component >= 0 && component < channels,
                    "gvtorch: root or component out of range");
    STD_TORCH_CHECK(width >= 0 && (width == 0 || rays % width == 0), "gvtorch: rays are no rows of this width");
    STD_TORCH_CHECK(levels >= 1 && levels <= INT32_MAX && limit >= 0 && limit <= INT32_MAX,
                    "gvtorch: levels or limit out of range");
    STD_TORCH_CHECK(opaque_m.numel() >= 2 && opaque_m.numel() <= INT32_MAX,
                    "gvtorch: opaque_m must hold at least 2 elements");
    require_all({{child_tn, "child_tn", nodes},
                 {brick_tn, "brick_tn", nodes},
                 {request_tn, "request_tn", nodes},
                 {stamp_t, "stamp_t", child_tn.size(0)},
                 {stamp_b, "stamp_b", bricks_bzyxc.size(0)},
                 {opaque_m, "opaque_m", opaque_m.numel()},
                 {frame_1, "frame_1", 1}},
                origin_r3, ScalarType::Int);
    require_all({{constant_tnc, "constant_tnc", nodes * channels}, {range_tn2c, "range_tn2c", 2 * nodes * channels}},
                origin_r3, bricks_bzyxc.scalar_type());
    require_all({{domain_2, "domain_2", 2}}, origin_r3, domain_2.scalar_type());
    if (state_r3.has_value()) require_all({{*state_r3, "state_r3", 3 * rays}}, origin_r3, domain_2.scalar_type());
  }
  TraceArgs args() const {
    TraceArgs args{};
    args.origin_r3 = world(origin_r3);
    args.direction_r3 = world(direction_r3);
    args.cone_r2 = world(cone_r2);
    args.range_r2 = world(range_r2);
    args.place_33 = world(place_33);
    args.child_tn = words_in(child_tn);
    args.brick_tn = words_in(brick_tn);
    args.request_tn = words_out(request_tn);
    args.stamp_t = words_out(stamp_t);
    args.bricks_bzyxc = bricks_bzyxc.const_data_ptr();
    args.constant_tnc = constant_tnc.const_data_ptr();
    args.range_tn2c = range_tn2c.const_data_ptr();
    args.stamp_b = words_out(stamp_b);
    args.domain_2 = domain_2.const_data_ptr();
    args.opaque_m = words_in(opaque_m);
    args.frame_1 = words_in(frame_1);
    args.rays = origin_r3.size(0);
    args.width = width;
    args.bricks = bricks_bzyxc.size(0);
    args.nodes = child_tn.numel();
    args.voxel = voxel_type(bricks_bzyxc.scalar_type());
    args.root = static_cast<int32_t>(root);
    args.nodes_per_tile = static_cast<int32_t>(child_tn.size(1));
    args.branching = static_cast<int32_t>(branching);
    args.max_depth = static_cast<int32_t>(max_depth);
    args.side = static_cast<int32_t>(bricks_bzyxc.size(1));
    args.border = static_cast<int32_t>(border);
    args.channels = static_cast<int32_t>(bricks_bzyxc.size(4));
    args.component = static_cast<int32_t>(component);
    args.rows = static_cast<int32_t>(opaque_m.numel());
    args.levels = static_cast<int32_t>(levels);
    args.cone_scale = cone_scale;
    args.root_voxel = root_voxel;
    args.step = step;
    args.stop_alpha = args.depth_alpha = 1;
    args.by_level = by_level;
    return args;
  }
  // Runs make(WalkRay) for every ray, with the channel's voxel type.
  template <class Device, class T, class Make>
  void run(const Make& make) const {
    TraceArgs args = this->args();
    Tensor hidden_tn = torch::stable::new_zeros(origin_r3, {args.nodes}, ScalarType::Byte);
    args.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
    const T* state = state_r3.has_value() ? reals<T>(*state_r3) : nullptr;
    with_voxel(args.voxel, [&](auto voxel) {
      const TraceRay<T, decltype(voxel)> trace(args);
      const WalkRay<T, decltype(voxel)> walk{trace, state, static_cast<int32_t>(limit), by_node};
      for_each<Device>(origin_r3, trace.order.count(), make(walk));
    });
  }
};

#define GV_WALK_PARAMETERS                                                                                     \
  const Tensor &origin_r3, const Tensor &direction_r3, const Tensor &cone_r2, const Tensor &range_r2,          \
      const Tensor &place_33, const Tensor &child_tn, const Tensor &brick_tn, const Tensor &request_tn,        \
      const Tensor &stamp_t, const Tensor &bricks_bzyxc, const Tensor &constant_tnc, const Tensor &range_tn2c, \
      const Tensor &stamp_b, const Tensor &domain_2, const Tensor &opaque_m, const Tensor &frame_1,            \
      const std::optional<Tensor>&state_r3, int64_t width, int64_t branching, int64_t root, int64_t max_depth, \
      int64_t border, int64_t component, int64_t levels, int64_t limit, double cone_scale, double root_voxel,  \
      double step, bool by_level, bool by_node
#define GV_WALK_ARGUMENTS                                                                                          \
  origin_r3, direction_r3, cone_r2, range_r2, place_33, child_tn, brick_tn, request_tn, stamp_t, bricks_bzyxc,     \
      constant_tnc, range_tn2c, stamp_b, domain_2, opaque_m, frame_1, state_r3, width, branching, root, max_depth, \
      border, component, levels, limit, cone_scale, root_voxel, step, by_level, by_node

template <class Device>
std::tuple<Tensor, Tensor, Tensor> count_segments(GV_WALK_PARAMETERS) {
  const WalkTensors walk_tensors{GV_WALK_ARGUMENTS};
  walk_tensors.check();
  const int64_t rays = origin_r3.size(0);
  Tensor count_r3 = torch::stable::new_empty(origin_r3, {rays, 3}, ScalarType::Int);
  Tensor next_r3 = torch::stable::new_empty(domain_2, {rays, 3});
  Tensor missed_r = torch::stable::new_empty(origin_r3, {rays}, ScalarType::Bool);
  with_real(domain_2.scalar_type(), "domain_2", [&](auto real) {
    using T = decltype(real);
    walk_tensors.run<Device, T>([&](auto walk) {
      return CountSegments<T, decltype(walk)>{walk, words_out(count_r3), reals<T>(next_r3), reals<bool>(missed_r)};
    });
  });
  return {count_r3, next_r3, missed_r};
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> write_segments(GV_WALK_PARAMETERS,
                                                                                          const Tensor& first_r,
                                                                                          int64_t total) {
  const WalkTensors walk_tensors{GV_WALK_ARGUMENTS};
  walk_tensors.check();
  require_all({{first_r, "first_r", origin_r3.size(0)}}, origin_r3, ScalarType::Long);
  STD_TORCH_CHECK(total >= 0, "gvtorch: total must not be negative");
  const auto words = [&](int64_t width) {
    return torch::stable::new_empty(child_tn,
                                    width == 1 ? std::vector<int64_t>{total} : std::vector<int64_t>{total, width});
  };
  Tensor ray_s = words(1), node_s2 = words(2), brick_s2 = words(2), depth_s3 = words(3), interval_s3 = words(3);
  Tensor t0_s = torch::stable::new_empty(domain_2, {total}), t1_s = torch::stable::new_empty(domain_2, {total});
  Tensor distance_s3 = torch::stable::new_empty(domain_2, {total, 3});
  with_real(domain_2.scalar_type(), "domain_2", [&](auto real) {
    using T = decltype(real);
    const SegmentView<T> out{words_out(ray_s),       words_out(node_s2), words_out(brick_s2), words_out(depth_s3),
                             words_out(interval_s3), reals<T>(t0_s),     reals<T>(t1_s),      reals<T>(distance_s3)};
    const auto* first = static_cast<const int64_t*>(first_r.const_data_ptr());
    walk_tensors.run<Device, T>([&](auto walk) { return WriteSegments<T, decltype(walk)>{walk, first, total, out}; });
  });
  return {ray_s, node_s2, brick_s2, depth_s3, interval_s3, t0_s, t1_s, distance_s3};
}
#undef GV_WALK_PARAMETERS
#undef GV_WALK_ARGUMENTS

// What `sample_bricks` and its gradient read.
struct SampleTensors {
  const Tensor &origin_r3, &direction_r3, &cone_r2, &range_r2, &place_33, &bricks_bzyxc, &constant_tnc, &ray_s,
      &node_s2, &brick_s2, &depth_s3, &interval_s3, &distance_s3, &segment_k, &number_k;
  int64_t branching, max_depth, border;
  double cone_scale, root_voxel, step;

  void check() const {
    check_rays(origin_r3, direction_r3, cone_r2, range_r2, place_33);
    check_bricks(bricks_bzyxc, constant_tnc, origin_r3, border, branching, max_depth, step, root_voxel);
    const int64_t segments = ray_s.numel(), samples = segment_k.numel();
    require_all({{ray_s, "ray_s", segments},
                 {node_s2, "node_s2", 2 * segments},
                 {brick_s2, "brick_s2", 2 * segments},
                 {depth_s3, "depth_s3", 3 * segments},
                 {interval_s3, "interval_s3", 3 * segments},
                 {segment_k, "segment_k", samples},
                 {number_k, "number_k", samples}},
                origin_r3, ScalarType::Int);
    require_all({{distance_s3, "distance_s3", 3 * segments}}, origin_r3, distance_s3.scalar_type());
  }
  template <class T, class Voxel>
  AimSample<T, Voxel> aim() const {
    TreeView tree{};
    tree.branching = static_cast<int32_t>(branching);
    tree.max_depth = static_cast<int32_t>(max_depth);
    tree.digit_bits = digit_bits_of(tree.branching, tree.max_depth);
    const auto side = static_cast<int32_t>(bricks_bzyxc.size(1));
    const auto channels = static_cast<int32_t>(bricks_bzyxc.size(4));
    const Levels<T> levels(static_cast<T>(root_voxel), static_cast<T>(side - 2 * border), tree.branching);
    const BrickView<Voxel> bricks{static_cast<const Voxel*>(bricks_bzyxc.const_data_ptr()),
                                  static_cast<const Voxel*>(constant_tnc.const_data_ptr()),
                                  nullptr,
                                  nullptr,
                                  bricks_bzyxc.size(0),
                                  side,
                                  static_cast<int32_t>(border),
                                  channels,
                                  0};
    const RayView rays{world(origin_r3), world(direction_r3), world(cone_r2),
                       world(range_r2),  world(place_33),     cone_scale};
    const SegmentView<T> segments{const_cast<int32_t*>(words_in(ray_s)),
                                  const_cast<int32_t*>(words_in(node_s2)),
                                  const_cast<int32_t*>(words_in(brick_s2)),
                                  const_cast<int32_t*>(words_in(depth_s3)),
                                  const_cast<int32_t*>(words_in(interval_s3)),
                                  nullptr,
                                  nullptr,
                                  const_cast<T*>(static_cast<const T*>(distance_s3.const_data_ptr()))};
    return {rays,
            tree,
            levels,
            bricks,
            segments,
            words_in(segment_k),
            words_in(number_k),
            origin_r3.size(0),
            ray_s.numel(),
            constant_tnc.size(0) * constant_tnc.size(1),
            static_cast<T>(step)};
  }
};

#define GV_SAMPLE_PARAMETERS                                                                               \
  const Tensor &origin_r3, const Tensor &direction_r3, const Tensor &cone_r2, const Tensor &range_r2,      \
      const Tensor &place_33, const Tensor &bricks_bzyxc, const Tensor &constant_tnc, const Tensor &ray_s, \
      const Tensor &node_s2, const Tensor &brick_s2, const Tensor &depth_s3, const Tensor &interval_s3,    \
      const Tensor &distance_s3, const Tensor &segment_k, const Tensor &number_k, int64_t branching,       \
      int64_t max_depth, int64_t border, double cone_scale, double root_voxel, double step
#define GV_SAMPLE_ARGUMENTS                                                                                          \
  origin_r3, direction_r3, cone_r2, range_r2, place_33, bricks_bzyxc, constant_tnc, ray_s, node_s2, brick_s2,        \
      depth_s3, interval_s3, distance_s3, segment_k, number_k, branching, max_depth, border, cone_scale, root_voxel, \
      step

template <class Device>
Tensor sample_bricks(GV_SAMPLE_PARAMETERS) {
  const SampleTensors read{GV_SAMPLE_ARGUMENTS};
  read.check();
  Tensor value_kc = torch::stable::new_empty(distance_s3, {segment_k.numel(), bricks_bzyxc.size(4)});
  with_real(distance_s3.scalar_type(), "distance_s3", [&](auto real) {
    using T = decltype(real);
    with_voxel(voxel_type(bricks_bzyxc.scalar_type()), [&](auto voxel) {
      using Voxel = decltype(voxel);
      for_each<Device>(origin_r3, segment_k.numel(), SampleBricks<T, Voxel>{read.aim<T, Voxel>(), reals<T>(value_kc)});
    });
  });
  return value_kc;
}

template <class Device>
std::tuple<Tensor, Tensor> sample_bricks_backward(const Tensor& grad_kc, GV_SAMPLE_PARAMETERS) {
  const SampleTensors read{GV_SAMPLE_ARGUMENTS};
  read.check();
  const ScalarType dtype = distance_s3.scalar_type();
  const int64_t side = bricks_bzyxc.size(1), channels = bricks_bzyxc.size(4);
  require_all({{grad_kc, "grad_kc", segment_k.numel() * channels}}, origin_r3, dtype);
  Tensor grad_bzyxc = torch::stable::new_zeros(distance_s3, {bricks_bzyxc.size(0), side, side, side, channels});
  Tensor grad_tnc = torch::stable::new_zeros(distance_s3, {constant_tnc.size(0), constant_tnc.size(1), channels});
  with_real(dtype, "distance_s3", [&](auto real) {
    using T = decltype(real);
    const auto* grad = static_cast<const T*>(grad_kc.const_data_ptr());
    with_voxel(voxel_type(bricks_bzyxc.scalar_type()), [&](auto voxel) {
      using Voxel = decltype(voxel);
      const SpreadGradient<T, Voxel> body{read.aim<T, Voxel>(), grad, reals<T>(grad_bzyxc), reals<T>(grad_tnc)};
      for_each<Device>(origin_r3, segment_k.numel(), body);
    });
  });
  return {grad_bzyxc, grad_tnc};
}
#undef GV_SAMPLE_PARAMETERS
#undef GV_SAMPLE_ARGUMENTS

// Checks packed samples: alpha_k (k,), feature_kc (k, c), offset_r (r + 1,).
inline PackedView packed(const Tensor& alpha_k, const Tensor& feature_kc, const Tensor& offset_r) {
  STD_TORCH_CHECK(feature_kc.dim() == 2 && feature_kc.size(1) <= INT32_MAX, "gvtorch: feature_kc must be (k, c)");
  STD_TORCH_CHECK(offset_r.numel() >= 1, "gvtorch: offset_r must be (r + 1,)");
  const int64_t count = feature_kc.size(0), channels = feature_kc.size(1);
  require_all({{alpha_k, "alpha_k", count}, {feature_kc, "feature_kc", count * channels}}, alpha_k,
              alpha_k.scalar_type());
  require_all({{offset_r, "offset_r", offset_r.numel()}}, alpha_k, ScalarType::Long);
  return {static_cast<const int64_t*>(offset_r.const_data_ptr()), count, static_cast<int32_t>(channels)};
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor> composite(const Tensor& alpha_k, const Tensor& feature_kc, const Tensor& offset_r,
                                             const Tensor& clear_r, double stop_clear) {
  const PackedView view = packed(alpha_k, feature_kc, offset_r);
  const int64_t rays = offset_r.numel() - 1;
  require_all({{clear_r, "clear_r", rays}}, alpha_k, alpha_k.scalar_type());
  Tensor sum_rc = torch::stable::new_empty(alpha_k, {rays, view.channels});
  Tensor left_r = torch::stable::new_empty(alpha_k, {rays});
  Tensor before_k = torch::stable::new_zeros(alpha_k, {view.count});
  with_real(alpha_k.scalar_type(), "alpha_k", [&](auto real) {
    using T = decltype(real);
    const auto in = [](const Tensor& tensor) { return static_cast<const T*>(tensor.const_data_ptr()); };
    const CompositeRay<T> body{view,
                               in(alpha_k),
                               in(feature_kc),
                               in(clear_r),
                               static_cast<T>(stop_clear),
                               reals<T>(sum_rc),
                               reals<T>(left_r),
                               reals<T>(before_k)};
    for_each<Device>(alpha_k, rays, body);
  });
  return {sum_rc, left_r, before_k};
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor> composite_backward(const Tensor& grad_sum_rc, const Tensor& grad_left_r,
                                                      const Tensor& alpha_k, const Tensor& feature_kc,
                                                      const Tensor& offset_r, const Tensor& before_k,
                                                      double stop_clear) {
  const PackedView view = packed(alpha_k, feature_kc, offset_r);
  const int64_t rays = offset_r.numel() - 1;
  require_all({{before_k, "before_k", view.count},
               {grad_sum_rc, "grad_sum_rc", rays * view.channels},
               {grad_left_r, "grad_left_r", rays}},
              alpha_k, alpha_k.scalar_type());
  Tensor grad_alpha_k = torch::stable::new_zeros(alpha_k, {view.count});
  Tensor grad_feature_kc = torch::stable::new_zeros(alpha_k, {view.count, view.channels});
  Tensor grad_clear_r = torch::stable::new_empty(alpha_k, {rays});
  with_real(alpha_k.scalar_type(), "alpha_k", [&](auto real) {
    using T = decltype(real);
    const auto in = [](const Tensor& tensor) { return static_cast<const T*>(tensor.const_data_ptr()); };
    const CompositeGradient<T> body{view,
                                    in(alpha_k),
                                    in(feature_kc),
                                    in(before_k),
                                    in(grad_sum_rc),
                                    in(grad_left_r),
                                    static_cast<T>(stop_clear),
                                    reals<T>(grad_alpha_k),
                                    reals<T>(grad_feature_kc),
                                    reals<T>(grad_clear_r)};
    for_each<Device>(alpha_k, rays, body);
  });
  return {grad_alpha_k, grad_feature_kc, grad_clear_r};
}

// Defines the ops of this file, and adds a device's kernels to them.
template <class Library>
void define_segments(Library& library) {
  for (const char* schema : {kCountSegmentsSchema, kWriteSegmentsSchema, kSampleBricksSchema,
                             kSampleBricksBackwardSchema, kCompositeSchema, kCompositeBackwardSchema})
    library.def(schema);
}

}  // namespace gvtorch

#define GV_IMPLEMENT_SEGMENTS(library, Device)                                                 \
  library.impl("count_segments", TORCH_BOX(&gvtorch::count_segments<Device>));                 \
  library.impl("write_segments", TORCH_BOX(&gvtorch::write_segments<Device>));                 \
  library.impl("sample_bricks", TORCH_BOX(&gvtorch::sample_bricks<Device>));                   \
  library.impl("sample_bricks_backward", TORCH_BOX(&gvtorch::sample_bricks_backward<Device>)); \
  library.impl("composite", TORCH_BOX(&gvtorch::composite<Device>));                           \
  library.impl("composite_backward", TORCH_BOX(&gvtorch::composite_backward<Device>))
