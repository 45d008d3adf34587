// Rays through the pixels of pinhole cameras, in the world and in float64. Equal to the twin in ops/cameras.py.
#pragma once

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// planes, width, rows, columns
#define GV_PINHOLE_RAYS(X)      \
  X(World, x_kw, planes* width) \
  X(World, y_h, rows)           \
  X(World, camera_kc, planes* columns)

struct PinholeRays {
  GV_PINHOLE_RAYS(GV_VIEW)
  int64_t planes, width, columns;
  double *origin_r3, *direction_r3, *cone_r2, *range_r2;

  GV_HD void operator()(int64_t index) const {
    const int64_t row = index / width, plane = planes == 1 ? 0 : row;
    const double x = x_kw[plane * width + (index - row * width)], y = y_h[row];
    const double* const camera = camera_kc + plane * columns;
    const double length = square_root(x * x + (y * y + 1));
    for (int axis = 0; axis < 3; ++axis) {
      origin_r3[3 * index + axis] = camera[9 + axis];
      const double down = y * camera[3 + axis] + camera[6 + axis];
      direction_r3[3 * index + axis] = (x * camera[axis] + down) / length;
    }
    for (int end = 0; end < 2; ++end) {
      cone_r2[2 * index + end] = camera[16 + end];
      range_r2[2 * index + end] = camera[18 + end];
    }
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
