// The ops on triangles: from tensors to the functors of mesh/. See entry.h.
#pragma once

#include "entry/entry_segments.h"
#include "mesh/voxelize.h"

namespace gvtorch {

GV_OP(VoxelizeOp, "voxelize", GV_VOXELIZE,
      "(Tensor distance_kzyx, Tensor nearest_kzyx, Tensor winding_kzyx, Tensor coverage_kzyx)");

inline auto run(const VoxelizeOp& a) {
  const Like like{a.corner_m33, a.corner_m33.scalar_type()};
  const int64_t triangles = a.corner_m33.numel() / 9, cubes = a.first_k.numel() - 1, side = a.side;
  STD_TORCH_CHECK(cubes >= 0 && triangles <= INT32_MAX, "gvtorch: first_k is empty, or too many triangles");
  STD_TORCH_CHECK(side >= 1, "gvtorch: side out of range");
  Tensor distance_kzyx, nearest_kzyx, winding_kzyx, coverage_kzyx;
  with_real(a.corner_m33, [&](auto real) {
    using T = decltype(real);
    VoxelizeRow<T> args{};
    GV_VOXELIZE(GV_TAKE)
    args.triangles = triangles;
    const auto make = [&](auto*& pointer, ScalarType dtype) {
      Tensor made = torch::stable::new_empty(a.corner_m33, {cubes, side, side, side}, dtype);
      pointer = lay(made);
      return made;
    };
    distance_kzyx = make(args.distance_kzyx, like.real);
    nearest_kzyx = make(args.nearest_kzyx, ScalarType::Int);
    winding_kzyx = make(args.winding_kzyx, ScalarType::Int);
    coverage_kzyx = make(args.coverage_kzyx, like.real);
    for_each(a.corner_m33, cubes * side * side, args);
  });
  return std::make_tuple(distance_kzyx, nearest_kzyx, winding_kzyx, coverage_kzyx);
}

using MeshOps = Types<VoxelizeOp>;

}  // namespace gvtorch
