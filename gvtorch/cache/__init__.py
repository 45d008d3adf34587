"""The cache: pools with an order of use, requests, and which of them are served."""

from .cache import Cache
from .lru import LRU
from .requests import KINDS, RequestList, Requests, RequestsByKind, coarser_requests
from .scheduler import Scheduler
from .write import (
    Children,
    Targets,
    Written,
    put_bricks,
    share_bricks,
    write_bricks,
    write_tiles,
    write_uniform,
)

__all__ = [
    "KINDS",
    "LRU",
    "Cache",
    "Children",
    "RequestList",
    "Requests",
    "RequestsByKind",
    "Scheduler",
    "Targets",
    "Written",
    "coarser_requests",
    "put_bricks",
    "share_bricks",
    "write_bricks",
    "write_tiles",
    "write_uniform",
]
