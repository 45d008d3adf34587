// Segments: the runs of intervals that rays take in the nodes they visit, for module shaders, which are not part of a
// kernel. Rays are walked as in shade_rays.h (the same visits, marks and intervals), but nothing is shaded: what a
// sample needs is stored. SampleBricks then reads any channel at any sample, equal to the renderer in every bit;
// CompositeRay composites.
//
// A segment is all the whole intervals of one visit that have one length and one base, or one piece of any length: the
// last interval of a ray, cut at the far side, or a region of one value. Lists have exact sizes: rays are walked twice,
// to count and to write. A ray may be walked in parts of `limit` samples and at least one visit, from `state_r3` on.
#pragma once

#include "shaders/shade_rays.h"
#include "walk/brick.h"

namespace gvtorch {
inline namespace GV_NAMESPACE {

constexpr int32_t kPiece = -1;  // level of a piece

template <class T>
struct Segment {
  Holder fine, coarse;
  int32_t wanted = 0;            // depth that the cone asked for
  int32_t first = 0, count = 0;  // number of the first interval, counted from base; how many intervals
  int32_t level = kPiece;        // intervals are step * 2^level long, or kPiece
  // Distances from where the ray enters the scene; lookup_t: where the nodes were looked up.
  T base = 0, start = 0, end = 0, lookup_t = 0;
};

template <class T>
struct SegmentView {
  int32_t *ray_s, *node_s2, *brick_s2, *depth_s3, *interval_s3;
  T *t0_s, *t1_s, *distance_s3;

  GV_HD void write(int64_t row, int64_t ray, const Segment<T>& segment, T moved) const {
    ray_s[row] = static_cast<int32_t>(ray);
    node_s2[2 * row] = segment.fine.node;
    node_s2[2 * row + 1] = segment.coarse.node;
    brick_s2[2 * row] = segment.fine.brick;
    brick_s2[2 * row + 1] = segment.coarse.brick;
    depth_s3[3 * row] = segment.fine.depth;
    depth_s3[3 * row + 1] = segment.coarse.depth;
    depth_s3[3 * row + 2] = segment.wanted;
    interval_s3[3 * row] = segment.first;
    interval_s3[3 * row + 1] = segment.count;
    interval_s3[3 * row + 2] = segment.level;
    t0_s[row] = segment.start + moved;
    t1_s[row] = segment.end + moved;
    distance_s3[3 * row] = segment.base;
    distance_s3[3 * row + 1] = segment.end;
    distance_s3[3 * row + 2] = segment.lookup_t;
  }
};

// Walks a ray, and calls emit(segment) for what it samples.
template <class T, class Digits>
struct WalkRay {
  ShadeRay<T, Plain<T>, Digits> kernel;
  const T* state_r3;  // base, count and level from which each ray continues; null: rays begin
  int32_t limit;      // a ray pauses after the visit in which it reaches this many samples; 0: it goes to its end
  bool by_node;       // a visit of two nodes is never a region, even where their constants are equal

  GV_HD Intervals<T> begin(const Ray<T>& ray, int64_t number) const {
    Intervals<T> intervals(ray, kernel.options.step, kernel.lengths);
    if (state_r3 == nullptr) return intervals;
    intervals.base = state_r3[3 * number];
    intervals.count = state_r3[3 * number + 1];
    intervals.level =
        static_cast<int32_t>(clamp(state_r3[3 * number + 2], static_cast<T>(0), static_cast<T>(intervals.top)));
    intervals.length = intervals.step;
    for (int32_t level = 0; level < intervals.level; ++level) intervals.length = intervals.length + intervals.length;
    intervals.inverse_length = 1 / intervals.length;
    intervals.start = intervals.start_of(intervals.count);
    return intervals;
  }

  // See Walk::follow.
  template <class Emit>
  struct Visitor {
    static constexpr bool kSeesEmpty = false;
    const WalkRay& walk;
    Emit& emit;
    int32_t segments = 0, samples = 0, visits = 0;
    bool missing = false;

    GV_HD bool& missed() { return missing; }
    GV_HD bool sees() const { return true; }
    GV_HD bool goes_on() {
      if (walk.limit != 0 && samples >= walk.limit) return false;
      ++visits;
      return true;
    }
    GV_HD NodeWords node_words(int32_t node) const { return walk.kernel.node_words(node); }
    GV_HD Segment<T> enter(const Ray<T>&, const Visit<T>& visit, const Digits&) const {
      Segment<T> segment;
      segment.fine = visit.fine;
      segment.coarse = visit.coarse;
      segment.wanted = visit.wanted;
      segment.lookup_t = visit.lookup_t;
      return segment;
    }
    GV_HD bool uniform(const Segment<T>& segment) const {
      const Holder &fine = segment.fine, &coarse = segment.coarse;
      if (fine.brick >= 0 || coarse.brick >= 0) return false;
      return walk.by_node ? fine.node == coarse.node : walk.constant(fine) == walk.constant(coarse);
    }
    GV_HD void region(Segment<T>& segment, T start, T end) {
      segment.base = segment.start = start;
      segment.end = end;
      segment.first = 0;
      segment.count = 1;
      segment.level = kPiece;
      finish(segment);
    }
    GV_HD int32_t take_intervals(Segment<T>& segment, const Intervals<T>& intervals, int32_t run_length, bool last) {
      if (last || intervals.base != segment.base || intervals.level != segment.level) finish(segment);
      if (last) {
        region(segment, intervals.start, intervals.stop);
        return 1;
      }
      if (segment.count == 0) {
        segment.base = intervals.base;
        segment.start = intervals.start;
        segment.first = static_cast<int32_t>(intervals.count);
        segment.level = intervals.level;
      }
      segment.count += run_length;
      segment.end = intervals.start_of(intervals.count + static_cast<T>(run_length));
      return run_length;
    }
    // Emits the complete segment; another may begin.
    GV_HD void finish(Segment<T>& segment) {
      if (segment.count == 0) return;
      emit(segment);
      ++segments;
      samples += segment.count;
      segment.count = 0;
    }
  };

  template <class Emit>
  GV_HD Visitor<Emit> walk(const Ray<T>& ray, Intervals<T>& intervals, Emit& emit) const {
    Visitor<Emit> visitor{*this, emit};
    kernel.template follow<Digits>(ray, intervals, visitor);
    return visitor;
  }

  GV_HD T constant(const Holder& holder) const {
    return kernel.channels.value.template constant<T>(holder.node, kernel.channels.component);
  }
};

template <class T, class Walk>
struct CountSegments {
  Walk walk;
  int32_t* count_r3;  // segments, samples, visits
  T* state_r3;
  bool* missed_r;

  GV_HD void operator()(int64_t index) const {
    const int64_t ray_number = walk.kernel.order(index);
    if (ray_number < 0) return;
    const Ray<T> ray(walk.kernel.rays, ray_number);
    Intervals<T> intervals = walk.begin(ray, ray_number);
    const auto ignore = [](const Segment<T>&) {};
    const auto walked = walk.walk(ray, intervals, ignore);
    count_r3[3 * ray_number] = walked.segments;
    count_r3[3 * ray_number + 1] = walked.samples;
    count_r3[3 * ray_number + 2] = walked.visits;
    state_r3[3 * ray_number] = intervals.base;
    state_r3[3 * ray_number + 1] = intervals.count;
    state_r3[3 * ray_number + 2] = static_cast<T>(intervals.level);
    missed_r[ray_number] = walked.missing;
  }
};

template <class T, class Walk>
struct WriteSegments {
  Walk walk;
  const int64_t* first_r;  // where each ray's segments begin
  int64_t total;
  SegmentView<T> out;

  GV_HD void operator()(int64_t index) const {
    const int64_t ray_number = walk.kernel.order(index);
    if (ray_number < 0) return;
    const Ray<T> ray(walk.kernel.rays, ray_number);
    Intervals<T> intervals = walk.begin(ray, ray_number);
    int64_t row = first_r[ray_number];
    const auto write = [&](const Segment<T>& segment) {
      if (row >= 0 && row < total) out.write(row, ray_number, segment, ray.moved);
      ++row;
    };
    walk.walk(ray, intervals, write);
  }
};

// A channel whose dtype the compiler knows.
template <class Voxel>
struct BrickView {
  const Voxel *bricks_bzyxc, *constant_tnc;
  int32_t side, border, channels;

  GV_HD int64_t first_number(int32_t brick) const {
    return static_cast<int64_t>(brick) * side * side * side * channels;
  }
};

// Finds what a sample of a segment reads: the bricks (or constants) of two nodes, and the weight of the coarse one.
template <class T, class Voxel>
struct FindSample {
  RayView rays;
  TreeView tree;  // only its shape
  Levels<T> levels;
  BrickView<Voxel> bricks;
  SegmentView<T> segments;  // read only
  const int32_t *segment_k, *number_k;
  int64_t ray_count, segment_count, node_count, brick_count;
  T step;

  struct SampleSource {
    Spot<T> fine, coarse;
    T t, weight;
    bool valid = false;  // everything the segment refers to exists
  };

  GV_HD SampleSource operator()(int64_t k) const {
    SampleSource source;
    const int64_t segment = segment_k[k];
    if (segment < 0 || segment >= segment_count) return source;
    const int32_t wanted = segments.depth_s3[3 * segment + 2];
    const int64_t ray_number = segments.ray_s[segment];
    Holder holders[2];
    for (int i = 0; i < 2; ++i) {
      Holder& holder = holders[i];
      holder = {segments.node_s2[2 * segment + i], segments.brick_s2[2 * segment + i],
                segments.depth_s3[3 * segment + i]};
      if (holder.node < 0 || holder.node >= node_count || holder.brick >= brick_count || holder.depth < 0 ||
          holder.depth > tree.max_depth)
        return source;
    }
    if (ray_number < 0 || ray_number >= ray_count || wanted < 0 || wanted > tree.max_depth) return source;
    source.valid = true;
    const Ray<T> ray(rays, ray_number);
    const Digits<T> digits(tree, levels, rays, ray, segments.distance_s3[3 * segment + 2]);
    source.fine = source.coarse = Spot<T>(holders[0], digits, ray, bricks.border);
    source.t = middle_of(segment, number_k[k]);
    source.weight = 0;
    if (holders[1].node != holders[0].node) {
      source.coarse = Spot<T>(holders[1], digits, ray, bricks.border);
      const T voxel = levels.voxel[wanted];
      const T blend = 1 / ((wanted > 0 ? levels.voxel[wanted - 1] : static_cast<T>(INFINITY)) - voxel);
      const T cone = ray.cone_near + ray.cone_growth * source.t;
      source.weight = clamp((cone - voxel) * blend, static_cast<T>(0), static_cast<T>(1));
    }
    return source;
  }
  // Distance of the middle of a segment's interval.
  GV_HD T middle_of(int64_t segment, int32_t number) const {
    const int32_t level = segments.interval_s3[3 * segment + 2];
    const T base = segments.distance_s3[3 * segment];
    const T end = segments.distance_s3[3 * segment + 1];
    if (level < 0) return base + (end - base) * static_cast<T>(0.5);
    T length = step;
    for (int32_t power = 0; power < smaller(level, kMaxLevels); ++power) length = length + length;
    const int32_t count = segments.interval_s3[3 * segment] + number;
    return base + (static_cast<T>(count) + static_cast<T>(0.5)) * length;
  }
};

template <class T, class Voxel>
struct SampleBricks {
  FindSample<T, Voxel> find_sample;
  T* value_kc;

  GV_HD void operator()(int64_t k) const {
    const auto source = find_sample(k);
    const BrickView<Voxel>& bricks = find_sample.bricks;
    const bool mixed = source.coarse.node != source.fine.node;
    for (int32_t channel = 0; channel < bricks.channels; ++channel) {
      T value = 0;
      if (source.valid) {
        value = read(source.fine, source.t, channel);
        if (mixed) value = value + source.weight * (read(source.coarse, source.t, channel) - value);
      }
      value_kc[k * bricks.channels + channel] = value;
    }
  }
  GV_HD T read(const Spot<T>& spot, T t, int32_t channel) const {
    const BrickView<Voxel>& bricks = find_sample.bricks;
    if (spot.brick < 0)
      return number<T>(bricks.constant_tnc[static_cast<int64_t>(spot.node) * bricks.channels + channel]);
    const Voxel* voxels = bricks.bricks_bzyxc + bricks.first_number(spot.brick) + channel;
    return trilinear(voxels, bricks.side, bricks.channels, spot.at(t));
  }
};

// The gradient of SampleBricks: each sample adds to the voxels (or constants) it was made of.
template <class T, class Voxel>
struct SpreadGradient {
  FindSample<T, Voxel> find_sample;
  const T* grad_kc;
  T *grad_bzyxc, *grad_tnc;

  GV_HD void operator()(int64_t k) const {
    const auto source = find_sample(k);
    if (!source.valid) return;
    spread(source.fine, source.t, k, 1 - source.weight);
    if (source.coarse.node != source.fine.node) spread(source.coarse, source.t, k, source.weight);
  }
  GV_HD void spread(const Spot<T>& spot, T t, int64_t k, T share) const {
    const BrickView<Voxel>& bricks = find_sample.bricks;
    const T* grad_c = grad_kc + k * bricks.channels;
    if (spot.brick < 0) {
      T* constant = grad_tnc + static_cast<int64_t>(spot.node) * bricks.channels;
      for (int32_t channel = 0; channel < bricks.channels; ++channel)
        add_to(constant + channel, share * grad_c[channel]);
      return;
    }
    const EightVoxels<T> corners(spot.at(t), bricks.side);
    const auto& weight = corners.weight;
    T* first = grad_bzyxc + bricks.first_number(spot.brick);
    for (int i = 0; i < 8; ++i) {
      const int dx = i & 1, dy = i >> 1 & 1, dz = i >> 2;
      const T corner_share = share * (dx ? weight[0] : 1 - weight[0]) * (dy ? weight[1] : 1 - weight[1]) *
                             (dz ? weight[2] : 1 - weight[2]);
      const int64_t z = corners.cell[2] + dz, y = corners.cell[1] + dy, x = corners.cell[0] + dx;
      T* voxel_c = first + ((z * bricks.side + y) * bricks.side + x) * bricks.channels;
      for (int32_t channel = 0; channel < bricks.channels; ++channel) {
        add_to(voxel_c + channel, corner_share * grad_c[channel]);
      }
    }
  }
};

// Packed samples of rays: those of a ray are consecutive, from front to back.
struct PackedView {
  const int64_t* offset_r;  // (r + 1,)
  int64_t count;
  int32_t channels;

  GV_HD int64_t begin(int64_t ray) const { return clamp<int64_t>(offset_r[ray], 0, count); }
  GV_HD int64_t end(int64_t ray) const { return clamp<int64_t>(offset_r[ray + 1], 0, count); }
};

// Front to back: sum of clear * alpha * feature, where clear is the transmittance of the samples in front. A ray ends
// where at most `stop_clear` of it is left; samples behind have a `before` of 0. stop_clear 0: all samples count.
template <class T>
struct CompositeRay {
  PackedView packed;
  const T *alpha_k, *feature_kc, *clear_r;
  T stop_clear;
  T *sum_rc, *left_r, *before_k;

  GV_HD void operator()(int64_t ray) const {
    T clear = clear_r[ray];
    T* sum_c = sum_rc + ray * packed.channels;
    for (int32_t channel = 0; channel < packed.channels; ++channel) sum_c[channel] = 0;
    for (int64_t k = packed.begin(ray); k < packed.end(ray); ++k) {
      const bool ended = stop_clear > 0 && !(clear > stop_clear);
      before_k[k] = ended ? 0 : clear;
      if (ended) continue;
      const T share = clear * alpha_k[k];
      for (int32_t channel = 0; channel < packed.channels; ++channel) {
        sum_c[channel] = sum_c[channel] + share * feature_kc[k * packed.channels + channel];
      }
      clear = clear * (1 - alpha_k[k]);
    }
    left_r[ray] = clear;
  }
};

// The gradient of CompositeRay, from back to front. With S the sum and L the light left of the samples behind one, per
// unit of light that enters, the sample makes them S' = alpha f + (1 - alpha) S, L' = (1 - alpha) L. No division, so an
// alpha of 1 is no special case.
template <class T>
struct CompositeGradient {
  PackedView packed;
  const T *alpha_k, *feature_kc, *before_k, *grad_sum_rc, *grad_left_r;
  T stop_clear;
  T *grad_alpha_k, *grad_feature_kc, *grad_clear_r;

  GV_HD void operator()(int64_t ray) const {
    const int64_t begin = packed.begin(ray), end = packed.end(ray);
    T grad_behind = grad_left_r[ray];  // gradient of the light that enters the samples behind
    for (int64_t k = end - 1; k >= begin; --k) {
      const T before = before_k[k], alpha = alpha_k[k];
      T grad_absorbed = 0;  // gradient of the light that the sample absorbs
      for (int32_t channel = 0; channel < packed.channels; ++channel) {
        const T grad = grad_sum_rc[ray * packed.channels + channel];
        grad_absorbed = grad_absorbed + grad * feature_kc[k * packed.channels + channel];
        grad_feature_kc[k * packed.channels + channel] = before * alpha * grad;
      }
      const bool counts = before > 0 || !(stop_clear > 0);
      grad_alpha_k[k] = counts ? before * (grad_absorbed - grad_behind) : 0;
      if (counts) grad_behind = alpha * grad_absorbed + (1 - alpha) * grad_behind;
    }
    grad_clear_r[ray] = grad_behind;
  }
};

}  // namespace GV_NAMESPACE
}  // namespace gvtorch
