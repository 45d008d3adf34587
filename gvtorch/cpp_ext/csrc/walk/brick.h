// Trilinear sampling of one channel of the brick pool.
//
// A brick is B*B*B voxels plus `border` voxels on every side, stored (z, y, x, c), x next to fastest. Voxel
// centres lie at half-integers of the brick's own units [0, B], so neighbours agree at the face they share as
// long as border >= 1: both interpolate the same two voxels. Positions beyond the stored centres are clamped.
#pragma once

#include "base/arguments.h"
#include "walk/ray.h"
#include "walk/tree.h"

namespace gvtorch::GV_NAMESPACE {

// Calls body(Voxel{}) with the C++ type of a channel's voxels.
#ifdef __CUDACC__
#pragma nv_exec_check_disable
#endif
template <class Body>
GV_HD void with_voxel(VoxelType type, const Body& body) {
  switch (type) {
    case VoxelType::kUInt8:
      return body(uint8_t{});
    case VoxelType::kInt8:
      return body(int8_t{});
    case VoxelType::kInt16:
      return body(int16_t{});
    case VoxelType::kUInt16:
      return body(uint16_t{});
    case VoxelType::kHalf:
      return body(Half{});
    case VoxelType::kBFloat16:
      return body(BFloat16{});
    case VoxelType::kFloat:
      return body(float{});
  }
}

inline int64_t brick_bytes(VoxelType type, int32_t side, int32_t width) {
  int64_t bytes = int64_t{side} * side * side * width;
  with_voxel(type, [&](auto voxel) { bytes *= sizeof(voxel); });
  return bytes;
}

// A node's brick along a ray: offset + t * slope is the position at distance t, in voxels from the first stored centre.
template <class T>
struct Spot {
  int32_t node = kAbsent, brick = kAbsent;
  T scale = 0;  // voxels per tree unit
  Vec3<T> offset{0, 0, 0}, slope{0, 0, 0};

  Spot() = default;
  GV_HD Spot(int32_t node, int32_t brick, T scale, Vec3<T> offset, Vec3<T> slope)
      : node(node), brick(brick), scale(scale), offset(offset), slope(slope) {}
  template <class Digits>
  GV_HD Spot(const Holder& holder, const Digits& digits, const Ray<T>& ray, int32_t border)
      : node(holder.node), brick(holder.brick), scale(digits.levels.scale[holder.depth]) {
    const T first = static_cast<T>(border) - static_cast<T>(0.5);
    for (int axis = 0; axis < 3; ++axis) {
      offset[axis] = -digits.face(axis, holder.depth, false) * scale + first;
      slope[axis] = ray.direction[axis] * scale;
    }
  }
  GV_HD Vec3<T> at(T t) const { return {offset.x + t * slope.x, offset.y + t * slope.y, offset.z + t * slope.z}; }
  // True if the brick is in one of the first `count` slots.
  GV_HD bool in_first_slots(int32_t count) const { return brick >= 0 && brick < count; }
};

// Lower one of the two voxels around a position along an axis; the upper one exists. Packets multiply floats faster.
template <class T>
GV_HD int32_t voxel_below(T position, int32_t side) {
  return smaller(static_cast<int32_t>(position), side - 2);
}
#ifndef __CUDACC__
GV_HD Floats voxel_below(Floats position, int32_t side) {
  return smaller(to_floats(truncated(position)), broadcast<Floats>(static_cast<float>(side - 2)));
}
#endif

// Blends eight values: weight_3 belongs to the upper one along each axis, pair(y, z, left, right) reads two along x.
template <class V, class T, class Pair>
GV_HD V blend_eight(const T* weight_3, const Pair& pair) {
  V plane[2];
  for (int z = 0; z < 2; ++z) {
    V row[2];
    for (int y = 0; y < 2; ++y) {
      V left, right;
      pair(y, z, left, right);
      row[y] = left + weight_3[0] * (right - left);
    }
    plane[z] = row[0] + weight_3[1] * (row[1] - row[0]);
  }
  return plane[0] + weight_3[2] * (plane[1] - plane[0]);
}

// The eight voxels around a position in a brick, and their weights. Positions count in voxels from the centre of the
// first one, and are clamped to the voxel centres.
template <class T>
struct EightVoxels {
  decltype(voxel_below(T{}, 0)) cell[3];
  T weight[3];

  GV_HD EightVoxels(const Vec3<T>& position, int32_t side) {
    using Real = RealOf<T>;
    for (int axis = 0; axis < 3; ++axis) {
      const T clamped = clamp(position[axis], static_cast<Real>(0), static_cast<Real>(side - 1));
      cell[axis] = voxel_below(clamped, side);
      weight[axis] = clamped - static_cast<T>(cell[axis]);
    }
  }
  // Without the clamp, for positions for which is_inside is true.
  GV_HD explicit EightVoxels(const Vec3<T>& position) {
    for (int axis = 0; axis < 3; ++axis) {
      cell[axis] = static_cast<int32_t>(position[axis]);
      weight[axis] = position[axis] - static_cast<T>(cell[axis]);
    }
  }
  GV_HD static bool is_inside(const Vec3<T>& position, int32_t side) {
    const T last = static_cast<T>(side - 1);
    return position.x >= 0 && position.y >= 0 && position.z >= 0 && position.x < last && position.y < last &&
           position.z < last;
  }
  template <class Pair>
  GV_HD T blend(const Pair& pair) const {
    return blend_eight<T>(weight, pair);
  }
};

// Trilinear interpolation of a brick's voxels, between eight corners or at a position.
template <class T, class Voxel>
GV_HD T trilinear(const Voxel* voxels, const EightVoxels<T>& corners, int32_t side, int32_t width) {
  const int32_t step_y = width * side, step_z = step_y * side;
  const auto offset =
      static_cast<uint32_t>(corners.cell[2] * step_z + corners.cell[1] * step_y + corners.cell[0] * width);
  const Voxel* corner = voxels + offset;
  return corners.blend([&](int y, int z, T& left, T& right) {
    const Voxel* first = corner + (z * step_z + y * step_y);
    left = number<T>(first[0]);
    right = number<T>(first[width]);
  });
}
template <class T, class Voxel>
GV_HD T trilinear(const Voxel* voxels, int32_t side, int32_t width, Vec3<T> position) {
  return trilinear(voxels, EightVoxels<T>(position, side), side, width);
}

}  // namespace gvtorch::GV_NAMESPACE
