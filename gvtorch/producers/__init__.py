"""Producers: they make the content of trees."""

from .children import FromChildren as FromChildren
from .field import FieldProducer as FieldProducer
from .hypertexture import Hypertexture as Hypertexture
from .joined import JoinedProducer as JoinedProducer
from .joined import StoredChannels as StoredChannels
from .mesh import MeshProducer as MeshProducer
from .octaves import OctaveProducer as OctaveProducer
from .points import PointProducer as PointProducer
from .producer import Bricks as Bricks
from .producer import Layout as Layout
from .producer import Nodes as Nodes
from .producer import Producer as Producer
from .producer import Region as Region
from .producer import Regions as Regions
from .stored import StoredProducer as StoredProducer
from .volume import VolumeProducer as VolumeProducer
