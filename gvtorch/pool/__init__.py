"""Node pool, brick pool, the tree over them, and the transfer of bricks to the device."""

from .n3tree import N3Tree as N3Tree
from .pools import BrickPool as BrickPool
from .pools import Channel as Channel
from .pools import NodePool as NodePool
from .staging import BrickTable as BrickTable
