// All ops of gvtorch: the one list of families, by which cpu.cpp and cuda.cu register them. The ops of a family are
// listed at the end of its own header.
#pragma once

#include "entry/entry.h"
#include "entry/entry_cache.h"
#include "entry/entry_camera.h"
#include "entry/entry_fields.h"
#include "entry/entry_mesh.h"
#include "entry/entry_noise.h"
#include "entry/entry_points.h"
#include "entry/entry_segments.h"

namespace gvtorch {

// All but those of rays and segments, whose CPU kernels are compiled in cpu_rays.cpp and cpu_segments.cpp.
using OtherOps = decltype(CacheOps{} + MeshOps{} + CameraOps{} + NoiseOps{} + PointOps{} + FieldOps{});
using AllOps = decltype(RayOps{} + SegmentOps{} + OtherOps{});

}  // namespace gvtorch
