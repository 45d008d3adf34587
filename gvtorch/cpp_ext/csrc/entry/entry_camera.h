// The op of cameras: from tensors to the functor of cameras/. See entry.h.
#pragma once

#include "cameras/pinhole.h"
#include "entry/entry.h"

namespace gvtorch {

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

using CameraOps = Types<PinholeRaysOp>;

}  // namespace gvtorch
