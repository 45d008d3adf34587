// Segments: the runs of intervals that rays take in the nodes they visit, for module shaders, which are not part of a
// kernel. Rays are walked as in shade_rays.h (the same visits, marks and intervals), but nothing is shaded: what a
// sample needs is stored. SampleBricks then reads any channel at any sample, equal to the renderer in every bit;
// CompositeRay composites.
//
// A segment is all the whole intervals of one visit that have one length and one base, or one odd interval: the last
// one of a ray, cut at the far side, or a region of one value. Lists have exact sizes: rays are walked twice, to count
// and to write. A ray may be walked in parts of `limit` samples and at least one visit, from `state_r3` on.
#pragma once

#include "shaders/shade_rays.h"
#include "walk/brick.h"

namespace gvtorch {

// A part of a walk: it continues from state_r3, and pauses after `limit` samples. In scope for the limits: rays
#define GV_PART(X)                  \
  X(MaybeReals, state_r3, 3 * rays) \
  X(Int, limit, kAny)               \
  X(Bool, by_node, kAny)
#define GV_SEGMENT_RANGE(X) X(Longs, first_r, rays) X(Count, total, kAny)

// Segments, and samples of them. In scope for the limits: samples
#define GV_SAMPLES(X)                      \
  X(Words, ray_s, args.segments)           \
  X(Words, node_s2, 2 * args.segments)     \
  X(Words, brick_s2, 2 * args.segments)    \
  X(Words, depth_s3, 3 * args.segments)    \
  X(Words, interval_s3, 3 * args.segments) \
  X(Reals, distance_s3, 3 * args.segments) \
  X(Words, segment_k, samples)             \
  X(Words, number_k, samples)
// The gradient by the samples' values, and in what order it is spread; see SpreadGradient.
#define GV_GRADIENT(X)                         \
  X(Reals, grad_kc, args.samples* voxel_width) \
  X(Longs, entry_e, args.entries)              \
  X(Words, segment_e, args.entries)            \
  X(Words, length_e, args.entries)             \
  X(Longs, begin_p, args.portions + 1)         \
  X(Longs, row_p, args.portions)               \
  X(Longs, brick_x, args.rows)

// Packed samples of rays: those of a ray are consecutive, from front to back. In scope for the limits: rays
#define GV_PACKED(X)                           \
  X(Reals, alpha_k, args.count)                \
  X(Reals, feature_kc, args.count* args.width) \
  X(Longs, offset_r, rays + 1)
#define GV_COMPOSITE(X) GV_PACKED(X) X(Reals, clear_r, rays) X(Float, stop_clear, kAny)
#define GV_COMPOSITE_BACKWARD(X)          \
  X(Reals, grad_sum_rc, rays* args.width) \
  X(Reals, grad_left_r, rays)             \
  GV_PACKED(X)                            \
  X(Reals, before_k, args.count)          \
  X(Float, stop_clear, kAny)

inline namespace GV_NAMESPACE {

constexpr int32_t kOdd = -1;  // level of an odd interval

template <class T>
struct Segment {
  Holder fine, coarse;
  int32_t wanted = 0;            // depth that the cone asked for
  int32_t first = 0, count = 0;  // number of the first interval, counted from base; how many intervals
  int32_t level = kOdd;          // intervals are step * 2^level long, or kOdd
  // Distances from where the ray enters the scene; lookup_t: where the nodes were looked up.
  T base = 0, start = 0, end = 0, lookup_t = 0;
};

// Where segments are written.
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
//
//   state_r3    base, count and level from which each ray continues; null: rays begin
//   limit       a ray pauses after the visit in which it reaches this many samples; 0: it goes to its end
//   by_node     a visit of two nodes is never a region, even where their constants are equal
template <class T, class Digits>
struct WalkRay {
  using Real = T;
  ShadeRay<T, Plain<T>, Digits> kernel;
  GV_PART(GV_TYPED_VIEW)

  GV_HD Intervals<T> begin(const Ray<T>& ray, int64_t number) const {
    Intervals<T> intervals(ray, kernel.step, kernel.lengths);
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
      segment.level = kOdd;
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

template <class Walk, class T = typename Walk::Real>
struct CountSegments {
  Walk walk;
  int32_t* count_r3 = nullptr;  // segments, samples, visits
  T* state_r3 = nullptr;
  bool* missed_r = nullptr;

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

// first_r: where each ray's segments begin.
template <class Walk, class T = typename Walk::Real>
struct WriteSegments {
  Walk walk;
  GV_SEGMENT_RANGE(GV_TYPED_VIEW)
  SegmentView<T> out{};

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

// Finds what the samples of a segment read: the bricks (or constants) of two nodes, and the weight of the coarse one.
template <class T>
struct FindSamples {
  Walk<T> walk;                 // only rays and the shape of the tree
  int32_t side, border, width;  // of a channel's bricks; width: numbers per voxel
  int64_t segments, nodes;
  GV_SAMPLES(GV_TYPED_VIEW)

  // Where a segment's samples lie, and how much of each is the coarse node's.
  struct Line {
    bool valid = false;  // everything the segment refers to exists
    bool mixed = false;
    int32_t count{}, level{};  // number of the first interval; kOdd: there is one, from base on
    T base{}, length{};
    T cone_near{}, cone_growth{}, voxel{}, blend{};

    // Distance of a sample, the middle of an interval.
    GV_HD T middle(int32_t number) const {
      const T half = static_cast<T>(0.5);
      return base + (level < 0 ? half : static_cast<T>(count + number) + half) * length;
    }
    GV_HD T weight(T t) const { return saturate((cone_near + cone_growth * t - voxel) * blend); }
  };
  struct Source {
    Line line;
    Spot<T> first, second;  // of the fine node, or of the one node that was asked for; of the coarse one, if mixed
  };

  GV_HD Source operator()(int64_t segment, bool only_fine = false, bool only_coarse = false) const {
    Source source;
    if (segment < 0 || segment >= segments) return source;
    const TreeView& tree = walk.tree;
    const int32_t wanted = depth_s3[3 * segment + 2];
    const int64_t ray_number = ray_s[segment];
    Holder holders[2];
    for (int i = 0; i < 2; ++i) {
      Holder& holder = holders[i];
      holder = {node_s2[2 * segment + i], brick_s2[2 * segment + i], depth_s3[3 * segment + i]};
      if (holder.node < 0 || holder.node >= nodes || holder.brick >= tree.bricks || holder.depth < 0 ||
          holder.depth > tree.max_depth)
        return source;
    }
    if (ray_number < 0 || ray_number >= walk.order.rays || wanted < 0 || wanted > tree.max_depth) return source;
    Line& line = source.line;
    line.valid = true;
    line.mixed = holders[1].node != holders[0].node;
    const Ray<T> ray(walk.rays, ray_number);
    const Digits<T> digits(tree, walk.levels, walk.rays, ray, distance_s3[3 * segment + 2]);
    source.first = Spot<T>(only_coarse ? holders[1] : holders[0], digits, ray, border);
    if (line.mixed && !only_fine && !only_coarse) source.second = Spot<T>(holders[1], digits, ray, border);
    line.cone_near = ray.cone_near;
    line.cone_growth = ray.cone_growth;
    line.voxel = walk.levels.voxel[wanted];
    line.blend = 1 / ((wanted > 0 ? walk.levels.voxel[wanted - 1] : static_cast<T>(INFINITY)) - line.voxel);
    line.base = distance_s3[3 * segment];
    line.count = interval_s3[3 * segment];
    line.level = interval_s3[3 * segment + 2];
    line.length = line.level < 0 ? distance_s3[3 * segment + 1] - line.base : walk.step;
    for (int32_t power = 0; power < smaller(line.level, kMaxLevels); ++power) line.length = line.length + line.length;
    return source;
  }
  // How many numbers a brick has.
  GV_HD int64_t numbers() const { return static_cast<int64_t>(side) * side * side * width; }
};

template <class T, class Voxel>
struct SampleBricks {
  FindSamples<T> samples;
  const Voxel *bricks_bzyxc, *constant_tnc;
  T* value_kc = nullptr;

  GV_HD void operator()(int64_t k) const {
    const auto source = samples(samples.segment_k[k]);
    const auto& line = source.line;
    const T t = line.valid ? line.middle(samples.number_k[k]) : 0;
    const int32_t width = samples.width;
    for (int32_t c = 0; c < width; ++c) {
      T value = 0;
      if (line.valid) {
        value = read(source.first, t, c);
        if (line.mixed) value = value + line.weight(t) * (read(source.second, t, c) - value);
      }
      value_kc[k * width + c] = value;
    }
  }
  GV_HD T read(const Spot<T>& spot, T t, int32_t c) const {
    const int32_t width = samples.width;
    if (spot.brick < 0) return number<T>(constant_tnc[static_cast<int64_t>(spot.node) * width + c]);
    return trilinear(bricks_bzyxc + spot.brick * samples.numbers() + c, samples.side, width, spot.at(t));
  }
};

// The gradient of SampleBricks: each sample adds to the voxels (or constants) it was made of, and those of a brick are
// added one after another, in the order of the samples, so that sums have the same bits in every run.
//
// An entry is a run of samples of one segment, and one of its two nodes. Entries are sorted by the brick (or constants)
// they add to, and cut into portions, each of which belongs to one brick. A brick's first portion adds to the gradient,
// its others to rows of their own, which AddRows adds up.
//
//   entry_e     twice the first sample of each entry, and one more for the coarse node
//   segment_e   its segment
//   length_e    its number of samples
//   begin_p     each portion's first entry, and the end of the last one
//   row_p       the row that a portion adds to; -1: the gradient
//   brick_x     the brick of each row; constants count on from the bricks
//
// On a GPU several threads take a portion together. Each looks up one entry, and one of an entry's samples, and then
// all take these one by one. A thread adds to those voxels whose coordinates are odd or even as its number says (a
// sample has one of each kind), and one channel in `channels`.
template <class T>
struct SpreadGradient {
#ifdef __CUDACC__
  static constexpr int kCorners = 8;  // threads for the voxels of a sample
  static constexpr int kBlocksPerSM = sizeof(T) == 4 ? 8 : 5;
#else
  static constexpr int kCorners = 1;
  static constexpr int64_t kChunkSize = 4;  // see for_each.h
#endif
  FindSamples<T> find;
  int64_t samples, entries, portions, rows;
  int32_t channels;
  GV_GRADIENT(GV_TYPED_VIEW)
  T *grad_bzyxc = nullptr, *grad_tnc = nullptr, *row_xn = nullptr;

  // `channels` where voxels have so many numbers: the threads of a portion are at most a warp.
  static int32_t channels_of(int32_t width) { return kCorners == 1 || width == 1 ? 1 : width == 2 ? 2 : 4; }
  GV_HD int32_t threads() const { return kCorners * channels; }

  struct Entry {
    int64_t first = 0;  // sample
    int32_t length = 0;
    int32_t is_coarse = 0;
    typename FindSamples<T>::Line line;
    Spot<T> spot;
  };
  struct Sample {
    EightVoxels<T> corners;
    T share;  // of the node in its value
  };
  // An entry without samples if something it refers to does not exist.
  GV_HD Entry entry_at(int64_t e) const {
    Entry found;
    const int64_t first = e < 0 || e >= entries ? -1 : entry_e[e] / 2;
    if (first < 0 || length_e[e] < 0 || first > samples - length_e[e]) return found;
    found.first = first;
    found.is_coarse = static_cast<int32_t>(entry_e[e] % 2);
    const auto source = find(segment_e[e], found.is_coarse == 0, found.is_coarse != 0);
    found.line = source.line;
    found.spot = source.first;
    if (found.line.valid && (found.line.mixed || found.is_coarse == 0)) found.length = length_e[e];
    return found;
  }
  GV_HD Sample sample_at(const Entry& entry, int64_t number) const {
    const T t = entry.line.middle(find.number_k[entry.first + number]);
    const T weight = entry.line.mixed ? entry.line.weight(t) : 0;
    return {EightVoxels<T>(entry.spot.at(t), find.side), entry.is_coarse != 0 ? weight : 1 - weight};
  }
  // The value that the thread `from` of the portion has.
  template <class Value>
  GV_HD Value of_thread(const Value& value, [[maybe_unused]] int32_t from) const {
#ifdef __CUDA_ARCH__
    static_assert(sizeof(Value) % sizeof(uint32_t) == 0 && std::is_trivially_copyable_v<Value>);
    const int32_t size = threads(), lowest = threadIdx.x % 32 / size * size;
    const unsigned portion = (~0u >> (32 - size)) << lowest;
    uint32_t words[sizeof(Value) / sizeof(uint32_t)];
    memcpy(words, &value, sizeof(value));
#pragma unroll
    for (uint32_t& word : words) word = __shfl_sync(portion, word, from, size);
    Value out = value;
    memcpy(&out, words, sizeof(out));
    return out;
#else
    return value;
#endif
  }

  GV_HD void operator()(int64_t index) const {
    const int64_t portion = index / threads(), end = smaller(begin_p[portion + 1], entries), row = row_p[portion];
    const auto thread = static_cast<int32_t>(index % threads());
    for (int64_t e = larger(begin_p[portion], int64_t{0}); e < end; e += threads()) {
      const Entry own = e + thread < end ? entry_at(e + thread) : Entry{};
      GV_NO_UNROLL
      for (int32_t from = 0; from < threads(); ++from) {
        const Entry entry = of_thread(own, from);
        const bool has_row = row >= 0 && row < rows;
        add(entry, has_row ? row_xn + row * find.numbers() : gradient(entry.spot.brick, entry.spot.node), thread);
      }
    }
  }
  // Adds the samples of an entry to what begins at `sum`.
  GV_HD void add(const Entry& entry, T* sum, int32_t thread) const {
    for (int64_t begin = 0; begin < entry.length; begin += threads()) {
      const auto count = static_cast<int32_t>(smaller<int64_t>(entry.length - begin, threads()));
      const Sample own = sample_at(entry, begin + smaller(thread, count - 1));
      for (int32_t from = 0; from < count; ++from) {
        const T* grad_c = grad_kc + (entry.first + begin + from) * find.width;
        add(of_thread(own, from), entry.spot.brick < 0, grad_c, sum, thread);
      }
    }
  }
  GV_HD void add(const Sample& sample, bool is_constant, const T* grad_c, T* sum, int32_t thread) const {
    const int32_t corner = thread % kCorners, channel = thread / kCorners;
    if (is_constant) {
      if (corner == 0) add(sample.share, grad_c, sum, channel);
      return;
    }
    for (int i = 0; i < 8 / kCorners; ++i) {
      T share = sample.share;
      int32_t voxel = 0, stride = find.width;
      for (int axis = 0; axis < 3; ++axis) {
        const int32_t cell = sample.corners.cell[axis];
        const int upper = (kCorners == 1 ? i >> axis : corner >> axis ^ cell) & 1;
        share = share * (upper != 0 ? sample.corners.weight[axis] : 1 - sample.corners.weight[axis]);
        voxel += (cell + upper) * stride;
        stride *= find.side;
      }
      add(share, grad_c, sum + voxel, channel);
    }
  }
  GV_HD void add(T share, const T* grad_c, T* sum_c, int32_t channel) const {
    for (int32_t c = channel; c < find.width; c += channels) sum_c[c] = sum_c[c] + share * grad_c[c];
  }
  // The gradient of a brick, or, if there is none, of a node's constants.
  GV_HD T* gradient(int32_t brick, int32_t node) const {
    return brick < 0 ? grad_tnc + static_cast<int64_t>(node) * find.width : grad_bzyxc + brick * find.numbers();
  }
};

// Adds each brick's rows to its gradient, in order. Index: a number of a row; that of a brick's first row does it.
template <class T>
struct AddRows {
  static constexpr int kAhead = 8;  // rows that are read together: GPUs wait long for memory
  SpreadGradient<T> spread;

  GV_HD void operator()(int64_t index) const {
    const int64_t numbers = spread.find.numbers(), number = index % numbers, bricks = spread.find.walk.tree.bricks;
    const int64_t first = index / numbers, brick = spread.brick_x[first];
    const bool is_constant = brick >= bricks;
    if (first > 0 && spread.brick_x[first - 1] == brick) return;
    if (brick < 0 || brick >= bricks + spread.find.nodes || (is_constant && number >= spread.find.width)) return;
    const auto node = static_cast<int32_t>(brick - bricks);
    T* sum = spread.gradient(is_constant ? kAbsent : static_cast<int32_t>(brick), node) + number;
    T total = *sum;
    for (int64_t row = first; row < spread.rows && spread.brick_x[row] == brick; row += kAhead) {
      T more[kAhead];
      bool is_same[kAhead];
      for (int i = 0; i < kAhead; ++i) {
        const int64_t ahead = smaller(row + i, spread.rows - 1);
        more[i] = spread.row_xn[ahead * numbers + number];
        is_same[i] = row + i < spread.rows && spread.brick_x[ahead] == brick;
      }
      for (int i = 0; i < kAhead; ++i) total = is_same[i] ? total + more[i] : total;
    }
    *sum = total;
  }
};

// Front to back: sum of clear * alpha * feature, where clear is the transmittance of the samples in front. A ray ends
// where at most `stop_clear` of it is left; samples behind have a `before` of 0. stop_clear 0: all samples count.
template <class T>
struct CompositeRay {
  GV_COMPOSITE(GV_TYPED_VIEW)
  int64_t count;
  int32_t width;  // numbers of a feature
  T *sum_rc, *left_r, *before_k;

  GV_HD void operator()(int64_t ray) const {
    const Span samples(offset_r + ray, count);
    T clear = clear_r[ray];
    T* sum_c = sum_rc + ray * width;
    for (int32_t c = 0; c < width; ++c) sum_c[c] = 0;
    for (int64_t k = samples.begin; k < samples.end; ++k) {
      const bool ended = stop_clear > 0 && !(clear > stop_clear);
      before_k[k] = ended ? 0 : clear;
      if (ended) continue;
      const T share = clear * alpha_k[k];
      for (int32_t c = 0; c < width; ++c) sum_c[c] = sum_c[c] + share * feature_kc[k * width + c];
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
  GV_COMPOSITE_BACKWARD(GV_TYPED_VIEW)
  int64_t count;
  int32_t width;  // numbers of a feature
  T *grad_alpha_k, *grad_feature_kc, *grad_clear_r;

  GV_HD void operator()(int64_t ray) const {
    const Span samples(offset_r + ray, count);
    T grad_behind = grad_left_r[ray];  // gradient of the light that enters the samples behind
    for (int64_t k = samples.end - 1; k >= samples.begin; --k) {
      const T before = before_k[k], alpha = alpha_k[k];
      T grad_absorbed = 0;  // gradient of the light that the sample absorbs
      for (int32_t c = 0; c < width; ++c) {
        const T grad = grad_sum_rc[ray * width + c];
        grad_absorbed = grad_absorbed + grad * feature_kc[k * width + c];
        grad_feature_kc[k * width + c] = before * alpha * grad;
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
