// What packets read of the pools, and how rays are distributed to threads.
#pragma once

#include <algorithm>
#include <cstring>

#include "base/for_each.h"
#include "shaders/shaders.h"
#include "walk/walk.h"

namespace gvtorch {

// Packets load 4 bytes at once, beyond a voxel that has fewer, but not beyond the pool; and they compute offsets in a
// brick in float32, which is exact up to 2^24. What they can't read so, the functions of a single ray read: the last
// brick of such voxels, and bricks of more than 2^24 numbers. A pool of a single brick is copied to memory with room
// after it if that takes little time beside its rays.
//
// Sets args.packet_bricks, and pointers to the copies, which `copies` owns.
inline void prepare_pools(const torch::stable::Tensor& like, ShadeArgs& args, torch::stable::Tensor (&copies)[3]) {
  constexpr int64_t kMaxBrickNumbers = 1 << 24, kBytesPerRay = 256;
  constexpr int32_t kSmallSide = 8;  // always copied: idle lanes load at the first eight voxels, and it may end there
  struct Channel {
    const void*& bricks;
    VoxelType type;
    int32_t width;
    int64_t count;
  };
  const Channel channels[3] = {{args.bricks_bzyxc, args.voxel, args.voxel_width, args.bricks},
                               {args.normal_bzyxc, args.normal_voxel, args.normal_tnc == nullptr ? 0 : 3, args.bricks},
                               {args.other_bzyxc, args.other_voxel, args.other_width, args.other_bricks}};
  const int64_t voxels = int64_t{args.side} * args.side * args.side;
  int64_t bytes = 0, numbers = 0;
  bool narrow = false;  // a number has fewer than 4 bytes
  for (const Channel& channel : channels) {
    bytes += brick_bytes(channel.type, args.side, channel.width);
    numbers = std::max(numbers, voxels * channel.width);
    narrow = narrow || (channel.width > 0 && brick_bytes(channel.type, 1, 1) < 4);
  }
  const bool counted = numbers <= kMaxBrickNumbers;
  const bool copied = args.bricks == 0 || (args.bricks == 1 && narrow && counted &&
                                           (args.side <= kSmallSide || bytes <= kBytesPerRay * args.rays));
  args.packet_bricks = !counted ? 0 : copied ? 1 : args.bricks - (narrow ? 1 : 0);
  if (!copied) return;
  for (int i = 0; i < 3; ++i) {
    const Channel& channel = channels[i];
    const int64_t brick = brick_bytes(channel.type, args.side, channel.width);
    copies[i] = torch::stable::new_empty(like, {brick + 4}, torch::headeronly::ScalarType::Byte);
    void* const first = copies[i].mutable_data_ptr();
    if (brick * channel.count > 0) std::memcpy(first, channel.bricks, static_cast<size_t>(brick * channel.count));
    channel.bricks = first;
  }
}

// Calls body(args, begin, end) for chunks of the rays, which packets trace. args.hidden_tn gets a zero byte for each
// node: see kUnknown in walk.h.
template <class Body>
void trace_chunks(const torch::stable::Tensor& like, ShadeArgs args, const Body& body) {
  constexpr int64_t kChunk = 256;
  const torch::stable::Tensor hidden_tn =
      torch::stable::new_zeros(like, {args.nodes + 3}, torch::headeronly::ScalarType::Byte);
  args.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
  torch::stable::Tensor copies[3];
  prepare_pools(like, args, copies);
  for_chunks(RayOrder{args.rays, args.width}.count(), kChunk,
             [&](int64_t begin, int64_t end) { body(args, begin, end); });
}

}  // namespace gvtorch
