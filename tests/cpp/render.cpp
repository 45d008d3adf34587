// A process with libtorch and the gvtorch library only: loads a scripted TreeTracer and rays, traces them, and
// prints the sums of colour, alpha and samples.
//
// Usage: render libgvtorch_cpu.so tracer.pt rays.pt

#define AT_PER_OPERATOR_HEADERS  // torch/script.h, which has all of these, takes twice as long to compile
#include <dlfcn.h>
#include <torch/csrc/jit/serialization/import.h>

#include <cstdio>

int main(int argc, char** argv) {
  if (argc != 4) {
    std::fprintf(stderr, "usage: %s LIBRARY TRACER RAYS\n", argv[0]);
    return 2;
  }
  if (dlopen(argv[1], RTLD_NOW | RTLD_GLOBAL) == nullptr) {
    std::fprintf(stderr, "%s\n", dlerror());
    return 1;
  }
  torch::jit::Module tracer = torch::jit::load(argv[2]);
  torch::jit::Module rays = torch::jit::load(argv[3]);
  const auto inputs = rays.forward({}).toTuple()->elements();
  const auto hits = tracer.forward({inputs[0], inputs[1], inputs[2], inputs[3]}).toTuple()->elements();
  const auto sum = [&](int index) { return hits[index].toTensor().to(at::kDouble).sum().item<double>(); };
  std::printf("%.9f %.9f %.0f\n", sum(0), sum(1), sum(3));
  return 0;
}
