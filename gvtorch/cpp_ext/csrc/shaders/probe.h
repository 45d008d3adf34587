// Probe: what a shader can read at a position on its ray: values of any channel, of any dtype, and gradients. Where two
// levels blend, the coarse one has the weight (cone - voxel) * blend, linear from 0 at the fine voxel's width to 1 at
// the coarse one's. The dtype is a switch at run time, the same for all threads, unless it is compiled in.
#pragma once

#include <type_traits>

#include "walk/shade.h"
#include "walk/walk.h"

namespace gvtorch::GV_NAMESPACE {

constexpr int32_t kMaxNumbers = 16;  // of a voxel that `numbers_at` reads at once

// How read_number and read_brick convert voxels, and read_four where rays have shadows. By an instruction for halves
// they would need fewer registers, and nvcc would leave fewer for the loads of all dtypes: shadows on a GPU would take
// a tenth longer.
template <class Voxel>
using Converted = std::conditional_t<std::is_same_v<Voxel, Half>, PlainHalf, Voxel>;

template <class T>
GV_CALL T read_number(const void* numbers, VoxelType type, int64_t index) {
  T out = 0;
  with_voxel(type,
             [&](auto voxel) { out = number<T>(static_cast<const Converted<decltype(voxel)>*>(numbers)[index]); });
  return out;
}

struct ChannelView {
  const void* bricks_bzyxc;  // null where there is no brick
  const void* constant_tnc;  // null: there is no such channel, or only bricks have it
  VoxelType type;
  int32_t width;  // numbers per voxel

  GV_HD bool exists() const { return constant_tnc != nullptr; }
  // A number of a node without a brick; 0 where there is no node.
  template <class T>
  GV_HD T constant(int32_t node, int32_t component) const {
    return node < 0 ? T{} : read_number<T>(constant_tnc, type, static_cast<int64_t>(node) * width + component);
  }
};

// A call, not inlined: shaders read in many places, and each would hold the code of seven dtypes. Arguments are passed
// by value, because an address would put the whole kernel's arguments on the stack; a position as three numbers,
// because a struct would go over the stack in 8-byte stores and 16-byte loads, for which a CPU waits.
template <class T>
GV_CALL T read_brick(const void* voxels, VoxelType type, int32_t width, int64_t first, int32_t side, T x, T y, T z) {
  T out = 0;
  with_voxel(type, [&](auto voxel) {
    out = trilinear(static_cast<const Converted<decltype(voxel)>*>(voxels) + first, side, width, Vec3<T>{x, y, z});
  });
  return out;
}

// Interpolates four consecutive numbers of the voxels.
template <class T, bool kShadows>
GV_CALL Row<T> read_four(const void* voxels, VoxelType type, int32_t width, int64_t first, int32_t side, T x, T y,
                         T z) {
  Row<T> row{};
  with_voxel(type, [&](auto voxel) {
    using Voxel = std::conditional_t<kShadows, Converted<decltype(voxel)>, decltype(voxel)>;
    const EightVoxels<T> corners({x, y, z}, side);
    const int32_t step_y = width * side, step_z = step_y * side;
    const auto* corner = static_cast<const Voxel*>(voxels) + first +
                         (corners.cell[2] * step_z + corners.cell[1] * step_y + corners.cell[0] * width);
    const auto blend = [&](int32_t i) {
      return corners.blend([&](int y, int z, T& left, T& right) {
        const auto* pair = corner + (z * step_z + y * step_y) + i;
        left = number<T>(pair[0]);
        right = number<T>(pair[width]);
      });
    };
    row = {blend(0), blend(1), blend(2), blend(3)};
  });
  return row;
}

// The indices of the numbers of a voxel to read: whole numbers, `stride` apart in memory.
template <class T>
struct Components {
  const T* first;
  int32_t stride, width;

  GV_HD int32_t operator[](int32_t i) const {
    return static_cast<int32_t>(clamp(first[i * stride], static_cast<T>(0), static_cast<T>(width - 1)));
  }
};

// Interpolates several numbers of the voxels; the eight voxels are found once.
template <class T>
GV_CALL void read_numbers(const void* voxels, VoxelType type, Components<T> components, int32_t count, int64_t first,
                          int32_t side, T x, T y, T z, T* out) {
  with_voxel(type, [&](auto voxel) {
    const EightVoxels<T> corners({x, y, z}, side);
    const int32_t width = components.width, step_y = width * side, step_z = step_y * side;
    const auto* corner = static_cast<const decltype(voxel)*>(voxels) + first +
                         (corners.cell[2] * step_z + corners.cell[1] * step_y + corners.cell[0] * width);
    for (int32_t i = 0; i < count; ++i) {
      const int32_t component = components[i];
      out[i] = corners.blend([&](int y, int z, T& left, T& right) {
        const auto* pair = corner + (z * step_z + y * step_y) + component;
        left = number<T>(pair[0]);
        right = number<T>(pair[width]);
      });
    }
  });
}

// A vector of length 1, or 0 where there is no direction.
template <class T>
GV_HD Vec3<T> unit(Vec3<T> v) {
  const T largest = larger(larger(absolute(v.x), absolute(v.y)), absolute(v.z));
  const MaskOf<T> nonzero = largest > 0 && largest < static_cast<RealOf<T>>(INFINITY);
  Vec3<T> scaled{};
  if (!any(nonzero)) return scaled;
  scaled = {v.x / largest, v.y / largest, v.z / largest};
  const T length = square_root(dot(scaled, scaled));
  for (int axis = 0; axis < 3; ++axis) scaled[axis] = select(nonzero, scaled[axis] / length, T{});
  return scaled;
}

// The eye's ray in the world.
template <class T>
struct Sight {
  Vec3<T> origin, direction;
  T moved;  // distance from the camera to where t counts from

  Sight() = default;
  GV_HD Sight(Vec3<T> origin, Vec3<T> direction) : origin(origin), direction(direction), moved{} {}
  GV_HD Sight(const RayView& rays, int64_t index, T moved) : moved(moved) {
    for (int axis = 0; axis < 3; ++axis) {
      origin[axis] = static_cast<T>(rays.origin_r3[3 * index + axis]);
      direction[axis] = static_cast<T>(rays.direction_r3[3 * index + axis]);
    }
  }
  GV_HD Vec3<T> at(T t) const {
    const T distance = t + moved;
    return {origin.x + distance * direction.x, origin.y + distance * direction.y, origin.z + distance * direction.z};
  }

  GV_EACH_MEMBER(GV_BOTH(origin) GV_BOTH(direction) GV_BOTH(moved))
};

struct Channels {
  ChannelView value, normal, other;
  int32_t side, border;
  int32_t component;  // of `value`
};

// A gradient that the CPU computed for many rays at once, before a shader asks for it.
template <class T>
struct PrefetchedGradient {
  T t;  // distance; NaN: none is known
  Vec3<T> gradient;
  bool requested;
};

template <class T>
struct Probe {
  using Number = T;
  const Channels& channels;
  const Sight<T>& sight;
  Spot<T> fine, coarse;
  bool mixed;
  T cone_near, cone_growth;  // cone
  T voxel, blend;            // weight of the coarse node: (cone - voxel) * blend
  Vec3<T> cube;              // world size of the root cube
#ifndef __CUDACC__
  PrefetchedGradient<T>* prefetched = nullptr;
#endif

  template <class Digits>
  GV_HD Probe(const Channels& channels, const Sight<T>& sight, const RayView& rays, const Ray<T>& ray,
              const Visit<T>& visit, const Digits& digits)
      : channels(channels),
        sight(sight),
        fine(visit.fine, digits, ray, channels.border),
        coarse(fine),
        mixed(visit.coarse.node != visit.fine.node),
        cone_near(ray.cone_near),
        cone_growth(ray.cone_growth),
        voxel(visit.voxel),
        blend(1 / (visit.voxel_above - visit.voxel)) {
    if (mixed) coarse = Spot<T>(visit.coarse, digits, ray, channels.border);
    for (int axis = 0; axis < 3; ++axis) cube[axis] = static_cast<T>(rays.place_33[3 + axis]);
  }

  // From all fields, which a packet's walk already has.
  GV_HD Probe(const Channels& channels, const Sight<T>& sight, const Spot<T>& fine, const Spot<T>& coarse, bool mixed,
              T cone_near, T cone_growth, T voxel, T blend, Vec3<T> cube)
      : channels(channels),
        sight(sight),
        fine(fine),
        coarse(coarse),
        mixed(mixed),
        cone_near(cone_near),
        cone_growth(cone_growth),
        voxel(voxel),
        blend(blend),
        cube(cube) {}

  // What shaders call to select lanes of a packet's probe (see shaders.h); here there is one ray.
  GV_HD void select_lanes(bool) const {}
  template <class Body>
  GV_HD void each_lane(bool mask, const Body& body) const {
    if (mask) body(0, *this);
  }

  // The shader's value at distance t.
  GV_HD T value(T t) const { return number_at(channels.value, channels.component, t); }
  // Calls body(value) with the fastest function value(t) that this visit allows for distances from `begin` to `end`.
  // Rounding keeps the order of positions along a ray, so it suffices to check both ends.
  template <class Body>
  GV_HD int32_t with_value(T, T, const Body& body) const {
    return body([this](T t) { return value(t); });
  }

  // A number of a channel at distance t.
  GV_HD T number_at(const ChannelView& channel, int32_t component, T t) const {
    const T number = read(channel, component, fine, fine.at(t));
    return mixed ? between(number, read(channel, component, coarse, coarse.at(t)), t) : number;
  }

  // Four consecutive numbers of a channel at distance t; the voxels around it are found once.
  template <bool kShadows = false>
  GV_HD Row<T> four_at(bool, const ChannelView& channel, int32_t first, T t) const {
    const Row<T> row = four_in<kShadows>(channel, first, fine, t);
    return mixed ? between(row, four_in<kShadows>(channel, first, coarse, t), t) : row;
  }

  // Several numbers of a channel at distance t, at most kMaxNumbers.
  GV_HD void numbers_at(const ChannelView& channel, Components<T> components, int32_t count, T t, T* out) const {
    read(channel, components, count, fine, t, out);
    if (!mixed) return;
    T coarse_numbers[kMaxNumbers];
    read(channel, components, count, coarse, t, coarse_numbers);
    const T coarse_weight = weight(t);
    for (int32_t i = 0; i < count; ++i) out[i] = out[i] + coarse_weight * (coarse_numbers[i] - out[i]);
  }

  // Gradient of the value at distance t, per world unit: differences over one voxel, half a voxel to each side, for
  // which a border of 1 suffices. Neighbours read the same voxels at the face they share, so no seam shows.
  GV_HD Vec3<T> gradient(T t) const {
#ifndef __CUDACC__
    if (prefetched != nullptr) {
      prefetched->requested = true;
      if (prefetched->t == t) return prefetched->gradient;
    }
#endif
    const Vec3<T> slope = differences(fine, t);
    return mixed ? between(slope, differences(coarse, t), t) : slope;
  }

  // For one of the two nodes, fine or coarse: the value, its gradient, four numbers of another channel in its brick,
  // and its scale. `weight` is that of the coarse node.
  GV_HD T value_of(const Spot<T>& spot, T t) const {
    return read(channels.value, channels.component, spot, spot.at(t));
  }
  GV_HD Vec3<T> differences(const Spot<T>& spot, T t) const {
    Vec3<T> slope{0, 0, 0};
    if (spot.brick < 0) return slope;
    GV_NO_UNROLL
    for (int axis = 0; axis < 3; ++axis) {
      slope[axis] = difference(
          spot, t, axis, [&](Vec3<T> position) { return read(channels.value, channels.component, spot, position); });
    }
    return slope;
  }
  template <bool kShadows = false>
  GV_HD Row<T> four_of(bool, const ChannelView& channel, int32_t component, const Spot<T>& spot, T t) const {
    const int64_t first = first_of(channel, component, spot);
    const Vec3<T> at = spot.at(t);
    return read_four<T, kShadows>(channel.bricks_bzyxc, channel.type, channel.width, first, channels.side, at.x, at.y,
                                  at.z);
  }
  GV_HD static T scale_of(const Spot<T>& spot) { return spot.scale; }
  // The value of one voxel of a brick; x, y and z count the border.
  GV_HD T value_in(const Spot<T>& spot, int32_t x, int32_t y, int32_t z) const {
    const ChannelView& channel = channels.value;
    const int64_t voxel = (static_cast<int64_t>(z) * channels.side + y) * channels.side + x;
    return read_number<T>(channel.bricks_bzyxc, channel.type,
                          first_of(channel, channels.component, spot) + voxel * channel.width);
  }
  GV_HD T weight(T t) const { return saturate((cone_near + cone_growth * t - voxel) * blend); }

  // Blends the two nodes' results at distance t, a number or several: the coarse one has `weight`.
  template <class Numbers>
  GV_HD Numbers between(const Numbers& finer, const Numbers& coarser, T t) const {
    const T coarse_weight = weight(t);
    return combined(finer, coarser, [&](T a, T b) { return a + coarse_weight * (b - a); });
  }

  // True if neither node has a brick and all numbers of both are equal: one value all over the visit.
  GV_HD bool uniform() const {
    if (fine.brick >= 0 || coarse.brick >= 0) return false;
    return !mixed || (same(channels.value) && same(channels.normal) && same(channels.other));
  }

 protected:
  // Central difference along an axis of the values read(at), per world unit.
  template <class Read>
  GV_HD T difference(const Spot<T>& spot, T t, int axis, const Read& read) const {
    Vec3<T> below = spot.at(t), above = below;
    below[axis] = below[axis] + static_cast<T>(-0.5);
    above[axis] = above[axis] + static_cast<T>(0.5);
    const T low = read(below), high = read(above);
    return (high - low) * (spot.scale / cube[axis]);
  }
  GV_HD int64_t first_of(const ChannelView& channel, int32_t component, const Spot<T>& spot) const {
    const int32_t numbers = channels.side * channels.side * channels.side * channel.width;  // they fit: check_bricks
    return static_cast<int64_t>(spot.brick) * numbers + component;
  }

 private:
  template <bool kShadows>
  GV_HD Row<T> four_in(const ChannelView& channel, int32_t first, const Spot<T>& spot, T t) const {
    if (spot.brick >= 0) return four_of<kShadows>(true, channel, first, spot, t);
    const auto read = [&](int32_t i) { return channel.constant<T>(spot.node, first + i); };
    return {read(0), read(1), read(2), read(3)};
  }
  GV_HD T read(const ChannelView& channel, int32_t component, const Spot<T>& spot, Vec3<T> position) const {
    if (spot.brick < 0) return channel.constant<T>(spot.node, component);
    const int64_t first = first_of(channel, component, spot);
    return read_brick(channel.bricks_bzyxc, channel.type, channel.width, first, channels.side, position.x, position.y,
                      position.z);
  }
  GV_HD void read(const ChannelView& channel, Components<T> components, int32_t count, const Spot<T>& spot, T t,
                  T* out) const {
    if (spot.brick >= 0) {
      const int64_t first = first_of(channel, 0, spot);
      const Vec3<T> at = spot.at(t);
      return read_numbers(channel.bricks_bzyxc, channel.type, components, count, first, channels.side, at.x, at.y, at.z,
                          out);
    }
    for (int32_t i = 0; i < count; ++i) out[i] = channel.constant<T>(spot.node, components[i]);
  }
  GV_HD bool same(const ChannelView& channel) const {
    if (!channel.exists()) return true;
    for (int32_t component = 0; component < channel.width; ++component) {
      if (channel.constant<T>(fine.node, component) != channel.constant<T>(coarse.node, component)) return false;
    }
    return true;
  }
};

// A probe whose value is of a dtype that the compiler knows, and whose reads are inlined.
template <class T, class Voxel>
struct TypedProbe : Probe<T> {
  using Probe<T>::Probe;

  GV_HD T value(T t) const {
    const T value = value_of(this->fine, t);
    return this->mixed ? this->between(value, value_of(this->coarse, t), t) : value;
  }
  GV_HD T value_of(const Spot<T>& spot, T t) const {
    const ChannelView& channel = this->channels.value;
    const auto* constants = static_cast<const Voxel*>(channel.constant_tnc);
    if (spot.brick >= 0) return trilinear(first_voxel(spot), this->channels.side, channel.width, spot.at(t));
    return number<T>(constants[static_cast<int64_t>(spot.node) * channel.width + this->channels.component]);
  }
  GV_HD Vec3<T> gradient(T t) const {
    const Vec3<T> slope = differences(this->fine, t);
    return this->mixed ? this->between(slope, differences(this->coarse, t), t) : slope;
  }
  GV_HD Vec3<T> differences(const Spot<T>& spot, T t) const {
    Vec3<T> slope{0, 0, 0};
    if (spot.brick < 0) return slope;
    const Voxel* voxels = first_voxel(spot);
    const int32_t side = this->channels.side, width = this->channels.value.width;
    for (int axis = 0; axis < 3; ++axis) {
      slope[axis] =
          this->difference(spot, t, axis, [&](Vec3<T> position) { return trilinear(voxels, side, width, position); });
    }
    return slope;
  }
  template <class Body>
  GV_HD int32_t with_value([[maybe_unused]] T begin, [[maybe_unused]] T end, const Body& body) const {
#ifdef __CUDA_ARCH__
    // The usual bricks, 8 and 16 voxels wide with a border of 1: eight addresses are one and seven constant offsets.
    const int32_t side = this->channels.side;
    const Spot<T>& spot = this->fine;
    if (!this->mixed && spot.brick >= 0 && this->channels.value.width == 1 &&
        EightVoxels<T>::is_inside(spot.at(begin), side) && EightVoxels<T>::is_inside(spot.at(end), side)) {
      const Voxel* voxels = first_voxel(spot);
      if (side == 10) return body([&](T t) { return trilinear(voxels, EightVoxels<T>(spot.at(t)), 10, 1); });
      if (side == 18) return body([&](T t) { return trilinear(voxels, EightVoxels<T>(spot.at(t)), 18, 1); });
    }
#endif
    return body([this](T t) { return value(t); });
  }

 private:
  GV_HD const Voxel* first_voxel(const Spot<T>& spot) const {
    const ChannelView& channel = this->channels.value;
    return static_cast<const Voxel*>(channel.bricks_bzyxc) + this->first_of(channel, this->channels.component, spot);
  }
};
template <class T, class Voxel>
using ProbeOf = std::conditional_t<std::is_void_v<Voxel>, Probe<T>, TypedProbe<T, Voxel>>;

}  // namespace gvtorch::GV_NAMESPACE
