"""The cache: pools with an order of use, requests, and which of them are served."""

from .cache import Cache, Children, Written
from .lru import LRU
from .requests import KINDS, Listed, Requests, Wishes
from .scheduler import Scheduler

__all__ = [
    "KINDS",
    "LRU",
    "Cache",
    "Children",
    "Listed",
    "Requests",
    "Scheduler",
    "Wishes",
    "Written",
]
