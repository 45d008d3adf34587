// Samples of one ray inside one brick, kLanes at a time: their places, voxels, values and rows of the transfer function
// side by side, then compositing in order. Each lane does what OneByOne does, so every bit is the same.
//
// Vectors are the compiler's (GCC and Clang "vector extensions"): as wide as the instruction set that this file is
// compiled for. Only loads from many addresses are written for each.
#pragma once

#if defined(__AVX2__)
#include <immintrin.h>
#endif

#include "trace.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif
typedef float Floats __attribute__((vector_size(kLanes * 4)));
typedef int32_t Ints __attribute__((vector_size(kLanes * 4)));
typedef float Quad __attribute__((vector_size(16)));

GV_HD Floats to_floats(Ints value) { return __builtin_convertvector(value, Floats); }
GV_HD Ints truncated(Floats value) { return __builtin_convertvector(value, Ints); }

GV_HD Floats clamp(Floats value, float low, float high) {
  const Floats lowest = Floats{} + low;
  const Floats highest = Floats{} + high;
  const Floats raised = value > lowest ? value : lowest;
  return raised < highest ? raised : highest;
}
GV_HD Ints smaller(Ints a, int32_t b) {
  const Ints most = Ints{} + b;
  return most < a ? most : a;
}

// 4 bytes at each address base + offset.
GV_HD Ints gather(const void* base, Ints offset) {
#if defined(__AVX512F__)
  return (Ints)_mm512_i32gather_epi32((__m512i)offset, base, 1);
#elif defined(__AVX2__)
  return (Ints)_mm256_i32gather_epi32(static_cast<const int*>(base), (__m256i)offset, 1);
#else
  Ints word;
  for (int lane = 0; lane < kLanes; ++lane) {
    int32_t one;
    memcpy(&one, static_cast<const char*>(base) + offset[lane], 4);
    word[lane] = one;
  }
  return word;
#endif
}

// The voxel in the low bytes of each word, as a number.
template <class Voxel>
struct Unpack;
template <>
struct Unpack<uint8_t> {
  GV_HD static Floats low(Ints word) { return to_floats(word & 0xff); }
};
template <>
struct Unpack<int8_t> {
  GV_HD static Floats low(Ints word) { return to_floats((word << 24) >> 24); }
};
template <>
struct Unpack<uint16_t> {
  GV_HD static Floats low(Ints word) { return to_floats(word & 0xffff); }
};
template <>
struct Unpack<int16_t> {
  GV_HD static Floats low(Ints word) { return to_floats((word << 16) >> 16); }
};
template <>
struct Unpack<BFloat16> {
  GV_HD static Floats low(Ints word) { return (Floats)(word << 16); }
};
template <>
struct Unpack<Half> {
  GV_HD static Floats low(Ints word) {
    const Ints magnitude = (word & 0x7fff) << 13;
    const Floats scaled = (Floats)magnitude * 5.192296858534828e33f;  // see `number` in hd.h
    const Ints bits = magnitude < (0x7c00 << 13) ? (Ints)scaled : magnitude | 0x7f800000;
    return (Floats)(bits | ((word & 0x8000) << 16));
  }
};
template <>
struct Unpack<float> {
  GV_HD static Floats low(Ints word) { return (Floats)word; }
};

// Two neighbours along x, blended. One load serves both where they lie in 4 bytes.
template <class Voxel>
GV_HD Floats sample_row(const Voxel* voxels, Ints offset, int32_t channels, Floats weight) {
  constexpr int32_t kBytes = sizeof(Voxel);
  const Ints word = gather(voxels, offset);
  Ints next;
  if (kBytes <= 2 && channels == 1) {
    next = (word >> (8 * kBytes % 32)) & ((1 << (8 * kBytes % 32)) - 1);
  } else {
    next = gather(voxels, offset + channels * kBytes);
  }
  const Floats left = Unpack<Voxel>::low(word);
  const Floats right = Unpack<Voxel>::low(next);
  return left + weight * (right - left);
}

template <class Voxel>
GV_HD Floats sample_lanes(const BrickView<Voxel>& view, const BrickRay<float, Voxel>& ray, Floats t) {
  if (ray.voxels == nullptr) return Floats{} + ray.constant;
  Ints cell[3];
  Floats weight[3];
  for (int axis = 0; axis < 3; ++axis) {
    const Floats place = clamp(ray.offset[axis] + t * ray.slope[axis], 0.0f, static_cast<float>(view.side - 1));
    cell[axis] = smaller(truncated(place), view.side - 2);
    weight[axis] = place - to_floats(cell[axis]);
  }
  const int32_t step_x = view.channels * static_cast<int32_t>(sizeof(Voxel));
  const int32_t step_y = step_x * view.side;
  const int32_t step_z = step_y * view.side;
  const Ints corner = cell[2] * step_z + cell[1] * step_y + cell[0] * step_x;
  Floats plane[2];
  for (int z = 0; z < 2; ++z) {
    const Ints start = corner + z * step_z;
    const Floats near = sample_row(ray.voxels, start, view.channels, weight[0]);
    const Floats far = sample_row(ray.voxels, start + step_y, view.channels, weight[0]);
    plane[z] = near + weight[1] * (far - near);
  }
  return plane[0] + weight[2] * (plane[1] - plane[0]);
}

GV_HD Quad blend_rows(const Row<float>* row, float weight) {
  Quad a, b;
  memcpy(&a, row, sizeof(a));
  memcpy(&b, row + 1, sizeof(b));
  return a + weight * (b - a);
}

struct Lanes {
  template <class Voxel>
  GV_HD static int32_t march(const BrickView<Voxel>& bricks, const Transfer<float>& transfer,
                             const Run<float, Voxel>& run, const Intervals<float>& at, int32_t count,
                             Accumulator<float>& sum) {
    // A load of 4 bytes may reach behind its voxel: never behind the pool.
    if (run.fine.last || run.coarse.last || count == 1) {
      return OneByOne::march(bricks, transfer, run, at, count, sum);
    }
    Ints lane;
    for (int i = 0; i < kLanes; ++i) lane[i] = i;
    const Row<float>* rows_m = transfer.table_lm + static_cast<int64_t>(at.level) * transfer.rows;
    Quad color{sum.red, sum.green, sum.blue, 0};
    float clear = sum.clear;
    int32_t taken = 0;
    for (; taken < count; taken += kLanes) {
      const Floats number = to_floats(lane + taken) + at.count;
      const Floats t = at.base + (number + 0.5f) * at.length;
      Floats value = sample_lanes(bricks, run.fine, t);
      if (run.mixed) {
        const Floats weight = clamp((at.near + at.growth * t - run.voxel) * run.blend, 0.0f, 1.0f);
        value = value + weight * (sample_lanes(bricks, run.coarse, t) - value);
      }
      const Floats place = clamp((value - transfer.low) * transfer.scale, 0.0f, transfer.last);
      const Ints cell = smaller(truncated(place), transfer.rows - 2);
      alignas(64) int32_t rows[kLanes];
      alignas(64) float weights[kLanes];
      memcpy(rows, &cell, sizeof(cell));
      const Floats weight = place - to_floats(cell);
      memcpy(weights, &weight, sizeof(weight));

      // Four at a time without a look at the sum; where the ray ended or its depth was passed, once more with care.
      const int32_t here = count - taken < kLanes ? count - taken : kLanes;
      for (int32_t i = 0; i < here; i += 4) {
        const int32_t some = here - i < 4 ? here - i : 4;
        const Quad before = color;
        const float clear_before = clear;
        for (int32_t j = 0; j < 4; ++j) {
          const Quad row = blend_rows(rows_m + rows[i + j], weights[i + j]);
          const float alpha = j < some ? row[3] : 0.0f;
          color = color + clear * alpha * row;
          clear = clear * (1.0f - alpha);
        }
        if (clear > run.stop_clear && (clear >= run.hit_clear || clear_before < run.hit_clear)) continue;
        store(before, clear_before, sum);
        for (int32_t j = 0; j < some; ++j) {
          const Row<float> row = transfer.look_up({rows[i + j], weights[i + j]}, at.level);
          sum.add(row, at.start_of(at.count + static_cast<float>(taken + i + j)), at.length, run.hit_clear);
          if (!(sum.clear > run.stop_clear)) return taken + i + j + 1;
        }
        color = Quad{sum.red, sum.green, sum.blue, 0};
        clear = sum.clear;
      }
    }
    store(color, clear, sum);
    return count;
  }
  GV_HD static void store(Quad color, float clear, Accumulator<float>& sum) {
    sum.red = color[0];
    sum.green = color[1];
    sum.blue = color[2];
    sum.clear = clear;
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
