// The op of cameras: from tensors to the functor of cameras/. See entry.h.
#pragma once

#include "cameras/pinhole.h"
#include "entry/entry.h"

namespace gvtorch {

GV_OP(PinholeRaysOp, "pinhole_rays", GV_PINHOLE_RAYS,
      "(Tensor origin_r3, Tensor direction_r3, Tensor cone_r2, Tensor range_r2)");

inline auto run(const PinholeRaysOp& a) {
  const Like like{a.x_kw};
  STD_TORCH_CHECK(a.x_kw.dim() == 2 && a.camera_kc.dim() == 2 && a.camera_kc.size(1) >= 20,
                  "gvtorch: x_kw must be (k, w), and camera_kc (k, c) with c >= 20");
  const int64_t planes = a.x_kw.size(0), width = a.x_kw.size(1), rows = a.y_h.numel(), columns = a.camera_kc.size(1);
  STD_TORCH_CHECK(planes == 1 || planes == rows, "gvtorch: x_kw must be of one row, or of a row each");
  PinholeRays args{};
  GV_PINHOLE_RAYS(GV_TAKE)
  args.planes = planes;
  args.width = width;
  args.columns = columns;
  const int64_t rays = rows * width;
  Tensor origin_r3 = give(args.origin_r3, a.x_kw, {rays, 3}), direction_r3 = give(args.direction_r3, a.x_kw, {rays, 3});
  Tensor cone_r2 = give(args.cone_r2, a.x_kw, {rays, 2}), range_r2 = give(args.range_r2, a.x_kw, {rays, 2});
  for_each(a.x_kw, PinholeRays::kThreads * rays, args);
  return std::make_tuple(origin_r3, direction_r3, cone_r2, range_r2);
}

using CameraOps = Types<PinholeRaysOp>;

}  // namespace gvtorch
