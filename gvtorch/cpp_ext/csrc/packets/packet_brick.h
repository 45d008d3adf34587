// How packets read bricks, each lane its own. Coordinates, weights and blending are those of brick.h; only the loads
// differ.
#pragma once

#include "shaders/probe.h"

namespace gvtorch::GV_NAMESPACE {

// Spot for a packet. A lane with a constant has slope 0; it reads the pool's first voxels, and the result is ignored.
struct PacketBrick {
  Vec3<Floats> offset, slope;
  Floats constant;
  Mask stored;
  Ints brick;  // its slot, or its first byte in the pool: see TypedValues

  // True where the brick is in one of the first `count` slots; only if `brick` holds slots.
  GV_HD Mask in_first_slots(int32_t count) const { return stored & (brick < count); }

  // Lanes of `mask`, which no longer use the brick, read the pool's first voxels.
  GV_HD void forget(Mask mask) {
    brick = select(mask, Ints{}, brick);
    offset = choose(mask, Vec3<Floats>{}, offset);
    slope = choose(mask, Vec3<Floats>{}, slope);
  }

  GV_HD Vec3<Floats> at(Floats t) const {
    return {offset.x + t * slope.x, offset.y + t * slope.y, offset.z + t * slope.z};
  }
};

// A channel of the brick pool.
struct PacketPool {
  const void* first;    // the number to read, in the pool's first voxel
  int64_t stride;       // bytes of a brick
  int32_t side, width;  // width: numbers per voxel

  PacketPool(const void* bricks, VoxelType type, int32_t side, int32_t width, int32_t component)
      : stride(brick_bytes(type, side, width)), side(side), width(width) {
    with_voxel(type, [&](auto voxel) { first = static_cast<const decltype(voxel)*>(bricks) + component; });
  }
  // True if offsets in the pool need 64 bits.
  bool needs_long_offsets(int64_t bricks) const { return stride * bricks > INT32_MAX; }
};

template <bool kLongOffsets>
GV_HD Ints load_words(const PacketPool& pool, Ints brick, Ints offset) {
  if (!kLongOffsets) return gather(pool.first, brick + offset);
  Ints words;
  for (int lane = 0; lane < kLanes; ++lane) {
    int32_t word;
    memcpy(&word, static_cast<const char*>(pool.first) + brick[lane] * pool.stride + offset[lane], 4);
    words[lane] = word;
  }
  return words;
}

// Offset of the lowest of eight voxels in a brick, whose voxels are step_x, step_y and step_z apart.
GV_HD Ints offset_of(const EightVoxels<Floats>& corners, int32_t step_x, int32_t step_y, int32_t step_z) {
  return truncated(corners.cell[2] * static_cast<float>(step_z) + corners.cell[1] * static_cast<float>(step_y) +
                   corners.cell[0] * static_cast<float>(step_x));
}

// Trilinear interpolation. `brick` is the brick's first byte in the pool or, with kLongOffsets, its slot, for 64-bit
// offsets.
template <class Voxel, bool kLongOffsets>
GV_HD Floats trilinear(const PacketPool& pool, Ints brick, const Vec3<Floats>& position) {
  constexpr int32_t kBytes = sizeof(Voxel);
  const int32_t step_x = pool.width * kBytes;
  const int32_t step_y = step_x * pool.side;
  const int32_t step_z = step_y * pool.side;
  const EightVoxels<Floats> corners(position, pool.side);
  const Ints corner = offset_of(corners, step_x, step_y, step_z);
  return corners.blend([&](int y, int z, Floats& left, Floats& right) {
    const Ints first = corner + (z * step_z + y * step_y);
    const Ints word = load_words<kLongOffsets>(pool, brick, first);
    left = unpack<Voxel>(word);
    if (kBytes <= 2 && step_x == kBytes) {  // one load serves both
      right = unpack<Voxel>((word >> (8 * kBytes % 32)) & ((1 << (8 * kBytes % 32)) - 1));
    } else {
      right = unpack<Voxel>(load_words<kLongOffsets>(pool, brick, first + step_x));
    }
  });
}

// Interpolates four numbers of the voxels, from `shift` bytes on; lane by lane, as the four are consecutive in memory.
template <class Voxel>
GV_CALL Row<Floats> read_packet_four(const PacketPool& pool, int64_t shift, Mask mask, Ints brick, Floats x, Floats y,
                                     Floats z) {
  const int64_t step_x = pool.width * static_cast<int64_t>(sizeof(Voxel));
  const int64_t step_y = step_x * pool.side, step_z = step_y * pool.side;
  const EightVoxels<Floats> corners(Vec3<Floats>{x, y, z}, pool.side);
  const Ints cell =
      truncated((corners.cell[2] * static_cast<float>(pool.side) + corners.cell[1]) * static_cast<float>(pool.side) +
                corners.cell[0]);
  const char* const first = static_cast<const char*>(pool.first) + shift;
  float numbers[kLanes][4] = {};
  for_lanes(mask, [&](int lane) {
    const char* const corner = first + brick[lane] * pool.stride + cell[lane] * step_x;
    const float weight[3] = {corners.weight[0][lane], corners.weight[1][lane], corners.weight[2][lane]};
    const Floats4 blended = blend_eight<Floats4>(weight, [&](int y, int z, Floats4& left, Floats4& right) {
      const char* const pair = corner + (z * step_z + y * step_y);
      left = four_numbers<Voxel>(pair);
      right = four_numbers<Voxel>(pair + step_x);
    });
    memcpy(numbers[lane], &blended, sizeof(blended));
  });
  Floats row[4];
  load_rows(numbers[0], lane_numbers(), row);
  return {row[0], row[1], row[2], row[3]};
}

// Interpolates several numbers of the voxels. A word of 32 bits holds up to four of them, which may include those of
// the next voxel along x.
template <class Voxel, bool kLongOffsets>
GV_CALL void read_packet_numbers(const PacketPool& pool, Components<float> components, int32_t count, Ints brick,
                                 Floats x, Floats y, Floats z, Floats* out) {
  constexpr int32_t kBytes = sizeof(Voxel);
  const int32_t step_x = pool.width * kBytes, step_y = step_x * pool.side, step_z = step_y * pool.side;
  const EightVoxels<Floats> corners(Vec3<Floats>{x, y, z}, pool.side);
  const Ints corner = offset_of(corners, step_x, step_y, step_z);
  const Ints slot = kLongOffsets ? brick : brick * static_cast<int32_t>(pool.stride);
  Ints words[8]{};
  int32_t loaded = -1;  // offset of the loaded words in the voxel, bytes
  for (int32_t i = 0; i < count; ++i) {
    const int32_t byte = components[i] * kBytes, word_offset = byte / 4 * 4, shift = 8 * (byte - word_offset);
    if (word_offset != loaded) {
      for (int voxel = 0; voxel < 8; voxel += 2) {
        const Ints first = corner + ((voxel >> 1 & 1) * step_y + (voxel >> 2) * step_z + word_offset);
        words[voxel] = load_words<kLongOffsets>(pool, slot, first);
        words[voxel + 1] =
            2 * step_x <= 4 ? words[voxel] >> (8 * step_x) : load_words<kLongOffsets>(pool, slot, first + step_x);
      }
      loaded = word_offset;
    }
    out[i] = corners.blend([&](int y, int z, Floats& left, Floats& right) {
      left = unpack<Voxel>(words[2 * y + 4 * z] >> shift);
      right = unpack<Voxel>(words[1 + 2 * y + 4 * z] >> shift);
    });
  }
}

// Interpolates the component at `shift` bytes in a voxel; `brick` is a slot.
template <class Voxel, bool kLongOffsets>
GV_HD Floats read_shifted(PacketPool pool, int64_t shift, Ints brick, const Vec3<Floats>& position) {
  pool.first = static_cast<const char*>(pool.first) + shift;
  return trilinear<Voxel, kLongOffsets>(pool, kLongOffsets ? brick : brick * static_cast<int32_t>(pool.stride),
                                        position);
}
template <class Voxel, bool kLongOffsets>
GV_CALL Floats read_packet(const PacketPool& pool, int64_t shift, Ints brick, Floats x, Floats y, Floats z) {
  return read_shifted<Voxel, kLongOffsets>(pool, shift, brick, {x, y, z});
}

// Differences of the component along each axis over one voxel, half a voxel to each side.
template <class Voxel, bool kLongOffsets>
GV_CALL Vec3<Floats> read_rise(const PacketPool& pool, int64_t shift, Ints brick, Floats x, Floats y, Floats z) {
  Vec3<Floats> rise;
  for (int axis = 0; axis < 3; ++axis) {
    Vec3<Floats> below{x, y, z}, above{x, y, z};
    below[axis] = below[axis] - 0.5f;
    above[axis] = above[axis] + 0.5f;
    rise[axis] = read_shifted<Voxel, kLongOffsets>(pool, shift, brick, above) -
                 read_shifted<Voxel, kLongOffsets>(pool, shift, brick, below);
  }
  return rise;
}

// A channel whose dtype is known at run time only. `brick` is a slot.
struct PacketChannel : ChannelView {
  PacketPool pool;
  int64_t bytes;  // of a number
  decltype(&read_packet<float, false>) reader;
  decltype(&read_rise<float, false>) rise_reader;
  decltype(&read_packet_four<float>) four_reader;
  decltype(&read_packet_numbers<float, false>) numbers_reader;

  PacketChannel(const ChannelView& channel, int32_t side, int64_t bricks)
      : ChannelView(channel), pool(bricks_bzyxc, type, side, width, 0) {
    with_voxel(type, [&](auto voxel) {
      using Voxel = decltype(voxel);
      bytes = sizeof(Voxel);
      reader = pool.needs_long_offsets(bricks) ? &read_packet<Voxel, true> : &read_packet<Voxel, false>;
      rise_reader = pool.needs_long_offsets(bricks) ? &read_rise<Voxel, true> : &read_rise<Voxel, false>;
      four_reader = &read_packet_four<Voxel>;
      numbers_reader =
          pool.needs_long_offsets(bricks) ? &read_packet_numbers<Voxel, true> : &read_packet_numbers<Voxel, false>;
    });
  }
  GV_HD Floats read(int32_t component, Ints brick, const Vec3<Floats>& position) const {
    return reader(pool, component * bytes, brick, position.x, position.y, position.z);
  }
  GV_HD Row<Floats> four(Mask mask, int32_t component, Ints brick, const Vec3<Floats>& position) const {
    return four_reader(pool, component * bytes, mask, brick, position.x, position.y, position.z);
  }
  GV_HD void numbers(Components<float> components, int32_t count, Ints brick, const Vec3<Floats>& position,
                     Floats* out) const {
    numbers_reader(pool, components, count, brick, position.x, position.y, position.z, out);
  }
  GV_HD Vec3<Floats> rise(int32_t component, Ints brick, const Vec3<Floats>& position) const {
    return rise_reader(pool, component * bytes, brick, position.x, position.y, position.z);
  }
};

// The shader's values: of a dtype known to the compiler, or only at run time. `slot_bytes` is what a slot is multiplied
// by to give PacketBrick::brick.
template <class KnownVoxel, bool kLongOffsets>
struct TypedValues {
  using Voxel = KnownVoxel;
  const PacketPool pool;

  TypedValues(const ChannelView& channel, int32_t side, int32_t component, int64_t)
      : pool(channel.bricks_bzyxc, channel.type, side, channel.width, component) {}
  int32_t slot_bytes() const { return kLongOffsets ? 1 : static_cast<int32_t>(pool.stride); }
  GV_HD Floats read(Ints brick, const Vec3<Floats>& position) const {
    return trilinear<Voxel, kLongOffsets>(pool, brick, position);
  }
};
struct AnyValues {
  using Voxel = void;
  const PacketChannel channel;
  const int32_t component;

  AnyValues(const ChannelView& channel, int32_t side, int32_t component, int64_t bricks)
      : channel(channel, side, bricks), component(component) {}
  int32_t slot_bytes() const { return 1; }
  GV_HD Floats read(Ints brick, const Vec3<Floats>& position) const { return channel.read(component, brick, position); }
  GV_HD Vec3<Floats> rise(Ints brick, const Vec3<Floats>& position) const {
    return channel.rise(component, brick, position);
  }
};

}  // namespace gvtorch::GV_NAMESPACE
