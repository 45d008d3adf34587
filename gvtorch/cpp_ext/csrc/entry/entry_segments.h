// The ops of segments: from tensors to the views of segments.h. See entry.h.
#pragma once

#include <vector>

#include "entry/entry.h"
#include "shaders/segments.h"
#include "shaders/shade_each.h"

namespace gvtorch {

// Calls body(T{}) with float or double.
template <class Body>
void with_real(const Tensor& tensor, const Body& body) {
  if (is_wide(tensor)) {
    body(double{});
  } else {
    body(float{});
  }
}

template <class T>
T* fill(const Tensor& tensor) {
  return data<T>(tensor);
}
template <class T>
const T* read(const Tensor& tensor) {
  return data<const T>(tensor);
}

// --- Walks

// A part of a walk: it goes on from state_r3, and pauses after `limit` samples.
#define GV_PART(X)                  \
  X(MaybeReals, state_r3, 3 * rays) \
  X(Int, limit, kAny)               \
  X(Bool, by_node, kAny)
#define GV_PLACES(X) X(Longs, first_r, rays) X(Count, total, kAny)
#define GV_COUNT_SEGMENTS(X) GV_TRACE_RAYS(X) GV_PART(X)
#define GV_WRITE_SEGMENTS(X) GV_COUNT_SEGMENTS(X) GV_PLACES(X)
GV_OP(CountSegmentsOp, "count_segments", GV_COUNT_SEGMENTS, "(Tensor count_r3, Tensor state_r3, Tensor missed_r)");
GV_OP(WriteSegmentsOp, "write_segments", GV_WRITE_SEGMENTS,
      "(Tensor ray_s, Tensor node_s2, Tensor brick_s2, Tensor depth_s3, Tensor interval_s3, Tensor distance_s3, "
      "Tensor t0_s, Tensor t1_s)");

// Checks a walk, and runs make(WalkRay) for every ray.
template <class Device, class Op, class Make>
void walk_rays(const Op& a, const Make& make) {
  TraceArgs args{};
  lay_ready(args, a);
  with_real(a.table_lm4, [&](auto real) {
    using T = decltype(real);
    const T* state = a.state_r3.has_value() ? read<T>(*a.state_r3) : nullptr;
    ShadeRay<T, Plain<T>> kernel{PlainArgs(args)};
    const Tensor hidden_tn = hide_nodes<Device>(a.origin_r3, args.nodes, kernel);
    const WalkRay<T> walk{kernel, state, static_cast<int32_t>(a.limit), a.by_node};
    for_each<Device>(a.origin_r3, kernel.order.count(), make(walk, real));
  });
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor> run(const CountSegmentsOp& a) {
  const int64_t rays = check_rays(a.origin_r3);
  const Like like{a.origin_r3, a.table_lm4.scalar_type()};
  GV_PART(GV_CHECK)
  Tensor count_r3 = torch::stable::new_empty(a.origin_r3, {rays, 3}, ScalarType::Int);
  Tensor next_r3 = torch::stable::new_empty(a.table_lm4, {rays, 3});
  Tensor missed_r = torch::stable::new_empty(a.origin_r3, {rays}, ScalarType::Bool);
  walk_rays<Device>(a, [&](auto walk, auto real) {
    using T = decltype(real);
    return CountSegments<T, decltype(walk)>{walk, fill<int32_t>(count_r3), fill<T>(next_r3), fill<bool>(missed_r)};
  });
  return {count_r3, next_r3, missed_r};
}

template <class Device>
auto run(const WriteSegmentsOp& a) {
  const int64_t rays = check_rays(a.origin_r3), total = a.total;
  const Like like{a.origin_r3, a.table_lm4.scalar_type()};
  GV_PART(GV_CHECK)
  GV_PLACES(GV_CHECK)
  Tensor ray_s, node_s2, brick_s2, depth_s3, interval_s3, distance_s3, t0_s, t1_s;
  walk_rays<Device>(a, [&](auto walk, auto real) {
    using T = decltype(real);
    SegmentView<T> out{};
    ray_s = give(out.ray_s, a.child_tn, {total});
    node_s2 = give(out.node_s2, a.child_tn, {total, 2});
    brick_s2 = give(out.brick_s2, a.child_tn, {total, 2});
    depth_s3 = give(out.depth_s3, a.child_tn, {total, 3});
    interval_s3 = give(out.interval_s3, a.child_tn, {total, 3});
    distance_s3 = give(out.distance_s3, a.table_lm4, {total, 3});
    t0_s = give(out.t0_s, a.table_lm4, {total});
    t1_s = give(out.t1_s, a.table_lm4, {total});
    return WriteSegments<T, decltype(walk)>{walk, read<int64_t>(a.first_r), total, out};
  });
  return std::make_tuple(ray_s, node_s2, brick_s2, depth_s3, interval_s3, distance_s3, t0_s, t1_s);
}

// --- Samples

// Segments, and samples of them. segments, samples
#define GV_SAMPLES(X)                 \
  X(Words, ray_s, segments)           \
  X(Words, node_s2, 2 * segments)     \
  X(Words, brick_s2, 2 * segments)    \
  X(Words, depth_s3, 3 * segments)    \
  X(Words, interval_s3, 3 * segments) \
  X(Reals, distance_s3, 3 * segments) \
  X(Words, segment_k, samples)        \
  X(Words, number_k, samples)
#define GV_SAMPLE_BRICKS(X) GV_RAYS(X) GV_CHANNEL(X) GV_SAMPLES(X)
#define GV_SAMPLE_BRICKS_BACKWARD(X) X(Reals, grad_kc, samples* channels) GV_SAMPLE_BRICKS(X)
GV_OP(SampleBricksOp, "sample_bricks", GV_SAMPLE_BRICKS, "Tensor value_kc");
GV_OP(SampleBricksBackwardOp, "sample_bricks_backward", GV_SAMPLE_BRICKS_BACKWARD,
      "(Tensor grad_bzyxc, Tensor grad_tnc)");

// Checks what both read; returns the kernels' side of rays and channel.
template <class Op>
TraceArgs lay_channel(const Op& a) {
  const Like like{a.origin_r3, a.distance_s3.scalar_type(), a.bricks_bzyxc.scalar_type()};
  const int64_t rays = check_rays(a.origin_r3), side = check_bricks(a.bricks_bzyxc);
  STD_TORCH_CHECK(a.constant_tnc.dim() == 3, "gvtorch: constant_tnc must be (t, n, c)");
  const int64_t nodes = a.constant_tnc.size(0) * a.constant_tnc.size(1), channels = a.bricks_bzyxc.size(4);
  STD_TORCH_CHECK(nodes <= INT32_MAX, "gvtorch: constant_tnc is too large");
  const int64_t segments = a.ray_s.numel(), samples = a.segment_k.numel();
  GV_SAMPLE_BRICKS(GV_CHECK)
  check_numbers(a);
  TraceArgs args{};
  GV_RAYS(GV_LAY)
  GV_CHANNEL(GV_LAY)
  args.rays = rays;
  args.nodes = nodes;
  args.bricks = a.bricks_bzyxc.size(0);
  args.voxel = voxel_type(like.voxel);
  lay(args.side, side);
  lay(args.channels, channels);
  return args;
}

template <class T, class Voxel, class Op>
AimSample<T, Voxel> aim(const TraceArgs& args, const Op& a) {
  TreeView tree{};
  tree.branching = args.branching;
  tree.max_depth = args.max_depth;
  tree.digit_bits = digit_bits_of(tree.branching, tree.max_depth);
  const Levels<T> levels(static_cast<T>(a.root_voxel), static_cast<T>(args.side - 2 * args.border), tree.branching);
  const BrickView<Voxel> bricks{static_cast<const Voxel*>(args.bricks_bzyxc),
                                static_cast<const Voxel*>(args.constant_tnc),
                                nullptr,
                                nullptr,
                                args.bricks,
                                args.side,
                                args.border,
                                args.channels,
                                0};
  const RayView rays{args.origin_r3, args.direction_r3, args.cone_r2, args.range_r2, args.place_33, args.cone_scale};
  SegmentView<T> segments{};  // which is not written to here
  segments.ray_s = const_cast<int32_t*>(read<int32_t>(a.ray_s));
  segments.node_s2 = const_cast<int32_t*>(read<int32_t>(a.node_s2));
  segments.brick_s2 = const_cast<int32_t*>(read<int32_t>(a.brick_s2));
  segments.depth_s3 = const_cast<int32_t*>(read<int32_t>(a.depth_s3));
  segments.interval_s3 = const_cast<int32_t*>(read<int32_t>(a.interval_s3));
  segments.distance_s3 = const_cast<T*>(read<T>(a.distance_s3));
  const int32_t *segment = read<int32_t>(a.segment_k), *number = read<int32_t>(a.number_k);
  const T step = static_cast<T>(a.step);
  return {rays, tree, levels, bricks, segments, segment, number, args.rays, a.ray_s.numel(), args.nodes, step};
}

template <class Device>
Tensor run(const SampleBricksOp& a) {
  const TraceArgs args = lay_channel(a);
  const int64_t samples = a.segment_k.numel();
  Tensor value_kc = torch::stable::new_empty(a.distance_s3, {samples, args.channels});
  with_real(a.distance_s3, [&](auto real) {
    using T = decltype(real);
    with_voxel(args.voxel, [&](auto voxel) {
      using Voxel = decltype(voxel);
      for_each<Device>(a.origin_r3, samples, SampleBricks<T, Voxel>{aim<T, Voxel>(args, a), fill<T>(value_kc)});
    });
  });
  return value_kc;
}

template <class Device>
std::tuple<Tensor, Tensor> run(const SampleBricksBackwardOp& a) {
  const TraceArgs args = lay_channel(a);
  const int64_t samples = a.segment_k.numel(), side = args.side, channels = args.channels;
  require<kinds::Reals>(a.grad_kc, "grad_kc", {a.origin_r3, a.distance_s3.scalar_type()}, samples * channels);
  Tensor grad_bzyxc = torch::stable::new_zeros(a.distance_s3, {args.bricks, side, side, side, channels});
  Tensor grad_tnc = torch::stable::new_zeros(a.distance_s3, {a.constant_tnc.size(0), a.constant_tnc.size(1), channels});
  with_real(a.distance_s3, [&](auto real) {
    using T = decltype(real);
    with_voxel(args.voxel, [&](auto voxel) {
      using Voxel = decltype(voxel);
      const SpreadGradient<T, Voxel> body{aim<T, Voxel>(args, a), read<T>(a.grad_kc), fill<T>(grad_bzyxc),
                                          fill<T>(grad_tnc)};
      for_each<Device>(a.origin_r3, samples, body);
    });
  });
  return {grad_bzyxc, grad_tnc};
}

// --- Compositing

// Packed samples of rays. count, rays, channels
#define GV_COMPOSITE(X)                 \
  X(Reals, alpha_k, count)              \
  X(Reals, feature_kc, count* channels) \
  X(Longs, offset_r, rays + 1)          \
  X(Reals, clear_r, rays)               \
  X(Float, stop_clear, kAny)
#define GV_COMPOSITE_BACKWARD(X)        \
  X(Reals, grad_sum_rc, rays* channels) \
  X(Reals, grad_left_r, rays)           \
  X(Reals, alpha_k, count)              \
  X(Reals, feature_kc, count* channels) \
  X(Longs, offset_r, rays + 1)          \
  X(Reals, before_k, count)             \
  X(Float, stop_clear, kAny)
GV_OP(CompositeOp, "composite", GV_COMPOSITE, "(Tensor sum_rc, Tensor left_r, Tensor before_k)");
GV_OP(CompositeBackwardOp, "composite_backward", GV_COMPOSITE_BACKWARD,
      "(Tensor grad_alpha_k, Tensor grad_feature_kc, Tensor grad_clear_r)");

template <class Op>
PackedView packed(const Op& a) {
  STD_TORCH_CHECK(a.feature_kc.dim() == 2 && a.feature_kc.size(1) <= INT32_MAX, "gvtorch: feature_kc must be (k, c)");
  STD_TORCH_CHECK(a.offset_r.numel() >= 1, "gvtorch: offset_r must be (r + 1,)");
  return {read<int64_t>(a.offset_r), a.feature_kc.size(0), static_cast<int32_t>(a.feature_kc.size(1))};
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor> run(const CompositeOp& a) {
  const PackedView view = packed(a);
  const int64_t rays = a.offset_r.numel() - 1, count = view.count, channels = view.channels;
  const Like like{a.alpha_k, a.alpha_k.scalar_type()};
  GV_COMPOSITE(GV_CHECK)
  Tensor sum_rc = torch::stable::new_empty(a.alpha_k, {rays, channels});
  Tensor left_r = torch::stable::new_empty(a.alpha_k, {rays});
  Tensor before_k = torch::stable::new_zeros(a.alpha_k, {count});
  with_real(a.alpha_k, [&](auto real) {
    using T = decltype(real);
    const T *alpha = read<T>(a.alpha_k), *feature = read<T>(a.feature_kc), *clear = read<T>(a.clear_r);
    const CompositeRay<T> body{
        view, alpha, feature, clear, static_cast<T>(a.stop_clear), fill<T>(sum_rc), fill<T>(left_r), fill<T>(before_k)};
    for_each<Device>(a.alpha_k, rays, body);
  });
  return {sum_rc, left_r, before_k};
}

template <class Device>
std::tuple<Tensor, Tensor, Tensor> run(const CompositeBackwardOp& a) {
  const PackedView view = packed(a);
  const int64_t rays = a.offset_r.numel() - 1, count = view.count, channels = view.channels;
  const Like like{a.alpha_k, a.alpha_k.scalar_type()};
  GV_COMPOSITE_BACKWARD(GV_CHECK)
  Tensor grad_alpha_k = torch::stable::new_zeros(a.alpha_k, {count});
  Tensor grad_feature_kc = torch::stable::new_zeros(a.alpha_k, {count, channels});
  Tensor grad_clear_r = torch::stable::new_empty(a.alpha_k, {rays});
  with_real(a.alpha_k, [&](auto real) {
    using T = decltype(real);
    const CompositeGradient<T> body{view,
                                    read<T>(a.alpha_k),
                                    read<T>(a.feature_kc),
                                    read<T>(a.before_k),
                                    read<T>(a.grad_sum_rc),
                                    read<T>(a.grad_left_r),
                                    static_cast<T>(a.stop_clear),
                                    fill<T>(grad_alpha_k),
                                    fill<T>(grad_feature_kc),
                                    fill<T>(grad_clear_r)};
    for_each<Device>(a.alpha_k, rays, body);
  });
  return {grad_alpha_k, grad_feature_kc, grad_clear_r};
}

using SegmentOps =
    Types<CountSegmentsOp, WriteSegmentsOp, SampleBricksOp, SampleBricksBackwardOp, CompositeOp, CompositeBackwardOp>;

}  // namespace gvtorch
