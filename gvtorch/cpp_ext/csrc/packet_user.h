// The packet of a user's shader (user_shader.h): the walk and the values of all lanes at once, then the user's `add`,
// lane by lane, each with a Sum of its own. Each lane has every bit of its ray's.
#pragma once

#include <type_traits>

#include "packet_shade_rays.h"
#include "user_shader.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

template <class Kind>
struct UserPacket : ShadePacket<UserPacket<Kind>, Kind> {
  using Base = ShadePacket<UserPacket<Kind>, Kind>;
  using Sum = typename Kind::Sum;
  using Base::Base;
  using Base::sum;
  static constexpr bool kKeepsPath = HidesAlike<Kind>::value;  // one of the user's own may ask the ray's Sum
  // Values that are hidden change nothing, unless a Sum of the user's own counts them.
  static constexpr bool kLeavesOut = kHidesByTransfer<Kind> && std::is_same_v<Sum, ShadeSum<float>> && !Kind::kEnds;

  const PacketTable seen{static_cast<const UserShader<float>&>(this->shader).transfer};
  Sum sum_l[kLanes];
  int32_t asked = 0;  // lanes whose shader asked for a gradient at the last interval

  GV_HD void begin_run(Mask) {}
  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    if constexpr (kLeavesOut) seeing = seeing & ~seen.transparent(piece.value);
    // All lanes' gradients take about as long as those of two, one by one.
    const bool ahead = asked >= 2;
    Vec3<Floats> slope{};
    if (ahead) slope = this->gradient(seeing, piece.middle);
    asked = 0;
    for_lanes(seeing, [&](int lane) {
      KnownGradient<float> known{NAN, {}, false};
      if (ahead) known = {piece.middle[lane], {slope.x[lane], slope.y[lane], slope.z[lane]}, false};
      this->add_alone(lane, piece, &known);
      asked += known.asked ? 1 : 0;
    });
  }

  // The walk looks at what a ray lets through, and tells what it missed.
  GV_HD Sum& sum_of(int lane) {
    sum_l[lane].missed = sum.missed[lane] != 0;
    return sum_l[lane];
  }
  GV_HD void put_sum(int lane, const Sum& one) {
    sum.clear[lane] = one.clear;
    sum.missed[lane] = one.missed ? -1 : 0;
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
