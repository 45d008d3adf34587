// The op on points: from tensors to the functors of points/. See entry.h.
#pragma once

#include "entry/entry.h"
#include "points/splat.h"

namespace gvtorch {

GV_OP(SplatOp, "splat", GV_SPLAT, "Tensor");

void splat_points(const Tensor& like, const SplatArgs& args);  // in cpu.cpp and in cuda.cu

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
  splat_points(a.edge_k3e, args);
  return sum_kzyxc;
}

using PointOps = Types<SplatOp>;

}  // namespace gvtorch
