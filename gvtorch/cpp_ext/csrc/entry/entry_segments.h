// The ops of segments: from tensors to the functors of segments.h. See entry.h.
#pragma once

#include "entry/entry.h"
#include "shaders/segments.h"
#include "shaders/shade_each.h"

namespace gvtorch {

// --- Walks

#define GV_COUNT_SEGMENTS(X) GV_TRACE_RAYS(X) GV_PART(X)
#define GV_WRITE_SEGMENTS(X) GV_COUNT_SEGMENTS(X) GV_SEGMENT_RANGE(X)
GV_OP(CountSegmentsOp, "count_segments", GV_COUNT_SEGMENTS, "(Tensor count_r3, Tensor state_r3, Tensor missed_r)");
GV_OP(WriteSegmentsOp, "write_segments", GV_WRITE_SEGMENTS,
      "(Tensor ray_s, Tensor node_s2, Tensor brick_s2, Tensor depth_s3, Tensor interval_s3, Tensor distance_s3, "
      "Tensor t0_s, Tensor t1_s)");

// Returns body(the op's WalkRay).
template <class Op, class Body>
auto with_walk(const Op& a, const Body& body) {
  const ShadeArgs walk_args = make_walk_args(a);
  const int64_t rays = walk_args.rays;
  const Like like{a.origin_r3, a.table_lm4.scalar_type()};
  return with_real(a.table_lm4, [&](auto real) {
    using T = decltype(real);
    return with_digits<T>(walk_args, [&](auto* digits) {
      using Digits = std::decay_t<decltype(*digits)>;
      WalkRay<T, Digits> args{ShadeRay<T, Plain<T>, Digits>(walk_args)};
      GV_PART(GV_CHECK_AND_SET)
      const Tensor node_cache = allocate_node_cache(a.origin_r3, walk_args.nodes, args.kernel);
      return body(args);
    });
  });
}

inline auto run(const CountSegmentsOp& a) {
  return with_walk(a, [&](auto walk) {
    const RayOrder order = walk.kernel.order;
    CountSegments<decltype(walk)> args{walk};
    Tensor count_r3 = make_output(args.count_r3, a.origin_r3, {order.rays, 3});
    Tensor state_r3 = make_output(args.state_r3, a.origin_r3, {order.rays, 3});
    Tensor missed_r = make_output(args.missed_r, a.origin_r3, {order.rays});
    for_each(a.origin_r3, order.count(), args);
    return std::make_tuple(count_r3, state_r3, missed_r);
  });
}

inline auto run(const WriteSegmentsOp& a) {
  return with_walk(a, [&](auto walk) {
    const Like like{a.origin_r3};
    const int64_t rays = walk.kernel.order.rays;
    WriteSegments<decltype(walk)> args{walk};
    GV_SEGMENT_RANGE(GV_CHECK_AND_SET)
    Tensor ray_s = make_output(args.out.ray_s, a.origin_r3, {a.total});
    Tensor node_s2 = make_output(args.out.node_s2, a.origin_r3, {a.total, 2});
    Tensor brick_s2 = make_output(args.out.brick_s2, a.origin_r3, {a.total, 2});
    Tensor depth_s3 = make_output(args.out.depth_s3, a.origin_r3, {a.total, 3});
    Tensor interval_s3 = make_output(args.out.interval_s3, a.origin_r3, {a.total, 3});
    Tensor distance_s3 = make_output(args.out.distance_s3, a.origin_r3, {a.total, 3});
    Tensor t0_s = make_output(args.out.t0_s, a.origin_r3, {a.total});
    Tensor t1_s = make_output(args.out.t1_s, a.origin_r3, {a.total});
    for_each(a.origin_r3, walk.kernel.order.count(), args);
    return std::make_tuple(ray_s, node_s2, brick_s2, depth_s3, interval_s3, distance_s3, t0_s, t1_s);
  });
}

// --- Samples

#define GV_SAMPLE_BRICKS(X) GV_RAYS(X) GV_CHANNEL(X) GV_SAMPLES(X)
#define GV_SAMPLE_BRICKS_BACKWARD(X) GV_GRADIENT(X) GV_SAMPLE_BRICKS(X)
GV_OP(SampleBricksOp, "sample_bricks", GV_SAMPLE_BRICKS, "Tensor value_kc");
GV_OP(SampleBricksBackwardOp, "sample_bricks_backward", GV_SAMPLE_BRICKS_BACKWARD,
      "(Tensor grad_bzyxc, Tensor grad_tnc)");

// Calls body(the op's FindSamples, T{}).
template <class Op, class Body>
void with_samples(const Op& a, const Body& body) {
  const Like like{a.origin_r3, a.distance_s3.scalar_type(), a.bricks_bzyxc.scalar_type()};
  STD_TORCH_CHECK(a.constant_tnc.dim() == 3 && a.constant_tnc.size(1) > 0, "gvtorch: constant_tnc must be (t, n, c)");
  TraceArgs trace_args{};
  trace_args.nodes_per_tile = static_cast<int32_t>(a.constant_tnc.size(1));
  set_channel_args(trace_args, a, like, a.constant_tnc.size(0) * a.constant_tnc.size(1));
  const int64_t samples = a.segment_k.numel();
  with_real(a.distance_s3, [&](auto real) {
    using T = decltype(real);
    FindSamples<T> args{Walk<T>(trace_args),    trace_args.side, trace_args.border,
                        trace_args.voxel_width, a.ray_s.numel(), trace_args.nodes};
    GV_SAMPLES(GV_CHECK_AND_SET)
    body(args, real);
  });
}

inline auto run(const SampleBricksOp& a) {
  Tensor value_kc;
  with_samples(a, [&](const auto& find, auto real) {
    with_voxel(voxel_type(a.bricks_bzyxc.scalar_type()), [&](auto voxel) {
      const int64_t samples = a.segment_k.numel();
      SampleBricks<decltype(real), decltype(voxel)> args{find, to_kernel(a.bricks_bzyxc), to_kernel(a.constant_tnc)};
      value_kc = make_output(args.value_kc, a.distance_s3, {samples, find.width});
      for_each(a.origin_r3, samples, args);
    });
  });
  return value_kc;
}

inline auto run(const SampleBricksBackwardOp& a) {
  Tensor grad_bzyxc, grad_tnc;
  with_samples(a, [&](const auto& find, auto real) {
    const Like like{a.origin_r3, a.distance_s3.scalar_type()};
    const int64_t voxel_width = find.width, side = find.side;
    STD_TORCH_CHECK(a.begin_p.numel() > 0, "gvtorch: begin_p needs an end");
    SpreadGradient<decltype(real)> args{find,
                                        a.segment_k.numel(),
                                        a.entry_e.numel(),
                                        a.begin_p.numel() - 1,
                                        a.brick_x.numel(),
                                        SpreadGradient<decltype(real)>::channels_of(find.width)};
    GV_GRADIENT(GV_CHECK_AND_SET)
    grad_bzyxc = make_zeros(args.grad_bzyxc, a.grad_kc, {a.bricks_bzyxc.size(0), side, side, side, voxel_width});
    grad_tnc = make_zeros(args.grad_tnc, a.grad_kc, {a.constant_tnc.size(0), a.constant_tnc.size(1), voxel_width});
    const Tensor row_xn = make_zeros(args.row_xn, a.grad_kc, {args.rows, find.numbers()});
    for_each(a.origin_r3, args.portions * args.threads(), args);
    for_each(a.origin_r3, args.rows * find.numbers(), AddRows<decltype(real)>{args});
  });
  return std::make_tuple(grad_bzyxc, grad_tnc);
}

// --- Compositing

GV_OP(CompositeOp, "composite", GV_COMPOSITE, "(Tensor sum_rc, Tensor left_r, Tensor before_k)");
GV_OP(CompositeBackwardOp, "composite_backward", GV_COMPOSITE_BACKWARD,
      "(Tensor grad_alpha_k, Tensor grad_feature_kc, Tensor grad_clear_r)");

// Stores how many packed samples there are, and numbers of a feature; returns the number of rays.
template <class Args, class Op>
int64_t set_packed_sizes(Args& args, const Op& a) {
  STD_TORCH_CHECK(a.feature_kc.dim() == 2 && a.feature_kc.size(1) <= INT32_MAX, "gvtorch: feature_kc must be (k, c)");
  STD_TORCH_CHECK(a.offset_r.numel() >= 1, "gvtorch: offset_r must be (r + 1,)");
  args.count = a.feature_kc.size(0);
  args.width = static_cast<int32_t>(a.feature_kc.size(1));
  return a.offset_r.numel() - 1;
}

inline auto run(const CompositeOp& a) {
  const Like like{a.alpha_k, a.alpha_k.scalar_type()};
  return with_real(a.alpha_k, [&](auto real) {
    CompositeRay<decltype(real)> args{};
    const int64_t rays = set_packed_sizes(args, a);
    GV_COMPOSITE(GV_CHECK_AND_SET)
    Tensor sum_rc = make_output(args.sum_rc, a.alpha_k, {rays, args.width});
    Tensor left_r = make_output(args.left_r, a.alpha_k, {rays});
    Tensor before_k = make_zeros(args.before_k, a.alpha_k, {args.count});
    for_each(a.alpha_k, rays, args);
    return std::make_tuple(sum_rc, left_r, before_k);
  });
}

inline auto run(const CompositeBackwardOp& a) {
  const Like like{a.alpha_k, a.alpha_k.scalar_type()};
  return with_real(a.alpha_k, [&](auto real) {
    CompositeGradient<decltype(real)> args{};
    const int64_t rays = set_packed_sizes(args, a);
    GV_COMPOSITE_BACKWARD(GV_CHECK_AND_SET)
    Tensor grad_alpha_k = make_zeros(args.grad_alpha_k, a.alpha_k, {args.count});
    Tensor grad_feature_kc = make_zeros(args.grad_feature_kc, a.alpha_k, {args.count, args.width});
    Tensor grad_clear_r = make_output(args.grad_clear_r, a.alpha_k, {rays});
    for_each(a.alpha_k, rays, args);
    return std::make_tuple(grad_alpha_k, grad_feature_kc, grad_clear_r);
  });
}

using SegmentOps =
    Types<CountSegmentsOp, WriteSegmentsOp, SampleBricksOp, SampleBricksBackwardOp, CompositeOp, CompositeBackwardOp>;

}  // namespace gvtorch
