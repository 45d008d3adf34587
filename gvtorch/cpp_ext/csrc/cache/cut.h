// Bricks cut out of a level, borders from the neighbours, clamped at the level's faces. Equal to ops/reference/cut.py.
#pragma once

#include <cstring>

#include "base/arithmetic.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// An index is a plane of a brick. Sizes in voxels, of z, y, x; a voxel is `bytes` bytes, all its channels. Bricks lie
// anywhere in a level, so that each row is a miss: the rows of a later plane are fetched ahead.
struct CutBricks {
  const char* values_zyx;
  const int64_t* place_k3;
  char* bricks_kzyx;
  int64_t size_3[3];
  int64_t bytes, planes;
  int32_t brick_size, border;

  GV_HD int32_t side() const { return brick_size + 2 * border; }
  GV_HD int64_t low(int64_t plane, int32_t axis) const {
    return place_k3[3 * (plane / side()) + axis] * brick_size - border;
  }
  GV_HD int64_t inside(int64_t at, int32_t axis) const {
    return larger<int64_t>(0, smaller<int64_t>(at, size_3[axis] - 1));
  }
  // The voxel x = 0 of a row.
  GV_HD const char* row(int64_t plane, int32_t y) const {
    const int64_t z = inside(low(plane, 0) + plane % side(), 0);
    return values_zyx + (z * size_3[1] + inside(low(plane, 1) + y, 1)) * size_3[2] * bytes;
  }

  GV_HD void operator()(int64_t plane) const {
#ifndef __CUDA_ARCH__
    constexpr int64_t kAhead = 4;
    if (plane + kAhead < planes) {
      const int64_t x = inside(low(plane + kAhead, 2), 2);
      for (int32_t y = 0; y < side(); ++y) __builtin_prefetch(row(plane + kAhead, y) + x * bytes);
    }
#endif
    const int64_t first = low(plane, 2);
    const bool whole = first >= 0 && first + side() <= size_3[2];
    char* to = bricks_kzyx + plane * side() * side() * bytes;
    for (int32_t y = 0; y < side(); ++y, to += side() * bytes) {
      const char* from = row(plane, y);
      if (whole) {
        memcpy(to, from + first * bytes, side() * bytes);
        continue;
      }
      for (int32_t x = 0; x < side(); ++x) memcpy(to + x * bytes, from + inside(first + x, 2) * bytes, bytes);
    }
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
