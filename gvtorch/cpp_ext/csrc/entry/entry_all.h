// All ops of gvtorch: the ops of cameras, triangles, noise, points and fractals, from tensors to the functors of their
// rooms; and the list of all ops, by which cpu.cpp and cuda.cu register them. How lists become ops: entry.h.
#pragma once

#include "cameras/pinhole.h"
#include "entry/entry.h"
#include "entry/entry_cache.h"
#include "entry/entry_segments.h"
#include "fields/orbits.h"
#include "mesh/voxelize.h"
#include "noise/noise.h"
#include "packets/processor.h"
#include "points/splat.h"

namespace gvtorch {

#ifndef __CUDACC__
// Calls run(args, begin, end), one of `processor().chunks`, for all items of an op, `chunk_size` at a time.
template <class Args>
void in_chunks(void (*run)(const Args&, int64_t, int64_t), const Args& args, int64_t count, int64_t chunk_size) {
  for_chunks(count, chunk_size, [&](int64_t begin, int64_t end) { run(args, begin, end); });
}
#endif

GV_OP(PinholeRaysOp, "pinhole_rays", GV_PINHOLE_RAYS,
      "(Tensor origin_r3, Tensor direction_r3, Tensor cone_r2, Tensor range_r2)");

inline auto run(const PinholeRaysOp& a) {
  const Like like{a.camera_nc};
  STD_TORCH_CHECK(a.camera_nc.dim() == 2 && a.camera_nc.size(1) >= PinholeRays::kLeastColumns,
                  "gvtorch: camera_nc must be (n, c) with c >= 20");
  const int64_t cameras = a.camera_nc.size(0), rays = a.rows * a.width;
  PinholeRays args{};
  args.columns = a.camera_nc.size(1);
  GV_PINHOLE_RAYS(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(a.height >= 1 && a.first + a.rows <= cameras * a.height, "gvtorch: there are fewer rows");
  STD_TORCH_CHECK(a.first + a.rows <= INT32_MAX && rays <= INT32_MAX, "gvtorch: these are too many rays");
  Tensor origin_r3 = make_output(args.origin_r3, a.camera_nc, {rays, 3});
  Tensor direction_r3 = make_output(args.direction_r3, a.camera_nc, {rays, 3});
  Tensor cone_r2 = make_output(args.cone_r2, a.camera_nc, {rays, 2}),
         range_r2 = make_output(args.range_r2, a.camera_nc, {rays, 2});
  for_each(a.camera_nc, PinholeRays::kThreads * rays, args);
  return std::make_tuple(origin_r3, direction_r3, cone_r2, range_r2);
}

GV_OP(VoxelizeOp, "voxelize", GV_VOXELIZE,
      "(Tensor distance_kzyx, Tensor nearest_kzyx, Tensor winding_kzyx, Tensor coverage_kzyx, Tensor weight_kzyx3)");

template <class T>
void voxelize_each(const Tensor& like, const VoxelizeArgs& args, int64_t rows) {
  for_each(like, rows, WindRow<T>{{args}});
  for_each(like, rows * args.side, VoxelizePack<T>{args});
}

inline auto run(const VoxelizeOp& a) {
  const ScalarType real = a.wide ? ScalarType::Double : ScalarType::Float;
  const Like like{a.corner_f33, real};
  const int64_t triangles = a.corner_f33.numel() / 9, side = a.side;
  STD_TORCH_CHECK(triangles >= 1 && triangles <= INT32_MAX / 2, "gvtorch: corner_f33 has no triangles, or too many");
  STD_TORCH_CHECK(side >= 1, "gvtorch: side out of range");
  VoxelizeArgs args{};
  args.triangles = triangles;
  args.cubes = a.low_k3.numel() / 3;
  int64_t boxes = 0;
  for (int64_t floor = triangles; args.floors == 0 || args.first[args.floors] - args.first[args.floors - 1] > kArity;
       floor = (floor + kArity - 1) / kArity) {
    boxes += floor;
    args.first[++args.floors] = static_cast<int32_t>(boxes);
  }
  GV_VOXELIZE(GV_CHECK_AND_SET)
  const auto make = [&](auto*& pointer, ScalarType dtype, bool wanted = true) {
    Tensor output = torch::stable::new_empty(a.corner_f33, {wanted ? args.cubes : 0, side, side, side}, dtype);
    pointer = to_kernel(output);
    return output;
  };
  Tensor distance_kzyx = make(args.distance_kzyx, real), nearest_kzyx = make(args.nearest_kzyx, ScalarType::Int);
  Tensor winding_kzyx = make(args.winding_kzyx, ScalarType::Int),
         coverage_kzyx = make(args.coverage_kzyx, real, a.shares);
  Tensor weight_kzyx3 = torch::stable::new_empty(a.corner_f33, {a.weights ? args.cubes : 0, side, side, side, 3}, real);
  args.weight_kzyx3 = to_kernel(weight_kzyx3);
  const int64_t rows = args.cubes * side * side;
#ifdef __CUDACC__
  a.wide ? voxelize_each<double>(a.corner_f33, args, rows) : voxelize_each<float>(a.corner_f33, args, rows);
#else
  in_chunks(processor().chunks.voxelize, args, rows, 16);
#endif
  return std::make_tuple(distance_kzyx, nearest_kzyx, winding_kzyx, coverage_kzyx, weight_kzyx3);
}

GV_OP(NoiseOp, "noise", GV_NOISE, "Tensor");

template <class T>
void noise_each(const Tensor& like, const NoiseArgs& args, int64_t points) {
  with_noise(args, [&](auto kind, auto axes) { for_each(like, points, MakeNoise<T, kind.value, axes.value>{args}); });
}

inline auto run(const NoiseOp& a) {
  STD_TORCH_CHECK(a.point_pn.dim() == 2 && (a.point_pn.size(1) == 2 || a.point_pn.size(1) == 3),
                  "gvtorch: point_pn must be (p, 2) or (p, 3)");
  const bool in_float64 = is_float64(a.point_pn);  // raises for other dtypes
  const Like like{a.point_pn, a.point_pn.scalar_type()};
  const int64_t points = a.point_pn.size(0);
  NoiseArgs args{};
  args.axes = static_cast<int32_t>(a.point_pn.size(1));
  GV_NOISE(GV_CHECK_AND_SET)
  Tensor value_p = make_output(args.value_p, a.point_pn, {points});
  if (in_float64) {
    noise_each<double>(a.point_pn, args, points);
  } else {
#ifdef __CUDACC__
    noise_each<float>(a.point_pn, args, points);
#else
    in_chunks(processor().chunks.noise, args, points, 1 << 11);
#endif
  }
  return value_p;
}

GV_OP(SplatOp, "splat", GV_SPLAT, "Tensor");

inline auto run(const SplatOp& a) {
  STD_TORCH_CHECK(a.edge_k3e.dim() == 3 && a.edge_k3e.size(2) >= 2 && a.edge_k3e.size(2) <= kMaxSplatSide,
                  "gvtorch: edge_k3e must be (k, 3, e), e >= 2");
  STD_TORCH_CHECK(a.value_nc.dim() == 2 && a.value_nc.size(1) >= 1 && a.value_nc.size(1) <= INT32_MAX,
                  "gvtorch: value_nc must be (n, c)");
  const Like like{a.edge_k3e};
  const int64_t side = a.edge_k3e.size(2) - 1;
  SplatArgs args{};
  args.cubes = a.edge_k3e.size(0);
  args.side = side;
  args.width = a.value_nc.size(1);
  args.narrow = a.value_nc.size(0);
  args.narrow_runs = a.narrow_s2.numel() / 2;
  args.wide = a.radius_m.numel();
  args.wide_runs = a.wide_t2.numel() / 2;
  GV_SPLAT(GV_CHECK_AND_SET)
  Tensor sum_kzyxc = make_output(args.sum_kzyxc, a.edge_k3e, {args.cubes, side, side, side, args.width});
#ifdef __CUDACC__
  for_each(a.edge_k3e, args.cubes * side * side * side, SplatVoxel{args});
#else
  in_chunks(processor().chunks.splat, args, SplatPart{args}.parts(), 1);
#endif
  return sum_kzyxc;
}

GV_OP(OrbitsOp, "orbits", GV_ORBITS, "Tensor");

inline auto run(const OrbitsOp& a) {
  const Like like{a.point_p3, a.point_p3.scalar_type()};
  OrbitArgs args{};
  args.points = a.point_p3.numel() / 3;
  args.in_float64 = is_float64(a.point_p3);  // raises for other dtypes
  GV_ORBITS(GV_CHECK_AND_SET)
  Tensor result_3p = make_output(args.result_3p, a.point_p3, {3, args.points});
#ifdef __CUDACC__
  with_real(a.point_p3, [&](auto real) {
    using T = decltype(real);
    with_step<T>(args.kind, [&](auto* step) {
      for_each(a.point_p3, args.points, FollowPoints<T, std::decay_t<decltype(*step)>>{args});
    });
  });
#else
  in_chunks(processor().chunks.orbits, args, args.points, 1 << 9);
#endif
  return result_3p;
}

GV_OP(OrbitBoundsOp, "orbit_bounds", GV_ORBIT_BOUNDS, "Tensor");

inline auto run(const OrbitBoundsOp& a) {
  const Like like{a.center_k3, a.center_k3.scalar_type()};
  OrbitBoundsArgs args{};
  args.balls = a.reach_k.numel();
  GV_ORBIT_BOUNDS(GV_CHECK_AND_SET)
  Tensor ends_2k = make_output(args.ends_2k, a.center_k3, {2, args.balls});
  with_real(a.center_k3, [&](auto real) {
    using T = decltype(real);
    with_step<T>(args.kind, [&](auto* step) {
      for_each(a.center_k3, args.balls, FollowBalls<T, std::decay_t<decltype(*step)>>{args});
    });
  });
  return ends_2k;
}

// All but those of rays and segments, whose CPU kernels are compiled in cpu_rays.cpp and cpu_segments.cpp.
using OtherOps = decltype(CacheOps{} + Types<PinholeRaysOp, VoxelizeOp, NoiseOp, SplatOp, OrbitsOp, OrbitBoundsOp>{});
using AllOps = decltype(RayOps{} + SegmentOps{} + OtherOps{});

}  // namespace gvtorch
