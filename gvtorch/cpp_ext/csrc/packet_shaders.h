// What a packet does with the values of the fused shaders: twins of the structs of shaders.h. Each lane has every bit
// of its ray's.
#pragma once

#include "packet_shade_rays.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// Twin of `unit`.
GV_HD Vec3<Floats> unit(Vec3<Floats> v) {
  const Floats most = larger(larger(larger(v.x, -v.x), larger(v.y, -v.y)), larger(v.z, -v.z));
  const Mask turned = (most > 0.0f) & (most < INFINITY);
  const Vec3<Floats> scaled{v.x / most, v.y / most, v.z / most};
  const Floats length = square_root(dot(scaled, scaled));
  return {turned ? scaled.x / length : Floats{}, turned ? scaled.y / length : Floats{},
          turned ? scaled.z / length : Floats{}};
}

// Twin of Row.
struct PacketRow {
  Floats red, green, blue, alpha;
};

// Twin of Light, by the gradient's normals.
template <class Self, class Kind>
struct LightPacket : ShadePacket<Self, Kind> {
  using Base = ShadePacket<Self, Kind>;
  using Base::along;
  using Base::Base;
  using Base::sum;

  // Puts a row behind what the rays met before, lit where asked.
  GV_HD void composite(Mask shown, PacketRow row, const PacketPiece& piece, bool lit) {
    const Floats share = sum.clear * row.alpha;
    if (lit) {
      const Vec3<Floats> n = normal_at(shown, piece.middle);
      row = shade(row, n, piece.middle);
      for (int axis = 0; axis < 3; ++axis) {
        this->normal[axis] = shown ? this->normal[axis] + share * n[axis] : this->normal[axis];
      }
    }
    sum.red = shown ? sum.red + share * row.red : sum.red;
    sum.green = shown ? sum.green + share * row.green : sum.green;
    sum.blue = shown ? sum.blue + share * row.blue : sum.blue;
    sum.absorb(shown ? row.alpha : Floats{}, piece.start, this->at.length, this->hit_clear);
  }

 private:
  GV_HD Vec3<Floats> normal_at(Mask which, Floats t) {
    const Vec3<Floats> n = unit(this->gradient(which, t));
    const Mask away = dot(n, along) > 0.0f;
    return {away ? -n.x : n.x, away ? -n.y : n.y, away ? -n.z : n.z};
  }
  GV_HD PacketRow shade(PacketRow base, Vec3<Floats> n, Floats t) const {
    const float* parameters = this->kernel.parameter_54;
    const int32_t kind = static_cast<int32_t>(parameters[3]);
    const Vec3<Floats> d = along;
    Vec3<Floats> to_light{-d.x, -d.y, -d.z};
    if (kind == Light<float>::kDirectional) {
      for (int axis = 0; axis < 3; ++axis) to_light[axis] = -(Floats{} + parameters[axis]);
      to_light = unit(to_light);
    } else if (kind == Light<float>::kPoint) {
      const Floats far = t + this->moved;
      for (int axis = 0; axis < 3; ++axis) to_light[axis] = parameters[axis] - (this->from[axis] + far * d[axis]);
      to_light = unit(to_light);
    }
    const Mask faces = dot(n, n) > 0.0f;
    const Floats facing = faces ? larger(Floats{}, dot(n, to_light)) : Floats{} + 1.0f;
    const Vec3<Floats> half = unit(Vec3<Floats>{to_light.x - d.x, to_light.y - d.y, to_light.z - d.z});
    const Floats shine = larger(Floats{}, dot(n, half));
    const Mask shines = faces & (facing > 0.0f) & (shine > 1.1754944e-38f);
    const Floats highlight = shines ? exp2_exact(log2_exact(shine) * parameters[10]) : Floats{};
    const Floats diffuse = parameters[8] * facing;
    const Floats specular = parameters[9] * highlight;
    const float ambient = parameters[7];
    return {base.red * (ambient + diffuse * parameters[4]) + specular * parameters[4],
            base.green * (ambient + diffuse * parameters[5]) + specular * parameters[5],
            base.blue * (ambient + diffuse * parameters[6]) + specular * parameters[6], base.alpha};
  }
};

struct LitPacket : LightPacket<LitPacket, Lit<float>> {
  using LightPacket::LightPacket;

  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    const PacketCell cell = table.find(piece.value);
    const Ints entry = rows + cell.row * PacketTable::kBytes;
    const Floats alpha = table.column(entry, PacketTable::kAlpha, cell.weight);
    const Mask shown = seeing & (alpha > 0.0f);
    if (!any(shown)) return;
    if (kernel.channels.normal.given()) {
      for_lanes(shown, [&](int lane) { add_alone(lane, piece); });
      return;
    }
    const Floats red = table.column(entry, 0, cell.weight);
    const Floats green = table.column(entry, 1, cell.weight);
    const Floats blue = table.column(entry, 2, cell.weight);
    composite(shown, {red, green, blue, alpha}, piece, true);
  }
};

struct StoredColorPacket : LightPacket<StoredColorPacket, StoredColor<float>> {
  const PacketChannel red, green, blue;

  StoredColorPacket(const ShadeRay<float, Shader>& kernel, const ShadeArgs& args)
      : LightPacket(kernel, args),
        red(kernel.channels.value, args.side, 0, args.bricks),
        green(kernel.channels.value, args.side, 1, args.bricks),
        blue(kernel.channels.value, args.side, 2, args.bricks) {}

  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    const float* parameters = shader.light.parameter_54;
    const Floats opacity = clamp(piece.value * parameters[12], Floats{}, Floats{} + 1.0f);
    const Mask shown = seeing & (opacity > 0.0f);
    if (!any(shown)) return;
    const bool lit = parameters[15] > 0;
    const Mask read = lit && kernel.channels.normal.given() ? Mask{} : shown & stored();
    for_lanes(shown & ~read, [&](int lane) { add_alone(lane, piece); });
    if (!any(read)) return;
    const auto number = [&](const PacketChannel& channel) {
      const Floats scaled = number_at(channel, read, piece.middle) * parameters[12];
      return parameters[14] > 0 ? scaled / opacity : scaled;
    };
    const PacketRow row{number(red), number(green), number(blue), stretch(opacity, at.length / parameters[13])};
    composite(read, row, piece, lit);
  }
};

struct PreIntegratedPacket : ShadePacket<PreIntegratedPacket, PreIntegrated<float>> {
  using ShadePacket::ShadePacket;

  GV_HD void begin_run(Mask which) { rows = which ? at.level * (table.rows * table.rows * PacketTable::kBytes) : rows; }
  // Values that leave the function's domain within an interval are rare.
  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    const Floats low = Floats{} + shader.transfer.domain_2[0], high = Floats{} + shader.transfer.domain_2[1];
    const Floats front = clamp(piece.front, low, high), back = clamp(piece.back, low, high);
    const Mask within = (front == back) | ((front == piece.front) & (back == piece.back));
    const PacketCell before = table.find(front), behind = table.find(back);
    const Ints entry = rows + (before.row * table.rows + behind.row) * PacketTable::kBytes;
    const auto column = [&](int32_t which) {
      const Floats near = table.column(entry, which, behind.weight);
      const Floats far = table.column(entry + table.rows * PacketTable::kBytes, which, behind.weight);
      return near + before.weight * (far - near);
    };
    const Floats alpha = seeing & within ? column(PacketTable::kAlpha) : Floats{};
    if (any(alpha > 0.0f)) {  // colours are premultiplied
      const Floats clear = alpha > 0.0f ? sum.clear : Floats{};
      sum.red = sum.red + clear * column(0);
      sum.green = sum.green + clear * column(1);
      sum.blue = sum.blue + clear * column(2);
      sum.absorb(alpha, piece.start, at.length, hit_clear);
    }
    for_lanes(seeing & ~within, [&](int lane) { add_alone(lane, piece); });
  }
};

struct IsosurfacePacket : ShadePacket<IsosurfacePacket, Isosurface<float>> {
  using ShadePacket::ShadePacket;
  Floats before{}, before_end{}, share{};

  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    const float level = shader.light.parameter_54[12];
    const Mask below = piece.front < level;
    const Mask parted = (before_end == piece.start) & ((before < level) ^ below);
    const Mask hit = seeing & (parted | (below ^ (piece.back < level)));
    for_lanes(hit, [&](int lane) { add_alone(lane, piece); });
    const Mask passed = seeing & ~hit;
    before = passed ? piece.back : before;
    before_end = passed ? piece.end : before_end;
  }
  GV_HD void get(int lane, Sum& one) const {
    one.before = before[lane];
    one.before_end = before_end[lane];
    one.share = share[lane];
  }
  GV_HD void put(int lane, const Sum& one) {
    before[lane] = one.before;
    before_end[lane] = one.before_end;
    share[lane] = one.share;
  }
};

struct ProjectionPacket : ShadePacket<ProjectionPacket, Projection<float>> {
  using ShadePacket::ShadePacket;
  static constexpr bool kKeepsPath = false;  // what is hidden depends on what was found
  Floats found{}, length{}, place{};

  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    const int32_t which = shader.kind();
    const Mask first = ~(length > 0.0f);
    if (which == Projection<float>::kMean) {
      place = seeing & first ? piece.start : place;
      found = seeing ? found + piece.value * at.length : found;
    } else {
      const Mask beyond = which == Projection<float>::kMaximum ? piece.value > found : piece.value < found;
      const Mask better = seeing & (first | beyond);
      found = better ? piece.value : found;
      place = better ? piece.middle : place;
    }
    length = seeing ? length + at.length : length;
  }
  GV_HD void get(int lane, Sum& one) const {
    one.found = found[lane];
    one.length = length[lane];
    one.at = place[lane];
  }
  GV_HD void put(int lane, const Sum& one) {
    found[lane] = one.found;
    length[lane] = one.length;
    place[lane] = one.at;
  }
};

struct FeaturesPacket : ShadePacket<FeaturesPacket, Features<float>> {
  using ShadePacket::ShadePacket;

  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    const PacketCell cell = table.find(piece.value);
    const Ints entry = rows + cell.row * PacketTable::kBytes;
    const Mask shown = seeing & (table.column(entry, PacketTable::kAlpha, cell.weight) > 0.0f);
    for_lanes(shown, [&](int lane) { add_alone(lane, piece); });
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
