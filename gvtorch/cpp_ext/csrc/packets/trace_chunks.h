// Which rays the CPU traces in packets, and how it shares them out.
#pragma once

#include "base/for_each.h"
#include "shaders/shaders.h"
#include "walk/walk.h"

namespace gvtorch {

// Packets find nodes by 32-bit bytes, count the places in a brick in floats, and load 4 bytes at once, which may reach
// behind a voxel, but never behind the pool: its last brick is read by single rays.
inline bool packs(const TraceArgs& args) {
  constexpr int64_t kMostNodes = INT32_MAX / sizeof(int32_t);
  return args.nodes <= kMostNodes && args.bricks >= 2 && brick_bytes(args.voxel, args.side, args.channels) < 1 << 24;
}

// Whether packets take a fused shader's rays.
inline bool shades(const ShadeArgs& args) {
  const auto fits = [&](VoxelType type, int32_t channels) { return brick_bytes(type, args.side, channels) < 1 << 24; };
  if (!packs(args) || !fits(args.normal_voxel, 3) || !fits(args.other_voxel, args.other_channels)) return false;
  return with_shader<float>(args.shader, [&](auto type) {
    using Type = decltype(type);
    return !Type::kShadows && Type::Shader::packs(args);
  });
}

// body(begin, end) for chunks of the rays; first an empty byte for each node, in which it is kept what is hidden.
template <class Body>
void trace_chunks(const torch::stable::Tensor& like, TraceArgs& args, const Body& body) {
  constexpr int64_t kChunk = 256;
  torch::stable::Tensor hidden_tn =
      torch::stable::new_zeros(like, {args.nodes + 3}, torch::headeronly::ScalarType::Byte);
  args.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
  for_shares(RayOrder{args.rays, args.width}.count(), kChunk, body);
}

}  // namespace gvtorch
