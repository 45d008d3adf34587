// The ops of fields: from tensors to the functors of fields/. See entry.h.
#pragma once

#include "entry/entry.h"
#include "fields/orbits.h"

namespace gvtorch {

GV_OP(OrbitsOp, "orbits", GV_ORBITS, "Tensor");
GV_OP(OrbitBoundsOp, "orbit_bounds", GV_ORBIT_BOUNDS, "Tensor");

void follow_points(const Tensor& like, const OrbitArgs& args);  // in cpu.cpp and in cuda.cu

inline auto run(const OrbitsOp& a) {
  const Like like{a.point_p3, a.point_p3.scalar_type()};
  OrbitArgs args{};
  args.points = a.point_p3.numel() / 3;
  args.in_float64 = is_float64(a.point_p3);  // raises for other dtypes
  GV_ORBITS(GV_CHECK_AND_SET)
  Tensor result_3p = make_output(args.result_3p, a.point_p3, {3, args.points});
  follow_points(a.point_p3, args);
  return result_3p;
}

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

using FieldOps = Types<OrbitsOp, OrbitBoundsOp>;

}  // namespace gvtorch
