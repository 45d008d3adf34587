"""Node pool, brick pool and the tree over them."""

from .brick_pool import BrickPool
from .channel import Channel
from .n3tree import N3Tree
from .node_pool import NodePool
from .staging import BrickTable, Rows, Staging

__all__ = [
    "BrickPool",
    "BrickTable",
    "Channel",
    "N3Tree",
    "NodePool",
    "Rows",
    "Staging",
]
