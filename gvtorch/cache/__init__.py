"""The cache: pools with an order of use, requests, and which of them are served."""

from .cache import Cache
from .lru import LRU
from .requests import KINDS, RequestList, Requests, RequestsByKind
from .scheduler import Scheduler

__all__ = ["KINDS", "LRU", "Cache", "RequestList", "Requests", "RequestsByKind", "Scheduler"]
