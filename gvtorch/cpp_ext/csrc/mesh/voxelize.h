// The kernels of `voxelize`: distance to a mesh, nearest triangle, winding number, coverage and weights, in cubes of
// voxels. Every voxel descends a hierarchy of boxes by itself, so that no list of triangles is made, for whose length
// the host would wait. Twin and sources: ops/reference/voxelize.py, which tests all triangles, with equal results.
// Coordinates are in voxels, from a cube's low corner.
#pragma once

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch {

constexpr int32_t kMaxCubeSide = 32;  // along a side of a cube
constexpr int32_t kArity = 8;         // boxes in a box
constexpr int32_t kMaxFloors = 12;    // levels of boxes: enough for 8^12 triangles
constexpr int32_t kStackSize = (kArity - 1) * kMaxFloors + kArity;
constexpr double kFlat = 1e-3;      // least share of a component in a normal's sum: divisions by it stay finite
constexpr double kTouch = 1e-6;     // squared distance, in voxels, below which a position lies on the triangle
constexpr double kBeyond = 0.8661;  // voxels: half a voxel's diagonal, within which a surface may cross it
constexpr double kParts = 1 << 30;  // of a voxel: volumes are summed as whole parts, in any order of triangles
constexpr int32_t kCorners = 16;    // of a clipped triangle, at most
constexpr double kCoarse = 2;       // voxel size, in triangle sizes (`detail`), above which voxels descend alone

// In scope for the limits: boxes
#define GV_VOXELIZE(X)                     \
  X(World, corner_f33, 9 * args.triangles) \
  X(Flags, solid_f, args.triangles)        \
  X(World, box_n6, 6 * boxes)              \
  X(World, low_k3, 3 * args.cubes)         \
  X(World, size_k3, 3 * args.cubes)        \
  X(Int, side, kMaxCubeSide + 1)           \
  X(Float, thickness, kAny)                \
  X(Float, detail, kAny)                   \
  X(Bool, shares, kAny)                    \
  X(Bool, weights, kAny)                   \
  X(Bool, wide, kAny)

// The kernels' arguments: boxes of floor i begin at first[i]; those of floor 0 are the triangles'.
struct VoxelizeArgs {
  GV_VOXELIZE(GV_VIEW)
  int64_t triangles, cubes;
  int32_t first[kMaxFloors + 1], floors;

  void *distance_kzyx, *coverage_kzyx, *weight_kzyx3;
  int32_t *nearest_kzyx, *winding_kzyx;
};

inline namespace GV_NAMESPACE {

// The voxels of a row that are processed together: on the CPU a vector of float32, else one.
#ifdef __CUDACC__
template <class T>
using VoxelVector = T;
#else
template <class T>
using VoxelVector = std::conditional_t<std::is_same_v<T, float>, Floats, T>;
#endif
template <class T>
constexpr int32_t kVectorSize = static_cast<int32_t>(sizeof(VoxelVector<T>) / sizeof(T));

template <class T>
GV_HD Vec3<T> outer(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// What is computed of a triangle once for all positions. A position has one number per axis, or a vector of them (F).
template <class T>
struct Triangle {
  Vec3<T> corner[3], edge[3], edge_normal[3], normal;
  // max_inside: largest product with `edge_normal` inside; below 0 for a triangle without area.
  T inverse2[3], length2, max_inside;

  GV_HD explicit Triangle(const Vec3<T>* corner_3) {
    for (int i = 0; i < 3; ++i) corner[i] = corner_3[i];
    for (int i = 0; i < 3; ++i) edge[i] = minus(corner[(i + 1) % 3], corner[i]);
    normal = outer(edge[0], minus(corner[2], corner[0]));
    const T squared = dot(normal, normal);
    length2 = squared > 0 ? squared : static_cast<T>(1);
    max_inside = static_cast<T>(squared > 0 ? 0 : -1);
    for (int i = 0; i < 3; ++i) {
      edge_normal[i] = outer(edge[i], normal);
      const T edge2 = dot(edge[i], edge[i]);
      inverse2[i] = 1 / (edge2 > 0 ? edge2 : static_cast<T>(1));
    }
  }

  template <class F>
  GV_HD Vec3<F> from_edge(int i, Vec3<F> position) const {
    const Vec3<F> from = minus(position, corner[i]);
    const F t = clamp(dot(from, edge[i]) * inverse2[i], F{}, F{} + 1);
    return {from.x - t * edge[i].x, from.y - t * edge[i].y, from.z - t * edge[i].z};
  }
  // True if the nearest point of the triangle's plane lies in the triangle.
  template <class F>
  GV_HD auto projects_inside(Vec3<F> position) const {
    const F first = dot(minus(position, corner[0]), edge_normal[0]),
            second = dot(minus(position, corner[1]), edge_normal[1]),
            third = dot(minus(position, corner[2]), edge_normal[2]);
    return larger(larger(first, second), third) <= max_inside + F{};
  }
  template <class F>
  GV_HD F gap2(Vec3<F> position) const {
    const Vec3<F> from0 = from_edge(0, position), from1 = from_edge(1, position), from2 = from_edge(2, position);
    const F best = smaller(smaller(dot(from0, from0), dot(from1, from1)), dot(from2, from2));
    const F height = dot(minus(position, corner[0]), normal);
    return select(projects_inside(position), height * height / length2, best);
  }
  // Weights of the corners at the nearest point. This and `away` both search for the nearest edge: one function for
  // both costs 5 to 11 % of the time for a mesh with distances.
  GV_HD Vec3<T> weight(Vec3<T> position) const {
    Vec3<T> weights{};
    if (projects_inside(position)) {
      for (int i = 0; i < 3; ++i) weights[(i + 2) % 3] = -dot(minus(position, corner[i]), edge_normal[i]) / length2;
      return weights;
    }
    int nearest = 0;
    T best{};
    for (int i = 0; i < 3; ++i) {
      const Vec3<T> from = from_edge(i, position);
      const T distance2 = dot(from, from);
      if (i == 0 || distance2 < best) {
        nearest = i;
        best = distance2;
      }
    }
    const T t = clamp(dot(minus(position, corner[nearest]), edge[nearest]) * inverse2[nearest], T{}, T{} + 1);
    weights[nearest] = 1 - t;
    weights[(nearest + 1) % 3] = t;
    return weights;
  }
  // A vector along the line to the nearest point, of any length and sign.
  GV_HD Vec3<T> away(Vec3<T> position, T gap2) const {
    if (projects_inside(position) || gap2 < static_cast<T>(kTouch)) return normal;
    Vec3<T> toward{};
    T best{};
    for (int i = 0; i < 3; ++i) {
      const Vec3<T> from = from_edge(i, position);
      const T distance2 = dot(from, from);
      if (i == 0 || distance2 < best) {
        toward = from;
        best = distance2;
      }
    }
    return toward;
  }
};

// Where a line along x pierces a triangle, and the sign of the triangle's normal along x; 0: it misses.
template <class T>
struct Pierced {
  T x;
  int32_t sign;
};
template <class T>
GV_HD Pierced<T> pierced(T y, T z, const Vec3<T>* corner) {
  T side[3];
  bool positive[3];
  for (int i = 0; i < 3; ++i) {
    Vec3<T> u = corner[(i + 1) % 3], v = corner[(i + 2) % 3];
    const bool swap = u.y > v.y || (u.y == v.y && u.z > v.z);
    if (swap) {
      const Vec3<T> old_u = u;
      u = v;
      v = old_u;
    }
    const T area = (v.y - u.y) * (z - u.z) - (v.z - u.z) * (y - u.y);
    side[i] = swap ? -area : area;
    positive[i] = (area >= 0) != swap;
  }
  const T total = side[0] + side[1] + side[2];
  if (positive[0] != positive[1] || positive[1] != positive[2] || total == 0) return {0, 0};
  const T height = side[0] * corner[0].x + side[1] * corner[1].x + side[2] * corner[2].x;
  return {height / total, positive[0] ? 1 : -1};
}

// A triangle clipped at the sides of voxels.
template <class T>
struct Polygon {
  Vec3<T> corner[kCorners];
  int32_t count = 0;

  GV_HD void push(Vec3<T> point) {
    if (count < kCorners) corner[count++] = point;
  }
  // True if all of it is above (`upper`) or below `limit` along an axis. Points in the plane are above.
  GV_HD bool within(int axis, T limit, bool upper) const {
    for (int32_t i = 0; i < count; ++i) {
      if ((corner[i][axis] >= limit) != upper) return false;
    }
    return true;
  }
  // The part that is above or below.
  GV_HD Polygon clip(int axis, T limit, bool upper) const {
    if (within(axis, limit, upper)) return *this;
    Polygon clipped;
    for (int32_t i = 0; i < count; ++i) {
      const Vec3<T> current = corner[i], following = corner[i + 1 < count ? i + 1 : 0];
      const bool inside = (current[axis] >= limit) == upper, next_inside = (following[axis] >= limit) == upper;
      if (inside) clipped.push(current);
      if (inside == next_inside) continue;
      const bool swap = current[axis] > following[axis];
      const Vec3<T> first = swap ? following : current, second = swap ? current : following;
      const T fraction = (limit - first[axis]) / (second[axis] - first[axis]);
      Vec3<T> crossing{first.x + fraction * (second.x - first.x), first.y + fraction * (second.y - first.y),
                       first.z + fraction * (second.z - first.z)};
      crossing[axis] = limit;
      clipped.push(crossing);
    }
    return clipped;
  }
  // The volume between x = 0 and the polygon, with the sign of its normal along x.
  GV_HD T volume_before() const {
    T total{};
    for (int32_t i = 1; i + 1 < count; ++i) {
      const Vec3<T>&a = corner[0], &b = corner[i], &c = corner[i + 1];
      const T area = (b.y - a.y) * (c.z - a.z) - (b.z - a.z) * (c.y - a.y);
      total += area * (a.x + b.x + c.x);
    }
    return total * static_cast<T>(1.0 / 6);
  }
};

// The share of a voxel below a plane. Scardovelli and Zaleski 2000.
template <class T>
GV_HD T box_share(Vec3<T> normal, T offset) {
  const T length = square_root(dot(normal, normal));
  const T x0 = absolute(normal.x), y0 = absolute(normal.y), z0 = absolute(normal.z);
  const T minimum = static_cast<T>(kFlat) * (x0 + y0 + z0);
  const T x = larger(x0, minimum), y = larger(y0, minimum), z = larger(z0, minimum);
  const T low = smaller(x, y), high = larger(x, y), rest = smaller(high, z);
  T m1 = smaller(low, rest), m2 = larger(low, rest), m3 = larger(high, z);
  T total = m1 + m2 + m3;
  total = total > 0 ? total : static_cast<T>(1);
  m1 = m1 / total;
  m2 = m2 / total;
  m3 = m3 / total;
  const T full = offset * length / total + static_cast<T>(0.5);
  const T complement = 1 - full, nearer = smaller(full, complement), alpha = nearer > 0 ? nearer : static_cast<T>(0);
  const T m12 = m1 + m2, six = 6 * m1 * m2 * m3, pair = 2 * m2 * m3;
  T share;
  if (alpha < m1) {
    share = alpha * alpha * alpha / (six > 0 ? six : static_cast<T>(1));
  } else if (alpha < m2) {
    const T divisor = pair > 0 ? pair : static_cast<T>(1);
    share = alpha * (alpha - m1) / divisor + m1 * m1 / (3 * divisor);
  } else if (alpha >= m12 && m12 <= m3) {
    share = (2 * alpha - m12) / (2 * (m3 > 0 ? m3 : static_cast<T>(1)));
  } else {
    const bool all = !(alpha < m3);
    const T cubic = all ? alpha * alpha * (3 - 2 * alpha) : alpha * alpha * (3 * m12 - alpha);
    T sum = cubic + m1 * m1 * (m1 - 3 * alpha) + m2 * m2 * (m2 - 3 * alpha);
    if (all) sum = sum + m3 * m3 * (m3 - 3 * alpha);
    share = sum / (six > 0 ? six : static_cast<T>(1));
  }
  share = full > static_cast<T>(0.5) ? 1 - share : share;
  return saturate(share);
}

// A stack of the boxes that are still to be visited.
struct BoxStack {
  int32_t box[kStackSize], floor[kStackSize];
  double gap2[kStackSize];
  int32_t count = 0;

  GV_HD void push(int32_t box_index, int32_t box_floor, double gap) {
    box[count] = box_index;
    floor[count] = box_floor;
    gap2[count] = gap;
    ++count;
  }
};

// An index is kPack voxels of a row along x, for which `write_winding` has run. T: float or double, for the
// computation.
template <class T>
struct VoxelizePack {
  VoxelizeArgs a;

  static constexpr double kMargin = sizeof(T) == 4 ? 1e-2 : 1e-6;  // voxels, more than rounding moves a triangle
  static constexpr int32_t kPack = kVectorSize<T>;
  static constexpr int kBlocksPerSM = 4;  // triangles need 128 registers per thread

  struct Cube {
    double low[3], voxel, inverse;
    T step, reach;

    GV_HD T local(double value, int axis) const { return static_cast<T>((value - low[axis]) * inverse); }
    GV_HD double world(T value, int axis) const { return low[axis] + static_cast<double>(value) * voxel; }
  };

  GV_HD int32_t packs() const { return (a.side + kPack - 1) / kPack; }

  GV_HD void operator()(int64_t index) const {
    const int64_t row = index / packs(), cube = row / (a.side * a.side);
    const int32_t begin = static_cast<int32_t>(index % packs()) * kPack;
    const int32_t end = begin + kPack < a.side ? begin + kPack : a.side;
    if (!(a.size_k3[3 * cube] > 0)) {
      for (int32_t i = begin; i < end; ++i) write(row * a.side + i, {}, infinite(), -1, 0);
      return;
    }
    const Cube frame = cube_at(cube);
    const T y = center_of(frame, row % a.side), z = center_of(frame, row / a.side % a.side);
    if (kPack == 1 || frame.voxel > kCoarse * a.detail) {
      for (int32_t i = begin; i < end; ++i) find_nearest<T>(frame, row, i, i + 1, y, z);
    } else {
      find_nearest<VoxelVector<T>>(frame, row, begin, end, y, z);
    }
    if (a.shares) write_coverage(frame, row, begin, end, y, z);
  }

  GV_HD Cube cube_at(int64_t cube) const {
    const double *low = a.low_k3 + 3 * cube, *size = a.size_k3 + 3 * cube, inverse = 1 / size[0];
    return {{low[0], low[1], low[2]},
            size[0],
            inverse,
            static_cast<T>(size[1] * inverse),
            static_cast<T>(size[2] * inverse)};
  }
  static GV_HD T infinite() { return static_cast<T>(bit_cast<float>(0x7f800000)); }
  static GV_HD T center_of(const Cube& cube, int64_t i) { return static_cast<T>(i) * cube.step + static_cast<T>(0.5); }

  // The three corners of a triangle, in voxels of the cube.
  GV_HD void read_corners(const Cube& cube, int64_t number, Vec3<T>* corner) const {
    for (int i = 0; i < 3; ++i) {
      const double* world_corner = a.corner_f33 + 9 * number + 3 * i;
      corner[i] = {cube.local(world_corner[0], 0), cube.local(world_corner[1], 1), cube.local(world_corner[2], 2)};
    }
  }
  GV_HD Triangle<T> triangle(const Cube& cube, int64_t number) const {
    Vec3<T> corner[3];
    read_corners(cube, number, corner);
    return Triangle<T>(corner);
  }
  // Distance along an axis between a box and the range from low to high; world units, 0 where they overlap.
  GV_HD double box_gap(int64_t box, int axis, double low, double high) const {
    const double below = a.box_n6[6 * box + axis] - high, above = low - a.box_n6[6 * box + 3 + axis];
    return larger(larger(below, above), 0.0);
  }

  // Calls body(triangle) for all triangles whose boxes have gap2(box) <= limit(), which may fall meanwhile; those of
  // nearer boxes first.
  template <class Gap, class Limit, class Body>
  GV_HD void descend(const Gap& gap2, const Limit& limit, const Body& body) const {
    BoxStack stack;
    int32_t floor = a.floors, from = 0, to = a.first[a.floors] - a.first[a.floors - 1];
    while (true) {
      --floor;  // the boxes from..to of this floor
      const int32_t base = stack.count;
      for (int32_t box = from; box < to; ++box) {
        const double gap = gap2(a.first[floor] + box);
        if (!(gap <= limit())) continue;
        int32_t slot = stack.count;  // sorted: the nearest of them is on top
        stack.push(box, floor, gap);
        for (; slot > base && stack.gap2[slot - 1] < gap; --slot) {
          stack.box[slot] = stack.box[slot - 1];
          stack.gap2[slot] = stack.gap2[slot - 1];
        }
        stack.box[slot] = box;
        stack.gap2[slot] = gap;
      }
      bool descends = false;
      while (stack.count > 0 && !descends) {
        const int32_t top = --stack.count;
        if (!(stack.gap2[top] <= limit())) continue;
        if (stack.floor[top] == 0) {
          body(stack.box[top]);
          continue;
        }
        floor = stack.floor[top];
        from = stack.box[top] * kArity;
        const int32_t box_count = a.first[floor] - a.first[floor - 1];
        to = from + kArity < box_count ? from + kArity : box_count;
        descends = true;
      }
      if (!descends) return;
    }
  }

  // Calls body(triangle) for the triangles of solids whose boxes reach into a beam along x, from x on.
  template <class Body>
  GV_HD void for_triangles_ahead(double x, double y0, double y1, double z0, double z1, const Body& body) const {
    descend(
        [&](int64_t number) {
          const double* box = a.box_n6 + 6 * number;
          const bool overlaps = box[1] <= y1 && box[4] >= y0 && box[2] <= z1 && box[5] >= z0 && box[3] >= x;
          return overlaps ? 0.0 : 1.0;
        },
        [] { return 0.0; },
        [&](int64_t number) {
          if (a.solid_f[number]) body(number);
        });
  }

  // Writes the winding numbers of a row, which packs read: triangles ahead along x count 1 if their normals point
  // ahead, else -1.
  GV_HD void write_winding(int64_t row) const {
    const int64_t number = row / (a.side * a.side);
    if (!(a.size_k3[3 * number] > 0)) return;
    const Cube cube = cube_at(number);
    const T y = center_of(cube, row % a.side), z = center_of(cube, row / a.side % a.side);
    const double margin = kMargin * cube.voxel, x = cube.world(center_of(cube, 0), 0) - margin;
    const double y0 = cube.world(y, 1) - margin, y1 = y0 + 2 * margin;
    const double z0 = cube.world(z, 2) - margin, z1 = z0 + 2 * margin;
    int32_t* winding = a.winding_kzyx + row * a.side;
    for (int32_t i = 0; i < a.side; ++i) winding[i] = 0;
    for_triangles_ahead(x, y0, y1, z0, z1, [&](int64_t number) {
      Vec3<T> corner[3];
      read_corners(cube, number, corner);
      const Pierced<T> along = pierced(y, z, corner);
      if (along.sign == 0) return;
      for (int32_t i = 0; i < a.side; ++i) winding[i] += along.sign * (along.x > center_of(cube, i));
    });
  }

  // Writes the coverage (the mean of the winding number) of those of the voxels begin..end of a row through which a
  // solid's surface may pass. A triangle adds the volume before it along x, with the sign of its normal.
  GV_HD void write_coverage(const Cube& cube, int64_t row, int32_t begin, int32_t end, T y, T z) const {
    const T* distance = static_cast<const T*>(a.distance_kzyx) + row * a.side;
    const int32_t* nearest = a.nearest_kzyx + row * a.side;
    const auto may_be_cut = [&](int32_t i) {
      return nearest[i] >= 0 && a.solid_f[nearest[i]] && distance[i] <= static_cast<T>(kBeyond);
    };
    while (begin < end && !may_be_cut(begin)) ++begin;
    while (begin < end && !may_be_cut(end - 1)) --end;
    if (begin == end) return;
    const auto half = static_cast<T>(0.5);
    const Vec3<T> low{center_of(cube, begin) - half, y - half, z - half};
    const double margin = kMargin * cube.voxel, x = cube.world(low.x, 0) - margin;
    const double y0 = cube.world(low.y, 1) - margin, y1 = y0 + cube.voxel + 2 * margin;
    const double z0 = cube.world(low.z, 2) - margin, z1 = z0 + cube.voxel + 2 * margin;
    int64_t parts[kPack] = {};
    for_triangles_ahead(x, y0, y1, z0, z1, [&](int64_t number) {
      Polygon<T> polygon;
      read_corners(cube, number, polygon.corner);
      polygon.count = 3;
      const Polygon<T> column = in_column(polygon, low);
      if (column.count == 0) return;
      for (int32_t i = begin; i < end; ++i) {
        if (may_be_cut(i)) parts[i - begin] += in_voxel(column, center_of(cube, i) - half, polygon);
      }
    });
    for (int32_t i = begin; i < end; ++i) {
      if (!may_be_cut(i)) continue;
      const int64_t sum = parts[i - begin];
      const T share = static_cast<T>(sum < 0 ? -sum : sum) * static_cast<T>(1 / kParts);
      static_cast<T*>(a.coverage_kzyx)[row * a.side + i] = smaller(share, static_cast<T>(1));
    }
  }

  // A triangle clipped to the y and z of a row of voxels, and moved so that the row begins at 0 there; x stays.
  GV_HD static Polygon<T> in_column(const Polygon<T>& polygon, Vec3<T> low) {
    Polygon<T> cut = polygon;
    for (int axis = 1; axis < 3; ++axis) {
      const T p = polygon.corner[0][axis], q = polygon.corner[1][axis], r = polygon.corner[2][axis];
      const bool overlaps = larger(larger(p, q), r) > low[axis] && smaller(smaller(p, q), r) < low[axis] + 1;
      if (!overlaps) return {};
    }
    for (int axis = 1; axis < 3; ++axis) {
      for (int32_t i = 0; i < cut.count; ++i) cut.corner[i][axis] = cut.corner[i][axis] - low[axis];
      cut = cut.clip(axis, 0, true).clip(axis, 1, false);
    }
    return cut;
  }

  // The volume of a row's voxel that is before a triangle, in units of 1 / kParts.
  GV_HD static int64_t in_voxel(const Polygon<T>& column, T low, const Polygon<T>& polygon) {
    if (!(larger(larger(polygon.corner[0].x, polygon.corner[1].x), polygon.corner[2].x) > low)) return 0;
    Polygon<T> shifted = column;
    for (int32_t i = 0; i < shifted.count; ++i) shifted.corner[i].x = shifted.corner[i].x - low;
    Polygon<T> ahead = shifted.clip(0, 1, true);
    for (int32_t i = 0; i < ahead.count; ++i) ahead.corner[i].x = 1;
    T volume = ahead.volume_before();
    if (!shifted.within(0, 1, true)) volume += shifted.clip(0, 0, true).clip(0, 1, false).volume_before();
    const T clamped = volume < 1 ? volume : static_cast<T>(1);
    return static_cast<int64_t>((clamped > -1 ? clamped : static_cast<T>(-1)) * static_cast<T>(kParts));
  }

  // Finds the nearest triangles of the voxels begin..end of a row together, and writes the voxels' results.
  template <class F>
  GV_HD void find_nearest(const Cube& cube, int64_t row, int32_t begin, int32_t end, T y, T z) const {
    using I = typename LanesOf<F>::Int;
    constexpr int32_t kLanesOfF = static_cast<int32_t>(sizeof(F) / sizeof(T));
    F x{}, best{};
    I nearest_index = I{} - 1;
    for (int32_t lane = 0; lane < kLanesOfF; ++lane) {  // lanes beyond the row's end repeat its last voxel
      set_lane(x, lane, center_of(cube, begin + lane < end ? begin + lane : end - 1));
      set_lane(best, lane, cube.reach * cube.reach);
    }
    const double x0 = cube.world(center_of(cube, begin), 0), x1 = cube.world(center_of(cube, end - 1), 0);
    const double y0 = cube.world(y, 1), z0 = cube.world(z, 2);
    const auto squared_limit = [&](T gap) {
      const double limit = (static_cast<double>(gap) + kMargin) * cube.voxel;
      return limit * limit;
    };
    double limit2 = cube.reach >= 0 ? squared_limit(cube.reach) : -1;
    descend(
        [&](int64_t box) {
          const double gx = box_gap(box, 0, x0, x1), gy = box_gap(box, 1, y0, y0), gz = box_gap(box, 2, z0, z0);
          return gx * gx + gy * gy + gz * gz;
        },
        [&] { return limit2; },
        [&](int64_t number) {
          const auto index = I{} + static_cast<int32_t>(number);
          const F gap2 = triangle(cube, number).gap2(Vec3<F>{x, F{} + y, F{} + z});
          const auto nearer = gap2 < best || (gap2 == best && (nearest_index < 0 || index < nearest_index));
          if (!any(nearer)) return;
          nearest_index = select(nearer, index, nearest_index);
          best = select(nearer, gap2, best);
          T worst = lane_of(best, 0);
          for (int32_t lane = 1; lane < kLanesOfF; ++lane) worst = larger(worst, lane_of(best, lane));
          limit2 = squared_limit(square_root(worst));
        });
    for (int32_t i = begin; i < end; ++i) {
      const int32_t nearest = lane_of(nearest_index, i - begin);
      const T gap2 = nearest < 0 ? infinite() : lane_of(best, i - begin);
      const int64_t voxel = row * a.side + i;
      if (nearest < 0) {
        write(voxel, {}, gap2, nearest, a.winding_kzyx[voxel]);
      } else {
        const Triangle<T> nearest_triangle = triangle(cube, nearest);
        const Vec3<T> position{lane_of(x, i - begin), y, z};
        write(voxel, position, gap2, nearest, a.winding_kzyx[voxel], &nearest_triangle, cube.inverse);
      }
    }
  }

  GV_HD void write(int64_t voxel, Vec3<T> position, T gap2, int32_t nearest, int32_t winding,
                   const Triangle<T>* triangle = nullptr, double inverse = 0) const {
    const T gap = square_root(gap2), full = winding != 0 ? 1 : 0;
    static_cast<T*>(a.distance_kzyx)[voxel] = gap;
    a.nearest_kzyx[voxel] = nearest;
    a.winding_kzyx[voxel] = winding;
    T share = full;
    Vec3<T> weight{};
    if (triangle != nullptr) {
      if (a.shares && !a.solid_f[nearest] && winding == 0) {
        const Vec3<T> away = triangle->away(position, gap2);
        const T half_thickness = static_cast<T>(0.5 * a.thickness * inverse);
        share = box_share(away, gap + half_thickness) - box_share(away, gap - half_thickness);
      }
      if (a.weights) weight = triangle->weight(position);
    }
    if (a.shares) static_cast<T*>(a.coverage_kzyx)[voxel] = share;
    if (!a.weights) return;
    for (int i = 0; i < 3; ++i) static_cast<T*>(a.weight_kzyx3)[3 * voxel + i] = weight[i];
  }
};

// An index is a row.
template <class T>
struct WindRow {
  VoxelizePack<T> pack;

  static constexpr int kBlocksPerSM = VoxelizePack<T>::kBlocksPerSM;

  GV_HD void operator()(int64_t row) const { pack.write_winding(row); }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
