// The library of a user's shader (user_shader.h): the op `gvtorch_user::GV_USER_OP`, with the schema of `shade_rays`.
// The compiler gets the user's header by -include, and GV_USER_SHADER, the name of the struct in it. A C++ compiler
// makes the op and its CPU kernel, nvcc the CUDA kernel. On the CPU, float32 rays are traced in packets, for the
// instruction set of the flags; if the header defines GV_RAY_BY_RAY, rays are traced one by one, for tests.

#include "user_shader.h"

template <class T>
using UserShaderOf = GV_USER_SHADER<T>;  // the name given to CompiledShader: a template <class T> struct

#include <type_traits>

#include "entry/entry.h"
#include "shaders/shade_each.h"
#if !defined(__CUDACC__) && !defined(GV_RAY_BY_RAY)
#define GV_PACKETS
#include "packets/packet_walk.h"
#include "packets/trace_chunks.h"
#endif

namespace gvtorch {

// Never called: used only to test whether such calls compile.
constexpr auto kCallAdd = [](auto& shader, auto& interval, auto& probe,
                             auto& sum) -> decltype(shader.add(interval, probe, sum), void()) {};
constexpr auto kCallSurface = [](auto& shader, auto& probe, auto& sum) -> decltype(shader.surface(probe, sum), void()) {
};

// What a shader must have, checked with readable messages.
template <class T, class Shader>
struct Interface {
  using Sum = typename Shader::Sum;
  static constexpr bool kAdds =
      std::is_invocable_v<decltype(kCallAdd), const Shader&, const Interval<T>&, const Probe<T>&, Sum&>;
  static constexpr bool kHasSurface = std::is_invocable_v<decltype(kCallSurface), const Shader&, const Probe<T>&, Sum&>;

  static_assert(std::is_base_of_v<UserShader<T>, Shader>, "a shader is derived from gv::UserShader<T>");
  static_assert(std::is_constructible_v<Shader, const ShadeArgs&>,
                "a shader is made from gv::ShadeArgs: using gv::UserShader<T>::UserShader;");
  static_assert(std::is_trivially_copyable_v<Shader>, "a shader is copied into the kernel: plain values only");
  static_assert(std::is_base_of_v<ShadeSum<T>, Sum>, "a shader's Sum is derived from gv::ShadeSum<T>");
  static_assert(kAdds, "a shader has GV_HD void add(const gv::Interval<T>&, const gv::Probe<T>&, Sum&) const");
  static_assert(!Shader::kSurface || kHasSurface,
                "a shader of kSurface has GV_HD void surface(const gv::Probe<T>&, Sum&) const");
  static_assert(Shader::kFeatures >= Shader::kAsOther, "kFeatures is a number, or kAsOther");
};

template struct Interface<float, UserShaderOf<float>>;
template struct Interface<double, UserShaderOf<double>>;

// The shader of the library, see FusedShaders in entry.h.
struct LibraryShader {
  using FloatShader = UserShaderOf<float>;
  static constexpr int32_t kUniforms = FloatShader::kUniforms;
  static ShaderNeeds needs(int64_t shader) {
    STD_TORCH_CHECK(shader == 0, "gvtorch: shader must be 0");
    return kNeeds<FloatShader>;
  }
  static void run(const Tensor& like, ShadeArgs args, bool in_float64) {
    const auto run_kernel = [&](const auto& kernel) { shade_each(like, args.nodes, kernel); };
    if (in_float64) return run_kernel(ShadeRay<double, CalledShader<UserShaderOf, double>, Digits<double>>(args));
#ifdef GV_PACKETS
    trace_chunks(like, args, trace_packets<CalledShader<UserShaderOf, float>, AnyValues>);
#else
    with_digits<float>(args, [&](auto* digits) {
      run_kernel(ShadeRay<float, CalledShader<UserShaderOf, float>, std::decay_t<decltype(*digits)>>(args));
    });
#endif
  }
};

struct UserOp : ShadeRaysOp {};
inline auto run(const UserOp& a) { return shade_rays<LibraryShader>(a); }

}  // namespace gvtorch

#define GV_TEXT_OF(name) #name
#define GV_TEXT(name) GV_TEXT_OF(name)

#ifdef __CUDACC__
STABLE_TORCH_LIBRARY_IMPL(gvtorch_user, CUDA, library) {
  gvtorch::implement_as<gvtorch::UserOp>(library, GV_TEXT(GV_USER_OP));
}
#else
STABLE_TORCH_LIBRARY_FRAGMENT(gvtorch_user, library) {
  library.def(gvtorch::ShadeRaysOp::schema(GV_TEXT(GV_USER_OP)).c_str());
}

STABLE_TORCH_LIBRARY_IMPL(gvtorch_user, CPU, library) {
  gvtorch::implement_as<gvtorch::UserOp>(library, GV_TEXT(GV_USER_OP));
}

// What Python reads from the struct.
#define GV_EXPORT extern "C" __attribute__((visibility("default")))
GV_EXPORT int32_t gvtorch_features() { return gvtorch::LibraryShader::FloatShader::kFeatures; }
GV_EXPORT int32_t gvtorch_whole() { return gvtorch::LibraryShader::FloatShader::kWhole; }
GV_EXPORT int32_t gvtorch_named() { return gvtorch::LibraryShader::FloatShader::kUniforms >= 0; }
GV_EXPORT const char* gvtorch_uniforms() { return gvtorch::LibraryShader::FloatShader::kUniformNames; }
#endif
