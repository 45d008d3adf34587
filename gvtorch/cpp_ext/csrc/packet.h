// The packet of the plain transfer function: the twin of TraceRay, equal to it in every bit.
#pragma once

#include "packet_walk.h"
#include "trace.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

// kFar: offsets in the pool need 64 bits.
template <class Voxel, bool kFar>
struct TracePacket : PacketWalk<TracePacket<Voxel, kFar>> {
  using Base = PacketWalk<TracePacket<Voxel, kFar>>;
  using Base::at;
  using Base::coarse;
  using Base::fine;
  using Base::hit_clear;
  using Base::sum;
  static constexpr bool kEnds = false, kSeesEmpty = false, kKeepsPath = true;

  const TraceRay<float, Voxel>& kernel;
  const PacketPool pool;
  const PacketTable table;
  Ints rows{};  // byte offset of the level's table

  TracePacket(const TraceRay<float, Voxel>& kernel, const PacketPool& pool, const TraceArgs& args)
      : Base(kernel, args), kernel(kernel), pool(pool), table(kernel.transfer) {}

  GV_HD void begin_ray(int) {}
  GV_HD void end_ray(int lane) const {
    kernel.store(this->numbers[lane], sum.at(lane), this->moved[lane], this->samples[lane]);
  }
  GV_HD bool hides(int, int32_t node) const { return kernel.hides(table, node); }
  GV_HD Ints first_of(Ints brick) const { return kFar ? brick : brick * static_cast<int32_t>(pool.stride); }
  GV_HD Floats read(Ints brick, const Vec3<Floats>& at) const { return trilinear<Voxel, kFar>(pool, brick, at); }
  GV_HD float constant(int32_t node) const {
    const BrickView<Voxel>& view = kernel.bricks;
    return number<float>(view.constant_tnc[static_cast<int64_t>(node) * view.channels + view.component]);
  }
  GV_HD Mask uniform(Mask) const { return fine.constant == coarse.constant; }
  GV_HD bool shades_each_place() const { return false; }

  GV_HD void begin_run(Mask which) { rows = which ? at.level * (table.rows * PacketTable::kBytes) : rows; }
  GV_HD void add(Mask seeing, const PacketPiece& piece) {
    const PacketCell cell = table.find(piece.value);
    const Ints entry = rows + cell.row * PacketTable::kBytes;
    const Floats alpha = seeing ? table.column(entry, PacketTable::kAlpha, cell.weight) : Floats{};
    if (!any(alpha > 0.0f)) return;
    const Floats share = sum.clear * alpha;
    sum.red = sum.red + share * table.column(entry, 0, cell.weight);
    sum.green = sum.green + share * table.column(entry, 1, cell.weight);
    sum.blue = sum.blue + share * table.column(entry, 2, cell.weight);
    sum.absorb(alpha, piece.start, at.length, hit_clear);
  }
  GV_HD void add_region(int lane, float start, float end) {
    Accumulator<float> one = sum.at(lane);
    kernel.add_piece(table, run_of(lane), fine.constant[lane], start, end, one);
    sum.put(lane, one);
  }
  GV_HD int32_t march_node(int lane, const Visit<float>& visit, Intervals<float>& at) {
    Accumulator<float> one = sum.at(lane);
    const int32_t taken = kernel.march_node(table, run_of(lane), visit, at, one);
    sum.put(lane, one);
    return taken;
  }

 private:
  GV_HD BrickRay<float, Voxel> brick_of(const PacketBrick& ray, int lane) const {
    BrickRay<float, Voxel> one;
    one.constant = ray.constant[lane];
    if (!ray.stored[lane]) return one;
    one.voxels = static_cast<const Voxel*>(pool.first) + ray.brick[lane] * (kFar ? pool.stride : 1) / sizeof(Voxel);
    for (int axis = 0; axis < 3; ++axis) {
      one.offset[axis] = ray.offset[axis][lane];
      one.slope[axis] = ray.slope[axis][lane];
    }
    return one;
  }
  GV_HD Run<float, Voxel> run_of(int lane) const {
    return {brick_of(fine, lane),
            brick_of(coarse, lane),
            this->mixed[lane] != 0,
            this->voxel[lane],
            this->blend_scale[lane],
            this->stop_clear,
            hit_clear};
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
