// Where torch meets the kernels: how the lists of arguments.h become ops, and the ops that trace rays. Included once by
// cpu.cpp and once by cuda.cu, each of which brings its own `trace` and `shade`; and by every user's shader (user.cpp),
// which needs neither. The cache's ops and those of segments: entry_cache.h, entry_segments.h.
//
// An op is a struct of its arguments (GV_OP), and a function `run<Device>` of it, which checks them and runs kernels.
//
// Only the LibTorch Stable ABI is used (torch/csrc/stable), so that one binary serves every torch >= 2.11.
// Messages for users are made in gvtorch/ops/*.py; the checks here only keep memory safe.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <initializer_list>
#include <optional>
#include <string>
#include <tuple>
#include <type_traits>

#include "base/for_each.h"
#include "shaders/shade_rays.h"
#include "walk/trace.h"

namespace gvtorch {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class Device>
void trace(const Tensor& like, TraceArgs args, bool wide);
template <class Device>
void shade(const Tensor& like, ShadeArgs args, bool wide);

// --- From a kind to what torch hands over, and to words.

template <class Kind, class = void>
struct Handed {
  using Type = std::conditional_t<std::is_same_v<Kind, kinds::Float>, double,
                                  std::conditional_t<std::is_same_v<Kind, kinds::Bool>, bool, int64_t>>;
  static std::string word() {
    if (std::is_same_v<Kind, kinds::Float>) return "float ";
    if (std::is_same_v<Kind, kinds::Bool>) return "bool ";
    return std::is_same_v<Kind, kinds::Count> ? "SymInt " : "int ";
  }
};
template <class Kind>
struct Handed<Kind, std::void_t<typename Kind::Value>> {
  using Type = std::conditional_t<Kind::kOptional, std::optional<Tensor>, Tensor>;
  static std::string word() {
    if (Kind::kAlias != 0) return std::string("Tensor(") + Kind::kAlias + "!) ";
    return Kind::kOptional ? "Tensor? " : "Tensor ";
  }
};

inline std::string schema_of(const char* name, std::initializer_list<std::string> words, const char* returns) {
  std::string text = name;
  const char* before = "(";
  for (const std::string& word : words) {
    text += before + word;
    before = ", ";
  }
  return text + ") -> " + returns;
}

struct Begin {};  // the first of a list's types, for each of the others has a comma before it
template <class...>
struct Types {};

#define GV_FIELD(kind, name, limit) Handed<kinds::kind>::Type name;
#define GV_TYPE(kind, name, limit) , Handed<kinds::kind>::Type
#define GV_WORD(kind, name, limit) Handed<kinds::kind>::word() + #name,
#define GV_CHECK(kind, name, limit) require<kinds::kind>(a.name, #name, like, limit);
#define GV_LAY(kind, name, limit) lay(args.name, a.name);

// Declares the struct of an op.
#define GV_OP(Op, op_name, LIST, returns)                                                                     \
  struct Op {                                                                                                 \
    LIST(GV_FIELD)                                                                                            \
    using List = Types<Begin LIST(GV_TYPE)>;                                                                  \
    static constexpr const char* kName = op_name;                                                             \
    static std::string schema(const char* name = kName) { return schema_of(name, {LIST(GV_WORD)}, returns); } \
  }

template <class Device>
void run(Begin);  // each op has an overload
// `call` is an op's function as torch calls it, with one parameter for each argument.
template <class Device, class Op, class List, class... Extra>
struct Called;
template <class Device, class Op, class... Type, class... Extra>
struct Called<Device, Op, Types<Begin, Type...>, Extra...> {
  static auto call(const Type&... values) { return run<Device, Extra...>(Op{values...}); }
};

// Defines ops, and adds a device's kernels to them.
template <class Library, class... Op>
void define(Library& library, Types<Op...>) {
  (library.def(Op::schema().c_str()), ...);
}
template <class Device, class Op, class... Extra, class Library>
void implement_as(Library& library, const char* name) {
  static constexpr auto kCall = &Called<Device, Op, typename Op::List, Extra...>::call;
  library.impl(name, TORCH_BOX(kCall));
}
template <class Device, class Library, class... Op>
void implement(Library& library, Types<Op...>) {
  (implement_as<Device, Op>(library, Op::kName), ...);
}

// --- Checks

// What tensors of an op have in common.
struct Like {
  const Tensor& tensor;  // on whose device all lie
  ScalarType real = ScalarType::Float;
  ScalarType voxel = ScalarType::Float;
};

template <class Kind>
void require(const Tensor& tensor, const char* name, const Like& like, int64_t numel) {
  using T = typename Kind::Value;
  STD_TORCH_CHECK(tensor.is_contiguous(), "gvtorch: ", name, " must be contiguous");
  STD_TORCH_CHECK(tensor.device() == like.tensor.device(), "gvtorch: ", name, " lies on another device");
  ScalarType dtype = tensor.scalar_type();
  if (std::is_same_v<T, double>) dtype = ScalarType::Double;
  if (std::is_same_v<T, int32_t>) dtype = ScalarType::Int;
  if (std::is_same_v<T, int64_t>) dtype = ScalarType::Long;
  if (std::is_same_v<T, bool>) dtype = ScalarType::Bool;
  if (std::is_same_v<T, kinds::AnyReal>) dtype = like.real;
  if (std::is_same_v<T, kinds::AnyVoxel> && !Kind::kOptional) dtype = like.voxel;
  STD_TORCH_CHECK(tensor.scalar_type() == dtype, "gvtorch: ", name, " has the wrong dtype");
  STD_TORCH_CHECK(numel == kAny || tensor.numel() == numel, "gvtorch: ", name, " must hold ", numel, " elements, got ",
                  tensor.numel());
}
template <class Kind>
void require(const std::optional<Tensor>& tensor, const char* name, const Like& like, int64_t numel) {
  if (tensor.has_value()) require<Kind>(*tensor, name, like, numel);
}
template <class Kind>
void require(int64_t number, const char* name, const Like&, int64_t end) {
  const int64_t most = end != kAny ? end - 1 : std::is_same_v<Kind, kinds::Count> ? INT64_MAX : INT32_MAX;
  STD_TORCH_CHECK(number >= 0 && number <= most, "gvtorch: ", name, " out of range: ", number);
}
template <class Kind>
void require(double, const char*, const Like&, int64_t) {}
template <class Kind>
void require(bool, const char*, const Like&, int64_t) {}

inline VoxelType voxel_type(ScalarType dtype) {
  switch (dtype) {
    case ScalarType::Byte:
      return VoxelType::kUInt8;
    case ScalarType::Char:
      return VoxelType::kInt8;
    case ScalarType::Short:
      return VoxelType::kInt16;
    case ScalarType::UInt16:
      return VoxelType::kUInt16;
    case ScalarType::Half:
      return VoxelType::kHalf;
    case ScalarType::BFloat16:
      return VoxelType::kBFloat16;
    case ScalarType::Float:
      return VoxelType::kFloat;
    default:
      STD_TORCH_CHECK(false, "gvtorch: this channel dtype has no kernel");
  }
}

// Whether an op computes in float64, not in float32.
inline bool is_wide(const Tensor& tensor) {
  const ScalarType dtype = tensor.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double, "gvtorch: must be float32 or float64");
  return dtype == ScalarType::Double;
}

inline int64_t check_rays(const Tensor& origin_r3) {
  STD_TORCH_CHECK(origin_r3.dim() == 2 && origin_r3.size(1) == 3 && origin_r3.size(0) <= INT32_MAX,
                  "gvtorch: origin_r3 must be (r, 3)");
  return origin_r3.size(0);
}

// Returns the side of bricks of any channel.
inline int64_t check_bricks(const Tensor& bricks_bzyxc) {
  STD_TORCH_CHECK(bricks_bzyxc.dim() == 5 && bricks_bzyxc.size(1) >= 2 && bricks_bzyxc.size(1) <= 1024 &&
                      bricks_bzyxc.size(1) == bricks_bzyxc.size(2) && bricks_bzyxc.size(2) == bricks_bzyxc.size(3),
                  "gvtorch: bricks must be (b, s, s, s, c) with s >= 2");
  const int64_t side = bricks_bzyxc.size(1);
  STD_TORCH_CHECK(side * side * side * bricks_bzyxc.size(4) <= INT32_MAX / 8, "gvtorch: a brick is too large");
  return side;
}

template <class Op>
void check_numbers(const Op& a) {
  STD_TORCH_CHECK(a.branching >= 2, "gvtorch: branching out of range");
  STD_TORCH_CHECK(a.step > 0 && a.root_voxel > 0, "gvtorch: step and root_voxel must be positive");
}

// --- From torch's struct to the kernels'.

template <class T>
T* data(const Tensor& tensor) {
  if constexpr (std::is_const_v<T>) {
    return static_cast<T*>(tensor.const_data_ptr());
  } else {
    return static_cast<T*>(tensor.mutable_data_ptr());
  }
}
template <class T>
void lay(T*& pointer, const Tensor& tensor) {
  pointer = data<T>(tensor);
}
template <class T>
void lay(T*& pointer, const std::optional<Tensor>& tensor) {
  pointer = tensor.has_value() ? data<T>(*tensor) : nullptr;
}
template <class To, class From, class = std::enable_if_t<!std::is_pointer_v<To>>>
void lay(To& number, From from) {
  number = static_cast<To>(from);
}

// Checks what all ops that walk rays have in common and lays it ready. integrates: the table is (l, m, m, 4).
template <class Op>
void lay_ready(TraceArgs& args, const Op& a, bool integrates = false) {
  const Like like{a.origin_r3, a.table_lm4.scalar_type(), a.bricks_bzyxc.scalar_type()};
  const int64_t rays = check_rays(a.origin_r3), side = check_bricks(a.bricks_bzyxc);
  const int64_t bricks = a.bricks_bzyxc.size(0), channels = a.bricks_bzyxc.size(4);
  STD_TORCH_CHECK(a.child_tn.dim() == 2, "gvtorch: child_tn must be (t, n)");
  const int64_t tiles = a.child_tn.size(0), nodes = a.child_tn.numel();
  STD_TORCH_CHECK(a.table_lm4.dim() == (integrates ? 4 : 3) && a.table_lm4.size(0) >= 1 && a.table_lm4.size(1) >= 2,
                  "gvtorch: table_lm4 must be (l, m, 4) with m >= 2");
  const int64_t levels = a.table_lm4.size(0), rows = a.table_lm4.size(1);
  const int64_t table = 4 * levels * rows * (integrates ? rows : 1);
  GV_RAYS(GV_CHECK)
  GV_CHANNEL(GV_CHECK)
  GV_WALK(GV_CHECK)
  check_numbers(a);
  STD_TORCH_CHECK(a.child_tn.size(1) >= a.branching * a.branching * a.branching && nodes <= INT32_MAX,
                  "gvtorch: child_tn has too few or too many nodes");
  STD_TORCH_CHECK(a.width == 0 || rays % a.width == 0, "gvtorch: rays are no rows of this width");
  STD_TORCH_CHECK(levels <= INT32_MAX && rows <= INT32_MAX, "gvtorch: table_lm4 is too large");
  STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(a.table_lm4.const_data_ptr()) % 16 == 0,
                  "gvtorch: table_lm4 must begin at a multiple of 16 bytes");
  GV_RAYS(GV_LAY)
  GV_CHANNEL(GV_LAY)
  GV_WALK(GV_LAY)
  args.rays = rays;
  args.bricks = bricks;
  args.nodes = nodes;
  args.voxel = voxel_type(like.voxel);
  lay(args.nodes_per_tile, a.child_tn.size(1));
  lay(args.side, side);
  lay(args.channels, channels);
  lay(args.rows, rows);
  lay(args.levels, levels);
}

// --- The ops

// Makes a tensor for the kernels to fill, of the dtype of `like` or another.
template <class T>
Tensor give(T*& pointer, const Tensor& like, std::initializer_list<int64_t> shape) {
  Tensor made = torch::stable::new_empty(like, shape);
  lay(pointer, made);
  return made;
}
template <class T>
Tensor give(T*& pointer, const Tensor& like, std::initializer_list<int64_t> shape, ScalarType dtype) {
  Tensor made = torch::stable::new_empty(like, shape, dtype);
  lay(pointer, made);
  return made;
}

// What a traced ray gives.
inline std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> give_hits(TraceArgs& args, const Tensor& table) {
  return {give(args.color_r3, table, {args.rays, 3}), give(args.alpha_r1, table, {args.rays, 1}),
          give(args.depth_r1, table, {args.rays, 1}), give(args.samples_r, table, {args.rays}, ScalarType::Int),
          give(args.missed_r, table, {args.rays}, ScalarType::Bool)};
}

#define GV_TRACE_RAYS(X) GV_RAYS(X) GV_CHANNEL(X) GV_WALK(X)
#define GV_HITS "Tensor color_r3, Tensor alpha_r1, Tensor depth_r1, Tensor samples_r, Tensor missed_r"
GV_OP(TraceRaysOp, "trace_rays", GV_TRACE_RAYS, "(" GV_HITS ")");

template <class Device>
auto run(const TraceRaysOp& a) {
  TraceArgs args{};
  lay_ready(args, a);
  auto hits = give_hits(args, a.table_lm4);
  trace<Device>(a.origin_r3, args, is_wide(a.table_lm4));
  return hits;
}

// Tensor shape of features: (r, features).
#define GV_SHADE_RAYS(X) GV_TRACE_RAYS(X) GV_SHADE(X)
GV_OP(ShadeRaysOp, "shade_rays", GV_SHADE_RAYS, "(" GV_HITS ", Tensor normal_r3, Tensor features_rc)");

// Checks a second channel of the same pool, with `width` numbers a voxel (0: any); returns them, 0 where there is none.
inline int32_t check_second(const std::optional<Tensor>& bricks_bzyxc, const std::optional<Tensor>& constant_tnc,
                            const char* name, int64_t width, const Tensor& like_bzyxc, int64_t nodes,
                            VoxelType& voxel) {
  STD_TORCH_CHECK(bricks_bzyxc.has_value() == constant_tnc.has_value(), "gvtorch: ", name,
                  " needs bricks and constants");
  if (!bricks_bzyxc.has_value()) return 0;
  check_bricks(*bricks_bzyxc);
  const int64_t channels = bricks_bzyxc->size(4);
  STD_TORCH_CHECK(bricks_bzyxc->size(0) == like_bzyxc.size(0) && bricks_bzyxc->size(1) == like_bzyxc.size(1) &&
                      channels >= 1 && (width == 0 || channels == width),
                  "gvtorch: ", name, " has the wrong shape");
  STD_TORCH_CHECK(
      constant_tnc->scalar_type() == bricks_bzyxc->scalar_type() && constant_tnc->numel() == nodes * channels,
      "gvtorch: the constants of ", name, " have the wrong dtype or size");
  voxel = voxel_type(bricks_bzyxc->scalar_type());
  return static_cast<int32_t>(channels);
}

// The shaders of a library: what is asked of their arguments, and `run`, which shades all rays. A user's library has a
// class like this one (user.cpp).
struct FusedShaders {
  static bool integrates(int64_t shader) {
    STD_TORCH_CHECK(shader < static_cast<int64_t>(ShaderKind::kCount), "gvtorch: shader is unknown");
    return with_shader<float>(static_cast<int32_t>(shader),
                              [](auto type) { return decltype(type)::Shader::kIntegrates; });
  }
  static void check(const ShadeArgs& args, int64_t shader) {
    with_shader<float>(static_cast<int32_t>(shader), [&](auto type) {
      using Shader = typename decltype(type)::Shader;
      const bool by_other = Shader::kFeatures == Shader::kAsOther;
      STD_TORCH_CHECK(!by_other || args.other_channels > 0, "gvtorch: other_bzyxc is missing");
      const bool colored = (args.channels == 4 || args.channels == 4 * kDirections) && args.component == 3;
      STD_TORCH_CHECK(!Shader::kColored || colored, "gvtorch: bricks_bzyxc must hold red, green, blue and opacity");
      STD_TORCH_CHECK(args.features == (by_other ? args.other_channels : Shader::kFeatures),
                      "gvtorch: features is not what the shader gives");
    });
    STD_TORCH_CHECK(args.parameters == kParameters, "gvtorch: parameter_54 must hold 20 elements, got ",
                    args.parameters);
  }
  template <class Device>
  static void run(const Tensor& like, const ShadeArgs& args, bool wide) {
    shade<Device>(like, args, wide);
  }
};

template <class Device, class Shaders = FusedShaders>
auto run(const ShadeRaysOp& a) {
  ShadeArgs args{};
  lay_ready(args, a, Shaders::integrates(a.shader));
  const Like like{a.origin_r3, a.table_lm4.scalar_type()};
  GV_SHADE(GV_CHECK)
  GV_SHADE(GV_LAY)
  check_second(a.normal_bzyxc, a.normal_tnc, "normal_bzyxc", 3, a.bricks_bzyxc, args.nodes, args.normal_voxel);
  args.other_channels =
      check_second(a.other_bzyxc, a.other_tnc, "other_bzyxc", 0, a.bricks_bzyxc, args.nodes, args.other_voxel);
  STD_TORCH_CHECK(!a.other_bzyxc.has_value() || a.other_component < args.other_channels,
                  "gvtorch: other_component out of range");
  STD_TORCH_CHECK(a.parameter_54.numel() <= INT32_MAX, "gvtorch: parameter_54 is too large");
  lay(args.parameters, a.parameter_54.numel());
  Shaders::check(args, a.shader);
  auto hits = give_hits(args, a.table_lm4);
  Tensor normal_r3 = give(args.normal_r3, a.table_lm4, {args.rays, 3});
  Tensor features_rc = give(args.features_rc, a.table_lm4, {args.rays, a.features});
  Shaders::template run<Device>(a.origin_r3, args, is_wide(a.table_lm4));
  return std::tuple_cat(hits, std::make_tuple(normal_r3, features_rc));
}

using RayOps = Types<TraceRaysOp, ShadeRaysOp>;

}  // namespace gvtorch
