"""The public names of gvtorch, in groups: `import gvtorch as gv` offers all of them."""

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
from .pool import (
    BrickPool as BrickPool,
    BrickTable as BrickTable,
    Channel as Channel,
    N3Tree as N3Tree,
    NodePool as NodePool,
)

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
from .producers import (
    Bricks as Bricks,
    FieldProducer as FieldProducer,
    FromChildren as FromChildren,
    Hypertexture as Hypertexture,
    JoinedProducer as JoinedProducer,
    MeshProducer as MeshProducer,
    Nodes as Nodes,
    OctaveProducer as OctaveProducer,
    PointProducer as PointProducer,
    Producer as Producer,
    Region as Region,
    Regions as Regions,
    StoredChannels as StoredChannels,
    StoredProducer as StoredProducer,
    VolumeProducer as VolumeProducer,
)

# Cameras and rays.
from .base.records import Hits as Hits, Rays as Rays
from .cameras import (
    Camera as Camera,
    CameraPath as CameraPath,
    CustomCamera as CustomCamera,
    read_cameras as read_cameras,
    write_cameras as write_cameras,
)

# Shaders and lights.
from .cpp_ext.user import CompileError as CompileError
from .shaders import (
    ChannelLook as ChannelLook,
    Channels as Channels,
    CompiledShader as CompiledShader,
    DirectionalLight as DirectionalLight,
    Filtered as Filtered,
    Headlight as Headlight,
    Labels as Labels,
    ModuleShader as ModuleShader,
    PointLight as PointLight,
    Shader as Shader,
    TransferFunction as TransferFunction,
    TransferModule as TransferModule,
)
from .shaders.built_in import *  # its __all__: Lit, Isosurface, Projection and others

# Rendering a resident tree.
from .tracing import (
    Clip as Clip,
    Cost as Cost,
    Layer as Layer,
    Lighting as Lighting,
    RenderOptions as RenderOptions,
    RenderSettings as RenderSettings,
    ThinLens as ThinLens,
    TreeTracer as TreeTracer,
    cost as cost,
    point_layer as point_layer,
    render as render,
    slice_picture as slice_picture,
    trace as trace,
)

# Timings of stages.
from .base.stage import Timeline as Timeline

# Streaming a scene larger than memory.
from .engine import (
    Engine as Engine,
    EngineOptions as EngineOptions,
    FrameStats as FrameStats,
    ProductionError as ProductionError,
)

# Pictures.
from .pictures import (
    Backdrop as Backdrop,
    ColorBar as ColorBar,
    Environment as Environment,
    Gradient as Gradient,
    Overlay as Overlay,
    Picture as Picture,
    Progressive as Progressive,
    Video as Video,
    read_image as read_image,
    render_tiles as render_tiles,
)
from . import opengl as opengl

# Looking at a scene in the browser or a notebook.
from .viewer import Flight as Flight, Viewer as Viewer, ViewState as ViewState, view as view

__version__: str
