// Bricks as packets read them, each lane in a brick of its own: the twin of brick.h.
#pragma once

#include "brick.h"
#include "simd.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Twin of BrickRay. A lane with a constant has no slope and reads the pool's first voxels in vain.
struct PacketBrick {
  Floats offset[3], slope[3];
  Floats constant;
  Mask stored;
  Ints brick;  // its first byte in the pool, or its number where that takes 64 bits

  GV_HD Vec3<Floats> at(Floats t) const {
    return {offset[0] + t * slope[0], offset[1] + t * slope[1], offset[2] + t * slope[2]};
  }
};

// One component of a channel of the brick pool.
struct PacketPool {
  const void* first;  // of the first voxel
  int64_t stride;     // bytes of a brick
  int32_t side, channels;

  PacketPool(const void* bricks, VoxelType type, int32_t side, int32_t channels, int32_t component)
      : side(side), channels(channels) {
    with_voxel(type, [&](auto voxel) {
      first = static_cast<const decltype(voxel)*>(bricks) + component;
      stride = int64_t{sizeof(voxel)} * side * side * side * channels;
    });
  }
  // Loads of 4 bytes may reach behind a voxel, but never behind the pool; places in a brick are counted in a float.
  bool fits() const { return stride >= 4 && stride < 1 << 24; }
  // Offsets in the pool need 64 bits.
  bool far(int64_t bricks) const { return stride * bricks > INT32_MAX; }
};

template <bool kFar>
GV_HD Ints load_words(const PacketPool& pool, Ints brick, Ints offset) {
  if (!kFar) return gather(pool.first, brick + offset);
  Ints word;
  for (int lane = 0; lane < kLanes; ++lane) {
    int32_t one;
    memcpy(&one, static_cast<const char*>(pool.first) + brick[lane] * pool.stride + offset[lane], 4);
    word[lane] = one;
  }
  return word;
}

// Two neighbours along x, blended. One load serves both where they lie in 4 bytes.
template <class Voxel, bool kFar>
GV_HD Floats sample_row(const PacketPool& pool, Ints brick, Ints offset, int32_t step_x, Floats weight) {
  constexpr int32_t kBytes = sizeof(Voxel);
  const Ints word = load_words<kFar>(pool, brick, offset);
  Ints next;
  if (kBytes <= 2 && step_x == kBytes) {
    next = (word >> (8 * kBytes % 32)) & ((1 << (8 * kBytes % 32)) - 1);
  } else {
    next = load_words<kFar>(pool, brick, offset + step_x);
  }
  const Floats from = Unpack<Voxel>::low(word);
  return from + weight * (Unpack<Voxel>::low(next) - from);
}

// Twin of `trilinear`. `brick`: as in PacketBrick.
template <class Voxel, bool kFar>
GV_HD Floats trilinear(const PacketPool& pool, Ints brick, const Vec3<Floats>& at) {
  const int32_t step_x = pool.channels * static_cast<int32_t>(sizeof(Voxel));
  const int32_t step_y = step_x * pool.side;
  const int32_t step_z = step_y * pool.side;
  const Floats last = Floats{} + static_cast<float>(pool.side - 1);
  Floats cell[3], weight[3];
  for (int axis = 0; axis < 3; ++axis) {
    const Floats place = clamp(at[axis], Floats{}, last);
    cell[axis] = smaller(to_floats(truncated(place)), last - 1.0f);
    weight[axis] = place - cell[axis];
  }
  const Ints corner = truncated(cell[2] * static_cast<float>(step_z) + cell[1] * static_cast<float>(step_y) +
                                cell[0] * static_cast<float>(step_x));
  Floats plane[2];
  for (int z = 0; z < 2; ++z) {
    const Floats near = sample_row<Voxel, kFar>(pool, brick, corner + z * step_z, step_x, weight[0]);
    const Floats behind = sample_row<Voxel, kFar>(pool, brick, corner + (z * step_z + step_y), step_x, weight[0]);
    plane[z] = near + weight[1] * (behind - near);
  }
  return plane[0] + weight[2] * (plane[1] - plane[0]);
}

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
