// The op of noise: from tensors to the functors of noise/. See entry.h.
#pragma once

#include "entry/entry.h"
#include "noise/noise.h"

namespace gvtorch {

GV_OP(NoiseOp, "noise", GV_NOISE, "Tensor");

void make_noise(const Tensor& like, const NoiseArgs& args, int64_t points);  // in cpu.cpp and in cuda.cu

template <class T>
void noise_each(const Tensor& like, const NoiseArgs& args, int64_t points) {
  with_noise(args, [&](auto kind, auto axes) { for_each(like, points, MakeNoise<T, kind.value, axes.value>{args}); });
}

inline auto run(const NoiseOp& a) {
  STD_TORCH_CHECK(a.point_pn.dim() == 2 && (a.point_pn.size(1) == 2 || a.point_pn.size(1) == 3),
                  "gvtorch: point_pn must be (p, 2) or (p, 3)");
  is_float64(a.point_pn);  // raises for other dtypes
  const Like like{a.point_pn, a.point_pn.scalar_type()};
  const int64_t points = a.point_pn.size(0);
  NoiseArgs args{};
  args.axes = static_cast<int32_t>(a.point_pn.size(1));
  GV_NOISE(GV_CHECK_AND_SET)
  Tensor value_p = make_output(args.value_p, a.point_pn, {points});
  make_noise(a.point_pn, args, points);
  return value_p;
}

using NoiseOps = Types<NoiseOp>;

}  // namespace gvtorch
