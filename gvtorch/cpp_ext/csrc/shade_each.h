// A shader's rays one by one, on any device: `shade_each<Device>(like, nodes, kernel)`. On a GPU it is worked out first
// what the shader hides, where that is the same for all rays.
#pragma once

#include "for_each.h"
#include "shade_rays.h"

namespace gvtorch {

template <class Device, class Kernel>
void shade_each(const torch::stable::Tensor& like, int64_t nodes, Kernel kernel) {
#ifdef __CUDACC__
  torch::stable::Tensor hidden_tn;
  if constexpr (Kernel::kHidesAlike) {
    hidden_tn = torch::stable::new_empty(like, {nodes}, torch::headeronly::ScalarType::Byte);
    kernel.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
    for_each<Device>(like, nodes, HideShaded<Kernel>{kernel});
  }
#else
  (void)nodes;
#endif
  for_each<Device>(like, kernel.order.count(), kernel);
}

}  // namespace gvtorch
