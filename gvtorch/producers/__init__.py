"""Producers: they make the content of trees."""

from .children import FromChildren
from .field import FieldProducer
from .hypertexture import Hypertexture
from .joined import JoinedProducer, StoredChannels
from .mesh import MeshProducer
from .octaves import OctaveProducer
from .points import PointProducer
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions
from .stored import StoredProducer
from .volume import VolumeProducer

__all__ = [
    "Bricks",
    "FieldProducer",
    "FromChildren",
    "Hypertexture",
    "JoinedProducer",
    "Layout",
    "MeshProducer",
    "Nodes",
    "OctaveProducer",
    "PointProducer",
    "Producer",
    "Region",
    "Regions",
    "StoredChannels",
    "StoredProducer",
    "VolumeProducer",
]
