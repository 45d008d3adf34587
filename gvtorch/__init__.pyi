"""The public names of gvtorch, in groups: `import gvtorch as gv` offers all of them. `*` stands for
the names that a room's `__init__.py` hands on (`from .module import Name as Name`).
"""

# Data, and the tree it becomes.
from .base.arrays import as_volume as as_volume
from .base.image_info import ChannelInfo as ChannelInfo, ImageInfo as ImageInfo
from .base.volume import Volume as Volume
from .io.stores.conversion import convert as convert, estimate as estimate
from .io.mesh_file import read_mesh as read_mesh
from .io.mesh_source import voxelize as voxelize
from .io.point_file import PointFile as PointFile, read_points as read_points
from .io.point_source import splat as splat
from .io.reading import read_volume as read_volume
from .io.stores.store import Store as Store
from .io.surface import export_surface as export_surface, extract_surface as extract_surface
from .io.window import window as window
from .meshes.mesh import Material as Material, Mesh as Mesh
from .points.points import Points as Points
from .points.sorted import SortedPoints as SortedPoints, sort_points as sort_points
from .pool import *

# Fields: functions of position.
from .fields import (
    Field as Field,
    Fractal as Fractal,
    Fur as Fur,
    Iteration as Iteration,
    Julia as Julia,
    Mandelbox as Mandelbox,
    Mandelbulb as Mandelbulb,
    Painted as Painted,
    SampledDistance as SampledDistance,
    Solid as Solid,
    blend as blend,
    mask as mask,
    noise as noise,
    sdf as sdf,
    stack as stack,
    warp as warp,
)

# Producers, which make the content of a tree.
from .producers import *

# Cameras and rays.
from .base.records import Hits as Hits, Rays as Rays
from .cameras import *

# Shaders and lights.
from .cpp_ext.user import CompileError as CompileError
from .shaders import *

# Rendering a resident tree.
from .tracing import *

# Timings of stages.
from .base.stage import Timeline as Timeline

# Streaming a scene larger than memory.
from .engine import *

# Pictures.
from .pictures import *
from . import opengl as opengl

# Looking at a scene in the browser or a notebook.
from .viewer import *

__version__: str
