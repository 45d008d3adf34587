// Which rays the CPU traces in packets, and how they are distributed to threads.
#pragma once

#include <algorithm>
#include <cstring>

#include "base/for_each.h"
#include "shaders/shaders.h"
#include "walk/walk.h"

namespace gvtorch {

// Returns a copy of a channel of a pool that has one brick or none, with room after it; the returned tensor owns it.
inline torch::stable::Tensor with_room(const torch::stable::Tensor& like, const void*& bricks, int64_t bytes,
                                       int64_t count) {
  torch::stable::Tensor copy = torch::stable::new_empty(like, {bytes + 4}, torch::headeronly::ScalarType::Byte);
  void* const first = copy.mutable_data_ptr();
  if (bricks != nullptr) std::memcpy(first, bricks, static_cast<size_t>(bytes * count));
  bricks = first;
  return copy;
}

// Calls body(begin, end) for chunks of the rays, which packets trace. args.hidden_tn gets a zero byte for each node:
// see kUnknown in walk.h.
//
// Packets count the numbers of a brick in floats, and load 4 bytes at once: beyond a voxel, but not beyond the pool.
// What they can't read so, the functions of a single ray read: the last of several bricks, and bricks of more than 2^24
// numbers.
template <class Body>
void trace_chunks(const torch::stable::Tensor& like, ShadeArgs args, const Body& body) {
  constexpr int64_t kChunk = 256, kMaxCounted = 1 << 24;
  const torch::stable::Tensor hidden_tn =
      torch::stable::new_zeros(like, {args.nodes + 3}, torch::headeronly::ScalarType::Byte);
  args.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
  torch::stable::Tensor copies[3];
  args.packet_bricks = args.bricks - 1;
  if (args.bricks < 2) {
    const auto bytes = [&](VoxelType type, int32_t width) { return brick_bytes(type, args.side, width); };
    copies[0] = with_room(like, args.bricks_bzyxc, bytes(args.voxel, args.voxel_width), args.bricks);
    copies[1] = with_room(like, args.normal_bzyxc, bytes(args.normal_voxel, 3), args.bricks);
    copies[2] = with_room(like, args.other_bzyxc, bytes(args.other_voxel, args.other_width), args.other_bricks);
    args.packet_bricks = 1;
  }
  const int64_t voxels = int64_t{args.side} * args.side * args.side;
  if (voxels * std::max({args.voxel_width, args.other_width, args.normal_tnc ? 3 : 1}) > kMaxCounted)
    args.packet_bricks = 0;
  for_chunks(RayOrder{args.rays, args.width}.count(), kChunk,
             [&](int64_t begin, int64_t end) { body(args, begin, end); });
}

}  // namespace gvtorch
