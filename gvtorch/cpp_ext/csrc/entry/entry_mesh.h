// The ops on triangles: from tensors to the functors of mesh/. See entry.h.
#pragma once

#include "entry/entry.h"
#include "mesh/voxelize.h"

namespace gvtorch {

GV_OP(VoxelizeOp, "voxelize", GV_VOXELIZE,
      "(Tensor distance_kzyx, Tensor nearest_kzyx, Tensor winding_kzyx, Tensor coverage_kzyx, Tensor weight_kzyx3)");

void voxelize(const Tensor& like, const VoxelizeArgs& args);  // in cpu.cpp and in cuda.cu

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
  voxelize(a.corner_f33, args);
  return std::make_tuple(distance_kzyx, nearest_kzyx, winding_kzyx, coverage_kzyx, weight_kzyx3);
}

using MeshOps = Types<VoxelizeOp>;

}  // namespace gvtorch
