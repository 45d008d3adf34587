// The ops of segments: from tensors to the functors of segments.h. See entry.h.
#pragma once

#include "entry/entry.h"
#include "shaders/segments.h"
#include "shaders/shade_each.h"

namespace gvtorch {

// Calls body(T{}) with float or double.
template <class Body>
void with_real(const Tensor& tensor, const Body& body) {
  if (is_float64(tensor)) {
    body(double{});
  } else {
    body(float{});
  }
}

// --- Walks

// A part of a walk: it continues from state_r3, and pauses after `limit` samples.
#define GV_PART(X)                  \
  X(MaybeReals, state_r3, 3 * rays) \
  X(Int, limit, kAny)               \
  X(Bool, by_node, kAny)
#define GV_SEGMENT_RANGE(X) X(Longs, first_r, rays) X(Count, total, kAny)
#define GV_COUNT_SEGMENTS(X) GV_TRACE_RAYS(X) GV_PART(X)
#define GV_WRITE_SEGMENTS(X) GV_COUNT_SEGMENTS(X) GV_SEGMENT_RANGE(X)
GV_OP(CountSegmentsOp, "count_segments", GV_COUNT_SEGMENTS, "(Tensor count_r3, Tensor state_r3, Tensor missed_r)");
GV_OP(WriteSegmentsOp, "write_segments", GV_WRITE_SEGMENTS,
      "(Tensor ray_s, Tensor node_s2, Tensor brick_s2, Tensor depth_s3, Tensor interval_s3, Tensor distance_s3, "
      "Tensor t0_s, Tensor t1_s)");

// Runs the functor that make(WalkRay, T{}) returns for every ray.
template <class Op, class Make>
void walk_rays(const Op& a, const Make& make) {
  const ShadeArgs walk_args = make_walk_args(a);
  const int64_t rays = walk_args.rays;
  const Like like{a.origin_r3, a.table_lm4.scalar_type()};
  with_real(a.table_lm4, [&](auto real) {
    using T = decltype(real);
    with_digits<T>(walk_args, [&](auto* digits) {
      using Digits = std::decay_t<decltype(*digits)>;
      WalkRay<T, Digits> args{ShadeRay<T, Plain<T>, Digits>(walk_args), nullptr, 0, false};
      GV_PART(GV_CHECK_AND_SET)
      const Tensor node_cache = allocate_node_cache(a.origin_r3, walk_args.nodes, args.kernel);
      for_each(a.origin_r3, args.kernel.order.count(), make(args, real));
    });
  });
}

inline auto run(const CountSegmentsOp& a) {
  Tensor count_r3, state_r3, missed_r;
  walk_rays(a, [&](auto walk, auto real) {
    const int64_t rays = walk.kernel.order.rays;
    CountSegments<decltype(real), decltype(walk)> kernel{walk, nullptr, nullptr, nullptr};
    count_r3 = make_output(kernel.count_r3, a.origin_r3, {rays, 3});
    state_r3 = make_output(kernel.state_r3, a.origin_r3, {rays, 3});
    missed_r = make_output(kernel.missed_r, a.origin_r3, {rays});
    return kernel;
  });
  return std::make_tuple(count_r3, state_r3, missed_r);
}

inline auto run(const WriteSegmentsOp& a) {
  Tensor ray_s, node_s2, brick_s2, depth_s3, interval_s3, distance_s3, t0_s, t1_s;
  walk_rays(a, [&](auto walk, auto real) {
    const Like like{a.origin_r3};
    const int64_t rays = walk.kernel.order.rays;
    WriteSegments<decltype(real), decltype(walk)> args{walk, nullptr, 0, {}};
    GV_SEGMENT_RANGE(GV_CHECK_AND_SET)
    ray_s = make_output(args.out.ray_s, a.origin_r3, {a.total});
    node_s2 = make_output(args.out.node_s2, a.origin_r3, {a.total, 2});
    brick_s2 = make_output(args.out.brick_s2, a.origin_r3, {a.total, 2});
    depth_s3 = make_output(args.out.depth_s3, a.origin_r3, {a.total, 3});
    interval_s3 = make_output(args.out.interval_s3, a.origin_r3, {a.total, 3});
    distance_s3 = make_output(args.out.distance_s3, a.origin_r3, {a.total, 3});
    t0_s = make_output(args.out.t0_s, a.origin_r3, {a.total});
    t1_s = make_output(args.out.t1_s, a.origin_r3, {a.total});
    return args;
  });
  return std::make_tuple(ray_s, node_s2, brick_s2, depth_s3, interval_s3, distance_s3, t0_s, t1_s);
}

// --- Samples

// Segments, and samples of them. Sizes in limits: segments, samples
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
#define GV_GRADIENT(X) X(Reals, grad_kc, samples* channels)
#define GV_SAMPLE_BRICKS_BACKWARD(X) GV_GRADIENT(X) GV_SAMPLE_BRICKS(X)
GV_OP(SampleBricksOp, "sample_bricks", GV_SAMPLE_BRICKS, "Tensor value_kc");
GV_OP(SampleBricksBackwardOp, "sample_bricks_backward", GV_SAMPLE_BRICKS_BACKWARD,
      "(Tensor grad_bzyxc, Tensor grad_tnc)");

// Runs the functor that make(FindSample, T{}, Voxel{}) returns for every sample.
template <class Op, class Make>
void for_each_sample(const Op& a, const Make& make) {
  const Like like{a.origin_r3, a.distance_s3.scalar_type(), a.bricks_bzyxc.scalar_type()};
  STD_TORCH_CHECK(a.constant_tnc.dim() == 3 && a.constant_tnc.size(1) > 0, "gvtorch: constant_tnc must be (t, n, c)");
  TraceArgs args{};
  args.nodes_per_tile = static_cast<int32_t>(a.constant_tnc.size(1));
  set_channel_args(args, a, like, a.constant_tnc.size(0) * a.constant_tnc.size(1));
  const int64_t segments = a.ray_s.numel(), samples = a.segment_k.numel();
  GV_SAMPLES(GV_CHECK)
  with_real(a.distance_s3, [&](auto real) {
    using T = decltype(real);
    const Walk<T> walk(args);
    const SegmentView<T> read{to_kernel(a.ray_s),
                              to_kernel(a.node_s2),
                              to_kernel(a.brick_s2),
                              to_kernel(a.depth_s3),
                              to_kernel(a.interval_s3),
                              nullptr,
                              nullptr,
                              to_kernel(a.distance_s3)};
    with_voxel(args.voxel, [&](auto voxel) {
      using Voxel = decltype(voxel);
      const auto* stored = static_cast<const Voxel*>(args.bricks_bzyxc);
      const auto* constants = static_cast<const Voxel*>(args.constant_tnc);
      const BrickView<Voxel> bricks{stored, constants, args.side, args.border, args.channels};
      const FindSample<T, Voxel> find_sample{walk.rays,
                                             walk.tree,
                                             walk.levels,
                                             bricks,
                                             read,
                                             to_kernel(a.segment_k),
                                             to_kernel(a.number_k),
                                             args.rays,
                                             segments,
                                             args.nodes,
                                             args.bricks,
                                             walk.options.step};
      for_each(a.origin_r3, samples, make(find_sample, real, voxel));
    });
  });
}

inline auto run(const SampleBricksOp& a) {
  Tensor value_kc;
  for_each_sample(a, [&](const auto& find_sample, auto real, auto voxel) {
    SampleBricks<decltype(real), decltype(voxel)> kernel{find_sample, nullptr};
    value_kc = make_output(kernel.value_kc, a.origin_r3, {a.segment_k.numel(), find_sample.bricks.channels});
    return kernel;
  });
  return value_kc;
}

inline auto run(const SampleBricksBackwardOp& a) {
  Tensor grad_bzyxc, grad_tnc;
  for_each_sample(a, [&](const auto& find_sample, auto real, auto voxel) {
    const int64_t side = find_sample.bricks.side, channels = find_sample.bricks.channels, samples = a.segment_k.numel();
    const Like like{a.origin_r3, a.distance_s3.scalar_type()};
    SpreadGradient<decltype(real), decltype(voxel)> args{find_sample, nullptr, nullptr, nullptr};
    GV_GRADIENT(GV_CHECK_AND_SET)
    grad_bzyxc = make_output(args.grad_bzyxc, a.grad_kc, {find_sample.brick_count, side, side, side, channels});
    grad_tnc = make_output(args.grad_tnc, a.grad_kc, {a.constant_tnc.size(0), a.constant_tnc.size(1), channels});
    torch::stable::zero_(grad_bzyxc);
    torch::stable::zero_(grad_tnc);
    return args;
  });
  return std::make_tuple(grad_bzyxc, grad_tnc);
}

// --- Compositing

// Packed samples of rays. Sizes in limits: count, rays, channels
#define GV_PACKED(X)                    \
  X(Reals, alpha_k, count)              \
  X(Reals, feature_kc, count* channels) \
  X(Longs, offset_r, rays + 1)
#define GV_COMPOSITE(X) GV_PACKED(X) X(Reals, clear_r, rays) X(Float, stop_clear, kAny)
#define GV_COMPOSITE_BACKWARD(X)        \
  X(Reals, grad_sum_rc, rays* channels) \
  X(Reals, grad_left_r, rays)           \
  GV_PACKED(X)                          \
  X(Reals, before_k, count)             \
  X(Float, stop_clear, kAny)
GV_OP(CompositeOp, "composite", GV_COMPOSITE, "(Tensor sum_rc, Tensor left_r, Tensor before_k)");
GV_OP(CompositeBackwardOp, "composite_backward", GV_COMPOSITE_BACKWARD,
      "(Tensor grad_alpha_k, Tensor grad_feature_kc, Tensor grad_clear_r)");

template <class Op>
PackedView pack(const Op& a) {
  STD_TORCH_CHECK(a.feature_kc.dim() == 2 && a.feature_kc.size(1) <= INT32_MAX, "gvtorch: feature_kc must be (k, c)");
  STD_TORCH_CHECK(a.offset_r.numel() >= 1, "gvtorch: offset_r must be (r + 1,)");
  return {to_kernel(a.offset_r), a.feature_kc.size(0), static_cast<int32_t>(a.feature_kc.size(1))};
}

inline auto run(const CompositeOp& a) {
  const PackedView packed = pack(a);
  const int64_t rays = a.offset_r.numel() - 1, count = packed.count, channels = packed.channels;
  const Like like{a.alpha_k, a.alpha_k.scalar_type()};
  GV_COMPOSITE(GV_CHECK)
  Tensor sum_rc = torch::stable::new_empty(a.alpha_k, {rays, channels});
  Tensor left_r = torch::stable::new_empty(a.alpha_k, {rays});
  Tensor before_k = torch::stable::new_zeros(a.alpha_k, {count});
  with_real(a.alpha_k, [&](auto real) {
    using T = decltype(real);
    const CompositeRay<T> kernel{packed,
                                 to_kernel(a.alpha_k),
                                 to_kernel(a.feature_kc),
                                 to_kernel(a.clear_r),
                                 static_cast<T>(a.stop_clear),
                                 to_kernel(sum_rc),
                                 to_kernel(left_r),
                                 to_kernel(before_k)};
    for_each(a.alpha_k, rays, kernel);
  });
  return std::make_tuple(sum_rc, left_r, before_k);
}

inline auto run(const CompositeBackwardOp& a) {
  const PackedView packed = pack(a);
  const int64_t rays = a.offset_r.numel() - 1, count = packed.count, channels = packed.channels;
  const Like like{a.alpha_k, a.alpha_k.scalar_type()};
  GV_COMPOSITE_BACKWARD(GV_CHECK)
  Tensor grad_alpha_k = torch::stable::new_zeros(a.alpha_k, {count});
  Tensor grad_feature_kc = torch::stable::new_zeros(a.alpha_k, {count, channels});
  Tensor grad_clear_r = torch::stable::new_empty(a.alpha_k, {rays});
  with_real(a.alpha_k, [&](auto real) {
    using T = decltype(real);
    const CompositeGradient<T> kernel{packed,
                                      to_kernel(a.alpha_k),
                                      to_kernel(a.feature_kc),
                                      to_kernel(a.before_k),
                                      to_kernel(a.grad_sum_rc),
                                      to_kernel(a.grad_left_r),
                                      static_cast<T>(a.stop_clear),
                                      to_kernel(grad_alpha_k),
                                      to_kernel(grad_feature_kc),
                                      to_kernel(grad_clear_r)};
    for_each(a.alpha_k, rays, kernel);
  });
  return std::make_tuple(grad_alpha_k, grad_feature_kc, grad_clear_r);
}

using SegmentOps =
    Types<CountSegmentsOp, WriteSegmentsOp, SampleBricksOp, SampleBricksBackwardOp, CompositeOp, CompositeBackwardOp>;

}  // namespace gvtorch
