// Rays through the pixels of pinhole cameras, in the world and in float64. Equal to the twin in ops/cameras.py.
#pragma once

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch::GV_NAMESPACE {

// Rows are counted through the batch: `rows` from `first`, `height` per camera. In scope for the limits: cameras
#define GV_PINHOLE_RAYS(X)                   \
  X(World, camera_nc, cameras* args.columns) \
  X(Int, first, kAny)                        \
  X(Int, rows, kAny)                         \
  X(Int, width, kAny)                        \
  X(Int, height, kAny)

struct PinholeRays {
  // Columns of a camera: rotation from world to camera (3, 3); position; focal lengths and centre of the picture, along
  // x and y, in pixels; cone and range of its rays. There may be further columns.
  enum { kRotation = 0, kPosition = 9, kFocal = 12, kCenter = 14, kCone = 16, kRange = 18, kLeastColumns = 20 };
  GV_PINHOLE_RAYS(GV_VIEW)
  int64_t columns;
  double *origin_r3, *direction_r3, *cone_r2, *range_r2;
#ifdef __CUDACC__
  static constexpr int64_t kThreads = 3;  // per ray, so that neighbouring threads write neighbouring numbers
#else
  static constexpr int64_t kThreads = 1;
#endif

  GV_HD void operator()(int64_t index) const {
    const int64_t ray = index / kThreads;
    const int32_t ray_int32 = static_cast<int32_t>(ray);  // 31 bits: a GPU divides wider numbers slowly
    const int32_t row_offset = ray_int32 / width, row = first + row_offset;
    const double* const camera = camera_nc + row / height * columns;
    const double x = (static_cast<double>(ray_int32 - row_offset * width) - camera[kCenter]) / camera[kFocal];
    const double y = (static_cast<double>(row % height) - camera[kCenter + 1]) / camera[kFocal + 1];
    const double length = square_root(x * x + (y * y + 1));
    for (int64_t axis = index % kThreads; axis < 3; axis += kThreads) {
      const double forward = y * camera[kRotation + 3 + axis] + camera[kRotation + 6 + axis];
      origin_r3[3 * ray + axis] = camera[kPosition + axis];
      direction_r3[3 * ray + axis] = (x * camera[kRotation + axis] + forward) / length;
      if (axis == 2) break;
      cone_r2[2 * ray + axis] = camera[kCone + axis];
      range_r2[2 * ray + axis] = camera[kRange + axis];
    }
  }
};

}  // namespace gvtorch::GV_NAMESPACE
