"""The cache: pools with an order of use, requests, and the choice of those that are served."""

from .cache import LRU, Cache
from .requests import KINDS, RequestList, Requests, RequestsByKind, Scheduler

__all__ = ["KINDS", "LRU", "Cache", "RequestList", "Requests", "RequestsByKind", "Scheduler"]
