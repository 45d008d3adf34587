// Traces rays one by one, with any shader and on any device.
#pragma once

#include "base/for_each.h"
#include "shaders/shade_rays.h"

namespace gvtorch {

// Gives a ShadeRay memory for each node, to cache what is hidden from all rays: see kUnknown in walk.h. The returned
// tensor owns it.
template <class Kernel>
torch::stable::Tensor allocate_node_cache(const torch::stable::Tensor& like, int64_t nodes, Kernel& kernel) {
  torch::stable::Tensor node_cache;
  if constexpr (Kernel::kHidesAlike) {
#ifdef __CUDACC__
    node_cache = torch::stable::new_empty(like, {nodes}, torch::headeronly::ScalarType::Long);
    kernel.words_tn = static_cast<NodeWords*>(node_cache.mutable_data_ptr());
    for_each(like, nodes, HideShaded<Kernel>{kernel});
#else
    node_cache = torch::stable::new_zeros(like, {nodes}, torch::headeronly::ScalarType::Byte);
    kernel.hidden_tn = static_cast<uint8_t*>(node_cache.mutable_data_ptr());
#endif
  }
  return node_cache;
}

#ifdef __CUDACC__
static_assert(kBlockThreads == kBlockWarps * kWarpThreads);
#endif

template <class Kernel>
void shade_each(const torch::stable::Tensor& like, int64_t nodes, Kernel kernel) {
  const torch::stable::Tensor node_cache = allocate_node_cache(like, nodes, kernel);
  for_each(like, kernel.order.count(), kernel);
}

// Traces rays with a fused shader of ShaderType `type`, and with a voxel of the dtype that is compiled in, if any.
template <class T, class Type, class... Voxel>
void shade_as(const torch::stable::Tensor& like, const ShadeArgs& args, Type, Voxel...) {
  with_digits<T>(args, [&](auto* digits) {
    using Digits = std::decay_t<decltype(*digits)>;
    shade_each(like, args.nodes, ShadeRay<T, typename Type::Shader, Digits, Type::kShadows, Voxel...>(args));
  });
}

// Traces rays with any fused shader. On CUDA the voxels' dtype is compiled in for the plain function, filtered or not,
// and for the usual dtypes of stored colours, lit functions and isosurfaces.
template <class T>
void shade_fused(const torch::stable::Tensor& like, const ShadeArgs& args) {
  const auto trace = [&](auto type, auto... voxel) { shade_as<T>(like, args, type, voxel...); };
#ifdef __CUDACC__
  const auto is = [&](ShaderKind kind) { return args.shader == static_cast<int32_t>(kind); };
  if (is(ShaderKind::kFiltered)) {
    return with_voxel(args.voxel, [&](auto voxel) { trace(ShaderType<Filtered<T>, false>{}, voxel); });
  }
  if constexpr (std::is_same_v<T, float>) {
    const ShaderType<StoredColor<T>, false> colors;
    if (is(ShaderKind::kStoredColor) && args.voxel == VoxelType::kUInt8) return trace(colors, uint8_t{});
    if (is(ShaderKind::kStoredColor) && args.voxel == VoxelType::kHalf) return trace(colors, Half{});
    const ShaderType<Isosurface<T>, false> surface;
    if (is(ShaderKind::kIsosurface) && args.voxel == VoxelType::kHalf) return trace(surface, Half{});
    if (!is_deep(args)) {
      const auto shallow = [&](auto shader, auto voxel) {
        using Shader = typename decltype(shader)::Shader;
        shade_each(like, args.nodes, ShadeRay<T, Shader, BitDigits, false, decltype(voxel)>(args));
      };
      const ShaderType<Lit<T>, false> lit;
      const bool is_lit = is(ShaderKind::kLit);
      if (is_lit && args.voxel == VoxelType::kUInt8) return shallow(lit, uint8_t{});
      if (is_lit && args.voxel == VoxelType::kInt16) return shallow(lit, int16_t{});
      if (is_lit && args.voxel == VoxelType::kUInt16) return shallow(lit, uint16_t{});
      if (is(ShaderKind::kIsosurface) && args.voxel == VoxelType::kUInt8) return shallow(surface, uint8_t{});
    }
  }
  if (args.shader == kPlainShader) {
    return with_voxel(args.voxel, [&](auto voxel) { trace(ShaderType<Plain<T>, false>{}, voxel); });
  }
#endif
  with_shader<T>(args.shader, trace);
}

}  // namespace gvtorch
