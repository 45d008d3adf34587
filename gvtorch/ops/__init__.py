"""The ops on bare tensors. Importing this package loads the compiled libraries, so that TorchScript
archives and exported programs that contain `gvtorch::` ops can be loaded."""

from .arguments import RayArguments as RayArguments
from .arguments import Samples as Samples
from .arguments import Segments as Segments
from .arguments import ShadeArguments as ShadeArguments
from .arguments import TraceArguments as TraceArguments
from .cache import choose_requests as choose_requests
from .cache import compact_requests as compact_requests
from .cache import cut_bricks as cut_bricks
from .cache import lacking as lacking
from .cache import link as link
from .cache import link_bricks as link_bricks
from .cache import link_tiles as link_tiles
from .cache import locate as locate
from .cache import lru_partition as lru_partition
from .cache import orphan as orphan
from .cache import put_rows as put_rows
from .cache import unlink as unlink
from .cameras import pinhole_rays as pinhole_rays
from .noise import noise as noise
from .orbits import Orbit as Orbit
from .orbits import orbit_bounds as orbit_bounds
from .orbits import orbits as orbits
from .registry import unavailable as unavailable
from .segments import composite as composite
from .segments import list_samples as list_samples
from .segments import sample_bricks as sample_bricks
from .segments import trace_segments as trace_segments
from .splat import splat as splat
from .trace import shade_rays as shade_rays
from .trace import trace_rays as trace_rays
from .voxelize import voxelize as voxelize
