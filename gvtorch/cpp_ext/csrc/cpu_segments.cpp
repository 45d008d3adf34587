// The ops of segments on the CPU.

#include "entry/entry_segments.h"

STABLE_TORCH_LIBRARY_IMPL(gvtorch, CPU, library) { gvtorch::implement(library, gvtorch::SegmentOps{}); }
