// Rays one by one, with any shader and on any device.
#pragma once

#include "base/for_each.h"
#include "shaders/shade_rays.h"

namespace gvtorch {

// Gives a ShadeRay a byte for each node, in which it is kept what is hidden from all rays: see kUnknown in walk.h. They
// live as long as what is returned.
template <class Device, class Kernel>
torch::stable::Tensor hide_nodes(const torch::stable::Tensor& like, int64_t nodes, Kernel& kernel) {
  torch::stable::Tensor hidden_tn;
  if constexpr (Kernel::kHidesAlike) {
    constexpr auto kByte = torch::headeronly::ScalarType::Byte;
#ifdef __CUDACC__
    hidden_tn = torch::stable::new_empty(like, {nodes}, kByte);
    kernel.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
    for_each<Device>(like, nodes, HideShaded<Kernel>{kernel});
#else
    hidden_tn = torch::stable::new_zeros(like, {nodes}, kByte);
    kernel.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
#endif
  }
  return hidden_tn;
}

template <class Device, class Kernel>
void shade_each(const torch::stable::Tensor& like, int64_t nodes, Kernel kernel) {
  const torch::stable::Tensor hidden_tn = hide_nodes<Device>(like, nodes, kernel);
  for_each<Device>(like, kernel.order.count(), kernel);
}

// Rays with a fused shader; those of the plain function, filtered or not, with voxels of a known dtype, and on CUDA
// those that see the usual stored colours.
template <class T>
void shade_fused(const torch::stable::Tensor& like, const ShadeArgs& args) {
  const auto each = [&](const auto& kernel) { shade_each<Device>(like, args.nodes, kernel); };
  const bool plain = args.shader == kPlainShader;
#ifdef __CUDACC__
  if constexpr (std::is_same_v<T, float>) {
    const auto colors = [&](auto voxel) {
      with_digits<T>(args, [&](auto* digits) {
        each(ShadeRay<T, StoredColor<T>, std::decay_t<decltype(*digits)>, false, decltype(voxel)>(args));
      });
    };
    const bool stored = args.shader == static_cast<int32_t>(ShaderKind::kStoredColor);
    if (stored && args.voxel == VoxelType::kUInt8) return colors(uint8_t{});
    if (stored && args.voxel == VoxelType::kHalf) return colors(Half{});
  }
#endif
  if (!plain && args.shader != static_cast<int32_t>(ShaderKind::kFiltered)) return with_rays<T>(args, each);
  with_voxel(args.voxel, [&](auto voxel) {
    with_digits<T>(args, [&](auto* digits) {
      using Voxel = decltype(voxel);
      using Digits = std::decay_t<decltype(*digits)>;
      plain ? each(ShadeRay<T, Plain<T>, Digits, false, Voxel>(args))
            : each(ShadeRay<T, Filtered<T>, Digits, false, Voxel>(args));
    });
  });
}

}  // namespace gvtorch
