"""Node pool, brick pool, the tree over them, and the way of bricks to the device."""

from .brick_table import BrickTable, TableRows
from .channel import Channel
from .n3tree import N3Tree
from .pools import BrickPool, NodePool
from .staging import Staging

__all__ = [
    "BrickPool",
    "BrickTable",
    "Channel",
    "N3Tree",
    "NodePool",
    "Staging",
    "TableRows",
]
