"""Node pool, brick pool, the tree over them, and the transfer of bricks to the device."""

from .n3tree import N3Tree
from .pools import BrickPool, Channel, NodePool
from .staging import BrickTable, Staging, TableRows

__all__ = ["BrickPool", "BrickTable", "Channel", "N3Tree", "NodePool", "Staging", "TableRows"]
