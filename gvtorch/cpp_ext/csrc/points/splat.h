// The kernels of `splat`: sums of the values of points in cubes of voxels. Twin and source: ops/splat.py, with the same
// order of operations. A voxel adds points in the order of its cube's lists, however the work is divided. Skipping
// points without a share changes no bit: sums begin at 0 and are never -0, the only number that adding 0 changes.
#pragma once

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch {

constexpr int64_t kMaxSplatSide = 1 << 20;  // voxels along a side of a cube
constexpr double kSmallest = 0x1p-1000;     // smallest radius to divide by: SMALLEST of the twin

// The list of cube k is the runs of rows narrow_b[k] to narrow_b[k + 1], and wide_b[k] to wide_b[k + 1].
#define GV_SPLAT(X)                                    \
  X(World, edge_k3e, 3 * args.cubes * (args.side + 1)) \
  X(Longs, low_k3, 3 * args.cubes)                     \
  X(Longs, narrow_b, args.cubes + 1)                   \
  X(Longs, narrow_s2, 2 * args.narrow_runs)            \
  X(Longs, voxel_n3, 3 * args.narrow)                  \
  X(World, value_nc, args.narrow* args.width)          \
  X(Longs, wide_b, args.cubes + 1)                     \
  X(Longs, wide_t2, 2 * args.wide_runs)                \
  X(World, center_m3, 3 * args.wide)                   \
  X(World, radius_m, args.wide)                        \
  X(World, value_mc, args.wide* args.width)

struct SplatArgs {
  GV_SPLAT(GV_VIEW)
  int64_t cubes, side, width, narrow, narrow_runs, wide, wide_runs;
  double* sum_kzyxc;
};

inline namespace GV_NAMESPACE {

// Calls body(row) for the rows of a cube's list.
template <class Body>
GV_HD void for_rows(const Span& runs, const int64_t* run_s2, int64_t rows, const Body& body) {
  for (int64_t run = runs.begin; run < runs.end; ++run) {
    const Span span(run_s2 + 2 * run, rows);
    for (int64_t row = span.begin; row < span.end; ++row) body(row);
  }
}

// A voxel's index in a cube; at least the side if it is outside the cube.
GV_HD uint64_t from_low(int64_t voxel, int64_t low) {
  return static_cast<uint64_t>(voxel) - static_cast<uint64_t>(low);
}

// The spread of a point along one axis.
struct Spread {
  double center, scale;
  bool wide;

  GV_HD Spread(double center, double radius) : center(center), scale(2 / larger(radius, kSmallest)), wide(radius > 0) {}

  // True if a point certainly has no share between two edges; with a margin, because products are rounded.
  static GV_HD bool misses(double center, double radius, double low, double high) {
    const double reach = larger(radius, kSmallest) * (1 + 0x1p-20);
    return low - center > reach || center - high > reach;
  }

  // Signed distance of an edge from the point, scaled so that the spline's knots are the whole numbers -2 to 2.
  template <class T>
  GV_HD T away(T edge) const {
    const T high = T{} + 2.0, low = T{} - 2.0, from = edge - center;
    if (!wide) return select(from > T{}, high, low);
    return clamp(from * scale, low, high);
  }
  // The share of the point that is below an edge.
  template <class T>
  static GV_HD T below(T away) {
    const T zero{}, one = zero + 1.0, far = absolute(away), rest = 2.0 - far, square = rest * rest;
    const T inner = 0.5 - far * (2.0 / 3 - far * far * (1.0 / 3 - far * 0.125));
    const T tail = select(far > one, square * square * (1.0 / 24), inner);
    return select(away < zero, tail, 1.0 - tail);
  }
  GV_HD double share(const double* edge) const { return below(away(edge[1])) - below(away(edge[0])); }
};

// An index is a voxel.
struct SplatVoxel {
  SplatArgs args;
  static constexpr int kNumbersAtOnce = 4;  // numbers of a value that are summed at once

  GV_HD void operator()(int64_t index) const {
    const int64_t side = args.side;
    const uint64_t x = index % side, y = index / side % side, z = index / (side * side) % side;
    const int64_t cube = index / (side * side * side);
    const double* edge = args.edge_k3e + 3 * cube * (side + 1);
    const double *edge_x = edge + x, *edge_y = edge + side + 1 + y, *edge_z = edge + 2 * (side + 1) + z;
    const int64_t* low = args.low_k3 + 3 * cube;
    const Span narrow_span(args.narrow_b + cube, args.narrow_runs), wide_span(args.wide_b + cube, args.wide_runs);
    double* sum_c = args.sum_kzyxc + index * args.width;
    for (int64_t first = 0; first < args.width; first += kNumbersAtOnce) {
      double sum[kNumbersAtOnce] = {};
      const int64_t remaining = args.width - first;
      for_rows(narrow_span, args.narrow_s2, args.narrow, [&](int64_t row) {
        const int64_t* voxel = args.voxel_n3 + 3 * row;
        if (from_low(voxel[0], low[0]) != x || from_low(voxel[1], low[1]) != y || from_low(voxel[2], low[2]) != z)
          return;
        const double* value = args.value_nc + row * args.width + first;
        for (int i = 0; i < kNumbersAtOnce; ++i) sum[i] += i < remaining ? value[i] : 0.0;
      });
      for_rows(wide_span, args.wide_t2, args.wide, [&](int64_t row) {
        const double *center = args.center_m3 + 3 * row, radius = args.radius_m[row];
        if (Spread::misses(center[2], radius, edge_z[0], edge_z[1]) ||
            Spread::misses(center[1], radius, edge_y[0], edge_y[1]) ||
            Spread::misses(center[0], radius, edge_x[0], edge_x[1])) {
          return;
        }
        const double plane = Spread(center[2], radius).share(edge_z) * Spread(center[1], radius).share(edge_y);
        const double share_x = Spread(center[0], radius).share(edge_x);
        const double* value = args.value_mc + row * args.width + first;
        for (int i = 0; i < kNumbersAtOnce; ++i) sum[i] += plane * (share_x * (i < remaining ? value[i] : 0.0));
      });
      for (int i = 0; i < kNumbersAtOnce && i < remaining; ++i) sum_c[first + i] = sum[i];
    }
  }
};

#ifndef __CUDACC__
constexpr int64_t kPartX = 256, kPartY = 32, kPartZ = 16;  // numbers (voxels * width) along x; voxels along y and z

// The shares of a point in some voxels along an axis.
template <int64_t kMaxVoxels>
struct Shares {
  static constexpr int64_t kStep = sizeof(Doubles) / sizeof(double);
  double share[kMaxVoxels + kStep];
  int64_t begin, end;  // of the shares that are not 0

  // Computes the shares of `count` voxels, from their count + 1 edges.
  void fill(const Spread& point, const double* edge, int64_t count) {
    double below[kMaxVoxels + 2 * kStep];
    Doubles edges;
    for (int64_t first = 0; first <= count; first += kStep) {
      const int64_t filled = count + 1 - first < kStep ? count + 1 - first : kStep;
      if (filled == kStep) {
        memcpy(&edges, edge + first, sizeof(edges));
      } else {
        edges = broadcast<Doubles>(edge[count]);
        for (int64_t lane = 0; lane < filled; ++lane) edges[lane] = edge[first + lane];
      }
      edges = Spread::below(point.away(edges));
      memcpy(below + first, &edges, sizeof(edges));
    }
    for (int64_t i = 0; i < count; ++i) share[i] = below[i + 1] - below[i];
    begin = 0, end = count;
    while (begin < end && share[begin] == 0) ++begin;
    while (begin < end && share[end - 1] == 0) --end;
  }
};

// An index is a part of a cube.
struct SplatPart {
  SplatArgs args;

  int64_t along_x() const { return (args.side * args.width + kPartX - 1) / kPartX; }
  int64_t along_y() const { return (args.side + kPartY - 1) / kPartY; }
  int64_t along_z() const { return (args.side + kPartZ - 1) / kPartZ; }
  int64_t parts() const { return args.cubes * along_x() * along_y() * along_z(); }

  // A row of the cube has all numbers of its first voxel, then those of the next, and so on.
  void operator()(int64_t index) const {
    const int64_t side = args.side, width = args.width, row_size = side * width;
    const int64_t x0 = index % along_x() * kPartX, x1 = smaller(x0 + kPartX, row_size);
    index /= along_x();
    const int64_t y0 = index % along_y() * kPartY, y1 = smaller(y0 + kPartY, side);
    index /= along_y();
    const int64_t z0 = index % along_z() * kPartZ, z1 = smaller(z0 + kPartZ, side), cube = index / along_z();
    double* sum = args.sum_kzyxc + cube * side * side * row_size;
    for (int64_t z = z0; z < z1; ++z) {
      for (int64_t y = y0; y < y1; ++y) {
        memset(sum + (z * side + y) * row_size + x0, 0, static_cast<size_t>(x1 - x0) * sizeof(double));
      }
    }
    const int64_t* low = args.low_k3 + 3 * cube;
    const Span narrow_span(args.narrow_b + cube, args.narrow_runs), wide_span(args.wide_b + cube, args.wide_runs);
    for_rows(narrow_span, args.narrow_s2, args.narrow, [&](int64_t row) {
      const int64_t* voxel = args.voxel_n3 + 3 * row;
      const uint64_t x = from_low(voxel[0], low[0]), y = from_low(voxel[1], low[1]), z = from_low(voxel[2], low[2]);
      const uint64_t limit = side;
      if (x >= limit || y >= limit || z >= limit) return;
      const int64_t i = x * width, j = y, k = z;
      if (j < y0 || j >= y1 || k < z0 || k >= z1) return;
      double* target = sum + (k * side + j) * row_size + i;
      const double* value = args.value_nc + row * width;
      for (int64_t c = 0; c < width; ++c) {
        if (i + c >= x0 && i + c < x1) target[c] += value[c];
      }
    });
    const double* edge = args.edge_k3e + 3 * cube * (side + 1);
    const int64_t first = x0 / width, voxels = (x1 + width - 1) / width - first;
    const double *edge_x = edge + first, *edge_y = edge + side + 1 + y0, *edge_z = edge + 2 * (side + 1) + z0;
    Shares<kPartX> x;
    Shares<kPartY> y;
    Shares<kPartZ> z;
    double line[kPartX];
    for_rows(wide_span, args.wide_t2, args.wide, [&](int64_t row) {
      const double *center = args.center_m3 + 3 * row, radius = args.radius_m[row];
      if (Spread::misses(center[2], radius, edge_z[0], edge_z[z1 - z0]) ||
          Spread::misses(center[1], radius, edge_y[0], edge_y[y1 - y0]) ||
          Spread::misses(center[0], radius, edge_x[0], edge_x[voxels])) {
        return;
      }
      z.fill({center[2], radius}, edge_z, z1 - z0);
      y.fill({center[1], radius}, edge_y, y1 - y0);
      x.fill({center[0], radius}, edge_x, voxels);
      if (z.begin == z.end || y.begin == y.end || x.begin == x.end) return;
      const double* value = args.value_mc + row * width;
      const int64_t begin = larger((first + x.begin) * width, x0), end = smaller((first + x.end) * width, x1);
      int64_t voxel = begin / width - first, c = begin % width;
      for (int64_t i = begin; i < end; ++i) {
        line[i - begin] = x.share[voxel] * value[c];
        if (++c == width) c = 0, ++voxel;
      }
      for (int64_t k = z.begin; k < z.end; ++k) {
        for (int64_t j = y.begin; j < y.end; ++j) {
          const double plane = z.share[k] * y.share[j];
          double* target = sum + ((z0 + k) * side + y0 + j) * row_size + begin;
          for (int64_t i = 0; i < end - begin; ++i) target[i] += plane * line[i];
        }
      }
    });
  }
};
#endif

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
