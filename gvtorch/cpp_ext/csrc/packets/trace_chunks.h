// Which rays the CPU traces in packets, and how they are distributed to threads.
#pragma once

#include "base/for_each.h"
#include "shaders/shaders.h"
#include "walk/walk.h"

namespace gvtorch {

// True if packets can trace the rays. They address nodes and the table by 32-bit byte offsets, compute offsets in a
// brick in floats, and load 4 bytes at once: beyond a voxel, but not beyond the pool, whose last brick only single
// rays' functions read.
inline bool packets_can_trace(const TraceArgs& args) {
  constexpr int64_t kMaxAddressed = INT32_MAX / sizeof(int32_t);
  return args.nodes <= kMaxAddressed && args.table <= kMaxAddressed && args.bricks >= 2 &&
         brick_bytes(args.voxel, args.side, args.voxel_width) < 1 << 24;
}

// True if packets can trace a fused shader's rays.
inline bool packets_can_shade(const ShadeArgs& args) {
  const auto fits = [&](VoxelType type, int32_t width) { return brick_bytes(type, args.side, width) < 1 << 24; };
  if (!packets_can_trace(args) || !fits(args.normal_voxel, 3) || !fits(args.other_voxel, args.other_width))
    return false;
  return with_shader<float>(args.shader, [&](auto type) {
    using Type = decltype(type);
    return !Type::kShadows && Type::Shader::packets_can_trace(args);
  });
}

// Calls body(begin, end) for chunks of the rays. args.hidden_tn gets a zero byte for each node: see kUnknown in walk.h.
template <class Body>
void trace_chunks(const torch::stable::Tensor& like, TraceArgs& args, const Body& body) {
  constexpr int64_t kChunk = 256;
  torch::stable::Tensor hidden_tn =
      torch::stable::new_zeros(like, {args.nodes + 3}, torch::headeronly::ScalarType::Byte);
  args.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
  for_chunks(RayOrder{args.rays, args.width}.count(), kChunk, body);
}

}  // namespace gvtorch
