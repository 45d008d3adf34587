"""Producers: what makes the content of trees."""

from .mesh import MeshProducer
from .producer import Bricks, Layout, Nodes, Producer, Region, Regions
from .stored import StoredProducer
from .volume import VolumeProducer

__all__ = [
    "Bricks",
    "Layout",
    "MeshProducer",
    "Nodes",
    "Producer",
    "Region",
    "Regions",
    "StoredProducer",
    "VolumeProducer",
]
