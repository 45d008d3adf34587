// The instruction set of packets: chosen once, at the first use.
#pragma once

#include <cstdlib>
#include <string_view>

#include "packets/chunks.h"

namespace gvtorch {

// packet.cpp, compiled once for each instruction set.
namespace baseline {
extern const Chunks chunks;
}  // namespace baseline
#ifdef GV_X86
namespace avx2 {
extern const Chunks chunks;
}  // namespace avx2
namespace avx512 {
extern const Chunks chunks;
}  // namespace avx512
#endif

struct Processor {
  const char* name;
  const Chunks& chunks;
};

// The widest instruction set of this processor; GVTORCH_CPU=baseline, avx2 or avx512 limits it.
inline Processor find_processor() {
#ifdef GV_X86
  const char* limit_name = std::getenv("GVTORCH_CPU");
  const std::string_view requested = limit_name == nullptr ? "avx512" : limit_name;
  __builtin_cpu_init();
  const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("f16c");
  if (requested == "avx512" && has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl")) {
    return {"avx512", avx512::chunks};
  }
  if ((requested == "avx512" || requested == "avx2") && has_avx2) return {"avx2", avx2::chunks};
#endif
  return {"baseline", baseline::chunks};
}

inline const Processor& processor() {
  static const Processor chosen = find_processor();
  return chosen;
}

}  // namespace gvtorch
