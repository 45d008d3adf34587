// Connects torch and the kernels: turns the lists of arguments.h into ops, and defines the ops that trace rays.
// Included by the two libraries (cpu*.cpp, cuda.cu) and by every user's shader (user.cpp). The other ops are in the
// other headers of this folder; entry_all.h lists them all.
//
// An op is a struct of its arguments (GV_OP), and a function `run` that takes it, checks them and runs kernels.
//
// Only the LibTorch Stable ABI is used (torch/csrc/stable), so that one binary serves every torch >= 2.11.
// Messages for users are made in gvtorch/ops/*.py; the checks here only keep memory safe.
#pragma once

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <algorithm>
#include <initializer_list>
#include <limits>
#include <optional>
#include <string>
#include <tuple>
#include <type_traits>

#include "base/for_each.h"
#include "shaders/shade_rays.h"

namespace gvtorch {

using torch::headeronly::CppTypeToScalarType;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// --- From a kind to the type that torch passes, and to its word in a schema.

template <class Kind>
struct TorchType;
template <class T>
struct TorchType<kinds::NumberOf<T>> {
  static constexpr bool kFloat = std::is_same_v<T, double>, kBool = std::is_same_v<T, bool>;
  using Type = std::conditional_t<kFloat || kBool, T, int64_t>;
  static std::string schema_type() { return kFloat ? "float " : kBool ? "bool " : sizeof(T) == 8 ? "SymInt " : "int "; }
};
template <class T, char kAlias, bool kOptional>
struct TorchType<kinds::TensorOf<T, kAlias, kOptional>> {
  using Type = std::conditional_t<kOptional, std::optional<Tensor>, Tensor>;
  static std::string schema_type() {
    if (kAlias != 0) return std::string("Tensor(") + kAlias + "!) ";
    return kOptional ? "Tensor? " : "Tensor ";
  }
};

inline std::string schema_of(const char* name, std::initializer_list<std::string> arguments, const char* returns) {
  std::string text = name;
  const char* separator = "(";
  for (const std::string& argument : arguments) {
    text += separator + argument;
    separator = ", ";
  }
  return text + ") -> " + returns;
}

struct Begin {};  // the first of a list's types, because GV_TYPE puts a comma before each of the others
template <class...>
struct Types {};
template <class... First, class... Second>
Types<First..., Second...> operator+(Types<First...>, Types<Second...>);  // both lists as one

#define GV_FIELD(kind, name, limit) TorchType<kinds::kind>::Type name;
#define GV_TYPE(kind, name, limit) , TorchType<kinds::kind>::Type
#define GV_SCHEMA(kind, name, limit) TorchType<kinds::kind>::schema_type() + #name,

// Declares the struct of an op.
#define GV_OP(Op, op_name, LIST, returns)                                                                       \
  struct Op {                                                                                                   \
    LIST(GV_FIELD)                                                                                              \
    using List = Types<Begin LIST(GV_TYPE)>;                                                                    \
    static constexpr const char* kName = op_name;                                                               \
    static std::string schema(const char* name = kName) { return schema_of(name, {LIST(GV_SCHEMA)}, returns); } \
  }

// `call` is an op's function as torch calls it, with one parameter for each argument.
template <class Op, class List = typename Op::List>
struct OpFunction;
template <class Op, class... Type>
struct OpFunction<Op, Types<Begin, Type...>> {
  static auto call(const Type&... values) { return run(Op{values...}); }
};

// Defines ops, and adds this library's kernels to them.
template <class Library, class... Op>
void define(Library& library, Types<Op...>) {
  (library.def(Op::schema().c_str()), ...);
}
template <class Op, class Library>
void implement_as(Library& library, const char* name) {
  static constexpr auto kCall = &OpFunction<Op>::call;
  library.impl(name, TORCH_BOX(kCall));
}
template <class Library, class... Op>
void implement(Library& library, Types<Op...>) {
  (implement_as<Op>(library, Op::kName), ...);
}

// --- From torch's struct to the kernels'

// What tensors of an op have in common.
struct Like {
  const Tensor& tensor;  // all are on its device
  ScalarType real = ScalarType::Float;
  ScalarType voxel = ScalarType::Float;
  ScalarType request = ScalarType::Short;

  template <class T>
  ScalarType dtype() const {
    if constexpr (std::is_same_v<T, kinds::AnyReal>) return real;
    if constexpr (std::is_same_v<T, kinds::AnyVoxel>) return voxel;
    if constexpr (std::is_same_v<T, int16_t>) return request;
    if constexpr (!std::is_class_v<T>) return CppTypeToScalarType<T>::value;
  }
};

template <class T, char kAlias, bool kOptional>
void check(kinds::TensorOf<T, kAlias, kOptional>, const Tensor& tensor, const char* name, const Like& like,
           int64_t numel) {
  constexpr bool any_dtype = kOptional && std::is_same_v<T, kinds::AnyVoxel>;
  STD_TORCH_CHECK(tensor.is_contiguous(), "gvtorch: ", name, " must be contiguous");
  STD_TORCH_CHECK(tensor.device() == like.tensor.device(), "gvtorch: ", name, " lies on another device");
  STD_TORCH_CHECK(any_dtype || tensor.scalar_type() == like.dtype<T>(), "gvtorch: ", name, " has the wrong dtype");
  STD_TORCH_CHECK(numel == kAny || tensor.numel() == numel, "gvtorch: ", name, " must hold ", numel, " elements, got ",
                  tensor.numel());
}
template <class Kind>
void check(Kind kind, const std::optional<Tensor>& tensor, const char* name, const Like& like, int64_t numel) {
  if (tensor.has_value()) check(kind, *tensor, name, like, numel);
}
template <class T>
void check(kinds::NumberOf<T>, int64_t number, const char* name, const Like&, int64_t end) {
  const int64_t maximum = end != kAny ? end - 1 : std::numeric_limits<T>::max();
  STD_TORCH_CHECK(number >= 0 && number <= maximum, "gvtorch: ", name, " out of range: ", number);
}
inline void check(kinds::Float, double, const char*, const Like&, int64_t) {}
inline void check(kinds::Bool, bool, const char*, const Like&, int64_t) {}

// The memory of a tensor, which converts to a pointer of the type that a kernel declares; null without a tensor.
struct Memory {
  const Tensor* tensor;

  template <class T>
  operator T*() const {
    if (tensor == nullptr) return nullptr;
    if constexpr (std::is_const_v<T>) return static_cast<T*>(tensor->const_data_ptr());
    if constexpr (!std::is_const_v<T>) return static_cast<T*>(tensor->mutable_data_ptr());
  }
};
inline Memory to_kernel(const Tensor& tensor) { return {&tensor}; }
inline Memory to_kernel(const std::optional<Tensor>& tensor) { return {tensor.has_value() ? &*tensor : nullptr}; }
template <class Number>
Number to_kernel(Number number) {
  return number;
}

// Checks an argument of `a`, and stores it in the kernels' `args`.
#define GV_CHECK_AND_SET(kind, name, limit)         \
  check(kinds::kind{}, a.name, #name, like, limit); \
  args.name = to_kernel(a.name);

// Makes a tensor for the kernels to fill, of the pointer's dtype, or of that of `like` if the pointer is void.
template <class T>
Tensor make_output(T*& pointer, const Tensor& like, std::initializer_list<int64_t> shape) {
  ScalarType dtype = like.scalar_type();
  if constexpr (!std::is_void_v<T>) dtype = CppTypeToScalarType<T>::value;
  Tensor output = torch::stable::new_empty(like, shape, dtype);
  pointer = to_kernel(output);
  return output;
}

// The same, filled with 0.
template <class T>
Tensor make_zeros(T*& pointer, const Tensor& like, std::initializer_list<int64_t> shape) {
  Tensor output = make_output(pointer, like, shape);
  torch::stable::zero_(output);
  return output;
}

inline VoxelType voxel_type(ScalarType dtype) {
  constexpr ScalarType kScalarTypes[] = {ScalarType::Byte, ScalarType::Char,     ScalarType::Short, ScalarType::UInt16,
                                         ScalarType::Half, ScalarType::BFloat16, ScalarType::Float};
  const auto* match = std::find(std::begin(kScalarTypes), std::end(kScalarTypes), dtype);
  STD_TORCH_CHECK(match != std::end(kScalarTypes), "gvtorch: this channel dtype has no kernel");
  return static_cast<VoxelType>(match - kScalarTypes);
}

// True if an op computes in float64, not in float32.
inline bool is_float64(const Tensor& tensor) {
  const ScalarType dtype = tensor.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double, "gvtorch: must be float32 or float64");
  return dtype == ScalarType::Double;
}

// Returns body(T{}), with T float or double, as is_float64.
template <class Body>
auto with_real(const Tensor& tensor, const Body& body) {
  return is_float64(tensor) ? body(double{}) : body(float{});
}

// Checks the bricks of any channel; returns their side, border included.
inline int32_t check_bricks(const Tensor& bricks_bzyxc) {
  STD_TORCH_CHECK(bricks_bzyxc.dim() == 5 && bricks_bzyxc.size(1) >= 2 && bricks_bzyxc.size(1) <= 1024 &&
                      bricks_bzyxc.size(1) == bricks_bzyxc.size(2) && bricks_bzyxc.size(2) == bricks_bzyxc.size(3),
                  "gvtorch: bricks must be (b, s, s, s, c) with s >= 2");
  const int64_t side = bricks_bzyxc.size(1);
  STD_TORCH_CHECK(side * side * side * bricks_bzyxc.size(4) <= INT32_MAX / 8, "gvtorch: a brick is too large");
  return static_cast<int32_t>(side);
}

// Checks and stores the arguments that all ops on rays and bricks have in common.
template <class Op>
void set_channel_args(TraceArgs& args, const Op& a, const Like& like, int64_t nodes) {
  STD_TORCH_CHECK(a.origin_r3.dim() == 2 && a.origin_r3.size(1) == 3 && a.origin_r3.size(0) <= INT32_MAX,
                  "gvtorch: origin_r3 must be (r, 3)");
  STD_TORCH_CHECK(nodes <= INT32_MAX, "gvtorch: too many nodes");
  args.rays = a.origin_r3.size(0);
  args.bricks = a.bricks_bzyxc.size(0);
  args.nodes = nodes;
  args.voxel = voxel_type(like.voxel);
  args.side = check_bricks(a.bricks_bzyxc);
  args.voxel_width = static_cast<int32_t>(a.bricks_bzyxc.size(4));
  GV_RAYS(GV_CHECK_AND_SET)
  GV_CHANNEL(GV_CHECK_AND_SET)
  STD_TORCH_CHECK(a.branching >= 2 && std::pow(a.branching, a.max_depth) <= kMaxNodes,
                  "gvtorch: branching or max_depth out of range");
  STD_TORCH_CHECK(a.step > 0 && a.root_voxel > 0, "gvtorch: step and root_voxel must be positive");
}

// Checks and stores the arguments that all ops that walk rays have in common. integrates: the table is (l, m, m, 4).
template <class Op>
ShadeArgs make_walk_args(const Op& a, bool integrates = false) {
  ShadeArgs args{};
  args.shader = kPlainShader;
  // Programs that version 0.1 exported pass requests of 32 bits. Nobody reads them, so none are written.
  const bool unread = a.request_tn.scalar_type() == ScalarType::Int;
  const Like like{a.origin_r3, a.table_lm4.scalar_type(), a.bricks_bzyxc.scalar_type(),
                  unread ? ScalarType::Int : ScalarType::Short};
  STD_TORCH_CHECK(a.child_tn.dim() == 2, "gvtorch: child_tn must be (t, n)");
  const int64_t tiles = a.child_tn.size(0), nodes = a.child_tn.numel();
  set_channel_args(args, a, like, nodes);
  const int64_t dims = integrates ? 4 : 3;
  STD_TORCH_CHECK(a.table_lm4.dim() == dims && a.table_lm4.size(0) >= 1 && a.table_lm4.size(1) >= 2 &&
                      a.table_lm4.size(dims - 2) == a.table_lm4.size(1) && a.table_lm4.size(dims - 1) == 4,
                  "gvtorch: table_lm4 must be (l, m, 4) with m >= 2");
  const int64_t lengths = a.table_lm4.size(0), rows = a.table_lm4.size(1);
  args.table = a.table_lm4.numel();
  GV_WALK(GV_CHECK_AND_SET)
  if (unread) args.request_tn = nullptr;
  STD_TORCH_CHECK(a.child_tn.size(1) >= a.branching * a.branching * a.branching, "gvtorch: child_tn has too few nodes");
  STD_TORCH_CHECK(a.width == 0 || args.rays % a.width == 0, "gvtorch: rays are no rows of this width");
  STD_TORCH_CHECK(args.table <= INT32_MAX, "gvtorch: table_lm4 is too large");
  STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(args.table_lm4) % 16 == 0,
                  "gvtorch: table_lm4 must begin at a multiple of 16 bytes");
  args.nodes_per_tile = static_cast<int32_t>(a.child_tn.size(1));
  args.rows = static_cast<int32_t>(rows);
  args.lengths = static_cast<int32_t>(lengths);
  return args;
}

// --- The ops

// Makes the tensors of what traced rays return.
inline std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> make_hits(TraceArgs& args, const Tensor& table) {
  return {make_output(args.color_r3, table, {args.rays, 3}), make_output(args.alpha_r1, table, {args.rays, 1}),
          make_output(args.depth_r1, table, {args.rays, 1}), make_output(args.samples_r, table, {args.rays}),
          make_output(args.missed_r, table, {args.rays})};
}

// Checks a second channel of the same pool, with `width` numbers per voxel (0: any); returns this number, 0 where
// there is no channel. coarse: it may have only the pool's first bricks, and no constants.
inline int32_t check_second_channel(const std::optional<Tensor>& bricks_bzyxc,
                                    const std::optional<Tensor>& constant_tnc, const char* name, int64_t width,
                                    const TraceArgs& args, VoxelType& voxel, bool coarse = false) {
  STD_TORCH_CHECK(coarse || bricks_bzyxc.has_value() == constant_tnc.has_value(), "gvtorch: ", name,
                  " needs bricks and constants");
  if (!bricks_bzyxc.has_value()) return 0;
  const int32_t side = check_bricks(*bricks_bzyxc);
  const int64_t own_width = bricks_bzyxc->size(4), bricks = bricks_bzyxc->size(0);
  STD_TORCH_CHECK((bricks == args.bricks || (coarse && bricks < args.bricks)) && side == args.side && own_width >= 1 &&
                      (width == 0 || own_width == width),
                  "gvtorch: ", name, " has the wrong shape");
  if (constant_tnc.has_value()) {
    STD_TORCH_CHECK(
        constant_tnc->scalar_type() == bricks_bzyxc->scalar_type() && constant_tnc->numel() == args.nodes * own_width,
        "gvtorch: the constants of ", name, " have the wrong dtype or size");
  }
  voxel = voxel_type(bricks_bzyxc->scalar_type());
  return static_cast<int32_t>(own_width);
}

// What a shader requires of its arguments: some of the facts of ShaderFacts.
struct ShaderNeeds {
  bool integrates, colored;
  int32_t filtered, features;
};
template <class Shader>
constexpr ShaderNeeds kNeeds{Shader::kIntegrates, Shader::kColored, Shader::kFiltered, Shader::kFeatures};

// The shaders of a library: what each needs, and `run`, which shades all rays. A user's library has a class like this
// one (user.cpp).
struct FusedShaders {
  static constexpr int32_t kUniforms = 0;  // how many numbers follow the kParameters; -1: any number
  static ShaderNeeds needs(int64_t shader) {
    STD_TORCH_CHECK(shader < static_cast<int64_t>(ShaderKind::kCount), "gvtorch: shader is unknown");
    return with_shader<float>(static_cast<int32_t>(shader),
                              [](auto type) { return kNeeds<typename decltype(type)::Shader>; });
  }
  static void run(const Tensor& like, ShadeArgs args, bool in_float64);  // in cpu_rays.cpp and in cuda.cu
};

// Checks that the arguments are what a shader needs.
inline void check_needs(const ShaderNeeds& needs, const ShadeArgs& args) {
  const bool colored = (args.voxel_width == 4 || args.voxel_width == 4 * kDirections) && args.component == 3;
  STD_TORCH_CHECK(!needs.colored || colored, "gvtorch: bricks_bzyxc must hold red, green, blue and opacity");
  const bool sided = args.other_width == needs.filtered || args.other_width == needs.filtered * kDirections;
  STD_TORCH_CHECK(needs.filtered == 0 || sided, "gvtorch: other_bzyxc must hold filtered colours");
  const int32_t features = needs.features == ShaderFacts::kAsOther ? args.other_width : needs.features;
  STD_TORCH_CHECK(args.features == features, "gvtorch: features must be ", features, ", got ", args.features);
}

#define GV_TRACE_RAYS(X) GV_RAYS(X) GV_CHANNEL(X) GV_WALK(X)
#define GV_HITS "Tensor color_r3, Tensor alpha_r1, Tensor depth_r1, Tensor samples_r, Tensor missed_r"
GV_OP(TraceRaysOp, "trace_rays", GV_TRACE_RAYS, "(" GV_HITS ")");

inline auto run(const TraceRaysOp& a) {
  ShadeArgs args = make_walk_args(a);
  auto hits = make_hits(args, a.table_lm4);
  FusedShaders::run(a.origin_r3, args, is_float64(a.table_lm4));
  return hits;
}

// Shape of features: (r, features).
#define GV_SHADE_RAYS(X) GV_TRACE_RAYS(X) GV_SHADE(X)
GV_OP(ShadeRaysOp, "shade_rays", GV_SHADE_RAYS, "(" GV_HITS ", Tensor normal_r3, Tensor features_rc)");

template <class Shaders>
auto shade_rays(const ShadeRaysOp& a) {
  const ShaderNeeds needs = Shaders::needs(a.shader);
  ShadeArgs args = make_walk_args(a, needs.integrates);
  const Like like{a.origin_r3, a.table_lm4.scalar_type()};
  GV_SHADE(GV_CHECK_AND_SET)
  check_second_channel(a.normal_bzyxc, a.normal_tnc, "normal_bzyxc", 3, args, args.normal_voxel);
  args.other_width =
      check_second_channel(a.other_bzyxc, a.other_tnc, "other_bzyxc", 0, args, args.other_voxel, needs.filtered > 0);
  STD_TORCH_CHECK(!a.other_bzyxc.has_value() || a.other_component < args.other_width,
                  "gvtorch: other_component out of range");
  args.other_bricks = a.other_bzyxc.has_value() ? static_cast<int32_t>(a.other_bzyxc->size(0)) : 0;
  const int64_t uniforms = a.parameter_54.numel() - kParameters;
  STD_TORCH_CHECK(uniforms >= 0 && uniforms <= INT32_MAX && (Shaders::kUniforms < 0 || uniforms == Shaders::kUniforms),
                  "gvtorch: parameter_54 holds the wrong number of uniforms: ", uniforms);
  args.uniforms = static_cast<int32_t>(uniforms);
  check_needs(needs, args);
  auto hits = make_hits(args, a.table_lm4);
  Tensor normal_r3 = make_output(args.normal_r3, a.table_lm4, {args.rays, 3});
  Tensor features_rc = make_output(args.features_rc, a.table_lm4, {args.rays, a.features});
  Shaders::run(a.origin_r3, args, is_float64(a.table_lm4));
  return std::tuple_cat(hits, std::make_tuple(normal_r3, features_rc));
}

inline auto run(const ShadeRaysOp& a) { return shade_rays<FusedShaders>(a); }

using RayOps = Types<TraceRaysOp, ShadeRaysOp>;

}  // namespace gvtorch
