"""Node pool, brick pool and the tree over them."""

from .brick_pool import BrickPool, cut_bricks
from .channel import Channel
from .n3tree import N3Tree
from .node_pool import NodePool

__all__ = ["BrickPool", "Channel", "N3Tree", "NodePool", "cut_bricks"]
