// The body of `voxelize`: what cubes of voxels hold of the triangles near them. Twin and sources:
// ops/reference/voxelize.py, whose order of operations is kept. Coordinates are in voxels, from a cube's low corner.
#pragma once

#include "base/arguments.h"
#include "base/arithmetic.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

constexpr int32_t kMostVoxels = 16;  // along a side of a cube: a row's numbers stay in registers and first cache
constexpr double kFlat = 1e-3, kTouch = 1e-6;

// triangles, cubes
#define GV_VOXELIZE(X)                \
  X(Reals, corner_m33, 9 * triangles) \
  X(Flags, solid_m, triangles)        \
  X(Longs, first_k, cubes + 1)        \
  X(Reals, start_k3, 3 * cubes)       \
  X(Words, winding_k, cubes)          \
  X(Reals, voxel_3, 3)                \
  X(Int, side, kMostVoxels + 1)       \
  X(Float, thickness, kAny)

// The voxels of a row that are looked at together: on the CPU a vector of float32, else one.
#ifdef __CUDACC__
template <class T>
using Together = T;
#else
template <class T>
using Together = std::conditional_t<std::is_same_v<T, float>, Floats, T>;
#endif
template <class T>
constexpr int32_t kTogether = static_cast<int32_t>(sizeof(Together<T>) / sizeof(T));

// A place may be of one number an axis, or of a vector of them (F) where the triangle's are numbers (T).
template <class F, class T>
GV_HD Vec3<F> minus(Vec3<F> a, Vec3<T> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class F, class T>
GV_HD auto inner(Vec3<F> a, Vec3<T> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T>
GV_HD Vec3<T> outer(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// What of a triangle is the same for all places.
template <class T>
struct Triangle {
  Vec3<T> corner[3], edge[3], beside[3], normal;
  T inverse2[3], length2, most;  // most: what `beside` may give inside; less where there is no area

  GV_HD explicit Triangle(const T* at) {
    for (int i = 0; i < 3; ++i) corner[i] = {at[3 * i], at[3 * i + 1], at[3 * i + 2]};
    for (int i = 0; i < 3; ++i) edge[i] = minus(corner[(i + 1) % 3], corner[i]);
    normal = outer(edge[0], minus(corner[2], corner[0]));
    const T squared = inner(normal, normal);
    length2 = squared > 0 ? squared : static_cast<T>(1);
    most = static_cast<T>(squared > 0 ? 0 : -1);
    for (int i = 0; i < 3; ++i) {
      beside[i] = outer(edge[i], normal);
      const T edge2 = inner(edge[i], edge[i]);
      inverse2[i] = 1 / (edge2 > 0 ? edge2 : static_cast<T>(1));
    }
  }

  template <class F>
  GV_HD Vec3<F> from_edge(int i, Vec3<F> place) const {
    const Vec3<F> from = minus(place, corner[i]);
    const F t = clamp(inner(from, edge[i]) * inverse2[i], F{}, F{} + 1);
    return {from.x - t * edge[i].x, from.y - t * edge[i].y, from.z - t * edge[i].z};
  }
  // Whether the nearest place of the triangle's plane lies in the triangle.
  template <class F>
  GV_HD auto over(Vec3<F> place) const {
    const F first = inner(minus(place, corner[0]), beside[0]), second = inner(minus(place, corner[1]), beside[1]),
            third = inner(minus(place, corner[2]), beside[2]);
    return larger(larger(first, second), third) <= most + F{};
  }
  template <class F>
  GV_HD F gap2(Vec3<F> place) const {
    const Vec3<F> from0 = from_edge(0, place), from1 = from_edge(1, place), from2 = from_edge(2, place);
    const F best = smaller(smaller(inner(from0, from0), inner(from1, from1)), inner(from2, from2));
    const F height = inner(minus(place, corner[0]), normal);
    return select(over(place), height * height / length2, best);
  }
  // A vector along which the nearest place lies, of any length and sign.
  GV_HD Vec3<T> away(Vec3<T> place, T gap2) const {
    if (over(place) || gap2 < static_cast<T>(kTouch)) return normal;
    Vec3<T> toward{};
    T best{};
    for (int i = 0; i < 3; ++i) {
      const Vec3<T> from = from_edge(i, place);
      const T own = inner(from, from);
      if (i == 0 || own < best) {
        toward = from;
        best = own;
      }
    }
    return toward;
  }
};

// Where a line along an axis pierces a triangle (`at`), and which way its normal points along it; 0: it passes beside.
template <class T>
struct Pierced {
  T at;
  int32_t way;
};
template <class T>
GV_HD Pierced<T> pierced(Vec3<T> place, const Vec3<T>* corner, int axis) {
  const int first = (axis + 1) % 3, second = (axis + 2) % 3;
  T side[3];
  bool positive[3];
  for (int i = 0; i < 3; ++i) {
    Vec3<T> u = corner[(i + 1) % 3], v = corner[(i + 2) % 3];
    const bool swap = u[first] > v[first] || (u[first] == v[first] && u[second] > v[second]);
    if (swap) {
      const Vec3<T> kept = u;
      u = v;
      v = kept;
    }
    const T area =
        (v[first] - u[first]) * (place[second] - u[second]) - (v[second] - u[second]) * (place[first] - u[first]);
    side[i] = swap ? -area : area;
    positive[i] = (area >= 0) != swap;
  }
  const T total = side[0] + side[1] + side[2];
  if (positive[0] != positive[1] || positive[1] != positive[2] || total == 0) return {0, 0};
  const T height = side[0] * corner[0][axis] + side[1] * corner[1][axis] + side[2] * corner[2][axis];
  return {height / total, positive[0] ? 1 : -1};
}

// The share of a box below a plane. Scardovelli and Zaleski 2000.
template <class T>
GV_HD T box_share(Vec3<T> normal, T offset, Vec3<T> voxel) {
  const T length = square_root(inner(normal, normal));
  const T x0 = (normal.x < 0 ? -normal.x : normal.x) * voxel.x, y0 = (normal.y < 0 ? -normal.y : normal.y) * voxel.y,
          z0 = (normal.z < 0 ? -normal.z : normal.z) * voxel.z;
  const T least = static_cast<T>(kFlat) * (x0 + y0 + z0);
  const T x = larger(x0, least), y = larger(y0, least), z = larger(z0, least);
  const T low = smaller(x, y), high = larger(x, y), rest = smaller(high, z);
  T m1 = smaller(low, rest), m2 = larger(low, rest), m3 = larger(high, z);
  T total = m1 + m2 + m3;
  total = total > 0 ? total : static_cast<T>(1);
  m1 = m1 / total;
  m2 = m2 / total;
  m3 = m3 / total;
  const T full = offset * length / total + static_cast<T>(0.5);
  const T beyond = 1 - full, nearer = smaller(full, beyond), alpha = nearer > 0 ? nearer : static_cast<T>(0);
  const T m12 = m1 + m2, six = 6 * m1 * m2 * m3, pair = 2 * m2 * m3;
  T share;
  if (alpha < m1) {
    share = alpha * alpha * alpha / (six > 0 ? six : static_cast<T>(1));
  } else if (alpha < m2) {
    const T two = pair > 0 ? pair : static_cast<T>(1);
    share = alpha * (alpha - m1) / two + m1 * m1 / (3 * two);
  } else if (alpha >= m12 && m12 <= m3) {
    share = (2 * alpha - m12) / (2 * (m3 > 0 ? m3 : static_cast<T>(1)));
  } else {
    const bool all = !(alpha < m3);
    const T most = all ? alpha * alpha * (3 - 2 * alpha) : alpha * alpha * (3 * m12 - alpha);
    T sum = most + m1 * m1 * (m1 - 3 * alpha) + m2 * m2 * (m2 - 3 * alpha);
    if (all) sum = sum + m3 * m3 * (m3 - 3 * alpha);
    share = sum / (six > 0 ? six : static_cast<T>(1));
  }
  share = full > static_cast<T>(0.5) ? 1 - share : share;
  return clamp(share, static_cast<T>(0), static_cast<T>(1));
}

// An index is a row of voxels along x.
template <class T>
struct VoxelizeRow {
  const T* corner_m33;
  const bool* solid_m;
  const int64_t* first_k;
  const T* start_k3;
  const int32_t* winding_k;
  const T* voxel_3;
  int32_t side;
  double thickness;
  int64_t triangles;

  T *distance_kzyx, *coverage_kzyx;
  int32_t *nearest_kzyx, *winding_kzyx;

  GV_HD void operator()(int64_t row) const {
    const int64_t cube = row / (side * side);
    const Vec3<T> voxel{voxel_3[0], voxel_3[1], voxel_3[2]};
    const auto half = static_cast<T>(0.5);
    const T y = (static_cast<T>(row % side) + half) * voxel.y;
    const T z = (static_cast<T>(row / side % side) + half) * voxel.z;
    const Vec3<T> start{start_k3[3 * cube], start_k3[3 * cube + 1], start_k3[3 * cube + 2]};
    using F = Together<T>;
    using I = typename LanesOf<F>::Int;
    constexpr int32_t kMostPacks = kMostVoxels / kTogether<T>;
    const int32_t packs = (side + kTogether<T> - 1) / kTogether<T>;
    F place[kMostPacks], best[kMostPacks];
    I found[kMostPacks];
    int32_t count[kMostVoxels];
    for (int32_t pack = 0; pack < packs; ++pack) {
      best[pack] = F{} + bit_cast<float>(0x7f800000);
      found[pack] = I{} - 1;
      for (int32_t lane = 0; lane < kTogether<T>; ++lane) {
        set_lane(place[pack], lane, (static_cast<T>(pack * kTogether<T> + lane) + half) * voxel.x);
      }
    }
    for (int32_t i = 0; i < side; ++i) count[i] = winding_k[cube];
    // Lists that would lead out of the triangles are cut.
    const int64_t begin = clamp<int64_t>(first_k[cube], 0, triangles);
    const int64_t end = clamp<int64_t>(first_k[cube + 1], 0, triangles);
    for (int64_t m = begin; m < end; ++m) {
      const Triangle<T> triangle(corner_m33 + 9 * m);
      for (int32_t pack = 0; pack < packs; ++pack) {
        const F gap2 = triangle.gap2(Vec3<F>{place[pack], F{} + y, F{} + z});
        const auto nearer = gap2 < best[pack];
        found[pack] = select(nearer, I{} + static_cast<int32_t>(m), found[pack]);
        best[pack] = select(nearer, gap2, best[pack]);
      }
      if (solid_m[m]) cross(triangle.corner, start, voxel.x, y, z, count);
    }
    for (int32_t i = 0; i < side; ++i) {
      const int64_t at = row * side + i;
      const int32_t pack = i / kTogether<T>, lane = i % kTogether<T>;
      const T gap2 = lane_of(best[pack], lane);
      const int32_t nearest = lane_of(found[pack], lane);
      distance_kzyx[at] = square_root(gap2);
      nearest_kzyx[at] = nearest;
      winding_kzyx[at] = count[i];
      coverage_kzyx[at] = coverage({lane_of(place[pack], lane), y, z}, gap2, nearest, count[i], voxel);
    }
  }

  // Adds by how much a triangle makes the winding numbers of a row larger than that at the start.
  GV_HD void cross(const Vec3<T>* corner, Vec3<T> start, T step, T y, T z, int32_t* count) const {
    const Pierced<T> up = pierced(start, corner, 2);
    const Pierced<T> across = pierced({start.x, start.y, z}, corner, 1);
    const Pierced<T> along = pierced({start.x, y, z}, corner, 0);
    const int32_t before = up.way * ((up.at > z) - (up.at > start.z)) +
                           across.way * ((across.at > y) - (across.at > start.y)) - along.way * (along.at > start.x);
    if (before == 0 && along.way == 0) return;
    for (int32_t i = 0; i < side; ++i) {
      count[i] += before + along.way * (along.at > (static_cast<T>(i) + static_cast<T>(0.5)) * step);
    }
  }

  GV_HD T coverage(Vec3<T> place, T gap2, int32_t nearest, int32_t winding, Vec3<T> voxel) const {
    const T full = winding != 0 ? 1 : 0;
    if (nearest < 0) return full;
    const Triangle<T> triangle(corner_m33 + 9 * static_cast<int64_t>(nearest));
    const Vec3<T> away = triangle.away(place, gap2);
    const T gap = square_root(gap2);
    if (solid_m[nearest]) {
      const T below = box_share(away, gap, voxel);
      return winding != 0 ? below : 1 - below;
    }
    const T half = static_cast<T>(0.5 * thickness);
    return winding != 0 ? full : box_share(away, gap + half, voxel) - box_share(away, gap - half, voxel);
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
