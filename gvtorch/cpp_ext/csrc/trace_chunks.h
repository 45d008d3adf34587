// How the CPU shares out rays that are traced in packets.
#pragma once

#include "for_each.h"
#include "walk.h"

namespace gvtorch {

// body(begin, end) for chunks of the rays; first an empty byte for each node, in which it is kept what is hidden.
template <class Device, class Body>
void trace_chunks(const torch::stable::Tensor& like, TraceArgs& args, const Body& body) {
  constexpr int64_t kChunk = 256;
  torch::stable::Tensor hidden_tn =
      torch::stable::new_zeros(like, {args.nodes + 3}, torch::headeronly::ScalarType::Byte);
  args.hidden_tn = static_cast<uint8_t*>(hidden_tn.mutable_data_ptr());
  const int64_t count = RayOrder{args.rays, args.width}.count();
  const auto chunk = [&](int64_t number) { body(number * kChunk, std::min(count, (number + 1) * kChunk)); };
  for_each<Device>(like, (count + kChunk - 1) / kChunk, chunk, 1);
}

}  // namespace gvtorch
